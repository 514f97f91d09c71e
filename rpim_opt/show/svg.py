"""Small charts in SVG, coloured by the page's style sheet, so that they follow light and dark and print sharp."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.markup import Element, tag

WIDTH = 420
TOP = 12
RIGHT = 14
TALLEST = 400.0
"""Of a chart whose axes have the same scale [px]."""


class Axis:
    """From values to places on paper: linear or logarithmic between two ends, or one place for each name."""

    def __init__(self, label: str, ends: tuple[float, float] = (0, 1), log: bool = False, names: Sequence[str] = ()):
        self.label = label
        self.log = log
        self.names = tuple(names)
        low, high = (-0.5, len(names) - 0.5) if names else (float(ends[0]), float(ends[1]))
        if log:
            low = np.log10(low)
            high = np.log10(high)
        room = 0.0 if names else 0.04 * (high - low) or 0.5
        self.low = low - room * (log or low != 0)
        self.high = high + room  # counts stand on zero
        self.start = 0.0
        self.end = 1.0

    def __call__(self, values: ArrayLike) -> Array:
        """Return the places [px]; beyond the ends they stay at the ends."""
        v = np.asarray(values, dtype=float)
        if self.log:
            v = np.log10(np.maximum(v, 10.0**self.low))
        return np.round(self.start + (np.clip(v, self.low, self.high) - self.low) * self.unit, 2)

    @property
    def unit(self) -> float:
        """Pixels of one unit of the axis."""
        return (self.end - self.start) / (self.high - self.low)

    def ticks(self) -> list[tuple[float, str]]:
        """Return value and text of the ticks: names, decades, or steps of 1, 2 or 5."""
        if self.names:
            return list(enumerate(self.names))
        if self.log:
            return self._powers()
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


def _step(span: float) -> float:
    """Return the smallest step of 1, 2 or 5 times a power of ten that makes at most six of a span."""
    power = 10.0 ** np.floor(np.log10(span / 5))
    return next(m * power for m in (1, 2, 5, 10) if span / (m * power) <= 6)


class Chart:
    """A chart with two axes; what is drawn carries a class of the style sheet and a text to show on hover.

    Parameters
    ----------
    title
        What a screen reader says.
    x, y
        The axes.
    height
        Of the whole chart [px]; it is 420 wide and scales with the page.
    """

    def __init__(self, title: str, x: Axis, y: Axis, height: int = 270):
        self.title = title
        self.x = x
        self.y = y
        self.height = height
        self.items = []
        longest = max((len(text) for _, text in y.ticks()), default=1)
        upright = sum(len(name) + 1 for name in x.names) * 7 > WIDTH - 80
        self.upright = upright and bool(x.names)
        below = 4 + 8 * max(len(name) for name in x.names) if self.upright else 16
        x.start = 30.0 + 7 * longest
        x.end = float(WIDTH - RIGHT)
        y.start = float(height - below - (24 if x.label else 8))
        y.end = float(TOP)
        if y.names:
            y.start, y.end = y.end, y.start

    def add(self, name: str, hint: str = "", **attributes: object) -> Element:
        """Draw an element, with a text to show on hover."""
        item = tag(name, *([tag("title", hint)] if hint else []), **attributes)
        self.items.append(item)
        return item

    def line(self, x: ArrayLike, y: ArrayLike, class_: str) -> None:
        """Draw a line through points."""
        places = [f"{a:g},{b:g}" for a, b in zip(self.x(x), self.y(y), strict=True)]
        self.add("path", d="M" + "L".join(places), class_=f"line {class_}")

    def cloud(self, x: ArrayLike, y: ArrayLike, class_: str) -> None:
        """Draw many points as one element."""
        places = [f"M{a:g} {b:g}h0" for a, b in zip(self.x(x), self.y(y), strict=True)]
        self.add("path", d="".join(places), class_=f"cloud {class_}")

    def dots(self, x: ArrayLike, y: ArrayLike, class_: str, hints: Sequence[str] = (), r: float = 3.5) -> None:
        """Draw points."""
        for i, (a, b) in enumerate(zip(self.x(x), self.y(y), strict=True)):
            self.add("circle", hints[i] if hints else "", cx=f"{a:g}", cy=f"{b:g}", r=r, class_=f"dot {class_}")

    def bars(self, left: ArrayLike, right: ArrayLike, top: ArrayLike, class_: str, hints: Sequence[str] = ()) -> None:
        """Draw bars from the chart's floor, between two values of x."""
        floor = self.y.start
        for i, (a, b, c) in enumerate(zip(self.x(left), self.x(right), self.y(top), strict=True)):
            size = {"x": f"{a:g}", "y": f"{c:g}", "width": f"{max(b - a, 0.5):g}", "height": f"{max(floor - c, 0):g}"}
            self.add("rect", hints[i] if hints else "", class_=f"bar {class_}", **size)

    def cell(self, x: tuple[float, float], y: tuple[float, float], class_: str, hint: str = "") -> None:
        """Draw a rectangle between two values of x and two of y."""
        left, right = self.x(x)
        bottom, top = self.y(y)
        size = {"x": f"{left:g}", "y": f"{top:g}", "width": f"{right - left:g}", "height": f"{bottom - top:g}"}
        self.add("rect", hint, class_=f"cell {class_}", **size)

    def alike(self) -> None:
        """Give both axes the same scale, and the chart the height that this takes, before anything is drawn."""
        per = (self.x.end - self.x.start) / (self.x.high - self.x.low)
        below = self.height - self.y.start
        across = per * (self.y.high - self.y.low)
        if across > TALLEST:
            middle = (self.x.low + self.x.high) / 2
            half = (self.x.high - self.x.low) / 2 * across / TALLEST
            self.x.low = middle - half
            self.x.high = middle + half
            across = TALLEST
        self.y.start = TOP + across
        self.height = int(np.ceil(self.y.start + below))

    def element(self) -> Element:
        """Return the chart."""
        grid, (x, y), floor = [], (self.x, self.y), max(self.y.start, self.y.end)
        for value, text in x.ticks():
            at = f"{float(x(value)):g}"
            if not x.names:
                grid.append(tag("line", x1=at, x2=at, y1=TOP, y2=f"{floor:g}", class_="grid"))
            turned = {"transform": f"rotate(-90 {at} {floor + 10:g})", "text_anchor": "end", "dy": "4"}
            upright = {"text_anchor": "middle", "dy": "6"}
            grid.append(
                tag("text", text, x=at, y=f"{floor + 10:g}", class_="tick", **(turned if self.upright else upright))
            )
        for value, text in y.ticks():
            at = f"{float(y(value)):g}"
            grid.append(tag("line", x1=f"{x.start:g}", x2=f"{x.end:g}", y1=at, y2=at, class_="grid"))
            grid.append(tag("text", text, x=f"{x.start - 6:g}", y=at, dy="4", text_anchor="end", class_="tick"))
        middle = f"{(TOP + floor) / 2:g}"
        labels = [
            tag(
                "text", x.label, x=f"{(x.start + x.end) / 2:g}", y=self.height - 6, text_anchor="middle", class_="name"
            ),
            tag(
                "text",
                y.label,
                x=12,
                y=middle,
                text_anchor="middle",
                transform=f"rotate(-90 12 {middle})",
                class_="name",
            ),
        ]
        box = f"0 0 {WIDTH} {self.height}"
        return tag("svg", *grid, *self.items, *labels, viewBox=box, role="img", aria_label=self.title)
