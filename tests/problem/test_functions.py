"""What a script's own measurement reads may change: every call asks it anew, a frozen problem asks once."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.data.measurements.registry import MEASUREMENTS

ZERO = 0.0
COLUMNS = {"z": "length"}


class Probe:
    """A probe whose reading starts at an attribute."""

    zero = 0.0

    def read(self, T: Any) -> Any:
        return T[2, 3] + self.zero


def by_global() -> tuple[ro.data.Measurement, Callable[[float], None]]:
    def change(value: float) -> None:
        global ZERO
        ZERO = value

    return ro.data.Measurement("height", lambda T: T[2, 3] + ZERO, COLUMNS), change


def by_closure() -> tuple[ro.data.Measurement, Callable[[float], None]]:
    zero = 0.0

    def change(value: float) -> None:
        nonlocal zero
        zero = value

    return ro.data.Measurement("height", lambda T: T[2, 3] + zero, COLUMNS), change


def by_attribute() -> tuple[ro.data.Measurement, Callable[[float], None]]:
    probe = Probe()
    return ro.data.Measurement("height", lambda T: probe.read(T), COLUMNS), lambda v: setattr(probe, "zero", v)


def by_method() -> tuple[ro.data.Measurement, Callable[[float], None]]:
    probe = Probe()
    return ro.data.Measurement("height", probe.read, COLUMNS), lambda v: setattr(probe, "zero", v)


def by_residual() -> tuple[ro.data.Measurement, Callable[[float], None]]:
    box = {"zero": 0.0}
    minus = lambda y, m: y - m - box["zero"]  # noqa: E731
    return ro.data.Measurement("height", lambda T: T[2, 3], COLUMNS, minus=minus), lambda v: box.update(zero=v)


WAYS = [by_global, by_closure, by_attribute, by_method, by_residual]


def heights(measurement: ro.data.Measurement) -> ro.CalibrationProblem:
    arm = ro.load("position").problem
    z = ro.robot.forward_kinematics(arm.robot, arm.data.q)[:, 2, 3:4]
    data = ro.Dataset.of(arm.data.q, z, 1e-5, measurement=measurement)
    return ro.CalibrationProblem(arm.robot, arm.parameters.identify(["base_z", "a2"]), data)


@pytest.mark.parametrize("way", WAYS)
def test_a_measurement_is_asked_at_every_call(way) -> None:
    measurement, change = way()
    change(0.0)
    problem = heights(measurement)
    x = np.array([0.3e-3, 0.0])
    before = problem.residual(x)
    change(1e-3)
    np.testing.assert_allclose(problem.residual(x), before - 1e-3, rtol=0, atol=1e-15)
    b = problem.linearize(x).b
    change(0.0)
    # whitened by 10 um, and so 100 sigmas; to the rounding of values of some thousand sigmas
    np.testing.assert_allclose(problem.linearize(x).b, b + 100, rtol=0, atol=1e-9)


@pytest.mark.parametrize("way", WAYS)
def test_a_measurement_is_asked_at_every_calibration(way) -> None:
    measurement, change = way()
    problem = heights(measurement)
    base_z = problem.parameters.free.names.index("base_z")
    heights_of_base = []
    for zero in (0.0, 1e-3, 2e-3):
        change(zero)
        heights_of_base.append(ro.calibrate(problem, ro.least_squares).x[base_z])
    # the reading is z + zero: the base is found lower by as much
    np.testing.assert_allclose(np.diff(heights_of_base), -1e-3, rtol=1e-9)


@pytest.mark.parametrize("way", WAYS)
def test_a_frozen_problem_asks_once(way) -> None:
    measurement, change = way()
    change(0.0)
    problem = heights(measurement)
    frozen = problem.frozen()
    x = np.zeros(2)
    before = frozen.residual(x)
    change(1e-3)
    np.testing.assert_array_equal(frozen.residual(x), before)
    part = frozen.on(frozen.data.take(range(5)))
    np.testing.assert_array_equal(part.residual(x), before[:5])
    assert frozen.frozen() is frozen
    assert not np.allclose(problem.residual(x), before)


def test_ready_measurements_are_built_once() -> None:
    problem = ro.load("pose").problem
    block = problem.data.blocks[0]
    assert problem.functions(block) is problem.functions(block)


def test_a_model_that_imitates_a_ready_one_gives_its_numbers() -> None:
    ready = MEASUREMENTS["pose"]
    problem = ro.load("pose").problem
    block = problem.data.blocks[0]
    own = replace(ready, name="mine")
    data = replace(problem.data, blocks=(replace(block, measurement=own),))
    x = 0.3 * problem.parameters.free.scale
    there, here = problem.linearize(x), problem.on(data).linearize(x)
    np.testing.assert_array_equal(here.A, there.A)
    np.testing.assert_array_equal(here.b, there.b)


@pytest.mark.slow
def test_threads_get_the_serial_numbers() -> None:
    zero = threading.local()
    measurement = ro.data.Measurement("height", lambda T: T[2, 3] + zero.value, COLUMNS)
    problem = heights(measurement)
    x = np.zeros(2)
    zero.value = 0.0
    alone = problem.residual(x)
    wrong: list[float] = []

    def work(value: float) -> None:
        zero.value = value
        for _ in range(40):
            wrong.append(float(np.abs(problem.residual(x) - (alone - value)).max()))

    threads = [threading.Thread(target=work, args=(v,)) for v in (0.0, 1e-3, 2e-3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(wrong) == 120
    assert max(wrong) < 1e-15


def test_a_wrong_number_of_components_is_named() -> None:
    wrong = ro.data.Measurement("height", lambda T: ca.vertcat(T[2, 3], 1), COLUMNS, components=COLUMNS)
    with pytest.raises(ro.InputError, match="height: found 2 components of the residual, accepted: 1"):
        heights(wrong).residual(np.zeros(2))
    pair = ro.data.Measurement("pair", lambda T: T[2, 3], {"a": "length", "b": "length"})
    two = ro.Dataset.of(np.zeros((3, 6)), np.zeros((3, 2)), 1e-4, measurement=pair)
    with pytest.raises(ro.InputError, match="pair: found 1 components of the residual, accepted: 2"):
        ro.load("position").problem.on(two).residual(np.zeros(34))
