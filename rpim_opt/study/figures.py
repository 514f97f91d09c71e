"""Figures that several studies draw, and a mean that several state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array


def distributions(values: Mapping[str, Sequence[float]], label: str) -> Any:
    """Return a figure with one line of dots a name, logarithmic, its median marked; names from top to bottom."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    figure = Figure(figsize=(7, 0.32 * len(values) + 0.9), layout="constrained")
    ax = figure.add_subplot()
    for y, (name, found) in enumerate(reversed(list(values.items()))):
        dots = ax.semilogx(found, [y] * len(found), "o", ms=3, alpha=min(1.0, 5 / len(found) ** 0.5), color="C0", mew=0)
        dots[0].set_rasterized(len(found) > 50)  # thousands of dots would make megabytes of SVG
        middle = sorted(found)[len(found) // 2]
        ax.semilogx([middle], [y], "|", ms=11, mew=2, color="C3")
        ax.annotate(f"{middle:.3g}", (1.01, y), xycoords=("axes fraction", "data"), va="center", fontsize=8)
        ax.annotate(name, (-0.01, y), xycoords=("axes fraction", "data"), ha="right", va="center", fontsize=8)
    ax.set_yticks([])
    ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.xaxis.set_major_formatter(ScalarFormatter())
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.grid(axis="x", alpha=0.3)
    ax.set_xlabel(label)
    return figure


def geometric_mean(ratios: Sequence[float] | Array) -> float:
    """Return the mean of ratios that treats twice and half alike."""
    return float(np.exp(np.mean(np.log(ratios))))
