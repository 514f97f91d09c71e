"""Signs and zeros of joints are found from measurements where the nominal robot does not explain them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration import inspect
from rpim_opt.data.measurements.pose import pose
from rpim_opt.problem.registration.global_start import mapped
from rpim_opt.robot import Robot, forward_kinematics
from rpim_opt.robot.kinematics import numeric_frame
from rpim_opt.robot.library import find_robot

COUNT, UNSEEN, NOISE = 20, 60, 5e-4
QUARTER = np.pi / 2
HOBBY = Robot(
    "hobby arm",
    np.array([[0, 0, 0, 0.06, 0], [-QUARTER, 0.03, 0, 0, 0], [0, 0.12, 0, 0, 0], [0, 0.13, 0, 0, 0],
              [-QUARTER, 0, 0, 0.06, 0]]),
    limits=np.array([[-1.9, 1.9], [-1.7, 1.7], [-1.7, 1.7], [-1.6, 1.6], [-2.7, 2.7]]),
)  # fmt: skip
SCARA = Robot(
    "SCARA",
    np.array([[0, 0, 0, 0.2, 0], [0, 0.325, 0, 0, 0], [np.pi, 0.275, 0, 0, 0], [0, 0, 0, 0.05, 0]]),
    ("revolute", "revolute", "prismatic", "revolute"),
    limits=np.array([[-2.3, 2.3], [-2.5, 2.5], [0.0, 0.2], [-3.1, 3.1]]),
)


def robot_of(name: str) -> Robot:
    return {"hobby": HOBBY, "scara": SCARA}.get(name) or ro.read_robot(find_robot(name))


def simulated(name: str, seed: int, sign: np.ndarray | None = None, zero: np.ndarray | None = None, kind="position"):
    """Return the problem, unseen rows, and the same problem with the true mapping stated."""
    robot = robot_of(name)
    rng = np.random.default_rng([seed, robot.dof])
    turning = np.array([each == "revolute" for each in robot.joint_types])
    low, high = np.clip(robot.limits, -2.5, 2.5).T
    q = rng.uniform(low, high, (COUNT + UNSEEN, robot.dof))
    sign = rng.choice([-1.0, 1.0], robot.dof) if sign is None else sign
    zero = rng.uniform(-np.pi, np.pi, robot.dof) * turning if zero is None else zero
    true = replace(robot, mdh=robot.mdh + rng.normal(size=robot.mdh.shape) * [2e-3, 1e-3, 2e-3, 1e-3, 0])
    T = numeric_frame([1.2, -0.7, 0.35, 0.2, -0.4, 1.1]) @ forward_kinematics(true, q)
    T = T @ numeric_frame([0.03, -0.02, 0.08, 0.3, 0.2, -0.5])
    y = T[:, :3, 3] + NOISE * rng.normal(size=(len(q), 3))
    if kind == "pose":
        turns = quaternions(T[:, :3, :3])
        y = np.hstack([y, turns])
    counted = sign * (q - zero)
    parameters = ro.robot.model_parameters(robot, (1.0, 0, 0, 0, 0, 0), {"": [0.0] * 6})
    tool = ["tool_[xyz]"] if kind == "position" else ["tool_*"]
    parameters = parameters.identify(["alpha?", "a?", "theta?", "d?", "base_*", *tool])
    parameters = parameters.scaled({"base_mm": 10, "base_mrad": 10, "tool_mm": 10})
    noise = NOISE if kind == "position" else [NOISE, 1e-3]
    data, unseen = (rows(counted[part], y[part], noise, kind) for part in (slice(COUNT), slice(COUNT, None)))
    problem = ro.CalibrationProblem(robot, parameters, data)
    truth = mapped(robot, sign, zero)
    nominal = parameters.nominal.copy()
    nominal[: 5 * robot.dof] = truth.mdh.ravel()
    return problem, unseen, replace(problem, robots=truth, parameters=replace(parameters, nominal=nominal))


def quaternions(R: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(R).as_quat()[:, [3, 0, 1, 2]]


def rows(q: np.ndarray, y: np.ndarray, noise, kind: str) -> ro.Dataset:
    if kind == "position":
        return ro.Dataset.of(q, y, noise)
    sigma = np.repeat(noise, 3)
    return ro.Dataset.of(q, y, np.diag(sigma**2), measurement=pose)


def error(result: ro.Calibration, unseen: ro.Dataset) -> float:
    return float(np.sqrt(np.mean(result.errors(unseen) ** 2)))


@pytest.mark.parametrize("name", ["hobby", "ur5e", "scara"])
def test_random_signs_and_zeros_are_found(name: str) -> None:
    problem, unseen, truth = simulated(name, 3)
    result = ro.calibrate(problem)
    assert result.converged
    assert result.mapping is not None
    assert "Joint mapping estimated from the data: " in result.message
    assert error(result, unseen) < 1.2 * error(ro.calibrate(truth), unseen)
    assert np.abs(np.degrees(result.x[["theta" in n for n in result.problem.parameters.free.names]])).max() < 3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hobby", "ur5e", "kr6_r900", "panda", "scara"])
@pytest.mark.parametrize("seed", range(10))
def test_many_random_signs_and_zeros_are_found(name: str, seed: int) -> None:
    problem, unseen, truth = simulated(name, seed)
    result = ro.calibrate(problem)
    assert result.mapping is not None
    # what is lost is what the nominal robot says of the zeros
    assert error(result, unseen) < 1.2 * error(ro.calibrate(truth), unseen) or result.mapping.alternatives


def test_another_description_of_the_same_robot_is_named() -> None:
    """A reversed joint 5 is half a turn of joint 4 and of the reflector: exports say how joints count."""
    problem = ro.load("position").problem
    block = problem.data.blocks[0]
    turned = replace(block, q=block.q * np.array([1, 1, 1, 1, -1, 1]))
    result = ro.calibrate(problem.on(replace(problem.data, blocks=(turned,))))
    assert result.mapping is not None
    assert "zero of joint 4 +180.0 deg (" in result.message
    both = "zero of joint 4 +180.0 deg, or joint 5 reversed (sign = -1)"
    said = (
        f"Signs or zeros of joints differ between table and robot file: {both} (these explain the data equally well, "
    )
    assert result.verdict.caution.startswith(said)
    assert str(result.verdict).startswith(f"Delivered under a condition. {said}")
    assert both in inspect(problem.on(replace(problem.data, blocks=(turned,)))).judgement[0]


def test_of_two_descriptions_that_the_one_with_the_stated_reflector_is_taken() -> None:
    """Half a turn of joint 5 and a reflector 360 mm behind the flange explain positions as a reversed joint 6 does."""
    instance = ro.load("position")
    robot, block = instance.problem.robot, instance.problem.data.blocks[0]
    turned = replace(block, q=block.q * np.array([1, 1, 1, 1, 1, -1]))
    result = ro.calibrate(instance.problem.on(replace(instance.problem.data, blocks=(turned,))))
    assert result.mapping is not None
    assert result.mapping.sign.tolist() == [1, 1, 1, 1, 1, -1]
    assert "joint 6 reversed (sign = -1), or zero of joint 5 +180.0 deg (these explain" in result.verdict.caution
    assert result.mapping.moved < 0.08 < 2 * robot.mdh[-1, 3] < result.mapping.same[0].moved


def test_zeros_that_were_found_are_not_held_there() -> None:
    """20 points tell zeros to some mrad: held there the error was 1.18 times as large."""
    problem, unseen, truth = simulated("panda", 101)
    assert error(ro.calibrate(problem), unseen) < 1.12 * error(ro.calibrate(truth), unseen)


def test_poses_show_signs_and_zeros() -> None:
    problem, unseen, truth = simulated("ur5e", 2, kind="pose")
    result = ro.calibrate(problem)
    assert result.mapping is not None
    assert error(result, unseen) < 1.2 * error(ro.calibrate(truth), unseen)


@pytest.mark.slow
def test_a_known_base_stays_where_it_is_stated_and_joint_1_takes_up_its_zero() -> None:
    problem, *_ = simulated("hobby", 2, kind="pose")
    base = dict(zip(("x", "y", "z", "rx", "ry", "rz"), (1.2, -0.7, 0.35, 0.2, -0.4, 1.1), strict=True))
    nominal = problem.parameters.nominal.copy()
    known = ro.bayes.Prior()
    for axis, value in base.items():
        nominal[problem.parameters.names.index(f"base_{axis}")] = value
        known &= ro.bayes.Prior.known(f"base_{axis} +- 1 {'mrad' if 'r' in axis else 'mm'}")
    problem = replace(problem, parameters=replace(problem.parameters, nominal=nominal))
    result = ro.calibrate(problem, prior=known)
    values = result.problem.parameters.by_name(result.x)
    assert result.mapping is not None
    assert result.converged
    assert [values[f"base_{axis}"] for axis in base] == pytest.approx(list(base.values()), abs=0.005)


@pytest.mark.parametrize("name", ["scara", pytest.param("ur5e", marks=pytest.mark.slow)])
def test_lengths_show_signs_and_zeros_but_not_which_of_two_mirror_images(name: str) -> None:
    """A draw-wire whose anchor is not known; held-out lengths are as with the truth stated, for both images."""
    robot = robot_of(name)
    problem, unseen, truth = simulated(name, 3)

    def lengths(data: ro.Dataset) -> ro.Dataset:
        away = np.linalg.norm(data.blocks[0].y - [0.4, 0.9, 1.1], axis=1, keepdims=True)
        return ro.Dataset.of(data.q, away + 0.05, NOISE, measurement="cable")

    result = ro.calibrate(ro.problem_from(robot, lengths(problem.data)))
    assert result.mapping is not None
    assert [each.mirror for each in result.mapping.alternatives] == [True]
    assert "do not distinguish an arm from its mirror image" in str(result)
    stated = ro.calibrate(ro.problem_from(truth.robot, lengths(problem.data)))
    assert stated.mapping is None
    assert error(result, lengths(unseen)) < 1.2 * error(stated, lengths(unseen))


def test_a_mirror_image_with_stated_signs_is_not_delivered_either() -> None:
    """A reversed stroke and zeros of any size: lengths fit an arm with stated signs and other zeros as well."""
    problem, _, _ = simulated("scara", 3, np.array([1.0, 1, -1, 1]), np.array([0.3, 1.0, 0, 0.8]))
    away = np.linalg.norm(problem.data.blocks[0].y - [0.4, 0.9, 1.1], axis=1, keepdims=True)
    result = ro.calibrate(
        ro.problem_from(problem.robot, ro.Dataset.of(problem.data.q, away, NOISE, measurement="cable"))
    )
    assert result.mapping is not None
    assert (result.mapping.sign > 0).all()
    assert not result.verdict.delivered
    assert "do not distinguish an arm from its mirror image" in str(result.verdict)


def test_what_is_found_goes_into_the_mapping() -> None:
    """One joint reversed and one a quarter turn off are said exactly, in the words of robot.toml."""
    sign = np.array([1.0, 1, -1, 1, 1, 1])
    zero = np.array([0.0, QUARTER, 0, 0, 0, 0])
    problem, _, _ = simulated("ur5e", 1, sign, zero)
    result = ro.calibrate(problem)
    assert (result.problem.robot.joint_map == np.diag(sign)).all()
    assert np.allclose(result.problem.robot.mdh[:, 2] - problem.robot.mdh[:, 2], zero)
    assert "joint 3 reversed (sign = -1), zero of joint 2 +90.0 deg" in result.message
    commands = ro.use.compensate(result, problem.data.q[:3], orientation=False)
    for said in (str(commands), commands.csv()):  # or a controller that counts otherwise turns joint 3 the wrong way
        assert "joint 3 reversed (sign = -1), zero of joint 2 +90.0 deg. The result holds" in said


def test_a_result_keeps_its_mapping(tmp_path) -> None:
    problem, unseen, _ = simulated("scara", 4)
    names = ("Arm_A", "Arm_B", "Quill", "Wrist")
    result = ro.calibrate(replace(problem, robots=replace(problem.robot, joint_names=names)))
    ro.store.save_result(result, tmp_path / "result.json")
    again = ro.load_result(tmp_path / "result.json")
    assert again.mapping.sentence == result.mapping.sentence
    assert "add their zeros to theta_deg (or theta_rad)" in result.verdict.caution
    assert "joint 2 (Arm_B) reversed (sign = -1), zero of joint 2 (Arm_B) -18.9 deg. " in result.verdict.caution
    assert np.allclose(again.errors(unseen), result.errors(unseen))
    assert again.without_flagged().mapping is not None


def test_gross_errors_do_not_hide_it() -> None:
    problem, unseen, truth = simulated("ur5e", 5)
    (block,) = problem.data.blocks
    y = block.y.copy()
    y[[3, 11]] += [0.3, -0.2, 0.1]
    wrong = problem.on(replace(problem.data, blocks=(replace(block, y=y),)))
    assert error(ro.calibrate(wrong), unseen) < 1.5 * error(ro.calibrate(truth), unseen)


def test_robots_that_are_nominal_or_read_otherwise_are_not_mapped() -> None:
    """Neither is a left-handed measured frame, which reversed joints would fit as well."""
    problem, _, _ = simulated("ur5e", 6, np.ones(6), np.zeros(6))
    assert ro.calibrate(problem).mapping is None
    (block,) = problem.data.blocks
    for y in (block.y * [1, -1, 1], block.y[::-1]):
        wrong = problem.on(replace(problem.data, blocks=(replace(block, y=y),)))
        assert ro.calibrate(wrong).mapping is None


def test_a_left_handed_frame_with_a_reversed_joint_is_named_beside_the_description_without_a_mirror() -> None:
    problem = ro.load("position").problem  # an arm that is its own mirror image, but for joints 2, 4 and 5
    (block,) = problem.data.blocks
    q, y = block.q.copy(), block.y.copy()
    q[..., 4] *= -1
    reversed_ = ro.calibrate(problem.on(replace(problem.data, blocks=(replace(block, q=q),))))
    assert reversed_.mapping is not None
    assert reversed_.mapping.behind == ""
    assert reversed_.verdict.delivered
    y[:, 1] *= -1
    both = ro.calibrate(problem.on(replace(problem.data, blocks=(replace(block, q=q, y=y),))))
    assert not both.verdict.delivered
    assert "left-handed measured frame with joint 5 reversed" in str(both.verdict)


@pytest.mark.parametrize("name", ["a3", "d4"])
def test_a_length_of_the_wrong_sign_is_no_matter_of_the_joints_alone(name: str) -> None:
    """Half a turn of joints explains it as well: the number of the robot file comes first, here and in `inspect`."""
    problem = ro.load("position").problem
    joint, column = int(name[1:]) - 1, ["alpha", "a", "theta", "d", "beta"].index(name[0])
    mdh, nominal = problem.robot.mdh.copy(), problem.parameters.nominal.copy()
    mdh[joint, column] *= -1
    nominal[problem.parameters.names.index(name)] *= -1
    parameters = replace(problem.parameters, nominal=nominal)
    wrong = ro.CalibrationProblem(replace(problem.robot, mdh=mdh), parameters, problem.data)
    result = ro.calibrate(wrong)
    assert f"robot file: {name} with the opposite sign in the robot file, or " in result.verdict.caution
    assert result.verdict.caution.endswith(f"Check the sign of {name} first.")
    assert inspect(wrong).judgement[0] == result.verdict.caution
    assert not ro.calibrate(problem).verdict.caution
