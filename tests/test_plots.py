"""Figures show what was chosen."""

from __future__ import annotations

import matplotlib as mpl
import numpy as np
import pytest

import rpim_opt as ro

mpl.use("Agg")
from matplotlib import pyplot as plt


@pytest.fixture
def ax():
    figure, axes = plt.subplots()
    yield axes
    plt.close(figure)


def test_the_l_curve_marks_every_choice(ax, tmp_path) -> None:
    problem = ro.load("position").problem
    program = ro.tikhonov.compile(problem.linearize(np.zeros(len(problem.parameters.free))))
    selections = {rule.__name__: rule(program) for rule in (ro.l_curve, ro.gcv, ro.reml)}
    ro.plot_l_curve(ax, program, selections)
    assert [text.get_text().split(",")[0] for text in ax.get_legend().get_texts()] == list(selections)
    curve, *marks = ax.lines
    assert (np.diff(curve.get_xdata()) > 0).all()  # the residual grows with the weight, the solution shrinks
    assert (np.diff(curve.get_ydata()) < 0).all()
    assert len(marks) == 3
    ax.figure.savefig(tmp_path / "l.svg")


def test_the_choice_of_every_selector_can_be_drawn(ax) -> None:
    problem = ro.load("position").problem
    program = ro.tikhonov.compile(problem.linearize(np.zeros(len(problem.parameters.free))))
    for rule in (ro.corner, ro.gcv, ro.reml, ro.leave_one_out, ro.discrepancy, ro.quasi_optimality, ro.ncp):
        ax.clear()
        chosen = rule(program)
        ro.plot_selection(ax, chosen)
        assert ax.lines[1].get_xdata()[0] == chosen.weight
        assert chosen.name in ax.get_ylabel()


def test_distrusted_rows_are_marked(ax) -> None:
    instance = ro.load("blunders")
    result = ro.calibrate(instance.problem, ro.robust, 1.0)
    ro.plot_errors(ax, result)
    assert len(ax.lines[0].get_xdata()) == len(result.flagged) == 5
    assert ax.get_ylabel() == "error [mm]"
