"""Covariance of identified deviations and of the positions that they predict."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.quadratic import Ridge
from rpim_opt.problem.linear import LinearModel

UNSEEN = 1e-9
"""A position depends on an undecided direction where it moves by more than this part of what it moves by in all."""


@dataclass(frozen=True, eq=False)
class Spread:
    """The uncertainty of a squared fit with a squared penalty, noise and prior apart (`Uncertainty` says what for).

    Parameters
    ----------
    linear, form, weight
        The equations that the fit rests on, their closed form with the penalty, and its weight.
    z
        (n,) the solution in units of the scales.
    factor
        By how much a robust loss weighs the equations, against squared residuals in sigmas.
    drift
        (n, k) what learned sizes and heavy tails add: D with D D' a covariance of the deviations [SI], or None.
    level
        The noise's variance where it was learned with the scatter, in units of the equations'; None: the residuals say.
    """

    linear: LinearModel
    form: Ridge
    weight: float
    z: Array
    factor: float
    level: float | None = None
    drift: Array | None = None

    @property
    def degrees_of_freedom(self) -> float:
        """Of the fit: what the directions without penalty take, and sum s^2 / (s^2 + weight) over the others."""
        return self.form.degrees_of_freedom(self.weight)

    @cached_property
    def noise_variance(self) -> float:
        """sigma^2 = RSS / (m - dof) in units of the declared variance, or 1 where no equation is left over."""
        if self.level is not None:
            return self.level
        spare = self.linear.equations - self.degrees_of_freedom
        if spare <= 1e-6:
            return 1.0
        rss = float(np.sum((self.linear.A @ self.z - self.linear.b) ** 2))
        return rss / spare / self.factor

    def _in_si(self, C: Array) -> Array:
        scale = self.linear.parameters.scale
        return self.noise_variance * self.factor * C * np.outer(scale, scale)

    @cached_property
    def noise(self) -> Array:
        """Covariance (n, n) [SI] from the noise alone."""
        return self._in_si(self.form.noise(self.weight))

    @cached_property
    def prior(self) -> Array:
        """Mean square (n, n) [SI] of what the penalty holds back; directions that the data do not see are here."""
        found = self._in_si(self.form.prior(self.weight))
        if self.drift is not None:
            found = found + self.drift @ self.drift.T
        return found

    @cached_property
    def covariance(self) -> Array:
        """Covariance (n, n) [SI]; infinite variances where something moves that neither data nor penalty decide."""
        C = self.noise + self.prior
        open_ended = np.sum(self.form.undecided(self.weight) ** 2, axis=1) > 1e-12
        C[open_ended, open_ended] = np.inf
        return C

    def of_positions(self, J: Array) -> Array:
        """Return the covariances (N, 3, 3) [m^2] of positions with slopes J (N, 3, n) by the deviations [SI].

        A position that an undecided direction moves is not known: its variances are infinite. One that none moves is,
        even where no parameter alone is.
        """
        found = J @ (self.noise + self.prior) @ J.transpose(0, 2, 1)
        slopes = J * self.linear.parameters.scale
        moved = np.linalg.norm(slopes @ self.form.undecided(self.weight), axis=2)
        size = np.linalg.norm(slopes, axis=(1, 2))
        for i, axis in zip(*np.nonzero(moved > UNSEEN * size[:, None]), strict=True):
            found[i, axis, axis] = np.inf
        return found
