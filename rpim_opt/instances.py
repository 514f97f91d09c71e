"""Problem folders: ``robot.toml``, ``problem.toml`` and tables become a problem with its validation data."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

import cvxpy as cp
import numpy as np
from pydantic import Field

from rpim_opt.constraints import Constraint, at_nominal, equal, signed
from rpim_opt.dataset import Dataset, read_data
from rpim_opt.exceptions import InputError, choices
from rpim_opt.exchange.chain import Described
from rpim_opt.exchange.plain import read_mdh
from rpim_opt.exchange.urdf import read_urdf
from rpim_opt.files import Angle, Length, Table, read_toml, validate
from rpim_opt.formulation import FORMULATIONS, Formulation
from rpim_opt.frames import starting_parameters
from rpim_opt.kinematics import FRAME
from rpim_opt.measurement import MEASUREMENTS, Measurement, of_fixture
from rpim_opt.observability import near_parallel
from rpim_opt.parameters import Parameters
from rpim_opt.problem import CalibrationProblem
from rpim_opt.record import Record
from rpim_opt.robot import Robot
from rpim_opt.selection import SELECTORS, Selector
from rpim_opt.tables import robodk_columns
from rpim_opt.units import quantities, split_unit

HERE = Path(__file__).resolve().parent
ROLES = ("identification", "validation")
ROBOT_FILES = (".toml", ".urdf", ".csv", ".json")


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
    simulation
        How the tables were simulated; empty for real measurements.
    files
        SHA-256 of the files that were read, by name.
    excluded
        Rows that the folder leaves out, label to reason.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> result = ro.calibrate(instance.problem, instance.formulation, instance.weight)
    >>> instance.record.title, instance.excluded["T8-7"], instance.published["validation"]["RPIM"]
    ("The paper's cooperative manipulator", 'z misprinted, off by 15.0 mm', 0.468)
    """

    title: str
    source: str
    problem: CalibrationProblem
    validation: Dataset | None
    formulation: Formulation
    weight: float | Selector
    published: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    reference: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    simulation: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    excluded: Mapping[str, str] = field(default_factory=dict)

    @property
    def record(self) -> Record:
        """What a saved result and its report say of the data: title, source, validation data, files, excluded rows."""
        return Record(self.title, self.source, self.validation, self.files, self.excluded, bool(self.simulation))


class _FrameTable(Table):
    x: Length = 0.0
    y: Length = 0.0
    z: Length = 0.0
    rx: Angle = 0.0
    ry: Angle = 0.0
    rz: Angle = 0.0


class _Observation(Table):
    measurement: str = "position"
    layout: Literal["named", "robodk"] = "named"
    identification: str
    validation: str | None = None
    noise: dict[str, Any] = Field(default_factory=dict)


class _Constraints(Table):
    at_nominal: list[str] = Field(default_factory=list)
    positive: list[str] = Field(default_factory=list)
    negative: list[str] = Field(default_factory=list)
    equal: list[list[str]] = Field(default_factory=list)

    def all(self) -> tuple[Constraint, ...]:
        boxes = [
            (self.at_nominal, at_nominal),
            (self.positive, partial(signed, 1)),
            (self.negative, partial(signed, -1)),
        ]
        return (*(make(*patterns) for patterns, make in boxes if patterns), *(equal(*names) for names in self.equal))


class _ProblemTable(Table):
    title: str
    source: str = ""
    robot: str = "robot.toml"
    urdf_base: str | None = None
    urdf_tip: str | None = None
    measurement: str = "position"
    layout: Literal["named", "robodk"] = "named"
    identification: str | None = None
    validation: str | None = None
    observation: list[_Observation] = Field(default_factory=list)
    exclude: dict[str, str] = Field(default_factory=dict)
    identify: list[str] | Literal["auto"]
    formulation: str = "tikhonov"
    selector: str = "reml"
    noise: dict[str, Any] = Field(default_factory=dict)
    scale: dict[str, float | int] = Field(default_factory=dict)
    tolerance: dict[str, float | int] = Field(default_factory=dict)
    constraints: _Constraints = _Constraints()
    base: dict[str, Any] | Literal["auto"] = Field(default_factory=dict)
    tool: dict[str, Any] = Field(default_factory=dict)
    published: dict[str, dict[str, float]] = Field(default_factory=dict)
    reference: dict[str, list[float]] = Field(default_factory=dict)
    simulation: dict[str, Any] = Field(default_factory=dict)
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


def load(name: str | Path, variant: str | None = None, measurements: Sequence[Measurement] = ()) -> Instance:
    """Return a problem from its folder, or from the name of one that comes with the package.

    Parameters
    ----------
    name
        A folder with ``problem.toml`` (its format: README, "Your own robot"), that file, or the name of one that comes
        with the package.
    variant
        One of the file's ``[variant.NAME]`` tables, laid over the other keys.
    measurements
        Measurement models of your own that the file may name.

    Raises
    ------
    InputError
        Naming the file, the row or key, what was found and what is accepted.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm", variant="swap")  # the 16 points for the 9, and the other way round
    >>> len(instance.problem.data), len(instance.validation), instance.formulation.name
    (16, 9, 'Tikhonov')
    """
    stated = read_problem(name, variant, measurements)
    table, path, robot, folder = stated.table, stated.path, stated.robot, stated.path.parent
    sets: dict[str, list[Dataset]] = {role: [] for role in ROLES}
    names: dict[str, list[str]] = {role: [] for role in ROLES}
    files: dict[str, list[str]] = {role: [] for role in ROLES}
    tcps = {m: [1e3 * v for v in frame[:3]] for m, frame in stated.tools.items() if table.tool}
    for each in stated.observations:
        kind = stated.kinds[each.measurement]
        for role in ROLES:
            file = getattr(each, role)
            if not file:
                continue
            robodk = each.layout == "robodk"
            try:
                source: Any = robodk_columns(folder / file, robot.joint_dimensions, tcps) if robodk else folder / file
                sets[role].append(read_data(source, robot, each.noise or table.noise, kind))
            except InputError as error:
                raise error.within(folder / file if robodk and error.where.startswith("row") else path) from None
            names[role].append(Path(file).stem)
            files[role].append(file)
    tools = dict(stated.tools)
    if any(each.layout == "robodk" for each in stated.observations):
        tools = {m: tools.get(m, (*(1e-3 * v for v in tcp), 0.0, 0.0, 0.0)) for m, tcp in tcps.items()}
    data = {role: Dataset.together(parts, names[role]) for role, parts in sets.items() if parts}
    labels = {label for part in data.values() for label in part.label}
    for label in table.exclude:
        if label not in labels:
            raise InputError("key exclude", f"label '{label}'", "a label of the data", path)
    for role, part in data.items():
        data[role] = part.without(table.exclude)
        if not len(data[role]):
            raise InputError("the table", "no row that is not excluded", "at least one", folder / files[role][0])
    try:
        own = place_fixtures(stated.placed, data["identification"])
        parameters = starting_parameters(robot, data["identification"], stated.base, tools, own)
        parameters = stated.chosen(parameters, data["identification"])
        problem = CalibrationProblem(robot, parameters, data["identification"])
        if "validation" in data:
            problem.on(data["validation"])
    except InputError as error:
        raise error.within(path) from None
    drawing = find_robot(table.robot, folder)
    used = {path.name: path, drawing.name: drawing, **{file: folder / file for role in ROLES for file in files[role]}}
    formulation = lookup(FORMULATIONS, table.formulation, "formulation", path)
    formulation = replace(formulation, constraints=(*formulation.constraints, *table.constraints.all()))
    try:
        for constraint in formulation.constraints:
            constraint(cp.Variable(len(problem.parameters.free)), problem.parameters.free)
    except InputError as error:
        raise error.within(path) from None
    for key in table.published:
        if not (folder / key).is_file():
            raise InputError("table published", f"'{key}'", "the name of a table in this folder", path)
    for key, pair in table.reference.items():
        if len(pair) != 2:
            raise InputError(f"key reference.{key}", f"{pair}", "[value, tolerance]", path)
    return Instance(
        title=table.title,
        source=table.source,
        problem=problem,
        validation=data.get("validation"),
        formulation=formulation,
        weight=parse_weight(table.selector, path),
        published={role: table.published.get(files[role][0], {}) for role in ROLES if files[role]},
        reference={key: (value, spread) for key, (value, spread) in table.reference.items()},
        simulation=table.simulation,
        files={name: sha256(file.read_bytes()).hexdigest() for name, file in used.items()},
        excluded=table.exclude,
    )


@dataclass(frozen=True, eq=False)
class Stated:
    """What a problem file states, checked, before any table is read."""

    path: Path
    table: _ProblemTable
    placed: Mapping[str, Any]
    robot: Robot
    kinds: Mapping[str, Measurement]
    observations: tuple[_Observation, ...]
    tools: Mapping[str, tuple[float, ...]]
    base: tuple[float, ...] | None

    def chosen(self, parameters: Parameters, data: Dataset) -> Parameters:
        """Return the parameters with the file's scales and tolerances, and those identified that it names."""
        table = self.table
        parameters = parameters.scaled(table.scale, self.path).toleranced(table.tolerance, self.path)
        patterns = proposed(self.robot, parameters, data) if table.identify == "auto" else table.identify
        return parameters.identify(patterns)


def read_problem(name: str | Path, variant: str | None = None, measurements: Sequence[Measurement] = ()) -> Stated:
    """Return what a problem file states; arguments and errors as for `load`."""
    path = find(name) / "problem.toml"
    content = read_toml(path)
    kinds = {**MEASUREMENTS, **{m.name: m for m in measurements}}
    fixtures = {p.partition("_")[0] for kind in kinds.values() for p in kind.parameters}
    table, placed = _split(content, fixtures, path)
    if variant is not None:
        variants = content.get("variant", {})
        if variant not in variants:
            raise InputError("variant", f"'{variant}'", choices(variant, variants), path)
        content = _overlay({k: v for k, v in content.items() if k != "variant"}, variants[variant])
        table, placed = _split(content, fixtures, path)
    observations = list(table.observation)
    if table.identification is not None:
        first = {f: getattr(table, f) for f in ("measurement", "layout", "identification", "validation")}
        observations.insert(0, _Observation.model_construct(**first, noise={}))
    if not observations:
        raise InputError("key identification", "nothing", "the name of a table, or [[observation]] tables", path)
    for each in observations:
        lookup(kinds, each.measurement, "measurement", path)
    lookup(FORMULATIONS, table.formulation, "formulation", path)
    parse_weight(table.selector, path)
    several = bool(table.tool) and not any(split_unit(key)[0] in FRAME for key in table.tool)
    tools = {m: _frame(t, f"tool.{m}", path) for m, t in table.tool.items()} if several else {}
    file = find_robot(table.robot, path.parent)
    if file.suffix != ".urdf" and (table.urdf_base or table.urdf_tip):
        raise InputError("key urdf_base, urdf_tip", f"a robot '{table.robot}'", "a robot in a file .urdf", path)
    arm = read_arm(file, table.urdf_base, table.urdf_tip)
    return Stated(
        path=path,
        table=table,
        placed=placed,
        robot=arm.robot,
        kinds=kinds,
        observations=tuple(observations),
        tools=tools or {"": _frame(table.tool, "tool", path) if table.tool else tuple(arm.tool)},
        base=None if table.base == "auto" else _frame(table.base, "base", path) if table.base else tuple(arm.base),
    )


def _split(content: dict[str, Any], fixtures: set[str], path: Path) -> tuple[_ProblemTable, dict[str, Any]]:
    """Return the checked table, and apart from it those that place a measurement's anchor, plane, ..."""
    placed = {key: value for key, value in content.items() if key in fixtures and isinstance(value, dict)}
    return validate(_ProblemTable, {k: v for k, v in content.items() if k not in placed}, path), placed


def _frame(table: Any, where: str, path: Path) -> tuple[float, ...]:
    if not isinstance(table, dict):
        raise InputError(f"key {where}", repr(table)[:60], "a table with x_mm, ..., rz_deg", path)
    try:
        place = validate(_FrameTable, table, path)
    except InputError as error:
        where = f"key {where}" + error.where.removeprefix("key").replace(" the top level", "").replace(" ", ".", 1)
        raise InputError(where, error.found, error.accepted, path) from None
    return tuple(getattr(place, c) for c in FRAME)


def place_fixtures(placed: Mapping[str, Any], data: Dataset) -> dict[str, float]:
    """Return the stated values [SI] of the measurements' own parameters: ``[anchor] x_mm``, ``[anchor.A] x_mm``."""
    own: dict[str, float] = {}
    used: dict[str, dict[str, dict[str, str]]] = {}
    for block in data.blocks:
        for name, dimension in block.measurement.parameters.items():
            table, _, rest = name.partition("_")
            used.setdefault(table, {}).setdefault(block.fixture, {})[rest] = dimension
    for table, content in placed.items():
        if table not in used:
            raise InputError(f"table {table}", "a place for no measurement here", choices(table, used))
        for fixture, known in used[table].items():
            part = content.get(fixture) if fixture else content
            if part is None:
                continue
            where = f"table {table}.{fixture}" if fixture else f"table {table}"
            if not isinstance(part, dict):
                raise InputError(where, repr(part)[:60], "a table")
            given = quantities(part, {rest: (d,) for rest, d in known.items()}, where)
            own |= {of_fixture(f"{table}_{rest}", fixture): value for (rest, _), value in given.items()}
        unknown = [key for key, value in content.items() if isinstance(value, dict) and key not in used[table]]
        if unknown:
            raise InputError(f"table {table}", f"'{unknown[0]}'", choices(unknown[0], used[table]))
    return own


def proposed(robot: Robot, parameters: Parameters, data: Dataset) -> list[str]:
    """Return what ``identify = "auto"`` means: geometry, Hayati's beta where it is needed, and what places things."""
    kinds = {block.measurement.name for block in data.blocks}
    absolute = kinds & {"position", "pose"}
    frames = [n for n in parameters.names if re.match(r"tool_|anchor_|length_|plane_|sphere_", n)]
    if "pose" not in kinds:
        frames = [n for n in frames if not (n.startswith("tool_") and n[-2:] in ("rx", "ry", "rz"))]
    base = [n for n in parameters.names if n.startswith("base_")] if absolute else []
    geometry = [n for n in parameters.names if re.fullmatch(r"(alpha|a|d|theta)\d+", n)]
    return [*geometry, *near_parallel(robot), *base, *frames]


def robots() -> list[str]:
    """Return the names of the ready robots, which a problem file may name: ``robot = "ur5e"``.

    >>> import rpim_opt as ro
    >>> ro.robots()[-3:]
    ['ur3e', 'ur5', 'ur5e']
    """
    return sorted(p.stem for p in (HERE / "robots").glob("*.toml"))


def find_robot(name: str, folder: Path | None = None) -> Path:
    """Return the file of a robot: one in ``folder``, or a ready robot by name."""
    if folder is not None and name.endswith(ROBOT_FILES):
        return folder / name
    if name in robots():
        return HERE / "robots" / f"{name}.toml"
    accepted = "a file .toml, .urdf, .csv or .json, or a ready robot: " + choices(name, robots())
    raise InputError("key robot", f"'{name}'", accepted, folder / "problem.toml" if folder else None)


def read_arm(file: Path, urdf_base: str | None = None, urdf_tip: str | None = None) -> Described:
    """Return the robot of a file, with base and tool where a URDF states them."""
    if file.suffix == ".urdf":
        return read_urdf(file, urdf_base, urdf_tip)
    return Described(read_mdh(file), np.zeros(6), np.zeros(6))


def parse_formulation(text: str) -> Formulation:
    """Return the ready formulation of that name."""
    return lookup(FORMULATIONS, text, "formulation")


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
        merged[key] = _overlay(base[key], value) if tables and value else value  # an empty table clears
    return merged
