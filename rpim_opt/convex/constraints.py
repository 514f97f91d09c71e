"""Constraints of a formulation, and the groups that its penalty may see."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.units import display, fits
from rpim_opt.convex.atoms import cp
from rpim_opt.convex.drawn import parse
from rpim_opt.convex.structure import Quadratic
from rpim_opt.robot.parameters import Parameters

__all__ = [
    "Box",
    "at_nominal",
    "by_kind",
    "by_link",
    "differences",
    "equal",
    "in_ball",
    "parse",
    "signed",
    "within_tolerance",
]

Constraint = Callable[[Any, Parameters], Any]
"""From z and the identified parameters to a CVXPY constraint, or several."""

Limits = Callable[[Parameters], tuple[Array, Array]]
"""From the identified parameters to lower and upper bounds (n,) of z."""


class Ready:
    """What the package itself makes: equal in content is equal in meaning, so that a program may be kept, or a file."""

    maker = ""

    @property
    def stated(self) -> list[Any]:
        """The maker's name and its arguments, as a file holds them."""
        arguments: list[Any] = []
        for value in astuple(self):  # type: ignore[call-overload]
            arguments += list(value) if isinstance(value, tuple) else [value]
        return [self.maker, *arguments]

    @property
    def quadratic(self) -> Quadratic | None:
        """The quadratic of its argument that a penalty declares to be, where it knows that exactly."""
        return None


def spoken(deviation: float, dimension: str) -> str:
    """Return a deviation [SI] as a person says it: in mm, mrad, or the parameter's own unit."""
    unit, si = display(dimension)
    if dimension == "angle":
        unit, si = "mrad", 1e-3
    return f"{deviation / si:.4g} {unit}"


@dataclass(frozen=True)
class Box:
    """A constraint lower <= z <= upper; with squared loss and penalty an active set solves it to rounding.

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
    >>> half = ro.constraints.Box("half a scale", lambda p: (np.full(len(p), -0.5), np.full(len(p), 0.5)))
    >>> within = ro.Formulation("Tikhonov in a box", penalty=cp.sum_squares, constraints=(half,))
    >>> result = ro.calibrate(ro.load("paper_arm").problem, within, weight=1e-3)
    >>> round(float(abs(result.z).max()), 9)
    0.5
    >>> half.bounds(result.problem.parameters.free)[1][:3], half.stated, ro.within_tolerance.stated
    (array([0.5, 0.5, 0.5]), None, None)
    """

    name: str
    limits: Limits

    @property
    def stated(self) -> list[Any] | None:
        """What a file holds of it; None for limits that a script made."""
        return getattr(self.limits, "stated", None)

    def bounds(self, parameters: Parameters) -> tuple[Array, Array]:
        """Return the lower and upper bounds (n,), checked."""
        n = len(parameters)
        lower, upper = (np.broadcast_to(np.asarray(side, dtype=float), n) for side in self.limits(parameters))
        if np.isnan(lower).any() or np.isnan(upper).any():
            raise InputError(f"constraint '{self.name}'", "a bound that is not a number", "numbers, or infinity")
        crossed = np.flatnonzero(lower > upper)
        if len(crossed):
            i = int(crossed[0])
            low, high = (spoken(side[i] * parameters.scale[i], parameters.dimensions[i]) for side in (lower, upper))
            found = f"for {parameters.names[i]} a lower bound of {low} above the upper one of {high}"
            raise InputError(f"constraint '{self.name}'", found, "lower <= upper")
        if not (np.isfinite(lower).any() or np.isfinite(upper).any()):
            raise InputError(f"constraint '{self.name}'", "no finite bound", "a bound of one parameter at least")
        return lower, upper

    def __call__(self, z: Any, parameters: Parameters) -> list[Any]:
        """Return the CVXPY constraints."""
        lower, upper = self.bounds(parameters)
        fixed = np.flatnonzero(lower == upper)
        low = np.flatnonzero(np.isfinite(lower) & (lower < upper))
        high = np.flatnonzero(np.isfinite(upper) & (lower < upper))
        made = []
        if len(fixed):
            made.append(z[fixed] == lower[fixed])
        if len(low):
            made.append(z[low] >= lower[low])
        if len(high):
            made.append(z[high] <= upper[high])
        return made


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


@dataclass(frozen=True)
class _AtNominal(Ready):
    patterns: tuple[str, ...]
    maker = "at_nominal"

    def __call__(self, parameters: Parameters) -> tuple[Array, Array]:
        chosen = matching(parameters, self.patterns, self.maker)
        return np.where(chosen, 0.0, -np.inf), np.where(chosen, 0.0, np.inf)


def at_nominal(*patterns: str) -> Box:
    """Keep the parameters that match one of the patterns at their nominal values: z_i = 0.

    >>> import cvxpy as cp
    >>> import rpim_opt as ro
    >>> kept = ro.constraints.at_nominal("alpha[34]")
    >>> parallel = ro.Formulation("parallel axes", penalty=cp.sum_squares, constraints=(kept,))
    >>> result = ro.calibrate(ro.load("paper_arm").problem, parallel, weight=1e-3)
    >>> dict(zip(result.problem.parameters.free.names, result.x.tolist()))["alpha3"]
    0.0
    """
    return Box("at nominal", _AtNominal(patterns))


@dataclass(frozen=True)
class _Signed(Ready):
    sign: int
    patterns: tuple[str, ...]
    maker = "signed"

    def __call__(self, parameters: Parameters) -> tuple[Array, Array]:
        chosen = matching(parameters, self.patterns, self.maker)
        lower = np.where(chosen & (self.sign > 0), 0.0, -np.inf)
        upper = np.where(chosen & (self.sign < 0), 0.0, np.inf)
        return lower, upper


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
    >>> positive = ro.constraints.signed(+1, "a?")
    >>> longer = ro.Formulation("no link is shorter", penalty=cp.sum_squares, constraints=(positive,))
    >>> result = ro.calibrate(ro.load("paper_arm").problem, longer, weight=1e-3)
    >>> bool((result.robot.mdh[:, 1] >= result.problem.robot.mdh[:, 1]).all())
    True
    """
    if sign not in (1, -1):
        raise InputError("signed", f"sign {sign}", "+1 or -1")
    return Box("signed", _Signed(sign, patterns))


@dataclass(frozen=True)
class _Equal(Ready):
    names: tuple[str, ...]
    maker = "equal"

    def __call__(self, z: Any, parameters: Parameters) -> Any:
        k = [parameters.names.index(n) for n in self.names if n in parameters.names]
        if len(k) < len(self.names) or len(k) < 2:
            missing = next((n for n in self.names if n not in parameters.names), self.names[0] if self.names else "")
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


def equal(*names: str) -> Constraint:
    """Keep parameters equal in value, nominal included: two links machined to one length, axes that stay parallel.

    InputError for names that are not identified, fewer than two, or of different dimensions.

    >>> import cvxpy as cp
    >>> import rpim_opt as ro
    >>> parallel = ro.constraints.equal("alpha3", "alpha4")
    >>> stated = ro.Formulation("axes 2 to 4", penalty=cp.sum_squares, constraints=(parallel,))
    >>> result = ro.calibrate(ro.load("paper_arm").problem, stated, weight=1e-3)
    >>> (1e3 * result.robot.mdh[2:4, 0]).round(3)  # [mrad]
    array([-0.124, -0.124])
    """
    return _Equal(names)


@dataclass(frozen=True)
class _InBall(Ready):
    radius: float
    patterns: tuple[str, ...]
    maker = "in_ball"

    def __call__(self, z: Any, parameters: Parameters) -> Any:
        return cp.norm(z[np.flatnonzero(matching(parameters, self.patterns, self.maker))]) <= self.radius


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
    if not (np.isfinite(radius) and radius >= 0):
        raise InputError("in_ball", f"radius {radius}", "a finite number of scales, zero or more")
    return _InBall(radius, patterns)


def matching(parameters: Parameters, patterns: Sequence[str], what: str) -> np.ndarray:
    """Return which identified parameters match one of the patterns, (n,) true or false."""
    if not patterns:
        raise InputError(what, "no pattern", "names or patterns of identified parameters")
    chosen = np.zeros(len(parameters), dtype=bool)
    for pattern in patterns:
        hits = np.array([fits(name, pattern) for name in parameters.names])
        if not hits.any():
            known = "identified parameters: " + choices(pattern, parameters.names)
            raise InputError(what, f"pattern '{pattern}'", known)
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
    >>> [len(D) for D in ro.constraints.by_link(parameters)]  # six links, base, tool
    [4, 5, 4, 4, 4, 4, 6, 3]
    """
    return _grouped(
        parameters, lambda name: re.sub(r"^[a-z_]+?(\d+)$", r"\1", name) if name[-1].isdigit() else name.split("_")[0]
    )


def by_kind(parameters: Parameters) -> list[Array]:
    """Group the parameters by kind (all ``alpha``, all ``a``, ...), as `by_link` does by link: D_k (n_k, n).

    >>> import rpim_opt as ro
    >>> parameters = ro.load("position").problem.parameters.free
    >>> [len(D) for D in ro.constraints.by_kind(parameters)]  # alpha, a, theta, d, beta, base, tool
    [6, 6, 6, 6, 1, 6, 3]
    """
    return _grouped(parameters, lambda name: name.rstrip("0123456789") if name[-1].isdigit() else name.split("_")[0])


@dataclass(frozen=True)
class _Differences(Ready):
    patterns: tuple[str, ...]
    maker = "differences"

    def __call__(self, parameters: Parameters) -> list[Array]:
        chosen = matching(parameters, self.patterns, self.maker)
        eye = np.eye(len(parameters))
        k = np.flatnonzero(chosen)
        neighbours = [eye[[i]] - eye[[j]] for i, j in zip(k[1:], k[:-1], strict=True)]
        return neighbours + [eye[[i]] for i in np.flatnonzero(~chosen)]


def differences(*patterns: str) -> Callable[[Parameters], list[Array]]:
    """Penalize how much neighbours differ (total variation with ``cp.sum``), and the others themselves.

    For parameters of consecutive joints that share a cause: ``differences("ratio?")``, one scale of all encoders. The
    function that it returns gives rows D_k (1, n), for ``penalty_over`` of a `Formulation`.

    >>> import rpim_opt as ro
    >>> parameters = ro.load("position").problem.parameters.identify(["d[12]", "ratio?"]).free
    >>> for D in ro.constraints.differences("ratio[123]")(parameters)[:3]:
    ...     print(D.astype(int))
    [[ 0  0 -1  1  0  0  0  0]]
    [[ 0  0  0 -1  1  0  0  0]]
    [[1 0 0 0 0 0 0 0]]
    """
    return _Differences(patterns)
