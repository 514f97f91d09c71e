"""Points on a plane of unknown pose."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.measurements.measurement import Measurement, origin
from rpim_opt.robot.kinematics import FRAME_DIMENSION, roll_pitch_yaw


def plane_start(points: Array, y: Array) -> Mapping[str, float]:
    """Fit a plane: its normal is the direction in which the points spread least."""
    centre = points.mean(axis=0)
    _, s, Vt = np.linalg.svd(points - centre)
    if len(points) < 3 or s[1] < 1e-6 * s[0]:
        raise InputError("data", f"{len(points)} points that do not determine a plane", "three or more, not on a line")
    x = Vt[0]
    n = Vt[2] * np.copysign(1.0, Vt[2, np.argmax(np.abs(Vt[2]))])  # towards its largest coordinate
    turn = roll_pitch_yaw(np.column_stack([x, np.cross(n, x), n]))
    return dict(zip([f"plane_{c}" for c in FRAME_DIMENSION], (*centre, *turn), strict=True))


plane = Measurement(
    "plane",
    model=lambda T, plane: ca.dot(plane[:3, 2], origin(T) - plane[:3, 3]),
    columns={},
    components={"distance": "length"},
    parameters={f"plane_{c}": d for c, d in FRAME_DIMENSION.items()},
    frames=("plane",),
    start=plane_start,
)
"""A point on a plane, stated as a frame whose x and y axes span it: r = -n'(p - o) with its z axis n and origin o."""

TYPES = (plane,)
