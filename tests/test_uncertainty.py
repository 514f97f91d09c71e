"""Uncertainty: intervals cover what they promise; the design that lowers it."""

from __future__ import annotations

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.design import choose, joint_cells, random_candidates, read_candidates
from rpim_opt.tables import csv_text
from tests.simulate import simulated
from tests.test_cli import run

Q = np.random.default_rng(77).uniform(-2, 2, (50, 6))


def covered(seeds: range) -> np.ndarray:
    """Share of predicted coordinates inside their 95 % intervals, calibration by calibration."""
    hits = []
    for seed in seeds:
        problem, truth = simulated(noise=5e-5, seed=seed, configurations=25)
        found = ro.Uncertainty(ro.calibrate(problem, ro.tikhonov, ro.reml)).predict(Q)
        want = problem.on(ro.Dataset.of(Q, np.zeros((50, 3)), 1.0)).modelled(truth)[0]
        hits.append(np.mean(np.abs(found.position - want) <= found.expanded))
    return np.array(hits)


def test_intervals_of_predicted_positions_cover() -> None:
    # 60 calibrations: the share's standard error is about 0.006
    assert 0.93 < covered(range(60)).mean() < 0.97


@pytest.mark.slow
def test_intervals_of_predicted_positions_cover_in_a_thousand_calibrations() -> None:
    assert 0.93 < covered(range(1000)).mean() < 0.97


def test_noise_and_prior_add_up_and_monte_carlo_agrees() -> None:
    problem, _ = simulated(noise=5e-5, seed=3, configurations=25)
    result = ro.calibrate(problem, ro.tikhonov, 1.0)
    u = ro.Uncertainty(result)
    scale = np.outer(problem.parameters.free.scale, problem.parameters.free.scale)
    assert np.abs((u.noise + u.prior - u.total) / scale).max() < 1e-12
    drawn = ro.monte_carlo(result, 1500)
    # the standard error of a standard deviation from 1500 draws is 1.8 %
    assert drawn.std(axis=0) / np.sqrt(np.diag(u.noise)) == pytest.approx(np.ones(34), abs=0.08)
    assert np.abs(drawn.mean(axis=0) - result.x).max() < 5 * np.sqrt(np.diag(u.total)).max()


def test_the_noise_is_compared_with_the_declared() -> None:
    for factor, word in ((1.0, "as declared"), (5.0, "rows are wrong"), (0.2, "too large")):
        problem, _ = simulated(noise=factor * 5e-5, seed=1)
        test = ro.Uncertainty(ro.calibrate(problem, ro.tikhonov, ro.reml)).noise_test()
        assert test.ratio == pytest.approx(factor, rel=0.25)
        assert word in test.verdict


def test_what_active_bounds_do_is_said() -> None:
    instance = ro.load("constrained", "wrong_tolerance")
    u = ro.Uncertainty(ro.calibrate(instance.problem, instance.formulation, instance.weight))
    assert "a5" in u.at_bound
    assert "a5 *" in u.budget()
    assert "held by a bound" in u.budget()
    with pytest.raises(ro.InputError, match="uncertainty: found formulation 'lasso'"):
        ro.Uncertainty(ro.calibrate(instance.problem, ro.lasso, 1.0))
    with pytest.raises(ro.InputError, match="confidence: found 95"):
        ro.Uncertainty(ro.calibrate(instance.problem, ro.tikhonov, 1.0), confidence=95)


def test_a_robust_fit_is_as_certain_as_one_of_the_rows_it_trusts() -> None:
    instance = ro.load("blunders")
    robust = ro.Uncertainty(ro.calibrate(instance.problem, ro.robust, 1.0))
    clean = ro.Uncertainty(ro.calibrate(robust.result.without_flagged().problem, ro.tikhonov, 1.0))
    q = instance.problem.data.q[:20]
    assert robust.predict(q).expanded == pytest.approx(clean.predict(q).expanded, rel=0.25)


@pytest.mark.parametrize("criterion", ["D", "A", "E", "V"])
def test_a_design_is_near_the_best_and_better_than_chance(criterion: str) -> None:
    problem = ro.load("position").problem
    q = random_candidates(problem.robot, 300, 1)
    found = choose(problem, q, 40, criterion)
    assert found.gap < 0.05
    assert len(set(found.chosen.tolist())) == 40
    assert found.weights.sum() == pytest.approx(40)
    assert (found.bound >= found.value) == (criterion in "DE")
    assert f"{criterion}-optimal" in str(found)
    assert "no other set is more than" in str(found)


def test_a_designed_set_predicts_better_than_the_best_of_two_hundred_random_ones() -> None:
    problem, truth = simulated(seed=5)
    robot = ro.Robot("limited", problem.robot.mdh, limits=np.tile([-2.0, 2.0], (6, 1)))
    q, scale = random_candidates(robot, 300, 2), problem.parameters.free.scale
    rng, there = np.random.default_rng(3), problem.on(ro.Dataset.of(Q, np.zeros((50, 3)), 1.0))
    want = there.modelled(truth)[0]
    exact = problem.on(ro.Dataset.of(q, np.zeros((300, 3)), 5e-5)).modelled(truth)[0]

    def predicted(index: np.ndarray) -> float:
        """Root mean square error over draws of the noise, each solved at the truth's linearization."""
        part = problem.on(ro.Dataset.of(q[index], exact[index], 5e-5))
        model = part.linearize(truth)
        inverse = np.linalg.inv(model.A.T @ model.A + np.eye(len(scale)))
        J = there.jacobian(truth) * scale
        z = truth / scale
        bias = J @ (inverse @ z)
        noise = np.einsum("ij,jk,ik->i", J @ inverse, model.A.T @ model.A, J @ inverse)
        return float(np.sqrt(np.mean(bias**2 + noise)))

    chosen = choose(problem, q, 40, "V", predicted=Q).chosen
    random = [predicted(rng.choice(300, 40, replace=False)) for _ in range(200)]
    assert predicted(chosen) < min(random)
    data = ro.Dataset.of(q[chosen], exact[chosen] + 5e-5 * rng.normal(size=(40, 3)), 5e-5)
    result = ro.calibrate(problem.on(data), ro.tikhonov, 1.0)
    assert np.sqrt(np.mean((there.modelled(result.x)[0] - want) ** 2)) < 1.3 * predicted(chosen)


def test_design_from_the_command_line(monkeypatch, capsys, tmp_path) -> None:
    out = tmp_path / "next.csv"
    assert run(monkeypatch, "design", "position", "--count", "40", "--candidates", "200", "--out", str(out)) == 0
    assert "40 of 200 configurations, V-optimal" in capsys.readouterr().out
    robot = ro.load("position").problem.robot
    q = read_candidates(out, robot)
    assert q.shape == (40, 6)
    again = tmp_path / "again.csv"
    cells = joint_cells(robot, q, np.arange(40))
    again.write_text(csv_text(cells, zip(*cells.values(), strict=True)))
    assert run(monkeypatch, "design", "position", "--count", "35", "--table", str(again), "--criterion", "D") == 0
    assert run(monkeypatch, "design", "position", "--criterion", "Q") == 2
    assert "criterion: found 'Q', accepted: D, A, E, V" in capsys.readouterr().err
