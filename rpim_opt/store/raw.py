"""Interpretation of raw files: joined tables, measurement type, and checks by the nominal robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError, in_file, pick
from rpim_opt.basics.layout import RawTable, TableOptions
from rpim_opt.basics.tables import EXCEL, Columns, Grid, is_numeral, read_columns
from rpim_opt.basics.units import split
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.distance import cable, distance
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.measurements.pose import pose, position
from rpim_opt.data.measurements.registry import MEASUREMENTS
from rpim_opt.data.tables.formats.registry import read_raw
from rpim_opt.data.tables.joining import seconds, time_column, together
from rpim_opt.data.tables.names import NUMBERED, ORDERS, recognize
from rpim_opt.data.tables.reading import read_data
from rpim_opt.data.tables.understanding import CanonicalTable, Column, interpret
from rpim_opt.problem.causes.misreadings import pose_misfit
from rpim_opt.robot.chain import RobotSetup

CLEARLY = 3.0  # Ratio of errors by which the right interpretation of orientations or camera mounting has to be better.
ALIKE = 1.0  # Angle [deg] to the nominal orientation up to which targets agree with their joint values.
USUAL = "extrinsic xyz"
SINCE_1970 = 1e8  # larger times [s] count from 1970; others may start at zero in every file
READINGS = {
    "quaternion": ORDERS,
    "rotation": (USUAL, "vector", *(f"intrinsic {''.join(order)}" for order in permutations("xyz") if order[0] != "z"),
                 "intrinsic zxy"),
}  # fmt: skip
"""Values of the option that a check against the robot tries; extrinsic orders are intrinsic ones in reverse."""
Files = Sequence[tuple[Path | None, RawTable]]


@dataclass(frozen=True, eq=False)
class Interpretation:
    """Interpretation of raw tables.

    ``kind`` is the measurement type, ``columns`` one table with canonical names (texts and numbers as in the files),
    ``raw`` the same rows with the files' names, ``tables`` the interpretation of every file, ``notes`` state how they
    were joined and what was checked, ``options`` the stated ones, ``file`` the first of the files.
    """

    kind: Measurement
    columns: Columns
    raw: Columns
    tables: tuple[CanonicalTable, ...]
    notes: tuple[str, ...]
    options: TableOptions
    file: str

    @property
    def left_out(self) -> tuple[str, ...]:
        """The names of ignored columns of all files."""
        unused = (each.column for table in self.tables for each in table.meant if each.meaning == "not used")
        return tuple(dict.fromkeys(unused))

    @property
    def texts(self) -> dict[str, list[str]]:
        """The ignored columns that hold more than numbers, unchanged."""
        cells = {name: [str(cell) for cell in self.raw.get(name.lower(), ())] for name in self.left_out}
        return {name: own for name, own in cells.items() if not all(map(is_numeral, filter(None, own)))}

    @property
    def count(self) -> int:
        """The number of rows."""
        return len(next(iter(self.columns.values()), ()))

    def __str__(self) -> str:
        parts = []
        for each in self.tables:
            rows = [("column", "meaning", "name here", "unit", "why"), *each.meant]
            width = [max(map(len, column)) for column in zip(*rows, strict=True)]
            rows.insert(1, tuple("-" * w for w in width))
            lines = ["   ".join(cell.ljust(w) for cell, w in zip(row, width, strict=True)).rstrip() for row in rows]
            title = [each.file] if len(self.tables) > 1 else []
            parts.append("\n".join([*title, *lines, *(f"{each.file}: {note}" for note in each.notes)]))
        # on the flange or beside the robot: only the fit decides
        what = "pixels of a camera" if self.kind.by_camera else f"measurement {self.kind.name}"
        return "\n\n".join(parts) + "\n" + "\n".join([*self.notes, f"{self.count} rows, {what}."])

    def content(self) -> dict[str, Any]:
        """Return the same as a document."""
        of_tables = [f"{each.file}: {note}" for each in self.tables for note in each.notes]
        columns = [{"file": each.file, **meant._asdict()} for each in self.tables for meant in each.meant]
        notes = [*of_tables, *self.notes]
        return {"columns": columns, "measurement": self.kind.name, "rows": self.count, "notes": notes}


def usual_noise(kind: Measurement) -> dict[str, float]:
    """Return standard deviations for data that state none, as keys of ``[noise]``."""
    usual = {"length": ("mm", 0.05), "angle": ("mrad", 0.5), "pixel": ("px", 0.2)}
    return {f"{name}_{usual[dimension][0]}": usual[dimension][1] for name, dimension in kind.noise.items()}


def rows_of(
    read: Interpretation, columns: Columns, arm: RobotSetup, kind: Measurement, noise: Mapping[str, float] | None = None
) -> Dataset:
    """Return the measurements of interpreted columns; errors use the file's column names."""
    try:
        return read_data(columns, arm.robot, usual_noise(kind) if noise is None else noise, kind)
    except InputError as error:
        row, mark, ours = error.where.partition(", column ")
        row += " of those joined" * (bool(mark) and len(read.tables) > 1)
        own = {each.name: each.column for table in read.tables for each in table.meant if each.name}
        column = own.get(ours, ours)
        where = f"{row}{mark}'{column}'" if column != ours else error.where
        of_column = [table.file for table in read.tables if column in {each.column for each in table.meant}]
        raise InputError(where, error.found, error.accepted, error.file or next(iter(of_column), read.file)) from None


def interpret_tables(
    arm: RobotSetup,
    data: Sequence[Any],
    measurement: str | Measurement | None = None,
    options: TableOptions | None = None,
    targets: bool = False,
) -> Interpretation:
    """Interpret raw tables (files or data frames) of measurements, or of targets of the arm's tool, as one table."""
    options = options or TableOptions()
    stated = {"x", "y", "z", *(f"q{i}" for i in range(1, arm.robot.dof + 1))}

    def turned(grid: Grid) -> bool:
        return stated <= {recognize(split(row[0])[0], arm.names).stem for row in grid.rows}

    files = _read(data, options, turned)
    known = pick(MEASUREMENTS, measurement, "measurement") if isinstance(measurement, str) else measurement
    if known is None:
        columns = [raw.columns for _, raw in files]
        known = next((kind for kind in MEASUREMENTS.values() if kind.shown_by and kind.shown_by(columns)), None)
    for kind in [known] if known else (pose, position, distance, cable):
        tables = _tables(files, arm, kind, options, targets)
        stems = set().union(*(each.stems for each in tables))
        if known or kind.stands_in(stems):
            understanding = _whole(files, arm, kind, options, tables)
            wanted = ("rotation",) * ("q1" in stems) if targets else tuple(READINGS)
            doubt = next((each.doubt for each in tables if each.doubt in wanted and kind.turning), "")
            return _checked(understanding, files, arm, doubt, targets) if doubt else understanding
    names = ", ".join(name for _, raw in files for name in raw.columns)
    sheets = [note.rstrip(".") for _, raw in files for note in raw.notes if note.startswith("sheet '")]
    accepted = "; ".join(["columns x, y, z or distance, or --measurement plane or sphere (touched)", *sheets])
    raise InputError("the header", f"no positions among {names}", accepted, files[0][0])


def _read(data: Sequence[Any], options: TableOptions, turned: Callable[[Grid], bool]) -> Files:
    """Return the tables of sources, each once; of workbooks and texts a stated sheet is the workbooks'."""
    once = {str(each) if isinstance(each, str | Path) else id(each): each for each in data}
    books = {key for key in once if Path(str(key)).suffix.lower() in EXCEL}
    tables: list[tuple[Path | None, RawTable]] = []
    for key, source in once.items():
        if not isinstance(source, str | Path):
            tables.append((None, RawTable(read_columns(source))))
            continue
        path, sheet = Path(source), options.sheet if key in books or not books else ""
        try:
            tables.append((path, read_raw(path, replace(options, sheet=sheet.strip()), turned)))
        except InputError as error:  # no sheet of that name with commas: several sheets
            if error.where != "--sheet" or "," not in sheet:
                raise
            parts = [replace(options, sheet=each.strip()) for each in sheet.split(",")]
            tables += [(path, read_raw(path, part, turned)) for part in parts]
    return tables


def _tables(
    files: Files, arm: RobotSetup, kind: Measurement, options: TableOptions, targets: bool = False
) -> list[CanonicalTable]:
    tables = []
    for path, raw in files:
        with in_file(path):
            understood = interpret(raw, arm.robot, kind, options, arm.names, targets)
        tables.append(replace(understood, file=path.name) if path else understood)
    return tables


def _whole(
    files: Files, arm: RobotSetup, kind: Measurement, options: TableOptions, tables: Sequence[CanonicalTable]
) -> Interpretation:
    with in_file(files[0][0] if len(files) == 1 else None):
        whole = together(tables, arm.robot, kind, options.key, options.within)
    join = {"meaning": "joins the files", "why": "rows of equal keys or of the nearest times"}
    shown = _with_meaning(tables, whole.keys, **join)
    return Interpretation(kind, whole.columns, whole.raw, shown, whole.notes, options, str(files[0][0] or ""))


def in_time_order(found: Interpretation) -> Interpretation:
    """Return labelled rows in the order of the first column of dates, or of times since 1970, if there is one."""
    columns = {"label": [str(i + 1) for i in range(found.count)], **found.columns}
    unused = [each.column for table in found.tables for each in table.meant if not each.name]
    for name in (column for column in unused if time_column([column.lower()])):
        with suppress(InputError, KeyError):  # no times, or not for all rows
            times = seconds(name, found.raw[name.lower()])
            if times.min() > SINCE_1970:
                order = np.argsort(times, kind="stable").tolist()
                columns, raw = ({n: [c[i] for i in order] for n, c in each.items()} for each in (columns, found.raw))
                tables = _with_meaning(found.tables, [name.lower()], meaning="order of the rows", why="times")
                notes = (*found.notes, f"rows are in the order of '{name}'.")
                return replace(found, columns=columns, raw=raw, tables=tables, notes=notes)
    return replace(found, columns=columns)


def _with_meaning(tables: Sequence[CanonicalTable], columns: Sequence[str], **new: str) -> tuple[CanonicalTable, ...]:
    """Return tables in which columns, in lower case, that have no other meaning have a new one."""

    def updated(each: Column) -> Column:
        return each._replace(**new) if each.column.lower() in columns and each.meaning == "not used" else each

    return tuple(replace(table, meant=tuple(map(updated, table.meant))) for table in tables)


def _checked(first: Interpretation, files: Files, arm: RobotSetup, doubt: str, targets: bool) -> Interpretation:
    """Return poses with the order of a quaternion that fits the nominal robot; refuse turns that are not as usual."""
    alternatives: dict[str, Interpretation] = {}
    misfit: dict[str, float] = {}
    noise = {"position_mm": 1.0, "orientation_mrad": 1.0}
    for reading in READINGS[doubt]:
        options = replace(first.options, **{doubt: reading})
        alternatives[reading] = _whole(
            files, arm, first.kind, options, _tables(files, arm, first.kind, options, targets)
        )
        data = read_data(alternatives[reading].columns, arm.robot, noise, first.kind)
        misfit[reading] = float(np.degrees(pose_misfit(arm.robot, data, arm.tool if targets else None)))
        if targets and misfit[USUAL] <= ALIKE:
            return first
    best, second = sorted(misfit, key=lambda reading: misfit[reading])[:2]
    figures = ", ".join(f"{reading} {misfit[reading]:.2f} deg" for reading in (best, second))
    if doubt == "rotation":
        if misfit[USUAL] <= CLEARLY * misfit[best] or (targets and misfit[best] > ALIKE):
            return first
        how = "that differ from the nominal ones at the stated joint values by" if targets else "with nominal errors of"
        missed = f"rotations {how} {misfit[USUAL]:.2f} deg as {USUAL}, and {figures}"
        accepted = f"--rotation '{best}' if correct, or '{USUAL}'"
        raise InputError("rx, ry, rz", missed, accepted, first.file)
    if misfit[second] <= CLEARLY * misfit[best]:
        accepted = "--quaternion wxyz or xyzw, or names qw, qx, qy, qz"
        raise InputError("the order of the quaternion", f"an ambiguous order ({figures})", accepted, first.file)
    note = f"the quaternion's order is {best}: nominal rotation errors {figures}."
    found = alternatives[best]
    return replace(found, notes=(*found.notes, note), options=replace(found.options, quaternion=NUMBERED + best))
