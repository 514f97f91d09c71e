"""What an instrument sees: measurement models as signed residuals, symbolic in CasADi."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, eq=False)
class Measurement:
    """A measurement model.

    Parameters
    ----------
    name
        What a problem file calls it.
    columns
        The columns of a data table that hold the measured values, name to dimension: ``{"x": "length"}``
        stands for a column ``x_mm`` or ``x_m``.
    components
        The components of the residual, name to dimension, in order. Their names are the keys of the
        noise per axis (``sigma_x_mm``, ``[noise] x_mm``).
    noise
        The keys of the noise common to all components of a dimension: ``{"position": "length"}``.
    residual
        ``residual(y, T, **own)``: measured minus modelled (k, 1), from the measured values y, the transform T
        (4 x 4) of the reflector in the instrument's frame, and the measurement's own parameters by name.
    parameters
        The measurement's own parameters, name to dimension (an anchor's place, say).
    """

    name: str
    columns: Mapping[str, str]
    components: Mapping[str, str]
    noise: Mapping[str, str]
    residual: Callable[..., Any]
    parameters: Mapping[str, str] = field(default_factory=dict)


_XYZ = {"x": "length", "y": "length", "z": "length"}

position = Measurement(
    "position",
    columns=_XYZ,
    components=_XYZ,
    noise={"position": "length"},
    residual=lambda y, T: y - T[:3, 3],
)
"""A reflector's position in the instrument's frame: r = y - origin of T."""

MEASUREMENTS = {measurement.name: measurement for measurement in (position,)}
