"""One table of a simulated problem in which points or planes are touched that nobody measures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import joint_columns
from rpim_opt.data.contact import touches
from rpim_opt.data.models import revisit
from rpim_opt.data.tables.reading import read_data
from rpim_opt.problem.postures import postures_at
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.mdh import Robot
from rpim_opt.store.simulated_world import Draws, PlaneTable, Simulation, Truth

DIGITS = 9
"""Of joint values in degrees or millimetres: the noise is in them, and none may come from rounding."""


def touched_table(robot: Robot, markers: Sequence[str], truth: Truth, draws: Draws) -> dict[str, list[str]]:
    """Return the columns of a table as text.

    Parameters
    ----------
    robot, markers
        The nominal robot and its tools, which take turns.
    truth, draws
        The world, and how the table is drawn.
    """
    column, things = _things(truth.plan, draws)
    names = [name for name, places in things.items() for _ in places]
    table = {"label": [f"{name}_{i}" for name, places in things.items() for i in range(len(places))], column: names}
    turn = np.arange(len(names)) % len(markers)
    if len(markers) > 1:
        table["marker"] = [markers[k] for k in turn.tolist()]
    units = joint_columns(robot.joint_dimensions)
    still = {**table, **{name: ["0"] * len(names) for name in units}}
    declared = read_data(still, robot, draws.noise, revisit).blocks[0].covariance[0]
    errors = draws.rng.normal(size=(len(names), 3)) @ np.linalg.cholesky(declared).T
    targets = np.concatenate(list(things.values())) + draws.noisy * errors
    problem = CalibrationProblem(robot, truth.parameters, touches(np.zeros((1, robot.dof)), ["any"], 1.0))
    q = np.empty((len(names), robot.dof))
    for k, marker in enumerate(markers):
        mine = turn == k
        q[mine] = postures_at(problem, targets[mine], draws.rng, truth.x, truth.plan.joint_share, marker)
    for (name, si), values in zip(units.items(), q.T, strict=True):
        table[name] = [f"{v:.{DIGITS}f}" for v in values / si]
    return table


def _things(plan: Simulation, draws: Draws) -> tuple[str, dict[str, Array]]:
    """Return the column that names what is touched, and by name where (K, 3) [m]."""
    points, planes, each = plan.validation_points_mm, plan.validation_planes, plan.validation
    if draws.noisy:
        points, planes, each = plan.points_mm, plan.planes, plan.configurations
    if bool(points) == bool(planes):
        raise InputError("table simulation", "points_mm and planes", "one of them, for either table")
    if planes:
        return "plane", {name: _on(square, each, draws.rng) for name, square in planes.items()}
    return "point", {name: np.tile(_vector(place) / 1e3, (each, 1)) for name, place in points.items()}


def _vector(values: Sequence[float]) -> Array:
    if len(values) != 3:
        raise InputError("table simulation", f"{list(values)}", "three numbers, x, y and z")
    return np.array(values, dtype=float)


def _on(square: PlaneTable, count: int, rng: np.random.Generator) -> Array:
    """Return points (count, 3) [m] of a square, uniform."""
    normal = _vector(square.normal)
    normal = normal / np.sqrt(np.sum(normal**2))
    axis = np.eye(3)[int(np.argmin(np.abs(normal)))]
    first = axis - normal * np.sum(axis * normal)
    first = first / np.sqrt(np.sum(first**2))
    second = np.cross(normal, first)
    places = square.size * (rng.uniform(size=(count, 2)) - 0.5)
    return _vector(square.at_mm) / 1e3 + places[:, :1] * first + places[:, 1:] * second
