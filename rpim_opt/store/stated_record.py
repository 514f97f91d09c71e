"""``[record]`` and ``[acceptance]`` of a problem file: who measured how, and what the robot is accepted by."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import date, datetime
from typing import Any

from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.units import number, quantities
from rpim_opt.data.requirement import CONFIDENCE, Requirement, Side
from rpim_opt.robot.mdh import Robot

FIELDS = {
    "by": "Measured by",
    "when": "Measured",
    "where": "Place",
    "instrument": "Instrument",
    "instrument_serial": "Instrument, serial",
    "certificate": "Certificate",
    "robot_serial": "Robot, serial",
    "controller": "Controller",
    "temperature": "Temperature",
    "load": "Load",
    "order": "Order",
    "notes": "Notes",
}
"""Keys of ``[record]``, and what a report calls them."""
LONGEST = 1000
"""Characters of a text that somebody may want to read."""
BOX = ("x", "y", "z")


def stated_details(table: Mapping[str, Any]) -> dict[str, str]:
    """Return what ``[record]`` states, in the order of `FIELDS`.

    Raises
    ------
    InputError
        For another key, and values that are no text, number or date.
    """
    for key in table:
        if key not in FIELDS:
            raise InputError(f"key record.{key}", "a key that is not known", choices(key, FIELDS))
    return {key: _text(table[key], f"key record.{key}") for key in FIELDS if key in table}


def _text(value: Any, where: str) -> str:
    if isinstance(value, bool) or not isinstance(value, str | int | float | date | datetime):
        raise InputError(where, repr(value)[:60], "a text, a number or a date")
    text = str(value).strip()
    if not 0 < len(text) <= LONGEST:
        raise InputError(where, f"{len(text)} characters", f"1 to {LONGEST}")
    return text


def stated_requirement(table: Mapping[str, Any], robot: Robot) -> Requirement | None:
    """Return what ``[acceptance]`` requires; None for an empty table.

    ::

        limit_mm = 0.1                  the robot reaches positions within this, with
        confidence = 0.95               at every configuration whose nominal reflector is
        x_mm = [300.0, 800.0]           in this box of the robot's base frame (with y_mm and z_mm), and
        q1_deg = [-90.0, 90.0]          whose joints are within these, the others within the measured ranges
        marker = "smr1"

    Raises
    ------
    InputError
        For other keys, sides that are no two numbers, a limit that nothing can keep.
    """
    if not table:
        return None
    plain = {key: table[key] for key in ("confidence", "marker") if key in table}
    values = _quantities({key: value for key, value in table.items() if key not in plain}, robot, plain)
    limit = values.pop("limit", None)
    if not isinstance(limit, float):
        raise InputError("table acceptance", "no limit", "limit_mm = 0.1")
    sides = {stem: _side(value, stem) for stem, value in values.items()}
    marker = plain.get("marker", "")
    if not isinstance(marker, str):
        raise InputError("key acceptance.marker", repr(marker)[:60], "the name of a reflector")
    return Requirement(
        limit=limit,
        box=_box(sides),
        joints=tuple((int(stem[1:]), side) for stem, side in sides.items() if stem not in BOX),
        marker=marker,
        confidence=number(plain.get("confidence", CONFIDENCE), "key acceptance.confidence"),
    )


def _quantities(table: Mapping[str, Any], robot: Robot, also: Iterable[str]) -> dict[str, Any]:
    """Return the limit, the sides of a box and of joints by stem [SI]."""
    known = dict.fromkeys(("limit", *BOX), ("length",))
    known |= {f"q{i}": (dimension,) for i, dimension in enumerate(robot.joint_dimensions, start=1)}
    found = quantities(table, known, "table acceptance", _numbers, also)
    return {stem: value for (stem, _), value in found.items()}


def _numbers(value: Any, key: str, si: float) -> Any:
    if isinstance(value, list):
        return [number(each, key) * si for each in value]
    return number(value, key) * si


def _side(value: Any, stem: str) -> Side:
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(f"key acceptance.{stem}", "not two numbers", "[low, high]")
    return value[0], value[1]


def _box(sides: Mapping[str, Side]) -> tuple[Side, Side, Side] | None:
    found = [axis for axis in BOX if axis in sides]
    if not found:
        return None
    if len(found) < len(BOX):
        raise InputError("table acceptance", f"{', '.join(found)} alone", "x_mm, y_mm and z_mm of a box, or none")
    return sides["x"], sides["y"], sides["z"]
