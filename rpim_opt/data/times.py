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
SECONDS = {"s": 1.0, "sec": 1.0, "secs": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "μs": 1e-6, "ns": 1e-9,
           "nsec": 1e-9, "nsecs": 1e-9}  # fmt: skip
"""What a unit is in lower case (`str.casefold`)."""
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
    read = [_read(cell) for cell in cells]
    dates = [time for time in read if isinstance(time, datetime)]
    numbers = [time for time in read if isinstance(time, float)]
    if len(numbers) < len(cells) and len(dates) < len(cells):
        raise _neither(name, cells, read)
    if dates:
        return np.array([date.replace(tzinfo=date.tzinfo or UTC).timestamp() for date in dates])
    found = np.array(numbers)
    return SECONDS[_split(name)[1].casefold() or _guessed(found)] * found


def _neither(name: str, cells: Sequence[Any], read: Sequence[float | datetime | None]) -> InputError:
    """Return what is said of the first cell that is no number or date, or another of them than the first one."""
    i = next(i for i, time in enumerate(read) if time is None or type(time) is not type(read[0]))
    accepted = "numbers, or dates as 2026-05-31T12:00:00"
    return InputError(f"column '{name}', row {i + 1}", f"'{cells[i]}'", accepted)


def _guessed(times: Array) -> str:
    size = np.abs(times).max(initial=0.0)
    return next((unit for least, unit in SINCE_1970 if size >= least), "s")


def _split(name: str) -> tuple[str, str]:
    match = UNIT.fullmatch(name.strip().replace("_", " "))
    if match:
        return match[1].strip(), match[2]
    return name.strip(), ""


def _read(cell: Any) -> float | datetime | None:
    """Return a cell's finite number or date; None where it is neither."""
    if isinstance(cell, datetime):
        return cell
    try:
        value = float(cell)
    except (TypeError, ValueError):
        return _date(cell)
    if not np.isfinite(value):
        return None
    return value


def _date(cell: Any) -> datetime | None:
    try:
        return datetime.fromisoformat(str(cell).strip())
    except ValueError:
        return None
