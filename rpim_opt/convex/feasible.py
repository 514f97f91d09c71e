"""How far a point is from the constraints, in units of the scales, and the nearest point that meets them."""

from __future__ import annotations

import threading
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.late import Late
from rpim_opt.convex.atoms import OPTIMAL, cp
from rpim_opt.convex.conic import ATTEMPTS
from rpim_opt.convex.posed import Posed

nonpos: Any = Late("cvxpy.constraints.nonpos")
zero: Any = Late("cvxpy.constraints.zero")
FEASIBLE = 1e-7
"""By how much a solution may miss its constraints: in scales, relative to its largest component where that is more."""
_LOCK = threading.Lock()  # a posed formulation's z has one value at a time


def room(z: Array) -> float:
    """Return by how many scales z may miss its constraints."""
    return FEASIBLE * max(1.0, float(np.max(np.abs(z), initial=0.0)))


def violation(posed: Posed, z: Array) -> float:
    """Return how far z (n,) lies outside the constraints: to first order the distance, in units of the scales."""
    if posed.box is not None:
        lower, upper = posed.box
        return float(np.max(np.maximum(lower - z, z - upper), initial=0.0))
    every = [constraint for group in posed.constraints for constraint in group]
    if not every:
        return 0.0
    if any(v.id != posed.z.id for constraint in every for v in constraint.variables()):
        return float(np.max(np.abs(nearest(posed, z) - z)))
    with _LOCK:
        posed.z.save_value(z)
        return max(_missed(constraint, posed.z, posed.speeds) for constraint in every)


def _missed(constraint: Any, z: cp.Variable, constant: dict[int, Array]) -> float:
    """Return by how much a constraint is missed at the value of z, over how fast it changes with z."""
    with np.errstate(all="ignore"):
        missed = np.ravel(np.asarray(constraint.violation(), dtype=float))
    if not np.isfinite(missed).all():
        return float("inf")
    if not np.any(missed > 0):
        return 0.0
    speed = constant.get(constraint.id)
    if speed is None:
        speed = _changes(constraint, z, len(missed))
    if all(arg.is_affine() for arg in constraint.args) and not constraint.parameters():
        constant[constraint.id] = speed  # CVXPY takes milliseconds for a gradient
    return float(np.max(np.divide(missed, speed, out=missed.copy(), where=speed > 0)))


def _changes(constraint: Any, z: cp.Variable, count: int) -> Array:
    """Return how fast each of a constraint's components (count,) changes with z at its value."""
    if not isinstance(constraint, nonpos.Inequality | zero.Equality):
        return np.full(count, max((float(np.max(_speeds(arg, z))) for arg in constraint.args), default=0.0))
    speed = _speeds(constraint.args[0] - constraint.args[1], z)
    if len(speed) != count:
        return np.full(count, np.max(speed, initial=0.0))
    return speed


def _speeds(expression: Any, z: cp.Variable) -> Array:
    """Return the norm of the gradient of every component; zero where CVXPY knows none."""
    slopes = expression.grad.get(z)
    if slopes is None:
        return np.zeros(expression.size)
    return np.sqrt(np.ravel(np.asarray((slopes.multiply(slopes)).sum(axis=0))))


def nearest(posed: Posed, z: Array) -> Array:
    """Return the point of the constraints that is nearest to z (n,); z itself where none is found."""
    n = len(z)
    program = posed.projection
    lift = np.vstack([np.eye(n), np.zeros((posed.equations, n))])
    for attempt in range(len(ATTEMPTS)):
        found = program.solve(lift, np.zeros(n + posed.equations), 0.0, 2 * np.eye(n), -2 * z, attempt=attempt)
        if found.status == OPTIMAL:
            return found.u
    return z
