"""A posterior becomes the next prior: two calibrations in turn are one with all data."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.bayes import Prior
from rpim_opt.bayes.population import data_likelihood
from rpim_opt.problem import LinearModel

PROBLEM = ro.load("position").problem
FREE = PROBLEM.parameters.free
n = len(FREE)
WEIGHT = 0.3


def model(seed: int, rows: int = 40) -> LinearModel:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((rows, n)) * np.geomspace(0.01, 30.0, n)
    return LinearModel(A, 5 * rng.standard_normal(rows), np.arange(rows), FREE)


def both(one: LinearModel, other: LinearModel) -> LinearModel:
    return replace(
        one, A=np.vstack([one.A, other.A]), b=np.append(one.b, other.b), group=np.arange(len(one.b) + len(other.b))
    )


def result_of(formulation: ro.Formulation, linear: LinearModel, weight: float, noise: float = 1.0) -> SimpleNamespace:
    """What a prior needs of a calibration whose model is linear."""
    program = ro.convex.pose(formulation, linear)
    x = program.solve(weight).z * FREE.scale
    fit = SimpleNamespace(linear=linear, weight=weight, noise_variance=noise, factor=1.0, drift=None)
    return SimpleNamespace(problem=PROBLEM, x=x, program=program, fit_covariance=fit, learned=None)


def then(prior: Prior, linear: LinearModel) -> np.ndarray:
    mine = prior.stated(PROBLEM.parameters).penalized(ro.tikhonov)
    return ro.convex.pose(mine, linear).solve(1.0).z


def test_a_posterior_then_as_the_prior_is_all_data_at_once() -> None:
    first, second = model(1), model(2, rows=12)
    prior = Prior.from_result(result_of(ro.tikhonov, first, WEIGHT))
    wanted = ro.convex.pose(ro.tikhonov, both(first, second)).solve(WEIGHT).z
    assert then(prior, second) == pytest.approx(wanted, rel=1e-9, abs=1e-9 * np.abs(wanted).max())


def test_three_in_turn_are_three_at_once() -> None:
    parts = [model(seed, rows=15) for seed in (1, 2, 3)]
    result = result_of(ro.tikhonov, parts[0], WEIGHT)
    for part in parts[1:]:
        prior = Prior.from_result(result)
        mine = prior.stated(PROBLEM.parameters).penalized(ro.tikhonov)
        result = result_of(mine, part, 1.0)
    everything = both(both(parts[0], parts[1]), parts[2])
    wanted = ro.convex.pose(ro.tikhonov, everything).solve(WEIGHT).z
    assert result.x / FREE.scale == pytest.approx(wanted, rel=1e-8, abs=1e-8 * np.abs(wanted).max())


def test_what_neither_data_nor_penalty_saw_stays_open() -> None:
    first, second = model(1, rows=10), model(2, rows=40)
    prior = Prior.from_result(result_of(ro.least_squares, first, 0.0))
    wanted = ro.convex.pose(ro.least_squares, both(first, second)).solve(0.0).z
    assert then(prior, second) == pytest.approx(wanted, rel=1e-6, abs=1e-6 * np.abs(wanted).max())


def test_what_was_set_up_anew_is_left_out_whatever_it_was() -> None:
    result = result_of(ro.tikhonov, model(1), WEIGHT)
    covariance = np.linalg.inv(result.fit_covariance.linear.A.T @ result.fit_covariance.linear.A + WEIGHT * np.eye(n))
    stated = Prior.from_result(result, without=("base_*",)).stated(PROBLEM.parameters)
    kept = np.array([not name.startswith("base_") for name in FREE.names])
    precision = stated.rows.T @ stated.rows
    assert (stated.replaced == kept).all()
    assert np.linalg.inv(precision[np.ix_(kept, kept)]) == pytest.approx(covariance[np.ix_(kept, kept)], rel=1e-6)
    # and so are parameters that the next calibration does not identify
    fewer = PROBLEM.parameters.identify([name for name, keep in zip(FREE.names, kept, strict=True) if keep])
    again = Prior.from_result(result).stated(fewer)
    assert again.rows.T @ again.rows == pytest.approx(precision[np.ix_(kept, kept)], rel=1e-6, abs=1e-9)


def test_noise_and_inflation_widen_it() -> None:
    result = result_of(ro.tikhonov, model(1), WEIGHT, noise=4.0)
    plain = Prior.from_result(result, noise=1.0).stated(PROBLEM.parameters)
    found = Prior.from_result(result).stated(PROBLEM.parameters)
    loud = Prior.from_result(result, noise=3.0).stated(PROBLEM.parameters)
    inflated = Prior.from_result(result, inflate=6.0).stated(PROBLEM.parameters)
    assert np.abs(plain.rows) == pytest.approx(2 * np.abs(found.rows), rel=1e-9)
    assert np.abs(plain.rows) == pytest.approx(3 * np.abs(loud.rows), rel=1e-9)  # 3 standard deviations, not variances
    assert np.abs(found.rows) == pytest.approx(6 * np.abs(inflated.rows), rel=1e-9)


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_it_is_as_wide_with_a_part_of_loss_and_penalty(share: float) -> None:
    """That the objective is halved changes neither the minimum nor what is known of it."""
    huber = ro.huber(1.5)
    stated = ro.Formulation("a part", loss=lambda r: share * huber(r), penalty=cp.sum_squares)
    result = ro.calibrate(PROBLEM, stated, weight=share)
    rows = Prior.from_result(result).stated(PROBLEM.parameters).rows
    widths = np.sqrt(np.diag(np.linalg.inv(rows.T @ rows))) * FREE.scale
    assert widths == pytest.approx(np.sqrt(np.diag(result.covariance)), rel=1e-6)


def test_it_is_as_wide_as_the_result_says() -> None:
    """With learned sizes and heavy tails, too, which no penalty at the learned scales holds."""
    result = ro.calibrate(PROBLEM.on(PROBLEM.data.configurations(8, 0)))
    stated = Prior.from_result(result).stated(PROBLEM.parameters)
    covariance = np.linalg.inv(stated.rows.T @ stated.rows) * np.outer(FREE.scale, FREE.scale)
    assert np.diag(covariance) == pytest.approx(np.diag(result.covariance), rel=1e-5)
    held = result.fit_covariance.noise + result.fit_covariance.form.prior(1.0) * np.outer(
        *2 * [result.problem.parameters.free.scale]
    )
    assert np.median(np.diag(covariance) / np.diag(held)) > 1.3  # eight configurations leave much to the tails


def test_it_counts_from_the_nominal_values_that_it_was_found_with() -> None:
    result = result_of(ro.tikhonov, model(1), WEIGHT)
    moved = PROBLEM.parameters.nominal.copy()
    a2 = PROBLEM.parameters.names.index("a2")
    moved[a2] += 1e-3
    elsewhere = replace(PROBLEM.parameters, nominal=moved)
    here, there = (Prior.from_result(result).stated(p) for p in (PROBLEM.parameters, elsewhere))
    z = result.x / FREE.scale
    assert here.rows @ z == pytest.approx(here.values)
    z[FREE.names.index("a2")] -= 1e-3 / FREE.scale[FREE.names.index("a2")]
    assert there.rows @ z == pytest.approx(there.values, abs=1e-6 * np.abs(there.values).max())


def test_a_turned_frame_is_not_added_up() -> None:
    result = result_of(ro.tikhonov, model(1), WEIGHT)
    turned = PROBLEM.parameters.nominal.copy()
    turned[PROBLEM.parameters.names.index("base_rx")] += 0.1
    with pytest.raises(ro.InputError, match="'base_rx' relative to another nominal orientation"):
        Prior.from_result(result).stated(replace(PROBLEM.parameters, nominal=turned))
    Prior.from_result(result, without=["base_*"]).stated(replace(PROBLEM.parameters, nominal=turned))


@pytest.mark.parametrize(
    "arguments", [{"inflate": 0.0}, {"inflate": np.nan}, {"noise": -1.0}, {"without": ("b?",)}, {"without": ("*",)}]
)
def test_what_cannot_be_is_refused(arguments: dict[str, object]) -> None:
    with pytest.raises(ro.InputError, match=r"Prior\.from_result"):
        Prior.from_result(result_of(ro.tikhonov, model(1), WEIGHT), **arguments)


def test_a_lasso_has_no_posterior() -> None:
    with pytest.raises(ro.InputError, match="lasso"):
        Prior.from_result(ro.calibrate(PROBLEM, ro.lasso, weight=1.0))


def test_two_campaigns_of_one_arm_end_where_one_with_all_rows_does() -> None:
    rows = np.arange(len(PROBLEM.data))
    first, second = (PROBLEM.on(PROBLEM.data.take(part)) for part in (rows[:25], rows[25:]))
    prior = Prior.from_result(ro.calibrate(first, ro.tikhonov, weight=1.0), noise=1.0)
    mine = prior.stated(PROBLEM.parameters).penalized(ro.tikhonov)
    result = ro.calibrate(second, mine, weight=1.0)
    wanted = ro.calibrate(PROBLEM, ro.tikhonov, weight=1.0)
    sd = np.sqrt(np.diag(wanted.covariance))
    assert result.converged
    assert np.max(np.abs(result.x - wanted.x) / sd) < 0.05  # the model bends a little between the two
    assert np.sqrt(np.diag(result.covariance / result.fit_covariance.noise_variance)) == pytest.approx(
        np.sqrt(np.diag(wanted.covariance / wanted.fit_covariance.noise_variance)), rel=0.02
    )


def test_the_data_alone_say_what_least_squares_says() -> None:
    linear = model(1, rows=60)
    result = result_of(ro.tikhonov, linear, 1e6)
    names, rows, values = data_likelihood(result)
    robot = ~FREE.of_frames
    H = linear.A.T @ linear.A + np.diag(np.where(robot, 0.0, 0.01))  # frames are ten scales wide
    wanted = np.linalg.solve(H, linear.A.T @ linear.b) * FREE.scale
    assert names == tuple(name for name, own in zip(FREE.names, robot, strict=True) if own)
    assert np.linalg.solve(rows, values) == pytest.approx(wanted[robot], rel=1e-6)
    covariance = np.linalg.inv(H) * np.outer(FREE.scale, FREE.scale)
    assert np.linalg.inv(rows.T @ rows) == pytest.approx(covariance[np.ix_(robot, robot)], rel=1e-5)
