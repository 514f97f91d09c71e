"""Calibrate one benchmark problem with pybotics; called by ``studies/peers.py`` in the peer's own environment.

``documented`` is the package's example: residuals are distances, SciPy's default method. ``xyz`` gives the solver the
coordinates of the same model instead. Units: mm and rad.
"""

import json
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
from pybotics.optimization import OptimizationHandler, optimize_accuracy
from pybotics.robot import Robot
from scipy.optimize import least_squares

SETTINGS = {
    "xyz, trf": {},
    "xyz, lm": {"method": "lm"},
    "xyz, soft_l1": {"loss": "soft_l1", "f_scale": 0.05},
}


def main(folder: Path, method: str) -> None:
    """Print what the method finds as JSON."""
    table = json.loads((folder / "robot.json").read_text())
    calib, valid = (np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1) for name in ("calib", "valid"))
    rows = np.array(table["alpha_a_theta_d"]) * [1, 1e3, 1, 1e3]
    robot = Robot.from_parameters(rows.ravel())
    robot.tool.position = 1e3 * np.array(table["tool"])
    tool = [True] * 3 + [False] * 3
    handler = OptimizationHandler(robot, kinematic_chain_mask=True, tool_mask=tool)
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
    else:
        found = least_squares(coordinates, x0, **SETTINGS[method])
    seconds = time.perf_counter() - start
    handler.apply_optimization_vector(found.x)
    change = np.abs(found.x - x0)
    angles = np.append(np.tile([True, False, True, False], len(rows)), [False] * 3)
    print(
        json.dumps(
            {
                "seconds": seconds,
                "largest_mm": change[~angles].max(),
                "largest_mrad": 1e3 * change[angles].max(),
                "predicted_mm": positions(valid[:, 3:]).tolist(),
                "versions": f"pybotics {version('pybotics')}, SciPy {version('scipy')}, NumPy {version('numpy')}",
            }
        )
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
