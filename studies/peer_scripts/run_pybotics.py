"""Calibrate one benchmark problem with pybotics; called by ``studies/peers.py`` in the peer's own environment.

``documented`` is the package's example: residuals are distances, SciPy's default method. ``xyz`` gives the solver the
coordinates of the same model instead, ``xyz, soft_l1`` with a robust loss. Chain, base and reflector are identified.
Units: mm and rad.
"""

from common import answer  # first: it starts the clock

import json
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
from pybotics.optimization import OptimizationHandler, optimize_accuracy
from pybotics.robot import Robot
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation


def placed(base: list) -> np.ndarray:
    """Return the transform (4, 4) of a base x, y, z [m], roll, pitch, yaw [rad], in mm."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", base[3:]).as_matrix()
    T[:3, 3] = 1e3 * np.array(base[:3])
    return T


def run(folder: Path, method: str) -> dict:
    """Return what the method finds."""
    table = json.loads((folder / "robot.json").read_text())
    calib, valid = (np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1) for name in ("calib", "valid"))
    rows = np.array(table["alpha_a_theta_d"]) * [1, 1e3, 1, 1e3]
    robot = Robot.from_parameters(rows.ravel())
    robot.tool.position = 1e3 * np.array(table["tool"])
    robot.world_frame = placed(table["base"])
    tool = [True] * 3 + [False] * 3
    handler = OptimizationHandler(robot, kinematic_chain_mask=True, tool_mask=tool, world_mask=True)
    q, p = calib[:, 3:], 1e3 * calib[:, :3]
    x0 = handler.generate_optimization_vector()

    def positions(joints: np.ndarray) -> np.ndarray:
        return np.array([handler.robot.fk(row)[:3, 3] for row in joints])

    def coordinates(x: np.ndarray) -> np.ndarray:
        handler.apply_optimization_vector(x)
        return (positions(q) - p).ravel()

    start = time.perf_counter()
    if method == "documented":
        found = least_squares(optimize_accuracy, x0, args=(handler, q, p))
    elif method == "xyz":
        found = least_squares(coordinates, x0)
    else:
        found = least_squares(coordinates, x0, loss="soft_l1", f_scale=1e3 * table["noise"])
    seconds = time.perf_counter() - start
    handler.apply_optimization_vector(found.x)
    change = np.abs(found.x - x0)
    angles = np.append(np.tile([True, False, True, False], len(rows)), [False] * 6 + [True] * 3)
    return {
        "seconds": seconds,
        "largest_mm": change[~angles].max(),
        "largest_mrad": 1e3 * change[angles].max(),
        "predicted_mm": positions(valid[:, 3:]).tolist(),
    }


if __name__ == "__main__":
    packages = {"pybotics": "pybotics", "SciPy": "scipy", "NumPy": "numpy"}
    answer(run, {label: version(package) for label, package in packages.items()})
