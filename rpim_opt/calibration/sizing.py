"""Sizes and deviations that agree with each other: evidence and relinearization in turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.phases import phase
from rpim_opt.calibration.loop import nearby, require_finite
from rpim_opt.convex.evidence import Believed, Evidence, Linearized, Point, alike
from rpim_opt.convex.formulation import tikhonov
from rpim_opt.convex.prior import BASE, Prior
from rpim_opt.convex.stated import Stated
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.scatter import Scatter
from rpim_opt.robot.parameters import Parameters

FEW = 60
"""Configurations up to which the evidence may have several optima, and is climbed from several sides."""
SAME_SIZE, SAME_PLACE = 0.02, 0.01
"""Sizes are found when their logarithms change by no more, and deviations by no more of their scales (RMS)."""
CLOSE = 0.1
"""Scales (RMS) up to which the mean at one linearization stands for a fit."""
NEAR, STEPS = 1e-3, 6
"""Tolerance of the fits in between, and steps of the first, twice as many in every later one: the first sizes change
soon, and the last fit is exact."""
DISTINCT = 0.3
"""Logarithms of sizes by which two optima differ."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A problem with sizes laid into it, and where it was linearized.

    Parameters
    ----------
    problem
        With its stated scales.
    evidence, point, others
        The last evidence, its optimum, and others that were come to from other sides.
    laid
        The problem with local scales and scatter: ordinary Tikhonov at weight 1.
    x
        (n,) its solution [SI].
    """

    problem: CalibrationProblem
    evidence: Evidence
    point: Point
    others: Sequence[Point]
    laid: CalibrationProblem
    x: Array

    @property
    def several(self) -> bool:
        """Whether the evidence has other optima."""
        return any(np.abs(other.logs - self.point.logs).max() > DISTINCT for other in self.others)

    @property
    def spare(self) -> float:
        """Which part of the equations is left over for the noise."""
        used = float(np.sum(1 - np.diag(self.point.C) / self.point.v))
        return 1 - used / len(self.evidence.data.y)

    @property
    def covariance(self) -> Array:
        """Covariance (n, n) of the deviations [SI]."""
        unit = self.laid.parameters.free.scale / np.sqrt(self.point.v)
        return self.point.C * np.outer(unit, unit)


@dataclass(frozen=True, eq=False)
class Learning:
    """What stays the same while sizes are learned.

    Parameters
    ----------
    prior
        What is believed of the deviations.
    noise
        Parts of the scatter that are looked for, where the data have such equations.
    """

    prior: Prior
    noise: tuple[str, ...]

    @cached_property
    def _told(self) -> dict[int, tuple[Parameters, Stated]]:
        return {}

    def stated(self, problem: CalibrationProblem) -> Stated:
        """Return what the prior says of a problem's parameters, in units of their stated scales; asked once a table."""
        table = problem.parameters
        if id(table) not in self._told:
            self._told[id(table)] = (table, self.prior.stated(table))  # the table is kept, so that its id is its own
        return self._told[id(table)][1]

    def evidence(self, problem: CalibrationProblem, x: Array) -> Evidence:
        """Return the evidence of a linearization at x (n,) [SI]."""
        free = problem.parameters.free
        stated = self.stated(problem)
        residual, jacobian = problem.slopes(x)
        J = problem.contrasts(jacobian)
        y = problem.contrasts(residual[:, None])[:, 0] + J @ x
        require_finite(J, y)
        unit = free.scale * stated.scale
        stacks = problem.stacks(joints="joint" in self.noise, at=_values(problem, x))
        data = Linearized(J * unit, y - J @ (free.scale * stated.centre), stacks)
        heavy = np.isin(np.arange(len(stated.names)), stated.group[stated.heavy])
        base = np.array([name == BASE for name in stated.names], dtype=bool)
        believed = Believed(
            group=stated.group,
            heavy=stated.heavy,
            names=stated.names,
            covariance=alike(heavy, base),
            tails=self.prior.tails,
            replaced=stated.replaced,
            rows=stated.rows * stated.scale,
            values=stated.values - stated.rows @ stated.centre,
        )
        return Evidence(data, believed, self._kinds(data), problem.scatter or Scatter())

    def _kinds(self, data: Linearized) -> tuple[str, ...]:
        """Return the parts of the scatter that the equations have."""
        have = {"instrument"}
        if any(stack.positional for stack in data.stacks):
            have |= {"position", "joint"}
        if any(stack.angle.any() for stack in data.stacks):
            have.add("orientation")
        return tuple(kind for kind in self.noise if kind in have)

    def fitted(self, problem: CalibrationProblem, x: Array, before: Array | None, rounds: int) -> Fit:
        """Return sizes and deviations that agree with each other.

        Parameters
        ----------
        problem
            Without what is to be learned.
        x
            (n,) where to begin [SI].
        before
            Logarithms of sizes to begin with, or None.
        rounds
            How often the evidence is asked.
        """
        fit = self._once(problem, x, before, before is None, STEPS)
        for k in range(1, rounds):
            again = self._once(problem, fit.x, fit.point.logs, k == 1 and fit.several, STEPS * 2**k)
            moved = _moved(again.x, fit.x, again.laid)
            resized = np.abs(again.point.logs - fit.point.logs).max()
            fit = replace(again, others=again.others or fit.others)
            if resized <= SAME_SIZE and moved <= SAME_PLACE:
                break
        return fit

    def _once(self, problem: CalibrationProblem, x: Array, known: Array | None, several: bool, steps: int) -> Fit:
        """Return sizes at one linearization, from known ones (s,) and from several sides, and what they lead to."""
        evidence = self.evidence(problem, x)
        starts = [] if known is None else [known]
        if several:
            starts += sides(problem, evidence)
        with phase("selection"):
            point, *others = evidence.mode(starts)
        laid = self.laid(problem, evidence, point, x)
        stated = self.stated(problem)
        mean = problem.parameters.free.scale * (stated.centre + stated.scale * point.z)
        if _moved(mean, x, laid) > CLOSE:  # too far for one linearization
            penalized = self.prior.penalized(tikhonov, self.inside(problem, point))
            mean = nearby(laid, penalized, 1.0, x, NEAR, steps)
        return Fit(problem, evidence, point, others, laid, mean)

    def widths(self, problem: CalibrationProblem, point: Point) -> Array:
        """Return by what the scales of the identified parameters are multiplied, (n,)."""
        return self.stated(problem).scale * np.sqrt(point.v)

    def inside(self, problem: CalibrationProblem, point: Point) -> Stated:
        """Return what the prior says of the parameters at the scales that were learned."""
        return self.stated(problem).inside(self.widths(problem, point))

    def laid(self, problem: CalibrationProblem, evidence: Evidence, point: Point, x: Array) -> CalibrationProblem:
        """Return the problem with what was learned in it: local scales, and the robot's scatter."""
        p = problem.parameters
        scale = p.scale.copy()
        scale[p.identified] *= self.widths(problem, point)
        scatter = replace(evidence.scatter(point.logs), at=_values(problem, x))
        return replace(problem, parameters=replace(p, scale=scale), scatter=scatter)


def _moved(x: Array, before: Array, laid: CalibrationProblem) -> float:
    """Return by how many of their scales deviations (n,) moved, RMS."""
    return float(np.sqrt(np.mean(((x - before) / laid.parameters.free.scale) ** 2)))


def sides(problem: CalibrationProblem, evidence: Evidence) -> list[Array]:
    """Return where its optimum is looked for: from several sides where configurations are few."""
    starts = evidence.starts()
    if len(np.unique(problem.data.configuration)) <= FEW:
        return starts
    return starts[:1]


def _values(problem: CalibrationProblem, x: Array) -> Array:
    """Return the values (P,) of all parameters at deviations x (n,)."""
    p = problem.parameters
    values = p.nominal.copy()
    values[p.identified] = p.free.values(x)
    return values
