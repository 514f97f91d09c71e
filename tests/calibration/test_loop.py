"""The loop: when it asks for the weight, when it rests, what certifies its end, and what is said of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration import Certificate, Iteration
from rpim_opt.calibration.certificate import certified
from rpim_opt.calibration.identify import ending
from rpim_opt.calibration.loop import Ended, Loop, Options, State, weight_choice
from tests.simulate import simulated

PROBLEM, _ = simulated(noise=5e-5)
FAR, _ = simulated(noise=5e-5, size=100.0)
N = len(PROBLEM.parameters.free)


def loop(problem: Any = PROBLEM, formulation: ro.Formulation = ro.tikhonov, **how: Any) -> Loop:
    return Loop.of(problem, formulation, Options(**how))


def state(problem: Any = PROBLEM, formulation: ro.Formulation = ro.tikhonov, weight: float = 1.0, **how: Any) -> State:
    """Before the first pass, at nominal."""
    z = np.zeros(len(problem.parameters.free))
    program = ro.convex.pose(formulation, problem.linearize(z))
    size = np.linalg.norm(program.model.A, axis=0)
    return replace(State(z, program, weight_choice(weight, True), program.objective(z, weight), size), **how)


# --- the weight in the loop --------------------------------------------------------------------------------


def answering(*weights: float) -> Any:
    """A selector that gives these answers in turn."""
    left = list(weights)

    def mine(_: Any) -> ro.select.Selection:
        return ro.select.Selection(left.pop(0), "mine", np.ones(1), np.ones(1), interior=True)

    return mine


def test_the_objective_follows_the_weight() -> None:
    before = state(choice=weight_choice(answering(2.0, 2.0, 3.0), True), z=np.ones(N), merit=-1.0)
    first = loop().chosen(before)
    assert first.choice.weight == 2.0
    assert first.merit == pytest.approx(before.program.objective(before.z, 2.0), rel=1e-12)
    passed = replace(first, history=(Iteration(1.0, 1.0, 2.0, 0.0),))
    same = loop().chosen(passed)
    assert (same.merit, same.choice.weights) == (first.merit, (2.0, 2.0))
    other = loop().chosen(same)
    assert other.merit == pytest.approx(before.program.objective(before.z, 3.0), rel=1e-12)
    given = state(z=np.ones(N), merit=-1.0, history=passed.history)
    assert loop().chosen(given).merit == -1.0


@pytest.mark.parametrize(("away", "damping", "asks"), [(0.001, 0.0, True), (0.001, 1.0, False), (0.05, 0.0, False)])
def test_a_rule_is_asked_next_to_where_the_first_weight_leads(away: float, damping: float, asks: bool) -> None:
    """By the next step's share of the solution; a damped one tells nothing."""
    program = state(formulation=ro.robust).program
    z = ro.calibrate(PROBLEM, ro.robust, 1.0).z * (1 + away)
    there = program.on(PROBLEM.linearize(PROBLEM.parameters.free.scale * z))
    length = np.linalg.norm(there.solve(1.0).z - z) / (1 + np.linalg.norm(z))
    assert (length < 0.01) == (away < 0.01)
    choice = replace(weight_choice(answering(5.0), True), robust=True, weight=1.0, settled=True)
    before = state(formulation=ro.robust, z=z, program=there, choice=choice, damping=damping, stalled=2)
    before = replace(before, merit=there.objective(z, 1.0))
    after = loop(formulation=ro.robust).advanced(before)
    assert after.choice.weights == ((5.0,) if asks else ())
    if asks:
        assert np.array_equal(after.z, z)
        assert (after.choice.weight, after.outcome, after.stalled) == (5.0, "", 0)
        assert after.merit == pytest.approx(there.objective(z, 5.0), rel=1e-12)


def test_at_rest_a_weight_is_asked_for_once_more() -> None:
    def resting(*weights: float, outcome: str = "converged") -> State:
        choice = weight_choice(answering(2.0, *weights), True).updated(state().program).after(0.0)
        return state(choice=choice, z=np.ones(N), merit=-1.0, outcome=outcome, stalled=2)

    same = loop().confirmed(resting(2.0))
    assert (same.outcome, same.merit, same.choice.final, same.stalled) == ("converged", -1.0, True, 2)
    other = loop().confirmed(resting(5.0))
    assert (other.outcome, other.choice.weight, other.choice.settled, other.stalled) == ("", 5.0, False, 0)
    assert other.merit == pytest.approx(other.program.objective(other.z, 5.0), rel=1e-12)
    for outcome in ("", "stalled"):
        going = resting(outcome=outcome)
        assert loop().confirmed(going) is going
    final = state(outcome="converged")
    assert loop().confirmed(final) is final


@pytest.mark.parametrize("start", [np.zeros(N - 1), np.zeros((N, 1)), np.full(N, np.nan), np.full(N, np.inf)])
def test_a_start_that_does_not_fit_is_refused(start: np.ndarray) -> None:
    with pytest.raises(ro.InputError, match="accepted: finite numbers of shape"):
        ro.calibrate(PROBLEM, ro.tikhonov, 1.0, start=start)


@pytest.mark.parametrize("part", ["A", "b"])
def test_data_that_are_not_finite_are_refused(part: str) -> None:
    class Broken(Loop):
        def linearized(self, z: np.ndarray) -> Any:
            model = super().linearized(z)
            return replace(model, **{part: np.nan * getattr(model, part)})

    at = loop()
    broken = Broken(**vars(at))
    with pytest.raises(ro.InputError, match="non-finite residuals or derivatives"):
        broken.initial(weight_choice(1.0, True), None)


def test_a_loop_begins_at_a_point_that_meets_the_constraints() -> None:
    box = ro.constraints.Box("half", lambda p: (np.full(len(p), -0.5), np.full(len(p), 0.5)))
    boxed = ro.Formulation("boxed", penalty=cp.sum_squares, constraints=(box,))
    scale = PROBLEM.parameters.free.scale
    start = np.linspace(-2, 2, N)
    first = loop(formulation=boxed).initial(weight_choice(1.0, True), start * scale)
    assert first.z == pytest.approx(np.clip(start, -0.5, 0.5), abs=1e-12)
    there = PROBLEM.linearize(scale * first.z)
    assert pytest.approx(there.A, rel=1e-9, abs=1e-9) == first.program.model.A
    assert first.merit == pytest.approx(first.program.objective(first.z, 1.0), rel=1e-12)
    assert first.size == pytest.approx(np.linalg.norm(there.A, axis=0), rel=1e-9)
    inside = loop(formulation=boxed).initial(weight_choice(1.0, True), 0.1 * scale)
    assert inside.z == pytest.approx(np.full(N, 0.1), rel=1e-12)
    assert (loop().initial(weight_choice(1.0, True), None).z == 0).all()


@pytest.mark.parametrize(("configurations", "enough"), [(11, False), (12, True)])
def test_equations_are_as_many_as_parameters_or_there_is_a_weight(configurations: int, enough: bool) -> None:
    few, _ = simulated(configurations=configurations, noise=5e-5)
    assert (3 * configurations >= len(few.parameters.free)) == enough
    for formulation, weight in ((ro.least_squares, 0.0), (ro.tikhonov, 0.0)):
        at = loop(few, formulation)
        if enough:
            assert at.initial(weight_choice(weight, True), None).evaluations == 1
        else:
            with pytest.raises(ro.InputError, match="33 equations for 34 parameters"):
                at.initial(weight_choice(weight, True), None)
    for weight in (1e-3, answering(1.0)):
        assert loop(few).initial(weight_choice(weight, True), None).evaluations == 1


def test_passes_are_reported_as_they_come() -> None:
    seen: list[Iteration] = []
    result = ro.calibrate(PROBLEM, ro.tikhonov, 1.0, progress=seen.append)
    assert tuple(seen) == result.history
    assert len(ro.calibrate(PROBLEM, ro.tikhonov, 1.0, max_iterations=1).history) == 1
    for wrong in (0, -1):
        with pytest.raises(ro.InputError, match="max_iterations"):
            ro.calibrate(PROBLEM, ro.tikhonov, 1.0, max_iterations=wrong)


@pytest.mark.parametrize(("most", "decrease", "converged"), [(500, 0.0, True), (500, 0.5, False), (1, 0.0, False)])
def test_converged_is_at_rest_and_certified(
    most: int, decrease: float, converged: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    evidence = Certificate(1.0, 0.0, decrease)
    monkeypatch.setattr("rpim_opt.calibration.loop.certified", lambda *_: evidence)
    result = ro.calibrate(PROBLEM, ro.tikhonov, 1.0, max_iterations=most)
    assert result.converged == converged
    assert result.message.startswith("Converged after") == converged
    assert result.certificate is evidence


# --- one attempt -------------------------------------------------------------------------------------------


def test_a_first_step_counts_and_lowers_the_objective() -> None:
    before = state()
    after = loop().advanced(before)
    assert after.evaluations == before.evaluations + 1
    assert after.merit < before.merit
    assert after.stalled == 0
    assert len(after.history) == 1
    assert after.damping == 0.0


def test_at_its_minimum_a_damped_state_asks_for_the_full_step_and_then_rests() -> None:
    x = ro.calibrate(PROBLEM, ro.tikhonov, 1.0, tolerance=1e-12).x
    z = x / PROBLEM.parameters.free.scale
    program = ro.convex.pose(ro.tikhonov, PROBLEM.linearize(x))
    there = state(z=z, program=program, merit=program.objective(z, 1.0), damping=1.0)
    full = loop().advanced(there)
    assert (full.damping, full.outcome, full.evaluations) == (0.0, "", there.evaluations)
    end = full
    for _ in range(4):
        if not end.outcome:
            end = loop().advanced(end)
    assert end.outcome == "converged"
    assert end.z == pytest.approx(z, abs=1e-7)


def test_a_stalled_loop_rests_at_a_step_that_promises_nothing_and_later_at_any() -> None:
    """Near a lasso's minimum: less is promised than an interior point's accuracy, and more than its best."""
    before = state(formulation=ro.lasso, weight=20.0)
    program = before.program
    z = program.solve(20.0).z
    best = program.objective(z, 20.0)
    i = int(np.argmax(np.abs(z)))
    z[i] += np.sqrt(1e-9 * best) / before.size[i]
    merit = program.objective(z, 20.0)
    there = replace(before, z=z, merit=merit, lowest=merit)
    assert 1e-10 * best < there.merit - best < 0.5e-8 * best
    at = loop(formulation=ro.lasso, tolerance=0.0)
    third = at.advanced(replace(there, stalled=2))
    assert (third.outcome, third.evaluations) == ("converged", there.evaluations)
    second = at.advanced(replace(there, stalled=1))
    assert (second.outcome, second.evaluations) == ("", there.evaluations + 1)
    assert at.advanced(replace(there, merit=best, stalled=0)).outcome == "converged"
    promising = replace(there, merit=best * (1 + 1e-7), lowest=best * (1 + 1e-7))
    assert at.advanced(replace(promising, stalled=2)).stalled == 0
    assert at.advanced(replace(promising, stalled=20)).outcome == "converged"
    assert at.advanced(replace(there, damping=1e9, stalled=19)).damping == 0.0
    assert at.advanced(replace(there, damping=1e9, stalled=20)).outcome == "converged"


# --- what is said ------------------------------------------------------------------------------------------


CERTIFIED = Certificate(1.0, 0.0, 0.0)


def unfinished(most: int, history: tuple[Iteration, ...]) -> str:
    return ending(Ended(state(history=history), np.zeros(N), CERTIFIED), most)


def uncertified(evidence: Certificate) -> str:
    return ending(Ended(state(outcome="converged"), np.zeros(N), evidence), 8)


def test_why_passes_ran_out() -> None:
    falling = tuple(Iteration(100.0 - k, 1.0, 1.0, 0.0) for k in range(8))
    assert unfinished(8, falling) == "Not converged: 8 iterations were not enough; allow more (max_iterations)."
    level = tuple(Iteration(100.0 - 2e-8 * k, 1.0, 1.0, 0.0) for k in range(8))
    flat = unfinished(8, level)
    assert flat == (
        "Not converged: 8 iterations were not enough, though the objective hardly changes: the data hardly determine "
        "the solution; use a larger weight."
    )
    assert unfinished(1, level[:4]) == "Not converged: 1 iteration was not enough; allow more (max_iterations)."
    slowly = tuple(Iteration(100.0 - 1e-6 * k, 1.0, 1.0, 0.0) for k in range(8))
    assert "allow more" in unfinished(8, slowly)
    late = (*falling, *level)
    assert "hardly determine" in unfinished(16, late)
    assert "allow more" in unfinished(16, (*level, *falling))


def test_why_a_loop_at_rest_has_not_converged() -> None:
    assert "still predicts a decrease of the objective by 0.2 %" in uncertified(Certificate(1.0, 0.0, 0.002))
    assert "constraints are violated by 3e-05 prior standard deviations" in uncertified(Certificate(1.0, 3e-5, 1e-9))
    assert "the solution is not certified" in uncertified(Certificate(1.0, 0.0, None))


@pytest.mark.parametrize(
    ("decrease", "violation", "holds"),
    [(1e-7, 0.0, True), (1.1e-6, 0.0, False), (None, 0.0, False), (0.0, 0.9e-7, True), (0.0, 1.1e-7, False)],
)
def test_a_certificate_holds_to_an_interior_points_accuracy(decrease: Any, violation: float, holds: bool) -> None:
    assert Certificate(1.0, violation, decrease).holds(np.full(3, 0.5)) == holds
    assert Certificate(1.0, 10 * violation, decrease).holds(np.full(3, -10.0)) == holds  # of the largest entry


def test_a_certificate_measures_what_is_left() -> None:
    """Of a quadratic everything is known: the step to the minimum, and what it promises."""
    start = PROBLEM.linearize(np.zeros(N))
    best = ro.convex.pose(ro.tikhonov, start).solve(1.0).z
    z = best + 1e-3 * np.linspace(-1, 1, N)
    found = certified(ro.tikhonov, start, z, 1.0)
    assert found.step == pytest.approx(np.linalg.norm(best - z) / (1 + np.linalg.norm(z)), rel=1e-6)
    away = z - best
    fall = np.sum((start.A @ away) ** 2) + away @ away
    objective = np.sum((start.A @ z - start.b) ** 2) + z @ z
    assert found.decrease == pytest.approx(fall / max(objective, 1.0), rel=1e-6)
    assert found.violation == 0.0


@pytest.mark.parametrize("unit", [1.0, 1e-9])
def test_a_certificate_does_not_depend_on_the_objectives_unit(unit: float) -> None:
    start = PROBLEM.linearize(np.zeros(N))
    box = ro.constraints.Box("half", lambda p: (np.full(len(p), -0.5), np.full(len(p), 0.5)))
    loss = ro.Formulation("small", loss=lambda r: unit * cp.sum_squares(r), penalty=cp.sum_squares, constraints=(box,))
    best = ro.convex.pose(loss, start).solve(unit).z
    found = certified(loss, start, best, unit)
    assert found.holds(best)
    assert not certified(loss, start, 0.9 * best, unit).holds(best)


def test_a_certificate_leaves_out_what_bounds_hold_back() -> None:
    start = PROBLEM.linearize(np.zeros(N))
    box = ro.constraints.Box("half", lambda p: (np.full(len(p), -0.5), np.full(len(p), 0.5)))
    boxed = ro.Formulation("boxed", penalty=cp.sum_squares, constraints=(box,))
    best = ro.convex.pose(boxed, start).solve(1.0).z
    assert (np.abs(best) == 0.5).sum() > 2
    found = certified(boxed, start, best, 1.0)
    assert found.holds(best)
    assert found.violation == 0.0
    inside = np.clip(best, -0.49, 0.49)
    assert not certified(boxed, start, inside, 1.0).holds(inside)
    outside = certified(boxed, start, 2 * best, 1.0)
    assert outside.violation == pytest.approx(0.5, rel=1e-12)


def test_a_start_outside_of_the_constraints_is_moved_inside_before_the_first_pass() -> None:
    """Also where one parameter alone is outside."""
    problem = ro.load("paper_arm").problem
    tight = problem.with_parameters(problem.parameters.toleranced({"length_mm": 0.5, "angle_mrad": 0.5}))
    free = tight.parameters.free
    start = np.zeros(len(free))
    start[3] = 7 * free.tolerance[3]
    at = Loop.of(tight, ro.bounded, Options())
    x = free.scale * at.initial(weight_choice(1.0, True), start).z
    assert (np.abs(x) <= free.tolerance * (1 + 1e-9)).all()
    assert x == pytest.approx(np.clip(start, -free.tolerance, free.tolerance))
