"""Where a camera sees a point: the pinhole with radial and tangential distortion, symbolic in CasADi."""

from __future__ import annotations

from typing import Any

import casadi as ca

INTRINSICS = {
    "fx": "pixel", "fy": "pixel", "cx": "pixel", "cy": "pixel",
    "k1": "", "k2": "", "p1": "", "p2": "", "k3": "",
}  # fmt: skip
"""Focal lengths and centre, and distortion in the order of OpenCV."""
STRETCH = {"stretch_x": "ratio", "stretch_y": "ratio"}
"""By how much a printed board is larger than its file says, along its axes."""
TARGET = {"target_x": "length", "target_y": "length", "target_z": "length"}
"""Columns: where a row's point is on its board."""


def pixels(
    X: Any, Y: Any, Z: Any,
    fx: Any, fy: Any, cx: Any, cy: Any,
    k1: Any = 0.0, k2: Any = 0.0, p1: Any = 0.0, p2: Any = 0.0, k3: Any = 0.0,
) -> tuple[Any, Any]:  # fmt: skip
    """Return u and v [px] of a point in the camera's frame, x right, y down, z forwards; symbols, numbers or arrays.

    With x = X / Z, y = Y / Z and r^2 = x^2 + y^2 (Brown and Conrady)::

        u = fx [x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)] + cx
        v = fy [y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y] + cy

    >>> from rpim_opt.data.projection import pixels
    >>> pixels(0.1, 0.0, 1.0, fx=1000.0, fy=1000.0, cx=640.0, cy=480.0, k1=-0.1)
    (739.9, 480.0)
    """
    x = X / Z
    y = Y / Z
    r2 = x**2 + y**2
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return fx * u + cx, fy * v + cy


def _own(**values: Any) -> tuple[dict[str, Any], ca.SX]:
    """Return intrinsics by their short names, and the point (3, 1) on its board, stretched [m]."""
    intrinsics = {name: values[f"camera_{name}"] for name in INTRINSICS}
    x = values["target_x"] * (1 + values["board_stretch_x"])
    y = values["target_y"] * (1 + values["board_stretch_y"])
    return intrinsics, ca.vertcat(x, y, values["target_z"])


def _seen(point: ca.SX, intrinsics: dict[str, Any]) -> ca.SX:
    return ca.vertcat(*pixels(*ca.vertsplit(point), **intrinsics))


def on_the_flange(T: Any, **values: Any) -> ca.SX:
    """Return the pixels of a point of a board that stands in the cell, T (4, 4) the camera in the board's frame."""
    intrinsics, point = _own(**values)
    return _seen(T[:3, :3].T @ (point - T[:3, 3]), intrinsics)


def beside_the_robot(T: Any, **values: Any) -> ca.SX:
    """Return the pixels of a point of a board that the robot carries, T (4, 4) the board in the camera's frame."""
    intrinsics, point = _own(**values)
    return _seen(T[:3, :3] @ point + T[:3, 3], intrinsics)


def metres_on_the_flange(T: Any, **values: Any) -> ca.SX:
    """Return how far apart lines of sight through neighbouring pixels are at the point [m]: Z / f."""
    intrinsics, point = _own(**values)
    depth = ca.dot(T[:3, 2], point - T[:3, 3])
    return depth / ca.sqrt(intrinsics["fx"] * intrinsics["fy"])


def metres_beside_the_robot(T: Any, **values: Any) -> ca.SX:
    """Return the same where the robot carries the board."""
    intrinsics, point = _own(**values)
    depth = (T[:3, :3] @ point + T[:3, 3])[2]
    return depth / ca.sqrt(intrinsics["fx"] * intrinsics["fy"])
