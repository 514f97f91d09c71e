"""What a raw table says: every column with its meaning, its unit, and why it is taken so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import Columns
from rpim_opt.basics.text import listed
from rpim_opt.basics.units import UNITS, split_unit
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.tables.layout import RawTable, TableOptions, missing_rows, read_raw
from rpim_opt.data.tables.names import Reading
from rpim_opt.data.tables.naming import Meant, rename
from rpim_opt.data.tables.orientations import from_vectors, quaternion_columns
from rpim_opt.data.tables.units import split
from rpim_opt.robot.mdh import Robot


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
    options: TableOptions | None = None,
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
    options
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
    options = options or TableOptions()
    raw = table or read_raw(path, options)
    try:
        raw, vectors = _with_quaternions(raw, options)
        found = rename(raw.columns, robot, kind, options.units, joints, raw.heads, options.quaternion or "wxyz")
    except InputError as error:
        raise error.within(path) from None
    columns, kept, notes = _with_values(found.columns, robot, kind)
    columns, more = _labelled(columns)
    stems = {each.column: split_unit(each.name)[0] for each in found.meant}
    read = {name: Reading(stems[name]) for name in raw.columns}
    made = ("qw", "qx", "qy", "qz") if vectors else ()
    meant = [Meant(name, "rotation vector", "qw, qx, qy, qz", "", "--rotation vector") for name in vectors]
    return Understood(
        path.name,
        columns,
        {name: [cells[i] for i in kept] for name, cells in raw.columns.items()},
        (*meant, *(each for each in found.meant if each.column not in made)),
        (*raw.notes, *notes, *more),
        not options.quaternion and bool(quaternion_columns(read, robot.dof)),
    )


def _with_quaternions(raw: RawTable, options: TableOptions) -> tuple[RawTable, tuple[str, ...]]:
    """Return the table with quaternions for rotation vectors, and the columns that these were."""
    if not options.rotation:
        return raw, ()
    if options.rotation != "vector":
        raise InputError("--rotation", f"'{options.rotation}'", "vector, where rx, ry, rz are a rotation vector")
    stems = {split(name)[0].strip().lower(): name for name in raw.columns}
    names = [stems[stem] for stem in ("rx", "ry", "rz") if stem in stems]
    if len(names) < 3:
        raise InputError("the header", "no columns rx, ry, rz", "three of a rotation vector, or no --rotation")
    unit = split(names[0])[1] or options.units.get("angle", "")
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
