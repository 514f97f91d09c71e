"""Tables as people have them: other names of columns, and units that are given once for all of them."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import Columns, numbers
from rpim_opt.basics.units import split_unit
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.tables.columns import number_columns, text_columns
from rpim_opt.data.tables.layout import Head
from rpim_opt.data.tables.names import TURNS, UR_JOINTS, Reading, dialect, recognize, ur_joint
from rpim_opt.data.tables.orientations import numbered
from rpim_opt.data.tables.units import FOREIGN, split
from rpim_opt.robot.mdh import Robot

AMBIGUOUS = ("rx", "ry", "rz")
"""Without a unit these may also be a rotation vector, as Universal Robots' are."""
ANOTHER_POINT = re.compile(r"(?:p|pos|position|meas|measured)?_?[xyz]_?[2-9]")
Readings = dict[str, Reading]
"""What every column holds, by its name."""
NAMES = {"label": "label of the row", "configuration": "configuration", "marker": "reflector", "fixture": "fixture",
         "session": "session of the measurements", "to_marker": "reflector of the second point",
         "point": "point that was touched or seen", "rx": "measured roll", "ry": "measured pitch",
         "rz": "measured yaw"}  # fmt: skip
NUMBERED = {r"q(\d+)": "joint {}", r"tau(\d+)": "torque of joint {}", r"q([wxyz])": "quaternion {}",
            r"r(\d)(\d)": "rotation matrix {},{}"}  # fmt: skip
SPREAD = {"u95": "U95", "sigma": "standard deviation", "cov": "covariance"}


class Meant(NamedTuple):
    """A column: its name in the file, what it means, our name, the unit, and why."""

    column: str
    meaning: str
    name: str
    unit: str
    why: str


class Renamed(NamedTuple):
    """A table with the names of this package, and what every column of the file means."""

    columns: Columns
    meant: tuple[Meant, ...]

    @property
    def left_out(self) -> tuple[str, ...]:
        """Columns that mean nothing here."""
        return tuple(each.column for each in self.meant if not each.name)


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

    Names that it takes already stay. Others are recognized where they can mean one thing only: ``joint_1``,
    ``J1 [deg]``, names of joints in a URDF, joints counted from 0, ``x1``, ``measured_x (mm)``, ``quat_w``, ``roll``
    and what `names` lists. What is recognized in no way is left out.

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
    read = {name: _read(name, (heads or {}).get(name), [*numeric, *plain], kind.names, joints) for name in table}
    read = numbered(_angles(read), table, robot.dof, quaternion)
    read = _from_one(_by_name(read, table, joints, robot.dof), robot.dof)
    if "temperature" not in units and "temperature" not in robot.model.columns:
        read = {name: _in_degrees(each) for name, each in read.items()}
    read, left_why = _one_of_each(read)
    ours = {name: each for name, each in read.items() if _is_ours(name, each.stem, numeric, plain)}
    new, why = _with_units(ours, numeric, units)
    meant = []
    for name in table:
        if name not in ours:
            reason = left_why.get(name) or read[name].why or "no column of these measurements"
            meant.append(Meant(name, "left out", "", "", reason))
            continue
        stem, unit = split_unit(new[name])
        reason = f"{ours[name].why}; unit {why[name]}" if why[name] else ours[name].why
        shown = new[name].removeprefix(f"{stem}_") if unit else ""
        meant.append(Meant(name, kind.words.columns.get(stem) or meaning(stem), new[name], shown, reason))
    return Renamed({new[name]: _converted(table[name], each, units, new[name]) for name, each in ours.items()},
                   tuple(meant))  # fmt: skip


def meaning(stem: str) -> str:
    """Return what a column of ours is, in words.

    >>> from rpim_opt.data.tables.naming import meaning
    >>> [meaning(stem) for stem in ("q2", "x", "u95_z", "qw", "r12", "to_q1")]
    ['joint 2', 'measured x', 'U95 of z', 'quaternion w', 'rotation matrix 1,2', 'second point: joint 1']
    """
    if stem in NAMES:
        return NAMES[stem]
    if stem.startswith("to_"):
        return f"second point: {meaning(stem.removeprefix('to_'))}"
    for prefix, word in SPREAD.items():
        if stem.startswith(prefix):
            return f"{word} of {stem.removeprefix(prefix).strip('_').replace('_', ', ') or 'all axes'}"
    for pattern, words in NUMBERED.items():
        match = re.fullmatch(pattern, stem)
        if match:
            return words.format(*match.groups())
    return f"measured {stem}"


# --- what every column holds ---------------------------------------------------------------------------------------


def _read(name: str, head: Head | None, known: Sequence[str], names: Sequence[str], joints: Sequence[str]) -> Reading:
    """Return what a column holds; its name as stem where that is not known."""
    text = name.partition(" #")[0]
    stem, unit = split(text)
    if head is not None:
        stem = f"{split(head.group)[0]} {split(head.name)[0]}".strip()
        unit = next(filter(None, (split(part)[1] for part in (f"x [{head.unit}]", head.name, head.group))), "")
    for whole in (text, stem):
        if whole in joints:
            return Reading(f"q{joints.index(whole) + 1}", unit, "a joint of the robot's file")
    if stem in known:
        return Reading(stem, unit, "named so")
    if stem.lower() in names:  # elsewhere such a column holds labels
        return Reading(stem.lower(), unit, "what was touched")
    found = recognize(stem, joints)
    if head is not None and head.group and not found.why and not found.kind:
        bare = split(head.name)[0]
        found = Reading(bare, "", "named so") if bare in known else recognize(bare, joints)
    return found._replace(unit=unit)


def _in_degrees(found: Reading) -> Reading:
    """Return a reading that is no temperature where its unit is not there: nobody has to say it."""
    if found.stem == "temperature" and not found.unit:
        return Reading("", "", "a temperature whose unit is not there")
    return found


def _angles(read: Readings) -> Readings:
    """Return readings in which letters are angles where all three of them stand beside x, y, z."""
    for letters, meaning, why in TURNS:
        if {"x", "y", "z", *letters} <= {found.stem for found in read.values()}:
            new = dict(zip(letters, meaning, strict=True))
            turned = {name: found._replace(stem=new[found.stem], why=why)
                      for name, found in read.items() if found.stem in new}  # fmt: skip
            read = {**read, **turned}
    return read


def _by_name(read: Readings, table: Columns, joints: Sequence[str], dof: int) -> Readings:
    """Return readings with ROS' joints in the robot's order, where columns name0, ... name them."""
    matches = {name: re.fullmatch(r"(?:field_)?name_?(\d{1,9})", found.stem) for name, found in read.items()}
    named = {int(match[1]): name for name, match in matches.items() if match}
    if not named or f"q{min(named)}" not in {found.stem for found in read.values()}:
        return read
    places = {f"q{i}": _joint_named(table[column], column, joints, dof) for i, column in named.items()}
    ordered = dict(read)
    for name, found in read.items():
        number = places.get(found.stem)
        if number:
            ordered[name] = found._replace(stem=f"q{number}", why="the joint that its column of names names")
        elif number == 0:
            ordered[name] = found._replace(stem=f"another {found.stem}")
    return ordered


def _joint_named(cells: Sequence[Any], column: str, joints: Sequence[str], dof: int) -> int:
    """Return the number of the joint that all cells name, 0 for one that the robot does not have."""
    names = {str(cell) for cell in cells}
    if len(names) > 1:
        raise InputError("the header", f"column '{column}' with {len(names)} names", "one joint a column")
    name = names.pop()
    if joints:
        return joints.index(name) + 1 if name in joints else 0
    number = ur_joint(name)
    if number and dof == len(UR_JOINTS):
        return number
    raise InputError(
        "the header", f"joint '{name}' in column '{column}'", "a robot from a URDF, which names its joints"
    )


def _from_one(read: Readings, dof: int) -> Readings:
    """Return readings with the joints counted from 1, where they are counted from 0."""
    if all(found.stem != "q0" for found in read.values()):
        return read
    count = {f"{stem}{i}": f"{stem}{i + 1}" for i in range(dof) for stem in ("q", "tau")}
    shifted = {name: found._replace(stem=count[found.stem], why=f"{found.why}, counted from 0")
               for name, found in read.items() if found.stem in count}  # fmt: skip
    return {**read, **shifted}


def _one_of_each(read: Readings) -> tuple[Readings, dict[str, str]]:
    """Return readings without what was computed, and without what was wanted where it was measured, and why."""
    kept: Readings = {}
    why: dict[str, str] = {}
    measured = {each.stem for each in read.values() if each.kind in ("", "measured")}
    for name, found in read.items():
        if found.kind == "derived":
            why[name] = "computed from others"
        elif found.kind != "wanted" or (found.stem == "label" and "label" not in measured):
            kept[name] = found
        elif found.stem not in measured and re.fullmatch(r"(?:to_)?q\d+", found.stem):
            kept[name] = found._replace(why=f"{found.why}; commanded, as no measured value is there")
        else:
            why[name] = "what was wanted is no measurement"
    return kept, why


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


# --- units ---------------------------------------------------------------------------------------------------------


def _with_units(
    read: Readings, numeric: Mapping[str, Sequence[str]], units: Mapping[str, str]
) -> tuple[dict[str, str], dict[str, str]]:
    """Return the columns' names with their units, the given ones where a name carries none, and why."""
    named: dict[str, str] = {}
    why: dict[str, str] = {}
    first: dict[str, str] = {}
    unitless: dict[str, list[str]] = {}
    for name, found in read.items():
        dimensions = [dimension for dimension in numeric.get(found.stem, []) if dimension]
        unit, why[name] = _unit(name, found, dimensions, units)
        if unit in FOREIGN:
            why[name] += f"; {unit} is {FOREIGN[unit].size:g} {FOREIGN[unit].unit}"
            unit = FOREIGN[unit].unit
        named[name] = f"{found.stem}_{unit}" if unit else found.stem
        if not unit and dimensions:
            unitless.setdefault(dimensions[0], []).append(name)
        other = first.setdefault(named[name], name)
        if other != name:
            raise InputError("the header", f"columns '{other}' and '{name}' for {named[name]}", "one of them")
    if unitless:
        examples = {"angle": "deg", "length": "mm", "torque": "Nm", "mass": "kg"}
        missing = ",".join(examples.get(dimension, dimension) for dimension in unitless)
        lacking = ", ".join(name for names in unitless.values() for name in names)
        accepted = f"--units with theirs, such as {missing}, or names that carry one, such as q1_deg and x_mm"
        raise InputError("the header", f"columns without a unit ({lacking})", accepted)
    return named, why


def _unit(name: str, found: Reading, dimensions: Sequence[str], units: Mapping[str, str]) -> tuple[str, str]:
    """Return a column's unit and why: its own, that of its dialect, the given one."""
    if found.unit:
        return found.unit, "in the header"
    if len(dimensions) != 1:  # a sigma may be of lengths or of angles: no unit of one dimension is meant
        return "", ""
    (dimension,) = dimensions
    if dimension in units:
        return units[dimension], "--units"
    if dimension == "pixel":
        return "px", "the only unit"
    of = dialect(name)
    if of is not None and dimension in ("angle", "length"):
        return getattr(of, dimension), of.why
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
