"""Transmission errors of joints: a model extension with a Gaussian process of each joint's angle.

f(q) = sum_k c_k cos(w_k q) + s_k sin(w_k q) represents two processes with Matern covariance (3/2), ripple and waves.
Coefficients have the variances of `Spectrum`; w_k are multiples of 2 pi / period, and below these of 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.bayes.evidence import CURVES, Evidence, Linearized, Point, whitened
from rpim_opt.bayes.hyperparameters import Estimator, Fit, Trial, spectrum_of
from rpim_opt.bayes.model_selection import GAIN as EXTENSION_GAIN
from rpim_opt.bayes.model_selection import MOMENTS, ROUNDS, SECOND, Candidate, Models, complexity, extended, named
from rpim_opt.bayes.prior_terms import FIXED
from rpim_opt.problem.noise import Repeatability, Stack
from rpim_opt.robot.terms import Curve

TRANSMISSION = "transmission error"  # the extension by curves of the joints
GAIN = 12.0  # fall of -2 ln L required of curves: real arms without them gain up to 10, of 162 simulated ones none 12
MOMENTS_GAIN = 20.0
"""The same for first moments of links with curves: admitted at a gain of 15 they made errors outside the measured range
1.44 times as large; with all data of that arm they gain 70, and are needed."""
COLUMNS, FINEST = 68, 128
"""Mean number of harmonics (sine and cosine) per joint, for at least six joints; cycles per turn of the finest one."""
SHORTEST = 0.05  # travel of a joint [rad] from which its curve is sought
BEYOND = 0.3  # continuation of curves beyond the measured angles [rad], where they are unknown
STARTS = (0.3, 0.03)  # length scales [rad] at which the search for the optimum starts
ACCURACY = 0.3  # derivative of -2 ln L by ln(hyperparameters) at which curves are admitted
LEAST = 2e-6  # least noise [m or rad] at which the search for its optimum starts


def series(curves: Sequence[Curve], q: Array, slopes: Array) -> Array:
    """Return the columns (m, c) of all coefficients, from joint values and derivatives by them (m, dof)."""
    columns = [np.zeros((len(q), 0))]
    for curve in curves:
        joint, half = curve.joint - 1, curve.period / 2
        moved = q[:, joint] - curve.centre
        waves = np.outer(moved, np.arange(1, curve.waves + 1))
        repeated = np.outer(np.pi / half * np.clip(moved, -half, half), np.arange(1, curve.harmonics + 1))
        angles = np.hstack([waves, repeated])
        columns.append(slopes[:, [joint]] * np.hstack([np.cos(angles), np.sin(angles)]))
    return np.hstack(columns)


def admitted(
    estimator: Estimator, fit: Fit, stated: Sequence[str], trials: tuple[Trial, ...]
) -> tuple[Fit, tuple[Trial, ...], float] | None:
    """Return the fit with transmission errors, the models compared, and the decrease of -2 ln L; None if too small.

    None also if an equation depends on several configurations or on one of several robots, and if curves correlate over
    more than the joints' travel: then they are joint zeros that were not to be identified. Curves replace second
    harmonics. All other extensions are selected again with curves in the model; gravity stays if it was selected
    without them: waves can imitate it in the measured range, but not elsewhere. ``fit`` is that of the selected model
    without curves, the first of ``trials``; ``stated`` are the names of the parameters to identify.
    """
    several = any(block.q.shape[1] > 1 for block in fit.problem.data.blocks)
    if several or len(fit.problem.arms) > 1 or fit.problem.touches is not None:
        return None
    p = fit.problem.parameters
    bare = fit.problem.with_parameters(replace(p, identified=np.isin(p.names, stated)))
    deviation = named(fit.problem, fit.x)
    models = Models(bare, estimator, deviation, skip=(SECOND,))
    used = np.isin(models.names, p.free.names)
    before = named(fit.problem, fit.point.v)
    evidence_with = partial(_with_curves, models.columns, used, np.array([before[name] for name in models.names[used]]))
    start = np.log([max(getattr(fit.laid.repeatability, kind), LEAST) for kind in models.columns.noise])
    plain = evidence_with(np.zeros((len(models.columns.data.y), 0))).optima([start], ACCURACY)[0]
    likeliest = _most_likely(evidence_with, models, plain)
    if likeliest is None:
        return None
    point, curves, columns = likeliest
    rest = _integrated(models.columns, columns, point)
    kept = {"gravity"}.intersection(trials[0].extensions)

    def fitted(extensions: tuple[str, ...]) -> Candidate:
        model = rest.restricted(models.members(extensions))
        best = model.optima(model.starts()[:1])[0]
        penalty = EXTENSION_GAIN * complexity(extensions) + (MOMENTS_GAIN - EXTENSION_GAIN) * (MOMENTS in extensions)
        if not kept.issubset(extensions):
            penalty = np.inf
        return Candidate(best.value + penalty, extensions, model, best)

    compared = sorted(models.compared(fitted), key=lambda each: each.criterion)
    best = compared[0]
    problem = extended(bare, models.added(best.extensions))
    prior = estimator.prior.stated(problem.parameters)
    geometry = problem.parameters.free.scale * (prior.centre + prior.scale * best.point.z)
    x = np.append(geometry, point.z[len(point.z) - columns.shape[1] :])
    logs = np.append(best.point.logs, point.logs)
    joint = replace(estimator, curves=curves, refit=None).fit(problem.with_transmission(curves), x, logs, ROUNDS)
    gain = plain.value - point.value
    shift = trials[0].value - gain - best.point.value
    with_curves = [Trial((*each.extensions, TRANSMISSION), each.point.value + shift) for each in compared]
    return joint, (*with_curves, *trials), gain


def _with_curves(
    evidence: Evidence, keep: np.ndarray, v: Array, columns: Array, curves: Sequence[Curve] = ()
) -> Evidence:
    """Return the likelihood of curves and noise, beside some of the deviations (p,) at local variances (k,)."""
    prior = evidence.prior.of(keep)
    width = np.sqrt(np.where(prior.replaced, 1.0, v))
    c = columns.shape[1]
    known = replace(
        prior,
        group=np.full(len(v) + c, FIXED),
        heavy=np.zeros(len(v) + c, dtype=bool),
        names=(),
        replaced=np.append(prior.replaced, np.zeros(c, dtype=bool)),
        rows=np.pad(prior.rows * width, ((0, 0), (0, c))),
        spectrum=spectrum_of(curves, np.ones(c)),
    )
    X = np.hstack([evidence.data.X[:, keep] * width, columns])
    return replace(evidence, data=replace(evidence.data, X=X), prior=known)


def _most_likely(
    evidence_with: Callable[[Array, Sequence[Curve]], Evidence], models: Models, plain: Point
) -> tuple[Point, tuple[Curve, ...], Array] | None:
    """Return the optimum of curves and noise, the curves and columns (m, c); None where they gain too little."""
    problem = models.whole
    slopes = problem.joint_slopes(problem.parameters.values_at(models.x))
    q = problem.joint_values[problem.owners]
    centre, travel = (q.min(axis=0) + q.max(axis=0)) / 2, np.ptp(q, axis=0)
    joints = [j for j, kind in enumerate(problem.robot.joint_types) if kind == "revolute" and travel[j] > SHORTEST]
    if not joints:
        return None
    turns = np.minimum(travel + 2 * BEYOND, 2 * np.pi) / (2 * np.pi)
    cycles = min(FINEST, COLUMNS * max(len(joints), 6) / 2 / np.sum(turns[joints]))
    counts = np.maximum(cycles * turns, 1).astype(int)
    curves = tuple(Curve(j + 1, float(centre[j]), float(2 * np.pi * turns[j]), int(counts[j])) for j in joints)
    columns = series(curves, q, slopes)
    beside = evidence_with(columns, curves)
    starts = [beside.at(np.array([beside.centre[0], np.log(length), *plain.logs])) for length in STARTS]
    point = beside.optima([min(starts, key=lambda point: point.value)], ACCURACY)[0]
    if plain.value - point.value <= GAIN or np.exp(point.logs[1]) > np.max(travel[joints]):
        return None
    return point, curves, columns


def _integrated(evidence: Evidence, columns: Array, point: Point) -> Evidence:
    """Return the likelihood of the geometry with curves and noise as at a point, the curves integrated out by QR."""
    c = columns.shape[1]
    scaled = columns * np.sqrt(point.v[len(point.v) - c :])
    noise = dict(zip(evidence.noise, np.exp(point.logs[len(CURVES) :]).tolist(), strict=True))
    data = replace(evidence.data, X=np.hstack([scaled, evidence.data.X]))
    parts = whitened(data, replace(evidence.fixed, **noise), ())
    rows = np.vstack([part.X.reshape(-1, data.X.shape[1]) for part in parts])
    y = np.concatenate([part.y.ravel() for part in parts])
    table = np.vstack([np.column_stack([rows, y]), np.eye(c, data.X.shape[1] + 1)])
    R = np.asarray(np.linalg.qr(table, mode="r"))[c:, c:]
    m = len(R)
    every = np.ones((m, 1), dtype=bool)
    stack = Stack(np.arange(m)[:, None], np.ones((m, 1, 1)), every, ~every, np.zeros((m, 1, 0)))
    return replace(evidence, data=Linearized(R[:, :-1], R[:, -1], [stack]), noise=(), fixed=Repeatability())
