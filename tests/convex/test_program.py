"""A program's values, slopes and solutions against the formulas and the CVXPY problem that it stands for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.convex import Estimate
from rpim_opt.convex.program import Damping
from tests.convex.test_formulation import model

MODEL = model(condition=30.0).scaled(np.full(30, 3.0))
N = 12
Z = np.random.default_rng(2).normal(size=N)


def box(half: float) -> ro.constraints.Box:
    return ro.constraints.Box("box", lambda p: (np.full(len(p), -half), np.full(len(p), half)))


def test_a_constant_of_the_loss_counts_on_a_path() -> None:
    shifted = ro.Formulation("shifted", loss=lambda r: cp.sum_squares(r) + 5, penalty=cp.sum_squares)
    program = ro.convex.pose(shifted, MODEL)
    assert program.path([1.0])[0].loss == pytest.approx(program.solve(1.0).loss, rel=1e-12)


DENSE = np.random.default_rng(4).normal(size=(N, N))
FORMULATIONS = {
    "tikhonov": ro.tikhonov,
    "least squares": ro.least_squares,
    "robust": ro.robust,
    "norms": ro.sum_of_norms,
    "lasso": ro.lasso,
    "groups": ro.group_lasso,
    "huber": ro.Formulation("huber", loss=ro.huber(1.0), penalty=cp.sum_squares),
    "dense": ro.Formulation("dense", penalty=lambda z: cp.sum_squares(DENSE @ z - 1.0)),
    "shifted": ro.Formulation("shifted", loss=lambda r: 2 * cp.sum_squares(r - 0.5) + 3.0, penalty=cp.sum_squares),
    "weighed": ro.Formulation("weighed", loss=lambda v: 2 * cp.sum_squares(v), loss_over="configuration"),
}


@pytest.mark.parametrize("name", FORMULATIONS)
@pytest.mark.parametrize("weight", [0.0, 0.7])
def test_a_value_is_that_of_the_written_problem(name: str, weight: float) -> None:
    program = ro.convex.pose(FORMULATIONS[name], replace(MODEL, offset=2.5))
    written = program.problem(weight)
    [z] = [v for v in written.variables() if v.name() == "z"]
    objective = cp.Problem(written.objective, [*written.constraints, z == Z]).solve(solver=cp.CLARABEL)
    assert program.objective(Z, weight) == pytest.approx(objective, rel=1e-6)
    loss, penalty = program.value(Z)
    if weight == 0:
        assert program.objective(Z, weight) == loss
    else:
        assert program.objective(Z, weight) == pytest.approx(loss + weight * penalty, rel=1e-12)


@pytest.mark.parametrize("name", FORMULATIONS)
@pytest.mark.parametrize("constraints", [(), (box(0.3),), (ro.in_ball(0.5, "*"),)])
@pytest.mark.parametrize("damped", [False, True])
def test_a_solution_is_that_of_the_written_problem(name: str, constraints: tuple[Any, ...], damped: bool) -> None:
    formulation = replace(FORMULATIONS[name], constraints=constraints)
    program = ro.convex.pose(formulation, MODEL)
    damping = Damping(np.linspace(-0.2, 0.2, N), np.diag(np.geomspace(0.5, 3.0, N))) if damped else None
    ours = program.solve(0.7, damping=damping)
    theirs = program.solve(0.7, damping=damping, solver="CLARABEL")

    def objective(z: np.ndarray) -> float:
        value = program.objective(z, 0.7)
        return value + damping.value(z) if damping else value

    assert objective(ours.z) == pytest.approx(objective(theirs.z), rel=1e-6)
    assert ours.z == pytest.approx(theirs.z, abs=2e-3)
    assert ours.loss + ours.weight * ours.penalty == pytest.approx(ours.objective, rel=1e-12)
    assert program.violation(ours.z) <= 1e-7
    for mine, other in zip(ours.duals, theirs.duals, strict=True):
        assert mine == pytest.approx(other, rel=2e-2, abs=2e-2 * max(1.0, np.abs(mine).max()))
    if program.quadratic and program.box is not None:  # a formula, or an active set
        assert ours.iterations == 0


def joint(name: str) -> ro.Formulation:
    """A formulation whose loss shares variables of its own with the penalty or with constraints."""
    slack, slacks = cp.Variable(nonneg=True), cp.Variable(N, nonneg=True)
    shift, threshold, square = cp.Variable(3), cp.Variable(), cp.Variable((2, 2), PSD=True)

    def inequality(z: Any, p: Any) -> Any:
        return cp.bmat([[square[0, 0] - 1e-4, z[0]], [z[0], square[1, 1] - 1e-4]]) >> 0

    kinds: dict[str, dict[str, Any]] = {
        "slack": {
            "loss": lambda r: cp.sum(cp.huber(r, 1.5)) + 5 * slack,
            "constraints": (lambda z, p: cp.norm(z) <= 0.2 + slack,),
        },
        "slacks": {
            "loss": lambda r: cp.sum_squares(r) + 3 * cp.sum(slacks),
            "penalty": cp.norm1,
            "constraints": (lambda z, p: [cp.abs(z) <= 0.1 + slacks, cp.sum(slacks) <= 2],),
        },
        "norms": {
            "loss": lambda v: threshold + cp.sum(cp.pos(v - threshold)) / 5,
            "loss_over": "configuration",
            "constraints": (lambda z, p: threshold <= 1.0,),
        },
        "shift": {
            "loss": lambda r: cp.norm1(r - shift[0]),
            "penalty": lambda z: cp.norm(z[:3] - shift) + cp.norm1(z),
            "constraints": (lambda z, p: cp.sum(shift) == 0.1,),
        },
        "matrix": {
            "loss": lambda r: cp.sum_squares(r) + 10 * cp.trace(square),
            "constraints": (inequality,),
        },
    }
    return ro.Formulation(name, **{"penalty": cp.sum_squares, **kinds[name]})


@pytest.mark.parametrize("name", ["slack", "slacks", "norms", "shift", "matrix"])
def test_variables_that_loss_and_constraints_share_have_one_value(name: str) -> None:
    program = ro.convex.pose(joint(name), MODEL)
    for weight, estimate in zip([10.0, 0.1], program.path([10.0, 0.1]), strict=True):
        written = program.problem(weight)
        least = float(written.solve(solver=cp.CLARABEL, tol_gap_rel=1e-9, tol_gap_abs=1e-9))
        A, b = program.rows
        loss, penalty = program.structure.values(estimate.z, A @ estimate.z - b, weight)
        assert estimate.objective == pytest.approx(least, rel=1e-7)
        assert loss + weight * penalty == pytest.approx(least, rel=1e-7)
        assert program.violation(estimate.z) <= 1e-7
        theirs = np.concatenate([np.empty(0), *[np.ravel(each.dual_value) for each in written.constraints[1:]]])
        ours = np.concatenate([np.empty(0), *estimate.duals])
        assert np.abs(ours) == pytest.approx(np.abs(theirs), abs=1e-4 * (1 + np.abs(theirs).max()))


def test_a_written_problem_is_parametrized_with_parameters_of_the_users_own_too() -> None:
    price, radius = cp.Parameter(nonneg=True, value=2.0), cp.Parameter(nonneg=True, value=0.5)
    mine = ro.Formulation(
        "mine", penalty=lambda z: price * cp.norm1(z), constraints=(lambda z, p: cp.norm(z) <= radius,)
    )
    program = ro.convex.pose(mine, MODEL)
    written = program.problem(0.7)
    assert written.is_dcp(dpp=True)
    written.solve(solver=cp.CLARABEL)
    assert written.value == pytest.approx(program.solve(0.7).objective, rel=1e-6)
    price.value, radius.value = 0.1, 5.0
    written.param_dict["weight"].value = 3.0
    written.solve(solver=cp.CLARABEL)
    assert written.value == pytest.approx(ro.convex.pose(mine, MODEL).solve(3.0).objective, rel=1e-6)


def test_a_solvers_steps_are_told() -> None:
    program = ro.convex.pose(ro.lasso, MODEL)
    assert ro.convex.pose(ro.tikhonov, MODEL).solve(0.7).iterations == 0  # a formula
    assert program.solve(0.7, solver="CLARABEL").iterations > 0
    assert program.solve(0.7, settings={"max_iter": 100}).iterations > 0


def test_an_estimates_objective_leaves_out_a_penalty_without_weight() -> None:
    assert Estimate(Z, 0.0, 3.0, float("inf")).objective == 3.0
    formula = Estimate(Z, 2.0, 3.0, 4.0)
    assert formula.objective == 11.0
    assert (formula.status, formula.iterations, formula.duals) == ("optimal", 0, ())


def test_a_point_outside_a_domain_is_moved_inside() -> None:
    entropy = ro.Formulation("entropy", penalty=lambda z: cp.sum(cp.kl_div(z + 1, 1)))
    program = ro.convex.pose(entropy, MODEL)
    edge = np.full(N, -1.0)
    outside = edge - 1e-10
    assert not np.isfinite(program.objective(outside, 1.0))
    for distance in (3e-10, 5e-8, 5e-6, 5e-4):
        outside = edge - distance
        inside = program.inside(outside, 1.0)
        assert np.isfinite(program.objective(inside, 1.0))
        assert np.abs(inside - outside).max() < 200 * distance
    assert program.inside(0.5 * edge, 1.0) is not None
    assert (program.inside(0.5 * edge, 1.0) == 0.5 * edge).all()
    far = np.full(N, -30.0)
    assert (program.inside(far, 1.0) == far).all()


def test_multipliers_go_to_the_box_that_states_the_bound() -> None:
    tight, wide = box(0.1), box(0.3)
    both = ro.Formulation("both", penalty=cp.sum_squares, constraints=(wide, tight))
    alone = ro.Formulation("alone", penalty=cp.sum_squares, constraints=(tight,))
    of_wide, of_tight = ro.convex.pose(both, MODEL).solve(0.7).duals
    [want] = ro.convex.pose(alone, MODEL).solve(0.7).duals
    assert np.abs(of_wide).max() == 0.0
    assert of_tight == pytest.approx(want, rel=1e-9)
    twice = ro.Formulation("twice", penalty=cp.sum_squares, constraints=(tight, tight))
    first, second = ro.convex.pose(twice, MODEL).solve(0.7).duals
    assert first == pytest.approx(want, rel=1e-9)
    assert np.abs(second).max() == 0.0


def test_a_robust_path_is_its_solutions() -> None:
    program = ro.convex.pose(ro.robust, MODEL)
    weights = [0.1, 1.0]
    for found, weight in zip(program.path(weights), weights, strict=True):
        assert found.z == pytest.approx(program.solve(weight).z, abs=1e-9)
        assert found.weight == weight


def test_squares_of_a_loss_have_its_value() -> None:
    for name in ("tikhonov", "shifted", "weighed"):
        program = ro.convex.pose(FORMULATIONS[name], replace(MODEL, offset=2.5))
        squared = program.squared
        value = np.sum((squared.A @ Z - squared.b) ** 2) + squared.offset
        assert value == pytest.approx(program.value(Z)[0], rel=1e-9)
    with pytest.raises(ro.InputError, match="a loss that is not quadratic"):
        _ = ro.convex.pose(ro.robust, MODEL).squared


def test_what_mixes_configurations_is_one() -> None:
    mixed = ro.Formulation("mixed", loss=lambda r: cp.sum_squares(np.tri(30) @ r), penalty=cp.sum_squares)
    assert set(ro.convex.pose(mixed, MODEL).squared.group.tolist()) == {0}
    assert (ro.convex.pose(FORMULATIONS["shifted"], MODEL).squared.group == MODEL.group).all()


def test_inliers_follow_from_the_norms() -> None:
    b = MODEL.b.copy()
    b[4] += 1e4
    program = ro.convex.pose(ro.robust, MODEL.with_values(b))
    z = program.solve(1.0).z
    kept = program.inlier_model(z)
    assert set(MODEL.group.tolist()) - set(kept.group.tolist()) == {1}
    assert ro.convex.pose(ro.tikhonov, MODEL).inliers(Z) is None
    by_equation = ro.convex.pose(FORMULATIONS["huber"], MODEL.with_values(b))
    inliers = by_equation.inliers(by_equation.solve(1.0).z)
    assert inliers is not None
    assert 0 < inliers.factor <= 1


def test_a_damped_step_of_what_nothing_holds_is_the_shortest() -> None:
    blind = replace(MODEL, A=MODEL.A * (np.arange(N) != 3))
    size = np.where(np.arange(N) == 3, 0.0, 0.1)  # a column without data has no length
    z = ro.convex.pose(ro.least_squares, blind).solve(damping=Damping(Z, np.diag(size))).z
    A = np.vstack([blind.A, np.diag(size)])
    want = np.linalg.pinv(A) @ np.concatenate([blind.b, size * Z])
    assert z == pytest.approx(want, rel=1e-9, abs=1e-11)
