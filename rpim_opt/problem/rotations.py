"""The smallest value of a quadratic form of rotations: found, refined, and bounded from below by a proof."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.late import transform
from rpim_opt.problem.moments import rotation_constraints
from rpim_opt.problem.placing import proper
from rpim_opt.problem.relaxed import Moments, relax

STEPS = 50
"""Newton steps after which rotations are as good as they get."""
SHORT = 1e-13
"""Rotations are found when a step is shorter [rad]."""
SPREAD = 1e-3
"""Second over first eigenvalue from which moments are those of several rotations, and a few are drawn from them."""
FINE = 1e-12
"""Tolerance with which the relaxation is solved again where its moments are those of several rotations."""
DRAWN = 20
CROSS = np.array(
    [
        [[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
        [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]],
        [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
    ]
)
"""The matrices of the cross products e_a x."""


@dataclass(frozen=True, eq=False)
class Smallest:
    """The rotations (k, 3, 3) that minimize |L x|^2 over x = (1, vec R_1, ..., vec R_k), and what is known of that.

    Parameters
    ----------
    rotations
        (k, 3, 3).
    value
        |L x|^2.
    bound
        No rotations have a smaller value than this, up to rounding.
    rank_ratio
        Second eigenvalue of the relaxation's moment matrix over its first.
    information
        (3k, 3k) half the second derivative of the value by rotation vectors [1/rad^2].
    steepness
        c >= 0: every x has a value of at least bound + c |x_other|^2, x_other being what of x is not along the best.
    """

    rotations: Array
    value: float
    bound: float
    rank_ratio: float
    information: Array
    steepness: float

    def radius(self, excess: float) -> float:
        """Return the angle [rad] from the best beyond which every value exceeds the smallest by more than this.

        Both x have the length n = 1 + 3 k, squared, so that c = x'x_best / n has 1 - c^2 = |x_other|^2 / n, and
        |x - x_best|^2 = 2 n (1 - c), of which one rotation has 8 sin^2(angle / 2). A trace of -1 or more keeps c above
        (1 - k) / n.
        """
        if self.steepness <= 0:
            return float(np.pi)
        k = len(self.rotations)
        n = 1 + 3 * k
        square = 1 - (excess + self.value - self.bound) / (self.steepness * n)
        if square <= ((1 - k) / n) ** 2:
            return float(np.pi)
        apart = 2 * n * (1 - np.sqrt(square))
        return float(2 * np.arcsin(min(1.0, np.sqrt(apart / 8))))


def nearest(L: Array, rotations: Array) -> Smallest:
    """Return the stationary rotations near some, of which nothing is known."""
    best = _refined(L, rotations)
    return Smallest(best, _value(L, best), -np.inf, np.inf, np.zeros((3 * len(best), 3 * len(best))), 0.0)


def smallest(L: Array, candidates: Iterable[Array] = (), shared: int | None = None) -> Smallest:
    """Return the best of what the relaxation and candidates (k, 3, 3) lead to, with the relaxation's bound.

    ::

        Q - f e e' - sum_j multipliers_j C_j  >=  mu 1,    mu <= 0
        x'Q x  >=  f + mu |x|^2  =  f + mu (1 + 3 k)    for every x = (1, vec R_1, ..., vec R_k)

    The multipliers are the solver's, moved by the least that makes the left side vanish on the rotations found, with f
    their value. The bound then does not depend on the solver's accuracy: mu is the smallest eigenvalue.

    Parameters
    ----------
    L
        (m, n), n = 1 + 9 k.
    candidates
        Further rotations to start from.
    shared
        As `relax` has it.

    Examples
    --------
    >>> import numpy as np
    >>> from rpim_opt.problem.rotations import smallest
    >>> wanted = np.diag([1.0, -1.0, -1.0])
    >>> L = np.hstack([-wanted.reshape(9, 1), np.eye(9)])  # |L x|^2 = |R - wanted|^2
    >>> found = smallest(L)
    >>> bool(np.abs(found.rotations[0] - wanted).max() < 1e-9), bool(abs(found.bound) < 1e-9)
    (True, True)
    """
    Q = L.T @ L
    moments = relax(Q, shared)
    if moments.rank_ratio > SPREAD:  # several rotations, or one of which the form is large where others hardly differ
        moments = relax(Q, shared, FINE)
    starts = [*_rounded(moments), *candidates]
    refined = [_refined(L, start) for start in starts]
    values = [_value(L, R) for R in refined]
    best = refined[int(np.argmin(values))]
    bound, steepness = _bound(Q, lifted(best), min(values), moments.multipliers)
    return Smallest(best, min(values), bound, moments.rank_ratio, _slopes(L, best)[1] / 2, steepness)


def undercut(L: Array, shared: int | None = None) -> float:
    """Return a value of |L x|^2 that no rotations undercut, by the relaxation's multipliers alone."""
    Q = L.T @ L
    moments = relax(Q, shared, FINE)
    value = float(np.sum(Q * moments.matrix))
    count = (len(Q) - 1) // 9
    S = Q - np.tensordot(moments.multipliers, rotation_constraints(count), axes=1)
    S[0, 0] -= value
    return value + min(0.0, float(np.linalg.eigvalsh(S)[0])) * (1 + 3 * count)


def lifted(rotations: Array) -> Array:
    """Return x = (1, vec R_1, ..., vec R_k), rows first."""
    return np.concatenate([[1.0], rotations.ravel()])


def _value(L: Array, rotations: Array) -> float:
    return float(np.sum((L @ lifted(rotations)) ** 2))


def _rounded(moments: Moments) -> list[Array]:
    """Return rotations that the moment matrix stands for: their mean, and where it has several, some drawn from it."""
    eigenvalues, vectors = np.linalg.eigh(moments.matrix)
    lifts = [moments.matrix[:, 0]]
    if moments.rank_ratio > SPREAD:
        lifts += [np.copysign(1.0, v[0]) * v for v in vectors.T[::-1][:4]]
        normal = np.random.default_rng(0).normal(size=(DRAWN, len(eigenvalues)))
        drawn = normal * np.sqrt(np.maximum(eigenvalues, 0.0)) @ vectors.T
        lifts += [np.copysign(1.0, v[0]) * v for v in drawn]
    return [proper(lift[1:].reshape(-1, 3, 3)) for lift in lifts]


def _slopes(L: Array, rotations: Array) -> tuple[Array, Array]:
    """Return first (3k,) and second derivatives (3k, 3k) of |L x|^2 by rotation vectors w, R_i exp([w_i] x)."""
    k = len(rotations)
    residual = L @ lifted(rotations)
    G = (2 * L.T @ residual)[1:].reshape(k, 3, 3)
    D = np.zeros((L.shape[1], 3 * k))
    B = np.zeros((3 * k, 3 * k))
    for i, R in enumerate(rotations):
        own = slice(3 * i, 3 * i + 3)
        D[1 + 9 * i : 10 + 9 * i, own] = (R @ CROSS).reshape(3, 9).T
        M = R.T @ G[i]
        # the second order of exp([w] x) is ([w] x)^2 / 2 = (w w' - |w|^2) / 2
        B[own, own] = (M + M.T) / 2 - np.trace(M) * np.eye(3)
    J = L @ D
    return 2 * J.T @ residual, 2 * J.T @ J + B


def _refined(L: Array, rotations: Array) -> Array:
    """Return the stationary rotations to which Newton's steps lead, uphill directions turned, long steps halved."""
    value = _value(L, rotations)
    for _ in range(STEPS):
        slope, curvature = _slopes(L, rotations)
        eigenvalues, V = np.linalg.eigh(curvature)
        sizes = np.maximum(np.abs(eigenvalues), 1e-14 * np.abs(eigenvalues).max() + 1e-300)
        step = -V @ ((V.T @ slope) / sizes)
        step *= min(1.0, 1.0 / max(np.linalg.norm(step), 1e-300))
        moved, lower = _moved(L, rotations, step, value)
        if lower >= value:
            break
        rotations = moved
        value = lower
        if np.linalg.norm(step) < SHORT:
            break
    return rotations


def _moved(L: Array, rotations: Array, step: Array, value: float) -> tuple[Array, float]:
    """Return the rotations after the step, or the first of its halves that lowers the value."""
    part = step
    for _ in range(12):
        turn = transform.Rotation.from_rotvec(part.reshape(-1, 3)).as_matrix()
        moved = proper(rotations @ turn)
        lower = _value(L, moved)
        if lower < value:
            return moved, lower
        part = part / 2
    return rotations, value


def _bound(Q: Array, x: Array, value: float, multipliers: Array) -> tuple[float, float]:
    """Return a value that no rotations undercut, from multipliers near the solver's, and how steeply others rise."""
    C = rotation_constraints((len(x) - 1) // 9)
    S = Q - np.tensordot(multipliers, C, axes=1)
    S[0, 0] -= value
    moves = np.linalg.lstsq((C @ x).T, S @ x, rcond=1e-12)[0]
    S = S - np.tensordot(moves, C, axes=1)
    eigenvalues = np.linalg.eigvalsh(S)
    return value + min(0.0, float(eigenvalues[0])) * float(x @ x), max(0.0, float(eigenvalues[1]))
