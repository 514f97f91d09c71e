"""Where a table's header and rows are among the cells of a file, and numbers without decimal commas and thousands."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.grids import Grid, read_grid
from rpim_opt.basics.numerals import decimal_mark, is_missing, is_numeral, plain, with_units
from rpim_opt.basics.shape import Columns
from rpim_opt.basics.tables import read_columns
from rpim_opt.basics.text import listed
from rpim_opt.basics.units import UNITS

FULL = 0.6
"""A row belongs to the data if it has this part of the numbers of the fullest row."""
MOSTLY = 0.8
"""A column is one of numbers if this part of its cells are."""
LINES_OF_HEADER = 4
MOST_NAMED = 5
"""Lines that are left out and named one by one."""
SUMMARIES = frozenset({
    "mean", "average", "avg", "std", "std dev", "stddev", "stdev", "sigma", "min", "max", "minimum", "maximum", "range",
    "rms", "sum", "total", "median", "mittelwert", "mittel", "summe", "moyenne",
})  # fmt: skip
"""What a row begins with that is no measurement."""
COMMENT = ("//", "#", "%", "!", "*")
"""What a line begins with that other programs skip."""
UNIT_SIGNS = frozenset({
    *UNITS, "°", "grad", "degree", "degrees", "radian", "radians", "inch", "in", "cm", "gon", "µm", "μm", "nm", "n.m",
    "n·m", "-", "s", "1",
})  # fmt: skip
"""What stands in a line of units."""


@dataclass(frozen=True)
class Layout:
    """What a user states of a raw table; what is empty is found in the file.

    Parameters
    ----------
    sheet
        An Excel sheet's name, or its number from 1.
    encoding, separator, decimal
        Of a text file: ``"cp1252"``, ``"semicolon"``, ``","``.
    columns
        The columns' names, instead of a header; a column called ``-`` is left out.

    Examples
    --------
    >>> from rpim_opt.basics.layouts import Layout
    >>> Layout(columns=("label", "q1_deg", "x_mm")).columns[1]
    'q1_deg'
    """

    sheet: str = ""
    encoding: str = ""
    separator: str = ""
    decimal: str = ""
    columns: tuple[str, ...] = ()


class Head(NamedTuple):
    """What stands above a column: the name itself, what groups it, and its unit."""

    name: str
    group: str = ""
    unit: str = ""

    def __str__(self) -> str:
        """Return it as one name."""
        unit = f" [{self.unit}]" if self.unit else ""
        return f"{self.group} {self.name}".strip() + unit


@dataclass(frozen=True)
class RawTable:
    """A table as its file has it, numbers as Python writes them.

    Parameters
    ----------
    columns
        Cells by what stands above them; a name that is there again has its place behind it, ``X #7``.
    heads
        The same taken apart.
    notes
        How it was read, and what was left out, a sentence each.
    """

    columns: Columns
    heads: dict[str, Head] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def read_raw(path: Path, layout: Layout | None = None) -> RawTable:
    r"""Return the table of a file as people have them: text of any kind, Excel, Parquet.

    Raises
    ------
    InputError
        For a file that cannot be read, and a table without header of which no columns are stated.

    Examples
    --------
    >>> from pathlib import Path
    >>> from rpim_opt.basics.layouts import read_raw
    >>> text = "Cell 7;;;\nJoints;;Position;\nJ1;J2;X;Y\n[deg];[deg];[mm];[mm]\n1,5;2;3;4\n"
    >>> _ = Path("raw.csv").write_text(text)
    >>> raw = read_raw(Path("raw.csv"))
    >>> list(raw.columns), raw.columns["Joints J1 [deg]"]
    (['Joints J1 [deg]', 'Joints J2 [deg]', 'Position X [mm]', 'Position Y [mm]'], ['1.5'])
    """
    layout = layout or Layout()
    try:
        if path.suffix.lower() == ".parquet":
            return RawTable(read_columns(path))
        grid = read_grid(path, layout.sheet, layout.encoding, layout.separator)
        return raw_table(grid, layout)
    except InputError as error:
        raise error.within(path) from None


def raw_table(grid: Grid, layout: Layout) -> RawTable:
    """Return the table among the rows of a file."""
    counts = [_count(row) for row in grid.rows]
    most = max(counts, default=0)
    if not grid.rows:
        raise InputError("the table", "an empty file", "a header and at least one row")
    if most < 2:
        raise InputError("the table", "a header and no rows", "at least one row of numbers")
    full = _without_numbered_header([i for i, count in enumerate(counts) if count >= FULL * most], grid.rows)
    heads, above = _heads(grid, full, layout)
    rows, notes = _data(grid, full, above)
    _require_width(rows, len(heads), grid, layout)
    columns, heads = _columns(rows, heads)
    columns, mark = _plain(columns, layout.decimal)
    columns, heads = _without_units(columns, heads)
    if mark == ",":
        how = "as stated" if layout.decimal else "no comma can part thousands"
        notes.append(f"decimal commas: {how}.")
    return RawTable(columns, heads, (*grid.notes, *_about_header(grid, above, layout), *notes))


def _count(row: Sequence[str]) -> int:
    """Return how many cells of a row are numbers, or say that there is none where one could be."""
    numbers = sum(map(_has_number, row))
    if not numbers:
        return 0
    return numbers + sum(bool(cell) and is_missing(cell) for cell in row)


def _has_number(cell: str) -> bool:
    """Return whether a cell is a number, perhaps with its unit."""
    if is_numeral(cell):
        return True
    found = with_units([cell])
    return found is not None and found[1].lower() in UNIT_SIGNS


def _without_numbered_header(full: list[int], rows: Sequence[Sequence[str]]) -> list[int]:
    """Return the rows of numbers without a header that numbers its joints, 1 2 3 4 5 6 X Y Z."""
    while len(full) > 1:
        pairs = zip(rows[full[0]], rows[full[1]], strict=False)
        words = sum(cell[:1].isalpha() and is_numeral(below) for cell, below in pairs)
        if words < 2:
            break
        full = full[1:]
    return full


def _heads(grid: Grid, full: Sequence[int], layout: Layout) -> tuple[list[Head], list[int]]:
    """Return what stands above every column, and the numbers of the rows of the header."""
    width = Counter(len(grid.rows[i]) for i in full).most_common(1)[0][0]
    above = _header_rows(grid.rows, full[0], width)
    if layout.columns:
        return [Head(name) for name in layout.columns], above
    if not above:
        found = f"no header above '{', '.join(grid.rows[full[0]][:4])}, ...'"
        accepted = f"a header, or --columns with {width} names, such as label,q1_deg,...,x_mm,y_mm,z_mm"
        raise InputError(f"line {grid.lines[full[0]]}", found, accepted)
    header = [_uncommented(grid.rows[i], width) for i in above]
    return _named(header, max(map(len, header))), above


def _header_rows(rows: Sequence[Sequence[str]], first: int, width: int) -> list[int]:
    """Return the rows of text directly above the data that are as wide as these."""
    found: list[int] = []
    for i in reversed(range(max(first - LINES_OF_HEADER, 0), first)):
        row = _uncommented(rows[i], width)
        filled = [place for place, cell in enumerate(row, start=1) if cell]
        if not any(map(str.isalpha, "".join(row))):
            continue  # a line of dashes
        wide = len(filled) >= width / 2 or (len(filled) > 1 and filled[-1] > width / 2)
        if not wide or len(row) > width + 1:
            break
        found.insert(0, i)
    return found


def _uncommented(row: Sequence[str], width: int) -> list[str]:
    """Return a row without the sign that makes it a comment."""
    cells = list(row)
    for sign in COMMENT:
        if cells and cells[0].startswith(sign):
            cells[0] = cells[0].removeprefix(sign).strip()
            if not cells[0] and len(cells) > width:
                return cells[1:]
    return cells


def _named(header: Sequence[Sequence[str]], width: int) -> list[Head]:
    """Return the heads of columns from up to four lines: groups, names, units."""
    lines = [[*row, *[""] * (width - len(row))] for row in header]
    units = [""] * width
    if len(lines) > 1 and _is_units(lines[-1]):
        units = [cell.strip("[]()") for cell in lines.pop()]
    names = lines.pop()
    groups = [_spread(line) for line in lines]
    heads = []
    for j, name in enumerate(names):
        group = " ".join(line[j] for line in groups if line[j])
        unit = units[j] if units[j] not in ("-", "1") else ""
        heads.append(Head(name, group, unit))
    return heads


def _is_units(row: Sequence[str]) -> bool:
    cells = [cell.strip("[]()").lower() for cell in row if cell]
    return bool(cells) and all(cell in UNIT_SIGNS for cell in cells)


def _spread(line: Sequence[str]) -> list[str]:
    """Return a line in which merged cells have the text of their first."""
    spread: list[str] = []
    for cell in line:
        spread.append(cell or (spread[-1] if spread else ""))
    return spread


def _data(grid: Grid, full: Sequence[int], above: Sequence[int]) -> tuple[list[list[str]], list[str]]:
    """Return the rows of data, and what was left out below the header."""
    summing = [i for i in full if _first(grid.rows[i]).lower().rstrip(":") in SUMMARIES]
    notes = _between(grid, full, above)
    notes += [f"line {grid.lines[i]} sums others up: left out '{_first(grid.rows[i])}'." for i in summing]
    kept = sorted(set(full) - set(summing))
    return [grid.rows[i] for i in kept], notes


def _first(row: Sequence[str]) -> str:
    return next(cell for cell in row if cell)


def _between(grid: Grid, full: Sequence[int], above: Sequence[int]) -> list[str]:
    """Say which lines below the header are no rows of data: the header once more, and others."""
    header = [grid.rows[i] for i in above]
    below = sorted(set(range(full[0], len(grid.rows))) - set(full))
    again = [i for i in below if grid.rows[i] in header]
    others = [i for i in below if grid.rows[i] not in header]
    notes = []
    if again:
        notes.append(f"the header stands there again in {_lines(grid, again)}: left out.")
    for i in others[:MOST_NAMED]:
        text = ", ".join(cell for cell in grid.rows[i] if cell)
        notes.append(f"line {grid.lines[i]} is no row of the table: left out '{text[:60]}'.")
    if len(others) > MOST_NAMED:
        notes.append(f"{len(others) - MOST_NAMED} more lines are no rows of the table: left out.")
    return notes


def _lines(grid: Grid, rows: Sequence[int]) -> str:
    return "line " + listed([str(grid.lines[i]) for i in rows])


def _require_width(rows: Sequence[list[str]], width: int, grid: Grid, layout: Layout) -> None:
    """Refuse rows that are longer than the header; blank cells at the end may be missing or too many."""
    for row in rows:
        while len(row) > width and not row[-1]:
            row.pop()
        if len(row) != width and not (len(row) < width and layout.separator == "" and _short(row, width)):
            where = f"row {rows.index(row) + 1} ({row[0]})"
            what = "--columns" if layout.columns else "the header"
            hint = "" if len(row) < width else "; decimal commas between commas need quotes"
            raise InputError(where, f"{len(row)} cells", f"{width} cells as in {what}{hint}")
        row += [""] * (width - len(row))


def _short(row: Sequence[str], width: int) -> bool:
    """Return whether a row may lack its last cells: a remark that is not there, not a value."""
    return len(row) == width - 1 and width > 2


def _columns(rows: Sequence[Sequence[str]], heads: Sequence[Head]) -> tuple[dict[str, list[str]], dict[str, Head]]:
    """Return the columns by unique names; those without name and cells are no columns."""
    columns: dict[str, list[str]] = {}
    named: dict[str, Head] = {}
    for j, head in enumerate(heads):
        cells = [row[j] for row in rows]
        if str(head) == "-" or (not head.name and not any(cells)):
            continue
        key = str(head) if head.name else f"column {j + 1}"
        if key in columns:
            key = f"{key} #{j + 1}"
        columns[key] = cells
        named[key] = head
    return columns, named


def _plain(columns: dict[str, list[str]], decimal: str) -> tuple[dict[str, list[str]], str]:
    """Return the columns with decimal points, and the mark that they had."""
    numeric = {name: cells for name, cells in columns.items() if _is_numeric(cells)}
    if decimal and decimal not in (",", "."):
        raise InputError("--decimal", f"'{decimal}'", "a comma or a point")
    mark = decimal_mark(numeric.values(), decimal)
    changed = {name: [plain(cell, mark) for cell in cells] for name, cells in numeric.items()}
    return {**columns, **changed}, mark


def _is_numeric(cells: Sequence[str]) -> bool:
    numbers = sum(map(is_numeral, cells))
    return numbers > 0 and numbers >= MOSTLY * sum(not is_missing(cell) for cell in cells)


def _without_units(
    columns: dict[str, list[str]], heads: dict[str, Head]
) -> tuple[dict[str, list[str]], dict[str, Head]]:
    """Return columns whose cells carry a unit as numbers with the unit in the head."""
    bare = dict(columns)
    named = dict(heads)
    for name, cells in columns.items():
        found = with_units(cells) if not _is_numeric(cells) else None
        if found is not None and found[1].lower() in UNIT_SIGNS:
            bare[name] = [plain(cell, ".") for cell in found[0]]
            named[name] = heads[name]._replace(unit=found[1])
    return bare, named


def _about_header(grid: Grid, above: Sequence[int], layout: Layout) -> Iterator[str]:
    """Say where the header is, unless it is the first line alone."""
    if layout.columns:
        yield "names of columns as stated" + (f", instead of {_lines(grid, above)}." if above else ".")
    elif len(above) > 1:
        yield f"the header has {len(above)} lines, from line {grid.lines[above[0]]}."
    skipped = list(range(above[0])) if above else []
    if skipped:
        text = " ".join(grid.rows[0])[:50]
        yield f"{len(skipped)} lines above the header are left out ('{text}' ...)."


def missing_rows(columns: Columns, names: Sequence[str]) -> list[int]:
    """Return the rows (from 0) in which all of some columns have no value.

    >>> from rpim_opt.basics.layouts import missing_rows
    >>> missing_rows({"x": ["1", "-"], "y": ["2", ""]}, ["x", "y"])
    [1]
    """
    if not names:  # nor columns, perhaps
        return []
    count = len(columns[names[0]])
    return [i for i in range(count) if all(is_missing(str(columns[name][i])) for name in names)]
