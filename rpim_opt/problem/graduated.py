"""Least squares of closed loops, by the relaxation; outliers by weights that a loss gives them in turn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.problem.consensus import FEWEST, alone, compatible, likeliest, likely
from rpim_opt.problem.loops import Loops
from rpim_opt.problem.rotations import Smallest, lifted, nearest, smallest

LOSSES = ("squares", "huber", "truncated")
QUANTILES = {"huber": 0.90, "truncated": 0.99}
"""Which part of good measurements a loss leaves as they are: the squares of their errors are chi-squared."""
FACTOR = 1.6
"""By which the truncated loss comes nearer to itself from one pass to the next."""
MOST_PASSES = 100
FULL = 0.999
"""Weight from which a measurement agrees."""
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
    cost
        The loss, summed, and what is expected of translations.
    settled
        Whether the weights are those of the residuals.
    alone
        Whether no other measurements than those of full weight can be as many that agree.
    """

    v: Array
    smallest: Smallest
    weights: Array
    squares: Array
    cost: float
    settled: bool = True
    alone: bool = True


Weigh = Callable[[Array], Array]


def solve(loops: Loops, loss: str, candidates: Sequence[Array] = ()) -> Solved:
    """Return the least of a loss of |J_i v|, which is global where it is the sum of squares and the bound meets it.

    ::

        squares    r^2                                    r = |J_i v|
        huber      r^2,  2 c r - c^2 beyond c             c^2 a quantile of chi-squared
        truncated  min(r^2, c^2)

    From the relaxation's optimum of the squares Huber's loss follows repeated weights c / r, and the truncated loss
    graduated non-convexity (Yang et al. 2020, IEEE RA-L 5:1127), by Newton's steps; the last weighted problem is the
    relaxation's again. The truncated loss begins with the largest core of measurements that turn alike, and if not all
    of that agree, with all of them; it is followed from the candidates, too, so that none of them is better.

    Parameters
    ----------
    loops
        The residuals.
    loss
        One of `LOSSES`.
    candidates
        Rotations (k, 3, 3) to start from, too.
    """
    if loss == "squares":
        return _weighted(loops, np.ones(len(loops.rows)), loss, candidates)
    beyond = chdtri(loops.freedom, 1 - QUANTILES[loss])
    if loss == "huber":
        first = _weighted(loops, np.ones(len(loops.rows)), loss, candidates)
        found = _repeated(loops, first, loss, lambda squares: _huber_weights(squares, beyond))
    else:
        found = _truncated(loops, beyond, candidates)
    return replace(found, alone=alone(loops, found.squares, found.weights > FULL, beyond))


def _truncated(loops: Loops, beyond: Array, candidates: Sequence[Array]) -> Solved:
    """Return the least of the truncated loss that is found from the likeliest measurements, from all and candidates.

    Where too few of the likeliest agree with that, parts of them are begun with, too.
    """
    pairs = compatible(loops.turns, beyond)
    first = likeliest(pairs)
    found = [_graduated(loops, first, beyond), *(_from(loops, rotations, beyond) for rotations in candidates)]
    if not np.array_equal(found[0].weights > 0, first):
        found.append(_graduated(loops, np.ones(len(pairs), dtype=bool), beyond))
    best = _least(found)
    if best.weights.sum() < first.sum() - 1:
        best = _least([best, *(_graduated(loops, part, beyond) for part in likely(pairs, first))])
    return best


def _least(found: Sequence[Solved | None]) -> Solved:
    """Return the first of those that cost least, up to rounding."""
    known = [each for each in found if each is not None]
    least = min(each.cost for each in known)
    return next(each for each in known if each.cost * (1 - SETTLED) <= least)


def _weighted(loops: Loops, weights: Array, loss: str, candidates: Sequence[Array] = ()) -> Solved:
    """Return the solution of a weighted sum of squares, by the relaxation."""
    triangle = loops.triangle(weights)
    return _solved(loops, weights, loss, triangle, smallest(loops.form(triangle), candidates, loops.shared))


def _followed(loops: Loops, weights: Array, loss: str, solved: Solved) -> Solved:
    """Return the solution of a weighted sum of squares near that of other weights."""
    triangle = loops.triangle(weights)
    return _solved(loops, weights, loss, triangle, nearest(loops.form(triangle), solved.smallest.rotations))


def _solved(loops: Loops, weights: Array, loss: str, triangle: Array, best: Smallest) -> Solved:
    v = loops.completed(triangle, lifted(best.rotations))
    squares = loops.squares(v)
    return Solved(v, best, weights, squares, _cost(loops, v, squares, loss))


def _cost(loops: Loops, v: Array, squares: Array, loss: str) -> float:
    expected = float(np.sum((loops.prior @ v) ** 2))
    if loss == "squares":
        return float(np.sum(squares)) + expected
    beyond = chdtri(loops.freedom, 1 - QUANTILES[loss])
    if loss == "truncated":
        return float(np.sum(np.minimum(squares, beyond))) + expected
    straight = 2 * np.sqrt(beyond * squares) - beyond
    return float(np.sum(np.where(squares > beyond, straight, squares))) + expected


def _huber_weights(squares: Array, beyond: Array) -> Array:
    return np.sqrt(beyond / np.maximum(squares, beyond))


def _truncated_weights(squares: Array, beyond: Array) -> Array:
    return (squares <= beyond).astype(float)


def _repeated(loops: Loops, solved: Solved, loss: str, weigh: Weigh) -> Solved:
    """Return the fixed point of weights and solution, the last of which is the relaxation's."""
    for _ in range(MOST_PASSES):
        weights = weigh(solved.squares)
        if np.sum(weights > 0) < FEWEST:
            break
        if np.max(np.abs(weights - solved.weights)) >= SETTLED:
            solved = _followed(loops, weights, loss, solved)
            continue
        if np.isfinite(solved.smallest.bound):
            return replace(solved, settled=True)
        solved = _weighted(loops, weights, loss, [solved.smallest.rotations])
    if not np.isfinite(solved.smallest.bound):
        solved = _weighted(loops, solved.weights, loss, [solved.smallest.rotations])
    return replace(solved, settled=False)


def _graduated(loops: Loops, among: np.ndarray, beyond: Array) -> Solved:
    """Return a least of the truncated loss: losses of some measurements (N,) from squares to it, each from the last.

    The loss of parameter mu has weights 1 below mu / (mu + 1) c^2, 0 above (mu + 1) / mu c^2, and between them
    sqrt(mu (mu + 1) c^2 / r^2) - mu.
    """
    solved = _weighted(loops, among.astype(float), "truncated")
    ratio = float(np.max(among * solved.squares / beyond))
    mu = 1 / max(2 * ratio - 1, 1e-3)
    for _ in range(MOST_PASSES):
        between = np.sqrt(mu * (mu + 1) * beyond / np.maximum(solved.squares, 1e-300)) - mu
        weights = among * np.clip(between, 0.0, 1.0)
        if np.all((weights == 0) | (weights == 1)) or np.sum(weights > 0) < FEWEST:
            break
        solved = _followed(loops, weights, "truncated", solved)
        mu *= FACTOR
    return _repeated(loops, solved, "truncated", lambda squares: _truncated_weights(squares, beyond))


def _from(loops: Loops, rotations: Array, beyond: Array) -> Solved | None:
    """Return the least of the truncated loss near rotations; None where fewer than three measurements are near."""
    triangle = loops.triangle(np.ones(len(loops.rows)))
    squares = loops.squares(loops.completed(triangle, lifted(rotations)))
    weights = _truncated_weights(squares, beyond)
    if np.sum(weights) < FEWEST:
        return None
    solved = _weighted(loops, weights, "truncated", [rotations])
    return _repeated(loops, solved, "truncated", lambda squares: _truncated_weights(squares, beyond))
