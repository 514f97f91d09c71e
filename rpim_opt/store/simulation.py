"""Simulation of problem folders: tables from known true parameters and a seed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, in_file, pick
from rpim_opt.basics.files import inside, write_files
from rpim_opt.basics.schema import Length, Table, validate
from rpim_opt.basics.tables import csv_text
from rpim_opt.basics.units import display, joint_columns, quantities
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.data.measurements.camera import on_board
from rpim_opt.data.measurements.measurement import Measurement, of_fixture
from rpim_opt.data.tables.reading import read_data
from rpim_opt.problem.design import random_candidates
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.workspace import Target, configurations_at, visible_configurations
from rpim_opt.robot.parameters import Parameters, model_parameters
from rpim_opt.store.problem_file import Observation, ProblemFile, place_fixtures, read_problem

Columns = dict[str, list[str]]
MOST = 1_000_000  # largest number of configurations of a table
TORQUE = 20.0  # Simulated joint torques are uniform between plus and minus this [Nm].
DIGITS, EXACT_DIGITS, CAMERA_DIGITS = 4, 9, 5
"""Decimals of joint values in degrees or millimetres; for joint noise so many that rounding adds none."""
PREFIXES = ("", "to_")  # Prefixes of the columns of a row's points.
Place = Annotated[list[float], Field(min_length=3, max_length=3)]
Pixels = Annotated[int, Field(gt=0)]


class PlaneTable(Table):
    """A square plane to touch, in the robot's base frame."""

    at_mm: Place
    normal: Place
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
    points_mm: dict[str, Place] = Field(default_factory=dict)
    validation_points_mm: dict[str, Place] = Field(default_factory=dict)
    planes: dict[str, PlaneTable] = Field(default_factory=dict)
    validation_planes: dict[str, PlaneTable] = Field(default_factory=dict)
    image_px: list[Pixels] = Field(default=[1280, 960], min_length=2, max_length=2)
    truth: dict[str, Any] = Field(default_factory=dict)


def write_simulation(name: str | Path, seed: int | None = None, out: Path | None = None) -> list[Path]:
    """Write the tables of a problem folder that has a ``[simulation]`` table (the guide "The command line").

    They are written to the folder, or to ``out``, with ``truth.toml``: true deviations and labels of blunders. Return
    the files. True deviations of identified parameters are normal with the scales as standard deviations, times
    ``spread``; those in ``[simulation.truth]`` are fixed. Joint values are uniform in ``joint_share`` of the limits.
    Identification data have the declared noise, validation data none. The tables need not exist.
    """
    definition = read_problem(name)
    if not definition.table.simulation:
        raise InputError("table simulation", "nothing", "seed, configurations, ...", definition.path)
    plan = validate(Simulation, definition.table.simulation, definition.path, "simulation")
    rng = np.random.default_rng(plan.seed if seed is None else seed)
    fixtures, parameters = _parameters(definition)
    free = parameters.free
    x = plan.spread * rng.normal(size=len(free)) * free.scale
    dimensions = {name: (dimension,) for name, dimension in zip(free.names, free.dimensions, strict=True)}
    with in_file(definition.path):
        for (name, _), value in quantities(plan.truth, dimensions, "table simulation.truth").items():
            x[free.names.index(name)] = value
    folder = out or definition.path.parent
    texts: dict[Path, str] = {}
    blunders: list[str] = []
    for role, count in (("identification", plan.configurations), ("validation", plan.validation)):
        with in_file(definition.path):
            # drawn even without a table of that role: other tables of the same seed do not change
            q = random_candidates(definition.robot, 2 * count, rng, plan.joint_share)
        for each, of in zip(definition.observations, fixtures, strict=True):
            file = getattr(each, role)
            if not (count and file):
                continue
            place = inside(folder, file, f"key {role}", definition.path)
            if place.suffix.lower() != ".csv" or place.resolve() in map(Path.resolve, texts):
                raise InputError(f"key {role}", f"{file!r}", "a unique name for every table, in .csv", definition.path)
            markers = tuple(plan.markers.get(each.identification, definition.tools))
            for marker in markers:
                pick(definition.tools, marker, "table simulation.markers", definition.path)
            kind = definition.kinds[each.measurement]
            maker = _Table(definition, plan, parameters, x, each, kind, markers, of, rng, role == "identification")
            columns, wrong = maker.made(q)
            texts[place] = csv_text(columns, zip(*columns.values(), strict=True))
            blunders += wrong
    labels = ", ".join(f'"{label}"' for label in blunders)
    lines = [f"# made by: rpim-opt simulate {Path(name).name}", f"blunders = [{labels}]", "", "[deviation]"]
    for parameter, dimension, value in zip(free.names, free.dimensions, x.tolist(), strict=True):
        unit, si = display(dimension)
        lines.append(f"{f'{parameter}_{unit}'.rstrip('_')} = {value / si:.12g}")
    texts[inside(folder, "truth.toml", "the file", folder)] = "\n".join(lines) + "\n"
    write_files({place: text.encode() for place, text in texts.items()})
    return list(texts)


def _parameters(stated: ProblemFile) -> tuple[list[tuple[str, ...]], Parameters]:
    """Return the fixtures of every observation, and the parameters that the file identifies."""
    fixtures: list[tuple[str, ...]] = []
    none = np.empty(0, dtype=int)
    blocks = []  # without rows, for every measurement and fixture with own parameters
    for each in stated.observations:
        kind = stated.kinds[each.measurement]
        places = [stated.placed.get(name.partition("_")[0], {}) for name in kind.parameters]
        nested = [key for table in places for key, value in table.items() if isinstance(value, dict)]
        fixtures.append(tuple(dict.fromkeys(nested)) or ("",))  # one without a name is the only one
        empty = np.empty((0, kind.points, stated.robot.dof)), np.empty((0, len(kind.columns))), np.empty((0, 1, 1))
        blocks += [Block(kind, *empty, none, fixture=fixture) for fixture in fixtures[-1]]
    nothing = Dataset(tuple(blocks), (), none)
    own = place_fixtures(stated.placed, nothing)
    entries = {}
    for block in blocks:
        for name, dimension in block.measurement.parameters.items():
            whole = of_fixture(name, block.fixture)
            entries[whole] = dimension, own.get(whole, 0.0)
    base = (0.0,) * 6 if stated.base is None else stated.base
    return fixtures, stated.chosen(model_parameters(stated.robot, base, stated.tools, entries), nothing)


@dataclass(frozen=True, eq=False)
class _Table:
    """One table of the true deviations ``x`` (n,) [SI]; it is noisy where it identifies, with the same draws if not."""

    stated: ProblemFile
    plan: Simulation
    parameters: Parameters
    x: Array
    observation: Observation
    kind: Measurement
    markers: tuple[str, ...]
    fixtures: tuple[str, ...]
    rng: np.random.Generator
    noisy: bool

    def made(self, random: Array) -> tuple[Columns, list[str]]:
        """Return the columns as text, and the labels of blunders, from joint values (2 count, dof) [rad or m]."""
        if self.kind.touching:
            return self._touched(), []
        if self.kind.by_camera:
            return self._seen(len(random) // 2), []
        kind = self.kind
        count = len(random) // 2
        columns, rows = self._labelled(count)
        q = np.array([[random[k], random[count + k]][: kind.points] for k in rows])
        torque = None
        if self.plan.torques == "measured" and any(n.startswith("compliance") for n in self.parameters.free.names):
            torque = self.rng.uniform(-TORQUE, TORQUE, q.shape).round(3)
        constraint = not kind.columns  # configurations on a plane or sphere
        columns |= self._joints(q, EXACT_DIGITS if constraint else DIGITS, torque)
        values = np.zeros((len(rows), len(kind.columns)))
        values[:, [i for i, name in enumerate(kind.columns) if name == "qw"]] = 1.0  # no rotation
        data = self._read({**columns, **self._values(values)})
        problem = CalibrationProblem(self.stated.robot, self.parameters, data)
        if constraint:
            sigma = np.sqrt(data.blocks[0].covariance[0, 0, 0])
            errors = sigma * self.rng.normal(size=len(data)) * self.noisy
            return columns | self._joints(self._touching(problem, errors)[:, None], EXACT_DIGITS), []
        for block, modelled in zip(data.blocks, problem.modelled(self.x), strict=True):
            values[block.row] = modelled
        # covariances at the true values: a tracker's depend on them
        for block in self._read({**columns, **self._values(values)}).blocks:
            errors = self._errors(block)
            if self.noisy:
                values[block.row] = kind.plus(block.y, errors)
        if not self.noisy or not self.plan.blunders:
            return columns | self._values(values), []
        # displaced by the length of a blunder, in random directions
        hit = self.rng.choice(len(values), self.plan.blunders, replace=False)
        lengths = [i for i, dimension in enumerate(kind.columns.values()) if dimension == "length"]
        direction = self.rng.normal(size=(len(hit), len(lengths)))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        values[hit[:, None], np.array(lengths)] += self.plan.blunder * direction
        return columns | self._values(values), [columns["label"][i] for i in sorted(hit.tolist())]

    def _touching(self, problem: CalibrationProblem, wanted: Array) -> Array:
        """Return joint values (N, dof) at which a constraint's residuals are the wanted ones (N,) [m]."""

        def away(q: Array, rows: np.ndarray) -> Array:
            data = problem.data.take(rows)
            blocks = tuple(replace(block, q=q[block.row][:, None]) for block in data.blocks)
            posed = problem.on(Dataset(blocks, data.label, data.configuration))
            residual = np.empty(len(q))
            residual[np.concatenate([block.row for block in blocks])] = posed.residual(self.x)
            return (residual - wanted[rows])[:, None]

        target = Target(problem.robot, away, damping=1e-20)  # larger damping would change the last digits of tables
        # its own generator: draws of other tables do not depend on the number needed
        q, beyond = target.reached(len(wanted), self.rng.spawn(1)[0], self.plan.joint_share)
        if beyond is not None:
            found = "a plane or sphere out of reach"
            raise InputError("table simulation", found, "a surface within reach", self.stated.path)
        return q

    def _labelled(self, count: int) -> tuple[Columns, list[int]]:
        """Return labels, what tells rows of one configuration apart, and every row's configuration."""
        points = self.kind.points
        if points == 1:
            rows = [(k, (m,), f) for k in range(count) for m in self.markers for f in self.fixtures]
        else:
            rows = [(k, tuple(self.rng.choice(self.markers, points)), f) for k in range(count) for f in self.fixtures]
        several = len(rows) > count
        columns = {"label": [f"c{k}{''.join(m) * several}{f * (len(self.fixtures) > 1)}" for k, m, f in rows]}
        if several:
            columns["configuration"] = [str(k) for k, _, _ in rows]
        for i, prefix in enumerate(PREFIXES[:points] if self.markers != ("",) else ()):
            columns[f"{prefix}marker"] = [row[1][i] for row in rows]
        if self.fixtures != ("",):
            columns["fixture"] = [fixture for _, _, fixture in rows]
        return columns, [k for k, _, _ in rows]

    def _joints(self, q: Array, digits: int, torque: Array | None = None) -> Columns:
        """Return the joint values (N, p, dof) of every point, each beside its torque [Nm] where there are torques."""
        columns = {}
        for p, prefix in enumerate(PREFIXES[: self.kind.points]):
            for i, (name, si) in enumerate(joint_columns(self.stated.robot.joint_dimensions).items()):
                columns[prefix + name] = [f"{v:.{digits}f}" for v in q[:, p, i] / si]
                if torque is not None:
                    columns[f"{prefix}tau{i + 1}_Nm"] = [f"{v:.3f}" for v in torque[:, p, i]]
        return columns

    def _values(self, y: Array) -> Columns:
        """Return measured values (N, c): millimetres to a nanometre, quaternions to 1e-12."""
        columns = {}
        for i, (name, dimension) in enumerate(self.kind.columns.items()):
            unit, si = display(dimension)
            columns[f"{name}_{unit}".rstrip("_")] = [f"{v:.{6 if unit else 12}f}" for v in y[:, i] / si]
        return columns

    def _read(self, columns: Mapping[str, Sequence[Any]]) -> Dataset:
        noise = self.observation.noise or self.stated.table.noise
        return read_data(columns, self.stated.robot, noise, self.kind)

    def _errors(self, block: Block) -> Array:
        """Return errors (N, k) of the declared covariance; zero without noise."""
        k = len(block.measurement.components)
        L = np.linalg.cholesky(np.broadcast_to(block.covariance, (len(block.row), k, k)))
        return self.noisy * (L @ self.rng.normal(size=(len(block.row), k, 1)))[:, :, 0]

    def _seen(self, count: int) -> Columns:
        """Return a camera's table: configurations in which it sees its whole board, and where every point appears."""
        definition, plan, board = self.stated, self.plan, self.stated.board
        if board is None:
            raise InputError("key target", "nothing", "the points of the board that the camera sees", definition.path)
        names = list(board)
        joints = list(joint_columns(definition.robot.joint_dimensions))
        one = self._read(on_board({"point": names[:1], **{n: ["0"] for n in ("u_px", "v_px", *joints)}}, board))
        world = CalibrationProblem(definition.robot, self.parameters, one)
        width, height = plan.image_px
        points = np.array(list(board.values()))
        q = visible_configurations(world, points, count, self.rng, self.x, plan.joint_share, (width, height))
        table: Columns = {"label": [f"v{k}/{name}" for k in range(count) for name in names], "point": names * count}
        table |= self._joints(np.repeat(q, len(names), axis=0)[:, None], CAMERA_DIGITS)
        data = self._read(on_board({**table, **dict.fromkeys(("u_px", "v_px"), ["0"] * len(table["label"]))}, board))
        y = world.on(data).modelled(self.x)[0] + self._errors(data.blocks[0])
        return {**table, "u_px": [f"{u:.4f}" for u in y[:, 0]], "v_px": [f"{v:.4f}" for v in y[:, 1]]}

    def _touched(self) -> Columns:
        """Return a table of touches, by tools that take turns."""
        plan, robot, markers = self.plan, self.stated.robot, self.markers
        points, planes, each = plan.validation_points_mm, plan.validation_planes, plan.validation
        if self.noisy:
            points, planes, each = plan.points_mm, plan.planes, plan.configurations
        if bool(points) == bool(planes):
            raise InputError("table simulation", "points_mm and planes", "one of them, for both tables")
        things = {name: np.tile(np.array(place, dtype=float) / 1e3, (each, 1)) for name, place in points.items()}
        for name, square in planes.items():  # positions uniform on it
            normal = np.array(square.normal, dtype=float)
            normal /= np.linalg.norm(normal)
            axis = np.eye(3)[int(np.argmin(np.abs(normal)))]
            first = axis - normal * np.sum(axis * normal)
            first /= np.linalg.norm(first)
            along = square.size * (self.rng.uniform(size=(each, 2)) - 0.5)
            on_plane = along[:, :1] * first + along[:, 1:] * np.cross(normal, first)
            things[name] = np.array(square.at_mm) / 1e3 + on_plane
        names = [name for name in things for _ in range(each)]
        labels = [f"{name}_{i}" for name in things for i in range(each)]
        table = {"label": labels, "plane" if planes else "point": names}
        turn = np.arange(len(names)) % len(markers)
        if len(markers) > 1:
            table["marker"] = [markers[k] for k in turn.tolist()]
        q = np.zeros((len(names), robot.dof))
        touching = self._read({**table, **self._joints(q[:, None], 0)})
        declared = touching.blocks[0].covariance[0]
        errors = self.rng.normal(size=(len(names), 3)) @ np.linalg.cholesky(declared).T
        targets = np.concatenate(list(things.values())) + self.noisy * errors
        problem = CalibrationProblem(robot, self.parameters, touching)
        for k, marker in enumerate(markers):
            mine = turn == k
            q[mine] = configurations_at(problem, targets[mine], self.rng, self.x, plan.joint_share, marker)
        return table | self._joints(q[:, None], EXACT_DIGITS)
