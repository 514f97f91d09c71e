"""Two arms that touched the same points: where they stand to each other, one point in a fold, and intervals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration.words import touch_errors
from rpim_opt.problem.registration.frames import shared_bases
from rpim_opt.robot.kinematics import FRAME, numeric_frame

SIGMA = 3e-5
STANDS = np.array([1.1, 0.05, 0.0, 0.0, 0.0, np.pi])
"""The right arm in the left one's frame: opposite."""
SOCKETS = {f"S{i}": [x, y, z] for i, (x, y, z) in enumerate(np.ndindex(2, 2, 2))}
MIDDLE, SIZE = np.array([0.55, 0.02, 0.28]), np.array([0.12, 0.35, 0.25])
ELSEWHERE = {"V1": [0.2, 0.4, 0.5], "V2": [0.8, 0.6, 0.1]}


def arm_of(identify: list[str]) -> ro.CalibrationProblem:
    arm = ro.load("contact").problem
    return arm.with_parameters(arm.parameters.identify(identify))


def touched(
    arm: ro.CalibrationProblem, x: np.ndarray, base: np.ndarray, places: dict, count: int, rng: np.random.Generator,
    sigma: float = SIGMA,
) -> ro.Dataset:  # fmt: skip
    """Return touches by an arm with these deviations, which stands there, of places in the left arm's frame."""
    T = numeric_frame(base)
    there = MIDDLE + (np.array(list(places.values())) - 0.5) * SIZE
    local = np.repeat((there - T[:3, 3]) @ T[:3, :3], count, axis=0)
    q = ro.problem.configurations_at(arm, local + sigma * rng.normal(size=local.shape), rng, x, 0.9)
    return ro.data.touches(q, np.repeat(list(places), count).tolist(), SIGMA)


def pair(seed: int, identify: list[str], count: int = 4):
    """Return two arms' problem, the right base sought from nothing, and touches elsewhere by both, without noise."""
    rng = np.random.default_rng([seed, 47])
    left = arm_of(identify)
    right = arm_of([*identify, "base_*"])
    parts, clean = {}, {}
    for name, arm, base in (("left", left, np.zeros(6)), ("right", right, STANDS)):
        free = arm.parameters.free
        x = np.where([own.startswith("base_") for own in free.names], 0.0, rng.normal(size=len(free)) * free.scale)
        parts[name] = arm.on(touched(arm, x, base, SOCKETS, count, rng))
        clean[name] = touched(arm, x, base, ELSEWHERE, 4, rng, sigma=0.0)
    return ro.together(**parts, shared=[]), ro.Dataset.of_robots(clean).grouped_by_points()


ALL = ["theta?", "d?", "tool_[xyz]"]


@pytest.fixture(scope="module")
def cell():
    return pair(0, ALL)


@pytest.fixture(scope="module")
def result(cell):
    return ro.calibrate(cell[0])


def base_of(problem: ro.CalibrationProblem) -> list[int]:
    return [problem.parameters.free.names.index(f"right.base_{c}") for c in FRAME]


@pytest.mark.slow
def test_the_base_is_found_from_nothing(cell, result) -> None:
    """It stands a metre away and was stated nowhere: within the errors of nominal robots, and then of calibrated."""
    problem, _ = cell
    assert np.abs(shared_bases(problem)["right"][:3] - STANDS[:3]).max() < 0.03
    assert result.converged
    k = base_of(result.problem)
    found = numeric_frame(result.problem.parameters.free.nominal[k])
    found[:3, 3] += result.x[k[:3]]
    sd = np.sqrt(np.diag(result.covariance))[k[:3]]
    assert np.all(np.abs(found[:3, 3] - STANDS[:3]) < 4 * sd)


def test_touches_of_both_meet_elsewhere(cell, result) -> None:
    """Eight touches of a point that nothing has seen, four by either arm: in one place."""
    _, clean = cell
    there = result.problem.on(clean)
    assert len(there.touches.rows) == 2
    assert there.errors(result.x).max() < 2e-4
    left_alone = [part.errors(np.zeros(len(part.parameters.free))).max() for part in (there.alone("left"),)]
    assert max(left_alone) > 1e-3


def test_a_result_goes_to_a_file_and_a_report(result, tmp_path: Path) -> None:
    ro.store.save_result(result, tmp_path / "result.json")
    again = ro.load_result(tmp_path / "result.json")
    assert np.array_equal(again.x, result.x)
    assert np.allclose(again.errors(), result.errors(), atol=1e-12)
    ro.report.write_report(result, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "how consistently they are reached from all sides" in page


def test_a_point_is_in_one_fold_whoever_touched_it(cell) -> None:
    problem, _ = cell
    data = problem.data
    assert len(np.unique(data.configuration)) == len(SOCKETS)
    found = touch_errors(data, np.zeros(len(data)), np.ones(len(data)))
    assert sorted(each["name"] for each in found) == sorted(SOCKETS)
    assert {each["count"] for each in found} == {8}


def test_a_known_distance_joins_points_of_two_arms(cell) -> None:
    """One point that only the left arm touched, one that only the right one did."""
    problem, _ = cell
    rows = [
        i
        for block in problem.data.blocks
        for i, name in zip(block.row, block.touched[:, 0], strict=True)
        if not ((block.robot == "left" and name == "S7") or (block.robot == "right" and name == "S0"))
    ]
    length = float(np.linalg.norm(SIZE))
    known = ro.data.KnownDistance(("S0", "S7"), length, 1e-5)
    whole = problem.on(ro.data.with_known(problem.data.take(rows), [known]))
    result = ro.calibrate(whole)
    assert result.converged
    (tie,) = result.problem.touches.ties
    assert abs(result.problem.residual(result.x)[tie.equations[0]]) < 3e-5


def test_points_that_are_elsewhere_are_not_called_alike(cell) -> None:
    problem, _ = cell
    left = problem.alone("left")
    blocks = problem.alone("right").data.blocks
    names = np.roll(blocks[0].point, 4, axis=0)  # every point by the name of the one before it
    moved = replace(problem.alone("right").data, blocks=(replace(blocks[0], point=names),))
    with pytest.raises(ro.InputError, match=r"'S\d' that are 0.\d+ m from those of another robot"):
        ro.together(left=left, right=problem.alone("right").on(moved), shared=[])
    fixed = problem.alone("right").with_parameters(problem.alone("right").parameters.identify(ALL))
    with pytest.raises(ro.InputError, match="state or identify its base"):
        ro.together(left=left, right=fixed, shared=[])
    nominal = fixed.parameters.nominal.copy()
    nominal[[fixed.parameters.names.index(f"base_{c}") for c in FRAME]] = STANDS
    stated = fixed.with_parameters(replace(fixed.parameters, nominal=nominal))
    assert len(ro.together(left=left, right=stated, shared=[]).touches.rows) == len(SOCKETS)


@pytest.mark.parametrize("line", [["S0", "S7"], ["S0", "middle", "S7"]])
def test_points_on_a_line_place_no_base(line: list[str]) -> None:
    """Nor do two; whether they are in one place nobody can say then, and the base stays where it is stated."""
    rng = np.random.default_rng(1)
    sockets = SOCKETS | {"middle": [0.5, 0.5, 0.5]}
    some = {name: sockets[name] for name in line}
    parts = {}
    for name, arm, base in (("left", arm_of(ALL), np.zeros(6)), ("right", arm_of([*ALL, "base_*"]), STANDS)):
        parts[name] = arm.on(touched(arm, np.zeros(len(arm.parameters.free)), base, some, 2, rng, sigma=0.0))
    assert shared_bases(ro.together(**parts, shared=[])) == {}


def test_a_robot_that_an_instrument_sees_stands_where_that_says(cell) -> None:
    """Touches do not place its base, but have to be where that puts them."""
    left, right = (cell[0].alone(name) for name in ("left", "right"))
    p = right.parameters
    nominal = p.nominal.copy()
    nominal[[p.names.index(f"base_{c}") for c in FRAME]] = STANDS
    data = right.data
    seen = ro.Dataset.of(data.q[:3], np.zeros((3, 3)), SIGMA)
    both_kinds = right.on(ro.Dataset.together([data, seen], ["touches", "tracker"]))
    with pytest.raises(ro.InputError, match="from those of another robot"):
        ro.together(left=left, right=both_kinds, shared=[])
    stated = both_kinds.with_parameters(replace(p, nominal=nominal))
    assert shared_bases(ro.together(left=left, right=stated, shared=[])) == {}


@pytest.mark.slow
def test_intervals_of_two_arms_hold() -> None:
    """Of differences of noise-free touches elsewhere, by both arms, of 20 pairs that nothing was tuned to."""
    covered, far = [], []
    for seed in range(100, 120):
        problem, clean = pair(seed, ALL)
        result = ro.calibrate(problem)
        there = result.problem.on(clean)
        J = there.jacobian(result.x)
        sd = np.sqrt(np.einsum("ij,jk,ik->i", J, result.covariance, J))
        covered.append(np.abs(there.residual(result.x)) <= ro.calibration.Uncertainty(result).coverage_factor * sd)
        far.append(there.errors(result.x).mean())
    assert 0.92 < np.mean(covered) < 0.99
    assert np.mean(far) < 6e-5


@pytest.mark.parametrize("shared", [["a?"], ["[!b]*", "beta?"]])
def test_links_that_two_campaigns_share_are_judged_saved_reported_and_used(shared: list[str], tmp_path: Path) -> None:
    whole = ro.load("position").problem
    parts = {name: whole.on(whole.data.take(range(k, k + 20))) for name, k in (("spring", 0), ("autumn", 20))}
    result = ro.calibrate(ro.together(**parts, shared=shared))
    assert result.verdict.delivered
    assert "a1" in str(result)
    ro.store.save_result(result, tmp_path / "result.json")
    ro.report.write_report(result, tmp_path / "report.html")
    ro.use.compensate(ro.load_result(tmp_path / "result.json"), whole.data.q[:3], robot="spring")
    ro.use.update(result, result.problem.data)
