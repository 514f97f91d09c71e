"""Calibrations of several robots, of data in blocks and of losses by equation, asked for what they know."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration import influence, likely_causes, refit_all
from rpim_opt.calibration.lack_of_fit import lack_of_fit
from rpim_opt.data import Requirement
from rpim_opt.problem import PartitionedProblem
from tests.simulate import simulated

IDENTIFY = ("theta[23]", "d4", "tool_[xyz]", "base_*")


@cache
def one(noise: float = 5e-5) -> ro.CalibrationProblem:
    return simulated(IDENTIFY, 24, noise, 4)[0]


@cache
def result() -> ro.calibration.Calibration:
    return ro.calibrate(one(), ro.tikhonov, 1.0)


@cache
def both() -> ro.calibration.Calibration:
    other = simulated(IDENTIFY, 20, 5e-5, 5)[0]
    return ro.calibrate(ro.together(left=one(), right=other, shared=("tool_[xyz]",)), ro.tikhonov, 1.0)


def in_parts() -> PartitionedProblem:
    halves = [one().data.take(np.arange(start, start + 12)) for start in (0, 12)]
    return PartitionedProblem(
        one().robot, one().parameters, halves[0], tuple(lambda part=part: part for part in halves)
    )


def test_squares_are_squares_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Outlying rows count for the covariance of a squared loss, wherever the rows are kept."""
    whole = ro.load("blunders").problem
    halves = [whole.data.take(rows) for rows in np.array_split(np.arange(len(whole.data)), 2)]
    sources = tuple(lambda part=part: part for part in halves)
    blocks = PartitionedProblem(whole.robot, whole.parameters, halves[0], sources)
    monkeypatch.setattr(PartitionedProblem, "gathered", lambda self: None)
    memory, parts = (ro.calibrate(each, ro.tikhonov, 1.0) for each in (whole, blocks))
    assert parts.squared_loss
    assert parts.covariance == pytest.approx(memory.covariance, rel=1e-6, abs=1e-15)


# --- several robots ------------------------------------------------------------------------------------------------


def test_what_numbers_of_joints_would_not_tell_is_not_said_of_several_robots() -> None:
    found = lack_of_fit(both())
    assert found.upward == ()
    assert not found.missing
    assert likely_causes(both()) == []


def test_a_region_is_of_one_robot() -> None:
    with pytest.raises(ro.InputError, match="several robots in one calibration"):
        ro.calibration.accept(both(), Requirement(1e-3))
    with pytest.raises(ro.InputError, match="robot: found 'middle'"):
        both().forward(one().data.q, robot="middle")


# --- in parts ------------------------------------------------------------------------------------------------------


def test_what_needs_all_rows_says_so_of_measurements_in_parts() -> None:
    parts = ro.calibrate(in_parts(), ro.tikhonov, 1.0)
    assert parts.x == pytest.approx(result().x, abs=1e-9)
    assert likely_causes(parts) == []
    held_out = one().data.take(np.arange(3))
    with pytest.raises(ro.InputError, match="data in blocks, accepted: measurements in memory"):
        refit_all(replace(parts, record=replace(parts.record, validation=held_out)))
    with pytest.raises(ro.InputError, match="no held-out rows"):
        refit_all(result())


def test_sizes_are_learned_from_parts_as_from_the_whole() -> None:
    whole = ro.calibrate(one())
    parts = ro.calibrate(in_parts())
    assert parts.learned is not None
    assert whole.learned is not None
    assert parts.learned.scales.keys() == whole.learned.scales.keys()
    assert parts.x == pytest.approx(whole.x, abs=2e-5)


# --- losses --------------------------------------------------------------------------------------------------------


def test_influence_of_a_loss_by_equation_is_that_of_the_squares_it_ends_with() -> None:
    """Beyond the threshold a residual counts with threshold / residual, a configuration with the mean of its own."""
    y = one().data.blocks[0].y.copy()
    y[7, 2] += 2e-3
    data = replace(one().data, blocks=(replace(one().data.blocks[0], y=y),))
    stated = ro.Formulation("huber", loss=ro.huber(2.0), penalty=cp.sum_squares, loss_over="equation")
    robust = ro.calibrate(one().on(data), stated, 1.0)
    found = influence(robust)
    model = robust.program.model
    r = np.abs(model.A @ robust.z - model.b)
    weight = np.minimum(1.0, 2.0 / r).reshape(24, 3).mean(axis=1)
    assert found.weight == pytest.approx(weight, rel=1e-6)
    assert found.weight.argmin() == 7
    with pytest.raises(ro.InputError, match="a squared loss, or a robust one"):
        influence(replace(robust, formulation=replace(stated, loss=lambda r: cp.norm2(r) + cp.max(r))))
