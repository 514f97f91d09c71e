"""Poses that touch a surface: on it, within the limits, and hardly moved by what rounding changes."""

from __future__ import annotations

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.data.measurements.registry import MEASUREMENTS
from rpim_opt.problem import workspace
from rpim_opt.store.simulation import touching_poses

SURFACES = ("plane", "sphere")
COUNT = 30
"""Of the problems' 80 rows: no row depends on another one."""


def problem_of(name: str) -> ro.CalibrationProblem:
    whole = ro.load(name).problem
    return whole.on(whole.data.take(range(COUNT)))


def touched(name: str, seed: int = 0) -> tuple[ro.CalibrationProblem, np.ndarray, np.ndarray]:
    """Return a problem at its touching poses, its nominal deviations, and the residuals that were wanted (N,)."""
    problem = problem_of(name)
    x = np.zeros(len(problem.parameters.free))
    wanted = 2e-5 * np.random.default_rng(9).normal(size=len(problem.data))
    q = touching_poses(problem, x, wanted, np.random.default_rng(seed), share=0.9)
    data = ro.Dataset.of(q, np.empty((len(q), 0)), 2e-5, measurement=MEASUREMENTS[name])
    return problem.on(data), x, wanted


@pytest.mark.parametrize("name", SURFACES)
def test_poses_touch_within_the_limits(name: str) -> None:
    problem, x, wanted = touched(name)
    q = problem.data.blocks[0].q[:, 0]
    low, high = problem.robot.limits.T
    # distances are differences of metres, each rounded to 1e-16
    assert np.abs(problem.residual(x) - wanted).max() < 1e-14
    assert ((q >= low) & (q <= high)).all()
    # spread as the random poses are, uniform with deviation 0.9 / sqrt(12): a calibration sees every joint
    assert (np.std(q / (high - low), axis=0) > 0.15).all()


@pytest.mark.parametrize("name", SURFACES)
def test_a_change_in_the_last_digits_stays_there(name: str, monkeypatch) -> None:
    poses = touched(name)[0].data.blocks[0].q
    noise = np.random.default_rng(1)
    draw = workspace.random_candidates
    monkeypatch.setattr(
        workspace,
        "random_candidates",
        lambda *arguments: draw(*arguments) + 1e-12 * noise.normal(size=poses[:, 0].shape),
    )
    moved = np.abs(touched(name)[0].data.blocks[0].q - poses).max()
    # 1e-12 is ten thousand times what processors differ by; growing a thousandfold it would still be seen by nobody
    assert 0 < moved < 1e-9


def test_further_draws_do_not_depend_on_how_many_poses_were_tried() -> None:
    problem = problem_of("plane")
    x = np.zeros(len(problem.parameters.free))
    rng = np.random.default_rng(4)
    touching_poses(problem, x, np.zeros(len(problem.data)), rng)
    assert rng.normal() == np.random.default_rng(4).normal()


def test_a_surface_out_of_reach_is_refused() -> None:
    problem = problem_of("sphere")
    x = np.zeros(len(problem.parameters.free))
    with pytest.raises(ro.InputError, match="out of reach"):
        touching_poses(problem, x, np.full(len(problem.data), 50.0), np.random.default_rng(0))
