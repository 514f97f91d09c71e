"""Calibrate one benchmark problem with figaroh; called by ``studies/peers.py`` in the peer's own environment.

As documented: a class with the cost function of the package's guide, a configuration file with the method of
estimation, data as CSV, frames of base and tool unknown. m and rad. ``map`` is told the noise, ``threshold`` sets its
limit for outliers by hand.
"""

from common import answer  # first: it starts the clock

import contextlib
import json
import logging
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pinocchio as pin
import yaml
from figaroh.calibration.base_calibration import BaseCalibration
from figaroh.calibration.calibration_tools import calc_updated_fkm
from figaroh.tools.load_robot import load_robot

THRESHOLD = 1.5e-3


class Calibration(BaseCalibration):
    """The benchmark's arm."""

    def cost_function(self, var: np.ndarray) -> np.ndarray:
        """Return measured minus modelled, as the package weighs it."""
        modelled = calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
        return self.apply_measurement_weighting(self._compute_logmap_residuals(self.PEE_measured, modelled))


def configured(folder: Path, method: str) -> dict:
    """Return the package's configuration."""
    name = method.partition(",")[0]
    estimation = {"method": name}
    if name == "map":
        estimation["noise_std"] = json.loads((folder / "robot.json").read_text())["noise"]
    threshold = 0.05
    if method.endswith("threshold"):
        threshold = THRESHOLD
    return {
        "robot": {"name": "arm"},
        "tasks": {
            "calibration": {
                "enabled": True,
                "type": "kinematic_calibration",
                "kinematics": {"base_frame": "universe", "tool_frame": "smr"},
                "parameters": {
                    "calibration_level": "full_params",
                    "outlier_threshold": threshold,
                    "estimation": estimation,
                },
                "measurements": {
                    "markers": [{"measurable_dof": [True, True, True, False, False, False]}],
                    "poses": {"base_pose": None, "tool_pose": None},
                },
                "data": {
                    "number_of_samples": sum(1 for _ in (folder / "calib.csv").open()) - 1,
                    "source_file": str(folder / "calib.csv"),
                },
            }
        },
    }


def run(folder: Path, method: str) -> dict:
    """Return what the method finds."""
    configuration = configured(folder, method)
    path = folder / f"{method}.yaml"
    path.write_text(yaml.safe_dump(configuration))
    valid = np.loadtxt(folder / "valid.csv", delimiter=",", skiprows=1)
    logging.disable(logging.CRITICAL)
    with contextlib.redirect_stdout(sys.stderr):
        robot = load_robot(str((folder / "robot.urdf").resolve()), load_by_urdf=True)
        start = time.perf_counter()
        calibration = Calibration(robot, str(path))
        calibration.calib_config["known_baseframe"] = False
        calibration.calib_config["known_tipframe"] = False
        calibration.initialize()
        found = calibration.solve(enable_logging=False)
        seconds = time.perf_counter() - start
        configuration = dict(calibration.calib_config, NbSample=len(valid))
        q = np.array([pin.neutral(calibration.model)] * len(valid))
        q[:, calibration.calib_config["config_idx"]] = valid[:, 3:]
        predicted = calc_updated_fkm(calibration.model, calibration.data, found.x, q, configuration)
    return {"seconds": seconds, "predicted_mm": (1e3 * np.reshape(predicted, (3, -1)).T).tolist()}


if __name__ == "__main__":
    answer(run, {"figaroh": version("figaroh"), "Pinocchio": pin.__version__, "NumPy": version("numpy")})
