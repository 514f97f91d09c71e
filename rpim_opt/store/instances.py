"""Problem folders: ``robot.toml``, ``problem.toml`` and tables become a problem with its validation data."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Any, Concatenate, NamedTuple, ParamSpec

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import inside, sha256_of
from rpim_opt.basics.layout import TableOptions
from rpim_opt.basics.tables import Columns, read_columns
from rpim_opt.basics.text import Tabled, shortened
from rpim_opt.basics.units import UNITS
from rpim_opt.bayes.prior import Prior
from rpim_opt.calibration import identify
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.constraints import Box, Constraint, Parsed
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.given import given
from rpim_opt.convex.rules.selection import Selector
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.data.measurements.camera import Board, on_board
from rpim_opt.data.measurements.contact import Known, KnownAngle, KnownDistance, with_known
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.record import Record, Requirement
from rpim_opt.data.tables.reading import read_data, robodk_columns
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.linear import identified_of
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.frames import starting_parameters
from rpim_opt.robot.library import find_robot
from rpim_opt.robot.parameters import Parameters
from rpim_opt.robot.terms import Model as KinematicModel
from rpim_opt.store.prior_file import stated_prior
from rpim_opt.store.problem_file import (
    AngleTable,
    DistanceTable,
    Observation,
    ProblemFile,
    ProblemTable,
    named_formulation,
    named_weight,
    read_problem,
    stated_scatter,
)
from rpim_opt.store.statements import place_fixtures, stated_details, stated_requirement

ROLES = ("identification", "validation")
Tools = Mapping[str, tuple[float, ...]]
UNSTATED = 1e-5
"""Standard deviation [m or rad] of what only validates, where none is stated: of a good machine tool."""
RIGHT = (0.0, 90.0)
"""Angles [deg] that two planes may be known to have."""


@dataclass(frozen=True, eq=False, repr=False)
class Instance(Tabled):
    """A calibration problem as its folder states it.

    Parameters
    ----------
    title, source
        What it is, and where every figure comes from.
    problem
        Robot, parameters and identification data.
    validation
        Measurements that no step of the calibration may see; None when there are none.
    formulation, weight, model
        How the folder wants it solved; weight None where sizes are learned, model ``"auto"`` for families that the
        evidence wants.
    noise
        What of the noise is learned, as `calibrate` has it.
    details
        Who measured, when, with which instrument, ... as the folder states it.
    requirement
        What the robot is accepted by; None where the folder demands nothing.
    prior
        What the folder believes of the deviations.
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
    reading
        How the tables that it was made from were read.
    held_out
        Whether the validation data were drawn from the same table: once they have validated, all rows are used.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> result = instance.calibrate()
    >>> instance.record.title, instance.excluded["T8-7"], instance.published["validation"]["RPIM"]
    ("The paper's cooperative manipulator", 'z misprinted, off by 15.0 mm', 0.468)
    """

    title: str
    source: str
    problem: CalibrationProblem
    validation: Dataset | None
    formulation: Formulation
    weight: float | Selector | None
    prior: Prior = field(default_factory=Prior)
    published: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    reference: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    simulation: Mapping[str, Any] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    excluded: Mapping[str, str] = field(default_factory=dict)
    model: str = "geometry"
    noise: str = "robot"
    details: Mapping[str, str] = field(default_factory=dict)
    requirement: Requirement | None = None
    reading: Mapping[str, str] = field(default_factory=dict)
    held_out: bool = False

    def _short(self) -> str:
        return f"'{shortened(self.title)}' {self.problem._short()}"

    def _frame_rows(self) -> list[dict[str, Any]]:
        """Return the identified parameters."""
        return self.problem.parameters.free._frame_rows()

    def _notes(self) -> list[str]:
        return [self.source]

    def calibrate(self, **changes: Any) -> Calibration:
        """Return the calibration as the folder wants it, with its record.

        Parameters
        ----------
        changes
            Arguments of `calibrate` to use instead: ``weight="reml"``, ``formulation=ro.robust``, ``model="auto"``.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> result = ro.load("paper_arm").calibrate()
        >>> result.selector, result.record.title
        ('l_curve', "The paper's cooperative manipulator")
        """
        asked = {"formulation": self.formulation, "weight": self.weight, "prior": self.prior}
        asked |= {"model": self.model, "noise": self.noise}
        return replace(identify.calibrate(self.problem, **{**asked, **changes}), record=self.record)

    @property
    def record(self) -> Record:
        """What a saved result and its report say of the data: title, source, validation data, files, excluded rows."""
        return Record(
            self.title,
            self.source,
            self.validation,
            self.files,
            self.excluded,
            bool(self.simulation),
            details=self.details,
            requirement=self.requirement,
            reading=self.reading,
        )


def load(
    name: str | Path,
    variant: str | None = None,
    measurements: Sequence[Measurement] = (),
    model: KinematicModel | None = None,
) -> Instance:
    """Return a problem from its folder, or from the name of one that comes with the package.

    Parameters
    ----------
    name
        A folder with ``problem.toml`` (its format: the guide "Your own robot"), that file, or the name of one that
        comes with the package.
    variant
        One of the file's ``[variant.NAME]`` tables, laid over the other keys.
    measurements
        Measurement models of your own that the file may name.
    model
        Terms of your own: the file may identify and scale their parameters, its tables have the columns that they see.

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
    stated = read_problem(name, variant, measurements, model)
    table = stated.table
    path = stated.path
    tables = _read_tables(stated)
    try:
        problem = _problem(stated, tables)
        formulation = _formulation(stated, problem)
        prior = stated_prior(table.prior, table.scale, problem.parameters, path, measurements)
        details = stated_details(table.record)
        TableOptions.stated(table.reading)
        requirement = stated_requirement(table.acceptance, problem.robot)
    except InputError as error:
        raise error.within(path) from None
    return Instance(
        title=table.title,
        source=table.source,
        problem=problem,
        validation=tables.validation,
        formulation=formulation,
        weight=named_weight(table.selector, path),
        prior=prior,
        published=_published(table, tables, path),
        reference=_reference(table, path),
        simulation=table.simulation,
        files=_hashes(stated, tables),
        excluded=table.exclude,
        model=table.model,
        noise=table.scatter if isinstance(table.scatter, str) else "declared",
        details=details,
        requirement=requirement,
        reading=table.reading,
        held_out=table.held_out,
    )


_Options = ParamSpec("_Options")


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
            return function(problem, *arguments, **options)
        stated = signature(function).bind(problem.problem, *arguments, **options).arguments
        del stated["problem"]
        return problem.calibrate(**stated)

    return calibrate


calibrate = _also_of_folders(identify.calibrate)
"""Identify the parameters of a problem, an `Instance`, or one that `load` finds by its name or folder.

Arguments and errors as for `calibration.calibrate`; what is not stated is as the instance has it.

>>> import rpim_opt as ro
>>> ro.calibrate("paper_arm").selector, ro.calibrate(ro.load("paper_arm"), weight="reml").selector
('l_curve', 'reml')
"""


def _problem(stated: ProblemFile, tables: _Tables) -> CalibrationProblem:
    """Return the problem, whose robot and reflectors the validation data must have, too."""
    data = tables.identification
    fixtures = place_fixtures(stated.placed, data)
    temperature = None
    if stated.table.celsius is not None:
        temperature = stated.table.celsius + UNITS["degC"].zero
    parameters = starting_parameters(stated.robot, data, stated.base, tables.tools, fixtures, temperature)
    problem = CalibrationProblem(stated.robot, stated.chosen(parameters, data), data)
    if tables.validation is not None:
        problem.on(tables.validation)
    return problem.scattered(stated_scatter(stated.table, stated.path))


def _formulation(stated: ProblemFile, problem: CalibrationProblem) -> Formulation:
    """Return the formulation with the file's constraints, each of which must fit the parameters."""
    table, path = stated.table, stated.path
    formulation = named_formulation(table.formulation, path)
    demands = table.constraints.all(problem.robot, problem.data)
    formulation = replace(formulation, constraints=(*formulation.constraints, *demands))
    parameters = identified_of(problem.robot, problem.parameters, problem.data)
    for constraint in formulation.constraints:
        if isinstance(constraint, Box):
            constraint.bounds(parameters)
        else:
            _require_fit(constraint, parameters)
    for demand in demands:
        if isinstance(demand, Parsed):
            demand.require_near(parameters)
    return formulation


def _require_fit(constraint: Constraint, parameters: Parameters) -> None:
    """Ask a constraint of the file for what it demands of the parameters, or raise its InputError."""
    from rpim_opt.convex.unknown import Unknown  # a variable of CVXPY

    z = Unknown(parameters.names)
    constraint(z, given(z, parameters))


def _published(table: ProblemTable, tables: _Tables, path: Path) -> dict[str, Mapping[str, float]]:
    for file in table.published:
        if not inside(path.parent, file, "table published", path).is_file():
            raise InputError("table published", f"'{file}'", "the name of a table in this folder", path)
    return {role: table.published.get(files[0], {}) for role, files in tables.files.items() if files}


def _reference(table: ProblemTable, path: Path) -> dict[str, tuple[float, float]]:
    for key, pair in table.reference.items():
        if len(pair) != 2:
            raise InputError(f"key reference.{key}", f"{pair}", "[value, tolerance]", path)
    return {key: (value, spread) for key, (value, spread) in table.reference.items()}


def _hashes(stated: ProblemFile, tables: _Tables) -> dict[str, str]:
    folder = stated.path.parent
    drawing = find_robot(stated.table.robot, folder)
    used = {stated.path.name: stated.path, drawing.name: drawing}
    if isinstance(stated.table.target, str):
        used[stated.table.target] = folder / stated.table.target
    for files in tables.files.values():
        used |= {file: folder / file for file in files}
    used |= stated.table.prior.files(stated.path)
    return {name: sha256_of(file) for name, file in used.items()}


# --- the tables of a folder, without the excluded rows -----------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Tables:
    """What the tables of a folder hold: both sets of data, the files of each role, and where the reflectors start."""

    identification: Dataset
    validation: Dataset | None
    files: Mapping[str, Sequence[str]]
    tools: Tools


class _Part(NamedTuple):
    """One table of the folder."""

    role: str
    file: str
    data: Dataset


def _read_tables(stated: ProblemFile) -> _Tables:
    """Return the measurements that a problem file names."""
    # RoboDK's export states the tools [mm] itself; the file's own go before them
    tcps = {marker: [1e3 * v for v in frame[:3]] for marker, frame in stated.tools.items() if stated.table.tool}
    parts = list(_parts(stated, tcps))
    files = {role: [part.file for part in parts if part.role == role] for role in ROLES}
    sets = {}
    for role in ROLES:
        if files[role]:
            own = [part.data for part in parts if part.role == role]
            sets[role] = Dataset.together(own, [Path(file).stem for file in files[role]])
    labels = {label for data in sets.values() for label in data.label}
    for label in stated.table.exclude:
        if label not in labels:
            raise InputError("key exclude", f"label '{label}'", "a label of the data", stated.path)
    for role, data in sets.items():
        rest = data.without(stated.table.exclude)
        if not len(rest):
            file = stated.path.parent / files[role][0]
            raise InputError("the table", "no row that is not excluded", "at least one", file)
        sets[role] = _with_known(rest, stated.table, role, stated.path)
    return _Tables(sets["identification"], sets.get("validation"), files, _tools(stated, tcps))


def _parts(stated: ProblemFile, tcps: dict[str, list[float]]) -> Iterator[_Part]:
    """Read the tables in the file's order, in which RoboDK's reflectors get their names."""
    for each in stated.observations:
        for role in ROLES:
            file = getattr(each, role)
            if file:
                yield _Part(role, file, _read(stated, each, file, tcps))


def _read(stated: ProblemFile, each: Observation, file: str, tcps: dict[str, list[float]]) -> Dataset:
    path = stated.path.parent / file
    robodk = each.layout == "robodk"
    try:
        source: Any = robodk_columns(path, stated.robot.joint_dimensions, tcps) if robodk else path
        if stated.board is not None and stated.kinds[each.measurement].by_camera:
            source = _seen(path, stated.board)
        return read_data(source, stated.robot, each.noise or stated.table.noise, stated.kinds[each.measurement])
    except InputError as error:
        at_fault = path if robodk and error.where.startswith("row") else stated.path
        raise error.within(at_fault) from None


def _seen(path: Path, board: Board) -> Columns:
    """Return the columns of a table of corners, with where their points are on the board."""
    try:
        return on_board(read_columns(path), board)
    except InputError as error:
        raise error.within(path) from None


def _tools(stated: ProblemFile, tcps: Mapping[str, list[float]]) -> Tools:
    if all(each.layout != "robodk" for each in stated.observations):
        return stated.tools
    exported = {marker: (*(1e-3 * v for v in tcp), 0.0, 0.0, 0.0) for marker, tcp in tcps.items()}
    return {marker: stated.tools.get(marker, place) for marker, place in exported.items()}


# --- [[known_distance]] and [[known_angle]] between touched points and planes ------------------------------------


def _with_known(data: Dataset, table: ProblemTable, role: str, path: Path) -> Dataset:
    """Return the measurements of a role with what a file knows of the points and planes that they touch."""
    known: list[Known] = []
    for number, distance in enumerate(table.known_distance, start=1):
        where = f"key known_distance {number}"
        pair, sigma = _pair(distance, where, path), _sigma(distance, f"{where}.sigma_mm", path)
        if distance.validation == (role == "validation"):
            known.append(KnownDistance(pair, distance.distance, sigma))
    for number, angle in enumerate(table.known_angle, start=1):
        where = f"key known_angle {number}"
        if angle.deg not in RIGHT:
            raise InputError(f"{where}.deg", f"{angle.deg:g}", "0 (parallel) or 90 (square)", path)
        pair, sigma = _pair(angle, where, path), _sigma(angle, f"{where}.sigma_mrad", path)
        if angle.validation == (role == "validation"):
            known.append(KnownAngle(pair, angle.deg == 0, sigma))
    try:
        whole = with_known(data, known)
        _require_enough(whole)
    except InputError as error:
        raise error.within(path) from None
    return whole


def _pair(table: DistanceTable | AngleTable, where: str, path: Path) -> tuple[str, str]:
    if len(table.between) != 2:
        raise InputError(f"{where}.between", f"{len(table.between)} names", "two", path)
    first, second = table.between
    return first, second


def _sigma(table: DistanceTable | AngleTable, where: str, path: Path) -> float:
    if table.sigma is not None:
        return table.sigma
    if not table.validation:
        raise InputError(where, "nothing", "the standard deviation of what the drawing states", path)
    return UNSTATED


def _require_enough(data: Dataset) -> None:
    """Refuse what was touched so few times that its touches say nothing."""
    blocks = [(block, block.touched) for block in data.blocks if block.touched is not None]
    joined = {name for block, rows in blocks if not block.measurement.touching for names in rows for name in names}
    count: Counter[str] = Counter()
    last: dict[str, tuple[Block, str]] = {}
    for block, rows in blocks:
        if block.measurement.touching:
            count.update(names[0] for names in rows)
            last |= {names[0]: (block, data.label[i]) for i, names in zip(block.row, rows, strict=True)}
    for name, touches in count.items():
        block, label = last[name]
        least, column = (4, "plane") if block.measurement.planar else (2, "point")
        if touches < least - (name in joined):
            accepted = f"{least} or more, one less where a [[known_distance]] or [[known_angle]] joins it to another"
            raise InputError(f"row {label}, column {column}", f"'{name}' touched {touches} times", accepted)
