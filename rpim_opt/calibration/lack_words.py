"""What a calibration leaves, in words: one paragraph of measured facts, what they point to, and what to do."""

from __future__ import annotations

from rpim_opt.basics.text import joined
from rpim_opt.calibration.lack_numbers import LeftOver

ROUGH, FINE = 2.0, 0.3
"""Robot's scatter over the instrument's noise above which the robot is the limit, and below which the instrument is."""
GROSS = 300.0
"""Scatter over the instrument's noise above which data are wrong."""
NEGLIGIBLE = 0.1
"""Parts below this share of a larger one are not worth a word."""
LOW = 0.7
"""What is left over the instrument's noise, below which that is declared too large."""
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


def sentences(found: LeftOver) -> list[str]:
    """Return the paragraph, sentence by sentence."""
    left = f"Left: {_size(found, found.left)} RMS"
    if not found.instrument:
        count = max(round(found.spare), 0)
        are = f"{count} equations are"
        if count == 1:
            are = "1 equation is"
        return [f"{left}; {are} left over, too few to tell what it is. Measure more configurations."]
    lines = [f"{left}; {_division(found)}."]
    lines += _present(found)
    lines += _missing(found)
    lines += _upward(found)
    lines += _likeness(found)
    lines += _repeated(found)
    return lines


def _size(found: LeftOver, value: float) -> str:
    unit, si = UNITS[found.dimension]
    return f"{value / si:.3g} {unit}"


def _division(found: LeftOver) -> str:
    """Say what a new reading would differ by from the model: the instrument, what repeats, and the robot's scatter."""
    said = [f"{_size(found, found.instrument)} by the instrument"]
    if found.repeatable:
        said.append(f"{_size(found, found.repeatable)} by effects that the model lacks")
    if found.robot > NEGLIGIBLE * found.instrument:
        scatter = f"{_size(found, found.robot)} by the robot's scatter"
        if found.joint > NEGLIGIBLE * found.robot:
            scatter += f" ({_size(found, found.joint)} from its joints)"
        said.append(scatter)
    return f"a new reading would differ from the model by {joined(said)}"


def _present(found: LeftOver) -> list[str]:
    lines = []
    for family, effect in found.present.items():
        size = ""
        if effect.rms is not None:
            size = f": {_size(found, effect.rms)} RMS that no geometry can imitate"
        lines.append(f"{DOES[family]}{size} (-2 ln L falls by {effect.gain:.0f}).")
    return lines


def _missing(found: LeftOver) -> list[str]:
    if not found.missing:
        return []
    what = joined([WHAT[family] for family in found.missing])
    added = joined(found.parameters)
    return [
        f"{what[0].upper()}{what[1:]} would explain {found.share:.0%} of the mean square of what is left (-2 ln L "
        f'falls by {found.gain:.0f}): add {added} to `identify`, or model = "auto".'
    ]


def _upward(found: LeftOver) -> list[str]:
    if not found.upward:
        return []
    named = joined([str(joint) for joint in found.upward])
    joints = f"Joints {named} seem to bend upwards"
    if len(found.upward) == 1:
        joints = f"Joint {named} seems to bend upwards"
    return [
        f"{joints}, which gravity cannot do: check `mounting`, the payload, and whether the controller compensates "
        "sag; do not use such a fit outside the measured joint ranges."
    ]


def _likeness(found: LeftOver) -> list[str]:
    if found.correlated and found.alike is not None:
        even = "Similar"
        if found.missing:
            even = "Even then similar"
        return [
            f"{even} configurations err alike (correlation {found.alike.correlation:.2f}, z = {found.alike.z:.0f}): "
            "the model lacks an effect, which more readings will not average away.",
            *_reach(found),
        ]
    if found.robot > ROUGH * found.instrument:
        return _rough(found)
    if found.left * found.room < LOW * found.instrument:
        return ["What is left is far below the declared noise: repeat one reading ten times, and state what it shows."]
    if found.robot < FINE * found.instrument:
        return ["The robot is as good as this instrument can tell: only a better one would show more."]
    return []


def _rough(found: LeftOver) -> list[str]:
    """Say what to do about a robot that is worse than its instrument, and whose errors show no order."""
    if found.robot > GROSS * found.instrument:
        return ["So much is no robot's scatter: look for wrong units, signs, frames or rows first (`inspect`)."]
    limit = "The robot, not the instrument, is the limit"
    if found.repeated is not None and not found.excess:
        return [f"{limit}, and it does not repeat better: this is repeatability, backlash or drift."]
    if found.repeated is not None:
        return [f"{limit}."]
    return [
        f"{limit}; the data do not tell its repeatability from an effect that the model lacks. Repeat five "
        "configurations, approached from both sides, before a better instrument is bought."
    ]


def _reach(found: LeftOver) -> list[str]:
    if not found.narrow:
        return []
    named = joined([str(joint) for joint in found.narrow])
    return [f"More reach would help to find it: of joints {named} too little was seen for their gears to be told."]


def _repeated(found: LeftOver) -> list[str]:
    if found.repeated is None:
        return []
    agree = f"Repeated readings of a configuration agree to {_size(found, found.repeated)}"
    if not found.excess:
        return [f"{agree}: what is left is no larger."]
    return [
        f"{agree}, and {_size(found, found.excess)} beyond that comes again with the configuration, unless the robot "
        "stood still between them."
    ]
