"""A formulation's functions, asked once for one shape of data: private expressions that nothing outside reaches."""

from __future__ import annotations

import copy
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
from rpim_opt.convex.canonical import Canonical
from rpim_opt.convex.constraints import Box, Ready
from rpim_opt.convex.formulation import Formulation, lost
from rpim_opt.convex.solvers.solve import Loss
from rpim_opt.convex.structure import Quadratic, identity, quadratic
from rpim_opt.convex.terms import Frozen, Term, apart, fulfilled, scalar, substituted, term
from rpim_opt.convex.trust import SMALL, Trusted, trusted
from rpim_opt.problem.linear import LinearModel
from rpim_opt.robot.parameters import Parameters

INVARIANT = (SQUARES, NORM2)
"""Losses that declare to see only the length of the residual: [A b] may be replaced by its triangular factor."""
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

    A formulation whose functions declare what they are (`declared`) is asked when an expression of it is first needed:
    what a formula or an active set solves, it solves without CVXPY.

    Parameters
    ----------
    formulation
        Whose functions are asked, once.
    shape
        Of the data.
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
        self.constrained = bool(formulation.constraints) or self.limited
        if self._known:
            self.box  # noqa: B018 - limits that do not fit the parameters are refused now
        else:  # what a user's functions say may be another thing later
            self.asked  # noqa: B018

    @cached_property
    def asked(self) -> Asked:
        """The answers of the functions; asked once, whichever thread needs them first."""
        with self._lock:
            if self._answers is None:
                self._answers = ask(self.formulation, self.parameters, self.equations, self.groups)
        return self._answers

    @property
    def predicts(self) -> bool:
        """Whether constraints asked for positions, which are linear about some point."""
        return not self._known and self.asked.predicts

    @cached_property
    def constraints(self) -> list[list[Any]]:
        """The constraints of z, one list for every function."""
        return self.asked.constraints

    def on_squares(self) -> Posed:
        """Return the same penalty and constraints with the sum of squares of the equations as the loss."""
        made = copy.copy(self)
        for name in ("loss_form", "_quadratic_of_r", "loss", "joint", "inner", "order", "sizes"):
            vars(made).pop(name, None)
        formulation = replace(self.formulation, loss=SQUARES, loss_over="equation", largest=float("inf"))
        made.formulation, made.equations, made.limited = formulation, self.n + 1, False
        made.constrained = bool(formulation.constraints)
        return made

    # --- structure ---------------------------------------------------------------------------------------------

    @cached_property
    def loss_form(self) -> Quadratic | None:
        """The quadratic of r that the loss is."""
        if self.limited:
            return None
        return self._quadratic_of_r

    @cached_property
    def _quadratic_of_r(self) -> Quadratic | None:
        over_equations = self.formulation.loss_over == "equation"
        size = self.equations if over_equations else len(np.unique(self.groups))
        form = self._form(self.formulation.loss, size, "loss_term")
        if form is None or over_equations:
            return form
        if not form.diagonal or form.c.any():
            return None
        which = np.unique(self.groups, return_inverse=True)[1]
        return Quadratic(form.L[which], np.zeros(len(which)), form.constant)  # p_k v_k^2 = p_k |r_k|^2

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

    def _form(self, function: Any, size: int, of: str) -> Quadratic | None:
        """Return the quadratic that loss or penalty is of so many numbers."""
        if function == SQUARES:  # declared; a test holds it against the canonicalization
            return identity(size)
        if isinstance(function, Ready) and function.quadratic is not None:  # so does one against this
            return function.quadratic
        stated: Term = getattr(self.asked, of)
        return quadratic(stated.expression, stated.variable)

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

    @cached_property
    def canonical(self) -> Canonical:
        """Penalty and constraints of z in canonical form."""
        squares = self.formulation.penalty is None or self.penalty_form is not None
        if squares and all(isinstance(constraint, Box) for constraint in self.formulation.constraints):
            return Canonical.box(self.n, self.penalty_form, self.limits)
        penalty = self.asked.penalty if self.asked.penalty is not None else cp.Constant(0.0)
        with self._lock:
            return Canonical(penalty, self._flat, self.asked.z)

    @property
    def _flat(self) -> list[Any]:
        return [constraint for group in self.constraints for constraint in group]

    @cached_property
    def loss(self) -> Loss | None:
        """What the solver is told of a loss that is no square, or limited by ``largest``."""
        if self.loss_form is not None:
            return None
        asked, over_norms = self.asked, self.formulation.loss_over == "configuration"
        with self._lock:
            if not self.limited:
                return Loss(asked.loss_term.expression, asked.loss_term.variable, (), over_norms)
            expression = asked.loss
            if self._quadratic_of_r is not None:
                expression = cp.Constant(0.0)  # its squares are reduced
            return Loss(expression, asked.r, (self.limit_of_norms,), False)

    @cached_property
    def order(self) -> np.ndarray | None:
        """(m,) sorts equations by configurations; None where they stay as they are."""
        if self.limited or self.formulation.loss_over == "equation":
            return None
        order = np.argsort(self.groups, kind="stable")
        return order if (np.diff(order) != 1).any() else None

    @cached_property
    def sizes(self) -> np.ndarray | None:
        """(N,) equations of every configuration, where the loss gets norms."""
        if self.limited or self.formulation.loss_over == "equation":
            return None
        return np.unique(self.groups, return_counts=True)[1]

    # --- values ------------------------------------------------------------------------------------------------

    @cached_property
    def inner(self) -> list[Any]:
        """Variables of the functions' own in loss or penalty: a value is a minimum over them."""
        if self._known:
            return []
        stated = [self.asked.loss_term.expression]
        if self.asked.penalty is not None:
            stated.append(self.asked.penalty)
        ids = {v.id for each in stated for v in each.variables()}
        return [variable for variable in self.asked.own if variable.id in ids]

    @cached_property
    def joint(self) -> bool:
        """Whether the loss shares variables with penalty or constraints: then they are one program."""
        if self._known or not self.asked.own:
            return False
        own = {variable.id for variable in self.asked.own}
        of_loss = own & {v.id for v in self.asked.loss_term.expression.variables()}
        others = [*self._flat, *([] if self.asked.penalty is None else [self.asked.penalty])]
        return bool(of_loss & {v.id for each in others for v in each.variables()})

    def values(self, z: Array, r: Array, weight: float) -> tuple[float, float]:
        """Return loss and penalty at numbers; variables of the functions' own are at their best."""
        if not self.inner:
            return self.loss_of(r), self.penalty_of(z)
        with self._lock:
            if self.joint:
                return self._together(z, r, weight)
            own = {variable.id for variable in self.inner}
            loss = penalty = 0.0
            if own & {v.id for v in self.asked.loss_term.expression.variables()}:
                loss = self._fixed_loss.at_best(self.seen(r))[0]
            else:
                loss = self.loss_of(r)
            if self.asked.penalty is None:
                return loss, 0.0
            if own & {v.id for v in self.asked.penalty.variables()}:
                penalty = self._fixed_penalty.at_best(z)[0]
            else:
                penalty = self.penalty_of(z)
        return loss, penalty

    @cached_property
    def _fixed_loss(self) -> Canonical:
        return Canonical(self.asked.loss_term.expression, [], self.asked.loss_term.variable)

    @cached_property
    def _fixed_penalty(self) -> Canonical:
        own = {variable.id for variable in self.asked.own}
        tied = [c for c in self._flat if own & {v.id for v in c.variables()}]
        return Canonical(self.asked.penalty, tied, self.asked.z)

    def _together(self, z: Array, r: Array, weight: float) -> tuple[float, float]:
        """Minimize loss + weight penalty over variables that both share, z and r given."""
        asked = self.asked
        own = {variable.id for variable in asked.own}
        tied = [c for c in self._flat if own & {v.id for v in c.variables()}]
        total = asked.loss if asked.penalty is None else asked.loss + weight * asked.penalty
        instead = {id(asked.z): cp.Constant(z), id(asked.r): cp.Constant(r)}
        problem = cp.Problem(cp.Minimize(substituted(total, instead)), [substituted(c, instead) for c in tied])
        for variable in problem.variables():
            variable.save_value(None)
        problem.solve(solver=cp.CLARABEL)
        if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
            return float("inf"), 0.0
        penalty = 0.0 if asked.penalty is None else float(substituted(asked.penalty, instead).value)
        return float(substituted(asked.loss, instead).value), penalty

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
        slope = self.asked.loss_term.slope(seen)
        if slope is None or self.formulation.loss_over == "equation":
            return slope
        return (slope / np.maximum(seen, 1e-150))[self.groups] * r

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
        return apart(self.asked.penalty, self.asked.z)

    # --- what a robust loss trusts -----------------------------------------------------------------------------

    def trusted(self, norms: Array, count: np.ndarray) -> Trusted:
        """Return what the loss trusts, by its slopes at as many numbers as it keeps."""
        slope_at = (lambda _: None) if self.inner else self._slope_of_some
        return trusted(self.formulation.name, slope_at, norms, count, self.formulation.loss_over)

    def _slope_of_some(self, v: Array) -> Array | None:
        """Return the loss's slopes at numbers, the others being zero."""
        size = self.asked.loss_term.variable.size
        if size < len(v):  # posed on a triangle, which has fewer residuals than the data
            return term(self.formulation.loss, len(v), "loss").slope(v)
        slope = self.asked.loss_term.slope(np.concatenate([v, np.full(size - len(v), SMALL)]))
        if slope is None:
            return None
        return slope[: len(v)]

    @cached_property
    def limit_of_norms(self) -> Any:
        """The bound of the configurations' norms."""
        return norms(self.asked.r, self.groups) <= self.formulation.largest

    def met(self, z: Array) -> bool:
        """Whether z (n,) meets the constraints exactly; those with variables of their own are not tried."""
        with self._lock:
            if any(variable is not self.asked.z for limit in self._flat for variable in limit.variables()):
                return False
            self.asked.z.save_value(z)
            with np.errstate(all="ignore"):
                return all(fulfilled(limit) for limit in self._flat)

    def like(self, other: Posed) -> bool:
        """Whether the functions answered what they answered another time, about data of the same shape."""
        same = (self.n, self.equations) == (other.n, other.equations) and np.array_equal(self.groups, other.groups)
        return same and not self._known and self.asked.like(other.asked)


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
        self.limited, self.constrained = False, True
        self.constraints = []
        self.loss_form, self.penalty_form, self.box = loss_form, penalty_form, None
        self._known = True
        self.values = self.trusted = lost(formulation.name)

    @cached_property
    def asked(self) -> Asked:
        """Raises InputError."""
        return lost(self.formulation.name)()
