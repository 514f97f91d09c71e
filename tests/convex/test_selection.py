"""Selectors: their formulas, and that they say when there is nothing to find."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.convex.rules.curve import _curvature, menger
from rpim_opt.convex.rules.folds import held_out_error
from rpim_opt.convex.rules.selection import choice, weight_grid
from tests.convex.test_formulation import model
from tests.simulate import simulated


def test_curvature_is_that_of_the_curve() -> None:
    program = ro.convex.pose(ro.tikhonov, model())
    t = np.linspace(-8, 0, 4001)
    u, v = 0.5 * np.log([[e.loss, e.penalty] for e in program.path(np.exp(t))]).T
    u1, v1 = np.gradient(u, t), np.gradient(v, t)
    kappa = (u1 * np.gradient(v1, t) - v1 * np.gradient(u1, t)) / (u1**2 + v1**2) ** 1.5
    inner = slice(10, -10)
    assert _curvature(program, np.exp(t))[inner] == pytest.approx(kappa[inner], rel=2e-3, abs=1e-4)


def test_menger_curvature_of_a_circle() -> None:
    t = np.linspace(0, 2, 50)
    points = 3 * np.column_stack([np.cos(t), np.sin(t)])
    assert menger(points)[1:-1] == pytest.approx(1 / 3, rel=1e-12)
    assert menger(points[::-1])[1:-1] == pytest.approx(-1 / 3, rel=1e-12)


def test_the_corner_is_a_maximum_inside_the_grid() -> None:
    program = ro.convex.pose(ro.tikhonov, model(condition=1e5))
    corner = ro.l_curve(program)
    assert corner.interior
    around = _curvature(program, corner.weight * np.array([0.99, 1.0, 1.01]))
    assert around[1] > max(around[0], around[2])
    assert around[1] >= corner.score.max()


def test_analytic_and_three_point_corners_agree() -> None:
    """A constraint that is never active makes the path numerical, not different."""
    loose = ro.Formulation("loose", penalty=cp.sum_squares, constraints=(lambda z, p: cp.abs(z) <= 1e6,))
    m = model(condition=1e5)
    analytic, numeric = ro.l_curve(ro.convex.pose(ro.tikhonov, m)), ro.l_curve(ro.convex.pose(loose, m))
    step = numeric.weights[1] / numeric.weights[0]
    assert 1 / step**2 < analytic.weight / numeric.weight < step**2


def test_no_corner_is_said() -> None:
    """Equal singular values and exact data: (u, v) bends the other way at every weight."""
    m = model(condition=1.0)
    exact = ro.problem.LinearModel(m.A, m.A @ np.ones(12), m.group, m.parameters)
    choice = ro.l_curve(ro.convex.pose(ro.tikhonov, exact))
    assert not choice.interior
    assert "no corner" in choice.note
    assert choice.weight == choice.weights[0]


def test_the_grid_follows_the_units_of_the_data() -> None:
    m = model()
    program, tenfold = (
        ro.convex.pose(ro.tikhonov, ro.problem.LinearModel(f * m.A, f * m.b, m.group, m.parameters)) for f in (1, 10)
    )
    assert weight_grid(tenfold) == pytest.approx(100 * weight_grid(program))
    assert ro.l_curve(tenfold).weight == pytest.approx(100 * ro.l_curve(program).weight, rel=1e-4)


def test_held_out_error_is_that_of_fits_without_the_configuration() -> None:
    m, weight = model(), 1e-3
    total = 0.0
    for group in range(10):
        seen, out = m.group != group, m.group == group
        A, b = m.A[seen], m.b[seen]
        z = np.linalg.solve(A.T @ A + weight * np.eye(12), A.T @ b)
        total += np.sum((m.A[out] @ z - m.b[out]) ** 2)
    expected = np.sqrt(total / len(m.b))
    assert held_out_error(ro.convex.pose(ro.tikhonov, m))(np.array([weight]))[0] == pytest.approx(expected, rel=1e-9)


def tail(r: Any) -> Any:
    threshold = cp.Variable()
    return threshold + cp.sum(cp.pos(cp.abs(r) - threshold)) / (0.1 * r.size)


@pytest.mark.parametrize(
    "formulation", [ro.minimax, ro.Formulation("tail", loss=tail, penalty=cp.sum_squares)], ids=lambda f: f.name
)
def test_what_rests_on_few_configurations_is_solved_without_each(formulation: ro.Formulation) -> None:
    problem = ro.load("position").problem
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    program = ro.convex.pose(formulation, model)
    expected = []
    for k in range(40):
        out = model.group == k
        z = ro.convex.pose(formulation, model.scaled(np.where(out, 0.0, 1.0))).solve(10.0).z
        expected.append(np.linalg.norm(model.A[out] @ z - model.b[out]))
    assert held_out_error(program)(np.array([10.0]))[0] == pytest.approx(np.median(expected), rel=1e-5)


@pytest.mark.parametrize("rule", [ro.leave_one_out, ro.two_step])
def test_fewer_configurations_than_folds_are_held_out_each(rule: Any) -> None:
    problem = ro.load("paper_arm").problem
    few = problem.on(problem.data.take(np.arange(9)))
    chosen = rule(ro.convex.pose(ro.lasso, few.linearize(np.zeros(len(few.parameters.free)))))
    assert chosen.weight > 0
    assert np.isfinite(chosen.score).all()


@pytest.mark.parametrize("loss", [cp.sum_squares, ro.huber(1.5)])
def test_half_of_a_loss_has_half_of_the_weight(loss: Any) -> None:
    """By the discrepancy principle, too, which compares with the declared noise."""
    problem = ro.load("position").problem
    half = ro.Formulation("half", loss=lambda r: 0.5 * loss(r), penalty=cp.sum_squares)
    linear = problem.linearize(np.zeros(len(problem.parameters.free)))
    whole, halved = (ro.discrepancy(ro.convex.pose(each, linear)).weight for each in (replace(half, loss=loss), half))
    assert halved == pytest.approx(0.5 * whole, rel=1e-6)


def test_two_step_ends_below_the_corner_with_ten_held_out_errors() -> None:
    program = ro.convex.pose(ro.tikhonov, model(condition=1e5))
    choice = ro.two_step(program)
    assert choice.weight < 1.7 * ro.l_curve(program).weight
    assert len(choice.score) == 10
    assert choice.weight == choice.weights[np.argmin(choice.score)]


def test_a_selector_needs_a_penalty() -> None:
    with pytest.raises(ro.InputError, match="without penalty"):
        ro.l_curve(ro.convex.pose(ro.least_squares, model()))


def test_reml_is_the_restricted_likelihood_of_the_normal_model() -> None:
    problem, _ = simulated(noise=5e-5)
    program = ro.convex.pose(ro.tikhonov, problem.linearize(np.zeros(len(problem.parameters.free))))
    model, frames = program.model, program.model.parameters.of_frames
    F, A, b, m = model.A[:, frames], model.A[:, ~frames], model.b, len(model.b)

    def minus_two_log_likelihood(weight: float) -> float:
        # Harville 1974: ln|V| + ln|F' V^-1 F| + (m - f) ln(b' P b), with V = A A' / weight + 1
        V = A @ A.T / weight + np.eye(m)
        inverse = np.linalg.inv(V)
        G = F.T @ inverse @ F
        P = inverse - inverse @ F @ np.linalg.solve(G, F.T @ inverse)
        return np.linalg.slogdet(V)[1] + np.linalg.slogdet(G)[1] + (m - F.shape[1]) * np.log(b @ P @ b)

    chosen = ro.reml(program)
    assert chosen.interior
    tried = chosen.weights[[60, 90, 120, 150]]
    want = np.array([minus_two_log_likelihood(w) for w in tried])
    got = np.array([chosen.score[list(chosen.weights).index(w)] for w in tried])
    assert got - got[0] == pytest.approx(want - want[0], rel=1e-6, abs=1e-5)
    around = [minus_two_log_likelihood(chosen.weight * f) for f in (0.97, 1.0, 1.03)]
    assert around[1] == min(around)


def test_reml_finds_the_ratio_of_noise_and_deviations() -> None:
    logs = []
    for seed in range(30):
        problem, _ = simulated(noise=5e-4, sigma=5e-5, seed=seed)  # ten times the declared noise
        program = ro.convex.pose(ro.tikhonov, problem.linearize(np.zeros(len(problem.parameters.free))))
        logs.append(np.log10(ro.reml(program).weight))
    # deviations are of the size of the scales: the weight is the noise's variance over the declared, 100
    assert np.mean(logs) == pytest.approx(2.0, abs=0.15)


def test_reml_says_what_it_cannot_choose() -> None:
    problem, _ = simulated(noise=5e-5)
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    with pytest.raises(ro.InputError, match="selector reml: found formulation 'lasso', accepted: a quadratic penalty"):
        ro.reml(ro.convex.pose(ro.lasso, model))
    few, _ = simulated(("a[234]", "d5"), noise=5e-5, configurations=12)
    with pytest.raises(
        ro.InputError,
        match="found a loss that depends on a few equations, accepted: a loss with gradients, without own variables",
    ):
        ro.reml(ro.convex.pose(ro.minimax, few.linearize(np.zeros(4))))
    sphere = ro.load("sphere").problem
    chosen = ro.reml(ro.convex.pose(ro.tikhonov, sphere.linearize(np.zeros(len(sphere.parameters.free)))))
    assert (chosen.weight, chosen.interior) == (1.0, False)
    assert "stated noise and scales are used" in chosen.note


RULES = [ro.l_curve, ro.corner, ro.k_fold, ro.leave_one_out, ro.two_step]


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_a_weight_at_which_the_solver_fails_is_skipped(rule: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    solve, failed = ro.convex.Program.solve, []

    def failing(program: ro.convex.Program, weight: float, **options: Any) -> ro.convex.Estimate:
        if not failed or weight == failed[0]:
            failed.append(weight)
            raise ro.NoSolutionFound("minimax", weight, "NumericalError")
        return solve(program, weight, **options)

    program = ro.convex.pose(ro.minimax, model())
    monkeypatch.setattr(ro.convex.Program, "solve", failing)
    choice = rule(program)
    assert failed
    assert choice.weight not in failed
    if rule in (ro.two_step, ro.leave_one_out):  # it failed for what tells where their own scores are computed
        assert failed[0] not in choice.weights
    else:
        assert "1 weight skipped, where the solver failed" in choice.note
    assert len(choice.weights) == len(choice.score)
    assert np.isfinite(choice.score).all()
    monkeypatch.setattr(ro.convex.Program, "solve", lambda *given, **options: failing(given[0], failed[0]))
    with pytest.raises(ro.NoSolutionFound):
        rule(program)


def test_a_tiny_weight_of_redundant_parameters_is_no_failure() -> None:
    problem = ro.load("position").problem
    x = (
        problem.parameters.free.scale
        * np.random.default_rng(0).normal(size=(2, len(problem.parameters.free)))[1]
        * 1e-3
    )
    m = problem.linearize(x)
    absolute = ro.Formulation("L1", loss=cp.norm1, penalty=cp.sum_squares)
    program = ro.convex.pose(absolute, m.scaled(np.where(m.group == 19, 0.0, 1.0)))
    path = program.path(np.geomspace(1e-12, 1e-6, 13))
    assert np.ptp([estimate.objective for estimate in path]) < 1e-4


def test_a_rule_reads_a_penalty_with_own_variables_beside_a_robust_loss() -> None:
    def nearest_shift(z: Any) -> Any:
        shift = cp.Variable()
        return cp.sum_squares(z - shift) + cp.square(shift)

    mine = ro.Formulation("shifted", loss=ro.huber(1.5), penalty=nearest_shift)
    program = ro.convex.pose(mine, model(condition=30.0).scaled(np.full(30, 3.0)))
    program.value(np.ones(program.structure.n))  # asked for own variables of the loss as it is
    assert ro.l_curve(program).weight > 0


def test_rows_held_out_from_a_loss_with_own_variables_stop_no_solver() -> None:
    """Huber's loss of norms, written with a variable for each: held-out errors are those of the ready function."""

    def written(v: Any) -> Any:
        beyond = cp.Variable(v.size, nonneg=True)
        return cp.sum_squares(cp.pos(v - beyond)) + 4 * cp.sum(beyond)

    problem = ro.load("pose").problem
    at_nominal = problem.linearize(np.zeros(len(problem.parameters.free)))
    over = {"loss_over": "configuration", "penalty": cp.sum_squares}
    weights = np.array([1e-2, 1.0, 1e2, 1e4])
    own, ready = (
        held_out_error(ro.convex.pose(ro.Formulation("mine", loss=loss, **over), at_nominal))(weights)
        for loss in (written, lambda v: cp.sum(cp.huber(v, 2)))
    )
    assert own == pytest.approx(ready, rel=1e-5)


def test_a_choice_beside_a_weight_that_was_skipped_is_not_inside() -> None:
    weights, score = np.geomspace(1, 1e4, 5), np.array([3.0, 2.0, 1.0, 2.0, 3.0])
    inside = choice("mine", weights, score, 2, "least")
    score[3] = np.nan
    unsure = choice("mine", weights, score, 2, "least")
    assert inside.interior
    assert inside.note == "least"
    assert not unsure.interior
    assert unsure.note.endswith("1 weight skipped, where the solver failed")
