"""A loss that is the largest of many: of the configurations' norms, of the residuals, or of their absolute values."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.rows import Topmost

NEAR_ZERO = 1e-150
"""Norms below have no direction."""


@dataclass(frozen=True, eq=False)
class Largest:
    """max_k (a_k |r_k + shift_k| + c_k) over groups of equations, or max_i (a_i r_i + c_i), r (m,) ordered by groups.

    Parameters
    ----------
    a, c
        (N,) by groups; a is zero or more, save of signed ones.
    shift
        (m,) what is added to the residual.
    starts
        (N,) the first equation of every group; None where every equation is a group.
    signed
        Whether r_i itself counts, and not its absolute value.

    Examples
    --------
    >>> import numpy as np
    >>> from rpim_opt.convex.largest import Largest
    >>> r = np.array([3.0, 4.0, 0.0, -6.0])
    >>> two = Largest(np.ones(2), np.zeros(2), np.zeros(4), np.array([0, 2]), signed=False)
    >>> two.values(r), two.at(r)
    (array([5., 6.]), 6.0)
    >>> two.slope(r, np.array([0.5, 0.5]))
    array([ 0.3,  0.4,  0. , -0.5])
    """

    a: Array
    c: Array
    shift: Array
    starts: np.ndarray | None
    signed: bool

    @cached_property
    def begin(self) -> np.ndarray:
        """(N,) the first equation of every group."""
        if self.starts is None:
            return np.arange(len(self.shift))
        return self.starts

    @cached_property
    def sizes(self) -> np.ndarray:
        """(N,) equations of every group."""
        return np.diff(np.append(self.begin, len(self.shift)))

    @cached_property
    def which(self) -> np.ndarray:
        """(m,) the group of every equation."""
        return np.repeat(np.arange(len(self.sizes)), self.sizes)

    def norms(self, r: Array) -> Array:
        """Return |r_k + shift_k| (N,), or r itself where signs count."""
        known = self._last.get("norms")
        if known is None or known[0] is not r:  # value, slope and curvature ask for the same
            known = (r, self._norms(r))
            self._last["norms"] = known
        return known[1]

    @cached_property
    def _last(self) -> dict[str, tuple[Array, Array]]:
        """The last residual, and its norms."""
        return {}

    def _norms(self, r: Array) -> Array:
        s = r + self.shift
        if self.signed:
            return s
        if self.starts is None:
            return np.abs(s)
        return np.sqrt(np.add.reduceat(s * s, self.starts))

    def values(self, r: Array) -> Array:
        """Return the numbers (N,) of which the loss is the largest."""
        return self.a * self.norms(r) + self.c

    def at(self, r: Array) -> float:
        """Return the loss of a residual (m,)."""
        return float(self.values(r).max())

    def directions(self, r: Array) -> Array:
        """Return the slope (m,) of every group's number by its own equations."""
        if self.signed:
            return self.a[self.which]
        factor = self.a / np.maximum(self.norms(r), NEAR_ZERO)
        return factor[self.which] * (r + self.shift)

    def projected(self, rows: Array, r: Array) -> Array:
        """Return the slopes (N, p) of the groups' numbers along the columns of rows (m, p), of residuals r (m,)."""
        directions = self.directions(r)
        each = self._alike
        if not each:
            return np.add.reduceat(directions[:, None] * rows, self.begin)
        return np.einsum("nk,nkp->np", directions.reshape(-1, each), rows.reshape(-1, each, rows.shape[1]))

    @cached_property
    def _alike(self) -> int:
        """Equations of every group that all have the same number; else 0."""
        if np.ptp(self.sizes) > 0:
            return 0
        return int(self.sizes[0])

    def slope(self, r: Array, shares: Array) -> Array:
        """Return the slope (m,) of the groups' mean with shares (N,), which is a subgradient of the loss nearby."""
        return shares[self.which] * self.directions(r)

    def minorant(self, r: Array, shares: Array, slope: Array) -> float:
        """Return at r (m,) a linear function that the loss is nowhere below, of shares (N,) and their slope (m,)."""
        return float(shares @ self.c + slope @ (r + self.shift))

    def curvature(self, r: Array, shares: Array) -> tuple[np.ndarray, Array]:
        """Return the groups that have a share, and by what their norms' second derivatives are multiplied."""
        heard = shares.nonzero()[0]
        if self.signed or self.starts is None:
            return heard[:0], np.empty(0)
        factor = shares[heard] * self.a[heard] / np.maximum(self.norms(r)[heard], NEAR_ZERO)
        return heard, factor

    def shares(self, slope: Array) -> Array:
        """Return the shares (N,) that a slope (m,) tells of; none where they do not fit."""
        size = np.sqrt(np.add.reduceat(slope**2, self.begin))
        shares = np.divide(size, np.abs(self.a), out=np.zeros_like(size), where=self.a != 0)
        return shares / max(float(shares.sum()), NEAR_ZERO)


def of_norms(found: Topmost, starts: np.ndarray, equations: int) -> Largest | None:
    """Return the largest over groups' norms; None where that does not grow with them."""
    a, c = _each(found, len(starts))
    if np.any(a < 0) or not np.any(a) or (found.absolute and np.any(c < 0)):
        return None
    return Largest(a, c + found.constant, np.zeros(equations), starts, signed=False)


def of_equations(found: Topmost, equations: int) -> Largest | None:
    """Return the largest over equations; None where some do not matter."""
    a, c = _each(found, equations)
    constant = np.full(len(a), found.constant)
    if not np.all(a):
        return None
    if found.absolute:
        return Largest(np.abs(a), constant, c / a, None, signed=False)
    return Largest(a, c + constant, np.zeros(len(a)), None, signed=True)


def _each(found: Topmost, count: int) -> list[Array]:
    return [np.full(count, found.factor) * each for each in found.of]
