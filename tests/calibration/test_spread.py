"""Covariances against their formulas, intervals against their quantiles, and what is not known."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
from scipy.stats import chi2
from scipy.stats import t as student

import rpim_opt as ro
from rpim_opt.calibration import Uncertainty
from rpim_opt.calibration.covariance import noise_test
from tests.simulate import simulated

PROBLEM, _ = simulated(noise=5e-5, configurations=25)
WEIGHT = 2.0
RESULT = ro.calibrate(PROBLEM, ro.tikhonov, WEIGHT)
SCALE = PROBLEM.parameters.free.scale


def test_covariances_are_their_formulas() -> None:
    m = RESULT.fit_covariance.linear
    inverse = np.linalg.inv(m.A.T @ m.A + WEIGHT * np.eye(len(SCALE)))
    freedom = len(m.b) - np.trace(m.A @ inverse @ m.A.T)
    variance = np.sum((m.A @ RESULT.z - m.b) ** 2) / freedom
    assert RESULT.fit_covariance.noise_variance == pytest.approx(variance, rel=1e-9)
    assert RESULT.fit_covariance.degrees_of_freedom == pytest.approx(len(m.b) - freedom, rel=1e-9)
    assert RESULT.noise_dof == pytest.approx(freedom, rel=1e-9)
    units = np.outer(SCALE, SCALE)
    assert RESULT.covariance / units == pytest.approx(variance * inverse, rel=1e-6, abs=1e-11)
    assert RESULT.fit_covariance.noise / units == pytest.approx(
        variance * inverse @ m.A.T @ m.A @ inverse, rel=1e-6, abs=1e-11
    )
    assert RESULT.fit_covariance.prior / units == pytest.approx(
        variance * WEIGHT * inverse @ inverse, rel=1e-6, abs=1e-11
    )


def test_intervals_are_students() -> None:
    for confidence in (0.5, 0.95, 0.99):
        u = Uncertainty(RESULT, confidence)
        assert u.coverage_factor == pytest.approx(student.ppf((1 + confidence) / 2, RESULT.noise_dof), rel=1e-9)
        half = u.coverage_factor * np.sqrt(np.diag(RESULT.covariance))
        assert u.expanded == pytest.approx(half, rel=1e-9, abs=1e-12)
    for wrong in (0.0, 1.0, -0.5, 95.0):
        with pytest.raises(ro.InputError, match="a probability between 0 and 1"):
            Uncertainty(RESULT, wrong)


def stand_in(equations: float, dof: float, variance: float) -> Uncertainty:
    result: Any = SimpleNamespace(
        fit_covariance=SimpleNamespace(residual_dof=equations - dof),
        noise_dof=max(equations - dof, 0.0),
        noise_test=lambda: noise_test(variance * (equations - dof), equations - dof),
    )
    return Uncertainty(result)


@pytest.mark.parametrize(
    ("variance", "said"),
    [
        (1.0, "agree with the measurement"),
        (0.3, "smaller than stated"),
        (3.0, "times the measurement noise: the robot's repeatability, noise larger"),
    ],
)
def test_the_noise_is_judged_by_its_distribution(variance: float, said: str) -> None:
    test = stand_in(60, 20.0, variance).result.noise_test()
    upper = chi2.sf(40 * variance, 40)
    assert test.probability == pytest.approx(2 * min(upper, 1 - upper), rel=1e-9)
    assert test.ratio == pytest.approx(np.sqrt(variance), rel=1e-12)
    assert said in test.verdict


def test_the_noise_is_as_declared_in_99_of_100_cases() -> None:
    for tail in (0.005, 0.995):
        edge = chi2.ppf(tail, 40) / 40
        inner, outer = (edge * (1 + by * (0.5 - tail)) for by in (1e-6, -1e-6))
        agreed = stand_in(60, 20.0, inner).result.noise_test().verdict
        assert "agree with the measurement noise (" in agreed
        assert f"{np.sqrt(edge):.2f}" in agreed.partition("by chance")[2]
        assert "agree with the measurement noise (" not in stand_in(60, 20.0, outer).result.noise_test().verdict


@pytest.mark.parametrize(("left", "tells"), [(0.0, False), (0.9, False), (1.0, True), (1.5, True)])
def test_what_few_equations_tell(left: float, tells: bool) -> None:
    u = stand_in(20, 20.0 - left, 1.0)
    assert u.result.noise_dof == pytest.approx(left, abs=1e-12)
    test = u.result.noise_test()
    assert ("No degrees of freedom remain" in test.verdict) != tells
    if not tells:
        assert (test.ratio, test.probability) == (1.0, 1.0)
    assert u.coverage_factor == pytest.approx(student.ppf(0.975, max(left, 1.0)), rel=1e-12)
    assert stand_in(20, 21.0, 1.0).result.noise_dof == 0.0


def test_without_equations_left_over_the_noise_is_the_declared() -> None:
    few, _ = simulated(("a2", "theta1", "d5"), noise=5e-5, configurations=1)
    exact = ro.calibrate(few, ro.least_squares)
    assert exact.fit_covariance.linear.equations == 3
    assert exact.fit_covariance.noise_variance == 1.0


def test_what_nothing_decides_is_infinite_and_moves_what_it_moves() -> None:
    """theta1 and the base's rotation about it are one direction; a2 alone is known."""
    problem, _ = simulated(("theta1", "base_rz", "a2"), noise=5e-5)
    names = problem.parameters.free.names
    result = ro.calibrate(problem, ro.least_squares)
    variances = dict(zip(names, np.diag(result.covariance), strict=True))
    if np.isinf(variances["theta1"]):
        assert np.isinf(variances["base_rz"])
    assert np.isfinite(variances["a2"])
    q = np.random.default_rng(0).uniform(-2, 2, (3, 6))
    assert np.isfinite(result.predict(q).standard).all()  # positions do not depend on how the two share it
    J = np.zeros((2, 3, 3))
    J[0, 0, names.index("theta1")] = 1.0  # what one of the two moves alone is not known
    J[1, 0, names.index("a2")] = 1.0
    found = result.fit_covariance.of_positions(J)
    if np.isinf(variances["theta1"]):
        assert np.isinf(found[0, 0, 0])
        assert np.isfinite(found[0, 1, 1])
    assert found[1, 0, 0] == pytest.approx(variances["a2"], rel=1e-9)
    for unit in (1e-7, 1e7):  # metres or anything else
        assert (np.isinf(result.fit_covariance.of_positions(unit * J)) == np.isinf(found)).all()


def test_predictions_propagate() -> None:
    q = np.random.default_rng(0).uniform(-2, 2, (4, 6))
    h = 1e-6

    def at(x: np.ndarray) -> np.ndarray:
        return replace(RESULT, x=x).forward(q)[:, :3, 3]

    J = np.stack([(at(RESULT.x + h * e) - at(RESULT.x - h * e)) / (2 * h) for e in np.eye(len(SCALE))], axis=2)
    want = np.einsum("nij,jk,nlk->nil", J, RESULT.covariance, J)
    found = RESULT.predict(q, of="mean")
    assert found.position == pytest.approx(at(RESULT.x), abs=1e-12)
    assert found.covariance == pytest.approx(want, rel=1e-4, abs=1e-14)
    assert found.standard**2 == pytest.approx(np.einsum("nii->ni", want), rel=1e-4)
    wide = RESULT.predict(q, of="mean", confidence=0.99)
    assert wide.expanded == pytest.approx(Uncertainty(RESULT, 0.99).coverage_factor * wide.standard, rel=1e-12)


def test_draws_repeatability_as_the_noise() -> None:
    draws = ro.calibration.monte_carlo(RESULT, draws=1500, seed=1)
    assert draws.shape == (1500, len(SCALE))
    stated = np.sqrt(np.diag(RESULT.fit_covariance.noise))
    assert draws.std(axis=0) / stated == pytest.approx(np.ones(len(SCALE)), abs=0.08)  # each is told to 1.8 %
    m = RESULT.program.model
    shrunk = RESULT.program.on(m.with_values(m.A @ RESULT.z)).solve(WEIGHT).z * SCALE
    assert (np.abs(draws.mean(axis=0) - shrunk) / stated).max() < 0.13  # five standard errors


def test_a_penalty_without_covariance_is_refused() -> None:
    lasso = ro.calibrate(PROBLEM, ro.Formulation("lasso", penalty=cp.norm1), 1.0)
    for ask in (lambda: lasso.covariance, lambda: Uncertainty(lasso), lambda: lasso.predict(np.zeros((1, 6)))):
        with pytest.raises(ro.InputError, match="formulation 'lasso'"):
            ask()
    assert lasso.known_covariance is None


def test_reflectors_of_rows_are_predicted_in_one_call() -> None:
    result = ro.calibrate(ro.load("markers").problem)
    q = result.problem.data.q[:6]
    names = ["A", "C", "B", "B", "A", "C"]
    for of in ("mean", "reached", "reading"):
        whole = result.predict(q, names, of=of, confidence=0.9)
        for row, name in enumerate(names):
            alone = result.predict(q[row : row + 1], name, of=of, confidence=0.9)
            np.testing.assert_allclose(whole.position[row], alone.position[0], atol=1e-12)
            np.testing.assert_allclose(whole.expanded[row], alone.expanded[0], rtol=1e-9)
    with pytest.raises(ro.InputError, match="found 'X', accepted: a reflector of A, B, C"):
        result.predict(q, ["A", "X", "B", "B", "A", "C"])
    with pytest.raises(ro.InputError, match="found 2 names, accepted: 6, one per row"):
        result.predict(q, ["A", "B"])
