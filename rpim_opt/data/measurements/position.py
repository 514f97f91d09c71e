"""A reflector's position in the instrument's frame."""

from __future__ import annotations

import numpy as np

from rpim_opt.basics.arrays import Array
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

TYPES = (position,)
