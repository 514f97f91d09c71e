"""Data and solvers that no cell has: a result that says what happened, never a plausible wrong number.

Where a calibration says that it converged, its point is tried against its neighbours on the nonlinear objective, and
the optimality conditions are computed anew.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics import NoSolutionFound, RpimError
from tests.simulate import simulated

SOME = ("a?", "d?", "theta?")


def problem_of(q: np.ndarray, y: np.ndarray, sigma: Any = 5e-5) -> ro.CalibrationProblem:
    problem, _ = simulated(SOME, configurations=3)
    return problem.on(ro.Dataset.of(q, y, sigma))


def measured(count: int = 20, noise: float = 5e-5, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    problem, _ = simulated(SOME, configurations=count, noise=noise, seed=seed)
    block = problem.data.blocks[0]
    return problem.data.q.reshape(count, -1), block.y


def zero_noise() -> ro.CalibrationProblem:
    return simulated(SOME, configurations=20, noise=0.0, seed=1)[0]


def nominal_data() -> ro.CalibrationProblem:
    return simulated(SOME, configurations=20, noise=0.0, seed=1, size=0.0)[0]


def identical_rows() -> ro.CalibrationProblem:
    q, y = measured(4)
    return problem_of(np.repeat(q[:1], 30, axis=0), np.repeat(y[:1], 30, axis=0))


def one_configuration() -> ro.CalibrationProblem:
    q, y = measured(4)
    return problem_of(q[:1], y[:1])


def rank_one() -> ro.CalibrationProblem:
    """Only the first joint moves, and nothing but d1 can be told from its neighbours along its axis."""
    q, _ = measured(4)
    turned = np.repeat(q[:1], 12, axis=0)
    turned[:, 0] = np.linspace(-2, 2, 12)
    problem, truth = simulated(("d1",), configurations=12)
    nominal = -problem.on(ro.Dataset.of(turned, np.zeros((12, 3)), 5e-5)).residual(truth).reshape(-1, 3)
    return problem_of(turned, nominal)


def noise_far_apart() -> ro.CalibrationProblem:
    q, y = measured(20)
    return problem_of(q, y, np.geomspace(1e-9, 1e3, 20)[:, None] * np.ones(3))


def scales_far_apart() -> ro.CalibrationProblem:
    problem, _ = simulated(SOME, configurations=20, noise=5e-5, seed=1)
    scale = problem.parameters.scale.copy()
    scale *= np.geomspace(1e-6, 1e6, len(scale))
    return replace(problem, parameters=replace(problem.parameters, scale=scale))


def many_turns() -> ro.CalibrationProblem:
    q, y = measured(20)
    turns = 2 * np.pi * np.random.default_rng(0).integers(-1000, 1000, q.shape)
    return problem_of(q + turns, y)


def impossible() -> ro.CalibrationProblem:
    q, y = measured(20)
    return problem_of(q, y + 50.0)


CASES: dict[str, Callable[[], ro.CalibrationProblem]] = {
    "zero noise": zero_noise,
    "nominal data": nominal_data,
    "identical rows": identical_rows,
    "one configuration": one_configuration,
    "rank one": rank_one,
    "noise 1e12 apart": noise_far_apart,
    "scales 1e12 apart": scales_far_apart,
    "many turns": many_turns,
    "50 m off": impossible,
}
LONG = ("50 m off", "many turns")
ASKED: dict[str, tuple[ro.Formulation, Any]] = {
    "least squares": (ro.least_squares, 0.0),
    "tikhonov": (ro.tikhonov, 1.0),
    "bounded": (ro.bounded, 1e-3),
    "robust": (ro.robust, 1.0),
    "lasso": (ro.lasso, 5.0),
    "reml": (ro.tikhonov, ro.reml),
    "l_curve": (ro.tikhonov, ro.l_curve),
    "learned": (ro.tikhonov, None),
}


def objective(result: ro.calibration.Calibration, z: np.ndarray) -> float:
    """Return the nonlinear objective at z (n,), the functions of the formulation asked anew; inf where not allowed."""
    model = result.problem.linearize(z * result.problem.parameters.free.scale)
    program = ro.convex.pose(result.formulation, model)
    if program.violation(z) > 1e-6:
        return np.inf
    return program.objective(z, result.weight)


def no_neighbour_is_lower(result: ro.calibration.Calibration) -> None:
    rng = np.random.default_rng(0)
    here = objective(result, result.z)
    assert np.isfinite(here)
    for size in (1e-4, 1e-2, 1.0):
        for _ in range(8):
            step = rng.normal(size=len(result.z)) * (rng.random(len(result.z)) < rng.random())
            for sign in (1, -1):
                there = objective(result, result.z + sign * size * step)
                assert there >= here - 1e-6 * abs(here) - 1e-9, (size, here - there)


@pytest.mark.parametrize("asked", ASKED)
@pytest.mark.parametrize(
    "case", [name if name not in LONG else pytest.param(name, marks=pytest.mark.slow) for name in CASES]
)
def test_a_result_says_what_happened(case: str, asked: str) -> None:
    formulation, weight = ASKED[asked]
    try:
        result = ro.calibrate(CASES[case](), formulation, weight)
    except RpimError as error:
        said = str(error)
        result = None
    if result is None:
        assert "\n" not in said
        return
    assert np.isfinite(result.x).all()
    assert np.isfinite(result.weight)
    assert str(result)
    if result.converged:
        assert result.certificate.holds(result.z)
        if weight is not None:
            no_neighbour_is_lower(result)
    else:
        assert result.message


def test_the_conditions_of_optimality_hold_where_they_can_be_written_down() -> None:
    """A'(A z - b) + w z = 0; and for the lasso -A'(A z - b) in w times the signs, computed here."""
    problem = simulated(SOME, configurations=20, noise=5e-5, seed=1)[0]
    for formulation, weight in ((ro.tikhonov, 1.0), (ro.lasso, 5.0)):
        result = ro.calibrate(problem, formulation, weight)
        assert result.converged
        model = problem.linearize(result.x)
        slope = 2 * model.A.T @ (model.A @ result.z - model.b)
        largest = np.abs(2 * model.A.T @ model.b).max()
        if formulation is ro.tikhonov:
            assert np.abs(slope + 2 * weight * result.z).max() < 1e-6 * max(largest, weight)
            continue
        zero = np.abs(result.z) < 1e-7
        assert np.abs(slope + weight * np.sign(result.z))[~zero].max() < 1e-3 * weight
        assert np.abs(slope[zero]).max(initial=0.0) <= weight * (1 + 1e-3)


def problem_to_break() -> ro.CalibrationProblem:
    return simulated(SOME, configurations=20, noise=5e-5, seed=1)[0]


def with_nothing(z: Any) -> Any:
    return np.nan * cp.sum_squares(z)


def raising(z: Any) -> Any:
    raise ZeroDivisionError("a function of a script")


@pytest.mark.parametrize("part", ["loss", "penalty"])
def test_functions_of_a_script_that_are_not_numbers_are_named(part: str) -> None:
    stated = ro.Formulation("mine", **{"loss": cp.sum_squares, "penalty": cp.sum_squares} | {part: with_nothing})
    with pytest.raises(RpimError, match=f"{part}"):
        ro.calibrate(problem_to_break(), stated, 1.0)


@pytest.mark.parametrize(
    "status",
    [cp.INFEASIBLE, cp.UNBOUNDED, cp.INFEASIBLE_INACCURATE, cp.UNBOUNDED_INACCURATE, "user_limit", "solver_error"],
)
def test_what_a_solver_does_not_find_is_said(monkeypatch: pytest.MonkeyPatch, status: str) -> None:
    def ended(self: cp.Problem, *_: Any, **__: Any) -> float:
        self._status = status
        return np.nan

    monkeypatch.setattr(cp.Problem, "solve", ended)
    monkeypatch.setattr(cp.Problem, "status", property(lambda self: self._status))
    with pytest.raises(NoSolutionFound) as error:
        ro.calibrate(problem_to_break(), ro.robust, 1.0, solver="CLARABEL")
    assert "\n" not in str(error.value)
    said = str(error.value)  # without constraints nothing is infeasible, whatever a solver says
    assert "stalled" in said if status.startswith("infeasible") else status in said


@pytest.mark.parametrize(
    "error",
    [cp.SolverError("it failed"), ValueError("it failed"), ArithmeticError("it failed"), RuntimeError("it failed")],
)
def test_a_solver_that_raises_is_said(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def raises(*_: Any, **__: Any) -> float:
        raise error

    monkeypatch.setattr(cp.Problem, "solve", raises)
    with pytest.raises(NoSolutionFound, match="it failed"):
        ro.calibrate(problem_to_break(), ro.robust, 1.0, solver="CLARABEL")


@pytest.mark.parametrize("formulation", [ro.robust, ro.lasso, ro.group_lasso], ids=lambda each: each.name)
def test_a_solver_that_is_wrong_and_sure_of_it_is_not_believed(monkeypatch, formulation: ro.Formulation) -> None:
    """A point a twentieth of a scale off, called optimal: the certificate, computed anew, does not hold."""
    solve = cp.Problem.solve

    def wrong(self: cp.Problem, *arguments: Any, **options: Any) -> Any:
        value = solve(self, *arguments, **options)
        for variable in self.variables():
            if variable.name() == "z" and variable.value is not None:
                variable.value = variable.value + 0.05
        return value

    monkeypatch.setattr(cp.Problem, "solve", wrong)
    try:
        result = ro.calibrate(problem_to_break(), formulation, 1.0, solver="CLARABEL")
    except NoSolutionFound:
        return
    assert not result.converged
    assert not result.certificate.holds(result.z)
    assert result.message
