"""The L-curve: its curvature is that of the points, its corners are sought where they are, in as few steps as said."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.convex.rules import curve as select_curve
from rpim_opt.convex.rules.curve import (
    _by_golden_sections,
    _curvature,
    menger,
)
from rpim_opt.convex.rules.selection import weight_grid
from tests.convex.test_select import NOISY, PROGRAM


def lengths(z: Array, model: ro.problem.LinearModel = NOISY) -> Array:
    """ln |A z - b| and ln |z|, as the docstring has them."""
    return np.log([np.linalg.norm(model.A @ z - model.b), np.linalg.norm(z)])


def test_the_curvature_is_that_of_the_curve() -> None:
    """Of the circle through three near points on it, all over the grid, with its sign."""
    weights = weight_grid(PROGRAM, 25)
    found = _curvature(PROGRAM, weights)
    S, n = NOISY.A.T @ NOISY.A, NOISY.A.shape[1]

    def at(weight: float) -> Array:
        return lengths(np.linalg.solve(S + weight * np.eye(n), NOISY.A.T @ NOISY.b))

    beside = np.exp(1e-2)
    points = np.array([[at(w / beside), at(w), at(w * beside)] for w in weights])
    moving = np.linalg.norm(points[:, 2] - points[:, 0], axis=1) > 1e-5  # elsewhere differences are rounding
    near = np.array([menger(each)[1] for each in points])
    assert np.count_nonzero(moving) > 12
    assert found[moving] == pytest.approx(near[moving], rel=2e-3, abs=2e-3)
    assert found[moving].min() < 0 < found[moving].max()


class Peak:
    """A curve whose curvature is largest at one place, and may be negative beyond another; what was asked is kept."""

    def __init__(self, top: float, flat: float = np.inf):
        self.top = top
        self.flat = flat
        self.asked: set[float] = set()

    def curvature(self, a: float, b: float, c: float) -> float:
        assert a < b < c
        self.asked |= {a, b, c}
        if b > self.flat:
            return -1.0
        return 1.0 / (1.0 + (b - self.top) ** 2)


@pytest.mark.parametrize("top", [-6.9, -3.0, 0.1, 2.5, 4.9])
def test_golden_sections_end_at_the_top_with_one_new_point_a_step(top: float) -> None:
    curve = Peak(top)
    found = _by_golden_sections(curve.curvature, -7.0, 5.0, 0.01)
    assert found == pytest.approx(top, abs=0.01)
    steps = np.log(12.0 / 0.01) / np.log((1 + np.sqrt(5)) / 2)
    assert len(curve.asked) <= steps + 5
    beside = sorted(curve.asked)
    k = beside.index(found)
    assert beside[min(k + 1, len(beside) - 1)] - beside[max(k - 1, 0)] <= 0.01 * (1 + 1e-9)


@pytest.mark.parametrize("top", [-6.0, -4.5])
def test_the_flat_end_is_cut_off(top: float) -> None:
    assert _by_golden_sections(Peak(top, flat=-4.0).curvature, -7.0, 50.0, 0.01) == pytest.approx(top, abs=0.01)


def test_a_curve_that_bends_the_other_way_everywhere_ends() -> None:
    found = _by_golden_sections(Peak(0.0, flat=-np.inf).curvature, 1.0, 5.0, 0.01)
    assert 1.0 < found < 5.0


@pytest.mark.parametrize(("inside", "interior"), [(0.05, False), (0.2, True), (-0.2, True), (-0.05, False)])
def test_a_corner_by_sections_at_an_edge_is_none(
    inside: float, interior: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def at_edge(curvature: Callable[..., float], low: float, high: float, tolerance: float) -> float:
        best = {True: low, False: high}[inside > 0] + inside
        curvature(best - 0.01, best, best + 0.01)
        return best

    monkeypatch.setattr(select_curve, "_by_golden_sections", at_edge)
    chosen = ro.corner(PROGRAM)
    assert chosen.interior == interior
    assert ("no corner" in chosen.note) == (not interior)


def test_a_corner_by_sections_is_found_to_a_hundredth() -> None:
    """Of ln weight: both neighbours of the corner that were solved are as near."""
    chosen = ro.corner(PROGRAM)
    t = np.log(chosen.weights)
    k = int(np.argmin(np.abs(t - np.log(chosen.weight))))
    assert 0 < k < len(t) - 1
    assert t[k + 1] - t[k - 1] <= 0.01 * (1 + 1e-9)
