"""The weight while the loop goes on: asked until it settles, confirmed at rest, and never in circles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration import loop
from rpim_opt.calibration.loop import MOST_CHOICES, SETTLED, WeightChoice, weight_choice

PROGRAM: Any = SimpleNamespace(closed_form=True)
DEAR: Any = SimpleNamespace(closed_form=False)
"""The rules below look at no program; one without a formula they are asked about where their last answer leads."""


def rule(*answers: float) -> Callable[[Any], ro.select.Selection]:
    """A selector that gives these answers in turn."""
    left = list(answers)

    def mine(_: Any) -> ro.select.Selection:
        return ro.select.Selection(left.pop(0), "mine", np.ones(1), np.ones(1), interior=True)

    return mine


def ending(*answers: float) -> Callable[[Any], ro.select.Selection]:
    """A selector that gives these answers in turn; a negative one is that weight at the lower end of those tried."""
    left = list(answers)

    def mine(_: Any) -> ro.select.Selection:
        weight = left.pop(0)
        inside = weight > 0
        weights = abs(weight) * np.array([0.5, 1.0, 2.0])[int(not inside) :]
        return ro.select.Selection(abs(weight), "mine", weights, np.ones(len(weights)), inside)

    return mine


def followed(*answers: float) -> WeightChoice:
    """The choice after all answers about a program without a formula, or after the one that ended it."""
    choice = weight_choice(ending(*answers), True).updated(DEAR)
    for _ in answers[1:]:
        choice = choice.confirmed(DEAR)
    return choice


def asked(count: int, *answers: float) -> WeightChoice:
    """The choice after so many answers."""
    choice = weight_choice(rule(*answers), True)
    for _ in range(count):
        choice = choice.updated(PROGRAM)
    return choice


def test_a_number_is_final_and_asks_nobody() -> None:
    choice = weight_choice(3, True)
    assert (choice.weight, choice.settled, choice.final, choice.note) == (3.0, True, True, "")
    assert choice.updated(PROGRAM) is choice
    assert choice.confirmed(PROGRAM) is choice
    assert weight_choice(np.float64(0.5), True).weight == 0.5
    assert weight_choice(0, True).weight == 0.0


def test_a_rule_is_asked_until_it_settles() -> None:
    first = asked(1, 2.0)
    assert (first.weight, first.weights, first.settled, first.final) == (2.0, (2.0,), False, False)
    assert first.selection is not None
    second = asked(2, 2.0, 5.0)
    assert (second.weight, second.weights) == (5.0, (2.0, 5.0))
    settled = second.after(0.0)
    assert settled.settled
    assert settled.updated(PROGRAM) is settled


def test_of_a_program_without_formula_every_answer_is_followed_to_its_end() -> None:
    first = weight_choice(rule(2.0, 5.0, 5.0), True).updated(DEAR)
    assert (first.weight, first.settled, first.final) == (2.0, True, False)
    assert first.updated(DEAR) is first
    second = first.confirmed(DEAR)
    assert (second.weight, second.settled, second.final) == (5.0, True, False)
    third = second.confirmed(DEAR)
    assert (third.weight, third.settled, third.final) == (5.0, True, True)


def test_without_a_penalty_a_rule_is_not_asked() -> None:
    choice = weight_choice(rule(), False)
    assert (choice.settled, choice.final, choice.weight) == (True, True, 0.0)
    assert choice.updated(PROGRAM) is choice


def test_a_ready_rule_goes_by_its_name() -> None:
    assert not weight_choice(ro.reml, True).settled


def test_a_weight_settles_when_steps_are_short() -> None:
    choice = asked(1, 2.0)
    assert not choice.after(1.01 * SETTLED).settled
    assert choice.after(SETTLED).settled
    assert not choice.after(SETTLED).final
    assert pytest.approx(1e-3) == SETTLED


@pytest.mark.parametrize(("answer", "same"), [(2.19, True), (2.21, False), (2 / 1.09, True), (2 / 1.11, False)])
def test_without_a_formula_answers_are_the_same_within_what_a_search_tells_apart(answer: float, same: bool) -> None:
    end = followed(2.0, answer)
    assert end.final == same
    assert end.weight == (2.0 if same else answer)


def test_what_a_search_tells_apart_is_no_more_than_its_weights_are_apart() -> None:
    def near(weight: float, refined: float, ratio: float) -> WeightChoice:
        """The choice after an answer of 2 and another one, of a grid of that ratio, refined by that factor."""
        grid = weight / refined * np.array([1 / ratio, 1.0, ratio])
        answers = [rule(2.0)(None), ro.select.Selection(weight, "mine", grid, np.ones(3), interior=True)]
        return weight_choice(lambda _: answers.pop(0), True).updated(DEAR).confirmed(DEAR)

    assert near(2.0 * 1.029, 1.0, 1.03).final
    assert not near(2.0 * 1.031, 1.0, 1.03).final
    assert not near(2.0 * 1.02, 1.001, 1.03).final  # refined between the weights


def test_a_lower_end_with_no_answer_inside_before_it_is_followed() -> None:
    assert not followed(-1e-3, -1e-9).final
    assert followed(-1e-3, -1e-9).weight == 1e-9


def test_an_answer_that_comes_back_from_the_lower_end_is_an_alternation() -> None:
    end = followed(-1e-3, 30.0, -1e-9, 30.1)
    assert (end.weight, end.settled, end.final) == (30.1, True, True)
    assert end.note == ("The rule mine alternates between 1e-09 and 30: the larger one is used.")
    assert not followed(-1e-3, 30.0, -1e-9, 40.0).final


def test_an_answer_that_comes_back_has_led_to_the_other_before() -> None:
    end = followed(-1e-9, 30.0, -0.95e-9)
    assert (end.weight, end.settled, end.final) == (30.0, True, True)
    assert "alternates between 30 and 9.5e-10" in end.note
    assert not followed(-1e-9, 30.0, -0.9e-9).final


@pytest.mark.parametrize(("answer", "same"), [(2.0, True), (2.0 * np.exp(0.0099), True), (2.0 * np.exp(0.0101), False)])
def test_an_answer_is_confirmed_when_it_is_the_same_again(answer: float, same: bool) -> None:
    for again in (answer, 4.0 / answer):  # to either side
        for unit in (1.0, 1e-9, 1e9):
            end = asked(1, 2.0 * unit, again * unit).after(0.0).confirmed(PROGRAM)
            assert end.final == same
            assert end.settled == same
            assert end.weight == pytest.approx(unit * (2.0 if same else again), rel=1e-12)
            assert end.note == ""


def test_weights_of_zero_are_the_same_as_themselves_alone() -> None:
    zero = asked(1, 0.0, 0.0).after(0.0).confirmed(PROGRAM)
    assert (zero.weight, zero.final) == (0.0, True)
    other = asked(1, 0.0, 1e-9).after(0.0).confirmed(PROGRAM)
    assert (other.weight, other.final) == (1e-9, False)
    back = asked(1, 1e-9, 0.0).after(0.0).confirmed(PROGRAM)
    assert (back.weight, back.final) == (0.0, False)


def test_two_answers_in_turn_end_at_their_geometric_mean() -> None:
    three = asked(3, 1.0, 4.0, 1.0)
    assert not three.final
    four = asked(4, 1.0, 4.0, 1.0, 4.0)
    assert four.weight == pytest.approx(2.0, rel=1e-12)
    assert (four.settled, four.final) == (True, True)
    assert four.note == "The rule mine alternates between 4 and 1: their geometric mean, 2, is used." or (
        four.note == "The rule mine alternates between 1 and 4: their geometric mean, 2, is used."
    )


@pytest.mark.parametrize(("low", "high", "used"), [(1.0, 10.0, 10**0.5), (1.0, 10.1, 10.1), (0.0, 3.0, 3.0)])
def test_answers_more_than_a_decade_apart_end_at_the_larger(low: float, high: float, used: float) -> None:
    for one, other in ((low, high), (high, low)):
        end = asked(4, one, other, one, other)
        assert end.weight == pytest.approx(used, rel=1e-12)
        assert end.final
        assert ("the larger one is used" in end.note) == (used == high)


def test_answers_that_repeat_are_no_turn() -> None:
    """1, 1, 4, 4, 1 are three turns: nothing is said yet; a fourth makes it an alternation."""
    assert not asked(5, 1.0, 1.0, 4.0, 4.0, 1.0).final
    assert asked(6, 1.0, 1.0, 4.0, 4.0, 1.0, 4.001).final


def test_answers_that_move_on_are_no_alternation() -> None:
    for answers in ((1.0, 4.0, 2.0, 4.0), (1.0, 4.0, 1.0, 3.0), (8.0, 4.0, 2.0, 1.0)):
        assert not asked(4, *answers).final


def test_an_alternation_counts_from_the_last_answers() -> None:
    end = asked(6, 50.0, 30.0, 1.0, 4.0, 1.0, 4.0)
    assert end.weight == pytest.approx(2.0, rel=1e-12)
    assert end.final


def test_a_rule_that_never_comes_to_rest_is_ended() -> None:
    answers = [2.0**k for k in range(MOST_CHOICES)]
    assert not asked(MOST_CHOICES - 1, *answers).final
    end = asked(MOST_CHOICES, *answers)
    assert end.final
    assert end.weight == pytest.approx(np.sqrt(answers[-2] * answers[-1]), rel=1e-12)
    assert MOST_CHOICES == 10


@pytest.mark.parametrize("weight", [True, None, [1.0], -1.0, float("inf"), float("nan"), "lcurve"])
def test_what_is_no_weight_is_refused(weight: Any) -> None:
    with pytest.raises(ro.InputError, match=r"^weight: found "):
        weight_choice(weight, True)


@pytest.mark.parametrize("answer", [-1e-9, float("inf"), float("nan")])
def test_an_answer_that_is_no_weight_is_refused(answer: float) -> None:
    with pytest.raises(ro.InputError, match=r"selector mine: found weight .*, accepted: a number, zero or more"):
        asked(1, answer)


def test_a_weight_of_zero_is_an_answer() -> None:
    assert asked(1, 0.0).weight == 0.0


def test_of_a_robust_loss_a_rule_is_first_asked_where_weight_one_leads() -> None:
    seen: Any = SimpleNamespace(closed_form=False)
    begun = {"robust": True, "weight": 1.0, "settled": True}
    first = replace(weight_choice(rule(5.0), True), **begun).confirmed(seen)
    assert (first.weight, first.final, first.weights) == (5.0, False, (5.0,))
    same = replace(weight_choice(rule(1.0), True), **begun).confirmed(seen)  # its own answer, to be shown
    assert (same.weight, same.final) == (1.0, False)
    assert same.selection is not None


@pytest.mark.parametrize("passes", [2, 50])
def test_a_rule_is_asked_however_few_the_passes(passes: int) -> None:
    """With few of them at once; with more, not at nominal."""
    problem = ro.load("blunders").problem
    nominal: list[bool] = []

    def mine(program: Any) -> ro.select.Selection:
        first = program.model.A[0] / np.linalg.norm(program.model.A[0])
        rows = at_nominal.A / np.linalg.norm(at_nominal.A, axis=1, keepdims=True)
        nominal.append(bool(np.abs(rows @ first - 1).min() < 1e-14))
        return ro.select.Selection(3.0, "mine", np.ones(1), np.ones(1), interior=True)

    at_nominal = problem.linearize(np.zeros(len(problem.parameters.free)))
    result = ro.calibrate(problem, ro.robust, mine, max_iterations=passes)
    assert result.weight == 3.0
    assert nominal[0] == (passes == 2)
    assert result.converged == (passes == 50)


def test_a_rule_is_asked_at_last_where_passes_run_out_on_the_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "FEW_ITERATIONS", 1)
    result = ro.calibrate(ro.load("blunders").problem, ro.robust, rule(3.0), max_iterations=2)
    assert not result.converged
    assert result.selection is not None
    assert result.weight == 3.0


def test_two_answers_hardly_apart_of_a_robust_loss_end_between_them() -> None:
    absolute = ro.Formulation("tilted", loss=lambda r: cp.sum(cp.maximum(0.9 * r, -0.1 * r)), penalty=cp.sum_squares)
    result = ro.calibrate(ro.load("position").problem, absolute, ro.l_curve, max_iterations=100)
    assert result.converged
    assert "alternates" not in result.message


def test_a_rule_may_return_a_number() -> None:
    problem = ro.load("position").problem

    def smallest(program: ro.convex.Program) -> float:
        return 0.5

    result = ro.calibrate(problem, ro.tikhonov, weight=smallest)
    assert result.weight == 0.5
    assert result.selector == "smallest"
    assert result.x == pytest.approx(ro.calibrate(problem, ro.tikhonov, weight=0.5).x, abs=1e-12)
    with pytest.raises(ro.InputError, match=r"Selection, name: found a ndarray, accepted: a text, the second argument"):
        ro.select.Selection(1.0, np.ones(3), np.ones(3), True, "mine")  # type: ignore[arg-type]
    with pytest.raises(ro.InputError, match="selector <lambda>: found a str, accepted: a weight, or a Selection"):
        ro.calibrate(problem, ro.tikhonov, weight=lambda program: "reml")
