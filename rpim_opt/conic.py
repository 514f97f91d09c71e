"""Programs that CVXPY canonicalizes once and Clarabel solves for any data, without asking CVXPY again."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import clarabel as clarabel_module
import cvxpy as cp
import numpy as np
from cvxpy.reductions.solvers.conic_solvers.clarabel_conif import dims_to_solver_cones
from scipy import sparse

from rpim_opt.phases import phase
from rpim_opt.robot import Array

clarabel: Any = clarabel_module  # a compiled module, without types
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
    "Solved": cp.OPTIMAL,
    "AlmostSolved": cp.OPTIMAL,
    "PrimalInfeasible": cp.INFEASIBLE,
    "AlmostPrimalInfeasible": cp.INFEASIBLE_INACCURATE,
    "DualInfeasible": cp.UNBOUNDED,
}


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
        P, q, dP, dq = first["P"], first["c"], 0.0 * first["P"], 0.0 * first["c"]
        if weight is not None:
            second = self._data(weight, 2.0)[0]
            dP, dq = second["P"] - first["P"], second["c"] - first["c"]
            P, q = first["P"] - dP, first["c"] - dq
        place = first["param_prob"].var_id_to_col
        rows, own, start = [], [], 0
        for variable in variables:
            if variable.id in place:
                rows.append(np.arange(start, start + variable.size))
                own.append(place[variable.id] + np.arange(variable.size))
            start += variable.size
        self._rows = np.concatenate(rows) if rows else np.empty(0, dtype=int)
        own = np.concatenate(own) if own else np.empty(0, dtype=int)
        rest = np.setdiff1d(np.arange(len(first["c"])), own)
        self._objective = _Affine(P, dP, q, dq, own, rest)
        self._size, self._b, self._cones = len(first["c"]), first["b"], dims_to_solver_cones(first["dims"])
        A = sparse.csr_array(first["A"])
        self._A_own, self._A_rest = A[:, own], sparse.coo_array(A[:, rest])
        self._touched = np.flatnonzero(np.diff(self._A_own.indptr))
        self._A_touched = self._A_own[self._touched]
        self._patterns: dict[tuple[int, int], tuple[_Pattern, _Pattern]] = {}

    def _data(self, weight: cp.Parameter | None, value: float) -> tuple[dict[str, Any], Any, Any]:
        if weight is not None:
            weight.value = value
        data, chain, inverse = self.problem.get_problem_data(cp.CLARABEL, solver_opts={})
        n = len(data["c"])
        data["P"] = sparse.csc_array(data["P"]) if data.get("P") is not None else sparse.csc_array((n, n))
        return data, chain, inverse

    def solve(
        self,
        T: Array,
        c: Array,
        weight: float,
        identity: float,
        box: tuple[Array, Array, Array] | None,
    ) -> tuple[str, Array, Array]:
        """Solve for u, v = T u + c.

        Parameters
        ----------
        T, c
            (k, n) and (k,), all variables' rows.
        weight
            Of the second part of the objective.
        identity
            This times |u|^2 is added to the objective.
        box
            (n, n), (n,), (n,): B u between lower and upper bounds, or None.

        Returns
        -------
        CVXPY's word for the status, u (n,), and the multipliers of the cones.
        """
        n, extra = T.shape[1], 0 if box is None else 2 * len(box[1])
        if (n, extra) not in self._patterns:
            self._patterns[n, extra] = self._pattern(n, extra)
        P_pattern, A_pattern = self._patterns[n, extra]
        T, c = T[self._rows], c[self._rows]
        P, q = self._objective.at(T, c, weight, identity)
        values = [(self._A_touched @ T).ravel(), self._A_rest.data]
        b, cones = self._b - self._A_own @ c, self._cones
        if box is not None:
            B, lower, upper = box
            values += [B.ravel(), -B.ravel()]
            b, cones = np.concatenate([b, upper, -lower]), [*cones, clarabel.NonnegativeConeT(extra)]
        data = P_pattern.filled(P), q, A_pattern.filled(values), b, cones
        status, solution = "", SimpleNamespace(x=(), z=())
        for attempt in range(len(ATTEMPTS)):
            with phase("solve"):
                solution = clarabel.DefaultSolver(*data, _settings(attempt)).solve()
            status = STATUS.get(str(solution.status), str(solution.status))
            if status in (cp.OPTIMAL, cp.INFEASIBLE, cp.UNBOUNDED):
                break
        return status, np.array(solution.x[:n]), np.array(solution.z[: len(self._b)])

    def _pattern(self, n: int, extra: int) -> tuple[_Pattern, _Pattern]:
        """Return where the numbers of P and A stand."""
        dense: list[tuple[Any, Any]] = [(np.repeat(self._touched, n), np.tile(np.arange(n), len(self._touched)))]
        dense.append((self._A_rest.row, n + self._A_rest.col))
        k = np.arange(extra)
        dense.append((np.repeat(len(self._b) + k, n), np.tile(np.arange(n), extra)))
        size = n + self._size - len(self._rows)
        return _Pattern(self._objective.places(n), (size, size)), _Pattern(dense, (len(self._b) + extra, size))

    def multipliers(self, z: Array, constraint: Any) -> Array:
        """Return the multipliers of one of the constraints, from those of the cones."""
        raw = SimpleNamespace(status="Solved", solve_time=0.0, iterations=0, obj_val=0.0, z=z, x=np.zeros(self._size))
        return np.ravel(self._chain.invert(raw, self._inverse).dual_vars[constraint.id])


@lru_cache
def _settings(attempt: int) -> Any:
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = SOUGHT
    settings.reduced_tol_gap_abs = settings.reduced_tol_gap_rel = settings.reduced_tol_feas = ACCEPTED
    for name, value in ATTEMPTS[attempt].items():
        setattr(settings, name, value)
    return settings


class _Affine:
    """Objective 1/2 x'(P + weight dP) x + (q + weight dq)'x, when some x are T u + c and the others stay."""

    def __init__(self, P: Any, dP: Any, q: Array, dq: Array, own: np.ndarray, rest: np.ndarray):
        both = abs(P) + abs(dP)  # where numbers may stand
        cross = sparse.coo_array(both[own][:, rest])
        self._crossed = np.unique(cross.col)
        upper = sparse.coo_array(sparse.triu(both[rest][:, rest]))
        self._upper = upper.row, upper.col
        self._parts = [
            (
                M[own][:, own],
                M[own][:, rest],
                M[own][:, rest[self._crossed]],
                np.asarray(sparse.csr_array(M[rest][:, rest])[self._upper]).ravel() if len(upper.row) else np.empty(0),
                v[own],
                v[rest],
            )
            for M, v in ((sparse.csr_array(P), q), (sparse.csr_array(dP), dq))
        ]

    def places(self, n: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return rows and columns of the numbers that `at` returns, for n unknowns u."""
        k = len(self._crossed)
        cross = np.repeat(np.arange(n), k), n + np.tile(self._crossed, n)
        return [np.triu_indices(n), cross, (n + self._upper[0], n + self._upper[1])]

    def at(self, T: Array, c: Array, weight: float, identity: float) -> tuple[list[Array], Array]:
        """Return the numbers of P and q, with identity |u|^2 added."""
        n = T.shape[1]
        own, rest, crossed, upper, q_own, q_rest = (
            a + weight * b if weight else a for a, b in zip(*self._parts, strict=True)
        )
        dense = T.T @ (own @ T) + 2 * identity * np.eye(n)
        q = np.concatenate([T.T @ (q_own + own @ c), q_rest + rest.T @ c])
        return [dense[np.triu_indices(n)], np.asarray(T.T @ crossed).ravel(), upper], q


class _Pattern:
    """A sparse matrix whose numbers change and whose places do not, zeros among them."""

    def __init__(self, places: Sequence[tuple[Any, Any]], shape: tuple[int, int]):
        rows, columns = (np.concatenate([part[k] for part in places]) for k in range(2))
        self._order = np.lexsort((rows, columns))
        ends = np.searchsorted(columns[self._order], np.arange(shape[1] + 1))
        self._empty = sparse.csc_matrix((np.zeros(len(rows)), rows[self._order], ends), shape=shape)

    def filled(self, values: Sequence[Array]) -> Any:
        """Return the matrix with these numbers, in the order of the places."""
        matrix = self._empty.copy()
        matrix.data = np.concatenate(values)[self._order]
        return matrix


class Term:
    """A convex function as CVXPY states it, evaluated at numbers."""

    def __init__(self, function: Callable[[Any], Any], size: int):
        self._variable = cp.Variable(size)
        self._expression = function(self._variable)
        self._lock = threading.Lock()  # a variable has one value at a time

    def __call__(self, value: Array) -> float:
        """Return the function's value."""
        with self._lock:
            self._variable.value = value
            return float(self._expression.value)

    def slope(self, value: Array) -> Array | None:
        """Return the gradient, None where CVXPY knows none."""
        with self._lock:
            self._variable.value = value
            found = self._expression.grad[self._variable]
        return None if found is None else np.asarray(found.todense()).ravel()
