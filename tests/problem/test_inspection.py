"""Inspection: likely mistakes are found where they were made, and nowhere else."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration import inspect
from rpim_opt.problem.causes.positions import odd_column, other_places
from tests.test_cli import run

CLEAN = ("position", "pose", "markers", "cable", "distance", "mixed", "seven_axis", "tracker", "scara", "paper_arm")


@pytest.mark.parametrize("name", CLEAN)
def test_good_data_raise_no_suspicion(name: str) -> None:
    found = inspect(ro.load(name).problem)
    assert not [text for text in (*found.warnings, *found.judgement) if "better" in text or "?" in text]
    assert "parameter combinations are identifiable" in str(found)


def test_neither_do_poses_and_positions_of_one_reflector() -> None:
    """Half of the rows are without orientations, as an instrument measures that sees the reflector's centre alone."""
    poses = ro.load("pose").problem
    later = ro.Dataset.of(poses.data.q[15:], poses.data.blocks[0].y[15:, :3], 5e-5)
    both = ro.Dataset.together([poses.data.take(np.arange(15)), later], ["poses", "positions"])
    found = inspect(poses.on(both))
    assert found.judgement == ()
    assert "parameter combinations are identifiable" in str(found)


def changed(name: str, q=lambda q: q, y=lambda y: y) -> ro.CalibrationProblem:
    problem = ro.load(name).problem
    blocks = tuple(replace(b, q=q(b.q.copy()), y=y(b.y.copy())) for b in problem.data.blocks)
    return problem.on(replace(problem.data, blocks=blocks))


MISTAKES = {
    "degrees as radians": ("position", {"q": np.degrees}, "degrees, not radians"),
    "millimetres as metres": ("position", {"y": lambda y: 1e3 * y}, "a thousand times smaller"),
    "millimetres as inches": ("position", {"y": lambda y: 25.4 * y}, "or correct the robot file"),
    "lengths in an unknown unit": ("position", {"y": lambda y: 1.37 * y}, "multiply all measured lengths by 0.72"),
    "a column a row too high": (
        "position",
        {"q": lambda q: np.concatenate([np.roll(q[..., :1], -1, axis=0), q[..., 1:]], axis=-1)},
        "move the column of joint 1 one row down",
    ),
    "a frame flipped": ("markers", {"y": lambda y: y * [1, -1, 1]}, "mirrored"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_likely_mistakes_are_named(mistake: str) -> None:
    name, change, expected = MISTAKES[mistake]
    said = inspect(changed(name, **change)).judgement
    assert any(expected in text and "times better" in text for text in said), said


def test_the_row_from_which_on_the_base_stood_elsewhere_is_named() -> None:
    """Not where all rows scatter, and no part of the table fits better than the whole."""
    (said,) = other_places(changed("position", y=lambda y: y + 0.05 * (np.arange(len(y)) >= 20)[:, None]))
    assert said.startswith("from about row c20 on the points fit another base")
    assert "name both parts in a column `session` of the raw table (rpim-opt new registers each), or" in said
    scattered = changed("position", y=lambda y: y + np.random.default_rng(1).normal(0.0, 0.05, y.shape))
    assert list(other_places(scattered)) == []


@pytest.mark.parametrize("moved", [True, False])
@pytest.mark.parametrize("name", ["irb120", "ur10e"])
def test_the_row_from_which_on_a_wire_hung_elsewhere_is_named(name: str, moved: bool) -> None:
    """With the errors of a robot, beside which few errors of one coordinate are small by chance."""
    rng, count = np.random.default_rng(0), 60
    robot = ro.read_robot(name)
    mdh = robot.mdh + rng.normal(size=robot.mdh.shape) * [5e-4, 5e-4, 1e-3, 5e-4, 0.0]
    q = rng.uniform(-2, 2, (count, robot.dof))
    T = ro.robot.forward_kinematics(replace(robot, mdh=mdh), q)
    anchor = np.array([1.5, -0.5, 0.3]) + np.outer(np.arange(count) >= count / 2, [-0.6, 0.6, 0.5]) * moved
    lengths = np.linalg.norm(T[:, :3, 3] + T[:, :3, :3] @ [0.03, -0.04, 0.07] - anchor, axis=1)
    lengths += rng.normal(0.0, 5e-5, count)
    said = list(other_places(ro.problem_from(robot, ro.Dataset.of(q, lengths[:, None], 5e-5, measurement="cable"))))
    remedy = "name the anchor of every row in a column `fixture` of the raw table"
    assert [text.startswith("from about row 31 on the points fit another anchor") for text in said] == [True] * moved
    assert all(remedy in text for text in said)


def test_rows_that_stand_out_are_named() -> None:
    problem = ro.load("position").problem
    block = problem.data.blocks[0]
    y = block.y.copy()
    y[[3, 17]] += [0.05, 0.0, 0.0]
    found = inspect(problem.on(replace(problem.data, blocks=(replace(block, y=y),))))
    assert {row.label for row in found.outliers} == {"c3", "c17"}
    assert "\nExcluded outliers: " in str(found)


def test_repeated_rows_tell_the_repeatability() -> None:
    problem = ro.load("position").problem
    data = problem.data.take(np.repeat(np.arange(20), 3))
    data = replace(data, label=tuple(f"{label}.{i % 3}" for i, label in enumerate(data.label)))
    y = data.blocks[0].y + 2e-5 * np.random.default_rng(1).normal(size=data.blocks[0].y.shape)
    found = inspect(problem.on(replace(data, blocks=(replace(data.blocks[0], y=y),))))
    assert len(found.repeated) == 20
    assert ("c0.0", "c0.1", "c0.2") in found.repeated
    assert found.lack_of_fit.repeated == pytest.approx(3**0.5 * 2e-5, rel=0.2)  # of three coordinates


def test_copied_values_limits_and_coverage() -> None:
    problem = ro.load("position").problem
    block = problem.data.blocks[0]
    q = block.q.copy()
    q[7, 0, 1] = 3.0
    q[:, 0, 4] = 0.3
    there = problem.on(replace(problem.data, blocks=(replace(block, q=q),)))
    y = there.modelled(np.zeros(len(problem.parameters.free)))[0]
    y[5] = y[4]
    warnings = inspect(problem.on(replace(problem.data, blocks=(replace(block, q=q, y=y),)))).warnings
    assert any("rows c4 and c5 have the same measured values" in text for text in warnings)
    assert any(re.match("joint 2 is .* deg, but its limits are", text) for text in warnings)
    assert any("joint 5 moves only 0.00 deg" in text for text in warnings)


def test_columns_without_a_negative_value_are_named() -> None:
    assert list(odd_column(changed("position"))) == []
    assert (
        list(odd_column(changed("position", y=lambda y: y - [0, 0, y[:, 2].min()]))) == []
    )  # z above the lowest point
    assert list(odd_column(changed("position", y=lambda y: np.abs(y - y.mean(axis=0))))) == [
        "no value of columns x, y and z is negative, and some are near zero: were signs lost?"
    ]
    far = changed("position", y=lambda y: np.random.default_rng(1).permutation(y) - y.min(axis=0) + 0.5)
    assert list(odd_column(far)) == []


def test_deviations_of_pixels_are_in_pixels() -> None:
    problem = ro.load("camera").problem
    (block,) = problem.data.blocks
    rows = inspect(problem).content()["measured"]
    assert {row["sigma_px"] for row in rows} == {np.sqrt(np.median(block.covariance[:, 0, 0]))}


def test_parallel_axes_are_proposed() -> None:
    problem = ro.load("position").problem
    without = ro.CalibrationProblem(problem.robot, problem.parameters.identify(["a?", "base_*"]), problem.data)
    assert "the axes 2 and 3 are nearly parallel: add beta2 to `identify`." in inspect(without).warnings
    assert not any("parallel" in text for text in inspect(problem).warnings)


def test_the_command(monkeypatch, capsys) -> None:
    assert run(monkeypatch, "inspect", "rank_deficient") == 0
    out = capsys.readouterr().out
    for part in (
        "joint 6 moves only 0.00 deg",
        "Unidentifiable",
        "Redundant combinations",
        "O1",
        "noise (1 sigma)",
    ):
        assert part in out
