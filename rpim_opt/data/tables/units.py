"""Units as headers of tables spell them, and those that are converted at the border."""

from __future__ import annotations

import re
from typing import NamedTuple

from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.units import UNITS, split_unit

SPELLED = {
    "°": "deg", "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad", "meter": "m", "metre": "m",
    "meters": "m", "metres": "m", "millimeter": "mm", "millimetre": "mm", "millimeters": "mm", "millimetres": "mm",
    "nm": "Nm", "n.m": "Nm", "n·m": "Nm", "µm": "um", "μm": "um", "micron": "um", "microns": "um", "inch": "in",
    "inches": "in", '"': "in", "centimeter": "cm", "centimetre": "cm",
    "°c": "degC", "celsius": "degC", "kelvin": "K",
}  # fmt: skip
"""Units as they are spelled in headers; their own names besides."""
UNIT_SIGNS = frozenset({
    *UNITS, "°", "grad", "degree", "degrees", "radian", "radians", "inch", "in", "cm", "gon", "µm", "μm", "nm", "n.m",
    "n·m", "-", "s", "1",
})  # fmt: skip
"""What stands in a line of units."""
LONGEST_NAME = 200
"""Characters that a column's name has: longer ones would take for ever to be matched."""
IN_A_NAME = (
    re.compile(r"(.+?)[\s_]*[\[(]\s*(\S+?)\s*[\])]"),
    re.compile(r"(.+?)\s*/\s*(\S+)"),
    re.compile(r"(.+?)\s+in\s+(\S+)"),
    re.compile(r"(.+?)[\s_]+(\S+)"),
)


class Foreign(NamedTuple):
    """A unit of ours, and how many of it a unit of others is."""

    unit: str
    size: float


FOREIGN = {"in": Foreign("mm", 25.4), "cm": Foreign("mm", 10.0), "gon": Foreign("deg", 0.9)}
"""Units that files of ours do not have: their numbers are converted."""


def _spelled(text: str) -> str:
    """Return the name of a unit, or nothing where a text is none."""
    names = (text, SPELLED.get(text.lower(), ""), text.lower())
    return next((name for name in names if name in UNITS or name in FOREIGN), "")


def dimension_of(unit: str) -> str:
    """Return the dimension of a unit."""
    return UNITS[FOREIGN[unit].unit if unit in FOREIGN else unit].dimension


def parse_units(text: str) -> dict[str, str]:
    """Return the units of ``"deg,mm"`` by dimension.

    >>> from rpim_opt.data.tables.units import parse_units
    >>> parse_units("rad, m")
    {'angle': 'rad', 'length': 'm'}
    """
    units: dict[str, str] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name = _spelled(part)
        if not name:
            raise InputError("--units", f"'{part}'", choices(part, [*UNITS, *FOREIGN]))
        dimension = dimension_of(name)
        if dimension in units:
            raise InputError("--units", f"{units[dimension]} and {part}", "one unit for each dimension")
        units[dimension] = name
    return units


def split(name: str) -> tuple[str, str]:
    """Return a column's name without its unit, and the unit, empty where there is none.

    >>> from rpim_opt.data.tables.units import split
    >>> [split(name) for name in ("x_mm", "U(95) X [mm]", "J1 (°)", "z / µm", "y in inch", "position[0]")]
    [('x', 'mm'), ('U(95) X', 'mm'), ('J1', 'deg'), ('z', 'um'), ('y', 'in'), ('position[0]', '')]
    """
    stem, unit = split_unit(name)
    if unit:
        return stem, name[len(stem) + 1 :]
    if len(name) <= LONGEST_NAME:
        for pattern in IN_A_NAME:
            match = pattern.fullmatch(name)
            if match and _spelled(match[2]):
                return match[1], _spelled(match[2])
    return stem, ""
