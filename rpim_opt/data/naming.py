"""Tables as people have them: other names of columns, and units that are given once for all of them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.tables import Columns
from rpim_opt.basics.units import UNITS, split_unit
from rpim_opt.data.columns import number_columns, text_columns
from rpim_opt.data.models import Measurement
from rpim_opt.robot.mdh import Robot

SPELLED = {
    "°": "deg", "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad", "meter": "m", "metre": "m",
    "meters": "m", "metres": "m", "millimeter": "mm", "millimetre": "mm", "millimeters": "mm", "millimetres": "mm",
    "nm": "Nm",
}  # fmt: skip
"""Units as they are spelled in headers; their own names besides."""
ALIASES = (
    (r"(to_)?(?:q|j|joint|axis|a|theta)_?(\d+)(?:_?(?:pos|position|angle|value))?", r"\1q\2"),
    (r"(to_)?(?:tau|torque|effort)_?(\d+)", r"\1tau\2"),
    (r"(?:p|pos|position|meas|measured)?_?([xyz])(?:_?1)?(?:_(?:meas|measured))?", r"\1"),
    (r"(?:q|quat|quaternion|orientation)_?([wxyz])", r"q\1"),
    (r"roll", "rx"),
    (r"pitch", "ry"),
    (r"yaw", "rz"),
    (r"distance|dist|cable|cable_length", "distance"),
    (r"label|name|id|no|nr|number|index|point|point_id|row", "label"),
    (r"configuration|config|pose|pose_id", "configuration"),
    (r"marker|reflector|smr", "marker"),
)  # fmt: skip
"""What else a column may be called, in lower case: unambiguous names alone."""
AMBIGUOUS = ("rx", "ry", "rz")
"""Without a unit these may also be a rotation vector, as Universal Robots' are."""
ANOTHER_POINT = re.compile(r"(?:p|pos|position|meas|measured)?_?[xyz]_?[2-9]")


class Renamed(NamedTuple):
    """A table with the names of this package, what they were where they differ, and columns that were left out."""

    columns: Columns
    was: Mapping[str, str]
    left_out: tuple[str, ...]


def parse_units(text: str) -> dict[str, str]:
    """Return the units of ``"deg,mm"`` by dimension.

    >>> from rpim_opt.data.naming import parse_units
    >>> parse_units("rad, m")
    {'angle': 'rad', 'length': 'm'}
    """
    units: dict[str, str] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name = SPELLED.get(part.lower(), part)
        if name not in UNITS:
            raise InputError("--units", f"'{part}'", choices(part, UNITS))
        if UNITS[name].dimension in units:
            raise InputError("--units", f"{units[UNITS[name].dimension]} and {part}", "one unit for each dimension")
        units[UNITS[name].dimension] = name
    return units


def rename(
    table: Columns, robot: Robot, kind: Measurement, units: Mapping[str, str], joints: Sequence[str] = ()
) -> Renamed:
    """Return a table with columns named as `read_data` takes them; no cell is changed.

    Names that it takes already stay. Others are recognised where they can mean one thing only: ``joint_1``,
    ``J1 [deg]``, names of joints in a URDF, joints counted from 0, ``x1``, ``measured_x (mm)``, ``quat_w``, ``roll``.
    What is recognised in no way is left out.

    Parameters
    ----------
    table
        The columns.
    robot, kind
        Decide which columns there may be.
    units
        The unit of columns whose name carries none, by dimension (`parse_units`).
    joints
        What the robot's file calls its joints.

    Raises
    ------
    InputError
        For columns without a unit that no one gave, two columns that mean the same, several points in a row.
    """
    numeric = number_columns(robot, kind)
    plain = text_columns(kind)
    read = {name: _read(name, [*numeric, *plain], joints) for name in table}
    read = _from_one(read, robot.dof)
    ours = {name: found for name, found in read.items() if _is_ours(name, found[0], numeric, plain)}
    new = _with_units(ours, numeric, units)
    columns = {new[name]: table[name] for name in ours}
    was = {new[name]: name for name in ours if new[name] != name}
    left_out = tuple(name for name in table if name not in ours)
    return Renamed(columns, was, left_out)


def _with_units(
    read: Mapping[str, tuple[str, str]], numeric: Mapping[str, Sequence[str]], units: Mapping[str, str]
) -> dict[str, str]:
    """Return the columns' names with their units, the given ones where a name carries none."""
    named: dict[str, str] = {}
    unitless: dict[str, list[str]] = {}
    for name, (stem, own) in read.items():
        dimensions = [dimension for dimension in numeric.get(stem, []) if dimension]
        unit = own or _given(units, dimensions)
        named[name] = stem
        if unit:
            named[name] = f"{stem}_{unit}"
        elif dimensions:
            unitless.setdefault(dimensions[0], []).append(name)
    _require_once(named)
    _require_units(unitless)
    return named


def _require_once(named: Mapping[str, str]) -> None:
    """Refuse two columns that mean the same."""
    first: dict[str, str] = {}
    for name, new in named.items():
        if new in first:
            raise InputError("the header", f"columns '{first[new]}' and '{name}' for {new}", "one of them")
        first[new] = name


def _from_one(read: dict[str, tuple[str, str]], dof: int) -> dict[str, tuple[str, str]]:
    """Return stems and units with the joints counted from 1, where they are counted from 0."""
    if all(stem != "q0" for stem, _ in read.values()):
        return read
    count = {f"q{i}": f"q{i + 1}" for i in range(dof)}
    return {name: (count.get(stem, stem), unit) for name, (stem, unit) in read.items()}


def _given(units: Mapping[str, str], dimensions: Sequence[str]) -> str:
    """Return the unit that was given for columns of one dimension."""
    # a sigma may be of lengths or of angles: no unit of one dimension is meant
    if len(dimensions) != 1:
        return ""
    return units.get(dimensions[0], "")


def _is_ours(name: str, stem: str, numeric: Mapping[str, Sequence[str]], plain: Sequence[str]) -> bool:
    """Return whether a column is one that we read; refuse what may mean two things."""
    if ANOTHER_POINT.fullmatch(stem):
        raise InputError("the header", f"column '{name}', another point", "a row each, with a column marker")
    if name in AMBIGUOUS and stem in numeric:
        accepted = "roll, pitch, yaw; rx_deg, ry_deg, rz_deg, the same; a quaternion; or --measurement position"
        raise InputError("the header", f"column '{name}', of angles or of a rotation vector", accepted)
    return stem in numeric or stem in plain


def _require_units(unitless: Mapping[str, Sequence[str]]) -> None:
    if not unitless:
        return
    examples = {"angle": "deg", "length": "mm", "torque": "Nm"}
    missing = ",".join(examples.get(dimension, dimension) for dimension in unitless)
    named = ", ".join(name for names in unitless.values() for name in names)
    accepted = f"--units with theirs, such as {missing}, or names that carry one, such as q1_deg and x_mm"
    raise InputError("the header", f"columns without a unit ({named})", accepted)


def _read(name: str, known: Sequence[str], joints: Sequence[str]) -> tuple[str, str]:
    """Return what a column holds and its unit; empty where the name has none."""
    if name in joints:
        return f"q{joints.index(name) + 1}", ""
    stem, spelled = _split(name)
    if stem in joints:
        return f"q{joints.index(stem) + 1}", spelled
    if stem in known:
        return stem, spelled
    plain = re.sub(r"[\s.\-]+", "_", stem.strip().lower())
    for pattern, meaning in ALIASES:
        match = re.fullmatch(pattern, plain)
        if match:
            return re.sub(r"(?<=[qu])0+(?=\d)", "", match.expand(meaning)), spelled
    return plain, spelled


def _split(name: str) -> tuple[str, str]:
    """Return a column's name without its unit, and the unit: ``x_mm``, ``x [mm]``, ``x (mm)``, ``x mm``."""
    stem, unit = split_unit(name)
    if unit:
        return stem, name[len(stem) + 1 :]
    for pattern in (r"(.+?)[\s_]*[\[(]\s*(\S+?)\s*[\])]", r"(.+?)[\s_]+(\S+)"):
        match = re.fullmatch(pattern, name)
        if match:
            spelled = SPELLED.get(match[2].lower(), match[2])
            if spelled in UNITS:
                return match[1], spelled
            return stem, ""
    return stem, ""
