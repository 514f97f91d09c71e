"""Closed forms of registration: point sets, hand and eye (AX = ZB)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError

Place = Sequence[float] | Array
"""A frame's six numbers, or a point's three."""
NOMINAL_ERROR, TOOL_ERROR = 5e-3, 0.1
"""What a nominal robot (also in angle, at a metre) and a roughly measured reflector may be wrong by [m, rad]."""


def register(source: Array, target: Array) -> Array:
    """Return the rigid motion T (4, 4) that minimizes sum |R source_i + t - target_i|^2 (paper, Eq. 17).

    The rotation is proper (det R = 1), by singular value decomposition (Umeyama 1991, IEEE PAMI 13:376).

    ``source`` and ``target`` are N points (N, 3) [m]. Refused are fewer than three points, points that coincide, and
    points on a line: their rotation is arbitrary.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    >>> seen = np.array([[2, 0, 0], [2, 1, 0], [1, 0, 0]])  # turned by 90 degrees about z, moved by 2 along x
    >>> ro.problem.register(corners, seen).round(9)[:3] + 0.0
    array([[ 0., -1.,  0.,  2.],
           [ 1.,  0.,  0.,  0.],
           [ 0.,  0.,  1.,  0.]])
    """
    source, target = np.asarray(source, dtype=float), np.asarray(target, dtype=float)
    if source.shape != target.shape or source.shape[1:] != (3,):
        raise InputError("points", f"shapes {source.shape}, {target.shape}", "N points, N points")
    if len(source) < 3:
        raise InputError("points", f"{len(source)}", "three or more, not on a line")
    for points, what in ((source, "source"), (target, "target")):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[1] <= 1e-6 * spread[0]:
            raise InputError(f"{what} points", "points on a line, or all in one place", "points that span a plane")
    p, r = source.mean(axis=0), target.mean(axis=0)
    R = proper((target - r).T @ (source - p))
    return rigid(R, r - R @ p)


def hand_eye(flange: Array, measured: Array) -> tuple[Array, Array]:
    """Return base Z and tool X, (4, 4) each, with measured_i = Z flange_i X: the problem A X = Z B, A = flange^-1.

    Rotations by the Kronecker product and one singular value decomposition (Shah 2013, J. Mechanisms and
    Robotics 5:031007), translations by linear least squares, of the least norm.

    ``flange`` and ``measured`` are (N, 4, 4) transforms of the flange in the base, and of the tool in the instrument's
    frame. Refused are fewer than three poses, and rotations about one axis only.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> arm = ro.load("paper_arm").problem
    >>> flange = ro.robot.forward_kinematics(arm.robot, arm.data.q)
    >>> base, tool = np.eye(4), np.eye(4)
    >>> base[:3, 3], tool[:3, 3] = [2.0, 0.0, 0.5], [0.0, 0.02, 0.06]
    >>> Z, X = ro.problem.hand_eye(flange, base @ flange @ tool)
    >>> bool(np.abs(Z - base).max() < 1e-9), bool(np.abs(X - tool).max() < 1e-9)
    (True, True)
    """
    N = len(flange)
    if N < 3:
        raise InputError("poses", f"{N}", "three or more")
    RA, RB = flange[:, :3, :3], measured[:, :3, :3]
    # R_B = R_Z R_A R_X, so that sum_i R_B kron R_A maps vec(R_X') to N vec(R_Z)
    K = np.einsum("nij,nkl->ikjl", RB, RA).reshape(9, 9)
    U, s, Vt = np.linalg.svd(K)
    if s[1] > (1 - 1e-6) * s[0]:
        raise InputError("poses", "rotations about one axis only", "poses turned about two axes")
    V, W = U[:, 0].reshape(3, 3), Vt[0].reshape(3, 3)  # R_Z and R_X', up to one common factor
    sign = np.sign(np.linalg.det(V))
    Z, X = proper(sign * V), proper(sign * W).T
    A = np.concatenate([np.hstack([Z @ R, np.eye(3)]) for R in RA])
    b = measured[:, :3, 3] - flange[:, :3, 3] @ Z.T
    t: Any = np.linalg.lstsq(A, b.ravel(), rcond=1e-6)[0]
    return rigid(Z, t[3:]), rigid(X, t[:3])


def proper(M: Array) -> Array:
    """Return the rotations nearest to M (..., 3, 3)."""
    U, _, Vt = np.linalg.svd(M)
    handed = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    U = U.copy()
    U[..., :, 2] *= handed[..., None]
    return U @ Vt


def transforms(y: Array) -> Array:
    """Return the transforms (N, 4, 4) of measured poses (N, 7): x, y, z [m] and unit quaternion, w first."""
    return rigid(scipy.spatial.transform.Rotation.from_quat(y[:, [4, 5, 6, 3]]).as_matrix(), y[:, :3])


def rigid(R: Array, t: Array) -> Array:
    """Return the transforms (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    T = np.zeros((*np.broadcast_shapes(R.shape[:-2], t.shape[:-1]), 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = t
    T[..., 3, 3] = 1.0
    return T


def transformed(T: Array, points: Array) -> Array:
    """Return points (..., 3) where transforms (..., 4, 4) put them."""
    return np.asarray((T[..., :3, :3] @ points[..., None])[..., 0] + T[..., :3, 3])
