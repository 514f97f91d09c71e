"""Vectorized functions: the bits of one row after the other, for every operation, number of rows and thread."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics import threads
from rpim_opt.robot import kinematics
from rpim_opt.robot.kinematics import SHARE, call_rows

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


def both_ways(
    function: ca.Function, shared: list[np.ndarray], rows: np.ndarray, patch: pytest.MonkeyPatch
) -> list[np.ndarray]:
    """Require that the vectorized function has the bits of one row after the other, and return them."""
    patch.setattr(kinematics, "PAYS", np.inf)
    single = call_rows(function, shared, rows)
    patch.setattr(kinematics, "PAYS", 1)
    wide = call_rows(function, shared, rows)
    for a, b in zip(single, wide, strict=True):
        assert a.shape == b.shape
        assert np.array_equal(a, b)
    return wide


@pytest.mark.parametrize("N", [1, 255, 256, 257, 9000])
def test_vectorized_functions_have_the_bits_of_one_after_the_other(N: int, monkeypatch: pytest.MonkeyPatch) -> None:
    function = every_operation()
    values = both_ways(function, SHARED, table(N), monkeypatch)[0]
    assert np.array_equal(values[-1].T, function(*SHARED, table(N)[-1])[0].full())


def test_what_is_shared_may_change_and_may_be_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = table(300)
    function = every_operation()
    first = both_ways(function, SHARED, rows, monkeypatch)
    both_ways(function, [SHARED[0] + 1, SHARED[1]], rows, monkeypatch)
    again = call_rows(function, SHARED, rows)  # none of it stayed
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    row = ca.SX.sym("row", 3)
    both_ways(ca.Function("alone", [row], [ca.sin(row) * row]), [], rows, monkeypatch)


@pytest.mark.parametrize("cores", [1, 3])
def test_threads_change_no_bit(cores: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threads, "cores", lambda: cores)
    both_ways(every_operation(), SHARED, table(4 * SHARE + 11), monkeypatch)


def test_a_function_of_matrices_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    x = ca.MX.sym("x", 3)
    both_ways(ca.Function("matrices", [x], [ca.sum1(x) * x]), [], table(2500), monkeypatch)


@pytest.mark.parametrize("name", ["position", "pose", "distance", "cable", "joints"])
def test_ready_measurements(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    problem = ro.load(name).problem
    problem = problem.on(problem.data.take(np.arange(300) % len(problem.data)))
    x = 0.3 * problem.parameters.free.scale
    slow = problem.linearize(x)
    monkeypatch.setattr(kinematics, "PAYS", 1)
    quick = problem.linearize(x)
    assert np.array_equal(quick.A, slow.A)
    assert np.array_equal(quick.b, slow.b)
