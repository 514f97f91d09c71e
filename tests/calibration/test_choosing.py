"""The weight while the loop goes on: asked until it settles, confirmed at rest, and never in circles."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration.choosing import PATIENCE, SETTLED, Choosing, choosing

PROGRAM: Any = SimpleNamespace(closed_form=True)
DEAR: Any = SimpleNamespace(closed_form=False)
"""The rules below look at no program; one without a formula they are asked about where their last answer leads."""


def rule(*answers: float) -> Callable[[Any], ro.select.Selection]:
    """A selector that gives these answers in turn."""
    left = list(answers)

    def mine(_: Any) -> ro.select.Selection:
        return ro.select.Selection(left.pop(0), "mine", np.ones(1), np.ones(1), interior=True)

    return mine


def asked(count: int, *answers: float) -> Choosing:
    """The choice after so many answers."""
    choice = choosing(rule(*answers), True)
    for _ in range(count):
        choice = choice.asked(PROGRAM)
    return choice


def test_a_number_is_final_and_asks_nobody() -> None:
    choice = choosing(3, True)
    assert (choice.weight, choice.settled, choice.final, choice.note) == (3.0, True, True, "")
    assert choice.asked(PROGRAM) is choice
    assert choice.confirmed(PROGRAM) is choice
    assert choosing(np.float64(0.5), True).weight == 0.5
    assert choosing(0, True).weight == 0.0


def test_a_rule_is_asked_until_it_settles() -> None:
    first = asked(1, 2.0)
    assert (first.weight, first.answers, first.settled, first.final) == (2.0, (2.0,), False, False)
    assert first.selection is not None
    second = asked(2, 2.0, 5.0)
    assert (second.weight, second.answers) == (5.0, (2.0, 5.0))
    settled = second.after(0.0)
    assert settled.settled
    assert settled.asked(PROGRAM) is settled


def test_of_a_program_without_formula_every_answer_is_followed_to_its_end() -> None:
    first = choosing(rule(2.0, 5.0, 5.0), True).asked(DEAR)
    assert (first.weight, first.settled, first.final) == (2.0, True, False)
    assert first.asked(DEAR) is first
    second = first.confirmed(DEAR)
    assert (second.weight, second.settled, second.final) == (5.0, True, False)
    third = second.confirmed(DEAR)
    assert (third.weight, third.settled, third.final) == (5.0, True, True)


def test_without_a_penalty_a_rule_is_not_asked() -> None:
    choice = choosing(rule(), False)
    assert (choice.settled, choice.final, choice.weight) == (True, True, 0.0)
    assert choice.asked(PROGRAM) is choice


def test_a_ready_rule_goes_by_its_name() -> None:
    assert choosing("reml", True).rule is ro.reml
    assert not choosing("reml", True).settled


def test_a_weight_settles_when_steps_are_short() -> None:
    choice = asked(1, 2.0)
    assert not choice.after(1.01 * SETTLED).settled
    assert choice.after(SETTLED).settled
    assert not choice.after(SETTLED).final
    assert pytest.approx(1e-3) == SETTLED


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
        assert ("the larger one, which holds back more, is used" in end.note) == (used == high)


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
    answers = [2.0**k for k in range(PATIENCE)]
    assert not asked(PATIENCE - 1, *answers).final
    end = asked(PATIENCE, *answers)
    assert end.final
    assert end.weight == pytest.approx(np.sqrt(answers[-2] * answers[-1]), rel=1e-12)
    assert PATIENCE == 10


@pytest.mark.parametrize("weight", [True, None, [1.0], -1.0, float("inf"), float("nan"), "lcurve"])
def test_what_is_no_weight_is_refused(weight: Any) -> None:
    with pytest.raises(ro.InputError, match=r"^weight: found "):
        choosing(weight, True)


@pytest.mark.parametrize("answer", [-1e-9, float("inf"), float("nan")])
def test_an_answer_that_is_no_weight_is_refused(answer: float) -> None:
    with pytest.raises(ro.InputError, match=r"selector mine: found weight .*, accepted: a number, zero or more"):
        asked(1, answer)


def test_a_weight_of_zero_is_an_answer() -> None:
    assert asked(1, 0.0).weight == 0.0
