"""Cone programs: CVXPY's canonical form, and programs of n + 1 rows with it, by an active set or by Clarabel."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from importlib import import_module
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import scipy
from scipy.linalg import get_lapack_funcs, qr

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.constraints import box_sides
from rpim_opt.convex.expressions import cp
from rpim_opt.convex.quadratic import Quadratic
from rpim_opt.problem.linear import RANK_TOLERANCE

FEASIBLE = 1e-7
"""Largest violation of constraints by a solution, in scales; relative to its largest component if that exceeds 1."""
SOUGHT, ACCEPTED = 1e-10, 1e-8
"""Clarabel's tolerances: the one that it aims at while it makes progress, and the one that suffices."""
SOLVED = ("Solved", "AlmostSolved")
Attempt = tuple[tuple[str, Any], ...]
"""Settings of Clarabel by name that differ from the usual ones."""
ATTEMPTS: tuple[Attempt, ...] = (
    (),
    (("static_regularization_constant", 1e-10),),
    (("equilibrate_enable", True),),
    (("static_regularization_constant", 1e-7),),
    (("static_regularization_constant", 1e-7), ("equilibrate_enable", True)),  # unknowns of 1e4 prior scales
)
"""Settings that are tried in turn: one factorization may succeed where another stalls."""
EQUILIBRATED: Attempt = (
    ("equilibrate_enable", True),
    ("tol_gap_abs", SOUGHT),
    ("tol_gap_rel", SOUGHT),
    ("tol_feas", 0.1 * SOUGHT),  # relative to the largest residual, possibly an outlier's
)
"""Settings for the rows of a loss, which are not scaled before: a quarter fewer iterations."""
REFINED: Attempt = (
    ("static_regularization_constant", 1e-12),
    ("iterative_refinement_max_iter", 20),
    ("iterative_refinement_reltol", 1e-15),
    ("iterative_refinement_abstol", 1e-15),
    *((f"tol_{each}", 1e-12) for each in ("gap_abs", "gap_rel", "feas")),
    ("reduced_tol_feas", 1e-10),
)
"""Settings for changes of unit size about a minimum."""
LOOSE: Attempt = (
    ("equilibrate_enable", True),
    *((f"reduced_tol_{each}", 5e-8) for each in ("gap_abs", "gap_rel", "feas")),
)
"""Settings for a distance that may be zero, where progress stops early."""
CURVED = 1e-14
"""Eigenvalues of P below this part of the largest are rounding."""
DENSE = 4e5
"""Largest number of entries of the constraints' matrix for which active sets are tried."""
CENTRED = 1e-10
"""Least weight of |z|^2, relative to the squares, for the point from which Clarabel's unknowns count."""
FAR, REFINEMENTS = 1e3, 3
"""Size of a change from which a minimum is refined, and the largest number of refinements."""
LARGE = 1e-2
"""Part of the largest residual above which the objective is scaled down: without it, small residuals lose accuracy and
large ones cost iterations."""
DEAR = 1e6
"""Linear costs above this are scaled down if there is a loss."""
MOST_ACTIVE_SETS = 40
"""Number of active sets tried before Clarabel is asked for one."""


class Canonical:
    """minimize 1/2 x'P x + q'x + offset subject to b - A x in K, where ``x[at]`` is the variable of the functions.

    Rows of a cone and columns added by CVXPY are scaled to unit size: a solver's tolerances are absolute, while
    constraints may be stated in metres.
    """

    own = False  # whether the functions have own variables

    def __init__(self, objective: Any, constraints: Sequence[Any], variable: Any):
        from cvxpy.reductions.solvers.conic_solvers.clarabel_conif import dims_to_solver_cones

        every = [objective, *constraints]
        present = {v.id: v for e in every for v in e.variables()}
        self.own = len(present) - (variable.id in present) > 0
        for v in present.values():  # atoms read their arguments' values, which may be stale
            v.save_value(None)
        anchor = [] if variable.id in present else [variable == cp.Variable(variable.shape)]
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
        A = scipy.sparse.coo_array(data["A"])
        sizes = [int(k) for k in dims.soc] + [int(k) * (int(k) + 1) // 2 for k in dims.psd]
        rest = len(data["b"]) - self.linear - sum(sizes)
        self.second_order = len(dims.soc)
        self.cone_sizes = sizes + ([3] * (rest // 3) if rest % 3 == 0 else [rest])  # exponential and power cones
        self.row_scale, self.column_scale = _scales(A, len(data["b"]), self.size, self.at, self.linear, self.cone_sizes)
        free = np.isposinf(data["b"])  # infinite bounds
        self.row_scale[free] = 0.0
        self.b = np.where(free, 0.0, data["b"]) * self.row_scale + free
        self.q = data["c"] * self.column_scale
        rows, columns = (scipy.sparse.diags_array(scale) for scale in (self.row_scale, self.column_scale))
        P = data.get("P")
        self.A: Any = scipy.sparse.csr_array(rows @ A @ columns)
        self.P: Any = scipy.sparse.csc_array((self.size, self.size) if P is None else columns @ P @ columns)

    @classmethod
    def box(cls, penalty: Quadratic | None, lower: Array, upper: Array) -> Canonical:
        """Return a quadratic penalty |L z - c|^2 + constant and a box lower <= z <= upper, (n,), fixed ones first."""
        made = cls.__new__(cls)
        n = len(lower)
        made.size, made.at = n, np.arange(n)
        eye = np.eye(n)
        fixed, below, above = box_sides(lower, upper)
        made.A = np.vstack([eye[fixed], -eye[below], eye[above]])
        made.b = np.concatenate([lower[fixed], -lower[below], upper[above]])
        made.zero, made.linear = int(fixed.sum()), len(made.b)
        made.row_scale, made.column_scale = np.ones(len(made.b)), np.ones(n)
        made.P, made.q, made.offset = np.zeros((n, n)), np.zeros(n), 0.0
        if penalty is not None:
            L = penalty.matrix
            made.P = 2 * L.T @ L
            made.q = -2 * L.T @ penalty.c
            made.offset = float(penalty.c @ penalty.c) + penalty.constant
            made.root = np.sqrt(2) * L
        made.dense = made.A, made.P
        made.cones = None
        made.cone_sizes, made.second_order = [], 0
        return made

    @property
    def polyhedral(self) -> bool:
        """Whether an active set may solve it: few linear equations and inequalities, no variables of the functions."""
        return self.linear == len(self.b) and not self.own and len(self.b) * self.size <= DENSE

    @property
    def cone_rows(self) -> list[slice]:
        """The rows of each cone."""
        ends = np.cumsum([self.linear, *self.cone_sizes]).tolist()
        return [slice(begin, end) for begin, end in pairwise(ends)]

    @cached_property
    def dense(self) -> tuple[Array, Array]:
        """A and P as dense matrices."""
        return self.A.toarray(), self.P.toarray()

    @cached_property
    def root(self) -> Array:
        """A matrix (p, N) with root'root = P."""
        values, vectors = np.linalg.eigh(self.dense[1])
        curved = values > CURVED * max(values[-1], 0.0)
        return (np.sqrt(np.where(curved, values, 0.0)) * vectors).T[curved]

    @cached_property
    def clarabel_cones(self) -> list[Any]:
        """The cones in Clarabel's form."""
        if self.cones is not None:
            return list(self.cones)
        clarabel = import_module("clarabel")
        cones = [clarabel.ZeroConeT(self.zero), clarabel.NonnegativeConeT(self.linear - self.zero)]
        return [cone for cone, count in zip(cones, (self.zero, self.linear - self.zero), strict=True) if count]

    def value(self, x: Array) -> float:
        """Return the objective at x (N,)."""
        return float(0.5 * x @ (self.P @ x) + self.q @ x) + self.offset

    def changes(self, near: Array, M: Array, size: float) -> Canonical:
        """Return the form of changes y of a point (N,): x[at] = near[at] + size M y[at] with M (n, n).

        The other entries change by size y, and the rows are divided by ``size``.
        """
        turned = np.eye(self.size)
        turned[np.ix_(self.at, self.at)] = M
        T: Any = scipy.sparse.csr_array(turned)
        changed = copy(self)
        changed.A, changed.b = scipy.sparse.csr_array(self.A) @ T, (self.b - self.A @ near) / size
        changed.P = size**2 * (T.T @ scipy.sparse.csr_array(self.P) @ T)
        changed.q = size * (T.T @ (self.q + self.P @ near))
        return changed

    def missed(self, x: Array) -> float:
        """Return the violation of the stated equations, inequalities and second-order cones at x (N,)."""
        slack = np.divide(self.b - self.A @ x, self.row_scale, out=np.zeros(len(self.b)), where=self.row_scale > 0)
        worst = [np.abs(slack[: self.zero]).max(initial=0.0), -slack[self.zero : self.linear].min(initial=0.0)]
        for part in self.cone_rows[: self.second_order]:
            first, *others = slack[part]
            worst.append(np.linalg.norm(others) - first)
        return float(max(worst))

    def duals(self, x: Array, z: Array) -> dict[int, Array]:
        """Return the multipliers of the stated constraints by their id, from those of all rows (m,)."""
        raw = SimpleNamespace(status="Solved", solve_time=0.0, iterations=0, obj_val=0.0)
        raw.x, raw.z = x * self.column_scale, z * self.row_scale
        return self._chain.invert(raw, self._inverse).dual_vars


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


@cache
def _settings(attempt: Attempt) -> Any:
    """Return Clarabel's settings with some that are another attempt's."""
    settings = import_module("clarabel").DefaultSettings()  # a compiled module, without types
    settings.verbose, settings.max_threads = False, 1
    settings.presolve_enable = False
    settings.chordal_decomposition_merge_method = "parent_child"  # the default takes longer than solving
    settings.equilibrate_enable = False  # rows and columns are scaled before: a quarter fewer iterations
    if attempt in ((), EQUILIBRATED):  # the default, ten, takes half of the time; points are judged by true residuals
        settings.iterative_refinement_max_iter = 1
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = ACCEPTED if attempt else SOUGHT
    settings.reduced_tol_gap_abs = settings.reduced_tol_gap_rel = settings.reduced_tol_feas = ACCEPTED
    for name, value in attempt:
        setattr(settings, name, value)
    return settings


class Clarabel:
    """Clarabel for programs of one sparsity pattern: the solver is set up once and updated for the next program."""

    def __init__(self, cones: list[Any], attempts: Sequence[Attempt] = ATTEMPTS):
        self.cones, self.attempts = cones, attempts
        self.renew()

    def renew(self) -> None:
        """Discard the solver: the next program has another sparsity pattern."""
        self._solver: Any = None
        self._numbers: dict[str, Array] = {}

    def solve(self, P: Any, q: Array, A: Any, b: Array) -> Any:
        """Return the solution of minimize 1/2 x'P x + q'x subject to b - A x in cones; Unsolved where none is found.

        P (its upper triangle) and A are `csc_matrix` with the same sparsity pattern in every call.
        """
        solver = self._solver
        solution = SimpleNamespace(status="")
        numbers = {"P": P.data.copy(), "q": q, "A": A.data.copy(), "b": b}
        for k, attempt in enumerate(self.attempts):
            if k == 0 and solver is not None:
                changed = {key: v for key, v in numbers.items() if not np.array_equal(v, self._numbers[key])}
                if changed:  # Clarabel panics at an empty update
                    solver.update(**changed)
            else:
                solver = self._made(P, q, A, b, attempt)
            if k == 0 and solver.is_data_update_allowed():
                self._solver, self._numbers = solver, numbers
            solution = solver.solve()
            if str(solution.status) in SOLVED:
                return solution
        raise Unsolved(str(solution.status))

    def _made(self, P: Any, q: Array, A: Any, b: Array, attempt: Attempt) -> Any:
        """Return a solver, set up without costs: those of one weight would scale those of all that follow."""
        make = import_module("clarabel").DefaultSolver
        solver = make(P, np.zeros_like(q), A, b, self.cones, _settings(attempt))
        if not solver.is_data_update_allowed():  # it decomposes a matrix
            return make(P, q, A, b, self.cones, _settings(attempt))
        solver.update(q=q)
        return solver


class Unsolved(RuntimeError):
    """A program that the solver does not solve; its argument is the solver's status."""


class Damping(NamedTuple):
    """|F (z - centre)|^2, added to the objective: the term of Levenberg and Marquardt. F (k, n), centre (n,)."""

    centre: Array
    F: Array

    def value(self, z: Array) -> float:
        """Return the term at z (n,)."""
        return float(np.sum((self.F @ (z - self.centre)) ** 2))

    def along(self, z: Array, d: Array) -> tuple[float, float]:
        """Return first and second derivative of the term at z (n,) along a step d (n,)."""
        step = self.F @ d
        return float(2 * step @ (self.F @ (z - self.centre))), float(2 * step @ step)


@dataclass(frozen=True, eq=False)
class ReducedSquares:
    """|R z - y|^2 + g'z with R (n + 1, n), y (n + 1,), g (n,); R'R is never formed, whose condition is squared."""

    R: Array
    y: Array
    g: Array

    @classmethod
    def of_factor(cls, T: Array) -> ReducedSquares:
        """Return the squares of a QR factor (n + 1, n + 1) of [A b]."""
        return cls(T[:, :-1], T[:, -1], np.zeros(len(T) - 1))

    def damped(self, damping: Damping | None) -> ReducedSquares:
        """Return the squares with damping added."""
        if damping is None:
            return self
        rows = np.column_stack([damping.F, damping.F @ damping.centre])
        T: Any = np.linalg.qr(np.vstack([np.column_stack([self.R, self.y]), rows]), mode="r")
        missing = np.zeros((T.shape[1] - len(T), T.shape[1]))
        return replace(ReducedSquares.of_factor(np.vstack([T, missing])), g=self.g)


@dataclass(frozen=True, eq=False)
class Point:
    """A minimum x (N,) of the canonical form, multipliers of its rows (m,), and of Clarabel's minima their slacks."""

    x: Array
    dual: Array
    iterations: int = 0
    slack: Array = field(default_factory=lambda: np.zeros(0))


class ReducedProgram:
    """minimize |R z - y|^2 + g'z + loss(A z - b) + weight * penalty(z) subject to constraints(z).

    R has ``rows`` rows; ``loss`` is the canonical form for rows without a quadratic model, ``counts`` (N,) the numbers
    of equations of the configurations whose norms it gets.
    """

    def __init__(
        self, canonical: Canonical, rows: int, loss: Canonical | None = None, counts: np.ndarray | None = None
    ):
        self.canonical, self.rows, self.loss, self.counts = canonical, rows, loss, counts
        self.working = np.zeros(0, dtype=int)
        self.near = np.zeros(canonical.size)

    def solve(self, squares: ReducedSquares, weight: float, A: Array | None = None, b: Array | None = None) -> Point:
        """Return the minimum; A (k, n) and b (k,) are the rows of the loss. Unsolved where none is found."""
        p = self.canonical
        if self.loss is not None or not p.polyhedral:
            return self._by_cones(squares, weight, A, b)
        exact = self._by_active_set(squares, weight, self.working, self.near)
        if exact is not None:
            return exact
        point = self._by_cones(squares, weight, A, b)
        active = np.arange(p.zero, p.linear)
        working = active[(point.dual > point.slack)[active]]
        exact = self._by_active_set(squares, weight, working, point.x)
        return point if exact is None else replace(exact, iterations=point.iterations)

    # --- active set --------------------------------------------------------------------------------------------------

    def _by_active_set(self, squares: ReducedSquares, weight: float, working: np.ndarray, near: Array) -> Point | None:
        """Return the minimum by a primal-dual active set; None if a set has no minimum, or too many are tried.

        All rows with a wrong sign change at once; when a set recurs, only the first of them, which cannot cycle if the
        multipliers are unique (Murty, Opsearch 11, 1974).
        """
        p = self.canonical
        A, b = p.dense[0][p.zero : p.linear], p.b[p.zero : p.linear]
        seen: set[bytes] = set()
        cycles = False
        for _ in range(MOST_ACTIVE_SETS):
            cycles |= working.tobytes() in seen
            seen.add(working.tobytes())
            active = np.concatenate([np.arange(p.zero), working])
            solution = on_working_set(squares, weight, p, active, near)
            if solution is None:
                return None
            x, multipliers = solution
            slack, dual = b - A @ x, np.zeros(len(b))
            dual[working - p.zero] = multipliers[p.zero :]
            rounding = 1e-9 * max(weight * np.abs(p.q).max(initial=0.0), np.abs(dual).max(initial=0.0))
            holds = slack >= -1e-11 * (1 + np.abs(b))
            if holds.all() and (dual >= -rounding).all():
                self.working, self.near = working, x
                every = np.zeros(len(p.b))
                every[active] = multipliers
                return Point(x, every)
            tight = np.zeros(len(b), dtype=bool)
            tight[working - p.zero] = True
            changed = np.flatnonzero(tight != np.where(tight, (dual > 0) | ~holds, slack < 0))
            tight[changed[: 1 if cycles else None]] ^= True
            working = p.zero + np.flatnonzero(tight)
        return None

    # --- Clarabel ----------------------------------------------------------------------------------------------------

    @cached_property
    def data(self) -> _ConicData:
        """Clarabel's data and solver."""
        return _ConicData(self.canonical, self.rows, self.loss, self.counts)

    def _by_cones(self, squares: ReducedSquares, weight: float, A: Array | None, b: Array | None) -> Point:
        """Return Clarabel's minimum.

        Its tolerances are relative to the unknowns, changes from the last point or from the minimum of the squares with
        a small weight on |z|^2. A minimum that is far from there, or violates constraints, is refined.
        """
        p, n = self.canonical, len(self.canonical.at)
        near = np.zeros(p.size)
        near[p.at] = self.near[p.at]
        if self.rows and not near.any():
            rows = np.vstack([squares.R, np.sqrt(weight + CENTRED * np.sum(squares.R**2)) * np.eye(n)])
            near[p.at] = np.linalg.lstsq(rows, np.concatenate([squares.y, np.zeros(n)]), rcond=None)[0]
        far = np.abs(near).max() > FAR
        found = self._nearby(near, FEASIBLE, squares, weight, A, b) if far else None
        if found is None:
            found = self._about(near, squares, weight, A, b)
            missed = p.missed(found.x)
            if missed > ACCEPTED or np.abs(found.x).max() > FAR:
                found = self._nearby(found.x, max(FEASIBLE, missed), squares, weight, A, b) or found
        self.near = found.x
        return found

    def _nearby(
        self, near: Array, missed: float, squares: ReducedSquares, weight: float, A: Array | None, b: Array | None
    ) -> Point | None:
        """Return the minimum refined from a point (N,); None where it misses constraints by more, or is not solved."""
        for _ in range(REFINEMENTS):
            try:
                point = self._refined(near, squares, weight, A, b)
            except Unsolved:
                return None
            near = point.x
            if self.canonical.missed(near) <= max(missed, SOUGHT * np.abs(near).max()):
                return point
        return None

    def _refined(self, near: Array, squares: ReducedSquares, weight: float, A: Array | None, b: Array | None) -> Point:
        """Return the minimum near ``near`` (N,), in changes of unit size: z = z0 + V min(1 / s, far) y, others far y.

        s and V are singular values and right singular vectors of all equations, far is the size of the point. With
        small weights z has components of 10^5 scales and of 10^-4, and costs are below a solver's tolerances.
        """
        p = self.canonical
        z0, every, far = near[p.at], squares.R, np.abs(near).max()
        if A is not None:
            every = np.vstack([every, A])
        _, s, V = np.linalg.svd(np.linalg.qr(every, mode="r"))
        M = V.T / np.maximum(np.pad(s, (0, len(z0) - len(s))), 1 / far)
        program = ReducedProgram(p.changes(near, M / far, far), self.rows, self.loss, self.counts)
        program.data.clarabel.attempts = [(*REFINED, *other) for other in ATTEMPTS]
        squares = ReducedSquares(squares.R @ M, squares.y - squares.R @ z0, M.T @ squares.g)
        if A is not None and b is not None:
            A, b = A @ M, b - A @ z0
        point = program._about(np.zeros(p.size), squares, weight, A, b)
        x = far * point.x
        x[p.at] = M @ point.x[p.at]
        return replace(point, x=near + x, dual=point.dual / far, slack=far * point.slack)

    def _about(self, near: Array, squares: ReducedSquares, weight: float, A: Array | None, b: Array | None) -> Point:
        """Return Clarabel's minimum; the unknowns are changes of ``near`` (N,)."""
        data, p, k = self.data, self.canonical, self.rows
        z0 = near[p.at]
        residual = squares.y - squares.R @ z0
        q = [weight * (p.q + p.P @ near), np.zeros(k)]
        q[0][p.at] += squares.g
        bounds, dense = [residual, p.b - p.A @ near], [squares.R.ravel(), data.own]
        if self.loss is not None and A is not None and b is not None:
            q.append(self.loss.q)
            bounds.append(data.linked(A @ z0 - b))
            dense.append(-A.ravel())
        cost = np.concatenate(q)
        # tolerances are absolute below one; a loss, which is not smaller, takes fewer iterations unscaled
        largest = max(np.abs(cost).max(), 1e-3 * weight, LARGE * np.abs(residual).max(initial=0.0))
        scale = 1.0 / max(1.0, largest if self.loss is None else largest / DEAR)
        P, matrix = data.filled(weight, np.concatenate(dense))
        P.data *= scale
        solution = data.clarabel.solve(P, cost * scale, matrix, np.concatenate(bounds))
        x, z, s = np.array(solution.x), np.array(solution.z) / scale, np.array(solution.s)
        x[: p.size] += near
        own = slice(k, k + len(p.b))
        return Point(x[: p.size], z[own], int(solution.iterations), s[own])


class _ConicData:
    """Clarabel's data of a small program; the unknowns are those of the penalty, s = R z - y, and those of the loss.

    Rows: R z - s = y, those of the penalty, those of the loss, and the loss's argument: v = A z - b, or for norms one
    second-order cone each, (v_k, A_k z - b_k).
    """

    def __init__(self, p: Canonical, k: int, loss: Canonical | None, counts: np.ndarray | None):
        clarabel = import_module("clarabel")
        cones = [*([clarabel.ZeroConeT(k)] if k else []), *p.clarabel_cones]
        top, size = k + len(p.b), p.size + k
        squares = np.arange(k)
        # entries (rows, columns, numbers): those whose numbers differ between programs, and the rest
        dense = [_block(squares, p.at), _entries(p.A, k, 0)]
        entries = [(squares, p.size + squares, -np.ones(k))]
        curvature = [_entries(p.P, 0, 0, upper=True), (p.size + squares, p.size + squares, np.full(k, 2.0))]
        if loss is not None:
            cones += loss.clarabel_cones
            entries += [_entries(loss.A, top, size)]
            curvature += [_entries(loss.P, size, size, upper=True)]
            begin = top + len(loss.b)
            if counts is None:
                links = begin + np.arange(len(loss.at))
                cones += [clarabel.ZeroConeT(len(links))]
                entries += [(links, size + loss.at, np.ones(len(links)))]
            else:
                first = begin + np.cumsum(counts + 1) - counts - 1
                links = np.setdiff1d(np.arange(begin, begin + int(np.sum(counts + 1))), first)
                cones += [clarabel.SecondOrderConeT(int(count) + 1) for count in counts]
                entries += [(first, size + loss.at, -np.ones(len(first)))]
            dense += [_block(links, p.at)]
            self._links = links - top
            self._bounds = np.pad(loss.b, (0, int(links[-1]) + 1 - begin))
            top += len(self._bounds)
            size += loss.size
        self._dense, self._entries, self._shape = dense, entries, (top, size)
        self._nonzero = np.zeros(sum(len(rows) for rows, _, _ in dense), dtype=bool)
        self.matrix: Any = None
        self.P, place = _assembled(curvature, (size, size))
        self._curvature = self.P.data.copy()
        self.own, self._weighted = dense[1][2], place[: len(curvature[0][0])]
        # the user scales a loss
        self.clarabel = Clarabel(cones, ATTEMPTS if loss is None else (EQUILIBRATED, *ATTEMPTS))

    def linked(self, r: Array) -> Array:
        """Return the bounds of the loss's rows, for a residual r (m,) of the equations."""
        bounds = self._bounds.copy()
        bounds[self._links] = r
        return bounds

    def filled(self, weight: float, numbers: Array) -> tuple[Any, Any]:
        """Return P at a weight, and the matrix with the numbers of R (k, n), `own`, and the loss's rows, row by row."""
        if self.matrix is None or numbers[~self._nonzero].any():  # zeros cost as much as other numbers
            self._nonzero |= numbers != 0
            rows, columns, ones = (np.concatenate(each)[self._nonzero] for each in zip(*self._dense, strict=True))
            self.matrix, place = _assembled([(rows, columns, ones), *self._entries], self._shape)
            self._numbers = place[: len(rows)]
            self.clarabel.renew()
        self.matrix.data[self._numbers] = numbers[self._nonzero]
        self.P.data = self._curvature.copy()
        self.P.data[self._weighted] *= weight
        return self.P, self.matrix


Entries = tuple[np.ndarray, np.ndarray, Array]
"""Rows, columns and numbers of a sparse matrix."""


def _block(rows: np.ndarray, columns: np.ndarray) -> Entries:
    """Return the places of a dense block, row by row."""
    return np.repeat(rows, len(columns)), np.tile(columns, len(rows)), np.ones(len(rows) * len(columns))


def _entries(M: Any, row: int, column: int, upper: bool = False) -> Entries:
    """Return those of a matrix, or of its upper triangle, from a row and column on."""
    M = scipy.sparse.coo_array(M)
    keep = M.row <= M.col if upper else slice(None)
    return M.row[keep] + row, M.col[keep] + column, M.data[keep]


def _assembled(entries: list[Entries], shape: tuple[int, int]) -> tuple[Any, np.ndarray]:
    """Return a `csc_matrix` of entries at different places, and where in its data each of them is."""
    rows, columns, numbers = (np.concatenate(each) for each in zip(*entries, strict=True))
    order = np.lexsort((rows, columns))
    starts = np.concatenate([[0], np.cumsum(np.bincount(columns, minlength=shape[1]))])
    return scipy.sparse.csc_matrix((numbers[order], rows[order], starts), shape), np.argsort(order)


def nearest(p: Canonical, z: Array) -> Array:
    """Return the point (n,) of a form's constraints that is nearest to z (n,); Unsolved where Clarabel finds none."""
    n, N = len(z), p.size
    link = scipy.sparse.coo_array((-np.ones(n + 1), (np.arange(n + 1), np.append(N, p.at))), (n + 1, N + 1))
    stated = scipy.sparse.hstack([scipy.sparse.coo_array(p.A), scipy.sparse.coo_array((len(p.b), 1))])
    A = scipy.sparse.csc_matrix(scipy.sparse.vstack([stated, link]))
    bound = np.concatenate([p.b, [0.0], -z])  # (t, x - z) in a second-order cone; minimize t
    cone = import_module("clarabel").SecondOrderConeT(n + 1)
    flat = scipy.sparse.csc_matrix((N + 1, N + 1))
    clarabel = Clarabel([*p.clarabel_cones, cone], (*ATTEMPTS, LOOSE))
    solution = clarabel.solve(flat, np.append(np.zeros(N), 1.0), A, bound)
    return np.array(solution.x)[p.at]


TRTRS: Any = get_lapack_funcs("trtrs", dtype=float)


def triangular_solution(T: Array, b: Array, transposed: bool = False) -> Array:
    """Return T^-1 b, or T'^-1 b, of an upper triangular T: SciPy's `solve_triangular` takes five times as long."""
    return TRTRS(T, b, trans=int(transposed))[0]


def on_working_set(
    squares: ReducedSquares, weight: float, p: Canonical, active: np.ndarray, near: Array
) -> tuple[Array, Array] | None:
    """Return the minimum (N,) near ``near`` with the active rows as equations A x = b, and their multipliers, or None.

    The method is the null space of the active rows, with corrected seminormal equations.
    """
    A, b = p.dense[0][active], p.b[active]
    P, root = p.dense[1], p.root
    at, N = p.at, p.size

    def gradient(x: Array) -> Array:
        slope = weight * (P @ x + p.q)
        slope[at] += 2 * squares.R.T @ (squares.R @ x[at] - squares.y) + squares.g
        return slope

    Y, Z, T = np.zeros((N, 0)), np.eye(N), np.zeros((0, 0))
    order, rank = np.zeros(0, dtype=int), 0
    x = near.copy()
    if len(b):
        factors: Any = qr(A.T, pivoting=True, check_finite=False)
        Q, T, order = factors
        pivots = np.abs(np.diag(T))
        rank = int((pivots > 1e-11 * pivots.max(initial=0.0)).sum())
        Y, Z, T = Q[:, :rank], Q[:, rank:], T[:rank, :rank]
        x = near + Y @ triangular_solution(T, (b - A @ near)[order[:rank]], transposed=True)
    if Z.shape[1]:
        reduced = np.vstack([np.sqrt(2) * squares.R @ Z[at], np.sqrt(weight) * root @ Z])
        L: Any = np.linalg.qr(reduced, mode="r")
        pivots = np.abs(np.diag(L))
        if len(L) == Z.shape[1] and pivots.min() > RANK_TOLERANCE * pivots.max():
            for _ in range(3):
                x = x - Z @ triangular_solution(L, triangular_solution(L, Z.T @ gradient(x), transposed=True))
        else:  # directions without curvature: the minimum closest to x, unless there is a slope along them
            largest = np.abs(squares.R).max()
            _, values, V = np.linalg.svd(reduced, full_matrices=False)
            curved = values > RANK_TOLERANCE * max(values.max(initial=0.0), 1e-3 * largest)
            values, V, slope = values[curved], V[curved], Z.T @ gradient(x)
            for _ in range(3):
                x = x - Z @ (V.T @ (V @ slope / values**2))
                slope = Z.T @ gradient(x)
            rounding = 1e-14 * largest * max(np.abs(squares.R @ x[at]).max(), np.abs(squares.y).max())
            pull = 2 * squares.R.T @ squares.y - squares.g
            allowed = max(1e-9 * weight * np.abs(p.q).max(initial=0.0), 1e-14 * np.abs(pull).max(initial=0.0), rounding)
            if not np.abs(slope - V.T @ (V @ slope)).max(initial=0.0) <= allowed:
                return None
    multipliers = np.zeros(len(b))
    if rank:
        multipliers[order[:rank]] = triangular_solution(T, -Y.T @ gradient(x))
    return x, multipliers
