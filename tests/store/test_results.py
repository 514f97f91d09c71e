"""Results last: what a file holds gives the same figures, to the last bit."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from tests.simulate import simulated
from tests.test_cli import run


def saved(
    tmp_path: Path, result: ro.calibration.Calibration, record: ro.data.Record | None = None
) -> ro.calibration.Calibration:
    ro.store.save_result(result if record is None else replace(result, record=record), tmp_path)
    return ro.load_result(tmp_path)


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in (
    "cable", "distance", "far_frames", "markers", "plane", "scara", "seven_axis", "sphere", "tracker")]  # fmt: skip


@pytest.mark.parametrize("name", ["paper_arm", "blunders", "constrained", "joints", "mixed", "pose", *SLOW])
def test_a_loaded_result_is_the_same_to_the_last_bit(tmp_path: Path, name: str) -> None:
    instance = ro.load(name, "everything" if name == "constrained" else None)
    result = instance.calibrate()
    again = saved(tmp_path, result, instance.record)
    assert np.array_equal(again.x, result.x)
    assert np.array_equal(again.errors(), result.errors())
    assert instance.validation is not None
    assert np.array_equal(again.errors(again.record.validation), result.errors(instance.validation))
    assert np.array_equal(again.covariance, result.covariance)
    assert np.array_equal(again.nominal_errors(), result.nominal_errors())
    assert again.history == result.history
    assert again.certificate.decrease < 1e-12  # of a solver's run of its own
    assert str(again) == str(result)
    assert np.array_equal(again.robot.mdh, result.robot.mdh)
    assert again.record.files == instance.record.files
    assert again.record.simulated == instance.record.simulated
    assert set(again.record.versions) >= {"rpim-opt", "numpy", "casadi", "cvxpy-base", "clarabel"}
    first = json.loads((tmp_path / "result.json").read_text())
    ro.store.save_result(again, tmp_path / "result.json")
    second = json.loads((tmp_path / "result.json").read_text())
    for content in (first, second):
        del content["certificate"], content["active_bounds"], content["digest"]
    assert second == first


def test_a_file_says_when_and_from_what_it_was_made(monkeypatch, tmp_path) -> None:
    assert run(monkeypatch, "calibrate", "paper_arm", "--out", str(tmp_path)) == 0
    record = json.loads((tmp_path / "result.json").read_text())["record"]
    assert re.fullmatch(r"20\d\d-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00", record["made"])
    assert set(record["files"]) == {"problem.toml", "robot.toml", "identification.csv", "validation.csv"}
    assert all(re.fullmatch("[0-9a-f]{64}", digest) for digest in record["files"].values())
    assert record["excluded"]["T8-6"]
    assert record["simulated"] is False


@pytest.mark.parametrize(
    "selector", [ro.corner, ro.gcv, lambda program: ro.select.Selection(1.0, "mine", np.ones(1), np.ones(1), True)]
)
def test_the_evidence_for_the_weight_is_kept(tmp_path: Path, selector) -> None:
    problem, _ = simulated(noise=5e-5)
    result = ro.calibrate(problem, ro.tikhonov, selector)
    again = saved(tmp_path, result).selection
    assert result.selection is not None
    assert again is not None
    assert np.array_equal(again.weights, result.selection.weights)
    assert np.array_equal(again.score, result.selection.score)
    assert (again.name, again.weight, again.note) == (result.selector, result.weight, result.selection.note)
    assert again.interior is bool(result.selection.interior)


AT_NOMINAL = ro.constraints.at_nominal("alpha[34]")
SIGNS = (ro.constraints.signed(1, "a[23]"), ro.constraints.equal("a2", "a3"))
FORMULATIONS = [
    ro.Formulation("own numbers", ro.huber(1.5), cp.sum_squares, (AT_NOMINAL, ro.in_ball(9.0, "a?"))),
    ro.Formulation("differences", penalty=cp.sum, penalty_over=ro.constraints.differences("a?")),
    ro.Formulation("signs", penalty=cp.sum_squares, constraints=SIGNS),
    ro.least_squares,
    ro.robust,
    ro.group_lasso,
    ro.lasso,
]


@pytest.mark.parametrize("formulation", FORMULATIONS, ids=lambda f: f.name)
def test_ready_made_formulations_can_be_solved_again(tmp_path: Path, formulation: ro.Formulation) -> None:
    problem, _ = simulated(noise=5e-5)
    result = ro.calibrate(problem, formulation, 1.0)
    again = saved(tmp_path, result)
    assert again.formulation.solvable
    repeated = ro.calibrate(again.problem, again.formulation, again.weight)
    assert np.array_equal(repeated.x, result.x)


def test_the_weight_that_a_rule_of_a_script_chose_is_kept(tmp_path: Path) -> None:
    problem, _ = simulated(noise=5e-5)
    again = saved(tmp_path, ro.calibrate(problem, ro.tikhonov, lambda program: 3.0))
    assert again.calibrate_again(again.problem).weight == 3.0


def test_functions_of_a_script_are_missing_and_nothing_else(tmp_path: Path) -> None:
    instance = ro.load("blunders")
    mine = ro.Formulation("mine", lambda v: cp.sum(cp.huber(v, 2)), cp.sum_squares, loss_over="configuration")  # ty: ignore
    result = ro.calibrate(instance.problem, mine, ro.reml)
    again = saved(tmp_path, result, instance.record)
    assert np.array_equal(again.errors(), result.errors())
    # the kept rows' factor is a root that is squared again
    assert again.covariance == pytest.approx(result.covariance, rel=1e-13)
    q = instance.problem.data.q
    assert again.predict(q, confidence=0.95).expanded == pytest.approx(
        result.predict(q, confidence=0.95).expanded, rel=1e-12
    )
    assert again.flagged == result.flagged
    assert again.certificate == result.certificate
    assert "cannot store functions of a script" in str(again)
    assert "cannot store functions of a script" not in str(result)
    with pytest.raises(ro.InputError, match="formulation 'mine': found functions that a result file cannot hold"):
        ro.calibrate(again.problem, again.formulation, 1.0)
    twice = saved(tmp_path, again)
    assert str(twice) == str(again)
    assert np.array_equal(twice.covariance, again.covariance)


def test_intervals_stay_conditional_on_a_scripts_constraints(tmp_path: Path) -> None:
    instance = ro.load("position")
    q = instance.problem.data.q[:3]
    place = ro.calibrate(instance.problem, ro.tikhonov, 1.0).predict(q).position + 1e-4

    def held(z: Any, p: Any) -> Any:
        return p.positions(q)[:1, 2] == place[:1, 2]

    mine = ro.Formulation("mine", penalty=cp.sum_squares, constraints=(held,))
    result = ro.calibrate(instance.problem, mine, 1.0)
    again = saved(tmp_path, result, instance.record)
    assert again.active_constraints == result.active_constraints == ("held",)
    assert again.predict(q, of="mean").standard == pytest.approx(result.predict(q, of="mean").standard, rel=1e-9)
    assert again.predict(q, of="mean").standard[0, 2] < 1e-8
    assert str(again).count("Active constraints: held") == 1


def test_a_measurement_of_a_script_is_passed_again(tmp_path: Path) -> None:
    height = ro.data.Measurement("height", model=lambda T: T[2, 3], columns={"z": "length"})
    arm = ro.load("paper_arm").problem
    data = ro.Dataset.of(
        arm.data.q, ro.robot.forward_kinematics(arm.robot, arm.data.q)[:, 2:3, 3] + 1e-3, 1e-5, measurement=height
    )
    problem = ro.CalibrationProblem(arm.robot, arm.parameters.identify(["d1"]), data)
    result = ro.calibrate(problem, ro.tikhonov, 1.0)
    ro.store.save_result(result, tmp_path / "result.json")
    with pytest.raises(ro.InputError, match=r"measurement: found 'height', accepted: measurements=\[...\] with it"):
        ro.load_result(tmp_path)
    assert np.array_equal(ro.load_result(tmp_path, [height]).x, result.x)
    other = ro.data.Measurement("height", model=lambda T: T[1, 3], columns={"z": "length"})
    with pytest.raises(ro.InputError, match="which follows from the file's data, terms and measurement models"):
        ro.load_result(tmp_path, [other])


@pytest.fixture(scope="module")
def text(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("result") / "result.json"
    instance = ro.load("paper_arm")
    result = ro.calibrate(instance.problem, ro.tikhonov, 1.0)
    ro.store.save_result(replace(result, record=instance.record), path)
    return path.read_text()


BAD = {
    "truncated": (lambda t: t[: len(t) // 2], "the JSON text: found"),
    "another JSON file": (lambda t: '{"weight": 1}', "no result of rpim-opt"),
    "a list": (lambda t: "[1, 2]", "no result of rpim-opt"),
    "a newer version": (lambda t: t.replace('"version": 3', '"version": 4', 1), "key version: found 4, accepted: 3"),
    "a key twice": (lambda t: t.replace('"weight": 1.0', '"weight": 1.0, "weight": 1.0', 1), "the key 'weight' twice"),
    "not a number": (lambda t: t.replace('"weight": 1.0', '"weight": NaN', 1), "inconsistent content"),
    "a key left out": (lambda t: t.replace('"history"', '"hist"', 1), "its content was changed"),
    "an edited parameter": (lambda t: re.sub(r'"x": \[\S+,', '"x": [0.001,', t, count=1), "was changed"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_what_is_no_result_is_refused_in_one_sentence(tmp_path: Path, text: str, case: str) -> None:
    change, said = BAD[case]
    path = tmp_path / "r.json"
    path.write_text(change(text))
    assert path.read_text() != text
    with pytest.raises(ro.InputError) as error:
        ro.load_result(path)
    assert said in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_no_file_is_refused_too(tmp_path: Path) -> None:
    with pytest.raises(ro.InputError, match=r"result.json, the file: found nothing, accepted: an existing file"):
        ro.load_result(tmp_path)


def test_forward_and_predict_are_the_model(tmp_path: Path) -> None:
    instance = ro.load("position")
    result = ro.calibrate(instance.problem, ro.tikhonov, ro.reml)
    data = instance.validation
    assert data is not None
    T = result.forward(data.q)
    assert T[:, 3] == pytest.approx(np.tile([0.0, 0.0, 0.0, 1.0], (len(T), 1)), abs=0)
    assert T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1) == pytest.approx(
        np.tile(np.eye(3), (len(T), 1, 1)), abs=1e-14
    )
    predicted = result.predict(data.q)
    assert np.array_equal(predicted.position, T[:, :3, 3])
    assert np.array_equal(predicted.standard, result.predict(data.q, confidence=0.95).standard)
    error = data.blocks[0].y - predicted.position
    assert (
        np.array_equal(np.linalg.norm(error, axis=1), result.errors(data))
        or np.abs(np.linalg.norm(error, axis=1) - result.errors(data)).max() < 1e-15
    )
    assert np.array_equal(result.error_vectors(data), error)
    with pytest.raises(ro.InputError, match="formulation 'lasso'"):
        ro.calibrate(instance.problem, ro.lasso, 1.0).predict(data.q)


def test_forward_knows_reflectors_and_torques() -> None:
    instance = ro.load("markers")
    result = ro.calibrate(instance.problem, ro.tikhonov, 1.0)
    for block in instance.problem.data.blocks:
        error = block.y - result.forward(block.q[:, 0], block.markers[0])[:, :3, 3]
        assert np.abs(np.linalg.norm(error, axis=1) - result.errors()[block.row]).max() < 1e-15
    with pytest.raises(ro.InputError, match="column marker"):
        result.forward(block.q[:, 0], "Z")
    instance = ro.load("joints")
    result = ro.calibrate(instance.problem, ro.tikhonov, 1.0)
    (block,) = instance.problem.data.blocks
    assert block.torque is not None
    T = result.forward(block.q[:, 0], torque=block.torque[:, 0])
    assert np.abs(np.linalg.norm(block.y - T[:, :3, 3], axis=1) - result.errors()).max() < 1e-15
    with pytest.raises(ro.InputError, match="without joint torques"):
        result.forward(block.q[:, 0])


def test_a_notebook_shows_labels_as_text() -> None:
    problem, _ = simulated(noise=5e-5)
    label = ("<script>alert(1)</script>", *map(str, range(39)))
    bad = problem.data.blocks[0].y.copy()
    bad[0] += 0.01
    result = ro.calibrate(problem.on(ro.Dataset.of(problem.data.q, bad, 5e-5, label)), ro.robust, 1.0)
    page = result._repr_html_()
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert "<script" not in page
    assert page.count("<tr>") == 1 + len(result.x)


def test_measurements_without_a_length_are_kept_too(tmp_path: Path) -> None:
    tilt = ro.data.Measurement("tilt", model=lambda T: T[2, 2], columns={"c": "angle"}, noise={"angle": "angle"})
    arm = ro.load("paper_arm").problem
    T = ro.robot.forward_kinematics(arm.robot, arm.data.q)
    data = ro.Dataset.of(arm.data.q, T[:, 2:3, 2], 1e-4, measurement=tilt)
    problem = ro.CalibrationProblem(arm.robot, arm.parameters.identify(["alpha2"]), data)
    ro.store.save_result(ro.calibrate(problem, ro.tikhonov, 1.0), tmp_path)
    result = ro.load_result(tmp_path, [tilt])
    assert json.loads((tmp_path / "result.json").read_text())["identification"]["count"] == 0
    with pytest.raises(ro.InputError, match="no measurement of a length"):
        ro.report.write_report(result, tmp_path / "report.html")
    assert not (tmp_path / "report.html").exists()
