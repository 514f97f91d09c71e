"""Sections of a problem file other than data: constraints, prior, record, acceptance, poses of fixtures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import date, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import ConfigDict, Field, create_model

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.files import inside
from rpim_opt.basics.schema import Length, Name, Table, validate
from rpim_opt.basics.units import fits, quantities, split_unit
from rpim_opt.bayes.prior import Prior
from rpim_opt.bayes.prior_terms import FRAMES
from rpim_opt.bayes.prior_terms import JOINT_OFFSET as FACTOR
from rpim_opt.convex.constraints import BOX, WORKSPACE, Constraint, at_nominal, equal, parse, signed
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.measurement import Measurement, of_fixture
from rpim_opt.data.record import CONFIDENCE, Requirement
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import JOINT_OFFSET, Parameters, is_joint_offset

MEASURED = "measured"  # The place that every problem has: the configurations of its identification data.
FIELDS = {  # keys of ``[record]``, and what a report calls them
    "by": "Measured by",
    "when": "Measured",
    "where": "Place",
    "instrument": "Instrument",
    "instrument_serial": "Instrument, serial",
    "certificate": "Certificate",
    "robot_serial": "Robot, serial",
    "controller": "Controller",
    "temperature": "Temperature",
    "load": "Load",
    "order": "Order",
    "ignored_joints": "Ignored joint values",
    "notes": "Notes",
}
LONGEST_TEXT = 1000  # Characters of a text that somebody may want to read.


def _joints(robot: Robot) -> dict[str, tuple[str, ...]]:
    return {f"q{i}": (dimension,) for i, dimension in enumerate(robot.joint_dimensions, start=1)}


class Constraints(Table):
    """The keys of ``[constraints]``."""

    at_nominal: list[Name] = Field(default_factory=list)
    positive: list[Name] = Field(default_factory=list)
    negative: list[Name] = Field(default_factory=list)
    equal: list[list[Name]] = Field(default_factory=list)
    stated: list[str] = Field(default_factory=list)
    places: dict[Name, dict[str, Any]] = Field(default_factory=dict)

    def all(self, robot: Robot, data: Dataset) -> tuple[Constraint, ...]:
        """Return the constraint functions for a problem with this robot and identification data."""
        made = [at_nominal(*self.at_nominal)] if self.at_nominal else []
        made += [signed(sign, *names) for sign, names in ((1, self.positive), (-1, self.negative)) if names]
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
            raise InputError(where, "rows and other keys", "rows alone")
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
    """The keys of ``[prior]``; tails may be infinite."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=True)

    known: list[str] = Field(default_factory=list)
    earlier: str = Field(default="", alias="from")
    without: list[str] = Field(default_factory=list)
    inflate: float | int = 1.0
    population: list[str] = Field(default_factory=list)
    tails: float | int = 3.0
    groups: list[str] = Field(default_factory=list)
    joint_offset: float | int = FACTOR
    frames: float | int = FRAMES
    centre: dict[str, float | int] = Field(default_factory=dict)
    scale: dict[str, float | int] = Field(default_factory=dict)

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


def stated_prior(
    table: PriorTable,
    scale: Mapping[str, float],
    parameters: Parameters,
    path: Path,
    measurements: Sequence[Measurement],
) -> Prior:
    """Return the prior of a problem file, checked against the problem's parameters.

    What ``scale`` says of joint offsets alone, or of a parameter by its name, is taken at its word: somebody has
    thought of it, as of a certificate's standard uncertainty of a reflector's place.
    """
    for key in ("inflate", "without"):
        if key in table.model_fields_set and not table.earlier:
            raise InputError(f"key prior.{key}", "no key from in addition", "from = 'other/result.json'", path)
    offsets = {}
    for key, value in scale.items():
        stem = split_unit(key)[0]
        matches = [name for name in parameters.names if fits(name, stem)]
        if stem == JOINT_OFFSET or stem in parameters.names or (matches and all(map(is_joint_offset, matches))):
            offsets[key] = value
    numbers: Any = {name: float(getattr(table, name)) for name in ("tails", "joint_offset", "frames")}
    groups = tuple(tuple(group.split()) for group in table.groups)
    try:
        prior = Prior(centre=table.centre, scale={**offsets, **table.scale}, groups=groups, **numbers)
    except InputError as error:
        raise InputError(error.where.replace("prior, key ", "key prior."), error.found, error.accepted, path) from None
    files = table.files(path)
    for i, text in enumerate(table.known, start=1):
        with _of_prior(f"known {i}", path):
            prior &= Prior.known(text)
    if files:
        from rpim_opt.store.result_file import load_result  # most folders name no earlier result

        load = partial(load_result, measurements=measurements)
        if table.earlier:
            with _of_prior("from", path):
                prior &= Prior.from_result(load(files[table.earlier]), table.inflate, table.without)
        if table.population:
            with _of_prior("population", path):
                prior &= Prior.from_population({name: load(files[name]) for name in table.population})
    prior.stated(parameters)
    return prior


@contextmanager
def _of_prior(key: str, path: Path) -> Iterator[None]:
    """Let an InputError that names no file name the key of ``[prior]``."""
    try:
        yield
    except InputError as error:
        raise error if error.file else InputError(f"key prior.{key}", error.found, error.accepted, path) from None


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
    """Return the requirement of ``[acceptance]``; None for an empty table.

    ::

        limit_mm = 0.1                  the robot reaches positions within this, with
        confidence = 0.95               at every configuration whose nominal reflector is
        x_mm = [300.0, 800.0]           in this box of the robot's base frame (with y_mm and z_mm), and
        q1_deg = [-90.0, 90.0]          whose joints are within these, the others within the measured ranges
        marker = "smr1"
    """
    if not table:
        return None
    joints = _joints(robot)
    pair = Annotated[list[float] | None, Field(min_length=2, max_length=2)]
    known = dict.fromkeys(BOX, ("length",)) | joints
    fields: dict[str, Any] = {name: (Annotated[pair, dimension], None) for name, (dimension,) in known.items()}
    fields |= {"limit": (Length, ...), "confidence": (float, CONFIDENCE), "marker": (str, "")}
    schema: type[Table] = create_model("Acceptance", __base__=Table, **fields)
    keys = dict(validate(schema, table, path, "acceptance"))
    sides = {name: (keys[name][0], keys[name][1]) for name in known if keys[name] is not None}
    axes = [axis for axis in BOX if axis in sides]
    if axes and len(axes) < len(BOX):
        raise InputError("table acceptance", f"{', '.join(axes)} alone", "x_mm, y_mm and z_mm of a box, or none", path)
    box = (sides["x"], sides["y"], sides["z"]) if axes else None
    ranges = tuple((int(name[1:]), side) for name, side in sides.items() if name not in BOX)
    return Requirement(keys["limit"], box, ranges, keys["marker"], keys["confidence"])


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
