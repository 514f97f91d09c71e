"""Charts of a calibration: errors, parameters, uncertainty in the workspace, choice of the weight, checks over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.text import joined, percent
from rpim_opt.basics.units import display
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.constraints import within_tolerance
from rpim_opt.convex.program import Program
from rpim_opt.data.dataset import Dataset
from rpim_opt.report.chart import Axis, Boxes, Chart, Dots, Line, Mark, segments

if TYPE_CHECKING:
    from rpim_opt.use.monitoring import Monitoring


MODELS = {"before": "nominal", "after": "identified"}
"""Model that errors before and after calibration are of."""


def mm(value: float) -> str:
    """Return a length in mm with the digits that matter."""
    if value < 10:
        return f"{value:.3f}"
    return f"{value:.2f}" if value < 100 else f"{value:.0f}"


# --- errors ------------------------------------------------------------------------------------------------

MANY_ROWS = 100
"""Above it each row is a small point without a name."""
LINEAR_MM = 0.1
"""Size up to which the axis of signed errors is linear."""


def lengths_of(result: Calibration, data: Dataset) -> tuple[dict[str, Array], list[str]]:
    """Return the errors [mm] before and after calibration, and the labels, of rows that measure a length."""
    before = 1e3 * result.nominal_errors(data)
    after = 1e3 * result.errors(data)
    finite = np.isfinite(after)
    labels = [data.label[i] for i in np.flatnonzero(finite)]
    return {"before": before[finite], "after": after[finite]}, labels


def rows_chart(result: Calibration, data: Dataset) -> Chart:
    """Return every row's error before and after calibration; flagged rows of the identification data are marked."""
    lengths, labels = lengths_of(result, data)
    every = np.concatenate(list(lengths.values()))
    low = max(0.5 * float(every.min()), 1e-4 * float(every.max()), 1e-7)
    drawn = {when: np.maximum(errors, low) for when, errors in lengths.items()}
    place = np.arange(1.0, len(labels) + 1)
    x = Axis("row", (1, max(len(labels), 2)))
    marks: list[Mark] = []
    hints: dict[str, list[str]] = {"before": [], "after": []}
    if len(labels) <= MANY_ROWS:
        x = Axis("row", names=labels)
        stems = segments(np.column_stack([drawn["before"], drawn["after"]]))
        marks.append(Line(segments(np.column_stack([place, place])), stems, "before"))
        for when, errors in lengths.items():
            named = zip(labels, errors, strict=True)
            hints[when] = [f"{label}, {MODELS[when]}: {mm(error)} mm" for label, error in named]
    marks += [Dots(place, drawn[when], when, MODELS[when], hints[when]) for when in lengths]
    flagged: set[str] = set()
    if data is result.problem.data:
        flagged = {flag.label for flag in result.flagged}
    at = [i for i, label in enumerate(labels) if label in flagged]
    if at:
        marks.append(Dots(place[at], drawn["after"][at], "mark", "flagged", [f"{labels[i]}: flagged" for i in at]))
    cut = int(np.sum(every < low))
    note = f"{cut} errors below {low:.2g} mm are drawn at the lower edge." if cut else ""
    y = Axis("error [mm]", (low, max(float(every.max()), 1e-6)), log=True)
    return Chart("Error of every row before and after calibration", x, y, marks, note)


def histogram_chart(lengths: Mapping[str, Array]) -> Chart:
    """Return a histogram of the errors [mm] of each set, four decades at most."""
    every = np.concatenate(list(lengths.values()))
    high = max(float(every.max(initial=0.0)), 1e-6) * 1.001
    low = max(float(every.min(initial=high)), 1e-4 * high)
    edges = np.geomspace(low, high, 25 if high > 1.01 * low else 2)
    marks: list[Mark] = []
    most = 0
    below = []
    for when, errors in lengths.items():
        count = np.histogram(np.maximum(errors, edges[0]), edges)[0]
        bins = np.flatnonzero(count)
        hints = [f"{MODELS[when]}: {count[k]} rows from {mm(edges[k])} to {mm(edges[k + 1])} mm" for k in bins]
        floor = np.zeros(len(bins))
        marks.append(Boxes(edges[bins], edges[bins + 1], floor, count[bins], when, MODELS[when], hints))
        most = max(most, int(count.max()))
        if (errors < low).any():
            below.append(f"{int(np.sum(errors < low))} {MODELS[when]}")
    note = f"The first bar includes the rows below {low:.2g} mm: {joined(below)}." if below else ""
    x = Axis("error [mm]", (edges[0], edges[-1]), log=True)
    return Chart("Distribution of the errors before and after calibration", x, Axis("rows", (0, most)), marks, note)


def signed_errors(result: Calibration, data: Dataset) -> tuple[str, str, dict[str, Array]]:
    """Return whose axes positions are along, what the errors are, and these (N, 3) [mm] before and after."""
    frame, what = "the instrument", "measured minus modelled"
    if any(block.measurement.touching for block in data.blocks):  # there is no instrument
        frame, what = "the robot's base", "mean of the point minus touch"
    before = 1e3 * result.error_vectors(data, nominal=True)
    after = 1e3 * result.error_vectors(data)
    finite = np.isfinite(after).all(axis=1)
    return frame, what, {"before": before[finite], "after": after[finite]}


def axes_chart(result: Calibration, data: Dataset) -> Chart:
    """Return mean (dot) and central 95 % (line) of the errors of positions along x, y and z."""
    marks: list[Mark] = [Line([0.5, 3.5], [0, 0], "zero")]
    ends = [0.0]
    frame, what, vectors = signed_errors(result, data)
    for (when, each), shift in zip(vectors.items(), (-0.1, 0.1), strict=True):
        mean = each.mean(axis=0)
        spread = np.percentile(each, [2.5, 97.5], axis=0).T
        place = np.arange(1, 4) + shift
        hints = [
            f"{axis}, {MODELS[when]}: mean {m:+z.3f} mm, 95 % of the rows from {low:+z.3f} to {high:+z.3f} mm"
            for axis, m, (low, high) in zip("xyz", mean, spread, strict=True)
        ]
        marks.append(Line(segments(np.column_stack([place, place])), segments(spread), when))
        marks.append(Dots(place, mean, when, MODELS[when], hints))
        ends += [float(spread.min()), float(spread.max())]
    x = Axis(f"axis of {frame}", names=("x", "y", "z"))
    y = Axis(f"{what} [mm]", (min(ends), max(ends)), linear_to=LINEAR_MM)
    return Chart("Errors along x, y and z", x, y, marks)


def magnification(points: Array, vectors: Array) -> float:
    """Return the factor, 1, 2 or 5 times 10^k, by which the longest error is a sixth of the points' extent."""
    longest = float(np.linalg.norm(vectors, axis=1).max(initial=0.0))
    exponent = np.log10(max(float(np.ptp(points, axis=0).max()), 1e-3) / 6 / max(longest, 1e-12))
    decade = 10.0 ** np.floor(exponent)
    return float(max(step for step in (1, 2, 5) if step * decade <= 10**exponent) * decade)


# --- parameters --------------------------------------------------------------------------------------------


def active_tolerance(result: Calibration) -> Array:
    """Return the tolerances (n,) [SI] that constrain the formulation; infinite where it has none."""
    tolerance = result.problem.parameters.free.tolerance
    if any(each is within_tolerance for each in result.formulation.constraints):
        return tolerance
    return np.full(len(tolerance), np.inf)


def deviations_chart(result: Calibration, dimension: str, half: Array, confidence: float = 0.95) -> Chart:
    """Return the deviations of the robot's own parameters of a dimension, with intervals and active tolerances.

    Half the intervals (n,) [SI] are NaN where there are none.
    """
    free = result.problem.parameters.free
    unit, si = display(dimension)
    own = np.flatnonzero(~free.of_frames & (np.array(free.dimensions) == dimension))
    x = result.x[own] / si
    spread = np.nan_to_num(half[own] / si, posinf=0.0)
    bound = active_tolerance(result)[own] / si
    bounded = np.flatnonzero(np.isfinite(bound))
    place = np.arange(1.0, len(own) + 1)
    names = [free.names[i] for i in own]
    hints = [f"{name}: {d:+z.4f} ± {s:.4f} {unit}" for name, d, s in zip(names, x, spread, strict=True)]
    intervals = segments(np.column_stack([x - spread, x + spread]))
    marks: list[Mark] = [
        Line([0, 0], [0.5, len(own) + 0.5], "zero"),
        Line(intervals, segments(np.column_stack([place, place])), "after"),
        Dots(x, place, "after", f"deviation, {percent(confidence)} interval", hints),
    ]
    if len(bounded):
        ends = np.concatenate([-bound[bounded], bound[bounded]])
        height = np.tile(np.column_stack([place[bounded] - 0.35, place[bounded] + 0.35]), (2, 1))
        marks.append(Line(segments(np.column_stack([ends, ends])), segments(height), "mark", "tolerance"))
    # an interval that ends far out would hide all others: it is cut at the chart's edge
    reach = max(float(np.max(np.abs(x), initial=1e-9)), float(np.max(bound[bounded], initial=0.0)))
    if len(x):
        reach = max(reach, float(np.median(np.abs(x) + spread)))
    reach *= 1.1
    across = Axis(f"deviation from nominal [{unit}]", (-reach, reach))
    cut = "Intervals beyond the edge are cut." if (np.abs(x) + spread > reach).any() else ""
    title = f"Deviations of the {dimension} parameters"
    return Chart(title, across, Axis("", names=names), marks, cut, 60 + 17 * len(own))


# --- uncertainty in the workspace --------------------------------------------------------------------------

CELLS = 24
"""Cells along the longer side."""
SHADES = 5
VIEWS = (("from above", 0, 1), ("from the side", 0, 2))


def workspace_charts(at: Array, bound: Array, box: Array | None, limit: float | None) -> list[Chart]:
    """Return maps of the expanded uncertainties (N,) at positions (N, 3), from above and from the side, all in mm.

    Each cell has the largest one of its positions; it is marked above the limit. The box (3, 2) is drawn as a frame.
    """
    low, high = float(bound.min()), float(bound.max())
    levels = np.linspace(low, high, SHADES + 1)[1:]
    decimals = 10.0 ** (int(np.ceil(-np.log10(max(high - low, 1e-3 * high)))) + 1)
    levels = np.asarray(np.ceil(levels * decimals) / decimals, dtype=float)
    charts = []
    for name, across, up in VIEWS:
        plane = at[:, [across, up]]
        corner, size = _cells(plane)
        corners, cell = np.unique(corner, axis=0, return_inverse=True)
        worst = np.zeros(len(corners))
        np.maximum.at(worst, cell.ravel(), bound)
        shades: dict[tuple[str, str], list[int]] = {}
        for k, value in enumerate(worst):
            shades.setdefault(_shade(levels, value, limit), []).append(k)
        marks: list[Mark] = []
        for (role, label), ks in sorted(shades.items()):
            lower, upper = corners[ks].T, (corners[ks] + size).T
            hints = [f"{mm(worst[k])} mm" for k in ks]
            marks.append(Boxes(lower[0], upper[0], lower[1], upper[1], role, label, hints))
        note = f"{name.capitalize()}."
        if box is not None:
            (a, b), (c, d) = box[across], box[up]
            marks.append(Line([a, b, b, a, a], [c, c, d, d, c], "ink"))
            note += " The frame is the box of the requirement."
        (left, right), (bottom, top) = zip(plane.min(axis=0), plane.max(axis=0), strict=True)
        x, y = Axis(f"{'xyz'[across]} [mm]", (left, right)), Axis(f"{'xyz'[up]} [mm]", (bottom, top))
        title = f"Largest expanded uncertainty of the position reached, {name}"
        charts.append(Chart(title, x, y, marks, note, alike=True))
    return charts


def _cells(points: Array) -> tuple[Array, Array]:
    """Return the lower corners (N, 2) of the points' cells, and the cells' common size (2,)."""
    extent = np.ptp(points, axis=0)
    count = np.maximum(np.ceil(extent / (extent.max() / CELLS) - 1e-9), 1)
    size = extent / count
    low = points.min(axis=0)
    return low + np.minimum((points - low) // np.maximum(size, 1e-9), count - 1) * size, size


def _shade(levels: Array, value: float, limit: float | None) -> tuple[str, str]:
    """Return role and label of a cell."""
    level = min(int(np.searchsorted(levels, value)), SHADES - 1)
    end = float(levels[level])
    if limit is not None and value > limit:
        return f"level{level} over", f"to {mm(end)} mm, above the limit"
    return f"level{level}", f"to {mm(min(end, limit or np.inf))} mm"


# --- the regularization weight -----------------------------------------------------------------------------

VANISHED = 1e-4
"""Penalties below this part of the median one are not drawn: a lasso has no deviation left there."""
FAINT = 1e-4
"""Coefficients of the data below this many standard deviations are not drawn."""


def l_curve_chart(residual: Array, solution: Array, chosen: Mapping[str, tuple[float, float]], own: str) -> Chart:
    """Return the L-curve: roots of loss and penalty (k,) over the weight, and choices by label; ``own`` is in use."""
    drawn = solution > VANISHED * float(np.median(solution))
    marks: list[Mark] = [Line(residual[drawn], solution[drawn], "ink")]
    others = {name: at for name, at in chosen.items() if name != own}
    if others:
        x, y = np.transpose(list(others.values()))
        marks.append(Dots(x, y, "other", "other selectors", list(others), each=True))
    if own in chosen:
        (x,), (y,) = np.transpose([chosen[own]])
        marks.append(Dots([x], [y], "mark", f"chosen: {own}", [f"chosen: {own}"], size="large"))
    across = Axis(
        "residual norm [standard deviations of the noise]", (max(residual.min(), 1e-9), residual.max()), log=True
    )
    up = Axis("deviation norm [prior scales]", (solution[drawn].min(), solution.max()), log=True)
    return Chart("L-curve: residual norm against norm of the deviations", across, up, marks, height=330)


def picard_chart(program: Program, weight: float) -> Chart:
    """Return Picard's condition: singular values, coefficients of the data and of the solution, root of the weight."""
    beta, s, _ = program.model.svd
    k = np.flatnonzero(s > 0)
    data = np.abs(beta[k])
    solution = data / s[k]
    level = float(np.sqrt(weight))
    place = k + 1.0
    last = max(len(k), 2)
    seen = [f"direction {i + 1}: data {abs(beta[i]):.3g}, s {s[i]:.3g}" for i in k]
    ratio = [f"direction {i + 1}: coefficient {abs(beta[i]) / s[i]:.3g}" for i in k]
    marks: list[Mark] = [
        Line(place, s[k], "ink", "singular value s"),
        Dots(place, solution, "other", "coefficient |u'b| / s", ratio, size="small"),
        Dots(place, data, "after", "data |u'b|", seen),
    ]
    every = np.concatenate([s[k], data])
    if level > 0:
        marks.append(Line([1, last], [level, level], "mark", "root of the weight", dashed=True))
        every = np.append(every, level)
    high = max(float(every.max(initial=1.0)), float(solution.max(initial=0.0)))
    y = Axis("size, whitened and scaled [1]", (max(float(every.min(initial=1.0)), FAINT), high), log=True)
    return Chart("Singular values and coefficients of the data", Axis("singular direction", (1, last)), y, marks)


# --- checks over time --------------------------------------------------------------------------------------

TIMES = ((86400.0, "days"), (3600.0, "hours"))
"""Units of an axis of time [s]."""


def checks_charts(found: Monitoring) -> list[Chart]:
    """Return every check against its limit, and their cumulative sum (CUSUM) against its limit."""
    count = len(found.label)
    place = np.arange(1, count + 1, dtype=float)
    axis = Axis("check", (1, max(count, 2)))
    if found.when is not None and np.ptp(found.when) > 0:
        span = float(np.ptp(found.when))
        unit, name = next(((size, name) for size, name in TIMES if span > 2 * size), (1.0, "seconds"))
        place = (found.when - found.when[0]) / unit
        axis = Axis(f"{name} since the first check", (0.0, float(place[-1])))
    hints = [
        f"{label}: {sigmas:.1f} standard deviations, {mm(1e3 * error)} mm"
        for label, sigmas, error in zip(found.label, found.sigmas, found.error, strict=True)
    ]
    beyond = np.isin(np.arange(count), found.beyond)
    marks: list[Mark] = [Line(place, found.allowed, "mark", "limit, checks beyond it")]
    for which, role, label in ((~beyond, "after", "check"), (beyond, "mark", "")):
        at = np.flatnonzero(which)
        if len(at):
            marks.append(Dots(place[at], found.sigmas[at], role, label, [hints[i] for i in at]))
    y = Axis("residual [standard deviations]", (0.0, 1.05 * float(max(found.sigmas.max(), found.allowed.max()))))
    each = Chart("Residual of every check and its limit", axis, y, marks, "Each check on its own.")
    sums: list[Mark] = [
        Line(place, np.full(count, found.limit), "mark", "limit, alarm"),
        Line(place, found.sums, "after", "sum"),
    ]
    if found.alarm is not None:
        at = [found.alarm]
        sums.append(Dots(place[at], found.sums[at], "mark", hints=[f"alarm at {found.label[found.alarm]}"]))
    y = Axis("cumulative sum", (0.0, 1.05 * float(max(found.sums.max(), found.limit))))
    together = Chart("Cumulative sum of the checks and its limit", axis, y, sums, "All checks together (CUSUM).")
    return [each, together]
