"""A chart is described once: on a page and on matplotlib's axes the same things stand at the same places."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.report.chart import Axis, Boxes, Chart, Dots, Line, Picture, Scale, segments
from rpim_opt.report.page import TEMPLATES
from rpim_opt.report.plot import COLORS, draw

mpl.use("Agg")
from matplotlib import pyplot as plt

AXES = {
    "linear": Axis("x", (-3.0, 7.0)),
    "counts": Axis("x", (0, 12)),
    "logarithmic": Axis("x", (2e-3, 40.0), log=True),
    "one value": Axis("x", (5.0, 5.0), log=True),
    "both signs": Axis("x", (-0.02, 30.0), linear_to=0.1),
    "names": Axis("x", names=("p", "q", "r", "s")),
}


def places(axis: Axis) -> np.ndarray:
    """Return values between an axis's limits, spread over it."""
    low, high = axis.limits
    if axis.log:
        return np.geomspace(low, high, 9)
    return np.sort(np.append(np.linspace(low, high, 9), low + 0.006 * (high - low)))


@pytest.mark.parametrize("name", AXES)
@pytest.mark.parametrize("which", ["x", "y"])
def test_values_are_at_the_same_place_on_page_and_paper(name: str, which: str) -> None:
    axis = AXES[name]
    values = places(axis)
    other = np.linspace(0, 1, len(values))
    pair = {"x": values, "y": other} if which == "x" else {"x": other, "y": values}
    both = {"x": Axis("o"), "y": Axis("o"), which: axis}
    chart = Chart("c", both["x"], both["y"], [Dots(pair["x"], pair["y"], "after", hints=["h"] * len(values))])
    picture = Picture(chart)
    scale = picture.x if which == "x" else picture.y
    on_page = (scale(values) - scale.start) / (scale.end - scale.start)
    if which == "y" and axis.names:
        on_page = 1 - on_page  # from above to below, on either
    ax = draw(chart)
    drawn = ax.lines[0].get_xydata()
    on_paper = ax.transAxes.inverted().transform(ax.transData.transform(drawn))[:, "xy".index(which)]
    plt.close(ax.figure)
    assert on_page == pytest.approx(on_paper, abs=1e-4)  # of 400 pixels with two digits


@pytest.mark.parametrize("ends", [(-5.0, 8.0), (0.0, 0.01), (-2000.0, 3.0)])
def test_ticks_to_both_signs_are_zero_and_decades(ends) -> None:
    ticks = Scale(Axis("x", ends, linear_to=0.1)).ticks()
    values = np.array([value for value, _ in ticks])
    assert 3 <= len(ticks) <= 9
    assert 0 in values
    assert np.log10(np.abs(values[values != 0])) % 1 == pytest.approx(0, abs=1e-9)
    assert all(float(text) == pytest.approx(value) for value, text in ticks)


def test_everything_that_can_be_drawn_is_drawn_on_both() -> None:
    x = np.array([1.0, 2.0, 3.0])
    marks = [
        Line(x, x, "ink", "line", dashed=True),
        Line(segments(np.column_stack([x, x])), segments(np.column_stack([x - 1, x])), "before"),
        Dots(x, x, "after", "dots", ["a", "b", "c"], hollow=True),
        Dots(x, x, "other", "points"),
        Dots(x, x, "mark", "each", ["one", "two", "three"], each=True),
        Boxes(x - 1, x, 0 * x, x, "before", "boxes", ["d", "e", "f"]),
    ]
    chart = Chart("all", Axis("x [mm]", (0, 4)), Axis("y", (0, 4)), marks, "A note.")
    svg = ElementTree.fromstring(Picture(chart).svg())
    classes = [item.get("class") for item in svg]
    assert classes.count("dot after hollow") == 3
    assert classes.count("box before") == 3
    assert "line ink dashed" in classes
    assert svg.find("path[@class='line before']").get("d").count("M") == 3
    assert [text for _, text in chart.legend] == ["line", "dots", "points", "each", "boxes"]
    ax = draw(chart)
    said = [text.get_text() for text in ax.get_legend().get_texts()]
    assert said == ["line", "dots", "points", "one", "two", "three", "boxes"]
    assert len(ax.patches) == 3
    assert ax.get_xlabel() == "x [mm]\nA note."
    plt.close(ax.figure)


def test_paper_has_the_colours_of_the_page_in_light() -> None:
    style = (TEMPLATES / "page.css").read_text(encoding="utf-8")
    light = dict(re.findall(r"--(\w+): (#\w{6})", style.split("@media")[0]))
    assert {role: COLORS[role] for role in ("before", "after", "mark", "other")} == {
        role: light[role] for role in ("before", "after", "mark", "other")
    }
    assert COLORS["ink"] == light["soft"]


def test_errors_of_touches_are_along_the_axes_of_the_robot() -> None:
    problem = ro.load("position").problem
    arm = ro.calibrate(problem, ro.tikhonov, 1.0)
    touched = problem.on(ro.data.touches(problem.data.q[:6], ["A"] * 3 + ["B"] * 3, sigma=1e-4))
    assert ro.plot.error_axes(arm).get_xlabel() == "axis of the instrument"
    axes = ro.plot.error_axes(ro.calibrate(touched, ro.tikhonov, 1.0))
    assert axes.get_xlabel() == "axis of the robot's base"
    assert axes.get_ylabel() == "mean of the point minus touch [mm]"
    plt.close("all")
