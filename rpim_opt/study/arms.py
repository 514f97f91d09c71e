"""Simulated arms with errors in all six directions after every link, of magnitudes that vary between arms."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.closed_forms import rigid
from rpim_opt.robot.formats.tables import read_robot
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import model_parameters

KINDS = {"ur10e": ["beta[23]"], "irb120": ["beta2"], "iiwa7": []}
"""Ready robots on which arms are based, with Hayati's parameter where neighbouring axes are parallel."""
SCALES = {"length_mm": 1.0, "angle_mrad": 1.0, "tool_mm": 10.0, "base_mm": 100.0, "base_mrad": 100.0}
"""Prior scales stated for every arm, those of a folder without further knowledge."""
BASE = (1.5, -0.8, 0.3, 0.0, 0.0, 0.6)
TOOL = (0.04, -0.02, 0.11, 0.0, 0.0, 0.0)
REACH = np.radians(120)
VALIDATION_COUNT = 200  # configurations at which an arm is judged


class SimulatedArm(NamedTuple):
    """Simulated tracker measurements of an arm with known true parameters.

    ``problem`` has the identification data and generic scales, ``true`` the true positions of validation configurations
    [m], ``read`` the tracker's readings of the same.
    """

    problem: CalibrationProblem
    true: Dataset
    read: Dataset


def simulated_arm(
    seed: int,
    count: int,
    noise: float = 3e-5,
    offset: float = 0.0,
    joints: Callable[[Robot, Array], Array] = lambda _, q: q,
) -> SimulatedArm:
    """Return a simulated arm; successive seeds cycle through three robots.

    A small transform follows every link. The standard deviation of its lengths is 0.05 to 1 mm (log-uniform, one per
    arm), that of its angles 1 to 30 mrad per mm of this (at most 5 mrad), each with an own factor exp(N(0, 1)); joint
    offsets add three times such angles. The base is known to 2 mm and 2 mrad, the reflector to 3 mm.

    ``seed`` is that of the arm; ``count``, the number of identification configurations, changes neither its truth nor
    the configurations in common with a smaller count. ``noise`` is the standard deviation of a coordinate [m], declared
    correctly, ``offset`` an additional angle [rad] of one joint, neither the first nor the last. ``joints`` returns the
    robot's joint values at encoder values (N, dof) [rad], for errors beyond geometry.

    >>> import rpim_opt as ro
    >>> arm = ro.study.simulated_arm(seed=1, count=25, offset=0.017)
    >>> result = ro.calibrate(arm.problem)
    >>> arm.problem.robot.name, len(arm.true), bool(result.errors(arm.true).mean() < 1e-4)
    ('ABB IRB 120-3/0.58', 200, True)
    """
    name = list(KINDS)[seed % len(KINDS)]
    robot = read_robot(name)
    rng = np.random.default_rng([seed, 77])
    length = np.exp(rng.uniform(np.log(5e-5), np.log(1e-3)))
    angle = min(length * np.exp(rng.uniform(0, np.log(30))), 5e-3)
    local = np.exp(rng.standard_normal((robot.dof, 6)))
    # a small transform per row: lengths [m], rotation vector [rad]
    errors = rng.standard_normal((robot.dof, 6)) * local * np.repeat([length, angle], 3)
    errors[:, 5] += 3 * angle * rng.standard_normal(robot.dof)
    errors[rng.integers(1, robot.dof - 1), 5] += offset * rng.choice([-1.0, 1.0])
    base = _small(np.array(BASE)) @ _small(2e-3 * rng.standard_normal(6))
    tool = np.array(TOOL[:3]) + 3e-3 * rng.standard_normal(3)
    limits = np.clip(robot.limits, -REACH, REACH)
    there = np.random.default_rng([seed, 3]).uniform(limits[:, 0], limits[:, 1], (VALIDATION_COUNT, robot.dof))
    q = np.random.default_rng([seed, 1]).uniform(limits[:, 0], limits[:, 1], (count, robot.dof))

    def measured(encoders: Array, level: float, stream: int) -> Dataset:
        T = base @ flange(robot, joints(robot, encoders), errors)
        points = T[:, :3, :3] @ tool + T[:, :3, 3]
        draws = np.random.default_rng([seed, stream]).standard_normal(points.shape)
        return Dataset.of(encoders, points + level * draws, noise)

    parameters = model_parameters(robot, base=list(BASE), tools={"": list(TOOL)}).scaled(SCALES)
    identified = ["alpha?", "a?", "d?", "theta?", *KINDS[name], "base_*", "tool_[xyz]"]
    problem = CalibrationProblem(robot, parameters.identify(identified), measured(q, noise, 2))
    return SimulatedArm(problem, measured(there, 0.0, 4), measured(there, noise, 4))


def flange(robot: Robot, q: Array, errors: Array) -> Array:
    """Return the frames (N, 4, 4) after the last of revolute joints, each followed by a small transform."""
    T = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    for (alpha, a, theta, d, beta), angle, error in zip(robot.mdh, (q @ robot.joint_map.T).T, errors, strict=True):
        about_z = scipy.spatial.transform.Rotation.from_euler("z", (theta + angle)[:, None]).as_matrix()
        turn = rigid(about_z, np.zeros(3))
        behind = _small(np.array([0, 0, d, 0, beta, 0]))
        T = T @ _small(np.array([a, 0, 0, alpha, 0, 0])) @ turn @ behind @ _small(error)
    return T


def _small(numbers: Array) -> Array:
    """Return the transform (4, 4) of a translation and a rotation vector."""
    return rigid(scipy.spatial.transform.Rotation.from_rotvec(numbers[3:]).as_matrix(), numbers[:3])
