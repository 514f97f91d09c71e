"""Marginal likelihood: against the textbook's dense likelihood, differences, and what must not change it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import multivariate_normal

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.bayes import Prior
from rpim_opt.bayes.evidence import (
    FACTORS,
    NOISE_SD,
    Evidence,
    Hierarchy,
    Linearized,
    Point,
    Spectrum,
    widening,
)
from rpim_opt.bayes.hyperparameters import Estimator
from rpim_opt.problem.noise import Stack

NOISE = ("position", "orientation", "joint")


def hierarchy(group: list[int], heavy: list[bool], names: tuple[str, ...], tails: float = 3.0) -> Hierarchy:
    """Return beliefs without statements, sizes alike."""
    p = len(group)
    none = np.zeros((0, p))
    return Hierarchy(np.array(group), np.array(heavy), names, tails, np.zeros(p, bool), none, np.zeros(0))


def linearized(seed: int, configurations: int, p: int, k: int = 6) -> Linearized:
    """Return random equations of poses, in units in which noise is about 1e-4."""
    rng = np.random.default_rng(seed)
    m = configurations * k
    X = 1e-4 * rng.normal(size=(m, p))
    y = X @ rng.normal(size=p) + 1e-4 * rng.normal(size=m)
    index = rng.permutation(m).reshape(configurations, k)
    B = 2e-5 * rng.normal(size=(configurations, k, k))
    V = B @ B.transpose(0, 2, 1) + 1e-10 * np.eye(k)
    length = np.tile(np.arange(k) < (k + 1) // 2, (configurations, 1))
    joint = rng.normal(size=(configurations, k, 2))
    return Linearized(X, y, [Stack(index, V, length, ~length, joint)])


def dense(evidence: Evidence, logs: Array) -> tuple[Array, Array]:
    """Return the covariance (m, m) of the data apart from the deviations, and the data in its order."""
    repeatability = evidence.repeatability(logs)
    m = len(evidence.data.y)
    R = np.zeros((m, m))
    for stack in evidence.data.stacks:
        for index, block in zip(stack.index, stack.covariance(repeatability), strict=True):
            R[np.ix_(index, index)] = block
    return R, evidence.data.y


def hyperprior(evidence: Evidence, logs: Array) -> float:
    off = logs - evidence.centre
    sizes = len(evidence.prior.names)
    of_sizes = off[:sizes] @ np.linalg.solve(evidence.prior.covariance, off[:sizes])
    return float(of_sizes + np.sum((off[sizes:] / NOISE_SD) ** 2))


@pytest.mark.parametrize("rounding", [0.0, 3e-11])
def test_an_optimum_takes_few_evaluations_where_values_are_rounded(
    rounding: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Below rounding, values do not say whether a step leads on; and an optimum needs no second derivatives."""
    evidence = Evidence(linearized(3, 60, 8), hierarchy([0] * 4 + [1] * 4, [True] * 8, ("a", "b")), NOISE)
    (want,) = evidence.optima([evidence.centre])
    at, rng = Evidence.at, np.random.default_rng(0)
    points: list[Point] = []

    def rounded(self: Evidence, logs: Array, *near: Point) -> Point:
        point = at(self, logs, *near)
        points.append(replace(point, value=point.value * (1 + rounding * rng.uniform(-1, 1))))
        return points[-1]

    monkeypatch.setattr(Evidence, "at", rounded)
    (point,) = evidence.optima([evidence.centre])
    assert len(points) <= 12
    assert np.allclose(point.logs, want.logs, atol=1e-4)
    assert "_second" not in vars(point)
    assert sum("_second" in vars(other) for other in points) < len(points)


def test_normal_deviations_give_the_textbooks_likelihood() -> None:
    data = linearized(0, 5, 4)
    evidence = Evidence(data, hierarchy([0, 0, 1, -1], [False] * 4, ("a", "b")), NOISE)
    rng = np.random.default_rng(1)
    values = []
    for _ in range(4):
        logs = evidence.centre + 0.5 * rng.normal(size=5)
        R, y = dense(evidence, logs)
        size2 = np.array([np.exp(2 * logs[0])] * 2 + [np.exp(2 * logs[1]), 1.0])
        want = -2 * multivariate_normal(np.zeros(len(y)), R + (data.X * size2) @ data.X.T).logpdf(y)
        values.append(evidence.at(logs).value - hyperprior(evidence, logs) - want)
    # the constant m ln 2 pi is left out
    assert np.allclose(values, -len(data.y) * np.log(2 * np.pi), rtol=1e-9)


def test_mean_and_covariance_are_the_posteriors() -> None:
    data = linearized(2, 6, 3)
    evidence = Evidence(data, hierarchy([0, 0, -1], [False] * 3, ("a",)), NOISE)
    logs = evidence.centre + 0.3
    R, y = dense(evidence, logs)
    M = data.X.T @ np.linalg.solve(R, data.X) + np.diag([np.exp(-0.6)] * 2 + [1.0])
    point = evidence.at(logs)
    assert np.allclose(point.C, np.linalg.inv(M), rtol=1e-8)
    assert np.allclose(point.z, np.linalg.solve(M, data.X.T @ np.linalg.solve(R, y)), rtol=1e-8)


@pytest.mark.parametrize("tails", [3.0, 5.0])
@pytest.mark.parametrize("seed", range(3))
def test_gradients_are_differences(seed: int, tails: float) -> None:
    data = linearized(seed, 6, 5)
    heavy = [True, True, False, False, False]
    evidence = Evidence(data, hierarchy([0, 0, 1, 1, -1], heavy, ("a", "b"), tails), (*NOISE, "instrument"))
    logs = evidence.centre + 0.4 * np.random.default_rng(seed).normal(size=6)
    steps = 1e-5 * np.eye(6)
    want = [(evidence.at(logs + s).value - evidence.at(logs - s).value) / 2e-5 for s in steps]
    found = evidence.at(logs).gradient
    assert np.abs(found - want).max() <= 1e-6 * np.abs(found).max()


@pytest.mark.parametrize("noise", [(), ("position",), (*NOISE, "instrument")])
@pytest.mark.parametrize("seed", range(3))
def test_second_derivatives_and_slopes_are_differences(seed: int, noise: tuple[str, ...]) -> None:
    """Heavy, light, free and stated deviations, two stacks, with a unit of positions of its own in one."""
    data = linearized(seed, 6, 6)
    more = linearized(seed + 10, 4, 6, k=3)
    unit = np.random.default_rng(seed).normal(size=(4, 3, 3))
    second = replace(more.stacks[0], index=more.stacks[0].index + len(data.y), unit=unit @ unit.transpose(0, 2, 1))
    both = Linearized(np.vstack([data.X, more.X]), np.append(data.y, more.y), [*data.stacks, second])
    plain = hierarchy([0, 0, 0, 1, 1, -1], [True, True, True, False, False, False], ("a", "b"), 3.0)
    rows, values = np.eye(6)[4:5] + 0.3, np.array([0.7])
    stated = replace(plain, replaced=np.arange(6) == 2, rows=rows, values=values)
    evidence = Evidence(both, stated, noise)
    logs = evidence.centre + 0.4 * np.random.default_rng(seed).normal(size=len(evidence.centre))
    sides = [(evidence.at(logs + s), evidence.at(logs - s)) for s in 1e-5 * np.eye(len(logs))]
    found = evidence.at(logs)
    curvature = np.array([after.gradient - before.gradient for after, before in sides]) / 2e-5
    assert np.abs(found.curvature - curvature).max() <= 1e-6 * np.abs(curvature).max()
    means = np.array([after.z - before.z for after, before in sides]).T / 2e-5
    assert np.abs(found.slopes - means).max() <= 1e-6 * np.abs(means).max()
    M = found.C @ np.diag(np.arange(1.0, 7.0)) @ found.C
    rises = [np.diag(after.C - before.C) @ np.arange(1.0, 7.0) / 2e-5 for after, before in sides]
    assert np.allclose(found.falls(M), rises, rtol=1e-6, atol=1e-6 * np.abs(rises).max())


@pytest.mark.parametrize("count", [3, 60])
def test_posterior_and_derivatives_beside_a_spectrum(count: int) -> None:
    """Of fewer coefficients than the 36 equations, and of more."""
    plain = hierarchy([0, 0, 0] + [-1] * count, [True, True] + [False] * (1 + count), ("a",))
    spectrum = Spectrum(np.geomspace(1.0, 900.0, count), np.full(count, 2e-8))
    evidence = Evidence(linearized(1, 6, 3 + count), replace(plain, spectrum=spectrum), NOISE)
    logs = evidence.centre + 0.4 * np.random.default_rng(1).normal(size=6)
    sides = [(evidence.at(logs + s), evidence.at(logs - s)) for s in 1e-5 * np.eye(6)]
    found = evidence.at(logs)
    R, y = dense(evidence, logs)
    X = evidence.data.X
    covariance = np.linalg.inv(X.T @ np.linalg.solve(R, X) + np.diag(1 / found.v))
    assert np.allclose(found.C, covariance, rtol=1e-7, atol=1e-9 * np.abs(covariance).max())
    assert np.allclose(found.z, covariance @ X.T @ np.linalg.solve(R, y), rtol=1e-7, atol=1e-9 * np.abs(found.z).max())
    M = found.C @ found.C
    rises = [np.trace(after.C - before.C) / 2e-5 for after, before in sides]
    assert np.allclose(found.falls(M), rises, rtol=1e-5, atol=1e-6 * np.abs(rises).max())
    gradient = np.array([after.value - before.value for after, before in sides]) / 2e-5
    curvature = np.array([after.gradient - before.gradient for after, before in sides]) / 2e-5
    slopes = np.array([after.z - before.z for after, before in sides]).T / 2e-5
    assert np.allclose(found.gradient, gradient, rtol=1e-5, atol=1e-6 * np.abs(gradient).max())
    assert np.allclose(found.curvature, curvature, rtol=1e-5, atol=1e-6 * np.abs(curvature).max())
    assert np.allclose(found.slopes, slopes, rtol=1e-5, atol=1e-6 * np.abs(slopes).max())


@pytest.mark.parametrize("seed", range(4))
def test_no_point_next_to_an_optimum_is_lower(seed: int) -> None:
    heavy = [True, True, True, True, False, False, False]
    evidence = Evidence(linearized(seed, 12, 7), hierarchy([0, 0, 0, 0, 1, 1, -1], heavy, ("a", "b")), NOISE)
    (point,) = evidence.optima([evidence.centre])

    def objective(logs: Array) -> tuple[float, Array]:
        there = evidence.at(logs)
        return there.value, there.gradient

    for start in (evidence.centre, point.logs):
        found = minimize(objective, start, jac=True, method="L-BFGS-B", options={"ftol": 1e-14, "gtol": 1e-8})
        assert point.value <= found.fun + 1e-8 * abs(found.fun)


def test_heavy_tails_of_infinite_freedom_are_normal() -> None:
    data = linearized(3, 6, 4)
    normal = Evidence(data, hierarchy([0, 0, 0, -1], [False] * 4, ("a",)), ("position",))
    heavy = replace(normal, prior=hierarchy([0, 0, 0, -1], [True] * 3 + [False], ("a",), 1e9))
    logs = normal.centre + 0.2
    values = [each.at(logs).value - hyperprior(each, logs) for each in (normal, heavy)]
    assert values[0] == pytest.approx(values[1], abs=1e-5)
    assert np.allclose(normal.at(logs).z, heavy.at(logs).z, rtol=1e-6)


def test_a_deviation_that_nothing_decides_adds_nothing() -> None:
    data = linearized(4, 6, 3)
    evidence = Evidence(data, hierarchy([0, 0, 0], [True] * 3, ("a",)), NOISE)
    wider = Evidence(
        replace(data, X=np.column_stack([data.X, np.zeros(len(data.y))])), hierarchy([0] * 4, [True] * 4, ("a",)), NOISE
    )
    for shift in (-1.0, 0.0, 2.0):
        logs = evidence.centre + shift
        assert wider.at(logs).value == pytest.approx(evidence.at(logs).value, abs=1e-8)


def test_local_variances_are_a_fixed_point_and_bound_student_t() -> None:
    data = linearized(5, 8, 4)
    evidence = Evidence(data, hierarchy([0] * 4, [True] * 4, ("a",)), ("position",))
    point = evidence.at(evidence.centre - 0.7)
    size2 = np.exp(2 * point.logs[0])
    assert np.allclose(point.v, (3 * size2 + point.z**2 + np.diag(point.C)) / 4, rtol=1e-7)


@pytest.mark.parametrize(
    ("name", "seed", "off"),
    [
        ("paper_arm", 0, [-1.64, -3.5, -0.5]),
        ("paper_arm", 2, [-1.64, -3.5, -0.5]),
        ("pose", 2, [-0.95, -3.01, -4.09, 0.8]),
    ],
)
def test_local_variances_settle_where_steps_each_for_itself_run_in_circles(
    name: str, seed: int, off: list[float]
) -> None:
    problem = ro.load(name).problem
    few = problem.on(problem.data.configurations(6, seed))
    evidence = Estimator(Prior(), NOISE).evidence(few, np.zeros(len(few.parameters.free)))
    sizes = len(evidence.prior.names)
    point = evidence.at(evidence.centre + np.array(off[:1] * sizes + off[1:]))
    heavy = evidence.prior.heavy
    e2 = point.z**2 + np.diag(point.C)
    size2 = np.exp(2 * point.logs[0])
    np.testing.assert_allclose(point.v[heavy], (3 * size2 + e2[heavy]) / 4, rtol=1e-7)


def test_a_blunder_does_not_widen_local_variances_beyond_what_rounding_leaves() -> None:
    """Of two directions that nothing tells apart, 1 / v is all that is known: it must not vanish beside rounding."""
    data = linearized(1, 10, 4)
    X = data.X.copy()
    X[:, 1] = X[:, 0]
    y = X @ np.array([1e7, 0.0, 1.0, -1.0])  # tails take such a deviation for 5e6 of its scales
    evidence = Evidence(replace(data, X=X, y=y), hierarchy([0] * 4, [True] * 4, ("size",)), ())
    point = evidence.at(evidence.centre)
    assert point.v.max() <= 1e8
    assert np.isfinite(point.gradient).all()
    assert (X @ point.z)[:5] == pytest.approx(y[:5], rel=1e-3)


def test_statements_are_measurements_without_repeatability() -> None:
    data = linearized(6, 5, 3)
    rows = np.array([[1.0, -1.0, 0.0], [0.0, 3.0, 1.0]])
    values = np.array([0.4, -0.2])
    plain = hierarchy([0, 0, 0], [False] * 3, ("a",))
    stated = Evidence(data, replace(plain, rows=rows, values=values), ("position",))
    stack = data.stacks[0]
    # the same as two more configurations, each of one equation of unit noise that no repeatability reaches
    one = np.zeros((2, 1), dtype=bool)
    more = Stack(np.array([[30], [31]]), np.ones((2, 1, 1)), one, one, np.zeros((2, 1, 2)))
    longer = Linearized(np.vstack([data.X, rows]), np.concatenate([data.y, values]), [stack, more])
    want = Evidence(longer, plain, ("position",))
    logs = stated.centre + 0.1
    assert stated.at(logs).value == pytest.approx(want.at(logs).value, rel=1e-12)
    assert np.allclose(stated.at(logs).gradient, want.at(logs).gradient, rtol=1e-9)


def test_a_replaced_deviation_has_no_size() -> None:
    data = linearized(7, 5, 3)
    plain = hierarchy([0, 0, 0], [True] * 3, ("a",))
    rows = np.array([[0.0, 0.0, 2.0]])
    stated = replace(plain, rows=rows, values=np.array([1.0]), replaced=np.array([False, False, True]))
    evidence = Evidence(data, stated, ("position",))
    logs = evidence.centre
    R, _ = dense(evidence, logs)
    own = 1 / evidence.at(logs).v
    M = data.X.T @ np.linalg.solve(R, data.X) + np.diag([own[0], own[1], 4.0])
    assert np.allclose(evidence.at(logs).C, np.linalg.inv(M), rtol=1e-7)
    step = np.array([1e-5, 0.0])
    slope = (evidence.at(logs + step).value - evidence.at(logs - step).value) / 2e-5
    assert evidence.at(logs).gradient[0] == pytest.approx(slope, rel=1e-6)


def test_several_starts_find_both_optima_of_few_data() -> None:
    """Few equations: little noise and large deviations, or all of it noise."""
    found = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        X = 1e-3 * rng.normal(size=(9, 6))
        y = X @ (5 * rng.standard_t(3, size=6))
        stack = Stack(np.arange(9).reshape(3, 3), np.full((3, 1, 1), 1e-12) * np.eye(3), np.ones((3, 3), bool),
                      np.zeros((3, 3), bool), np.zeros((3, 3, 0)))  # fmt: skip
        evidence = Evidence(Linearized(X, y, [stack]), hierarchy([0] * 6, [True] * 6, ("a",)), ("position",))
        points = evidence.optima(evidence.starts())
        assert [p.value for p in points] == sorted(p.value for p in points)
        found.append(points[0].value <= evidence.optima([evidence.centre])[0].value + 1e-6)
        assert np.abs(points[0].gradient).max() < 1e-2
    assert all(found)


def test_a_way_into_an_optimum_that_is_known_is_not_climbed_to_its_end() -> None:
    evidence = Evidence(linearized(3, 8, 4), hierarchy([0, 0, 1, 1], [True] * 4, ("a", "b")), ("position",))
    (alone,) = evidence.optima([evidence.centre])
    points = evidence.optima([evidence.centre, evidence.centre + 0.5, evidence.centre - 0.5])
    assert len(points) == 1
    assert points[0].value == pytest.approx(alone.value, rel=1e-12)


def test_sizes_of_simulated_data_are_found() -> None:
    """Many deviations and configurations: sizes within their spread of the truth."""
    rng = np.random.default_rng(10)
    N, p = 400, 60
    T = rng.normal(size=(N, 3, 4))
    X = rng.normal(size=(3 * N, p))
    z = 0.3e-3 * rng.normal(size=p)
    noise = 5e-5 * rng.normal(size=(N, 3)) + 2e-5 * rng.normal(size=(N, 3))
    noise += np.einsum("nkd,nd->nk", T, 8e-5 * rng.normal(size=(N, 4)))
    stack = Stack(np.arange(3 * N).reshape(N, 3), np.full((N, 1, 1), 4e-10) * np.eye(3), np.ones((N, 3), bool),
                  np.zeros((N, 3), bool), T)  # fmt: skip
    data = Linearized(1e-3 * X, 1e-3 * X @ (z / 1e-3) + noise.ravel(), [stack])
    evidence = Evidence(data, hierarchy([0] * p, [False] * p, ("a",)), ("position", "joint"))
    point = evidence.optima(evidence.starts())[0]
    assert np.abs(point.logs - np.log([0.3, 5e-5, 8e-5])).max() < 0.25


@pytest.mark.slow
def test_a_gibbs_sampler_agrees() -> None:
    """Student's t as a scale mixture, sampled for long at the sizes found: means and deviations within its error."""
    problem = ro.load("position").problem
    few = problem.on(problem.data.configurations(15, 0))
    result = ro.calibrate(few)
    free = few.parameters.free
    stated = ro.bayes.Prior().stated(few.parameters)
    unit = free.scale * stated.scale
    J = result.problem.jacobian(result.x) * unit
    y = few.residual(result.x) + result.problem.jacobian(result.x) @ result.x
    R = np.zeros((len(y), len(y)))
    for stack in result.problem.stacks(False):
        for index, block in zip(stack.index, stack.covariance(result.problem.repeatability), strict=True):
            R[np.ix_(index, index)] = block
    sizes = np.append([size.value for size in result.learned.scales.values()], 1.0)
    size = sizes[stated.group]
    W = np.linalg.inv(np.linalg.cholesky(R))
    A, b = W @ J, W @ y
    rng = np.random.default_rng(0)
    v = size**2
    draws = []
    for k in range(6000):
        L = np.linalg.cholesky(A.T @ A + np.diag(1 / v))
        mean = np.linalg.solve(L.T, np.linalg.solve(L, A.T @ b))
        z = mean + np.linalg.solve(L.T, rng.normal(size=len(v)))
        v = np.where(stated.heavy, (3 * size**2 + z**2) / rng.chisquare(4, size=len(v)), size**2)
        if k >= 1000:
            draws.append(z)
    z = np.array(draws)
    batches = z.reshape(50, 100, -1).mean(axis=1)
    error = batches.std(axis=0) / np.sqrt(50)
    spread = z.std(axis=0)
    found = result.x / unit
    # the mean field is an approximation: a fifth of a standard deviation is allowed beside the sampler's own error
    assert np.abs(found - z.mean(axis=0)).max() < np.max(4 * error + 0.35 * spread)
    stated_spread = np.sqrt(np.diag(result.covariance)) / unit
    over = np.log(stated_spread / spread)
    # of the normals that stand for the tails alone 0.77 of the sampler's, some 0.6
    assert abs(np.mean(over)) < 0.06
    assert np.abs(over).max() < 0.2


def test_what_halves_miss_of_each_other_widens_the_covariance() -> None:
    """Equations of one model add nothing; where it differs between halves, the factor is the likeliest, densely."""
    rng = np.random.default_rng(4)
    m, p = 60, 5
    X = rng.normal(size=(m, p))
    one, every = np.ones((m, 1, 1)), np.ones((m, 1), dtype=bool)
    prior = hierarchy([-1] * p, [False] * p, ())
    half = np.arange(m) < m // 2
    for lack in (0.0, 1.5):
        y = X @ rng.normal(size=p) + lack * half * X[:, 0] + rng.normal(size=m)
        data = Linearized(X, y, [Stack(np.arange(m)[:, None], one, every, ~every, np.zeros((m, 1, 0)))])
        evidence = Evidence(data, prior, ())
        point = evidence.at(np.zeros(0))
        factors = evidence.overdispersion(point, np.column_stack([np.arange(m), np.zeros(m)]))
        value = np.zeros(len(FACTORS))
        for inside in (half, ~half):
            C = np.linalg.inv(X[inside].T @ X[inside] + np.eye(p))
            error = y[~inside] - X[~inside] @ C @ X[inside].T @ y[inside]
            for i, factor in enumerate(FACTORS):
                V = np.eye(m // 2) + factor * X[~inside] @ C @ X[~inside].T
                value[i] += np.linalg.slogdet(V)[1] + error @ np.linalg.solve(V, error)
        factor = FACTORS[np.argmin(value)]
        assert (factor > 2) == (lack > 0)
        assert factors.tolist() == [factor, 1]  # a joint that did not move tells nothing
        D = widening(point.C, factor, np.zeros((0, p)))
        np.testing.assert_allclose(D @ D.T, (factor - 1) * point.C, rtol=1e-6, atol=1e-12)
        stated = np.array([[0.3, 0.0, -2.0, 0.0, 0.0]])  # what is known besides is as well known as before
        C = np.linalg.inv(X.T @ X + np.eye(p) + stated.T @ stated)
        D = widening(C, factor, stated)
        wide = np.linalg.inv((X.T @ X + np.eye(p)) / factor + stated.T @ stated)
        np.testing.assert_allclose(C + D @ D.T, wide, rtol=1e-6, atol=1e-12)
