"""Simulated arms: their kinematics are the package's, and their errors are within what parameters can take up."""

from __future__ import annotations

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.study.arms import KINDS, flange


@pytest.mark.parametrize("seed", range(len(KINDS)))
def test_an_arm_without_errors_is_its_drawing(seed: int) -> None:
    robot = ro.study.simulated_arm(seed, 10).problem.robot
    q = np.random.default_rng(1).uniform(-2, 2, (20, robot.dof))
    expected = ro.robot.forward_kinematics(robot, q)
    np.testing.assert_allclose(flange(robot, q, np.zeros((robot.dof, 6))), expected, atol=1e-12)


def test_an_error_is_behind_its_link() -> None:
    robot = ro.study.simulated_arm(0, 10).problem.robot
    q = np.random.default_rng(1).uniform(-2, 2, (20, robot.dof))
    errors = np.zeros((robot.dof, 6))
    errors[-1, 2] = 1e-3
    errors[-1, 5] = 0.1
    T = ro.robot.forward_kinematics(robot, q)
    moved = flange(robot, q, errors)
    np.testing.assert_allclose(moved[:, :3, 3], T[:, :3, 3] + 1e-3 * T[:, :3, 2], atol=1e-12)
    np.testing.assert_allclose(np.einsum("nij,nij->n", moved[:, :3, :3], T[:, :3, :3]), 1 + 2 * np.cos(0.1))


@pytest.mark.parametrize("seed", range(len(KINDS)))
def test_parameters_take_up_all_errors(seed: int) -> None:
    # a chain with six errors a link is a chain of the same kind: with 60 configurations only the noise is left
    arm = ro.study.simulated_arm(seed, 60, noise=1e-6, offset=0.017)
    result = ro.calibrate(arm.problem, weight=1e-9)
    assert np.sqrt(np.mean(result.errors(arm.true) ** 2)) < 2e-6


def test_few_configurations_are_some_of_the_many() -> None:
    few = ro.study.simulated_arm(4, 8)
    many = ro.study.simulated_arm(4, 20)
    np.testing.assert_array_equal(few.problem.data.q, many.problem.data.q[:8])
    np.testing.assert_array_equal(few.problem.data.blocks[0].y, many.problem.data.blocks[0].y[:8])
    np.testing.assert_array_equal(few.true.blocks[0].y, many.true.blocks[0].y)


def test_readings_have_the_declared_noise() -> None:
    arm = ro.study.simulated_arm(2, 10, noise=1e-4)
    noise = arm.read.blocks[0].y - arm.true.blocks[0].y
    assert np.std(noise) == pytest.approx(1e-4, rel=0.1)  # 600 numbers: 0.03 is one standard deviation
