"""What a raw table says: every column with its meaning, its unit, and why; the table with our names."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.layout import Head, RawTable, TableOptions, is_missing, missing_rows
from rpim_opt.basics.tables import Columns, numbers
from rpim_opt.basics.text import listed
from rpim_opt.basics.units import FOREIGN, UNITS, dimension_of, split, split_unit
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.tables.columns import number_columns, text_columns
from rpim_opt.data.tables.formats.registry import read_raw
from rpim_opt.data.tables.names import MOTOMAN, TURNS, UR_JOINTS, Reading, dialect, endings, recognize, ur_joint
from rpim_opt.data.tables.orientations import numbered, quaternion_columns, quaternions, require_rotation
from rpim_opt.robot.mdh import Robot

TURNED = ("rx", "ry", "rz")
"""Columns of three turns; without a unit they may also be a rotation vector, as Universal Robots' are."""
ANOTHER_POINT = re.compile(r"(?:p|pos|position|meas|measured)?_?[xyz]_?[2-9]")
Readings = dict[str, Reading]
"""What every column holds, by its name."""
NAMES = {"label": "label of the row", "configuration": "configuration", "marker": "reflector", "fixture": "fixture",
         "session": "session of the measurements", "to_marker": "reflector of the second point",
         "point": "point that was touched or seen", "rx": "measured roll (extrinsic xyz)",
         "ry": "measured pitch (extrinsic xyz)", "rz": "measured yaw (extrinsic xyz)"}  # fmt: skip
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


@dataclass(frozen=True, eq=False)
class Understood:
    """A raw table with our names.

    Parameters
    ----------
    file
        Its name.
    columns
        Cells by our names.
    raw
        The columns as the file has them, of the same rows.
    meant
        What every column means.
    notes
        How the file was read and what was left out, a sentence each.
    doubt
        The option that tells how orientations are to be read where only a check against the robot does:
        ``quaternion`` or ``rotation``.
    """

    file: str
    columns: Columns
    raw: Columns
    meant: tuple[Meant, ...]
    notes: tuple[str, ...]
    doubt: str = ""

    @property
    def stems(self) -> set[str]:
        """The names of the columns without units."""
        return {split_unit(name)[0] for name in self.columns}

    @property
    def left_out(self) -> tuple[str, ...]:
        """Columns that mean nothing here."""
        return tuple(each.column for each in self.meant if each.meaning == "left out")


def understand(
    source: Path | RawTable,
    robot: Robot,
    kind: Measurement,
    options: TableOptions | None = None,
    joints: Sequence[str] = (),
    targets: bool = False,
) -> Understood:
    r"""Return what a raw table says of a robot and a kind of measurement, under the names that `read_data` takes.

    Names that it takes already stay. Others are recognized where they can mean one thing only: ``joint_1``,
    ``J1 [deg]``, names of joints in a URDF, joints counted from 0, ``robot1_joint_1``, ``measured_x (mm)``,
    ``quat_w``, ``roll`` and what `names` lists. What is recognized in no way is left out, and so are rows without any
    measured value, or without any joint value; cells change where their unit is none of ours.

    Parameters
    ----------
    source
        A file of any format, or what it holds.
    robot, kind
        Decide which columns there may be.
    options
        What the user states.
    joints
        What the robot's file calls its joints.
    targets
        Whether rows are where the robot is to go: what was commanded counts then, and rows may lack either values.

    Raises
    ------
    InputError
        For a table that cannot be read, columns without a unit that no one gave, names that may mean two things.

    Examples
    --------
    >>> from pathlib import Path
    >>> import numpy as np
    >>> from rpim_opt.data.measurements.position import position
    >>> from rpim_opt.data.tables.understanding import understand
    >>> from rpim_opt.robot import Robot
    >>> arm = Robot("two links", np.array([[0, 0, 0, 0, 0], [0, 0.4, 0, 0, 0]]))
    >>> text = "Point;J1 [deg];J2 [deg];X [mm];Y [mm];Z [mm]\nP1;1,5;2;401;0,5;0\nP2;3;4;-;-;-\n"
    >>> _ = Path("raw.csv").write_text(text)
    >>> found = understand(Path("raw.csv"), arm, position)
    >>> found.columns["q1_deg"], found.meant[1].meaning, found.notes[-1]
    (['1.5'], 'joint 1', 'rows without measured values are left out: P2.')
    """
    options = options or TableOptions()
    file = source.name if isinstance(source, Path) else ""
    raw = read_raw(source, options) if isinstance(source, Path) else source
    require_rotation(options.rotation)
    known = number_columns(robot, kind)
    try:
        read, why, rotation = _readings(raw, robot, kind, options, joints, targets)
        columns, meant = _ours(raw.columns, read, why, kind, known, options.units)
        if "rx" in known:
            columns, meant = _as_quaternions(columns, meant, options.rotation or rotation)
    except InputError as error:
        raise error.within(source if isinstance(source, Path) else None) from None
    kept = list(range(len(next(iter(columns.values()), ()))))
    notes: list[str] = []
    if not targets:
        columns, kept, notes = _with_values(columns, robot, kind)
        columns, more = _labelled(columns)
        notes += more
    return Understood(
        file,
        columns,
        {name: [cells[i] for i in kept] for name, cells in raw.columns.items()},
        meant,
        (*raw.notes, *notes),
        _doubt(read, options, rotation, robot.dof),
    )


def _doubt(read: Readings, options: TableOptions, rotation: str, dof: int) -> str:
    """Return which option only a check against the robot can spare: of components that are numbered, of rx, ry, rz."""
    if not options.quaternion and quaternion_columns(read, dof):
        return "quaternion"
    turns = [name for name, each in read.items() if each.stem in TURNED and recognize(split(name)[0]).stem in TURNED]
    named = any(re.search("roll|pitch|yaw", name, re.IGNORECASE) for name in turns)
    return "rotation" if len(turns) == 3 and not named and not (options.rotation or rotation) else ""


def _ours(
    table: Columns,
    read: Readings,
    left_why: Mapping[str, str],
    kind: Measurement,
    known: Mapping[str, Sequence[str]],
    units: Mapping[str, str],
) -> tuple[dict[str, Sequence[Any]], tuple[Meant, ...]]:
    """Return the columns that are ours, by our names and in our units, and what every column means."""
    plain = text_columns(kind)
    ours = {
        name: each for name, each in read.items() if name not in left_why and (each.stem in known or each.stem in plain)
    }
    in_unit = _with_units(ours, known, units)
    columns: dict[str, Sequence[Any]] = {}
    meant = []
    for name in table:
        if name not in ours:
            reason = left_why.get(name) or read[name].why or "no column of these measurements"
            meant.append(Meant(name, "left out", "", "", reason))
            continue
        new, size, why = in_unit[name]
        columns[new] = table[name] if size == 1 else _times(table[name], size, name)
        stem, unit = split_unit(new)
        reason = f"{ours[name].why}; unit {why}" if why else ours[name].why
        shown = new.removeprefix(f"{stem}_") if unit else ""
        meant.append(Meant(name, kind.words.columns.get(stem) or meaning(stem), new, shown, reason))
    return columns, tuple(meant)


def meaning(stem: str) -> str:
    """Return what a column of ours is, in words.

    >>> from rpim_opt.data.tables.understanding import meaning
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


def _readings(
    raw: RawTable, robot: Robot, kind: Measurement, options: TableOptions, joints: Sequence[str], targets: bool
) -> tuple[Readings, dict[str, str], str]:
    """Return what every column holds, why some are left out, and the rotation that names tell."""
    table, dof = raw.columns, robot.dof
    names = [*number_columns(robot, kind), *text_columns(kind)]
    read = {name: _read(name, raw.heads.get(name), names, kind.names, joints) for name in table}
    read, rotation = _of_letters(read, dof)
    read = numbered(read, table, dof, options.quaternion or "wxyz")
    read = _from_one(_by_name(read, table, joints, dof), dof)
    wanted = [{f"q{i}" for i in range(1, dof + 1)}, {"x", "y", "z"}]
    for stems in wanted:
        read = _without_prefix(read, stems, joints, options.prefix)
    for name, each in read.items():
        if ANOTHER_POINT.fullmatch(each.stem):
            raise InputError("the header", f"column '{name}', another point", "a row each, with a column marker")
        if name.lower() in TURNED and each.stem in names and not (options.rotation or options.units.get("rx")):
            accepted = (
                "roll, pitch, yaw; rx_deg, ry_deg, rz_deg, the same; a quaternion; --rotation vector; "
                "--rotation 'intrinsic xyz'; or --measurement position"
            )
            raise InputError("the header", f"column '{name}', of angles or of a rotation vector", accepted)
        if (
            each.stem == "temperature"
            and not each.unit
            and not {"temperature"} & {*options.units, *robot.model.columns}
        ):
            read[name] = Reading("", "", "a temperature whose unit is not there")
    return (*_one_of_each(read, targets), rotation)


def _read(name: str, head: Head | None, known: Sequence[str], names: Sequence[str], joints: Sequence[str]) -> Reading:
    """Return what a column holds; its name as stem where that is not known."""
    text = name.partition(" #")[0]
    stem, unit = split(text)
    group = ""
    if head is not None and head.name:
        group = split(head.group)[0]
        stem = f"{group} {split(head.name)[0]}".strip()
        unit = next(filter(None, (split(part)[1] for part in (f"x [{head.unit}]", head.name, head.group))), "")
    for whole in (text, stem):
        if whole in joints:
            return Reading(f"q{joints.index(whole) + 1}", unit, "a joint of the robot's file")
    if stem in known:
        return Reading(stem, unit, "named so")
    if stem.lower() in names:  # elsewhere such a column holds labels
        return Reading(stem.lower(), unit, "what was touched")
    found = recognize(stem, joints)
    if group and not found.why:  # the words of a group that tell nothing
        rests = [rest for _, rest in endings(stem)]
        inner = [Reading(rest, "", "named so") if rest in known else recognize(rest, joints) for rest in rests]
        inside = next((each for each in inner if each.why), found)
        found = inside._replace(kind=found.kind or inside.kind)
    return found._replace(unit=unit)


def _of_letters(read: Readings, dof: int) -> tuple[Readings, str]:
    """Return readings in which letters are angles or joints where all of them are there, and the rotation they tell."""
    stems = {found.stem for found in read.values()}
    if dof == len(MOTOMAN) and stems >= set(MOTOMAN):
        joints = {letter: f"q{i}" for i, letter in enumerate(MOTOMAN, start=1)}
        why = "Yaskawa: S, L, U, R, B, T"
        yaskawa = {name: each for name, each in read.items() if each.stem in joints}
        read = read | {name: each._replace(stem=joints[each.stem], why=why) for name, each in yaskawa.items()}
    for letters, meant, why, rotation in TURNS:
        if {"x", "y", "z", *letters} <= stems:
            new = dict(zip(letters, meant, strict=True))
            turned = {
                name: each._replace(stem=new[each.stem], why=why) for name, each in read.items() if each.stem in new
            }
            return {**read, **turned}, rotation
    return read, ""


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


def _without_prefix(read: Readings, wanted: set[str], joints: Sequence[str], stated: str) -> Readings:
    """Return readings in which names with a prefix are what they are without it, where no others are any of these."""
    if wanted & {each.stem for each in read.values()}:
        return read
    found: dict[str, Readings] = {}
    for name, each in read.items():
        stem = split(name)[0]
        for prefix, rest in endings(stem):
            known = recognize(rest, joints)
            if known.why and known.kind != "derived" and not each.why:
                why = f"{known.why}, of {prefix.strip(' ._/:-')}"
                found.setdefault(prefix, {})[name] = known._replace(
                    unit=each.unit, why=why, kind=known.kind or each.kind
                )
    whole = {}
    for prefix, each in found.items():
        shifted = _from_one(each, len(wanted))
        if wanted <= {known.stem for known in shifted.values()}:
            whole[prefix] = shifted
    if stated:
        whole = {prefix: each for prefix, each in whole.items() if prefix.strip(" ._/:-") == stated.strip(" ._/:-")}
    if len(whole) > 1:
        accepted = "--prefix with the one that was measured"
        raise InputError("the header", f"columns of {', '.join(each.strip(' ._/:-') for each in whole)}", accepted)
    return {**read, **next(iter(whole.values()), {})}


def _one_of_each(read: Readings, targets: bool) -> tuple[Readings, dict[str, str]]:
    """Return readings, and why some are left out: what was computed, and what was wanted where it was measured.

    Of targets, what was measured is left out where it was wanted, too.
    """
    why: dict[str, str] = {}
    measured = {each.stem for each in read.values() if each.kind in ("", "measured")}
    wanted = {each.stem for each in read.values() if each.kind == "wanted"}
    found = dict(read)
    for name, each in read.items():
        if each.kind == "derived":
            why[name] = "computed from others"
        elif targets:
            if each.kind != "wanted" and each.stem in wanted:
                why[name] = "it is not where the robot is to go"
        elif each.kind != "wanted" or (each.stem == "label" and "label" not in measured):
            continue
        elif each.stem not in measured and re.fullmatch(r"(?:to_)?q\d+", each.stem):
            found[name] = each._replace(why=f"{each.why}; commanded, as no measured value is there")
        else:
            why[name] = "what was wanted is no measurement"
    return found, why


# --- units ---------------------------------------------------------------------------------------------------------


def _with_units(
    read: Readings, known: Mapping[str, Sequence[str]], units: Mapping[str, str]
) -> dict[str, tuple[str, float, str]]:
    """Return the columns' names with their units, the factor on their cells, and why; refuse what cannot be."""
    named: dict[str, tuple[str, float, str]] = {}
    first: dict[str, str] = {}
    unitless: dict[str, list[str]] = {}
    for name, found in read.items():
        dimensions = [dimension for dimension in known.get(found.stem, []) if dimension]
        unit, why = _unit(name, found, dimensions, units)
        if unit and dimension_of(unit) not in dimensions:
            accepted = f"one of {' or '.join(dimensions) or 'no unit'}; units stand in the row below their names"
            raise InputError("the header", f"column '{name}' ({meaning(found.stem)}) in {unit}", accepted)
        size = 1.0
        if unit in FOREIGN:
            size = FOREIGN[unit].size
            why += f"; {unit} is {size:g} {FOREIGN[unit].unit}"
            unit = FOREIGN[unit].unit
        if not unit and dimensions:
            unitless.setdefault(dimensions[0], []).append(name)
        new = f"{found.stem}_{unit}" if unit else found.stem
        named[name] = new, size, why
        other = first.setdefault(new, name)
        if other != name:
            raise InputError("the header", f"columns '{other}' and '{name}' for {new}", "one of them")
    if unitless:
        examples = {"angle": "deg", "length": "mm", "torque": "Nm", "mass": "kg"}
        missing = ",".join(examples.get(dimension, dimension) for dimension in unitless)
        lacking = ", ".join(name for names in unitless.values() for name in names)
        accepted = f"--units with theirs, such as {missing}, or names that carry one, such as q1_deg and x_mm"
        raise InputError("the header", f"columns without a unit ({lacking})", accepted)
    return named


def _unit(name: str, found: Reading, dimensions: Sequence[str], units: Mapping[str, str]) -> tuple[str, str]:
    """Return a column's unit and why: its own, the given one, that of its dialect."""
    if found.unit:
        return found.unit, "in the header"
    stated = units.get(found.stem) or units.get(found.stem.rstrip("0123456789"))
    if stated:
        return stated, "--units"
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


def _times(cells: Sequence[Any], size: float, name: str) -> list[str]:
    """Return numbers in another unit; cells without one stay."""
    rows = range(1, len(cells) + 1)
    return ["" if is_missing(str(cell)) else repr(float(size * numbers([cell], [str(i)], name)[0]))
            for i, cell in zip(rows, cells, strict=True)]  # fmt: skip


def _as_quaternions(
    columns: dict[str, Sequence[Any]], meant: tuple[Meant, ...], rotation: str
) -> tuple[dict[str, Sequence[Any]], tuple[Meant, ...]]:
    """Return columns whose rotation vector, or turns other than roll, pitch, yaw, are a quaternion."""
    if rotation in ("", "extrinsic xyz"):
        return columns, meant
    names = {split_unit(name)[0]: name for name in columns}
    if any(turn not in names for turn in TURNED):
        raise InputError("the header", "no columns rx, ry, rz", "three of them, or no --rotation")
    angles = []
    for turn in TURNED:
        unit = split_unit(names[turn])[1] or UNITS["rad"]
        cells = ["nan" if is_missing(str(cell)) else cell for cell in columns[names[turn]]]
        filled = [0.0 if cell == "nan" else cell for cell in cells]
        values = unit.si * numbers(filled, [str(i) for i in range(1, len(cells) + 1)], names[turn])
        angles.append(np.where([cell == "nan" for cell in cells], np.nan, values))
    others = {name: cells for name, cells in columns.items() if split_unit(name)[0] not in TURNED}
    said = "rotation vector" if rotation == "vector" else f"turn, {rotation}"
    new = "qw, qx, qy, qz"
    changed = tuple(
        each._replace(meaning=said, name=new, unit="") if split_unit(each.name)[0] in TURNED else each for each in meant
    )
    return {**others, **quaternions(np.column_stack(angles), rotation)}, changed


# --- rows ----------------------------------------------------------------------------------------------------------


def row_stems(robot: Robot, kind: Measurement) -> dict[str, set[str]]:
    """Return the names of measured and of joint values without units: a row needs both."""
    forms: Iterable[str] = [stem for form, _ in kind.forms for stem in form]
    return {"measured": {*kind.columns, *forms}, "joint": {f"q{i}" for i in range(1, robot.dof + 1)}}


def _with_values(columns: Columns, robot: Robot, kind: Measurement) -> tuple[Columns, list[int], list[str]]:
    """Return the columns without rows that have no values, the rows that are left, and what was left out."""
    out: set[int] = set()
    notes = []
    count = len(next(iter(columns.values()), ()))
    labels = columns.get("label", range(1, count + 1))
    for what, stems in row_stems(robot, kind).items():
        rows = missing_rows(columns, [name for name in columns if split_unit(name)[0] in stems])
        if rows:
            notes.append(f"rows without {what} values are left out: {listed([str(labels[i]) for i in rows])}.")
        out |= set(rows)
    kept = [i for i in range(count) if i not in out]
    if columns and not kept:
        raise InputError("the table", "no row with values", "at least one")
    return {name: [cells[i] for i in kept] for name, cells in columns.items()}, kept, notes


def _labelled(columns: Columns) -> tuple[Columns, list[str]]:
    """Return the columns with unique labels, of point and reflector where a point is there with several."""
    labels = [str(cell).strip() for cell in columns.get("label", ())]
    if _unique(labels):
        return columns, []
    if "marker" in columns:
        both = [f"{label}/{marker}" for label, marker in zip(labels, columns["marker"], strict=True)]
        if _unique(both):
            return {"configuration": labels, **columns, "label": both}, ["labels are those of point and reflector."]
    again = next((label for label in labels if labels.count(label) > 1), "")
    others = {name: cells for name, cells in columns.items() if name != "label"}
    return others, [f"labels are not unique ('{again}'): rows are numbered."]


def _unique(labels: Sequence[str]) -> bool:
    return all(labels) and len(set(labels)) == len(labels)
