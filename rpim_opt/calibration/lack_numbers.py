"""What a calibration leaves, in numbers: noise by its parts, families that are missing, neighbours, repetitions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from rpim_opt.calibration.alike import Alike
from rpim_opt.calibration.left_over import Effect

ALIKE = 4.0
"""Standard deviations from chance at which configurations are said to err alike."""


@dataclass(frozen=True, eq=False)
class LeftOver:
    """What a calibration leaves in numbers; `LackOfFit` says it in words.

    RMS values are lengths of vectors [m], root of the mean square over the rows; [rad] or [px] where no length
    was measured.

    Parameters
    ----------
    configurations
        How many were looked at.
    equations, spare
        How many equations there are, and how many the deviations leave over; with fewer than 6 nothing else is judged.
    dimension
        ``"length"``, ``"angle"`` or ``"pixel"``.
    left
        RMS of the errors of the rows.
    instrument, position, joint
        RMS of the noise's parts: the instrument's as declared (or learned), the robot's scatter in position (in
        orientation without lengths), and what comes from its joints.
    repeatable
        RMS of what `missing` would explain.
    missing
        Families that the data want beside those of the model; empty: none.
    parameters
        Patterns that identify them.
    gain
        By how much -2 ln L falls with them.
    share
        Part of the variance of what is left that they would explain, 0 to 1.
    present
        Families of the model that earn their parameters.
    alike
        Whether similar configurations err alike in the model with all that `missing` names; None for too few.
    upward
        Joints whose compliance is significantly negative, which gravity cannot do.
    narrow
        Joints that turned so little that nothing of their gears can be told.
    repeated
        RMS of repeated readings of a configuration about their mean; None without enough of them.
    excess
        RMS of what is left beyond that, where it is more than chance.
    """

    configurations: int
    equations: int
    spare: float
    dimension: str
    left: float
    instrument: float = 0.0
    position: float = 0.0
    joint: float = 0.0
    repeatable: float = 0.0
    missing: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ()
    gain: float = 0.0
    share: float = 0.0
    present: Mapping[str, Effect] = field(default_factory=dict)
    alike: Alike | None = None
    upward: tuple[int, ...] = ()
    narrow: tuple[int, ...] = ()
    repeated: float | None = None
    excess: float = 0.0

    @property
    def robot(self) -> float:
        """RMS of the robot's scatter."""
        return float(np.hypot(self.position, self.joint))

    @property
    def room(self) -> float:
        """By how much the errors of a fit are smaller than those elsewhere: root of equations over spare ones."""
        return float(np.sqrt(self.equations / max(self.spare, 1.0)))

    @property
    def correlated(self) -> bool:
        """Whether similar configurations err alike, beyond what chance does."""
        return self.alike is not None and self.alike.z > ALIKE

    @property
    def alarming(self) -> bool:
        """Whether anything is said to lack."""
        return bool(self.missing or self.upward or self.correlated)
