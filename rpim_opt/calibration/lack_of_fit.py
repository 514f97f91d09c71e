"""Lack of fit: what a calibration's residuals consist of, which effect the model lacks, and what to do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError, NoSolutionFound
from rpim_opt.basics.text import joined
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.bayes.hyperparameters import sampled
from rpim_opt.bayes.model_selection import Comparison
from rpim_opt.calibration.identify import calibrate
from rpim_opt.calibration.outcome import Outcome
from rpim_opt.calibration.residuals import (
    FEWEST,
    PATTERNS,
    Alike,
    Effect,
    errors_alike,
    excess,
    narrow,
    parts,
    present,
    repeated,
    upward,
)
from rpim_opt.convex.formulation import tikhonov
from rpim_opt.convex.select import reml
from rpim_opt.problem.source import Source

QUICK = 60
"""Configurations that are looked at before calibrating."""
ALIKE = 4.0
"""z-score from which on residuals are said to be autocorrelated."""
ROUGH, FINE = 2.0, 0.3
"""Repeatability over measurement noise above which the robot is the limit, and below which the instrument is."""
GROSS = 300.0
"""Scatter over the instrument's noise above which data are wrong."""
NEGLIGIBLE = 0.1
"""Parts below this share of a larger one are not worth a word."""
UNITS = {"length": ("mm", 1e-3), "angle": ("mrad", 1e-3), "pixel": ("px", 1.0)}
"""Unit in which what is left is said, and its size in SI."""
WHAT = {
    "gravity": "gravity",
    "first harmonic": "unevenly turning joints (eccentric encoders or gears)",
    "second harmonic": "second harmonics of joints",
    "moments": "gravity on masses elsewhere than supposed",
    "sessions": "a registration that differs from session to session",
    "temperature": "lengths that grow with temperature",
}
DOES = {
    "gravity": "The arm bends under gravity",
    "first harmonic": "Joints turn unevenly (eccentric encoders or gears)",
    "second harmonic": "Joints turn unevenly twice a turn",
    "sessions": "The registration differs from session to session",
    "temperature": "Lengths grow with temperature",
}


@dataclass(frozen=True, eq=False)
class LackOfFit:
    """What a calibration's residuals consist of.

    RMS values are lengths of vectors [m], root of the mean square over the rows; [rad] or [px] where no length
    was measured.

    Parameters
    ----------
    configurations
        How many were looked at.
    equations, spare
        How many equations there are, and how many the deviations leave over; with fewer than 6 nothing else is judged.
    dimension
        ``"length"``, ``"angle"`` or ``"pixel"``.
    left
        RMS of the errors of the rows.
    instrument, position, joint
        RMS of the noise's parts: the instrument's as declared (or learned), the robot's scatter in position (in
        orientation without lengths), and what comes from its joints.
    repeatable
        RMS of what `missing` would explain.
    missing
        Families that the data want beside those of the model; empty: none.
    parameters
        Patterns that identify them.
    gain
        By how much -2 ln L falls with them.
    share
        Part of the variance of what is left that they would explain, 0 to 1.
    present
        Families of the model that earn their parameters.
    alike
        Whether similar configurations err alike in the model with all that `missing` names; None for too few.
    upward
        Joints whose compliance is significantly negative, which gravity cannot do.
    narrow
        Joints that turned so little that nothing of their gears can be told.
    repeated
        RMS of repeated readings of a configuration about their mean; None without enough of them.
    excess
        RMS of what is left beyond that, where it is more than chance.
    overstated
        Whether the residuals are smaller than the stated measurement noise, by the chi-squared test (`NoiseTest`).

    Examples
    --------
    >>> import rpim_opt as ro
    >>> from rpim_opt.calibration.lack_of_fit import lack_of_fit
    >>> found = lack_of_fit(ro.calibrate(ro.load("position").problem))
    >>> found.missing, found.alarming, round(1e3 * found.instrument, 3)
    ((), False, 0.052)
    """

    configurations: int
    equations: int
    spare: float
    dimension: str
    left: float
    instrument: float = 0.0
    position: float = 0.0
    joint: float = 0.0
    repeatable: float = 0.0
    missing: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    gain: float = 0.0
    share: float = 0.0
    present: Mapping[str, Effect] = field(default_factory=dict)
    alike: Alike | None = None
    upward: tuple[int, ...] = ()
    narrow: tuple[int, ...] = ()
    repeated: float | None = None
    excess: float = 0.0
    overstated: bool = False

    @property
    def robot(self) -> float:
        """RMS of the robot's scatter."""
        return float(np.hypot(self.position, self.joint))

    @property
    def correlated(self) -> bool:
        """Whether similar configurations err alike, beyond what chance does."""
        return self.alike is not None and self.alike.z > ALIKE

    @property
    def alarming(self) -> bool:
        """Whether anything is said to lack."""
        return bool(self.missing or self.upward or self.correlated)

    def sentences(self) -> list[str]:
        """Return the paragraph, sentence by sentence."""
        return _sentences(self)

    def __str__(self) -> str:
        """Return the paragraph."""
        return " ".join(self.sentences())

    def content(self) -> dict[str, Any]:
        """Return the same as a document [mm, mrad or px]."""
        unit, si = UNITS[self.dimension]
        milli = ("left", "instrument", "position", "joint", "repeatable", "excess")
        repeated = None
        if self.repeated is not None:
            repeated = self.repeated / si
        likeness = None
        if self.alike is not None:
            likeness = self.alike._asdict()
        own = {}
        for family, effect in self.present.items():
            size = None
            if effect.rms is not None:
                size = effect.rms / si
            own[family] = {"gain": effect.gain, f"rms_{unit}": size}
        return {
            "configurations": self.configurations,
            "equations": self.equations,
            "spare": self.spare,
            "dimension": self.dimension,
            **{f"{key}_{unit}": getattr(self, key) / si for key in milli},
            f"repeated_{unit}": repeated,
            "missing": list(self.missing),
            "identify": list(self.parameters),
            "gain": self.gain,
            "share": self.share,
            "present": own,
            "alike": likeness,
            "upward": list(self.upward),
            "narrow": list(self.narrow),
            "alarming": self.alarming,
            "text": self.sentences(),
        }


@one_blas_thread
def lack_of_fit(result: Outcome) -> LackOfFit:
    """Return what a calibration leaves, and what it is made of.

    The evidence of families is computed at the linearization of the result, whatever its weight; of large data at
    most 1000 configurations are looked at, and rows that the fit distrusts are left out.

    Parameters
    ----------
    result
        Any calibration, just made or read from a file.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> from rpim_opt.calibration.lack_of_fit import lack_of_fit
    >>> found = lack_of_fit(ro.calibrate(ro.load("position").problem, ro.tikhonov, ro.reml))
    >>> print(found.sentences()[0].partition(" (")[0])
    Residual RMS 0.0468 mm
    """
    compared = Comparison(result)
    errors = compared.problem.errors(result.x, compared.dimension)
    left = float(np.sqrt(np.nanmean(errors**2)))
    known: dict[str, Any] = {
        "configurations": compared.configurations,
        "equations": len(compared.row),
        "spare": compared.spare,
        "dimension": compared.dimension,
        "left": left,
    }
    if compared.spare < FEWEST:
        return LackOfFit(**known)
    best = compared.best
    after = parts(compared, best)
    total = _square(parts(compared, compared.plain))
    explained = max(total - _square(after), 0.0)
    share = 0.0
    if best.families:
        share = explained / total
    again = repeated(compared.problem, result.x, compared.dimension)
    return LackOfFit(
        **known,
        instrument=after["instrument"],
        position=after["position"],
        joint=after["joint"],
        repeatable=float(np.sqrt(share * total)),
        missing=best.families,
        parameters=tuple(p for family in best.families for p in PATTERNS[family]),
        gain=compared.gain,
        share=share,
        present=present(compared),
        alike=errors_alike(compared, best),
        upward=upward(compared),
        narrow=narrow(compared.problem),
        repeated=again.rms,
        excess=excess(again, total, compared.spare),
        overstated=_overstated(result),
    )


def judged(result: Outcome) -> LackOfFit | None:
    """Return `lack_of_fit`, or None for a calibration that did not converge, or whose equations are no numbers."""
    if not result.converged:
        return None
    try:
        return lack_of_fit(result)
    except np.linalg.LinAlgError:
        return None


def foreseen(problem: Source) -> LackOfFit | None:
    """Return what a quick fit of the geometry would leave, of at most 60 configurations; None where none succeeds.

    >>> import rpim_opt as ro
    >>> from rpim_opt.calibration.lack_of_fit import foreseen
    >>> foreseen(ro.load("position").problem).alarming
    False
    """
    try:
        return judged(calibrate(sampled(problem, QUICK), tikhonov, reml))
    except (InputError, NoSolutionFound, np.linalg.LinAlgError):
        return None


def _overstated(result: Outcome) -> bool:
    try:
        return result.noise_test().overstated
    except InputError:  # no covariance
        return False


def _square(parts: Mapping[str, float]) -> float:
    """Return the variance of a row."""
    return sum(value**2 for value in parts.values())


# --- in words ---------------------------------------------------------------------------------------------------------


def _sentences(found: LackOfFit) -> list[str]:
    """Return the paragraph, sentence by sentence."""
    rms = f"Residual RMS {_size(found, found.left)}"
    if not found.instrument:
        count = max(round(found.spare), 0)
        degrees = "1 degree of freedom is" if count == 1 else f"{count} degrees of freedom are"
        return [f"{rms}; {degrees} too few to tell what it consists of. Measure more configurations."]
    lines = [f"{rms} ({_division(found)})."]
    lines += _present(found)
    lines += _missing(found)
    lines += _upward(found)
    lines += _likeness(found)
    lines += _repeated(found)
    return lines


def _size(found: LackOfFit, value: float) -> str:
    unit, si = UNITS[found.dimension]
    return f"{value / si:.3g} {unit}"


def _division(found: LackOfFit) -> str:
    """Say by what a new reading would differ from the model."""
    said = [f"measurement noise {_size(found, found.instrument)}"]
    if found.repeatable:
        said.append(f"missing effects {_size(found, found.repeatable)}")
    if found.robot > NEGLIGIBLE * found.instrument:
        said.append(f"repeatability {_size(found, found.robot)}")
        if found.joint > NEGLIGIBLE * found.robot:
            said[-1] += f", of it {_size(found, found.joint)} from the joints"
    return ", ".join(said)


def _present(found: LackOfFit) -> list[str]:
    lines = []
    for family, effect in found.present.items():
        size = ""
        if effect.rms is not None:
            size = f": {_size(found, effect.rms)} RMS beyond what geometry can imitate"
        lines.append(f"{DOES[family]}{size} (-2 ln L falls by {effect.gain:.0f}).")
    return lines


def _missing(found: LackOfFit) -> list[str]:
    if not found.missing:
        return []
    what = joined([WHAT[family] for family in found.missing])
    added = joined(found.parameters)
    return [
        f"{what[0].upper()}{what[1:]} would explain {found.share:.0%} of the mean square residual (-2 ln L falls by "
        f'{found.gain:.0f}): add {added} to `identify`, or model = "auto".'
    ]


def _upward(found: LackOfFit) -> list[str]:
    if not found.upward:
        return []
    named = joined([str(joint) for joint in found.upward])
    joints = f"Compliances of joints {named} are"
    if len(found.upward) == 1:
        joints = f"Compliance of joint {named} is"
    return [
        f"{joints} negative, which gravity cannot cause: check `mounting`, the payload, and whether the controller "
        "compensates sag; do not use such a fit outside the measured joint ranges."
    ]


def _likeness(found: LackOfFit) -> list[str]:
    if found.correlated and found.alike is not None:
        even = "Residuals"
        if found.missing:
            even = "Even then residuals"
        return [
            f"{even} of neighbouring configurations are correlated ({found.alike.correlation:.2f}, z = "
            f"{found.alike.z:.0f}): the model lacks an effect, which more readings will not average away.",
            *_reach(found),
        ]
    if found.robot > ROUGH * found.instrument:
        return _rough(found)
    if found.overstated:
        return ["Repeat one reading ten times, and state its standard deviation as the measurement noise."]
    if found.robot < FINE * found.instrument:
        return ["The instrument limits the result: only a more accurate one would show the robot's repeatability."]
    return []


def _rough(found: LackOfFit) -> list[str]:
    """Say what to do about a robot that is worse than its instrument, and whose errors show no order."""
    if found.robot > GROSS * found.instrument:
        return ["No robot repeats so badly: look for wrong units, signs, frames or rows first (`inspect`)."]
    limit = "The robot, not the instrument, limits the result"
    if found.repeated is not None and not found.excess:
        return [f"{limit}, by its repeatability, backlash or drift."]
    if found.repeated is not None:
        return [f"{limit}."]
    return [
        f"{limit}; the data do not separate repeatability from an effect that the model lacks. Repeat five "
        "configurations, approached from both sides, before a better instrument is bought."
    ]


def _reach(found: LackOfFit) -> list[str]:
    if not found.narrow:
        return []
    named = joined([str(joint) for joint in found.narrow])
    return [f"Joints {named} moved too little to identify gear eccentricity."]


def _repeated(found: LackOfFit) -> list[str]:
    if found.repeated is None:
        return []
    agree = f"Repeated readings of a configuration agree to {_size(found, found.repeated)} RMS"
    if not found.excess:
        return [f"{agree}: residuals are no larger."]
    return [
        f"{agree}; {_size(found, found.excess)} of the residuals repeat with the configuration, unless the robot stood "
        "still between them."
    ]
