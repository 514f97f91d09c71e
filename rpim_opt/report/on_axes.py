"""Charts on matplotlib's axes, for papers and notebooks, in the colours of the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rpim_opt.report.chart import Axis, Bars, Cells, Chart, Dots, Line, Mark, Role, Segments

Axes = Any  # matplotlib's, which is imported by whoever makes the axes

COLORS = {
    "before": "#a3adb8", "after": "#1769c2", "mark": "#c8371b", "other": "#7a5bc7", "ink": "#59636e", "zero": "#a3adb8",
}  # fmt: skip
SHADES = (0.12, 0.32, 0.52, 0.74, 1.0)
SIZES = {"small": 3.5, "middle": 5.0, "large": 9.0}
SHAPES = "osD^v<>"
FONT = 7.0
"""Size of a name along x [points]; along y there is more room."""
UPRIGHT = 10.0
SMALLEST = 4.0
"""Below this names cannot be read, and are left out."""
APART = 1.25
"""Distance of names over their size."""


def on_axes(chart: Chart, ax: Axes = None) -> Axes:
    """Draw a chart on axes, by default on new ones that are as high as its names need, and return them."""
    ax = axes_of(ax, len(chart.y.names))
    _scaled(ax, "x", chart.x)
    _scaled(ax, "y", chart.y)
    for mark in chart.marks:
        _draw(ax, mark)
    if chart.alike:
        ax.set_aspect("equal")
    if chart.note:
        ax.set_xlabel(f"{ax.get_xlabel()}\n{chart.note}".strip())
    if ax.get_legend_handles_labels()[0]:
        ax.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, fontsize=8)
    return ax


def axes_of(ax: Axes, rows: int = 0, **kwargs: Any) -> Axes:
    """Return the given axes, or new ones, which are as high as so many named rows need."""
    if ax is not None:
        return ax
    from matplotlib import pyplot

    figure, ax = pyplot.subplots(layout="constrained", subplot_kw=kwargs)
    figure.set_figheight(max(figure.get_figheight(), 0.2 * rows + 1.2))
    return ax


def color_of(role: Role) -> Any:
    """Return the colour that stands for a role."""
    level = role.removesuffix(" over")
    if not level.startswith("level"):
        return COLORS[role]
    from matplotlib.colors import to_rgb

    full = np.array(to_rgb(COLORS["mark" if level != role else "after"]))
    return tuple(1 - SHADES[int(level[-1])] * (1 - full))


def _scaled(ax: Axes, which: str, axis: Axis) -> None:
    if axis.log:
        ax.set(**{f"{which}scale": "log"})
    if axis.linear_to:
        getattr(ax, f"set_{which}scale")("symlog", linthresh=axis.linear_to)
    if axis.log or axis.linear_to:
        getattr(ax, f"{which}axis").set_major_formatter("{x:g}")  # 0.1 in the place of powers of ten
    limits = axis.limits
    if axis.names:
        _name(ax, which, axis.names)
        if which == "y":
            limits = limits[::-1]
    ax.set(**{f"{which}lim": limits, f"{which}label": axis.label})


def _name(ax: Axes, which: str, names: Sequence[str]) -> None:
    """Write names at 1, 2, ... where there is room for letters that can be read."""
    box = ax.get_window_extent()
    room, largest = (box.width, FONT) if which == "x" else (box.height, UPRIGHT)
    size = room * 72 / ax.figure.dpi / (APART * len(names))
    if size < SMALLEST:
        return
    turned = 90 if which == "x" and len(names) > 3 else 0
    ticks = range(1, len(names) + 1)
    getattr(ax, f"set_{which}ticks")(ticks, names, fontsize=max(min(size, largest), SMALLEST), rotation=turned)


def _draw(ax: Axes, mark: Mark) -> None:
    color = color_of(mark.role)
    match mark:
        case Line():
            ax.plot(mark.x, mark.y, color=color, lw=1.5, ls="--" if mark.dashed else "-", label=mark.label)
        case Segments():
            gaps = np.full((len(mark.x), 1), np.nan)
            x = np.hstack([mark.x, gaps]).ravel()
            ax.plot(x, np.hstack([mark.y, gaps]).ravel(), color=color, lw=1.2, label=mark.label)
        case Dots(each=True):
            for k, (x, y, hint) in enumerate(zip(mark.x, mark.y, mark.hints, strict=True)):
                style = {"marker": SHAPES[k % len(SHAPES)], "mfc": "none", "mew": 1.6, "ms": 8}  # one shows another
                ax.plot([x], [y], ls="none", color=f"C{k}", label=hint, **style)
        case Dots():
            fill = "none" if mark.hollow else color
            size = SIZES[mark.size] if len(mark.hints) else 2.0
            ax.plot(mark.x, mark.y, "o", color=color, mfc=fill, ms=size, label=mark.label)
        case Bars():
            width = np.subtract(mark.right, mark.left)
            ax.bar(mark.left, mark.top, width, align="edge", color=color, alpha=0.85, label=mark.label)
        case Cells():
            from matplotlib.collections import PatchCollection
            from matplotlib.patches import Rectangle

            cells = [Rectangle(tuple(corner), *mark.size) for corner in mark.corners]
            ax.add_collection(PatchCollection(cells, facecolor=color, edgecolor="none"))
