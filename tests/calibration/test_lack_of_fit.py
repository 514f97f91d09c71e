"""The paragraph on what is left: right about simulated arms, and silent about clean ones."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from html import unescape

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration.acceptance import Requirement
from rpim_opt.calibration.lack_of_fit import FEWEST, LackOfFit, autocorrelation, judged, lack_of_fit
from rpim_opt.report.report import page
from tests.simulate import ALL, ARM, simulated

NOISE = 5e-5
ROOT3 = np.sqrt(3)


LISTED = (*ALL, "compliance[23]")


def arm(seed, n=25, compliance=0.0, repeatability=0.0, joints=0.0, repeats=1, identify=ALL, mounting=-1.0):
    """Return a problem of an arm with errors of table size, gravity in joints 2 and 3, and repeatability [m, rad]."""
    rng = np.random.default_rng([seed, 1])
    problem, truth = simulated(ALL, n, seed=seed, sigma=NOISE)
    q = np.repeat(problem.data.q, repeats, axis=0)
    robot = replace(ARM, gravity=ro.robot.Gravity(direction=(0.0, 0.0, mounting)))
    told = q + joints * rng.normal(size=q.shape)
    told[:, 1:3] += compliance * ro.robot.gravity_torques(robot, q)[:, 1:3]
    exact = problem.on(ro.Dataset.of(told, np.zeros((len(q), 3)), NOISE))
    y = exact.modelled(truth)[0] + np.hypot(NOISE, repeatability) * rng.normal(size=(len(q), 3))
    problem = problem.on(ro.Dataset.of(q, y, NOISE))
    return problem.with_parameters(problem.parameters.identify(identify))


@cache
def learned(seed, **how):
    """Return the calibration of such an arm with learned sizes."""
    return ro.calibrate(arm(seed, **how))


BENT = 5e-6
"""A compliance [rad/Nm] that bends the arm by about 0.3 mm."""


def test_clean_arm_is_left_alone_and_its_noise_named():
    found = lack_of_fit(learned(0))
    assert not found.alarming
    assert found.missing == found.upward == found.parameters == ()
    assert found.instrument == pytest.approx(ROOT3 * NOISE, rel=1e-9)
    assert found.robot < 0.6 * found.instrument
    assert found.share == found.gain == found.repeatable == 0.0
    assert "would explain" not in str(found)
    fine = LackOfFit(60, 180, 150.0, "length", residual=1e-4, instrument=1e-4, position=2e-5)
    assert "only a more accurate one" in str(fine)
    assert "only a more accurate one" not in str(replace(fine, position=4e-5))
    assert "mm, repeatability 0.04 mm" in str(replace(fine, position=4e-5))
    assert "mm, repeatability" not in str(replace(fine, position=4e-6))


@pytest.mark.parametrize("weight", [None, "reml", 1.0])
def test_gravity_is_found_whatever_the_weight(weight):
    found = lack_of_fit(ro.calibrate(arm(1, compliance=BENT), weight=weight))
    assert "gravity" in found.missing
    assert found.parameters[0] == "compliance?"
    assert found.alarming
    assert 0.5 < found.share < 1.0
    assert found.gain > 10 * len(found.missing)
    assert not found.upward
    text = str(found)
    assert f"explain {found.share:.0%} of the mean square residual" in text
    assert "add compliance?" in text
    # what it would explain is no longer the robot's repeatability
    assert found.repeatable > 2 * found.robot


def test_division_adds_up_to_what_the_model_without_the_extension_leaves():
    found = lack_of_fit(learned(1, compliance=BENT))
    total = found.instrument**2 + found.robot**2 + found.repeatable**2
    assert found.repeatable**2 / total == pytest.approx(found.share, rel=1e-9)
    # of 75 equations 2 in 5 serve the parameters
    assert found.residual * np.sqrt(found.equations / found.residual_dof) == pytest.approx(np.sqrt(total), rel=0.2)


def test_model_that_has_gravity_says_so():
    found = lack_of_fit(ro.calibrate(arm(2, n=40, compliance=BENT), model="auto"))
    assert found.missing == ()
    assert found.present["gravity"] > 10
    assert f"The arm deflects under gravity (likelihood-ratio statistic {found.present['gravity']:.0f})." in str(found)
    listed = arm(2, n=40, compliance=BENT, identify=LISTED)
    stated = lack_of_fit(ro.calibrate(listed, ro.tikhonov, ro.reml))
    assert stated.present["gravity"] > 10


def test_extension_that_is_listed_in_vain_is_not_praised():
    found = lack_of_fit(ro.calibrate(arm(3, identify=LISTED), ro.tikhonov, ro.reml))
    assert found.present == {}
    assert not found.alarming


def test_wrong_mounting_bends_upwards():
    hanging = arm(4, compliance=BENT, mounting=1.0)
    found = lack_of_fit(ro.calibrate(hanging))
    assert "2" in found.upward
    assert "negative, which gravity cannot cause" in str(found)
    assert not lack_of_fit(learned(4, compliance=BENT)).upward


@pytest.mark.parametrize(("mounting", "delivered"), [(-1.0, True), (1.0, False)])
def test_an_arm_that_bends_against_gravity_is_not_delivered_where_residuals_are_beyond_the_noise(mounting, delivered):
    noisy = arm(4, n=40, compliance=5 * BENT, repeatability=5 * NOISE, mounting=mounting)
    result = ro.calibrate(noisy, model="auto")
    assert result.verdict.delivered == delivered
    assert any("which gravity cannot cause: check `mounting`" in text for text in result.causes) != delivered


def test_repeatability_is_no_lack_and_is_told_by_its_size():
    found = lack_of_fit(learned(5, n=60, repeatability=2e-4))
    assert not found.alarming
    assert found.robot == pytest.approx(ROOT3 * 2e-4, rel=0.2)
    assert "Repeat five configurations" in str(found)


def test_repeatability_of_joints_is_told_from_that_in_position():
    found = lack_of_fit(learned(6, n=150, joints=3e-4))
    assert not found.alarming
    assert found.joint > 2 * found.position


def test_repeated_readings_tell_repeatability_from_what_comes_again():
    noisy = lack_of_fit(learned(7, n=30, repeats=2, repeatability=2e-4))
    assert noisy.repeated == pytest.approx(ROOT3 * np.hypot(2e-4, NOISE), rel=0.2)
    assert noisy.excess == 0.0
    assert "limits the result, by its repeatability, backlash or drift" in str(noisy)
    bent = lack_of_fit(learned(7, n=30, repeats=2, compliance=BENT))
    assert bent.repeated == pytest.approx(ROOT3 * NOISE, rel=0.2)
    assert bent.excess > bent.repeated
    assert "is systematic (repeatable)" in str(bent)


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"repeatability": 2e-4}, "the robot's repeatability alone contributes at least"),
        ({"compliance": BENT}, r"an effect that it lacks contributes at least .* Gravity would explain"),
    ],
)
def test_repeatability_rejects_a_robot_where_repeated_readings_show_it(how: dict[str, float], said: str) -> None:
    found = ro.calibration.accept(learned(7, n=30, repeats=2, **how), Requirement(1e-4))
    assert re.search(said, found.reasons[0]), found.reasons


def test_too_few_equations_are_not_judged():
    found = lack_of_fit(learned(8, n=9, compliance=BENT))
    assert found.residual_dof < FEWEST
    assert not found.alarming
    assert "too few to separate" in str(found)


def test_noise_declared_far_too_large_is_said():
    problem = arm(9, n=40)
    loud = problem.on(ro.Dataset.of(problem.data.q, problem.data.blocks[0].y, 10 * NOISE))
    found = lack_of_fit(ro.calibrate(loud))
    assert not found.alarming
    assert "Repeat one reading ten times" in str(found)


def test_gross_errors_are_no_repeatability():
    rough = LackOfFit(60, 180, 150.0, "length", residual=0.07, instrument=1e-4, position=0.07)
    assert "units, signs, frames" in str(rough)
    assert "Repeat five" not in str(rough)
    assert "Repeat five" in str(replace(rough, position=0.02))


def test_blunders_are_not_taken_for_physics():
    problem = arm(10, n=40)
    y = problem.data.blocks[0].y.copy()
    y[[3, 17]] += 0.004
    found = lack_of_fit(ro.calibrate(problem.on(ro.Dataset.of(problem.data.q, y, NOISE)), ro.robust, ro.reml))
    assert not found.alarming
    assert found.residual < 2 * ROOT3 * NOISE


def test_paragraph_of_a_file_is_that_of_the_result(tmp_path):
    result = learned(1, compliance=BENT)
    ro.store.save_result(result, tmp_path / "result.json")
    assert lack_of_fit(ro.load_result(tmp_path / "result.json")).sentences() == lack_of_fit(result).sentences()


def test_quick_look_agrees_with_the_calibration():
    problem = arm(1, compliance=BENT)
    found = ro.calibration.inspect(problem)
    quick = found.lack_of_fit
    assert quick is not None
    assert not found.outliers
    full = lack_of_fit(ro.calibrate(problem))
    assert quick.missing == full.missing
    assert quick.share == pytest.approx(full.share, abs=0.02)
    named = replace(problem, robots=replace(problem.robot, joint_names=tuple("ABCDEF")))
    few = str(ro.calibration.inspect(named.on(problem.data.take([0, 1]))))
    assert "too few to separate" in few
    assert "q2 (B)" in few


def test_the_quick_look_leaves_out_what_the_calibration_leaves_out():
    problem = arm(1)
    y = problem.data.blocks[0].y.copy()
    y[5, 2] += 0.008
    spoiled = problem.on(ro.Dataset.of(problem.data.q, y, NOISE))
    found = ro.calibration.inspect(spoiled)
    quick, outliers = found.lack_of_fit, found.outliers
    assert [row.label for row in outliers] == [spoiled.labels[5]]
    assert outliers[0].error == pytest.approx(0.008, rel=0.1)
    assert quick is not None
    assert quick.residual < 2 * ROOT3 * NOISE


def test_what_did_not_converge_is_not_judged():
    assert judged(ro.calibrate(arm(0), ro.tikhonov, 1.0, max_iterations=1)) is None


def test_document_has_what_the_sentences_say():
    found = lack_of_fit(learned(1, compliance=BENT))
    document = found.content()
    assert document["text"] == found.sentences()
    assert document["residual_mm"] == pytest.approx(1e3 * found.residual)
    assert document["identify"] == list(found.parameters)
    assert document["alarming"] is True


def test_angles_alone_are_told_in_mrad():
    found = LackOfFit(20, 60, 30.0, "angle", residual=1e-4, instrument=1e-4)
    assert "0.1 mrad" in str(found)
    assert "residual_mrad" in found.content()


def test_neighbours_that_share_an_effect_are_alike_and_others_are_not():
    rng = np.random.default_rng(0)
    q = rng.uniform(-1, 1, (200, 2))
    kinds = np.zeros(200, dtype=int)
    smooth = np.sin(3 * q) + 0.3 * rng.normal(size=(200, 2))
    found = autocorrelation(q, smooth, kinds)
    assert found is not None
    assert found.z > 6
    assert found.correlation > 0.5
    # dealing out the errors leaves z standard: neighbours that are mutual do not inflate it
    z = [autocorrelation(q, rng.normal(size=(200, 2)), kinds).z for _ in range(100)]
    assert np.std(z) == pytest.approx(1.0, abs=0.25)
    assert abs(np.mean(z)) < 0.4
    assert autocorrelation(q[:5], smooth[:5], kinds[:5]) is None
    assert autocorrelation(q, 0 * smooth, kinds) is None


def test_neighbours_are_sought_among_the_same_kind_only():
    rng = np.random.default_rng(1)
    q = np.repeat(rng.uniform(-1, 1, (50, 2)), 2, axis=0) + 1e-3 * rng.normal(size=(100, 2))
    errors = np.repeat(rng.normal(size=(50, 3)), 2, axis=0)
    together = autocorrelation(q, errors, np.zeros(100, dtype=int))
    apart = autocorrelation(q, errors, np.tile([0, 1], 50))
    assert together.correlation == pytest.approx(1.0, abs=0.1)
    assert abs(apart.z) < 4


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(("compliance", "said"), [(BENT, True), (0.0, False)])
def test_an_update_names_an_effect_that_few_rows_did_not_support(compliance, said):
    """It keeps their model: gravity stayed in 40 configurations that 12 had not shown, and nothing said so."""
    problem = arm(1, 52, compliance)
    few, more = (problem.data.take(np.arange(*rows)) for rows in ((12,), (12, 52)))
    first = ro.calibrate(problem.on(few), model="auto")
    assert first.learned.extensions == ()
    found = ro.use.update(first, more)
    sentence = "An update keeps the model: calibrate all tables together (`rpim-opt new FOLDER --data OLD --data NEW"
    assert (sentence in str(found)) == (sentence in found.content()["lacking"]) == said
    assert ("gravity" in lack_of_fit(found.result).missing) == said


def test_the_report_says_it():
    result = learned(1, compliance=BENT)
    text = re.sub("</?code>", "`", unescape(page(result)))
    for sentence in lack_of_fit(result).sentences():
        assert sentence in text


def test_no_alarm_of_clean_arms_and_one_of_each_that_bends():
    clean = [arm(100, n=15), arm(101, joints=1e-4), arm(102, repeatability=1e-4), arm(103, n=45)]
    assert not any(lack_of_fit(ro.calibrate(problem, ro.tikhonov, ro.reml)).alarming for problem in clean)
    bent = [arm(200 + seed, compliance=BENT / 2) for seed in range(3)]
    assert all(lack_of_fit(ro.calibrate(problem, ro.tikhonov, ro.reml)).missing for problem in bent)


@pytest.mark.slow
def test_no_cry_of_wolf_and_no_gravity_overlooked():
    alarms = 0
    for seed in range(150):
        kind = seed % 3
        clean = arm(1000 + seed, repeatability=1e-4 * (kind == 1), joints=1e-4 * (kind == 2))
        alarms += lack_of_fit(ro.calibrate(clean)).alarming
    assert alarms <= 1
    seen = sum(bool(lack_of_fit(learned(2000 + seed, compliance=BENT / 2)).missing) for seed in range(30))
    assert seen >= 27
