"""Figures of a calibration on matplotlib axes: each is drawn on ``ax`` or on new axes, and returns them.

The report's charts are the same figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, NoSolutionFound
from rpim_opt.basics.units import display
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import TransmissionError, Uncertainty
from rpim_opt.convex.constraints import within_tolerance
from rpim_opt.convex.program import Program
from rpim_opt.convex.rules.selection import weight_grid
from rpim_opt.data.dataset import Dataset

if TYPE_CHECKING:
    from rpim_opt.use.monitoring import Monitoring

__all__ = ["errors", "l_curve", "parameters"]

Axes = Any  # matplotlib's, imported where axes are made
COLORS = {"before": "#a3adb8", "after": "#1769c2", "mark": "#c8371b", "ink": "#59636e"}
"""Colours by meaning, as in the page's style sheet, which has others for dark mode."""
CLOSE = 3.0  # ratio of an axis's ends below which a logarithmic axis has ticks like a linear one
MANY_DOTS = 1000  # Dots above which they become one bitmap in a vector graphic.
FONT_X, FONT_Y, FONT_LEAST = 0.75, 1.0, 6.0
"""Largest sizes of names along x and y, relative to the axis's label, and the smallest legible one [points]."""
LINE_HEIGHT = 1.25  # line spacing of names over their size
MANY_ROWS = 100  # above it, each row is a small point without a name
TIMES = ((86400.0, "days"), (3600.0, "hours"), (1.0, "seconds"))  # units of an axis of time [s]
CELLS, FAINT = 24, "#dce8f5"  # of a map: cells along the longer side, and the colour of the least value
VIEWS = {"from above": (0, 1), "from the side": (0, 2)}  # axes to the right and up
VANISHED = 1e-4  # penalties below this part of the median are not drawn: a lasso has no deviation left there


def errors(result: Calibration, data: Dataset | None = None, ax: Axes = None) -> Axes:
    """Draw every row's error [mm] before and after calibration; flagged rows of the identification data are marked.

    By default the rows are those of the identification data, and the axes are new.

    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> result = ro.calibrate(instance.problem, ro.tikhonov, weight=ro.l_curve)
    >>> ax = ro.plot.errors(result, instance.validation)
    >>> ax.get_ylabel(), len(ax.get_xticks())
    ('error [mm]', 16)
    """
    ax = _axes(ax)
    data = data or result.problem.data
    after = 1e3 * result.errors(data)
    finite = np.flatnonzero(np.isfinite(after))  # rows that measure a length
    labels = [data.label[i] for i in finite]
    both = np.array([1e3 * result.nominal_errors(data)[finite], after[finite]])
    low = max(0.5 * float(both.min()), 1e-4 * float(both.max()), 1e-7)
    before, after = np.maximum(both, low)
    place = np.arange(1.0, len(labels) + 1)
    few = len(labels) <= MANY_ROWS
    if few:
        ax.vlines(place, before, after, color=COLORS["before"])
    for when, model, each in (("before", "nominal", before), ("after", "identified", after)):
        _dots(ax, place, each, when, model, ms=2.0 + 3.0 * few)
    flagged = {flag.label for flag in result.flagged if data is result.problem.data}
    at = [i for i, label in enumerate(labels) if label in flagged]
    if at:
        _dots(ax, place[at], after[at], "mark", "flagged")
    ax.set(xlabel="row", ylabel="error [mm]")
    if few:
        _name(ax, "x", labels)
    logarithmic(ax, "y")
    return _with_legend(ax)


def parameters(result: Calibration, dimension: str = "length", ax: Axes = None) -> Axes:
    """Draw the deviations of the robot's parameters of a dimension with their 95 % intervals and tolerances.

    The dimension is ``length`` [mm], ``angle`` [deg], ``ratio`` [ppm] or ``compliance`` [mrad/Nm]. Intervals exist
    where the formulation has a covariance.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot.parameters(result, "angle")
    >>> ax.get_xlabel(), len(ax.get_yticks())
    ('deviation from nominal [deg]', 13)
    """
    free = result.problem.parameters.free
    own = np.flatnonzero(~free.of_frames & ~free.of_curves & (np.array(free.dimensions) == dimension))
    ax = _axes(ax, len(own))
    unit, si = display(dimension)
    x = result.x[own] / si
    spread, legend = np.zeros(len(own)), "deviation"
    with suppress(InputError):
        spread = np.nan_to_num(Uncertainty(result).expanded[own] / si, posinf=0.0)
        legend = "deviation, 95 % interval"
    bound = active_tolerance(result)[own] / si
    bounded = np.isfinite(bound)
    place = np.arange(1.0, len(own) + 1)
    ax.axvline(0, color=COLORS["before"], lw=1)
    ax.hlines(place, x - spread, x + spread, color=COLORS["after"])
    _dots(ax, x, place, "after", legend)
    if bounded.any():
        ends = np.concatenate([-bound[bounded], bound[bounded]])
        at = np.tile(place[bounded], 2)
        ax.vlines(ends, at - 0.35, at + 0.35, color=COLORS["mark"], label="tolerance")
    # a very long interval would hide all others: it is cut at the edge
    middle = np.median(np.abs(x) + spread) if len(x) else 0.0
    reach = 1.1 * max([1e-9, *np.abs(x), *bound[bounded], middle])
    cut = "\nIntervals beyond the axis are clipped." * bool((np.abs(x) + spread > reach).any())
    ax.set(xlim=(-reach, reach), xlabel=f"deviation from nominal [{unit}]{cut}")
    _name(ax, "y", [free.names[i] for i in own])
    return _with_legend(ax)


def transmission_error(curve: TransmissionError, factor: float, largest: float, ax: Axes) -> None:
    """Draw a joint's transmission error with its interval, of a coverage factor, up to a largest value [rad]."""
    at, error, half = np.degrees(curve.q), 1e3 * curve.error, 1e3 * factor * curve.standard
    low, high = np.degrees(curve.measured)
    ax.axvspan(low, high, color=COLORS["before"], alpha=0.2, lw=0, label="measured")
    ax.fill_between(at, error - half, error + half, color=COLORS["after"], alpha=0.3, lw=0, label="95 % interval")
    ax.plot(at, error, color=COLORS["after"], lw=1.2, label="error")
    ax.set(xlabel=f"{curve} [deg]", ylabel="error [mrad]", xlim=(at[0], at[-1]))
    ax.set_ylim(-1e3 * largest, 1e3 * largest)
    _with_legend(ax)


def active_tolerance(result: Calibration) -> Array:
    """Return the tolerances (n,) [SI] that constrain the formulation; infinite where it has none."""
    tolerance = result.problem.parameters.free.tolerance
    if any(each is within_tolerance for each in result.formulation.constraints):
        return tolerance
    return np.full(len(tolerance), np.inf)


def l_curve(of: Program | Calibration, ax: Axes = None) -> Axes:
    """Draw the L-curve: root of the penalty against root of the loss over the weight; that of a result is marked.

    The program is solved at 200 weights with a closed form, otherwise at 40; InputError without a penalty.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot.l_curve(result)
    >>> print(ax.get_legend().get_texts()[0].get_text())
    chosen: reml, weight 1.5
    """
    program: Any = getattr(of, "program", of)

    def at(weight: float) -> list[Array]:
        """Return the curve's point at a weight, or none: far from the chosen one a solver may fail."""
        with suppress(NoSolutionFound):
            (each,) = program.path([weight])
            return [np.sqrt([each.loss, each.penalty])]
        return []

    weights = weight_grid(program, 200 if program.closed_form else 40)
    curve = np.array([point for weight in weights for point in at(weight)])
    ax = _axes(ax)
    residual, solution = curve[curve[:, 1] > VANISHED * float(np.median(curve[:, 1]))].T
    ax.plot(residual, solution, color=COLORS["ink"], lw=1.5)
    if isinstance(of, Calibration):
        for x, y in at(of.weight):
            _dots(ax, [x], [y], "mark", f"chosen: {of.selector}, weight {of.weight:.2g}")
    norms = "residual norm [standard deviations of the noise]", "deviation norm [prior standard deviations]"
    ax.set(xlabel="root of the loss" if program.loss_form is None else norms[0])
    ax.set(ylabel="root of the penalty" if program.penalty_form is None else norms[1])
    logarithmic(ax, "x")
    logarithmic(ax, "y")
    return _with_legend(ax)


def uncertainty_map(at: Array, bound: Array, box: Array | None, limit: float, view: str, ax: Axes) -> None:
    """Draw a map of the expanded uncertainties (N,) at positions (N, 3), all in mm, as a `VIEWS` sees it.

    Each cell has the largest one of its positions; it is red above the limit. A box (3, 2) is drawn as a frame.
    """
    from matplotlib.colors import LinearSegmentedColormap

    across, up = VIEWS[view]
    plane = at[:, [across, up]].T
    extent = np.ptp(plane, axis=1)
    count = np.maximum(np.ceil(extent / (extent.max() / CELLS) - 1e-9), 1).astype(int)
    grid, x, y, _ = scipy.stats.binned_statistic_2d(*plane, bound, "max", bins=count.tolist())
    high = float(bound.max())
    top = min(high, limit)
    colours = LinearSegmentedColormap.from_list("U", [FAINT, COLORS["after"]]).with_extremes(over=COLORS["mark"])
    drawn = ax.pcolormesh(x, y, grid.T, cmap=colours, vmin=min(float(bound.min()), 0.9 * top), vmax=top)
    said = {"label": "U [mm], above the limit in red", "extend": "max"} if high > top else {"label": "U [mm]"}
    ax.figure.colorbar(drawn, ax=ax, location="bottom", **said)
    if box is not None:
        (a, b), (c, d) = box[across], box[up]
        ax.plot([a, b, b, a, a], [c, c, d, d, c], color=COLORS["ink"])
    ax.set(xlabel=f"{'xyz'[across]} [mm]", ylabel=f"{'xyz'[up]} [mm]", aspect="equal")


def checks(found: Monitoring, ax: Axes, sums: bool = False) -> None:
    """Draw every check, or their cumulative sum (CUSUM), against its limit."""
    place, along = np.arange(1, len(found.label) + 1, dtype=float), "check"
    if found.when is not None and np.ptp(found.when) > 0:
        unit, name = next((size, name) for size, name in TIMES if np.ptp(found.when) > 2 * size or size == 1)
        place, along = (found.when - found.when[0]) / unit, f"{name} since the first check"
    values, allowed, name, what = found.sigmas, found.allowed, "check", "residual [standard deviations]"
    marked = None
    if sums:  # the first one alone is marked
        values, allowed, name, what = found.sums, np.full(len(place), found.limit), "sum", "cumulative sum"
        marked = 1
    beyond = np.flatnonzero(values > allowed)[:marked]
    ax.plot(place, allowed, color=COLORS["mark"], lw=1.5, label="limit")
    ax.plot(place, values, color=COLORS["after"], lw=0.8)
    _dots(ax, place, values, "after", name)
    _dots(ax, place[beyond], values[beyond], "mark")
    ax.set(xlabel=along, ylabel=what)
    ax.set_ylim(bottom=0)
    _with_legend(ax)


def _axes(ax: Axes, rows: int = 0) -> Axes:
    """Return the axes, or new ones that are as high as names of rows need."""
    if ax is not None:
        return ax
    from matplotlib import pyplot

    figure, ax = pyplot.subplots(layout="constrained")
    figure.set_figheight(max(figure.get_figheight(), 0.2 * rows + 1.2))
    return ax


def _dots(ax: Axes, x: Any, y: Any, role: str, label: str = "", ms: float = 5.0) -> None:
    ax.plot(x, y, "o", color=COLORS[role], label=label, ms=ms, rasterized=len(x) > MANY_DOTS)


def logarithmic(ax: Axes, which: str) -> None:
    """Make an axis logarithmic, with as many ticks per power of ten as it has room for."""
    from matplotlib.ticker import LogLocator, MaxNLocator

    ax.set(**{f"{which}scale": "log"})
    low, high = getattr(ax, f"get_{which}lim")()
    axis = getattr(ax, f"{which}axis")
    powers = np.floor(np.log10(high)) - np.ceil(np.log10(low)) + 1
    axis.set_major_locator(MaxNLocator(6) if high / low < CLOSE else LogLocator(subs=(1, 2, 5) if powers < 3 else (1,)))
    axis.set_major_formatter("{x:g}")
    axis.minorticks_off()


def _name(ax: Axes, which: str, names: Sequence[str]) -> None:
    """Name the places 1, 2, ... along an axis, from top to bottom; of rows so many that the names can be read."""
    box = ax.get_window_extent()
    first, last = 0.5, len(names) + 0.5
    limits, length, largest, least, turned = (last, first), box.height, FONT_Y, 0.0, 0
    if which == "x":
        limits, length, largest, least = (first, last), box.width, FONT_X, FONT_LEAST
        turned = 90 * (len(names) > 3)
    size = length * 72 / ax.figure.dpi / (LINE_HEIGHT * max(len(names), 1))
    step = max(int(np.ceil(least / size)), 1)
    size = min(step * size, largest * ax.xaxis.label.get_fontsize())
    ticks = range(1, len(names) + 1, step)
    getattr(ax, f"set_{which}ticks")(ticks, list(names[::step]), fontsize=size, rotation=turned)
    ax.set(**{f"{which}lim": limits})


def _with_legend(ax: Axes) -> Axes:
    """Draw the legend above the axes in as many columns as there is width for, and return the axes."""
    labels = ax.get_legend_handles_labels()[1]
    if labels:
        width = 72 * ax.figure.get_figwidth() / ax.xaxis.label.get_fontsize()
        columns = max(1, int(width / (4 + 0.5 * max(map(len, labels)))))
        place = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "borderaxespad": 0.1}
        ax.legend(frameon=False, ncols=columns, fontsize="small", **place)
    return ax
