"""Raw tables of a robot, understood: what every column means, before anything is computed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError, pick
from rpim_opt.basics.layout import RawTable, TableOptions
from rpim_opt.basics.tables import Columns
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.measurements.pose import pose
from rpim_opt.data.measurements.position import position
from rpim_opt.data.measurements.registry import MEASUREMENTS
from rpim_opt.data.tables.formats.registry import read_raw
from rpim_opt.data.tables.joining import together
from rpim_opt.data.tables.orientations import ORDERS
from rpim_opt.data.tables.reading import read_data
from rpim_opt.data.tables.understanding import Understood, understand
from rpim_opt.problem.misreadings import pose_misfit
from rpim_opt.robot.chain import Described
from rpim_opt.robot.library import find_source, read_arm

CLEARLY = 3.0
"""The right reading of orientations leaves so many times less than another one."""
USUAL = "extrinsic xyz"
GUESSED = (pose, position)
"""What columns are taken for, the first that they have all values of."""
READINGS = {
    "quaternion": ORDERS,
    "rotation": (USUAL, "vector", *(f"intrinsic {''.join(order)}" for order in permutations("xyz") if order[0] != "z"),
                 "intrinsic zxy"),
}  # fmt: skip
"""What an option may say, and a check against the robot tries; extrinsic turns are intrinsic ones in reverse order."""


@dataclass(frozen=True, eq=False)
class Understanding:
    r"""What raw tables say.

    Parameters
    ----------
    kind
        What was measured.
    columns
        One table with our names, texts and numbers as the files have them.
    tables
        What was understood of every file.
    notes
        How the tables were put together and what was checked, a sentence each.
    options
        What was stated of them.
    file
        The file, or the first of them.

    Examples
    --------
    >>> from pathlib import Path
    >>> import rpim_opt as ro
    >>> rows = ["Point;" + ";".join(f"J{i} [deg]" for i in range(1, 7)) + ";X [mm];Y [mm];Z [mm]"]
    >>> rows += [f"P{k};{k},5;-90;10;20;30;40;{k}00,125;200;300" for k in range(1, 4)]
    >>> _ = Path("raw.csv").write_text("\n".join(rows))
    >>> found = ro.store.understand_tables("ur5e", ["raw.csv"])
    >>> print(str(found).splitlines()[2])
    Point      label of the row   label         a usual name
    >>> found.columns["x_mm"], found.kind.name
    (['100.125', '200.125', '300.125'], 'position')
    """

    kind: Measurement
    columns: Columns
    tables: tuple[Understood, ...]
    notes: tuple[str, ...]
    options: TableOptions
    file: str

    def __str__(self) -> str:
        """Return what every column means as a table, and the sentences."""
        parts = []
        for each in self.tables:
            rows = [[m.column, m.meaning, m.name, m.unit, m.why] for m in each.meant]
            text = _table(["column", "meaning", "name here", "unit", "why"], rows)
            if len(self.tables) > 1:
                text = f"{each.file}\n{text}"
            parts.append("\n".join([text, *(f"{each.file}: {note}" for note in each.notes)]))
        count = len(next(iter(self.columns.values())))
        what = f"measurement {self.kind.name}"
        if self.kind.by_camera:  # on the flange or beside the robot: only what they fit tells
            what = "pixels of a camera"
        return "\n\n".join(parts) + "\n" + "\n".join([*self.notes, f"{count} rows, {what}."])

    @property
    def sentences(self) -> tuple[str, ...]:
        """The same in sentences, without what stands as it was.

        >>> import rpim_opt as ro
        >>> arm = ro.store.find_problem("paper_arm")
        >>> ro.store.understand_tables(str(arm / "robot.toml"), [arm / "identification.csv"]).sentences
        ()
        """
        said = []
        for each in self.tables:
            said += [f"{each.file}: {note}" for note in each.notes]
            renamed = [f"{m.column} is {m.name}" for m in each.meant if m.name and m.name != m.column]
            out = [m.column for m in each.meant if m.meaning == "left out"]
            if renamed:
                said.append(f"{each.file}: {', '.join(renamed)}.")
            if out:
                said.append(f"{each.file}: left out {', '.join(out)}.")
        return (*said, *self.notes)

    def content(self) -> dict[str, Any]:
        """Return the same as a document.

        >>> import rpim_opt as ro
        >>> arm = ro.store.find_problem("paper_arm")
        >>> found = ro.store.understand_tables(str(arm / "robot.toml"), [arm / "identification.csv"])
        >>> found.content()["columns"][1]["meaning"], found.content()["rows"]
        ('joint 1', 9)
        """
        said = [f"{each.file}: {note}" for each in self.tables for note in each.notes]
        count = len(next(iter(self.columns.values())))
        columns = [{"file": each.file, **meant._asdict()} for each in self.tables for meant in each.meant]
        return {"columns": columns, "measurement": self.kind.name, "rows": count, "notes": [*said, *self.notes]}


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table of text, all columns aligned left."""
    width = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    lines = [header, ["-" * w for w in width], *rows]
    return "\n".join("   ".join(cell.ljust(w) for cell, w in zip(line, width, strict=True)).rstrip() for line in lines)


def understand_tables(
    robot: str,
    data: Sequence[str | Path],
    measurement: str | None = None,
    options: TableOptions | None = None,
    urdf_base: str | None = None,
    urdf_tip: str | None = None,
    dh: str = "",
) -> Understanding:
    r"""Return what raw tables of a robot say: every column's meaning, unit, and why.

    Several files are stacked where each is whole, and joined by a key where some have the joint values and others the
    measured ones. Whether a quaternion's numbered components begin with w is checked against the nominal robot.

    Parameters
    ----------
    robot
        The name of a ready robot, or a file.
    data
        Text, Excel or Parquet files.
    measurement
        What was measured; by default poses where the tables have orientations, else positions.
    options
        What is stated of the tables.
    urdf_base, urdf_tip
        Links between which a URDF's robot is.
    dh
        The convention of a DH table, ``"modified"`` or ``"standard"``, where it does not say it (`read_sheet`).

    Raises
    ------
    InputError
        For what cannot be read, or may mean two things.

    Examples
    --------
    >>> from pathlib import Path
    >>> import rpim_opt as ro
    >>> _ = Path("joints.csv").write_text("Point,A1,A2,A3,A4,A5,A6\nP1,0,-90,10,20,30,40\nP2,5,-80,0,0,10,0\n")
    >>> _ = Path("points.csv").write_text("Point ID;X [m];Y [m];Z [m]\nP2;0,125;0,2;1,5\nP1;0,5;0,25;1,75\n")
    >>> options = ro.data.TableOptions(units={"angle": "deg"})
    >>> found = ro.store.understand_tables("ur5e", ["joints.csv", "points.csv"], options=options)
    >>> found.columns["q1_deg"], found.columns["x_m"]
    (['5', '0'], ['0.125', '0.5'])
    >>> found.notes
    ('joined by label: 2 rows of 2 with joints and 2 measured.',)
    """
    arm = read_arm(find_source(robot).file, urdf_base, urdf_tip, dh)
    return understand_of(arm, data, measurement, options)


def understand_of(
    arm: Described, data: Sequence[str | Path], measurement: str | None = None, options: TableOptions | None = None
) -> Understanding:
    """Return what raw tables of an arm say, as `understand_tables` does."""
    options = options or TableOptions()
    paths = [Path(each) for each in data]
    known = pick(MEASUREMENTS, measurement, "measurement") if measurement is not None else None
    files = [read_raw(path, options) for path in paths]
    if known is None:
        columns = [table.columns for table in files]
        known = next((kind for kind in MEASUREMENTS.values() if kind.shown_by and kind.shown_by(columns)), None)
    for kind in [known] if known else GUESSED:
        tables = [_understood(path, file, arm, kind, options) for path, file in zip(paths, files, strict=True)]
        if known or _has_values(tables, kind):
            found = _whole(paths, arm, kind, options, tables)
            doubt = next((each.doubt for each in tables if each.doubt), "")
            return _checked(found, files, arm, doubt) if doubt and kind.turning else found
    names = ", ".join(name for table in files for name in table.columns)
    accepted = f"columns x, y, z, or --measurement {', '.join(MEASUREMENTS)}"
    raise InputError("the header", f"no positions among {names}", accepted, paths[0])


def _understood(path: Path, file: RawTable, arm: Described, kind: Measurement, options: TableOptions) -> Understood:
    try:
        return replace(understand(file, arm.robot, kind, options, arm.names), file=path.name)
    except InputError as error:
        raise error.within(path) from None


def _has_values(tables: Sequence[Understood], kind: Measurement) -> bool:
    """Return whether tables state the values of a type in one of its forms."""
    stems = {stem for each in tables for stem in each.stems}
    return any(set(form) <= stems for form in (kind.columns, *(form for form, _ in kind.forms)))


def _whole(
    paths: Sequence[Path], arm: Described, kind: Measurement, options: TableOptions, tables: Sequence[Understood]
) -> Understanding:
    try:
        whole = together(tables, arm.robot, kind, options.key, options.within)
    except InputError as error:
        raise error.within(paths[0] if len(paths) == 1 else None) from None
    return Understanding(kind, whole.columns, tuple(tables), whole.notes, options, str(paths[0]))


def _checked(first: Understanding, files: Sequence[RawTable], arm: Described, doubt: str) -> Understanding:
    """Return poses read as they fit the nominal robot, and say both figures: the order of a quaternion is found.

    Turns that fit clearly better in another convention than roll, pitch, yaw are asked for.
    """
    paths = [Path(first.file).with_name(each.file) for each in first.tables]
    found: dict[str, Understanding] = {}
    misfit: dict[str, float] = {}
    for reading in READINGS[doubt]:
        options = replace(first.options, **{doubt: reading})
        tables = [_understood(path, file, arm, first.kind, options) for path, file in zip(paths, files, strict=True)]
        found[reading] = replace(_whole(paths, arm, first.kind, options, tables), file=first.file)
        data = read_data(found[reading].columns, arm.robot, {"position_mm": 1.0, "orientation_mrad": 1.0}, first.kind)
        misfit[reading] = float(np.degrees(pose_misfit(arm.robot, data)))
    best, second = sorted(misfit, key=lambda reading: misfit[reading])[:2]
    clear = misfit[second] > CLEARLY * misfit[best]
    figures = ", ".join(f"{reading} {misfit[reading]:.2f} deg" for reading in (best, second))
    if doubt == "rotation":
        if misfit[USUAL] <= CLEARLY * misfit[best]:
            return first
        accepted = f"--rotation '{best}' if that is what they are, or '{USUAL}'"
        found_ = f"turns that the nominal robot misses by {misfit[USUAL]:.2f} deg as {USUAL}, and {figures}"
        raise InputError("rx, ry, rz", found_, accepted, first.file)
    if not clear:
        raise InputError(
            "the order of the quaternion", f"no clear one ({figures})", "--quaternion wxyz or xyzw", first.file
        )
    note = (
        f"the quaternion's order is {best}: on the nominal robot it leaves {misfit[best]:.2f} deg, "
        f"{second} {misfit[second]:.1f} deg."
    )
    return replace(found[best], notes=(*found[best].notes, note))
