"""What is drawn of a result: errors of every row, how many are how large, along the axes, and its parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.text import percent
from rpim_opt.basics.units import display
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.report.chart import Axis, Bars, Chart, Dots, Line, Mark, Segments
from rpim_opt.report.scales import below, error_bins, kept_tolerance, mm

MANY = 100
"""Rows from which each is a small point without a name."""
LINEAR_MM = 0.1
"""Errors along the axes have two signs: up to here they are drawn linear."""


def lengths_of(result: Calibration, data: Dataset) -> tuple[dict[str, Array], list[str]]:
    """Return the errors [mm] before and after, and the labels, of rows that measure a length."""
    before = 1e3 * result.nominal_errors(data)
    after = 1e3 * result.errors(data)
    seen = np.isfinite(after)
    labels = [data.label[i] for i in np.flatnonzero(seen)]
    return {"before": before[seen], "after": after[seen]}, labels


def rows_chart(result: Calibration, data: Dataset) -> Chart:
    """Return every row's error before and after, those of the identification data that are distrusted marked."""
    lengths, labels = lengths_of(result, data)
    every = np.concatenate(list(lengths.values()))
    low = max(0.5 * float(every.min()), 1e-4 * float(every.max()), 1e-7)
    place = np.arange(1.0, len(labels) + 1)
    x = Axis("row", (1, max(len(labels), 2)))
    marks: list[Mark] = []
    hints: dict[str, list[str]] = {"before": [], "after": []}
    if len(labels) <= MANY:
        x = Axis("row", names=labels)
        both = np.maximum(np.column_stack(list(lengths.values())), low)
        marks.append(Segments(np.column_stack([place, place]), both, "before"))
        for when, errors in lengths.items():
            hints[when] = [f"{label}, {when}: {mm(error)} mm" for label, error in zip(labels, errors, strict=True)]
    marks += [Dots(place, np.maximum(errors, low), when, when, hints[when]) for when, errors in lengths.items()]
    wrong = _distrusted(result, data, labels)
    if wrong:
        said = [f"{labels[i]}: distrusted" for i in wrong]
        marks.append(Dots(place[wrong], np.maximum(lengths["after"][wrong], low), "mark", "distrusted", said))
    cut = int(np.sum(every < low))
    note = f"{cut} errors below {low:.2g} mm stand at the floor." if cut else ""
    y = Axis("error [mm]", (low, max(float(every.max()), 1e-6)), log=True)
    return Chart("Error of every row before and after", x, y, marks, note)


def _distrusted(result: Calibration, data: Dataset, labels: Sequence[str]) -> list[int]:
    if data is not result.problem.data:
        return []
    flagged = {flag.label for flag in result.flagged}
    return [i for i, label in enumerate(labels) if label in flagged]


def histogram_chart(lengths: Mapping[str, Array]) -> Chart:
    """Return how many rows have which error [mm], for each set."""
    edges = error_bins(*lengths.values())
    marks = []
    most = 0
    for when, errors in lengths.items():
        count = np.histogram(np.maximum(errors, edges[0]), edges)[0]
        bins = np.flatnonzero(count)
        hints = [f"{when}: {count[k]} rows from {mm(edges[k])} to {mm(edges[k + 1])} mm" for k in bins]
        marks.append(Bars(edges[bins], edges[bins + 1], count[bins], when, when, hints))
        most = max(most, int(count.max()))
    x = Axis("error [mm]", (edges[0], edges[-1]), log=True)
    title = "How many rows have which error, before and after"
    return Chart(title, x, Axis("rows", (0, most)), marks, below(edges[0], lengths))


def along_axes(result: Calibration, data: Dataset) -> dict[str, Array]:
    """Return measured minus modelled positions (N, 3) [mm] before and after, of rows that measure one."""
    vectors = {
        "before": 1e3 * result.error_vectors(data, nominal=True),
        "after": 1e3 * result.error_vectors(data),
    }
    seen = np.isfinite(vectors["after"]).all(axis=1)
    return {when: each[seen] for when, each in vectors.items()}


def directed(data: Dataset) -> tuple[str, str]:
    """Say whose axes the errors of positions are along, and what they are."""
    if any(block.measurement.touching for block in data.blocks):
        return "the robot's base", "mean of the point minus touch"  # no instrument stands there
    return "the instrument", "measured minus modelled"


def axes_chart(result: Calibration, data: Dataset) -> Chart:
    """Return mean (dot) and spread (95 % of the rows) of the errors of positions along x, y and z."""
    marks: list[Mark] = [Line([0.5, 3.5], [0, 0], "zero")]
    ends = [0.0]
    vectors = along_axes(result, data)
    for (when, each), shift in zip(vectors.items(), (-0.1, 0.1), strict=True):
        mean = each.mean(axis=0)
        spread = np.percentile(each, [2.5, 97.5], axis=0).T
        place = np.arange(1, 4) + shift
        hints = [
            f"{axis}, {when}: mean {m:+z.3f} mm, 95 % of the rows from {low:+z.3f} to {high:+z.3f} mm"
            for axis, m, (low, high) in zip("xyz", mean, spread, strict=True)
        ]
        marks.append(Segments(np.column_stack([place, place]), spread, when))
        marks.append(Dots(place, mean, when, when, hints))
        ends += [float(spread.min()), float(spread.max())]
    frame, what = directed(data)
    x = Axis(f"axis of {frame}", names=("x", "y", "z"))
    y = Axis(f"{what} [mm]", (min(ends), max(ends)), linear_to=LINEAR_MM)
    return Chart("Errors along x, y and z", x, y, marks)


def deviations_chart(result: Calibration, dimension: str, half: Array, confidence: float = 0.95) -> Chart:
    """Return the deviations of the robot's own parameters of a dimension, with intervals and tolerances kept to.

    Half the intervals (n,) [SI] are NaN where there are none.
    """
    free = result.problem.parameters.free
    unit, si = display(dimension)
    own = np.flatnonzero(~free.of_frames & (np.array(free.dimensions) == dimension))
    x = result.x[own] / si
    spread = np.nan_to_num(half[own] / si, posinf=0.0)
    bound = kept_tolerance(result)[own] / si
    kept = np.flatnonzero(np.isfinite(bound))
    place = np.arange(1.0, len(own) + 1)
    names = [free.names[i] for i in own]
    hints = [f"{name}: {d:+z.4f} ± {s:.4f} {unit}" for name, d, s in zip(names, x, spread, strict=True)]
    level = np.column_stack([place, place])
    marks: list[Mark] = [
        Line([0, 0], [0.5, len(own) + 0.5], "zero"),
        Segments(np.column_stack([x - spread, x + spread]), level, "after"),
        Dots(x, place, "after", f"deviation, {percent(confidence)} interval", hints),
    ]
    if len(kept):
        ends = np.concatenate([-bound[kept], bound[kept]])
        height = np.tile(np.column_stack([place[kept] - 0.35, place[kept] + 0.35]), (2, 1))
        marks.append(Segments(np.column_stack([ends, ends]), height, "mark", "tolerance"))
    # an interval that ends far out would hide all others: it is cut at the chart's edge
    seen = [np.max(np.abs(x), initial=1e-9), np.max(bound[kept], initial=0.0)]
    reach = 1.1 * float(max(*seen, np.median(np.abs(x) + spread) if len(x) else 0.0))
    across = Axis(f"deviation from nominal [{unit}]", (-reach, reach))
    cut = "Intervals beyond the edge are cut." if (np.abs(x) + spread > reach).any() else ""
    title = f"Deviations of the {dimension} parameters"
    return Chart(title, across, Axis("", names=names), marks, cut, 60 + 17 * len(own))
