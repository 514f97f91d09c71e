"""The report's parameters: a table with intervals and tolerances, and a chart of the deviations."""

from __future__ import annotations

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import display
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import Uncertainty
from rpim_opt.calibration.words import turned_frames
from rpim_opt.report.charts_result import deviations_chart
from rpim_opt.report.frame import data_table, section
from rpim_opt.report.markup import Element, tag
from rpim_opt.report.pieces import figure
from rpim_opt.report.scales import kept_tolerance


def parameters_section(result: Calibration) -> list[Element]:
    """Return the identified parameters with half their intervals, where the formulation has any."""
    half, note = _intervals(result)
    free = result.problem.parameters.free
    head = ["parameter", "nominal", "identified", "deviation", "± (95 %)", "tolerance"]
    rows = _rows(result, half)
    if not np.isfinite(kept_tolerance(result)).any():
        head = head[:-1]
        rows = [row[:-1] for row in rows]
    own = np.array(free.dimensions)[~free.of_frames]
    charts = [
        figure(
            deviations_chart(result, dimension, half), f"The robot's own {dimension} parameters against the drawing."
        )
        for dimension in ("length", "angle")
        if dimension in own
    ]
    return section(
        "Parameters",
        tag("p", " ".join([note, *turned_frames(result)])),
        tag("div", *charts, class_="figures"),
        data_table("Identified parameters", head, rows),
    )


def _intervals(result: Calibration) -> tuple[Array, str]:
    """Return half the intervals (n,) [SI], NaN where there is none, and what they are."""
    try:
        uncertainty = Uncertainty(result)
        low, high = uncertainty.intervals().T
        note = f"± is half the {100 * uncertainty.confidence:.0f} % interval, noise and prior together. "
        return (high - low) / 2, note + uncertainty.noise_test().verdict
    except InputError:
        return np.full(len(result.x), np.nan), "No intervals: the formulation has no covariance."


def _rows(result: Calibration, half: Array) -> list[list[str]]:
    free = result.problem.parameters.free
    tolerance = kept_tolerance(result)
    held = {each.name for each in result.held}
    rows = []
    for i, row in enumerate(result.parameter_rows()):
        _, si = display(free.dimensions[i])
        name = f"{row['name']} [{row['unit']}]"
        if row["name"] in held:
            name += ", at its bound"
        figures = [f"{row['nominal']:z.4f}", f"{row['identified']:z.4f}", f"{row['deviation']:+z.4f}"]
        spread = f"±{half[i] / si:.4f}" if np.isfinite(half[i]) else ""
        bound = f"±{tolerance[i] / si:.4g}" if np.isfinite(tolerance[i]) else ""
        rows.append([name, *figures, spread, bound])
    return rows
