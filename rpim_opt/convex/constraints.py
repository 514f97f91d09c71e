"""Constraints of formulations, and groups of parameters for penalties."""

from __future__ import annotations

import linecache
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.text import shortened
from rpim_opt.basics.units import UNITS, display
from rpim_opt.convex.arguments import Arguments, arguments_of, places, problem_of
from rpim_opt.convex.expressions import cp
from rpim_opt.problem.workspace import bounding, markers, moved
from rpim_opt.robot.parameters import Parameters

if TYPE_CHECKING:
    from rpim_opt.convex.constraint_parser import Sentence, Sum

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
"""Function of z and the identified parameters that returns one or several CVXPY constraints."""

WORKSPACE, BOX = "workspace", ("x", "y", "z")
"""The predefined place, all joint ranges; and the keys of a box."""
FAR = 100.0
"""Largest difference of a stated value from nominal, in prior scales: beyond, its unit or meaning is wrong."""

Limits = Callable[[Parameters], tuple[Array, Array]]
"""Function of the identified parameters that returns lower and upper bounds (n,) of z."""


@dataclass(frozen=True)
class Ready:
    """A function made by the package, compared and stored by the name and arguments of its ``maker``.

    ``function`` is called with its own arguments, followed by the maker's ``arguments``.
    """

    maker: str
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    quadratic: ClassVar[Any] = None
    """The exact quadratic form of a penalty, if it declares one."""

    def __post_init__(self) -> None:
        for argument in self.arguments:
            if isinstance(argument, list):
                raise InputError(self.maker, f"{argument}", f"arguments one by one: {self.maker}(*{argument})")

    def __call__(self, *values: Any) -> Any:
        """Return what the function does."""
        return self.function(*values, *self.arguments)

    @property
    def stated(self) -> list[Any]:
        """The maker's name and its arguments, as a file holds them."""
        return [self.maker, *self.arguments]

    @property
    def name(self) -> str:
        """Its name in errors and reports: the call that makes it."""
        return f"{self.maker}({', '.join(map(repr, self.arguments))})"


def name_of(function: Any, k: int) -> str:
    """Return the name of a constraint function; of a lambda its source text."""
    name = getattr(function, "name", getattr(function, "__name__", "<lambda>"))
    if name != "<lambda>":
        return str(name)
    code = getattr(function, "__code__", None)
    known = [place for place in (code.co_positions() if code else ()) if None not in place]
    places = [place for place in known if place[::2] < place[1::2]]  # pairs (line, byte) of begin and end
    lines = linecache.getlines(code.co_filename) if code and places else []
    if not lines:
        return f"constraint {k + 1}"
    (first, start), (last, end) = min(place[::2] for place in places), max(place[1::2] for place in places)
    text = "".join(lines[first - 1 : last]).encode()[start:]
    behind = len(lines[last - 1].encode()) - end
    return shortened(" ".join(text[: len(text) - behind].decode().split()))


def as_text(deviation: float, dimension: str) -> str:
    """Return a deviation [SI] as text in mm, mrad, or the parameter's own unit."""
    unit, si = display(dimension)
    if dimension == "angle":
        unit, si = "mrad", 1e-3
    return f"{deviation / si:.4g} {unit}"


@dataclass(frozen=True)
class Box:
    """A constraint lower <= z <= upper; with squared loss and penalty, an active-set method solves it to rounding.

    ``limits`` returns lower and upper bounds (n,) for the identified `Parameters`, infinite where there is none.

    >>> import cvxpy as cp
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> half = ro.constraints.Box("half a scale", lambda p: (np.full(len(p), -0.5), np.full(len(p), 0.5)))
    >>> within = ro.Formulation("Tikhonov in a box", penalty=cp.sum_squares, constraints=(half,))
    >>> result = ro.calibrate(ro.load("paper_arm").problem, within, weight=1e-3)
    >>> round(float(abs(result.z).max()), 9)
    0.5
    """

    name: str
    limits: Limits

    @property
    def stated(self) -> list[Any] | None:
        """Its representation in a file; None for limits computed by a script."""
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
            low, high = (as_text(side[i] * parameters.scale[i], parameters.dimensions[i]) for side in (lower, upper))
            found = f"for {parameters.names[i]} a lower bound of {low} above the upper one of {high}"
            raise InputError(f"constraint '{self.name}'", found, "lower <= upper")
        if not (np.isfinite(lower).any() or np.isfinite(upper).any()):
            raise InputError(f"constraint '{self.name}'", "no finite bound", "a bound on at least one parameter")
        return lower, upper

    def __call__(self, z: Any, parameters: Parameters) -> list[Any]:
        """Return the CVXPY constraints."""
        lower, upper = self.bounds(parameters)
        fixed, low, high = (np.flatnonzero(side) for side in box_sides(lower, upper))
        made = []  # CVXPY before 1.8 has no empty expression
        if len(fixed):
            made.append(z[fixed] == lower[fixed])
        if len(low):
            made.append(z[low] >= lower[low])
        if len(high):
            made.append(z[high] <= upper[high])
        return made


def box_sides(lower: Array, upper: Array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return which components (n,) of a box are fixed, and which of the others have a lower and an upper bound."""
    fixed = lower == upper
    return fixed, np.isfinite(lower) & ~fixed, np.isfinite(upper) & ~fixed


def _tolerances(parameters: Parameters) -> tuple[Array, Array]:
    bound = parameters.tolerance / parameters.scale
    if not np.isfinite(bound).any():
        accepted = "length_mm, ... in [tolerance], or `parameters.toleranced({'length_mm': 5.0})` in a script"
        raise InputError("tolerances", "none for any identified parameter", accepted)
    return -bound, bound


within_tolerance = Box("within tolerance", _tolerances)
"""|x_i| <= tolerance_i for all stated tolerances; InputError if none is stated.

>>> import rpim_opt as ro
>>> parameters = ro.load("paper_arm").problem.parameters.free
>>> lower, upper = ro.within_tolerance.limits(parameters)
>>> sorted(set(upper.round(9).tolist()))  # in units of the scales
[5.0, 10.0]
"""


def at_nominal(*patterns: str) -> Box:
    """Fix the parameters that match one of the patterns at their nominal values: z_i = 0.

    >>> import cvxpy as cp
    >>> import rpim_opt as ro
    >>> kept = ro.constraints.at_nominal("alpha[34]")
    >>> parallel = ro.Formulation("parallel axes", penalty=cp.sum_squares, constraints=(kept,))
    >>> result = ro.calibrate(ro.load("paper_arm").problem, parallel, weight=1e-3)
    >>> dict(zip(result.problem.parameters.free.names, result.x.tolist()))["alpha3"]
    0.0
    """
    limits = Ready("at_nominal", _at_nominal, patterns)
    return Box(limits.name, limits)


def _at_nominal(parameters: Parameters, *patterns: str) -> tuple[Array, Array]:
    chosen = matching(parameters, patterns, "at_nominal")
    return np.where(chosen, 0.0, -np.inf), np.where(chosen, 0.0, np.inf)


def signed(sign: int, *patterns: str) -> Box:
    """Restrict the sign of deviations that match one of the patterns: sign z_i >= 0, with sign +1 or -1.

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
    limits = Ready("signed", _signed, (sign, *patterns))
    return Box(limits.name, limits)


def _signed(parameters: Parameters, sign: int, *patterns: str) -> tuple[Array, Array]:
    chosen = matching(parameters, patterns, "signed")
    return np.where(chosen & (sign > 0), 0.0, -np.inf), np.where(chosen & (sign < 0), 0.0, np.inf)


def equal(*names: str) -> Constraint:
    """Constrain parameters to equal values (nominal plus deviation): equal link lengths, parallel axes.

    InputError for names that are not identified, fewer than two, or of different dimensions.

    >>> import cvxpy as cp
    >>> import rpim_opt as ro
    >>> parallel = ro.constraints.equal("alpha3", "alpha4")
    >>> stated = ro.Formulation("axes 2 to 4", penalty=cp.sum_squares, constraints=(parallel,))
    >>> result = ro.calibrate(ro.load("paper_arm").problem, stated, weight=1e-3)
    >>> (1e3 * result.robot.mdh[2:4, 0]).round(3)  # [mrad]
    array([-0.124, -0.124])
    """
    return Ready("equal", _equal, names)


def _equal(z: Any, parameters: Parameters, *names: str) -> Any:
    k = [parameters.names.index(n) for n in names if n in parameters.names]
    if len(k) < len(names) or len(k) < 2:
        missing = next((n for n in names if n not in parameters.names), names[0] if names else "")
        accepted = "identified parameters, two or more: " + choices(missing, parameters.names)
        raise InputError("equal", f"'{missing}'", accepted)
    if len({parameters.dimensions[i] for i in k}) > 1:
        found = ", ".join(f"{parameters.names[i]} ({parameters.dimensions[i]})" for i in k)
        raise InputError("equal", found, "parameters of one dimension")
    scale, nominal = parameters.scale[k], parameters.nominal[k]
    unit = scale.max()
    value = cp.multiply(scale / unit, z[k]) + nominal / unit
    return value[1:] == value[0]


def in_ball(radius: float, *patterns: str) -> Constraint:
    """Restrict the deviations that match one of the patterns to a ball: |z| <= radius, in units of the scales.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.Formulation("ball", constraints=(ro.in_ball(2.0, "*"),)))
    >>> round(float(np.linalg.norm(result.x / result.problem.parameters.free.scale)), 6)
    2.0
    """
    if not (np.isfinite(radius) and radius >= 0):
        raise InputError("in_ball", f"radius {radius}", "a finite number of prior scales, zero or more")
    return Ready("in_ball", _in_ball, (radius, *patterns))


def _in_ball(z: Any, parameters: Parameters, radius: float, *patterns: str) -> Any:
    return cp.norm(z[np.flatnonzero(matching(parameters, patterns, "in_ball"))]) <= radius


def matching(parameters: Parameters, patterns: Sequence[str], what: str) -> np.ndarray:
    """Return which identified parameters match one of the patterns, (n,) true or false."""
    if not patterns:
        raise InputError(what, "no pattern", "names or patterns of identified parameters")
    chosen = np.zeros(len(parameters), dtype=bool)
    for pattern in patterns:
        chosen[places(parameters.names, pattern, what, "identified parameters")] = True
    return chosen


# --- groups of the penalty ---------------------------------------------------------------------------------


def _grouped(parameters: Parameters, key: Callable[[str], str]) -> list[Array]:
    keys = [key(name) if name[-1].isdigit() else name.split("_")[0] for name in parameters.names]
    return [np.eye(len(keys))[[i for i, k in enumerate(keys) if k == one]] for one in dict.fromkeys(keys)]


def by_link(parameters: Parameters) -> list[Array]:
    """Group the parameters by link (``alpha3, a3, theta3, d3``) and by frame (``base``, ``tool``).

    The function returns matrices D_k (n_k, n) that select the groups, for ``penalty_over`` of a `Formulation`.

    >>> import rpim_opt as ro
    >>> parameters = ro.load("position").problem.parameters.free
    >>> [len(D) for D in ro.constraints.by_link(parameters)]  # six links, base, tool
    [4, 5, 4, 4, 4, 4, 6, 3]
    """
    return _grouped(parameters, lambda name: re.sub(r"^[a-z_]+?(\d+)$", r"\1", name))


def by_kind(parameters: Parameters) -> list[Array]:
    """Group the parameters by kind (all ``alpha``, all ``a``, ...), with matrices D_k (n_k, n) as of `by_link`.

    >>> import rpim_opt as ro
    >>> parameters = ro.load("position").problem.parameters.free
    >>> [len(D) for D in ro.constraints.by_kind(parameters)]  # alpha, a, theta, d, beta, base, tool
    [6, 6, 6, 6, 1, 6, 3]
    """
    return _grouped(parameters, lambda name: name.rstrip("0123456789"))


def differences(*patterns: str) -> Callable[[Parameters], list[Array]]:
    """Penalize differences of neighbouring links (total variation with ``cp.sum``), and other parameters themselves.

    Intended for parameters of consecutive joints with a common cause: ``differences("ratio?")`` for one scale of all
    encoders. The returned function gives rows D_k (1, n), for ``penalty_over`` of a `Formulation`.

    >>> import rpim_opt as ro
    >>> parameters = ro.load("position").problem.parameters.identify(["d[12]", "ratio?"]).free
    >>> for D in ro.constraints.differences("ratio[123]")(parameters)[:3]:
    ...     print(D.astype(int))
    [[ 0  0 -1  1  0  0  0  0]]
    [[ 0  0  0 -1  1  0  0  0]]
    [[1 0 0 0 0 0 0 0]]
    """
    return Ready("differences", _differences, patterns)


def _differences(parameters: Parameters, *patterns: str) -> list[Array]:
    chosen = matching(parameters, patterns, "differences")
    eye = np.eye(len(parameters))
    k = np.flatnonzero(chosen)
    neighbours = [eye[[j]] - eye[[i]] for i, j in pairwise(k)]
    return neighbours + [eye[[i]] for i in np.flatnonzero(~chosen)]


# --- statements in words ---------------------------------------------------------------------------------------


class Place(NamedTuple):
    """Named joint values (N, dof) [rad or m], or a box (3, 2) [m] in the robot's base frame."""

    name: str
    is_box: bool
    numbers: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Parsed:
    """A constraint parsed from a text by `parse`, with its named places."""

    text: str
    demanded: Sentence
    where: tuple[Place, ...] = ()

    @property
    def name(self) -> str:
        """Its name in errors and reports."""
        return f"'{self.text}'"

    @property
    def stated(self) -> list[Any]:
        """The maker's name and its arguments, as a file holds them."""
        if not self.where:
            return ["parse", self.text]
        where: dict[str, Any] = {}
        for name, is_box, numbers in self.where:
            rows = [list(row) for row in numbers]
            where[name] = dict(zip(BOX, rows, strict=True)) if is_box else rows
        return ["parse", self.text, where]

    @property
    def unit(self) -> tuple[str, float]:
        """The unit in which it was written, and its size [SI]."""
        name = self.demanded.unit
        return (name, UNITS[name].si) if name else ("SI", 1.0)

    @property
    def step(self) -> float:
        """A small loosening [SI]: a tenth of its limit, or a hundredth of its unit."""
        if self.demanded.limit:
            return 0.1 * self.demanded.limit
        return 0.01 * self.unit[1]

    def __call__(self, z: Any, parameters: Parameters) -> list[Any]:
        """Return the CVXPY constraints."""
        return self.loosened(z, parameters)

    def loosened(self, z: Any, parameters: Parameters, by: Any = None) -> list[Any]:
        """Return the CVXPY constraints with limits that are larger by a number or expression [SI]."""
        E, f, size = self._sums(arguments_of(z, parameters))
        count, together, n = E.shape
        E, f = E / size[:, None, None], f / size[:, None]
        value = E.reshape(count * together, n) @ z + f.ravel()
        kind = self.demanded.kind
        if by is None and kind == "equal":
            return [value == 0]
        limit = self.demanded.limit / size
        if by is not None:
            limit = limit + by / size
        if kind in ("norm", "move"):
            return [cp.norm(cp.reshape(value, (count, together), order="C"), 2, axis=1) <= limit]
        if kind == "most":
            return [value <= limit]
        return [value <= limit, -value <= limit]

    def price(self, multipliers: Array, parameters: Parameters) -> float:
        """Return the shadow price: the decrease of the objective per unit of loosening of all limits [1 / SI]."""
        size = self._sums(arguments_of(None, parameters))[2]
        return float(np.abs(multipliers) @ (1 / np.tile(size, len(multipliers) // len(size))))

    def slack(self, z: Array, parameters: Parameters) -> float:
        """Return the slack of z (n,) [SI]; for an equality the negative violation."""
        E, f, _ = self._sums(arguments_of(None, parameters))
        value = E @ z + f
        if self.demanded.kind == "most":
            return float(-np.max(value))
        return self.demanded.limit - float(np.max(np.linalg.norm(value, axis=1)))

    def scale(self, parameters: Parameters) -> float:
        """Return the change [SI] of the constrained quantity for deviations of the prior scale."""
        return float(np.max(self._sums(arguments_of(None, parameters))[2]))

    def names(self, parameters: Parameters) -> list[str]:
        """Return the identified parameters in the constraint."""
        used = np.any(self._sums(arguments_of(None, parameters))[0], axis=(0, 1)).tolist()
        return [name for name, own in zip(parameters.names, used, strict=True) if own]

    def require_near(self, parameters: Parameters) -> None:
        """Refuse a constraint that the nominal robot violates by far more than the prior scales."""
        missed = -self.slack(np.zeros(len(parameters)), parameters)
        if missed > FAR * self.scale(parameters):
            unit, si = self.unit
            accepted = "a value near nominal; 'nominal' refers to the nominal value"
            raise self._wrong(f"a constraint that the nominal parameters violate by {missed / si:.4g} {unit}", accepted)

    def _wrong(self, found: str, accepted: str) -> InputError:
        return InputError(f"constraint {self.name}", found, accepted)

    def _sums(self, p: Arguments) -> tuple[Array, Array, Array]:
        """Return sums E z + f [SI], (K, k, n) and (K, k), of which k together are to be small, and sizes (K,) of E."""
        if self.demanded.kind == "move":
            known = {place.name: place for place in self.where}
            q: list[Array] = []  # joint values (N, dof) at which movements are bounded
            for name in self.demanded.places:
                if name not in (*known, WORKSPACE):
                    raise self._wrong(f"place '{name}'", choices(name, [*known, WORKSPACE]))
                numbers = np.array(known[name].numbers) if name in known else None
                if numbers is None or known[name].is_box:
                    numbers = bounding(problem_of(p), numbers, p.at)
                q.append(numbers)
            problem = problem_of(p)  # deviations of frames are no property of the robot: `moved` leaves them out
            movements = [moved(problem, np.concatenate(q), marker, at=p.at) for marker in markers(problem)]
            slope = np.concatenate([each.slope for each in movements]) * p.scale
            position = np.concatenate([each.position for each in movements])
            size = np.linalg.norm(slope, axis=(1, 2))
            moving = size > 0
            if not moving.any():
                raise self._wrong("no identified parameter that moves the tool", "parameters of the robot")
            return slope[moving], position[moving], size[moving]
        rows = [row for each in self.demanded.sums for row in self._rows(each, p)]
        E, f = np.array([[row] for row, _ in rows]), np.array([[constant] for _, constant in rows])
        size = np.linalg.norm(E[:, 0], axis=1)
        if self.demanded.kind == "norm":
            E, f, size = E.swapaxes(0, 1), f.T, np.array([np.max(size)])
        if not (size > 0).all():
            raise self._wrong("no identified parameter", "identified parameters: " + ", ".join(p.names[:24]))
        return E, f, size

    def _rows(self, found: Sum, p: Arguments) -> Iterator[tuple[Array, float]]:
        """Yield a sum as a row (n,) and a number [SI], once for every identified parameter that matches its pattern.

        Parameters that are not identified have their nominal values.
        """
        table = p if p.problem is None else p.problem.parameters
        unit = self.demanded.unit
        patterns = [name for name in found.names if name not in table.names]
        matched = [""]
        if patterns:
            every = [table.names[i] for i in places(table.names, patterns[0], f"constraint {self.name}")]
            if len(patterns) > 1:
                raise self._wrong(f"patterns {' and '.join(patterns)}", "one pattern in a sum")
            matched = [name for name in every if name in p.names]
            if not matched:
                raise self._wrong(f"'{patterns[0]}'", "identified parameters: " + choices(patterns[0], p.names))
        for instead in matched:
            names = [instead if name in patterns else name for name in found.names]
            index = [table.names.index(name) for name in names]
            dimensions = sorted({table.dimensions[i] for i in index})
            if len(dimensions) > 1:
                raise self._wrong(f"a sum of {' and '.join(dimensions)}", "parameters of one dimension")
            if unit and UNITS[unit].dimension != dimensions[0]:
                raise self._wrong(f"unit {unit} for what is not {UNITS[unit].dimension}", f"a unit of {dimensions[0]}")
            row, constant = np.zeros(len(p)), found.constant
            for name, i, factor in zip(names, index, found.factors, strict=True):
                if name in p.names:
                    row[p.names.index(name)] += factor * p.scale[p.names.index(name)]
                if found.nominal:
                    continue
                if table.of_frames[i] and table.periodic[i] and table.nominal[i] != 0:  # then deviations are rotations
                    what = f"the value of '{name}', an angle of a rotated frame"
                    raise self._wrong(what, "its deviation: '= nominal +- 0.1 mrad'")
                constant += factor * table.nominal[i]
            yield row, constant


def parse(text: str, where: Mapping[str, Any] | None = None) -> Parsed:
    """Parse a constraint on parameter values with units, or a limit on the robot's movement.

    ::

        d2 + d3 = 850.00 +- 0.05 mm       |d2 + d3 - 850 mm| <= 0.05 mm; = without +- is an equality
        |a2 - a3| <= 0.1 mm               |a? - nominal| <= 0.2 mm, for every a
        alpha2 >= 89.9 deg                89.9 deg <= alpha2 <= 90.1 deg
        d5 = nominal +- 0.1 mm            on the deviation
        norm(tool_x - 10 mm, tool_y) <= 0.05 mm
        move at most 5 mm: workspace      |p(q; x) - p(q; 0)| at every q of a place

    Parameters that are not identified have their nominal values. Movements are caused by the robot's own parameters,
    not by frames: linearized about the solution, at 64 configurations of a box or of all joint ranges (``workspace``).

    ``where`` maps places to joint values (dof,) or (N, dof) [rad or m], or to a box ``{"x": (low, high), "y": ..., "z":
    ...}`` [m] in the robot's base frame. InputError for anything else, units that do not fit and constraints that are
    not convex, and, once the program is posed, for unknown parameters. The text is parsed, never evaluated.

    >>> import cvxpy as cp
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> statements = ("a3 + a4 = 824.0 +- 0.5 mm", "|theta4| <= 1 mrad", "move at most 2 mm: home")
    >>> demands = [ro.constraints.parse(text, {"home": np.zeros(6)}) for text in statements]
    >>> stated = ro.Formulation("as stated", penalty=cp.sum_squares, constraints=demands)
    >>> result = ro.calibrate(ro.load("paper_arm").problem, stated, weight=1.0)
    >>> for price in result.shadow_prices:
    ...     print(f"{price.text}: {price.multiplier:.2f} a {price.unit}")
    a3 + a4 = 824.0 +- 0.5 mm: 68.85 a mm
    |theta4| <= 1 mrad: 2.88 a mrad
    move at most 2 mm: home: 131.04 a mm
    """
    from rpim_opt.convex.constraint_parser import sentence  # texts are parsed where there are any

    if where is not None and not isinstance(where, Mapping):
        raise InputError("parse", f"places as {type(where).__name__}", "{'home': [0, ...]}, by name")
    demanded = sentence(text)
    named = tuple(
        _place(name, configuration) for name, configuration in (where or {}).items() if name in demanded.places
    )
    return Parsed(text.strip(), demanded, named)


def _place(name: str, stated: Any) -> Place:
    accepted = "joint values (N, dof) [rad or m], or a box {'x': (low, high), 'y': ..., 'z': ...} [m]"
    is_box = isinstance(stated, Mapping)
    if is_box:
        if set(stated) != set(BOX):
            raise InputError(f"place '{name}'", f"a box of {', '.join(map(str, stated))}", accepted)
        stated = [stated[axis] for axis in BOX]
    try:
        numbers = np.atleast_2d(np.asarray(stated, dtype=float))
    except (TypeError, ValueError):
        raise InputError(f"place '{name}'", repr(stated)[:60], accepted) from None
    if numbers.ndim != 2 or not np.isfinite(numbers).all():
        raise InputError(f"place '{name}'", "numbers that are not finite, or of another shape", accepted)
    if is_box and (numbers.shape != (3, 2) or (numbers[:, 0] >= numbers[:, 1]).any()):
        raise InputError(f"place '{name}'", "a box whose sides are not (low, high)", accepted)
    return Place(name, is_box, tuple(map(tuple, numbers.tolist())))
