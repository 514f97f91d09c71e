"""What is said of touches, rows and units before a calibration, and where there is nothing to say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration.words import contact_remarks
from rpim_opt.problem.causes.positions import other_places, unrelated_rows
from rpim_opt.problem.causes.rows import rounded, rows_without_values, shared_rows
from tests.simulate import simulated


def sockets(names: tuple[str, ...]) -> ro.CalibrationProblem:
    """Return touches of some sockets of a plate, without the stated distances."""
    problem = ro.load("contact").problem
    data = problem.data
    kept = [
        label
        for block in data.blocks
        if block.measurement.touching and block.point is not None
        for label, (point,) in zip(np.array(data.label)[block.row], block.point, strict=True)
        if point in names
    ]
    return problem.without(set(data.label) - set(kept))


def test_the_scale_that_touches_show_is_said() -> None:
    many = " ".join(contact_remarks(sockets(("A", "B", "C", "D"))))
    assert "the mean of all touches of its point" in many
    assert "a [[known_distance]] would determine it." in many
    assert len(contact_remarks(ro.load("contact").problem)) == 1
    assert "the best-fit plane of all touches of its plane" in contact_remarks(ro.load("datum_cube").problem)[0]
    assert contact_remarks(ro.load("position").problem) == []
    assert ro.load("position").problem.touched == ()


def test_rows_of_the_validation_set_that_are_copies_are_named() -> None:
    data = simulated(("theta2",), 12)[0].data
    copied = replace(data.take(np.array([2, 5])), label=("3", "again"))
    (said,) = shared_rows(data, copied)
    assert said.startswith("2 of 2 rows of the validation set are identification rows as well: 3, again (6).")
    assert list(shared_rows(data, None)) == []
    assert list(shared_rows(data, simulated(("theta2",), 12, seed=3)[0].data)) == []


def test_where_no_points_are_measured_nothing_is_suspected() -> None:
    distance = ro.load("distance").problem
    assert list(rounded(distance, 1e-3)) == []
    assert list(other_places(distance)) == []
    few = simulated(("theta2",), 8)[0]
    assert list(other_places(few)) == []


def test_rounded_values_are_named_where_that_explains_the_fit() -> None:
    problem, _ = simulated(("theta2",), 30)
    y = problem.data.blocks[0].y
    q = np.radians(np.degrees(problem.data.q).round(1))
    coarse = problem.on(ro.Dataset.of(q, y, 5e-5))
    assert list(rounded(coarse, 10.0)) == []  # metres are not explained by tenths of a degree
    made = [size for size in np.geomspace(1e-5, 1e-1, 60) if list(rounded(coarse, float(size)))]
    assert made
    assert 1e-4 < np.median(made) < 3e-3
    assert list(rounded(problem, float(np.median(made)))) == []
    (text,) = rounded(problem.on(ro.Dataset.of(problem.data.q, y.round(2), 5e-5)), 4e-3)
    assert text.startswith(
        "measured values are rounded to 10 mm: that alone contributes 5 mm, the residual RMS is 4 mm"
    )


def test_degrees_and_minutes_are_named_also_where_a_model_takes_most_of_them_up() -> None:
    """So many different decimals below .60 are no chance; those of a coarse grid may be."""
    problem = ro.load("position").problem
    whole, part = np.divmod(np.abs(np.degrees(problem.data.q)), 1)

    def says(decimals: np.ndarray, error: float) -> list[str]:
        q = np.radians(np.sign(problem.data.q) * (whole + decimals))
        texts = rounded(problem.on(ro.Dataset.of(q, problem.data.blocks[0].y, 5e-5)), error)
        return [text for text in texts if "degrees and minutes" in text]

    (text,) = says((60 * part).round() % 60 / 100, 3e-3)
    assert "no decimals from .60 on" in text
    assert says((60 * part).round() % 60 / 100, 4e-4)
    assert not says((part * 10).round() % 6 / 10, 4e-4)


def test_values_of_three_digits_are_rounded_to_the_last_of_the_largest() -> None:
    problem, _ = simulated(("theta2",), 30)
    y = np.array([[float(f"{value:.3g}") for value in row] for row in 1e3 * problem.data.blocks[0].y])
    assert np.abs(y).max() >= 1000
    (text,) = rounded(problem.on(ro.Dataset.of(problem.data.q, 1e-3 * y, 5e-5)), 2e-3)
    assert text.startswith("measured values are rounded to 10 mm")


def test_rows_that_do_not_belong_together_are_named() -> None:
    problem, _ = simulated(("theta2",), 30)
    assert list(unrelated_rows(problem, 0.05)) == []
    (text,) = unrelated_rows(problem, 1.0)
    assert "do the rows of the two tables match" in text


def test_travel_of_a_rail_is_reach() -> None:
    robot = ro.robot.Robot("rail", np.zeros((1, 5)), joint_types=("prismatic",))
    q = np.append(np.linspace(0, 0.5, 20), 8.0)[:, None]
    y = [0.1, 0.2, 0.3] + q * [0.0, 0.0, 1.0] + 1e-3 * np.arange(21)[:, None] * [1.0, 2.0, 0.0]
    problem = ro.problem_from(robot, ro.Dataset.of(q, y, 5e-5), ("base_*",), base=np.zeros(6))
    assert list(rows_without_values(problem.data, problem.arms)) == []


def test_round_lengths_of_a_drawing_are_no_rounded_measurements() -> None:
    assert list(rounded(ro.load("datum_cube").problem, 0.03)) == []


def test_readings_of_one_configuration_are_said_to_agree() -> None:
    problem, _ = simulated(("theta2", "tool_x", "base_*"), 12)
    y = problem.data.blocks[0].y
    q = problem.data.q
    again = ro.Dataset.of(np.vstack([q, q[:2]]), np.vstack([y, y[:2] + 1e-4]), 5e-5)
    said = str(ro.calibration.inspect(problem.on(again)))
    assert "Measured more than once in the same configuration: " in said
    assert "Repeated readings of a configuration agree to " in said
    assert "1, 13" in said
    assert "more than once" not in str(ro.calibration.inspect(problem))


def test_several_robots_have_no_positions() -> None:
    left, right = (simulated(("theta2", "tool_x"), 8, seed=seed)[0] for seed in (1, 2))
    both = ro.together(left=left, right=right, shared=("tool_x",))
    near = ro.Formulation(
        "near", penalty=ro.tikhonov.penalty, constraints=ro.constraints.parse("move at most 5 mm: workspace")
    )
    with pytest.raises(ro.InputError, match="2 in one problem"):
        ro.calibrate(both, near, 1.0)
