"""Which configurations a robust loss trusts, and the squares that its fit amounts to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.terms import term
from rpim_opt.problem.linear import LinearModel
from rpim_opt.problem.source import Source

RARE = 0.01
"""What part of good sets of data have any configuration that counts as an outlier."""
SMALL = 1e-6
"""Residuals are taken as no smaller, in sigmas: below, a norm has no slope of its own."""


def _quantiles(beyond: float, count: np.ndarray) -> Array:
    """Return which chi-squared numbers with ``count`` (N,) degrees of freedom exceed with a probability."""
    several, which = np.unique(count, return_inverse=True)
    return chdtri(several, beyond)[which]


def noise_level(norms: Array, count: np.ndarray) -> float:
    """Return the noise that whitened norms (N,) with ``count`` equations show: median(norm / median of chi_k).

    At least 1, which is the declared noise.
    """
    return max(1.0, float(np.median(norms / np.sqrt(_quantiles(0.5, count)))))


def limits(noise: float, configurations: int, count: np.ndarray) -> Array:
    """Return above which norm one of so many configurations with ``count`` equations is an outlier."""
    return noise * np.sqrt(_quantiles(RARE / configurations, count))


def outlying(norms: Array, count: np.ndarray) -> Array:
    """Return above which whitened norm (N,) a row or configuration with ``count`` equations is an outlier.

    What one good set of data in a hundred would exceed, s sqrt(chi2_k^-1(1 - 0.01 / N)), with the declared noise s = 1
    or, where that is larger, median(norm / median of chi_k).
    """
    return limits(noise_level(norms, count), len(norms), count)


@dataclass(frozen=True)
class Trusted:
    """Keeps the equations that a robust loss trusts, weighed as it does: squares that its fit amounts to.

    Configurations above ``noise sqrt(chi2_k^-1(1 - 0.01 / configurations))`` are left out, with k their equations
    (`outlying`); the others are multiplied by the root of ``factor``. A `Reweigh` for measurements in parts too.
    """

    noise: float
    configurations: int
    factor: float

    def keeps(self, model: LinearModel, z: Array) -> np.ndarray:
        """Return which equations (m,) are trusted at z (n,)."""
        which, count = model.members
        norms = model.norms(model.A @ z - model.b)
        return (norms <= limits(self.noise, self.configurations, count))[which]

    def __call__(self, model: LinearModel, z: Array) -> tuple[LinearModel, float]:
        """Return the trusted equations; nothing is constant. z is (n,)."""
        return kept_equations(model, self.keeps(model, z), self.factor), 0.0


def kept_equations(model: LinearModel, keep: np.ndarray, factor: float) -> LinearModel:
    """Return some of a model's equations (m,), multiplied by the root of a factor."""
    A, b = np.compress(keep, model.A.T, axis=1).T, model.b[keep]  # the columns stand together, as LAPACK asks
    if factor != 1:
        A *= np.sqrt(factor)
        b *= np.sqrt(factor)
    return replace(model, A=A, b=b, group=model.group[keep])


def trusted(
    name: str, slope_at: Callable[[Array], Array | None], norms: Array, count: np.ndarray, over: str
) -> Trusted:
    """Return what a robust formulation trusts: its factor is the median of loss'(v) / (2 v) over what it keeps.

    v are the norms of the configurations; of a loss over equations norm / sqrt(count), each equation's share of it, so
    that it does not matter how the measurements are stored.

    Parameters
    ----------
    name
        The formulation's.
    slope_at
        The loss's slopes at numbers v, one each.
    norms, count
        (N,) whitened norms of the configurations, and how many equations each has.
    over
        ``"equation"`` or ``"configuration"``.

    Raises
    ------
    InputError
        For a loss without a slope, or one that rests on few equations (minimax).
    """
    noise = noise_level(norms, count)
    keep = norms <= limits(noise, len(norms), count)
    v = norms[keep]
    if over == "equation":
        v = v / np.sqrt(count[keep])
    v = np.maximum(v, SMALL)
    found, accepted = (
        f"formulation '{name}'",
        "a loss with slopes, which covariances and most rules need; monte_carlo, l_curve, k_fold do not",
    )
    slope = slope_at(v)
    if slope is None or len(slope) != len(v):
        raise InputError(found, "a loss without slope", accepted)
    factor = 0.0
    if len(v):
        factor = float(np.median(np.abs(slope) / (2 * v)))
    if not factor > 0:
        raise InputError(found, "a loss that rests on a few equations", accepted)
    return Trusted(noise, len(norms), factor)


def trusted_rows(source: Source, x: Array, formulation: Formulation) -> Trusted:
    """Return what a robust formulation trusts of measurements, wherever they stand, at deviations x (n,) [SI]."""
    norms, count = source.configuration_errors(x)

    def slope_at(v: Array) -> Array | None:
        return term(formulation.loss, len(v), f"formulation '{formulation.name}', loss").slope(v)

    return trusted(formulation.name, slope_at, norms, count, formulation.loss_over)
