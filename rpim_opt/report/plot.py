"""Figures on matplotlib axes, for papers and notebooks: each draws on ``ax`` or on new axes, and returns them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import Uncertainty
from rpim_opt.convex.program import Program
from rpim_opt.convex.rules.selection import Selection, weight_grid
from rpim_opt.convex.select import compare
from rpim_opt.data.dataset import Dataset
from rpim_opt.report import charts
from rpim_opt.report.chart import Axis, Boxes, Chart, Dots, Line, Mark

__all__ = [
    "error_axes", "error_histogram", "error_vectors", "errors", "l_curve", "parameters", "picard", "selection",
    "selectors",
]  # fmt: skip

Axes = Any  # matplotlib's, which is imported by whoever makes the axes


def errors(result: Calibration, data: Dataset | None = None, ax: Axes = None) -> Axes:
    """Draw every row's error [mm] before and after calibration; flagged rows of the identification data are marked.

    The rows are those of the identification data, and the axes new ones, unless others are given.

    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> result = ro.calibrate(instance.problem, ro.tikhonov, weight=ro.l_curve)
    >>> ax = ro.plot.errors(result, instance.validation)
    >>> ax.get_ylabel(), len(ax.get_xticks())
    ('error [mm]', 16)
    """
    return draw(charts.rows_chart(result, data or result.problem.data), ax)


def error_histogram(result: Calibration, data: Dataset | None = None, ax: Axes = None) -> Axes:
    """Draw a histogram of the errors [mm] before and after calibration. Arguments as for `errors`.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot.error_histogram(result)
    >>> ax.get_xlabel(), ax.get_xscale()
    ('error [mm]', 'log')
    """
    return draw(charts.histogram_chart(charts.lengths_of(result, data or result.problem.data)[0]), ax)


def error_axes(result: Calibration, data: Dataset | None = None, ax: Axes = None) -> Axes:
    """Draw mean (dot) and central 95 % (line) of the errors [mm] along x, y and z. Arguments as for `errors`.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot.error_axes(result)
    >>> [label.get_text() for label in ax.get_xticklabels()]
    ['x', 'y', 'z']
    """
    return draw(charts.axes_chart(result, data or result.problem.data), ax)


def error_vectors(result: Calibration, data: Dataset | None = None, nominal: bool = False, ax: Axes = None) -> Axes:
    """Draw measured positions [m] with their error vectors, of the identified or of the nominal model, in 3D.

    The title says how they are enlarged. Arguments as for `errors`.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ro.plot.error_vectors(result, nominal=True).get_title()
    'nominal errors, enlarged 100 times'
    """
    ax = _axes(ax, projection="3d")
    points = result.measured_positions(data)
    vectors = result.error_vectors(data, nominal=nominal)
    finite = np.isfinite(vectors).all(axis=1)
    points, vectors = points[finite], vectors[finite]
    times = charts.magnification(points, vectors)
    when = "before" if nominal else "after"
    width = 0.5 if len(points) > charts.MANY_ROWS else 1.5
    ax.scatter(*points.T, s=6, color="0.3")
    ax.quiver(*points.T, *(times * vectors).T, color=COLORS[when], lw=width, arrow_length_ratio=0.2)
    ax.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", aspect="equal")
    ax.set_title(f"{charts.MODELS[when]} errors, enlarged {times:,.0f} times", fontsize=9)
    return ax


def parameters(result: Calibration, dimension: str = "length", confidence: float = 0.95, ax: Axes = None) -> Axes:
    """Draw the deviations of the robot's own parameters of a dimension with their intervals and tolerances.

    The dimension is ``length`` [mm], ``angle`` [deg], ``ratio`` [ppm] or ``compliance`` [mrad/Nm]. Intervals exist for
    a squared penalty, or none.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot.parameters(result, "angle")
    >>> ax.get_xlabel(), len(ax.get_yticks())
    ('deviation from nominal [deg]', 13)
    """
    half = np.full(len(result.x), np.nan)
    if result.linear_penalty:
        half = np.diff(Uncertainty(result, confidence).intervals())[:, 0] / 2
    return draw(charts.deviations_chart(result, dimension, half, confidence), ax)


def l_curve(of: Program | Calibration, selections: Mapping[str, Selection] | None = None, ax: Axes = None) -> Axes:
    """Draw the L-curve: root of the penalty against root of the loss over the weight, with the selectors' choices.

    The program is solved at 200 weights where it has a closed form, else at 40; InputError without a penalty. The
    weight of a result is marked, and the choices that are given by name.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot.l_curve(result)
    >>> print(ax.get_legend().get_texts()[0].get_text())
    chosen: reml, weight 1.5
    >>> ax.get_xlabel()
    'residual norm [standard deviations of the noise]'
    >>> ax.figure.savefig("l_curve.pdf")
    """
    program = _program(of)
    marked = {name: choice.weight for name, choice in (selections or {}).items()}
    if isinstance(of, Calibration) and of.selector not in marked:
        marked = {of.selector: of.weight, **marked}
    path = program.path(weight_grid(program, 200 if program.closed_form else 40))
    residual, solution = np.sqrt([[e.loss, e.penalty] for e in path]).T
    chosen: dict[str, tuple[float, float]] = {}
    for name, weight in marked.items():
        (at,) = program.path([weight])
        chosen[f"{name}, weight {weight:.2g}"] = (float(np.sqrt(at.loss)), float(np.sqrt(at.penalty)))
    own = next(iter(chosen)) if isinstance(of, Calibration) else ""
    return draw(charts.l_curve_chart(residual, solution, chosen, own), ax)


def _program(of: Program | Calibration) -> Program:
    return of.program if isinstance(of, Calibration) else of


def selection(selection: Selection, ax: Axes = None) -> Axes:
    """Draw a selector's score over the weights, and its choice, dashed where it is at an edge.

    Arguments as for `errors`.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ro.plot.selection(result.selection).get_ylabel()
    'score of reml'
    """
    finite = np.isfinite(selection.score)
    weights = selection.weights[finite]
    score = selection.score[finite]
    every = [*weights, selection.weight]
    x = Axis("weight", (min(every), max(every)), log=True)
    y = Axis(f"score of {selection.name}", (float(score.min()), float(score.max())))
    label = f"weight {selection.weight:.3g}"
    choice = Line([selection.weight] * 2, list(y.limits), "mark", label, dashed=not selection.interior)
    return draw(Chart("", x, y, [Line(weights, score, "ink"), choice]), ax)


def selectors(of: Program | Calibration, selections: Mapping[str, Selection] | None = None, ax: Axes = None) -> Axes:
    """Draw the weights that selectors choose (`compare` by default); hollow: at an edge. Arguments as for `l_curve`.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot.selectors(result)
    >>> [label.get_text() for label in ax.get_yticklabels()][:4]  # by weight
    ['quasi_optimality', 'discrepancy', 'corner', 'l_curve']
    """
    chosen = compare(_program(of)) if selections is None else selections
    ordered = sorted(chosen.items(), key=lambda item: -item[1].weight)
    weight = np.array([each.weight for _, each in ordered])
    interior = np.array([each.interior for _, each in ordered])
    marks: list[Mark] = []
    for which, label in ((interior, ""), (~interior, "at an edge")):
        at = np.flatnonzero(which)
        if len(at):
            marks.append(Dots(weight[at], at + 1.0, "after", label, ["choice"] * len(at), hollow=bool(label)))
    y = Axis("", names=[name for name, _ in ordered])
    return draw(Chart("", Axis("weight", (weight.min(), weight.max()), log=True), y, marks), ax)


def picard(of: Program | Calibration, weight: float = 0.0, ax: Axes = None) -> Axes:
    """Draw Picard's condition: singular values, coefficients of the data, and coefficients of the solution.

    Where the data |u'b| sink to the noise, at 1, while the singular values sink below it, coefficients |u'b| / s are
    noise; the weight, by default that of a result, damps the directions with s below its root (Hansen 1990,
    BIT 30:658). Arguments as for `l_curve`.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot.picard(result)
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['singular value s', "coefficient |u'b| / s", "data |u'b|", 'root of the weight']
    """
    if isinstance(of, Calibration):
        weight = weight or of.weight
    return draw(charts.picard_chart(_program(of), weight), ax)


# --- the renderer ------------------------------------------------------------------------------------------

COLORS = {
    "before": "#a3adb8", "after": "#1769c2", "mark": "#c8371b", "other": "#7a5bc7", "ink": "#59636e", "zero": "#a3adb8",
}  # fmt: skip
SIZES = {"small": 3.5, "middle": 5.0, "large": 9.0}
SHAPES = "osD^v<>"
FONT_X, FONT_Y, FONT_LEAST = 7.0, 10.0, 4.0
"""Largest sizes of names along x and y [points], and the smallest that can be read."""
LINE_HEIGHT = 1.25
"""Distance of names over their size."""


def draw(chart: Chart, ax: Axes = None) -> Axes:
    """Draw a chart on axes, by default on new ones that are as high as its names need, and return them."""
    ax = _axes(ax, len(chart.y.names))
    _set_axis(ax, "x", chart.x)
    _set_axis(ax, "y", chart.y)
    for mark in chart.marks:
        _draw(ax, mark)
    if chart.note:
        ax.set_xlabel(f"{ax.get_xlabel()}\n{chart.note}".strip())
    if ax.get_legend_handles_labels()[0]:
        ax.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, fontsize=8)
    return ax


def _axes(ax: Axes, rows: int = 0, **kwargs: Any) -> Axes:
    if ax is not None:
        return ax
    from matplotlib import pyplot

    figure, ax = pyplot.subplots(layout="constrained", subplot_kw=kwargs)
    figure.set_figheight(max(figure.get_figheight(), 0.2 * rows + 1.2))
    return ax


def _set_axis(ax: Axes, which: str, axis: Axis) -> None:
    if axis.log:
        ax.set(**{f"{which}scale": "log"})
    if axis.linear_to:
        getattr(ax, f"set_{which}scale")("symlog", linthresh=axis.linear_to)
    if axis.log or axis.linear_to:
        getattr(ax, f"{which}axis").set_major_formatter("{x:g}")  # 0.1 in the place of powers of ten
    limits = axis.limits
    if axis.names:
        limits = limits[::-1] if which == "y" else limits
        box = ax.get_window_extent()
        length, largest = (box.width, FONT_X) if which == "x" else (box.height, FONT_Y)
        size = length * 72 / ax.figure.dpi / (LINE_HEIGHT * len(axis.names))
        if size >= FONT_LEAST:
            turned = 90 if which == "x" and len(axis.names) > 3 else 0
            ticks = range(1, len(axis.names) + 1)
            getattr(ax, f"set_{which}ticks")(ticks, axis.names, fontsize=min(size, largest), rotation=turned)
    ax.set(**{f"{which}lim": limits, f"{which}label": axis.label})


def _draw(ax: Axes, mark: Mark) -> None:
    color = COLORS[mark.role]
    match mark:
        case Line():
            ax.plot(mark.x, mark.y, color=color, lw=1.5, ls="--" if mark.dashed else "-", label=mark.label)
        case Dots(each=True):
            for k, (x, y, hint) in enumerate(zip(mark.x, mark.y, mark.hints, strict=True)):
                style = {"marker": SHAPES[k % len(SHAPES)], "mfc": "none", "mew": 1.6, "ms": 8}
                ax.plot([x], [y], ls="none", color=f"C{k}", label=hint, **style)
        case Dots():
            fill = "none" if mark.hollow else color
            size = SIZES[mark.size] if len(mark.hints) else 2.0
            ax.plot(mark.x, mark.y, "o", color=color, mfc=fill, ms=size, label=mark.label)
        case Boxes():
            style = {"align": "edge", "color": color, "alpha": 0.85, "label": mark.label}
            ax.bar(mark.left, mark.high - mark.low, mark.right - mark.left, mark.low, **style)
