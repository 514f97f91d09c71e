"""Interpretation of raw tables: meaning, unit and reason for every column, under canonical names."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
import scipy

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.layout import RawTable, TableOptions, is_missing
from rpim_opt.basics.tables import Columns, is_numeral, numbers
from rpim_opt.basics.text import listed
from rpim_opt.basics.units import DISPLAY, UNITS, accepted_units, numeral, split, split_unit
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.tables import names as known_names
from rpim_opt.data.tables.names import Meaning, Meanings, endings, numbered, quaternion_columns, recognize
from rpim_opt.data.tables.reading import number_columns, text_columns
from rpim_opt.robot.mdh import Robot

TURNED = ("rx", "ry", "rz")
"""Columns of three rotation angles; without a unit they may also be a rotation vector, as of Universal Robots."""
COORDINATES = {"x", "y", "z"}
ANOTHER_POINT = re.compile(r"(?:p|pos|position|meas|measured)?_?[xyz]_?[2-9]")
READING = re.compile(r"((?:p|pos|position|meas|measured|shot)?[\s_]*([xyz]))[\s_]*([1-9])", re.IGNORECASE)
NEAR_READINGS = 0.01  # part of the points' spread within which a row's readings are of one reflector
INSTRUMENT = re.compile(r"tracker|leica|laser|meas|mess", re.IGNORECASE)
"""Instrument in the name of a coordinate: not the robot's own; actual may be either."""
CONTROLLER = re.compile(r"\$?pos_act|actual_tcp", re.IGNORECASE)
"""Beginning of coordinates computed by a controller: KUKA's and Universal Robots'."""
PLACED = 3  # minimum of configurations per position of an instrument: three points determine it
INCOMPLETE = 0.25  # share of rows that may lack one of several values and are then left out
MEANINGS = {
    "label": "label of the row", "configuration": "configuration", "marker": "reflector", "fixture": "fixture",
    "session": "session of the measurements", "to_marker": "reflector of the second point",
    "point": "touched or observed point", "rx": "measured roll (extrinsic xyz)",
    "ry": "measured pitch (extrinsic xyz)", "rz": "measured yaw (extrinsic xyz)",
    "temperature": "robot's temperature: lengths grow with it",
    r"q(\d+)": r"joint \1", r"tau(\d+)": r"torque of joint \1", r"q([wxyz])": r"quaternion \1",
    r"r(\d)(\d)": r"rotation matrix \1,\2", "u95": "U95 of all axes", "sigma": "standard deviation of all axes",
    r"u95_(\w+)": r"U95 of \1", r"sigma_(\w+)": r"standard deviation of \1",
    r"cov_([^_]+)_(\w+)": r"covariance of \1, \2",
}  # fmt: skip
"""Descriptions of canonical columns; the first matching pattern counts."""


class Column(NamedTuple):
    """A column of a file: its name there, its meaning, its canonical name, its unit, and the reason."""

    column: str
    meaning: str
    name: str
    unit: str
    why: str


@dataclass(frozen=True, eq=False)
class CanonicalTable:
    """A raw table with canonical names.

    ``columns`` are cells by canonical names, ``raw`` those of the same rows by the file's names in lower case.
    ``doubt`` is the option, ``quaternion`` or ``rotation``, for an interpretation of orientations that only a check
    against the robot can confirm. Of several joined files, ``file`` is the first, and ``keys`` are the joining columns,
    in lower case.
    """

    columns: Columns
    raw: Columns
    meant: tuple[Column, ...]
    notes: tuple[str, ...]
    doubt: str = ""
    file: str = "the table"
    keys: Sequence[str] = ()

    @property
    def stems(self) -> set[str]:
        """The names of the columns without units."""
        return {split_unit(name)[0] for name in self.columns}

    @property
    def labels(self) -> list[str]:
        """The labels of the rows, or their numbers from 1."""
        count = len(next(iter(self.columns.values()), ()))
        return [str(label) for label in self.columns.get("label", range(1, count + 1))]

    def take(self, rows: Sequence[int]) -> CanonicalTable:
        """Return the table of these rows."""
        columns, raw = ({n: [cells[i] for i in rows] for n, cells in c.items()} for c in (self.columns, self.raw))
        return replace(self, columns=columns, raw=raw)


def interpret(
    raw: RawTable,
    robot: Robot,
    kind: Measurement,
    options: TableOptions,
    joints: Sequence[str] = (),
    targets: bool = False,
) -> CanonicalTable:
    """Interpret a raw table with the names that `read_data` takes, leaving out other columns and rows without values.

    ``joints`` are the robot file's names. With ``targets`` commanded values count; rows may lack either kind of value.
    """
    units = options.units
    raw = _readings_below_each_other(raw)
    options = replace(options, units={**raw.units, **units}, joints=tuple(joints))
    if options.rotation not in ("", "vector") and not known_names.EULER.fullmatch(options.rotation):
        accepted = "vector, or extrinsic or intrinsic with the order of the turns: 'extrinsic xyz', 'intrinsic zyx'"
        raise InputError("--rotation", f"'{options.rotation}'", accepted)
    known = number_columns(robot, kind)
    more = raw.with_constants(options.constants)
    read, rotation = _readings(more, robot, kind, options, targets)
    if any(re.fullmatch(r"q\d+", read[name].stem) for name in raw.columns):  # the file with the joints
        raw = more
    elif options.constants:
        read, rotation = _readings(raw, robot, kind, options, targets)
    rotation = options.rotation or rotation
    stated = {key: (unit, "--units" if key in units else "above the header") for key, unit in options.units.items()}
    columns, meant = _under_our_names(raw.columns, read, kind, known, stated)
    if "rx" in known and rotation not in ("", "extrinsic xyz"):
        columns, meant = _as_quaternions(columns, meant, rotation)
    of_file = {name.lower(): cells for name, cells in raw.columns.items()}
    turns = [name for name, each in read.items() if each.stem in TURNED and recognize(split(name)[0]).stem in TURNED]
    named = any(re.search("roll|pitch|yaw", name, re.IGNORECASE) for name in turns)
    doubt = "rotation" if len(turns) == 3 and not named and not rotation else ""
    if not options.quaternion and quaternion_columns(read, robot.dof):
        doubt = "quaternion"
    table = CanonicalTable(columns, of_file, tuple(meant), raw.notes, doubt)
    if not targets:
        table = _rows_with_values(table, robot, kind)
    headed = {UNITS[each.unit].dimension: each for each in meant if each.unit and "in the header" in each.why}
    other = [(units[of], each) for of, each in headed.items() if units.get(of, each.unit) != each.unit]
    notes = [f"--units {unit} does not apply: the header has '{m.column}' in {m.unit}." for unit, m in other]
    return replace(table, notes=(*table.notes, *notes))


def _readings_below_each_other(raw: RawTable) -> RawTable:
    """Return a table with one row per reading, if readings of one point stand side by side, X1, Y1, Z1, X2, ...

    Point names (a text that differs in every row) get the reading's number.
    """
    named = {name: READING.fullmatch(split(name)[0].strip()) for name in raw.columns}
    of = {(int(match[3]), match[2].lower()): name for name, match in named.items() if match}
    count = max((number for number, _ in of), default=0)
    if count < 2 or sorted(of) != [(k, axis) for k in range(1, count + 1) for axis in "xyz"]:
        return raw
    values = np.array([[numeral(str(cell)) for cell in raw.columns[of[each]]] for each in sorted(of)])
    values = values.reshape(count, 3, -1)
    apart = np.fmax.reduce(values) - np.fmin.reduce(values)  # of existing readings
    if not np.nanmax(apart) < NEAR_READINGS * np.nanstd(values, axis=(0, 2)).max():
        return raw
    columns: dict[str, Sequence[Any]] = {}
    for name, cells in raw.columns.items():
        match = named[name]
        if match is None:
            names = _unique(cells) and not any(map(is_numeral, cells))
            columns[name] = [f"{cell}/{k}" if names else cell for cell in cells for k in range(1, count + 1)]
        elif match[3] == "1":
            readings = (raw.columns[of[k, match[2].lower()]] for k in range(1, count + 1))
            columns[name.replace(match[0], match[1], 1)] = [cell for row in zip(*readings, strict=True) for cell in row]
    note = f"{count} readings of every point stand side by side: each is a row, of the same configuration."
    return replace(raw, columns=columns, notes=(*raw.notes, note))


def _as_quaternions(columns: Columns, meant: Sequence[Column], rotation: str) -> tuple[Columns, list[Column]]:
    """Return columns and meanings with a quaternion in place of three rotation angles.

    With ``intrinsic zyx`` the first rotation, about z, is in column rz; with ``intrinsic zyz`` the columns have the
    first, second and third rotation.
    """
    names = {split_unit(name)[0]: name for name in columns}
    if names.keys().isdisjoint(TURNED):  # joint values, from a file beside one of poses
        return columns, list(meant)
    if any(turn not in names for turn in TURNED):
        raise InputError("the header", "no columns rx, ry, rz", "three of them, or no --rotation")
    turned = [names[turn] for turn in TURNED]
    angles = [(split_unit(name)[1] or UNITS["rad"]).si * _values(columns[name], name) for name in turned]
    finite = np.flatnonzero(np.isfinite(angles).all(axis=0))
    rotations = scipy.spatial.transform.Rotation
    if rotation == "vector":
        of_rows = rotations.from_rotvec(np.transpose(angles)[finite])
    else:
        how, order = rotation.split()
        places = ["xyz".index(axis) for axis in order] if len(set(order)) == 3 else [0, 1, 2]
        order = order.upper() if how == "intrinsic" else order
        of_rows = rotations.from_euler(order, np.transpose(angles)[finite][:, places])
    xyzw = np.full((len(angles[0]), 4), np.nan)
    xyzw[finite] = of_rows.as_quat()
    quaternion = {f"q{part}": xyzw[:, "xyzw".index(part)].tolist() for part in "wxyz"}
    others = {name: cells for name, cells in columns.items() if name not in turned}
    meaning_of_turn = "rotation vector" if rotation == "vector" else f"turn, {rotation}"
    new = {"meaning": meaning_of_turn, "name": "qw, qx, qy, qz", "unit": ""}
    meant = [each._replace(**new) if each.name in turned else each for each in meant]
    return others | quaternion, meant


# --- what every column holds ---------------------------------------------------------------------------------------


def _readings(
    raw: RawTable, robot: Robot, kind: Measurement, options: TableOptions, targets: bool
) -> tuple[Meanings, str]:
    """Return the meaning of every column, None for ignored ones, and the rotation convention in the names."""
    table, dof, joints = raw.columns, robot.dof, options.joints
    names = [*number_columns(robot, kind), *text_columns(kind)]
    read = {name: _read(name, raw.groups.get(name, ""), names, kind.names, joints) for name in table}
    rotation = ""
    stems = {reading.stem for reading in read.values()}
    for words, why in known_names.JOINTS:
        if dof == len(words) and stems >= set(words):
            _rename(read, {word: f"q{i}" for i, word in enumerate(words, start=1)}, why)
    for letters, new, why, turns in (*known_names.TURNS, *(known_names.TCP_POSES if targets else ())):
        if stems | {*new} >= COORDINATES and stems >= {*letters}:
            _rename(read, dict(zip(letters, new, strict=True)), why)
            rotation = turns
            break
    if stems & {"elevation", "zenith"}:
        _rename(read, {"d": "distance"}, "beside two angles")
    numbered(read, table, dof, options.quaternion)
    _put_in_robots_order(read, table, dof, joints)
    _count_from_one(read, dof)
    _beside_external_axis(read, robot)
    for stems in ({f"q{i}" for i in range(1, dof + 1)}, COORDINATES):
        read.update(_without_prefix(read, stems, joints, options.prefix))
    _counted(read, robot)
    wanted = {*options.units, *robot.model.columns}
    for name, each in read.items():
        if ANOTHER_POINT.fullmatch(each.stem):
            accepted = "one row per reading: those of a point below each other, with its joint values in every row, "
            accepted += "or their means; those of several reflectors with a column marker"
            raise InputError("the header", f"column '{name}', another point or reading", accepted)
        if name.lower() in TURNED and each.stem in names and not (options.rotation or options.units.get("rx")):
            accepted = "roll, pitch, yaw; rx_deg, ry_deg, rz_deg; a quaternion; --rotation vector; --rotation "
            accepted += "'intrinsic xyz'; or --measurement position"
            raise InputError("the header", f"column '{name}', either angles or a rotation vector", accepted)
        if each.stem == "temperature" and not each.unit and "temperature" not in wanted:
            read[name] = Meaning("", "", "a temperature without a unit")
    _leave_out_efforts(read, dof, wanted)
    _leave_out(read, targets)
    _name_sessions(read, table)
    _choose_label(read, table, options.key)
    return read, rotation


def _name_sessions(read: Meanings, table: Columns) -> None:
    """Take the only column that names the instrument's places for sessions; one a pose is a label, which others are."""
    places = [name for name, each in read.items() if each.stem == "station" and all(map(str, table[name]))]
    joints = [table[name] for name, each in read.items() if re.fullmatch(r"q\d+", each.stem)]
    if len(places) == 1 and "session" not in {each.stem for each in read.values()}:
        poses = {*zip(table[places[0]], *joints, strict=True)} if joints else table[places[0]]
        count = len({*table[places[0]]})
        if count == 1 or len(poses) >= PLACED * count:
            read[places[0]] = Meaning("session", "", "where the instrument stood")


def counts_rows(keys: Sequence[str]) -> bool:
    """Return whether keys are the numbers of the rows."""
    return keys == [str(i) for i in range(1, len(keys) + 1)]


def _choose_label(read: Meanings, table: Columns, key: str) -> None:
    """Of several labels keep the stated key, or the one that distinguishes rows and is no row number."""
    names = {name: [*map(str, table[name])] for name, each in read.items() if each.stem in ("label", "configuration")}
    if len(names) == 1 and all(map(_unique, names.values())):  # one pose per row
        read.update({name: read[name]._replace(stem="label") for name in names})
    cells = {name: [cell.strip() for cell in own] for name, own in names.items() if read[name].stem == "label"}
    for group, point in permutations(cells, 2):  # SpatialAnalyzer: one group per configuration
        rows = [*zip(cells[group], cells[point], strict=True)]
        repeated = len(rows) > len(set(cells[group])) > len(set(cells[point])) > 1
        if re.search("group|gruppe", group.lower()) and repeated and len(set(rows)) == len(rows):
            read[group] = read[group]._replace(stem="configuration")
            read[point] = Meaning("marker", "", f"the same in every '{group}'")
            return
    chosen = [name for name in cells if name.lower() == key.lower()]
    if not chosen:
        counting = [name for name in cells if not counts_rows(cells[name])]
        groups = [name for name in counting if len(set(cells[name])) > 1]
        chosen = [name for name in groups if _unique(cells[name])] or groups or counting
    if len(cells) > 1 and len(chosen) == 1:
        read.update({name: Meaning("", "", f"'{chosen[0]}' is the label") for name in cells if name != chosen[0]})


def _read(name: str, group: str, known: Sequence[str], names: Sequence[str], joints: Sequence[str]) -> Meaning:
    """Return the meaning of a column; an unknown name becomes its stem."""
    text = name.partition(" #")[0]
    stem, unit = split(text.removeprefix(group).strip())
    group, of_group = split(group)
    stem = f"{group} {stem}".strip()
    unit = unit or of_group
    for whole in (text, stem):
        if whole in joints:
            return Meaning(f"q{joints.index(whole) + 1}", unit, "a joint of the robot file")
    if stem in known:
        return Meaning(stem, unit, "by its name")
    if stem.lower() in names:  # otherwise such a column holds labels
        return Meaning(stem.lower(), unit, "touched point")
    reading = recognize(stem, joints)
    if group and not reading.why:  # the words of a group without meaning
        rests = [rest for _, rest in endings(stem)]
        inner = [Meaning(rest, "", "by its name") if rest in known else recognize(rest, joints) for rest in rests]
        inside = next((each for each in inner if each.why), reading)
        reading = inside._replace(kind=reading.kind or inside.kind)
    return reading._replace(unit=unit)


def _put_in_robots_order(read: Meanings, table: Columns, dof: int, joints: Sequence[str]) -> None:
    """Put ROS' joints and their efforts in the robot's order, where columns name0, ... name them."""
    matches = {name: re.fullmatch(r"(?:field_)?name_?(\d{1,9})", reading.stem) for name, reading in read.items()}
    named = {int(match[1]): name for name, match in matches.items() if match}
    if not named or f"q{min(named)}" not in {reading.stem for reading in read.values()}:
        return
    new: dict[str, str] = {}
    for i, column in named.items():
        joint, *others = {str(cell) for cell in table[column]}
        if others:
            found = f"column '{column}' with {len(others) + 1} names"
            raise InputError("the header", found, "one joint per column: of several publishers keep the rows of one")
        place = joints.index(joint) + 1 if joint in joints else 0
        if not joints and dof == len(known_names.UR_JOINTS):
            place = known_names.UR_NUMBERS.get(joint, 0)
        if not joints and not place:
            accepted = "a robot from a URDF, which names its joints"
            raise InputError("the header", f"joint '{joint}' in column '{column}'", accepted)
        new |= {f"{stem}{i}": f"{stem}{place}" if place else f"another {stem}{i}" for stem in ("q", "tau")}
    _rename(read, new, "the joint named in its name column")


def _rename(read: Meanings, new: Mapping[str, str], why: str) -> None:
    """Change stems, for a reason that may follow ``{}``, the one so far."""
    for name, each in read.items():
        if each.stem in new:
            read[name] = each._replace(stem=new[each.stem], why=why.format(each.why))


def _beside_external_axis(read: Meanings, robot: Robot) -> None:
    """Take KUKA's ``E1`` for the only joint that slides, and A1, A2, ... for the others."""
    axes = [name for name, each in read.items() if known_names.EXTERNAL.fullmatch(each.stem)]
    slides = [i for i, kind in enumerate(robot.joint_dimensions, start=1) if kind == "length"]
    missing = {f"q{i}" for i in range(1, robot.dof + 1)} - {each.stem for each in read.values()}
    if len(axes) == len(slides) == 1 and missing == {f"q{robot.dof}"}:
        others = [i for i in range(1, robot.dof + 1) if i not in slides]
        _rename(read, {f"q{k}": f"q{i}" for k, i in enumerate(others, start=1)}, "{}, beside an external axis")
        read[axes[0]] = read[axes[0]]._replace(stem=f"q{slides[0]}", why="the external axis, which slides")


def _count_from_one(read: Meanings, dof: int) -> None:
    """Count the joints from 1, where they are counted from 0."""
    if any(reading.stem == "q0" for reading in read.values()):
        new = {f"{stem}{i}": f"{stem}{i + 1}" for i in range(dof) for stem in ("q", "tau")}
        _rename(read, new, "{}, numbered from 0")


def _without_prefix(read: Meanings, wanted: set[str], joints: Sequence[str], stated: str) -> Meanings:
    """Return the meanings of names without a common prefix; refuse several prefixes if none is stated."""
    known = [name for name, each in read.items() if each.stem in wanted]
    direct = dict.fromkeys(known, Meaning("", "", "another column is the instrument's"))
    bare = any(len(split(name)[0]) == 1 or INSTRUMENT.search(name) for name in known)
    if known and (bare or wanted != COORDINATES):
        return {}
    stated = stated.strip(" ._/:-")
    whole = {}
    for prefix, each in _prefixed(read, joints).items():
        _count_from_one(each, len(wanted))
        missing = sorted(wanted - {reading.stem for reading in each.values()})
        if not missing:
            whole[prefix] = each
        elif len(missing) < len(wanted) / 2 and not known:  # is it one that did not move
            why = f"of {prefix}, which has no {', '.join(missing)}: --constants"
            read.update({name: Meaning("", "", why) for name in each})
    if known and whole and not all(CONTROLLER.match(name) for name in known):
        own = split(known[0])[0][:-1].strip(" ._/:-")
        whole = {own: {name: read[name] for name in known}} | whole
    if stated in whole:
        whole = {stated: whole[stated]}
    if len(whole) > 1:
        raise InputError("the header", f"columns of {', '.join(whole)}", "--prefix of the measured robot")
    return direct | next(iter(whole.values())) if whole else {}


def _prefixed(read: Meanings, joints: Sequence[str]) -> dict[str, Meanings]:
    """Return the meanings of unknown names without what stands before them, by that."""
    by_prefix: dict[str, Meanings] = {}
    for name, each in read.items():
        for prefix, rest in endings(split(name)[0]):
            known = recognize(rest, joints)
            if known.why and known.kind != "derived" and not each.why:
                bare = prefix.strip(" ._/:-")
                new = Meaning(known.stem, each.unit, f"{known.why}, of {bare}", known.kind or each.kind)
                by_prefix.setdefault(bare, {})[name] = new
                break  # the shortest prefix: orientation/x is not x
    return by_prefix


def _counted(read: Meanings, robot: Robot) -> None:
    """Name counted columns of an unknown word: in joint units the joints, three others (``p_1, p_2, p_3``) x, y, z."""
    words: dict[str, dict[int, str]] = {}
    for name, each in read.items():
        match = re.fullmatch(r"(\D*?)_?(0|[1-9]\d?)", each.stem)
        if match and not each.why:
            words.setdefault(match[1], {})[int(match[2])] = name
    dimensions = {name: UNITS[read[name].unit].dimension if read[name].unit else "" for name in read}
    stems = {each.stem for each in read.values()}
    joints = set(enumerate(robot.joint_dimensions, start=1))
    whole = [word for word, names in words.items() if joints <= {(i, dimensions[n]) for i, n in names.items()}]
    if len(whole) == 1 and whole[0] and not any(re.fullmatch(r"q\d+", stem) for stem in stems):
        for i, name in words.pop(whole[0]).items():
            why = f"'{whole[0]}' numbered from 1, in joint units"
            read[name] = read[name]._replace(stem=f"q{i}", why=why)
    lengths = [{i: n for i, n in names.items() if dimensions[n] in ("", "length")} for names in words.values()]
    triples = [names for names in lengths if sorted(names) in ([1, 2, 3], [0, 1, 2])]
    if len(triples) == 1 and not stems & {*COORDINATES, "distance", "q0"}:
        for axis, (_, name) in zip("xyz", sorted(triples[0].items()), strict=True):
            read[name] = read[name]._replace(stem=axis, why="the only three numbered columns besides the joints")


def _leave_out_efforts(read: Meanings, dof: int, stated: Collection[str]) -> None:
    """Ignore efforts of ROS that may be currents, having no unit and none ``stated``, and those of some joints only."""
    torques = {f"tau{i}" for i in range(1, dof + 1)}
    whole = torques <= {each.stem for each in read.values()}
    for name, each in read.items():
        if "effort" not in name or each.stem not in torques:
            continue
        if not each.unit and {each.stem, "tau", "torque"}.isdisjoint(stated):
            read[name] = Meaning("", "", "an effort without a unit: --units Nm if it is a torque")
        elif not whole:
            read[name] = Meaning("", "", "not all joints have an effort")


def _leave_out(read: Meanings, targets: bool) -> None:
    """Ignore computed columns, and commanded ones where measured ones exist; for targets ignore measured ones."""
    measured = {each.stem for each in read.values() if each.kind in ("", "measured")}
    named = {each.stem for name, each in read.items() if each.kind == "measured" and INSTRUMENT.search(name)}
    by_instrument = COORDINATES if named >= COORDINATES else set()  # one alone is of another frame
    wanted = {each.stem for each in read.values() if each.kind == "wanted"}
    letters = COORDINATES & {split(name)[0].lower() for name in read}
    for name, each in list(read.items()):
        why = ""
        if each.kind == "derived":
            why = "computed from others"
        elif not each.kind and each.stem in by_instrument and not INSTRUMENT.search(name):
            why = "another column is the instrument's"
        elif name == "X_Value" and letters == COORDINATES:
            why = "LabVIEW's time"
        elif targets:
            if each.kind != "wanted" and each.stem in wanted:
                why = "not a target of the robot"
        elif each.kind == "wanted" and (each.stem != "label" or "label" in measured):
            if each.stem not in measured and re.fullmatch(r"(?:to_)?q\d+", each.stem):
                note = "commanded values are used, since there are no measured ones"
                read[name] = each._replace(why=f"{each.why}; {note}")
            else:
                why = "commanded, not measured"
        if why:
            read[name] = Meaning("", "", why)


# --- our names and units -------------------------------------------------------------------------------------------


def _under_our_names(
    table: Columns,
    read: Meanings,
    kind: Measurement,
    known: Mapping[str, Sequence[str]],
    units: Mapping[str, tuple[str, str]],
) -> tuple[dict[str, Sequence[Any]], list[Column]]:
    """Return columns under canonical names and their meanings; ``units`` by stem or dimension, and who says so."""
    columns: dict[str, Sequence[Any]] = {}
    meant: list[Column] = []
    stems: dict[str, Sequence[str]] = {**dict.fromkeys(text_columns(kind), ()), **known}
    dimensions = {stem: list(filter(None, each)) for stem, each in stems.items()}
    if not {each.stem for each in read.values()} & {"qw", "rx", "r11"}:  # an uncertainty of all axes is then a length
        dimensions |= {stem: ["length"] for stem, each in dimensions.items() if len(each) > 1}
    for name, cells in table.items():
        stem, _, reason, _ = read[name]
        if stem not in dimensions:
            unused = reason and stem and "not used by this robot and measurement type"
            meant.append(Column(name, "not used", "", "", unused or reason or "an unknown name"))
            continue
        unit, why = _unit(name, read[name], dimensions[stem], units)
        if unit and UNITS[unit].dimension not in dimensions[stem]:
            accepted = f"one of {' or '.join(dimensions[stem]) or 'no unit'} (in the header or the row below it)"
            if re.fullmatch(r"q\d+", stem):
                accepted += ', or another type of the joint in the robot file (type = "prismatic")'
            raise InputError("the header", f"column '{name}' ({meaning(stem)}) in {unit}", accepted)
        new = f"{stem}_{unit}" if unit else stem
        if new in columns:
            other = next(each.column for each in meant if each.name == new)
            accepted = f"one of them, such as --key '{name}'" if new == "label" else "one of them"
            raise InputError("the header", f"columns '{other}' and '{name}' for {new}", accepted)
        columns[new] = cells
        words_of_column = kind.words.columns.get(stem) or meaning(stem)
        reasons = filter(None, [reason, why and f"unit {why}"])
        meant.append(Column(name, words_of_column, new, unit, "; ".join(reasons)))
    unitless = {each.column: dimensions[each.name][0] for each in meant if dimensions.get(each.name)}
    if unitless:
        units_of = [
            (DISPLAY.get(of, of), next(iter(accepted_units(of)), of)) for of in dict.fromkeys(unitless.values())
        ]
        either = " or ".join(dict.fromkeys(f"--units {','.join(each)}" for each in zip(*units_of, strict=True)))
        accepted = f"{either}, whichever they are in, or names with a unit, such as q1_deg and x_mm"
        raise InputError("the header", f"columns without a unit ({', '.join(unitless)})", accepted)
    if not columns:
        accepted = "names with units, such as q1_deg and x_mm, in the header or as --columns"
        raise InputError("the header", f"no known column ({listed(list(table))})", accepted)
    return columns, meant


def meaning(stem: str) -> str:
    """Return the meaning of a canonical column as text: ``U95 of z``, ``second point: joint 1``."""
    if stem.startswith("to_") and stem not in MEANINGS:
        return f"second point: {meaning(stem.removeprefix('to_'))}"
    matches = ((re.fullmatch(pattern, stem), words) for pattern, words in MEANINGS.items())
    return next((match.expand(words) for match, words in matches if match), f"measured {stem}")


def _unit(name: str, read: Meaning, dimensions: Sequence[str], units: Mapping[str, tuple[str, str]]) -> tuple[str, str]:
    """Return a column's unit and why: its own, the stated one, that of its dialect."""
    if read.unit:
        return read.unit, "in the header"
    # a sigma may be of lengths or angles: a unit by dimension does not apply
    only = dimensions[0] if len(dimensions) == 1 else ""
    for key in (read.stem, read.stem.rstrip("0123456789"), only):
        if key in units:
            return units[key]
    if only == "pixel":
        return "px", "the only unit"
    unit = {"angle": "rad", "length": "m"}.get(only, "")
    dialects = (why for pattern, why in known_names.IN_SI.items() if unit and re.fullmatch(pattern, name))
    return next(((unit, why) for why in dialects), ("", ""))


def _values(cells: Sequence[Any], name: str) -> np.ndarray:
    """Return the numbers (N,) of cells, NaN where there is none."""
    missing = [is_missing(str(cell)) for cell in cells]
    values = numbers([0.0 if lacks else cell for cell, lacks in zip(cells, missing, strict=True)], name)
    return np.where(missing, np.nan, values)


def row_stems(robot: Robot, kind: Measurement) -> dict[str, set[str]]:
    """Return the names of measured and of joint values without units: a row needs both."""
    forms = {stem for form, _ in kind.forms for stem in form}
    return {"measured": {*kind.columns, *forms}, "joint": {f"q{i}" for i in range(1, robot.dof + 1)}}


def _rows_with_values(table: CanonicalTable, robot: Robot, kind: Measurement) -> CanonicalTable:
    """Return the rows that have measured and joint values, with unique labels, and notes on what was changed."""
    labels = table.labels
    out: set[int] = set()
    notes = list(table.notes)
    for what, stems in row_stems(robot, kind).items():
        own = [cells for name, cells in table.columns.items() if split_unit(name)[0] in stems]
        lacking = [sum(is_missing(str(cell)) for cell in row) for row in zip(*own, strict=True)]
        none = [i for i, count in enumerate(lacking) if count == len(own)]
        some = [i for i, count in enumerate(lacking) if 0 < count < len(own)]
        if len(some) > INCOMPLETE * len(labels):  # a wrong column: named where its numbers are read
            some = []
        for rows, which in ((none, f"without {what} values"), (some, f"that lack one of their {what} values")):
            if rows:
                notes.append(f"rows {which} are ignored: {listed([labels[i] for i in rows])}.")
            out.update(rows)
    whole = table.take([i for i in range(len(labels)) if i not in out])
    if not whole.labels:
        raise InputError("the table", "no row with values", "at least one")
    columns = dict(whole.columns)
    own = [str(cell).strip() for cell in columns.get("label") or columns.get("configuration", ())]
    both = [f"{label}/{marker}" for label, marker in zip(own, columns.get("marker", ()), strict=False)]
    if both and all(own) and not _unique(own):
        notes.append("labels combine point and reflector.")
        if _unique(both):
            columns = {"configuration": own, **columns}
        columns["label"] = own = both
    if own and not all(own):
        notes.append("some labels are empty: rows are numbered.")
        columns.pop("label", None)
    elif not _unique(own):  # a reference point, or checks of the same poses
        times = Counter(own)
        again = next(label for label, count in times.items() if count > 1)
        notes.append(f"labels are not unique: the row number is appended to '{again}'.")
        named = enumerate(own, start=1)
        columns["label"] = [label if times[label] == 1 else f"{label} (row {i})" for i, label in named]
    return replace(whole, columns=columns, notes=tuple(notes))


def _unique(labels: Sequence[str]) -> bool:
    return all(labels) and len(set(labels)) == len(labels)
