"""Text of a calibration: the parameter table, the weight or hyperparameters, and remarks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array, rms
from rpim_opt.basics.text import joined, listed, table
from rpim_opt.basics.units import display, printed
from rpim_opt.bayes.hyperparameters import Hyperparameter, Learned
from rpim_opt.bayes.prior import BASE, SESSIONS
from rpim_opt.calibration.outcome import Outcome
from rpim_opt.calibration.uncertainty import transmission_errors
from rpim_opt.calibration.verdict import REPEATABILITY, Verdict, scaled_by_board
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.noise import UNITS, in_unit
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.camera import camera_blocks
from rpim_opt.problem.registration.closed_forms import NOMINAL_ERROR
from rpim_opt.problem.row_functions import masses_assumed
from rpim_opt.robot.extensions import EXPECTED
from rpim_opt.robot.parameters import EXPANSION, is_joint_offset, of_session, own_name

MOST_ROWS, MOST_BOUNDS = 8, 5  # outliers and active bounds named individually
LAST_DIGIT = 1e-4  # resolution of parameter tables [mm, degree]
WHERE = {
    "position": "in position along each axis",
    "orientation": "in orientation",
    "joint": "at the joints",
    "reading": "of each reading",
}
"""Wording of the components of the robot's repeatability."""
DEFLECTIONS = {
    "compliance": "deflection of joints under gravity",
    "ecc": "first harmonic of joints",
    "ecc2": "second harmonic of joints",
    "moment": "deflection of links under gravity",
}
"""Model extensions whose scales are reported as deflections, at the configuration where these are largest."""
UNUSUAL = 10.0  # scales of its group above which a deviation is called unusual: 2 in 1000 are under Student's t_3
MOST = 5  # unusual parameters and outliers named individually
VAGUE = 0.5  # standard deviation of ln(hyperparameter) above which only its upper bound is reported
REDUNDANT = 0.99  # correlation of two parameters above which little more than a combination is known
NEGLIGIBLE = 0.1  # share of the largest part of repeatability below which another is not reported
TWO_SIDED, ONE_SIDED = 1.96, 1.645  # standard normal quantiles of intervals and of bounds with 95 % confidence
MOST_POINTS = 20  # rows of a table of points; one row counts the others
HEADER = ["touches by point [mm]", "touches", "RMS, nominal", "RMS, identified", "max, identified"]


def rotated(row: Mapping[str, Any]) -> bool:
    """Whether the deviation of a row of `parameter_rows` is a composed rotation, not a difference of the columns."""
    return abs(row["identified"] - row["nominal"] - row["deviation"]) > LAST_DIGIT


def turned_frames(result: Outcome) -> list[str]:
    """Return a note on the parameters that tables mark with ``*``, since they are `rotated`."""
    names = [row["parameter"] for row in result.parameter_rows() if rotated(row)]
    if not names:
        return []
    turn = "roll, pitch and yaw of the rotation from the nominal to the identified frame, about the axes of its parent"
    return [f"Deviations marked * ({listed(names)}) are not identified minus nominal, but {turn}."]


def parameter_table(result: Outcome) -> str:
    """Return the identified parameters as a table of text, and the joints' transmission errors as another."""
    head, rows = curve_columns(result)
    return "\n\n".join([table(*columns(result)), *([table(head, rows)] if rows else [])])


def columns(result: Outcome) -> tuple[list[str], list[list[str]]]:
    """Return header and cells of the table of identified parameters."""
    cells = []
    for row, of_curve in zip(result.parameter_rows(), result.problem.parameters.free.of_curves, strict=True):
        if not of_curve:
            n = decimals(row["std"])
            figures = [f"{row['nominal']:z.{n}f}", f"{row['identified']:z.{n}f}", f"{row['deviation']:+z.{n}f}"]
            std = "-" if row["std"] is None else f"{row['std']:.{n}f}"
            name = f"{row['parameter']} *" if rotated(row) else row["parameter"]
            cells.append([name, printed(row["unit"]), *figures, std])
    return ["parameter", "unit", "nominal", "identified", "deviation", "std"], cells


def decimals(std: float | None) -> int:
    """Return how many decimals show two digits of a standard deviation, at least 4 and at most 9."""
    return 4 if not std or not np.isfinite(std) else int(np.clip(1 - np.floor(np.log10(std)), 4, 9))


def curve_columns(result: Outcome) -> tuple[list[str], list[list[str]]]:
    """Return header and cells of the table of transmission errors, over the measured range of each joint."""
    cells = []
    for curve in transmission_errors(result):
        inside = curve.inside
        sizes = [curve.rms, np.abs(curve.error[inside]).max(), np.median(curve.standard[inside])]
        low, high = np.degrees(curve.measured)
        figures = [f"{1e3 * size:.3f}" for size in (*sizes, curve.effect)]
        cells.append([str(curve), f"{low:.1f} to {high:.1f}", *figures])
    head = ["transmission error", "measured [deg]", "RMS [mrad]", "maximum [mrad]", "std, median [mrad]"]
    return [*head, "at the tool, RMS [mm]"], cells


def sentences(result: Outcome, verdict: Verdict) -> list[str]:
    """Return the sentences below the table: errors, reasons of the verdict, weight, noise and remarks."""
    errors = "Errors are undefined: the rows have neither lengths nor angles nor pixels."
    for dimension, (unit, si) in UNITS.items():
        before, after = result.nominal_errors(dimension=dimension), result.errors(dimension=dimension)
        if np.isfinite(after).any():
            means = f"{np.nanmean(before) / si:.4f} {unit} before, {np.nanmean(after) / si:.4f} {unit} after"
            errors = f"Identification error (mean): {means}."
            break
    reasons = [text for text in verdict.reasons if text != result.message]
    above = [*turned_frames(result), errors, *filter(None, [verdict.caution]), *reasons]
    return [*above, *weight_lines(result), noise_sentence(result), *underdetermined(result), *remarks(result, verdict)]


def noise_sentence(result: Outcome) -> str:
    """Return the noise test as a sentence, or why there is none."""
    if result.contradiction and not result.no_intervals:
        ratio = result.noise_test().ratio
        return f"Residuals are {ratio:.2f} times the measurement noise, with constraints that the data contradict."
    return result.no_intervals or result.noise_test().verdict


def weight_lines(result: Outcome) -> list[str]:
    """Return sentences on the weight and its origin, or on the hyperparameters."""
    name = result.formulation.name
    if result.record.earlier:
        last = result.record.earlier[-1]
        text = f"Prior: the posterior of '{last.title}', {last.rows} rows, made {last.made or 'just now'}"
        text += f" (digest {last.digest[:12]})"
        if last.prior_inflation != 1:
            text += f", its standard deviations times {last.prior_inflation:g}"
        if last.released:
            text += f", without {last.changed}"
        return [f"Formulation '{name}'.", f"{text}."]
    if result.learned is not None:
        form = result.program.penalty_form
        centre = 0.0 if form is None else np.linalg.lstsq(form.matrix, form.c, rcond=None)[0]
        names = result.problem.parameters.free.names
        return [f"Formulation '{name}'.", *learned_lines(result.learned, names, result.z, result.z - centre)]
    if result.formulation.penalty is None:
        return [f"Formulation '{name}' has no penalty and needs no weight."]
    if result.selection is None:
        return [f"Weight {result.weight:.4g} ({result.selector}), formulation '{name}'."]
    note = result.selection.note or ("" if result.selection.interior else "at an edge of the tried weights")
    rule = ": ".join(filter(None, [result.selector, note]))
    return [f"Weight {result.weight:.4g} ({rule}), formulation '{name}'."]


def remarks(result: Outcome, verdict: Verdict) -> list[str]:
    """Return remarks on outliers, active bounds, an assumed noise and convergence; advice only if delivered."""
    lines = _outlying(result, verdict.delivered)
    for held in [held for held in result.active_bounds if held.bound][:MOST_BOUNDS]:
        parameters = result.problem.parameters
        unit, si = display(parameters.dimensions[parameters.names.index(held.name)])
        tenth = f"{0.1 * abs(held.bound) / si:.3g} {unit}"
        lines.append(
            f"Active bound: {held.name} at {held.bound / si:+.3g} {unit}. Loosening its tolerance by {tenth} would "
            f"lower the RMS of the standardized residuals by {held.gain:.2g}."
        )
    beyond = np.flatnonzero(np.abs(result.x) > 1.001 * result.problem.parameters.free.tolerance)
    if len(beyond):
        names = listed([result.problem.parameters.free.names[i] for i in beyond])
        lines.append(
            f"Deviations beyond the tolerance ([tolerance]): {names}. Only formulation 'bounded' enforces tolerances."
        )
    lines += [price.sentence() for price in result.shadow_prices]
    if result.active_constraints and not result.contradiction:  # which says it
        lines.append(
            f"Active constraints: {listed(result.active_constraints)}. Standard deviations and intervals are "
            "conditional on them: too small where these do not hold for the robot."
        )
    if not result.formulation.solvable:
        lines.append("The result file cannot store functions of a script: use that script to calibrate again.")
    lines += on_assumed_masses(result)
    if result.record.noise_assumed:
        lines.append(
            "The measurement noise is assumed, not stated; uncertainties and verdict depend on it. State the "
            "instrument's in [noise] of problem.toml and remove noise_assumed."
        )
    return [*lines, result.message]


def on_assumed_masses(result: Outcome) -> list[str]:
    """Return a sentence on a deflection by assumed masses of links, whose error no interval contains."""
    part = result.problem.sample()
    if not any(masses_assumed(arm.robot, arm.parameters, arm.data) for arm in map(part.alone, part.arms)):
        return []
    return [
        "Gravity acts on assumed masses of the links, whose error U does not contain: state their masses in the robot "
        "file (mass_kg, centre_x_mm, ...), or test the result on new configurations (`accept --data`)."
    ]


def underdetermined(result: Outcome) -> list[str]:
    """Return a sentence on frame parameters of which the data determine only a combination."""
    p = result.problem.parameters
    covariance = result.known_covariance
    if covariance is None:
        return []
    std = np.sqrt(np.diag(covariance))
    placed = [own_name(name).startswith((f"{BASE}_", "tool_")) for name in p.free.names]
    vague = np.flatnonzero(placed & np.isfinite(std) & (std > NOMINAL_ERROR))
    correlation = covariance[np.ix_(vague, vague)] / np.outer(std[vague], std[vague]) - np.eye(len(vague))
    names = [p.free.names[k] for k, each in zip(vague, correlation, strict=True) if np.abs(each).max() > REDUNDANT]
    if not names:
        return []
    return [
        f"{joined(names)} are redundant: the data determine a combination; each value and its uncertainty depend "
        f'on nominal value and prior scale. State one, with 1 sigma: [prior] known = ["{names[-1]} = ... +- ..."].'
    ]


def _outlying(result: Outcome, advised: bool) -> list[str]:
    flagged = result.flagged
    if not flagged:
        return []
    together = result.clustered
    named = [f"{f.label} ({f.sigmas:.0f} standard deviations, {in_unit(f.error, f.dimension)})" for f in flagged]
    lines = [f"Outliers: {listed(named, MOST_ROWS)}."]
    if together:
        lines.append(
            f"{listed(together)} have errors like their neighbours in joint space or time: the model lacks an effect"
            ' there (model = "auto" tests compliance and gear eccentricity), or the set-up moved. --drop-outliers keeps'
            " them."
        )
    if advised and len(together) < len(flagged) and result.squared_loss:
        lines.append("Outliers bias a squared loss: use formulation 'robust', or leave them out ([exclude]).")
    return lines


# --- hyperparameters --------------------------------------------------------------------------------------------


def learned_lines(learned: Learned, names: tuple[str, ...], z: Array, off: Array) -> list[str]:
    """Return sentences on estimated hyperparameters, from z and z minus prior mean (n,) in local scales."""
    ratio = np.abs(off) * learned.local
    unusual = []
    for i in np.argsort(-ratio)[:MOST]:
        if ratio[i] > UNUSUAL:
            cause = "an assembly or joint-zero error" if is_joint_offset(names[i]) else "check it in the data sheet"
            unusual.append(f"{names[i]} deviates by {ratio[i]:.0f} prior standard deviations of its group: {cause}.")
    lines = [f"{what}: {joined(parts)}." for what, parts in _estimates(learned, names, z).items() if parts]
    lines += [*_model_lines(learned), *unusual]
    if learned.left_out:
        excluded = [str(row) for row in learned.left_out]
        lines.append(f"Excluded outliers: {listed(excluded, MOST)}.")
    return [*lines, *learned.notes]


def _estimates(learned: Learned, names: tuple[str, ...], z: Array) -> dict[str, list[str]]:
    """Return the estimates as texts: prior scales, repeatability beside its largest part, noise, and conditions."""
    groups, deflections, curves = [], [], []
    for name, size in learned.scales.items():
        if name in DEFLECTIONS:
            deflections.append(f"{DEFLECTIONS[name]} {_figure(size, 1e3 * EXPECTED, 'mrad')}")
        elif name not in (*SESSIONS.values(), BASE, EXPANSION):
            groups.append(f"{name} {_figure(size, 1.0, 'x' if groups else 'x the stated one')}")
    if learned.curves is not None:
        ripple = _figure(learned.curves.size, 1e3, "mrad")
        curves.append(f"{ripple}, correlation length {learned.curves.length.value:.2g} rad")
    robot = {kind: size for kind, size in learned.noise.items() if kind != "instrument"}
    largest = max((size.value for size in robot.values()), default=0.0)
    parts = []
    for kind, size in robot.items():
        if size.value > NEGLIGIBLE * largest:
            parts.append(f"{_figure_or_bound(size, 1e3, REPEATABILITY[kind][0])} {WHERE[kind]}")
    factor = learned.noise.get("instrument")
    instrument = [] if factor is None else [_figure_or_bound(factor, 1.0, "x the stated one")]
    sessions = []  # of a coordinate, and of an axis
    for dimension, group in SESSIONS.items():
        if group in learned.scales:
            turn = dimension == "angle"
            of = [of_session(name) and own_name(name).rpartition("_")[2].startswith("r") == turn for name in names]
            scale = learned.stated[of.index(True)]
            sessions.append(_figure_or_bound(learned.scales[group], 1e3 * scale, "mrad" if turn else "mm"))
    expansion = []
    if EXPANSION in learned.scales:
        per_kelvin = 1e6 * learned.stated * learned.scales[EXPANSION].value * z
        of = [own_name(name) == EXPANSION for name in names]
        expansion = [f"{value:.3g} um/(m K)" for value in per_kelvin[of]]
    return {
        "Estimated prior scale": groups,
        "Estimated scale of model extensions": deflections,
        "Transmission error of joints (1 sigma)": curves,
        "Robot repeatability (1 sigma)": parts,
        "Measurement noise": instrument,
        "Session offsets (1 sigma)": sessions,
        "Thermal expansion": expansion,
    }


def _model_lines(learned: Learned) -> list[str]:
    """Return a sentence on the selected model extensions and the evidence for each."""
    if not learned.trials:
        return []
    gains = {extension: learned.gain(extension) for trial in learned.trials for extension in trial.extensions}
    supported = [f"{extension} {gain:.0f}" for extension, gain in gains.items() if gain is not None and gain >= 0.5]
    evidence = f" (likelihood-ratio statistic: {joined(supported)})" if supported else ""
    if not learned.extensions:
        return [f"Model: the data support no extension{evidence}."]
    return [
        f"Model: geometry with {joined(learned.extensions)}{evidence}. `compensate` uses the whole model; files "
        "for controllers hold geometry only, and `export` states the error of what it writes."
    ]


def _figure(size: Hyperparameter, factor: float, unit: str) -> str:
    """Return a hyperparameter with its 95 % confidence interval as text."""
    spread = np.exp(TWO_SIDED * min(size.log_std, 7.0))
    value, low, high = (f"{float(f'{factor * size.value * by:.2g}'):,g}" for by in (1.0, 1 / spread, spread))
    return f"{value} {unit} (95 % CI {low} to {high})"


def _figure_or_bound(size: Hyperparameter, factor: float, unit: str) -> str:
    """Return the same, or an upper bound with 95 % confidence where little more is known."""
    if size.log_std <= VAGUE:
        return _figure(size, factor, unit)
    return f"at most {factor * size.value * np.exp(ONE_SIDED * size.log_std):.2g} {unit} (95 % confidence)"


def camera_remarks(result: Outcome) -> list[str]:
    """Return remarks on views of a camera; empty if there are none."""
    if not camera_blocks(result.problem.sample().data):
        return []
    from rpim_opt.calibration.leverage import improvement  # which no other measurement needs

    before, after = (rms(errors(dimension="pixel")) for errors in (result.nominal_errors, result.errors))
    remarks = [
        f"Reprojection error (RMS): {before:.3g} px before, {after:.3g} px after; errors in mm are distances of the "
        "line of sight from the point. The reprojection error measures how well views agree, not how well the robot is "
        "identified."
    ]
    lens = improvement(result)
    if lens is None:
        remarks.append("This result does not determine the expected position error of the flange.")
    else:
        remarks.append(
            "Expected position error of the flange over its joint ranges, base and tool fitted: "
            f"{1e3 * lens.before:.3g} mm RMS nominal, {1e3 * lens.after:.3g} mm identified (95 % within "
            f"{1e3 * lens.within:.3g} mm along any axis)."
        )
        if not lens.improves:
            remarks.append(
                "These views do not improve this robot: use its nominal parameters. Views from farther apart, with the "
                "board nearer or larger, or an instrument that measures positions would."
            )
    if scaled_by_board(result):
        remarks.append(
            "Views do not identify the size of the board: an error in it scales the robot by the same factor. Measure "
            "the board over all its squares, or identify board_stretch_x and board_stretch_y."
        )
    return remarks


# --- contacts ---------------------------------------------------------------------------------------------------------


def touch_errors(data: Dataset, nominal: Array, error: Array) -> tuple[dict[str, Any], ...]:
    """Return by point or plane, the worst first: touches, their RMS errors [mm] before and after, and the largest."""
    errors = []
    for name, rows in _touched(data).items():
        before, after = 1e3 * nominal[rows], 1e3 * error[rows]
        lengths = {"nominal_rms_mm": rms(before), "rms_mm": rms(after), "max_mm": float(after.max())}
        errors.append({"name": name, "count": len(rows), **lengths})
    return tuple(sorted(errors, key=lambda each: -each["rms_mm"]))


def _touched(data: Dataset) -> dict[str, list[int]]:
    """Return the rows that touched a point or plane, with any tool and of any robot, by its name."""
    rows: dict[str, list[int]] = {}
    for block in data.blocks:
        if block.measurement.touching and block.touched is not None:
            for name, row in zip(block.touched[:, 0], block.row, strict=True):
                rows.setdefault(name, []).append(int(row))
    return rows


def touch_rows(found: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """Return the rows of the table [mm] under `HEADER`: the worst points, and the number of the others."""
    rows = []
    for each in found[:MOST_POINTS]:
        lengths = [f"{each[key]:.3f}" for key in ("nominal_rms_mm", "rms_mm", "max_mm")]
        rows.append([each["name"], str(each["count"]), *lengths])
    others = found[MOST_POINTS:]
    if others:
        touches, largest = sum(each["count"] for each in others), max(each["max_mm"] for each in others)
        rows.append([f"{len(others)} others", str(touches), "", "", f"{largest:.3f}"])
    return rows


def known_points(problem: CalibrationProblem, data: Dataset) -> list[str]:
    """Return a sentence on touched points that are not held out, since the calibration used them."""
    known = _touched(problem.data)
    both = [name for name in _touched(data) if name in known]
    if not both:
        return []
    return [f"Not held out: the calibration also used touches of {listed(both)}."]


def contact_remarks(problem: CalibrationProblem) -> list[str]:
    """Return remarks on what touches show and what they do not; empty if there are none."""
    if problem.touches is None:
        return []
    remarks = [
        "Error of a touch: the modelled distance of the tool from the mean of all touches of its point, or from the "
        "best-fit plane of all touches of its plane. True places were not measured: the error shows how consistently "
        "they are reached from all sides. Touches do not identify the base frame or the offset of the first joint."
    ]
    if not any(tie.kind == "known_distance" for tie in problem.touches.ties):
        remarks.append("The scale of the robot rests on its nominal lengths: a [[known_distance]] would determine it.")
    return remarks
