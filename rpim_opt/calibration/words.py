"""A calibration in words: its parameters as a table, its weight, and what a reader must know besides."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.text import html_table, joined, listed, table
from rpim_opt.basics.units import display
from rpim_opt.calibration.diagnosis import Held
from rpim_opt.calibration.learned_words import sentences
from rpim_opt.calibration.outcome import Outcome
from rpim_opt.convex.select import disagreement
from rpim_opt.data.record import Earlier

MOST_ROWS, MOST_BOUNDS = 8, 5
"""Distrusted rows and bounds that are named one by one."""
LAST_DIGIT = 1e-4
"""What tables of parameters show [mm, degree]."""


def standard_deviations(result: Outcome) -> Array:
    """Return standard deviations (n,) [SI]; infinite where the formulation has none (lasso, minimax)."""
    try:
        return np.sqrt(np.diag(result.covariance))
    except InputError:  # a penalty that is no prior, or a loss that no squared one stands for
        return np.full(len(result.x), np.inf)


def parameter_rows(result: Outcome) -> list[dict[str, Any]]:
    """Return name, unit, nominal, identified, deviation and std of every identified parameter, in that unit."""
    free = result.problem.parameters.free
    values, std = free.values(result.x), standard_deviations(result)
    rows: list[dict[str, Any]] = []
    for i, name in enumerate(free.names):
        unit, si = display(free.dimensions[i])
        row = {
            "name": name,
            "unit": unit,
            "nominal": float(free.nominal[i] / si),
            "identified": float(values[i] / si),
            "deviation": float(result.x[i] / si),
            "std": None,
        }
        if np.isfinite(std[i]):
            row["std"] = float(std[i] / si)
        rows.append(row)
    return rows


def turned_frames(result: Outcome) -> list[str]:
    """Say where a deviation is not the difference of the columns beside it: turns of a frame are composed."""
    names = [
        row["name"]
        for row in parameter_rows(result)
        if abs(row["identified"] - row["nominal"] - row["deviation"]) > LAST_DIGIT
    ]
    if not names:
        return []
    turn = "turn the frame about the axes of the one before it: no differences of the values beside them"
    return [f"Deviations of {listed(names)} {turn}."]


def parameter_table(result: Outcome) -> str:
    """Return the identified parameters as a table of text."""
    return table(*_columns(result))


def _columns(result: Outcome) -> tuple[list[str], list[list[str]]]:
    head = ["parameter", "unit", "nominal", "identified", "deviation", "std"]
    return head, [_cells(row) for row in parameter_rows(result)]


def _cells(row: dict[str, Any]) -> list[str]:
    std = "-"
    if row["std"] is not None:
        std = f"{row['std']:.4f}"
    figures = [f"{row['nominal']:z.4f}", f"{row['identified']:z.4f}", f"{row['deviation']:+z.4f}", std]
    return [row["name"], row["unit"], *figures]


def as_text(result: Outcome) -> str:
    """Return the parameters and errors as a person reads them."""
    return "\n".join([parameter_table(result), "", *_sentences(result)])


def as_html(result: Outcome) -> str:
    """Return the same for a notebook."""
    return html_table(*_columns(result), notes=_sentences(result), title=in_short(result).strip("<>"))


def in_short(result: Outcome) -> str:
    """Return one line: what was asked, and how it ended."""
    count = len(result.x)
    return (
        f"<Calibration '{result.formulation.name}', {count} parameters, weight {result.weight:.4g}: {result.message}>"
    )


def _sentences(result: Outcome) -> list[str]:
    before = 1e3 * np.nanmean(result.nominal_errors())
    after = 1e3 * np.nanmean(result.errors())
    errors = f"Identification error (mean): {before:.4f} mm before, {after:.4f} mm after."
    return [errors, *weight_lines(result), *noise_sentence(result), *remarks(result)]


def noise_sentence(result: Outcome) -> list[str]:
    """Say how the noise that the data show compares with what was declared; nothing where it cannot be told."""
    try:
        return [result.noise_test().verdict]
    except InputError:  # no freedom: a penalty that is no prior, or a loss that no squared one stands for
        return []


def selector(result: Outcome) -> str:
    """Return the rule's name: ``learned`` sizes, ``given`` for a number, ``none`` without a penalty."""
    if result.formulation.penalty is None:
        return "none"
    if result.record.earlier:
        return "earlier result"
    if result.learned is not None:
        return "learned"
    if result.selection is None:
        return "given"
    return result.selection.name


def weight_lines(result: Outcome) -> list[str]:
    """Say the weight and where it came from, or what was learned in its place: a few sentences."""
    if result.record.earlier:
        return [f"Formulation '{result.formulation.name}'.", _carried_on(result.record.earlier[-1])]
    if result.learned is None:
        return [_one_weight(result)]
    names = result.problem.parameters.free.names
    return [f"Formulation '{result.formulation.name}'.", *sentences(result.learned, names, result.z)]


def weight_sentence(result: Outcome) -> str:
    """Say the same in one line."""
    return " ".join(weight_lines(result))


def _carried_on(last: Earlier) -> str:
    """Say which calibration's posterior the prior is."""
    text = f"Prior: the posterior of '{last.title}', {last.rows} rows, made {last.made or 'just now'}"
    text += f" (digest {last.digest[:12]})"
    if last.inflate != 1:
        text += f", its standard deviations times {last.inflate:g}"
    if last.let_go:
        text += f", without {joined(last.let_go)}"
    return f"{text}."


def _one_weight(result: Outcome) -> str:
    name = result.formulation.name
    if result.formulation.penalty is None:
        return f"Formulation '{name}' has no penalty and needs no weight."
    if result.selection is None:
        return f"Weight {result.weight:.4g} ({selector(result)}), formulation '{name}'."
    if result.selection.groups:
        weights = ", ".join(f"{group} {weight:.4g}" for group, weight in result.selection.groups.items())
        return f"Weights {weights} ({selector(result)}: {result.selection.note}), formulation '{name}'."
    text = f"Weight {result.weight:.4g} ({selector(result)}: {result.selection.note}), formulation '{name}'."
    return " ".join(filter(None, [text, disagreement(result.program)]))


def remarks(result: Outcome) -> list[str]:
    """Say what a reader must know besides the figures: blunders, bounds that hold, what did not converge."""
    lines = _distrust(result)
    lines += [_bound(result, held) for held in result.held[:MOST_BOUNDS]]
    lines += [price.sentence() for price in result.prices]
    if not result.formulation.solvable:
        lines.append("The formulation has functions that the result's file cannot hold: it cannot be solved again.")
    return [*lines, result.message]


def _distrust(result: Outcome) -> list[str]:
    flagged = result.flagged
    if not flagged:
        return []
    named = [f"{flag.label} ({flag.sigmas:.0f} sigmas, {flag.error_mm:.2f} mm)" for flag in flagged[:MOST_ROWS]]
    text = f"Distrusted rows: {', '.join(named)}"
    if len(flagged) > MOST_ROWS:
        text += f" and {len(flagged) - MOST_ROWS} more"
    lines = [f"{text}."]
    together = result.kept_together
    if together:
        lines.append(
            f"Of them {listed(together)} err with their neighbours in joint space or in time: they are no blunders, "
            "the model lacks something there (model 'auto' looks for gravity and eccentric joints) or the set-up "
            "moved; a refit keeps them."
        )
    if len(together) < len(flagged) and result.squared_loss:
        lines.append("A squared loss lets such rows pull the fit: use formulation 'robust', or leave them out.")
    return lines


def _bound(result: Outcome, held: Held) -> str:
    unit, si = display(result.problem.parameters.dimension_of(held.name))
    tenth = f"{0.1 * abs(held.bound) / si:.3g} {unit}"
    return (
        f"{held.name} is held at {held.bound / si:+.3g} {unit}: loosening its tolerance by {tenth} would lower the "
        f"whitened RMS by {held.gain:.2g}."
    )


def frame_rows(result: Outcome, what: str) -> list[dict[str, Any]]:
    """Return the rows of one of the `FRAMES`."""
    if what not in FRAMES:
        raise InputError("to_frame", f"'{what}'", choices(what, FRAMES))
    return FRAMES[what](result)


def _parameter_frame(result: Outcome) -> list[dict[str, Any]]:
    rows = parameter_rows(result)
    return [{"parameter": row["name"], **{key: row[key] for key in row if key != "name"}} for row in rows]


def _error_frame(result: Outcome) -> list[dict[str, Any]]:
    both = zip(result.problem.labels, 1e3 * result.nominal_errors(), 1e3 * result.errors(), strict=True)
    return [{"label": label, "nominal_mm": float(b), "identified_mm": float(a)} for label, b, a in both]


FRAMES: dict[str, Callable[[Outcome], list[dict[str, Any]]]] = {
    "parameters": _parameter_frame,
    "errors": _error_frame,
    "history": lambda result: [dict(vars(each)) for each in result.history],
    "flags": lambda result: [flag._asdict() for flag in result.flagged],
    "bounds": lambda result: [held._asdict() for held in result.held],
    "prices": lambda result: [price._asdict() for price in result.prices],
}
"""Tables of a result by name."""
