"""A loss that is a sum over rows or configurations, of the residual: value, slope and curvature, kinks smoothed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.rows import LINE, Affine, Kink, Piece, Rows

NEAR_ZERO = 1e-150
"""Norms below have no direction."""


MANY = 500
"""Groups from which their norms are summed column by column."""
PLAIN = Affine(1.0, 0.0)
"""Of the norms themselves."""
NONE: Array = np.empty(0)


class Curvature(NamedTuple):
    """Second derivative by the residual: ``across`` (m,) times 1, and ``along`` (N,) times u u' by groups.

    u (m,) is a unit vector in every group; both are empty where there is one equation a group.
    """

    across: Array
    along: Array = NONE
    u: Array = NONE


class Rounded(NamedTuple):
    """A smoothed kink: t = sharpness s + y (m,), its norms (N,), and what part of t the multiplier anew is, (N,)."""

    t: Array
    length: Array
    share: Array


class Smoothed(NamedTuple):
    """A loss with kinks smoothed: its slope (m,), the kinks' multipliers anew, and the value of what is no kink."""

    slope: Array
    multipliers: list[Array]
    without_kinks: float
    kinks: list[Rounded]


@dataclass(frozen=True, eq=False)
class Separated:
    """sum_i f_i(|r_i|) over groups of equations, or sum_i f_i(r_i) over equations, r (m,) ordered by groups.

    A kink k |s| of s = a r + c is replaced by its Moreau envelope about multipliers y: the least over t of
    k |t| + sharpness / 2 |t - s - y / sharpness|^2 (augmented Lagrangian; Rockafellar 1976, Math. Oper. Res. 1:97). Its
    slope is the multiplier anew: one that stays what it is makes the minimum that of the loss itself.

    Parameters
    ----------
    rows
        f_i.
    starts
        (N,) the first equation of every group; None where the loss gets equations.
    count
        Equations m.
    straight
        Whether norms are taken as they are, without kinks: where they are zero, their slope is zero, too.
    """

    rows: Rows
    starts: np.ndarray | None
    count: int
    straight: bool = False

    @cached_property
    def away(self) -> Separated | None:
        """The same sum as it is away from kinks at norms of zero; None where it has none, or of equations."""
        if self.starts is None or not self.kinks:
            return None
        line = Piece(LINE, self.at_zero - self._tilt, PLAIN)
        return replace(self, rows=replace(self._curved, pieces=(*self._curved.pieces, line)), straight=True)

    @cached_property
    def _sizes(self) -> np.ndarray:
        if self.starts is None:
            return np.ones(self.count, dtype=int)
        return np.diff(np.append(self.starts, self.count))

    @property
    def _begin(self) -> np.ndarray:
        """The first equation of every group, of one equation each where the loss gets those."""
        if self.starts is None:
            return np.arange(self.count)
        return self.starts

    @cached_property
    def which(self) -> np.ndarray:
        """(m,) the group of every equation."""
        return np.repeat(np.arange(len(self._sizes)), self._sizes)

    @cached_property
    def at_zero(self) -> Any:
        """Slopes (N,) of f_i at the norm zero, or one number: the kinks there."""
        if self.starts is None:
            return 0.0
        slope = self.rows.both(np.zeros(len(self.starts)))[1]
        for factor, of in self.rows.kinks:
            slope = slope + factor * np.abs(of.a)
        if np.ptp(slope) == 0:
            return float(slope[0])
        return slope

    @cached_property
    def kinks(self) -> list[Kink]:
        """The kinks, as norms of groups or as absolute values of equations."""
        if self.starts is None:
            return [Kink(np.broadcast_to(factor, self.count), of) for factor, of in self.rows.kinks]
        if self.straight or np.all(self.at_zero == 0):
            return []
        return [Kink(np.broadcast_to(self.at_zero, len(self.starts)), PLAIN)]

    def slope_of_norms(self, v: Array) -> Array:
        """Return f_i' (N,) at norms of groups, on the right where there is a kink."""
        slope = self._curved.both(v)[1]
        if self.straight:
            return slope
        return slope - self._tilt + self.at_zero

    @property
    def holds(self) -> bool:
        """Whether the sum is one that can be separated: its kinks over norms all at zero, and no slope falling."""
        if self.starts is None:
            return True
        rises = np.all(np.asarray(self.at_zero) >= 0)
        return bool(rises and all(np.all(of.c == 0) for _, of in self.rows.kinks))

    def picked(self, every: int) -> np.ndarray:
        """Return the places (k,) of the equations of one of every so many groups."""
        if every == 1 or self.starts is None:
            return np.arange(0, self.count, every)
        return np.flatnonzero(self.which % every == 0)

    def projected(self, rows: Array, u: Array, groups: np.ndarray, every: int = 1) -> Array:
        """Return u'rows (G, p) of some groups, u (m,) and rows (m, p); all of them of one of every so many groups."""
        sizes, each = self._sizes[::every], self._alike
        count = len(sizes)
        if each:
            by_group = u.reshape(count, each), rows.reshape(count, each, -1)
            if len(groups) == count:
                return np.einsum("nk,nkp->np", *by_group)
            if 2 * len(groups) > count:  # most of them: picked out afterwards
                return np.einsum("nk,nkp->np", *by_group)[groups]
            return np.einsum("nk,nkp->np", *(some[groups] for some in by_group))
        return np.add.reduceat(u[:, None] * rows, np.cumsum(sizes) - sizes)[groups]

    @cached_property
    def _alike(self) -> int:
        """Equations of every group that all have the same number; else 0."""
        sizes = self._sizes
        if np.ptp(sizes) > 0:
            return 0
        return int(sizes[0])

    @cached_property
    def _columns(self) -> int:
        """Equations of every group, of many that have the same number; else 0."""
        if len(self._sizes) < MANY:
            return 0
        return self._alike

    def _norms(self, s: Array) -> Array:
        if self.starts is None:
            return np.abs(s)
        if not self._columns:
            return np.sqrt(np.add.reduceat(s * s, self.starts))
        total = s[:: self._columns] ** 2
        for k in range(1, self._columns):
            total += s[k :: self._columns] ** 2
        return np.sqrt(total, out=total)

    def _spread(self, v: Any) -> Any:
        """Return numbers of groups (N,) by equation (m,)."""
        if self.starts is None or not isinstance(v, np.ndarray):
            return v
        return v[self.which]

    @cached_property
    def _curved(self) -> Rows:
        """What is no kink and, of norms, no line: a line in a norm is a kink at zero."""
        if self.starts is None or self.straight:
            return self.rows
        bent = tuple(piece for piece in self.rows.pieces if piece.curve is not LINE)
        nothing = np.zeros(len(self.starts))
        left = self.rows.both(nothing)[0] - Rows(bent).both(nothing)[0]
        return Rows(bent, constant=left)

    @cached_property
    def _tilt(self) -> Any:
        """Slopes (N,) that curved pieces have at norms of zero, which belong to the kink there; or one number."""
        if self.starts is None or self.straight:
            return 0.0
        slope = self._curved.both(np.zeros(len(self.starts)))[1]
        if np.any(slope):
            return slope
        return 0.0

    def _smooth(self, r: Array) -> tuple[float, Array]:
        """Return value and slope (m,) of what is no kink."""
        curved = self._curved
        if not curved.pieces:
            return curved.constant, np.zeros(r.shape)
        if self.starts is None:
            return curved.both(r)
        v = self._norms(r)
        value, slope = curved.both(v)
        if isinstance(self._tilt, np.ndarray):
            slope = slope - self._tilt
            value -= float(self._tilt @ v)
        return value, self._spread(slope / np.maximum(v, NEAR_ZERO)) * r

    def at(self, r: Array) -> float:
        """Return the loss of a residual (m,)."""
        return self._smooth(r)[0] + sum(self._bent(r))

    def _bent(self, r: Array) -> list[float]:
        """Return the value of every kink at a residual (m,)."""
        return [float(factor.dot(self._norms(_along(of, r)))) for factor, of in self.kinks]

    def smoothed(self, r: Array, y: list[Array], sharpness: float) -> Smoothed:
        """Return the loss with its kinks smoothed about multipliers, (m,) each."""
        value, slope = self._smooth(r)
        anew = []
        rounded = []
        for (factor, of), old in zip(self.kinks, y, strict=True):
            t = sharpness * _along(of, r) + old
            length = np.maximum(self._norms(t), NEAR_ZERO)
            share = np.minimum(1.0, factor / length)
            new = t * self._spread(share)
            anew.append(new)
            rounded.append(Rounded(t, length, share))
            slope = slope + of.a * new
        return Smoothed(slope, anew, value, rounded)

    def missed(self, r: Array, smoothed: Smoothed) -> tuple[float, float]:
        """Return the loss of a residual (m,), and what the multipliers there miss of its kinks."""
        bent = sum(self._bent(r))
        reached = sum(float(y.dot(_along(of, r))) for (_, of), y in zip(self.kinks, smoothed.multipliers, strict=True))
        return smoothed.without_kinks + bent, bent - reached

    def curvature(self, r: Array, smoothed: Smoothed, sharpness: float) -> list[Curvature]:
        """Return the second derivative of the smoothed loss, as a sum."""
        found = []
        if self._curved.pieces or not smoothed.kinks:
            found.append(self._smooth_curvature(r))
        for (factor, of), (t, length, share) in zip(self.kinks, smoothed.kinks, strict=True):
            outside = length > factor
            if self.starts is None:
                found.append(Curvature(of.a**2 * sharpness * ~outside))
                continue
            across = sharpness * share
            found.append(Curvature(self._spread(across), -across * outside, t / self._spread(length)))
        return found

    def _smooth_curvature(self, r: Array) -> Curvature:
        if not self._curved.pieces:
            return Curvature(np.zeros_like(r))
        if self.starts is None:
            return Curvature(self.rows.bend(r))
        v = self._norms(r)
        slope = self._curved.both(v)[1] - self._tilt
        bend = self._curved.bend(v)
        small = v <= NEAR_ZERO
        across = np.where(small, bend, slope / np.where(small, 1.0, v))
        return Curvature(self._spread(across), bend - across, r / self._spread(np.where(small, 1.0, v)))


def _along(of: Affine, r: Array) -> Array:
    """Return a r + c of residuals (m,)."""
    if of is PLAIN:
        return r
    return of.a * r + of.c
