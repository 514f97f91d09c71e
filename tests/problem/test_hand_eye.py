"""Hand-eye calibration: its cost is the one stated, no closed form undercuts it, and it knows what is open."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.problem.registration.closed_forms import transforms
from rpim_opt.problem.registration.frames import locate
from rpim_opt.study.studies import find_study, load_study
from tests import SHARED

REAL = SHARED / "data"


def frame(rng: np.random.Generator, size: float) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(rng=rng).as_matrix()
    T[:3, 3] = size * rng.normal(size=3)
    return T


def noisy(T: np.ndarray, rng: np.random.Generator, sigma: tuple[float, float]) -> np.ndarray:
    T = T.copy()
    T[:, :3, :3] = Rotation.from_rotvec(sigma[1] * rng.normal(size=(len(T), 3))).as_matrix() @ T[:, :3, :3]
    T[:, :3, 3] += sigma[0] * rng.normal(size=(len(T), 3))
    return T


def poses(seed: int, count: int = 12) -> tuple[np.random.Generator, np.ndarray, np.ndarray, np.ndarray]:
    """Return a generator, flange poses, a base and a tool."""
    rng = np.random.default_rng(seed)
    return rng, np.array([frame(rng, 0.5) for _ in range(count)]), frame(rng, 2.0), frame(rng, 0.1)


def turned_by(first: np.ndarray, second: np.ndarray) -> float:
    return float(Rotation.from_matrix(first[:3, :3].T @ second[:3, :3]).magnitude())


@pytest.mark.parametrize("turned", [False, True])
def test_base_and_tool_of_poses_and_of_positions(turned: bool) -> None:
    _, flange, Z, X = poses(7)
    measured = Z @ flange @ X
    if not turned:
        measured = measured[:, :3, 3]
    start = ro.problem.hand_eye(flange, measured)
    assert start.determined, start.reason
    assert np.abs(start.base - Z).max() < 1e-9
    assert np.abs(start.tool[:3, 3] - X[:3, 3]).max() < 1e-9


def test_the_cost_is_what_the_docstring_says() -> None:
    rng, flange, Z, X = poses(11, 20)
    sigma = 1e-3, 2e-3
    measured = noisy(Z @ flange @ X, rng, sigma)
    start = ro.problem.hand_eye(flange, measured, sigma=sigma)

    def cost(base: np.ndarray, tool: np.ndarray) -> float:
        off = measured - base @ flange @ tool
        turns = np.sum(off[:, :3, :3] ** 2) / (2 * sigma[1] ** 2)
        return float(np.sum(off[:, :3, 3] ** 2) / sigma[0] ** 2 + turns)

    least = cost(start.base, start.tool)
    assert start.cost == pytest.approx(least, rel=1e-6)
    assert start.determined
    for step in 1e-4 * rng.normal(size=(40, 4, 3)):  # a minimum
        base, tool = start.base.copy(), start.tool.copy()
        for T, (turn, shift) in ((base, step[:2]), (tool, step[2:])):
            T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
            T[:3, 3] += shift
        assert cost(base, tool) > least


def test_turns_about_one_axis_determine_nothing() -> None:
    rng, _, Z, X = poses(17)
    flange = np.tile(np.eye(4), (10, 1, 1))
    flange[:, :3, :3] = Rotation.from_rotvec(np.outer(rng.uniform(-2, 2, 10), [0, 0, 1])).as_matrix()
    measured = noisy(Z @ flange @ X, rng, (1e-3, 1e-3))
    start = ro.problem.hand_eye(flange, measured, sigma=(1e-3, 1e-3))
    assert not start.determined
    assert "do not determine the rotations" in start.reason
    # places that are no circle do
    flange[:, :3, 3] = rng.normal(size=(10, 3))
    start = ro.problem.hand_eye(flange, Z @ flange @ X)
    assert start.determined
    assert np.abs(start.base - Z)[:3, :3].max() < 1e-9
    assert np.abs(start.tool - X)[:3, :3].max() < 1e-9
    # along the axis base and tool are one; that stays where it is expected
    assert abs(start.tool[2, 3]) < 1e-6
    assert np.abs(start.tool - X)[:2, 3].max() < 1e-9


def test_solutions_that_fit_as_well_are_told() -> None:
    """Three positions are nine numbers, as many as base and reflector have: there is more than one solution."""
    for seed in range(5):
        _, flange, Z, X = poses(seed, 3)
        start = ro.problem.hand_eye(flange, (Z @ flange @ X)[:, :3, 3])
        assert start.cost < 1e-6
        assert not start.determined
        assert "fits as well" in start.reason


def test_three_poses_with_two_answers_are_told() -> None:
    """Two frames fit three noisy poses within the noise; the better one is not that of which they were made."""
    study = load_study(find_study("hand_eye"))
    row = study.run(seed=7113)
    assert row["another"] == 1
    assert not row["said"]
    assert "fits as well" in row["reason"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sigma": (0.0, 1.0)}, "sigma: found a number that is not positive"),
        ({"measured": np.zeros((12, 2))}, "transforms: found shapes"),
        ({"measured": np.zeros((12, 4, 4))}, "pose 1: found a matrix that misses R R' = 1 by 1"),
        ({"measured": np.full((12, 3), np.nan)}, "transforms: found numbers that are not finite"),
    ],
)
def test_what_cannot_be_used_is_refused(change: dict, message: str) -> None:
    _, flange, _, _ = poses(29)
    given = {"flange": flange, "measured": flange} | change
    with pytest.raises(ro.InputError, match=message.replace("(", r"\(")):
        ro.problem.hand_eye(**given)
    with pytest.raises(ro.InputError, match="poses: found 2, accepted: 3 or more"):
        ro.problem.hand_eye(flange[:2], flange[:2])


def check_study(rows: list[dict]) -> None:
    study = load_study(find_study("hand_eye"))
    metrics = study.report(rows).metrics
    assert metrics["worse_than_a_closed_form"] == 0
    assert metrics["said_to_be_determined_but_wrong"] == 0
    assert metrics["right"] == 1
    assert metrics["said_of_right"] >= 0.995
    assert not any(row["said"] for row in rows if row["scene"] == "one axis")


@pytest.mark.slow
def test_random_cases_are_right_where_determined() -> None:
    study = load_study(find_study("hand_eye"))
    check_study([study.run(**case) for case in study.cases(quick=True)[:30]])


@pytest.mark.slow
def test_all_random_cases_are_right_where_determined() -> None:
    study = load_study(find_study("hand_eye"))
    check_study([study.run(**case) for case in study.cases(quick=False)])


def test_a_base_is_found_where_problems_start() -> None:
    problem = ro.load("pose").problem
    tools = {"": np.zeros(6)}
    base, _, _ = locate(problem.robot, problem.data, tools)
    p = problem.parameters
    stated = [p.nominal[p.names.index(f"base_{c}")] for c in "xyz"]
    assert np.abs(base[:3] - stated).max() < 0.02  # of a robot whose parameters are off by millimetres


def test_positions_are_fitted_where_nothing_is_determined() -> None:
    problem = ro.load("position").problem
    few = problem.on(problem.data.take([0, 1, 2]))
    base, _, _ = locate(few.robot, few.data, {"": np.zeros(6)})
    assert np.isfinite(base).all()


@pytest.mark.skipif(not REAL.is_dir(), reason="the real measurements are not here")
def test_a_real_camera_is_determined() -> None:
    problem = ro.load(REAL / "franka_fr3_nadeau").problem
    block = problem.data.blocks[0]
    flange = ro.robot.forward_kinematics(problem.robot, block.q[:, 0])
    start = ro.problem.hand_eye(flange, transforms(block.y), spread=0.1)
    assert start.determined
    assert np.abs(start.tool[:3, 3] - [0.0909, -0.0121, 0.0438]).max() < 2e-3
