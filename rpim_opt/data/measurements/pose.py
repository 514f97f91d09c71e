"""Position of a reflector and pose of a target in the instrument's frame: columns, residual and noise."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import RowError
from rpim_opt.data.measurements.measurement import XYZ, Measurement, origin


def from_elevation(polar: Array) -> Array:
    """Return positions (N, 3) from azimuth, counterclockwise from x, elevation and distance (N, 3) [rad, rad, m]."""
    azimuth, elevation, distance = polar.T
    level = distance * np.cos(elevation)
    return np.column_stack([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)])


def from_zenith(polar: Array) -> Array:
    """Return positions (N, 3) from azimuth, angle from the vertical axis, and distance."""
    return from_elevation(polar * [1, -1, 1] + [0, np.pi / 2, 0])


_REST = {"distance": "length"}
position = Measurement(
    "position",
    origin,
    XYZ,
    noise={"position": "length"},
    forms=(
        ({"azimuth": "angle", "elevation": "angle", **_REST}, from_elevation),
        ({"azimuth": "angle", "zenith": "angle", **_REST}, from_zenith),
        # a total station's horizontal circle counts clockwise
        ({"hz": "angle", "zenith": "angle", **_REST}, lambda polar: from_zenith(polar * [-1, 1, 1])),
    ),
    registers=True,
)
"""A reflector's position in the instrument's frame: r = y - p."""


def quaternion(T: Any) -> Any:
    """Return the unit quaternion (w, x, y, z), up to its sign, of a transform's rotation; regular everywhere.

    The symmetric matrix 4 q q' is linear in the entries of R; its column with the largest diagonal entry, normalized,
    is the quaternion; before, its length is at least 2 (Shepperd 1978, J. Guidance and Control 1:223).
    """
    R = T[:3, :3]
    t = R[0, 0] + R[1, 1] + R[2, 2]
    x = R[2, 1] - R[1, 2]
    y = R[0, 2] - R[2, 0]
    z = R[1, 0] - R[0, 1]
    xy = R[0, 1] + R[1, 0]
    xz = R[0, 2] + R[2, 0]
    yz = R[1, 2] + R[2, 1]
    columns = [
        ca.vertcat(1 + t, x, y, z),
        ca.vertcat(x, 1 + 2 * R[0, 0] - t, xy, xz),
        ca.vertcat(y, xy, 1 + 2 * R[1, 1] - t, yz),
        ca.vertcat(z, xz, yz, 1 + 2 * R[2, 2] - t),
    ]
    best = columns[0]
    size = columns[0][0]
    for i in (1, 2, 3):
        larger = columns[i][i] > size
        best = ca.if_else(larger, columns[i], best)
        size = ca.if_else(larger, columns[i][i], size)
    return best / ca.sqrt(ca.sumsqr(best))


def rotation_between(p: Any, q: Any) -> Any:
    """Return the rotation vector [rad] of R(p) R(q)' for unit quaternions: the exact logarithm up to pi."""
    w = p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3]
    x = -p[0] * q[1] + p[1] * q[0] - p[2] * q[3] + p[3] * q[2]
    y = -p[0] * q[2] + p[1] * q[3] + p[2] * q[0] - p[3] * q[1]
    z = -p[0] * q[3] - p[1] * q[2] + p[2] * q[1] + p[3] * q[0]
    sign = ca.if_else(w < 0, -1, 1)
    w = sign * w
    v = sign * ca.vertcat(x, y, z)
    n2 = ca.sumsqr(v)
    small = n2 < 1e-12
    n = ca.sqrt(ca.if_else(small, 1, n2))  # the branch not taken must have derivatives too
    return ca.if_else(small, 2 / w * (1 - n2 / (3 * w**2)), 2 * ca.atan2(n, w) / n) * v


def turned(y: Array, e: Array) -> Array:
    """Move poses (N, 7) by e (N, 6), the positions and then the rotations about the instrument's axes."""
    rotations = scipy.spatial.transform.Rotation
    turned_by = rotations.from_rotvec(e[:, 3:]) * rotations.from_quat(y[:, [4, 5, 6, 3]])
    return _posed(y[:, :3] + e[:, :3], turned_by)


def _posed(y: Array, rotation: scipy.spatial.transform.Rotation) -> Array:
    """Return poses (N, 7) of positions, the first columns of y, and rotations."""
    return np.hstack([y[:, :3], rotation.as_quat()[:, [3, 0, 1, 2]]])


def unit_quaternions(y: Array) -> Array:
    """Return poses (N, 7) with normalized quaternions; refuse other norms."""
    norm = np.linalg.norm(y[:, 3:], axis=1)
    for row in np.flatnonzero(np.abs(norm - 1) > 1e-3).tolist():
        raise RowError(row, f"a quaternion of norm {norm[row]:.4g}", "norm 1 within 0.001, w first")
    return np.hstack([y[:, :3], y[:, 3:] / norm[:, None]])


def from_matrices(y: Array) -> Array:
    """Return poses (N, 7) from matrices, row by row (N, 12); refuse matrices that are not rotations."""
    R = y[:, 3:].reshape(-1, 3, 3)
    off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    for row in np.flatnonzero((off > 1e-3) | (np.linalg.det(R) < 0)).tolist():
        found = f"a matrix that violates R R' = I by {off[row]:.2g}, determinant {np.linalg.det(R[row]):.3g}"
        raise RowError(row, found, "a rotation within 0.001, determinant 1")
    return _posed(y, scipy.spatial.transform.Rotation.from_matrix(R))


_TURN = {"rx": "angle", "ry": "angle", "rz": "angle"}
_MATRIX = {f"r{i}{j}": "" for i in (1, 2, 3) for j in (1, 2, 3)}

pose = Measurement(
    "pose",
    model=lambda T: ca.vertcat(origin(T), quaternion(T)),
    columns=XYZ | {"qw": "", "qx": "", "qy": "", "qz": ""},
    components=XYZ | _TURN,
    noise={"position": "length", "orientation": "angle"},
    minus=lambda y, m: ca.vertcat(y[:3] - m[:3], rotation_between(y[3:], m[3:])),
    plus=turned,
    forms=(
        (XYZ | _TURN, lambda y: _posed(y, scipy.spatial.transform.Rotation.from_euler("xyz", y[:, 3:]))),
        (XYZ | _MATRIX, from_matrices),
    ),
    prepare=unit_quaternions,
    parts=(position,),
    registers=True,
    turning=True,
)
"""Position and orientation in the instrument's frame: r = (y - p, log(R_measured R')), about the instrument's axes."""

TYPES = (pose, position)
