"""One thing that was touched and nobody measured, a point or a plane: where its touches put it, and without it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array

UNKNOWNS = 3
"""Of a point its coordinates; of a plane a distance and two tilts."""


class Moved(NamedTuple):
    """How a point or the centre of a plane moves (3, c) [m], and how its normal turns (3, c); zero for a point.

    ``across`` (2, 3, c) is how the plane's two directions turn with it; None where all that is parallel turns with it.
    """

    centre: Array
    normal: Array
    across: Array | None = None


@dataclass(frozen=True, eq=False)
class Point:
    """A point at the mean of the positions p_i (K, 3) of its touches.

    Without it K touches say 3 (K - 1) things of the robot alone, the differences of every touch to the mean of those
    before it (Helmert's contrasts)::

        h_j = sqrt(j / (j + 1)) (r_{j+1} - mean(r_1 ... r_j)),    j = 1 ... K - 1

    They are orthonormal: independent touches of one accuracy have independent contrasts of that accuracy.

    Parameters
    ----------
    centre
        (3,) the mean [m].
    count
        K.
    normal, across
        Zero: a point has none.

    Examples
    --------
    >>> import numpy as np
    >>> from rpim_opt.problem.touched import Point
    >>> Point.of(np.array([[0, 0, 0.1], [0, 0, 0.3]])).centre
    array([0. , 0. , 0.2])
    """

    centre: Array
    count: int
    normal: Array
    across: Array

    @classmethod
    def of(cls, positions: Array) -> Point:
        """Return the point that touches at (K, 3) [m] put where they are in the mean."""
        return cls(positions.mean(axis=0), len(positions), np.zeros(3), np.zeros((2, 3)))

    @property
    def level(self) -> Point:
        """The point itself."""
        return self

    @property
    def kept(self) -> np.ndarray:
        """Which of the touches' coordinates (K, 3) give a contrast its place."""
        found = np.ones((self.count, 3), dtype=bool)
        found[0] = False
        return found

    def seen(self, values: Array) -> Array:
        """Return what of values (K, 3, c) of the positions a touch shows, (K, 3, c)."""
        return values

    def slopes(self, values: Array) -> Array:
        """Return how far touches are off the point (K, 3, c) changes, where positions move by values (K, 3, c)."""
        return values - values.mean(axis=0)

    def contrasts(self, values: Array) -> Array:
        """Return the contrasts of values (K, 3, c), in the places that are kept."""
        found = np.zeros_like(values)
        j = np.arange(1, self.count)[:, None, None]
        before = np.cumsum(values, axis=0)[:-1] / j
        found[1:] = np.sqrt(j / (j + 1)) * (values[1:] - before)
        return found

    def moved(self, values: Array) -> Moved:
        """Return how it moves where its touches move by values (K, 3, c)."""
        return Moved(values.mean(axis=0), np.zeros(values.shape[1:]))


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane that fits the positions p_i (K, 3) of its touches best.

    A touch shows how far it is along the normal n, s_i = n'(p_i - centre), its first coordinate here; two others are
    zero. Without the plane K touches say K - 3 things of the robot alone: s in an orthonormal basis of what is
    perpendicular to 1, u, v, the coordinates in the plane.

    Parameters
    ----------
    centre, normal
        (3,) each.
    axis
        The number of the coordinate axis whose projection into the plane is its first direction; None for a plane that
        is parallel to those that should be.
    across
        (2, 3) two directions in the plane.
    height
        (K,) s of every touch [m].
    places
        (K, 3): 1 and the coordinates u, v [m] of every touch in the plane.
    aside
        (K, K - 3) the orthonormal basis.

    Examples
    --------
    >>> import numpy as np
    >>> from rpim_opt.problem.touched import Plane
    >>> flat = Plane.of(np.array([[0, 0, 0.1], [1, 0, 0.1], [0, 1, 0.1], [1, 1, 0.1]]))
    >>> abs(flat.normal).round(9), flat.aside.shape
    (array([0., 0., 1.]), (4, 1))
    """

    centre: Array
    normal: Array
    axis: int | None
    across: Array
    height: Array
    places: Array
    aside: Array

    @classmethod
    def of(cls, positions: Array) -> Plane:
        """Return the plane that is nearest to touches at (K, 3) [m]."""
        centre = positions.mean(axis=0)
        normal = np.linalg.svd(positions - centre)[2][2]
        normal = normal * np.copysign(1.0, normal[np.argmax(np.abs(normal))])
        axis = int(np.argmin(np.abs(normal)))
        first = np.eye(3)[axis] - normal * normal[axis]
        first = first / np.linalg.norm(first)
        across = np.array([first, np.cross(normal, first)])
        places = np.column_stack([np.ones(len(positions)), (positions - centre) @ across.T])
        aside = np.linalg.qr(places, mode="complete")[0][:, UNKNOWNS:]
        return cls(centre, normal, axis, across, (positions - centre) @ normal, places, aside)

    @property
    def level(self) -> Plane:
        """The plane with its touches in it, as they were: what the nominal robot is off is no noise.

        And planes that are to be parallel are.
        """
        return replace(self, height=np.zeros_like(self.height), axis=None)

    @property
    def kept(self) -> np.ndarray:
        """Which of the touches' coordinates (K, 3) give a contrast its place."""
        found = np.zeros((len(self.places), 3), dtype=bool)
        found[UNKNOWNS:, 0] = True
        return found

    def seen(self, values: Array) -> Array:
        """Return what of values (K, 3, c) of the positions a touch shows, (K, 3, c)."""
        found = np.zeros_like(values)
        found[:, 0] = np.einsum("kic,i->kc", values, self.normal)
        return found

    def slopes(self, values: Array) -> Array:
        """Return how s changes (K, 3, c), its first coordinate, where positions move by values (K, 3, c)."""
        found = np.zeros_like(values)
        moved = self.moved(values)
        q = self.places[:, 1:] @ self.across + np.outer(self.height, self.normal)
        found[:, 0] = np.einsum("kic,i->kc", values - moved.centre, self.normal) + q @ moved.normal
        return found

    def contrasts(self, values: Array) -> Array:
        """Return the contrasts of values (K, 3, c), in the places that are kept."""
        found = np.zeros_like(values)
        found[UNKNOWNS:, 0] = self.aside.T @ values[:, 0]
        return found

    def moved(self, values: Array) -> Moved:
        """Return how it moves where its touches move by values (K, 3, c).

        n is the eigenvector of M = sum_i q_i q_i', q_i = p_i - centre, with the least eigenvalue s's::

            dn = -E' (E M E' - s's)^-1 E dM n,    dM n = sum_i q_i n'dp_i + s_i dp_i,    E the directions in the plane
        """
        n = self.normal
        E = self.across
        uv = self.places[:, 1:]
        turn = uv.T @ np.einsum("kic,i->kc", values, n) + E @ np.einsum("k,kic->ic", self.height, values)
        normal = -E.T @ np.linalg.solve(uv.T @ uv - self.height @ self.height * np.eye(2), turn)
        if self.axis is None:
            return Moved(values.mean(axis=0), normal, None)
        # E_1 = (a - n n'a) / |a - n n'a| with a coordinate axis a, E_2 = n x E_1
        a = np.eye(3)[self.axis]
        first = -(np.outer(n, a @ normal) + normal * (a @ n))
        first = (first - np.outer(E[0], E[0] @ first)) / np.sqrt(1 - n[self.axis] ** 2)
        second = np.cross(normal, E[0][:, None], axis=0) + np.cross(n[:, None], first, axis=0)
        return Moved(values.mean(axis=0), normal, np.stack([first, second]))
