"""Calibrate one benchmark problem with rpim_opt; called by ``studies/peers.py`` like a peer."""

import json
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np

import rpim_opt as ro

SPREAD = {"length_mm": 0.3, "angle_mrad": 1.0, "tool_mm": 0.5}
GENERIC = {"length_mm": 1.0, "angle_mrad": 1.0, "tool_mm": 1.0}
NOISE = 5e-5  # [m], declared
METHODS = {
    "learned": (GENERIC, "tikhonov", None),
    "learned, model auto": (GENERIC, "tikhonov", None),
    "Tikhonov": (GENERIC, "tikhonov", "reml"),
    "Tikhonov, spread declared": (SPREAD, "tikhonov", 1.0),
    "Tikhonov, spread declared, REML": (SPREAD, "tikhonov", "reml"),
    "robust": (GENERIC, "robust", "reml"),
    "robust, spread declared": (SPREAD, "robust", "reml"),
    "robust, refitted": (GENERIC, "robust", "reml"),
}


def main(folder: Path, method: str) -> None:
    """Print what the method finds as JSON."""
    table = json.loads((folder / "robot.json").read_text())
    calib, valid = (np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1) for name in ("calib", "valid"))
    scales, formulation, weight = METHODS[method]
    calibrate, problem_of, form = ro.calibrate, ro.CalibrationProblem, getattr(ro, formulation)  # imports them
    start = time.perf_counter()
    rows = np.array(table["alpha_a_theta_d"])
    robot = ro.robot.Robot("benchmark", np.column_stack([rows, np.zeros(len(rows))]))
    parameters = ro.robot.model_parameters(robot, tools={"": [*table["tool"], 0, 0, 0]}).scaled(scales)
    parameters = parameters.identify(["alpha?", "a?", "theta?", "d?", "tool_[xyz]"])
    problem = problem_of(robot, parameters, ro.Dataset.of(calib[:, 3:], calib[:, :3], NOISE))
    rule = getattr(ro, weight) if isinstance(weight, str) else weight
    model = "geometry"
    if method.endswith("model auto"):
        model = "auto"
    found = calibrate(problem, form, rule, model=model)
    if method.endswith("refitted"):
        found = calibrate(found.without_flagged().problem, ro.tikhonov, ro.reml)
    seconds = time.perf_counter() - start
    of = np.array(found.problem.parameters.free.dimensions)
    predicted = found.problem.on(ro.Dataset.of(valid[:, 3:], valid[:, :3], NOISE)).modelled(found.x)[0]
    print(
        json.dumps(
            {
                "seconds": seconds,
                "largest_mm": 1e3 * np.abs(found.x[of == "length"]).max(),
                "largest_mrad": 1e3 * np.abs(found.x[of == "angle"]).max(),
                "predicted_mm": (1e3 * predicted).tolist(),
                "versions": f"rpim_opt {version('rpim-opt')}, NumPy {version('numpy')}",
            }
        )
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
