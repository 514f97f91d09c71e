"""The way down by Newton's steps: quadratics, a curved valley, bounds, saddles, and values that are not numbers."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import lsq_linear, minimize

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.descent import descent

WIDE = np.array([-10.0, -10.0]), np.array([10.0, 10.0])


@dataclass(frozen=True, eq=False)
class Known:
    """A point that was asked for."""

    x: Array
    value: float
    gradient: Array


class Valley:
    """Rosenbrock's function, which counts."""

    def __init__(self) -> None:
        self.asked: list[Array] = []

    def at(self, x: Array) -> Known:
        self.asked.append(x)
        a, b = x
        up = b - a**2
        return Known(x, float((1 - a) ** 2 + 100 * up**2), np.array([2 * (a - 1) - 400 * a * up, 200 * up]))

    @staticmethod
    def curvature(point: Known) -> Array:
        a, b = point.x
        return np.array([[2 - 400 * (b - 3 * a**2), -400 * a], [-400 * a, 200.0]])


@pytest.mark.parametrize("seed", range(20))
def test_a_quadratic_in_a_box_ends_where_bounded_least_squares_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 6
    A, y = rng.normal(size=(9, n)), 3 * rng.normal(size=9)
    low = -rng.uniform(0.1, 1.0, n)
    high = rng.uniform(0.1, 1.0, n)
    start = rng.uniform(low, high)
    start[:2] = low[0], high[1]

    def ask(x: Array) -> Known:
        assert (low <= x).all()
        assert (x <= high).all()
        residual = A @ x - y
        return Known(x, float(residual @ residual), 2 * A.T @ residual)

    way = list(descent(ask, lambda _: 2 * A.T @ A, start, (low, high), 1.0, 1e-14))
    want = lsq_linear(A, y, (low, high), method="bvls", tol=1e-14)
    assert way[-1].value == pytest.approx(2 * want.cost, rel=1e-10)
    assert np.allclose(way[-1].x, want.x, atol=1e-6)
    assert all(after.value < before.value for before, after in pairwise(way))


def test_a_quadratic_that_no_bound_touches_takes_one_step() -> None:
    H = np.array([[4.0, 1.0], [1.0, 3.0]])
    best = np.array([1.0, -2.0])

    def ask(x: Array) -> Known:
        return Known(x, float((x - best) @ H @ (x - best)), 2 * H @ (x - best))

    way = list(descent(ask, lambda _: 2 * H, np.zeros(2), WIDE, 5.0, 1e-12))
    assert len(way) == 2
    assert np.allclose(way[1].x, best)


@pytest.mark.parametrize("start", [(-1.2, 1.0), (5.0, -5.0), (-9.0, 9.0), (0.0, 0.0), (-30.0, 3.0)])
def test_the_curved_valleys_end_is_found(start: tuple[float, float]) -> None:
    valley = Valley()
    last = list(descent(valley.at, valley.curvature, np.array(start), WIDE, 2.0, 1e-16))[-1]
    assert np.allclose(last.x, 1.0, atol=1e-7)
    assert len(valley.asked) < 60


def test_the_curved_valley_asks_for_less_than_scipy_does() -> None:
    valley, scipys = Valley(), Valley()
    start = np.array([-1.2, 1.0])
    last = list(descent(valley.at, valley.curvature, start, WIDE, 2.0, 1e-12))[-1]

    def both(x: Array) -> tuple[float, Array]:
        point = scipys.at(x)
        return point.value, point.gradient

    found = minimize(both, start, jac=True, method="L-BFGS-B", options={"ftol": 1e-12})
    assert last.value <= found.fun + 1e-12
    assert len(valley.asked) < len(scipys.asked)


@pytest.mark.parametrize("start", [(-1.2, 1.0), (0.5, 0.2), (-2.0, -1.0), (0.5, 2.0)])
def test_a_minimum_at_a_bound_has_a_slope_out_of_the_box(start: tuple[float, float]) -> None:
    """The valley's end lies outside; along the bound a = 0.5 the lowest is b = 0.25."""
    box = np.array([-2.0, -1.0]), np.array([0.5, 2.0])
    valley = Valley()
    last = list(descent(valley.at, valley.curvature, np.array(start), box, 2.0, 1e-16))[-1]
    assert np.allclose(last.x, [0.5, 0.25], atol=1e-7)
    assert last.gradient[0] < 0
    assert all((box[0] <= x).all() and (x <= box[1]).all() for x in valley.asked)


def test_a_corner_is_left_at_once_where_nothing_is_lower() -> None:
    box = np.zeros(2), np.ones(2)
    way = list(descent(lambda x: Known(x, float(x.sum()), np.ones(2)), lambda _: np.eye(2), np.zeros(2), box, 1.0, 0.0))
    assert len(way) == 1


def test_steps_lead_away_from_a_saddle() -> None:
    """x^2 - y^2 + y^4: from beside the saddle to one of the minima at y = +-1/sqrt(2)."""

    def ask(x: Array) -> Known:
        a, b = x
        return Known(x, float(a**2 - b**2 + b**4), np.array([2 * a, 4 * b**3 - 2 * b]))

    def curvature(point: Known) -> Array:
        return np.diag([2.0, 12 * point.x[1] ** 2 - 2])

    last = list(descent(ask, curvature, np.array([1.0, -1e-3]), WIDE, 1.0, 1e-14))[-1]
    assert np.allclose(last.x, [0.0, -np.sqrt(0.5)], atol=1e-6)


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_values_that_are_no_numbers_shorten_steps(wrong: float) -> None:
    """-ln x + x^2 with a step far beyond zero: what is asked there is refused."""
    refused = []

    def ask(x: Array) -> Known:
        if x[0] <= 0:
            refused.append(x)
            return Known(x, wrong, np.full(1, wrong))
        return Known(x, float(x[0] ** 2 - np.log(x[0])), 2 * x - 1 / x)

    box = np.full(1, -50.0), np.full(1, 50.0)
    way = list(descent(ask, lambda _: 0.1 * np.eye(1), np.full(1, 20.0), box, 50.0, 1e-13))
    assert refused
    assert all(np.isfinite(point.value) for point in way)
    assert way[-1].x[0] == pytest.approx(np.sqrt(0.5), abs=1e-5)


def test_a_start_that_is_no_number_is_all_there_is() -> None:
    way = list(descent(lambda x: Known(x, np.nan, np.ones(2)), lambda _: np.eye(2), np.zeros(2), WIDE, 1.0, 1e-9))
    assert len(way) == 1


def test_no_number_changes_by_more_than_the_longest_step() -> None:
    valley = Valley()
    way = list(descent(valley.at, valley.curvature, np.array([-5.0, 5.0]), WIDE, 0.5, 1e-12))
    steps = [np.abs(after.x - before.x).max() for before, after in pairwise(way)]
    assert max(steps) == pytest.approx(0.5)
    assert np.allclose(way[-1].x, 1.0, atol=1e-5)


def test_a_promise_that_is_not_kept_ends() -> None:
    """A gradient that lies: steps become shorter until they promise nothing more."""
    asked = []

    def ask(x: Array) -> Known:
        asked.append(x)
        return Known(x, float(np.abs(x).sum()), np.array([-1.0, 0.0]))

    way = list(descent(ask, lambda _: np.eye(2), np.zeros(2), WIDE, 1.0, 1e-6))
    assert len(way) == 1
    assert 2 < len(asked) < 30
