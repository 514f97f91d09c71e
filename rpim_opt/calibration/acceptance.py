"""Whether a calibrated robot keeps a limit: accepted, rejected, or what is lacking to tell."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal

import numpy as np
from scipy.special import bdtrc

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import joined, listed, percent
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.basics.units import display
from rpim_opt.calibration.causes import refuse_misread
from rpim_opt.calibration.held_out_rows import Checked, checked
from rpim_opt.calibration.lack_of_fit import judged
from rpim_opt.calibration.region import Reaching, Region, Share, reaching, region_of, share
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.record import Requirement

Verdict = Literal["accepted", "rejected", "undecided"]
FEWEST = 5
"""Rows that were kept apart, below which they say too little of the intervals."""
MOST = 3
"""Joints or rows that a reason names."""


@dataclass(frozen=True, eq=False)
class Acceptance:
    """What a requirement and a calibration come to.

    Parameters
    ----------
    requirement
        The limit and the region.
    verdict
        ``"accepted"``: at every configuration of the region the bound is within the limit, and rows that were kept
        apart bear it out. ``"rejected"``: they miss oftener than chance allows, or the robot's own scatter at its
        least is above the limit. ``"undecided"``: something is lacking, see ``reasons``.
    reasons
        What rejects it, or what is lacking, a sentence each.
    count
        How many configurations of the region were drawn.
    bound, typical
        The largest bound of the region, and the median of those drawn [m]; None where there is none.
    scatter
        What would be left of the largest bound if all parameters were known [m].
    worst, place
        (dof,) joint values [rad or m] and predicted position (3,) [m] of the largest bound.
    checked
        The rows that were kept apart, beside the limit.
    drawn
        The positions that were drawn with their bounds.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.load("position").calibrate()
    >>> found = ro.calibration.accept(result, ro.data.Requirement(limit=1e-4))
    >>> print(found.verdict, f"{1e3 * found.bound:.2f} mm")
    accepted 0.08 mm
    >>> print(found.sentences()[1])
    Region: joints within the measured ranges.
    >>> ro.calibration.accept(result, ro.data.Requirement(limit=5e-5)).content()["verdict"]
    'undecided'
    """

    requirement: Requirement
    verdict: Verdict
    reasons: tuple[str, ...]
    count: int = 0
    bound: float | None = None
    typical: float | None = None
    scatter: float | None = None
    worst: Array | None = None
    place: Array | None = None
    checked: Checked | None = None
    drawn: Reaching | None = field(default=None, repr=False)

    def sentences(self) -> list[str]:
        """Return the verdict and what it rests on, sentence by sentence."""
        limit = f"{1e3 * self.requirement.limit:g} mm"
        said = {"accepted": "Accepted", "rejected": "Rejected", "undecided": "Cannot be decided"}[self.verdict]
        lines = [
            f"{said}: limit {limit} with {percent(self.requirement.confidence)} at every configuration of the region."
        ]
        lines.append(f"Region: {self.requirement.where}.")
        if self.bound is not None and self.typical is not None and np.isfinite(self.bound):
            lines.append(
                f"The position reached is within {1e3 * self.bound:.3f} mm of the predicted one even at the worst of "
                f"{self.count} configurations and a search from there; {1e3 * self.typical:.3f} mm in the middle."
            )
        if self.checked is not None:
            lines.append(self.checked.sentence())
        return [*lines, *self.reasons]

    def __str__(self) -> str:
        """Return the verdict and what it rests on."""
        return "\n".join(self.sentences())

    def content(self) -> dict[str, Any]:
        """Return the same as a document [mm]."""
        r = self.requirement
        box = None
        if r.box is not None:
            box = {axis: [1e3 * low, 1e3 * high] for axis, (low, high) in zip("xyz", r.box, strict=True)}
        return {
            "verdict": self.verdict,
            "limit_mm": 1e3 * r.limit,
            "confidence": r.confidence,
            "region": r.where,
            "box_mm": box,
            "configurations": self.count,
            "bound_mm": _milli(self.bound),
            "typical_mm": _milli(self.typical),
            "scatter_mm": _milli(self.scatter),
            "worst": None if self.worst is None else self.worst.tolist(),
            "place_mm": None if self.place is None else (1e3 * self.place).tolist(),
            "checked": self.checked and self.checked.content(),
            "reasons": list(self.reasons),
        }


def _milli(value: float | None) -> float | None:
    if value is None or not np.isfinite(value):
        return None
    return 1e3 * value


@one_blas_thread
def accept(result: Calibration, requirement: Requirement | None = None, data: Dataset | None = None) -> Acceptance:
    """Return whether the calibrated robot keeps a limit at every configuration of a region.

    What is held against the limit is the position that the robot will reach, as `Calibration.predict` has it: with the
    uncertainty of the parameters and the robot's own scatter, without the instrument's. Its distance from the predicted
    position stays below the bound with the confidence that is required (`distance_quantile`); the bound is taken at
    2048 configurations of the region, and a search goes on from the worst.

    A bound is as good as its covariance. Rows that the calibration did not see check it: they have to lie in their
    intervals, and may not miss by more than the limit oftener than chance lets them.

    Parameters
    ----------
    result
        The calibration.
    requirement
        The limit and the region; what the result's record states by default.
    data
        Measurements that the calibration did not see; those of its record by default, used since (`refit_all`) or not.

    Raises
    ------
    InputError
        Where nothing is required, for a region that the robot has not or does not reach, and for measurements of
        which another reading (another unit, exchanged joints) fits far better.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.load("position").calibrate()
    >>> box = ((0.3, 0.8), (-0.5, 0.5), (0.2, 0.9))
    >>> print(ro.calibration.accept(result, ro.data.Requirement(2e-4, box=box)).sentences()[0])
    Accepted: limit 0.2 mm with 95 % at every configuration of the region.
    """
    requirement = requirement or result.record.requirement
    if requirement is None:
        raise InputError("acceptance", "no limit", "a limit [mm]: --limit, or limit_mm in [acceptance]")
    if data is not None:
        refuse_misread(result, data)
    region = region_of(result, requirement)
    q = region.drawn()
    seen = checked(result, region, requirement, data)
    lacking = _lacking(result, region, seen)
    try:
        found = reaching(result, region, q, requirement.confidence)
    except InputError as error:
        verdict = "undecided" if result.verdict.delivered else "rejected"
        reasons = (*result.verdict.reasons, *lacking, f"No bound: {error}")
        return Acceptance(requirement, verdict, reasons, len(q), checked=seen)
    bound = partial(_bound, result, region, requirement.confidence)
    worst = region.largest(q, found.bound, bound)
    at = reaching(result, region, worst[None], requirement.confidence)
    made = share(result, region, worst, requirement.confidence)
    verdict, reasons = _verdict(result, requirement, float(at.bound[0]), made, seen, lacking)
    return Acceptance(
        requirement,
        verdict,
        reasons,
        count=len(q),
        bound=float(at.bound[0]),
        typical=float(np.median(found.bound)),
        scatter=made.scatter,
        worst=worst,
        place=at.position[0],
        checked=seen,
        drawn=found,
    )


def _bound(result: Calibration, region: Region, confidence: float, q: Array) -> Array:
    return reaching(result, region, q, confidence).bound


def _verdict(
    result: Calibration,
    requirement: Requirement,
    bound: float,
    made: Share,
    seen: Checked | None,
    lacking: list[str],
) -> tuple[Verdict, tuple[str, ...]]:
    against = [*result.verdict.reasons, *_against(requirement, made, seen)]
    if against:
        return "rejected", tuple(against)
    reasons = [*lacking, *_wide(requirement.limit, bound, made)]
    if reasons:
        return "undecided", tuple(reasons)
    return "accepted", ()


def _wide(limit: float, bound: float, made: Share) -> list[str]:
    """Say what would lower a bound that is above the limit."""
    if not np.isfinite(bound):
        return ["Lacking: measurements of directions that neither data nor penalty decide, and that move the robot."]
    if bound <= limit:
        return []
    if made.scatter > limit:
        return [
            f"Lacking: a better known scatter. The robot's own, which this calibration takes for up to "
            f"{1e3 * made.scatter:.3f} mm, may be above the limit or not: approach some poses repeatedly "
            "(`rpim-opt iso9283`)."
        ]
    return [
        f"Lacking: measurements. The bound is {1e3 * bound:.3f} mm; with all parameters known the robot's own scatter "
        f"would leave {1e3 * made.scatter:.3f} mm of it. `rpim-opt design PROBLEM --augment --count 10` names the "
        "configurations that help most."
    ]


def _against(requirement: Requirement, made: Share, seen: Checked | None) -> list[str]:
    """Return what shows that the limit is not kept."""
    reasons: list[str] = []
    if seen is not None and seen.missing:
        chance = 1 - requirement.confidence
        if bdtrc(len(seen.missing) - 1, seen.count, chance) < chance:
            reasons.append(
                f"{len(seen.missing)} of {seen.count} rows miss by more than the limit and the instrument's part of "
                f"it: {listed(list(seen.missing), MOST)}."
            )
    if made.least_scatter > requirement.limit:
        least = f"{1e3 * made.least_scatter:.3f} mm"
        reasons.append(f"The robot's own scatter alone is {least} at the least: no calibration lowers that.")
    return reasons


def _lacking(result: Calibration, region: Region, seen: Checked | None) -> list[str]:
    """Return what keeps a bound from being believed."""
    lines: list[str] = []
    lacking = judged(result)
    if lacking is not None and lacking.alarming:
        lines.append(f"Lacking: a model that fits. {lacking}")
    if seen is None:
        lines.append(
            "Lacking: rows that the calibration did not see (`new --hold-out`, or a table for `accept --data`)."
        )
    else:
        lines += seen.doubts(FEWEST)
    return [*lines, *_beyond(result, region)]


def _beyond(result: Calibration, region: Region) -> list[str]:
    """Say which joints of the region go beyond what was measured."""
    corners = Dataset.of(region.limits.T.copy(), np.zeros((2, 3)), 1.0)
    found = result.outside(corners)
    if not found.rows:
        return []
    named: list[str] = []
    for joint in found.joints:
        unit, si = display(result.problem.robot.joint_dimensions[joint - 1])
        low, high = region.limits[joint - 1] / si
        named.append(f"joint {joint} from {low:.4g} to {high:.4g} {unit}")
    return [f"Lacking: measurements with {joined(named)}, as the region has it: nothing checked the model there."]
