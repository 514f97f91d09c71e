"""A problem folder from a table of measurements and a robot: every key with what it means and where it comes from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.inputs import read_text
from rpim_opt.basics.tables import Columns, csv_text
from rpim_opt.basics.writing import make_folder, scratch_folder, undoing, write_text
from rpim_opt.data.models import Measurement
from rpim_opt.data.tables.naming import TOUCHED
from rpim_opt.data.tables.understanding import Asked
from rpim_opt.data.tables.units import parse_units
from rpim_opt.robot.chain import Described
from rpim_opt.robot.library import read_arm
from rpim_opt.robot.plain import toml, write_robot
from rpim_opt.store.drawing import Source, find_source
from rpim_opt.store.kept_apart import Reading, beside, held_out, whole_table
from rpim_opt.store.raw import Understanding, understand_of
from rpim_opt.store.seen_target import TARGET_FILE, SeenTarget, seen_target, which_camera
from rpim_opt.store.template import problem_text

NOISE = {"length": ("mm", 0.05), "angle": ("mrad", 0.5), "pixel": ("px", 0.2)}
"""Standard deviations that are written where the data state none."""


@dataclass(frozen=True)
class Started:
    """A folder that was made: its files with their rows, a sentence for all that was recognised or guessed."""

    folder: Path
    rows: Mapping[str, int]
    notes: tuple[str, ...]
    understood: Understanding

    def __str__(self) -> str:
        """Return the files and the sentences."""
        lines = [f"{name}: {count} rows" for name, count in self.rows.items()]
        then = f"Look at {self.folder / 'problem.toml'}, then: rpim-opt inspect {self.folder}"
        return "\n".join([f"Made: {self.folder}", *lines, *self.notes, then])


def new_problem(
    folder: str | Path,
    robot: str,
    data: str | Path | Sequence[str | Path],
    *,
    measurement: str | None = None,
    units: str = "",
    asked: Asked | None = None,
    validation: str | Path | None = None,
    hold_out: float | None = None,
    seed: int = 0,
    urdf_base: str | None = None,
    urdf_tip: str | None = None,
    target: str = "",
    understood: Callable[[Understanding], None] | None = None,
) -> Started:
    """Make a problem folder that `load` reads; the folder is whole or not there.

    Parameters
    ----------
    folder
        A new one.
    robot
        The name of a ready robot, or a file ``.urdf``, ``.xacro``, ``.toml``, ``.json`` or ``.csv``.
    data
        Measurements, in one or several text, Excel or Parquet files of whatever columns `understand_tables` recognises.
    measurement
        What was measured; by default poses where the table has orientations, else positions.
    units
        Units of columns whose name carries none, ``"deg,mm"``.
    asked
        What else is stated of the tables, and their units.
    validation
        A table of measurements to keep apart.
    hold_out
        Instead of that, which part of the configurations to keep apart, drawn at random.
    seed
        Of the draw.
    urdf_base, urdf_tip
        Links between which a URDF's robot is.
    target
        What a camera sees: a table with point, x_mm, y_mm, or a grid ``7x5,30mm``.
    understood
        Hears what was understood of the tables, before anything is computed.

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
    _require_new(folder, validation, hold_out)
    source = find_source(robot)
    arm = read_arm(source.file, urdf_base, urdf_tip)
    paths = [data] if isinstance(data, str | Path) else data
    found = understand_of(arm, paths, measurement, asked or Asked(units=parse_units(units)))
    if understood is not None:
        understood(found)
    seen = seen_target(target)
    _require_target(found, seen)
    kind, how = _kind(arm, found, seen, measurement)
    noise = {f"{name}_{NOISE[d][0]}": NOISE[d][1] for name, d in kind.noise.items()}
    reading = Reading(arm, kind, noise, seen)
    if validation is not None:
        parts = beside(reading, found, validation)
    elif hold_out is not None:
        parts = held_out(reading, found, hold_out, seed)
    else:
        parts = whole_table(reading, found)
    tables = parts.tables
    if seen.table:
        tables = {**tables, TARGET_FILE: seen.table}
    said = {
        "target": seen.stated,
        "robot": toml(source.stated),
        "drawing": source.drawing,
        "columns": how,
        "data": Path(found.file).name,
        "count": str(len(parts.rows)),
        "validation": parts.said,
    }
    try:
        text, guessed = problem_text(arm, kind, parts.rows, noise, said)
    except InputError as error:
        raise error.within(found.file) from None
    _write(folder, text, tables, source, arm)
    counts = {name: len(next(iter(each.values()))) for name, each in tables.items()}
    notes = (*parts.notes, f"Measurement {kind.name}: {how}.", *guessed)
    return Started(folder, counts, notes, replace(found, kind=kind))


def _require_target(found: Understanding, seen: SeenTarget) -> None:
    """Refuse pixels without a board, and a board without pixels."""
    if seen.board and not found.kind.by_camera:
        raise InputError(
            "--target", "a board", f"none: measurement {found.kind.name} sees no points of one", found.file
        )
    stated = any(name.startswith("target_x") for name in found.columns)
    if found.kind.by_camera and not seen.board and not stated:
        accepted = "--target with what the camera sees: a table with point, x_mm, y_mm, or a grid such as 7x5,30mm"
        raise InputError("the target", "nothing", accepted, found.file)


def _kind(arm: Described, found: Understanding, seen: SeenTarget, measurement: str | None) -> tuple[Measurement, str]:
    """Return the kind of measurement, and how it is known."""
    kind = found.kind
    if measurement is not None:
        return kind, "as you said"
    if kind.by_camera:
        return which_camera(arm, seen.under(found.columns))
    if not kind.touching:
        return kind, f"guessed from the columns {', '.join(kind.columns)}"
    column = next(name for name in TOUCHED if name in found.columns)
    count = len(set(found.columns[column]))
    return kind, f"guessed: rows with the same {column} touched it, {count} in all, and nothing else is measured"


def _require_new(folder: Path, validation: str | Path | None, hold_out: float | None) -> None:
    if folder.exists() or folder.is_symlink():
        raise InputError("the folder", "one that is there", "a new one: nothing is overwritten", folder)
    if validation is not None and hold_out is not None:
        raise InputError("validation", "a table and a part to hold out", "one of them")


def _write(folder: Path, text: str, tables: Mapping[str, Columns], source: Source, arm: Described) -> None:
    """Make the folder beside its place, and move it there when it is whole."""
    with undoing() as parents, ExitStack() as stack:
        make_folder(folder.parent, parents)
        scratch = stack.enter_context(scratch_folder(folder))
        made = scratch / folder.name
        write_text(made / "problem.toml", text)
        for name, each in tables.items():
            write_text(made / name, csv_text(each, zip(*each.values(), strict=True)))
        if source.stated == "robot.toml":
            _write_robot(source.file, arm, made / "robot.toml")
        made.rename(folder)


def _write_robot(file: Path, arm: Described, target: Path) -> None:
    if file.suffix == ".toml":
        write_text(target, read_text(file))  # with its comments
    else:
        write_robot(arm.robot, target)
