"""Calibrate one benchmark problem with figaroh; called by ``studies/peers.py`` in the peer's own environment.

As documented: a class with the cost function of the package's guide, a configuration file with the method of
estimation, data as CSV, the tool's frame unknown. m and rad. ``threshold`` sets its limit for outliers by hand.
"""

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

THRESHOLDS = {"structural, threshold": 1.5e-3}


class Calibration(BaseCalibration):
    """The benchmark's arm."""

    def cost_function(self, var: np.ndarray) -> np.ndarray:
        """Return measured minus modelled, as the package weighs it."""
        modelled = calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
        return self.apply_measurement_weighting(self._compute_logmap_residuals(self.PEE_measured, modelled))


def main(folder: Path, method: str) -> None:
    """Print what the method finds as JSON."""
    name = method.partition(",")[0]
    configuration = {
        "robot": {"name": "rpim6"},
        "tasks": {
            "calibration": {
                "enabled": True,
                "type": "kinematic_calibration",
                "kinematics": {"base_frame": "universe", "tool_frame": "smr"},
                "parameters": {
                    "calibration_level": "full_params",
                    "outlier_threshold": THRESHOLDS.get(method, 0.05),
                    "estimation": {"method": name},
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
    path = folder / f"{method}.yaml"
    path.write_text(yaml.safe_dump(configuration))
    valid = np.loadtxt(folder / "valid.csv", delimiter=",", skiprows=1)
    logging.disable(logging.CRITICAL)
    with contextlib.redirect_stdout(sys.stderr):
        robot = load_robot(str((folder / "robot.urdf").resolve()), load_by_urdf=True)
        start = time.perf_counter()
        calibration = Calibration(robot, str(path))
        calibration.calib_config["known_baseframe"] = True
        calibration.calib_config["known_tipframe"] = False
        calibration.initialize()
        found = calibration.solve(enable_logging=False)
        seconds = time.perf_counter() - start
        configuration = dict(calibration.calib_config, NbSample=len(valid))
        q = np.array([pin.neutral(calibration.model)] * len(valid))
        q[:, calibration.calib_config["config_idx"]] = valid[:, 3:]
        predicted = calc_updated_fkm(calibration.model, calibration.data, found.x, q, configuration)
    names = calibration.calib_config["param_name"]
    angle = np.array(["phi" in n or "offset" in n for n in names])
    change = np.abs(found.x)
    print(
        json.dumps(
            {
                "seconds": seconds,
                "largest_mm": 1e3 * change[~angle].max(),
                "largest_mrad": 1e3 * change[angle].max(),
                "predicted_mm": (1e3 * np.reshape(predicted, (3, -1)).T).tolist(),
                "versions": f"figaroh {version('figaroh')}, Pinocchio {pin.__version__}, NumPy {version('numpy')}",
            }
        )
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
