"""Joining of raw tables: complete tables are stacked, others are joined by a key or the nearest time."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from itertools import groupby, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.text import listed
from rpim_opt.basics.units import numeral, split_unit
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.tables.understanding import CanonicalTable, counts_rows, row_stems
from rpim_opt.robot.mdh import Robot

TIME = re.compile(r"(?i)[%#]?(?:.*[._/ ])?(time ?stamp|date ?time|time|stamp|(uhr)?zeit|zeitstempel|date|datum|t)"
                  r"(\W*(utc|gmt|local)\W*)?")  # fmt: skip
NUMBERED = re.compile(r"(\D*)0*(\d+)\W?")
GERMAN = re.compile(r"(\d\d)\.(\d\d)\.(\d{4})[ T]*")
SLASHES = re.compile(r"(\d{1,2})/(\d{1,2})/(\d{4})[ ,T]*")
ONE_DIGIT = re.compile(r"(?<=[ T])(?=\d:)")  # hours
HALF_DAY = re.compile(r"(?i)(\d{1,2})(:\d\d.*?)\s*([ap])\.?m\.?")
UNIT = re.compile(r"(.+?)[\s_]*[\[(/]?\s*\b(s|sec|secs|seconds|ms|us|µs|ns|nsec|nsecs)\b\s*[\])]?", re.IGNORECASE)
SECONDS = {"s": 1.0, "sec": 1.0, "secs": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "μs": 1e-6, "ns": 1e-9,
           "nsec": 1e-9, "nsecs": 1e-9}  # fmt: skip
"""Seconds per unit, by its name in lower case (`str.casefold`)."""
STAMP, NANOSECONDS = re.compile(r"(?i)(.*stamp[._/])secs?"), ("nsecs", "nsec", "nanosec")
"""A ROS time in two columns: whole seconds, and endings of the other column's name."""
COUNTER = re.compile(r"(?i)(.*[._/ ])?seq")
"""A ROS publisher's counter of its own messages: no key between two tables."""
SAME = 0.8
"""Share of the shorter column's values that two differently named columns share if they are one key."""
OTHER_KEYS = "--key row for rows in the same order, or --time-tolerance for the nearest time"
SIMULTANEOUS = 0.01
"""Times closer than this part of the shortest interval between rows are those of one row."""
LOG, SMALL, MOVED = 2, 0.5, 0.01
"""A log has more rows of joints per measured one, or a smaller median joint step [deg]; a larger change is named."""
PAUSE = 10  # multiple of the usual time step that counts as a gap in the log
OFFSETS, STILL = np.linspace(-5, 5, 501), 0.02
"""Trial offsets between two clocks [s], and how long the robot rests before and after a measurement [s]."""
RESTING, FEWEST = 0.95, 6  # share of measured rows at rest with the right offset, and the rows needed to find it
SINCE_1970 = ((1e17, "ns"), (1e14, "us"), (1e11, "ms"))
"""Number from which on a time without a unit since 1970 is in this unit: seconds would be in the year 5000."""


class Key(NamedTuple):
    """Key that joins two tables: its name, its columns, and its values in the rows of joints and of measured values."""

    how: str
    columns: tuple[str, ...]
    left: list[str]
    right: list[str]


class Match(NamedTuple):
    """Which rows of joints and of measured values belong together, their names, notes, and the columns that match."""

    left: Sequence[int]
    right: Sequence[int]
    names: Sequence[str]
    notes: Sequence[str]
    columns: tuple[str, ...]


def together(
    tables: Sequence[CanonicalTable], robot: Robot, kind: Measurement, key: str = "", within: float | None = None
) -> CanonicalTable:
    """Return tables stacked if each is complete, else joined; ``key`` and ``within`` as in `TableOptions`."""
    stems = row_stems(robot, kind)
    moving = [table for table in tables if table.stems & stems["joint"]]
    seen = [table for table in tables if table.stems & stems["measured"]]
    if len(tables) == 1 or (len(moving) == len(seen) == len(tables)):
        return _stacked(tables)
    if not moving or not seen or len(moving) + len(seen) != len(tables):
        lost = [table for table in tables if table not in moving and table not in seen]
        lost = lost or [table for table in tables if table not in moving or table not in seen]
        found = "; ".join(f"{table.file} ({listed([each.column for each in table.meant], 12)})" for table in lost)
        accepted = "in every file, or in one file each, joint values named as A1, J1, Axis 1 or q1_deg and measured "
        accepted += f"values {', '.join(kind.columns)}"
        raise InputError("--data", f"no joint values or no measured values in {found}", accepted)
    columns = [each.column for table in tables for each in table.meant]
    if key.lower() not in ("", "row", "label", "time", *map(str.lower, columns)):
        raise InputError("--key", f"'{key}', no column of the files", choices(key, columns))
    joints, values = _stacked(moving), _stacked(seen)
    match = _by_key(joints, values, key) if within is None else _by_time(joints, values, key, within)
    left, right = joints.take(match.left), values.take(match.right)
    columns = {**left.columns, **right.columns}
    columns.pop("label", None)
    own = right.columns.get("label", ())
    if len(set(match.names)) == len(match.names):
        columns = {"label": match.names, **columns}
    else:  # several measured values of a configuration
        columns.setdefault("configuration", match.names)
        if len(set(own)) == len(match.names):
            columns = {"label": own, **columns}
    notes = (*joints.notes, *values.notes, *match.notes)
    return replace(right, columns=columns, raw={**left.raw, **right.raw}, notes=notes, keys=match.columns)


def _stacked(tables: Sequence[CanonicalTable]) -> CanonicalTable:
    """Return the rows of several tables below each other, in the units of the first."""
    first = tables[0]
    if len(tables) == 1:
        return replace(first, notes=())
    whole: dict[str, list[Any]] = {"label": [label for table in tables for label in table.labels]}
    for table in tables:
        for name, cells in _in_units_of(first, table).items():
            whole.setdefault(name, []).extend(cells)
    notes = [f"rows of the files are stacked: {', '.join(f'{each.file} {len(each.labels)}' for each in tables)}."]
    if len(set(whole["label"])) < len(whole["label"]):
        files = [Path(table.file).stem for table in tables]
        if len(set(files)) < len(files):
            files = [str(i) for i in range(1, len(files) + 1)]
        whole["label"] = [f"{file}:{label}" for file, each in zip(files, tables, strict=True) for label in each.labels]
        notes.append("labels occur in several files: they are prefixed with the name of the file.")
    common = [name for name in first.raw if all(name in table.raw for table in tables)]
    raw = {name: [cell for table in tables for cell in table.raw[name]] for name in common}
    return replace(first, columns=whole, raw=raw, notes=tuple(notes))


def _in_units_of(first: CanonicalTable, table: CanonicalTable) -> dict[str, Sequence[Any]]:
    """Return the columns of a table, but its labels, by the names and in the units of the first one's."""
    names, own = ({split_unit(name)[0]: name for name in of.columns if name != "label"} for of in (first, table))
    lacking = own.keys() ^ names.keys()
    if lacking:
        found = f"{listed(sorted(lacking))} in only one of {first.file} and {table.file}"
        accepted = "the same columns in all files, or one file of joints and one of values"
        raise InputError("the header", found, accepted)
    columns: dict[str, Sequence[Any]] = {}
    for stem, name in names.items():
        columns[name] = table.columns[own[stem]]
        old, new = split_unit(own[stem])[1], split_unit(name)[1]
        if old is not None and new is not None and old.si != new.si:
            columns[name] = [repr(float(cell) * old.si / new.si) for cell in columns[name]]
    return columns


def _by_key(joints: CanonicalTable, values: CanonicalTable, key: str) -> Match:
    """Return the rows of equal keys; where none or few times are equal and all nearly are, of the nearest times."""
    chosen = _key(joints, values, key)
    count = len(chosen.left)
    if sorted([chosen.left, chosen.right]) == [[str(i) for i in range(k, k + count)] for k in (0, 1)]:
        chosen = _row_numbers(joints, values, None)  # either file may count from 0
    again = {name: number for name, number in Counter(chosen.left).items() if number > 1}
    place = {name: i for i, name in enumerate(chosen.left) if name not in again}
    if len(place) < SAME * len(chosen.left):
        raise InputError(f"the key {chosen.how}", f"'{next(iter(again))}' twice in {joints.file}", "unique keys")
    right = [i for i, name in enumerate(chosen.right) if name in place]
    times = not key and all(time_column([name]) for name in chosen.columns or [""])
    few = len(right) < max(SAME * min(len(place), len(chosen.right)), len(chosen.right) / 2)
    if not right or (times and few):
        within = 0.0 if key else _simultaneous(joints, values)
        if within:
            return _by_time(joints, values, key, within)
        raise _few_common(joints, values, chosen, len(right), times)
    passes: dict[int, int] = {}  # how often the run with a measured row's name has come
    begun: Counter[str] = Counter()
    for name, run in groupby(range(len(chosen.right)), chosen.right.__getitem__):
        begun[name] += 1
        passes |= dict.fromkeys(run, begun[name])
    right.sort(key=lambda i: (passes[i], place[chosen.right[i]]))
    names = [chosen.right[i] for i in right]
    counts = f"{len(right)} rows match, of {len(chosen.left)} with joints and {len(chosen.right)} measured"
    notes = [f"joined by {chosen.how}: {counts}."]
    if again:
        names_again = f"{listed(list(again))}. To keep them: {OTHER_KEYS}."
        notes.append(f"several rows of {joints.file} have the same name, ignored: {names_again}")
    matched, known = set(names), {*place, *again}
    lonely = [name for name in place if name not in matched] + [name for name in chosen.right if name not in known]
    if lonely:
        notes.append(f"without a match, ignored: {listed(lonely)}.")
    return Match([place[name] for name in names], right, names, notes, chosen.columns)


def _simultaneous(joints: CanonicalTable, values: CanonicalTable) -> float:
    """Return the tolerance [s] within which every measured row has its own row of joints in time, or 0."""
    if any(time_column(side.raw) is None or len(side.labels) < 2 for side in (joints, values)):
        return 0.0
    there, then = (_times(side, "")[1] for side in (joints, values))
    within = SIMULTANEOUS * float(min(np.diff(np.sort(there)).min(), np.diff(np.sort(then)).min()))
    return within * (len(partners(there, then, within)[1]) == len(then))


def _few_common(joints: CanonicalTable, values: CanonicalTable, key: Key, count: int, times: bool) -> InputError:
    """Return the error that a key, or equal ``times``, are common to so few rows."""
    names = [f"{side.file} ({listed(keys, 3)})" for side, keys in ((joints, key.left), (values, key.right))]
    accepted = f"--key with a column of common values, {OTHER_KEYS}"
    if times:
        accepted = (
            f"--key with a column that names the points, --time-tolerance SECONDS for the nearest time, or --key "
            f"'{key.columns[0]}' for equal ones alone"
        )
    return InputError(f"the key {key.how}", f"{count or 'no'} common values in {' and '.join(names)}", accepted)


def _key(joints: CanonicalTable, values: CanonicalTable, key: str) -> Key:
    """Return the key as stated, else the label, the only common column, the only pair with the same values or numbers.

    A label that merely counts rows is none if two columns with the same values distinguish the rows.
    """
    pairs = _pairs(joints, values, key)
    telling = [pair for pair in pairs if not counts_rows(pair.left)]
    if key == "row":
        return _row_numbers(joints, values, telling[0] if len(telling) == 1 else None)
    pairs = telling or pairs
    labels = _normal(joints.columns.get("label", ()))
    if key in ("", "label") and not (telling and counts_rows(labels)):
        for column in ("label", "configuration"):
            other = _keyed("label", (), labels, _normal(values.columns.get(column, ())))
            if {*labels} & {*other.right}:
                return other
    common = [name for name in joints.raw if name in values.raw]
    common = [name for name in common if name == key.lower() or not COUNTER.fullmatch(name)]
    stated = [name for name in common if name == key.lower()] if key else common
    if len(stated) == 1 and (key or not telling or len(pairs) > 1):
        (name,) = stated
        return _keyed(f"column '{name}'", (name,), _normal(joints.raw[name]), _normal(values.raw[name]))
    same = pairs or _pairs(joints, values, key, numbers=True)
    if len(same) == 1:
        return same[0]
    found = f"{', '.join(common) or 'no column'} in both {joints.file} and {values.file}"
    if key:
        found = f"'{key}', whose values no column of the other file has"
    for side in (joints, values):
        found += "".join(f"; {name} of {side.file}: {listed(keys, 3)}" for name, keys in _naming(side).items())
    raise InputError("--key", found, f"--key with a column of common values, {OTHER_KEYS}")


def _pairs(joints: CanonicalTable, values: CanonicalTable, key: str, numbers: bool = False) -> list[Key]:
    """Return the keys that two columns make whose values, or the ``numbers`` in these, are nearly the same."""
    keys = (
        _keyed(f"{name} = {other}", (name.lower(), other.lower()), own, others, numbers)
        for (name, own), (other, others) in product(_naming(joints).items(), _naming(values, key).items())
        if key in ("", "row") or key.lower() in (name.lower(), other.lower())
    )
    sides = ((each, {*each.left}, {*each.right}) for each in keys)
    return [each for each, own, others in sides if len(own & others) >= max(SAME * min(len(own), len(others)), 1)]


def _keyed(how: str, columns: tuple[str, ...], left: list[str], right: list[str], numbers: bool = False) -> Key:
    """Return a key; measured names that differ only in case and leading zeros are spelled as in the table of joints.

    With ``numbers``, names may differ that are one word and a number, or a number alone, on each side: ``XP1``, ``P1``.
    """

    def bare(name: str) -> str:
        return NUMBERED.sub(r"\2", name) if numbers else re.sub(r"(?<![\d.,])0+(?=\d)", "", name.casefold())

    for names in (left, right):
        words = {NUMBERED.sub(r"\1", name) if NUMBERED.fullmatch(name) else None for name in names}
        spelled = len(words) == 1 and None not in words if numbers else any(map(str.isalpha, "".join(names[:1])))
        if not spelled or len({*map(bare, names)}) < len({*names}):  # other numbers, and dates
            return Key(how, columns, left, right)
    spelling = {bare(name): name for name in left}
    named = [spelling.get(bare(name), name) for name in right]
    examples = (f" ('{old}' as '{new}')" for old, new in zip(right, named, strict=True) if old != new)
    return Key(how + next(examples, ""), columns, left, named)


def _naming(table: CanonicalTable, key: str = "") -> dict[str, list[str]]:
    """Return the cells of label or unused columns that identify nearly every row of a reflector and session.

    Names of re-measured reference points may recur; those of the column ``key`` may recur in any row.
    """
    free = [each.column for each in table.meant if each.name in ("", "label", "configuration")]
    free = [name for name in free if not COUNTER.fullmatch(name)]
    cells = {name: _normal(table.raw[name.lower()]) for name in free if name.lower() in table.raw}
    apart = [table.columns[name] for name in ("marker", "session") if name in table.columns]
    rows = {name: {*zip(keys, *apart, strict=True)} for name, keys in cells.items()}
    unique = {name: name.lower() == key.lower() or len(rows[name]) >= SAME * len(cells[name]) for name in cells}
    return {name: keys for name, keys in cells.items() if all(keys) and unique[name]}


def _row_numbers(joints: CanonicalTable, values: CanonicalTable, pair: Key | None) -> Key:
    """Return the numbers of the rows as the key, unless a pair of columns shows that the rows are in another order."""
    count, other = len(joints.labels), len(values.labels)
    if count != other:
        found = f"{count} rows of joints and {other} measured"
        raise InputError("--key row", found, "equal numbers of both, or a common column")
    if pair:
        there = set(pair.right)
        wrong = sum(a != b and a in there for a, b in zip(pair.left, pair.right, strict=True))
        if wrong:
            name, other_name = pair.how.split(" = ")
            found = f"{wrong} of {count} rows whose {name} matches {other_name} in another row"
            raise InputError("--key row", found, f"no --key, to join by {pair.how}")
    named = [_normal(side.columns.get("label", ())) for side in (joints, values)]
    names = next((each for each in named if len({*each}) == count), [str(i) for i in range(1, count + 1)])
    return Key("the number of the row", (), names, names)


def _normal(cells: Sequence[Any]) -> list[str]:
    """Return keys as texts: numbers without zeros before or behind them, ``Collection::Group::P1`` as P1."""
    keys = [str(cell).strip() for cell in cells]
    last = [key.rpartition("::")[2] for key in keys]
    if len(set(last)) == len(set(keys)):
        keys = last
    return [str(int(key.partition(".")[0])) if re.fullmatch(r"\d+(?:\.0*)?", key) else key for key in keys]


def partners(left: Array, right: Array, within: float) -> tuple[np.ndarray, np.ndarray, Array]:
    """Return matching pairs of times (N,) and (M,) [s] as two index arrays (K,), and their differences (K,) [s].

    Two times match if each is the closest to the other.
    """
    far, partner = scipy.spatial.KDTree(left[:, None]).query(right[:, None])
    least, _ = scipy.spatial.KDTree(right[:, None]).query(left[:, None])
    rows = np.flatnonzero((far <= within) & (far == least[partner]))
    return partner[rows], rows, (right - left[partner])[rows]


def _by_time(joints: CanonicalTable, values: CanonicalTable, key: str, within: float) -> Match:
    if not (np.isfinite(within) and within >= 0):
        raise InputError("--time-tolerance", f"{within:g}", "a time [s], zero or more")
    clocks, (there, then) = zip(*(_times(side, key) for side in (joints, values)), strict=True)
    rounding = 4 * np.spacing(max(np.abs(there).max(), np.abs(then).max()))  # of times since 1970: half a microsecond
    markers = np.array(values.columns.get("marker", [""] * len(then)))
    found = []
    for marker in sorted(set(markers)):  # a row of joints matches one measured row of each reflector
        own = np.flatnonzero(markers == marker)
        rows, of_own, apart = partners(there, then[own], within + rounding)
        found.append((rows, own[of_own], apart))
    left, right, apart = (np.concatenate(each) for each in zip(*found, strict=True))
    order = np.lexsort((right, left))
    left, right, apart = left[order], right[order], apart[order]
    if not len(left):
        nearest = float(np.abs(there - then[0]).min())
        found = f"none within {within:g} s of each other; the first measured row is {nearest:.6g} s from any joint row"
        raise InputError("times", found, "synchronized clocks, or a larger --time-tolerance")
    labels = values.labels
    notes = [
        f"joined by the nearest time: {len(right)} rows match, of {len(there)} with joints and {len(then)} measured; "
        f"times differ by {np.abs(apart).max():.3g} s at most, {apart.mean():+.3g} s on average."
    ]
    moved, ordered = _motion(joints, there, there[left], then[right]), np.unique(there)
    usual = np.median(np.diff(ordered, append=np.inf))
    pause = np.diff(ordered, prepend=-np.inf, append=np.inf) > PAUSE * usual
    moved[pause[np.searchsorted(ordered, then[right])]] = 0.0  # across a gap nothing is known
    steps = _motion(joints, there, ordered[:-1], ordered[1:])
    if moved.max() > MOVED and (len(there) > LOG * len(right) or np.median(steps) < SMALL):
        count = np.count_nonzero(moved > MOVED)
        notes.append(
            f"the robot moved by up to {moved.max():.2g} degrees between measurement and joint values in {count} of "
            f"{len(right)} joined rows: leave out rows in which it moves. Or do the clocks differ? "
            f"{_clocks(joints, there, then[right])}"
        )
    lonely = [labels[i] for i in sorted(set(range(len(labels))) - set(right.tolist()))]
    if lonely:
        several = f"{len(lonely)} measured rows without a match within {within:g} s, ignored"
        notes.append(f"{several}: {listed(lonely)}.")
    names = [labels[i] for i in right]
    if len(set(left.tolist())) < len(left):
        names = [joints.labels[i] for i in left]
    return Match(left.tolist(), right.tolist(), names, notes, clocks)


def _clocks(joints: CanonicalTable, times: Array, moments: Array) -> str:
    """Say what to add to moments (K,) [s] of measurements for the robot to stand still at the most of them."""
    when = moments + OFFSETS[:, None]
    still = (when > times.min()) & (when < times.max()) & (_motion(joints, times, when - STILL, when + STILL) < MOVED)
    good = np.flatnonzero(still.mean(axis=1) > RESTING)
    if not len(good) or len(moments) < FEWEST:
        return "If so, add the offset to the times of one file."
    runs = np.split(good, np.flatnonzero(np.diff(good) > 1) + 1)
    nearest = OFFSETS[min(runs, key=lambda run: np.abs(OFFSETS[run]).min())]
    return (
        f"The robot is at rest if {nearest.mean():+.2g} s ({nearest[0]:+.2f} to {nearest[-1]:+.2f}) are added to the "
        "times of the measured rows: add this clock offset to that column."
    )


def _motion(joints: CanonicalTable, times: Array, start: Array, end: Array) -> Array:
    """Return the largest change [deg] of a revolute joint from start to end times [s], linear between rows."""
    order = np.argsort(times)
    largest = np.zeros(start.shape)
    for name, cells in joints.columns.items():
        stem, unit = split_unit(name)
        if re.fullmatch(r"q\d+", stem) and unit and unit.dimension == "angle":
            values = np.degrees(unit.si * np.array([numeral(str(cell)) for cell in cells]))
            before, after = (np.interp(moments, times[order], values[order]) for moments in (start, end))
            largest = np.fmax(largest, np.abs(after - before))
    return largest


def _times(table: CanonicalTable, key: str) -> tuple[str, Array]:
    """Return the column of a table's times, the stated one if it has it, and the times [s] of its rows."""
    name = key.lower() if key.lower() in table.raw else time_column(table.raw)
    for whole in table.raw if name is None else [name]:
        match = STAMP.fullmatch(whole)
        fractions = [table.raw.get(f"{match[1]}{ending}") for ending in NANOSECONDS] if match else []
        for fraction in filter(None, fractions):
            cells = zip(table.raw[whole], fraction, strict=True)
            return whole, np.array([numeral(str(s)) + 1e-9 * numeral(str(ns)) for s, ns in cells])
    if name is None:
        columns = ", ".join(each.column for each in table.meant)
        found = f"no column of times among {columns}"
        raise InputError(f"--time-tolerance, {table.file}", found, "one called time, or --key with it")
    return name, seconds(name, table.raw[name])


def time_column(names: Iterable[str]) -> str | None:
    """Return the first column that is called a time, ``Time [ms]``, ``header.stamp``; None where there is none."""
    return next((name for name in names if TIME.fullmatch(_split_time(name)[0].replace("_", " "))), None)


def seconds(name: str, cells: Sequence[Any]) -> Array:
    """Return times (N,) [s] from numbers, in the unit of the column's name, or from dates: ISO 8601, DIN 1355, UTC.

    In dates with slashes a number above 12 shows the order of month and day; in 12-hour format the month is first.
    """
    texts = [str(cell).strip() for cell in cells]
    times = np.array([numeral(text) for text in texts])
    dates = bool(np.isnan(times[:1]).any())
    if dates:
        for i, text in enumerate(_iso_dates(name, texts)):
            with suppress(ValueError):
                date = datetime.fromisoformat(text)
                times[i] = date.replace(tzinfo=date.tzinfo or UTC).timestamp()
    for i in np.flatnonzero(np.isnan(times)).tolist():
        accepted = "numbers, or dates as 2026-05-31T12:00:00, 31.05.2026 12:00:00 or 05/31/2026 12:00:00 PM"
        raise InputError(f"column '{name}', row {i + 1}", f"'{texts[i]}'", accepted)
    if dates:
        return times
    size = np.abs(times).max(initial=0.0)
    guessed = next((unit for least, unit in SINCE_1970 if size >= least), "s")
    return SECONDS[_split_time(name)[1].casefold() or guessed] * times


def _iso_dates(name: str, texts: Sequence[str]) -> list[str]:
    """Return dates of other countries as ISO 8601, all with month and day in the same order."""

    def of_24_hours(half: re.Match[str]) -> str:
        return f"{int(half[1]) % 12 + 12 * (half[3].lower() == 'p'):02d}{half[2]}"

    parts = [match for match in map(SLASHES.match, texts) if match]
    month_first = any(map(HALF_DAY.search, texts)) or any(int(match[2]) > 12 for match in parts)
    day_first = any(int(match[1]) > 12 for match in parts)
    if not (month_first or day_first) and len({match[0] for match in parts}) > 1:
        found = f"'{parts[0][0].rstrip()}', whose order of month and day no number above 12 shows"
        raise InputError(f"column '{name}'", found, "dates as 2026-05-31T12:00:00")
    month, day = (2, 1) if day_first else (1, 2)
    iso = [SLASHES.sub(lambda of: f"{of[3]}-{of[month]:0>2}-{of[day]:0>2} ", text) for text in texts]
    iso = [HALF_DAY.sub(of_24_hours, GERMAN.sub(r"\3-\2-\1 ", text)).strip() for text in iso]
    return [ONE_DIGIT.sub("0", text.replace("/", "-").replace(",", ".")) for text in iso]


def _split_time(name: str) -> tuple[str, str]:
    match = UNIT.fullmatch(name.strip().replace("_", " "))
    return (match[1].strip(), match[2]) if match else (name.strip(), "")
