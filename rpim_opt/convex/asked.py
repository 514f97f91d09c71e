"""What a formulation's functions answer: expressions of z and of the residual, copied from whatever may change."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.atoms import cp
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.given import Given
from rpim_opt.convex.given import given as told
from rpim_opt.convex.terms import Frozen, Term, listed, reason, scalar
from rpim_opt.robot.parameters import Parameters


@dataclass(frozen=True, eq=False)
class Asked:
    """Answers of a formulation's functions.

    Parameters
    ----------
    z, r
        The variables (n,) and (m,).
    loss, penalty
        Expressions of r and z; penalty is None where there is none.
    loss_term, penalty_term
        The same of what the functions see: numbers of equations or configurations, z or norms of groups.
    differences
        Matrices D_k of ``penalty_over``.
    constraints
        Of z, one list for every function.
    own
        Variables that the functions brought along.
    live
        Loss, penalty and constraints with the user's own parameters, and no copies of them.
    predicts
        Whether constraints asked for positions, which are linear about some point.
    """

    z: cp.Variable
    r: cp.Variable
    loss: Any
    penalty: Any
    loss_term: Term
    penalty_term: Any
    differences: list[Array]
    constraints: list[list[Any]]
    own: list[cp.Variable]
    live: tuple[Any, Any, list[list[Any]]]
    predicts: bool


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
    live_loss = scalar(formulation.loss(seen), f"{where}, loss")
    loss_term = Term(copy(live_loss), seen)
    live_penalty = None
    penalty_term = None
    penalty = None
    if formulation.penalty is not None:
        live_penalty = scalar(formulation.penalty(given), f"{where}, penalty")
        penalty_term = Term(copy(live_penalty), given)
        penalty = _over_z(penalty_term.expression, z, given, differences)
    known = told(z, parameters)
    live = [_listed(c, z, known, f"{where}, {called(c, k)}") for k, c in enumerate(formulation.constraints)]
    loss = _over_r(loss_term.expression, r, seen, groups)
    _require_convex(f"{where}, loss", loss)
    _require_convex(f"{where}, penalty", penalty)
    predicts = bool(known.asked)
    stated = (_over_r(live_loss, r, seen, groups), _over_z(live_penalty, z, given, differences), live)
    constraints = [[copy(each) for each in group] for group in live]
    return Asked(z, r, loss, penalty, loss_term, penalty_term, differences, constraints, copy.own, stated, predicts)


def _listed(constraint: Any, z: cp.Variable, known: Given, where: str) -> list[Any]:
    return listed(constraint(z, known), where)


def called(constraint: Any, k: int) -> str:
    """Return what a person calls the constraint function number k."""
    name = getattr(constraint, "name", getattr(constraint, "__name__", "<lambda>"))
    if name == "<lambda>":
        return f"constraint {k + 1}"
    return str(name)


def _over_r(expression: Any, r: cp.Variable, seen: cp.Variable, groups: np.ndarray) -> Any:
    """Return the loss as a function of r."""
    if seen is r:
        return expression
    return expression.tree_copy({id(seen): norms(r, groups)})


def _over_z(expression: Any, z: cp.Variable, given: cp.Variable, differences: list[Array]) -> Any:
    """Return the penalty as a function of z."""
    if expression is None or given is z:
        return expression
    return expression.tree_copy({id(given): cp.hstack([cp.norm(D @ z) for D in differences])})


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
