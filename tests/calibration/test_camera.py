"""Calibration by a camera: truth within the intervals, and what is said when views do not improve a robot."""

from __future__ import annotations

import re
import shutil
import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics.units import split_unit
from rpim_opt.calibration.words import camera_remarks
from rpim_opt.report import write_report
from rpim_opt.report.summary import summary
from rpim_opt.store import problems_folder
from rpim_opt.study.studies import load_study

STUDY = load_study(Path(__file__).parents[2] / "studies" / "camera.py")
FOLDER = problems_folder() / "camera"


@cache
def calibrated() -> tuple[ro.store.Instance, ro.calibration.Calibration]:
    instance = ro.load("camera")
    return instance, instance.calibrate()


@pytest.mark.slow
def test_what_views_see_is_within_its_intervals() -> None:
    """The lens, what a link is long, positions elsewhere: of 20 numbers one may lie outside 95 %, and none far."""
    instance, result = calibrated()
    assert result.converged
    stated = tomllib.loads((FOLDER / "truth.toml").read_text())["deviation"]
    truth = {}
    for key, value in stated.items():
        stem, unit = split_unit(key)
        truth[stem] = value * (unit.si if unit else 1.0)
    free = result.problem.parameters.free
    seen = [name for name in free.names if name.startswith(("camera_", "a3", "a4", "a5", "alpha4", "alpha5", "theta3"))]
    assert len(seen) > 12
    k = [free.names.index(name) for name in seen]
    sigmas = (result.x - [truth[name] for name in free.names])[k] / np.sqrt(np.diag(result.covariance))[k]
    assert np.abs(sigmas).max() < 4
    assert np.mean(np.abs(sigmas) < 2) > 0.8
    # a tenth of a pixel of noise in, and as much out, though the nominal robot is off by twenty times that
    assert np.sqrt(np.mean(result.errors(dimension="pixel") ** 2)) == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
    assert result.errors(instance.validation, "pixel").max() < 0.5
    found = ro.use.validate(result, instance.validation)
    assert found.beyond == ()


def test_a_result_tells_reprojection_from_positions() -> None:
    instance, result = calibrated()
    said = " ".join(camera_remarks(result))
    assert "px before" in said
    assert "do not improve" not in said
    assert "board_stretch_x" in said
    found = ro.calibration.improvement(result)
    assert found is not None
    assert found.improves
    world = STUDY._shape(instance.problem, result.x, np.zeros_like(result.x))
    assert found.before == pytest.approx(world, rel=0.2)


def test_a_board_of_another_size_is_refused(tmp_path: Path) -> None:
    """Its squares are stated 1 % too large, and so all links become; with the right ones nothing is said."""
    folder = shutil.copytree(FOLDER, tmp_path / "camera")
    problem = (folder / "problem.toml").read_text()
    (folder / "problem.toml").write_text(problem.replace("spacing_mm = 40 ", "spacing_mm = 40.4 "))
    instance = ro.load(folder)
    verdict = ro.calibrate(instance.problem, "tikhonov", weight="learned").verdict
    assert not verdict.delivered
    stretch = re.match(r"Lengths of the robot deviate by \+(0\.\d+) % in common", verdict.reasons[0])
    assert stretch
    assert 0.7 < float(stretch[1]) < 1.3
    assert not calibrated()[1].verdict.caution


@pytest.mark.slow
def test_views_that_do_not_improve_a_robot_say_so() -> None:
    """A good robot and a camera that shakes: positions become many times worse than the drawing's, and it is said."""
    found = STUDY.run("shaking", "known", 1000)
    for method in STUDY.METHODS:
        assert found[f"{method}: as identified"] > 2 * found[f"{method}: as drawn"]
        assert not found[f"{method}: improves"]
        # said from the identification data alone, and within a small factor of what it is
        assert 0.4 < found[f"{method}: expected"] / found[f"{method}: as identified"] < 4


@pytest.mark.slow
def test_the_sentence_is_in_the_output(tmp_path: Path) -> None:
    rng = np.random.default_rng([1000, 19])
    problem, truth = STUDY._world("on the flange", True, rng, STUDY.GOOD)
    data, _ = STUDY._views(problem, truth, rng, STUDY.SHAKE)
    result = ro.calibrate(problem.on(data), ro.tikhonov, 1e-3)
    assert "These views do not improve this robot" in " ".join(camera_remarks(result))
    assert any("These views do not improve this robot" in line for line in summary(result, {})["remarks"])
    write_report(result, tmp_path / "report.html")
    assert "These views do not improve this robot" in (tmp_path / "report.html").read_text()


def boards_in_two_places(shared: list[str]) -> ro.CalibrationProblem:
    """Return the same views in halves, of which the second shows a board that stands 30 mm further along x."""
    problem = replace(calibrated()[1].problem, repeatability=None)
    rng = np.random.default_rng(4)
    second = problem.data.configuration > np.median(problem.data.configuration)
    parts = {}
    for name, rows, shift in (("table", ~second, 0.0), ("wall", second, 0.03)):
        part = problem.on(problem.data.take(np.flatnonzero(rows)))
        x = calibrated()[1].x.copy()
        x[problem.parameters.free.names.index("base_x")] += shift
        (block,) = part.data.blocks
        seen = replace(block, y=part.modelled(x)[0] + 0.1 * rng.normal(size=block.y.shape))
        parts[name] = part.on(replace(part.data, blocks=(seen,)))
    return ro.together(**parts, shared=shared)


def test_boards_in_two_places_are_one_calibration() -> None:
    """Two problems that share all but the base."""
    names = calibrated()[1].problem.parameters.names
    found = ro.calibrate(boards_in_two_places([name for name in names if not name.startswith("base_")]))
    assert found.converged
    free = found.problem.parameters.free
    k = [free.names.index(f"{place}.base_x") for place in ("table", "wall")]
    apart = np.diff((free.nominal + found.x)[k])[0]
    sd = np.sqrt(np.array([-1, 1]) @ found.covariance[np.ix_(k, k)] @ [-1, 1])
    assert sd < 1e-3
    assert abs(apart - 0.03) < 4 * sd
    assert ro.calibration.improvement(found) is None


@pytest.mark.slow
@pytest.mark.parametrize("known", ["known", "unknown"])
@pytest.mark.parametrize("place", STUDY.PLACES)
def test_intervals_hold(place: str, known: str) -> None:
    """Of positions elsewhere, and of directions that views see, on robots that nothing was tuned to."""
    found = [STUDY.run(place, known, 500 + seed) for seed in range(20)]
    assert all(row["converged"] and row["learned: improves"] and row["learned: did improve"] for row in found)
    assert 0.92 < np.mean([row["directions held"] for row in found]) < 0.99
    # the 60 coordinates of a robot err together: of the study's 125 robots of a kind the share spreads by 7 to 11 %
    # about 94 to 96 %, so the mean of 20 by 1.5 to 2.4 %: one in a thousand is below 0.86 to 0.90, or above 0.99
    assert np.mean([row["positions held"] for row in found]) > 0.87


def copied(folder: Path, **changed: str) -> Path:
    """Copy the problem's folder, with words of its file changed."""
    for file in ("identification.csv", "validation.csv"):
        (folder / file).write_text((FOLDER / file).read_text())
    text = (FOLDER / "problem.toml").read_text()
    for word, other in changed.items():
        assert word in text
        text = text.replace(word, other)
    (folder / "problem.toml").write_text(text)
    return folder


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ("", "column for 'target_x'.*the target's points: target = "),
        ('target = "board.csv"', "board.csv"),
        ('target = "../board.csv"', "key target"),
        ("target = { columns = 5, rows = 1, spacing_mm = 40 }", "two to 300 along either side"),
        ("target = { columns = 59223372036854775808, rows = 4, spacing_mm = 40 }", "two to 300 along either side"),
        ("target = { columns = 5, rows = 4 }", "spacing"),
        ("target = { columns = 4, rows = 4, spacing_mm = 40 }", "column point.*'16'"),
    ],
)
def test_a_target_that_is_none_is_refused(target: str, said: str, tmp_path: Path) -> None:
    stated = next(line for line in (FOLDER / "problem.toml").read_text().splitlines() if line.startswith("target"))
    with pytest.raises(ro.InputError, match=said):
        ro.load(copied(tmp_path, **{stated: target}))


def test_a_board_may_come_from_a_table(tmp_path: Path) -> None:
    stated = next(line for line in (FOLDER / "problem.toml").read_text().splitlines() if line.startswith("target"))
    board = ro.data.grid_board(5, 4, 0.04)
    rows = [f"{name},{1e3 * x:.9g},{1e3 * y:.9g}" for name, (x, y, _) in board.items()]
    (tmp_path / "board.csv").write_text("\n".join(["point,x_mm,y_mm", *rows]))
    found = ro.load(copied(tmp_path, **{stated: 'target = "board.csv"'}))
    x = np.zeros(len(found.problem.parameters.free))
    assert found.problem.residual(x) == pytest.approx(ro.load("camera").problem.residual(x), abs=1e-9)
    assert "board.csv" in found.record.files


def test_results_keep_what_a_camera_saw(tmp_path: Path) -> None:
    """A result's file has the board: new corners that name its points are validated without it."""
    _, result = calibrated()
    ro.store.save_result(result, tmp_path / "result.json")
    again = ro.load_result(tmp_path / "result.json")
    data, left_out, *_ = ro.use.read_measurements(again, FOLDER / "validation.csv")
    assert left_out == ()
    assert again.errors(data, "pixel") == pytest.approx(result.errors(result.record.validation, "pixel"), abs=1e-9)


@pytest.mark.parametrize("place", STUDY.PLACES)
def test_new_makes_a_folder_from_corners(place: str, tmp_path: Path) -> None:
    rng = np.random.default_rng([7, 19])
    problem, truth = STUDY._world(place, False, rng)
    data, _ = STUDY._views(problem, truth, rng)
    block = data.blocks[0]
    head = ["point", *(f"J{i} [deg]" for i in range(1, 7)), "u", "v"]
    cells = np.column_stack([np.degrees(block.q[:, 0]), block.y])
    rows = [",".join([name, *map(repr, row)]) for name, row in zip(block.point[:, 0], cells.tolist(), strict=True)]
    (tmp_path / "corners.csv").write_text("\n".join([",".join(head), *rows]))
    with pytest.raises(ro.InputError, match="target: found"):
        ro.store.new_problem(tmp_path / "cell", "ur5e", tmp_path / "corners.csv")
    made = ro.store.new_problem(tmp_path / "cell", "ur5e", tmp_path / "corners.csv", hold_out=0.2, target="5x4,40mm")
    assert made.understood.content()["measurement"] == STUDY.PLACES[place][0]
    assert f"Measurement {STUDY.PLACES[place][0]}: guessed" in str(made)
    instance = ro.load(tmp_path / "cell")
    assert instance.problem.data.blocks[0].measurement.name == STUDY.PLACES[place][0]
    assert {"camera_fx", "camera_k1", "base_rz", "tool_rx"} <= set(instance.problem.parameters.free.names)
    result = instance.calibrate(model="geometry")
    assert result.converged
    assert np.sqrt(np.mean(result.errors(instance.validation, "pixel") ** 2)) < 0.3


@pytest.mark.parametrize("target", ["board", "7x5", "1x5,30mm", "nowhere.csv"])
def test_new_refuses_boards_that_are_none(target: str, tmp_path: Path) -> None:
    with pytest.raises(ro.InputError, match=r"target|board|nowhere"):
        ro.store.new_problem(tmp_path / "cell", "ur5e", FOLDER / "identification.csv", target=target)
    assert not (tmp_path / "cell").exists()


@pytest.mark.slow
def test_two_cameras_on_the_flange_are_told_apart(tmp_path: Path) -> None:
    """A column marker names the camera's frame, a column fixture its intrinsics; both start from the views alone."""
    rng = np.random.default_rng(3)
    rows = []
    truth = {"A": (900.0, 0.06), "B": (700.0, -0.05)}
    for name, (f, x) in truth.items():
        camera = {"camera_fx": f, "camera_fy": f, "camera_cx": 640.0, "camera_cy": 480.0}
        empty = ro.data.views(np.zeros((1, 6)), STUDY.BOARD, np.zeros((1, 20, 2)), 0.1)
        robot = STUDY._robot()
        base = STUDY.PLACES["on the flange"][1]
        p = ro.problem.starting_parameters(robot, empty, base, {"": (x, 0, 0.04, 0, 0, 0)}, camera).identify(["a2"])
        problem = ro.CalibrationProblem(robot, p, empty)
        q = ro.problem.visible_configurations(problem, np.array(list(STUDY.BOARD.values())), 12, rng, share=0.6)
        seen = problem.on(ro.data.views(q, STUDY.BOARD, np.zeros((12, 20, 2)), 0.1))
        cells = np.column_stack([np.degrees(seen.data.blocks[0].q[:, 0]), seen.modelled(np.array([4e-4]))[0]])
        points = seen.data.blocks[0].point[:, 0]
        rows += [",".join([name, name, point, *map(repr, c)]) for point, c in zip(points, cells.tolist(), strict=True)]
    head = ["marker", "fixture", "point", *(f"q{i}_deg" for i in range(1, 7)), "u_px", "v_px"]
    (tmp_path / "corners.csv").write_text("\n".join([",".join(head), *rows]))
    (tmp_path / "problem.toml").write_text(
        'title = "two"\nrobot = "ur5e"\nmeasurement = "eye_in_hand"\nidentification = "corners.csv"\nbase = "auto"\n'
        'identify = ["a2", "base_*", "tool_*", "camera_*_f?", "camera_*_c?", "board_*"]\n'
        "target = { columns = 5, rows = 4, spacing_mm = 40 }\nnoise.pixel_px = 0.1\n"
        "scale.board_A_stretch_x_ppm = 10\nscale.length_mm = 1\ntool.A.x_mm = 0\ntool.B.x_mm = 0\n"
    )
    result = ro.load(tmp_path).calibrate(weight=1e-6)
    free = result.problem.parameters.free
    values = dict(zip(free.names, free.values(result.x), strict=True))
    # no noise: what is left is what so small a weight holds back
    for name, (f, x) in truth.items():
        assert values[f"camera_{name}_fx"] == pytest.approx(f, abs=0.1)
        assert values[f"tool_{name}_x"] == pytest.approx(x, abs=1e-4)
    assert result.errors(dimension="pixel").max() < 0.01


CAMERA_INFO = """image_width: 640   # pixels
image_height: 480
camera_name: head
camera_matrix:
  rows: 3
  cols: 3
  data: [500.0, 0., 320., 0., 510., 240., 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0, 0, 0, 0, 0]
projection_matrix:
  rows: 3
  cols: 4
  data: [400., 0., 310., 0.,
         0., 408., 236., 0., 0., 0., 1., 0.]
"""


def test_a_camera_goes_into_the_file_that_ros_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = ro.load("camera").calibrate(weight=1.0)
    Path("camera.yaml").write_text(CAMERA_INFO)
    ro.use.export_files(result, Path("better.yaml"), camera_info=Path("camera.yaml"), despite_verdict=True)
    rows = [
        re.findall(r"[-\d.e]+", data) for data in re.findall(r"data: \[([^\]]*)\]", Path("better.yaml").read_text())
    ]
    matrix, distortion, projection = (np.array(numbers, dtype=float) for numbers in rows)
    p = result.problem.parameters
    values = dict(zip(p.names, p.nominal, strict=True))
    for name, x in zip(p.free.names, result.x, strict=True):
        values[name] += x
    fx, fy, cx, cy, *of = (values[f"camera_{name}"] for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"))
    assert matrix.tolist() == pytest.approx([fx, 0, cx, 0, fy, cy, 0, 0, 1])
    assert distortion.tolist() == pytest.approx(of)
    assert projection[[0, 2, 5, 6]].tolist() == pytest.approx([0.8 * fx, cx - 10, 0.8 * fy, cy - 4])
    assert "\nimage_width: 640   # pixels\nimage_height: 480\n" in Path("better.yaml").read_text()
    Path("camera.yaml").write_text(CAMERA_INFO.replace("data: [0, 0, 0, 0, 0]", "data: [0, 0, 0, 0]"))
    with pytest.raises(ro.InputError, match="key distortion_coefficients: found 4 numbers"):
        ro.use.export_files(result, Path("b.yaml"), camera_info=Path("camera.yaml"), despite_verdict=True)
    plain = ro.calibrate("position", weight=1.0)
    with pytest.raises(ro.InputError, match="the calibration: found 0 cameras"):
        ro.use.export_files(plain, Path("b.yaml"), camera_info=Path("camera.yaml"))
