"""Joints that follow others: calibrated, written into every file, and back into the URDF."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.robot.kinematics import numeric_frame
from tests.robot.test_exchange import reach
from tests.test_cli import run

URDF = """<robot name="palletizer"><link name="base"/><link name="column"/><link name="lift"/><link name="upper"/>
<link name="wrist"/><link name="tip"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="column"/><origin xyz="0 0 0.3"/>
<axis xyz="0 0 1"/><limit lower="-2" upper="2"/></joint>
<joint name="slide" type="prismatic"><parent link="column"/><child link="lift"/><origin xyz="0.1 0 0"/>
<axis xyz="0 0 1"/><mimic joint="slide2" multiplier="0.5" offset="0.05"/></joint>
<joint name="slide2" type="prismatic"><parent link="lift"/><child link="upper"/><origin rpy="0.3 0 0"/>
<axis xyz="0 1 0"/><limit lower="0" upper="0.6"/></joint>
<joint name="bend" type="revolute"><parent link="upper"/><child link="wrist"/><origin xyz="0.4 0 0" rpy="1.2 0 0"/>
<axis xyz="0 0 1"/><mimic joint="turn" multiplier="-0.7" offset="0.2"/></joint>
<joint name="flange" type="fixed"><parent link="wrist"/><child link="tip"/><origin xyz="0.3 0.1 0"/></joint></robot>
"""


@pytest.fixture
def arm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ro.robot.RobotSetup:
    monkeypatch.chdir(tmp_path)
    Path("arm.urdf").write_text(URDF)
    return ro.read_urdf("arm.urdf")


def test_what_the_controller_moves_is_fewer_than_the_table_has(arm: ro.robot.RobotSetup) -> None:
    robot = arm.robot
    assert (robot.dof, len(robot.mdh), arm.names) == (2, 4, ("turn", "slide2"))
    assert robot.joint_dimensions == ("angle", "length")
    assert robot.joint_map.tolist() == [[1, 0], [0, 0.5], [0, 1], [-0.7, 0]]
    assert robot.limits.tolist() == [[-2, 2], [0, 0.6]]
    for name in ("robot.toml", "robot.json"):
        ro.robot.write_robot(robot, name)
        again = ro.read_robot(name)
        for what in ("mdh", "joint_map", "limits"):
            assert np.array_equal(getattr(again, what), getattr(robot, what))


def test_errors_of_joints_that_follow_are_found_and_go_back_into_the_file(arm: ro.robot.RobotSetup) -> None:
    rng = np.random.default_rng(0)
    robot = arm.robot
    parameters = ro.robot.model_parameters(robot, arm.base, {"": arm.tool}).identify(["d3", "a4", "theta4"])
    q = rng.uniform(*robot.limits.T, (40, 2))
    truth = np.array([-0.002, 0.003, 0.001])
    empty = ro.CalibrationProblem(robot, parameters, ro.Dataset.of(q, np.zeros((40, 3)), 1e-5))
    y = empty.modelled(truth)[0] + 1e-6 * rng.normal(size=(40, 3))
    problem = empty.on(ro.Dataset.of(q, y, 1e-5))
    result = ro.calibrate(problem, ro.tikhonov, weight=1e-6)
    assert np.abs(result.x - truth).max() < 1e-5
    assert ro.calibration.inspect(problem)
    ro.store.save_result(result, "result.json")
    assert np.array_equal(ro.load_result("result.json").robot.joint_map, robot.joint_map)
    ro.use.export_files(result, "identified.urdf", urdf="arm.urdf")
    written = ro.read_urdf("identified.urdf")
    identified = ro.use.identified(result)
    assert np.abs(reach(written, q) - reach(replace(identified, base=arm.base), q)).max() < 1e-12
    assert Path("identified.urdf").read_text().count("<mimic") == 2


def test_commands_of_joints_that_others_follow_are_corrected(arm: ro.robot.RobotSetup) -> None:
    rng = np.random.default_rng(1)
    robot = arm.robot
    q = rng.uniform(*robot.limits.T, (30, 2))
    y = (numeric_frame(arm.base) @ ro.robot.forward_kinematics(robot, q) @ numeric_frame(arm.tool))[:, :3, 3]
    problem = ro.problem_from(arm, ro.Dataset.of(q, y + 1e-3 * np.array([0, 0, 1]), 1e-4), ["d[12]"], base=arm.base)
    result = ro.calibrate(problem)
    corrected = ro.use.compensate(result, q[:5])
    assert corrected.q.shape == (5, 2)
    assert result.verdict


def lines(rows: np.ndarray) -> str:
    return "".join(f"P{i}," + ",".join(map(repr, row)) + "\n" for i, row in enumerate(rows.tolist()))


def test_a_joint_that_nobody_recorded_is_stated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A torso that stood still has no column: its value comes from the command, and from the folder afterwards."""
    monkeypatch.chdir(tmp_path)
    Path("arm.urdf").write_text(re.sub(r"<mimic[^>]*>", "", URDF))
    arm = ro.read_urdf("arm.urdf")
    rng = np.random.default_rng(0)
    q = np.column_stack([rng.uniform(-1, 1, 40), np.full(40, 0.15), *rng.uniform(0, 0.6, (2, 40))])
    T = numeric_frame(arm.base) @ ro.robot.forward_kinematics(arm.robot, q) @ numeric_frame(arm.tool)
    measured = np.hstack([np.degrees(q[:, [0]]), q[:, [2]], np.degrees(q[:, [3]]), 1e3 * T[:, :3, 3]])
    Path("joints.csv").write_text("id,turn [deg],slide2 [m],bend [deg]\n" + lines(measured[:, :3]))
    Path("points.csv").write_text("id,x_mm,y_mm,z_mm\n" + lines(measured[:, 3:]))
    data = ["--data", "joints.csv", "--data", "points.csv"]
    folder = ["new", "cell", "--robot", "arm.urdf", *data]
    assert run(monkeypatch, *folder) == 2
    assert run(monkeypatch, *folder, "--constants", "slide [m]=lots") == 2
    assert run(monkeypatch, *folder, "--constants", "turn [deg]=1") == 2
    assert run(monkeypatch, *folder, "--constants", "slide [m]=0.15") == 0
    instance = ro.load("cell")
    assert np.allclose(instance.problem.data.q, q, atol=1e-9)
    assert 'constants = "slide [m]=0.15"' in Path("cell/problem.toml").read_text()
    moved = np.hstack([measured[:, :3], np.full((40, 1), 0.2)])  # a later table that has the joint: its values count
    Path("joints.csv").write_text("id,turn [deg],slide2 [m],bend [deg],slide_m\n" + lines(moved))
    assert run(monkeypatch, "new", "later", *folder[2:], "--constants", "slide [m]=0.15") == 0
    assert np.allclose(ro.load("later").problem.data.q[:, 1], 0.2, atol=1e-9)


def test_a_ready_robots_joint_by_the_name_of_its_driver_is_stated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where one of a driver's joints is not there, the others are said to lack it; stated, all of them are known."""
    monkeypatch.chdir(tmp_path)
    rows = [",".join([*(f"iiwa_joint_{i} [deg]" for i in (1, 2, 4, 5, 6, 7)), "x_mm", "y_mm", "z_mm"])]
    rows += [",".join(map(str, row)) for row in np.random.default_rng(0).uniform(-50, 50, (9, 9)).tolist()]
    Path("table.csv").write_text("\n".join(rows) + "\n")
    new = ["new", "cell", "--robot", "iiwa7", "--data", "table.csv", "--dry-run"]
    assert run(monkeypatch, *new) == 2
    assert "--constants" in capsys.readouterr().err
    assert run(monkeypatch, *new, "--constants", "iiwa_joint_3 [deg]=20") == 0
    assert "q3_deg" in capsys.readouterr().out
