"""Configurations to measure next: the design that lowers the uncertainty of what is predicted."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics.tables import csv_text
from rpim_opt.problem import choose, random_candidates
from rpim_opt.problem.design import joint_cells, read_candidates
from tests.simulate import simulated
from tests.test_cli import run

Q = np.random.default_rng(77).uniform(-2, 2, (50, 6))


@pytest.mark.parametrize("criterion", ["D", "A", "V"])
def test_a_design_is_near_the_best_and_better_than_chance(criterion: str) -> None:
    problem = ro.load("position").problem
    q = random_candidates(problem.robot, 300, 1)
    found = choose(problem, q, 40, criterion)
    assert found.gap < 0.05
    assert len(set(found.chosen.tolist())) == 40
    assert found.weights.sum() == pytest.approx(40)
    assert (found.bound >= found.value) == (criterion == "D")
    assert f"{criterion}-optimal" in str(found)
    assert "no other choice is more than" in str(found)


@pytest.mark.slow
def test_a_designed_set_predicts_better_than_the_best_of_two_hundred_random_ones() -> None:
    problem, truth = simulated(seed=5)
    robot = ro.robot.Robot("limited", problem.robot.mdh, limits=np.tile([-2.0, 2.0], (6, 1)))
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

    chosen = choose(problem, q, 40, "V").chosen
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
    assert "criterion: found 'Q', accepted: D, A, V" in capsys.readouterr().err


def test_what_is_measured_already_counts() -> None:
    """Value and choice are those of the information of all rows."""
    problem = ro.load("position").problem
    q = random_candidates(problem.robot, 60, 3)
    still = np.zeros(len(problem.parameters.free))
    there = problem.on(ro.Dataset.of(q, np.zeros((60, 3)), np.sqrt(problem.data.blocks[0].covariance[0, 0, 0])))
    rows = there.linearize(still).A.reshape(60, 3, -1)
    known = problem.linearize(still).A
    already = np.eye(known.shape[1]) + known.T @ known

    def information(chosen: np.ndarray) -> np.ndarray:
        return already + np.einsum("kin,kim->nm", rows[chosen], rows[chosen])

    found = choose(problem, q, 6, "D", measured=problem.data)
    assert found.value == pytest.approx(np.linalg.slogdet(information(found.chosen))[1], rel=1e-8)
    alone = choose(problem, q, 6, "D")
    assert np.linalg.slogdet(information(alone.chosen))[1] < np.linalg.slogdet(information(found.chosen))[1]
    slopes = there.jacobian(still).reshape(60, 3, -1) * problem.parameters.free.scale
    C = np.einsum("kin,kim->nm", slopes, slopes) / 60
    found = choose(problem, q, 6, "V", measured=problem.data)
    assert found.value == pytest.approx(np.trace(np.linalg.solve(information(found.chosen), C)), rel=1e-8)


FEW = (9, 4)
"""Candidates, and how many of them: every set can be tried."""


def small() -> tuple[ro.CalibrationProblem, np.ndarray]:
    arm = ro.robot.Robot(
        "two links", np.array([[0, 0, 0, 0, 0], [0, 0.4, 0, 0, 0]]), limits=np.tile([-2.0, 2.0], (2, 1))
    )
    problem, _ = simulated(("theta2", "tool_x", "base_[xy]"), configurations=3, robot=arm, seed=8)
    # directions that a design weighs, not ones that any three readings decide
    there = problem.parameters.scaled({"tool_mm": 0.3, "base_mm": 0.3, "angle_mrad": 0.3})
    data = ro.Dataset.of(problem.data.q, problem.data.blocks[0].y, 2e-4)
    return ro.CalibrationProblem(arm, there, data), random_candidates(arm, FEW[0], 4)


@pytest.mark.parametrize("criterion", "DAV")
def test_of_few_candidates_the_best_of_all_sets_is_between_the_found_one_and_the_bound(criterion: str) -> None:
    """Found is within its own gap of what trying every set finds; a maximum for D, else a minimum."""
    problem, q = small()
    n = len(problem.parameters.free)
    there = problem.on(ro.Dataset.of(q, np.zeros((len(q), 3)), 2e-4))
    rows = there.linearize(np.zeros(n)).A.reshape(len(q), 3, n)
    slopes = there.jacobian(np.zeros(n)).reshape(-1, n) * problem.parameters.free.scale
    C = slopes.T @ slopes / len(q)

    def value(chosen: tuple[int, ...]) -> float:
        M = np.eye(n) + np.einsum("kin,kim->nm", rows[list(chosen)], rows[list(chosen)])
        figures = {
            "D": lambda: np.linalg.slogdet(M)[1],
            "A": lambda: np.trace(np.linalg.inv(M)),
            "V": lambda: np.trace(np.linalg.solve(M, C)),
        }
        return float(figures[criterion]())

    sets = list(combinations(range(FEW[0]), FEW[1]))
    values = np.array([value(chosen) for chosen in sets])
    found = choose(problem, q, FEW[1], criterion)
    assert found.value == pytest.approx(value(tuple(found.chosen)), rel=1e-9)
    if criterion == "D":
        assert found.value <= values.max() * (1 + 1e-9)
        assert values.max() <= found.bound * (1 + 1e-9)
    else:
        assert found.value >= values.min() * (1 - 1e-9)
        assert values.min() >= found.bound * (1 - 1e-9)
    assert found.value == pytest.approx({True: values.max(), False: values.min()}[criterion == "D"], rel=1e-6)


def test_what_cannot_be_designed_is_said() -> None:
    problem, q = small()
    for count in (0, len(q)):
        with pytest.raises(ro.InputError, match=r"accepted: 1 to 8, fewer than the candidates"):
            choose(problem, q, count)
    with pytest.raises(ro.InputError, match="a joint without limits"):
        random_candidates(ro.robot.Robot("free", problem.robot.mdh), 3)
    with pytest.raises(ro.InputError, match=r"no column for 'q2', accepted: q2_rad or .* or q2_deg"):
        read_candidates({"q1_deg": [1.0]}, problem.robot)
    two = ro.load("distance").problem
    with pytest.raises(ro.InputError, match="'distance' between two points"):
        choose(two, random_candidates(two.robot, 5), 2)


def test_poses_are_designed_with_their_orientations() -> None:
    """A candidate counts six equations, not three: the information is that of poses."""
    problem = ro.load("pose").problem
    q = random_candidates(problem.robot, 12, 5)
    found = choose(problem, q, 6, "D")
    y = np.tile([0.0, 0, 0, 1, 0, 0, 0], (6, 1))
    kind = problem.data.blocks[0].measurement
    covariance = np.median(problem.data.blocks[0].covariance, axis=0)
    chosen = problem.on(ro.Dataset.of(q[found.chosen], y, covariance, measurement=kind))
    A = chosen.linearize(np.zeros(len(problem.parameters.free))).A
    assert len(A) == 36
    assert found.value == pytest.approx(np.linalg.slogdet(np.eye(A.shape[1]) + A.T @ A)[1], rel=1e-8)


def test_a_bound_that_says_nothing_is_said() -> None:
    """One row of many unknowns: what the best set would reach is not known within a factor of two."""
    found = ro.problem.Design(np.array([1]), np.ones(3), "V", 3.0, 1.0, 2.0)
    assert str(found).endswith("too few for a useful optimality bound; choose more.")
