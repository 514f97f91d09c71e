"""Empirical Bayes: hyperparameters, model extensions and outliers of one problem."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.bayes.evidence import Evidence, Point
from rpim_opt.bayes.hyperparameters import Fit, Learned, Learning, LeftOut, Refit, Size, Trial, doubts
from rpim_opt.bayes.model_selection import modelled
from rpim_opt.bayes.outliers import beyond, suspected, unbelievable
from rpim_opt.bayes.prior import Prior
from rpim_opt.bayes.prior_terms import Stated
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.frames import settled
from rpim_opt.problem.scatter import Scatter, Stack
from rpim_opt.problem.source import Source

MOST = 1000
"""Configurations that sizes are learned from, drawn at random where there are more."""
ROUNDS = 6
"""Linearizations at which sizes are looked for."""
ASKED = 6.0
"""By how much -2 ln L must fall for a doubted prior: a likelihood ratio of twenty, which by Markov's inequality an arm
of another kind shows once in twenty times at most."""
LOOKS = 4
"""How often blunders are looked for again without those that were found: they hide behind each other."""
FLATTEST = 0.05
"""Least second derivative of -2 ln L that is believed."""


@dataclass(frozen=True, eq=False)
class Found:
    """What was learned, ready for a fit at weight 1.

    Parameters
    ----------
    problem
        With local scales, scatter and families, without blunders.
    learned
        The evidence.
    stated
        The prior, in units of those scales.
    x
        (n,) where to begin [SI].
    """

    problem: Source
    learned: Learned
    stated: Stated
    x: Array


def learn(problem: Source, prior: Prior, model: str, start: Array | None, noise: Sequence[str], refit: Refit) -> Found:
    """Return what the data say of sizes, noise, families and blunders.

    Parameters
    ----------
    problem
        With stated scales.
    prior
        What is believed of the deviations.
    model
        ``"geometry"``, or ``"auto"`` for families that the evidence wants.
    start
        (n,) where to begin [SI], or None.
    noise
        Parts of the scatter that are looked for.
    refit
        As for `Learning`.
    """
    try:
        return _found(problem, Learning(prior, tuple(noise), refit), model, start)
    except np.linalg.LinAlgError:
        found = "equations, scales and noise too far apart for sizes to be learned"
        raise InputError("data", found, "their units looked at, or a weight") from None


def _found(problem: Source, learning: Learning, model: str, start: Array | None) -> Found:
    every = sampled(problem)
    learning, whole, doubt = _believed(every, learning, _begin(every, start))
    fit, trials, blunders = _without_blunders(every, learning, whole, model)
    laid = problem.with_parameters(fit.laid.parameters).scattered(fit.laid.scatter)
    if not problem.keeps_rows or len(every.data) < len(problem.labels):
        blunders = beyond(laid, fit.x)
    if blunders:
        laid = laid.without(blunders)
    worst = tuple(LeftOut(*item) for item in sorted(blunders.items(), key=lambda item: -item[1]))
    stated = set(every.parameters.free.names)
    added = tuple(name for name in fit.problem.parameters.free.names if name not in stated)
    return Found(laid, _learned(fit, added, trials, worst, doubt), learning.inside(fit.problem, fit.point), fit.x)


def _without_blunders(
    every: CalibrationProblem, learning: Learning, whole: Fit, model: str
) -> tuple[Fit, tuple[Trial, ...], dict[str, float]]:
    """Return the fit without the rows that no model makes believable, the models compared, and those rows."""
    blunders = suspected(every, whole.x, whole.laid.parameters.free.scale, whole.spare)
    fit, trials = _explained(learning, whole, blunders, model)
    for _ in range(LOOKS):  # what families explain, and the worst blunders, stood before the smaller ones
        if not blunders and not (trials and trials[0].families):
            break
        again = fit.problem.on(every.data)
        more = suspected(again, fit.x, fit.laid.parameters.free.scale, fit.spare)
        if not more.keys() - blunders.keys():
            break
        blunders = {**more, **blunders}
        fit, trials = _explained(learning, whole, blunders, model)
    if blunders:
        left = unbelievable(fit.laid.on(every.data), fit.x, fit.covariance, blunders)
        if left.keys() != blunders.keys():
            blunders = left
            fit, trials = _explained(learning, whole, blunders, model)
    return fit, trials, blunders


def _believed(every: CalibrationProblem, learning: Learning, x: Array) -> tuple[Learning, Fit, tuple[str, ...]]:
    """Return how sizes are found and what they are; a doubted prior is left out where the evidence is against it."""
    prior = learning.prior
    whole = learning.fitted(every, x, None, ROUNDS)
    if not prior.doubted:
        return learning, whole, ()
    plain = replace(learning, prior=prior.without_centre())
    without = plain.fitted(every, x, None, ROUNDS)
    fall = without.point.value - whole.point.value
    if fall >= ASKED:
        return learning, whole, ()
    said = f"What other arms say was left out: -2 ln L falls by {fall:.1f} with it, where {ASKED:g} are asked."
    return plain, without, (said,)


def _explained(
    learning: Learning, whole: Fit, blunders: Mapping[str, float], model: str
) -> tuple[Fit, tuple[Trial, ...]]:
    """Return the fit of the wanted model without some rows, and the models compared."""
    fit = whole
    if blunders:
        fit = learning.fitted(whole.problem.without(blunders), whole.x, None, ROUNDS)
    if model == "geometry":
        return fit, ()
    return modelled(learning, fit)


def with_families(problem: Source, found: Found) -> Source:
    """Return a problem with the families that were found in it, and all else as it was stated."""
    p = problem.parameters
    added = np.isin(p.names, found.learned.added)
    scale = np.where(added, found.problem.parameters.scale, p.scale)
    return problem.with_parameters(replace(p, scale=scale, identified=p.identified | added))


def _begin(problem: CalibrationProblem, start: Array | None) -> Array:
    """Return where to linearize first: frames where the data put them, the robot as on its drawing."""
    p = problem.parameters
    if start is not None:
        return start
    x = np.zeros(len(p.free))
    frames = p.placed & p.identified
    if frames.any():  # those stated far from there count from there already
        x[p.placed[p.identified]] = settled(problem.identifying(frames))
    return x


def sampled(problem: Source, most: int = MOST) -> CalibrationProblem:
    """Return the problem with some of its configurations in memory: all, or so many at random, from every part."""
    if isinstance(problem, CalibrationProblem):
        return _drawn(problem, most).frozen()
    count = sum(1 for _ in problem.rows())
    parts = [_drawn(part, max(most // count, 1)).data for part in problem.rows()]
    return problem.on(Dataset.together(parts, [str(i) for i in range(len(parts))])).frozen()


def _drawn(problem: CalibrationProblem, most: int) -> CalibrationProblem:
    """Return the problem with so many of its configurations at most."""
    if len(np.unique(problem.data.configuration)) <= most:
        return problem
    return problem.on(problem.data.configurations(most, seed=0))


def _learned(
    fit: Fit,
    added: tuple[str, ...],
    trials: tuple[Trial, ...],
    left_out: tuple[LeftOut, ...],
    notes: tuple[str, ...],
) -> Learned:
    """Return the sizes with what is not known of them."""
    evidence, point = fit.evidence, fit.point
    covariance, slopes, growth = _curvature(evidence, point)
    spread = np.sqrt(np.diag(covariance))
    names = evidence.believed.names
    values = [Size(float(v), float(s)) for v, s in zip(np.exp(point.logs), spread, strict=True)]
    size = np.append(np.exp(point.logs[: len(names)]), np.nan)[evidence.believed.group]
    local = np.where(np.isfinite(size), np.sqrt(point.v) / size, 1.0)
    return Learned(
        sizes=dict(zip(names, values, strict=False)),
        noise=dict(zip(evidence.noise, values[len(names) :], strict=True)),
        local=local,
        trials=trials,
        value=point.value,
        freedom=_freedom(growth, covariance),
        left_out=left_out,
        covariance=covariance,
        stated=fit.problem.parameters.free.scale,
        drift=_drift(fit, covariance, slopes),
        added=added,
        notes=(*notes, *doubts(evidence, point, fit.others, spread)),
    )


def _curvature(evidence: Evidence, point: Point) -> tuple[Array, Array, Array]:
    """Return how the evidence and what follows from it change with the logarithms of sizes.

    Returns
    -------
    Their covariance (s, s), twice the inverse of -2 ln L's second derivatives; the slopes (p, s) of the deviations; and
    those (s,) of the logarithm of the variance of what is read, on average over the measured lengths.
    """
    slopes = evidence.slopes(point)
    curvature, U = np.linalg.eigh((slopes.curvature + slopes.curvature.T) / 2)
    covariance = U @ np.diag(2 / np.maximum(curvature, FLATTEST)) @ U.T
    X = np.vstack([evidence.data.X[stack.index[_read(stack)]] for stack in evidence.data.stacks])
    scatter = evidence.scatter(point.logs)
    noise = _noise(evidence, scatter)
    # tr(X C X' + R): C by its inverse, and R is a sum of squares of the noises
    rises = slopes.falls(point.C @ (X.T @ X) @ point.C)
    for i, kind in enumerate(evidence.noise, len(rises) - len(evidence.noise)):
        rises[i] += 2 * (noise - _noise(evidence, replace(scatter, **{kind: 0.0})))
    return covariance, slopes.z, rises / (float(np.sum((X @ point.C) * X)) + noise)


def _read(stack: Stack) -> np.ndarray:
    """Return which equations (N, k) are of lengths (else angles, else pixels)."""
    kinds = (stack.of(dimension) for dimension in ("length", "angle", "pixel"))
    return next(kind for kind in kinds if kind.any())


def _noise(evidence: Evidence, scatter: Scatter) -> float:
    """Return the variance of what is read, summed over those equations."""
    stacks = evidence.data.stacks
    return sum(float(np.sum(np.einsum("nkk->nk", stack.covariance(scatter))[_read(stack)])) for stack in stacks)


def _drift(fit: Fit, covariance: Array, slopes: Array) -> Array:
    """Return by what the deviations move (n, s + h) [SI] where sizes are others, and their own scales."""
    unit = fit.laid.parameters.free.scale / np.sqrt(fit.point.v)
    variance, U = np.linalg.eigh(covariance)
    by_sizes = slopes @ (U * np.sqrt(np.maximum(variance, 0.0)))
    return unit[:, None] * np.column_stack([by_sizes, fit.evidence.tails(fit.point)])


def _freedom(growth: Array, covariance: Array) -> float:
    """Return Satterthwaite's degrees of freedom 2 V^2 / var(V) of the variance V of a reading, at least three.

    Of all of it: what is not known of the model counts with how little is known of the sizes behind it.
    """
    return float(max(2 / max(growth @ covariance @ growth, 1e-3), 3.0))
