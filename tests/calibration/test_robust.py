"""Blunders: named, and harmless under a robust loss."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.store import problems_folder
from tests.test_cli import run

BLUNDERS = set(tomllib.loads((problems_folder() / "blunders" / "truth.toml").read_text())["blunders"])


def test_all_published_points_with_the_two_misprints() -> None:
    instance = ro.load("paper_arm", "misprints")
    result = instance.calibrate()
    assert result.converged
    assert len(instance.problem.data) == 27
    assert [flag.label for flag in result.flagged[:2]] == ["T8-6", "T8-7"]
    index = {label: i for i, label in enumerate(instance.problem.data.label)}
    off = 1e3 * np.abs(result.problem.residual(result.x).reshape(-1, 3))
    assert off[index["T8-6"], 2] == pytest.approx(38.0, abs=0.05)
    assert off[index["T8-7"], 2] == pytest.approx(15.0, abs=0.05)
    clean = [i for label, i in index.items() if label not in ("T8-6", "T8-7")]
    assert 1e3 * result.errors()[clean].mean() <= 0.020
    squared = ro.calibrate(instance.problem, ro.tikhonov, ro.reml)
    assert 1e3 * squared.errors()[clean].mean() > 1.0
    assert "bias a squared loss" in str(squared)


@pytest.mark.parametrize("formulation", [ro.robust, ro.sum_of_norms])
def test_blunders_are_named_and_a_refit_leaves_them_out(formulation: ro.Formulation) -> None:
    instance = ro.load("blunders")
    result = ro.calibrate(instance.problem, formulation, ro.reml)
    assert result.converged
    assert {flag.label for flag in result.flagged} == BLUNDERS
    assert all(90 < flag.sigmas < 110 for flag in result.flagged)  # 3 mm over 0.03 mm
    assert 1e3 * result.errors(instance.validation).mean() < 0.045
    refit = result.without_flagged()
    assert len(refit.flagged) <= 1  # one good set of data in a hundred is suspected, and so is one of c20's tail here
    assert 1e3 * refit.errors(instance.validation).mean() < 0.032


def test_without_blunders_a_robust_loss_costs_little() -> None:
    instance = ro.load("position")
    mean = [
        ro.calibrate(instance.problem, f, ro.reml).errors(instance.validation).mean() for f in (ro.tikhonov, ro.robust)
    ]
    assert mean[1] < 1.25 * mean[0]
    assert not ro.calibrate(instance.problem, ro.robust, ro.reml).flagged


def test_the_command_names_and_refits(monkeypatch, capsys) -> None:
    assert (
        run(monkeypatch, "calibrate", "blunders", "--formulation", "robust", "--selector", "reml", "--drop-outliers")
        == 0
    )
    out = capsys.readouterr().out
    assert "Refitted without " in out
    assert all(label in out for label in BLUNDERS)
    assert run(monkeypatch, "calibrate", "paper_arm", "--variant", "misprints") == 0
    assert "Outliers: T8-6 (" in capsys.readouterr().out
    assert run(monkeypatch, "calibrate", "paper_arm", "--formulation", "robust", "--drop-outliers") == 0
    said = capsys.readouterr().out
    assert said.startswith("No flagged row to drop: nothing was refitted.")
    assert "Excluded before the fit: 2 rows, T8-6, " in said
