"""What a formulation can have follows from what it is, not from which function states it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from tests.simulate import simulated

WEIGHT = 3.0
RULES = (ro.reml, ro.gcv, ro.discrepancy, ro.leave_one_out)


def quadratic_form(z: Any) -> Any:
    return cp.quad_form(z, np.eye(z.size))


def rotated(z: Any) -> Any:
    """|Q z|^2 with an orthogonal Q, which is |z|^2."""
    Q, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(z.size, z.size)))
    return cp.sum_squares(Q @ z)


def about_zero(z: Any) -> Any:
    return cp.sum_squares(np.eye(z.size) @ (z - np.zeros(z.size)))


def with_own_variable(z: Any) -> Any:
    """min over v of 2 |z - v|^2 + 2 |v|^2 is |z|^2."""
    other = cp.Variable(z.size)
    return 2 * cp.sum_squares(z - other) + 2 * cp.sum_squares(other)


PENALTIES: dict[str, Callable[[Any], Any]] = {
    "lambda": lambda z: cp.sum_squares(z),
    "quad_form": quadratic_form,
    "L (z - z0)": about_zero,
    "rotated": rotated,
    "sum of squares": lambda z: cp.sum(cp.square(z)),
    "half of two": lambda z: 0.5 * cp.sum_squares(z) * 2,
    "in two parts": lambda z: cp.sum_squares(z[:5]) + cp.sum_squares(z[5:]),
    "with a constant": lambda z: cp.sum_squares(z) + 4.0,
}
LOSSES: dict[str, Callable[[Any], Any]] = {
    "sum_squares": cp.sum_squares,
    "lambda": lambda r: cp.sum_squares(r),
    "quad_form": quadratic_form,
    "sum of squares": lambda r: cp.sum(cp.square(r)),
    "half of two": lambda r: 0.5 * cp.sum_squares(r) * 2,
}
PAIRS = [("sum_squares", name) for name in PENALTIES] + [(name, "lambda") for name in LOSSES if name != "sum_squares"]


@pytest.fixture(scope="module")
def problem() -> ro.CalibrationProblem:
    return ro.load("position").problem


def formulated(loss: str, penalty: str) -> ro.Formulation:
    return ro.Formulation(f"{loss} + {penalty}", LOSSES[loss], PENALTIES[penalty])


def in_scales(C: np.ndarray, problem: ro.CalibrationProblem) -> np.ndarray:
    scale = problem.parameters.free.scale
    return C / np.outer(scale, scale)


# --- the same quadratic, written differently ---------------------------------------------------------------


@pytest.mark.parametrize(("loss", "penalty"), PAIRS)
def test_the_same_quadratic_gives_the_same_answer_and_all_that_follows(
    problem: ro.CalibrationProblem, loss: str, penalty: str
) -> None:
    want = ro.calibrate(problem, ro.tikhonov, WEIGHT)
    result = ro.calibrate(problem, formulated(loss, penalty), WEIGHT)
    scale = problem.parameters.free.scale
    assert result.converged
    assert np.abs((result.x - want.x) / scale).max() < 1e-7
    assert result.fit_covariance.degrees_of_freedom == pytest.approx(want.fit_covariance.degrees_of_freedom, rel=1e-7)
    assert result.fit_covariance.noise_variance == pytest.approx(want.fit_covariance.noise_variance, rel=1e-6)
    difference = in_scales(result.covariance - want.covariance, problem)
    assert np.abs(difference).max() < 1e-6 * np.abs(in_scales(want.covariance, problem)).max()
    q = problem.data.q[:3]
    assert result.predict(q).standard == pytest.approx(want.predict(q).standard, rel=1e-5)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
@pytest.mark.parametrize(("loss", "penalty"), PAIRS)
def test_the_same_quadratic_is_served_by_every_rule(
    problem: ro.CalibrationProblem, loss: str, penalty: str, rule: Any
) -> None:
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    want = rule(ro.convex.pose(ro.tikhonov, model))
    found = rule(ro.convex.pose(formulated(loss, penalty), model))
    assert found.weight == pytest.approx(want.weight, rel=1e-5)
    assert found.interior == want.interior


def test_a_quadratic_with_its_own_variable_is_the_same_answer(problem: ro.CalibrationProblem) -> None:
    want = ro.calibrate(problem, ro.tikhonov, WEIGHT)
    result = ro.calibrate(problem, ro.Formulation("own", penalty=with_own_variable), WEIGHT)
    assert result.converged
    best, found = want.history[-1].objective, result.history[-1].objective
    assert found == pytest.approx(best, rel=1e-7)


# --- another quadratic -------------------------------------------------------------------------------------


def factor(n: int) -> np.ndarray:
    """Well conditioned, with neighbours coupled and units that differ."""
    return np.diag(np.linspace(0.5, 5.0, n)) + 0.4 * np.eye(n, k=1)


@pytest.mark.parametrize("centre", [0.0, 0.3])
@pytest.mark.parametrize("form", ["rows", "quad_form"])
def test_a_covariance_means_the_penalty_that_was_stated(
    problem: ro.CalibrationProblem, centre: float, form: str
) -> None:
    """sigma^2 S (A'A + w L'L)^-1 S, computed densely; with the identity for L it would be several times off."""
    n = len(problem.parameters.free)
    L = factor(n)

    def rows(z: Any) -> Any:
        return cp.sum_squares(L @ (z - centre))

    def whole(z: Any) -> Any:
        return cp.quad_form(z - centre, L.T @ L)

    formulation = ro.Formulation("coupled", penalty={"rows": rows, "quad_form": whole}[form])
    result = ro.calibrate(problem, formulation, WEIGHT)
    model = result.problem.linearize(result.x)
    normal = model.A.T @ model.A + WEIGHT * L.T @ L
    z = np.linalg.solve(normal, model.A.T @ model.b + WEIGHT * L.T @ L @ np.full(n, centre))
    freedom = float(np.trace(np.linalg.solve(normal, model.A.T @ model.A)))
    residual = model.A @ z - model.b
    variance = residual @ residual / (len(residual) - freedom)
    want = variance * np.linalg.inv(normal)
    assert np.abs(result.x / model.parameters.scale - z).max() < 1e-6
    assert result.fit_covariance.degrees_of_freedom == pytest.approx(freedom, rel=1e-6)
    assert result.fit_covariance.noise_variance == pytest.approx(variance, rel=1e-6)
    assert np.abs(in_scales(result.covariance, problem) - want).max() < 1e-6 * np.abs(want).max()
    assert (
        np.abs(in_scales(result.fit_covariance.noise + result.fit_covariance.prior, problem) - want).max()
        < 1e-6 * np.abs(want).max()
    )


def test_a_restricted_likelihood_means_the_penalty_that_was_stated() -> None:
    """REML for |L z|^2 is REML for |u|^2 in the unknowns u = L z (no frames: they would be others in u)."""
    problem, _ = simulated(("a[2-5]", "theta[2-5]", "d[456]"), noise=5e-5, configurations=25)
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    L = factor(model.A.shape[1])
    coupled = ro.Formulation("coupled", penalty=lambda z: cp.sum_squares(L @ z))
    turned = ro.problem.LinearModel(model.A @ np.linalg.inv(L), model.b, model.group, model.parameters)
    for rule in RULES:
        want = rule(ro.convex.pose(ro.tikhonov, turned))
        found = rule(ro.convex.pose(coupled, model))
        assert found.weight == pytest.approx(want.weight, rel=1e-4), rule.__name__


def test_a_path_means_the_penalty_that_was_stated(problem: ro.CalibrationProblem) -> None:
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    L = factor(model.A.shape[1])
    program = ro.convex.pose(ro.Formulation("coupled", penalty=lambda z: cp.sum_squares(L @ (z - 0.2))), model)
    weights = [1.0, 1e2, 1e4, 1e6]
    for weight, estimate in zip(weights, program.path(weights), strict=True):
        normal = model.A.T @ model.A + weight * L.T @ L
        want = np.linalg.solve(normal, model.A.T @ model.b + weight * L.T @ L @ np.full(len(L), 0.2))
        assert np.abs(estimate.z - want).max() < 1e-7
        assert estimate.penalty == pytest.approx(np.sum((L @ (want - 0.2)) ** 2), rel=1e-6)
        assert np.abs(program.solve(weight).z - want).max() < 1e-7


# --- what is no quadratic ----------------------------------------------------------------------------------

NOT_QUADRATIC: dict[str, Callable[[], ro.Formulation]] = {
    "lasso": lambda: ro.lasso,
    "group lasso": lambda: ro.group_lasso,
    "own L1": lambda: ro.Formulation("own L1", penalty=lambda z: cp.norm1(z)),
    "root of the squares": lambda: ro.Formulation("root", penalty=lambda z: cp.norm(z)),
    "squares and L1": lambda: ro.Formulation("net", penalty=lambda z: cp.sum_squares(z) + 0.1 * cp.norm1(z)),
}


def refusal(ask: Callable[[], Any]) -> str:
    with pytest.raises(ro.InputError) as caught:
        ask()
    text = str(caught.value)
    assert "\n" not in text
    assert text.endswith(".")
    return text


@pytest.mark.parametrize("name", list(NOT_QUADRATIC))
def test_what_a_penalty_cannot_have_is_refused_with_its_name(problem: ro.CalibrationProblem, name: str) -> None:
    formulation = NOT_QUADRATIC[name]()
    result = ro.calibrate(problem, formulation, WEIGHT)
    assert result.converged
    asked: dict[str, Callable[[], Any]] = {
        "covariance": lambda: result.covariance,
        "prediction": lambda: result.predict(problem.data.q[:2]),
        "degrees of freedom": lambda: result.fit_covariance.degrees_of_freedom,
        "uncertainty": lambda: ro.calibration.Uncertainty(result),
        "reml": lambda: ro.calibrate(problem, formulation, ro.reml),
        "gcv": lambda: ro.calibrate(problem, formulation, ro.gcv),
    }
    for what, ask in asked.items():
        assert formulation.name in refusal(ask), what
    assert result.forward(problem.data.q[:2]).shape == (2, 4, 4)
    assert all(row["std"] is None for row in result.parameter_rows())


# --- multipliers, and what the data know -------------------------------------------------------------------


def held_at(value: float, *names: str) -> ro.constraints.Box:
    """Parameters that are kept at a value [scales]."""

    def limits(p: Any) -> tuple[np.ndarray, np.ndarray]:
        chosen = np.isin(p.names, names)
        return np.where(chosen, value, -np.inf), np.where(chosen, value, np.inf)

    return ro.constraints.Box("held", limits)


@pytest.mark.parametrize("loss", [cp.sum_squares, ro.huber(1.5)], ids=["squared", "Huber"])
@pytest.mark.parametrize("name", ["a2", "d4", "theta3"])
def test_a_multiplier_of_at_nominal_is_the_slope_of_the_optimum(
    problem: ro.CalibrationProblem, name: str, loss: Any
) -> None:
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    index = model.parameters.names.index(name)
    nominal = ro.Formulation("at nominal", loss, cp.sum_squares, (ro.constraints.at_nominal(name),))
    multiplier = ro.convex.pose(nominal, model).solve(WEIGHT).duals[0]
    h, values = 1e-4, []
    for value in (-h, h):
        moved = ro.Formulation("moved", loss, cp.sum_squares, (held_at(value, name),))
        estimate = ro.convex.pose(moved, model).solve(WEIGHT)
        values.append(estimate.loss + WEIGHT * estimate.penalty)
    slope = (values[1] - values[0]) / (2 * h)
    assert abs(slope) > 1.0
    assert abs(multiplier[index]) == pytest.approx(abs(slope), rel=1e-4)
    assert np.abs(np.delete(multiplier, index)).max() < 1e-6 * abs(slope)


@pytest.mark.parametrize("name", ["position", "markers", "rank_deficient", "seven_axis"])
def test_least_squares_predicts_positions_that_the_data_know(name: str) -> None:
    """Single parameters are unseen, and their variances infinite; the positions that were measured are known."""
    problem = ro.load(name).problem
    result = ro.calibrate(problem, ro.least_squares)
    model = result.problem.linearize(result.x)
    assert model.rank < len(result.x)
    assert np.isinf(np.diag(result.covariance)).any()
    block = problem.data.blocks[0]
    q = block.q[:5, 0]
    found = result.predict(q, block.markers[0], of="mean")
    assert np.isfinite(found.standard).all()
    assert found.standard.max() < 1e-3
    m, scale = len(model.b), model.parameters.scale
    residual = model.A @ (result.x / scale) - model.b
    variance = residual @ residual / (m - model.rank)
    empty = ro.Dataset.of(q, np.zeros((5, 3)), 1.0)
    J = problem.on(with_marker(empty, block.markers)).jacobian(result.x) * scale
    want = np.sqrt(variance * np.einsum("ij,jk,ik->i", J, np.linalg.pinv(model.A.T @ model.A, 1e-16), J))
    assert found.standard.ravel() == pytest.approx(want, rel=1e-3)


def with_marker(data: ro.Dataset, markers: tuple[str, ...]) -> ro.Dataset:
    return replace(data, blocks=(replace(data.blocks[0], markers=markers),))


def test_least_squares_does_not_claim_positions_that_the_data_do_not_know() -> None:
    """Joint 1 alone moved, so that a2 and d4 are seen as one sum: elsewhere they count apart."""
    arm, _ = simulated(("a2", "d4", "theta1"), configurations=20)
    q = np.zeros((20, 6))
    q[:, 0] = np.linspace(-2, 2, 20)
    modelled = arm.on(ro.Dataset.of(q, np.zeros((20, 3)), 5e-5))
    y = modelled.modelled(np.zeros(3))[0] + 5e-5 * np.random.default_rng(0).normal(size=(20, 3))
    result = ro.calibrate(arm.on(ro.Dataset.of(q, y, 5e-5)), ro.least_squares)
    assert result.program.model.rank == 2
    assert result.predict(q).standard.max() < 1e-4
    elsewhere = result.predict(arm.data.q[:5])
    assert not np.isfinite(elsewhere.standard).any(axis=1).all()
