"""Calibrate one benchmark problem with SciPy alone: least squares on a vectorised forward model, mm and rad."""

from common import answer  # first: it starts the clock

import json
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation


def positions(x: np.ndarray, q: np.ndarray, parallel: list) -> np.ndarray:
    """Return the tool's positions (N, 3) for alpha, a, theta, d of every joint, base, tool, Hayati's angles."""
    dof = q.shape[1]
    alpha, a, theta, d = x[: 4 * dof].reshape(-1, 4).T
    base, tool = x[4 * dof : 4 * dof + 6], x[4 * dof + 6 : 4 * dof + 9]
    beta = np.zeros(dof)
    beta[parallel] = x[4 * dof + 9 :]
    R = np.broadcast_to(Rotation.from_euler("xyz", base[3:]).as_matrix(), (len(q), 3, 3))
    p = np.broadcast_to(base[:3], (len(q), 3))
    for i in range(dof):
        ca, sa = np.cos(alpha[i]), np.sin(alpha[i])
        c, s = np.cos(q[:, i] + theta[i]), np.sin(q[:, i] + theta[i])
        link = np.empty((len(q), 3, 3))
        link[:, 0, 0], link[:, 0, 1], link[:, 0, 2] = c, -s, 0
        link[:, 1, 0], link[:, 1, 1], link[:, 1, 2] = s * ca, c * ca, -sa
        link[:, 2, 0], link[:, 2, 1], link[:, 2, 2] = s * sa, c * sa, ca
        p = p + R @ np.array([a[i], -sa * d[i], ca * d[i]])
        R = R @ link @ Rotation.from_euler("y", beta[i]).as_matrix()
    return p + R @ tool


def run(folder: Path, method: str) -> dict:
    """Return what the method finds."""
    table = json.loads((folder / "robot.json").read_text())
    calib, valid = (np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1) for name in ("calib", "valid"))
    base = np.array(table["base"]) * [1e3, 1e3, 1e3, 1, 1, 1]
    rows = np.array(table["alpha_a_theta_d"]) * [1, 1e3, 1, 1e3]
    parallel = [int(name[4:]) - 1 for name in table["parallel"]]
    x0 = np.concatenate([rows.ravel(), base, 1e3 * np.array(table["tool"]), np.zeros(len(parallel))])
    q, p = calib[:, 3:], 1e3 * calib[:, :3]
    settings = {}
    if method == "soft_l1":
        settings = {"loss": "soft_l1", "f_scale": 1e3 * table["noise"]}
    elif p.size >= len(x0):
        settings = {"method": "lm"}  # it refuses fewer equations than parameters; SciPy's default does not
    start = time.perf_counter()
    found = least_squares(lambda x: (positions(x, q, parallel) - p).ravel(), x0, **settings)
    return {
        "seconds": time.perf_counter() - start,
        "predicted_mm": positions(found.x, valid[:, 3:], parallel).tolist(),
    }


if __name__ == "__main__":
    answer(run, {"SciPy": version("scipy"), "NumPy": version("numpy")})
