"""What arms of one type share is learned, and shrunken where they say little."""

from __future__ import annotations

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.bayes import Prior
from rpim_opt.bayes.population import expectation, random_effects

n = 12


def arms(
    count: int, common: np.ndarray, own: np.ndarray, sd: float, seed: int = 0
) -> tuple[list[tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """Arms that are seen through dense matrices with noise, and their deviations (count, n)."""
    rng = np.random.default_rng(seed)
    truth = common + own * rng.standard_normal((count, n))
    made = []
    for u in truth:
        rows = np.linalg.qr(rng.standard_normal((n, n)))[0] / sd
        made.append((rows, rows @ u + rng.standard_normal(n)))
    return made, truth


def test_expectations_are_those_of_the_joint_normal_distribution() -> None:
    K, few = 3, 4
    rng = np.random.default_rng(1)
    rows = rng.standard_normal((K, 6, few))
    values = rng.standard_normal((K, 6))
    s2, ratio = np.array([0.2, 1.0, 3.0, 0.5]), 0.7
    P = np.einsum("kij,kil->kjl", rows, rows)
    q = np.einsum("kij,ki->kj", rows, values)
    m, C_m, d2 = expectation(P, q, s2, ratio)
    # unknowns (m, d_1, ..., d_K), all at once
    size = few * (K + 1)
    precision = np.diag(np.concatenate([1 / (ratio * s2), *[1 / s2] * K]))
    right = np.zeros(size)
    for k in range(K):
        see = np.zeros((6, size))
        see[:, :few] = rows[k]
        see[:, few * (k + 1) : few * (k + 2)] = rows[k]
        precision += see.T @ see
        right += see.T @ values[k]
    C = np.linalg.inv(precision)
    mean = C @ right
    assert m == pytest.approx(mean[:few], rel=1e-9)
    assert C_m == pytest.approx(C[:few, :few], rel=1e-9)
    assert d2.ravel() == pytest.approx(mean[few:] ** 2 + np.diag(C)[few:], rel=1e-9)


def test_many_arms_that_are_seen_well_tell_everything() -> None:
    rng = np.random.default_rng(2)
    own = np.geomspace(0.1, 3.0, n)
    common = 2 * own * rng.standard_normal(n)
    made, truth = arms(400, common, own, sd=0.01)
    centre, width = random_effects(made)
    error = own / np.sqrt(400)
    assert np.abs(centre - common).max() < 4 * error.max()
    assert width == pytest.approx(truth.std(axis=0), rel=0.03)


def test_arms_that_say_nothing_leave_the_generic_widths() -> None:
    centre, width = random_effects([(1e-6 * np.eye(n), np.zeros(n))] * 3)
    assert centre == pytest.approx(np.zeros(n), abs=1e-9)
    assert width == pytest.approx(np.ones(n), rel=1e-3)


def test_few_arms_are_shrunken_towards_the_spread_that_all_have() -> None:
    common, own = np.zeros(n), np.where(np.arange(n) == 0, 5.0, 0.5)
    ratio = []
    for count in (2, 5, 40):
        made, truth = arms(count, common, own, sd=0.01, seed=3)
        width = random_effects(made)[1]
        sample = truth.std(axis=0)
        ratio.append(np.ptp(np.log(width)) / np.ptp(np.log(sample)))
    assert ratio[0] < ratio[1] < ratio[2]
    assert ratio[0] < 0.6
    assert ratio[2] > 0.8


def few_data(x: np.ndarray, sd: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((6, n)) / sd
    return rows, rows @ x + rng.standard_normal(6)


def estimate(rows: np.ndarray, values: np.ndarray, centre: np.ndarray, width: np.ndarray) -> np.ndarray:
    left = np.linalg.inv(rows.T @ rows + np.diag(width**-2))
    return left @ (rows.T @ values + centre / width**2)


def test_another_arm_gains_by_what_the_others_share() -> None:
    rng = np.random.default_rng(5)
    better = []
    for seed in range(30):
        common = 0.9 * rng.standard_normal(n)
        made, _ = arms(6, common, np.full(n, 0.4), sd=0.05, seed=seed)
        found = random_effects(made[:5])
        x = common + 0.4 * rng.standard_normal(n)
        rows, values = few_data(x, 0.05, seed)
        errors = [np.linalg.norm(estimate(rows, values, *prior) - x) for prior in (found, (np.zeros(n), np.ones(n)))]
        better.append(errors[1] / errors[0])
    assert np.exp(np.mean(np.log(better))) > 1.5


# --- from calibrations ----------------------------------------------------------------------------------------------


def test_the_prior_of_a_population_centres_on_what_calibrations_share() -> None:
    problem = ro.load("position").problem
    rows = np.arange(len(problem.data))
    results = {f"arm {k}": ro.calibrate(problem.on(problem.data.take(rows[k::3])), ro.tikhonov, 1.0) for k in range(3)}
    stated = Prior.from_population(results).stated(problem.parameters)
    free = problem.parameters.free
    robot = ~free.of_frames
    assert (stated.scale[~robot] == 10).all()
    full = ro.calibrate(problem, ro.tikhonov, 1.0)
    generic = Prior().stated(problem.parameters).scale * free.scale
    known = robot & (np.sqrt(np.diag(full.covariance)) < 0.1 * generic)
    assert known.sum() > 8
    apart = stated.centre * free.scale - full.x
    assert (apart / generic)[known] == pytest.approx(0, abs=0.25)


def test_the_order_of_the_arms_does_not_matter() -> None:
    """Also of arms whose scales were estimated: what is generic is what was stated."""
    problem = ro.load("position").problem
    results = [ro.calibrate(problem.on(problem.data.take(np.arange(k, 40, 2)))) for k in (0, 1)]
    one, other = (Prior.from_population(each).stated(problem.parameters) for each in (results, results[::-1]))
    assert one.centre == pytest.approx(other.centre, abs=1e-6)
    assert one.scale == pytest.approx(other.scale, rel=1e-6)


def test_a_rejected_population_takes_nothing_else_with_it() -> None:
    both = Prior(centre={"a2_mm": 0.5}) & Prior(centre={"d4_mm": 0.1}, scale={"d4_mm": 0.2}, optional=("d4_mm",))
    assert both.without_optional() == Prior(centre={"a2_mm": 0.5})


@pytest.mark.parametrize("count", [0, 1])
def test_one_arm_is_no_population(count: int) -> None:
    result = ro.calibrate(ro.load("position").problem, ro.tikhonov, 1.0)
    with pytest.raises(ro.InputError, match="two robots"):
        Prior.from_population([result] * count)


def test_arms_of_another_type_are_refused() -> None:
    results = [ro.calibrate(ro.load(name).problem, ro.tikhonov, 1.0) for name in ("position", "paper_arm")]
    with pytest.raises(ro.InputError, match="robots of one type"):
        Prior.from_population(results)
