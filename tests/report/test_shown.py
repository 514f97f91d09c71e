"""Objects show themselves in a line, in a notebook as a table, and as data frames."""

from __future__ import annotations

from xml.etree import ElementTree

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics import InputError
from rpim_opt.report import console

INSTANCE = ro.load("position")
RESULT = ro.calibrate(INSTANCE.problem, ro.tikhonov, weight=ro.reml)
OBJECTS = {
    "instance": INSTANCE,
    "problem": INSTANCE.problem,
    "data": INSTANCE.problem.data,
    "block": INSTANCE.problem.data.blocks[0],
    "measurement": INSTANCE.problem.data.blocks[0].measurement,
    "robot": INSTANCE.problem.robot,
    "parameters": INSTANCE.problem.parameters,
    "result": RESULT,
    "linear": RESULT.fit_covariance.linear,
    "identified": RESULT.program.model.parameters,
    "selection": RESULT.selection,
    "program": RESULT.program,
    "estimate": RESULT.program.solve(1.0),
    "uncertainty": ro.calibration.Uncertainty(RESULT),
    "influence": ro.influence(RESULT),
    "inspection": ro.calibration.inspect(INSTANCE.problem),
    "observability": ro.problem.observe(INSTANCE.problem),
    "formulation": ro.robust,
    "prediction": RESULT.predict(INSTANCE.validation.q[:3]),
    "learned": ro.calibrate(INSTANCE.problem).learned,
}
TABLED = (
    "instance", "problem", "data", "parameters", "result", "selection", "uncertainty", "inspection", "identified",
    "influence",
)  # fmt: skip


@pytest.mark.parametrize("name", OBJECTS)
def test_a_repr_is_one_short_line(name: str) -> None:
    text = repr(OBJECTS[name])
    assert len(text) <= 200
    assert "\n" not in text
    assert text.startswith(f"<{type(OBJECTS[name]).__name__} ")


@pytest.mark.parametrize("name", TABLED)
def test_a_notebook_shows_a_table(name: str) -> None:
    page = ElementTree.fromstring(OBJECTS[name]._repr_html_())
    assert len(page.findall(".//tr")) > 3
    first = page.find("p/b")
    assert first is not None
    assert page[0][0] is first  # what it is stands above the table
    assert first.text == repr(OBJECTS[name])[1:-1]
    cells = [cell.text or "" for cell in page.findall(".//td")]
    assert not {"True", "False", "None"} & set(cells)
    assert max(map(len, cells)) < 30


def test_long_tables_are_cut_in_notebooks_and_whole_in_frames() -> None:
    parameters = INSTANCE.problem.parameters
    assert len(parameters) > 60
    assert parameters._repr_html_().count("<tr>") == 61
    assert "and 54 more rows" in parameters._repr_html_()
    assert len(parameters.to_frame()) == len(parameters) == 114


def test_names_of_a_file_are_text_in_a_notebook() -> None:
    """A title is shown, and never run."""
    robot = ro.robot.Robot("<script>alert(1)</script>", INSTANCE.problem.robot.mdh)
    problem = ro.CalibrationProblem(robot, INSTANCE.problem.parameters, INSTANCE.problem.data)
    assert "<script" not in problem._repr_html_()


def test_frames_hold_what_the_tables_say() -> None:
    frame = RESULT.to_frame()
    assert list(frame["parameter"]) == list(INSTANCE.problem.parameters.free.names)
    assert np.allclose(frame["identified"] - frame["nominal"], frame["deviation"]) is False  # angles of frames compose
    budget = ro.calibration.Uncertainty(RESULT).to_frame()
    assert np.allclose(budget["u"] ** 2, budget["u_noise"] ** 2 + budget["u_prior"] ** 2)
    assert np.allclose(INSTANCE.problem.data.to_frame()["x_mm"], 1e3 * INSTANCE.problem.data.blocks[0].y[:, 0])


@pytest.mark.parametrize(
    ("formulation", "where", "why"),
    [
        (ro.Formulation("mine", loss=lambda r: -cp.sum_squares(r)), "loss", "concave"),
        (ro.Formulation("mine", penalty=lambda z: cp.sum(cp.sqrt(cp.abs(z)))), "penalty", "abs(z) convex"),
        (
            ro.Formulation("mine", constraints=(ro.in_ball(2.0, "*"), lambda z, p: cp.norm(z) >= 1)),
            "cp.norm(z) >= 1",
            "convex <= concave",
        ),
        (
            ro.Formulation("mine", constraints=(lambda z, p: cp.exp(z[0]) == 1,)),
            "cp.exp(z[0]) == 1",
            "affine == affine",
        ),
        (
            ro.Formulation("mine", loss=lambda v: -cp.sum(v), loss_over="configuration"),
            "loss",
            "nondecreasing over norms",
        ),
    ],
)
def test_what_is_not_convex_is_named_with_its_reason(formulation: ro.Formulation, where: str, why: str) -> None:
    with pytest.raises(InputError) as error:
        ro.calibrate(INSTANCE.problem, formulation, weight=1.0)
    assert error.value.where == f"formulation 'mine', {where}"
    assert error.value.found == "a program that is not convex"
    assert why in error.value.accepted


def test_a_plot_of_a_result_marks_its_weight() -> None:
    ax = ro.plot.l_curve(RESULT)
    assert [text.get_text() for text in ax.get_legend().get_texts()] == [f"chosen: reml, weight {RESULT.weight:.2g}"]
    (marked,) = [line for line in ax.lines if line.get_marker() != "None"]
    loss, penalty = RESULT.program.value(RESULT.z)
    assert marked.get_xdata()[0] == pytest.approx(np.sqrt(loss), rel=1e-6)
    assert marked.get_ydata()[0] == pytest.approx(np.sqrt(penalty), rel=1e-6)


def test_what_is_piped_while_a_command_works_stays_out_of_its_progress(monkeypatch, capsys) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")  # a terminal on stderr, and none on stdout
    with console.progress() as say:
        say("working")
        console.show("the text")
    said = capsys.readouterr()
    assert said.out == "the text\n"
    assert "working" in said.err
