"""What a problem file knows of touched points and planes: ``[[known_distance]]`` and ``[[known_angle]]``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import Angle, Length, Name, Table, validate
from rpim_opt.basics.units import accepted_units
from rpim_opt.data.contact import Known, KnownAngle, KnownDistance, with_known
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.store.problem_file import ProblemTable

UNSTATED = 1e-5
"""Standard deviation [m or rad] of what only validates, where none is stated: of a good machine tool."""
RIGHT = (0.0, 90.0)
"""Angles [deg] that two planes may be known to have."""


class KnownTable(Table):
    """What all such tables have; one that validates identifies nothing."""

    between: list[Name]
    validation: bool = False


class DistanceTable(KnownTable):
    """One distance; ``mm = 50`` is short for ``distance_mm = 50``."""

    distance: Length
    sigma: Length = 0.0


class AngleTable(KnownTable):
    """One angle, 0 or 90 degrees."""

    deg: float
    sigma: Angle = 0.0


def with_stated(data: Dataset, table: ProblemTable, role: str, path: Path) -> Dataset:
    """Return the measurements of a role with what a file knows of the points and planes that they touch.

    Raises
    ------
    InputError
        For a table that is incomplete, a name that no row touches, and what was touched too few times.
    """
    try:
        whole = with_known(data, [*_distances(table, role, path), *_angles(table, role, path)])
        _require_enough(whole)
    except InputError as error:
        raise error.within(path) from None
    return whole


def _distances(table: ProblemTable, role: str, path: Path) -> Iterator[Known]:
    units = accepted_units("length")
    for number, content in enumerate(table.known_distance, start=1):
        where = f"key known_distance {number}"
        spelled = {f"distance_{key}" if key in units else key: value for key, value in content.items()}
        found = _checked(DistanceTable, spelled, where, path)
        if found.validation == (role == "validation"):
            sigma = _sigma(found, float(found.sigma), f"{where}.sigma_mm", path)
            yield KnownDistance(_pair(found, where, path), float(found.distance), sigma)


def _angles(table: ProblemTable, role: str, path: Path) -> Iterator[Known]:
    for number, content in enumerate(table.known_angle, start=1):
        where = f"key known_angle {number}"
        found = _checked(AngleTable, content, where, path)
        if found.deg not in RIGHT:
            raise InputError(f"{where}.deg", f"{found.deg:g}", "0 (parallel) or 90 (square)", path)
        if found.validation == (role == "validation"):
            sigma = _sigma(found, float(found.sigma), f"{where}.sigma_mrad", path)
            yield KnownAngle(_pair(found, where, path), found.deg == 0, sigma)


def _checked(kind: Any, content: dict[str, Any], where: str, path: Path) -> Any:
    try:
        return validate(kind, content, path)
    except InputError as error:
        inside = error.where.replace("key ", f"{where}.").replace(".the top level", "")
        raise InputError(inside, error.found, error.accepted, path) from None


def _pair(table: KnownTable, where: str, path: Path) -> tuple[str, str]:
    if len(table.between) != 2:
        raise InputError(f"{where}.between", f"{len(table.between)} names", "two", path)
    first, second = table.between
    return first, second


def _sigma(table: KnownTable, stated: float, where: str, path: Path) -> float:
    if "sigma" in table.model_fields_set:
        return stated
    if not table.validation:
        raise InputError(where, "nothing", "the standard deviation of what the drawing states", path)
    return UNSTATED


def _require_enough(data: Dataset) -> None:
    """Refuse what was touched so few times that its touches say nothing."""
    count: dict[str, int] = {}
    of: dict[str, tuple[Block, str]] = {}
    joined: set[str] = set()
    for block in data.blocks:
        if block.touched is None:
            continue
        for i, names in zip(block.row, block.touched, strict=True):
            if not block.measurement.touching:
                joined |= set(names)
                continue
            count[names[0]] = count.get(names[0], 0) + 1
            of[names[0]] = (block, data.label[i])
    for name, touches in count.items():
        block, label = of[name]
        least = 2
        if block.measurement.planar:
            least = 4
        if touches < least - (name in joined):
            column = "point"
            if block.measurement.planar:
                column = "plane"
            accepted = f"{least} or more, one less where a [[known_distance]] or [[known_angle]] joins it to another"
            raise InputError(f"row {label}, column {column}", f"'{name}' touched {touches} times", accepted)
