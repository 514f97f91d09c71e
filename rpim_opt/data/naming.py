"""Tables as people have them: other names of columns, and units that are given once for all of them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.layouts import Head
from rpim_opt.basics.tables import Columns, numbers
from rpim_opt.data.columns import number_columns, text_columns
from rpim_opt.data.dialects import DERIVED, MEASURED, NAMES, TURNS, UR_JOINTS, WANTED, Reading, dialect
from rpim_opt.data.models import Measurement
from rpim_opt.data.orientations import numbered
from rpim_opt.data.spelling import FOREIGN, parse_units, split
from rpim_opt.robot.mdh import Robot

__all__ = ["Reading", "Renamed", "parse_units", "rename"]
AMBIGUOUS = ("rx", "ry", "rz")
"""Without a unit these may also be a rotation vector, as Universal Robots' are."""
ANOTHER_POINT = re.compile(r"(?:p|pos|position|meas|measured)?_?[xyz]_?[2-9]")
TOUCHED = ("point", "plane")
"""Names of columns that say what a row touched."""
NOT_MEASURED = "what was wanted is no measurement"
VALUE = frozenset({"position", "pos", "angle", "value"})
"""What may stand behind the name of a joint for its value."""


class Renamed(NamedTuple):
    """A table with the names of this package, what they were where they differ, and columns that were left out.

    ``why`` says it of every new name and its unit, ``left_why`` of what was left out.
    """

    columns: Columns
    was: Mapping[str, str]
    left_out: tuple[str, ...]
    why: Mapping[str, tuple[str, str]] = {}
    left_why: Mapping[str, str] = {}


def rename(
    table: Columns,
    robot: Robot,
    kind: Measurement,
    units: Mapping[str, str],
    joints: Sequence[str] = (),
    heads: Mapping[str, Head] | None = None,
    quaternion: str = "wxyz",
) -> Renamed:
    """Return a table with columns named as `read_data` takes them; cells change where their unit is none of ours.

    Names that it takes already stay. Others are recognised where they can mean one thing only: ``joint_1``,
    ``J1 [deg]``, names of joints in a URDF, joints counted from 0, ``x1``, ``measured_x (mm)``, ``quat_w``, ``roll``
    and what `dialects` lists. What is recognised in no way is left out.

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
    heads
        What stands above the columns, taken apart, where it is more than a name.
    quaternion
        In which order quaternions stand whose components are numbered, ``"wxyz"`` or ``"xyzw"``.

    Raises
    ------
    InputError
        For columns without a unit that no one gave, two columns that mean the same, several points in a row.
    """
    numeric = number_columns(robot, kind)
    plain = text_columns(kind)
    read = {name: _read(name, (heads or {}).get(name), [*numeric, *plain], joints) for name in table}
    read = numbered(_turns(read), table, robot.dof, quaternion)
    read = _from_one(_by_name(read, table, joints, robot.dof), robot.dof)
    if "temperature" not in units and "temperature" not in robot.model.columns:
        read = {name: _in_degrees(found) for name, found in read.items()}
    read, left_why = _one_of_each(read)
    ours = {name: found for name, found in read.items() if _is_ours(name, found.stem, numeric, plain)}
    new, why = _with_units(ours, numeric, units)
    columns = {new[name]: _converted(table[name], ours[name], units, new[name]) for name in ours}
    was = {new[name]: name for name in ours if new[name] != name}
    left_out = tuple(name for name in table if name not in ours)
    reasons = {name: left_why.get(name) or read[name].why or "no column of these measurements" for name in left_out}
    return Renamed(columns, was, left_out, {new[name]: (ours[name].why, why[name]) for name in ours}, reasons)


def _read(name: str, head: Head | None, known: Sequence[str], joints: Sequence[str]) -> Reading:
    """Return what a column holds; its name as stem where that is not known."""
    text = name.partition(" #")[0]
    stem, unit = split(text)
    if head is not None:
        stem = f"{split(head.group)[0]} {split(head.name)[0]}".strip()
        unit = _unit_of(head)
    for whole in (text, stem):
        if whole in joints:
            return Reading(f"q{joints.index(whole) + 1}", unit, "a joint of the robot's file")
    if stem in known:
        return Reading(stem, unit, "named so")
    if stem.lower() in TOUCHED and stem.lower() in known:  # elsewhere such a column holds labels
        return Reading(stem.lower(), unit, "what was touched")
    found = recognised(stem, joints)
    if head is not None and head.group and not found.why and not found.kind:
        bare = split(head.name)[0]
        found = Reading(bare, "", "named so") if bare in known else recognised(bare, joints)
    return found._replace(unit=unit)


def _in_degrees(found: Reading) -> Reading:
    """Return a reading that is no temperature where its unit is not there: nobody has to say it."""
    if found.stem == "temperature" and not found.unit:
        return Reading("", "", "a temperature whose unit is not there")
    return found


def _unit_of(head: Head) -> str:
    """Return the unit of a column from the line of units, else of its group."""
    for text in (f"x [{head.unit}]", head.name, head.group):
        unit = split(text)[1]
        if unit:
            return unit
    return ""


def recognised(stem: str, joints: Sequence[str]) -> Reading:
    """Return what a name means, with why; without where it is not known."""
    path = [part for part in re.split(r"[/.]", stem.strip().strip("%")) if part]
    plain = re.sub(r"[\s.\-/:\[\]()]+", "_", re.sub(r"\(95\s*%?\)", "95", stem.strip().lower())).strip("_% ")
    words = plain.split("_")
    kind = _kind(words)
    kept = [word for word in words if word not in MEASURED | WANTED | DERIVED]
    rest = "_".join(kept or words)
    joint = _joint_in(path, joints)
    if joint and path[-1] in VALUE | {"effort"}:
        number, why = joint
        return Reading(f"tau{number}" if path[-1] == "effort" else f"q{number}", "", why, kind)
    for each in NAMES:
        match = re.fullmatch(each.pattern, rest)
        if match:
            meaning = re.sub(r"(?<=[qu])0+(?=\d)", "", match.expand(each.meaning))
            return Reading(meaning, "", each.why, kind)
    # u(x) is a standard uncertainty, U(x) an expanded one whose coverage factor nobody knows
    match = re.fullmatch(r"u[\s_(]*([xyzXYZ])\)?", stem.strip())
    if match:
        return Reading(f"sigma_{match[1].lower()}", "", "u: standard uncertainty", kind)
    return Reading(plain, "", "", kind)


def _kind(words: Sequence[str]) -> str:
    for name, signs in (("derived", DERIVED), ("wanted", WANTED), ("measured", MEASURED)):
        if len(words) > 1 and signs & set(words):
            return name
    return ""


def _joint_in(path: Sequence[str], joints: Sequence[str]) -> tuple[int, str] | None:
    """Return the number of the joint that a path names, and whose name it is."""
    for part in path[:-1]:
        if part in joints:
            return joints.index(part) + 1, "a joint of the robot's file"
        if part.removesuffix("_joint") in UR_JOINTS:
            return UR_JOINTS.index(part.removesuffix("_joint")) + 1, "a joint of Universal Robots"
    return None


def _turns(read: dict[str, Reading]) -> dict[str, Reading]:
    """Return readings in which letters are angles where all three of them stand beside x, y, z."""
    stems = {found.stem for found in read.values()}
    for letters, meaning, why in TURNS:
        if {"x", "y", "z", *letters} <= stems:
            new = dict(zip(letters, meaning, strict=True))
            for name, found in read.items():
                if found.stem in new:
                    read = {**read, name: found._replace(stem=new[found.stem], why=why)}
    return read


def _by_name(read: dict[str, Reading], table: Columns, joints: Sequence[str], dof: int) -> dict[str, Reading]:
    """Return readings with ROS' joints in the robot's order, where columns name0, ... name them."""
    named = {}
    for name, found in read.items():
        match = re.fullmatch(r"(?:field_)?name_?(\d{1,9})", found.stem)
        if match:
            named[int(match[1])] = name
    if not named or f"q{min(named)}" not in {found.stem for found in read.values()}:
        return read
    places = {f"q{i}": _place(table[column], column, joints, dof) for i, column in named.items()}
    ordered = {}
    for name, found in read.items():
        number = places.get(found.stem, -1)
        if number > 0:
            found = found._replace(stem=f"q{number}", why="the joint that its column of names names")
        elif number == 0:
            found = found._replace(stem=f"another {found.stem}")
        ordered[name] = found
    return ordered


def _place(cells: Sequence[Any], column: str, joints: Sequence[str], dof: int) -> int:
    """Return the number of the joint that all cells name, 0 for one that the robot does not have."""
    names = {str(cell) for cell in cells}
    if len(names) > 1:
        raise InputError("the header", f"column '{column}' with {len(names)} names", "one joint a column")
    name = names.pop()
    if name in joints:
        return joints.index(name) + 1
    if not joints and dof == len(UR_JOINTS) and name.removesuffix("_joint") in UR_JOINTS:
        return UR_JOINTS.index(name.removesuffix("_joint")) + 1
    if joints:
        return 0
    raise InputError(
        "the header", f"joint '{name}' in column '{column}'", "a robot from a URDF, which names its joints"
    )


def _from_one(read: dict[str, Reading], dof: int) -> dict[str, Reading]:
    """Return readings with the joints counted from 1, where they are counted from 0."""
    if all(found.stem != "q0" for found in read.values()):
        return read
    count = {f"{stem}{i}": f"{stem}{i + 1}" for i in range(dof) for stem in ("q", "tau")}
    shifted = {}
    for name, found in read.items():
        if found.stem in count:
            found = found._replace(stem=count[found.stem], why=f"{found.why}, counted from 0")
        shifted[name] = found
    return shifted


def _one_of_each(read: dict[str, Reading]) -> tuple[dict[str, Reading], dict[str, str]]:
    """Return readings without what was computed, and without what was wanted where it was measured, and why."""
    kept: dict[str, Reading] = {}
    why: dict[str, str] = {}
    for name, found in read.items():
        others = [other for key, other in read.items() if key != name and other.stem == found.stem]
        better = any(other.kind in ("", "measured") for other in others)
        if found.kind == "derived":
            why[name] = "computed from others"
        elif found.kind == "wanted" and (better or not re.fullmatch(r"(?:to_)?q\d+|label", found.stem)):
            why[name] = NOT_MEASURED
        elif found.kind == "wanted" and found.stem != "label":
            kept[name] = found._replace(why=f"{found.why}; commanded, as no measured value is there")
        else:
            kept[name] = found
    return kept, why


def _with_units(
    read: Mapping[str, Reading], numeric: Mapping[str, Sequence[str]], units: Mapping[str, str]
) -> tuple[dict[str, str], dict[str, str]]:
    """Return the columns' names with their units, the given ones where a name carries none, and why."""
    named: dict[str, str] = {}
    why: dict[str, str] = {}
    unitless: dict[str, list[str]] = {}
    for name, found in read.items():
        dimensions = [dimension for dimension in numeric.get(found.stem, []) if dimension]
        unit, how = _unit(name, found, dimensions, units)
        named[name] = found.stem
        why[name] = how
        if unit in FOREIGN:
            why[name] = f"{how}; {unit} is {FOREIGN[unit].size:g} {FOREIGN[unit].unit}"
            unit = FOREIGN[unit].unit
        if unit:
            named[name] = f"{found.stem}_{unit}"
        elif dimensions:
            unitless.setdefault(dimensions[0], []).append(name)
    _require_once(named)
    _require_units(unitless)
    return named, why


def _unit(name: str, found: Reading, dimensions: Sequence[str], units: Mapping[str, str]) -> tuple[str, str]:
    """Return a column's unit and why: its own, that of its dialect, the given one."""
    if found.unit:
        return found.unit, "in the header"
    if len(dimensions) != 1:  # a sigma may be of lengths or of angles: no unit of one dimension is meant
        return "", ""
    if dimensions[0] in units:
        return units[dimensions[0]], "--units"
    if dimensions[0] == "pixel":
        return "px", "the only unit"
    of = dialect(name)
    if of is not None and dimensions[0] in ("angle", "length"):
        return getattr(of, dimensions[0]), of.why
    return "", ""


def _converted(cells: Sequence[Any], found: Reading, units: Mapping[str, str], name: str) -> Sequence[Any]:
    """Return cells in a unit of ours."""
    unit = found.unit
    if not unit:
        unit = next((u for u in units.values() if u in FOREIGN and name.endswith(f"_{FOREIGN[u].unit}")), "")
    if unit not in FOREIGN:
        return cells
    rows = [str(i) for i in range(1, len(cells) + 1)]
    return [repr(float(value)) for value in FOREIGN[unit].size * numbers(cells, rows, name)]


def _require_once(named: Mapping[str, str]) -> None:
    """Refuse two columns that mean the same."""
    first: dict[str, str] = {}
    for name, new in named.items():
        if new in first:
            raise InputError("the header", f"columns '{first[new]}' and '{name}' for {new}", "one of them")
        first[new] = name


def _is_ours(name: str, stem: str, numeric: Mapping[str, Sequence[str]], plain: Sequence[str]) -> bool:
    """Return whether a column is one that we read; refuse what may mean two things."""
    if ANOTHER_POINT.fullmatch(stem):
        raise InputError("the header", f"column '{name}', another point", "a row each, with a column marker")
    if name.lower() in AMBIGUOUS and stem in numeric:
        accepted = (
            "roll, pitch, yaw; rx_deg, ry_deg, rz_deg, the same; a quaternion; --rotation vector; "
            "or --measurement position"
        )
        raise InputError("the header", f"column '{name}', of angles or of a rotation vector", accepted)
    return stem in numeric or stem in plain


def _require_units(unitless: Mapping[str, Sequence[str]]) -> None:
    if not unitless:
        return
    examples = {"angle": "deg", "length": "mm", "torque": "Nm", "mass": "kg"}
    missing = ",".join(examples.get(dimension, dimension) for dimension in unitless)
    named = ", ".join(name for names in unitless.values() for name in names)
    accepted = f"--units with theirs, such as {missing}, or names that carry one, such as q1_deg and x_mm"
    raise InputError("the header", f"columns without a unit ({named})", accepted)
