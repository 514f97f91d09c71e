"""Result files: a calibration in one JSON file, independent of the problem's folder."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple, get_origin

import numpy as np

from rpim_opt.basics.arrays import Array, statistics
from rpim_opt.basics.exceptions import InputError, choices, pick
from rpim_opt.basics.files import read_json, write_json
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.bayes.hyperparameters import Learned
from rpim_opt.bayes.prior_terms import prior_penalty
from rpim_opt.calibration.certificate import Certificate
from rpim_opt.calibration.diagnosis import ActiveBound, ShadowPrice
from rpim_opt.calibration.held_out import sets
from rpim_opt.calibration.identify import calibrate, mapped_as
from rpim_opt.calibration.loop import Iteration
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex import constraints
from rpim_opt.convex.expressions import LARGEST, NORM1, NORM2, SQUARES, SUM
from rpim_opt.convex.formulation import Formulation, huber, unavailable
from rpim_opt.convex.program import pose
from rpim_opt.convex.quadratic import Quadratic
from rpim_opt.convex.robust_loss import kept_equations
from rpim_opt.convex.rules.selection import Selection, Selector
from rpim_opt.convex.select import SELECTORS
from rpim_opt.data.dataset import Block, Dataset, named_sessions
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.measurements.registry import READY
from rpim_opt.data.record import Record
from rpim_opt.problem.noise import Repeatability
from rpim_opt.problem.problem import CalibrationProblem, around
from rpim_opt.problem.registration.global_start import JointMapping
from rpim_opt.robot.chain import RowOrigins, origins_term, row_origins
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import Parameters
from rpim_opt.robot.terms import Curve, Model, Term, transmission
from rpim_opt.store.own_code import is_own, own_object

FORMAT = "rpim-opt result"
VERSION = 3
Models = Model | Mapping[str, Model]
SHARED = ("x", "weight", "selection", "converged", "message", "history", "certificate", "learned", "mapping")
CONSTRAINED = ("active_bounds", "active_constraints", "moves", "shadow_prices")
DERIVED = (*CONSTRAINED, "record", "causes")
"""Fields that a calibration and its file share by name, and values that a calibration derives."""
RELATIVE = 1e-4  # relative differences between processors in standard deviations of hardly identifiable directions
ABSOLUTE = 1e-6  # Largest difference between a small figure [mm, deg] and the one recomputed from the data.
FUNCTIONS: dict[str, Callable[..., Any]] = {
    "sum_squares": SQUARES, "sum": SUM, "max": LARGEST, "norm1": NORM1, "norm2": NORM2, "huber": huber,
    "prior_penalty": prior_penalty,
    **{name: getattr(constraints, name) for name in ("within_tolerance", "by_link", "by_kind", "at_nominal", "signed",
                                                     "equal", "in_ball", "differences", "parse")},
}  # fmt: skip
"""Functions of a formulation that a file names; makers of functions are named in a list with their arguments."""


@one_blas_thread
def save_result(result: Calibration, path: str | Path) -> None:
    """Write a calibration to one JSON file, or ``result.json`` in a folder, which `load_result` reads.

    The file is written completely or not at all. Title, validation data and input files are those of the calibration's
    record. The file states the verdict; if it was not computed before, likely causes of a bad fit are sought first,
    which takes seconds. InputError for a `PartitionedProblem`, whose measurements the file cannot hold.
    """
    if not result.problem.keeps_rows:
        raise InputError("save_result", "data in blocks", "data in memory, which the file repeats")
    write_json(_result_path(path), content(result))


def load_result(path: str | Path, measurements: Sequence[Measurement] = (), model: Models | None = None) -> Calibration:
    """Return the calibration that a file holds.

    A digest shows accidental changes since the file was written; it does not protect against somebody who writes a new
    digest. The errors of all rows are recomputed and compared with those in the file. A formulation with a script's
    functions is restored by name only: it cannot be solved again, everything else works.

    ``path`` is a file of `save_result`, or a folder with ``result.json``. ``measurements`` are the user-defined
    measurement types that the file names, ``model`` has the calibration's user-defined terms, for several robots also
    by name: a file holds only their names, no functions. They are checked by names, columns and the errors of all rows.
    InputError names the file, the key, what was found and what is accepted.

    >>> import rpim_opt as ro
    >>> ro.store.save_result(ro.load("paper_arm").calibrate(), "result.json")
    >>> again = ro.load_result("result.json")  # without the problem's folder
    >>> print(f"{1e3 * again.errors(again.record.validation).mean():.3f} mm")
    0.032 mm
    """
    path = _result_path(path)
    stored = read_json(path)
    try:
        if not isinstance(stored, dict) or stored.get("format") != FORMAT:
            accepted = "a file of `rpim-opt calibrate --out` or save_result()"
            raise InputError("the file", "no result of rpim-opt", accepted)
        if stored.get("version") != VERSION:
            accepted = f"{VERSION}; read other versions with the rpim-opt that wrote them"
            raise InputError("key version", repr(stored.get("version"))[:40], accepted)
        known = str(stored.get("digest", "nothing"))
        if known != digest(stored):
            found = f"{known[:12]}, content digest {digest(stored)[:12]}"
            raise InputError("key digest", found, "the unmodified file: its content was changed")
        file: Stored = _converter().structure(stored, Stored)
        ready = {**READY, **{m.name: m for m in measurements}}
        kinds = {str(block.measurement) for part in file.data.values() for block in part.blocks}
        for kind in filter(is_own, kinds - set(ready)):
            ready[kind] = replace(own_object(kind, Measurement, "key data", path), name=kind)
        if model is None:
            model = Model([own_object(term, Term, "key record.terms", path) for term in file.record.terms])
        result = _calibration(file, ready, model)
        for name, rows in _rows(result).items():
            for before, now in zip(file.rows.get(name, ()), rows, strict=True):
                errors = np.array([before[1:], now[1:]], dtype=float)  # NaN for none
                if before.label == now.label and np.allclose(*errors, rtol=RELATIVE, atol=ABSOLUTE, equal_nan=True):
                    continue
                accepted = f"{now.identified_mm} mm, which follows from the file's data, terms and measurement models"
                raise InputError(f"key rows.{name}, row {before.label}", f"{before.identified_mm} mm", accepted)
        result.outside(result.problem.data)  # ranges of earlier calibrations have to fit this robot's joints
    except InputError as error:
        raise error.within(path) from None
    except (TypeError, ValueError, LookupError, ArithmeticError, AttributeError, RuntimeError) as error:
        # of a file put together by hand, with a digest
        found = f"inconsistent content ({type(error).__name__}: {error})"
        raise InputError("the file", found, "an unmodified file", path) from None
    return result


def _result_path(path: str | Path) -> Path:
    path = Path(path)
    return path / "result.json" if path.is_dir() else path


# --- what a file holds -------------------------------------------------------------------------------------------


class OwnTerm(NamedTuple):
    """A user-defined term without its function: where it acts, its parameters and columns."""

    at: str
    parameters: list[str]
    columns: dict[str, str]

    def __str__(self) -> str:
        columns = [f"column {name} ({dimension or 'no unit'})" for name, dimension in self.columns.items()]
        return f"a term of the {self.at} ({', '.join([*self.parameters, *columns]) or 'without parameters'})"


class StoredInliers(NamedTuple):
    """Equations that a script's loss kept, and their factor."""

    factor: float
    left_out: list[int]


class Forms(NamedTuple):
    """The quadratic forms of a script's loss (of the residual) and penalty (of z)."""

    loss: Quadratic | None
    penalty: Quadratic | None


class RowErrors(NamedTuple):
    """The errors of one row [mm], before and after; None if it measures no length."""

    label: str
    nominal_mm: float | None
    identified_mm: float | None


@dataclass(frozen=True, eq=False)
class Stored:
    """The primary content of a result file in SI, from which everything else follows."""

    formulation: str  # Name of the formulation.
    definition: dict[str, Any]  # Its loss, penalty and constraints.
    forms: Forms | None  # Quadratic forms of a script's loss and penalty.
    weight: float  # Regularization weight.
    selection: Selection | None  # Choice of the weight with its evidence.
    converged: bool  # Whether the certificate holds.
    message: str  # How the iteration ended.
    history: tuple[Iteration, ...]  # Objective, step, weight and damping of every iteration.
    x: Array  # Deviations of the identified parameters [SI].
    certificate: Certificate  # Optimality gap and violation.
    inliers: StoredInliers | None  # Equations that a script's loss downweighted or left out.
    active_bounds: tuple[ActiveBound, ...]  # Parameters at an active bound.
    shadow_prices: tuple[ShadowPrice, ...]  # Multipliers of the constraints.
    robots: dict[str, Robot]  # Nominal robots.
    terms: dict[str, list[OwnTerm]]  # Terms of a script's own, without their functions.
    transmission: tuple[Curve, ...]  # Transmission errors of the joints.
    origins: dict[str, tuple[RowOrigins, ...]]  # Origins of a URDF's joints that displace the robots' rows.
    model: Parameters  # All parameters: nominal, prior scale, tolerance, identified.
    data: dict[str, Dataset]  # Identification and validation data.
    repeatability: Repeatability | None  # Repeatability of the robot.
    learned: Learned | None  # Estimated prior scales and noise with their evidence.
    record: Record  # Title, source, files and excluded rows.
    causes: tuple[str, ...]  # Likely mistakes in the data.
    rows: dict[str, list[RowErrors]]  # Errors of every row [mm], nominal and identified.
    active_constraints: tuple[str, ...] = ()  # Constraints on which standard deviations are conditional.
    moves: Array | None = None  # Basis of the steps [prior scales] that active constraints leave.
    mapping: JointMapping | None = None  # Signs and offsets of joints that the global start found.
    digest: str = ""  # SHA-256 of the content.


def content(result: Calibration) -> dict[str, Any]:
    """Return the content of a result file: figures [mm, deg], the data they follow from [SI], and a digest."""
    from rpim_opt.calibration.acceptance import accept  # few robots have an acceptance test

    result = replace(result, record=result.record.dated(), known={**result.known, "causes": result.causes})
    functions = definition(result.formulation)
    solvable = formulation_of("", functions).solvable
    arms = dict(result.problem.arms)
    stored = Stored(
        **{name: getattr(result, name) for name in (*SHARED, *DERIVED)},
        formulation=result.formulation.name,
        definition=functions,
        inliers=None if solvable else _inliers(result),
        forms=None if solvable else Forms(result.program.loss_form, result.program.penalty_form),
        robots=arms,
        terms={name: _terms(robot.model, robot) for name, robot in arms.items()},
        transmission=tuple(curve for robot in arms.values() for curve in robot.model.curves),
        origins={name: row_origins(robot.model.terms) for name, robot in arms.items()},
        rows=_rows(result),
        model=result.problem.parameters,
        data=sets(result),
        repeatability=result.problem.repeatability,
    )
    parts = {
        "format": FORMAT,
        "version": VERSION,
        "title": result.record.title,
        **figures(result),
        "nominal": {name: statistics(result.nominal_errors(data)) for name, data in sets(result).items()},
        **_converter().unstructure(stored),
        "acceptance": None if result.record.requirement is None else accept(result).content(),
    }
    return {**parts, "digest": digest(parts)}


def figures(result: Calibration) -> dict[str, Any]:
    """Return the main figures: errors [mm], the weight and its origin, the parameters."""
    validation = None
    if result.record.validation is not None:
        validation = statistics(result.errors(result.record.validation))
    held_out = result.record.held_out
    if held_out is not None:
        before, validation = statistics(held_out.nominal), statistics(held_out.error)
        held_out = {"nominal": before, "identified": validation, "used": held_out.used}
    return {
        "verdict": result.verdict.content(),
        "identification": statistics(result.errors()),
        "validation": validation,
        "held_out": held_out,
        "weight": result.weight,
        "selector": result.selector,
        "corner": None if result.selection is None else bool(result.selection.interior),
        "formulation": result.formulation.name,
        "converged": result.converged,
        "message": result.message,
        "iterations": len(result.history),
        "flagged": result.outliers,
        "parameters": [{"name": row.pop("parameter"), **row} for row in result.parameter_rows()],
    }


def _rows(result: Calibration) -> dict[str, list[RowErrors]]:
    rows = {}
    for name, data in sets(result).items():
        errors = (1e3 * result.nominal_errors(data), 1e3 * result.errors(data))
        columns = [[value if math.isfinite(value) else None for value in each.tolist()] for each in errors]
        rows[name] = list(map(RowErrors, data.label, *columns))
    return rows


def _terms(model: Model, robot: Robot) -> list[OwnTerm]:
    """Return what a file holds of a user's own terms on a robot: all but their functions."""
    own = [term for term in model.terms if not term.ready]
    names = [[name for i in term.places(robot.joint_types) for name in term.names(i)] for term in own]
    return [OwnTerm(term.at, named, dict(term.columns)) for term, named in zip(own, names, strict=True)]


def _inliers(result: Calibration) -> StoredInliers | None:
    """Return the equations that a script's loss kept; a ready loss recomputes them."""
    if "inliers" in result.known:  # stated in an earlier file
        return result.known["inliers"]
    inliers = None
    with suppress(InputError):  # a loss without a quadratic model
        inliers = result.program.inliers(result.z)
    if inliers is None:
        return None
    left_out = np.flatnonzero(~inliers.keeps(result.program.model, result.z))
    return StoredInliers(float(np.sqrt(inliers.factor)), left_out.tolist())


# --- formulations by the names of ready functions ----------------------------------------------------------------


def definition(formulation: Formulation) -> dict[str, Any]:
    """Return the names of a formulation's ready functions; None for those of a script."""
    return {
        "loss": _name(formulation.loss),
        "penalty": _name(formulation.penalty),
        "constraints": [_name(constraint) for constraint in formulation.constraints],
        "loss_over": formulation.loss_over,
        "penalty_over": _name(formulation.penalty_over),
    }


def formulation_of(name: str, stated: Mapping[str, Any]) -> Formulation:
    """Return the formulation of a file; with functions of a script it cannot be solved."""
    functions = {key: _function(stated[key], name) for key in ("loss", "penalty", "penalty_over")}
    constraints = tuple(_function(term, name) for term in stated["constraints"])
    solvable = None not in (*stated.values(), *stated["constraints"])
    return Formulation(name, **functions, constraints=constraints, loss_over=stated["loss_over"], solvable=solvable)


def _name(function: Callable[..., Any] | None) -> str | list[Any] | None:
    """Return the name of a ready function, or of its maker and the arguments; ``none`` for no function."""
    if function is None:
        return "none"
    known = next((name for name, ready in FUNCTIONS.items() if ready == function), None)
    call = getattr(function, "stated", None)
    if known or call is None:
        return known
    maker, *arguments = call
    return [maker, *(_name(each) if callable(each) else each for each in arguments)]


def _function(stated: Any, name: str) -> Any:
    if stated is None:
        return unavailable(name)
    if stated == "none":
        return None
    if isinstance(stated, str):
        return pick(FUNCTIONS, stated, "key definition")
    maker, *arguments = stated
    if maker == prior_penalty.__name__:
        arguments[0] = _function(arguments[0], name)
    return pick(FUNCTIONS, str(maker), "key definition")(*arguments)


# --- reading -----------------------------------------------------------------------------------------------------


def _calibration(file: Stored, known: Mapping[str, Measurement], models: Models) -> Calibration:
    robots = {name: _robot(name, file, models) for name in file.robots}
    data = {name: _with_measurements(part, known, f"key data.{name}") for name, part in file.data.items()}
    rows, validation = data["identification"], data.get("validation")
    problem = CalibrationProblem(robots.get("", robots), file.model, rows, repeatability=file.repeatability)
    if validation is not None:
        problem.on(validation)  # raises for rows that the problem's robot or reflectors cannot have
    formulation = formulation_of(file.formulation, file.definition)
    program = pose(formulation, around(problem.linearize(file.x), file.x), file.forms)
    learned = file.learned if not file.record.earlier else None
    weight: float | Selector | None = None  # estimated, as before
    if learned is None:
        weight = SELECTORS.get(file.selection.name, file.weight) if file.selection else file.weight
    extensions = "auto" if learned is not None and learned.trials else "geometry"
    again = partial(calibrate, formulation=formulation, weight=weight, model=extensions)
    known_already: dict[str, Any] = {"causes": file.causes}  # in place of what the calibration would compute
    if not program.formulation.solvable:  # as with a script's functions
        known_already |= {name: getattr(file, name) for name in (*CONSTRAINED, "inliers")}
        if file.inliers is not None:
            keep = np.ones(len(program.model.b), dtype=bool)
            keep[file.inliers.left_out] = False
            known_already["squares"] = kept_equations(program.model, keep, file.inliers.factor**2)
    return Calibration(
        problem,
        formulation,
        **{name: getattr(file, name) for name in SHARED},
        program=program,
        calibrate_again=mapped_as(file.mapping, again),
        record=replace(file.record, validation=validation, digest=file.digest),
        known=known_already,
    )


def _robot(name: str, file: Stored, models: Models) -> Robot:
    """Return a robot of the file with the terms that somebody gives again: by name, or one model for all."""
    terms = file.terms.get(name, [])
    model = models if isinstance(models, Model) else models.get(name, Model())
    if not isinstance(models, Model) and not name:
        raise InputError("model", "models by name", "a Model, for the one robot of the file")
    if name and not terms and isinstance(models, Model):
        model = Model()  # one model for all: a robot without terms has none of them
    robot = file.robots[name]
    own_terms = _terms(model, robot)
    if terms != own_terms:
        accepted = f"model=ro.Model(terms=[...]) with the calibration's terms: {'; '.join(map(str, terms)) or 'none'}"
        raise InputError("key terms", "; ".join(map(str, own_terms)) or "no term", accepted)
    curves = [transmission(curve) for curve in file.transmission if curve.joint <= len(robot.mdh) and not name]
    origins = [origins_term(carried) for carried in file.origins.get(name, ())]
    return replace(robot, model=Model((*origins, *model.terms, *curves)))


def _with_measurements(data: Dataset, known: Mapping[str, Measurement], where: str) -> Dataset:
    """Return data with the measurement types that their blocks name."""
    rows = sorted(row for block in data.blocks for row in block.row.tolist())
    if not rows == list(range(len(data))) == list(range(len(data.configuration))):
        raise InputError(where, f"rows {str(rows)[:40]}", f"0 to {len(data) - 1}, each once, with its configuration")
    blocks = []
    for number, block in enumerate(data.blocks, start=1):
        name = str(block.measurement)
        if name not in known:
            place = f"{where}.blocks {number}.measurement"
            raise InputError(place, f"'{name}'", f"measurements=[...] with it, or {choices(name, known)}")
        session = None if block.session is None else named_sessions(block.session, len(block.row))
        blocks.append(replace(block, measurement=known[name], session=session))
    return replace(data, blocks=tuple(blocks))


# --- dataclasses, named tuples, arrays and mappings as JSON and back, by annotations -----------------------------


def digest(content: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a file's content without its digest, independent of layout and order."""
    rest = {key: value for key, value in content.items() if key != "digest"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return sha256(text.encode()).hexdigest()


@cache
def _converter() -> Any:
    from cattrs import Converter
    from cattrs.cols import is_namedtuple, namedtuple_dict_structure_factory, namedtuple_dict_unstructure_factory
    from cattrs.gen import make_dict_structure_fn, make_dict_unstructure_fn, override

    made = Converter(detailed_validation=False)
    for kind in (bool, int, str):  # also NumPy's
        made.register_unstructure_hook(kind, kind)
    made.register_unstructure_hook(float, _spelled)
    made.register_structure_hook_factory(is_namedtuple, namedtuple_dict_structure_factory)
    made.register_unstructure_hook_factory(is_namedtuple, namedtuple_dict_unstructure_factory)
    made.register_structure_hook_func(_is_array, _array)
    made.register_unstructure_hook_func(_is_array, _listed)
    omitted = override(omit=True)
    by_name = override(unstruct_hook=lambda kind: kind.name, struct_hook=lambda name, _: name)
    fields: dict[type, dict[str, Any]] = {
        Record: {"validation": omitted, "digest": omitted},  # stored with the data; computed from the file
        Robot: {"model": omitted},  # a script's functions, given again by the user
        Block: {"measurement": by_name},
    }
    for kind, changes in fields.items():
        made.register_unstructure_hook(kind, make_dict_unstructure_fn(kind, made, **changes))
        made.register_structure_hook(kind, make_dict_structure_fn(kind, made, **changes))
    return made


def _spelled(value: float) -> float | str:
    """Return a number, as a text where JSON has none: inf, -inf, nan."""
    return float(value) if math.isfinite(value) else str(float(value))


def _is_array(kind: Any) -> bool:
    return kind is np.ndarray or get_origin(kind) is np.ndarray


def _listed(array: np.ndarray) -> Any:
    if array.dtype.kind != "f" or np.isfinite(array).all():
        return array.tolist()
    return [_listed(each) if array.ndim > 1 else _spelled(each) for each in array]


def _array(values: Any, kind: Any) -> np.ndarray:
    """Return lists as an array: of floats where the class has them, otherwise of integers, truth values or texts."""
    if kind is not np.ndarray:
        return np.array(values, dtype=float)  # also reads "nan" and "inf"
    array = np.array(values)
    if not array.size:
        return array.astype(int)
    return array.astype(object) if array.dtype.kind == "U" else array
