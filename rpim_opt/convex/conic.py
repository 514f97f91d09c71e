"""Programs that CVXPY canonicalizes once and Clarabel solves for any data, without asking CVXPY again."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.late import Late, sparse
from rpim_opt.basics.phases import phase
from rpim_opt.convex.atoms import INFEASIBLE, INFEASIBLE_INACCURATE, OPTIMAL, UNBOUNDED, cp

clarabel: Any = Late("clarabel")  # a compiled module, without types
conif: Any = Late("cvxpy.reductions.solvers.conic_solvers.clarabel_conif")
SOUGHT, ACCEPTED = 1e-12, 1e-8
"""Tolerances of gap and feasibility, relative or absolute: the solver goes on to the first while it makes progress, and
has solved the program when it then meets the second, Clarabel's own default."""
ATTEMPTS: tuple[dict[str, Any], ...] = (
    {},
    {"static_regularization_constant": 1e-10},
    {"direct_solve_method": "faer"},
    {"equilibrate_enable": False, "tol_gap_abs": ACCEPTED, "tol_gap_rel": ACCEPTED, "tol_feas": ACCEPTED},
)
"""Settings, tried in turn: where one factorization stalls short of the tolerance, another does not."""
STATUS = {
    "Solved": OPTIMAL,
    "AlmostSolved": OPTIMAL,
    "PrimalInfeasible": INFEASIBLE,
    "AlmostPrimalInfeasible": INFEASIBLE_INACCURATE,
    "DualInfeasible": UNBOUNDED,
}


@dataclass(frozen=True, eq=False)
class Solution:
    """How Clarabel ended: CVXPY's word, unknowns u (n,), everything that CVXPY sees, and the cones' multipliers."""

    status: str
    u: Array
    x: Array
    cones: Array
    iterations: int
    seconds: float


class Conic:
    """A program in variables v, ready to be solved in others, v = T u + c.

    CVXPY brings ``minimize objective(v)`` subject to constraints on v to Clarabel's form once::

        minimize  1/2 x'(P + weight dP) x + (q + weight dq)'x    subject to    A x + s = b,  s in a cone

    where x holds v and what CVXPY adds. The data of a calibration are in T and c alone: to put v = T u + c is a
    product of matrices, where CVXPY's own parameters cost ten times the solver.

    Parameters
    ----------
    objective
        Convex expression of the variables; with ``weight`` in it, affine in the weight.
    constraints
        Of the variables.
    variables
        v in the order of the rows of T; those that do not occur are passed over.
    weight
        Parameter of the objective, or None.
    """

    def __init__(
        self, objective: Any, constraints: Sequence[Any], variables: Sequence[cp.Variable], weight: cp.Parameter | None
    ):
        self.problem = cp.Problem(cp.Minimize(objective), list(constraints))
        first, self._chain, self._inverse = self._data(weight, 1.0)
        P, q = first["P"], first["c"]
        dP, dq = 0.0 * P, 0.0 * q
        if weight is not None:
            second = self._data(weight, 2.0)[0]
            dP, dq = second["P"] - first["P"], second["c"] - first["c"]
            P, q = first["P"] - dP, first["c"] - dq
        place = first["param_prob"].var_id_to_col
        rows: list[np.ndarray] = []
        places: list[np.ndarray] = []
        start = 0
        for variable in variables:
            if variable.id in place:
                rows.append(np.arange(start, start + variable.size))
                places.append(place[variable.id] + np.arange(variable.size))
            start += variable.size
        self._rows = np.concatenate([np.empty(0, dtype=int), *rows])
        self._own = own = np.concatenate([np.empty(0, dtype=int), *places])
        self._rest = np.setdiff1d(np.arange(len(first["c"])), own)
        self._objective = _Affine(P, dP, q, dq, own, self._rest)
        self._size, self._b = len(first["c"]), first["b"]
        self._cones = conif.dims_to_solver_cones(first["dims"])
        self._blocks = _blocks(first["dims"], len(self._b))
        A = sparse.csr_array(first["A"])
        self._A_own, self._A_rest = A[:, own], sparse.coo_array(A[:, self._rest])
        self._touched = np.flatnonzero(np.diff(self._A_own.indptr))
        self._A_touched = self._A_own[self._touched]
        self._patterns: dict[int, tuple[_Pattern, _Pattern]] = {}

    def _data(self, weight: cp.Parameter | None, value: float) -> tuple[dict[str, Any], Any, Any]:
        if weight is not None:
            weight.value = value
        data, chain, inverse = self.problem.get_problem_data(cp.CLARABEL, solver_opts={})
        n = len(data["c"])
        if data.get("P") is None:
            data["P"] = sparse.csc_array((n, n))
        data["P"] = sparse.csc_array(data["P"])
        return data, chain, inverse

    def solve(
        self, T: Array, c: Array, weight: float, H: Array, g: Array, size: float = 1.0, attempt: int = 0
    ) -> Solution:
        """Solve for u, v = T u + c.

        Parameters
        ----------
        T, c
            (k, n) and (k,), all variables' rows.
        weight
            Of the second part of the objective.
        H, g
            (n, n) and (n,): 1/2 u'H u + g'u is added to the objective.
        size
            The objective is solved in units of it.
        attempt
            Which of the `ATTEMPTS`.
        """
        n = T.shape[1]
        if n not in self._patterns:
            self._patterns[n] = self._pattern(n)
        P_pattern, A_pattern = self._patterns[n]
        T, c = T[self._rows], c[self._rows]
        P, q = self._objective.at(T, c, weight, H, g)
        P, q = [part / size for part in P], q / size
        touched = self._A_touched @ T
        added = self._added_scale(touched) if attempt else np.ones(len(self._rest))
        P, q = self._objective.scaled(P, q, added)
        rest = self._A_rest.data * added[self._A_rest.col]
        scale = self._row_scale(touched, rest)
        values = [(touched * scale[self._touched, None]).ravel(), rest * scale[self._A_rest.row]]
        b = (self._b - self._A_own @ c) * scale
        begin = time.perf_counter()
        with phase("solve"):
            solver = clarabel.DefaultSolver(
                P_pattern.filled(P), q, A_pattern.filled(values), b, self._cones, _settings(attempt)
            )
            found = solver.solve()
        status = STATUS.get(str(found.status), str(found.status))
        unknowns = np.array(found.x)
        x = np.zeros(self._size)
        x[self._own] = T @ unknowns[:n] + c
        x[self._rest] = unknowns[n:] * added
        cones = np.array(found.z) * scale * size
        return Solution(status, unknowns[:n], x, cones, int(found.iterations), time.perf_counter() - begin)

    def _row_scale(self, touched: Array, rest: Array) -> Array:
        """Return one over the size of the rows (m,), of a cone's rows together: Clarabel's tolerances are absolute."""
        squares = np.bincount(self._A_rest.row, rest**2, minlength=len(self._b)).astype(float)
        squares[self._touched] += np.sum(touched**2, axis=1)
        largest = np.maximum.reduceat(squares, self._blocks) if len(squares) else squares
        counts = np.diff(np.append(self._blocks, len(squares)))
        size = np.sqrt(np.repeat(largest, counts))
        return np.divide(1.0, size, out=np.ones_like(size), where=size > 0)

    def _added_scale(self, touched: Array) -> Array:
        """Return units for what CVXPY added: those of v in the rows that hold both (a bound of a thousandth, in SI)."""
        own = np.zeros(len(self._b))
        own[self._touched] = np.linalg.norm(touched, axis=1)
        ratio = own[self._A_rest.row] / np.maximum(np.abs(self._A_rest.data), 1e-300)
        scale = np.zeros(len(self._rest))
        np.maximum.at(scale, self._A_rest.col, ratio)
        return np.where(scale > 0, scale, 1.0)

    def _pattern(self, n: int) -> tuple[_Pattern, _Pattern]:
        """Return where the numbers of P and A stand."""
        dense = (np.repeat(self._touched, n), np.tile(np.arange(n), len(self._touched)))
        added = (self._A_rest.row, n + self._A_rest.col)
        size = n + len(self._rest)
        return _Pattern(self._objective.places(n), (size, size)), _Pattern([dense, added], (len(self._b), size))

    def values(self, found: Solution, variable: cp.Variable) -> Array:
        """Return what a variable besides v ended with, in the variable's shape."""
        return np.asarray(self._inverted(found.x, found.cones).primal_vars[variable.id])

    def multipliers(self, found: Solution, constraint: Any) -> Array:
        """Return the multipliers of one of the constraints, from those of the cones."""
        return np.ravel(self._inverted(found.x, found.cones).dual_vars[constraint.id])

    def _inverted(self, x: Array, z: Array) -> Any:
        """Return a solution in the terms of the problem as it was stated."""
        raw = SimpleNamespace(status="Solved", solve_time=0.0, iterations=0, obj_val=0.0, z=z, x=x)
        return self._chain.invert(raw, self._inverse)


@lru_cache
def _settings(attempt: int) -> Any:
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = SOUGHT
    settings.reduced_tol_gap_abs = settings.reduced_tol_gap_rel = settings.reduced_tol_feas = ACCEPTED
    for name, value in ATTEMPTS[attempt].items():
        setattr(settings, name, value)
    return settings


def _blocks(dims: Any, count: int) -> np.ndarray:
    """Return the first row of every part that may be scaled alone: single rows, and cones as a whole."""
    sizes = [1] * (dims.zero + dims.nonneg)
    sizes += list(dims.soc)
    sizes += [n * (n + 1) // 2 for n in dims.psd]
    sizes += [3] * (dims.exp + len(dims.p3d))
    left = count - sum(sizes)
    if left:  # cones of a kind that came later: all of them together
        sizes.append(left)
    return np.cumsum([0, *sizes[:-1]])


class _Affine:
    """Objective 1/2 x'(P + weight dP) x + (q + weight dq)'x, when some x are T u + c and the others stay."""

    def __init__(self, P: Any, dP: Any, q: Array, dq: Array, own: np.ndarray, rest: np.ndarray):
        both = abs(P) + abs(dP)  # where numbers may stand
        cross = sparse.coo_array(both[own][:, rest])
        self._crossed = np.unique(cross.col)
        upper = sparse.coo_array(sparse.triu(both[rest][:, rest]))
        self._upper = upper.row, upper.col
        self._parts = [self._part(sparse.csr_array(M), v, own, rest) for M, v in ((P, q), (dP, dq))]

    def _part(self, M: Any, v: Array, own: np.ndarray, rest: np.ndarray) -> tuple[Any, ...]:
        inner = np.empty(0)
        if len(self._upper[0]):
            inner = np.asarray(sparse.csr_array(M[rest][:, rest])[self._upper]).ravel()
        return M[own][:, own], M[own][:, rest], M[own][:, rest[self._crossed]], inner, v[own], v[rest]

    def places(self, n: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return rows and columns of the numbers that `at` returns, for n unknowns u."""
        k = len(self._crossed)
        cross = np.repeat(np.arange(n), k), n + np.tile(self._crossed, n)
        return [np.triu_indices(n), cross, (n + self._upper[0], n + self._upper[1])]

    def scaled(self, P: list[Array], q: Array, added: Array) -> tuple[list[Array], Array]:
        """Return the numbers of `at` for what was added in other units."""
        dense, cross, inner = P
        n = len(q) - len(added)
        units = added[self._crossed]
        cross = (cross.reshape(n, -1) * units).ravel() if len(units) else cross
        inner = inner * added[self._upper[0]] * added[self._upper[1]]
        return [dense, cross, inner], np.concatenate([q[:n], q[n:] * added])

    def at(self, T: Array, c: Array, weight: float, H: Array, g: Array) -> tuple[list[Array], Array]:
        """Return the numbers of P and q, with 1/2 u'H u + g'u added."""
        n = T.shape[1]
        parts = [a + weight * b if weight else a for a, b in zip(*self._parts, strict=True)]
        own, rest, crossed, upper, q_own, q_rest = parts
        dense = T.T @ (own @ T) + H
        q = np.concatenate([T.T @ (q_own + own @ c) + g, q_rest + rest.T @ c])
        return [dense[np.triu_indices(n)], np.asarray(T.T @ crossed).ravel(), upper], q


class _Pattern:
    """A sparse matrix whose numbers change and whose places do not, zeros among them."""

    def __init__(self, places: Sequence[tuple[Any, Any]], shape: tuple[int, int]):
        rows = np.concatenate([part[0] for part in places])
        columns = np.concatenate([part[1] for part in places])
        self._order = np.lexsort((rows, columns))
        ends = np.searchsorted(columns[self._order], np.arange(shape[1] + 1))
        self._empty = sparse.csc_matrix((np.zeros(len(rows)), rows[self._order], ends), shape=shape)

    def filled(self, values: Sequence[Array]) -> Any:
        """Return the matrix with these numbers, in the order of the places."""
        matrix = self._empty.copy()
        matrix.data = np.concatenate(values)[self._order]
        return matrix
