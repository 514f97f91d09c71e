"""Distances between two points of the robot, to an anchor, from a plane and from a sphere."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.measurements.measurement import Measurement, origin
from rpim_opt.robot.kinematics import FRAME_DIMENSION, roll_pitch_yaw

DISTANCE = {"distance": "length"}


def _centred(points: Array, y: Array, what: str) -> tuple[Array, Array]:
    """Return the points' mean m (3,), and the unknowns of |p - m - c| = y - l or R: c (3,), l if measured, R^2 - |c|^2.

    The squared equations are linear in them (for an anchor, R = l). InputError if the points do not determine them.
    """
    middle = points.mean(axis=0)
    p = points - middle
    A = np.column_stack([2 * p, -2 * y, np.ones(len(p))])
    x, _, rank, s = np.linalg.lstsq(A, np.sum(p**2, axis=1) - np.sum(y**2, axis=1), rcond=None)
    if rank < A.shape[1] or s[-1] < 1e-7 * s[0]:
        raise InputError("data", f"{len(A)} points that do not determine {what}", "more, or better spread, points")
    return middle, np.asarray(x, dtype=float)


def anchor_start(points: Array, y: Array) -> Mapping[str, float]:
    """Locate an anchor from cable lengths."""
    middle, unknown = _centred(points, y, "an anchor and a zero length")
    return dict(zip(ANCHOR, (*middle + unknown[:3], unknown[3]), strict=True))


def sphere_start(points: Array, y: Array) -> Mapping[str, float]:
    """Fit a sphere."""
    middle, unknown = _centred(points, y[:, :0], "a sphere")
    c = unknown[:3]
    return dict(zip(SPHERE, (*middle + c, float(np.sqrt(unknown[3] + c @ c))), strict=True))


def plane_start(points: Array, y: Array) -> Mapping[str, float]:
    """Fit a plane: its normal is the direction in which the points spread least."""
    centre = points.mean(axis=0)
    _, s, Vt = np.linalg.svd(points - centre)
    if len(points) < 3 or s[1] < 1e-6 * s[0]:
        raise InputError("data", f"{len(points)} points that do not determine a plane", "three or more, not on a line")
    x = Vt[0]
    n = Vt[2] * np.copysign(1.0, Vt[2, np.argmax(np.abs(Vt[2]))])  # towards its largest coordinate
    turn = roll_pitch_yaw(np.column_stack([x, np.cross(n, x), n]))
    return dict(zip(PLANE, (*centre, *turn), strict=True))


distance = Measurement("distance", lambda T1, T2: ca.norm_2(origin(T2) - origin(T1)), columns=DISTANCE, points=2)
"""Distance between two points, of two configurations or two reflectors (paper, Eq. 21; ballbar): r = y - |p2 - p1|."""

ANCHOR: dict[str, str] = dict.fromkeys(("anchor_x", "anchor_y", "anchor_z", "length_0"), "length")
cable = Measurement(
    "cable",
    model=lambda T, anchor_x, anchor_y, anchor_z, length_0: (
        ca.norm_2(origin(T) - ca.vertcat(anchor_x, anchor_y, anchor_z)) + length_0
    ),
    columns=DISTANCE,
    parameters=ANCHOR,
    start=anchor_start,
)
"""Distance to a fixed anchor a (draw-wire, cable): r = y - |p - a| - l, with l the reading at zero distance."""

PLANE = {f"plane_{c}": d for c, d in FRAME_DIMENSION.items()}
plane = Measurement(
    "plane",
    model=lambda T, plane: ca.dot(plane[:3, 2], origin(T) - plane[:3, 3]),
    columns={},
    components=DISTANCE,
    parameters=PLANE,
    frames=("plane",),
    start=plane_start,
)
"""A point on a plane given by a frame with origin o and z axis n, the normal: r = -n'(p - o)."""

SPHERE: dict[str, str] = dict.fromkeys(("sphere_x", "sphere_y", "sphere_z", "sphere_r"), "length")
sphere = Measurement(
    "sphere",
    model=lambda T, sphere_x, sphere_y, sphere_z, sphere_r: (
        ca.norm_2(origin(T) - ca.vertcat(sphere_x, sphere_y, sphere_z)) - sphere_r
    ),
    columns={},
    components=DISTANCE,
    parameters=SPHERE,
    start=sphere_start,
)
"""A point on a sphere of radius R about c: r = R - |p - c|."""

TYPES = (cable, distance, plane, sphere)
