"""Figures of the weight: the L-curve, scores, choices of selectors, and what the data say at all."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.program import Program
from rpim_opt.convex.select import compare
from rpim_opt.convex.selection import Selection, weight_grid
from rpim_opt.show.figure import AFTER, MARK, Axes, axes_of, legend_above


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
    reml, weight 1.5
    >>> ax.get_xlabel()
    'whitened residual norm'
    >>> ax.figure.savefig("l_curve.pdf")
    """
    ax = axes_of(ax)
    program, marked = _program_and_marks(of, selections)
    weights = weight_grid(program, 200 if program.closed_form else 40)
    points = np.array([[e.loss, e.penalty] for e in program.path(weights)])
    ax.loglog(np.sqrt(points[:, 0]), np.sqrt(points[:, 1]), color="0.3", lw=1.5)
    for k, (name, weight) in enumerate(marked.items()):
        e = program.path([weight])[0]
        label = f"{name}, weight {weight:.2g}"
        mark = {"marker": "osD^v<>"[k % 7], "color": f"C{k}", "ms": 8, "mfc": "none", "mew": 1.6}  # one shows another
        ax.plot(np.sqrt(e.loss), np.sqrt(e.penalty), ls="none", label=label, **mark)
    ax.set_xlabel("whitened residual norm")
    ax.set_ylabel("norm of the deviations [scales]")
    if marked:
        ax.legend(frameon=False)
    return ax


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
    >>> ro.plot.selection(result.selection).get_title()
    'largest restricted likelihood'
    """
    ax = axes_of(ax)
    finite = np.isfinite(selection.score)
    ax.semilogx(selection.weights[finite], selection.score[finite], color="0.3", lw=1.5)
    ax.axvline(selection.weight, color=MARK, ls="-" if selection.interior else "--", lw=1.2)
    ax.set_xlabel("weight")
    ax.set_ylabel(f"score of {selection.name}")
    ax.set_title(selection.note, fontsize=9)
    return ax


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
    ax = axes_of(ax)
    program, _ = _program_and_marks(of, None)
    chosen = compare(program) if selections is None else selections
    ordered = sorted(chosen.items(), key=lambda item: -item[1].weight)
    for place, (_, selection) in enumerate(ordered):
        ax.plot(selection.weight, place, "o", color=AFTER, ms=7, mfc=AFTER if selection.interior else "none")
    ax.set_xscale("log")
    ax.set_yticks(range(len(ordered)), [name for name, _ in ordered])
    ax.grid(axis="y", color="0.9")
    ax.set_xlabel("weight")
    return ax


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
    ['singular value s', "data |u'b|", "coefficient |u'b| / s", 'root of the weight']
    """
    ax = axes_of(ax)
    program, marked = _program_and_marks(of, None)
    weight = weight or next(iter(marked.values()), 0.0)
    beta, s, _ = program.model.svd
    k = np.arange(1, len(s) + 1)
    seen = s > 0
    ax.semilogy(k[seen], s[seen], "o-", color="0.3", ms=4, label="singular value s")
    ax.semilogy(k[seen], np.abs(beta[seen]), "x", color=AFTER, label="data |u'b|")
    ax.semilogy(k[seen], np.abs(beta[seen]) / s[seen], "^", color="C1", ms=4, label="coefficient |u'b| / s")
    if weight > 0:
        ax.axhline(np.sqrt(weight), color=MARK, lw=1, ls="--", label="root of the weight")
    ax.set_xlabel("direction")
    ax.set_ylabel("size [sigmas, scales]")
    return legend_above(ax)
