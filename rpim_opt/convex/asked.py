"""What a formulation's functions answer: expressions of z and of the residual, copied from whatever may change."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.atoms import cp
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.given import Given
from rpim_opt.convex.given import given as told
from rpim_opt.convex.terms import Frozen, Term, alike, asked, listed, reason, scalar, substituted
from rpim_opt.robot.parameters import Parameters


@dataclass(frozen=True, eq=False)
class Asked:
    """Answers of a formulation's functions.

    Parameters
    ----------
    z, r
        The variables (n,) and (m,).
    groups
        (m,) numbers of configurations.
    loss_term, penalty_term
        What loss and penalty say of what they see: numbers of equations or configurations, z or norms of groups.
    penalty
        The penalty as a function of z; None where there is none.
    differences
        Matrices D_k of ``penalty_over``.
    constraints
        Of z, one list for every function.
    own
        Variables that the functions brought along.
    live
        Loss, as a function of what it sees, penalty and constraints with the user's own parameters, and no copies.
    predicts
        Whether constraints asked for positions, which are linear about some point.
    """

    z: cp.Variable
    r: cp.Variable
    groups: np.ndarray
    loss_term: Term
    penalty_term: Any
    penalty: Any
    differences: list[Array]
    constraints: list[list[Any]]
    own: list[cp.Variable]
    live: tuple[Any, Any, list[list[Any]]]
    predicts: bool

    @cached_property
    def loss(self) -> Any:
        """The loss as a function of r."""
        return self.over_r(self.loss_term.expression)

    def over_r(self, stated: Any) -> Any:
        """Return an expression of what the loss gets as one of r."""
        if self.loss_term.variable is self.r:
            return stated
        return substituted(stated, {id(self.loss_term.variable): norms(self.r, self.groups)})

    def like(self, other: Asked) -> bool:
        """Whether these are the answers that the functions gave another time."""
        stated = [[a.loss_term.expression, a.penalty, a.constraints, a.differences, a.predicts] for a in (self, other)]
        pairs: dict[int, int] = {}
        for mine, its in ((self.z, other.z), (self.loss_term.variable, other.loss_term.variable)):
            pairs |= {id(mine): id(its), id(its): id(mine)}
        try:
            return alike(stated[0], stated[1], pairs)
        except ValueError:  # something that has no truth value: then they may differ
            return False


def ask(formulation: Formulation, parameters: Parameters, equations: int, groups: np.ndarray) -> Asked:
    """Ask the functions of a formulation for the parameters and so many equations; keep copies of what they answer."""
    where = f"formulation '{formulation.name}'"
    from rpim_opt.convex.unknown import Unknown  # a variable of CVXPY, imported where one is made

    z = Unknown(parameters.names)
    r = cp.Variable(equations, name="r")
    seen = r
    if formulation.loss_over == "configuration":
        seen = cp.Variable(len(np.unique(groups)))
    differences: list[Array] = []
    given = z
    if formulation.penalty_over is not None:
        differences = [np.asarray(D, dtype=float) for D in formulation.penalty_over(parameters)]
        given = cp.Variable(len(differences))
    copy = Frozen([z, r, seen, given], where)
    live_loss = scalar(asked(formulation.loss, f"{where}, loss", seen), f"{where}, loss")
    loss_term = Term(copy(live_loss), seen)
    live_penalty = None
    penalty_term = None
    penalty = None
    if formulation.penalty is not None:
        live_penalty = scalar(asked(formulation.penalty, f"{where}, penalty", given), f"{where}, penalty")
        penalty_term = Term(copy(live_penalty), given)
        penalty = _over_z(penalty_term.expression, z, given, differences)
    known = told(z, parameters)
    live = [_listed(c, z, known, f"{where}, {called(c, k)}") for k, c in enumerate(formulation.constraints)]
    if seen is not r:  # norms are convex and nonnegative, as absolute values are
        _require_convex(f"{where}, loss", substituted(loss_term.expression, {id(seen): cp.abs(cp.Variable(seen.size))}))
    _require_convex(f"{where}, penalty", penalty)
    predicts = bool(known.asked)
    stated = (live_loss, _over_z(live_penalty, z, given, differences), live)
    constraints = [[copy(each) for each in group] for group in live]
    return Asked(z, r, groups, loss_term, penalty_term, penalty, differences, constraints, copy.own, stated, predicts)


def _listed(constraint: Any, z: cp.Variable, known: Given, where: str) -> list[Any]:
    return listed(asked(constraint, where, z, known), where)


def called(constraint: Any, k: int) -> str:
    """Return what a person calls the constraint function number k."""
    name = getattr(constraint, "name", getattr(constraint, "__name__", "<lambda>"))
    if name == "<lambda>":
        return f"constraint {k + 1}"
    return str(name)


def _over_z(expression: Any, z: cp.Variable, given: cp.Variable, differences: list[Array]) -> Any:
    """Return the penalty as a function of z."""
    if expression is None or given is z:
        return expression
    return substituted(expression, {id(given): cp.hstack([cp.norm(D @ z) for D in differences])})


def _require_convex(where: str, expression: Any) -> None:
    if expression is not None and not expression.is_convex():
        found = "a program that is not convex"
        accepted = f"CVXPY's DCP rules: nondecreasing over norms; {reason(expression)}"
        raise InputError(where, found, accepted)


def norms(r: Any, group: np.ndarray) -> Any:
    """Return the norms of a residual (m,) by group in CVXPY, in the order of the groups' numbers."""
    _, which, count = np.unique(group, return_inverse=True, return_counts=True)
    order = np.argsort(which, kind="stable")
    place = np.empty(len(group), dtype=int)
    place[order] = np.arange(len(group)) - np.repeat(np.cumsum(count) - count, count)
    shape = (len(count), int(count.max()))  # shorter groups are filled with zeros
    at = (which * shape[1] + place, np.arange(len(group)))
    pick = scipy.sparse.csr_array((np.ones(len(group)), at), (shape[0] * shape[1], len(group)))
    return cp.norm(cp.reshape(pick @ r, shape, order="C"), 2, axis=1)
