"""``[constraints]`` of a problem file: what is known of parameters besides their scales, and places by name."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from pydantic import Field

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.files import Name, Table
from rpim_opt.basics.units import number, quantities
from rpim_opt.convex.constraints import Constraint, at_nominal, equal, parse, signed
from rpim_opt.convex.drawn import BOX, WORKSPACE
from rpim_opt.data.dataset import Dataset
from rpim_opt.robot.mdh import Robot

MEASURED = "measured"
"""The place that every problem has: the configurations of its identification data."""


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
        where = self._places(robot, data)
        return (*made, *(equal(*names) for names in self.equal), *(parse(text, where) for text in self.stated))

    def _places(self, robot: Robot, data: Dataset) -> dict[str, Any]:
        """Return the places by name, as `parse` takes them."""
        found: dict[str, Any] = {MEASURED: _rows(data, None)}
        for name, table in self.places.items():
            where = f"key constraints.places.{name}"
            if name in (MEASURED, WORKSPACE):
                raise InputError(where, "a place that every problem has", "another name")
            found[name] = _place(table, robot, data, where)
        return found


def _place(table: Mapping[str, Any], robot: Robot, data: Dataset, where: str) -> Any:
    """Return joint values (N, dof) [rad or m], or the sides of a box [m]."""
    if "rows" in table:
        if len(table) > 1:
            raise InputError(where, "rows and other keys", "rows alone")
        return _rows(data, table["rows"], where)
    joints = {f"q{i}": (dimension,) for i, dimension in enumerate(robot.joint_dimensions, start=1)}
    known: dict[str, tuple[str, ...]] = dict.fromkeys(BOX, ("length",))
    known |= joints
    if len(set(robot.joint_dimensions)) == 1:
        known["q"] = (robot.joint_dimensions[0],)
    values = {stem: value for (stem, _), value in quantities(table, known, where, _numbers).items()}
    if set(values) == set(BOX):
        return values
    if set(values) == {"q"}:
        return _joint_values([values["q"]], robot, where)
    if set(values) == set(joints):
        return _joint_values([[values[name] for name in joints]], robot, where)
    accepted = "x_mm, y_mm and z_mm of a box, all joints' q1_deg, ..., q_deg of all joints, or rows = [labels]"
    raise InputError(where, ", ".join(table) or "nothing", accepted)


def _numbers(value: Any, key: str, si: float) -> Any:
    """Return a number, or numbers in lists, in SI."""
    if isinstance(value, list):
        return [_numbers(each, key, si) for each in value]
    return number(value, key) * si


def _joint_values(values: Any, robot: Robot, where: str) -> Array:
    """Return joint values (N, dof), of which some or one were given."""
    try:
        q = np.array(values, dtype=float)
    except ValueError:
        raise InputError(where, "lists of different lengths", f"{robot.dof} joint values a configuration") from None
    q = q.reshape(-1, q.shape[-1])
    if q.shape[1] != robot.dof:
        raise InputError(where, f"{q.shape[1]} joint values", f"{robot.dof} a configuration")
    return q


def _rows(data: Dataset, labels: Any, where: str = "") -> Array:
    """Return the joint values (N, dof) of measured rows."""
    q: list[Array] = []
    known: list[str] = []
    for block in data.blocks:
        for row, at in zip(block.row, block.q, strict=True):
            known.append(data.label[row])
            if labels is None or data.label[row] in labels:
                q.append(at)
    missing = [label for label in labels or [] if label not in known]
    if missing or not q:
        found = f"'{missing[0]}'" if missing else "no row"
        raise InputError(f"{where}.rows", found, "labels of the identification data: " + choices(found, known))
    return np.unique(np.concatenate(q), axis=0)
