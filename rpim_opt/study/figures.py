"""Figures of comparisons and studies (imported only when drawing)."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from rpim_opt.basics.arrays import Array
from rpim_opt.report.plot import logarithmic

ROW_INCHES = 0.25  # height of a method
LARGEST_RATIO = 30.0  # ratios beyond are drawn at the edge, with an arrow


def picture(figure: Any, name: str, kind: str) -> bytes:
    """Return a figure as a reproducible file."""
    stream = io.BytesIO()
    metadata = {"Date": None} if kind == "svg" else None
    with rc_context({"svg.hashsalt": name}):
        figure.savefig(stream, format=kind, metadata=metadata)
    return stream.getvalue()


def distributions(values: Mapping[str, Sequence[float]], label: str) -> Any:
    """Return a logarithmic dot plot with one line per name, from top to bottom, and marked medians.

    ``values`` are positive figures by name; ``label`` says what they are, with their unit.

    >>> import rpim_opt as ro
    >>> figure = ro.study.distributions({"reml": [0.1, 0.2, 0.4], "l_curve": [0.2, 0.3, 0.9]}, "mean error [mm]")
    >>> len(figure.axes)
    1
    """
    figure = Figure(figsize=(7, 0.32 * len(values) + 0.9), layout="constrained")
    ax = figure.add_subplot()
    for y, known in enumerate(values.values()):
        dots = ax.plot(known, [y] * len(known), "o", ms=3, alpha=min(1.0, 5 / len(known) ** 0.5), color="C0", mew=0)
        dots[0].set_rasterized(len(known) > 50)  # thousands of dots would make megabytes of SVG
        middle = sorted(known)[len(known) // 2]
        ax.plot([middle], [y], "|", ms=11, mew=2, color="C3")
        ax.annotate(f"{middle:.3g}", (1.01, y), xycoords=("axes fraction", "data"), va="center", fontsize=8)
    return _finished(ax, list(values), label)


def comparison_figure(ratios: Mapping[str, Array], means: Mapping[str, Sequence[float | None]], label: str) -> Any:
    """Return the figure: methods from top to bottom, their ratios as dots, the mean with the ends of its interval."""
    figure = Figure(figsize=(7, max(ROW_INCHES * len(ratios) + 1.5, 3.5)), dpi=150, layout="constrained")
    ax = figure.add_subplot()
    ax.axvline(1, color="0.4", lw=1, zorder=1)
    for y, (method, values) in enumerate(ratios.items()):
        alpha = min(0.5, 3 / max(len(values), 1) ** 0.5)
        ax.plot(_inside(values), np.full(len(values), y), "o", ms=3.5, color="C0", alpha=alpha, mew=0, zorder=2)
        if (values > LARGEST_RATIO).any():
            ax.plot([LARGEST_RATIO], [y], ">", ms=6, color="C0", zorder=2)
        if (values < 1 / LARGEST_RATIO).any():
            ax.plot([1 / LARGEST_RATIO], [y], "<", ms=6, color="C0", zorder=2)
        mean, low, high = means[method]
        colour = "0.3"
        if low is not None and high is not None:
            if high < 1 or low > 1:
                colour = "C2" if high < 1 else "C3"
            ax.plot(_inside([low, high]), [y, y], lw=2, color=colour, zorder=3, solid_capstyle="butt")
        if mean is not None:
            ax.plot(_inside([mean]), [y], "D", ms=5, color=colour, mec="white", mew=0.6, zorder=4)
    ax.set_title("dots: replicates; marks: geometric mean, 95 % interval", fontsize=9)
    return _finished(ax, list(ratios), label)


def _inside(ratios: Any) -> Any:
    return np.clip(ratios, 1 / LARGEST_RATIO, LARGEST_RATIO)


def _finished(ax: Any, names: Sequence[str], label: str) -> Figure:
    """Return the figure of axes with named rows from top to bottom, logarithmic along x."""
    ax.set_yticks(range(len(names)), names, fontsize=8)
    ax.set_ylim(len(names) - 0.3, -0.7)
    ax.set_xlabel(label)
    ax.grid(axis="x", alpha=0.25)
    logarithmic(ax, "x")
    return ax.figure
