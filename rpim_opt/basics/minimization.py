"""Minimization of a function of one variable; importing SciPy's optimizers takes longer than a calibration."""

from __future__ import annotations

from collections.abc import Callable

GOLDEN = (3 - 5**0.5) / 2
"""Part of an interval at which it is divided."""
MOST = 500
"""Values that are asked for, at most."""
Point = tuple[float, float]
"""Where, and the value there."""


def least(function: Callable[[float], float], low: float, high: float, accuracy: float) -> Point:
    """Return the minimizer of a function on an interval, and the minimum (Brent 1973).

    Each step goes to the vertex of the parabola through the three best points where steps shrink that way, and else
    divides the larger side by the golden section. A minimum at an end is found next to it, within ``accuracy``.
    """
    start = low + GOLDEN * (high - low)
    points = [(start, float(function(start)))]  # the best three, best first
    last = before = high - low
    for _ in range(MOST):
        best = points[0][0]
        middle = (low + high) / 2
        if abs(best - middle) + (high - low) / 2 <= accuracy:
            break
        step = None
        if len(points) == 3:  # to the lowest point of their parabola
            (x, y), (v, f), (w, g) = points
            one = (x - v) * (y - g)
            other = (x - w) * (y - f)
            if one != other:
                step = ((x - w) * other - (x - v) * one) / (2 * (one - other))
        if step is None or abs(step) >= abs(before) / 2 or not low < best + step < high:
            last = low - best if best > middle else high - best
            step = GOLDEN * last
        before = last
        last = step
        if abs(step) < accuracy / 3:  # nearer than that, values say nothing
            step = accuracy / 3 if middle >= best else -accuracy / 3
        tried = (best + step, float(function(best + step)))
        inner, outer = sorted([points[0], tried], key=lambda point: point[1])
        low, high = (outer[0], high) if outer[0] < inner[0] else (low, outer[0])
        points = sorted([tried, *points], key=lambda point: point[1])[:3]
    return points[0]
