"""Constraints in the words of a drawing: linear, absolute values, norms, tolerances, and predicted movements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.units import UNITS
from rpim_opt.convex.atoms import cp
from rpim_opt.convex.given import Given, every_movement, given, machine_of, places, whole
from rpim_opt.problem.workspace import within_box, within_ranges
from rpim_opt.robot.parameters import Parameters

if TYPE_CHECKING:
    from rpim_opt.convex.sentence import Sentence, Sum

WORKSPACE, BOX = "workspace", ("x", "y", "z")
"""The place that every robot has, all its joint ranges; and what a box is given by."""
FAR = 100.0
"""Expected sizes by which a nominal robot may miss a statement: beyond, its unit or its meaning is wrong."""
Rows = tuple[tuple[float, ...], ...]


class Place(NamedTuple):
    """Named joint values (N, dof) [rad or m], or a box (3, 2) [m] in the robot's base frame."""

    name: str
    is_box: bool
    numbers: Rows


class _Affine(NamedTuple):
    """E z + f (k,) [SI], and how large the rows of E (k, n) are; of `move` E is (3 k, n)."""

    E: Array
    f: Array
    size: Array


@dataclass(frozen=True)
class Drawn:
    """A constraint that `parse` read: a function of z and the identified parameters.

    Parameters
    ----------
    text
        As a person wrote it.
    demanded
        What it demands.
    where
        Places that it names.
    """

    text: str
    demanded: Sentence
    where: tuple[Place, ...] = ()

    @property
    def name(self) -> str:
        """What errors and reports call it."""
        return f"'{self.text}'"

    @property
    def stated(self) -> list[Any]:
        """The maker's name and its arguments, as a file holds them."""
        if not self.where:
            return ["parse", self.text]
        return ["parse", self.text, {place.name: _as_stated(place) for place in self.where}]

    @property
    def unit(self) -> tuple[str, float]:
        """The unit in which it was written, and its size [SI]."""
        name = self.demanded.unit
        if not name:
            return "SI", 1.0
        return name, UNITS[name].si

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
        made = self._affine(given(z, parameters))
        size, kind = made.size, self.demanded.kind
        value = (made.E / self._by_row(size)[:, None]) @ z + made.f / self._by_row(size)
        if by is None and kind == "equal":
            return [value == 0]
        room = self.demanded.limit / size
        if by is not None:
            room = room + by / size
        if kind == "move":
            return [cp.norm(cp.reshape(value, (len(size), 3), order="C"), 2, axis=1) <= room]
        if kind == "norm":
            return [cp.norm(value) <= room]
        if kind == "most":
            return [value <= room]
        return [value <= room, -value <= room]

    def price(self, multipliers: Array, parameters: Parameters) -> float:
        """Return by how much the objective falls for every unit [1 / SI] by which all limits are loosened."""
        size = self._affine(given(None, parameters)).size
        share = 1 / np.tile(size, len(multipliers) // len(size))
        return float(np.abs(multipliers) @ share)

    def room(self, z: Array, parameters: Parameters) -> float:
        """Return how far z (n,) is from the limit [SI]; zero for an equality."""
        made = self._affine(given(None, parameters))
        value = made.E @ z + made.f
        demanded = self.demanded
        if demanded.kind == "equal":
            return 0.0
        if demanded.kind == "most":
            return float(-np.max(value))
        if demanded.kind == "within":
            return demanded.limit - float(np.max(np.abs(value)))
        return demanded.limit - float(np.max(np.linalg.norm(value.reshape(len(made.size), -1), axis=1)))

    def scale(self, parameters: Parameters) -> float:
        """Return by how much [SI] deviations of their expected sizes change what is demanded."""
        return float(np.max(self._affine(given(None, parameters)).size))

    def names(self, parameters: Parameters) -> list[str]:
        """Return the identified parameters that it speaks of."""
        E = self._affine(given(None, parameters)).E
        return [name for i, name in enumerate(parameters.names) if E[:, i].any()]

    def require_near(self, parameters: Parameters) -> None:
        """Refuse a statement that the nominal robot misses by far more than the expected sizes."""
        made = self._affine(given(None, parameters))
        missed = -self.room(np.zeros(len(parameters)), parameters)
        if self.demanded.kind == "equal":
            missed = float(np.max(np.abs(made.f)))
        if missed > FAR * float(np.max(made.size)):
            unit, si = self.unit
            accepted = "one near it; 'nominal' where the drawing's value is meant"
            raise self._wrong(f"a demand that nominal misses by {missed / si:.4g} {unit}", accepted)

    # --- what it is on some parameters ------------------------------------------------------------------------

    def _wrong(self, found: str, accepted: str) -> InputError:
        return InputError(f"constraint {self.name}", found, accepted)

    def _by_row(self, size: Array) -> Array:
        """Return sizes a row of E, of which movements have three each, and a norm all together one."""
        if self.demanded.kind == "move":
            return np.repeat(size, 3)
        return size

    def _affine(self, p: Given) -> _Affine:
        """Return what is demanded to be small, of these parameters."""
        if self.demanded.kind == "move":
            found = every_movement(p, self._configurations(p))
            size = np.linalg.norm(found.slope, axis=(1, 2))
            if not size.any():
                raise self._wrong("no identified parameter that moves the tool", "parameters of the robot")
            moving = size > 0
            E = found.slope[moving].reshape(-1, len(p))
            return _Affine(E, found.position[moving].ravel(), size[moving])
        E, f = self._sums(p)
        size = np.linalg.norm(E, axis=1)
        if self.demanded.kind == "norm":
            size = np.array([np.max(size)])
        if not (size > 0).all():
            raise self._wrong("no identified parameter", "identified parameters: " + ", ".join(p.names[:24]))
        return _Affine(E, f, size)

    def _sums(self, p: Given) -> tuple[Array, Array]:
        """Return the sums E z + f [SI], those of patterns one a parameter."""
        E: list[Array] = []
        f: list[float] = []
        for each in self.demanded.sums:
            for one in self._expanded(each, p):
                row, constant = self._row(one, p)
                E.append(row)
                f.append(constant)
        return np.array(E), np.array(f)

    def _expanded(self, found: Sum, p: Given) -> list[Sum]:
        """Return a sum for every parameter that its pattern matches."""
        names = whole(p).names
        patterns = [name for name in found.names if name not in names]
        if not patterns:
            return [found]
        matched = [names[i] for i in places(names, patterns[0], f"constraint {self.name}")]
        if len(patterns) > 1:
            raise self._wrong(f"patterns {' and '.join(patterns)}", "one pattern in a sum")
        known = [name for name in matched if name in p.names]
        own = [found.names.index(patterns[0])]
        made: list[Sum] = []
        for name in known:
            instead = tuple(name if i in own else other for i, other in enumerate(found.names))
            made.append(replace(found, names=instead))
        if not made:
            raise self._wrong(f"'{patterns[0]}'", "identified parameters: " + choices(patterns[0], p.names))
        return made

    def _row(self, found: Sum, p: Given) -> tuple[Array, float]:
        """Return one sum as a row (n,) and a number [SI]; parameters that are not identified are nominal."""
        table = whole(p)
        index = [table.names.index(name) for name in found.names]
        self._require_dimension([table.dimensions[i] for i in index])
        row = np.zeros(len(p))
        constant = found.constant
        for name, i, factor in zip(found.names, index, found.factors, strict=True):
            if name in p.names:
                row[p.names.index(name)] += factor * p.scale[p.names.index(name)]
            if found.nominal == 0:
                self._require_additive(table, i)
                constant += factor * table.nominal[i]
        return row, constant

    def _require_dimension(self, dimensions: Sequence[str]) -> None:
        if len(set(dimensions)) > 1:
            raise self._wrong(f"a sum of {' and '.join(sorted(set(dimensions)))}", "parameters of one dimension")
        unit = self.demanded.unit
        if unit and UNITS[unit].dimension != dimensions[0]:
            raise self._wrong(f"unit {unit} for what is no {UNITS[unit].dimension}", f"a unit of {dimensions[0]}")

    def _require_additive(self, table: Parameters, i: int) -> None:
        """Refuse values of a turned frame's angles: its deviations are rotations, which do not add up to them."""
        if table.of_frames[i] and table.periodic[i] and table.nominal[i] != 0:
            found = f"the value of '{table.names[i]}', an angle of a turned frame"
            raise self._wrong(found, "its deviation: '= nominal +- 0.1 mrad'")

    def _configurations(self, p: Given) -> Array:
        """Return the joint values (N, dof) at which movements are bounded."""
        known = {place.name: place for place in self.where}
        q: list[Array] = []
        for name in self.demanded.places:
            if name in known:
                q.append(_at(known[name], p))
            elif name == WORKSPACE:
                q.append(within_ranges(machine_of(p)))
            else:
                raise self._wrong(f"place '{name}'", choices(name, [*known, WORKSPACE]))
        return np.concatenate(q)


def _at(place: Place, p: Given) -> Array:
    numbers = np.array(place.numbers)
    if place.is_box:
        return within_box(machine_of(p), numbers[:, 0], numbers[:, 1])
    return numbers


def _as_stated(place: Place) -> Any:
    if place.is_box:
        return {axis: list(side) for axis, side in zip(BOX, place.numbers, strict=True)}
    return [list(row) for row in place.numbers]


def parse(text: str, where: Mapping[str, Any] | None = None) -> Drawn:
    """Return a constraint in the words of a drawing: values of parameters with units, or how far the robot may move.

    ::

        d2 + d3 = 850.00 +- 0.05 mm       |d2 + d3 - 850 mm| <= 0.05 mm; = without +- is an equality
        |a2 - a3| <= 0.1 mm               |a? - nominal| <= 0.2 mm, one for every a
        alpha2 >= 89.9 deg                89.9 deg <= alpha2 <= 90.1 deg
        d5 = nominal +- 0.1 mm            of the deviation
        norm(tool_x - 10 mm, tool_y) <= 0.05 mm
        move at most 5 mm: workspace      |p(q; x) - p(q; 0)| at every q of a place

    Parameters that are not identified are nominal. A movement is that of the robot's own parameters, not of frames,
    at 64 configurations of a box or of all joint ranges (``workspace``); to first order about the solution.

    Parameters
    ----------
    text
        The statement: it is parsed, and never evaluated.
    where
        Places by name: joint values (dof,) or (N, dof) [rad or m], or a box ``{"x": (low, high), "y": ..., "z": ...}``
        [m] in the robot's base frame.

    Raises
    ------
    InputError
        For anything else, units that do not fit, demands that are not convex; when it is posed, for names that the
        problem has not.

    Examples
    --------
    >>> import cvxpy as cp
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> statements = ("a3 + a4 = 824.0 +- 0.5 mm", "|theta4| <= 1 mrad", "move at most 2 mm: home")
    >>> drawing = [ro.constraints.parse(text, {"home": np.zeros(6)}) for text in statements]
    >>> stated = ro.Formulation("as drawn", penalty=cp.sum_squares, constraints=drawing)
    >>> result = ro.calibrate(ro.load("paper_arm").problem, stated, weight=1.0)
    >>> for price in result.prices:
    ...     print(f"{price.text}: {price.multiplier:.2f} a {price.unit}")
    a3 + a4 = 824.0 +- 0.5 mm: 68.85 a mm
    |theta4| <= 1 mrad: 2.88 a mrad
    move at most 2 mm: home: 131.04 a mm
    """
    from rpim_opt.convex.sentence import sentence  # a drawing says something of few robots

    if where is not None and not isinstance(where, Mapping):
        raise InputError("parse", f"places as {type(where).__name__}", "{'home': [0, ...]}, by name")
    demanded = sentence(text)
    named = tuple(_place(name, stated) for name, stated in (where or {}).items() if name in demanded.places)
    return Drawn(text.strip(), demanded, named)


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
