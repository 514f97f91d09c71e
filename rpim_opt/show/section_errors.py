"""The report's errors before and after: of every row, how many are how large, and along the axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.markup import Element, tag
from rpim_opt.basics.page import data_table, section
from rpim_opt.basics.statistics import statistics
from rpim_opt.calibration.contact_words import HEADER, scatter, scatter_rows
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.show.pieces import BEFORE_AFTER, figure, mm, sets
from rpim_opt.show.scales import below, error_bins
from rpim_opt.show.svg import Axis, Chart

FEW = 30
"""Rows up to which labels stand below the bars."""
MANY = 100
"""Rows from which errors are points."""


def errors_section(result: Calibration) -> list[Element]:
    """Return the errors of all data: tables, and figures for each set."""
    rows: list[list[str]] = []
    angles: list[list[str]] = []
    blocks: list[Element] = []
    touched: list[Element] = []
    for name, data in sets(result).items():
        lengths, labels = _lengths(result, data)
        rows += [[f"{name}, {when}", *_figures(errors)] for when, errors in lengths.items()]
        angles += _angles(result, name, data)
        touched += _by_point(result, name, data)
        figures = [_bars(result, name, labels, lengths), _histogram(name, lengths), *_axes(result, name, data)]
        blocks += [tag("h3", f"{name.capitalize()} rows"), tag("div", *figures, class_="figures")]
    rows += _held_out(result)
    tables = [data_table("Error [mm]", ["data", "rows", "mean", "RMS", "95 % below", "largest"], rows)]
    if angles:
        head = ["data", "rows", "mean", "RMS", "largest"]
        tables.append(data_table("Orientation error [mrad]", head, angles))
    return section("Errors before and after", tag("p", _note(result)), *tables, *touched, *blocks)


def _note(result: Calibration) -> str:
    fitted = result.problem.parameters.of_frames & result.problem.parameters.identified
    note = "Before: the robot of the drawing"
    if fitted.any():
        note += ", its base, reflectors and other frames fitted to the identification data"
    used = "Identification rows were used to find the parameters."
    if result.record.validation is not None:
        used = "Identification rows were used to find the parameters; validation rows were not used for anything."
    if result.record.held_out is not None:
        used += " Those kept apart were not, when they were judged; they are among the identification rows now."
    return f"{note}. {used}"


def _held_out(result: Calibration) -> list[list[str]]:
    held = result.record.held_out
    if held is None:
        return []
    what = f"kept apart, from {held.used} rows"
    both = (("before", held.nominal), ("after", held.error))
    return [[f"{what}, {when}", *_figures(1e3 * errors[np.isfinite(errors)])] for when, errors in both]


def _lengths(result: Calibration, data: Dataset) -> tuple[dict[str, Array], list[str]]:
    """Return the errors [mm] before and after, and the labels, of rows that measure a length."""
    before = 1e3 * result.nominal_errors(data)
    after = 1e3 * result.errors(data)
    seen = np.isfinite(after)
    labels = [data.label[i] for i in np.flatnonzero(seen)]
    return {"before": before[seen], "after": after[seen]}, labels


def _figures(errors: Array) -> list[str]:
    of = statistics(errors / 1e3)
    high = float(np.percentile(errors, 95))
    return [str(of["count"]), mm(of["mean_mm"]), mm(of["rms_mm"]), mm(high), mm(of["max_mm"])]


def _angles(result: Calibration, name: str, data: Dataset) -> list[list[str]]:
    """Return the orientation errors [mrad] before and after; nothing where no orientation was measured."""
    rows = []
    for when, errors in (("before", result.nominal_errors), ("after", result.errors)):
        mrad = 1e3 * errors(data, "angle")
        mrad = mrad[np.isfinite(mrad)]
        if len(mrad):
            spread = (mrad.mean(), np.sqrt(np.mean(mrad**2)), mrad.max())
            rows.append([f"{name}, {when}", str(len(mrad)), *(f"{value:.3f}" for value in spread)])
    return rows


def _by_point(result: Calibration, name: str, data: Dataset) -> list[Element]:
    """Return how far touches are from their points; nothing where no row touched one."""
    found = scatter(data, result.nominal_errors(data), result.errors(data))
    if not found:
        return []
    return [data_table(f"{name.capitalize()}, distance of touches from their point [mm]", HEADER, scatter_rows(found))]


def _bars(result: Calibration, name: str, labels: Sequence[str], lengths: Mapping[str, Array]) -> Element:
    """Return the error of every row: bars, with labels where they are few, points where they are many."""
    n = len(labels)
    every = np.concatenate(list(lengths.values()))
    low = max(0.5 * float(every.min()), 1e-4 * float(every.max()), 1e-7)
    few = n <= FEW and max(map(len, labels)) <= 12
    x = Axis("", (0.5, n + 0.5), names=labels) if few else Axis("row", (0.5, n + 0.5))
    y = Axis("error [mm]", (low, max(float(every.max()), 1e-6)), log=True)
    chart = Chart(f"Error of every {name} row before and after", x, y)
    place = np.arange(n) + (0.0 if few else 1.0)
    for (when, errors), shift in zip(lengths.items(), (-0.4, 0.0), strict=True):
        if n > MANY:
            chart.cloud(place, errors, when)
        else:
            hints = [f"{label}, {when}: {mm(error)} mm" for label, error in zip(labels, errors, strict=True)]
            chart.bars(place + shift, place + shift + 0.4, errors, when, hints)
    wrong = _distrusted(result, name, labels)
    hints = [f"{labels[i]}: distrusted" for i in wrong]
    chart.dots(place[wrong] + 0.2, 1.15 * lengths["after"][wrong], "mark", hints)
    legend = [*BEFORE_AFTER]
    if wrong:
        legend.append(("mark", "distrusted"))
    cut = sum(int(np.sum(errors < low)) for errors in lengths.values())
    note = ""
    if cut:
        note = f" {cut} errors below {low:.2g} mm stand at the floor."
    return figure(chart, f"Every row, on a logarithmic scale.{note}", *legend)


def _distrusted(result: Calibration, name: str, labels: Sequence[str]) -> list[int]:
    if name != "identification":
        return []
    flagged = {flag.label for flag in result.flagged}
    return [i for i, label in enumerate(labels) if label in flagged]


def _histogram(name: str, sets: Mapping[str, Array]) -> Element:
    edges = error_bins(*sets.values())
    counts = {when: np.histogram(np.maximum(errors, edges[0]), edges)[0] for when, errors in sets.items()}
    most = max(int(c.max()) for c in counts.values())
    x = Axis("error [mm]", (edges[0], edges[-1]), log=True)
    y = Axis("rows", (0, most))
    chart = Chart(f"How many {name} rows have which error, before and after", x, y)
    for when, count in counts.items():
        bins = np.flatnonzero(count)
        hints = [f"{when}: {count[k]} rows from {mm(edges[k])} to {mm(edges[k + 1])} mm" for k in bins]
        chart.bars(edges[bins], edges[bins + 1], count[bins], when, hints)
    return figure(chart, f"How many rows have which error.{below(edges[0], sets)}", *BEFORE_AFTER)


def _axes(result: Calibration, name: str, data: Dataset) -> list[Element]:
    """Return the errors along x, y and z; nothing where no position was measured."""
    vectors = [1e3 * result.error_vectors(data, nominal=nominal) for nominal in (True, False)]
    seen = np.isfinite(vectors[0]).all(axis=1)
    if not seen.any():
        return []
    vectors = [v[seen] for v in vectors]
    rms = [np.sqrt(np.mean(v**2, axis=0)) for v in vectors]
    every = np.concatenate(rms)
    y = Axis("RMS [mm]", (max(0.5 * float(every.min()), 1e-7), max(float(every.max()), 1e-6)), log=True)
    chart = Chart(f"RMS error of the {name} rows along x, y and z", Axis("", names="xyz"), y)
    for (when, _), shift, values in zip(BEFORE_AFTER, (-0.3, 0.0), rms, strict=True):
        hints = [f"{axis}, {when}: {mm(v)} mm" for axis, v in zip("xyz", values, strict=True)]
        chart.bars(np.arange(3) + shift, np.arange(3) + shift + 0.3, values, when, hints)
    rows = []
    for i, axis in enumerate("xyz"):
        rows.append([axis, *(f"{v[:, i].mean():+z.3f} ± {v[:, i].std():.3f}" for v in vectors)])
    caption = "Measured minus modelled, mean ± standard deviation [mm]"
    return [
        figure(chart, "Along the axes of the instrument.", *BEFORE_AFTER),
        data_table(caption, ["axis", "before", "after"], rows),
    ]
