"""What a comparison says of its rows, in words, as a page and as a figure, and what it is asked on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.study import Report
from rpim_opt.study.methods import UNDELIVERED, problems_of
from rpim_opt.study.studies import load_study, write
from tests import ROOT
from tests.study.test_comparison import POSITION, rows_of

Errors = dict[str, dict[str, float | None]]
SIX = [f"p{k}" for k in range(6)]


def compared(errors: Errors, **changed: Any) -> ro.study.Comparison:
    """Return a comparison of given errors, of which some rows may be changed."""
    return ro.study.Comparison(tuple({**row, **changed} for row in rows_of(errors)), ("rms_mm",))


def even(size: float) -> dict[str, float | None]:
    return dict.fromkeys(SIX, size)


def test_without_intervals_none_is_said() -> None:
    found = compared({"a": {"p": 1.0}, "b": {"p": 0.5}})
    assert any("There are no intervals" in note for note in found.summary().notes)
    alone = compared({"a": {"p": 1.0}}).summary()
    assert not any("There are no intervals" in note for note in alone.notes)


def test_what_has_no_figures_is_named_and_nothing_is_summed_up() -> None:
    broken = compared({"a": {"p": None}})
    assert str(broken) == repr(broken) == "Comparison: 1 method on 1 problem, 1 replicates (1 failed)"
    some = compared({"a": {"p": 1.0}, "b": {"p": None}})
    assert str(some).startswith(f"{some!r}\n\n")
    for against, said in (("c", "against: found 'c'"), ("b", "'b', which has no results")):
        with pytest.raises(ro.InputError, match=said):
            some.summary(against=against)
    with pytest.raises(ro.InputError, match="metric: found 'max_mm', accepted: one to minimize: rms_mm"):
        some.summary("max_mm")


def test_coverage_is_a_column_and_ranks_nothing() -> None:
    """95 is best: a method whose intervals cover nothing was first."""
    found = ro.compare("position", selectors=[1.0, 2.0], metrics=["rms_mm", "covered_percent"], progress=False)
    assert found.rows[0]["covered_percent"] > 80
    for ranked in (found.summary, found.plot):
        with pytest.raises(ro.InputError, match="found 'covered_percent', accepted: one to minimize: rms"):
            ranked("covered_percent")


def test_replicates_that_are_not_delivered_are_counted() -> None:
    found = compared({"a": even(1.0), "b": even(0.5)}, status=UNDELIVERED, reason="")
    notes = found.summary().notes
    assert "b: not delivered, 6 of 6 replicates. Their figures are included; the column `reason` states why." in notes


@pytest.mark.parametrize("largest", [5.0, 2.0])
def test_held_out_readings_that_are_wrong_for_every_method_are_noted(largest: float) -> None:
    found = compared({"a": even(1.0), "b": even(0.5)}, mean_mm=0.3, max_mm=largest)
    assert any("gross readings" in note for note in found.summary().notes) == (largest > 3)


def test_a_fit_that_no_robot_has_is_not_delivered() -> None:
    found = ro.compare("position", "tikhonov", ["reml", 1e9], splits=2, progress=False)
    assert [row["status"] for row in found.rows] == ["ok", "not delivered"] * 2
    assert found.rows[1]["reason"].startswith("Residual RMS ")
    assert found.rows[1]["rms_mm"] > 1
    assert "2 ok, 2 not delivered" in repr(found)
    assert found.summary().notes[-1].startswith("tikhonov, 1e+09: not delivered, 2 of 2 replicates.")


@pytest.mark.slow
def test_the_page_says_of_many_problems_how_many_and_which_have_no_figure(tmp_path: Path) -> None:
    some = {**even(0.5), "p4": None, "p5": None}
    found = compared({"a": even(1.0), "b": even(50.0), "c": some})
    page = found.report(tmp_path / "out").read_text(encoding="utf-8")
    assert "3 methods on 6 problems" in page
    assert "p4, p5" in page
    assert "| b | 50 |" in page
    assert "| c | 0.5 | 0.5 | 0.5 | 0.5 | - | - |" in page
    all_of_them = compared({"a": even(1.0), "b": even(0.5) | dict.fromkeys(SIX)}).report(tmp_path / "all")
    assert "6 of 6 replicates" in all_of_them.read_text(encoding="utf-8")


def test_intervals_tell_by_colour_what_is_better_and_what_worse() -> None:
    axes = compared({"a": even(1.0), "b": even(2.0), "c": even(0.5)}).plot().axes[0]
    bars = {round(line.get_xdata()[0], 6): line.get_color() for line in axes.lines if line.get_linewidth() == 2}
    assert bars == {1.0: "0.3", 2.0: "C3", 0.5: "C2"}


def test_a_method_without_figures_is_not_drawn() -> None:
    lost = compared({"a": even(1.0), "b": dict.fromkeys(SIX)})
    assert [text.get_text() for text in lost.plot().axes[0].get_yticklabels()] == ["a"]


# --- what it is asked on -------------------------------------------------------------------------------------------


def test_problems_come_as_a_pair_or_as_a_file() -> None:
    pair = (POSITION.problem, POSITION.validation)
    assert problems_of(pair)["ABB IRB 120-3/0.58"].problem == POSITION.problem
    assert list(problems_of(ROOT / "problems" / "position" / "problem.toml")) == ["position"]


def test_a_generator_returns_problems() -> None:
    found = ro.compare({"mine": lambda seed: seed}, selectors=1.0, seeds=[7], progress=False)
    assert "problem mine: found a function of a seed that returns no problem (7)" in found.rows[0]["reason"]


def test_folds_need_as_many_configurations() -> None:
    data = POSITION.problem.data
    few = POSITION.problem.on(data.take(np.flatnonzero(data.configuration < 4)))
    found = ro.compare(few, selectors=1.0, splits=5, progress=False)
    assert "splits: found 4 configurations, accepted: at least 5 for 5 folds" in found.rows[0]["reason"]


def test_a_study_is_a_python_file(tmp_path: Path) -> None:
    with pytest.raises(ro.InputError, match="a Python file"):
        load_study(tmp_path / "study.txt")


def test_figures_of_a_study_stand_beside_its_text(tmp_path: Path) -> None:
    from matplotlib.figure import Figure

    figures = []
    for _ in range(2):
        figure = Figure(figsize=(2, 1))
        figure.subplots().plot([0, 1])
        figures.append(figure)
    for folder, figure in zip(("one", "two"), figures, strict=True):
        write(tmp_path / folder, "Why?", Report("Because.", {"n": 1}, {"curve": figure}), "", {})
    assert sorted(path.name for path in (tmp_path / "one").iterdir()) == [
        "README.md", "curve.png", "curve.svg", "metrics.json",
    ]  # fmt: skip
    assert "![curve](curve.svg)" in (tmp_path / "one" / "README.md").read_text()
    assert (tmp_path / "one" / "curve.svg").read_bytes() == (tmp_path / "two" / "curve.svg").read_bytes()
