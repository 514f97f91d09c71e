"""Programs brought to Clarabel's form once: the same minimum as CVXPY's, in other variables, units and weights."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
from scipy import sparse

from rpim_opt.convex.conic import ATTEMPTS, Conic, _Affine, _blocks, _Pattern

N, K = 5, 4
RNG = np.random.default_rng(8)
T = RNG.normal(size=(N + 2, K))
C = RNG.normal(size=N + 2)
H = np.diag(np.arange(1.0, K + 1))
G = RNG.normal(size=K)


def stated(kind: str) -> tuple[Any, Any, list[Any], list[cp.Variable], cp.Parameter]:
    """An objective with a weight in it, in v (5,) and w (2,); constraints of several cones."""
    v, w, weight = cp.Variable(N), cp.Variable(2), cp.Parameter(nonneg=True)
    first: Any = cp.norm1(v) + cp.sum_squares(w - 1.0)
    second: Any = cp.sum_squares(v[:3] - w[0]) + cp.norm(w)
    constraints: list[Any] = [v[0] + w[1] <= 0.3, cp.norm(v[1:4]) <= 2.0, v[4] + v[3] == 0.1]
    if kind == "exponential":
        second = second + cp.log_sum_exp(v[:3])
    if kind == "matrix":
        constraints.append(cp.bmat([[v[0] + 4.0, w[0]], [w[0], 2.0]]) >> 0)
    return first, second, constraints, [v, w], weight


@pytest.mark.parametrize("kind", ["plain", "exponential", "matrix"])
@pytest.mark.parametrize("weight", [0.0, 0.5, 3.0])
def test_the_minimum_is_that_of_cvxpy(kind: str, weight: float) -> None:
    first, second, constraints, (v, w), price = stated(kind)
    program = Conic(first + price * second, constraints, [v, w], price)
    u = cp.Variable(K)
    x = T @ u + C
    tied = [v == x[:N], w == x[N:]]
    added = 0.5 * cp.quad_form(u, H) + G @ u
    written = cp.Problem(cp.Minimize(first + weight * second + added), constraints + tied)
    written.solve(solver=cp.CLARABEL, tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11)
    for size in (1.0, 100.0):
        for attempt in range(4):
            found = program.solve(T, C, weight, H, G, size, attempt)
            assert found.status == cp.OPTIMAL
            assert found.u == pytest.approx(np.asarray(u.value), abs=2e-4)  # the root of 1e-8
            assert np.append(*(program.values(found, each) for each in (v, w))) == pytest.approx(T @ found.u + C)
            assert found.iterations > 0
            assert 0 < found.seconds < 10
            got = program.multipliers(found, constraints[0])
            assert got == pytest.approx(np.ravel(constraints[0].dual_value), abs=1e-3)
            assert np.abs(program.multipliers(found, constraints[2])) == pytest.approx(
                np.abs(np.ravel(constraints[2].dual_value)), abs=1e-3
            )


def test_a_program_is_solved_for_unknowns_of_any_number() -> None:
    first, second, constraints, (v, w), price = stated("plain")
    program = Conic(first + price * second, constraints, [v, w], price)
    few = program.solve(T[:, :3], C, 1.0, np.eye(3), np.zeros(3))
    again = program.solve(T, C, 1.0, H, G)
    assert (len(few.u), len(again.u)) == (3, K)
    assert program.solve(T[:, :3], C, 1.0, np.eye(3), np.zeros(3)).u == pytest.approx(few.u, abs=1e-12)


def test_what_is_not_of_the_variables_has_its_value() -> None:
    v, slack = cp.Variable(N, name="v"), cp.Variable(N, name="slack")
    program = Conic(cp.sum(slack), [slack >= v, slack >= -v], [v], None)
    found = program.solve(np.zeros((N, 0)), np.arange(N) - 2.0, 0.0, np.empty((0, 0)), np.empty(0))
    assert program.values(found, slack) == pytest.approx(np.abs(np.arange(N) - 2.0), abs=1e-8)


def test_variables_that_do_not_occur_are_passed_over() -> None:
    unused, v = cp.Variable(2), cp.Variable(N)
    program = Conic(cp.sum_squares(v - 1.0), [], [unused, v], None)
    lift = np.vstack([np.full((2, N), 7.0), np.eye(N)])
    found = program.solve(lift, np.zeros(N + 2), 0.0, np.zeros((N, N)), np.zeros(N))
    assert found.u == pytest.approx(np.ones(N), abs=1e-8)


@pytest.mark.parametrize("unit", [1e-8, 1.0, 1e8])
def test_a_constraints_unit_changes_nothing(unit: float) -> None:
    v = cp.Variable(N)
    program = Conic(cp.sum_squares(v - 1.0), [unit * cp.norm(v) <= unit * 0.5, unit * v[0] <= 0.1 * unit], [v], None)
    found = program.solve(np.eye(N), np.zeros(N), 0.0, np.zeros((N, N)), np.zeros(N))
    rest = np.sqrt((0.25 - 0.01) / (N - 1))
    assert found.u == pytest.approx(np.array([0.1, *[rest] * (N - 1)]), abs=1e-7)


def test_infeasible_and_unbounded_are_said() -> None:
    v = cp.Variable(N)
    nothing = Conic(cp.sum_squares(v), [cp.sum(v) >= 1.0, cp.sum(v) <= 0.0], [v], None)
    assert nothing.solve(np.eye(N), np.zeros(N), 0.0, np.zeros((N, N)), np.zeros(N)).status == cp.INFEASIBLE
    endless = Conic(cp.sum(v), [v[0] <= 0.0], [v], None)
    assert endless.solve(np.eye(N), np.zeros(N), 0.0, np.zeros((N, N)), np.zeros(N)).status == cp.UNBOUNDED


def test_rows_are_scaled_alone_and_cones_as_a_whole() -> None:
    dims = SimpleNamespace(zero=2, nonneg=1, soc=[3, 4], psd=[3], exp=1, p3d=[0.5])
    rows = [0, 1, 2, 3, 6, 10, 16, 19]
    assert _blocks(dims, 22).tolist() == rows
    assert _blocks(dims, 27).tolist() == [*rows, 22]


def test_an_objective_in_other_unknowns_has_its_value() -> None:
    """Of x, some are T u + c and the others stay, products of both kinds among them."""
    own, rest = np.array([1, 4, 5]), np.array([0, 2, 3, 6])
    M = RNG.normal(size=(7, 7)) * (RNG.random((7, 7)) < 0.6)
    P, dP = M @ M.T, np.diag(np.arange(7.0))
    q, dq = RNG.normal(size=7), RNG.normal(size=7)
    lift, shift, H, g = RNG.normal(size=(3, 2)), RNG.normal(size=3), np.eye(2), np.array([1.0, -2.0])
    affine = _Affine(sparse.csc_array(P), sparse.csc_array(dP), q, dq, own, rest)
    pattern = _Pattern(affine.places(2), (6, 6))
    for weight in (0.0, 0.7):
        numbers, slope = affine.at(lift, shift, weight, H, g)
        upper = pattern.filled(numbers).toarray()
        whole = upper + upper.T - np.diag(np.diag(upper))

        def ours(y: np.ndarray, whole: np.ndarray = whole, slope: np.ndarray = slope) -> float:
            return float(0.5 * y @ whole @ y + slope @ y)

        def theirs(y: np.ndarray, weight: float = weight) -> float:
            x = np.zeros(7)
            x[own], x[rest] = lift @ y[:2] + shift, y[2:]
            added = 0.5 * y[:2] @ H @ y[:2] + g @ y[:2]
            return float(0.5 * x @ (P + weight * dP) @ x + (q + weight * dq) @ x + added)

        for y in RNG.normal(size=(5, 6)):
            assert ours(y) == pytest.approx(theirs(y) - theirs(np.zeros(6)), rel=1e-9)
        assert (np.tril(upper, -1) == 0).all()


@pytest.mark.parametrize("attempt", range(len(ATTEMPTS)))
def test_what_is_added_has_its_value_in_whatever_units_it_is_solved(attempt: int) -> None:
    """Variables that are not of u, of sizes from a thousandth to a thousand."""
    v, slack = cp.Variable(N, name="v"), cp.Variable(N, name="slack")
    size = np.geomspace(1e-3, 1e3, N)
    bounds = [slack >= cp.multiply(size, v), slack >= -cp.multiply(size, v)]
    program = Conic(cp.sum(slack), bounds, [v], None)
    values = np.arange(N) - 1.5
    found = program.solve(np.zeros((N, 0)), values, 0.0, np.empty((0, 0)), np.empty(0), attempt=attempt)
    assert program.values(found, slack) == pytest.approx(size * np.abs(values), rel=1e-4)
    assert program.values(found, v) == pytest.approx(values, rel=1e-12)
