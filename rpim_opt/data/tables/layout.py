"""Where a table's header and rows are among the cells of a file, and its numbers without commas, thousands, units."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import Columns, Grid, is_numeral, read_columns, read_grid
from rpim_opt.basics.text import listed
from rpim_opt.data.tables.units import UNIT_SIGNS

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
MISSING = frozenset({"", "-", "--", "n/a", "na", "nan", "none", "null", "#n/a"})
"""How tables say that there is no value."""
GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}(?:[.,]\d{3})+")
"""What may be a whole number with its thousands apart, or one with three decimals."""
WITH_UNIT = re.compile(r"([+-]?[\d.,]+(?:[eE][+-]?\d+)?)\s*([^\d\s.,+-]\S*)")
"""A number with its unit in the cell."""


@dataclass(frozen=True)
class TableOptions:
    """What a user states of raw tables; what is empty is found in the files.

    Parameters
    ----------
    sheet
        An Excel sheet's name, or its number from 1.
    encoding, separator, decimal
        Of a text file: ``"cp1252"``, ``"semicolon"``, ``","``.
    columns
        The columns' names, instead of a header; a column called ``-`` is left out.
    units
        Of columns whose name carries none, by dimension.
    quaternion
        Order of components that are numbered, ``"wxyz"`` or ``"xyzw"``; empty to check both against the robot.
    rotation
        ``"vector"`` where rx, ry, rz are a rotation vector (Universal Robots), else roll, pitch, yaw.
    key
        The column by which several files are joined; ``"row"`` for the number of the row.
    within
        Tolerance [s] where they are joined by the nearest time.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> options = ro.data.TableOptions(separator="semicolon", units={"angle": "rad", "length": "m"}, quaternion="xyzw")
    >>> options.key
    ''
    """

    sheet: str = ""
    encoding: str = ""
    separator: str = ""
    decimal: str = ""
    columns: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    quaternion: str = ""
    rotation: str = ""
    key: str = ""
    within: float | None = None


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


def read_raw(path: Path, options: TableOptions | None = None) -> RawTable:
    r"""Return the table of a file as people have them: text of any kind, Excel, Parquet.

    Raises
    ------
    InputError
        For a file that cannot be read, and a table without header of which no columns are stated.

    Examples
    --------
    >>> from pathlib import Path
    >>> from rpim_opt.data.tables.layout import read_raw
    >>> text = "Cell 7;;;\nJoints;;Position;\nJ1;J2;X;Y\n[deg];[deg];[mm];[mm]\n1,5;2;3;4\n"
    >>> _ = Path("raw.csv").write_text(text)
    >>> raw = read_raw(Path("raw.csv"))
    >>> list(raw.columns), raw.columns["Joints J1 [deg]"]
    (['Joints J1 [deg]', 'Joints J2 [deg]', 'Position X [mm]', 'Position Y [mm]'], ['1.5'])
    """
    options = options or TableOptions()
    try:
        if path.suffix.lower() == ".parquet":
            return RawTable(read_columns(path))
        return _table(read_grid(path, options.sheet, options.encoding, options.separator), options)
    except InputError as error:
        raise error.within(path) from None


def missing_rows(columns: Columns, names: Sequence[str]) -> list[int]:
    """Return the rows (from 0) in which all of some columns have no value."""
    if not names:  # nor columns, perhaps
        return []
    rows = zip(*(columns[name] for name in names), strict=True)
    return [i for i, row in enumerate(rows) if all(_is_missing(str(cell)) for cell in row)]


def _table(grid: Grid, options: TableOptions) -> RawTable:
    """Return the table among the rows of a file."""
    counts = [_count(row) for row in grid.rows]
    most = max(counts, default=0)
    if not grid.rows:
        raise InputError("the table", "an empty file", "a header and at least one row")
    if most < 2:
        raise InputError("the table", "a header and no rows", "at least one row of numbers")
    full = _without_numbered_header([i for i, count in enumerate(counts) if count >= FULL * most], grid.rows)
    heads, above = _heads(grid, full, options)
    summing = [i for i in full if _first(grid.rows[i]).lower().rstrip(":") in SUMMARIES]
    rows = [grid.rows[i] for i in sorted(set(full) - set(summing))]
    _require_width(rows, len(heads), options)
    columns, heads = _columns(rows, heads)
    columns, mark = _plain(columns, options.decimal)
    columns, heads = _without_units(columns, heads)
    notes = [*grid.notes, *_about_header(grid, above, options), *_about_rows(grid, full, above)]
    notes += [f"line {grid.lines[i]} sums others up: left out '{_first(grid.rows[i])}'." for i in summing]
    if mark == ",":
        notes.append(f"decimal commas: {'as stated' if options.decimal else 'no comma can part thousands'}.")
    return RawTable(columns, heads, tuple(notes))


def _first(row: Sequence[str]) -> str:
    return next(cell for cell in row if cell)


def _is_missing(cell: str) -> bool:
    return cell.strip().lower() in MISSING


def _count(row: Sequence[str]) -> int:
    """Return how many cells of a row are numbers, or say that there is none where one could be."""
    numbers = sum(is_numeral(cell) or _unit_of([cell]) != "" for cell in row)
    return numbers and numbers + sum(cell != "" and _is_missing(cell) for cell in row)


# --- header --------------------------------------------------------------------------------------------------------


def _without_numbered_header(full: list[int], rows: Sequence[Sequence[str]]) -> list[int]:
    """Return the rows of numbers without a header that numbers its joints, 1 2 3 4 5 6 X Y Z."""
    while len(full) > 1:
        pairs = zip(rows[full[0]], rows[full[1]], strict=False)
        if sum(cell[:1].isalpha() and is_numeral(below) for cell, below in pairs) < 2:
            break
        full = full[1:]
    return full


def _heads(grid: Grid, full: Sequence[int], options: TableOptions) -> tuple[list[Head], list[int]]:
    """Return what stands above every column, and the numbers of the rows of the header."""
    width = Counter(len(grid.rows[i]) for i in full).most_common(1)[0][0]
    above = _header_rows(grid.rows, full[0], width)
    if options.columns:
        return [Head(name) for name in options.columns], above
    if not above:
        found = f"no header above '{', '.join(grid.rows[full[0]][:4])}, ...'"
        accepted = f"a header, or --columns with {width} names, such as label,q1_deg,...,x_mm,y_mm,z_mm"
        raise InputError(f"line {grid.lines[full[0]]}", found, accepted)
    header = [_uncommented(grid.rows[i], width) for i in above]
    width = max(map(len, header))
    lines = [[*row, *[""] * (width - len(row))] for row in header]
    units = [""] * width
    if len(lines) > 1 and _is_units(lines[-1]):
        units = [cell.strip("[]()") for cell in lines.pop()]
    names = lines.pop()
    groups = [" ".join(filter(None, parts)) for parts in zip(*map(_unmerged, lines), strict=True)] or [""] * width
    units = ["" if unit in ("-", "1") else unit for unit in units]
    return [Head(*parts) for parts in zip(names, groups, units, strict=True)], above


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


def _is_units(row: Sequence[str]) -> bool:
    cells = [cell.strip("[]()").lower() for cell in row if cell]
    return bool(cells) and all(cell in UNIT_SIGNS for cell in cells)


def _unmerged(line: Sequence[str]) -> list[str]:
    """Return a line in which merged cells have the text of their first."""
    cells: list[str] = []
    for cell in line:
        cells.append(cell or (cells[-1] if cells else ""))
    return cells


def _about_header(grid: Grid, above: Sequence[int], options: TableOptions) -> Iterator[str]:
    """Say where the header is, unless it is the first line alone."""
    if options.columns:
        yield "names of columns as stated" + (f", instead of {_lines(grid, above)}." if above else ".")
    elif len(above) > 1:
        yield f"the header has {len(above)} lines, from line {grid.lines[above[0]]}."
    if above and above[0]:
        yield f"{above[0]} lines above the header are left out ('{' '.join(grid.rows[0])[:50]}' ...)."


def _about_rows(grid: Grid, full: Sequence[int], above: Sequence[int]) -> Iterator[str]:
    """Say which lines below the header are no rows of data: the header once more, and others."""
    header = [grid.rows[i] for i in above]
    below = sorted(set(range(full[0], len(grid.rows))) - set(full))
    again = [i for i in below if grid.rows[i] in header]
    others = [i for i in below if grid.rows[i] not in header]
    if again:
        yield f"the header stands there again in {_lines(grid, again)}: left out."
    for i in others[:MOST_NAMED]:
        text = ", ".join(cell for cell in grid.rows[i] if cell)
        yield f"line {grid.lines[i]} is no row of the table: left out '{text[:60]}'."
    if len(others) > MOST_NAMED:
        yield f"{len(others) - MOST_NAMED} more lines are no rows of the table: left out."


def _lines(grid: Grid, rows: Sequence[int]) -> str:
    return "line " + listed([str(grid.lines[i]) for i in rows])


# --- columns and their numbers -------------------------------------------------------------------------------------


def _require_width(rows: Sequence[list[str]], width: int, options: TableOptions) -> None:
    """Refuse rows that are longer than the header; blank cells at the end may be missing or too many."""
    for number, row in enumerate(rows, start=1):
        while len(row) > width and not row[-1]:
            row.pop()
        lacks_remark = len(row) == width - 1 and width > 2 and not options.separator
        if len(row) != width and not lacks_remark:
            what = "--columns" if options.columns else "the header"
            hint = "" if len(row) < width else "; decimal commas between commas need quotes"
            raise InputError(f"row {number} ({row[0]})", f"{len(row)} cells", f"{width} cells as in {what}{hint}")
        row += [""] * (width - len(row))


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
    if decimal not in ("", ",", "."):
        raise InputError("--decimal", f"'{decimal}'", "a comma or a point")
    mark = _decimal_mark((cell for cells in numeric.values() for cell in cells), decimal)
    return columns | {name: [_as_python(cell, mark) for cell in cells] for name, cells in numeric.items()}, mark


def _is_numeric(cells: Sequence[str]) -> bool:
    numbers = sum(map(is_numeral, cells))
    return numbers > 0 and numbers >= MOSTLY * sum(not _is_missing(cell) for cell in cells)


def _decimal_mark(cells: Iterable[str], stated: str) -> str:
    """Return the decimal mark of a table, a comma or a point.

    Where both stand in a number, the last one is the decimal mark. Where commas alone do, one that cannot part
    thousands decides. A stated mark holds unless a number contradicts it.
    """
    found: dict[str, str] = {}
    doubtful = ""
    for cell in cells:
        mark = _mark(cell)
        if mark == "?":
            doubtful = doubtful or cell
        elif mark and GROUPED.fullmatch(found.get(mark, "1.000")):
            found[mark] = cell
    if stated:
        cell = found.get("." if stated == "," else ",", "")
        if cell and not GROUPED.fullmatch(cell):
            raise InputError("--decimal", f"'{stated}', and a number '{cell}'", "the mark that the numbers have")
        return stated
    if len(found) > 1:
        raise InputError("the numbers", f"'{found[',']}' and '{found['.']}'", "one decimal mark, or --decimal with it")
    if not found and doubtful:
        raise InputError("the numbers", f"'{doubtful}', of thousands or of decimals", "--decimal , or --decimal .")
    return next(iter(found), ".")


def _mark(cell: str) -> str:
    """Return the decimal mark that a cell shows, a question mark where it may part thousands, or nothing."""
    last = max(cell.rfind(","), cell.rfind("."))
    if last < 0 or not is_numeral(cell):
        return ""
    mark = cell[last]
    other = "," if mark == "." else "."
    if other in cell:
        return mark
    if cell.count(mark) > 1:  # 1.234.567
        return other
    return "?" if mark == "," and GROUPED.fullmatch(cell) else mark


def _as_python(cell: str, mark: str) -> str:
    """Return a numeral as Python writes it; other texts stay."""
    if not is_numeral(cell):
        return cell
    return cell.replace("," if mark == "." else ".", "").replace(mark, ".")


def _unit_of(cells: Sequence[str]) -> str:
    """Return the unit that stands behind all numbers; nothing where it is not so."""
    matches = [WITH_UNIT.fullmatch(cell) for cell in cells if not _is_missing(cell)]
    units = {match[2] if match else "" for match in matches}
    unit = units.pop() if len(units) == 1 else ""
    return unit if unit.lower() in UNIT_SIGNS else ""


def _without_units(
    columns: dict[str, list[str]], heads: dict[str, Head]
) -> tuple[dict[str, list[str]], dict[str, Head]]:
    """Return columns whose cells carry a unit as numbers with the unit in the head."""
    units = {name: _unit_of(cells) for name, cells in columns.items() if not _is_numeric(cells)}
    units = {name: unit for name, unit in units.items() if unit}
    bare = {name: [_as_python(cell.removesuffix(unit).strip(), ".") for cell in columns[name]]
            for name, unit in units.items()}  # fmt: skip
    return columns | bare, heads | {name: heads[name]._replace(unit=unit) for name, unit in units.items()}
