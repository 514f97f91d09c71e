"""A weight for each group of parameters: in the scales, chosen until it is its own answer, and said."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.bayes import Prior
from rpim_opt.calibration.group_weights import Grouped, members, reml_groups

POSITION = ro.load("position")
PROBLEM = POSITION.problem
FREE = PROBLEM.parameters.free
ASKED = {"alpha? theta?": ro.reml, "a? d?": ro.reml, "tool": 2.0}


def weights_of(result: ro.calibration.Calibration, asked: dict[str, object]) -> np.ndarray:
    """The weights (n,) of the parameters, from what the result says of its groups."""
    found = np.ones(len(FREE))
    assert result.selection is not None
    for key in asked:
        found[members(FREE, {key: ro.reml}).member == 0] = result.selection.groups[key]
    return found


def test_given_weights_are_those_of_a_weighted_penalty() -> None:
    asked = {"alpha? theta?": 4.0, "a? d?": 0.1, "base": 1e-3}
    result = ro.calibrate(PROBLEM, ro.tikhonov, asked)
    root = np.sqrt(weights_of(result, asked))
    mine = ro.Formulation("weighted", penalty=lambda z: cp.sum_squares(cp.multiply(root, z)))
    wanted = ro.calibrate(PROBLEM, mine, weight=1.0)
    sd = np.sqrt(np.diag(wanted.covariance))
    assert result.converged
    assert result.weight == 1.0
    assert np.abs(result.x - wanted.x).max() == pytest.approx(0, abs=1e-6 * sd.max())
    apart = (result.covariance - wanted.covariance) / np.outer(sd, sd)
    assert np.abs(apart).max() < 1e-6
    assert result.spread.degrees_of_freedom == pytest.approx(wanted.spread.degrees_of_freedom, rel=1e-6)


@pytest.mark.parametrize("name", ["position", "paper_arm", "distance"])
def test_one_group_ends_where_the_single_weight_does(name: str) -> None:
    instance = ro.load(name)
    result = ro.calibrate(instance.problem, ro.tikhonov, {"*": ro.reml})
    single = ro.calibrate(instance.problem, ro.tikhonov, weight=ro.reml)
    assert result.selection is not None
    assert np.log(result.selection.groups["*"] / single.weight) == pytest.approx(0, abs=2e-3)  # both settle at 0.1 %
    again = ro.calibrate(instance.problem, ro.tikhonov, weight=result.selection.groups["*"])
    assert result.x == pytest.approx(again.x, abs=1e-6 * np.abs(again.x).max())


def test_the_weights_are_their_own_answer() -> None:
    result = ro.calibrate(PROBLEM, ro.tikhonov, ASKED)
    assert result.converged
    values = weights_of(result, ASKED)
    model = PROBLEM.linearize(result.x)
    n = len(FREE)
    squares = Grouped(model, members(FREE, ASKED), np.ones(n), np.zeros(n), np.zeros((0, n)), np.zeros(0))
    answer = reml_groups(squares).groups
    for key in ASKED:
        assert np.log(answer[key] / result.selection.groups[key]) == pytest.approx(0, abs=2e-3)
    assert result.problem.parameters.free.scale == pytest.approx(FREE.scale / np.sqrt(values), rel=1e-12)


def test_scales_that_are_wrong_by_kind_are_made_good() -> None:
    table = PROBLEM.parameters
    scale = table.scale.copy()
    angles = np.array([name.startswith(("alpha", "theta", "beta")) for name in table.names])
    scale[angles] *= 30.0
    wrong = PROBLEM.with_parameters(replace(table, scale=scale))
    asked = {"alpha theta beta": ro.reml, "a d": ro.reml}
    results = [ro.calibrate(problem, ro.tikhonov, asked) for problem in (PROBLEM, wrong)]
    assert results[0].x == pytest.approx(results[1].x, abs=1e-4 * np.abs(results[0].x).max())
    ratio = results[1].selection.groups["alpha theta beta"] / results[0].selection.groups["alpha theta beta"]
    assert ratio == pytest.approx(900.0, rel=0.01)


def test_the_text_says_every_weight() -> None:
    text = str(ro.calibrate(PROBLEM, ro.tikhonov, ASKED))
    assert "Weights alpha? theta? 1." in text
    assert ", tool 2, others 1 (reml by group: largest restricted likelihood), formulation 'Tikhonov'." in text
    assert "given by group: as stated" in str(ro.calibrate(PROBLEM, ro.tikhonov, {"a?": 2.0}))


def test_a_file_holds_the_weights(tmp_path: Path) -> None:
    result = ro.calibrate(PROBLEM, ro.tikhonov, ASKED)
    ro.store.save_result(result, tmp_path)
    again = ro.load_result(tmp_path)
    assert again.selection.groups == result.selection.groups
    assert str(again) == str(result)
    assert again.asked(again.problem).x == pytest.approx(result.x, abs=1e-7 * np.abs(result.x).max())


@pytest.mark.slow
def test_without_flagged_rows_it_is_asked_anew_and_not_weighted_twice() -> None:
    problem = ro.load("blunders").problem
    asked = {"alpha? theta?": ro.reml, "a? d?": ro.reml}
    result = ro.calibrate(problem, ro.robust, asked)
    clean = result.without_flagged()
    wanted = ro.calibrate(problem.without({flag.label for flag in result.flagged}), ro.robust, asked)
    assert len(result.flagged) >= 5
    assert clean.x == pytest.approx(wanted.x, abs=1e-5 * np.abs(wanted.x).max())
    assert clean.selection.groups == pytest.approx(wanted.selection.groups, rel=1e-2)


def test_bounds_hold_in_their_own_units() -> None:
    problem = PROBLEM.with_parameters(PROBLEM.parameters.toleranced({"length_mm": 0.3, "angle_mrad": 0.5}))
    result = ro.calibrate(problem, ro.bounded, ASKED)
    assert result.converged
    free = problem.parameters.free
    assert (np.abs(result.x) <= free.tolerance * (1 + 1e-9)).all()
    assert result.held


def test_a_prior_stands_beside_the_weights() -> None:
    prior = Prior(centre={"d5_mm": 0.2}, scale={"a?_mm": 0.1}) & Prior.known("a2 + a3 = nominal + 0.3 +- 0.0001 mm")
    asked = {"alpha? theta?": 2.0, "a? d?": 0.5}
    result = ro.calibrate(PROBLEM, ro.tikhonov, asked, prior=prior)
    values = weights_of(result, asked)
    stated = prior.stated(PROBLEM.parameters, widened=False)

    def penalty(z: cp.Variable) -> cp.Expression:
        own = cp.multiply(np.sqrt(values) / stated.scale, z - stated.centre)
        return cp.sum_squares(own) + cp.sum_squares(stated.rows @ z - stated.values)

    wanted = ro.calibrate(PROBLEM, ro.Formulation("by hand", penalty=penalty), weight=1.0)
    assert result.x == pytest.approx(wanted.x, abs=1e-6 * np.abs(wanted.x).max())
    a2, a3 = (result.x[FREE.names.index(name)] for name in ("a2", "a3"))
    assert a2 + a3 == pytest.approx(3e-4, abs=2e-6)
    chosen = ro.calibrate(PROBLEM, ro.tikhonov, ASKED, prior=prior)
    assert chosen.converged


@pytest.mark.parametrize(
    ("formulation", "asked", "says"),
    [
        (ro.least_squares, {"a?": 2.0}, "one with a penalty"),
        (ro.lasso, {"a?": ro.reml}, "sums squared deviations"),
        (ro.tikhonov, {"a?": ro.gcv}, "'gcv' for groups"),
        (ro.tikhonov, {"q?": ro.reml}, "'q?'"),
    ],
)
def test_what_cannot_be_is_refused(formulation: ro.Formulation, asked: dict[str, object], says: str) -> None:
    with pytest.raises(ro.InputError) as error:
        ro.calibrate(PROBLEM, formulation, asked)
    assert says in str(error.value)


def test_numbers_serve_any_penalty() -> None:
    result = ro.calibrate(PROBLEM, ro.lasso, {"a?": 4.0})
    wanted = ro.Formulation(
        "by hand",
        penalty=lambda z: cp.norm1(
            cp.multiply([2.0 if name[0] == "a" and len(name) == 2 else 1.0 for name in FREE.names], z)
        ),
    )
    assert result.x == pytest.approx(ro.calibrate(PROBLEM, wanted, weight=1.0).x, abs=1e-5 * np.abs(result.x).max())
