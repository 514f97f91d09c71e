"""What was learned before the last fit: sizes of deviations and noise with their evidence, families, rows left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.shown import Brief
from rpim_opt.convex.prior import SESSIONS


class Size(NamedTuple):
    """A size: of a group of deviations over their scales, or of a part of the noise [m or rad].

    ``spread`` is the standard deviation of its natural logarithm.
    """

    value: float
    spread: float


class Trial(NamedTuple):
    """Families of a model, and -2 ln of their restricted likelihood."""

    families: tuple[str, ...]
    value: float


class LeftOut(NamedTuple):
    """A row that was left out as a blunder: its error [m or rad] over the median of all rows' errors."""

    label: str
    ratio: float


@dataclass(frozen=True, eq=False, repr=False)
class Learned(Brief):
    """What the data said of the sizes of deviations and of the noise.

    Parameters
    ----------
    sizes
        Of the groups of deviations, in units of their scales.
    noise
        Of the robot's scatter: ``position`` [m], ``orientation`` and ``joint`` [rad]; ``instrument`` over the stated.
    local
        (n,) how far the data let each deviation's own scale leave that of its group; 1: as the group.
    trials
        The models that were compared, the chosen one first; empty where nothing was compared.
    value
        -2 ln of the restricted likelihood at the end.
    freedom
        Degrees of freedom of the noise's variance (Satterthwaite).
    left_out
        Rows that were left out as blunders, the worst first.
    covariance
        (s, s) of the logarithms of ``sizes`` and ``noise``.
    stated
        (n,) the scales that were stated for what is identified [SI].
    drift
        (n, s + h) by what the deviations move where the sizes are others, and where tails let them [SI]: D, with D D'
        what that adds to the covariance that ordinary Tikhonov has at the learned scales. Deviations are the same.
    added
        Parameters of families that were added to those that were to be identified.
    notes
        Sentences on how far the evidence decides.
    """

    sizes: Mapping[str, Size]
    noise: Mapping[str, Size]
    local: Array
    trials: tuple[Trial, ...]
    value: float
    freedom: float
    left_out: tuple[LeftOut, ...]
    covariance: Array
    stated: Array
    drift: Array
    added: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def _short(self) -> str:
        sizes = ", ".join(f"{name} {size.value:.3g}" for name, size in self.sizes.items())
        return f"sizes: {sizes}; {len(self.left_out)} rows left out"

    @property
    def families(self) -> tuple[str, ...]:
        """The families of the chosen model."""
        if not self.trials:
            return ()
        return self.trials[0].families

    def gain(self, family: str) -> float | None:
        """Return by how much -2 ln L falls where a family is added to the best of the models without it."""
        having = [t.value for t in self.trials if family in t.families]
        without = [t.value for t in self.trials if family not in t.families]
        if not having or not without:
            return None
        return float(min(without) - min(having))

    def unusual(self, names: tuple[str, ...], z: Array, least: float) -> list[tuple[str, float]]:
        """Return the parameters beyond so many of their group's scales, z (n,) in units of the local scales."""
        ratio = np.abs(z) * self.local
        order = np.argsort(-ratio)
        return [(names[i], float(ratio[i])) for i in order if ratio[i] > least]


def sessions_spread(learned: Learned | None) -> float:
    """Return the standard deviation of the logarithm of how far sessions lie apart; zero where no size was learned."""
    if learned is None:
        return 0.0
    return max((learned.sizes[name].spread for name in SESSIONS.values() if name in learned.sizes), default=0.0)
