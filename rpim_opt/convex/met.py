"""Minima that were met: those of another weight or linearization are near, and begin with them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array

MOST = 100
"""Weights whose minima are kept."""
TINY = 1e-300
"""Stands for a weight of zero, whose logarithm is asked for."""


class Kinked(NamedTuple):
    """What a neighbour may begin with.

    About which multipliers (m,) each the kinks are smoothed, and how sharply; of a smooth loss its second derivative by
    z (n, n) at a point nearby, where that was dear.
    """

    multipliers: list[Array]
    sharpness: float
    curved: Array | None = None


class Near(NamedTuple):
    """A minimum of a program like the one that is asked for.

    z (n,), what a neighbour may begin with, the loss's slope (m,), equations in the order of their configurations, and
    the loss; of a point that is only thought to be near, z.
    """

    z: Array
    kinked: Kinked = Kinked([], 1.0)
    slope: Array = np.empty(0)
    loss: float = np.nan


class Met:
    """The last minima at some weights, from which those of another weight or linearization are near.

    Parameters
    ----------
    whole
        What was met of all data, where these are of some of them: it hears of every minimum, too.
    """

    def __init__(self, whole: Met | None = None) -> None:
        self._at: dict[float, Near] = {}
        self._own: dict[float, Near] = {}  # those that are not of some of the data
        self.begin: Array | None = None  # (n,) where a box, or the first minimum, is looked for
        self._whole = whole

    def nearest(self, weight: float) -> Near | None:
        """Return the minimum at the nearest weight."""
        if weight in self._at or not self._at:
            return self._at.get(weight)
        return self._at[min(self._at, key=lambda other: abs(np.log((other + TINY) / (weight + TINY))))]

    def near(self, weight: float) -> list[Near]:
        """Return the minimum at the nearest weight, and the last one, which may be of a program more like this one.

        Of some of the data the nearest one of the same data, too, and that of all data at this weight.
        """
        if self._whole is not None:
            found = self._whole.near(weight)
            for other in (self.nearest(weight), self._whole._own.get(weight)):
                if other is not None and all(other is not each for each in found):
                    found.append(other)
            return found
        nearest = self.nearest(weight)
        if nearest is None:
            return [] if self.begin is None else [Near(self.begin)]
        last = self._at[next(reversed(self._at))]
        if last is nearest:
            return [nearest]
        return [nearest, last]

    def keep(self, weight: float, near: Near) -> None:
        """Keep a minimum; of too many weights the one that was met first goes."""
        _keep(self._own, weight, near)
        _keep(self._at, weight, near)
        if self._whole is not None:
            _keep(self._whole._at, weight, near)


def _keep(met: dict[float, Near], weight: float, near: Near) -> None:
    met.pop(weight, None)
    met[weight] = near
    if len(met) > MOST:
        del met[next(iter(met))]
