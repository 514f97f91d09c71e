"""Figures on matplotlib axes, for papers and reports."""

from __future__ import annotations

from typing import Any

import numpy as np

from rpim_opt.calibration import Calibration
from rpim_opt.formulation import ConvexProgram
from rpim_opt.selection import Selection, weight_grid

Axes = Any  # matplotlib's, which is imported by whoever makes the axes


def plot_l_curve(ax: Axes, program: ConvexProgram, selections: dict[str, Selection] | None = None) -> Axes:
    """Draw loss against penalty of the solutions over the weights, with the selectors' choices.

    Parameters
    ----------
    ax
        Axes to draw on.
    program
        Solved at 200 weights where it has a closed form, else at 40.
    selections
        Choices to mark, by name.
    """
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


def plot_selection(ax: Axes, selection: Selection) -> Axes:
    """Draw what a selector compared over the weights, and its choice."""
    finite = np.isfinite(selection.score)
    ax.semilogx(selection.weights[finite], selection.score[finite], color="0.3", lw=1.5)
    ax.axvline(selection.weight, color="C3", ls="-" if selection.interior else "--", lw=1.2)
    ax.set_xlabel("weight")
    ax.set_ylabel(f"score of {selection.name}")
    ax.set_title(selection.note, fontsize=9)
    return ax


def plot_errors(ax: Axes, result: Calibration) -> Axes:
    """Draw every row's error before and after, distrusted rows marked."""
    labels = result.problem.data.label
    place, before, after = np.arange(len(labels)), 1e3 * result.nominal_errors(), 1e3 * result.errors()
    ax.bar(place - 0.2, before, 0.4, color="0.75", label="nominal")
    ax.bar(place + 0.2, after, 0.4, color="C0", label="identified")
    wrong = [i for i, label in enumerate(labels) if label in {flag.label for flag in result.flagged}]
    if wrong:
        ax.plot(place[wrong] + 0.2, after[wrong], "v", color="C3", label="distrusted")
    ax.set_yscale("log")
    ax.set_ylim(bottom=max(0.5 * min(before.min(), after.min()), 1e-4))  # a row that a norm fits exactly is below
    ax.set_ylabel("error [mm]")
    if len(labels) <= 60:
        ax.set_xticks(place, labels, rotation=90, fontsize=7)
    ax.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    return ax
