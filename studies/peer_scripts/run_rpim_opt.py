"""Calibrate one benchmark problem with rpim_opt; called by ``studies/peers.py`` like a peer.

``command`` is what a user types: ``rpim-opt new`` with the URDF and the table, ``rpim-opt calibrate``. The others are
scripts on the same problem: ``script`` states the noise and learns the rest, ``reml`` and ``robust`` have one weight.
"""

from common import answer  # first: it starts the clock

import contextlib
import json
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np

import rpim_opt as ro
from rpim_opt.cli import main as command_line

BETWEEN = {"script": ("tikhonov", None), "reml": ("tikhonov", "reml"), "robust": ("robust", "reml")}


def commanded(folder: Path) -> ro.calibration.Calibration:
    """Return what the two commands find."""
    table = folder / "measured.csv"
    lines = (folder / "calib.csv").read_text().splitlines()
    dof = lines[0].count("joint_")
    names = ["x_m", "y_m", "z_m", *(f"joint_{i + 1}" for i in range(dof))]
    table.write_text("\n".join([",".join(names), *lines[1:]]) + "\n")
    cell = folder / "cell"
    new = ["new", str(cell), "--robot", str(folder / "robot.urdf"), "--data", str(table), "--units", "rad,m"]
    calibrate = ["calibrate", str(cell), "--out", str(folder / "out")]
    with contextlib.redirect_stdout(sys.stderr):
        for arguments in (new, calibrate):
            sys.argv = ["rpim-opt", *arguments]
            try:
                command_line()
            except SystemExit as end:
                if end.code not in (0, None):
                    raise
    return ro.load_result(folder / "out")


def scripted(folder: Path, method: str) -> ro.calibration.Calibration:
    """Return what a script finds on the same arm, in modified DH."""
    table = json.loads((folder / "robot.json").read_text())
    calib = np.loadtxt(folder / "calib.csv", delimiter=",", skiprows=1)
    rows = np.array(table["alpha_a_theta_d"])
    robot = ro.robot.Robot("arm", np.column_stack([rows, np.zeros(len(rows))]))
    scales = {"length_mm": 1.0, "angle_mrad": 1.0, "tool_mm": 10.0, "base_mm": 100.0, "base_mrad": 100.0}
    parameters = ro.robot.model_parameters(robot, base=table["base"], tools={"": [*table["tool"], 0, 0, 0]})
    identified = ["alpha?", "a?", "theta?", "d?", *table["parallel"], "base_*", "tool_[xyz]"]
    parameters = parameters.scaled(scales).identify(identified)
    data = ro.Dataset.of(calib[:, 3:], calib[:, :3], table["noise"])
    formulation, weight = BETWEEN[method]
    rule = weight
    if weight is not None:
        rule = getattr(ro, weight)
    return ro.calibrate(ro.CalibrationProblem(robot, parameters, data), getattr(ro, formulation), rule)


def run(folder: Path, method: str) -> dict:
    """Return what the method finds."""
    valid = np.loadtxt(folder / "valid.csv", delimiter=",", skiprows=1)
    start = time.perf_counter()
    if method == "command":
        found = commanded(folder)
    else:
        found = scripted(folder, method)
    seconds = time.perf_counter() - start
    of = np.array(found.problem.parameters.free.dimensions)
    return {
        "seconds": seconds,
        "largest_mm": 1e3 * np.abs(found.x[of == "length"]).max(),
        "largest_mrad": 1e3 * np.abs(found.x[of == "angle"]).max(),
        "predicted_mm": (1e3 * found.predict(valid[:, 3:]).position).tolist(),
    }


if __name__ == "__main__":
    answer(run, {"rpim_opt": version("rpim-opt"), "NumPy": version("numpy")})
