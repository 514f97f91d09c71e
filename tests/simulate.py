"""Simulated problems with a known truth, for the tests."""

from __future__ import annotations

import numpy as np

import rpim_opt as ro

ARM = ro.robot.Robot(
    "test arm",
    np.array(
        [
            [0.0, 0.0, 0.0, 0.33, 0.0],
            [-np.pi / 2, 0.05, -np.pi / 2, 0.0, 0.0],
            [0.0, 0.44, 0.0, 0.02, 0.0],
            [-np.pi / 2, 0.035, 0.0, 0.42, 0.0],
            [np.pi / 2, 0.0, 0.0, 0.0, 0.0],
            [-np.pi / 2, 0.0, np.pi, 0.08, 0.0],
        ]
    ),
)
ALL = ("alpha?", "a?", "theta?", "d?", "beta3", "tool_[xyz]", "base_*")


def simulated(
    identify=ALL, configurations=40, noise=0.0, seed=0, robot=ARM, size=1.0, sigma=5e-5
) -> tuple[ro.CalibrationProblem, np.ndarray]:
    """Return a problem and the true deviations, drawn `size` times the scales."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-2.0, 2.0, (configurations, robot.dof))
    tool = [0.03, -0.02, 0.06, 0.0, 0.0, 0.0]
    parameters = ro.robot.model_parameters(robot, tools={"": tool}).identify(identify)
    parameters = parameters.scaled({"base_mm": 5.0, "base_mrad": 5.0, "tool_mm": 5.0})
    empty = ro.Dataset.of(q, np.zeros((configurations, 3)), sigma)
    truth = size * rng.normal(size=len(parameters.free)) * parameters.free.scale
    problem = ro.CalibrationProblem(robot, parameters, empty)
    y = -problem.residual(truth).reshape(-1, 3) + noise * rng.normal(size=(configurations, 3))
    return problem.on(ro.Dataset.of(q, y, sigma)), truth
