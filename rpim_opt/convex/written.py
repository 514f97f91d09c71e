"""A program as a CVXPY problem: written down in variables of its own, and solved by any solver of CVXPY's."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.atoms import cp
from rpim_opt.convex.interior import Found, multipliers
from rpim_opt.convex.objective import Damping, Objective


@dataclass(frozen=True, eq=False)
class Written:
    """A CVXPY problem, its variable z, and the formulation's constraints by function."""

    problem: cp.Problem
    z: cp.Variable
    groups: Sequence[Sequence[cp.Constraint]]


def parametrized(objective: Objective, weight: float) -> Written:
    """Write a program down with A, b and the weight as parameters, and the user's own as they are."""
    A, b = objective.rows
    data = (
        cp.Parameter(A.shape, name="A", value=A),
        cp.Parameter(b.shape, name="b", value=b),
        cp.Parameter(nonneg=True, name="weight", value=weight),
    )
    loss, penalty, groups = objective._posed.live
    return _written(objective, data, loss, penalty, groups, None)


def in_numbers(objective: Objective, weight: float, damping: Damping | None) -> Written:
    """Write a program down with the numbers that it was posed with."""
    posed = objective._posed
    return _written(objective, (*objective.rows, weight), posed.loss, posed.penalty, posed.constraints, damping)


def _written(
    objective: Objective,
    data: tuple[Any, Any, Any],
    loss: cp.Expression,
    penalty: cp.Expression | None,
    groups: Sequence[Sequence[cp.Constraint]],
    damping: Damping | None,
) -> Written:
    posed = objective._posed
    A, b, weight = data
    z, r = cp.Variable(posed.n, name="z"), cp.Variable(posed.equations, name="r")
    instead = {id(posed.z): z, id(posed.r): r}
    groups = [[constraint.tree_copy(instead) for constraint in group] for group in groups]
    every = [r == A @ z - b]
    every += [constraint for group in groups for constraint in group]
    if posed.limited:
        every.append(posed.largest.tree_copy(instead))
    total = loss.tree_copy(instead) + objective.model.offset
    if penalty is not None:
        price = penalty.tree_copy(instead)
        if price.parameters():  # a parameter times a parameter would not be DPP
            above = cp.Variable(name="penalty")
            every.append(above >= price)
            price = above
        total = total + weight * price
    if damping is not None:
        total = total + cp.sum_squares(cp.multiply(damping.size, z - damping.centre))
    return Written(cp.Problem(cp.Minimize(total), every), z, groups)


def by_solver(
    objective: Objective,
    weight: float,
    damping: Damping | None,
    solver: str,
    settings: Mapping[str, Any],
    verbose: bool,
) -> Found:
    """Return the minimum that a solver of CVXPY finds; without a point where it finds none."""
    _require_installed(solver)
    written = in_numbers(objective, weight, damping)
    problem, z = written.problem, written.z
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # an inaccurate answer is judged by what it misses
        try:
            problem.solve(solver=solver, verbose=verbose, **settings)
        except TypeError as error:
            if not settings:
                raise
            raise InputError("settings", f"{error}".rstrip("."), f"settings that {solver} knows") from None
        except (cp.SolverError, ValueError, ArithmeticError, RuntimeError) as error:  # solvers have errors of their own
            return Found(f"an error of {solver}: {error}")
    if problem.status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE) or z.value is None:
        return Found(problem.status)
    point = np.array(z.value)
    if not objective.meets(point):
        missed = objective.violation(point)
        return Found(f"{problem.status}, but outside the constraints by {missed:.1e}")
    values = [[np.ravel(np.asarray(c.dual_value, dtype=float)) for c in group] for group in written.groups]
    return Found(problem.status, point, multipliers(objective, values), int(problem.solver_stats.num_iters or 0))


def _require_installed(solver: Any) -> None:
    if not isinstance(solver, str) or solver.upper() not in cp.installed_solvers():
        installed = ", ".join(cp.installed_solvers())
        raise InputError("solver", f"{solver!r}", f"one that is installed: {installed}")
