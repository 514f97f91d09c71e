"""What an earlier calibration knows of its parameters: its normal posterior as a statement, and its data alone."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.constraints import matching
from rpim_opt.convex.program import Program
from rpim_opt.convex.statement import Statement, listed, marginal
from rpim_opt.problem.linear import LinearModel
from rpim_opt.robot.parameters import Parameters


class Table(Protocol):
    """What has a table of parameters: a problem."""

    @property
    def parameters(self) -> Parameters:
        """All of them."""
        ...


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
    def problem(self) -> Table:
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
