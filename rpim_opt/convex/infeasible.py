"""Infeasibility: which constraints contradict each other, and by how much."""

from __future__ import annotations

from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import Conflict
from rpim_opt.convex.constraints import Box, Parsed, as_text, name_of
from rpim_opt.convex.expressions import cp, minimized, substituted
from rpim_opt.convex.structure import Structure

LEAST = 1e-6
"""Slacks below this are within the solver's accuracy."""
Conditions = list[tuple[str, list[Any]]]
"""CVXPY constraints of z, by names that their user knows."""


def conflict(structure: Structure) -> Conflict | None:
    """Return the contradiction; None if the constraints are feasible after all.

    ``constraints`` is irreducible: without any one of them the others are feasible (deletion filter; Chinneck and
    Dravnieks 1991, ORSA Journal on Computing 3:157). The loosening that resolves it has the least sum of slacks, of one
    kind of constraint at a time.
    """
    z = cp.Variable(structure.n)
    conditions = _conditions(structure, z)
    if _possible(conditions):
        return None
    left = list(conditions)
    for condition in conditions:  # drop in turn what the contradiction does not need
        others = [other for other in left if other is not condition]
        if not _possible(others):
            left = others
    parameters = structure.parameters
    parsed = [function for function in structure.formulation.constraints if isinstance(function, Parsed)]
    slacks = []
    for kind, count in (("boxes", structure.n), ("statements", len(parsed))):
        slack = cp.Variable(max(count, 1), nonneg=True)
        minimized(cp.Problem(cp.Minimize(cp.sum(slack)), _demands(_conditions(structure, z, **{kind: slack}))))
        slacks.append(np.zeros(count) if slack.value is None else np.asarray(slack.value)[:count])
    by_box, by_statement = slacks
    boxes = {i: float(by_box[i] * parameters.scale[i]) for i in np.flatnonzero(by_box > LEAST)}
    pairs = zip(parsed, by_statement, strict=True)
    stated = {each.name: (float(each.scale(parameters) * by), each.unit) for each, by in pairs if by > LEAST}
    loosen = (
        ", ".join(f"{parameters.names[i]} by {as_text(by, parameters.dimensions[i])}" for i, by in boxes.items()),
        ", ".join(f"{name} by {by / si:.4g} {unit}" for name, (by, (unit, si)) in stated.items()),
    )
    bounds = {parameters.names[i]: by for i, by in boxes.items()}
    statements = {name: by for name, (by, _) in stated.items()}
    return Conflict(bounds, tuple(name for name, _ in left), statements, loosen)


def _demands(conditions: Conditions) -> list[Any]:
    return [demand for _, demands in conditions for demand in demands]


def _possible(conditions: Conditions) -> bool:
    """Whether all can be met at once."""
    problem = cp.Problem(cp.Minimize(0), _demands(conditions))
    return minimized(problem) or problem.status not in (cp.INFEASIBLE, cp.INFEASIBLE_INACCURATE)


def _conditions(structure: Structure, z: cp.Variable, boxes: Any = 0, statements: Any = 0) -> Conditions:
    """Return the conditions of every constraint function, bound by bound.

    They are loosened by slacks of ``boxes`` [scales] and of ``statements`` in words [scales of each].
    """
    parameters, stated = structure.parameters, structure.formulation
    made: Conditions = []
    count = 0
    for k, function in enumerate(stated.constraints):
        if isinstance(function, Box):
            more = boxes + np.zeros(structure.n)
            for sign, side in zip("><", function.bounds(parameters), strict=True):
                for i in np.flatnonzero(np.isfinite(side)):
                    bound = as_text(side[i] * parameters.scale[i], parameters.dimensions[i])
                    demand = z[i] >= side[i] - more[i] if sign == ">" else z[i] <= side[i] + more[i]
                    made.append((f"{parameters.names[i]} {sign}= {bound} ({function.name})", [demand]))
        elif isinstance(function, Parsed):
            by = None if isinstance(statements, int) else function.scale(parameters) * statements[count]
            made.append((function.name, function.loosened(z, parameters, by)))
            count += 1
        else:
            own = structure.expressions
            demands = [substituted(constraint, {id(own.z): z}) for constraint in own.constraints[k]]
            name = name_of(function, k)
            several = len(demands) > 1
            made += [(f"{name} ({i + 1})" if several else name, [demand]) for i, demand in enumerate(demands)]
    return made


def advice(structure: Structure, status: str, found: Conflict | None, solver: str) -> str:
    """Return a sentence on why a program was not solved by a solver of CVXPY, with a remedy."""
    if found is not None:
        return ""
    if status.startswith("unbounded"):
        return (
            "the objective appears to be unbounded below: bound a linear loss or a variable of your own that no term "
            "penalizes, or use a larger weight"
        )
    if solver.upper() != cp.CLARABEL:
        return f"the program may be beyond {solver}, or beyond its accuracy: tighten its settings, or use CLARABEL"
    if structure.constrained and status.startswith(("infeasible", "optimal")):
        return (
            "its constraints are feasible, but not to the solver's accuracy: check their units, or loosen them slightly"
        )
    remedy = "add a penalty or use a larger weight, or use another solver (solver=..., settings=...)"
    return f"the solver did not reach its accuracy: {remedy}"
