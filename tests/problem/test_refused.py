"""What no calibration can be made of is one sentence that names it, before anything is computed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.data import KnownAngle, KnownDistance, touches
from rpim_opt.data.measurements.camera import on_board
from rpim_opt.data.measurements.distance import plane
from rpim_opt.data.measurements.pose import pose, position
from rpim_opt.data.tables.reading import declared_noise
from rpim_opt.problem import configurations_at, partitions
from rpim_opt.problem.registration.camera import starting_camera, with_poses
from rpim_opt.problem.registration.frames import locate
from rpim_opt.problem.workspace import touched_place, within
from rpim_opt.report.console import touched_point
from tests.problem.test_camera import BOARD, LENS, SIGMA, world
from tests.simulate import ARM

Q = np.zeros((4, 6))
PAPER = "paper_arm"


def problem() -> ro.CalibrationProblem:
    return ro.load(PAPER).problem


def few_views(count: int) -> ro.Dataset:
    data = world("eye_in_hand").data
    return data.take(np.flatnonzero(data.configuration < count))


def one_side() -> ro.Dataset:
    """The same view three times."""
    data = world("eye_in_hand").data
    first = data.blocks[0].y[:12].reshape(1, 12, 2)
    q = data.blocks[0].q[:12:12, 0]
    return ro.data.views(np.repeat(q, 3, axis=0), BOARD, np.repeat(first, 3, axis=0), SIGMA, "eye_in_hand")


def own(**changed: float) -> dict[str, float]:
    return {f"camera_{name}": value for name, value in {**LENS, **changed}.items()}


def straight() -> np.ndarray:
    """Motions none of which turns."""
    motions = np.tile(np.eye(4), (5, 1, 1))
    motions[:, :3, 3] = np.random.default_rng(1).normal(size=(5, 3))
    return motions


REFUSED: dict[str, tuple[Callable[[], object], str]] = {
    "a known distance of nothing": (lambda: KnownDistance(("A", "B"), 0.0, 1e-5), "a length greater than zero"),
    "a known distance without a deviation": (lambda: KnownDistance(("A", "B"), 0.3, 0.0), "sigma 0"),
    "an angle between one": (lambda: KnownAngle(("A", "A"), parallel=True, sigma=1e-5), "'A' twice"),
    "touches of fewer names": (lambda: touches(Q, ["A"], 1e-4), "1 names, accepted: 4, one per row"),
    "a point of another board": (
        lambda: on_board({"label": ["first", "second"], "point": ["3", "33"]}, BOARD),
        "row second, column point: found '33', accepted: a point of the target",
    ),
    "the second point of another board": (lambda: on_board({"point": ["3", "33"]}, BOARD), "row 2, column point"),
    "joint values that are no numbers": (lambda: ro.Dataset.of(Q * np.nan, np.zeros((4, 3)), 1e-4), "finite numbers"),
    "transforms as positions": (lambda: ro.Dataset.of(Q, np.zeros((4, 4, 4)), 1e-4), 'state measurement="pose"'),
    "measured values in two columns": (lambda: ro.Dataset.of(Q, np.zeros((4, 2)), 1e-4), "(N, 3) measured values"),
    "torques of other rows": (lambda: ro.Dataset.of(Q, np.zeros((4, 3)), 1e-4, torque=Q[:2]), "shape (2, 6)"),
    "a payload too many": (lambda: ro.Dataset.of(Q, np.zeros((4, 3)), 1e-4, payload=np.ones(5)), "shape (4,)"),
    "a tracker that is a number": (lambda: declared_noise({"tracker": 5}, position), "a table, for positions"),
    "a tracker of distances": (
        lambda: declared_noise({"tracker": {"range_um": 5.0}}, ro.load("distance").problem.data.blocks[0].measurement),
        "a table, for positions and poses",
    ),
    "nothing to identify": (
        lambda: problem().with_parameters(problem().parameters.identify([])), "key identify: found no parameter"
    ),
    "data of another robot": (
        lambda: problem().on(ro.Dataset.of(Q[:, :5], np.zeros((4, 3)), 1e-4)), "5 columns, accepted: 6, one per joint"
    ),
    "a plane that the model does not have": (
        lambda: problem().on(ro.Dataset.of(Q, np.zeros((4, 0)), 1e-4, measurement=plane)), "no parameter 'plane_"
    ),
    "parts of no file": (lambda: partitions([], ARM, {"position_mm": 0.1}), "no file, accepted: at least one"),
    "a base of distances": (
        lambda: locate(ARM, ro.load("distance").problem.data, {"": (0.0,) * 6}), '"auto" without positions or poses'
    ),
    "a box out of reach": (
        lambda: within(ro.load("position").problem, 50.0 + np.eye(3)[:, :2]), "no configuration of the joint ranges"
    ),
    "a point out of reach": (
        lambda: configurations_at(ro.load("position").problem, np.array([[9.0, 0, 0]])), "(9000, 0, 0) mm, out of reach"
    ),
    "a point that is a word": (lambda: touched_point("here"), "point: found 'here'"),
    "a point of two numbers": (lambda: touched_point("1,2"), "x,y,z [mm]"),
    "the middle of what nobody touched": (lambda: touched_place(problem()), "no touch of a point"),
    "a camera without a focal length": (
        lambda: with_poses(few_views(3), own(fx=0.0)), "a focal length of 0 px, accepted: one greater than zero"
    ),
    "views that show three corners": (
        lambda: with_poses(world("eye_in_hand").data.take(np.array([0, 1, 5, 12, 13, 17])), own()),
        "no view that determines a pose",
    ),
    "two views for a focal length": (
        lambda: starting_camera(few_views(2), few_views(2).blocks[0]), "2 views of a flat board"
    ),
    "three views from one side": (
        lambda: starting_camera(one_side(), one_side().blocks[0]), "views that do not determine the focal length"
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_what_cannot_be_used_is_named(what: str) -> None:
    make, said = REFUSED[what]
    with pytest.raises(ro.InputError) as error:
        make()
    assert said in str(error.value)


def test_views_with_few_corners_are_left_out_where_others_show_their_pose() -> None:
    data = few_views(4)
    some = data.take(np.array([i for i in range(len(data)) if data.configuration[i] != 1 or i % 12 < 3]))
    found = with_poses(some, own())
    whole = with_poses(data, own())
    assert len(found) == 3
    assert np.allclose(found.blocks[0].y, whole.blocks[0].y[[0, 2, 3]], atol=1e-9)


def test_poses_about_one_axis_are_located_by_their_places() -> None:
    """Where along the axis a tool is they do not tell: the stated one and registration say where the base is."""
    q = np.zeros((8, 6))
    q[:, 0] = np.random.default_rng(3).uniform(-2, 2, 8)
    flange = ro.robot.forward_kinematics(ARM, q)
    tool = (0.05, 0.0, 0.1, 0.0, 0.0, 0.0)
    turns = Rotation.from_matrix(flange[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    y = np.hstack([flange[:, :3, :3] @ tool[:3] + flange[:, :3, 3], turns])
    base, tools, how = locate(ARM, ro.Dataset.of(q, y, 1e-3**2 * np.eye(6), measurement=pose), {"": tool})
    assert "registration of positions" in how
    assert base == pytest.approx(np.zeros(6), abs=1e-9)
    assert tools[""] == pytest.approx(tool, abs=1e-9)
