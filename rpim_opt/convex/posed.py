"""A formulation's functions, asked once for one shape of data: private expressions that nothing outside reaches."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import cvxpy as cp
import numpy as np
from scipy.sparse import csr_array

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.conic import ATTEMPTS, Conic, Solution
from rpim_opt.convex.constraints import Box, Ready
from rpim_opt.convex.formulation import Formulation, lost
from rpim_opt.convex.given import Given, Unknown
from rpim_opt.convex.given import given as told
from rpim_opt.convex.kinks import kinks
from rpim_opt.convex.separated import Separated
from rpim_opt.convex.split import Split, split
from rpim_opt.convex.structure import Quadratic, identity, quadratic
from rpim_opt.convex.terms import Frozen, Term, apart, listed, reason, scalar, term
from rpim_opt.convex.trust import SMALL, Trusted, trusted
from rpim_opt.problem.linear import LinearModel
from rpim_opt.robot.parameters import Parameters

INVARIANT = (cp.sum_squares, cp.norm2)
"""Losses that declare to see only the length of the residual: [A b] may be replaced by its triangular factor."""
TINY = 1e-150
"""Norms below have no direction."""
FEW = 20_000
"""Equations up to which another loss is canonicalized to see whether it is one of those."""


@dataclass(frozen=True)
class Shape:
    """What a posed formulation depends on, besides its functions; the data of a calibration are no part of it."""

    unknowns: int
    equations: int
    group: bytes
    signature: tuple[Any, ...]
    parameters: Parameters = field(compare=False)
    groups: np.ndarray = field(compare=False)


class Posed:
    """Loss, penalty and constraints of a formulation as CVXPY expressions of a residual r and of z.

    Parameters
    ----------
    formulation
        Whose functions are asked, once.
    shape
        Of the data.

    Attributes
    ----------
    z, r
        The variables (n,) and (m,).
    loss, penalty
        Expressions of r and z; penalty is None where there is none.
    constraints
        Of z, one list for every function.
    predicts
        Whether constraints asked for positions, which are linear about some point.
    own
        Variables that the functions brought along.
    loss_form, penalty_form
        The quadratics that loss (of r) and penalty (of z) are; None where they are something else.
    """

    def __init__(self, formulation: Formulation, shape: Shape):
        self.formulation, self.parameters = formulation, shape.parameters
        self.n = shape.unknowns
        self.groups = shape.groups
        self.limited = bool(np.isfinite(formulation.largest))
        self.z = Unknown(self.parameters.names)
        self.r = cp.Variable(shape.equations, name="r")
        self._lock = threading.Lock()
        self._ask()
        self.constrained = bool(formulation.constraints) or self.limited

    def _ask(self) -> None:
        """Ask the functions, and keep copies of what they answered."""
        f, where = self.formulation, f"formulation '{self.formulation.name}'"
        seen = self.r
        if f.loss_over == "configuration":
            seen = cp.Variable(len(np.unique(self.groups)))
        self._differences: list[Array] = []
        given = self.z
        if f.penalty_over is not None:
            self._differences = [np.asarray(D, dtype=float) for D in f.penalty_over(self.parameters)]
            given = cp.Variable(len(self._differences))
        copy = Frozen([self.z, self.r, seen, given], where)
        live_loss = scalar(f.loss(seen), f"{where}, loss")
        self._loss_term = Term(copy(live_loss), seen)
        live_penalty = None
        self._penalty_term: Term | None = None
        if f.penalty is not None:
            live_penalty = scalar(f.penalty(given), f"{where}, penalty")
            self._penalty_term = Term(copy(live_penalty), given)
        known = told(self.z, self.parameters)
        live = [self._listed(c, known, f"{where}, {called(c, k)}") for k, c in enumerate(f.constraints)]
        self.predicts = bool(known.asked)
        self.constraints = [[copy(each) for each in group] for group in live]
        self.own = copy.own
        self.live = (self._over_r(live_loss, seen), self._over_z(live_penalty, given), live)
        self.loss = self._over_r(self._loss_term.expression, seen)
        self.penalty = None
        if self._penalty_term is not None:
            self.penalty = self._over_z(self._penalty_term.expression, given)
        for part, expression in (("loss", self.loss), ("penalty", self.penalty)):
            if expression is not None and not expression.is_convex():
                found = "a program that is not convex"
                accepted = f"CVXPY's DCP rules: nondecreasing over norms; {reason(expression)}"
                raise InputError(f"{where}, {part}", found, accepted)

    def _listed(self, constraint: Any, known: Given, where: str) -> list[Any]:
        return listed(constraint(self.z, known), where)

    def _over_r(self, expression: Any, seen: cp.Variable) -> Any:
        """Return the loss as a function of r."""
        if seen is self.r:
            return expression
        return expression.tree_copy({id(seen): norms(self.r, self.groups)})

    def _over_z(self, expression: Any, given: cp.Variable) -> Any:
        """Return the penalty as a function of z."""
        if expression is None or given is self.z:
            return expression
        return expression.tree_copy({id(given): cp.hstack([cp.norm(D @ self.z) for D in self._differences])})

    # --- structure ---------------------------------------------------------------------------------------------

    @cached_property
    def loss_form(self) -> Quadratic | None:
        """The quadratic of r that the loss is."""
        if self.limited:
            return None
        form = self._form(self.formulation.loss, self._loss_term)
        if form is None or self.formulation.loss_over == "equation":
            return form
        if not form.diagonal or form.c.any():
            return None
        which = np.unique(self.groups, return_inverse=True)[1]
        return Quadratic(form.L[which], np.zeros(len(which)), form.constant)  # p_k v_k^2 = p_k |r_k|^2

    @cached_property
    def separated(self) -> Separated | None:
        """The sum over equations or configurations, in their `order`, that the loss is; None for other losses."""
        if self.limited or self.inner or self.loss_form is not None:
            return None
        from rpim_opt.convex.tree import rows_of  # CVXPY's tree is read where a loss is none of the squares

        rows = rows_of(self._loss_term.expression, self._loss_term.variable)
        if rows is None:
            return None
        starts = None
        if self.formulation.loss_over == "configuration":
            starts = np.flatnonzero(np.diff(self.groups[self.order], prepend=-1))
        made = Separated(rows, starts, len(self.groups))
        if made.count == self.r.size and made.holds:
            return made
        return None

    @cached_property
    def order(self) -> np.ndarray:
        """(m,) equations in the order of their configurations."""
        return np.argsort(self.groups, kind="stable")

    @cached_property
    def penalty_form(self) -> Quadratic | None:
        """The quadratic of z that the penalty is."""
        if self._penalty_term is None:
            return None
        form = self._form(self.formulation.penalty, self._penalty_term)
        if form is None or not self._differences:
            return form
        if not form.diagonal or form.c.any():
            return None
        L = np.vstack([root * D for root, D in zip(form.L, self._differences, strict=True)])
        return Quadratic(L, np.zeros(len(L)), form.constant)

    @cached_property
    def split(self) -> Split | None:
        """The unknowns in which the penalty is a sum of absolute values and norms; None where there are none such."""
        if self.penalty is None or self.penalty_form is not None or self.box is None or self.inner:
            return None
        z = cp.Variable(self.n)
        found = kinks(self.penalty.tree_copy({id(self.z): z}), z)
        if found is None:
            return None
        return split(found)

    def _form(self, function: Any, term: Term) -> Quadratic | None:
        if function is cp.sum_squares:  # declared; a test holds it against the canonicalization
            return identity(term.variable.size)
        if isinstance(function, Ready) and function.quadratic is not None:  # so does one against this
            return function.quadratic
        return quadratic(term.expression, term.variable)

    @cached_property
    def box(self) -> tuple[Array, Array] | None:
        """Lower and upper bounds (n,) where every constraint is a `Box`, infinite where there is none."""
        lower, upper = np.full(self.n, -np.inf), np.full(self.n, np.inf)
        for constraint in self.formulation.constraints:
            if not isinstance(constraint, Box):
                return None
            low, high = constraint.bounds(self.parameters)
            lower, upper = np.maximum(lower, low), np.minimum(upper, high)
        if self.limited or (lower > upper).any():
            return None
        return lower, upper

    # --- values ------------------------------------------------------------------------------------------------

    def values(self, z: Array, r: Array, weight: float) -> tuple[float, float]:
        """Return loss and penalty at numbers; variables of the functions' own are at their best."""
        if self.inner:
            return self._best(z, r, weight)
        return self.loss_of(r), self.penalty_of(z)

    @cached_property
    def inner(self) -> list[cp.Variable]:
        """Variables of the functions' own in loss or penalty: a value is a minimum over them."""
        ids = {v.id for term in (self.loss, self.penalty) if term is not None for v in term.variables()}
        return [variable for variable in self.own if variable.id in ids]

    def loss_of(self, r: Array) -> float:
        """Return the loss of a residual (m,)."""
        if self.formulation.loss is cp.sum_squares:
            return float(r @ r)
        return self._loss_term(self.seen(r))

    def penalty_of(self, z: Array) -> float:
        """Return the penalty of z (n,)."""
        if self._penalty_term is None:
            return 0.0
        if self._differences:
            z = np.array([float(np.linalg.norm(D @ z)) for D in self._differences])
        if self.formulation.penalty is cp.sum_squares:
            return float(z @ z)
        if self._declared is not None:
            return self._declared.value(z)
        return self._penalty_term(z)

    @cached_property
    def _declared(self) -> Quadratic | None:
        """The quadratic of z that a penalty of the package's own declares to be."""
        penalty = self.formulation.penalty
        if isinstance(penalty, Ready) and not self._differences:
            return penalty.quadratic
        return None

    def seen(self, r: Array) -> Array:
        """Return what the loss gets of a residual: itself, or the norms of the configurations."""
        if self.formulation.loss_over == "equation":
            return r
        return np.sqrt(np.bincount(self.groups, r**2))

    def loss_slope(self, r: Array) -> Array | None:
        """Return the gradient (m,) of the loss by the residual; None where CVXPY knows none."""
        if self.inner:
            return None
        if self.formulation.loss is cp.sum_squares:  # of the residual or of its configurations' norms
            return 2 * r
        seen = self.seen(r)
        slope = self.slope_seen(seen)
        if slope is None or self.formulation.loss_over == "equation":
            return slope
        return (slope / np.maximum(seen, TINY))[self.groups] * r

    def slope_seen(self, seen: Array) -> Array | None:
        """Return the gradient of the loss by what it gets, residuals or norms; None where CVXPY knows none."""
        return self._loss_term.slope(seen)

    def loss_of_norms(self, v: Array) -> float:
        """Return a loss of the configurations' norms (N,)."""
        return self._loss_term(v)

    def row_slopes(self, v: Array) -> Array | None:
        """Return the gradient of the loss by what it gets: residuals (m,) or configurations' norms (N,)."""
        if self.inner or self._loss_term.variable.size != len(v):
            return None
        return self._loss_term.slope(v)

    def trusted(self, norms: Array, count: np.ndarray, residuals: Array) -> Trusted:
        """Return what the loss trusts, by its slopes at as many numbers as it keeps."""
        name = self.formulation.name
        if self.inner:
            return trusted(name, lambda _: None, norms, count, None)
        if self.formulation.loss_over == "configuration":
            return trusted(name, self._slope_of_some, norms, count, None)
        return trusted(name, self._slope_of_some, norms, count, residuals)

    def _slope_of_some(self, v: Array) -> Array | None:
        """Return the loss's slopes at numbers, the others being zero."""
        size = self._loss_term.variable.size
        if size < len(v):  # posed on a triangle, which has fewer residuals than the data
            return term(self.formulation.loss, len(v), "loss").slope(v)
        slope = self._loss_term.slope(np.concatenate([v, np.full(size - len(v), SMALL)]))
        if slope is None:
            return None
        return slope[: len(v)]

    def penalty_slope(self, z: Array) -> Array | None:
        """Return the gradient (n,) of the penalty by z; None where CVXPY knows none."""
        if self.inner or self.penalty is None:
            return None
        if self.formulation.penalty is cp.sum_squares and not self._differences:
            return 2 * z
        if self._declared is not None:
            return 2 * self._declared.matrix.T @ (self._declared.times(z) - self._declared.c)
        return self._penalty_of_z.slope(z)

    @cached_property
    def _penalty_of_z(self) -> Term:
        return apart(self.penalty, self.z)

    def _best(self, z: Array, r: Array, weight: float) -> tuple[float, float]:
        """Minimize over the functions' own variables, z and r given."""
        given = np.concatenate([z, r])
        found = self._inner_solution(given, weight)
        if found is None:
            return float("inf"), 0.0
        with self._lock:
            for variable in self.own:
                variable.save_value(self._inner_program.values(found, variable))
            self.z.save_value(z)
            self.r.save_value(r)
            loss = float(self.loss.value)
            penalty = 0.0
            if self.penalty is not None:
                penalty = float(self.penalty.value)
        return loss, penalty

    def _inner_solution(self, given: Array, weight: float) -> Solution | None:
        """Return the functions' own variables at their best, z and r given; None where nothing solves for them."""
        nothing = np.zeros((len(given), 0))
        for attempt in range(len(ATTEMPTS)):  # with all data given, one factorization in three stalls
            found = self._inner_program.solve(nothing, given, weight, np.empty((0, 0)), np.empty(0), attempt=attempt)
            if found.status == cp.OPTIMAL:
                return found
        return None

    @cached_property
    def _inner_program(self) -> Conic:
        own = {variable.id for variable in self.own}
        tied = [c for group in self.constraints for c in group if own & {v.id for v in c.variables()}]
        objective, weight = self._objective(self.loss, self.penalty)
        return Conic(objective, tied, [self.z, self.r], weight)

    # --- programs ----------------------------------------------------------------------------------------------

    def conic(self, loss_apart: bool, penalty_apart: bool) -> Conic:
        """Return the program in (z, r); a loss or penalty ``apart`` is left out, a quadratic that is added later."""
        key = (loss_apart, penalty_apart)
        if key not in self._conics:
            self._conics[key] = self._made(*key)
        return self._conics[key]

    @cached_property
    def _conics(self) -> dict[tuple[bool, bool], Conic]:
        return {}

    def _made(self, loss_apart: bool, penalty_apart: bool) -> Conic:
        loss = cp.Constant(0.0) * cp.sum(self.z) if loss_apart else self.loss
        penalty = None if penalty_apart else self.penalty
        objective, weight = self._objective(loss, penalty)
        return Conic(objective, self.all_constraints, [self.z, self.r], weight)

    def _objective(
        self, loss: cp.Expression, penalty: cp.Expression | None
    ) -> tuple[cp.Expression, cp.Parameter | None]:
        if penalty is None:
            return loss, None
        weight = cp.Parameter(nonneg=True)
        return loss + weight * penalty, weight

    @cached_property
    def projection(self) -> Conic:
        """The constraints of z alone, with nothing to minimize yet: the distance from a point is added to it."""
        every = [constraint for group in self.constraints for constraint in group]
        return Conic(cp.Constant(0.0) * cp.sum(self.z), every, [self.z, self.r], None)

    @cached_property
    def all_constraints(self) -> list[Any]:
        """The constraints of z, and of r where ``largest`` bounds it."""
        every = [constraint for group in self.constraints for constraint in group]
        if self.limited:
            every.append(self.largest)
        return every

    @cached_property
    def largest(self) -> Any:
        """The bound of the configurations' norms."""
        return norms(self.r, self.groups) <= self.formulation.largest


def called(constraint: Any, k: int) -> str:
    """Return what a person calls the constraint function number k."""
    name = getattr(constraint, "name", getattr(constraint, "__name__", "<lambda>"))
    if name == "<lambda>":
        return f"constraint {k + 1}"
    return str(name)


def posed(formulation: Formulation, model: LinearModel) -> Posed:
    """Return the formulation posed for the shape of a model; a ready one may have been posed before."""
    m, n = model.A.shape
    if model.stands_for is not None:
        formulation = _for_triangle(formulation, model.equations)
    if formulation.loss in INVARIANT and formulation.loss_over == "equation" and not np.isfinite(formulation.largest):
        m = n + 1  # rows of the triangle say all
    groups = np.unique(model.group, return_inverse=True)[1]
    p = model.parameters
    signature: tuple[Any, ...] = ()
    if formulation.constraints or formulation.penalty_over is not None:
        signature = (p.names, p.dimensions, p.nominal.tobytes(), p.scale.tobytes(), p.tolerance.tobytes())
    shape = Shape(n, m, groups.tobytes(), signature, p, groups)
    if formulation.ready:
        return _kept(formulation, shape)
    return Posed(formulation, shape)


def _for_triangle(formulation: Formulation, equations: int) -> Formulation:
    """Return a formulation whose loss means of a triangle what it means of the equations that the triangle stands for.

    A loss may ask how many residuals there are: a mean square of the equations is no mean of the triangle's rows.
    """
    if not invariant(formulation, equations):
        found = f"formulation '{formulation.name}'"
        raise InputError(found, "equations of which only the triangle is kept", "a squared loss")
    form = None
    if formulation.loss not in INVARIANT:
        form = _loss_form(formulation, equations)
    if form is None:
        return formulation
    factor, constant = float(form.L[0] ** 2), form.constant
    return replace(formulation, loss=lambda r: factor * cp.sum_squares(r) + constant)


@lru_cache(maxsize=64)
def _kept(formulation: Formulation, shape: Shape) -> Posed:
    return Posed(formulation, shape)


def invariant(formulation: Formulation, equations: int) -> bool:
    """Return whether the loss sees only the length of the whole residual: the triangle of [A b] then says all."""
    if formulation.loss_over != "equation" or np.isfinite(formulation.largest):
        return False
    if formulation.loss in INVARIANT:
        return True
    if formulation.ready or equations > FEW:
        return False
    form = _loss_form(formulation, equations)
    return form is not None and form.diagonal and not form.c.any() and bool(np.ptp(form.L) == 0)


def _loss_form(formulation: Formulation, equations: int) -> Quadratic | None:
    """Return the quadratic that a loss is of so many residuals; None where it is something else."""
    r = cp.Variable(equations)
    where = f"formulation '{formulation.name}', loss"
    try:
        return quadratic(Frozen([r], where)(scalar(formulation.loss(r), where)), r)
    except ValueError:  # it is made for another number of residuals
        return None


def configuration_norms(r: Array, groups: np.ndarray) -> Array:
    """Return the norm of every configuration's part of a residual (m,), in the order of their numbers."""
    which = np.unique(groups, return_inverse=True)[1]
    return np.sqrt(np.bincount(which, r**2))


def norms(r: Any, group: np.ndarray) -> Any:
    """Return the norms of a residual (m,) by group in CVXPY, in the order of the groups' numbers."""
    _, which, count = np.unique(group, return_inverse=True, return_counts=True)
    order = np.argsort(which, kind="stable")
    place = np.empty(len(group), dtype=int)
    place[order] = np.arange(len(group)) - np.repeat(np.cumsum(count) - count, count)
    shape = (len(count), int(count.max()))  # shorter groups are filled with zeros
    at = (which * shape[1] + place, np.arange(len(group)))
    pick = csr_array((np.ones(len(group)), at), (shape[0] * shape[1], len(group)))
    return cp.norm(cp.reshape(pick @ r, shape, order="C"), 2, axis=1)


class Unposed(Posed):
    """In the place of `Posed` for a formulation whose functions a file could not hold: asking them is an error.

    Of the functions only the quadratics may be known that loss and penalty were.
    """

    def __init__(
        self,
        formulation: Formulation,
        model: LinearModel,
        loss_form: Quadratic | None = None,
        penalty_form: Quadratic | None = None,
    ):
        self.formulation, self.parameters = formulation, model.parameters
        self.n = model.A.shape[1]
        self.groups = np.unique(model.group, return_inverse=True)[1]
        self.z, self.r = cp.Variable(self.n), cp.Variable(len(model.b))
        self.limited, self.constrained, self.predicts = False, True, False
        self.constraints, self.own = [], []
        self.loss_form, self.penalty_form, self.box, self.split = loss_form, penalty_form, None, None
        self._penalty_term = None
        self.live = self.loss = self.penalty = self.values = self.trusted = self.conic = lost(formulation.name)
