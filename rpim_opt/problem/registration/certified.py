"""Certified registration: base and tool from closed loops, with a proof that none fit better."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.problem.registration.closed_forms import NOMINAL_ERROR, Place, hand_eye, rigid
from rpim_opt.problem.registration.loops import LOSSES, Loops, Solved, of_motions, of_poses, solve

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

    Angles are in rad; ``bound`` and ``radius`` are proven. Where outliers are left out, the bound is that of the sum of
    squares of the others. ``certified`` says that the optimum is global, the only one and determined, and, where
    outliers were expected, that so many measurements agree with it that no other can have as many.

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

    bases: Mapping[str, Array]  # (4, 4) transform of the robot's base in each instrument's frame [m], by instrument
    tools: Mapping[str, Array]  # (4, 4) of each target in the flange frame, by marker; not turned by positions alone
    scale: float  # the metre's part that the instrument calls one; 1 unless it is estimated
    cost: float
    bound: float
    gap: float
    rank_ratio: float  # second over first eigenvalue of the moment matrix: zero where the relaxation is tight
    uncertainty: float  # standard deviation of the least certain rotation
    radius: float  # angle from these rotations beyond which all others fit worse by more than noise explains
    weights: Array  # (N,) that the loss gives the measurements; one for those that count
    certified: bool
    reason: str  # why it is certified or not, in a sentence


def _judged(
    solved: Solved, loops: Loops, bases: Mapping[str, Array], tools: Mapping[str, Array], scale: float
) -> CertifiedStart:
    """Return the start with its proof, or what it lacks."""
    best = solved.smallest
    excess = best.value - best.bound
    gap = excess / (1 + solved.cost)
    weakest = float(np.linalg.eigvalsh(best.information)[0])
    uncertainty = float(1 / np.sqrt(weakest)) if weakest > 0 else float(np.inf)
    radius = best.radius(float(chdtri(loops.unknowns, AS_WELL)))
    full = int(np.sum(solved.weights))
    several = solved.weights.min() < 1 and not solved.alone
    causes = {
        f"the measurements do not determine the rotations (about {uncertainty:.2g} rad): turns about two axes would": (
            uncertainty > UNKNOWN
        ),
        f"the relaxation is not tight: another start may be up to {100 * gap:.2g} % better": gap > GAP,
        f"another start, up to {radius:.2g} rad away, may fit as well: more or other poses would tell": radius > FAR,
        "the measurements do not determine the scale": scale <= 0,
        "the weights of the loss did not converge": not solved.settled,
        f"{full} of {len(solved.weights)} measurements agree, and as many others may agree with another start": several,
    }
    cause = next((text for text, true in causes.items() if true), "")
    return CertifiedStart(
        bases=bases,
        tools=tools,
        scale=float(scale),
        cost=solved.cost,
        bound=solved.cost - excess,
        gap=gap,
        rank_ratio=best.rank_ratio,
        uncertainty=uncertainty,
        radius=radius,
        weights=solved.weights,
        certified=not cause,
        reason=cause or f"no other start is better: the bound meets the cost within {gap:.1e} of it",
    )


@one_blas_thread
def certified_hand_eye(
    flange: Array,
    measured: Array,
    *,
    marker: Sequence[str] | None = None,
    instrument: Sequence[str] | None = None,
    sigma: tuple[float | Array, float | Array] = (NOMINAL_ERROR, NOMINAL_ERROR),
    expected: Mapping[str, Place] | None = None,
    spread: float = np.inf,
    scaled: bool = False,
    loss: str = "squares",
) -> CertifiedStart:
    """Return bases Z and tools X of A X = Z B, measured_i = Z flange_i X, with a proof that none are better.

    ::

        minimize  sum_i loss(|r_i|),   |r_i|^2 = |Z_R'y_i - A_R,i t - A_t,i - u|^2 / sigma_position^2
                                               + |B_R,i X_R' - Z_R A_R,i|^2 / (2 sigma_orientation^2)

    over rotations Z_R, X_R and translations t = X_t, u = Z_R'Z_t of several instruments and markers, all at once. The
    translations are eliminated exactly; the rotations are relaxed to a moment matrix (`relaxation.relax`).

    Parameters
    ----------
    flange
        (N, 4, 4) transforms of the flange in the robot's base [m].
    measured
        (N, 4, 4) of the tool in the instrument's frame, NaN for rotations that were not measured; or positions (N, 3).
    marker, instrument
        (N,) names of what was seen (reflector, target) and by what (camera); by default one of each.
    sigma
        Standard deviations of a position [m] and an orientation [rad], each a number or (N,): of the instrument and of
        the robot, which differs from the nominal one.
    expected, spread
        (3,) where markers are in the flange frame [m], and the standard deviation of that [m]. A direction that the
        measurements do not show stays there in any case.
    scaled
        Whether the unit of the instrument's lengths is unknown.
    loss
        "squares", or "truncated", which leaves outliers out.

    Raises
    ------
    InputError
        For fewer than three measurements, and what is no transform.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> arm = ro.load("paper_arm").problem
    >>> flange = ro.robot.forward_kinematics(arm.robot, arm.data.q)
    >>> base, tool = np.eye(4), np.eye(4)
    >>> base[:3, 3], tool[:3, 3] = [2.0, 0.0, 0.5], [0.0, 0.02, 0.06]
    >>> seen = base @ flange @ tool
    >>> seen[0, 0, 3] += 0.5  # one of them is wrong
    >>> start = ro.problem.certified_hand_eye(flange, seen, loss="truncated")
    >>> bool(np.abs(start.bases[""] - base).max() < 1e-6), bool(np.abs(start.tools[""] - tool).max() < 1e-6)
    (True, True)
    >>> start.certified, int(np.sum(start.weights == 0))
    (True, 1)
    """
    flange, measured, turned = _checked(flange, measured, loss)
    N = len(flange)
    markers, which = _numbered(marker, N, "marker")
    instruments, where = _numbered(instrument, N, "instrument")
    places = np.array([np.asarray((expected or {}).get(name, (0, 0, 0)), dtype=float)[:3] for name in markers])
    loops = of_poses(flange, measured, turned, where, which, _deviations(sigma, N), places, spread, scaled)
    candidates = []
    if len(markers) == len(instruments) == 1 and turned.all():
        with suppress(InputError):
            Z, X = hand_eye(flange, measured)
            candidates.append(np.stack([Z[:3, :3], X[:3, :3].T]))
    solved = solve(loops, loss, candidates)
    R = solved.smallest.rotations
    count = len(instruments)
    scale = 1 / solved.v[loops.linear - 1] if scaled else 1.0
    t = solved.v[: loops.linear - scaled].reshape(-1, 3) * scale
    turns = dict(zip(np.unique(which[turned]).tolist(), R[count:].swapaxes(1, 2), strict=True))
    bases = {name: rigid(R[i], R[i] @ t[len(markers) + i]) for i, name in enumerate(instruments)}
    tools = {name: rigid(turns.get(k, np.eye(3)), t[k]) for k, name in enumerate(markers)}
    return _judged(solved, loops, bases, tools, scale)


@one_blas_thread
def certified_motions(
    A: Array,
    B: Array,
    *,
    sigma: tuple[float | Array, float | Array] = (NOMINAL_ERROR, NOMINAL_ERROR),
    expected: Place = (0, 0, 0),
    spread: float = np.inf,
    scaled: bool = False,
    loss: str = "squares",
) -> CertifiedStart:
    """Return the tool X of A X = X B, motions of the flange and of what is on it, with a proof that none is better.

    ::

        minimize  sum_i loss(|r_i|),   |r_i|^2 = |X_R B_t,i - A_R,i t + t - A_t,i|^2 / sigma_position^2
                                               + |A_R,i X_R - X_R B_R,i|^2 / (2 sigma_orientation^2)

    Parameters
    ----------
    A
        (N, 4, 4) motions of the flange, flange_i^-1 flange_j [m].
    B
        (N, 4, 4) motions of the tool or camera in its own frame.
    sigma
        Standard deviations of a motion's translation [m] and rotation [rad], each a number or (N,).
    expected, spread
        (3,) where the tool is in the flange frame [m], and the standard deviation of that [m].
    scaled
        Whether the unit of lengths in B is unknown (a single camera).
    loss
        "squares" or "truncated".

    Raises
    ------
    InputError
        For fewer than two motions, and what is no transform.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> arm = ro.load("paper_arm").problem
    >>> flange = ro.robot.forward_kinematics(arm.robot, arm.data.q)
    >>> tool = np.eye(4)
    >>> tool[:3, 3] = [0.0, 0.02, 0.06]
    >>> A = np.linalg.inv(flange[:-1]) @ flange[1:]
    >>> B = np.linalg.inv(tool) @ A @ tool
    >>> B[:, :3, 3] *= 20  # in units of five centimetres
    >>> start = ro.problem.certified_motions(A, B, scaled=True)
    >>> bool(np.abs(start.tools[""] - tool).max() < 1e-6), round(start.scale, 9)
    (True, 0.05)
    """
    A, B, turned = _checked(A, B, loss, 2)
    if not turned.all():
        raise InputError("B", "motions without a rotation", "rotations of all motions")
    place = np.asarray(expected, dtype=float)
    loops = of_motions(A, B, _deviations(sigma, len(A)), place, spread, scaled)
    solved = solve(loops, loss)
    scale = 1 / solved.v[3] if scaled else 1.0
    tool = rigid(solved.smallest.rotations[0], solved.v[:3] * scale)
    return _judged(solved, loops, {}, {"": tool}, scale)


def _checked(flange: Array, measured: Array, loss: str, fewest: int = 3) -> tuple[Array, Array, np.ndarray]:
    """Return transforms and which were measured to turn; refuse what is none."""
    flange = np.asarray(flange, dtype=float)
    measured = np.asarray(measured, dtype=float)
    N = len(flange)
    if loss not in LOSSES:
        raise InputError("loss", repr(loss), ", ".join(LOSSES))
    if flange.shape != (N, 4, 4) or measured.shape not in ((N, 4, 4), (N, 3)):
        raise InputError(
            "transforms", f"shapes {flange.shape}, {measured.shape}", "(N, 4, 4) both, or positions (N, 3)"
        )
    if fewest > N:
        raise InputError("poses", f"{N}", f"{fewest} or more")
    points = measured if measured.ndim == 2 else measured[:, :3, 3]
    poses = rigid(np.eye(3), points)
    turned = np.zeros(N, dtype=bool)
    if measured.ndim == 3:
        turned = np.asarray(~np.isnan(measured[:, :3, :3]).any(axis=(1, 2)))
        poses[turned] = measured[turned]
    if not (np.isfinite(flange).all() and np.isfinite(poses).all()):
        raise InputError("transforms", "numbers that are not finite", "finite numbers")
    for R in (flange[:, :3, :3], poses[:, :3, :3]):
        off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        wrong = np.flatnonzero((off > 1e-3) | (np.linalg.det(R) < 0))
        if len(wrong):
            raise InputError(
                f"pose {wrong[0] + 1}", f"a matrix that misses R R' = 1 by {off[wrong[0]]:.2g}", "a rotation"
            )
    return flange, poses, turned


def _numbered(names: Sequence[str] | None, N: int, what: str) -> tuple[list[str], np.ndarray]:
    if names is None:
        return [""], np.zeros(N, dtype=int)
    if len(names) != N:
        raise InputError(what, f"{len(names)} names", f"one for each of {N} poses")
    known, number = np.unique(np.asarray(names, dtype=str), return_inverse=True)
    return known.tolist(), number


def _deviations(sigma: tuple[float | Array, float | Array], N: int) -> Array:
    both = np.stack([np.broadcast_to(np.asarray(each, dtype=float), N) for each in sigma], axis=1)
    if not (np.isfinite(both).all() and (both > 0).all()):
        raise InputError("sigma", "a number that is not positive", "standard deviations of position and orientation")
    return both
