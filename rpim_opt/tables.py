"""Tables at the border: CSV, Parquet, Excel files and data frames become named columns of cells."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.exceptions import InputError, choices

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
    if isinstance(source, str | Path):
        path = Path(source)
        kinds = {".csv": _csv, ".parquet": _parquet, ".xlsx": _excel}
        if path.suffix.lower() not in kinds:
            raise InputError("the file's name", f"'{path.name}'", "a name ending in " + ", ".join(kinds), path)
        if not path.is_file():
            near = sorted(p.name for k in kinds for p in path.parent.glob(f"*{k}")) if path.parent.is_dir() else []
            raise InputError("the file", "nothing", choices(path.name, near) if near else "a table there", path)
        columns = kinds[path.suffix.lower()](path)
    else:
        names = list(getattr(source, "column_names", getattr(source, "columns", source)))
        for name in names:
            if not isinstance(name, str) or names.count(name) > 1:
                raise InputError("the header", f"column {name!r}", "texts as names, every one once")
        columns = {name.strip(): source[name] for name in names}
    if not columns or not len(next(iter(columns.values()))):
        raise InputError("the table", "a header and no rows" if columns else "an empty table", "at least one row")
    return columns


def csv_text(columns: Columns) -> str:
    """Return columns as CSV with a header."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return stream.getvalue()


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
    for name in header:
        if not name or header.count(name) > 1:
            found = f"column '{name}' twice" if name else "a column without a name"
            raise InputError("the header", found, "every column once, with its name")
    for number, row in enumerate(lines[1:], start=1):
        if len(row) != len(header):
            raise InputError(f"row {number} ({row[0]})", f"{len(row)} cells", f"{len(header)} cells as in the header")
    return {name: [row[i].strip() for row in lines[1:]] for i, name in enumerate(header)}


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
        if not path.is_file():
            raise InputError("the file", "nothing", "a CSV file of RoboDK")
        table = list(_csv(path).values())
        if len(table) < len(joints) + 6:
            raise InputError(
                "the header", f"{len(table)} columns", f"{len(joints)} joints, 3 measured and 3 of the tool"
            )
        names = [f"q{i}_{'deg' if kind == 'angle' else 'mm'}" for i, kind in enumerate(joints, start=1)]
        columns = dict(zip([*names, "x_mm", "y_mm", "z_mm"], table, strict=False))
        rows = [str(i + 1) for i in range(len(table[0]))]
        tcp = [numbers(cells, rows, f"{len(names) + 4 + i}") for i, cells in enumerate(table[len(names) + 3 :][:3])]
    except InputError as error:
        raise error.within(path) from None
    markers = []
    for place in np.column_stack(tcp):
        name = next((m for m, known in tools.items() if np.allclose(known, place, atol=1e-6)), "")
        name = name or next(c for c in MARKERS if c not in tools)
        tools.setdefault(name, place.tolist())
        markers.append(name)
    return columns | {"marker": markers}


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
        rows = [row for row in book.worksheets[0].iter_rows(values_only=True) if any(c is not None for c in row)]
        book.close()
    except Exception as error:  # a broken file fails in zipfile, XML and openpyxl in many ways
        raise InputError("the file", str(error) or type(error).__name__, "a readable Excel workbook (.xlsx)") from None
    while rows and all(row[-1] is None for row in rows):
        rows = [row[:-1] for row in rows]
    return _rectangle([["" if cell is None else str(cell) for cell in row] for row in rows])


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
