"""Frames that fit the data on the nominal robot: as by a calibration of the frames alone, in memory and in parts."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.optimize import least_squares

import rpim_opt as ro
from rpim_opt.problem import PartitionedProblem, fitted_frames
from rpim_opt.problem import blocks as parts_module
from rpim_opt.problem.blocks import in_parts

NAMES = ["position", "pose", "markers", "cable", "distance", "mixed", "plane", "sphere", "far_frames", "scara"]


@pytest.mark.parametrize("name", NAMES)
def test_they_are_a_calibration_of_frames_alone(name: str) -> None:
    problem = ro.load(name).problem
    fitted, x = fitted_frames(problem)
    frames = problem.parameters.of_frames & problem.parameters.identified
    wanted = ro.calibrate(problem.identifying(frames), ro.tikhonov, 1.0, max_iterations=100)
    np.testing.assert_array_equal(fitted.parameters.nominal, wanted.problem.parameters.nominal)
    assert (np.abs(x - wanted.x) / fitted.parameters.free.scale).max() < 1e-9


def test_they_minimize_what_they_say() -> None:
    problem = ro.load("position").problem
    fitted, x = fitted_frames(problem)
    scale = fitted.parameters.free.scale

    def stacked(z: np.ndarray) -> np.ndarray:
        model = fitted.linearize(scale * z)
        return np.append(model.A @ z - model.b, z)

    free = least_squares(stacked, np.zeros(len(scale)), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert np.linalg.norm(stacked(x / scale)) <= np.linalg.norm(free.fun) * (1 + 1e-12)
    # differences of residuals of a thousand sigmas tell z to some 1e-7
    assert np.abs(x / scale - free.x).max() < 1e-6


def test_parts_give_the_same(monkeypatch) -> None:
    problem = ro.load("position").problem
    _, wanted = fitted_frames(problem)
    parts = [partial(problem.data.take, range(k, 40, 3)) for k in range(3)]
    apart = PartitionedProblem(problem.robot, problem.parameters, problem.data, parts)
    fitted, x = fitted_frames(apart)
    scale = fitted.parameters.free.scale
    assert np.abs((x - wanted) / scale).max() < 1e-10
    monkeypatch.setattr(parts_module, "KEPT", 30)
    assert not in_parts(problem).keeps_rows
    assert np.abs((fitted_frames(problem)[1] - wanted) / scale).max() < 1e-10


def test_a_problem_without_frames_stays_as_it_is() -> None:
    problem = ro.load("paper_arm").problem
    fitted, x = fitted_frames(problem)
    assert fitted is problem
    assert not x.any()
    assert len(x) == len(problem.parameters.free)
