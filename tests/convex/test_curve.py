"""The L-curve: its curvature is that of the points, its corners are sought where they are, in as few steps as said."""

from __future__ import annotations

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.convex import select_curve
from rpim_opt.convex.select_curve import (
    _between,
    _by_golden_sections,
    _curvature,
    _first_corner,
    _peaks,
    menger,
)
from rpim_opt.convex.selection import weight_grid
from tests.convex.test_select import NOISY, PROGRAM
from tests.simulate import simulated


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


def test_a_score_is_the_curvature_of_the_points_that_were_solved() -> None:
    model = simulated(configurations=20, noise=1e-4, seed=1)[0].linearize(np.zeros(34))
    program = ro.convex.pose(ro.lasso, model)
    weights = weight_grid(program, 12)[:-1]  # at the last one the penalty is zero, which has no logarithm
    path = program.path(weights)
    points = [[0.5 * np.log(each.loss), 0.5 * np.log(each.penalty)] for each in path]
    assert select_curve._on_grid(program, weights)[1] == pytest.approx(menger(np.array(points)), rel=1e-9)


@pytest.mark.parametrize(
    ("formulation", "kinks"), [(ro.robust, False), (ro.sum_of_norms, True)], ids=["robust", "norms"]
)
def test_a_path_that_meets_a_kink_is_looked_at_all_over_the_grid(formulation: ro.Formulation, kinks: bool) -> None:
    """Where configurations are met exactly, a path bends in jumps, and large steps may miss its sharpest corner."""
    model = simulated(configurations=15, noise=1e-4, seed=1)[0].linearize(np.zeros(34))
    weights = weight_grid(ro.convex.pose(ro.tikhonov, model), 40)
    path = ro.convex.pose(formulation, model).path(weights)
    met = [np.min(program_norms) <= 1e-3 * np.median(program_norms)
           for program_norms in (ro.convex.pose(formulation, model).norms(each.z) for each in path)]  # fmt: skip
    assert any(met) == kinks
    some, score = select_curve._on_grid(ro.convex.pose(formulation, model), weights)
    assert (len(some) == len(weights)) == kinks
    whole = menger(0.5 * np.log([[each.loss, each.penalty] for each in path]))
    assert some[np.argmax(score)] == weights[np.argmax(whole)]
    assert score.max() == pytest.approx(whole.max(), rel=1e-3)


def test_about_a_corner_two_weights_on_both_sides_are_looked_at_and_its_neighbours() -> None:
    some = [0, 4, 8, 9, 12, 16, 19]
    expected = {1: range(9), 2: range(4, 11), 3: range(7, 13), 4: range(9, 17), 5: range(12, 20)}
    assert {k: _between(some, k, 19) for k in expected} == expected
    assert _between([0, 1, 2], 1, 2) == range(3)
    assert _between([0, 1, 2, 3, 4], 2, 4) == range(5)


def test_corners_are_what_is_about_as_sharp_as_the_sharpest() -> None:
    score = np.array([9.0, 1.0, 3.0, 2.0, 4.0, 4.0, 2.5, 2.6, 0.0, 1.9, 1.0, 8.0])
    assert _peaks(score).tolist() == []  # the largest of all is at the end, where no corner is
    inside = np.array([0.0, 1.0, 3.0, 2.0, 4.0, 4.0, 1.5, 1.6, 0.0, 1.9, 1.0, 2.0])
    assert _peaks(inside).tolist() == [2, 4, 5]
    assert _peaks(-inside).tolist() == []
    assert _first_corner(inside) == 2
    assert _first_corner(inside - 1.5 * (np.arange(12) == 2)) == 5  # the end of a flat top
    assert _first_corner(np.arange(5.0)) == 4


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
    found = _by_golden_sections(curve, -7.0, 5.0, 0.01)  # type: ignore[arg-type]
    assert found == pytest.approx(top, abs=0.01)
    steps = np.log(12.0 / 0.01) / np.log((1 + np.sqrt(5)) / 2)
    assert len(curve.asked) <= steps + 5
    beside = sorted(curve.asked)
    k = beside.index(found)
    assert beside[min(k + 1, len(beside) - 1)] - beside[max(k - 1, 0)] <= 0.01 * (1 + 1e-9)


@pytest.mark.parametrize("top", [-6.0, -4.5])
def test_the_flat_end_is_cut_off(top: float) -> None:
    assert _by_golden_sections(Peak(top, flat=-4.0), -7.0, 50.0, 0.01) == pytest.approx(top, abs=0.01)  # type: ignore[arg-type]


def test_a_curve_that_bends_the_other_way_everywhere_ends() -> None:
    found = _by_golden_sections(Peak(0.0, flat=-np.inf), 1.0, 5.0, 0.01)  # type: ignore[arg-type]
    assert 1.0 < found < 5.0


@pytest.mark.parametrize(("inside", "interior"), [(0.05, False), (0.2, True), (-0.2, True), (-0.05, False)])
def test_a_corner_by_sections_at_an_edge_is_none(
    inside: float, interior: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def at_edge(curve: select_curve._Curve, low: float, high: float, tolerance: float) -> float:
        best = {True: low, False: high}[inside > 0] + inside
        for t in (best - 0.01, best, best + 0.01):
            curve.point(t)
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
