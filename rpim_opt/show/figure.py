"""What every figure has: axes, a legend, labels that do not overlap, and colours of before and after."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

Axes = Any  # matplotlib's, which is imported by whoever makes the axes


BEFORE = "0.75"


AFTER = "C0"


MARK = "C3"


FONT = 7.0
"""Size of a label of a row [points]."""


SMALLEST = 4.0
"""Below this labels of rows cannot be read, and are left out."""


APART = 1.25
"""Distance of labels over their size."""


def axes_of(ax: Axes, rows: int = 0, **kwargs: Any) -> Axes:
    """Return the given axes, or new ones, which are as high as so many labelled rows need."""
    if ax is not None:
        return ax
    from matplotlib import pyplot

    figure, ax = pyplot.subplots(layout="constrained", subplot_kw=kwargs)
    figure.set_figheight(max(figure.get_figheight(), 0.2 * rows + 1.2))
    return ax


def label_rows(axis: Axes, labels: Sequence[str], room: float, largest: float = FONT) -> bool:
    """Write a label at every place 0, 1, ... of an axis of so many points, and return whether there is room."""
    size = room / (APART * max(len(labels), 1))
    if size < SMALLEST:
        return False
    axis.set_ticks(range(len(labels)), labels, fontsize=min(size, largest))
    return True


def extent(ax: Axes) -> tuple[float, float]:
    """Return width and height of axes [points]."""
    box = ax.get_window_extent()
    point = ax.figure.dpi / 72
    return box.width / point, box.height / point


def in_millimetres(axis: Axes) -> None:
    """Write 0.1 in the place of powers of ten."""
    axis.set_major_formatter("{x:g}")


def legend_above(ax: Axes) -> Axes:
    """Put the legend above the axes, where it hides nothing."""
    ax.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, fontsize=8)
    return ax
