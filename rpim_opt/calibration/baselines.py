"""Baseline methods without convex programming, for comparison."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.problem.problem import CalibrationProblem

__all__ = ["gauss_newton", "levenberg_marquardt", "linear_least_squares"]


class Baseline(NamedTuple):
    """Identified deviations (n,) [SI], and the number of iterations or evaluations."""

    x: Array
    iterations: int


def linear_least_squares(problem: CalibrationProblem) -> Baseline:
    """Linear least squares of the paper: one step from nominal, of smallest norm in units of the scales."""
    return gauss_newton(problem, iterations=1, cutoff=1e-12)


def gauss_newton(
    problem: CalibrationProblem, iterations: int = 20, tolerance: float = 1e-10, cutoff: float = 1e-8
) -> Baseline:
    """Gauss-Newton: repeat least-squares steps of smallest norm until they are shorter than ``tolerance`` scales.

    Weakly identifiable directions follow the noise. Singular values below ``cutoff`` times the largest count as zero:
    for a redundant direction they are rounding at nominal, and larger at inexact deviations.

    >>> import rpim_opt as ro
    >>> ro.baselines.gauss_newton(ro.load("position").problem).iterations < 20
    True
    """
    scale = problem.parameters.free.scale
    z, k = np.zeros_like(scale), 0
    while k < iterations:
        k += 1
        model = problem.linearize(scale * z)
        step = np.linalg.lstsq(model.A, model.b - model.A @ z, rcond=cutoff)[0]
        z = z + step
        if np.linalg.norm(step) <= tolerance * (1 + np.linalg.norm(z)):
            break
    return Baseline(scale * z, k)


def levenberg_marquardt(problem: CalibrationProblem) -> Baseline:
    """Levenberg-Marquardt of SciPy (MINPACK) on whitened residuals, with analytic Jacobian and 200 evaluations."""
    scale = problem.parameters.free.scale

    def slope(z: Array) -> Any:
        return -problem.linearize(scale * z).A

    if len(problem.owners) < len(scale):
        raise InputError("data", "fewer equations than parameters", "gauss_newton, or a calibration with a penalty")
    how: Any = {"method": "lm", "xtol": 1e-12, "ftol": 1e-12, "max_nfev": 200}
    solution = scipy.optimize.least_squares(lambda z: problem.whitened_residual(scale * z), 0 * scale, slope, **how)
    return Baseline(scale * solution.x, int(solution.nfev))
