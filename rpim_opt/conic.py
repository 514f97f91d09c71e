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
        self._P, self._q, self._dP, self._dq = first["P"], first["c"], 0.0 * first["P"], 0.0 * first["c"]
        if weight is not None:
            second = self._data(weight, 2.0)[0]
            self._dP, self._dq = second["P"] - first["P"], second["c"] - first["c"]
            self._P, self._q = first["P"] - self._dP, first["c"] - self._dq
        place = first["param_prob"].var_id_to_col
        rows, own, start = [], [], 0
        for variable in variables:
            if variable.id in place:
                rows.append(np.arange(start, start + variable.size))
                own.append(place[variable.id] + np.arange(variable.size))
            start += variable.size
        self._rows = np.concatenate(rows) if rows else np.empty(0, dtype=int)
        own = np.concatenate(own) if own else np.empty(0, dtype=int)
        rest = np.setdiff1d(np.arange(len(self._q)), own)
        self._own, self._rest, self._b = own, rest, first["b"]
        self._cones = dims_to_solver_cones(first["dims"])
        A = sparse.csr_array(first["A"])
        self._A_own, self._A_rest = A[:, own], sparse.coo_array(A[:, rest])
        self._touched = np.flatnonzero(np.diff(self._A_own.indptr))
        self._A_touched = self._A_own[self._touched]

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
        n = T.shape[1]
        T, c = T[self._rows], c[self._rows]
        P, q = self._P + weight * self._dP, self._q + weight * self._dq
        Poo, Por = P[self._own][:, self._own], P[self._own][:, self._rest]
        Prr = sparse.coo_array(sparse.triu(P[self._rest][:, self._rest]))
        Puu = T.T @ (Poo @ T) + 2 * identity * np.eye(n)
        upper = np.triu_indices(n)
        cross = sparse.coo_array(T.T @ Por) if Por.nnz else sparse.coo_array((n, len(self._rest)))
        size = n + len(self._rest)
        P_new = _csc(
            [
                (upper[0], upper[1], Puu[upper]),
                (cross.row, n + cross.col, cross.data),
                (n + Prr.row, n + Prr.col, Prr.data),
            ],
            (size, size),
        )
        q_new = np.concatenate([T.T @ (q[self._own] + Poo @ c), q[self._rest] + Por.T @ c])
        dense = self._A_touched @ T
        parts = [
            (np.repeat(self._touched, n), np.tile(np.arange(n), len(self._touched)), dense.ravel()),
            (self._A_rest.row, n + self._A_rest.col, self._A_rest.data),
        ]
        b, cones, height = self._b - self._A_own @ c, list(self._cones), len(self._b)
        if box is not None:
            B, lower, top = box
            for sign, bound in ((1.0, top), (-1.0, -lower)):
                k = len(bound)
                parts.append((np.repeat(height + np.arange(k), n), np.tile(np.arange(n), k), sign * B.ravel()))
                b, height = np.concatenate([b, bound]), height + k
            cones.append(clarabel.NonnegativeConeT(2 * len(lower)))
        A_new = _csc(parts, (height, size))
        status, solution = "", SimpleNamespace(x=(), z=())
        for attempt in range(len(ATTEMPTS)):
            solution = clarabel.DefaultSolver(P_new, q_new, A_new, b, cones, _settings(attempt)).solve()
            status = STATUS.get(str(solution.status), str(solution.status))
            if status in (cp.OPTIMAL, cp.INFEASIBLE, cp.UNBOUNDED):
                break
        return status, np.array(solution.x[:n]), np.array(solution.z[: len(self._b)])

    def multipliers(self, z: Array, constraint: Any) -> Array:
        """Return the multipliers of one of the constraints, from those of the cones."""
        raw = SimpleNamespace(status="Solved", solve_time=0.0, iterations=0, obj_val=0.0, z=z, x=np.zeros(len(self._q)))
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


def _csc(parts: Sequence[tuple[Any, Any, Any]], shape: tuple[int, int]) -> Any:
    rows, columns, values = (np.concatenate([part[k] for part in parts]) for k in range(3))
    return sparse.csc_matrix((values, (rows, columns)), shape=shape)


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
