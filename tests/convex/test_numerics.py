"""The estimators against certified values, selectors against brute force, baselines against the convex programs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt import baselines
from rpim_opt.convex.rules.folds import held_out_error
from rpim_opt.convex.rules.selection import weight_grid
from rpim_opt.convex.select import SELECTORS
from rpim_opt.problem import LinearModel
from rpim_opt.robot import Parameters
from tests.convex.plain import plain
from tests.nist import sets
from tests.simulate import simulated


def model_of(A: np.ndarray, b: np.ndarray, group: np.ndarray | None = None) -> LinearModel:
    n = A.shape[1]
    names = tuple(f"a{i}" for i in range(n))
    p = Parameters(names, ("length",) * n, np.zeros(n), np.ones(n), np.full(n, np.inf), np.ones(n, dtype=bool))
    return LinearModel(A, b, np.arange(len(b)) if group is None else group, p)


@pytest.mark.parametrize("name", sets())
def test_nists_certified_coefficients(name: str) -> None:
    X, y, coefficients = sets()[name]
    scale = np.linalg.norm(X, axis=0)
    program = ro.convex.pose(ro.least_squares, model_of(X / scale, y))
    assert program.model.rank == X.shape[1]
    certified = scale * coefficients
    s = np.linalg.svd(X / scale, compute_uv=False)
    condition = s[0] / s[-1]
    left = np.linalg.norm(X @ coefficients - y)
    # what one rounding of the data changes (Wedin's bound): QR on any processor stays at a fifth of it or below
    rounding = np.finfo(float).eps * condition * (np.linalg.norm(certified) + condition * left / s[0])
    for z in (program.solve().z, program.path([0.0])[0].z):
        assert np.abs(z - certified).max() < rounding


def tikhonov_program(noise: float = 5e-5, seed: int = 0, configurations: int = 40):
    problem, _ = simulated(noise=noise, seed=seed, configurations=configurations)
    return ro.convex.pose(ro.tikhonov, problem.linearize(np.zeros(len(problem.parameters.free))))


def test_leaving_configurations_out_in_closed_form_is_leaving_them_out() -> None:
    program = tikhonov_program()
    chosen = ro.leave_one_out(program)
    some = chosen.weights[::40]
    assert np.sqrt(chosen.score[::40] / len(program.model.b)) == pytest.approx(held_out_error(program)(some), rel=1e-6)


@pytest.mark.slow
def test_many_configurations_of_a_lasso_are_left_out_in_parts() -> None:
    problem, _ = simulated(noise=5e-5, configurations=130)
    program = ro.convex.pose(ro.lasso, problem.linearize(np.zeros(len(problem.parameters.free))))
    chosen = ro.leave_one_out(program)
    alone = held_out_error(program)(chosen.weights)
    assert min(chosen.score) == pytest.approx(min(alone), rel=0.05)


def test_gcv_is_its_formula_and_close_to_leaving_out() -> None:
    program = tikhonov_program()
    A, b, m = program.model.A, program.model.b, len(program.model.b)
    chosen = ro.gcv(program)

    def score(w: float) -> float:
        H = A @ np.linalg.solve(A.T @ A + w * np.eye(A.shape[1]), A.T)
        return float(np.sum((b - H @ b) ** 2) / (m - np.trace(H)) ** 2)

    for k in (50, 120, 180):
        assert chosen.score[k] == pytest.approx(score(chosen.weights[k]), rel=1e-6)
    assert score(chosen.weight) <= min(score(chosen.weight * f) for f in (0.9, 1.1))


def test_the_discrepancy_is_the_declared_noise() -> None:
    program = tikhonov_program(noise=2e-4)  # four times as declared: no weight fits that well
    assert not ro.discrepancy(program).interior
    assert "too small" in ro.discrepancy(program).note
    program = tikhonov_program(noise=4.9e-5, seed=4)
    chosen = ro.discrepancy(program)
    assert chosen.interior
    e, s = program.path([chosen.weight])[0], program.model.svd[1]
    dof = np.sum(s**2 / (s**2 + chosen.weight))
    assert e.loss == pytest.approx(1.1**2 * (len(program.model.b) - dof), rel=1e-3)


@pytest.mark.parametrize("name", [n for n in SELECTORS if n != "two_step"])
def test_every_selector_comes_near_the_best_weight_on_a_robot(name: str) -> None:
    ratios = []
    for seed in range(6):
        problem, truth = simulated(noise=5e-5, seed=seed, configurations=25)
        program = ro.convex.pose(ro.tikhonov, problem.linearize(np.zeros(len(truth))))
        q = np.random.default_rng(99).uniform(-2, 2, (60, 6))
        there = problem.on(ro.Dataset.of(q, np.zeros((60, 3)), 1.0))
        want, scale = there.modelled(truth)[0], problem.parameters.free.scale

        def error(weight: float, program=program, there=there, want=want, scale=scale) -> float:
            z = program.path([weight])[0].z
            return float(np.linalg.norm(there.modelled(scale * z)[0] - want))

        best = min(error(w) for w in weight_grid(program)[::8])
        ratios.append(error(SELECTORS[name](program).weight) / best)
    assert np.median(ratios) < {"quasi_optimality": 30, "discrepancy": 3.5}.get(name, 1.6)


def test_selectors_work_on_robust_and_constrained_formulations() -> None:
    instance = ro.load("constrained", "everything")
    program = ro.convex.pose(
        instance.formulation, instance.problem.linearize(np.zeros(len(instance.problem.parameters.free)))
    )
    for rule in (ro.reml, ro.gcv):
        assert 0.05 < rule(program).weight < 100
    blunders = ro.load("blunders").problem
    robust = ro.convex.pose(ro.robust, blunders.linearize(np.zeros(len(blunders.parameters.free))))
    assert 0.05 < ro.gcv(robust).weight < 100
    assert ro.k_fold(robust, folds=5).weight < 1e4
    with pytest.raises(ro.InputError, match="selector gcv: found formulation 'lasso'"):
        ro.gcv(ro.convex.pose(ro.lasso, robust.model))


@pytest.mark.slow
def test_baselines_agree_where_the_data_decide() -> None:
    problem, _ = simulated(("a[234]", "theta[234]", "d5"), noise=5e-5, configurations=20)
    scale = problem.parameters.free.scale
    want = ro.calibrate(problem, ro.least_squares).x / scale
    for method in (baselines.gauss_newton, baselines.levenberg_marquardt):
        assert np.abs(method(problem).x / scale - want).max() < 1e-8
    assert np.abs(baselines.linear_least_squares(problem).x / scale - want).max() < 0.05


def test_a_constraint_that_does_not_bind_changes_nothing_at_weak_directions() -> None:
    rng = np.random.default_rng(0)
    U, V = (np.linalg.qr(rng.normal(size=(k, 8)))[0] for k in (40, 8))
    s = np.array([1.0, 0.5, 1e-2, 1e-4, 5e-9, 7e-10, 0.0, 0.0])  # the data see six directions, two of them hardly
    model = model_of(1e4 * (U * s) @ V.T, 1e-3 * rng.normal(size=40))
    free = ro.Formulation("free")
    slack = ro.Formulation("with room", constraints=(lambda z, _: z[0] <= 1e9,))
    expected = ro.convex.pose(free, model).solve()
    found = ro.convex.pose(slack, model).solve()
    assert found.objective == pytest.approx(expected.objective, rel=1e-9)


def test_an_active_set_is_followed_where_some_rows_are_left_out() -> None:
    """Steps along hardly identified directions violate more rows at once than there are unknowns: rows that depend on
    others are dropped, and hardly any solution is left to an interior point (`iterations`)."""
    every = ["alpha?", "a?", "theta?", "d?", "tool_[xyz]", "base_*"]
    problem, _ = simulated(every, noise=5e-5, robot=ro.load("paper_arm").problem.robot, size=0.3)
    tolerances = {"length_mm": 0.4, "angle_mrad": 0.4, "tool_mm": 0.4, "base_mm": 0.4, "base_mrad": 0.4}
    problem = problem.with_parameters(problem.parameters.toleranced(tolerances))
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    elastic = ro.Formulation(
        "elastic net", penalty=lambda z: cp.sum_squares(z) + cp.norm1(z), constraints=(ro.within_tolerance,)
    )
    program = ro.convex.pose(elastic, model)
    program.solve(100.0)
    iterations = []
    for weight in (1.0, 1e-2, 1e-4, 1e-6):
        for group in range(0, 40, 4):
            without = model.scaled(np.where(model.group == group, 0.0, 1.0))
            left_out = program.on(without)
            solution = left_out.solve(weight)
            iterations.append(solution.iterations)
            exact = plain(elastic, without, weight)
            assert left_out.objective(solution.z, weight) <= exact.objective * (1 + 1e-8) + exact.gained
    assert np.count_nonzero(iterations) <= 4  # of 40


def test_a_threshold_of_a_users_own_is_the_mean_of_the_largest_at_its_minimum() -> None:
    count = 1_500

    def cvar(r):
        threshold = cp.Variable()
        return threshold + cp.sum(cp.pos(cp.abs(r) - threshold)) / (0.1 * r.size)

    rng = np.random.default_rng(1)
    model = model_of(rng.normal(size=(count, 4)), rng.standard_t(3, size=count))
    program = ro.convex.pose(ro.Formulation("CVaR", loss=cvar, penalty=cp.sum_squares), model)
    found = program.solve(1e-3)
    assert found.objective == pytest.approx(program.problem(1e-3).solve(solver="CLARABEL"), rel=1e-7)
    largest = np.sort(np.abs(model.A @ found.z - model.b))[-count // 10 :]
    assert found.loss == pytest.approx(largest.mean(), rel=1e-7)


def groups_of_three(z):
    return cp.sum(cp.hstack([cp.norm(z[k : k + 3]) for k in range(0, z.size - 2, 3)]))


def symmetric_logistic(r):
    return cp.sum(cp.logistic(r) + cp.logistic(-r))


@pytest.mark.parametrize(
    ("loss", "penalty", "constraint"),
    [
        (cp.norm1, cp.norm1, None),
        (symmetric_logistic, groups_of_three, lambda z, _: cp.sum(z[:4]) <= -0.2),
        (cp.sum_squares, groups_of_three, lambda z, _: cp.sum(z[:4]) <= -0.2),
        (lambda r: cp.sum(cp.maximum(0.9 * r, -0.1 * r)), cp.norm1, ro.in_ball(1.5, "*")),
    ],
    ids=["L1", "logistic", "squares", "quantile in a ball"],
)
def test_small_weights_on_a_singular_problem_are_solved_to_the_last_digits(loss, penalty, constraint) -> None:
    """At a weight of 1e-8 some directions are 10^5 scales long, and a penalty's costs below a solver's tolerances."""
    problem = ro.load("rank_deficient").problem
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    formulation = ro.Formulation("small weight", loss, penalty, () if constraint is None else (constraint,))
    program = ro.convex.pose(formulation, model)
    estimate = program.solve(1e-8)
    if constraint is None:  # a linear program has vertices, which SciPy's simplex method finds
        z = cp.Variable(model.A.shape[1])
        known = cp.Problem(cp.Minimize(loss(model.A @ z - model.b) + 1e-8 * penalty(z))).solve(solver=cp.SCIPY)
    else:
        found = plain(formulation, model, 1e-8)
        known = found.objective + found.gained
    assert estimate.objective <= known * (1 + 1e-7)
    assert program.violation(estimate.z) <= 1e-7


LOSSES_ALONE: dict[str, dict[str, Any]] = {
    "squares": {"loss": cp.sum_squares},
    "Huber": {"loss": lambda r: cp.sum(cp.huber(r, 1.35))},
    "sum of norms": {"loss": cp.sum, "loss_over": "configuration"},
    "L1": {"loss": cp.norm1},
    "minimax": {"loss": cp.norm_inf},
}


@pytest.mark.parametrize("loss", LOSSES_ALONE)
@pytest.mark.parametrize("constraint", [(), (ro.in_ball(1.5, "*"),)], ids=["none", "ball"])
def test_weight_zero_is_the_minimum_without_a_penalty_on_a_singular_problem(loss: str, constraint: Any) -> None:
    """A penalty that costs nothing bounds nothing: its variables drift, and unidentified directions with them."""
    problem = ro.load("rank_deficient").problem
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    _, s, V = model.svd
    y = cp.Variable(model.A.shape[1])  # z = V y of the identified directions alone, where there are no constraints
    z, held = V.T @ y, [] if constraint else [y[s == 0] == 0]
    seen: Any = model.A @ z - model.b
    if "loss_over" in LOSSES_ALONE[loss]:
        seen = cp.hstack([cp.norm(seen[np.flatnonzero(model.group == k)]) for k in np.unique(model.group)])
    objective = LOSSES_ALONE[loss]["loss"](seen)
    least = cp.Problem(cp.Minimize(objective), [*held, *([cp.norm(z) <= 1.5] if constraint else [])])
    value = least.solve(solver="CLARABEL")
    formulation = ro.Formulation("free", penalty=cp.norm1, constraints=constraint, **LOSSES_ALONE[loss])
    program = ro.convex.pose(formulation, model)
    estimate = program.solve(0.0)
    assert estimate.objective <= value * (1 + 1e-6)  # CVXPY's point may lie 1e-8 outside a ball that costs 1e5
    assert program.violation(estimate.z) <= 1e-7
    assert np.isfinite(estimate.penalty)
    if not constraint:
        assert np.abs(V[s == 0] @ estimate.z).max() <= 1e-6


def test_a_minimum_at_weight_zero_does_not_depend_on_the_order_of_rows() -> None:
    """Unknowns are 1e4 prior scales: of another order Clarabel factorizes another matrix, and half of them stalled."""
    problem = ro.load("rank_deficient").problem
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    formulation = ro.Formulation("free", loss=cp.norm1)
    values = []
    for seed in range(10):
        order = np.random.default_rng(seed).permutation(len(model.b))
        turned = replace(model, A=model.A[order], b=model.b[order], group=model.group[order])
        values.append(ro.convex.pose(formulation, turned).solve().objective)
    assert max(values) <= min(values) * (1 + 1e-6)  # the point of CVXPY's own attempt was 1.5e-5 above


@pytest.mark.parametrize("loss", ["squares", "Huber", "L1"])
def test_at_weight_zero_constraints_move_what_the_data_do_not_identify(loss: str) -> None:
    problem = ro.load("rank_deficient").problem
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    _, s, V = model.svd
    relation = V[s == 0][0] + V[len(s[s > 1]) - 1]  # an unidentified direction and the weakest identified one

    def stated(z: Any, _: Any) -> Any:
        return relation @ z == 5.0

    free = ro.Formulation("free", **LOSSES_ALONE[loss])
    bound = ro.Formulation("bound", constraints=(stated,), **LOSSES_ALONE[loss])
    least, estimate = (ro.convex.pose(each, model).solve(0.0) for each in (free, bound))
    # the unidentified direction meets it at no cost; of L1 an interior point ends within 4e-6, where data are 1e8 flat
    assert estimate.objective <= least.objective * (1 + 1e-5)
    assert relation @ estimate.z == pytest.approx(5.0, abs=1e-6)
