"""Closed-form starts: exact on exact data, refused with a reason where the data cannot tell."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.data.measurements.registry import MEASUREMENTS
from rpim_opt.problem import register
from rpim_opt.problem.registration.frames import locate
from rpim_opt.robot.kinematics import numeric_frame
from tests.calibration.mistakes import simulated_arm
from tests.simulate import ARM, simulated


def transform(seed: int, size: float = 3.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    T[:3, 3] = size * np.random.default_rng(seed).normal(size=3)
    return T


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("flat", [False, True])
def test_registration_finds_a_motion(seed: int, flat: bool) -> None:
    rng = np.random.default_rng(seed)
    T, p = transform(seed), rng.normal(size=(8, 3))
    p[:, 2] *= not flat
    q = p @ T[:3, :3].T + T[:3, 3]
    assert np.abs(register(p, q) - T).max() < 1e-12


def test_registration_minimizes_the_sum_of_squares() -> None:
    rng = np.random.default_rng(1)
    p, q = rng.normal(size=(6, 3)), rng.normal(size=(6, 3))

    def cost(T: np.ndarray) -> float:
        return float(np.sum((p @ T[:3, :3].T + T[:3, 3] - q) ** 2))

    best = register(p, q)
    assert np.linalg.det(best[:3, :3]) == pytest.approx(1.0)
    for k in range(200):
        near = best.copy()
        near[:3, :3] = Rotation.from_rotvec(1e-3 * rng.normal(size=3)).as_matrix() @ near[:3, :3]
        near[:3, 3] += 1e-3 * rng.normal(size=3) * (k % 2)
        assert cost(near) > cost(best)


def test_mirrored_points_get_a_proper_rotation() -> None:
    p = np.random.default_rng(4).normal(size=(9, 3))
    assert np.linalg.det(register(p, p * [1, 1, -1])[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("points", "found"),
    [
        (np.zeros((2, 3)), "measured positions: found 2"),
        (np.ones((5, 3)), "points on a line, or all in one place"),
        (np.outer(np.arange(5.0), [1.0, 2.0, 3.0]), "points on a line, or all in one place"),
        (np.zeros((4, 2)), "shapes"),
    ],
)
def test_degenerate_points_are_refused(points: np.ndarray, found: str) -> None:
    with pytest.raises(ro.InputError, match=found):
        register(points, points)


@pytest.mark.parametrize("turn", [0.0, np.pi / 2, np.pi])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_base_metres_and_half_a_turn_off_does_not_matter(turn: float, axis: int) -> None:
    problem, _ = simulated(noise=3e-5, seed=3)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(turn * np.eye(3)[axis]).as_matrix()
    T[:3, 3] = [4.0, -3.0, 2.0]
    moved = problem.data.blocks[0].y @ T[:3, :3].T + T[:3, 3]
    near = ro.calibrate(problem, ro.tikhonov, ro.reml)
    far = ro.calibrate(problem.on(ro.Dataset.of(problem.data.q, moved, 5e-5)), ro.tikhonov, ro.reml)
    assert near.converged
    assert far.converged
    # the same robot, up to what a prior of 5 mm on a base that is metres away does
    assert far.errors().mean() == pytest.approx(near.errors().mean(), rel=0.02)


@pytest.mark.parametrize("known", ["base_rz +- 0.5 mrad", "base_rz = 0 +- 0.5 mrad"])
def test_a_known_base_is_not_registered_again_where_a_joint_zero_is_off(known: str) -> None:
    problem, truth = simulated(noise=3e-5, seed=3)
    names = problem.parameters.free.names
    truth = np.where([name.startswith("base_") for name in names], 0.0, truth)
    zero = names.index("theta1")
    truth[zero] = 0.8  # far beyond what registration takes for a start, and exactly a turn of the base
    y = problem.data.blocks[0].y + (problem.residual(np.zeros(len(truth))) - problem.residual(truth)).reshape(-1, 3)
    prior = ro.bayes.Prior.known(known)
    for name in ("base_x +- 0.1 mm", "base_y +- 0.1 mm", "base_z +- 0.1 mm", "base_rx +- 0.5 mrad"):
        prior &= ro.bayes.Prior.known(name)
    result = ro.calibrate(problem.on(ro.Dataset.of(problem.data.q, y, 5e-5)), prior=prior)
    values = result.problem.parameters.by_name(result.x)
    assert result.converged
    assert abs(values["base_rz"]) < 4 * 0.5e-3
    assert values["theta1"] - ARM.mdh[0, 2] == pytest.approx(0.8, abs=0.004)


def test_deviations_of_frames_count_from_their_known_values() -> None:
    """Of a turned base too, whose deviations are rotations about the axes of its parent."""
    problem = simulated_arm("ur5e", count=25)
    found = ro.calibrate(problem)
    values = found.problem.parameters.by_name(found.x)
    places = {"tool_y": ("mm", 1e-3, 0.05), "base_rx": ("mrad", 1e-3, 0.01), "base_ry": ("mrad", 1e-3, 0.01)}
    known = ro.bayes.Prior()
    for name, (unit, si, sigma) in places.items():
        known &= ro.bayes.Prior.known(f"{name} = {values[name] / si + sigma:.4f} +- {sigma} {unit}")
    result = ro.calibrate(problem, prior=known)
    assert result.verdict.delivered
    rows = {row["parameter"]: row for row in result.parameter_rows()}
    for name, (_, si, sigma) in places.items():
        p = result.problem.parameters
        assert p.nominal[p.names.index(name)] == pytest.approx(values[name] + sigma * si, abs=1e-7)
        assert abs(result.x[p.free.names.index(name)]) < 2 * sigma * si
        assert rows[name]["identified"] == pytest.approx(rows[name]["nominal"], abs=0.11)


def test_a_base_nobody_knows_is_registered() -> None:
    instance = ro.load("position")
    p = instance.problem.parameters
    base = [p.nominal[p.names.index(f"base_{c}")] for c in "xyz"]
    # the truth in problem.toml is 1800, -700, 350 mm; registration on the nominal robot is good to its errors
    assert np.abs(np.array(base) - [1.8, -0.7, 0.35]).max() < 5e-3


def test_anchors_and_spheres_are_located_where_none_is_stated(tmp_path) -> None:
    import shutil

    from rpim_opt.store.problem_file import problems_folder

    folder = shutil.copytree(problems_folder() / "sphere", tmp_path / "sphere")
    text = (folder / "problem.toml").read_text()
    start = text.index("[sphere]")
    (folder / "problem.toml").write_text(text[:start] + text[text.index("[simulation]") :])
    p = ro.load(folder).problem.parameters
    found = [p.nominal[p.names.index(f"sphere_{c}")] for c in "xyzr"]
    assert np.abs(np.array(found) - [0.7, 0.15, 0.3, 0.3]).max() < 0.05


@pytest.mark.parametrize("kind", ["position", "pose"])
def test_of_many_markers_one_places_the_base_and_the_others_follow(kind: str) -> None:
    rng = np.random.default_rng(3)
    markers, each, place = 12, 6, [0.4, -0.3, 0.2, 0.1, -0.2, 0.5]
    tools = {f"M{k}": np.array([*rng.uniform(-0.1, 0.1, 3), *rng.uniform(-0.5, 0.5, 3)]) for k in range(markers)}
    q = rng.uniform(-2, 2, (markers * each, ARM.dof))
    table: dict[str, Any] = {"marker": each * list(tools)} | {f"q{j + 1}_rad": q[:, j] for j in range(ARM.dof)}
    held = np.array([numeric_frame(tools[name]) for name in table["marker"]])
    T = numeric_frame(place) @ ro.robot.forward_kinematics(ARM, q) @ held
    y = T[:, :3, 3] + 5e-5 * rng.normal(size=(len(q), 3))
    table |= {f"{axis}_m": y[:, i] for i, axis in enumerate("xyz")}
    noise, known = {"position_mm": 0.05}, 3
    if kind == "pose":
        noise, known = noise | {"orientation_mrad": 0.1}, 6
        xyzw = Rotation.from_matrix(T[:, :3, :3]).as_quat()
        table |= {f"q{axis}": xyzw[:, i] for i, axis in enumerate("xyzw")}
    data = ro.read_data(table, ARM, noise, MEASUREMENTS[kind])
    off = np.array([1e-3, -1e-3, 5e-4, 0, 0, 0])
    stated = {name: tool + off for name, tool in tools.items()}
    base, located, how = locate(ARM, data, stated)
    assert how.partition("; ")[2].startswith("optimum of the registration certified")
    assert base == pytest.approx(place, abs=3e-4)
    for name, tool in tools.items():
        assert located[name][:known] == pytest.approx(tool[:known], abs=3e-4)


def once_each(markers: int, each: int) -> tuple[ro.Dataset, dict[str, np.ndarray]]:
    """Markers that are seen once each, so many in a configuration, and where they are stated."""
    rng = np.random.default_rng(4)
    tools = {f"M{k}": np.array([*rng.uniform(-0.1, 0.1, 3), 0, 0, 0]) for k in range(markers)}
    q = np.repeat(rng.uniform(-2, 2, (markers // each, ARM.dof)), each, axis=0)
    held = np.array([numeric_frame(tool) for tool in tools.values()])
    y = (numeric_frame([0.4, -0.3, 0.2, 0.1, -0.2, 0.5]) @ ro.robot.forward_kinematics(ARM, q) @ held)[:, :3, 3]
    table: dict[str, Any] = {"marker": list(tools)} | {f"q{j + 1}_rad": q[:, j] for j in range(ARM.dof)}
    table |= {f"{axis}_m": y[:, i] for i, axis in enumerate("xyz")}
    return ro.read_data(table, ARM, {"position_mm": 0.05}), tools


def test_where_no_marker_tells_the_base_all_are_fitted() -> None:
    data, tools = once_each(24, 3)
    base, _, how = locate(ARM, data, {name: tool + 0.02 for name, tool in tools.items()})
    assert "; registration of positions: " in how
    assert base == pytest.approx([0.4, -0.3, 0.2, 0.1, -0.2, 0.5], abs=0.02)


@pytest.mark.parametrize(
    ("stated", "said"),
    [
        ({"base": [0, 0, 0]}, r"base: found \[0, 0, 0\], accepted: six finite numbers"),
        ({"base": None}, "base: found None"),
        ({"tool": "flange"}, "tool: found 'flange'"),
        ({"data": 5}, "5 joint values per row, accepted: 6"),
    ],
)
def test_frames_and_joints_that_do_not_fit_are_named(stated, said: str) -> None:
    arm = ro.load("position").problem
    if "data" in stated:
        stated = {"data": ro.Dataset.of(arm.data.q[:, : stated["data"]], np.zeros((len(arm.data), 3)), 1e-4)}
    with pytest.raises(ro.InputError, match=said):
        ro.problem_from(**{"robot": arm.robot, "data": arm.data, **stated})


def test_a_base_may_be_a_transform_and_a_pattern_stand_alone() -> None:
    arm = ro.load("position").problem
    one = ro.problem_from(arm.robot, arm.data, "theta?", base=numeric_frame([1.8, -0.7, 0.35, 0.1, 0.2, 0.3]))
    assert one.parameters.free.names == tuple(f"theta{k}" for k in range(1, 7))
    two = ro.problem_from(arm.robot, arm.data, ["theta?"], base=[1.8, -0.7, 0.35, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(one.parameters.nominal, two.parameters.nominal, atol=1e-12)


def test_of_a_users_type_the_frames_that_it_depends_on_are_identified() -> None:
    """An inclinometer at the flange: its readings have no unit, and depend on no position and no heading."""
    problem = ro.load("position").problem
    tilt = ro.data.Measurement("tilt", model=lambda T: T[2, :2].T, columns={"tx": "", "ty": ""})
    rng = np.random.default_rng(0)
    q = rng.uniform(-2, 2, (60, 6))
    mdh = problem.robot.mdh + 1e-3 * rng.normal(size=problem.robot.mdh.shape) * [1, 0, 1, 0, 0]
    turned = numeric_frame([0, 0, 0, 0.02, -0.01, 0.0]) @ ro.robot.forward_kinematics(
        replace(problem.robot, mdh=mdh), q
    )
    y = (turned @ numeric_frame([0, 0, 0, 0.03, 0.02, -0.04]))[:, 2, :2] + 1e-4 * rng.normal(size=(60, 2))
    problem = ro.problem_from(problem.robot, ro.Dataset.of(q, y, 1e-4, measurement=tilt), base=np.zeros(6))
    frames = {name for name in problem.parameters.free.names if name.startswith(("base", "tool"))}
    assert frames == {"base_rx", "base_ry", "tool_rx", "tool_ry", "tool_rz"}
    result = ro.calibrate(problem)
    assert result.verdict.delivered
    assert np.std(problem.residual(result.x)) < 1.2e-4


def test_a_problem_from_arrays_has_its_frames_where_the_data_put_them() -> None:
    """Else errors and identifiable combinations would be those of a reflector in the flange."""
    arm = ro.load("position").problem
    problem = ro.problem_from(arm.robot, arm.data)
    result = ro.calibrate(problem)
    assert np.array_equal(result.problem.parameters.nominal, problem.parameters.nominal)
    assert np.array_equal(problem.errors(result.x), result.errors())
    assert ro.calibration.inspect(arm).observability.rank == ro.problem.observe(arm).rank


REFLECTORS = {"A": [0.04, 0, 0.03, 0, 0, 0], "B": [0, 0.04, 0.03, 0, 0, 0], "C": [-0.04, 0, 0.05, 0, 0, 0]}


def of_reflectors(marker: list[str]) -> ro.Dataset:
    """Return the rows of three reflectors as arrays, with the names of the reflectors or none."""
    read = ro.load("markers").problem.data
    y = np.empty((len(read), 3))
    for block in read.blocks:
        y[block.row] = block.y
    return ro.Dataset.of(read.q, y, 3e-5, marker=marker)


@pytest.mark.parametrize("tool", [REFLECTORS, None])
def test_several_reflectors_come_from_arrays_in_one_call(tool: dict[str, list[float]] | None) -> None:
    folder = ro.load("markers")
    data = of_reflectors([label[-1] for label in folder.problem.data.label])
    problem = ro.problem_from(folder.problem.robot, data, tool=tool)
    assert set(problem.parameters.free.names) == set(folder.problem.parameters.free.names)
    assert len(set(data.configuration)) == 25
    error, same = (ro.calibrate(each).errors(folder.validation).mean() for each in (problem, folder.problem))
    assert error == pytest.approx(same, rel=0.02)


def test_reflectors_that_have_no_name_or_no_start_are_named() -> None:
    robot = ro.load("markers").problem.robot
    warned = ro.calibration.inspect(ro.problem_from(robot, of_reflectors([]))).judgement
    assert any("are they of several reflectors?" in text for text in warned), warned
    data = of_reflectors(["A", "B", "C"] * 25)
    with pytest.raises(ro.InputError, match=r"found 'C', accepted: .* \(\[tool.C\]\): 'A', 'B'\."):
        ro.problem_from(robot, data, tool={name: REFLECTORS[name] for name in "AB"})
    with pytest.raises(ro.InputError, match="marker: found 2 names, accepted: 75, one per row"):
        of_reflectors(["A", "B"])
    with pytest.raises(ro.InputError, match=r"found pattern 'auto', accepted: names, or patterns such as"):
        ro.load("markers").problem.parameters.identify("auto")


def test_two_points_of_a_row_and_anchors_have_names_from_arrays() -> None:
    bar = ro.Dataset.of(
        np.zeros((3, 2, 6)), [[0.1]] * 3, 1e-5, measurement="distance", marker=[["A", "B"], ["B", "C"], ["A", "B"]]
    )
    assert [(block.markers, block.row.tolist()) for block in bar.blocks] == [(("A", "B"), [0, 2]), (("B", "C"), [1])]
    wire = ro.Dataset.of(np.zeros((2, 6)), [[0.1]] * 2, 1e-5, measurement="cable", fixture=["left", "right"])
    assert [block.fixture for block in wire.blocks] == ["left", "right"]


def test_a_problem_from_an_array_alone_says_what_a_robot_is() -> None:
    problem = ro.load("position").problem
    table: Any = problem.robot.mdh
    with pytest.raises(ro.InputError, match=r"robot: found ndarray, accepted: a Robot, such as ro.robot.Robot\("):
        ro.problem_from(table, problem.data)
    named: Any = "m40.csv"
    with pytest.raises(ro.InputError, match=r"data: found 'm40.csv', accepted: a Dataset: ro.read_data\(table, robot"):
        ro.problem_from("ur5e", named)


def test_the_base_is_identified_where_values_of_a_users_own_type_depend_on_it() -> None:
    """No closed form registers it: it begins at zero, 1.9 m and 109 degrees away."""

    def seen(T: ca.SX, h: ca.SX) -> ca.SX:
        return ca.vertcat(ca.norm_2(T[:3, 3] - ca.vertcat(0, 0, h)), ca.atan2(T[1, 3], T[0, 3]))

    station = ro.data.Measurement(
        "station",
        model=seen,
        columns={"range": "length", "bearing": "angle"},
        noise={"range": "length", "bearing": "angle"},
        parameters={"h": "length"},
    )
    arm = ro.load("position").problem
    names = arm.parameters.names
    tool = [arm.parameters.nominal[names.index(f"tool_{axis}")] for axis in ("x", "y", "z", "rx", "ry", "rz")]
    x, y, z = arm.data.blocks[0].y.T
    values = np.column_stack([np.sqrt(x**2 + y**2 + z**2), np.arctan2(y, x)])
    half = np.arange(len(x)) % 3 > 0
    of = partial(ro.Dataset.of, sigma=5e-5, measurement=station)
    result = ro.calibrate(ro.problem_from(arm.robot, of(arm.data.q[half], values[half]), tool=tool))
    free = result.problem.parameters.free
    base = [free.nominal[i] + result.x[i] for i, name in enumerate(free.names) if name.startswith("base_")]
    placed = ro.calibrate(arm).problem.parameters.free
    there = [placed.nominal[placed.names.index(f"base_{axis}")] for axis in "xy"]
    np.testing.assert_allclose(base[:2], there, atol=5e-3)  # z and h are the same
    rest = result.errors(of(arm.data.q[~half], values[~half]))
    assert float(np.sqrt(np.mean(rest**2))) < 1e-3
