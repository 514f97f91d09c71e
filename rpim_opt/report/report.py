"""The calibration report: the content of its sections, in their order."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import stdtrit

from rpim_opt.basics.arrays import Array, statistics
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import write_text
from rpim_opt.basics.text import counted, listed, percent
from rpim_opt.basics.units import joint_columns, printed
from rpim_opt.bayes.prior import Prior
from rpim_opt.bayes.prior_terms import prior_penalty
from rpim_opt.calibration import words
from rpim_opt.calibration.acceptance import Acceptance, Workspace, accept, tested
from rpim_opt.calibration.held_out import coverage_text, headline_errors, rows_used
from rpim_opt.calibration.lack_of_fit import judged
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import Uncertainty, held_out_errors, position_budget, transmission_errors
from rpim_opt.convex import select
from rpim_opt.convex.rules.selection import Selection
from rpim_opt.data.dataset import Block as Rows
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.design import combination, observe
from rpim_opt.problem.noise import in_unit
from rpim_opt.problem.workspace import in_base
from rpim_opt.report import plot, summary
from rpim_opt.report.page import Block, Figure, Table, figure, render
from rpim_opt.report.summary import mm
from rpim_opt.robot.parameters import own_name
from rpim_opt.store.problem_file import FIELDS
from rpim_opt.store.result_file import definition
from rpim_opt.use.export import FLANGE, beyond_geometry
from rpim_opt.use.sessions import in_session, session_notes
from rpim_opt.use.validation import Validation

MOST_FLAGGED = 200  # flagged rows that are named, the worst first
L_CURVE_HEIGHT = 340.0  # [px], for the label of its axis
WHY = {"learned": "maximum of the marginal likelihood"}  # reasons of choices without a note


def write_report(calibration: Calibration, path: str | Path, new: Mapping[str, Validation] | None = None) -> None:
    """Write a calibration report: one HTML file that needs no network, written whole or not at all.

    Verdict and headline come first, then `SECTIONS`. Text from a user's file is shown as plain text. ``new`` maps names
    of tables to `ro.use.validate`'s results on further measurements; headline and acceptance test then refer to them.
    InputError if none has a length.

    >>> import rpim_opt as ro
    >>> ro.report.write_report(ro.calibrate("paper_arm"), "report.html")
    """
    write_text(Path(path), page(replace(calibration, record=calibration.record.dated()), new))


FAVOURABLE = ("accepted", "inconclusive", "rejected")  # verdicts of acceptance tests, the most favourable first


class Content(NamedTuple):
    """A result, with evaluations that several sections share."""

    result: Calibration
    accepted: Acceptance | None  # the least favourable test by new measurements, or the result's own
    tested: str  # the new measurements of that test
    errors: tuple[str, Array, Array]  # name of the headline's rows, and their errors (N,) [m], nominal and identified
    map: Workspace | None
    composition: list[str]
    new: Mapping[str, Validation]


def page(result: Calibration, new: Mapping[str, Validation] | None = None) -> str:
    """Return the report as HTML."""
    new = new or {}
    result = in_session(result)
    heading = result.record.title or " and ".join(robot.name for robot in result.problem.arms.values())
    warnings = summary.warnings(result, checked=bool(new))
    composition: list[str] = []
    if lacking := judged(result):
        composition = lacking.sentences()
        if lacking.alarming:  # shown at the top; otherwise it is a diagnosis
            warnings.insert(0, " ".join(composition))
            composition = []
    left_out = [str(row) for row in result.left_out]
    if left_out:
        warnings.append(f"Excluded outliers: {counted(len(left_out), 'row')}, {listed(left_out)}.")
    accepted, workspace = tested(result)
    if workspace is not None and not np.isfinite(workspace.expanded).all():
        workspace = None
    warnings = [f"New measurements, {name}: {each.failure}" for name, each in new.items() if each.failure] + warnings
    tests = {}
    for name, each in new.items():
        with contextlib.suppress(InputError):  # no requirement, or rows with another interpretation: a failure
            tests[name] = accept(result, data=each.data)
    by, accepted = max(tests.items(), key=lambda of: FAVOURABLE.index(of[1].verdict), default=("", accepted))
    content = Content(result, accepted, by, _errors(result, new), workspace, composition, new)
    headline = list(_headline(content))  # raises for rows without a length, before any figure is drawn
    sections = [(name, list(section(content))) for name, section in SECTIONS]
    return render(
        f"Calibration: {heading}",
        f"Robot calibration report, {result.record.made[:10]}",
        heading,
        [*headline, ("notes", warnings)],
        [(name, blocks) for name, blocks in sections if blocks],
    )


def _errors(result: Calibration, new: Mapping[str, Validation]) -> tuple[str, Array, Array]:
    """Return what the headline's rows are, and their errors (N,) [m], nominal and identified."""
    if not any(np.isfinite(each.error).any() for each in new.values()):
        return headline_errors(result)
    nominal, identified = (np.concatenate([getattr(v, of) for v in new.values()]) for of in ("nominal", "error"))
    used = any(rows_used(result, each.data) for each in new.values())
    return "used" if used else "new", nominal, identified


def _headline(content: Content) -> Iterator[Block]:
    result = content.result
    accepted = content.accepted
    reasons = result.verdict.reasons
    yield "facts", [(FIELDS.get(key, key), text) for key, text in result.record.details.items()]
    if accepted is not None:
        word, _, text = accepted.sentences()[0].partition(": ")
        first, *reasons = accepted.reasons or [""]
        if first:
            text = f"{text} {first}"
        elif accepted.bound is not None:
            share = percent(accepted.requirement.confidence)
            U = f"expanded uncertainty of the position that the reflector reaches (U, {share})"
            text = f"{U} at most {1e3 * accepted.bound:.3f} mm, {text}"
        if any(beyond_geometry(result).values()):
            text += " It holds for the whole model, as `compensate` uses it; files with geometry alone have another U."
        yield "verdict", {"kind": accepted.verdict, "word": word, "text": text}
    elif result.verdict.delivered:
        kind, sentence = summary.conclusion(result, content.map)
        word, _, text = sentence.partition(": ")
        yield "verdict", {"kind": kind, "word": word, "text": text}
    yield "lead", {"text": summary.headline(result, content.errors), "alarm": not result.verdict.delivered}
    yield "notes", [*filter(None, [result.verdict.caution]), *reasons, *result.verdict.beside(result.causes)]
    name, nominal, identified = content.errors
    before, after = statistics(nominal), statistics(identified)
    if not after["count"]:
        raise InputError(f"the {name} data", "no measurement of a length", "positions, poses, distances, ...")
    cards = [
        ("Mean error, nominal", "before", mm(before["mean_mm"]), _mean_interval(nominal)),
        ("Mean error, identified", "after", mm(after["mean_mm"]), _mean_interval(identified)),
        ("Maximum error, identified", "after", mm(after["max_mm"]), f"of {after['count']} rows"),
    ]
    if content.map is not None:
        note = f"{percent(content.map.requirement.confidence)}, maximum over the region"
        cards.append(("Expanded uncertainty U", "after", mm(1e3 * content.map.largest), note))
    yield "cards", cards


def _mean_interval(errors: Array) -> str:
    """Return the 95 % confidence interval of the mean of errors (N,) [m], of independent rows."""
    known = 1e3 * errors[np.isfinite(errors)]
    if len(known) < 2:
        return ""
    half = stdtrit(len(known) - 1, 0.975) * known.std(ddof=1) / np.sqrt(len(known))
    return f"95 % CI {mm(max(known.mean() - half, 0.0))} to {mm(known.mean() + half)}"


def _accuracy(content: Content) -> Iterator[Block]:
    result = content.result
    record = result.record
    found = content.accepted
    if found is not None:
        yield "heading", {"": "Acceptance"}.get(content.tested, f"Acceptance test by {content.tested}")
        said = (*found.reasons, found.caution)  # at the top
        lines = [text for text in found.sentences()[1:] if text not in said]
        if found.workspace is not None:
            units = joint_columns(result.problem.robot.joint_dimensions)
            worst = zip(found.workspace.q[-1], units.items(), strict=True)
            values = [f"{value / si:.1f} {name.rpartition('_')[2]}" for value, (name, si) in worst]
            lines.append(f"The maximum U is at joints {', '.join(values)}.")
        yield "bullets", lines
    yield "heading", "Accuracy"
    used = "Parameters are identified from the identification rows alone."
    if record.held_out is not None:
        used = "Errors of held-out rows are those of a fit without them; the delivered parameters use all rows."
    notes = [summary.nominal_note(result), used]
    if found is None:  # otherwise its section says it
        held = record.held_out
        if held is None and record.validation is not None:
            held = held_out_errors(result, record.validation)
        if held is not None and held.coverage is not None:
            notes.append(f"Held-out rows: {coverage_text(held)}.")
    yield "text", notes
    head = ["data, model", *summary.COLUMNS]
    rows = [row for row in summary.error_rows(result) if row["count"]]
    yield "table", Table("Error [mm]", head, summary.cells(rows))
    angles = summary.orientation_rows(result)
    if angles:
        yield "table", Table("Orientation error [mrad]", head, summary.cells(angles, "mrad"))
    for name, data in summary.sets(result).items():
        touched = words.touch_errors(data, result.nominal_errors(data), result.errors(data))
        if touched:
            caption = f"{name.capitalize()}, distance of touches from their point [mm]"
            yield "table", Table(caption, words.HEADER, words.touch_rows(touched))
    name, data = next(iter(summary.sets(result).items()))
    yield "figures", [_error_figure(result, name, data)]
    if content.map is not None:
        yield "heading", "Expanded uncertainty in the workspace"
        yield from _uncertainty(content.map, result)


def _new_measurements(content: Content) -> Iterator[Block]:
    for name, validation in content.new.items():
        for head, rows in validation.tables():
            yield "table", Table(name, head, rows)
        yield "text", validation.sentences()
        if np.isfinite(validation.error).any():
            yield "figures", [_error_figure(content.result, "new", validation.data)]


def _error_figure(result: Calibration, name: str, data: Dataset) -> Figure:
    title = "Error of every row before and after calibration"
    return figure(partial(plot.errors, result, data), title, f"All {name} rows.")


def _uncertainty(map_: Workspace, result: Calibration) -> Iterator[Block]:
    notes = [
        "U is the radius about the predicted position that contains the position reached with the stated confidence. "
        "It includes the uncertainty of the parameters and the robot's repeatability, not the instrument's noise "
        "(GUM), nor effects that no reading varied: the instrument's scale, temperature and other loads than those "
        "measured. Each square shows the maximum of the configurations that reach it, at any depth. Axes are those of "
        "the robot's base."
    ]
    limit, box, frame = np.inf, None, ""
    if result.record.requirement is None:
        notes.insert(0, f"{map_.summary}; region: {map_.requirement.where}.")
    else:
        limit = 1e3 * map_.requirement.limit
    if map_.region.box is not None:
        box, frame = 1e3 * map_.region.box, " The frame is the box of the requirement."
    yield "text", [*notes, *session_notes(result)]
    at = 1e3 * in_base(map_.region.problem, map_.q, map_.region.marker)
    drawn = []
    for view, (across, up) in plot.VIEWS.items():
        wide, tall = np.ptp(at[:, across]), np.ptp(at[:, up])
        height = min(330.0 * tall / max(wide, 1e-9), 400.0) + 80
        draw = partial(plot.uncertainty_map, at, 1e3 * map_.expanded, box, limit, view)
        title = f"Largest expanded uncertainty of the position reached, {view}"
        drawn.append(figure(draw, title, f"{view.capitalize()}.{frame}", height))
    yield "figures", drawn
    units = joint_columns(map_.region.problem.robot.joint_dimensions)
    known = zip(units.items(), map_.region.limits, strict=True)
    ranges = [[*name.split("_"), *(f"{end / si:.2f}" for end in ends)] for (name, si), ends in known]
    joints = Table("Joint ranges of the region", ["joint", "unit", "from", "to"], ranges)
    variances = position_budget(result, map_.q, map_.region.marker)
    whole = np.sum(list(variances.values()), axis=0)
    rows = []
    for name, each in {**variances, "combined": whole}.items():
        cells = [name]
        for own, total in ((each[-1], whole[-1]), (each[:-1].mean(), whole[:-1].mean())):
            cells += [f"{1e3 * np.sqrt(max(own, 0.0)):.4f}", f"{100 * max(own, 0.0) / total:.1f} %"]
        rows.append(cells)
    head = ["contributor", "u [mm], maximum U", "share of u²", "u [mm], region (RMS)", "share of u²"]
    factor = map_.largest / np.sqrt(whole[-1])
    title = f"Uncertainty budget of the position reached (GUM; u over all three axes, U is {factor:.2f} u)"
    yield "beside", [("table", Table(title, head, rows)), ("table", joints)]


def _parameters(content: Content) -> Iterator[Block]:
    result = content.result
    free = result.problem.parameters.free
    half, factor = np.full(len(result.x), np.nan), 0.0
    note = result.no_intervals
    head = ["parameter", "nominal", "identified", "deviation", "U", "tolerance"]
    with contextlib.suppress(InputError):
        uncertainty = Uncertainty(result)
        half, factor = uncertainty.expanded, uncertainty.coverage_factor
        k = f"k = {factor:.2f}"
        head[4] = f"U ({k})"
        t = f"Student's t with {result.noise_dof:.0f} effective degrees of freedom"
        note = f"U = k u is the expanded uncertainty ({k}, 95 %, {t}), from measurement noise and prior."
    tolerance = plot.active_tolerance(result)
    at_bound = {each.name for each in result.active_bounds}
    columns = len(head) - (not np.isfinite(tolerance).any())
    rows = []
    own = free.take(np.flatnonzero(~free.of_curves))
    bounds = own.rows({"U": half[~free.of_curves], "tolerance": tolerance[~free.of_curves]})
    for (name, unit, *figures, _), bound in zip(words.columns(result)[1], bounds, strict=True):
        edge = ", at its bound" * (bound["parameter"] in at_bound)
        expanded = "" if bound["U"] is None else f"±{bound['U']:.{words.decimals(bound['U'] / 2)}f}"
        allowed = "" if bound["tolerance"] is None else f"±{bound['tolerance']:.4g}"
        rows.append([f"{name} [{printed(unit)}]{edge}", *figures, expanded, allowed][:columns])
    yield "text", words.weight_lines(result)
    files = "Exported files hold the geometry of a separate fit without model extensions, with other values than these."
    separate = [files] * any(beyond_geometry(result).values())
    tool = f"tool_x ... tool_rz: pose of the reflector in {FLANGE}."
    tools = [tool] * any(own_name(name).startswith("tool_") for name in free.names)
    yield "text", [note, *tools, *words.turned_frames(result), *separate]
    count = Counter(np.array(own.dimensions)[~own.of_frames].tolist())
    drawn = []
    for dimension in ("length", "angle"):
        if count[dimension]:
            draw = partial(plot.parameters, result, dimension)
            title, caption = f"Deviations of the {dimension} parameters", f"The robot's {dimension} parameters."
            drawn.append(figure(draw, title, caption, 80.0 + 17 * count[dimension]))
    yield "beside", [("table", Table("Identified parameters", head[:columns], rows)), ("figures", drawn)]
    known = []
    for text in result.record.known:
        of, values, _ = Prior.known(text).statements[0].on(result.problem.parameters)
        known += [[text, f"{off:+.2f}"] for off in of @ result.z - values]
    if known:
        compared = ["stated", "identified minus stated, in stated standard deviations"]
        yield "table", Table("Known values", compared, known)
    curves = transmission_errors(result)
    if not curves:
        return
    yield "heading", "Transmission errors of the joints"
    yield "text", ["Actual joint angle: the controller's plus this error, which is unknown outside the measured range."]
    yield "table", Table("Within the measured range", *words.curve_columns(result))
    largest = max(float(np.max(np.abs(each.error) + factor * np.nan_to_num(each.standard))) for each in curves)
    drawn = []
    for each in curves:
        draw = partial(plot.transmission_error, each, factor, largest)
        sizes = f"{1e3 * each.rms:.3f} mrad RMS, {mm(1e3 * each.effect)} mm RMS at the tool"
        caption = f"{str(each).capitalize()}: {sizes}."
        drawn.append(figure(draw, f"Transmission error of {each}", caption, 200.0))
    yield "figures", drawn


def _diagnostics(content: Content) -> Iterator[Block]:
    result = content.result
    yield "heading", "Residuals"
    yield "text", [words.noise_sentence(result), *words.underdetermined(result), *content.composition]
    signed = []
    what = ""
    if len(summary.sets(result)) > 1:
        yield "figures", [_error_figure(result, "identification", result.problem.data)]
    for name, data in summary.sets(result).items():
        what, vectors = summary.signed_errors(result, data)
        for i, axis in enumerate("xyz" * (len(vectors["after"]) > 0)):
            means = [f"{v[:, i].mean():+z.3f} ± {v[:, i].std():.3f}" for v in vectors.values()]
            signed.append([f"{name}, {axis}", *means])
    if signed:
        yield "table", Table(f"{what}, mean ± standard deviation [mm]", ["data, axis", "nominal", "identified"], signed)
    yield "heading", "Identifiability"
    yield from _identifiability(result)
    yield "heading", "Flagged and excluded rows"
    status = "flagged, not excluded"
    flagged = result.flagged
    rows = [[f.label, f"{f.sigmas:.1f}", in_unit(f.error, f.dimension), status] for f in flagged[:MOST_FLAGGED]]
    if len(flagged) > MOST_FLAGGED:
        rows.append([f"and {len(flagged) - MOST_FLAGGED} more", "", "", f"{status}; result.json names them"])
    rows += [[label, "", "", f"excluded: {reason}"] for label, reason in result.record.excluded.items()]
    for row in result.left_out:
        if row.label not in result.record.excluded:
            error = in_unit(row.error, row.dimension)
            rows.append([row.label, "", error, f"excluded outlier, {row.ratio:.0f} times the median error"])
    if rows:
        yield "table", Table("Largest first", ["row", "standardized residual", "error", "status"], rows, prose=True)
    else:
        yield "text", ["No row is flagged or excluded (by chance, one in a hundred good data sets has a flagged row)."]
    yield "heading", "Convergence"
    c = result.certificate
    at_solution = f"next step of the convex program {c.step:.2g}, constraint violation {c.violation:.2g}"
    yield "text", [result.message, f"Certificate at the solution: {at_solution} (in prior standard deviations)."]


def _identifiability(result: Calibration) -> Iterator[Block]:
    parameters = result.problem.parameters
    observability = observe(result.problem.identifying(parameters.identified & ~parameters.of_curves))
    redundant = observability.redundant
    lines = [f"{observability.configurations} configurations. {summary.identifiability(result)}"]
    if result.record.earlier:
        lines.append("The other parameters are known from the earlier calibrations that serve as prior.")
        redundant = ()
    elif redundant:
        lines.append(
            "Redundant combinations [mm, mrad], which change no measurement at the nominal parameters; the "
            "penalty determines them. Predictions of another point on the flange or of its orientation may depend on "
            "them."
        )
    yield "text", lines
    yield "bullets", list(map(combination, redundant))
    yield "text", str(replace(observability, redundant=())).splitlines()[1:]


def _provenance(content: Content) -> Iterator[Block]:
    result = content.result
    record = result.record
    robots = []
    for name, robot in result.problem.arms.items():
        named = filter(None, [name, robot.name])
        robots.append(" - ".join(filter(None, [": ".join(named), f"{robot.dof} joints", robot.source])))
    facts = {
        "Source": record.source or "not stated" * (not record.details),
        "Measurements": "simulated" * record.simulated,
        "Robot": "; ".join(robots),
        "Formulation": f"{result.formulation.name}: {_formulation(result)}",
        "Made": record.made,
        "Digest of the result": record.digest,
        "Versions": ", ".join(f"{name} {version}" for name, version in record.versions.items()),
    }
    yield "facts", [(name, text) for name, text in facts.items() if text]
    blocks: dict[str, list[Rows]] = {}
    for name, data in summary.sets(result).items():
        for block in data.blocks:
            what = " ".join(filter(None, [block.measurement.name, *block.markers, block.fixture]))
            blocks.setdefault(f"{name}, {what}", []).append(block)
    rows = []
    for what, of in blocks.items():
        sigmas = np.concatenate([np.sqrt(np.einsum("nii->ni", block.covariance)) for block in of])
        components: dict[str, list[str]] = {}  # by value, as a range if rows differ
        for (name, dimension), each in zip(of[0].measurement.components.items(), sigmas.T, strict=True):
            unit, si = {"length": ("mm", 1e-3), "angle": ("mrad", 1e-3)}.get(dimension, ("", 1.0))
            low, high = each.min() / si, each.max() / si
            value = f"{low:.3g}" if high < 1.005 * low else f"{low:.3g} to {high:.3g}"
            components.setdefault(f"{value} {unit}".strip(), []).append(name)
        stated = "; ".join(f"{value} ({', '.join(names)})" for value, names in components.items())
        rows.append([what, str(sum(len(block.row) for block in of)), stated])
    head = ["data", "rows", "standard uncertainty"]
    yield "table", Table("Measurements and their stated standard uncertainties", head, rows, prose=True)
    if record.files:
        yield "table", Table("Input files", ["file", "SHA-256"], list(record.files.items()), prose=True)
    if record.earlier:
        earlier = []
        for each in record.earlier:
            changes = each.changed
            if each.prior_inflation != 1:
                changes += f"; standard deviations times {each.prior_inflation:g}"
            earlier.append([each.title, each.made, str(each.rows), changes, each.digest])
        head = ["calibration", "made", "rows", "changed since", "digest"]
        yield "table", Table("Earlier calibrations used as prior", head, earlier, prose=True)
    yield "text", ["All figures on this page were computed from the calibration's measurements and parameters."]
    yield "facts", [(who, f"{'_' * 30} date {'_' * 12}") for who in ("Calibrated by", "Approved by")]


def _formulation(result: Calibration) -> str:
    """Return what is minimized, in the terms of the result's file."""

    def term(part: Any) -> str:
        if isinstance(part, list) and part[0] == prior_penalty.__name__:
            return f"{part[1] or 'none'}, with the stated prior"
        if isinstance(part, list):
            return f"{part[0]}({', '.join(map(str, part[1:]))})"
        return part or "a function of a script, not stored in the file"

    parts = definition(result.formulation)
    over = f" over {term(parts['penalty_over'])}" * (parts["penalty_over"] != "none")
    text = f"loss {term(parts['loss'])} of each {parts['loss_over']}, penalty {term(parts['penalty'])}{over}"
    return f"{text}, constraints: {', '.join(map(term, parts['constraints'])) or 'none'}"


def _regularization(content: Content) -> Iterator[Block]:
    """Yield the L-curve, and the choice of every rule."""
    result = content.result
    formulation = result.formulation
    # with an earlier result as prior, weight 1 combines two sets of data: no other weight has a meaning
    has_path = formulation.penalty is not None and formulation.solvable and not result.record.earlier
    if not has_path or not result.weight > 0:
        return
    by_user = Selection(result.weight, "given", np.array([]), np.array([]), True)
    chosen = {**select.compare(result.program), result.selector: result.selection or by_user}
    chosen = dict(sorted(chosen.items(), key=lambda item: item[1].weight))
    title = "L-curve: residual norm against norm of the deviations"
    caption = "Each point is the solution at one weight: small ones at the upper left, large ones at the lower right."
    yield "figures", [figure(partial(plot.l_curve, result), title, caption, L_CURVE_HEIGHT)]
    rows = []
    for rule, choice in chosen.items():
        chosen_here = " (chosen)" * (rule == result.selector)
        rows.append([rule + chosen_here, f"{choice.weight:.3g}", choice.note or WHY.get(rule, "given")])
    title = "Weights chosen by the selection rules from the identification data alone"
    yield "table", Table(title, ["selector", "weight", "criterion"], rows, prose=True)


SECTIONS = (
    ("Accuracy and uncertainty", _accuracy),
    ("Validation on new measurements", _new_measurements),
    ("Parameters", _parameters),
    ("Diagnostics", _diagnostics),
    ("Provenance", _provenance),
    ("Appendix: regularization", _regularization),
)
