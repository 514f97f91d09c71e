"""The figure of a comparison: errors over those of the reference in pairs, and performance profiles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.study.pairs import figures, profiles
from rpim_opt.study.standing import Standing, Summary

ROW = 0.25
"""Inches a method."""
FARTHEST = 30.0
"""Ratios beyond are drawn at the edge, with an arrow."""
SHOWN = 6
"""Methods with a profile of their own; the others are grey."""
BROADEST = 10.0
"""Largest ratio of the profiles; less where all that are named are done before."""


def drawn(rows: Sequence[Mapping[str, Any]], summary: Summary) -> Any:
    """Return the figure: methods from best to worst, and what share of replicates each is near the best of."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise InputError("plot", "no package matplotlib", "pip install 'rpim-opt[plots]'") from None
    height = max(ROW * len(summary.standings) + 1.5, 3.5)
    figure = Figure(figsize=(11, height), layout="constrained")
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
        _dots(ax, ratios, top - k)
        _mean(ax, each, top - k, each.method == summary.reference)
    ax.set_yticks(range(top + 1), [each.method for each in reversed(summary.standings)], fontsize=8)
    ax.set_ylim(-0.7, top + 0.7)
    ax.set_xscale("log")
    _round_ticks(ax)
    ax.grid(axis="x", alpha=0.25)
    ax.set_xlabel(f"{summary.metric} over that of {summary.reference}, same replicate")
    ax.set_title("dots: replicates; marks: geometric mean, 95 % interval", fontsize=9, color="0.3")


def _dots(ax: Any, ratios: Any, y: int) -> None:
    inside = np.clip(ratios, 1 / FARTHEST, FARTHEST)
    alpha = min(0.5, 3 / max(len(ratios), 1) ** 0.5)
    ax.plot(inside, np.full(len(inside), y), "o", ms=3.5, color="C0", alpha=alpha, mew=0, zorder=2)
    for edge, beyond, turn in ((FARTHEST, ratios > FARTHEST, ">"), (1 / FARTHEST, ratios < 1 / FARTHEST, "<")):
        if beyond.any():
            ax.plot([edge], [y], turn, ms=6, color="C0", zorder=2)


def _mean(ax: Any, each: Standing, y: int, reference: bool) -> None:
    if each.ratio is None:
        return
    colour = "0.3"
    if each.different:
        colour = "C2" if each.ratio < 1 else "C3"
    at = float(np.clip(each.ratio, 1 / FARTHEST, FARTHEST))
    if each.low is not None and each.high is not None and not reference:
        ends = np.clip([each.low, each.high], 1 / FARTHEST, FARTHEST)
        ax.plot(ends, [y, y], "-", lw=2, color=colour, zorder=3, solid_capstyle="butt")
    ax.plot([at], [y], "D", ms=5, color=colour, mec="white", mew=0.6, zorder=4)


def _profiles(ax: Any, rows: Sequence[Mapping[str, Any]], summary: Summary) -> None:
    """Draw what share of replicates is within a ratio of the best method's figure."""
    of = profiles(rows, summary.metric)
    ranked = sorted(of, key=lambda name: -_area(of[name]))
    for name in reversed(ranked[SHOWN:]):
        _step(ax, of[name], color="0.85", lw=0.8)
    for k, name in enumerate(ranked[:SHOWN]):
        _step(ax, of[name], color=f"C{k}", lw=1.6, label=name)
    ax.set_xscale("log")
    ax.set_xlim(1, _end([of[name] for name in ranked[:SHOWN]]))
    ax.set_ylim(0, 1.02)
    _round_ticks(ax)
    ax.grid(alpha=0.25)
    ax.set_xlabel("ratio to the best method of the replicate")
    ax.set_ylabel("share of replicates within that ratio")
    others = len(ranked) - SHOWN
    ax.legend(frameon=False, fontsize=8, loc="lower right")
    title = "performance profiles"
    if others > 0:
        title += f" (the best {SHOWN}; grey: {others} others)"
    ax.set_title(title, fontsize=9, color="0.3")


def _area(over: Any) -> float:
    """Return the mean height of a profile over the logarithm of the ratio."""
    return float(np.mean(np.maximum(np.log(BROADEST) - np.log(over), 0)))


def _end(named: Sequence[Any]) -> float:
    """Return where the axis of the profiles ends: a little beyond the last step of those that are named."""
    finite = np.concatenate([over[np.isfinite(over)] for over in named])
    return float(np.clip(1.1 * finite.max(initial=1.0), 1.2, BROADEST))


def _step(ax: Any, over: Any, **style: Any) -> None:
    share = np.arange(1, len(over) + 1) / len(over)
    finite = np.isfinite(over)
    x = np.concatenate([[1.0], over[finite], [BROADEST]])
    y = np.concatenate([[0.0], share[finite], share[finite][-1:] if finite.any() else [0.0]])
    ax.step(x, y, where="post", **style)


def _round_ticks(ax: Any) -> None:
    """Mark ratios by numbers that people say."""
    from matplotlib.ticker import LogLocator, NullFormatter, NullLocator, StrMethodFormatter

    low, high = ax.get_xlim()
    if high / low > 3:
        ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    else:
        ax.xaxis.set_major_locator(LogLocator(subs=[k / 10 for k in range(10, 100)]))
    if 1.6 < high / low <= 3:
        ax.xaxis.set_major_locator(LogLocator(subs=(1, 1.2, 1.5, 2, 2.5, 3, 5, 6, 7, 8, 9)))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
