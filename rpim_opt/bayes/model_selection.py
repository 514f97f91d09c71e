"""Selection of the model extensions that the data support, by marginal likelihood."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import combinations
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.bayes.evidence import CENTRES, Evidence, Point
from rpim_opt.bayes.hyperparameters import Estimator, Fit, Trial, sampled
from rpim_opt.bayes.outliers import clustered
from rpim_opt.bayes.prior import Prior
from rpim_opt.bayes.prior_terms import Result
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.extensions import extension_scales, model_extensions
from rpim_opt.robot.parameters import EXPANSION, frame_of, of_session, own_name, session_prefix

FIRST, SECOND, MOMENTS = "first harmonic", "second harmonic", "moments"
TURNED = {FIRST: 2.0, SECOND: 4.0}  # travel of a joint [rad] from which its harmonics are tried: less fails elsewhere
MANY = 40  # configurations from which first moments and second harmonics are compared
CANDIDATES = ((), ("gravity",), (FIRST,), ("gravity", FIRST))  # models of the arm that are compared first
FURTHER = {MOMENTS: "gravity", SECOND: FIRST}  # tried one by one, each with the extension that it needs
ARM = ("gravity", FIRST, SECOND, MOMENTS)  # extensions of the arm, in the order of reports
SESSIONS = "sessions"  # the extension by session offsets, none of the arm
WARMTH = "temperature"  # the extension by thermal expansion
CONDITIONS = (SESSIONS, WARMTH)  # extensions by measuring conditions, each tried separately
GAIN = 5.0
"""Decrease of -2 ln L over its overdispersion (QAIC, Burnham and Anderson 2002) required of a model with extensions.

None of 120 simulated arms without extensions gained 4. It holds again for sessions, and for temperature."""
LARGE = 3.0  # ln(new scale over its prior median) at which the search for an optimum starts
COMPARED = 1e-2  # derivatives of -2 ln L by ln(hyperparameters) at which models are compared
ROUNDS = 3  # linearizations at which the hyperparameters of the selected model are estimated
SPEAK = 10.0  # decrease of -2 ln L for an extension to be reported: false ones gain 4, none of many gained 10
NOISE = ("position", "orientation", "joint", "reading")  # parts of the noise in a comparison at a result
KNOWN = Prior(joint_offset=1.0, frames=1.0)  # prior with scales estimated before, as the problem has them


class Candidate(NamedTuple):
    """A candidate model: its penalized -2 ln L, its extensions, its marginal likelihood, and the optimum."""

    criterion: float
    extensions: tuple[str, ...]
    evidence: Evidence
    point: Point


# --- which extensions there are ---------------------------------------------------------------------------------


def identifiable(problem: CalibrationProblem) -> dict[str, tuple[str, ...]]:
    """Return the parameters of every extension that are not identified yet, of joints that turned far enough."""
    candidates: dict[str, list[str]] = {}
    known = set(problem.parameters.free.names)
    for robot, arm in problem.arms.items():
        travel = np.ptp(problem.alone(robot).joint_values, axis=0)
        for extension, names in model_extensions(arm).items():
            if extension in TURNED:
                turned = {str(i) for i, angle in enumerate(travel, start=1) if angle > TURNED[extension]}
                names = [name for name in names if name.rpartition("_")[2].lstrip("cosin") in turned]
            candidates.setdefault(extension, []).extend(problem.parameters.called(robot, name) for name in names)
    prefixes = {session_prefix(name) for name in problem.data.sessions}
    if 2 <= len(prefixes) <= len(np.unique(problem.data.configuration)) / 2:  # sessions that differ from configurations
        candidates[SESSIONS] = [n for n in problem.parameters.names if frame_of(n) in prefixes]
    grows = [n for n in problem.parameters.names if own_name(n) == EXPANSION]
    if grows and np.ptp(problem.data.temperatures) > 0:
        candidates[WARMTH] = grows
    new = {each: tuple(dict.fromkeys(n for n in names if n not in known)) for each, names in candidates.items()}
    return {extension: names for extension, names in new.items() if names}


def extended(problem: CalibrationProblem, names: Sequence[str]) -> CalibrationProblem:
    """Return the problem with more identified parameters, with scales derived from their effects."""
    p = problem.parameters
    index = [p.names.index(name) for name in names]
    identified = p.identified.copy()
    scale = p.scale.copy()
    identified[index] = True
    for name, robot in problem.arms.items():
        own = [i for i in p.places_of(name) if i in index]
        mine = [i for i in own if not of_session(p.names[i]) and own_name(p.names[i]) != EXPANSION]
        scale[mine] = extension_scales(robot, [own_name(p.names[i]) for i in mine])
    return problem.with_parameters(replace(p, identified=identified, scale=scale))


def named(problem: Source, x: Array) -> dict[str, float]:
    """Return deviations (n,) by the names of the parameters."""
    return dict(zip(problem.parameters.free.names, x.tolist(), strict=True))


def deviations(problem: Source, known: Mapping[str, float]) -> Array:
    """Return deviations (n,) from a mapping by name; zero for the others."""
    return np.array([known.get(name, 0.0) for name in problem.parameters.free.names])


# --- which of them are selected ---------------------------------------------------------------------------------


class Models:
    """Models with and without extensions at one linearization, since the effects of extensions are small.

    ``own`` are the parameters that the problem identifies, ``names`` (p,) those of all models, the ``columns`` of the
    marginal likelihood; ``known`` are deviations by name.
    """

    def __init__(
        self, problem: CalibrationProblem, estimator: Estimator, known: Mapping[str, float], skip: Sequence[str] = ()
    ) -> None:
        self.problem = problem
        self.own = problem.parameters.free.names
        self.extensions = {name: own for name, own in identifiable(problem).items() if name not in skip}
        self.whole = extended(problem, self.added(self.extensions))
        self.names = np.array(self.whole.parameters.free.names)
        self.x = deviations(self.whole, known)
        self.columns = estimator.evidence(self.whole, self.x)

    def added(self, extensions: Iterable[str]) -> list[str]:
        """Return the parameters of some extensions."""
        return [name for extension in extensions for name in self.extensions[extension]]

    def members(self, extensions: Iterable[str]) -> np.ndarray:
        """Return which parameters (p,) the model with some extensions has."""
        return np.isin(self.names, [*self.own, *self.added(extensions)])

    def compared(self, fitted: Callable[[tuple[str, ...]], Candidate]) -> list[Candidate]:
        """Return the candidate models, each ``fitted`` to its extensions.

        Extensions of the arm are selected with all conditions in the model, whose effects they would otherwise absorb;
        then each condition is tried with the best one.
        """
        conditions = tuple(condition for condition in CONDITIONS if condition in self.extensions)
        possible = [tuple(each for each in candidate if each in self.extensions) for candidate in CANDIDATES]
        candidates = [fitted((*candidate, *conditions)) for candidate in dict.fromkeys(possible)]
        best = min(candidates, key=lambda each: each.criterion)
        many = len(np.unique(self.problem.data.configuration)) >= MANY
        for extension, beside in FURTHER.items():
            if many and extension in self.extensions:
                more = (*best.extensions, beside, extension)
                arm = [each for each in ARM if each in more and each in self.extensions]
                candidates.append(fitted((*arm, *conditions)))
                best = min(best, candidates[-1], key=lambda each: each.criterion)
        kept = tuple(extension for extension in best.extensions if extension not in conditions)
        for count in range(len(conditions)):
            candidates += [fitted((*kept, *some)) for some in combinations(conditions, count)]
        return candidates


def select_model(estimator: Estimator, fit: Fit) -> tuple[Fit, tuple[Trial, ...]]:
    """Return the fit of the model with the largest marginal likelihood, and all candidates, the best first."""
    deviation = named(fit.problem, fit.x)
    models = Models(fit.problem, estimator, deviation)
    before = _hyperparameters(fit.evidence, fit.point)
    known: dict[frozenset[str], dict[str, float]] = {}

    def fitted(candidate: tuple[str, ...]) -> Candidate:
        evidence = models.columns.restricted(models.members(candidate))
        conditions = frozenset(candidate).intersection(CONDITIONS)
        point = evidence.optima([_start(evidence, known.get(conditions, before))], COMPARED)[0]
        if conditions and conditions == set(candidate):  # their effects were part of the noise
            known[conditions] = _hyperparameters(evidence, point)
        return Candidate(point.value + GAIN * complexity(candidate), candidate, evidence, point)

    candidates = models.compared(fitted)
    likeliest = min(candidates, key=lambda each: each.point.value)
    q = fit.problem.joint_values[fit.problem.owners]
    factor = np.mean(likeliest.evidence.overdispersion(likeliest.point, q))
    candidates.sort(key=lambda each: each.point.value / factor + GAIN * complexity(each.extensions))
    trials = tuple(Trial(each.extensions, each.point.value) for each in candidates)
    if not candidates[0].extensions:
        return fit, trials
    whole = extended(fit.problem, models.added(candidates[0].extensions))
    return estimator.fit(whole, deviations(whole, deviation), candidates[0].point.logs, ROUNDS), trials


def complexity(extensions: Sequence[str]) -> int:
    """Return the number of extensions of a model, all of `CANDIDATES` counted as one."""
    others = sum(extension in FURTHER or extension in CONDITIONS for extension in extensions)
    return others + (len(extensions) > others)


def _hyperparameters(evidence: Evidence, point: Point) -> dict[str, float]:
    return dict(zip(evidence.names, point.logs.tolist(), strict=True))


def _start(evidence: Evidence, known: Mapping[str, float]) -> Array:
    """Return a start for the optimum of a model from logarithms of another model's hyperparameters by name.

    Scales of extensions start far above their prior medians: at small scales the likelihood is flat if the noise has
    absorbed the effect.
    """
    pairs = zip(evidence.names, evidence.centre, strict=True)
    return np.array([known.get(name, centre + LARGE) for name, centre in pairs])


# --- at a result ------------------------------------------------------------------------------------------------


class Comparison(Models):
    """Models with and without extensions at the linearization of one result, whatever its weight.

    At most `hyperparameters.MOST` configurations are used.
    """

    def __init__(self, result: Result) -> None:
        self.result = result
        estimator = Estimator(Prior(), NOISE)
        if result.learned is not None:
            estimator = Estimator(KNOWN, NOISE + ("instrument",) * ("instrument" in result.learned.noise))
        problem = sampled(result.problem.with_repeatability(None))  # in memory, without noise estimates
        rows = np.flatnonzero(np.isin(problem.labels, [flag.label for flag in result.flagged]))
        if 0 < len(rows) <= len(problem.labels) / 4:  # without flagged rows, unless they are neighbours
            alone = {problem.labels[i] for i in rows[~clustered(problem, result.x, rows)]}
            problem = problem.without(alone)
        super().__init__(problem, estimator, named(result.problem, result.x))
        stacks = self.columns.data.stacks
        self.configurations = len(np.unique(self.problem.data.configuration))
        # angles if no length was measured, pixels if only cameras were used
        self.dimension = next(d for d in ("length", "angle", "pixel") if any(stack.of(d).any() for stack in stacks))
        self.equations = np.sort(np.concatenate([stack.index[stack.of(self.dimension)] for stack in stacks]))
        self.row = self.problem.owners
        self.rows = len(np.unique(self.row[self.equations]))

    @cached_property
    def residual_dof(self) -> float:
        """Degrees of freedom of the residuals, in the result's model."""
        point = self.plain.point
        return len(self.row) - float(np.sum(1 - np.diag(point.C) / point.v))

    @cached_property
    def plain(self) -> Candidate:
        """The result's own model, without extensions."""
        evidence = self.columns.restricted(self.members(()))
        if self.result.learned is None:
            starts = evidence.starts()
        else:
            noise = {name: np.log(size.value) for name, size in self.result.learned.noise.items() if name in CENTRES}
            starts = [np.array([noise.get(n, c) for n, c in zip(evidence.names, evidence.centre, strict=True)])]
        point = evidence.optima(starts)[0]
        return Candidate(point.value, (), evidence, point)

    @cached_property
    def best(self) -> Candidate:
        """The selected model, with a penalty of `SPEAK` per extension."""
        learned, updated = self.result.learned, self.result.record.earlier
        if learned is not None and learned.trials and not updated:  # selected before; in an update, from other rows
            return self.plain
        candidates = self.compared(lambda some: self._fitted(some, self.members(some)) if some else self.plain)
        return min([self.plain, *candidates], key=lambda each: each.criterion)

    def rise_without(self, members: np.ndarray) -> float:
        """Return the increase of -2 ln L without a subset of the result's own parameters (n,)."""
        keep = np.isin(self.names, np.array(self.own)[~members])
        return self._fitted((), keep).point.value - self.plain.point.value

    def _fitted(self, extensions: tuple[str, ...], keep: np.ndarray) -> Candidate:
        """Return a model at its hyperparameters, looked for from those of the result's."""
        evidence = self.columns.restricted(keep)
        start = _start(evidence, _hyperparameters(self.plain.evidence, self.plain.point))
        point = evidence.optima([start])[0]
        return Candidate(point.value + SPEAK * len(extensions), extensions, evidence, point)
