"""Unmeasured points on a sphere."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.data.measurements.measurement import Measurement, origin, solve


def sphere_start(points: Array, y: Array) -> Mapping[str, float]:
    """Fit a sphere: |p - c|^2 = r^2 is linear in c and r^2 - |c|^2."""
    centre = points.mean(axis=0)
    p = points - centre
    c = solve(np.column_stack([2 * p, np.ones(len(p))]), np.sum(p**2, axis=1), "a sphere")
    place = c[:3] + centre
    radius = float(np.sqrt(c[3] + c[:3] @ c[:3]))
    return {"sphere_x": place[0], "sphere_y": place[1], "sphere_z": place[2], "sphere_r": radius}


sphere = Measurement(
    "sphere",
    model=lambda T, sphere_x, sphere_y, sphere_z, sphere_r: (
        ca.norm_2(origin(T) - ca.vertcat(sphere_x, sphere_y, sphere_z)) - sphere_r
    ),
    columns={},
    components={"distance": "length"},
    parameters={"sphere_x": "length", "sphere_y": "length", "sphere_z": "length", "sphere_r": "length"},
    start=sphere_start,
)
"""A point on a sphere of radius R about c: r = R - |p - c|."""

TYPES = (sphere,)
