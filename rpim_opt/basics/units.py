"""Units and suffixed names: files and tables use names with units (``d_mm``, ``q1_deg``), the package uses SI."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

from rpim_opt.basics.exceptions import InputError, choices


class Unit(NamedTuple):
    """A unit: its dimension, its size in SI, and its zero point in SI."""

    dimension: str
    si: float
    zero: float = 0.0


DIMENSIONS = {
    "length": {"m": 1.0, "mm": 1e-3, "um": 1e-6, "cm": 1e-2, "in": 0.0254},
    "length2": {"m2": 1.0, "mm2": 1e-6, "um2": 1e-12},
    "angle": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180, "urad": 1e-6, "gon": math.pi / 200},
    "angle2": {"rad2": 1.0, "mrad2": 1e-6},
    "length angle": {"m_rad": 1.0, "mm_mrad": 1e-6},
    "torque": {"Nm": 1.0},
    "mass": {"kg": 1.0},
    "ratio": {"ppm": 1e-6},
    "compliance": {"rad_per_Nm": 1.0, "mrad_per_Nm": 1e-3, "urad_per_Nm": 1e-6},
    "temperature": {"K": 1.0, "degC": 1.0},
    "ratio per temperature": {"ppm_per_K": 1e-6},
    "length per temperature": {"m_per_K": 1.0, "mm_per_K": 1e-3, "um_per_K": 1e-6},
    "angle per temperature": {"rad_per_K": 1.0, "mrad_per_K": 1e-3, "urad_per_K": 1e-6},
    "pixel": {"px": 1.0},
    "pixel2": {"px2": 1.0},
    "length per force": {"m_per_N": 1.0, "mm_per_N": 1e-3, "um_per_N": 1e-6},
}
"""Sizes of units in SI by dimension."""
UNITS = {
    name: Unit(dimension, si, 273.15 if name == "degC" else 0.0)
    for dimension, units in DIMENSIONS.items()
    for name, si in units.items()
}

CELSIUS = "temperature_C"  # the common name of a temperature in degrees Celsius
LARGEST = 1e7
"""Largest measured or nominal value [m, rad, ...]: map coordinates in metres, a million turns. Beyond it a double has
no digits left for micrometres."""
SMALLEST = 1e-15
"""Standard deviations and scales [SI] that are not zero: below an atom's size, where squares still are numbers."""

DISPLAY = {
    "length": "mm", "angle": "deg", "torque": "Nm", "mass": "kg", "ratio": "ppm", "compliance": "mrad_per_Nm",
    "temperature": "K", "ratio per temperature": "ppm_per_K", "length per temperature": "um_per_K",
    "angle per temperature": "urad_per_K", "length per force": "um_per_N", "pixel": "px",
}  # fmt: skip
"""Unit in which a dimension is shown and written."""

WITH_UNIT = re.compile(rf"_({'|'.join(sorted(UNITS, key=len, reverse=True))})\Z")
LONGEST = 200  # longest pattern or name in characters: longer ones take too long to match


def accepted_units(dimension: str) -> tuple[str, ...]:
    """Return the unit suffixes of a dimension."""
    return tuple(DIMENSIONS.get(dimension, ()))


def display(dimension: str) -> tuple[str, float]:
    """Return the display unit of a dimension and its size in SI; no unit for the dimension ``""``."""
    name = DISPLAY[dimension] if dimension else ""
    return name, UNITS[name].si if name else 1.0


def printed(unit: str) -> str:
    """Return a unit as texts show it, ``mrad/(N m)`` for ``mrad_per_Nm`` of keys and columns."""
    return unit.replace("_per_Nm", "/(N m)").replace("_per_", "/")


def joint_columns(dimensions: Iterable[str]) -> dict[str, float]:
    """Return the columns for writing joint values, and the size of their units in SI."""
    units = (display(dimension) for dimension in dimensions)
    return {f"q{i}_{unit}": si for i, (unit, si) in enumerate(units, start=1)}


def split_unit(name: str) -> tuple[str, Unit | None]:
    """Split ``"q1_deg"`` into ``"q1"`` and its unit; the unit is None if there is none."""
    if name == CELSIUS:  # elsewhere a letter C is a name
        return "temperature", UNITS["degC"]
    match = WITH_UNIT.search(name)
    if match is None or name[: match.start()].endswith("_per"):  # a unit that is none of these
        return name, None
    return name[: match.start()], UNITS[match[1]]


def with_unit(stem: str, *dimensions: str, count: int = 9) -> list[str]:
    """Return the names of a quantity of one of these dimensions, ``d_m, d_mm, d_um``; plain where it has no unit."""
    units = [accepted_units(dimension)[:count] for dimension in dimensions]
    return [name for of in units for name in [f"{stem}_{unit}" for unit in of] or [stem]]


def number(value: Any, where: str) -> float:
    """Return a finite number; InputError for anything else."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        with suppress(OverflowError):  # an integer beyond all doubles
            if math.isfinite(value):
                return float(value)
    raise InputError(where, repr(value)[:60], "a finite number")


def numeral(text: str) -> float:
    """Return the finite number that an ASCII text states in Python's notation; NaN for ``1_000``, ``inf``, ..."""
    try:
        value = float(text)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) and text.isascii() and "_" not in text else math.nan


def quantities(
    table: Mapping[str, Any],
    dimensions: Mapping[str, tuple[str, ...]],
    where: str = "",
    lists: bool = False,
    also: Iterable[str] = (),
) -> dict[tuple[str, str], Any]:
    """Return the values [SI] of a table of quantities, ``{"x_mm": 1.0, "rx_deg": 90}``, by (stem, dimension).

    ``dimensions`` are those that stems may have, ``{"x": ("length",), "rx": ("angle",)}``; ``where`` is what errors
    call the table; with ``lists`` a value may be numbers in lists; ``also`` are further keys to list.
    """
    result: dict[tuple[str, str], Any] = {}
    for key, value in table.items():
        place = f"{where}, key {key}" if where else f"key {key}"
        stem, unit = split_unit(key)
        if stem not in dimensions:
            names = [name for each, of in dimensions.items() for name in with_unit(each, *of, count=3)]
            raise InputError(where or "the table", f"unknown key '{key}'", choices(key, [*also, *names]))
        unit = unit or Unit("", 1.0)
        if unit.dimension not in dimensions[stem]:
            raise InputError(place, "no unit of the right dimension", ", ".join(with_unit(stem, *dimensions[stem])))
        if (stem, unit.dimension) in result:
            raise InputError(place, f"{stem} twice, in two units", "one of them")
        result[stem, unit.dimension] = _in_si(value, place, unit, lists)
    return result


def _in_si(value: Any, where: str, unit: Unit, lists: bool) -> Any:
    """Return a number, or those in lists, in SI; refuse one too large for any robot or instrument."""
    if lists and isinstance(value, list):
        return [_in_si(each, where, unit, lists) for each in value]
    scaled = number(value, where) * unit.si
    if not abs(scaled) <= LARGEST:
        raise InputError(where, f"{scaled / unit.si:g}", f"a magnitude of at most {LARGEST / unit.si:g}")
    return scaled


def fits(name: str, pattern: str) -> bool:
    """Return whether a pattern (``d?``, ``theta[23]``, ``tool_*``) matches a name; an overlong one never does."""
    return len(pattern) <= LONGEST and fnmatchcase(name, pattern)


# --- units as headers of tables spell them ---------------------------------------------------------------------------

SPELLED = {
    "°": "deg", "º": "deg", "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad", "meter": "m",
    "metre": "m", "meters": "m", "metres": "m", "millimeter": "mm", "millimetre": "mm", "millimeters": "mm",
    "millimetres": "mm", "nm": "Nm", "n.m": "Nm", "n·m": "Nm", "µm": "um", "μm": "um", "micron": "um", "microns": "um",
    "inch": "in", "inches": "in", '"': "in", "centimeter": "cm", "centimetre": "cm", "°c": "degC", "celsius": "degC",
    "kelvin": "K", "Grad": "deg", "gradi": "deg", "grados": "deg", "graus": "deg", "degrés": "deg", "graden": "deg",
    "derece": "deg", "град": "deg", "рад": "rad", "度": "deg", "도": "deg", "мм": "mm", "毫米": "mm", "gons": "gon",
}  # fmt: skip
"""Units as they are spelled in headers; a small grad may be a gon."""
UNIT_SIGNS = frozenset(map(str.lower, [*UNITS, *SPELLED, "-", "s", "1"]))
"""Contents of a line of units, in lower case."""
IN_A_NAME = (
    re.compile(r"(.+?)[\s_]*[\[(]\s*(\S+?)\s*[\])]"),
    re.compile(r"(.+?)\s*/\s*(\S+)"),
    re.compile(r"(.+?)\s+in\s+(\S+)"),
    re.compile(r"(.+?),?[\s_]+([^\s_,]+)"),
    re.compile(r"(.*[\dxyzXYZ])(mm|deg|rad)"),
)


def _spelled(text: str) -> str:
    """Return the name of a unit, or nothing where a text is none."""
    names = (text, SPELLED.get(text) or SPELLED.get(text.lower(), ""), text.lower() if len(text) > 1 else "")
    return next((name for name in names if name in UNITS), "")


def parse_units(text: str) -> dict[str, str]:
    """Return the units of ``"deg,mm"`` by dimension, and those of ``"q=rad"`` by column name."""
    units: dict[str, str] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        stem, _, sign = (each.strip() for each in part.rpartition("="))
        name = _spelled(sign)
        if not name:
            raise InputError("--units", f"'{part}'", choices(part, UNITS))
        key = stem or UNITS[name].dimension
        if key in units:
            accepted = "one unit per dimension; another for joint values only as q=rad"
            raise InputError("--units", f"{units[key]} and {part}", accepted)
        units[key] = name
    return units


def split(name: str) -> tuple[str, str]:
    """Split a column name into the name without its unit and the unit, which may be empty.

    >>> from rpim_opt.basics.units import split
    >>> [split(name) for name in ("x_mm", "U(95) X [mm]", "J1 (°)", "z / µm", "y in inch", "T [C]", "position[0]")]
    [('x', 'mm'), ('U(95) X', 'mm'), ('J1', 'deg'), ('z', 'um'), ('y', 'in'), ('T', 'degC'), ('position[0]', '')]
    """
    name = name.replace("[C]", "[degC]")
    stem, unit = split_unit(name)
    if unit:
        return stem, "degC" if name == CELSIUS else name[len(stem) + 1 :]
    if len(name) <= LONGEST:
        for pattern in IN_A_NAME:
            match = pattern.fullmatch(name)
            if match and _spelled(match[2]):
                return match[1], _spelled(match[2])
    return stem, ""
