"""Constraints stated as on a drawing: each holds, and finite differences confirm its multiplier."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics import InputError
from rpim_opt.calibration import Calibration
from rpim_opt.calibration.diagnosis import ShadowPrice

HOME = np.zeros((1, 6))
FIXTURE = {"x": (0.2, 0.5), "y": (-0.2, 0.2), "z": (0.0, 0.5)}
PLACES = {"home": HOME, "fixture": FIXTURE}
TIGHT = {
    "a3 + d4 = 572.00 +- 0.05 mm": "0.05",
    "|a3 - nominal| <= 0.2 mm": "0.2",
    "alpha3 >= -0.05 deg": "0.05",
    "d5 = nominal +- 0.1 mm": "0.1",
    "norm(tool_x - 20 mm, tool_y) <= 1 mm": "1 mm",
    "-0.5 <= beta2 - nominal <= 0.5 mrad": "0.5",
    "|theta? - nominal| <= 0.3 mrad": "0.3",
    "move at most 0.5 mm: workspace": "0.5",
    "move at most 0.3 mm: home": "0.3",
    "move at most 0.5 mm: fixture": "0.5",
}
"""Statements that the arm of ``position`` would like to break, and the number by which each is loosened."""


def calibrated(*texts: str, formulation: ro.Formulation = ro.tikhonov, problem: str = "position") -> Calibration:
    demands = tuple(ro.constraints.parse(text, PLACES) for text in texts)
    result = ro.calibrate(ro.load(problem).problem, replace(formulation, constraints=demands), weight=1.0)
    assert result.converged, result.message
    return result


def misfit(result: Calibration) -> float:
    return result.program.objective(result.z, result.weight)


def loosened(text: str, number: str, by: float) -> str:
    """Return a statement whose number is larger by so much, on both sides where it stands on both."""
    stem = number.split()[0]
    return re.sub(rf"(?<![\d.]){re.escape(stem)}(?=\D*(?:mm|deg|mrad|<=|$))", f"{float(stem) + by:.6f}", text)


def priced(text: str, formulation: ro.Formulation = ro.tikhonov) -> ShadowPrice:
    """Return the price of one statement, and hold it against a central difference of the misfit."""
    step = 2e-4
    more, less = (misfit(calibrated(loosened(text, TIGHT[text], by), formulation=formulation)) for by in (step, -step))
    result = calibrated(text, formulation=formulation)
    (price,) = result.shadow_prices
    assert price.holds
    assert price.slack < 1e-6
    assert price.multiplier == pytest.approx((less - more) / (2 * step), rel=2e-4)
    return price


REGIONS = ("workspace", "fixture")


@pytest.mark.parametrize("text", [text for text in TIGHT if not text.endswith(REGIONS)])
def test_the_price_of_a_statement_is_the_slope_of_the_misfit(text: str) -> None:
    """A round of positions may change z by 1e-4, and the multiplier with it."""
    price = priced(text)
    assert price.gain == pytest.approx(min(price.multiplier * price.step, price.misfit))
    assert price.text == text


@pytest.mark.slow
@pytest.mark.parametrize("text", [text for text in TIGHT if text.endswith(REGIONS)])
def test_so_is_that_of_movements_in_a_region(text: str) -> None:
    priced(text)


def test_so_is_that_of_another_loss() -> None:
    priced("|a3 - nominal| <= 0.2 mm", ro.robust)


def test_an_equality_is_priced_by_giving_it_a_tolerance() -> None:
    (price,) = calibrated("a4 = 70 mm").shadow_prices
    exact, loose = (misfit(calibrated(text)) for text in ("a4 = 70 mm", "a4 = 70 +- 0.00002 mm"))
    assert price.slack == 0
    assert price.multiplier == pytest.approx((exact - loose) / 2e-5, rel=1e-3)  # one-sided: its error is the step's


@pytest.mark.slow
def test_ten_statements_together_have_their_own_prices() -> None:
    """Whether or not they hold: multipliers are zero where there is slack, and slack is zero where they are not."""
    texts = (*list(TIGHT)[:7], "a2 - 0.5 a3 <= -134 mm", "a4 = 70 mm", "move at most 3 mm: home")
    result = calibrated(*texts)
    assert [price.text for price in result.shadow_prices] == list(texts)
    assert {price.text for price in result.shadow_prices if not price.holds} >= {"a2 - 0.5 a3 <= -134 mm"}
    step = 2e-4
    for text, price in zip(texts[:7], result.shadow_prices, strict=False):
        assert price.holds == (price.multiplier > 0)
        assert (price.slack < 1e-6) == price.holds
        if text not in texts[1:7:3]:  # two of them suffice to see that the others matter
            continue
        more, less = (
            misfit(calibrated(*(loosened(t, TIGHT[t], by) if t == text else t for t in texts))) for by in (step, -step)
        )
        assert price.multiplier == pytest.approx((less - more) / (2 * step), rel=1e-3, abs=1e-3)


def test_statements_hold_of_the_identified_robot() -> None:
    """By the tables of the robot, which know nothing of the program."""
    result = calibrated("a3 + d4 = 572.00 +- 0.05 mm", "alpha3 >= -0.05 deg", "d1 + d2 = 290 mm")
    _, a, _, d, _ = result.robot.mdh.T
    assert 571.95 - 1e-6 <= 1e3 * (a[2] + d[3]) <= 572.05 + 1e-6
    assert np.degrees(result.robot.mdh[2, 0]) >= -0.05 - 1e-8
    assert d[0] + d[1] == pytest.approx(0.29, abs=1e-9)


@pytest.mark.parametrize("where", ["home", "workspace", pytest.param("fixture", marks=pytest.mark.slow)])
def test_no_movement_is_larger_than_stated(where: str) -> None:
    """Of the robot alone, by its forward kinematics and not to first order."""
    result = calibrated(f"move at most 0.3 mm: {where}")
    q = HOME
    if where != "home":
        q = np.random.default_rng(5).uniform(*result.problem.robot.limits.T, (20000, 6))
    frames = result.problem.parameters.of_frames[result.problem.parameters.identified]
    robot_alone = replace(result, x=np.where(frames, 0.0, result.x))
    before = replace(result, x=np.zeros_like(result.x)).forward(q)[:, :3, 3]
    if where == "fixture":  # in the robot's base frame
        tool = np.array([0.02, 0.0, 0.06, 1.0])
        at = (ro.robot.forward_kinematics(result.problem.robot, q) @ tool)[:, :3]
        low, high = np.array([FIXTURE[axis] for axis in "xyz"]).T
        inside = ((at > low) & (at < high)).all(axis=1)
        q, before = q[inside], before[inside]
        assert len(q) > 100
    moved = np.linalg.norm(robot_alone.forward(q)[:, :3, 3] - before, axis=1)
    assert np.max(moved) == pytest.approx(3e-4, rel=1e-5 if where == "home" else 0.1)  # others than those asked


def test_a_contradiction_is_named() -> None:
    """Any one of those named less, and there is a solution; what may stay is not named."""
    sum_, link, other = "a3 + d4 = 572.00 +- 0.05 mm", "a3 = 270.5 mm", "|d4 - 302 mm| <= 0.1 mm"
    with pytest.raises(ro.NoSolutionFound) as error:
        calibrated(sum_, "a4 = 70 mm", link, other)
    conflict = error.value.conflict
    assert conflict is not None
    assert set(conflict.constraints) == {f"'{text}'" for text in (sum_, link, other)}
    assert "these constraints contradict each other" in str(error.value)
    (name, by), *rest = conflict.stated.items()
    assert not rest
    assert name == f"'{sum_}'"  # or one of the others: alike, and the first
    assert by == pytest.approx((270.5 + 301.9 - 572.05) * 1e-3, abs=1e-9)
    calibrated(sum_, link, "a4 = 70 mm")


def test_names_in_a_script_say_the_same() -> None:
    """`z` and `x` by name, as a statement would have it."""

    def by_hand(z: ro.convex.Unknown, p: ro.convex.Arguments) -> list[cp.Constraint]:
        deviations = p.x
        return [
            270e-3 + deviations["a3"] + 302e-3 + deviations["d4"] <= 572.05e-3,
            z["alpha3"] * p.scale[p.names.index("alpha3")] >= np.radians(-0.05),
        ]

    stated = calibrated("a3 + d4 = 572.00 +- 0.05 mm", "alpha3 >= -0.05 deg")
    mine = replace(ro.tikhonov, constraints=(by_hand,))
    result = ro.calibrate(ro.load("position").problem, mine, weight=1.0)
    assert result.converged
    assert np.max(np.abs(result.z - stated.z)) < 1e-7


def test_predicted_positions_are_those_of_the_result() -> None:
    """Affine in z, about the solution: what the constraint sees there is what the calibrated robot does."""
    q = np.random.default_rng(2).uniform(-1, 1, (3, 6))
    problem = ro.load("position").problem
    lowest = ro.calibrate(problem, ro.tikhonov, weight=1.0).forward(q)[:, 2, 3] + 2e-5
    mine = replace(ro.tikhonov, constraints=(lambda z, p: p.positions(q)[:, 2] >= lowest,))
    result = ro.calibrate(problem, mine, weight=1.0)
    assert result.converged
    assert np.min(result.forward(q)[:, 2, 3] - lowest) == pytest.approx(0, abs=1e-9)


def test_positions_of_several_reflectors_need_a_name() -> None:
    problem = ro.load("markers").problem
    reflector, q = problem.data.blocks[0].markers[0], np.zeros((1, 6))
    for names, accepted in (((), False), ((reflector,), True)):
        mine = replace(ro.tikhonov, constraints=(lambda z, p, names=names: p.positions(q, *names)[0, 2] <= 9,))
        if accepted:
            assert ro.calibrate(problem, mine, weight=1.0).converged
            continue
        with pytest.raises(InputError, match=f"no marker, of . reflectors, accepted: marker = one of {reflector}"):
            ro.calibrate(problem, mine, weight=1.0)


def test_a_name_that_is_none_is_refused() -> None:
    for expression in (lambda z, p: z["a99"] <= 1, lambda z, p: p.x["a99"] <= 1):
        with pytest.raises(InputError, match="a99"):
            ro.calibrate(ro.load("position").problem, replace(ro.tikhonov, constraints=(expression,)), weight=1.0)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("a9 = 1 mm", "'a9'"),
        ("a3 = 1 deg", "unit deg"),
        ("a3 + alpha3 = 1 mm", "a sum of angle and length"),
        ("a3 = alpha3", "a sum of angle and length"),
        ("beta5 = 0 deg", "no identified parameter"),
        ("a? = d?", "patterns a? and d?"),
        ("base_rx = 0 deg", "an angle of a rotated frame"),
        ("move at most 1 mm: nowhere", "place 'nowhere'"),
    ],
)
def test_what_does_not_fit_the_problem_is_refused(text: str, found: str) -> None:
    with pytest.raises(InputError) as error:
        calibrated(text)
    assert found in error.value.found
    assert text in error.value.where or found == "'a9'"


@pytest.mark.parametrize("lower", [2e-4, 3e-3])  # [m], the second far from all that the data allow
def test_a_bound_on_positions_holds_of_the_identified_robot(lower: float) -> None:
    """By its forward kinematics and not to first order: the loop runs again about its solution."""
    problem = ro.load("position").problem
    q = np.random.default_rng(5).uniform(-1, 1, (4, 6))
    highest = ro.calibrate(problem, ro.tikhonov, 1.0).forward(q)[:, 2, 3].max() - lower
    below = replace(ro.tikhonov, constraints=(lambda _, p: p.positions(q)[:, 2] <= highest,))
    result = ro.calibrate(problem, below, 1.0)
    assert result.converged, result.message
    assert result.forward(q)[:, 2, 3].max() == pytest.approx(highest, abs=1e-8)


def test_a_position_that_a_constraint_fixes_has_no_interval() -> None:
    problem, home = ro.load("position").problem, np.zeros((1, 6))
    free = ro.calibrate(problem, ro.tikhonov, 1.0)
    height = free.forward(home)[0, 2, 3] + 2e-5
    fixed = ro.calibrate(
        problem, replace(ro.tikhonov, constraints=(lambda _, p: p.positions(home)[0, 2] == height,)), 1.0
    )
    before, after = (result.predict(home, of="mean").standard[0] for result in (free, fixed))
    assert before[2] > 1e-5
    assert after[2] == pytest.approx(0, abs=1e-9)  # the constraint is linearized to 1e-4 of its own size
    assert (after[:2] > 0.9 * before[:2]).all()  # a height tells nothing about x and y


def moving(text: str, places: dict[str, object]) -> Calibration:
    demand = ro.constraints.parse(text, places)
    return ro.calibrate(ro.load("position").problem, replace(ro.tikhonov, constraints=(demand,)), weight=1.0)


@pytest.mark.parametrize(
    "place",
    [
        [[0, 0], [0]],
        [np.nan] * 6,
        "home",
        {"x": (0, 1)},
        {"x": (0, 1), "y": (1, 0), "z": (0, 1)},
        {"x": (5, 6), "y": (5, 6), "z": (5, 6)},
        [0, 0, 0],
    ],
)
def test_places_that_are_none_are_refused(place: object) -> None:
    with pytest.raises(InputError):
        moving("move at most 1 mm: there", {"there": place})


def test_a_file_keeps_statements_and_their_prices(tmp_path: Path) -> None:
    result = calibrated("a3 + d4 = 572.00 +- 0.05 mm", "move at most 0.3 mm: home")
    ro.store.save_result(result, tmp_path / "result.json")
    again = ro.load_result(tmp_path)
    assert again.formulation.solvable
    for one, other in zip(result.shadow_prices, again.shadow_prices, strict=True):
        assert one.text == other.text
        assert one.multiplier == pytest.approx(other.multiplier, rel=1e-4)
    own = replace(result.formulation, loss=lambda r: cp.sum_squares(1.0 * r))
    script = ro.calibrate(result.problem, own, weight=1.0)
    ro.store.save_result(script, tmp_path / "script.json")
    assert ro.load_result(tmp_path / "script.json").shadow_prices == script.shadow_prices


def test_a_file_keeps_the_places_of_a_statement(tmp_path: Path) -> None:
    """A box in the robot's base stays a box, and joint values stay joint values."""
    demands = tuple(ro.constraints.parse(f"move at most 0.5 mm: {place}", PLACES) for place in PLACES)
    result = calibrated("move at most 0.3 mm: home")
    stated = replace(result, formulation=replace(result.formulation, constraints=demands))
    ro.store.save_result(stated, tmp_path / "result.json")
    assert ro.load_result(tmp_path).formulation.constraints == demands


def test_parameters_that_are_not_identified_are_nominal() -> None:
    """d4 is 302 mm where it is not identified: the sum says all of a3."""
    problem = ro.load("position").problem
    names = [name for name in problem.parameters.free.names if name != "d4"]
    fewer = problem.with_parameters(problem.parameters.identify(names))
    demand = ro.constraints.parse("a3 + d4 = 572.3 mm")
    result = ro.calibrate(fewer, replace(ro.tikhonov, constraints=(demand,)), weight=1.0)
    assert result.robot.mdh[2, 1] == pytest.approx(0.2703, abs=1e-9)


def test_intervals_say_which_parameters_are_held_back() -> None:
    result = calibrated("a3 + d4 = 572.00 +- 0.05 mm", "a2 - 0.5 a3 <= -100 mm")
    assert set(result.actively_constrained) == {"a3", "d4"}
