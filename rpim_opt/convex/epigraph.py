"""Quadratic plus the largest of many linear functions, within linear bounds: minimum by a dual active set."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import get_lapack_funcs

from rpim_opt.basics.arrays import Array

SLACK = 1e-13
"""By how much a function may exceed the largest, relative to the largest value."""
NEGATIVE = 1e-12
"""Multipliers above minus this are no reason to let go of a function with which a search begins."""
TINY = 1e-300
"""Stands for values that are all zero."""
MANY = 10**9
"""Changes that no search makes."""
PARALLEL = 1e-12
"""Falls below this part of what lengths would allow are rounding."""

_getrf: Any
_getri: Any
_getrf, _getri = get_lapack_funcs(("getrf", "getri"), (np.empty(1),))


class Least(NamedTuple):
    """A minimum: the step d (p,), the largest value t there, multipliers (N,), and how many functions came or went.

    Where the functions that are equal to t are larger by e (k,) than they were taken for, it is ``bend e`` elsewhere.
    """

    d: Array
    t: float
    shares: Array
    changes: int
    active: np.ndarray
    bend: Array


@dataclass(frozen=True, eq=False)
class Epigraph:
    """minimize  d'H d / 2 + g'd + t  subject to  v_k + G_k d <= s_k t,  s_k being 1, or 0 for a bound.

    The multipliers of those with s_k = 1 add up to one. Goldfarb and Idnani's method (1983, Math. Program. 27:1): the
    functions that are equal to t form a set whose multipliers stay nonnegative; the one that exceeds t most enters,
    and those leave whose multipliers vanish on the way. It begins with the set of a neighbour, which it hardly changes.

    Parameters
    ----------
    H, g
        (p, p) positive definite, and (p,).
    v, G, s
        (N,), (N, p) and (N,).
    """

    H: Array
    g: Array
    v: Array
    G: Array
    s: Array

    def minimum(self, start: np.ndarray, most: int) -> Least | None:
        """Return the minimum, begun with some functions; None where so many changes do not lead there.

        Parameters
        ----------
        start
            Numbers of the functions.
        most
            Changes of the set.
        """
        search = _Search(self)
        if not search.begun(start):
            return None
        enough = SLACK * max(float(np.max(np.abs(self.v))), TINY)
        while search.changes < most:
            slack = search.slack()
            worst = int(slack.argmax())
            if slack[worst] <= enough:
                if search.exact():
                    return search.least()
            elif not search.entered(worst, float(slack[worst])):
                return None
        return None


class _Search:
    """The active functions, with the step, the largest value and the multipliers x that belong to them.

    ::

        K x = y      K = (H 0 G'; 0 0 -s'; G -s 0)      x = (d, t, multipliers)      y = (-g, -1, -v)

    over the active ones, and the inverse B of K, to which a row and a column are added or taken away.
    """

    def __init__(self, of: Epigraph):
        self.of = of
        self.rows = np.column_stack([of.G, -of.s])
        self.many = self.rows.shape[1]
        self.active: list[int] = []
        self.changes = 0
        self.fresh = True
        self._room(self.many + 1)

    def _room(self, most: int) -> None:
        full = self.many + most
        self.B = np.zeros((full, full))
        self.x = np.zeros(full)

    @property
    def _size(self) -> int:
        return self.many + len(self.active)

    def begun(self, start: np.ndarray) -> bool:
        """Begin with those of a set whose multipliers are positive, or with the largest function alone."""
        self.active = [int(k) for k in start]
        if not (0 < len(start) <= self.many and self.of.s[start].any() and self._anew()):
            self.active = [int(np.argmax(np.where(self.of.s > 0, self.of.v, -np.inf)))]
            if not self._anew():
                return False
        while True:
            mu = self.x[self.many : self._size]
            least = int(mu.argmin())
            if mu[least] >= -NEGATIVE:
                return True
            if len(self.active) == 1:
                return False
            self._let_go(least)

    def _matrix(self) -> tuple[Array, Array]:
        """Return K and y."""
        size, p = self._size, self.many - 1
        K = np.zeros((size, size))
        rows = self.rows[self.active]
        K[:p, :p] = self.of.H
        K[self.many :, : self.many] = rows
        K[: self.many, self.many :] = rows.T
        return K, np.concatenate([-self.of.g, [-1.0], -self.of.v[self.active]])

    def _anew(self) -> bool:
        """Invert K; whether it could be."""
        K, y = self._matrix()
        factor, order, singular = _getrf(K.T)  # K is symmetric, and then as LAPACK has it in memory
        if singular:
            return False
        B, _ = _getri(factor, order, overwrite_lu=1)
        if not np.isfinite(B).all():
            return False
        size = self._size
        x = B @ y
        x += B @ (y - K @ x)
        self.B[:size, :size] = B
        self.x[:size] = x
        self.fresh = True
        return True

    def exact(self) -> bool:
        """Free the point from what rounding has left on the way; whether nothing else has to change then."""
        if self.fresh:
            return True
        if not self._anew():
            self.changes = MANY
            return False
        while len(self.active) > 1:
            mu = self.x[self.many : self._size]
            least = int(mu.argmin())
            if mu[least] >= -NEGATIVE:
                break
            self._let_go(least)
        return self.fresh

    def _let_go(self, i: int) -> None:
        """Take an active function away, the others' equations kept."""
        place = self.many + i
        size = self._size
        b = self.B[:size, place].copy()
        pivot = float(b[place])
        self.x[:size] -= b * (self.x[place] / pivot)
        self._removed(i, b, pivot)

    def _removed(self, i: int, b: Array, pivot: float) -> None:
        """Take its row and column from the inverse, and the last ones to where they were."""
        place, size = self.many + i, self._size
        last = size - 1
        B = self.B[:size, :size]
        B -= np.multiply.outer(b, b / pivot)
        B[place] = B[last]
        B[:, place] = B[:, last]
        self.x[place] = self.x[last]
        self.active[i] = self.active[-1]
        self.active.pop()
        self.changes += 1
        self.fresh = False

    def slack(self) -> Array:
        """Return by how much functions (N,) exceed the largest value."""
        slack = self.of.v + self.rows @ self.x[: self.many]
        slack[self.active] = -np.inf
        return slack

    def entered(self, j: int, slack: float) -> bool:
        """Let a function that exceeds the largest enter; whether it could."""
        row = self.rows[j]
        mu_j = 0.0
        while True:
            size = self._size
            change = -(self.B[:size, : self.many] @ row)
            fall = -float(row @ change[: self.many])
            length = float(np.sqrt((row @ row) * (change[: self.many] @ change[: self.many])))
            if len(self.active) == self.many or fall <= PARALLEL * length:
                fall = 0.0
            whole = np.inf
            share, last = self._first(change[self.many :])
            if fall > 0:
                whole = slack / fall
            step = min(whole, share)
            if not np.isfinite(step):
                return False
            self.x[:size] += step * change
            mu_j += step
            slack -= step * fall
            if whole <= share:
                self._added(j, mu_j, change, fall)
                return True
            others = self.of.s[self.active].sum() - self.of.s[self.active[last]]
            if not others and self.of.s[j]:
                return self._alone(j, last)
            b = self.B[:size, self.many + last].copy()
            self._removed(last, b, float(b[self.many + last]))

    def _first(self, change: Array) -> tuple[float, int]:
        """Return how far a change goes until the first multiplier vanishes, and which."""
        mu = self.x[self.many : self._size]
        falling = (change < 0).nonzero()[0]
        if not len(falling):
            return np.inf, -1
        ratios = np.maximum(mu[falling], 0.0) / -change[falling]
        first = int(ratios.argmin())
        return float(ratios[first]), int(falling[first])

    def _added(self, j: int, mu_j: float, change: Array, fall: float) -> None:
        size = self._size  # below that of B: as many rows as unknowns let none enter
        self.B[:size, :size] -= np.multiply.outer(change, change / fall)
        self.B[:size, size] = self.B[size, :size] = -change / fall
        self.B[size, size] = -1 / fall
        self.x[size] = mu_j
        self.active.append(j)
        self.changes += 1
        self.fresh = False

    def _alone(self, j: int, last: int) -> bool:
        """Put a function in the place of the only one that was equal to the largest value."""
        self.active[last] = j
        self.changes += 1
        return self._anew()

    def least(self) -> Least:
        """Return point and multipliers."""
        shares = np.zeros(len(self.of.v))
        shares[self.active] = np.maximum(self.x[self.many : self._size], 0.0)
        p = self.many - 1
        bend = -self.B[:p, self.many : self._size]
        return Least(self.x[:p].copy(), float(self.x[p]), shares, self.changes, np.array(self.active), bend)
