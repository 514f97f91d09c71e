"""One table of a simulated problem: its rows, what an instrument reads there, and its mistakes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.units import display, joint_columns
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.models import Measurement
from rpim_opt.data.tables.reading import read_data
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.mdh import Robot
from rpim_opt.store.problem_file import Stated
from rpim_opt.store.seen_table import seen_table
from rpim_opt.store.simulated_world import Draws, Simulation, Truth
from rpim_opt.store.touched_table import touched_table
from rpim_opt.store.touching import touching_poses

TORQUE = 20.0
"""Simulated joint torques are uniform up to this [Nm]."""


@dataclass(frozen=True)
class Shape:
    """Which reflectors and fixtures the rows of one observation involve."""

    kind: Measurement
    markers: tuple[str, ...]
    fixtures: tuple[str, ...]

    @classmethod
    def of(cls, stated: Stated, plan: Simulation, i: int) -> Shape:
        """Return what the file states of its i-th observation."""
        each = stated.observations[i]
        kind = stated.kinds[each.measurement]
        markers = tuple(plan.markers.get(each.identification, stated.tools))
        for marker in markers:
            if marker not in stated.tools:
                raise InputError("table simulation.markers", f"'{marker}'", choices(marker, stated.tools), stated.path)
        tables = [stated.placed.get(name.partition("_")[0], {}) for name in kind.parameters]
        nested = [key for table in tables for key, value in table.items() if isinstance(value, dict)]
        return cls(kind, markers, tuple(dict.fromkeys(nested)) or ("",))


@dataclass
class Draft:
    """Rows of a table as text, and the joint values (N, p, dof) that stand in it [rad or m]."""

    robot: Robot
    shape: Shape
    rows: list[tuple[int, tuple[str, ...], str]]
    columns: dict[str, list[str]] = field(default_factory=dict)

    @property
    def prefixes(self) -> list[str]:
        """What precedes the columns of each point."""
        return ["", "to_"][: self.shape.kind.points]

    def name(self, count: int) -> None:
        """Write labels, and what tells rows of one configuration apart."""
        shape = self.shape
        several = len(self.rows) > count
        self.columns["label"] = [self._label(*row, several) for row in self.rows]
        if several:
            self.columns["configuration"] = [str(k) for k, _, _ in self.rows]
        if shape.markers != ("",):
            for i, prefix in enumerate(self.prefixes):
                self.columns[f"{prefix}marker"] = [markers[i] for _, markers, _ in self.rows]
        if shape.fixtures != ("",):
            self.columns["fixture"] = [fixture for _, _, fixture in self.rows]

    def _label(self, k: int, markers: tuple[str, ...], fixture: str, several: bool) -> str:
        label = f"c{k}"
        if several:
            label += "".join(markers)
        if len(self.shape.fixtures) > 1:
            label += fixture
        return label

    def write_joints(self, q: Array, torque: Array | None, digits: int) -> None:
        """Write the joint values (N, p, dof) of every point, each beside its torque [Nm] where there are torques."""
        for p, prefix in enumerate(self.prefixes):
            for i, (name, si) in enumerate(joint_columns(self.robot.joint_dimensions).items()):
                self.columns[prefix + name] = [f"{v:.{digits}f}" for v in q[:, p, i] / si]
                if torque is not None:
                    self.columns[f"{prefix}tau{i + 1}_Nm"] = [f"{v:.3f}" for v in torque[:, p, i]]

    def written(self, y: Array) -> dict[str, list[str]]:
        """Return the columns with measured values (N, c): millimetres to a nanometre, quaternions to 1e-12."""
        result = dict(self.columns)
        for i, (name, dimension) in enumerate(self.shape.kind.columns.items()):
            if dimension:
                unit, si = display(dimension)
                result[f"{name}_{unit}"] = [f"{v:.6f}" for v in y[:, i] / si]
            else:
                result[name] = [f"{v:.12f}" for v in y[:, i]]
        return result


def simulated_table(
    stated: Stated, shape: Shape, truth: Truth, random: Array, draws: Draws
) -> tuple[dict[str, list[str]], list[str]]:
    """Return the columns of one table as text, and the labels of its blunders.

    Parameters
    ----------
    stated, shape, truth
        The problem, the observation, and the world.
    random
        (2 count, dof) joint values, of which the second half are for second points.
    draws
        How the table is drawn.
    """
    kind = shape.kind
    if kind.touching:
        return touched_table(stated.robot, shape.markers, truth, draws), []
    count = len(random) // 2
    if kind.by_camera:
        return seen_table(stated, kind, truth, count, draws), []
    draft = Draft(stated.robot, shape, _rows(shape, count, draws.rng))
    draft.name(count)
    q = np.array([[random[k], random[count + k]][: kind.points] for k, _, _ in draft.rows])
    torque = None
    if truth.with_torques:
        torque = draws.rng.uniform(-TORQUE, TORQUE, q.shape).round(3)
    constraint = not kind.columns
    draft.write_joints(q, torque, 9 if constraint else 4)
    data = read_data(draft.written(_placeholder(kind, len(draft.rows))), stated.robot, draws.noise, kind)
    problem = CalibrationProblem(stated.robot, truth.parameters, data)
    if constraint:
        touching = _touching(problem, truth, draws, stated)
        draft.write_joints(touching[:, None], None, 9)
        return draft.columns, []
    exact = _modelled(problem, truth.x)
    # covariances at the true values: a tracker's depend on them
    data = read_data(draft.written(exact), stated.robot, draws.noise, kind)
    y = _read(data, exact, draws)
    wrong: list[int] = []
    if draws.noisy and truth.plan.blunders:
        wrong = _blunders(y, kind, truth.plan, draws.rng)
    return draft.written(y), [draft.columns["label"][i] for i in wrong]


def _placeholder(kind: Measurement, count: int) -> Array:
    """Return values (count, c) that a table may have before its own are known: no turn, where there are quaternions."""
    values = np.zeros((count, len(kind.columns)))
    values[:, [i for i, name in enumerate(kind.columns) if name == "qw"]] = 1.0
    return values


def _rows(shape: Shape, count: int, rng: np.random.Generator) -> list[tuple[int, tuple[str, ...], str]]:
    """Return configuration, reflectors and fixture of every row."""
    if shape.kind.points == 1:
        return [(k, (m,), f) for k in range(count) for m in shape.markers for f in shape.fixtures]
    points = shape.kind.points
    return [(k, tuple(rng.choice(shape.markers, points)), f) for k in range(count) for f in shape.fixtures]


def _touching(problem: CalibrationProblem, truth: Truth, draws: Draws, stated: Stated) -> Array:
    """Return joint values (N, dof) at which the robot touches, but for the declared noise."""
    block = problem.data.blocks[0]
    sigma = np.sqrt(block.covariance[0, 0, 0])
    errors = sigma * draws.rng.normal(size=len(problem.data)) * draws.noisy
    try:
        return touching_poses(problem, truth.x, errors, draws.rng, truth.plan.joint_share)
    except InputError as error:
        raise error.within(stated.path) from None


def _modelled(problem: CalibrationProblem, x: Array) -> Array:
    modelled = np.empty((len(problem.data), len(problem.data.blocks[0].measurement.columns)))
    for block, values in zip(problem.data.blocks, problem.modelled(x), strict=True):
        modelled[block.row] = values
    return modelled


def _read(data: Dataset, exact: Array, draws: Draws) -> Array:
    """Return what the instrument reads, (N, c) [SI]."""
    y = exact.copy()
    for block in data.blocks:
        e = draws.errors(block)
        if draws.noisy:
            y[block.row] = block.measurement.plus(block.y, e)
    return y


def _blunders(y: Array, kind: Measurement, plan: Simulation, rng: np.random.Generator) -> list[int]:
    """Move some rows of y by the length of a blunder, in random directions; return which."""
    hit = rng.choice(len(y), plan.blunders, replace=False)
    lengths = [i for i, dimension in enumerate(kind.columns.values()) if dimension == "length"]
    direction = rng.normal(size=(len(hit), len(lengths)))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    y[hit[:, None], np.array(lengths)] += plan.blunder * direction
    return sorted(hit.tolist())
