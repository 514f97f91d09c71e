"""Closed loops of base, flange, tool and instrument, and their least squares with outliers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import comb

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import chdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.problem.registration.closed_forms import proper
from rpim_opt.problem.registration.relaxation import Smallest, lifted, nearest, smallest, undercut

RIDGE = 1e-6
"""How certain an expected translation is at least, in units of all positions together: what they do not show stays."""
SINGULAR = 1e-13


@dataclass(frozen=True, eq=False)
class Turns:
    """Orientations of measurements B_i = Z A_i X, up to their errors: A_i'A_j and B_i'B_j turn by the same angle."""

    first: Array
    second: Array
    sigma: Array
    group: np.ndarray


@dataclass(frozen=True, eq=False)
class Loops:
    """Residuals J_i v of measurements, v = (translations, scale, 1, vec R_1, ..., vec R_k), rotations' rows first."""

    rows: Array
    prior: Array
    linear: int
    freedom: Array
    shared: int
    turns: Turns

    @property
    def unknowns(self) -> int:
        """How many numbers are sought: three a rotation."""
        n = self.rows.shape[2] - 1 - self.linear
        return self.linear + n // 3

    def triangle(self, weights: Array) -> Array:
        """Return T (n, n), upper, with |T v|^2 = sum_i weights_i |J_i v|^2 + |prior v|^2."""
        n = self.rows.shape[2]
        rows = (np.sqrt(weights)[:, None, None] * self.rows).reshape(-1, n)
        stacked = np.vstack([rows, self.prior, np.zeros((n, n))])
        return np.asarray(np.linalg.qr(stacked, mode="r"))

    def squares(self, v: Array) -> Array:
        """Return |J_i v|^2 (N,)."""
        return np.asarray(np.sum((self.rows @ v) ** 2, axis=1))

    def form(self, triangle: Array) -> Array:
        """Return L (n-linear, n-linear), with |L x|^2 the least over translations and scale (a Schur complement)."""
        pivots = np.abs(np.diag(triangle)[: self.linear])
        if pivots.min() <= SINGULAR * pivots.max():
            raise InputError("poses", "places that do not determine translations and scale", "places that differ")
        return triangle[self.linear :, self.linear :]

    def completed(self, triangle: Array, x: Array) -> Array:
        """Return v (n,) with the translations and the scale that are best for x."""
        T = triangle[: self.linear]
        y = solve_triangular(T[:, : self.linear], -T[:, self.linear :] @ x)
        return np.concatenate([np.asarray(y, dtype=float), x])


@dataclass(frozen=True, eq=False)
class Seen:
    """What closes the loops ``measured = base flange tool``."""

    flange: Array
    measured: Array
    turned: np.ndarray
    instrument: np.ndarray
    marker: np.ndarray
    sigma: Array
    expected: Array
    spread: float


def of_poses(seen: Seen, scaled: bool) -> Loops:
    """Return the loops of bases Z and tools X, several of either."""
    N = len(seen.flange)
    bases = int(seen.instrument.max()) + 1
    tools = len(seen.expected)
    turning = np.unique(seen.marker[seen.turned])
    linear = 3 * (tools + bases) + scaled
    one = linear
    lengths = 1 / seen.sigma[:, 0]
    angles = seen.turned / (np.sqrt(2) * seen.sigma[:, 1])
    J = np.zeros((N, 12, linear + 1 + 9 * (bases + len(turning))))
    each = np.arange(N)
    A = seen.flange[:, :3, :3]
    B = seen.measured[:, :3, :3]
    eye = np.eye(3)
    robot = linear - 1 if scaled else one
    J[:, :3, robot] = -seen.flange[:, :3, 3] * lengths[:, None]
    first = one + 1 + 9 * seen.instrument
    last = one + 1 + 9 * (bases + np.searchsorted(turning, seen.marker))  # of those turned
    for a in range(3):
        J[each, a, 3 * (tools + seen.instrument) + a] = -lengths
        for b in range(3):
            J[each, a, 3 * seen.marker + b] = -A[:, a, b] * lengths
            # (Z_R' y)_a = sum_b (Z_R)_ba y_b
            J[each, a, first + 3 * b + a] = seen.measured[:, b, 3] * lengths
    of_base = np.einsum("ai,njb->nabij", eye, A).reshape(N, 9, 9)
    of_tool = np.einsum("nai,bj->nabij", B, eye).reshape(N, 9, 9)
    at = np.flatnonzero(seen.turned)
    for k in range(9):
        J[at, 3:, first[at] + k] = -of_base[at, :, k] * angles[at, None]
        J[at, 3:, last[at] + k] = of_tool[at, :, k] * angles[at, None]
    weak = RIDGE * float(np.sqrt(np.sum(lengths**2)))
    prior = _expected(seen.expected, max(1 / seen.spread, weak), robot, J.shape[2])
    group = np.where(seen.turned, seen.instrument * tools + seen.marker, -1)
    turns = Turns(A, B, seen.sigma[:, 1], group)
    return Loops(J, prior, linear, np.where(seen.turned, 6, 3), bases, turns)


def of_motions(A: Array, B: Array, sigma: Array, expected: Array, spread: float, scaled: bool) -> Loops:
    """Return the loops A X = X B of motions (N, 4, 4), with X_R the only rotation."""
    N = len(A)
    linear = 3 + scaled
    J = np.zeros((N, 12, linear + 10))
    robot = linear - 1 if scaled else linear
    eye = np.eye(3)
    J[:, :3, :3] = eye - A[:, :3, :3]
    J[:, :3, robot] -= A[:, :3, 3]
    J[:, :3, linear + 1 :] = np.einsum("ai,nj->naij", eye, B[:, :3, 3]).reshape(N, 3, 9)
    left = np.einsum("nai,bj->nabij", A[:, :3, :3], eye)
    right = np.einsum("ai,njb->nabij", eye, B[:, :3, :3])
    J[:, 3:, linear + 1 :] = (left - right).reshape(N, 9, 9)
    J[:, :3] /= sigma[:, 0, None, None]
    J[:, 3:] /= np.sqrt(2) * sigma[:, 1, None, None]
    weak = RIDGE * float(np.sqrt(np.sum(sigma[:, 0] ** -2)))
    prior = _expected(expected[None], max(1 / spread, weak), robot, J.shape[2])
    turns = Turns(A[:, :3, :3], B[:, :3, :3], sigma[:, 1], np.zeros(N, dtype=int))
    return Loops(J, prior, linear, np.full(N, 6), 1, turns)


def _expected(points: Array, certainty: float, robot: int, n: int) -> Array:
    """Return the residuals (p, n) of translations, the first of v, that are expected at points."""
    prior = np.zeros((points.size, n))
    prior[:, : points.size] = certainty * np.eye(points.size)
    prior[:, robot] = -certainty * points.ravel()
    return prior


MOST_PAIRED = 2000
"""Measurements up to which all pairs are compared."""
FEW = 10
"""Measurements of which each is left out in turn, and how many sets are begun with at most."""
FEWEST = 3
"""Measurements that have to have a weight."""
ASKED = 40
"""Measurements, evenly spread, of which is asked what they go with."""
MOST_SOLVED = 60
"""Pairs, and sets, of measurements whose relaxations are solved to show that they do not agree."""
ROUNDING = 1e-7
"""Error of an angle from its cosine [rad]."""
SURPRISE = 1e-4
"""Probability that a good measurement, or what is expected of translations, is off by more than counts as good."""


def compatible(turns: Turns, beyond: Array) -> np.ndarray:
    """Return which two measurements (N, N) can both have squared residuals up to these (N,), for some frames."""
    N = len(beyond)
    if N > MOST_PAIRED:
        return np.ones((N, N), dtype=bool)
    first = proper(turns.first)
    second = proper(turns.second)
    # matrices that are rotations but for a few digits are taken for the nearest
    rough = _sizes(turns.first - first) + _sizes(turns.second - second)
    chord = turns.sigma * np.sqrt(beyond) / 2 + rough / np.sqrt(8)
    off = 2 * np.arcsin(np.minimum(1.0, chord)) + ROUNDING
    alike = np.abs(_angles(first) - _angles(second)) <= off[:, None] + off
    known = (turns.group[:, None] == turns.group) & (turns.group >= 0)
    return alike | ~known


def _angles(rotations: Array) -> Array:
    """Return the angles (N, N) between rotations."""
    flat = rotations.reshape(-1, 9)
    return np.arccos(np.clip((flat @ flat.T - 1) / 2, -1.0, 1.0))


def _sizes(matrices: Array) -> Array:
    return np.asarray(np.linalg.norm(matrices, axis=(1, 2)))


def core(pairs: np.ndarray, count: int) -> np.ndarray:
    """Return which measurements (N,) are left after those are dropped, in turn, that fewer than `count` go with."""
    left = np.ones(len(pairs), dtype=bool)
    while True:
        kept = left & (np.sum(pairs[:, left], axis=1) >= count)
        if np.array_equal(kept, left):
            return left
        left = kept


def likeliest(pairs: np.ndarray) -> np.ndarray:
    """Return the core (N,) of the largest count that leaves any."""
    return core(pairs, _largest(pairs))


def likely(pairs: np.ndarray, among: np.ndarray) -> list[np.ndarray]:
    """Return smaller sets (N,) to begin with, the larger first: of those that one of some goes with, the likeliest."""
    sets = []
    members = np.flatnonzero(among)
    for each in members[:: 1 + len(members) // ASKED]:
        near = np.flatnonzero(pairs[each])
        sets.append(np.isin(np.arange(len(pairs)), near[likeliest(pairs[np.ix_(near, near)])]))
    if len(members) <= FEW:
        sets += [among & (np.arange(len(pairs)) != each) for each in members]
    distinct = {each.tobytes(): each for each in sets if np.sum(each) >= FEWEST and not np.array_equal(each, among)}
    return sorted(distinct.values(), key=lambda each: -int(np.sum(each)))[:FEW]


def _largest(pairs: np.ndarray) -> int:
    """Return the largest count that has a core, by halving."""
    low, high = 1, len(pairs) + 1
    while high - low > 1:
        middle = (low + high) // 2
        if core(pairs, middle).any():
            low = middle
        else:
            high = middle
    return low


def alone(loops: Loops, squares: Array, agreeing: np.ndarray, beyond: Array) -> bool:
    """Return whether no other measurements than the agreeing (N,) can be as many that agree with something else."""
    N = len(agreeing)
    count = int(np.sum(agreeing))
    if count >= N // 2 + 2:
        return True
    if count < 2:
        return False
    pairs = compatible(loops.turns, beyond)
    strange = ~agreeing & (squares > chdtri(loops.freedom, SURPRISE))
    others = np.flatnonzero(core(pairs, count) & strange)
    if not _told_apart(loops, pairs, others, core(pairs, count), beyond):
        return False
    rivals: list[list[int]] = []
    for other in np.flatnonzero(core(pairs, count) & strange):
        rest = _around(pairs, int(other), count)
        if len(rivals) + comb(len(rest), count - 1) > MOST_SOLVED:
            return False
        rivals += [[int(other), *some] for some in combinations(rest, count - 1)]
    return not any(_may_agree(loops, rival, beyond) for rival in rivals)


def _told_apart(loops: Loops, pairs: np.ndarray, others: np.ndarray, among: np.ndarray, beyond: Array) -> bool:
    """Mark pairs of others whose relaxation shows that they do not go together; return whether they are few enough."""
    asked = {(min(i, j), max(i, j)) for i in others for j in np.flatnonzero(pairs[i] & among) if i != j}
    if len(asked) > MOST_SOLVED:
        return False
    for i, j in asked:
        pairs[i, j] = pairs[j, i] = _may_agree(loops, [i, j], beyond)
    return True


def _around(pairs: np.ndarray, other: int, count: int) -> list[int]:
    """Return what goes with a measurement and with enough of what does; nothing where that is too little."""
    near = np.flatnonzero(pairs[other])
    members = near[core(pairs[np.ix_(near, near)], count)].tolist()
    return [each for each in members if each != other] if other in members else []


def _may_agree(loops: Loops, members: list[int], beyond: Array) -> bool:
    """Return whether the relaxation leaves it open that measurements, and what is expected of translations, agree."""
    weights = np.zeros(len(loops.rows))
    weights[members] = 1.0
    least = undercut(loops.form(loops.triangle(weights)), loops.shared)
    return least <= float(np.sum(beyond[members]) + chdtri(len(loops.prior), SURPRISE))


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
    """Where a loss of closed loops is least."""

    v: Array
    smallest: Smallest
    weights: Array
    squares: Array
    cost: float
    settled: bool = True
    alone: bool = True


Weigh = Callable[[Array], Array]


def solve(loops: Loops, loss: str, candidates: Sequence[Array] = ()) -> Solved:
    """Return the least of a loss of |J_i v|, which is global where it is the sum of squares and the bound meets it."""
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
    """Return the least of the truncated loss that is found from the likeliest measurements, from all and candidates."""
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
    """Return a least of the truncated loss: losses of some measurements (N,) from squares to it, each from the last."""
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
