"""Tables at the border: CSV, Parquet, Excel files and data frames become named columns of cells."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.units import joint_columns

MARKERS = [chr(65 + i) for i in range(26)] + [f"M{i}" for i in range(1, 1000)]
Columns = Mapping[str, Sequence[Any]]
"""Column name to its cells: text from a CSV file, whatever the table holds elsewhere."""


def read_columns(source: Any) -> Columns:
    """Return the columns of a table.

    Parameters
    ----------
    source
        A path (``.csv``, ``.parquet``, ``.xlsx``), a pandas, polars or similar data frame, or a mapping from
        column names to cells.

    Raises
    ------
    InputError
        If there is no such file, it cannot be read as what its name says, or the table has no rows, a column
        twice, or rows of different lengths.
    """
    columns = _file(Path(source)) if isinstance(source, str | Path) else _frame(source)
    if not columns or not len(next(iter(columns.values()))):
        raise InputError("the table", "a header and no rows" if columns else "an empty table", "at least one row")
    return columns


def _file(path: Path) -> Columns:
    readers = {".csv": _csv, ".parquet": _parquet, ".xlsx": _excel}
    kind = path.suffix.lower()
    if kind not in readers:
        raise InputError("the file's name", f"'{path.name}'", "a name ending in " + ", ".join(readers), path)
    if not path.is_file():
        near = [p.name for p in path.parent.glob("*") if p.suffix in readers]
        raise InputError("the file", "nothing", choices(path.name, sorted(near)) if near else "a table there", path)
    return readers[kind](path)


def _frame(source: Any) -> Columns:
    """Return the columns of a data frame or a mapping."""
    names = list(getattr(source, "column_names", getattr(source, "columns", source)))
    for name in names:
        if not isinstance(name, str) or names.count(name) > 1:
            raise InputError("the header", f"column {name!r}", "texts as names, every one once")
    return {name.strip(): source[name] for name in names}


def _csv(path: Path) -> Columns:
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            lines = [row for row in csv.reader(stream, strict=True) if any(cell.strip() for cell in row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError("the file", str(error), "a readable UTF-8 CSV file") from None
    if lines and len(lines[0]) == 1 and any(mark in lines[0][0] for mark in ";\t"):
        raise InputError("the header", "one column with semicolons or tabs", "columns separated by commas")
    return _rectangle(lines)


def _rectangle(lines: Sequence[Sequence[str]]) -> Columns:
    """Return the columns of rows of text; the first row is the header."""
    if not lines:
        raise InputError("the table", "an empty file", "a header and at least one row")
    header = [name.strip() for name in lines[0]]
    _require_names(header)
    for number, row in enumerate(lines[1:], start=1):
        if len(row) != len(header):
            raise InputError(f"row {number} ({row[0]})", f"{len(row)} cells", f"{len(header)} cells as in the header")
    return {name: [row[i].strip() for row in lines[1:]] for i, name in enumerate(header)}


def _require_names(header: Sequence[str]) -> None:
    for name in header:
        if not name:
            raise InputError("the header", "a column without a name", "every column once, with its name")
        if header.count(name) > 1:
            raise InputError("the header", f"column '{name}' twice", "every column once, with its name")


def robodk_columns(path: str | Path, joints: Sequence[str], tools: dict[str, list[float]]) -> Columns:
    """Return the columns of the CSV file that RoboDK exports after calibration measurements.

    Its columns count, not their names: the joints [deg or mm], the measured point x, y, z [mm], and the
    reflector in the flange frame x, y, z [mm] (RoboDK's macro library reads it so). Every reflector gets a
    marker A, B, ...

    Parameters
    ----------
    path
        The file.
    joints
        ``"angle"`` or ``"length"`` for every joint.
    tools
        Reflectors that are known, marker to x, y, z [mm]; new ones are added.
    """
    path = Path(path)
    try:
        columns, tcp = _robodk(path, joints)
    except InputError as error:
        raise error.within(path) from None
    markers = [_marker(place, tools) for place in tcp]
    return columns | {"marker": markers}


def _robodk(path: Path, joints: Sequence[str]) -> tuple[dict[str, Sequence[Any]], np.ndarray]:
    """Return joints and measured point under our names, and the reflector's place (N, 3) [mm]."""
    if not path.is_file():
        raise InputError("the file", "nothing", "a CSV file of RoboDK")
    table = list(_csv(path).values())
    if len(table) < len(joints) + 6:
        accepted = f"{len(joints)} joints, 3 measured and 3 of the tool"
        raise InputError("the header", f"{len(table)} columns", accepted)
    names = [*joint_columns(joints), "x_mm", "y_mm", "z_mm"]
    columns = dict(zip(names, table, strict=False))
    rows = [str(i) for i in range(1, len(table[0]) + 1)]
    first = len(names)
    tcp = [numbers(table[i], rows, f"{i + 1}") for i in range(first, first + 3)]
    return columns, np.column_stack(tcp)


def _marker(place: np.ndarray, tools: dict[str, list[float]]) -> str:
    """Return the name of the reflector there [mm]; a new one is added to those that are known."""
    for name, known in tools.items():
        if np.allclose(known, place, atol=1e-6):
            return name
    name = next(marker for marker in MARKERS if marker not in tools)
    tools[name] = place.tolist()
    return name


def csv_text(header: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """Return a table as CSV text, one line a row."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return stream.getvalue()


def _parquet(path: Path) -> Columns:
    parquet = _library("pyarrow.parquet", "Parquet files")
    try:
        table = parquet.read_table(path)
    except (OSError, ValueError) as error:  # pyarrow's own errors derive from these
        raise InputError("the file", str(error).splitlines()[0], "a readable Parquet file") from None
    for name in table.column_names:
        if table.column_names.count(name) > 1:
            raise InputError("the header", f"column '{name}' twice", "every column once")
    return {name: _cells(table.column(name)) for name in table.column_names}


def _cells(column: Any) -> Sequence[Any]:
    """Return a column of numbers without gaps as an array, any other as a list."""
    numeric = str(column.type) in ("float", "double") or str(column.type).startswith(("int", "uint"))
    return column.to_numpy() if numeric and not column.null_count else column.to_pylist()


def _excel(path: Path) -> Columns:
    openpyxl = _library("openpyxl", "Excel files")
    try:
        book = openpyxl.load_workbook(path, read_only=True, data_only=True)
        cells = list(book.worksheets[0].iter_rows(values_only=True))
        rows = [[None if cell is None else str(cell) for cell in row] for row in cells]
        book.close()
    except Exception as error:  # a broken file fails in zipfile, XML and openpyxl in many ways
        raise InputError("the file", str(error) or type(error).__name__, "a readable Excel workbook (.xlsx)") from None
    return _rectangle(_trimmed(rows))


def _trimmed(rows: list[list[str | None]]) -> list[list[str]]:
    """Return rows without those that are empty, and without empty columns at their end."""
    filled = [row for row in rows if any(cell is not None for cell in row)]
    width = max(map(_width, filled), default=0)
    return [[cell or "" for cell in row[:width]] for row in filled]


def _width(row: Sequence[str | None]) -> int:
    """Return how far a row is filled."""
    return max((place for place, cell in enumerate(row, start=1) if cell is not None), default=0)


def _library(name: str, what: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        remedy = "pip install 'rpim-opt[tables]'"
        raise InputError(what, f"no package {name.split('.')[0]}", remedy) from None


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
    try:
        value = math.nan if isinstance(cell, bool | np.bool_) or "_" in text else float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(f"row {row}, column {column}", f"'{text[:40]}'", "a finite number")
    return value


def texts(cells: Sequence[Any], column: str) -> tuple[str, ...]:
    """Return cells as printable texts."""
    result = tuple("" if cell is None or cell != cell else str(cell).strip() for cell in cells)  # NaN is no text
    for number, text in enumerate(result, start=1):
        if not text.isprintable():
            raise InputError(f"row {number}, column {column}", repr(text[:40]), "printable text")
    return result
