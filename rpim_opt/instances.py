"""Problem folders: ``robot.toml``, ``problem.toml`` and tables become a problem with its validation data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import Field

from rpim_opt.dataset import Dataset, read_csv
from rpim_opt.exceptions import InputError, choices
from rpim_opt.files import Angle, Length, Table, read_toml, validate
from rpim_opt.formulation import FORMULATIONS, Formulation
from rpim_opt.kinematics import FRAME
from rpim_opt.measurement import MEASUREMENTS
from rpim_opt.parameters import model_parameters
from rpim_opt.problem import CalibrationProblem
from rpim_opt.robot import read_robot
from rpim_opt.selection import SELECTORS, Selector

HERE = Path(__file__).resolve().parent
ROLES = ("identification", "validation")


@dataclass(frozen=True, eq=False)
class Instance:
    """A calibration problem as its folder states it.

    Parameters
    ----------
    title, source
        What it is, and where every figure comes from.
    problem
        Robot, parameters and identification data.
    validation
        Measurements that no step of the calibration may see; None when there are none.
    formulation, weight
        How the folder wants it solved.
    published
        Mean errors [mm] that the source prints for the same table, by role (identification,
        validation) and method, to show beside ours.
    reference
        Figures that a run must reproduce, by name: (value, tolerance).
    """

    title: str
    source: str
    problem: CalibrationProblem
    validation: Dataset | None
    formulation: Formulation
    weight: float | Selector
    published: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    reference: Mapping[str, tuple[float, float]] = field(default_factory=dict)


class _FrameTable(Table):
    x: Length = 0.0
    y: Length = 0.0
    z: Length = 0.0
    rx: Angle = 0.0
    ry: Angle = 0.0
    rz: Angle = 0.0


class _ProblemTable(Table):
    title: str
    source: str = ""
    robot: str = "robot.toml"
    measurement: str = "position"
    identification: str
    validation: str | None = None
    exclude: dict[str, str] = Field(default_factory=dict)
    identify: list[str] = Field(min_length=1)
    formulation: str = "tikhonov"
    selector: str = "l_curve"
    noise: dict[str, float | int] = Field(default_factory=dict)
    scale: dict[str, float | int] = Field(default_factory=dict)
    tolerance: dict[str, float | int] = Field(default_factory=dict)
    base: _FrameTable = _FrameTable()
    tool: _FrameTable = _FrameTable()
    published: dict[str, dict[str, float]] = Field(default_factory=dict)
    reference: dict[str, list[float]] = Field(default_factory=dict)
    variant: dict[str, dict[str, Any]] = Field(default_factory=dict)


def problems_folder() -> Path:
    """Return the folder of the problems that come with the package."""
    return next(p for p in (HERE / "problems", HERE.parent / "problems") if p.is_dir())


def find(name: str | Path) -> Path:
    """Return the folder of a problem, given its path or the name of one that comes with the package."""
    path = Path(name)
    if path.is_file() and path.name == "problem.toml":
        return path.parent
    if path.is_dir():
        return path
    known = sorted(p.name for p in problems_folder().iterdir() if (p / "problem.toml").is_file())
    if str(name) in known:
        return problems_folder() / str(name)
    raise InputError(
        "the problem", f"no folder '{name}'", "a folder with problem.toml, or " + choices(str(name), known)
    )


def load(name: str | Path, variant: str | None = None) -> Instance:
    """Return a problem from its folder, or from the name of one that comes with the package.

    Parameters
    ----------
    name
        A folder with ``problem.toml`` (its format: README, "Your own robot"), or ``"paper_arm"``.
    variant
        One of the file's ``[variant.NAME]`` tables, laid over the other keys.

    Raises
    ------
    InputError
        Naming the file, the row or key, what was found and what is accepted.
    """
    folder = find(name)
    path = folder / "problem.toml"
    content = read_toml(path)
    validate(_ProblemTable, content, path)
    if variant is not None:
        variants = content.get("variant", {})
        if variant not in variants:
            raise InputError("variant", f"'{variant}'", choices(variant, variants), path)
        content = _overlay({k: v for k, v in content.items() if k != "variant"}, variants[variant])
    table = validate(_ProblemTable, content, path)
    formulation = lookup(FORMULATIONS, table.formulation, "formulation", path)
    measurement = lookup(MEASUREMENTS, table.measurement, "measurement", path)
    robot = read_robot(folder / table.robot)
    base, tool = ([getattr(f, c) for c in FRAME] for f in (table.base, table.tool))
    try:
        parameters = model_parameters(robot, base, {"": tool}).identify(table.identify)
        parameters = parameters.scaled(table.scale).toleranced(table.tolerance)
        tables = [table.identification] + ([table.validation] if table.validation else [])
        data = [read_csv(folder / file, robot, table.noise, measurement) for file in tables]
    except InputError as error:
        raise error.within(path) from None
    labels = {label for part in data for label in part.label}
    for label in table.exclude:
        if label not in labels:
            raise InputError("key exclude", f"label '{label}'", "a label of the data", path)
    data = [part.without(table.exclude) for part in data]
    for file, part in zip(tables, data, strict=True):
        if not len(part):
            raise InputError("the table", "no row that is not excluded", "at least one", folder / file)
    for key in table.published:
        if not (folder / key).is_file():
            raise InputError("table published", f"'{key}'", "the name of a table in this folder", path)
    for key, pair in table.reference.items():
        if len(pair) != 2:
            raise InputError(f"key reference.{key}", f"{pair}", "[value, tolerance]", path)
    return Instance(
        title=table.title,
        source=table.source,
        problem=CalibrationProblem(robot, parameters, data[0], measurement),
        validation=data[1] if len(data) > 1 else None,
        formulation=formulation,
        weight=parse_weight(table.selector, path),
        published={role: table.published.get(file, {}) for role, file in zip(ROLES, tables, strict=False)},
        reference={key: (value, spread) for key, (value, spread) in table.reference.items()},
    )


def parse_weight(text: str, file: object = None) -> float | Selector:
    """Return the selector of that name, or the number that the text is."""
    try:
        value = float(text)
    except ValueError:
        return lookup(SELECTORS, text, "selector", file, "a number, ")
    if not 0 <= value < float("inf"):
        raise InputError("selector", f"'{text}'", "a finite number, zero or more", file)
    return value


def lookup(known: Mapping[str, Any], name: str, what: str, file: object = None, also: str = "") -> Any:
    """Return ``known[name]``, or list what there is."""
    if name not in known:
        raise InputError(f"key {what}", f"'{name}'", also + choices(name, known), file)
    return known[name]


def _overlay(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``base`` with the keys of ``over``; tables are merged, anything else is replaced."""
    merged = dict(base)
    for key, value in over.items():
        tables = isinstance(value, Mapping) and isinstance(base.get(key), Mapping)
        merged[key] = _overlay(base[key], value) if tables else value
    return merged
