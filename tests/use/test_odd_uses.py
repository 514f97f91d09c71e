"""Results that are asked for what they cannot do, and verdicts in words for whatever came out."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.problem import PartitionedProblem, Repeatability
from rpim_opt.use import export_files
from rpim_opt.use.export import write_all
from rpim_opt.use.monitoring import Drift
from rpim_opt.use.recalibration import Cause, Moved
from tests.simulate import simulated
from tests.test_cli import run


@cache
def calibrated(formulation: str = "tikhonov") -> ro.calibration.Calibration:
    problem, _ = simulated(("theta[23]", "d4", "tool_[xyz]", "base_*"), 20, 5e-5, 3)
    return ro.calibrate(problem, formulation, 1.0)


def checks(count: int = 8, moved: float = 0.0) -> ro.Dataset:
    """Return readings of the robot as calibrated, with one joint moved by an angle [rad]."""
    result = calibrated()
    q = np.random.default_rng(7).uniform(-2, 2, (count, 6))
    x = result.x.copy()
    x[result.problem.parameters.free.names.index("theta2")] += moved
    empty = ro.Dataset.of(q, np.zeros((count, 3)), 5e-5)
    return ro.Dataset.of(q, result.problem.on(empty).modelled(x)[0], 5e-5)


@cache
def updated() -> Any:
    return ro.use.update(calibrated(), checks())


@cache
def monitored() -> Any:
    return ro.use.monitor(calibrated(), checks())


READING = Cause("c1", "reading", ("c1",), 40.0, 1e-9, 0.9)
JOINT = Cause("theta2", "joint offset", ("theta2",), 50.0, 1e-9, 0.6)
MOVED = Moved("theta2", "angle", 1e-3, 1e-4)
RIVAL = Cause("theta3", "joint offset", ("theta3",), 45.0, 1e-8, 0.4)


def unlikely(fit: Any) -> Any:
    return fit._replace(squares=1e4, probability=1e-12)


def test_a_script_is_told_of_arguments_and_a_command_of_options(monkeypatch, capsys, tmp_path) -> None:
    result = calibrated()
    with pytest.raises(ro.InputError, match=r"^marker: found 'B'"):
        ro.use.compensate(result, np.zeros((1, 6)), marker="B")
    with pytest.raises(ro.InputError, match=r"accepted: urdf, \.\.\.; mdh and others name their own"):
        ro.use.export_files(result, tmp_path / "x.toml", mdh=tmp_path / "y.toml", despite_verdict=True)
    data = result.problem.data
    named = replace(data, blocks=tuple(replace(block, markers=("B",)) for block in data.blocks))
    with pytest.raises(ro.InputError, match="found 'B', accepted: no names of reflectors"):
        result.problem.on(named)
    ro.store.save_result(result, tmp_path / "result.json")
    assert run(monkeypatch, "export", str(tmp_path), "--mdh", "y.toml", "--out", "x.toml", "--despite-verdict") == 2
    assert "accepted: --urdf, ...; --mdh and others name their own" in capsys.readouterr().err


def test_an_update_says_what_came_out() -> None:
    found = updated()
    assert str(found).startswith("No change of the robot is detectable from 8 readings: chi-squared")
    assert found.explained
    lost = replace(found, before=unlikely(found.before), after=unlikely(found.after), changes=())
    assert "8 readings contradict the previous calibration" in str(lost)
    wrong = replace(found, before=unlikely(found.before), changes=(READING,), causes=(READING,))
    assert str(wrong).startswith(
        "The robot has not changed, but readings are wrong. With the previous calibration: chi-squared"
    )
    assert "reading c1: chi-squared falls by 40, posterior probability 0.9, excluded." in str(wrong)
    assert not wrong.changed
    moved = replace(found, before=unlikely(found.before), changes=(JOINT,), causes=(JOINT, RIVAL))
    assert str(moved).startswith("The robot has changed. With the previous calibration: chi-squared")
    assert "These readings do not distinguish this from a change of theta3: measure more." in str(moved)
    assert "excluded" not in str(moved)
    sure = replace(moved, causes=(JOINT,))
    assert "do not tell it apart" not in str(sure)


@pytest.mark.parametrize(
    ("drift", "said"),
    [
        (None, "No single parameter or frame explains the deviation."),
        (Drift(JOINT, 0, True, MOVED), "theta2 +0.0573 deg (standard deviation 0.0057), steadily from"),
        (Drift(JOINT, 0, False, MOVED), "before the first check"),
        (Drift(JOINT, 3, False, None), "theta2, in one step before '4'"),
    ],
)
def test_monitoring_says_what_moved(drift: Drift | None, said: str) -> None:
    quiet = monitored()
    assert str(quiet).startswith("No drift in 8 checks.")
    sums = np.array([0.0, 0.0, 1.0, 2.0, 9e9, 9e9, 9e9, 9e9])
    found = replace(quiet, sums=sums, drift=drift)
    lines = str(found).splitlines()
    assert lines[0] == "The robot deviates from its calibration (8 checks)."
    assert lines[1] == "Cumulative sum above its limit at check '5', rising since '3'."
    assert said in lines[2]
    assert found.content()["since"] == "3"
    only = replace(quiet, sigmas=quiet.sigmas + 100.0 * (np.arange(8) == 5), drift=drift)
    assert "Outside the prediction interval of a new reading: '6', " in str(only)
    assert "Cumulative" not in str(only)
    assert only.content()["alarm"] is None
    moved = found.content()["moved"]
    assert (moved is None) == (drift is None)
    if drift is not None and drift.moved is None:
        assert moved["moved"] is None


def test_sums_that_never_were_zero_began_at_the_first_check() -> None:
    found = replace(monitored(), sums=np.linspace(1.0, 9e9, 8))
    assert found.content()["since"] == found.label[0]


def test_two_checks_show_no_course() -> None:
    """A change at once is all that two can show; nothing is found where nothing moved."""
    found = ro.use.monitor(calibrated(), checks(2))
    assert found.drift is None
    moved = ro.use.monitor(calibrated(), checks(2, 0.02))
    assert moved.drifts
    assert moved.drift is None or not moved.drift.steady


def test_what_a_formulation_cannot_do_is_said() -> None:
    with pytest.raises(ro.InputError, match="the penalty of formulation 'lasso' is not quadratic"):
        ro.use.monitor(calibrated("lasso"), checks())


def test_a_script_is_told_of_degrees_and_of_arrays_that_are_no_dataset() -> None:
    result, degrees = calibrated(), [[10.0, -90.0, 45.0, 0.0, 30.0, 0.0]]
    for use in (result.forward, result.predict, partial(ro.use.compensate, result)):
        with pytest.raises(ro.InputError, match=r"q: found shape \(2, 1, 6\), accepted: "):
            use(np.zeros((2, 1, 6)))
        with pytest.raises(ro.InputError, match=r"q: found 90 rad, accepted: at most 4 turns: are these degrees"):
            use(degrees)
    for use in (result.errors, partial(ro.use.validate, result), result.problem.on):
        with pytest.raises(ro.InputError, match="data: found a ndarray, accepted: a Dataset"):
            use(np.zeros((3, 3)))


def test_a_robot_and_a_payload_that_are_none_are_refused() -> None:
    q = checks().q
    with pytest.raises(ro.InputError, match="robot: found 'left'"):
        ro.use.compensate(calibrated(), q=q, robot="left")
    with pytest.raises(ro.InputError, match="a payload without effect on the model"):
        ro.use.compensate(calibrated(), q=q, payload=3.0)


def test_repeatability_is_at_the_robot_that_was_found() -> None:
    result = calibrated()
    noisy = replace(result, problem=replace(result.problem, repeatability=Repeatability(1e-4, 0.0, 0.0)))
    found = ro.use.compensate(noisy, q=checks().q, tool=[0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    plain = ro.use.compensate(result, q=checks().q, tool=[0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    assert np.allclose(found.q, plain.q, atol=1e-12)


# --- tables --------------------------------------------------------------------------------------------------------

Q = {f"q{i}_deg": [0.0, 5.0] for i in range(1, 7)}
PLACES = {"x_mm": [1.0, 2.0], "y_mm": [1.0, 2.0], "z_mm": [1.0, 2.0]}


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({**Q, **PLACES, "marker": ["A", "B"]}, "several reflectors, accepted: targets of one"),
        ({**Q, **PLACES} | {f"approach{i}": [1, -1] for i in range(1, 7)}, "none: compensation assumes the middle"),
    ],
)
def test_targets_that_are_none(table: dict[str, Any], said: str) -> None:
    with pytest.raises(ro.InputError) as error:
        ro.use.read_targets(calibrated(), table)
    assert said in str(error.value)


def test_degrees_that_are_radians_are_remarked_on() -> None:
    """Of three rows or more, since a few targets may all be near zero."""
    q = np.random.default_rng(4).uniform(-2, 2, (3, 6))
    table = {f"q{i}_deg": column for i, column in enumerate(q.T, start=1)}
    readings = table | {name: [1.0, 2.0, 3.0] for name in PLACES}
    said = "if they are in radians, name the columns q1_rad, ..."
    for notes in (
        ro.use.read_targets(calibrated(), table)[1].notes,
        ro.use.read_measurements(calibrated(), readings).notes,
    ):
        assert len([note for note in notes if note.endswith(said)]) == 1
    for other in (
        {name: cells[:2] for name, cells in table.items()},
        {name: np.degrees(cells) for name, cells in table.items()},
        {name.replace("deg", "rad"): cells for name, cells in table.items()},
    ):
        assert not ro.use.read_targets(calibrated(), other)[1].notes


def test_a_table_of_another_kind_or_with_a_numbered_quaternion_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ro.InputError, match="measurement: found 'pose'"):
        ro.use.read_measurements(calibrated(), {**Q, **PLACES}, "pose")
    pose = ro.load("pose")
    path = tmp_path / "raw.csv"
    head = [*(f"J{i} [deg]" for i in range(1, 7)), "X [mm]", "Y [mm]", "Z [mm]", "Q0", "Q1", "Q2", "Q3"]
    path.write_text(",".join(head) + "\n" + ",".join(["1"] * 9 + ["1", "0", "0", "0"]) + "\n")
    with pytest.raises(
        ro.InputError, match=r"an ambiguous order .* accepted: quaternion wxyz or xyzw, or names qw, qx"
    ):
        ro.use.read_measurements(pose.calibrate(weight=1.0), path)


APPROACHES = {"Pose": ["P1", "P1"], "X [mm]": [0.0, 1.0], "Y [mm]": [0.0, 0.0], "Z [mm]": [0.0, 0.0]}


def test_approaches_with_other_columns() -> None:
    found = ro.use.read_approaches({**APPROACHES, "RMS": [1.0, 2.0], "Operator": ["a", "b"], "dX": [0.1, 0.2]})
    assert 1e3 * found.repeatability == pytest.approx(0.5)  # both are as far from their middle
    assert found.content()["accuracy_mm"] is None
    assert found.content()["poses"][0]["AP_p_mm"] is None
    assert "AP_p" not in str(found)
    for table, said in (
        ({**APPROACHES, "Measured X [mm]": [0.0, 0.0]}, "'X [mm]' and 'Measured X [mm]'"),
        ({name: cells for name, cells in APPROACHES.items() if name != "Pose"}, "the header"),
        ({name: cells for name, cells in APPROACHES.items() if name != "Z [mm]"}, "the header"),
    ):
        with pytest.raises(ro.InputError) as error:
            ro.use.read_approaches(table)
        assert said in str(error.value)


# --- files ---------------------------------------------------------------------------------------------------------


def test_rows_of_an_instrument_that_moved_are_named() -> None:
    instance = ro.load("position")
    result = ro.calibrate(instance.problem)
    (block,) = instance.validation.blocks
    moved = replace(instance.validation, blocks=(replace(block, y=block.y + np.array([0.5, -0.2, 0.1])),))
    assert "--register" in ro.use.validate(result, moved).mistake
    # less than the nominal robot's errors, many times the prediction intervals
    moved = replace(instance.validation, blocks=(replace(block, y=block.y + np.array([0.0005, -0.0006, 0.0002])),))
    assert "displaced as a whole by 0.80" in ro.use.validate(result, moved).mistake
    requirement = ro.data.Requirement(limit=1e-2)
    accepted = ro.calibration.accept(result, requirement, moved)
    assert accepted.verdict == "inconclusive"
    assert "the instrument or the base moved" in str(accepted)
    assert not ro.use.validate(result, instance.validation).mistake
    rejected = ro.calibration.accept(result, ro.data.Requirement(limit=2e-4), moved)
    assert rejected.verdict == "rejected"
    assert "If the instrument or the base moved, use --register" in str(
        rejected
    )  # a good robot is not rejected without a hint
    # by less than a row's interval: together the rows contradict the calibration
    moved = replace(instance.validation, blocks=(replace(block, y=block.y + np.array([6e-5, -6e-5, 6e-5])),))
    found, accepted = ro.use.validate(result, moved), ro.calibration.accept(result, requirement, moved)
    assert not found.mistake
    assert "The measurements are displaced as a whole by 0.1 mm" in str(found)
    assert accepted.verdict == "inconclusive"
    assert accepted.reasons[-1].endswith("If the instrument was moved since the calibration, use --register.")
    assert not ro.use.validate(result, moved, register=True).remarks[1:]


@pytest.mark.parametrize("register", [False, True])
def test_the_row_from_which_on_an_instrument_moved_is_named(register: bool) -> None:
    """Calibrations name it; `validate` said that all rows are displaced as a whole."""
    instance = ro.load("position")
    result = ro.calibrate(instance.problem)
    (block,) = instance.validation.blocks
    steps = np.outer(np.arange(40) >= 24, [0.0013, -0.0004, 0.0002])
    moved = replace(instance.validation, blocks=(replace(block, y=block.y + steps),))
    said = ro.use.validate(result, moved, register).mistake
    assert re.match(r"Likely: from row c2[345] on the points are 1\.[34]\d? mm off the fit .* a changed base", said)


@pytest.mark.parametrize("name", ["position", "pose"])
def test_measurements_of_an_instrument_that_moved_are_registered_again(name: str) -> None:
    instance = ro.load(name)
    result = ro.calibrate(instance.problem)
    (block,) = instance.validation.blocks
    y = block.y.copy()
    y[3, :3] += 0.008  # a broken beam does not move the frame
    stayed = replace(instance.validation, blocks=(replace(block, y=y.copy()),))
    there = ro.use.validate(result, stayed, register=True)
    turn = Rotation.from_rotvec([0.2, -1.0, 0.4])
    y[:, :3] = turn.apply(y[:, :3]) + np.array([2.0, -1.0, 0.5])
    if y.shape[1] == 7:
        y[:, [4, 5, 6, 3]] = (turn * Rotation.from_quat(y[:, [4, 5, 6, 3]])).as_quat()
    moved = replace(instance.validation, blocks=(replace(block, y=y),))
    again = ro.use.validate(result, moved, register=True)
    assert again.error == pytest.approx(there.error, abs=1e-9)
    assert again.angle == pytest.approx(there.angle, abs=1e-7, nan_ok=True)
    assert np.delete(again.error, 3).max() <= np.delete(ro.use.validate(result, stayed).error, 3).max()
    assert again.beyond[0] == 3
    assert not again.mistake
    assert "Registered again: the measurements were" in str(again)
    with pytest.raises(ro.InputError, match="register, measured positions: found 2"):
        ro.use.validate(result, moved.take(range(2)), register=True)
    assert len(ro.use.validate(result, moved.take(range(3)), register=True).error) == 3


def test_a_urdf_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ro.InputError, match=r"none\.urdf"):
        export_files(calibrated(), tmp_path / "out.urdf", urdf=tmp_path / "none.urdf")


def test_what_no_file_holds_is_named_and_counted() -> None:
    problem, _ = simulated(("ecc?*", "compliance?"), 40)
    result = ro.calibrate(problem, weight=1.0)
    with pytest.raises(ro.InputError, match=r"and \d+ more, accepted: MDH parameters"):
        ro.use.identified(replace(result, x=np.full(len(result.x), 1e-6)))


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    with pytest.raises(ro.InputError, match="a folder, accepted: a unique name for every file"):
        write_all([(tmp_path, lambda path: None)])
    with pytest.raises(ro.InputError, match="two files with this name"):
        write_all([(tmp_path / "a", lambda path: None)] * 2)


def test_validation_says_what_it_knows_and_what_not() -> None:
    bare = str(ro.use.validate(calibrated("lasso"), checks()))
    assert "No uncertainties or prediction intervals: the penalty of formulation 'lasso' is not quadratic" in bare
    assert "orientation" not in bare
    pose = ro.load("pose")
    assert pose.validation is not None
    said = str(ro.use.validate(pose.calibrate(weight=1.0), pose.validation))
    assert "orientation, identified [mrad]" in said
    assert "95 % prediction intervals" in said


def test_everything_may_be_released() -> None:
    """Nothing of the last calibration but its widths is then left."""
    data = simulated(("theta[23]", "d4", "tool_[xyz]", "base_*"), 30, 5e-5, 3)[0].data
    found = ro.use.update(calibrated(), data, reset=["*"])
    anew = ro.calibrate(calibrated().problem.on(data), ro.least_squares)
    assert found.result.x == pytest.approx(anew.x, abs=2e-5)
    halves = [data.take(np.arange(k, k + 15)) for k in (0, 15)]
    p = calibrated().problem
    parts = PartitionedProblem(p.robot, p.parameters, halves[0], tuple(lambda each=each: each for each in halves))
    with pytest.raises(ro.InputError, match="a calibration of data in blocks, accepted: one of measurements in"):
        ro.use.update(ro.calibrate(parts, ro.tikhonov, 1.0), checks())


def test_one_of_several_robots_is_compensated_as_it_alone() -> None:
    """Without a covariance, too: of a lasso nothing is said of intervals."""
    other = simulated(("theta[23]", "d4", "tool_[xyz]", "base_*"), 20, 5e-5, 3)[0]
    both = ro.together(left=calibrated().problem, right=other, shared=())
    q = checks().q
    for formulation in (ro.tikhonov, ro.lasso):
        whole = ro.calibrate(both, formulation, 1.0)
        alone = ro.calibrate(other, formulation, 1.0)
        found = ro.use.compensate(whole, q=q, robot="right")
        assert found.q == pytest.approx(ro.use.compensate(alone, q=q).q, abs=1e-4)


def test_a_table_without_any_known_column_is_named_so(tmp_path: Path) -> None:
    """Not as an empty one: it has a row."""
    path = tmp_path / "other.csv"
    path.write_text("a,b\n1,2\n")
    with pytest.raises(ro.InputError, match=r"header: found no known column \(a, b\)"):
        ro.use.read_measurements(calibrated(), path)


def test_a_lost_reading_among_checks_is_named() -> None:
    data = checks()
    (block,) = data.blocks
    y = block.y.copy()
    y[3] = -9.99
    lost = replace(data, blocks=(replace(block, y=y),))
    for found in (ro.use.validate(calibrated(), lost), ro.use.monitor(calibrated(), lost)):
        assert "has -9990 mm for every measured coordinate: missing measurements?" in found.mistake
    assert ro.use.validate(calibrated(), lost).failure
