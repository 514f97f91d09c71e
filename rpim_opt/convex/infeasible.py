"""Why a program has no solution: which constraints contradict each other, and by how much."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import Conflict
from rpim_opt.convex.constraints import Box, Parsed, spoken
from rpim_opt.convex.expressions import cp, norms, substituted
from rpim_opt.convex.structure import Structure
from rpim_opt.problem.linear import LinearModel

FAR = 1e6
"""Bounds beyond so many scales are none."""
LEAST = 1e-6
"""Slacks below this are the solver's accuracy."""


class Stated(NamedTuple):
    """CVXPY constraints of z, by a name that their user knows."""

    name: str
    demands: tuple[Any, ...]


def conflict(structure: Structure, model: LinearModel) -> Conflict | None:
    """Return what contradicts what; None where the constraints can be met after all.

    ``constraints`` is irreducible: without any one of them the others can be met (deletion filter; Chinneck and
    Dravnieks 1991, ORSA Journal on Computing 3:157).
    """
    z = cp.Variable(structure.n)
    units = _units(structure, model, z)
    everything = [stated for unit in units for stated in unit]
    if _possible(everything):
        return None
    kept = _irreducible(units)
    single = _irreducible([[stated] for unit in kept for stated in unit])
    names = tuple(stated.name for unit in single for stated in unit)
    parameters, groups = structure.parameters, np.unique(model.group)
    slack = _least(structure, model, "boxes")
    bounds = {parameters.names[i]: float(slack[i] * parameters.scale[i]) for i in np.flatnonzero(slack > LEAST)}
    slack = _least(structure, model, "configurations")
    rows = {int(groups[i]): float(slack[i]) for i in np.flatnonzero(slack > LEAST)}
    parsed = [function for function in structure.formulation.constraints if isinstance(function, Parsed)]
    slack = _least(structure, model, "statements") if parsed else np.zeros(0)
    pairs = zip(parsed, slack, strict=True)
    statements = {each.name: float(each.scale(parameters) * by) for each, by in pairs if by > LEAST}
    return Conflict(bounds, rows, names, statements)


def _solved(objective: Any, demands: Sequence[Any]) -> cp.Problem | None:
    """Return a problem after Clarabel, which may be inaccurate; None where it fails."""
    problem = cp.Problem(cp.Minimize(objective), list(demands))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            problem.solve(solver=cp.CLARABEL)
        except cp.SolverError:
            return None
    return problem


def _possible(demands: Sequence[Stated]) -> bool:
    """Whether all can be met at once."""
    problem = _solved(0, [constraint for stated in demands for constraint in stated.demands])
    return problem is None or problem.status not in (cp.INFEASIBLE, cp.INFEASIBLE_INACCURATE)


def _irreducible(units: list[list[Stated]]) -> list[list[Stated]]:
    """Leave out, one after the other, what is not needed for the contradiction."""
    kept = list(units)
    for unit in units:
        others = [other for other in kept if other is not unit]
        if not _possible([stated for other in others for stated in other]):
            kept = others
    return kept


def _units(structure: Structure, model: LinearModel, z: cp.Variable) -> list[list[Stated]]:
    """Return what every constraint function demands, bound by bound, and ``largest`` by configuration."""
    units: list[list[Stated]] = []
    for k, function in enumerate(structure.formulation.constraints):
        if isinstance(function, Box):
            units.append(_bounds(function, structure, z))
            continue
        demands = [substituted(constraint, {id(structure.answers.z): z}) for constraint in structure.constraints[k]]
        if isinstance(function, Parsed):
            units.append([Stated(function.name, tuple(demands))])
            continue
        name = name_of(function, k)
        several = len(demands) > 1
        units.append([Stated(f"{name} ({i + 1})" if several else name, (d,)) for i, d in enumerate(demands)])
    if structure.limited:
        size = norms(model.A @ z - model.b, model.group)
        largest = structure.formulation.largest
        numbers = np.unique(model.group)
        name = "configuration {} within {:g} sigmas"
        units.append([Stated(name.format(g, largest), (size[i] <= largest,)) for i, g in enumerate(numbers)])
    return units


def name_of(function: Any, k: int) -> str:
    """Return what a user calls a constraint function."""
    stated = getattr(function, "stated", None)
    if stated:
        maker, *arguments = stated
        return f"{maker}({', '.join(repr(a) for a in arguments)})"
    name = getattr(function, "__name__", "<lambda>")
    if name == "<lambda>":
        return f"constraint {k + 1}"
    return name


def _bounds(box: Box, structure: Structure, z: cp.Variable) -> list[Stated]:
    """Return every finite bound of a box, in the parameter's unit."""
    parameters = structure.parameters
    found: list[Stated] = []
    for sign, side in zip("><", box.bounds(parameters), strict=True):
        for i in np.flatnonzero(np.isfinite(side)):
            bound = spoken(side[i] * parameters.scale[i], parameters.dimensions[i])
            name = f"{parameters.names[i]} {sign}= {bound} ({box.name})"
            demand = z[i] >= side[i] if sign == ">" else z[i] <= side[i]
            found.append(Stated(name, (demand,)))
    return found


def _least(structure: Structure, model: LinearModel, loosened: str) -> Array:
    """Return the slacks of least sum of boxes [scales], configurations [sigma] or statements [scales of each].

    The others stay as they are; zeros where that does not make the constraints possible.
    """
    parameters = structure.parameters
    z = cp.Variable(structure.n)
    parsed = [function for function in structure.formulation.constraints if isinstance(function, Parsed)]
    count = {"boxes": structure.n, "configurations": len(np.unique(model.group)), "statements": len(parsed)}[loosened]
    slack = cp.Variable(count, nonneg=True)
    demands: list[Any] = []
    for k, function in enumerate(structure.formulation.constraints):
        if isinstance(function, Box):
            lower, upper = (np.clip(side, -FAR, FAR) for side in function.bounds(parameters))
            more = slack if loosened == "boxes" else 0.0
            demands += [z <= upper + more, z >= lower - more]
        elif isinstance(function, Parsed) and loosened == "statements":
            demands += function.loosened(z, parameters, function.scale(parameters) * slack[parsed.index(function)])
        else:
            demands += [substituted(each, {id(structure.answers.z): z}) for each in structure.constraints[k]]
    if structure.limited:
        more = slack if loosened == "configurations" else 0.0
        demands.append(norms(model.A @ z - model.b, model.group) <= structure.formulation.largest + more)
    _solved(cp.sum(slack), demands)
    return np.zeros(slack.size) if slack.value is None else np.asarray(slack.value)


def advice(structure: Structure, status: str, found: Conflict | None) -> str:
    """Return the sentence that says why a program was not solved, and what may help."""
    if found is not None:
        return ""
    if status.startswith("unbounded"):
        return "the objective appears to be unbounded below: use a larger weight, or a start nearer to the data"
    if structure.constrained and status.startswith(("infeasible", "optimal")):
        return (
            "its constraints are feasible, but not to the solver's accuracy: check their units, or loosen them slightly"
        )
    return "the solver did not reach its accuracy: use a larger weight, or another solver (solver=..., settings=...)"
