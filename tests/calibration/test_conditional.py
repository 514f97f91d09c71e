"""Covariances on the active face, and certificates that do not share the model's derivative."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration.certificate import certified
from rpim_opt.convex.constraints import name_of
from rpim_opt.report.summary import describe, summary
from tests.simulate import simulated

PROBLEM = ro.load("position").problem


def stated(*constraints: Any) -> ro.Formulation:
    return ro.Formulation("mine", penalty=cp.sum_squares, constraints=constraints)


def widths(result: Any) -> dict[str, float]:
    return {row["parameter"]: row["std"] for row in result.parameter_rows()}


def test_a_parameter_that_is_held_has_no_width_and_the_others_those_of_a_problem_without_it() -> None:
    held = ro.calibrate(PROBLEM, stated(ro.constraints.at_nominal("theta3", "d5")), 1.0)
    p = PROBLEM.parameters
    free = p.identified & ~np.isin(p.names, ["theta3", "d5"])
    without = ro.calibrate(PROBLEM.identifying(free), ro.tikhonov, 1.0)
    found, expected = widths(held), widths(without)
    assert found.pop("theta3") == found.pop("d5") == 0.0
    assert found == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("loss", ["squares", "Huber"])
@pytest.mark.parametrize(
    "constraint",
    [
        lambda z, _: cp.norm(z) <= 5.0,
        lambda z, _: cp.abs(z) <= 500.0,
        lambda z, p: cp.norm(cp.vec(p.positions([[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]]), order="C")) <= 9.0,
        lambda z, _: cp.bmat([[z[3], 1.0], [1.0, 9.0 - z[3]]]) + 5.0 * np.eye(2) >> 0,
        lambda z, _: cp.exp(z[3]) <= 50.0,
    ],
    ids=["ball", "absolute values", "positions", "matrix", "exponential"],
)
def test_a_constraint_that_is_not_active_changes_no_width(constraint: Any, loss: str) -> None:
    """An interior point's multipliers are not zero: widths were zero, or constraints said to be contradicted."""
    form = ro.robust if loss == "Huber" else ro.tikhonov
    free = ro.calibrate(PROBLEM, form, 1.0)
    result = ro.calibrate(PROBLEM, replace(form, constraints=(constraint,)), 1.0)
    assert np.linalg.norm(free.z) < 4.9
    assert result.active_constraints == ()
    assert widths(result) == pytest.approx(widths(free), rel=1e-3)
    assert result.verdict == ro.calibration.Verdict()


def test_intervals_say_on_which_own_constraints_they_rest() -> None:
    def longer(_: Any, p: Any) -> Any:
        return p.x["a3"] + p.x["d4"] >= 2e-3

    def wide(z: Any, _: Any) -> Any:
        return cp.norm(z) <= 1e3

    result = ro.calibrate(PROBLEM, stated(longer, wide, lambda z, p: p.x["a2"] == 0), 1.0)
    assert result.active_constraints == ("longer", 'p.x["a2"] == 0')
    assert str(result).count("Standard deviations and intervals are conditional on them") == 1


def test_intervals_say_on_which_ready_constraints_they_rest_once() -> None:
    """What is at nominal, at a limit or as a drawing says; what the data contradict is said above all instead."""
    free = ro.calibrate(PROBLEM, ro.tikhonov, 1.0)
    p = PROBLEM.parameters.free
    k = p.names.index("a3")
    a3 = 1e3 * (p.nominal[k] + free.x[k])
    at_nominal, zero = ro.constraints.at_nominal("alpha6"), ro.constraints.at_nominal("beta2")
    drawn, wide = ro.constraints.parse(f"a3 <= {a3 - 0.003:.4f} mm"), ro.constraints.parse("a2 <= nominal + 30 mm")
    for constraints in ((drawn, wide), (at_nominal, drawn), (zero,)):
        result = ro.calibrate(PROBLEM, stated(*constraints), 1.0)
        assert result.active_constraints == tuple(name_of(each, 0) for each in constraints if each is not wide)
        for text in (str(result), describe(result, summary(result, {}))):
            assert text.count("Standard deviations and intervals are conditional on them") == 1
            assert ("Active constraints: " in text) != ("The data contradict constraints" in text)
            assert "by 0 mm" not in text  # what is at nominal has no tolerance to be loosened


@pytest.mark.parametrize(
    "constraint",
    [
        ro.constraints.equal("a2", "a3"),
        lambda z, _: z[3] == 2 * z[8],  # an equation of one's own
        lambda z, _: cp.sum(z[:12]) <= -3.0,  # an inequality that holds
        ro.constraints.Box("no width", lambda p: (np.zeros(len(p)), np.where(np.arange(len(p)) == 4, 0.0, np.inf))),
    ],
    ids=["equal", "equation", "inequality", "box"],
)
def test_widths_are_those_of_repeated_measurements(constraint: Any) -> None:
    """The noise's part of the covariance against 2,000 draws of it: 5 % are three standard errors of a width."""
    result = ro.calibrate(PROBLEM, stated(constraint), 1.0)
    program, rng = result.program, np.random.default_rng(7)
    model = program.model
    fitted = model.A @ result.z
    small = 1e-6  # so that no other constraint becomes active
    pulled = model.b - fitted
    draws = np.array([
        program.on(model.with_values(fitted + pulled + small * rng.normal(size=len(fitted)))).solve(1.0).z
        for _ in range(2000)
    ])  # fmt: skip
    measured = draws.std(axis=0) / small
    expected = np.sqrt(np.diag(result.fit_covariance.form.noise(1.0)))
    assert measured == pytest.approx(expected, rel=0.06, abs=1e-5 * expected.max())


def test_a_derivative_that_is_not_the_residuals_certifies_nothing() -> None:
    """The minimum of a model with one column off by half is refused; that of the right one is certified."""
    problem, _ = simulated(configurations=30, noise=1e-4, seed=5)
    result = ro.calibrate(problem, ro.tikhonov, 1.0)
    scale = problem.parameters.free.scale

    def residual(z: np.ndarray) -> np.ndarray:
        return problem.whitened_residual(scale * z)

    def wrong(z: np.ndarray) -> ro.problem.LinearModel:
        model = problem.linearize(scale * z)
        A = model.A.copy()
        A[:, 7] *= 2.0
        return ro.convex.pose(ro.tikhonov, model).model.__class__(A, residual(z) + A @ z, model.group, model.parameters)

    z = result.z
    for _ in range(30):
        z = ro.convex.pose(ro.tikhonov, wrong(z)).solve(1.0).z
    assert certified(ro.tikhonov, wrong(z), z, 1.0).holds(z)  # by its own derivative
    assert not certified(ro.tikhonov, wrong(z), z, 1.0, residual=residual).holds(z)
    right = problem.linearize(result.x)
    assert certified(ro.tikhonov, right, result.z, 1.0, residual=residual).holds(result.z)


@pytest.mark.parametrize("name", ["paper_arm", "rank_deficient", "pose", "distance"])
@pytest.mark.parametrize("bound", [0.05, 1.0])
@pytest.mark.parametrize("kind", ["slack", "bound", "norm"])
def test_variables_of_ones_own_in_constraints_are_solved(name: str, bound: float, kind: str) -> None:
    def constraint(z: Any, _: Any) -> list[Any]:
        s = cp.Variable(z.size, nonneg=True)
        if kind == "slack":
            return [z <= bound + s, cp.sum(s) <= 1]
        if kind == "bound":
            return [cp.abs(z) <= s, cp.sum(s) <= 8 * bound, s <= bound]
        return [cp.abs(z) <= s, cp.norm(s) <= bound]

    result = ro.calibrate(ro.load(name).problem, stated(constraint), 1.0)
    assert result.converged
    assert result.certificate.violation <= 1e-7
