"""Minimization along a line without SciPy's optimizers, which take longer to import than a calibration takes."""

from __future__ import annotations

from collections.abc import Callable

GOLDEN = (3 - 5**0.5) / 2
"""Part of an interval at which it is divided."""
MOST = 500
"""Values that are asked for, at most."""
Point = tuple[float, float]
"""Where, and the value there."""


def least(function: Callable[[float], float], low: float, high: float, accuracy: float) -> Point:
    """Return where a function is least between two numbers, and its value there (Brent 1973).

    Each step goes to the vertex of the parabola through the three best points where steps shrink that way, and else
    divides the larger side by the golden section. A minimum at an end is found next to it, within ``accuracy``.

    >>> from rpim_opt.basics.minimization import least
    >>> x, value = least(lambda x: (x - 2) ** 2 + 1, 0.0, 5.0, 1e-6)
    >>> round(x, 6), round(value, 6)
    (2.0, 1.0)
    """
    start = low + GOLDEN * (high - low)
    points = [(start, float(function(start)))] * 3  # the best three, best first
    last = before = high - low
    for _ in range(MOST):
        best = points[0][0]
        middle = (low + high) / 2
        if abs(best - middle) + (high - low) / 2 <= accuracy:
            break
        step = _to_vertex(points)
        if step is None or abs(step) >= abs(before) / 2 or not low < best + step < high:
            last = high - best
            if best > middle:
                last = low - best
            step = GOLDEN * last
        before = last
        last = step
        if abs(step) < accuracy / 3:  # nearer than that, values say nothing
            step = accuracy / 3
            if middle < best:
                step = -step
        tried = (best + step, float(function(best + step)))
        low, high = _between(low, high, points[0], tried)
        points = _three_best(points, tried)
    return points[0]


def _to_vertex(points: list[Point]) -> float | None:
    """Return the way from the first of three points to their parabola's lowest; None where there is none."""
    (x, y), (v, f), (w, g) = points
    one = (x - v) * (y - g)
    other = (x - w) * (y - f)
    below = 2 * (one - other)
    if below == 0:
        return None
    return ((x - w) * other - (x - v) * one) / below


def _between(low: float, high: float, best: Point, tried: Point) -> Point:
    """Return the interval that the minimum is left to lie in."""
    inner, outer = sorted([best, tried], key=lambda point: point[1])
    if outer[0] < inner[0]:
        return outer[0], high
    return low, outer[0]


def _three_best(points: list[Point], tried: Point) -> list[Point]:
    """Return the best point and two more, with one that was tried."""
    if tried[1] <= points[0][1]:
        return [tried, *points[:2]]
    if tried[1] <= points[1][1] or points[1] == points[0]:
        return [points[0], tried, points[1]]
    if tried[1] <= points[2][1] or points[2] in points[:2]:
        return [*points[:2], tried]
    return points
