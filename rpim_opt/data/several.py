"""Several raw tables become one: stacked where each is whole, joined by a key where they have parts of the rows."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import Columns
from rpim_opt.basics.text import listed
from rpim_opt.basics.units import split_unit
from rpim_opt.data.models import Measurement
from rpim_opt.data.understanding import Understood
from rpim_opt.robot.mdh import Robot


class Whole(NamedTuple):
    """One table, and how it was put together, a sentence each."""

    columns: Columns
    notes: tuple[str, ...]


def together(tables: Sequence[Understood], robot: Robot, kind: Measurement, key: str = "") -> Whole:
    """Return several tables as one.

    Tables that have joint and measured values each are stacked. Where some have the one and some the other, rows of
    equal keys are one row.

    Parameters
    ----------
    tables
        What was understood of every file.
    robot, kind
        Decide which columns are joint and which are measured values.
    key
        The column of the key, as the files or we call it; ``"row"`` for the number of the row. By default the label,
        else the only name that both have.

    Raises
    ------
    InputError
        For columns that one table lacks, keys that are there twice, and tables without a common key.
    """
    joints = {f"q{i}" for i in range(1, robot.dof + 1)}
    values = {*kind.columns, *(stem for form, _ in kind.forms for stem in form)}
    moving = [table for table in tables if table.stems & joints]
    seen = [table for table in tables if table.stems & values]
    if len(tables) == 1 or (len(moving) == len(seen) == len(tables)):
        return _stacked(tables)
    if not moving or not seen or len(moving) + len(seen) != len(tables):
        what = ", ".join(table.file for table in tables if table not in moving and table not in seen)
        found = f"{what or 'some tables'} with only part of joint and measured values"
        raise InputError("--data", found, "tables that have both, or tables of joints and tables of measured values")
    return _joined(moving, seen, key)


def _stacked(tables: Sequence[Understood]) -> Whole:
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
    counts = ", ".join(f"{table.file} {_count(table.columns)}" for table in tables)
    notes.append(f"rows of the files below each other: {counts}.")
    labels = [label for table in tables for label in _labels(table.columns)]
    if len(set(labels)) < len(labels):
        names = _file_names(tables)
        labels = [f"{name}:{label}" for name, t in zip(names, tables, strict=True) for label in _labels(t.columns)]
        notes.append("labels are there in several files: the file's name is put before them.")
    return Whole({"label": labels, **whole}, tuple(notes))


def _file_names(tables: Sequence[Understood]) -> list[str]:
    names = [Path(table.file).stem for table in tables]
    if len(set(names)) < len(names):
        return [str(i) for i in range(1, len(names) + 1)]
    return names


def _count(columns: Columns) -> int:
    return len(next(iter(columns.values())))


def _labels(columns: Columns) -> list[str]:
    return [str(label) for label in columns.get("label", range(1, _count(columns) + 1))]


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


def _joined(moving: Sequence[Understood], seen: Sequence[Understood], key: str) -> Whole:
    """Return rows of joints with the measured values of the same key."""
    joints = _stacked(moving)
    values = _stacked(seen)
    how, left, right = _keys(moving, seen, joints.columns, values.columns, key)
    place = _places(left, f"the key {how}", moving[0].file)
    rows = [i for i, name in enumerate(right) if name in place]
    if not rows:
        found = f"none that {moving[0].file} and {seen[0].file} share"
        raise InputError(f"the key {how}", found, "--key with a column that both have, or --key row")
    notes = [*joints.notes, *values.notes]
    notes.append(f"joined by {how}: {len(rows)} rows of {len(left)} with joints and {len(right)} measured.")
    lonely = [name for name in left if name not in set(right)] + [name for name in right if name not in place]
    if lonely:
        notes.append(f"without a partner, left out: {listed(lonely)}.")
    own = {name: cells for name, cells in joints.columns.items() if name not in values.columns and name != "label"}
    whole: dict[str, Sequence[Any]] = {name: [cells[place[right[i]]] for i in rows] for name, cells in own.items()}
    whole |= {name: [cells[i] for i in rows] for name, cells in values.columns.items() if name != "label"}
    return Whole(_named(whole, [right[i] for i in rows]), tuple(notes))


def _places(names: Sequence[str], where: str, file: object) -> dict[str, int]:
    """Return where every name of a key stands, each of which stands once."""
    place: dict[str, int] = {}
    for i, name in enumerate(names):
        if name in place:
            raise InputError(where, f"'{name}' twice in {file}", "every configuration once")
        place[name] = i
    return place


def _named(columns: dict[str, Sequence[Any]], names: list[str]) -> dict[str, Sequence[Any]]:
    """Return columns with the names of their rows: labels where each is another, otherwise configurations."""
    if len(set(names)) == len(names):
        return {"label": names, **columns}
    return {**columns, "configuration": columns.get("configuration", names)}


def _keys(
    moving: Sequence[Understood], seen: Sequence[Understood], joints: Columns, values: Columns, key: str
) -> tuple[str, list[str], list[str]]:
    """Return what the key is, and those of both tables."""
    if key == "row":
        if _count(joints) != _count(values):
            found = f"{_count(joints)} rows of joints and {_count(values)} measured"
            raise InputError("--key row", found, "as many of both, or a column that both have")
        numbers = [str(i) for i in range(1, _count(joints) + 1)]
        return "the number of the row", numbers, numbers
    if "label" in joints and key in ("", "label"):
        labels = _normal(joints["label"])
        for column in ("label", "configuration"):
            if set(labels) & set(_normal(values.get(column, ()))):
                return "label", labels, _normal(values[column])
    both = [_raw(tables) for tables in (moving, seen)]
    common = [name for name in both[0] if name in both[1]]
    if key.lower() in common:
        common = [key.lower()]
    if (key and key.lower() not in common) or len(common) != 1:
        found = f"'{key}'" if key else f"{', '.join(common) or 'no column'} in both {moving[0].file} and {seen[0].file}"
        raise InputError("--key", found, "a column that both have, or --key row for rows in the same order")
    return f"column '{common[0]}'", _normal(both[0][common[0]]), _normal(both[1][common[0]])


def _raw(tables: Sequence[Understood]) -> Mapping[str, list[Any]]:
    """Return the columns that all files have, below each other, by names in lower case."""
    lower = [{name.lower(): cells for name, cells in table.raw.items()} for table in tables]
    return {
        name: [cell for table in lower for cell in table[name]] for name in lower[0] if all(name in t for t in lower)
    }


def _normal(cells: Sequence[Any]) -> list[str]:
    """Return keys as texts, numbers without zeros before or behind them."""
    keys = []
    for cell in cells:
        text = str(cell).strip()
        if re.fullmatch(r"\d+(?:\.0*)?", text):
            text = str(int(text.partition(".")[0]))
        keys.append(text)
    return keys
