"""Results that last: a calibration goes to one file and comes back, without the problem's folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import read_json, validate, write_json
from rpim_opt.calibration.asking import calibrate
from rpim_opt.calibration.certificate import Certificate
from rpim_opt.calibration.diagnosis import Held
from rpim_opt.calibration.prices import Price
from rpim_opt.calibration.result import Calibration, Iteration, Kept
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.posed import Unposed
from rpim_opt.convex.program import Program, pose
from rpim_opt.convex.select import SELECTORS, Selector
from rpim_opt.convex.trust import kept_equations
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.models import READY, Measurement
from rpim_opt.data.record import Record
from rpim_opt.problem.frames import own_frames
from rpim_opt.problem.identified import around
from rpim_opt.problem.linear import LinearModel
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.open_model import Model
from rpim_opt.store.agreement import agreement
from rpim_opt.store.content import content, derived, digest
from rpim_opt.store.definition import formulation_of, quadratic_of
from rpim_opt.store.figures import sets
from rpim_opt.store.learned_parts import learned_of, scatter_of
from rpim_opt.store.parts import data_of, parameters_of, robots_of, selection_of
from rpim_opt.store.record_part import record_of
from rpim_opt.store.schema import FORMAT, VERSION, File, RowPart

Models = Model | Mapping[str, Model]
AGREEMENT_MM = 1e-6
"""By how much an error that a file states may differ from the one that its data and parameters give."""


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
    write_json(_file(path), content(result))


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
    path = _file(path)
    stored = read_json(path)
    _require_format(stored, path)
    file = validate(File, stored, path)
    known = {**READY, **{m.name: m for m in measurements}}
    try:
        result = _calibration(file, known, model or Model())
        _compare(file, result)
        if _same_formulas(file):
            agreement(stored, derived(result), "key")
        _require_digest(stored)
    except InputError as error:
        raise error.within(path) from None
    except (
        TypeError,
        ValueError,
        LookupError,
        ArithmeticError,
    ) as error:  # well-formed parts that were put together by hand
        found = f"parts that do not fit together ({error})"
        raise InputError("the file", found, "one as it was written", path) from None
    return result


def _file(path: str | Path) -> Path:
    path = Path(path)
    return path / "result.json" if path.is_dir() else path


def _require_format(stored: Any, path: Path) -> None:
    """Refuse what another program or another version wrote, before its keys are looked at."""
    if not isinstance(stored, dict) or stored.get("format") != FORMAT:
        accepted = "a file of `rpim-opt calibrate --out` or save_result()"
        raise InputError("the file", "no result of rpim-opt", accepted, path)
    written = stored.get("version")
    if written != VERSION:
        raise InputError("key version", repr(written)[:40], f"{VERSION}; a newer rpim-opt may read it", path)


def _calibration(file: File, known: Mapping[str, Measurement], model: Models) -> Calibration:
    robots = robots_of(file, model)
    data = data_of(file.data.identification, known)
    problem = CalibrationProblem(
        robots.get("", robots),
        replace(parameters_of(file.model, robots), own_frames=own_frames(data)),
        data,
        scatter=scatter_of(file.scatter),
    )
    x = np.array(file.x)
    unknowns = len(problem.parameters.free)
    if len(x) != unknowns:
        raise InputError("key x", f"{len(x)} numbers", f"{unknowns}, one an identified parameter")
    formulation = formulation_of(file.formulation, file.definition)
    program = _program(file, formulation, around(problem.linearize(x), x))
    return Calibration(
        problem,
        formulation,
        x,
        weight=file.weight,
        selection=selection_of(file.selection),
        converged=file.converged,
        message=file.message,
        history=_history(file),
        program=program,
        certificate=_certificate(file),
        asked=partial(calibrate, formulation=formulation, weight=_rule(file), model=_model(file)),
        record=record_of(file.title, file.record, _validation(file, problem, known), file.digest, problem.arms),
        kept=None if formulation.solvable else _kept(file, program),
        learned=learned_of(file.learned),
    )


def _program(file: File, formulation: Formulation, model: LinearModel) -> Program:
    """Return the program at the solution; of a script's functions the file knows the quadratics that they were."""
    if file.forms is None:
        return pose(formulation, model)
    forms = quadratic_of(file.forms.loss), quadratic_of(file.forms.penalty)
    return Program(formulation, model, Unposed(formulation, model, *forms))


def _certificate(file: File) -> Certificate:
    if file.certificate is None:
        return Certificate(None, float("inf"), float("inf"))
    stated = file.certificate.model_dump()
    if stated["step"] is None:
        stated["step"] = float("inf")
    return Certificate(**stated)


def _rule(file: File) -> float | Selector | None:
    """Return the selector that chose the weight, where it is a ready one, and otherwise the weight; None: learned."""
    if file.learned is not None and not file.record.earlier:
        return None
    if file.selection is None:
        return file.weight
    return SELECTORS.get(file.selection.name, file.weight)


def _model(file: File) -> str:
    """Return whether families were compared."""
    if file.learned is not None and file.learned.trials and not file.record.earlier:
        return "auto"
    return "geometry"


def _history(file: File) -> tuple[Iteration, ...]:
    return tuple(Iteration(each.objective, each.step, each.weight, each.damping) for each in file.history)


def _validation(file: File, problem: CalibrationProblem, known: Mapping[str, Measurement]) -> Dataset | None:
    if file.data.validation is None:
        return None
    data = data_of(file.data.validation, known)
    problem.on(data)  # refuses rows that the problem's robot or reflectors cannot have
    return data


def _kept(file: File, program: Program) -> Kept:
    """Return what the functions of a script said when they were there; nobody can ask them again."""
    held = tuple(Held(**held.model_dump()) for held in file.held)
    prices = tuple(Price(**price.model_dump()) for price in file.prices)
    if file.trust is None:
        return Kept(held, None, prices=prices)
    keep = np.ones(len(program.model.b), dtype=bool)
    keep[file.trust.left_out] = False
    factor = file.trust.factor**2
    return Kept(held, kept_equations(program.model, keep, factor), factor, tuple(file.trust.left_out), prices)


def _compare(file: File, result: Calibration) -> None:
    """Refuse a file whose stated errors do not follow from its data: edited, or read with another measurement model."""
    for name, data in sets(result.problem.data, result.record).items():
        stated = _stated(file.rows.get(name, []))
        errors = 1e3 * result.errors(data)
        if len(stated) != len(errors):
            raise InputError(f"key rows.{name}", f"{len(stated)} rows", f"{len(errors)}, as in key data")
        off = float(np.max(np.abs(np.nan_to_num(stated) - np.nan_to_num(errors)), initial=0.0))
        if off > AGREEMENT_MM:
            found = f"errors up to {off:.2g} mm off those that the file's data give"
            raise InputError(
                f"key rows.{name}", found, "the file as it was written, and the same terms and measurement models"
            )


def _same_formulas(file: File) -> bool:
    """Whether this version wrote the file; a later one may define a figure differently, and must still read it."""
    return file.record.versions.get("rpim-opt", version("rpim-opt")) == version("rpim-opt")


def _require_digest(stored: Mapping[str, Any]) -> None:
    found = digest(stored)
    if stored["digest"] != found:
        accepted = "the file as it was written: something in it was changed"
        raise InputError("key digest", f"'{stored['digest'][:12]}...' for a content of '{found[:12]}...'", accepted)


def _stated(rows: Sequence[RowPart]) -> np.ndarray:
    return np.array([np.nan if row.identified_mm is None else row.identified_mm for row in rows])
