"""A calibration in words: what is named, in which unit, and how much of it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration import Certificate, Verdict, words
from rpim_opt.calibration.diagnosis import ActiveBound, Flag, ShadowPrice
from rpim_opt.calibration.identify import ending
from rpim_opt.calibration.loop import Ended, State
from tests.calibration.test_loop import state

RESULT = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, 1e-3)
FREE = RESULT.problem.parameters.free


def test_rows_are_in_the_parameters_units() -> None:
    values = FREE.values(RESULT.x)
    rows = RESULT.parameter_rows()
    assert [row["parameter"] for row in rows] == list(FREE.names)
    for i, row in enumerate(rows):
        si = {"mm": 1e-3, "mrad": 1e-3, "deg": np.pi / 180}[row["unit"]]
        assert row["nominal"] == pytest.approx(FREE.nominal[i] / si, rel=1e-12, abs=1e-12)
        assert row["identified"] == pytest.approx(values[i] / si, rel=1e-12, abs=1e-12)
        assert row["deviation"] == pytest.approx(row["identified"] - row["nominal"], abs=1e-9)
        variance = RESULT.covariance[i, i]
        if np.isfinite(variance):
            assert row["std"] == pytest.approx(np.sqrt(variance) / si, rel=1e-9)
        else:
            assert row["std"] is None


def test_a_parameter_without_covariance_has_a_dash() -> None:
    lasso = ro.calibrate(ro.load("paper_arm").problem, ro.lasso, 1.0)
    assert all(row["std"] is None for row in lasso.parameter_rows())
    assert words.parameter_table(lasso).splitlines()[-1].rstrip().endswith("-")


def flagged(count: int, squared_loss: bool = False) -> list[str]:
    flags = tuple(Flag(f"r{k}", 10.4 + k, 1.234e-3, "length") for k in range(count))
    held = tuple(ActiveBound("a2", 0.0005, 1.0, 0.05) for _ in range(count))
    stand_in: Any = SimpleNamespace(
        active_constraints=(),
        flagged=flags,
        clustered=(),
        active_bounds=held,
        shadow_prices=(ShadowPrice("a2 by 0.5 mm", "mm", 0.0, 2.0, 0.1, 0.2, 9.0),) * count,
        squared_loss=squared_loss,
        problem=RESULT.problem,
        record=RESULT.record,
        x=np.zeros(len(FREE)),
        formulation=ro.tikhonov,
        message="Done.",
    )
    return words.remarks(stand_in, Verdict())


def test_some_rows_and_bounds_are_named_and_the_others_counted() -> None:
    assert flagged(0) == ["Done."]
    eight = flagged(8)[0]
    assert eight.startswith("Outliers: r0 (10 standard deviations, 1.23 mm), ")
    assert "r7 (17 standard deviations" in eight
    assert "more" not in eight
    eleven = flagged(11)
    assert eleven[0].endswith("and 3 more.")
    assert "r8" not in eleven[0]
    bounds = [line for line in eleven if line.startswith("Active bound")]
    assert len(bounds) == 5
    assert bounds[0] == (
        "Active bound: a2 at +0.5 mm. Loosening its tolerance by 0.05 mm would lower "
        "the RMS of the standardized residuals by 0.05."
    )
    loosened = "'a2 by 0.5 mm' is active: loosening it by 0.1 mm would lower the objective by 0.2, from 9."
    assert eleven.count(loosened) == 11
    assert not any("Outliers bias" in line for line in eleven)
    assert any("Outliers bias" in line for line in flagged(1, True))


def test_points_beyond_a_table_are_counted_with_the_largest_of_their_errors() -> None:
    found = [{"name": f"p{k}", "count": 2, "nominal_rms_mm": 1.0, "rms_mm": 0.1, "max_mm": 1e-3 * k} for k in range(23)]
    assert words.touch_rows(found)[20:] == [["3 others", "6", "", "", "0.022"]]
    assert len(words.touch_rows(found[:20])) == 20


def test_what_a_file_could_not_hold_is_said() -> None:
    stand_in: Any = SimpleNamespace(
        active_constraints=(),
        flagged=(),
        active_bounds=(),
        shadow_prices=(),
        problem=RESULT.problem,
        record=RESULT.record,
        x=np.zeros(len(FREE)),
        formulation=replace(ro.tikhonov, solvable=False),
        message="Done.",
    )
    assert "cannot store functions of a script" in words.remarks(stand_in, Verdict())[0]


def test_frames_of_which_the_data_determine_a_combination_are_named() -> None:
    """On a SCARA base and reflector rise together; a known length of the tool tells them apart."""
    problem = ro.load("scara").problem
    said = "base_z and tool_z are redundant"
    assert said in "".join(words.underdetermined(ro.calibrate(problem)))
    assert said not in "".join(
        words.underdetermined(ro.calibrate(problem, prior=ro.bayes.Prior.known("tool_z +- 0.1 mm")))
    )
    assert words.underdetermined(RESULT) == words.underdetermined(ro.calibrate(ro.load("plane").problem)) == []


def test_joints_that_hardly_moved_or_one_by_one_are_a_condition() -> None:
    """From the middle of the ranges, each joint in turn; beyond that the robot is 1.6 to 3 times as wrong."""
    problem = ro.load("position").problem
    (block,) = problem.data.blocks
    q = np.tile(np.median(block.q, axis=0), (len(block.q), 1, 1))
    rows = np.arange(len(q))
    q[rows, 0, rows % 6] = block.q[rows, 0, rows % 6]
    moved = problem.on(replace(problem.data, blocks=(replace(block, q=q),)))
    y = moved.modelled(np.zeros(len(problem.parameters.free)))[0] + 1e-5 * np.random.default_rng(0).normal(size=(40, 3))
    caution = ro.calibrate(moved.on(replace(moved.data, blocks=(replace(block, q=q, y=y),)))).verdict.caution
    assert "one joint alone differs from a common configuration" in caution
    still = ro.calibrate(ro.load("rank_deficient").problem).verdict
    assert str(still).startswith("Delivered under a condition. Too little motion: joint 6 moves only 0.00 deg.")


def test_errors_before_and_after_are_in_millimetres() -> None:
    before, after = 1e3 * RESULT.nominal_errors().mean(), 1e3 * RESULT.errors().mean()
    assert f"Identification error (mean): {before:.4f} mm before, {after:.4f} mm after." in str(RESULT)


def test_a_weight_is_said_with_where_it_came_from() -> None:
    assert RESULT.weight_sentence() == "Weight 0.001 (given), formulation 'Tikhonov'."
    free = ro.calibrate(ro.load("position").problem, ro.least_squares)
    assert free.weight_sentence() == "Formulation 'least squares' has no penalty and needs no weight."
    assert (free.selector, free.penalty_weight) == ("none", 0.0)
    assert (RESULT.selector, RESULT.penalty_weight) == ("given", 1e-3)


@pytest.mark.parametrize(("count", "said"), [(0, "0 iterations"), (1, "1 iteration"), (2, "2 iterations")])
def test_passes_are_counted(count: int, said: str) -> None:
    good, bad = Certificate(0.0, 0.0, 0.0), Certificate(1.0, 0.0, 0.5)
    before = state(history=(None,) * count, outcome="converged")

    def said_of(at: State, evidence: Certificate = good, most: int = 500) -> str:
        return ending(Ended(at, at.z, evidence), most)

    assert said_of(before) == f"Converged after {said}."
    noted = replace(before, choice=replace(before.choice, note="It alternates."))
    assert said_of(noted) == f"Converged after {said}. It alternates."
    assert "no step, however short, decreases the nonlinear objective" in said_of(replace(before, outcome="stalled"))
    assert "still predicts a decrease of the objective by 5e+01 %" in said_of(before, bad)
    ended = said_of(replace(before, outcome="", history=()), most=7)
    assert ended == "Not converged: 7 iterations were not enough; allow more (max_iterations)."


def test_turns_of_frames_are_no_differences() -> None:
    """Whoever subtracts the columns of a frame's angles gets something else than the deviation, and is told."""
    problem = ro.load("position").problem
    lengths = problem.with_parameters(problem.parameters.identify(["d?", "base_[xyz]"]))
    assert not words.turned_frames(ro.calibrate(lengths, ro.tikhonov, weight=1.0))
    result = ro.calibrate(problem, ro.tikhonov, weight=1.0)
    rows = {row["parameter"]: row for row in result.parameter_rows()}
    told = words.turned_frames(result)[0].split(" turn ")[0]
    for name, row in rows.items():
        missed = abs(row["identified"] - row["nominal"] - row["deviation"])
        assert (name in told) == (missed > 1e-4)
    assert "base_rx" in told


def test_deviations_beyond_a_tolerance_that_nothing_bounds_are_named() -> None:
    instance = ro.load("paper_arm")
    tight = instance.problem.with_parameters(instance.problem.parameters.toleranced({"length_mm": 0.01}))
    free = ro.calibrate(tight, ro.tikhonov, 1e-3)
    (line,) = [line for line in words.remarks(free, free.verdict) if "tolerance" in line]
    assert line.endswith("Only formulation 'bounded' enforces tolerances.")
    assert "d4" in line
    bounded = ro.calibrate(tight, ro.bounded, 1e-3)
    assert not [line for line in words.remarks(bounded, bounded.verdict) if line.startswith("Beyond")]


def test_deviations_are_unusual_from_the_mean_of_the_prior() -> None:
    problem = ro.load("position").problem
    p = problem.parameters
    other = replace(p, nominal=p.nominal - 0.1 * (np.array(p.names) == "theta3"))
    prior = ro.bayes.Prior(centre={"theta3_mrad": 100.0}, scale={"theta3_mrad": 3.0})
    result = ro.calibrate(problem.with_parameters(other), prior=prior)
    assert result.x[result.problem.parameters.free.names.index("theta3")] == pytest.approx(0.1, abs=1e-3)
    assert "prior standard deviations" not in " ".join(words.weight_lines(result))
