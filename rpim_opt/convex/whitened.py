"""A convex loss of A z - b with a squared penalty, in a box, in unknowns that whiten both: what bounds its minimum."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.coordinates import Coordinates
from rpim_opt.convex.met import Kinked
from rpim_opt.problem.linear import RANK_TOLERANCE

ACCEPTED = 1e-10
"""Duality gap, relative to the objective, that a method must reach."""
SOUGHT = 1e-12
"""Duality gap, relative to the objective, that methods go on to while it falls."""
PROMISED = 1e-10
"""Part of the objective by which it may be lower elsewhere, where points are compared."""
VAIN = 3
"""Steps that lower the gap no more, after which a good point is taken."""
HALF = 0.5
"""Part of the gap before a step that one of a hasty method may leave, if it is larger than one met before."""
FLAT = 1e-10
"""Curvature that unknowns without penalty have at least, where the data have about one."""
FAR = 100.0
"""No minimum is this many times farther than the point where the gap is taken, in what no penalty holds."""
UNSEEN = RANK_TOLERANCE**2
"""Coordinates whose square sees less than this part of the longest one's stay where the penalty has them."""


class Ended(NamedTuple):
    """Where a method ended.

    z (n,), duality gap, objective and loss, steps, what a neighbour may begin with, the slope by z (n,) in a box, the
    loss's (m,), what kinks miss of the gap, and whether it is close enough for a rule.
    """

    z: Array
    gap: float
    objective: float
    loss: float
    steps: int
    kinked: Kinked
    slope: Array | None
    of_loss: Array
    missing: float = 0.0
    close: bool = False

    @property
    def good(self) -> bool:
        """Whether the gap says that this is a minimum."""
        return self.gap <= ACCEPTED * max(1.0, abs(self.objective))


@dataclass
class Best:
    """The point with the smallest gap that a method has met, and how many after it had none smaller.

    Of those, how many at last came no nearer: where kinks are sharp, the first step may lead far from a small gap.
    """

    ended: Ended
    vain: int = 0
    stuck: int = 0
    last: float = np.inf

    def meets(self, ended: Ended) -> None:
        """Take note of another point."""
        self.vain += 1
        self.stuck += 1
        if ended.gap <= HALF * self.last:
            self.stuck = 0
        self.last = ended.gap
        if ended.gap < self.ended.gap:
            self.ended = ended
            self.vain = 0
            self.stuck = 0

    def will_do(self, sought: float = SOUGHT, hasty: bool = False) -> bool:
        """Whether nothing is left to go on for: the gap is as sought, or falls no more and is good or one is hasty."""
        if self.ended.gap <= sought * abs(self.ended.objective):
            return True
        return (self.vain >= VAIN and self.ended.good) or (hasty and self.stuck >= VAIN)


@dataclass(frozen=True, eq=False)
class Whitened:
    """minimize  f(A z - b) + weight |L z - c|^2  in a box, for a convex f.

    With y a subgradient of f at the residual, g = A'y + penalty'(z) and Fenchel's inequality, no point has an
    objective lower by more than ::

        gap = (what the subgradient misses of f) + sum_k g_k^2 / (4 weight)

    over penalized coordinates; those without penalty add |g_k| times `FAR` of their size. Of the components on a
    bound only those slopes count that lead inwards.

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
    """

    loss: Any
    at: Coordinates
    weight: float
    box: tuple[Array, Array] | None = None

    @cached_property
    def pull(self) -> Array:
        """(p,) weight of every coordinate's square."""
        return np.where(self.at.penalized, self.weight, 0.0)

    @cached_property
    def unit(self) -> Array:
        """(p,) size of a coordinate of which data and penalty together make one; zero where they do not see it."""
        size = self.at.lengths + self.pull
        seen = size > UNSEEN * self.at.lengths.max(initial=0.0)
        return np.divide(1.0, np.sqrt(size), out=np.zeros(size.shape), where=seen)

    @property
    def whole(self) -> bool:
        """Whether the coordinates say all of z, as a box asks for."""
        return len(self.unit) == len(self.at.offset) and bool((self.unit > 0).all())

    def of_squares(self) -> Array:
        """Return where the squares of the residuals and the penalty are least together, in the box (n,)."""
        z = self.at.offset + self.at.B @ (self.unit**2 * self.at.along(self.at.b))
        if self.box is None:
            return z
        return np.clip(z, *self.box)

    def multipliers(self, ended: Ended) -> Array:
        """Return by how much the objective would fall per unit by which a bound were loosened, (n,)."""
        if ended.slope is None:
            return np.zeros_like(ended.z)
        return np.where(self.held(ended.z, ended.slope), np.abs(ended.slope), 0.0)

    def placed(self, z: Array) -> tuple[Array, Array]:
        """Return z (n,), or the point beside it that the coordinates can say, and its coordinates (p,)."""
        if self.box is not None:
            z = np.clip(z, *self.box)
        a = np.where(self.unit > 0, self.at.inverse @ (z - self.at.offset), 0.0)
        if self.box is None:
            z = self.at.offset + self.at.B @ a
        return z, a

    def objective(self, z: Array) -> float:
        """Return the objective at z (n,), or at the point beside it."""
        a = self.placed(z)[1]
        return self.loss.at(self.at.by_row(a) - self.at.b) + float(self.pull @ a**2)

    def slope(self, a: Array, of_loss: Array) -> Array:
        """Return the objective's slope by the coordinates in their units, (p,), from the loss's (m,)."""
        return self.penalized(a, self.at.along(of_loss))

    def penalized(self, a: Array, along: Array) -> Array:
        """Return the same from the loss's by the coordinates (p,)."""
        return self.unit * (along + 2 * self.pull * a)

    def bound(self, z: Array, a: Array, slope: Array) -> tuple[float, Array | None]:
        """Return by how much a minorant of that slope (p,) may fall at most, and its slope by z (n,) in a box."""
        by_z = None
        if self.box is not None:
            by_z = self.back.T @ slope
            slope = (self.at.B * self.unit).T @ np.where(self.held(z, by_z), 0.0, by_z)
        gap = float((slope**2).dot(self._price))
        free = self.free
        if len(free):
            gap += FAR * float(np.abs(slope[free]) @ (1 + np.abs(a[free] / self.unit[free])))
        return gap, by_z

    @cached_property
    def _price(self) -> Array:
        """(p,) by what squared slopes of penalized coordinates are multiplied in the gap."""
        held = (self.pull > 0) & (self.unit > 0)
        return np.divide(0.25, self.pull * self.unit**2, out=np.zeros_like(self.unit), where=held)

    @cached_property
    def free(self) -> np.ndarray:
        """Which coordinates data alone decide."""
        return np.flatnonzero((self.pull == 0) & (self.unit > 0))

    def held(self, z: Array, slope: Array) -> np.ndarray:
        """Return which components of z (n,) a bound holds, for a slope (n,)."""
        lower, upper = self.box or (-np.inf, np.inf)
        return ((z <= lower) & (slope > 0)) | ((z >= upper) & (slope < 0))

    @cached_property
    def back(self) -> Array:
        """(p, n) inverse of the coordinates in their units."""
        return self.at.inverse / self.unit[:, None]
