"""Files of cells: the rows of a text or Excel file as they stand there, before anything is made of them."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from rpim_opt.basics.encodings import decoded
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.inputs import LARGEST_DATA, read_bytes, require_file
from rpim_opt.basics.numerals import is_numeral
from rpim_opt.basics.packed import EXCEL_ROWS, library, require_unpacked
from rpim_opt.basics.shape import WIDEST, narrow

SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "bar": "|", "space": " "}
"""What may stand between cells, by name; a space stands for any number of them."""
SAMPLE = 200
"""Lines from which the separator is found."""
LONGEST = 2**16
"""Characters of these lines; a line of a hundred thousand cells is not looked at whole."""
TEXTS = (".csv", ".txt", ".tsv", ".dat", ".asc", ".xyz", ".pts")
"""Endings of text files."""
EXCEL = (".xlsx", ".xlsm")


@dataclass(frozen=True)
class Grid:
    """The rows of a file.

    Parameters
    ----------
    rows
        Cells as texts, those of the rows that are not blank; rows are as long as they are.
    lines
        The number of every row in the file, from 1.
    notes
        How it was read, a sentence each.
    """

    rows: list[list[str]]
    lines: list[int]
    notes: tuple[str, ...] = ()


def text_grid(path: Path, encoding: str = "", separator: str = "") -> Grid:
    """Return the rows of a text file.

    The separator is the one that parts most numbers from each other in the file's first lines.

    Parameters
    ----------
    path
        The file.
    encoding, separator
        What it is in, and what stands between its cells (a name of `SEPARATORS`, or the sign itself), where stated.

    Raises
    ------
    InputError
        For a file that cannot be read, an unknown separator, a quote that does not end.
    """
    text, name, why = decoded(read_bytes(path, LARGEST_DATA), encoding)
    text = text.replace("\u2212", "-").replace("\r\n", "\n").replace("\r", "\n")
    mark = _stated(separator) if separator else _found(text)
    notes = []
    if name != "utf-8":
        notes.append(f"read as {name}: {why}.")
    spelled = next((word for word, sign in SEPARATORS.items() if sign == mark), repr(mark))
    if mark != ",":
        how = "as stated" if separator else "it parts most numbers"
        notes.append(f"cells are separated by {spelled}: {how}.")
    rows, lines = _split(text, mark)
    return Grid(rows, lines, tuple(notes))


def _stated(separator: str) -> str:
    mark = SEPARATORS.get(separator, separator.replace("\\t", "\t"))
    if len(mark) != 1:
        raise InputError("--separator", f"'{separator}'", choices(separator, SEPARATORS))
    return mark


def _found(text: str) -> str:
    """Return the separator that parts most numbers; a comma where none does."""
    sample = "\n".join(islice((line for line in io.StringIO(text[: SAMPLE * LONGEST]) if line.strip()), SAMPLE))
    sample = sample[:LONGEST]
    best = ","
    most = (0, 0)
    for mark in SEPARATORS.values():
        rows = _split(sample, mark, strict=False)[0]
        count = (sum(is_numeral(cell) for row in rows for cell in row), 0)
        if not count[0] and mark != " ":  # a header so wide that no row is seen
            count = (0, sum(map(len, rows)))
        if count > most:
            best = mark
            most = count
    return best


def _split(text: str, mark: str, strict: bool = True) -> tuple[list[list[str]], list[int]]:
    """Return the rows that are not blank, and their lines."""
    if mark == " ":
        rows = [_words(line) for line in text.split("\n")]
        numbers = list(range(1, len(rows) + 1))
    else:
        rows, numbers = _delimited(text, mark, strict)
    kept = [i for i, row in enumerate(rows) if any(row)]
    wide = max((len(rows[i]) for i in kept), default=0)
    if strict and wide > WIDEST:
        raise InputError("the table", f"a row of {wide} cells", f"at most {WIDEST} columns")
    return [rows[i] for i in kept], [numbers[i] for i in kept]


def _delimited(text: str, mark: str, strict: bool) -> tuple[list[list[str]], list[int]]:
    reader = csv.reader(io.StringIO(text), delimiter=mark, strict=strict, skipinitialspace=True)
    rows: list[list[str]] = []
    numbers: list[int] = []
    try:
        for row in reader:
            rows.append([cell.strip() for cell in row])
            numbers.append(reader.line_num)
    except csv.Error as error:
        if strict:
            raise InputError(f"line {reader.line_num}", str(error), "short cells whose quotes end") from None
    return rows, numbers


def _words(line: str) -> list[str]:
    """Return the words of a line; a header's names may hold single spaces where wider gaps part them."""
    words = line.split()
    if any(map(is_numeral, words)):
        return words
    wide = re.split(r"\s{2,}", line.strip())
    return wide if len(wide) > 2 else words


def excel_grid(path: Path, sheet: str = "") -> Grid:
    """Return the rows of a sheet of an Excel workbook.

    Parameters
    ----------
    path
        The file.
    sheet
        The sheet's name, or its number from 1; by default the first one that has cells.

    Raises
    ------
    InputError
        For a workbook that cannot be read, or a sheet that is not there.
    """
    openpyxl = library("openpyxl", "Excel files")
    rows: list[tuple[int, list[str]]] = []
    try:
        with path.open("rb") as stream:
            require_unpacked(stream)
            book = openpyxl.load_workbook(stream, read_only=True, data_only=True)
            names = [each.title for each in book.worksheets]
            chosen = _sheet(names, sheet) if sheet else ""
            for name in [chosen] if chosen else names:
                rows = list(_filled(book[name]))
                chosen = name
                if rows:
                    break
    except InputError:
        raise
    except Exception as error:  # a broken file fails in zipfile, XML and openpyxl in many ways
        found = next(iter(str(error).splitlines()), type(error).__name__)
        raise InputError("the file", found, "a readable Excel workbook (.xlsx)") from None
    notes = []
    if len(names) > 1:
        how = "as stated" if sheet else "the first with cells; another one by --sheet"
        notes.append(f"sheet '{chosen}' of {', '.join(names)}: {how}.")
    return Grid([row for _, row in rows], [number for number, _ in rows], tuple(notes))


def _filled(sheet: Any) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a sheet that are not empty with their numbers; a sheet of few bytes may have cells anywhere."""
    sheet.reset_dimensions()  # what the file says of them would fill every row up
    for number, row in enumerate(sheet.iter_rows(values_only=True), start=1):
        if number > EXCEL_ROWS:
            raise InputError("the sheet", f"more than {EXCEL_ROWS} rows", "as many as Excel has")
        cells = [_cell(value) for value in row]
        while cells and not cells[-1]:
            cells.pop()
        if cells:
            yield number, narrow(cells)


def _sheet(names: Sequence[str], asked: str) -> str:
    if asked in names:
        return asked
    if asked.isdigit() and 0 < int(asked) <= len(names):
        return names[int(asked) - 1]
    raise InputError("--sheet", f"'{asked}'", choices(asked, names))


def _cell(value: object) -> str:
    return "" if value is None else str(value).strip()


def read_grid(path: Path, sheet: str = "", encoding: str = "", separator: str = "") -> Grid:
    r"""Return the rows of a text or Excel file; a file whose name says nothing of the kind is read as text.

    Raises
    ------
    InputError
        For no such file, and what `text_grid` and `excel_grid` refuse.

    Examples
    --------
    >>> from pathlib import Path
    >>> from rpim_opt.basics.grids import read_grid
    >>> _ = Path("points.txt").write_text("// Point X Y Z\nP1 1.5 2.5 3.5\nP2 4 5 6\n")
    >>> grid = read_grid(Path("points.txt"))
    >>> grid.rows[1], grid.notes
    (['P1', '1.5', '2.5', '3.5'], ('cells are separated by space: it parts most numbers.',))
    """
    require_file(path, LARGEST_DATA, (*TEXTS, *EXCEL, ".parquet"))
    if path.suffix.lower() in EXCEL:
        return excel_grid(path, sheet)
    if sheet:
        raise InputError("--sheet", f"'{sheet}' of a text file", "an Excel workbook")
    if path.suffix.lower() not in TEXTS:
        known = ", ".join((*TEXTS, *EXCEL, ".parquet"))
        raise InputError("the file's name", f"'{path.name}'", f"a name ending in {known}")
    return text_grid(path, encoding, separator)
