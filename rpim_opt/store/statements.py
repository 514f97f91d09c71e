"""What a problem file states besides data: ``[constraints]``, ``[record]``, ``[acceptance]``, places of fixtures."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import date, datetime
from functools import partial
from typing import Any

import numpy as np
from pydantic import Field

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.schema import Name, Table
from rpim_opt.basics.units import number, quantities
from rpim_opt.convex.constraints import BOX, WORKSPACE, Constraint, at_nominal, equal, parse, signed
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.measurement import of_fixture
from rpim_opt.data.record import CONFIDENCE, Requirement, Side
from rpim_opt.robot.mdh import Robot

MEASURED = "measured"
"""The place that every problem has: the configurations of its identification data."""
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
LONGEST_TEXT = 1000
"""Characters of a text that somebody may want to read."""


def _joints(robot: Robot) -> dict[str, tuple[str, ...]]:
    return {f"q{i}": (dimension,) for i, dimension in enumerate(robot.joint_dimensions, start=1)}


def _numbers(value: Any, key: str, si: float) -> Any:
    """Return a number, or numbers in lists, in SI."""
    if isinstance(value, list):
        return [_numbers(each, key, si) for each in value]
    return number(value, key) * si


# --- [constraints] -----------------------------------------------------------------------------------------------


class Constraints(Table):
    """The keys of ``[constraints]``."""

    at_nominal: list[Name] = Field(default_factory=list)
    positive: list[Name] = Field(default_factory=list)
    negative: list[Name] = Field(default_factory=list)
    equal: list[list[Name]] = Field(default_factory=list)
    stated: list[str] = Field(default_factory=list)
    places: dict[Name, dict[str, Any]] = Field(default_factory=dict)

    def all(self, robot: Robot, data: Dataset) -> tuple[Constraint, ...]:
        """Return them as functions of a formulation of a problem with this robot and identification data."""
        boxes = (
            (self.at_nominal, at_nominal),
            (self.positive, partial(signed, 1)),
            (self.negative, partial(signed, -1)),
        )
        made = [make(*patterns) for patterns, make in boxes if patterns]
        places: dict[str, Any] = {MEASURED: _rows(data, None)}
        for name, table in self.places.items():
            where = f"key constraints.places.{name}"
            if name in (MEASURED, WORKSPACE):
                raise InputError(where, "a place that every problem has", "another name")
            places[name] = _place(table, robot, data, where)
        return (*made, *(equal(*names) for names in self.equal), *(parse(text, places) for text in self.stated))


def _place(table: Mapping[str, Any], robot: Robot, data: Dataset, where: str) -> Any:
    """Return joint values (N, dof) [rad or m], or the sides of a box [m]."""
    if "rows" in table:
        if len(table) > 1:
            raise InputError(where, "rows and other keys", "rows alone")
        return _rows(data, table["rows"], where)
    joints = _joints(robot)
    known = dict.fromkeys(BOX, ("length",)) | joints
    if len(set(robot.joint_dimensions)) == 1:
        known["q"] = (robot.joint_dimensions[0],)
    values = {stem: value for (stem, _), value in quantities(table, known, where, _numbers).items()}
    if set(values) == set(BOX):
        return values
    if set(values) not in ({"q"}, set(joints)):
        accepted = "x_mm, y_mm and z_mm of a box, all joints' q1_deg, ..., q_deg of all joints, or rows = [labels]"
        raise InputError(where, ", ".join(table) or "nothing", accepted)
    stated = values["q"] if "q" in values else [values[name] for name in joints]
    try:
        q = np.array(stated, dtype=float)
    except ValueError:
        raise InputError(where, "lists of different lengths", f"{robot.dof} joint values a configuration") from None
    q = q.reshape(-1, q.shape[-1] if q.ndim else 1)
    if q.shape[1] != robot.dof:
        raise InputError(where, f"{q.shape[1]} joint values", f"{robot.dof} a configuration")
    return q


def _rows(data: Dataset, labels: Any, where: str = "") -> Array:
    """Return the joint values (N, dof) of measured rows."""
    known = [data.label[row] for block in data.blocks for row in block.row]
    points = [q for block in data.blocks for q in block.q]
    chosen = [q for label, q in zip(known, points, strict=True) if labels is None or label in labels]
    missing = [label for label in labels or [] if label not in known]
    if missing or not chosen:
        found = f"'{missing[0]}'" if missing else "no row"
        raise InputError(f"{where}.rows", found, "labels of the identification data: " + choices(found, known))
    return np.unique(np.concatenate(chosen), axis=0)


# --- [record] and [acceptance] -----------------------------------------------------------------------------------


def stated_details(table: Mapping[str, Any]) -> dict[str, str]:
    """Return what ``[record]`` states, in the order of `FIELDS`."""
    for key, value in table.items():
        if key not in FIELDS:
            raise InputError(f"key record.{key}", "a key that is not known", choices(key, FIELDS))
        if isinstance(value, bool) or not isinstance(value, str | int | float | date | datetime):
            raise InputError(f"key record.{key}", repr(value)[:60], "a text, a number or a date")
        length = len(str(value).strip())
        if not 0 < length <= LONGEST_TEXT:
            raise InputError(f"key record.{key}", f"{length} characters", f"1 to {LONGEST_TEXT}")
    return {key: str(table[key]).strip() for key in FIELDS if key in table}


def stated_requirement(table: Mapping[str, Any], robot: Robot) -> Requirement | None:
    """Return what ``[acceptance]`` requires; None for an empty table.

    ::

        limit_mm = 0.1                  the robot reaches positions within this, with
        confidence = 0.95               at every configuration whose nominal reflector is
        x_mm = [300.0, 800.0]           in this box of the robot's base frame (with y_mm and z_mm), and
        q1_deg = [-90.0, 90.0]          whose joints are within these, the others within the measured ranges
        marker = "smr1"
    """
    if not table:
        return None
    plain = {key: table[key] for key in ("confidence", "marker") if key in table}
    known = dict.fromkeys(("limit", *BOX), ("length",)) | _joints(robot)
    rest = {key: value for key, value in table.items() if key not in plain}
    values = {stem: value for (stem, _), value in quantities(rest, known, "table acceptance", _numbers, plain).items()}
    limit = values.pop("limit", None)
    if not isinstance(limit, float):
        raise InputError("table acceptance", "no limit", "limit_mm = 0.1")
    sides: dict[str, Side] = {}
    for stem, value in values.items():
        if not isinstance(value, list) or len(value) != 2 or not all(isinstance(each, float) for each in value):
            raise InputError(f"key acceptance.{stem}", "not two numbers", "[low, high]")
        sides[stem] = value[0], value[1]
    marker = plain.get("marker", "")
    if not isinstance(marker, str):
        raise InputError("key acceptance.marker", repr(marker)[:60], "the name of a reflector")
    axes = [axis for axis in BOX if axis in sides]
    if axes and len(axes) < len(BOX):
        raise InputError("table acceptance", f"{', '.join(axes)} alone", "x_mm, y_mm and z_mm of a box, or none")
    return Requirement(
        limit=limit,
        box=(sides["x"], sides["y"], sides["z"]) if axes else None,
        joints=tuple((int(stem[1:]), side) for stem, side in sides.items() if stem not in BOX),
        marker=marker,
        confidence=number(plain.get("confidence", CONFIDENCE), "key acceptance.confidence"),
    )


# --- places of anchors, planes, spheres --------------------------------------------------------------------------


def place_fixtures(placed: Mapping[str, Any], data: Dataset) -> dict[str, float]:
    """Return the stated values [SI] of the measurements' own parameters: ``[anchor] x_mm``, ``[anchor.A] x_mm``."""
    used: dict[str, dict[str, dict[str, str]]] = {}  # dimension by table, fixture and coordinate
    for block in data.blocks:
        for name, dimension in block.measurement.parameters.items():
            table, _, coordinate = name.partition("_")
            used.setdefault(table, {}).setdefault(block.fixture, {})[coordinate] = dimension
    own: dict[str, float] = {}
    for table, content in placed.items():
        if table not in used:
            raise InputError(f"table {table}", "a place for no measurement here", choices(table, used))
        for fixture, coordinates in used[table].items():
            part: Any = content
            where = f"table {table}"
            if fixture:
                part = content.get(fixture, {})
                where = f"table {table}.{fixture}"
            if not isinstance(part, dict):
                raise InputError(where, repr(part)[:60], "a table")
            values = quantities(part, {name: (dimension,) for name, dimension in coordinates.items()}, where)
            own |= {of_fixture(f"{table}_{name}", fixture): value for (name, _), value in values.items()}
        unknown = [key for key, value in content.items() if isinstance(value, dict) and key not in used[table]]
        if unknown:
            raise InputError(f"table {table}", f"'{unknown[0]}'", choices(unknown[0], used[table]))
    return own
