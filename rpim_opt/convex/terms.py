"""Convex functions as CVXPY states them: asked once, checked, cut off from what may change, evaluated at numbers."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.atoms import cp


def scalar(value: Any, where: str) -> Any:
    """Return what a loss or penalty answered as a convex scalar expression, or say what it is instead."""
    accepted = "a convex scalar expression of CVXPY"
    if value is None:
        raise InputError(where, "None", f"{accepted}; is a 'return' missing?")
    if not isinstance(value, cp.Expression | int | float | np.number):
        raise InputError(where, f"a {type(value).__name__}", accepted)
    expression: Any = cp.Expression.cast_to_const(value)  # type: ignore[arg-type]
    if expression.size != 1:
        found = f"a value of shape {expression.shape}"
        raise InputError(where, found, f"{accepted}: cp.sum or cp.max of it, for instance")
    if expression.is_complex():
        raise InputError(where, "a complex value", accepted)
    if not expression.is_convex():
        raise InputError(where, "a program that is not convex", f"CVXPY's DCP rules; {reason(expression)}")
    if expression.shape == ():
        return expression
    return cp.reshape(expression, (), order="C")


def listed(value: Any, where: str) -> list[Any]:
    """Return what a constraint function answered as a list of CVXPY constraints."""
    made = [value]
    if isinstance(value, list | tuple):
        made = list(value)
    for constraint in made:
        if isinstance(constraint, bool | np.bool_):
            raise InputError(where, f"{constraint}", "a CVXPY constraint: something that depends on z")
        if not isinstance(constraint, cp.Constraint):
            raise InputError(where, f"a {type(constraint).__name__}", "a CVXPY constraint, or several in a list")
        if not constraint.is_dcp():
            raise InputError(where, "a program that is not convex", f"CVXPY's DCP rules; {reason(constraint)}")
    return made


def reason(stated: Any) -> str:
    """Say which part of an expression or constraint breaks CVXPY's rules: the innermost one."""
    if isinstance(stated, cp.Constraint):
        broken = [argument for argument in stated.args if not argument.is_dcp()]
        if not broken:
            shapes = ", ".join(argument.curvature.lower() for argument in stated.args)
            return f"found {_short(stated)}, whose sides are {shapes}: convex <= concave, or affine == affine"
        return reason(broken[0])
    if stated.is_dcp():
        return f"found {_short(stated)}, which is {stated.curvature.lower()}"
    inner = [argument for argument in stated.args if not argument.is_dcp()]
    if inner:
        return reason(inner[0])
    within = ", ".join(f"{_short(argument)} {argument.curvature.lower()}" for argument in stated.args)
    return f"found {_short(stated)}, of which CVXPY cannot tell that it is convex (of {within})"


def _short(expression: Any) -> str:
    text = " ".join(str(expression).split())
    if len(text) <= 80:
        return text
    return text[:77] + "..."


class Frozen:
    """Copies of expressions with the values that the user's parameters have now, and variables of their own.

    What the user changes afterwards, or another thread solves meanwhile, does not reach the copies.
    """

    def __init__(self, shared: Sequence[cp.Variable], where: str):
        self.own: list[cp.Variable] = []
        self._where = where
        self._shared = {id(variable) for variable in shared}
        self._instead: dict[int, Any] = {}

    def __call__(self, stated: Any) -> Any:
        """Return the copy of an expression or constraint."""
        for parameter in stated.parameters():
            if parameter.value is None:
                raise InputError(self._where, f"parameter '{parameter.name()}' without a value", "one that has a value")
            self._instead.setdefault(id(parameter), cp.Constant(parameter.value))
        for variable in stated.variables():
            if id(variable) not in self._shared | self._instead.keys():
                self._instead[id(variable)] = self._copy(variable)
        return stated.tree_copy(self._instead)

    def _copy(self, variable: cp.Variable) -> cp.Variable:
        if variable.attributes.get("boolean") or variable.attributes.get("integer"):
            found = f"integer variable '{variable.name()}'"
            raise InputError(self._where, found, "continuous variables: integer programs are not convex")
        made = cp.Variable(variable.shape, **{k: v for k, v in variable.attributes.items() if v})
        self.own.append(made)
        return made


def _met(limit: Any) -> bool:
    return not np.any(limit.violation() > 0)


class Term:
    """An expression of one variable, evaluated at numbers."""

    def __init__(self, expression: Any, variable: cp.Variable):
        self.expression, self.variable = expression, variable
        self._domain = expression.domain
        self._lock = threading.Lock()  # a variable has one value at a time

    def __call__(self, value: Array) -> float:
        """Return the value; infinite outside the domain."""
        with self._lock:
            self.variable.save_value(value)
            with np.errstate(all="ignore"):
                found = self.expression.value
                if not all(_met(limit) for limit in self._domain):  # 1 / x is a number there, but not the atom's
                    return float("inf")
        if found is None or not np.isfinite(found):
            return float("inf")
        return float(found)

    def slope(self, value: Array) -> Array | None:
        """Return the gradient (n,), None where CVXPY knows none, or outside the domain."""
        with self._lock:
            self.variable.save_value(value)
            with np.errstate(all="ignore"):
                found = self.expression.grad.get(self.variable)
        if found is None:
            return None
        if not scipy.sparse.issparse(found):
            return np.atleast_1d(np.asarray(found, dtype=float)).ravel()
        return np.asarray(found.todense()).ravel()


def apart(expression: Any, variable: cp.Variable) -> Term:
    """Return an expression as a term of a variable that nothing else sets."""
    own = cp.Variable(variable.size)
    return Term(expression.tree_copy({id(variable): own}), own)


def term(function: Callable[[Any], Any], size: int, where: str) -> Term:
    """Return a function of a vector of so many numbers as a term, with the parameters' values of now."""
    variable = cp.Variable(size)
    expression = Frozen([variable], where)(scalar(function(variable), where))
    return Term(expression, variable)
