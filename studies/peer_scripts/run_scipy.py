"""Calibrate one benchmark problem with SciPy alone: Levenberg-Marquardt on a vectorised forward model, mm and rad."""

import json
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

SETTINGS = {"lm": {"method": "lm"}, "soft_l1": {"loss": "soft_l1", "f_scale": 0.05}}


def positions(x: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the tool's positions (N, 3) for parameters alpha, a, theta, d of every joint and the tool's x, y, z."""
    alpha, a, theta, d = x[:-3].reshape(-1, 4).T
    R, p = np.broadcast_to(np.eye(3), (len(q), 3, 3)), np.zeros((len(q), 3))
    for i in range(len(alpha)):
        ca, sa = np.cos(alpha[i]), np.sin(alpha[i])
        c, s = np.cos(q[:, i] + theta[i]), np.sin(q[:, i] + theta[i])
        link = np.empty((len(q), 3, 3))
        link[:, 0, 0], link[:, 0, 1], link[:, 0, 2] = c, -s, 0
        link[:, 1, 0], link[:, 1, 1], link[:, 1, 2] = s * ca, c * ca, -sa
        link[:, 2, 0], link[:, 2, 1], link[:, 2, 2] = s * sa, c * sa, ca
        p = p + R @ np.array([a[i], -sa * d[i], ca * d[i]])
        R = R @ link
    return p + R @ x[-3:]


def main(folder: Path, method: str) -> None:
    """Print what the method finds as JSON."""
    table = json.loads((folder / "robot.json").read_text())
    calib, valid = (np.loadtxt(folder / f"{name}.csv", delimiter=",", skiprows=1) for name in ("calib", "valid"))
    x0 = np.append(np.array(table["alpha_a_theta_d"]) * [1, 1e3, 1, 1e3], 1e3 * np.array(table["tool"]))
    q, p = calib[:, 3:], 1e3 * calib[:, :3]
    start = time.perf_counter()
    found = least_squares(lambda x: (positions(x, q) - p).ravel(), x0, **SETTINGS[method])
    seconds = time.perf_counter() - start
    change = np.abs(found.x - x0)
    angles = np.append(np.tile([True, False, True, False], (len(x0) - 3) // 4), [False] * 3)
    print(
        json.dumps(
            {
                "seconds": seconds,
                "largest_mm": change[~angles].max(),
                "largest_mrad": 1e3 * change[angles].max(),
                "predicted_mm": positions(found.x, valid[:, 3:]).tolist(),
                "versions": f"SciPy {version('scipy')}, NumPy {version('numpy')}",
            }
        )
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
