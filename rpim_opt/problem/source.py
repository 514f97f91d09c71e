"""What a calibration needs of its measurements, wherever they stand: linear models, and rows part by part."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Protocol

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.linear import LinearModel, Reweigh
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.scatter import Scatter
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import Parameters
from rpim_opt.robot.terms import Curve


class Source(Protocol):
    """A source of linear models: a `CalibrationProblem`, or measurements in parts (`PartitionedProblem`).

    Unknowns are the deviations x (n,) [SI] of the identified parameters.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> def equations(source: ro.problem.Source) -> int:
    ...     return source.linearize(0 * source.parameters.free.nominal).equations
    >>> equations(ro.load("paper_arm").problem)
    27
    """

    @property
    def robot(self) -> Robot:
        """The nominal robot."""
        ...

    @property
    def arms(self) -> Mapping[str, Robot]:
        """The nominal robots by name; ``""`` for the only one."""
        ...

    @property
    def parameters(self) -> Parameters:
        """All parameters of the model, some of them identified."""
        ...

    @property
    def data(self) -> Dataset:
        """The measurements; InputError where they are in parts and stand together nowhere."""
        ...

    @property
    def keeps_rows(self) -> bool:
        """Whether `linearize` returns the equations themselves, and not their triangle."""
        ...

    @property
    def labels(self) -> tuple[str, ...]:
        """N labels of the rows, unique."""
        ...

    def linearize(self, x: Array, reweigh: Reweigh | None = None) -> LinearModel:
        """Return the linear model around the deviations x (n,), its equations weighed by their residuals there."""
        ...

    def rows(self) -> Iterator[CalibrationProblem]:
        """Yield problems that together have all the rows; the number of a configuration occurs in one of them."""
        ...

    def sample(self) -> CalibrationProblem:
        """Return rows enough to place frames by."""
        ...

    def errors(self, x: Array, dimension: str = "length") -> Array:
        """Return the norm of every row's residual, (N,) [m or rad]."""
        ...

    def whitened_errors(self, x: Array) -> tuple[Array, np.ndarray]:
        """Return the whitened norm of every row's residual (N,), and how many equations each has (N,)."""
        ...

    def configuration_errors(self, x: Array) -> tuple[Array, np.ndarray]:
        """Return the same of every configuration, (C,) and (C,)."""
        ...

    def on(self, data: Dataset) -> CalibrationProblem:
        """Return the same problem with other measurements."""
        ...

    def with_parameters(self, parameters: Parameters) -> Source:
        """Return the same problem with another table of parameters."""
        ...

    def with_transmission(self, curves: Sequence[Curve]) -> Source:
        """Return the same problem with these transmission errors of joints identified, and no others."""
        ...

    @property
    def scatter(self) -> Scatter | None:
        """The robot's own noise; None for the instrument's alone."""
        ...

    def scattered(self, scatter: Scatter | None) -> Source:
        """Return the same problem with other noise of the robot's own, or none."""
        ...

    def identifying(self, identified: np.ndarray) -> Source:
        """Return the same problem with other parameters identified, (P,) true or false."""
        ...

    def without(self, labels: Collection[str]) -> Source:
        """Return the same problem without the rows of these labels."""
        ...

    def frozen(self) -> Source:
        """Return a copy that asks every measurement once and keeps the answer."""
        ...
