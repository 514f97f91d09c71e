"""Whether a robot is delivered is decided once, and everything that is done with it follows."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration.verdict import worse_than_nominal
from rpim_opt.store import load_result, save_result
from rpim_opt.store.result_file import digest
from tests.calibration.mistakes import IN_TABLES, coupled, joints, simulated_arm, values
from tests.simulate import simulated
from tests.test_cli import run


def halved(problem: ro.CalibrationProblem) -> ro.CalibrationProblem:
    """Lose one reading halfway: every later value is that of the row before."""

    def change(y: np.ndarray) -> np.ndarray:
        y[20:] = y[19:-1]
        return y

    return values(change)(problem)


WRONG = {
    "one reading lost halfway": halved,
    "coupled to half of joint 2": coupled(2, 1, -0.5),
    "gon read as degrees": joints(lambda q: q / 0.9),
    "a frozen joint": joints(lambda q: np.where(np.arange(6) == 4, 0.3, q)),
    "z of another column": values(lambda y: np.where(np.arange(3) == 2, 0.02, y)),
    "joints 2 and 3 exchanged": IN_TABLES["joints 2 and 3 exchanged"][0],
}


@pytest.mark.slow
@pytest.mark.parametrize("mistake", WRONG)
def test_a_wrong_robot_is_not_delivered(mistake: str) -> None:
    verdict = ro.calibrate(WRONG[mistake](simulated_arm("ur5e"))).verdict
    assert not verdict.delivered
    with pytest.raises(ro.InputError, match="not delivered"):
        verdict.require()
    assert verdict.reasons[0] in verdict.require(forced=True)


def test_a_good_one_is_delivered_with_outliers_and_few_rows() -> None:
    problem = simulated_arm("irb120", seed=5)
    far = values(lambda y: y + 0.03 * (np.arange(len(y)) % 9 == 1)[:, None])(problem)
    for each in (problem, problem.on(problem.data.take(range(10))), far):
        assert ro.calibrate(each).verdict == ro.calibration.Verdict()


def test_held_out_rows_that_no_robot_misses_so_far_are_a_reason() -> None:
    """A tracker that moved before the second table: nominal and identified robot miss its rows alike."""
    instance = ro.load("position")
    block = instance.validation.blocks[0]
    moved = replace(instance.validation, blocks=(replace(block, y=block.y + np.array([0.0, 0.05, 0.0])),))
    result = instance.calibrate()
    verdict = replace(result, record=replace(result.record, validation=moved)).verdict
    assert len(verdict.reasons) == 1
    assert "held-out rows" in verdict.reasons[0]
    assert "--register" in verdict.reasons[0]


def test_errors_that_few_rows_leave_are_no_reason() -> None:
    """Five rows of an arm with deviations of 5 mm: errors of 6 mm, a third of nominal ones, are within intervals."""
    problem, _ = simulated(configurations=45, noise=5e-5, seed=4, size=5)
    few, other = (problem.data.take(rows) for rows in (np.arange(5), np.arange(5, 45)))
    result = ro.calibrate(problem.on(few))
    assert np.median(result.errors(other)) > 5e-3
    assert replace(result, record=replace(result.record, validation=other)).verdict.delivered


def test_few_lengths_do_not_tell_that_the_noise_is_overstated() -> None:
    """Anchor, offset and reflector take up seven of eight equations."""
    problem, _ = simulated(configurations=48, seed=5, size=0.3)
    away = np.linalg.norm(problem.data.blocks[0].y - [0.4, 0.9, 1.1], axis=1, keepdims=True) + 0.05
    away += 5e-4 * np.random.default_rng(5).normal(size=away.shape)
    data = ro.Dataset.of(problem.data.q, away, 5e-4, measurement="cable")
    few, other = data.take(np.arange(8)), data.take(np.arange(8, 48))
    result = ro.calibrate(ro.problem_from(problem.robot, data).on(few))
    assert replace(result, record=replace(result.record, validation=other)).verdict.delivered


def test_joint_zeros_are_not_limited() -> None:
    """An arm whose zeros are 45 mrad off is as good as another."""
    problem = simulated_arm("irb120")
    off = joints(lambda q: q + np.array([0.0, 0.045, -0.03, 0.04, 0.0, 0.0]))(problem)
    assert ro.calibrate(off).verdict.delivered


def test_a_stated_tool_that_is_wrong_looks_like_the_last_link() -> None:
    """The fit is as good as with the right one: the condition is named wherever the robot is used."""
    problem = ro.load("position").problem
    p = problem.parameters
    tool_z = np.array(p.names) == "tool_z"
    stated = replace(p, nominal=p.nominal + 0.01 * tool_z, identified=p.identified & ~tool_z)
    verdict = ro.calibrate(problem.with_parameters(stated)).verdict
    assert verdict.delivered
    assert verdict.caution.startswith("d6 deviates by -9.0")
    assert "an error of the stated tool_z: check the stated value." in verdict.require()
    assert not ro.calibrate(problem.with_parameters(replace(stated, identified=p.identified))).verdict.caution


def test_a_stated_base_that_is_too_high_looks_like_the_first_link() -> None:
    problem = ro.load("position").problem
    p = problem.parameters
    names = np.array(p.names)
    high = replace(
        p, nominal=p.nominal + 0.01 * (names == "base_z"), identified=p.identified & ~np.char.startswith(names, "base_")
    )
    assert ro.calibrate(problem.with_parameters(high)).verdict.caution.startswith("d1 deviates by -10.4 mm, which the")


def test_a_stated_tool_beside_the_last_axis_looks_like_its_joint_zero() -> None:
    """The last joint turns the right tool to the stated x, and y, which is free, follows."""
    problem = ro.load("position").problem
    p = problem.parameters
    narrow = replace(p, nominal=p.nominal - 2e-3 * (np.array(p.names) == "tool_x"))
    known = ro.bayes.Prior.known("tool_x = 18 +- 0.02 mm")
    verdict = ro.calibrate(problem.with_parameters(narrow), prior=known).verdict
    assert verdict.delivered
    assert verdict.caution.startswith("theta6 deviates by 159 mrad")
    assert "an error of the stated tool_x: check the stated value." in verdict.caution


@pytest.mark.parametrize("error", [0.01, 0.005, -0.03])
def test_an_instrument_of_another_scale_looks_like_a_longer_robot(error: float) -> None:
    """Positions in millimetres that are too long, in a frame of the instrument: no machined robot has that."""
    problem = ro.load("position").problem
    (block,) = problem.data.blocks
    scaled = problem.on(replace(problem.data, blocks=(replace(block, y=(1 + error) * block.y),)))
    verdict = ro.calibrate(scaled).verdict
    said = re.search(r"Lengths of the robot deviate by ([-+.\d]+) % in common, as with an instrument", str(verdict))
    assert said
    assert float(said[1]) == pytest.approx(100 * error, abs=0.25)  # of 1 mm each, 0.24 % of the lengths in common
    assert not verdict.delivered
    assert not ro.calibrate(problem).verdict.caution


@pytest.mark.parametrize("name", ["seven_axis", "position"])
def test_a_scale_is_estimated_by_the_lengths_that_data_determine(name: str) -> None:
    """Lengths that the prior alone determines are near their nominal values, which was evidence against a scale."""
    problem = ro.load(name).problem
    (block,) = problem.data.blocks
    exact = problem.modelled(np.zeros(len(problem.parameters.free)))[0]
    noise = 5e-5 * np.random.default_rng(0).normal(size=exact.shape)
    scaled = problem.on(replace(problem.data, blocks=(replace(block, y=1.008 * exact + noise),)))
    said = re.search(r"Lengths of the robot deviate by \+([.\d]+) % in common", str(ro.calibrate(scaled).verdict))
    assert said
    assert float(said[1]) == pytest.approx(0.8, rel=0.03)


def test_lengths_that_shrink_to_half_are_no_scale() -> None:
    """Those of rows that are not related do."""
    problem = ro.load("position").problem
    (block,) = problem.data.blocks
    shifted = problem.on(replace(problem.data, blocks=(replace(block, y=np.roll(block.y, 5, axis=0)),)))
    verdict = ro.calibrate(shifted, ro.tikhonov, weight=1.0).verdict
    assert not verdict.delivered
    assert not verdict.caution


def test_beside_a_known_value_that_is_wrong_a_right_one_is_not_named() -> None:
    """With the wrong one the last joint would turn; estimated scales are no weight that was too large."""
    problem = ro.load("position").problem
    known = ro.bayes.Prior.known("tool_x = 15 +- 0.02 mm") & ro.bayes.Prior.known("tool_y = -3.7 +- 0.02 mm")
    *before, x = ro.calibrate(problem, prior=known).verdict.reasons
    assert x.startswith("The data contradict prior 'tool_x = 15 +- 0.02 mm', by +3.83 mm (chi-squared ")
    assert "weight" not in " ".join(before)
    assert "contradict" not in " ".join(before)


@pytest.mark.parametrize(("shift", "named"), [(0.0, ()), (0.4, ("A", "B", "C"))])
def test_known_values_that_are_unlikely_together_are_named(shift: float, named: tuple[str, ...]) -> None:
    """As by a flange whose axis is elsewhere: by 0.4 mm not one value that is known to 0.1 mm stands out."""
    problem = simulated_arm("ur5e", count=25, markers=3)
    found = ro.calibrate(problem)
    values = found.problem.parameters.by_name(found.x)
    known = ro.bayes.Prior()
    for name in (f"tool_{marker}_{axis}" for marker in "ABC" for axis in "xyz"):
        known &= ro.bayes.Prior.known(f"{name} = {1e3 * values[name] + shift * name.endswith('y'):.3f} +- 0.1 mm")
    reasons = ro.calibrate(problem, prior=known).verdict.reasons
    assert len(reasons) == bool(named)
    for text in reasons:
        assert text.startswith("The data contradict prior ")
        assert re.findall(r"tool_(.)_(.)", text) == [(marker, "y") for marker in named]
        assert "degrees of freedom 3). Correct the known values" in text


def test_what_free_frames_explain_is_no_error_of_stated_ones() -> None:
    problem = ro.load("position").problem
    names = np.array(problem.parameters.names)
    result = ro.calibrate(problem.identifying(problem.parameters.identified & (names != "tool_z")))
    free = result.problem.parameters.free.names
    higher = result.x + 6e-3 * (np.array(free) == "d1") - 6e-3 * (np.array(free) == "base_z")
    assert not replace(result, x=higher).verdict.caution


def test_computed_positions_are_no_measurements() -> None:
    problem = simulated_arm("ur5e")
    y = problem.modelled(np.zeros(len(problem.parameters.free)))[0]
    (reason,) = ro.calibrate(values(lambda _: y)(problem)).verdict.reasons
    assert "computed" in reason


def test_a_fit_that_interpolates_needs_rows_that_check_it() -> None:
    problem = ro.load("position").problem
    three = problem.identifying(np.isin(problem.parameters.names, ("a2", "d4", "tool_z")))
    one = three.on(problem.data.take(np.array([0])))
    result = ro.calibrate(one, ro.least_squares)
    assert any(
        "interpolates the data: 3 equations leave no residual degrees of freedom" in reason
        for reason in result.verdict.reasons
    )
    checked = replace(result, record=replace(result.record, validation=problem.data.take(np.arange(1, 21))))
    assert not any("interpolates" in reason for reason in checked.verdict.reasons)


def test_a_robot_worse_than_the_nominal_one_is_not_delivered() -> None:
    """Beyond chance: where both err by noise alone, either may be ahead."""
    instance = ro.load("position")
    result = instance.calibrate()
    assert result.verdict.delivered
    off = replace(result, x=result.x + 20 * instance.problem.parameters.free.scale)
    assert any("larger than those of the nominal robot" in text for text in off.verdict.reasons)


@pytest.mark.parametrize("rows", [3, 5, 8, 11, 12, 20])
def test_few_rows_tell_a_worse_robot_from_chance(rows: int) -> None:
    """Errors that are the nominal robot's but for a tenth are not larger; four times larger ones are."""
    rng = np.random.default_rng(3)
    nominal = rng.normal(size=(400, rows, 3))
    near = np.linalg.norm(nominal + 0.1 * rng.normal(size=nominal.shape), axis=2)
    far = 4 * np.linalg.norm(rng.normal(size=nominal.shape), axis=2)
    nominal = np.linalg.norm(nominal, axis=2)
    assert sum(bool(worse_than_nominal(a, b)) for a, b in zip(nominal, near, strict=True)) <= 6
    assert sum(bool(worse_than_nominal(a, b)) for a, b in zip(nominal, far, strict=True)) >= 350


def test_a_robot_twice_as_wrong_as_the_nominal_one_is_worse_whatever_few_errors_are() -> None:
    """Errors of ten lengths' calibration, half of them within 0.7 mm and two of 6 and 7 mm, against 0.9 mm RMS."""
    error = np.array([*np.linspace(0.02, 0.7, 17), *np.linspace(1.1, 2.5, 12), 3.8, 5.9, 7.0])
    nominal = np.array([*np.linspace(0.01, 0.4, 18), *np.linspace(0.4, 2.0, 12), 2.1, 2.6])[::-1]
    assert worse_than_nominal(nominal, error)
    assert not worse_than_nominal(error, 0.9 * error)


def test_files_hold_the_verdict(tmp_path: Path) -> None:
    result = ro.calibrate(simulated_arm("ur5e"), "tikhonov", 1.0, max_iterations=1)
    result = replace(result, known={"causes": ("Likely: joints 2 and 3 exchanged.",)})
    save_result(result, tmp_path / "result.json")
    again = load_result(tmp_path)
    assert again.verdict == result.verdict
    assert again.causes == result.causes
    stored = json.loads((tmp_path / "result.json").read_text())
    assert stored["verdict"] == {"delivered": False, "reasons": list(result.verdict.reasons), "caution": None}
    stored["verdict"] = {"delivered": True, "reasons": []}
    (tmp_path / "result.json").write_text(json.dumps({**stored, "digest": digest(stored)}))
    assert load_result(tmp_path).verdict == result.verdict  # which is judged anew


def test_python_follows_it(tmp_path: Path) -> None:
    result = ro.calibrate(simulated_arm("ur5e"), "tikhonov", 1.0)
    result = replace(result, known={"causes": ("Likely: joints 2 and 3 exchanged.",)})
    with pytest.raises(ro.basics.NotDelivered, match="joints 2 and 3 exchanged"):
        ro.use.compensate(result, np.zeros((1, 6)))
    forced = ro.use.compensate(result, np.zeros((1, 6)), orientation=False, despite_verdict=True)
    assert "despite the verdict" in forced.note
    assert forced.note in forced.csv()
    with pytest.raises(ro.basics.NotDelivered):
        ro.use.export_files(result, tmp_path / "out.urdf", urdf="arm.urdf")
    with pytest.raises(ro.basics.NotDelivered):
        ro.use.export_files(result, mdh=tmp_path / "out.csv")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("limit", "word"), [(2e-4, "Accepted: "), (5e-5, "Inconclusive: "), (None, "Rejected: ")])
def test_export_follows_the_acceptance_test(monkeypatch, capsys, tmp_path: Path, limit, word: str) -> None:
    if limit is None:  # the robot's own repeatability is above the limit
        limit, result = 2e-4, ro.calibrate(simulated(noise=5e-4)[0])
    else:
        result = ro.load("position").calibrate()
    record = replace(result.record, requirement=ro.data.Requirement(limit))
    save_result(replace(result, record=record), tmp_path / "result.json")
    target = tmp_path / "arm.csv"
    arguments = ("export", str(tmp_path), "--mdh", str(target))
    assert run(monkeypatch, *arguments) == {"A": 0, "I": 4, "R": 1}[word[0]]
    said = capsys.readouterr()
    assert word in said.out + said.err
    assert target.exists() == (word[0] != "R")
    if word[0] == "R":
        assert run(monkeypatch, *arguments, "--despite-verdict") == 0
    assert (word in target.read_text()) == (word[0] != "A")


@pytest.mark.usefixtures("undrawn")
def test_commands_follow_it(monkeypatch, capsys, tmp_path: Path) -> None:
    result = ro.calibrate(simulated_arm("ur5e"), "tikhonov", 1.0)
    result = replace(result, known={"causes": ("Likely: joints 2 and 3 exchanged.",)})
    folder = str(tmp_path)
    save_result(result, tmp_path / "result.json")
    (tmp_path / "targets.csv").write_text("q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n10,-80,60,20,30,0\n")
    forms = {"mdh": "csv", "robodk": "csv"}
    for key, ending in forms.items():
        target = tmp_path / f"{key}.{ending}"
        assert run(monkeypatch, "export", folder, f"--{key}", str(target)) == 1
        assert not target.exists()
        assert "not delivered" in capsys.readouterr().err
        assert run(monkeypatch, "export", folder, f"--{key}", str(target), "--despite-verdict") == 0
        assert "despite the verdict" in target.read_text()
    for ending in ("toml", "json", "csv"):
        target = tmp_path / f"arm.{ending}"
        assert run(monkeypatch, "export", folder, "--mdh", str(target), "--despite-verdict") == 0
        assert "despite the verdict" in target.read_text()
        np.testing.assert_allclose(ro.read_robot(target).mdh, result.robot.mdh, rtol=0, atol=1e-9)  # digits of a file
    compensate = ["compensate", folder, str(tmp_path / "targets.csv"), "--position-only"]
    assert run(monkeypatch, *compensate) == 1
    assert run(monkeypatch, *compensate, "--despite-verdict") == 0
    assert "despite the verdict" in capsys.readouterr().out
    assert run(monkeypatch, "accept", folder, "--limit", "500") == 1
    data = result.problem.data
    columns = [*(f"q{i}_rad" for i in range(1, 7)), "x_m", "y_m", "z_m"]
    measured = np.hstack([data.q, data.blocks[0].y])
    np.savetxt(tmp_path / "rows.csv", measured, delimiter=",", header=",".join(columns), comments="")
    assert run(monkeypatch, "validate", folder, str(tmp_path / "rows.csv")) == 1  # the rows fit
    assert "is not delivered" in capsys.readouterr().out
    assert run(monkeypatch, "report", folder) == 0
    assert "do not use this robot" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_a_weight_that_makes_a_robot_worse_than_nominal_is_no_delivery() -> None:
    """The penalty holds reflector and base, too, which the nominal robot has fitted."""
    problem = ro.load("position").problem
    nominal = problem.parameters.nominal.copy()
    nominal[-1] += 0.02  # the reflector's start, 20 mm off
    off = problem.with_parameters(replace(problem.parameters, nominal=nominal))
    result = ro.calibrate(off, ro.tikhonov, weight=1e9)
    assert any("larger than those of the nominal robot" in reason for reason in result.verdict.reasons)


@pytest.mark.parametrize("seed", [3, 11])
def test_positions_noisier_than_stated_are_no_drift(seed: int) -> None:
    """Of poses only the positions are: they alone are what a sum of squares has for equations."""
    problem = ro.load("pose").problem
    rng = np.random.default_rng(seed)
    few = problem.on(problem.data.take(np.sort(rng.permutation(len(problem.data))[:20])))
    noisy = values(lambda y: y + np.pad(rng.normal(0.0, 5e-4, (20, 3)), [(0, 0), (0, 4)]))(few)
    assert ro.calibrate(noisy).verdict.delivered


def test_a_noise_in_another_unit_is_not_delivered() -> None:
    """Unless nobody stated it: `new` assumes an orientation's noise, which some instruments are far below."""
    problem = ro.load("pose").problem
    (block,) = problem.data.blocks
    size = np.repeat([1.0, 1e3], 3)
    wrong = replace(block, covariance=block.covariance * np.outer(size, size))
    result = ro.calibrate(problem.on(replace(problem.data, blocks=(wrong,))))
    assert not result.verdict.delivered
    assert "in another unit" in str(result.verdict)
    assert replace(result, record=replace(result.record, noise_assumed=True)).verdict.delivered


def test_a_loss_with_own_variables_is_judged_where_rows_are_flagged() -> None:
    slack = cp.Variable(nonneg=True)
    priced = ro.Formulation("priced", lambda v: cp.sum_squares(v) + 500 * slack, cp.sum_squares)
    result = ro.calibrate(ro.load("blunders").problem, priced, 1.0)
    assert result.flagged
    assert "Outliers: " in str(result)


def test_a_formulation_that_forbids_what_is_true_limits_the_fit() -> None:
    problem = ro.load("position").problem
    fixed = ro.Formulation("fixed", penalty=cp.sum_squares, constraints=(ro.constraints.at_nominal("a?", "d?"),))
    heavy = ro.Formulation("heavy", lambda v: cp.sum(cp.huber(v, 1.5)), cp.norm1)
    for formulation, weight, remedy in ((fixed, None, "at_nominal('a?', 'd?')"), (heavy, 1e3, "Use a smaller weight")):
        (reason,) = ro.calibrate(problem, formulation, weight).verdict.reasons
        assert "the formulation, not the robot, limits the fit" in reason
        assert remedy in reason
    wide = ro.calibrate(problem, "minimax")  # twice the noise: delivered, with the cause
    assert wide.verdict.delivered
    assert "limits the fit" in wide.causes[0]
    (block,) = problem.data.blocks
    exchanged = replace(block, q=block.q[:, :, [0, 2, 1, 3, 4, 5]])
    wrong = ro.calibrate(problem.on(replace(problem.data, blocks=(exchanged,))), fixed, 1.0)
    assert "joints 2 and 3 exchanged" in str(wrong.verdict)


def test_outliers_that_bias_a_loss_of_ones_own_are_named_and_not_the_formulation() -> None:
    steep = ro.Formulation("steep", lambda v: cp.sum(v**4), cp.sum_squares)
    for formulation in ("minimax", steep):
        (reason,) = ro.calibrate(ro.load("blunders").problem, formulation, 1.0).verdict.reasons
        assert "outliers (c43, c39, c7, c14, c1): without them residuals are 0.9" in reason


def test_an_outlier_that_a_loss_spreads_over_all_rows_is_the_cause() -> None:
    """Of the largest errors of a minimax fit none stands out."""
    problem = ro.load("position").problem
    (block,) = problem.data.blocks
    gross = block.y + 3e-3 * np.eye(len(block.y))[:, [3]]
    result = ro.calibrate(problem.on(replace(problem.data, blocks=(replace(block, y=gross),))), ro.minimax, 0.1)
    assert not result.verdict.delivered
    assert f"outliers ({problem.labels[3]})" in str(result.verdict)


def test_outliers_are_the_cause_where_the_same_rows_without_them_fit_a_loss_of_ones_own() -> None:
    """Its residuals with outliers were compared with those of a squared penalty without, and a weight was blamed."""
    lopsided = ro.Formulation("lopsided", lambda r: cp.sum_squares(cp.pos(r)) + 4 * cp.sum_squares(cp.neg(r)))
    errors = np.zeros((40, 3))
    errors[[3, 7]] = 3e-3 * np.random.default_rng(0).normal(size=(2, 3))
    wrong = values(lambda y: y + errors)
    result = ro.calibrate(wrong(ro.load("position").problem), replace(lopsided, penalty=cp.sum_squares), 1.0)
    (reason,) = result.verdict.reasons
    assert reason.startswith("Likely: outliers (c3, c7): without them residuals are 0.8")
    assert "They bias this loss: use formulation 'robust'" in reason


def test_a_loss_that_knows_its_equations_keeps_outliers_and_says_so() -> None:
    """Without six equations an index array failed, and slices took the next session's: a weight of one half."""
    problem = values(lambda y: y + 5e-3 * np.isin(np.arange(len(y)), [3, 7])[:, None])(ro.load("position").problem)
    first, second = np.array_split(np.arange(3 * len(problem.data)), 2)

    def worse_half(r: cp.Variable) -> cp.Expression:
        return cp.sum_squares(r) + cp.maximum(cp.sum_squares(r[first]), cp.sum_squares(r[second]))

    result = ro.calibrate(problem, ro.Formulation("worse half", worse_half, cp.sum_squares))
    assert result.excluded is None
    assert result.verdict.reasons == (
        "Likely: outliers bias a loss that depends on the order of its equations: leave out c3, c7.",
    )
    assert "Outliers, kept since the loss depends on equation order: c7 (" in str(result)
    without = ro.calibrate(problem.without(["c3", "c7"]), ro.Formulation("sum", lambda r: cp.sum(r**2), cp.sum_squares))
    assert without.verdict.delivered


def test_a_loss_without_gradients_has_no_intervals_and_can_be_stored(tmp_path: Path) -> None:
    def worst(r: cp.Variable) -> cp.Expression:
        return cp.sum_squares(r) + 50 * cp.norm_inf(r)

    result = ro.calibrate(ro.load("position").problem, ro.Formulation("worst", worst, cp.sum_squares), 1.0)
    assert "no quadratic model" in result.no_intervals
    save_result(result, tmp_path / "result.json")
    assert load_result(tmp_path / "result.json").x == pytest.approx(result.x)


def test_without_a_covariance_it_says_why_wherever_intervals_would_be() -> None:
    instance = ro.load("position")
    result = ro.calibrate(instance.problem, "lasso")
    why = "the penalty of formulation 'lasso' is not quadratic"
    requirement = ro.data.Requirement(1e-4)
    texts = [ro.use.validate(result, instance.validation), ro.use.compensate(result, instance.validation.q[:2]).note]
    texts += [result, "".join(ro.calibration.accept(result, requirement).sentences())]
    assert all(why in str(text) for text in texts)
    for refused in (ro.calibration.Uncertainty, ro.influence, lambda r: r.predict(instance.validation.q)):
        with pytest.raises(ro.InputError, match="is not quadratic"):
            refused(result)
    loss = ro.use.validate(ro.calibrate(instance.problem, "minimax"), instance.validation)
    assert "the loss of formulation 'minimax' has no quadratic model: it depends on a few equations" in str(loss)


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("away", [0.003, 0.12])
def test_a_constraint_that_contradicts_the_data_is_the_reason(away: float, robust: bool) -> None:
    """And neither the weight nor the DH table, where it does not converge; a robust loss hides it no more than rows."""
    problem, q = ro.load("position").problem, np.radians([[10.0, 20, -30, 40, 50, 60]])
    here = ro.calibrate(problem).forward(q)[0, :3, 3]
    (block,) = problem.data.blocks
    y = block.y.copy()
    y[[3, 11, 24]] += 1e-3 * np.eye(3)
    problem = problem.on(replace(problem.data, blocks=(replace(block, y=y),))) if robust else problem
    loss = (lambda v: cp.sum(cp.huber(v, 2))) if robust else cp.sum_squares

    def elsewhere(_z, parameters):
        return cp.norm(parameters.positions(q)[0] - (here + np.array([0, 0, away]))) <= 2e-3

    mine = ro.Formulation("mine", loss, cp.sum_squares, (elsewhere,))
    result = ro.calibrate(problem, mine, 1.0)
    verdict = result.verdict
    assert result.contradiction or not result.converged
    assert "the formulation, not the robot, limits the fit" in verdict.reasons[0]
    assert "Loosen its constraints (elsewhere)" in verdict.reasons[0]
    assert "DH table" not in str(verdict)
    assert "larger weight" not in str(verdict)


def test_held_out_rows_that_are_read_wrongly_are_named() -> None:
    """Degrees in the validation file alone: neither the instrument nor the base moved."""
    instance = ro.load("position")
    result = ro.calibrate(instance)
    assert instance.validation is not None
    (block,) = instance.validation.blocks
    degrees = replace(instance.validation, blocks=(replace(block, q=np.degrees(block.q)),))
    (reason,) = replace(result, record=replace(result.record, validation=degrees)).verdict.reasons
    assert reason.startswith("Held-out rows do not fit. Likely: the data fit")
    assert "degrees" in reason
