"""Inliers of a robust loss: a limit that good data rarely exceed, whatever the noise, and the weight of the rest."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest
from scipy.stats import chi2

import rpim_opt as ro
from rpim_opt.convex.robust_loss import Inliers, inliers_of, kept_equations, limits, noise_level, outlying
from rpim_opt.problem import LinearModel
from tests.simulate import simulated

COUNT = np.array([1, 2, 3, 3, 6])
MEDIANS = np.sqrt(chi2.ppf(0.5, COUNT))


def linear() -> LinearModel:
    problem, _ = simulated(noise=5e-5)
    return problem.linearize(np.zeros(len(problem.parameters.free)))


HUBER = ro.Formulation("f", loss=ro.huber(1.5), loss_over="configuration")


@pytest.mark.parametrize(("repeatability", "noise"), [(0.3, 1.0), (1.0, 1.0), (7.0, 7.0)])
def test_the_noise_is_what_norms_show_and_at_least_the_declared(repeatability: float, noise: float) -> None:
    assert noise_level(repeatability * MEDIANS, COUNT) == pytest.approx(noise, rel=1e-12)


def test_one_blunder_does_not_make_noise() -> None:
    norms = 3 * MEDIANS
    norms[0] *= 1e6
    assert noise_level(norms, COUNT) == pytest.approx(3.0, rel=1e-12)


def test_one_good_set_of_data_in_a_hundred_has_an_outlier() -> None:
    """Bonferroni: every configuration has an N-th part of that probability, whatever its number of equations."""
    for configurations in (1, 40, 1000):
        rare = chi2.sf(limits(1.0, configurations, COUNT) ** 2, COUNT)
        assert rare == pytest.approx(0.01 / configurations, rel=1e-6)
    assert limits(2.5, 40, COUNT) == pytest.approx(2.5 * limits(1.0, 40, COUNT), rel=1e-12)


def test_what_is_outlying_follows_noise_and_number() -> None:
    norms = 4 * MEDIANS
    assert outlying(norms, COUNT) == pytest.approx(4 * limits(1.0, 5, COUNT), rel=1e-12)
    assert outlying(0.1 * MEDIANS, COUNT) == pytest.approx(limits(1.0, 5, COUNT), rel=1e-12)


def test_equations_are_kept_by_configuration_up_to_the_limit() -> None:
    """Uneven configurations, whose equations are not in the order of their numbers."""
    group = np.array([7, 2, 2, 5, 7, 5, 5, 9])
    _, which, count = np.unique(group, return_inverse=True, return_counts=True)
    problem, _ = simulated(("a[234]", "d5"), noise=5e-5)
    limit = limits(2.0, 40, count)
    inliers = Inliers(2.0, 40, 1.0)
    for outlier in range(4):
        norms = limit * (1 - 1e-9)
        norms[outlier] = limit[outlier] * (1 + 1e-9)
        b = (norms / np.sqrt(count))[which]
        model = LinearModel(np.ones((8, 4)), b + 4.0, group, problem.parameters.free)
        assert (inliers.keeps(model, np.ones(4)) == (which != outlier)).all()


def test_the_kept_equations_weigh_their_factor() -> None:
    model = linear()
    keep = model.group % 3 != 0
    z = np.linspace(-1, 1, model.A.shape[1])
    kept = kept_equations(model, keep, 0.25)
    squares = (model.A @ z - model.b) ** 2
    assert np.sum((kept.A @ z - kept.b) ** 2) == pytest.approx(0.25 * np.sum(squares[keep]), rel=1e-12)
    assert (kept.group == model.group[keep]).all()


def test_inliers_called_return_the_kept_equations_and_no_constant() -> None:
    model = linear()
    inliers = Inliers(1.0, 40, 0.5)
    z = np.zeros(model.A.shape[1])
    kept, constant = inliers(model, z)
    expected = kept_equations(model, inliers.keeps(model, z), 0.5)
    assert constant == 0.0
    assert (kept.A == expected.A).all()
    assert (kept.b == expected.b).all()


def test_a_factor_is_the_losss_over_the_squares() -> None:
    """Huber's loss is the square within its threshold, and falls behind it as threshold / v."""
    norms = np.array([0.1, 1.0, 1.2, 3.0, 3.1, 3.2, 3.3, 1e9])
    count = np.full(8, 3)
    assert inliers_of(HUBER, norms[:3], count[:3]).factor == 1.0
    some = inliers_of(HUBER, norms, count)
    assert some.factor == pytest.approx(1.5 / 3.0, rel=1e-12)  # the median of seven: the blunder is not among them
    assert some.configurations == 8
    assert some.noise == pytest.approx(noise_level(norms, count), rel=1e-12)


def test_a_factor_by_equations_is_that_of_their_sizes() -> None:
    norms, count = np.full(4, 3.0 * np.sqrt(3)), np.full(4, 3)  # three sigmas of each equation
    assert inliers_of(replace(HUBER, loss_over="equation"), norms, count).factor == pytest.approx(1.5 / 3.0, rel=1e-12)


def test_a_residual_of_zero_has_the_factor_of_a_millionth_sigma() -> None:
    found = inliers_of(ro.sum_of_norms, np.zeros(3), np.full(3, 3))
    assert found.factor == pytest.approx(0.5e6, rel=1e-12)


@pytest.mark.parametrize(
    ("loss", "said"),
    [
        (lambda v: cp.sum_squares(v - cp.Variable()), "a loss with own variables"),
        (cp.max, "a loss that depends on a few equations"),
    ],
)
def test_a_loss_that_has_no_factor_is_named(loss: Any, said: str) -> None:
    mine = ro.Formulation("mine", loss=loss)
    with pytest.raises(
        ro.InputError, match=f"formulation 'mine': found {said}, accepted: a loss with gradients, without own variables"
    ):
        inliers_of(mine, np.full(5, 2.0), np.full(5, 3))


def test_inliers_of_blocks_are_those_of_whole_data() -> None:
    instance = ro.load("blunders")
    x = ro.calibrate(instance.problem, ro.robust, 1.0).x
    z = x / instance.problem.parameters.free.scale
    program = ro.convex.pose(ro.robust, instance.problem.linearize(x))
    whole, parts = program.inliers(z), inliers_of(ro.robust, *instance.problem.configuration_errors(x))
    assert whole is not None
    assert (parts.noise, parts.factor) == pytest.approx((whole.noise, whole.factor), rel=1e-9)
    assert parts.configurations == whole.configurations


def test_parts_take_the_equations_of_a_configuration_as_alike() -> None:
    instance = ro.load("blunders")
    x = np.zeros(len(instance.problem.parameters.free))
    formulation = replace(ro.robust, loss=cp.norm1, loss_over="equation")
    norms, count = instance.problem.configuration_errors(x)
    typical = norms[norms <= outlying(norms, count)] / np.sqrt(3)
    parts = inliers_of(formulation, norms, count)
    assert parts.factor == pytest.approx(np.median(0.5 / typical), rel=0.2)
