"""Figures show what was chosen."""

from __future__ import annotations

from itertools import pairwise

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


def test_the_l_curve_trades_residuals_for_deviations(ax, tmp_path) -> None:
    problem = ro.load("position").problem
    ro.plot.l_curve(ro.convex.pose(ro.tikhonov, problem.linearize(np.zeros(len(problem.parameters.free)))), ax)
    (curve,) = ax.lines
    assert (np.diff(curve.get_xdata()) > 0).all()  # the residual grows with the weight, the solution shrinks
    assert (np.diff(curve.get_ydata()) < 0).all()
    ax.figure.savefig(tmp_path / "l.svg")


def drawn(ax, label: str):
    """Return the line of a label."""
    return next(line for line in ax.lines if line.get_label() == label)


def test_the_l_curve_of_what_is_no_norm_says_so(ax) -> None:
    ro.plot.l_curve(ro.calibrate(ro.load("position").problem, ro.group_lasso, 1.0), ax=ax)
    assert ax.get_xlabel() == "residual norm [standard deviations of the noise]"
    assert ax.get_ylabel() == "root of the penalty"


def test_flagged_rows_are_marked(ax) -> None:
    instance = ro.load("blunders")
    result = ro.calibrate(instance.problem, ro.robust, 1.0)
    ro.plot.errors(result, ax=ax)
    marked = drawn(ax, "flagged")
    labels = result.problem.data.label
    assert {labels[round(x) - 1] for x in marked.get_xdata()} == {flag.label for flag in result.flagged}
    assert len(marked.get_xdata()) == 5
    errors = 1e3 * result.errors(result.problem.data)
    assert marked.get_ydata() == pytest.approx([errors[round(x) - 1] for x in marked.get_xdata()], rel=1e-12)
    assert ax.get_ylabel() == "error [mm]"


@pytest.fixture(scope="module")
def fitted() -> tuple[ro.store.Instance, ro.calibration.Calibration]:
    instance = ro.load("constrained", "wrong_tolerance")
    return instance, ro.calibrate(instance.problem, instance.formulation, ro.reml)


def test_figures_show_the_numbers_of_the_result(ax, fitted) -> None:
    _, result = fitted
    ro.plot.parameters(result, ax=ax)
    names = [text.get_text() for text in ax.get_yticklabels()]
    x = dict(zip(result.problem.parameters.free.names, 1e3 * result.x, strict=True))
    assert drawn(ax, "deviation, 95 % interval").get_xdata() == pytest.approx([x[name] for name in names], rel=1e-12)
    (tolerance,) = [each for each in ax.collections if each.get_label() == "tolerance"]
    ends = np.array(tolerance.get_segments())[:, :, 0]
    assert set(np.abs(ends.ravel())) == {1.5}  # the tolerance that the file states


def overlapping(axis) -> int:
    """Count labels of ticks that touch the next one."""
    axis.figure.canvas.draw()
    boxes = [label.get_window_extent() for label in axis.get_ticklabels() if label.get_text()]
    return sum(one.overlaps(other) for one, other in pairwise(boxes))


@pytest.mark.parametrize("count", [40, 60, 120, 1000])
def test_labels_of_rows_do_not_overlap(ax, fitted, count: int) -> None:
    _, result = fitted
    data = result.problem.data.take(np.arange(count) % len(result.problem.data))
    ro.plot.errors(result, data, ax)
    assert overlapping(ax.xaxis) == 0
    named = [text.get_text() for text in ax.get_xticklabels()]
    if count > 60:  # dots, none of which could be found
        assert named != list(data.label[: len(named)])
        return
    step = int(np.ceil(count / len(named)))
    assert named == list(data.label[::step])  # letters of all would be too small to be read
    assert min(label.get_fontsize() for label in ax.get_xticklabels()) >= 6


def test_names_of_many_parameters_do_not_overlap(fitted) -> None:
    _, result = fitted
    both = ro.together(spring=result.problem, autumn=result.problem, shared=["tool_*"])
    ax = ro.plot.parameters(ro.calibrate(both, ro.tikhonov, 1.0), "angle")
    assert len(ax.get_yticks()) > 24
    assert overlapping(ax.yaxis) == 0
    assert min(label.get_fontsize() for label in ax.get_yticklabels()) > 6
    plt.close(ax.figure)


def test_axes_are_made_and_carry_units(fitted) -> None:
    _, result = fitted
    axes = [ro.plot.errors(result), ro.plot.parameters(result), ro.plot.parameters(result, "angle")]
    said = [ax.get_xlabel() + ax.get_ylabel() for ax in axes]
    assert all("[" in text for text in said)
    for ax in axes:
        plt.close(ax.figure)


def test_errors_have_a_direction_where_a_position_was_measured() -> None:
    instance = ro.load("mixed")
    result = ro.calibrate(instance.problem, ro.tikhonov, 1.0)
    for nominal in (False, True):
        length = np.linalg.norm(result.error_vectors(nominal=nominal), axis=1)
        positions = np.isfinite(length)
        assert 0 < positions.sum() < len(length)
        want = result.nominal_errors() if nominal else result.errors()
        assert length[positions] == pytest.approx(want[positions], rel=1e-12)
