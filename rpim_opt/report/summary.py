"""The figures that a metrologist reads after a calibration, as a document and as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from rpim_opt.basics.statistics import statistics
from rpim_opt.basics.text import table
from rpim_opt.calibration.camera_words import camera_remarks
from rpim_opt.calibration.causes import likely_causes
from rpim_opt.calibration.contact_words import contact_remarks
from rpim_opt.calibration.lack_of_fit import judged
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.words import turned_frames, weight_lines
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.contact import known_distance, known_parallel, known_square
from rpim_opt.store.result_file import figures, sets
from rpim_opt.store.statements import FIELDS

if TYPE_CHECKING:
    from rpim_opt.calibration.acceptance import Acceptance

KEYS = ("weight", "selector", "corner", "formulation", "converged", "iterations", "flagged", "parameters")


def describe_times(seconds: Mapping[str, float]) -> str:
    """Return the seconds of a calibration's phases as a table [ms]."""
    whole = sum(seconds.values())
    rows = [[phase, f"{1e3 * each:.2f}", f"{each / whole:.0%}"] for phase, each in seconds.items()]
    return table(["phase", "ms", "share"], [*rows, ["all", f"{1e3 * whole:.2f}", "100%"]])


def summary(result: Calibration, published: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """Return parameters, errors, the weight and where it came from.

    Parameters
    ----------
    result
        The calibration, with title, source and validation data in its record.
    published
        Mean errors [mm] that the source prints, by role and method.
    """
    record = result.record
    errors: list[dict[str, Any]] = []
    angles: list[dict[str, Any]] = []
    for name, data in sets(result.problem.data, record).items():
        errors += _errors(result, name, data)
        errors += [
            {"what": f"  printed: {method}", "mean_mm": mean, "printed": True}
            for method, mean in published.get(name, {}).items()
        ]
        turn = result.errors(data, "angle")
        if np.isfinite(turn).any():
            angles.append({"what": name, **statistics(turn, "mrad")})
        stated = result.errors(data, "stated angle")
        if np.isfinite(stated).any():
            angles.append({"what": f"{name}, known angle", **statistics(stated, "mrad")})
    errors += _held_out(result)
    whole = figures(result)
    lacking = judged(result)
    accepted = acceptance(result)
    causes = likely_causes(result)
    return {
        "title": record.title,
        "source": record.source,
        **{key: whole[key] for key in KEYS},
        "errors": errors,
        "orientation": angles,
        "prices": [price._asdict() for price in result.prices],
        "remarks": [*_remarks(result), *causes],
        "likely_causes": causes,
        "lack_of_fit": lacking and lacking.content(),
        "details": dict(record.details),
        "acceptance": accepted and {**accepted.content(), "text": accepted.sentences()},
    }


def acceptance(result: Calibration) -> Acceptance | None:
    """Return the verdict of what a result's record requires; None where nothing is required."""
    if result.record.requirement is None:
        return None
    from rpim_opt.calibration.acceptance import accept

    return accept(result)


def _held_out(result: Calibration) -> list[dict[str, Any]]:
    """Return the errors of rows that were kept apart before they were used."""
    held = result.record.held_out
    if held is None:
        return []
    what = f"kept apart, from {held.used} rows"
    return [
        {"what": f"{what}, {when}", **statistics(of)}
        for when, of in (("nominal", held.nominal), ("identified", held.error))
    ]


def _errors(result: Calibration, name: str, data: Dataset) -> list[dict[str, Any]]:
    """Return the errors of every kind of measurement, and those of the rows that are not distrusted."""
    errors = []
    several = len(_kinds(result.problem.data)) > 1
    for kind, rows in _kinds(data).items():
        which = f"{name}, {kind.replace('_', ' ')}" if several else name
        if kind in (known_square.name, known_parallel.name):
            continue
        dimension = "length"
        if kind == known_distance.name:
            dimension = "stated length"
        for when, of in (("nominal", result.nominal_errors), ("identified", result.errors)):
            errors.append({"what": f"{which}, {when}", **statistics(of(data, dimension)[rows])})
    if name == "identification" and result.flagged:
        distrusted = {flag.label for flag in result.flagged}
        trusted = result.errors(data)[[label not in distrusted for label in data.label]]
        errors.append({"what": "identification, trusted rows", **statistics(trusted)})
    return errors


def _remarks(result: Calibration) -> list[str]:
    model = result.program.model
    count = f"{model.equations} equations, {len(result.x)} parameters, {model.rank} directions that the data see."
    remarks = [
        *turned_frames(result),
        *weight_lines(result),
        count,
        *contact_remarks(result.problem.sample()),
        *camera_remarks(result),
        *result.noise_sentence(),
        *result.remarks(),
    ]
    if result.record.held_out is not None:
        remarks.append(result.record.held_out.sentence(len(result.problem.data)))
    fitted = result.problem.parameters.placed & result.problem.parameters.identified
    if fitted.any():
        remarks.insert(0, "Nominal: the drawing's robot, frames fitted.")
    return remarks


def describe(result: Calibration, found: Mapping[str, Any]) -> str:
    """Return the tables of a `summary`."""
    stated = [f"{FIELDS[key]}: {text}" for key, text in found["details"].items()]
    head = "\n".join([*filter(None, [found["title"], found["source"]]), *stated])
    lines = [f"{head}\n", result.parameter_table(), ""]
    lines.append(table(["error [mm]", "rows", "mean", "RMS", "max"], [_row(e, "mm") for e in found["errors"]]))
    if found["orientation"]:
        rows = [_row(e, "mrad") for e in found["orientation"]]
        lines.append(table(["orientation error [mrad]", "rows", "mean", "RMS", "max"], rows))
    lines += ["", *found["remarks"]]
    if found["lack_of_fit"]:
        lines += ["", *found["lack_of_fit"]["text"]]
    if found["acceptance"]:
        lines += ["", *found["acceptance"]["text"]]
    return "\n".join(lines)


def _row(e: Mapping[str, Any], unit: str) -> Sequence[str]:
    if "printed" in e:
        return [e["what"], "", f"{e['mean_mm']:.3f}", "", ""]
    figures = (e[f"{key}_{unit}"] for key in ("mean", "rms", "max"))
    return [e["what"], str(e["count"]), *("-" if v is None else f"{v:.4f}" for v in figures)]


def _kinds(data: Dataset) -> dict[str, list[int]]:
    """Return the rows of every kind of measurement."""
    kinds: dict[str, list[int]] = {}
    for block in data.blocks:
        kinds.setdefault(block.measurement.name, []).extend(block.row.tolist())
    return kinds
