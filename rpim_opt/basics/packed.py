"""Tables in packed files, Parquet and Excel: a few bytes of them can say more than memory holds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO
from zipfile import ZipFile

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.shape import Columns, narrow, rectangle, require_names, require_size

LARGEST_WORKBOOK = 2**27
"""Bytes that a workbook may unpack to: some three hundred thousand rows."""
EXCEL_ROWS = 2**20


def read_parquet(path: Path) -> Columns:
    """Return the columns of a Parquet file."""
    parquet = library("pyarrow.parquet", "Parquet files")
    try:
        with parquet.ParquetFile(path) as file:
            require_names(file.schema_arrow.names)
            require_size(file.metadata.num_rows, len(file.schema_arrow.names), _expanded(file.metadata))
            table = file.read()
            return {name: _cells(table.column(name)) for name in table.column_names}
    except (OSError, ValueError, KeyError, NotImplementedError, MemoryError) as error:  # pyarrow's derive from these
        raise InputError("the file", _first_line(error), "a readable Parquet file") from None


def _expanded(metadata: Any) -> int:
    """Return how many bytes a Parquet file says that it has when it is unpacked."""
    return sum(metadata.row_group(i).total_byte_size for i in range(metadata.num_row_groups))


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


def _cells(column: Any) -> Sequence[Any]:
    """Return a column of numbers without gaps as an array, any other as a list."""
    numeric = str(column.type) in ("float", "double") or str(column.type).startswith(("int", "uint"))
    return column.to_numpy() if numeric and not column.null_count else column.to_pylist()


def read_excel(path: Path) -> Columns:
    """Return the columns of a workbook's first sheet, as texts."""
    openpyxl = library("openpyxl", "Excel files")
    try:
        with path.open("rb") as stream:
            require_unpacked(stream)
            book = openpyxl.load_workbook(stream, read_only=True, data_only=True)
            rows = list(_filled(book.worksheets[0]))
    except InputError:
        raise
    except Exception as error:  # a broken file fails in zipfile, XML and openpyxl in many ways
        raise InputError("the file", _first_line(error), "a readable Excel workbook (.xlsx)") from None
    width = max(map(_width, rows), default=0)
    return rectangle([[cell or "" for cell in row[:width]] for row in rows])


def require_unpacked(stream: BinaryIO) -> None:
    """Refuse an archive that unpacks to more than memory should hold; what it says of itself is what is read of it."""
    with ZipFile(stream) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
    if size > LARGEST_WORKBOOK:
        found = f"{size} bytes unpacked"
        raise InputError("the file", found, f"at most {LARGEST_WORKBOOK} bytes; more as .csv or .parquet")


def _filled(sheet: Any) -> Iterator[list[str | None]]:
    """Yield the rows of a sheet that are not empty; a sheet of few bytes may have cells anywhere."""
    sheet.reset_dimensions()  # what the file says of them would fill every row up
    for number, row in enumerate(sheet.iter_rows(values_only=True)):
        if number > EXCEL_ROWS:
            raise InputError("the sheet", f"more than {EXCEL_ROWS} rows", "as many as Excel has")
        if any(cell is not None for cell in row):
            yield narrow([None if cell is None else str(cell) for cell in row[: _width(row)]])


def _width(row: Sequence[Any]) -> int:
    """Return how far a row is filled."""
    return max((place for place, cell in enumerate(row, start=1) if cell is not None), default=0)


def library(name: str, what: str) -> Any:
    """Return a package that only some tables need, or say how to get it."""
    try:
        return import_module(name)
    except ImportError:
        remedy = "pip install 'rpim-opt[tables]'"
        raise InputError(what, f"no package {name.split('.')[0]}", remedy) from None
