"""Result files: a calibration goes to one JSON file and comes back, without the problem's folder."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array, statistics
from rpim_opt.basics.exceptions import InputError, choices, pick
from rpim_opt.basics.files import read_json, write_json
from rpim_opt.basics.text import version_of
from rpim_opt.bayes.hyperparameters import Learned
from rpim_opt.bayes.prior_terms import believed
from rpim_opt.calibration.certificate import Certificate
from rpim_opt.calibration.diagnosis import Held, Price
from rpim_opt.calibration.identify import calibrate, mapped_as
from rpim_opt.calibration.result import Calibration, Iteration, Kept
from rpim_opt.convex import constraints
from rpim_opt.convex.expressions import LARGEST, NORM1, NORM2, SQUARES, SUM
from rpim_opt.convex.formulation import Formulation, huber, lost
from rpim_opt.convex.program import Program, pose
from rpim_opt.convex.quadratic import Quadratic
from rpim_opt.convex.rules.selection import Selection
from rpim_opt.convex.select import SELECTORS, Selector
from rpim_opt.convex.structure import Lost
from rpim_opt.convex.trust import kept_equations
from rpim_opt.data.dataset import Block, Dataset, named_sessions
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.measurements.registry import READY
from rpim_opt.data.record import Record
from rpim_opt.problem.linear import LinearModel, around
from rpim_opt.problem.noise import Scatter
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.global_start import JointMapping
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import Parameters
from rpim_opt.robot.terms import Curve, Model, Transmission, transmission
from rpim_opt.store.serialize import digest, plain, structured

FORMAT = "rpim-opt result"
VERSION = 2
Models = Model | Mapping[str, Model]
RELATIVE = 1e-4
"""Standard deviations of hardly identifiable directions differ by that much from one processor to another."""
ABSOLUTE = 1e-6
"""Largest difference [mm] of a stated figure and the one that follows from the data: a nanometre."""
FUNCTIONS: dict[str, Callable[..., Any]] = {
    "sum_squares": SQUARES,
    "sum": SUM,
    "max": LARGEST,
    "norm1": NORM1,
    "norm2": NORM2,
    "within_tolerance": constraints.within_tolerance,
    "by_link": constraints.by_link,
    "by_kind": constraints.by_kind,
}
"""Functions of a formulation that a file names; those that the next ones make are named with their arguments."""
MAKERS: dict[str, Callable[..., Any]] = {
    "huber": huber,
    "believed": believed,
    "at_nominal": constraints.at_nominal,
    "signed": constraints.signed,
    "equal": constraints.equal,
    "in_ball": constraints.in_ball,
    "differences": constraints.differences,
    "parse": constraints.parse,
}


def save_result(result: Calibration, path: str | Path, record: Record | None = None) -> None:
    """Write a calibration to one JSON file, which `load_result` reads; the file is whole or not written at all.

    Parameters
    ----------
    result
        The calibration.
    path
        The file, or a folder for ``result.json``.
    record
        Title, validation data and input files, as in ``load(...).record``; the calibration's own by default.

    Raises
    ------
    InputError
        For a `PartitionedProblem`, whose measurements the file cannot repeat.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> result = ro.calibrate(instance.problem, ro.tikhonov, weight=1e-3)
    >>> ro.store.save_result(result, "result.json", instance.record)
    >>> ro.load_result("result.json").record.title
    "The paper's cooperative manipulator"
    """
    if not result.problem.keeps_rows:
        raise InputError("save_result", "measurements in parts", "measurements in memory, which the file repeats")
    if record is not None:
        result = replace(result, record=record)
    write_json(result_path(path), content(result))


def load_result(path: str | Path, measurements: Sequence[Measurement] = (), model: Models | None = None) -> Calibration:
    """Return the calibration that a file holds.

    Its figures are computed anew from the data in the file, and those that the file states are compared with them.
    A digest tells whether anything else was changed since it was written: by error, that is, and not by somebody who
    also writes a new digest.
    A formulation with functions of a script's own is there by its name: it cannot be solved again, everything else
    works.

    Parameters
    ----------
    path
        A file of `save_result`, or a folder with ``result.json``.
    measurements
        Measurement models of your own that the file names.
    model
        The terms of your own that the calibration had, of several robots also by name: a file holds what the terms are
        called and no functions. They are checked by names, columns and the errors of all rows.

    Raises
    ------
    InputError
        Naming the file, the key, what was found and what is accepted.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> result = ro.calibrate(instance.problem, ro.tikhonov, weight=ro.l_curve)
    >>> ro.store.save_result(result, "result.json", instance.record)
    >>> again = ro.load_result("result.json")  # without the problem's folder
    >>> print(f"{1e3 * again.errors(again.record.validation).mean():.3f} mm")
    0.032 mm
    """
    path = result_path(path)
    stored = read_json(path)
    try:
        _require_format(stored)
        file = structured(stored, Stored)
        result = _calibration(file, {**READY, **{m.name: m for m in measurements}}, model or Model())
        _require_errors(file, result)
        if _same_version(file):
            require_agreement(stored, derived(result), "key")
        _require_digest(stored)
    except InputError as error:
        raise error.within(path) from None
    except (TypeError, ValueError, LookupError, ArithmeticError, RuntimeError) as error:
        # well-formed parts that somebody put together by hand
        found = f"parts that do not fit together ({error})"
        raise InputError("the file", found, "one as it was written", path) from None
    return result


def result_path(path: str | Path) -> Path:
    """Return a result's file, which may be named by its folder."""
    path = Path(path)
    return path / "result.json" if path.is_dir() else path


# --- what a file holds -------------------------------------------------------------------------------------------


class OwnTerm(NamedTuple):
    """A term of a user's own, whose function only a script has: where it acts, its parameters and columns."""

    at: str
    parameters: list[str]
    columns: dict[str, str]


class Trust(NamedTuple):
    """What a loss of a script made of the equations: a factor, and those that it left out."""

    factor: float
    left_out: list[int]


class Forms(NamedTuple):
    """The quadratics that a script's loss (of the residual) and penalty (of z) are."""

    loss: Quadratic | None
    penalty: Quadratic | None


class RowErrors(NamedTuple):
    """The errors of one row [mm], before and after; None where it measures no length."""

    label: str
    nominal_mm: float | None
    identified_mm: float | None


@dataclass(frozen=True, eq=False)
class Stored:
    """What everything else in a result file follows from, in SI, by its keys."""

    formulation: str
    """Name of the formulation."""
    definition: dict[str, Any]
    """Its loss, penalty and constraints."""
    forms: Forms | None
    """Quadratic forms of a script's loss and penalty."""
    weight: float
    """Regularization weight."""
    selection: Selection | None
    """Choice of the weight with its evidence."""
    converged: bool
    """Whether the certificate holds."""
    message: str
    """How the iteration ended."""
    history: tuple[Iteration, ...]
    """Objective, step, weight and damping of every iteration."""
    x: Array
    """Deviations of the identified parameters [SI]."""
    certificate: Certificate
    """Optimality gap, violation, gradient."""
    trust: Trust | None
    """Equations that a script's loss downweighted or left out."""
    held: tuple[Held, ...]
    """Parameters at an active bound."""
    prices: tuple[Price, ...]
    """Multipliers of the constraints."""
    robots: dict[str, Robot]
    """Nominal robots."""
    terms: dict[str, list[OwnTerm]]
    """Terms of a script's own, without their functions."""
    transmission: tuple[Curve, ...]
    """Transmission errors of the joints."""
    model: Parameters
    """All parameters: nominal, prior scale, tolerance, identified."""
    data: dict[str, Dataset]
    """Identification and validation data."""
    scatter: Scatter | None
    """Repeatability of the robot."""
    learned: Learned | None
    """Estimated prior scales and noise with their evidence."""
    record: Record
    """Title, source, files and excluded rows."""
    causes: tuple[str, ...]
    """Likely mistakes in the data."""
    rows: dict[str, list[RowErrors]]
    """Errors of every row [mm], nominal and identified."""
    mapping: JointMapping | None = None
    """Signs and offsets of joints that the global start found."""
    digest: str = ""
    """SHA-256 of the content."""


def content(result: Calibration) -> dict[str, Any]:
    """Return what a file says of a calibration: its figures [mm, deg], what they follow from [SI], and a digest."""
    from rpim_opt.calibration.acceptance import accept  # few robots have to be accepted

    result = replace(result, record=result.record.dated(), known_causes=result.causes)
    solvable = is_defined(result.formulation)
    stored = Stored(
        formulation=result.formulation.name,
        definition=definition(result.formulation),
        forms=None if solvable else Forms(result.program.loss_form, result.program.penalty_form),
        weight=result.weight,
        selection=result.selection,
        converged=result.converged,
        message=result.message,
        history=result.history,
        x=result.x,
        certificate=result.certificate,
        trust=None if solvable else _trust(result),
        held=result.held,
        prices=result.prices,
        robots=dict(result.problem.arms),
        terms={name: _terms(robot.model, robot) for name, robot in result.problem.arms.items()},
        transmission=tuple(curve for robot in result.problem.arms.values() for curve in robot.model.curves),
        model=result.problem.parameters,
        data=sets(result.problem.data, result.record),
        scatter=result.problem.scatter,
        learned=result.learned,
        record=result.record,
        causes=result.causes,
        rows=_rows(result),
        mapping=result.mapping,
    )
    parts = {
        "format": FORMAT,
        "version": VERSION,
        "title": result.record.title,
        **derived(result),
        **plain(stored),
        "acceptance": None if result.record.requirement is None else accept(result).content(),
    }
    return {**parts, "digest": digest(parts)}


def figures(result: Calibration) -> dict[str, Any]:
    """Return what a reader looks for first: errors [mm], the weight and where it came from, the parameters."""
    validation = None
    if result.record.validation is not None:
        validation = statistics(result.errors(result.record.validation))
    held_out = result.record.held_out
    if held_out is not None:
        before, validation = statistics(held_out.nominal), statistics(held_out.error)
        held_out = {"nominal": before, "identified": validation, "used": held_out.used}
    return {
        "verdict": {"delivered": result.verdict.delivered, "reasons": list(result.verdict.reasons)},
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
        "flagged": result.doubted,
        "parameters": result.parameter_rows(),
    }


def derived(result: Calibration) -> dict[str, Any]:
    """Return the figures of a file that follow from its data and parameters: they are computed anew where it is read.

    Those are what a reader looks for first, and the errors before and after, also row by row.
    """
    data = sets(result.problem.data, result.record)
    nominal = {name: statistics(result.nominal_errors(part)) for name, part in data.items()}
    return {**figures(result), "nominal": nominal, "rows": plain(_rows(result))}


def sets(identification: Dataset, record: Record) -> dict[str, Dataset]:
    """Return the measurements by name: those of the identification, and those of the validation."""
    data = {"identification": identification}
    if record.validation is not None:
        data["validation"] = record.validation
    return data


def _rows(result: Calibration) -> dict[str, list[RowErrors]]:
    rows = {}
    for name, data in sets(result.problem.data, result.record).items():
        before = 1e3 * result.nominal_errors(data)
        after = 1e3 * result.errors(data)
        rows[name] = [
            RowErrors(label, _finite(b), _finite(a)) for label, b, a in zip(data.label, before, after, strict=True)
        ]
    return rows


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _terms(model: Model, robot: Robot) -> list[OwnTerm]:
    """Return what a file says of a user's own terms on a robot: all but their functions."""
    terms = []
    for term in model.terms:
        if isinstance(term, Transmission):
            continue
        names = [name for i in term.places(robot.joint_types) for name in term.names(i)]
        terms.append(OwnTerm(term.at, names, dict(term.columns)))
    return terms


def _trust(result: Calibration) -> Trust | None:
    """Return what a loss of a script made of the rows; a ready one says it again when it is called."""
    if result.kept is not None:  # an earlier file said it
        if result.kept.linear is None:
            return None
        return Trust(float(np.sqrt(result.kept.factor)), list(result.kept.left_out))
    try:
        trust = result.program.trust(result.z)
    except InputError:  # a loss that no squared one stands for
        return None
    if trust is None:
        return None
    left_out = np.flatnonzero(~trust.keeps(result.program.model, result.z))
    return Trust(float(np.sqrt(trust.factor)), left_out.tolist())


# --- formulations by the names of ready functions ----------------------------------------------------------------


def definition(formulation: Formulation) -> dict[str, Any]:
    """Return the functions of a formulation by the names of ready ones; None for those of a script."""
    return {
        "loss": _name(formulation.loss),
        "penalty": _name(formulation.penalty),
        "constraints": [_name(constraint) for constraint in formulation.constraints],
        "loss_over": formulation.loss_over,
        "penalty_over": _name(formulation.penalty_over),
        "largest": _finite(formulation.largest),
    }


def is_defined(formulation: Formulation) -> bool:
    """Whether a file can hold a formulation: all its functions are ready-made."""
    return formulation_of("", definition(formulation)).solvable


def formulation_of(name: str, stated: Mapping[str, Any]) -> Formulation:
    """Return the formulation that a file holds; one that cannot be solved where it names functions of a script."""
    functions = [stated[key] for key in ("loss", "penalty", "penalty_over")]
    return Formulation(
        name,
        loss=_function(stated["loss"], name),
        penalty=_function(stated["penalty"], name),
        constraints=tuple(_function(term, name) for term in stated["constraints"]),
        loss_over=stated["loss_over"],
        penalty_over=_function(stated["penalty_over"], name),
        largest=math.inf if stated["largest"] is None else stated["largest"],
        solvable=None not in (*functions, *stated["constraints"]),
    )


def _name(function: Callable[..., Any] | None) -> str | list[Any] | None:
    """Return the name of a ready function, or of its maker and the arguments; ``none`` for no function."""
    if function is None:
        return "none"
    for name, ready in FUNCTIONS.items():
        if ready == function:
            return name
    stated = getattr(function, "stated", None)
    if stated is None or stated[0] != believed.__name__:
        return stated
    maker, penalty, *numbers = stated
    return [maker, _name(penalty), *numbers]


def _function(stated: str | list[Any] | None, name: str) -> Any:
    if stated is None:
        return lost(name)
    if stated == "none":
        return None
    if isinstance(stated, str):
        return pick(FUNCTIONS, stated, "key definition")
    maker, *arguments = stated
    if maker == believed.__name__:
        arguments[0] = _function(arguments[0], name)
    return pick(MAKERS, str(maker), "key definition")(*arguments)


# --- reading -----------------------------------------------------------------------------------------------------


def _require_format(stored: Any) -> None:
    """Refuse what another program or another version wrote, before its keys are looked at."""
    if not isinstance(stored, dict) or stored.get("format") != FORMAT:
        raise InputError("the file", "no result of rpim-opt", "a file of `rpim-opt calibrate --out` or save_result()")
    if stored.get("version") != VERSION:
        found = repr(stored.get("version"))[:40]
        raise InputError("key version", found, f"{VERSION}; the rpim-opt that wrote it reads others")
    if not isinstance(stored.get("digest"), str):
        raise InputError("key digest", repr(stored.get("digest", "nothing"))[:40].strip("'"), "the digest of the rest")


def _calibration(file: Stored, known: Mapping[str, Measurement], models: Models) -> Calibration:
    robots = {name: _robot(name, file, models) for name in file.robots}
    data = {name: _with_models(part, known, f"key data.{name}") for name, part in file.data.items()}
    _require_lengths(file.model)
    problem = CalibrationProblem(robots.get("", robots), file.model, data["identification"], scatter=file.scatter)
    validation = data.get("validation")
    if validation is not None:
        problem.on(validation)  # refuses rows that the problem's robot or reflectors cannot have
    unknowns = int(np.count_nonzero(file.model.identified))
    if len(file.x) != unknowns:
        raise InputError("key x", f"{len(file.x)} numbers", f"{unknowns}, one an identified parameter")
    for earlier in file.record.earlier:
        for name, ranges in earlier.ranges.items():
            if name not in robots or np.shape(ranges) != (2, robots[name].dof):
                accepted = "the least and the largest value of every joint, of the file's robots"
                found = f"ranges of shape {np.shape(ranges)} of robot '{name}'"
                raise InputError("key record.earlier", found, accepted)
    formulation = formulation_of(file.formulation, file.definition)
    program = _program(file, formulation, around(problem.linearize(file.x), file.x))
    return Calibration(
        problem,
        formulation,
        file.x,
        weight=file.weight,
        selection=file.selection,
        converged=file.converged,
        message=file.message,
        history=file.history,
        program=program,
        certificate=file.certificate,
        asked=mapped_as(
            file.mapping, partial(calibrate, formulation=formulation, weight=_rule(file), model=_model(file))
        ),
        record=replace(file.record, validation=validation, digest=file.digest),
        kept=None if formulation.solvable else _kept(file, program),
        learned=file.learned,
        mapping=file.mapping,
        known_causes=file.causes,
    )


def _robot(name: str, file: Stored, models: Models) -> Robot:
    """Return a robot of the file with the terms that somebody gives again: by name, or one model for all.

    Raises
    ------
    InputError
        For terms that the file has and nobody gives, and others than it has.
    """
    stated = file.terms.get(name, [])
    if not isinstance(models, Model):
        if not name:
            raise InputError("model", "models by name", "a Model, for the one robot of the file")
        model = models.get(name, Model())
    elif name and not stated:
        model = Model()
    else:
        model = models
    robot = file.robots[name]
    given = _terms(model, robot)
    if stated != given:
        wanted = "; ".join(map(_in_words, stated)) or "none"
        accepted = f"model=ro.Model(terms=[...]) with what the calibration had: {wanted}"
        raise InputError("key terms", "; ".join(map(_in_words, given)) or "no term given", accepted)
    curves = [transmission(curve) for curve in file.transmission if curve.joint <= robot.dof and not name]
    return replace(robot, model=Model((*model.terms, *curves)))


def _in_words(term: OwnTerm) -> str:
    what = ", ".join(term.parameters) or "without parameters"
    seen = "".join(f", column {name} ({dimension or 'no unit'})" for name, dimension in term.columns.items())
    return f"a term of the {term.at} ({what}{seen})"


def _require_lengths(parameters: Parameters) -> None:
    for key in ("dimensions", "nominal", "scale", "tolerance", "identified"):
        values = getattr(parameters, key)
        if np.shape(values) != (len(parameters),):
            raise InputError(f"key model.{key}", f"shape {np.shape(values)}", f"{len(parameters)} values, one a name")


def _with_models(data: Dataset, known: Mapping[str, Measurement], where: str) -> Dataset:
    """Return measurements with the models that their blocks name, all of one length."""
    blocks = [_block(block, known, f"{where}.blocks {i}") for i, block in enumerate(data.blocks, start=1)]
    rows = sorted(row for block in blocks for row in block.row.tolist())
    if rows != list(range(len(data.label))) or data.configuration.shape != (len(data.label),):
        raise InputError(where, f"{len(data.label)} labels for other rows", "one label and configuration a row")
    return replace(data, blocks=tuple(blocks))


def _block(block: Block, known: Mapping[str, Measurement], where: str) -> Block:
    name = str(block.measurement)
    if name not in known:
        raise InputError(f"{where}.measurement", f"'{name}'", f"measurements=[...] with it, or {choices(name, known)}")
    kind = known[name]
    p, k = kind.points, len(kind.components)
    if len(block.markers) != p:
        raise InputError(f"{where}.markers", f"{len(block.markers)} reflectors", f"{p}, one a point")
    N = len(block.row)
    shapes = {
        "q": (N, p, -1),
        "y": (N, len(kind.columns)),
        "covariance": (-1, k, k),
        "torque": (N, p, -1),
        "payload": (N,),
        "approach": (N, p, -1),
        "point": (N, p),
    }
    arrays = {key: getattr(block, key) for key in shapes}
    arrays |= {f"columns.{name}": values for name, values in block.columns.items()}
    for key, array in arrays.items():
        shape = shapes.get(key, (N,))
        if array is None:
            continue
        if array.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, array.shape, strict=True)):
            raise InputError(f"{where}.{key}", f"shape {array.shape}", f"shape {shape}")
    session = None if block.session is None else named_sessions(block.session, N)
    return replace(block, measurement=kind, session=session)


def _program(file: Stored, formulation: Formulation, model: LinearModel) -> Program:
    """Return the program at the solution; of a script's functions the file knows the quadratics that they were."""
    if file.forms is None:
        return pose(formulation, model)
    return Program(formulation, model, Lost(formulation, model, file.forms.loss, file.forms.penalty))


def _kept(file: Stored, program: Program) -> Kept:
    """Return what the functions of a script said when they were there; nobody can call them again."""
    if file.trust is None:
        return Kept(file.held, None, prices=file.prices)
    keep = np.ones(len(program.model.b), dtype=bool)
    keep[file.trust.left_out] = False
    factor = file.trust.factor**2
    equations = kept_equations(program.model, keep, factor)
    return Kept(file.held, equations, factor, tuple(file.trust.left_out), file.prices)


def _rule(file: Stored) -> float | Selector | None:
    """Return the selector that chose the weight, where it is a ready one, and otherwise the weight; None: learned."""
    if file.learned is not None and not file.record.earlier:
        return None
    if file.selection is None:
        return file.weight
    return SELECTORS.get(file.selection.name, file.weight)


def _model(file: Stored) -> str:
    """Return whether model extensions were compared."""
    if file.learned is not None and file.learned.trials and not file.record.earlier:
        return "auto"
    return "geometry"


# --- whether a file says what follows from it --------------------------------------------------------------------


def _require_errors(file: Stored, result: Calibration) -> None:
    """Refuse errors that do not follow from the data: edited, or read with another measurement model."""
    for name, rows in _rows(result).items():
        stated = file.rows.get(name, [])
        if len(stated) != len(rows):
            raise InputError(f"key rows.{name}", f"{len(stated)} rows", f"{len(rows)}, as in key data")
        pairs = [(a.identified_mm or 0.0, b.identified_mm or 0.0) for a, b in zip(stated, rows, strict=True)]
        off = max((abs(a - b) for a, b in pairs), default=0.0)
        if off > ABSOLUTE:
            found = f"errors up to {off:.2g} mm off those that the file's data give"
            accepted = "the file as it was written, and the same terms and measurement models"
            raise InputError(f"key rows.{name}", found, accepted)


def _same_version(file: Stored) -> bool:
    """Whether this version wrote the file; a later one may define a figure differently, and must still read it."""
    return file.record.versions.get("rpim-opt", version_of("rpim-opt")) == version_of("rpim-opt")


def require_agreement(stated: Any, found: Any, where: str) -> None:
    """Refuse stated figures that are not the computed ones, to their rounding; other keys of the file do not matter.

    Raises
    ------
    InputError
        Naming the key.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> from rpim_opt.store.result_file import require_agreement
    >>> require_agreement({"weight": 1.0, "note": "mine"}, {"weight": 1.0 + 1e-12}, "key")
    >>> try:
    ...     require_agreement({"rows": [{"mm": 0.1}]}, {"rows": [{"mm": 0.2}]}, "key")
    ... except ro.InputError as error:
    ...     print(error)
    key rows 1.mm: found 0.1, accepted: 0.2, which follows from the file's data.
    """
    known = dict(_leaves(stated, where))
    for place, value in _leaves(found, where):
        if place not in known:
            raise InputError(place, "nothing", "this key, as it was written")
        if not _same(known[place], value):
            raise InputError(place, _short(known[place]), f"{_short(value)}, which follows from the file's data")


def _leaves(content: Any, where: str) -> Iterator[tuple[str, Any]]:
    """Yield the places of a content and what stands there; of mappings None, of lists their length."""
    if isinstance(content, Mapping):
        for key, value in content.items():
            yield from _leaves(value, f"{where}{' ' if where == 'key' else '.'}{key}")
    elif isinstance(content, list | tuple):
        yield where, range(len(content))
        for number, value in enumerate(content, start=1):
            yield from _leaves(value, f"{where} {number}")
    else:
        yield where, content


def _same(stated: Any, found: Any) -> bool:
    if isinstance(found, float) and isinstance(stated, int | float) and not isinstance(stated, bool):
        try:
            return math.isclose(stated, found, rel_tol=RELATIVE, abs_tol=ABSOLUTE)
        except OverflowError:  # an integer beyond all doubles
            return False
    return type(stated) is type(found) and stated == found


def _short(value: Any) -> str:
    return f"{len(value)} entries" if isinstance(value, range) else repr(value)[:60]


def _require_digest(stored: Mapping[str, Any]) -> None:
    found = digest(stored)
    if stored["digest"] != found:
        accepted = "the file as it was written: something in it was changed"
        raise InputError("key digest", f"'{stored['digest'][:12]}...' for a content of '{found[:12]}...'", accepted)
