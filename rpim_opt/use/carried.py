"""A result carried on: its posterior as the prior of new readings, its noise as it was learned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import UNITS, accepted_units
from rpim_opt.bayes.prior import Prior
from rpim_opt.calibration.asking import calibrate
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.atoms import SQUARES
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.structure import Quadratic
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.linear import LinearModel
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.several import knowing_sessions
from rpim_opt.problem.source import Source
from rpim_opt.use.changes import SIZES, Missed, widths

OPEN = SIZES[-1]
"""Widths within which a parameter that changed may be: far enough that readings alone decide where they see it."""


@dataclass(frozen=True, eq=False)
class Carried:
    """How a result is carried on: its posterior as a prior, its noise as it was learned.

    Parameters
    ----------
    result
        With a squared penalty or none.
    inflate
        Factor on its standard deviations.
    """

    result: Calibration
    inflate: float = 1.0

    def problem(self, data: Dataset) -> CalibrationProblem:
        """Return the result's problem with other measurements; sessions that it does not know stand behind."""
        problem = self.result.problem
        if not isinstance(problem, CalibrationProblem):
            raise InputError("the result", "a calibration of measurements in parts", "one of measurements in memory")
        return knowing_sessions(problem.on(data))

    def start(self, problem: CalibrationProblem) -> Array:
        """Return the result's deviations (n,) [SI], zero for sessions that it does not know."""
        return np.append(self.result.x, np.zeros(len(problem.parameters.free) - len(self.result.x)))

    def widths(self, problem: Source) -> Array:
        """Return how large deviations (n,) were expected before any calibration [SI]."""
        known = self._widths
        return np.append(known, problem.parameters.free.scale[len(known) :])

    @cached_property
    def _widths(self) -> Array:
        return widths(self.result)

    def known(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return those of some parameters that the result has."""
        has = set(self.result.problem.parameters.free.names)
        return tuple(name for name in names if name in has)

    def prior(self, problem: CalibrationProblem, let_go: Sequence[str]) -> Prior:
        """Return what is known still; what was let go may be far from where it was."""
        free = problem.parameters.free
        centre = {}
        scale = {}
        x = self.start(problem)
        widths = self.widths(problem)
        for i in [free.names.index(name) for name in let_go]:
            unit = next(u for u in accepted_units(free.dimensions[i]) if UNITS[u].si == 1.0)
            centre[f"{free.names[i]}_{unit}"] = float(x[i])
            scale[f"{free.names[i]}_{unit}"] = float(OPEN * widths[i])
        released = Prior(centre=centre, scale=scale)
        if len(let_go) == len(free):
            return released
        # in units of the declared noise, as the new readings are: weight 1 then joins both
        return Prior.from_result(self.result, self.inflate, self.known(let_go), noise=1.0) & released

    def formulation(self, problem: CalibrationProblem, let_go: Sequence[str]) -> Formulation:
        """Return the result's loss and constraints with the prior as the penalty."""
        prior = self.prior(problem, let_go)
        plain = replace(self.result.formulation, penalty=SQUARES, penalty_over=None)
        return prior.penalized(plain, prior.stated(problem.parameters, widened=False))

    def calibrated(self, problem: CalibrationProblem, let_go: Sequence[str], start: Array | None) -> Calibration:
        """Return the calibration; what was learned of sizes and noise stays."""
        formulation = self.formulation(problem, let_go)
        found = calibrate(problem, formulation, 1.0, start=start)
        asked = partial(calibrate, formulation=formulation, weight=1.0)
        learned = self.result.learned
        if learned is not None:
            more = problem.parameters.free.scale[len(learned.stated) :]
            learned = replace(
                learned,
                left_out=(),
                notes=(),
                drift=np.zeros((len(found.x), 0)),  # the prior holds what was not known of the sizes
                stated=np.append(learned.stated, more),
                local=np.append(learned.local, np.ones(len(more))),
            )
        return replace(found, learned=learned, asked=asked)

    def missed(self, model: LinearModel, penalty: Quadratic) -> Missed:
        """Return what equations and a prior leave, by the noise as the result knows it."""
        return Missed(model, penalty, self.result.noise_level, self.result.freedom)
