"""The distance to a fixed anchor: a draw-wire or cable."""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.data.measurements.measurement import Measurement, origin, solve


def anchor_start(points: Array, y: Array) -> Mapping[str, float]:
    """Locate an anchor from cable lengths: |p - a| + l = y is linear in a, l and |a|^2 - l^2 once squared."""
    centre = points.mean(axis=0)
    p = points - centre
    length = y[:, 0]
    A = np.column_stack([2 * p, -2 * length, -np.ones(len(p))])
    a = solve(A, np.sum(p**2, axis=1) - length**2, "an anchor and a zero length")
    place = a[:3] + centre
    return {"anchor_x": place[0], "anchor_y": place[1], "anchor_z": place[2], "length_0": a[3]}


cable = Measurement(
    "cable",
    model=lambda T, anchor_x, anchor_y, anchor_z, length_0: (
        ca.norm_2(origin(T) - ca.vertcat(anchor_x, anchor_y, anchor_z)) + length_0
    ),
    columns={"distance": "length"},
    parameters={"anchor_x": "length", "anchor_y": "length", "anchor_z": "length", "length_0": "length"},
    start=anchor_start,
)
"""Distance to a fixed anchor a (draw-wire, cable): r = y - |p - a| - l, with l the reading at zero distance."""

TYPES = (cable,)
