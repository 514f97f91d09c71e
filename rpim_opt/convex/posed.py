"""A formulation's functions, asked once for one shape of data: private expressions that nothing outside reaches."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.asked import Asked, ask, norms
from rpim_opt.convex.atoms import NORM2, SQUARES, cp
from rpim_opt.convex.conic import ATTEMPTS, Conic, Solution
from rpim_opt.convex.constraints import Box, Ready
from rpim_opt.convex.formulation import Formulation, lost
from rpim_opt.convex.kinks import kinks
from rpim_opt.convex.largest import Largest, of_equations, of_norms
from rpim_opt.convex.separated import Separated
from rpim_opt.convex.split import Split, split
from rpim_opt.convex.structure import Quadratic, identity, quadratic
from rpim_opt.convex.terms import Frozen, Term, apart, scalar, term
from rpim_opt.convex.trust import SMALL, Trusted, trusted
from rpim_opt.problem.linear import LinearModel
from rpim_opt.robot.parameters import Parameters

INVARIANT = (SQUARES, NORM2)
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


def declared(formulation: Formulation) -> bool:
    """Whether the functions themselves say what they are: sums of squares of all equations, in boxes of the package."""
    penalty = formulation.penalty
    return (
        formulation.ready
        and formulation.loss == SQUARES
        and formulation.loss_over == "equation"
        and not np.isfinite(formulation.largest)
        and formulation.penalty_over is None
        and (penalty in (None, SQUARES) or (isinstance(penalty, Ready) and penalty.quadratic is not None))
        and all(isinstance(constraint, Box) for constraint in formulation.constraints)
    )


class Posed:
    """Loss, penalty and constraints of a formulation as CVXPY expressions of a residual r and of z.

    Parameters
    ----------
    formulation
        Whose functions are asked, once.
    shape
        Of the data.

    A formulation whose functions declare what they are (`declared`) is asked when an expression of it is first needed:
    what a formula solves, it solves without CVXPY.
    """

    def __init__(self, formulation: Formulation, shape: Shape):
        self.formulation, self.parameters = formulation, shape.parameters
        self.n = shape.unknowns
        self.groups = shape.groups
        self.limited = bool(np.isfinite(formulation.largest))
        self.equations = shape.equations
        self._lock = threading.RLock()
        self._answers: Asked | None = None
        self._known = declared(formulation)
        self.speeds: dict[int, Array] = {}  # of constraints whose gradient is the same everywhere, by their id
        if self._known:
            self.box  # noqa: B018 - limits that do not fit the parameters are refused now
        else:  # what a user's functions say may be another thing later
            self.asked  # noqa: B018
        self.constrained = bool(formulation.constraints) or self.limited

    @cached_property
    def asked(self) -> Asked:
        """The answers of the functions; asked once, whichever thread needs them first."""
        with self._lock:
            if self._answers is None:
                self._answers = ask(self.formulation, self.parameters, self.equations, self.groups)
        return self._answers

    @cached_property
    def z(self) -> cp.Variable:
        """The variable (n,) of penalty and constraints."""
        return self.asked.z

    @cached_property
    def r(self) -> cp.Variable:
        """The variable (m,) of the loss."""
        return self.asked.r

    @cached_property
    def loss(self) -> Any:
        """The loss, an expression of r."""
        return self.asked.loss

    @cached_property
    def penalty(self) -> Any:
        """The penalty, an expression of z; None where there is none."""
        return self.asked.penalty

    @cached_property
    def constraints(self) -> list[list[Any]]:
        """The constraints of z, one list for every function."""
        return self.asked.constraints

    @cached_property
    def own(self) -> list[cp.Variable]:
        """Variables that the functions brought along."""
        return self.asked.own

    @cached_property
    def predicts(self) -> bool:
        """Whether constraints asked for positions, which are linear about some point."""
        return not self._known and self.asked.predicts

    @cached_property
    def live(self) -> tuple[Any, Any, list[list[Any]]]:
        """Loss, penalty and constraints with the user's own parameters, and no copies of them."""
        return self.asked.live

    # --- structure ---------------------------------------------------------------------------------------------

    @cached_property
    def loss_form(self) -> Quadratic | None:
        """The quadratic of r that the loss is."""
        if self.limited:
            return None
        form = self._form(self.formulation.loss, self._sees, "loss_term")
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

        rows = rows_of(self.asked.loss_term.expression, self.asked.loss_term.variable)
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
    def worst(self) -> Largest | None:
        """The largest of equations or configurations, in their `order`, that the loss is; None for other losses."""
        if self.limited or self.inner or self.loss_form is not None:
            return None
        if len(self.groups) != self.r.size:
            return None
        from rpim_opt.convex.tree import largest_of  # as above

        term = self.asked.loss_term
        found = largest_of(term.expression, term.variable)
        if found is None:
            return None
        if self.formulation.loss_over == "equation":
            return of_equations(found, len(self.groups))
        return of_norms(found, np.flatnonzero(np.diff(self.groups[self.order], prepend=-1)), len(self.groups))

    @cached_property
    def order(self) -> np.ndarray:
        """(m,) equations in the order of their configurations; as they are, where the loss knows each by its place."""
        if self.formulation.loss_over == "equation":
            return np.arange(len(self.groups))
        return np.argsort(self.groups, kind="stable")

    @cached_property
    def penalty_form(self) -> Quadratic | None:
        """The quadratic of z that the penalty is."""
        if self.formulation.penalty is None:
            return None
        if self.formulation.penalty_over is None:
            return self._form(self.formulation.penalty, self.n, "penalty_term")
        differences = self.asked.differences
        form = self._form(self.formulation.penalty, len(differences), "penalty_term")
        if form is None or not form.diagonal or form.c.any():
            return None
        L = np.vstack([root * D for root, D in zip(form.L, differences, strict=True)])
        return Quadratic(L, np.zeros(len(L)), form.constant)

    @cached_property
    def split(self) -> Split | None:
        """The unknowns in which the penalty is a sum of absolute values and norms; None where there are none such."""
        if self.penalty_form is not None or self.box is None or self.inner or self.penalty is None:
            return None
        z = cp.Variable(self.n)
        found = kinks(self.penalty.tree_copy({id(self.z): z}), z)
        if found is None:
            return None
        return split(found)

    @property
    def _sees(self) -> int:
        """Of how many numbers the loss is a function."""
        if self.formulation.loss_over == "equation":
            return self.equations
        return len(np.unique(self.groups))

    def _form(self, function: Any, size: int, of: str) -> Quadratic | None:
        """Return the quadratic that loss or penalty is of so many numbers."""
        if function == SQUARES:  # declared; a test holds it against the canonicalization
            return identity(size)
        if isinstance(function, Ready) and function.quadratic is not None:  # so does one against this
            return function.quadratic
        term: Term = getattr(self.asked, of)
        return quadratic(term.expression, term.variable)

    @cached_property
    def limits(self) -> list[tuple[Array, Array]]:
        """Lower and upper bounds (n,) of every `Box`, in the order in which they are stated."""
        boxes = [constraint for constraint in self.formulation.constraints if isinstance(constraint, Box)]
        return [box.bounds(self.parameters) for box in boxes]

    @cached_property
    def box(self) -> tuple[Array, Array] | None:
        """Lower and upper bounds (n,) where every constraint is a `Box`, infinite where there is none."""
        lower, upper = np.full(self.n, -np.inf), np.full(self.n, np.inf)
        if any(not isinstance(constraint, Box) for constraint in self.formulation.constraints):
            return None
        for low, high in self.limits:
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
        if self._known:
            return []
        ids = {v.id for term in (self.loss, self.penalty) if term is not None for v in term.variables()}
        return [variable for variable in self.own if variable.id in ids]

    def loss_of(self, r: Array) -> float:
        """Return the loss of a residual (m,)."""
        if self.formulation.loss == SQUARES:
            return float(r @ r)
        return self.asked.loss_term(self.seen(r))

    def penalty_of(self, z: Array) -> float:
        """Return the penalty of z (n,)."""
        if self.formulation.penalty is None:
            return 0.0
        if self.formulation.penalty_over is not None:
            z = np.array([float(np.linalg.norm(D @ z)) for D in self.asked.differences])
        if self.formulation.penalty == SQUARES:
            return float(z @ z)
        if self._declared is not None:
            return self._declared.value(z)
        return self.asked.penalty_term(z)

    @cached_property
    def _declared(self) -> Quadratic | None:
        """The quadratic of z that a penalty of the package's own declares to be."""
        penalty = self.formulation.penalty
        if isinstance(penalty, Ready) and self.formulation.penalty_over is None:
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
        if self.formulation.loss == SQUARES:  # of the residual or of its configurations' norms
            return 2 * r
        seen = self.seen(r)
        slope = self.slope_seen(seen)
        if slope is None or self.formulation.loss_over == "equation":
            return slope
        return (slope / np.maximum(seen, TINY))[self.groups] * r

    def slope_seen(self, seen: Array) -> Array | None:
        """Return the gradient of the loss by what it gets, residuals or norms; None where CVXPY knows none."""
        return self.asked.loss_term.slope(seen)

    def loss_of_norms(self, v: Array) -> float:
        """Return a loss of the configurations' norms (N,)."""
        return self.asked.loss_term(v)

    def row_slopes(self, v: Array) -> Array | None:
        """Return the gradient of the loss by what it gets: residuals (m,) or configurations' norms (N,)."""
        if self.inner or self.asked.loss_term.variable.size != len(v):
            return None
        return self.asked.loss_term.slope(v)

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
        size = self.asked.loss_term.variable.size
        if size < len(v):  # posed on a triangle, which has fewer residuals than the data
            return term(self.formulation.loss, len(v), "loss").slope(v)
        slope = self.asked.loss_term.slope(np.concatenate([v, np.full(size - len(v), SMALL)]))
        if slope is None:
            return None
        return slope[: len(v)]

    def penalty_slope(self, z: Array) -> Array | None:
        """Return the gradient (n,) of the penalty by z; None where CVXPY knows none."""
        if self.inner or self.formulation.penalty is None:
            return None
        if self.formulation.penalty == SQUARES and self.formulation.penalty_over is None:
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


def posed(formulation: Formulation, model: LinearModel) -> Posed:
    """Return the formulation posed for the shape of a model; a ready one may have been posed before."""
    m, n = model.A.shape
    if model.stands_for is not None:
        formulation = _for_triangle(formulation, model.equations)
    if formulation.loss in INVARIANT and formulation.loss_over == "equation" and not np.isfinite(formulation.largest):
        m = n + 1  # rows of the triangle say all
    groups = model.members[0]
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
    if not invariant(formulation, lambda: equations):
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


def invariant(formulation: Formulation, equations: Callable[[], int]) -> bool:
    """Return whether the loss sees only the length of the whole residual: the triangle of [A b] then says all.

    How many equations there are is only asked where it matters: of tables, they would be read for it.
    """
    if formulation.loss_over != "equation" or np.isfinite(formulation.largest):
        return False
    if formulation.loss in INVARIANT:
        return True
    if formulation.ready:
        return False
    count = equations()
    if count > FEW:
        return False
    form = _loss_form(formulation, count)
    return form is not None and form.diagonal and not form.c.any() and bool(np.ptp(form.L) == 0)


def _loss_form(formulation: Formulation, equations: int) -> Quadratic | None:
    """Return the quadratic that a loss is of so many residuals; None where it is something else."""
    r = cp.Variable(equations)
    where = f"formulation '{formulation.name}', loss"
    try:
        return quadratic(Frozen([r], where)(scalar(formulation.loss(r), where)), r)
    except ValueError:  # it is made for another number of residuals
        return None


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
        self.groups = model.members[0]
        self.equations = len(model.b)
        self.limited, self.constrained, self.predicts = False, True, False
        self.constraints, self.own = [], []
        self.loss_form, self.penalty_form, self.box, self.split = loss_form, penalty_form, None, None
        self._known = False
        self.live: Any = lost(formulation.name)
        self.loss = self.penalty = self.values = self.trusted = self.conic = lost(formulation.name)
