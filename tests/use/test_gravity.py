"""Gravity from a table to corrected commands: without torques, with another payload, in files, hung the wrong way."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration.lack_of_fit import lack_of_fit
from rpim_opt.store.simulation import write_simulation
from tests.simulate import ARM

SIGMA = 2e-5
GEOMETRY = ("alpha[2-6]", "a[2-6]", "theta[2-6]", "d[2-6]")
EXTENSION = ("compliance[2345]",)
TRUE = {"compliance2": 6e-6, "compliance3": 9e-6, "compliance4": 2e-5, "compliance5": 3e-5}
"""Of 120 Nm: joint 2 gives way by 0.7 mrad, which is 0.5 mm at the flange."""
TOOL = (0.03, -0.02, 0.06, 0.0, 0.0, 0.0)


def arm(mounting: str = "floor", payload: float = 1.0, centre: tuple = (0.0, 0.02, 0.1)) -> ro.robot.Robot:
    links = {"masses": (0, 0, 0, 10, 0, 5), "centres": ((0, 0, 0),) * 6}
    return replace(ARM, gravity=ro.robot.Gravity(**links, payload=payload, payload_centre=centre).mounted(mounting))


def table(robot: ro.robot.Robot, identify: tuple[str, ...] = GEOMETRY + EXTENSION) -> ro.robot.Parameters:
    parameters = ro.robot.model_parameters(robot, tools={"": TOOL}).identify(identify)
    scale = parameters.scale.copy()
    for i, name in enumerate(parameters.names):
        if name.startswith("compliance"):
            scale[i] = 1e-5
    return replace(parameters, scale=scale)


def truth(parameters: ro.robot.Parameters, seed: int = 0) -> np.ndarray:
    free = parameters.free
    x = 0.5 * np.random.default_rng(seed).normal(size=len(free)) * free.scale
    return np.array([TRUE.get(name, value) for name, value in zip(free.names, x, strict=True)])


def data_at(q: np.ndarray, payload: float | np.ndarray | None = None) -> ro.Dataset:
    data = ro.Dataset.of(q, np.zeros((len(q), 3)), SIGMA)
    if payload is None:
        return data
    carried = np.broadcast_to(np.asarray(payload, dtype=float), (len(q),))
    return replace(data, blocks=(replace(data.blocks[0], payload=carried),))


def calibrated(robot: ro.robot.Robot, believed: ro.robot.Robot | None = None, seed: int = 0, configurations: int = 40):
    """A calibration of an arm that bends, as the believed robot's; and the true problem with its deviations."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-2.0, 2.0, (configurations, 6))
    parameters = table(robot)
    x = truth(parameters)
    real = ro.CalibrationProblem(robot, parameters, data_at(q))
    y = real.modelled(x)[0] + SIGMA * rng.normal(size=(configurations, 3))
    problem = ro.CalibrationProblem(believed or robot, parameters, ro.Dataset.of(q, y, SIGMA))
    return ro.calibrate(problem, ro.tikhonov, 1.0), real, x


def rms(e: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(e**2, axis=1))))


@pytest.mark.parametrize("mounting", ["floor", "ceiling", "wall"])
def test_what_bends_is_predicted_without_torques_wherever_the_robot_hangs(mounting: str) -> None:
    result, real, x = calibrated(arm(mounting))
    q = np.random.default_rng(9).uniform(-2.0, 2.0, (200, 6))
    expected = real.on(data_at(q)).modelled(x)[0]
    assert rms(result.predict(q).position - expected) < SIGMA * np.sqrt(3)
    assert np.abs(result.forward(q)[:, :3, 3] - result.predict(q).position).max() < 1e-15
    stiff = result.problem.parameters.identify(GEOMETRY)
    geometry = ro.calibrate(result.problem.with_parameters(stiff), ro.tikhonov, 1.0)
    assert rms(geometry.predict(q).position - expected) > 5 * SIGMA


def test_a_payload_that_was_not_there_is_predicted() -> None:
    result, real, x = calibrated(arm())
    q = np.random.default_rng(9).uniform(-2.0, 2.0, (100, 6))
    payloads = np.linspace(0, 2.5, 100)
    expected = real.on(data_at(q, payloads)).modelled(x)[0]
    assert rms(result.predict(q, payload=payloads).position - expected) < 1.5 * SIGMA * np.sqrt(3)
    assert (
        np.abs(result.forward(q, payload=payloads)[:, :3, 3] - result.predict(q, payload=payloads).position).max()
        < 1e-15
    )
    assert rms(result.predict(q).position - result.predict(q, payload=5.0).position) > 3 * SIGMA
    stated = result.predict(q, payload=1.0).position
    assert np.abs(result.predict(q).position - stated).max() == 0


@pytest.mark.parametrize("payload", [None, 0.0, 2.5])
def test_compensation_closes_the_loop_to_the_noise(payload: float | None) -> None:
    result, real, x = calibrated(arm())
    q = np.random.default_rng(9).uniform(-1.5, 1.5, (60, 6))
    nominal = (ro.robot.forward_kinematics(ARM, q) @ np.array([*TOOL[:3], 1.0]))[:, :3]
    found = ro.use.compensate(result, q, orientation=False, payload=payload)
    ok = np.array(found.status) == "ok"
    assert ok.mean() > 0.9
    assert found.position_error[ok].max() < 1e-7
    reached = real.on(data_at(found.q, payload)).modelled(x)[0]
    assert rms((reached - nominal)[ok]) < 1.5 * SIGMA * np.sqrt(3)
    # and what was believed is what the calibration predicts at the corrected commands
    predicted = result.predict(found.q, payload=payload).position
    assert np.abs(predicted - nominal)[ok].max() < 1e-7
    other = ro.use.compensate(result, q, orientation=False, payload=5.0)
    assert rms((real.on(data_at(other.q, payload)).modelled(x)[0] - nominal)[ok]) > 3 * SIGMA


def test_uncertainty_of_exported_geometry_contains_what_files_cannot_hold(tmp_path: Path) -> None:
    robot = arm()
    q = np.random.default_rng(1).uniform(-2.0, 2.0, (40, 6))
    real = ro.CalibrationProblem(robot, table(robot), data_at(q))
    x = truth(real.parameters, 1)
    y = real.modelled(x)[0] + SIGMA * np.random.default_rng(2).normal(size=(40, 3))
    rigid = ro.robot.model_parameters(robot, tools={"": TOOL}).identify(GEOMETRY)
    result = ro.calibrate(ro.CalibrationProblem(robot, rigid, ro.Dataset.of(q, y, SIGMA)), model="auto")
    assert result.learned is not None
    assert result.learned.extensions == ("gravity",)
    said = " ".join(ro.use.export_files(result, mdh=tmp_path / "arm.toml").notes)
    stated, of_gravity = (
        float(re.search(rf"{before} ([\d.]+) mm", said)[1])
        for before in (r"this geometry \(U, 95 %\): at most", "error of leaving out the model extensions, at most")
    )
    others = np.random.default_rng(3).uniform(q.min(axis=0), q.max(axis=0), (2000, 6))
    alone = ro.use.geometry_alone(result)[0].forward(others)[:, :3, 3]
    missed = 1e3 * np.linalg.norm(alone - real.on(data_at(others)).modelled(x)[0], axis=1)
    assert np.mean(missed > stated) < 0.05  # of the geometry's own U, which takes gravity for noise, 12 %
    assert 0.7 * stated < missed.max()
    assert 0.7 * stated < of_gravity < stated
    # the file says so itself, and that no limit below holds for it
    required = replace(result, record=replace(result.record, requirement=ro.data.Requirement(9e-4 * stated)))
    assert ro.use.export_files(required, mdh=tmp_path / "arm.toml").inconclusive
    assert f"at most {stated:.3f} mm" in (tmp_path / "arm.toml").read_text()
    assert "above the limit" in (tmp_path / "arm.toml").read_text()


def test_exported_geometry_is_fitted_to_the_rows_that_only_gravity_explains() -> None:
    robot = arm()
    q = np.random.default_rng(1).uniform(-2.0, 2.0, (40, 6))
    q[:, 1:3] *= 0.1  # hanging, but for two configurations
    q[:2, 1:3] = [[1.5, 0.0], [-1.5, 0.1]]
    real = ro.CalibrationProblem(robot, table(robot), data_at(q))
    y = real.modelled(truth(real.parameters, 1))[0] + SIGMA * np.random.default_rng(2).normal(size=(40, 3))
    rigid = ro.robot.model_parameters(robot, tools={"": TOOL}).identify(GEOMETRY)
    result = ro.calibrate(ro.CalibrationProblem(robot, rigid, ro.Dataset.of(q, y, SIGMA)), model="auto")
    assert result.learned is not None
    assert not result.learned.left_out
    assert ro.calibrate(result.stated).learned.left_out  # the geometry alone takes them for outliers
    assert ro.use.geometry_alone(result)[0].problem.labels == result.problem.labels


def bent(times: float = 1.0) -> ro.CalibrationProblem:
    """Return the problem of a geometry alone, measured on an arm that bends, and so many times as far."""
    robot = arm()
    q = np.random.default_rng(1).uniform(-2.0, 2.0, (40, 6))
    real = ro.CalibrationProblem(robot, table(robot), data_at(q))
    x = truth(real.parameters, 1)
    x[[name.startswith("compliance") for name in real.parameters.free.names]] *= times
    y = real.modelled(x)[0] + SIGMA * np.random.default_rng(2).normal(size=(40, 3))
    rigid = ro.robot.model_parameters(robot, tools={"": TOOL}).identify(GEOMETRY)
    return ro.CalibrationProblem(robot, rigid, ro.Dataset.of(q, y, SIGMA))


def test_gravity_that_files_cannot_hold_is_no_scatter_of_readings(tmp_path: Path) -> None:
    """They asked for a loose reflector or an instrument that something shook, also where gravity was not tried."""
    result = ro.calibrate(bent(4.0), model="auto")
    assert result.verdict.caution == ""
    rigid = ro.calibrate(bent(4.0), "tikhonov", "reml")
    assert "mm). Does the arm bend under gravity, or do its gears err" in rigid.verdict.caution
    notes = " ".join(ro.use.export_files(result, mdh=tmp_path / "arm.toml").notes)
    assert "Files cannot hold gravity: their geometry is from a separate fit" in notes
    assert "loose" not in notes


def test_acceptance_says_that_masses_are_assumed(tmp_path: Path) -> None:
    """A sheet without masses: positions were off by twice U, and the test accepted the robot without a word."""
    problem = bent()
    unknown = replace(problem, robots=replace(problem.robot, gravity=ro.robot.Gravity()))
    limit = ro.data.Requirement(2e-3)
    result = ro.calibrate(unknown, model="auto")
    said = "Gravity acts on assumed masses of the links, whose error U does not contain"
    assert said in str(ro.calibration.accept(result, limit))
    assert said not in str(ro.calibration.accept(ro.calibrate(problem, model="auto"), limit))
    notes = ro.use.export_files(result, corrections=tmp_path / "none.csv").notes
    assert "no transmission errors; `compensate` corrects compliance2" in " ".join(notes)


def test_of_extensions_at_a_given_weight_files_hold_the_geometry_of_a_formulation_of_ones_own(tmp_path: Path) -> None:
    problem = bent()
    own = ro.Formulation("own", cp.sum_squares, lambda z: cp.sum_squares(z))
    result = ro.calibrate(problem, own, 0.5, model="auto")
    notes = " ".join(ro.use.export_files(result, mdh=tmp_path / "arm.toml").notes)
    assert "Files cannot hold compliance2, compliance3, compliance4, compliance5: their geometry" in notes
    rigid = ro.calibrate(problem, own, 0.5)
    assert np.abs(ro.read_robot(tmp_path / "arm.toml").mdh - rigid.robot.mdh).max() < 1e-9


def test_a_prior_holds_for_exported_geometry_also_of_a_result_that_was_read(tmp_path: Path) -> None:
    known = ro.bayes.Prior.known("a2 = nominal + 0.4 +- 0.001 mm")
    result = ro.calibrate(bent(), prior=known, model="auto")
    assert result.learned is not None
    assert result.learned.extensions == ("gravity",)
    ro.store.save_result(result, tmp_path / "result.json")
    tables = []
    for each in (result, ro.load_result(tmp_path / "result.json")):
        ro.use.export_files(each, mdh=tmp_path / "arm.toml")
        tables.append(ro.read_robot(tmp_path / "arm.toml").mdh)
    assert np.abs(tables[1] - tables[0]).max() < 1e-9
    assert abs(tables[0][1, 1] - ARM.mdh[1, 1] - 4e-4) < 5e-6


def test_payloads_may_differ_by_row_and_lie_elsewhere() -> None:
    result, *_ = calibrated(arm())
    q = np.random.default_rng(9).uniform(-1.5, 1.5, (20, 6))
    payloads = np.linspace(0, 2.5, 20)
    together = ro.use.compensate(result, q, orientation=False, payload=payloads)
    for i in (0, 7, 19):
        alone = ro.use.compensate(result, q[[i]], orientation=False, payload=payloads[i])
        assert np.abs(alone.q - together.q[i]).max() < 1e-12
    off_axis = ro.use.compensate(result, q, orientation=False, payload=2.5, payload_centre=(0.3, 0, 0.2))
    there = ro.CalibrationProblem(
        arm(payload=2.5, centre=(0.3, 0, 0.2)), result.problem.parameters, data_at(off_axis.q)
    )
    nominal = (ro.robot.forward_kinematics(ARM, q) @ np.array([*TOOL[:3], 1.0]))[:, :3]
    ok = np.array(off_axis.status) == "ok"
    assert np.abs(there.modelled(result.x)[0] - nominal)[ok].max() < 1e-7


def compensated(result: ro.calibration.Calibration, table: dict[str, Any], **options: Any) -> ro.use.Compensation:
    targets, _ = ro.use.read_targets(result, table)
    return ro.use.compensate(result, targets.q, targets.poses, payload=targets.payload, **options)


def test_targets_state_payloads_and_no_sides() -> None:
    result, *_ = calibrated(arm())
    q = np.random.default_rng(9).uniform(-1.5, 1.5, (5, 6))
    columns = {f"q{i + 1}_rad": q[:, i] for i in range(6)}
    targets = columns | {"payload_kg": [0.0, 0.5, 1.0, 2.0, 2.5]}
    found = compensated(result, targets, orientation=False)
    same = ro.use.compensate(result, q, payload=[0.0, 0.5, 1.0, 2.0, 2.5], orientation=False)
    assert np.abs(found.q - same.q).max() < 1e-12
    without = compensated(result, columns, orientation=False)
    assert np.abs(without.q - found.q).max() > 1e-5
    sides = {f"approach{i}": [1] * 5 for i in range(1, 7)}
    with pytest.raises(ro.InputError, match="column approach1"):
        ro.use.read_targets(result, columns | sides)


def test_a_payload_that_cannot_count_is_refused() -> None:
    result, *_ = calibrated(arm())
    q = np.zeros((2, 6))
    for wrong in (-1.0, np.nan, [1.0, 2.0, 3.0]):
        with pytest.raises(ro.InputError, match="payload: found"):
            ro.use.compensate(result, q, payload=wrong)
    stiff = result.problem.with_parameters(result.problem.parameters.identify(GEOMETRY))
    geometry = ro.calibrate(stiff, ro.tikhonov, 1.0)
    with pytest.raises(ro.InputError, match="payload without effect on the model"):
        ro.use.compensate(geometry, q, payload=1.0, despite_verdict=True)
    with pytest.raises(ro.InputError, match="joint torques"):
        ro.use.compensate(result, q, torque=np.zeros((2, 6)))
    with pytest.raises(ro.InputError, match="joint torques"):
        result.forward(q, torque=np.zeros((2, 6)))


def test_free_first_moments_are_predicted_and_compensated() -> None:
    robot = arm("wall")
    bends = ro.robot.moment_names(robot)[:12]
    parameters = table(robot, bends)
    x = 2e-4 * np.random.default_rng(0).normal(size=12)
    q = np.random.default_rng(1).uniform(-1.5, 1.5, (60, 6))
    real = ro.CalibrationProblem(robot, parameters, data_at(q))
    data = ro.Dataset.of(q, real.modelled(x)[0], SIGMA)
    result = ro.calibrate(real.on(data), ro.tikhonov, 1e-12)
    assert np.abs(result.predict(q).position - data.blocks[0].y).max() < 1e-8
    found = ro.use.compensate(result, q, orientation=False)
    nominal = (ro.robot.forward_kinematics(ARM, q) @ np.array([*TOOL[:3], 1.0]))[:, :3]
    ok = np.array(found.status) == "ok"
    reached = real.on(data_at(found.q)).modelled(x)[0]
    assert np.abs(reached - nominal)[ok].max() < 2e-7


# --- the wrong way up -----------------------------------------------------------------------------------------------


def upwards(result: ro.calibration.Calibration) -> tuple[int, ...]:
    return lack_of_fit(result).upward


def test_a_robot_that_hangs_otherwise_than_stated_seems_to_bend_upwards() -> None:
    right, *_ = calibrated(arm())
    assert upwards(right) == ()
    wrong, *_ = calibrated(arm("ceiling"), believed=arm("floor"))
    assert {"2", "3"} <= set(upwards(wrong))
    assert any("negative, which gravity cannot cause" in said for said in lack_of_fit(wrong).sentences())


def test_a_table_whose_first_axis_points_down_warns_until_it_is_told_so() -> None:
    """The same arm from a table whose frame 0 is upside down: on the floor there gravity points along +z."""
    turned = ARM.mdh.copy()
    turned[1, 0] += np.pi  # frame 0 and the first axis point down: alpha2 takes the half turn
    down = replace(ARM, mdh=turned)
    real = replace(down, gravity=ro.robot.Gravity().mounted([0, 0, 1]))
    wrong, *_ = calibrated(real, believed=down)
    assert {"2", "3"} <= set(upwards(wrong))
    right, *_ = calibrated(real)
    assert upwards(right) == ()


def test_measured_torques_have_the_sign_of_their_controller() -> None:
    """The torques that gravity would have in the wrong mounting, but measured: the arm gives way the other way."""
    wrong, *_ = calibrated(arm("ceiling"), believed=arm("floor"))
    data = wrong.problem.data
    torque = ro.robot.gravity_torques(arm("floor"), wrong.problem.joint_values)
    loaded = replace(data, blocks=(replace(data.blocks[0], torque=torque[:, None]),))
    problem = ro.CalibrationProblem(arm("floor"), wrong.problem.parameters, loaded)
    measured = ro.calibrate(problem, ro.tikhonov, 1.0)
    named = dict(zip(measured.problem.parameters.free.names, measured.x, strict=True))
    assert named["compliance2"] < -1e-6
    assert upwards(measured) == ()


# --- files ----------------------------------------------------------------------------------------------------------


def test_a_result_keeps_its_gravity_and_an_older_one_loads(tmp_path: Path) -> None:
    masses = ro.robot.Gravity(masses=(4.0, 3, 2, 1, 1, 0.5), centres=((0.0, 0.01, 0.1),) * 6)
    robot = replace(ARM, gravity=masses.carrying(1.5, (0, 0, 0.08)).mounted("wall"))
    result, *_ = calibrated(robot)
    data = result.problem.data
    side = np.ones((len(data), 1, 6))
    block = replace(data.blocks[0], payload=np.full(len(data), 1.5), approach=side)
    result = ro.calibrate(result.problem.on(replace(data, blocks=(block,))), ro.tikhonov, 1.0)
    path = tmp_path / "result.json"
    ro.store.save_result(result, path)
    again = ro.load_result(path)
    assert again.problem.robot.gravity == robot.gravity
    kept = again.problem.data.blocks[0]
    assert kept.payload is not None
    assert kept.approach is not None
    assert np.array_equal(kept.payload, np.full(len(data), 1.5))
    assert np.array_equal(kept.approach, side)
    q = np.random.default_rng(3).uniform(-2, 2, (10, 6))
    assert np.abs(again.forward(q, payload=2.0) - result.forward(q, payload=2.0)).max() == 0


def test_gravity_is_stated_in_a_problems_folder(tmp_path: Path) -> None:
    ro.robot.write_robot(ARM, tmp_path / "robot.toml")
    q = np.degrees(np.random.default_rng(0).uniform(-2, 2, (12, 6)))
    lines = ["q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm,payload_kg"]
    lines += [",".join(map(repr, [*row.tolist(), 1.0, 2.0, 3.0, 0.5])) for row in q]
    (tmp_path / "data.csv").write_text("\n".join(lines))
    head = 'title = "t"\nidentification = "data.csv"\nidentify = ["theta[2-6]", "compliance2"]\n'
    tail = "[noise]\nposition_mm = 0.1\n"
    (tmp_path / "problem.toml").write_text(head + 'mounting = "wall"\n' + tail + "[payload]\nmass_kg = 2\nz_mm = 80\n")
    problem = ro.load(tmp_path).problem
    assert problem.robot.gravity == ro.robot.Gravity().mounted("wall").carrying(2.0, (0, 0, 0.08))
    assert problem.data.blocks[0].payload is not None
    assert [name for name in problem.parameters.names if name.startswith("moment1_")]
    for stated, match in (
        ('mounting = "roof"\n', "key mounting: found 'roof'"),
        ("mounting = [0, 0, 0]\n", "mounting"),
    ):
        (tmp_path / "problem.toml").write_text(head + stated + tail)
        with pytest.raises(ro.InputError, match=match):
            ro.load(tmp_path)
    (tmp_path / "problem.toml").write_text(head + tail + "[payload]\nmass_g = 2\n")
    with pytest.raises(ro.InputError, match="mass_kg"):
        ro.load(tmp_path)


def test_a_mounting_speaks_of_a_urdfs_base_wherever_its_first_axis_points(tmp_path: Path) -> None:
    from tests.robot.test_gravity import DRAWN, UPSIDE_DOWN, URDF

    head = 'title = "t"\nrobot = "arm.urdf"\nurdf_base = "base"\nurdf_tip = "tip"\nidentification = "data.csv"\n'
    head += 'identify = ["theta[23]"]\n'
    (tmp_path / "data.csv").write_text("q1_deg,q2_deg,q3_deg,x_mm,y_mm,z_mm\n1,2,3,4,5,6\n3,2,1,4,5,6\n")
    for drawn, sign in ((DRAWN, 1), (UPSIDE_DOWN, -1)):
        (tmp_path / "arm.urdf").write_text(URDF.format(**drawn))
        for mounting, z in (("", -1), ('mounting = "ceiling"\n', 1), ("mounting = [0, 0, -1]\n", -1)):
            (tmp_path / "problem.toml").write_text(head + mounting + "[noise]\nposition_mm = 0.1\n")
            gravity = ro.load(tmp_path).problem.robot.gravity
            assert gravity.direction == pytest.approx((0, 0, sign * z))
            assert len(gravity.masses) == 3


SIMULATED = """title = "bent"
robot = "robot.toml"
identification = "identification.csv"
validation = "validation.csv"
mounting = "wall"
identify = ["theta[2-6]", "compliance[234]"]
[noise]
position_mm = 0.02
[payload]
mass_kg = 3
[simulation]
seed = 1
configurations = 30
validation = 20
torques = "gravity"
"""


def test_a_simulated_folder_bends_by_gravity_without_a_column_of_torques(tmp_path: Path) -> None:
    limited = replace(ARM, limits=np.tile([-2.0, 2.0], (6, 1)))
    ro.robot.write_robot(limited, tmp_path / "robot.toml")
    (tmp_path / "problem.toml").write_text(SIMULATED)
    write_simulation(tmp_path)
    assert "tau1" not in (tmp_path / "identification.csv").read_text()
    instance = ro.load(tmp_path)
    assert instance.validation is not None
    assert instance.problem.robot.gravity.direction == (-1, 0, 0)
    result = ro.calibrate(instance.problem, ro.tikhonov, 1.0)
    assert 1e3 * result.errors(instance.validation).mean() < 0.02  # as good as the noise
    stiff = instance.problem.with_parameters(instance.problem.parameters.identify(["theta[2-6]"]))
    assert 1e3 * ro.calibrate(stiff, ro.tikhonov, 1.0).errors(instance.validation).mean() > 0.06
