"""A user's functions are called at every calibration: what they return now is solved."""

from __future__ import annotations

import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro

WEIGHT = 1.0
SAME = 1e-6
"""Between answers of one program that an interior point solved, in units of the scales."""
OTHER = 1e-2
"""How far apart answers must at least lie for a test to show something."""


class Pattern(NamedTuple):
    """A formulation, what changes it, and how somebody would write it anew after that change."""

    asked: ro.Formulation
    change: Callable[[], None]
    fresh: ro.Formulation


def arm() -> ro.CalibrationProblem:
    return ro.load("paper_arm").problem


def answer(problem: ro.CalibrationProblem, formulation: ro.Formulation, weight: float = WEIGHT) -> np.ndarray:
    """Identified deviations in units of the scales, of a calibration that converged."""
    result = ro.calibrate(problem, formulation, weight)
    assert result.converged, result.message
    return result.x / problem.parameters.free.scale


def in_ball_of(radius: float) -> ro.Formulation:
    return ro.Formulation("ball", penalty=cp.sum_squares, constraints=(lambda z, p: cp.norm(z) <= radius,))


def towards(centre: float) -> ro.Formulation:
    return ro.Formulation("towards", penalty=lambda z: cp.sum_squares(z - centre))


# --- ten ways to keep something outside of a function ------------------------------------------------------


def parameter_of_a_constraint() -> Pattern:
    radius = cp.Parameter(nonneg=True, value=1.0)
    asked = ro.Formulation("ball", penalty=cp.sum_squares, constraints=(lambda z, p: cp.norm(z) <= radius,))
    return Pattern(asked, lambda: setattr(radius, "value", 3.0), in_ball_of(3.0))


def parameter_of_a_loss() -> Pattern:
    factor = cp.Parameter(nonneg=True, value=1.0)
    asked = ro.Formulation("loss", lambda r: factor * cp.norm1(r), cp.sum_squares)
    fresh = ro.Formulation("loss", lambda r: 50.0 * cp.norm1(r), cp.sum_squares)
    return Pattern(asked, lambda: setattr(factor, "value", 50.0), fresh)


def parameter_of_a_penalty() -> Pattern:
    centre = cp.Parameter(value=0.0)
    asked = ro.Formulation("towards", penalty=lambda z: cp.sum_squares(z - centre))
    return Pattern(asked, lambda: setattr(centre, "value", 1.0), towards(1.0))


def closure() -> Pattern:
    centre = 0.0

    def penalty(z: Any) -> Any:
        return cp.sum_squares(z - centre)

    def change() -> None:
        nonlocal centre
        centre = 1.0

    return Pattern(ro.Formulation("towards", penalty=penalty), change, towards(1.0))


CENTRE = 0.0


def around_the_global(z: Any) -> Any:
    return cp.sum_squares(z - CENTRE)


def set_the_global(value: float) -> None:
    global CENTRE
    CENTRE = value


def global_name() -> Pattern:
    set_the_global(0.0)
    return Pattern(ro.Formulation("towards", penalty=around_the_global), lambda: set_the_global(1.0), towards(1.0))


def attribute_of_an_object() -> Pattern:
    kept = SimpleNamespace(centre=0.0)
    asked = ro.Formulation("towards", penalty=lambda z: cp.sum_squares(z - kept.centre))
    return Pattern(asked, lambda: setattr(kept, "centre", 1.0), towards(1.0))


class Prior:
    """A user's own class, with a method and a call."""

    def __init__(self, centre: float) -> None:
        self.centre = centre

    def penalty(self, z: Any) -> Any:
        return cp.sum_squares(z - self.centre)

    def __call__(self, z: Any) -> Any:
        return self.penalty(z)


def bound_method() -> Pattern:
    prior = Prior(0.0)
    return Pattern(
        ro.Formulation("towards", penalty=prior.penalty), lambda: setattr(prior, "centre", 1.0), towards(1.0)
    )


def callable_object() -> Pattern:
    prior = Prior(0.0)
    return Pattern(ro.Formulation("towards", penalty=prior), lambda: setattr(prior, "centre", 1.0), towards(1.0))


def array_that_is_written_to() -> Pattern:
    centre = np.zeros(26)
    asked = ro.Formulation("towards", penalty=lambda z: cp.sum_squares(z - centre))
    return Pattern(asked, lambda: centre.fill(1.0), towards(1.0))


def default_argument() -> Pattern:
    def penalty(z: Any, centre: list[float] = [0.0]) -> Any:  # noqa: B006 (that is the pattern)
        return cp.sum_squares(z - centre[0])

    given = penalty.__defaults__
    assert given is not None
    return Pattern(ro.Formulation("towards", penalty=penalty), lambda: given[0].__setitem__(0, 1.0), towards(1.0))


def partial() -> Pattern:
    centre = np.zeros(26)

    def about(middle: np.ndarray, z: Any) -> Any:
        return cp.sum_squares(z - middle)

    asked = ro.Formulation("towards", penalty=functools.partial(about, centre))
    return Pattern(asked, lambda: centre.fill(1.0), towards(1.0))


def limits_of_a_box() -> Pattern:
    kept = {"half": 0.2}

    def limits(p: Any) -> tuple[np.ndarray, np.ndarray]:
        return np.full(len(p), -kept["half"]), np.full(len(p), kept["half"])

    def wide(p: Any) -> tuple[np.ndarray, np.ndarray]:
        return np.full(len(p), -0.9), np.full(len(p), 0.9)

    asked = ro.Formulation("box", penalty=cp.sum_squares, constraints=(ro.constraints.Box("box", limits),))
    fresh = ro.Formulation("box", penalty=cp.sum_squares, constraints=(ro.constraints.Box("box", wide),))
    return Pattern(asked, lambda: kept.update(half=0.9), fresh)


def matrix_of_penalty_over() -> Pattern:
    rows = np.eye(26)
    asked = ro.Formulation("over", penalty=cp.sum, penalty_over=lambda p: [rows])
    fresh = ro.Formulation("over", penalty=cp.sum, penalty_over=lambda p: [np.diag([9.0] * 13 + [1.0] * 13)])

    def change() -> None:
        rows[:13] *= 9

    return Pattern(asked, change, fresh)


PATTERNS = (
    parameter_of_a_constraint,
    parameter_of_a_loss,
    parameter_of_a_penalty,
    closure,
    global_name,
    attribute_of_an_object,
    bound_method,
    callable_object,
    array_that_is_written_to,
    default_argument,
    partial,
    limits_of_a_box,
    matrix_of_penalty_over,
)


@pytest.mark.parametrize("make", PATTERNS, ids=[make.__name__ for make in PATTERNS])
def test_a_change_is_solved(make: Callable[[], Pattern]) -> None:
    problem, pattern = arm(), make()
    before = answer(problem, pattern.asked)
    pattern.change()
    after = answer(problem, pattern.asked)
    want = answer(problem, pattern.fresh)
    assert np.abs(before - want).max() > OTHER
    assert np.abs(after - want).max() < SAME


def test_a_ball_has_the_radius_that_its_parameter_has_now() -> None:
    radius = cp.Parameter(nonneg=True)
    ball = ro.Formulation("ball", penalty=cp.sum_squares, constraints=(lambda z, p: cp.norm(z) <= radius,))
    lengths = []
    for value in (1.0, 2.0, 3.0, 1.0):
        radius.value = value
        lengths.append(float(np.linalg.norm(answer(arm(), ball, 1e-3))))
    assert lengths == pytest.approx([1.0, 2.0, 3.0, 1.0], abs=SAME)


def test_a_measurement_model_is_asked_anew() -> None:
    """The probe's tip turns out to be longer: the same problem, calibrated again, knows."""
    kept = {"length": 0.0}
    probe = ro.data.Measurement("probe", lambda T: T[:3, 3] + kept["length"] * T[:3, 2], dict.fromkeys("xyz", "length"))
    longer = ro.data.Measurement("probe", lambda T: T[:3, 3] + 2e-3 * T[:3, 2], dict.fromkeys("xyz", "length"))
    data = arm().data
    problem = arm().on(ro.Dataset.of(data.q, data.blocks[0].y, sigma=3e-5, measurement=probe))
    other = arm().on(ro.Dataset.of(data.q, data.blocks[0].y, sigma=3e-5, measurement=longer))
    before = answer(problem, ro.tikhonov)
    kept["length"] = 2e-3
    want = answer(other, ro.tikhonov)
    assert np.abs(before - want).max() > OTHER
    assert np.abs(answer(problem, ro.tikhonov) - want).max() < SAME


# --- once a calibration ------------------------------------------------------------------------------------


def counted(function: Callable[..., Any], calls: list[str], name: str) -> Callable[..., Any]:
    def counting(*arguments: Any) -> Any:
        calls.append(name)
        return function(*arguments)

    return counting


def solves_a_path(program: Any) -> ro.select.Selection:
    weights = np.geomspace(0.1, 10, 5)
    losses = np.array([estimate.loss for estimate in program.path(weights)])
    return ro.select.Selection(1.0, "path", weights, losses, interior=True)


@pytest.mark.parametrize("weight", [WEIGHT, solves_a_path], ids=["given", "selected"])
def test_functions_are_asked_once_a_calibration_and_once_for_its_certificate(weight: Any) -> None:
    calls: list[str] = []
    formulation = ro.Formulation(
        "counted",
        counted(lambda r: cp.sum(cp.huber(r, 2)), calls, "loss"),
        counted(cp.sum, calls, "penalty"),
        (counted(lambda z, p: cp.norm(z) <= 50, calls, "constraint"),),
        penalty_over=counted(ro.constraints.by_link, calls, "penalty_over"),
    )
    result = ro.calibrate(arm(), formulation, weight)
    assert len(result.history) >= 2
    for name in ("loss", "penalty", "constraint", "penalty_over"):
        assert 1 <= calls.count(name) <= 2, name


def test_one_frozen_program_serves_a_whole_call() -> None:
    """A parameter that the callback changes between two passes counts from the next calibration on."""
    radius = cp.Parameter(nonneg=True, value=1.0)
    ball = ro.Formulation("ball", penalty=cp.sum_squares, constraints=(lambda z, p: cp.norm(z) <= radius,))

    def meddle(_: Any) -> None:
        radius.value = 3.0

    problem = arm()
    first = ro.calibrate(problem, ball, WEIGHT, progress=meddle)
    z = first.x / problem.parameters.free.scale
    assert radius.value == 3.0
    assert np.abs(z - answer(problem, in_ball_of(1.0))).max() < SAME
    assert np.abs(answer(problem, ball) - answer(problem, in_ball_of(3.0))).max() < SAME


def test_a_result_keeps_the_program_that_it_solved() -> None:
    """Asked later, `result.program` is the frozen one: what was solved can be solved again."""
    radius = cp.Parameter(nonneg=True, value=1.0)
    ball = ro.Formulation("ball", penalty=cp.sum_squares, constraints=(lambda z, p: cp.norm(z) <= radius,))
    result = ro.calibrate(arm(), ball, 1e-3)
    radius.value = 3.0
    again = result.program.solve(1e-3).z
    assert np.linalg.norm(again) == pytest.approx(1.0, abs=SAME)
    assert np.abs(again - result.x / result.problem.parameters.free.scale).max() < 1e-4
    assert result.certificate.violation < SAME


def test_two_programs_of_one_formulation_do_not_share_a_parameter() -> None:
    """Posed before and after a change, side by side: each keeps its own value."""
    model = arm().linearize(np.zeros(26))
    radius = cp.Parameter(nonneg=True, value=1.0)
    ball = ro.Formulation("ball", penalty=cp.sum_squares, constraints=(lambda z, p: cp.norm(z) <= radius,))
    small = ro.convex.pose(ball, model)
    radius.value = 2.0
    large = ro.convex.pose(ball, model)
    lengths = [float(np.linalg.norm(program.solve(1e-3).z)) for program in (small, large, small)]
    assert lengths == pytest.approx([1.0, 2.0, 1.0], abs=SAME)
    assert small.violation(large.solve(1e-3).z) == pytest.approx(1.0, abs=1e-5)


def test_ready_formulations_with_equal_arguments_give_the_same_bits() -> None:
    one = answer(arm(), ro.Formulation("one", ro.huber(1.5), cp.sum_squares))
    other = answer(arm(), ro.Formulation("other", ro.huber(1.5), cp.sum_squares))
    assert np.array_equal(one, other)
