"""Moment matrices of quadratic forms of rotations, by Clarabel: CVXPY's definition, brought to cones once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.late import Late, sparse
from rpim_opt.basics.phases import phase
from rpim_opt.problem.moments import relaxation, shares

if TYPE_CHECKING:
    import cvxpy as cp
else:
    cp = Late("cvxpy")
conif: Any = Late("cvxpy.reductions.solvers.conic_solvers.clarabel_conif")

clarabel: Any = Late("clarabel")  # a compiled module, without types
SOUGHT = 1e-8
"""Tolerance of gap and feasibility, the form being of size one: what follows refines rotations and multipliers."""


@dataclass(frozen=True, eq=False)
class Moments:
    """What the relaxation says.

    Parameters
    ----------
    matrix
        (n, n) moment matrix; of rank one where it is x x' of rotations.
    multipliers
        (c,) of the constraints of `moments.rotation_constraints`.
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


@dataclass(frozen=True, eq=False)
class _Cone:
    """The relaxation in Clarabel's form, which CVXPY made once: of Q is b alone, its parts' triangles."""

    A: Any
    q: Array
    cones: Any
    columns: slice
    places: tuple[np.ndarray, ...]

    def triangles(self, Q: Array) -> Array:
        """Return the parts' upper triangles column by column, what is off the diagonal times the root of two."""
        return np.concatenate([_triangle(share) for share in shares(Q, self.places)])

    def matrix(self, triangles: Array) -> Array:
        """Return the moment matrix (n, n) of which the parts know theirs, completed so that it stays semidefinite."""
        sizes = [len(place) * (len(place) + 1) // 2 for place in self.places]
        parts = [_square(each) for each in np.split(triangles, np.cumsum(sizes)[:-1])]
        n = int(self.places[-1][-1]) + 1
        M = np.zeros((n, n))
        for place, part in zip(self.places, parts, strict=True):
            M[np.ix_(place, place)] = part
        if len(parts) > 1:
            common = len(np.intersect1d(self.places[0], self.places[-1]))
            known = M[:, :common]
            completed = known @ np.linalg.pinv(M[:common, :common], rcond=1e-9, hermitian=True) @ known.T
            unknown = np.ones((n, n), dtype=bool)
            for place in self.places:
                unknown[np.ix_(place, place)] = False
            M[unknown] = completed[unknown]
        return M


def _triangle(M: Array) -> Array:
    columns, rows = np.tril_indices(len(M))
    return np.where(rows == columns, 1.0, np.sqrt(2)) * M[rows, columns]


def _square(triangle: Array) -> Array:
    n = int(np.sqrt(2 * len(triangle)))
    columns, rows = np.tril_indices(n)
    M = np.zeros((n, n))
    M[rows, columns] = triangle / np.where(rows == columns, 1.0, np.sqrt(2))
    return M + np.triu(M, 1).T


@lru_cache
def _cone(count: int, shared: int) -> _Cone:
    stated = relaxation(count, shared)
    stated.state(np.eye(1 + 9 * count))
    data = stated.problem.get_problem_data(cp.CLARABEL, solver_opts={})[0]
    start = data["param_prob"].var_id_to_col[stated.multipliers.id]
    own = slice(start, start + stated.multipliers.size)
    return _Cone(sparse.csc_matrix(data["A"]), data["c"], conif.dims_to_solver_cones(data["dims"]), own, stated.places)


def relax(Q: Array, shared: int | None = None, sought: float = SOUGHT) -> Moments:
    """Return the moment matrix and the multipliers of `moments.Relaxation`.

    Parameters
    ----------
    Q
        (n, n) symmetric, n = 1 + 9 k for k rotations.
    shared
        The first so many rotations are those that the others have products with, and they have none among themselves;
        all by default.
    sought
        Tolerance of gap and feasibility.

    Examples
    --------
    The rotation with the largest trace is none at all.

    >>> import numpy as np
    >>> from rpim_opt.problem.relaxed import relax
    >>> Q = np.zeros((10, 10))
    >>> Q[0, [1, 5, 9]] = Q[[1, 5, 9], 0] = -0.5
    >>> found = relax(Q)
    >>> found.matrix[0, 1:].reshape(3, 3).round(6) + 0.0
    array([[1., 0., 0.],
           [0., 1., 0.],
           [0., 0., 1.]])
    """
    count = (len(Q) - 1) // 9
    cone = _cone(count, count if shared is None else shared)
    size = float(np.abs(Q).max()) or 1.0
    P = sparse.csc_matrix((len(cone.q), len(cone.q)))
    with phase("solve"):
        b = cone.triangles(Q / size)
        found = clarabel.DefaultSolver(P, cone.q, cone.A, b, cone.cones, _settings(sought)).solve()
    return Moments(cone.matrix(np.array(found.z)), size * np.array(found.x)[cone.columns], str(found.status))


@lru_cache
def _settings(sought: float) -> Any:
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.iterative_refinement_enable = False  # half of the time, for digits that are refined later
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = sought
    return settings
