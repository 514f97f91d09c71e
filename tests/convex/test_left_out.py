"""Configurations left out: by formula, by one Newton step, by triangles, against solving without their rows."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.convex import left_out, newton_step, select_held_out
from rpim_opt.convex.left_out import Folds, _folds, _rows, solved, solved_again, without_say
from rpim_opt.convex.newton_step import NewtonStep
from rpim_opt.convex.program import Program
from rpim_opt.convex.select_held_out import _left_out_error, held_out_error
from rpim_opt.problem.linear import LinearModel
from tests.convex.test_faces import box, whitened

MODEL = whitened()
ALONE = list(np.unique(MODEL.group)[:, None])
BOXED = ro.Formulation("boxed", penalty=cp.sum_squares, constraints=(box(-0.5, 0.5),))
GROUPS = ro.Formulation("groups", penalty=cp.sum, penalty_over=lambda p: np.split(np.eye(len(p)), 4))


def without(program: ro.convex.Program, part: np.ndarray) -> LinearModel:
    kept = ~np.isin(program.model.group, part)
    m = program.model
    return replace(m, A=m.A[kept], b=m.b[kept], group=m.group[kept])


@pytest.mark.parametrize("formulation", [ro.tikhonov, BOXED, ro.lasso, GROUPS], ids=lambda f: f.name)
@pytest.mark.parametrize("seen", [True, False])
def test_folds_of_triangles_are_fits_without_their_rows(formulation: ro.Formulation, seen: bool) -> None:
    """Also where what is left does not see a parameter: the rows of one configuration alone do."""
    m = MODEL
    if not seen:
        A = m.A.copy()
        A[3:, 2] = 0.0
        m = replace(m, A=A)
    program = ro.convex.pose(formulation, m)
    parts = [np.array([0, 5]), np.array([1]), np.arange(6, 12)]
    assert program.on_triangles
    weights = np.array([0.3, 30.0])
    found = Folds(program, parts).norms(weights)
    place = 0
    for part in parts:
        fold = ro.convex.pose(formulation, without(program, part))
        for k, weight in enumerate(weights):
            z = fold.solve(weight).z
            for j, g in enumerate(part):
                rows = m.group == g
                assert found[k, place + j] == pytest.approx(np.linalg.norm(m.A[rows] @ z - m.b[rows]), rel=1e-6)
        place += len(part)


@pytest.mark.parametrize(
    ("formulation", "off"),
    [(ro.tikhonov, 1e-9), (BOXED, 1e-7), (ro.lasso, 1e-7), (GROUPS, 1e-6), (ro.sum_of_norms, 1e-4), (ro.minimax, 1e-4)],
    ids=lambda v: getattr(v, "name", ""),
)
def test_weights_asked_for_later_get_what_they_would_have_got_alone(formulation: ro.Formulation, off: float) -> None:
    """Wherever they begin: between known weights, or with another part left out.

    What a rule compares is within 1e-10 of its minimum where Newton's method or quadratic programs find it: norms
    within 1e-5 of the root of that.
    """
    program = ro.convex.pose(formulation, MODEL)
    parts = [np.array([0, 5]), np.array([1]), np.arange(6, 12)]
    folds = Folds(program, parts)
    folds.norms(np.array([40.0, 2.0, 0.3]))
    later = np.array([1.2, 3.0, 0.3, 40.0])
    alone = np.vstack([Folds(ro.convex.pose(formulation, MODEL), parts).norms(later[[k]]) for k in range(4)])
    assert folds.norms(later) == pytest.approx(alone, rel=off)


@pytest.mark.parametrize("formulation", [ro.robust, ro.sum_of_norms, ro.minimax], ids=lambda f: f.name)
def test_equations_that_are_too_many_to_be_kept_for_every_part_are_left_out_when_asked(
    formulation: ro.Formulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts, weights = [np.array([0, 5]), np.array([1]), np.arange(6, 12)], np.array([40.0, 2.0, 0.3])
    program = ro.convex.pose(formulation, MODEL)
    kept = Folds(program, parts).norms(weights)
    monkeypatch.setattr(left_out, "KEPT", 3 * MODEL.A.nbytes - 1)
    made = []
    without = Program.without
    monkeypatch.setattr(Program, "without", lambda self, out: made.append(out) or without(self, out))
    folds = Folds(ro.convex.pose(formulation, MODEL), parts)
    assert made == []
    assert folds.norms(weights) == pytest.approx(kept, rel=1e-4)
    assert len(made) == 3


def test_what_few_have_a_say_in_is_not_solved_without_everybody(monkeypatch: pytest.MonkeyPatch) -> None:
    """Copies of all equations, one a configuration, fill the memory."""
    made = []
    monkeypatch.setattr(select_held_out, "Folds", lambda *asked: made.append(asked) or Folds(*asked))
    program = ro.convex.pose(ro.minimax, MODEL)
    quick = ro.leave_one_out(program)
    assert made == []
    assert quick.weight == pytest.approx(ro.leave_one_out(program, exact=True).weight, rel=1e-6)
    assert len(made) == 1


def test_a_step_of_squares_is_exact_where_the_face_stays() -> None:
    for formulation in (ro.tikhonov, BOXED, ro.lasso):
        program = ro.convex.pose(formulation, MODEL)
        weight = 0.05
        estimate = program.solve(weight)
        quick = NewtonStep(program).norms(estimate)
        same = []
        for part in ALONE:
            z = ro.convex.pose(formulation, without(program, part)).solve(weight).z
            bound = np.sign(z) * (np.abs(z) == 0.5)
            bound_of_all = np.sign(estimate.z) * (np.abs(estimate.z) == 0.5)
            signs = (np.sign(z) == np.sign(estimate.z)).all() or formulation is not ro.lasso
            same.append(bool(signs and (bound == bound_of_all).all()))
        slow = solved_again(program, np.array([weight]), ALONE)[0]
        assert sum(same) > 10
        assert quick[same] == pytest.approx(slow[same], rel=1e-6)


def test_steps_are_those_of_all_together_where_they_are_taken_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    program = ro.convex.pose(ro.robust, MODEL)
    estimate = program.solve(1.0)
    together = NewtonStep(program).norms(estimate)
    monkeypatch.setattr(newton_step, "TOGETHER", 4)
    assert len(together) > 4
    assert NewtonStep(program).norms(estimate) == pytest.approx(together, rel=1e-12)


@pytest.mark.parametrize(
    ("formulation", "off"),
    [(ro.lasso, 0.03), (GROUPS, 0.03), (ro.robust, 0.03), (ro.sum_of_norms, 0.1)],
    ids=lambda v: getattr(v, "name", ""),
)
def test_a_step_is_close(formulation: ro.Formulation, off: float) -> None:
    problem = ro.load("blunders").problem
    if formulation is GROUPS:
        formulation = ro.group_lasso
    program = ro.convex.pose(formulation, problem.linearize(np.zeros(len(problem.parameters.free))))
    weight = 20.0
    step = NewtonStep(program)
    assert step.serves
    quick = step.norms(program.solve(weight))
    slow = solved_again(program, np.array([weight]), list(np.unique(program.model.group)[:, None]))[0]
    assert np.linalg.norm(quick - slow) <= off * np.linalg.norm(slow)
    whole = program.norms(program.solve(weight).z)
    assert np.linalg.norm(quick - slow) < 0.3 * np.linalg.norm(whole - slow)


def test_only_smooth_sums_take_steps() -> None:
    for formulation, serves in (
        (ro.robust, True),
        (ro.minimax, False),
        (ro.Formulation("L1", loss=cp.norm1, penalty=cp.sum_squares), False),
        (ro.Formulation("Huber", loss=ro.huber(1.0), penalty=cp.sum_squares), True),
        (replace(ro.robust, penalty=cp.norm1), False),
        (ro.Formulation("largest", penalty=cp.norm_inf), False),
    ):
        assert NewtonStep(ro.convex.pose(formulation, MODEL)).serves is serves, formulation.name


def test_of_a_largest_norm_few_have_a_say() -> None:
    program = ro.convex.pose(ro.minimax, MODEL)
    for weight in (0.1, 100.0):
        z = program.solve(weight).z
        silent = without_say(program, z)
        assert 0 < np.count_nonzero(~silent) <= 13
        assert (program.norms(z)[silent] < program.norms(z).max() * (1 - 1e-5)).all()
    some = np.array([0.1, 10.0])
    assert _left_out_error(program, some) == pytest.approx(held_out_error(program, some), rel=1e-4)


def test_a_choice_says_how_far_off_its_steps_are_and_solves_all_on_demand() -> None:
    problem = ro.load("position").problem
    program = ro.convex.pose(ro.lasso, problem.linearize(np.zeros(len(problem.parameters.free))))
    quick, exact = ro.leave_one_out(program), ro.leave_one_out(program, exact=True)
    assert "by one Newton step each" in quick.note
    assert "% off in 6 that were solved" in quick.note
    assert exact.score == pytest.approx(held_out_error(program, exact.weights), rel=1e-6)
    assert "step" not in exact.note
    assert abs(np.log(quick.weight / exact.weight)) < 0.7
    assert partial(ro.leave_one_out, exact=True)(program).weight == exact.weight


def test_small_systems_are_solved_and_what_nothing_decides_is_zero() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(7, 3, 3))
    M = np.eye(3) + root @ np.swapaxes(root, 1, 2)
    v = rng.normal(size=(7, 3))
    found = solved(np.moveaxis(M, 0, -1), v.T)
    assert pytest.approx(np.linalg.solve(M, v[..., None])[..., 0], rel=1e-10) == found.T
    singular = np.diag([2.0, 0.0])[..., None]
    assert solved(singular, np.array([[4.0], [1.0]]))[:, 0].tolist() == [2.0, 0.0]


def test_a_fold_stands_for_the_equations_that_it_has() -> None:
    parts = [np.array([0, 5]), np.array([1]), np.arange(6, 12)]
    program = ro.convex.pose(ro.tikhonov, MODEL)
    counts = [len(without(program, part).b) for part in parts]
    assert [fold.model.equations for fold in _folds(program, _rows(program.model.group, parts))] == counts
