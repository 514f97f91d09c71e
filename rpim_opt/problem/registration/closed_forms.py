"""Registration of point sets in closed form, and transforms."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError

Place = Sequence[float] | Array  # a frame's six numbers, or a point's three
NOMINAL_ERROR, TOOL_ERROR = 5e-3, 0.1
"""Assumed errors of a nominal robot (also of its angles, at 1 m) and of a roughly measured reflector [m, rad]."""


def register(source: Array, target: Array) -> Array:
    """Return the rigid motion T (4, 4) that minimizes sum |R source_i + t - target_i|^2 (paper, Eq. 17).

    The rotation is proper (det R = 1), by singular value decomposition (Umeyama 1991, IEEE PAMI 13:376).

    ``source`` and ``target`` are N points (N, 3) [m]. InputError for fewer than three points, and for coincident or
    collinear points, whose rotation is arbitrary.
    """
    source, target = np.asarray(source, dtype=float), np.asarray(target, dtype=float)
    if source.shape != target.shape or source.shape[1:] != (3,):
        raise InputError("points", f"shapes {source.shape}, {target.shape}", "N points, N points")
    if len(source) < 3:
        raise InputError("measured positions", f"{len(source)}", "three or more, not on a line")
    for points, what in ((source, "source"), (target, "target")):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[1] <= 1e-6 * spread[0]:
            raise InputError(f"{what} points", "points on a line, or all in one place", "points that span a plane")
    p, r = source.mean(axis=0), target.mean(axis=0)
    R = proper((target - r).T @ (source - p))
    return rigid(R, r - R @ p)


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
