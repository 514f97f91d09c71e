"""Files of instruments, controllers and drivers become the clean table's problem through the command line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.basics.files import read_toml
from rpim_opt.robot import write_robot
from tests.simulate import ARM
from tests.store.fresh_files import FRESH
from tests.store.instrument_files import INSTRUMENTS, REFUSED_THOUGH_RIGHT, RPY, STRANGERS, krl
from tests.store.raw_files import (
    HEAD,
    JOINTS,
    LABELS,
    NAMED,
    POINTS,
    RAW,
    ROWS,
    P,
    Q,
    Rows,
    T,
    beside,
    book,
    cells,
    text,
)
from tests.test_cli import run

NOT_READ = {"DMIS output"}
"""Formats without a reader."""
FILES = {
    **REFUSED_THOUGH_RIGHT,
    **STRANGERS,
    **FRESH,
    **{name: shape for name, shape in INSTRUMENTS.items() if name not in NOT_READ},
}


@pytest.fixture
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_robot(ARM, "robot.toml")
    return tmp_path


def new(patch: pytest.MonkeyPatch, *files: str, **options: str) -> int:
    data = [part for file in files for part in ("--data", file)]
    stated = [part for name, value in options.items() for part in (f"--{name}", value)]
    return run(patch, "new", "cell", "--robot", "robot.toml", *data, *stated)


@pytest.mark.parametrize("name", FILES)
def test_a_file_as_it_is_exported_is_the_clean_table(monkeypatch, capsys, empty, name) -> None:
    write, options, kind = FILES[name]
    files = write(empty)
    paths = [path.name for path in (files if isinstance(files, list) else [files])]
    assert new(monkeypatch, *paths, **options) == 0, capsys.readouterr().err
    assert_clean(ro.load("cell").problem.data, kind)


def assert_clean(data: ro.Dataset, kind: str) -> None:
    """Compare with the clean table: rows in any order, numbers to the last digit that a file has of them."""
    (block,) = data.blocks
    labels = [label.upper() for label in data.label]
    order = [LABELS.index(label) for label in labels] if set(labels) <= set(LABELS) else list(range(len(Q)))
    assert block.measurement.name == kind
    assert len(order) == len(Q)
    assert np.abs(np.degrees(block.q[:, 0]) - Q[order]).max() < 1e-6
    assert np.abs(1e3 * block.y[:, :3] - P[order]).max() < 2e-4
    if kind == "pose":
        turned = Rotation.from_quat(block.y[:, [4, 5, 6, 3]]).as_matrix()
        assert np.abs(turned - T[order][:, :3, :3]).max() < 1e-8


@pytest.fixture(scope="module")
def calibrated() -> dict[str, ro.Calibration]:
    """Calibrations of the arm with positions and with poses, which read further ones."""
    parameters = ro.robot.model_parameters(ARM).identify(["theta?"])
    poses = ro.robot.forward_kinematics(ARM, np.radians(Q))
    results = {}
    for kind, y in (("position", poses[:, :3, 3]), ("pose", poses)):
        data = ro.Dataset.of(np.radians(Q), y, 1e-4, measurement=kind)
        results[kind] = ro.calibrate(ro.CalibrationProblem(ARM, parameters, data), weight=1.0)
    return results


@pytest.mark.parametrize("name", [*RAW, *FILES])
def test_new_measurements_are_read_as_the_clean_table(tmp_path, calibrated, name) -> None:
    write, stated, kind = RAW.get(name) or FILES[name]
    options = {"within" if key == "time-tolerance" else key: text for key, text in stated.items()}
    stated = ro.data.TableOptions.stated(options)
    assert_clean(ro.use.read_measurements(calibrated[kind], write(tmp_path), options=stated).data, kind)


def test_an_order_found_for_numbered_columns_leaves_names_of_other_tables(monkeypatch, empty, calibrated) -> None:
    write, _, _ = RAW["quaternion Q0 to Q3, w first"]
    assert new(monkeypatch, write(empty).name) == 0
    stated = ro.data.TableOptions.stated(read_toml(Path("cell/problem.toml"))["reading"])
    named = RAW["quaternion of named components"][0](empty)
    assert_clean(ro.use.read_measurements(calibrated["pose"], named, options=stated).data, "pose")


@pytest.mark.parametrize(("unit", "si"), [("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("µs", 1e-6), ("ns", 1e-9)])
def test_times_of_new_measurements_are_in_seconds(calibrated, unit, si) -> None:
    table = {f"time [{unit}]": [3.0, 8.0], **{f"q{i}_deg": [0.0, 10.0] for i in range(1, 7)}}
    table |= {f"{axis}_mm": [800.0, 810.0] for axis in "xyz"}
    assert np.diff(ro.use.read_measurements(calibrated["position"], table).when) == pytest.approx(5 * si)


def test_units_above_the_header_are_not_said_to_be_stated(monkeypatch, capsys, empty) -> None:
    write, _, _ = FILES["units above the header"]
    assert new(monkeypatch, write(empty).name) == 0
    said = capsys.readouterr().out
    assert "unit above the header" in said
    assert "unit --units" not in said


@pytest.mark.parametrize("name", sorted(NOT_READ))
def test_a_format_without_a_reader_is_one_sentence(monkeypatch, capsys, empty, name) -> None:
    write, options, _ = INSTRUMENTS[name]
    files = write(empty)
    assert new(monkeypatch, *[path.name for path in (files if isinstance(files, list) else [files])], **options) == 2
    error = capsys.readouterr().err.strip()
    assert "\n" not in error
    assert "accepted:" in error


def test_a_program_and_a_table_of_points_calibrate(monkeypatch, empty) -> None:
    (empty / "calib.dat").write_text(krl())
    (empty / "points.csv").write_text(text([["Point", *HEAD[7:]]], beside(NAMED, POINTS)))
    assert new(monkeypatch, "calib.dat", "points.csv", **{"hold-out": "0.25"}) == 0
    assert run(monkeypatch, "calibrate", "cell", "--selector", "1", "--out", "out") == 0
    result = ro.load_result("out")
    assert 1e3 * result.errors(result.record.validation).max() < 0.3


def turns(folder: Path, angles: Rows) -> None:
    head = [*HEAD, "rx [deg]", "ry [deg]", "rz [deg]"]
    (folder / "raw.csv").write_text(text([head], beside(ROWS, angles)))


def test_turns_in_another_convention_are_asked_for_and_what_they_are_is_printed(monkeypatch, capsys, empty) -> None:
    intrinsic = cells(Rotation.from_matrix(T[:, :3, :3]).as_euler("XYZ", degrees=True))
    turns(empty, intrinsic)
    assert new(monkeypatch, "raw.csv") == 2
    assert "--rotation 'intrinsic xyz'" in capsys.readouterr().err
    turns(empty, RPY)
    assert new(monkeypatch, "raw.csv") == 0
    assert "measured roll (extrinsic xyz)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("content", "options", "said"),
    [
        (text([[f"{r}_joint_{i}" for r in "ab" for i in range(1, 7)] + HEAD[7:]],
              [[*q, *q, *p] for q, p in zip(JOINTS, POINTS, strict=True)]), {"units": "deg"}, "--prefix"),
        (text([["Point", *(f"J{i}" for i in range(1, 7)), "X", "Y", "Z"], [*["deg"] * 5, *["mm"] * 4, "-"]], ROWS, ";"),
         {}, "(label of the row) in deg, accepted: one of no unit"),
        (text([["Axis", *HEAD[1:7], "Value [mm]"]], [["XYZ"[i % 3], *ROWS[0][1:7], "1"] for i in range(9)]), {},
         "a column that names the point"),
        (text([["// export", "units: mm"]], ROWS), {}, "no header above 'P1, "),
        (text([HEAD], [["P1", *["1 mm"] * 9]] * 3), {"columns": "a,b", "separator": "semicolon"}, "none of numbers"),
        (text([["a", "b"]], [["P1", "1.5"]] * 3), {"columns": "a,b"}, "no known column (a, b)"),
        (text([["Point", *HEAD[1:]]], ROWS), {"rotation": "intrinsic xxy"}, "'extrinsic xyz', 'intrinsic zyx'"),
    ],
)  # fmt: skip
def test_what_is_ambiguous_is_asked_in_one_sentence(monkeypatch, capsys, empty, content, options, said) -> None:
    (empty / "raw.csv").write_text(content)
    assert new(monkeypatch, "raw.csv", **options) == 2
    error = capsys.readouterr().err.strip()
    assert "\n" not in error
    assert said in error


def test_a_sheet_may_have_a_comma_in_its_name(monkeypatch, capsys, empty) -> None:
    book(empty, {"Notes": [["warm", "up"]], "Day 1, cold": [HEAD, *ROWS]})
    assert new(monkeypatch, "raw.xlsx", sheet="Day 1, cold") == 0, capsys.readouterr().err


def test_a_units_line_between_blanks_has_no_cell_for_the_label(monkeypatch, empty) -> None:
    head = ["Point", *(f"J{i}" for i in range(1, 7)), "X", "Y", "Z"]
    units = [" " * 5, *["deg"] * 6, *["mm"] * 3]
    (empty / "raw.txt").write_text(text([head, units], ROWS, " "))
    assert new(monkeypatch, "raw.txt") == 0
    data = ro.load("cell").problem.data
    assert np.abs(np.degrees(data.q) - Q).max() < 1e-9


@pytest.mark.parametrize(
    "name", ["rotation vectors without units", "a ROS driver's names", "joints in rad, angles in deg"]
)
def test_later_commands_read_the_very_table_that_new_read(monkeypatch, capsys, empty, name) -> None:
    write, options, kind = FILES[name]
    file = write(empty).name
    assert new(monkeypatch, file, **options) == 0
    assert run(monkeypatch, "calibrate", "cell", "--selector", "1", "--out", "out") in (0, 1)
    capsys.readouterr()
    assert run(monkeypatch, "validate", "out", file, "--json") == 0, capsys.readouterr().err
    raw = json.loads(capsys.readouterr().out)["identified"]
    assert run(monkeypatch, "validate", "out", "cell/identification.csv", "--json") == 0
    assert json.loads(capsys.readouterr().out)["identified"] == pytest.approx(raw)
    assert run(monkeypatch, "compensate", "out", file, "--json") in (0, 1), capsys.readouterr().err
    if kind == "pose":
        (empty / "points.csv").write_text(text([HEAD], ROWS))
        assert run(monkeypatch, "validate", "out", "points.csv", "--json") == 0, capsys.readouterr().err


def test_a_value_of_a_joined_file_is_refused_with_the_name_of_that_file(monkeypatch, capsys, empty) -> None:
    points = [[*row, "0" if i == 4 else "0.02"] for i, row in enumerate(beside(NAMED, POINTS))]
    (empty / "joints.csv").write_text(text([HEAD[:7]], beside(NAMED, JOINTS)))
    (empty / "points.csv").write_text(text([["Point", *HEAD[7:], "U95 [mm]"]], points))
    assert new(monkeypatch, "joints.csv", "points.csv") == 2
    said = capsys.readouterr().err
    assert said.startswith("points.csv, row P5 of those joined, column 'U95 [mm]': found 0"), said


def test_lost_readings_are_named_before_anything_is_calibrated(monkeypatch, capsys, empty) -> None:
    rows = [[*row[:7], *(["-999"] * 3 if i == 6 else row[7:])] for i, row in enumerate(ROWS)]
    (empty / "raw.csv").write_text(text([HEAD], rows))
    assert new(monkeypatch, "raw.csv") == 0
    assert "Row P7 has -999 mm for every measured coordinate" in " ".join(capsys.readouterr().out.split())
