"""Priors, drawings and functions that say nothing or contradict themselves: one sentence that names what it is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.bayes import Prior
from rpim_opt.bayes.prior import kind_of
from rpim_opt.convex.constraint_parser import combination
from tests.convex.test_formulation import model

MODEL = model()


def posed(**functions: Any) -> ro.convex.Program:
    stated = {"loss": cp.sum_squares, "penalty": cp.sum_squares, **functions}
    return ro.convex.pose(ro.Formulation("own", **stated), MODEL)


def drawn(text: str, **identify: Any) -> ro.calibration.Calibration:
    problem = ro.load("paper_arm").problem
    if identify:
        problem = problem.with_parameters(problem.parameters.identify(identify["identify"]))
    stated = ro.Formulation("drawn", penalty=cp.sum_squares, constraints=ro.constraints.parse(text))
    return ro.calibrate(problem, stated, 1.0)


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "NumPy's absolute value": (
        lambda: posed(penalty=lambda z: np.sum(np.abs(z))), "penalty: found a NumPy function of a CVXPY expression"
    ),
    "NumPy's sum": (lambda: posed(penalty=lambda z: np.sum(z**2)), "functions of CVXPY: cp.abs, cp.sum"),
    "NumPy's maximum as a loss": (lambda: posed(loss=lambda r: np.max(np.abs(r))), "loss: found a NumPy function"),
    "a list of patterns": (lambda: ro.in_ball(1.0, ["a1", "a2"]), "arguments one by one"),  # type: ignore[arg-type]
    "a statement that is a number": (lambda: combination(3), "prior: found 3"),  # type: ignore[arg-type]
    "no deviation": (lambda: Prior.known("a2 - a3 = 0 mm"), "no standard deviation"),
    "groups of nothing": (lambda: Prior(groups=((),)), "names or patterns of parameters"),
    "two centres": (lambda: Prior(centre={"d5_mm": 1.0}) & Prior(centre={"d5_mm": 2.0}), "'d5_mm' as 1 and 2"),
    "places in a list": (
        lambda: ro.constraints.parse("move at most 2 mm: home", [0]), "places as list"  # type: ignore[arg-type]
    ),
    "two relations of a size": (lambda: ro.constraints.parse("1 mm <= |a3| <= 2 mm"), "one relation after"),
    "a pattern that nothing identified fits": (
        lambda: drawn("|d? - nominal| <= 1 mm", identify=["a?"]), "found 'd?', accepted: identified parameters"
    ),
    "constraints that are a number": (lambda: posed(constraints=3), "constraints: found a int, accepted: functions"),
    "a loss that is a text": (lambda: posed(loss=lambda r: "small"), "a str, accepted: a convex scalar expression"),
    "a loss without a return": (lambda: posed(loss=lambda r: None), "is a 'return' missing?"),
    "a constraint of z alone": (lambda: posed(constraints=lambda z: z <= 1), "a function of z and the parameters"),
    "a constraint of two concave sides": (
        lambda: posed(constraints=lambda z, p: cp.sqrt(cp.norm(z)) <= 1).solve(1.0), "a program that is not convex"
    ),
    "a constraint function that returns none": (lambda: posed(constraints=lambda z, p: []), "found no constraint"),
    "a constraint with the sides exchanged": (
        lambda: posed(constraints=lambda z, p: cp.sum_squares(z) >= 1).solve(1.0), "whose sides are"
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_meant_is_named(what: str) -> None:
    make, said = REFUSED[what]
    with pytest.raises(ro.InputError) as error:
        make()
    assert said in str(error.value)


def test_the_innermost_part_that_breaks_the_rules_is_named() -> None:
    with pytest.raises(ro.InputError, match="convexity CVXPY cannot verify") as error:
        posed(constraints=lambda z, p: 1 + cp.sqrt(cp.sum_squares(z)) <= 2).solve(1.0)
    assert "1 +" not in error.value.accepted


def test_a_strict_inequality_is_refused_by_the_name_of_its_constraint() -> None:
    with pytest.raises(ro.InputError, match=r"'own', z < 2: found Strict inequalities are not allowed, accepted"):
        posed(constraints=lambda z, p: z < 2).solve(1.0)


def test_a_prior_and_something_else_are_no_prior() -> None:
    with pytest.raises(TypeError):
        Prior() & 3  # type: ignore[operator]
    assert Prior(centre={"d5_mm": 1.0}) & Prior(centre={"d5_mm": 1.0}) == Prior(centre={"d5_mm": 1.0})


def test_a_parameter_of_no_kind_is_its_own() -> None:
    assert kind_of("_anchor") == "_anchor"


def test_a_statement_without_a_unit_is_in_si() -> None:
    bare = ro.constraints.parse("a3 = a4")
    assert bare.unit == ("SI", 1.0)
    assert bare.step == pytest.approx(0.01)
    equal = ro.constraints.parse("a3 = a4 + 2 mm")
    assert equal.step == pytest.approx(1e-5)  # a hundredth of a millimetre
    near = ro.constraints.parse("|a3 - a4| <= 2 mm")
    assert near.unit == ("mm", 1e-3)
    assert near.step == pytest.approx(2e-4)


def test_one_constraint_may_stand_alone() -> None:
    alone = ro.Formulation("own", constraints=ro.constraints.at_nominal("a3"))
    assert alone.constraints == ro.Formulation("own", constraints=[ro.constraints.at_nominal("a3")]).constraints
    assert "1 constraint" in repr(alone)


def test_groups_of_another_width_are_refused_with_the_accepted_one() -> None:
    problem = ro.load("paper_arm").problem
    n = len(problem.parameters.free)
    narrow = ro.Formulation("mine", penalty=cp.sum, penalty_over=lambda parameters: [np.eye(n - 1)])
    with pytest.raises(ro.InputError, match=rf"penalty_over: found a matrix of shape .*{n - 1}.*\(k, {n}\)"):
        ro.calibrate(problem, narrow, 1.0)
