"""Figures of comparisons and of studies; it is imported where one is drawn."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, NullLocator, ScalarFormatter, StrMethodFormatter

from rpim_opt.basics.arrays import Array
from rpim_opt.study.ranking import Standing, Summary, figures, profiles

ROW_INCHES = 0.25
"""Height of a method."""
LARGEST_RATIO = 30.0
"""Ratios beyond are drawn at the edge, with an arrow."""
NAMED_PROFILES = 6
"""Methods with a profile of their own; the others are grey."""
LARGEST_PROFILE_RATIO = 10.0
"""End of the axis of the profiles; less where all that are named are done before."""


def picture(figure: Any, name: str, kind: str) -> bytes:
    """Return a figure as a file: the same bytes for the same figure."""
    stream = io.BytesIO()
    metadata = {"Date": None} if kind == "svg" else None
    with rc_context({"svg.hashsalt": name}):
        figure.savefig(stream, format=kind, metadata=metadata)
    return stream.getvalue()


def distributions(values: Mapping[str, Sequence[float]], label: str) -> Any:
    """Return a figure with one line of dots a name, logarithmic, its median marked; names from top to bottom.

    Parameters
    ----------
    values
        Positive figures by name.
    label
        What they are, with their unit.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> figure = ro.study.distributions({"reml": [0.1, 0.2, 0.4], "l_curve": [0.2, 0.3, 0.9]}, "mean error [mm]")
    >>> len(figure.axes)
    1
    """
    figure = Figure(figsize=(7, 0.32 * len(values) + 0.9), layout="constrained")
    ax = figure.add_subplot()
    for y, (name, known) in enumerate(reversed(list(values.items()))):
        dots = ax.semilogx(known, [y] * len(known), "o", ms=3, alpha=min(1.0, 5 / len(known) ** 0.5), color="C0", mew=0)
        dots[0].set_rasterized(len(known) > 50)  # thousands of dots would make megabytes of SVG
        middle = sorted(known)[len(known) // 2]
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


def comparison_figure(rows: Sequence[Mapping[str, Any]], summary: Summary) -> Any:
    """Return the figure: methods from best to worst, and what share of replicates each is near the best of."""
    height = max(ROW_INCHES * len(summary.standings) + 1.5, 3.5)
    figure = Figure(figsize=(11, height), dpi=150, layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.5, 1))
    _ratios(left, rows, summary)
    _profiles(right, rows, summary)
    return figure


def _ratios(ax: Any, rows: Sequence[Mapping[str, Any]], summary: Summary) -> None:
    """Draw every replicate's ratio as a dot, and the mean with its interval."""
    of = figures(rows, summary.metric)
    other = of[summary.reference]
    top = len(summary.standings) - 1
    ax.axvline(1, color="0.4", lw=1, zorder=1)
    for k, each in enumerate(summary.standings):
        own = of[each.method]
        ratios = np.array([own[pair] / other[pair] for pair in own if other.get(pair)])
        alpha = min(0.5, 3 / max(len(ratios), 1) ** 0.5)
        ax.plot(_inside(ratios), np.full(len(ratios), top - k), "o", ms=3.5, color="C0", alpha=alpha, mew=0, zorder=2)
        for edge, beyond, turn in (
            (LARGEST_RATIO, ratios > LARGEST_RATIO, ">"),
            (1 / LARGEST_RATIO, ratios < 1 / LARGEST_RATIO, "<"),
        ):
            if beyond.any():
                ax.plot([edge], [top - k], turn, ms=6, color="C0", zorder=2)
        _mean(ax, each, top - k, each.method == summary.reference)
    ax.set_yticks(range(top + 1), [each.method for each in reversed(summary.standings)], fontsize=8)
    ax.set_ylim(-0.7, top + 0.7)
    ax.set_xscale("log")
    _round_ticks(ax)
    ax.grid(axis="x", alpha=0.25)
    ax.set_xlabel(f"{summary.metric} over that of {summary.reference}, same replicate")
    ax.set_title("dots: replicates; marks: geometric mean, 95 % interval", fontsize=9, color="0.3")


def _inside(ratios: Any) -> Array:
    return np.clip(ratios, 1 / LARGEST_RATIO, LARGEST_RATIO)


def _mean(ax: Any, each: Standing, y: int, reference: bool) -> None:
    if each.ratio is None:
        return
    colour = "0.3"
    if each.different:
        colour = "C2" if each.ratio < 1 else "C3"
    if each.low is not None and each.high is not None and not reference:
        ends = _inside([each.low, each.high])
        ax.plot(ends, [y, y], "-", lw=2, color=colour, zorder=3, solid_capstyle="butt")
    ax.plot(_inside([each.ratio]), [y], "D", ms=5, color=colour, mec="white", mew=0.6, zorder=4)


def _profiles(ax: Any, rows: Sequence[Mapping[str, Any]], summary: Summary) -> None:
    """Draw what share of replicates is within a ratio of the best method's figure."""
    of = profiles(rows, summary.metric)

    def area(name: str) -> float:  # below the logarithm of the ratio
        return float(np.mean(np.maximum(np.log(LARGEST_PROFILE_RATIO) - np.log(of[name]), 0)))

    ranked = sorted(of, key=area, reverse=True)
    for name in reversed(ranked[NAMED_PROFILES:]):
        _step(ax, of[name], color="0.85", lw=0.8)
    for k, name in enumerate(ranked[:NAMED_PROFILES]):
        _step(ax, of[name], color=f"C{k}", lw=1.6, label=name)
    finite = np.concatenate([of[name][np.isfinite(of[name])] for name in ranked[:NAMED_PROFILES]])
    ax.set_xscale("log")
    ax.set_xlim(1, float(np.clip(1.1 * finite.max(initial=1.0), 1.2, LARGEST_PROFILE_RATIO)))
    ax.set_ylim(0, 1.02)
    _round_ticks(ax)
    ax.grid(alpha=0.25)
    ax.set_xlabel("ratio to the best method of the replicate")
    ax.set_ylabel("share of replicates within that ratio")
    others = len(ranked) - NAMED_PROFILES
    ax.legend(frameon=False, fontsize=8, loc="lower right")
    title = "performance profiles"
    if others > 0:
        title += f" (the best {NAMED_PROFILES}; grey: {others} others)"
    ax.set_title(title, fontsize=9, color="0.3")


def _step(ax: Any, over: Any, **style: Any) -> None:
    share = np.arange(1, len(over) + 1) / len(over)
    finite = np.isfinite(over)
    x = np.concatenate([[1.0], over[finite], [LARGEST_PROFILE_RATIO]])
    y = np.concatenate([[0.0], share[finite], share[finite][-1:] if finite.any() else [0.0]])
    ax.step(x, y, where="post", **style)


def _round_ticks(ax: Any) -> None:
    """Mark ratios by numbers that people say."""
    low, high = ax.get_xlim()
    subs: Any = [k / 10 for k in range(10, 100)]
    if high / low > 3:
        subs = (1, 2, 5)
    elif high / low > 1.6:
        subs = (1, 1.2, 1.5, 2, 2.5, 3, 5, 6, 7, 8, 9)
    ax.xaxis.set_major_locator(LogLocator(subs=subs))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
