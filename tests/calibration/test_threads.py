"""Threads and processes give the numbers of the serial run, bit for bit."""

from __future__ import annotations

import pickle
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cvxpy as cp
import joblib
import numpy as np
import pytest

import rpim_opt as ro
from tests.convex.grid import CASES

NAMES = ("paper_arm", "cable")
READY = ("least_squares", "tikhonov", "bounded", "robust", "sum_of_norms", "minimax", "lasso", "group_lasso")


def identified(problem: ro.CalibrationProblem, formulation: ro.Formulation, weight: float = 100.0) -> np.ndarray:
    return ro.calibrate(problem, formulation, weight).x


@pytest.mark.parametrize(
    "name",
    [
        "CVaR + squares",
        pytest.param("Tikhonov, slack of a box", marks=pytest.mark.slow),
        pytest.param("bias of all equations + squares", marks=pytest.mark.slow),
        "parameters in the loss",
        "parameters in the penalty and a constraint, Huber",
        "Huber of norms, a ball a link",
    ],
)
def test_two_threads_calibrate_with_one_formulation(name: str) -> None:
    """Its own variables and parameters are the same objects in both threads."""
    formulation = CASES[name]()
    problems = [ro.load(problem).problem for problem in NAMES]
    serial = [identified(problem, formulation) for problem in problems]
    with ThreadPoolExecutor(2) as threads:
        found = list(threads.map(lambda problem: identified(problem, formulation), 3 * problems))
    for one, other in zip(found, 3 * serial, strict=True):
        assert np.array_equal(one, other)


@pytest.mark.slow
def test_two_threads_ask_one_program_for_violations() -> None:
    model = ro.load("paper_arm").problem.linearize(np.zeros(26))
    ball = ro.Formulation("ball", penalty=cp.sum_squares, constraints=(lambda z, p: cp.norm(z) <= 1.0,))
    program = ro.convex.pose(ball, model)
    rng = np.random.default_rng(0)
    points = [rng.uniform(1, 3) * rng.normal(size=26) for _ in range(20)]
    serial = [program.violation(z) for z in points]
    assert len(set(serial)) == len(points)
    asked = 20_000 // len(points)
    with ThreadPoolExecutor(2) as threads:
        found = list(threads.map(program.violation, asked * points, chunksize=100))
    assert found == asked * serial


def test_two_threads_ask_one_program_for_values() -> None:
    model = ro.load("paper_arm").problem.linearize(np.zeros(26))
    formulation = ro.Formulation("own", lambda r: cp.sum(cp.huber(r, 2)), lambda z: cp.norm1(z) + cp.norm(z[:3]))
    program = ro.convex.pose(formulation, model)
    points = [np.full(26, value) for value in np.linspace(-2, 2, 20)]
    serial = [program.value(z) for z in points]
    with ThreadPoolExecutor(2) as threads:
        found = list(threads.map(program.value, 100 * points))
    assert found == 100 * serial


def test_two_threads_solve_one_program() -> None:
    model = ro.load("position").problem.linearize(np.zeros(34))
    program = ro.convex.pose(CASES["Huber of norms + squares"](), model)
    weights = [float(weight) for weight in np.geomspace(1e2, 1e4, 10)]
    serial = [program.solve(weight).z for weight in weights]
    with ThreadPoolExecutor(2) as threads:
        found = list(threads.map(lambda weight: program.solve(weight).z, weights))
    for one, other, weight in zip(found, serial, weights, strict=True):  # each begins where some other ended
        least = program.objective(other, weight)
        assert program.objective(one, weight) == pytest.approx(least, rel=1e-12)
        np.testing.assert_allclose(one, other, atol=1e-5)  # of a scale; the square root of that


@pytest.mark.slow
def test_processes_get_lambdas() -> None:
    """joblib's loky sends formulations with lambdas and own variables by cloudpickle."""
    radius = 2.0
    threshold = cp.Variable()
    tail = ro.Formulation(
        "tail",
        lambda r: threshold + cp.sum(cp.pos(cp.abs(r) - threshold)) / (0.2 * r.size),
        lambda z: cp.sum_squares(z) + 0.1 * cp.norm1(z),
        (lambda z, p: cp.norm(z) <= radius,),
    )
    robust = ro.Formulation("Huber", lambda v: cp.sum(cp.huber(v, 2)), cp.sum_squares, loss_over="configuration")
    tasks = [(ro.load(name).problem, formulation) for name in NAMES for formulation in (tail, robust)]
    serial = [identified(*task) for task in tasks]
    found: Any = joblib.Parallel(n_jobs=2, backend="loky")(joblib.delayed(identified)(*task) for task in tasks)
    for one, other in zip(found, serial, strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize("name", READY)
def test_ready_formulations_travel_by_pickle(name: str) -> None:
    formulation = getattr(ro, name)
    there = pickle.loads(pickle.dumps(formulation))
    assert there.name == formulation.name
    problem = ro.load("paper_arm").problem
    assert np.array_equal(identified(problem, there), identified(problem, formulation))


def test_a_huber_of_ones_own_threshold_travels_by_pickle() -> None:
    formulation = ro.Formulation("mine", ro.huber(1.3), cp.sum_squares)
    there = pickle.loads(pickle.dumps(formulation))
    problem = ro.load("paper_arm").problem
    assert np.array_equal(identified(problem, there), identified(problem, formulation))


def test_a_ready_formulation_says_the_same_after_a_travel() -> None:
    """What is known of its structure travels too: covariance and degrees of freedom are the same."""
    problem = ro.load("paper_arm").problem
    here = ro.calibrate(problem, ro.robust, ro.reml)
    there = ro.calibrate(problem, pickle.loads(pickle.dumps(ro.robust)), ro.reml)
    assert there.weight == here.weight
    assert np.array_equal(there.covariance, here.covariance)
