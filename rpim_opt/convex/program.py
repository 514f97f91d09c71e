"""The convex program of one linearization: its CVXPY problem, its values, and its solutions at any weight."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from scipy.linalg import get_lapack_funcs

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, NoSolutionFound
from rpim_opt.basics.text import Brief
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.convex.constraints import Box, box_sides
from rpim_opt.convex.expressions import OPTIMAL, cp, norms, substituted
from rpim_opt.convex.formulation import Formulation, formulation_of
from rpim_opt.convex.quadratic import Quadratic, Ridge, ridge
from rpim_opt.convex.robust_loss import Inliers, inliers_of
from rpim_opt.convex.solvers.conic import FEASIBLE, Damping, Point, Unsolved, nearest, triangular_solution
from rpim_opt.convex.solvers.separable import Rows
from rpim_opt.convex.solvers.solve import WarmStart, minimum
from rpim_opt.convex.structure import INVARIANT, TIGHT, Structure
from rpim_opt.problem.linear import RANK_TOLERANCE, LinearModel, reduced_rows

ACTIVE = 1e-7
"""A constraint is active if its multiplier is above this part of the largest one."""
TOUCHING = 1e-9
"""A component this close to a bound, in scales, is at the bound."""
SOFTEST = 1e-8
"""Least curvature, as part of the objective, assumed for smaller weights."""
WELL_CONDITIONED = 1e-6
"""Reciprocal condition number above which triangular factors are used for solving."""
PROXIMAL = 1e-2, 1e-4, 1e-6
"""Weights of the proximal term after the first one."""
STATUS = {
    "PrimalInfeasible": "infeasible",
    "AlmostPrimalInfeasible": "infeasible_inaccurate",
    "DualInfeasible": "unbounded",
    "AlmostDualInfeasible": "unbounded",
}
"""CVXPY's status for Clarabel's."""

TRCON: Any = get_lapack_funcs("trcon", dtype=float)


def feasibility_tolerance(z: Array) -> float:
    """Return the feasibility tolerance at z (n,), in units of the scales."""
    return FEASIBLE * max(1.0, float(np.max(np.abs(z), initial=0.0)))


@dataclass(frozen=True, eq=False, repr=False)
class Estimate(Brief):
    """A solution z (n,) at a weight, with loss and penalty, the coordinates of the L-curve.

    ``status`` is CVXPY's; ``iterations`` are zero for a closed form or an active-set method.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("paper_arm").problem
    >>> program = ro.convex.pose(ro.bounded, problem.linearize(np.zeros(len(problem.parameters.free))))
    >>> estimate = program.solve(1e-3)
    >>> estimate.status, estimate.objective == estimate.loss + 1e-3 * estimate.penalty, len(estimate.duals)
    ('optimal', True, 1)
    """

    z: Array
    weight: float
    loss: float
    penalty: float
    multipliers: Callable[[], tuple[Array, ...]] = tuple
    status: str = OPTIMAL
    iterations: int = 0

    def _short(self) -> str:
        return f"{self.status} at weight {self.weight:.4g}: loss {self.loss:.4g}, penalty {self.penalty:.4g}"

    @cached_property
    def duals(self) -> tuple[Array, ...]:
        """Multipliers of the formulation's constraints, one array each, (n,) for a `Box`.

        The rate at which the objective falls as the constraint is loosened, per unit of the scales.
        """
        return self.multipliers()

    @property
    def objective(self) -> float:
        """Loss and weighted penalty together."""
        return self.loss if self.weight == 0 else self.loss + self.weight * self.penalty


@dataclass(frozen=True, eq=False, repr=False)
class Program(Brief):
    """A formulation applied to a linear model A z ~ b, ready to be solved at any weight.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> program = ro.convex.pose(ro.lasso, problem.linearize(np.zeros(len(problem.parameters.free))))
    >>> estimate = program.solve(5.0)
    >>> written = program.problem(5.0)  # the same program, to print, change, or give to another solver
    >>> bool(abs(written.solve(solver="CLARABEL") / estimate.objective - 1) < 1e-6), written.is_dcp(dpp=True)
    (True, True)
    >>> [round(e.penalty, 1) for e in program.path([0.5, 5.0, 50.0])]
    [13.4, 12.5, 10.4]
    >>> there = program.on(problem.linearize(estimate.z * problem.parameters.free.scale))
    >>> round(estimate.loss), round(there.value(estimate.z)[0])  # promised, and what the nonlinear model keeps
    (97, 100)
    """

    formulation: Formulation
    model: LinearModel
    structure: Structure
    _warm: WarmStart  # shared with all programs that `on` makes of this one
    _values: dict[Any, tuple[float, float]] = field(default_factory=dict, init=False)  # of repeated points

    def __reduce__(self) -> Any:
        return pose, (self.formulation, self.model)  # CVXPY's canonical forms are not pickled

    def _short(self) -> str:
        return f"'{self.formulation.name}' on {self.model._short()}"

    def on(self, model: LinearModel) -> Program:
        """Return the program for another model of the same shape, without calling the functions again."""
        return Program(self.formulation, model, self.structure, self._warm)

    def on_squares(self, model: LinearModel) -> Program:
        """Return the same penalty and constraints with the squares of other equations as the loss."""
        return self._part(self.structure.on_squares, model)

    def _part(self, structure: Structure, model: LinearModel) -> Program:
        """Return the program of a part of the formulation, with warm starts of its own."""
        warm = self._warm.parts.setdefault(structure, WarmStart(structure))
        return Program(structure.formulation, model, structure, warm)

    def beginning(self, z: Array) -> Program:
        """Return the same program with z (n,) as the start of its next solution, unless that is a formula."""
        if not self.closed_form:
            self._warm.begin(z)
        return self

    # --- structure -----------------------------------------------------------------------------------------------

    @property
    def loss_form(self) -> Quadratic | None:
        """The loss as a quadratic form of the residual; None if it is not quadratic."""
        return self.structure.loss_form

    @property
    def penalty_form(self) -> Quadratic | None:
        """The quadratic |L z - c|^2 that the penalty is; None if it is not quadratic, or there is none."""
        return self.structure.penalty_form

    @property
    def linear_penalty(self) -> bool:
        """Whether there is no penalty or a quadratic one, so that the estimate is linear in the data."""
        return self.formulation.penalty is None or self.penalty_form is not None

    @property
    def quadratic(self) -> bool:
        """Whether loss and penalty are quadratics."""
        return self.loss_form is not None and self.linear_penalty

    @property
    def separable(self) -> bool:
        """Whether the loss is a sum over equations or configurations, and not quadratic."""
        return self.structure.loss is not None and self.structure.loss.separable

    @property
    def closed_form(self) -> bool:
        """Whether every solution on the path is a formula in the singular values (Tikhonov, least squares)."""
        return self.quadratic and not self.structure.constrained

    @property
    def box(self) -> tuple[Array, Array] | None:
        """Lower and upper bounds (n,) of z, infinite where there is none; None where a constraint is no `Box`."""
        return self.structure.box

    @cached_property
    def squared(self) -> LinearModel:
        """The equations whose squares a quadratic loss sums, |L (A z - b) - c|^2; InputError for another loss."""
        form, model = self.loss_form, self.model
        if form is None:
            raise InputError(f"formulation '{self.formulation.name}'", "a loss that is not quadratic", "a squared loss")
        if form.diagonal and (form.L == 1).all() and not form.c.any() and form.constant == 0:
            return model
        A, b = form.times(model.A), form.times(model.b) + form.c
        group = model.group
        if form.diagonal:
            counts = form.L > 0  # equations without weight are none
            A, b, group = A[counts], b[counts], group[counts]
        else:
            group = np.zeros(len(b), dtype=int)  # its rows mix configurations
        return replace(model, A=A, b=b, group=group, offset=model.offset + form.constant, factor=form.size)

    @cached_property
    def ridge(self) -> Ridge:
        """The closed form of a program with quadratic loss and penalty, its constraints left out."""
        return ridge(self.squared, self.penalty_form)

    @property
    def rows(self) -> tuple[Array, Array]:
        """A (m, n) and b (m,) of the residual that the loss gets: the QR factor, where it suffices."""
        n = self.model.A.shape[1]
        if self.structure.equations == len(self.model.b):
            return self.model.A, self.model.b
        return self.model.qr_factor[:, :n], self.model.qr_factor[:, n]

    @cached_property
    def _rows(self) -> Rows:
        """The equations in the order in which the solver has them."""
        A, b = self.rows
        counts = None
        if self.structure.over_norms:
            order, counts = np.argsort(self.structure.groups, kind="stable"), np.bincount(self.structure.groups)
            A, b = A[order], b[order]
        model = self.model if self.loss_form is None else self.squared
        return Rows(A, b, counts, model.qr_factor)

    # --- values --------------------------------------------------------------------------------------------------

    def value(self, z: Array, weight: float = 1.0) -> tuple[float, float]:
        """Return loss(A z - b) and penalty(z), minimized over the functions' own variables at the weight.

        z is (n,) in units of the scales; the weight only affects the functions' own variables.
        """
        key = z.tobytes(), weight if self.structure.inner else 0.0
        if key not in self._values:
            A, b = self.rows
            loss, penalty = self.structure.values(z, A @ z - b, weight)
            self._values[key] = loss + self.model.offset, penalty
        return self._values[key]

    def objective(self, z: Array, weight: float) -> float:
        """Return loss(A z - b) + weight penalty(z); infinite outside their domain. Arguments as for `value`."""
        loss, penalty = self.value(z, weight)
        return loss if weight == 0 else loss + weight * penalty

    def inside(self, z: Array, weight: float) -> Array:
        """Return z (n,), or a nearby point inside the functions' domain.

        An interior-point solution may lie on either side of a boundary of the domain: it is moved slightly towards
        nominal, or away from it if nominal is outside.
        """
        for share in (0.0, 1e-9, -1e-9, 1e-7, -1e-7, 1e-5, -1e-5, 1e-3, -1e-3, 1e-1, -1e-1):
            nearer = z - share * z
            if np.isfinite(self.objective(nearer, weight)):
                return nearer
        return z

    def norms(self, z: Array) -> Array:
        """Return the whitened norm of every configuration's residual (N,), in the order of their numbers."""
        return self.model.norms(self.model.A @ z - self.model.b)

    def violation(self, z: Array) -> float:
        """Return the violation of the constraints at z (n,), in units of the scales.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> ball = ro.Formulation("ball", constraints=(ro.in_ball(2.0, "*"),))
        >>> problem = ro.load("position").problem
        >>> program = ro.convex.pose(ball, problem.linearize(np.zeros(len(problem.parameters.free))))
        >>> round(program.violation(3 * program.solve().z), 6)
        4.0
        """
        projection = self._projected(z)
        if projection is None:
            return np.inf
        return float(np.linalg.norm(projection - z, 2 if self.box is None else np.inf))

    def nearest(self, z: Array) -> Array:
        """Return the projection of z (n,) on the constraints; z itself if it fails."""
        projection = self._projected(z)
        return z if projection is None or np.linalg.norm(projection - z) <= TOUCHING else projection

    def _projected(self, z: Array) -> Array | None:
        """Return the point of the constraints of z that is nearest to z (n,); None where the solver finds none."""
        if self.box is not None:
            return np.clip(z, *self.box)
        if not self.formulation.constraints or self.structure.feasible(z):
            return z
        try:
            return nearest(self.structure.canonical, z)
        except Unsolved:
            return None

    def inliers(self, z: Array) -> Inliers | None:
        """Return the equations that a robust loss does not treat as outliers at z (n,); None for a squared loss.

        InputError for a loss without a slope, or one that depends on few equations (minimax).
        """
        if self.loss_form is not None:
            return None
        return inliers_of(self.formulation, self.norms(z), self.model.members[1], self.structure.expressions.loss)

    def inlier_model(self, z: Array) -> LinearModel:
        """Return the equivalent squared-loss model of a robust fit: the inlier rows at z (n,), downweighted.

        Degrees of freedom, likelihoods and covariances of a robust estimate are those of this model; rules for the
        weight use it, too. For a squared loss it is the model itself. InputError as for `inliers`.
        """
        inliers = self.inliers(z)
        return self.squared if inliers is None else inliers(self.model, z)[0]

    # --- solutions -----------------------------------------------------------------------------------------------

    def problem(self, weight: float) -> cp.Problem:
        """Return the program that `solve` solves as a CVXPY problem in the variable ``z``.

        ``A``, ``b`` and ``weight`` are parameters with these names (`cp.Problem.param_dict`), as are the parameters of
        the formulation's own functions; it obeys CVXPY's rules for parametrized programs (DPP). InputError for a weight
        that is negative or not finite.
        """
        A, b = self.rows
        data = (
            cp.Parameter(A.shape, name="A", value=A),
            cp.Parameter(b.shape, name="b", value=b),
            cp.Parameter(nonneg=True, name="weight", value=self._weight(weight)),
        )
        return self._written(data, self.structure.expressions.live, None)[0]

    def _written(self, data: tuple[Any, Any, Any], stated: tuple[Any, Any, Any], damping: Damping | None) -> Any:
        """Return a CVXPY problem, its variable z, and the formulation's constraints by function."""
        shape, expressions = self.structure, self.structure.expressions
        loss, penalty, groups = stated
        A, b, weight = data
        z, r = cp.Variable(shape.n, name="z"), cp.Variable(shape.equations, name="r")
        instead = {id(expressions.z): z, id(expressions.r): r}
        if shape.over_norms:
            instead[id(expressions.loss.variable)] = norms(r, shape.groups)
        groups = [[substituted(constraint, instead) for constraint in group] for group in groups]
        every = [r == A @ z - b]
        every += [constraint for group in groups for constraint in group]
        total = substituted(loss, instead) + self.model.offset
        if penalty is not None:
            price = substituted(penalty, instead)
            if price.parameters():  # a product of two parameters is not DPP
                above = cp.Variable(name="penalty")
                every.append(above >= price)
                price = above
            total = total + weight * price
        if damping is not None:
            total = total + cp.sum_squares(damping.F @ (z - damping.centre))
        return cp.Problem(cp.Minimize(total), every), z, groups

    @one_blas_thread
    def solve(
        self,
        weight: float = 0.0,
        *,
        damping: Damping | None = None,
        solver: str | None = None,
        settings: Mapping[str, Any] | None = None,
        verbose: bool = False,
    ) -> Estimate:
        """Return the solution at a weight.

        At weight zero the penalty is absent, and directions that the data do not identify stay nominal unless
        constraints move them.

        ``damping`` is a term that keeps the solution near a point. If ``solver``, ``settings`` or ``verbose`` is given,
        CVXPY solves `problem` with that solver (default Clarabel), whatever its structure; it also does if loss and
        constraints share own variables.

        InputError for a weight that is negative or not finite, and a solver that is not installed. NoSolutionFound if
        the solver does not end with "optimal", or its point violates the constraints; ``conflict`` has the
        contradicting ones.
        """
        weight = self._weight(weight)
        if solver or settings or verbose:
            return self._by_cvxpy(weight, damping, solver or cp.CLARABEL, settings or {}, verbose)
        if self.structure.joint:
            return self._by_cvxpy(weight, damping, cp.CLARABEL, TIGHT, False)
        if weight == 0 and not self.linear_penalty:  # a penalty times zero is no part of the program
            alone = self._part(self.structure.without_penalty, self.model).solve(damping=damping)
            return replace(alone, penalty=self.value(alone.z, 0.0)[1])
        if damping is None and self.closed_form:
            return self._at(self._closed(weight), weight)
        if weight == 0 and damping is None and not self.model.svd[1].all():
            return self._unidentified()
        return self._by_structure(weight, damping)

    def _closed(self, weight: float) -> Array:
        """Return the minimum (n,) of squares and a quadratic penalty, by QR unless it is ill-conditioned."""
        n, form, rows = self.structure.n, self.penalty_form, self.squared.qr_factor
        rows = rows[rows.any(axis=1)]  # those of fewer equations than parameters are zero below
        if form is not None and weight > 0:
            rows = np.vstack([rows, np.sqrt(weight) * np.column_stack([form.matrix, form.c])])
        T = reduced_rows(rows)
        if TRCON(T[:n, :n])[0] > WELL_CONDITIONED:
            return triangular_solution(T[:n, :n], T[:n, n])
        z = self.ridge.minima(np.array([weight]))[0]
        if form is not None and weight > 0 and not (form.diagonal and (form.L == 1).all()):
            # a penalty with little curvature in some directions costs the closed form digits
            z = z + np.linalg.lstsq(rows[:, :n], rows[:, n] - rows[:, :n] @ z, rcond=RANK_TOLERANCE)[0]
        return z

    @one_blas_thread
    def path(self, weights: Sequence[float] | Array) -> list[Estimate]:
        """Return the solutions at many weights (K,), zero or more: by formula, or each from its neighbour."""
        checked = np.array([self._weight(weight) for weight in weights])
        if self.closed_form:
            Z = self.ridge.minima(checked)
            R, n, form = self.squared.qr_factor, self.structure.n, self.penalty_form
            losses = np.sum((Z @ R[:, :n].T - R[:, n]) ** 2, axis=1) + self.squared.offset
            penalties = np.zeros(len(Z))
            if form is not None:
                penalties = np.sum((form.times(Z.T).T - form.c) ** 2, axis=1) + form.constant
            rows = zip(Z, checked, losses, penalties, strict=True)
            return [Estimate(z, float(w), float(loss), float(penalty)) for z, w, loss, penalty in rows]
        estimates = {weight: self.solve(weight) for weight in sorted(set(checked.tolist()), reverse=True)}
        return [estimates[weight] for weight in checked.tolist()]

    def tangent(self, z: Array, weight: float) -> Array | None:
        """Return an orthonormal basis (n, k) of the active constraints' null space at z.

        Equality, inequality and cone constraints are linearized at z; own variables are free to follow. None if no
        constraint is active, or if it is unknown because the loss shares own variables.
        """
        found = self._active(z, weight)
        if found is None:
            return None
        p, (optimum, active) = self.structure.canonical, found
        dense = p.dense[0]
        normals = [dense[: p.linear][active[: p.linear]]]
        for part in p.cone_rows:
            if active[part.start]:
                normals.append(optimum.dual[part][None] @ dense[part])
        G = np.vstack(normals)
        if not len(G):
            return None
        _, values, V = np.linalg.svd(G)
        rank = int(np.count_nonzero(values > RANK_TOLERANCE * values.max(initial=0.0)))
        moves = V[rank:].T[p.at]
        U, values, _ = np.linalg.svd(moves, full_matrices=False)
        return U[:, values > TOUCHING]

    def active_multipliers(self, z: Array, weight: float) -> tuple[Array, ...]:
        """Return the multipliers at z by constraint function, zero where a constraint is not active."""
        found = self._active(z, weight)
        if found is None:
            return self.beginning(z).solve(weight).duals
        optimum, active = found
        return self._duals(replace(optimum, dual=np.where(active, optimum.dual, 0.0)))

    def _active(self, z: Array, weight: float) -> tuple[Point, np.ndarray] | None:
        """Return the minimum next to z, and which rows of the constraints are active there (m,), cones as a whole.

        An interior-point method leaves both multipliers and slacks nonzero: a constraint is active if its multiplier
        exceeds its slack times the least curvature of the penalty. None without constraints, without minimum, and if
        the loss shares own variables.
        """
        if not self.formulation.constraints or self.structure.joint:
            return None
        try:
            optimum = minimum(self._rows, WarmStart(self.structure).begin(z), weight)
        except Unsolved:
            return None
        p = self.structure.canonical
        size, slack = np.abs(optimum.dual), p.b - p.A @ optimum.x
        for k, part in enumerate(p.cone_rows):
            size[part] = size[part].max()
            first, *others = slack[part]
            slack[part] = first - np.linalg.norm(others) if k < p.second_order else 0.0
        objective = self.objective(z, weight)
        least = np.maximum(max(weight, SOFTEST * objective) * slack, max(ACTIVE * size.max(), TOUCHING * objective))
        return optimum, (size > least) | (np.arange(len(size)) < p.zero)

    def _weight(self, weight: float) -> float:
        """Return the weight, checked; zero where there is no penalty for it to multiply."""
        number = isinstance(weight, int | float | np.integer | np.floating) and not isinstance(weight, bool)
        if not (number and np.isfinite(weight) and weight >= 0):
            raise InputError("weight", f"{weight!r}", "a finite number, zero or more")
        return 0.0 if self.formulation.penalty is None else float(weight)

    def _at(
        self, z: Array, weight: float, multipliers: Callable[[], tuple[Array, ...]] = tuple, iterations: int = 0
    ) -> Estimate:
        if not self.quadratic:  # a quadratic is finite everywhere
            z = self.inside(z, weight)
        return Estimate(z, weight, *self.value(z, weight), multipliers, iterations=iterations)

    def _by_structure(self, weight: float, damping: Damping | None) -> Estimate:
        """Return the minimum by the structure of the loss; where that fails, CVXPY's."""
        try:
            optimum = minimum(self._rows, self._warm, weight, damping)
        except Unsolved as error:
            status = STATUS.get(str(error), str(error))
            return self._by_cvxpy(weight, damping, cp.CLARABEL, {}, False, status)
        canonical = self.structure.canonical
        z = optimum.x[canonical.at]
        # half: the projection in `violation` is no more accurate
        if self.structure.constrained and canonical.missed(optimum.x) > 0.5 * FEASIBLE:
            z = self.nearest(z)
        return self._at(z, weight, partial(self._duals, optimum), optimum.iterations)

    def _unidentified(self) -> Estimate:
        """Return the minimum at weight zero where the data do not identify all, by the proximal point method.

        z <- argmin loss(A z - b) + |F (z - last z)|^2 subject to constraints(z), from z = 0; F'F is a decreasing
        multiple of the projection on the unidentified directions (Rockafellar, SIAM J. Control Optim. 14(5), 1976).
        """
        _, s, V = self.model.svd
        best = self._by_structure(0.0, Damping(np.zeros(len(s)), V[s == 0]))
        for part in PROXIMAL if self.structure.constrained else ():  # otherwise the term is zero there
            try:
                found = self._by_structure(0.0, Damping(best.z, part * V[s == 0]))
            except NoSolutionFound:
                break
            if found.loss >= best.loss or self.violation(found.z) > feasibility_tolerance(best.z):
                break
            best = found
        return best

    def _duals(self, found: Point) -> tuple[Array, ...]:
        """Return the multipliers by constraint function."""
        canonical = self.structure.canonical
        if not self.formulation.constraints:
            return ()
        if canonical.cones is None and self.box is not None:
            lower, upper = self.box
            price = np.bincount(_sides(lower, upper), np.abs(found.dual), self.structure.n)
            below = found.x - lower < upper - found.x
            duals = []
            for box in self.formulation.constraints:  # boxes that share a bound: the first gets the multiplier
                low, high = box.bounds(self.structure.parameters) if isinstance(box, Box) else self.box
                duals.append(np.where(np.where(below, low == lower, high == upper), price, 0.0))
                price = price - duals[-1]
            return tuple(duals)
        values = canonical.duals(found.x, found.dual)
        groups = self.structure.expressions.constraints
        return self._by_function([[np.ravel(np.asarray(values[c.id], dtype=float)) for c in group] for group in groups])

    def _by_function(self, groups: Sequence[Sequence[Array]]) -> tuple[Array, ...]:
        """Return multipliers by constraint function: of a box (n,), as if loosened on the side that is active."""
        multipliers = []
        for constraint, group in zip(self.formulation.constraints, groups, strict=True):
            values = np.concatenate([np.empty(0), *group])
            if isinstance(constraint, Box):
                sides = _sides(*constraint.bounds(self.structure.parameters))
                values = np.bincount(sides, np.abs(values), self.structure.n)
            multipliers.append(values)
        return tuple(multipliers)

    def _by_cvxpy(
        self,
        weight: float,
        damping: Damping | None,
        solver: str,
        settings: Mapping[str, Any],
        verbose: bool,
        first: str = "",
    ) -> Estimate:
        """Return the minimum by a solver of CVXPY; ``first`` is the reason why the previous method failed."""
        if not isinstance(solver, str) or solver.upper() not in cp.installed_solvers():
            installed = ", ".join(cp.installed_solvers())
            raise InputError("solver", f"{solver!r}", f"an installed solver: {installed}")
        own = self.structure.expressions
        stated = own.loss.expression, own.penalty_of_z, own.constraints
        problem, z, groups = self._written((*self.rows, weight), stated, damping)
        for variable in problem.variables():
            variable.save_value(None)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # an inaccurate solution is judged by its violation
            try:
                problem.solve(solver=solver, verbose=verbose, **settings)
            except TypeError as error:
                if not settings:
                    raise
                raise InputError("settings", f"{error}".rstrip("."), f"settings that {solver} knows") from None
            except (cp.SolverError, ValueError, ArithmeticError, RuntimeError) as error:  # each solver has its own
                raise self._failure(first or f"an error of {solver}: {error}", weight, solver) from None
        if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) or z.value is None:
            raise self._failure(first or problem.status, weight, solver)
        point = np.array(z.value)
        missed = self.violation(point)
        if missed > feasibility_tolerance(point):
            raise self._failure(f"{problem.status}, but violates the constraints by {missed:.1e}", weight, solver)
        values = [[np.ravel(np.asarray(c.dual_value, dtype=float)) for c in group] for group in groups]
        iterations = int(problem.solver_stats.num_iters or 0)
        multipliers = partial(self._by_function, values)
        return replace(self._at(point, weight, multipliers, iterations), status=problem.status)

    def _failure(self, status: str, weight: float, solver: str) -> NoSolutionFound:
        """Return why a solver of CVXPY found no solution."""
        from rpim_opt.convex.infeasible import advice, conflict  # for programs without a solution

        contradiction = None
        if self.structure.constrained:  # they may contradict each other, whatever the status
            contradiction = conflict(self.structure)
        elif status.startswith("infeasible"):
            status = "stalled"  # a program without constraints always has a point
        text = advice(self.structure, status, contradiction, solver)
        return NoSolutionFound(self.formulation.name, weight, status, contradiction, text)


def _sides(lower: Array, upper: Array) -> np.ndarray:
    """Return the components that the rows of a box bound: fixed ones, lower and upper bounds."""
    return np.concatenate([np.flatnonzero(side) for side in box_sides(lower, upper)])


def pose(
    formulation: Formulation | str, model: LinearModel, forms: Sequence[Quadratic | None] | None = None
) -> Program:
    """Return the program of a formulation, or of the ready one of that name, on a linear model A z ~ b.

    The formulation's functions are called once, now. If it is not ``solvable``, ``forms`` may state the quadratic forms
    of loss and penalty. InputError if they do not return convex expressions and constraints of CVXPY.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("paper_arm").problem
    >>> program = ro.convex.pose(ro.tikhonov, problem.linearize(np.zeros(len(problem.parameters.free))))
    >>> program.closed_form, len(program.path([1e-3, 1.0]))
    (True, 2)
    """
    formulation = formulation_of(formulation)
    m, n = model.A.shape
    if formulation.solvable:
        by_length = formulation.loss in INVARIANT and formulation.loss_over == "equation"
        if model.stands_for is not None and not by_length:
            found = "equations in blocks, of which only the QR factor is kept"
            accepted = "cp.sum_squares or cp.norm2 of the equations as the loss"
            raise InputError(f"formulation '{formulation.name}'", found, accepted)
        if by_length:
            m = n + 1
    made = Structure(formulation, model.parameters, m, model.members[0], forms)
    return Program(formulation, model, made, WarmStart(made))
