"""Tables of joints and tables of measured values joined: rows of equal keys are one row."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import Columns
from rpim_opt.basics.text import listed
from rpim_opt.data.stacking import Whole, count, stacked
from rpim_opt.data.understanding import Understood


class Keys(NamedTuple):
    """What a key is called, and the keys of the rows with joints and of those with measured values."""

    how: str
    joints: list[str]
    values: list[str]


def joined(moving: Sequence[Understood], seen: Sequence[Understood], key: str) -> Whole:
    """Return rows of joints with the measured values of the same key."""
    joints = stacked(moving)
    values = stacked(seen)
    keys = _keys(moving, seen, joints.columns, values.columns, key)
    place = _places(keys.joints, f"the key {keys.how}", moving[0].file)
    rows = [i for i, name in enumerate(keys.values) if name in place]
    if not rows:
        found = f"none that {moving[0].file} and {seen[0].file} share"
        accepted = "--key with a column that both have, --key row, or --within for the nearest time"
        raise InputError(f"the key {keys.how}", found, accepted)
    names = [keys.values[i] for i in rows]
    whole = beside(joints.columns, [place[name] for name in names], values.columns, rows)
    notes = [*joints.notes, *values.notes, *_said(keys, place, len(rows))]
    return Whole(named(whole, names), tuple(notes))


def beside(joints: Columns, left: Sequence[int], values: Columns, right: Sequence[int]) -> dict[str, Sequence[Any]]:
    """Return some rows of joints beside some of measured values, whose columns go before; without labels."""
    own = {name: cells for name, cells in joints.items() if name not in values and name != "label"}
    whole: dict[str, Sequence[Any]] = {name: [cells[i] for i in left] for name, cells in own.items()}
    return whole | {name: [cells[i] for i in right] for name, cells in values.items() if name != "label"}


def _said(keys: Keys, place: Mapping[str, int], rows: int) -> list[str]:
    """Say how many rows were joined, and name those without a partner."""
    notes = [f"joined by {keys.how}: {rows} rows of {len(keys.joints)} with joints and {len(keys.values)} measured."]
    known = set(keys.values)
    lonely = [name for name in keys.joints if name not in known] + [name for name in keys.values if name not in place]
    if lonely:
        notes.append(f"without a partner, left out: {listed(lonely)}.")
    return notes


def _places(names: Sequence[str], where: str, file: object) -> dict[str, int]:
    """Return where every name of a key stands, each of which stands once."""
    place: dict[str, int] = {}
    for i, name in enumerate(names):
        if name in place:
            raise InputError(where, f"'{name}' twice in {file}", "every configuration once")
        place[name] = i
    return place


def named(columns: dict[str, Sequence[Any]], names: list[str]) -> dict[str, Sequence[Any]]:
    """Return columns with the names of their rows: labels where each is another, otherwise configurations."""
    if len(set(names)) == len(names):
        return {"label": names, **columns}
    return {**columns, "configuration": columns.get("configuration", names)}


def _keys(moving: Sequence[Understood], seen: Sequence[Understood], joints: Columns, values: Columns, key: str) -> Keys:
    """Return what the key is, and those of both tables."""
    if key == "row":
        return _numbers(joints, values)
    if "label" in joints and key in ("", "label"):
        by_label = _labels(joints, values)
        if by_label is not None:
            return by_label
    left, right = _raw(moving), _raw(seen)
    name = _common(left, right, key, f"{moving[0].file} and {seen[0].file}")
    return Keys(f"column '{name}'", _normal(left[name]), _normal(right[name]))


def _numbers(joints: Columns, values: Columns) -> Keys:
    """Return the numbers of the rows, of which both have as many."""
    if count(joints) != count(values):
        found = f"{count(joints)} rows of joints and {count(values)} measured"
        raise InputError("--key row", found, "as many of both, or a column that both have")
    numbers = [str(i) for i in range(1, count(joints) + 1)]
    return Keys("the number of the row", numbers, numbers)


def _labels(joints: Columns, values: Columns) -> Keys | None:
    """Return labels of joints with labels or configurations of values, whichever they share; None where neither."""
    labels = _normal(joints["label"])
    for column in ("label", "configuration"):
        others = _normal(values.get(column, ()))
        if set(labels) & set(others):
            return Keys("label", labels, others)
    return None


def _common(left: Mapping[str, Any], right: Mapping[str, Any], key: str, files: str) -> str:
    """Return the name of the column that was asked for, or of the only one that both have."""
    common = [name for name in left if name in right]
    wanted = key.lower()
    if wanted in common:
        return wanted
    if not key and len(common) == 1:
        return common[0]
    found = f"'{key}'"
    if not key:
        found = f"{', '.join(common) or 'no column'} in both {files}"
    accepted = "a column that both have, --key row for rows in the same order, or --within for the nearest time"
    raise InputError("--key", found, accepted)


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
