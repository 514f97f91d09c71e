"""Cells of tables: text, Excel and Parquet files and data frames, as rows or as named columns.

What the cells mean is decided in `data.tables`. Small files can say more than memory holds, so that sizes are bounded
before and while they are read. Measured against: python-calamine reads a workbook 5 times as fast as openpyxl, and ends
the process where a file of 5 kB has a cell in its last row (it allocates the whole sheet); charset-normalizer reads
``J1 [°]`` in Windows-1252 as Chinese in UTF-16.
"""

from __future__ import annotations

import codecs
import contextlib
import csv
import io
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from itertools import islice
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np

from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.files import LARGEST_DATA, read_bytes, read_text, require_file
from rpim_opt.basics.units import numeral

WIDEST = 1000
"""Columns that a table may have: with all covariances of a pose and many joints it has a hundred."""
MOST_CELLS = 2**27
"""Cells that a Parquet file may have: ten million rows of a dozen columns."""
MOST_TEXT = 2**27
"""Bytes of texts that a Parquet file may have, which a dictionary of one value repeats in every row."""
LARGEST_WORKBOOK = 2**27
"""Bytes that a workbook may unpack to: some three hundred thousand rows."""
EXCEL_ROWS = 2**20
SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "bar": "|", "space": " "}
"""What may stand between cells, by name; a space stands for any number of them."""
SAMPLE = 200
"""Lines from which the separator is found."""
LONGEST = 2**16
"""Characters of these lines; a line of a hundred thousand cells is not looked at whole."""
TEXTS = (".csv", ".txt", ".tsv", ".dat", ".asc", ".xyz", ".pts")
EXCEL = (".xlsx", ".xlsm")
NUMERAL = re.compile(r"[+-]?(?:\d[\d.,]*|[.,]\d+)(?:[eE][+-]?\d+)?")
THOUSANDS = re.compile(r"(?<=\d)['\u2019\u00a0\u202f](?=\d{3}(?!\d))")
"""Signs between thousands that are no decimal marks."""
OPEN = re.compile(r"[\[({][\s\d.+\-\[({]")
"""How a cell of several numbers begins."""
ONE_READ = 2**20
ZEROS = bytes(8)
"""No text has so many zeros in a row, in whatever encoding."""
BRACKETS = frozenset("[({")
ROW_OF_NUMBERS = 1 / 3
"""Part of a row's cells that are numbers, from which on it tells what separates them."""
BLANKS_CLEARLY = 1.5
"""Blanks separate cells where they part so many times more numbers than any sign does: a label may hold some."""
FORMULA = re.compile(r"'*[=+\-@\t\r\uff1d\uff0b\uff0d\uff20]")
"""What a spreadsheet computes, be it behind apostrophes that keep it from that."""
BYTE_ORDER_MARKS = (  # that of UTF-32 begins as UTF-16's does
    (codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF32_LE, "utf-32"), (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"),
)  # fmt: skip
Columns = Mapping[str, Sequence[Any]]
"""Column name to its cells: text from a text or Excel file, whatever the table holds elsewhere."""


@dataclass(frozen=True)
class Grid:
    """The rows of a file: texts of those that are not blank, their line in the file (from 1), how it was read.

    ``blanks`` tells that blanks separate the cells, so that no cell can be empty.
    """

    rows: list[list[str]]
    lines: list[int]
    notes: tuple[str, ...] = ()
    blanks: bool = False


# --- what has the shape that problem folders have ------------------------------------------------------------------


def read_columns(source: Any) -> Columns:
    """Return the columns of a table whose first row is its header.

    Parameters
    ----------
    source
        A path (``.csv`` in UTF-8 with commas, ``.parquet``, ``.xlsx``), a pandas, polars or similar data frame, or a
        mapping from column names to cells.

    Raises
    ------
    InputError
        If there is no such file, it cannot be read as what its name says, or the table has no rows, a column
        twice, or rows of different lengths.
    """
    columns = _file(Path(source)) if isinstance(source, str | Path) else _frame(source)
    if not columns:
        raise InputError("the table", "an empty table", "at least one row")
    if not len(next(iter(columns.values()))):
        raise InputError("the table", "a header and no rows", "at least one row")
    return columns


def _file(path: Path) -> Columns:
    readers = {".csv": _csv, ".parquet": read_parquet, ".xlsx": lambda file: _rectangle(_excel(file).rows)}
    kind = path.suffix.lower()
    if kind not in readers:
        raise InputError("the file's name", f"'{path.name}'", "a name ending in " + ", ".join(readers), path)
    require_file(path, LARGEST_DATA, list(readers))
    return readers[kind](path)


def _frame(source: Any) -> Columns:
    """Return the columns of a data frame or a mapping."""
    names = list(getattr(source, "column_names", getattr(source, "columns", source)))
    for name in names:
        if not isinstance(name, str):
            raise InputError("the header", f"column {name!r}", "texts as names, every one once")
    _require_names(names)
    return {name.strip(): source[name] for name in names}


def _csv(path: Path) -> Columns:
    text = read_text(path, LARGEST_DATA).lstrip("\ufeff")  # files put together have more than one mark
    rows, _ = _split(text, ",")
    rows = [[_without_apostrophe(cell) for cell in row] for row in rows]
    if rows and len(rows[0]) == 1 and any(mark in rows[0][0] for mark in ";\t"):
        raise InputError("the header", "one column with semicolons or tabs", "columns separated by commas")
    return _rectangle(rows)


def _rectangle(rows: Sequence[Sequence[str]]) -> Columns:
    """Return the columns of rows of text; the first row is the header."""
    if not rows:
        raise InputError("the table", "an empty file", "a header and at least one row")
    header, *body = rows
    _require_names(header)
    for number, row in enumerate(body, start=1):
        if len(row) != len(header):
            accepted = f"{len(header)} cells as in the header"
            raise InputError(f"row {number} ({row[0][:40]})", f"{len(row)} cells", accepted)
    return {name: [row[i] for row in body] for i, name in enumerate(header)}


def _require_names(header: Sequence[str]) -> None:
    """Refuse a header that is too wide, or has a column without a name or twice."""
    accepted = "every column once, with its name"
    if len(header) > WIDEST:
        raise InputError("the header", f"{len(header)} columns", f"at most {WIDEST}")
    for name in header:
        if not name:
            raise InputError("the header", "a column without a name", accepted)
        if header.count(name) > 1:
            raise InputError("the header", f"column '{name[:40]}' twice", accepted)


def read_parquet(path: Path) -> Columns:
    """Return the columns of a Parquet file."""
    parquet = _library("pyarrow.parquet", "Parquet files")
    try:
        with parquet.ParquetFile(path) as file:
            metadata, schema = file.metadata, file.schema_arrow
        _require_names(schema.names)
        groups = [metadata.row_group(i) for i in range(metadata.num_row_groups)]
        cells = sum(group.column(j).num_values for group in groups for j in range(group.num_columns))
        size = sum(group.total_byte_size for group in groups)
        if max(cells, metadata.num_rows * len(schema.names)) > MOST_CELLS or size > LARGEST_DATA:
            found = f"{metadata.num_rows} rows of {len(schema.names)} columns, {size} bytes unpacked"
            raise InputError("the table", found, f"at most {MOST_CELLS} cells and {LARGEST_DATA} bytes")
        kinds = ("string", "large_string", "binary", "dictionary")
        texts = [field.name for field in schema if str(field.type).startswith(kinds)]
        with parquet.ParquetFile(path, read_dictionary=texts) as file:  # a text that is there again once
            table = file.read()
        repeated = sum(_repeated(table.column(name)) for name in texts)
        if repeated > MOST_TEXT:
            raise InputError("the table", f"{repeated} bytes of texts", f"at most {MOST_TEXT}")
        return {name: _parquet_cells(table.column(name)) for name in table.column_names}
    except (OSError, ValueError, KeyError, NotImplementedError, MemoryError) as error:  # pyarrow's derive from these
        raise InputError("the file", _first_line(error), "a readable Parquet file") from None


def _repeated(column: Any) -> int:
    """Return how many bytes the texts of a column have where each stands in every row that has it."""
    compute = import_module("pyarrow.compute")
    if str(getattr(column.type, "value_type", "")) not in ("string", "large_string", "binary"):
        return 0
    sizes = [compute.binary_length(chunk.dictionary).take(chunk.indices) for chunk in column.chunks]
    return sum(compute.sum(each).as_py() or 0 for each in sizes)


def _parquet_cells(column: Any) -> Sequence[Any]:
    """Return a column of numbers without gaps as an array, any other as a list."""
    if str(column.type).startswith("dictionary"):
        known = [chunk.dictionary.to_pylist() for chunk in column.chunks]
        indices = [chunk.indices.to_pylist() for chunk in column.chunks]
        return [None if i is None else known[k][i] for k, chunk in enumerate(indices) for i in chunk]
    numeric = str(column.type).startswith(("float", "double", "int", "uint"))
    return column.to_numpy() if numeric and not column.null_count else column.to_pylist()


# --- files as people have them -------------------------------------------------------------------------------------


def read_grid(path: Path, sheet: str = "", encoding: str = "", separator: str = "") -> Grid:
    r"""Return the rows of a text or Excel file.

    A byte order mark tells the encoding, else zeros in every other byte (UTF-16), else whether the bytes are UTF-8,
    which other encodings practically never are; else it is Windows-1252, which has Latin-1's letters. The separator is
    the one that parts most numbers from each other in the first lines.

    Parameters
    ----------
    path
        The file; its ending decides how it is read.
    sheet
        An Excel sheet's name, or its number from 1; by default the first one that has cells.
    encoding, separator
        Of a text file, where stated: ``"cp1252"``; a name of `SEPARATORS`, or the sign itself.

    Raises
    ------
    InputError
        For a file that cannot be read, a sheet that is not there, an unknown separator, a quote that does not end.

    Examples
    --------
    >>> from pathlib import Path
    >>> from rpim_opt.basics.tables import read_grid
    >>> _ = Path("points.txt").write_text("// Point X Y Z\nP1 1.5 2.5 3.5\nP2 4 5 6\n")
    >>> grid = read_grid(Path("points.txt"))
    >>> grid.rows[1], grid.notes
    (['P1', '1.5', '2.5', '3.5'], ('cells are separated by space: it parts most numbers.',))
    """
    known = (*TEXTS, *EXCEL, ".parquet")
    require_file(path, LARGEST_DATA, known)
    if path.suffix.lower() in EXCEL:
        return _excel(path, sheet)
    if sheet:
        raise InputError("--sheet", f"'{sheet}' of a text file", "an Excel workbook")
    if path.suffix.lower() not in TEXTS:
        raise InputError("the file's name", f"'{path.name}'", f"a name ending in {', '.join(known)}")
    return _text(path, encoding, separator)


def decoded(path: Path, encoding: str = "") -> tuple[str, tuple[str, ...]]:
    """Return the text of a file, whatever ends its lines, and a sentence on its encoding unless that is UTF-8.

    Raises
    ------
    InputError
        For another encoding than the stated one, and a file with zeros, which may be no longer than its hole.
    """
    with path.open("rb") as stream:  # before it is in memory
        while block := stream.read(ONE_READ):
            if ZEROS in block:
                raise InputError("the text", "bytes that are zero", "a text file, not a binary one")
    data = read_bytes(path, LARGEST_DATA)
    name, why = (encoding, "as stated") if encoding else _encoding(data)
    try:
        text = data.decode(name)
    except (ValueError, LookupError) as error:  # of the text, or of the encoding's name
        raise InputError("the text", str(error), "an encoding that fits: --encoding utf-8, cp1252, utf-16") from None
    if "\x00" in text:
        raise InputError("the text", "bytes that are zero", "a text file, not a binary one")
    text = text.replace("\u2212", "-").replace("\r\n", "\n").replace("\r", "\n")
    return text, () if name == "utf-8" else (f"read as {name}: {why}.",)


def _text(path: Path, encoding: str, separator: str) -> Grid:
    whole, said = decoded(path, encoding)
    text = THOUSANDS.sub("", whole)
    mark = SEPARATORS.get(separator, separator.replace("\\t", "\t")) if separator else _separator(text)
    if len(mark) != 1:
        raise InputError("--separator", f"'{separator}'", choices(separator, SEPARATORS))
    notes = list(said)
    if mark != ",":
        spelled = next((word for word, sign in SEPARATORS.items() if sign == mark), repr(mark))
        notes.append(f"cells are separated by {spelled}: {'as stated' if separator else 'it parts most numbers'}.")
    return Grid(*_split(text, mark), tuple(notes), mark == " ")


def _encoding(data: bytes) -> tuple[str, str]:
    """Return the encoding of a file, and why it is that one."""
    for mark, name in BYTE_ORDER_MARKS:
        if data.startswith(mark):
            return name, "byte order mark"
    sample = data[:4096]
    zeros = sample[::2].count(0), sample[1::2].count(0)
    if len(sample) > 3 and min(zeros) == 0 and max(zeros) > 0.3 * len(sample):
        return "utf-16-le" if zeros[1] else "utf-16-be", "every other byte is zero"
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252", "not UTF-8"
    return "utf-8", "valid UTF-8"


def is_numeral(cell: str) -> bool:
    """Return whether a cell is a number, with whatever decimal mark.

    >>> from rpim_opt.basics.tables import is_numeral
    >>> [is_numeral(cell) for cell in ("1.5", "-1,5", "1.234,5", "2e-3", "P1", "nan")]
    [True, True, True, True, False, False]
    """
    return NUMERAL.fullmatch(cell) is not None


def _separator(text: str) -> str:
    """Return the separator that parts most numbers in rows of numbers; a comma where none does."""
    lines = (line for line in io.StringIO(text[: SAMPLE * LONGEST]) if line.strip())
    sample = "".join(islice(lines, SAMPLE))[:LONGEST]
    rows = {mark: _split(sample, mark, strict=False)[0] for mark in SEPARATORS.values()}
    parted = {mark: sum(map(_parted, split)) for mark, split in rows.items()}
    blanks = parted.pop(" ")
    best = max(parted, key=lambda mark: parted[mark])
    if blanks > BLANKS_CLEARLY * parted[best]:
        return " "
    if not parted[best]:  # a header so wide that no row is seen
        best = max(parted, key=lambda mark: sum(map(len, rows[mark])))
    return best


def _parted(row: Sequence[str]) -> int:
    """Return how many numbers a row of numbers has; those of a cell that lists several count, too."""
    numbers = [len(list_of_numbers(cell)) or is_numeral(cell) for cell in row if cell]
    return sum(numbers) if sum(numbers) >= ROW_OF_NUMBERS * len(numbers) else 0


def list_of_numbers(cell: str) -> list[str]:
    """Return the numbers of a cell that lists several, in brackets; none for any other cell.

    >>> from rpim_opt.basics.tables import list_of_numbers
    >>> list_of_numbers("[1.5, 2, -3e-2]"), list_of_numbers("((1 2) (3 4))"), list_of_numbers("1.5")
    (['1.5', '2', '-3e-2'], ['1', '2', '3', '4'], [])
    """
    if not OPEN.match(cell) or cell[-1] not in "])}":
        return []
    parts = re.split(r"[\s\[\](){};]+" if ";" in cell else r"[\s\[\](){},]+", cell)  # else commas are decimal marks
    numbers = [part for part in parts if part]
    return numbers if len(numbers) > 1 and all(map(is_numeral, numbers)) else []


def _split(text: str, mark: str, strict: bool = True) -> tuple[list[list[str]], list[int]]:
    """Return the rows that are not blank, and their lines."""
    kept: list[list[str]] = []
    lines: list[int] = []
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=mark, strict=strict, skipinitialspace=True)
    spaced = enumerate(map(_words, text.split("\n")), start=1)
    numbered = spaced if mark == " " else ((reader.line_num, row) for row in reader)
    brackets = any(sign in text for sign in "[({")
    try:
        for number, cells in numbered:
            row = [cell.strip() for cell in cells]
            if brackets:
                row = _closed(row, mark)
            if strict and len(row) > WIDEST and any(row):
                raise InputError("the table", f"a row of {len(row)} cells", f"at most {WIDEST} columns")
            if any(row):
                kept.append(row)
                lines.append(number)
    except csv.Error as error:
        if strict:
            raise InputError(f"line {reader.line_num}", str(error), "short cells whose quotes end") from None
    return kept, lines


def _closed(row: list[str], mark: str) -> list[str]:
    """Return a row in which numbers between brackets are one cell, whatever stands between them."""
    if not any(cell[:1] in BRACKETS and OPEN.match(cell) for cell in row):
        return row
    whole: list[str] = []
    depth = 0
    for cell in row:
        if depth > 0:
            whole[-1] += mark + cell
        else:
            whole.append(cell)
        if depth > 0 or OPEN.match(cell):
            depth += sum(map(cell.count, "[({")) - sum(map(cell.count, "])}"))
    return whole if depth == 0 else row


def _words(line: str) -> list[str]:
    """Return the words of a line; a header's names may hold single spaces where wider gaps part them."""
    words = line.split()
    if sum(map(is_numeral, words)) > ROW_OF_NUMBERS * len(words):
        return words
    wide = re.split(r"\s{2,}", line.strip())
    return wide if len(wide) > 2 else words


def _excel(path: Path, sheet: str = "") -> Grid:
    """Return the rows of a sheet of an Excel workbook: the stated one, or the first that has cells."""
    openpyxl = _library("openpyxl", "Excel files")
    rows: list[tuple[int, list[str]]] = []
    try:
        with path.open("rb") as stream:
            with ZipFile(stream) as archive:  # what it says of itself is what is read of it
                size = sum(entry.file_size for entry in archive.infolist())
            if size > LARGEST_WORKBOOK:
                accepted = f"at most {LARGEST_WORKBOOK} bytes; more as .csv or .parquet"
                raise InputError("the file", f"{size} bytes unpacked", accepted)
            book = openpyxl.load_workbook(stream, read_only=True, data_only=True)
            names = [each.title for each in book.worksheets]
            chosen = ""
            for chosen in [_sheet(names, sheet)] if sheet else names:
                rows = list(_filled(book[chosen]))
                if rows:
                    break
    except InputError:
        raise
    except Exception as error:  # a broken file fails in zipfile, XML and openpyxl in many ways
        raise InputError("the file", _first_line(error), "a readable Excel workbook (.xlsx)") from None
    how = "as stated" if sheet else "the first with cells; another one by --sheet"
    notes = (f"sheet '{chosen}' of {', '.join(names)}: {how}.",) if len(names) > 1 else ()
    return Grid([row for _, row in rows], [number for number, _ in rows], notes)


def _sheet(names: Sequence[str], stated: str) -> str:
    if stated in names:
        return stated
    if stated.isdigit() and 0 < int(stated) <= len(names):
        return names[int(stated) - 1]
    raise InputError("--sheet", f"'{stated}'", choices(stated, names))


def _filled(sheet: Any) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a sheet that are not empty with their numbers; a sheet of few bytes may have cells anywhere."""
    sheet.reset_dimensions()  # what the file says of them would fill every row up
    for number, row in enumerate(sheet.iter_rows(values_only=True), start=1):
        if number > EXCEL_ROWS:
            raise InputError("the sheet", f"more than {EXCEL_ROWS} rows", "as many as Excel has")
        cells = ["" if value is None else str(value).strip() for value in row]
        while cells and not cells[-1]:
            cells.pop()
        if len(cells) > WIDEST:
            raise InputError("the table", f"a row of {len(cells)} cells", f"at most {WIDEST} columns")
        if cells:
            yield number, cells


def _library(name: str, what: str) -> Any:
    """Return a package that only some tables need, or say how to get it."""
    try:
        return import_module(name)
    except ImportError:
        raise InputError(what, f"no package {name.split('.')[0]}", "pip install 'rpim-opt[tables]'") from None


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


# --- cells ---------------------------------------------------------------------------------------------------------


def numbers(cells: Sequence[Any], labels: Sequence[str], column: str) -> np.ndarray:
    """Return cells as finite numbers (N,), or name the row whose cell is none."""
    try:
        values = np.asarray(cells)
        if values.dtype.kind in "iuf" and np.isfinite(values).all():
            return values.astype(float)
    except (TypeError, ValueError):
        pass
    return np.array([_number(cell, row, column) for cell, row in zip(cells, labels, strict=True)])


def _number(cell: Any, row: str, column: str) -> float:
    text = "" if cell is None else str(cell).strip()
    value = math.nan if isinstance(cell, bool | np.bool_) else numeral(text)
    if math.isnan(value):
        raise InputError(f"row {row}, column {column}", f"'{text[:40]}'", "a finite number")
    return value


def texts(cells: Sequence[Any], column: str) -> tuple[str, ...]:
    """Return cells as printable texts."""
    result = tuple("" if cell is None or cell != cell else str(cell).strip() for cell in cells)  # NaN is no text
    for number, text in enumerate(result, start=1):
        if not text.isprintable():
            raise InputError(f"row {number}, column {column}", repr(text[:40]), "printable text")
    return result


# --- out -----------------------------------------------------------------------------------------------------------


def csv_text(header: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """Return a table as CSV text, one line a row.

    A text that a spreadsheet would compute, ``=1+1``, gets an apostrophe before it, which `read_columns` takes away.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(_with_apostrophe(name) for name in header)
    writer.writerows([_with_apostrophe(cell) for cell in row] for row in rows)
    return stream.getvalue()


def _with_apostrophe(cell: Any) -> Any:
    """Return a cell that no spreadsheet takes for a formula; numbers may have a sign."""
    if not isinstance(cell, str) or not FORMULA.match(cell):
        return cell
    with contextlib.suppress(ValueError):
        float(cell)
        return cell
    return f"'{cell}"


def _without_apostrophe(cell: str) -> str:
    if cell.startswith("'") and FORMULA.match(cell):
        return cell[1:].strip()
    return cell


def frame_of(rows: Sequence[dict[str, Any]]) -> Any:
    """Return rows as a data frame of pandas, or of polars where that is missing.

    Raises
    ------
    InputError
        Where neither is installed.
    """
    with contextlib.suppress(ImportError):
        return import_module("pandas").DataFrame(list(rows))
    with contextlib.suppress(ImportError):
        return import_module("polars").DataFrame(list(rows), infer_schema_length=None)
    raise InputError("the data frame", "neither pandas nor polars", "pip install 'rpim-opt[studies]'")
