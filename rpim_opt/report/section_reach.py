"""The report's map of the workspace: how far off the robot may be, from above and from the side."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import percent
from rpim_opt.calibration.reaching import reaching
from rpim_opt.calibration.region import Region, region_of
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.record import Requirement
from rpim_opt.problem.workspace import in_base
from rpim_opt.report.chart import Axis, Cells, Chart, Line, Mark
from rpim_opt.report.frame import section
from rpim_opt.report.markup import Element, tag
from rpim_opt.report.pieces import figure
from rpim_opt.report.scales import mm

ANY = Requirement(limit=1.0)
"""All that was measured, where nothing is demanded."""
CELLS = 24
"""Cells along the longer side."""
LEVELS = 5
"""Shades."""
VIEWS = (("from above", 0, 1), ("from the side", 0, 2))


class _Map(NamedTuple):
    """Positions (N, 3) [mm] in the base frame, bounds (N,) [mm], and the ends of the shades."""

    at: Array
    bound: Array
    ends: Array


def reach_section(result: Calibration) -> list[Element]:
    """Return the map; nothing where there are no intervals, or several robots."""
    requirement = result.record.requirement or ANY
    try:
        region = region_of(result, requirement)
        q = region.drawn()
        bound = 1e3 * reaching(result, region, q, requirement.confidence).bound
    except InputError:
        return []
    if not np.isfinite(bound).all():
        return []
    found = _Map(1e3 * in_base(region.machine, q, region.marker), bound, _ends(bound))
    limit = None
    if result.record.requirement is not None:
        limit = 1e3 * requirement.limit
    sure = percent(requirement.confidence)
    text = (
        f"With {sure} the position that the robot reaches is within this of the predicted one. {len(q)} configurations "
        f"of the region ({requirement.where}); every square has the largest bound of those that reach into it, at "
        "whatever depth, empty squares have none. Axes of the robot's base."
    )
    if limit is not None:
        text += " The search for the largest bound goes on between these configurations, and may end above the shades."
    maps = [figure(_view(found, name, across, up, region, limit)) for name, across, up in VIEWS]
    return section("How far off the robot may be", tag("p", text), tag("div", *maps, class_="figures"))


def _ends(bound: Array) -> Array:
    """Return the upper ends (LEVELS,) of the shades [mm], round to two digits."""
    low = float(bound.min())
    high = float(bound.max())
    ends = np.linspace(low, high, LEVELS + 1)[1:]
    digits = int(np.ceil(-np.log10(max(high - low, 1e-3 * high)))) + 1
    return np.asarray(np.ceil(ends * 10.0**digits) / 10.0**digits, dtype=float)


def _view(found: _Map, name: str, across: int, up: int, region: Region, limit: float | None) -> Chart:
    u = found.at[:, across]
    v = found.at[:, up]
    largest = max(np.ptp(u), np.ptp(v)) / CELLS
    left, wide = _cells(u, largest)
    low, high = _cells(v, largest)
    worst: dict[tuple[float, float], float] = {}
    for a, b, bound in zip(left, low, found.bound, strict=True):
        worst[a, b] = max(bound, worst.get((a, b), 0.0))
    shades: dict[str, list[tuple[float, float]]] = {}
    for place, bound in sorted(worst.items(), key=lambda item: item[1]):
        shades.setdefault(_shade(found.ends, bound, limit), []).append(place)
    marks: list[Mark] = []
    for shade in sorted(shades):
        hints = [f"{mm(worst[place])} mm" for place in shades[shade]]
        marks.append(Cells(np.array(shades[shade]), (wide, high), shade, _said(found.ends, shade, limit), hints))
    note = f"{name.capitalize()}."
    if region.box is not None:
        (a, b), (c, d) = 1e3 * region.box[across], 1e3 * region.box[up]
        marks.append(Line([a, b, b, a, a], [c, c, d, d, c], "ink"))
        note += " The frame is the box that is demanded."
    x = Axis(f"{'xyz'[across]} [mm]", (u.min(), u.max()))
    y = Axis(f"{'xyz'[up]} [mm]", (v.min(), v.max()))
    return Chart(f"Largest bound of the position reached, {name}", x, y, marks, note, alike=True)


def _cells(values: Array, largest: float) -> tuple[Array, float]:
    """Return where the cells of values begin (N,), and how wide they are: equal, and within the values' ends."""
    count = max(int(np.ceil(np.ptp(values) / largest - 1e-9)), 1)
    wide = float(np.ptp(values)) / count
    number = np.minimum((values - values.min()) // max(wide, 1e-9), count - 1)
    return values.min() + number * wide, wide


def _shade(ends: Array, value: float, limit: float | None) -> str:
    level = f"level{min(int(np.searchsorted(ends, value)), LEVELS - 1)}"
    if limit is not None and value > limit:
        return f"{level} over"
    return level


def _said(ends: Array, shade: str, limit: float | None) -> str:
    level, *over = shade.split()
    end = float(ends[int(level.removeprefix("level"))])
    if over:
        return f"to {mm(end)} mm, above the limit"
    return f"to {mm(min(end, limit or np.inf))} mm"
