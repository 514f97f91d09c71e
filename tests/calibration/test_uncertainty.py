"""Uncertainty: intervals cover what they promise."""

from __future__ import annotations

from dataclasses import replace

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics.arrays import rms
from rpim_opt.calibration.covariance import row_dof
from rpim_opt.robot import forward_kinematics
from rpim_opt.robot.kinematics import numeric_frame
from tests.simulate import ARM, simulated

Q = np.random.default_rng(77).uniform(-2, 2, (50, 6))


def covered(seeds: range) -> np.ndarray:
    """Share of predicted coordinates inside their 95 % intervals, calibration by calibration."""
    hits = []
    for seed in seeds:
        problem, truth = simulated(noise=5e-5, seed=seed, configurations=25)
        found = ro.calibrate(problem, ro.tikhonov, ro.reml).predict(Q, confidence=0.95)
        want = problem.on(ro.Dataset.of(Q, np.zeros((50, 3)), 1.0)).modelled(truth)[0]
        hits.append(np.mean(np.abs(found.position - want) <= found.expanded))
    return np.array(hits)


@pytest.mark.slow
def test_intervals_of_predicted_positions_cover_in_a_thousand_calibrations() -> None:
    assert 0.93 < covered(range(1000)).mean() < 0.97


def test_zeros_of_joint_1_are_as_uncertain_as_its_prior_where_the_base_was_registered() -> None:
    """Registration takes up the zero of joint 1: that the base is near to where it was registered tells nothing."""
    off, stated = [], []
    for seed in range(20):
        rng = np.random.default_rng([seed, 12])
        off_nominal = rng.normal(size=(6, 5)) * [1e-3, 6e-4, np.radians(0.5), 6e-4, 0]
        q = rng.uniform(-2, 2, (30, 6))
        arm = replace(ARM, mdh=ARM.mdh + off_nominal)
        T = numeric_frame([1.1, -0.4, 0.2, 0.01, -0.02, 0.8]) @ forward_kinematics(arm, q)
        y = (T @ [0.03, -0.02, 0.06, 1.0])[:, :3] + 5e-5 * rng.normal(size=(30, 3))
        result = ro.calibrate(ro.problem_from(ARM, ro.Dataset.of(q, y, 5e-5)))
        i = result.problem.parameters.free.names.index("theta1")
        off.append(result.x[i] - off_nominal[0, 2])
        stated.append(np.sqrt(result.covariance[i, i]))
    assert 0.6 < rms(np.divide(off, stated)) < 2.0  # 2.7 where the scale of the base counts


def test_the_noise_is_compared_with_the_declared() -> None:
    for factor, word in (
        (1.0, "agree with the measurement"),
        (5.0, "wrong rows"),
        (0.2, "smaller than stated"),
    ):
        problem, _ = simulated(noise=factor * 5e-5, seed=1)
        test = ro.calibrate(problem, ro.tikhonov, ro.reml).noise_test()
        assert test.ratio == pytest.approx(factor, rel=0.25)
        assert word in test.verdict


def held(uncertainty: ro.calibration.Uncertainty) -> set[str]:
    """The parameters that the budget marks."""
    frame = uncertainty.to_frame()
    return {name for name, marked in zip(frame["parameter"], frame["actively_constrained"], strict=True) if marked}


def test_what_active_bounds_do_is_said() -> None:
    instance = ro.load("constrained", "wrong_tolerance")
    u = ro.calibration.Uncertainty(instance.calibrate())
    assert "a5" in u.result.actively_constrained
    assert held(u) == set(u.result.actively_constrained)
    assert "At an active bound" in u._repr_html_()
    with pytest.raises(ro.InputError, match="the penalty of formulation 'lasso' is not quadratic"):
        ro.calibration.Uncertainty(ro.calibrate(instance.problem, ro.lasso, 1.0))
    with pytest.raises(ro.InputError, match="confidence: found 95"):
        ro.calibration.Uncertainty(ro.calibrate(instance.problem, ro.tikhonov, 1.0), confidence=95)


def test_a_robust_fit_is_as_certain_as_one_of_the_rows_it_keeps() -> None:
    instance = ro.load("blunders")
    robust = ro.calibrate(instance.problem, ro.robust, 1.0)
    clean = ro.calibrate(robust.without_flagged().problem, ro.tikhonov, 1.0)
    q = instance.problem.data.q[:20]
    assert robust.predict(q).expanded == pytest.approx(clean.predict(q).expanded, rel=0.25)


def test_monte_carlo_serves_losses_and_penalties_without_a_covariance() -> None:
    problem = ro.load("position").problem
    result = ro.calibrate(problem, ro.Formulation("L1", loss=cp.norm1, penalty=cp.norm1), weight=1.0)
    spread = ro.calibration.monte_carlo(result, draws=40).std(axis=0)
    squares = ro.calibration.monte_carlo(ro.calibrate(problem, ro.tikhonov, weight=1.0), draws=40).std(axis=0)
    moved = spread > 0.3 * squares  # the others rest at zero
    assert 0.7 < np.median(spread[moved] / squares[moved]) < 1.8  # 1.25 with normal noise and no penalty


def test_monte_carlo_serves_a_loss_with_variables_of_its_own() -> None:
    """The mean of the worst quarter, as a user writes it; its draws scatter more than those of least squares."""

    def worst(v: cp.Expression) -> cp.Expression:
        t = cp.Variable()
        return v.size * t + 4 * cp.sum(cp.pos(v - t))

    formulation = ro.Formulation("worst quarter", worst, cp.sum_squares, loss_over="configuration")
    result = ro.calibrate(ro.load("position").problem, formulation, weight=1.0)
    squares = ro.calibrate(ro.load("position").problem, weight=1.0)
    spread, least = (ro.calibration.monte_carlo(each, draws=40).std(axis=0) for each in (result, squares))
    a2 = result.problem.parameters.free.names.index("a2")
    assert 1 < spread[a2] / least[a2] < 5
    with pytest.raises(ro.InputError, match="`forward`, monte_carlo, l_curve and k_fold do not"):
        ro.calibration.Uncertainty(result)


def test_what_a_constraint_of_a_script_holds_is_marked() -> None:
    problem = ro.load("position").problem
    fixed = ro.Formulation("a2", penalty=cp.sum_squares, constraints=(lambda z, p: p.x["a2"] == 1e-4,))
    assert "a2" in held(ro.calibration.Uncertainty(ro.calibrate(problem, fixed, weight=1.0)))


def test_rules_serve_an_own_variable_in_the_penalty_beside_any_loss() -> None:
    problem = ro.load("position").problem
    slack = cp.Variable(nonneg=True)
    own = ro.Formulation(
        "slack", cp.norm1, lambda z: cp.norm1(z) + 10 * slack, (lambda z, p: cp.abs(p.x["a2"]) <= 3e-4 + 1e-3 * slack,)
    )
    assert ro.calibrate(problem, own, weight=ro.l_curve).converged


def test_contributors_to_the_uncertainty_of_a_position_add_up() -> None:
    from rpim_opt.calibration.uncertainty import position_budget

    problem = ro.load("position").problem
    q = problem.data.q[:7] * 0.9
    for weight in (None, 1.0):  # estimated scales, which add uncertainty; and stated ones
        result = ro.calibrate(problem, ro.tikhonov, weight)
        found = position_budget(result, q)
        assert all((each >= -1e-20).all() for each in found.values())
        assert (found["estimated prior scales and variance components"] > 0).any() == (weight is None)
        total = np.trace(result.predict(q, of="reached").covariance, axis1=1, axis2=2)
        np.testing.assert_allclose(sum(found.values()), total, rtol=1e-9)


def test_degrees_of_freedom_of_a_row_are_those_of_the_part_that_it_consists_of() -> None:
    """A variance v of which log(sqrt v) has a standard deviation s has 1 / (2 s^2) of them."""
    V = 1e-8 * np.eye(3)[None]
    assert row_dof(100.0, 0.3, V, 0 * V) == pytest.approx([100.0])
    assert row_dof(100.0, 0.3, V, V) == pytest.approx([1 / (2 * 0.3**2)])
    assert row_dof(100.0, 0.3, 2 * V, V) == pytest.approx([2**2 / (1 / 100.0 + 2 * 0.3**2)])
