"""The minimum of loss(A z - b) + weight * penalty(z) subject to constraints(z): one dispatch for every formulation."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.canonical import Canonical
from rpim_opt.convex.solvers.newton import FEW, Newton, Rows, kink_of
from rpim_opt.convex.solvers.small import Point, Small, Squares, Unsolved
from rpim_opt.convex.solvers.summands import OutsideDomain, Summands

GENERATIONS = 40
"""Rounds of row generation before all rows are taken."""
VIOLATED = 1e-8
"""Part of the largest entry by which an inequality of a left-out row may be missed."""


@dataclass(frozen=True, eq=False)
class Loss:
    """A loss that is no square, as the solver sees it.

    Parameters
    ----------
    expression, variable
        Expression of residuals (m,), or of configurations' norms (N,), and the variable that stands for them.
    limits
        Constraints of that variable.
    over_norms
        Whether the variable stands for norms.
    """

    expression: Any
    variable: Any
    limits: tuple[Any, ...]
    over_norms: bool

    def __post_init__(self) -> None:
        summands = Summands(self.expression, self.variable, self.over_norms)
        object.__setattr__(self, "summands", summands if summands.separable and not self.limits else None)

    summands: Summands | None = None

    def canonical(self) -> Canonical:
        """Return the loss in canonical form."""
        return Canonical(self.expression, self.limits, self.variable)


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

    def begun(self, z: Array | None) -> Warm:
        """Return another one that shares what does not change, to begin at z (n,) or anew."""
        other = Warm(self.penalty, canonical=self.canonical, kink=self.kink)
        if z is not None and len(self.penalty.at) == self.penalty.size:
            other.z, other.x = z, z
        return other


@dataclass(frozen=True, eq=False)
class Minimum:
    """A minimum z (n,), x (N,) of the penalty's form, multipliers of its rows, the loss's slopes where known."""

    z: Array
    x: Array
    dual: Array
    iterations: int
    slope: Array | None = None


def minimum(
    loss: Loss | None,
    rows: Rows,
    warm: Warm,
    weight: float,
    squares: Squares | None = None,
    size: Array | None = None,
    centre: Array | None = None,
    accuracy: float = 0.0,
) -> Minimum:
    """Return the minimum of a convex program; what solves it is told by the structure of the loss.

    ========================== =====================================================
    quadratic                  the small program of its QR factor
    separable, smooth          proximal Newton, a sequence of small programs
    separable, non-smooth      the same on the smoothed loss, then rows near kinks;
                               of at most `FEW` entries all rows as they are
    any other                  row generation where rows stand in inequalities alone,
                               else all rows
    ========================== =====================================================

    Parameters
    ----------
    loss, rows
        What the loss is, and its equations; a quadratic one is None, with ``squares``.
    warm
        Where the last minimum was; this one is left there.
    weight
        Of the penalty.
    squares
        The quadratic part of the loss.
    size, centre
        (n,) damping |size (z - centre)|^2.
    accuracy
        Part of the loss that a sum over rows may be above its minimum.

    Raises
    ------
    Unsolved
        Where there is no minimum, or the solver does not find it.
    """
    with warm.lock:
        n = rows.A.shape[1]
        if loss is None:
            point = warm.program(n + 1).solve((squares or rows.squares).damped(size, centre), weight)
        elif loss.summands is None:
            point = _coupled(loss, rows, warm, weight, squares, size, centre)
        else:
            try:
                point = _separable(loss, rows, warm, weight, size, centre, accuracy)
            except (OutsideDomain, np.linalg.LinAlgError, FloatingPointError):
                point = _all_rows(loss, rows, warm, weight, None, size, centre)
        z = point.x[warm.penalty.at]
        warm.z, warm.x = z, point.x
        return Minimum(z, point.x, point.dual, point.iterations, point.slope)


def _separable(
    loss: Loss, rows: Rows, warm: Warm, weight: float, size: Array | None, centre: Array | None, accuracy: float
) -> Point:
    summands = loss.summands
    if summands is None:
        raise OutsideDomain
    if warm.kink < 0:
        warm.kink = kink_of(summands, rows)
    if warm.kink and summands.variable.size <= FEW:
        return _all_rows(loss, rows, warm, weight, None, size, centre)
    small = warm.program(rows.A.shape[1] + 1)
    z, x = warm.z, warm.x
    known = z is not None and x is not None and len(x) == warm.penalty.size
    if z is None or x is None or not known:
        x = small.solve(rows.squares.damped(size, centre), weight).x
        z = x[warm.penalty.at]
    search = Newton(summands, rows, warm.penalty, small, weight, size, centre, warm.kink, warm.exact, accuracy)
    if warm.kink:
        z, warm.width = search.non_smooth(z, x, warm.width, known)
    else:
        z = search.smooth(z, x)
    if not np.isfinite(z).all():
        raise OutsideDomain
    dual = np.zeros(len(warm.penalty.b)) if search.point is None else search.point.dual
    return Point(search.x, dual, search.steps)


# --- losses that are no sums over entries ----------------------------------------------------------------------


def _canonical(loss: Loss, warm: Warm) -> Canonical:
    if warm.canonical is None:
        warm.canonical = loss.canonical()
    return warm.canonical


def _stacked(squares: Squares | None, n: int, size: Array | None, centre: Array | None) -> Squares | None:
    """Return the quadratic terms beside a loss that is taken as it is; None where there are none."""
    if squares is None and size is None:
        return None
    return (squares or Squares(np.zeros((n + 1, n)), np.zeros(n + 1), np.zeros(n))).damped(size, centre)


def _all_rows(
    loss: Loss,
    rows: Rows,
    warm: Warm,
    weight: float,
    squares: Squares | None,
    size: Array | None,
    centre: Array | None,
) -> Point:
    """Return the minimum with all rows of the loss in Clarabel."""
    n = rows.A.shape[1]
    terms = _stacked(squares, n, size, centre)
    count = 0 if terms is None else n + 1
    if count not in warm.direct:
        sizes = rows.sizes if loss.over_norms else None
        warm.direct[count] = Small(warm.penalty, count, _canonical(loss, warm), sizes)
    return warm.direct[count].solve(terms, weight, rows.A, rows.b)


def _coupled(
    loss: Loss,
    rows: Rows,
    warm: Warm,
    weight: float,
    squares: Squares | None,
    size: Array | None,
    centre: Array | None,
) -> Point:
    """Return the minimum by row generation.

    A loss whose entries stand in inequalities alone (a maximum, CVaR, the sum of the largest) is solved for some
    entries, which bounds it from below, and for those that it then violates, until there are none.
    """
    canonical = _canonical(loss, warm)
    count, n = loss.variable.size, rows.A.shape[1]
    if count <= FEW or not _in_inequalities(canonical):
        return _all_rows(loss, rows, warm, weight, squares, size, centre)
    touched = canonical.A[:, canonical.at].tocoo()
    owner = np.full(len(canonical.b), -1)
    owner[touched.row] = touched.col
    terms = _stacked(squares, n, size, centre)
    entries = rows.entries if loss.over_norms else lambda r: r
    if not len(warm.working):
        start = warm.program(n + 1).solve(rows.squares.damped(size, centre), weight)
        v = entries(rows.A @ start.x[warm.penalty.at] - rows.b)
        warm.working = np.sort(np.argsort(-np.abs(v))[: 4 * n])
        warm.z = start.x[warm.penalty.at]
    for _ in range(GENERATIONS):
        sizes = rows.sizes[warm.working] if loss.over_norms and rows.sizes is not None else None
        part = canonical.part(warm.working, owner)
        small = Small(warm.penalty, 0 if terms is None else n + 1, part, sizes)
        A, b = rows.of(warm.working)
        try:
            point = small.solve(terms, weight, A, b)
        except Unsolved as error:
            if "DualInfeasible" not in str(error) or len(warm.working) == count or warm.z is None:
                raise
            v = entries(rows.A @ warm.z - rows.b)  # too few rows to bound the loss from below
            warm.working = np.sort(np.argsort(-np.abs(v))[: min(2 * len(warm.working), count)])
            continue
        warm.z = point.x[warm.penalty.at]
        v = entries(rows.A @ warm.z - rows.b)
        slope = np.zeros(len(rows.b))
        slope[rows.places(warm.working)] = point.slope
        more = _violated(canonical, owner, warm.working, v, point.rest)
        if not len(more):
            return replace(point, slope=slope)
        warm.working = np.union1d(warm.working, more[: max(4 * n, len(warm.working))])
    return _all_rows(loss, rows, warm, weight, squares, size, centre)


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
