"""Joining of raw tables: complete tables are stacked, others are joined by a key or the nearest time."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import Columns
from rpim_opt.basics.text import listed
from rpim_opt.basics.units import numeral, split_unit
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.tables.understanding import Understood, row_stems
from rpim_opt.robot.mdh import Robot

TIME = re.compile(r"[%#]?(?:.*[._/ ])?(time ?stamp|date ?time|time|stamp|zeit|zeitstempel|date|datum|t)", re.IGNORECASE)
UNIT = re.compile(r"(.+?)[\s_]*[\[(/]?\s*\b(s|sec|secs|seconds|ms|us|µs|ns|nsec|nsecs)\b\s*[\])]?", re.IGNORECASE)
SECONDS = {"s": 1.0, "sec": 1.0, "secs": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "μs": 1e-6, "ns": 1e-9,
           "nsec": 1e-9, "nsecs": 1e-9}  # fmt: skip
"""What a unit is in lower case (`str.casefold`)."""
SAME = 0.8
"""Share of the shorter one's values that two columns of other names have in common where they are one key."""
SINCE_1970 = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
"""From which number on a time without a unit counts so since 1970: seconds would be in the year 5000."""


class Whole(NamedTuple):
    """One table: cells by our names, the same rows' by the files' names, how it was put together in sentences.

    ``keys`` are the files' names of the columns by which rows were joined, in lower case.
    """

    columns: Columns
    raw: Columns
    notes: tuple[str, ...]
    keys: Sequence[str] = ()


def together(
    tables: Sequence[Understood], robot: Robot, kind: Measurement, key: str = "", within: float | None = None
) -> Whole:
    """Return several tables as one; ``key`` and ``within`` are those of `TableOptions`.

    Tables that have joint and measured values each are stacked. Where some have the one and some the other, rows of
    equal keys (the label by default, else the only name that both have), or of the nearest times, are one row.
    """
    stems = row_stems(robot, kind)
    moving = [table for table in tables if table.stems & stems["joint"]]
    seen = [table for table in tables if table.stems & stems["measured"]]
    if len(tables) == 1 or (len(moving) == len(seen) == len(tables)):
        return _stacked(tables)
    if not moving or not seen or len(moving) + len(seen) != len(tables):
        lost = ", ".join(table.file for table in tables if table not in moving and table not in seen)
        found = f"{lost or 'some tables'} with only part of joint and measured values"
        raise InputError("--data", found, "tables that have both, or tables of joints and tables of measured values")
    joints = _stacked(moving)
    values = _stacked(seen)
    notes = [*joints.notes, *values.notes]
    if within is None:
        how, used, keys, others = _keys(moving, seen, joints, values, key)
        place = {name: i for i, name in enumerate(keys)}
        if len(place) < len(keys):
            twice = next(name for name, count in Counter(keys).items() if count > 1)
            raise InputError(f"the key {how}", f"'{twice}' twice in {moving[0].file}", "unique keys")
        right = [i for i, name in enumerate(others) if name in place]
        if not right:
            found = f"no common value in {moving[0].file} and {seen[0].file}"
            accepted = "--key with a column of common values, --key row, or --time-tolerance for the nearest time"
            raise InputError(f"the key {how}", found, accepted)
        names = [others[i] for i in right]
        left = [place[name] for name in names]
        notes.append(f"joined by {how}: {len(right)} rows of {len(keys)} with joints and {len(others)} measured.")
        known = set(names)
        lonely = [name for name in keys if name not in known] + [name for name in others if name not in place]
        if lonely:
            notes.append(f"without a match, left out: {listed(lonely)}.")
    else:
        if not (np.isfinite(within) and within >= 0):
            raise InputError("--time-tolerance", f"{within:g}", "a time [s], zero or more")
        clocks, there = _times(moving, key)
        other_clocks, then = _times(seen, key)
        used = [*clocks, *other_clocks]
        rounding = 4 * np.spacing(max(np.abs(there).max(), np.abs(then).max()))  # since 1970, half a microsecond
        at, of, apart = partners(there, then, within + rounding)
        if not len(at):
            nearest = float(np.abs(there - then[0]).min())
            found = f"no two within {within:g} s; the first measured row is {nearest:.6g} s from one with joints"
            raise InputError("times", found, "synchronized clocks, or a larger --time-tolerance")
        left, right = at.tolist(), of.tolist()
        labels = _labels(values.columns)
        names = [labels[i] for i in right]
        notes.append(
            f"joined by the nearest time: {len(right)} rows of {len(there)} with joints and {len(then)} measured; "
            f"times differ by {np.abs(apart).max():.3g} s at most, {apart.mean():+.3g} s on average."
        )
        lonely = [labels[i] for i in sorted(set(range(len(labels))) - set(right))]
        if lonely:
            several = f"{len(lonely)} measured rows without a match within {within:g} s, left out"
            notes.append(f"{several}: {listed(lonely)}.")
    sides = ((joints, left), (values, right))
    whole = {name: [cells[i] for i in rows] for side, rows in sides for name, cells in side.columns.items()}
    raw = {name: [cells[i] for i in rows] for side, rows in sides for name, cells in side.raw.items()}
    whole.pop("label", None)
    if len(set(names)) == len(names):
        whole = {"label": names, **whole}
    else:  # several measured values of a configuration
        whole.setdefault("configuration", names)
    return Whole(whole, raw, tuple(notes), used)


# --- below each other ----------------------------------------------------------------------------------------------


def _stacked(tables: Sequence[Understood]) -> Whole:
    """Return the rows of several tables below each other, in the units of the first."""
    first = tables[0]
    if len(tables) == 1:
        return Whole(first.columns, first.raw, ())
    wanted = {split_unit(name)[0]: name for name in first.columns if name != "label"}
    whole: dict[str, list[Any]] = {name: [] for name in wanted.values()}
    for table in tables:
        own = {split_unit(name)[0]: name for name in table.columns if name != "label"}
        lacking = own.keys() ^ wanted.keys()
        if lacking:
            found = f"{listed(sorted(lacking))} in one of {first.file} and {table.file} alone"
            accepted = "the same columns in all files, or one file of joints and one of values"
            raise InputError("the header", found, accepted)
        for stem, name in wanted.items():
            cells = table.columns[own[stem]]
            old, new = split_unit(own[stem])[1], split_unit(name)[1]
            if old is not None and new is not None and old.si != new.si:
                cells = [repr(float(cell) * old.si / new.si) for cell in cells]
            whole[name].extend(cells)
    labels = [_labels(table.columns) for table in tables]
    counts = ", ".join(f"{table.file} {len(own)}" for table, own in zip(tables, labels, strict=True))
    notes = [f"rows of the files are stacked: {counts}."]
    names = [name for own in labels for name in own]
    if len(set(names)) < len(names):
        files = [Path(table.file).stem for table in tables]
        if len(set(files)) < len(files):
            files = [str(i) for i in range(1, len(files) + 1)]
        names = [f"{file}:{name}" for file, own in zip(files, labels, strict=True) for name in own]
        notes.append("labels occur in several files: they are prefixed with the name of the file.")
    return Whole({"label": names, **whole}, _raw(tables), tuple(notes))


def _labels(columns: Columns) -> list[str]:
    count = len(next(iter(columns.values())))
    return [str(label) for label in columns.get("label", range(1, count + 1))]


# --- by a key ------------------------------------------------------------------------------------------------------


def _keys(
    moving: Sequence[Understood], seen: Sequence[Understood], joints: Whole, values: Whole, key: str
) -> tuple[str, Sequence[str], list[str], list[str]]:
    """Return what the key is, its columns, and the keys of the rows with joints and of the measured ones."""
    left, right = _raw(moving), _raw(seen)
    # columns of either side, labels or left out, that name every row alike
    sides = []
    for tables, raw in ((moving, left), (seen, right)):
        free = [each.column for each in tables[0].meant if each.name in ("", "label", "configuration")]
        cells = {name: _normal(raw[name.lower()]) for name in free if name.lower() in raw}
        sides.append({name: set(keys) for name, keys in cells.items() if all(keys) and len(set(keys)) == len(keys)})
    pairs = [
        (name, other)
        for (name, keys), (other, others) in product(sides[0].items(), sides[1].items())
        if len(keys & others) >= SAME * min(len(keys), len(others))
        and (key in ("", "row") or key.lower() in (name.lower(), other.lower()))
    ]
    names = [pair for pair in pairs if not _running(_normal(left[pair[0].lower()]))]
    pair = next(iter(names or pairs), None) if len(names or pairs) == 1 else None
    own: list[str] = []
    others: list[str] = []
    if pair:
        own, others = _normal(left[pair[0].lower()]), _normal(right[pair[1].lower()])
    if key == "row":
        count, other = (len(next(iter(side.columns.values()))) for side in (joints, values))
        if count != other:
            found = f"{count} rows of joints and {other} measured"
            raise InputError("--key row", found, "equal numbers of both, or a common column")
        there = set(others)
        wrong = sum(a != b and a in there for a, b in zip(own, others, strict=True))
        if names and pair and wrong:
            found = f"{wrong} of {len(own)} rows whose {pair[0]} is the {pair[1]} of another row"
            raise InputError("--key row", found, f"no --key, which joins by {' = '.join(pair)}")
        numbers = [str(i) for i in range(1, count + 1)]
        return "the number of the row", (), numbers, numbers
    if "label" in joints.columns and key in ("", "label"):
        labels = _normal(joints.columns["label"])
        for column in ("label", "configuration"):
            measured = _normal(values.columns.get(column, ()))
            if set(labels) & set(measured) and not (names and _running(labels)):
                return "label", (), labels, measured
    common = [name for name in left if name in right]
    name = key.lower()
    if not key and len(common) == 1 and not (names and pair):
        name = common[0]
    if name in common:
        return f"column '{name}'", (name,), _normal(left[name]), _normal(right[name])
    if pair:
        return " = ".join(pair), [each.lower() for each in pair], own, others
    found = f"'{key}'" if key else f"{', '.join(common) or 'no column'} in both {moving[0].file} and {seen[0].file}"
    accepted = "a common column, --key row for rows in the same order, or --time-tolerance"
    raise InputError("--key", found, f"{accepted} for the nearest time")


def _running(keys: Sequence[str]) -> bool:
    """Whether keys count the rows."""
    return keys == [str(i) for i in range(1, len(keys) + 1)]


def _raw(tables: Sequence[Understood]) -> Mapping[str, list[Any]]:
    """Return the columns that all files have, below each other, by names in lower case."""
    lower = [{name.lower(): cells for name, cells in table.raw.items()} for table in tables]
    common = [name for name in lower[0] if all(name in table for table in lower)]
    return {name: [cell for table in lower for cell in table[name]] for name in common}


def _normal(cells: Sequence[Any]) -> list[str]:
    """Return keys as texts, numbers without zeros before or behind them."""
    keys = [str(cell).strip() for cell in cells]
    return [str(int(key.partition(".")[0])) if re.fullmatch(r"\d+(?:\.0*)?", key) else key for key in keys]


# --- by the nearest time -------------------------------------------------------------------------------------------


def partners(left: Array, right: Array, within: float) -> tuple[np.ndarray, np.ndarray, Array]:
    """Return matching pairs of times (N,) and (M,) [s], and their differences (K,) [s].

    Each of the fewer belongs to the nearest of the others; of several whose nearest is the same one, the nearest alone
    (of equal times, all).
    """
    if len(left) < len(right):
        others, own, apart = partners(right, left, within)
        order = np.argsort(own, kind="stable")
        return own[order], others[order], -apart[order]
    _, partner = scipy.spatial.KDTree(left[:, None]).query(right[:, None])
    apart = right - left[partner]
    least = np.full(len(left), np.inf)
    np.minimum.at(least, partner, np.abs(apart))
    kept = np.flatnonzero((np.abs(apart) <= within) & (np.abs(apart) == least[partner]))
    return partner[kept], kept, apart[kept]


def _times(tables: Sequence[Understood], key: str) -> tuple[list[str], Array]:
    """Return the columns of times of some tables, in lower case, and the times [s] of all rows."""
    clocks = []
    found = []
    for table in tables:
        name = time_column(table.raw)
        if key and key.lower() != "time":
            name = next((column for column in table.raw if column.lower() == key.lower()), None)
        if name is None:
            lacks = f"no column '{key}'" if key else "no column of times"
            where = f"--time-tolerance, {table.file}"
            raise InputError(where, f"{lacks} among {', '.join(table.raw)}", "one called time, or --key with it")
        clocks.append(name.lower())
        found.append(seconds(name, table.raw[name]))
    return clocks, np.concatenate(found)


def time_column(names: Iterable[str]) -> str | None:
    """Return the first column that is called a time, ``Time [ms]``, ``header.stamp``; None where there is none."""
    return next((name for name in names if TIME.fullmatch(_split_time(name)[0].replace("_", " "))), None)


def seconds(name: str, cells: Sequence[Any]) -> Array:
    """Return times (N,) [s] of a column's numbers, in the unit of its name, or of its dates (ISO 8601).

    Numbers without a unit are seconds, or, where that would be after the year 5000, what since 1970 is in our time.
    Dates without a zone are UTC.
    """
    texts = [str(cell).strip() for cell in cells]
    times = np.array([numeral(text) for text in texts])
    dates = bool(np.isnan(times[:1]).any())
    if dates:
        for i, text in enumerate(texts):
            with suppress(ValueError):
                date = datetime.fromisoformat(text)
                times[i] = date.replace(tzinfo=date.tzinfo or UTC).timestamp()
    if np.isnan(times).any():
        i = int(np.isnan(times).argmax())
        accepted = "numbers, or dates as 2026-05-31T12:00:00"
        raise InputError(f"column '{name}', row {i + 1}", f"'{texts[i]}'", accepted)
    if dates:
        return times
    size = np.abs(times).max(initial=0.0)
    guessed = next((unit for least, unit in SINCE_1970 if size >= least), "s")
    return SECONDS[_split_time(name)[1].casefold() or guessed] * times


def _split_time(name: str) -> tuple[str, str]:
    match = UNIT.fullmatch(name.strip().replace("_", " "))
    return (match[1].strip(), match[2]) if match else (name.strip(), "")
