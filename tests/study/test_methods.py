"""Names of methods and metrics that are compared: each once, and what is no method is refused in a sentence."""

from __future__ import annotations

from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.study.methods import METRICS, Fitted, answer_of, measure, methods_of

POSITION = ro.load("position")
OWN = ro.Formulation("squares", penalty=cp.sum_squares)


def by_hand(problem: ro.CalibrationProblem) -> float:
    return 1.0


def labels(formulations: Any, selectors: Any, functions: Any = ()) -> list[str]:
    return [method.label for method in methods_of(formulations, selectors, functions, {})]


def test_methods_are_called_as_a_person_calls_them() -> None:
    assert labels("folder", "folder") == ["as in the folder"]
    assert labels(["tikhonov", "folder"], 2) == ["tikhonov, 2", "folder, 2"]
    assert labels([ro.tikhonov, OWN, ro.least_squares], None) == [
        "tikhonov, learned",
        "squares, learned",
        "least_squares",
    ]
    assert labels("tikhonov", [ro.reml, by_hand]) == ["tikhonov, reml", "tikhonov, by_hand"]
    assert labels({"mine": OWN}, {"heavy": 2.0}, {"own": by_hand}) == ["mine, heavy", "own"]
    assert labels((), (), [by_hand, "nominal"]) == ["by_hand", "nominal"]


def test_what_a_method_predicts_is_measured_as_what_it_calibrates() -> None:
    result = POSITION.calibrate(weight=1.0)
    held_out = POSITION.validation
    assert held_out is not None
    predicts = answer_of(lambda q: result.forward(q)[:, :3, 3], result.problem, "")
    of = {
        name: measure(POSITION, answer, 2.0, METRICS)
        for name, answer in {"calibrates": answer_of(result, result.problem, ""), "predicts": predicts}.items()
    }
    same = ("rms_mm", "mean_mm", "p95_mm", "max_mm", "fit_rms_mm", "seconds")
    assert [of["predicts"][name] for name in same] == pytest.approx([of["calibrates"][name] for name in same], rel=1e-9)
    assert of["calibrates"]["rms_mm"] == pytest.approx(1e3 * np.sqrt(np.mean(result.errors(held_out) ** 2)))
    assert of["calibrates"]["covered_percent"] > 80  # of rows without noise, in intervals of 95 %
    assert of["predicts"]["covered_percent"] is None  # knows no intervals
    assert of["predicts"]["rms_mrad"] is None  # of positions


@pytest.mark.parametrize("returned", [np.zeros((3, 2)), np.full(34, np.nan), "text", None])
def test_what_is_no_answer_is_refused(returned: Any) -> None:
    with pytest.raises(ro.InputError, match="34 finite deviations"):
        answer_of(returned, POSITION.problem, "mine")


def test_predictions_have_the_shape_of_positions() -> None:
    assert POSITION.validation is not None
    wrong = Fitted(POSITION.problem, POSITION.validation, *answer_of(lambda q: q, POSITION.problem, ""), 0.0)
    with pytest.raises(ro.InputError, match="predicted positions"):
        wrong.errors()
    pose = ro.load("pose")
    assert pose.validation is not None
    other = Fitted(pose.problem, pose.validation, *answer_of(lambda q: q[:, :3], pose.problem, ""), 0.0)
    with pytest.raises(ro.InputError, match="one reflector"):
        other.errors()
