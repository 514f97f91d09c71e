"""The distance between two points of the robot."""

from __future__ import annotations

import casadi as ca

from rpim_opt.data.measurements.measurement import Measurement, origin

distance = Measurement(
    "distance", lambda T1, T2: ca.norm_2(origin(T2) - origin(T1)), columns={"distance": "length"}, points=2
)
"""Distance between two points, of two configurations or two reflectors (paper, Eq. 21; ballbar): r = y - |p2 - p1|."""

TYPES = (distance,)
