"""Quadratic forms of rotations, relaxed to moment matrices: the definition in CVXPY, its minimum by Clarabel."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import clarabel as clarabel_module
import cvxpy as cp
import numpy as np
from cvxpy.reductions.solvers.conic_solvers.clarabel_conif import dims_to_solver_cones
from scipy import sparse

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.phases import phase

clarabel: Any = clarabel_module  # a compiled module, without types
SOUGHT = 1e-11
"""Tolerance of gap and feasibility that Clarabel goes on to while it makes progress; the form is of size one."""


@dataclass(frozen=True, eq=False)
class Moments:
    """What the relaxation says.

    Parameters
    ----------
    matrix
        (n, n) moment matrix; of rank one where it is x x' of rotations.
    multipliers
        (c,) of the constraints of `rotation_constraints`.
    status
        Clarabel's word.
    """

    matrix: Array
    multipliers: Array
    status: str

    @property
    def rank_ratio(self) -> float:
        """Second eigenvalue of the moment matrix over its first: zero where it is of rank one."""
        eigenvalues = np.linalg.eigvalsh(self.matrix)
        return float(abs(eigenvalues[-2]) / eigenvalues[-1])


@lru_cache
def rotation_constraints(count: int) -> Array:
    """Return C (c, n, n) with x'C x = 0 for x = (1, vec R_1, ..., vec R_count), rows first, and no other quadratic.

    Of every rotation the twenty independent ones: R R' = 1 and R'R = 1, of which one diagonal entry follows from the
    others, and each row the cross product of the next two, which says that R is right-handed.
    """
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
class Relaxation:
    """The relaxation of min x'Q x over x = (1, vec R_1, ..., vec R_k), in the form that has k 20 + 1 unknowns.

    ::

        maximize    bound
        subject to  Q - bound e e' - sum_j multipliers_j C_j  positive semidefinite,    e = (1, 0, ..., 0)

    For rotations the left side of the constraint times x x' is x'Q x - bound >= 0: no rotation has a smaller value. The
    constraint's own multiplier is the moment matrix, which minimizes <Q, M> over all positive semidefinite M with
    M_00 = 1 and <C_j, M> = 0.
    """

    problem: cp.Problem
    form: cp.Parameter
    bound: cp.Variable
    multipliers: cp.Variable
    constraint: Any


def relaxation(count: int) -> Relaxation:
    """Return the definition for so many rotations, its form Q a parameter."""
    C = rotation_constraints(count)
    n = C.shape[1]
    form = cp.Parameter((n, n), symmetric=True)
    bound = cp.Variable()
    multipliers = cp.Variable(len(C))
    first = np.zeros((n, n))
    first[0, 0] = 1.0
    combined = cp.reshape(C.reshape(len(C), -1).T @ multipliers, (n, n), order="C")
    constraint = form - bound * first - combined >> 0
    return Relaxation(cp.Problem(cp.Maximize(bound), [constraint]), form, bound, multipliers, constraint)


@dataclass(frozen=True, eq=False)
class _Cone:
    """The relaxation in Clarabel's form, which CVXPY made once: only b is of the form Q, and is its triangle."""

    A: Any
    q: Array
    cones: Any
    columns: slice
    upper: tuple[np.ndarray, np.ndarray]
    root: Array

    def triangle(self, Q: Array) -> Array:
        """Return the upper triangle column by column, what is off the diagonal times the root of two."""
        return Q[self.upper] * self.root

    def matrix(self, triangle: Array) -> Array:
        """Return the symmetric matrix of a triangle."""
        n = self.upper[1][-1] + 1
        M = np.zeros((n, n))
        M[self.upper] = triangle / self.root
        return M + np.triu(M, 1).T


@lru_cache
def _cone(count: int) -> _Cone:
    stated = relaxation(count)
    n = stated.form.shape[0]
    stated.form.value = np.eye(n)
    data = stated.problem.get_problem_data(cp.CLARABEL, solver_opts={})[0]
    start = data["param_prob"].var_id_to_col[stated.multipliers.id]
    columns, rows = np.tril_indices(n)
    root = np.where(rows == columns, 1.0, np.sqrt(2))
    A = sparse.csc_matrix(data["A"])
    own = slice(start, start + stated.multipliers.size)
    return _Cone(A, data["c"], dims_to_solver_cones(data["dims"]), own, (rows, columns), root)


def relax(Q: Array) -> Moments:
    """Return the moment matrix and the multipliers of the relaxation of min x'Q x.

    Parameters
    ----------
    Q
        (n, n) symmetric, n = 1 + 9 k for k rotations.

    Examples
    --------
    The rotation with the largest trace is none at all.

    >>> import numpy as np
    >>> from rpim_opt.problem.moments import relax
    >>> Q = np.zeros((10, 10))
    >>> Q[0, [1, 5, 9]] = Q[[1, 5, 9], 0] = -0.5
    >>> found = relax(Q)
    >>> found.matrix[0, 1:].reshape(3, 3).round(6) + 0.0
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]])
    """
    cone = _cone((len(Q) - 1) // 9)
    size = float(np.abs(Q).max()) or 1.0
    P = sparse.csc_matrix((len(cone.q), len(cone.q)))
    with phase("solve"):
        b = cone.triangle(Q / size)
        found = clarabel.DefaultSolver(P, cone.q, cone.A, b, cone.cones, _settings()).solve()
    return Moments(cone.matrix(np.array(found.z)), size * np.array(found.x)[cone.columns], str(found.status))


@lru_cache
def _settings() -> Any:
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = SOUGHT
    return settings
