"""Canonical forms: CVXPY's program as the data of a cone program, or those of a box, written down without CVXPY."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.structure import Quadratic

SOUGHT, ACCEPTED = 1e-10, 1e-8
"""Clarabel's tolerances: what it goes on to while it makes progress, and what is good enough."""
SOLVED = ("Solved", "AlmostSolved")
ATTEMPTS: tuple[dict[str, Any], ...] = (
    {},
    {"static_regularization_constant": 1e-10},
    {"equilibrate_enable": True},
    {"static_regularization_constant": 1e-7},
)
"""Settings that are tried in turn: where one factorization stalls, another does not."""
CURVED = 1e-14
"""Eigenvalues of P below this part of the largest are rounding."""


class Canonical:
    """minimize 1/2 x'P x + q'x + offset subject to b - A x in K, where ``x[at]`` is the variable of the functions.

    Rows of a cone and columns that CVXPY added are scaled to unit size, because a solver's tolerances are absolute and
    constraints may be stated in metres.

    Parameters
    ----------
    objective
        Convex scalar expression of CVXPY.
    constraints
        Of the variable, and of variables of the functions' own.
    variable
        Whose numbers are sought.
    """

    def __init__(self, objective: Any, constraints: Sequence[Any], variable: Any):
        import cvxpy as cp
        from cvxpy.reductions.solvers.conic_solvers.clarabel_conif import dims_to_solver_cones
        from scipy import sparse

        every = [objective, *constraints]
        stated = {v.id: v for e in every for v in e.variables()}
        for v in stated.values():  # atoms ask for the value of what they are made of, and may get a stale one
            v.save_value(None)
        anchor = [] if variable.id in stated else [variable == cp.Variable(variable.shape)]
        problem = cp.Problem(cp.Minimize(objective), [*constraints, *anchor])
        self._chain: Any
        data, self._chain, self._inverse = problem.get_problem_data(cp.CLARABEL, solver_opts={})
        self.size = len(data["c"])
        self.at = data["param_prob"].var_id_to_col[variable.id] + np.arange(variable.size)
        dims = data["dims"]
        self.cones = dims_to_solver_cones(dims)
        self.zero = int(dims.zero)
        self.linear = int(dims.zero + dims.nonneg)
        self.offset = float(self._inverse[-1].get("offset", 0.0)) if isinstance(self._inverse[-1], dict) else 0.0
        A = sparse.coo_array(data["A"])
        self.cone_sizes = _cone_sizes(dims, len(data["b"]))
        self.row_scale, self.column_scale = _scales(A, len(data["b"]), self.size, self.at, self.linear, self.cone_sizes)
        self.A: Any = sparse.csr_array(
            (A.data * self.row_scale[A.row] * self.column_scale[A.col], (A.row, A.col)), A.shape
        )
        self.b = data["b"] * self.row_scale
        free = np.isposinf(self.b)  # a bound that is none
        if free.any():
            self.A = sparse.csr_array(sparse.diags_array(np.where(free, 0.0, 1.0)) @ self.A)
            self.b = np.where(free, 1.0, self.b)
        self.q = data["c"] * self.column_scale
        P = data.get("P")
        P = sparse.coo_array((self.size, self.size)) if P is None else sparse.coo_array(P)
        values = P.data * self.column_scale[P.row] * self.column_scale[P.col]
        self.P: Any = sparse.csc_array((values, (P.row, P.col)), P.shape)

    @classmethod
    def box(cls, n: int, penalty: Quadratic | None, bounds: Sequence[tuple[Array, Array]]) -> Canonical:
        """Return a quadratic penalty |L z - c|^2 + constant and boxes lower <= z <= upper, each (n,)."""
        made = cls.__new__(cls)
        made.size, made.at = n, np.arange(n)
        eye = np.eye(n)
        fixed = [eye[low == high] for low, high in bounds]
        values = [low[low == high] for low, high in bounds]
        below = [-eye[np.isfinite(low) & (low < high)] for low, high in bounds]
        above = [eye[np.isfinite(high) & (low < high)] for low, high in bounds]
        limits = [
            side
            for low, high in bounds
            for side in (-low[np.isfinite(low) & (low < high)], high[np.isfinite(high) & (low < high)])
        ]
        inequalities = [side for pair in zip(below, above, strict=True) for side in pair]
        made.A = np.vstack([np.zeros((0, n)), *fixed, *inequalities])
        made.b = np.concatenate([np.zeros(0), *values, *limits])
        made.zero, made.linear = sum(map(len, fixed)), len(made.b)
        made.row_scale, made.column_scale = np.ones(len(made.b)), np.ones(n)
        made.P, made.q, made.offset = np.zeros((n, n)), np.zeros(n), 0.0
        if penalty is not None:
            L = penalty.matrix
            made.P = 2 * L.T @ L
            made.q = -2 * L.T @ penalty.c
            made.offset = float(penalty.c @ penalty.c) + penalty.constant
            made.root = np.sqrt(2) * L
        made.cones = None
        made.cone_sizes = []
        return made

    @cached_property
    def polyhedral(self) -> bool:
        """Whether all constraints are equations and inequalities."""
        return self.linear == len(self.b)

    @property
    def entries(self) -> int:
        """Number of entries of A as a dense matrix."""
        return len(self.b) * self.size

    @cached_property
    def dense(self) -> tuple[Array, Array]:
        """A and P as dense matrices."""
        if isinstance(self.A, np.ndarray):
            return self.A, self.P
        return self.A.toarray(), self.P.toarray()

    @cached_property
    def root(self) -> Array:
        """A matrix (p, N) with root'root = P."""
        values, vectors = np.linalg.eigh(self.dense[1])
        curved = values > CURVED * max(values[-1], 0.0)
        if not values[-1] > 0:
            return np.zeros((0, self.size))
        return (np.sqrt(np.where(curved, values, 0.0)) * vectors).T[curved]

    @cached_property
    def linear_cones(self) -> list[Any]:
        """The cones as Clarabel has them."""
        clarabel = import_module("clarabel")

        if self.cones is not None:
            return list(self.cones)
        cones: list[Any] = []
        if self.zero:
            cones.append(clarabel.ZeroConeT(self.zero))
        if self.linear > self.zero:
            cones.append(clarabel.NonnegativeConeT(self.linear - self.zero))
        return cones

    def value(self, x: Array) -> float:
        """Return the objective at x (N,)."""
        return float(0.5 * x @ (self.P @ x) + self.q @ x) + self.offset

    def at_best(self, fixed: Array) -> tuple[float, Array]:
        """Return the least objective at a fixed variable, and x (N,); infinite where there is none."""
        from scipy import sparse

        clarabel = import_module("clarabel")

        rest = np.setdiff1d(np.arange(self.size), self.at)
        x = np.zeros(self.size)
        x[self.at] = fixed
        if not len(rest):
            return self.value(x), x
        P = sparse.csc_matrix(sparse.triu(sparse.csc_array(self.P)[rest][:, rest]))
        q = self.q[rest] + (sparse.csr_array(self.P) @ x)[rest]
        A = sparse.csc_matrix(sparse.csc_array(self.A)[:, rest])
        bound = self.b - self.A @ x
        for settings in ATTEMPTS:
            found = clarabel.DefaultSolver(P, q, A, bound, self.linear_cones, clarabel_settings(settings)).solve()
            if str(found.status) in SOLVED:
                x[rest] = found.x
                return self.value(x), x
        return float("inf"), x

    def duals(self, x: Array, z: Array) -> dict[int, Array]:
        """Return the multipliers of the stated constraints by their id, from those of all rows (m,)."""
        return self._inverted(x, z).dual_vars

    def values(self, x: Array, z: Array) -> dict[int, Array]:
        """Return the values of all stated variables by their id."""
        return self._inverted(x, z).primal_vars

    def _inverted(self, x: Array, z: Array) -> Any:
        raw = SimpleNamespace(
            status="Solved",
            solve_time=0.0,
            iterations=0,
            obj_val=0.0,
            x=x * self.column_scale,
            z=z * self.row_scale,
        )
        return self._chain.invert(raw, self._inverse)

    def part(self, kept: np.ndarray, owner: np.ndarray) -> Canonical:
        """Return the form of some entries of the variable; ``owner`` (m,) is the entry of every inequality, or -1.

        Other entries' inequalities and columns are left out.
        """
        made = object.__new__(Canonical)
        rows = np.flatnonzero((owner < 0) | np.isin(owner, kept))
        out = np.setdiff1d(np.arange(len(self.at)), kept)
        columns = np.setdiff1d(np.arange(self.size), self.at[out])
        made.A, made.b, made.q = self.A[rows][:, columns], self.b[rows], self.q[columns]
        made.P, made.offset, made.zero, made.size = self.P[columns][:, columns], self.offset, self.zero, len(columns)
        inequalities = int(((rows >= self.zero) & (rows < self.linear)).sum())
        made.linear = self.zero + inequalities
        clarabel = import_module("clarabel")

        made.cones = [clarabel.NonnegativeConeT(inequalities) if "Nonneg" in str(cone) else cone for cone in self.cones]
        made.at = np.searchsorted(columns, self.at[kept])
        return made


def _cone_sizes(dims: Any, m: int) -> list[int]:
    """Return the numbers of rows of the cones behind equations and inequalities."""
    sizes = [int(k) for k in dims.soc] + [int(k) * (int(k) + 1) // 2 for k in dims.psd]
    rest = m - int(dims.zero + dims.nonneg) - sum(sizes)
    if rest % 3 == 0:  # exponential and power cones
        return sizes + [3] * (rest // 3)
    return [*sizes, rest]


def _scales(A: Any, m: int, n: int, at: np.ndarray, linear: int, cones: list[int]) -> tuple[Array, Array]:
    """Return factors of the rows (m,), one a cone, and of the columns (n,), one for those of the variable."""
    own = np.isin(A.col, at)
    size = np.zeros(m)
    np.maximum.at(size, A.row[own], np.abs(A.data[own]))
    ratio = size[A.row] / np.abs(np.where(A.data == 0, 1.0, A.data))
    column = np.zeros(n)
    np.maximum.at(column, A.col, np.where(A.data == 0, 0.0, ratio))
    column[at] = 1.0
    column[column == 0] = 1.0
    size = np.zeros(m)
    np.maximum.at(size, A.row, np.abs(A.data) * column[A.col])
    sizes = [1] * linear + cones
    begin = np.cumsum([0, *sizes])[:-1]
    largest = np.maximum.reduceat(size, begin) if m else size
    size = np.repeat(largest, sizes) if m else size
    return np.divide(1.0, size, out=np.ones(m), where=size > 0), column


def clarabel_settings(other: dict[str, Any]) -> Any:
    """Return Clarabel's settings, some of them other ones."""
    clarabel = import_module("clarabel")

    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_threads = False, 1
    settings.presolve_enable = settings.chordal_decomposition_enable = False
    settings.equilibrate_enable = False  # rows and columns are scaled already: a quarter fewer iterations
    settings.input_sparse_dropzeros = False
    tolerance = ACCEPTED if other else SOUGHT
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    settings.reduced_tol_gap_abs = settings.reduced_tol_gap_rel = settings.reduced_tol_feas = ACCEPTED
    for name, value in other.items():
        setattr(settings, name, value)
    return settings
