"""Charts: one description of axes and marks, and its renderer as SVG for pages (`plot` draws it with matplotlib)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike, NDArray

from rpim_opt.basics.arrays import Array

# --- the description ---------------------------------------------------------------------------------------

MARGIN = 0.04
"""Margin at an axis's ends, relative to its length."""


@dataclass(frozen=True)
class Axis:
    """Axis with its label and unit: linear, logarithmic, linear up to ``linear_to`` and logarithmic beyond, or names.

    Values beyond ``ends`` are drawn at the edge; names are at 1, 2, ..., on the y axis from top to bottom.
    """

    label: str
    ends: tuple[float, float] = (0.0, 1.0)
    log: bool = False
    linear_to: float = 0.0
    names: Sequence[str] = ()

    def scaled(self, values: ArrayLike) -> Array:
        """Return values as lengths along the axis."""
        v = np.asarray(values, dtype=float)
        if self.log:
            return np.log10(np.maximum(v, np.finfo(float).tiny))
        if not self.linear_to:
            return v
        # as matplotlib's symlog: the linear part is as long as a decade
        size = np.maximum(np.abs(v) / self.linear_to, 1e-300)
        return np.where(size <= 1, v / self.linear_to, np.sign(v) * (1 + 0.9 * np.log10(size)))

    @property
    def limits(self) -> tuple[float, float]:
        """Values at the axis's two ends, with a margin."""
        if self.names:
            return 0.5, len(self.names) + 0.5
        low, high = map(float, self.ends)
        if self.log:
            factor = (high / low) ** MARGIN if high > low else 2.0
            return low / factor, high * factor
        if self.linear_to:
            return -1.5 * max(-low, self.linear_to), 1.5 * max(high, self.linear_to)
        margin = MARGIN * (high - low) or 0.5
        return (0.0 if low == 0 else low - margin), high + margin  # counts stand on zero


Role = str
"""Meaning of a mark, which decides its colour: ``before``, ``after``, ``mark``, ``other``, ``ink``, ``zero``,
``level0`` to ``level4``, these with `` over`` where they are above a limit."""

Values = NDArray[np.floating[Any]] | Sequence[float]


@dataclass(frozen=True)
class Line:
    """Line through points (k,); it is interrupted where they are NaN."""

    x: Values
    y: Values
    role: Role
    label: str = ""
    dashed: bool = False


def segments(ends: ArrayLike) -> Array:
    """Return coordinates (3 k,) of a `Line` that consists of the segments between ends (k, 2)."""
    pairs = np.asarray(ends, dtype=float)
    return np.hstack([pairs, np.full((len(pairs), 1), np.nan)]).ravel()


@dataclass(frozen=True)
class Dots:
    """Points (k,), each with a tooltip on a page; with ``each`` the tooltips are matplotlib's legend."""

    x: Values
    y: Values
    role: Role
    label: str = ""
    hints: Sequence[str] = ()
    each: bool = False
    size: Literal["small", "middle", "large"] = "middle"
    hollow: bool = False


@dataclass(frozen=True)
class Boxes:
    """Rectangles (k,) with tooltips."""

    left: Array
    right: Array
    low: Array
    high: Array
    role: Role
    label: str = ""
    hints: Sequence[str] = ()


Mark = Line | Dots | Boxes


@dataclass(frozen=True)
class Chart:
    """Two axes and marks in drawing order; ``height`` is of a page 420 wide, ``alike`` asks for equal scales."""

    title: str
    x: Axis
    y: Axis
    marks: Sequence[Mark]
    note: str = ""
    height: int = 270
    alike: bool = False

    @property
    def legend(self) -> list[tuple[Role, str]]:
        """Roles and labels, each pair once."""
        return list(dict.fromkeys((mark.role, mark.label) for mark in self.marks if mark.label))


# --- SVG ---------------------------------------------------------------------------------------------------

WIDTH = 420
TOP = 12
RIGHT = 14
TALLEST = 400.0
"""Height of a chart with equal scales [px]."""
LETTER = 7
"""Mean width of a letter [px]."""
MANY_NAMES = 30
LONG_NAME = 12
"""Names along x are omitted where there are more, or longer ones."""
RADIUS = {"small": 2.5, "middle": 3.5, "large": 6.0}


def tag(name: str, /, *children: str, **attributes: object) -> Markup:
    """Return an element; texts and attributes are escaped, ``class_`` stands for ``class``, ``a_b`` for ``a-b``."""
    named = [Markup(' {}="{}"').format(k.strip("_").replace("_", "-"), v) for k, v in attributes.items()]
    return Markup("<{0}{1}>{2}</{0}>").format(name, Markup("").join(named), Markup("").join(children))


class Scale:
    """Pixels of an axis's values, and its ticks."""

    def __init__(self, axis: Axis):
        self.axis = axis
        self.low, self.high = axis.scaled(axis.limits)
        self.start = 0.0
        self.end = 1.0

    def __call__(self, values: ArrayLike) -> Array:
        """Return pixels; values beyond the ends are drawn at the ends."""
        inside = np.clip(self.axis.scaled(values), self.low, self.high)
        return np.round(self.start + (inside - self.low) * (self.end - self.start) / (self.high - self.low), 2)

    def ticks(self, named: bool = True) -> list[tuple[float, str]]:
        """Return values and texts of the ticks: names, decades, or steps of 1, 2 or 5."""
        axis = self.axis
        span = self.high - self.low
        if named and axis.names:
            return [(float(k), name) for k, name in enumerate(axis.names, start=1)]
        if axis.linear_to:  # zero, and to either side the end of the linear part and at most four decades
            low, high = axis.limits
            decades = int(np.floor(np.log10(max(-low, high) / axis.linear_to)))
            sizes = axis.linear_to * 10.0 ** np.arange(0, decades + 1, 1 + decades // 4)
            return [(float(v), f"{v:g}") for v in [*-sizes[::-1], 0.0, *sizes] if low <= v <= high]
        if axis.log:
            low, high = int(np.ceil(self.low)), int(np.floor(self.high))
            if span >= 1.5 and high - low >= 2:
                powers = range(low, high + 1, int(np.ceil(span / 6)))
                return [(10.0**k, f"{10.0**k:g}" if -3 <= k <= 4 else f"1e{k}") for k in powers]
            steps = [m * 10.0**k for k in range(low - 1, high + 1) for m in (1, 2, 5)]
            return [(v, f"{v:g}") for v in steps if self.low <= np.log10(v) <= self.high]
        power = 10.0 ** np.floor(np.log10(span / 5))
        step = next(m * power for m in (1, 2, 5, 10) if span / (m * power) <= 6)
        every = np.arange(np.ceil(self.low / step), np.floor(self.high / step) + 1)
        return [(float(v), f"{v:.6g}") for v in every * step + 0.0]


class Picture:
    """A chart as SVG, 420 wide and coloured by the page's style sheet through the classes of its roles."""

    def __init__(self, chart: Chart):
        self.chart = chart
        self.x = Scale(chart.x)
        self.y = Scale(chart.y)
        names = chart.x.names
        longest = max(map(len, names), default=0)
        self.named = len(names) <= MANY_NAMES and longest <= LONG_NAME
        self.upright = self.named and sum(len(name) + 1 for name in names) * LETTER > WIDTH - 80
        below = 4 + 8 * longest if self.upright else 16
        below += 24 if chart.x.label else 8
        self.x.start = 30.0 + LETTER * max((len(text) for _, text in self.y.ticks()), default=1)
        self.x.end = float(WIDTH - RIGHT)
        self.floor = float(TOP + (self._equal() if chart.alike else chart.height - below - TOP))
        self.y.start = self.floor
        self.y.end = float(TOP)
        if chart.y.names:
            self.y.start, self.y.end = self.y.end, self.y.start
        self.height = int(np.ceil(self.floor + below))

    def _equal(self) -> float:
        """Return the height of a y axis of the same scale; x becomes longer where that is too tall."""
        tall = (self.x.end - self.x.start) / (self.x.high - self.x.low) * (self.y.high - self.y.low)
        if tall <= TALLEST:
            return tall
        middle = (self.x.low + self.x.high) / 2
        half = (self.x.high - self.x.low) / 2 * tall / TALLEST
        self.x.low = middle - half
        self.x.high = middle + half
        return TALLEST

    def svg(self, *above: Markup) -> Markup:
        """Return the picture, with other elements drawn above the chart's own."""
        drawn = [item for mark in self.chart.marks for item in self._mark(mark)]
        return tag(
            "svg", *self._grid(), *drawn, *above, *self._labels(),
            viewBox=f"0 0 {WIDTH} {self.height}", role="img", aria_label=self.chart.title,
        )  # fmt: skip

    def _grid(self) -> Iterator[Markup]:
        for value, text in self.x.ticks(self.named):
            at = f"{float(self.x(value)):g}"
            if not self.chart.x.names:
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

    def _labels(self) -> Iterator[Markup]:
        middle = f"{(self.x.start + self.x.end) / 2:g}"
        yield tag("text", self.chart.x.label, x=middle, y=self.height - 6, text_anchor="middle", class_="name")
        aside = f"{(TOP + self.floor) / 2:g}"
        turned = f"rotate(-90 12 {aside})"
        yield tag("text", self.chart.y.label, x=12, y=aside, text_anchor="middle", transform=turned, class_="name")

    def _mark(self, mark: Mark) -> Iterator[Markup]:
        match mark:
            case Line():
                drawn = ""
                pen = "M"
                for a, b in zip(self.x(mark.x), self.y(mark.y), strict=True):
                    inside = np.isfinite(a + b)
                    drawn += f"{pen}{a:g},{b:g}" if inside else ""
                    pen = "L" if inside else "M"
                yield tag("path", d=drawn, class_=f"line {mark.role}" + " dashed" * mark.dashed)
            case Dots(hints=hints) if not len(hints):
                places = zip(self.x(mark.x), self.y(mark.y), strict=True)
                yield tag("path", d="".join(f"M{a:g} {b:g}h0" for a, b in places), class_=f"cloud {mark.role}")
            case Dots():
                class_ = f"dot {mark.role}" + " hollow" * mark.hollow
                for a, b, hint in zip(self.x(mark.x), self.y(mark.y), mark.hints, strict=True):
                    at = {"cx": f"{a:g}", "cy": f"{b:g}"}
                    yield tag("circle", tag("title", hint), **at, r=RADIUS[mark.size], class_=class_)
            case Boxes():
                x, y = self.x(mark.left), self.y(mark.high)
                wide = np.maximum(self.x(mark.right) - x, 0.5)
                tall = np.maximum(self.y(mark.low) - y, 0)
                for *numbers, hint in zip(x, y, wide, tall, mark.hints, strict=True):
                    size = dict(zip(("x", "y", "width", "height"), (f"{n:g}" for n in numbers), strict=True))
                    yield tag("rect", tag("title", hint), class_=f"box {mark.role}", **size)
