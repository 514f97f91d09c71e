"""Squares with a penalty that has kinks, in a box: the minimum, from face to face, certified by its duality gap."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import get_lapack_funcs

from rpim_opt.basics.arrays import Array

EPS = float(np.finfo(float).eps)
SLOPE = 16 * EPS
"""Rounding of a slope, relative to the sizes of its column and of the residual's terms."""
VANISHED = 1e-15
"""Fall that a Newton step promises, relative to the objective, from which the minimum of a face is reached."""
CERTAIN = 1e-9
"""Gap, relative to the objective, up to which a minimum is taken to be one."""
EXACT = 1e-13
"""Gap, relative to the objective, up to which the end of one step needs no other."""
GOOD = 1e-6
"""The same for a minimum that no other solver finds more exactly."""
NOTHING = 1e-12
"""Gap, in squared sigmas of one equation, that is as good as none."""
FAR = 1e100
"""Stands for a bound where there is none."""
SHORT = 0.05
"""Part of the promised fall with which a step has to come, or groups are moved one by one."""
FIRM, STIFFER = 1e-3, 1e3
"""Up to what ridge, and by what factor, steps are tried that rounding spoiled with less."""
NEAR = 1e-13
"""How near to a kink a start is taken to be at it, relative to its largest component."""
UNSEEN = 1e-8
"""Curvature of a direction that nothing sees, relative to the largest: what a ridge is measured by there."""
RIDGE = 100 * EPS
"""Curvature, relative to a column's own, that directions get which nothing else holds: a step there is then long, and
ends at the next kink."""

_posv: Any
(_posv,) = get_lapack_funcs(("posv",), (np.empty(1),))


class Face(NamedTuple):
    """A point y (n,), which components of it may move, and what the gap says of it.

    Parameters
    ----------
    y, free
        (n,) each.
    gap
        By how much the objective at y may lie above the minimum, infinite where nothing is known.
    value
        The objective at y.
    """

    y: Array
    free: np.ndarray
    gap: float
    value: float

    @property
    def good(self) -> bool:
        """Whether y is as good as what an interior point finds."""
        return self.gap <= GOOD * self.value + NOTHING

    @property
    def certain(self) -> bool:
        """Whether the gap says that y is the minimum."""
        return self.gap <= CERTAIN * self.value + NOTHING


@dataclass(frozen=True, eq=False)
class Faces:
    """|M y - d|^2 + weight (1/2 y'H y + g'y + sum price_j |y_j| + sum price_k |y_k|), lower <= y <= upper.

    A component has a price of its own, or is a member of one group y_k, or has neither. Kinks are at zero.

    On a face (the components at zero or on a bound stay, the others keep their signs) the objective is smooth. Newton's
    steps lead to its minimum, or to the next kink or bound, which then holds; groups are put to zero where that is best
    with the others as they are. At the minimum of a face, components and groups that are held in vain are moved to
    where each is best, and the next face begins. The objective falls at every step. That the last point is the minimum
    is known from the duality gap, which asks nothing of the way there.

    Parameters
    ----------
    M, d
        (k, n) and (k,).
    H, g
        (n, n), or None for zero, and (n,).
    price
        (n,), zero or more.
    member
        (n,) number of the group that a component belongs to, or -1.
    groups
        (K,) prices of the groups, above zero.
    lower, upper
        (n,), infinite for members of groups.

    Examples
    --------
    >>> import numpy as np
    >>> from rpim_opt.convex.faces import Faces
    >>> one = np.ones(2)
    >>> single = np.full(2, -1)
    >>> lasso = Faces(np.eye(2), np.array([3.0, 0.2]), None, 0 * one, one, single, np.empty(0), -9 * one, 9 * one)
    >>> face = lasso.minimum(1.0)
    >>> [round(float(y), 9) for y in face.y], face.certain  # shrunk by half the weight
    ([2.5, 0.0], True)
    """

    M: Array
    d: Array
    H: Array | None
    g: Array
    price: Array
    member: np.ndarray
    groups: Array
    lower: Array
    upper: Array

    # --- what stays the same ---------------------------------------------------------------------------------------

    @cached_property
    def gram(self) -> Array:
        """2 M'M, the curvature of the squares."""
        return 2 * self.M.T @ self.M

    @cached_property
    def _twice(self) -> Array:
        return 2 * self.M

    @cached_property
    def _lined(self) -> bool:
        """Whether the penalty has a line."""
        return bool(self.g.any())

    @cached_property
    def size(self) -> Array:
        """Norms of the columns of M (n,)."""
        return np.sqrt(np.einsum("ij,ij->j", self.M, self.M))

    @cached_property
    def grouped(self) -> np.ndarray:
        """Which components (n,) belong to groups."""
        return self.member >= 0

    @cached_property
    def together(self) -> Array:
        """1 where two components belong to the same group (n, n)."""
        return ((self.member[:, None] == self.member) & self.grouped[:, None]).astype(float)

    @cached_property
    def blocks(self) -> Array:
        """The curvature of the squares within groups (n, n), zero elsewhere."""
        return self.gram * self.together

    @cached_property
    def picks(self) -> Array:
        """1 where a component (n) belongs to a group (K): (K, n)."""
        return (self.member == np.arange(len(self.groups))[:, None]).astype(float)

    @cached_property
    def spectrum(self) -> tuple[Array, Array]:
        """Singular values of M that are not rounding, and their directions as rows."""
        _, s, Vt = np.linalg.svd(self.M, full_matrices=False)
        seen = s > len(s) * EPS * np.max(s, initial=0.0)
        return s[seen], Vt[seen]

    @cached_property
    def _of(self) -> np.ndarray:
        """Group (n,) of every component, the first one for those of none."""
        return np.maximum(self.member, 0)

    def spread(self, some: np.ndarray) -> np.ndarray:
        """Return which components (n,) belong to some of the groups (K,)."""
        return some[self._of] & self.grouped

    @cached_property
    def members(self) -> list[np.ndarray]:
        """The components of every group."""
        return [np.flatnonzero(self.member == k) for k in range(len(self.groups))]

    @cached_property
    def kinked(self) -> np.ndarray:
        """Which components (n,) have a kink of their own at zero."""
        return self.price > 0

    @cached_property
    def _smooth(self) -> np.ndarray:
        """Which components have none."""
        return ~self.kinked

    @cached_property
    def _many(self) -> int:
        """How many groups there are."""
        return len(self.groups)

    @cached_property
    def _plain(self) -> bool:
        """Whether every component has a kink of its own, and no bound: a lasso."""
        return not self._many and not self.bounded and bool(self.kinked.all())

    @cached_property
    def _alone(self) -> np.ndarray:
        """Which components belong to no group."""
        return ~self.grouped

    def lengths(self, v: Array) -> Array:
        """Return the norms of the groups (K,) of a vector (n,)."""
        return np.sqrt(self.picks @ (v * v))

    def curvature(self, weight: float) -> Array:
        """Return the second derivatives (n, n) of the smooth part."""
        if self.H is None:
            return self.gram
        return self.gram + weight * self.H

    # --- values ----------------------------------------------------------------------------------------------------

    def penalty(self, y: Array) -> float:
        """Return what the weight multiplies."""
        value = float(self.price.dot(np.abs(y)))
        if self._lined:
            value += float(self.g @ y)
        if self._many:
            value += float(self.groups @ self.lengths(y))
        if self.H is not None:
            value += float(0.5 * y @ self.H @ y)
        return value

    def value(self, y: Array, weight: float) -> float:
        """Return the objective."""
        r = self._residual(y)
        return float(r.dot(r)) + weight * self.penalty(y)

    def _residual(self, y: Array) -> Array:
        """Return M y - d; a point's slope is asked for after its value."""
        known = self._last.get("residual")
        if known is None or known[0] is not y:
            known = (y, self.M.dot(y) - self.d)
            self._last["residual"] = known
        return known[1]

    @cached_property
    def _last(self) -> dict[str, tuple[Array, Array]]:
        """The last point, and its residual."""
        return {}

    def slope(self, y: Array, weight: float) -> Array:
        """Return the gradient (n,) of the smooth part."""
        slope = self._residual(y).dot(self._twice)
        if self._lined:
            slope += weight * self.g
        if self.H is not None:
            slope += weight * (self.H @ y)
        return slope

    def rounding(self, y: Array, weight: float) -> Array:
        """Return what rounding may make of the slopes (n,)."""
        terms = float(self.size.dot(np.abs(y))) + self.target
        return (2 * SLOPE * terms) * self.size + (SLOPE * weight) * self._steepest

    @cached_property
    def _steepest(self) -> Array:
        """What the penalty's slopes (n,) are at most, but for its square."""
        return self.prices + np.abs(self.g)

    @cached_property
    def target(self) -> float:
        """Norm of d."""
        return float(np.linalg.norm(self.d))

    @cached_property
    def prices(self) -> Array:
        """Prices (n,) of the components, or of the groups that they belong to."""
        if not self._many:
            return self.price
        return self.price + self.groups @ self.picks

    def gap(self, y: Array, slope: Array, weight: float, step: Array | None = None) -> float:
        """Return by how much the objective at y may lie above its minimum: the least of some bounds of it.

        The first one, if given, is by a step (n,) that the slope at y (n,) was answered with.
        """
        gap = np.inf
        ridge = RIDGE
        value = self.value(y, weight)
        C = self.curvature(weight)
        if step is not None:
            gap = self._gap(y, slope, weight, C, step)
        while ridge < FIRM and not gap <= CERTAIN * value:
            gap = min(gap, self._gap(y, slope, weight, C, self._newton(y, slope, C, weight, ridge)[0]))
            ridge = STIFFER * ridge
        return gap

    def _gap(self, y: Array, slope: Array, weight: float, C: Array, step: Array | None) -> float:
        """Return by how much the objective at y may lie above its minimum: Fenchel's and Young's inequality.

        The tangent of the smooth part at any point is a lower bound of it, and with the kinks, whose minimum is known,
        one of the objective. It is taken where Newton's step leads, whose curvature counts: on the face the slope there
        is what the kinks need, whatever rounding made of it at y.
        """
        left = slope
        if step is not None:
            left = slope + C @ step
        price = weight * self.price
        excess = np.minimum(left + price, 0.0)
        rest = np.maximum(left - price, 0.0)
        if self.bounded:
            excess[np.isfinite(self.upper)] = 0.0
            rest[np.isfinite(self.lower)] = 0.0
        excess += rest
        if self._many:
            excess = np.where(self.grouped, self._over(left, weight), excess)
        left = left - excess
        young = self._young(y, left, price, weight * self.groups)
        return max(young, 0.0) + self._curved(step, weight) + self._cost(excess, y, step, weight)

    def _curved(self, step: Array | None, weight: float) -> float:
        """Return by how much the smooth part rises above its tangent where a step leads."""
        if step is None:
            return 0.0
        seen = self.M @ step
        curved = float(seen @ seen)
        if self.H is not None:
            curved += 0.5 * weight * max(float(step @ self.H @ step), 0.0)
        return curved

    def _over(self, slope: Array, weight: float) -> Array:
        """Return what a slope (n,) has beyond the prices of the groups."""
        steep = self.lengths(slope)
        over = np.maximum(steep - weight * self.groups, 0.0)
        share = np.divide(over, steep, out=np.zeros_like(steep), where=steep > 0)
        return slope * (share @ self.picks)

    def _young(self, y: Array, left: Array, price: Array, groups: Array) -> float:
        """Return left'y and the kinks at y, less the least that both together are anywhere in the box."""
        here = left * y + price * np.abs(y)
        if not self.bounded and not self._many:  # left is at most the price: zero is where both are least
            return float(here.sum())
        nearest = np.minimum(np.maximum(0.0, self.lower), self.upper)
        least = left * nearest + price * np.abs(nearest)
        for bound in (self.lower, self.upper):
            at = np.where(np.isfinite(bound), bound, nearest)
            least = np.minimum(least, left * at + price * np.abs(at))
        if not self._many:
            return float(np.sum(here - least))
        single = float(np.sum((here - least)[~self.grouped]))
        return single + float(np.sum(self.picks @ here + groups * self.lengths(y)))

    def _cost(self, excess: Array, y: Array, step: Array | None, weight: float) -> float:
        """Return what it costs a lower bound to take an excess (n,) off the slope after a step.

        Of what the equations see, the squares hold y' near y + step: |e|^2 / 4 - e'M step in their coordinates.
        """
        if not np.count_nonzero(excess):
            return 0.0
        s, Vt = self.spectrum
        seen = Vt @ excess
        cost = float(np.sum((seen / (2 * s)) ** 2))
        if step is not None:
            cost -= float(seen @ (Vt @ step))
        if len(s) == len(y):
            return cost
        unseen = excess - seen @ Vt
        unseen[np.abs(unseen) <= self.rounding(y, weight)] = 0.0
        if not np.count_nonzero(unseen):
            return cost
        priced = weight * self.prices
        if (priced[unseen != 0] == 0).any():
            return float("inf")
        value = self.value(y, weight)
        away = np.abs(y) + np.divide(value, priced, out=np.zeros_like(y), where=priced > 0)
        return cost + float(np.abs(unseen) @ away)

    # --- the way there ---------------------------------------------------------------------------------------------

    def near(self, weight: float) -> Array:
        """Return a point (n,) from which the minimum is few steps away.

        That with squares instead of norms, or zero where that is lower: little is not zero then.
        """
        s, Vt = self.spectrum
        target = Vt @ (self.M.T @ self.d)  # s times the coordinates of d
        squared = (target / (s**2 + weight)) @ Vt
        zero = np.zeros_like(squared)
        if self.value(zero, weight) < self.value(squared, weight):
            return zero
        return squared

    def minimum(self, weight: float, start: Array | None = None) -> Face:
        """Return the minimum at a weight above zero, from a point (n,) near it."""
        if start is not None:
            face = self._minimum(weight, start)
            if face.certain:
                return face
        return self._minimum(weight, self.near(weight))

    def _minimum(self, weight: float, start: Array) -> Face:
        y = self.snapped(start, NEAR)
        if self.bounded:
            y = np.minimum(np.maximum(y, self.lower), self.upper)
        C = self.curvature(weight)
        value = self.value(y, weight)
        step = np.zeros(len(y))
        ridge = RIDGE
        arrived = False
        for _ in range(50 + 2 * len(y)):
            slope = self.slope(y, weight)
            if self._many:
                y, slope = self._emptied(y, slope, C, weight)
                value = self.value(y, weight)
            if not arrived:
                step, stepped, ridge = self._onward(y, value, slope, C, weight, ridge)
                if stepped is not None:
                    y, value, arrived = stepped  # squares on a face are a quadratic, whose minimum is one step away
                    continue
            ahead, there = self._freed(y, value, slope, C, weight)
            if not (there < value or arrived):
                break
            if not there < value:
                gap = self._gap(y, slope, weight, C, None)
                if gap <= EXACT * value:
                    return Face(y, self.free(y), gap, value)
            arrived = False
            y, value = ahead, there
        slope = self.slope(y, weight)
        return Face(y, self.free(y), self.gap(y, slope, weight, step), value)

    def _onward(
        self, y: Array, value: float, slope: Array, C: Array, weight: float, ridge: float
    ) -> tuple[Array, tuple[Array, float, bool] | None, float]:
        """Return Newton's step (n,), where to go on as `_ahead` returns it, None for nowhere, and with what ridge."""
        step, fall = self._newton(y, slope, C, weight, ridge)
        if fall > VANISHED * abs(value):
            stepped = self._ahead(y, step, fall, value, C, weight)
            if self._nearer(y, value, *stepped[:2]):
                return step, stepped, RIDGE
            if ridge < FIRM:  # what rounding makes of a direction that nothing holds spoils the step
                return step, (y, value, False), STIFFER * ridge
        return step, None, RIDGE

    def _nearer(self, y: Array, value: float, ahead: Array, there: float) -> bool:
        """Whether a step is one: the objective falls, or it is the same on a smaller face."""
        if there == value:
            return bool(self.free(ahead).sum() < self.free(y).sum())
        return there < value

    def _freed(self, y: Array, value: float, slope: Array, C: Array, weight: float) -> tuple[Array, float]:
        """Return the point after what is held in vain was moved to where it is best, and its value."""
        wrong = self._wrong(y, slope, weight)
        if not np.count_nonzero(wrong):
            return y, value
        moved = self._moved(y, slope, wrong, C, weight)
        return moved, self.value(moved, weight)

    def free(self, y: Array) -> np.ndarray:
        """Return which components (n,) are on no kink and no bound."""
        if self._plain:
            return y != 0
        free = (y != 0) | self._smooth
        if self.bounded:
            free &= (y > self.lower) & (y < self.upper)
        if self._many:
            free &= ~self.spread(self.lengths(y) == 0)
        return free

    def largest(self) -> float | None:
        """Return the smallest weight from which all that has a price is zero; None where there is none.

        With what has no price at its best, zero is the minimum where no slope of the squares exceeds weight x price:
        the dual norm of the slope, the largest of |slope_j| / price_j and |slope_k| / price_k.
        """
        if (self.lower > 0).any() or (self.upper < 0).any():
            return None
        y = np.zeros(len(self.g))
        bare = self.prices == 0
        if bare.any():
            y[bare] = np.linalg.lstsq(self.M[:, bare], self.d, rcond=None)[0]
        slope = 2 * (self.M.T @ (self.M @ y - self.d))
        # with a line in the penalty, one side of zero costs more than the other
        room = self.price - np.sign(slope) * self.g
        single = ~self.grouped & (room > 0) & ~bare
        found = [0.0, *(np.abs(slope[single]) / room[single])]
        if self._many:
            found += [*(self.lengths(slope) / self.groups)]
        largest = float(np.max(found))
        if largest > 0:
            return largest
        return None

    def bent(self, y: Array, weight: float) -> tuple[Array, Array]:
        """Return slope (n,) and curvature (n, n) of the penalty's kinked part where it is smooth, without its zeros."""
        slope = weight * self.price * np.sign(y)
        if not self._many:
            return slope, np.zeros((0, 0))
        nu = self.lengths(y)
        inverse = np.divide(1.0, nu, out=np.zeros_like(nu), where=nu > 0)
        per = (weight * self.groups * inverse) @ self.picks
        u = y * (inverse @ self.picks)
        bend = self.together * (per * u)[:, None] * -u
        bend.flat[:: len(y) + 1] += per
        return slope + per * y, bend

    def bend(self, y: Array, weight: float) -> Array:
        """Return the penalty's Hessian (n, n) where it is smooth."""
        bend = self.bent(y, weight)[1]
        if not self._many:
            bend = np.zeros((len(y), len(y)))
        if self.H is not None:
            bend = bend + weight * self.H
        return bend

    def snapped(self, y: Array, close: float) -> Array:
        """Return a point (n,) with what is close to a kink or bound, relative to the largest component, put on it."""
        room = close * float(np.abs(y).max(initial=0.0))
        y = y.copy()
        for place in self.places:
            y = np.where(np.abs(y - place) <= room, place, y)
        if self._many:
            y[self.spread(self.lengths(y) <= room)] = 0.0
        return y

    def _ahead(
        self, y: Array, step: Array, fall: float, value: float, C: Array, weight: float
    ) -> tuple[Array, float, bool]:
        """Return the point after a step, and where that comes short, after groups were moved one by one.

        With its value, and whether it is the minimum of a quadratic.
        """
        ahead, there, whole = self._stepped(y, step, value, weight)
        if not self._many:
            return ahead, there, whole
        if there > value - SHORT * fall:
            # where a group is nearly zero, the norm bends more than Newton's step sees
            ahead = self._moved(ahead, self.slope(ahead, weight), self.grouped, C, weight)
            there = self.value(ahead, weight)
        return ahead, there, False

    def _newton(self, y: Array, slope: Array, C: Array, weight: float, ridge: float) -> tuple[Array, float]:
        """Return Newton's step (n,) on the face, and twice the fall that it promises."""
        step = np.zeros(len(y))
        F = self._places(y)
        if not len(F):
            return step, 0.0
        if not self._many:
            g = (slope + (weight * self.price) * np.sign(y))[F]
            if C is self.gram and ridge == RIDGE:
                K = self._raised.take(F, 0).take(F, 1).T  # as LAPACK has it in memory
                _, found, info = _posv(K, -g, lower=1, overwrite_a=1, overwrite_b=1)
                if info == 0:
                    step[F] = found
                    return step, -float(g.dot(found))
            K = C.take(F, 0).take(F, 1)
        else:
            kink, bend = self.bent(y, weight)
            g = (slope + kink)[F]
            K = (C + bend).take(F, 0).take(F, 1)
        return self._solved(K, g, F, step, ridge)

    def _places(self, y: Array) -> np.ndarray:
        """Return the components that are on no kink and no bound."""
        if self._plain:
            return y.nonzero()[0]
        return self.free(y).nonzero()[0]

    @cached_property
    def _raised(self) -> Array:
        """`gram` with the least ridge."""
        raised = self.gram.copy()
        diagonal = raised.diagonal().copy()
        raised.flat[:: len(raised) + 1] += RIDGE * np.maximum(diagonal, UNSEEN * diagonal.max(initial=0.0))
        return raised

    def _solved(self, K: Array, g: Array, F: np.ndarray, step: Array, ridge: float) -> tuple[Array, float]:
        """Return the step (n,) that solves K step = -g for its components F, with a ridge, and twice the fall."""
        diagonal = K.diagonal().copy()
        own = np.maximum(diagonal, UNSEEN * diagonal.max())
        for _ in range(20):
            K.flat[:: len(F) + 1] = diagonal + ridge * own
            _, found, info = _posv(K.T, -g, lower=1)
            if info == 0:
                break
            ridge = 10 * ridge
        else:
            return step, 0.0
        step[F] = found
        return step, float(-g @ found)

    def _stepped(self, y: Array, step: Array, value: float, weight: float) -> tuple[Array, float, bool]:
        """Return the point after a step and its value: over all kinks where that is lower, else to the first.

        And whether nothing stopped it.
        """
        full, whole = self._stopped(y, y + step)
        there = self.value(full, weight)
        if there < value:
            return full, there, whole
        share = self._first(y, step)
        if share == 1 and there == value:
            return full, there, whole
        for _ in range(40):
            ahead, _ = self._stopped(y, y + share * step)
            if share < 1:
                ahead = self._snapped(y, step, ahead, share)
            there = self.value(ahead, weight)
            if there <= value:
                return ahead, there, False
            share = share / 2
        return y, value, False

    def _stopped(self, y: Array, ahead: Array) -> tuple[Array, bool]:
        """Return a point with components that passed a kink or a bound put on it, and whether none did."""
        inside = ahead
        if self.bounded:
            inside = np.minimum(np.maximum(ahead, self.lower), self.upper)
        passed = inside * y < 0
        if not self._plain:
            passed &= self.kinked
        if np.count_nonzero(passed):
            inside[passed] = 0.0
            return inside, False
        return inside, inside is ahead or bool((inside == ahead).all())

    def _first(self, y: Array, step: Array) -> float:
        """Return how far along a step (at most 1) the first kink or bound is."""
        gap = self._stops - y
        passed = (gap * step > 0) & (np.abs(gap) < np.abs(step))
        if not np.count_nonzero(passed):
            return 1.0
        places, components = passed.nonzero()
        return float((gap[places, components] / step[components]).min())

    @cached_property
    def _stops(self) -> Array:
        """`places` as rows (k, n)."""
        return np.array(self.places).reshape(-1, len(self.g))

    @cached_property
    def bounded(self) -> bool:
        """Whether some component has a bound."""
        return bool(np.isfinite(self.lower).any() or np.isfinite(self.upper).any())

    @cached_property
    def places(self) -> list[Array]:
        """Lower and upper bounds and kinks (n,), far away where there is none; those that no component has left out."""
        kink = np.where(self.kinked, 0.0, FAR)
        every = (np.maximum(self.lower, -FAR), np.minimum(self.upper, FAR), kink)
        return [place for place in every if (np.abs(place) < FAR).any()]

    def _snapped(self, y: Array, step: Array, ahead: Array, share: float) -> Array:
        """Put what reached its kink or bound but for rounding exactly there."""
        close = 8 * EPS * (np.abs(y) + np.abs(share * step))
        for place in self.places:
            reached = (step != 0) & (np.abs(ahead - place) <= close)
            ahead = np.where(reached, place, ahead)
        return ahead

    def _emptied(self, y: Array, slope: Array, C: Array, weight: float) -> tuple[Array, Array]:
        """Return the point with groups put to zero where that is best with the others as they are, and the slope."""
        blocks = self.blocks
        if self.H is not None:
            blocks = C * self.together
        small = (self.lengths(slope - blocks @ y) <= weight * self.groups) & (self.lengths(y) > 0)
        for k in np.flatnonzero(small):
            inside = self.members[k]
            block = C[inside[:, None], inside]
            without = slope[inside] - block @ y[inside]
            if np.linalg.norm(without) <= weight * self.groups[k]:
                slope = slope - C[:, inside] @ y[inside]
                y = np.where(self.member == k, 0.0, y)
        return y, slope

    def _wrong(self, y: Array, slope: Array, weight: float) -> np.ndarray:
        """Return which held components (n,) the objective falls along."""
        room = self.rounding(y, weight)
        price = weight * self.price
        if self.bounded:
            right = slope + np.where(y >= 0, price, -price)
            left = slope + np.where(y > 0, price, -price)
            wrong = ((y < self.upper) & (right < -room)) | ((y > self.lower) & (left > room))
        else:  # what is held is zero
            wrong = np.abs(slope) > price + room
        wrong &= ~self.free(y)
        if self._many:
            steep = self.lengths(slope) - weight * self.groups
            vain = (self.lengths(y) == 0) & (steep > 4 * EPS * weight * self.groups)
            wrong = np.where(self.grouped, vain[self._of], wrong)
        return wrong

    def _moved(self, y: Array, slope: Array, wrong: np.ndarray, C: Array, weight: float) -> Array:
        """Return the point after each component or group that is held in vain was moved to where it is best."""
        y = y.copy()
        slope = slope.copy()
        alone = wrong & self._alone
        for j in alone.nonzero()[0].tolist():
            moved = self._best_component(j, float(y[j]), float(slope[j]), float(C[j, j]), weight)
            slope += C[j] * (moved - y[j])  # as its column, which is no row of memory
            y[j] = moved
        if not self._many:
            return y
        for k in np.unique(self.member[wrong & self.grouped]):
            inside = self.members[k]
            block = C[inside[:, None], inside]
            moved = shrunk(block, slope[inside] - block @ y[inside], weight * float(self.groups[k]))
            slope += C[:, inside] @ (moved - y[inside])
            y[inside] = moved
        return y

    def _best_component(self, j: int, at: float, slope: float, curvature: float, weight: float) -> float:
        """Return where the objective is least along a component, on this side of the next kink or bound."""
        price = weight * float(self.price[j])
        lower, upper = float(self.lower[j]), float(self.upper[j])
        right = slope + (price if at >= 0 else -price)
        left = slope + (price if at > 0 else -price)
        if right < 0 and at < upper:
            end = min(0.0, upper) if at < 0 < price else upper
            return _towards(at, -right, curvature, end)
        if left > 0 and at > lower:
            end = max(0.0, lower) if at > 0 < price else lower
            return _towards(at, -left, curvature, end)
        return at


def _towards(at: float, force: float, curvature: float, end: float) -> float:
    """Return at + force / curvature, or the end where that lies beyond."""
    if curvature <= 0:
        return end if isfinite(end) else at
    ahead = at + force / curvature
    if (ahead - end) * force > 0:
        return end
    return ahead


def shrunk(K: Array, c: Array, price: float) -> Array:
    """Return where 1/2 v'K v + c'v + price |v| is least, v (k,): zero where |c| <= price.

    With K = Q diag(l) Q', v = -Q (Q'c) / (l + price / |v|), where |v| solves sum (Q'c)_i^2 / (l_i |v| + price)^2 = 1.

    >>> import numpy as np
    >>> from rpim_opt.convex.faces import shrunk
    >>> [float(v) for v in shrunk(2 * np.eye(2), np.array([-6.0, -8.0]), 4.0).round(6)]
    [1.8, 2.4]
    """
    if np.linalg.norm(c) <= price:
        return np.zeros_like(c)
    curvatures, Q = np.linalg.eigh(K)
    # rounding leaves small negative ones; along them, nothing but the norm would hold
    curvatures = np.maximum(curvatures, 4 * EPS * max(float(curvatures[-1]), np.finfo(float).tiny))
    squares = (Q.T @ c) ** 2
    length = 0.0
    for _ in range(100):
        below = curvatures * length + price
        total = float(np.sum(squares / below**2))
        falling = float(np.sum(squares * curvatures / below**3))
        # Newton's for 1 / sqrt(total) = 1, which is nearly a line and concave: from the left, it never overshoots
        step = (np.sqrt(total) - 1) * total / falling
        length += step
        if abs(step) <= 8 * EPS * length:
            break
    return -Q @ ((Q.T @ c) * length / (curvatures * length + price))
