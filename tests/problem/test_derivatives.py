"""Jacobians of the shipped problems against differences of the true residual, and stationarity against SciPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

import rpim_opt as ro
from tests import ROOT

NAMES = sorted(folder.name for folder in (ROOT / "problems").iterdir())
LONG = {"datum_cube": pytest.mark.slow}  # as 3.0, without noise
STEP = 3e-3
"""Of the differences, in prior standard deviations."""


def noisy(joint: float) -> ro.CalibrationProblem:
    """Return the faces of a cube, touched with noise [mrad] of the joints."""
    problem = ro.load("datum_cube").problem
    rng = np.random.default_rng(1)
    blocks = [
        replace(b, q=b.q + 1e-3 * joint * rng.normal(size=b.q.shape)) if b.measurement.touching else b
        for b in problem.data.blocks
    ]
    return problem.on(replace(problem.data, blocks=tuple(blocks)))


def differences(problem: ro.CalibrationProblem, x: np.ndarray) -> np.ndarray:
    """Return -d residual / dz (m, n), z = x / scale, by differences of fourth order."""
    scale = problem.parameters.free.scale

    def slope(k: int, step: float) -> np.ndarray:
        away = step * scale * (np.arange(len(x)) == k)
        return (problem.residual(x - away) - problem.residual(x + away)) / (2 * step)

    return np.column_stack([(4 * slope(k, STEP) - slope(k, 2 * STEP)) / 3 for k in range(len(x))])


@pytest.mark.parametrize("name", [*(pytest.param(name, marks=LONG.get(name, ())) for name in NAMES), 3.0])
def test_every_column_of_the_jacobian_is_the_derivative(name: str | float) -> None:
    problem = ro.load(name).problem if isinstance(name, str) else noisy(name)
    scale = problem.parameters.free.scale
    x = 0.2 * np.random.default_rng(0).normal(size=len(scale)) * scale
    J = problem.jacobian(x) * scale
    largest = np.abs(J).max(axis=0)
    off = np.abs(J - differences(problem, x)).max(axis=0)
    # columns that no row depends on are rounding: what the others are is their size
    assert (off / np.maximum(largest, 1e-4 * largest.max())).max() < 2e-6


def test_no_optimizer_finds_a_lower_objective() -> None:
    problem = noisy(1.0)
    scale = problem.parameters.free.scale
    z = ro.calibrate(problem, ro.tikhonov, weight=1.0).x / scale

    def terms(z: np.ndarray) -> np.ndarray:
        return np.append(problem.whitened_residual(z * scale), z)

    objective = np.sum(terms(z) ** 2)
    found = least_squares(terms, z, xtol=1e-12, ftol=1e-14, gtol=1e-14)  # slopes by differences
    assert 2 * found.cost > (1 - 1e-9) * objective
