"""Ready constraints, groups and losses: which parameters they take, what they demand of them, how a file holds them."""

from __future__ import annotations

import pickle
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.convex.constraints import (
    Box,
    as_text,
    at_nominal,
    by_kind,
    by_link,
    differences,
    equal,
    matching,
    signed,
)
from rpim_opt.convex.formulation import unavailable
from rpim_opt.robot import Parameters

NAMES = ("alpha1", "a1", "alpha2", "a2", "base_x", "base_rz", "tool_x", "d12")
KINDS = ("angle", "length", "angle", "length", "length", "angle", "length", "length")
SCALE = np.array([1e-3, 5e-4, 2e-3, 1e-3, 5e-3, 5e-3, 5e-3, 1e-3])
NOMINAL = np.array([0.0, 0.1, 1.5, 0.45, 1.0, 0.2, 0.3, 0.0])
TOLERANCE = np.array([np.inf, 1e-3, 1e-3, np.inf, np.inf, np.inf, np.inf, 2e-3])
P = Parameters(NAMES, KINDS, NOMINAL, SCALE, TOLERANCE, np.ones(8, dtype=bool))


def met(constraint: Any, z: np.ndarray) -> bool:
    v = cp.Variable(8, value=z)
    made = constraint(v, P)
    return all(bool(c.value(1e-9)) for c in (made if isinstance(made, list) else [made]))


def box(lower: Any, upper: Any) -> Box:
    return Box("mine", lambda p: (lower, upper))


def test_tolerances_are_bounds_in_scales() -> None:
    lower, upper = ro.within_tolerance.bounds(P)
    assert upper == pytest.approx([np.inf, 2.0, 0.5, np.inf, np.inf, np.inf, np.inf, 2.0])
    assert (lower == -upper).all()
    none = Parameters(NAMES, KINDS, NOMINAL, SCALE, np.full(8, np.inf), np.ones(8, dtype=bool))
    with pytest.raises(ro.InputError, match="tolerances: found none for any identified parameter"):
        ro.within_tolerance.bounds(none)


def test_a_box_demands_what_it_bounds_and_no_more() -> None:
    lower = np.array([-1.0, -np.inf, 0.5, -np.inf, -1, -1, -1, -1])
    upper = np.array([1.0, 1.0, 0.5, np.inf, np.inf, 2, 2, 2])
    stated = box(lower, upper)
    inside = np.array([0.0, -50.0, 0.5, 70.0, 80.0, 0.0, 2.0, -1.0])
    assert met(stated, inside)
    for i, value in ((0, -1.1), (0, 1.1), (1, 1.1), (2, 0.4), (2, 0.6), (4, -1.1), (7, 2.1)):
        z = inside.copy()
        z[i] = value
        assert not met(stated, z), i
    sizes = [c.size for c in stated(cp.Variable(8), P)]
    assert sizes == [1, 5, 5]  # one fixed; low 0, 4 to 7; high 0, 1, 5 to 7
    assert [c.size for c in box(-1.0, np.inf)(cp.Variable(8), P)] == [8]
    assert [c.size for c in box(-np.inf, 1.0)(cp.Variable(8), P)] == [8]


@pytest.mark.parametrize(
    ("lower", "upper", "said"),
    [
        (np.nan, 1.0, "a bound that is not a number"),
        (-1.0, np.nan, "a bound that is not a number"),
        (-np.inf, np.inf, "no finite bound"),
        (np.where(np.arange(8) == 1, 2.0, 0.0), 1.0, "for a1 a lower bound of 1 mm above the upper one of 0.5 mm"),
        (
            np.where(np.arange(8) == 2, 2.0, 0.0),
            1.0,
            "for alpha2 a lower bound of 4 mrad above the upper one of 2 mrad",
        ),
    ],
)
def test_bounds_that_are_none_are_said(lower: Any, upper: Any, said: str) -> None:
    with pytest.raises(ro.InputError, match=said):
        box(lower, upper).bounds(P)
    assert box(0.0, 0.0).bounds(P)[0].shape == (8,)
    assert box(-1.0, np.inf).bounds(P)[0].shape == (8,)
    assert box(-np.inf, 1.0).bounds(P)[0].shape == (8,)


def test_patterns_choose_by_name() -> None:
    assert matching(P, ("a?",), "mine").tolist() == [False, True, False, True, False, False, False, False]
    assert np.flatnonzero(matching(P, ("alpha?", "base_*"), "mine")).tolist() == [0, 2, 4, 5]
    with pytest.raises(ro.InputError, match="found 'q1'"):
        matching(P, ("a?", "q1"), "mine")
    with pytest.raises(ro.InputError, match="no pattern"):
        matching(P, (), "mine")


def test_at_nominal_is_zero_for_what_matches() -> None:
    lower, upper = at_nominal("alpha?").bounds(P)
    assert (upper == np.where([0, 1, 0, 1, 1, 1, 1, 1], np.inf, 0.0)).all()
    assert (lower == -upper).all()


def test_signs() -> None:
    above, below = signed(+1, "a?").bounds(P), signed(-1, "a?").bounds(P)
    chosen = matching(P, ("a?",), "mine")
    assert (above[0] == np.where(chosen, 0.0, -np.inf)).all()
    assert np.isposinf(above[1]).all()
    assert (below[1] == np.where(chosen, 0.0, np.inf)).all()
    assert np.isneginf(below[0]).all()
    for wrong in (0, 2, -2):
        with pytest.raises(ro.InputError, match="sign"):
            signed(wrong, "a?")


def test_equal_values_nominal_included() -> None:
    """a1 + 0.35 m is a2, and base_x is 1 m: the deviations make up for what the drawing says."""
    lengths = equal("a1", "a2", "base_x")
    z = np.zeros(8)
    z[1], z[3], z[4] = 0.2 / SCALE[1], -0.15 / SCALE[3], -0.7 / SCALE[4]
    assert met(lengths, z)
    for i in (1, 3, 4):
        off = z.copy()
        off[i] += 1e-3 * SCALE[4] / SCALE[i]
        assert not met(lengths, off)
    assert lengths(cp.Variable(8), P).size == 2
    for names, said in (
        (("a1",), "'a1'"),
        (("a1", "q"), "'q'"),
        (("a1", "a2", "q"), "'q'"),
        ((), "identified parameters, two or more"),
        (("a1", "alpha1"), "one dimension"),
    ):
        with pytest.raises(ro.InputError, match=said):
            equal(*names)(cp.Variable(8), P)


def test_a_ball_of_what_matches() -> None:
    z = np.array([9.0, 3.0, 9.0, 4.0, 9.0, 9.0, 9.0, 9.0])
    assert met(ro.in_ball(5.0, "a?"), z)
    assert not met(ro.in_ball(4.99, "a?"), z)
    assert met(ro.in_ball(0.0, "a?"), 0 * z)
    for wrong in (-1e-9, np.inf, np.nan):
        with pytest.raises(ro.InputError, match="radius"):
            ro.in_ball(wrong, "*")


def test_groups_of_the_penalty() -> None:
    def groups(function: Any) -> list[list[str]]:
        return [[NAMES[i] for i in np.flatnonzero(D.sum(axis=0))] for D in function(P)]

    assert groups(by_link) == [["alpha1", "a1"], ["alpha2", "a2"], ["base_x", "base_rz"], ["tool_x"], ["d12"]]
    assert groups(by_kind) == [["alpha1", "alpha2"], ["a1", "a2"], ["base_x", "base_rz"], ["tool_x"], ["d12"]]
    for function in (by_link, by_kind):
        assert np.vstack(function(P)).sum(axis=0).tolist() == [1.0] * 8
        assert all((np.eye(len(D)) == D @ D.T).all() for D in function(P))


def test_differences_of_neighbours_and_the_rest_alone() -> None:
    D = np.vstack(differences("a?", "d12")(P))
    z = np.arange(1.0, 9.0) ** 2
    assert D @ z == pytest.approx([16 - 4, 64 - 16, 1, 9, 25, 36, 49])


def test_what_a_person_reads() -> None:
    assert as_text(1.25e-3, "length") == "1.25 mm"
    assert as_text(-2e-3, "angle") == "-2 mrad"


def test_what_a_file_holds() -> None:
    assert at_nominal("a?", "d*").stated == ["at_nominal", "a?", "d*"]
    assert signed(-1, "a?").stated == ["signed", -1, "a?"]
    assert ro.in_ball(2.0, "*").stated == ["in_ball", 2.0, "*"]  # type: ignore[attr-defined]
    assert ro.huber(1.5).stated == ["huber", 1.5]  # type: ignore[attr-defined]
    assert box(0.0, 1.0).stated is None


def test_ready_is_what_means_the_same_whenever_it_is_asked() -> None:
    ready = [ro.tikhonov, ro.robust, ro.bounded, ro.group_lasso]
    ready.append(ro.Formulation("b", constraints=(at_nominal("a?"), ro.in_ball(1.0, "*"), equal("a1", "a2"))))
    ready.append(ro.Formulation("d", penalty=cp.sum, penalty_over=differences("a?")))
    assert all(each.ready for each in ready)
    own = [
        ro.Formulation("l", loss=lambda r: cp.sum_squares(r)),
        ro.Formulation("p", penalty=lambda z: cp.norm1(z)),
        ro.Formulation("c", constraints=(lambda z, p: z >= 0,)),
        ro.Formulation("b", constraints=(ro.in_ball(1.0, "*"), box(0.0, 1.0))),
        ro.Formulation("g", penalty=cp.sum, penalty_over=lambda p: [np.eye(8)]),
    ]
    assert not any(each.ready for each in own)
    for each in ready:
        assert pickle.loads(pickle.dumps(each)) == each


@pytest.mark.parametrize("threshold", [0.0, -1.0, np.inf, np.nan])
def test_a_threshold_is_above_zero(threshold: float) -> None:
    with pytest.raises(ro.InputError, match="a positive number of standard deviations"):
        ro.huber(threshold)


def test_hubers_loss_is_its_formula() -> None:
    v = np.array([-5.0, -1.5, 0.0, 1.0, 1.5, 4.0])
    want = np.where(np.abs(v) <= 1.5, v**2, 3.0 * np.abs(v) - 2.25).sum()
    assert float(ro.huber(1.5)(v).value) == pytest.approx(want, rel=1e-12)
    assert float(ro.huber()(np.array([2.0, 3.0])).value) == pytest.approx(4.0 + 8.0, rel=1e-12)


def test_a_loss_is_over_equations_or_configurations() -> None:
    with pytest.raises(ro.InputError, match="loss_over: found 'row'"):
        ro.Formulation("f", loss_over="row")


def test_what_a_file_could_not_hold_says_so() -> None:
    with pytest.raises(ro.InputError, match="formulation 'mine': found functions that a result file cannot hold"):
        unavailable("mine")(1, 2, 3)
