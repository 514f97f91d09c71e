"""Formulations: the convex program of one linearization, in CVXPY's own algebra, solved by Clarabel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.linalg import qr, solve_triangular
from scipy.sparse import csr_array
from scipy.stats import chi2

from rpim_opt.conic import Conic, Term
from rpim_opt.constraints import Box, Constraint, by_link, stated, within_tolerance
from rpim_opt.exceptions import Conflict, InputError, NoSolutionFound
from rpim_opt.parameters import Parameters
from rpim_opt.problem import LinearModel
from rpim_opt.robot import Array
from rpim_opt.threads import one_blas_thread

Function = Callable[[Any], Any]
ROTATION_INVARIANT = (cp.sum_squares, cp.norm2)
"""Losses that see only the length of the residual: [A b] may be replaced by its triangular factor."""

FEASIBLE = 1e-9
"""By how much a solution may miss its constraints, relative to its largest entry."""
SNAP = 1e-7
"""How near to a bound an interior point lies, relative to its size, where the active set begins with that bound."""
STATIONARY = 1e-7
"""Largest gradient of a box-constrained solution off its bounds, relative to that of the data at nominal."""


def rotation_invariant(formulation: Formulation) -> bool:
    """Return whether the loss sees only the length of the whole residual: the triangle of [A b] then says all."""
    whole = formulation.loss_over == "equation" and not np.isfinite(formulation.largest)
    return formulation.loss in ROTATION_INVARIANT and whole


def squared_norm(value: Any) -> float:
    """Return |value|^2 of an array."""
    return float(np.sum(np.square(value)))


@dataclass(frozen=True)
class Formulation:
    """A convex way to identify the scaled total deviation z from whitened equations A z ~ b.

    ::

        minimize    loss(A z - b) + weight * penalty(z)     subject to    constraints(z)

    Parameters
    ----------
    name
        What reports call it.
    loss
        Convex function of the whitened residual (m,); the sum of squares by default.
    penalty
        Convex function of z (n,), or None.
    constraints
        Functions of z and of the identified `Parameters`, each returning a CVXPY constraint or several.
    loss_over
        ``"equation"``, or ``"configuration"``: the loss then gets the whitened norm of each configuration (N,), and
        has to be nondecreasing.
    penalty_over
        A function of the identified `Parameters` that returns matrices D_k: the penalty then gets the norms
        |D_k z| (K,), and has to be nondecreasing. `by_link`, `by_kind`, `differences`.
    largest
        Largest whitened norm that a configuration may keep; infinite by default.
    solvable
        False for one that was read from a file, which cannot hold a script's functions.
    """

    name: str
    loss: Function = cp.sum_squares
    penalty: Function | None = None
    constraints: tuple[Constraint, ...] = ()
    loss_over: str = "equation"
    penalty_over: Callable[[Parameters], Sequence[Array]] | None = None
    largest: float = float("inf")
    solvable: bool = True

    def __post_init__(self) -> None:
        if self.loss_over not in ("equation", "configuration"):
            raise InputError("loss_over", f"'{self.loss_over}'", "equation, configuration")

    def compile(self, model: LinearModel) -> ConvexProgram:
        """Pose the program in CVXPY, or take the one that was posed for the same shape before."""
        return ConvexProgram(self, model, _posed(self, model) if self.solvable else _Unposed(self))


@dataclass(frozen=True, eq=False)
class Estimate:
    """One solution: z (n,) at a weight, with the two values that the L-curve plots.

    ``duals`` are the multipliers of the formulation's constraints, one array each: by how much the objective would
    fall if the constraint were loosened by one unit of the scales.
    """

    z: Array
    weight: float
    loss: float
    penalty: float
    duals: tuple[Array, ...] = ()


@dataclass(frozen=True, eq=False)
class ConvexProgram:
    """A formulation applied to a linear model, ready to be solved at any weight."""

    formulation: Formulation
    model: LinearModel
    _posed: _Posed | _Unposed

    def on(self, model: LinearModel) -> ConvexProgram:
        """Return the program for another model of the same shape, without posing it anew."""
        return ConvexProgram(self.formulation, model, self._posed)

    @property
    def squared(self) -> bool:
        """Whether the loss is a sum of squares and the penalty too, or there is none."""
        return self._posed.quadratic

    @property
    def quadratic(self) -> bool:
        """Whether loss and penalty are squared norms."""
        return self.squared and self.formulation.penalty is not None

    @property
    def box(self) -> tuple[Array, Array] | None:
        """Lower and upper bounds (n,) of z, infinite where there is none; None where a constraint is no `Box`."""
        return self._posed.box

    @property
    def closed_form(self) -> bool:
        """Whether every solution on the path is a formula in the singular values (Tikhonov, least squares)."""
        return self._posed.quadratic and not self._posed.constrained

    def value(self, z: Array) -> tuple[float, float]:
        """Return loss(A z - b) and penalty(z)."""
        r = self.model.A @ z - self.model.b
        if self.formulation.loss_over == "configuration":
            r = self.norms(z)
        return self._posed.loss(r) + self.model.offset, self._posed.penalty(self._posed.penalized(z))

    def norms(self, z: Array) -> Array:
        """Return the whitened norm of every configuration's residual (N,), in the order of their numbers."""
        squares = (self.model.A @ z - self.model.b) ** 2
        return np.sqrt(np.bincount(np.unique(self.model.group, return_inverse=True)[1], squares))

    def violation(self, z: Array) -> float:
        """Return by how much z misses the constraints, in units of the scales."""
        excess = float(np.max(self.norms(z))) - self.formulation.largest if self._posed.limited else 0.0
        return max(self._posed.violation(z), excess, 0.0)

    @one_blas_thread
    def solve(self, weight: float = 0.0, centre: Array | None = None, radius: float = np.inf) -> Estimate:
        """Return the solution at a weight, from Clarabel.

        Weight zero is the limit of small weights: directions that the data do not see stay nominal.

        Parameters
        ----------
        weight
            Of the penalty, zero or more.
        centre, radius
            A trust region: the solution is sought in |z - centre| <= radius, each component.

        Raises
        ------
        NoSolutionFound
            When the solver does not end with "optimal", or its point misses the constraints; ``conflict`` names
            what contradicts what when the program is infeasible.
        """
        weight, posed, box = self._weight(weight), self._posed, self.box
        region = (centre - radius, centre + radius) if centre is not None and np.isfinite(radius) else None
        if region is not None and box is not None:
            box = np.maximum(box[0], region[0]), np.minimum(box[1], region[1])
        limited = bool(posed.constrained or region is not None)
        polish = posed.quadratic and limited and box is not None and bool((box[0] <= box[1]).all())
        try:
            z, duals = posed.solve(self, weight, region)
        except NoSolutionFound:
            if not polish:
                raise
            z, duals = self._formula(weight), ()  # an interior point may fail where an active set does not
        if polish and box is not None:
            near = SNAP * (1 + np.abs(z))  # an interior point stops short of the bounds that hold
            z = np.where(z - box[0] < near, box[0], np.where(box[1] - z < near, box[1], z))
            z, held = self._polished(z, weight, *box)
            duals = (held,)
        return Estimate(z, weight, *self.value(z), duals)

    @one_blas_thread
    def path(self, weights: Sequence[float] | Array) -> list[Estimate]:
        """Return the solutions at many weights.

        A squared loss with a squared penalty has a formula, z = V diag(s / (s^2 + weight)) U'b; where that
        meets the constraints it is the solution. In a box the active set continues from weight to weight; otherwise
        a program is solved.
        """
        checked = np.array([self._weight(weight) for weight in weights])
        if not self._posed.quadratic:
            return [self.solve(weight) for weight in checked]
        formula = self._formulas(checked)
        if self.closed_form:
            return self._estimates(formula, checked)
        estimates, z = [], None
        for weight, free in zip(checked, formula, strict=True):
            if self.violation(free) <= 0:
                z, held = free, np.zeros_like(free)
            elif self.box is None or (self.box[0] > self.box[1]).any():
                estimates.append(self.solve(weight))
                continue
            else:
                z, held = self._polished(np.clip(free if z is None else z, *self.box), weight, *self.box)
            estimates.append(Estimate(z, weight, *self.value(z), (held,)))
        return estimates

    def _estimates(self, z: Array, weights: Array) -> list[Estimate]:
        """Return solutions (K, n) with their values, all at once."""
        R, n = self.model.triangle, z.shape[1]
        loss = np.sum((z @ R[:, :n].T - R[:, n]) ** 2, axis=1)
        penalty = np.sum(z**2, axis=1) if self.formulation.penalty else np.zeros(len(z))
        rows = zip(z, weights, loss, penalty, strict=True)
        return [Estimate(each, float(w), float(fit), float(size)) for each, w, fit, size in rows]

    def trusted(self, z: Array) -> LinearModel:
        """Return the squared-loss model that a robust fit amounts to: what it trusts at z, weighed as the loss does.

        Configurations beyond `outlying` are left out; the others are scaled by the root of the median of
        loss'(v) / (2 v), so that a weight means the same. Degrees of freedom, likelihoods and covariances of a robust
        estimate are those of this model. With a squared loss it is the model itself.

        Raises
        ------
        InputError
            For a loss without a slope, or one that rests on few equations (minimax).
        """
        if self.formulation.loss is cp.sum_squares:
            return self.model
        norms, (_, which, count) = self.norms(z), np.unique(self.model.group, return_inverse=True, return_counts=True)
        keep = norms <= outlying(norms, count)
        over = self.formulation.loss_over == "configuration"
        v = norms if over else self.model.A @ z - self.model.b
        v = np.where(np.abs(v) > 1e-6, v, 1e-6)
        slope = self._posed.loss_term(len(v)).slope(v)
        found = f"formulation '{self.formulation.name}'"
        if slope is None:
            raise InputError(found, "a loss without slope", "another selector: l_curve, corner, k_fold, or a number")
        weight = np.abs(slope) / (2 * np.abs(v))
        factor = float(np.median(weight[keep if over else keep[which]]))
        if not factor > 0:
            raise InputError(found, "a loss that rests on a few equations", "another selector: l_curve, corner, k_fold")
        return self.model.scaled(np.sqrt(factor) * keep[which])

    def _weight(self, weight: float) -> float:
        """Return the weight, checked; zero where there is no penalty for it to multiply."""
        if not (np.isfinite(weight) and weight >= 0):
            raise InputError("weight", f"{weight}", "a finite number, zero or more")
        return 0.0 if self.formulation.penalty is None else float(weight)

    def _formula(self, weight: float) -> Array:
        return self._formulas(np.array([weight]))[0]

    def _formulas(self, weights: Array) -> Array:
        """Return the unconstrained solutions (K, n) of a squared loss and penalty."""
        beta, s, Vt = self.model.svd
        gain = np.zeros((len(weights), len(s)))
        seen = s > 0
        gain[:, seen] = s[seen] * beta[seen] / (s[seen] ** 2 + weights[:, None])
        return gain @ Vt

    def _polished(self, z: Array, weight: float, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Return the exact minimum in a box, from a point near it, and by how much each bound holds it back.

        A monotone active-set method (Stark and Parker 1995, Computational Statistics 10:129) on the triangular
        factor; ends where the gradient has the right sign at every bound and vanishes off them.
        """
        R, n = self.model.triangle, len(z)
        A = np.vstack([R[:, :n], np.sqrt(weight) * np.eye(n)])
        b = np.concatenate([R[:, n], np.zeros(n)])
        size = np.linalg.norm(A, axis=0) * max(float(np.linalg.norm(b)), 1e-300)
        free = (z > lower) & (z < upper)
        for _ in range(10 * n + 10):
            r = b - A @ z
            step = np.zeros(n)
            step[free] = _least_squares(A[:, free], r) if free.any() else 0.0
            to_bound = np.where(step > 0, upper - z, np.where(step < 0, lower - z, np.inf))
            share = np.divide(to_bound, step, out=np.full(n, np.inf), where=step != 0)
            k = int(np.argmin(share))
            z = np.clip(z + min(1.0, float(share[k])) * step, lower, upper)
            if share[k] < 1:
                z[k] = upper[k] if step[k] > 0 else lower[k]
                free[k] = False
                continue
            slope = A.T @ (b - A @ z)  # minus half the gradient
            held = ~free & (lower < upper)
            inward = np.where(z <= lower, slope, -slope)
            wrong = np.where(held, inward / size, -np.inf)
            k = int(np.argmax(wrong))
            if wrong[k] <= 1e-14:
                off = float(np.max(np.abs(slope[free]) / size[free], initial=0.0))
                if off > STATIONARY:
                    raise NoSolutionFound(self, weight, f"active set: gradient {off:.1e} off the bounds")
                return z, 2 * np.where(held, -inward, 0.0)
            free[k] = True
        raise NoSolutionFound(self, weight, "active set: no end")


def outlying(norms: Array, count: np.ndarray) -> np.ndarray:
    """Return above which whitened norm (N,) a row or configuration with ``count`` equations is an outlier.

    What one good set of data in a hundred would exceed, s sqrt(chi2_k^-1(1 - 0.01 / N)), with the declared noise s = 1
    or, where that is larger, median(norm / median of chi_k).
    """
    noise = max(1.0, float(np.median(norms / np.sqrt(chi2.ppf(0.5, count)))))
    return noise * np.sqrt(chi2.ppf(1 - 0.01 / len(norms), count))


def _least_squares(A: Array, b: Array) -> Array:
    """Return the least-squares solution, by QR where A has full rank and else of least norm."""
    factors: Any = qr(np.column_stack([A, b]), mode="r", overwrite_a=True, check_finite=False)
    n = A.shape[1]
    R = factors[0][:n, :n]
    diagonal = np.abs(np.diag(R))
    if len(R) < n or not diagonal.min() > 1e-14 * diagonal.max():
        return np.asarray(np.linalg.lstsq(A, b, rcond=1e-15)[0], dtype=float)
    return solve_triangular(R, factors[0][:n, n], check_finite=False)


@dataclass(frozen=True)
class _Shape:
    """What a posed program depends on, besides the formulation; the data of a calibration are no part of it."""

    unknowns: int
    equations: int
    group: bytes
    signature: tuple[Any, ...]
    parameters: Parameters = field(compare=False)
    groups: np.ndarray = field(compare=False)


def _posed(formulation: Formulation, model: LinearModel) -> _Posed:
    m, n = model.A.shape
    if model.stands_for is not None and not rotation_invariant(formulation):
        found = f"formulation '{formulation.name}'"
        raise InputError(found, "equations of which only the triangle is kept", "a squared loss")
    grouped = formulation.loss_over == "configuration" or np.isfinite(formulation.largest)
    groups = np.unique(model.group, return_inverse=True)[1] if grouped else np.empty(0, dtype=int)
    p = model.parameters
    own = bool(formulation.constraints) or formulation.penalty_over is not None
    signature = (p.names, p.dimensions, p.nominal.tobytes(), p.scale.tobytes(), p.tolerance.tobytes()) if own else ()
    shape = _Shape(n, m, groups.tobytes(), signature, p, groups)
    try:
        return _posed_once(formulation, shape)
    except TypeError:  # a user's function or constraint that cannot be told from others
        return _Posed(formulation, shape)


@lru_cache(maxsize=64)
def _posed_once(formulation: Formulation, shape: _Shape) -> _Posed:
    return _Posed(formulation, shape)


class _Posed:
    """The program of a formulation for one shape: CVXPY canonicalizes it once, in z and the residual r.

    Data come in by substitution. With D = sqrt(s^2 + weight) and the singular values of A,

        z = V D^-1 u + V D^-2 s U'b        r = A z - b

    so that a squared loss with a squared (or no) penalty is |u|^2 + const: perfectly conditioned at every weight,
    where posed in z an interior-point solver calls answers "optimal" that have no correct digit.
    """

    def __init__(self, formulation: Formulation, shape: _Shape):
        self.formulation, self.shape, self.parameters = formulation, shape, shape.parameters
        self.n = n = shape.unknowns
        self.limited = bool(np.isfinite(formulation.largest))
        self.constrained = bool(formulation.constraints) or self.limited
        whole = formulation.loss_over == "equation"
        plain = formulation.penalty_over is None
        self.quadratic = (
            formulation.loss is cp.sum_squares
            and (formulation.penalty is None or (formulation.penalty is cp.sum_squares and plain))
            and not self.limited
        )
        self.reduced = rotation_invariant(formulation)
        over = formulation.penalty_over
        self.differences = [np.asarray(D, dtype=float) for D in over(self.parameters)] if over else None
        z, weight = cp.Variable(n), cp.Parameter(nonneg=True)
        self.constraints: list[list[Any]] = [_listed(c(z, self.parameters)) for c in formulation.constraints]
        variables, objective = [z], 0.0 * cp.sum(z)
        if not self.quadratic:
            r = cp.Variable(n + 1 if self.reduced else shape.equations)
            variables.append(r)
            norms = None if whole and not self.limited else _norms(r, shape.groups)
            objective = formulation.loss(r if whole else norms)
            if formulation.penalty is not None:
                over = z if plain else cp.hstack([cp.norm(D @ z) for D in self.differences or ()])
                objective = objective + weight * formulation.penalty(over)
            if norms is not None and self.limited:
                self.constraints.append([norms <= formulation.largest])
        every = [constraint for group in self.constraints for constraint in group]
        if not cp.Problem(cp.Minimize(objective), every).is_dcp():
            raise InputError(f"formulation '{formulation.name}'", "a program that is not convex", "CVXPY's DCP rules")
        penalized = not self.quadratic and formulation.penalty is not None
        self.conic = Conic(objective, every, variables, weight if penalized else None)

    @cached_property
    def _checks(self) -> tuple[cp.Variable, list[Any]]:
        probe = cp.Variable(self.n)
        return probe, [k for c in self.formulation.constraints for k in _listed(c(probe, self.parameters))]

    @cached_property
    def box(self) -> tuple[Array, Array] | None:
        """Lower and upper bounds (n,) where every constraint is a `Box`."""
        if not all(isinstance(c, Box) for c in self.formulation.constraints):
            return None
        limits = [c.limits(self.parameters) for c in self.formulation.constraints if isinstance(c, Box)]
        lower = np.max([low for low, _ in limits] + [np.full(self.n, -np.inf)], axis=0)
        upper = np.min([high for _, high in limits] + [np.full(self.n, np.inf)], axis=0)
        return lower, upper

    @cached_property
    def _terms(self) -> dict[tuple[str, int], Term]:
        return {}

    def loss_term(self, size: int) -> Term:
        """Return the loss as a function of numbers (size,)."""
        return self._terms.setdefault(("loss", size), Term(self.formulation.loss, size))

    def loss(self, r: Array) -> float:
        """Return the loss of a residual, or of the configurations' norms."""
        return squared_norm(r) if self.formulation.loss is cp.sum_squares else self.loss_term(len(r))(r)

    def penalty(self, over: Array) -> float:
        """Return the penalty of z, or of its groups' norms."""
        penalty = self.formulation.penalty
        if penalty is None or penalty is cp.sum_squares:
            return 0.0 if penalty is None else squared_norm(over)
        return self._terms.setdefault(("penalty", len(over)), Term(penalty, len(over)))(over)

    def penalized(self, z: Array) -> np.ndarray:
        """Return what the penalty gets: z, or the norms of its groups."""
        return z if self.differences is None else np.array([float(np.linalg.norm(D @ z)) for D in self.differences])

    def violation(self, z: Array) -> float:
        """Return by how much z misses the formulation's constraints."""
        if self.box is not None:
            return float(np.max(np.maximum(self.box[0] - z, z - self.box[1]), initial=0.0))
        probe, checks = self._checks
        probe.value = z
        return max((float(np.max(c.violation())) for c in checks), default=0.0)

    def solve(
        self, program: ConvexProgram, weight: float, region: tuple[Array, Array] | None
    ) -> tuple[Array, tuple[Array, ...]]:
        """Return z and the constraints' multipliers, from Clarabel."""
        model = program.model
        beta, s, Vt = model.svd
        given = weight
        if self.constrained or region is not None or not self.quadratic:
            # a nominal value for unseen directions may not be the answer: let them move, at a price
            weight = max(weight, 1e-16 * s[0] ** 2) if not s.all() or not self.quadratic else weight
        D = np.sqrt(s**2 + weight)
        inverse = np.divide(1.0, D, out=np.zeros_like(D), where=D > 0)
        basis, centre = Vt.T * inverse, Vt.T @ (inverse**2 * s * beta)
        T, c = basis, centre
        if not self.quadratic:
            R = model.triangle if self.reduced else np.column_stack([model.A, model.b])
            T = np.vstack([basis, R[:, : self.n] @ basis])
            c = np.concatenate([centre, R[:, : self.n] @ centre - R[:, self.n]])
        box = None if region is None else (basis, region[0] - centre, region[1] - centre)
        status, u, cones = self.conic.solve(T, c, given, float(self.quadratic), box)
        if status == cp.OPTIMAL:
            z = basis @ u + centre
            if program.violation(z) <= max(FEASIBLE, 1e-8 * self.limited) * max(1.0, float(np.max(np.abs(z)))):
                return z, tuple(self._duals(k, cones) for k in range(len(self.formulation.constraints)))
            status = "optimal, but outside the constraints"
        conflict = _conflict(program) if status in (cp.INFEASIBLE, cp.INFEASIBLE_INACCURATE) else None
        raise NoSolutionFound(program, weight, status, conflict)

    def _duals(self, k: int, cones: Array) -> np.ndarray:
        """Multipliers of the k-th constraint: of a box (n,), as if loosened on the side that holds."""
        values = np.concatenate([self.conic.multipliers(cones, constraint) for constraint in self.constraints[k]])
        constraint = self.formulation.constraints[k]
        if not isinstance(constraint, Box):
            return values
        lower, upper = constraint.limits(self.parameters)
        sides = [lower == upper, np.isfinite(lower) & (lower < upper), np.isfinite(upper) & (lower < upper)]
        found = np.zeros(self.n)
        for side in sides:
            part, values = np.split(values, [np.count_nonzero(side)])
            found[side] += np.abs(part)
        return found


class _Unposed:
    """In the place of `_Posed` for a formulation that is not solvable."""

    quadratic, limited, constrained, box = False, False, True, None

    def __init__(self, formulation: Formulation):
        self.solve = self.violation = self.penalized = self.loss = self.penalty = self.loss_term = lost(
            formulation.name
        )


def lost(name: str) -> Callable[..., Any]:
    """Return what stands for the functions of a formulation that a file could not hold: it raises InputError."""

    def function(*_: Any) -> Any:
        accepted = "the script that holds them, to calibrate again"
        raise InputError(f"formulation '{name}'", "functions that the file of a result cannot hold", accepted)

    return function


def _listed(constraints: Any) -> list[Any]:
    return list(constraints) if isinstance(constraints, list | tuple) else [constraints]


def _norms(r: Any, group: np.ndarray) -> Any:
    """Norms of a residual (m,) by group, in the order of the groups' numbers; shorter groups are filled with zeros."""
    _, which, count = np.unique(group, return_inverse=True, return_counts=True)
    order = np.argsort(which, kind="stable")
    place = np.empty(len(group), dtype=int)
    place[order] = np.arange(len(group)) - np.repeat(np.cumsum(count) - count, count)
    shape = (len(count), int(count.max()))
    pick = csr_array(
        (np.ones(len(group)), (which * shape[1] + place, np.arange(len(group)))), (shape[0] * shape[1], len(group))
    )
    return cp.norm(cp.reshape(pick @ r, shape, order="C"), 2, axis=1)


def _conflict(program: ConvexProgram) -> Conflict:
    """Find the least loosening of the box, and apart from it of the configurations' bound, that would be enough."""
    formulation, parameters = program.formulation, program.model.parameters
    n, groups = program.model.A.shape[1], np.unique(program.model.group)
    boxes = [c.limits(parameters) for c in formulation.constraints if isinstance(c, Box)]
    others = [c for c in formulation.constraints if not isinstance(c, Box)]

    def least(loosen_box: bool) -> Array:
        z, slack = cp.Variable(n), cp.Variable(n if loosen_box else len(groups), nonneg=True)
        room, extra = (slack, 0.0) if loosen_box else (0.0, slack)
        hard = [k for c in others for k in _listed(c(z, parameters))]
        for lower, upper in boxes:
            low, high = np.where(np.isfinite(lower), lower, -1e6), np.where(np.isfinite(upper), upper, 1e6)
            hard += [z <= high + room, z >= low - room]
        if np.isfinite(formulation.largest):
            hard.append(
                _norms(program.model.A @ z - program.model.b, program.model.group) <= formulation.largest + extra
            )
        cp.Problem(cp.Minimize(cp.sum(slack)), hard).solve(solver=cp.CLARABEL)
        return np.zeros(slack.size) if slack.value is None else np.asarray(slack.value)

    box, rows = least(True) * parameters.scale, least(False)
    return Conflict(
        {parameters.names[i]: float(box[i]) for i in np.flatnonzero(box > 1e-6 * parameters.scale)},
        {int(groups[i]): float(rows[i]) for i in np.flatnonzero(rows > 1e-6)},
    )


HUBER = 2.0
"""Whitened norm of a configuration from which Huber's loss grows linearly: a quarter of good positions lie beyond."""


@stated
def huber(threshold: float = HUBER) -> Function:
    """Return Huber's loss: v^2 up to the threshold, 2 threshold v - threshold^2 beyond, summed."""
    bound: Any = threshold  # CVXPY's annotation says int
    return lambda v: cp.sum(cp.huber(v, bound))


least_squares = Formulation("least squares")
tikhonov = Formulation("Tikhonov", penalty=cp.sum_squares)
bounded = Formulation("bounded Tikhonov", penalty=cp.sum_squares, constraints=(within_tolerance,))
robust = Formulation("Huber", loss=huber(), penalty=cp.sum_squares, loss_over="configuration")
sum_of_norms = Formulation("sum of norms", loss=cp.sum, penalty=cp.sum_squares, loss_over="configuration")
minimax = Formulation("minimax", loss=cp.max, penalty=cp.sum_squares, loss_over="configuration")
lasso = Formulation("lasso", penalty=cp.norm1)
group_lasso = Formulation("group lasso by link", penalty=cp.sum, penalty_over=by_link)

FORMULATIONS = {
    "least_squares": least_squares,
    "tikhonov": tikhonov,
    "bounded": bounded,
    "robust": robust,
    "sum_of_norms": sum_of_norms,
    "minimax": minimax,
    "lasso": lasso,
    "group_lasso": group_lasso,
}
