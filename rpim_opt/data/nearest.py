"""Tables of joints and of measured values joined by the nearest time, whatever the rates of their clocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import listed
from rpim_opt.data.joining import beside, named
from rpim_opt.data.stacking import Whole, labels, stacked
from rpim_opt.data.times import seconds, time_column
from rpim_opt.data.understanding import Understood


class Pairs(NamedTuple):
    """Rows of one table with rows of another one, and by how much their times differ [s]."""

    left: np.ndarray
    right: np.ndarray
    apart: Array


def nearest(moving: Sequence[Understood], seen: Sequence[Understood], key: str, within: float) -> Whole:
    """Return rows of joints beside the measured values of the nearest time.

    Every row of the shorter table looks for its partner in the longer one, where a row is the partner of the nearest
    alone (of readings of one time, of all).

    Parameters
    ----------
    moving, seen
        Tables of joints, and of measured values.
    key
        The column of the times; one that is called so by default.
    within
        How far times of partners may be apart [s].

    Raises
    ------
    InputError
        For a table without times, a tolerance that is none, and no two rows so near.
    """
    if not (np.isfinite(within) and within >= 0):
        raise InputError("--within", f"{within:g}", "a time [s], zero or more")
    joints = stacked(moving)
    values = stacked(seen)
    there = _times(moving, key)
    then = _times(seen, key)
    pairs = partners(there, then, within)
    if not len(pairs.left):
        apart = float(np.abs(there[:, None] - then[:1]).min())
        found = f"no two within {within:g} s; the first measured row is {apart:.4g} s from the nearest with joints"
        raise InputError("times", found, "clocks that agree, or a larger --within")
    whole = beside(joints.columns, pairs.left.tolist(), values.columns, pairs.right.tolist())
    names = [labels(values.columns)[i] for i in pairs.right]
    note = (
        f"joined by the nearest time: {len(pairs.left)} rows of {len(there)} with joints and {len(then)} measured; "
        f"times differ by {np.abs(pairs.apart).max():.3g} s at most, {pairs.apart.mean():+.3g} s on average."
    )
    notes = [*joints.notes, *values.notes, note]
    lonely = [label for i, label in enumerate(labels(values.columns)) if i not in set(pairs.right.tolist())]
    if lonely:
        notes.append(f"{len(lonely)} measured rows without a partner within {within:g} s, left out: {listed(lonely)}.")
    return Whole(named(whole, names), tuple(notes))


def partners(left: Array, right: Array, within: float) -> Pairs:
    """Return which times (N,) and (M,) [s] belong together: each of the fewer with the nearest of the others.

    >>> import numpy as np
    >>> from rpim_opt.data.nearest import partners
    >>> pairs = partners(np.arange(0.0, 1.0, 0.01), np.array([0.104, 0.501, 7.0]), within=0.005)
    >>> pairs.left.tolist(), pairs.right.tolist(), pairs.apart.round(3).tolist()
    ([10, 50], [0, 1], [0.004, 0.001])
    """
    if len(left) < len(right):
        turned = partners(right, left, within)
        order = np.argsort(turned.right, kind="stable")
        return Pairs(turned.right[order], turned.left[order], -turned.apart[order])
    order = np.argsort(left, kind="stable")
    ordered = left[order]
    after = np.clip(np.searchsorted(ordered, right), 1, max(len(left) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(left) - 1)
    nearer = np.where(np.abs(ordered[after] - right) < np.abs(ordered[before] - right), after, before)
    partner = order[nearer]
    apart = right - left[partner]
    kept = np.flatnonzero(np.abs(apart) <= within)
    least: dict[int, float] = {}
    for i in kept:
        least[int(partner[i])] = min(least.get(int(partner[i]), np.inf), abs(float(apart[i])))
    kept = np.array([i for i in kept if abs(float(apart[i])) == least[int(partner[i])]], dtype=int)
    return Pairs(partner[kept], kept, apart[kept])


def _times(tables: Sequence[Understood], key: str) -> Array:
    """Return the times [s] of all rows of some tables."""
    found = []
    for table in tables:
        name = time_column(table.raw)
        if key and key.lower() != "time":
            name = next((column for column in table.raw if column.lower() == key.lower()), None)
        if name is None:
            what = "no column of times"
            if key:
                what = f"no column '{key}'"
            columns = ", ".join(table.raw)
            raise InputError(f"--within, {table.file}", f"{what} among {columns}", "one called time, or --key with it")
        found.append(seconds(name, table.raw[name]))
    return np.concatenate(found)
