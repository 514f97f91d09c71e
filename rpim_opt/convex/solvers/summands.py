"""A loss that is a sum over entries, read from CVXPY's expression tree: its values, slopes, curvatures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array

JUMP = 1e-3
"""Part of the slope's total variation above which a jump counts as a kink."""
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
        self.variable, self.positive = variable, positive
        self.entries: Any = None
        if {v.id for v in expression.variables()} == {variable.id}:
            self.entries = _summands(expression, variable)

    @property
    def separable(self) -> bool:
        """Whether the loss is a sum over entries."""
        return self.entries is not None

    @cached_property
    def uniform(self) -> bool:
        """Whether all entries have the same function."""
        return all(constant.size == 1 for constant in self.entries.constants())

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

    def some(self, which: np.ndarray) -> tuple[Any, Any]:
        """Return the sum of some entries, and the variable (k,) of their own that it is an expression of."""
        import cvxpy as cp

        entries, own = self._alone(which)
        return cp.sum(entries), own

    def _alone(self, which: np.ndarray) -> tuple[Any, Any]:
        """Return some of the entries (k,) as an expression of a variable of their own, and that variable."""
        import cvxpy as cp

        own = cp.Variable(len(which))
        return _restricted(self.entries, self.variable, own, which), own

    def jump(self, size: float) -> float:
        """Return the largest jump of the slope within 5 ``size`` of zero, 0 where f is smooth; by bisection."""
        which = np.unique(np.linspace(0, self.variable.size - 1, PROBES).astype(int))
        evaluated = evaluation(*self._alone(which))

        def slope(v: Array) -> Array:
            return evaluated(v)[1] * np.ones(len(v))

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


# --- the expression tree -----------------------------------------------------------------------------------------


def _summands(e: Any, v: Any) -> Any:
    """Return the entrywise expression (M,) whose sum a scalar expression is, up to a constant; None for another one."""
    import cvxpy as cp

    name = type(e).__name__
    if e.size != 1 or v.id not in {each.id for each in e.variables()}:
        return None
    if name in ("Sum", "norm1", "quad_over_lin"):
        entries = {"Sum": lambda a: a, "norm1": cp.abs, "quad_over_lin": cp.square}[name](e.args[0])
        if name == "quad_over_lin" and e.args[1].is_constant():
            entries = entries / e.args[1]
        return _checked(entries, v)
    parts = [a if a.is_constant() else _summands(a, v) for a in e.args]
    if name == "MulExpression" and parts[0] is e.args[0] and v.shape == e.args[1].shape:  # weights @ entries
        return _checked(cp.multiply(cp.reshape(e.args[0], v.shape, order="C"), e.args[1]), v)
    if any(part is None for part in parts):
        return None
    if name == "AddExpression":
        return sum(part for part, a in zip(parts, e.args, strict=True) if part is not a)
    if name in ("multiply", "MulExpression"):
        return cp.multiply(*parts)
    if name in ("NegExpression", "DivExpression"):
        return e.copy(parts)
    if name == "reshape":
        return parts[0]
    return None


def _checked(entries: Any, v: Any) -> Any:
    return entries if entries.shape == v.shape and entrywise(entries, v) else None


def entrywise(e: Any, v: Any) -> bool:
    """Return whether entry i of an expression depends on v_i alone."""
    from cvxpy.atoms.elementwise.elementwise import Elementwise

    if e is v or not e.variables():
        return True
    if e.shape != v.shape:
        return False
    if _is_norm(e):
        return all(a.shape == v.shape and entrywise(a, v) for a in e.args[0].args)
    known = isinstance(e, Elementwise) or type(e).__name__ in AFFINE
    return known and all((a.shape == v.shape or a.size == 1) and entrywise(a, v) for a in e.args)


def _is_norm(e: Any) -> bool:
    """Whether an expression is the 2-norm, entry by entry, of several vectors (pseudo-Huber: of v and a constant)."""
    named = type(e).__name__.startswith("Pnorm") and type(e.args[0]).__name__ == "Vstack"
    return named and float(e.p) == 2 and e.axis == 0


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
        rows = [_restricted(a, v, own, which) + np.zeros(own.size) for a in e.args[0].args]
        return cp.norm(cp.vstack(rows), 2, axis=0)
    return e.copy([_restricted(a, v, own, which) for a in e.args])


# --- values and slopes -------------------------------------------------------------------------------------------

Evaluation = Callable[[Array], tuple[Any, Any]]
"""Value and derivative of every entry at numbers v (M,)."""


def evaluation(e: Any, v: Any) -> Evaluation:
    """Return how an entrywise expression is evaluated, by forward differentiation; its function raises OutsideDomain.

    Parameters
    ----------
    e, v
        An expression that is `entrywise` in a variable.
    """
    if e is v:
        return lambda x: (x, 1.0)
    if not e.variables():
        number = np.ravel(e.value) if e.size > 1 else np.squeeze(e.value)
        return lambda x: (number, 0.0)
    norm = _is_norm(e)
    inner = [evaluation(a, v) for a in (e.args[0].args if norm else e.args)]
    name = "norm" if norm else type(e).__name__
    affine, atom = AFFINE.get(name), ATOMS.get(name)

    def evaluated(x: Array) -> tuple[Any, Any]:
        values, slopes = zip(*(part(x) for part in inner), strict=True)
        if affine is not None:
            return affine(values, slopes)
        with np.errstate(all="ignore"):
            value, parts = atom(e, values) if atom else _by_cvxpy(e, values)
        return value, sum(part * slope for part, slope in zip(parts, slopes, strict=True) if np.any(slope))

    return evaluated


def _by_cvxpy(e: Any, values: Sequence[Any]) -> tuple[Any, list[Any]]:
    """Return value and partial derivatives of an atom, by CVXPY's sparse Jacobians."""
    shape = np.broadcast_shapes(*(np.shape(value) for value in values))
    full = [np.broadcast_to(np.asarray(value, dtype=float), shape) for value in values]
    value, parts = e.numeric(full), e._grad(full)
    if any(part is None for part in parts):
        raise OutsideDomain
    return value, [part.diagonal() for part in parts]


def _product(values: Sequence[Any], slopes: Sequence[Any]) -> tuple[Any, Any]:
    return values[0] * values[1], slopes[0] * values[1] + slopes[1] * values[0]


AFFINE: dict[str, Callable[[Any, Any], tuple[Any, Any]]] = {
    "AddExpression": lambda values, slopes: (sum(values), sum(slopes)),
    "NegExpression": lambda values, slopes: (-values[0], -slopes[0]),
    "Promote": lambda values, slopes: (values[0], slopes[0]),
    "reshape": lambda values, slopes: (values[0], slopes[0]),
    "DivExpression": lambda values, slopes: (values[0] / values[1], slopes[0] / values[1]),
    "multiply": _product,
    "MulExpression": _product,
}
"""Affine expressions: value and derivative, from those of what they are made of."""


def _huber(e: Any, v: Sequence[Array]) -> tuple[Array, list[Array]]:
    bound = float(e.M.value)
    cut = np.clip(v[0], -bound, bound)
    return cut * (2 * v[0] - cut), [2 * cut]


def _maximum(_: Any, v: Sequence[Any]) -> tuple[Array, list[Array]]:
    v = np.broadcast_arrays(*v)
    first = np.argmax(v, axis=0)
    return np.maximum.reduce(v), [(first == i).astype(float) for i in range(len(v))]


def _norm(_: Any, v: Sequence[Any]) -> tuple[Any, list[Any]]:
    length = np.sqrt(sum(np.square(each) for each in v))
    return length, [each / np.maximum(length, 1e-300) for each in v]


ATOMS: dict[str, Callable[[Any, Any], tuple[Any, list[Any]]]] = {
    "huber": _huber,
    "abs": lambda _, v: (np.abs(v[0]), [np.sign(v[0])]),
    "maximum": _maximum,
    "logistic": lambda _, v: (np.logaddexp(0.0, v[0]), [1.0 / (1.0 + np.exp(-v[0]))]),
    "exp": lambda _, v: (np.exp(v[0]), [np.exp(v[0])]),
    "norm": _norm,
}
"""Atoms that losses are mostly made of: value and partial derivatives. CVXPY evaluates any other."""
