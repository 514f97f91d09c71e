"""Text for readers: tables, lists, rounded figures, one-line representations of objects, and progress bars."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from html import escape
from importlib import metadata
from importlib.util import find_spec
from io import StringIO
from typing import Any
from unicodedata import category

BOX = "max-height: 24em; max-width: 100%; width: fit-content; overflow: auto; border: thin solid #8886"
"""Style of a table in a notebook: a long one scrolls."""
MOST = 60  # rows of a table in a notebook
LONGEST = 60  # characters of a title in one line


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a plain-text table; the first column is aligned left, the others right."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    grid = Table(*header, box=SIMPLE_HEAD, pad_edge=False)
    for column in grid.columns[1:]:
        column.justify = "right"
    for row in rows:
        grid.add_row(*row)
    stream = StringIO()
    Console(file=stream, width=120, color_system=None, markup=False, force_jupyter=False).print(grid)
    return "\n".join(line.rstrip() for line in stream.getvalue().strip("\n").splitlines() if line.strip())


def visible(text: str) -> str:
    r"""Return untrusted text for a terminal: non-printable characters are escaped (``\x1b``)."""
    return "".join(
        c if c.isprintable() or c == "\n" or category(c) == "Zs" else c.encode("unicode_escape").decode("ascii")
        for c in text
    )


def listed(items: Sequence[str], most: int = 8, between: str = ", ") -> str:
    """Return the first items separated by commas, and the number of the others."""
    more = f" and {len(items) - most} more" if len(items) > most else ""
    return between.join(items[:most]) + more


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table; the first column is aligned left, the others right."""
    lines = [header, [":--", *["--:"] * (len(header) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def html_table(header: Sequence[str], rows: Sequence[Sequence[str]], notes: Sequence[str] = (), title: str = "") -> str:
    """Return a table for a notebook as HTML, with a title above it and notes below it; all texts are escaped."""
    columns = "".join(f'<th scope="col">{escape(name)}</th>' for name in header)
    body = "".join(
        f'<tr><th scope="row">{escape(first)}</th>{"".join(f"<td>{escape(cell)}</td>" for cell in cells)}</tr>'
        for first, *cells in rows
    )
    above = f"<p><b>{escape(title)}</b></p>" if title else ""
    below = "".join(f"<p>{escape(note)}</p>" for note in notes)
    table = f"<table><thead><tr>{columns}</tr></thead><tbody>{body}</tbody></table>"
    return f'<div>{above}<div style="{BOX}">{table}</div>{below}</div>'


def three_digits(value: float) -> str:
    """Return a number with three significant digits, and without an exponent if it is large."""
    rounded = float(f"{value:.3g}")
    return f"{rounded:g}" if abs(rounded) < 1000 else f"{rounded:,.0f}"


def joined(parts: Sequence[str]) -> str:
    """Return parts as an English list: ``a, b and c``."""
    *before, last = parts
    return f"{', '.join(before)} and {last}" if before else last


def percent(share: float) -> str:
    """Return a share as a text: ``95 %``, ``99.9 %``."""
    return f"{100 * share:.4g} %"


def counted(count: int, word: str) -> str:
    """Return a number with a word: ``1 row``, ``3 rows``."""
    return f"1 {word}" if count == 1 else f"{count} {word}s"


def shortened(text: str) -> str:
    """Return the beginning of a title."""
    return text if len(text) <= LONGEST else text[: LONGEST - 3] + "..."


def version_of(package: str) -> str:
    """Return the version of an installed package, or of this package in a checkout."""
    return str(sys.modules["rpim_opt"].__version__) if package == "rpim-opt" else metadata.version(package)


class Brief:
    """Base class with a one-line representation; `_short` returns that line without the class name."""

    def _short(self) -> str:
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._short()}>"


class Tabled(Brief):
    """Base class of objects with a table: `_frame_rows` returns its rows by column names with units."""

    def _frame_rows(self) -> list[dict[str, Any]]:
        raise NotImplementedError

    def _notes(self) -> Sequence[str]:
        """Return the sentences below the table."""
        return ()

    def to_frame(self) -> Any:
        """Return the table as a data frame (pandas, or polars if pandas is not installed)."""
        from rpim_opt.basics.tables import frame_of

        return frame_of(self._frame_rows())

    def _repr_html_(self) -> str:
        rows = self._frame_rows()
        notes = list(self._notes())
        if len(rows) > MOST:
            notes.insert(0, f"... and {len(rows) - MOST} more rows.")
        head = [key for key in next(iter(rows), {}) if any(row[key] is not None for row in rows)]
        cells = [[_cell(row[key]) for key in head] for row in rows[:MOST]]
        return html_table(head, cells, notes, f"{type(self).__name__} {self._short()}")


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return ", ".join(map(_cell, value))
    return str(value)


Progress = Callable[[int, int], None]  # receives how many of how many are done


@contextmanager
def progress_bar(name: str, wanted: bool | Progress = True) -> Iterator[Progress]:
    """Provide a function of the number done and the total: the user's, or a bar on a terminal or in a notebook."""
    if callable(wanted):
        yield wanted
        return
    from rich import progress
    from rich.console import Console

    console = Console(stderr=True)
    columns = (name, progress.BarColumn(), progress.MofNCompleteColumn(), progress.TimeRemainingColumn())
    drawable = console.is_jupyter and find_spec("ipywidgets") is not None  # which rich asks for, with a warning
    visible = wanted and (console.is_terminal or drawable)
    with progress.Progress(*columns, console=console, transient=True, disable=not visible) as bar:
        task = bar.add_task(name, total=None)
        yield lambda done, every: bar.update(task, completed=done, total=every)
