"""Figures of a result: its errors before and after, and its parameters."""

from __future__ import annotations

import numpy as np

from rpim_opt.basics.units import display
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import Uncertainty
from rpim_opt.data.dataset import Dataset
from rpim_opt.show.figure import (
    AFTER,
    BEFORE,
    MARK,
    Axes,
    axes_of,
    extent,
    in_millimetres,
    label_rows,
    legend_above,
)
from rpim_opt.show.scales import below, error_bins, kept_tolerance, magnification

FEW = 100
"""Rows up to which each has its line and its large dot."""


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
    >>> ax.get_ylabel(), [len(line.get_xdata()) for line in ax.lines]  # two points a row
    ('error [mm]', [16, 16])
    """
    ax = axes_of(ax)
    labels = (data or result.problem.data).label
    place = np.arange(len(labels))
    before = 1e3 * result.nominal_errors(data)
    after = 1e3 * result.errors(data)
    dot = 2
    if len(labels) <= FEW:
        dot = 5
        ax.vlines(place, after, before, color=BEFORE, lw=0.8)  # no bars: a logarithmic axis has no zero to begin at
    ax.plot(place, before, "o", color=BEFORE, ms=dot, label="nominal")
    ax.plot(place, after, "o", color=AFTER, ms=dot, label="identified")
    flagged = {flag.label for flag in result.flagged} if data is None else set()
    wrong = [i for i, label in enumerate(labels) if label in flagged]
    if wrong:
        ax.plot(place[wrong], after[wrong], "v", color=MARK, label="distrusted")
    ax.set_yscale("log")
    ax.set_ylim(
        bottom=max(0.5 * min(np.nanmin(before), np.nanmin(after)), 1e-4)
    )  # a row that a norm fits exactly is below
    ax.set_ylabel("error [mm]")
    in_millimetres(ax.yaxis)
    if label_rows(ax.xaxis, labels, extent(ax)[0]):
        ax.tick_params(axis="x", rotation=90)
    else:
        ax.set_xlabel("row")
    return legend_above(ax)


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
    ax = axes_of(ax)
    sets = {"nominal": 1e3 * result.nominal_errors(data), "identified": 1e3 * result.errors(data)}
    edges = error_bins(*sets.values())
    for (label, errors), color in zip(sets.items(), (BEFORE, AFTER), strict=True):
        ax.hist(np.maximum(errors, edges[0]), edges, color=color, alpha=0.85, label=label)
    ax.set_xscale("log")
    in_millimetres(ax.xaxis)
    ax.set_xlabel("error [mm]" + below(edges[0], sets).replace(" The", "\nThe"))
    ax.set_ylabel("rows")
    return legend_above(ax)


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
    ax = axes_of(ax)
    ax.set_yscale("symlog", linthresh=0.1)
    for nominal, color, label, shift in ((True, "0.55", "nominal", -0.1), (False, AFTER, "identified", 0.1)):
        vectors = 1e3 * result.error_vectors(data, nominal=nominal)
        vectors = vectors[np.isfinite(vectors).all(axis=1)]
        mean = vectors.mean(axis=0)
        low, high = np.percentile(vectors, [2.5, 97.5], axis=0)
        ax.errorbar(np.arange(3) + shift, mean, [mean - low, high - mean], fmt="o", color=color, capsize=4, label=label)
    ax.axhline(0, color="0.8", lw=1)
    ax.set_xticks(range(3), ["x", "y", "z"])
    ax.set_xlim(-0.5, 2.5)
    ax.set_xlabel("axis of the instrument")
    in_millimetres(ax.yaxis)
    ax.set_ylabel("measured minus modelled [mm]")
    return legend_above(ax)


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
    'nominal errors, enlarged 100 times'
    """
    ax = axes_of(ax, projection="3d")
    points = result.measured_positions(data)
    vectors = result.error_vectors(data, nominal=nominal)
    points, vectors = (a[np.isfinite(vectors).all(axis=1)] for a in (points, vectors))
    times = magnification(points, vectors)
    ax.scatter(*points.T, s=6, color="0.3")
    color = AFTER
    if nominal:
        color = BEFORE
    width = 1.5
    if len(points) > FEW:
        width = 0.5
    ax.quiver(*points.T, *(times * vectors).T, color=color, lw=width, arrow_length_ratio=0.2)
    ax.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", aspect="equal")
    ax.set_title(f"{'nominal' if nominal else 'identified'} errors, enlarged {times:,.0f} times", fontsize=9)
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
    free = result.problem.parameters.free
    own = ~free.of_frames & (np.array(free.dimensions) == dimension)
    ax = axes_of(ax, int(own.sum()))
    unit, si = display(dimension)
    place = np.arange(own.sum())
    x = result.x[own] / si
    half = np.full(len(x), np.nan)
    if result.linear_penalty:
        low, high = Uncertainty(result, confidence).intervals()[own].T / si
        half = (high - low) / 2
    bound = kept_tolerance(result)[own] / si
    ax.errorbar(
        x, place, xerr=half, fmt="o", color=AFTER, ms=4, capsize=3, label=f"deviation, {confidence:.0%} interval"
    )
    if np.isfinite(bound).any():
        ax.plot(np.r_[-bound, bound], np.r_[place, place], "|", color=MARK, ms=9, label="tolerance")
    ax.axvline(0, color="0.8", lw=1)
    names = [name for name, is_own in zip(free.names, own, strict=True) if is_own]
    label_rows(ax.yaxis, names, extent(ax)[1], largest=10)
    ax.invert_yaxis()
    ax.set_xlabel(f"deviation from nominal [{unit}]")
    return legend_above(ax)
