"""Vectorized functions: the bits of one row after the other, for every operation, number of rows and thread."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics import threads
from rpim_opt.robot import evaluation
from rpim_opt.robot.evaluation import call_rows

SHARED = [np.array([0.3, -1.7]), np.array([2.5])]


def every_operation() -> ca.Function:
    """Return outputs of several shapes: of the row, of what is shared, of both, of neither."""
    x = ca.SX.sym("x", 2)
    c = ca.SX.sym("c", 1)
    row = ca.SX.sym("row", 3)
    a, b, d = ca.vertsplit(row)
    common = ca.sin(x[0]) * c / 3
    table = ca.vertcat(
        ca.horzcat(a * common - b / 7, ca.atan2(a, b), ca.if_else(a > b, d**2, ca.exp(-d))),
        ca.horzcat(ca.fabs(a) ** 1.5, common + 1, ca.fmin(ca.tanh(d), x[1]) / c),
    )
    rest = ca.vertcat(
        ca.sqrt(1 + a * a), ca.fmod(b, 0.7), ca.sign(d), ca.hypot(a, d), ca.floor(b), 2 * a, -d, 1 / b, 0, 4
    )
    return ca.Function("every", [x, c, row], [table, rest, ca.densify(ca.SX(2, 2)), c])


def table(N: int) -> np.ndarray:
    return np.random.default_rng(N).normal(size=(N, 3))


def require_same(here: list[np.ndarray], there: list[np.ndarray]) -> None:
    for a, b in zip(here, there, strict=True):
        assert a.shape == b.shape
        assert np.array_equal(a, b)


@pytest.mark.parametrize("N", [1, 64, 65, 255, 256, 257, 9000])
def test_vectorized_functions_have_the_bits_of_one_after_the_other(N: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation, "PAYS", 1)
    function = every_operation()
    require_same(evaluation.evaluate_rows(function, SHARED, table(N)), call_rows(function, SHARED, table(N)))


def test_what_is_shared_may_change_and_may_be_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation, "PAYS", 1)
    function = every_operation()
    rows = table(300)
    first = evaluation.evaluate_rows(function, SHARED, rows)
    other = [SHARED[0] + 1, SHARED[1]]
    require_same(evaluation.evaluate_rows(function, other, rows), call_rows(function, other, rows))
    require_same(evaluation.evaluate_rows(function, SHARED, rows), first)  # none of it stayed
    row = ca.SX.sym("row", 3)
    alone = ca.Function("alone", [row], [ca.sin(row) * row])
    require_same(evaluation.evaluate_rows(alone, [], rows), call_rows(alone, [], rows))


@pytest.mark.parametrize("cores", [1, 3])
def test_threads_change_no_bit(cores: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "cores", lambda: cores)
    function = every_operation()
    rows = table(4 * evaluation.SHARE + 11)
    require_same(evaluation.evaluate_rows(function, SHARED, rows), call_rows(function, SHARED, rows))


def test_a_function_of_matrices_stays_as_it_is() -> None:
    x = ca.MX.sym("x", 3)
    function = ca.Function("matrices", [x], [ca.sum1(x) * x])
    require_same(evaluation.evaluate_rows(function, [], table(2500)), call_rows(function, [], table(2500)))


@pytest.mark.parametrize("name", ["position", "pose", "distance", "cable", "joints"])
def test_ready_measurements(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = ro.load(name).problem
    x = 0.3 * problem.parameters.free.scale
    slow = problem.linearize(x)
    monkeypatch.setattr(evaluation, "PAYS", 1)
    quick = problem.linearize(x)
    assert np.array_equal(quick.A, slow.A)
    assert np.array_equal(quick.b, slow.b)
