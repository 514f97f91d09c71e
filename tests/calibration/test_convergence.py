"""A calibration says whether it converged, why it did not, and which constraints contradict each other."""

from __future__ import annotations

import re
from collections.abc import Callable
from itertools import count
from typing import Any

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from tests.convex.plain import objective_at, plain, violation
from tests.simulate import ARM, simulated

SHIPPED = ("blunders", "constrained", "distance", "far_frames", "pose", "rank_deficient", "scara")
"""Of each kind one: the others run through the same code."""


def promised(result: Any) -> float:
    """How far the objective lies above the optimum of its last linearization, relative to that."""
    model = result.problem.linearize(result.x)
    z = result.x / model.parameters.scale
    best = plain(result.formulation, model, result.weight).objective
    return (objective_at(result.formulation, model, result.weight, z) - best) / max(abs(best), 1.0)


def told(result: Any) -> str:
    """Everything that a reader of the result sees."""
    return f"{result.message}\n{result}"


def one_sentence(error: BaseException) -> str:
    text = str(error)
    assert "\n" not in text
    assert text.endswith((".", "?", ")"))
    assert len(text) < 500
    return text


# --- converged ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHIPPED)
def test_a_penalty_with_a_domain_converges_to_its_minimum(name: str) -> None:
    """Relative entropy, defined for z >= -1: full steps leave the domain, where the objective is infinite."""
    problem = ro.load(name).problem
    s = problem.linearize(np.zeros(len(problem.parameters.free))).svd[1]
    entropy = ro.Formulation("entropy", penalty=lambda z: cp.sum(cp.kl_div(z + 1, 1)))
    result = ro.calibrate(problem, entropy, max(1.0, 1e-6 * s[0] ** 2))
    assert np.isfinite(result.x).all()
    assert (result.x / result.problem.parameters.free.scale).min() >= -1 - 1e-7
    assert result.converged, result.message
    assert promised(result) < 1e-6
    assert result.certificate.decrease < 2e-6


@pytest.mark.parametrize("weight", [1.0, 100.0])
def test_what_is_called_converged_is_a_minimum_at_small_weights_too(weight: float) -> None:
    """Old loops stopped at 308,728 where the linearization's own minimum was 252,896."""
    entropy = ro.Formulation("entropy", penalty=lambda z: cp.sum(cp.kl_div(z + 1, 1)))
    result = ro.calibrate(ro.load("distance").problem, entropy, weight)
    assert np.isfinite(result.history[-1].objective)
    if result.converged:
        assert promised(result) < 1e-6


@pytest.mark.parametrize("weight", [pytest.param(1.0, marks=pytest.mark.slow), 10.0,
                                    pytest.param(100.0, marks=pytest.mark.slow)])  # fmt: skip
@pytest.mark.parametrize("formulation", [ro.lasso, ro.group_lasso], ids=["lasso", "group lasso"])
@pytest.mark.parametrize("name", SHIPPED)
def test_sparse_penalties_converge_everywhere(name: str, formulation: ro.Formulation, weight: float) -> None:
    result = ro.calibrate(ro.load(name).problem, formulation, weight)
    assert result.converged, result.message
    assert result.certificate.decrease < 1e-6


def test_a_certificate_is_what_converged_rests_on() -> None:
    problem = ro.load("position").problem
    early = ro.calibrate(problem, ro.robust, 1.0, max_iterations=1)
    late = ro.calibrate(problem, ro.robust, 1.0)
    assert not early.converged
    assert late.converged
    assert early.certificate.decrease > 1e-6 > late.certificate.decrease >= 0
    assert late.certificate.step < 1e-4
    assert late.certificate.violation == 0


def test_exact_poses_of_the_nominal_robot_converge_where_they_begin() -> None:
    """What is left is rounding, of which a step of 1e-14 takes a share."""
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (36, 6))
    data = ro.Dataset.of(q, ro.robot.forward_kinematics(ARM, q), 1e-4, measurement="pose")
    parameters = ro.robot.model_parameters(ARM).identify(["theta?"])
    result = ro.calibrate(ro.CalibrationProblem(ARM, parameters, data), weight=1.0)
    assert result.converged, result.message
    assert np.abs(result.x).max() < 1e-12


@pytest.mark.parametrize("weight", [1e-3, 1e-2, 1.0])
def test_a_loss_with_a_variable_of_its_own_converges(weight: float) -> None:
    """Its value is a minimum over that variable, which one factorization in three does not reach."""

    def worst_fifth(v: Any) -> Any:
        level = cp.Variable()
        return level + cp.sum(cp.pos(v - level)) / (0.2 * v.size)

    cvar = ro.Formulation("CVaR", loss=worst_fifth, loss_over="configuration", penalty=cp.sum_squares)
    result = ro.calibrate(ro.load("position").problem, cvar, weight)
    assert result.converged, result.message
    assert result.certificate.decrease < 1e-8
    worst = np.sort(result.program.norms(result.z))[-8:]
    assert result.program.value(result.z, weight)[0] == pytest.approx(worst.mean(), rel=1e-8)


def test_a_solver_that_is_not_installed_is_named_with_those_that_are() -> None:
    with pytest.raises(ro.InputError, match=r"'NOT_ONE'.*CLARABEL") as raised:
        ro.calibrate(ro.load("position").problem, ro.lasso, 1.0, solver="NOT_ONE")
    one_sentence(raised.value)


# --- selectors ---------------------------------------------------------------------------------------------


def in_turn(*weights: float) -> Callable[[Any], ro.select.Selection]:
    """A selector that answers with these weights in turn, whatever the data say."""
    asked = count()

    def alternating(program: Any) -> ro.select.Selection:
        weight = weights[next(asked) % len(weights)]
        return ro.select.Selection(weight, "in turn", np.array(weights), np.zeros(len(weights)), interior=True)

    return alternating


def test_a_selector_that_alternates_is_answered_with_a_sentence() -> None:
    result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, in_turn(1e-3, 1e-2))
    assert "alternat" in told(result)
    assert 1e-3 <= result.weight <= 1e-2
    given = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, result.weight)
    assert np.abs((result.x - given.x) / result.problem.parameters.free.scale).max() < 1e-6


@pytest.mark.parametrize(
    ("name", "rule"),
    [
        ("paper_arm", ro.gcv),
        ("cable", ro.quasi_optimality),
        ("scara", ro.leave_one_out),
        ("position", ro.reml),
        ("position", ro.l_curve),
        ("rank_deficient", ro.gcv),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_the_weight_is_a_fixed_point_of_its_rule_or_it_is_said(name: str, rule: Any) -> None:
    """Asked once more at the end, paper_arm's GCV answered 6e-15 where 1e-3 had been used, without a word."""
    result = ro.calibrate(ro.load(name).problem, ro.tikhonov, rule)
    asked_again = rule(result.program).weight
    settled = abs(np.log(asked_again / result.weight)) < 1e-2
    assert settled != ("alternat" in told(result))


def test_a_selector_that_settles_is_not_said_to_alternate() -> None:
    for rule in (ro.reml, ro.l_curve, ro.discrepancy):
        result = ro.calibrate(ro.load("position").problem, ro.tikhonov, rule)
        assert "alternat" not in told(result)


# --- not converged, and why --------------------------------------------------------------------------------


def test_too_few_passes_are_the_cause_that_is_named() -> None:
    result = ro.calibrate(ro.load("position").problem, ro.tikhonov, 1.0, max_iterations=1)
    assert not result.converged
    assert re.search(r"\b(1|one) iteration\b", result.message)
    assert "weight" not in result.message  # no larger weight helps against a limit of one pass


@pytest.mark.parametrize("name", ["position", "paper_arm"])
def test_angles_wrap(name: str) -> None:
    """A start at theta + 2 pi is the same robot."""
    problem = ro.load(name).problem
    free = problem.parameters.free
    want = ro.calibrate(problem, ro.tikhonov, 1.0)
    for turned in ("theta2", "theta3"):
        for turns in (1, -1):
            start = np.zeros(len(free))
            start[free.names.index(turned)] = turns * 2 * np.pi
            result = ro.calibrate(problem, ro.tikhonov, 1.0, start=start)
            assert result.converged, result.message
            assert np.abs((result.x - want.x) / free.scale).max() < 1e-6


@pytest.mark.parametrize("metres", [1e2, 1e3, 1e4])
@pytest.mark.parametrize("weight", [1.0, 1e3])
def test_a_huber_loss_far_from_its_data_is_not_called_infeasible(metres: float, weight: float) -> None:
    """A program without constraints always has a point."""
    problem, _ = simulated(noise=5e-5, configurations=20)
    data = problem.data
    far = problem.on(ro.Dataset.of(data.q, data.blocks[0].y + metres, 5e-5))
    start = np.zeros(len(problem.parameters.free))
    try:
        result = ro.calibrate(far, ro.robust, weight, start=start, max_iterations=3)
    except ro.NoSolutionFound as refused:  # plain CVXPY finds none either
        text = one_sentence(refused)
    else:
        assert np.isfinite(result.x).all()
        text = told(result)
    assert not re.search("infeasible|constraint", text.lower())


# --- infeasible, and what contradicts what -----------------------------------------------------------------


def bound(name: str, parameter: str, lower: float, upper: float) -> ro.constraints.Box:
    """Bounds of one parameter [scales]."""

    def limits(p: Any) -> tuple[np.ndarray, np.ndarray]:
        at = p.names.index(parameter)
        low, high = np.full(len(p), -np.inf), np.full(len(p), np.inf)
        low[at], high[at] = lower, upper
        return low, high

    return ro.constraints.Box(name, limits)


def position_of(parameter: str, p: Any) -> int:
    return p.names.index(parameter)


def refused(*constraints: Any, loss: Any = cp.sum_squares) -> str:
    """What is said of constraints that contradict each other on the paper's arm (scales of 1 mm and 1 mrad)."""
    impossible = ro.Formulation("impossible", loss, cp.sum_squares, constraints)
    with pytest.raises((ro.NoSolutionFound, ro.InputError)) as caught:
        ro.calibrate(ro.load("paper_arm").problem, impossible, 1.0)
    return one_sentence(caught.value)


def test_bounds_the_wrong_way_round_are_named_with_their_units() -> None:
    text = refused(bound("crossed", "a3", 0.5, 0.2))
    assert re.search(r"\ba3\b", text)
    assert re.search(r"\b0\.50* mm", text)
    assert re.search(r"\b0\.20* mm", text)


def test_an_angles_bounds_the_wrong_way_round_are_in_milliradians() -> None:
    text = refused(bound("crossed", "alpha2", 3.0, -1.25))
    assert re.search(r"\balpha2\b", text)
    assert re.search(r"\b3(\.0*)? mrad", text)
    assert re.search(r"-1\.250* mrad", text)


def test_two_boxes_that_contradict_each_other_are_named() -> None:
    long, short = bound("a3 is long", "a3", 0.5, np.inf), bound("a3 is short", "a3", -np.inf, 0.2)
    others = [bound(f"{name} is free enough", name, -5.0, 5.0) for name in ("a4", "d2", "alpha3")]
    text = refused(others[0], long, others[1], short, others[2])
    assert re.search(r"\ba3\b", text)
    assert re.search(r"\bmm\b", text)
    assert not re.search(r"\b(a4|d2|alpha3)\b", text)


def short_sum(z: Any, p: Any) -> Any:
    return z[position_of("a3", p)] + z[position_of("a4", p)] <= -1.0


def a3_not_short(z: Any, p: Any) -> Any:
    return z[position_of("a3", p)] >= -0.4


def a4_not_short(z: Any, p: Any) -> Any:
    return z[position_of("a4", p)] >= -0.4


def small_ball(z: Any, p: Any) -> Any:
    return cp.norm(z) <= 20


def level(z: Any, p: Any) -> Any:
    return z[position_of("d2", p)] == z[position_of("d3", p)]


FIVE = (small_ball, short_sum, level, a3_not_short, a4_not_short)
CONTRADICTING = (short_sum, a3_not_short, a4_not_short)


@pytest.mark.parametrize("loss", [cp.sum_squares, ro.huber()], ids=["squared", "Huber"])
def test_an_irreducible_set_of_contradicting_constraints_is_named(loss: Any) -> None:
    text = refused(*FIVE, loss=loss)
    named = {constraint.__name__ for constraint in FIVE if constraint.__name__ in text}
    assert named == {constraint.__name__ for constraint in CONTRADICTING}


@pytest.mark.parametrize("left_out", CONTRADICTING)
def test_without_any_one_of_them_the_rest_is_feasible(left_out: Any) -> None:
    rest = tuple(constraint for constraint in FIVE if constraint is not left_out)
    formulation = ro.Formulation("possible", penalty=cp.sum_squares, constraints=rest)
    result = ro.calibrate(ro.load("paper_arm").problem, formulation, 1.0)
    z = result.x / result.problem.parameters.free.scale
    assert result.converged
    assert violation(formulation, result.program.model, z) < 1e-7


def test_a_pair_among_five_is_named_and_nothing_else() -> None:
    def in_a_small_ball(z: Any, p: Any) -> Any:
        return cp.norm(z) <= 1.0

    def far_out(z: Any, p: Any) -> Any:
        return z[0] >= 2.0

    def harmless(z: Any, p: Any) -> Any:
        return cp.norm1(z) <= 100

    def harmless_too(z: Any, p: Any) -> Any:
        return z[5] <= 3.0

    text = refused(harmless, in_a_small_ball, level, far_out, harmless_too)
    assert "in_a_small_ball" in text
    assert "far_out" in text
    assert not any(name in text for name in ("harmless", "level"))


# --- what a user may get wrong -----------------------------------------------------------------------------


def wrong(formulation: Callable[[], ro.Formulation], weight: Any = 1.0) -> str:
    with pytest.raises((ro.InputError, ro.NoSolutionFound)) as caught:
        ro.calibrate(ro.load("paper_arm").problem, formulation(), weight)
    return one_sentence(caught.value)


def whole_numbers(z: Any, p: Any) -> Any:
    return z[0] == 0.1 * cp.Variable(integer=True)


def switch(z: Any, p: Any) -> Any:
    return z[0] <= cp.Variable(boolean=True)


def no_limit(p: Any) -> tuple[np.ndarray, np.ndarray]:
    return np.full(len(p), -np.inf), np.full(len(p), np.inf)


UNSET = cp.Parameter(name="radius", nonneg=True)
WRONG: dict[str, tuple[Callable[[], ro.Formulation], str]] = {
    "a loss that is a vector": (lambda: ro.Formulation("mine", cp.abs, cp.sum_squares), "loss"),
    "no loss at all": (lambda: ro.Formulation("mine", lambda r: None, cp.sum_squares), "loss"),
    "a penalty that is a vector": (lambda: ro.Formulation("mine", penalty=cp.abs), "penalty"),
    "no penalty at all": (lambda: ro.Formulation("mine", penalty=lambda z: None), "penalty"),
    "a concave penalty": (lambda: ro.Formulation("mine", penalty=lambda z: -cp.norm(z)), "convex"),
    "an integer variable": (lambda: ro.Formulation("mine", penalty=cp.norm1, constraints=(whole_numbers,)), "integer"),
    "a boolean variable": (lambda: ro.Formulation("mine", penalty=cp.norm1, constraints=(switch,)), "integer|boolean"),
    "a constraint that is none": (
        lambda: ro.Formulation("mine", penalty=cp.norm1, constraints=(lambda z, p: None,)),
        "constraint",
    ),
    "a parameter without value": (
        lambda: ro.Formulation("mine", penalty=cp.norm1, constraints=(lambda z, p: cp.norm(z) <= UNSET,)),
        "radius",
    ),
    "a Huber threshold below zero": (lambda: ro.Formulation("mine", ro.huber(-1)), r"huber.*-1"),
    "a Huber threshold that is no number": (lambda: ro.Formulation("mine", ro.huber(np.nan)), r"huber.*nan"),
    "a box without a finite limit": (
        lambda: ro.Formulation("mine", penalty=cp.norm1, constraints=(ro.constraints.Box("no limit", no_limit),)),
        "no limit",
    ),
}


@pytest.mark.parametrize("name", list(WRONG))
def test_what_is_wrong_with_a_formulation_is_one_sentence(name: str) -> None:
    make, culprit = WRONG[name]
    assert re.search(culprit, wrong(make))


def test_a_selector_by_its_name_works_or_is_answered() -> None:
    problem = ro.load("paper_arm").problem
    want = ro.calibrate(problem, ro.tikhonov, ro.reml).weight
    by_name: Any = "reml"
    try:
        found = ro.calibrate(problem, ro.tikhonov, by_name).weight
    except ro.InputError as refused:
        text = one_sentence(refused)
        found = want
    else:
        text = "reml"
    assert "reml" in text
    assert found == want


def test_a_selector_by_a_wrong_name_is_answered() -> None:
    assert "remel" in wrong(lambda: ro.tikhonov, "remel")


def test_a_selector_that_returns_nothing_is_named() -> None:
    def mine(program: Any) -> Any:
        return None

    assert "mine" in wrong(lambda: ro.tikhonov, mine)


@pytest.mark.parametrize("weight", [np.nan, np.inf, -1.0])
def test_a_selector_that_returns_no_weight_is_named(weight: float) -> None:
    def mine(program: Any) -> ro.select.Selection:
        return ro.select.Selection(weight, "mine", np.ones(1), np.ones(1), interior=True)

    assert re.search("mine|weight", wrong(lambda: ro.tikhonov, mine))


def test_a_covariance_that_is_no_number_is_named() -> None:
    data = ro.load("paper_arm").problem.data
    covariance = np.tile(1e-9 * np.eye(3), (len(data), 1, 1))
    covariance[4, 1, 1] = np.nan

    def asked() -> None:
        noisy = ro.Dataset.of(data.q, data.blocks[0].y, covariance)
        ro.calibrate(ro.load("paper_arm").problem.on(noisy), ro.tikhonov, 1.0)

    with pytest.raises(ro.InputError) as caught:
        asked()
    assert re.search("covariance|sigma", one_sentence(caught.value))


@pytest.mark.parametrize("rule", [ro.reml, ro.gcv, ro.l_curve, ro.discrepancy], ids=lambda rule: rule.__name__)
def test_one_configuration_gives_an_answer_or_one_sentence(rule: Any) -> None:
    arm = ro.load("paper_arm").problem
    single = arm.on(ro.Dataset.of(arm.data.q[:1], arm.data.blocks[0].y[:1], 3e-5))
    try:
        result = ro.calibrate(single, ro.robust, rule)
    except (ro.InputError, ro.NoSolutionFound) as error:
        one_sentence(error)
    else:
        assert np.isfinite(result.x).all()
        assert np.isfinite(result.weight)


def test_a_fit_without_a_penalty_that_ran_away_says_so() -> None:
    result = ro.calibrate(ro.load("rank_deficient").problem, ro.least_squares, 0.0)
    assert "diverge without a penalty; add one" in result.message
    assert "diverge" not in ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, 1.0).message


def test_a_damped_program_that_no_solver_solves_is_damped_more() -> None:
    """Far along combinations that no penalty holds: no error of a solver, but the reason."""
    robot = ro.load("paper_arm").problem.robot
    every = ["alpha?", "a?", "theta?", "d?", "tool_[xyz]", "base_*"]
    problem, _ = simulated(every, configurations=20, noise=5e-5, robot=robot)
    result = ro.calibrate(problem, ro.Formulation("absolute values", loss=cp.norm1), 0.0, max_iterations=40)
    assert "diverge without a penalty; add one" in result.message


def test_a_fit_that_leads_on_and_on_is_given_up() -> None:
    """After 250 iterations beyond a thousand prior standard deviations, not after the 500 that are allowed."""
    norms = ro.Formulation("sum of norms", loss=cp.sum, loss_over="configuration")
    result = ro.calibrate(ro.load("paper_arm").problem, norms, 0.0)
    assert not result.converged
    assert "deviations exceed 1000 prior standard deviations" in result.message
    assert 100 < len(result.history) <= 250


def test_a_penalty_that_leaves_redundant_parameters_out_is_the_cause_of_their_deviations() -> None:
    """And not the table, which would be searched for a mistake in vain."""
    offsets = ro.Formulation("joint offsets", penalty=lambda z: cp.sum_squares(z["theta?"]))
    for name, weight in (("pose", 1.0), ("pose", None), ("position", 1.0)):
        result = ro.calibrate(ro.load(name).problem, offsets, weight)
        assert ("neither data nor penalty determines diverge" in result.message) == (name == "pose")
        (said,) = [text for text in result.verdict.reasons if "manufacturing errors" in text]
        assert "Neither data nor penalty determines it: add a penalty on it" in said
        assert "DH table" not in str(result.verdict)


def test_one_configuration_has_its_torques_in_a_row() -> None:
    result = ro.calibrate(ro.load("position").problem, ro.tikhonov, 1.0)
    q, torque = np.full(6, 0.1), np.ones(6)
    assert np.array_equal(result.forward(q, torque=torque), result.forward(q[None], torque=torque[None]))
