"""Tables of repeated approaches: which columns hold the pose, what was attained, and what was commanded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import numbers, read_columns, texts
from rpim_opt.basics.text import listed
from rpim_opt.basics.units import UNITS
from rpim_opt.data.tables.layout import read_raw
from rpim_opt.data.tables.names import recognize
from rpim_opt.data.tables.units import FOREIGN, dimension_of, parse_units, split
from rpim_opt.use.iso9283 import Performance, iso9283

PLACE = ("x", "y", "z")
TURNS = (("rx", "ry", "rz"), ("a", "b", "c"), ("w", "p", "r"))
"""What the three angles may be called; each is judged by itself, whichever axis it turns about."""
NAMES = ("configuration", "label")
"""What a column that names the pose may be, the better one first."""
QUANTITIES = {*PLACE, *(stem for group in TURNS for stem in group)}
ACCEPTED = "pose, x_mm, y_mm, z_mm; with a command command_x_mm, ...; with an orientation rx_deg, ry_deg, rz_deg"


class _Column(NamedTuple):
    """A column by what it holds: its name in the file and its unit's size in SI."""

    name: str
    si: float


_Parts = dict[str, _Column]


def read_approaches(source: Any, units: str = "") -> Performance:
    """Return pose accuracy and repeatability of a table of repeated approaches (`iso9283`).

    Parameters
    ----------
    source
        A text, Excel or Parquet file, or columns by name: ``pose``, attained ``x_mm, y_mm, z_mm``, commanded
        ``command_x_mm, ...`` (or Nominal X, Target X, ...), and angles ``rx_deg, ry_deg, rz_deg`` likewise.
    units
        Units of columns whose name carries none, ``"deg,mm"``.

    Raises
    ------
    InputError
        For columns that are missing or without unit, cells that are no numbers, and what `iso9283` refuses.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> columns = {"pose": ["P1", "P1"], "X [mm]": [1.0, 3.0], "Y [mm]": [0.0, 0.0], "Z [mm]": [0.0, 0.0]}
    >>> columns |= {f"Nominal {axis} [mm]": [0.0, 0.0] for axis in "XYZ"}
    >>> found = ro.use.read_approaches(columns)
    >>> round(1e3 * found.accuracy, 3), round(1e3 * found.repeatability, 3)
    (2.0, 1.0)
    """
    file = source if isinstance(source, str | Path) else None
    try:
        columns: Mapping[str, Sequence[Any]] = read_columns(source) if file is None else read_raw(Path(file)).columns
        return _performance(columns, parse_units(units))
    except InputError as error:
        raise error.within(file) from None


def _performance(columns: Mapping[str, Sequence[Any]], units: Mapping[str, str]) -> Performance:
    pose, attained, commanded = _recognised(columns, units)
    if not pose or not set(PLACE) <= set(attained):
        raise InputError("the header", listed(list(columns), 6), ACCEPTED)
    rows = [str(i + 1) for i in range(len(columns[pose]))]
    turns = next((group for group in TURNS if set(group) <= set(attained)), None)
    return iso9283(
        texts(columns[pose], pose),
        _values(columns, attained, PLACE, rows),
        _if_there(columns, commanded, PLACE, rows),
        _if_there(columns, attained, turns, rows),
        _if_there(columns, commanded, turns, rows),
        turns or TURNS[0],
    )


def _recognised(columns: Iterable[str], units: Mapping[str, str]) -> tuple[str, _Parts, _Parts]:
    """Return the column that names the pose, and those of what was attained and commanded by what they hold."""
    names: dict[str, str] = {}
    attained: _Parts = {}
    commanded: _Parts = {}
    of_kind = {"": attained, "measured": attained, "wanted": commanded}
    for name in columns:
        stem, unit = split(name)
        found = recognize(stem)
        into = of_kind.get(found.kind)
        if found.stem in NAMES:
            names.setdefault(found.stem, name)
        elif found.stem in QUANTITIES and into is not None:
            if found.stem in into:
                raise InputError("the header", f"'{into[found.stem].name}' and '{name}'", "one of them")
            into[found.stem] = _Column(name, _size(name, found.stem, unit, units))
    pose = next((names[stem] for stem in NAMES if stem in names), "")
    return pose, attained, commanded


def _size(name: str, stem: str, unit: str, units: Mapping[str, str]) -> float:
    dimension = "length" if stem in PLACE else "angle"
    unit = unit or units.get(dimension, "")
    if not unit or dimension_of(unit) != dimension:
        raise InputError("the header", f"column '{name}' without a unit of {dimension}", "x_mm, or --units deg,mm")
    if unit in FOREIGN:
        return FOREIGN[unit].size * UNITS[FOREIGN[unit].unit].si
    return UNITS[unit].si


def _if_there(
    columns: Mapping[str, Sequence[Any]], of: Mapping[str, _Column], stems: tuple[str, ...] | None, rows: list[str]
) -> Array | None:
    if stems is None or not set(stems) & set(of):
        return None
    missing = [stem for stem in stems if stem not in of]
    if missing:
        raise InputError("the header", f"no column for {listed(missing)}", f"all of {', '.join(stems)}, or none")
    return _values(columns, of, stems, rows)


def _values(
    columns: Mapping[str, Sequence[Any]], of: Mapping[str, _Column], stems: tuple[str, ...], rows: list[str]
) -> Array:
    return np.column_stack([of[stem].si * numbers(columns[of[stem].name], rows, of[stem].name) for stem in stems])
