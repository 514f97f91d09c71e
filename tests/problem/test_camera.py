"""Pixels as measurements: projection, starts, what the robot's repeatability does to them, what a board leaves open."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.data.measurements.camera import INTRINSICS, TARGET
from rpim_opt.data.measurements.registry import MEASUREMENTS
from rpim_opt.problem import workspace as sight
from rpim_opt.problem.causes.misreadings import better_interpretation
from rpim_opt.problem.registration.camera import normalized, starting_camera, with_poses

BOARD = ro.data.grid_board(4, 3, 0.05)
POINTS = np.array(list(BOARD.values()))
LENS = dict(zip(INTRINSICS, (910.0, 890.0, 650.0, 470.0, -0.2, 0.06, 1e-3, -8e-4, 0.02), strict=True))
STRETCH = {"board_stretch_x": 2e-3, "board_stretch_y": -1e-3}
FRAMES = {
    "eye_in_hand": ((-0.45, 0.06, 0.0, np.pi, 0.0, 0.1), (0.06, 0.0, 0.04, 0.02, 0.0, 0.3)),
    "eye_to_hand": ((0.1, 0.2, 1.1, -2.0, 0.1, 0.2), (-0.08, -0.06, 0.05, 0.0, 0.1, 0.0)),
}
KINDS = ("eye_in_hand", "eye_to_hand")
SIGMA = 0.1
EVERYTHING = ["alpha?", "a?", "theta?", "d?", "beta[23]", "base_*", "tool_*", "camera_*", "board_*"]


@cache
def world(kind: str, views: int = 12) -> ro.CalibrationProblem:
    """A board of twelve points in sight of a camera with a lens, all identified; pixels as modelled at nominal."""
    robot = ro.load("pose").problem.robot
    base, tool = FRAMES[kind]
    own = {f"camera_{name}": value for name, value in LENS.items()} | STRETCH
    empty = ro.data.views(np.zeros((1, 6)), BOARD, np.zeros((1, 12, 2)), SIGMA, kind)
    parameters = ro.problem.starting_parameters(robot, empty, base, {"": tool}, own).identify(EVERYTHING)
    problem = ro.CalibrationProblem(robot, parameters, empty)
    q = ro.problem.visible_configurations(problem, POINTS, views, seed=3, share=0.6)
    return at(problem, q, np.zeros(len(parameters.free)))


def at(problem: ro.CalibrationProblem, q: np.ndarray, x: np.ndarray) -> ro.CalibrationProblem:
    """Return the problem with what the camera sees at deviations x, without noise."""
    kind = problem.data.blocks[0].measurement.name
    empty = problem.on(ro.data.views(q, BOARD, np.zeros((len(q), 12, 2)), SIGMA, kind))
    uv = empty.modelled(x)[0].reshape(len(q), 12, 2)
    return problem.on(ro.data.views(q, BOARD, uv, SIGMA, kind))


def configurations(problem: ro.CalibrationProblem) -> np.ndarray:
    return problem.data.blocks[0].q[::12, 0]


def seen(kind: str, flange: np.ndarray) -> np.ndarray:
    """Return pixels (P, 2) by matrices of NumPy alone, as the formula of Brown and Conrady is printed."""
    base, tool = (np.eye(4) for _ in range(2))
    for T, numbers in zip((base, tool), FRAMES[kind], strict=True):
        T[:3, :3] = Rotation.from_euler("xyz", numbers[3:]).as_matrix()
        T[:3, 3] = numbers[:3]
    T = base @ flange @ tool
    if kind == "eye_in_hand":
        T = np.linalg.inv(T)
    stretched = POINTS * [1 + STRETCH["board_stretch_x"], 1 + STRETCH["board_stretch_y"], 1]
    X, Y, Z = (T[:3, :3] @ stretched.T) + T[:3, 3:]
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = LENS.values()
    x, y = X / Z, Y / Z
    r = np.hypot(x, y)
    radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
    u = x * radial + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2)
    v = y * radial + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y
    return np.column_stack([fx * u + cx, fy * v + cy])


@pytest.mark.parametrize("kind", KINDS)
def test_projection_is_the_printed_formula(kind: str) -> None:
    problem = world(kind)
    flange = ro.robot.forward_kinematics(problem.robot, configurations(problem))
    expected = np.concatenate([seen(kind, T) for T in flange])
    # pixels of a thousand, rounded to 1e-16 in a dozen operations, divided by depths of which digits cancel
    assert np.abs(problem.data.blocks[0].y - expected).max() < 1e-9


@pytest.mark.parametrize("kind", KINDS)
def test_the_jacobian_is_the_derivative(kind: str) -> None:
    problem = world(kind)
    scale = problem.parameters.free.scale
    x = 0.3 * np.random.default_rng(1).normal(size=len(scale)) * scale
    steps = 1e-5 * np.diag(scale)
    numeric = np.column_stack([(problem.residual(x - h) - problem.residual(x + h)) / 2e-5 for h in steps])
    J = problem.jacobian(x) * scale
    # differences of pixels of 1e3 with rounding 1e-13 over 2e-5, and third derivatives times 1e-10
    assert np.abs(numeric - J).max() < 1e-6 * np.abs(J).max()


@pytest.mark.parametrize("kind", KINDS)
def test_errors_are_pixels_and_the_distances_of_lines_of_sight(kind: str) -> None:
    problem = world(kind)
    block = problem.data.blocks[0]
    moved = problem.on(replace(problem.data, blocks=(replace(block, y=block.y + np.array([3.0, 4.0])),)))
    x = np.zeros(len(problem.parameters.free))
    assert moved.errors(x, "pixel") == pytest.approx(5.0, rel=1e-9)
    # as far as five pixels are apart at a depth of half a metre to a metre: 5 Z / f
    assert (moved.errors(x) > 5 * 0.2 / 900).all()
    assert (moved.errors(x) < 5 * 1.5 / 900).all()
    assert np.isnan(moved.errors(x, "angle")).all()


@pytest.mark.parametrize("flat", [True, False])
def test_a_view_shows_its_pose(flat: bool) -> None:
    rng = np.random.default_rng(4)
    points = POINTS if flat else 0.1 * rng.normal(size=(9, 3))
    for _ in range(50):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(0.5 * rng.normal(size=3)).as_matrix()
        T[:3, 3] = [*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.5, 1.0)]
        there = points @ T[:3, :3].T + T[:3, 3]
        assert ro.problem.view_pose(points, there[:, :2] / there[:, 2:]) == pytest.approx(T, abs=1e-8)


@pytest.mark.parametrize(
    ("points", "found"), [(POINTS[[0, 1, 4]], "3 points"), (POINTS[:4] * [1, 0, 0], "on a line")], ids=["three", "line"]
)
def test_a_view_that_shows_no_pose_is_refused(points: np.ndarray, found: str) -> None:
    with pytest.raises(ro.InputError, match=found):
        ro.problem.view_pose(points, points[:, :2])


def test_distortion_is_taken_back() -> None:
    from rpim_opt.data.measurements.camera import pixels

    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 9), np.linspace(-0.5, 0.5, 7))
    uv = np.column_stack([part.ravel() for part in pixels((x, y, 1.0), LENS)])
    assert normalized(uv, LENS) == pytest.approx(np.column_stack([x.ravel(), y.ravel()]), abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_views_place_base_and_tool_from_nothing(kind: str) -> None:
    problem = world(kind)
    p = problem.parameters
    # the size of the board decides how far away everything is: as in a file, none is known of it
    stretched = [name in STRETCH for name in p.names]
    plain = problem.with_parameters(replace(p, nominal=np.where(stretched, 0.0, p.nominal)))
    exact = at(plain, configurations(problem), np.zeros(len(p.free)))
    own = dict(zip(p.names, exact.parameters.nominal.tolist(), strict=True))
    assert len(with_poses(exact.data, own)) == 12
    start = ro.problem.starting_parameters(exact.robot, exact.data, None, {"": (0.0,) * 6}, own)
    found = exact.with_parameters(start.identify(["a2"]))
    # the tool is expected within 0.1 m of nowhere, which counts as much as a robot that is wrong by 5 mm
    assert found.errors(np.zeros(1), "pixel").max() < 0.2


def test_homographies_show_the_camera() -> None:
    problem = world("eye_in_hand")
    p = problem.parameters
    lens = [name.startswith(("camera_k", "camera_p", "board")) for name in p.names]
    plain = problem.with_parameters(replace(p, nominal=np.where(lens, 0.0, p.nominal)))
    data = at(plain, configurations(problem), np.zeros(len(p.free))).data
    found = starting_camera(data, data.blocks[0])
    assert found == pytest.approx({name: LENS[name] for name in found}, rel=1e-6)
    glimpse = data.take(np.r_[0, 1, 4, 12 : len(data)])  # three points of the first view, which make no homography
    assert starting_camera(glimpse, glimpse.blocks[0]) == pytest.approx(found, rel=1e-6)
    few = data.take(np.arange(24))
    with pytest.raises(ro.InputError, match=r"2 views of a flat board.*\[camera\]"):
        starting_camera(few, few.blocks[0])


def test_repeatability_of_the_robot_moves_a_view_together() -> None:
    problem = world("eye_in_hand", views=12)
    sigma = 1e-4
    shaken = replace(problem, repeatability=ro.problem.Repeatability(position=sigma))
    (stack,) = shaken.stacks(joints=False)
    V = stack.covariance(shaken.repeatability)[0]
    p = problem.parameters
    base = np.array([name in ("base_x", "base_y", "base_z") for name in p.names])
    J = problem.identifying(base).jacobian(np.zeros(3))[stack.index[0]]
    assert pytest.approx(sigma**2 * J @ J.T + SIGMA**2 * np.eye(24), rel=1e-9, abs=1e-12) == V
    # and not point by point: noise of the robot does not average away within a view
    assert np.linalg.matrix_rank(V - SIGMA**2 * np.eye(24), tol=1e-9) == 3


def test_no_view_tells_the_size_of_the_board() -> None:
    """A board and all lengths larger by the same part look the same: that is the robot's drawing to say."""
    problem = world("eye_in_hand")
    p = problem.parameters
    lengths = np.array([dimension == "length" for dimension in p.free.dimensions])
    stretch = np.array([name.startswith("board_stretch") for name in p.free.names])
    x = np.where(lengths, p.free.values(np.zeros(len(p.free))), 0.0)
    x[stretch] = [1 + STRETCH["board_stretch_x"], 1 + STRETCH["board_stretch_y"]]
    J = problem.jacobian(np.zeros(len(x)))
    assert np.abs(J @ x).max() < 1e-6 * np.abs(J[:, lengths] @ x[lengths]).max()
    known = p.identify(["alpha?", "a?", "theta?", "d?", "beta[23]", "base_*", "tool_*"])
    seen_with = ro.problem.observe(problem.with_parameters(known))
    assert "a3" not in seen_with.unidentifiable


def test_corners_that_were_not_found_and_those_that_vary() -> None:
    problem = world("eye_in_hand")
    q = configurations(problem)[:3]
    uv = problem.data.blocks[0].y[:36].reshape(3, 12, 2).copy()
    uv[1, 4] = np.nan
    covariance = np.tile(np.diag([0.04, 0.01]), (3, 12, 1, 1))
    data = ro.data.views(q, BOARD, uv, covariance)
    assert len(data) == 35
    assert "v1/4" not in data.label
    assert data.blocks[0].covariance.shape == (35, 2, 2)
    assert np.bincount(data.configuration).tolist() == [12, 11, 12]
    with pytest.raises(ro.InputError, match="shapes"):
        ro.data.views(q, BOARD, uv[:, :5], SIGMA)
    with pytest.raises(ro.InputError, match="eye_in_hand, eye_to_hand"):
        ro.data.views(q, BOARD, uv, SIGMA, "pose")


@pytest.mark.parametrize("kind", KINDS)
def test_a_table_says_which_point_of_which_board(kind: str) -> None:
    robot = world(kind).robot
    table = {f"q{i}_deg": ["0", "5"] for i in range(1, 7)} | {"u_px": ["1", "2"], "v_px": ["3", "4"]}
    with pytest.raises(ro.InputError, match=r"no column for .target_x. among .*target = .board.csv."):
        ro.read_data(table, robot, {"pixel_px": 0.1}, MEASUREMENTS[kind])
    places = {f"{stem}_mm": ["10", "20"] for stem in TARGET}
    data = ro.read_data(table | places | {"u95_px": ["0.2", "0.4"]}, robot, measurement=MEASUREMENTS[kind])
    assert data.blocks[0].columns["target_x"].tolist() == [0.01, 0.02]
    assert np.sqrt(data.blocks[0].covariance[:, 0, 0]) == pytest.approx([0.1, 0.2])
    with pytest.raises(ro.InputError, match="pixel_px"):
        ro.read_data(table | places, robot, measurement=MEASUREMENTS[kind])


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ({"x_mm": [0]}, "accepted: point, x_mm"),
        ({"point": ["a"], "x_mm": [0]}, "perhaps z_mm"),
        ({"point": ["a", "a"], "x_mm": [0, 1], "y_mm": [0, 1]}, "row 2, column point.*'a'"),
        ({"point": ["a"], "x_mm": [0], "y_mm": [0], "w_mm": [0]}, "column 'w_mm'"),
        ({"point": ["a"], "x_deg": [0], "y_mm": [0]}, "column 'x_deg'"),
        ({"point": ["a"], "x_mm": ["far"], "y_mm": [0]}, "row a, column x_mm"),
    ],
)
def test_a_board_that_is_none_is_refused(table: dict, said: str) -> None:
    with pytest.raises(ro.InputError, match=said):
        ro.data.read_board(table)


@pytest.mark.parametrize("asked", [(1, 5, 0.03), (4, 3, 0.0), (4, 3, np.nan)])
def test_a_grid_that_is_none_is_refused(asked: tuple) -> None:
    with pytest.raises(ro.InputError, match="board"):
        ro.data.grid_board(*asked)


def test_a_board_that_is_never_in_sight_is_said(monkeypatch) -> None:
    problem = world("eye_in_hand")
    away = problem.parameters.nominal.copy()
    away[problem.parameters.names.index("base_x")] = 50.0
    far = problem.with_parameters(replace(problem.parameters, nominal=away))
    monkeypatch.setattr(sight, "TIMES", 2)
    with pytest.raises(ro.InputError, match="0 of 5 views"):
        ro.problem.visible_configurations(far, POINTS, 5)
    with pytest.raises(ro.InputError, match="no row of a camera"):
        ro.problem.visible_configurations(ro.load("pose").problem, POINTS, 5)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        pytest.param(
            lambda b: replace(b, q=b.q * [1, 1, -1, 1, 1, 1]), "write sign = -1 for joint 3", marks=pytest.mark.slow
        ),
        pytest.param(
            lambda b: replace(b, q=b.q[:, :, [0, 2, 1, 3, 4, 5]]),
            "exchange the columns of joints 2 and 3",
            marks=pytest.mark.slow,
        ),
        (lambda b: replace(b, q=np.radians(b.q)), "q1_rad"),
        (lambda b: replace(b, measurement=MEASUREMENTS["eye_to_hand"]), 'measurement = "eye_to_hand"'),
    ],
    ids=["sign", "order", "units", "place"],
)
def test_mistakes_are_found_in_views(change, said: str) -> None:
    problem = ro.load("camera").problem
    wrong = problem.on(replace(problem.data, blocks=(change(problem.data.blocks[0]),)))
    found = better_interpretation(wrong)
    assert found is not None
    assert said in found.remedy
    assert ";" not in found.remedy  # one mistake, and not others that a lens makes plausible


def test_a_reversed_joint_is_found_in_eight_views() -> None:
    problem = ro.load("camera").problem
    data = problem.data.configurations(8, 0)
    turned = replace(data.blocks[0], q=data.blocks[0].q * [1, 1, -1, 1, 1, 1])
    inspection = ro.calibration.inspect(problem.on(replace(data, blocks=(turned,))))
    said = "joint 3 reversed: write sign = -1 for joint 3 in robot.toml."
    assert any(text.endswith(said) for text in [*inspection.warnings, *inspection.judgement])


@pytest.mark.slow
def test_good_views_are_read_as_they_are() -> None:
    assert better_interpretation(ro.load("camera").problem) is None
