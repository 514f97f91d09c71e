"""Selectors against what they say they minimize, on data whole and with blunders, and what they say at an edge."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.convex.program import Program
from rpim_opt.convex.rules.curve import menger
from rpim_opt.convex.rules.folds import held_out_error
from rpim_opt.convex.rules.selection import weight_grid
from rpim_opt.convex.select import SELECTORS
from rpim_opt.problem import LinearModel
from tests.convex.test_formulation import model
from tests.simulate import simulated

NOISY = model(rows=60, condition=30.0).scaled(np.full(60, 100.0))
"""Declared noise about as large as the noise that is in it."""
PROGRAM = ro.convex.pose(ro.tikhonov, NOISY)
FREE = ro.Formulation("three free", penalty=lambda z: cp.sum_squares(z[3:] - 0.1))


def influence(m: LinearModel, weight: float, D: np.ndarray) -> np.ndarray:
    return m.A @ np.linalg.solve(m.A.T @ m.A + weight * D, m.A.T)


def residual(m: LinearModel, weight: float, D: np.ndarray, centre: float) -> np.ndarray:
    z = np.linalg.solve(m.A.T @ m.A + weight * D, m.A.T @ m.b + weight * centre * np.diag(D))
    return m.A @ z - m.b


def gcv(m: LinearModel, weight: float, D: np.ndarray, centre: float) -> float:
    r = residual(m, weight, D, centre)
    return float(r @ r / (len(m.b) - np.trace(influence(m, weight, D))) ** 2)


def misfit(m: LinearModel, weight: float, D: np.ndarray, centre: float) -> float:
    r = residual(m, weight, D, centre)
    return float(np.log(r @ r / (1.1**2 * (len(m.b) - np.trace(influence(m, weight, D))))))


def change(m: LinearModel, weight: float, D: np.ndarray, centre: float) -> float:
    """|w dz/dw|^2 in the penalty's units, from differences."""

    def z(t: float) -> np.ndarray:
        w = weight * np.exp(t)
        return np.linalg.solve(m.A.T @ m.A + w * D, m.A.T @ m.b + w * centre * np.diag(D))

    return float(np.sum((D @ (z(1e-4) - z(-1e-4)) / 2e-4) ** 2))


def left_out(m: LinearModel, weight: float, D: np.ndarray, centre: float) -> float:
    total = 0.0
    for g in np.unique(m.group):
        seen = m.group != g
        part = LinearModel(m.A[seen], m.b[seen], m.group[seen], m.parameters)
        z = np.linalg.solve(part.A.T @ part.A + weight * D, part.A.T @ part.b + weight * centre * np.diag(D))
        total += float(np.sum((m.A[~seen] @ z - m.b[~seen]) ** 2))
    return total


SCORES: dict[str, Any] = {
    "gcv": gcv,
    "discrepancy": misfit,
    "quasi_optimality": change,
    "leave_one_out": left_out,
}


@pytest.mark.parametrize("name", SCORES)
@pytest.mark.parametrize("free", [False, True])
def test_a_score_is_what_it_says(name: str, free: bool) -> None:
    """Also where the penalty leaves directions free, and is measured from a centre that is not nominal."""
    formulation, D, centre = ro.tikhonov, np.eye(12), 0.0
    if free:
        formulation, D, centre = FREE, np.diag([0.0] * 3 + [1.0] * 9), 0.1
    chosen = SELECTORS[name](ro.convex.pose(formulation, NOISY))
    for k in (40, 100, 150):
        want = SCORES[name](NOISY, chosen.weights[k], D, centre)
        assert chosen.score[k] == pytest.approx(want, rel=1e-5, abs=1e-9), k
    if name not in ("discrepancy", "quasi_optimality") and chosen.interior:
        around = [SCORES[name](NOISY, chosen.weight * f, D, centre) for f in (0.9, 1.0, 1.1)]
        assert around[1] == min(around)
        assert around[1] <= chosen.score.min() * (1 + 1e-6)
        assert chosen.note
        assert "best" not in chosen.note


def test_the_discrepancy_chosen_is_where_the_misfit_is_the_noises() -> None:
    chosen = ro.select.discrepancy(PROGRAM)
    assert chosen.interior
    assert misfit(NOISY, chosen.weight, np.eye(12), 0.0) == pytest.approx(0.0, abs=1e-3)
    large = ro.select.discrepancy(ro.convex.pose(ro.tikhonov, NOISY.scaled(np.full(60, 1e-4))))
    assert (large.interior, large.weight) == (False, large.weights[-1])
    assert "stated too large" in large.note
    small = ro.select.discrepancy(ro.convex.pose(ro.tikhonov, NOISY.scaled(np.full(60, 1e4))))
    assert (small.interior, small.weight) == (False, small.weights[0])
    assert "too small" in small.note


def test_a_grid_spans_what_the_data_see() -> None:
    s = np.linalg.svd(NOISY.A)[1]
    weights = weight_grid(PROGRAM)
    assert (weights[0], weights[-1]) == pytest.approx((1e-4 * s[-1] ** 2, 10 * s[0] ** 2), rel=1e-9)
    assert len(weights) == 200
    assert len(weight_grid(ro.convex.pose(ro.robust, NOISY), 7)) == 7
    robust = weight_grid(ro.convex.pose(ro.robust, NOISY))
    assert robust == pytest.approx(weights, rel=1e-9)
    with pytest.raises(ro.InputError, match="no sensitivity to any identified parameter"):
        weight_grid(ro.convex.pose(ro.tikhonov, NOISY.scaled(np.zeros(60))))


def test_edges_are_said() -> None:
    """Exact data want no penalty, pure noise no deviation."""
    exact = ro.convex.pose(ro.tikhonov, NOISY.with_values(NOISY.A @ np.ones(12)))
    lower = ro.gcv(exact)
    assert (lower.weight, lower.interior) == (lower.weights[0], False)
    assert "smallest weight of the grid is best" in lower.note
    U = np.linalg.svd(NOISY.A)[0]
    noise = ro.convex.pose(ro.tikhonov, NOISY.with_values(U[:, 12] + 1e-3 * U[:, 0]))
    upper = ro.gcv(noise)
    assert (upper.weight, upper.interior) == (upper.weights[-1], False)
    assert "largest weight of the grid is best" in upper.note
    none = ro.reml(noise)
    assert (none.weight, none.interior) == (1.0, False)
    assert "stated noise and scales are used" in none.note


@pytest.mark.parametrize(("best", "said"), [(0, "lower edge"), (1, ""), (100, ""), (198, ""), (199, "upper edge")])
def test_a_corner_at_an_edge_is_none(best: int, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    grid = weight_grid(PROGRAM)

    def curvature(program: Any, weights: np.ndarray) -> np.ndarray:
        return 5.0 - np.abs(np.log(weights / grid[best]))

    monkeypatch.setattr("rpim_opt.convex.rules.curve._curvature", curvature)
    chosen = ro.l_curve(PROGRAM)
    assert chosen.weight == pytest.approx(grid[best], rel=1e-5)
    assert chosen.interior == (not said)
    assert said in chosen.note
    monkeypatch.setattr(
        "rpim_opt.convex.rules.curve._curvature", lambda program, weights: -curvature(program, weights) - 99
    )
    none = ro.l_curve(PROGRAM)
    assert (none.weight, none.interior) == (grid[0], False)


@pytest.mark.parametrize("rule", [ro.l_curve, ro.corner, ro.gcv, ro.k_fold])
def test_every_rule_sees_a_robust_loss_as_the_squares_of_its_inliers(rule: Any) -> None:
    model = simulated(configurations=30, noise=1e-4, seed=3)[0].linearize(np.zeros(34))
    program = ro.convex.pose(ro.robust, model)
    chosen = rule(program)
    squares = ro.convex.pose(ro.tikhonov, program.inlier_model(program.solve(chosen.weight).z))
    assert abs(np.log(rule(squares).weight / chosen.weight)) < 0.03  # the rounds end within 2 %


def test_curvature_of_a_small_circle_and_of_a_point() -> None:
    t = np.linspace(0, 2, 50)
    circle = 3e-5 * np.column_stack([np.cos(t), np.sin(t)])
    assert menger(circle)[1:-1] == pytest.approx(1 / 3e-5, rel=1e-6)
    assert (menger(np.ones((5, 2))) == 0).all()
    assert menger(circle)[[0, -1]].tolist() == [0.0, 0.0]


def blundered() -> LinearModel:
    b = NOISY.b.copy()
    b[[4, 20]] += 1e3
    return NOISY.with_values(b)


@pytest.mark.parametrize("rule", [ro.reml, ro.gcv])
@pytest.mark.parametrize("price", [1.0, np.geomspace(1.0, 50.0, 12)])
def test_a_robust_choice_is_that_of_its_inliers(rule: Any, price: Any) -> None:
    """A fixed point: the squares of the inliers at the chosen weight choose the same again."""

    def penalty(z: Any) -> Any:
        return cp.sum_squares(cp.multiply(price, z))

    program = ro.convex.pose(replace(ro.robust, penalty=penalty), blundered())
    chosen = rule(program)
    kept = program.inlier_model(program.solve(chosen.weight).z)
    again = rule(ro.convex.pose(replace(ro.tikhonov, penalty=penalty), kept))
    assert chosen.interior
    assert abs(np.log(again.weight / chosen.weight)) < 0.05
    without = rule(ro.convex.pose(ro.tikhonov, blundered()))
    assert abs(np.log(without.weight / chosen.weight)) > 1


def test_held_out_errors_of_a_robust_loss_are_medians() -> None:
    program = ro.convex.pose(ro.robust, blundered())
    norms = []
    for g in np.unique(NOISY.group):
        out = program.model.group == g
        z = program.on(program.model.scaled(np.where(out, 0.0, 1.0))).solve(2.0).z
        norms.append(np.linalg.norm(program.model.A[out] @ z - program.model.b[out]))
    assert held_out_error(program)(np.array([2.0]))[0] == pytest.approx(np.median(norms), rel=1e-6)


def test_folds_hold_configurations_out_together() -> None:
    groups = np.unique(NOISY.group)
    weights = np.array([0.5, 50.0])
    squares = np.zeros(2)
    parts = np.array_split(np.random.default_rng(3).permutation(groups), 4)
    for part in parts:
        out = np.isin(NOISY.group, part)
        for k, w in enumerate(weights):
            A, b = NOISY.A[~out], NOISY.b[~out]
            z = np.linalg.solve(A.T @ A + w * np.eye(12), A.T @ b)
            squares[k] += np.sum((NOISY.A[out] @ z - NOISY.b[out]) ** 2)
    assert held_out_error(PROGRAM, parts)(weights) == pytest.approx(np.sqrt(squares / 60), rel=1e-9)
    chosen = ro.k_fold(PROGRAM, folds=4, seed=3)
    assert chosen.score == pytest.approx(held_out_error(PROGRAM, parts)(chosen.weights), rel=1e-9)
    assert chosen.weight == chosen.weights[np.argmin(chosen.score)]
    assert len(chosen.weights) == 200


def test_folds_are_not_more_than_configurations() -> None:
    assert ro.k_fold(PROGRAM, folds=20).name == "k_fold"
    with pytest.raises(ro.InputError, match="20 configurations, accepted: at least 21"):
        ro.k_fold(PROGRAM, folds=21)
    one = replace(NOISY, group=np.zeros(60, dtype=int))
    with pytest.raises(ro.InputError, match="one configuration"):
        held_out_error(ro.convex.pose(ro.tikhonov, one))


@pytest.mark.parametrize(("values", "edge"), [("exact", "lower"), ("noise", "upper")])
def test_a_search_by_holding_out_says_its_edges(values: str, edge: str) -> None:
    b = NOISY.A @ np.ones(12)
    if values == "noise":
        b = np.random.default_rng(1).normal(size=60)
    program = ro.convex.pose(ro.tikhonov, NOISY.with_values(b))
    chosen = ro.k_fold(program)
    if edge == "lower":
        assert (chosen.weight, chosen.interior) == (chosen.weights[0], False)
        assert "smallest weight of the grid is best" in chosen.note
    elif not chosen.interior:
        assert chosen.weight == chosen.weights[-1]
        assert "largest weight of the grid is best" in chosen.note


def of_few() -> Program:
    """Return a program of twelve configurations, whose residual falls below the corner of its L-curve, too."""
    problem = ro.load("position").problem.on(ro.load("position").problem.data.take(np.arange(12)))
    return ro.convex.pose(ro.tikhonov, problem.linearize(np.zeros(len(problem.parameters.free))))


@pytest.mark.parametrize(("program", "steps"), [(PROGRAM, 0), (of_few(), 3)], ids=["at the corner", "below it"])
def test_two_steps_are_those_of_the_paper(program: Program, steps: int) -> None:
    chosen = ro.two_step(program)
    coarse = np.geomspace(ro.l_curve(program).weight, 1e-10 * ro.l_curve(program).weight, 30)
    norms = np.sqrt([e.loss for e in program.path(coarse)])
    level = next(w for k, w in enumerate(coarse[:-1]) if norms[k + 1] >= 0.99 * norms[k])
    assert level == coarse[steps]
    assert chosen.weights == pytest.approx(level * np.linspace(0.563, 5.063, 10) / 3.063, rel=1e-9)
    assert chosen.score == pytest.approx(held_out_error(program)(chosen.weights), rel=1e-9)
    k = int(np.argmin(chosen.score))
    assert chosen.weight == chosen.weights[k]
    assert chosen.interior == (0 < k < 9)
    assert ("a wider range of weights may be better" in chosen.note) != chosen.interior


def test_all_selectors_are_compared_where_they_are_quick() -> None:
    assert set(ro.select.compare(PROGRAM)) == set(SELECTORS)
    lasso = ro.select.compare(ro.convex.pose(ro.lasso, NOISY))
    assert set(lasso) == {"l_curve", "corner"}


def test_frames_tell_nothing_of_how_large_deviations_are() -> None:
    problem, _ = simulated(noise=5e-5)
    m = problem.linearize(np.zeros(len(problem.parameters.free)))
    frames = m.parameters.of_frames
    assert frames.any()
    shifted = m.with_values(m.b + m.A[:, frames] @ np.full(int(frames.sum()), 50.0))
    pair = [ro.reml(ro.convex.pose(ro.tikhonov, each)).weight for each in (m, shifted)]
    assert pair[0] == pytest.approx(pair[1], rel=1e-3)


def test_a_corner_by_sections_is_found_to_a_hundredth() -> None:
    """Of ln weight: both neighbours of the corner that were solved are as near, and the grid's corner is the same."""
    chosen = ro.corner(PROGRAM)
    t = np.log(chosen.weights)
    k = int(np.argmin(np.abs(t - np.log(chosen.weight))))
    assert 0 < k < len(t) - 1
    assert t[k + 1] - t[k - 1] <= 0.01 * (1 + 1e-9)
    program = ro.convex.pose(ro.tikhonov, model(condition=1e5))
    assert abs(np.log(ro.corner(program).weight / ro.l_curve(program).weight)) < 0.5
