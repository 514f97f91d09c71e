"""Layout of raw tables: header, rows, units and number formats found among the cells of a file."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import takewhile, zip_longest
from pathlib import Path
from typing import Any

from rpim_opt.basics.exceptions import InputError, in_file, pick
from rpim_opt.basics.tables import (
    WITH_UNIT,
    Columns,
    Grid,
    array_columns,
    is_numeral,
    list_of_numbers,
    read_columns,
    read_grid,
)
from rpim_opt.basics.units import DIMENSIONS, UNIT_SIGNS, UNITS, numeral, parse_units, split

FULL = 0.6  # a data row has at least this part of the numbers of the fullest row
MOSTLY = 0.8  # a column of numbers has at least this part of numeric cells
LINES_OF_HEADER = 6
LISTS = ("columns", "constants", "joints")  # options that list names
MOST_NAMED = 5  # skipped lines that are named one by one
SUMMARIES = frozenset({
    "mean", "average", "avg", "std", "stddev", "stdev", "sigma", "min", "max", "minimum", "maximum", "range", "rms",
    "sum", "total", "median", "standarddeviation", "mittelwert", "mittel", "summe", "stdabw", "standardabweichung",
    "spannweite", "moyenne", "écarttype", "media", "média", "promedio", "gemiddelde", "ortalama", "среднее", "平均",
    "最大", "最小", "标准差", "標準偏差",
})  # fmt: skip
"""What a row begins with that is no measurement, letters alone."""
COMMENT = re.compile(r"(?:(?://|[#%!*])\s*)+")
MISSING = re.compile(r"[-\u2013\u2014*?]*|n/?a|nan|none|null|#(?:n/a|value!|ref!|div/0!)|[+-]?1\.#\w+", re.IGNORECASE)
"""Cells that mark a missing value."""
BLANK_NAME = re.compile(r"[^\s\[(]+(?:\s+\d+(?!\S))?(?:\s*[\[(][^\])]*[\])])?")
"""A name with number and unit, in a header with single blanks between and within names."""
PART_OF_PI = re.compile(r"([+-]?)\s*(?:(\d+(?:\.\d*)?)\s*\*?\s*)?(?:π|pi)\s*(?:/\s*(\d+))?", re.IGNORECASE)
"""An angle [rad] as a part of pi, ``-pi/2``."""
GROUPED = re.compile(r"[+-]?[1-9]\d{0,2}[.,]\d{3}")
"""What may be a whole number with its thousands apart, or one with three decimals."""
ACCOUNTED = re.compile(r"\(((?:\d{1,3}(?:,\d{3})+|\d+)\.\d+)\)|([\d.,]*\d[.,]\d+)-")
"""Negative numbers as accounting writes them, ``(1,079.557)`` and ``129.2-``; of brackets and commas alone: a list."""
BEYOND = {"angle": 20 * math.pi, "length": 50.0}
"""Joint values and coordinates [SI] that no table has: ten turns, and farther than instruments stand."""
AXES = {"x", "y", "z"}
PARTS = re.compile(r"(j|a|q|joint_?|axis_?)1(?: \1\d)+")
"""What tables with one row per quantity name in that row: the axes and whatever else, or joints alone, sorted."""
VALUE = re.compile(r"\b(?:value|meas\w*|actual|ist\b|mess\w*|wert|reading)", re.IGNORECASE)
"""What the column is called that holds the coordinates of a table with one row per coordinate."""
UNITS_WORD = re.compile(r"\b(?:units?|einheit(?:en)?|unités?|unidades|unità)\b", re.IGNORECASE)
"""Words before the units in a line above the header."""
JOINING = ("in", "and", "und", "et", "y", "e")
"""Words among units; ``in`` alone is inches."""


@dataclass(frozen=True)
class TableOptions:
    """Options for reading raw tables; whatever is left empty is detected from the files.

    ``sheet`` is an Excel sheet's name, or its number from 1; ``encoding``, ``separator`` and ``decimal`` are those of a
    text file: ``"cp1252"``, ``"semicolon"``, ``","``. ``columns`` are column names in place of a header; a column named
    ``-`` is left out. ``units`` are those of columns whose name has none, ``"rad,m"``, or by dimension or the columns'
    stem (`parse_units`).

    ``quaternion`` is the order of numbered components, ``"wxyz"`` or ``"xyzw"``; empty to check both against the robot.
    ``rotation`` is the meaning of rx, ry, rz: ``"vector"`` (Universal Robots), or rotations about fixed (extrinsic) or
    moving (intrinsic) axes, ``"intrinsic zyx"``; by default roll, pitch, yaw, which is ``"extrinsic xyz"``. ``prefix``
    is that of joint names in a table of several robots, ``joints`` are their names in the robot's file; ``constants``
    are values of joints that did not move and have no column, by headers with units: ``("torso_lift [m]=0.15",)``.

    ``key`` is the column that joins several files, ``"row"`` for the number of the row, and ``within`` the tolerance
    [s] if they are joined by the nearest time.

    >>> import rpim_opt as ro
    >>> options = ro.data.TableOptions(separator="semicolon", units="rad,m", quaternion="xyzw")
    >>> options.texts()
    {'separator': 'semicolon', 'units': 'rad,m', 'quaternion': 'xyzw'}
    """

    sheet: str = ""
    encoding: str = ""
    separator: str = ""
    decimal: str = ""
    columns: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    quaternion: str = ""
    rotation: str = ""
    prefix: str = ""
    constants: tuple[str, ...] = ()
    key: str = ""
    within: float | None = None
    joints: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if isinstance(self.units, str):
            object.__setattr__(self, "units", parse_units(self.units))

    @classmethod
    def stated(cls, texts: Mapping[str, str]) -> TableOptions:
        """Return the options from texts, as in ``[reading]`` of a problem file."""
        for name in texts:
            pick(cls.__dataclass_fields__, name, "key reading")
        options: dict[str, Any] = dict(texts)
        for name in LISTS:
            options[name] = tuple(filter(None, texts.get(name, "").split(",")))
        if "within" in texts:
            options["within"] = numeral(texts["within"])
        return cls(**options)

    def texts(self) -> dict[str, str]:
        """Return the options that are set as texts."""
        texts = vars(self) | {name: ",".join(getattr(self, name)) for name in LISTS}
        texts["within"] = "" if self.within is None else repr(self.within)
        texts["units"] = ",".join(unit if key in DIMENSIONS else f"{key}={unit}" for key, unit in self.units.items())
        return {name: text for name, text in texts.items() if text}


@dataclass(frozen=True)
class RawTable:
    """A table as in its file, with numbers in Python's notation.

    ``columns`` are cells by their header, ``Position X [mm]`` (a repeated name has its position appended, ``X #7``),
    ``groups`` headers of groups of columns; ``notes`` are sentences on how it was read, and what was left out;
    ``units`` are those above the header, as returned by `parse_units`; ``left`` are rows below it that are left out.
    """

    columns: Columns
    groups: Mapping[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    left: Sequence[Sequence[str]] = ()

    def with_constants(self, constants: Sequence[str]) -> RawTable:
        """Return the table with constant columns, ``torso_lift [m]=0.15``, that it does not have already."""
        columns, own = dict(self.columns), {split(name)[0] for name in self.columns}
        for text in constants:
            name, mark, value = (part.strip() for part in text.rpartition("="))
            if not mark or math.isnan(numeral(value)):
                raise InputError("constants", f"'{text}'", "COLUMN [UNIT]=NUMBER, such as 'torso_lift [m]=0.15'")
            if split(name)[0] not in own:
                columns[name] = [value] * len(next(iter(columns.values()), ()))
        return replace(self, columns=columns)


def read_table(
    path: Path, options: TableOptions | None = None, turned: Callable[[Grid], bool] = lambda grid: False
) -> RawTable:
    """Return the table of a raw file, whose rows and columns are exchanged if its grid is ``turned``."""
    options = options or TableOptions()
    readers = {".parquet": read_columns, ".mat": array_columns, ".npz": array_columns}
    reader = readers.get(path.suffix.lower())
    with in_file(path):
        if reader is not None:
            return unfolded(RawTable(reader(path)))
        grid = read_grid(path, options.sheet, options.encoding, options.separator)
        if turned(grid):
            rows = [list(cells) for cells in zip_longest(*grid.rows, fillvalue="")]
            notes = (*grid.notes, "one row per quantity: transposed.")
            grid = Grid(rows, list(range(1, len(rows) + 1)), notes)
        return unfolded(_of_grid(grid, options))


def is_missing(cell: str) -> bool:
    """Return whether a cell marks a missing value."""
    return MISSING.fullmatch(cell.strip()) is not None


def _of_grid(grid: Grid, options: TableOptions) -> RawTable:
    """Return the table in a file: the rows with most numbers, below the texts directly above them."""
    grid = _signed(grid)
    counts = [_count(row) for row in grid.rows]
    most = max(counts, default=0)
    if not grid.rows:
        raise InputError("the table", "an empty file", "a header and at least one row")
    if most < 2 and (len(counts) == 1 or 0 in counts[1:]):  # else a row a coordinate, in which names are the rest
        found = f"{len(grid.rows)} lines, none of numbers" if len(grid.rows) > 1 else "a header and no rows"
        raise InputError("the table", found, "at least one row of numbers")
    numeric = _without_numbered_header([i for i, count in enumerate(counts) if count >= FULL * most], grid.rows)
    heads, above = _heads(grid, numeric, options)
    others = () if len(heads) == len(options.columns) else options.columns  # another file's, without a header
    options = replace(options, columns=() if others else options.columns)
    full: list[int] = []
    last = ""
    for i in numeric:
        label = next(filter(None, grid.rows[i]))
        if not _summarizes(label, last):
            full.append(i)
            last = label
    stated = [(row, _stated_units(row)) for row in grid.rows[: above[0] if above else 0]]
    units = next((units for _, units in reversed(stated) if units), {})
    lines_of_units = [f"units above the header: {' '.join(filter(None, row))}." for row, of_row in stated if of_row]
    table = _columns(grid, full, heads, replace(options, units={**units, **options.units}))
    left = set(range(numeric[0], len(grid.rows))).difference(full)
    lines_of_units += [f"--columns has {len(others)} names, the header {len(heads)}, which is used."] * bool(others)
    notes = (*grid.notes, *_notes(grid, above, left, options), *lines_of_units, *table.notes)
    return replace(table, notes=notes, units=units, left=[grid.rows[i] for i in sorted(left)])


def _signed(grid: Grid) -> Grid:
    """Return a grid with the signs of accounting before its numbers, unless other numbers have them there."""
    cells = [cell for row in grid.rows for cell in row]
    example = next(filter(ACCOUNTED.fullmatch, cells), "")
    if not example or any(re.match(r"-[.,]?\d", cell) for cell in cells):
        return grid
    rows = [[ACCOUNTED.sub(r"-\1\2", cell) if ACCOUNTED.fullmatch(cell) else cell for cell in row] for row in grid.rows]
    return grid._replace(rows=rows, notes=(*grid.notes, f"numbers such as '{example}' are negative, as in accounting."))


def _summarizes(label: str, before: str) -> bool:
    """Return whether a row is no measurement: ``Mean``, or ``Mean P1`` after a row whose name begins with P1."""
    word, _, rest = label.partition(" ")
    text = word if before.startswith(rest) else label
    return "".join(filter(str.isalpha, text)).lower() in SUMMARIES


def _stated_units(row: Sequence[str]) -> dict[str, str]:
    """Return the units that a line states, ``Units: mm, deg`` or ``length unit mm, angle unit deg``, by dimension."""
    names: list[str] = []
    for text in UNITS_WORD.split(" ".join(filter(None, row)))[1:]:
        words = re.findall(r"[^\s;,:=()]+", text)
        taken = list(takewhile(lambda word: word.lower() in JOINING or split(f"x [{word}]")[1], words))
        names += [word for word in taken if word.lower() not in JOINING] or taken
    with suppress(InputError):  # units of columns, or a sentence
        return parse_units(",".join(names))
    return {}


def _count(row: Sequence[str]) -> int:
    """Return how many cells of a row are numbers or marks of a missing number."""
    numbers = sum(
        is_numeral(cell)
        or len(list_of_numbers(cell))
        or _unit_of([cell]) != ""
        or PART_OF_PI.fullmatch(cell) is not None
        for cell in row
    )
    return numbers and numbers + sum(cell != "" and is_missing(cell) for cell in row)


def _notes(grid: Grid, above: Sequence[int], left: Collection[int], options: TableOptions) -> Iterator[str]:
    """Yield notes on a header that is not the first line alone, and on lines that are left out."""
    if options.columns:
        yield "column names as requested" + (", instead of the header." if above else ".")
    elif len(above) > 1:
        yield f"the header has {len(above)} lines, from line {grid.lines[above[0]]}."
    if above and above[0]:
        count = grid.lines[above[0]] - 1  # with blank lines
        yield f"{count} lines above the header are ignored ('{' '.join(filter(None, grid.rows[0]))[:50]}' ...)."
    for i in sorted(left)[:MOST_NAMED]:
        text = ", ".join(filter(None, grid.rows[i]))
        yield f"line {grid.lines[i]} is not a row of the table: '{text[:60]}' ignored."
    if len(left) > MOST_NAMED:
        yield f"{len(left) - MOST_NAMED} more lines are not rows of the table: ignored."


# --- header --------------------------------------------------------------------------------------------------------


def _without_numbered_header(full: list[int], rows: Sequence[Sequence[str]]) -> list[int]:
    """Return the rows of numbers without those of the header: joints 1 2 3 4 5 6 X Y Z, numbers above more names."""
    while len(full) > 1:
        first, second = rows[full[0]], rows[full[1]]
        names_between = any(not _count(row) for row in rows[full[0] + 1 : full[1]])
        pairs = zip(first, second, strict=False)
        above_numbers = sum(cell[:1].isalpha() and is_numeral(below) for cell, below in pairs)
        # LabVIEW: counts and steps of the channels, above the names of columns that begin with a number or a blank
        lines = first[0][:1].isalpha() and not rows[full[-1]][0][:1].isalpha()
        lines = lines and any(not _count(row) and len(row) > 1 for row in rows[full[0] + 1 : full[-1]])
        if not (names_between and not first[0] and second[0]) and not lines and above_numbers < 2:
            break
        full = full[1:]
    return full


def _heads(grid: Grid, full: Sequence[int], options: TableOptions) -> tuple[list[tuple[str, str]], list[int]]:
    """Return every column's name with its unit, and what groups it; and the numbers of the header's rows."""
    width = Counter(len(grid.rows[i]) for i in full).most_common(1)[0][0]
    above = _header_rows(grid, full[0], width)
    if options.columns and (not above or len(options.columns) in (width, len(grid.rows[above[-1]]))):
        return [(name, "") for name in options.columns], above
    if not above:
        found = f"no header above '{', '.join(grid.rows[full[0]][:4])}, ...'"
        accepted = f"a header, or --columns with {width} names, such as label,q1_deg,...,x_mm,y_mm,z_mm"
        raise InputError(f"line {grid.lines[full[0]]}", found, accepted)
    lines = [_uncommented(grid, i, width, grid.rows[full[0]][0]) for i in above]
    width = max(map(len, lines))
    units: list[str] = []
    signs = {cell.strip("[]()").lower() for cell in lines[-1]} - {""}
    if len(lines) > 1 and signs and signs <= UNIT_SIGNS:  # a line of nothing but units
        units = [cell.strip("[]()") for cell in lines.pop()]
        units = ["" if unit in ("-", "1") else unit for unit in units]
    lacking = [""] * (width - len(units))
    units = lacking + units if grid.mark == " " else units + lacking  # a blank cell of the label cannot be seen
    *grouping, names = [[*line, *[""] * (width - len(line))] for line in lines]
    downwards = [  # merged downwards: the name stands higher up
        not name and any(row[i] and row[i + 1 : i + 2] != [""] for row in grouping) for i, name in enumerate(names)
    ]
    higher = [next(filter(None, cells), "") for cells in zip(*reversed(grouping), names, strict=True)]
    names = [top if alone else name for top, name, alone in zip(higher, names, downwards, strict=True)]
    heads = []
    groups = [""] * len(grouping)  # a cell also counts for blank ones to its right
    for name, unit, alone, *cells in zip(names, units, downwards, *grouping, strict=True):
        groups = ["" if alone else cell or group for cell, group in zip(cells, groups, strict=True)]
        heads.append((_with_unit(name, unit), " ".join(filter(None, groups))))
    return heads, above


def _with_unit(name: str, unit: str) -> str:
    """Return a name with the unit that stands elsewhere in place of its own."""
    return f"{split(name)[0]} [{unit}]" if unit else name


def _header_rows(grid: Grid, first: int, width: int) -> list[int]:
    """Return the rows of text directly above the data that are as wide as these, without a blank line among them."""
    headers: list[int] = []
    for i in reversed(range(max(first - LINES_OF_HEADER, 0), first)):
        row = _uncommented(grid, i, width, grid.rows[first][0])
        filled = [place for place, cell in enumerate(row, start=1) if cell]
        if (headers and grid.lines[i + 1] - grid.lines[i] > 1) or _stated_units(row):
            break
        if not any(sign.isalpha() or sign == "°" for sign in "".join(row)):
            continue  # a line of dashes
        wide = len(filled) >= width / 2 or (filled[-1] > width / 2 and filled[-1] > 1)
        # merged, above names: Pose, Joint values [deg]
        wide = wide or (headers and len(filled) > 1 and any(split(cell)[1] for cell in row))
        if not wide or (grid.mark and len(row) > width + 1):
            break
        headers.insert(0, i)
    return headers


def _uncommented(grid: Grid, line: int, width: int, label: str) -> list[str]:
    """Return a row without the sign that makes it a comment, and as wide as the table if names hold blanks."""
    cells = list(grid.rows[line])
    if grid.mark != " ":  # cells stand above each other
        return [COMMENT.sub("", cells[0]), *cells[1:]]
    if len(cells) > width:
        named = BLANK_NAME.findall(" ".join(cells))
        cells = named if len(named) == width else cells
    if COMMENT.match(cells[0]):
        cells[0] = COMMENT.sub("", cells[0])
        if not cells[0] and len(cells) > width:
            cells = cells[1:]
    excess = len(cells) - width  # several names, Collection Group Point, may stand above a label, A::Robot::P1
    return ["::".join(cells[: excess + 1]), *cells[excess + 1 :]] if excess == label.count("::") else cells


# --- columns and their numbers -------------------------------------------------------------------------------------


def _as_wide(grid: Grid, data: Sequence[int], width: int, options: TableOptions) -> list[list[str]]:
    """Return the rows of data as wide as the header; blank cells behind them may be missing or too many."""
    rows = [grid.rows[i] for i in data]
    what = "--columns, the names of files without a header" if options.columns else "the header"
    for number, row in enumerate(rows, start=1):
        while len(row) > width and not row[-1]:
            row.pop()
        lacks_remark = len(row) == width - 1 and width > 2 and not options.separator
        if len(row) != width and not lacks_remark and (grid.mark or len(row) > width):
            hint = "" if len(row) < width else "; if commas separate cells, decimal commas need quotes"
            raise InputError(f"row {number} ({row[0]})", f"{len(row)} cells", f"{width} cells as in {what}{hint}")
        row += [""] * (width - len(row))
    return rows


def _columns(grid: Grid, data: Sequence[int], heads: Sequence[tuple[str, str]], options: TableOptions) -> RawTable:
    """Return the columns, those of numbers with decimal points."""
    rows = _as_wide(grid, data, len(heads), options)
    columns: dict[str, list[str]] = {}
    groups: dict[str, str] = {}
    for j, (name, group) in enumerate(heads):
        cells = [row[j] for row in rows]
        full = f"{group} {name}".strip()
        if full == "-" or (not name and not any(cells)):
            continue
        unit = "" if _is_numeric(cells) else _unit_of(cells)
        if unit:
            cells = [cell.removesuffix(unit).strip() for cell in cells]
        full = _with_unit(full, unit) if name else f"column {j + 1}"
        if full in columns:
            full = f"{full} #{j + 1}"
        columns[full] = cells
        if name:
            groups[full] = group
    numeric = {name: cells for name, cells in columns.items() if _is_numeric(cells)}
    mark, notes = _decimal_mark(numeric, options)
    grouping = "," if mark == "." else "."
    for name, cells in numeric.items():
        columns[name] = [cell.replace(grouping, "").replace(mark, ".") if is_numeral(cell) else cell for cell in cells]
    return RawTable(columns, groups, notes)


def _is_numeric(cells: Sequence[str]) -> bool:
    numbers = sum(map(is_numeral, cells))
    return numbers > 0 and numbers >= MOSTLY * sum(not is_missing(cell) for cell in cells)


def _decimal_mark(columns: Mapping[str, Sequence[str]], options: TableOptions) -> tuple[str, tuple[str, ...]]:
    """Return the decimal mark of a table's numbers, and notes; a stated one decides what the numbers leave open."""
    stated = {"comma": ",", "point": "."}.get(options.decimal, options.decimal)
    if stated not in ("", ",", "."):
        raise InputError("--decimal", f"'{stated}'", "comma or point")
    grouping = "." if stated == "," else ","
    shown: dict[str, str] = {}  # the first cell with every mark
    doubtful: list[tuple[str, str]] = []  # numbers whose mark may separate thousands, with their columns
    for name, cells in columns.items():
        for cell in cells:
            mark = _mark(cell)
            if mark == grouping and GROUPED.fullmatch(cell):
                doubtful.append((name, cell))
            elif mark:
                shown.setdefault(mark, cell)
    if len(shown) > 1:
        raise InputError("the numbers", f"'{shown[',']}' and '{shown['.']}'", "one decimal mark")
    if not shown:
        beyond = [cell for name, cell in doubtful if _impossible(cell.replace(grouping, ""), name, options)]
        shown = {grouping: beyond[0]} if beyond else {}
    mark = next(iter(shown), stated)
    if doubtful and not mark:
        found = f"'{doubtful[0][1]}', whose mark may separate thousands or decimals"
        raise InputError("the numbers", found, "--decimal comma, or --decimal point")
    mark = mark or "."
    if stated and mark != stated:
        return mark, (f"--decimal {options.decimal} does not apply: found '{shown[mark]}'.",)
    why = "as requested" if stated else "no comma can be a thousands separator"
    return mark, (f"decimal commas: {why}.",) if mark == "," else ()


def _mark(cell: str) -> str:
    """Return the last mark of a number, the other one if it is there more than once alone, or an empty text."""
    last = max(cell.rfind(","), cell.rfind("."))
    if last < 0 or not is_numeral(cell):
        return ""
    mark, other = (",", ".") if cell[last] == "," else (".", ",")
    return other if other not in cell and cell.count(mark) > 1 else mark  # 1.234.567


def _impossible(number: str, name: str, options: TableOptions) -> bool:
    """Return whether a number is beyond any joint value or coordinate, in its column's unit or all that are stated."""
    own = split(name)[1]
    units = [UNITS[unit] for unit in ([own] if own else options.units.values())]
    beyond = [abs(float(number)) * unit.si > BEYOND[unit.dimension] for unit in units if unit.dimension in BEYOND]
    return bool(beyond) and all(beyond)


def _unit_of(cells: Sequence[str]) -> str:
    """Return the unit that follows all numbers; empty if they differ or have none."""
    matches = [WITH_UNIT.fullmatch(cell) for cell in cells if not is_missing(cell)]
    units = {match[2] if match else "" for match in matches}
    unit = units.pop() if len(units) == 1 else ""
    return unit if unit.lower() in UNIT_SIGNS else ""


# --- cells that list numbers, rows that hold one coordinate ----------------------------------------------------------


def unfolded(table: RawTable) -> RawTable:
    """Return a table with one number per cell and one row per point."""
    return _one_row_each(_one_number_each(table))


def _one_number_each(table: RawTable) -> RawTable:
    """Return a table with one column a number in place of every column whose cells list numbers."""
    columns: dict[str, Sequence[Any]] = {}
    groups = dict(table.groups)
    for name, cells in table.columns.items():
        counts = {len(list_of_numbers(cell)) for cell in cells if isinstance(cell, str) and not is_missing(cell)}
        if len(counts) != 1 or counts == {0}:
            columns[name] = cells
            continue
        stem, unit = split(name)
        rows = [list_of_numbers(str(cell)) for cell in cells]
        for i, part in enumerate(_parts(stem, counts.pop())):
            new = _with_unit(part, unit) if part.startswith("joint") else part
            if part in "xyz":
                new = f"{stem} {_with_unit(part, unit)}"
                groups[new] = stem
            if new in columns:
                raise InputError("the header", f"two lists of {new}, one of them in '{name}'", "one of them")
            columns[new] = [numbers[i] if numbers else "" for numbers in rows]
    return replace(table, columns=columns, groups=groups)


def _parts(stem: str, count: int) -> Sequence[str]:
    """Return names for the numbers in a column whose cells list several."""
    turns = re.search(r"rot|orient|rpy|euler|quat", stem, re.IGNORECASE)
    if count == 3 and not re.search(r"joint|axes|angle", stem, re.IGNORECASE):
        return ("rx", "ry", "rz") if turns else "xyz"
    if count == 4 and turns:
        return [f"quat_{i}" for i in range(4)]
    if count in (9, 12, 16):
        width = 4 if count > 9 else 3
        return [f"m{i // width}{i % width}" for i in range(count)]
    return [f"joint {i}" for i in range(1, count + 1)]


def _one_row_each(table: RawTable) -> RawTable:
    """Return a table whose rows hold a coordinate, ``P1, X, 1.5``, or a joint and one per point; others as is."""
    axis = next((name for name, cells in table.columns.items() if _are_parts(cells)), "")
    if not axis:
        return table
    texts = {name: [str(cell).strip() for cell in cells] for name, cells in table.columns.items()}
    letters = texts.pop(axis)
    parts = sorted({*letters})
    texts = {name: _without_letters(cells, letters) for name, cells in texts.items()}
    points = next(filter(None, (_points(cells, letters) for cells in texts.values())), [])
    if not points:
        accepted = f"a column that names the point, with {', '.join(parts)} once for each point"
        raise InputError("the header", f"one row per coordinate ('{axis}')", accepted)
    # of columns with one text for all rows of a point, that one
    every = {name: [{cells[i] for i in rows.values()} for rows in points] for name, cells in texts.items()}
    columns = {name: [min(own) for own in each] for name, each in every.items() if max(map(len, each)) == 1}
    numeric = [name for name, cells in texts.items() if name not in columns and _is_numeric(cells)]
    value, *others = [name for name in numeric if VALUE.search(name)] or numeric or ["none"]
    if others or not numeric:
        found = f"one row per coordinate, value columns: {', '.join([value, *others])}"
        raise InputError("the header", found, "one column called value or measured, or a table with columns x, y, z")
    units = [cells for cells in texts.values() if {cell.lower() for cell in cells} <= UNIT_SIGNS]
    for part in parts:
        of_part = {cells[i] for cells in units for i, letter in enumerate(letters) if letter == part}
        unit = split(value)[1] or (of_part.pop() if len(of_part) == 1 else "")
        columns[_with_unit(part, unit)] = [texts[value][rows[part]] if part in rows else "" for rows in points]
    note = f"one row per coordinate: column '{value}' by '{axis}'."
    return replace(table, columns=columns, notes=(*table.notes, note))


def _are_parts(cells: Sequence[Any]) -> bool:
    """Return whether cells name the axes, or joints alone, of several points."""
    parts = {str(cell).strip().lower() for cell in cells}
    return len(parts) < len(cells) and (parts >= AXES or PARTS.fullmatch(" ".join(sorted(parts))) is not None)


def _without_letters(cells: list[str], letters: Sequence[str]) -> list[str]:
    """Return the names of points where every cell names the coordinate besides, ``P1.X``; others as they are."""
    pairs = zip(cells, letters, strict=True)
    named = [re.fullmatch(rf"(.+?)[\s._:-]+{re.escape(letter)}", cell, re.IGNORECASE) for cell, letter in pairs]
    return [match[1] for match in named if match] if all(named) else cells


def _points(names: Sequence[str], letters: Sequence[str]) -> list[dict[str, int]]:
    """Return the row of every point's coordinates; empty where the names are not those of points, three rows each."""
    points: dict[str, dict[str, int]] = {}
    for i, (name, letter) in enumerate(zip(names, letters, strict=True)):
        points.setdefault(name, {})[letter] = i
    alone = sum(map(len, points.values())) == len(names)
    return list(points.values()) if alone and "" not in points and len(names) > 2 * len(points) else []
