"""Variance components of a problem: prior scales and noise by marginal likelihood, alternated with relinearization."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.phases import phase
from rpim_opt.basics.shown import Brief
from rpim_opt.basics.text import joined
from rpim_opt.bayes.evidence import FARTHEST, Believed, Evidence, Linearized, Point, alike
from rpim_opt.bayes.prior import BASE, SESSIONS, Prior
from rpim_opt.bayes.prior_terms import Stated
from rpim_opt.convex.formulation import Formulation, tikhonov
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.scatter import Scatter
from rpim_opt.robot.parameters import Parameters


class Size(NamedTuple):
    """A size: of a group of deviations over their scales, or of a part of the noise [m or rad].

    ``spread`` is the standard deviation of its natural logarithm.
    """

    value: float
    spread: float


class Trial(NamedTuple):
    """Families of a model, and -2 ln of their restricted likelihood."""

    families: tuple[str, ...]
    value: float


class LeftOut(NamedTuple):
    """A row that was left out as a blunder: its error [m or rad] over the median of all rows' errors."""

    label: str
    ratio: float


@dataclass(frozen=True, eq=False, repr=False)
class Learned(Brief):
    """What the data said of the sizes of deviations and of the noise.

    Parameters
    ----------
    sizes
        Of the groups of deviations, in units of their scales.
    noise
        Of the robot's scatter: ``position`` [m], ``orientation`` and ``joint`` [rad]; ``instrument`` over the stated.
    local
        (n,) how far the data let each deviation's own scale leave that of its group; 1: as the group.
    trials
        The models that were compared, the chosen one first; empty where nothing was compared.
    value
        -2 ln of the restricted likelihood at the end.
    freedom
        Degrees of freedom of the noise's variance (Satterthwaite).
    left_out
        Rows that were left out as blunders, the worst first.
    covariance
        (s, s) of the logarithms of ``sizes`` and ``noise``.
    stated
        (n,) the scales that were stated for what is identified [SI].
    drift
        (n, s + h) by what the deviations move where the sizes are others, and where tails let them [SI]: D, with D D'
        what that adds to the covariance that ordinary Tikhonov has at the learned scales. Deviations are the same.
    added
        Parameters of families that were added to those that were to be identified.
    notes
        Sentences on how far the evidence decides.
    """

    sizes: Mapping[str, Size]
    noise: Mapping[str, Size]
    local: Array
    trials: tuple[Trial, ...]
    value: float
    freedom: float
    left_out: tuple[LeftOut, ...]
    covariance: Array
    stated: Array
    drift: Array
    added: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def _short(self) -> str:
        sizes = ", ".join(f"{name} {size.value:.3g}" for name, size in self.sizes.items())
        return f"sizes: {sizes}; {len(self.left_out)} rows left out"

    @property
    def families(self) -> tuple[str, ...]:
        """The families of the chosen model."""
        if not self.trials:
            return ()
        return self.trials[0].families

    def gain(self, family: str) -> float | None:
        """Return by how much -2 ln L falls where a family is added to the best of the models without it."""
        having = [t.value for t in self.trials if family in t.families]
        without = [t.value for t in self.trials if family not in t.families]
        if not having or not without:
            return None
        return float(min(without) - min(having))

    def unusual(self, names: tuple[str, ...], z: Array, least: float) -> list[tuple[str, float]]:
        """Return the parameters beyond so many of their group's scales, z (n,) in units of the local scales."""
        ratio = np.abs(z) * self.local
        order = np.argsort(-ratio)
        return [(names[i], float(ratio[i])) for i in order if ratio[i] > least]


def sessions_spread(learned: Learned | None) -> float:
    """Return the standard deviation of the logarithm of how far sessions lie apart; zero where no size was learned."""
    if learned is None:
        return 0.0
    return max((learned.sizes[name].spread for name in SESSIONS.values() if name in learned.sizes), default=0.0)


NEARLY, APART = 6.0, 1.0
"""By how much -2 ln L of another optimum may be worse to be named, and its logarithms of sizes must differ."""
HARDLY = 1.0
"""Standard deviation of a logarithm from which on a size of the geometry is hardly told."""


def doubts(evidence: Evidence, point: Point, others: Sequence[Point], spread: Array) -> Iterator[str]:
    """Yield sentences.

    Parameters
    ----------
    evidence, point
        And its optimum.
    others
        Optima that were come to from other sides.
    spread
        (s,) standard deviations of the logarithms of sizes.
    """
    for other in others:
        if other.value - point.value < NEARLY and np.abs(other.logs - point.logs).max() > APART:
            yield (
                "The evidence has a second optimum that is nearly as good, with sizes "
                f"{_times(other, point)} as large: more configurations would decide."
            )
            break
    if (np.abs(point.logs - evidence.centre) > FARTHEST - 0.01).any():
        yield "A size came to the edge of what is believed possible: look at units, scales and declared noise."
    vague = [i for i in evidence.believed.geometry if spread[i] > HARDLY]
    if vague:
        names = joined([evidence.believed.names[i] for i in vague])
        factor = np.exp(max(spread[vague]))
        yield f"The data hardly tell how much {names} deviate (by a factor of {factor:.1f} either way)."
    m, n = evidence.data.X.shape
    if m < n:
        yield f"{m} equations for {n} parameters: at least {n - m} directions are prior alone."


def _times(other: Point, point: Point) -> str:
    ratios = np.exp(other.logs - point.logs)
    return ", ".join(f"{ratio:.1g}" for ratio in ratios) + " times"


FEW = 60
"""Configurations up to which the evidence may have several optima, and is climbed from several sides."""
SAME_SIZE, SAME_PLACE = 0.02, 0.01
"""Sizes are found when their logarithms change by no more, and deviations by no more of their scales (RMS)."""
CLOSE = 0.1
"""Scales (RMS) up to which the mean at one linearization stands for a fit."""
STEPS = 6
"""Iterations of the first fit in between, twice as many in every later one: the first sizes change soon."""
Refit = Callable[[CalibrationProblem, Formulation, Array, int], Array]
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
    refit
        Deviations (n,) [SI] near a minimum of a formulation at weight 1, from a start, in so many iterations; without
        it the posterior mean of one linearization stands for them.
    """

    prior: Prior
    noise: tuple[str, ...]
    refit: Refit | None = None

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
        if not (np.isfinite(J).all() and np.isfinite(y).all()):
            raise InputError("data", "residuals or slopes that are not finite", "measurements and a model that are")
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
        if self.refit is not None and _moved(mean, x, laid) > CLOSE:  # too far for one linearization
            penalized = self.prior.penalized(tikhonov, self.inside(problem, point))
            mean = self.refit(laid, penalized, x, steps)
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
