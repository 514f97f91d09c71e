"""Expressions of a formulation for data of one shape, and the structure that selects the solver.

A user's functions are called when a program is posed (`pose`), never by `Program.on`; a loss is also called by
`expressions.term` where its values or slopes are needed at numbers: for blocks of rows, and for the inliers of a robust
loss.

CVXPY canonicalizes penalty and constraints once per `Structure` (`canonical`), a loss once if Clarabel takes all its
rows (`Loss.canonical`), and entries of a non-smooth loss for every working set (`Loss.some`). A user's quadratic is
also recognized by its canonical form, and the last resort (`Program.solve`) canonicalizes again. Structures, warm
starts and Clarabel's solvers are shared by all programs that `Program.on` derives from one another.
"""

from __future__ import annotations

import copy
import threading
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.arguments import arguments_of
from rpim_opt.convex.constraints import Box, Ready, name_of
from rpim_opt.convex.expressions import (
    NORM2,
    SQUARES,
    Frozen,
    Term,
    called,
    cp,
    listed,
    minimized,
    norms,
    reason,
    scalar,
    substituted,
)
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.quadratic import Quadratic, identity, quadratic
from rpim_opt.convex.robust_loss import QuadraticModel, separable
from rpim_opt.convex.solvers.conic import Canonical
from rpim_opt.convex.solvers.separable import Loss
from rpim_opt.robot.parameters import Parameters

INVARIANT = (SQUARES, NORM2)
"""Losses that depend only on the residual's length: [A b] may be replaced by its QR factor."""
TIGHT = {"tol_gap_abs": 1e-10, "tol_gap_rel": 1e-10, "tol_feas": 1e-10}
"""Clarabel's tolerances for the functions' own variables."""


class Expressions:
    """Expressions that a formulation's functions return, with private copies of the user's parameters and variables.

    ``loss`` and ``penalty`` are expressions of their arguments (residuals or norms, z or norms of groups),
    ``penalty_of_z`` and ``constraints``, one list per function, of z; ``live`` are loss, penalty and constraints with
    the user's own parameters.
    """

    def __init__(self, formulation: Formulation, parameters: Parameters, equations: int, groups: np.ndarray):
        from rpim_opt.convex.unknown import Unknown  # imports CVXPY

        where = f"formulation '{formulation.name}'"
        z = self.z = Unknown(parameters.names)
        r = self.r = cp.Variable(equations, name="r")
        argument: cp.Variable = r
        if formulation.loss_over == "configuration":
            argument = cp.Variable(len(np.unique(groups)))
        self.differences: list[Array] = []
        penalized: cp.Variable = z
        instead: dict[int, Any] = {}
        if formulation.penalty_over is not None:
            self.differences = [np.asarray(D, dtype=float) for D in formulation.penalty_over(parameters)]
            n = len(parameters)
            for D in self.differences:
                if D.shape[1:] != (n,):
                    accepted = f"matrices of shape (k, {n}): a column for each identified parameter"
                    raise InputError("penalty_over", f"a matrix of shape {D.shape}", accepted)
            penalized = cp.Variable(len(self.differences))
            which = np.repeat(np.arange(len(self.differences)), [len(D) for D in self.differences])
            instead = {id(penalized): norms(np.vstack(self.differences) @ z, which)}
        frozen = Frozen([z, r, argument, penalized], where)
        live_loss = scalar(called(formulation.loss, f"{where}, loss", argument), f"{where}, loss")
        self.loss = Term(frozen(live_loss), argument)
        live_penalty: Any = None
        self.penalty: Any = None
        self.penalty_of_z: Any = None
        if formulation.penalty is not None:
            stated = scalar(called(formulation.penalty, f"{where}, penalty", penalized), f"{where}, penalty")
            self.penalty = Term(frozen(stated), penalized)
            live_penalty, self.penalty_of_z = (
                substituted(each, instead) if instead else each for each in (stated, self.penalty.expression)
            )
        known = arguments_of(z, parameters)
        live = []
        for k, constraint in enumerate(formulation.constraints):
            of = f"{where}, {name_of(constraint, k)}"
            live.append(listed(called(constraint, of, z, known), of))
        composed = {"penalty": self.penalty_of_z} if instead and self.penalty is not None else {}
        if argument is not r:  # norms are convex and nonnegative, like absolute values
            composed["loss"] = substituted(self.loss.expression, {id(argument): cp.abs(cp.Variable(argument.size))})
        for what, expression in composed.items():
            if not expression.is_convex():
                accepted = f"CVXPY's DCP rules: nondecreasing over norms; {reason(expression)}"
                raise InputError(f"{where}, {what}", "a program that is not convex", accepted)
        self.constraints = [[frozen(each) for each in group] for group in live]
        self.flat = [constraint for group in self.constraints for constraint in group]
        self.own = {variable.id for variable in frozen.own}
        self.live: tuple[Any, ...] = (live_loss, live_penalty, live)
        self.predicts = bool(known.nonlinear)

    def owned(self, *stated: Any) -> set[int]:
        """Return the ids of the functions' own variables in some expressions and constraints."""
        return self.own & {v.id for each in stated if each is not None for v in each.variables()}


def declared_form(function: Any, size: int) -> Quadratic | None:
    """Return the quadratic form that one of the package's own functions declares, for a given size."""
    if function == SQUARES:
        return identity(size)
    if isinstance(function, Ready):
        return function.quadratic
    return None


def declared(formulation: Formulation) -> bool:
    """Whether the functions declare their structure: quadratic forms of the equations and of z, with boxes."""
    return (
        formulation.ready
        and formulation.loss == SQUARES
        and formulation.loss_over == "equation"
        and formulation.penalty_over is None
        and (formulation.penalty is None or declared_form(formulation.penalty, 1) is not None)
        and all(isinstance(constraint, Box) for constraint in formulation.constraints)
    )


class Structure:
    """A formulation for data of one shape: its functions' expressions of r and z, their structure and their values.

    The functions of a `declared` formulation are called when an expression is first needed: a closed form or an active
    set needs no CVXPY. Without the functions (read from a file that cannot hold them) the ``forms`` of loss and penalty
    may be known; anything else raises InputError.
    """

    def __init__(
        self,
        formulation: Formulation,
        parameters: Parameters,
        equations: int,
        groups: np.ndarray,
        forms: Sequence[Quadratic | None] | None = None,
    ):
        self.formulation, self.parameters = formulation, parameters
        self.n, self.equations, self.groups = len(parameters), equations, groups
        self.constrained = bool(formulation.constraints) or not formulation.solvable
        self._lock = threading.RLock()
        self._called: Expressions | None = None
        self._declared = declared(formulation) or not formulation.solvable
        if not formulation.solvable:
            self.box = None
            self.loss_form, self.penalty_form = forms or (None, None)
        elif self._declared:
            self.box  # noqa: B018 - limits that do not fit the parameters are refused now
        else:  # a user's functions may return something else later
            self.expressions  # noqa: B018

    @property
    def expressions(self) -> Expressions:
        """The expressions; the functions are called once, whichever thread needs them first."""
        with self._lock:
            if self._called is None:
                self._called = Expressions(self.formulation, self.parameters, self.equations, self.groups)
        return self._called

    @property
    def predicts(self) -> bool:
        """Whether constraints use positions, which are linear about some point."""
        return not self._declared and self.expressions.predicts

    @property
    def over_norms(self) -> bool:
        """Whether the loss gets the configurations' norms."""
        return self.formulation.loss_over == "configuration"

    @cached_property
    def on_squares(self) -> Structure:
        """The same penalty and constraints with the sum of squares of the equations as the loss."""
        made = self._changed(replace(self.formulation, loss=SQUARES, loss_over="equation"), "loss_form", "loss")
        if made._called is not None:
            own = made._called
            own.r = cp.Variable(self.n + 1, name="r")
            own.loss = Term(cp.sum_squares(own.r), own.r)
            own.live = (own.loss.expression, *own.live[1:])
        made.equations = self.n + 1
        return made

    @cached_property
    def without_penalty(self) -> Structure:
        """The same loss and constraints without the penalty."""
        made = self._changed(replace(self.formulation, penalty=None), "penalty_form", "canonical")
        if made._called is not None:
            own = made._called
            own.penalty = own.penalty_of_z = None
            own.live = (own.live[0], None, own.live[2])
        return made

    def _changed(self, formulation: Formulation, *properties: str) -> Structure:
        """Return a copy for another formulation, whose functions that stay are not called again."""
        made = copy.copy(self)
        made.formulation = formulation
        for name in (*properties, "joint", "inner", "_over_own", "on_squares", "without_penalty"):
            vars(made).pop(name, None)
        made._called = copy.copy(self._called)
        return made

    # --- structure ---------------------------------------------------------------------------------------------

    @cached_property
    def loss_form(self) -> Quadratic | None:
        """The loss as a quadratic form of r."""
        which = self.groups if self.over_norms else np.arange(self.equations)
        form = declared_form(self.formulation.loss, int(which.max()) + 1)
        form = form or quadratic(self.expressions.loss.expression, self.expressions.loss.variable)
        if form is None or not self.over_norms:
            return form
        if not form.diagonal or form.c.any():
            return None
        return Quadratic(form.L[which], np.zeros(len(which)), form.constant)  # p_k v_k^2 = p_k |r_k|^2

    @cached_property
    def penalty_form(self) -> Quadratic | None:
        """The penalty as a quadratic form of z."""
        if self.formulation.penalty is None:
            return None
        groups = self.formulation.penalty_over is not None
        form = declared_form(self.formulation.penalty, len(self.expressions.differences) if groups else self.n)
        form = form or quadratic(self.expressions.penalty.expression, self.expressions.penalty.variable)
        if form is None or not groups:
            return form
        if not form.diagonal or form.c.any():
            return None
        L = np.vstack([root * D for root, D in zip(form.L, self.expressions.differences, strict=True)])
        return Quadratic(L, np.zeros(len(L)), form.constant)

    @cached_property
    def box(self) -> tuple[Array, Array] | None:
        """Lower and upper bounds (n,) where every constraint is a `Box`, infinite where there is none.

        None if there is another constraint, or if they contradict each other.
        """
        boxes = [constraint for constraint in self.formulation.constraints if isinstance(constraint, Box)]
        if len(boxes) < len(self.formulation.constraints):
            return None
        bounds = [box.bounds(self.parameters) for box in boxes]
        lower = np.max([np.full(self.n, -np.inf), *(low for low, _ in bounds)], axis=0)
        upper = np.min([np.full(self.n, np.inf), *(high for _, high in bounds)], axis=0)
        return None if (lower > upper).any() else (lower, upper)

    @cached_property
    def canonical(self) -> Canonical:
        """Penalty and constraints of z in canonical form."""
        if self.box is not None and (self.formulation.penalty is None or self.penalty_form is not None):
            return Canonical.box(self.penalty_form, *self.box)
        penalty = self.expressions.penalty_of_z
        with self._lock:
            constant = cp.Constant(0.0) if penalty is None else penalty
            return Canonical(constant, self.expressions.flat, self.expressions.z)

    @cached_property
    def loss(self) -> Loss | None:
        """The loss for the solver, where it is not quadratic."""
        if self.loss_form is not None:
            return None
        with self._lock:
            return Loss(self.expressions.loss.expression, self.expressions.loss.variable, self.over_norms)

    # --- values ------------------------------------------------------------------------------------------------

    @cached_property
    def inner(self) -> bool:
        """Whether loss or penalty has variables of its own, over which a value is the minimum."""
        if self._declared:
            return False
        a = self.expressions
        return bool(a.owned(a.loss.expression, a.penalty_of_z))

    @cached_property
    def joint(self) -> bool:
        """Whether the loss shares variables of its own with penalty or constraints."""
        if self._declared:
            return False
        a = self.expressions
        return bool(a.owned(a.loss.expression) & a.owned(a.penalty_of_z, *a.flat))

    def values(self, z: Array, r: Array, weight: float) -> tuple[float, float]:
        """Return loss and penalty at numbers; minimized over the functions' own variables."""
        if not self.inner:
            return self.loss_of(r), self.penalty_of(z)
        a, v = self.expressions, self.argument(r)
        with self._lock:
            problem, parameters = self._over_own
            for parameter, number in zip(parameters, (z, v, weight if self.joint else 1.0), strict=True):
                parameter.value = number
            if not minimized(problem, **TIGHT):
                return float("inf"), 0.0
            for variable, number in ((a.z, z), (a.loss.variable, v)):  # not the values left by the solver
                variable.save_value(number)
            penalty: Any = 0.0 if a.penalty_of_z is None else a.penalty_of_z.value
            return np.asarray(a.loss.expression.value).item(), np.asarray(penalty).item()  # (1,) for a perspective

    @cached_property
    def _over_own(self) -> tuple[cp.Problem, list[cp.Parameter]]:
        """The program of the functions' own variables, its parameters z, what the loss gets, and the weight."""
        a = self.expressions
        fixed = a.z, a.loss.variable
        at, weight = [cp.Parameter(variable.size) for variable in fixed], cp.Parameter(nonneg=True)
        total: Any = a.loss.expression if a.owned(a.loss.expression) else 0.0
        if a.owned(a.penalty_of_z):
            total = total + weight * a.penalty_of_z
        tied = [constraint for constraint in a.flat if a.owned(constraint)]
        same = [variable == parameter for variable, parameter in zip(fixed, at, strict=True)]
        return cp.Problem(cp.Minimize(total), [*tied, *same]), [*at, weight]

    def loss_of(self, r: Array) -> float:
        """Return the loss of a residual (m,)."""
        if self.formulation.loss == SQUARES:  # of residuals or norms
            return float(r @ r)
        return self.expressions.loss(self.argument(r))

    def penalty_of(self, z: Array) -> float:
        """Return the penalty of z (n,)."""
        if self.formulation.penalty is None:
            return 0.0
        if self.formulation.penalty_over is not None:
            z = np.array([float(np.linalg.norm(D @ z)) for D in self.expressions.differences])
        form = declared_form(self.formulation.penalty, len(z))
        return self.expressions.penalty(z) if form is None else form.value(z)

    def argument(self, r: Array) -> Array:
        """Return the argument of the loss for a residual: the residual, or the norms of the configurations."""
        return np.sqrt(np.bincount(self.groups, r**2)) if self.over_norms else r

    def feasible(self, z: Array) -> bool:
        """Whether z (n,) satisfies the constraints exactly; those with variables of their own are not checked."""
        own = self.expressions.z
        with self._lock:
            if any(variable is not own for limit in self.expressions.flat for variable in limit.variables()):
                return False
            own.save_value(z)
            with np.errstate(all="ignore"):
                return not any(np.any(limit.violation() > 0) for limit in self.expressions.flat)


def in_blocks(formulation: Formulation) -> tuple[Formulation, QuadraticModel | None]:
    """Return the formulation for blocks of rows, and the quadratic model of its loss; None if it needs none.

    None if the loss depends only on the residual's length. InputError for a loss that is no sum over rows.
    """
    if formulation.loss in INVARIANT:
        return replace(formulation, loss_over="equation"), None
    where = f"formulation '{formulation.name}'"
    accepted = "a squared loss, or a sum over configurations or equations (robust)"
    if not separable(formulation.loss, formulation.loss_over):
        raise InputError(where, "a loss that is not a sum, with data in blocks", accepted)
    squares = QuadraticModel(formulation.loss, formulation.name, formulation.loss_over)
    return replace(formulation, loss=SQUARES, loss_over="equation"), squares
