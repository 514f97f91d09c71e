"""A calibration in words: its parameters as a table, its weight or hyperparameters, and remarks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.text import html_table, joined, listed, table
from rpim_opt.basics.units import display
from rpim_opt.bayes.hyperparameters import Learned, Size
from rpim_opt.bayes.prior import BASE, SESSIONS, family_of
from rpim_opt.calibration.diagnosis import Held
from rpim_opt.calibration.outcome import Outcome
from rpim_opt.calibration.uncertainty import known_covariance
from rpim_opt.calibration.verdict import Verdict
from rpim_opt.convex.select import disagreement
from rpim_opt.data.record import Earlier
from rpim_opt.robot.extensions import EXPECTED
from rpim_opt.robot.parameter_names import EXPANSION, is_joint_offset, of_session, own_name

MOST_ROWS, MOST_BOUNDS = 8, 5
"""Outlying rows and active bounds that are named one by one."""
LAST_DIGIT = 1e-4
"""What tables of parameters show [mm, degree]."""
NOISE_UNITS = {"position": ("mm", 1e3), "orientation": ("mrad", 1e3), "joint": ("mrad", 1e3)}
"""Unit in which the robot's repeatability is said, and how many of it are one in SI."""
WHERE = {"position": "in position", "orientation": "in orientation", "joint": "at the joints"}
SESSION_UNITS = {"length": ("mm", 1e-3), "angle": ("mrad", 1e-3)}
"""Unit in which session offsets are said, and its size in SI."""
DEFLECTIONS = {
    "compliance": "deflection of joints under gravity",
    "ecc": "first harmonic of joints",
    "ecc2": "second harmonic of joints",
    "bend": "deflection of links under gravity",
}
"""Model extensions whose scales are said as deflections of `EXPECTED` where these are largest."""
MOVED = 10.0
"""Scales of its group beyond which a deviation is said to be unusual: 2 in 1000 are under Student's t_3."""
MOST = 5
"""Unusual parameters and outliers that are named one by one."""
VAGUE = 0.5
"""Standard deviation of the logarithm of a hyperparameter from which on only its upper bound is said."""
NEGLIGIBLE = 0.1
"""Share of the largest part of the repeatability below which another is not said."""
TWO_SIDED, ONE_SIDED = 1.96, 1.645
"""Standard normal quantiles of intervals and of bounds with 95 % confidence."""


def parameter_rows(result: Outcome) -> list[dict[str, Any]]:
    """Return name, unit, nominal, identified, deviation and std of every identified parameter, in that unit."""
    free = result.problem.parameters.free
    values = free.values(result.x)
    C = known_covariance(result)
    rows: list[dict[str, Any]] = []
    for i, name in enumerate(free.names):
        unit, si = display(free.dimensions[i])
        row: dict[str, Any] = {"name": name, "unit": unit, "nominal": float(free.nominal[i] / si)}
        row |= {"identified": float(values[i] / si), "deviation": float(result.x[i] / si), "std": None}
        if C is not None and np.isfinite(C[i, i]):
            row["std"] = float(np.sqrt(C[i, i]) / si)
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
    return head, [_cells(row) for row in parameter_rows(result) if family_of(row["name"]) != "transmission"]


def _cells(row: dict[str, Any]) -> list[str]:
    std = "-"
    if row["std"] is not None:
        std = f"{row['std']:.4f}"
    figures = [f"{row['nominal']:z.4f}", f"{row['identified']:z.4f}", f"{row['deviation']:+z.4f}", std]
    return [row["name"], row["unit"], *figures]


def as_text(result: Outcome, verdict: Verdict) -> str:
    """Return the parameters and errors as a person reads them."""
    return "\n".join([parameter_table(result), "", *_sentences(result, verdict)])


def as_html(result: Outcome, verdict: Verdict) -> str:
    """Return the same for a notebook."""
    return html_table(*_columns(result), notes=_sentences(result, verdict), title=in_short(result).strip("<>"))


def in_short(result: Outcome) -> str:
    """Return one line: what was asked, and how it ended."""
    count = len(result.x)
    return (
        f"<Calibration '{result.formulation.name}', {count} parameters, weight {result.weight:.4g}: {result.message}>"
    )


def _sentences(result: Outcome, verdict: Verdict) -> list[str]:
    before = 1e3 * np.nanmean(result.nominal_errors())
    after = 1e3 * np.nanmean(result.errors())
    errors = f"Identification error (mean): {before:.4f} mm before, {after:.4f} mm after."
    reasons = [text for text in verdict.reasons if text != result.message]
    return [errors, *reasons, *weight_lines(result), *noise_sentence(result), *remarks(result)]


def noise_sentence(result: Outcome) -> list[str]:
    """Say how the residuals compare with the stated measurement noise; nothing where there is no covariance."""
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
    """Say the weight and where it came from, or the hyperparameters in its place: a few sentences."""
    if result.record.earlier:
        return [f"Formulation '{result.formulation.name}'.", _carried_on(result.record.earlier[-1])]
    if result.learned is None:
        return [_one_weight(result)]
    names = result.problem.parameters.free.names
    return [f"Formulation '{result.formulation.name}'.", *learned_lines(result.learned, names, result.z)]


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
    """Say what a reader must know besides the figures: outliers, active bounds, what did not converge."""
    lines = _outlying(result)
    lines += [_bound(result, held) for held in result.held[:MOST_BOUNDS]]
    lines += [price.sentence() for price in result.prices]
    if not result.formulation.solvable:
        lines.append("The formulation has functions that the result's file cannot hold: it cannot be solved again.")
    return [*lines, result.message]


def _outlying(result: Outcome) -> list[str]:
    flagged = result.flagged
    if not flagged:
        return []
    named = [f"{flag.label} ({flag.sigmas:.0f} sigma, {flag.error_mm:.2f} mm)" for flag in flagged[:MOST_ROWS]]
    text = f"Outlying rows: {', '.join(named)}"
    if len(flagged) > MOST_ROWS:
        text += f" and {len(flagged) - MOST_ROWS} more"
    lines = [f"{text}."]
    together = result.kept_together
    if together:
        lines.append(
            f"Of them {listed(together)} err with their neighbours in joint space or in time: they are no outliers; "
            "the model lacks an effect there (model 'auto' compares compliance and gear eccentricity) or the set-up "
            "moved. A refit keeps them."
        )
    if len(together) < len(flagged) and result.squared_loss:
        lines.append("A squared loss lets outliers pull the fit: use formulation 'robust', or exclude them.")
    return lines


def _bound(result: Outcome, held: Held) -> str:
    unit, si = display(result.problem.parameters.dimension_of(held.name))
    tenth = f"{0.1 * abs(held.bound) / si:.3g} {unit}"
    return (
        f"Active bound: {held.name} at {held.bound / si:+.3g} {unit}. Loosening its tolerance by {tenth} would lower "
        f"the whitened RMS by {held.gain:.2g}."
    )


# --- hyperparameters --------------------------------------------------------------------------------------------


def learned_lines(learned: Learned, names: tuple[str, ...], z: Array) -> list[str]:
    """Say which hyperparameters were estimated; parameters' names (n,), and z (n,) in units of the local scales."""
    lines = [
        _scales(learned),
        _transmission(learned),
        *_noise(learned),
        _sessions(learned, names),
        _expansion(learned, names, z),
    ]
    lines += [_model(learned), *_unusual(learned, names, z), _excluded(learned)]
    return [line for line in [*lines, *learned.notes] if line]


def _figure(size: Size, factor: float, unit: str) -> str:
    """Say a hyperparameter with its 95 % confidence interval."""
    spread = np.exp(TWO_SIDED * min(size.spread, 7.0))
    value = factor * size.value
    return f"{value:.2g} {unit} (95 % CI {value / spread:.2g} to {value * spread:.2g})"


def _figure_or_bound(size: Size, factor: float, unit: str) -> str:
    """Say the same, or an upper bound with 95 % confidence where little more is known."""
    if size.spread <= VAGUE:
        return _figure(size, factor, unit)
    return f"at most {factor * size.value * np.exp(ONE_SIDED * size.spread):.2g} {unit} (95 % confidence)"


def _scales(learned: Learned) -> str:
    """Say the scales of groups; those of the base and of sessions have other sentences, or none."""
    said = []
    deflections = []
    unit = "x the stated one"
    for name, size in learned.sizes.items():
        if name in DEFLECTIONS:
            deflections.append(f"{DEFLECTIONS[name]} {_figure(size, 1e3 * EXPECTED, 'mrad')}")
        elif name not in (*SESSIONS.values(), BASE, EXPANSION, "transmission"):
            said.append(f"{name} {_figure(size, 1.0, unit)}")
            unit = "x"
    lines = []
    if said:
        lines.append(f"Estimated prior scale: {joined(said)}.")
    if deflections:
        lines.append(f"Estimated scale of model extensions: {joined(deflections)}.")
    return " ".join(lines)


def _transmission(learned: Learned) -> str:
    if learned.curves is None:
        return ""
    size, length, _ = learned.curves
    return f"Transmission error of joints (1 sigma): {_figure(size, 1e3, 'mrad')}, length scale {length.value:.2g} rad."


def _noise(learned: Learned) -> list[str]:
    """Say the robot's repeatability, and the instrument's noise where that was estimated."""
    robot = {kind: size for kind, size in learned.noise.items() if kind != "instrument"}
    largest = max((size.value for size in robot.values()), default=0.0)
    said = []
    for kind, size in robot.items():
        if size.value > NEGLIGIBLE * largest:
            unit, per_si = NOISE_UNITS[kind]
            said.append(f"{_figure_or_bound(size, per_si, unit)} {WHERE[kind]}")
    lines = []
    if said:
        lines.append(f"Robot repeatability (1 sigma): {joined(said)}.")
    if "instrument" in learned.noise:
        lines.append(f"Measurement noise: {_figure_or_bound(learned.noise['instrument'], 1.0, 'x the stated one')}.")
    return lines


def _sessions(learned: Learned, names: tuple[str, ...]) -> str:
    """Say the standard deviation of session offsets, a coordinate and an axis."""
    said = []
    for dimension, group in SESSIONS.items():
        if group not in learned.sizes:
            continue
        turn = dimension == "angle"
        scale = next(
            s for name, s in zip(names, learned.stated, strict=True)
            if of_session(name) and own_name(name).rpartition("_")[2].startswith("r") == turn
        )  # fmt: skip
        unit, si = SESSION_UNITS[dimension]
        said.append(_figure_or_bound(learned.sizes[group], scale / si, unit))
    if not said:
        return ""
    return f"Session offsets (1 sigma): {joined(said)}."


def _expansion(learned: Learned, names: tuple[str, ...], z: Array) -> str:
    """Say the thermal expansion of lengths."""
    said = []
    for name, stated, value in zip(names, learned.stated, z, strict=True):
        if own_name(name) == EXPANSION and EXPANSION in learned.sizes:
            said.append(f"{1e6 * stated * learned.sizes[EXPANSION].value * value:.3g} um per metre and kelvin")
    if not said:
        return ""
    return f"Thermal expansion: {joined(said)}."


def _model(learned: Learned) -> str:
    if not learned.trials:
        return ""
    gains = {family: learned.gain(family) for trial in learned.trials for family in trial.families}
    supported = [f"{family} {gain:.0f}" for family, gain in gains.items() if gain is not None and gain >= 0.5]
    evidence = ""
    if supported:
        evidence = f" (-2 ln L falls by {joined(supported)})"
    if not learned.families:
        return f"Model: geometry alone; the data support no model extension{evidence}."
    return f"Model: geometry with {joined(learned.families)}{evidence}."


def _unusual(learned: Learned, names: tuple[str, ...], z: Array) -> list[str]:
    lines = []
    for name, ratio in learned.unusual(names, z, MOVED)[:MOST]:
        cause = ""
        if is_joint_offset(name):
            cause = ": an error of assembly or of its zero"
        lines.append(f"{name} deviates by {ratio:.0f} prior standard deviations of its group{cause}.")
    return lines


def _excluded(learned: Learned) -> str:
    if not learned.left_out:
        return ""
    named = [f"{row.label} ({row.ratio:.0f} times the median error)" for row in learned.left_out[:MOST]]
    text = f"Excluded outliers: {', '.join(named)}"
    if len(learned.left_out) > MOST:
        text += f" and {len(learned.left_out) - MOST} more"
    return f"{text}."


# --- tables -----------------------------------------------------------------------------------------------------


def _parameter_frame(result: Outcome) -> list[dict[str, Any]]:
    return [{"parameter": row.pop("name"), **row} for row in parameter_rows(result)]


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


def frame_rows(result: Outcome, what: str) -> list[dict[str, Any]]:
    """Return the rows of one of the `FRAMES`."""
    if what not in FRAMES:
        raise InputError("to_frame", f"'{what}'", choices(what, FRAMES))
    return FRAMES[what](result)
