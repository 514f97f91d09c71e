"""Baseline methods without convex programming, for comparison."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.problem.problem import CalibrationProblem

__all__ = [
    "gauss_newton",
    "gradient_descent",
    "levenberg_marquardt",
    "linear_least_squares",
]


class Baseline(NamedTuple):
    """Identified deviations (n,) [SI], the number of iterations or evaluations, and the method."""

    x: Array
    iterations: int
    method: str


def linear_least_squares(problem: CalibrationProblem) -> Baseline:
    """Linear least squares of the paper: one step from nominal, of smallest norm in units of the scales."""
    scale = problem.parameters.free.scale
    model = problem.linearize(np.zeros_like(scale))
    return Baseline(scale * np.linalg.lstsq(model.A, model.b, rcond=1e-12)[0], 1, "linear least squares")


def gauss_newton(
    problem: CalibrationProblem, iterations: int = 20, tolerance: float = 1e-10, cutoff: float = 1e-8
) -> Baseline:
    """Gauss-Newton: repeat least-squares steps of smallest norm until they are shorter than ``tolerance`` scales.

    Weakly identifiable directions wander where noise sends them. Singular values below ``cutoff`` times the largest are
    taken for zero: that of a redundant direction is rounding at nominal, and larger where deviations are not exact.

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
    return Baseline(scale * z, k, "Gauss-Newton")


def levenberg_marquardt(problem: CalibrationProblem) -> Baseline:
    """Levenberg-Marquardt of SciPy (MINPACK) on whitened residuals, with analytic Jacobian and 200 evaluations."""
    scale = problem.parameters.free.scale

    def residual(z: Array) -> Array:
        model = problem.linearize(scale * z)
        return model.A @ z - model.b

    if len(residual(np.zeros_like(scale))) < len(scale):
        raise InputError("data", "fewer equations than parameters", "gauss_newton, or a calibration with a penalty")

    def slope(z: Array) -> Array:
        return problem.linearize(scale * z).A

    jac: Any = slope
    found = scipy.optimize.least_squares(
        residual, np.zeros_like(scale), jac=jac, method="lm", xtol=1e-12, ftol=1e-12, max_nfev=200
    )
    return Baseline(scale * found.x, int(found.nfev), "Levenberg-Marquardt")


def gradient_descent(problem: CalibrationProblem, iterations: int = 1000, preconditioned: bool = False) -> Baseline:
    """Gradient descent on the sum of squares, with exact steps of the linear model.

    As in the paper it works on raw parameters (metres and radians); with ``preconditioned`` on deviations divided by
    the column norms of the Jacobian, which is what makes it move at all along the weak directions.
    """
    scale = problem.parameters.free.scale
    model = problem.linearize(np.zeros_like(scale))
    unit = np.ones_like(scale)
    if preconditioned:
        norms = np.linalg.norm(model.A, axis=0) / scale
        unit = 1 / np.where(norms > 0, norms, norms.max())
    x, k = np.zeros_like(scale), 0
    r = model.A @ (x / scale) - model.b
    while k < iterations:
        k += 1
        J = model.A / scale * unit
        g = J.T @ r
        if np.linalg.norm(g) <= 1e-12 * max(1.0, float(np.linalg.norm(r))):
            break
        step = -(g @ g) / float(np.sum((J @ g) ** 2)) * g * unit
        for _ in range(30):
            model = problem.linearize(x + step)
            after = model.A @ ((x + step) / scale) - model.b
            if after @ after <= r @ r:
                break
            step = step / 2
        else:
            break
        x, r = x + step, after
    return Baseline(x, k, "gradient descent, preconditioned" if preconditioned else "gradient descent")
