"""What CVXPY's tree says of a loss: whether it is a sum over rows, and of which functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.late import Late
from rpim_opt.convex.atoms import cp
from rpim_opt.convex.rows import LINE, SQUARE, Affine, Curve, Kink, Piece, Rows, Topmost, huber, power, root
from rpim_opt.convex.terms import Term, apart

elementwise: Any = Late("cvxpy.atoms.elementwise.elementwise")

APART = 1e-5
"""How far from a number, relative to it, the slopes are whose difference is the curvature there."""


def rows_of(expression: Any, variable: cp.Variable) -> Rows | None:
    """Return the sum over the components of a variable (m,) that a convex expression is; None where it is none.

    It is one if CVXPY's tree says so: sums, nonnegative multiples and 1-norms of functions that act on every component
    alone. Atoms with formulas are huber, abs, squares and even powers, the larger one of two lines, norms of
    ``vstack`` (pseudo-Huber); of other elementwise ones CVXPY is asked for value and slope.
    """
    found = _Reading(variable).scalar(expression, 1.0)
    if found is None:
        return None
    constant = 0.0
    pieces: list[Piece] = []
    kinks: list[Kink] = []
    for part in found:
        if isinstance(part, Kink):
            kinks.append(part)
        elif isinstance(part, Piece):
            pieces.append(part)
        else:
            constant += part
    return Rows(tuple(pieces), tuple(kinks), constant)


def largest_of(expression: Any, variable: cp.Variable) -> Topmost | None:
    """Return the largest over the components of a variable (m,) that a convex expression is; None where it is none.

    CVXPY's tree has to be a ``max`` of lines of every component or of their absolute values (`cp.norm_inf`), times
    numbers and plus numbers.

    >>> import cvxpy as cp
    >>> from rpim_opt.convex.tree import largest_of
    >>> r = cp.Variable(3)
    >>> largest_of(2 * cp.norm(r, "inf") + 1, r)
    Topmost(factor=2.0, of=Affine(a=1.0, c=0.0), absolute=True, constant=1.0)
    >>> largest_of(cp.max(r) + cp.sum(cp.huber(r)), r) is None
    True
    """
    reading = _Reading(variable)
    constant, factor = 0.0, 1.0
    e = expression
    while type(e).__name__ not in ("max", "norm_inf"):
        inner = _unwrapped(e)
        if inner is None:
            return None
        times, plus, e = inner
        constant += factor * plus
        factor *= times
    of = e.args[0]
    absolute = type(e).__name__ == "norm_inf"
    if type(of).__name__ == "abs":
        absolute = True
        of = of.args[0]
    line = reading.affine(of)
    if line is None or e.shape != () or factor <= 0:
        return None
    return Topmost(factor, line, absolute, constant)


def _unwrapped(e: Any) -> tuple[float, float, Any] | None:
    """Return times, plus and the expression inside of: times (expression) + plus; None for other ones."""
    kind = type(e).__name__
    if kind == "reshape":
        return 1.0, 0.0, e.args[0]
    if kind == "AddExpression":
        inner = [arg for arg in e.args if not arg.is_constant()]
        plus = sum(float(arg.value) for arg in e.args if arg.is_constant())
        if len(inner) == 1:
            return 1.0, plus, inner[0]
        return None
    multiple = _multiple(e)
    if multiple is None or np.size(multiple[0]) != 1:
        return None
    return float(multiple[0]), 0.0, multiple[1]


Parts = list[Any]
"""Pieces, kinks and numbers."""


class _Reading:
    """Reads expressions of one variable."""

    def __init__(self, variable: cp.Variable):
        self.variable = variable
        self.shape = variable.shape

    def scalar(self, e: Any, factor: float) -> Parts | None:
        """Return what a scalar expression sums, times a factor."""
        kind = type(e).__name__
        if e.is_constant():
            return [factor * float(e.value)]
        if kind == "reshape":
            return self.scalar(e.args[0], factor)
        if kind == "AddExpression":
            return _joined([self.scalar(arg, factor) for arg in e.args])
        if kind == "NegExpression":
            return self.scalar(e.args[0], -factor)
        multiple = _multiple(e)
        if multiple is not None and np.size(multiple[0]) == 1:
            return self.scalar(multiple[1], factor * float(multiple[0]))
        return self._summed(e, kind, factor)

    def _summed(self, e: Any, kind: str, factor: float) -> Parts | None:
        inner = e.args[0]
        if kind == "Sum" and e.shape == ():
            return self.each(inner, factor)
        of = self.affine(inner)
        if of is None or e.shape != ():
            return None
        if kind == "norm1":
            return [Kink(factor, of)]
        if kind == "quad_over_lin" and e.args[1].is_constant():
            return [Piece(SQUARE, factor / float(e.args[1].value), of)]
        return None

    def each(self, e: Any, factor: Any) -> Parts | None:
        """Return what the components of an expression (m,) are, times a factor."""
        if e.shape != self.shape:
            return self._root(e, factor)
        of = self.affine(e)
        if of is not None:
            return [Piece(LINE, factor, of)]
        kind = type(e).__name__
        if kind == "AddExpression":
            return _joined([self.each(arg, factor) for arg in e.args])
        if kind == "NegExpression":
            return self.each(e.args[0], -factor)
        multiple = _multiple(e)
        if multiple is not None:
            return self.each(multiple[1], factor * multiple[0])
        return self._atom(e, kind, factor) or self._root(e, factor) or self._other(e, factor)

    def _atom(self, e: Any, kind: str, factor: Any) -> Parts | None:
        """Return an atom that has a formula."""
        lines = [self.affine(arg) for arg in e.args]
        if not lines or any(line is None for line in lines):
            return None
        of: Any = lines[0]
        if kind == "abs":
            return [Kink(factor, of)]
        if kind == "huber":
            return [Piece(huber(float(e.M.value)), factor, of)]
        if kind.startswith("Power") and _even(e.p.value):
            return [Piece(power(int(e.p.value)), factor, of)]
        if kind == "maximum" and len(lines) == 2:  # the mean of two lines, and half their distance
            (a, c), (A, C) = lines[0], lines[1]  # type: ignore[misc]
            mean = Affine((a + A) / 2, (c + C) / 2)
            return [Piece(LINE, factor, mean), Kink(factor / 2, Affine(a - A, c - C))]
        return None

    def _root(self, e: Any, factor: Any) -> Parts | None:
        """Return Euclidean norms of columns, each of which holds one component."""
        kind = type(e).__name__
        norm = kind.startswith("Pnorm") and e.p == 2 and e.axis == 0 and not e.keepdims
        if not norm or type(e.args[0]).__name__ != "Vstack":
            return None
        parts = [self.affine(arg) for arg in e.args[0].args]
        if e.shape != self.shape or any(part is None for part in parts):
            return None
        return self._norm([part for part in parts if part is not None], factor)

    def _norm(self, parts: list[Affine], factor: Any) -> Parts | None:
        slope = sum(a**2 for a, _ in parts)
        nearest = -sum(a * c for a, c in parts) / slope  # the least norm is there
        if not np.all(sum((a * nearest + c) ** 2 for a, c in parts) > 0):
            return None
        return [Piece(root(parts), factor, Affine(1.0, 0.0))]

    def _other(self, e: Any, factor: Any) -> Parts | None:
        """Return an elementwise atom that CVXPY evaluates."""
        if not self._elementwise(e):
            return None
        whole = apart(cp.sum(e), self.variable)
        own = cp.Variable(self.shape)
        single = e.tree_copy({id(self.variable): own})

        def each(x: Array) -> Array:
            if not np.isfinite(whole(x)):
                return np.full_like(x, np.inf)
            own.save_value(x)
            return np.asarray(single.value, dtype=float)

        return [Piece(_asked(whole, each), factor, Affine(1.0, 0.0))]

    def _elementwise(self, e: Any) -> bool:
        if e.is_constant():
            return e.shape in ((), (1,), self.shape)
        if e is self.variable:
            return True
        acts = isinstance(e, elementwise.Elementwise) or type(e).__name__ in ("AddExpression", "NegExpression")
        if e.shape != self.shape or not (acts or _multiple(e) is not None):
            return False
        return all(self._elementwise(arg) for arg in e.args)

    def affine(self, e: Any) -> Affine | None:
        """Return a v + c, where an expression is that of every component v."""
        if e is self.variable:
            return Affine(1.0, 0.0)
        if e.is_constant():
            return self._constant(e)
        if e.shape != self.shape:
            return None
        kind = type(e).__name__
        if kind == "AddExpression":
            terms = [(1.0, arg) for arg in e.args]
        elif kind == "NegExpression":
            terms = [(-1.0, e.args[0])]
        else:
            multiple = _multiple(e)
            if multiple is None:
                return None
            terms = [multiple]
        return self._combined(terms)

    def _combined(self, terms: list[tuple[Any, Any]]) -> Affine | None:
        """Return the sum of factors times expressions."""
        a: Any = 0.0
        c: Any = 0.0
        for factor, expression in terms:
            of = self.affine(expression)
            if of is None:
                return None
            a = a + factor * of.a
            c = c + factor * of.c
        return Affine(a, c)

    def _constant(self, e: Any) -> Affine | None:
        value = np.asarray(e.value, dtype=float)
        if value.size == 1:
            return Affine(0.0, float(value.reshape(-1)[0]))
        if value.shape != self.shape:
            return None
        return Affine(0.0, value)


def _joined(parts: list[Parts | None]) -> Parts | None:
    if any(part is None for part in parts):
        return None
    return [each for part in parts if part is not None for each in part]


def _multiple(e: Any) -> tuple[Any, Any] | None:
    """Return the constant and the expression that are multiplied, component by component."""
    kind = type(e).__name__
    if kind == "DivExpression" and e.args[1].is_constant():
        return 1 / _number(e.args[1]), e.args[0]
    if kind == "multiply":
        for constant, other in (e.args, e.args[::-1]):
            if constant.is_constant():
                return _number(constant), other
    return None


def _number(e: Any) -> Any:
    value = np.asarray(e.value, dtype=float)
    if value.size == 1 or (value.ndim == 1 and np.ptp(value) == 0):
        return float(value.reshape(-1)[0])
    return value


def _even(p: Any) -> bool:
    return float(p) >= 2 and float(p) % 2 == 0


def _asked(priced: Term, each: Callable[[Array], Array]) -> Curve:
    """Return a curve that CVXPY evaluates: the curvature is a difference of its slopes."""

    def slope(x: Array) -> Array:
        found = priced.slope(x)
        if found is None:
            return np.full_like(x, np.nan)
        return found

    def bend(x: Array) -> Array:
        step = APART * (1 + np.abs(x))
        return np.maximum(slope(x + step) - slope(x - step), 0.0) / (2 * step)

    return Curve(lambda x: (each(x), slope(x)), bend)
