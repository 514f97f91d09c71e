"""The way down to a minimum in a box by Newton's steps, where second derivatives are known."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Protocol, TypeVar

import numpy as np

from rpim_opt.basics.arrays import Array

MOST = 100
"""Steps that are tried, at most."""
FLAT = 1e-9
"""Curvatures smaller than so much of the largest are taken for that: along them values hardly change."""
ACCEPTED, POOR, GOOD = 1e-4, 0.25, 0.75
"""Part of the expected decrease from which a step is made, from which steps stay as long, and from which they grow."""
SHORTER, LONGER = 0.4, 2.0
"""Length of the next step after a poor one and after a good one, in lengths of that."""


class Valued(Protocol):
    """What is known of a function at a point."""

    @property
    def value(self) -> float:
        """The function's."""
        ...

    @property
    def gradient(self) -> Array:
        """(n,)."""
        ...


P = TypeVar("P", bound=Valued)


def descent(
    ask: Callable[[Array], P],
    curvature: Callable[[P], Array],
    start: Array,
    box: tuple[Array, Array],
    longest: float,
    enough: float,
) -> Iterator[P]:
    """Yield ever lower points of a smooth function, until no step promises more.

    A step is Newton's with the absolute values of the curvature's eigenvalues, which leads away from saddles (Dauphin
    et al. 2014): towards the minimum of g's + s'|H|s / 2, along the bounds that are met on the way there (an active
    set, Nocedal and Wright 2006, section 16.5, which is not left again), and shortened to a radius. It promises
    -g's - s'H s / 2, which is positive, and from what the value falls by of that follows the radius, as of a trust
    region (their algorithm 4.1): a step that does not lead down is tried shorter.

    Parameters
    ----------
    ask
        The function at x (n,). Where its value is not finite, steps are shortened.
    curvature
        Second derivatives (n, n) at a point that was asked for last; asked once for every point of the way.
    start
        (n,) which is moved into the box.
    box
        Bounds (n,) and (n,).
    longest
        No number changes by more in a step.
    enough
        Steps end where they promise no more than this times the value, or times 1 where that is larger.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> import numpy as np
    >>> from rpim_opt.basics.descent import descent
    >>> def bowl(x):
    ...     return SimpleNamespace(x=x, value=x @ x, gradient=2 * x)
    >>> box = np.array([1.0, -4.0]), np.array([5.0, 4.0])
    >>> way = descent(bowl, lambda _: 2 * np.eye(2), np.array([3.0, 2.0]), box, 10.0, 1e-9)
    >>> [float(point.value) for point in way]
    [13.0, 1.0]
    """
    x = np.clip(start, *box)
    point, radius = ask(x), longest
    yield point
    if not len(x):
        return
    H = curvature(point)
    for _ in range(MOST):
        step = _step(x, point.gradient, H, box, radius)
        promised = -float(point.gradient @ step + step @ H @ step / 2)
        if not promised > enough * max(abs(point.value), 1.0):
            break
        there = np.clip(x + step, *box)
        tried = ask(there)
        share = (point.value - tried.value) / promised
        length = float(np.abs(step).max())
        if share > GOOD:
            radius = min(max(radius, LONGER * length), longest)
        elif not share > POOR:
            radius = SHORTER * length
        if share > ACCEPTED:
            x, point = there, tried
            yield point
            H = curvature(point)


def _step(x: Array, gradient: Array, H: Array, box: tuple[Array, Array], radius: float) -> Array:
    """Return a step (n,) to where g's + s'|H|s / 2 is least in a box, about, and no longer than a radius."""
    low, high = box[0] - x, box[1] - x
    step = np.zeros(len(x))
    free = ~(((low >= 0) & (gradient > 0)) | ((high <= 0) & (gradient < 0)))
    metric = _positive(H)
    while free.any():
        onward = np.zeros(len(x))
        onward[free] = np.linalg.solve(metric[free][:, free], -(gradient + metric @ step)[free])
        room = np.where(onward > 0, high, low) - step
        beyond = np.abs(onward) > np.abs(room)
        if not beyond.any():
            step += onward
            break
        part = np.where(beyond, room / np.where(beyond, onward, 1.0), 1.0)
        step += part.min() * onward
        free &= part > part.min()
    return step * (radius / max(np.abs(step).max(), radius))


def _positive(H: Array) -> Array:
    """Return |H|, with the absolute values of a matrix's eigenvalues, kept from zero."""
    values, vectors = np.linalg.eigh(H)
    size = np.abs(values)
    return vectors * np.maximum(size, max(FLAT * size.max(), np.sqrt(np.finfo(float).tiny))) @ vectors.T
