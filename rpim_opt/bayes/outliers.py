"""Outliers: isolated rows that the model cannot explain; clusters of neighbours are a model error."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.special import chdtrc, chdtri, fdtrc, pdtrc

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.quadratic import Quadratic, ridge
from rpim_opt.convex.robust_loss import RARE, kept_equations
from rpim_opt.data.dataset import Block, stops
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.linear import LinearModel
from rpim_opt.problem.noise import Equations
from rpim_opt.problem.problem import CalibrationProblem, error_dimensions

BEYOND, LOOK = 6.0, 3.0
"""Error of an outlier in medians, and error from which outliers are sought."""
FALSE_RATE = float(chdtrc(3, BEYOND**2 * chdtri(3, 0.5)))  # of a good position with three components
SPARE = 0.4  # share of equations that must be redundant: errors that the fit has absorbed cannot be seen
WELL_DETERMINED = 10.0  # equations per parameter from which no single row can pull the fit to itself
FULL_WEIGHT, STEPS = 1.5, 50
"""Error in medians up to which a row has full weight in a resistant fit; most reweighted fits."""
FINEST = 1e-8  # least median error of a resistant fit [m, rad, pixels]: with fewer rows than parameters it is zero
SAME = 1e-3  # largest change of row weights at convergence
RUN = 0.01  # probability of neighbouring outliers by chance, below which they are a cluster
NEIGHBOURS, ALIKE = 3, 0.7
"""Least number of outliers in a cluster, and the cosine of errors with the same direction."""
WIDE = 30.0
"""Factor on prior scales, so that a prior alone makes no outlier. Chosen on 300 simulated arms with ten good
configurations, of which 7 have an outlier then, 40 without this test; on 300 others 7 and 41. The target is 3."""
UNDECIDED = 1e-5
"""Share of a configuration's Jacobian in directions that others do not determine, from which it cannot be judged."""


def by_block(problem: CalibrationProblem, values: Array) -> Iterator[tuple[Block, Array]]:
    """Yield every block of a problem's data with its part (N, k, ...) of values (m, ...) of the equations."""
    start = 0
    for block in problem.data.blocks:
        end = start + len(block.row) * len(block.measurement.components)
        yield block, values[start:end].reshape(len(block.row), -1, *values.shape[1:])
        start = end


def error_vectors(problem: CalibrationProblem, x: Array) -> Array:
    """Return measured minus modelled position of every row (N, 3) [m] at deviations x (n,); NaN without a position."""
    vectors = np.full((len(problem.data), 3), np.nan)
    for block, part in by_block(problem, problem.residual(x)):
        names = list(block.measurement.components)
        if {"x", "y", "z"} <= set(names):
            vectors[block.row] = part[:, [names.index(axis) for axis in "xyz"]]
    return vectors


def largest_errors(problem: Source, x: Array) -> list[tuple[float | None, str]]:
    """Return every row's error [SI] at x (n,) [SI] in the dimension of largest ratio to the median, and that dimension.

    None for rows without length and angle; a known distance counts as length.
    """
    dimensions = ("length", "stated length", "angle", "stated angle")
    errors = np.array([problem.errors(x, dimension) for dimension in dimensions])
    medians = [np.median(each[np.isfinite(each)]) if np.isfinite(each).any() else 1.0 for each in errors]
    largest = np.nan_to_num(errors / np.maximum(medians, FINEST)[:, None]).argmax(axis=0)
    values = [float(e) if np.isfinite(e) else None for e in errors[largest, np.arange(errors.shape[1])]]
    return [(value, dimensions[k].rpartition(" ")[2]) for value, k in zip(values, largest, strict=True)]


def error_ratios(problem: CalibrationProblem, x: Array) -> Array:
    """Return the larger ratio (N,) of errors in length and in angle to the median of the measurement type.

    It is scaled to the same false rate for every type, at the deviations x (n,) [SI].
    """
    ratios = np.zeros(len(problem.data))
    for dimension in ("length", "angle"):
        counts = np.zeros(len(ratios), dtype=int)
        for block in problem.data.blocks:
            counts[block.row] = error_dimensions(block).count(dimension)
        if not counts.any():
            continue
        errors = np.nan_to_num(problem.errors(x, dimension))
        for k in np.unique(counts[counts > 0]):
            rows = np.flatnonzero(counts == k)
            median = max(float(np.median(errors[rows])), 1e-12)
            as_rare = np.sqrt(chdtri(int(k), FALSE_RATE) / chdtri(int(k), 0.5)) / BEYOND
            ratios[rows] = np.maximum(ratios[rows], errors[rows] / median / as_rare)
    return ratios


def resistant_fit(problem: CalibrationProblem, x: Array, scale: Array) -> Array:
    """Return deviations (n,) [SI] of a fit that is resistant to a few outliers.

    It has Huber's loss of the rows' errors over their median, by reweighted squares of the linearization at x, with
    prior scales (n,) [SI]::

        minimize    sum_i w_i |e_i|^2 / median^2 + |x / scale|^2,    w_i = min(1, FULL_WEIGHT median / |e_i|)
    """
    residual, jacobian = problem.slopes(x)
    X = jacobian * scale
    y = residual + jacobian @ x
    equations = Equations.of(problem.data)
    rows, length, angle = equations.row, equations.length, equations.angle
    kinds = [kind for kind in (length, angle, ~(length | angle)) if kind.any()]
    z = x / scale
    weight = np.ones(len(problem.data))
    for _ in range(STEPS):
        e = y - X @ z
        unit = np.empty_like(e)  # median error of an equation's kind
        for kind in kinds:
            count = np.bincount(rows[kind])
            mean = np.bincount(rows[kind], e[kind] ** 2) / np.maximum(count, 1)
            unit[kind] = max(float(np.sqrt(np.median(mean[count > 0]))), FINEST)
        size = np.sqrt(np.bincount(rows, (e / unit) ** 2) / np.bincount(rows))
        before = weight
        weight = np.minimum(1.0, FULL_WEIGHT / np.maximum(size, 1e-12))
        weighed = X * (weight[rows] / unit**2)[:, None]
        H = weighed.T @ X + np.eye(len(z))
        d = 1 / np.sqrt(H.diagonal())
        z = d * np.linalg.solve(H * np.outer(d, d), d * (weighed.T @ y))
        if np.abs(weight - before).max() <= SAME:
            break
    return scale * z


def outlier_candidates(problem: CalibrationProblem, x: Array, scale: Array, spare: float) -> dict[str, float]:
    """Return the error over the median, by label, of rows that may be outliers of a squared fit x (n,) [SI].

    ``scale`` (n,) are prior scales [SI]; the share ``spare`` of the equations is redundant.
    """
    ratio = error_ratios(problem, x)
    if spare < SPARE or ratio.max() < LOOK:
        return {}
    if len(problem.groups) < WELL_DETERMINED * len(x):
        ratio = error_ratios(problem, resistant_fit(problem, x, scale))
    return _alone(problem, x, {problem.labels[i]: float(ratio[i]) for i in np.flatnonzero(ratio > BEYOND)})


def _alone(problem: CalibrationProblem, x: Array, ratios: dict[str, float]) -> dict[str, float]:
    """Return the rows without clusters of neighbours."""
    rows = np.flatnonzero(np.isin(problem.labels, list(ratios)))
    return {problem.labels[i]: ratios[problem.labels[i]] for i in rows[~clustered(problem, x, rows)]}


def clustered(problem: CalibrationProblem, x: Array, rows: np.ndarray) -> np.ndarray:
    """Return which rows (r,) have errors like their neighbours in joint space: a model error, not outliers."""
    member = np.zeros(len(rows), dtype=bool)
    if len(rows) < NEIGHBOURS:
        return member
    q = problem.data.q
    unit = (q - q.mean(axis=0)) / (q.std(axis=0) + 1e-9)
    errors = np.nan_to_num(error_vectors(problem, x))
    length = np.maximum(np.linalg.norm(errors, axis=1), 1e-12)
    whose = np.array(problem.data.robot)
    together = problem.data.configuration
    if problem.touches is not None:  # touches of a point have one number, and differ in joint values
        together = stops(q)
    for k, i in enumerate(rows):
        apart = np.sum((unit - unit[i]) ** 2, axis=1)
        apart[(together == together[i]) | (whose != whose[i])] = np.inf
        j = int(np.argmin(apart))
        member[k] = j in rows and errors[i] @ errors[j] > ALIKE * length[i] * length[j]
    pairs = np.ceil(member.sum() / 2)  # two are each other's neighbour
    expected = len(rows) ** 2 / len(q) * (1 - ALIKE) / 2  # distributed at random, in random directions
    if pairs and pdtrc(pairs - 1, expected) >= RUN:
        member[:] = False
    return member


def coherent(problem: CalibrationProblem, x: Array, rows: np.ndarray) -> np.ndarray:
    """Return which rows (r,) are no outliers: with errors like their neighbours in joint space, or a run in time."""
    stop = stops(problem.data.q)
    visit = np.cumsum(np.diff(stop, prepend=stop[:1]) != 0)
    suspect = np.zeros(visit[-1] + 1, dtype=bool)
    suspect[visit[rows]] = True
    share = suspect.mean()
    edges = np.flatnonzero(np.diff(suspect, prepend=False, append=False))
    long = np.zeros(len(suspect), dtype=bool)
    for start, end in edges.reshape(-1, 2):
        # such a run starts at a given visit with probability share^length: not once in a hundred sets of data
        if end - start >= NEIGHBOURS and len(suspect) * share ** (end - start) < RUN:
            long[start:end] = True
    return clustered(problem, x, rows) | long[visit[rows]]


def beyond_noise(problem: Source, x: Array) -> dict[str, float]:
    """Return the rows that the noise of a fit x (n,) [SI] cannot explain, if no row alone influences it much."""
    norms, count = problem.whitened_errors(x)
    rare = chdtrc(count, norms**2) < FALSE_RATE
    typical = norms / np.sqrt(chdtri(count, 0.5))
    labels = problem.labels
    return {labels[i]: float(typical[i]) for i in np.flatnonzero(rare)}


def isolated(problem: CalibrationProblem, x: Array) -> dict[str, float]:
    """Return the rows that the noise of a fit x (n,) [SI] cannot explain, without clusters of neighbours."""
    return _alone(problem, x, beyond_noise(problem, x))


def unexplained(problem: CalibrationProblem, x: Array, covariance: Array, labels: dict[str, float]) -> dict[str, float]:
    """Return the excluded rows that a fit without them, x (n,) with covariance (n, n) [SI], cannot explain."""
    reasons = dict(labels)
    residual, J = problem.slopes(x)
    parts = by_block(problem, np.column_stack([residual, J]))
    for (block, part), V in zip(parts, problem.covariances(), strict=True):
        k = len(block.measurement.components)
        labelled = np.array([problem.labels[row] in labels for row in block.row])
        r, slopes = part[labelled][:, :, :1], part[labelled][:, :, 1:]
        S = slopes @ covariance @ slopes.transpose(0, 2, 1) + np.broadcast_to(V, (len(block.row), k, k))[labelled]
        squares = np.sum(r * np.linalg.solve(S, r), axis=(1, 2))
        for row in block.row[labelled][chdtrc(k, squares) > FALSE_RATE]:
            reasons.pop(problem.labels[row])
    return reasons


def contradicted(
    model: LinearModel, penalty: Quadratic | None, weight: float, width: Array, groups: np.ndarray
) -> np.ndarray:
    """Return which of some configurations (g,) are contradicted by the others.

    A robust loss may fit half of few equations at the expense of the other half, although none is wrong. So all
    possible outliers are removed together, and each is compared with the prediction of the rest, at the false rate of
    flags; the penalty has its weight, and ``width`` (n,) are prior scales in units of the stated ones::

        e' (sigma^2 (I + A_i H^-1 A_i'))^-1 e,    H = A' A + weight L' L of the rest,    e = b_i - A_i z
    """
    rest = kept_equations(model, ~np.isin(model.group, groups), 1.0)
    if penalty is not None:
        penalty = replace(penalty, L=penalty.matrix / (WIDE * width))
    form = ridge(rest, penalty)
    z = form.minima(np.array([weight]))[0]
    C = form.noise(weight) + form.prior(weight)
    undecided = form.undetermined(weight)
    spare = len(rest.b) - form.degrees_of_freedom(weight)
    sigma2 = 1.0
    if spare > 1:
        sigma2 = max(1.0, float(np.sum((rest.A @ z - rest.b) ** 2)) / spare)
    rare = RARE / len(np.unique(model.group))
    outlying = []
    for number in groups:
        A = model.A[model.group == number]
        e = A @ z - model.b[model.group == number]
        squares = float(e @ np.linalg.solve(np.eye(len(A)) + A @ C @ A.T, e)) / sigma2
        chance = chdtrc(len(A), squares)
        if sigma2 > 1:  # estimated: Fisher's F
            chance = fdtrc(len(A), spare, squares / len(A))
        decided = np.linalg.norm(A @ undecided) <= UNDECIDED * np.linalg.norm(A)
        outlying.append(bool(decided and chance < rare))
    return np.array(outlying, dtype=bool)
