"""Names of methods and metrics that are compared: each once, and what is no method is refused in a sentence."""

from __future__ import annotations

from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.study.methods import METRICS, methods_of

POSITION = ro.load("position")
OWN = ro.Formulation("squares", penalty=cp.sum_squares)


def by_hand(problem: ro.CalibrationProblem) -> float:
    return 1.0


def labels(formulations: Any, selectors: Any, functions: Any = ()) -> list[str]:
    return list(methods_of(formulations, selectors, functions, {}))


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


def predicting(problem: ro.CalibrationProblem) -> Any:
    result = ro.calibrate(problem, ro.tikhonov, 1.0)
    return lambda q: result.forward(q)[:, :3, 3]


def test_what_a_method_predicts_is_measured_as_what_it_calibrates() -> None:
    found = ro.compare(
        "position", selectors=1.0, methods={"predicts": predicting}, metrics=list(METRICS), progress=False
    )
    calibrates, predicts = found.rows
    same = ("rms_mm", "mean_mm", "p95_mm", "max_mm", "fit_rms_mm")
    assert [predicts[name] for name in same] == pytest.approx([calibrates[name] for name in same], rel=1e-9)
    errors = POSITION.calibrate(weight=1.0).errors(POSITION.validation)
    assert calibrates["rms_mm"] == pytest.approx(1e3 * np.sqrt(np.mean(errors**2)))
    assert calibrates["covered_percent"] > 80  # of rows without noise, in intervals of 95 %
    assert predicts["covered_percent"] is None  # knows no intervals
    assert predicts["rms_mrad"] is None  # of positions
    assert min(row["seconds"] for row in found.rows) > 0


@pytest.mark.parametrize("returned", [np.zeros((3, 2)), np.full(34, np.nan), "text", None])
def test_what_is_no_answer_is_refused(returned: Any) -> None:
    found = ro.compare("position", (), methods={"mine": lambda problem: returned}, progress=False)
    assert found.rows[0]["status"] == "impossible"
    assert "34 finite deviations" in found.rows[0]["reason"]


def test_predictions_have_the_shape_of_positions() -> None:
    for name, returned, said in (
        ("position", lambda q: q, "predicted positions: found shape"),
        ("pose", lambda q: q[:, :3], "one reflector"),
    ):
        found = ro.compare(name, (), methods={"mine": lambda problem, returned=returned: returned}, progress=False)
        assert said in found.rows[0]["reason"]
