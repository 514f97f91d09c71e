"""Covariances of deviations and positions, intervals of a position, and the test of the measurement noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri, stdtrit

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.quadratic import Ridge
from rpim_opt.data.record import UNLIKELY
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.linear import LinearModel
from rpim_opt.problem.multi_robot import unknown_sessions
from rpim_opt.problem.problem import CalibrationProblem

Interval = Literal["mean", "reached", "reading"]
UNDECIDED = 1e-9  # share of a position's movement by an undetermined direction above which the position is undetermined


@dataclass(frozen=True, eq=False)
class FitCovariance:
    """Covariance of a least-squares fit with a quadratic penalty, noise and prior separately (see `Uncertainty`).

    ``linear``, ``form`` and ``weight`` are the equations of the fit, their closed form with the penalty, and its
    weight; ``z`` (n,) is the solution in units of the scales. ``level`` is the noise's variance in units of the
    equations', if it was estimated with the repeatability. ``drift`` (n, k) is D, where D D' [SI] is the covariance
    added by estimated hyperparameters and heavy tails.
    """

    linear: LinearModel
    form: Ridge
    weight: float
    z: Array
    level: float | None = None
    drift: Array | None = None

    @property
    def degrees_of_freedom(self) -> float:
        """Degrees of freedom of the fit: unpenalized directions, and sum s^2 / (s^2 + weight) over the others."""
        return self.form.degrees_of_freedom(self.weight)

    @property
    def residual_dof(self) -> float:
        """Residual degrees of freedom, m - dof; with a robust loss of the equations that it keeps."""
        return self.linear.equations - self.degrees_of_freedom

    @cached_property
    def noise_variance(self) -> float:
        """sigma^2 = RSS / (m - dof) in units of the stated variance; 1 without residual degrees of freedom."""
        if self.level is not None:
            return self.level
        if self.residual_dof <= 1e-6:
            return 1.0
        return float(np.sum((self.linear.A @ self.z - self.linear.b) ** 2)) / self.residual_dof / self.linear.factor

    def _in_si(self, C: Array) -> Array:
        scale = self.linear.parameters.scale
        return self.noise_variance * self.linear.factor * C * np.outer(scale, scale)

    @cached_property
    def noise(self) -> Array:
        """Covariance (n, n) [SI] from the noise alone."""
        return self._in_si(self.form.noise(self.weight))

    @cached_property
    def prior(self) -> Array:
        """Mean-square bias (n, n) [SI] due to the penalty, mostly in unidentifiable directions."""
        covariance = self._in_si(self.form.prior(self.weight))
        if self.drift is not None:
            covariance = covariance + self.drift @ self.drift.T
        return covariance

    @cached_property
    def covariance(self) -> Array:
        """Covariance (n, n) [SI]; infinite for combinations that neither data nor penalty determines."""
        C = self.noise + self.prior
        open_ended = np.sum(self.form.undetermined(self.weight) ** 2, axis=1) > 1e-12
        C[open_ended, open_ended] = np.inf
        return C

    def of_positions(self, J: Array) -> Array:
        """Return the covariances (N, 3, 3) [m^2] of positions with derivatives J (N, 3, n) by the deviations [SI].

        Variances are infinite if an undetermined direction moves the position; otherwise they are finite, even if no
        single parameter is determined.
        """
        covariance = J @ (self.noise + self.prior) @ J.transpose(0, 2, 1)
        variances = np.einsum("nkk->nk", covariance)
        np.maximum(variances, 0.0, out=variances)  # along directions fixed by constraints only rounding is left
        slopes = J * self.linear.parameters.scale
        moved = np.linalg.norm(slopes @ self.form.undetermined(self.weight), axis=2)
        size = np.linalg.norm(slopes, axis=(1, 2))
        for i, axis in zip(*np.nonzero(moved > UNDECIDED * size[:, None]), strict=True):
            covariance[i, axis, axis] = np.inf
        return covariance


class NoiseCovariances(NamedTuple):
    """Covariances added to that of the rows' model, block by block (N, k, k) [SI].

    ``robot`` is the robot's repeatability, ``reading`` adds the instrument's noise and ``session``, the offset of a
    session that the problem does not know.
    """

    robot: list[Array]
    reading: list[Array]
    session: list[Array]


def noise_covariances(problem: CalibrationProblem, level: float) -> NoiseCovariances:
    """Return the covariances that robot and instrument add to the model of some measurements.

    If repeatability was not estimated, the robot's part is the excess of residuals over the stated noise, (level - 1)
    Sigma, with ``level`` the noise's variance over the stated one, at least 1.
    """
    session = unknown_sessions(problem)
    if problem.repeatability is not None:
        robot, reading = problem.covariances(reading=False), problem.covariances()
    else:
        stated = problem.covariances()
        robot, reading = [(level - 1) * V for V in stated], [level * V for V in stated]
    return NoiseCovariances(robot, [V + more for V, more in zip(reading, session, strict=True)], session)


def position_noise(source: Source) -> Array:
    """Return the median covariance (3, 3) [m^2] of a position reading; zero if no position was measured."""
    for part in source.rows():
        seen = [b.covariance[:, :3, :3] for b in part.data.blocks if b.measurement.name in ("position", "pose")]
        if seen:
            return np.asarray(np.median(np.concatenate(seen), axis=0), dtype=float)
    return np.zeros((3, 3))


def coverage_factor(dof: float | Array, confidence: float) -> Array:
    """Return the quantile k of Student's t at (1 + confidence) / 2, with at least one degree of freedom."""
    if not 0 < confidence < 1:
        raise InputError("confidence", f"{confidence}", "a probability between 0 and 1")
    return np.asarray(stdtrit(np.maximum(dof, 1.0), (1 + confidence) / 2), dtype=float)


def row_dof(dof: float, log_std: float, whole: Array, session: Array) -> Array:
    """Return the degrees of freedom (N,) of the rows' variances, at least one; few sessions reduce them.

    2 V^2 / var(V) of the sum V of both parts' variances (Satterthwaite), with ``dof`` those of the part without
    session, ``log_std`` the standard deviation of the logarithm of the session offsets' scale, and covariances (N, k,
    k) of a row and of the part by an unknown session.
    """
    dof = max(dof, 1.0)
    V = np.einsum("nkk->n", whole)
    part = np.broadcast_to(np.einsum("nkk->n", session), V.shape)
    variance = 2 * (V - part) ** 2 / dof + (2 * log_std * part) ** 2
    return np.maximum(np.minimum(2 * V**2 / np.maximum(variance, 1e-300), dof), 1.0)


class NoiseTest(NamedTuple):
    """Ratio of observed to stated standard deviation, its two-sided p-value under the stated noise, and a verdict."""

    ratio: float
    probability: float
    verdict: str

    @property
    def overstated(self) -> bool:
        """Whether residuals are so small that the stated noise must be too large."""
        return self.probability < UNLIKELY and self.ratio < 1


def noise_test(squares: float, dof: float) -> NoiseTest:
    """Compare a sum of squared whitened residuals with its chi-squared distribution."""
    if dof < 1:
        return NoiseTest(1.0, 1.0, "No degrees of freedom remain to test the measurement noise.")
    ratio = float(np.sqrt(squares / dof))
    upper = float(chdtrc(dof, squares))
    probability = 2 * min(upper, 1 - upper)
    if probability >= UNLIKELY:
        low, high = np.sqrt(chdtri(dof, [1 - UNLIKELY / 2, UNLIKELY / 2]) / dof)
        found = f"ratio {ratio:.2f}; by chance {low:.2f} to {high:.2f} in {100 * (1 - UNLIKELY):g} % of fits"
        return NoiseTest(ratio, probability, f"Residuals agree with the measurement noise ({found}).")
    cause = "the noise is smaller than stated"
    if upper < 0.5:
        cause = "the robot's repeatability, noise larger than stated, wrong rows, or an effect that the model lacks"
    return NoiseTest(ratio, probability, f"Residuals are {ratio:.2f} times the measurement noise: {cause}.")
