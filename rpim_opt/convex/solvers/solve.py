"""The minimum of loss(A z - b) + weight * penalty(z) subject to constraints(z): one dispatch for every formulation."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.expressions import OutsideDomain
from rpim_opt.convex.solvers.conic import Canonical, Damping, Point, ReducedProgram, ReducedSquares, Unsolved
from rpim_opt.convex.solvers.separable import FEW_ENTRIES, Loss, Newton, Rows

if TYPE_CHECKING:
    from rpim_opt.convex.structure import Structure

GENERATIONS = 40
"""Most working sets of entries before all rows are used."""
GAP = 1e-8
"""Relative amount by which an entry may exceed the largest one of the working set."""


@dataclass(eq=False)
class WarmStart:
    """Warm start of the next solution: the canonical form's point x (N,), smoothing width, last working set, data."""

    structure: Structure
    x: Array | None = None
    width: float = 0.0
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
        """Return the reduced program with a number of rows of squares, and with all rows of a loss."""
        key = rows, loss is None
        if key not in self.small:
            self.small[key] = ReducedProgram(self.canonical, rows, loss, counts)
        return self.small[key]

    def begin(self, z: Array) -> WarmStart:
        """Discard all solvers, and start the next solution from z (n,)."""
        with self.lock:
            self.x = z if len(self.canonical.at) == self.canonical.size else None
            self.width, self.part, self.small = 0.0, None, {}
        return self


def minimum(rows: Rows, warm: WarmStart, weight: float, damping: Damping | None = None) -> Point:
    """Return the minimum of a convex program; the structure of the loss selects the method.

    ============================ ===================================================
    quadratic                    the small program of its QR factor
    separable, few entries       all rows in Clarabel, where that is quicker
    separable, smooth            proximal Newton, a sequence of small programs
    separable, non-smooth        the same on the smoothed loss, then exact rows near non-smooth points
    the largest entries          a working set of the largest entries
    any other                    all rows in Clarabel
    ============================ ===================================================

    For quadratic losses and penalties without constraints or damping `Program.solve` has a closed form. Penalty and
    constraints select the solver of a small program (n + 1 rows): an active-set method if they are linear or quadratic,
    otherwise Clarabel. Entries are equations, or configurations if the loss gets their norms.

    Unsolved if no minimum is found, also for a small program of proximal Newton: CVXPY then solves all rows
    (`Program.solve`).
    """
    with warm.lock:
        loss = warm.structure.loss
        if loss is None:
            point = warm.program(rows.A.shape[1] + 1).solve(rows.squares.damped(damping), weight)
        elif not loss.separable:
            point = _by_largest(loss, rows, warm, weight, damping)
        else:
            try:
                point = _by_newton(loss, rows, warm, weight, damping)
            except (OutsideDomain, np.linalg.LinAlgError):
                point = _all_rows(loss, rows, warm, weight, damping)
        warm.x = point.x
        return point


def _by_newton(loss: Loss, rows: Rows, warm: WarmStart, weight: float, damping: Damping | None) -> Point:
    few = loss.variable.size <= FEW_ENTRIES
    # piecewise linear: one program of all rows; piecewise quadratic: the same if Newton's first small programs need
    # cones, or start with an unknown active set
    begun = warm.x is not None
    quick = begun or (warm.canonical.polyhedral and warm.canonical.size == len(warm.canonical.at))
    if few and (loss.expression.is_pwl() or (not quick and loss.expression.is_qpwa())):
        return _all_rows(loss, rows, warm, weight, damping)
    if warm.jump < 0:
        warm.jump = loss.slope_jump(rows)
    if few and warm.jump:
        return _all_rows(loss, rows, warm, weight, damping)
    small = warm.program(rows.A.shape[1] + 1)
    x = warm.x
    if x is None:
        x = small.solve(rows.squares.damped(damping), weight).x
    search = Newton(loss, rows, warm.canonical, small, weight, damping, warm.jump, x)
    if warm.jump:
        warm.width = search.non_smooth(warm.width, begun)
    else:
        search.smooth()
    if not np.isfinite(search.x[warm.canonical.at]).all():
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


def _by_largest(loss: Loss, rows: Rows, warm: WarmStart, weight: float, damping: Damping | None) -> Point:
    """Return the minimum of the largest entries (minimax, CVaR) by a working set; of other losses all rows are used.

    The largest of some entries are a lower bound for those of all; entries that exceed them are then added.
    """
    n, at = rows.A.shape[1], warm.canonical.at
    if loss.variable.size <= FEW_ENTRIES or loss.entries is None:
        return _all_rows(loss, rows, warm, weight, damping)
    terms = _alone(n, damping)
    working, small = warm.part or (np.zeros(0, dtype=int), None)
    x = warm.x
    if x is None:
        x = warm.program(n + 1).solve(rows.squares.damped(damping), weight).x
    values = loss.values(rows.entries(rows.A @ x[at] - rows.b))
    for _ in range(GENERATIONS):
        if small is None or small.rows != len(terms.y):
            working = np.union1d(working, np.argsort(-values)[: 4 * n + int(loss.largest)])
            small = rows.program(loss, working, warm.canonical, len(terms.y))
        try:
            point = small.solve(terms, weight, *rows.equations(working))
        except Unsolved:  # the program of some entries may be unbounded
            break
        values = loss.values(rows.entries(rows.A @ point.x[at] - rows.b))
        most = loss.total(values[working])
        if loss.total(values) - most <= GAP * max(abs(most), 1.0):
            warm.part = working, small
            return point
        small = None
    return _all_rows(loss, rows, warm, weight, damping)
