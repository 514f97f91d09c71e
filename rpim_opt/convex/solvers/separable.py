"""Proximal Newton for a separable convex loss: a sequence of weighted least-squares models.

Around a point the loss has a quadratic model; minimizing it with the penalty and the constraints is a small program,
and a line search on the true loss completes the step. A non-smooth loss is smoothed by convolution with a box, or by
sqrt(v^2 + h^2) for norms, with decreasing width h; finally the rows near a non-smooth point are treated exactly (Lee,
Sun and Saunders 2014, SIAM J. Optim. 24:1420).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.expressions import Atom, Evaluation, cp, evaluation, has, is_norm
from rpim_opt.convex.solvers.conic import Canonical, Damping, Point, ReducedProgram, ReducedSquares, Unsolved

DECREASE = 1e-12
"""Newton ends when its model predicts a smaller decrease, relative to the objective."""
INTERIOR = 1e-10
"""The same if an interior-point method solves the small program, which is no more accurate."""
INEXACT = 1e-7
"""Relative to the loss: a small program whose minimum is above the current point by more than this was not solved."""
STEPS = 60
"""Most Newton steps per smoothing width."""
FEW_ENTRIES = 400
"""Largest number of entries of a loss that Clarabel treats exactly at once, where that is faster."""
NEAR = 6
"""Number of rows near a non-smooth point that are treated exactly, per parameter."""
SMOOTHED = 0.02
"""Newton stops at a width when the predicted decrease is this part of the largest smoothing error."""
NARROWER = 10.0
"""Ratio of consecutive widths."""
NARROWEST = 1e-9
"""Smallest width, relative to the mean residual."""
PROXIMAL = 1e-13
"""Weight of |z - z_k|^2 in a quadratic model, relative to its curvature."""
VANISHED = 1e-12
"""Singular values of A below this part of the largest are rounding."""
TINY = 1e-12
"""Lower bound on norms."""
POOR = 1e-3
"""Ratio of pivots of a Hessian below which secants (iteratively reweighted least squares) are added to it."""
FEWER, LEAST_SECANTS = 0.1, 1e-8
"""Factor on the added secants after a full step, and its lower bound."""
SCALED = ("AddExpression", "multiply", "MulExpression", "DivExpression", "reshape", "Promote")
"""Expressions whose entry i depends only on entry i of their arguments."""
JUMP = 1e-3
"""Least jump of the slope that counts, relative to its total variation."""
PROBES = 64
"""Number of entries at which non-smooth points are sought."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Equations A z ~ b, (m, n) and (m,), with the QR factor of [A b], or of the equations in a quadratic loss.

    ``counts`` (N,) are the numbers of equations of the configurations, which are contiguous; None if the loss gets
    equations.
    """

    A: Array
    b: Array
    counts: np.ndarray | None
    qr_factor: Array

    @cached_property
    def starts(self) -> np.ndarray:
        """First equation of every configuration (N,)."""
        counts: Any = self.counts
        return np.cumsum(counts) - counts

    @cached_property
    def squares(self) -> ReducedSquares:
        """|A z - b|^2, or a quadratic loss, reduced."""
        return ReducedSquares.of_factor(self.qr_factor)

    @cached_property
    def whitened(self) -> tuple[Array, Array]:
        """U (m, r) and T (r, n) with A = U T and U'U = 1: in u = T z every model of a loss is well conditioned."""
        n = self.A.shape[1]
        _, s, V = np.linalg.svd(self.qr_factor[:, :n])
        V = V[: len(s)]
        seen = s > VANISHED * s[0]
        s, V = s[seen], V[seen]
        return self.A @ (V.T / s), s[:, None] * V

    def by_equation(self, v: Array) -> Array:
        """Return numbers of entries (N,) by equation (m,)."""
        return v if self.counts is None else np.repeat(v, self.counts)

    def combined(self, U: Array, u: Array) -> Array:
        """Return the sums of u_i U_i over the equations i of each configuration (N, n), from U (m, n) and u (m,)."""
        each = len(u) // len(self.starts)
        if each * len(self.starts) == len(u) and (np.diff(self.starts) == each).all():  # nine times as fast
            return np.einsum("ikn,ik->in", U.reshape(-1, each, U.shape[1]), u.reshape(-1, each))
        return np.add.reduceat(U * u[:, None], self.starts)

    def entries(self, r: Array) -> Array:
        """Return the argument of the loss for a residual (m,): the residual, or the norms of configurations (N,)."""
        return r if self.counts is None else np.sqrt(np.add.reduceat(r * r, self.starts))

    def equations(self, which: np.ndarray) -> tuple[Array, Array]:
        """Return the equations A and b of some entries."""
        places = which
        if self.counts is not None:
            places = np.concatenate([np.arange(int(self.counts[i])) + self.starts[i] for i in which])
        return self.A[places], self.b[places]

    def program(self, loss: Loss, which: np.ndarray, canonical: Canonical, squares: int) -> ReducedProgram:
        """Return the reduced program with some entries of a loss unchanged, and a number of rows of squares."""
        counts = None if self.counts is None else self.counts[which]
        return ReducedProgram(canonical, squares, loss.some(which), counts)


@dataclass(eq=False)
class Newton:
    """One search for the minimum of loss(A z - b) + damping(z) + weight penalty(z) subject to constraints.

    ``small`` is the program of squares, penalty and constraints; ``jump`` the largest jump of the loss's slope, 0 where
    it is smooth; ``x`` (N,) the point of the canonical form, at first the start.
    """

    loss: Loss
    rows: Rows
    canonical: Canonical
    small: ReducedProgram
    weight: float
    damping: Damping | None
    jump: float
    x: Array
    steps: int = 0
    point: Point | None = None

    # --- the loss ----------------------------------------------------------------------------------------------------

    def _slope(self, r: Array, h: float) -> Array:
        """Return the slope (m,) of the smoothed loss by residuals."""
        if self.rows.counts is None:
            return self.loss.smooth(r, h)[0] if h else self.loss.slope(r)
        v = np.sqrt(np.add.reduceat(r * r, self.rows.starts) + h * h)
        return self.rows.by_equation(self.loss.slope(v) / np.maximum(v, 1e-300)) * r

    def _model(self, r: Array, h: float, out: np.ndarray | None = None) -> tuple[Array, Array]:
        """Return gradient and Hessian of the smoothed loss by u = T z, without the entries ``out``."""
        U = self.rows.whitened[0]
        if self.rows.counts is None:
            slope, curvature = self.loss.smooth(r, h)
            if out is not None:
                slope[out] = 0.0
                curvature[out] = 0.0
            return U.T @ slope, gram(U, curvature)
        starts = self.rows.starts
        v = np.maximum(np.sqrt(np.add.reduceat(r * r, starts) + h * h), TINY)
        slope, curvature = self.loss.smooth(v, 0.0)
        inner = np.maximum(v * v - h * h, 0.0)  # |r|^2
        across = slope / v
        along = curvature * inner / v**2 + slope * h * h / v**3
        if out is not None:
            across[out] = 0.0
            along[out] = 0.0
        across = np.maximum(across, 0.0)
        unit = r / self.rows.by_equation(np.sqrt(np.maximum(inner, 1e-300)))
        wide = self.rows.by_equation(across)
        H = gram(U, wide)
        curved = np.flatnonzero(np.abs(along - across) > 1e-9 * across.max(initial=0.0))
        if len(curved):
            turned = self.rows.combined(U, unit)[curved]
            H += (turned * (along - across)[curved, None]).T @ turned
        return U.T @ (wide * r), H

    def _residual(self, x: Array) -> Array:
        return self.rows.A @ x[self.canonical.at] - self.rows.b

    def _total(self, r: Array) -> float:
        return float(self.loss.values(self.rows.entries(r)).sum())

    def _others(self, x: Array) -> float:
        pull = 0.0 if self.damping is None else self.damping.value(x[self.canonical.at])
        return self.weight * self.canonical.value(x) + pull

    def _value(self, x: Array) -> float:
        return self._total(self._residual(x)) + self._others(x)

    def _solved(self, z: Array, gradient: Array, H: Array, small: ReducedProgram | None = None, *exact: Array) -> Point:
        """Return the minimum of the quadratic model around z (n,), with the penalty and the constraints."""
        T = self.rows.whitened[1]
        n = T.shape[1]
        ridge = PROXIMAL * np.trace(H) + np.finfo(float).tiny
        L = np.linalg.cholesky(H + ridge * np.eye(len(H)))
        R = np.vstack([np.sqrt(0.5) * L.T @ T, np.zeros((n + 1 - len(T), n))])
        squares = ReducedSquares(R, R @ z, T.T @ gradient).damped(self.damping)
        self.steps += 1
        return (small or self.small).solve(squares, self.weight, *exact)

    # --- smooth losses -----------------------------------------------------------------------------------------------

    def smooth(self, h: float = 0.0, tolerance: float = DECREASE, most: int = STEPS) -> None:
        """Go to the minimum of the loss smoothed with width h."""
        at, T, weight = self.canonical.at, self.rows.whitened[1], self.weight
        r = self._residual(self.x)
        size = max(min(abs(self._total(r)), float(len(r))), TINY)  # outliers do not loosen the tolerance
        secants, t_before = 0.0, 0.0
        for _ in range(most):
            z = self.x[at]
            gradient, H = self._model(r, h)
            pivots = np.diag(np.linalg.cholesky(H + PROXIMAL * np.trace(H) * np.eye(len(H))))
            if secants or pivots.min() < POOR * pivots.max():
                # squares with the loss's slopes at r and -r are nowhere below it
                secants = max(secants, LEAST_SECANTS) if t_before == 1.0 else 1.0
                v = np.where(np.abs(r) > TINY, r, TINY)
                secant = np.maximum((self._slope(v, h) - self._slope(-v, h)) / (2 * v), 0.0)
                H = H + secants * gram(self.rows.whitened[0], secant)
            self.point = self._solved(z, gradient, H)
            ahead = self.point.x
            d = ahead[at] - z
            chord = weight * (self.canonical.value(ahead) - self.canonical.value(self.x))
            u = T @ d
            pull, bend = (0.0, 0.0) if self.damping is None else self.damping.along(z, d)
            predicted = -(gradient @ u + 0.5 * u @ H @ u + chord + pull + 0.5 * bend)
            if self.point.iterations:  # Clarabel's accuracy
                tolerance = max(tolerance, INTERIOR)
            if predicted < -INEXACT * size and predicted < -INEXACT * abs(self._total(r)):
                raise np.linalg.LinAlgError("the subproblem was not solved to a minimum")
            if predicted <= tolerance * size:
                break
            Ad = self.rows.A @ d
            t, left = self._search(r, Ad, chord + pull, bend, h, float(gradient @ u) + chord + pull)
            if t == 0:
                break
            secants *= FEWER if t == 1.0 else 1.0
            t_before = t
            r = r + t * Ad
            self.x = self.x + t * (ahead - self.x)
            # the model's error along the step predicts the gain of the next one
            if (t == 1.0 and predicted * left**2 <= 0.01 * tolerance * size) or t * np.abs(d).max() < 1e-15:
                break

    def _search(self, r: Array, Ad: Array, chord: float, bend: float, h: float, before: float) -> tuple[float, float]:
        """Return t in (0, 1] where the derivative along the step is small, and how small: no value of it is needed."""
        if before >= 0:  # rounding: no descent direction
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

    def non_smooth(self, warm_width: float, warm: bool) -> float:
        """Go to the minimum of a non-smooth loss, and return the width of smoothing at which it was found."""
        if warm and warm_width and self._exact(warm_width):
            return warm_width
        v = np.abs(self.rows.entries(self._residual(self.x)))
        h = float(np.median(v)) / (NARROWER if warm else 1.0)
        floor = NARROWEST * max(float(np.mean(v)), TINY)
        while h > floor:
            r = self._residual(self.x)
            total, added = self._total(r), self._added(self.rows.entries(r), h)
            before, x_before = total + self._others(self.x), self.x
            size = max(abs(total), TINY)
            self.smooth(h, max(SMOOTHED * added / size, DECREASE), 30)
            if self._value(self.x) > before + 2 * added + 1e-12 * abs(before):  # more than rounding
                self.x = x_before
                return h
            if added <= 0 or self._exact(h):
                return h
            h /= NARROWER
        return h

    def _added(self, v: Array, h: float) -> float:
        """Return what smoothing with width h may add to the loss: to that of a norm everywhere."""
        if self.rows.counts is None:
            return self.jump * h * np.count_nonzero(np.abs(v) < h)
        return self.jump * float(np.sum(np.hypot(v, h) - v))

    def _near(self, v: Array, h: float) -> np.ndarray:
        """Return the entries within h of a non-smooth point."""
        if self.rows.counts is None:
            rise = self.loss.slope(v + h) - self.loss.slope(v - h)
            return np.flatnonzero(rise > 0.1 * self.jump)
        rise = self.loss.slope(v + h) - self.loss.slope(np.maximum(v - h, -1e-12))
        return np.flatnonzero((rise > 0.1 * self.jump) | (v < h))

    def _exact(self, h: float) -> bool:
        """Go to the minimum with rows near a non-smooth point as they are and the others by their quadratic model.

        Return whether that is the minimum; otherwise the point stays.
        """
        at, T = self.canonical.at, self.rows.whitened[1]
        x, best = self.x, self.point
        near = self._near(self.rows.entries(self._residual(x)), 3 * h)
        few = max(NEAR * self.rows.A.shape[1], 200)
        if len(near) > few:
            return False
        value = self._value(x)
        for _ in range(8):
            if len(near) > 2 * few:
                return False
            r = self._residual(x)
            gradient, H = self._model(r, 0.0, near)
            small = self.small
            exact: tuple[Array, ...] = ()
            if len(near):
                small = self.rows.program(self.loss, near, self.canonical, small.rows)
                exact = self.rows.equations(near)
            try:
                point = self._solved(x[at], gradient, H, small, *exact)
            except (Unsolved, np.linalg.LinAlgError):
                return False
            v, v_ahead = self.rows.entries(r), self.rows.entries(self._residual(point.x))
            old, new = self.loss.values(v)[near].sum(), self.loss.values(v_ahead)[near].sum()
            u = T @ (point.x - x)[at]
            chord = self._others(point.x) - self._others(x)
            predicted = -(gradient @ u + 0.5 * u @ H @ u + chord + new - old)
            there = self._value(point.x)
            if there <= value:
                value, x, best = there, point.x, point
            if predicted <= 1e-9 * max(abs(value), 1e-9):
                self.x, self.point = x, best
                return True
            curved = np.abs(self.loss.slope(v_ahead) - self.loss.slope(v)) > 0.1 * self.jump
            beside = self._near(self.rows.entries(self._residual(x)), h)
            near = np.union1d(near, np.union1d(np.flatnonzero(curved), beside))
        return False


def gram(A: Array, weights: Array) -> Array:
    """Return A' diag(weights) A of A (m, n)."""
    rows = np.sqrt(weights)[:, None] * A
    return rows.T @ rows


# --- sums over entries, read from CVXPY's expression tree ---


class Loss:
    """A loss f(v) that is not quadratic, of residuals v (M,), or if ``positive`` of configurations' norms.

    If ``separable``, f(v) = sum_i f_i(v_i); otherwise, if ``entries`` is known, the sum of that many ``largest``
    f_i(v_i): one for minimax, k for a CVaR.
    """

    def __init__(self, expression: Any, variable: Any, positive: bool):
        self.expression, self.variable, self.positive = expression, variable, positive
        self.entries: Any = None
        self.largest = 0.0
        if {v.id for v in expression.variables()} == {variable.id}:
            self.entries = _entries(expression, variable, SUMS)
            if self.entries is None:
                self.largest = _count(expression, variable)
                self.entries = _entries(expression, variable, LARGEST)

    @property
    def separable(self) -> bool:
        """Whether the loss is a sum over entries."""
        return self.entries is not None and not self.largest

    @cached_property
    def canonical(self) -> Canonical:
        """The loss in canonical form."""
        return Canonical(self.expression, [], self.variable)

    @cached_property
    def _evaluated(self) -> Evaluation:
        return evaluation(self.entries, self.variable)

    def values(self, v: Array) -> Array:
        """Return f_i(v_i) (M,), up to a constant."""
        return self._evaluated(v)[0] * np.ones(len(v))

    def slope(self, v: Array) -> Array:
        """Return f_i'(v_i) (M,)."""
        return self._evaluated(v)[1] * np.ones(len(v))

    def smooth(self, v: Array, width: float) -> tuple[Array, Array]:
        """Return slope and curvature (M,): of f, or of its mean over [v - width, v + width] (convolution smoothing)."""
        if width:
            (above, high), (below, low) = self._evaluated(v + width), self._evaluated(v - width)
            slope = np.where(high == low, high, (above - below) / (2 * width))  # no cancellation away from kinks
            return slope, np.maximum((high - low) / (2 * width), 0.0) * np.ones(len(v))
        apart = 1e-5 * v if self.positive else 1e-6 * (1 + np.abs(v))
        high, low = self.slope(v + apart), self.slope(v - apart)
        return self.slope(v), np.maximum((high - low) / (2 * apart), 0.0)

    def some(self, which: np.ndarray) -> Canonical:
        """Return the sum of some entries (k,), or of the largest of them, in canonical form."""
        own = cp.Variable(len(which))
        entries = _restricted(self.entries, self.variable, own, which)
        return Canonical(cp.sum_largest(entries, self.largest) if self.largest else cp.sum(entries), [], own)

    def total(self, values: Array) -> float:
        """Return the sum of the largest f_i(v_i) of some (k,)."""
        return float(np.asarray(cp.sum_largest(values, self.largest).value))

    def slope_jump(self, rows: Rows) -> float:
        """Return the largest jump of the slope by residuals of usual size, or where norms are zero; 0 for none."""
        size = float(np.sqrt(np.mean(rows.entries(rows.b) ** 2))) or 1.0
        which = np.unique(np.linspace(0, self.variable.size - 1, PROBES).astype(int))
        own = cp.Variable(len(which))
        evaluated = evaluation(_restricted(self.entries, self.variable, own, which), own)

        def slope(v: Array) -> Array:
            return evaluated(v)[1] * np.ones(len(v))

        low = np.full(len(which), 1e-9 * size if self.positive else -5.03 * size)
        high = np.full(len(which), 5.0 * size)
        slope_low, slope_high = slope(low), slope(high)
        total = slope_high - slope_low
        for _ in range(45):  # by bisection
            middle = (low + high) / 2
            at = slope(middle)
            left = at - slope_low > slope_high - at
            high, slope_high = np.where(left, middle, high), np.where(left, at, slope_high)
            low, slope_low = np.where(left, low, middle), np.where(left, slope_low, at)
        jump = slope_high - slope_low
        kink = float(jump.max()) if (jump > JUMP * total).any() else 0.0
        if self.positive:  # f(|r|) is not smooth at zero if f has a slope there
            at_zero, far = (float(self.slope(np.full(self.variable.size, at)).max()) for at in (1e-12 * size, size))
            kink = max(kink, at_zero) if at_zero > 1e-3 * far else kink
        return kink


# --- the expression tree -----------------------------------------------------------------------------------------


SUMS: dict[str, Any] = {"Sum": lambda a: a, "norm1": Atom("abs"), "quad_over_lin": Atom("square")}
LARGEST: dict[str, Any] = {"max": lambda a: a, "sum_largest": lambda a: a, "norm_inf": Atom("abs")}


def _entries(e: Any, v: Any, atoms: dict[str, Any]) -> Any:
    """Return the entrywise expression (M,) of a scalar that sums all or the largest entries, or None.

    ``atoms`` are SUMS or LARGEST; terms that do not depend on v are dropped.
    """
    name = type(e).__name__
    if e.size != 1 or not has(e, v):
        return None
    if name in atoms:
        entries = atoms[name](e.args[0])
        if name == "quad_over_lin" and e.args[1].is_constant():
            entries = entries / e.args[1]
        return _checked(entries, v)
    parts = [_entries(a, v, atoms) if has(a, v) else a for a in e.args]
    if name == "MulExpression" and parts[0] is e.args[0] and v.shape == e.args[1].shape and atoms is SUMS:
        return _checked(cp.multiply(cp.reshape(e.args[0], v.shape, order="C"), e.args[1]), v)  # weights @ entries
    if any(part is None for part in parts):
        return None
    changed = [part for part, a in zip(parts, e.args, strict=True) if part is not a]
    if name == "AddExpression" and (atoms is SUMS or len(changed) == 1):
        return sum(changed)
    if name in ("multiply", "MulExpression"):
        return cp.multiply(*parts)
    if name in ("NegExpression", "DivExpression"):
        return e.copy(parts)
    if name == "reshape":
        return parts[0]
    return None


def _count(e: Any, v: Any) -> float:
    """Return how many of the largest entries a scalar expression sums."""
    for a in e.args:
        if a.size == 1 and has(a, v):
            return _count(a, v)
    return float(getattr(e, "k", 1.0))


def _checked(entries: Any, v: Any) -> Any:
    return entries if entries.shape == v.shape and entrywise(entries, v) else None


def entrywise(e: Any, v: Any) -> bool:
    """Return whether entry i of an expression depends on v_i alone."""
    from cvxpy.atoms.elementwise.elementwise import Elementwise

    if e is v or not has(e, v):
        return True
    if e.shape != v.shape:
        return False
    if is_norm(e):
        return all(a.shape == v.shape and entrywise(a, v) for a in e.args[0].args)
    known = isinstance(e, Elementwise) or type(e).__name__ in (*SCALED, "NegExpression")
    return known and all((a.shape == v.shape or a.size == 1) and entrywise(a, v) for a in e.args)


def _restricted(e: Any, v: Any, own: Any, which: np.ndarray) -> Any:
    """Return the entries (k,) of an entrywise expression, as an expression of their own variable (k,)."""
    if e is v:
        return own
    if not e.variables():
        if e.size == v.size and e.size > 1:
            return cp.Constant(np.ravel(e.value)[which])
        return cp.Constant(np.squeeze(e.value) if e.size == 1 else e.value)
    if type(e).__name__ in ("Promote", "reshape"):
        return _restricted(e.args[0], v, own, which)
    if is_norm(e):
        rows = [_restricted(a, v, own, which) + np.zeros(own.size) for a in e.args[0].args]
        return cp.norm(cp.vstack(rows), 2, axis=0)
    return e.copy([_restricted(a, v, own, which) for a in e.args])
