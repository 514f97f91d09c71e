"""Compensation: the true robot at the corrected commands is where the nominal one would be."""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.data.measurements.pose import pose
from rpim_opt.robot.library import find_robot
from rpim_opt.store import problems_folder
from tests.simulate import ARM, simulated

SCARA = ro.read_robot(problems_folder() / "scara" / "robot.toml")
ROBOTS = {
    "six axes": ARM,
    "seven axes": ro.read_robot(find_robot("iiwa14")),
    "SCARA": SCARA,
    "coupled": ro.read_robot(find_robot("lrmate200id")),
}


def commands(robot: ro.robot.Robot, count: int = 60, seed: int = 1) -> np.ndarray:
    """Joint values well inside the limits."""
    low, high = np.clip(robot.limits, -2.0, 2.0).T
    return np.random.default_rng(seed).uniform(0.8 * low, 0.8 * high, (count, robot.dof))


@cache
def calibrated(
    name: str = "six axes", noise: float = 5e-5, seed: int = 0
) -> tuple[ro.calibration.Calibration, np.ndarray]:
    """Return a calibration from noisy positions, and the true deviations."""
    problem, truth = simulated(noise=noise, seed=seed, robot=ROBOTS[name], configurations=60)
    return ro.calibrate(problem, ro.tikhonov, 1.0), truth


@cache
def known(name: str = "six axes") -> ro.calibration.Calibration:
    """Return a calibration that knows its robot exactly."""
    result, truth = calibrated(name)
    return replace(result, x=truth)


def reading(result: ro.calibration.Calibration, x: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the reflector's poses (N, 7) in the instrument's frame."""
    y = np.tile([0.0, 0, 0, 1, 0, 0, 0], (len(q), 1))
    return result.problem.on(ro.Dataset.of(q, y, np.eye(6), measurement=pose)).modelled(x)[0]


def wanted(result: ro.calibration.Calibration, q: np.ndarray) -> np.ndarray:
    """Return the poses that the nominal robot would have with the tool, and in the base, as identified."""
    return reading(result, frames_of(result, "base_", "tool_"), q)


def frames_of(result: ro.calibration.Calibration, *prefixes: str) -> np.ndarray:
    """Return the deviations of these frames alone, those of the robot being zero."""
    names = result.problem.parameters.free.names
    return np.where([name.startswith(prefixes) for name in names], result.x, 0.0)


def misses(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances and the angles between poses (N, 7)."""
    turn = Rotation.from_quat(a[:, [4, 5, 6, 3]]) * Rotation.from_quat(b[:, [4, 5, 6, 3]]).inv()
    return np.linalg.norm(a[:, :3] - b[:, :3], axis=1), turn.magnitude()


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def ok(found: ro.use.Compensation) -> np.ndarray:
    return np.array(found.status) == "ok"


def exact(found: ro.use.Compensation) -> np.ndarray:
    """Rows that reach their target by a small correction: what keeps a command weighs 1e-10, not nothing."""
    return ok(found) & (np.abs(found.q - found.nominal) < 0.1).all(axis=1)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_true_robot_misses_by_no_more_than_the_calibration(name: str) -> None:
    result, truth = calibrated(name)
    q = commands(ROBOTS[name], 300)
    found = ro.use.compensate(result, q, largest=0.5)
    good = ok(found)
    assert good.mean() > 0.75
    there = wanted(result, q)
    before = misses(reading(result, truth, q), there)[0][good]
    after = misses(reading(result, truth, found.q), there)[0][good]
    fresh = ro.Dataset.of(q, reading(result, truth, q)[:, :3], 1.0)
    validation = result.errors(fresh)
    assert before.mean() > 1.5e-3  # many times what the calibration leaves
    assert rms(after) == pytest.approx(rms(validation), rel=0.2)
    assert rms(found.std) == pytest.approx(rms(validation), rel=0.5)
    assert found.position_before[good] == pytest.approx(before, abs=4 * rms(validation))


@pytest.mark.parametrize("name", ROBOTS)
def test_a_robot_that_is_known_exactly_goes_exactly_there(name: str) -> None:
    result, q = known(name), commands(ROBOTS[name])
    found = ro.use.compensate(result, q, largest=0.5, orientation=True)
    place, turn = misses(reading(result, result.x, found.q), wanted(result, q))
    good = exact(found)
    assert good.mean() > 0.4
    assert found.position_error[ok(found)].max() <= 1e-7
    assert place[good].max() < 1e-10
    assert place == pytest.approx(found.position_error, abs=1e-12)
    # Rotation.magnitude takes the root of a rounding error
    assert turn == pytest.approx(found.orientation_error, abs=3e-8)
    if name == "SCARA":  # roll and pitch of four joints stay as they are
        assert found.orientation_error.max() < 2 * found.orientation_before.max()
    else:
        assert found.orientation_error[good].max() < 1e-10


def test_orientation_is_corrected_where_it_is_known_better_than_nominally() -> None:
    """Where a long tool is hardly known in its turn, positions of the reflector at its end say nothing of it."""
    problem, _ = simulated(("theta?", "a?", "d?", "tool_*"), noise=1e-3, configurations=25, size=0.05)
    result, q = ro.calibrate(problem, ro.tikhonov, 1.0), commands(ARM, 20)
    found = ro.use.compensate(result, q)
    assert "Orientations are not corrected: those of 20 of 20 targets are known no better" in found.point
    assert (found.position_error < 1e-5).all()  # it comes first, near a singular wrist, too: a squared turn weighs 1e-6
    assert found.orientation_error[ok(found)] == pytest.approx(found.orientation_before[ok(found)], abs=1e-3)
    assert ok(found).mean() > 0.75
    both = ro.use.compensate(result, q, orientation=True)
    assert "Orientations are" not in str(both)
    assert np.abs(found.q - q).max() < np.abs(both.q - q).max()
    poses = wanted(result, q)
    there = ro.use.compensate(result, q, poses)  # the nominal command is still that of the whole pose
    assert np.abs(there.nominal - q).max() < 1e-6
    sure, place = calibrated()[0], ro.use.compensate(calibrated()[0], q)
    assert "determine only part of an orientation; the prior determines the rest" in place.point
    assert rms(place.orientation_std) < rms(place.orientation_before)
    better = place.orientation_std < 0.9 * place.orientation_before
    assert 0 < np.count_nonzero(better) < 20
    # those of the others alone could turn their rows against these
    assert place.orientation_error[ok(place)] == pytest.approx(place.orientation_before[ok(place)], abs=1e-3)
    corrected = ro.use.compensate(sure, q[better])
    assert "Orientations of all targets are corrected." in corrected.point
    assert (corrected.orientation_error <= 1e-7)[ok(corrected)].all()
    exactly = ro.use.compensate(sure, q[better], orientation=True)
    assert np.array_equal(corrected.q[ok(corrected)], exactly.q[ok(corrected)])


def test_position_comes_first_where_joint_limits_do_not_allow_the_whole_pose() -> None:
    """It lost millimetres for the milliradians of an orientation."""
    result, q = limited()
    both, found = (ro.use.compensate(result, q, largest=0.5, orientation=each) for each in (True, None))
    assert np.count_nonzero(both.position_error > 5e-4) > 5
    assert (found.position_error < 1e-5).all()
    assert (found.orientation_error <= both.orientation_error + 0.1).all()


def test_a_singular_wrist_stays_still_where_orientations_are_kept() -> None:
    """To keep 3 mrad it would swing by 8 degrees."""
    problem, _ = simulated(("theta?", "a?", "d?", "tool_*"), noise=1e-3, configurations=25, size=0.05)
    q = commands(ARM, 20)
    q[:, 4] = 0.03
    found = ro.use.compensate(ro.calibrate(problem, ro.tikhonov, 1.0), q)
    assert "Orientations are not corrected" in str(found)
    assert np.abs(found.q - q)[:, [3, 5]].max() < np.radians(2)
    assert (found.position_error < 1e-6).all()


def test_an_orientation_of_unknown_uncertainty_is_not_corrected() -> None:
    problem, _ = simulated(("theta?", "a?"), noise=1e-4, configurations=25)
    found = ro.use.compensate(ro.calibrate(problem, ro.lasso, 1.0), commands(ARM, 5))
    assert "Orientations are not corrected: those of 5 of 5 targets" in str(found)


def test_the_limit_of_a_result_holds_for_its_commands() -> None:
    result, q = calibrated()[0], commands(ARM, 5)
    required = replace(result, record=replace(result.record, requirement=ro.data.Requirement(2e-4)))
    std = ro.use.compensate(required, q, limit=1.0, despite_verdict=True).std
    limit = 2 * float(np.median(std)) + 1e-9
    required = replace(result, record=replace(result.record, requirement=ro.data.Requirement(limit)))
    found = ro.use.compensate(required, q, despite_verdict=True)
    assert found.limit == limit
    assert [status == "above the limit" for status in found.status] == (2 * found.std > limit).tolist()
    assert 0 < len(found.missed) < 5
    assert f"Above the limit of {1e3 * limit:g} mm: " in str(found)
    note = next(csv.DictReader(found.csv().splitlines()))["note"]
    assert f"standard uncertainties (k = 1). Limit {1e3 * limit:g} mm." in note
    assert "Target point: the reflector" in note


def test_poses_that_are_unreachable_name_the_option_by_which_position_alone_counts() -> None:
    result = calibrated()[0]
    far = [[9.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0]]
    for poses, named in ((far, True), (np.array(far)[:, :3], False)):
        found = ro.use.compensate(result, poses=np.array(poses), despite_verdict=True)
        assert found.missed == ["1"]
        assert ("--position-only ignores the targets' orientations." in str(found)) == named


@pytest.mark.parametrize("name", ROBOTS)
def test_positions_alone_need_smaller_corrections(name: str) -> None:
    result, q = known(name), commands(ROBOTS[name])
    both, place = ro.use.compensate(result, q), ro.use.compensate(result, q, orientation=False)
    assert np.isnan(place.orientation_error).all()
    good = exact(place)
    assert good.mean() > 0.4
    assert misses(reading(result, result.x, place.q), wanted(result, q))[0][good].max() < 1e-10
    good &= exact(both)
    short, long = (np.linalg.norm((each.q - q)[good], axis=1) for each in (place, both))
    assert (short <= 1.1 * long).all()  # the shortest, to first order


@pytest.mark.parametrize(("name", "orientation"), [("seven axes", True), ("six axes", False)])
def test_a_redundant_robot_makes_the_shortest_correction(name: str, orientation: bool) -> None:
    """Its part along the directions that move nothing is of second order."""
    result, robot = known(name), ROBOTS[name]
    found = ro.use.compensate(result, commands(robot), orientation=orientation)
    for q, corrected in zip(found.nominal[ok(found)], found.q[ok(found)], strict=True):
        J = numeric_jacobian(result, q)[: 6 if orientation else 3]
        D = corrected - q
        still = np.linalg.svd(J)[2][len(J) :]
        assert np.linalg.norm(still @ D) < 10 * np.linalg.norm(D) * np.abs(D).max()


def numeric_jacobian(result: ro.calibration.Calibration, q: np.ndarray) -> np.ndarray:
    """Return the derivative (6, n) of the true reflector's pose by joint values, by central differences."""
    h, columns = 1e-5, []
    for step in h * np.eye(len(q)):
        a, b = reading(result, result.x, np.array([q + step, q - step]))
        turn = Rotation.from_quat(a[[4, 5, 6, 3]]) * Rotation.from_quat(b[[4, 5, 6, 3]]).inv()
        columns.append(np.concatenate([a[:3] - b[:3], turn.as_rotvec()]) / (2 * h))
    return np.column_stack(columns)


def pose_error(result: ro.calibration.Calibration, q: np.ndarray, target: np.ndarray) -> np.ndarray:
    is_ = reading(result, result.x, q[None])[0]
    turn = Rotation.from_quat(target[[4, 5, 6, 3]]) * Rotation.from_quat(is_[[4, 5, 6, 3]]).inv()
    return np.concatenate([target[:3] - is_[:3], turn.as_rotvec()])


def test_damped_rows_minimize_what_the_docstring_says() -> None:
    result, largest = known(), 0.1
    q = commands(ARM, 40)
    q[:, 4] = np.random.default_rng(2).uniform(-0.01, 0.01, 40)
    found, target = ro.use.compensate(result, q, largest=largest, orientation=True), wanted(result, q)
    rows = [i for i, s in enumerate(found.status) if s == "near singular"]
    inside = [i for i in rows if np.abs(found.q[i] - q[i]).max() < 0.99 * largest]
    assert len(inside) > 20
    for i in inside[:8]:
        U, s, Vt = np.linalg.svd(numeric_jacobian(result, q[i]))
        e = U.T @ pose_error(result, q[i], target[i])
        P = Vt.T * np.maximum((e / largest) ** 2 - s**2, 0.0) @ Vt

        def objective(D: np.ndarray, i: int = i, P: np.ndarray = P) -> float:
            return float(np.sum(pose_error(result, q[i] + D, target[i]) ** 2) + D @ P @ D)

        D = found.q[i] - q[i]
        best, h = objective(D), 1e-3
        for step in h * np.eye(6):
            assert best <= objective(D + step)
            assert best <= objective(D - step)


def test_corrections_stay_small_at_a_singular_wrist() -> None:
    result, largest = known(), 0.1
    q = np.tile(commands(ARM, 1)[0], (201, 1))
    q[:, 4] = np.linspace(-0.3, 0.3, 201)
    found = ro.use.compensate(result, q, largest=largest, orientation=True)
    change = found.q - q
    assert np.abs(change).max() <= largest + 1e-12
    assert found.status[100] == "near singular"
    assert found.status[0] == found.status[-1] == "ok"
    total = np.hypot(found.position_error, found.orientation_error)
    assert (total <= np.hypot(found.position_before, found.orientation_before)).all()
    # at the singularity the joints hardly move along it: what is left is orientation about one axis, mostly
    assert np.abs(change[100]).max() < 0.03
    assert "Near singular: " in str(found)


def limited() -> tuple[ro.calibration.Calibration, np.ndarray]:
    """Return an exactly known robot and commands, of which every second stands at a limit of some joint, or near it."""
    q = commands(ARM, 40)
    limits = np.tile([-2.0, 2.0], (6, 1))
    q[::2, 1] = 2.0
    q[::4, 3] = -2.0 + 2e-4 * np.arange(10)
    result = known()
    problem = ro.CalibrationProblem(
        ro.robot.Robot("limited", ARM.mdh, limits=limits), result.problem.parameters, result.problem.data
    )
    return replace(result, problem=problem), q


def test_joint_limits_hold_and_the_rest_is_the_best_within_them() -> None:
    result, q = limited()
    found, target = ro.use.compensate(result, q, largest=0.5, orientation=True), wanted(result, q)
    assert (np.abs(found.q) <= 2.0).all()
    rows = [i for i, s in enumerate(found.status) if s == "limited"]
    assert len(rows) > 5
    assert any(s == "ok" for s in found.status[::2])  # a limit that the correction leaves does not matter
    for i in rows:
        low, high = np.maximum(q[i] - 0.5, -2.0), np.minimum(q[i] + 0.5, 2.0)
        inner = np.clip(found.q[i], low + 1e-9, high - 1e-9)
        best = least_squares(
            lambda v, i=i: pose_error(result, v, target[i]), inner, bounds=(low, high), xtol=1e-14, ftol=1e-14
        )
        mine = np.sum(pose_error(result, found.q[i], target[i]) ** 2) / 2
        assert mine <= best.cost * (1 + 1e-6) + 1e-20
    for said in (str(found), str(ro.use.compensate(result, q, largest=0.5, limit=5e-4, orientation=True))):
        assert re.search(r"error .* mm.*, joint 2 at its limit of 114.592 deg", said)
    outside = q.copy()
    outside[:, 0] = 2.3
    assert (np.abs(ro.use.compensate(result, outside).q) <= 2.0).all()


def test_poses_are_reached_from_a_start_and_without_one() -> None:
    result, _ = limited()
    q = commands(ARM, 200, seed=5)
    poses = nominal_poses(result, q)
    near = q + np.random.default_rng(0).uniform(-0.05, 0.05, q.shape)
    found = ro.use.compensate(result, near, poses, largest=0.5)
    same = ro.use.compensate(result, q, largest=0.5)
    close = (np.abs(found.nominal - q).max(axis=1) < 1e-7) & ok(same)  # not the other branch of a singularity
    assert close.mean() > 0.8
    assert found.q[close] == pytest.approx(same.q[close], abs=1e-6)
    searched = ro.use.compensate(result, poses=poses, largest=0.5)
    assert "another arm configuration" in searched.point
    assert "another arm configuration" not in found.point
    assert (np.abs(searched.nominal) <= 2.0).all()
    place, turn = misses(nominal_poses(result, searched.nominal), poses)
    assert ((place < 1e-7) & (turn < 1e-7)).mean() > 0.99  # every one can be had; limits are narrow
    assert ok(ro.use.compensate(result, poses=poses[:, :3])).mean() > 0.98


def test_poses_without_a_start_are_reached_in_the_arm_configuration_that_was_measured() -> None:
    result, _ = limited()
    for seed in range(6):
        rng = np.random.default_rng(seed)
        q = rng.uniform(-1.6, 1.6, 6) + rng.uniform(-0.4, 0.4, (80, 6))
        measured = ro.Dataset.of(q, reading(result, result.x, q)[:, :3], 1e-10)
        moved = replace(result, problem=result.problem.on(measured))
        searched = ro.use.compensate(moved, poses=nominal_poses(moved, q[:20]), despite_verdict=True)
        assert np.abs(searched.nominal - q[:20]).max() < 1e-5  # of up to eight solutions


def nominal_poses(result: ro.calibration.Calibration, q: np.ndarray) -> np.ndarray:
    """Return the nominal poses (N, 7) of the identified tool in the robot's base."""
    return reading(result, frames_of(result, "tool_"), q)  # the simulated base is stated at the origin


@pytest.mark.slow
def test_what_cannot_be_reached_is_named_with_what_is_left() -> None:
    result = known()
    far = np.array([[3.0, 0.5, 1.0], [0.0, -4.0, 0.2], [0.2, 0.1, 0.4]])
    found = ro.use.compensate(result, poses=far)
    assert found.status[:2] == ("unreachable", "unreachable")
    for i in (0, 1):

        def error(q: np.ndarray, i: int = i) -> np.ndarray:
            return far[i] - base_position(result, q)

        nearest = min(least_squares(error, start, max_nfev=60).cost for start in commands(ARM, 4))
        # the outstretched arm: a flat valley
        assert found.position_error[i] == pytest.approx(np.sqrt(2 * nearest), abs=1e-3)
        assert np.linalg.norm(error(found.q[i])) == pytest.approx(found.position_error[i], abs=1e-10)
    assert f"Unreachable in the robot's base frame: 1 (error {1e3 * found.position_error[0]:.3f} mm)" in str(found)


def base_position(result: ro.calibration.Calibration, q: np.ndarray) -> np.ndarray:
    """Return where the true reflector is in the robot's base."""
    free = result.problem.parameters.free
    x = np.where([name.startswith("base_") for name in free.names], 0.0, result.x)
    return reading(result, x, q[None])[0, :3]


def test_a_row_does_not_depend_on_the_others() -> None:
    result, q = limited()
    q[1::3, 4] = 0.0
    assert re.search(r"those of \d of 40 targets are known no better", ro.use.compensate(result, q).point)
    together = ro.use.compensate(result, q, orientation=True)  # of which the choice is one for all rows
    assert set(together.status) >= {"ok", "limited", "near singular"}
    for i in range(0, 40, 3):
        alone = ro.use.compensate(result, q[i : i + 1], orientation=True)
        assert alone.q[0] == pytest.approx(together.q[i], abs=1e-11)
        assert alone.status[0] == together.status[i]
        assert alone.std[0] == pytest.approx(together.std[i])
    poses = nominal_poses(result, q)
    searched = ro.use.compensate(result, poses=poses, orientation=True)
    alone = ro.use.compensate(result, poses=poses[7:8], orientation=True)
    assert alone.q[0] == pytest.approx(searched.q[7], abs=1e-9)


def test_poses_are_reached_in_the_measured_joint_ranges_where_that_can_be() -> None:
    result = calibrated()[0]
    low, high = result.ranges[""]
    inside = np.random.default_rng(4).uniform(0.95 * low, 0.95 * high, (25, 6))
    found = ro.use.compensate(result, poses=nominal_poses(result, inside))
    assert not found.outside.rows
    assert "No solution in the measured joint ranges" not in found.point
    far = nominal_poses(result, np.array([[0.5, -0.3, high[2] + 0.6, 0.2, 0.4, 0.1]]))  # an elbow bent further
    assert "No solution in the measured joint ranges was found for 1." in ro.use.compensate(result, poses=far).point


@pytest.mark.slow
def test_the_predicted_uncertainty_covers_what_is_missed() -> None:
    """Mean square miss over its prediction, 60 calibrations with deviations and noise as the scales say."""
    ratios, turned, q = [], [], commands(ARM, 40)
    for seed in range(60):
        problem, truth = simulated(noise=5e-5, seed=seed, configurations=30)
        result = ro.calibrate(problem, ro.tikhonov, 1.0)
        found = ro.use.compensate(result, q, orientation=True)
        good = ok(found)
        place, turn = misses(reading(result, truth, found.q), wanted(result, q))
        ratios.append(np.mean((place / found.std)[good] ** 2))
        turned.append(np.mean((turn / found.orientation_std)[good] ** 2))
    # standard errors of the means: positions 0.06, orientations 0.1 (about the same for all configurations)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.2)
    assert np.mean(turned) == pytest.approx(1.0, abs=0.3)


def test_the_base_is_compensated_only_when_asked() -> None:
    result, q = known(), commands(ARM)
    moved = ro.use.compensate(result, q, base=True, largest=0.5)
    there = reading(result, frames_of(result, "tool_"), q)  # base and robot as stated
    good = ok(moved)
    assert good.mean() > 0.7
    assert misses(reading(result, result.x, moved.q), there)[0][good].max() < 1e-10
    stays = ro.use.compensate(result, q, largest=0.5)
    assert misses(reading(result, result.x, stays.q), there)[0].min() > 1e-3


def test_a_tool_of_ones_own_is_taken_as_it_is() -> None:
    result, q = known(), commands(ARM)
    tool = [0.1, 0.02, 0.15, 0.3, -0.2, 0.1]
    found = ro.use.compensate(result, q, tool=tool, largest=0.5, orientation=True)
    parameters = ro.robot.model_parameters(ARM, tools={"": tool}).identify(["alpha?", "a?", "theta?", "d?", "beta3"])
    own = ro.CalibrationProblem(ARM, parameters, result.problem.data)
    robot = ~result.problem.parameters.of_frames[result.problem.parameters.identified]
    same = replace(result, problem=own, x=result.x[robot])
    target = reading(same, np.zeros(robot.sum()), q)
    good = ok(found)
    assert good.mean() > 0.75
    assert misses(reading(same, same.x, found.q), target)[0][good].max() < 1e-10
    assert (found.std > ro.use.compensate(result, q).std).all()  # the flange is known less than the reflector


def test_the_reflector_is_moved_wherever_it_was_stated() -> None:
    """A place from which its search began is no TCP of the controller: its error would move the flange."""
    result, q = known(), commands(ARM, 10)
    p = result.problem.parameters
    at = [p.names.index(f"tool_{c}") for c in "xyz"]
    x = np.zeros(len(p))
    x[p.identified] = result.x
    nominal = p.nominal.copy()
    nominal[at] = p.values(x)[at] - [0.11, -0.03, 0.26]
    x[at] = [0.11, -0.03, 0.26]
    far = result.problem.with_parameters(replace(p, nominal=nominal))
    found = ro.use.compensate(result, q, orientation=False)
    assert "the reflector, as identified, at" in found.point
    elsewhere = ro.use.compensate(replace(result, problem=far, x=x[p.identified]), q, orientation=False)
    assert elsewhere.q == pytest.approx(found.q, abs=1e-9)
    at_identified = ro.use.compensate(result, q, orientation=False, tool=_identified_tool(result))
    assert at_identified.q == pytest.approx(found.q, abs=1e-9)


def _identified_tool(result: ro.calibration.Calibration) -> np.ndarray:
    p = result.problem.parameters
    x = np.zeros(len(p))
    x[p.identified] = result.x
    tool = dict(zip(p.names, p.values(x), strict=True))
    return np.array([tool[f"tool_{c}"] for c in ("x", "y", "z", "rx", "ry", "rz")])


def test_several_reflectors_and_torques() -> None:
    instance = ro.load("markers")
    result = ro.calibrate(instance.problem, instance.formulation, 1.0)
    q = instance.problem.data.q[:5]
    marker = instance.problem.data.blocks[0].markers[0]
    assert ok(ro.use.compensate(result, q, marker=marker, orientation=False)).all()
    with pytest.raises(ro.InputError, match="marker: found none"):
        ro.use.compensate(result, q)
    elastic = ro.load("joints")
    result = ro.calibrate(elastic.problem, elastic.formulation, 1.0)
    block = elastic.problem.data.blocks[0]
    q, torque = block.q[:20, 0], block.torque[:20, 0]
    found = ro.use.compensate(result, q, torque=torque, orientation=False)
    data = replace(ro.Dataset.of(found.q, np.zeros((20, 3)), 1.0))
    loaded = replace(data, blocks=(replace(data.blocks[0], torque=torque[:, None]),))
    is_ = result.problem.on(loaded).modelled(result.x)[0]
    assert np.linalg.norm(is_ - wanted_position(result, q, torque), axis=1)[ok(found)].max() < 1e-7
    with pytest.raises(ro.InputError, match="without joint torques"):
        ro.use.compensate(result, q)


def compensated(result: ro.calibration.Calibration, table: Path, **options: Any) -> ro.use.Compensation:
    targets, _ = ro.use.read_targets(result, table)
    columns = {"torque": targets.torque, "payload": targets.payload, "label": targets.label}
    return ro.use.compensate(result, targets.q, targets.poses, **columns, **options)


def test_torques_of_a_table_are_those_of_an_array(tmp_path) -> None:
    instance = ro.load("joints")
    result = ro.calibrate(instance.problem, instance.formulation, 1.0)
    block = instance.problem.data.blocks[0]
    q, torque = block.q[:5, 0], block.torque[:5, 0]
    rows = np.hstack([np.degrees(q), torque])
    names = [f"q{i}_deg" for i in range(1, 7)] + [f"tau{i}_Nm" for i in range(1, 7)]
    np.savetxt(tmp_path / "targets.csv", rows, delimiter=",", header=",".join(names), comments="", fmt="%.17g")
    found = compensated(result, tmp_path / "targets.csv", orientation=False)
    assert found.q == pytest.approx(ro.use.compensate(result, q, torque=torque, orientation=False).q, abs=1e-12)
    other = ro.use.compensate(result, q, torque=torque[:, ::-1], orientation=False)
    assert np.abs(found.q - other.q).max() > 1e-6


def wanted_position(result: ro.calibration.Calibration, q: np.ndarray, torque: np.ndarray) -> np.ndarray:
    data = ro.Dataset.of(q, np.zeros((len(q), 3)), 1.0)
    loaded = replace(data, blocks=(replace(data.blocks[0], torque=torque[:, None]),))
    return result.problem.on(loaded).modelled(frames_of(result, "base_", "tool_"))[0]


def test_a_formulation_without_covariance_has_no_uncertainty() -> None:
    result, _ = calibrated()
    sparse = ro.calibrate(result.problem, ro.lasso, 1.0)
    found = ro.use.compensate(sparse, commands(ARM, 5))
    assert np.isinf(found.std).all()
    assert "standard uncertainty" not in str(found)


@pytest.mark.parametrize("orientation", ["qw,qx,qy,qz", "rx_deg,ry_deg,rz_deg", ""])
def test_tables_of_targets_in_and_of_commands_out(tmp_path: Path, orientation: str) -> None:
    result, q = known("SCARA"), commands(SCARA, 6)
    names, unit = ["q1_deg", "q2_deg", "q3_mm", "q4_deg"], np.array([np.pi / 180, np.pi / 180, 1e-3, np.pi / 180])
    poses = nominal_poses(result, q)
    angles = Rotation.from_quat(poses[:, [4, 5, 6, 3]]).as_euler("xyz", degrees=True)
    turn = {"qw,qx,qy,qz": poses[:, 3:], "rx_deg,ry_deg,rz_deg": angles, "": np.empty((6, 0))}[orientation]
    head = ["label", *names, "x_mm", "y_mm", "z_mm", *orientation.split(",")]
    write(tmp_path / "both.csv", head, np.hstack([q / unit, 1e3 * poses[:, :3], turn]))
    write(tmp_path / "joints.csv", ["label", *names], q / unit)
    write(tmp_path / "poses.csv", ["label", *head[5:]], np.hstack([1e3 * poses[:, :3], turn]))
    targets, _ = ro.use.read_targets(result, tmp_path / "both.csv")
    assert targets.label == tuple("ABCDEF")
    assert targets.q == pytest.approx(q)
    assert targets.poses == pytest.approx(poses[:, : 7 if orientation else 3], abs=1e-12)
    assert ro.use.read_targets(result, tmp_path / "joints.csv")[0].poses is None
    assert ro.use.read_targets(result, tmp_path / "poses.csv")[0].q is None
    found = compensated(result, tmp_path / "joints.csv")
    rows = list(csv.DictReader(found.csv().splitlines()))
    assert [row["label"] for row in rows] == list("ABCDEF")
    assert [row["status"] for row in rows] == list(found.status)
    written = np.array([[float(row[name]) for name in names] for row in rows]) * unit
    assert written == pytest.approx(found.q, abs=1e-10)
    largest = np.abs(found.q - q).max(axis=0) / unit
    assert found.content()["largest_corrections"] == pytest.approx(dict(zip(names, largest, strict=True)), abs=1e-9)
    assert float(rows[0]["std_mm"]) == pytest.approx(1e3 * found.std[0], abs=1e-6)
    again = compensated(result, tmp_path / "both.csv")
    assert again.position_error.max() < 1e-7
    assert "6 targets" in str(again)


def test_turns_in_another_convention_than_that_of_the_joint_values_beside_them_are_refused(tmp_path: Path) -> None:
    """Read as roll, pitch, yaw, Universal Robots' rotation vectors turn the tool by tens of degrees."""
    result, q = known("six axes"), commands(ARM, 6)
    poses = nominal_poses(result, q)
    turns = Rotation.from_quat(poses[:, [4, 5, 6, 3]])
    head = ["label", *(f"q{i}_rad" for i in range(1, 7)), "x_mm", "y_mm", "z_mm", *(f"R{a} [rad]" for a in "XYZ")]
    table = tmp_path / "targets.csv"
    accepted = {"vector": turns.as_rotvec(), "intrinsic zyz": turns.as_euler("ZYZ"), "": turns.as_euler("xyz")}
    for rotation, angles in accepted.items():
        write(table, head, np.hstack([q, 1e3 * poses[:, :3], angles]))
        options = ro.data.TableOptions(rotation=rotation)
        assert misses(ro.use.read_targets(result, table, options)[0].poses, poses)[1].max() < 1e-7
    for count in (1, 6):  # one row is enough: the tool is known
        write(table, head, np.hstack([q, 1e3 * poses[:, :3], accepted["vector"]])[:count])
        with pytest.raises(ro.InputError, match=r"as extrinsic xyz, and vector 0\.00 deg, .*rotation 'vector' if"):
            ro.use.read_targets(result, table)
    # joint values of other poses tell nothing of the convention; nor do those of another tool
    write(table, head, np.hstack([q[::-1], 1e3 * poses[:, :3], accepted["vector"]]))
    assert len(ro.use.read_targets(result, table)[0].label) == 6
    write(table, head, np.hstack([q, 1e3 * poses[:, :3], accepted["vector"]]))
    assert len(ro.use.read_targets(result, table, tool=[0, 0, 0, 0.5, 0.2, 0])[0].label) == 6
    # without joint values nothing tells
    write(table, ["label", *head[7:]], np.hstack([1e3 * poses[:, :3], accepted["vector"]]))
    with pytest.raises(ro.InputError, match=r"rx, ry, rz in rad without .*rotation vector"):
        ro.use.read_targets(result, table)
    told = ro.use.read_targets(result, table, ro.data.TableOptions(rotation="vector"))[0]
    assert misses(told.poses, poses)[1].max() < 1e-7


def write(path: Path, head: list[str], values: np.ndarray) -> None:
    lines = [",".join(filter(None, head))]
    lines += [",".join(["ABCDEF"[i], *(repr(float(v)) for v in row)]) for i, row in enumerate(values)]
    path.write_text("\n".join(lines) + "\n")


def test_bad_input_is_answered_in_a_sentence(tmp_path: Path) -> None:
    result, q = known(), commands(ARM, 3)
    wrong = {
        "targets: found neither joint values nor poses": {},
        r"q: found shape \(3, 5\), accepted: finite numbers of shape \(3, 6\)": {"q": q[:, :5]},
        "q, row 2: found .* accepted: finite numbers": {"q": np.where([[0], [1], [0]], np.nan, q)},
        r"poses: found shape \(3, 4\), accepted: finite numbers of shape \(3, 7\) or \(3, 3\)": {
            "poses": np.zeros((3, 4))
        },
        "poses, row 1: found a quaternion of norm 0": {"poses": np.zeros((3, 7))},
        r"torque: found shape \(2, 6\)": {"q": q, "torque": q[:2]},
        "largest: found 0": {"q": q, "largest": 0},
        "label: found 2 labels": {"q": q, "label": ("a", "b")},
        r"tool: found shape \(2,\)": {"q": q, "tool": [1, 2]},
        "marker: found 'B'": {"q": q, "marker": "B"},
    }
    for message, arguments in wrong.items():
        with pytest.raises(ro.InputError, match=message):
            ro.use.compensate(result, **arguments)
    table = tmp_path / "targets.csv"
    for text, message in {
        "load,speed\n1,2\n": rf"{table.name}, the header: found no known column \(load, speed\)",
        "label,speed\n1,2\n": f"{table.name}, the header: found no targets",
        "q1_deg,q2_deg\n1,2\n": "'q3'",
        "x_mm,y_mm\n1,2\n": "'z'",
        "x_mm,y_mm,z_mm,qw,qx,qy,qz\n0,0,0,2,0,0,0\n": "row 1: found a quaternion of norm 2",
        "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n1,2,3,4,5,x\n": "row 1, column q6_deg: found 'x'",
    }.items():
        table.write_text(text)
        with pytest.raises(ro.InputError, match=message):
            compensated(result, table)


def test_a_row_beyond_the_measured_joint_ranges_is_extrapolated_and_the_uncertainty_is_that_of_a_prediction() -> None:
    result, _ = calibrated()
    low, high = result.ranges[""]
    q = np.tile(low + 0.65 * (high - low), (2, 1))
    q[1, 5] = high[5] + 0.6
    found = ro.use.compensate(result, q)
    assert found.status == ("ok", "extrapolated")
    assert not found.missed
    predicted = result.predict(found.q, of="reached")  # in the instrument's frame, with the base's uncertainty
    assert found.std == pytest.approx(np.linalg.norm(predicted.standard, axis=1), rel=1e-9)
    assert "position in the instrument's frame [mm], standard uncertainty" in str(found)


def test_a_limit_holds_for_what_is_left_and_its_uncertainty() -> None:
    """The flange is known less than the reflector: its model error is zero by the model alone."""
    result, q = calibrated()[0], commands(ARM, 10)
    tool = [0.0, 0.0, 0.5, 0.0, 0.0, 0.0]
    known_to = ro.use.compensate(result, q, tool=tool)
    assert not known_to.missed
    limit = float(np.median(2 * known_to.std))
    found = ro.use.compensate(result, q, tool=tool, limit=limit)
    above = 2 * found.std + found.position_error > limit
    assert found.missed == [label for label, far in zip(found.label, above, strict=True) if far]
    assert 0 < len(found.missed) < 10
    said = str(found)
    assert f"{found.missed[0]} (error 0.000 mm, U {2e3 * found.std[found.label.index(found.missed[0])]:.3f} mm" in said
    assert f"{above.sum()} of 10 commands reach their target by the model" in said
    assert "miss their target" not in said
    for text in (said, str(known_to)):  # with and without a limit
        assert (
            "measure a reflector as far from the flange as this tool, or state what is known of the reflector" in text
        )


def test_a_common_motion_of_all_targets_is_told_from_what_is_uncertain_beside_it() -> None:
    """Distances do not show where the base is: U was 5 mm, unsaid that targets are right to 0.1 mm among themselves."""
    instance = ro.load("distance")
    q = instance.validation.blocks[0].q[:30, 0]
    found = ro.use.compensate(ro.calibrate(instance.problem, ro.tikhonov, 1.0), q, marker="A")
    std = np.sqrt(np.mean(found.std**2))
    assert found.std_after_motion < std / 20
    text = f"Relative to each other it is {2e3 * found.std_after_motion:.4f} mm RMS."
    assert f"{2e3 * std:.4f} mm RMS, is a common displacement of all targets" in str(found)
    assert text in str(found)
    assert "Relative to each other" not in str(ro.use.compensate(calibrated()[0], commands(ARM, 30)))


def test_orientations_have_no_uncertainty_where_they_do_not_count() -> None:
    found = ro.use.compensate(calibrated()[0], commands(ARM, 2), orientation=False)
    assert np.isnan(found.orientation_std).all()
    assert "orientation" not in str(found)


def test_positions_far_from_the_joint_values_beside_them_are_named() -> None:
    result, q = known(), commands(ARM, 4)
    poses = nominal_poses(result, q)
    assert "in the same row" not in str(ro.use.compensate(result, q, poses))
    poses[2, :3] += [0.0, 0.0, 0.1]
    assert "by up to 100 mm (row 3)" in str(ro.use.compensate(result, q, poses))
