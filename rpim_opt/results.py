"""Results that last: a file of `Calibration.save` becomes a calibration again, without the problem's folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rpim_opt.calibration import Calibration, Certificate, Held, Iteration
from rpim_opt.exceptions import InputError
from rpim_opt.files import read_json, validate
from rpim_opt.measurement import MEASUREMENTS, Measurement
from rpim_opt.problem import CalibrationProblem
from rpim_opt.record import (
    FORMAT,
    VERSION,
    File,
    Record,
    data_of,
    formulation_of,
    parameters_of,
    robot_of,
    selection_of,
)  # fmt: skip

AGREEMENT_MM = 1e-6
"""By how much an error that a file states may differ from the one that its data and parameters give."""


def load_result(path: str | Path, measurements: Sequence[Measurement] = ()) -> Calibration:
    """Return the calibration that a file holds.

    Its figures are computed anew from the data in the file, and those that the file states are compared with them.
    A formulation with functions of a script's own is there by its name: it cannot be solved again, everything else
    works.

    Parameters
    ----------
    path
        A file of `Calibration.save`, or a folder with ``result.json``.
    measurements
        Measurement models of your own that the file names.

    Raises
    ------
    InputError
        Naming the file, the key, what was found and what is accepted.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> ro.calibrate(instance.problem, ro.tikhonov, weight=ro.l_curve).save("result.json", instance.record)
    >>> result = ro.load_result("result.json")  # without the problem's folder
    >>> print(f"{1e3 * result.errors(result.record.validation).mean():.3f} mm")
    0.032 mm
    """
    path = Path(path) / "result.json" if Path(path).is_dir() else Path(path)
    stored = read_json(path)
    stated = (stored.get("format"), stored.get("version")) if isinstance(stored, dict) else (None, None)
    if stated[0] != FORMAT:
        raise InputError("the file", "no result of rpim-opt", "a file of `rpim-opt calibrate --out` or save()", path)
    if stated[1] != VERSION:
        raise InputError("key version", repr(stated[1])[:40], f"{VERSION}; a newer rpim-opt may read it", path)
    file = validate(File, stored, path)
    try:
        result = _calibration(file, {**MEASUREMENTS, **{m.name: m for m in measurements}})
        _compare(file, result)
    except InputError as error:
        raise error.within(path) from None
    except (TypeError, ValueError, LookupError) as error:  # well-formed parts that were put together by hand
        raise InputError(
            "the file", f"parts that do not fit together ({error})", "one as it was written", path
        ) from None
    return result


def _calibration(file: File, known: dict[str, Measurement]) -> Calibration:
    data, apart = data_of(file.data.identification, known), file.data.validation
    problem = CalibrationProblem(robot_of(file.robot), parameters_of(file.model), data)
    x, formulation = np.array(file.x), formulation_of(file.formulation, file.definition)
    if len(x) != len(problem.parameters.free):
        raise InputError("key x", f"{len(x)} numbers", f"{len(problem.parameters.free)}, one an identified parameter")
    validation = data_of(apart, known) if apart else None
    if validation:
        problem.on(validation)
    kept = {f: getattr(file.record, f) for f in ("source", "files", "excluded", "simulated", "made", "versions")}
    passes = [Iteration(p.objective, p.step, p.weight, np.inf if p.radius is None else p.radius) for p in file.history]
    result = Calibration(
        problem, formulation, x, file.weight, selection_of(file.selection), file.converged, file.message,
        tuple(passes), formulation.compile(problem.linearize(x)), Record(file.title, validation=validation, **kept),
    )  # fmt: skip
    if not formulation.solvable:  # what its functions would say is taken from the file
        cache = result.__dict__
        cache["held"] = tuple(Held(h.name, h.bound, h.multiplier, h.gain) for h in file.held)
        if file.certificate:
            c = file.certificate
            cache["certificate"] = Certificate(c.gradient, c.step, c.violation)
        if file.trust:
            rows = np.full(len(result.program.model.b), file.trust.factor)
            rows[file.trust.left_out] = 0.0
            cache["linear"] = result.program.model.scaled(rows)
    return result


def _compare(file: File, result: Calibration) -> None:
    """Refuse a file whose stated errors do not follow from its data: edited, or read with another measurement model."""
    for name, data in (("identification", result.problem.data), ("validation", result.record.validation)):
        if data is None:
            continue
        stated = np.array(
            [np.nan if row.identified_mm is None else row.identified_mm for row in file.rows.get(name, [])]
        )
        errors = 1e3 * result.errors(data)
        if len(stated) != len(errors):
            raise InputError(f"key rows.{name}", f"{len(stated)} rows", f"{len(errors)}, as in key data")
        off = float(np.max(np.abs(np.nan_to_num(stated) - np.nan_to_num(errors)), initial=0.0))
        if off > AGREEMENT_MM:
            found = f"errors up to {off:.2g} mm off those that the file's data give"
            raise InputError(f"key rows.{name}", found, "the file as it was written, and the same measurement models")
