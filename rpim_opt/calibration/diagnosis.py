"""Diagnostics of a fit: outliers, active bounds, shadow prices, extrapolation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.bayes.outliers import largest_errors
from rpim_opt.convex.robust_loss import RARE, outlying
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.record import Earlier
from rpim_opt.problem.blocks import Source

SLACK = 0.1  # share of a measured joint range by which values may exceed it, since its extremes are random
SLACK_LEAST = np.radians(1.0)  # least such excess [rad; for prismatic joints 17 mm]


class Flag(NamedTuple):
    """An outlier: label, residual in standard deviations, and error [SI] of its dimension, as of `largest_errors`."""

    label: str
    sigmas: float
    error: float | None
    dimension: str


class ActiveBound(NamedTuple):
    """An active bound of a parameter [SI], its multiplier, and the decrease of the objective if loosened by a tenth."""

    name: str
    bound: float
    multiplier: float
    gain: float


class ShadowPrice(NamedTuple):
    """Shadow price or slack of a constraint that is written as text, at a solution.

    ``slack`` is the distance from its limit, in ``unit``; ``multiplier`` the decrease of the objective (loss + weight
    penalty) per ``unit`` of loosening, zero if inactive; ``gain`` the decrease for loosening by ``step``, to first
    order. ``misfit`` is the objective itself.
    """

    text: str
    unit: str
    slack: float
    multiplier: float
    step: float
    gain: float
    misfit: float

    @property
    def holds(self) -> bool:
        """Whether it is active."""
        return self.multiplier > 0

    def sentence(self) -> str:
        """Return the price or the slack as a sentence."""
        if not self.holds:
            return f"'{self.text}' is inactive, with {self.slack:.3g} {self.unit} of slack."
        return (
            f"'{self.text}' is active: loosening it by {self.step:.3g} {self.unit} would lower the objective "
            f"by {self.gain:.3g}, from {self.misfit:.4g}."
        )


def flagged(problem: Source, x: Array) -> tuple[Flag, ...]:
    """Return the outliers at x (n,) [SI], by the threshold `outlying`, the worst first."""
    norms, count = problem.whitened_errors(x)
    limit = outlying(norms, count)
    errors = largest_errors(problem, x)
    noise = limit / np.sqrt(chdtri(count, RARE / len(norms)))
    labels = problem.labels
    worst = [i for i in np.argsort(-norms) if norms[i] > limit[i]]
    return tuple(Flag(labels[i], float(norms[i] / noise[i]), *errors[i]) for i in worst)


@dataclass(frozen=True)
class Outside:
    """Rows outside the measured joint ranges: their numbers ``rows``, of ``count`` considered ones.

    ``joints`` are how many of them are outside by each joint (from 1).
    """

    count: int = 0
    rows: tuple[int, ...] = ()
    joints: Mapping[int, int] = field(default_factory=dict)

    def sentences(self) -> list[str]:
        """Return a sentence on the number of rows outside; empty if there are none."""
        if not self.rows:
            return []
        by = ", ".join(f"joint {joint}: {count}" for joint, count in self.joints.items())
        return [
            f"Rows well outside the measured joint ranges: {len(self.rows)} of {self.count} ({by}). No measurement "
            "checked the model there, and errors may exceed its intervals."
        ]


def measured_ranges(problem: Source, earlier: Sequence[Earlier] = ()) -> dict[str, Array]:
    """Return the measured range of every joint (2, dof) [rad or m] by robot, with those of earlier calibrations."""
    here = ((b.robot, b.q.reshape(-1, b.q.shape[2])) for part in problem.rows() for b in part.data.blocks)
    before = ((robot, np.array(ends)) for each in earlier for robot, ends in each.ranges.items())
    ranges: dict[str, Array] = {}
    for robot, q in chain(here, before):
        seen = np.vstack([q, ranges.get(robot, q[:0])])
        ranges[robot] = np.stack([seen.min(axis=0), seen.max(axis=0)])
    return ranges


def outside(ranges: Mapping[str, Array], data: Dataset) -> Outside:
    """Return which rows have a point outside the joint ranges (2, dof) of their robot."""
    beyond = np.zeros((len(data), max(block.q.shape[2] for block in data.blocks)), dtype=bool)
    for block in data.blocks:
        low, high = ranges[block.robot]
        slack = np.maximum(SLACK * (high - low), SLACK_LEAST)
        far = (block.q < low - slack) | (block.q > high + slack)
        beyond[block.row, : len(low)] = far.any(axis=1)
    by = {int(j) + 1: int(beyond[:, j].sum()) for j in np.flatnonzero(beyond.any(axis=0))}
    return Outside(len(data), tuple(np.flatnonzero(beyond.any(axis=1)).tolist()), by)
