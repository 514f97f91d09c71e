"""Programs whose loss is a sum or the largest over rows or configurations, and whose penalty a square."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rpim_opt.basics.phases import phase
from rpim_opt.convex.closed import shares
from rpim_opt.convex.coordinates import Coordinates, coordinates
from rpim_opt.convex.interior import Found
from rpim_opt.convex.largest import Largest
from rpim_opt.convex.met import Near
from rpim_opt.convex.newton import Newton
from rpim_opt.convex.objective import Damping, Objective
from rpim_opt.convex.products import DEAR
from rpim_opt.convex.structure import Quadratic
from rpim_opt.convex.whitened import Ended
from rpim_opt.convex.worst import Worst


def by_rows(
    objective: Objective, weight: float, damping: Damping | None, near: Sequence[Near], rough: bool = False
) -> tuple[Found, Near] | None:
    """Return the minimum, and what a neighbour may begin with; None where this is no such program, or no end in sight.

    Parameters
    ----------
    objective
        The program.
    weight
        Of the penalty.
    damping
        A term that keeps the solution near a point.
    near
        Minima of neighbours: another weight, or a linearization nearby. The lowest one here is where it begins.
    rough
        Whether a point that a rule compares with others will do.
    """
    method = _method(objective, weight, damping, rough)
    if method is None:
        return None
    with phase("solve"), np.errstate(all="ignore"):
        ended = _ended(method, near)
    if ended is None or not (ended.good or ended.close):
        return None
    duals = ()
    if method.box is not None:
        duals = shares(objective, method.box, ended.z, method.multipliers(ended))
    return Found("optimal", ended.z, duals, max(ended.steps, 1)), Near(ended.z, ended.kinked, ended.of_loss, ended.loss)


def _method(objective: Objective, weight: float, damping: Damping | None, rough: bool) -> Newton | Worst | None:
    """Return what minimizes the program; None where its loss is no sum and no largest, or nothing is to be moved."""
    loss = objective.separated or objective.worst
    if loss is None:
        return None
    at = objective.coordinates
    if damping is not None:
        at = _damped(objective, weight, damping)
        weight = 1.0
    box = objective.box if objective.constrained else None
    method: Newton | Worst
    if isinstance(loss, Largest):
        method = Worst(loss, at, weight, box, rough)
    else:
        method = Newton(loss, at, weight, box, rough)
    if not at.B.shape[1] or (box is not None and not method.whole):
        return None
    return method


def _ended(method: Newton | Worst, near: Sequence[Near]) -> Ended | None:
    """Return the minimum begun next to a neighbour, or where that leads nowhere at that of squares."""
    if near:
        lowest = near[0]
        if len(near) > 1 and method.at.rows.size < DEAR:
            lowest = min(near, key=lambda each: method.objective(each.z))
        ended = method.minimum(lowest.z, lowest.kinked)
        if ended.good or ended.close:
            return ended
    return method.minimum(method.of_squares())


def _damped(objective: Objective, weight: float, damping: Damping) -> Coordinates:
    """Return coordinates in which penalty and damping are one penalty."""
    form = objective.penalty_form
    L = [np.diag(damping.size)]
    c = [damping.size * damping.centre]
    if form is not None and weight > 0:
        L.append(np.sqrt(weight) * form.matrix)
        c.append(np.sqrt(weight) * form.c)
    both = Quadratic(np.vstack(L), np.concatenate(c))
    return coordinates(objective.model, both, objective.order, multiplied=objective.separated is None)
