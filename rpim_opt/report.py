"""A report that somebody else can check: one HTML page that works offline, with figures, evidence and provenance."""

from __future__ import annotations

import base64
import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.calibration import Calibration
from rpim_opt.dataset import Dataset
from rpim_opt.exceptions import InputError, NoSolutionFound, RpimError
from rpim_opt.files import write_text
from rpim_opt.markup import Element, html, table, tag
from rpim_opt.observability import combination, observe
from rpim_opt.plots import error_bins, magnification
from rpim_opt.record import definition, statistics
from rpim_opt.robot import Array
from rpim_opt.selection import Selection, compare, weight_grid
from rpim_opt.svg import Axis, Chart
from rpim_opt.uncertainty import Uncertainty
from rpim_opt.units import display

HERE = Path(__file__).resolve().parent
FEW, MANY, MOST = 30, 100, 2000
"""Rows up to which labels stand below the bars; from which errors are points; that are drawn in space at most."""


def write_report(calibration: Calibration, path: str | Path, validation: Dataset | None = None) -> None:
    """Write a report of a calibration: one HTML file that needs no network.

    For whoever has to believe the result: a summary in one sentence and three figures; then errors before and after,
    in space too, how the weight was chosen, the parameters with intervals and tolerances, what the data cannot tell
    apart, distrusted rows, convergence, and where the data come from. Every text of a user's file is shown as text.

    Parameters
    ----------
    calibration
        As `calibrate` or `load_result` return it.
    path
        The file; whole or not written at all.
    validation
        Measurements that no step of the calibration saw; those of the calibration's record by default.

    Raises
    ------
    InputError
        For validation data that do not belong to the problem, or measurements without a length.
    """
    record = calibration.record.dated()
    record = record if validation is None else replace(record, validation=validation)
    write_text(Path(path), page(replace(calibration, record=record)))


def page(result: Calibration) -> str:
    """Return the report as HTML; only its own style and script may run, and nothing can be loaded."""
    data: dict[str, Any] = {}
    title = result.record.title or result.problem.robot.name
    parts = [
        *_summary(result), *_errors(result), *_space(result, data), *_weight(result, data), *_parameters(result),
        *_identifiability(result), *_rows_apart(result), *_convergence(result), *_provenance(result),
    ]  # fmt: skip
    style, script = ((HERE / f"report.{kind}").read_text(encoding="utf-8") for kind in ("css", "js"))
    embedded = json.dumps(data, allow_nan=False).replace("<", "\\u003c")  # no text can end the script element
    policy = f"default-src 'none'; style-src {_hash(style)}; script-src {_hash(script)}"
    head = tag(
        "head",
        tag("meta", charset="utf-8"),
        tag("meta", http_equiv="Content-Security-Policy", content=policy),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", name="color-scheme", content="light dark"),
        tag("title", f"Calibration: {title}"),
        tag("style", style),
    )
    main = tag(
        "main",
        tag("header", tag("p", f"Robot calibration, {result.record.made[:10]}", class_="kind"), tag("h1", title)),
        *parts,
    )
    body = tag("body", main, tag("script", embedded, id="data", type="application/json"), tag("script", script))
    return "<!doctype html>\n" + html(tag("html", head, body, lang="en")) + "\n"


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(sha256(text.encode()).digest()).decode()}'"


# --- pieces ------------------------------------------------------------------------------------------------


def _section(name: str, *content: Element | str) -> list[Element]:
    key = name.lower().replace(" ", "-")
    return [tag("section", tag("h2", name, id=key), *content, aria_labelledby=key)]


def _table(caption: str, header: Sequence[str], rows: Sequence[Sequence[str]], prose: bool = False) -> Element:
    """Return a table that scrolls by itself where it is too wide; with ``prose`` its last column is running text."""
    grid = table(header, rows)
    grid.insert(0, tag("caption", caption))
    return tag("div", grid, class_="wide prose" if prose else "wide", tabindex="0", role="region", aria_label=caption)


def _figure(chart: Chart, caption: str, *legend: tuple[str, str]) -> Element:
    keys = [tag("span", tag("i", class_=f"key {name}"), text) for name, text in legend]
    head = [tag("div", *keys, class_="legend")] if keys else []
    return tag("figure", *head, chart.element(), tag("figcaption", caption))


def _list(lines: Sequence[str], class_: str = "") -> list[Element]:
    return [tag("ul", *(tag("li", line) for line in lines), class_=class_)] if lines else []


def _mm(value: float) -> str:
    """Return a length given in mm with the digits that matter."""
    return f"{value:.3f}" if value < 10 else f"{value:.2f}" if value < 100 else f"{value:.0f}"


def _sets(result: Calibration) -> dict[str, Dataset]:
    """Return the data by name, those that the calibration did not see first."""
    validation = result.record.validation
    return ({"validation": validation} if validation else {}) | {"identification": result.problem.data}


def _repeated(result: Calibration) -> int:
    """Return how many validation rows were measured where an identification row was too."""
    validation = result.record.validation
    known = {q.tobytes() for q in result.problem.data.q}
    return sum(q.tobytes() in known for q in validation.q) if validation else 0


def _quantity(result: Calibration) -> str:
    kinds = {block.measurement.name for data in _sets(result).values() for block in data.blocks}
    return "position error" if kinds <= {"position", "pose"} else "error"


# --- sections ----------------------------------------------------------------------------------------------


def _summary(result: Calibration) -> list[Element]:
    name, data = next(iter(_sets(result).items()))
    before, after = statistics(result.nominal_errors(data)), statistics(result.errors(data))
    n, what = after["count"], _quantity(result)
    if not n:
        raise InputError(f"the {name} data", "no measurement of a length", "positions, poses, distances, ...")
    ratio = before["mean_mm"] / max(after["mean_mm"], 1e-12)
    factor = f"{ratio:.1f}" if ratio < 10 else f"{ratio:.0f}"
    moves, times = ("falls", f", by a factor of {factor}") if ratio > 1 else ("rises", "")
    where = (
        f"On {n} measurements that the calibration did not see"
        if name == "validation"
        else f"On the {n} measurements that the calibration itself used (none were kept apart to check it)"
    )
    sentence = (
        f"{where}, the mean {what} {moves} from {_mm(before['mean_mm'])} mm to {_mm(after['mean_mm'])} mm{times}."
    )
    if not result.converged:
        sentence = f"This calibration did not converge and should not be used. {sentence}"
    figures = [
        ("mean before", before["mean_mm"], "before"),
        ("mean after", after["mean_mm"], "after"),
        ("largest after", after["max_mm"], "after"),
    ]
    cards = [
        tag("div", tag("dt", label), tag("dd", _mm(value), tag("small", " mm")), class_=kind)
        for label, value, kind in figures
    ]
    simulated = ["The measurements are simulated."] if result.record.simulated else []
    alarms = [line for line in result.remarks() if line != result.message or not result.converged]
    if name == "identification":
        alarms.append("Without validation data the errors elsewhere in the workspace are not known to be as small.")
    if repeated := _repeated(result):
        alarms.append(f"{repeated} validation rows repeat configurations of the identification: they are no check.")
    return [
        tag("p", sentence, class_="lead" if result.converged else "lead alarm"),
        tag("dl", *cards, class_="cards"),
        *_list([*simulated, *alarms], "notes"),
    ]


def _errors(result: Calibration) -> list[Element]:
    rows, angles, blocks = [], [], []
    fitted = result.problem.parameters.of_frames & result.problem.parameters.identified
    for name, data in _sets(result).items():
        sets = {"before": 1e3 * result.nominal_errors(data), "after": 1e3 * result.errors(data)}
        lengths = np.isfinite(sets["after"])
        sets = {when: errors[lengths] for when, errors in sets.items()}
        labels = [data.label[i] for i in np.flatnonzero(lengths)]
        for when, errors in sets.items():
            s, high = statistics(errors / 1e3), float(np.percentile(errors, 95))
            rows.append([f"{name}, {when}", str(s["count"]), *map(_mm, (s["mean_mm"], s["rms_mm"], high, s["max_mm"]))])
        figures = [_bars(result, name, labels, sets), _histogram(name, sets)]
        vectors = [1e3 * result.error_vectors(data, nominal=nominal) for nominal in (True, False)]
        seen = np.isfinite(vectors[0]).all(axis=1)
        if seen.any():
            figures += _axes(name, [v[seen] for v in vectors])
        blocks += [tag("h3", f"{name.capitalize()} rows"), tag("div", *figures, class_="figures")]
        for when, errors in (("before", result.nominal_errors), ("after", result.errors)):
            mrad = 1e3 * errors(data, "angle")
            if len(mrad := mrad[np.isfinite(mrad)]):
                spread = [f"{v:.3f}" for v in (mrad.mean(), np.sqrt(np.mean(mrad**2)), mrad.max())]
                angles.append([f"{name}, {when}", str(len(mrad)), *spread])
    note = "Before: the robot of the drawing"
    note += ", its base, reflectors and other frames fitted to the identification data." if fitted.any() else "."
    used = "Identification rows were used to find the parameters; validation rows were not used for anything."
    return _section(
        "Errors before and after",
        tag("p", f"{note} {used}"),
        _table("Error [mm]", ["data", "rows", "mean", "RMS", "95 % below", "largest"], rows),
        *([_table("Orientation error [mrad]", ["data", "rows", "mean", "RMS", "largest"], angles)] if angles else []),
        *blocks,
    )


BEFORE_AFTER = (("before", "before"), ("after", "after"))


def _bars(result: Calibration, name: str, labels: Sequence[str], sets: Mapping[str, Array]) -> Element:
    n, every = len(labels), np.concatenate(list(sets.values()))
    ends = max(0.5 * float(every.min()), 1e-4 * float(every.max()), 1e-7), max(float(every.max()), 1e-6)
    few = n <= FEW and max(map(len, labels)) <= 12
    x = Axis("" if few else "row", (0.5, n + 0.5), names=labels if few else ())
    chart = Chart(f"Error of every {name} row before and after", x, Axis("error [mm]", ends, log=True))
    place = np.arange(n) + (0.0 if few else 1.0)
    for (when, errors), shift in zip(sets.items(), (-0.4, 0.0), strict=True):
        if n > MANY:
            chart.cloud(place, errors, when)
        else:
            hints = [f"{label}, {when}: {_mm(e)} mm" for label, e in zip(labels, errors, strict=True)]
            chart.bars(place + shift, place + shift + 0.4, errors, when, hints)
    flagged = {flag.label for flag in result.flagged} if name == "identification" else set()
    wrong = [i for i, label in enumerate(labels) if label in flagged]
    hints = [f"{labels[i]}: distrusted" for i in wrong]
    chart.dots(place[wrong] + 0.2, 1.15 * sets["after"][wrong], "mark", hints)
    legend = [*BEFORE_AFTER, *([("mark", "distrusted")] if wrong else [])]
    return _figure(chart, "Every row, on a logarithmic scale.", *legend)


def _histogram(name: str, sets: Mapping[str, Array]) -> Element:
    edges = error_bins(*sets.values())
    counts = {when: np.histogram(np.maximum(errors, edges[0]), edges)[0] for when, errors in sets.items()}
    most = max(int(c.max()) for c in counts.values())
    x, y = Axis("error [mm]", (edges[0], edges[-1]), log=True), Axis("rows", (0, most))
    chart = Chart(f"How many {name} rows have which error, before and after", x, y)
    for when, count in counts.items():
        bins = np.flatnonzero(count)
        hints = [f"{when}: {count[k]} rows from {_mm(edges[k])} to {_mm(edges[k + 1])} mm" for k in bins]
        chart.bars(edges[bins], edges[bins + 1], count[bins], when, hints)
    return _figure(chart, "How many rows have which error.", *BEFORE_AFTER)


def _axes(name: str, vectors: Sequence[Array]) -> list[Element]:
    rms = [np.sqrt(np.mean(v**2, axis=0)) for v in vectors]
    every = np.concatenate(rms)
    y = Axis("RMS [mm]", (max(0.5 * float(every.min()), 1e-7), max(float(every.max()), 1e-6)), log=True)
    chart = Chart(f"RMS error of the {name} rows along x, y and z", Axis("", names="xyz"), y)
    for (when, _), shift, values in zip(BEFORE_AFTER, (-0.3, 0.0), rms, strict=True):
        hints = [f"{axis}, {when}: {_mm(v)} mm" for axis, v in zip("xyz", values, strict=True)]
        chart.bars(np.arange(3) + shift, np.arange(3) + shift + 0.3, values, when, hints)
    rows = []
    for i, axis in enumerate("xyz"):
        means, spreads = [v[:, i].mean() for v in vectors], [v[:, i].std() for v in vectors]
        rows.append([axis, *(f"{m:+.3f} ± {s:.3f}" for m, s in zip(means, spreads, strict=True))])
    caption = "Measured minus modelled, mean ± standard deviation [mm]"
    return [
        _figure(chart, "Along the axes of the instrument.", *BEFORE_AFTER),
        _table(caption, ["axis", "before", "after"], rows),
    ]


def _space(result: Calibration, embedded: dict[str, Any]) -> list[Element]:
    points, before, after, labels = [], [], [], []
    for name, data in _sets(result).items():
        vectors = result.error_vectors(data, nominal=True)
        seen = np.isfinite(vectors).all(axis=1)
        points.append(result.measured_positions(data)[seen])
        before.append(vectors[seen])
        after.append(result.error_vectors(data)[seen])
        labels += [f"{data.label[i]} ({name})" for i in np.flatnonzero(seen)]
    P, B, A = (np.vstack(part) for part in (points, before, after))
    if not len(P):
        return []
    drawn = np.linspace(0, len(P) - 1, min(len(P), MOST)).astype(int)
    embedded["space"] = {
        "points": P[drawn].round(6).tolist(), "labels": [labels[i] for i in drawn],
        "before": _lines(P[drawn], B[drawn]), "after": _lines(P[drawn], A[drawn]),
    }  # fmt: skip
    low, high = P.min(axis=0), P.max(axis=0)
    span = ", ".join(f"{c} {a:.2f} to {b:.2f} m" for c, a, b in zip("xyz", low, high, strict=True))
    choices = [
        tag("label", tag("input", type="radio", name="when", value=v, **({"checked": ""} if v == "after" else {})), v)
        for v in ("before", "after")
    ]
    views = [tag("button", text, type="button", data_view=v) for v, text in (
        ("30,20", "oblique"), ("0,90", "from above"), ("0,0", "along y"), ("90,0", "along x"))]  # fmt: skip
    said = f"Measured positions in space with their error vectors: {len(P)} points, {span}. Arrow keys turn the view."
    view = tag("svg", viewBox="0 0 600 420", id="space", tabindex="0", role="application", aria_label=said)
    return _section(
        "Errors in space",
        tag("p", f"{len(P)} measured positions in the instrument's frame, {span}; a line from each shows which way and "
            "how far the measurement lies off the model. Turn with the mouse, a finger or the arrow keys."
            + (f" {len(drawn)} of them are drawn." if len(drawn) < len(P) else "")),
        tag("div", *choices, *views, class_="controls"),
        view,
        tag("p", "The figure needs the page's script.", id="space-says", aria_live="polite", class_="says"),
    )  # fmt: skip


def _lines(points: Array, vectors: Array) -> dict[str, Any]:
    """Return errors [m] as lines to draw [m]: enlarged, those of blunders cut so that the others can be seen."""
    length = np.linalg.norm(vectors, axis=1)
    longest = 3 * float(np.percentile(length, 90))
    cut = vectors * np.minimum(1.0, longest / np.maximum(length, 1e-12))[:, None]
    times, beyond = magnification(points, cut), int(np.count_nonzero(length > longest))
    note = f"enlarged {times:,.0f} times" + (f", {beyond} beyond {_mm(1e3 * longest)} mm cut" if beyond else "")
    return {"lines": (times * cut).round(5).tolist(), "errors": (1e3 * length).round(6).tolist(), "note": note}


def _weight(result: Calibration, embedded: dict[str, Any]) -> list[Element]:
    program, formulation = result.program, result.formulation
    said = tag("p", result.weight_sentence())
    if formulation.penalty is None or not formulation.solvable or result.weight <= 0:
        return _section("Weight of the penalty", said)
    given = Selection(result.weight, "given", np.array([]), np.array([]), True)
    chosen = {**compare(program), result.selector: result.selection or given}
    grid = weight_grid(program, 80 if program.closed_form else 30)
    estimates, scale = [], result.problem.parameters.free.scale
    for weight in np.unique([*grid, *(s.weight for s in chosen.values() if s.weight > 0)]):
        with contextlib.suppress(NoSolutionFound):  # far from the chosen weight a solver may fail
            estimates += program.path([weight])
    every = np.array([e.weight for e in estimates])
    residual = np.sqrt([e.loss for e in estimates])
    solution = np.sqrt([e.penalty for e in estimates])
    name, data = next(iter(_sets(result).items()))
    problem = result.problem.on(data)
    error = [1e3 * float(np.nanmean(problem.errors(scale * e.z))) for e in estimates]
    x = Axis("root of the loss (residual norm) [sigmas]", (max(residual.min(), 1e-9), residual.max()), log=True)
    shown = solution > 1e-4 * float(np.median(solution))  # not where a lasso has nothing left
    y = Axis("root of the penalty [scales]", (solution[shown].min(), solution.max()), log=True)
    chart = Chart("L-curve: misfit against size of the deviations", x, y, 330)
    chart.line(residual[shown], solution[shown], "ink")
    at = {n: int(np.argmin(np.abs(np.log(every / s.weight)))) for n, s in chosen.items() if s.weight > 0}
    others = [k for n, k in at.items() if n != result.selector]
    chart.dots(residual[others], solution[others], "other", [n for n in at if n != result.selector])
    k = at[result.selector]
    chart.dots(residual[[k]], solution[[k]], "mark", [f"chosen, {result.selector}"], r=6)
    cursor = {"cx": f"{float(x(residual[k])):g}", "cy": f"{float(y(solution[k])):g}"}
    chart.add("circle", id="cursor", r=9, class_="cursor", **cursor)
    takers: dict[int, list[str]] = {}
    for rule, place in at.items():
        takers.setdefault(place, []).append("the chosen weight" if rule == "given" else rule)
    embedded["curve"] = {
        "weight": every.tolist(), "residual": residual.tolist(), "solution": solution.tolist(), "error": error,
        "of": name, "takers": {str(place): ", ".join(names) for place, names in takers.items()}, "chosen": k,
        "x": x(residual).tolist(), "y": y(solution).tolist(),
    }  # fmt: skip
    slider = tag("input", type="range", id="weight", min=0, max=len(every) - 1, value=k)
    figure = _figure(
        chart, "Each point is the solution at one weight: little penalty above left, much below right.",
        ("mark", "chosen"), ("other", "other selectors"),
    )  # fmt: skip
    rows = []
    for rule, s in sorted(chosen.items(), key=lambda item: item[1].weight):
        mark = " (chosen)" if rule == result.selector else ""
        mean = _mm(error[at[rule]]) if rule in at else ""
        rows.append([rule + mark, f"{s.weight:.3g}", mean, s.note or "given"])
    return _section(
        "Weight of the penalty",
        said,
        tag("div", figure,
            tag("div", tag("label", "Weight", slider), tag("output", id="weight-says", for_="weight"), class_="side"),
            class_="figures"),
        _table("What each selector takes, from the identification data alone",
               ["selector", "weight", f"mean error, {name} [mm]", "why"], rows, prose=True),
    )  # fmt: skip


def _parameters(result: Calibration) -> list[Element]:
    free = result.problem.parameters.free
    half, held = np.full(len(free), np.nan), {h.name for h in result.held}
    note = "No intervals: the formulation has no covariance."
    try:
        uncertainty = Uncertainty(result)
        low, high = uncertainty.intervals().T
        half = (high - low) / 2
        note = f"± is half the {uncertainty.confidence:.0%} interval, noise and prior together. "
        note += uncertainty.noise_test().verdict
    except InputError:
        pass
    rows = []
    for i, row in enumerate(result.parameter_rows()):
        _, si = display(free.dimensions[i])
        bound = f"±{free.tolerance[i] / si:.4g}" if np.isfinite(free.tolerance[i]) else ""
        spread = f"±{half[i] / si:.4f}" if np.isfinite(half[i]) else ""
        name = f"{row['name']} [{row['unit']}]" + (", at its bound" if row["name"] in held else "")
        figures = [f"{row['nominal']:.4f}", f"{row['identified']:.4f}", f"{row['deviation']:+.4f}", spread, bound]
        rows.append([name, *figures])
    head = ["parameter", "nominal", "identified", "deviation", "± (95 %)", "tolerance"]
    if not np.isfinite(free.tolerance).any():
        head, rows = head[:-1], [row[:-1] for row in rows]
    charts = [
        _deviations(result, dimension, half)
        for dimension in ("length", "angle")
        if np.any(~free.of_frames & (np.array(free.dimensions) == dimension))
    ]
    return _section(
        "Parameters", tag("p", note), tag("div", *charts, class_="figures"),
        _table("Identified parameters", head, rows),
    )  # fmt: skip


def _deviations(result: Calibration, dimension: str, half: Array) -> Element:
    free = result.problem.parameters.free
    unit, si = display(dimension)
    own = np.flatnonzero(~free.of_frames & (np.array(free.dimensions) == dimension))
    names, x = [free.names[i] for i in own], result.x[own] / si
    spread, bound = np.nan_to_num(half[own] / si, posinf=0.0), free.tolerance[own] / si
    stated = bound[np.isfinite(bound)]
    # an interval that ends far out would hide all others: it is cut at the chart's edge
    reach = 1.1 * max(
        float(np.max(np.abs(x))), float(np.median(np.abs(x) + spread)), float(stated.max(initial=0)), 1e-9
    )
    axis = Axis(f"deviation [{unit}]", (-reach, reach))
    chart = Chart(f"Deviations of the {dimension} parameters", axis, Axis("", names=names), 60 + 17 * len(own))
    chart.line([0, 0], [-0.5, len(own) - 0.5], "zero")
    for k, name in enumerate(names):
        chart.line([x[k] - spread[k], x[k] + spread[k]], [k, k], "after")
        if np.isfinite(bound[k]):
            for end in (-bound[k], bound[k]):
                chart.line([end, end], [k - 0.35, k + 0.35], "mark")
        chart.dots(x[[k]], [k], "after", [f"{name}: {x[k]:+.4f} ± {spread[k]:.4f} {unit}"])
    legend = [("after", "deviation and interval"), *([("mark", "tolerance")] if len(stated) else [])]
    return _figure(
        chart,
        f"The robot's own {dimension} parameters against the drawing; intervals beyond the edge are cut.",
        *legend,
    )


def _identifiability(result: Calibration) -> list[Element]:
    found = observe(result.problem)
    n, rank = len(found.names), found.rank
    text = f"{found.configurations} configurations, {result.program.model.equations} equations for {n} parameters, "
    text += f"of which the data determine {rank} combinations at nominal."
    if rank < n:
        text += " What follows cannot be told apart: the penalty shares it out, and predictions do not depend on it."
    told = [f"No measurement depends on {', '.join(found.unseen)}."] if found.unseen else []
    told += [f"No measurement changes along {combination(c)} [mm, mrad]." for c in found.redundant]
    indices = ", ".join(f"{name} {value:.3g}" for name, value in found.indices.items())
    beta, s, _ = result.program.model.svd
    k = np.flatnonzero(s > 0)
    weight = result.penalty_weight
    every = np.concatenate([s[k], np.abs(beta[k]), [np.sqrt(weight)] if weight > 0 else []])
    y = Axis("size [sigmas]", (max(float(every.min()), 1e-4), float(every.max())), log=True)
    chart = Chart("Singular values and what the data say along them", Axis("direction", (1, max(len(k), 2))), y)
    chart.line(k + 1.0, s[k], "ink")
    chart.dots(
        k + 1.0, np.abs(beta[k]), "after", [f"direction {i + 1}: data {abs(beta[i]):.3g}, s {s[i]:.3g}" for i in k]
    )
    legend = [("ink", "singular value s"), ("after", "data |u'b|")]
    if weight > 0:
        chart.line([1, max(len(k), 2)], [np.sqrt(weight)] * 2, "mark")
        legend.append(("mark", "root of the weight"))
    caption = (
        "At the solution: the penalty holds directions below the line; data near 1 are noise (Picard's condition)."
    )
    return _section(
        "What the data can tell",
        tag("p", text), *_list(told),
        tag("p", f"Condition number of these: {found.condition:.3g}. Observability indices: {indices}."),
        tag("div", _figure(chart, caption, *legend), class_="figures"),
    )  # fmt: skip


def _rows_apart(result: Calibration) -> list[Element]:
    rows = [[f.label, f"{f.sigmas:.1f}", _mm(f.error_mm), "distrusted, in the data"] for f in result.flagged]
    rows += [[label, "", "", f"left out: {reason}"] for label, reason in result.record.excluded.items()]
    if not rows:
        text = "No row stands out beyond what one good set of data in a hundred would show, and none was left out."
        return _section("Distrusted rows", tag("p", text))
    head = ["row", "residual [sigmas]", "error [mm]", "what became of it"]
    return _section("Distrusted rows", _table("Rows that stand out or were left out", head, rows, prose=True))


def _convergence(result: Calibration) -> list[Element]:
    rows = [
        [str(k), f"{it.objective:.8g}", f"{it.step:.2e}", f"{it.weight:.4g}"]
        for k, it in enumerate(result.history, start=1)
    ]
    try:
        c = result.certificate
        lines = [] if c.gradient is None else [f"gradient of the nonlinear problem {c.gradient:.1e} of that at nominal"]
        lines += [
            f"step that the convex program would still take {c.step:.1e}",
            f"constraints missed by {c.violation:.1e}",
        ]
        said = f"Checked anew at the solution: {', '.join(lines)} (in units of the scales)."
    except RpimError as error:
        said = f"The solution cannot be checked anew. {error}"
    return _section(
        "Convergence", tag("p", f"{result.message} {said}"),
        _table("Passes of the loop", ["pass", "objective", "step [scales]", "weight"], rows),
    )  # fmt: skip


def _provenance(result: Calibration) -> list[Element]:
    record, robot = result.record, result.problem.robot
    rows = []
    for name, data in _sets(result).items():
        for block in data.blocks:
            what = " ".join(filter(None, [block.measurement.name, *block.markers, block.fixture]))
            rows.append([f"{name}, {what}", str(len(block.row)), _noise(block)])
    facts = {
        "Source": record.source or "not stated",
        "Measurements": "simulated" if record.simulated else "as the source says; not marked as simulated",
        "Robot": " - ".join(filter(None, [robot.name, f"{robot.dof} joints", robot.source])),
        "Formulation": f"{result.formulation.name}: {_formulation(result)}",
        "Made": record.made,
        "Versions": ", ".join(f"{name} {version}" for name, version in record.versions.items()),
    }
    files = [[name, digest] for name, digest in record.files.items()]
    return _section(
        "Where the data come from",
        tag("dl", *(tag("div", tag("dt", key), tag("dd", value)) for key, value in facts.items()), class_="facts"),
        _table("Measurements and their declared standard deviations", ["data", "rows", "declared"], rows, prose=True),
        *([_table("Input files", ["file", "SHA-256"], files, prose=True)] if files else []),
        tag("p", "All figures on this page were computed from the measurements and parameters of the calibration when "
            "the page was written."),
    )  # fmt: skip


def _formulation(result: Calibration) -> str:
    """Return what is minimized, in the words of the result's file."""

    def said(term: Any) -> str:
        if isinstance(term, list):
            return f"{term[0]}({', '.join(map(str, term[1:]))})"
        return term or "a function of a script, not in the file"

    parts = definition(result.formulation)
    over = "" if parts["penalty_over"] == "none" else f" over {said(parts['penalty_over'])}"
    text = f"loss {said(parts['loss'])} of each {parts['loss_over']}, penalty {said(parts['penalty'])}{over}"
    bounds = [said(c) for c in parts["constraints"]]
    bounds += [] if parts["largest"] is None else [f"no configuration off by more than {parts['largest']:g} sigmas"]
    return f"{text}, constraints: {', '.join(bounds) or 'none'}"


def _noise(block: Any) -> str:
    """Return the declared standard deviations, by component, as a range where rows differ."""
    spread, said = np.sqrt(np.einsum("nii->ni", block.covariance)), {}
    for i, (name, dimension) in enumerate(block.measurement.components.items()):
        unit, si = {"length": ("mm", 1e-3), "angle": ("mrad", 1e-3)}.get(dimension, ("", 1.0))
        low, high = spread[:, i].min() / si, spread[:, i].max() / si
        figure = f"{low:.3g}" if high < 1.005 * low else f"{low:.3g} to {high:.3g}"
        said.setdefault(f"{figure} {unit}".strip(), []).append(name)
    return "; ".join(f"{figure} ({', '.join(names)})" for figure, names in said.items())
