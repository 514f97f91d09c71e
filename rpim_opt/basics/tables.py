"""Tables at the border: CSV, Parquet, Excel files and data frames become named columns of cells."""

from __future__ import annotations

import contextlib
import csv
import io
import math
import re
from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.inputs import LARGEST_DATA, require_file
from rpim_opt.basics.packed import read_excel, read_parquet
from rpim_opt.basics.shape import Columns, narrow, rectangle, require_names
from rpim_opt.basics.units import joint_columns

FORMULA = re.compile(r"'*[=+\-@\t\r\uff1d\uff0b\uff0d\uff20]")
"""What a spreadsheet computes, be it behind apostrophes that keep it from that."""
MARKERS = [chr(65 + i) for i in range(26)] + [f"M{i}" for i in range(1, 1000)]


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
        columns = _file(Path(source))
    else:
        columns = _frame(source)
    if not columns:
        raise InputError("the table", "an empty table", "at least one row")
    if not len(next(iter(columns.values()))):
        raise InputError("the table", "a header and no rows", "at least one row")
    return columns


def _file(path: Path) -> Columns:
    readers = {".csv": _csv, ".parquet": read_parquet, ".xlsx": read_excel}
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
    require_names(names)
    return {name.strip(): source[name] for name in names}


def _csv(path: Path) -> Columns:
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            rows = (narrow(row) for row in csv.reader(stream, strict=True) if any(cell.strip() for cell in row))
            lines = [[_as_written(cell) for cell in row] for row in rows]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError("the file", str(error), "a readable UTF-8 CSV file") from None
    if lines:
        lines[0][0] = lines[0][0].lstrip("\ufeff")  # files put together have more than one mark
    if lines and len(lines[0]) == 1 and any(mark in lines[0][0] for mark in ";\t"):
        raise InputError("the header", "one column with semicolons or tabs", "columns separated by commas")
    return rectangle(lines)


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
    require_file(path, LARGEST_DATA, [".csv"])
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
    """Return a table as CSV text, one line a row.

    A text that a spreadsheet would compute, ``=1+1``, gets an apostrophe before it, which `read_columns` takes away.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(_harmless(name) for name in header)
    writer.writerows([_harmless(cell) for cell in row] for row in rows)
    return stream.getvalue()


def _harmless(cell: Any) -> Any:
    """Return a cell that no spreadsheet takes for a formula; numbers may have a sign."""
    if not isinstance(cell, str) or not FORMULA.match(cell) or _is_number(cell):
        return cell
    return f"'{cell}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _as_written(cell: str) -> str:
    """Return what `_harmless` was given."""
    if cell.startswith("'") and FORMULA.match(cell):
        return cell[1:]
    return cell


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
