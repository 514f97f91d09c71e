"""Figures on matplotlib axes, for papers and notebooks: each draws on ``ax`` or on new axes, and returns them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import Uncertainty
from rpim_opt.convex.program import Program
from rpim_opt.convex.select import compare
from rpim_opt.convex.selection import Selection, weight_grid
from rpim_opt.data.dataset import Dataset
from rpim_opt.report.charts_result import (
    MANY,
    axes_chart,
    deviations_chart,
    histogram_chart,
    lengths_of,
    rows_chart,
)  # fmt: skip
from rpim_opt.report.charts_weight import choices_chart, l_curve_chart, picard_chart, score_chart
from rpim_opt.report.on_axes import COLORS, Axes, axes_of, on_axes
from rpim_opt.report.scales import magnification

__all__ = [
    "error_axes",
    "error_histogram",
    "error_vectors",
    "errors",
    "l_curve",
    "parameters",
    "picard",
    "selection",
    "selectors",
]


def errors(result: Calibration, data: Dataset | None = None, ax: Axes = None) -> Axes:
    """Draw every row's error [mm] before and after, distrusted rows of the identification data marked.

    Parameters
    ----------
    result
        The calibration.
    data
        The rows; the identification data by default.
    ax
        Matplotlib's axes; new ones by default.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> result = ro.calibrate(instance.problem, ro.tikhonov, weight=ro.l_curve)
    >>> ax = ro.plot.errors(result, instance.validation)
    >>> ax.get_ylabel(), len(ax.get_xticks())
    ('error [mm]', 16)
    """
    return on_axes(rows_chart(result, data or result.problem.data), ax)


def error_histogram(result: Calibration, data: Dataset | None = None, ax: Axes = None) -> Axes:
    """Draw how many rows have which error [mm] before and after, over the error's logarithm.

    Parameters
    ----------
    result
        The calibration.
    data
        The rows; the identification data by default.
    ax
        Matplotlib's axes; new ones by default.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot.error_histogram(result)
    >>> ax.get_xlabel(), ax.get_xscale()
    ('error [mm]', 'log')
    """
    lengths, _ = lengths_of(result, data or result.problem.data)
    return on_axes(histogram_chart(lengths), ax)


def error_axes(result: Calibration, data: Dataset | None = None, ax: Axes = None) -> Axes:
    """Draw mean (dot) and spread (95 % of the rows) of the errors [mm] along x, y, z, before and after.

    Parameters
    ----------
    result
        The calibration.
    data
        The rows; the identification data by default.
    ax
        Matplotlib's axes; new ones by default.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot.error_axes(result)
    >>> [label.get_text() for label in ax.get_xticklabels()]
    ['x', 'y', 'z']
    """
    return on_axes(axes_chart(result, data or result.problem.data), ax)


def error_vectors(result: Calibration, data: Dataset | None = None, nominal: bool = False, ax: Axes = None) -> Axes:
    """Draw measured positions [m] in space with their errors, enlarged as the title says.

    Parameters
    ----------
    result
        The calibration.
    data
        The rows; the identification data by default.
    nominal
        Whether to draw the errors before calibration.
    ax
        Matplotlib's 3D axes; new ones by default.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ro.plot.error_vectors(result, nominal=True).get_title()
    'errors before, enlarged 100 times'
    """
    ax = axes_of(ax, projection="3d")
    points = result.measured_positions(data)
    vectors = result.error_vectors(data, nominal=nominal)
    points, vectors = (a[np.isfinite(vectors).all(axis=1)] for a in (points, vectors))
    times = magnification(points, vectors)
    ax.scatter(*points.T, s=6, color="0.3")
    when = "before" if nominal else "after"
    width = 1.5
    if len(points) > MANY:
        width = 0.5
    ax.quiver(*points.T, *(times * vectors).T, color=COLORS[when], lw=width, arrow_length_ratio=0.2)
    ax.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", aspect="equal")
    ax.set_title(f"errors {when}, enlarged {times:,.0f} times", fontsize=9)
    return ax


def parameters(result: Calibration, dimension: str = "length", confidence: float = 0.95, ax: Axes = None) -> Axes:
    """Draw the deviations of the robot's own parameters of a dimension with their intervals and tolerances.

    Parameters
    ----------
    result
        The calibration.
    dimension
        ``length`` [mm], ``angle`` [deg], ``ratio`` [ppm] or ``compliance`` [mrad/Nm].
    confidence
        Of the intervals, which only a squared penalty, or none, has.
    ax
        Matplotlib's axes; new ones by default.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot.parameters(result, "angle")
    >>> ax.get_xlabel(), len(ax.get_yticks())
    ('deviation from nominal [deg]', 13)
    """
    half = np.full(len(result.x), np.nan)
    if result.linear_penalty:
        half = np.diff(Uncertainty(result, confidence).intervals())[:, 0] / 2
    return on_axes(deviations_chart(result, dimension, half, confidence), ax)


def l_curve(of: Program | Calibration, selections: Mapping[str, Selection] | None = None, ax: Axes = None) -> Axes:
    """Draw the L-curve: the root of the penalty against that of the loss, over the weights, with selectors' choices.

    The program is solved at 200 weights where it has a closed form, else at 40.

    Parameters
    ----------
    of
        A program, or a result, whose own weight is marked; its penalty has to be something: InputError otherwise.
    selections
        Choices to mark, by name.
    ax
        Matplotlib's axes; new ones by default.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot.l_curve(result)
    >>> print(ax.get_legend().get_texts()[0].get_text())
    chosen: reml, weight 1.5
    >>> ax.get_xlabel()
    'root of the loss (residual norm) [sigmas]'
    >>> ax.figure.savefig("l_curve.pdf")
    """
    program, marked = _program_and_marks(of, selections)
    path = program.path(weight_grid(program, 200 if program.closed_form else 40))
    residual, solution = np.sqrt([[e.loss, e.penalty] for e in path]).T
    chosen: dict[str, tuple[float, float]] = {}
    for name, weight in marked.items():
        (at,) = program.path([weight])
        chosen[f"{name}, weight {weight:.2g}"] = (float(np.sqrt(at.loss)), float(np.sqrt(at.penalty)))
    own = ""
    if isinstance(of, Calibration):
        own = next(iter(chosen))
    return on_axes(l_curve_chart(residual, solution, chosen, own), ax)


def _program_and_marks(
    of: Program | Calibration, selections: Mapping[str, Selection] | None
) -> tuple[Program, dict[str, float]]:
    """Return the program, and the weights to mark by name: of a result its own first."""
    marked = {name: choice.weight for name, choice in (selections or {}).items()}
    if not isinstance(of, Calibration):
        return of, marked
    if of.selector not in marked:
        marked = {of.selector: of.weight, **marked}
    return of.program, marked


def selection(selection: Selection, ax: Axes = None) -> Axes:
    """Draw what a selector compared over the weights, and its choice, dashed where it is at an edge.

    Parameters
    ----------
    selection
        The choice with its evidence.
    ax
        Matplotlib's axes; new ones by default.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ro.plot.selection(result.selection).get_ylabel()
    'score of reml'
    """
    return on_axes(score_chart(selection), ax)


def selectors(of: Program | Calibration, selections: Mapping[str, Selection] | None = None, ax: Axes = None) -> Axes:
    """Draw the weights that selectors choose; hollow: at an edge.

    Parameters
    ----------
    of
        The formulation on a linear model, or a result.
    selections
        Choices by name; by default those of all selectors that serve the program (`compare`).
    ax
        Matplotlib's axes; new ones by default.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot.selectors(result)
    >>> [label.get_text() for label in ax.get_yticklabels()][:4]  # by weight
    ['quasi_optimality', 'discrepancy', 'corner', 'l_curve']
    """
    program, _ = _program_and_marks(of, None)
    return on_axes(choices_chart(compare(program) if selections is None else selections), ax)


def picard(of: Program | Calibration, weight: float = 0.0, ax: Axes = None) -> Axes:
    """Draw Picard's condition: singular values, what the data say along them, and the solution's coefficients.

    Where the data |u'b| sink to the noise, at 1, while the singular values sink below it, coefficients |u'b| / s are
    noise; the weight takes out the directions with s below its root (Hansen 1990, BIT 30:658).

    Parameters
    ----------
    of
        The formulation on a linear model, or a result.
    weight
        Whose root is drawn, if it is not zero; of a result its own by default.
    ax
        Matplotlib's axes; new ones by default.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot.picard(result)
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['singular value s', "coefficient |u'b| / s", "data |u'b|", 'root of the weight']
    """
    program, marked = _program_and_marks(of, None)
    return on_axes(picard_chart(program, weight or next(iter(marked.values()), 0.0)), ax)
