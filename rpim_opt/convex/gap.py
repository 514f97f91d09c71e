"""A bound on what a point lacks of a program's minimum: a duality gap, from the functions' own values and slopes."""

from __future__ import annotations

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.largest import Largest
from rpim_opt.convex.objective import Objective

BESIDE, ROUNDING = 1e-12, 1e-9
"""Where the slopes beside zero are taken, and by how much of them a proposed one may exceed them: it is cut back."""
FAR = 100.0
"""No minimum is this many times farther than the point, in what no penalty holds."""
RANK = 1e-10
"""A penalty that holds a direction by less than this part of the strongest holds it not at all."""


def duality_gap(objective: Objective, z: Array, weight: float, proposed: Array | None = None) -> float:
    """Return by how much the objective at z (n,) may lie above the minimum; infinite where that is not known.

    With y a slope (subgradient) of the convex loss at residuals r~, and a squared penalty, for every z' of the box::

        loss(A z' - b) + weight penalty(z') >= loss(r~) + y'(A z' - b - r~) + weight penalty(z')

    whose least value over z' is known: a linear function and a square. (Fenchel's inequality: y'r~ - loss(r~) is the
    loss's conjugate at y.) r~ is A z - b, and zero where the proposed y_i lies between the slopes on both sides of a
    kink there. Nothing else is taken from a solver, and a wrong proposal makes the gap larger. In directions that the
    penalty leaves free, the minimum is taken to lie within `FAR` times (1 + |z|) of z.

    Parameters
    ----------
    objective
        A program without constraints, or in a box, with a quadratic penalty or none.
    z, weight
        The point (n,), and the weight.
    proposed
        (m,) slopes of a loss that has kinks at zero, or is the largest of many.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> from rpim_opt.convex.gap import duality_gap
    >>> problem = ro.load("blunders").problem
    >>> program = ro.convex.pose(ro.robust, problem.linearize(np.zeros(len(problem.parameters.free))))
    >>> z = program.solve(1.0).z
    >>> duality_gap(program, z, 1.0) < 1e-9, duality_gap(program, 1.1 * z, 1.0) > 1.0
    (True, True)
    """
    posed = objective._posed
    known = objective.linear_penalty and (objective.box is not None or not objective.constrained)
    model = objective.model
    if not known or model.stands_for is not None or objective.violation(z) > 0:
        return float("inf")
    r = model.A @ z - model.b
    if objective.worst is not None:
        if proposed is None:
            return float("inf")
        return _of_largest(objective, objective.worst, z, weight, proposed)
    y = posed.loss_slope(r)
    if y is None or len(y) != len(r) or not np.isfinite(y).all():
        return float("inf")
    nearby = r
    if proposed is not None:
        nearby, y = _at_kinks(objective, r, y, proposed)
    missing = posed.loss_of(r) - posed.loss_of(nearby) - float(y @ (r - nearby))
    return max(missing, 0.0) + _fall(objective, z, weight, model.A.T @ y)


def _of_largest(objective: Objective, worst: Largest, z: Array, weight: float, proposed: Array) -> float:
    """Return the gap of a largest loss: by the mean of its groups with those shares that slopes (m,) tell of."""
    model = objective.model
    r = model.A @ z - model.b
    ordered = r[objective.order]
    shares = worst.shares(proposed[objective.order])
    slope = worst.slope(ordered, shares)
    y = np.empty(len(r))
    y[objective.order] = slope
    missing = objective._posed.loss_of(r) - worst.minorant(ordered, shares, slope)
    if not shares.any() or not np.isfinite(missing):
        return float("inf")
    return max(missing, 0.0) + _fall(objective, z, weight, model.A.T @ y)


def _at_kinks(objective: Objective, r: Array, y: Array, proposed: Array) -> tuple[Array, Array]:
    """Return residuals and slopes (m,): zero and the proposed ones, where those are slopes of the loss at zero."""
    posed = objective._posed
    nothing = np.zeros(len(posed.seen(r)))
    above = posed.slope_seen(nothing + BESIDE)
    below = posed.slope_seen(nothing - BESIDE)
    if above is None or below is None:
        return r, y
    if len(nothing) < len(r):  # norms of configurations
        size = np.sqrt(np.bincount(posed.groups, proposed**2))
        there = (size <= above * (1 + ROUNDING))[posed.groups]
        proposed = proposed * np.minimum(1.0, above / np.maximum(size, BESIDE))[posed.groups]
    else:
        there = (proposed >= below - ROUNDING * np.abs(below)) & (proposed <= above + ROUNDING * np.abs(above))
        proposed = np.clip(proposed, below, above)
    return np.where(there, 0.0, r), np.where(there, proposed, y)


def _fall(objective: Objective, z: Array, weight: float, slope: Array) -> float:
    """Return by how much slope'z' + weight penalty(z') may fall from z in the box, the data's slope (n,) given."""
    form = objective.penalty_form
    n = len(z)
    values, vectors = np.zeros(n), np.eye(n)
    if form is not None and weight > 0:
        slope = slope + 2 * weight * form.matrix.T @ (form.times(z) - form.c)
        values, vectors = np.linalg.eigh(weight * form.matrix.T @ form.matrix)
    if objective.box is not None:
        lower, upper = objective.box
        held = ((z <= lower) & (slope > 0)) | ((z >= upper) & (slope < 0))
        slope = np.where(held, 0.0, slope)
    along = vectors.T @ slope
    curved = values > RANK * np.max(values, initial=0.0)
    fall = float(np.sum(along[curved] ** 2 / (4 * values[curved])))
    return fall + FAR * (1 + float(np.linalg.norm(z))) * float(np.linalg.norm(along[~curved]))
