"""Tables as text and for notebooks."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from io import StringIO
from unicodedata import category

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a plain-text table; the first column is aligned left, the others right."""
    grid = Table(*header, box=SIMPLE_HEAD, pad_edge=False)
    for column in grid.columns[1:]:
        column.justify = "right"
    for row in rows:
        grid.add_row(*row)
    stream = StringIO()
    Console(file=stream, width=120, color_system=None, markup=False, force_jupyter=False).print(grid)
    return "\n".join(line.rstrip() for line in stream.getvalue().strip("\n").splitlines() if line.strip())


def visible(text: str) -> str:
    r"""Return a text for a terminal: what is not printable but a line break is written out, ``\x1b`` for escape.

    Titles, sources, labels and file names may come from somebody else, and a terminal obeys what they say.
    """
    return "".join(map(_visible, text))


def _visible(character: str) -> str:
    if character.isprintable() or character == "\n" or category(character) == "Zs":
        return character
    return character.encode("unicode_escape").decode("ascii")


def listed(items: Sequence[str], most: int = 8, between: str = ", ") -> str:
    """Return the first items in a line, and how many more there are."""
    more = f" and {len(items) - most} more" if len(items) > most else ""
    return between.join(items[:most]) + more


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table; the first column is aligned left, the others right."""
    lines = [header, [":--", *["--:"] * (len(header) - 1)], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


BOX = "max-height: 24em; max-width: 100%; width: fit-content; overflow: auto; border: thin solid #8886"
"""Style of a table in a notebook: a long one scrolls."""


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
    """Return a figure with three digits that count, and without an exponent where it is large.

    >>> from rpim_opt.basics.text import three_digits
    >>> three_digits(0.53712), three_digits(-44.26), three_digits(852677.3)
    ('0.537', '-44.3', '853,000')
    """
    rounded = float(f"{value:.3g}")
    if abs(rounded) < 1000:
        return f"{rounded:g}"
    return f"{rounded:,.0f}"


def joined(parts: Sequence[str]) -> str:
    """Return parts as an English list: ``a, b and c``.

    >>> from rpim_opt.basics.text import joined
    >>> joined(["gravity"]), joined(["a", "b", "c"])
    ('gravity', 'a, b and c')
    """
    *before, last = parts
    if not before:
        return last
    return f"{', '.join(before)} and {last}"


def percent(share: float) -> str:
    """Return a share as a text.

    >>> from rpim_opt.basics.text import percent
    >>> percent(0.95), percent(0.999)
    ('95 %', '99.9 %')
    """
    return f"{100 * share:.4g} %"
