"""Calibrate one benchmark problem with robotkinecal; called by ``studies/peers.py`` in the peer's own environment.

The package has one way: iterated least squares on screw axes, m and rad; ``documented`` is its README's example with
positions. A second limit of iterations or another step changes nothing, so there are no best settings apart.
"""

from common import answer  # first: it starts the clock

import contextlib
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import roboticstoolbox as rtb
from robotkinecal import SerialRobotKineCal


def run(folder: Path, method: str) -> dict:
    """Return what the method finds."""
    calib, valid = (np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1) for name in ("calib", "valid"))
    with contextlib.redirect_stdout(sys.stderr):
        robot = rtb.ERobot.URDF(str((folder / "robot.urdf").resolve()))
        start = time.perf_counter()
        calibration = SerialRobotKineCal(robot, ee_name="smr")
        calibration.set_observations(list(calib[:, 3:]), list(calib[:, :3]))
        calibration.solve()
        seconds = time.perf_counter() - start
        last = calibration.N_JOINTS + 1
        predicted = [1e3 * calibration.forward_kinematics(last, row).t for row in valid[:, 3:]]
    return {"seconds": seconds, "predicted_mm": np.array(predicted).tolist()}


if __name__ == "__main__":
    packages = {"robotkinecal": "robotkinecal", "roboticstoolbox": "roboticstoolbox-python", "NumPy": "numpy"}
    answer(run, {label: version(package) for label, package in packages.items()})
