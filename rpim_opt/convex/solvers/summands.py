"""A loss that is a sum over entries, read from CVXPY's expression tree: its values, slopes, curvatures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array

JUMP = 1e-3
"""Part of the slope's total variation above which a jump counts as a kink."""


AFFINE = ("AddExpression", "NegExpression", "multiply", "MulExpression", "DivExpression", "Promote", "reshape")
PROBES = 64
"""Entries at which kinks are looked for."""


class OutsideDomain(Exception):
    """Raised where the loss has no derivative."""


class Summands:
    """f(v) = sum_i f_i(v_i) of v (M,): residuals, or nonnegative norms of configurations.

    Parameters
    ----------
    expression
        Convex scalar expression of CVXPY of the variable alone.
    variable
        v (M,).
    positive
        Whether v are norms.
    """

    def __init__(self, expression: Any, variable: Any, positive: bool):
        self.expression, self.variable, self.positive = expression, variable, positive
        entries = None
        if {v.id for v in expression.variables()} == {variable.id}:
            entries = _summands(expression, variable)
        self.entries = entries
        self._several: dict[int, tuple[Any, Any]] = {}

    @property
    def separable(self) -> bool:
        """Whether the loss is a sum over entries."""
        return self.entries is not None

    def values(self, v: Array) -> Array:
        """Return f_i(v_i) (M,), up to a constant."""
        return self._derivatives(v)[0]

    def slope(self, v: Array) -> Array:
        """Return f_i'(v_i) (M,)."""
        return self._derivatives(v)[1]

    def _derivatives(self, v: Array) -> tuple[Array, Array]:
        self.variable.save_value(v)
        value, slope = derivative(self.entries, self.variable)
        return value * np.ones(len(v)), slope * np.ones(len(v))

    def _slopes(self, *points: Array) -> list[Array]:
        """Return the slopes at several points, by one evaluation of the atoms."""
        count = self.variable.size
        made = self._several.get(len(points))
        if made is None:
            made = self._several[len(points)] = _alone(
                self.entries, self.variable, np.tile(np.arange(count), len(points))
            )
        entries, some = made
        some.save_value(np.concatenate(points))
        return np.split(derivative(entries, some)[1] * np.ones(some.size), len(points))

    def smooth(self, v: Array, width: float) -> tuple[Array, Array]:
        """Return slope and curvature (M,): of f, or of its mean over [v - width, v + width] (convolution smoothing)."""
        if width:
            high, low = self._slopes(v + width, v - width)
            rise = (self.values(v + width) - self.values(v - width)) / (2 * width)
            slope = np.where(high == low, high, rise)  # no cancellation away from kinks
            return slope, np.maximum((high - low) / (2 * width), 0.0)
        apart = 1e-5 * v if self.positive else 1e-6 * (1 + np.abs(v))
        slope, high, low = self._slopes(v, v + apart, v - apart)
        return slope, np.maximum((high - low) / (2 * apart), 0.0)

    def some(self, which: np.ndarray) -> tuple[Any, Any]:
        """Return the sum of some entries, and the variable (k,) of their own that it is an expression of."""
        import cvxpy as cp

        entries, own = _alone(self.entries, self.variable, which)
        return cp.sum(entries), own

    def jump(self, size: float) -> float:
        """Return the largest jump of the slope within 5 ``size`` of zero, 0 where f is smooth; by bisection."""
        which = np.unique(np.linspace(0, self.variable.size - 1, PROBES).astype(int))
        entries, own = _alone(self.entries, self.variable, which)

        def slope(v: Array) -> Array:
            own.save_value(v)
            return derivative(entries, own)[1] * np.ones(len(v))

        low = np.full(len(which), 1e-9 * size if self.positive else -5.03 * size)
        high = np.full(len(which), 5.0 * size)
        slope_low, slope_high = slope(low), slope(high)
        total = slope_high - slope_low
        for _ in range(45):
            middle = (low + high) / 2
            at = slope(middle)
            left = at - slope_low > slope_high - at
            high, slope_high = np.where(left, middle, high), np.where(left, at, slope_high)
            low, slope_low = np.where(left, low, middle), np.where(left, slope_low, at)
        jump = slope_high - slope_low
        if (jump > JUMP * total).any():
            return float(jump.max())
        return 0.0


def _alone(entries: Any, variable: Any, which: np.ndarray) -> tuple[Any, Any]:
    """Return some of the entries (k,) as an expression of a variable of their own, and that variable."""
    import cvxpy as cp

    own = cp.Variable(len(which))
    return _restricted(entries, variable, own, which), own


def _summands(e: Any, v: Any) -> Any:
    """Return the entrywise expression (M,) whose sum a scalar expression is, up to a constant; None for another one."""
    import cvxpy as cp

    name = type(e).__name__
    if v.id not in {each.id for each in e.variables()}:
        return None
    if name == "reshape" and e.size == 1:
        return _summands(e.args[0], v)
    if name in ("Sum", "norm1", "quad_over_lin") and e.args[0].size == v.size:
        return _reduction(e, name, v)
    if name == "AddExpression":
        parts = [_summands(a, v) if a.variables() else 0 for a in e.args]
        if any(part is None for part in parts):
            return None
        return sum(parts[1:], parts[0])
    if name == "NegExpression":
        inner = _summands(e.args[0], v)
        return None if inner is None else -inner
    if name in ("multiply", "MulExpression", "DivExpression"):
        first, second = e.args
        if name == "MulExpression" and first.is_constant() and first.size == v.size > 1 and second.shape == v.shape:
            if not entrywise(second, v):
                return None
            return cp.multiply(np.ravel(first.value), second)  # weights @ entries
        if name == "DivExpression":
            inner, factor = _summands(first, v), 1.0 / second.value if second.is_constant() else None
        else:
            constant, other = (first, second) if first.is_constant() else (second, first)
            inner = _summands(other, v)
            factor = constant.value if constant.is_constant() and constant.size == 1 else None
        if inner is None or factor is None:
            return None
        return float(np.squeeze(factor)) * inner
    return None


def _reduction(e: Any, name: str, v: Any) -> Any:
    """Return the entries that a sum, a 1-norm or a sum of squares adds up; None where they are not of v_i alone."""
    import cvxpy as cp

    inner = e.args[0]
    if e.shape != () and e.size != 1:
        return None
    if inner.shape != v.shape or not entrywise(inner, v):
        return None
    if name == "norm1":
        return cp.abs(inner)
    if name == "quad_over_lin":
        if not e.args[1].is_constant():
            return None
        return cp.square(inner) / float(np.squeeze(e.args[1].value))
    return inner


def entrywise(e: Any, v: Any) -> bool:
    """Return whether entry i of an expression depends on v_i alone."""
    if e is v or not e.variables():
        return True
    if _is_norm(e):
        return e.shape == v.shape and all(a.shape == v.shape and entrywise(a, v) for a in _rows_of_norm(e))
    from cvxpy.atoms.elementwise.elementwise import Elementwise

    if not (isinstance(e, Elementwise) or type(e).__name__ in AFFINE) or e.shape != v.shape:
        return False
    return all((a.shape == v.shape or a.size == 1) and entrywise(a, v) for a in e.args)


def _is_norm(e: Any) -> bool:
    """Whether an expression is the 2-norm, entry by entry, of several vectors (pseudo-Huber: of v and a constant)."""
    return (
        type(e).__name__.startswith("Pnorm")
        and float(e.p) == 2
        and e.axis == 0
        and type(e.args[0]).__name__ == "Vstack"
    )


def _rows_of_norm(e: Any) -> Sequence[Any]:
    return e.args[0].args


def derivative(e: Any, v: Any) -> tuple[Any, Any]:
    """Return value and derivative of every entry, by forward differentiation with CVXPY's own atoms.

    Raises
    ------
    OutsideDomain
        Where an atom has none.
    """
    if e is v:
        return v.value, 1.0
    if not e.variables():
        value = e.value
        return np.ravel(value) if np.size(value) > 1 else value, 0.0
    if _is_norm(e):
        values, slopes = zip(*(derivative(a, v) for a in _rows_of_norm(e)), strict=True)
        length = np.sqrt(sum(np.square(value) for value in values))
        along = sum(value * slope for value, slope in zip(values, slopes, strict=True))
        return length, along / np.maximum(length, 1e-300)
    from cvxpy.atoms.elementwise.elementwise import Elementwise

    values, slopes = zip(*(derivative(a, v) for a in e.args), strict=True)
    name = type(e).__name__
    if isinstance(e, Elementwise):
        return _of_atom(e, values, slopes)
    if name == "AddExpression":
        return sum(values[1:], values[0]), sum(slopes[1:], slopes[0])
    if name == "NegExpression":
        return -values[0], -slopes[0]
    if name in ("Promote", "reshape"):
        return values[0], slopes[0]
    if name == "DivExpression":
        return values[0] / values[1], slopes[0] / values[1]
    return values[0] * values[1], slopes[0] * values[1] + slopes[1] * values[0]


def _of_atom(e: Any, values: Sequence[Any], slopes: Sequence[Any]) -> tuple[Any, Any]:
    """Return value and derivative of an elementwise atom of arguments whose values and derivatives are known."""
    shape = np.broadcast_shapes(*(np.shape(value) for value in values))
    full = [np.broadcast_to(np.asarray(value, dtype=float), shape) for value in values]
    known = _KNOWN.get(type(e).__name__)
    if known is not None and len(full) == 1:
        with np.errstate(all="ignore"):
            value, by = known(e, full[0])
        return value, by * slopes[0]
    with np.errstate(all="ignore"):
        value = e.numeric(full)
        parts = e._grad(full)
    if any(part is None for part in parts):
        raise OutsideDomain
    return value, sum(part.diagonal() * slope for part, slope in zip(parts, slopes, strict=True) if np.any(slope))


def _huber(e: Any, v: Array) -> tuple[Array, Array]:
    bound = float(e.M.value)
    cut = np.clip(v, -bound, bound)
    return cut * (2 * v - cut), 2 * cut


_KNOWN: dict[str, Callable[[Any, Array], tuple[Array, Array]]] = {
    "huber": _huber,
    "abs": lambda _, v: (np.abs(v), np.sign(v)),
}
"""Atoms that losses are mostly made of, evaluated without CVXPY's sparse Jacobians."""


def _restricted(e: Any, v: Any, own: Any, which: np.ndarray) -> Any:
    """Return the entries (k,) of an entrywise expression, as an expression of their own variable (k,)."""
    import cvxpy as cp

    if e is v:
        return own
    if not e.variables():
        if e.size == v.size and e.size > 1:
            return cp.Constant(np.ravel(e.value)[which])
        return cp.Constant(np.squeeze(e.value) if e.size == 1 else e.value)
    if type(e).__name__ in ("Promote", "reshape"):
        return _restricted(e.args[0], v, own, which)
    if _is_norm(e):
        return cp.norm(
            cp.vstack([_restricted(a, v, own, which) + np.zeros(own.size) for a in _rows_of_norm(e)]), 2, axis=0
        )
    return e.copy([_restricted(a, v, own, which) for a in e.args])
