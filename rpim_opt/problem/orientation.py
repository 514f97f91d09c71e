"""How well measured orientations fit a nominal robot, whatever its base and tool."""

from __future__ import annotations

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.late import transform
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.placing import hand_eye, transforms
from rpim_opt.robot.kinematics import forward_kinematics
from rpim_opt.robot.mdh import Robot


def pose_misfit(robot: Robot, data: Dataset) -> float:
    """Return the RMS angle [rad] between measured and nominal orientations, base and tool fitted.

    Parameters
    ----------
    robot
        As its drawing says.
    data
        Poses; the first block of them counts.

    Returns
    -------
    Pi where the poses do not determine base and tool.
    """
    block = next(each for each in data.blocks if each.measurement.name == "pose")
    flange = forward_kinematics(robot, block.q[:, 0])
    measured = transforms(block.y)
    try:
        Z, X = hand_eye(flange, measured)
    except InputError:
        return float(np.pi)
    error = np.swapaxes(measured[:, :3, :3], 1, 2) @ (Z @ flange @ X)[:, :3, :3]
    return float(np.sqrt(np.mean(transform.Rotation.from_matrix(error).magnitude() ** 2)))
