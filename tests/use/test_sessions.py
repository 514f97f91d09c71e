"""A robot measured from two places of the instrument: U and base are of one of them, not of their mean (simulated)."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.basics.tables import csv_text
from rpim_opt.calibration.acceptance import measured_workspace
from rpim_opt.robot import model_parameters
from rpim_opt.robot.chain import placed
from rpim_opt.robot.kinematics import frame_numbers, numeric_frame
from rpim_opt.study.arms import BASE, KINDS, SCALES, TOOL
from tests import ROOT
from tests.test_cli import run
from tests.test_commands import urdf_text

NOISE = 3e-5
FAR = numeric_frame([0.4, -0.9, 0.1, 0.02, -0.03, 0.5])  # from the instrument's first place to its second


def from_far(points: Array) -> Array:
    """Return points (N, 3) [m] as the instrument reads them from its second place."""
    return points @ FAR[:3, :3].T + FAR[:3, 3]


@pytest.fixture(scope="module")
def arm() -> ro.study.SimulatedArm:
    return ro.study.simulated_arm(1, 40)


@pytest.fixture(scope="module")
def result(arm: ro.study.SimulatedArm) -> ro.Calibration:
    rows = arm.problem.data.blocks[0]
    names = [("near", "far")[i % 2] for i in range(len(rows.y))]
    y = np.where(np.array(names)[:, None] == "far", from_far(rows.y), rows.y)
    data = ro.Dataset.of(arm.problem.data.q, y, NOISE, session=names)
    table = model_parameters(arm.problem.robot, list(BASE), {"": list(TOOL)}, sessions=("near", "far"))
    table = table.scaled({**SCALES, "session_mm": 1000.0, "session_mrad": 1000.0})
    own = KINDS[list(KINDS)[1]]
    table = table.identify(["alpha?", "a?", "d?", "theta?", *own, "base_*", "tool_[xyz]", "session_*"])
    return ro.calibrate(ro.CalibrationProblem(arm.problem.robot, table, data))


def test_uncertainty_is_that_in_one_place_of_the_instrument_and_covers(
    arm: ro.study.SimulatedArm, result: ro.Calibration
) -> None:
    view = ro.use.in_session(result)
    mean, own = (measured_workspace(each) for each in (result, view))
    assert mean is not None
    assert own is not None
    assert mean.largest > 0.05  # the scatter of places a metre apart, none of the robot's
    assert own.largest < 5 * np.sqrt(3) * NOISE * 2
    true = arm.true.blocks[0].y
    there = {"near": true, "far": from_far(true)}[view.problem.session]
    predicted = view.predict(arm.true.q, of="reached")
    error = np.linalg.norm(predicted.position - there, axis=1)
    # U = 2 u of a vector covers 0.97 where u of three axes is known; 200 rows share one set of errors of parameters
    assert np.mean(error < 2 * np.linalg.norm(predicted.standard, axis=1)) > 0.9
    assert ro.use.in_session(view) is view


def test_exported_base_and_table_are_of_that_session_and_others_are_relative_to_it(
    arm: ro.study.SimulatedArm, result: ro.Calibration, tmp_path: Path
) -> None:
    found = ro.use.export_files(result, mdh=tmp_path / "arm.toml")
    text = (tmp_path / "arm.toml").read_text()
    named = ro.use.in_session(result).problem.session
    assert f"in the instrument's frame of session '{named}'" in text
    assert not found.inconclusive
    exported = ro.use.identified(result)
    true = arm.true.blocks[0].y
    there = {"near": true, "far": from_far(true)}[named]
    ends = numeric_frame(exported.base), numeric_frame(exported.tool)
    reached = (ends[0] @ ro.robot.forward_kinematics(exported.robot, arm.true.q) @ ends[1])[:, :3, 3]
    assert np.linalg.norm(reached - there, axis=1).max() < 10 * NOISE
    # the motion between both places, at the reached positions, is that between both bases
    number = r"(-?[\d.]+)"
    poses = re.findall(rf"'(near|far)' x {number} y {number} z {number} rx {number} ry {number} rz {number} mm", text)
    base = {}
    for name, *six in poses:
        base[name] = numeric_frame(
            [*np.array(six[:3], dtype=float) * 1e-3, *np.radians(np.array(six[3:], dtype=float))]
        )
    other = ({"near", "far"} - {named}).pop()
    moved = base[named] @ np.linalg.inv(base[other])
    at = {"near": true, "far": from_far(true)}
    missed = at[other] @ moved[:3, :3].T + moved[:3, 3] - at[named]
    assert np.linalg.norm(missed, axis=1).max() < 5e-4


def test_the_commands_that_judge_a_robot_judge_it_in_one_session(
    monkeypatch, capsys, arm: ro.study.SimulatedArm, result: ro.Calibration, tmp_path: Path
) -> None:
    required = replace(result.record, requirement=ro.data.Requirement(5e-4))
    ro.store.save_result(replace(result, record=required), tmp_path)
    rows = arm.read.blocks[0]
    header = [*(f"q{i}_rad" for i in range(1, 7)), "x_m", "y_m", "z_m", "session"]
    cells = [[*map(repr, map(float, [*q, *y])), "near"] for q, y in zip(arm.read.q, rows.y, strict=True)]
    (tmp_path / "new.csv").write_text(csv_text(header, cells))
    new = ("--data", str(tmp_path / "new.csv"))
    assert run(monkeypatch, "accept", str(tmp_path), "--limit", "0.5", *new) == 0
    assert "Base of the DH table in the frame of sessions: " in capsys.readouterr().out
    assert run(monkeypatch, "accept", str(tmp_path), *new, "--json") == 0
    assert json.loads(capsys.readouterr().out)["session"] in ("near", "far")
    assert run(monkeypatch, "report", str(tmp_path), *new) == 0
    assert "in the instrument&#39;s frame of session" in (tmp_path / "report.html").read_text()
    assert run(monkeypatch, "validate", str(tmp_path), new[1]) == 0
    assert run(monkeypatch, "update", str(tmp_path), new[1], "--out", str(tmp_path / "later")) == 0
    updated = ro.load_result(tmp_path / "later")
    stored = json.loads((tmp_path / "later" / "result.json").read_text())["acceptance"]["bound_mm"]
    mapped = measured_workspace(ro.use.in_session(updated))
    assert mapped is not None
    assert abs(stored - 1e3 * mapped.largest) < 1e-6 * stored


def test_a_new_place_metres_away_is_no_change_of_the_robot(arm: ro.study.SimulatedArm, result: ro.Calibration) -> None:
    """Session offsets of 1 m (1 sigma) leave its base open: their sum of squares counted against the robot."""
    away = numeric_frame([7.0, -4.0, 1.5, 0.1, 0.2, 2.5])
    y = arm.read.blocks[0].y[:30] @ away[:3, :3].T + away[:3, 3]
    found = ro.use.update(result, ro.Dataset.of(arm.read.q[:30], y, NOISE, session=["away"] * 30))
    assert not found.changes
    assert found.before.likely
    assert found.result.verdict.delivered


def test_measurements_from_a_third_place_are_judged_by_the_robots_uncertainty_once_registered(
    arm: ro.study.SimulatedArm, result: ro.Calibration
) -> None:
    """As rows of an unknown session they were judged by the scatter of the places: a millimetre was no error."""
    third = numeric_frame([1.0, 0.2, -0.1, 0.01, 0.02, -0.9])
    y = arm.read.blocks[0].y[:40] @ third[:3, :3].T + third[:3, 3]
    y[7, 2] += 1e-3
    found = ro.use.validate(result, ro.Dataset.of(arm.read.q[:40], y, NOISE), register=True)
    assert found.beyond == (7,)
    assert any("Registered again" in remark for remark in found.remarks)


def test_every_set_up_is_registered_by_itself(arm: ro.study.SimulatedArm, result: ro.Calibration) -> None:
    """One motion was fitted to the rows of all of them: errors were as large as the places are apart."""
    y = arm.read.blocks[0].y[:24].copy()
    for k, rows in enumerate(np.split(np.arange(24), 3)):
        place = numeric_frame([1.0 - k, 0.2 * k, -0.1, 0.01, 0.02, 0.9 * k - 0.5])
        y[rows] = y[rows] @ place[:3, :3].T + place[:3, 3]
    data = ro.Dataset.of(arm.read.q[:24], y, NOISE, session=[f"M{1 + i // 8}" for i in range(24)])
    found = ro.use.validate(result, data, register=True)
    assert 1e3 * found.error.max() < 0.2  # a reading is within 0.02 mm, and the arm's repeatability
    assert not found.mistake
    assert str(found).count("was displaced as a whole by") == 3
    monitored = ro.use.monitor(result, data, register=True)
    assert not monitored.drifts
    assert "session 'M3' was displaced" in str(monitored)
    few = data.take([*range(8), 8, 9])
    with pytest.raises(ro.InputError, match="session 'M2', measured positions: found 2"):
        ro.use.validate(result, few, register=True)


def test_a_third_place_is_no_change_of_the_robot_and_says_nothing_of_it_before_it_is_registered(
    arm: ro.study.SimulatedArm, result: ro.Calibration
) -> None:
    """An update took a turn beyond the two places' scatter for theta1; all rows were inside intervals of 2 m."""
    third = numeric_frame([1.0, 0.2, -0.1, 0.01, 0.02, -2.5])
    y = arm.read.blocks[0].y[:20] @ third[:3, :3].T + third[:3, 3]
    data = ro.Dataset.of(arm.read.q[:20], y, NOISE, session=["third"] * 20)
    found = ro.use.validate(result, data)
    assert found.coverage is None
    assert "The registration of session 'third' is unknown" in str(found)
    with pytest.raises(ro.InputError, match="found the registration of session 'third' is unknown, accepted: register"):
        ro.use.monitor(result, data)
    judged = replace(result, record=replace(result.record, validation=data)).verdict
    assert f"Held-out rows do not fit. {found.no_intervals}" in judged.reasons
    with pytest.raises(ro.InputError, match="accepted: no reset: a new session is registered by itself"):
        ro.use.update(result, data, reset=["base_*"])
    updated = ro.use.update(result, data)
    assert not updated.changed
    assert updated.errors["new"]["before"]["rms_mm"] < 0.1
    assert "Registered again: session 'third' was displaced as a whole by" in str(updated)
    assert updated.explained
    notes = ro.use.session_notes(ro.use.in_session(updated.result))
    for text in ("'third' x", "'near' (by rows before the update) x", "'far' (by rows before the update) x"):
        assert text in notes[0]


def test_joint_torques_go_with_the_configurations(tmp_path: Path) -> None:
    """Compliances of measured torques bend the arm where it was measured, also when sessions are compared."""
    shutil.copytree(ROOT / "problems" / "joints", tmp_path, dirs_exist_ok=True)
    head, *rows = (tmp_path / "identification.csv").read_text().splitlines()
    half = len(rows) // 2
    rows = [f"{row},{'first' if k < half else 'second'}" for k, row in enumerate(rows)]
    (tmp_path / "identification.csv").write_text("\n".join([f"{head},session", *rows]))
    text = (tmp_path / "problem.toml").read_text()
    (tmp_path / "problem.toml").write_text(text.replace("identify = [", 'identify = ["session_*", ', 1))
    result = ro.calibrate(tmp_path, "tikhonov", 1.0)
    notes = ro.use.session_notes(ro.use.in_session(result))
    assert "'first'" in notes[0]
    assert "'second'" in notes[0]


def test_what_moved_within_a_session_is_named_and_not_the_way_between_them(
    arm: ro.study.SimulatedArm, result: ro.Calibration
) -> None:
    """The way between sessions that are registered one by one was named in its place, with advice that was followed."""
    rows = result.problem.data.blocks[0]
    order = np.argsort(result.problem.data.session, kind="stable")[::-1]
    table = result.problem.parameters.identify(["alpha?", "a?", "d?", "theta?", "tool_[xyz]", "session_*"])
    for moved in (0.0, 5e-4):
        y = rows.y[order] + moved * (np.arange(40) >= 28)[:, None] * [1, 0, 0]
        data = ro.Dataset.of(rows.q[order, 0], y, NOISE, session=result.problem.data.session[order])
        causes = ro.calibrate(ro.CalibrationProblem(arm.problem.robot, table, data)).causes
        assert len(causes) == 2 * bool(moved), causes
    assert "from row 29 on" in causes[1]
    assert "consistent with a changed base" in causes[1]


def test_sessions_that_stand_apart_are_said_to_be_stated_so(arm: ro.study.SimulatedArm, result: ro.Calibration) -> None:
    """And frames of the nominal robot are those of the sessions, too: its errors are not the way between its places."""
    near = arm.problem.data.blocks[0].y
    rows = [("near", "far")[i >= 20] for i in range(40)]
    y = np.where(np.array(rows)[:, None] == "far", from_far(near), near)
    data = ro.Dataset.of(arm.problem.data.q, y, NOISE, session=rows)
    together = ro.calibrate(arm.problem.on(data))
    assert any("session_mm = 1000 and session_mrad = 1000 in [scale]" in cause for cause in together.causes)
    assert result.nominal_errors().max() < 0.02


OPPOSITE = numeric_frame([2.0, 1.7, -0.1, 0.01, -0.02, -2.6])  # to the other side of the robot


def test_new_registers_sessions_that_stand_apart_by_themselves(
    arm: ro.study.SimulatedArm, capsys, monkeypatch, tmp_path: Path
) -> None:
    """With a base of all besides, U was 11 mm: a motion of all, which the data do not see, is as wide as the prior."""
    rows = [("near", "far")[i % 2] for i in range(40)]
    y = arm.problem.data.blocks[0].y
    y = np.where(np.array(rows)[:, None] == "far", y @ OPPOSITE[:3, :3].T + OPPOSITE[:3, 3], y)
    cells = [[*q, *p, name] for q, p, name in zip(arm.problem.data.q, y, rows, strict=True)]
    header = [*(f"q{i}_rad" for i in range(1, 7)), "x_m", "y_m", "z_m", "session"]
    (tmp_path / "raw.csv").write_text(csv_text(header, cells))
    ro.robot.write_robot(arm.problem.robot, tmp_path / "arm.toml")
    cell = tmp_path / "cell"
    assert run(monkeypatch, "new", str(cell), "--robot", f"{tmp_path}/arm.toml", "--data", f"{tmp_path}/raw.csv") == 0
    assert "was moved between sessions. RMS distance of their points" in capsys.readouterr().out
    problem = ro.load(cell).problem
    names = problem.parameters.free.names
    assert not {"session_far_x", "session_near_rz"} - set(names)
    assert not any(name.startswith("base_") for name in names)
    result = ro.calibrate(problem)
    assert re.search(r"Session offsets \(1 sigma\): [12],\d00 mm \(95 % CI ", str(result))
    view = ro.use.in_session(result)
    assert view.verdict.delivered
    assert 2 * np.median(np.linalg.norm(view.predict(arm.true.q, of="reached").standard, axis=1)) < 1.5e-4
    # where the root of a URDF is, which stands on a floor, in that session; the DH table's base is on the pedestal
    root = '<link name="floor"/><joint name="pedestal" type="fixed"><parent link="floor"/><child link="base_link"/>'
    root += '<origin xyz="0.5 0.2 0" rpy="0 0 0"/></joint></robot>'
    text = urdf_text(arm.problem.robot.mdh, np.eye(4)).replace("</robot>", root)
    (tmp_path / "arm.urdf").write_text(text)
    exported = ["export", str(tmp_path / "cell"), "--urdf", f"{tmp_path}/arm.urdf", "--out", f"{tmp_path}/out.urdf"]
    ro.store.save_result(result, cell)
    assert run(monkeypatch, *exported) in (0, 4)
    there = numeric_frame(ro.use.identified(result).base) @ numeric_frame([-0.5, -0.2, 0.0, 0.0, 0.0, 0.0])
    at = f"floor is at {placed(frame_numbers(there))} in the instrument's frame of session '{view.problem.session}'"
    for said in (capsys.readouterr().out, (tmp_path / "out.urdf").read_text()):
        assert at in " ".join(said.split())
    # a tracker that was moved since then, under the name of a session, is no change of the robot (it was one of a1)
    y = arm.read.blocks[0].y[:12] + np.array([5e-3, 0.0, 0.0])
    later = ro.Dataset.of(arm.read.q[:12], y, NOISE, session=["near"] * 12)
    assert "recalibrate by `update`" in ro.use.validate(result, later).mistake
    updated = ro.use.update(result, later)
    assert {cause.name for cause in updated.changes} <= {"session_near"}
    assert updated.explained
