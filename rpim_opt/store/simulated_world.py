"""What is simulated: the keys of ``[simulation]``, the world that they make, and how a table of it is drawn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.files import Length, Table
from rpim_opt.data.dataset import Block
from rpim_opt.robot.parameters import Parameters

MOST = 1_000_000
"""Configurations of a table."""


class PlaneTable(Table):
    """A square of a plane that is touched, in the robot's base frame."""

    at_mm: list[float]
    normal: list[float]
    size: Length


class Simulation(Table):
    """The keys of ``[simulation]``."""

    seed: int = Field(ge=0)
    configurations: int = Field(gt=0, le=MOST)
    validation: int = Field(default=0, ge=0, le=MOST)
    spread: float = Field(default=1.0, ge=0)
    joint_share: float = Field(default=0.9, gt=0, le=1)
    blunders: int = Field(default=0, ge=0)
    blunder: Length = 0.0
    markers: dict[str, list[str]] = Field(default_factory=dict)
    torques: Literal["measured", "gravity"] = "measured"
    points_mm: dict[str, list[float]] = Field(default_factory=dict)
    validation_points_mm: dict[str, list[float]] = Field(default_factory=dict)
    planes: dict[str, PlaneTable] = Field(default_factory=dict)
    validation_planes: dict[str, PlaneTable] = Field(default_factory=dict)
    image_px: list[int] = Field(default=[1280, 960])
    truth: dict[str, Any] = Field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Truth:
    """The world that is simulated: the parameters, their true deviations (n,) [SI], and what happens to tables."""

    parameters: Parameters
    x: Array
    plan: Simulation

    @property
    def with_torques(self) -> bool:
        """Whether joints give way to torques that tables state, and not to those of gravity."""
        return self.plan.torques == "measured" and any(
            name.startswith("compliance") for name in self.parameters.free.names
        )

    def by_name(self) -> dict[str, tuple[str, float]]:
        """Return dimension and deviation [SI] by parameter."""
        free = self.parameters.free
        named = zip(free.names, free.dimensions, self.x, strict=True)
        return {name: (dimension, float(value)) for name, dimension, value in named}


class Draws(NamedTuple):
    """How a table of the world is drawn.

    Parameters
    ----------
    noise
        What the table states of its noise.
    rng
        The draws: their order is that of the table's making.
    noisy
        Whether the table identifies, with noise and blunders; it validates otherwise, without.
    """

    noise: Mapping[str, Any]
    rng: np.random.Generator
    noisy: bool

    def errors(self, block: Block) -> Array:
        """Return errors (N, k) of the declared covariance; zero without noise, though drawn all the same."""
        k = len(block.measurement.components)
        L = np.linalg.cholesky(np.broadcast_to(block.covariance, (len(block.row), k, k)))
        return self.noisy * (L @ self.rng.normal(size=(len(block.row), k, 1)))[:, :, 0]
