"""A page shows the figures of ``ro.plot``, in its own colours."""

from __future__ import annotations

import re
from base64 import b64decode
from collections.abc import Callable
from functools import partial
from typing import Any
from xml.etree import ElementTree

import matplotlib as mpl
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.report.page import TEMPLATES, figure
from rpim_opt.report.plot import COLORS
from rpim_opt.report.summary import signed_errors

mpl.use("Agg")

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def result() -> ro.calibration.Calibration:
    return ro.calibrate(ro.load("position").problem, ro.tikhonov, 1.0)


def svg(draw: Callable[..., Any], title: str) -> str:
    return b64decode(figure(draw, title).source.removeprefix("data:image/svg+xml;base64,")).decode()


def test_a_chart_has_its_texts_as_text(result) -> None:
    root = ElementTree.fromstring(svg(partial(ro.plot.errors, result), "Errors"))
    label = result.problem.data.label[3]
    assert {"error [mm]", "row", "nominal", "identified", label} <= {text.text for text in root.iter(f"{SVG}text")}


def test_a_chart_is_the_same_again(result) -> None:
    again = [figure(partial(ro.plot.parameters, result), "Deviations") for _ in range(2)]
    assert again[0] == again[1]


def test_thousands_of_rows_are_one_picture(result) -> None:
    data = result.problem.data.take(np.arange(3000) % len(result.problem.data))
    drawn = svg(partial(ro.plot.errors, result, data), "Errors")
    assert drawn.count("data:image/png") >= 1
    assert len(drawn) < 500_000


def test_paper_has_the_colours_of_the_page_in_light() -> None:
    style = (TEMPLATES / "page.css").read_text(encoding="utf-8")
    light = dict(re.findall(r"--(\w+): (#\w{6})", style.split("@media")[0]))
    assert {role: COLORS[role] for role in ("before", "after", "mark")} == {
        role: light[role] for role in ("before", "after", "mark")
    }
    assert COLORS["ink"] == light["soft"]


def test_errors_of_touches_are_along_the_axes_of_the_robot(result) -> None:
    problem = result.problem
    touched = problem.on(ro.data.touches(problem.data.q[:6], ["A"] * 3 + ["B"] * 3, sigma=1e-4))
    assert signed_errors(result, problem.data)[0] == "Measured minus modelled along the axes of the instrument"
    what, _ = signed_errors(ro.calibrate(touched, ro.tikhonov, 1.0), touched.data)
    assert what == "Mean of the point minus touch along the axes of the robot's base"
