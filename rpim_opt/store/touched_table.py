"""One table of a simulated problem in which points or planes are touched that nobody measures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import joint_columns
from rpim_opt.data.contact import touches
from rpim_opt.data.models import revisit
from rpim_opt.data.reading import read_data
from rpim_opt.problem.postures import postures_at
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import Parameters

DIGITS = 9
"""Of joint values in degrees or millimetres: the noise is in them, and none may come from rounding."""


class Square(Protocol):
    """A square of a plane, in the robot's base frame: its middle [mm], its normal, its side [m]."""

    @property
    def at_mm(self) -> list[float]:
        """Its middle."""
        ...

    @property
    def normal(self) -> list[float]:
        """Its normal."""
        ...

    @property
    def size(self) -> float:
        """Its side."""
        ...


class Plan(Protocol):
    """What is touched, in the robot's base frame."""

    @property
    def configurations(self) -> int:
        """Touches of each for the identification."""
        ...

    @property
    def validation(self) -> int:
        """Touches of each for the validation."""
        ...

    @property
    def joint_share(self) -> float:
        """Part of every joint's range."""
        ...

    @property
    def points_mm(self) -> Mapping[str, list[float]]:
        """Points for the identification."""
        ...

    @property
    def validation_points_mm(self) -> Mapping[str, list[float]]:
        """Points for the validation."""
        ...

    @property
    def planes(self) -> Mapping[str, Square]:
        """Planes for the identification."""
        ...

    @property
    def validation_planes(self) -> Mapping[str, Square]:
        """Planes for the validation."""
        ...


def touched_table(
    robot: Robot,
    markers: Sequence[str],
    parameters: Parameters,
    x: Array,
    plan: Plan,
    noise: Mapping[str, Any],
    rng: np.random.Generator,
    noisy: bool,
) -> dict[str, list[str]]:
    """Return the columns of a table as text.

    Parameters
    ----------
    robot, markers
        The nominal robot and its tools, which take turns.
    parameters, x
        The world: parameters and their true deviations (n,) [SI].
    plan
        What is touched, and how often.
    noise
        What the table states of its noise.
    rng
        The draws.
    noisy
        Whether it identifies, with noise; it validates otherwise.
    """
    points, planes, each = plan.validation_points_mm, plan.validation_planes, plan.validation
    if noisy:
        points, planes, each = plan.points_mm, plan.planes, plan.configurations
    if bool(points) == bool(planes):
        raise InputError("table simulation", "points_mm and planes", "one of them, for either table")
    names = np.repeat(list(points or planes), each)
    targets = np.concatenate([np.tile(_vector(place), (each, 1)) / 1e3 for place in points.values()] or [[]])
    if planes:
        targets = np.concatenate([_on(square, each, rng) for square in planes.values()])
    column = "point"
    if planes:
        column = "plane"
    labels = [f"{name}_{i % each}" for i, name in enumerate(names)]
    table = {"label": labels, column: names.tolist()}
    if len(markers) > 1:
        table["marker"] = [markers[i % len(markers)] for i in range(len(names))]
    covariance = _covariance(table, robot, noise)
    errors = rng.normal(size=targets.shape) @ np.linalg.cholesky(covariance).T
    problem = CalibrationProblem(robot, parameters, touches(np.zeros((1, robot.dof)), ["any"], 1.0))
    q = np.empty((len(names), robot.dof))
    for k, marker in enumerate(markers):
        mine = np.arange(len(names)) % len(markers) == k
        q[mine] = postures_at(problem, (targets + noisy * errors)[mine], rng, x, plan.joint_share, marker)
    units = joint_columns(robot.joint_dimensions)
    for (name, si), values in zip(units.items(), q.T, strict=True):
        table[name] = [f"{v:.{DIGITS}f}" for v in values / si]
    return table


def _vector(values: Sequence[float]) -> Array:
    if len(values) != 3:
        raise InputError("table simulation", f"{list(values)}", "three numbers, x, y and z")
    return np.array(values, dtype=float)


def _on(square: Square, count: int, rng: np.random.Generator) -> Array:
    """Return points (count, 3) [m] of a square, uniform."""
    normal = _vector(square.normal)
    normal = normal / np.sqrt(np.sum(normal**2))
    axis = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = axis - normal * np.sum(axis * normal)
    first = first / np.sqrt(np.sum(first**2))
    second = np.cross(normal, first)
    places = square.size * (rng.uniform(size=(count, 2)) - 0.5)
    return _vector(square.at_mm) / 1e3 + places[:, :1] * first + places[:, 1:] * second


def _covariance(table: Mapping[str, list[str]], robot: Robot, noise: Mapping[str, Any]) -> Array:
    """Return the covariance (3, 3) [m^2] of a touch that a table declares."""
    still = {name: ["0"] * len(table["label"]) for name in joint_columns(robot.joint_dimensions)}
    return np.asarray(read_data({**table, **still}, robot, noise, revisit).blocks[0].covariance[0])
