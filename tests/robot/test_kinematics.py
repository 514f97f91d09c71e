"""Kinematics against the paper's table, against a product of matrices, and Jacobians against differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.robot.kinematics import roll_pitch_yaw
from tests.simulate import ALL, ARM, simulated

TABLE_2 = np.array(  # the paper's Table 2, positions [mm]; y of point 2 is misprinted (-86.189)
    [
        [227.468, -98.454, 533.779],
        [178.354, np.nan, 612.075],
        [92.567, -65.997, 656.335],
        [225.414, -40.350, 522.257],
        [113.703, -74.274, 774.098],
        [-71.640, -124.917, 842.460],
        [152.101, -92.520, 703.000],
        [332.086, -332.150, 346.873],
        [217.168, -358.150, 272.553],
    ]
)


def test_the_papers_reference_positions() -> None:
    problem = ro.load("paper_arm").problem
    position = 1e3 * ro.robot.forward_kinematics(problem.robot, problem.data.q)[:, :3, 3]
    printed = ~np.isnan(TABLE_2)
    assert np.abs(position - TABLE_2)[printed].max() < 0.006
    assert position[1, 1] == pytest.approx(-85.068, abs=0.006)


def test_forward_kinematics_is_the_product_of_the_links() -> None:
    rng = np.random.default_rng(3)
    mdh, q = rng.normal(size=(4, 5)), rng.normal(size=4)
    robot = ro.robot.Robot("random", mdh, ("revolute", "prismatic", "revolute", "revolute"))
    T = np.eye(4)
    for (alpha, a, theta, d, beta), kind, value in zip(mdh, robot.joint_types, q, strict=True):
        turn, shift = (value, 0.0) if kind == "revolute" else (0.0, value)
        for axis, angle, offset in (
            ("x", alpha, [a, 0, 0]),
            ("z", theta + turn, [0, 0, d + shift]),
            ("y", beta, [0, 0, 0]),
        ):
            step = np.eye(4)
            step[:3, :3] = Rotation.from_euler(axis, angle).as_matrix()
            step[:3, 3] = offset
            T = T @ step
    assert np.abs(ro.robot.forward_kinematics(robot, q)[0] - T).max() < 1e-14


def test_signs_and_couplings_act_on_the_controllers_joint_values() -> None:
    joint_map = np.eye(6)
    joint_map[2] = [0, 1, -1, 0, 0, 0]
    coupled = ro.robot.Robot("coupled", ARM.mdh, joint_map=joint_map)
    q = np.random.default_rng(0).normal(size=(5, 6))
    assert np.array_equal(ro.robot.forward_kinematics(coupled, q), ro.robot.forward_kinematics(ARM, q @ joint_map.T))


def test_many_rows_are_the_single_rows() -> None:
    q = np.random.default_rng(0).normal(size=(600, 6))
    T = ro.robot.forward_kinematics(ARM, q)
    assert all(np.array_equal(T[i], ro.robot.forward_kinematics(ARM, q[i])[0]) for i in (0, 255, 256, 511, 512, 599))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_jacobian_equals_central_differences(seed: int) -> None:
    extras = ("ratio?", "ecc_*", "base_*", "tool_*")
    problem, truth = simulated((*ALL, *extras), configurations=3, seed=seed)
    h = 1e-6
    J = problem.jacobian(truth)
    for k, column in enumerate(J.T):
        step = h * (np.arange(len(truth)) == k)
        difference = (problem.residual(truth - step) - problem.residual(truth + step)) / (2 * h)
        # truncation h^2 |f'''| / 6 ~ 1e-12, rounding eps |f| / h ~ 1e-10
        assert np.abs(column - difference).max() < 2e-9


def test_a_jacobian_takes_few_operations() -> None:
    """Twelve an entry, where products from the left need thirty: what every evaluation of a table costs."""
    problem = simulated(ALL)[0]
    block = problem.data.blocks[0]
    jacobian = problem.functions(block)["jacobian"]
    entries = 3 * len(problem.parameters.free)
    assert jacobian.n_instructions() <= 16 * entries


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=3, max_size=3))
def test_roll_pitch_yaw_gives_back_the_rotation(angles: list[float]) -> None:
    R = Rotation.from_euler("xyz", angles).as_matrix()
    assert np.abs(Rotation.from_euler("xyz", roll_pitch_yaw(R)).as_matrix() - R).max() < 1e-12


def test_a_base_that_points_straight_up_has_a_full_rank_jacobian() -> None:
    """At a pitch of 90 degrees adding to roll and yaw would be one and the same motion."""
    parameters = ro.robot.model_parameters(ARM, base=[1, 2, 3, 0.3, np.pi / 2, 0.1]).identify(["base_*"])
    q = np.random.default_rng(1).normal(size=(10, 6))
    problem = ro.CalibrationProblem(ARM, parameters, ro.Dataset.of(q, np.zeros((10, 3)), 1e-5))
    assert problem.linearize(np.zeros(6)).rank == 6
    x = np.array([0.1, 0, 0, 0.01, 0.02, 0.03])
    moved = parameters.free.values(x)
    again = ro.robot.model_parameters(ARM, base=moved).identify(["base_*"])
    other = ro.CalibrationProblem(ARM, again, problem.data)
    assert np.abs(problem.residual(x) - other.residual(np.zeros(6))).max() < 1e-12
