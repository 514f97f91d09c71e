"""The file ``problem.toml``: its schema, its variants, and what its keys mean for a problem with its data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import date, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import ConfigDict, Field, create_model, model_validator

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices, pick
from rpim_opt.basics.files import inside, read_toml
from rpim_opt.basics.schema import Angle, Length, Name, Table, validate
from rpim_opt.basics.text import listed
from rpim_opt.basics.units import accepted_units, fits, quantities, split_unit
from rpim_opt.bayes.prior import Prior
from rpim_opt.bayes.prior_terms import FRAMES
from rpim_opt.bayes.prior_terms import JOINT_OFFSET as FACTOR
from rpim_opt.convex.constraints import BOX, WORKSPACE, Constraint, at_nominal, equal, parse
from rpim_opt.convex.rules.selection import Selector, require_weight
from rpim_opt.convex.select import LEARNED, SELECTORS
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.camera import Board, grid_board, read_board
from rpim_opt.data.measurements.measurement import Measurement, of_fixture
from rpim_opt.data.measurements.registry import MEASUREMENTS
from rpim_opt.data.record import CONFIDENCE, Requirement
from rpim_opt.problem.problem import identifiable
from rpim_opt.robot.chain import RobotSetup
from rpim_opt.robot.formats.tables import Mounting, PayloadTable, gravity_with
from rpim_opt.robot.kinematics import FRAME, numeric_frame
from rpim_opt.robot.library import find_robot, read_arm
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import JOINT_OFFSET, Parameters, is_joint_offset
from rpim_opt.robot.terms import Model, Term
from rpim_opt.store.own_code import is_own, own_object

Noise = Literal["robot", "free", "level", "declared"]
PACKAGE = Path(__file__).resolve().parents[1]
MEASURED = "measured"  # The predefined place of all problems: the configurations of the identification data.
FIELDS = {  # keys of ``[record]``, and their names in reports
    "by": "Measured by",
    "when": "Measured",
    "where": "Place",
    "instrument": "Instrument",
    "instrument_serial": "Instrument serial number",
    "certificate": "Certificate",
    "robot_serial": "Robot serial number",
    "controller": "Controller",
    "temperature": "Temperature",
    "load": "Load",
    "order": "Order",
    "ignored_joints": "Ignored joint values",
    "notes": "Notes",
}
LONGEST_TEXT = 1000  # Characters of a text for readers.


def problems_folder() -> Path:
    """Return the folder of the shipped problems: inside the package, or beside it in a checkout."""
    inside = PACKAGE / "problems"
    return inside if inside.is_dir() else PACKAGE.parent / "problems"


def find_problem(name: str | Path) -> Path:
    """Return the folder of a problem from its path, or of a shipped problem by name."""
    path = Path(name)
    if path.is_file() and path.name == "problem.toml":
        return path.parent
    if path.is_dir():
        return path
    known = sorted(p.name for p in problems_folder().iterdir() if (p / "problem.toml").is_file())
    if name in known:  # never a path: that is a folder
        return problems_folder() / str(name)
    accepted = "a folder with problem.toml, or " + choices(str(name), known)
    raise InputError("the problem", f"no folder '{name}'", accepted)


def named_weight(text: str, file: Path | None = None) -> float | Selector | None:
    """Return the selector of that name, or the number in the text; None if hyperparameters are estimated."""
    if text == LEARNED:
        return None
    try:
        value = float(text)
    except ValueError:
        return pick(SELECTORS, text, "key selector", file, f"a number, {LEARNED}, ")
    return require_weight(value, "selector", file)


def _joints(robot: Robot) -> dict[str, tuple[str, ...]]:
    return {f"q{i}": (dimension,) for i, dimension in enumerate(robot.joint_dimensions, start=1)}


class Constraints(Table):
    """The keys of ``[constraints]``."""

    at_nominal: list[Name] = Field(default_factory=list)
    equal: list[list[Name]] = Field(default_factory=list)
    stated: list[str] = Field(default_factory=list)
    places: dict[Name, dict[str, Any]] = Field(default_factory=dict)

    def all(self, robot: Robot, data: Dataset) -> tuple[Constraint, ...]:
        """Return the constraint functions for a problem with this robot and identification data."""
        made = [at_nominal(*self.at_nominal)] if self.at_nominal else []
        places: dict[str, Any] = {MEASURED: _rows(data, None)}
        for name, table in self.places.items():
            where = f"key constraints.places.{name}"
            if name in (MEASURED, WORKSPACE):
                raise InputError(where, "a predefined place", "another name")
            places[name] = _place(table, robot, data, where)
        return (*made, *(equal(*names) for names in self.equal), *(parse(text, places) for text in self.stated))


def _place(table: Mapping[str, Any], robot: Robot, data: Dataset, where: str) -> Any:
    """Return joint values (N, dof) [rad or m], or the sides of a box [m]."""
    if "rows" in table:
        if len(table) > 1:
            raise InputError(where, "rows and other keys", "rows only")
        return _rows(data, table["rows"], where)
    joints = _joints(robot)
    known = dict.fromkeys(BOX, ("length",)) | joints
    if len(set(robot.joint_dimensions)) == 1:
        known["q"] = (robot.joint_dimensions[0],)
    values = {stem: value for (stem, _), value in quantities(table, known, where, lists=True).items()}
    if set(values) == set(BOX):
        return values
    if set(values) not in ({"q"}, set(joints)):
        accepted = "x_mm, y_mm and z_mm of a box, all joints' q1_deg, ..., q_deg of all joints, or rows = [labels]"
        raise InputError(where, ", ".join(table) or "nothing", accepted)
    try:
        q = np.array(values["q"] if "q" in values else [values[name] for name in joints], dtype=float)
    except ValueError:
        raise InputError(where, "lists of different lengths", f"{robot.dof} joint values per configuration") from None
    q = q.reshape(-1, q.shape[-1] if q.ndim else 1)
    if q.shape[1] != robot.dof:
        raise InputError(where, f"{q.shape[1]} joint values", f"{robot.dof} per configuration")
    return q


def _rows(data: Dataset, labels: Any, where: str = "") -> Array:
    """Return the joint values (N, dof) of measured rows."""
    known = [data.label[row] for block in data.blocks for row in block.row]
    points = [q for block in data.blocks for q in block.q]
    chosen = [q for label, q in zip(known, points, strict=True) if labels is None or label in labels]
    missing = [label for label in labels or [] if label not in known]
    if missing or not chosen:
        found = f"'{missing[0]}'" if missing else "no row"
        raise InputError(f"{where}.rows", found, "labels of the identification data: " + choices(found, known))
    return np.unique(np.concatenate(chosen), axis=0)


class PriorTable(Table):
    """The keys of ``[prior]``; the degrees of freedom of Student's t may be infinite (a normal prior)."""

    model_config = ConfigDict(allow_inf_nan=True)

    known: list[str] = Field(default_factory=list)
    earlier: str = Field(default="", alias="from")
    without: list[str] = Field(default_factory=list)
    inflate: float = 1.0
    population: list[str] = Field(default_factory=list)
    tails: float = 3.0
    groups: list[str] = Field(default_factory=list)
    joint_offset: float = FACTOR
    frames: float = FRAMES
    centre: dict[str, float] = Field(default_factory=dict)
    scale: dict[str, float] = Field(default_factory=dict)

    def files(self, path: Path) -> dict[str, Path]:
        """Return the files of the prior in the problem's folder, by their names in the problem file."""
        named = [(file, "key prior.population") for file in self.population]
        if self.earlier:
            named.append((self.earlier, "key prior.from"))
        files = {}
        for name, key in named:
            try:
                folder = inside(path.parent, name, key, path).is_dir()
                files[name] = inside(path.parent, str(Path(name) / "result.json") if folder else name, key, path)
            except InputError as error:
                accepted = f"{error.accepted}; a copy there, `rpim-opt update`, or calibrate(prior=...) in a script"
                raise InputError(key, error.found, accepted, path) from None
        return files


class FrameTable(Table):
    """Pose of a frame: x, y, z and roll, pitch, yaw about fixed axes."""

    x: Length = 0.0
    y: Length = 0.0
    z: Length = 0.0
    rx: Angle = 0.0
    ry: Angle = 0.0
    rz: Angle = 0.0


class RepeatabilityTable(Table):
    """Known repeatability of the robot."""

    position: Length = Field(default=0.0, ge=0)
    orientation: Angle = Field(default=0.0, ge=0)
    joint: Angle = Field(default=0.0, ge=0)
    reading: Length = Field(default=0.0, ge=0)


class GridTable(Table):
    """A chessboard, or a grid of circles, whose points are numbered from 0 row by row."""

    columns: int
    rows: int
    spacing: Length


Pair = Annotated[list[Name], Field(min_length=2, max_length=2)]
Figure = Annotated[list[float], Field(min_length=2, max_length=2)]


class DistanceTable(Table):
    """A known distance; ``mm = 50`` is short for ``distance_mm = 50``. One for validation is not used in the fit."""

    between: Pair
    validation: bool = False
    distance: Length
    sigma: Annotated[float | None, "length"] = None

    @model_validator(mode="before")
    @classmethod
    def _distance(cls, table: Any) -> Any:
        units = accepted_units("length")
        if not isinstance(table, dict):
            return table
        return {f"distance_{key}" if key in units else key: value for key, value in table.items()}


class AngleTable(Table):
    """A known angle, 0 (parallel) or 90 degrees (square)."""

    between: Pair
    validation: bool = False
    deg: Literal[0, 90]
    sigma: Annotated[float | None, "angle"] = None


class Observation(Table):
    """Tables of one kind of measurement: ``[[observation]]``."""

    measurement: str = "position"
    identification: str
    validation: str | None = None
    noise: dict[str, Any] = Field(default_factory=dict)


class ProblemTable(Table):
    """The keys of ``problem.toml``."""

    title: str  # What was calibrated.
    source: str = ""  # Where every figure comes from, and its licence.
    robot: str = "robot.toml"  # File of the robot (.toml, .urdf, .csv, .json), or the name of a ready one.
    urdf_base: str | None = None  # Link where the chain starts.
    urdf_tip: str | None = None  # Link where the chain ends.
    mounting: Mounting | None = None  # floor, ceiling, wall, or the direction of gravity in the base frame.
    payload: PayloadTable | None = None  # Mass at the flange and its centre.
    celsius: float | None = Field(None, alias="temperature_C")  # Temperature at which lengths are nominal [degC].
    measurement: str = "position"  # Measurement type; mine:height is `height` in mine.py (--allow-code).
    terms: list[str] = Field([])  # Terms of your own: mine:droop is the Term `droop` in mine.py (--allow-code).
    identification: str | None = None  # Table of the identification data.
    validation: str | None = None  # Table of the validation data.
    held_out: bool = False  # Validation data are rows of the same table: once they have validated, all rows are used.
    noise_assumed: bool = False  # The measurement noise is a guess, which results and reports state.
    raw: dict[str, str] = Field({})  # Files from which `new` made the tables: name = SHA-256.
    observation: list[Observation] = Field([])  # Several measurement types, a table each.
    target: GridTable | str | None = None  # Board of a camera: a table, or columns, rows and spacing.
    exclude: dict[str, str] = Field({})  # Rows to leave out: label = reason.
    identify: list[Name] | Literal["auto"]  # Patterns of the parameters to identify, or auto.
    formulation: str = "tikhonov"  # Name of a ready formulation.
    selector: str = "learned"  # learned (prior scales), the name of a selection rule, or a number.
    model: Literal["geometry", "auto"] = "geometry"  # auto: model extensions by evidence; geometry: none.
    repeatability: RepeatabilityTable | Noise = "robot"  # Components: robot, free, level, declared; or stated.
    noise: dict[str, Any] = Field({})  # Measurement noise of rows that state none.
    scale: dict[Name, Any] = Field({})  # Prior standard deviations, by kind, pattern or name.
    tolerance: dict[Name, Any] = Field({})  # Largest deviations of the formulation bounded.
    prior: PriorTable = PriorTable()  # What is known besides the scales.
    constraints: Constraints = Constraints()  # Constraints on parameters and positions.
    known_distance: list[DistanceTable] = Field([])  # Known distances between touched points or planes.
    known_angle: list[AngleTable] = Field([])  # Known angles between touched planes.
    base: FrameTable | Literal["auto"] = FrameTable()  # Start of the base frame, or auto (registration).
    tool: dict[str, Any] = Field({})  # Start of the tool frame; of several reflectors by marker.
    published: dict[str, dict[str, float]] = Field({})  # Mean errors [mm] that the source prints.
    reference: dict[str, Figure] = Field({})  # Figures that a run must reproduce: [value, tolerance].
    simulation: dict[str, Any] = Field({})  # How the tables were simulated.
    record: dict[str, Any] = Field({})  # Who measured, when, with what.
    reading: dict[str, str] = Field({})  # How tables are to be read where joints or frames need another reading.
    acceptance: dict[str, Any] = Field({})  # Tolerance, confidence and region of the acceptance test.
    variant: dict[str, dict[str, Any]] = Field({})  # Overlays of any key, by name.
    chain: dict[str, dict[str, Any]] = Field({})  # Chains of one URDF, by name: overlays of any key.
    shared: list[Name] | dict[str, list[Name]] = Field([])  # What chains share besides joints, or by chain.


@dataclass(frozen=True, eq=False)
class ProblemFile:
    """The checked content of a problem file: ``placed`` has the tables of fixtures, ``base`` None for registration."""

    path: Path
    table: ProblemTable
    placed: Mapping[str, Any]
    robot: Robot
    kinds: Mapping[str, Measurement]
    tools: Mapping[str, tuple[float, ...]]
    base: tuple[float, ...] | None
    board: Board | None

    @property
    def observations(self) -> list[Observation]:
        """The tables of every kind of measurement, that of the top level first."""
        table = self.table
        if table.identification is None:
            return table.observation
        keys = ("measurement", "identification", "validation")
        return [Observation.model_construct(**{key: getattr(table, key) for key in keys}, noise={}), *table.observation]

    def chosen(self, parameters: Parameters, data: Dataset) -> Parameters:
        """Return the parameters with the file's scales, tolerances and selection of identified parameters."""
        table = self.table
        parameters = parameters.scaled(table.scale, self.path).toleranced(table.tolerance, self.path)
        return parameters.identify(identifiable(table.identify, self.robot, parameters, data))


def read_problem(
    name: str | Path,
    variant: str | None = None,
    measurements: Sequence[Measurement] = (),
    model: Model | None = None,
    chain: str | None = None,
) -> ProblemFile:
    """Return the content of a problem file, of the first of several chains by default; arguments as for `load`."""
    folder = find_problem(name)
    path = inside(folder, "problem.toml", "the problem", folder)
    kinds = {**MEASUREMENTS, **{m.name: m for m in measurements}}
    content = read_toml(path)
    table, placed = _checked(content, kinds, path)  # the file itself must be valid, whichever variant is requested
    for where, overlays in {"variant": table.variant, "chain": table.chain}.items():
        for key, over in overlays.items():
            if not any(map(is_own, _kinds_in(over))):  # such code runs only when requested
                _checked(_overlay(content, over), kinds, path, f"{where}.{key}")
    if variant is not None:
        content = _overlay(content, pick(table.variant, variant, "variant", path))
        table, placed = _checked(content, kinds, path)
    if table.chain:
        content = _overlay(content, pick(table.chain, chain or next(iter(table.chain)), "chain", path))
        table, placed = _checked(content, kinds, path)
    arm = _arm(table, path, model)
    base = None
    if table.base != "auto":
        base = tuple(dict(table.base).values()) if table.base.model_fields_set else tuple(arm.base)
    tools = {"": tuple(arm.tool)}
    if any(split_unit(key)[0] in FRAME for key in table.tool):  # one without a name is the only one
        tools = {"": _frame(table.tool, "tool", path)}
    elif table.tool:
        tools = {marker: _frame(place, f"tool.{marker}", path) for marker, place in table.tool.items()}
    board = None
    if isinstance(table.target, str):
        board = read_board(inside(path.parent, table.target, "key target", path))
    elif table.target is not None:
        with at_key("target", path):
            board = grid_board(**dict(table.target))
    file = ProblemFile(path, table, placed, arm.robot, kinds, tools, base, board)
    if not file.observations:
        raise InputError("key identification", "nothing", "the name of a table, or [[observation]] tables", path)
    for each in file.observations:
        pick(kinds, each.measurement, "key measurement", path)
        inside(path.parent, each.identification, "key identification", path)
        if each.validation:  # a variant clears it with an empty one
            inside(path.parent, each.validation, "key validation", path)
    return file


def _kinds_in(content: Mapping[str, Any]) -> list[Any]:
    """Return what a table and its observations name as measurement types."""
    observations = content.get("observation", [])
    tables = (content, *(observations if isinstance(observations, list) else []))
    return [each.get("measurement") for each in tables if isinstance(each, dict)]


def _checked(
    content: dict[str, Any], kinds: dict[str, Measurement], path: Path, where: str = ""
) -> tuple[ProblemTable, dict[str, Any]]:
    """Return the checked table, and apart from it those that place fixtures; types of Python files are added."""
    for kind in filter(is_own, _kinds_in(content)):
        kinds[kind] = replace(own_object(kind, Measurement, "key measurement", path), name=kind)
    fixtures = {name.partition("_")[0] for kind in kinds.values() for name in kind.parameters}
    placed = {key: value for key, value in content.items() if key in fixtures and isinstance(value, dict)}
    return validate(ProblemTable, {k: v for k, v in content.items() if k not in placed}, path, where), placed


def _arm(table: ProblemTable, path: Path, model: Model | None) -> RobotSetup:
    """Return the robot with its gravity, and terms of a script or of the file."""
    file = find_robot(table.robot, path.parent)
    if file.suffix != ".urdf" and (table.urdf_base or table.urdf_tip or table.chain):
        what = "chain" if table.chain else "urdf_base, urdf_tip"
        raise InputError(f"key {what}", f"a robot '{table.robot}'", "a robot in a file .urdf", path)
    arm = read_arm(file, table.urdf_base, table.urdf_tip, origins=bool(table.chain))
    turned = numeric_frame(arm.base)[:3, :3]
    gravity = gravity_with(arm.robot.gravity, table.mounting, table.payload, path, turned)
    if model is None:
        model = Model([own_object(term, Term, "key terms", path) for term in table.terms])
    if not isinstance(model, Model):
        accepted = "a ro.robot.Model with terms of your own; extensions are chosen by calibrate(model='auto')"
        raise InputError("model", f"{model!r}"[:80], accepted)
    whole = Model((*arm.robot.model.terms, *model.terms))
    return replace(arm, robot=replace(arm.robot, gravity=gravity, model=whole))


def _overlay(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``base`` with the keys of ``over``; tables are merged, anything else is replaced."""
    merged = dict(base)
    for key, value in over.items():
        tables = isinstance(value, Mapping) and isinstance(base.get(key), Mapping)
        merged[key] = _overlay(base[key], value) if tables and value else value  # an empty table clears
    return merged


def _frame(table: Any, where: str, path: Path) -> tuple[float, ...]:
    """Return the six numbers [m, rad] of a frame's table."""
    if not isinstance(table, dict):
        raise InputError(f"key {where}", repr(table)[:60], "a table with x_mm, ..., rz_deg", path)
    return tuple(dict(validate(FrameTable, table, path, where)).values())


# --- sections other than data --------------------------------------------------------------------------------------


def stated_prior(stated: ProblemFile, parameters: Parameters, measurements: Sequence[Measurement]) -> Prior:
    """Return the prior of a problem file, checked against the problem's parameters.

    A ``scale`` of joint offsets alone, or of a parameter by its name, is final, without the prior's factors: it was
    stated deliberately, for instance from a certificate's standard uncertainty of a reflector's place.
    """
    table = stated.table.prior
    path = stated.path
    for key in ("inflate", "without"):
        if key in table.model_fields_set and not table.earlier:
            raise InputError(f"key prior.{key}", "no key from in addition", "from = 'other/result.json'", path)
    offsets = {}
    for key, value in stated.table.scale.items():
        stem = split_unit(key)[0]
        matches = [name for name in parameters.names if fits(name, stem)]
        if stem == JOINT_OFFSET or stem in parameters.names or (matches and all(map(is_joint_offset, matches))):
            offsets[key] = value
    groups = tuple(tuple(group.split()) for group in table.groups)
    try:
        prior = Prior(table.centre, {**offsets, **table.scale}, table.tails, groups, table.joint_offset, table.frames)
    except InputError as error:
        raise InputError(error.where.replace("prior, key ", "key prior."), error.found, error.accepted, path) from None
    files = table.files(path)
    for i, text in enumerate(table.known, start=1):
        with at_key(f"prior.known {i}", path):
            prior &= Prior.known(text)
    if files:
        from rpim_opt.store.result_file import load_result  # most folders name no earlier result

        load = partial(load_result, measurements=measurements)
        if table.earlier:
            with at_key("prior.from", path):
                earlier = load(files[table.earlier])
                free = earlier.problem.parameters.free
                of_robot = np.array(free.names)[~free.of_frames].tolist()
                named = [*parameters.free.names, *table.without]
                if missed := [name for name in of_robot if not any(fits(name, each) for each in named)]:
                    accepted = "them in `identify`, or in prior.without"
                    raise InputError("", f"parameters that are not identified here ({listed(missed)})", accepted)
                prior &= Prior.from_result(earlier, table.inflate, table.without)
        if table.population:
            with at_key("prior.population", path):
                prior &= Prior.from_population({name: load(files[name]) for name in table.population})
    prior.stated(parameters)
    return prior


@contextmanager
def at_key(key: str, path: Path, part: bool = False) -> Iterator[None]:
    """Let an InputError that names no file name a key of the problem file; with ``part`` also what it names itself."""
    try:
        yield
    except InputError as error:
        where = f"key {key}"
        if part and not error.where.startswith(where):
            where += f", {error.where.removeprefix('--')}"
        raise error if error.file else InputError(where, error.found, error.accepted, path) from None


def stated_details(table: Mapping[str, Any]) -> dict[str, str]:
    """Return the entries of ``[record]``, in the order of `FIELDS`."""
    for key, value in table.items():
        if key not in FIELDS:
            raise InputError(f"key record.{key}", "an unknown key", choices(key, FIELDS))
        if isinstance(value, bool) or not isinstance(value, str | int | float | date | datetime):
            raise InputError(f"key record.{key}", repr(value)[:60], "a text, a number or a date")
        length = len(str(value).strip())
        if not 0 < length <= LONGEST_TEXT:
            raise InputError(f"key record.{key}", f"{length} characters", f"1 to {LONGEST_TEXT}")
    return {key: str(table[key]).strip() for key in FIELDS if key in table}


def stated_requirement(table: dict[str, Any], robot: Robot, path: Path) -> Requirement | None:
    """Return the requirement of ``[acceptance]`` (its keys: the guide "Results"); None for an empty table."""
    if not table:
        return None
    pair = Annotated[list[float] | None, Field(min_length=2, max_length=2)]
    known = dict.fromkeys(BOX, ("length",)) | _joints(robot)
    fields: dict[str, Any] = {name: (Annotated[pair, dimension], None) for name, (dimension,) in known.items()}
    fields |= {"limit": (Length, ...), "confidence": (float, CONFIDENCE), "marker": (str, "")}
    fields["measured"] = (bool, False)
    schema: type[Table] = create_model("Acceptance", __base__=Table, **fields)
    keys = dict(validate(schema, table, path, "acceptance"))
    sides = {name: (keys[name][0], keys[name][1]) for name in known if keys[name] is not None}
    axes = [axis for axis in BOX if axis in sides]
    if axes and len(axes) < len(BOX):
        raise InputError("table acceptance", f"{', '.join(axes)} alone", "x_mm, y_mm and z_mm of a box, or none", path)
    box = (sides["x"], sides["y"], sides["z"]) if axes else None
    ranges = tuple((int(name[1:]), side) for name, side in sides.items() if name not in BOX)
    with at_key("acceptance", path, part=True):
        return Requirement(keys["limit"], box, ranges, keys["marker"], keys["confidence"], keys["measured"])


def place_fixtures(placed: Mapping[str, Any], data: Dataset) -> dict[str, float]:
    """Return the stated values [SI] of the measurements' own parameters: ``[anchor] x_mm``, ``[anchor.A] x_mm``."""
    used: dict[str, dict[str, dict[str, tuple[str, ...]]]] = {}  # dimensions by table, fixture and coordinate
    for block in data.blocks:
        for name, dimension in block.measurement.parameters.items():
            table, _, coordinate = name.partition("_")
            used.setdefault(table, {}).setdefault(block.fixture, {})[coordinate] = (dimension,)
    own: dict[str, float] = {}
    for table, content in placed.items():
        if table not in used:
            raise InputError(f"table {table}", "a fixture that no measurement here has", choices(table, used))
        for fixture, coordinates in used[table].items():
            where = f"table {table}.{fixture}" if fixture else f"table {table}"
            part: Any = content.get(fixture, {}) if fixture else content
            if not isinstance(part, dict):
                raise InputError(where, repr(part)[:60], "a table")
            for (name, _), value in quantities(part, coordinates, where).items():
                own[of_fixture(f"{table}_{name}", fixture)] = value
        unknown = [key for key, value in content.items() if isinstance(value, dict) and key not in used[table]]
        if unknown:
            raise InputError(f"table {table}", f"'{unknown[0]}'", choices(unknown[0], used[table]))
    return own
