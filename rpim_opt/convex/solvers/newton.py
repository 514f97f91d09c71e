"""Proximal Newton for a separable convex loss: a sequence of squares, with the penalty and the constraints as they are.

Around a point the loss has a quadratic model (value, slope, curvature of residuals or of configurations' norms); its
minimum with the penalty and the constraints is a small program, and a line search on the true loss ends the step. A
non-smooth loss is first smoothed by convolution with a box, or by sqrt(v^2 + h^2) of norms, with a falling width h;
then the rows near a kink are taken as they are (Lee, Sun and Saunders 2014, SIAM J. Optim. 24:1420).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.canonical import Canonical
from rpim_opt.convex.solvers.small import Point, Small, Squares, Unsolved
from rpim_opt.convex.solvers.summands import Summands

DECREASE = 1e-12
"""Newton ends where its model promises less, relative to the objective."""
INTERIOR = 1e-10
"""The same where an interior point solves the small program, which is no more exact."""
STEPS = 60
"""Newton steps of one smoothing width."""
FEW = 400
"""Entries of a non-smooth loss up to which Clarabel takes them all as they are."""
NEAR = 12
"""Times the number of parameters: rows near a kink that are taken as they are."""
SMOOTHED = 0.02
"""Part of what smoothing may add to the loss below which Newton stops at a width."""
NARROWER = 10.0
"""Factor between two widths."""
NARROWEST = 1e-9
"""Smallest width, relative to the mean residual."""
PROXIMAL = 1e-13
"""Weight of |z - z_k|^2 in a quadratic model, relative to its curvature."""
UNSEEN = 1e-12
"""Singular values of A below this part of the largest are rounding."""
TINY = 1e-12
"""Norms are taken as no smaller."""
POOR = 1e-3
"""Ratio of pivots of a Hessian below which it gets secants (iteratively reweighted least squares) beside it."""
FEWER, LEAST_SECANTS = 0.1, 1e-8
"""Factor on the secants after a full step, and their least part."""
ROUND = 32
"""Rows that are taken as they are come in multiples of this: a program of so many is made once."""
BLOCK = 1024
"""Rows that are multiplied together, as a processor's cache holds them."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Equations A z ~ b of one linear model, those of a configuration next to each other.

    Parameters
    ----------
    A, b
        (m, n) and (m,).
    sizes
        (N,) equations a configuration; None where the loss gets equations.
    triangle
        (n + 1, n + 1) QR factor of [A b].
    """

    A: Array
    b: Array
    sizes: np.ndarray | None
    triangle: Array

    @cached_property
    def starts(self) -> np.ndarray:
        """First equation of every configuration (N,)."""
        if self.sizes is None:
            return np.arange(len(self.b))
        return np.concatenate([[0], np.cumsum(self.sizes)[:-1]])

    @cached_property
    def squares(self) -> Squares:
        """|A z - b|^2, reduced."""
        n = self.A.shape[1]
        return Squares(self.triangle[:, :n], self.triangle[:, n], np.zeros(n))

    @cached_property
    def whitened(self) -> tuple[Array, Array]:
        """U (m, r) and T (r, n) with A = U T and U'U = 1: in u = T z every model of a loss is well conditioned."""
        n = self.A.shape[1]
        _, s, V = np.linalg.svd(self.triangle[:, :n])
        V = V[: len(s)]
        seen = s > UNSEEN * s[0]
        s, V = s[seen], V[seen]
        return self.A @ (V.T / s), s[:, None] * V

    def spread(self, v: Array) -> Array:
        """Return numbers of entries (N,) by equation (m,)."""
        if self.sizes is None:
            return v
        return np.repeat(v, self.sizes)

    def entries(self, r: Array) -> Array:
        """Return what the loss gets of a residual (m,): itself, or the norms of the configurations (N,)."""
        if self.sizes is None:
            return r
        return np.sqrt(np.add.reduceat(r * r, self.starts))

    def places(self, which: np.ndarray) -> np.ndarray:
        """Return the places of the equations of some entries."""
        if self.sizes is None:
            return which
        places = [np.arange(int(self.sizes[i])) + self.starts[i] for i in which]
        return np.concatenate([np.zeros(0, dtype=int), *places])

    def of(self, which: np.ndarray) -> tuple[Array, Array]:
        """Return the equations of some entries."""
        places = self.places(which)
        return self.A[places], self.b[places]


@dataclass(eq=False)
class Newton:
    """One search for the minimum of loss(A z - b) + |size (z - centre)|^2 + weight penalty(z) subject to constraints.

    Parameters
    ----------
    loss, rows, penalty, small
        The summands, the equations, the canonical penalty with constraints, and its small program without exact rows.
    weight
        Of the penalty.
    size, centre
        (n,) each: damping; None for none.
    kink
        Largest jump of the loss's slope; 0 where it is smooth.
    exact
        Small programs with so many rows as they are, where one serves any rows.
    accuracy
        Part of the loss that the search may leave undone.
    """

    loss: Summands
    rows: Rows
    penalty: Canonical
    small: Small
    weight: float
    size: Array | None
    centre: Array | None
    kink: float
    exact: dict[int, Small]
    accuracy: float = 0.0
    steps: int = 0
    x: Array = field(default_factory=lambda: np.zeros(0))
    point: Point | None = None

    # --- the loss ----------------------------------------------------------------------------------------------------

    def _slope(self, r: Array, h: float) -> Array:
        """Return the slope (m,) of the smoothed loss by residuals."""
        if self.rows.sizes is None:
            return self.loss.smooth(r, h)[0] if h else self.loss.slope(r)
        v = np.sqrt(np.add.reduceat(r * r, self.rows.starts) + h * h)
        return self.rows.spread(self.loss.slope(v) / np.maximum(v, 1e-300)) * r

    def _model(self, r: Array, h: float, out: np.ndarray | None = None) -> tuple[Array, Array]:
        """Return gradient and Hessian of the smoothed loss by u = T z, without the entries ``out``."""
        U = self.rows.whitened[0]
        if self.rows.sizes is None:
            slope, curvature = self.loss.smooth(r, h)
            if out is not None:
                slope[out] = 0.0
                curvature[out] = 0.0
            return U.T @ slope, gram(U, curvature)
        sizes, starts = self.rows.sizes, self.rows.starts
        v = np.maximum(np.sqrt(np.add.reduceat(r * r, starts) + h * h), TINY)
        slope, curvature = self.loss.smooth(v, 0.0)
        inner = np.maximum(v * v - h * h, 0.0)  # |r|^2
        across = slope / v
        along = curvature * inner / v**2 + slope * h * h / v**3
        if out is not None:
            across[out] = 0.0
            along[out] = 0.0
        across = np.maximum(across, 0.0)
        unit = r / self.rows.spread(np.sqrt(np.maximum(inner, 1e-300)))
        wide = self.rows.spread(across)
        H = gram(U, wide)
        bent = np.flatnonzero(np.abs(along - across) > 1e-9 * across.max(initial=0.0))
        if len(bent):
            if np.ptp(sizes) == 0:
                d = int(sizes[0])
                turned = np.einsum("kd,kdn->kn", unit.reshape(-1, d)[bent], U.reshape(-1, d, U.shape[1])[bent])
            else:
                turned = np.add.reduceat(U * unit[:, None], starts)[bent]
            H += (turned * (along - across)[bent, None]).T @ turned
        return U.T @ (wide * r), H

    def _residual(self, z: Array) -> Array:
        return self.rows.A @ z - self.rows.b

    def _total(self, r: Array) -> float:
        return float(self.loss.values(self.rows.entries(r)).sum())

    def _value(self, z: Array, x: Array) -> float:
        return self._total(self._residual(z)) + self.weight * self.penalty.value(x) + self._damping(z)

    def _damping(self, z: Array) -> float:
        if self.size is None or self.centre is None:
            return 0.0
        return float(np.sum((self.size * (z - self.centre)) ** 2))

    def _solved(self, z: Array, gradient: Array, H: Array, small: Small | None = None, *exact: Array) -> Point:
        """Return the minimum of the quadratic model around z (n,), with the penalty and the constraints."""
        T = self.rows.whitened[1]
        n = T.shape[1]
        ridge = PROXIMAL * np.trace(H) + np.finfo(float).tiny
        L = np.linalg.cholesky(H + ridge * np.eye(len(H)))
        R = np.vstack([np.sqrt(0.5) * L.T @ T, np.zeros((n + 1 - len(T), n))])
        squares = Squares(R, R @ z, T.T @ gradient).damped(self.size, self.centre)
        self.steps += 1
        return (small or self.small).solve(squares, self.weight, *exact)

    # --- smooth losses -----------------------------------------------------------------------------------------------

    def smooth(self, z: Array, x: Array, h: float = 0.0, tolerance: float = DECREASE, most: int = STEPS) -> Array:
        """Return the minimum (n,) of the loss smoothed with width h, from z with x of the penalty's form."""
        at, T, weight = self.penalty.at, self.rows.whitened[1], self.weight
        self.x = x
        r = self._residual(z)
        size = max(min(abs(self._total(r)), float(len(r))), TINY)  # outliers do not loosen it
        secants, t_before = 0.0, 0.0
        tolerance = max(tolerance, self.accuracy)
        for _ in range(most):
            gradient, H = self._model(r, h)
            if secants or _poor(H):
                secants = max(secants, LEAST_SECANTS) if t_before == 1.0 else 1.0
                H = H + secants * self._secants(r, h)
            self.point = self._solved(z, gradient, H)
            ahead = self.point.x
            d = ahead[at] - z
            chord = weight * (self.penalty.value(ahead) - self.penalty.value(self.x))
            u = T @ d
            pull, bend = self._damping_along(z, d)
            promised = -(gradient @ u + 0.5 * u @ H @ u + chord + pull + 0.5 * bend)
            if self.point.iterations:  # Clarabel's accuracy
                tolerance = max(tolerance, INTERIOR)
            if promised <= tolerance * size:
                break
            Ad = self.rows.A @ d
            t, left = self._search(r, Ad, chord + pull, bend, h, float(gradient @ u) + chord + pull)
            if t == 0:
                break
            secants *= FEWER if t == 1.0 else 1.0
            t_before = t
            z = z + t * d
            r = r + t * Ad
            self.x = self.x + t * (ahead - self.x)
            # the model's error along the step says what the next one could gain
            if (t == 1.0 and promised * left**2 <= 0.01 * tolerance * size) or t * np.abs(d).max() < 1e-15:
                break
        return z

    def _secants(self, r: Array, h: float) -> Array:
        """Return the Hessian by u = T z of squares with the loss's slopes at r and -r: they lie nowhere below it."""
        U, v = self.rows.whitened[0], np.where(np.abs(r) > TINY, r, TINY)
        return gram(U, np.maximum((self._slope(v, h) - self._slope(-v, h)) / (2 * v), 0.0))

    def _damping_along(self, z: Array, d: Array) -> tuple[float, float]:
        """Return first and second derivative of the damping along a step."""
        if self.size is None or self.centre is None:
            return 0.0, 0.0
        along = self.size**2 * d
        return float(2 * along @ (z - self.centre)), float(2 * along @ d)

    def _search(self, r: Array, Ad: Array, chord: float, bend: float, h: float, before: float) -> tuple[float, float]:
        """Return t in (0, 1] where the derivative along the step is small, and how small: no value of it is needed."""
        if before >= 0:  # rounding: no descent is left
            return 0.0, 0.0
        low, high, t = 0.0, 1.0, 1.0
        slope_low, slope_high = before, 0.0
        for _ in range(30):
            now = float(self._slope(r + t * Ad, h) @ Ad) + chord + t * bend
            if (now <= 0 and t == 1.0) or abs(now) <= 0.1 * abs(before):
                return t, now / before
            if now > 0:
                high, slope_high = t, now
            else:
                low, slope_low = t, now
            share = -slope_low / (slope_high - slope_low)
            t = low + (high - low) * min(max(share, 0.1), 0.9)
        return t, 1.0

    # --- non-smooth losses -------------------------------------------------------------------------------------------

    def non_smooth(self, z: Array, x: Array, warm_width: float, warm: bool) -> tuple[Array, float]:
        """Return the minimum (n,) of a non-smooth loss, and the width of smoothing at which it was found."""
        self.x = x
        few = max(NEAR * self.rows.A.shape[1], 200)
        v = np.abs(self.rows.entries(self._residual(z)))
        h = float(np.median(v)) / (NARROWER if warm else 1.0)
        floor = NARROWEST * max(float(np.mean(v)), TINY)
        if warm and warm_width:
            near = self._near(self.rows.entries(self._residual(z)), 3 * warm_width)
            if 0 < len(near) <= few:
                found = self._exact(z, near, warm_width)
                if found is not None:
                    return found, warm_width
        while h > floor:
            v = self.rows.entries(self._residual(z))
            added = np.count_nonzero(np.abs(v) < h) * h * self.kink  # what smoothing may add to the loss
            before, z_before, x_before = self._value(z, self.x), z, self.x
            size = max(abs(self._total(self._residual(z))), TINY)
            z = self.smooth(z, self.x, h, max(SMOOTHED * added / size, DECREASE), 30)
            if self._value(z, self.x) > before + 2 * added + 1e-12 * abs(before):  # below what rounding lets pass
                self.x = x_before
                return z_before, h
            near = self._near(self.rows.entries(self._residual(z)), 3 * h)
            if added <= self.accuracy * size:
                return z, h
            if len(near) <= few:
                found = self._exact(z, near, h)
                if found is not None:
                    return found, h
            h /= NARROWER
        return z, h

    def _near(self, v: Array, h: float) -> np.ndarray:
        """Return the entries within h of a kink."""
        if self.rows.sizes is None:
            rise = self.loss.slope(v + h) - self.loss.slope(v - h)
            return np.flatnonzero(rise > 0.1 * self.kink)
        rise = self.loss.slope(v + h) - self.loss.slope(np.maximum(v - h, -1e-12))
        return np.flatnonzero((rise > 0.1 * self.kink) | (v < h))

    def _exact(self, z: Array, near: np.ndarray, h: float) -> Array | None:
        """Return the minimum with rows near a kink as they are, the others by their model, until no other row bends."""
        at, T, weight = self.penalty.at, self.rows.whitened[1], self.weight
        value = self._value(z, self.x)
        for _ in range(8):
            if len(near) > 2 * max(NEAR * self.rows.A.shape[1], 200):
                return None
            r = self._residual(z)
            near = self._filled(near, r)
            gradient, H = self._model(r, 0.0, near)
            A, b = self.rows.of(near)
            small = self.small
            exact: tuple[Array, ...] = ()
            if len(near):
                small = self._with_rows(near)
                exact = (A, b)
            try:
                point = self._solved(z, gradient, H, small, *exact)
            except (Unsolved, np.linalg.LinAlgError):
                return None
            ahead = point.x[at]
            d = ahead - z
            r_ahead = self._residual(ahead)
            v, v_ahead = self.rows.entries(r), self.rows.entries(r_ahead)
            old, new = self.loss.values(v)[near].sum(), self.loss.values(v_ahead)[near].sum()
            chord = weight * (self.penalty.value(point.x) - self.penalty.value(self.x))
            damping = self._damping(ahead) - self._damping(z)
            u = T @ d
            promised = -(gradient @ u + 0.5 * u @ H @ u + chord + damping + new - old)
            there = self._total(r_ahead) + weight * self.penalty.value(point.x) + self._damping(ahead)
            if there <= value:
                z, value, self.x, self.point = ahead, there, point.x, point
            if promised <= 1e-9 * max(abs(value), 1e-9):
                return z
            bent = np.abs(self.loss.slope(v_ahead) - self.loss.slope(v)) > 0.1 * self.kink
            beside = self._near(self.rows.entries(self._residual(z)), h)
            near = np.union1d(near, np.union1d(np.flatnonzero(bent), beside))
        return None

    def _filled(self, near: np.ndarray, r: Array) -> np.ndarray:
        """Return entries and the smallest others, so many that their number comes again."""
        if not len(near) or not self._alike:
            return near
        count = min(-(-len(near) // ROUND) * ROUND, self.loss.variable.size)
        order = np.argsort(np.abs(self.rows.entries(r)))
        return np.sort(np.concatenate([near, order[~np.isin(order, near)][: count - len(near)]]))

    @property
    def _alike(self) -> bool:
        """Whether one small program serves any entries of a number."""
        return self.loss.uniform and (self.rows.sizes is None or np.ptp(self.rows.sizes) == 0)

    def _with_rows(self, near: np.ndarray) -> Small:
        """Return the small program with the rows of some entries as they are."""
        if self._alike and len(near) in self.exact:
            return self.exact[len(near)]
        expression, own = self.loss.some(near)
        sizes = None if self.rows.sizes is None else self.rows.sizes[near]
        made = Small(self.penalty, self.small.rows, Canonical(expression, [], own), sizes)
        if self._alike:
            self.exact[len(near)] = made
        return made


def _poor(H: Array) -> bool:
    """Whether some directions have hardly any curvature: Newton's steps along them would be far too long."""
    pivots = np.diag(np.linalg.cholesky(H + PROXIMAL * np.trace(H) * np.eye(len(H))))
    return bool(pivots.min() < POOR * pivots.max())


def gram(A: Array, weights: Array) -> Array:
    """Return A' diag(weights) A of A (m, n), in blocks that stay in the cache; rows of weight zero cost nothing."""
    H = np.zeros((A.shape[1], A.shape[1]))
    some = np.flatnonzero(weights)
    whole = len(some) == len(weights)
    root = np.sqrt(weights if whole else weights[some])[:, None]
    for i in range(0, len(some), BLOCK):
        rows = A[i : i + BLOCK] if whole else A[some[i : i + BLOCK]]
        part = rows * root[i : i + BLOCK]
        H += part.T @ part
    return H


def kink_of(loss: Summands, rows: Rows) -> float:
    """Return the largest jump of a loss's slope: by residuals, or where norms are zero."""
    size = float(np.sqrt(np.mean(rows.entries(rows.b) ** 2))) or 1.0
    kink = loss.jump(size)
    if rows.sizes is None:
        return kink
    count = len(rows.sizes)
    at_zero = float(loss.slope(np.full(count, 1e-12 * size)).max())
    far = float(loss.slope(np.full(count, size)).max())
    if at_zero > 1e-3 * far:  # f(|r|) has a kink where f rises at once
        return max(kink, at_zero)
    return kink
