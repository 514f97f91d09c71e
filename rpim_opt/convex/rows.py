"""Sums over rows of functions of one number: values, slopes and curvatures of all rows at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array

Both = tuple[Array, Array]
"""Values and slopes."""


class Affine(NamedTuple):
    """Numbers a v + c of v (m,), component by component: one number for all components, or one each."""

    a: Any
    c: Any


class Curve(NamedTuple):
    """A function of one number: ``both`` gives values and slopes (m,) at numbers (m,), ``bend`` curvatures (m,)."""

    both: Callable[[Array], Both]
    bend: Callable[[Array], Array]


class Piece(NamedTuple):
    """factor f(a v + c), of every component v."""

    curve: Curve
    factor: Any
    of: Affine


class Kink(NamedTuple):
    """factor |a v + c|, of every component v."""

    factor: Any
    of: Affine


class Topmost(NamedTuple):
    """factor max_i (a v_i + c) + constant, or of the absolute values."""

    factor: float
    of: Affine
    absolute: bool
    constant: float


@dataclass(frozen=True, eq=False)
class Rows:
    """sum_i f_i(v_i): smooth pieces, kinks, and a constant.

    Examples
    --------
    >>> import cvxpy as cp
    >>> import numpy as np
    >>> from rpim_opt.convex.tree import rows_of
    >>> r = cp.Variable(3)
    >>> quantile = rows_of(cp.sum(cp.maximum(0.9 * r, -0.1 * r)), r)
    >>> len(quantile.pieces), [round(float(k.factor), 3) for k in quantile.kinks]
    (1, [0.5])
    >>> slope = rows_of(cp.sum(cp.huber(r, 2.0)), r).both(np.array([-9.0, 1.0, 2.5]))[1]
    >>> slope.tolist()
    [-4.0, 2.0, 4.0]
    >>> rows_of(cp.max(r), r) is None
    True
    """

    pieces: tuple[Piece, ...]
    kinks: tuple[Kink, ...] = field(default=())
    constant: float = 0.0

    def both(self, v: Array) -> tuple[float, Array]:
        """Return the sum of the smooth pieces at v (m,), with the constant, and their slopes (m,)."""
        total = self.constant
        slope = np.zeros(v.shape)
        for curve, factor, (a, c) in self.pieces:
            value, rise = curve.both(a * v + c)
            total += float((factor * value).sum())
            slope += factor * a * rise
        return total, slope

    def bend(self, v: Array) -> Array:
        """Return the curvatures (m,) of the smooth pieces."""
        bend = np.zeros(v.shape)
        for curve, factor, (a, c) in self.pieces:
            bend += factor * a**2 * curve.bend(a * v + c)
        return bend


# --- curves --------------------------------------------------------------------------------------------------------

LINE = Curve(lambda x: (x, np.ones_like(x)), np.zeros_like)
SQUARE = Curve(lambda x: (x**2, 2 * x), lambda x: np.full_like(x, 2.0))


def huber(bound: float) -> Curve:
    """Return x^2 up to a bound, and 2 bound |x| - bound^2 beyond."""

    def both(x: Array) -> Both:
        slope = 2 * np.minimum(np.maximum(x, -bound), bound)
        return slope * (x - slope / 4), slope

    return Curve(both, lambda x: np.where(np.abs(x) <= bound, 2.0, 0.0))


def power(p: float) -> Curve:
    """Return |x|^p, for an even p."""
    return Curve(lambda x: (x**p, p * x ** (p - 1)), lambda x: p * (p - 1) * x ** (p - 2))


def root(parts: list[Affine]) -> Curve:
    """Return the norm of (a_k x + c_k)_k, not all of which vanish together."""

    def both(x: Array) -> Both:
        value = np.sqrt(sum((a * x + c) ** 2 for a, c in parts))
        return value, sum(a * (a * x + c) for a, c in parts) / value

    def bend(x: Array) -> Array:
        value, slope = both(x)
        return (sum(a**2 for a, _ in parts) - slope**2) / value

    return Curve(both, bend)
