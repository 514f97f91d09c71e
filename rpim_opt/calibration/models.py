"""Which families of parameters the evidence wants beside the geometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.calibration.families import CANDIDATES, CONDITIONS, MANY, identifying, members
from rpim_opt.calibration.learned import Trial
from rpim_opt.calibration.sizing import Fit, Learning
from rpim_opt.convex.evidence import Evidence, Point
from rpim_opt.problem.problem import CalibrationProblem

GAIN = 6.0
"""By how much -2 ln L must fall for a model with families: of 306 simulated arms without them one gained more.

For sessions and for temperature once more each: they are other questions."""
LARGE = 3.0
"""By how much larger, in their logarithms, families are expected in another start."""
COMPARED = 1e-6
"""Of -2 ln L, to which models are compared: hundredths, of some thousands."""
ROUNDS = 3
"""Linearizations at which the sizes of the chosen model are looked for."""


def modelled(learning: Learning, fit: Fit) -> tuple[Fit, tuple[Trial, ...]]:
    """Return the fit of the model that the evidence wants, and the models compared, the wanted one first.

    Parameters
    ----------
    learning
        How sizes are found.
    fit
        Of the parameters that were to be identified.
    """
    added, trials, point = chosen(learning, fit)
    if not added:
        return fit, trials
    whole, x = extended(fit.problem, fit.x, added)
    return learning.fitted(whole, x, point.logs, ROUNDS), trials


def chosen(learning: Learning, fit: Fit) -> tuple[tuple[str, ...], tuple[Trial, ...], Point]:
    """Return the parameters of the families that the evidence wants, the models compared, and the winner's sizes.

    All models are compared at one linearization: families are small.
    """
    families = members(fit.problem)
    whole, x = extended(fit.problem, fit.x, tuple(name for names in families.values() for name in names))
    columns = learning.evidence(whole, x)
    names = whole.parameters.free.names
    own = set(fit.problem.parameters.free.names)
    trials = []
    for candidate in candidates(fit.problem, families):
        used = own.union(*(families[family] for family in candidate))
        evidence = restricted(columns, np.array([name in used for name in names]))
        point = evidence.mode(_starts(evidence, fit), COMPARED)[0]
        trials.append((point.value + GAIN * _questions(candidate), candidate, point))
    trials.sort(key=lambda trial: trial[0])
    _, best, point = trials[0]
    added = tuple(name for family in best for name in families[family])
    return added, tuple(Trial(candidate, each.value) for _, candidate, each in trials), point


def candidates(problem: CalibrationProblem, families: dict[str, tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return the models that these data may tell apart, each once."""
    tried = CANDIDATES
    if len(np.unique(problem.data.configuration)) < MANY:
        tried = CANDIDATES[:-1]
    possible = [tuple(family for family in candidate if family in families) for candidate in tried]
    for condition in CONDITIONS:
        if condition in families:
            possible += [(*candidate, condition) for candidate in possible]
    return list(dict.fromkeys(possible))


def _questions(families: tuple[str, ...]) -> int:
    """Return how many questions a model answers with yes: whether the arm has families, and each of the conditions."""
    conditions = set(families) & set(CONDITIONS)
    return len(conditions) + (len(families) > len(conditions))


def extended(problem: CalibrationProblem, x: Array, names: tuple[str, ...]) -> tuple[CalibrationProblem, Array]:
    """Return the problem that identifies more parameters, and its deviations, those zero."""
    whole = identifying(problem, names)
    known = dict(zip(problem.parameters.free.names, x, strict=True))
    return whole, np.array([known.get(name, 0.0) for name in whole.parameters.free.names])


def _starts(evidence: Evidence, fit: Fit) -> list[Array]:
    """Return where the optimum of a model with families is looked for: at the sizes without them, and as always."""
    before = fit.evidence.believed.names
    names = evidence.believed.names
    logs = evidence.centre.copy()
    logs[[names.index(name) for name in before]] = fit.point.logs[: len(before)]
    logs[len(names) :] = fit.point.logs[len(before) :]
    starts = [logs]
    new = [i for i, name in enumerate(names) if name not in before]
    if new:  # at small sizes the likelihood is flat in a family whose effect the noise has taken up
        large = logs.copy()
        large[new] += LARGE
        starts.append(large)
    if fit.several:
        starts += evidence.starts()
    return starts


def restricted(evidence: Evidence, keep: np.ndarray) -> Evidence:
    """Return the evidence of a model with some of the columns (n,)."""
    believed = evidence.believed
    group = believed.group[keep]
    used = np.unique(group[group >= 0])
    number = np.full(len(believed.names) + 1, -1)
    number[used] = np.arange(len(used))
    fewer = replace(
        believed,
        group=number[group],
        heavy=believed.heavy[keep],
        names=tuple(believed.names[i] for i in used),
        covariance=believed.covariance[np.ix_(used, used)],
        replaced=believed.replaced[keep],
        rows=believed.rows[:, keep],
    )
    return replace(evidence, data=replace(evidence.data, X=evidence.data.X[:, keep]), believed=fewer)
