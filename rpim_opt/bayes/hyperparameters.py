"""Estimation of prior scales and noise by marginal likelihood, alternated with relinearization."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import Brief, joined
from rpim_opt.bayes.evidence import (
    FARTHEST,
    Evidence,
    Hierarchy,
    Linearized,
    Point,
    Spectrum,
    tail_widening,
    widening,
    without_information,
)
from rpim_opt.bayes.prior import BASE, SESSIONS, Prior
from rpim_opt.bayes.prior_terms import ScaledPrior
from rpim_opt.convex.formulation import Formulation, tikhonov
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.noise import Repeatability, in_unit
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.terms import Curve

MOST = 1000  # configurations used for hyperparameters, drawn at random from more
SAME_SIZE, SAME_PLACE = 0.02, 0.01
"""Largest change of ln(hyperparameters), and of deviations over their scales (RMS), at convergence."""
SLOPES = 1e-2, 1e-5  # of -2 ln L by ln(hyperparameters), at the first linearization and at later ones
CLOSE = 0.1  # scales (RMS) within which the posterior mean at one linearization replaces a fit
ITERATIONS = 6  # of the first fit between two estimates; twice as many in later ones
VAGUE = 1.0  # standard deviation of its logarithm above which a geometric scale is hardly identified
FLATTEST = 0.05  # lower bound on the second derivatives of -2 ln L
Refit = Callable[[Source, Formulation, Array, int], Array]
"""From problem, formulation, start [SI] and number of iterations to deviations (n,) [SI] near a minimum."""


class Hyperparameter(NamedTuple):
    """A hyperparameter: the scale of a group of deviations over the stated one, or a part of the noise [m or rad].

    ``log_std`` is the standard deviation of its natural logarithm.
    """

    value: float
    log_std: float


class Trial(NamedTuple):
    """A set of model extensions, and -2 ln of the restricted likelihood with them."""

    extensions: tuple[str, ...]
    value: float


class ExcludedRow(NamedTuple):
    """A row that was excluded as an outlier: the ratio of its error to the median error, and the error [SI]."""

    label: str
    ratio: float
    error: float | None = None  # None if the row has neither length nor angle
    dimension: str = "length"

    def __str__(self) -> str:
        """Return the row with its error."""
        error = filter(None, [in_unit(self.error, self.dimension), f"{self.ratio:.0f} times the median error"])
        return f"{self.label} ({', '.join(error)})"


class Transmitted(NamedTuple):
    """Standard deviation and length scale of transmission errors [rad], and the decrease of -2 ln L."""

    size: Hyperparameter
    length: Hyperparameter
    gain: float


@dataclass(frozen=True, eq=False, repr=False)
class Learned(Brief):
    """Hyperparameters estimated from the data.

    ``scales`` are those of the groups of deviations over the stated ones; ``noise`` is the robot's repeatability in
    ``position`` [m], ``orientation`` and ``joint`` [rad], ``reading`` [m], and ``instrument`` over the stated noise;
    ``covariance`` (s, s) is that of the logarithms of both. ``local`` (n,) are local scales of deviations over those of
    their groups, 1 without heavy tails; ``stated`` (n,) the stated scales [SI]. ``trials`` are the compared models, the
    selected one first; ``value`` is the final -2 ln of the restricted likelihood, ``noise_dof`` the degrees of freedom
    of a reading's variance (Satterthwaite). ``drift`` (n, k) is D, where D D' is the covariance [SI] due to uncertain
    hyperparameters, heavy tails, and model errors outside the measured ranges. ``left_out`` are excluded outliers, the
    worst first, ``added`` parameters of model extensions, ``notes`` sentences on what the marginal likelihood leaves
    undecided, ``contradicted`` sentences on known values that the data contradict, and ``curves`` the joints'
    transmission errors, None without them.
    """

    scales: Mapping[str, Hyperparameter]
    noise: Mapping[str, Hyperparameter]
    local: Array
    trials: tuple[Trial, ...]
    value: float
    noise_dof: float
    left_out: tuple[ExcludedRow, ...]
    covariance: Array
    stated: Array
    drift: Array
    added: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    contradicted: tuple[str, ...] = ()
    curves: Transmitted | None = None

    def _short(self) -> str:
        scales = ", ".join(f"{name} {scale.value:.3g}" for name, scale in self.scales.items())
        return f"hyperparameters: {scales}; {len(self.left_out)} rows excluded"

    @property
    def extensions(self) -> tuple[str, ...]:
        """The extensions of the selected model."""
        return next((trial.extensions for trial in self.trials), ())

    def gain(self, extension: str) -> float | None:
        """Return the decrease of -2 ln L when an extension is added to the best model without it."""
        having = [t.value for t in self.trials if extension in t.extensions]
        without = [t.value for t in self.trials if extension not in t.extensions]
        if not having or not without:
            return None
        return float(min(without) - min(having))


def sessions_log_std(learned: Learned | None) -> float:
    """Return the standard error of the logarithm of the session offsets' scale; zero if it was not estimated."""
    if learned is None:
        return 0.0
    return max((learned.scales[name].log_std for name in SESSIONS.values() if name in learned.scales), default=0.0)


@dataclass(frozen=True, eq=False)
class Fit:
    """A problem with hyperparameters applied, and its linearization point.

    ``problem`` has its stated scales and the prior ``stated``; ``evidence`` is the last marginal likelihood, ``point``
    its optimum, ``others`` are further optima. ``laid`` is the problem with local scales and noise, an ordinary
    Tikhonov problem at weight 1, and ``x`` (n,) its solution [SI], by this ``estimator``.
    """

    problem: CalibrationProblem
    stated: ScaledPrior
    evidence: Evidence
    point: Point
    others: Sequence[Point]
    laid: CalibrationProblem
    x: Array
    estimator: Estimator

    @property
    def spare(self) -> float:
        """Fraction of the equations that remain as degrees of freedom of the noise."""
        used = float(np.sum(1 - np.diag(self.point.C) / self.point.v))
        return 1 - used / len(self.evidence.data.y)

    @property
    def unit(self) -> Array:
        """Units (n,) [SI] of the deviations in the marginal likelihood."""
        return self.problem.parameters.free.scale * self.stated.scale

    @property
    def covariance(self) -> Array:
        """Covariance (n, n) of the deviations [SI]."""
        return self.point.C * np.outer(self.unit, self.unit)

    @property
    def inside(self) -> ScaledPrior:
        """The prior in units of the estimated scales."""
        return self.stated.inside(self.stated.scale * np.sqrt(self.point.v))


@dataclass(frozen=True, eq=False)
class Estimator:
    """Estimator of hyperparameters, with a prior and the variance components to estimate.

    ``refit`` continues a Tikhonov fit at weight 1 from one linearization; without it the posterior mean is used
    instead. The coefficients of ``curves``, transmission errors of joints, are the last parameters of a problem.
    """

    prior: Prior
    noise: tuple[str, ...]
    refit: Refit | None = None
    curves: tuple[Curve, ...] = ()

    def evidence(self, problem: CalibrationProblem, x: Array, stated: ScaledPrior | None = None) -> Evidence:
        """Return the marginal likelihood of a linearization at x (n,) [SI]."""
        free = problem.parameters.free
        stated = stated or self.prior.stated(problem.parameters)
        residual, jacobian = problem.slopes(x)
        J = problem.contrasts(jacobian)
        y = problem.contrasts(residual[:, None])[:, 0] + J @ x
        require_finite(J, y)
        unit = free.scale * stated.scale
        stacks = problem.stacks(joints="joint" in self.noise, at=problem.parameters.values_at(x))
        data = Linearized(J * unit, y - J @ (free.scale * stated.centre), stacks)
        hierarchy = Hierarchy(
            group=stated.group,
            heavy=stated.heavy,
            names=stated.names,
            tails=self.prior.tails,
            replaced=stated.replaced,
            rows=stated.rows * stated.scale,
            values=stated.values - stated.rows @ stated.centre,
            spectrum=spectrum_of(self.curves, unit),
        )
        have = {"instrument"}
        if any(stack.unit is not None or stack.length.any() for stack in stacks):
            have |= {"position", "joint"}
        if problem.touches is None and any(stack.unit is not None and stack.length.any() for stack in stacks):
            have.add("reading")
        if any(stack.angle.any() for stack in stacks):
            have.add("orientation")
        noise = tuple(kind for kind in self.noise if kind in have)
        return Evidence(data, hierarchy, noise, problem.repeatability or Repeatability())

    def fit(self, problem: CalibrationProblem, x: Array, before: Array | None, rounds: int) -> Fit:
        """Alternate hyperparameters and deviations to a fixed point, with a limited number of linearizations.

        The start is x (n,) [SI], with logarithms of hyperparameters or None. All of several optima are continued: with
        few data and frames far from their start, their order changes with the linearization.
        """
        first = self._once(problem, x, before, 0)
        fits = [first, *(self._once(problem, x, other.logs, 0) for other in first.others)]
        for i, fit in enumerate(fits):
            for k in range(1, rounds):
                again = self._once(problem, fit.x, fit.point.logs, k)
                moved = _distance(again.x, fit.x, again.laid)
                resized = np.abs(again.point.logs - fit.point.logs).max(initial=0.0)
                fit = fits[i] = again
                if resized <= SAME_SIZE and moved <= SAME_PLACE:
                    break
        return min(fits, key=lambda fit: fit.point.value)

    def _once(self, problem: CalibrationProblem, x: Array, known: Array | None, k: int) -> Fit:
        """Estimate hyperparameters at linearization k, starting from given values (s,), or from several starts."""
        p = problem.parameters
        prior = self.prior.stated(p)
        evidence = self.evidence(problem, x, prior)
        point, *others = evidence.optima(evidence.starts() if known is None else [known], SLOPES[min(k, 1)])
        scale = p.scale.copy()
        scale[p.identified] *= prior.scale * np.sqrt(point.v)
        repeatability = replace(evidence.repeatability(point.logs), at=p.values_at(x))
        laid = replace(problem, parameters=replace(p, scale=scale), repeatability=repeatability)
        mean = p.free.scale * (prior.centre + prior.scale * point.z)
        fit = Fit(problem, prior, evidence, point, others, laid, mean, self)
        if self.refit is None or _distance(mean, x, laid) <= CLOSE:  # near enough for one linearization
            return fit
        return replace(fit, x=self.refit(laid, fit.inside.penalized(tikhonov), x, ITERATIONS * 2**k))


def spectrum_of(curves: Sequence[Curve], unit: Array) -> Spectrum:
    """Return prior variances of curve coefficients, which are the last of the (n,) deviations in these units [SI]."""
    w, share = [np.zeros(0)], [np.zeros(0)]
    for curve in curves:
        step = 2 * np.pi / curve.period
        own = np.append(np.arange(1.0, curve.waves + 1), step * np.arange(1, curve.harmonics + 1))
        between = np.concatenate([[own[0] / 2], (own[1:] + own[:-1]) / 2, [own[-1] + step / 2]])
        w += [own, own]
        share += [np.diff(between) / (2 * np.pi)] * 2  # a coefficient represents the frequencies closest to its own
    frequencies = np.concatenate(w)
    return Spectrum(frequencies**2, unit[len(unit) - len(frequencies) :] ** 2 / np.concatenate(share))


def sampled(problem: Source, most: int = MOST) -> CalibrationProblem:
    """Return the problem with all configurations in memory, or a random sample of them from every block."""

    def drawn(problem: CalibrationProblem, most: int) -> CalibrationProblem:
        few = len(np.unique(problem.data.configuration)) <= most
        return problem if few else problem.on(problem.data.configurations(most, seed=0))

    if isinstance(problem, CalibrationProblem):
        return drawn(problem, most).frozen()
    count = sum(1 for _ in problem.rows())
    parts = [drawn(part, max(most // count, 1)).data for part in problem.rows()]
    return problem.on(Dataset.together(parts, [str(i) for i in range(len(parts))])).frozen()


def require_finite(*arrays: Array) -> None:
    """Refuse non-finite residuals or derivatives."""
    if not all(np.isfinite(values).all() for values in arrays):
        accepted = "finite measurements and a finite model; user-defined terms need ca.sin, not math.sin"
        raise InputError("data", "non-finite residuals or derivatives", accepted)


def _distance(x: Array, before: Array, laid: CalibrationProblem) -> float:
    """Return the RMS change of deviations (n,) in units of their scales."""
    return float(np.sqrt(np.mean(((x - before) / laid.parameters.free.scale) ** 2)))


# --- how well they are known ------------------------------------------------------------------------------------


def learned(fit: Fit, gain: float = 0.0, **more: Any) -> Learned:
    """Return the hyperparameters of a fit with their standard errors; ``gain`` is the decrease by transmission errors.

    Their covariance (s, s) is twice the inverse of the second derivatives of -2 ln L; the variance V of a reading has
    Satterthwaite's degrees of freedom 2 V^2 / var(V), at least three.
    """
    evidence, point, prior = fit.evidence, fit.point, fit.evidence.prior
    curvature, U = np.linalg.eigh((point.curvature + point.curvature.T) / 2)
    root = U * np.sqrt(2 / np.maximum(curvature, FLATTEST))
    covariance = root @ root.T
    spread = np.sqrt(np.diag(covariance))
    # slopes (s,) of ln V by the logarithms of hyperparameters, V = tr(X C X' + R) of all lengths (else angles, pixels)
    stacks = evidence.data.stacks
    reads = [next(kind for kind in map(stack.of, ("length", "angle", "pixel")) if kind.any()) for stack in stacks]
    X = np.vstack([evidence.data.X[stack.index[read]] for stack, read in zip(stacks, reads, strict=True)])
    repeatability = evidence.repeatability(point.logs)

    def variance(repeatability: Repeatability) -> float:
        parts = [np.einsum("nkk->nk", stack.covariance(repeatability)) for stack in stacks]
        return sum(float(np.sum(part[read])) for part, read in zip(parts, reads, strict=True))

    growth = point.falls(point.C @ (X.T @ X) @ point.C)
    for i, kind in enumerate(evidence.noise, len(growth) - len(evidence.noise)):  # R is a sum of squared noises
        growth[i] += 2 * (variance(repeatability) - variance(replace(repeatability, **{kind: 0.0})))
    growth = growth / (float(np.sum((X @ point.C) * X)) + variance(repeatability))
    values = [Hyperparameter(float(v), float(s)) for v, s in zip(np.exp(point.logs), spread, strict=True)]
    groups, noise = len(prior.names), len(prior.hyperparameters)
    plain = np.delete(np.arange(len(values)), slice(groups, noise))  # without the curves'
    size = np.append(np.exp(point.logs[:groups]), np.nan)[prior.group]
    local = np.sqrt(point.v) / size
    heavy = np.flatnonzero(prior.heavy & ~prior.replaced)
    scales = np.sqrt(prior.variances(point.logs)[0][heavy])
    notes = []
    far = np.array(evidence.names)[np.abs(point.logs - evidence.centre) > FARTHEST - 0.01].tolist()
    if far:
        notes.append(f"Implausibly far from prior medians: {joined(far)}. Check units, scales and stated noise.")
    vague = [i for i in prior.geometry if spread[i] > VAGUE]
    if vague:
        names = joined([prior.names[i] for i in vague])
        factor = f"standard uncertainty: a factor of {np.exp(max(spread[vague])):.1f}"
        notes.append(f"The data hardly identify the prior scale of {names} ({factor}).")
    m, n = evidence.data.X.shape
    if m < n:
        rest = f"at least {n - m} parameter combinations are unidentifiable."
        notes.append(f"{m} equations for {n} parameters: {rest}")
    # the base was registered with the nominal robot: its distance from there, from which its scale is estimated, does
    # not show what the registration absorbed of joint 1; only the stated scale does
    of_base = np.array([*prior.names, ""])[prior.group] == BASE
    taken = np.where(of_base & ~prior.replaced, np.maximum(1 / point.v - 1, 0.0), 0.0)
    widened = without_information(point.C, taken)
    C = point.C + widened @ widened.T
    drift = [point.slopes @ root, widened]
    drift.append(tail_widening(point.z + C @ (taken * point.z), C, point.v, heavy, scales, prior.tails))
    if not len(prior.spectrum.w2):  # curves have an own prior; a prediction may leave the range of any joint
        factors = evidence.overdispersion(point, fit.problem.joint_values[fit.problem.owners])
        drift.append(widening(point.C, float(factors.max()), prior.rows))
    curves = None
    if len(prior.spectrum.w2):
        curves = Transmitted(*values[groups:noise], gain=gain)
    return Learned(
        scales=dict(zip(prior.names, values[:groups], strict=True)),
        noise=dict(zip(evidence.noise, values[noise:], strict=True)),
        local=np.where(np.isfinite(size), local, 1.0),
        value=point.value,
        noise_dof=float(max(2 / max(growth @ covariance @ growth, 1e-3), 3.0)),
        covariance=covariance[np.ix_(plain, plain)],
        stated=fit.problem.parameters.free.scale,
        drift=fit.unit[:, None] * np.column_stack(drift),
        notes=tuple(notes),
        curves=curves,
        **more,
    )
