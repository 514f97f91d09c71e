"""Covariances of measured values: stated by row, declared for all rows, or from a data sheet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import SMALLEST, quantities, with_unit
from rpim_opt.data.measurements.measurement import Measurement

Numbers = dict[tuple[str, str], Array]
"""Columns of numbers [SI] by (stem, dimension), and by (stem, "") where a stem has one dimension."""
TRACKER = {"range": ("length", "ratio"), "transverse": ("length",), "angle": ("angle",),
           "x": ("length",), "y": ("length",), "z": ("length",)}  # fmt: skip
"""The keys of ``[noise.tracker]`` and their dimensions."""
DEFINITE = 1e-9
"""A correlation matrix whose smallest eigenvalue is not above this is no covariance."""
COVERAGE = 2.0
"""Coverage factor of expanded uncertainties, the columns u95."""


@dataclass(frozen=True)
class LaserTracker:
    """The covariance of what a laser tracker measures, from the terms of its data sheet.

    With u the unit vector from the tracker to the point at distance D::

        C = (range + range_ppm D)^2 u u' + (transverse + angle D)^2 (1 - u u')

    ``range`` and ``transverse`` are standard deviations along and across the beam at zero distance [m], ``range_ppm``
    (1e-6 for 1 ppm) [1] and ``angle`` [rad] how they grow; ``x``, ``y``, ``z`` the tracker's place in the instrument's
    frame [m], its origin by default.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> tracker = ro.data.LaserTracker(range=10e-6, range_ppm=1e-6, transverse=15e-6, angle=6e-6)
    >>> covariance = tracker.covariance(np.array([[3.0, 0.0, 0.0]]))
    >>> (1e6 * np.sqrt(np.diag(covariance[0]))).round(3)  # along x the beam, [um]
    array([13., 33., 33.])
    """

    range: float = 0.0
    range_ppm: float = 0.0
    transverse: float = 0.0
    angle: float = 0.0
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0

    def covariance(self, points: Array) -> Array:
        """Return the covariances (N, 3, 3) [m^2] of points (N, 3) [m] in the instrument's frame."""
        beam = points - np.array([self.x, self.y, self.z])
        D = np.linalg.norm(beam, axis=1)
        u = beam / np.maximum(D, 1e-9)[:, None]
        along = ((self.range + self.range_ppm * D) ** 2)[:, None, None]
        across = ((self.transverse + self.angle * D) ** 2)[:, None, None]
        return across * np.eye(3) + (along - across) * (u[:, :, None] * u[:, None, :])


def declared_noise(noise: Mapping[str, Any], kind: Measurement) -> dict[str, Any]:
    """Return the declared noise for rows without a stated one: standard deviations [SI], or a ``tracker``."""
    declared: dict[str, Any] = {}
    plain = dict(noise)
    stated = plain.pop("tracker", None)
    if stated is not None:
        if not isinstance(stated, Mapping) or not {"x", "y", "z"} <= set(kind.columns):
            raise InputError("table noise, key tracker", repr(stated)[:60], "a table, for positions and poses")
        given = quantities(stated, TRACKER, "table noise.tracker")
        terms = {"range_ppm" if dimension == "ratio" else stem: value for (stem, dimension), value in given.items()}
        if not any(terms.get(term, 0) > 0 for term in ("range", "transverse")):
            raise InputError("table noise.tracker", "no range_um and no transverse_um", "at least one of them > 0")
        declared["tracker"] = LaserTracker(**terms)
    accepted = {name: (dimension,) for name, dimension in {**kind.noise, **kind.components}.items()}
    for (stem, _), value in quantities(plain, accepted, "table noise").items():
        if not value >= SMALLEST:
            asked = f"a standard deviation > 0, from {SMALLEST:g} on"
            raise InputError(f"table noise, key {stem}", f"{value:g}", asked)
        declared[stem] = value
    return declared


def covariances(
    columns: Numbers, declared: Mapping[str, Any], kind: Measurement, y: Array, label: Sequence[str]
) -> Array:
    """Return the covariances of the residual's components [SI], (N, k, k) or (1, k, k) where all rows are alike.

    A standard deviation that a row states of itself replaces the declared one and the tracker's part of it.
    """
    names = list(kind.components)
    k = len(names)
    instrument = np.zeros((1, k, k))
    if "tracker" in declared:
        instrument = np.zeros((len(y), k, k))
        axes = [list(kind.columns).index(axis) for axis in "xyz"]
        instrument[:, :3, :3] = declared["tracker"].covariance(y[:, axes])
    spread: list[Any] = []
    lacking = np.zeros(k, dtype=bool)
    for i, (name, dimension) in enumerate(kind.components.items()):
        # what rows state: of this component before those of all of its dimension
        sources = {
            (f"sigma_{name}", ""): 1.0,
            ("sigma", dimension): 1.0,
            (f"u95_{name}", ""): COVERAGE,
            ("u95", dimension): COVERAGE,
        }
        own = next((columns[key] / factor for key, factor in sources.items() if key in columns), None)
        common = ""
        if own is None:
            common = next((key for key, of in kind.noise.items() if of == dimension), "")
            own = declared.get(name, declared.get(common))
            lacking[i] = True
        if own is None:
            if not instrument[:, i, i].any() and (f"cov_{name}_{name}", "") not in columns:
                column = with_unit(f"sigma_{name}", dimension, 2)[-1]
                accepted = f"{with_unit(common, dimension, 2)[-1]}, or a column {column}"
                raise InputError("table noise", f"no standard deviation for '{name}'", accepted)
            own = 0.0  # the tracker or a column has it all
        spread.append(own)
    deviation = np.stack(np.broadcast_arrays(*map(np.atleast_1d, spread)), axis=1)
    covariance = deviation[:, :, None] ** 2 * np.eye(k) + instrument * np.outer(lacking, lacking)
    pairs = [(a, b) for a in names for b in names if (f"cov_{a}_{b}", "") in columns]
    if pairs:
        covariance = np.broadcast_to(covariance, (len(y), k, k)).copy()
    for a, b in pairs:
        i, j = names.index(a), names.index(b)
        covariance[:, i, j] = columns[f"cov_{a}_{b}", ""]
        covariance[:, j, i] = covariance[:, i, j]
    unit = np.sqrt(np.einsum("nii->ni", covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = np.nan_to_num(covariance / (unit[:, :, None] * unit[:, None, :]))
    definite = np.linalg.eigvalsh(correlation)[:, 0] > DEFINITE
    if not definite.all():
        row = label[int(np.argmin(definite))]
        raise InputError(f"row {row}, columns cov_...", "a covariance that is not positive definite", "one that is")
    return covariance
