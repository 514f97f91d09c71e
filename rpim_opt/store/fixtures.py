"""Where a file places what measurements refer to: anchors, planes, spheres."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.units import quantities
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.models import of_fixture

Fixtures = dict[str, dict[str, str]]
"""Dimension of every coordinate, by fixture: what one table may state."""


def place_fixtures(placed: Mapping[str, Any], data: Dataset) -> dict[str, float]:
    """Return the stated values [SI] of the measurements' own parameters: ``[anchor] x_mm``, ``[anchor.A] x_mm``."""
    used = _used(data)
    own: dict[str, float] = {}
    for table, content in placed.items():
        if table not in used:
            raise InputError(f"table {table}", "a place for no measurement here", choices(table, used))
        for fixture, coordinates in used[table].items():
            own |= _placed(table, fixture, content, coordinates)
        unknown = [key for key, value in content.items() if isinstance(value, dict) and key not in used[table]]
        if unknown:
            raise InputError(f"table {table}", f"'{unknown[0]}'", choices(unknown[0], used[table]))
    return own


def _used(data: Dataset) -> dict[str, Fixtures]:
    """Return what the data's measurements refer to, by table."""
    used: dict[str, Fixtures] = {}
    for block in data.blocks:
        for name, dimension in block.measurement.parameters.items():
            table, _, coordinate = name.partition("_")
            used.setdefault(table, {}).setdefault(block.fixture, {})[coordinate] = dimension
    return used


def _placed(table: str, fixture: str, content: Mapping[str, Any], coordinates: Mapping[str, str]) -> dict[str, float]:
    part: Any = content
    where = f"table {table}"
    if fixture:
        part = content.get(fixture)
        where = f"table {table}.{fixture}"
    if part is None:
        return {}
    if not isinstance(part, dict):
        raise InputError(where, repr(part)[:60], "a table")
    given = quantities(part, {name: (dimension,) for name, dimension in coordinates.items()}, where)
    return {of_fixture(f"{table}_{name}", fixture): value for (name, _), value in given.items()}
