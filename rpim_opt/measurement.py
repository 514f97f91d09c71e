"""What an instrument sees: measurement models, symbolic in CasADi."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from rpim_opt.exceptions import InputError
from rpim_opt.kinematics import FRAME_DIMENSION, roll_pitch_yaw
from rpim_opt.robot import Array


def _difference(y: Any, modelled: Any) -> Any:
    return y - modelled


def _sum(modelled: Array, error: Array) -> Array:
    return modelled + error


@dataclass(frozen=True, eq=False)
class Measurement:
    """A measurement model: the residual of a row is ``minus(y, model(T, **own))``.

    Parameters
    ----------
    name
        What a problem file calls it.
    model
        ``model(*T, **own)``: the modelled values (c, 1), from the transform T (4 x 4) of the reflector in the
        instrument's frame, one for each point, and the measurement's own parameters by name.
    columns
        The columns of a data table that hold the measured values y, name to dimension: ``{"x": "length"}``
        stands for a column ``x_mm`` or ``x_m``; dimension ``""`` for one without unit. None for a constraint,
        whose measured value is zero.
    components
        The components of the residual, name to dimension, in order; the columns by default. Their names are
        the keys of the noise per axis (``sigma_x_mm``, ``[noise] x_mm``).
    noise
        The keys of the noise common to all components of a dimension: ``{"position": "length"}``.
    parameters
        The measurement's own parameters, name to dimension; ``anchor_x`` is given as ``x`` of a table ``[anchor]``.
    frames
        The prefixes of those parameters that are frames, six each: the model gets one transform instead.
    points
        How many points of the robot a row involves: 2 for the distance between two.
    minus, plus
        Measured minus modelled (k, 1), symbolic; and its inverse on rows of numbers, ``plus(modelled, e) = y``
        with ``minus(y, modelled) = e``, for simulations. Difference and sum by default.
    start
        ``start(points, y)``: own parameters by name from nominal positions (N, 3) in the instrument's frame and
        measured values (N, c), in closed form.
    forms
        Other columns in which a table may state the values, each with the function to y (N, c).
    prepare
        Checks and normalizes y (N, c); raises InputError with the row's number as ``where``.
    """

    name: str
    model: Callable[..., Any]
    columns: Mapping[str, str]
    components: Mapping[str, str] = field(default_factory=dict)
    noise: Mapping[str, str] = field(default_factory=dict)
    parameters: Mapping[str, str] = field(default_factory=dict)
    frames: tuple[str, ...] = ()
    points: int = 1
    minus: Callable[[Any, Any], Any] = _difference
    plus: Callable[[Array, Array], Array] = _sum
    start: Callable[[Array, Array], Mapping[str, float]] | None = None
    forms: tuple[tuple[Mapping[str, str], Callable[[Array], Array]], ...] = ()
    prepare: Callable[[Array], Array] = lambda y: y

    def __post_init__(self) -> None:
        if not self.components:
            object.__setattr__(self, "components", self.columns)
        if not self.noise:
            object.__setattr__(self, "noise", {"distance": "length"})

    def __reduce__(self) -> Any:
        """Ready measurements travel to other processes by name, so that they stay the same there."""
        known = MEASUREMENTS.get(self.name) is self
        return (_ready, (self.name,)) if known else super().__reduce__()


def _ready(name: str) -> Measurement:
    return MEASUREMENTS[name]


def of_fixture(parameter: str, fixture: str) -> str:
    """Return the name of an own parameter at one of several fixtures: ``anchor_x`` of A is ``anchor_A_x``."""
    table, _, rest = parameter.partition("_")
    return f"{table}_{fixture}_{rest}" if fixture else parameter


# --- rotations ---------------------------------------------------------------------------------------------


def quaternion(T: Any) -> Any:
    """Return the unit quaternion (w, x, y, z), up to its sign, of a transform's rotation; regular everywhere.

    The symmetric matrix 4 q q' is linear in the entries of R; its column with the largest diagonal entry,
    normalized, is the quaternion and never shorter than 2 before (Shepperd 1978, J. Guidance and Control 1:223).
    """
    R = T[:3, :3]
    t = R[0, 0] + R[1, 1] + R[2, 2]
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    xy, xz, yz = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    columns = [
        ca.vertcat(1 + t, x, y, z),
        ca.vertcat(x, 1 + 2 * R[0, 0] - t, xy, xz),
        ca.vertcat(y, xy, 1 + 2 * R[1, 1] - t, yz),
        ca.vertcat(z, xz, yz, 1 + 2 * R[2, 2] - t),
    ]
    best, size = columns[0], columns[0][0]
    for i in (1, 2, 3):
        larger = columns[i][i] > size
        best, size = ca.if_else(larger, columns[i], best), ca.if_else(larger, columns[i][i], size)
    return best / ca.sqrt(ca.sumsqr(best))


def rotation_between(p: Any, q: Any) -> Any:
    """Return the rotation vector [rad] of R(p) R(q)' for unit quaternions: the exact logarithm up to pi."""
    w = p[0] * q[0] + p[1] * q[1] + p[2] * q[2] + p[3] * q[3]
    x = -p[0] * q[1] + p[1] * q[0] - p[2] * q[3] + p[3] * q[2]
    y = -p[0] * q[2] + p[1] * q[3] + p[2] * q[0] - p[3] * q[1]
    z = -p[0] * q[3] - p[1] * q[2] + p[2] * q[1] + p[3] * q[0]
    sign = ca.if_else(w < 0, -1, 1)
    w, v = sign * w, sign * ca.vertcat(x, y, z)
    n2 = ca.sumsqr(v)
    small = n2 < 1e-12
    n = ca.sqrt(ca.if_else(small, 1, n2))  # the branch not taken must have derivatives too
    return ca.if_else(small, 2 / w * (1 - n2 / (3 * w**2)), 2 * ca.atan2(n, w) / n) * v


def _turned(y: Array, e: Array) -> Array:
    """Move poses (N, 7) by e (N, 6), the positions and then the rotations about the instrument's axes."""
    turned = Rotation.from_rotvec(e[:, 3:]) * Rotation.from_quat(y[:, [4, 5, 6, 3]])
    return np.hstack([y[:, :3] + e[:, :3], _w_first(turned)])


def _w_first(rotation: Rotation) -> Array:
    return rotation.as_quat()[:, [3, 0, 1, 2]]


def _unit_quaternions(y: Array) -> Array:
    norm = np.linalg.norm(y[:, 3:], axis=1)
    wrong = np.flatnonzero(np.abs(norm - 1) > 1e-3)
    if len(wrong):
        raise InputError(str(wrong[0]), f"a quaternion of norm {norm[wrong[0]]:.4g}", "norm 1 within 0.001, w first")
    return np.hstack([y[:, :3], y[:, 3:] / norm[:, None]])


def _from_angles(y: Array) -> Array:
    return np.hstack([y[:, :3], _w_first(Rotation.from_euler("xyz", y[:, 3:]))])


def _from_matrices(y: Array) -> Array:
    R = y[:, 3:].reshape(-1, 3, 3)
    off = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    wrong = np.flatnonzero((off > 1e-3) | (np.linalg.det(R) < 0))
    if len(wrong):
        found = f"a matrix that misses R R' = 1 by {off[wrong[0]]:.2g}, determinant {np.linalg.det(R[wrong[0]]):.3g}"
        raise InputError(str(wrong[0]), found, "a rotation within 0.001, determinant 1")
    return np.hstack([y[:, :3], _w_first(Rotation.from_matrix(R))])


# --- closed-form starts ------------------------------------------------------------------------------------


def _solve(A: Array, b: Array, what: str) -> Array:
    """Return the least-squares solution; refuse a degenerate system."""
    x, _, rank, s = np.linalg.lstsq(A, b, rcond=None)
    if rank < A.shape[1] or s[-1] < 1e-7 * s[0]:
        raise InputError("data", f"{len(A)} points that do not determine {what}", "more, or better spread, points")
    return np.asarray(x, dtype=float)


def anchor_start(points: Array, y: Array) -> Mapping[str, float]:
    """Locate an anchor from cable lengths: |p - a| + l = y is linear in a, l and |a|^2 - l^2 once squared."""
    centre = points.mean(axis=0)
    p, length = points - centre, y[:, 0]
    A = np.column_stack([2 * p, -2 * length, -np.ones(len(p))])
    a = _solve(A, np.sum(p**2, axis=1) - length**2, "an anchor and a zero length")
    x, y_, z = a[:3] + centre
    return {"anchor_x": x, "anchor_y": y_, "anchor_z": z, "length_0": a[3]}


def plane_start(points: Array, y: Array) -> Mapping[str, float]:
    """Fit a plane: its normal is the direction in which the points spread least."""
    centre = points.mean(axis=0)
    _, s, Vt = np.linalg.svd(points - centre)
    if len(points) < 3 or s[1] < 1e-6 * s[0]:
        raise InputError("data", f"{len(points)} points that do not determine a plane", "three or more, not on a line")
    x, n = Vt[0], Vt[2] if Vt[2, np.argmax(np.abs(Vt[2]))] >= 0 else -Vt[2]
    turn = roll_pitch_yaw(np.column_stack([x, np.cross(n, x), n]))
    return dict(zip([f"plane_{c}" for c in FRAME_DIMENSION], (*centre, *turn), strict=True))


def sphere_start(points: Array, y: Array) -> Mapping[str, float]:
    """Fit a sphere: |p - c|^2 = r^2 is linear in c and r^2 - |c|^2."""
    centre = points.mean(axis=0)
    p = points - centre
    c = _solve(np.column_stack([2 * p, np.ones(len(p))]), np.sum(p**2, axis=1), "a sphere")
    x, y_, z = c[:3] + centre
    return {"sphere_x": x, "sphere_y": y_, "sphere_z": z, "sphere_r": float(np.sqrt(c[3] + c[:3] @ c[:3]))}


# --- the models --------------------------------------------------------------------------------------------

_XYZ = {"x": "length", "y": "length", "z": "length"}
_TURN = {"rx": "angle", "ry": "angle", "rz": "angle"}
_MATRIX = {f"r{i}{j}": "" for i in (1, 2, 3) for j in (1, 2, 3)}
_DISTANCE = {"distance": "length"}


def _origin(T: Any) -> Any:
    return T[:3, 3]


position = Measurement("position", _origin, _XYZ, noise={"position": "length"})
"""A reflector's position in the instrument's frame: r = y - p."""

pose = Measurement(
    "pose",
    model=lambda T: ca.vertcat(_origin(T), quaternion(T)),
    columns=_XYZ | {"qw": "", "qx": "", "qy": "", "qz": ""},
    components=_XYZ | _TURN,
    noise={"position": "length", "orientation": "angle"},
    minus=lambda y, m: ca.vertcat(y[:3] - m[:3], rotation_between(y[3:], m[3:])),
    plus=_turned,
    forms=((_XYZ | _TURN, _from_angles), (_XYZ | _MATRIX, _from_matrices)),
    prepare=_unit_quaternions,
)
"""Position and orientation in the instrument's frame: r = (y - p, log(R_measured R')), about the instrument's axes."""

cable = Measurement(
    "cable",
    model=lambda T, anchor_x, anchor_y, anchor_z, length_0: (
        ca.norm_2(_origin(T) - ca.vertcat(anchor_x, anchor_y, anchor_z)) + length_0
    ),
    columns=_DISTANCE,
    parameters={"anchor_x": "length", "anchor_y": "length", "anchor_z": "length", "length_0": "length"},
    start=anchor_start,
)
"""Distance to a fixed anchor a (draw-wire, cable): r = y - |p - a| - l, with l the reading at zero distance."""

distance = Measurement("distance", lambda T1, T2: ca.norm_2(_origin(T2) - _origin(T1)), _DISTANCE, points=2)
"""Distance between two points, of two configurations or two reflectors (paper, Eq. 21; ballbar): r = y - |p2 - p1|."""

plane = Measurement(
    "plane",
    model=lambda T, plane: ca.dot(plane[:3, 2], _origin(T) - plane[:3, 3]),
    columns={},
    components=_DISTANCE,
    parameters={f"plane_{c}": d for c, d in FRAME_DIMENSION.items()},
    frames=("plane",),
    start=plane_start,
)
"""A point on a plane, given as a frame whose x and y axes span it: r = -n'(p - o) with its z axis n and origin o."""

sphere = Measurement(
    "sphere",
    model=lambda T, sphere_x, sphere_y, sphere_z, sphere_r: (
        ca.norm_2(_origin(T) - ca.vertcat(sphere_x, sphere_y, sphere_z)) - sphere_r
    ),
    columns={},
    components=_DISTANCE,
    parameters={"sphere_x": "length", "sphere_y": "length", "sphere_z": "length", "sphere_r": "length"},
    start=sphere_start,
)
"""A point on a sphere of radius R about c: r = R - |p - c|."""

MEASUREMENTS = {m.name: m for m in (position, pose, cable, distance, plane, sphere)}


@dataclass(frozen=True)
class LaserTracker:
    """The covariance of what a laser tracker measures, from the terms of its data sheet.

    With u the unit vector from the tracker to the point at distance D::

        C = (range + range_ppm D)^2 u u' + (transverse + angle D)^2 (1 - u u')

    Parameters
    ----------
    range, transverse
        Standard deviations along and across the beam at zero distance [m].
    range_ppm
        Growth along the beam per metre [1].
    angle
        Growth across the beam [rad].
    x, y, z
        The tracker's place in the instrument's frame [m]; its origin by default.
    """

    range: float = 0.0
    range_ppm: float = 0.0
    transverse: float = 0.0
    angle: float = 0.0
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0

    def covariance(self, points: Array) -> Array:
        """Return (N, 3, 3) [m^2] for points (N, 3) [m]."""
        beam = points - np.array([self.x, self.y, self.z])
        D = np.linalg.norm(beam, axis=1)
        u = beam / np.maximum(D, 1e-9)[:, None]
        along = ((self.range + self.range_ppm * D) ** 2)[:, None, None]
        across = ((self.transverse + self.angle * D) ** 2)[:, None, None]
        return across * np.eye(3) + (along - across) * (u[:, :, None] * u[:, None, :])
