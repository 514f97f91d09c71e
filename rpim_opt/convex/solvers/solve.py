"""The minimum of loss(A z - b) + weight * penalty(z) subject to constraints(z): one dispatch for every formulation."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.expressions import OutsideDomain
from rpim_opt.convex.solvers.conic import (
    EQUILIBRATED,
    Canonical,
    Damping,
    Point,
    ReducedProgram,
    ReducedSquares,
    Unsolved,
)
from rpim_opt.convex.solvers.separable import FEW_ENTRIES, TINY, Loss, Newton, Rows

if TYPE_CHECKING:
    from rpim_opt.convex.structure import Structure

GENERATIONS = 40
"""Working sets of entries before all rows are taken."""
INACTIVE = 1e-6
"""Part of the largest slope below which slopes are the same, and an entry of a loss is not active."""
GAP = 1e-8
"""Relative gap between a loss and its bound by tangents at which the working set suffices."""


@dataclass(eq=False)
class WarmStart:
    """Warm start of the next solution: point, smoothing width, the last working set, Clarabel's data."""

    structure: Structure
    z: Array | None = None
    x: Array | None = None
    width: float = 0.0
    count: int = 0
    part: tuple[np.ndarray, ReducedProgram] | None = None
    small: dict[Any, ReducedProgram] = field(default_factory=dict)
    jump: float = -1.0
    parts: dict[Structure, WarmStart] = field(default_factory=dict)
    lock: Any = field(default_factory=threading.RLock)

    @property
    def canonical(self) -> Canonical:
        """Penalty and constraints in canonical form."""
        return self.structure.canonical

    def program(self, rows: int, loss: Canonical | None = None, counts: np.ndarray | None = None) -> ReducedProgram:
        """Return the small program with so many rows of squares, and with all rows of a loss."""
        key = rows, loss is None
        if key not in self.small:
            self.small[key] = ReducedProgram(self.canonical, rows, loss, counts)
        return self.small[key]

    def begin(self, z: Array) -> WarmStart:
        """Discard all solvers, and start the next solution from z (n,)."""
        with self.lock:
            self.z = self.x = z if len(self.canonical.at) == self.canonical.size else None
            self.width, self.count, self.part, self.small = 0.0, 0, None, {}
        return self


def minimum(rows: Rows, warm: WarmStart, weight: float, damping: Damping | None = None) -> Point:
    """Return the minimum of a convex program; the structure of the loss selects the method.

    ============================ ===================================================
    quadratic                    the small program of its QR factor
    separable, few entries       all rows in Clarabel, where that is quicker
    separable, smooth            proximal Newton, a sequence of small programs
    separable, non-smooth        the same on the smoothed loss, then rows where it bends
    with a threshold             entries near a non-smooth point as they are, tangents of others
    any other                    all rows in Clarabel
    ============================ ===================================================

    Of quadratic losses and penalties without constraints or damping `Program.solve` knows a formula.
    Penalty and constraints select what solves a small program of n + 1 rows: an active set where they are linear or
    quadratic, else Clarabel. Entries are equations, or configurations where the loss gets their norms.

    Unsolved where no minimum is found, also by a small program of proximal Newton: then CVXPY solves all rows
    (`Program.solve`).
    """
    with warm.lock:
        loss = warm.structure.loss
        if loss is None:
            point = warm.program(rows.A.shape[1] + 1).solve(rows.squares.damped(damping), weight)
        elif not loss.separable:
            point = _coupled(loss, rows, warm, weight, damping)
        else:
            try:
                point = _by_newton(loss, rows, warm, weight, damping)
            except (OutsideDomain, np.linalg.LinAlgError):
                point = _all_rows(loss, rows, warm, weight, damping)
        warm.z, warm.x = point.x[warm.canonical.at], point.x
        return point


def _by_newton(loss: Loss, rows: Rows, warm: WarmStart, weight: float, damping: Damping | None) -> Point:
    few = loss.variable.size <= FEW_ENTRIES
    # piecewise linear: one program of all rows; piecewise quadratic: the same where Newton's first small programs would
    # need cones, too, or begin with an unknown active set
    begun = warm.z is not None
    quick = begun or (warm.canonical.polyhedral and warm.canonical.size == len(warm.canonical.at))
    if few and (loss.expression.is_pwl() or (loss.piecewise_quadratic and not quick)):
        return _all_rows(loss, rows, warm, weight, damping)
    if warm.jump < 0:
        warm.jump = loss.slope_jump(rows)
    if few and warm.jump:
        return _all_rows(loss, rows, warm, weight, damping)
    small = warm.program(rows.A.shape[1] + 1)
    z, x = warm.z, warm.x
    if z is None or x is None:
        x = small.solve(rows.squares.damped(damping), weight).x
        z = x[warm.canonical.at]
    search = Newton(loss, rows, warm.canonical, small, weight, damping, warm.jump)
    if warm.jump:
        z, warm.width = search.non_smooth(z, x, warm.width, begun)
    else:
        z = search.smooth(z, x)
    if not np.isfinite(z).all():
        raise OutsideDomain
    dual = np.zeros(len(warm.canonical.b)) if search.point is None else search.point.dual
    return Point(search.x, dual, search.steps)


# --- losses that are no sums over entries ----------------------------------------------------------------------


def _alone(n: int, damping: Damping | None) -> ReducedSquares:
    """Return the quadratic terms beside a loss that is taken as it is: the damping, or none."""
    return ReducedSquares(np.zeros((0, n)), np.zeros(0), np.zeros(n)).damped(damping)


def _all_rows(loss: Loss, rows: Rows, warm: WarmStart, weight: float, damping: Damping | None) -> Point:
    """Return the minimum with all rows of the loss in Clarabel."""
    terms = _alone(rows.A.shape[1], damping)
    whole = warm.program(len(terms.y), loss.canonical, rows.counts if loss.positive else None)
    return whole.solve(terms, weight, rows.A, rows.b)


def _coupled(loss: Loss, rows: Rows, warm: WarmStart, weight: float, damping: Damping | None) -> Point:
    """Return the minimum of a loss with a threshold (a maximum, CVaR, the sum of the largest) by some of its entries.

    Those near a non-smooth point are taken as they are and all others by their tangents, which bounds the loss from
    below; those that then have other slopes are added until the bound is reached. Of any other loss all rows are taken.
    """
    n, at = rows.A.shape[1], warm.canonical.at
    if loss.variable.size <= FEW_ENTRIES or loss.threshold is None:
        return _all_rows(loss, rows, warm, weight, damping)
    terms = _alone(n, damping)
    z = warm.z
    if z is None:
        z = warm.program(n + 1).solve(rows.squares.damped(damping), weight).x[at]
    tangent = Tangent(loss, rows, rows.A @ z - rows.b)
    if not np.isfinite(tangent.value):
        return _all_rows(loss, rows, warm, weight, damping)
    working, small = warm.part or (None, None)
    if working is None:
        working = np.sort(tangent.near[: max(4 * n, warm.count or np.count_nonzero(tangent.pull))])
    for generation in range(GENERATIONS):
        outside = np.ones(loss.variable.size, dtype=bool)
        outside[working] = False
        slope = np.where(rows.by_equation(outside), tangent.slope, 0.0)
        if small is None or small.rows != len(terms.y):
            small = rows.program(loss, working, warm.canonical, len(terms.y))
            small.data.clarabel.attempts = (EQUILIBRATED,)
        part: Any = small.loss
        part.set_slope(loss.threshold, loss.rate + float(tangent.by_threshold[outside].sum()))
        try:
            point = small.solve(replace(terms, g=terms.g + rows.A.T @ slope), weight, *rows.equations(working))
        except Unsolved:
            if len(working) == len(outside):
                raise
            working, small = np.union1d(working, tangent.near[: 4 * len(working)]), None  # bounded too little
            continue
        r = rows.A @ point.x[at] - rows.b
        bound = part.value(point.rest) + float(slope @ r) + float(tangent.constant[outside].sum())
        there = Tangent(loss, rows, r)
        if there.value - bound <= GAP * max(abs(bound), 1.0):
            warm.count = len(working) // 2
            warm.part = None if generation else (working, small)
            return point
        other = np.flatnonzero(np.abs(there.pull - tangent.pull) > INACTIVE * np.abs(there.pull).max())
        more = np.union1d(working, np.union1d(other, there.near[: 4 * n]))
        if len(more) == len(working):
            break
        tangent, working, small = there, more, None
    return _all_rows(loss, rows, warm, weight, damping)


class Tangent:
    """The value of a loss with a threshold at a residual (m,), and tangents of its entries there, (N,) each.

    ``pull`` are slopes by the entries and ``slope`` (m,) by the equations.
    """

    def __init__(self, loss: Loss, rows: Rows, r: Array):
        self.v, one = rows.entries(r), np.ones(loss.variable.size)
        self.value, t = loss.best(self.v)
        self._entries, self._positive = loss.at_threshold(t), loss.positive
        values, pull = self._entries(self.v)
        by_threshold: Any = loss.by_threshold(self.v)
        self.pull, self.by_threshold = one * pull, one * by_threshold(t)[1]
        self.constant = values - pull * self.v - self.by_threshold * t
        self.slope = self.pull
        if loss.positive:
            self.slope = rows.by_equation(self.pull / np.maximum(self.v, TINY)) * r

    @cached_property
    def near(self) -> np.ndarray:
        """The entries (N,) in the order of their distance from a non-smooth point."""
        far = np.full(len(self.v), np.inf)
        for h in np.abs(self.v).max() * np.geomspace(2, 1e-8, 20):
            low = np.maximum(self.v - h, 0.0) if self._positive else self.v - h
            curved = np.abs(self._entries(self.v + h)[1] - self._entries(low)[1]) * np.ones(len(far))
            far[curved > INACTIVE * curved.max(initial=0.0)] = h
        return np.argsort(far, kind="stable")
