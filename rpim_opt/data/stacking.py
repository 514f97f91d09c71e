"""Several raw tables below each other, in the units of the first."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import Columns
from rpim_opt.basics.text import listed
from rpim_opt.basics.units import split_unit
from rpim_opt.data.understanding import Understood


class Whole(NamedTuple):
    """One table, and how it was put together, a sentence each."""

    columns: Columns
    notes: tuple[str, ...]


def stacked(tables: Sequence[Understood]) -> Whole:
    """Return the rows of several tables below each other."""
    first = tables[0]
    if len(tables) == 1:
        return Whole(first.columns, ())
    matched = [_matched(table, first) for table in tables]
    whole = {name: [cell for columns in matched for cell in columns[name]] for name in matched[0]}
    counts = ", ".join(f"{table.file} {count(table.columns)}" for table in tables)
    notes = [f"rows of the files below each other: {counts}."]
    names = [name for table in tables for name in labels(table.columns)]
    if len(set(names)) < len(names):
        names = [f"{file}:{name}" for file, table in _by_file(tables).items() for name in labels(table.columns)]
        notes.append("labels are there in several files: the file's name is put before them.")
    return Whole({"label": names, **whole}, tuple(notes))


def _by_file(tables: Sequence[Understood]) -> dict[str, Understood]:
    """Return tables by their files' names, by their numbers where those are the same."""
    found = {Path(table.file).stem: table for table in tables}
    if len(found) == len(tables):
        return found
    return {str(i): table for i, table in enumerate(tables, 1)}


def count(columns: Columns) -> int:
    """Return how many rows a table has."""
    return len(next(iter(columns.values())))


def labels(columns: Columns) -> list[str]:
    """Return the labels of a table's rows; their numbers where it has none."""
    return [str(label) for label in columns.get("label", range(1, count(columns) + 1))]


def _matched(table: Understood, first: Understood) -> dict[str, Sequence[Any]]:
    """Return a table's columns but for labels under the first one's names, in its units."""
    own, wanted = (_by_stem(each.columns) for each in (table, first))
    lacking = own.keys() ^ wanted.keys()
    if lacking:
        found = f"{listed(sorted(lacking))} in one of {first.file} and {table.file} alone"
        raise InputError("the header", found, "the same columns in all files, or one file of joints and one of values")
    return {name: _in_unit(table.columns[own[stem]], own[stem], name) for stem, name in wanted.items()}


def _by_stem(columns: Columns) -> dict[str, str]:
    return {split_unit(name)[0]: name for name in columns if name != "label"}


def _in_unit(cells: Sequence[Any], name: str, wanted: str) -> Sequence[Any]:
    """Return a column's cells in the unit of another name."""
    old = split_unit(name)[1]
    new = split_unit(wanted)[1]
    if old is None or new is None or old.si == new.si:
        return cells
    return [repr(float(cell) * old.si / new.si) for cell in cells]
