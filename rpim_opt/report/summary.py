"""Summary of a calibration in numbers and sentences, shared by the terminal, JSON and the report."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from rpim_opt.basics.arrays import Array, statistics
from rpim_opt.basics.text import counted, listed, table
from rpim_opt.calibration import words
from rpim_opt.calibration.acceptance import Workspace, inconclusive, tested
from rpim_opt.calibration.held_out import excluded_by_fit, headline_errors, of_positions, sets
from rpim_opt.calibration.lack_of_fit import judged
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.contact import known_distance, known_parallel, known_square
from rpim_opt.problem.linear import RANK_TOLERANCE
from rpim_opt.store.problem_file import FIELDS
from rpim_opt.store.result_file import figures
from rpim_opt.use.sessions import in_session, session_notes

COLUMNS = ("rows", "mean", "RMS", "95th percentile", "max")
Unit = Literal["mm", "mrad"]


def mm(value: float) -> str:
    """Return a length in mm with its significant digits."""
    digits = (3, 2, 0)[bisect((10, 100), value)]
    return f"{value:.{digits}f}"


def error_rows(result: Calibration) -> list[dict[str, Any]]:
    """Return mean, RMS, 95th percentile and maximum [mm] of every set of errors, with nominal and identified model."""
    rows: list[dict[str, Any]] = []
    several = len(_kinds(result.problem.data)) > 1
    for name, data in sets(result).items():
        for kind, at in _kinds(data).items():
            if kind not in (known_square.name, known_parallel.name):
                what = name + f", {kind.replace('_', ' ')}" * several
                dimension = {known_distance.name: "stated length"}.get(kind, "length")
                rows += _both_models(result, what, data, dimension, np.array(at))
        if name == "identification" and result.flagged:
            flagged = {flag.label for flag in result.flagged}
            others = result.errors(data)[[label not in flagged for label in data.label]]
            rows.append(_figures("identification, rows not flagged", others))
    held = result.record.held_out
    if held is not None:
        name, nominal, identified = headline_errors(result)
        what = f"{name}, from {held.used} rows"
        rows += [_figures(f"{what}, nominal", nominal), _figures(f"{what}, identified", identified)]
        if len(identified) < len(held.label):
            rows.append(_figures("held out, including excluded rows, identified", held.error))
    return rows


def orientation_rows(result: Calibration) -> list[dict[str, Any]]:
    """Return `error_rows` of orientations and of known angles [mrad]; empty if none were measured."""
    rows: list[dict[str, Any]] = []
    for name, data in sets(result).items():
        rows += _both_models(result, name, data, "angle", unit="mrad")
        rows += _both_models(result, f"{name}, known angle", data, "stated angle", unit="mrad")
    held = result.record.held_out
    if held is not None:
        rows.append(_figures(f"held out, from {held.used} rows, identified", held.angle, "mrad"))
    return [row for row in rows if row["count"]]


def signed_errors(result: Calibration, data: Dataset) -> tuple[str, dict[str, Array]]:
    """Return the definition of errors along axes, and these (N, 3) [mm] before and after calibration."""
    what = "Measured minus modelled along the axes of the instrument"
    if any(block.measurement.touching for block in data.blocks):  # there is no instrument
        what = "Mean of the point minus touch along the axes of the robot's base"
    before, after = (1e3 * result.error_vectors(data, nominal=nominal) for nominal in (True, False))
    finite = np.isfinite(after).all(axis=1)
    return what, {"before": before[finite], "after": after[finite]}


def _both_models(
    result: Calibration, what: str, data: Dataset, dimension: str, rows: Any = slice(None), unit: Unit = "mm"
) -> list[dict[str, Any]]:
    models = {"nominal": result.nominal_errors, "identified": result.errors}
    return [_figures(f"{what}, {model}", errors(data, dimension)[rows], unit) for model, errors in models.items()]


def _figures(what: str, errors: Array, unit: Unit = "mm") -> dict[str, Any]:
    return {"what": what, **statistics(errors, unit)}


def _kinds(data: Dataset) -> dict[str, list[int]]:
    kinds: dict[str, list[int]] = {}
    for block in data.blocks:
        kinds.setdefault(block.measurement.name, []).extend(block.row.tolist())
    return kinds


def cells(rows: Sequence[Mapping[str, Any]], unit: Unit = "mm") -> list[list[str]]:
    """Return rows of figures as text under `COLUMNS`, an empty cell where one is missing."""
    keys = [f"{key}_{unit}" for key in ("mean", "rms", "p95", "max")]
    return [
        [row["what"], str(row.get("count", "")), *("" if row.get(key) is None else f"{row[key]:.4f}" for key in keys)]
        for row in rows
    ]


def headline(result: Calibration, errors: tuple[str, Array, Array] | None = None) -> str:
    """Return a sentence on the error reduction, by default on data not used for identification if there are any."""
    name, nominal, identified = errors or headline_errors(result)
    before, after = statistics(nominal), statistics(identified)
    n = after["count"]
    if not n:
        return ""
    equations, unknowns = result.program.model.equations, len(result.x)
    few = f"; {equations} equations for {unknowns} parameters" * (equations < unknowns)
    where = {
        "held out": f"On {n} measurements that were held out",
        "used": f"On {n} measurements, which were used for identification at least in part,",
        "identification": f"On the {n} identification measurements (no validation data{few})",
    }.get(name, f"On {n} {name} measurements, not used for identification,")
    what = "position " * of_positions(result) + "error"
    ratio = before["mean_mm"] / max(after["mean_mm"], 1e-12)
    change = f"rises from {mm(before['mean_mm'])} mm to {mm(after['mean_mm'])} mm"
    if mm(before["mean_mm"]) == mm(after["mean_mm"]):
        change = f"stays at {mm(after['mean_mm'])} mm"
    elif ratio > 1:
        change = f"{change.replace('rises', 'falls')}, by a factor of {ratio:.{int(ratio < 10)}f}"
    sentence = f"{where} the mean {what} {change}."
    if not result.verdict.delivered:
        return f"Not delivered: do not use this robot before the points below are resolved. {sentence}"
    held = result.record.held_out
    if held is not None and name == "held out":
        every = len(result.problem.labels)
        sentence += f" This validates the procedure with parameters from {held.used} rows; "
        sentence += f"the delivered parameters are from all {every}."
        excluded = excluded_by_fit(result)
        if excluded:
            sentence += f" Not counted: held-out rows {listed(excluded)}, excluded from the fit to all rows."
    if result.record.earlier:
        last = result.record.earlier[-1]
        sentence += f" The prior is a calibration of {last.rows} rows; changed since then: {last.changed}."
    return sentence


def conclusion(result: Calibration, found: Workspace | None) -> tuple[str, str]:
    """Return the verdict on a robot without an acceptance limit, and a sentence on it; empty if it is not delivered."""
    if not result.verdict.delivered:
        return "rejected", ""
    if doubt := inconclusive(result, found):
        return "inconclusive", doubt
    text = "Delivered: the fit gives no reason against using this robot; no acceptance limit is stated."
    if result.verdict.caution:
        text = "Delivered under a condition: check the condition below before using this robot."
    return "accepted", text


def identifiability(result: Calibration) -> str:
    """Return a sentence on the number of identifiable parameter combinations, without coefficients of curves."""
    model = result.program.model
    parameters = ~result.problem.parameters.free.of_curves
    s = np.linalg.svd(model.qr_factor[:-1, :-1][:, parameters], compute_uv=False)
    rank, count = int(np.sum(s > RANK_TOLERANCE * s[0])), int(parameters.sum())
    apart = ", without the transmission errors of the joints" * (count < len(parameters))
    others = " The others enlarge standard deviations of parameters, not those of predicted measurements."
    others *= rank < count
    return f"{rank} of {count} parameter combinations are identifiable from {model.equations} equations{apart}.{others}"


def warnings(result: Calibration, checked: bool = False) -> list[str]:
    """Return the warnings, the most serious first; ``checked`` where new measurements validate the result."""
    lines = [line for line in words.remarks(result, result.verdict) if line != result.message]
    excluded = result.record.excluded
    if excluded:
        lines.append(f"Excluded before the fit: {counted(len(excluded), 'row')}, {listed(list(excluded))}.")
    validation = result.record.validation
    if validation is not None:
        lines += words.known_points(result.problem.sample(), validation)
        known = {q.tobytes() for q in result.problem.data.q}
        repeated = sum(q.tobytes() in known for q in validation.q)
        if repeated:
            lines.append(f"{repeated} validation rows repeat identification configurations and validate nothing.")
    elif result.record.held_out is None and not checked:
        lines.append("Without validation data, the accuracy at other configurations is not verified.")
    lines += words.contact_remarks(result.problem.sample())
    lines += words.camera_remarks(result)
    if result.record.simulated:
        lines.append("The measurements are simulated.")
    return lines


def nominal_note(result: Calibration) -> str:
    """Return a note that defines the nominal errors."""
    if not (result.problem.parameters.placed & result.problem.parameters.identified).any():
        return "Nominal: the nominal robot."
    frames = "its base, tool and other frames fitted to the identification data"
    return f"Nominal: the nominal robot, {frames}. Uncorrected errors of `compensate` refer to the identified base."


def summary(result: Calibration, published: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """Return parameters, errors, weight, verdict and sentences of a calibration as a document.

    ``published`` are mean errors [mm] that the source prints, by set and method.
    """
    result = in_session(result)
    record = result.record
    errors = error_rows(result)
    for name, methods in published.items():
        for method, mean in methods.items():
            errors.append({"what": f"{name}, published: {method}", "mean_mm": mean, "printed": True})
    lacking = judged(result)
    accepted, found = tested(result)
    concluded, verdict = conclusion(result, found)
    region, said = [], ""
    if accepted is not None:  # which states the uncertainty, too
        concluded, verdict, said = accepted.verdict, "", accepted.caution
    elif found is not None:
        region = [f"{found.summary}; region: {found.requirement.where}."]
    remarks = [
        *region,
        *words.weight_lines(result),
        identifiability(result),
        words.noise_sentence(result),
        *words.turned_frames(result),
        *session_notes(result),
        nominal_note(result),
        *(text for text in words.underdetermined(result) if text not in said),
        *warnings(result),
        *[result.message] * result.converged,
    ]
    return {
        **figures(result),
        "title": record.title,
        "source": record.source,
        "headline": " ".join(filter(None, [verdict, headline(result)])),
        "errors": errors,
        "orientation": orientation_rows(result),
        "shadow_prices": [price._asdict() for price in result.shadow_prices],
        "remarks": [*remarks, *result.verdict.beside(result.causes)],
        "likely_causes": list(result.causes),
        "lack_of_fit": lacking and lacking.content(),
        "details": dict(record.details),
        "acceptance": accepted and {**accepted.content(), "text": accepted.sentences()},
        "conclusion": concluded,
    }


def describe(result: Calibration, document: Mapping[str, Any]) -> str:
    """Return a `summary` as text: headline, verdict or acceptance, what was estimated, warnings, and the tables."""
    details = [f"{FIELDS[key]}: {text}" for key, text in document["details"].items()]
    lines = [*filter(None, [document["title"], document["source"]]), *details, "", document["headline"]]
    if document["acceptance"]:
        lines += document["acceptance"]["text"]
    else:
        lines += [*filter(None, [document["verdict"]["caution"]]), *document["verdict"]["reasons"]]
    lines += ["", *document["remarks"]]
    if document["lack_of_fit"]:
        lines += document["lack_of_fit"]["text"]
    lines += ["", table(["error [mm]", *COLUMNS], cells(document["errors"]))]
    if document["orientation"]:
        lines += ["", table(["orientation error [mrad]", *COLUMNS], cells(document["orientation"], "mrad"))]
    return "\n".join([*lines, "", words.parameter_table(result)])
