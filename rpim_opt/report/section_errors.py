"""The report's errors before and after: of every row, how many are how large, and along the axes."""

from __future__ import annotations

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.statistics import statistics
from rpim_opt.calibration.contact_words import HEADER, scatter, scatter_rows
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.report.charts_result import along_axes, axes_chart, directed, histogram_chart, lengths_of, rows_chart
from rpim_opt.report.frame import data_table, section
from rpim_opt.report.markup import Element, tag
from rpim_opt.report.pieces import figure, sets
from rpim_opt.report.scales import mm


def errors_section(result: Calibration) -> list[Element]:
    """Return the errors of all data: tables, and figures for each set."""
    rows: list[list[str]] = []
    angles: list[list[str]] = []
    blocks: list[Element] = []
    touched: list[Element] = []
    for name, data in sets(result).items():
        lengths, _ = lengths_of(result, data)
        rows += [[f"{name}, {when}", *_figures(errors)] for when, errors in lengths.items()]
        angles += _angles(result, name, data)
        touched += _by_point(result, name, data)
        figures = [
            figure(rows_chart(result, data), "Every row, on a logarithmic scale."),
            figure(histogram_chart(lengths), "How many rows have which error."),
            *_axes(result, data),
        ]
        blocks += [tag("h3", f"{name.capitalize()} rows"), tag("div", *figures, class_="figures")]
    rows += _held_out(result)
    tables = [data_table("Error [mm]", ["data", "rows", "mean", "RMS", "95 % below", "largest"], rows)]
    if angles:
        head = ["data", "rows", "mean", "RMS", "largest"]
        tables.append(data_table("Orientation error [mrad]", head, angles))
    return section("Errors before and after", tag("p", _note(result)), *tables, *touched, *blocks)


def _note(result: Calibration) -> str:
    fitted = result.problem.parameters.placed & result.problem.parameters.identified
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


def _axes(result: Calibration, data: Dataset) -> list[Element]:
    """Return the errors along x, y and z; nothing where no position was measured."""
    vectors = along_axes(result, data)
    if not len(vectors["after"]):
        return []
    rows = []
    for i, axis in enumerate("xyz"):
        rows.append([axis, *(f"{v[:, i].mean():+z.3f} ± {v[:, i].std():.3f}" for v in vectors.values())])
    frame, what = directed(data)
    caption = f"{what.capitalize()}, mean ± standard deviation [mm]"
    said = f"Along the axes of {frame}: mean, and where 95 % of the rows are."
    return [figure(axes_chart(result, data), said), data_table(caption, ["axis", "before", "after"], rows)]
