"""The ready robots: what their files state, held against their makers' drawings."""

from __future__ import annotations

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.robot import robots


@pytest.mark.parametrize("name", robots())
def test_ready_robots_state_source_limits_and_a_reachable_flange(name: str) -> None:
    robot = ro.read_robot(name)
    assert robot.source
    assert np.isfinite(robot.limits).all()
    assert robot.dof in (6, 7)
    q = np.random.default_rng(1).uniform(*robot.limits.T, (200, robot.dof))
    reach = np.linalg.norm(ro.robot.forward_kinematics(robot, q)[:, :3, 3], axis=1).max()
    assert 0.4 < reach < 4.0


def test_a_robot_that_is_not_ready_is_refused_with_the_list() -> None:
    for name in ("ur55", "arm.urdf"):
        with pytest.raises(ro.InputError, match=r"read_urdf reads \.urdf; ready robots are ro\.robots\(\)"):
            ro.read_robot(name)


def test_fanucs_third_joint_counts_from_the_horizontal() -> None:
    robot = ro.read_robot("lrmate200id")
    q = np.zeros((2, 6))
    q[1, 1] = 0.4
    R = ro.robot.forward_kinematics(robot, q)[:, :3, :3]
    assert np.abs(R[0] - R[1]).max() < 1e-12  # the second joint alone keeps the forearm's direction


def test_kukas_first_joint_turns_clockwise_seen_from_above() -> None:
    robot = ro.read_robot("kr6_r900")
    q = np.zeros((2, 6))
    q[1, 0] = 0.1
    p = ro.robot.forward_kinematics(robot, q)[:, :3, 3]
    assert p[0] == pytest.approx([0.98, 0, 0.435], abs=1e-12)
    assert p[1, 1] < 0
