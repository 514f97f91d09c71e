"""What was learned, and the robot's scatter, as parts of a result file, and back."""

from __future__ import annotations

from typing import Any

import numpy as np

from rpim_opt.calibration.learned import Learned, LeftOut, Size, Trial
from rpim_opt.problem.scatter import Scatter
from rpim_opt.store.schema import LearnedPart, ScatterPart


def scatter_part(scatter: Scatter | None) -> dict[str, Any] | None:
    """Return the robot's noise as a file holds it."""
    if scatter is None:
        return None
    at = None
    if scatter.at is not None:
        at = scatter.at.tolist()
    return {
        "position": scatter.position,
        "orientation": scatter.orientation,
        "joint": scatter.joint,
        "instrument": scatter.instrument,
        "at": at,
    }


def scatter_of(part: ScatterPart | None) -> Scatter | None:
    """Return the robot's noise that a file holds."""
    if part is None:
        return None
    at = None
    if part.at is not None:
        at = np.array(part.at)
    return Scatter(part.position, part.orientation, part.joint, part.instrument, at)


def learned_part(learned: Learned | None) -> dict[str, Any] | None:
    """Return what was learned as a file holds it."""
    if learned is None:
        return None
    return {
        "sizes": {name: size._asdict() for name, size in learned.sizes.items()},
        "noise": {name: size._asdict() for name, size in learned.noise.items()},
        "local": learned.local.tolist(),
        "trials": [{"families": list(trial.families), "value": trial.value} for trial in learned.trials],
        "value": learned.value,
        "freedom": learned.freedom,
        "left_out": [row._asdict() for row in learned.left_out],
        "covariance": learned.covariance.tolist(),
        "stated": learned.stated.tolist(),
        "drift": learned.drift.tolist(),
        "added": list(learned.added),
        "notes": list(learned.notes),
    }


def learned_of(part: LearnedPart | None) -> Learned | None:
    """Return what a file says was learned."""
    if part is None:
        return None
    return Learned(
        sizes={name: Size(size.value, size.spread) for name, size in part.sizes.items()},
        noise={name: Size(size.value, size.spread) for name, size in part.noise.items()},
        local=np.array(part.local),
        trials=tuple(Trial(tuple(trial.families), trial.value) for trial in part.trials),
        value=part.value,
        freedom=part.freedom,
        left_out=tuple(LeftOut(row.label, row.ratio) for row in part.left_out),
        covariance=np.array(part.covariance),
        stated=np.array(part.stated),
        drift=np.array(part.drift),
        added=tuple(part.added),
        notes=tuple(part.notes),
    )
