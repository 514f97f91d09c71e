"""Figures on matplotlib axes, for papers and notebooks: each draws on ``ax`` or on new axes, and returns them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from rpim_opt.calibration import Calibration
from rpim_opt.dataset import Dataset
from rpim_opt.formulation import ConvexProgram
from rpim_opt.robot import Array
from rpim_opt.selection import Selection, compare, weight_grid
from rpim_opt.uncertainty import Uncertainty
from rpim_opt.units import display

Axes = Any  # matplotlib's, which is imported by whoever makes the axes
BEFORE, AFTER, MARK = "0.75", "C0", "C3"


def _axes(ax: Axes, **kwargs: Any) -> Axes:
    if ax is not None:
        return ax
    from matplotlib import pyplot

    return pyplot.subplots(layout="constrained", subplot_kw=kwargs)[1]


def _legend(ax: Axes) -> Axes:
    """Put the legend above the axes, where it hides nothing."""
    ax.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, fontsize=8)
    return ax


def plot_l_curve(program: ConvexProgram, selections: Mapping[str, Selection] | None = None, ax: Axes = None) -> Axes:
    """Draw the L-curve: the root of the penalty against that of the loss, over the weights, with selectors' choices.

    The program is solved at 200 weights where it has a closed form, else at 40.

    Parameters
    ----------
    program
        Its penalty has to be something: InputError otherwise.
    selections
        Choices to mark, by name.
    ax
        Matplotlib's axes; new ones by default.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot_l_curve(result.program, {"REML": result.selection})
    >>> ax.get_xlabel()
    'whitened residual norm'
    >>> ax.figure.savefig("l_curve.pdf")
    """
    ax = _axes(ax)
    weights = weight_grid(program, 200 if program.closed_form else 40)
    points = np.array([[e.loss, e.penalty] for e in program.path(weights)])
    ax.loglog(np.sqrt(points[:, 0]), np.sqrt(points[:, 1]), color="0.3", lw=1.5)
    for k, (name, selection) in enumerate((selections or {}).items()):
        e = program.path([selection.weight])[0]
        label = f"{name}, weight {selection.weight:.2g}"
        ax.plot(np.sqrt(e.loss), np.sqrt(e.penalty), "osD^v<>"[k % 7], color=f"C{k}", ms=8, mec="white", label=label)
    ax.set_xlabel("whitened residual norm")
    ax.set_ylabel("norm of the deviations [scales]")
    if selections:
        ax.legend(frameon=False)
    return ax


def plot_selection(selection: Selection, ax: Axes = None) -> Axes:
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
    >>> ro.plot_selection(result.selection).get_title()
    'largest restricted likelihood'
    """
    ax = _axes(ax)
    finite = np.isfinite(selection.score)
    ax.semilogx(selection.weights[finite], selection.score[finite], color="0.3", lw=1.5)
    ax.axvline(selection.weight, color=MARK, ls="-" if selection.interior else "--", lw=1.2)
    ax.set_xlabel("weight")
    ax.set_ylabel(f"score of {selection.name}")
    ax.set_title(selection.note, fontsize=9)
    return ax


def plot_selectors(program: ConvexProgram, selections: Mapping[str, Selection] | None = None, ax: Axes = None) -> Axes:
    """Draw the weights that selectors choose; hollow: at an edge.

    Parameters
    ----------
    program
        The formulation on a linear model.
    selections
        Choices by name; by default those of all selectors that serve the program (`compare`).
    ax
        Matplotlib's axes; new ones by default.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot_selectors(result.program)
    >>> [label.get_text() for label in ax.get_yticklabels()][:4]  # by weight
    ['quasi_optimality', 'discrepancy', 'corner', 'l_curve']
    """
    ax, chosen = _axes(ax), compare(program) if selections is None else selections
    ordered = sorted(chosen.items(), key=lambda item: -item[1].weight)
    for place, (_, selection) in enumerate(ordered):
        ax.plot(selection.weight, place, "o", color=AFTER, ms=7, mfc=AFTER if selection.interior else "none")
    ax.set_xscale("log")
    ax.set_yticks(range(len(ordered)), [name for name, _ in ordered])
    ax.grid(axis="y", color="0.9")
    ax.set_xlabel("weight")
    return ax


def plot_picard(program: ConvexProgram, weight: float = 0.0, ax: Axes = None) -> Axes:
    """Draw Picard's condition: singular values, what the data say along them, and the solution's coefficients.

    Where the data |u'b| sink to the noise, at 1, while the singular values sink below it, coefficients |u'b| / s are
    noise; the weight takes out the directions with s below its root (Hansen 1990, BIT 30:658).

    Parameters
    ----------
    program
        The formulation on a linear model.
    weight
        Whose root is drawn, if it is not zero.
    ax
        Matplotlib's axes; new ones by default.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> ax = ro.plot_picard(result.program, result.weight)
    >>> [text.get_text() for text in ax.get_legend().get_texts()]
    ['singular value s', "data |u'b|", "coefficient |u'b| / s", 'root of the weight']
    """
    ax = _axes(ax)
    beta, s, _ = program.model.svd
    k, seen = np.arange(1, len(s) + 1), s > 0
    ax.semilogy(k[seen], s[seen], "o-", color="0.3", ms=4, label="singular value s")
    ax.semilogy(k[seen], np.abs(beta[seen]), "x", color=AFTER, label="data |u'b|")
    ax.semilogy(k[seen], np.abs(beta[seen]) / s[seen], "^", color="C1", ms=4, label="coefficient |u'b| / s")
    if weight > 0:
        ax.axhline(np.sqrt(weight), color=MARK, lw=1, ls="--", label="root of the weight")
    ax.set_xlabel("direction")
    ax.set_ylabel("size [sigmas, scales]")
    return _legend(ax)


def plot_errors(result: Calibration, data: Dataset | None = None, ax: Axes = None) -> Axes:
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
    >>> ax = ro.plot_errors(result, instance.validation)
    >>> ax.get_ylabel(), len(ax.patches)  # two bars a row
    ('error [mm]', 32)
    """
    ax, labels = _axes(ax), (data or result.problem.data).label
    place, before, after = np.arange(len(labels)), 1e3 * result.nominal_errors(data), 1e3 * result.errors(data)
    ax.bar(place - 0.2, before, 0.4, color=BEFORE, label="nominal")
    ax.bar(place + 0.2, after, 0.4, color=AFTER, label="identified")
    flagged = {flag.label for flag in result.flagged} if data is None else set()
    wrong = [i for i, label in enumerate(labels) if label in flagged]
    if wrong:
        ax.plot(place[wrong] + 0.2, after[wrong], "v", color=MARK, label="distrusted")
    ax.set_yscale("log")
    ax.set_ylim(bottom=max(0.5 * min(before.min(), after.min()), 1e-4))  # a row that a norm fits exactly is below
    ax.set_ylabel("error [mm]")
    if len(labels) <= 60:
        ax.set_xticks(place, labels, rotation=90, fontsize=7)
    else:
        ax.set_xlabel("row")
    return _legend(ax)


def plot_error_histogram(result: Calibration, data: Dataset | None = None, ax: Axes = None) -> Axes:
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
    >>> ax = ro.plot_error_histogram(result)
    >>> ax.get_xlabel(), ax.get_xscale()
    ('error [mm]', 'log')
    """
    ax, sets = _axes(ax), (1e3 * result.nominal_errors(data), 1e3 * result.errors(data))
    edges = error_bins(*sets)
    for errors, color, label in zip(sets, (BEFORE, AFTER), ("nominal", "identified"), strict=True):
        ax.hist(np.maximum(errors, edges[0]), edges, color=color, alpha=0.85, label=label)
    ax.set_xscale("log")
    ax.set_xlabel("error [mm]")
    ax.set_ylabel("rows")
    return _legend(ax)


def error_bins(*errors: Array) -> Array:
    """Return edges of a histogram's bins, equal in the logarithm, four decades at most."""
    every = np.concatenate(errors)
    high = max(float(every.max(initial=0.0)), 1e-6) * 1.001
    low = max(float(every.min(initial=high)), 1e-4 * high)
    return np.geomspace(low, high, 25 if high > 1.01 * low else 2)


def plot_error_axes(result: Calibration, data: Dataset | None = None, ax: Axes = None) -> Axes:
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
    >>> ax = ro.plot_error_axes(result)
    >>> [label.get_text() for label in ax.get_xticklabels()]
    ['x', 'y', 'z']
    """
    ax = _axes(ax)
    for nominal, color, label, shift in ((True, "0.55", "nominal", -0.1), (False, AFTER, "identified", 0.1)):
        vectors = 1e3 * result.error_vectors(data, nominal=nominal)
        vectors = vectors[np.isfinite(vectors).all(axis=1)]
        mean, (low, high) = vectors.mean(axis=0), np.percentile(vectors, [2.5, 97.5], axis=0)
        ax.errorbar(np.arange(3) + shift, mean, [mean - low, high - mean], fmt="o", color=color, capsize=4, label=label)
    ax.axhline(0, color="0.8", lw=1)
    ax.set_xticks(range(3), ["x", "y", "z"])
    ax.set_xlim(-0.5, 2.5)
    ax.set_xlabel("axis of the instrument")
    ax.set_yscale("symlog", linthresh=0.1)
    ax.set_ylabel("measured minus modelled [mm]")
    return _legend(ax)


def plot_error_vectors(
    result: Calibration, data: Dataset | None = None, nominal: bool = False, ax: Axes = None
) -> Axes:
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
    >>> ro.plot_error_vectors(result, nominal=True).get_title()
    'nominal errors, enlarged 100 times'
    """
    ax = _axes(ax, projection="3d")
    points, vectors = result.measured_positions(data), result.error_vectors(data, nominal=nominal)
    points, vectors = (a[np.isfinite(vectors).all(axis=1)] for a in (points, vectors))
    times = magnification(points, vectors)
    ax.scatter(*points.T, s=6, color="0.3")
    ax.quiver(*points.T, *(times * vectors).T, color=BEFORE if nominal else AFTER, arrow_length_ratio=0.2)
    ax.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", aspect="equal")
    ax.set_title(f"{'nominal' if nominal else 'identified'} errors, enlarged {times:,.0f} times", fontsize=9)
    return ax


def magnification(points: Array, vectors: Array) -> float:
    """Return by how much to enlarge errors, the longest to a sixth of the points' extent: 1, 2 or 5 times 10^k."""
    longest = float(np.linalg.norm(vectors, axis=1).max(initial=0.0))
    exponent = np.log10(max(float(np.ptp(points, axis=0).max()), 1e-3) / 6 / max(longest, 1e-12))
    decade = 10.0 ** np.floor(exponent)
    return float(max(step for step in (1, 2, 5) if step * decade <= 10**exponent) * decade)


def plot_parameters(result: Calibration, dimension: str = "length", confidence: float = 0.95, ax: Axes = None) -> Axes:
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
    >>> ax = ro.plot_parameters(result, "angle")
    >>> ax.get_xlabel(), len(ax.get_yticks())
    ('deviation from nominal [deg]', 13)
    """
    ax, free = _axes(ax), result.problem.parameters.free
    own = ~free.of_frames & (np.array(free.dimensions) == dimension)
    unit, si = display(dimension)
    place, x = np.arange(own.sum()), result.x[own] / si
    half = np.full(len(x), np.nan)
    if result.linear_penalty:
        low, high = Uncertainty(result, confidence).intervals()[own].T / si
        half = (high - low) / 2
    bound = free.tolerance[own] / si
    ax.errorbar(
        x, place, xerr=half, fmt="o", color=AFTER, ms=4, capsize=3, label=f"deviation, {confidence:.0%} interval"
    )
    if np.isfinite(bound).any():
        ax.plot(np.r_[-bound, bound], np.r_[place, place], "|", color=MARK, ms=9, label="tolerance")
    ax.axvline(0, color="0.8", lw=1)
    ax.set_yticks(place, [name for name, is_own in zip(free.names, own, strict=True) if is_own])
    ax.invert_yaxis()
    ax.set_xlabel(f"deviation from nominal [{unit}]")
    return _legend(ax)
