"""Empirical Bayes: hyperparameters, model extensions and outliers of one problem."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import listed
from rpim_opt.basics.units import display
from rpim_opt.bayes.hyperparameters import Estimator, ExcludedRow, Fit, Learned, Trial, learned, sampled
from rpim_opt.bayes.model_selection import select_model
from rpim_opt.bayes.outliers import beyond_noise, isolated, largest_errors, outlier_candidates, unexplained
from rpim_opt.bayes.prior_terms import ScaledPrior
from rpim_opt.bayes.transmission import admitted
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.frames import ridge_deviations

ROUNDS = 6  # linearizations at which hyperparameters are estimated
REQUIRED_GAIN = 6.0
"""By how much -2 ln L must fall for an optional prior: a likelihood ratio of twenty, which by Markov's inequality one
arm of another kind in twenty shows at most."""
CONTRADICTED = 28.0
"""By how much -2 ln L must fall without a known value that the data contradict: in the same way once in a million."""
OUTLIER_SEARCHES = 4  # how often outliers are looked for again without those that were found: they mask each other


@dataclass(frozen=True, eq=False)
class Estimated:
    """Estimated hyperparameters, and the problem to fit at weight 1 from x (n,) [SI].

    The problem has local scales, noise and model extensions, without outliers; ``stated`` is the prior in its units.
    """

    problem: Source
    learned: Learned
    stated: ScaledPrior
    x: Array


def estimate(problem: Source, estimator: Estimator, model: str, start: Array | None, keep: bool = False) -> Estimated:
    """Estimate hyperparameters, outliers, and of the model ``"auto"`` extensions, from a start (n,) [SI] or None.

    Outliers are left out of the problem, unless the loss has to ``keep`` the rows that it knows.
    """
    try:
        return _estimate(problem, estimator, model, start, keep)
    except np.linalg.LinAlgError:
        found = "magnitudes of equations, scales and noise too different to estimate hyperparameters"
        raise InputError("data", found, "correct units, or a fixed weight") from None


def _estimate(problem: Source, estimator: Estimator, model: str, start: Array | None, keep: bool) -> Estimated:
    every = sampled(problem)
    p = every.parameters
    if start is None:  # frames registered to the data, the robot nominal
        start = np.zeros(len(p.free))
        frames = p.placed & p.identified
        if frames.any():
            start[p.placed[p.identified]] = ridge_deviations(every.identifying(frames))
    whole = estimator.fit(every, start, None, ROUNDS)
    notes: tuple[str, ...] = ()
    if estimator.prior.optional:  # left out where the marginal likelihood is against it
        plain = replace(estimator, prior=estimator.prior.without_optional())
        without = plain.fit(every, start, None, ROUNDS)
        fall = without.point.value - whole.point.value
        if fall < REQUIRED_GAIN:
            estimator, whole = plain, without
            reason = f"its likelihood-ratio statistic is {fall:.1f}; {REQUIRED_GAIN:g} is required."
            notes = (f"The population prior is not used: {reason}",)
    contradicted = tuple(_contradicted(every, estimator, whole, start))
    (fit, trials, gain), outliers = _without_outliers(every, estimator, whole, model)
    requested = p.free.names
    if gain > 0:
        problem = problem.with_transmission(fit.problem.robot.model.curves)
    laid = problem.with_parameters(fit.laid.parameters).with_repeatability(fit.laid.repeatability)
    if not problem.keeps_rows or len(every.data) < len(problem.labels):
        outliers = beyond_noise(laid, fit.x)
    left_out: list[ExcludedRow] = []
    if outliers:
        errors = dict(zip(laid.labels, largest_errors(laid, fit.x), strict=True))
        for label, ratio in sorted(outliers.items(), key=lambda item: -item[1]):
            left_out.append(ExcludedRow(label, ratio, *errors[label]))
        if keep:
            kept = listed([str(row) for row in left_out], 5)
            notes += (f"Outliers, kept because the loss depends on the order of its equations: {kept}.",)
            left_out = []
        else:
            laid = laid.without(outliers)
    hyperparameters = learned(
        fit,
        gain,
        trials=trials,
        left_out=tuple(left_out),
        added=tuple(name for name in fit.problem.parameters.free.names if name not in requested),
        contradicted=contradicted,
    )
    return Estimated(laid, replace(hyperparameters, notes=(*notes, *hyperparameters.notes)), fit.inside, fit.x)


def _contradicted(every: CalibrationProblem, estimator: Estimator, whole: Fit, start: Array) -> Iterator[str]:
    """Say which known values are off: by how much -2 ln of the data's likelihood p(y | value) falls without one.

    A fit with the statement r z = v +- 1 knows p(y, value). With prior means m and variances V of a fit without it::

        -2 ln p(value) = ln s + (v - r m)^2 / s,    s = 1 + r V r'
    """
    prior, free = estimator.prior, every.parameters.free
    for statement in prior.statements:
        rows, values, _ = statement.on(every.parameters)
        if statement.whole or not len(rows):  # an earlier result; of parameters that are not identified
            continue
        others = tuple(each for each in prior.statements if each is not statement)
        without = replace(estimator, prior=replace(prior, statements=others)).fit(every, start, None, ROUNDS)
        spread = 1 + float((rows[0] * without.stated.scale) ** 2 @ without.point.v)
        centre = float(values[0] - rows[0] @ without.stated.centre)
        fall = whole.point.value - without.point.value - np.log(spread) - centre**2 / spread
        if fall > CONTRADICTED:
            own = rows[0] / free.scale
            unit, si = display(free.dimensions[int(np.argmax(np.abs(own)))])
            off = float(values[0] - own @ without.x) / np.abs(own).max() / si
            yield (
                f"The data contradict {statement.where}, by {off:+.3g} {unit} (likelihood-ratio statistic {fall:.0f}). "
                "Correct it, or take it out of the prior."
            )


class _Explained(NamedTuple):
    """A fit, the models that were compared, and the gain by transmission errors."""

    fit: Fit
    trials: tuple[Trial, ...] = ()
    gain: float = 0.0


def _without_outliers(
    every: CalibrationProblem, estimator: Estimator, whole: Fit, model: str
) -> tuple[_Explained, dict[str, float]]:
    """Return the fit without outliers, and the outliers."""

    def explain(outliers: Mapping[str, float], last: _Explained) -> _Explained:
        fit = whole
        if last.gain > 0:  # curves that were admitted beside other outliers stay
            estimated = replace(estimator, curves=last.fit.problem.robot.model.curves, refit=None)
            rows = last.fit.problem.on(every.data).without(outliers)
            return last._replace(fit=estimated.fit(rows, last.fit.x, last.fit.point.logs, ROUNDS))
        if outliers:
            fit = estimator.fit(whole.problem.without(outliers), whole.x, None, ROUNDS)
        if model == "geometry":
            return _Explained(fit)
        fit, trials = select_model(estimator, fit)
        return _Explained(*(admitted(estimator, fit, every.parameters.free.names, trials) or (fit, trials, 0.0)))

    outliers = outlier_candidates(every, whole.x, whole.laid.parameters.free.scale, whole.spare)
    now = explain(outliers, _Explained(whole))
    for _ in range(OUTLIER_SEARCHES):  # what extensions explain, and the worst outliers, stood before the smaller ones
        fit = now.fit
        if not outliers and not (now.trials and now.trials[0].extensions):
            break
        if now.gain > 0:  # a resistant fit with hundreds of coefficients would take up outliers itself
            more = isolated(fit.laid.on(every.data), fit.x)
        else:
            more = outlier_candidates(fit.problem.on(every.data), fit.x, fit.laid.parameters.free.scale, fit.spare)
        if not more.keys() - outliers.keys():
            break
        outliers = {**more, **outliers}
        now = explain(outliers, now)
    if outliers:
        left = unexplained(now.fit.laid.on(every.data), now.fit.x, now.fit.covariance, outliers)
        if left.keys() != outliers.keys():
            outliers = left
            now = explain(outliers, now)
    return now, outliers


def with_extensions(problem: Source, found: Estimated) -> Source:
    """Return the problem with the selected model extensions, otherwise unchanged."""
    if found.learned.curves is not None:
        robots = {name: robot.model.curves for name, robot in found.problem.arms.items()}
        problem = problem.with_transmission(robots[""])
    p = problem.parameters
    added = np.isin(p.names, found.learned.added)
    scale = np.where(added, found.problem.parameters.scale, p.scale)
    return problem.with_parameters(replace(p, scale=scale, identified=p.identified | added))
