"""Transmission error of joints: a Gaussian process of each joint's own angle, estimated by restricted likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy
from scipy.linalg import block_diag, solve_triangular

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.threads import phase
from rpim_opt.bayes.evidence import CENTRES, NOISE_SD, Evidence, Linearized, Point, noise_share
from rpim_opt.bayes.hyperparameters import (
    CLOSE,
    FLATTEST,
    Estimator,
    Fit,
    Learned,
    Size,
    Transmitted,
    Trial,
    learned,
    parameter_values,
    read_noise,
)
from rpim_opt.bayes.model_selection import GAIN as FAMILY_GAIN
from rpim_opt.bayes.model_selection import SECOND, Candidate, compare_models, extended, identifiable, questions
from rpim_opt.bayes.prior_terms import Stated
from rpim_opt.convex.formulation import tikhonov
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.scatter import Scatter, Stack
from rpim_opt.robot.terms import EXPECTED_WAVE, Curve

TRANSMISSION = "transmission error"
"""The extension by curves of the joints' transmission error."""
GAIN = 12.0
"""By how much -2 ln L must fall for curves: real arms without them gain up to 10, of 162 simulated ones none 12."""
COLUMNS, FINEST = 400, 128
"""Harmonics of all joints together at most, sines and cosines; cycles a turn of the finest one."""
SHORTEST = 0.05
"""Travel of a joint [rad] from which its curve is looked for."""
BEYOND, LENGTHS = 0.3, 2.5
"""How far curves go on beyond the measured angles [rad], and in length scales at least: there they are unknown."""
CENTRE = {"size": 1e-4, "length": 0.2}
"""Prior medians of the size of curves and of their length scale [rad]."""
SPREAD = {"size": 2.0, "length": 1.5}
"""Prior standard deviations of their natural logarithms."""
STARTS = (0.3, 0.03)
"""Length scales [rad] from which the optimum is looked for."""
ACCURACY, STEPS = 0.3, 20
"""Slope of -2 ln L by the logarithms of hyperparameters at the optimum; steps towards it at most."""
ROUNDS, ITERATIONS = 3, 30
"""Linearizations at which curves are estimated, and iterations of the fits between them."""
LEAST = 2e-6
"""Noise [m or rad] from which its optimum is looked for at least."""
FREE = 1e6
"""Variance, in squared scales, of a deviation of which statements alone say something."""


class Curves(NamedTuple):
    """The curves of a robot's joints, as series that stand for Gaussian processes with Matern's covariance (3/2).

    ::

        f(q) = sum_k a_k cos(w_k q) + b_k sin(w_k q),    a_k, b_k ~ N(0, size^2 s_k),    w_k = 2 pi k / T
        s_k = 8 r^3 / (r^2 + w_k^2)^2 / T,    r = sqrt(3) / length
    """

    each: tuple[Curve, ...]

    @classmethod
    def over(cls, q: Array, joint_types: Sequence[str], margin: float) -> Curves:
        """Return the curves of the revolute joints that turned, for joint values (N, dof) [rad]."""
        low, high = q.min(axis=0), q.max(axis=0)
        travel = high - low
        joints = [j for j, kind in enumerate(joint_types) if kind == "revolute" and travel[j] > SHORTEST]
        periods = np.minimum(travel + 2 * margin, 2 * np.pi)
        cycles = min(FINEST, COLUMNS / 2 / max(np.sum(periods[joints]) / (2 * np.pi), 1e-9))
        return cls(
            tuple(
                Curve(
                    j + 1,
                    float(low[j] + high[j]) / 2,
                    float(periods[j]),
                    max(int(cycles * periods[j] / (2 * np.pi)), 1),
                )
                for j in joints
            )
        )

    def columns(self, q: Array, slopes: Array) -> Array:
        """Return the columns (m, c) of all coefficients, from joint values and slopes by them (m, dof)."""
        found = [np.zeros((len(q), 0))]
        for joint, centre, period, count in self.each:
            u = 2 * np.pi / period * np.clip(q[:, joint - 1] - centre, -period / 2, period / 2)
            angles = np.outer(u, np.arange(1, count + 1))
            found.append(slopes[:, [joint - 1]] * np.hstack([np.cos(angles), np.sin(angles)]))
        return np.hstack(found)

    def variances(self, length: float) -> tuple[Array, Array]:
        """Return ln s_k (c,), and its slopes by ln length."""
        w2 = np.concatenate([np.tile(2 * np.pi / c.period * np.arange(1, c.harmonics + 1), 2) ** 2 for c in self.each])
        period = np.concatenate([np.full(2 * c.harmonics, c.period) for c in self.each])
        r2 = 3 / length**2
        logarithm = np.log(8 * r2**1.5 / period) - 2 * np.log(r2 + w2)
        return np.asarray(logarithm, dtype=float), np.asarray(4 * r2 / (r2 + w2) - 3, dtype=float)


class Optimum(NamedTuple):
    """-2 ln of the restricted likelihood at logarithms of hyperparameters (h,), with its derivatives.

    ``information`` (h, h) is the average of its observed and expected second derivatives (Gilmour, Thompson and Cullis
    1995); ``z`` (p,), ``C`` (p, p) and its inverse H are the posterior of all deviations in prior standard deviations,
    ``moves`` (p, h) the slopes of z; ``scale`` (c,) standard deviations of the curves' coefficients [rad], ``scatter``
    the noise.
    """

    logs: Array
    value: float
    gradient: Array
    information: Array
    z: Array
    C: Array
    H: Array
    moves: Array
    scale: Array
    scatter: Scatter


@dataclass(frozen=True, eq=False)
class Restricted:
    """The restricted likelihood of curves and noise, geometry's local variances given.

    ::

        y = X z + F c + e,    z ~ N(0, I),    c ~ N(0, diag(size^2 s)),    e ~ N(0, R)
        C = (M'R^-1 M + I)^-1,    M = [X, F sqrt(size^2 s)]
        -2 ln L = y'P y + ln|R| - ln|C|,    P = R^-1 - R^-1 M C M'R^-1

    with z and c integrated out. For a parameter h of V = R + M M' the slope is tr(P V_h) - y'P V_h P y, and the average
    information y'P V_g P V_h P y.

    Parameters
    ----------
    data
        Equations, their columns in prior standard deviations.
    statements
        (k, p + 1) rows and values of what is known of z besides.
    noise, fixed
        Parts of the noise that are estimated, and the others.
    curves
        The curves, none for geometry alone.
    columns
        (m, c) those of their coefficients.
    """

    data: Linearized
    statements: Array
    noise: tuple[str, ...]
    fixed: Scatter
    curves: Curves
    columns: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the h hyperparameters."""
        return (*(CENTRE if self.curves.each else ()), *self.noise)

    @cached_property
    def _hyperprior(self) -> tuple[Array, Array]:
        centres = np.log([(CENTRES | CENTRE)[name] for name in self.names])
        return centres, np.array([SPREAD.get(name, NOISE_SD) for name in self.names])

    def at(self, logs: Array) -> Optimum:
        """Return the restricted likelihood at (h,)."""
        first = len(self.names) - len(self.noise)
        sizes = np.exp(logs)
        scale, growth = np.zeros(0), np.zeros(0)
        if first:
            share, growth = self.curves.variances(sizes[1])
            scale = sizes[0] * np.exp(share / 2)
        scatter = replace(self.fixed, **dict(zip(self.noise, map(float, sizes[first:]), strict=True)))
        M = np.hstack([self.data.X, self.columns * scale])
        p = M.shape[1]
        known = self.data.X.shape[1]
        white, right, shares, logdet = whitened(self.data.stacks, M, self.data.y, scatter, self.noise)
        rows = np.vstack([*white, np.pad(self.statements[:, :-1], ((0, 0), (0, p - known)))])
        y = np.concatenate([*right, self.statements[:, -1]])
        H = rows.T @ rows
        H.flat[:: p + 1] += 1
        factor = np.linalg.cholesky(H)
        inverse = solve_triangular(factor, np.eye(p), lower=True, check_finite=False)
        C = inverse.T @ inverse
        z = C @ (rows.T @ y)
        residual = y - rows @ z
        gradient = np.zeros(len(logs))
        moved = np.zeros((len(rows), len(logs)))  # V_h P y
        by_log = np.zeros((p - known, first))
        if first:
            by_log = np.column_stack([np.full(p - known, 2.0), growth])
            gradient[:first] = (1 - C.diagonal()[known:] - z[known:] ** 2) @ by_log
            moved[:, :first] = rows[:, known:] @ (by_log * z[known:, None])
        start = 0
        for part, parts in zip(white, shares, strict=True):
            k = parts.shape[-1]
            end = start + len(part)
            r = residual[start:end].reshape(-1, k, 1)
            half = (part @ inverse.T).reshape(-1, k, p)
            blocks = np.eye(k) - half @ half.transpose(0, 2, 1)  # of P
            for i, V in enumerate(parts, start=first):
                moved[start:end, i] = (V @ r).ravel()
                gradient[i] += np.sum(blocks * V) - moved[start:end, i] @ r.ravel()
            start = end
        across = rows.T @ moved
        information = moved.T @ moved - across.T @ C @ across
        moves = -C @ across
        if first:
            moves[known:, :first] += by_log * z[known:, None]
        centre, sd = self._hyperprior
        off = (logs - centre) / sd
        return Optimum(
            logs=logs,
            value=float(y @ residual + logdet + 2 * np.sum(np.log(factor.diagonal())) + off @ off),
            gradient=gradient + 2 * off / sd,
            information=information + 2 * np.diag(1 / sd**2),
            z=z,
            C=C,
            H=H,
            moves=moves,
            scale=scale,
            scatter=scatter,
        )

    def optimum(self, starts: Sequence[Array]) -> Optimum:
        """Return the optimum that is reached from the best of some starts (h,)."""
        best = min((self.at(start) for start in starts), key=lambda point: point.value)
        if not len(best.logs):
            return best

        def ask(logs: Array) -> Optimum:
            nonlocal best
            if not np.array_equal(logs, best.logs):
                best = self.at(logs.copy())
            return best

        options = {"gtol": ACCURACY, "initial_trust_radius": 1.0, "max_trust_radius": 2.0, "maxiter": STEPS}
        found = scipy.optimize.minimize(
            lambda logs: ask(logs).value,
            best.logs,
            method="trust-exact",
            jac=lambda logs: ask(logs).gradient,
            hess=lambda logs: ask(logs).information,
            options=options,
        )
        return ask(found.x)


def whitened(
    stacks: Sequence[Stack], X: Array, y: Array, scatter: Scatter, noise: tuple[str, ...]
) -> tuple[list[Array], list[Array], list[Array], float]:
    """Return L^-1 X (N k, p), L^-1 y (N k,) and L^-1 dR L^-T (q, N, k, k) by stack, with L L' = R, and ln|R|."""
    rows, right, shares, logdet = [], [], [], 0.0
    for stack in stacks:
        N, k = stack.index.shape
        L = np.linalg.cholesky(stack.covariance(scatter))
        inverse = np.linalg.inv(L)
        logdet += 2 * float(np.sum(np.log(np.diagonal(L, axis1=1, axis2=2))))
        rows.append((inverse @ X[stack.index]).reshape(N * k, -1))
        right.append((inverse @ y[stack.index][:, :, None]).ravel())
        parts = [2 * getattr(scatter, kind) ** 2 * noise_share(stack, kind) for kind in noise]
        each = np.array(parts).reshape(-1, N, k, k)
        shares.append(inverse @ each @ inverse.transpose(0, 2, 1))
    return rows, right, shares, logdet


# --- at a fit ---------------------------------------------------------------------------------------------------


class Curved(NamedTuple):
    """A problem with curves laid into it, its prior in units of its scales, where to begin (n,), hyperparameters."""

    problem: CalibrationProblem
    stated: Stated
    x: Array
    learned: Learned


def possible(problem: CalibrationProblem) -> bool:
    """Return whether every equation is of one stop of the joints of one robot, so that curves may explain it."""
    one_stop = all(block.q.shape[1] == 1 for block in problem.data.blocks)
    return len(problem.arms) == 1 and problem.touches is None and one_stop


class Learner:
    """Curves at a fit: how likely they are, and what they leave for the extensions of the geometry.

    Parameters
    ----------
    estimator
        With the prior.
    whole, x
        The problem that identifies all extensions, and where it is linearized (n,) [SI].
    """

    def __init__(self, estimator: Estimator, whole: CalibrationProblem, x: Array) -> None:
        self.evidence = estimator.evidence(whole, x)
        self.noise = self.evidence.noise
        stacks = whole.stacks(joints=True, at=parameter_values(whole, x))
        self.slopes = np.zeros((len(self.evidence.data.y), whole.robot.dof))
        for stack in stacks:
            self.slopes[stack.index] = stack.joint
        self.stacks = stacks
        self.q = whole.joint_values[whole.owners]
        self.joint_types = whole.robot.joint_types

    def likelihood(self, keep: np.ndarray, v: Array, curves: Curves) -> Restricted:
        """Return the likelihood of a model with some columns (p,), at local variances (k,)."""
        prior = self.evidence.prior
        width = np.sqrt(np.where(prior.replaced[keep], FREE * v, v))
        data = Linearized(self.evidence.data.X[:, keep] * width, self.evidence.data.y, self.stacks)
        statements = np.column_stack([prior.rows[:, keep] * width, prior.values])
        columns = curves.columns(self.q, self.slopes)
        return Restricted(data, statements, self.noise, self.evidence.fixed, curves, columns)

    def without(self, point: Optimum, curves: Curves) -> Evidence:
        """Return the marginal likelihood of geometry and extensions with curves and noise as they are at a point.

        Curves are integrated out: what remains of the equations after those of the curves, in a QR factor.
        """
        F = curves.columns(self.q, self.slopes) * point.scale
        c = F.shape[1]
        rows, right, _, _ = whitened(
            self.stacks, np.hstack([F, self.evidence.data.X]), self.evidence.data.y, point.scatter, ()
        )
        table = np.column_stack([np.vstack(rows), np.concatenate(right)])
        table = np.vstack([table, np.eye(c, table.shape[1])])
        triangle: Array = np.asarray(np.linalg.qr(table, mode="r"))
        R = triangle[c:, c:]
        m = len(R)
        every = np.ones((m, 1), dtype=bool)
        stack = Stack(np.arange(m)[:, None], np.ones((m, 1, 1)), every, ~every, np.zeros((m, 1, 0)))
        return replace(self.evidence, data=Linearized(R[:, :-1], R[:, -1], [stack]), noise=(), fixed=Scatter())

    def best(self, keep: np.ndarray, v: Array, starts: Sequence[Array]) -> tuple[Optimum, Curves]:
        """Return the most likely curves beside some columns, from some starts (h,)."""
        margin = BEYOND
        curves = Curves.over(self.q, self.joint_types, margin)
        point = self.likelihood(keep, v, curves).optimum(starts)
        if LENGTHS * np.exp(point.logs[1]) > 1.2 * margin:  # they reach further
            margin = min(LENGTHS * float(np.exp(point.logs[1])), np.pi)
            curves = Curves.over(self.q, self.joint_types, margin)
            point = self.likelihood(keep, v, curves).optimum([point.logs])
        return point, curves


def admitted(estimator: Estimator, fit: Fit, stated: Sequence[str], trials: tuple[Trial, ...]) -> Curved | None:
    """Return the model with curves, and the extensions that are selected beside them; None where they gain too little.

    Curves stand in the place of second harmonics. All other extensions are selected again, with curves in the model.

    Parameters
    ----------
    estimator
        With the prior, and the parts of the noise to estimate.
    fit
        Of the model without curves that was selected.
    stated
        Names of the parameters that were to be identified.
    trials
        The models that it was selected from, that one first.
    """
    p = fit.problem.parameters
    bare = fit.problem.with_parameters(replace(p, identified=np.isin(p.names, stated)))
    extensions = identifiable(bare)
    extensions.pop(SECOND, None)
    known = dict(zip(p.free.names, fit.x, strict=True))
    start = np.array([known[name] for name in bare.parameters.free.names])
    whole, x = extended(bare, start, [name for names in extensions.values() for name in names])
    x = np.array([known.get(name, 0.0) for name in whole.parameters.free.names])
    learner = Learner(estimator, whole, x)
    names = np.array(whole.parameters.free.names)
    before = dict(zip(p.free.names, fit.point.v, strict=True))

    def scales(keep: np.ndarray) -> Array:
        return np.array([before[name] for name in names[keep]])

    with phase("selection"):
        keep = np.isin(names, p.free.names)
        noise = np.log([max(getattr(fit.laid.scatter, kind), LEAST) for kind in learner.noise])
        plain = learner.likelihood(keep, scales(keep), Curves(())).optimum([noise])
        sizes = [np.append(np.log([CENTRE["size"], length]), plain.logs) for length in STARTS]
        point, curves = learner.best(keep, scales(keep), sizes)
        gain = plain.value - point.value
        if not curves.each or gain <= GAIN:
            return None
        geometry = learner.without(point, curves)

        def price(families: tuple[str, ...]) -> Candidate:
            used = {*stated, *(name for family in families for name in extensions[family])}
            evidence = geometry.restricted(np.isin(names, list(used)))
            best = evidence.optima(evidence.starts()[:1])[0]
            return Candidate(best.value + FAMILY_GAIN * questions(families), families, (best, used))

        found = sorted(compare_models(bare, extensions, price), key=lambda each: each.price)
        best, used = found[0].found
    q = whole.parameters
    base = whole.with_parameters(replace(q, identified=np.isin(q.names, list(used))))
    keep = np.isin(names, list(used))
    geometry, x = geometry.restricted(keep), x[keep]
    rounds = 0
    while True:  # curves take over what stood in the geometry, which moves
        with phase("selection"):
            local = geometry.optima([best.logs])[0]
            every = np.ones(len(x), dtype=bool)
            learner = Learner(estimator, base, x)
            point, curves = learner.best(every, local.v, [point.logs])
            geometry = learner.without(point, curves)
            local = geometry.optima([best.logs])[0]
            point = learner.likelihood(every, local.v, curves).at(point.logs)
        laid, prior, solved = _laid(estimator, base, point, curves, local)
        if estimator.refit is not None:
            solved = estimator.refit(laid, estimator.prior.penalized(tikhonov, prior), solved, ITERATIONS)
        moved = float(np.sqrt(np.mean(((solved[: len(x)] - x) / laid.parameters.free.scale[: len(x)]) ** 2)))
        x = solved[: len(x)]
        rounds += 1
        if moved <= CLOSE or rounds == ROUNDS:
            break
    q = base.parameters
    scale = q.scale.copy()
    scale[q.identified] = laid.parameters.free.scale[: len(local.v)]
    alone = base.with_parameters(replace(q, scale=scale))
    beside = Fit(base, geometry, local, (), alone, x)
    with_curves = tuple(
        Trial((*each.families, TRANSMISSION), trials[0].value - gain + each.found[0].value - best.value)
        for each in found
    )
    added = tuple(name for name in laid.parameters.free.names if name not in stated)
    learned = _learned(beside, laid, point, learner.stacks, learner.noise, gain)
    return Curved(laid, prior, solved, replace(learned, trials=(*with_curves, *trials), added=added))


def _laid(
    estimator: Estimator, base: CalibrationProblem, point: Optimum, curves: Curves, local: Point
) -> tuple[CalibrationProblem, Stated, Array]:
    """Return a problem with hyperparameters and curves laid into it, its prior in those units, and deviations (n,)."""
    stated = estimator.stated(base)
    width = stated.scale * np.sqrt(local.v)
    whole = base.scattered(None).with_transmission(curves.each)
    p = whole.parameters
    count = len(width)
    size = np.append(width, point.scale / p.free.scale[count:])
    z = point.z[:count] * np.where(stated.replaced, np.sqrt(FREE), 1.0)
    x = np.append(base.parameters.free.scale * (stated.centre + width * z), point.scale * point.z[count:])
    scale = p.scale.copy()
    scale[p.identified] *= size
    scatter = replace(point.scatter, at=parameter_values(whole, x))
    laid = whole.with_parameters(replace(p, scale=scale)).scattered(scatter)
    return laid, estimator.prior.stated(p).inside(size), x


def _learned(
    fit: Fit, laid: CalibrationProblem, point: Optimum, stacks: Sequence[Stack], noise: tuple[str, ...], gain: float
) -> Learned:
    """Return the hyperparameters of a fit beside curves, and of those.

    What the hyperparameters of the geometry leave open of its deviations goes on to the curves' coefficients::

        dc = -H_cc^-1 H_cz dz,    H = C^-1
    """
    plain = learned(fit)
    count = len(plain.local)
    w, U = np.linalg.eigh(point.information)
    root = U * np.sqrt(2 / np.maximum(w, FLATTEST))
    covariance = root @ root.T
    replaced = fit.evidence.prior.replaced
    unit = laid.parameters.free.scale.copy()
    unit[:count][replaced] *= np.sqrt(FREE)
    own = plain.drift / unit[:count, None]
    follow = -np.linalg.solve(point.H[count:, count:], point.H[count:, :count])
    drift = unit[:, None] * np.column_stack([np.vstack([own, follow @ own]), point.moves @ root])
    spread = np.sqrt(np.diag(covariance))
    sizes = [Size(float(v), float(s)) for v, s in zip(np.exp(point.logs), spread, strict=True)]
    first = len(CENTRE)
    read = read_noise(stacks, point.scatter)
    rest = [read_noise(stacks, replace(point.scatter, **{kind: 0.0})) for kind in noise]
    growth = 2 * (1 - np.array(rest) / read)
    vague = growth @ covariance[first:, first:] @ growth
    waves = np.full(len(unit) - count, EXPECTED_WAVE)
    return replace(
        plain,
        noise=dict(zip(noise, sizes[first:], strict=True)),
        local=np.append(plain.local, np.ones(len(waves))),
        freedom=float(max(2 / max(vague, 1e-3), 3.0)),
        covariance=block_diag(plain.covariance, covariance[first:, first:]),
        stated=np.append(plain.stated, waves),
        drift=drift,
        curves=Transmitted(sizes[0], sizes[1], gain),
    )
