"""Charts in SVG, coloured by the page's style sheet, so that they follow light and dark and print sharp."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from rpim_opt.basics.arrays import Array
from rpim_opt.report.chart import Axis, Bars, Cells, Chart, Dots, Line, Mark, Segments
from rpim_opt.report.markup import Element, tag

WIDTH = 420
TOP = 12
RIGHT = 14
TALLEST = 400.0
"""Of a chart whose axes have the same scale [px]."""
LETTER = 7
"""Width of one [px]."""
MANY = 30
"""Names beyond which none is written along x, and the longest that is."""
LONG = 12
RADIUS = {"small": 2.5, "middle": 3.5, "large": 6.0}


class Scale:
    """An axis on paper: places [px] of its values, and its ticks."""

    def __init__(self, axis: Axis):
        self.axis = axis
        self.low, self.high = axis.scaled(axis.limits)
        self.start = 0.0
        self.end = 1.0

    def __call__(self, values: ArrayLike) -> Array:
        """Return the places [px]; beyond the ends they stay at the ends."""
        seen = np.clip(self.axis.scaled(values), self.low, self.high)
        return np.round(self.start + (seen - self.low) * self.unit, 2)

    @property
    def unit(self) -> float:
        """Pixels of one unit of the scaled axis."""
        return (self.end - self.start) / (self.high - self.low)

    def ticks(self, named: bool = True) -> list[tuple[float, str]]:
        """Return value and text of the ticks: names, decades, or steps of 1, 2 or 5."""
        if named and self.axis.names:
            return [(float(k), name) for k, name in enumerate(self.axis.names, start=1)]
        if self.axis.log:
            return self._powers()
        if self.axis.linear_to:
            return self._both_signs()
        step = _step(self.high - self.low)
        values = step * np.arange(np.ceil(self.low / step), np.floor(self.high / step) + 1)
        return [(float(v), f"{v:.6g}") for v in np.round(values / step) * step + 0.0]

    def _powers(self) -> list[tuple[float, str]]:
        """Return decades, or where there are fewer than three of them 1, 2 and 5 times each."""
        span = self.high - self.low
        if span >= 1.5 and np.floor(self.high) - np.ceil(self.low) >= 2:
            return self._decades(int(np.ceil(span / 6)))
        powers = range(int(np.floor(self.low)), int(np.ceil(self.high)))
        steps = [m * 10.0**k for k in powers for m in (1, 2, 5)]
        return [(v, f"{v:g}") for v in steps if self.low <= np.log10(v) <= self.high]

    def _decades(self, every: int) -> list[tuple[float, str]]:
        powers = range(int(np.ceil(self.low)), int(np.floor(self.high)) + 1, every)
        return [(10.0**k, f"{10.0**k:g}" if -3 <= k <= 4 else f"1e{k}") for k in powers]

    def _both_signs(self) -> list[tuple[float, str]]:
        """Return zero, and to either side the end of the linear part and decades of it, four at most."""
        least = self.axis.linear_to
        decades = int(np.floor(np.log10(max(map(abs, self.axis.limits)) / least)))
        sizes = least * 10.0 ** np.arange(0, decades + 1, 1 + decades // 4)
        low, high = self.axis.limits
        return [(float(v), f"{v:g}") for v in [*-sizes[::-1], 0.0, *sizes] if low <= v <= high]


def _step(span: float) -> float:
    """Return the smallest step of 1, 2 or 5 times a power of ten that makes at most six of a span."""
    power = 10.0 ** np.floor(np.log10(span / 5))
    return next(m * power for m in (1, 2, 5, 10) if span / (m * power) <= 6)


class Picture:
    """A chart on paper of 420 pixels' width, which scales with the page.

    Parameters
    ----------
    chart
        The description; what it draws carries the class of its role, and its hint.
    """

    def __init__(self, chart: Chart):
        self.chart = chart
        self.x = Scale(chart.x)
        self.y = Scale(chart.y)
        names = chart.x.names
        longest = max(map(len, names), default=0)
        self.named = len(names) <= MANY and longest <= LONG
        self.upright = self.named and sum(len(name) + 1 for name in names) * LETTER > WIDTH - 80
        below = 16
        if self.upright:
            below = 4 + 8 * longest
        below += 24 if chart.x.label else 8
        self.x.start = 30.0 + LETTER * max((len(text) for _, text in self.y.ticks()), default=1)
        self.x.end = float(WIDTH - RIGHT)
        tall = chart.height - below - TOP
        if chart.alike:
            tall = self._alike()
        self.y.start = float(TOP + tall)
        self.y.end = float(TOP)
        self.floor = self.y.start
        if chart.y.names:
            self.y.start, self.y.end = self.y.end, self.y.start
        self.height = int(np.ceil(self.floor + below))

    def _alike(self) -> float:
        """Return the height that a y axis of the same scale takes; x becomes longer where that is too tall."""
        across = (self.x.end - self.x.start) / (self.x.high - self.x.low) * (self.y.high - self.y.low)
        if across <= TALLEST:
            return across
        middle = (self.x.low + self.x.high) / 2
        half = (self.x.high - self.x.low) / 2 * across / TALLEST
        self.x.low = middle - half
        self.x.high = middle + half
        return TALLEST

    def element(self, *above: Element) -> Element:
        """Return the picture, with more above what the chart draws."""
        drawn = [item for mark in self.chart.marks for item in self._mark(mark)]
        return tag(
            "svg", *self._grid(), *drawn, *above, *self._labels(),
            viewBox=f"0 0 {WIDTH} {self.height}", role="img", aria_label=self.chart.title,
        )  # fmt: skip

    def _grid(self) -> Iterator[Element]:
        names = self.chart.x.names
        for value, text in self.x.ticks(self.named):
            at = f"{float(self.x(value)):g}"
            if not names:
                yield tag("line", x1=at, x2=at, y1=TOP, y2=f"{self.floor:g}", class_="grid")
            below = f"{self.floor + 10:g}"
            placed = {"text_anchor": "middle", "dy": "6"}
            if self.upright:
                placed = {"transform": f"rotate(-90 {at} {below})", "text_anchor": "end", "dy": "4"}
            yield tag("text", text, x=at, y=below, class_="tick", **placed)
        for value, text in self.y.ticks():
            at = f"{float(self.y(value)):g}"
            yield tag("line", x1=f"{self.x.start:g}", x2=f"{self.x.end:g}", y1=at, y2=at, class_="grid")
            yield tag("text", text, x=f"{self.x.start - 6:g}", y=at, dy="4", text_anchor="end", class_="tick")

    def _labels(self) -> Iterator[Element]:
        middle = f"{(self.x.start + self.x.end) / 2:g}"
        yield tag("text", self.chart.x.label, x=middle, y=self.height - 6, text_anchor="middle", class_="name")
        aside = f"{(TOP + self.floor) / 2:g}"
        turned = f"rotate(-90 12 {aside})"
        yield tag("text", self.chart.y.label, x=12, y=aside, text_anchor="middle", transform=turned, class_="name")

    def _mark(self, mark: Mark) -> Iterator[Element]:
        match mark:
            case Line():
                yield self._path([(mark.x, mark.y)], mark.role, mark.dashed)
            case Segments():
                yield self._path(zip(mark.x, mark.y, strict=True), mark.role)
            case Dots(hints=hints) if not len(hints):
                places = zip(self.x(mark.x), self.y(mark.y), strict=True)
                drawn = "".join(f"M{a:g} {b:g}h0" for a, b in places)
                yield tag("path", d=drawn, class_=f"cloud {mark.role}")
            case Dots():
                yield from self._dots(mark)
            case Bars():
                yield from self._bars(mark)
            case Cells():
                yield from self._cells(mark)

    def _path(self, lines, role: str, dashed: bool = False) -> Element:
        drawn = []
        for x, y in lines:
            places = [f"{a:g},{b:g}" for a, b in zip(self.x(x), self.y(y), strict=True)]
            drawn.append("M" + "L".join(places))
        return tag("path", d="".join(drawn), class_=f"line {role}" + " dashed" * dashed)

    def _dots(self, mark: Dots) -> Iterator[Element]:
        class_ = f"dot {mark.role}" + " hollow" * mark.hollow
        for a, b, hint in zip(self.x(mark.x), self.y(mark.y), mark.hints, strict=True):
            yield tag("circle", tag("title", hint), cx=f"{a:g}", cy=f"{b:g}", r=RADIUS[mark.size], class_=class_)

    def _bars(self, mark: Bars) -> Iterator[Element]:
        places = zip(self.x(mark.left), self.x(mark.right), self.y(mark.top), strict=True)
        for (left, right, top), hint in zip(places, mark.hints, strict=True):
            yield _box(left, top, max(right - left, 0.5), max(self.floor - top, 0), f"bar {mark.role}", hint)

    def _cells(self, mark: Cells) -> Iterator[Element]:
        lower = np.asarray(mark.corners)
        upper = lower + np.asarray(mark.size)
        ends = zip(self.x(lower[:, 0]), self.x(upper[:, 0]), self.y(lower[:, 1]), self.y(upper[:, 1]), strict=True)
        for (left, right, bottom, top), hint in zip(ends, mark.hints, strict=True):
            yield _box(left, top, right - left, bottom - top, f"cell {mark.role}", hint)


def _box(left: float, top: float, width: float, height: float, class_: str, hint: str) -> Element:
    size = {"x": f"{left:g}", "y": f"{top:g}", "width": f"{width:g}", "height": f"{height:g}"}
    return tag("rect", tag("title", hint), class_=class_, **size)
