"""Minima of the largest of many norms with a squared penalty: sequential quadratic programs, ended by a duality gap."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.epigraph import Epigraph, Least
from rpim_opt.convex.largest import Largest
from rpim_opt.convex.met import Kinked
from rpim_opt.convex.whitened import ACCEPTED, FLAT, PROMISED, SOUGHT, Best, Ended, Whitened

MOST, CHANGES = 40, 1000
"""Quadratic programs, and changes of the set in each, after which another method is asked."""
HALVES = 11
"""How often a step is halved at most."""
SOON = 10
"""Quadratic programs after which a neighbour was too far to begin with."""
NEAR = 1e-2
"""Gaps below this part of the objective tell whether a step was good; larger ones do not."""
FALL = 0.1
"""Part of what the quadratic program promises that a step has to keep, or its gap is this much smaller."""


class Point(NamedTuple):
    """Where the method is: z (n,), coordinates a (p,), residual (m,), shares (N,), the gap and what belongs to it."""

    z: Array
    a: Array
    r: Array
    shares: Array
    ended: Ended


class Bounds(NamedTuple):
    """Finite bounds: of which components (j,), at what (j,), and rows by steps (j, p) that point outwards."""

    of: np.ndarray
    at: Array
    rows: Array


@dataclass(frozen=True, eq=False)
class Worst(Whitened):
    """minimize  max_k (a_k |r_k| + c_k) + weight |L z - c|^2  in a box, of residuals r = A z - b in groups.

    The groups' numbers are linearized, with the second derivatives of those that have a share (a multiplier: the
    shares of all add up to one), and `Epigraph` solves that. Few groups have one: at most one more than unknowns. The
    shares are the subgradient whose gap ends the method, and that of a neighbour is where it begins.

    Parameters
    ----------
    loss
        Whose groups.
    at, weight, box
        As for `Whitened`.
    rough
        Whether a gap will do that is small enough for a rule, which compares points, or that a quadratic program
        promises to lower the objective by no more than `PROMISED` of it.
    """

    loss: Largest
    rough: bool = False

    def minimum(self, z: Array, kinked: Kinked | None = None) -> Ended:
        """Return the minimum, or the best point that was met, begun at z (n,) with the shares of a neighbour."""
        z, a = self.placed(z)
        r = self.at.rows @ a - self.at.b
        count = len(self.loss.a)
        shares = np.full(count, 1.0 / count)
        if kinked is not None and kinked.multipliers:
            shares = kinked.multipliers[0]
        point = self._point(z, a, r, shares, 0)
        best = Best(point.ended)
        most = MOST if kinked is None else SOON
        sought = ACCEPTED if self.rough else SOUGHT
        for steps in range(1, most + 1):
            if best.will_do(sought):
                break
            ahead = self._next(point, steps)
            if ahead is None:
                break
            if ahead.ended.close:
                return ahead.ended
            point = ahead
            best.meets(point.ended)
        return best.ended

    def _point(self, z: Array, a: Array, r: Array, shares: Array, steps: int) -> Point:
        of_loss = self.loss.slope(r, shares)
        loss = self.loss.at(r)
        gap, by_z = self.bound(z, a, self.slope(a, of_loss))
        gap += max(loss - self.loss.minorant(r, shares, of_loss), 0.0)
        objective = loss + float(self.pull @ a**2)
        return Point(z, a, r, shares, Ended(z, gap, objective, loss, steps, Kinked([shares], 1.0), by_z, of_loss))

    def _next(self, point: Point, steps: int) -> Point | None:
        """Return the point after a quadratic program, or the same where it is close; None where that leads nowhere."""
        least = self._step(point)
        if least is None:
            return None
        promised = point.ended.objective - least.t - float(self.pull @ (point.a + self.unit * least.d) ** 2)
        if self.rough and promised <= PROMISED * abs(point.ended.objective):
            return point._replace(ended=point.ended._replace(close=True))
        whole = self._moved(point, least, 1.0, steps)
        near = NEAR * abs(point.ended.objective)
        if whole.ended.gap <= (1 - FALL) * point.ended.gap and whole.ended.gap <= near:
            return whole
        return self._shortened(point, least, whole, promised, steps)

    def _shortened(self, point: Point, least: Least, whole: Point, promised: float, steps: int) -> Point | None:
        """Return the point after a step that keeps enough of its promise: all of it, bent, or part; None for none."""
        objective = point.ended.objective
        if objective - whole.ended.objective >= FALL * promised:
            return whole
        bent = self._moved(point, self._bent(least, whole), 1.0, steps)
        if objective - bent.ended.objective >= FALL * promised:
            return bent
        t = 1.0
        for _ in range(HALVES):
            t /= 2
            ahead = self._moved(point, least, t, steps)
            if objective - ahead.ended.objective >= FALL * t * promised:
                return ahead
        return None

    def _bent(self, least: Least, whole: Point) -> Least:
        """Return the step that makes equal, after the curved norms, what the straight ones made equal."""
        values = self.loss.values(whole.r)
        groups = least.active < len(values)
        excess = np.zeros(len(groups))
        excess[groups] = values[least.active[groups]] - least.t
        return least._replace(d=least.d + least.bend @ excess)

    def _moved(self, point: Point, least: Least, t: float, steps: int) -> Point:
        """Return the point after part of a step, with the shares that belong to all of it."""
        count = len(self.loss.a)
        a = point.a + t * self.unit * least.d
        r = self.at.rows @ a - self.at.b
        z = self.at.offset + self.at.B @ a
        if self.box is not None:
            z = np.clip(z, *self.box)
            held = np.flatnonzero(least.shares[count:])
            if t == 1.0:  # free of rounding
                z[self._bounds.of[held]] = self._bounds.at[held]
        return self._point(z, a, r, least.shares[:count], steps)

    def _step(self, point: Point) -> Least | None:
        loss = self.loss
        G = loss.projected(self.at.rows, point.r) * self.unit
        values = loss.values(point.r)
        H = self._hessian(point, G)
        g = 2 * self.unit * self.pull * point.a
        start = point.shares.nonzero()[0]
        s = np.ones(len(values))
        if self.box is not None:
            room = np.abs(self._bounds.at - point.z[self._bounds.of])
            start = np.append(start, len(s) + np.flatnonzero(room == 0))
            values, s = np.append(values, -room), np.append(s, np.zeros(len(room)))
            G = np.vstack([G, self._bounds.rows])
        return Epigraph(H, g, values, G, s).minimum(start, CHANGES)

    @cached_property
    def _bounds(self) -> Bounds:
        lower, upper = self.box or (np.empty(0), np.empty(0))
        low, high = np.flatnonzero(np.isfinite(lower)), np.flatnonzero(np.isfinite(upper))
        by_step = self.at.B * self.unit
        rows = np.vstack([-by_step[low], by_step[high]])
        return Bounds(np.append(low, high), np.append(lower[low], upper[high]), rows)

    def _hessian(self, point: Point, G: Array) -> Array:
        """Return the second derivative (p, p) of the shares' mean and the penalty, by coordinates in their units.

        G (N, p) are the slopes of the groups' numbers.
        """
        heard, factor = self.loss.curvature(point.r, point.shares)
        H = np.zeros((len(self.unit), len(self.unit)))
        if len(heard):
            places = point.shares[self.loss.which].nonzero()[0]
            rows = self.at.rows[places] * self.unit
            by_row = np.repeat(factor, self.loss.sizes[heard])
            across = G[heard] / self.loss.a[heard, None]
            H = rows.T @ (by_row[:, None] * rows) - across.T @ (factor[:, None] * across)
        H.flat[:: len(H) + 1] += np.maximum(2 * self.pull * self.unit**2, FLAT)
        return H
