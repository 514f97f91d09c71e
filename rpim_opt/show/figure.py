"""What every figure has: axes, a legend, and colours of before and after."""

from __future__ import annotations

from typing import Any

Axes = Any  # matplotlib's, which is imported by whoever makes the axes


BEFORE = "0.75"


AFTER = "C0"


MARK = "C3"


def axes_of(ax: Axes, **kwargs: Any) -> Axes:
    """Return the given axes, or new ones."""
    if ax is not None:
        return ax
    from matplotlib import pyplot

    return pyplot.subplots(layout="constrained", subplot_kw=kwargs)[1]


def legend_above(ax: Axes) -> Axes:
    """Put the legend above the axes, where it hides nothing."""
    ax.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, fontsize=8)
    return ax
