"""Least squares of closed loops, by the relaxation; outliers by weights that a loss gives them in turn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from rpim_opt.basics.arrays import Array
from rpim_opt.problem.loops import Loops
from rpim_opt.problem.rotations import Smallest, lifted, smallest

LOSSES = ("squares", "huber", "truncated")
QUANTILES = {"huber": 0.90, "truncated": 0.99}
"""Which part of good measurements a loss leaves as they are: the squares of their errors are chi-squared."""
FACTOR = 1.6
"""By which the truncated loss comes nearer to itself from one pass to the next."""
MOST_PASSES = 100
SETTLED = 1e-6
"""Weights that change by less from pass to pass are found."""


@dataclass(frozen=True, eq=False)
class Solved:
    """Where a loss of closed loops is least.

    Parameters
    ----------
    v
        (n,) translations, scale, 1 and rotations, as `Loops` has them.
    smallest
        Of the last weighted problem.
    weights
        (N,) that the loss gives the measurements; one for a square.
    squares
        (N,) squared residuals.
    triangle
        (n, n) of the last weighted problem.
    cost
        The loss, summed, and what is expected of translations.
    passes
        How often the relaxation was solved.
    settled
        Whether the weights are those of the residuals.
    """

    v: Array
    smallest: Smallest
    weights: Array
    squares: Array
    triangle: Array
    cost: float
    passes: int = 1
    settled: bool = True


Weigh = Callable[[Array, Array], Array]


def solve(loops: Loops, loss: str, candidates: Sequence[Array] = ()) -> Solved:
    """Return the least of a loss of |J_i v|, which is global where it is the sum of squares and the bound meets it.

    ::

        squares    r^2                                    r = |J_i v|
        huber      r^2,  2 c r - c^2 beyond c             c^2 a quantile of chi-squared
        truncated  min(r^2, c^2)

    Huber's loss by repeated weights c / r. The truncated loss by graduated non-convexity, from one that is nearly a
    square (Yang et al. 2020, IEEE RA-L 5:1127), every weighted problem by the relaxation; then once more from the
    candidates, so that none of them is better.

    Parameters
    ----------
    loops
        The residuals.
    loss
        One of `LOSSES`.
    candidates
        Rotations (k, 3, 3) to start from, too.
    """
    ones = np.ones(len(loops.rows))
    first = _weighted(loops, ones, loss, candidates)
    if loss == "squares":
        return first
    beyond = chi2.ppf(QUANTILES[loss], loops.freedom)
    if loss == "huber":
        return _repeated(loops, first, loss, lambda squares: _huber_weights(squares, beyond))
    found = _graduated(loops, first, beyond)
    for rotations in candidates:
        other = _from(loops, rotations, beyond)
        if other is not None and other.cost < found.cost * (1 - SETTLED):
            found = other
    return found


def _weighted(loops: Loops, weights: Array, loss: str, candidates: Sequence[Array] = ()) -> Solved:
    """Return the solution of a weighted sum of squares."""
    triangle = loops.triangle(weights)
    best = smallest(loops.form(triangle), candidates)
    v = loops.completed(triangle, lifted(best.rotations))
    squares = loops.squares(v)
    return Solved(v, best, weights, squares, triangle, _cost(loops, v, squares, loss))


def _cost(loops: Loops, v: Array, squares: Array, loss: str) -> float:
    expected = float(np.sum((loops.prior @ v) ** 2))
    if loss == "squares":
        return float(np.sum(squares)) + expected
    beyond = chi2.ppf(QUANTILES[loss], loops.freedom)
    if loss == "truncated":
        return float(np.sum(np.minimum(squares, beyond))) + expected
    straight = 2 * np.sqrt(beyond * squares) - beyond
    return float(np.sum(np.where(squares > beyond, straight, squares))) + expected


def _huber_weights(squares: Array, beyond: Array) -> Array:
    return np.sqrt(beyond / np.maximum(squares, beyond))


def _truncated_weights(squares: Array, beyond: Array) -> Array:
    return (squares <= beyond).astype(float)


def _repeated(loops: Loops, solved: Solved, loss: str, weigh: Callable[[Array], Array]) -> Solved:
    """Return the fixed point of weights and solution."""
    passes = solved.passes
    while passes < MOST_PASSES:
        weights = weigh(solved.squares)
        if np.max(np.abs(weights - solved.weights)) < SETTLED:
            return _after(solved, passes, True)
        if np.sum(weights > 0) < 3:
            break
        solved = _weighted(loops, weights, loss, [solved.smallest.rotations])
        passes += 1
    return _after(solved, passes, False)


def _after(solved: Solved, passes: int, settled: bool) -> Solved:
    own = {name: getattr(solved, name) for name in ("v", "smallest", "weights", "squares", "triangle", "cost")}
    return Solved(**own, passes=passes, settled=settled)


def _graduated(loops: Loops, solved: Solved, beyond: Array) -> Solved:
    """Return a least of the truncated loss: losses between it and a square, each from the one before.

    The loss of parameter mu has weights 1 below mu / (mu + 1) c^2, 0 above (mu + 1) / mu c^2, and between them
    sqrt(mu (mu + 1) c^2 / r^2) - mu.
    """
    ratio = float(np.max(solved.squares / beyond))
    mu = 1 / max(2 * ratio - 1, 1e-3)
    passes = solved.passes
    while passes < MOST_PASSES and ratio > 1:
        between = np.sqrt(mu * (mu + 1) * beyond / np.maximum(solved.squares, 1e-300)) - mu
        weights = np.clip(between, 0.0, 1.0)
        if np.all((weights == 0) | (weights == 1)) or np.sum(weights > 0) < 3:
            break
        solved = _weighted(loops, weights, "truncated", [solved.smallest.rotations])
        passes += 1
        mu *= FACTOR
    return _repeated(loops, _after(solved, passes, False), "truncated", lambda squares: _truncated_weights(squares, beyond))


def _from(loops: Loops, rotations: Array, beyond: Array) -> Solved | None:
    """Return the least of the truncated loss near rotations; None where fewer than three measurements are near."""
    triangle = loops.triangle(np.ones(len(loops.rows)))
    squares = loops.squares(loops.completed(triangle, lifted(rotations)))
    weights = _truncated_weights(squares, beyond)
    if np.sum(weights) < 3:
        return None
    solved = _weighted(loops, weights, "truncated", [rotations])
    return _repeated(loops, solved, "truncated", lambda squares: _truncated_weights(squares, beyond))
