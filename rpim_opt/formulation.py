"""Formulations: the convex program of one linearization, in CVXPY's own algebra, solved by Clarabel."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.sparse import csr_array
from scipy.stats import chi2

from rpim_opt.constraints import Box, Constraint, by_link, stated, within_tolerance
from rpim_opt.exceptions import Conflict, InputError, NoSolutionFound
from rpim_opt.parameters import Parameters
from rpim_opt.problem import LinearModel
from rpim_opt.robot import Array

Term = Callable[[Any], Any]
ROTATION_INVARIANT = (cp.sum_squares, cp.norm2)
"""Losses that see only the length of the residual: [A b] may be replaced by its triangular factor."""

TOLERANCES = [{"tol_gap_abs": t, "tol_gap_rel": t, "tol_feas": t} for t in (1e-12, 1e-10, 1e-8)]
"""Tried in turn; CVXPY keeps the solver and its settings from call to call, so each is stated in full."""
FEASIBLE = 1e-9
"""By how much a solution may miss its constraints, relative to its largest entry."""
STATIONARY = 1e-7
"""Largest gradient of a box-constrained solution off its bounds, relative to that of the data at nominal."""


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
    loss: Term = cp.sum_squares
    penalty: Term | None = None
    constraints: tuple[Constraint, ...] = ()
    loss_over: str = "equation"
    penalty_over: Callable[[Parameters], Sequence[Array]] | None = None
    largest: float = float("inf")
    solvable: bool = True

    def __post_init__(self) -> None:
        if self.loss_over not in ("equation", "configuration"):
            raise InputError("loss_over", f"'{self.loss_over}'", "equation, configuration")

    def compile(self, model: LinearModel) -> ConvexProgram:
        """Pose the program in CVXPY; `ConvexProgram.on` reuses it for other data of the same shape."""
        return ConvexProgram(self, model, _Posed(self, model) if self.solvable else _Unposed(self))


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
    _trust: dict[str, _Posed] = field(default_factory=dict)

    def on(self, model: LinearModel) -> ConvexProgram:
        """Return the program for another model of the same shape, without posing it anew."""
        return ConvexProgram(self.formulation, model, self._posed, self._trust)

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
        loss, penalty = self.formulation.loss, self.formulation.penalty
        r = self.model.A @ z - self.model.b
        if self.formulation.loss_over == "configuration":
            r = self.norms(z)
        fit = squared_norm(r) if loss is cp.sum_squares else float(loss(cp.Constant(r)).value)
        if penalty is None:
            return fit, 0.0
        over = self._posed.penalized(z)
        return fit, squared_norm(over) if penalty is cp.sum_squares else float(penalty(cp.Constant(over)).value)

    def norms(self, z: Array) -> Array:
        """Return the whitened norm of every configuration's residual (N,), in the order of their numbers."""
        squares = (self.model.A @ z - self.model.b) ** 2
        return np.sqrt(np.bincount(np.unique(self.model.group, return_inverse=True)[1], squares))

    def violation(self, z: Array) -> float:
        """Return by how much z misses the constraints, in units of the scales."""
        excess = float(np.max(self.norms(z))) - self.formulation.largest if self._posed.limited else 0.0
        return max(self._posed.violation(z), excess, 0.0)

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
        weight = self._weight(weight)
        posed, box = self._posed, self._posed.box
        if centre is not None and np.isfinite(radius):
            if "posed" not in self._trust:
                self._trust["posed"] = _Posed(self.formulation, self.model, trusted=True)
            posed = self._trust["posed"]
            posed.centred(centre, radius)
            if box is not None:
                box = np.maximum(box[0], centre - radius), np.minimum(box[1], centre + radius)
        polish = posed.quadratic and posed.constrained and box is not None and bool((box[0] <= box[1]).all())
        try:
            z, duals = posed.solve(self, weight)
        except NoSolutionFound:
            if not polish:
                raise
            z, duals = self._formula(weight), ()  # an interior point may fail where an active set does not
        if polish and box is not None:
            z, held = self._polished(np.clip(z, *box), weight, *box)
            duals = (held,)
        return Estimate(z, weight, *self.value(z), duals)

    def path(self, weights: Sequence[float] | Array) -> list[Estimate]:
        """Return the solutions at many weights.

        A squared loss with a squared penalty has a formula, z = V diag(s / (s^2 + weight)) U'b; where that
        meets the constraints it is the solution, and only elsewhere a program is solved.
        """
        estimates = []
        for weight in map(self._weight, weights):
            z = self._formula(weight) if self._posed.quadratic else None
            if z is not None and (self.closed_form or self.violation(z) <= 0):
                estimates.append(Estimate(z, weight, *self.value(z)))
            else:
                estimates.append(self.solve(weight))
        return estimates

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
        probe = cp.Variable(len(v))
        probe.value = np.where(np.abs(v) > 1e-6, v, 1e-6)
        slope = self.formulation.loss(probe).grad[probe]
        found = f"formulation '{self.formulation.name}'"
        if slope is None:
            raise InputError(found, "a loss without slope", "another selector: l_curve, corner, k_fold, or a number")
        weight = np.abs(np.asarray(slope.todense()).ravel()) / (2 * np.abs(probe.value))
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
        beta, s, Vt = self.model.svd
        gain = np.divide(s, s**2 + weight, out=np.zeros_like(s), where=s > 0)
        return Vt.T @ (gain * beta)

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
            step[free] = np.linalg.lstsq(A[:, free], r, rcond=1e-15)[0] if free.any() else 0.0
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


class _Posed:
    """The CVXPY problem of a shape: data and weight are its parameters, so it is canonicalized once.

    With a squared loss and a squared (or no) penalty, both terms are one squared norm: in the singular
    basis, u = D (V'z - D^-2 s U'b) with D = sqrt(s^2 + weight) gives loss + weight penalty = |u|^2 + const.
    Posed in u the program is perfectly conditioned at every weight, where posed in z an interior-point
    solver calls answers "optimal" that have no correct digit. Other losses and penalties are posed in the same u.
    """

    def __init__(self, formulation: Formulation, model: LinearModel, trusted: bool = False):
        m, n = model.A.shape
        self.n, self.formulation, self.parameters = n, formulation, model.parameters
        self.limited = np.isfinite(formulation.largest)
        self.constrained = bool(formulation.constraints) or self.limited or trusted
        whole = formulation.loss_over == "equation"
        plain = formulation.penalty_over is None
        self.quadratic = (
            formulation.loss is cp.sum_squares
            and (formulation.penalty is None or (formulation.penalty is cp.sum_squares and plain))
            and not self.limited
        )
        self.reduced = formulation.loss in ROTATION_INVARIANT and whole and not self.limited
        over = formulation.penalty_over
        self.differences = [np.asarray(D, dtype=float) for D in over(model.parameters)] if over else None
        rows = n + 1 if self.reduced else m
        u = cp.Variable(n)
        self.basis, self.centre = cp.Parameter((n, n)), cp.Parameter(n)
        self.z: Any = self.basis @ u + self.centre
        link: list[Any] = []
        if self.quadratic:
            objective = cp.sum_squares(u)
            self.constraints: list[list[Any]] = [_listed(c(self.z, model.parameters)) for c in formulation.constraints]
        else:
            self.A, self.b, self.weight = (
                cp.Parameter((rows, n)),
                cp.Parameter(rows),
                cp.Parameter(nonneg=True),
            )
            expression, self.z = self.z, cp.Variable(n)
            link = [self.z == expression]  # the penalty's weight may not multiply the basis: DPP
            r = self.A @ u - self.b
            norms = None if whole and not self.limited else _norms(r, model.group)
            objective = formulation.loss(r if whole else norms)
            if formulation.penalty is not None:
                over = self.z if plain else cp.hstack([cp.norm(D @ self.z) for D in self.differences or ()])
                objective = objective + self.weight * formulation.penalty(over)
            self.constraints = [_listed(c(self.z, model.parameters)) for c in formulation.constraints]
            if norms is not None and self.limited:
                self.constraints.append([norms <= formulation.largest])
        every: list[Any] = link + [constraint for group in self.constraints for constraint in group]
        if trusted:
            self.middle, self.radius = cp.Parameter(n), cp.Parameter(nonneg=True)
            every.append(cp.abs(self.z - self.middle) <= self.radius)
        self.problem = cp.Problem(cp.Minimize(objective), every)
        if not self.problem.is_dcp():
            raise InputError(f"formulation '{formulation.name}'", "a program that is not convex", "CVXPY's DCP rules")

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

    def penalized(self, z: Array) -> np.ndarray:
        """Return what the penalty gets: z, or the norms of its groups."""
        return z if self.differences is None else np.array([float(np.linalg.norm(D @ z)) for D in self.differences])

    def violation(self, z: Array) -> float:
        probe, checks = self._checks
        probe.value = z
        return max((float(np.max(c.violation())) for c in checks), default=0.0)

    def centred(self, centre: Array, radius: float) -> None:
        self.middle.value, self.radius.value = centre, radius

    def solve(self, program: ConvexProgram, weight: float) -> tuple[Array, tuple[Array, ...]]:
        self._set(program.model, weight)
        status = ""
        for settings in TOLERANCES:
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore", UserWarning)
                    self.problem.solve(solver=cp.CLARABEL, **settings)
                status = self.problem.status
            except cp.SolverError as error:
                status = str(error)
            if status == cp.INFEASIBLE:
                break
            if status == cp.OPTIMAL and self.z.value is not None:
                z = np.array(self.z.value)
                if program.violation(z) > max(FEASIBLE, 1e-8 * self.limited) * max(1.0, float(np.max(np.abs(z)))):
                    status = "optimal, but outside the constraints"
                    continue
                return z, tuple(self._duals(k) for k in range(len(self.formulation.constraints)))
        conflict = _conflict(program) if status in (cp.INFEASIBLE, cp.INFEASIBLE_INACCURATE) else None
        raise NoSolutionFound(program, weight, status, conflict)

    def _duals(self, k: int) -> np.ndarray:
        """Multipliers of the k-th constraint: of a box (n,), as if loosened on the side that holds."""
        values = np.concatenate([np.ravel(c.dual_value) for c in self.constraints[k]])
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

    def _set(self, model: LinearModel, weight: float) -> None:
        beta, s, Vt = model.svd
        given = weight
        if self.constrained or not self.quadratic:
            # a nominal value for unseen directions may not be the answer: let them move, at a price
            weight = max(weight, 1e-16 * s[0] ** 2) if not s.all() or not self.quadratic else weight
        D = np.sqrt(s**2 + weight)
        inverse = np.divide(1.0, D, out=np.zeros_like(D), where=D > 0)
        self.basis.value = Vt.T * inverse
        self.centre.value = Vt.T @ (inverse**2 * s * beta)
        if not self.quadratic:
            R = model.triangle if self.reduced else np.column_stack([model.A, model.b])
            self.A.value = R[:, : self.n] @ self.basis.value
            self.b.value = R[:, self.n] - R[:, : self.n] @ self.centre.value
            self.weight.value = given


class _Unposed:
    """In the place of `_Posed` for a formulation that is not solvable."""

    quadratic, limited, constrained, box = False, False, True, None

    def __init__(self, formulation: Formulation):
        self.solve = self.violation = self.penalized = lost(formulation.name)


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
def huber(threshold: float = HUBER) -> Term:
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
