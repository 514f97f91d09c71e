"""A reflector's position in the instrument's frame."""

from __future__ import annotations

from rpim_opt.data.measurements.measurement import XYZ, Measurement, origin

position = Measurement("position", origin, XYZ, noise={"position": "length"}, registers=True)
"""A reflector's position in the instrument's frame: r = y - p."""

TYPES = (position,)
