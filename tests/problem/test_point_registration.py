"""How badly points fit a robot when base and reflectors are placed anew: known motions come back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.problem import LinearModel
from rpim_opt.problem.registration.points import FEWEST_ROWS, Points, fit_points, misfit, points_of
from tests.simulate import ARM

TOOLS = np.array([[0.05, -0.02, 0.1], [-0.04, 0.06, 0.08]])
BASE = np.eye(4)
BASE[:3, :3] = Rotation.from_rotvec([0.3, -0.5, 2.0]).as_matrix()
BASE[:3, 3] = [1.0, -2.0, 0.4]


def measured(count: int = 24, moved: float = 0.0, seed: int = 0) -> Points:
    """Return points of two reflectors that an instrument sees exactly; they are stated at most `moved` away [m]."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(-2, 2, (count, 6))
    marker = np.arange(count) % 2
    flange = BASE @ ro.robot.forward_kinematics(ARM, q)
    y = np.einsum("nij,nj->ni", flange[:, :3, :3], TOOLS[marker]) + flange[:, :3, 3]
    return Points(ARM, q, y, marker, TOOLS + moved * rng.uniform(-1, 1, (2, 3)), None, np.arange(count))


def test_a_reflector_is_where_it_is_stated_unless_that_is_beyond_any_arm() -> None:
    """A fit to a robot whose file is in millimetres had put it a hundred metres from the flange, and kept it there."""
    problem = ro.load("position").problem
    for factor, tool in ((1.0, 0.09), (1e3, 90.0), (1.0, 90.0)):
        nominal = problem.parameters.nominal.copy()
        nominal[problem.parameters.frame("tool_")[:3]] = 0.0, 0.0, tool
        parameters = replace(problem.parameters, nominal=nominal)
        robot = replace(problem.robot, mdh=problem.robot.mdh * [1, factor, 1, factor, 1])
        points = points_of(replace(problem, robots=robot, parameters=parameters))
        assert points is not None
        assert points.tools[0, 2] == (tool if tool < 1 else 0.0)


@pytest.mark.parametrize("moved", [0.0, 0.003])
def test_base_and_reflectors_come_back(moved: float) -> None:
    points = measured(moved=moved)
    found = fit_points(points)
    assert found.error.max() < 1e-4 * (moved > 0) + 1e-7
    assert found.base == pytest.approx(BASE, abs=1e-4 * (moved > 0) + 1e-7)
    assert found.tools == pytest.approx(TOOLS, abs=1e-4 * (moved > 0) + 1e-7)
    assert found.modelled == pytest.approx(points.y, abs=1e-4)


def test_blunders_stand_out_and_move_nothing() -> None:
    points = measured(40)
    y = points.y.copy()
    y[[4, 17, 30]] += [0.3, -0.4, 0.2]
    found = fit_points(replace(points, y=y))
    far = np.linalg.norm([0.3, -0.4, 0.2])
    assert found.error[[4, 17, 30]] == pytest.approx(far, abs=1e-3)
    assert np.delete(found.error, [4, 17, 30]).max() < 1e-3
    assert misfit(replace(points, y=y)) < 1e-3


def test_the_misfit_is_of_the_best_three_quarters_over_the_extent() -> None:
    points = measured(30)
    noisy = replace(points, y=points.y + 1e-3 * np.random.default_rng(2).normal(size=(30, 3)))
    error = np.sort(fit_points(noisy).error)[: int(np.ceil(0.75 * 30))]
    extent = np.linalg.norm(np.std(noisy.y, axis=0))
    assert misfit(noisy) == pytest.approx(np.sqrt(np.mean(error**2)) / extent, rel=1e-9)


def test_orientations_count_by_the_tips_of_their_axes() -> None:
    problem = ro.load("pose").problem
    points = points_of(problem)
    assert points is not None
    assert points.turns is not None
    assert misfit(points) < 0.01  # of a nominal robot
    back = replace(points, turns=np.swapaxes(points.turns, 1, 2))
    assert misfit(back) > 0.1


def test_only_poses_of_one_reflector_have_orientations() -> None:
    has = {}
    for name in ("pose", "position", "markers", "mixed"):
        points = points_of(ro.load(name).problem)
        assert points is not None
        has[name] = points.turns is not None
        assert points.y.shape == (len(points.row), 3)
    assert has == {"pose": True, "position": False, "markers": False, "mixed": False}
    assert points_of(ro.load("distance").problem) is None


def test_a_few_rows_are_too_few_and_many_are_taken_evenly() -> None:
    problem = ro.load("position").problem
    few = [problem.on(problem.data.take(np.arange(count))) for count in (FEWEST_ROWS - 1, FEWEST_ROWS)]
    assert points_of(few[0]) is None
    enough = points_of(few[1])
    assert enough is not None
    assert enough.row.tolist() == list(range(FEWEST_ROWS))
    every = points_of(problem)
    assert every is not None
    some = every.evenly(14)
    assert some.row.tolist() == [3 * k for k in range(14)]
    assert some.y == pytest.approx(problem.data.blocks[0].y[::3])


def test_directions_that_only_rounding_sees_have_no_rank() -> None:
    def of(A: Array) -> LinearModel:
        model = ro.load("position").problem.linearize(np.zeros(34))
        return LinearModel(A, np.ones(len(A)), np.arange(len(A)), model.parameters)

    rows = np.random.default_rng(6).normal(size=(8, 2))
    tiny = np.column_stack([rows[:, 0], rows[:, 0] + 1e-15 * rows[:, 1]])
    assert [of(rows).rank, of(tiny).rank] == [2, 1]
    assert of(1e-9 * rows).rank == 2
