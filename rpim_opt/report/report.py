"""The calibration report: what each section of its page contains, in the order in which it is signed."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array, statistics
from rpim_opt.basics.exceptions import InputError, NoSolutionFound, RpimError
from rpim_opt.basics.files import write_text
from rpim_opt.basics.text import percent
from rpim_opt.basics.units import display, joint_columns
from rpim_opt.calibration.acceptance import Acceptance
from rpim_opt.calibration.held_out_rows import judged as predicted
from rpim_opt.calibration.lack_of_fit import judged
from rpim_opt.calibration.remarks import HEADER, scatter, scatter_rows
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import Uncertainty
from rpim_opt.calibration.words import turned_frames, weight_lines
from rpim_opt.convex.atoms import SQUARES
from rpim_opt.convex.program import Estimate, Program, pose
from rpim_opt.convex.rules.selection import Selection, weight_grid
from rpim_opt.convex.select import compare
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.data.record import Earlier
from rpim_opt.problem.observability import combination, observe
from rpim_opt.problem.workspace import in_base
from rpim_opt.report import charts, summary
from rpim_opt.report.chart import Picture, tag
from rpim_opt.report.charts import mm
from rpim_opt.report.page import Figure, Table, figure, render
from rpim_opt.robot.mdh import Robot
from rpim_opt.store.result_file import definition
from rpim_opt.store.statements import FIELDS

Section = dict[str, Any]


def write_report(calibration: Calibration, path: str | Path, validation: Dataset | None = None) -> None:
    """Write a calibration report: one HTML file that needs no network.

    In the order in which somebody signs it: verdict and headline; accuracy, with expanded uncertainty over the
    workspace; identified parameters with their expanded uncertainties; diagnostics (residuals, identifiability,
    flagged rows, convergence); provenance; and in an appendix the evidence for the regularization weight. Every text
    of a user's file is shown as text.

    Parameters
    ----------
    calibration
        As `calibrate` or `load_result` return it.
    path
        The file; whole or not written at all.
    validation
        Measurements that were not used for identification; those of the calibration's record by default.

    Raises
    ------
    InputError
        For validation data that do not belong to the problem, or measurements without a length.

    Examples
    --------
    >>> from pathlib import Path
    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> result = ro.calibrate(instance.problem, ro.tikhonov, weight=ro.l_curve)
    >>> ro.report.write_report(result, "report.html", instance.validation)
    >>> "0.032" in Path("report.html").read_text(encoding="utf-8")
    True
    """
    record = calibration.record.dated()
    record = record if validation is None else replace(record, validation=validation)
    write_text(Path(path), page(replace(calibration, record=record)))


def page(result: Calibration) -> str:
    """Return the report as HTML."""
    data: dict[str, Any] = {}
    record = result.record
    heading = record.title or " and ".join(robot.name for robot in result.problem.arms.values())
    accepted = summary.acceptance(result)
    map_ = summary.workspace(result)
    lacking = judged(result)
    # an effect that the model lacks is said at the top; otherwise what the residuals consist of is a diagnosis
    alarming = lacking is not None and lacking.alarming
    composition = [] if lacking is None else lacking.sentences()
    return render(
        "report.html",
        script="report.js",
        title=f"Calibration: {heading}",
        kind=f"Robot calibration report, {record.made[:10]}",
        heading=heading,
        details=[(FIELDS.get(key, key), text) for key, text in record.details.items()],
        verdict=_verdict(accepted),
        headline=summary.headline(result),
        alarm=not result.verdict.delivered,
        causes=list(dict.fromkeys([*result.verdict.reasons, *result.causes])),
        cards=_cards(result, map_, accepted),
        warnings=[*([" ".join(composition)] if alarming else []), *summary.warnings(result)],
        acceptance=_acceptance(result, accepted),
        accuracy=_accuracy(result, accepted),
        uncertainty=_uncertainty(map_, result),
        parameters=_parameters(result),
        residuals=_residuals(result, [] if alarming else composition),
        space=_space(result, data),
        identifiability=_identifiability(result),
        flagged=_flagged(result),
        convergence=_convergence(result),
        provenance=_provenance(result),
        weight=_weight(result, data),
        data=data,
    )


# --- verdict and headline ----------------------------------------------------------------------------------

VERDICTS = {"accepted": "Accepted", "rejected": "Rejected", "undecided": "Inconclusive"}


def _verdict(found: Acceptance | None) -> Section | None:
    if found is None:
        return None
    text = f"limit {1e3 * found.requirement.limit:g} mm"
    if found.bound is not None and np.isfinite(found.bound):
        text = f"expanded uncertainty of the position reached U = {1e3 * found.bound:.3f} mm at most, {text}"
    text += f", with {percent(found.requirement.confidence)} at every configuration of the region."
    return {"kind": found.verdict, "word": VERDICTS[found.verdict], "text": text}


def _cards(
    result: Calibration, map_: summary.Workspace | None, accepted: Acceptance | None
) -> list[tuple[str, str, str]]:
    """Return name, role and value [mm] of the headline's figures."""
    name, nominal, identified = summary.headline_errors(result)
    before, after = statistics(nominal), statistics(identified)
    if not after["count"]:
        raise InputError(f"the {name} data", "no measurement of a length", "positions, poses, distances, ...")
    cards = [
        ("Mean error, nominal", "before", mm(before["mean_mm"])),
        ("Mean error, identified", "after", mm(after["mean_mm"])),
        ("Maximum error, identified", "after", mm(after["max_mm"])),
    ]
    if map_ is None:
        return cards
    largest = map_.expanded.max()
    if accepted is not None and accepted.bound is not None:
        largest = accepted.bound  # its search goes on between the configurations of the map
    sure = percent(map_.requirement.confidence)
    return [*cards, (f"Expanded uncertainty U ({sure}), maximum", "after", mm(1e3 * largest))]


# --- accuracy and uncertainty ------------------------------------------------------------------------------


def _acceptance(result: Calibration, found: Acceptance | None) -> Section | None:
    if found is None:
        return None
    requirement = found.requirement
    facts = [
        ("Limit", f"{1e3 * requirement.limit:g} mm, with {percent(requirement.confidence)}"),
        ("Region", requirement.where),
    ]
    if found.bound is not None and found.typical is not None and np.isfinite(found.bound):
        units = joint_columns(result.problem.robot.joint_dimensions)
        worst = ""
        if found.worst is not None:
            values = [f"{value / si:.1f}" for value, si in zip(found.worst, units.values(), strict=True)]
            worst = f", at joints {', '.join(values)} {' and '.join(sorted({n.rpartition('_')[2] for n in units}))}"
        facts += [
            ("Maximum U", f"{1e3 * found.bound:.3f} mm{worst}"),
            ("Median U", f"{1e3 * found.typical:.3f} mm, of {found.count} configurations"),
        ]
    if found.scatter is not None:
        facts.append(("Repeatability", f"{1e3 * found.scatter:.3f} mm of the maximum U, with all parameters known"))
    if found.checked is not None:
        facts.append(("Validation", found.checked.sentence()))
    return {"facts": facts, "reasons": found.reasons}


def _accuracy(result: Calibration, accepted: Acceptance | None) -> Section:
    record = result.record
    notes = [summary.nominal_note(result)]
    used = "Identification rows were used to identify the parameters"
    if record.validation is not None:
        used += "; validation rows were not used for anything"
    notes.append(f"{used}.")
    if record.held_out is not None:
        notes.append("Rows held out were not, when they were judged; they are among the identification rows now.")
    covered = None
    if record.held_out is not None:
        covered = record.held_out.coverage
    elif record.validation is not None:
        covered = predicted(result, record.validation).coverage
    if covered is not None and accepted is None:  # whose section says it
        notes.append(
            f"{percent(round(covered, 2))} of the held-out coordinates lie in their 95 % prediction intervals."
        )
    head = ["data, model", *summary.COLUMNS]
    rows = [row for row in summary.error_rows(result) if row["count"]]
    tables = [Table("Error [mm]", head, summary.cells(rows))]
    angles = summary.orientation_rows(result)
    if angles:
        tables.append(Table("Orientation error [mrad]", head, summary.cells(angles, "mrad")))
    for name, data in summary.sets(result).items():
        touched = scatter(data, result.nominal_errors(data), result.errors(data))
        if touched:
            caption = f"{name.capitalize()}, distance of touches from their point [mm]"
            tables.append(Table(caption, HEADER, scatter_rows(touched)))
    name, data = next(iter(summary.sets(result).items()))
    return {"notes": notes, "tables": tables, "figures": _error_figures(result, name, data)}


def _error_figures(result: Calibration, name: str, data: Dataset) -> list[Figure]:
    lengths, _ = charts.lengths_of(result, data)
    return [
        figure(charts.rows_chart(result, data), f"Every {name} row."),
        figure(charts.histogram_chart(lengths), f"Distribution of the {name} errors."),
    ]


def _uncertainty(map_: summary.Workspace | None, result: Calibration) -> Section | None:
    """Return the map of the expanded uncertainty over the workspace."""
    if map_ is None:
        return None
    notes = [
        map_.sentence(),
        "U is the radius about the predicted position that contains the position reached, from the uncertainty of the "
        "parameters and the robot's repeatability, without the instrument's noise (GUM). Each square shows the maximum "
        "of the configurations that reach it, at any depth. Axes of the robot's base.",
    ]
    limit = None
    box = None
    if result.record.requirement is not None:
        limit = 1e3 * map_.requirement.limit
        notes.append("The search for the maximum goes on between these configurations, and may end above the map's.")
    if map_.region.box is not None:
        box = 1e3 * map_.region.box
    at = 1e3 * in_base(map_.region.machine, map_.q, map_.region.marker)
    maps = charts.workspace_charts(at, 1e3 * map_.expanded, box, limit)
    return {"notes": notes, "figures": [figure(each) for each in maps]}


# --- parameters --------------------------------------------------------------------------------------------


def _parameters(result: Calibration) -> Section:
    free = result.problem.parameters.free
    half = np.full(len(result.x), np.nan)
    note = "No intervals: the formulation has no covariance."
    head = ["parameter", "nominal", "identified", "deviation", "U", "tolerance"]
    with contextlib.suppress(InputError):
        uncertainty = Uncertainty(result)
        half = uncertainty.coverage_factor * np.sqrt(np.diag(uncertainty.total))
        k = f"k = {uncertainty.coverage_factor:.2f}"
        head[4] = f"U ({k})"
        note = f"U = k u: expanded uncertainty ({k}, 95 %) from measurement noise and prior."
    tolerance = charts.active_tolerance(result)
    held = {each.name for each in result.held}
    rows = []
    for i, row in enumerate(result.parameter_rows()):
        _, si = display(free.dimensions[i])
        name = f"{row['name']} [{row['unit']}]"
        if row["name"] in held:
            name += ", at its bound"
        spread = f"±{half[i] / si:.4f}" if np.isfinite(half[i]) else ""
        bound = f"±{tolerance[i] / si:.4g}" if np.isfinite(tolerance[i]) else ""
        figures = [f"{row['nominal']:z.4f}", f"{row['identified']:z.4f}", f"{row['deviation']:+z.4f}"]
        rows.append([name, *figures, spread, bound])
    if not np.isfinite(tolerance).any():
        head = head[:-1]
        rows = [row[:-1] for row in rows]
    own = np.array(free.dimensions)[~free.of_frames]
    return {
        "estimated": weight_lines(result),
        "notes": [note, *turned_frames(result)],
        "table": Table("Identified parameters", head, rows),
        "figures": [
            figure(charts.deviations_chart(result, dimension, half), f"The robot's own {dimension} parameters.")
            for dimension in ("length", "angle")
            if dimension in own
        ],
    }


# --- diagnostics -------------------------------------------------------------------------------------------

MOST_POINTS = 2000
"""Points drawn in space."""
VIEWS = (("30,20", "oblique"), ("0,90", "from above"), ("0,0", "along y"), ("90,0", "along x"))
"""Azimuth and elevation [deg], and their names."""
MOST_FLAGGED = 200
"""Flagged rows that are named, the worst first."""


def _residuals(result: Calibration, composition: list[str]) -> Section:
    """Return residuals against noise, what they consist of, and errors along the axes."""
    figures = []
    rows = []
    what = ""
    if len(summary.sets(result)) > 1:
        figures += _error_figures(result, "identification", result.problem.data)
    for name, data in summary.sets(result).items():
        frame, what, vectors = charts.signed_errors(result, data)
        if not len(vectors["after"]):
            continue
        caption = f"{name.capitalize()}: mean (dot) and central 95 % of the rows along the axes of {frame}."
        figures.append(figure(charts.axes_chart(result, data), caption))
        for i, axis in enumerate("xyz"):
            means = [f"{v[:, i].mean():+z.3f} ± {v[:, i].std():.3f}" for v in vectors.values()]
            rows.append([f"{name}, {axis}", *means])
    caption = f"{what.capitalize()}, mean ± standard deviation [mm]"
    table = Table(caption, ["data, axis", "nominal", "identified"], rows)
    return {"notes": [*result.noise_sentence(), *composition], "figures": figures, "table": table if rows else None}


def _space(result: Calibration, embedded: dict[str, Any]) -> Section | None:
    """Return the view of measured positions with their errors; what the page's script draws goes into ``embedded``."""
    points, before, after = [], [], []
    labels: list[str] = []
    for name, data in summary.sets(result).items():
        vectors = result.error_vectors(data, nominal=True)
        finite = np.isfinite(vectors).all(axis=1)
        points.append(result.measured_positions(data)[finite])
        before.append(vectors[finite])
        after.append(result.error_vectors(data)[finite])
        labels += [f"{data.label[i]} ({name})" for i in np.flatnonzero(finite)]
    P = np.vstack(points)
    if not len(P):
        return None
    drawn = np.linspace(0, len(P) - 1, min(len(P), MOST_POINTS)).astype(int)
    embedded["space"] = {
        "points": P[drawn].round(6).tolist(),
        "labels": [labels[i] for i in drawn],
        "before": _lines(P[drawn], np.vstack(before)[drawn]),
        "after": _lines(P[drawn], np.vstack(after)[drawn]),
    }
    ends = zip("xyz", P.min(axis=0), P.max(axis=0), strict=True)
    span = ", ".join(f"{axis} {low:z.2f} to {high:z.2f} m" for axis, low, high in ends)
    what = "measured positions in the instrument's frame"
    if result.problem.sample().touches is not None:
        what = "touches"
    text = f"{len(P)} {what} with their error vectors, {span}. Turn with the mouse, a finger or the arrow keys."
    if len(drawn) < len(P):
        text += f" {len(drawn)} of them are drawn."
    label = f"Measured positions in space with their error vectors: {len(P)} points, {span}. Arrow keys turn the view."
    return {"text": text, "label": label, "views": VIEWS}


def _lines(points: Array, vectors: Array) -> Section:
    """Return errors [m] as enlarged lines [m]; those far beyond the others are cut so that these can be seen."""
    length = np.linalg.norm(vectors, axis=1)
    longest = 3 * float(np.percentile(length, 90))
    cut = vectors * np.minimum(1.0, longest / np.maximum(length, 1e-12))[:, None]
    times = charts.magnification(points, cut)
    beyond = int(np.count_nonzero(length > longest))
    note = f"enlarged {times:,.0f} times"
    if beyond:
        note += f", {beyond} beyond {mm(1e3 * longest)} mm cut"
    return {"lines": (times * cut).round(5).tolist(), "errors": (1e3 * length).round(6).tolist(), "note": note}


def _identifiability(result: Calibration) -> Section:
    found = observe(result.problem)
    text = f"{found.configurations} configurations. {summary.identifiability(result)}"
    redundant = [f"{combination(each)}" for each in found.redundant]
    if result.record.earlier:
        text += " The others are known from the calibrations that are this one's prior."
        redundant = []
    elif found.rank < len(found.names):
        if found.unseen:
            text += f" No measurement depends on {', '.join(found.unseen)}."
        text += (
            " At the nominal parameters no measurement changes along the following combinations [mm, mrad]: the "
            "penalty decides there, and predictions do not depend on it."
        )
    indices = ", ".join(f"{name} {value:.3g}" for name, value in found.indices.items())
    condition = f"Condition number {found.condition:.3g}; observability indices (Sun and Hollerbach 2008): {indices}."
    return {"text": text, "redundant": redundant, "indices": condition}


def _flagged(result: Calibration) -> Section:
    flagged = result.flagged
    kept = "flagged, in the data"
    rows = [[flag.label, f"{flag.sigmas:.1f}", mm(flag.error_mm), kept] for flag in flagged[:MOST_FLAGGED]]
    if len(flagged) > MOST_FLAGGED:
        rows.append([f"and {len(flagged) - MOST_FLAGGED} more", "", "", f"{kept}; result.json names them"])
    rows += [[label, "", "", f"excluded: {reason}"] for label, reason in result.record.excluded.items()]
    head = ["row", "standardized residual", "error [mm]", "status"]
    table = Table("Flagged and excluded rows", head, rows, prose=True) if rows else None
    return {"table": table, "text": "No row is flagged (one good data set in a hundred has one), and none is excluded."}


def _convergence(result: Calibration) -> Section:
    rows = [
        [str(k), f"{it.objective:.8g}", f"{it.step:.2e}", f"{it.weight:.4g}"]
        for k, it in enumerate(result.history, start=1)
    ]
    try:
        c = result.certificate
        parts = [f"next step of the convex program {c.step:.1e}", f"constraint violation {c.violation:.1e}"]
        if c.gradient is not None:
            parts.insert(0, f"gradient of the nonlinear problem {c.gradient:.1e} of that at nominal")
        text = f"Certificate, computed anew at the solution: {', '.join(parts)} (in prior scales)."
    except RpimError as error:
        text = f"No certificate. {error}"
    head = ["iteration", "objective", "step [prior scales]", "weight"]
    return {"text": f"{result.message} {text}", "table": Table("Iterations", head, rows)}


# --- provenance --------------------------------------------------------------------------------------------


def _provenance(result: Calibration) -> Section:
    record = result.record
    facts = [
        ("Source", record.source or "not stated"),
        ("Measurements", "simulated" if record.simulated else "as the source says; not marked as simulated"),
        ("Robot", "; ".join(_robot(name, robot) for name, robot in result.problem.arms.items())),
        ("Formulation", f"{result.formulation.name}: {_formulation(result)}"),
        ("Made", record.made),
        ("Versions", ", ".join(f"{name} {version}" for name, version in record.versions.items())),
    ]
    count: Counter[tuple[str, str]] = Counter()
    for name, data in summary.sets(result).items():
        for block in data.blocks:
            what = " ".join(filter(None, [block.measurement.name, *block.markers, block.fixture]))
            count[f"{name}, {what}", _noise(block)] += len(block.row)
    rows = [[what, str(number), noise] for (what, noise), number in count.items()]
    head = ["data", "rows", "standard uncertainty"]
    tables = [Table("Measurements and their stated standard uncertainties", head, rows, prose=True)]
    if record.files:
        files = [[name, digest] for name, digest in record.files.items()]
        tables.append(Table("Input files", ["file", "SHA-256"], files, prose=True))
    if record.earlier:
        earlier = [[each.title, each.made, str(each.rows), _changes(each), each.digest] for each in record.earlier]
        head = ["calibration", "made", "rows", "changed since", "digest"]
        tables.append(Table("Earlier calibrations that are the prior", head, earlier, prose=True))
    return {"facts": facts, "tables": tables}


def _changes(each: Earlier) -> str:
    changes = ", ".join(each.let_go) or "nothing that readings show"
    if each.inflate != 1:
        changes += f"; standard deviations times {each.inflate:g}"
    return changes


def _robot(name: str, robot: Robot) -> str:
    named = f"{name}: {robot.name}" if name else robot.name
    return " - ".join(filter(None, [named, f"{robot.dof} joints", robot.source]))


def _formulation(result: Calibration) -> str:
    """Return what is minimized, in the terms of the result's file."""

    def term(part: Any) -> str:
        if isinstance(part, list):
            return f"{part[0]}({', '.join(map(str, part[1:]))})"
        return part or "a function of a script, not in the file"

    parts = definition(result.formulation)
    over = "" if parts["penalty_over"] == "none" else f" over {term(parts['penalty_over'])}"
    text = f"loss {term(parts['loss'])} of each {parts['loss_over']}, penalty {term(parts['penalty'])}{over}"
    bounds = [term(c) for c in parts["constraints"]]
    if parts["largest"] is not None:
        bounds.append(f"standardized residual of every configuration at most {parts['largest']:g}")
    return f"{text}, constraints: {', '.join(bounds) or 'none'}"


def _noise(block: Block) -> str:
    """Return the stated standard deviations by component, as a range where rows differ."""
    spread = np.sqrt(np.einsum("nii->ni", block.covariance))
    components: dict[str, list[str]] = {}
    for i, (name, dimension) in enumerate(block.measurement.components.items()):
        unit, si = {"length": ("mm", 1e-3), "angle": ("mrad", 1e-3)}.get(dimension, ("", 1.0))
        low = spread[:, i].min() / si
        high = spread[:, i].max() / si
        value = f"{low:.3g}" if high < 1.005 * low else f"{low:.3g} to {high:.3g}"
        components.setdefault(f"{value} {unit}".strip(), []).append(name)
    return "; ".join(f"{value} ({', '.join(names)})" for value, names in components.items())


# --- appendix: the weight ----------------------------------------------------------------------------------

WHY = {"learned": "maximum of the marginal likelihood"}
"""Reasons of choices that have no note; others were given."""
MANY_EQUATIONS = 600
"""Equations beyond which a loss that is no square is drawn by its quadratic model, which has a closed form: the two
curves look the same, and a hundred robust fits of two thousand rows take minutes."""
PICARD = "Picard's condition at the solution: the penalty damps directions below the line; data near 1 are noise."


def _weight(result: Calibration, embedded: dict[str, Any]) -> Section:
    """Return the L-curve with every selector's choice; what the page's slider needs goes into ``embedded``."""
    picard = figure(charts.picard_chart(result.program, result.penalty_weight), PICARD)
    section: Section = {"figure": None, "picard": picard}
    formulation = result.formulation
    # with an earlier result as the prior, weight 1 joins two sets of data: no other weight has a meaning
    if result.record.earlier or formulation.penalty is None or not formulation.solvable or result.weight <= 0:
        return section
    program, note = _drawn_program(result)
    chosen = {result.selector: result.selection or Selection(result.weight, "given", np.array([]), np.array([]), True)}
    if not _slow(program):
        chosen = {**compare(program), **chosen}
    name, curve = _path(result, program, chosen)
    weights = np.array(curve["weight"])
    places = {
        rule: int(np.argmin(np.abs(np.log(weights / choice.weight))))
        for rule, choice in chosen.items()
        if choice.weight > 0
    }
    k = places[result.selector]
    residual, solution = np.array(curve["residual"]), np.array(curve["solution"])
    points = {rule: (residual[i], solution[i]) for rule, i in places.items()}
    picture = Picture(charts.l_curve_chart(residual, solution, points, result.selector))
    x, y = picture.x(residual), picture.y(solution)
    takers: dict[str, list[str]] = {}
    for rule, i in places.items():
        takers.setdefault(str(i), []).append("the chosen weight" if rule == "given" else rule)
    names = {place: ", ".join(rules) for place, rules in takers.items()}
    embedded["curve"] = {**curve, "of": name, "takers": names, "chosen": k, "x": x.tolist(), "y": y.tolist()}
    cursor = tag("circle", id="cursor", r=9, class_="cursor", cx=f"{x[k]:g}", cy=f"{y[k]:g}")
    rows = []
    for rule, choice in sorted(chosen.items(), key=lambda item: item[1].weight):
        mean = mm(curve["error"][places[rule]]) if rule in places else ""
        own = f"{rule} (chosen)" if rule == result.selector else rule
        rows.append([own, f"{choice.weight:.3g}", mean, choice.note or WHY.get(rule, "given")])
    caption = "Every point is the solution at one weight: small weights above left, large ones below right."
    section |= {
        "figure": figure(picture, caption + note, cursor),
        "last": len(weights) - 1,
        "chosen": k,
        "table": Table(
            "Weights that the selection rules choose from the identification data alone",
            ["selector", "weight", f"mean error, {name} [mm]", "criterion"], rows, prose=True,
        ),
    }  # fmt: skip
    return section


def _slow(program: Program) -> bool:
    """Return whether a path of such programs takes longer than anybody waits for a report."""
    return not program.quadratic and program.model.equations > MANY_EQUATIONS


def _drawn_program(result: Calibration) -> tuple[Program, str]:
    """Return the program whose path is drawn, and a sentence where it is the loss's quadratic model."""
    program = result.program
    if program.loss_form is not None or not _slow(program):
        return program, ""
    try:
        weighted = result.linear
    except InputError:  # a loss that rests on a few equations
        return program, ""
    squares = replace(result.formulation, loss=SQUARES, loss_over="equation", largest=float("inf"))
    return pose(squares, weighted), " The curve is that of its quadratic model at the chosen weight."


def _path(result: Calibration, program: Program, chosen: Mapping[str, Selection]) -> tuple[str, Section]:
    """Solve over a grid of weights and at the chosen ones; return whose mean error [mm] is given, and the curve."""
    count = 80 if program.closed_form else 30
    if _slow(program):
        count = 10
    estimates: list[Estimate] = []
    positive = [choice.weight for choice in chosen.values() if choice.weight > 0]
    for weight in np.unique([*weight_grid(program, count), *positive]):
        with contextlib.suppress(NoSolutionFound):  # far from the chosen weight a solver may fail
            estimates += program.path([weight])
    name, data = next(iter(summary.sets(result).items()))
    problem = result.problem.on(data)
    scale = result.problem.parameters.free.scale
    return name, {
        "weight": [estimate.weight for estimate in estimates],
        "residual": [float(np.sqrt(estimate.loss)) for estimate in estimates],
        "solution": [float(np.sqrt(estimate.penalty)) for estimate in estimates],
        "error": [1e3 * float(np.nanmean(problem.errors(scale * estimate.z))) for estimate in estimates],
    }
