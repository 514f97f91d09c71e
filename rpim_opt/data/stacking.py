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
    whole: dict[str, list[Any]] = {name: list(cells) for name, cells in first.columns.items() if name != "label"}
    notes = []
    for table in tables[1:]:
        matched = _matched(table, first)
        for name in whole:
            whole[name] += matched[name]
    counts = ", ".join(f"{table.file} {count(table.columns)}" for table in tables)
    notes.append(f"rows of the files below each other: {counts}.")
    named = [label for table in tables for label in labels(table.columns)]
    if len(set(named)) < len(named):
        names = _file_names(tables)
        named = [f"{name}:{label}" for name, t in zip(names, tables, strict=True) for label in labels(t.columns)]
        notes.append("labels are there in several files: the file's name is put before them.")
    return Whole({"label": named, **whole}, tuple(notes))


def _file_names(tables: Sequence[Understood]) -> list[str]:
    names = [Path(table.file).stem for table in tables]
    if len(set(names)) < len(names):
        return [str(i) for i in range(1, len(names) + 1)]
    return names


def count(columns: Columns) -> int:
    """Return how many rows a table has."""
    return len(next(iter(columns.values())))


def labels(columns: Columns) -> list[str]:
    """Return the labels of a table's rows; their numbers where it has none."""
    return [str(label) for label in columns.get("label", range(1, count(columns) + 1))]


def _matched(table: Understood, first: Understood) -> dict[str, list[Any]]:
    """Return a table's columns under the first one's names, in its units."""
    own = {split_unit(name): name for name in table.columns if name != "label"}
    by_stem = {stem: (name, unit) for (stem, unit), name in own.items()}
    wanted = [name for name in first.columns if name != "label"]
    lacking = {split_unit(name)[0] for name in wanted} ^ set(by_stem)
    if lacking:
        found = f"{listed(sorted(lacking))} in one of {first.file} and {table.file} alone"
        raise InputError("the header", found, "the same columns in all files, or one file of joints and one of values")
    matched = {}
    for name in wanted:
        stem, unit = split_unit(name)
        source, other = by_stem[stem]
        cells = list(table.columns[source])
        if unit and other and unit.si != other.si:
            cells = [repr(float(cell) * other.si / unit.si) for cell in cells]
        matched[name] = cells
    return matched
