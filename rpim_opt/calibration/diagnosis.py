"""Diagnostics of a fit: outliers, active bounds, shadow prices, extrapolation."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.constraints import Parsed
from rpim_opt.convex.program import Program
from rpim_opt.convex.robust_loss import RARE, outlying
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.blocks import Source

SLACK = 0.1
"""Share of a measured joint range by which values may exceed it: its extremes are themselves drawn by chance."""
SLACK_LEAST = np.radians(1.0)
"""What they may exceed it by in any case [rad; for prismatic joints 17 mm]."""
ACTIVE = 1e-6
"""Relative multiplier from which on, and distance up to which, a constraint is active."""


class Flag(NamedTuple):
    """An outlier: label, residual in standard deviations, and error [mm]."""

    label: str
    sigmas: float
    error_mm: float


class ActiveBound(NamedTuple):
    """An active bound of a parameter [SI], its multiplier, and the gain of loosening it by a tenth."""

    name: str
    bound: float
    multiplier: float
    gain: float


class ShadowPrice(NamedTuple):
    """A constraint that is written as text, at a solution: its shadow price or its slack.

    ``slack`` is how far it is from its limit, in ``unit``; ``multiplier`` by how much the misfit (loss + weight
    penalty) would fall for every ``unit`` by which it is loosened, zero where it is not active; ``gain`` what loosening
    it by ``step`` would bring, to first order. ``misfit`` is all there is.
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
            f"by {self.gain:.3g} of {self.misfit:.4g}."
        )


def flagged(problem: Source, x: Array) -> tuple[Flag, ...]:
    """Return the outliers at x (n,) [SI], by the threshold `outlying`, the worst first."""
    norms, count = problem.whitened_errors(x)
    limit = outlying(norms, count)
    error = problem.errors(x)
    error = 1e3 * np.where(np.isfinite(error), error, problem.errors(x, "stated length"))
    noise = limit / np.sqrt(chdtri(count, RARE / len(norms)))
    labels = problem.labels
    worst = [i for i in np.argsort(-norms) if norms[i] > limit[i]]
    return tuple(Flag(labels[i], float(norms[i] / noise[i]), float(error[i])) for i in worst)


def active_bounds(program: Program, z: Array, weight: float) -> tuple[ActiveBound, ...]:
    """Return the parameters with an active bound at z (n,), the largest multiplier first."""
    box = program.box
    if box is None or not program.formulation.constraints:
        return ()
    parameters = program.model.parameters
    multiplier = np.sum(program.beginning(z).solve(weight).duals, axis=0)
    loss = program.value(z)[0]
    rows = program.model.equations
    near = np.minimum(z - box[0], box[1] - z) < ACTIVE * (1 + np.abs(z))
    bounds: list[ActiveBound] = []
    for i in np.flatnonzero((multiplier > ACTIVE * loss / rows) & near & (box[0] < box[1])):
        bound = float(min((box[0][i], box[1][i]), key=lambda side: abs(z[i] - side)))
        less = max(loss - 0.1 * abs(bound) * multiplier[i], 0.0)
        gain = float(np.sqrt(loss / rows) - np.sqrt(less / rows))
        bounds.append(ActiveBound(parameters.names[i], bound * float(parameters.scale[i]), float(multiplier[i]), gain))
    return tuple(sorted(bounds, key=lambda h: -h.gain))


def shadow_prices(program: Program, z: Array, weight: float) -> tuple[ShadowPrice, ...]:
    """Return the shadow prices of a program's textual constraints at its solution z (n,)."""
    constraints = program.formulation.constraints
    if not any(isinstance(constraint, Parsed) for constraint in constraints):
        return ()
    parameters = program.model.parameters
    duals = program.beginning(z).solve(weight).duals
    misfit = program.objective(z, weight)
    prices = []
    for parsed, multipliers in zip(constraints, duals, strict=True):
        if not isinstance(parsed, Parsed):
            continue
        unit, si = parsed.unit
        slack = parsed.slack(z, parameters)
        scale = parsed.scale(parameters)
        multiplier = parsed.price(multipliers, parameters)
        met = slack > ACTIVE * scale * (1 + float(np.max(np.abs(z))))
        if met or multiplier * scale <= ACTIVE * max(misfit, ACTIVE):  # an interior point's multipliers are not zero
            multiplier = 0.0
        gain = min(multiplier * parsed.step, misfit)
        prices.append(
            ShadowPrice(parsed.text, unit, max(slack, 0.0) / si, multiplier * si, parsed.step / si, gain, misfit)
        )
    return tuple(prices)


# --- extrapolation ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outside:
    """Rows, of ``count``, outside the measured joint ranges, and how many of them by each joint (from 1)."""

    count: int = 0
    rows: tuple[int, ...] = ()
    joints: Mapping[int, int] = field(default_factory=dict)

    def sentences(self) -> list[str]:
        """Return a sentence on the number of rows outside; empty if there are none."""
        if not self.rows:
            return []
        by = ", ".join(f"joint {joint}: {count}" for joint, count in self.joints.items())
        lie = "lies" if len(self.rows) == 1 else "lie"
        return [
            f"{len(self.rows)} of {self.count} rows {lie} well outside the measured joint ranges ({by}): no "
            "measurement checked the model there, and errors may exceed its intervals."
        ]


def measured_ranges(problem: Source) -> dict[str, Array]:
    """Return the minimum and maximum measured value of every joint (2, dof) [rad or m], by robot."""
    blocks = (block for part in problem.rows() for block in part.data.blocks)
    return widest((block.robot, np.stack([block.q.min(axis=(0, 1)), block.q.max(axis=(0, 1))])) for block in blocks)


def widest(ranges: Iterable[tuple[str, Array]]) -> dict[str, Array]:
    """Return the union of ranges (2, dof), by robot."""
    corrections: dict[str, Array] = {}
    for robot, (low, high) in ranges:
        least, most = corrections.get(robot, (low, high))
        corrections[robot] = np.stack([np.minimum(least, low), np.maximum(most, high)])
    return corrections


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
