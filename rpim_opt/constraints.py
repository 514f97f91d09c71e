"""Constraints of a formulation, and the groups that its penalty may see."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import wraps
from inspect import signature
from typing import Any, ParamSpec, TypeVar

import cvxpy as cp
import numpy as np

from rpim_opt.exceptions import InputError, choices
from rpim_opt.parameters import Parameters
from rpim_opt.robot import Array

Constraint = Callable[[Any, Parameters], Any]
"""From z and the identified parameters to a CVXPY constraint, or several."""

Arguments = ParamSpec("Arguments")
Made = TypeVar("Made")


def stated(make: Callable[Arguments, Made]) -> Callable[Arguments, Made]:
    """Let what a function makes keep ``stated``, the function's name and arguments, so that a file can hold it."""

    @wraps(make)
    def remembering(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Made:
        given, made = signature(make).bind(*args, **kwargs), make(*args, **kwargs)
        given.apply_defaults()
        object.__setattr__(made, "stated", [make.__name__, *given.args])  # made may be frozen
        return made

    return remembering


@dataclass(frozen=True)
class Box:
    """A constraint lower <= z <= upper; with squared loss and penalty an active set polishes its solutions to rounding.

    Parameters
    ----------
    name
        What reports call it.
    limits
        From the identified `Parameters` to lower and upper bounds (n,) of z, infinite where there is none.

    Examples
    --------
    >>> import cvxpy as cp
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> half = ro.Box("half a scale", lambda p: (np.full(len(p), -0.5), np.full(len(p), 0.5)))
    >>> within = ro.Formulation("Tikhonov in a box", penalty=cp.sum_squares, constraints=(half,))
    >>> result = ro.calibrate(ro.load("paper_arm").problem, within, weight=1e-3)
    >>> round(float(abs(result.x / result.problem.parameters.free.scale).max()), 9)
    0.5
    """

    name: str
    limits: Callable[[Parameters], tuple[Array, Array]]

    def __call__(self, z: Any, parameters: Parameters) -> list[Any]:
        """Return the CVXPY constraints."""
        lower, upper = self.limits(parameters)
        fixed = np.flatnonzero(lower == upper)
        low = np.flatnonzero(np.isfinite(lower) & (lower < upper))
        high = np.flatnonzero(np.isfinite(upper) & (lower < upper))
        parts = [
            (fixed, lambda k: z[k] == lower[k]),
            (low, lambda k: z[k] >= lower[k]),
            (high, lambda k: z[k] <= upper[k]),
        ]
        return [make(k) for k, make in parts if len(k)]


def _tolerances(parameters: Parameters) -> tuple[Array, Array]:
    bound = parameters.tolerance / parameters.scale
    if not np.isfinite(bound).any():
        raise InputError("table tolerance", "no tolerance for any identified parameter", "length_mm, angle_mrad, ...")
    return -bound, bound


within_tolerance = Box("within tolerance", _tolerances)
"""|x_i| <= tolerance_i, where a tolerance is stated; InputError where none is.

>>> import rpim_opt as ro
>>> parameters = ro.load("paper_arm").problem.parameters.free
>>> lower, upper = ro.within_tolerance.limits(parameters)
>>> sorted(set(upper.round(9).tolist()))  # in units of the scales
[5.0, 10.0]
"""


@stated
def at_nominal(*patterns: str) -> Box:
    """Keep the parameters that match one of the patterns at their nominal values: z_i = 0.

    >>> import cvxpy as cp
    >>> import rpim_opt as ro
    >>> parallel = ro.Formulation("parallel axes", penalty=cp.sum_squares, constraints=(ro.at_nominal("alpha[34]"),))
    >>> result = ro.calibrate(ro.load("paper_arm").problem, parallel, weight=1e-3)
    >>> dict(zip(result.problem.parameters.free.names, result.x.tolist()))["alpha3"]
    0.0
    """

    def limits(parameters: Parameters) -> tuple[Array, Array]:
        chosen = _matching(parameters, patterns, "at_nominal")
        return np.where(chosen, 0.0, -np.inf), np.where(chosen, 0.0, np.inf)

    return Box("at nominal", limits)


@stated
def signed(sign: int, *patterns: str) -> Box:
    """Keep the deviations that match one of the patterns on one side: sign z_i >= 0.

    Parameters
    ----------
    sign
        +1 or -1.
    patterns
        Names of identified parameters, with ``*``, ``?`` and ``[...]``.

    Examples
    --------
    >>> import cvxpy as cp
    >>> import rpim_opt as ro
    >>> longer = ro.Formulation("no link is shorter", penalty=cp.sum_squares, constraints=(ro.signed(+1, "a?"),))
    >>> result = ro.calibrate(ro.load("paper_arm").problem, longer, weight=1e-3)
    >>> bool((result.robot.mdh[:, 1] >= result.problem.robot.mdh[:, 1]).all())
    True
    """

    def limits(parameters: Parameters) -> tuple[Array, Array]:
        chosen = _matching(parameters, patterns, "signed")
        return np.where(chosen & (sign > 0), 0.0, -np.inf), np.where(chosen & (sign < 0), 0.0, np.inf)

    return Box("signed", limits)


@stated
def equal(*names: str) -> Constraint:
    """Keep parameters equal in value, nominal included: two links machined to one length, axes that stay parallel.

    InputError for names that are not identified, fewer than two, or of different dimensions.

    >>> import cvxpy as cp
    >>> import rpim_opt as ro
    >>> level = ro.Formulation("a4 = a5", penalty=cp.sum_squares, constraints=(ro.equal("a4", "a5"),))
    >>> result = ro.calibrate(ro.load("paper_arm").problem, level, weight=1e-3)
    >>> (1e3 * result.robot.mdh[3:5, 1]).round(3)  # [mm]
    array([489.544, 489.544])
    """

    def constraint(z: Any, parameters: Parameters) -> Any:
        k = [parameters.names.index(n) for n in names if n in parameters.names]
        if len(k) < len(names) or len(k) < 2:
            missing = next((n for n in names if n not in parameters.names), names[0] if names else "")
            raise InputError(
                "equal", f"'{missing}'", "identified parameters, two or more: " + choices(missing, parameters.names)
            )
        if len({parameters.dimensions[i] for i in k}) > 1:
            found = ", ".join(f"{parameters.names[i]} ({parameters.dimensions[i]})" for i in k)
            raise InputError("equal", found, "parameters of one dimension")
        scale, nominal = parameters.scale[k], parameters.nominal[k]
        unit = scale.max()
        value = cp.multiply(scale / unit, z[k]) + nominal / unit
        return value[1:] == value[0]

    return constraint


@stated
def in_ball(radius: float, *patterns: str) -> Constraint:
    """Keep the deviations that match one of the patterns in a ball: |z| <= radius.

    Parameters
    ----------
    radius
        In units of the scales.
    patterns
        Names of identified parameters, with ``*``, ``?`` and ``[...]``.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.Formulation("ball", constraints=(ro.in_ball(2.0, "*"),)))
    >>> round(float(np.linalg.norm(result.x / result.problem.parameters.free.scale)), 6)
    2.0
    """

    def constraint(z: Any, parameters: Parameters) -> Any:
        return cp.norm(z[np.flatnonzero(_matching(parameters, patterns, "in_ball"))]) <= radius

    return constraint


def _matching(parameters: Parameters, patterns: Sequence[str], what: str) -> np.ndarray:
    if not patterns:
        raise InputError(what, "no pattern", "names or patterns of identified parameters")
    chosen = np.zeros(len(parameters), dtype=bool)
    for pattern in patterns:
        hits = np.array([fnmatchcase(name, pattern) for name in parameters.names])
        if not hits.any():
            raise InputError(
                what, f"pattern '{pattern}'", "identified parameters: " + choices(pattern, parameters.names)
            )
        chosen |= hits
    return chosen


# --- groups of the penalty ---------------------------------------------------------------------------------


def _grouped(parameters: Parameters, key: Callable[[str], str]) -> list[Array]:
    keys = [key(name) for name in parameters.names]
    return [np.eye(len(keys))[[i for i, k in enumerate(keys) if k == one]] for one in dict.fromkeys(keys)]


def by_link(parameters: Parameters) -> list[Array]:
    """Group the parameters by link (``alpha3, a3, theta3, d3``) and by frame (``base``, ``tool``).

    Returns matrices D_k (n_k, n) that pick the groups, for ``penalty_over`` of a `Formulation`.

    >>> import rpim_opt as ro
    >>> parameters = ro.load("position").problem.parameters.free
    >>> [len(D) for D in ro.by_link(parameters)]  # six links, base, tool
    [4, 5, 4, 4, 4, 4, 6, 3]
    """
    return _grouped(
        parameters, lambda name: re.sub(r"^[a-z_]+?(\d+)$", r"\1", name) if name[-1].isdigit() else name.split("_")[0]
    )


def by_kind(parameters: Parameters) -> list[Array]:
    """Group the parameters by kind (all ``alpha``, all ``a``, ...), as `by_link` does by link: D_k (n_k, n).

    >>> import rpim_opt as ro
    >>> parameters = ro.load("position").problem.parameters.free
    >>> [len(D) for D in ro.by_kind(parameters)]  # alpha, a, theta, d, beta, base, tool
    [6, 6, 6, 6, 1, 6, 3]
    """
    return _grouped(parameters, lambda name: name.rstrip("0123456789") if name[-1].isdigit() else name.split("_")[0])


@stated
def differences(*patterns: str) -> Callable[[Parameters], list[Array]]:
    """Penalize how much neighbours differ (total variation with ``cp.sum``), and the others themselves.

    For parameters of consecutive joints that share a cause: ``differences("ratio?")``, one scale of all encoders. The
    function that it returns gives rows D_k (1, n), for ``penalty_over`` of a `Formulation`.

    >>> import rpim_opt as ro
    >>> parameters = ro.load("position").problem.parameters.identify(["d[12]", "ratio?"]).free
    >>> for D in ro.differences("ratio[123]")(parameters)[:3]:
    ...     print(D.astype(int))
    [[ 0  0 -1  1  0  0  0  0]]
    [[ 0  0  0 -1  1  0  0  0]]
    [[1 0 0 0 0 0 0 0]]
    """

    def rows(parameters: Parameters) -> list[Array]:
        chosen, eye = _matching(parameters, patterns, "differences"), np.eye(len(parameters))
        k = np.flatnonzero(chosen)
        return [eye[[i]] - eye[[j]] for i, j in zip(k[1:], k[:-1], strict=True)] + [
            eye[[i]] for i in np.flatnonzero(~chosen)
        ]

    return rows
