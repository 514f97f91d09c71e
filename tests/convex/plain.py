"""The program of a linearization as CVXPY's manual would state it, solved without this package."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import cvxpy as cp
import numpy as np

import rpim_opt as ro

SETTINGS: tuple[dict[str, float], ...] = (
    {"tol_gap_abs": 1e-9, "tol_gap_rel": 1e-9, "tol_feas": 1e-9},
    {},
    {"direct_solve_method": "faer"},
    {"equilibrate_enable": False},
    {"static_regularization_constant": 1e-10},
)
"""Tried in turn, the objective divided by its value at the last attempt; {} are Clarabel's defaults."""


class Plain(NamedTuple):
    """CVXPY's optimum, z (n,), which of `SETTINGS` gave it, and by how much its point's violations may have lowered it.

    An objective falls by at most |multiplier| |violation| of every constraint that is missed.
    """

    objective: float
    z: np.ndarray
    attempt: int
    gained: float = 0.0


def listed(constraints: Any) -> list[Any]:
    if isinstance(constraints, list | tuple):
        return list(constraints)
    return [constraints]


def norms(r: Any, group: np.ndarray) -> Any:
    """Norm of each configuration's residual (N,), in the order of the configurations' numbers."""
    return cp.hstack([cp.norm(r[np.flatnonzero(group == number)]) for number in np.unique(group)])


def parts(formulation: ro.Formulation, model: ro.problem.LinearModel, z: Any) -> tuple[Any, Any, list[Any]]:
    """Loss, penalty (zero where there is none) and constraints at z, a variable or numbers."""
    r = model.A @ z - model.b
    limits = [constraint for c in formulation.constraints for constraint in listed(c(z, model.parameters))]
    seen = r
    if formulation.loss_over == "configuration":
        seen = norms(r, model.group)
    penalized = z
    if formulation.penalty_over is not None:
        penalized = cp.hstack([cp.norm(D @ z) for D in formulation.penalty_over(model.parameters)])
    penalty = cp.Constant(0.0)
    if formulation.penalty is not None:
        penalty = formulation.penalty(penalized)
    return formulation.loss(seen), penalty, limits


def plain(formulation: ro.Formulation, model: ro.problem.LinearModel, weight: float) -> Plain:
    """Minimize loss + weight penalty over z and the formulation's own variables."""
    z = cp.Variable(model.A.shape[1])
    loss, penalty, limits = parts(formulation, model, z)
    return solved(loss + weight * penalty, limits, z)


@np.errstate(invalid="ignore")  # z may be beyond a function's domain by rounding
def solved(objective: Any, limits: list[Any], z: Any) -> Plain:
    """Minimize, tightly where Clarabel can; parameters are numbers."""
    size = 1.0
    ended = []
    for attempt, settings in enumerate(SETTINGS):
        program = cp.Problem(cp.Minimize(objective / size), limits)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of an inaccurate answer: the next attempt's reason
            try:
                program.solve(solver=cp.CLARABEL, ignore_dpp=True, **settings)
            except cp.SolverError:
                ended.append("solver error")
                continue
        ended.append(program.status)
        if program.status == cp.OPTIMAL:
            return Plain(float(np.squeeze(objective.value)), np.asarray(z.value), attempt, size * _gained(limits))
        if program.value is not None and np.isfinite(program.value):
            size *= max(abs(float(program.value)), 1.0)
    raise AssertionError(f"plain CVXPY has no answer to compare with: {ended}")


def _gained(limits: list[Any]) -> float:
    total = 0.0
    for limit in limits:
        duals = limit.dual_value if isinstance(limit.dual_value, list) else [limit.dual_value]
        price = np.sqrt(sum(np.sum(np.square(dual)) for dual in duals))
        total += float(price * np.linalg.norm(np.asarray(limit.residual, dtype=float)))
    return total


def objective_at(formulation: ro.Formulation, model: ro.problem.LinearModel, weight: float, z: np.ndarray) -> float:
    """Loss + weight penalty at z: a value, or a minimum over the formulation's own variables."""
    at = cp.Variable(len(z), value=z)
    loss, penalty, limits = parts(formulation, model, at)
    objective = loss + weight * penalty
    own = [v for v in cp.Problem(cp.Minimize(objective), limits).variables() if v.id != at.id]
    if not own:
        return float(np.squeeze(objective.value))
    loss, penalty, limits = parts(formulation, model, cp.Constant(z))
    depends = [limit for limit in limits if limit.variables()]
    return solved(loss + weight * penalty, depends, cp.Constant(z)).objective


def violation(formulation: ro.Formulation, model: ro.problem.LinearModel, z: np.ndarray) -> float:
    """By how much z misses the constraints, relative to 1 + its largest entry; own variables at their best."""
    at = cp.Variable(len(z), value=z)
    limits = parts(formulation, model, at)[2]
    size = 1 + float(np.abs(z).max())
    alone = [limit for limit in limits if {v.id for v in limit.variables()} <= {at.id}]
    with np.errstate(divide="ignore"):  # CVXPY projects a cone's axis by dividing by its distance, zero
        return max((float(np.max(limit.violation())) for limit in alone), default=0.0) / size
