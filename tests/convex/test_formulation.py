"""Convex programs against formulas and an active-set method."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

import rpim_opt as ro
from tests.simulate import ARM

NAMES = ro.robot.model_parameters(ARM).identify(["alpha?", "a?"]).free


def model(seed: int = 0, rows: int = 30, condition: float = 1e3) -> ro.problem.LinearModel:
    """A random model with 12 parameters and singular values down to 1 / condition."""
    rng = np.random.default_rng(seed)
    U, _ = np.linalg.qr(rng.normal(size=(rows, 12)))
    V, _ = np.linalg.qr(rng.normal(size=(12, 12)))
    A = U @ np.diag(np.geomspace(1.0, 1 / condition, 12)) @ V.T
    b = A @ rng.normal(size=12) + 0.01 * rng.normal(size=rows)
    return ro.problem.LinearModel(A, b, np.repeat(np.arange(rows // 3), 3), NAMES.toleranced({"length_mm": 0.5}))


def normal_equations(m: ro.problem.LinearModel, weight: float) -> np.ndarray:
    n = m.A.shape[1]
    return np.linalg.lstsq(np.vstack([m.A, np.sqrt(weight) * np.eye(n)]), np.concatenate([m.b, np.zeros(n)]))[0]


@pytest.mark.parametrize("weight", [1e-8, 1e-4, 1e-2, 1.0, 1e2])
def test_tikhonov_solves_the_normal_equations(weight: float) -> None:
    m = model()
    z = ro.convex.pose(ro.tikhonov, m).solve(weight).z
    assert np.abs(z - normal_equations(m, weight)).max() < 1e-9 * max(1, np.abs(z).max())
    gradient = m.A.T @ (m.A @ z - m.b) + weight * z
    assert np.abs(gradient).max() < 1e-10


@pytest.mark.parametrize("weight", [1e-3, 1e-1, 1e1])
def test_the_closed_form_path_is_the_program_as_written_down(weight: float) -> None:
    """The program posed in the singular basis, the formula, and CVXPY given Eq. (11) itself agree."""
    m = model()
    program = ro.convex.pose(ro.tikhonov, m)
    z = cp.Variable(12)
    written = cp.Problem(cp.Minimize(cp.sum_squares(m.A @ z - m.b) + weight * cp.sum_squares(z)))
    written.solve(solver=cp.CLARABEL, tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12)
    formula = program.path([weight])[0].z
    assert np.abs(formula - z.value).max() < 1e-8
    assert np.abs(formula - program.solve(weight).z).max() < 1e-10


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("weight", [0.0, 1e-6, 1e-3, 1e-1])
def test_box_equals_the_active_set_method(seed: int, weight: float) -> None:
    m = model(seed)
    m = ro.problem.LinearModel(m.A, m.b, m.group, m.parameters.toleranced({"angle_mrad": 0.1}))
    bound = m.parameters.tolerance / m.parameters.scale
    n = len(bound)
    stacked = np.vstack([m.A, np.sqrt(weight) * np.eye(n)])
    active = lsq_linear(stacked, np.concatenate([m.b, np.zeros(n)]), (-bound, bound), method="bvls", tol=1e-15)
    z = ro.convex.pose(ro.bounded, m).solve(weight).z
    assert np.count_nonzero(np.abs(active.x) > bound - 1e-12) > 0, "a case without active bounds shows nothing"
    assert np.abs(z - active.x).max() < 1e-8


def test_unseen_directions_stay_nominal_at_weight_zero() -> None:
    m = model()
    A = m.A.copy()
    A[:, 3] = 0
    A[:, 5] = A[:, 4]
    z = ro.convex.pose(ro.least_squares, ro.problem.LinearModel(A, m.b, m.group, m.parameters)).solve().z
    assert abs(z[3]) < 1e-12
    assert z[4] == pytest.approx(z[5], abs=1e-9)
    assert np.abs(z - np.linalg.pinv(A) @ m.b).max() < 1e-8


@pytest.mark.parametrize("constraints", [(), (ro.within_tolerance,)])
def test_without_a_penalty_a_weight_changes_nothing(constraints: tuple) -> None:
    program = ro.convex.pose(ro.Formulation("no penalty", constraints=constraints), model())
    unweighted = program.solve(0.0)
    for estimate in (program.solve(10.0), *program.path([10.0])):
        assert np.abs(estimate.z - unweighted.z).max() < 1e-9
        assert estimate.weight == 0


def test_one_program_serves_other_data_of_the_same_shape() -> None:
    program = ro.convex.pose(ro.bounded, model(0))
    assert np.array_equal(program.on(model(1)).solve(0.1).z, ro.convex.pose(ro.bounded, model(1)).solve(0.1).z)


def test_a_path_is_its_solutions() -> None:
    program = ro.convex.pose(ro.bounded, model())
    weights = [1e-4, 1e-1, 1e1, 1e3]
    for estimate, weight in zip(program.path(weights), weights, strict=True):
        alone = program.solve(weight)
        assert np.abs(estimate.z - alone.z).max() < 1e-8
        r = program.model.A @ alone.z - program.model.b
        assert alone.loss == pytest.approx(r @ r)
        assert alone.penalty == pytest.approx(alone.z @ alone.z)


def test_a_users_formulation_is_two_lines() -> None:
    m = model()
    b = m.b.copy()
    b[7] += 5.0
    spoiled = ro.problem.LinearModel(m.A, b, m.group, m.parameters)
    robust = ro.Formulation("Huber", loss=lambda r: cp.sum(cp.huber(r, 0.03)), penalty=cp.norm1)
    clean = ro.convex.pose(ro.tikhonov, m).solve(1e-4).z
    error = np.linalg.norm(ro.convex.pose(robust, spoiled).solve(1e-4).z - clean)
    assert error < 0.1 * np.linalg.norm(ro.convex.pose(ro.tikhonov, spoiled).solve(1e-4).z - clean)


def test_weight_reaches_a_general_penalty_and_invariant_losses_may_be_reduced() -> None:
    m = model()
    lasso = ro.convex.pose(ro.Formulation("lasso", penalty=cp.norm1), m)
    assert np.abs(lasso.solve(1e3).z).max() < 1e-8
    assert np.count_nonzero(np.abs(lasso.solve(1e-1).z) > 1e-6) < 12
    rows = ro.convex.pose(ro.Formulation("rows", loss=lambda r: cp.sum_squares(r), penalty=cp.norm1), m)
    assert np.abs(lasso.solve(1e-2).z - rows.solve(1e-2).z).max() < 1e-6


def test_contradicting_constraints_are_an_error_with_evidence() -> None:
    impossible = ro.Formulation("impossible", constraints=(lambda z, p: z >= 1, lambda z, p: z <= 0))
    with pytest.raises(
        ro.NoSolutionFound, match="'impossible' at weight 0: the solver ended with 'infeasible'"
    ) as caught:
        ro.convex.pose(impossible, model()).solve()
    assert caught.value.status == "infeasible"


def test_what_is_not_convex_is_refused() -> None:
    with pytest.raises(ro.InputError, match="not convex"):
        ro.convex.pose(ro.Formulation("concave", loss=lambda r: cp.sum(cp.sqrt(r))), model())


@pytest.mark.parametrize("weight", [-1.0, np.nan, np.inf])
def test_a_weight_is_a_finite_number(weight: float) -> None:
    with pytest.raises(ro.InputError, match="weight: found"):
        ro.convex.pose(ro.tikhonov, model()).solve(weight)


def test_a_loss_without_a_penalty_leaves_unseen_directions_nominal() -> None:
    problem = ro.load("position").problem
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    absolute = ro.Formulation("absolute values", loss=cp.norm1)
    z = ro.convex.pose(absolute, model).solve().z
    _, s, Vt = model.svd
    assert (s == 0).any()
    assert np.abs(Vt[s == 0] @ z).max() < 1e-9
    assert np.abs(z).max() < 10


def test_a_column_of_zeros_costs_no_warning() -> None:
    result = ro.calibrate(ro.load("paper_arm").problem, ro.least_squares)
    free = result.problem.parameters.free
    z = np.abs(result.x / free.scale)
    # theta6 moves no point on its axis: what is left there is rounding, 1e-16 for each of 26 unknowns and some passes
    assert z[free.names.index("theta6")] <= 1e-12 * z.max()
    boxed = ro.Formulation("boxed", constraints=(ro.constraints.signed(1, "a?"),))
    assert np.isfinite(ro.calibrate(ro.load("paper_arm").problem, boxed).x).all()
