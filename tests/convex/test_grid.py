"""Whatever CVXPY can state is solved as CVXPY solves it: formulations x shipped problems x weights."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from tests.convex.grid import CASES, PROBLEMS, TWINS
from tests.convex.plain import Plain, objective_at, plain, solved, violation

EQUAL = 1e-6
"""Of the objective: what plain CVXPY with Clarabel is good for, from weights of 1e-6 s_1^2 on."""
FLOOR = 1.0
"""Objectives below one squared sigma of one equation are compared absolutely."""
MISSED = 1e-7
"""By how much constraints may be missed, relative to 1 + the largest entry of z."""


@lru_cache
def problem_of(name: str) -> ro.CalibrationProblem:
    return ro.load(name).problem


@lru_cache
def weights(name: str) -> tuple[float, ...]:
    """1e-6 and 1e-4 of s_1^2 at nominal; 1 and 100 where they are larger than the first."""
    problem = problem_of(name)
    s = problem.linearize(np.zeros(len(problem.parameters.free))).svd[1]
    least = 1e-6 * s[0] ** 2
    plain_ones = [weight for weight in (1.0, 100.0) if weight > least]
    return tuple(sorted({least, 100 * least, *plain_ones}))


def sample() -> list[tuple[str, str, int]]:
    """Every formulation once, every fifth twice: problems and weights take turns."""
    pairs = []
    for k, name in enumerate(CASES):
        pairs.append((name, PROBLEMS[3 * k % len(PROBLEMS)], k // len(PROBLEMS)))
        if k % 5 == 0:
            pairs.append((name, PROBLEMS[(3 * k + 4) % len(PROBLEMS)], k + 1))
    return pairs


SAMPLE = sample()


def close(one: float, other: float) -> bool:
    return abs(one - other) <= EQUAL * max(abs(other), FLOOR)


def checked(name: str, problem_name: str, weight: float) -> None:
    """Calibrate and compare with plain CVXPY on the last linearization."""
    problem = problem_of(problem_name)
    formulation = CASES[name]()
    result = ro.calibrate(problem, formulation, weight)
    model = result.problem.linearize(result.x)
    z = result.x / model.parameters.scale
    fresh = CASES[name]()  # shares no variable with what was solved
    best = plain(replace(fresh, constraints=TWINS.get(name, fresh.constraints)), model, weight)
    ours = objective_at(fresh, model, weight, z)
    missed = violation(fresh, model, z)
    promised = best.objective < ours - EQUAL * max(abs(best.objective), FLOOR)
    said = f"ours {ours:.12g}, CVXPY {best.objective:.12g} (attempt {best.attempt}): {result.message}"
    assert result.converged == (not promised), said
    if not result.converged:
        return
    assert close(ours, best.objective), said
    assert missed <= MISSED
    assert result.certificate.violation <= MISSED * (1 + float(np.abs(z).max()))
    assert result.certificate.decrease <= 2 * EQUAL
    as_problem(formulation, model, weight, best, ours)


def as_problem(
    formulation: ro.Formulation, model: ro.problem.LinearModel, weight: float, best: Plain, ours: float
) -> None:
    """The program that the framework says it minimizes has that optimum."""
    program = ro.convex.pose(formulation, model)
    stated = program.problem(weight)
    assert isinstance(stated, cp.Problem)
    assert stated.is_dcp(dpp=True)
    assert {"A", "b"} <= {parameter.name() for parameter in stated.parameters()}
    assert "z" in {variable.name() for variable in stated.variables()}
    z = next(variable for variable in stated.variables() if variable.name() == "z")
    near = 2 * EQUAL
    if formulation.name in TWINS:
        near = 1e-4  # as a user scaled it, CVXPY misses the constraints by 1e-5
    try:
        optimum = solved(stated.objective.expr, stated.constraints, z).objective
    except AssertionError:  # CVXPY does not solve the program in its user's units: the twin has been compared
        assert formulation.name in TWINS
        optimum = best.objective
    assert optimum == pytest.approx(best.objective, rel=near, abs=near * FLOOR)
    estimate = program.solve(weight)
    assert estimate.status == cp.OPTIMAL
    assert estimate.loss + weight * estimate.penalty == pytest.approx(ours, rel=2 * EQUAL, abs=2 * EQUAL * FLOOR)


@pytest.mark.parametrize(("name", "problem_name", "turn"), SAMPLE, ids=[f"{f}, {p}" for f, p, _ in SAMPLE])
def test_a_calibration_ends_where_plain_cvxpy_ends(name: str, problem_name: str, turn: int) -> None:
    choice = weights(problem_name)
    checked(name, problem_name, choice[turn % len(choice)])


@pytest.mark.slow
@pytest.mark.parametrize("problem_name", PROBLEMS)
@pytest.mark.parametrize("name", list(CASES))
def test_the_whole_grid(name: str, problem_name: str) -> None:
    for weight in weights(problem_name):
        checked(name, problem_name, weight)


def test_the_grid_is_as_wide_as_it_says() -> None:
    assert len(CASES) >= 60
    assert {name for name, _, _ in SAMPLE} == set(CASES)
    used = [problem_name for _, problem_name, _ in SAMPLE]
    assert min(used.count(name) for name in PROBLEMS) >= 5


def test_the_squares_of_a_robust_loss_are_squares_for_a_stated_solver_too() -> None:
    """What rules see of a robust loss, where its own solver fails and CVXPY's stands in."""
    problem = ro.load("blunders").problem
    program = ro.convex.pose(ro.robust, problem.linearize(np.zeros(len(problem.parameters.free))))
    squares = program.on_squares(program.inlier_model(program.solve(1.0).z))
    found, stated = squares.solve(1.0), squares.solve(1.0, solver="CLARABEL")
    assert stated.loss == pytest.approx(found.loss, rel=1e-6)
    np.testing.assert_allclose(stated.z, found.z, atol=1e-5)
