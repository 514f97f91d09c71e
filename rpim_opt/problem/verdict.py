"""Whether a start is certainly right: cost and bound, what else would fit as well, and how many measurements agree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.problem.graduated import FULL, Solved
from rpim_opt.problem.loops import Loops

GAP = 1e-3
"""What cost and bound may differ by, in units of one plus the cost: a chi-squared means nothing finer."""
UNKNOWN = 0.1
"""Standard deviation of a rotation [rad] from which it is not determined."""
FAR = 0.5
"""Angle [rad] within which all starts have to be that fit as well, for there to be one."""
AS_WELL = 1e-4
"""Probability that the truth fits worse than what counts as fitting as well."""


@dataclass(frozen=True, eq=False)
class CertifiedStart:
    """Base and tool of closed loops, and whether no others fit better.

    ::

        cost   = sum_i loss(|r_i|) + |t - expected|^2 / spread^2,   r_i in standard deviations
        bound <= cost of any bases, tools and scale whatever
        gap    = (cost - bound) / (1 + cost)

    Parameters
    ----------
    bases
        (4, 4) transform of the robot's base in each instrument's frame [m], by instrument.
    tools
        (4, 4) transform of each tool or target in the flange frame [m], by marker; not turned where positions alone
        were measured.
    scale
        The metre's part that the instrument calls one; 1 unless it was asked for.
    cost, bound, gap
        As above. Where a loss weighs outliers, the bound is that of the sum of squares with the final weights.
    rank_ratio
        Second over first eigenvalue of the moment matrix: zero where the relaxation is tight and the optimum the only
        one.
    uncertainty
        Standard deviation of the least certain rotation [rad].
    radius
        Angle [rad] from these rotations beyond which all others fit worse by more than noise explains; proven as the
        bound is.
    weights
        (N,) that the loss gives the measurements; one for those that count in full.
    certified
        Whether the optimum is global, the only one and determined, and, where outliers were expected, so many
        measurements agree with it that no other can have as many.
    reason
        Why it is certified or not, in a sentence.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> arm = ro.load("paper_arm").problem
    >>> flange = ro.robot.forward_kinematics(arm.robot, arm.data.q)
    >>> start = ro.problem.certified_hand_eye(flange, flange)
    >>> bool(start.gap < 1e-6), bool(np.abs(start.tools[""] - np.eye(4)).max() < 1e-6)
    (True, True)
    """

    bases: Mapping[str, Array]
    tools: Mapping[str, Array]
    scale: float
    cost: float
    bound: float
    gap: float
    rank_ratio: float
    uncertainty: float
    radius: float
    weights: Array
    certified: bool
    reason: str


def judged(
    solved: Solved, loops: Loops, frames: tuple[Mapping[str, Array], Mapping[str, Array]], scale: float
) -> CertifiedStart:
    """Return the start with its proof, or what it lacks."""
    best = solved.smallest
    excess = best.value - best.bound
    gap = excess / (1 + solved.cost)
    weakest = float(np.linalg.eigvalsh(best.information)[0])
    uncertainty = float(1 / np.sqrt(weakest)) if weakest > 0 else float(np.inf)
    radius = best.radius(float(chdtri(loops.unknowns, AS_WELL)))
    doubt = _doubt(solved, gap, uncertainty, radius, scale)
    reason = doubt or f"no other start is better: the bound meets the cost within {gap:.1e} of it"
    return CertifiedStart(
        bases=frames[0],
        tools=frames[1],
        scale=float(scale),
        cost=solved.cost,
        bound=solved.cost - excess,
        gap=gap,
        rank_ratio=best.rank_ratio,
        uncertainty=uncertainty,
        radius=radius,
        weights=solved.weights,
        certified=not doubt,
        reason=reason,
    )


def _doubt(solved: Solved, gap: float, uncertainty: float, radius: float, scale: float) -> str:
    """Return what keeps a start from being certain, in words; nothing where nothing does."""
    N = len(solved.weights)
    if uncertainty > UNKNOWN:
        return (
            f"the measurements do not determine the rotations (about {uncertainty:.2g} rad): turns about two axes would"
        )
    if gap > GAP:
        return f"the relaxation is not tight: another start may be up to {100 * gap:.2g} % better"
    if radius > FAR:
        return f"another start, up to {radius:.2g} rad away, may fit as well: more or other poses would tell"
    if scale <= 0:
        return "the measurements do not determine the scale"
    if not solved.settled:
        return "the weights of the loss did not settle"
    if solved.weights.min() < 1 and not solved.alone:
        full = int(np.sum(solved.weights > FULL))
        return f"{full} of {N} measurements agree, and as many others may agree with another start"
    return ""
