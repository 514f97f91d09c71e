"""How objects show themselves: one short line, and in a notebook a table, which is also a data frame."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rpim_opt.basics.tables import frame_of
from rpim_opt.basics.text import html_table

MOST = 60
"""Rows of a table in a notebook."""
YES_OR_NO = {True: "yes", False: "no"}
LONGEST = 60
"""Characters of a title in one line."""


class Brief:
    """What says what it is in one short line; `_short` is that line without the class's name.

    >>> import rpim_opt as ro
    >>> ro.load("position").problem.robot
    <Robot 'ABB IRB 120-3/0.58', 6 joints>
    """

    def _short(self) -> str:
        raise NotImplementedError

    def __repr__(self) -> str:
        """Return one line."""
        return f"<{type(self).__name__} {self._short()}>"


class Tabled(Brief):
    """What is a table besides: `_frame_rows` are its rows by column, whose names carry units."""

    def _frame_rows(self) -> list[dict[str, Any]]:
        raise NotImplementedError

    def _shown_rows(self) -> list[dict[str, Any]]:
        """Return the rows for a notebook, where they are others."""
        return self._frame_rows()

    def _notes(self) -> Sequence[str]:
        """Return sentences below the table."""
        return ()

    def to_frame(self) -> Any:
        """Return its table as a data frame (pandas, or polars where that is missing).

        Raises
        ------
        InputError
            Where neither is installed.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> frame = ro.load("position").problem.parameters.to_frame()
        >>> list(frame.columns)
        ['parameter', 'unit', 'nominal', 'scale', 'tolerance', 'identified']
        """
        return frame_of(self._frame_rows())

    def _repr_html_(self) -> str:
        """Return the table for a notebook."""
        return as_html(self._shown_rows(), self._notes(), f"{type(self).__name__} {self._short()}")


def as_html(rows: Sequence[dict[str, Any]], notes: Sequence[str], title: str = "") -> str:
    """Return rows as a table of HTML with a line above and sentences below; columns without any value are left out."""
    head: list[str] = []
    if rows:
        head = [key for key in rows[0] if any(row[key] is not None for row in rows)]
    cells = [[_cell(row[key]) for key in head] for row in rows[:MOST]]
    if len(rows) > MOST:
        notes = [f"... and {len(rows) - MOST} rows more.", *notes]
    return html_table(head, cells, notes=notes, title=title)


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return YES_OR_NO[value]
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return ", ".join(map(_cell, value))
    return str(value)


def counted(count: int, word: str) -> str:
    """Return a number with a word: ``1 row``, ``3 rows``."""
    if count == 1:
        return f"1 {word}"
    return f"{count} {word}s"


def shortened(text: str) -> str:
    """Return the beginning of a title."""
    if len(text) <= LONGEST:
        return text
    return text[: LONGEST - 3] + "..."
