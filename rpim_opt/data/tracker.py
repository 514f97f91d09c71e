"""The uncertainty of a laser tracker, from its data sheet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rpim_opt.basics.arrays import Array


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
        Growth along the beam per metre [1]: 1e-6 for 1 ppm.
    angle
        Growth across the beam [rad].
    x, y, z
        The tracker's place in the instrument's frame [m]; its origin by default.

    Examples
    --------
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
