"""Every measurement model: its Jacobian, its inverse, and the frames that it recovers."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.data.measurements.camera import CAMERAS
from rpim_opt.data.measurements.measurement import of_fixture
from rpim_opt.data.measurements.pose import quaternion, rotation_between
from rpim_opt.data.measurements.registry import MEASUREMENTS

KINDS = [name for name in MEASUREMENTS if name not in CAMERAS]  # whose points have to be in sight: test_camera
TYPES = ("revolute", "prismatic")


def random_problem(kind: str, seed: int, types: tuple[str, ...], N: int = 6, identify: tuple[str, ...] = ("*",)):
    """A problem of a random robot with all there is to identify, torques included, and random measured values."""
    rng = np.random.default_rng(seed)
    measurement, dof = MEASUREMENTS[kind], len(types)
    robot = ro.robot.Robot(
        "random", 0.5 * rng.normal(size=(dof, 5)), types, joint_map=np.eye(dof) + 0.2 * rng.normal(size=(dof, dof))
    )
    q = rng.uniform(-1, 1, (N, measurement.points, dof))
    y = rng.normal(size=(N, len(measurement.columns)))
    if kind == "pose":
        y[:, 3:] /= np.linalg.norm(y[:, 3:], axis=1, keepdims=True)
    data = ro.Dataset.of(q, y, 1e-3, measurement=measurement)
    markers = ("A", "B")[: measurement.points]
    block = replace(data.blocks[0], markers=markers, fixture="F", torque=rng.uniform(-5, 5, q.shape))
    block = replace(block, approach=rng.choice([-1.0, 0.0, 1.0], q.shape))
    data = ro.Dataset((block,), data.label, data.configuration)
    own = {of_fixture(n, "F"): (d, float(rng.normal())) for n, d in measurement.parameters.items()}
    tools = {m: 0.3 * rng.normal(size=6) for m in markers}
    frames = tuple(of_fixture(f"{name}_", "F") for name in measurement.frames)
    parameters = ro.robot.model_parameters(robot, rng.normal(size=6), tools, own, frames).identify(identify)
    return ro.CalibrationProblem(robot, parameters, data), rng


def measuring(problem: ro.CalibrationProblem, y: np.ndarray) -> ro.CalibrationProblem:
    """The same problem with other measured values."""
    data = problem.data
    return problem.on(ro.Dataset((replace(data.blocks[0], y=y),), data.label, data.configuration))


@settings(deadline=None, max_examples=12)
@given(st.sampled_from(KINDS), st.integers(0, 10**6), st.lists(st.sampled_from(TYPES), min_size=2, max_size=7))
def test_jacobians_are_differences_of_residuals(kind: str, seed: int, types: list[str]) -> None:
    problem, rng = random_problem(kind, seed, tuple(types))
    n = len(problem.parameters.free)
    x, h = 0.05 * rng.normal(size=n), 1e-5
    J = problem.jacobian(x)
    for i in range(n):
        step = np.zeros(n)
        step[i] = h
        difference = (problem.residual(x - step) - problem.residual(x + step)) / (2 * h)
        # h^2 times the third derivative, at most some hundreds on these robots of a few metres
        assert np.abs(J[:, i] - difference).max() < 1e-6 * max(1.0, np.abs(J).max())


@pytest.mark.parametrize("kind", ["position", "pose", "cable", "distance"])
@pytest.mark.parametrize("prismatic", [False, True])
def test_frames_come_back_to_a_nanometre(kind: str, prismatic: bool) -> None:
    types = ("revolute", "revolute", "prismatic" if prismatic else "revolute", "revolute", "revolute", "revolute")
    seen = {
        "position": ("base_*", "tool_?_[xyz]"),
        "pose": ("base_*", "tool_*"),
        "cable": ("anchor_*", "length_*", "tool_?_[xyz]"),
        "distance": ("tool_?_[xyz]",),
    }
    problem, rng = random_problem(kind, 8, types, 60, seen[kind])
    free = problem.parameters.free
    truth = rng.normal(size=len(free)) * free.scale
    result = ro.calibrate(measuring(problem, problem.modelled(truth)[0]), ro.tikhonov, 1e-14)
    assert result.converged
    assert np.abs(result.x - truth).max() < 1e-9


@pytest.mark.parametrize("kind", ["plane", "sphere"])
def test_planes_and_spheres_come_back_to_a_nanometre(kind: str) -> None:
    measurement, rng = MEASUREMENTS[kind], np.random.default_rng(3)
    gantry = ro.robot.Robot(
        "gantry",
        np.array([[0, 0, 0, 0, 0], [np.pi / 2, 0, np.pi / 2, 0, 0], [np.pi / 2, 0, np.pi / 2, 0, 0]]),
        ("prismatic",) * 3,
    )
    if kind == "plane":
        R = Rotation.from_rotvec([0.4, -0.9, 0.2]).as_matrix()
        points = rng.normal(size=(30, 2)) @ R[:2] + [0.3, 0.2, -0.5]
    else:
        points = rng.normal(size=(30, 3))
        points = 0.4 * points / np.linalg.norm(points, axis=1, keepdims=True) + [0.3, 0.2, -0.5]
    to_joints = np.linalg.inv(ro.robot.forward_kinematics(gantry, np.eye(3))[:, :3, 3].T)
    data = ro.Dataset.of(points @ to_joints.T, np.empty((30, 0)), 1e-5, measurement=measurement)
    start = measurement.start(points + 0.003 * rng.normal(size=points.shape), np.empty((30, 0)))
    own = {n: (d, float(start[n])) for n, d in measurement.parameters.items()}
    parameters = ro.robot.model_parameters(gantry, own=own).identify([f"{kind}_*"])
    result = ro.calibrate(ro.CalibrationProblem(gantry, parameters, data), ro.tikhonov, 1e-13)
    assert result.converged
    assert result.errors().max() < 1e-9
    if kind == "sphere":
        found = parameters.free.values(result.x)
        assert np.abs(found - [0.3, 0.2, -0.5, 0.4]).max() < 1e-9


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-7, 1e-6, 1e-3, 1.0, 3.0, np.pi - 1e-3, np.pi - 1e-7, np.pi - 1e-10])
def test_the_logarithm_is_exact_up_to_half_a_turn(angle: float) -> None:
    T, a, b = ca.SX.sym("T", 4, 4), ca.SX.sym("a", 4), ca.SX.sym("b", 4)
    to_quaternion = ca.Function("q", [T], [quaternion(T)])
    log = ca.Function("log", [a, b], [rotation_between(a, b)])
    rng = np.random.default_rng(1)
    for first in Rotation.random(40, rng=rng):
        v = rng.normal(size=3)
        v *= angle / np.linalg.norm(v)
        turned, M = Rotation.from_rotvec(v) * first, [np.eye(4), np.eye(4)]
        for m, R in zip(M, (first, turned), strict=True):
            m[:3, :3] = R.as_matrix()
        p, q = (to_quaternion(m).full().ravel() for m in M)
        assert np.abs(log(q, p).full().ravel() - v).max() < 4e-15
        y = np.concatenate([rng.normal(size=3), p])[None]
        moved = MEASUREMENTS["pose"].plus(y, np.concatenate([np.ones(3), v])[None])
        assert np.abs(moved[0, :3] - y[0, :3] - 1).max() < 1e-15
        assert np.abs(log(moved[0, 3:], p).full().ravel() - v).max() < 4e-15


def test_the_jacobian_of_a_pose_that_fits_exactly_is_finite() -> None:
    problem, _ = random_problem("pose", 2, ("revolute",) * 3)
    x = np.zeros(len(problem.parameters.free))
    fits = measuring(problem, problem.modelled(x)[0])
    assert np.isfinite(fits.jacobian(x)).all()
    assert np.abs(fits.residual(x)).max() < 1e-14


def test_other_forms_of_a_rotation_are_the_same_rotation() -> None:
    R = Rotation.random(20, rng=np.random.default_rng(2))
    want = R.as_quat(canonical=True)[:, [3, 0, 1, 2]]
    (_, from_angles), (_, from_matrices) = MEASUREMENTS["pose"].forms
    xyz = np.zeros((20, 3))
    for got in (
        from_angles(np.hstack([xyz, R.as_euler("xyz")])),
        from_matrices(np.hstack([xyz, R.as_matrix().reshape(20, 9)])),
    ):
        assert np.abs(np.abs(np.sum(got[:, 3:] * want, axis=1)) - 1).max() < 1e-14
    with pytest.raises(ro.InputError, match="row 1: found a matrix that violates R R' = I by"):
        from_matrices(np.hstack([xyz, 1.01 * R.as_matrix().reshape(20, 9)]))


def test_positions_of_one_reflector_and_distances_of_another_in_one_calibration() -> None:
    instance = ro.load("mixed")
    kinds = {(block.measurement.name, block.markers) for block in instance.problem.data.blocks}
    assert kinds == {("position", ("A",)), ("cable", ("B",))}
    result = ro.calibrate(instance.problem, instance.formulation, ro.reml)
    assert result.converged
    alone = instance.problem.data.take(instance.problem.data.blocks[0].row)
    without = ro.calibrate(instance.problem.on(alone), instance.formulation, ro.reml)
    mean = [r.errors(instance.validation).mean() for r in (result, without)]
    assert mean[0] < mean[1]


def test_a_measurement_of_ones_own_must_be_what_it_declares() -> None:
    wrong = ro.data.Measurement("height", lambda T: T[:2, 3], {"z": "length"}, components={"z": "length"})
    robot = ro.robot.Robot("one joint", np.zeros((1, 5)))
    data = ro.Dataset.of(np.zeros((3, 1)), np.zeros((3, 1)), 1e-3, measurement=wrong)
    problem = ro.CalibrationProblem(robot, ro.robot.model_parameters(robot).identify(["a1"]), data)
    with pytest.raises(ro.InputError, match="height: found 2 components of the residual, accepted: 1"):
        problem.residual(np.zeros(1))


def test_what_a_script_says_of_its_values_reaches_the_reader() -> None:
    def positive(y: np.ndarray) -> np.ndarray:
        if (y < 0).any():
            raise ro.basics.RowError(int(np.argmax(y[:, 0] < 0)), "a negative height", "heights above the table")
        raise ro.InputError("the probe", "no calibration", "one of this year")

    probe = ro.data.Measurement("height", lambda T: T[2, 3], {"z": "length"}, prepare=positive)
    robot = ro.robot.Robot("one joint", np.zeros((1, 5)))
    table = {"label": ["P1", "P2"], "q1_deg": [0, 1], "z_mm": [1, -1]}
    with pytest.raises(ro.InputError, match="row P2: found a negative height, accepted: heights above the table"):
        ro.read_data(table, robot, {"distance_mm": 0.01}, probe)
    with pytest.raises(ro.InputError, match="the probe: found no calibration"):
        ro.read_data(table | {"z_mm": [1, 1]}, robot, {"distance_mm": 0.01}, probe)


def test_auto_identifies_the_parameters_of_a_type_of_ones_own() -> None:
    """A height gauge whose table tilts and whose zero is not known: without these the robot would take them up."""
    gauge = ro.data.Measurement(
        "gauge", lambda T, tilt, zero: T[2, 3] + tilt * T[0, 3] + zero, {"z": "length"},
        parameters={"tilt": "", "zero": "length"},
    )  # fmt: skip
    q = np.random.default_rng(0).uniform(-1, 1, (30, 6))
    data = ro.Dataset.of(q, np.ones((30, 1)), 1e-4, measurement=gauge)
    assert {"tilt", "zero"} <= set(ro.problem_from("irb120", data).parameters.free.names)
