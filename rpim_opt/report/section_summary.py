"""The report's summary: one sentence, three figures, and what a reader must know."""

from __future__ import annotations

from typing import Any

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.statistics import statistics
from rpim_opt.basics.text import joined
from rpim_opt.calibration.camera_words import camera_remarks
from rpim_opt.calibration.causes import likely_causes
from rpim_opt.calibration.contact_words import contact_remarks, known_points
from rpim_opt.calibration.lack_of_fit import judged
from rpim_opt.calibration.result import Calibration
from rpim_opt.report.frame import bullets
from rpim_opt.report.markup import Element, tag
from rpim_opt.report.pieces import quantity, repeated, sets
from rpim_opt.report.scales import mm

KEPT_APART = "kept apart"


def summary_section(result: Calibration) -> list[Element]:
    """Return the summary, of validation data where there are some."""
    name, nominal, identified = _shown(result)
    before = statistics(nominal)
    after = statistics(identified)
    if not after["count"]:
        raise InputError(f"the {name} data", "no measurement of a length", "positions, poses, distances, ...")
    figures = [
        ("mean before", before["mean_mm"], "before"),
        ("mean after", after["mean_mm"], "after"),
        ("largest after", after["max_mm"], "after"),
    ]
    cards = [
        tag("div", tag("dt", label), tag("dd", mm(value), tag("small", " mm")), class_=kind)
        for label, value, kind in figures
    ]
    causes = likely_causes(result)
    look = "lead"
    if causes or not result.converged:
        look = "lead alarm"
    return [
        tag("p", _sentence(result, name, before, after), class_=look),
        *bullets(causes, "notes"),
        tag("dl", *cards, class_="cards"),
        *_left(result),
        *bullets(_notes(result, name), "notes"),
    ]


def _shown(result: Calibration) -> tuple[str, Array, Array]:
    """Return which rows are summed up, and their errors (N,) before and after [m]: unseen ones where there are some."""
    held = result.record.held_out
    if held is not None:
        return KEPT_APART, held.nominal, held.error
    name, data = next(iter(sets(result).items()))
    return name, result.nominal_errors(data), result.errors(data)


def _left(result: Calibration) -> list[Element]:
    """Return how the noise compares with the declared one, and what the errors that are left are made of."""
    sentences = result.noise_sentence()
    lacking = judged(result)
    if lacking is not None:
        sentences += lacking.sentences()
    if not sentences:
        return []
    return [tag("p", " ".join(sentences))]


def _sentence(result: Calibration, name: str, before: dict[str, Any], after: dict[str, Any]) -> str:
    n = after["count"]
    where = f"On {n} measurements that the calibration did not see"
    if name == KEPT_APART:
        where = f"On {n} measurements that were kept apart"
    elif name != "validation":
        where = f"On the {n} measurements that the calibration itself used (none were kept apart to check it)"
    ratio = before["mean_mm"] / max(after["mean_mm"], 1e-12)
    moves = "rises"
    times = ""
    if ratio > 1:
        moves = "falls"
        times = f", by a factor of {ratio:.1f}" if ratio < 10 else f", by a factor of {ratio:.0f}"
    means = f"from {mm(before['mean_mm'])} mm to {mm(after['mean_mm'])} mm"
    sentence = f"{where}, the mean {quantity(result)} {moves} {means}{times}."
    if not result.converged:
        return f"This calibration did not converge and should not be used. {sentence}"
    return sentence + _from_all(result) + _carried_on(result)


def _carried_on(result: Calibration) -> str:
    """Say what the parameters come from besides, and which of them changed since."""
    if not result.record.earlier:
        return ""
    last = result.record.earlier[-1]
    changed = joined(last.let_go) or "nothing that these measurements show"
    return f" It carries on a calibration of {last.rows} rows; changed since: {changed}."


def _from_all(result: Calibration) -> str:
    """Say what the delivered parameters come from, where the rows that validated were used in their turn."""
    held = result.record.held_out
    if held is None:
        return ""
    return (
        f" That validates the procedure, with parameters from {held.used} rows; those delivered here come from all "
        f"{len(result.problem.labels)}."
    )


def _notes(result: Calibration, name: str) -> list[str]:
    notes = []
    if result.record.simulated:
        notes.append("The measurements are simulated.")
    notes += contact_remarks(result.problem.sample())
    if result.record.validation is not None:
        notes += known_points(result.problem.sample(), result.record.validation)
    notes += camera_remarks(result)
    notes += [line for line in result.remarks() if line != result.message or not result.converged]
    if name == "identification":
        notes.append("Without validation data the errors elsewhere in the workspace are not known to be as small.")
    again = repeated(result)
    if again:
        notes.append(f"{again} validation rows repeat configurations of the identification: they are no check.")
    return notes
