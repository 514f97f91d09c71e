"""Closed loops of base, flange, tool and instrument, and their least squares with outliers."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import chdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.problem.registration.closed_forms import proper
from rpim_opt.problem.registration.relaxation import Smallest, lifted, nearest, smallest

RIDGE = 1e-6
"""How certain an expected translation is at least, in units of all positions together: what they do not show stays."""
LOSSES = ("squares", "truncated")
QUANTILE = 0.99
"""Which part of good measurements the truncated loss leaves as they are: their squares are chi-squared."""
FEWEST = 3
"""Measurements that have to have a weight."""
MOST_PAIRED = 2000
"""Measurements up to which all pairs are compared."""
TRIED, FEW = 40, 10
"""Measurements, evenly spread, whose compatible sets are tried, and the most sets that are."""
SURPRISE = 1e-4
"""Probability that a good measurement is off by more than counts as good."""


@dataclass(frozen=True, eq=False)
class Loops:
    """Residuals J_i v of N measurements, v = (translations, scale, 1, vec R_1, ..., vec R_k), rotations' rows first.

    ``first`` and ``second`` (N, 3, 3) are orientations B_i = Z A_i X up to errors of ``sigma`` (N,) [rad], ``group``
    (N,) numbers what has the same Z and X, negative where the orientation was not measured: A_i'A_j and B_i'B_j of a
    group turn by the same angle.
    """

    rows: Array  # (N, m, n) J_i, each residual in units of its standard deviation
    prior: Array  # (p, n) residuals of what is expected of translations
    linear: int  # how many of the n are translations and the scale: they are eliminated exactly
    equations: Array  # (N,) of a measurement: 3 of a position, 6 of a pose
    first: Array
    second: Array
    sigma: Array
    group: np.ndarray

    @property
    def unknowns(self) -> int:
        """How many numbers are sought: three a rotation."""
        return self.linear + (self.rows.shape[2] - 1 - self.linear) // 3

    def triangle(self, weights: Array) -> Array:
        """Return T (n, n), upper, with |T v|^2 = sum_i weights_i |J_i v|^2 + |prior v|^2."""
        n = self.rows.shape[2]
        rows = (np.sqrt(weights)[:, None, None] * self.rows).reshape(-1, n)
        return np.asarray(np.linalg.qr(np.vstack([rows, self.prior, np.zeros((n, n))]), mode="r"))

    def squares(self, v: Array) -> Array:
        """Return |J_i v|^2 (N,)."""
        return np.asarray(np.sum((self.rows @ v) ** 2, axis=1))

    def form(self, triangle: Array) -> Array:
        """Return L (n-linear, n-linear), with |L x|^2 the least over translations and scale (a Schur complement)."""
        pivots = np.abs(np.diag(triangle)[: self.linear])
        if pivots.min() <= 1e-13 * pivots.max():
            raise InputError("poses", "places that do not determine translations and scale", "places that differ")
        return triangle[self.linear :, self.linear :]

    def completed(self, triangle: Array, x: Array) -> Array:
        """Return v (n,) with the translations and the scale that are best for x."""
        T = triangle[: self.linear]
        y = solve_triangular(T[:, : self.linear], -T[:, self.linear :] @ x)
        return np.concatenate([np.asarray(y, dtype=float), x])


def of_poses(
    flange: Array,
    measured: Array,
    turned: np.ndarray,
    instrument: np.ndarray,
    marker: np.ndarray,
    sigma: Array,
    expected: Array,
    spread: float,
    scaled: bool,
) -> Loops:
    """Return the loops ``measured = base flange tool`` of several bases Z and tools X.

    ::

        (Z_R' y - A_R t - A_t - u) / sigma_position,    t = X_t,  u = Z_R' Z_t
        (B_R X_R' - Z_R A_R) / (sqrt(2) sigma_orientation)    where the orientation was measured

    of the flange A and the measured B with its position y. For an unknown scale s of the instrument's lengths, both
    sides are in its unit: A_t / s, t / s and u / s. The norm of the second is the angle between the two, up to third
    order. Rotations are those of the bases Z_R, then X_R' of the tools that were measured to turn.
    """
    N = len(flange)
    bases = int(instrument.max()) + 1
    tools = len(expected)
    turning = np.unique(marker[turned])
    linear = 3 * (tools + bases) + scaled
    lengths = 1 / sigma[:, 0]
    angles = turned / (np.sqrt(2) * sigma[:, 1])
    J = np.zeros((N, 12, linear + 1 + 9 * (bases + len(turning))))
    each = np.arange(N)
    A = flange[:, :3, :3]
    B = measured[:, :3, :3]
    robot = linear - 1 if scaled else linear
    J[:, :3, robot] = -flange[:, :3, 3] * lengths[:, None]
    first = linear + 1 + 9 * instrument
    last = linear + 1 + 9 * (bases + np.searchsorted(turning, marker))  # of those turned
    for a in range(3):
        J[each, a, 3 * (tools + instrument) + a] = -lengths
        for b in range(3):
            J[each, a, 3 * marker + b] = -A[:, a, b] * lengths
            # (Z_R' y)_a = sum_b (Z_R)_ba y_b
            J[each, a, first + 3 * b + a] = measured[:, b, 3] * lengths
    of_base = np.einsum("ai,njb->nabij", np.eye(3), A).reshape(N, 9, 9)
    of_tool = np.einsum("nai,bj->nabij", B, np.eye(3)).reshape(N, 9, 9)
    at = np.flatnonzero(turned)
    for k in range(9):
        J[at, 3:, first[at] + k] = -of_base[at, :, k] * angles[at, None]
        J[at, 3:, last[at] + k] = of_tool[at, :, k] * angles[at, None]
    prior = _expected(expected, spread, lengths, robot, J.shape[2])
    group = np.where(turned, instrument * tools + marker, -1)
    return Loops(J, prior, linear, np.where(turned, 6, 3), A, B, sigma[:, 1], group)


def of_motions(A: Array, B: Array, sigma: Array, expected: Array, spread: float, scaled: bool) -> Loops:
    """Return the loops A X = X B of motions (N, 4, 4), with X_R the only rotation.

    ::

        (X_R B_t - A_R t + t - A_t) / sigma_position,    t = X_t
        (A_R X_R - X_R B_R) / (sqrt(2) sigma_orientation)

    For an unknown scale s of the lengths in B: A_t / s and t / s.
    """
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
    prior = _expected(expected[None], spread, 1 / sigma[:, 0], robot, J.shape[2])
    return Loops(J, prior, linear, np.full(N, 6), A[:, :3, :3], B[:, :3, :3], sigma[:, 1], np.zeros(N, dtype=int))


def _expected(points: Array, spread: float, lengths: Array, robot: int, n: int) -> Array:
    """Return the residuals (p, n) of translations, the first of v, that are expected at points."""
    certainty = max(1 / spread, RIDGE * float(np.sqrt(np.sum(lengths**2))))
    prior = np.zeros((points.size, n))
    prior[:, : points.size] = certainty * np.eye(points.size)
    prior[:, robot] = -certainty * points.ravel()
    return prior


# Which measurements can agree


def compatible(loops: Loops, beyond: Array) -> np.ndarray:
    """Return which two measurements (N, N) can both have squared residuals up to these (N,), for some frames.

    ::

        B_i = E_i Z A_i X,  |E_i| <= 2 asin(sigma_i c_i / 2)    hence    ||A_i'A_j| - |B_i'B_j|| <= |E_i| + |E_j|

    |.| being the angle of a rotation: X and Z drop out. Pairs of which nothing is known are compatible.
    """
    N = len(beyond)
    if N > MOST_PAIRED:
        return np.ones((N, N), dtype=bool)
    angles = []
    rough = np.zeros(N)
    for given in (loops.first, loops.second):
        rotations = proper(given)
        rough += np.linalg.norm(given - rotations, axis=(1, 2))  # taken for the nearest rotations
        flat = rotations.reshape(-1, 9)
        angles.append(np.arccos(np.clip((flat @ flat.T - 1) / 2, -1.0, 1.0)))
    chord = loops.sigma * np.sqrt(beyond) / 2 + rough / np.sqrt(8)
    off = 2 * np.arcsin(np.minimum(1.0, chord)) + 1e-7  # what an angle from its cosine is off by
    known = (loops.group[:, None] == loops.group) & (loops.group >= 0)
    return (np.abs(angles[0] - angles[1]) <= off[:, None] + off) | ~known


def core(pairs: np.ndarray, count: int) -> np.ndarray:
    """Return which measurements (N,) are left after those are dropped, in turn, that fewer than `count` go with.

    All sets of `count` that go with one another are among these (the k-core of a graph; Shi, Yang, Carlone 2021, IEEE
    ICRA, find outliers so).
    """
    left = np.ones(len(pairs), dtype=bool)
    while True:
        kept = left & (np.sum(pairs[:, left], axis=1) >= count)
        if np.array_equal(kept, left):
            return left
        left = kept


def likeliest(pairs: np.ndarray) -> np.ndarray:
    """Return the core (N,) of the largest count that leaves any."""
    counts = range(len(pairs) + 2)
    return core(pairs, bisect_left(counts, True, key=lambda count: not core(pairs, count).any()) - 1)


def _alone(loops: Loops, squares: Array, agreeing: np.ndarray, beyond: Array) -> bool:
    """Return whether no other measurements than the agreeing (N,) can be as many that agree with something else.

    They cannot if fewer are left over than would have to, or if no other is in a core of that size. One whose square
    (N,) a good one may have is no other.
    """
    count = int(np.sum(agreeing))
    if count >= len(agreeing) // 2 + 2:
        return True
    strange = ~agreeing & (squares > chdtri(loops.equations, SURPRISE))
    return count > 1 and not (core(compatible(loops, beyond), count) & strange).any()


# Losses


@dataclass(frozen=True, eq=False)
class Solved:
    """Where a loss of closed loops is least."""

    v: Array  # (n,) translations, scale, 1 and rotations, as `Loops` has them
    smallest: Smallest  # of the last weighted problem
    weights: Array  # (N,) that the loss gives the measurements; one for a square
    squares: Array  # (N,) squared residuals
    cost: float  # the loss, summed, and what is expected of translations
    settled: bool = True  # whether the weights are those of the residuals
    alone: bool = True  # whether no other measurements than those of full weight can be as many that agree


def solve(loops: Loops, loss: str, candidates: Sequence[Array] = ()) -> Solved:
    """Return the least of a loss of r = |J_i v|, global where it is the sum of squares and the bound meets it.

    ::

        squares    r^2
        truncated  min(r^2, c^2)        c^2 a quantile of chi-squared

    The truncated loss begins with the largest core of measurements that turn alike, and if not all of that agree, with
    all of them and parts of them; it is followed from candidates (k, 3, 3), too, so that none of them is better.
    """
    every = np.ones(len(loops.rows), dtype=bool)
    if loss == "squares":
        return Solver(loops, np.full(len(every), np.inf)).weighted(every.astype(float), candidates)
    beyond = chdtri(loops.equations, 1 - QUANTILE)
    solver = Solver(loops, beyond)
    pairs = compatible(loops, beyond)
    first = likeliest(pairs)
    found = [solver.graduated(first), *filter(None, map(solver.begun, candidates))]
    if not np.array_equal(found[0].weights > 0, first):
        found.append(solver.graduated(every))
    most = max(each.weights.sum() for each in found)
    if most < first.sum() - 1:  # the likeliest do not all agree: begin with those that one of them goes with, too
        members = np.flatnonzero(first)
        around = [pairs & np.outer(pairs[i], pairs[i]) for i in members[:: 1 + len(members) // TRIED]]
        parts = [likeliest(some) for some in around]
        if len(members) <= FEW:  # turning alike, one may be wrong all the same
            parts += list(first & ~np.eye(len(first), dtype=bool)[members])
        distinct = sorted(np.unique(parts, axis=0), key=np.sum)[-FEW:]
        found += [solver.graduated(part) for part in distinct if part.sum() >= FEWEST]
    least = min(each.cost for each in found)
    best = next(each for each in found if each.cost * (1 - 1e-6) <= least)  # the first, up to rounding
    return replace(best, alone=_alone(loops, best.squares, best.weights > 0, beyond))


@dataclass(frozen=True, eq=False)
class Solver:
    """Weighted sums of squares of loops, and the truncated loss by them; ``beyond`` (N,) are the c^2."""

    loops: Loops
    beyond: Array

    def weighted(self, weights: Array, candidates: Sequence[Array] = (), near: Array | None = None) -> Solved:
        """Return the solution of a weighted sum of squares: by the relaxation, or by Newton's steps from rotations."""
        triangle = self.loops.triangle(weights)
        L = self.loops.form(triangle)
        best = smallest(L, candidates) if near is None else nearest(L, near)
        v = self.loops.completed(triangle, lifted(best.rotations))
        squares = self.loops.squares(v)
        cost = float(np.sum(np.minimum(squares, self.beyond)) + np.sum((self.loops.prior @ v) ** 2))
        return Solved(v, best, weights, squares, cost)

    def repeated(self, solved: Solved) -> Solved:
        """Return the fixed point of weights and solution, the last of which is the relaxation's."""
        for _ in range(100):
            weights = (solved.squares <= self.beyond).astype(float)
            same = np.array_equal(weights, solved.weights)
            bounded = bool(np.isfinite(solved.smallest.bound))
            if weights.sum() < FEWEST or (same and bounded):
                break
            near = None if same else solved.smallest.rotations
            solved = self.weighted(weights, [solved.smallest.rotations], near)
        if not np.isfinite(solved.smallest.bound):
            solved = self.weighted(solved.weights, [solved.smallest.rotations])
        return replace(solved, settled=np.array_equal(solved.squares <= self.beyond, solved.weights))

    def graduated(self, among: np.ndarray) -> Solved:
        """Return a least of the truncated loss by graduated non-convexity (Yang et al. 2020, IEEE RA-L 5:1127).

        Losses of some measurements (N,) from squares to the truncated one, each from the last: that of parameter mu has
        weights 1 below mu / (mu + 1) c^2, 0 above (mu + 1) / mu c^2, and between them sqrt(mu (mu + 1) c^2 / r^2) - mu.
        """
        solved = self.weighted(among.astype(float))
        mu = 1 / max(2 * float(np.max(among * solved.squares / self.beyond)) - 1, 1e-3)
        for _ in range(100):
            between = np.sqrt(mu * (mu + 1) * self.beyond / np.maximum(solved.squares, 1e-300)) - mu
            weights = among * np.clip(between, 0.0, 1.0)
            if np.all((weights == 0) | (weights == 1)) or np.sum(weights > 0) < FEWEST:
                break
            solved = self.weighted(weights, near=solved.smallest.rotations)
            mu *= 1.6
        return self.repeated(solved)

    def begun(self, rotations: Array) -> Solved | None:
        """Return the least of the truncated loss near rotations; None where fewer than three measurements are near."""
        triangle = self.loops.triangle(np.ones(len(self.beyond)))
        squares = self.loops.squares(self.loops.completed(triangle, lifted(rotations)))
        weights = (squares <= self.beyond).astype(float)
        if weights.sum() < FEWEST:
            return None
        return self.repeated(self.weighted(weights, [rotations]))
