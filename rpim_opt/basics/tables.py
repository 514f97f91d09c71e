"""Cells of tables: text, Excel and Parquet files and data frames, as rows or as named columns.

Small files can unpack to more than memory holds, so that sizes are bounded before and while they are read.
python-calamine ends the process where a workbook of 5 kB has a cell in its last row; charset-normalizer reads
``J1 [°]`` in Windows-1252 as Chinese.
"""

from __future__ import annotations

import codecs
import contextlib
import csv
import io
import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from html import unescape
from importlib import import_module
from itertools import islice, repeat
from pathlib import Path
from string import ascii_letters
from typing import Any, BinaryIO, NamedTuple
from zipfile import BadZipFile, ZipFile

import numpy as np
import scipy

from rpim_opt.basics.exceptions import InputError, choices, pick
from rpim_opt.basics.files import LARGEST_DATA, read_bytes, read_text, require_file
from rpim_opt.basics.units import UNIT_SIGNS, numeral

WIDEST = 1000
"""Columns that a table may have: with all covariances of a pose and many joints it has a hundred."""
MOST_CELLS = 2**27
MOST_TEXT = 2**27
"""Cells of a Parquet file, and bytes of a column's texts: a dictionary of one value repeats it in every row."""
LARGEST_WORKBOOK = 2**27  # bytes that a workbook may unpack to: some three hundred thousand rows
EXCEL_ROWS = 2**20
SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t", "bar": "|", "space": " "}
"""What may stand between cells, by name; a space stands for any number of them."""
SAMPLE = 2**15  # characters from which the separator is found
TEXTS = (".csv", ".txt", ".tsv", ".dat", ".log", ".asc", ".xyz", ".pts", ".md", ".html", ".htm", ".xls", ".xml")
EXCEL = (".xlsx", ".xlsm", ".ods")
EXCEL_97, EXCEL_2003, ZIPPED = b"\xd0\xcf\x11\xe0", b"microsoft-com:office:spreadsheet", b"PK\x03\x04"
"""What workbooks begin with: old ones, those in XML, and those of today."""
BORDERS = str.maketrans("│┃║", "|||")  # lines between the columns of printed tables
NUMBERS_OF_ROW = 3  # numbers in a row from which on a sheet is one of measurements
NUMERAL = re.compile(
    r"(?!\d+([.,])(?:\d\d?|\d{4,})\1)[+-]?(?:\d+(?:[.,]\d+)*[.,]?|[.,]\d+)(?:[eE][+-]?\d+)?"
)  # no 31.05.2026
NO_NUMBER = re.compile(r"(?<=\d)['\u2019\u00a0\u202f](?=\d{3}(?!\d))|(?<=\d)[ \t]+#[^\n,;|\t]*$", re.MULTILINE)
"""Signs between thousands that are no decimal marks, and a comment behind a row."""
EITHER_SIGN = re.compile(r"±\s*(?=\d)")  # before an uncertainty, or the limits of a joint
FORTRAN = re.compile(r"(?<=\d)[dD](?=[+-]\d)")
"""The sign of an exponent of double precision, 0.15D+01."""
SEXAGESIMAL = re.compile(r"(\d+)°\s*(\d+)['\u2032]\s*(\d+(?:[.,]\d+)?)(?:\"|\u2033|'')")
"""Degrees, minutes and seconds."""
CELL = re.compile(
    r"(?i)<(?:t[hd]|table:[a-z-]*cell|(?:ss:)?cell)\b([^<>]*)>([^<]*(?:<(?!/?(?:t(?:[hdr]|able|body|foot)|(?:ss:)?cell)\b)[^<]*)*)"
)
"""What an HTML page or a sheet in XML states of a cell, and what is in it."""
NAMED_SHEET = re.compile(r'<(?:table:table|(?:ss:)?Worksheet)\s[^<>]*(?:table:n|ss:N)ame="([^"]*)')
FOREIGN = re.compile(rb"[\x80-\xff]{4,}")
"""So many letters beyond ASCII follow each other in no Western European word."""
NO_AXIS = re.compile(r"9E\+?0?9", re.IGNORECASE)  # what RAPID writes for an axis that is not there
LIST_OPENS = re.compile(r"[a-zA-Z]*[\[({][\s\d.+\-\[({]")
ENCODINGS = "--encoding with the one that fits: cp932 (Japanese), gb18030 (Chinese), cp1251 (Russian), utf-16, ..."
ZEROS = bytes(8)  # no text has so many zeros in a row, in whatever encoding
ROW_OF_NUMBERS = 1 / 3
"""Fraction of a row's cells that are numbers, from which on the row shows the separator."""
WITH_UNIT = re.compile(r"([+-]?[\d.,]+(?:[eE][+-]?\d+)?)\s*([^\d\s.,+-]\S*)")
BLANKS_CLEARLY = 1.5
"""Blanks separate cells where they part so many times more numbers than any sign does: a label may hold some."""
FORMULA = re.compile(r"'*[=+\-@\t\r\uff1d\uff0b\uff0d\uff20]")
"""What a spreadsheet computes, be it behind apostrophes that keep it from that."""
BYTE_ORDER_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
Columns = Mapping[str, Sequence[Any]]
"""Column name to its cells: text from a text or Excel file, whatever the table holds elsewhere."""


class Grid(NamedTuple):
    """The non-blank rows of a file, their line numbers, notes on reading, and what separates cells."""

    rows: list[list[str]]
    lines: list[int]
    notes: tuple[str, ...] = ()
    mark: str = ""  # of a workbook, whose rows end at their last cell that is filled


# --- tables of problem folders: a header, then rows ----------------------------------------------------------------


def read_columns(source: Any) -> Columns:
    """Return the columns of a file (.csv in UTF-8 with commas, .parquet, .xlsx), a data frame or a mapping."""
    if isinstance(source, str | Path):
        path = Path(source)
        readers = {".csv": _csv, ".parquet": _parquet, ".xlsx": lambda file: _rectangle(_excel(file, "").rows)}
        kind = path.suffix.lower()
        if kind not in readers:
            raise InputError("the file's name", f"'{path.name}'", "a name ending in " + ", ".join(readers), path)
        require_file(path, LARGEST_DATA, list(readers))
        columns = readers[kind](path)
    else:
        names = list(getattr(source, "column_names", getattr(source, "columns", source)))
        _require_names(names)
        columns = {name.strip(): source[name] for name in names}
    if not len(next(iter(columns.values()), ())):
        raise InputError("the table", "a header and no rows" if columns else "an empty table", "at least one row")
    return columns


def _csv(path: Path) -> Columns:
    text = read_text(path, LARGEST_DATA).lstrip("\ufeff")  # files put together have more than one mark
    rows, _ = _split(text, ",")
    if rows and len(rows[0]) == 1 and any(mark in rows[0][0] for mark in ";\t"):
        raise InputError("the header", "one column with semicolons or tabs", "columns separated by commas")
    return _rectangle(
        [[cell[1:].strip() if cell.startswith("'") and FORMULA.match(cell) else cell for cell in row] for row in rows]
    )


def _rectangle(rows: Sequence[Sequence[str]]) -> Columns:
    if not rows:
        raise InputError("the table", "an empty file", "a header and at least one row")
    header, *body = rows
    _require_names(header)
    for number, row in enumerate(body, start=1):
        if len(row) != len(header):
            where = f"row {number} ({row[0][:40]})"
            raise InputError(where, f"{len(row)} cells", f"{len(header)} cells as in the header")
    return {name: [row[i] for row in body] for i, name in enumerate(header)}


def _require_names(header: Sequence[Any]) -> None:
    accepted = "a unique name for every column"
    if len(header) > WIDEST:
        raise InputError("the header", f"{len(header)} columns", f"at most {WIDEST}")
    for name in header:
        if not isinstance(name, str) or not name:
            raise InputError("the header", f"column {name!r}", accepted)
        if header.count(name) > 1:
            raise InputError("the header", f"column '{name[:40]}' twice", accepted)


def _parquet(path: Path) -> Columns:
    parquet = library("pyarrow.parquet", "Parquet files")
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
        return {name: _parquet_cells(table.column(name)) for name in table.column_names}
    except (OSError, ValueError, KeyError, NotImplementedError, MemoryError) as error:  # pyarrow's derive from these
        raise InputError("the file", _first_line(error), "a readable Parquet file") from None


def _parquet_cells(column: Any) -> Sequence[Any]:
    if not str(column.type).startswith("dictionary"):
        numeric = str(column.type).startswith(("float", "double", "int", "uint"))
        return column.to_numpy() if numeric and not column.null_count else column.to_pylist()
    cells = []
    for chunk in column.chunks:
        values = chunk.dictionary.to_pylist()
        cells += [None if i is None else values[i] for i in chunk.indices.to_pylist()]
    size = sum(len(cell) for cell in cells if isinstance(cell, str | bytes))
    if size > MOST_TEXT:
        raise InputError("the table", f"{size} bytes of text", f"at most {MOST_TEXT}")
    return cells


# --- files as people have them -------------------------------------------------------------------------------------


def array_columns(path: Path) -> Columns:
    """Return the arrays of numbers of a MATLAB or NumPy file, of the most common length, as ``q_1, q_2, ...``."""
    require_file(path, LARGEST_DATA)
    accepted = "a file that MATLAB saved with -v7, or NumPy's savez, with numeric arrays, one row per configuration"
    try:
        if path.suffix.lower() == ".npz":
            with ZipFile(path) as archive:
                _require_few(sum(entry.file_size for entry in archive.infolist()) // 8)
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: np.atleast_2d(file[name].T).T for name in file.files if file[name].dtype.kind == "f"}
        else:
            shapes = {name: shape for name, shape, kind in scipy.io.whosmat(path) if kind in ("double", "single")}
            _require_few(sum(map(math.prod, shapes.values())))
            arrays = scipy.io.loadmat(path, variable_names=list(shapes)) if shapes else {}
            arrays = {name: arrays[name] for name in shapes}
    except (OSError, ValueError, TypeError, NotImplementedError, MemoryError, BadZipFile) as error:
        raise InputError("the file", _first_line(error), accepted) from None
    rows = Counter(len(array) for array in arrays.values() if array.ndim == 2 and len(array) > 1)
    columns: dict[str, Sequence[Any]] = {}
    for name, array in arrays.items():
        if rows and array.ndim == 2 and len(array) == rows.most_common(1)[0][0]:
            of_array = enumerate(array.T.tolist(), start=1)
            columns |= {f"{name}_{i}" if array.shape[1] > 1 else name: part for i, part in of_array}
    if not columns:
        raise InputError("the file", f"variables {', '.join(arrays) or 'without numbers'}", accepted)
    return columns


def _require_few(numbers: int) -> None:
    if numbers > MOST_CELLS:
        raise InputError("the file", f"more than {MOST_CELLS} numbers", "fewer")


def read_grid(path: Path, sheet: str = "", encoding: str = "", separator: str = "") -> Grid:
    """Return the rows of a text or Excel file; arguments as in `TableOptions`."""
    require_file(path, LARGEST_DATA, (*TEXTS, *EXCEL))
    with path.open("rb") as stream:
        begins = stream.read(1024)
    if begins.startswith(EXCEL_97):
        raise InputError("the file", "a workbook of Excel 97 to 2003", "one that was saved as .xlsx")
    zipped = path.suffix.lower() == ".xls" and begins.startswith(ZIPPED)
    if path.suffix.lower() in EXCEL or zipped or EXCEL_2003 in begins:
        return _excel(path, sheet)
    if sheet:
        raise InputError("--sheet", f"'{sheet}' of a text file", "an Excel workbook")
    whole, notes = decoded(path, encoding)
    if path.suffix.lower() == ".xml":
        raise InputError("the file's name", f"'{path.name}'", "a table, or a workbook that Excel saved as XML")
    if whole.lstrip().startswith("<"):
        whole = "\n".join("\t".join(_cells_of_page(row)) for row in re.split(r"(?i)<tr\b", whole)[1:])
    text = FORTRAN.sub(
        "e", NO_NUMBER.sub("", EITHER_SIGN.sub("+", SEXAGESIMAL.sub(_decimal, whole.translate(BORDERS))))
    )
    mark = SEPARATORS.get(separator, separator.replace("\\t", "\t")) if separator else _separator(text)
    if len(mark) != 1:
        raise InputError("--separator", f"'{separator}'", choices(separator, SEPARATORS))
    if mark != ",":
        spelled = next((word for word, sign in SEPARATORS.items() if sign == mark), repr(mark))
        why = "as requested" if separator else "this separates most numbers"
        notes = (*notes, f"cells are separated by {spelled}: {why}.")
    return Grid(*_split(text, mark), notes, mark)


def _cells_of_page(row: str) -> list[str]:
    """Return the cells of a row of an HTML table or of a sheet in XML, where a number is not as it is shown."""
    cells: list[str] = []
    for stated, inside in CELL.findall(row):
        place = re.search(r'ss:Index="(\d{1,4})"', stated)  # those before it are left out
        cells += [""] * (int(place[1]) - 1 - len(cells) if place else 0)
        value = re.search(r'office:value="([^"]*)', stated)
        cell = value[1] if value else " ".join(unescape(re.sub(r"<[^>]*>", " ", inside)).split())
        cells.append(cell)
        span = re.search(r"(colspan|columns-repeated|MergeAcross)\W+(\d{1,2})\b", stated, re.IGNORECASE)
        if span:
            further = int(span[2]) - (span[1] != "MergeAcross")
            cells += [cell if span[1] == "columns-repeated" else ""] * further
    return cells


def _decimal(angle: re.Match[str]) -> str:
    degrees, minutes, seconds = (float(part.replace(",", ".")) for part in angle.groups())
    return f"{degrees + minutes / 60 + seconds / 3600:.9f}"


def decoded(path: Path, encoding: str = "") -> tuple[str, tuple[str, ...]]:
    """Return the decoded text of a file, and a note on its encoding unless it is UTF-8."""
    binary = InputError("the text", "bytes that are zero", "a text file, not a binary one")
    with path.open("rb") as stream:  # before it is in memory: a file may be one long hole
        while block := stream.read(2**20):
            if ZEROS in block:
                raise binary
    data = read_bytes(path, LARGEST_DATA)
    if data.startswith((b"\x1f\x8b", b"BZh", ZIPPED)):
        raise InputError("the text", "a compressed file", "a text file: unpack it first")
    name, why = (encoding, "as requested") if encoding else _encoding(data)
    try:
        text = data.decode(name)
    except (ValueError, LookupError) as error:  # of the text, or of the encoding's name
        raise InputError("the text", str(error), ENCODINGS) from None
    if "\x00" in text:
        raise binary
    text = text.replace("\u2212", "-").replace("\r\n", "\n").replace("\r", "\n")
    return text, () if name == "utf-8" else (f"read as {name}: {why}.",)


def _encoding(data: bytes) -> tuple[str, str]:
    """Return the encoding of a file, and why; other encodings are practically never valid UTF-8 by chance."""
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
        if any(len(set(run)) > 2 for run in FOREIGN.findall(sample)):
            found = "letters that are neither UTF-8 nor Western European"
            raise InputError("the text", found, ENCODINGS) from None
        return "cp1252", "not UTF-8"
    return "utf-8", "valid UTF-8"


def is_numeral(cell: str) -> bool:
    """Return whether a cell is a number, with either decimal mark: ``-1,5``, ``1.234,5``, ``2e-3``."""
    return NUMERAL.fullmatch(cell) is not None


def _separator(text: str) -> str:
    """Return the separator between most numbers of the numeric rows; a comma if there is none."""
    rows = {mark: _split(text.lstrip()[:SAMPLE], mark, strict=False)[0] for mark in SEPARATORS.values()}
    parted = {mark: sum(map(_parted, split)) for mark, split in rows.items()}
    blanks = parted.pop(" ")
    best = max(parted, key=parted.__getitem__)
    if blanks > BLANKS_CLEARLY * parted[best]:
        return " "
    if not parted[best]:  # a header so wide that no row is seen
        best = max(parted, key=lambda mark: sum(map(len, rows[mark])))
    return best


def _parted(row: Sequence[str]) -> int:
    """Return how many numbers a row has, including those of cells that list several."""
    numbers = [len(list_of_numbers(cell)) or is_numeral(cell) or _has_unit(cell) for cell in row if cell]
    return sum(numbers) if sum(numbers) >= ROW_OF_NUMBERS * len(numbers) else 0


def _has_unit(cell: str) -> bool:
    match = WITH_UNIT.fullmatch(cell)
    return match is not None and match[2].lower() in UNIT_SIGNS


def list_of_numbers(cell: str) -> list[str]:
    """Return the numbers of a cell that lists several in brackets; empty for any other cell.

    >>> from rpim_opt.basics.tables import list_of_numbers
    >>> list_of_numbers("[1.5, 2, -3e-2]"), list_of_numbers("((1 2) (3 4))"), list_of_numbers("1.5")
    (['1.5', '2', '-3e-2'], ['1', '2', '3', '4'], [])
    """
    if not LIST_OPENS.match(cell) or cell[-1] not in "])}":
        return []
    cell = cell.lstrip(ascii_letters)  # array([1, 2, 3]), posj(1, 2, 3)
    parts = re.split(r"[\s\[\](){};]+" if ";" in cell else r"[\s\[\](){},]+", cell)  # else commas are decimal marks
    numbers = [part for part in parts if part and not NO_AXIS.fullmatch(part)]
    return numbers if len(numbers) > 1 and all(map(is_numeral, numbers)) else []


def _split(text: str, mark: str, strict: bool = True) -> tuple[list[list[str]], list[int]]:
    """Return the non-blank rows and their line numbers."""
    rows: list[list[str]] = []
    lines: list[int] = []
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=mark, strict=strict, skipinitialspace=True)
    numbered: Iterable[tuple[int, list[str]]] = ((reader.line_num, row) for row in reader)
    if mark == " ":
        numbered = enumerate(map(_words, text.split("\n")), start=1)
    brackets = any(sign in text for sign in "[({")
    try:
        for number, cells in numbered:
            row = [cell.strip() for cell in cells]
            if not any(row):
                continue
            if brackets:
                row = _with_lists(row, mark)
            if strict and len(row) > WIDEST:
                raise InputError("the table", f"a row of {len(row)} cells", f"at most {WIDEST} columns")
            rows.append(row)
            lines.append(number)
    except csv.Error as error:
        if strict:
            raise InputError(f"line {reader.line_num}", str(error), "short cells with closed quotes") from None
    return rows, lines


def _with_lists(row: list[str], mark: str) -> list[str]:
    """Return a row in which each bracketed list of numbers is one cell, whatever separates its numbers."""
    whole: list[str] = []
    depth = 0
    for cell in row:
        if depth > 0:
            whole[-1] += mark + cell
        else:
            whole.append(cell)
        if depth > 0 or LIST_OPENS.match(cell):
            depth += sum(map(cell.count, "[({")) - sum(map(cell.count, "])}"))
    return whole if depth == 0 else row


def _words(line: str) -> list[str]:
    """Return the words of a line; a header's names may hold single spaces where wider gaps part them."""
    words = line.split()
    if sum(map(is_numeral, words)) > ROW_OF_NUMBERS * len(words):
        return words
    wide = re.split(r"\s{2,}", line.strip())
    return wide if len(wide) > 2 else words


def _excel(path: Path, sheet: str) -> Grid:
    """Return the rows of a sheet of a workbook (Excel, OpenDocument): the stated one, or the first that has numbers."""
    rows: list[tuple[int, list[str]]] = []
    chosen = ""
    try:
        with path.open("rb") as stream:
            sheets = _sheets(path, stream)
            names = list(sheets)
            known = {str(i): name for i, name in enumerate(names, start=1)} | {name: name for name in names}
            for named in [pick(known, sheet, "--sheet")] if sheet else names:
                filled = list(_filled(sheets[named]))
                numeric = any(sum(map(is_numeral, row)) >= NUMBERS_OF_ROW for _, row in filled)
                if filled and (numeric or not rows):
                    rows, chosen = filled, named
                if numeric:
                    break
    except InputError:
        raise
    except Exception as error:  # a broken file fails in zipfile, XML and openpyxl in many ways
        raise InputError("the file", _first_line(error), "a readable workbook (.xlsx, .ods)") from None
    how = "as requested" if sheet else "the first with numbers; --sheet selects others"
    notes = (f"sheet '{chosen}' of {', '.join(names)}: {how}.",) if len(names) > 1 else ()
    return Grid([row for _, row in rows], [number for number, _ in rows], notes)


def _sheets(path: Path, stream: BinaryIO) -> dict[str, Iterable[Iterable[Any]]]:
    """Return the rows of the sheets of a workbook by their names."""
    if EXCEL_2003 in stream.read(1024):
        return _sheets_in_xml(decoded(path)[0])
    with ZipFile(stream) as archive:  # what it says of itself is what is read of it
        size = sum(entry.file_size for entry in archive.infolist())
        if size > LARGEST_WORKBOOK:
            raise InputError("the file", f"{size} bytes unpacked", f"{LARGEST_WORKBOOK}, or more as .csv or .parquet")
        if "content.xml" in archive.namelist():  # OpenDocument
            return _sheets_in_xml(archive.read("content.xml").decode())
    book = library("openpyxl", "Excel files").load_workbook(stream, read_only=True, data_only=True)
    for sheet in book.worksheets:
        sheet.reset_dimensions()  # what the file says of them would fill every row up
    return {sheet.title: sheet.iter_rows(values_only=True) for sheet in book.worksheets}


def _sheets_in_xml(text: str) -> dict[str, Iterable[Iterable[Any]]]:
    """Return the rows of the sheets of an OpenDocument or Excel 2003 file by their names."""
    named = NAMED_SHEET.split(text)[1:]
    return dict(zip(map(unescape, named[::2]), map(_rows_of_sheet, named[1::2]), strict=True))


def _rows_of_sheet(sheet: str) -> Iterator[list[str]]:
    """Yield the rows of a sheet in XML; what it states once for equal rows as often as they are there."""
    for row in re.split(r"<(?:table:table-row|(?:ss:)?Row)\b", sheet)[1:]:
        cells = _cells_of_page(row)
        times = re.match(r'[^<>]*number-rows-repeated="(\d{1,7})"', row)
        yield from repeat(cells, int(times[1]) if times and any(cells) else 1)


def _filled(rows: Iterable[Iterable[Any]]) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a sheet that are not empty with their numbers; a sheet of few bytes may have cells anywhere."""
    for number, row in enumerate(rows, start=1):
        if number > EXCEL_ROWS:
            raise InputError("the sheet", f"more than {EXCEL_ROWS} rows", "at most as many as Excel supports")
        cells = ["" if value is None else str(value).strip() for value in islice(row, WIDEST + 1)]
        while cells and not cells[-1]:
            cells.pop()
        if len(cells) > WIDEST:
            raise InputError("the table", f"a row of more than {WIDEST} cells", f"at most {WIDEST} columns")
        if cells:
            yield number, cells


def library(name: str, what: str, extra: str = "tables") -> Any:
    """Return a module of an optional package, which an extra of this one installs."""
    try:
        return import_module(name)
    except ImportError:
        raise InputError(what, f"no package {name.split('.')[0]}", f"pip install 'rpim-opt[{extra}]'") from None


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


# --- cells ---------------------------------------------------------------------------------------------------------


def numbers(cells: Sequence[Any], column: str, labels: Sequence[str] = ()) -> np.ndarray:
    """Return cells as finite numbers (N,); InputError names the first invalid row."""
    with contextlib.suppress(TypeError, ValueError):
        values = np.asarray(cells)
        if values.dtype.kind in "iuf" and np.isfinite(values).all():
            return values.astype(float)
    shown = ["" if cell is None else str(cell).strip() for cell in cells]
    values = np.array([numeral(text) for text in shown])
    if np.isnan(values).any():
        i = int(np.isnan(values).argmax())
        row = labels[i] if labels else i + 1
        raise InputError(f"row {row}, column {column}", f"'{shown[i][:40]}'", "a finite number")
    return values


def texts(cells: Sequence[Any], column: str) -> tuple[str, ...]:
    """Return cells as printable texts."""
    result = tuple("" if cell is None or cell != cell else str(cell).strip() for cell in cells)  # NaN is no text
    for number, text in enumerate(result, start=1):
        if not text.isprintable():
            raise InputError(f"row {number}, column {column}", repr(text[:40]), "printable text")
    return result


# --- out -----------------------------------------------------------------------------------------------------------


def csv_text(header: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """Return a table as CSV; text that a spreadsheet would evaluate gets an apostrophe (`read_columns` removes it)."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(_with_apostrophe(name) for name in header)
    writer.writerows([_with_apostrophe(cell) for cell in row] for row in rows)
    return stream.getvalue()


def records(columns: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Return the rows of columns, each by column."""
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def columns_csv(columns: Mapping[str, Sequence[Any]], exact: Collection[str] = ()) -> str:
    """Return columns as CSV; floats with six decimals, nine in ``exact`` ones; empty if not finite."""

    def cell(name: str, value: Any) -> Any:
        if not isinstance(value, float):
            return value
        return f"{value:.{9 if name in exact else 6}f}" if math.isfinite(value) else ""

    return csv_text(columns, ([cell(name, value) for name, value in row.items()] for row in records(columns)))


def _with_apostrophe(cell: Any) -> Any:
    """Return a cell that no spreadsheet takes for a formula; numbers may have a sign."""
    if not isinstance(cell, str) or not FORMULA.match(cell):
        return cell
    with contextlib.suppress(ValueError):
        float(cell)
        return cell
    return f"'{cell}"


def frame_of(rows: Sequence[dict[str, Any]]) -> Any:
    """Return rows as a pandas data frame, or polars if pandas is not installed."""
    for name, options in (("pandas", {}), ("polars", {"infer_schema_length": None})):
        with contextlib.suppress(ImportError):
            return import_module(name).DataFrame(list(rows), **options)
    raise InputError("the data frame", "neither pandas nor polars", "pip install 'rpim-opt[studies]'")
