"""CVXPY expressions: functions by name, checks of users' return values, copies, values and gradients."""

from __future__ import annotations

import contextlib
import sys
import threading
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError

if TYPE_CHECKING:
    import cvxpy as cp
else:

    class _Late(ModuleType):  # CVXPY, imported at first use
        def __getattr__(self, name: str) -> Any:
            if name.startswith("__"):  # doctest and inspect ask every module for such names: no use
                raise AttributeError(name)
            value = vars(self)[name] = getattr(import_module(self.__name__), name)
            return value

    cp = _Late("cvxpy")

OPTIMAL = "optimal"


@dataclass(frozen=True)
class Atom:
    """A function of CVXPY by its name, ``cp.sum_squares``, usable before CVXPY is imported."""

    name: str

    def __call__(self, v: Any) -> Any:
        """Return CVXPY's expression."""
        return getattr(cp, self.name)(v)

    def __repr__(self) -> str:
        return f"cp.{self.name}"

    @property
    def __name__(self) -> str:
        return self.name


SQUARES, SUM, LARGEST, NORM1, NORM2 = (Atom(name) for name in ("sum_squares", "sum", "max", "norm1", "norm2"))
ATOMS = (SQUARES, SUM, LARGEST, NORM1, NORM2)


def named(function: Callable[..., Any] | None) -> Callable[..., Any] | None:
    """Return a function of CVXPY as an `Atom`; any other function unchanged."""
    module = sys.modules.get("cvxpy")
    if module is None:  # then none of its functions is in use
        return function
    for atom in ATOMS:
        if function is getattr(module, atom.name, None):
            return atom
    return function


# --- what users' functions return ---


def scalar(value: Any, where: str) -> Any:
    """Check that a loss or penalty returned a convex scalar expression, and return it."""
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
    _require_numbers(expression, where)
    if not expression.is_convex():
        raise InputError(where, "a program that is not convex", f"CVXPY's DCP rules; {reason(expression)}")
    return expression if expression.shape == () else cp.reshape(expression, (), order="C")


def listed(value: Any, where: str) -> list[Any]:
    """Check the return value of a constraint function, and return it as a list of CVXPY constraints."""
    made = list(value) if isinstance(value, list | tuple) else [value]
    if not made:
        raise InputError(where, "no constraint", "a CVXPY constraint, or several in a list")
    for constraint in made:
        if isinstance(constraint, bool | np.bool_):
            raise InputError(where, f"{constraint}", "a CVXPY constraint: something that depends on z")
        if not isinstance(constraint, cp.Constraint):
            raise InputError(where, f"a {type(constraint).__name__}", "a CVXPY constraint, or several in a list")
        _require_numbers(constraint, where)
        if not constraint.is_dcp():
            raise InputError(where, "a program that is not convex", f"CVXPY's DCP rules; {reason(constraint)}")
    return made


def _require_numbers(stated: Any, where: str) -> None:
    numbers = [each.value.data if scipy.sparse.issparse(each.value) else each.value for each in stated.constants()]
    if any(np.isnan(each).any() for each in numbers):
        raise InputError(where, "a constant that is not a number (NaN)", "numbers, or infinity as a bound")


def reason(stated: Any) -> str:
    """Return the innermost part of an expression or constraint that violates CVXPY's rules, as text."""
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
    return f"found {_short(stated)}, whose convexity CVXPY cannot verify (of {within})"


def _short(expression: Any) -> str:
    text = " ".join(str(expression).split())
    return text if len(text) <= 80 else text[:77] + "..."


def substituted(stated: Any, instead: Mapping[int, Any]) -> Any:
    """Return a copy of an expression or constraint with other leaves, by the ``id`` of those that they replace."""
    if id(stated) in instead:
        return instead[id(stated)]
    kind = type(stated)  # for three types CVXPY's ``tree_copy`` loses arguments
    if kind.__name__ == "indicator":
        return kind([substituted(limit, instead) for limit in stated.args], stated.err_tol)
    if kind.__name__ == "perspective":
        parts = [stated.f, stated.args[0], stated.f_recession]
        return kind(*(None if part is None else substituted(part, instead) for part in parts))
    args = [substituted(arg, instead) for arg in stated.args]
    if kind.__name__ == "SuppFuncAtom":
        return kind(args[0], stated._parent)
    return stated.copy(args, instead)


class Frozen:
    """Copies of expressions with the current parameter values, unaffected by later changes."""

    def __init__(self, shared: Sequence[cp.Variable], where: str):
        self.own: list[cp.Variable] = []
        self._where = where
        self._shared = {id(variable) for variable in shared}
        self._instead: dict[int, Any] = {}

    def __call__(self, stated: Any) -> Any:
        """Return the copy of an expression or constraint."""
        for parameter in stated.parameters():
            if parameter.value is None:
                raise InputError(
                    self._where, f"parameter '{parameter.name()}' without a value", "a parameter with a value"
                )
            self._instead.setdefault(id(parameter), cp.Constant(parameter.value))
        for variable in stated.variables():
            if id(variable) in self._shared | self._instead.keys():
                continue
            if variable.attributes.get("boolean") or variable.attributes.get("integer"):
                found = f"integer variable '{variable.name()}'"
                raise InputError(self._where, found, "continuous variables: integer programs are not convex")
            made = cp.Variable(variable.shape, **{k: v for k, v in variable.attributes.items() if v})
            self._instead[id(variable)] = made
            self.own.append(made)
        if not self._instead.keys() & {id(leaf) for leaf in [*stated.parameters(), *stated.variables()]}:
            return stated  # it is constant from here on; CVXPY has determined its convexity
        return substituted(stated, self._instead)


def _domain(expression: Any) -> list[Any]:
    """Return the constraints outside of which an expression is infinite; CVXPY's own forgets indicators."""
    if type(expression).__name__ == "indicator":
        return list(expression.args)
    own = expression.domain if not expression.args else expression._domain()
    return [*own, *(limit for arg in expression.args for limit in _domain(arg))]


OF_NUMPY = ("You're calling a NumPy function on a CVXPY expression", "unexpected keyword argument 'out'")
"""Errors of NumPy functions applied to CVXPY expressions; ``np.sum`` calls their method ``sum``."""


def called(function: Callable[..., Any], where: str, *arguments: Any) -> Any:
    """Call a user's function, and turn its errors into an InputError."""
    try:
        return function(*arguments)
    except (cp.SolverError, NotImplementedError) as error:  # by atoms that call a solver, and strict inequalities
        raise InputError(where, f"{error}".rstrip("."), "expressions of CVXPY, with <=, >= or ==") from error
    except (TypeError, RuntimeError) as error:
        if any(text in str(error) for text in OF_NUMPY):
            accepted = "functions of CVXPY: cp.abs, cp.sum, cp.norm, cp.maximum, cp.sqrt, ..."
            raise InputError(where, "a NumPy function of a CVXPY expression", accepted) from error
        if isinstance(error, RuntimeError):
            raise
        if error.__traceback__ is None or error.__traceback__.tb_next is not None:  # raised in the function's own code
            raise
        constraint = "z and the parameters, lambda z, p: cp.norm1(z) <= 5"
        accepted = f"a function of {constraint if len(arguments) == 2 else 'one argument'}"
        raise InputError(where, str(error), accepted) from None


Evaluation = Callable[[Any], tuple[Any, Any]]
"""Value and derivative of an expression at a number or numbers of its variable."""


def evaluation(e: Any, v: Any, slopes: bool = True) -> Evaluation:
    """Return a function that evaluates an expression at values of a variable, four times as fast as ``e.value``.

    With ``slopes`` it differentiates in forward mode; entry i of every subexpression depends on v_i alone.
    """
    if e is v:
        return lambda x: (x, 1.0)
    if not has(e, v):
        constant = e.value
        return lambda x: (constant, 0.0)
    if not e.args or type(e).__name__ in ("SuppFuncAtom", "indicator") or 0 in e.shape:
        return lambda x: (e.value, None)
    norm = slopes and is_norm(e)
    args = e.args[0].args if norm else e.args
    parts = [evaluation(arg, v, slopes) for arg in args]
    moving = [k for k, arg in enumerate(args) if has(arg, v)]
    derivatives = DERIVATIVES.get("norm" if norm else type(e).__name__, _by_cvxpy)

    @np.errstate(all="ignore")
    def evaluated(x: Any) -> tuple[Any, Any]:
        values, inner = zip(*[part(x) for part in parts], strict=True)
        value = None if any(each is None for each in values) else e.numeric([np.vstack(values)] if norm else values)
        if not slopes:
            return value, None
        outer = derivatives(e, values, value)
        return value, sum([outer[k] * inner[k] for k in moving])

    return evaluated


def has(e: Any, v: Any) -> bool:
    """Return whether an expression depends on a variable."""
    return v.id in {each.id for each in e.variables()}


def is_norm(e: Any) -> bool:
    """Whether an expression is the 2-norm, entry by entry, of several vectors (pseudo-Huber: of v and a constant)."""
    named = type(e).__name__.startswith("Pnorm") and type(e.args[0]).__name__ == "Vstack"
    return named and float(e.p) == 2 and e.axis == 0


class OutsideDomain(Exception):
    """Raised outside the domain of a function, where it has no derivative."""


def _by_cvxpy(e: Any, values: Sequence[Any], _: Any) -> list[Any]:
    """Return partial derivatives of an atom by CVXPY's sparse Jacobians."""
    full = [np.broadcast_to(np.asarray(value, dtype=float), e.shape) for value in values]
    parts = e._grad(full)
    if any(part is None for part in parts):
        raise OutsideDomain
    return [part.diagonal() for part in parts]


def _of_maximum(_: Any, values: Sequence[Any], value: Any) -> list[Any]:
    free: Any = True  # where none of the previous ones is the largest
    parts = []
    for each in values:
        largest = free & (each == value)
        parts.append(largest * 1.0)
        free = free & ~largest
    return parts


def _of_product(_e: Any, values: Sequence[Any], _v: Any) -> list[Any]:
    return [values[1], values[0]]


DERIVATIVES: dict[str, Callable[[Any, Any, Any], list[Any]]] = {
    "AddExpression": lambda e, values, value: [1.0] * len(values),
    "NegExpression": lambda e, values, value: [-1.0],
    "Promote": lambda e, values, value: [1.0],
    "reshape": lambda e, values, value: [1.0],
    "DivExpression": lambda e, values, value: [1.0 / values[1], 0.0],
    "multiply": _of_product,
    "MulExpression": _of_product,
    "huber": lambda e, values, value: [2 * np.clip(values[0], -e.M.value, e.M.value)],
    "abs": lambda e, values, value: [np.sign(values[0])],
    "maximum": _of_maximum,
    "logistic": lambda e, values, value: [1.0 / (1.0 + np.exp(-values[0]))],
    "exp": lambda e, values, value: [value],
    "norm": lambda e, values, value: [each / np.maximum(value, 1e-300) for each in values],
}
"""Partial derivatives of the most frequent atoms of losses, from the values of their arguments and their own."""


class Term:
    """An expression of one variable, evaluated at numbers."""

    def __init__(self, expression: Any, variable: cp.Variable):
        self.expression, self.variable = expression, variable
        self._domain = _domain(expression)
        self._evaluated = evaluation(expression, variable, slopes=False)
        self._lock = threading.Lock()  # a variable has one value at a time

    def __call__(self, value: Array) -> float:
        """Return the value; infinite outside the domain."""
        with self._lock, np.errstate(all="ignore"):
            self.variable.save_value(value)
            if any(np.any(limit.violation() > 0) for limit in self._domain):  # 1 / x still is a number
                return float("inf")
            result = self._evaluated(value)[0]
        if result is None or not np.isfinite(result):
            return float("inf")
        return float(result)

    def slope(self, value: Array) -> Array | None:
        """Return the gradient (n,), None where CVXPY knows none, or outside the domain."""
        with self._lock:
            self.variable.save_value(value)
            gradient: Any = None
            # NotImplementedError if an atom has no gradient (norm_inf), ValueError by a fault in CVXPY (cummax)
            with np.errstate(all="ignore"), contextlib.suppress(NotImplementedError, ValueError):
                gradient = self.expression.grad.get(self.variable)
        if scipy.sparse.issparse(gradient):
            gradient = gradient.toarray()
        return None if gradient is None else np.asarray(gradient, dtype=float).ravel()


def term(function: Callable[[Any], Any], size: int, where: str) -> Term:
    """Return a function of a vector of given length as a term, with the current parameter values."""
    variable = cp.Variable(size)
    expression = Frozen([variable], where)(scalar(called(function, where, variable), where))
    return Term(expression, variable)


def minimized(problem: cp.Problem, **settings: float) -> bool:
    """Solve a problem by Clarabel, which may be inaccurate; return whether it found a minimum."""
    for variable in problem.variables():
        variable.save_value(None)
    with warnings.catch_warnings(), contextlib.suppress(cp.SolverError):
        warnings.simplefilter("ignore", UserWarning)
        problem.solve(solver=cp.CLARABEL, **settings)
        return problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)
    return False  # the status refers to the previous solution


def norms(r: Any, group: np.ndarray) -> Any:
    """Return the norms of a residual (m,) by group in CVXPY, in the order of the groups' numbers."""
    _, which, count = np.unique(group, return_inverse=True, return_counts=True)
    order = np.argsort(which, kind="stable")
    place = np.empty(len(group), dtype=int)
    place[order] = np.arange(len(group)) - np.repeat(np.cumsum(count) - count, count)
    shape = (len(count), int(count.max()))  # shorter groups are filled with zeros
    at = (which * shape[1] + place, np.arange(len(group)))
    pick = scipy.sparse.csr_array((np.ones(len(group)), at), (shape[0] * shape[1], len(group)))
    return cp.norm(cp.reshape(pick @ r, shape, order="C"), 2, axis=1)
