"""A problem folder from a table of measurements and a robot: every key with what it means and where it comes from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import write_text
from rpim_opt.basics.tables import Columns, csv_text, read_columns
from rpim_opt.basics.units import split_unit
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.models import MEASUREMENTS, Measurement, pose, position
from rpim_opt.data.naming import Renamed, parse_units, rename
from rpim_opt.data.reading import read_data
from rpim_opt.robot.chain import Described
from rpim_opt.robot.library import ROBOT_FILES, find_robot, read_arm
from rpim_opt.robot.plain import toml, write_robot
from rpim_opt.store.named import pick
from rpim_opt.store.template import problem_text

NOISE = {"length": ("mm", 0.05), "angle": ("mrad", 0.5)}
"""Standard deviations that are written where the data state none."""


@dataclass(frozen=True)
class Started:
    """A folder that was made: its files with their rows, and a sentence for all that was recognised or guessed."""

    folder: Path
    rows: Mapping[str, int]
    notes: tuple[str, ...]

    def __str__(self) -> str:
        """Return the files and the sentences."""
        lines = [f"{name}: {count} rows" for name, count in self.rows.items()]
        return "\n".join([f"Made: {self.folder}", *lines, *self.notes])


def new_problem(
    folder: str | Path,
    robot: str,
    data: str | Path,
    *,
    measurement: str | None = None,
    units: str = "",
    validation: str | Path | None = None,
    hold_out: float | None = None,
    seed: int = 0,
    urdf_base: str | None = None,
    urdf_tip: str | None = None,
) -> Started:
    """Make a problem folder that `load` reads; the folder is whole or not there.

    Parameters
    ----------
    folder
        A new one.
    robot
        The name of a ready robot, or a file ``.urdf``, ``.toml``, ``.json`` or ``.csv``.
    data
        Measurements, ``.csv``, ``.parquet`` or ``.xlsx``, with the columns of `read_data` or what `naming.rename`
        recognises.
    measurement
        What was measured; by default poses where the table has orientations, else positions.
    units
        Units of columns whose name carries none, ``"deg,mm"``.
    validation
        A table of measurements to keep apart.
    hold_out
        Instead of that, which part of the configurations to keep apart, drawn at random.
    seed
        Of the draw.
    urdf_base, urdf_tip
        Links between which a URDF's robot is.

    Raises
    ------
    InputError
        For a folder that is there already, and whatever of the robot or the data cannot be used.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> from rpim_opt.store.named import find
    >>> arm = find("paper_arm")
    >>> made = ro.store.new_problem("cell7", str(arm / "robot.toml"), arm / "identification.csv", hold_out=0.25)
    >>> made.rows
    {'identification.csv': 7, 'validation.csv': 2}
    """
    folder = Path(folder)
    data = Path(data)
    given = parse_units(units)
    _require_new(folder, validation, hold_out)
    source = _source(robot)
    arm = read_arm(source.file, urdf_base, urdf_tip)
    kind, table = _recognised(data, measurement, arm, given)
    noise = {f"{name}_{NOISE[d][0]}": NOISE[d][1] for name, d in kind.noise.items()}
    rows = _read(data, table, arm, noise, kind)
    columns = _labelled(table.columns, rows)
    notes = _named(data, table)
    tables = {"identification.csv": columns}
    apart = '# validation = "validation.csv"   # a table that no choice may see; none was given'
    if validation is not None:
        other = _recognised(Path(validation), kind.name, arm, given)[1]
        _read(Path(validation), other, arm, noise, kind)
        tables["validation.csv"] = other.columns
        notes += _named(Path(validation), other)
        apart = f'validation = "validation.csv"\n# from {Path(validation).name}; no choice sees it'
    elif hold_out is not None:
        held = _drawn(rows, hold_out, seed)
        tables = {"identification.csv": _taken(columns, ~held), "validation.csv": _taken(columns, held)}
        apart = f'validation = "validation.csv"\n# configurations drawn with seed {seed}; no choice sees them'
        rows = rows.take(np.flatnonzero(~held))
    said = {
        "robot": toml(source.stated),
        "drawing": source.drawing,
        "columns": "as you said" if measurement else f"guessed from the columns {', '.join(kind.columns)}",
        "data": data.name,
        "count": str(len(rows)),
        "validation": apart,
    }
    try:
        text, guessed = problem_text(arm, kind, rows, noise, said)
    except InputError as error:
        raise error.within(data) from None
    _write(folder, text, tables, source, arm)
    counts = {name: len(next(iter(each.values()))) for name, each in tables.items()}
    return Started(folder, counts, (*notes, *guessed))


class Source(NamedTuple):
    """Where the robot comes from: its file, what the problem states of it, and in words."""

    file: Path
    stated: str
    drawing: str


def _source(robot: str) -> Source:
    if not robot.endswith(ROBOT_FILES):
        return Source(find_robot(robot), robot, "a ready robot")
    file = Path(robot)
    if not file.is_file():
        raise InputError("the robot", "no such file", f"a file {', '.join(ROBOT_FILES)}, or a ready robot", file)
    return Source(file, "robot.toml", f"modified DH table, from {file.name}")


def _require_new(folder: Path, validation: str | Path | None, hold_out: float | None) -> None:
    if folder.exists() or folder.is_symlink():
        raise InputError("the folder", "one that is there", "a new one: nothing is overwritten", folder)
    if validation is not None and hold_out is not None:
        raise InputError("validation", "a table and a part to hold out", "one of them")


def _write(folder: Path, text: str, tables: Mapping[str, Columns], source: Source, arm: Described) -> None:
    """Make the folder beside its place, and move it there when it is whole."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=folder.parent, prefix=f"{folder.name}.") as temporary:
        made = Path(temporary) / folder.name
        write_text(made / "problem.toml", text)
        for name, each in tables.items():
            write_text(made / name, csv_text(each, zip(*each.values(), strict=True)))
        if source.stated == "robot.toml":
            _write_robot(source.file, arm, made / "robot.toml")
        made.rename(folder)


def _write_robot(file: Path, arm: Described, target: Path) -> None:
    if file.suffix == ".toml":
        write_text(target, file.read_text(encoding="utf-8"))  # with its comments
    else:
        write_robot(arm.robot, target)


def _recognised(
    path: Path, measurement: str | None, arm: Described, units: Mapping[str, str]
) -> tuple[Measurement, Renamed]:
    """Return what a table measures, and the table under our names."""
    try:
        source = read_columns(path)
    except InputError as error:
        raise error.within(path) from None

    def renamed(kind: Measurement) -> Renamed:
        try:
            return rename(source, arm.robot, kind, units, arm.names)
        except InputError as error:
            raise error.within(path) from None

    if measurement is not None:
        kind = pick(MEASUREMENTS, measurement, "measurement")
        return kind, renamed(kind)
    found = renamed(pose)
    stems = {split_unit(name)[0] for name in found.columns}
    if not stems & {"x", "y", "z"}:
        accepted = f"columns x, y, z, or --measurement {', '.join(MEASUREMENTS)}"
        raise InputError("the header", f"no positions among {', '.join(source)}", accepted, path)
    return (pose, found) if any(set(form) <= stems for form in _turns()) else (position, renamed(position))


def _turns() -> list[Sequence[str]]:
    return [tuple(pose.columns), *(tuple(form) for form, _ in pose.forms)]


def _read(path: Path, table: Renamed, arm: Described, noise: Mapping[str, float], kind: Measurement) -> Dataset:
    try:
        return read_data(table.columns, arm.robot, noise, kind)
    except InputError as error:
        raise error.within(path) from None


def _labelled(columns: Columns, rows: Dataset) -> Columns:
    """Return the columns with labels: a row keeps its number where rows are drawn."""
    return columns if "label" in columns else {"label": rows.label, **columns}


def _drawn(rows: Dataset, share: float, seed: int) -> np.ndarray:
    """Return which rows (N,) are held out: a share of the configurations, at least one."""
    known = len(np.unique(rows.configuration))
    if not 0 < share < 1 or known < 2:
        raise InputError("--hold-out", f"{share:g} of {known} configurations", "a part between 0 and 1 of two or more")
    drawn = rows.configurations(min(max(round(share * known), 1), known - 1), seed)
    return np.isin(rows.configuration, drawn.configuration)


def _taken(columns: Columns, rows: np.ndarray) -> Columns:
    return {name: [cells[i] for i in np.flatnonzero(rows).tolist()] for name, cells in columns.items()}


def _named(path: Path, table: Renamed) -> list[str]:
    notes = []
    if table.was:
        notes.append(f"{path.name}: " + ", ".join(f"{was} is {name}" for name, was in table.was.items()) + ".")
    if table.left_out:
        notes.append(f"{path.name}: left out {', '.join(table.left_out)}.")
    return notes
