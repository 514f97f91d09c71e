"""Least squares in a box: the exact minimum, by a method that provably ends."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import get_lapack_funcs

from rpim_opt.basics.arrays import Array

EPS = float(np.finfo(float).eps)
UNSEEN = 10 * EPS
"""Singular values below this part of the largest are rounding: steps have no component along them."""
SNAP = 4 * EPS
"""How near to a bound, relative to its size, a start counts as lying on it."""
SLOPE = 4 * EPS
"""Rounding of a slope, relative to the norms of its column and of the residual."""

_gelsy: Callable[..., Any]
(_gelsy,) = get_lapack_funcs(("gelsy",), (np.empty(1),))


def minimum_in_box(A: Array, b: Array, lower: Array, upper: Array, start: Array | None = None) -> tuple[Array, Array]:
    """Return where |A z - b|^2 is least in the box lower <= z <= upper, and by how much each bound holds it back.

    A face of the box is told by the components that lie on a bound; the others are free. The method goes from the
    minimum of one face (a small least-squares problem) to that of another, until no bound at which the objective
    would fall inwards is left (Stark and Parker 1995, Computational Statistics 10:129).

    Why it ends. On the way to the minimum of a face bounds are only added, at most n. Bounds are given up only at such
    a minimum, and the minimum that this leads to is kept only if the objective is lower there by more than rounding
    can feign: the exact objective falls strictly, so no point comes twice, and floating-point points are finitely many
    (in exact arithmetic no face comes twice: at most 3^n, in practice about n / 4). Bounds that were given up in vain
    stay until the objective has fallen again: at most n + 1 trials in a row. None of this depends on how a processor
    rounds, and what is returned is the best minimum that was met.

    Parameters
    ----------
    A, b
        Equations (k, n) and (k,), finite.
    lower, upper
        Bounds (n,), infinite where there is none, equal where a component is fixed; never crossed.
    start
        A point (n,) near the minimum; the bounds on which it lies are the first to be tried. Zero by default.
        Directions that A does not see stay where it has them, as far as the box lets them.

    Returns
    -------
    z
        The minimum (n,); components on a bound equal it exactly.
    multipliers
        (n,), zero or more: by how much the objective would fall per unit by which the bound were loosened; of a
        fixed component the absolute slope.

    Examples
    --------
    >>> import numpy as np
    >>> from rpim_opt.convex.active_set import minimum_in_box
    >>> z, multipliers = minimum_in_box(np.eye(2), np.array([3.0, 0.5]), np.zeros(2), np.ones(2))
    >>> [float(value) for value in z]
    [1.0, 0.5]
    >>> [float(value) for value in multipliers]  # (3 - 1)^2 falls by 4 per unit
    [4.0, 0.0]
    """
    box = _Box(_tall(A, len(lower)), _tall(b, len(lower)), lower, upper)
    z = box.snapped(np.zeros(len(lower)) if start is None else start)
    best = box.face_minimum(z, box.within(z))
    vain = np.zeros(len(z), dtype=bool)
    together = True
    while True:
        wrong = best.wrong & ~vain
        if not wrong.any():
            return best.z, best.multipliers
        freed = wrong  # all at once is quicker, but only one at a time is sure to lower the objective
        if not together:
            freed = best.steepest(wrong)
        trial = box.face_minimum(best.z, best.free | freed)
        if trial.lower_than(best):
            best = trial
            vain[:] = False
        elif np.count_nonzero(freed) > 1:
            together = False
        else:
            vain |= freed


def _tall(rows: Array, n: int) -> Array:
    """Return the rows, with rows of zeros where there are fewer than unknowns, as LAPACK's layout has it."""
    missing = max(n - len(rows), 0)
    if missing:
        rows = np.concatenate([rows, np.zeros((missing, *rows.shape[1:]))])
    return np.asarray(rows, dtype=float, order="F")


@dataclass(frozen=True, eq=False)
class _Box:
    """The problem: equations A (k, n), b (k,) with k >= n, and bounds (n,)."""

    A: Array
    b: Array
    lower: Array
    upper: Array

    @cached_property
    def size(self) -> Array:
        """Norms of the columns of A (n,)."""
        return np.sqrt(np.einsum("ij,ij->j", self.A, self.A))

    @cached_property
    def rounding(self) -> float:
        """Bound of the relative error of a residual's scalar product: that of k + n sums, and of some differences."""
        return (sum(self.A.shape) + 4) * EPS

    def clipped(self, z: Array) -> Array:
        """Return the nearest point (n,) in the box."""
        return np.minimum(np.maximum(z, self.lower), self.upper)

    def snapped(self, z: Array) -> Array:
        """Return the nearest point in the box; what lies on a bound but for rounding lies on it."""
        z = self.clipped(z)
        near = SNAP * np.abs(z)
        z = np.where(z - self.lower <= near, self.lower, z)
        return np.where(self.upper - z <= near, self.upper, z)

    def within(self, z: Array) -> np.ndarray:
        """Return which components (n,) lie strictly between their bounds."""
        return (self.lower < z) & (z < self.upper)

    def residual(self, z: Array) -> Array:
        """Return b - A z (k,)."""
        return self.b - self.A @ z

    def face_minimum(self, z: Array, free: np.ndarray) -> _Minimum:
        """Return the minimum of a face that is met from z when some components are free; others may become bound."""
        r = self.residual(z)
        while True:
            step = self.step(r, free)
            whole = z + step
            target = self.clipped(whole)
            after = self.residual(target)
            if not ((target < whole) | (target > whole)).any():  # so posed that not-a-number ends too
                return _Minimum(self, target, after, self.within(target))
            if not after @ after < r @ r:  # cut off at every bound the step went too far
                target = self.first_bound(z, step)
                after = self.residual(target)
            z = target
            r = after
            free = free & self.within(z)

    def step(self, r: Array, free: np.ndarray) -> Array:
        """Return the step (n,) of the free components, shortest of those that leave the least of a residual r."""
        step = np.zeros(len(free))
        count = np.count_nonzero(free)
        if count:
            pivots = np.zeros((count, 1), dtype=np.int32)
            found = _gelsy(self.A[:, free], r, pivots, UNSEEN, 4 * count + 64 * (count + 1), overwrite_a=True)
            step[free] = found[1][:count]
        return step

    def first_bound(self, z: Array, step: Array) -> Array:
        """Return the point where the way from z along a step that leaves the box meets the first bound."""
        ahead = np.where(step > 0, self.upper, self.lower)
        share = np.full(len(z), np.inf)
        np.divide(ahead - z, step, out=share, where=step != 0)
        k = int(np.argmin(share))
        met = self.clipped(z + share[k] * step)
        met[k] = ahead[k]
        return met


@dataclass(frozen=True, eq=False)
class _Minimum:
    """The minimum of a face: z (n,), its residual r = b - A z (k,), and which components are free."""

    box: _Box
    z: Array
    r: Array
    free: np.ndarray

    @cached_property
    def terms(self) -> float:
        """Size of the terms whose sum is the residual: |b| + sum_j |a_j z_j|."""
        return float(np.linalg.norm(self.box.b) + self.box.size @ np.abs(self.z))

    @cached_property
    def slope(self) -> Array:
        """Minus half the gradient of the objective (n,)."""
        return self.box.A.T @ self.r

    @cached_property
    def inward(self) -> Array:
        """Half of what the objective falls per unit from a bound inwards (n,), zero off the bounds and where fixed."""
        into = np.where(self.z <= self.box.lower, self.slope, -self.slope)
        return np.where(self.free | (self.box.lower == self.box.upper), 0.0, into)

    @property
    def wrong(self) -> np.ndarray:
        """Which bounds (n,) hold back nothing: inwards the objective falls."""
        rounding = SLOPE * float(np.linalg.norm(self.r)) * self.box.size
        return self.inward > rounding

    def steepest(self, among: np.ndarray) -> np.ndarray:
        """Return the component, as a mask (n,), at whose bound the objective falls most for its column's norm."""
        fall = np.full(len(self.z), -np.inf)
        np.divide(self.inward, self.box.size, out=fall, where=among)
        return np.arange(len(fall)) == np.argmax(fall)

    def lower_than(self, other: _Minimum) -> bool:
        """Return whether the objective is lower than at another point, beyond what rounding could feign."""
        apart = self.z - other.z
        moved = self.box.A @ apart
        fall = moved @ (self.r + other.r)  # the difference of the squares, without their cancellation
        in_moved = self.box.size @ np.abs(apart) * np.linalg.norm(self.r + other.r)
        in_residuals = (self.terms + other.terms) * np.linalg.norm(moved)
        return bool(fall > self.box.rounding * (in_moved + in_residuals))

    @property
    def multipliers(self) -> Array:
        """By how much the objective falls per unit by which each bound is loosened (n,)."""
        fixed = self.box.lower == self.box.upper
        return 2 * np.where(fixed, np.abs(self.slope), np.maximum(-self.inward, 0.0))
