"""Linear Gaussian statements about parameters: combinations, distributions, an earlier posterior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.units import UNITS, display, split_unit
from rpim_opt.convex.constraints import matching
from rpim_opt.convex.program import Program
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.linear import LinearModel
from rpim_opt.robot.parameters import Parameters

FAR = 100.0
"""Expected sizes by which a stated value may differ from nominal: beyond, its unit or its meaning is wrong."""


@dataclass(frozen=True)
class Statement:
    """Rows (v - reference) ~ N(values, I), where v are values of parameters, or their deviations.

    Parameters
    ----------
    names, dimensions
        (p) parameters that it speaks of, and what they are.
    rows
        (k, p) whitened [1 / SI].
    values
        (k,) whitened.
    reference
        (p,) [SI] from which the parameters' values count; None: from nominal, whatever that is.
    whole
        Whether it is the whole prior of these parameters: it stands in the place of their own scales, and says
        what it says of some of them where others are not identified. Otherwise those that are not identified are
        nominal.
    text
        As a person wrote it.
    """

    names: tuple[str, ...]
    dimensions: tuple[str, ...]
    rows: tuple[tuple[float, ...], ...]
    values: tuple[float, ...]
    reference: tuple[float, ...] | None = None
    whole: bool = False
    text: str = ""

    @property
    def where(self) -> str:
        """What an error calls it."""
        return f"prior '{self.text}'"

    def on(self, parameters: Parameters) -> tuple[Array, Array, np.ndarray]:
        """Return rows (k, n) and values (k,) in units of the scales of the n identified parameters, and whom it serves.

        Parameters
        ----------
        parameters
            The whole table of a problem.

        Raises
        ------
        InputError
            For a name that the table has not, another dimension, a value far from nominal.
        """
        here = self._here(parameters)
        known = [name for name in self.names if name in here]
        place = np.array([here[name] for name in known], dtype=int)
        own = np.array([self.names.index(name) for name in known], dtype=int)
        offset = self._offset(parameters, place, own)
        free = parameters.identified[place]
        rows = np.array(self.rows, dtype=float).reshape(len(self.values), len(self.names))
        values = np.array(self.values, dtype=float)
        if self.whole:
            rows, values = marginal(rows, values, own[free])
        else:
            values = values - rows[:, own] @ offset
            rows = rows[:, own[free]]
        return self._placed(parameters, rows, values, place[free], offset[free])

    def _placed(
        self, parameters: Parameters, rows: Array, values: Array, place: np.ndarray, offset: Array
    ) -> tuple[Array, Array, np.ndarray]:
        """Return rows of the places of a table as rows of the identified ones, in units of their scales."""
        if self.whole:
            values = values - rows @ offset
        column = np.cumsum(parameters.identified) - 1
        n = len(parameters.free)
        full = np.zeros((len(rows), n))
        full[:, column[place]] = rows * parameters.scale[place]
        served = np.zeros(n, dtype=bool)
        served[column[place]] = True
        says = full.any(axis=1)
        return full[says], values[says], served & self.whole

    def _here(self, parameters: Parameters) -> dict[str, int]:
        """Return the places of a table, names and dimensions checked."""
        here = {name: i for i, name in enumerate(parameters.names)}
        missing = [name for name in self.names if name not in here]
        if missing and (not self.whole or len(missing) == len(self.names)):
            raise InputError(self.where, f"'{missing[0]}'", "parameters: " + choices(missing[0], parameters.names))
        stated = [each for each in zip(self.names, self.dimensions, strict=True) if each[0] in here]
        have = [parameters.dimensions[here[name]] for name, _ in stated]
        for (name, said), dimension in zip(stated, have, strict=True):
            if said not in (dimension, ""):
                raise InputError(self.where, f"a unit of {said} for '{name}'", f"one of {dimension}")
        if len(set(have)) > 1 and any(said == "" for _, said in stated):
            raise InputError(self.where, f"a sum of {' and '.join(sorted(set(have)))}", "parameters of one dimension")
        return here

    def _offset(self, parameters: Parameters, place: np.ndarray, own: np.ndarray) -> Array:
        """Return by how much nominal values (p,) [SI] differ from the reference; zero where that is nominal."""
        if self.reference is None:
            return np.zeros(len(place))
        offset = parameters.nominal[place] - np.array(self.reference)[own]
        if self.whole:
            self._turned(parameters.take(place), offset)
            return offset
        rows = np.array(self.rows)[:, own]
        far = np.array(self.values) - rows @ offset
        room = FAR * (1 + np.linalg.norm(rows * parameters.scale[place], axis=1))
        if (np.abs(far) > room).any():
            norms = np.linalg.norm(rows, axis=1)
            size = float(np.max(np.abs(far) / np.where(norms > 0, norms, 1.0)))
            unit, si = display(parameters.dimensions[place[0]])
            found = f"a value {size / si:.4g} {unit} off nominal"
            raise InputError(self.where, found, "one near it; '= nominal +- ...' where the drawing's value is meant")
        return offset

    def _turned(self, parameters: Parameters, offset: Array) -> None:
        """Refuse angles of frames that count from another orientation: they do not add up."""
        for name, frame, angle, off in zip(
            parameters.names, parameters.of_frames, parameters.periodic, offset, strict=True
        ):
            if frame and angle and off != 0:
                found = f"'{name}' that counts from another orientation"
                raise InputError(self.where, found, "the same start of the frame; or leave out what was set up anew")


def marginal(rows: Array, values: Array, kept: np.ndarray) -> tuple[Array, Array]:
    """Return rows (k', p') and values (k',) of what a statement says of some parameters, whatever the others are.

    With the others first in a triangle, what is below their rows does not know them.
    """
    if len(kept) == rows.shape[1] and (kept == np.arange(len(kept))).all():
        return rows, values
    others = np.setdiff1d(np.arange(rows.shape[1]), kept)
    norms = np.linalg.norm(rows, axis=0)
    Q, R = np.linalg.qr(rows[:, others] / np.where(norms[others] > 0, norms[others], 1.0))
    U, s, _ = np.linalg.svd(R)
    seen = Q @ U[:, s > 1e-10 * np.max(s, initial=0.0)]
    left = rows[:, kept] - seen @ (seen.T @ rows[:, kept])
    right = values - seen @ (seen.T @ values)
    return left, right


def known(text: str, value: float | None = None, sd: float | None = None) -> Statement:
    """Return the statement that a combination of parameters has a value; arguments as for `Prior.known`."""
    from rpim_opt.convex.tolerances import combination  # texts are read where there are any

    said = combination(text)
    if said.sd is not None:
        if value is not None or sd is not None:
            raise InputError(f"prior '{text}'", "a value or sd besides", "the text alone, or value and sd [SI]")
        value, sd = said.value, said.sd
    if sd is None or not (np.isfinite(sd) and sd > 0):
        raise InputError(f"prior '{text}'", f"sd {sd}", "a standard deviation above zero: '+- 0.05 mm', or sd [SI]")
    if value is not None and not np.isfinite(value):
        raise InputError(f"prior '{text}'", f"value {value}", "a finite number [SI]")
    row = tuple(factor / sd for factor in said.factors)
    dimensions = (said.dimension,) * len(row)
    if value is None:
        return Statement(said.names, dimensions, (row,), (said.deviation / sd,), text=text.strip())
    return Statement(said.names, dimensions, (row,), (value / sd,), (0.0,) * len(row), text=text.strip())


def gaussian(mean: dict[str, float], covariance: Any, precision: Any, sd: Any) -> Statement:
    """Return the statement that deviations have a mean and a covariance; arguments as for `Prior.gaussian`."""
    given = [each is not None for each in (covariance, precision, sd)]
    if sum(given) != 1:
        raise InputError("Prior.gaussian", f"{sum(given)} of covariance, precision and sd", "one of them")
    keys = [_key(key) for key in mean]
    if not keys:
        raise InputError("Prior.gaussian", "no parameter", "mean={'a2_mm': 0.0, ...}")
    centre = np.array([float(value) for value in mean.values()])
    if not np.isfinite(centre).all():
        raise InputError("Prior.gaussian", "a mean that is not finite", "finite numbers")
    if sd is not None:
        covariance = np.diag(_vector(sd, len(keys)) ** 2)
    if precision is None:
        rows = _whitened(_square(covariance, len(keys), "covariance"))
    else:
        rows = _root(_square(precision, len(keys), "precision"))
    values = rows @ centre
    rows = rows / np.array([UNITS[unit].si for _, unit in keys])
    names = tuple(name for name, _ in keys)
    dimensions = tuple(UNITS[unit].dimension for _, unit in keys)
    return Statement(names, dimensions, listed(rows), tuple(values.tolist()), None, True, "mean and covariance")


def listed(matrix: Array) -> tuple[tuple[float, ...], ...]:
    """Return a matrix (k, p) as tuples, which are equal where their content is."""
    return tuple(tuple(row) for row in matrix.tolist())


def _key(key: str) -> tuple[str, str]:
    name, unit = split_unit(key)
    if unit is None:
        raise InputError(f"Prior.gaussian, key {key}", "no unit", f"{key}_mm, {key}_mrad, ...")
    return name, key.removeprefix(name + "_")


def _vector(sd: float | Sequence[float], count: int) -> Array:
    values = np.asarray(sd, dtype=float)
    if values.ndim > 1 or values.size not in (1, count):
        raise InputError("Prior.gaussian", f"sd of shape {values.shape}", f"a number, or {count} numbers")
    if not (np.isfinite(values).all() and (values > 0).all()):
        raise InputError("Prior.gaussian", "an sd that is not above zero", "finite numbers above zero")
    return np.broadcast_to(values.ravel(), (count,))


def _square(matrix: Any, count: int, what: str) -> Array:
    found = np.asarray(matrix, dtype=float)
    if found.shape != (count, count):
        raise InputError("Prior.gaussian", f"{what} of shape {found.shape}", f"({count}, {count})")
    if not np.isfinite(found).all() or not np.allclose(found, found.T, rtol=1e-9, atol=0):
        raise InputError("Prior.gaussian", f"a {what} that is not finite and symmetric", "one that is")
    return found


def _whitened(covariance: Array) -> Array:
    """Return W (p, p) with W C W' = I."""
    size = np.sqrt(np.maximum(np.diag(covariance), 0))
    try:
        if not (size > 0).all():
            raise np.linalg.LinAlgError
        factor = np.linalg.cholesky(covariance / np.outer(size, size))
    except np.linalg.LinAlgError:
        accepted = "one that is; [constraints] for what is known exactly, precision for what is not known at all"
        raise InputError("Prior.gaussian", "a covariance that is not positive definite", accepted) from None
    return np.linalg.inv(factor) / size


def _root(precision: Array) -> Array:
    """Return W (k, p) with W'W = P; k is less than p where nothing is known of some direction."""
    size = np.sqrt(np.maximum(np.diag(precision), 0))
    unit = np.where(size > 0, size, 1.0)
    values, vectors = np.linalg.eigh(precision / np.outer(unit, unit))
    if np.min(values) < -1e-10 * max(np.max(values), 1e-300):
        raise InputError("Prior.gaussian", "a precision with negative eigenvalues", "one that is positive semidefinite")
    kept = values > 1e-13 * np.max(values, initial=0.0)
    return (vectors[:, kept] * np.sqrt(values[kept])).T * unit


class Spread(Protocol):
    """What the covariance of a result has besides its equations and its penalty."""

    @property
    def factor(self) -> float:
        """How a robust loss weighs the equations, against squared residuals in sigmas; 1 for a squared loss."""
        ...

    @property
    def drift(self) -> Array | None:
        """(n, k) D with D D' what learned sizes and heavy tails add to the covariance [SI], or None."""
        ...


class Result(Protocol):
    """What a prior needs of an earlier result: a `Calibration` has it."""

    @property
    def problem(self) -> Source:
        """What was asked."""
        ...

    @property
    def x(self) -> Array:
        """(n,) deviations [SI]."""
        ...

    @property
    def program(self) -> Program:
        """The convex program at the solution."""
        ...

    @property
    def penalty_weight(self) -> float:
        """The weight of the penalty, zero where there is none."""
        ...

    @cached_property
    def linear(self) -> LinearModel:
        """The equations that the fit rests on."""
        ...

    @cached_property
    def noise_variance(self) -> float:
        """Of the equations, in units of the declared variance."""
        ...

    @cached_property
    def spread(self) -> Spread:
        """What the covariance rests on; InputError where there is none."""
        ...


def posterior(result: Result, inflate: float, without: Sequence[str], noise: float | None) -> Statement:
    """Return what a result says of its parameters; arguments as for `Prior.from_result`."""
    for name, value in (("inflate", inflate), ("noise", noise)):
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError(f"Prior.from_result, {name}", f"{value}", "a number above zero")
    free = result.problem.parameters.free
    A = result.linear.triangle[:, : len(free)]
    form = result.program.penalty_form
    weight = result.penalty_weight
    parts = [A / np.sqrt(_variance(result, noise))]
    if form is not None and weight > 0:
        parts.append(np.sqrt(weight / _variance(result, noise)) * form.matrix)
    kept = _kept(free, without)
    R = _triangle(np.vstack(parts))
    if result.spread.drift is not None:
        R = _widened(R, result.spread.drift / free.scale[:, None])
    rows, _ = marginal(R, np.zeros(len(free)), kept)
    rows = _triangle(rows) / (free.scale[kept] * inflate)
    return Statement(
        names=tuple(free.names[i] for i in kept),
        dimensions=tuple(free.dimensions[i] for i in kept),
        rows=listed(rows),
        values=tuple((rows @ result.x[kept]).tolist()),
        reference=tuple(free.nominal[kept].tolist()),
        whole=True,
        text="an earlier result",
    )


def of_data(result: Result, widths: Array) -> tuple[tuple[str, ...], Array, Array]:
    """Return names (p), rows (k, p) [1/SI] and values (k,) of what a result's data alone say of the robot.

    Parameters
    ----------
    result
        The calibration.
    widths
        (n,) [SI] of its parameters' deviations: those of frames count, which are integrated out.
    """
    free = result.problem.parameters.free
    sigma = np.sqrt(_variance(result, None))
    model = result.linear
    R = model.triangle / sigma
    frames = free.of_frames
    n = len(free)
    own = np.eye(n)[frames] * (free.scale / widths)[frames, None]
    rows = np.vstack([R[:, :n], own])
    values = np.concatenate([R[:, n], np.zeros(len(own))])
    robot = np.flatnonzero(~frames)
    rows, values = marginal(rows, values, robot)
    both = _triangle(np.column_stack([rows, values]))
    names = tuple(free.names[i] for i in robot)
    p = len(robot)
    return names, both[:p, :p] / free.scale[robot], both[:p, p]


def _variance(result: Result, noise: float | None) -> float:
    """Return the variance of the equations' noise, in units of the declared one, as the loss weighs them."""
    factor = result.spread.factor
    if noise is not None:
        return noise**2 * factor
    return result.noise_variance * factor


def _widened(R: Array, D: Array) -> Array:
    """Return rows (n, n) of the precision that belongs to (R'R)^-1 + D D'."""
    moved = R @ D
    L = np.linalg.cholesky(np.eye(len(R)) + moved @ moved.T)
    return np.asarray(np.linalg.solve(L, R), dtype=float)


def _kept(free: Parameters, without: Sequence[str]) -> np.ndarray:
    if isinstance(without, str):
        without = without.split()
    if not without:
        return np.arange(len(free))
    kept = np.flatnonzero(~matching(free, without, "Prior.from_result, without"))
    if not len(kept):
        raise InputError("Prior.from_result, without", "every parameter", "patterns that leave some")
    return kept


def _triangle(rows: Array) -> Array:
    """Return R with R'R = rows' rows, square."""
    n = rows.shape[1]
    R: Any = np.linalg.qr(np.vstack([rows, np.zeros((max(n - len(rows), 0), n))]), mode="r")
    return R
