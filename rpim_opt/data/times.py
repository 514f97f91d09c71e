"""Times of a table: which column holds them, and seconds of what it holds."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError

NAME = re.compile(r"[%#]?(?:.*[._/ ])?(time ?stamp|date ?time|time|stamp|zeit|zeitstempel|date|datum|t)", re.IGNORECASE)
UNIT = re.compile(r"(.+?)[\s_]*[\[(/]?\s*\b(s|sec|secs|seconds|ms|us|µs|ns|nsec|nsecs)\b\s*[\])]?", re.IGNORECASE)
SECONDS = {"s": 1.0, "sec": 1.0, "secs": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9,
           "nsec": 1e-9, "nsecs": 1e-9}  # fmt: skip
SINCE_1970 = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
"""From which number on a time without a unit counts so since 1970: seconds would be in the year 5000."""


def time_column(names: Iterable[str]) -> str | None:
    """Return the first column that is called a time; None where there is none.

    >>> from rpim_opt.data.times import time_column
    >>> [time_column(names) for names in (["q1", "Time [ms]"], ["header.stamp", "x"], ["x_mm"])]
    ['Time [ms]', 'header.stamp', None]
    """
    for name in names:
        if NAME.fullmatch(_split(name)[0].replace("_", " ")):
            return name
    return None


def seconds(name: str, cells: Sequence[Any]) -> Array:
    """Return times (N,) [s] of a column's numbers, in the unit of its name, or of its dates (ISO 8601).

    Numbers without a unit are seconds, or, where that would be after the year 5000, what since 1970 is in our time.
    Dates without a zone are UTC.

    Raises
    ------
    InputError
        For a cell that is neither.

    Examples
    --------
    >>> from rpim_opt.data.times import seconds
    >>> seconds("time_ms", ["0", "250"]).tolist(), seconds("date", ["1970-01-01T00:01", "1970-01-02"]).tolist()
    ([0.0, 0.25], [60.0, 86400.0])
    """
    unit = SECONDS.get(_split(name)[1].lower(), 0.0)
    found = np.array([_second(name, i, cell) for i, cell in enumerate(cells)], dtype=float)
    texts = any(isinstance(cell, datetime) or not _number(cell) for cell in cells)
    if texts:
        return found
    if not unit:
        unit = SECONDS[_guessed(float(np.median(np.abs(found))) if len(found) else 0.0)]
    return unit * found


def _guessed(size: float) -> str:
    return next((unit for least, unit in SINCE_1970 if size >= least), "s")


def _split(name: str) -> tuple[str, str]:
    match = UNIT.fullmatch(name.strip().replace("_", " "))
    if match:
        return match[1].strip(), match[2]
    return name.strip(), ""


def _number(cell: Any) -> bool:
    try:
        float(cell)
    except (TypeError, ValueError):
        return False
    return True


def _second(name: str, row: int, cell: Any) -> float:
    """Return a cell's number, or the seconds since 1970 of its date."""
    value = float("nan")
    if _number(cell):
        value = float(cell)
    else:
        try:
            when = cell if isinstance(cell, datetime) else datetime.fromisoformat(str(cell).strip())
            value = when.replace(tzinfo=when.tzinfo or UTC).timestamp()
        except ValueError:
            pass
    if not np.isfinite(value):
        raise InputError(f"column '{name}', row {row + 1}", f"'{cell}'", "a number, or a date as 2026-05-31T12:00:00")
    return value
