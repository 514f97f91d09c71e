"""Simulated problem folders: tables made from a truth that is known, by a seed and one command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field
from scipy.optimize import least_squares

from rpim_opt.dataset import Block, Dataset, read_data
from rpim_opt.exceptions import InputError, choices
from rpim_opt.files import Length, Table, validate, write_text
from rpim_opt.instances import Stated, place_fixtures, read_problem
from rpim_opt.measurement import Measurement, of_fixture
from rpim_opt.parameters import Parameters, model_parameters
from rpim_opt.problem import CalibrationProblem
from rpim_opt.robot import Array
from rpim_opt.tables import csv_text
from rpim_opt.units import display, quantities

TORQUE = 20.0
"""Simulated joint torques are uniform up to this [Nm]."""


class _Simulation(Table):
    seed: int
    configurations: int = Field(gt=0)
    validation: int = Field(default=0, ge=0)
    spread: float = Field(default=1.0, ge=0)
    joint_share: float = Field(default=0.9, gt=0, le=1)
    blunders: int = Field(default=0, ge=0)
    blunder: Length = 0.0
    markers: dict[str, list[str]] = Field(default_factory=dict)
    truth: dict[str, Any] = Field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Simulated:
    """Tables by file name, and the truth they were made from: deviations [SI] by parameter, labels of blunders."""

    tables: Mapping[str, Mapping[str, list[str]]]
    deviations: Mapping[str, tuple[str, float]]
    blunders: tuple[str, ...]


def simulate(name: str | Path, seed: int | None = None) -> Simulated:
    """Make the tables of a problem folder that has a ``[simulation]`` table (README, "Simulated problems").

    True deviations are normal with the scales as standard deviations, times ``spread``, for every identified
    parameter; those of ``[simulation.truth]`` are fixed instead. Joint values are uniform in ``joint_share`` of
    the limits. Identification data carry the declared noise, validation data none.

    Parameters
    ----------
    name
        A problem folder; its tables need not exist yet.
    seed
        Instead of the file's.

    Raises
    ------
    InputError
        For a folder without ``[simulation]``, a joint without limits, a key that does not fit.
    """
    stated = read_problem(name)
    if not stated.table.simulation:
        raise InputError("table simulation", "nothing", "seed, configurations, ...", stated.path)
    plan = validate(_Simulation, stated.table.simulation, stated.path)
    rng = np.random.default_rng(plan.seed if seed is None else seed)
    if not np.isfinite(stated.robot.limits).all():
        raise InputError("key limits", "a joint without limits", "limits for every joint", stated.path)
    shapes = [_Shape.of(stated, plan, i) for i in range(len(stated.observations))]
    parameters = _parameters(stated, shapes)
    truth = _truth(parameters, plan, rng, stated.path)
    tables: dict[str, Mapping[str, list[str]]] = {}
    blunders: list[str] = []
    configurations = {"identification": plan.configurations, "validation": plan.validation}
    for role, count in configurations.items():
        q = _random_joints(stated, plan, rng, 2 * count)
        for shape, each in zip(shapes, stated.observations, strict=True):
            file = getattr(each, role)
            if file is None or not count:
                continue
            noisy = role == "identification"
            table, wrong = _table(
                stated, plan, shape, parameters, truth, q, noisy, rng, each.noise or stated.table.noise
            )
            tables[file] = table
            blunders += wrong
    free = parameters.free
    deviations = {n: (d, float(v)) for n, d, v in zip(free.names, free.dimensions, truth, strict=True)}
    return Simulated(tables, deviations, tuple(blunders))


def write_simulation(name: str | Path, seed: int | None = None, out: Path | None = None) -> list[Path]:
    """Write the tables of `simulate` and ``truth.toml`` into the folder, or into another; return the files."""
    made = simulate(name, seed)
    folder = out or read_problem(name).path.parent
    written = []
    for file, table in made.tables.items():
        written.append(folder / file)
        write_text(written[-1], csv_text(table))
    lines = [
        f"# made by: rpim-opt simulate {Path(name).name}",
        f"blunders = [{', '.join(map(repr, made.blunders))}]",
        "",
    ]
    lines += ["[deviation]"]
    for parameter, (dimension, value) in made.deviations.items():
        unit, si = display(dimension)
        lines.append(f"{parameter}_{unit} = {value / si:.12g}")
    written.append(folder / "truth.toml")
    write_text(written[-1], "\n".join(lines).replace("'", '"') + "\n")
    return written


@dataclass(frozen=True)
class _Shape:
    """Which reflectors and fixtures the rows of one observation involve."""

    kind: Measurement
    markers: tuple[str, ...]
    fixtures: tuple[str, ...]

    @classmethod
    def of(cls, stated: Stated, plan: _Simulation, i: int) -> _Shape:
        each = stated.observations[i]
        kind = stated.kinds[each.measurement]
        markers = tuple(plan.markers.get(each.identification, stated.tools))
        for marker in markers:
            if marker not in stated.tools:
                raise InputError("table simulation.markers", f"'{marker}'", choices(marker, stated.tools), stated.path)
        nested = [key for p in kind.parameters for key, value in stated.placed.get(p.partition("_")[0], {}).items()
                  if isinstance(value, dict)]  # fmt: skip
        return cls(kind, markers, tuple(dict.fromkeys(nested)) or ("",))


def _parameters(stated: Stated, shapes: Sequence[_Shape]) -> Parameters:
    blocks = []
    for shape in shapes:
        for fixture in shape.fixtures:
            empty = np.empty((0, shape.kind.points, stated.robot.dof))
            y, covariance = np.empty((0, len(shape.kind.columns))), np.empty((0, 1, 1))
            blocks.append(Block(shape.kind, empty, y, covariance, np.empty(0, dtype=int), fixture=fixture))
    nothing = Dataset(tuple(blocks), (), np.empty(0, dtype=int))
    own = place_fixtures(stated.placed, nothing)
    entries = {}
    for shape in shapes:
        for fixture in shape.fixtures:
            names = {n: of_fixture(n, fixture) for n in shape.kind.parameters}
            entries |= {names[n]: (d, own.get(names[n], 0.0)) for n, d in shape.kind.parameters.items()}
    base = (0.0,) * 6 if stated.base is None else stated.base
    return stated.chosen(model_parameters(stated.robot, base, stated.tools, entries), nothing)


def _truth(parameters: Parameters, plan: _Simulation, rng: np.random.Generator, path: Path) -> Array:
    free = parameters.free
    truth = plan.spread * rng.normal(size=len(free)) * free.scale
    dims = {name: (dimension,) for name, dimension in zip(free.names, free.dimensions, strict=True)}
    try:
        for (name, _), value in quantities(plan.truth, dims, "table simulation.truth").items():
            truth[free.names.index(name)] = value
    except InputError as error:
        raise error.within(path) from None
    return truth


def _random_joints(stated: Stated, plan: _Simulation, rng: np.random.Generator, count: int) -> Array:
    low, high = stated.robot.limits.T
    middle, half = (low + high) / 2, plan.joint_share * (high - low) / 2
    return rng.uniform(middle - half, middle + half, (count, stated.robot.dof))


def _table(
    stated: Stated,
    plan: _Simulation,
    shape: _Shape,
    parameters: Parameters,
    truth: Array,
    random: Array,
    noisy: bool,
    rng: np.random.Generator,
    noise: Mapping[str, Any],
) -> tuple[dict[str, list[str]], list[str]]:
    """Return the columns of one table as text, and the labels of its blunders."""
    robot, kind, count = stated.robot, shape.kind, len(random) // 2
    units = [display(dimension) for dimension in robot.joint_dimensions]
    constraint = not kind.columns
    if kind.points == 1:
        rows = [(k, (m,), f) for k in range(count) for m in shape.markers for f in shape.fixtures]
    else:
        rows = [(k, tuple(rng.choice(shape.markers, kind.points)), f) for k in range(count) for f in shape.fixtures]
    columns: dict[str, list[str]] = {"label": []}
    many = len(rows) > count
    if many:
        columns["configuration"] = [str(k) for k, _, _ in rows]
    prefixes = ["", "to_"][: kind.points]
    if shape.markers != ("",):
        for i, prefix in enumerate(prefixes):
            columns[f"{prefix}marker"] = [markers[i] for _, markers, _ in rows]
    if shape.fixtures != ("",):
        columns["fixture"] = [fixture for _, _, fixture in rows]
    columns["label"] = [f"c{k}{''.join(m) if many else ''}{f if len(shape.fixtures) > 1 else ''}" for k, m, f in rows]
    q = np.array([[random[k], random[count + k]][: kind.points] for k, _, _ in rows])
    compliant = any(n.startswith("compliance") for n in parameters.free.names)
    torque = rng.uniform(-TORQUE, TORQUE, q.shape).round(3) if compliant else None
    digits = 9 if constraint else 4
    for p, prefix in enumerate(prefixes):
        for i, (unit, si) in enumerate(units):
            columns[f"{prefix}q{i + 1}_{unit}"] = [f"{v:.{digits}f}" for v in q[:, p, i] / si]
            if torque is not None:
                columns[f"{prefix}tau{i + 1}_Nm"] = [f"{v:.3f}" for v in torque[:, p, i]]
    for name, dimension in kind.columns.items():
        columns[name if not dimension else f"{name}_{display(dimension)[0]}"] = ["1" if name == "qw" else "0"] * len(
            rows
        )
    data = read_data(columns, robot, noise, kind)
    problem = CalibrationProblem(robot, parameters, data)
    if constraint:
        sigma = np.sqrt(data.blocks[0].covariance[0, 0, 0])
        errors = sigma * rng.normal(size=len(rows)) * noisy
        q = _on_constraint(problem, truth, errors, rng, stated, plan)
        for i, (unit, si) in enumerate(units):
            columns[f"q{i + 1}_{unit}"] = [f"{v:.{digits}f}" for v in q[:, i] / si]
        return columns, []
    modelled = np.empty((len(rows), len(kind.columns)))
    for block, values in zip(data.blocks, problem.modelled(truth), strict=True):
        modelled[block.row] = values
    exact = _written(columns, kind, modelled)
    data = read_data(exact, robot, noise, kind)  # covariances at the true values: a tracker's depend on them
    y, k = modelled.copy(), len(kind.components)
    for block in data.blocks:
        L = np.linalg.cholesky(np.broadcast_to(block.covariance, (len(block.row), k, k)))
        e = (L @ rng.normal(size=(len(block.row), k, 1)))[:, :, 0]
        if noisy:
            y[block.row] = kind.plus(block.y, e)
    wrong: list[str] = []
    if noisy and plan.blunders:
        hit = rng.choice(len(rows), plan.blunders, replace=False)
        lengths = [i for i, d in enumerate(kind.columns.values()) if d == "length"]
        direction = rng.normal(size=(len(hit), len(lengths)))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        y[hit[:, None], np.array(lengths)] += plan.blunder * direction
        wrong = [columns["label"][i] for i in sorted(hit)]
    return _written(columns, kind, y), wrong


def _written(columns: Mapping[str, list[str]], kind: Measurement, y: Array) -> dict[str, list[str]]:
    """Return the columns with measured values in millimetres to a nanometre, quaternions to 1e-12."""
    result = dict(columns)
    for i, (name, dimension) in enumerate(kind.columns.items()):
        unit, si = display(dimension) if dimension else ("", 1.0)
        digits = 6 if dimension else 12
        result[f"{name}_{unit}" if unit else name] = [f"{v:.{digits}f}" for v in y[:, i] / si]
    return result


def _on_constraint(
    problem: CalibrationProblem,
    truth: Array,
    errors: Array,
    rng: np.random.Generator,
    stated: Stated,
    plan: _Simulation,
) -> Array:
    """Return joint values (N, dof) at which the residuals of a constraint are ``errors``, from random starts."""
    robot, result = stated.robot, []
    row_of = [(block, i) for block in problem.data.blocks for i in range(len(block.row))]
    order = np.argsort([block.row[i] for block, i in row_of])
    for n in order:
        block, i = row_of[n]
        one = block.take(np.array([i]), np.array([0]))

        def residual(q: Array, one: Block = one, wanted: float = float(errors[len(result)])) -> Array:
            rows = Dataset((replace(one, q=q[None, None]),), ("",), np.zeros(1, dtype=int))
            return problem.on(rows).residual(truth) - wanted

        for _ in range(100):
            start = _random_joints(stated, plan, rng, 1)[0]
            found = least_squares(residual, start, bounds=robot.limits.T, xtol=1e-15, ftol=1e-15, gtol=1e-15)
            if abs(found.fun[0]) < 1e-10:
                result.append(found.x)
                break
        else:
            raise InputError(
                "table simulation", "a plane or sphere out of reach", "one that the robot can touch", stated.path
            )
    return np.array(result)
