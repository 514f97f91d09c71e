"""Rows beyond the measured joint ranges are counted, by joint, with a tenth of the range of slack."""

from __future__ import annotations

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration.diagnosis import Outside, measured_ranges, outside

RANGES = {"": np.array([[-1.0, 0.0, 0.5], [1.0, 2.0, 0.5]])}


def rows(q) -> ro.Dataset:
    """Return a dataset at joint values (N, 3)."""
    q = np.atleast_2d(q)
    return ro.Dataset.of(q, np.zeros((len(q), 3)), 1.0)


@pytest.mark.parametrize(
    ("q", "joints"),
    [
        ([0.0, 1.0, 0.5], {}),
        ([1.19, 2.19, 0.515], {}),
        ([-1.19, -0.19, 0.485], {}),
        ([1.21, 1.0, 0.5], {1: 1}),
        ([-1.21, -0.21, 0.5], {1: 1, 2: 1}),
        ([0.0, 1.0, 0.52], {3: 1}),
    ],
)
def test_tenth_of_a_range_is_to_spare_and_a_degree_of_one_that_stood_still(q, joints):
    found = outside(RANGES, rows(q))
    assert found.joints == joints
    assert found.rows == ((0,) if joints else ())
    assert bool(found.sentences()) is bool(joints)


def test_rows_are_named_by_their_numbers_and_counted_by_joint():
    found = outside(RANGES, rows([[0, 1, 0.5], [3, 1, 0.5], [0, 1, 0.5], [3, 5, 0.5]]))
    assert found == Outside(4, (1, 3), {1: 2, 2: 1})
    assert "Rows well outside the measured joint ranges: 2 of 4" in found.sentences()[0]
    assert "(joint 1: 2, joint 2: 1)" in found.sentences()[0]
    assert "ranges: 1 of 4 (joint 1: 1)" in outside(RANGES, rows([[3, 1, 0.5]] + 3 * [[0, 1, 0.5]])).sentences()[0]


def test_every_point_of_a_row_counts():
    data = ro.load("distance").problem.data
    problem = ro.load("distance").problem
    low, high = measured_ranges(problem)[""]
    every = np.concatenate([block.q.reshape(-1, problem.robot.dof) for block in data.blocks])
    assert (low == every.min(axis=0)).all()
    assert (high == every.max(axis=0)).all()
    assert data.blocks[0].q.shape[1] == 2
    tight = {"": np.array([low, high])}
    tight[""][1, 0] = np.median(data.blocks[0].q[:, 1, 0])
    assert outside(tight, data).rows


def test_predictions_validation_and_commands_say_it():
    instance = ro.load("position")
    seen = instance.problem.data
    problem = instance.problem.on(seen.take(np.flatnonzero(np.abs(seen.q[:, 0]) < 1.5)))
    result = ro.calibrate(problem, ro.tikhonov, 1.0)
    middle = measured_ranges(problem)[""].mean(axis=0)
    q = np.array([middle, [2.2, *middle[1:]]])
    assert result.predict(q).outside.rows == (1,)
    assert result.predict(q, confidence=0.95).outside.joints == {1: 1}
    data = ro.Dataset.of(q, result.predict(q).position, 5e-5, label=("near", "far"))
    found = ro.use.validate(result, data)
    assert found.content()["outside"] == ["far"]
    assert "Rows well outside the measured joint ranges: 1 of 2 (joint 1: 1)" in str(found)
    within = ro.use.validate(result, data.take([0]))
    assert within.content()["outside"] == []
    assert "outside the measured joint ranges" not in str(within)
    corrected = ro.use.compensate(result, q, label=["near", "far"])
    assert corrected.content()["outside"] == ["far"]
    assert "measured joint ranges" in str(corrected)
