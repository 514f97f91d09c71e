"""Several raw tables become one: stacked where each is whole, joined where they have parts of the rows."""

from __future__ import annotations

from collections.abc import Sequence

from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.joining import joined
from rpim_opt.data.models import Measurement
from rpim_opt.data.nearest import nearest
from rpim_opt.data.stacking import Whole, stacked
from rpim_opt.data.understanding import Understood, row_stems
from rpim_opt.robot.mdh import Robot


def together(
    tables: Sequence[Understood], robot: Robot, kind: Measurement, key: str = "", within: float | None = None
) -> Whole:
    """Return several tables as one.

    Tables that have joint and measured values each are stacked. Where some have the one and some the other, rows of
    equal keys, or of the nearest times, are one row.

    Parameters
    ----------
    tables
        What was understood of every file.
    robot, kind
        Decide which columns are joint and which are measured values.
    key
        The column of the key, as the files or we call it; ``"row"`` for the number of the row. By default the label,
        else the only name that both have.
    within
        Tolerance [s]: rows are joined by the nearest time, in columns called time or by the key, of clocks that agree.

    Raises
    ------
    InputError
        For columns that one table lacks, keys that are there twice, and tables without a common key.
    """
    stems = row_stems(robot, kind)
    moving = [table for table in tables if table.stems & stems["joint"]]
    seen = [table for table in tables if table.stems & stems["measured"]]
    if len(tables) == 1 or (len(moving) == len(seen) == len(tables)):
        return stacked(tables)
    _require_parts(tables, moving, seen)
    if within is not None:
        return nearest(moving, seen, key, within)
    return joined(moving, seen, key)


def _require_parts(tables: Sequence[Understood], moving: Sequence[Understood], seen: Sequence[Understood]) -> None:
    """Raise `InputError` unless some tables have joint values, and all others measured ones."""
    if moving and seen and len(moving) + len(seen) == len(tables):
        return
    lost = ", ".join(table.file for table in tables if table not in moving and table not in seen)
    found = f"{lost or 'some tables'} with only part of joint and measured values"
    raise InputError("--data", found, "tables that have both, or tables of joints and tables of measured values")
