"""Where a convex function along a line is about least."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

P = TypeVar("P")

ENOUGH = 0.3
"""A search ends where the slope is this part of the first."""
TRIES, MARGIN = 8, 0.05
"""Points of a search at most, and how near to an end of the bracket, relative to it, the next one may lie."""


def searched(at: Callable[[float], P], rise: Callable[[P], float], begin: P, longer: bool) -> P:
    """Return a point on a line where a convex function has a small slope, by secants and halves of a bracket.

    Parameters
    ----------
    at, rise
        The point at a number t, and the function's slope by t there.
    begin
        The point at zero, where the function falls.
    longer
        Whether t may exceed 1.
    """
    first = rise(begin)
    if not first < 0:
        return begin
    low, slope_low, below = 0.0, first, begin
    high, slope_high = np.inf, np.inf
    t = 1.0
    for k in range(TRIES):
        there = at(t)
        slope = rise(there)
        if abs(slope) <= ENOUGH * abs(first):
            return there
        if slope < 0:
            low, slope_low, below = t, slope, there
            if not longer and t >= 1:
                return there
        else:
            high, slope_high = t, slope
        t = _between(low, slope_low, high, slope_high, k % 2 == 1)
    return below


def _between(low: float, slope_low: float, high: float, slope_high: float, halved: bool) -> float:
    """Return where to look next between a falling and a rising slope."""
    if not np.isfinite(high):
        return 2 * low
    share = 0.5
    if np.isfinite(slope_high) and not halved:
        share = min(max(slope_low / (slope_low - slope_high), MARGIN), 1 - MARGIN)
    return low + share * (high - low)
