"""Empirical Bayes: hyperparameters, model extensions and outliers of one problem."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import joined, listed
from rpim_opt.basics.units import display
from rpim_opt.bayes.hyperparameters import Estimator, ExcludedRow, Fit, Learned, Trial, learned, sampled
from rpim_opt.bayes.model_selection import select_model
from rpim_opt.bayes.outliers import (
    beyond_noise,
    error_ratios,
    isolated,
    largest_errors,
    outlier_candidates,
    unexplained,
)
from rpim_opt.bayes.prior_terms import ScaledPrior
from rpim_opt.bayes.transmission import admitted
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.frames import ridge_deviations
from rpim_opt.robot.parameters import own_name

ROUNDS = 6  # linearizations at which hyperparameters are estimated
REQUIRED_GAIN = 6.0
"""Decrease of -2 ln L that an optional prior needs: a likelihood ratio of twenty, which by Markov's inequality at most
one in twenty arms of another kind reaches."""
CONTRADICTED = 1e-7  # p-value below which known values contradict the data
FEW, NOISY = 16, 2.0  # configurations, and noise over its prior median, with which a hidden outlier is sought
GAP, SMALLER, ROUGH = 20.0, 0.2, 0.3
"""Decrease of -2 ln L against any other row, part of the noise that may be left, and accuracy of the comparison. Of 96
simulated arms with 10 to 16 clean positions none decreased it by more than 7, of 192 draws of 10 to 20 configurations
of three real arms one by more than 20 with so much less noise."""
OUTLIER_SEARCHES = 4  # repetitions of the outlier search without outliers found before: they mask each other


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
    """Estimate hyperparameters, outliers and, with the model ``"auto"``, extensions, from a start (n,) [SI] or None.

    Outliers are removed from the problem, unless the loss has to ``keep`` the rows.
    """
    try:
        return _estimate(problem, estimator, model, start, keep)
    except np.linalg.LinAlgError:
        found = "magnitudes of equations, scales and noise too different to estimate hyperparameters"
        raise InputError("data", found, "correct units, or a fixed weight") from None


def _estimate(problem: Source, estimator: Estimator, model: str, start: Array | None, keep: bool) -> Estimated:
    every = sampled(problem)
    p = every.parameters
    if start is None:  # frames registered to the data, nominal robot
        start = np.zeros(len(p.free))
        frames = p.placed & p.identified
        if frames.any():
            start[p.placed[p.identified]] = ridge_deviations(every.identifying(frames))
    whole = estimator.fit(every, start, None, ROUNDS)
    notes: tuple[str, ...] = ()
    if estimator.prior.optional:  # omitted if the marginal likelihood is against it
        plain = replace(estimator, prior=estimator.prior.without_optional())
        without = plain.fit(every, start, None, ROUNDS)
        fall = without.point.value - whole.point.value
        if fall < REQUIRED_GAIN:
            estimator, whole = plain, without
            reason = f"its likelihood-ratio statistic is {fall:.1f}; {REQUIRED_GAIN:g} is required."
            notes = (f"The population prior is not used: {reason}",)
    (fit, trials, gain), outliers = _without_outliers(every, estimator, whole, model)
    if gain > 0:
        problem = problem.with_transmission(fit.problem.robot.model.curves)
    laid = problem.with_parameters(fit.laid.parameters).with_repeatability(fit.laid.repeatability)
    if not problem.keeps_rows or len(every.data) < len(problem.labels):
        outliers = beyond_noise(laid, fit.x)
    left_out: list[ExcludedRow] = []
    if outliers:
        errors = dict(zip(laid.labels, largest_errors(laid, fit.x), strict=True))
        worst_first = sorted(outliers.items(), key=lambda item: -item[1])
        left_out = [ExcludedRow(label, ratio, *errors[label]) for label, ratio in worst_first]
        if keep:
            kept = listed([str(row) for row in left_out], 5)
            notes += (f"Outliers, kept since the loss depends on equation order: {kept}. Leave them out ([exclude]).",)
            left_out = []
        else:
            laid = laid.without(outliers)
    hyperparameters = learned(
        fit,
        gain,
        trials=trials,
        left_out=tuple(left_out),
        added=tuple(name for name in fit.problem.parameters.free.names if name not in p.free.names),
        contradicted=tuple(_contradicted(fit)),
    )
    return Estimated(laid, replace(hyperparameters, notes=(*notes, *hyperparameters.notes)), fit.inside, fit.x)


def _contradicted(fit: Fit) -> Iterator[str]:
    """Report contradicted known values: single ones, or several of one kind of frame that are unlikely together.

    z and C are mean and covariance of a fit without the statements R z = v +- 1, but with their local variances: a
    joint zero far off does not contradict a frame. Named are the values without which chi-squared decreases most::

        chi-squared = d' S^-1 d,    d = R z - v,    S = 1 + R C R'
    """
    prior, p = fit.estimator.prior, fit.problem.parameters
    known = [each for each in prior.statements if not each.whole and len(each.on(p)[1])]
    if not known:
        return
    bare = replace(prior, statements=tuple(each for each in prior.statements if each.whole))
    without = replace(fit.estimator, prior=bare).fit(fit.problem, fit.x, None, ROUNDS)
    stated, z = without.stated, without.point.z
    opened = np.where(stated.replaced, 0.0, 1 / fit.point.v - 1 / without.point.v)
    C = np.linalg.inv(np.linalg.inv(without.point.C) + np.diag(opened))
    R, values = (np.concatenate([each.on(p)[k] for each in known]) for k in range(2))
    d = R @ (stated.centre + stated.scale * (z - C @ (opened * z))) - values
    S = np.eye(len(R)) + R * stated.scale @ C @ (R * stated.scale).T
    while known:
        groups: dict[object, list[int]] = {}
        for i, each in enumerate(known):
            kind, _, coordinate = own_name(each.names[0]).partition("_")
            for key in (i, kind, (kind, coordinate.rpartition("_")[2])):
                groups.setdefault(key, []).append(i)
        P = np.linalg.inv(S)
        off = {key: np.linalg.solve(P[np.ix_(g, g)], P[g] @ d) for key, g in groups.items()}
        chi2 = {key: float(d @ P[:, g] @ off[key]) for key, g in groups.items()}
        beyond = [key for key, g in groups.items() if chi2[key] > chdtri(len(g), CONTRADICTED)]
        if not beyond:
            return
        worst = max(beyond, key=lambda key: chi2[key] / len(groups[key]))
        amounts, named = [], []
        for i, amount in zip(groups[worst], off[worst], strict=True):
            factors, text = np.array(known[i].rows[0]), f"'{known[i].text}'"
            largest = np.abs(factors).max()
            unit, si = display(known[i].dimensions[int(np.abs(factors).argmax())])
            amounts.append(f"{amount / largest / si:+.3g} {unit}")
            if known[i].reference is None:  # the nominal place of such a frame comes from registration
                nominal = factors @ p.nominal[[p.names.index(name) for name in known[i].names]]
                text += f" (nominal: {nominal / largest / si:.5g} {unit})"
            named.append(text)
        yield (
            f"The data contradict prior {joined(named)}, by {joined(amounts)} (chi-squared {chi2[worst]:.0f}, "
            f"degrees of freedom {len(amounts)}). Correct the known values, or take them out of the prior."
        )
        left = np.setdiff1d(np.arange(len(known)), groups[worst])
        known, R, d, S = [known[i] for i in left], R[left], d[left], S[np.ix_(left, left)]


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
        if last.gain > 0:  # curves that were admitted with other outliers stay
            rows = last.fit.problem.on(every.data).without(outliers)
            return last._replace(fit=last.fit.estimator.fit(rows, last.fit.x, last.fit.point.logs, ROUNDS))
        if outliers:
            fit = estimator.fit(whole.problem.without(outliers), whole.x, None, ROUNDS)
        if model == "geometry":
            return _Explained(fit)
        fit, trials = select_model(estimator, fit)
        return _Explained(*(admitted(estimator, fit, every.parameters.free.names, trials) or (fit, trials, 0.0)))

    outliers = outlier_candidates(every, whole.x, whole.laid.parameters.free.scale, whole.spare)
    outliers = outliers or _hidden(every, estimator, whole)
    now = explain(outliers, _Explained(whole))
    for _ in range(OUTLIER_SEARCHES):  # extensions and the largest outliers hide smaller outliers
        fit = now.fit
        if not outliers and not (now.trials and now.trials[0].extensions):
            break
        if now.gain > 0:  # a resistant fit with hundreds of coefficients would absorb outliers
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


def _hidden(every: CalibrationProblem, estimator: Estimator, whole: Fit) -> dict[str, float]:
    """Return the row of few configurations without which the noise is far smaller, with its error over the median.

    A fit absorbs a part of every error: of 12 positions one that is 3 mm off leaves errors of 0.5 mm in all. Without
    it, the marginal likelihood of the others exceeds that without any other row.
    """
    noise = whole.evidence.noise
    own = slice(len(whole.point.logs) - len(noise), None)
    before, usual = (np.linalg.norm(np.exp(logs[own])) for logs in (whole.point.logs, whole.evidence.centre))
    if len(np.unique(every.data.configuration)) > FEW or before <= NOISY * usual:
        return {}
    trials = [estimator.evidence(every.without({label}), whole.x) for label in every.labels]
    if any(trial.noise != noise for trial in trials):  # rows of a kind of their own
        return {}
    points = [trial.optima([whole.point.logs], ROUGH)[0] for trial in trials]
    best, second = np.argsort([point.value for point in points])[:2].tolist()
    after = np.linalg.norm(np.exp(points[best].logs[own]))
    if points[second].value - points[best].value < GAP or after > SMALLER * before:
        return {}
    label = every.labels[best]
    fit = estimator.fit(every.without({label}), whole.x, points[best].logs, 1)
    return {label: float(error_ratios(every, fit.x)[best])}


def with_extensions(problem: Source, found: Estimated) -> Source:
    """Return the problem with the selected model extensions, otherwise unchanged."""
    if found.learned.curves is not None:
        problem = problem.with_transmission(found.problem.arms[""].model.curves)
    p = problem.parameters
    added = np.isin(p.names, found.learned.added)
    scale = np.where(added, found.problem.parameters.scale, p.scale)
    return problem.with_parameters(replace(p, scale=scale, identified=p.identified | added))
