"""A page shows the figures of ``ro.plot``, with its own colours and with tooltips."""

from __future__ import annotations

import re
from functools import partial
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.convex.rules.selection import Selection
from rpim_opt.report.page import TEMPLATES, figure
from rpim_opt.report.plot import COLORS
from rpim_opt.report.summary import signed_errors

mpl.use("Agg")
from matplotlib import pyplot as plt

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def result() -> ro.calibration.Calibration:
    return ro.calibrate(ro.load("position").problem, ro.tikhonov, 1.0)


def test_a_chart_has_a_tooltip_at_every_mark_and_its_texts_as_text(result) -> None:
    svg, _ = figure(partial(ro.plot.errors, result), "Errors & more")
    root = ElementTree.fromstring(svg)
    assert root.get("aria-label") == "Errors & more"
    hints = [title.text for title in root.iter(f"{SVG}title")]
    assert len(hints) == 2 * len(result.problem.data)
    label, error = result.problem.data.label[3], 1e3 * result.errors()[3]
    assert f"{label}, identified: {error:.3f} mm" in hints
    assert {"error [mm]", "row", "nominal", "identified", label} <= {text.text for text in root.iter(f"{SVG}text")}


def test_a_chart_has_no_style_and_nothing_is_loaded(result) -> None:
    svg, _ = figure(partial(ro.plot.parameters, result), "Deviations")
    assert "style" not in svg
    assert "url(" not in re.sub(r"url\(#\w+\)", "", svg)
    assert svg == figure(partial(ro.plot.parameters, result), "Deviations")[0]


def test_thousands_of_rows_are_one_picture(result) -> None:
    data = result.problem.data.take(np.arange(3000) % len(result.problem.data))
    svg, _ = figure(partial(ro.plot.errors, result, data), "Errors")
    assert svg.count("data:image/png") >= 1
    assert len(svg) < 500_000


def test_paper_has_the_colours_of_the_page_in_light() -> None:
    style = (TEMPLATES / "page.css").read_text(encoding="utf-8")
    light = dict(re.findall(r"--(\w+): (#\w{6})", style.split("@media")[0]))
    assert {role: COLORS[role] for role in ("before", "after", "mark", "other")} == {
        role: light[role] for role in ("before", "after", "mark", "other")
    }
    assert COLORS["ink"] == light["soft"]


@pytest.mark.parametrize(("low", "high"), [(0.05, 2.0), (0.02, 0.9), (0.4, 30.0)])
def test_an_axis_of_little_more_than_a_decade_has_more_than_one_tick(low: float, high: float) -> None:
    weights = np.geomspace(low, high, 9)
    ax = ro.plot.selection(Selection(float(weights[4]), "mine", weights, weights, True))
    ends = ax.get_xlim()
    assert sum(ends[0] <= tick <= ends[1] for tick in ax.get_xticks()) >= 3
    plt.close(ax.figure)


def test_errors_of_touches_are_along_the_axes_of_the_robot(result) -> None:
    problem = result.problem
    touched = problem.on(ro.data.touches(problem.data.q[:6], ["A"] * 3 + ["B"] * 3, sigma=1e-4))
    assert signed_errors(result, problem.data)[0] == "Measured minus modelled along the axes of the instrument"
    what, _ = signed_errors(ro.calibrate(touched, ro.tikhonov, 1.0), touched.data)
    assert what == "Mean of the point minus touch along the axes of the robot's base"
