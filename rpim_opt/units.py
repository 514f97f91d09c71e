"""Units at the border: names carry them as a suffix (``d_mm``, ``q1_deg``), inside everything is SI."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from rpim_opt.exceptions import InputError, choices


class Unit(NamedTuple):
    """A unit's dimension and its size in SI."""

    dimension: str
    si: float


UNITS = {
    "m": Unit("length", 1.0),
    "mm": Unit("length", 1e-3),
    "um": Unit("length", 1e-6),
    "rad": Unit("angle", 1.0),
    "mrad": Unit("angle", 1e-3),
    "deg": Unit("angle", math.pi / 180),
    "Nm": Unit("torque", 1.0),
    "ppm": Unit("ratio", 1e-6),
    "rad_per_Nm": Unit("compliance", 1.0),
    "mrad_per_Nm": Unit("compliance", 1e-3),
}

DISPLAY = {
    "length": "mm",
    "angle": "deg",
    "torque": "Nm",
    "ratio": "ppm",
    "compliance": "mrad_per_Nm",
}
"""The unit in which a dimension is shown and written."""


def accepted_units(dimension: str) -> list[str]:
    """Return the suffixes that a quantity of this dimension may carry."""
    return [name for name, unit in UNITS.items() if unit.dimension == dimension]


def display(dimension: str) -> tuple[str, float]:
    """Return the unit for showing a dimension and its size in SI."""
    name = DISPLAY[dimension]
    return name, UNITS[name].si


def split_unit(name: str) -> tuple[str, Unit | None]:
    """Split ``"q1_deg"`` into ``"q1"`` and its unit; the unit is None where there is none.

    >>> split_unit("q1_deg")[0]
    'q1'
    >>> split_unit("base_rx_mrad")[1].dimension
    'angle'
    >>> split_unit("label")
    ('label', None)
    """
    for suffix in sorted(UNITS, key=len, reverse=True):
        if name.endswith("_" + suffix):
            return name.removesuffix("_" + suffix), UNITS[suffix]
    return name, None


def number(value: Any, where: str) -> float:
    """Return a finite number, or say what stands in its place."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise InputError(where, repr(value), "a finite number")
    return float(value)


def quantities(
    table: Mapping[str, Any], dimensions: Mapping[str, tuple[str, ...]], where: str
) -> dict[tuple[str, str], float]:
    """Read a table of quantities whose keys carry units.

    Parameters
    ----------
    table
        For instance ``{"x_mm": 1.0, "rx_deg": 90}``.
    dimensions
        The accepted stems with their dimensions, ``{"x": ("length",), "rx": ("angle",)}``.
    where
        What to call the table in an error.

    Returns
    -------
    SI values by (stem, dimension).

    Raises
    ------
    InputError
        For an unknown key, a missing or wrong unit, a value that is no finite number.
    """
    result = {}
    for key, value in table.items():
        stem, unit = split_unit(key)
        if stem not in dimensions:
            names = [f"{s}_{u}" for s, ds in dimensions.items() for d in ds for u in accepted_units(d)[:3]]
            raise InputError(where, f"unknown key '{key}'", choices(key, names))
        if unit is None or unit.dimension not in dimensions[stem]:
            names = [f"{stem}_{u}" for d in dimensions[stem] for u in accepted_units(d)]
            raise InputError(f"{where}, key {key}", "no unit that fits", ", ".join(names))
        if (stem, unit.dimension) in result:
            raise InputError(f"{where}, key {key}", "the same quantity twice", "one of them")
        result[stem, unit.dimension] = number(value, f"{where}, key {key}") * unit.si
    return result
