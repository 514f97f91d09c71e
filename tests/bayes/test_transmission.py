"""Transmission errors of joints as curves: found where they are, unknown beyond the measured angles, kept by files."""

import csv
import dataclasses

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.bayes.evidence import WAVES, WAVES_LENGTH, Hierarchy
from rpim_opt.bayes.hyperparameters import spectrum_of
from rpim_opt.bayes.transmission import series
from rpim_opt.calibration import verdict, words
from rpim_opt.calibration.uncertainty import transmission_errors
from rpim_opt.report import report
from rpim_opt.report.summary import headline
from rpim_opt.robot import Curve, transmission
from tests.simulate import ARM

ROBOT = dataclasses.replace(
    ARM,
    mdh=ARM.mdh[:3],
    joint_types=("revolute",) * 3,
    joint_map=np.eye(3),
    limits=np.tile([-np.inf, np.inf], (3, 1)),
)
SIZE, CYCLES, NOISE = 4e-4, 16, 2e-5
"""Ripple of joints 2 and 3 [rad], in cycles a turn; noise of a reading [m]."""


def measured(ripple, configurations=120, seed=0, signs=(1, 1, 1)):
    """Return a problem whose arm has that ripple and deviations, and other rows of the same arm."""
    rng = np.random.default_rng(seed)
    arm = dataclasses.replace(ROBOT, joint_map=np.diag(np.array(signs, dtype=float)))
    parameters = ro.robot.model_parameters(arm, tools={"": [0.05, 0.0, 0.3, 0, 0, 0]})
    parameters = parameters.identify(["a?", "theta?", "d?", "alpha?"])
    q = rng.uniform(-1.0, 1.0, (2 * configurations, 3))
    problem = ro.CalibrationProblem(arm, parameters, ro.Dataset.of(q, np.zeros((len(q), 3)), NOISE))
    stands = q + ripple * np.cos(CYCLES * q * signs + [0.0, 0.5, 1.0]) * [0, 1, 1] * signs
    truth = rng.normal(size=len(parameters.free)) * 0.3 * parameters.free.scale
    y = problem.on(ro.Dataset.of(stands, np.zeros((len(q), 3)), NOISE)).modelled(truth)[0]
    data = ro.Dataset.of(q, y + NOISE * rng.normal(size=y.shape), NOISE)
    rows = np.arange(configurations)
    return problem.on(data.take(rows)), data.take(rows + configurations)


@pytest.fixture(scope="module")
def rippled():
    problem, others = measured(SIZE)
    return ro.calibrate(problem, model="auto"), others


def rms(errors):
    """Return the root mean square."""
    return float(np.sqrt(np.mean(errors**2)))


def test_ripple_is_found_and_predicts_other_rows(rippled):
    result, others = rippled
    assert result.learned.extensions[-1] == "transmission error"
    assert result.learned.left_out == ()
    assert (
        0.3 * SIZE < result.learned.curves.size.value < 3 * SIZE
    )  # of a sine whose RMS is 0.58 of that over all joints
    floor = np.sqrt(3) * NOISE
    assert rms(result.errors(others)) < 1.4 * floor < rms(ro.calibrate(result.stated).errors(others)) / 2
    assert 0.90 < ro.use.validate(result, others).coverage <= 0.99
    said = f"Transmission error of joints (1 sigma): {1e3 * result.learned.curves.size.value:.2g} mrad (95 % CI "
    assert said in str(result)
    text = words.parameter_table(result)
    assert "transmission2_c1" not in text
    assert text.count("joint 2") == 1
    assert any(row["parameter"] == "transmission2_c1" for row in result.parameter_rows())
    required = dataclasses.replace(
        result, record=dataclasses.replace(result.record, requirement=ro.data.Requirement(0.01))
    )
    page = report.page(required)
    assert "It holds for the whole model, as <code>compensate</code> uses it" in page
    assert "transmission2_c1" not in page
    assert "Joint 2: 0." in page
    assert "Exported files hold the geometry of a separate fit" in page
    assert "parameter combinations are identifiable from 360 equations, without the transmission errors" in page


@pytest.mark.parametrize(("off", "said"), [("base", "the stated base is wrong"), ("tool", "the stated tool is wrong")])
def test_a_frame_that_is_held_elsewhere_is_named_without_curves(monkeypatch, off, said):
    """Fits of hundreds of coefficients, one for all that is held, took ten times the calibration's time.

    Beside the wrong tool a curve over more than the measured range would stand for it, and is not admitted.
    """
    problem, _ = measured(SIZE)
    p = problem.parameters
    moved = p.nominal + np.isin(p.names, [f"{off}_x", f"{off}_y"]) * 4e-3
    result = ro.calibrate(problem.with_parameters(dataclasses.replace(p, nominal=moved)), model="auto")
    assert (result.learned.curves is not None) == (off == "base")
    counts = []
    fit = verdict.ridge_deviations
    monkeypatch.setattr(
        verdict, "ridge_deviations", lambda alone: counts.append(len(alone.parameters.free)) or fit(alone)
    )
    assert any(said in reason for reason in result.verdict.reasons)
    assert max(counts) < 40


def test_outliers_that_ripple_hides_are_excluded():
    """Of 0.6 mm: not conspicuous among the errors of the geometry, and far beyond the noise of a reading."""
    problem, others = measured(SIZE, configurations=80)
    rows = [20, 70]
    y = problem.data.blocks[0].y.copy()
    y[rows] += [[6e-4, 0, 0], [0, -6e-4, 0]]
    spoiled = problem.on(ro.Dataset.of(problem.data.q, y, NOISE))
    result = ro.calibrate(spoiled, model="auto")
    assert {row.label for row in result.learned.left_out} == {spoiled.labels[row] for row in rows}
    assert rms(result.errors(others)) < 2 * np.sqrt(3) * NOISE
    without = ro.calibrate(spoiled.without({spoiled.labels[row] for row in rows}), model="auto")
    # -2 ln L at both ends, of which each is an optimum to 1e-5 of its slope
    assert result.learned.value == pytest.approx(without.learned.value, abs=1e-2)


def test_beyond_the_measured_angles_the_interval_returns_to_the_prior(rippled):
    result, _ = rippled
    inside, outside = (result.predict([[0.0, angle, 0.0]], of="mean").standard.max() for angle in (0.3, 1.6))
    assert outside > 3 * inside
    curve = next(curve for curve in result.problem.robot.model.curves if curve.joint == 2)
    assert curve.period > 2.5  # 2 rad were measured


def test_a_curve_stays_at_its_ends_beyond_its_period() -> None:
    """Waves go on: multiples of a turn below pi, which is one cycle in a period of 2 rad."""
    curve = Curve(1, 0.3, 2.0, 3)
    assert curve.waves == 3
    assert Curve(1, 0.3, 2 * np.pi, 3).waves == 0
    q = 0.3 + np.array([-5.0, -1.0, -0.9, 0.9, 1.0, 5.0])[:, None]
    columns = series([curve], q, np.ones((6, 1)))
    below, low, inside, within, high, above = columns[:, [3, 4, 5, 9, 10, 11]]
    np.testing.assert_allclose([below, above], [low, high])
    angles = np.pi * 0.9 * np.arange(1, 4)
    np.testing.assert_allclose(within, [*np.cos(angles), *np.sin(angles)])
    np.testing.assert_allclose(inside, [*np.cos(angles), *-np.sin(angles)])
    np.testing.assert_allclose(columns[5, [0, 1, 2, 6]], [*np.cos([5, 10, 15]), np.sin(5)])
    symbolic = transmission(curve).moves
    for at, row in zip(q[:, 0], columns, strict=True):
        joint = ro.robot.Joint(1, ro.robot.Configuration(q=[at]))
        np.testing.assert_allclose([float(symbolic(joint, *unit)) for unit in np.eye(12)], row, atol=1e-12)


@pytest.mark.parametrize("travel", [0.5, 2.0, 7.0])
def test_coefficients_stand_for_ripple_and_waves(travel):
    """By the mean square of differences, which no constant enters; coarse frequencies leave 5 % of it."""
    curve = Curve(1, 0.0, min(travel + 0.6, 2 * np.pi), 200)
    count = 2 * (curve.waves + curve.harmonics)
    free = np.zeros(count, dtype=bool)
    nothing = np.zeros((0, count))
    spectrum = spectrum_of([curve], np.ones(count))
    prior = Hierarchy(np.full(count, -1), free, (), 3.0, free, nothing, np.zeros(0), spectrum)
    variances = prior.variances(np.log([3e-4, 0.05]))[0]
    apart = np.array([0.02, 0.1, 0.3])
    columns = series([curve], np.append(0.0, apart)[:, None], np.ones((4, 1)))
    found = (columns[1:] - columns[0]) ** 2 @ variances
    expected = 0.0
    for size, length in ((3e-4, 0.05), (WAVES, WAVES_LENGTH)):
        r = np.sqrt(3) * apart / length
        expected = expected + 2 * size**2 * (1 - (1 + r) * np.exp(-r))
    np.testing.assert_allclose(found, expected, rtol=0.05)


def test_a_file_holds_the_curves(rippled, tmp_path):
    result, others = rippled
    ro.store.save_result(result, tmp_path / "result.json")
    again = ro.load_result(tmp_path / "result.json")
    assert np.allclose(again.errors(others), result.errors(others), rtol=0, atol=1e-12)
    assert again.learned.curves == result.learned.curves
    assert again.stated.parameters.names == result.stated.parameters.names


def test_corrections_are_a_table(rippled, tmp_path):
    result, _ = rippled
    said = ro.use.export_files(result, corrections=tmp_path / "joints.csv").notes
    _, *lines = csv.reader((tmp_path / "joints.csv").read_text(encoding="utf-8").splitlines())
    table = np.array([line[:4] for line in lines], dtype=float)  # a note stands beside them
    rows = table[(table[:, 0] == 2) & (np.abs(table[:, 1]) < 50)]
    q = np.radians(rows[:, 1])
    curve = transmission_errors(result)[1]
    assert np.allclose(np.interp(q, curve.q, 1e3 * curve.error), rows[:, 2], atol=1e-4)
    assert 0.8 < curve.rms / (SIZE / np.sqrt(2)) < 1.2
    assert 0.3 < curve.effect / curve.rms < 1.0  # [m/rad]: how far the tool is
    wave = 1e3 * SIZE * np.cos(CYCLES * q + 0.5)
    slow = np.polynomial.Polynomial.fit(q, rows[:, 2] - wave, 4)  # geometry may stand for it
    assert rms(rows[:, 2] - wave - slow(q)) < 0.2 * 1e3 * SIZE
    assert said[-1].startswith("Transmission errors (RMS, mrad): joint 1")
    assert "subtract it from a command. The corrections belong to the geometry of the whole model" in said[-1]
    assert said[-1] in lines[0][4]
    assert "with this geometry" not in lines[0][4]
    assert np.abs(table[:, 1]).max() <= np.degrees(1.0)  # no rows beyond the measured angles
    assert "reaches with this geometry (U, 95 %): at most " in " ".join(said)
    assert "Acceptance" not in " ".join(said)
    required = dataclasses.replace(result.record, requirement=ro.data.Requirement(limit=1e-6))
    doubtful = ro.use.export_files(dataclasses.replace(result, record=required), mdh=tmp_path / "arm.csv")
    assert doubtful.inconclusive
    assert "whole model: Inconclusive: limit 0.001 mm" in doubtful.notes[0]
    assert "Missing: " in doubtful.notes[0]
    assert doubtful.notes[0] in list(csv.reader((tmp_path / "arm.csv").read_text().splitlines()))[1][-1]
    assert "separate fit to the same measurements" in (tmp_path / "arm.csv").read_text()
    plain = ro.calibrate(result.stated, weight=1.0)
    _, said, _ = ro.use.export_files(plain, mdh=tmp_path / "arm.csv", corrections=tmp_path / "none.csv")
    assert said[-1] == "none.csv has no rows: the calibration has no transmission errors."
    assert list(csv.reader((tmp_path / "none.csv").read_text().splitlines()))[1:] == []


def test_corrections_count_as_the_controller_does(tmp_path):
    """Joint 2 turns the other way in the table: its curve is that of the encoder's angle all the same."""
    result = ro.calibrate(measured(SIZE, signs=(1, -1, 1))[0], model="auto")
    ro.use.export_files(result, corrections=tmp_path / "joints.csv")
    _, *lines = csv.reader((tmp_path / "joints.csv").read_text(encoding="utf-8").splitlines())
    table = np.array([line[:3] for line in lines if line[0] == "2"], dtype=float)
    q, found = np.radians(table[:, 1]), table[:, 2]
    assert (np.diff(q) > 0).all()
    wave = -1e3 * SIZE * np.cos(-CYCLES * q + 0.5)
    slow = np.polynomial.Polynomial.fit(q, found - wave, 4)  # geometry may stand for it
    assert rms((found - wave - slow(q))[np.abs(q) < 0.9]) < 0.2 * 1e3 * SIZE


def test_commands_are_corrected_for_curves(rippled):
    result, others = rippled
    q = others.q[:5]
    reached = result.forward(q)[:, :3, 3]
    without = ro.calibrate(result.stated).forward(q)[:, :3, 3]
    assert rms(reached - without) > 0.1 * SIZE


def test_an_arm_without_ripple_gets_no_curves():
    problem, _ = measured(0.0, 60, seed=1)
    assert "transmission error" not in ro.calibrate(problem, model="auto").learned.extensions


def test_after_an_update_files_hold_the_geometry_alone(rippled, tmp_path):
    """The prior of the update knows the curves' coefficients, which no file of a robot holds."""
    result, others = rippled
    updated = ro.use.update(result, others).result
    assert len(report.page(updated)) < 1e6  # its prior is a matrix of all coefficients
    before, after = (transmission_errors(each)[0].measured for each in (result, updated))
    assert after[0] <= before[0] < before[1] <= after[1]
    alone, notes = ro.use.geometry_alone(updated)
    assert notes
    assert len(alone.x) == len(result.stated.parameters.free)
    fitted = ro.calibrate(result.stated.on(ro.Dataset.together([result.problem.data, others], ["first", "then"])))
    assert rms(alone.errors(others)) < 1.05 * rms(fitted.errors(others))  # both measurements without curves
    ro.use.export_files(updated, mdh=tmp_path / "robot.toml")
    text = (tmp_path / "robot.toml").read_text()
    assert "alpha_deg" in text
    assert "_rad" not in text


def test_a_worn_gear_is_one_change(rippled):
    """A curve is hundreds of coefficients without individual meaning: each was a change of its own."""
    result = rippled[0]
    worn = measured(3 * SIZE)[1].take(np.arange(60))
    found = ro.use.update(result, worn)
    curves = {f"transmission{joint}" for joint in (1, 2, 3)}
    assert {cause.name for cause in found.causes if cause.kind == "transmission error"} == curves
    assert {cause.name for cause in found.changes} == {"transmission2", "transmission3"}
    assert found.moved == ()
    before, after = (transmission_errors(each) for each in (result, found.result))
    assert all(now.rms > 1.5 * was.rms for was, now in zip(before[1:], after[1:], strict=True))
    assert found.result.record.earlier[-1].changed == "transmission2_* and transmission3_*"
    assert "Not delivered" in headline(found.result)  # curves of three times the size are not explained to the noise
    for text in (str(found), str(ro.use.monitor(result, worn)), *words.weight_lines(found.result)):
        assert "transmission2_c1" not in text


@pytest.mark.parametrize("noise", ["level", "declared"])
def test_curves_stand_beside_any_noise(noise):
    problem, _ = measured(SIZE, configurations=80)
    result = ro.calibrate(problem, noise=noise, model="auto")
    assert "transmission error" in result.learned.extensions


def test_curves_do_not_stand_for_joint_zeros_that_are_not_to_be_identified() -> None:
    """A table of a controller that takes lengths alone; zeros that are wrong vary slowly, if at all."""
    problem, _ = measured(0.0, configurations=60)
    lengths = problem.identifying(np.isin(problem.parameters.names, ["a2", "a3", "d1", "d2", "d3"]))
    zeros = np.where([name.startswith("theta") for name in problem.parameters.free.names], 5e-3, 0.0)
    y = problem.modelled(zeros)[0]
    wrong = lengths.on(ro.Dataset.of(problem.data.q, y, NOISE))
    assert "transmission error" not in ro.calibrate(wrong, model="auto").learned.extensions


@pytest.mark.parametrize("seed", [39, 44])
def test_backlash_that_curves_take_up_is_named(seed: int) -> None:
    """Either of two positions explains the rows better than curves, which hid 1 mm of new rows."""
    rng = np.random.default_rng(seed)
    alpha, theta = np.radians([0, -90, 0, -90, 90, 0]), np.radians([0, -90, 0, 0, 0, 180])
    a, d = [0, 0.35, 1.15, -0.04, 0, 0], [0.78, 0, 0, 1.2, 0, 0.215]
    high = np.radians([150, 65, 60, 170, 110, 170])
    robot = ro.robot.Robot("palletizer", np.column_stack([alpha, a, theta, d, np.zeros(6)]), ("revolute",) * 6)
    identify = ["alpha?", "a?", "theta?", "d?", "base_*", "tool_[xyz]"]
    parameters = ro.robot.model_parameters(robot, (5, 1, 0.2, 0.1, 0, 1), {"": [0.06, -0.03, 0.09, 0, 0, 0]})
    parameters = parameters.identify(identify).scaled({"base_mm": 10, "base_mrad": 10, "tool_mm": 10})
    q = rng.uniform(-high, high, (50, 6)) + np.radians([0, 5, 0, 0, 0, 0])
    problem = ro.CalibrationProblem(robot, parameters, ro.Dataset.of(q, np.zeros((50, 3)), 5e-5))
    x = 0.5 * rng.normal(size=len(parameters.free)) * parameters.free.scale
    sides = np.outer(5e-4 * rng.choice([-1, 1], 50), [1, 0, 0, 0, 0, 0])
    y = problem.on(ro.Dataset.of(q + sides, np.zeros((50, 3)), 5e-5)).modelled(x)[0]
    y += 5e-5 * rng.normal(size=y.shape)
    result = ro.calibrate(problem.on(ro.Dataset.of(q, y, 5e-5)), model="auto")
    assert result.learned is not None
    assert result.learned.curves is not None
    assert not result.verdict.delivered
    assert "backlash, joint 1 by 1 mrad" in str(result.verdict)
