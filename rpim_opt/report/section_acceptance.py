"""The report's verdict: whether the robot keeps what is demanded of it, and what that rests on."""

from __future__ import annotations

import numpy as np

from rpim_opt.basics.text import percent
from rpim_opt.basics.units import joint_columns
from rpim_opt.calibration.acceptance import Acceptance
from rpim_opt.calibration.result import Calibration
from rpim_opt.report.frame import facts, section
from rpim_opt.report.markup import Element, tag

WORDS = {"accepted": "Accepted", "rejected": "Rejected", "undecided": "Cannot be decided"}


def verdict(found: Acceptance | None) -> list[Element]:
    """Return the verdict in a line for the top of the page; nothing where nothing is demanded."""
    if found is None:
        return []
    text = f"the limit is {1e3 * found.requirement.limit:g} mm"
    if found.bound is not None and np.isfinite(found.bound):
        text = f"the robot may be off by up to {1e3 * found.bound:.3f} mm, {text}"
    sure = percent(found.requirement.confidence)
    text = f": {text}, with {sure} at every configuration of the region below."
    return [tag("p", tag("strong", WORDS[found.verdict]), text, class_=f"verdict {found.verdict}")]


def acceptance_section(result: Calibration, found: Acceptance | None) -> list[Element]:
    """Return what the verdict rests on."""
    if found is None:
        return []
    requirement = found.requirement
    said = [
        ("Limit", f"{1e3 * requirement.limit:g} mm, with {percent(requirement.confidence)}"),
        ("Region", requirement.where),
        *_bounds(result, found),
    ]
    if found.checked is not None:
        said.append(("Checked by", found.checked.sentence()))
    note = (
        "Held against the limit is how far the robot may end from the position that the calibrated model predicts: "
        "the uncertainty of its parameters and its own scatter, without the instrument's. It is computed at every one "
        "of the configurations, not in the mean, and rows that were kept apart check it."
    )
    return section("Acceptance", tag("p", note), facts(said), *_reasons(found))


def _reasons(found: Acceptance) -> list[Element]:
    if not found.reasons:
        return []
    return [tag("ul", *(tag("li", *_coded(reason)) for reason in found.reasons), class_="notes")]


def _coded(text: str) -> list[Element | str]:
    """Return a text with what stands between backticks as code."""
    parts: list[Element | str] = []
    for number, part in enumerate(text.split("`")):
        parts.append(tag("code", part) if number % 2 else part)
    return parts


def _bounds(result: Calibration, found: Acceptance) -> list[tuple[str, str]]:
    if found.bound is None or found.typical is None or not np.isfinite(found.bound):
        return []
    said = [
        ("Largest bound", f"{1e3 * found.bound:.3f} mm{_at(result, found)}"),
        ("In the middle", f"{1e3 * found.typical:.3f} mm: half of {found.count} configurations have a smaller bound"),
    ]
    if found.scatter is not None:
        scatter = f"{1e3 * found.scatter:.3f} mm of the largest bound would be left if all parameters were known"
        said.append(("The robot's own", scatter))
    return said


def _at(result: Calibration, found: Acceptance) -> str:
    if found.worst is None:
        return ""
    units = joint_columns(result.problem.robot.joint_dimensions)
    values = [f"{value / si:.1f}" for value, si in zip(found.worst, units.values(), strict=True)]
    kinds = sorted({name.rpartition("_")[2] for name in units})
    return f", at joints {', '.join(values)} {' and '.join(kinds)}"
