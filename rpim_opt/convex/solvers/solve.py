"""The minimum of loss(A z - b) + weight * penalty(z) subject to constraints(z): one dispatch for every formulation."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.solvers.conic import Canonical, Damping, Point, Small, Squares, Unsolved
from rpim_opt.convex.solvers.separable import FEW, Loss, Newton, OutsideDomain, Rows, kink_of

GENERATIONS = 40
"""Rounds of row generation before all rows are taken."""
INACTIVE = 1e-6
"""Part of the largest slope below which an entry of a loss is not active."""
VIOLATED = 1e-8
"""Part of the largest entry by which an inequality of a left-out row may be missed."""


@dataclass(eq=False)
class Warm:
    """What one solution leaves to the next: the point, the width of smoothing, active rows, Clarabel's data."""

    penalty: Canonical
    z: Array | None = None
    x: Array | None = None
    width: float = 0.0
    working: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    small: dict[int, Small] = field(default_factory=dict)
    exact: dict[int, Small] = field(default_factory=dict)
    direct: dict[int, Small] = field(default_factory=dict)
    canonical: Canonical | None = None
    kink: float = -1.0
    lock: Any = field(default_factory=threading.RLock)

    def program(self, rows: int) -> Small:
        """Return the small program with so many rows of squares."""
        if rows not in self.small:
            self.small[rows] = Small(self.penalty, rows)
        return self.small[rows]

    def form(self, loss: Loss) -> Canonical:
        """Return the loss in canonical form."""
        if self.canonical is None:
            self.canonical = Canonical(loss.expression, loss.limits, loss.variable)
        return self.canonical

    def begun(self, z: Array | None) -> Warm:
        """Return another one that shares what does not change, to begin at z (n,) or anew."""
        other = Warm(self.penalty, canonical=self.canonical, kink=self.kink)
        if z is not None and len(self.penalty.at) == self.penalty.size:
            other.z, other.x = z, z
        return other


def minimum(
    loss: Loss | None,
    rows: Rows,
    warm: Warm,
    weight: float,
    squares: Squares | None = None,
    damping: Damping | None = None,
    accuracy: float = 0.0,
) -> Point:
    """Return the minimum of a convex program; what solves it is told by the structure of the loss.

    ========================== =====================================================
    quadratic                  the small program of its QR factor
    separable, smooth          proximal Newton, a sequence of small programs
    separable, non-smooth      the same on the smoothed loss, then rows near kinks;
                               of at most `FEW` entries all rows as they are
    any other                  row generation where rows stand in inequalities alone,
                               else all rows
    ========================== =====================================================

    A quadratic loss is None, with ``squares``, which are also what is quadratic beside another loss. ``accuracy`` is
    the part of the loss that a sum over rows may be above its minimum. Unsolved where no minimum is found.
    """
    with warm.lock:
        n = rows.A.shape[1]
        if loss is None:
            point = warm.program(n + 1).solve((squares or rows.squares).damped(damping), weight)
        elif not loss.separable:
            point = _coupled(loss, rows, warm, weight, squares, damping)
        else:
            try:
                point = _separable(loss, rows, warm, weight, damping, accuracy)
            except (OutsideDomain, np.linalg.LinAlgError, FloatingPointError):
                point = _all_rows(loss, rows, warm, weight, None, damping)
        warm.z, warm.x = point.x[warm.penalty.at], point.x
        return point


def _separable(
    loss: Loss,
    rows: Rows,
    warm: Warm,
    weight: float,
    damping: Damping | None,
    accuracy: float,
) -> Point:
    if warm.kink < 0:
        warm.kink = kink_of(loss, rows)
    if warm.kink and loss.variable.size <= FEW:
        return _all_rows(loss, rows, warm, weight, None, damping)
    small = warm.program(rows.A.shape[1] + 1)
    z, x = warm.z, warm.x
    known = z is not None and x is not None and len(x) == warm.penalty.size
    if z is None or x is None or not known:
        x = small.solve(rows.squares.damped(damping), weight).x
        z = x[warm.penalty.at]
    search = Newton(loss, rows, warm.penalty, small, weight, damping, warm.kink, warm.exact, accuracy)
    if warm.kink:
        z, warm.width = search.non_smooth(z, x, warm.width, known)
    else:
        z = search.smooth(z, x)
    if not np.isfinite(z).all():
        raise OutsideDomain
    dual = np.zeros(len(warm.penalty.b)) if search.point is None else search.point.dual
    return Point(search.x, dual, search.steps)


# --- losses that are no sums over entries ----------------------------------------------------------------------


def _beside(squares: Squares | None, n: int, damping: Damping | None) -> Squares | None:
    """Return the quadratic terms beside a loss that is taken as it is; None where there are none."""
    if squares is None and damping is None:
        return None
    return (squares or Squares(np.zeros((n + 1, n)), np.zeros(n + 1), np.zeros(n))).damped(damping)


def _all_rows(
    loss: Loss, rows: Rows, warm: Warm, weight: float, squares: Squares | None, damping: Damping | None
) -> Point:
    """Return the minimum with all rows of the loss in Clarabel."""
    n = rows.A.shape[1]
    terms = _beside(squares, n, damping)
    count = 0 if terms is None else n + 1
    if count not in warm.direct:
        warm.direct[count] = Small(warm.penalty, count, warm.form(loss), rows.sizes if loss.positive else None)
    return warm.direct[count].solve(terms, weight, rows.A, rows.b)


def _coupled(
    loss: Loss, rows: Rows, warm: Warm, weight: float, squares: Squares | None, damping: Damping | None
) -> Point:
    """Return the minimum by row generation.

    A loss whose entries stand in inequalities alone (a maximum, CVaR, the sum of the largest) is solved for some
    entries, which bounds it from below, and for those that it then violates, until there are none.
    """
    canonical = warm.form(loss)
    count, n = loss.variable.size, rows.A.shape[1]
    if count <= FEW or not _in_inequalities(canonical):
        return _all_rows(loss, rows, warm, weight, squares, damping)
    touched = canonical.A[:, canonical.at].tocoo()
    owner = np.full(len(canonical.b), -1)
    owner[touched.row] = touched.col
    terms = _beside(squares, n, damping)
    entries = rows.entries if loss.positive else lambda r: r
    if not len(warm.working):
        start = warm.program(n + 1).solve(rows.squares.damped(damping), weight)
        v = entries(rows.A @ start.x[warm.penalty.at] - rows.b)
        warm.working = np.sort(np.argsort(-np.abs(v))[: 4 * n])
        warm.z = start.x[warm.penalty.at]
    for _ in range(GENERATIONS):
        sizes = rows.sizes[warm.working] if loss.positive and rows.sizes is not None else None
        part = canonical.part(warm.working, owner)
        small = Small(warm.penalty, 0 if terms is None else n + 1, part, sizes)
        A, b = rows.of(warm.working)
        try:
            point = small.solve(terms, weight, A, b)
        except Unsolved as error:
            if "DualInfeasible" not in str(error) or len(warm.working) == count or warm.z is None:
                raise
            v = entries(rows.A @ warm.z - rows.b)  # too few rows to bound the loss from below
            warm.working = np.sort(np.argsort(-np.abs(v))[: 4 * len(warm.working)])
            continue
        warm.z = point.x[warm.penalty.at]
        v = entries(rows.A @ warm.z - rows.b)
        more = _violated(canonical, owner, warm.working, v, point.rest)
        if len(more) and point.rest is not None:  # unknowns of the loss that nothing holds count as violated, too
            bound = part.value(point.rest)
            if canonical.at_best(v) - bound <= VIOLATED * max(abs(bound), 1.0):
                more = more[:0]
        if not len(more):  # the next minimum begins with what is active, and the largest beside it
            pull = np.zeros(len(rows.b))
            pull[rows.places(warm.working)] = point.slope
            size = np.abs(entries(pull))
            active = np.flatnonzero(size > INACTIVE * size.max())
            warm.working = np.union1d(active, np.argsort(-np.abs(v))[: len(active) + n])
            return point
        warm.working = np.union1d(warm.working, more[: max(4 * n, len(warm.working))])
    return _all_rows(loss, rows, warm, weight, squares, damping)


def _in_inequalities(canonical: Canonical) -> bool:
    """Whether the entries stand in inequalities alone."""
    at = canonical.at
    rows = np.unique(canonical.A[:, at].tocoo().row)
    free = not np.any(canonical.q[at]) and not abs(canonical.P[:, at]).nnz
    return bool(free and ((rows >= canonical.zero) & (rows < canonical.linear)).all())


def _violated(canonical: Canonical, owner: np.ndarray, working: np.ndarray, v: Array, rest: Array | None) -> np.ndarray:
    """Return the entries (k,) outside the working set whose inequalities are violated, the worst first."""
    count = len(canonical.at)
    left = np.setdiff1d(np.arange(count), working)
    full = np.zeros(canonical.size)
    full[np.setdiff1d(np.arange(canonical.size), canonical.at[left])] = rest
    full[canonical.at] = v
    over = (canonical.A @ full - canonical.b)[canonical.zero : canonical.linear]
    mine = owner[canonical.zero : canonical.linear]
    bad = (over > VIOLATED * (1 + np.abs(v).max())) & (mine >= 0)
    worst = np.zeros(count)
    np.maximum.at(worst, mine[bad], over[bad])
    more = np.setdiff1d(np.unique(mine[bad]), working)
    return more[np.argsort(-worst[more])]
