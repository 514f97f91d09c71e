"""The certified start: its relaxation is the one stated, its bound holds, and it knows when it is right."""

from __future__ import annotations

import re

import cvxpy as cp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.problem.registration.certified import lifted, relax, rotation_constraints, smallest
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


def lifts(rng: np.random.Generator, count: int, many: int) -> np.ndarray:
    rotations = Rotation.random(count * many, rng=rng).as_matrix().reshape(many, count, 3, 3)
    return np.array([lifted(R) for R in rotations])


@pytest.mark.parametrize("count", [1, 2])
def test_the_constraints_are_all_that_rotations_obey(count: int) -> None:
    C = rotation_constraints(count)
    X = lifts(np.random.default_rng(0), count, 600)
    assert np.abs(np.einsum("ni,cij,nj->nc", X, C, X)).max() < 1e-13
    upper = np.triu_indices(X.shape[1])
    monomials = X[:, upper[0]] * X[:, upper[1]]
    vanishing = monomials.shape[1] - np.linalg.matrix_rank(monomials, tol=1e-8)
    assert np.linalg.matrix_rank(C.reshape(len(C), -1)) == len(C) == 20 * count == vanishing


def form(rng: np.random.Generator, count: int, shared: int) -> np.ndarray:
    """Return a form of which rotations that are not shared have no products."""
    M = rng.normal(size=(1 + 9 * count, 1 + 9 * count))
    Q = M + M.T
    for i in range(shared, count):
        for j in range(shared, count):
            if i != j:
                Q[1 + 9 * i : 10 + 9 * i, 1 + 9 * j : 10 + 9 * j] = 0.0
    return Q


@pytest.mark.parametrize(("count", "shared"), [(1, 1), (2, 1), (2, 2)])
def test_the_solver_is_given_what_is_stated(count: int, shared: int) -> None:
    Q = form(np.random.default_rng(count), count, shared)
    C = rotation_constraints(count)
    M = cp.Variable(Q.shape, PSD=True)
    stated = cp.Problem(
        cp.Minimize(cp.sum(cp.multiply(Q, M))), [M[0, 0] == 1, C.reshape(len(C), -1) @ cp.vec(M, order="C") == 0]
    )
    least = stated.solve(solver=cp.CLARABEL)
    moments, multipliers = relax(Q)
    assert np.sum(Q * moments) == pytest.approx(least, abs=1e-5)
    if count == shared:
        assert np.abs(moments - M.value).max() < 1e-3
    S = Q - np.tensordot(multipliers, C, axes=1)
    S[0, 0] -= least
    assert np.linalg.eigvalsh(S)[0] > -1e-5
    assert np.linalg.eigvalsh(moments)[0] > -1e-6


@pytest.mark.parametrize("seed", range(6))
def test_no_rotations_undercut_the_bound(seed: int) -> None:
    """Random forms, of which none has to be tight: the bound holds, and the value is a minimum."""
    rng = np.random.default_rng(seed)
    count = 1 + seed % 2
    L = rng.normal(size=(6, 1 + 9 * count))
    found = smallest(L)
    values = np.sum((lifts(rng, count, 4000) @ L.T) ** 2, axis=1)
    assert found.bound <= found.value + 1e-12
    assert found.bound <= values.min()
    assert found.value == pytest.approx(np.sum((L @ lifted(found.rotations)) ** 2), rel=1e-12)
    for turn in 1e-3 * rng.normal(size=(50, count, 3)):
        near = found.rotations @ Rotation.from_rotvec(turn).as_matrix()
        assert np.sum((L @ lifted(near)) ** 2) >= found.value


def test_beyond_the_radius_everything_is_worse() -> None:
    rng = np.random.default_rng(3)
    wanted = Rotation.random(rng=rng).as_matrix()
    L = rng.uniform(1, 2, 9)[:, None] * np.hstack([-wanted.reshape(9, 1), np.eye(9)])
    L[:, 0] += 0.3 * rng.normal(size=9)  # |W (R - wanted) + e|^2
    found = smallest(L)
    turns = Rotation.from_rotvec(rng.normal(size=(20000, 3)) * rng.uniform(0, 2, (20000, 1)))
    x = np.array([lifted(R[None]) for R in found.rotations[0] @ turns.as_matrix()])
    excess = np.sum((x @ L.T) ** 2, axis=1) - found.value
    away = turns.magnitude()
    for allowed in (0.01, 0.1, 1.0):
        assert found.radius(allowed) < 2.0
        assert 0.3 * found.radius(allowed) < away[excess <= allowed].max() <= found.radius(allowed)


def test_the_second_derivative_is_that_of_the_value() -> None:
    rng = np.random.default_rng(5)
    L = rng.normal(size=(30, 19))
    found = smallest(L)

    def value(w: np.ndarray) -> float:
        R = found.rotations @ Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix()
        return float(np.sum((L @ lifted(R)) ** 2))

    h = 1e-3 * np.eye(6)
    numeric = [[value(a + b) - value(a - b) - value(b - a) + value(-a - b) for a in h] for b in h]
    assert np.abs(np.array(numeric) / 4e-6 - 2 * found.information).max() < 1e-4 * np.abs(found.information).max()


@pytest.mark.parametrize("turned", [False, True])
def test_base_and_tool_of_poses_and_of_positions(turned: bool) -> None:
    _, flange, Z, X = poses(7)
    measured = Z @ flange @ X
    if not turned:
        measured = measured[:, :3, 3]
    start = ro.problem.certified_hand_eye(flange, measured)
    assert start.certified, start.reason
    assert np.abs(start.base - Z).max() < 1e-9
    assert np.abs(start.tool[:3, 3] - X[:3, 3]).max() < 1e-9


def test_the_cost_is_what_the_docstring_says() -> None:
    rng, flange, Z, X = poses(11, 20)
    sigma = 1e-3, 2e-3
    measured = noisy(Z @ flange @ X, rng, sigma)
    start = ro.problem.certified_hand_eye(flange, measured, sigma=sigma)
    T = start.base @ flange @ start.tool
    turns = np.sum((measured - T)[:, :3, :3] ** 2, axis=(1, 2)) / (2 * sigma[1] ** 2)
    squares = np.sum((measured - T)[:, :3, 3] ** 2, axis=1) / sigma[0] ** 2 + turns
    assert start.cost == pytest.approx(squares.sum(), rel=1e-6)
    assert start.bound <= start.cost
    assert start.certified


def test_turns_about_one_axis_are_not_certified() -> None:
    rng, _, Z, X = poses(17)
    flange = np.tile(np.eye(4), (10, 1, 1))
    flange[:, :3, :3] = Rotation.from_rotvec(np.outer(rng.uniform(-2, 2, 10), [0, 0, 1])).as_matrix()
    measured = noisy(Z @ flange @ X, rng, (1e-3, 1e-3))
    start = ro.problem.certified_hand_eye(flange, measured, sigma=(1e-3, 1e-3))
    assert not start.certified
    assert "do not determine the rotations" in start.reason
    # places that are no circle do
    flange[:, :3, 3] = rng.normal(size=(10, 3))
    start = ro.problem.certified_hand_eye(flange, Z @ flange @ X)
    assert start.certified
    assert np.abs(start.base - Z)[:3, :3].max() < 1e-9
    assert np.abs(start.tool - X)[:3, :3].max() < 1e-9
    # along the axis base and tool are one; that stays where it is expected
    assert abs(start.tool[2, 3]) < 1e-6
    assert np.abs(start.tool - X)[:2, 3].max() < 1e-9


def test_starts_that_fit_as_well_are_not_certified() -> None:
    """Three positions are nine numbers, as many as base and reflector have: there is more than one solution."""
    for seed in range(5):
        _, flange, Z, X = poses(seed, 3)
        start = ro.problem.certified_hand_eye(flange, (Z @ flange @ X)[:, :3, 3])
        assert start.cost < 1e-6
        assert not start.certified
        assert start.radius > turned_by(start.base, Z)


def test_three_poses_with_two_answers_are_not_certified() -> None:
    """Two frames fit three noisy poses within the noise; the better one is not that of which they were made."""
    study = load_study(find_study("certified_start"))
    row = study.run(seed=7113)
    assert row["another"] == 1
    assert not row["certified"]
    assert "may fit as well" in row["reason"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sigma": (0.0, 1.0)}, "sigma: found a number that is not positive"),
        ({"measured": np.zeros((12, 2))}, "transforms: found shapes"),
        ({"measured": np.zeros((12, 4, 4))}, "pose 1: found a matrix that violates R R' = I by 1"),
        ({"measured": np.full((12, 3), np.nan)}, "transforms: found numbers that are not finite"),
    ],
)
def test_what_cannot_be_used_is_refused(change: dict, message: str) -> None:
    _, flange, _, _ = poses(29)
    given = {"flange": flange, "measured": flange} | change
    with pytest.raises(ro.InputError, match=message.replace("(", r"\(")):
        ro.problem.certified_hand_eye(**given)
    with pytest.raises(ro.InputError, match="poses: found 2, accepted: 3 or more"):
        ro.problem.certified_hand_eye(flange[:2], flange[:2])


def check_study(rows: list[dict]) -> None:
    study = load_study(find_study("certified_start"))
    metrics = study.report(rows).metrics
    assert metrics["worse_than_a_closed_form"] == 0
    assert metrics["certified_but_wrong"] == 0
    assert metrics["right"] == 1
    assert metrics["certified_of_right"] >= 0.995
    assert not any(row["certified"] for row in rows if row["scene"] == "one axis")


@pytest.mark.slow
def test_a_thousand_random_cases_are_right_where_certified() -> None:
    study = load_study(find_study("certified_start"))
    check_study([study.run(**case) for case in study.cases(quick=False)])


def test_a_base_is_certified_where_problems_start() -> None:
    problem = ro.load("pose").problem
    tools = {"": np.zeros(6)}
    base, _, how = locate(problem.robot, problem.data, tools)
    assert "; optimum of the registration certified: globally optimal" in how
    p = problem.parameters
    stated = [p.nominal[p.names.index(f"base_{c}")] for c in "xyz"]
    assert np.abs(base[:3] - stated).max() < 0.02  # of a robot whose parameters are off by millimetres


def test_positions_are_fitted_where_nothing_is_determined() -> None:
    problem = ro.load("position").problem
    few = problem.on(problem.data.take([0, 1, 2]))
    base, _, how = locate(few.robot, few.data, {"": np.zeros(6)})
    assert re.search("; registration of positions: |; optimum of the registration not certified: ", how)
    assert np.isfinite(base).all()


@pytest.mark.skipif(not REAL.is_dir(), reason="the real measurements are not here")
def test_a_real_camera_is_certified() -> None:
    problem = ro.load(REAL / "franka_fr3_nadeau").problem
    block = problem.data.blocks[0]
    flange = ro.robot.forward_kinematics(problem.robot, block.q[:, 0])
    start = ro.problem.certified_hand_eye(flange, transforms(block.y), spread=0.1)
    assert start.certified
    assert start.gap < 1e-6
    assert start.rank_ratio < 1e-6
    assert np.abs(start.tool[:3, 3] - [0.0909, -0.0121, 0.0438]).max() < 2e-3
