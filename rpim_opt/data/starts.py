"""Where anchors, planes and spheres are, in closed form: what an iteration starts from."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.robot.kinematics import FRAME_DIMENSION, roll_pitch_yaw


def _solve(A: Array, b: Array, what: str) -> Array:
    """Return the least-squares solution; refuse a degenerate system."""
    x, _, rank, s = np.linalg.lstsq(A, b, rcond=None)
    if rank < A.shape[1] or s[-1] < 1e-7 * s[0]:
        raise InputError("data", f"{len(A)} points that do not determine {what}", "more, or better spread, points")
    return np.asarray(x, dtype=float)


def anchor_start(points: Array, y: Array) -> Mapping[str, float]:
    """Locate an anchor from cable lengths: |p - a| + l = y is linear in a, l and |a|^2 - l^2 once squared."""
    centre = points.mean(axis=0)
    p = points - centre
    length = y[:, 0]
    A = np.column_stack([2 * p, -2 * length, -np.ones(len(p))])
    a = _solve(A, np.sum(p**2, axis=1) - length**2, "an anchor and a zero length")
    place = a[:3] + centre
    return {"anchor_x": place[0], "anchor_y": place[1], "anchor_z": place[2], "length_0": a[3]}


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


def sphere_start(points: Array, y: Array) -> Mapping[str, float]:
    """Fit a sphere: |p - c|^2 = r^2 is linear in c and r^2 - |c|^2."""
    centre = points.mean(axis=0)
    p = points - centre
    c = _solve(np.column_stack([2 * p, np.ones(len(p))]), np.sum(p**2, axis=1), "a sphere")
    place = c[:3] + centre
    radius = float(np.sqrt(c[3] + c[:3] @ c[:3]))
    return {"sphere_x": place[0], "sphere_y": place[1], "sphere_z": place[2], "sphere_r": radius}
