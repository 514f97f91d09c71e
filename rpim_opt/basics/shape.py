"""How large a table may be, and what its header must have: every column once, with its name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.inputs import LARGEST_DATA

WIDEST = 1000
"""Columns that a table may have: with all covariances of a pose and many joints it has a hundred."""
MOST_CELLS = 2**27
"""Cells that a table may have: ten million rows of a dozen columns."""
Cell = TypeVar("Cell")
Columns = Mapping[str, Sequence[Any]]
"""Column name to its cells: text from a CSV file, whatever the table holds elsewhere."""


def narrow(row: list[Cell]) -> list[Cell]:
    """Return a row, unless it is wider than any table of measurements; thousands of columns would take for ever."""
    if len(row) > WIDEST:
        raise InputError("the table", f"a row of {len(row)} cells", f"at most {WIDEST} columns")
    return row


def rectangle(lines: Sequence[Sequence[str]]) -> Columns:
    """Return the columns of rows of text; the first row is the header."""
    if not lines:
        raise InputError("the table", "an empty file", "a header and at least one row")
    header = [name.strip() for name in lines[0]]
    require_names(header)
    for number, row in enumerate(lines[1:], start=1):
        if len(row) != len(header):
            accepted = f"{len(header)} cells as in the header"
            raise InputError(f"row {number} ({row[0][:40]})", f"{len(row)} cells", accepted)
    return {name: [row[i].strip() for row in lines[1:]] for i, name in enumerate(header)}


def require_names(header: Sequence[str]) -> None:
    """Refuse a header that is too wide, or has a column without a name or twice."""
    accepted = "every column once, with its name"
    if len(header) > WIDEST:
        raise InputError("the header", f"{len(header)} columns", f"at most {WIDEST}")
    for name in header:
        if not name:
            raise InputError("the header", "a column without a name", accepted)
        if header.count(name) > 1:
            raise InputError("the header", f"column '{name[:40]}' twice", accepted)


def require_size(rows: int, columns: int, size: int = 0) -> None:
    """Refuse what a small file can say and no memory can hold."""
    if rows * columns > MOST_CELLS or size > LARGEST_DATA:
        found = f"{rows} rows of {columns} columns, {size} bytes unpacked"
        raise InputError("the table", found, f"at most {MOST_CELLS} cells and {LARGEST_DATA} bytes")
