"""Registry of table formats: those of all modules in this folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import Any, NamedTuple

from rpim_opt.basics.exceptions import InputError, in_file
from rpim_opt.basics.files import LARGEST_DATA, require_file
from rpim_opt.basics.layout import RawTable, TableOptions, read_table, unfolded
from rpim_opt.basics.tables import EXCEL, TEXTS, Grid, decoded

Rows = Sequence[Mapping[str, Any]]
"""Cells by the names of their columns, with units as in headers: ``{"label": "P1", "J1 [deg]": "10.5"}``."""

NO_TABLES = (".pdf", ".doc", ".docx", ".zip", ".bag", ".mcap", ".db3", ".h5", ".npy", ".pkl", ".py", ".ipynb")
"""Endings of files that are no text tables; any other unknown ending may be an instrument's."""


class TableFormat(NamedTuple):
    """A format of tables: a module of this folder lists its own in ``FORMATS``.

    ``endings`` are those of its files; ``read(text)`` returns the rows, or none for a text of another format with the
    same ending. Values that a program commands are so named, ``commanded x [mm]``: they are no measurements.
    """

    name: str
    endings: tuple[str, ...]
    read: Callable[[str], Rows]


def read_raw(
    path: Path, options: TableOptions | None = None, turned: Callable[[Grid], bool] = lambda grid: False
) -> RawTable:
    """Return the table of a file of any format, with ``turned`` as for `read_table`."""
    ending = path.suffix.lower()
    modules = [each.name for each in iter_modules([str(Path(__file__).parent)]) if each.name != "registry"]
    every: list[TableFormat] = [each for name in modules for each in import_module(f"{__package__}.{name}").FORMATS]
    fitting = [each for each in every if ending in each.endings]
    if not fitting and ending in NO_TABLES:
        plain = {*TEXTS, *EXCEL, ".parquet", ".mat", ".npz"}
        accepted = ", ".join(sorted(plain.union(*(each.endings for each in every))))
        raise InputError("the file's name", f"'{path.name}'", f"a name ending in {accepted}", path)
    if not fitting:
        return read_table(path, options, turned)
    with in_file(path):
        require_file(path, LARGEST_DATA)
        text, _ = decoded(path, options.encoding if options else "")
        name, rows = next(((each.name, rows) for each in fitting if (rows := each.read(text))), ("", ()))
        if not rows and ending in TEXTS:
            return read_table(path, options, turned)
        if not rows:
            accepted = f"{' or '.join(each.name for each in fitting)} with at least one"
            raise InputError("the file", "neither targets nor rows", accepted)
        names = dict.fromkeys(name for row in rows for name in row)
        columns = {name: ["" if row.get(name) is None else str(row[name]) for row in rows] for name in names}
        raw = unfolded(RawTable(columns))
    return replace(raw, notes=(f"read as {name}.", *raw.notes))
