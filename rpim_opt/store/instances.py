"""Loading of problem folders: ``robot.toml``, ``problem.toml`` and tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import wraps
from inspect import signature
from itertools import product
from pathlib import Path
from typing import Any, Concatenate, ParamSpec

from rpim_opt.basics.exceptions import InputError, in_file
from rpim_opt.basics.files import inside, sha256_of
from rpim_opt.basics.layout import TableOptions
from rpim_opt.basics.tables import read_columns
from rpim_opt.basics.text import Tabled, shortened
from rpim_opt.basics.units import UNITS
from rpim_opt.bayes.prior import Prior
from rpim_opt.calibration import identify
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.arguments import arguments_of
from rpim_opt.convex.constraints import Box, Constraint, Parsed
from rpim_opt.convex.formulation import Formulation, formulation_of
from rpim_opt.convex.rules.selection import Selector
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.camera import on_board
from rpim_opt.data.measurements.contact import Known, KnownAngle, KnownDistance, with_known
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.record import Record
from rpim_opt.data.tables.reading import read_data
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.multi_robot import together
from rpim_opt.problem.noise import Repeatability
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.frames import starting_parameters
from rpim_opt.robot.chain import OF_JOINTS
from rpim_opt.robot.library import find_robot
from rpim_opt.robot.terms import Model as KinematicModel
from rpim_opt.store import problem_file

_Options = ParamSpec("_Options")
ROLES = ("identification", "validation")
UNSTATED = 1e-5  # standard deviation [m or rad] of validation data if none is stated: that of a good machine tool


@dataclass(frozen=True, eq=False, repr=False)
class Instance(Tabled):
    """A calibration problem of a folder, with validation data and settings.

    ``problem`` has robot, parameters and identification data; ``formulation``, ``weight`` (None if hyperparameters are
    estimated), ``prior``, ``model`` and ``noise`` are as for `calibrate`. ``record`` is the part of a saved result
    about the data, with the validation data; ``published`` are mean errors [mm] printed by the source for the same
    table, by role (identification, validation) and method; ``reference`` are figures that a run must reproduce, name to
    (value, tolerance); ``held_out`` states that validation data were drawn from the same table: after validation all
    rows are used. ``constraints`` are the file's, which apply in addition to every ready formulation.
    """

    problem: CalibrationProblem
    formulation: Formulation
    weight: float | Selector | None
    prior: Prior = field(default_factory=Prior)
    model: str = "geometry"
    noise: str = "robot"
    record: Record = field(default_factory=Record)
    published: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    reference: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    held_out: bool = False
    constraints: tuple[Constraint, ...] = ()

    @property
    def validation(self) -> Dataset | None:
        """Validation data, not used in any step of the calibration."""
        return self.record.validation

    def _short(self) -> str:
        return f"'{shortened(self.record.title)}' {self.problem._short()}"

    def _frame_rows(self) -> list[dict[str, Any]]:
        return self.problem.parameters.free._frame_rows()

    def _notes(self) -> list[str]:
        return [self.record.source]

    def calibrate(self, **changes: Any) -> Calibration:
        """Return the calibration with the folder's settings and record.

        ``changes`` are arguments of `calibrate` to use instead: ``weight="reml"``, ``formulation="robust"``. The file's
        constraints also apply to a ready formulation; a `Formulation` object states its own.
        """
        if isinstance(changes.get("formulation"), str):
            ready = formulation_of(changes["formulation"])
            changes["formulation"] = replace(ready, constraints=(*ready.constraints, *self.constraints))
        settings = {name: getattr(self, name) for name in ("formulation", "weight", "prior", "model", "noise")}
        return replace(identify.calibrate(self.problem, **(settings | changes)), record=self.record)


def load(
    name: str | Path,
    variant: str | None = None,
    measurements: Sequence[Measurement] = (),
    model: KinematicModel | None = None,
    chain: str | None = None,
) -> Instance:
    """Return the problem of a folder, or a shipped problem by name.

    ``name`` is a folder with ``problem.toml`` (its format: the guide "Your own robot"), that file, or the name of one
    that comes with the package; ``variant`` is one of the file's ``[variant.NAME]`` tables, which replaces other keys.
    ``measurements`` are user-defined measurement types that the file may name, ``model`` has user-defined terms: the
    file may identify and scale their parameters, and its tables have their columns. ``chain`` is one of the file's
    ``[chain.NAME]`` tables; by default all of them are one problem. InputError names the file, the row or key, what was
    found and what is accepted.

    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm", variant="swap")  # the 16 points for the 9, and the other way round
    >>> len(instance.problem.data), len(instance.validation), instance.formulation.name
    (16, 9, 'Tikhonov')
    """
    definition = problem_file.read_problem(name, variant, measurements, model, chain)
    table = definition.table
    if len(table.chain) > 1 and chain is None:
        return _of_chains(definition, {each: load(name, variant, measurements, model, each) for each in table.chain})
    path = definition.path
    data, files = _read_tables(definition)
    tools = definition.tools
    validation = data.get("validation")
    with in_file(path):
        rows = data["identification"]
        temperature = None if table.celsius is None else table.celsius + UNITS["degC"].zero
        fixtures = problem_file.place_fixtures(definition.placed, rows)
        parameters = starting_parameters(definition.robot, rows, definition.base, tools, fixtures, temperature)
        problem = CalibrationProblem(definition.robot, definition.chosen(parameters, rows), rows)
        if not isinstance(table.repeatability, str):
            problem = problem.with_repeatability(Repeatability(**dict(table.repeatability)))
        if validation is not None:
            problem.on(validation)  # raises for rows that the problem's robot or reflectors cannot have
        formulation = _formulation(definition, problem)
        prior = problem_file.stated_prior(definition, problem.parameters, measurements)
        problem = problem.with_parameters(prior.where_known(problem.parameters, problem.parameters))
        unstated = [name for each in prior.statements if each.reference is None for name in each.names]
        for name in unstated:
            if definition.base is None and name.startswith("base_"):
                found = f"'{name}' without a value, where base = \"auto\""
                raise InputError("key prior.known", found, f"'{name} = ... +- ...', or a table [base]")
        details = problem_file.stated_details(table.record)
        with problem_file.at_key("reading", path, part=True):
            TableOptions.stated(table.reading)
        requirement = problem_file.stated_requirement(table.acceptance, problem.robot, path)
    for file in table.published:
        if not inside(path.parent, file, "table published", path).is_file():
            raise InputError("table published", f"'{file}'", "the name of a table in this folder", path)
    robot = find_robot(table.robot, path.parent)
    named = [file for names in files.values() for file in names]
    if isinstance(table.target, str):
        named.append(table.target)
    used = {path.name: path, robot.name: robot} | {file: path.parent / file for file in named} | table.prior.files(path)
    digests = {name: sha256_of(file) for name, file in used.items()}
    record = Record(
        title=table.title,
        source=table.source,
        validation=validation,
        excluded=table.exclude,
        files=digests | {f"{name} (raw data)": digest for name, digest in table.raw.items()},
        simulated=bool(table.simulation),
        noise_assumed=table.noise_assumed,
        details=details,
        requirement=requirement,
        reading=table.reading,
        terms=tuple(table.terms) if model is None else (),
        known=tuple(table.prior.known),
    )
    return Instance(
        problem,
        formulation,
        problem_file.named_weight(table.selector, path),
        prior,
        table.model,
        noise=table.repeatability if isinstance(table.repeatability, str) else "declared",
        record=record,
        published={role: table.published.get(names[0], {}) for role, names in files.items() if names},
        reference={key: (value, spread) for key, (value, spread) in table.reference.items()},
        held_out=table.held_out,
        constraints=formulation.constraints[len(formulation_of(table.formulation).constraints) :],
    )


def _of_chains(stated: problem_file.ProblemFile, parts: Mapping[str, Instance]) -> Instance:
    """Return the problem of several chains of one URDF: formulation, prior and record are the first one's."""
    count = Counter(name for part in parts.values() for name in part.problem.parameters.terms)
    several = tuple(name for name in count if count[name] > 1)
    shared = [f"{prefix}*" for prefix in OF_JOINTS if any(name.startswith(prefix) for name in several)]
    more = stated.table.shared
    if isinstance(more, list):
        more = dict.fromkeys(parts, more)
    by_chain = {name: [*shared, *more.get(name, ())] for name in {**parts, **more}}
    with in_file(stated.path):
        problem = together(**{name: part.problem for name, part in parts.items()}, shared=by_chain)
    first, *others = parts.values()
    record = first.record
    for other in others:
        files = {**record.files, **other.record.files}
        record = replace(record, files=files, excluded={**record.excluded, **other.record.excluded})
    validated = {name: part.validation for name, part in parts.items() if part.validation is not None}
    validation = Dataset.of_robots(validated).grouped_by_points() if validated else None
    return replace(first, problem=problem, record=replace(record, validation=validation), published={})


def _also_of_folders(
    function: Callable[Concatenate[Source, _Options], Calibration],
) -> Callable[Concatenate[Source | Instance | str | Path, _Options], Calibration]:
    """Return `calibration.calibrate` for instances and names, too: what is not stated is then as the folder has it."""

    @wraps(function, assigned=("__name__", "__qualname__", "__doc__"))
    def calibrate(
        problem: Source | Instance | str | Path, *arguments: _Options.args, **options: _Options.kwargs
    ) -> Calibration:
        if isinstance(problem, str | Path):
            problem = load(problem)
        if not isinstance(problem, Instance):
            if not hasattr(problem, "parameters"):  # for instance measurements
                accepted = "a problem, what `load` returns, or a problem's name or folder"
                raise InputError("problem", f"a {type(problem).__name__}", accepted)
            return function(problem, *arguments, **options)
        bound = signature(function).bind(problem.problem, *arguments, **options).arguments
        return problem.calibrate(**{name: value for name, value in bound.items() if name != "problem"})

    return calibrate


calibrate = _also_of_folders(identify.calibrate)
"""Identify the parameters of a problem, an `Instance`, or one that `load` finds by its name or folder.

Arguments and errors are those of `calibration.calibrate`; those not given are the instance's.

>>> import rpim_opt as ro
>>> ro.calibrate("paper_arm").selector, ro.calibrate(ro.load("paper_arm"), weight="reml").selector
('l_curve', 'reml')
"""


def _formulation(stated: problem_file.ProblemFile, problem: CalibrationProblem) -> Formulation:
    """Return the formulation with the file's constraints, each of which must fit the parameters."""
    with problem_file.at_key("formulation", stated.path):
        formulation = formulation_of(stated.table.formulation)
    with problem_file.at_key("constraints", stated.path, part=True):
        own = stated.table.constraints.all(problem.robot, problem.data)
        formulation = replace(formulation, constraints=(*formulation.constraints, *own))
        parameters = problem.identified
        for constraint in formulation.constraints:
            if isinstance(constraint, Box):
                constraint.bounds(parameters)
                continue
            from rpim_opt.convex.unknown import Unknown  # a variable of CVXPY

            z = Unknown(parameters.names)
            constraint(z, arguments_of(z, parameters))
            if isinstance(constraint, Parsed):
                constraint.require_near(parameters)
    return formulation


def _read_tables(stated: problem_file.ProblemFile) -> tuple[dict[str, Dataset], dict[str, list[str]]]:
    """Return the measurements and the names of their files by role."""
    files: dict[str, list[str]] = {role: [] for role in ROLES}
    parts: dict[str, list[Dataset]] = {role: [] for role in ROLES}
    for each, role in product(stated.observations, ROLES):
        file = getattr(each, role)
        if not file:
            continue
        kind = stated.kinds[each.measurement]
        source: Any = stated.path.parent / file
        if stated.board is not None and kind.by_camera:
            with in_file(source):
                source = on_board(read_columns(source), stated.board)
        with in_file(stated.path):
            data = read_data(source, stated.robot, each.noise or stated.table.noise, kind)
        files[role].append(file)
        parts[role].append(data)
    stems = {role: [Path(file).stem for file in names] for role, names in files.items() if names}
    whole = {role: Dataset.together(parts[role], names) for role, names in stems.items()}
    for label in stated.table.exclude:
        if not any(label in each.label for each in whole.values()):
            raise InputError("key exclude", f"label '{label}'", "a label of the data", stated.path)
    for role, each in whole.items():
        rest = each.without(stated.table.exclude)
        if not len(rest):
            file = stated.path.parent / files[role][0]
            raise InputError("the table", "no remaining row (all are excluded)", "at least one", file)
        whole[role] = _with_known(rest, stated.table, role, stated.path)
    return whole, files


def _with_known(data: Dataset, table: problem_file.ProblemTable, role: str, path: Path) -> Dataset:
    """Return the measurements of a role with the known distances and angles of what they touch."""
    known: list[Known] = []
    distances = [(f"key known_distance {i}.sigma_mm", each) for i, each in enumerate(table.known_distance, start=1)]
    angles = [(f"key known_angle {i}.sigma_mrad", each) for i, each in enumerate(table.known_angle, start=1)]
    for where, each in (*distances, *angles):
        if each.sigma is None and not each.validation:
            raise InputError(where, "nothing", "the standard deviation of the stated value", path)
        if each.validation != (role == "validation"):
            continue
        first, second = each.between
        sigma = UNSTATED if each.sigma is None else each.sigma
        if isinstance(each, problem_file.DistanceTable):
            known.append(KnownDistance((first, second), each.distance, sigma))
        else:
            known.append(KnownAngle((first, second), each.deg == 0, sigma))
    with in_file(path):
        whole = with_known(data, known)
        blocks = [(block, block.touched) for block in whole.blocks if block.touched is not None]
        joined = {name for block, rows in blocks if not block.measurement.touching for names in rows for name in names}
        touches: dict[str, list[tuple[str, bool]]] = {}  # label and whether a plane is touched, by touched object
        for block, rows in blocks:
            for i, names in zip(block.row, rows, strict=True):
                if block.measurement.touching:
                    touches.setdefault(names[0], []).append((whole.label[i], block.measurement.planar))
        for name, those in touches.items():  # so few touches of a point or plane are not informative
            label, planar = those[-1]
            least, column = (4, "plane") if planar else (2, "point")
            if len(those) < least - (name in joined):
                accepted = f"{least} or more, one less where a known distance or angle joins it to another"
                raise InputError(f"row {label}, column {column}", f"'{name}' touched {len(those)} times", accepted)
    return whole
