"""Statements a little beside the beaten track, whose answers would be wrong without a word."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from tests.convex.plain import objective_at, plain


@pytest.fixture(scope="module")
def problem() -> Any:
    return ro.load("position").problem


@pytest.fixture(scope="module")
def model(problem: Any) -> Any:
    return problem.linearize(np.zeros(len(problem.parameters.free)))


def gap(result: Any) -> float:
    """How far the objective lies above plain CVXPY's for the last linearization, relative to that."""
    model = result.problem.linearize(result.x)
    best = plain(result.formulation, model, result.weight).objective
    return (objective_at(result.formulation, model, result.weight, result.z) - best) / abs(best)


@pytest.mark.parametrize("heavy", [1e6, 1e12, 1e14])
def test_a_heavy_penalty_on_some_parameters_leaves_that_on_the_others(problem: Any, heavy: float) -> None:
    """Weights of 1 beside 1e12 are no rounding of a diagonal form."""
    weights = np.where(problem.parameters.free.of_frames, heavy, 1.0)
    stated = ro.Formulation("held frames", penalty=lambda z: cp.sum(cp.multiply(weights, cp.square(z))))
    result = ro.calibrate(problem, stated, 1.0)
    assert result.converged
    assert abs(gap(result)) < 1e-8


def test_the_multiplier_goes_to_the_box_on_whose_bound_the_solution_lies(model: Any) -> None:
    n = model.A.shape[1]
    tight, wide = np.full(n, 0.3), np.full(n, 5.0)
    low = ro.constraints.Box("low", lambda p: (-tight, wide))
    high = ro.constraints.Box("high", lambda p: (-wide, tight))
    estimate = ro.convex.pose(ro.Formulation("two", penalty=cp.sum_squares, constraints=(low, high)), model).solve(1.0)
    of_low, of_high = estimate.duals
    assert of_low.max() > 1
    assert of_high.max() > 1
    assert (of_low[estimate.z >= 0.3] == 0).all()
    assert (of_high[estimate.z <= -0.3] == 0).all()


OUTSIDE = {
    "1 / (z - 0.1)": lambda z: cp.sum(cp.inv_pos(z - 0.1)),
    "-ln z": lambda z: -cp.sum(cp.log(z)),
    "squares - sqrt(z - 0.2)": lambda z: cp.sum_squares(z) - cp.sum(cp.sqrt(z - 0.2)),
    "relative entropy of z - 0.1": lambda z: cp.sum(cp.kl_div(z - 0.1, 1)),
}


@pytest.mark.parametrize("name", OUTSIDE)
def test_nominal_may_lie_outside_the_domain_of_a_penalty(problem: Any, name: str) -> None:
    """NumPy answers a number for 1 / -0.1, where the atom has none."""
    result = ro.calibrate(problem, ro.Formulation(name, penalty=OUTSIDE[name]), 10.0)
    assert result.converged, result.message
    assert np.isfinite(result.history[-1].objective)
    assert result.certificate.decrease < 1e-6
    assert not gap(result) >= 1e-6  # plain CVXPY's point may be higher, or outside the domain by rounding: not a number


def test_outside_the_domain_an_objective_is_infinite(model: Any) -> None:
    program = ro.convex.pose(ro.Formulation("inverse", penalty=lambda z: cp.sum(cp.inv_pos(z - 0.1))), model)
    assert program.objective(np.zeros(model.A.shape[1]), 1.0) == np.inf


def noise_of(result: Any, W: np.ndarray) -> tuple[float, float]:
    """Trace of the influence matrix of the rows W (A z - b), and their RSS / (rows - trace)."""
    model = result.problem.linearize(result.x)
    A, r = W @ model.A, W @ (model.A @ result.z - model.b)
    dof = float(np.trace(A @ np.linalg.solve(A.T @ A + result.weight * np.eye(A.shape[1]), A.T)))
    return dof, float(r @ r) / (len(W) - dof)


@pytest.mark.parametrize("kind", ["half of the equations", "weights", "mixed", "fewer and mixed"])
def test_a_weighted_squared_loss_tells_the_noise_of_what_it_sums(problem: Any, kind: str) -> None:
    """Equations without weight are none, and unit weights of the others leave the declared variance as it is."""
    rng = np.random.default_rng(0)
    W = {
        "half of the equations": np.eye(60, 120),
        "weights": np.diag(rng.uniform(0.3, 2, 120)),
        "mixed": np.eye(120) + 0.1 * rng.normal(size=(120, 120)),
        "fewer and mixed": rng.normal(size=(60, 120)),
    }[kind]
    result = ro.calibrate(problem, ro.Formulation(kind, lambda r: cp.sum_squares(W @ r), cp.sum_squares), 2.0)
    dof, variance = noise_of(result, W)
    assert result.fit_covariance.linear.equations == len(W)
    assert result.fit_covariance.degrees_of_freedom == pytest.approx(dof, rel=1e-8)
    assert result.fit_covariance.noise_variance * np.mean(np.sum(W**2, axis=1)) == pytest.approx(variance, rel=1e-8)


def test_leaving_out_configurations_means_so_where_a_loss_mixes_their_equations(problem: Any) -> None:
    """The squares of a mixed loss are of no one configuration: left out all together, none would be predicted."""
    W = np.eye(120) + 1e-6 * np.random.default_rng(0).normal(size=(120, 120))
    mixed = ro.Formulation("mixed", lambda r: cp.sum_squares(W @ r), cp.sum_squares)
    plain_squares = ro.calibrate(problem, ro.tikhonov, ro.leave_one_out).weight
    assert ro.calibrate(problem, mixed, ro.leave_one_out).weight == pytest.approx(plain_squares, rel=0.1)


def test_a_mean_square_means_the_same_of_measurements_in_parts(problem: Any) -> None:
    """A QR factor has fewer rows than the equations that it stands for."""
    halves = [lambda: problem.data.take(range(20)), lambda: problem.data.take(range(20, 40))]
    parts = ro.problem.PartitionedProblem(problem.robot, problem.parameters, halves[0](), halves)
    mean = ro.Formulation("mean square", lambda r: cp.sum_squares(r) / r.size + 1, cp.sum_squares)
    whole, apart = (ro.calibrate(source, mean, 0.02) for source in (problem, parts))
    assert apart.converged
    assert np.abs(apart.z - whole.z).max() < 1e-8
    assert apart.history[-1].objective == pytest.approx(whole.history[-1].objective, rel=1e-9)


def test_the_norm_of_the_residual_has_a_spread(problem: Any) -> None:
    """It is posed on a QR factor, and keeps equations all the same."""
    result = ro.calibrate(problem, ro.Formulation("norm", cp.norm2, cp.sum_squares), 0.1)
    assert result.converged
    assert 0.8 < result.fit_covariance.noise_variance < 1.4


@pytest.mark.parametrize("formulation", [ro.tikhonov, ro.robust, ro.lasso], ids=lambda f: f.name)
def test_a_result_travels(problem: Any, formulation: ro.Formulation) -> None:
    """As a process pool sends it back."""
    result = ro.calibrate(problem, formulation, 1.0)
    for again in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result)):
        assert (again.x == result.x).all()
        assert again.program.objective(again.z, 1.0) == result.program.objective(result.z, 1.0)
        assert again.parameter_rows() == result.parameter_rows()


@pytest.mark.parametrize("formulation", [ro.robust, ro.lasso, ro.group_lasso, ro.sum_of_norms], ids=lambda f: f.name)
def test_without_weight_what_no_data_see_stays_nominal_and_the_rest_is_least(
    problem: Any, formulation: ro.Formulation
) -> None:
    """Seven directions of 34 are unseen: left to rounding they drift far, and the loop after them."""
    result = ro.calibrate(problem, formulation, 0.0)
    assert result.converged, result.message
    assert len(result.history) < 10
    assert gap(result) < 1e-5  # plain CVXPY is no better than that here
    unseen = result.program.model.svd[2][result.program.model.rank :]
    assert np.abs(unseen @ result.z).max() < 1e-6


def test_a_contradiction_is_named_however_the_solver_ended(model: Any) -> None:
    stated = ro.Formulation(
        "both", penalty=cp.sum_squares, constraints=(lambda z, p: [cp.norm1(z) <= 2, cp.sum(z) >= 3],)
    )
    with pytest.raises(ro.basics.exceptions.NoSolutionFound, match="contradict each other"):
        ro.convex.pose(stated, model).solve(1.0)


@pytest.mark.parametrize("light", [1e-4, 1e-6, 1e-8, 1e-10])
@pytest.mark.parametrize("name", ["position", "paper_arm"])
def test_a_penalty_that_hardly_holds_some_parameters_leaves_the_others_to_the_data(name: str, light: float) -> None:
    """In units of such a penalty the data of the others look like nothing, and were once taken for it."""
    problem = ro.load(name).problem
    weights = np.where(np.arange(len(problem.parameters.free)) % 5 == 0, light, 1.0)
    stated = ro.Formulation("light", penalty=lambda z: cp.sum_squares(cp.multiply(weights, z)))
    result = ro.calibrate(problem, stated, 1e-3)
    assert result.converged
    assert len(result.history) <= 6
    assert gap(result) < 1e-8


@pytest.mark.parametrize("weight", ["reml", None, [1.0], {"a?": 3.0}, 1j, np.complex128(1), True, -1.0, np.nan])
def test_a_program_takes_a_number_as_weight(model: Any, weight: Any) -> None:
    program = ro.convex.pose(ro.tikhonov, model)
    for ask in (program.solve, program.problem, lambda w: program.path([w])):
        with pytest.raises(ro.InputError, match=r"weight: found .*, accepted: a finite number"):
            ask(weight)


@pytest.mark.parametrize("solver", ["NOPE", 3])
def test_a_solver_that_is_not_there_is_said(problem: Any, solver: Any) -> None:
    """No larger weight would help."""
    with pytest.raises(ro.InputError, match=r"solver: found .*, accepted: an installed solver: .*CLARABEL"):
        ro.calibrate(problem, ro.tikhonov, 1.0, solver=solver)


def test_a_setting_that_the_solver_does_not_know_is_said(problem: Any) -> None:
    with pytest.raises(ro.InputError, match=r"settings: found .*unrecognized.*'foo'"):
        ro.calibrate(problem, ro.robust, 1.0, settings={"foo": 1})
