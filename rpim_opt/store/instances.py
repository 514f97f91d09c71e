"""Problem folders: ``robot.toml``, ``problem.toml`` and tables become a problem with its validation data."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import Any, Concatenate, ParamSpec

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import inside, sha256_of
from rpim_opt.basics.text import Tabled, shortened
from rpim_opt.basics.units import UNITS
from rpim_opt.bayes.prior import Prior
from rpim_opt.calibration import asking
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.constraints import Box, Constraint
from rpim_opt.convex.drawn import Drawn
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.given import given
from rpim_opt.convex.rules.selection import Selector
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.record import Record, Requirement
from rpim_opt.problem.identified import identified_of
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.frames import starting_parameters
from rpim_opt.problem.source import Source
from rpim_opt.robot.library import find_robot
from rpim_opt.robot.parameters import Parameters
from rpim_opt.robot.terms import Model as KinematicModel
from rpim_opt.store.observations import Tables, read_tables
from rpim_opt.store.prior_file import stated_prior
from rpim_opt.store.problem_file import (
    ProblemTable,
    Stated,
    named_formulation,
    named_weight,
    read_problem,
    stated_scatter,
)
from rpim_opt.store.statements import place_fixtures, stated_details, stated_requirement


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
        return replace(asking.calibrate(self.problem, **{**asked, **changes}), record=self.record)

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
    tables = read_tables(stated)
    try:
        problem = _problem(stated, tables)
        formulation = _formulation(stated, problem)
        prior = stated_prior(table.prior, table.scale, problem.parameters, path, measurements)
        details = stated_details(table.record)
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


calibrate = _also_of_folders(asking.calibrate)
"""Identify the parameters of a problem, an `Instance`, or one that `load` finds by its name or folder.

Arguments and errors as for `calibration.calibrate`; what is not stated is as the instance has it.

>>> import rpim_opt as ro
>>> ro.calibrate("paper_arm").selector, ro.calibrate(ro.load("paper_arm"), weight="reml").selector
('l_curve', 'reml')
"""


def _problem(stated: Stated, tables: Tables) -> CalibrationProblem:
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


def _formulation(stated: Stated, problem: CalibrationProblem) -> Formulation:
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
        if isinstance(demand, Drawn):
            demand.require_near(parameters)
    return formulation


def _require_fit(constraint: Constraint, parameters: Parameters) -> None:
    """Ask a constraint of the file for what it demands of the parameters, or raise its InputError."""
    from rpim_opt.convex.unknown import Unknown  # a variable of CVXPY

    z = Unknown(parameters.names)
    constraint(z, given(z, parameters))


def _published(table: ProblemTable, tables: Tables, path: Path) -> dict[str, Mapping[str, float]]:
    for file in table.published:
        if not inside(path.parent, file, "table published", path).is_file():
            raise InputError("table published", f"'{file}'", "the name of a table in this folder", path)
    return {role: table.published.get(files[0], {}) for role, files in tables.files.items() if files}


def _reference(table: ProblemTable, path: Path) -> dict[str, tuple[float, float]]:
    for key, pair in table.reference.items():
        if len(pair) != 2:
            raise InputError(f"key reference.{key}", f"{pair}", "[value, tolerance]", path)
    return {key: (value, spread) for key, (value, spread) in table.reference.items()}


def _hashes(stated: Stated, tables: Tables) -> dict[str, str]:
    folder = stated.path.parent
    drawing = find_robot(stated.table.robot, folder)
    used = {stated.path.name: stated.path, drawing.name: drawing}
    if isinstance(stated.table.target, str):
        used[stated.table.target] = folder / stated.table.target
    for files in tables.files.values():
        used |= {file: folder / file for file in files}
    used |= stated.table.prior.files(stated.path)
    return {name: sha256_of(file) for name, file in used.items()}
