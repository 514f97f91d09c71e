"""Minima of losses that are sums over rows: Newton's method on whitened unknowns, ended by a duality gap."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import get_lapack_funcs, solve_triangular

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.active_set import minimum_in_box
from rpim_opt.convex.line_search import searched
from rpim_opt.convex.met import Kinked
from rpim_opt.convex.products import DEAR, weighed_squares
from rpim_opt.convex.separated import Curvature, Separated, Smoothed
from rpim_opt.convex.whitened import FLAT, PROMISED, Best, Ended, Whitened

MOST, SOON = 100, 30
"""Steps of Newton's, after which another method is asked, and after which a neighbour's kinks are too sharp."""
BLUNT = 10.0
"""How sharp they then are, relative to those that a loss without multipliers begins with."""
SHARPER, SHARPEST = 5.0, 1e9
"""By what factor kinks are sharpened, and how sharp they become at most, relative to the first."""
SETTLED = 0.3
"""Multipliers take a step when the smoothed objective may fall by no more than this part of what the kinks miss."""
ENOUGH = 5e-11
"""Duality gap, relative to the objective, that ends steps with such ones."""
TELLING = 300
"""Rows a coordinate that tell a second derivative to about a tenth, 2 / sqrt(300), as the first one of a descent."""
STRIDES = (1, 3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53, 59, 61)
"""Of every so many groups one is taken: odd primes, which meet all robots and reflectors that take turns."""
SLOW = 0.05
"""Part of what a step with an old second derivative promises that it may leave."""
ROUND = 1e-12
"""Changes of slope below this part of what lengths allow tell nothing."""
CANCELLED = 1e-4
"""Part of the longest residual on the way that is left of it when it is computed anew: steps add up its rounding."""

_potrf: Any
_potrs: Any
_potrf, _potrs = get_lapack_funcs(("potrf", "potrs"), (np.empty(1),))


class Point(NamedTuple):
    """Where the method is: z (n,), coordinates a (p,), residual (m,), the kinks' state, and the smoothed loss there.

    With the loss's slope by the coordinates (p,), where a descent has been, and the square of the longest residual that
    it was added up from.
    """

    z: Array
    a: Array
    r: Array
    kinked: Kinked
    smooth: Smoothed
    along: Array | None = None
    longest: float = 0.0


@dataclass(frozen=True, eq=False)
class Newton(Whitened):
    """minimize  sum_i f_i(A_i z - b_i) + weight |L z - c|^2  in a box, by Newton's method.

    In unknowns that whiten data and penalty together the second derivative of a loss about the identity is well
    conditioned whatever the weight, so that a Cholesky factor of it serves. A step is followed by a search along it.
    A loss with kinks is smoothed about multipliers (`Separated`), which then take a step themselves. In a box the step
    is the minimum of the quadratic there, by the active set.

    The gap is that of `Whitened`, where the smoothed loss's slope at z is a subgradient.

    Parameters
    ----------
    loss
        f.
    at
        The coordinates.
    weight
        Of the penalty.
    box
        Lower and upper (n,), or None.
    rough
        Whether it will do that a quadratic promises to lower the objective by no more than `PROMISED` of it: a point
        that a rule compares with others. (Of small weights, a gap asks for far more: it knows of the penalty's
        curvature alone.)
    """

    loss: Separated
    rough: bool = False

    def minimum(self, z: Array, kinked: Kinked | None = None) -> Ended:
        """Return the minimum, or the best point that was met, begun at z (n,) with the multipliers of a neighbour.

        Where the neighbour was too far for kinks as sharp as there, they begin blunter. Many norms are first taken as
        they are: none of them may be zero at the minimum.
        """
        if self._dear:
            return self._by_secants(self._begin(z, kinked))
        if self._away is None:
            return self._with_kinks(z, kinked)
        begun = Kinked([], 1.0)
        if kinked is not None:
            begun = begun._replace(curved=kinked.curved)
        ended = self._away._by_secants(self._away._begin(z, begun), hasty=True)
        if ended.good or ended.close:
            return ended
        return self._with_kinks(ended.z, kinked)

    def _with_kinks(self, z: Array, kinked: Kinked | None) -> Ended:
        """Return the minimum of a loss whose kinks, if it has any, are smoothed about a neighbour's multipliers."""
        if kinked is None or not kinked.multipliers:  # a neighbour that met none knows nothing of them
            return self._descent(self._placed(z, None), MOST)
        ended = self._descent(self._placed(z, kinked), SOON, hasty=True)
        if ended.good or ended.close:
            return ended
        point = self._placed(ended.z, ended.kinked)
        sharpness = min(BLUNT * self._begun(point.r).sharpness, kinked.sharpness)
        return self._descent(self._about(point, ended.kinked._replace(sharpness=sharpness)), MOST)

    def _descent(self, point: Point, most: int, hasty: bool = False) -> Ended:
        """Return the best point of so many steps; a hasty one ends where some lower the gap no more."""
        slope = self._slope(point)
        ended = self._judged(point, slope, 0)
        best = Best(ended)
        for steps in range(1, most):
            if best.will_do(hasty=hasty):
                break
            ahead = self._next(point, slope, ended)
            if ahead is None:
                return ended._replace(close=True)
            if ahead is point:  # a kink that nothing told of: no step leads anywhere
                break
            point = ahead
            slope = self._slope(point)
            ended = self._judged(point, slope, steps)
            best.meets(ended)
        return best.ended

    @property
    def _dear(self) -> bool:
        """Whether a second derivative costs far more than a slope, and there is one that lasts."""
        return self.at.rows.size >= DEAR and not self.loss.kinks

    @cached_property
    def _away(self) -> Newton | None:
        """The same program away from kinks at norms of zero, where that is dear and there are some."""
        away = self.loss.away
        if away is None or self.at.rows.size < DEAR:
            return None
        return replace(self, loss=away)

    def _by_secants(self, point: Point, hasty: bool = False) -> Ended:
        """Return the minimum of a smooth loss with few second derivatives: with a neighbour's, and what slopes tell.

        Broyden, Fletcher, Goldfarb and Shanno's update after every step; where what steps promise does not fall fast
        with that, it is computed anew from some of the rows, and where that did not help, from all.
        """
        bent = self._known(point)
        every = self._stride
        point, slope = self._with_slope(point)
        ended = self._judged(point, slope, 0)
        best = Best(ended)
        for steps in range(1, MOST):
            if best.will_do(ENOUGH, hasty):
                break
            anew = bent is None
            if bent is None:
                bent = self._hessian(point, every)
            if self._close(slope, bent, ended):
                return self._with(ended._replace(close=True), bent, point)
            ahead = self._stepped(point, slope, bent)
            exact = anew and every == 1
            if exact and ahead is point:
                break
            left = self._left(slope, bent, ended)
            ahead, slope_ahead = self._with_slope(ahead)
            ended = self._judged(ahead, slope_ahead, steps)
            best.meets(ended)
            bent = self._updated(bent, point, ahead, slope_ahead - slope)
            if not exact and not self._left(slope_ahead, bent, ended) < SLOW * left:
                bent = None
                every = 1 if anew else self._stride
            point = ahead
            slope = slope_ahead
        return self._with(best.ended, bent, point)

    def _known(self, point: Point) -> Array | None:
        """Return a neighbour's second derivative of the loss (p, p), by the coordinates."""
        if point.kinked.curved is None:
            return None
        return self.at.B.T @ point.kinked.curved @ self.at.B

    def _begin(self, z: Array, kinked: Kinked | None) -> Point:
        """Return the point at z (n,): the last one where the last descent, of another weight, ended there."""
        loss, last = self.at.last.get("point", (None, None))
        if last is None or last.z is not z or loss is not self.loss or kinked is None:
            return self._placed(z, kinked)
        return last._replace(kinked=kinked)

    def _with(self, ended: Ended, bent: Array | None, point: Point) -> Ended:
        """Return where the method ended, with the loss's second derivative (p, p) for the next one."""
        if point.z is ended.z:
            self.at.last["point"] = (self.loss, point)
        if bent is None:
            return ended
        curved = self.at.inverse.T @ bent @ self.at.inverse
        return ended._replace(kinked=ended.kinked._replace(curved=curved))

    def _promised(self, slope: Array, bent: Array) -> float:
        """Return by how much the objective would fall, were it quadratic; infinite in a box."""
        if self.box is not None:
            return np.inf
        factor, failed = self._factored(bent)[1:]
        if failed:
            return np.inf
        return 0.5 * float(slope @ _potrs(factor, slope)[0])

    def _left(self, slope: Array, bent: Array, ended: Ended) -> float:
        """Return about by how much the objective would fall: as promised, or in a box the gap."""
        if self.box is not None:
            return ended.gap
        return self._promised(slope, bent)

    def _updated(self, bent: Array, before: Point, after: Point, change: Array) -> Array:
        """Return the loss's second derivative so that it explains by how much the objective's slope has changed."""
        step = after.a - before.a
        seen = self.unit > 0
        of_loss = np.divide(change, self.unit, out=np.zeros_like(change), where=seen) - 2 * self.pull * step
        along = bent @ step
        steep, flat = float(step @ of_loss), float(step @ along)
        if not (steep > ROUND * float(np.linalg.norm(step) * np.linalg.norm(of_loss)) and flat > 0):
            return bent
        return bent + np.outer(of_loss, of_loss / steep) - np.outer(along, along / flat)

    def _placed(self, z: Array, kinked: Kinked | None) -> Point:
        """Return the point at z (n,), or the one beside it that the coordinates can say."""
        z, a = self.placed(z)
        r = self.at.by_row(a) - self.at.b
        kinked = kinked or self._begun(r)
        return Point(z, a, r, kinked, self.loss.smoothed(r, *kinked[:2]))

    def _about(self, point: Point, kinked: Kinked) -> Point:
        """Return the same point with kinks in another state."""
        return point._replace(kinked=kinked, smooth=self.loss.smoothed(point.r, *kinked[:2]))

    def _next(self, point: Point, slope: Array, ended: Ended) -> Point | None:
        """Return the point after a step of Newton's, or of the multipliers where little else is left of the gap.

        None where the point will do for a rule.
        """
        if ended.missing > 0 and ended.gap - ended.missing <= SETTLED * ended.missing:
            sharpness = min(SHARPER * point.kinked.sharpness, SHARPEST)
            return self._about(point, Kinked(point.smooth.multipliers, sharpness))
        bent = self._hessian(point)
        if self._close(slope, bent, ended):
            return None
        ahead = self._stepped(point, slope, bent)
        if ahead is point and self.loss.kinks:  # no step is short enough for kinks so sharp
            return self._about(point, point.kinked._replace(sharpness=point.kinked.sharpness / SHARPER))
        return ahead

    def _close(self, slope: Array, bent: Array, ended: Ended) -> bool:
        """Whether a point will do for a rule that compares it with others."""
        room = PROMISED * abs(ended.objective) - ended.missing
        return self.rough and room > 0 and self._promised(slope, bent) <= room

    def _begun(self, r: Array) -> Kinked:
        """Return multipliers of zero, and kinks as blunt as the residuals are large."""
        if not self.loss.kinks:
            return Kinked([], 1.0)
        sizes = [np.median(np.abs(a * r + c)) for _, (a, c) in self.loss.kinks]
        factors = [np.median(factor) for factor, _ in self.loss.kinks]
        sharpness = max(f / max(s, 1e-9) for f, s in zip(factors, sizes, strict=True))
        return Kinked([np.zeros_like(r) for _ in self.loss.kinks], float(sharpness))

    def _slope(self, point: Point) -> Array:
        """Return the slope of the smoothed objective by the coordinates in their units, (p,)."""
        return self.slope(point.a, point.smooth.slope)

    def _with_slope(self, point: Point) -> tuple[Point, Array]:
        """Return the point, which then knows its loss's slope, and what `_slope` says there."""
        along = point.along
        if along is None:
            along = self.at.along(point.smooth.slope)
        return point._replace(along=along), self.penalized(point.a, along)

    def _judged(self, point: Point, slope: Array, steps: int) -> Ended:
        gap, by_z = self.bound(point.z, point.a, slope)
        smooth = point.smooth
        loss, missing = self.loss.missed(point.r, smooth)
        objective = loss + float(self.pull.dot(point.a**2))
        state = Kinked(smooth.multipliers, point.kinked.sharpness, point.kinked.curved)
        return Ended(point.z, gap + missing, objective, loss, steps, state, by_z, smooth.slope, missing)

    def _stepped(self, point: Point, slope: Array, bent: Array) -> Point:
        """Return the point after a step of Newton's, with the loss's second derivative (p, p) by the coordinates."""
        H, factor, failed = self._factored(bent)
        if failed:
            factor, _ = _potrf(H + np.eye(len(H)) * 1e-6 * np.max(np.diag(H)))
        if self.box is None:
            step = -self.unit * _potrs(factor, slope)[0]
            return self._searched(point, point.z, step)
        u = self.back @ (point.z - self.at.offset)
        R = np.triu(factor)
        target = R @ u - solve_triangular(R, slope, trans=1)
        z, _ = minimum_in_box(R @ self.back, target + R @ (self.back @ self.at.offset), *self.box, point.z)
        step = self.unit * (self.back @ (z - point.z))
        return self._searched(point, z, step)

    def _factored(self, bent: Array) -> tuple[Array, Array, int]:
        """Return the second derivative of the smoothed objective, its Cholesky factor, and whether there is none."""
        known = self._last.get("bent")
        if known is None or known[0] is not bent:  # what is promised is asked before the step
            H = self._whole(bent)
            self._last["bent"] = (bent, (H, *_potrf(H)))
        return self._last["bent"][1]

    @cached_property
    def _last(self) -> dict[str, Any]:
        """The last second derivative that was factored."""
        return {}

    def _whole(self, bent: Array) -> Array:
        """Return the second derivative (p, p) of the smoothed objective by the coordinates in their units."""
        units, diagonal = self._units
        H = units * bent
        H.flat[:: len(H) + 1] += diagonal
        return H

    @cached_property
    def _units(self) -> tuple[Array, Array]:
        """Units (p, p) of second derivatives by the coordinates, and what penalties add to them (p,)."""
        return np.multiply.outer(self.unit, self.unit), 2 * self.pull * self.unit**2 + FLAT

    @property
    def _stride(self) -> int:
        """Of every so many groups one is enough to tell the second derivative roughly."""
        count = len(self.at.rows)
        return max((k for k in STRIDES if k * TELLING * len(self.unit) <= count), default=1)

    def _hessian(self, point: Point, every: int = 1) -> Array:
        """Return the second derivative (p, p) of the smoothed loss by the coordinates, from one of so many groups."""
        curvatures = self.loss.curvature(point.r, point.smooth, point.kinked.sharpness)
        across = curvatures[0].across
        for more in curvatures[1:]:
            across = across + more.across
        H = self._across(across, every)
        for curvature in curvatures:
            if len(curvature.along):
                H += self._along(curvature, every)
        return self.at.turned(H)

    def _across(self, across: Array, every: int) -> Array:
        """Return what curvatures of the equations add, by what the rows are."""
        rows = self.at.rows
        if every == 1:
            return weighed_squares(rows, across, self.at.gram if rows.size >= DEAR else None)
        some, picked = self._picked(every)
        return every * weighed_squares(picked, across[some], self.at.gram / every)

    def _along(self, curvature: Curvature, every: int) -> Array:
        """Return what the curvatures along the groups' directions add, by what the rows are."""
        _, along, u = curvature
        rows = self.at.rows
        if every > 1:
            some, rows = self._picked(every)
            along, u = along[::every], u[some]
        bent = along.nonzero()[0]
        return every * weighed_squares(self.loss.projected(rows, u, bent, every), along[bent])

    def _picked(self, every: int) -> tuple[np.ndarray, Array]:
        """Return the places (k,) and the rows of one of every so many groups, row by row."""
        if self.at.last.get("picked", (0,))[0] != every:
            some = self.loss.picked(every)
            self.at.last["picked"] = (every, some, np.ascontiguousarray(self.at.rows[some]))
        return self.at.last["picked"][1:]

    def _searched(self, point: Point, z: Array, step: Array) -> Point:
        """Return the point along a step where the smoothed objective is about least."""
        ahead = self.at.by_row(step)
        of_penalty = 2 * self.pull * step

        def at(t: float) -> Point:
            r = point.r + t * ahead
            smooth = self.loss.smoothed(r, *point.kinked[:2])
            return Point(point.z + t * (z - point.z), point.a + t * step, r, point.kinked, smooth)

        def rise(p: Point) -> float:
            slope = float(p.smooth.slope.dot(ahead) + p.a.dot(of_penalty))
            if np.isfinite(slope) and np.isfinite(p.smooth.without_kinks):
                return slope
            return np.inf

        found = searched(at, rise, point, self.box is None)
        if found is point:
            return point
        found = found._replace(z=self._place(found), longest=max(point.longest, float(point.r.dot(point.r))))
        if found.r.dot(found.r) <= CANCELLED**2 * found.longest:
            return self._placed(found.z, found.kinked)
        return found

    def _place(self, point: Point) -> Array:
        """Return z (n,) of a point that a search has found: free of rounding, or inside the box."""
        if self.box is None:
            return self.at.offset + self.at.B.dot(point.a)
        return np.clip(point.z, *self.box)
