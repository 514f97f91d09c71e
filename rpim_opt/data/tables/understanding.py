"""What a raw table says: every column with its meaning, its unit, and why it is taken so."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import Columns
from rpim_opt.basics.text import listed
from rpim_opt.basics.units import UNITS, split_unit
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.tables.layout import Layout, RawTable, missing_rows, read_raw
from rpim_opt.data.tables.names import Reading
from rpim_opt.data.tables.naming import Renamed, rename
from rpim_opt.data.tables.orientations import from_vectors, quaternion_columns
from rpim_opt.data.tables.units import split
from rpim_opt.robot.mdh import Robot

NAMES = {"label": "label of the row", "configuration": "configuration", "marker": "reflector", "fixture": "fixture",
         "session": "session of the measurements",
         "to_marker": "reflector of the second point", "point": "point that was touched or seen",
         "plane": "plane that was touched",
         "rx": "measured roll", "ry": "measured pitch", "rz": "measured yaw"}  # fmt: skip
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


@dataclass(frozen=True)
class Asked:
    """What a user states of raw tables.

    Parameters
    ----------
    layout
        How the cells are written.
    units
        Of columns whose name carries none, by dimension.
    quaternion
        Order of components that are numbered, ``"wxyz"`` or ``"xyzw"``; empty to check both against the robot.
    rotation
        ``"vector"`` where rx, ry, rz are a rotation vector (Universal Robots), else roll, pitch, yaw.
    key
        The column by which several files are joined; ``"row"`` for the number of the row.
    within
        Tolerance [s] where they are joined by the nearest time.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> asked = ro.data.Asked(units={"angle": "rad", "length": "m"}, quaternion="xyzw")
    >>> asked.key
    ''
    """

    layout: Layout = field(default_factory=Layout)
    units: Mapping[str, str] | None = None
    quaternion: str = ""
    rotation: str = ""
    key: str = ""
    within: float | None = None


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
    numbered
        Whether a quaternion's components are numbered, whose order a check has to find.
    """

    file: str
    columns: Columns
    raw: Columns
    meant: tuple[Meant, ...]
    notes: tuple[str, ...]
    numbered: bool = False

    @property
    def stems(self) -> set[str]:
        """The names of the columns without units."""
        return {split_unit(name)[0] for name in self.columns}


def understand(
    path: Path,
    robot: Robot,
    kind: Measurement,
    asked: Asked | None = None,
    joints: Sequence[str] = (),
    table: RawTable | None = None,
) -> Understood:
    r"""Return what a raw table says of a robot and a kind of measurement.

    Rows without any measured value, or without any joint value, are left out, and said so.

    Parameters
    ----------
    path
        A text, Excel or Parquet file.
    robot, kind
        Decide which columns there may be.
    asked
        What the user states.
    joints
        What the robot's file calls its joints.
    table
        What the file holds, where it was read before.

    Raises
    ------
    InputError
        For a table that cannot be read, and names that may mean two things.

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
    asked = asked or Asked()
    raw = table or read_raw(path, asked.layout)
    try:
        raw, vectors = _with_quaternions(raw, asked)
        found = rename(raw.columns, robot, kind, asked.units or {}, joints, raw.heads, asked.quaternion or "wxyz")
    except InputError as error:
        raise error.within(path) from None
    columns, kept, notes = _with_values(found.columns, robot, kind)
    columns, more = _labelled(columns)
    ours = {found.was.get(name, name): name for name in found.columns}
    read = {name: Reading(split_unit(ours[name])[0] if name in ours else "") for name in raw.columns}
    return Understood(
        path.name,
        columns,
        {name: [cells[i] for i in kept] for name, cells in raw.columns.items()},
        _meant(raw, found, ours, vectors, kind),
        (*raw.notes, *notes, *more),
        not asked.quaternion and bool(quaternion_columns(read, robot.dof)),
    )


def _with_quaternions(raw: RawTable, asked: Asked) -> tuple[RawTable, tuple[str, ...]]:
    """Return the table with quaternions for rotation vectors, and the columns that these were."""
    if not asked.rotation:
        return raw, ()
    if asked.rotation != "vector":
        raise InputError("--rotation", f"'{asked.rotation}'", "vector, where rx, ry, rz are a rotation vector")
    stems = {split(name)[0].strip().lower(): name for name in raw.columns}
    names = [stems[stem] for stem in ("rx", "ry", "rz") if stem in stems]
    if len(names) < 3:
        raise InputError("the header", "no columns rx, ry, rz", "three of a rotation vector, or no --rotation")
    unit = split(names[0])[1] or (asked.units or {}).get("angle", "")
    if not unit:
        raise InputError("the header", f"columns without a unit ({', '.join(names)})", "--units with it, such as rad")
    others = {name: cells for name, cells in raw.columns.items() if name not in names}
    vectors = from_vectors(raw.columns, names, UNITS[unit].si)
    return replace(raw, columns={**others, **vectors}), tuple(names)


def row_stems(robot: Robot, kind: Measurement) -> dict[str, set[str]]:
    """Return the names of measured and of joint values without units: a row needs both."""
    forms = [stem for form, _ in kind.forms for stem in form]
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


def _meant(
    raw: RawTable, found: Renamed, ours: Mapping[str, str], vectors: Sequence[str], kind: Measurement
) -> tuple[Meant, ...]:
    """Return what every column of the file means."""
    meant = [Meant(name, "rotation vector", "qw, qx, qy, qz", "", "--rotation vector") for name in vectors]
    for name in raw.columns:
        if name not in ours:
            meant.append(Meant(name, "left out", "", "", found.left_why[name]))
        elif not (vectors and name in ("qw", "qx", "qy", "qz")):
            new = ours[name]
            why, unit_why = found.why[new]
            stem, unit = split_unit(new)
            shown = new.removeprefix(f"{stem}_") if unit else ""
            meant.append(
                Meant(
                    name,
                    kind.words.get(stem) or meaning(stem),
                    new,
                    shown,
                    f"{why}; unit {unit_why}" if unit_why else why,
                )
            )
    return tuple(meant)


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
