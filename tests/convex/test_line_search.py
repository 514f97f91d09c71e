"""A search along a line: a small slope in few points, whatever the convex function."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from rpim_opt.convex.line_search import TRIES, _between, searched

SLOPES: dict[str, Callable[[float], float]] = {
    "a square, its minimum in between": lambda t: 2 * (t - 0.4),
    "a square, its minimum near": lambda t: 2 * (t - 0.003),
    "a square, its minimum at one": lambda t: 2 * (t - 1.0),
    "a square, its minimum beyond": lambda t: 2 * (t - 7.0),
    "a corner": lambda t: -1.0 + 20 * max(t - 0.6, 0.0),
    "an exponential": lambda t: np.exp(3 * t) - 4.0,
}


def search(slope: Callable[[float], float], longer: bool = True) -> tuple[float, list[float]]:
    asked: list[float] = []

    def at(t: float) -> float:
        asked.append(t)
        return t

    return searched(at, slope, 0.0, longer), asked


@pytest.mark.parametrize("name", SLOPES)
def test_the_slope_is_a_third_of_the_first_or_less(name: str) -> None:
    slope = SLOPES[name]
    found, asked = search(slope)
    assert abs(slope(found)) <= 0.3 * abs(slope(0.0))
    assert len(asked) <= TRIES
    assert asked[0] == 1.0
    assert len(set(asked)) == len(asked)


def test_the_full_step_is_taken_where_it_will_do() -> None:
    assert search(lambda t: 2 * (t - 1.2)) == (1.0, [1.0])
    assert search(lambda t: 2 * (t - 0.8)) == (1.0, [1.0])


def test_no_longer_step_is_tried_where_none_may_be() -> None:
    """In a box the full step is as far as it goes, though the function falls still."""
    assert search(lambda t: t - 7.0, longer=False) == (1.0, [1.0])
    assert search(lambda t: t - 7.0)[0] > 4.0


@pytest.mark.parametrize("first", [0.0, 1.0, np.nan])
def test_nothing_is_tried_where_the_function_does_not_fall(first: float) -> None:
    assert search(lambda t: first) == (0.0, [])


def test_where_nothing_is_known_behind_a_wall_the_bracket_is_halved() -> None:
    """Infinite slopes: the last point at which the function falls, after so many tries."""
    found, asked = search(lambda t: np.inf if t > 0.1 else -1.0)
    assert asked[:4] == [1.0, 0.5, 0.25, 0.125]
    assert 0.05 < found <= 0.1
    assert len(asked) == TRIES


def test_the_next_point_is_where_the_secant_vanishes_and_off_the_ends() -> None:
    assert _between(0.0, -1.0, np.inf, np.inf, halved=False) == 0.0
    assert _between(1.0, -1.0, np.inf, np.inf, halved=True) == 2.0
    assert _between(1.0, -1.0, 3.0, 3.0, halved=False) == pytest.approx(1.5)
    assert _between(1.0, -1.0, 3.0, 3.0, halved=True) == 2.0
    assert _between(1.0, -1.0, 3.0, np.inf, halved=False) == 2.0
    assert _between(1.0, -1.0, 3.0, 1e9, halved=False) == pytest.approx(1.1)  # a twentieth from the end
    assert _between(1.0, -1e9, 3.0, 1.0, halved=False) == pytest.approx(2.9)
