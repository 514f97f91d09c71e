"""Quadratic forms of rotations: semidefinite relaxation, rounding, refinement and a lower bound."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from typing import Any

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.threads import phase
from rpim_opt.problem.registration.closed_forms import proper

TOLERANCE, FINE = 1e-8, 1e-12
"""Of gap and feasibility, the form being of size one: what follows refines rotations and multipliers; the finer one
where moments are those of several rotations."""
STEPS = 50
"""Newton steps after which rotations are as good as they get."""
SHORT = 1e-13
"""Rotations are found when a step is shorter [rad]."""
SPREAD = 1e-3
"""Second over first eigenvalue from which moments are those of several rotations, and a few are drawn from them."""
DRAWN = 20
CROSS = -np.cross(np.eye(3)[:, None], np.eye(3))
"""The matrices of the cross products e_a x."""


@lru_cache
def rotation_constraints(count: int) -> Array:
    """Return C (c, n, n) with x'C x = 0 for x = (1, vec R_1, ..., vec R_count), rows first, and no other quadratic."""
    rows = [_quadratic(count, terms) for k in range(count) for terms in _of_rotation(1 + 9 * k)]
    return np.array(rows)


def _of_rotation(first: int) -> list[list[tuple[int, int, float]]]:
    """Return the terms (place, place, coefficient) of the quadratics that vanish on one rotation."""
    at = first + np.arange(9).reshape(3, 3)
    forms = []
    for entries in (at, at.T):
        for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            terms = [(int(a), int(b), 1.0) for a, b in zip(entries[i], entries[j], strict=True)]
            forms.append([*terms, (0, 0, -float(i == j))])
    del forms[-1]  # both sums of squares are three
    for i in range(3):
        p, q, r = at[i], at[(i + 1) % 3], at[(i + 2) % 3]
        for a in range(3):
            b = (a + 1) % 3
            c = (a + 2) % 3
            forms.append([(int(p[b]), int(q[c]), 1.0), (int(p[c]), int(q[b]), -1.0), (0, int(r[a]), -1.0)])
    return forms


def _quadratic(count: int, terms: list[tuple[int, int, float]]) -> Array:
    """Return the symmetric matrix (n, n) of a sum of products."""
    M = np.zeros((1 + 9 * count, 1 + 9 * count))
    for i, j, value in terms:
        M[i, j] += value / 2
        M[j, i] += value / 2
    return M


@dataclass(frozen=True, eq=False)
class Moments:
    """The moment matrix (n, n), of rank one where it is x x' of rotations, and the multipliers (20 k,) of `relax`."""

    matrix: Array
    multipliers: Array

    @property
    def rank_ratio(self) -> float:
        """Second eigenvalue of the moment matrix over its first: zero where it is of rank one."""
        eigenvalues = np.linalg.eigvalsh(self.matrix)
        return float(abs(eigenvalues[-2]) / eigenvalues[-1])


def relax(Q: Array, shared: int | None = None, tolerance: float = TOLERANCE) -> Moments:
    """Return the relaxation of min x'Q x over x = (1, vec R_1, ..., vec R_k), with 20 k + 1 unknowns."""
    clarabel = import_module("clarabel")

    count = (len(Q) - 1) // 9
    shared = count if shared is None else shared
    blocks = _blocks(count, shared)
    A, q = _cone(count, shared)
    size = float(np.abs(Q).max()) or 1.0
    shares = [Q[np.ix_(block, block)] / size for block in blocks]
    for share in shares[:-1]:  # products of what is shared stand in the last
        share[: 1 + 9 * shared, : 1 + 9 * shared] = 0.0
    cones = [clarabel.PSDTriangleConeT(len(block)) for block in blocks]
    b = np.concatenate([_triangles(share) for share in shares])
    P = scipy.sparse.csc_matrix((len(q), len(q)))
    with phase("solve"):
        found = clarabel.DefaultSolver(P, q, A, b, cones, _settings(tolerance)).solve()
    return Moments(_completed(np.array(found.z), blocks, 1 + 9 * shared), size * np.array(found.x)[1 : 1 + 20 * count])


def _blocks(count: int, shared: int) -> list[np.ndarray]:
    """Return the places of every semidefinite block: of 1, the shared rotations and one of the others."""
    common = np.arange(1 + 9 * shared)
    return [np.append(common, np.arange(1 + 9 * k, 10 + 9 * k)) for k in range(shared, count)] or [common]


@lru_cache
def _cone(count: int, shared: int) -> tuple[Any, Array]:
    """Return A and q of Clarabel's form, minimize q'v subject to b - A v in the cone; b has the blocks of Q."""
    blocks = _blocks(count, shared)
    common = 1 + 9 * shared
    corner = np.eye(common)[:, None, :, None] * np.eye(common)[None, :, None, :]
    i, j = np.tril_indices(common)
    corners = (corner + corner.swapaxes(0, 1))[i, j] / (1 + (i == j))[:, None, None]
    first = np.zeros((1, common, common))
    first[0, 0, 0] = 1.0
    C = rotation_constraints(count)
    columns = []
    for number, block in enumerate(blocks):
        last = number == len(blocks) - 1
        own = np.repeat([last] * shared + [len(block) > common and k == number for k in range(count - shared)], 20)
        moved = [np.zeros_like(corners)] * (len(blocks) - 1)
        if last:
            moved = [corners] * len(moved)
        else:
            moved[number] = -corners
        shared_columns = np.zeros((1 + sum(map(len, moved)), len(block), len(block)))
        shared_columns[:, :common, :common] = np.concatenate([first * last, *moved])
        of_rotations = C[:, block[:, None], block] * own[:, None, None]
        columns.append(_triangles(np.concatenate([shared_columns[:1], of_rotations, shared_columns[1:]])).T)
    A = scipy.sparse.csc_matrix(np.concatenate(columns))
    q = np.zeros(A.shape[1])
    q[0] = -1.0
    return A, q


def _triangles(M: Array) -> Array:
    """Return upper triangles of M (..., n, n), column by column, what is off the diagonal times the root of two."""
    columns, rows = np.tril_indices(M.shape[-1])
    return np.where(rows == columns, 1.0, np.sqrt(2)) * M[..., rows, columns]


def _completed(triangles: Array, blocks: Sequence[np.ndarray], common: int) -> Array:
    """Return the moment matrix (n, n) of which the blocks know theirs, completed so that it stays semidefinite."""
    n = int(blocks[-1][-1]) + 1
    M = np.zeros((n, n))
    unknown = np.ones((n, n), dtype=bool)
    start = 0
    for block in blocks:
        columns, rows = np.tril_indices(len(block))
        values = triangles[start : start + len(rows)] / np.where(rows == columns, 1.0, np.sqrt(2))
        start += len(rows)
        M[block[rows], block[columns]] = M[block[columns], block[rows]] = values
        unknown[np.ix_(block, block)] = False
    known = M[:, :common]
    completed = known @ np.linalg.pinv(M[:common, :common], rcond=1e-9, hermitian=True) @ known.T
    return np.where(unknown, completed, M)


@lru_cache
def _settings(tolerance: float) -> Any:
    clarabel = import_module("clarabel")

    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.iterative_refinement_enable = False  # half of the time, for digits that are refined later
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    return settings


@dataclass(frozen=True, eq=False)
class Smallest:
    """The rotations (k, 3, 3) that minimize |L x|^2 over x = (1, vec R_1, ..., vec R_k), and what is known of that."""

    rotations: Array
    value: float
    bound: float
    rank_ratio: float
    information: Array
    steepness: float

    def radius(self, excess: float) -> float:
        """Return the angle [rad] from the best beyond which every value exceeds the smallest by more than this."""
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
    """Return the best of what the relaxation and candidates (k, 3, 3) lead to, with the relaxation's bound."""
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
        turn = scipy.spatial.transform.Rotation.from_rotvec(part.reshape(-1, 3)).as_matrix()
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
