"""Simulated problem folders: tables made from a truth that is known, by a seed and one command."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import validate
from rpim_opt.basics.inputs import inside
from rpim_opt.basics.tables import csv_text
from rpim_opt.basics.units import display, quantities
from rpim_opt.basics.writing import write_files
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.data.models import of_fixture
from rpim_opt.problem.design import random_candidates
from rpim_opt.robot.model import model_parameters
from rpim_opt.robot.parameters import Parameters
from rpim_opt.store.fixtures import place_fixtures
from rpim_opt.store.problem_file import Observation, Stated, read_problem
from rpim_opt.store.simulated_table import Shape, simulated_table
from rpim_opt.store.simulated_world import Draws, Simulation, Truth


@dataclass(frozen=True, eq=False)
class Simulated:
    """Tables by file name, and the truth they were made from: deviations [SI] by parameter, labels of blunders."""

    tables: Mapping[str, Mapping[str, list[str]]]
    deviations: Mapping[str, tuple[str, float]]
    blunders: tuple[str, ...]


def simulate(name: str | Path, seed: int | None = None) -> Simulated:
    """Make the tables of a problem folder that has a ``[simulation]`` table (the guide "The command line").

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
    plan = validate(Simulation, stated.table.simulation, stated.path)
    rng = np.random.default_rng(plan.seed if seed is None else seed)
    if not np.isfinite(stated.robot.limits).all():
        raise InputError("key limits", "a joint without limits", "limits for every joint", stated.path)
    _require_tables(stated)
    shapes = [Shape.of(stated, plan, i) for i in range(len(stated.observations))]
    parameters = _parameters(stated, shapes)
    truth = Truth(parameters, _deviations(parameters, plan, rng, stated.path), plan)
    tables: dict[str, Mapping[str, list[str]]] = {}
    blunders: list[str] = []
    for role, count in (("identification", plan.configurations), ("validation", plan.validation)):
        # drawn where no table of that role is, too: other tables of the same seed stay as they are
        q = random_candidates(stated.robot, 2 * count, rng, plan.joint_share)
        for shape, each in _to_make(stated, shapes, role, count):
            draws = Draws(each.noise or stated.table.noise, rng, noisy=role == "identification")
            tables[getattr(each, role)], wrong = simulated_table(stated, shape, truth, q, draws)
            blunders += wrong
    return Simulated(tables, truth.by_name(), tuple(blunders))


def _require_tables(stated: Stated) -> None:
    """Refuse names that something else has: another table, or a file that is no table."""
    taken: set[Path] = set()
    for each in stated.observations:
        for role in ("identification", "validation"):
            file = getattr(each, role)
            if not file:
                continue
            if not file.lower().endswith(".csv"):
                raise InputError(f"key {role}", f"{file!r}", "a name ending in .csv, to be written", stated.path)
            place = inside(stated.path.parent, file, f"key {role}", stated.path).resolve()
            if place in taken:
                raise InputError(f"key {role}", f"{file!r} twice", "a name of its own for every table", stated.path)
            taken.add(place)


def _to_make(stated: Stated, shapes: Sequence[Shape], role: str, count: int) -> Iterator[tuple[Shape, Observation]]:
    """Yield the observations that have a table of a role."""
    for shape, each in zip(shapes, stated.observations, strict=True):
        if count and getattr(each, role):
            yield shape, each


def write_simulation(name: str | Path, seed: int | None = None, out: Path | None = None) -> list[Path]:
    """Write the tables of `simulate` and ``truth.toml`` into the folder, or into another; return the files.

    All of them lie in it: names that lead elsewhere are refused.
    """
    made = simulate(name, seed)
    folder = out or read_problem(name).path.parent
    texts = {file: csv_text(table, zip(*table.values(), strict=True)) for file, table in made.tables.items()}
    texts["truth.toml"] = _truth_text(name, made)
    places = {inside(folder, file, "the file", folder): text.encode() for file, text in texts.items()}
    write_files(places)
    return list(places)


def _truth_text(name: str | Path, made: Simulated) -> str:
    lines = [
        f"# made by: rpim-opt simulate {Path(name).name}",
        f"blunders = [{', '.join(map(repr, made.blunders))}]",
        "",
    ]
    lines += ["[deviation]"]
    for parameter, (dimension, value) in made.deviations.items():
        unit, si = display(dimension)
        key = f"{parameter}_{unit}".rstrip("_")
        lines.append(f"{key} = {value / si:.12g}")
    return "\n".join(lines).replace("'", '"') + "\n"


def _parameters(stated: Stated, shapes: Sequence[Shape]) -> Parameters:
    blocks = []
    for shape in shapes:
        for fixture in shape.fixtures:
            empty = np.empty((0, shape.kind.points, stated.robot.dof))
            y = np.empty((0, len(shape.kind.columns)))
            covariance = np.empty((0, 1, 1))
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


def _deviations(parameters: Parameters, plan: Simulation, rng: np.random.Generator, path: Path) -> Array:
    free = parameters.free
    truth = plan.spread * rng.normal(size=len(free)) * free.scale
    dims = {name: (dimension,) for name, dimension in zip(free.names, free.dimensions, strict=True)}
    try:
        for (name, _), value in quantities(plan.truth, dims, "table simulation.truth").items():
            truth[free.names.index(name)] = value
    except InputError as error:
        raise error.within(path) from None
    return truth
