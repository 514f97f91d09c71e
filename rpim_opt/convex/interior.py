"""Minima of all other programs: by Clarabel's interior point, on data that are dimensionless."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.atoms import OPTIMAL
from rpim_opt.convex.conic import ATTEMPTS
from rpim_opt.convex.constraints import Box
from rpim_opt.convex.objective import Damping, Objective

FLOOR = 1e-16
"""Singular values are whitened as if their squares were at least this part of the largest: an interior point needs a
price on directions that neither data nor penalty see."""


@dataclass(frozen=True, eq=False)
class Found:
    """How an interior point ended: CVXPY's word, and where that is good the point (n,), its multipliers and steps."""

    status: str
    z: Array | None = None
    duals: tuple[Array, ...] = ()
    iterations: int = 0


def interior(objective: Objective, weight: float, damping: Damping | None) -> Found:
    """Return the minimum, in unknowns u that whiten the quadratic terms: z = T u + centre.

    The centre is the minimum without constraints where that meets them, and else a point that does, the objective then
    in units of its value there: far from the constraints, u would be large and its objective larger. What is no minimum
    after all `ATTEMPTS` has the status of the first.
    """
    T, centre = _whitened(objective, weight, damping)
    size = 1.0
    if objective.constrained and not objective.meets(centre):
        centre = objective.nearest(np.zeros(len(centre)))
        size = max(1.0, min(objective.objective(centre, weight), 1e300))
    M, y = objective.stacked(weight, damping)
    H = 2 * (M @ T).T @ (M @ T)
    g = 2 * (M @ T).T @ (M @ centre - y)
    A, b = objective.rows
    lift, shift = np.vstack([T, A @ T]), np.concatenate([centre, A @ centre - b])
    program = objective._posed.conic(objective.loss_form is not None, objective.penalty_form is not None)
    first = ""
    for attempt in range(len(ATTEMPTS)):
        found = program.solve(lift, shift, weight, H, g, size, attempt)
        first = first or found.status
        z = T @ found.u + centre
        if found.status == OPTIMAL and objective.meets(z):
            groups = objective._posed.constraints
            values = [[program.multipliers(found, constraint) for constraint in group] for group in groups]
            return Found(OPTIMAL, z, multipliers(objective, values), found.iterations)
    return Found(first)


def multipliers(objective: Objective, values: list[list[Array]]) -> tuple[Array, ...]:
    """Return the multipliers by constraint function: of a box (n,), as if loosened on the side that holds.

    Parameters
    ----------
    objective
        Whose constraints they are.
    values
        Of every CVXPY constraint of every function.
    """
    together = [np.concatenate([np.empty(0), *group]) for group in values]
    constraints = objective.formulation.constraints
    return tuple(_of_box(objective, c, v) for c, v in zip(constraints, together, strict=True))


def _of_box(objective: Objective, constraint: object, values: Array) -> Array:
    if not isinstance(constraint, Box):
        return values
    lower, upper = constraint.bounds(objective.model.parameters)
    sides = [lower == upper, np.isfinite(lower) & (lower < upper), np.isfinite(upper) & (lower < upper)]
    found = np.zeros(len(lower))
    for side in sides:
        part, values = np.split(values, [np.count_nonzero(side)])
        found[side] += np.abs(part)
    return found


def _whitened(objective: Objective, weight: float, damping: Damping | None) -> tuple[Array, Array]:
    """Return T (n, n) and a centre (n,): A and the penalty's ridge are about the identity in u."""
    R, n = objective.model.triangle, objective.model.A.shape[1]
    A, b = [R[:, :n]], [R[:, n]]
    if objective.penalty_form is not None:
        A.append(np.sqrt(weight) * objective.penalty_form.matrix)
        b.append(np.sqrt(weight) * objective.penalty_form.c)
    elif objective.formulation.penalty is not None:
        A.append(np.sqrt(weight) * np.eye(n))
        b.append(np.zeros(n))
    if damping is not None:
        A.append(np.diag(damping.size))
        b.append(damping.size * damping.centre)
    U, s, Vt = np.linalg.svd(np.vstack(A), full_matrices=False)
    D = np.sqrt(s**2 + FLOOR * s[0] ** 2)
    inverse = 1 / D
    unpenalized = objective.formulation.penalty is None or weight == 0
    if unpenalized and not objective.constrained and damping is None:
        inverse[s <= 1e-10 * s[0]] = 0.0  # nothing says anything of these directions: they stay nominal
    return Vt.T * inverse, Vt.T @ (inverse**2 * s * (U.T @ np.concatenate(b)))
