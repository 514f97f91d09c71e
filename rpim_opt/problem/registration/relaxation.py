"""Quadratic forms of rotations: semidefinite relaxation, rounding, refinement and a lower bound."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from importlib import import_module
from typing import NamedTuple

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.threads import phase
from rpim_opt.problem.registration.closed_forms import proper

TOLERANCE, FINE = 1e-8, 1e-12
"""Of gap and feasibility, the form being of size one: what follows refines rotations and multipliers; the finer one
where moments are those of several rotations."""
SPREAD = 1e-3
"""Second over first eigenvalue from which moments are those of several rotations, and a few are drawn from them."""
CROSS = -np.cross(np.eye(3)[:, None], np.eye(3))  # the matrices of the cross products e_a x


@lru_cache
def rotation_constraints(count: int) -> Array:
    """Return C (c, n, n) with x'C x = 0 for x = (1, vec R_1, ..., vec R_count), rows first, and no other quadratic.

    Of every rotation the twenty independent ones: R R' = 1 and R'R = 1, of which one diagonal entry follows from the
    others, and each row the cross product of the next two, which says that R is right-handed.
    """
    C = np.zeros((20 * count, 1 + 9 * count, 1 + 9 * count))
    number = 0
    for k in range(count):
        at = 1 + 9 * k + np.arange(9).reshape(3, 3)
        orthonormal = [(entries, i, j) for entries in (at, at.T) for i in range(3) for j in range(i, 3)]
        for entries, i, j in orthonormal[:-1]:  # both sums of squares are three
            C[number, entries[i], entries[j]] = 1.0
            C[number, 0, 0] = -float(i == j)
            number += 1
        for i in range(3):
            p, q, r = np.roll(at, -i, axis=0)
            for a in range(3):
                b, c = (a + 1) % 3, (a + 2) % 3
                C[number, [p[b], p[c], 0], [q[c], q[b], r[a]]] = [1.0, -1.0, -1.0]
                number += 1
    return (C + C.swapaxes(1, 2)) / 2


class Moments(NamedTuple):
    """The relaxation of `relax`: its moment matrix is x x' where rotations are its solution."""

    matrix: Array  # (n, n)
    multipliers: Array  # (20 k,)
    rank_ratio: float  # second eigenvalue of the matrix over the first: zero where it is of rank one


def relax(Q: Array, tolerance: float = TOLERANCE) -> Moments:
    """Return the relaxation of min x'Q x over x = (1, vec R_1, ..., vec R_k), with 20 k + 1 unknowns.

    ::

        maximize    bound
        subject to  Q - bound e e' - sum_j multipliers_j C_j  positive semidefinite,    e = (1, 0, ..., 0)

    For rotations the left side of the constraint times x x' is x'Q x - bound >= 0: no rotation has a smaller value. The
    constraint's own multiplier is the moment matrix, which minimizes <Q, M> over all positive semidefinite M with
    M_00 = 1 and <C_j, M> = 0.
    """
    clarabel = import_module("clarabel")

    n = len(Q)
    first = np.zeros((1, n, n))
    first[0, 0, 0] = 1.0
    columns, rows = np.tril_indices(n)
    root = np.where(rows == columns, 1.0, np.sqrt(2))  # the cone's norm is that of the matrix
    C = np.concatenate([first, rotation_constraints((n - 1) // 9)])
    A = scipy.sparse.csc_matrix((root * C[:, rows, columns]).T)
    size = float(np.abs(Q).max()) or 1.0
    b = root * Q[rows, columns] / size
    q = np.zeros(A.shape[1])
    q[0] = -1.0
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.iterative_refinement_enable = False  # half of the time, for digits that are refined later
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    P = scipy.sparse.csc_matrix((len(q), len(q)))
    with phase("solve"):
        found = clarabel.DefaultSolver(P, q, A, b, [clarabel.PSDTriangleConeT(n)], settings).solve()
    M = np.zeros((n, n))
    M[rows, columns] = M[columns, rows] = np.array(found.z) / root
    eigenvalues = np.linalg.eigvalsh(M)
    return Moments(M, size * np.array(found.x)[1:], float(abs(eigenvalues[-2]) / eigenvalues[-1]))


@dataclass(frozen=True, eq=False)
class Smallest:
    """The rotations (k, 3, 3) that minimize |L x|^2 over x = (1, vec R_1, ..., vec R_k), and what is known of that."""

    rotations: Array
    value: float
    bound: float = -np.inf  # no rotations have less, up to rounding
    rank_ratio: float = np.inf  # of the moment matrix
    information: Array = field(default_factory=lambda: np.zeros((0, 0)))  # (3k, 3k) half the Hessian by turns [1/rad^2]
    steepness: float = 0.0  # c: every x has at least bound + c |x_other|^2, x_other being what is not along the best

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


def smallest(L: Array, start: Array | None = None, bounded: bool = True) -> Smallest:
    """Return the best of what the relaxation and a start (k, 3, 3) lead to, with the relaxation's bound.

    If that is not wanted, the stationary rotations near the start, of which nothing is known.

    ::

        Q - f e e' - sum_j multipliers_j C_j  >=  mu 1,    mu <= 0
        x'Q x  >=  f + mu |x|^2  =  f + mu (1 + 3 k)    for every x = (1, vec R_1, ..., vec R_k)

    The multipliers are the solver's, moved by the least that makes the left side vanish on the rotations found, with f
    their value. The bound then does not depend on the solver's accuracy: mu is the smallest eigenvalue.
    """
    near = [] if start is None else [_refined(L, start)]
    if near and not bounded:
        return Smallest(near[0], _value(L, near[0]))
    Q = L.T @ L
    moments = relax(Q)
    if moments.rank_ratio > SPREAD:  # several rotations, or one of which the form is large where others hardly differ
        moments = relax(Q, FINE)
    lifts = [moments.matrix[:, 0]]  # the mean of the rotations that the moments stand for
    if moments.rank_ratio > SPREAD:  # and some that are drawn from them
        eigenvalues, vectors = np.linalg.eigh(moments.matrix)
        normal = np.random.default_rng(0).normal(size=(20, len(eigenvalues)))
        drawn = normal * np.sqrt(np.maximum(eigenvalues, 0.0)) @ vectors.T
        lifts += [np.copysign(1.0, v[0]) * v for v in (*vectors.T[::-1][:4], *drawn)]
    found = [_refined(L, proper(lift[1:].reshape(-1, 3, 3))) for lift in lifts]
    best = min([*found, *near], key=lambda R: _value(L, R))
    value = _value(L, best)
    x = lifted(best)
    C = rotation_constraints(len(best))
    S = Q - np.tensordot(moments.multipliers, C, axes=1)
    S[0, 0] -= value
    moves = np.linalg.lstsq((C @ x).T, S @ x, rcond=1e-12)[0]
    eigenvalues = np.linalg.eigvalsh(S - np.tensordot(moves, C, axes=1))
    bound = value + min(0.0, float(eigenvalues[0])) * float(x @ x)
    steepness = max(0.0, float(eigenvalues[1]))
    return Smallest(best, value, bound, moments.rank_ratio, _derivatives(L, best)[1] / 2, steepness)


def lifted(rotations: Array) -> Array:
    """Return x = (1, vec R_1, ..., vec R_k), rows first."""
    return np.concatenate([[1.0], rotations.ravel()])


def _value(L: Array, rotations: Array) -> float:
    return float(np.sum((L @ lifted(rotations)) ** 2))


def _derivatives(L: Array, rotations: Array) -> tuple[Array, Array]:
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
    for _ in range(50):
        slope, curvature = _derivatives(L, rotations)
        eigenvalues, V = np.linalg.eigh(curvature)
        sizes = np.maximum(np.abs(eigenvalues), 1e-14 * np.abs(eigenvalues).max() + 1e-300)
        step = -V @ ((V.T @ slope) / sizes)
        step *= min(1.0, 1.0 / max(np.linalg.norm(step), 1e-300))
        for halved in step / 2.0 ** np.arange(12)[:, None]:
            turn = scipy.spatial.transform.Rotation.from_rotvec(halved.reshape(-1, 3)).as_matrix()
            candidate = proper(rotations @ turn)
            lower = _value(L, candidate)
            if lower < value:
                break
        else:
            return rotations
        rotations = candidate
        value = lower
        if np.linalg.norm(step) < 1e-13:  # rad
            break
    return rotations
