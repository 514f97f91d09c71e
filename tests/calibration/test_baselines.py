"""The usual methods: their steps are those of their textbooks, and they stop when they are told."""

from __future__ import annotations

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt import baselines
from tests.simulate import simulated

PROBLEM, TRUTH = simulated(("a[234]", "d5", "theta[23]"), noise=1e-6, sigma=1e-6)
SCALE = PROBLEM.parameters.free.scale


def test_one_linear_step_is_that_of_the_normal_equations() -> None:
    m = PROBLEM.linearize(0 * SCALE)
    found = baselines.linear_least_squares(PROBLEM)
    assert found.x == pytest.approx(SCALE * np.linalg.solve(m.A.T @ m.A, m.A.T @ m.b), rel=1e-6)
    assert found.iterations == 1
    assert baselines.gauss_newton(PROBLEM, iterations=1).x == pytest.approx(found.x, rel=1e-6)


def test_passes_are_counted_and_limited() -> None:
    for most in (1, 2, 3):
        assert baselines.gauss_newton(PROBLEM, iterations=most, tolerance=0.0).iterations == most
    loose = baselines.gauss_newton(PROBLEM, tolerance=1e-1)
    tight = baselines.gauss_newton(PROBLEM)
    assert loose.iterations < tight.iterations < 20


def test_all_end_where_the_data_decide() -> None:
    want = baselines.gauss_newton(PROBLEM).x
    assert baselines.levenberg_marquardt(PROBLEM).x == pytest.approx(want, rel=1e-4, abs=1e-9)


def test_too_few_equations_are_said() -> None:
    few, _ = simulated(configurations=3)
    with pytest.raises(ro.InputError, match="fewer equations than parameters"):
        baselines.levenberg_marquardt(few)
    just, truth = simulated(("a2", "theta1", "d5"), configurations=1, sigma=1e-6)
    met = just.errors(baselines.levenberg_marquardt(just).x)
    assert met.max() < 1e-3 * just.errors(0 * truth).max()
