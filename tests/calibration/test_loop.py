"""The loop's decisions: how a step is damped, bent, refused and accepted, when it rests, and what is said of it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration.certificate import Certificate, certified
from rpim_opt.calibration.choosing import Choosing, choosing
from rpim_opt.calibration.loop import Loop, State, _begun, _doubted, _merit, _unfinished
from rpim_opt.calibration.result import Iteration
from rpim_opt.convex.majorize import Squares
from rpim_opt.problem.linear import LinearModel
from tests.simulate import simulated

PROBLEM, _ = simulated(noise=5e-5)
FAR, _ = simulated(noise=5e-5, size=100.0)
N = len(PROBLEM.parameters.free)


def loop(problem: Any = PROBLEM, formulation: ro.Formulation = ro.tikhonov, **how: Any) -> Loop:
    stated = {"reweigh": None, "solver": {}, "tolerance": 1e-8, "most": 500}
    return Loop(problem, formulation, **{**stated, **how})


def state(problem: Any = PROBLEM, formulation: ro.Formulation = ro.tikhonov, weight: float = 1.0, **how: Any) -> State:
    """Before the first pass, at nominal."""
    z = np.zeros(len(problem.parameters.free))
    program = ro.convex.pose(formulation, problem.linearize(z))
    size = np.linalg.norm(program.model.A, axis=0)
    return replace(State(z, program, choosing(weight, True), _merit(program, z, weight), size), **how)


# --- damping -----------------------------------------------------------------------------------------------

STEP = np.linspace(0.5, 2.0, N)
SIZE = np.linspace(1.0, 3.0, N)
EFFECT = float(np.sum((SIZE * STEP) ** 2))


def damped(damping: float, gain: float, promised: float, step: np.ndarray = STEP) -> float:
    before = state(damping=damping, size=SIZE, z=np.ones(N))
    return loop()._damped(before, gain, promised, 1 + step).damping


@pytest.mark.parametrize("gain", [-5.0, 0.0, 0.249])
def test_a_step_that_gains_less_than_a_quarter_is_damped_harder(gain: float) -> None:
    """First such that the term weighs as much as what was promised, then four times as much each time."""
    assert damped(0.0, gain, 7.0) * EFFECT == pytest.approx(7.0, rel=1e-12)
    assert damped(3.0, gain, 7.0) == pytest.approx(12.0, rel=1e-12)
    assert damped(1e-9, gain, 7.0) == pytest.approx(4e-9, rel=1e-12)


@pytest.mark.parametrize("gain", [0.251, 0.5, 0.749])
def test_a_step_that_gains_about_what_it_promised_keeps_its_damping(gain: float) -> None:
    assert damped(0.0, gain, 7.0) == 0.0
    assert damped(3.0, gain, 7.0) == 3.0


@pytest.mark.parametrize("gain", [0.751, 1.0, 4.0])
def test_a_step_that_gains_what_it_promised_is_damped_less_and_in_the_end_not_at_all(gain: float) -> None:
    assert damped(0.0, gain, 7.0) == 0.0
    assert damped(3.0, gain, 7.0) == 1.5
    least = 1e-4 * 7.0 / EFFECT
    assert damped(2.02 * least, gain, 7.0) == pytest.approx(1.01 * least, rel=1e-12)
    assert damped(1.98 * least, gain, 7.0) == 0.0


def test_nothing_is_damped_where_nothing_moved_or_was_promised() -> None:
    assert damped(0.0, 0.0, 7.0, step=np.zeros(N)) == 0.0
    assert damped(3.0, 0.0, 7.0, step=np.zeros(N)) == 3.0
    assert damped(0.0, 0.0, 0.0) == 0.0
    assert damped(3.0, 0.0, -1.0) == 3.0


def test_a_damped_step_minimizes_the_linear_model_and_the_term() -> None:
    """(A'A + weight + damping size^2) step = minus half the gradient: Marquardt's equations."""
    before = state(damping=2.5, z=np.full(N, 0.3), weight=0.7)
    A, b = before.program.model.A, before.program.model.b
    D = np.diag(before.size)
    want = np.linalg.solve(A.T @ A + 0.7 * np.eye(N) + 2.5 * D @ D, A.T @ (b - A @ before.z) - 0.7 * before.z)
    assert loop()._solved(before.program, before) - before.z == pytest.approx(want, rel=1e-6, abs=1e-9)


# --- what is refused, accepted, at rest --------------------------------------------------------------------


def rule(_: Any) -> ro.select.Selection:
    return ro.select.Selection(2.0, "mine", np.ones(1), np.ones(1), interior=True)


def test_a_refused_step_rests_settles_or_goes_on() -> None:
    settled, open_ended = state(), state(choice=choosing(rule, True))
    assert loop()._refused(settled, True).outcome == "rest"
    after = loop()._refused(open_ended, True)
    assert (after.outcome, after.choice.settled) == ("", True)
    assert loop()._refused(settled, False) is settled
    assert loop()._refused(open_ended, False) is open_ended


@pytest.mark.parametrize(("damping", "outcome"), [(0.9e30, ""), (1.1e30, "stuck"), (float("nan"), "stuck")])
def test_a_loop_is_stuck_when_no_damping_helps(damping: float, outcome: str) -> None:
    assert loop()._refused(state(damping=damping), False).outcome == outcome


def accepted(before: State, z: np.ndarray, short: bool = False, problem: Any = PROBLEM) -> State:
    candidate = before.program.on(loop(problem).linearized(z))
    return loop(problem)._accepted(before, candidate, z, _merit(candidate, z, before.choice.weight), short)


def test_an_accepted_step_is_where_the_loop_goes_on() -> None:
    before = state(damping=0.25, z=np.full(N, 0.1), size=np.full(N, 300.0))
    z = np.linspace(-1, 1, N)
    after = accepted(before, z)
    assert after.z == pytest.approx(z, abs=1e-12)
    assert after.merit == pytest.approx(after.program.objective(z, 1.0), rel=1e-9)
    length = float(np.linalg.norm(z - 0.1))
    assert after.history == (Iteration(after.merit, pytest.approx(length, rel=1e-12), 1.0, 0.25),)
    columns = np.linalg.norm(after.program.model.A, axis=0)
    assert (after.size == np.maximum(columns, 300.0)).all()
    assert (columns > 300.0).any()
    assert (columns < 300.0).any()
    assert after.outcome == ""
    assert len(accepted(after, 0 * z).history) == 2


def test_a_short_step_ends_the_loop_once_the_weight_is_settled() -> None:
    z = np.full(N, 1e-9)
    assert accepted(state(), z, short=True).outcome == "rest"
    unsettled = accepted(state(choice=Choosing(rule, 1.0)), z, short=True)
    assert (unsettled.outcome, unsettled.choice.settled) == ("", True)
    long = accepted(state(choice=Choosing(rule, 1.0)), np.full(N, 1.0))
    assert not long.choice.settled


def test_a_weight_settles_by_the_steps_share_of_the_solution() -> None:
    z = np.eye(N)[0] * 99
    for length, settles in ((0.09, True), (0.11, False)):
        before = state(choice=Choosing(rule, 1.0), z=z)
        assert accepted(before, z + np.eye(N)[1] * length).choice.settled == settles


def test_an_accepted_angle_is_within_half_a_turn_and_the_same_robot() -> None:
    free = PROBLEM.parameters.free
    k = free.names.index("theta3")
    z = np.zeros(N)
    z[k] = (2 * np.pi + 1e-4) / free.scale[k]
    after = accepted(state(), z)
    assert after.z[k] * free.scale[k] == pytest.approx(1e-4, abs=1e-12)
    model = PROBLEM.linearize(free.scale * after.z)
    at, want = (m.A @ after.z - m.b for m in (after.program.model, model))
    assert at == pytest.approx(want, abs=1e-6 * np.linalg.norm(want))
    assert after.merit == pytest.approx(after.program.objective(after.z, 1.0), rel=1e-12)


def test_missing_the_largest_norm_costs() -> None:
    limited = replace(ro.tikhonov, largest=3.0)
    program = ro.convex.pose(limited, PROBLEM.linearize(np.zeros(N)))
    z = np.zeros(N)
    objective = program.objective(z, 1.0)
    excess = program.norms(z).max() / 3.0 - 1
    assert excess > 0
    assert _merit(program, z, 1.0) == pytest.approx(objective + 10 * (1 + objective) * excess, rel=1e-12)
    met = program.solve(1.0).z
    assert _merit(program, met, 1.0) == pytest.approx(program.objective(met, 1.0), rel=1e-6)


def test_accuracy_is_that_of_formulas_or_of_an_interior_point() -> None:
    exact = state(merit=-200.0)
    assert loop()._accuracy(exact) == (pytest.approx(2e-10), -np.inf)
    interior = state(formulation=ro.lasso, merit=200.0)
    assert loop()._accuracy(interior) == (pytest.approx(2e-6), pytest.approx(2e-9))
    assert loop()._accuracy(replace(interior, merit=-200.0)) == (pytest.approx(2e-6), pytest.approx(2e-9))
    small = replace(interior, merit=0.01, floor=0.5)
    assert loop()._accuracy(small) == (pytest.approx(1e-8), pytest.approx(1e-11))  # absolute below one squared sigma
    assert loop()._accuracy(replace(exact, merit=1e-9, floor=0.5))[0] == pytest.approx(0.5e-12)
    assert loop()._accuracy(replace(interior, merit=np.inf)) == (0.0, -np.inf)
    squares = loop(reweigh=Squares(ro.robust.loss, "robust", "configuration"))
    assert squares._accuracy(replace(exact, merit=200.0)) == (pytest.approx(2e-6), pytest.approx(2e-9))
    ball = replace(ro.tikhonov, constraints=(ro.in_ball(1.0, "*"),))
    assert loop()._accuracy(state(formulation=ball, merit=200.0))[0] == pytest.approx(2e-6)


# --- the weight in the loop --------------------------------------------------------------------------------


def answering(*weights: float) -> Any:
    """A selector that gives these answers in turn."""
    left = list(weights)

    def mine(_: Any) -> ro.select.Selection:
        return ro.select.Selection(left.pop(0), "mine", np.ones(1), np.ones(1), interior=True)

    return mine


def test_the_objective_follows_the_weight() -> None:
    before = state(choice=choosing(answering(2.0, 2.0, 3.0), True), z=np.ones(N), merit=-1.0)
    first = loop().chosen(before)
    assert first.choice.weight == 2.0
    assert first.merit == pytest.approx(before.program.objective(before.z, 2.0), rel=1e-12)
    passed = replace(first, history=(Iteration(1.0, 1.0, 2.0, 0.0),), merit=-1.0)
    same = loop().chosen(passed)
    assert (same.merit, same.choice.answers) == (-1.0, (2.0, 2.0))
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
    choice = replace(choosing(answering(5.0), True), robust=True).begun()
    before = state(formulation=ro.robust, z=z, program=there, choice=choice, damping=damping, quiet=2)
    before = replace(before, merit=_merit(there, z, 1.0))
    after = loop(formulation=ro.robust).advanced(before)
    assert after.choice.answers == ((5.0,) if asks else ())
    if asks:
        assert np.array_equal(after.z, z)
        assert (after.choice.weight, after.outcome, after.quiet) == (5.0, "", 0)
        assert after.merit == pytest.approx(there.objective(z, 5.0), rel=1e-12)


def test_at_rest_a_weight_is_asked_for_once_more() -> None:
    def resting(*weights: float, outcome: str = "rest") -> State:
        choice = choosing(answering(2.0, *weights), True).asked(state().program).after(0.0)
        return state(choice=choice, z=np.ones(N), merit=-1.0, outcome=outcome, quiet=2)

    same = loop().confirmed(resting(2.0))
    assert (same.outcome, same.merit, same.choice.final, same.quiet) == ("rest", -1.0, True, 2)
    other = loop().confirmed(resting(5.0))
    assert (other.outcome, other.choice.weight, other.choice.settled, other.quiet) == ("", 5.0, False, 0)
    assert other.merit == pytest.approx(other.program.objective(other.z, 5.0), rel=1e-12)
    for outcome in ("", "stuck"):
        going = resting(outcome=outcome)
        assert loop().confirmed(going) is going
    final = state(outcome="rest")
    assert loop().confirmed(final) is final


@pytest.mark.parametrize("start", [np.zeros(N - 1), np.zeros((N, 1)), np.full(N, np.nan), np.full(N, np.inf)])
def test_a_start_that_does_not_fit_is_refused(start: np.ndarray) -> None:
    with pytest.raises(ro.InputError, match="deviations, finite, one a parameter"):
        ro.calibrate(PROBLEM, ro.tikhonov, 1.0, start=start)


@pytest.mark.parametrize("part", ["A", "b"])
def test_data_that_are_not_finite_are_refused(part: str) -> None:
    class Broken(Loop):
        def linearized(self, z: np.ndarray, before: np.ndarray | None = None) -> Any:
            model = super().linearized(z, before)
            return replace(model, **{part: np.nan * getattr(model, part)})

    at = loop()
    broken = Broken(at.source, at.asked, None, {}, 1e-8, 10)
    with pytest.raises(ro.InputError, match="residuals or slopes that are not finite"):
        _begun(broken, ro.tikhonov, choosing(1.0, True), None)


def test_a_loop_begins_at_a_point_that_meets_the_constraints() -> None:
    box = ro.constraints.Box("half", lambda p: (np.full(len(p), -0.5), np.full(len(p), 0.5)))
    boxed = ro.Formulation("boxed", penalty=cp.sum_squares, constraints=(box,))
    scale = PROBLEM.parameters.free.scale
    start = np.linspace(-2, 2, N)
    begun = _begun(loop(formulation=boxed), boxed, choosing(1.0, True), start * scale)
    assert begun.z == pytest.approx(np.clip(start, -0.5, 0.5), abs=1e-12)
    there = PROBLEM.linearize(scale * begun.z)
    assert pytest.approx(there.A, rel=1e-9, abs=1e-9) == begun.program.model.A
    assert begun.merit == pytest.approx(begun.program.objective(begun.z, 1.0), rel=1e-12)
    assert begun.size == pytest.approx(np.linalg.norm(there.A, axis=0), rel=1e-9)
    inside = _begun(loop(formulation=boxed), boxed, choosing(1.0, True), 0.1 * scale)
    assert inside.z == pytest.approx(np.full(N, 0.1), rel=1e-12)
    assert (_begun(loop(), ro.tikhonov, choosing(1.0, True), None).z == 0).all()


@pytest.mark.parametrize(("configurations", "enough"), [(11, False), (12, True)])
def test_equations_are_as_many_as_parameters_or_there_is_a_weight(configurations: int, enough: bool) -> None:
    few, _ = simulated(configurations=configurations, noise=5e-5)
    assert (3 * configurations >= len(few.parameters.free)) == enough
    for formulation, weight in ((ro.least_squares, 0.0), (ro.tikhonov, 0.0)):
        at = loop(few, formulation)
        if enough:
            assert _begun(at, formulation, choosing(weight, True), None).evaluations == 1
        else:
            with pytest.raises(ro.InputError, match="33 equations for 34 parameters"):
                _begun(at, formulation, choosing(weight, True), None)
    for weight in (1e-3, answering(1.0)):
        assert _begun(loop(few), ro.tikhonov, choosing(weight, True), None).evaluations == 1


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
    evidence = Certificate(None, 0.0, 0.0, decrease)
    monkeypatch.setattr("rpim_opt.calibration.loop._certified", lambda *_: evidence)
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
    assert after.quiet == 0
    assert len(after.history) == 1
    assert after.damping == 0.0


def test_at_its_minimum_a_damped_state_asks_for_the_full_step_and_then_rests() -> None:
    x = ro.calibrate(PROBLEM, ro.tikhonov, 1.0, tolerance=1e-12).x
    z = x / PROBLEM.parameters.free.scale
    program = ro.convex.pose(ro.tikhonov, PROBLEM.linearize(x))
    there = state(z=z, program=program, merit=_merit(program, z, 1.0), damping=1.0)
    full = loop().advanced(there)
    assert (full.damping, full.outcome, full.evaluations) == (0.0, "", there.evaluations)
    end = full
    for _ in range(4):
        if not end.outcome:
            end = loop().advanced(end)
    assert end.outcome == "rest"
    assert end.z == pytest.approx(z, abs=1e-7)


def test_three_quiet_passes_are_enough_and_two_are_not() -> None:
    """Near a lasso's minimum: less is promised than an interior point's accuracy, and more than its best."""
    before = state(formulation=ro.lasso, weight=20.0)
    program = before.program
    z = program.solve(20.0).z
    best = _merit(program, z, 20.0)
    i = int(np.argmax(np.abs(z)))
    z[i] += np.sqrt(1e-9 * best) / before.size[i]
    there = replace(before, z=z, merit=_merit(program, z, 20.0))
    assert 1e-10 * best < there.merit - best < 0.5e-8 * best
    at = loop(formulation=ro.lasso, tolerance=0.0)
    third = at.advanced(replace(there, quiet=2))
    assert (third.outcome, third.evaluations) == ("rest", there.evaluations)
    second = at.advanced(replace(there, quiet=1))
    assert (second.outcome, second.evaluations, second.quiet) == ("", there.evaluations + 1, 2)
    assert at.advanced(replace(there, merit=best, quiet=0)).outcome == "rest"
    assert at.advanced(replace(there, merit=best * (1 + 1e-7), quiet=2)).quiet == 0


def test_a_step_follows_the_curve_of_the_residual() -> None:
    """b moves by half the second derivative along the step, here from central differences."""
    before = state(FAR, weight=1e-2)
    straight = before.program.solve(1e-2).z
    bent = loop(FAR)._bent(before, straight)
    scale = FAR.parameters.free.scale
    h = 1e-3
    ahead, behind = (FAR.whitened_residual(scale * (s * straight)) for s in (h, -h))
    here = FAR.whitened_residual(0 * scale)
    half = 0.5 * (ahead - 2 * here + behind) / h**2
    curved = before.program.on(before.program.model.with_values(before.program.model.b + half)).solve(1e-2).z
    D = before.size
    turn = np.linalg.norm(D * (curved - straight))
    assert turn > 0
    if (bent != straight).any():
        assert np.linalg.norm(D * (bent - curved)) < 0.3 * turn
    merits = [_merit(before.program.on(loop(FAR).linearized(z)), z, 1e-2) for z in (straight, bent)]
    assert merits[1] <= merits[0]


class Curved(ro.CalibrationProblem):
    """Residuals that bend along the first step by a part of what it does: b - A z + part (z.s / s.s)^2 A s."""

    part = 0.0

    def whitened_residual(self, x: np.ndarray) -> np.ndarray:
        start = PROBLEM.linearize(0 * x)
        z = x / PROBLEM.parameters.free.scale
        step = np.linalg.lstsq(start.A, start.b)[0]
        along = start.A @ step
        return start.b - start.A @ z + self.part * (z @ step / (step @ step)) ** 2 * along


@pytest.mark.parametrize(
    ("part", "follows"), [(0.0, False), (0.09, False), (0.11, True), (-0.2, True), (0.37, True), (0.38, False)]
)
def test_a_step_follows_curves_that_matter_and_do_not_turn_it_too_far(part: float, follows: bool) -> None:
    """With full rank and no penalty the minimum moves by that part of the step: above a tenth, below 0.75 / 2."""
    curved = Curved(PROBLEM.robot, PROBLEM.parameters, PROBLEM.data)
    object.__setattr__(curved, "part", part)
    before = state(formulation=ro.least_squares, weight=0.0)
    straight = before.program.solve(0.0).z
    assert before.program.model.rank == N or before.program.closed_form
    bent = loop(curved, ro.least_squares)._bent(before, straight)
    if follows:
        assert bent == pytest.approx((1 + part) * straight, rel=1e-6)
    else:
        assert bent is straight


class Unasked(ro.CalibrationProblem):
    """Says whether its residual was asked for."""

    def whitened_residual(self, x: np.ndarray) -> np.ndarray:
        raise LookupError


@pytest.mark.parametrize(("distance", "length", "asks"), [(0, 0.9e-3, 0), (0, 1.1e-3, 1), (99, 0.09, 0), (99, 0.11, 1)])
def test_what_is_short_is_told_by_the_solutions_size(distance: float, length: float, asks: bool) -> None:
    unasked = Unasked(PROBLEM.robot, PROBLEM.parameters, PROBLEM.data)
    z = np.eye(N)[0] * distance
    before = state(z=z)
    step = np.eye(N)[1] * length
    if asks:
        with pytest.raises(LookupError):
            loop(unasked)._bent(before, z + step)
    else:
        assert (loop(unasked)._bent(before, z + step) == z + step).all()


def test_a_short_step_is_straight() -> None:
    before = state()
    z = before.z + 1e-4
    assert loop()._bent(before, z) is z


# --- what is said ------------------------------------------------------------------------------------------


def test_why_passes_ran_out() -> None:
    falling = tuple(Iteration(100.0 - k, 1.0, 1.0, 0.0) for k in range(8))
    assert _unfinished(state(history=falling), 8) == "8 passes were not enough; give more (max_iterations)."
    level = tuple(Iteration(100.0 - 2e-8 * k, 1.0, 1.0, 0.0) for k in range(8))
    flat = _unfinished(state(history=level), 8)
    assert flat == (
        "8 passes were not enough, though the objective hardly changes: the data hardly decide, give a larger weight."
    )
    assert _unfinished(state(history=level[:4]), 1) == "1 pass was not enough; give more (max_iterations)."
    slowly = tuple(Iteration(100.0 - 1e-6 * k, 1.0, 1.0, 0.0) for k in range(8))
    assert "give more" in _unfinished(state(history=slowly), 8)
    late = (*falling, *level)
    assert "hardly decide" in _unfinished(state(history=late), 16)
    assert "give more" in _unfinished(state(history=(*level, *falling)), 16)


def test_why_a_loop_at_rest_has_not_converged() -> None:
    assert "still promises 0.002 of the objective" in _doubted(Certificate(None, 1.0, 0.0, 0.002))
    assert "constraints are missed by 3e-05 scales" in _doubted(Certificate(None, 1.0, 3e-5, 1e-9))
    assert "nothing certifies it" in _doubted(Certificate(None, 1.0, 0.0, None))


@pytest.mark.parametrize(
    ("decrease", "violation", "holds"),
    [(1e-7, 0.0, True), (1.1e-6, 0.0, False), (None, 0.0, False), (0.0, 0.9e-7, True), (0.0, 1.1e-7, False)],
)
def test_a_certificate_holds_to_an_interior_points_accuracy(decrease: Any, violation: float, holds: bool) -> None:
    assert Certificate(None, 0.0, violation, decrease).holds(np.full(3, 0.5)) == holds
    assert Certificate(None, 0.0, 10 * violation, decrease).holds(np.full(3, -10.0)) == holds  # of the largest entry


def slope_of(model: LinearModel) -> float:
    """Norm of the data's gradient at nominal."""
    return float(np.linalg.norm(2 * model.A.T @ model.b))


def test_a_certificate_measures_what_is_left() -> None:
    """Of a quadratic everything is known: the gradient, the step to the minimum, and what it promises."""
    start = PROBLEM.linearize(np.zeros(N))
    best = ro.convex.pose(ro.tikhonov, start).solve(1.0).z
    z = best + 1e-3 * np.linspace(-1, 1, N)
    found = certified(ro.tikhonov, start, slope_of(start), z, 1.0)
    gradient = 2 * start.A.T @ (start.A @ z - start.b) + 2 * z
    size = np.linalg.norm(2 * start.A.T @ start.b)
    assert found.gradient == pytest.approx(np.linalg.norm(gradient) / size, rel=1e-9)
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
    found = certified(loss, start, slope_of(start), best, unit)
    assert found.gradient is not None
    assert found.gradient < 1e-9 * unit


def test_a_certificate_leaves_out_what_bounds_hold_back() -> None:
    start = PROBLEM.linearize(np.zeros(N))
    box = ro.constraints.Box("half", lambda p: (np.full(len(p), -0.5), np.full(len(p), 0.5)))
    boxed = ro.Formulation("boxed", penalty=cp.sum_squares, constraints=(box,))
    best = ro.convex.pose(boxed, start).solve(1.0).z
    assert (np.abs(best) == 0.5).sum() > 2
    found = certified(boxed, start, slope_of(start), best, 1.0)
    assert found.gradient is not None
    assert found.gradient < 1e-9
    assert found.violation == 0.0
    inside = np.clip(best, -0.49, 0.49)
    gradient = 2 * start.A.T @ (start.A @ inside - start.b) + 2 * inside
    size = np.linalg.norm(2 * start.A.T @ start.b)
    moved = certified(boxed, start, slope_of(start), inside, 1.0)
    assert moved.gradient == pytest.approx(np.linalg.norm(gradient) / size, rel=1e-9)
    opposite = certified(boxed, start, slope_of(start), -np.sign(gradient) * -0.5, 1.0)  # every bound on the wrong side
    assert opposite.gradient is not None
    outside = certified(boxed, start, slope_of(start), 2 * best, 1.0)
    assert outside.violation == pytest.approx(0.5, rel=1e-12)


def test_an_objective_that_did_not_fall_for_long_is_taken_to_be_the_least() -> None:
    passed = [Iteration(100.0 + 1e-12 * k, 1.0, 1.0, 0.0) for k in range(12, 0, -1)]
    still = state(formulation=ro.lasso, merit=100.0)
    assert loop()._stalled(replace(still, history=tuple(passed)))
    assert not loop()._stalled(replace(still, history=tuple(passed[:10])))
    falling = [Iteration(100.0 + 1e-3 * k, 1.0, 1.0, 0.0) for k in range(12, 0, -1)]
    assert not loop()._stalled(replace(still, history=tuple(falling)))


def test_a_start_outside_of_the_constraints_is_moved_inside_before_the_first_pass() -> None:
    """Also where one parameter alone is outside."""
    problem = ro.load("paper_arm").problem
    tight = problem.with_parameters(problem.parameters.toleranced({"length_mm": 0.5, "angle_mrad": 0.5}))
    free = tight.parameters.free
    start = np.zeros(len(free))
    start[3] = 7 * free.tolerance[3]
    loop = Loop(tight.frozen(), ro.bounded, None, {}, 1e-8, 500)
    x = free.scale * _begun(loop, ro.bounded, choosing(1.0, True), start).z
    assert (np.abs(x) <= free.tolerance * (1 + 1e-9)).all()
    assert x == pytest.approx(np.clip(start, -free.tolerance, free.tolerance))


def test_many_refusals_end_where_little_was_promised(monkeypatch: pytest.MonkeyPatch) -> None:
    """The seventh, of a step that promises less than a millionth of the objective; one that promises more goes on."""
    best = ro.calibrate(PROBLEM, ro.tikhonov, 1.0)
    start = state()
    monkeypatch.setattr(
        "rpim_opt.calibration.loop._merit",
        lambda program, z, weight: _merit(program, z, weight) + 1e9 * (program is not here.program),
    )

    def at(z: np.ndarray, refused: int) -> State:
        program = start.program.on(loop().linearized(z))
        merit = _merit(program, z, 1.0)
        return replace(start, z=z, program=program, merit=merit, refused=refused)

    rng = np.random.default_rng(1)
    direction = rng.normal(size=N)
    close = at(best.z, 0)
    rise = _merit(close.program, best.z + direction, 1.0) - close.merit
    little = best.z + np.sqrt(1e-7 * close.merit / rise) * direction
    for refused, outcome in ((4, ""), (5, ""), (6, "rest"), (7, "rest")):
        here = at(little, refused)
        found = loop().advanced(here)
        assert found.outcome == outcome
        assert found.refused == refused + 1
    here = at(np.zeros(N), 7)
    assert loop().advanced(here).outcome == ""
