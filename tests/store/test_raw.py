"""Files as instruments and people write them become the clean table's problem, and what was understood is said."""

from __future__ import annotations

import gzip
import json
import re
from pathlib import Path
from time import process_time

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.data.tables.joining import partners
from rpim_opt.robot import write_robot
from tests.simulate import ARM
from tests.store.raw_figures import CLEAN, MOST, TABLE, judged
from tests.store.raw_files import (
    COUNT,
    HEAD,
    JOINTS,
    LABELS,
    NAMED,
    POINTS,
    RAW,
    ROWS,
    WXYZ,
    P,
    Q,
    T,
    beside,
    book,
    cells,
    clocked,
    text,
)
from tests.test_cli import run


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("arm") / "robot.toml"
    write_robot(ARM, path)
    return path


def options(stated: dict[str, str]) -> list[str]:
    return [part for key, value in stated.items() for part in (f"--{key}", value)]


def new(monkeypatch: pytest.MonkeyPatch, arm: Path, folder: Path, files: Path | list[Path], *more: str) -> int:
    paths = files if isinstance(files, list) else [files]
    data = [part for path in paths for part in ("--data", str(path))]
    return run(monkeypatch, "new", str(folder), "--robot", str(arm), *data, *more)


@pytest.mark.parametrize("shape", RAW)
def test_a_raw_file_becomes_the_clean_tables_problem(monkeypatch, capsys, tmp_path, arm, shape) -> None:
    write, stated, kind = RAW[shape]
    assert new(monkeypatch, arm, tmp_path / "cell", write(tmp_path), *options(stated)) == 0, capsys.readouterr().err
    data = ro.load(tmp_path / "cell").problem.data
    assert len(data) == len(Q)
    order = list(range(len(Q)))
    if data.label[0].startswith("P"):  # a joined table has the order of one of its files
        order = [LABELS.index(label) for label in data.label]
    (block,) = data.blocks
    assert block.measurement.name == kind
    assert np.abs(np.degrees(block.q[:, 0]) - Q[order]).max() < 1e-9
    assert np.abs(1e3 * block.y[:, :3] - P[order]).max() < 1e-6
    if kind == "pose":
        turned = Rotation.from_quat(block.y[:, [4, 5, 6, 3]]).as_matrix()
        assert np.abs(turned - T[order][:, :3, :3]).max() < 1e-9


def test_a_dry_run_says_every_column_and_writes_nothing(monkeypatch, capsys, tmp_path, arm) -> None:
    write, stated, _ = RAW["SpatialAnalyzer"]
    path = write(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    assert new(monkeypatch, arm, tmp_path / "cell", path, *options(stated), "--dry-run") == 0
    said = capsys.readouterr().out
    lines = {line.split("   ")[0].strip(): line for line in said.splitlines()}
    assert "U95 of x" in lines["U(95) X [mm]"]
    assert "u95_x_mm" in lines["U(95) X [mm]"]
    assert "coverage factor 2" in lines["U(95) X [mm]"]
    assert "joint 1" in lines["J1 [deg]"]
    assert "not used" in lines["RMS"]
    assert f"\n{COUNT} rows, measurement position.\n" in said
    assert (
        f"\nDry run, nothing written: {tmp_path / 'cell'}\nidentification.csv: {COUNT} rows\nThe reflector starts"
        in said
    )
    assert new(monkeypatch, arm, tmp_path / "cell", path, "--dry-run", "--json") == 0
    content = json.loads(capsys.readouterr().out)
    assert [each["name"] for each in content["columns"][:2]] == ["label", "q1_deg"]
    assert sorted(tmp_path.rglob("*")) == before


def test_a_dry_run_checks_the_table_for_validation(monkeypatch, capsys, tmp_path, arm) -> None:
    path, later = tmp_path / "raw.csv", tmp_path / "later.csv"
    path.write_text(text([HEAD], ROWS))
    later.write_text(text([HEAD], ROWS[:5]))
    more = ["--validation", str(later), "--dry-run"]
    assert new(monkeypatch, arm, tmp_path / "cell", path, *more) == 0
    said = capsys.readouterr().out
    assert "5 rows, measurement position." in said
    assert "validation.csv: 5 rows" in said
    later.write_text(text([[*HEAD[:9], "X [mm]"]], ROWS))
    assert new(monkeypatch, arm, tmp_path / "cell", path, *more) == 2
    assert "columns 'X [mm]' and 'X [mm] #10' for x_mm" in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == [later, path]


def test_commanded_joints_serve_where_none_were_measured_and_it_is_said(monkeypatch, capsys, tmp_path, arm) -> None:
    path = tmp_path / "raw.csv"
    path.write_text(text([["Point", *(f"Commanded {name}" for name in HEAD[1:7]), *HEAD[7:]]], ROWS))
    assert new(monkeypatch, arm, tmp_path / "cell", path, "--dry-run") == 0
    assert "commanded values are used, since there are no measured ones" in capsys.readouterr().out
    path.write_text(text([[*HEAD[:7], *(f"Commanded {name}" for name in HEAD[7:])]], ROWS))
    assert new(monkeypatch, arm, tmp_path / "cell", path, "--dry-run") == 2
    assert "no positions among" in capsys.readouterr().err


def test_distances_alone_are_those_of_a_cable(monkeypatch, capsys, tmp_path, arm) -> None:
    """Unless a second point has columns, without which distances between points are refused."""
    path, distances = tmp_path / "raw.csv", [[f"{np.linalg.norm(p) + 40:.4f}"] for p in P]
    path.write_text(text([[*HEAD[:7], "distance [mm]"]], beside(NAMED, JOINTS, distances)))
    assert new(monkeypatch, arm, tmp_path / "between", path, "--measurement", "distance") == 2
    assert "measurement cable for distances to a fixed anchor" in capsys.readouterr().err
    assert new(monkeypatch, arm, tmp_path / "cable", path) == 0
    assert "Measurement cable: guessed from the columns distance." in capsys.readouterr().out
    to = [f"to_q{i}_deg" for i in range(1, 7)]
    path.write_text(text([[*HEAD[:7], *to, "distance [mm]"]], beside(NAMED, JOINTS, cells(Q[::-1]), distances)))
    assert new(monkeypatch, arm, tmp_path / "two", path) == 0
    assert "Measurement distance: guessed" in capsys.readouterr().out
    path.write_text(text([HEAD[:7]], beside(NAMED, JOINTS)))
    assert new(monkeypatch, arm, tmp_path / "none", path) == 2
    assert "accepted: columns x, y, z or distance, or --measurement plane" in capsys.readouterr().err


def test_what_was_understood_is_said_before_the_folder_is_made(monkeypatch, capsys, tmp_path, arm) -> None:
    """Also where the values then turn out to be unusable: the table is what explains it."""
    bad = [[*row] for row in ROWS]
    bad[3][8] = "x"
    path = tmp_path / "raw.csv"
    path.write_text(text([HEAD], bad))
    assert new(monkeypatch, arm, tmp_path / "cell", path) == 2
    said = capsys.readouterr()
    assert "measured y" in said.out
    assert "row P4, column 'Y [mm]': found 'x'" in said.err
    assert not (tmp_path / "cell").exists()


def test_uncertainties_of_the_instrument_are_those_of_the_rows(monkeypatch, tmp_path, arm) -> None:
    for shape in ("SpatialAnalyzer", "Leica"):  # half of a U(95), and a standard deviation
        write, stated, _ = RAW[shape]
        assert new(monkeypatch, arm, tmp_path / shape, write(tmp_path), *options(stated)) == 0
        (block,) = ro.load(tmp_path / shape).problem.data.blocks
        assert np.allclose(np.sqrt(np.einsum("nii->ni", block.covariance)), [18e-6, 20e-6, 22e-6], rtol=1e-12)


@pytest.mark.parametrize(("shape", "right", "wrong"), [("first", "wxyz", "xyzw"), ("last", "xyzw", "wxyz")])
def test_the_order_of_a_quaternion_is_checked_and_said(monkeypatch, capsys, tmp_path, arm, shape, right, wrong) -> None:
    write, stated, _ = RAW[f"quaternion Q0 to Q3, w {shape}"]
    path = write(tmp_path)
    assert new(monkeypatch, arm, tmp_path / "cell", path, *options(stated), "--dry-run") == 0
    said = capsys.readouterr().out
    assert f"the quaternion's order is {right}: nominal rotation errors {right} 0.09 deg, {wrong} " in said
    assert f"order {right}" in said
    # a stated order is not checked here: it is the user's word
    assert new(monkeypatch, arm, tmp_path / "cell", path, "--quaternion", wrong, "--dry-run") == 0
    assert "the quaternion's order is" not in capsys.readouterr().out


def test_a_stated_order_of_a_quaternion_goes_before_the_names_of_its_columns(
    monkeypatch, capsys, tmp_path, arm
) -> None:
    """A program wrote x, y, z, w below the names qw, qx, qy, qz."""
    path = tmp_path / "poses.csv"
    path.write_text(text([[*HEAD, "qw", "qx", "qy", "qz"]], beside(ROWS, cells(WXYZ[:, [1, 2, 3, 0]]))))
    assert new(monkeypatch, arm, tmp_path / "cell", path, "--quaternion", "xyzw") == 0, capsys.readouterr().err
    assert np.abs(ro.load(tmp_path / "cell").problem.data.blocks[0].y[:, 3:] - WXYZ).max() < 1e-5


U = ["Point", *HEAD[1:7], "X", "Y", "Z"]
REFUSED = {
    "no header": (text([], ROWS), [], ["line 1", "no header above 'P1", "--columns with 10 names"]),
    "too few names": (text([], ROWS), ["--columns", "label,q1_deg"], ["2 cells as in --columns", "without a header"]),
    "no unit": (text([U], ROWS), [], ["columns without a unit (X, Y, Z)", "--units"]),
    "thousands or decimals": (
        text([HEAD], [["P1", *["1,234"] * 9], ["P2", *["2,345"] * 9]], ";"), [], ["'1,234'", "--decimal"]
    ),
    "two decimal marks": (
        text([HEAD], [["P1", *["1,5"] * 6, *["1.5"] * 3]] * 2, ";"), [], ["'1,5' and '1.5'", "one decimal mark"]
    ),
    "decimal commas and three decimals": (
        text([HEAD], [["P1", *["1,5"] * 6, *["401.234"] * 3]] * 2, ";"), [], ["'1,5' and '401.234'", "one decimal mark"]
    ),
    "decimal commas between commas": (text([HEAD], ROWS, comma=True), [], ["19 cells", "need quotes"]),
    "not the encoding": (text([["Größe", *HEAD[1:]]], ROWS), ["--encoding", "ascii"], ["the text", "--encoding"]),
    "no such separator": (text([HEAD], ROWS), ["--separator", "colon"], ["--separator", "semicolon"]),
    "a sheet of a text": (text([HEAD], ROWS), ["--sheet", "2"], ["--sheet", "an Excel workbook"]),
    "names twice": (text([[*HEAD[:9], "X [mm]"]], ROWS), [], ["columns 'X [mm]' and 'X [mm] #10' for x_mm"]),
    "no such order": (
        text([[*HEAD, "Q0", "Q1", "Q2", "Q3"]], beside(ROWS, cells(WXYZ))), ["--quaternion", "abcd"], ["'abcd'", "xyzw"]
    ),
    "a quaternion of no order": (
        text([[*HEAD, "Q0", "Q1", "Q2", "Q3"]], beside(ROWS, [["0.5"] * 4] * COUNT)), [],
        ["an ambiguous order", "--quaternion"],
    ),
    "no matrices": (
        text([[*HEAD[:7], *(f"m{i}{j}" for i in range(4) for j in range(4))]],
             beside([row[:7] for row in ROWS], [["0.5"] * 16] * COUNT)),
        ["--units", "mm"], ["neither a last row nor a last column 0 0 0 1"],
    ),
    "a rotation vector without a unit": (
        text([[*HEAD, "rx", "ry", "rz"]], beside(ROWS, POINTS)), ["--rotation", "vector"], ["(rx, ry, rz)", "--units"]
    ),
    "nothing but text": ("a,b,c\nd,e,f\n", [], ["2 lines, none of numbers"]),
    "bytes": ("a\x00b,1,2\n", [], ["bytes that are zero"]),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_may_mean_two_things_is_refused(monkeypatch, capsys, tmp_path, arm, case) -> None:
    content, stated, expected = REFUSED[case]
    path = tmp_path / "raw.csv"
    path.write_text(content, encoding="utf-8")
    assert new(monkeypatch, arm, tmp_path / "cell", path, *stated) == 2
    said = capsys.readouterr().err.strip()
    assert "\n" not in said
    for part in expected:
        assert part in said, said
    assert not (tmp_path / "cell").exists()


@pytest.mark.parametrize("turned", [False, True])
def test_poses_that_are_named_once_are_the_labels(monkeypatch, capsys, tmp_path, arm, turned) -> None:
    grid = [["Pose", *HEAD[1:]], *ROWS]
    path = tmp_path / "raw.csv"
    path.write_text(text([], [list(cells) for cells in zip(*grid, strict=True)] if turned else grid))
    assert new(monkeypatch, arm, tmp_path / "cell", path) == 0, capsys.readouterr().err
    assert ("one row per quantity: transposed." in capsys.readouterr().out) == turned
    assert list(ro.load(tmp_path / "cell").problem.data.label) == LABELS


def test_a_compressed_table_is_to_be_unpacked(monkeypatch, capsys, tmp_path, arm) -> None:
    path = tmp_path / "raw.csv.gz"
    path.write_bytes(gzip.compress(text([HEAD], ROWS).encode()))
    assert new(monkeypatch, arm, tmp_path / "cell", path) == 2
    assert "found a compressed file, accepted: a text file: unpack it first" in capsys.readouterr().err


def test_a_xacro_file_is_refused_with_the_command_that_expands_it(monkeypatch, capsys, tmp_path) -> None:
    path = tmp_path / "raw.csv"
    path.write_text(text([HEAD], ROWS))
    assert new(monkeypatch, tmp_path / "arm.urdf.xacro", tmp_path / "cell", path) == 2
    assert "xacro arm.urdf.xacro > arm.urdf" in capsys.readouterr().err


def test_joints_and_points_need_a_key(monkeypatch, capsys, tmp_path, arm) -> None:
    joints = tmp_path / "first.csv"
    points = tmp_path / "second.csv"
    joints.write_text(text([HEAD[:7]], [row[:7] for row in ROWS]))
    points.write_text(text([HEAD[7:]], POINTS))
    assert new(monkeypatch, arm, tmp_path / "cell", [joints, points]) == 2
    assert (
        "no column in both first.csv and second.csv; Point of first.csv: P1, P2, P3 and 33 more"
        in capsys.readouterr().err
    )
    points.write_text(text([["Point", *HEAD[7:]]], [[f"Q{i}", *row] for i, row in enumerate(POINTS)]))
    assert new(monkeypatch, arm, tmp_path / "cell", [joints, points]) == 2
    assert (
        "no common values in first.csv (P1, P2, P3 and 33 more) and second.csv (Q0, Q1, Q2" in capsys.readouterr().err
    )
    points.write_text(text([["Point", *HEAD[7:]]], [[f"P{i}", *row] for i, row in enumerate(POINTS)]))
    assert new(monkeypatch, arm, tmp_path / "cell", [joints, points], "--dry-run") == 0
    said = capsys.readouterr().out
    assert f"joined by label: {COUNT - 1} rows match, of {COUNT} with joints and {COUNT} measured" in said
    assert f"without a match, ignored: P{COUNT}, P0." in said


def test_joints_of_axes_are_known_and_lost_columns_are_named(monkeypatch, capsys, tmp_path, arm) -> None:
    joints = tmp_path / "first.csv"
    points = tmp_path / "second.csv"
    points.write_text(text([["Point", *HEAD[7:]]], beside(NAMED, POINTS)))
    for pattern in ("AX{}_ACT [deg]", "AX{} [deg]", "Ax {} [deg]"):
        joints.write_text(text([["Point", *(pattern.format(i) for i in range(1, 7))]], beside(NAMED, JOINTS)))
        assert new(monkeypatch, arm, tmp_path / "cell", [joints, points], "--dry-run") == 0, capsys.readouterr().err
        assert f"joined by label: {COUNT} rows match, of {COUNT}" in capsys.readouterr().out
    joints.write_text(text([["Point", "Foo", "Bar"]], beside(NAMED, [row[:2] for row in JOINTS])))
    assert new(monkeypatch, arm, tmp_path / "cell", [joints, points]) == 2
    said = capsys.readouterr().err
    assert "no joint values or no measured values in first.csv (Point, Foo, Bar)" in said
    assert "named as A1, J1, Axis 1 or q1_deg and measured values x, y, z" in said


@pytest.mark.parametrize("head", [("Point", "Point"), ("Nr,Spot", "Target")])
def test_reflectors_of_one_point_share_its_configuration(monkeypatch, tmp_path, arm, head) -> None:
    """Also where the column that names the point, and repeats for its reflectors, is called otherwise."""
    joints = tmp_path / "first.csv"
    points = tmp_path / "second.csv"
    rows = [[*([str(i)] if "," in head[0] else []), *row[:7]] for i, row in enumerate(ROWS, start=1)]
    joints.write_text(text([[head[0], *HEAD[1:7]]], rows))
    several = [[row[0], marker, *row[7:]] for row in ROWS for marker in ("A", "B")]
    points.write_text(text([[head[1], "SMR", *HEAD[7:]]], several))
    assert new(monkeypatch, arm, tmp_path / "cell", [joints, points]) == 0
    data = ro.load(tmp_path / "cell").problem.data
    assert len(data) == 2 * COUNT
    assert len(np.unique(data.configuration)) == COUNT
    assert {block.markers for block in data.blocks} == {("A",), ("B",)}


def test_rows_that_were_left_out_are_named(monkeypatch, capsys, tmp_path, arm) -> None:
    for shape, expected in (
        ("beam lost", "rows without measured values are ignored: lost."),
        ("footer and means", "is not a row of the table: 'Mean, 1.5,"),
        ("footer and means", "is not a row of the table: 'End of export' ignored."),
        ("header again on every page", "line 7 is not a row of the table: 'Point, J1 [deg],"),
        ("preamble", "4 lines above the header are ignored ('Export of cell 7' ...)."),
        ("Latin-1 with degrees", "read as cp1252: not UTF-8."),
        ("semicolon and decimal comma", "decimal commas: no comma can be a thousands separator."),
        ("preamble", "--decimal comma does not apply: found '"),
    ):
        write, stated, _ = RAW[shape]
        more = ["--decimal", "comma"] if "--decimal" in expected else []
        assert new(monkeypatch, arm, tmp_path / "cell", write(tmp_path), *options(stated), *more, "--dry-run") == 0
        assert expected in capsys.readouterr().out, shape


@pytest.fixture(scope="module")
def after_the_clean_table() -> float:
    return judged(CLEAN).identified


@pytest.mark.slow
@pytest.mark.parametrize("shape", RAW)
def test_a_raw_file_calibrates_as_well_as_the_clean_table(shape, after_the_clean_table) -> None:
    found = judged(shape)
    assert found.identified <= MOST * after_the_clean_table
    assert found.identified < 0.1 * found.nominal


def test_the_table_of_raw_files_is_of_these() -> None:
    """More than forty, and none that its table calls worse; ``python -m tests.store.raw_figures`` writes it anew."""
    lines = [line.split(" | ") for line in TABLE.read_text(encoding="utf-8").splitlines() if line.startswith("| ")]
    over = {line[0].strip("| "): float(line[-1].strip("| ")) for line in lines[2:]}
    assert list(over) == list(RAW)
    assert len(over) >= 40
    assert max(over.values()) <= MOST


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory, arm: Path) -> tuple[Path, Path]:
    """A clean table, and the result of its calibration."""
    folder = tmp_path_factory.mktemp("calibrated")
    clean = folder / "clean.csv"
    clean.write_text(text([HEAD], ROWS))
    with pytest.MonkeyPatch.context() as patch:
        assert new(patch, arm, folder / "cell", clean) == 0
        run(patch, "calibrate", str(folder / "cell"), "--selector", "1", "--out", str(folder / "out"))
    return clean, folder / "out"


@pytest.mark.parametrize(
    "shape", ["semicolon and decimal comma", "SpatialAnalyzer", "merged header", "UTF-16", "Excel"]
)
def test_new_measurements_are_read_as_raw_files_are(monkeypatch, capsys, tmp_path, calibrated, shape) -> None:
    """Also by the commands that take tables later: validate and compensate."""
    clean, out = calibrated
    write = RAW[shape][0]
    raw = str(write(tmp_path))
    documents = []
    for path in (str(clean), raw):
        capsys.readouterr()
        assert run(monkeypatch, "validate", str(out), path, "--units", "deg,mm", "--json") == 0
        documents.append(json.loads(capsys.readouterr().out)["identified"])
    assert run(monkeypatch, "compensate", str(out), raw, "--units", "deg,mm", "--json") in (0, 1)
    assert documents[0] == pytest.approx(documents[1])


def test_targets_keep_the_names_of_their_positions(monkeypatch, capsys, tmp_path, calibrated) -> None:
    targets = tmp_path / "targets.csv"
    targets.write_text(text([["Nr", "PosName", *HEAD[1:7]]], [[str(i), *row[:7]] for i, row in enumerate(ROWS[:3], 1)]))
    capsys.readouterr()
    assert run(monkeypatch, "compensate", str(calibrated[1]), str(targets)) in (0, 1)
    said = capsys.readouterr().out
    assert "Ignored columns: Nr." in said
    assert "\nP3," in said


@pytest.mark.parametrize("decimal", ["", "comma", "point"])
def test_every_file_has_its_own_decimal_mark(monkeypatch, capsys, tmp_path, calibrated, decimal) -> None:
    """Joint values with three decimals each, ``-40,003``, which no joint has with thousands apart."""
    _, out = calibrated
    joints = [[*label, *row] for label, row in zip(NAMED, JOINTS, strict=True)]
    joints = [row for row in joints if all(abs(float(cell)) >= 1 for cell in row[1:])][:8]
    files = [tmp_path / "joints.txt", tmp_path / "points.txt"]
    files[0].write_text(text([["Point", "A1", "A2", "A3", "A4", "A5", "A6"]], joints, ";", comma=True))
    files[1].write_text(text([["Point", "X", "Y", "Z"]], beside(NAMED, POINTS), "\t"))
    stated = ["--units", "deg,mm", *(["--decimal", decimal] if decimal else [])]
    assert run(monkeypatch, "validate", str(out), *map(str, files), *stated, "--json") == 0, capsys.readouterr().err
    document = json.loads(capsys.readouterr().out)
    assert document["identified"]["count"] == len(joints)
    assert document["identified"]["max_mm"] < 1.0


def test_a_table_of_a_hundred_thousand_columns_is_refused_in_a_moment(monkeypatch, capsys, tmp_path, arm) -> None:
    path = tmp_path / "wide.csv"
    for mark in (",", ";", "\t"):
        path.write_text("\n".join([mark.join(f"c{i}" for i in range(100_000)), mark.join(["1.5"] * 100_000)]))
        start = process_time()
        assert new(monkeypatch, arm, tmp_path / "cell", path) == 2
        assert process_time() - start < 2.0
        assert "a row of 100000 cells, accepted: at most 1000 columns" in capsys.readouterr().err


def test_a_sheet_is_that_of_the_workbook_beside_a_text_file(monkeypatch, capsys, tmp_path, arm) -> None:
    joints = tmp_path / "joints.csv"
    joints.write_text(text([["Point", *HEAD[1:7]]], beside(NAMED, JOINTS), ";"))
    other = [[*row[:3], "0.0"] for row in POINTS]
    sheets = {
        "Info": [["Project", "cell 7"], ["Serial number", "4711"]],
        "Points": [["Point", *HEAD[7:]], *beside(NAMED, POINTS)],
        "Other": [["Point", *HEAD[7:]], *beside(NAMED, other)],
    }
    points = book(tmp_path, sheets)
    for k, sheet in enumerate(([], ["--sheet", "Points"], ["--sheet", "2"])):  # the first with numbers, or as stated
        assert new(monkeypatch, arm, tmp_path / f"cell{k}", [joints, points], *sheet) == 0, capsys.readouterr().err
        assert "sheet 'Points' of Info, Points, Other" in capsys.readouterr().out
        assert len(ro.load(tmp_path / f"cell{k}").problem.data) == COUNT


def test_joined_readings_keep_the_names_of_their_points(monkeypatch, capsys, tmp_path, arm) -> None:
    joints, points = tmp_path / "joints.csv", tmp_path / "points.csv"
    joints.write_text(text([["Point", *HEAD[1:7]]], beside(NAMED, JOINTS)))
    rows = [[*name, marker, *point] for name, point in zip(NAMED, POINTS, strict=True) for marker in ("A", "B")]
    points.write_text(text([["Point", "Reflector", *HEAD[7:]]], rows))
    assert new(monkeypatch, arm, tmp_path / "cell", [joints, points]) == 0, capsys.readouterr().err
    labels = ro.load(tmp_path / "cell").problem.data.label
    assert set(labels) == {f"{name[0]}/{marker}" for name in NAMED for marker in ("A", "B")}


def test_one_log_of_joints_serves_points_that_are_measured_again(monkeypatch, capsys, tmp_path, arm) -> None:
    """Monthly sessions at the same points: names repeat, and the times of one month alone are those of the log."""
    joints, points = tmp_path / "joints.csv", tmp_path / "points.csv"
    joints.write_text(
        text(
            [["Point", "Date", *HEAD[1:7]]],
            [[*n, f"2026-01-05 08:{i:02}", *q] for i, (n, q) in enumerate(zip(NAMED, JOINTS, strict=True))],
        )
    )
    rows = [
        [*name, f"2026-0{month}-05 08:{i:02}", *point]
        for month in (1, 2, 3)
        for i, (name, point) in enumerate(zip(NAMED, POINTS, strict=True))
    ]
    points.write_text(text([["Target", "Time", *HEAD[7:]]], rows))
    assert new(monkeypatch, arm, tmp_path / "none", [joints, points]) == 2
    assert "accepted: --key with a column" in capsys.readouterr().err
    assert new(monkeypatch, arm, tmp_path / "cell", [joints, points], "--key", "Target") == 0
    assert f"{3 * COUNT} rows match, of {COUNT} with joints" in capsys.readouterr().out
    sessions = [["Target", "Session", *HEAD[7:]]]
    points.write_text(text(sessions, [[row[0], row[1][:7], *row[2:]] for row in rows]))
    assert new(monkeypatch, arm, tmp_path / "two", [joints, points]) == 0
    assert f"{3 * COUNT} rows match, of {COUNT} with joints" in capsys.readouterr().out


@pytest.mark.parametrize("whole", [False, True])
def test_a_group_for_every_configuration_has_points_that_are_reflectors(
    monkeypatch, capsys, tmp_path, arm, whole
) -> None:
    """As SpatialAnalyzer exports them, beside joints or with them; one shot is missing."""
    rows = [
        [*name, mark, *axes, *point] for name, axes, point in zip(NAMED, JOINTS, POINTS, strict=True) for mark in "AB"
    ]
    joints, points = tmp_path / "joints.csv", tmp_path / "points.csv"
    joints.write_text(text([["Pose", *HEAD[1:7]]], beside(NAMED, JOINTS)))
    points.write_text(text([["Gruppe", "Punkt", *HEAD[7:]]], [[*row[:2], *row[8:]] for row in rows[:-1]]))
    files = [joints, points]
    if whole:
        points.write_text(text([["Gruppe", "Punkt", *HEAD[1:]]], rows[:-1]))
        files = [points]
    assert new(monkeypatch, arm, tmp_path / "cell", files) == 0, capsys.readouterr().err
    data = ro.load(tmp_path / "cell").problem.data
    assert len(data) == 2 * COUNT - 1
    assert {block.markers for block in data.blocks} == {("A",), ("B",)}
    assert len(np.unique(data.configuration)) == COUNT


def test_every_reflector_is_joined_by_the_nearest_time(monkeypatch, capsys, tmp_path, arm) -> None:
    joints, points = clocked(tmp_path, rate=10.0, apart=0.0)
    rows = []
    for i, point in enumerate(POINTS):
        rows += [[f"P{i}{marker}", marker, f"{1e3 * i + later}", *point] for marker, later in (("A", 20), ("B", 60))]
    points.write_text(text([["Point", "Reflector", "Timestamp [ms]", *HEAD[7:]]], rows))
    stated = ["--time-tolerance", "0.07"]
    assert new(monkeypatch, arm, tmp_path / "cell", [joints, points], *stated) == 0, capsys.readouterr().err
    data = ro.load(tmp_path / "cell").problem.data
    assert len(data) == 2 * COUNT
    assert len(np.unique(data.configuration)) == COUNT


def test_files_of_two_clocks_are_joined_by_the_nearest_time(monkeypatch, capsys, tmp_path, arm) -> None:
    files = clocked(tmp_path, rate=100.0, apart=0.003)
    assert new(monkeypatch, arm, tmp_path / "cell", files, "--time-tolerance", "0.006") == 0
    said = capsys.readouterr().out
    assert f"joined by the nearest time: {COUNT} rows match, of {10 * COUNT} with joints and {COUNT} measured" in said
    assert "times differ by 0.003 s at most, +0.003 s on average" in said
    assert "the robot moved" not in said
    assert "joins the files" in said
    assert "not used" not in said
    data = ro.load(tmp_path / "cell").problem.data
    np.testing.assert_allclose(np.degrees(data.q), [[float(cell) for cell in row] for row in JOINTS], atol=1e-9)
    assert list(data.label) == [name[0] for name in NAMED]


@pytest.mark.parametrize("key", [[], ["--key", "header.stamp.sec"]])
def test_times_of_ros_in_two_columns_are_one(monkeypatch, capsys, tmp_path, arm, key) -> None:
    files = clocked(tmp_path, rate=10.0, apart=0.003)
    header, *lines = files[0].read_text().splitlines()
    stamped = ["header.stamp.sec,header.stamp.nanosec," + header.partition(",")[2]]
    for line in lines:
        time, _, rest = line.partition(",")
        stamped.append(f"{int(float(time))},{round(1e9 * (float(time) % 1))},{rest}")
    files[0].write_text("\n".join(stamped))
    assert new(monkeypatch, arm, tmp_path / "cell", files, "--time-tolerance", "0.06", *key) == 0
    assert "times differ by 0.053 s at most" in capsys.readouterr().out


def test_a_robot_that_moves_as_it_is_measured_is_named(monkeypatch, capsys, tmp_path, arm) -> None:
    """Joint 1 turns for 30 s at 20 degrees a second; measured is 0.02 s after a row of the log."""
    files = [tmp_path / "joints.csv", tmp_path / "points.csv"]
    moments = np.arange(COUNT) + 0.52
    log = [[f"{t:.2f}", f"{20 * min(t, 30):.4f}", *["0"] * 5] for t in np.arange(0, COUNT + 1, 0.1)]
    files[0].write_text(text([["time [s]", *HEAD[1:7]]], log))
    points = [[name[0], f"{t:.2f}", *point] for name, t, point in zip(NAMED, moments, POINTS, strict=True)]
    files[1].write_text(text([["Point", "time [s]", *HEAD[7:]]], points))
    new(monkeypatch, arm, tmp_path / "cell", files, "--time-tolerance", "0.1", "--dry-run")
    said = capsys.readouterr().out
    assert (
        f"the robot moved by up to 0.4 degrees between measurement and joint values in 30 of {COUNT} joined rows"
        in said
    )


def test_nothing_is_said_of_how_a_robot_moved_while_nothing_was_recorded(monkeypatch, capsys, tmp_path, arm) -> None:
    """It was recorded at rest alone, and the last sample was measured 4 ms after its joint values."""
    files = [tmp_path / "joints.csv", tmp_path / "points.csv"]
    times = np.concatenate([5.0 * k + np.arange(10) / 20 for k in range(COUNT)])
    log = [[f"{t:.3f}", f"{20 * (t // 5):.4f}", *["0"] * 5] for t in times]
    files[0].write_text(text([["time [s]", *HEAD[1:7]]], log))
    points = [[f"P{i}", f"{t + 0.004:.3f}", *POINTS[i // 10]] for i, t in enumerate(times)]
    files[1].write_text(text([["Point", "time [s]", *HEAD[7:]]], points))
    new(monkeypatch, arm, tmp_path / "cell", files, "--time-tolerance", "0.01", "--dry-run")
    said = capsys.readouterr().out
    assert f"{10 * COUNT} rows match" in said
    assert "the robot moved" not in said


@pytest.mark.parametrize("late", [0.8, -0.3])
def test_the_offset_of_a_clock_is_named_by_where_the_robot_stands_still(
    monkeypatch, capsys, tmp_path, arm, late
) -> None:
    """It moves for 2 s, stands still for 1.5 s and more, and is measured 0.75 s after it stopped."""
    files = [tmp_path / "joints.csv", tmp_path / "points.csv"]
    starts = np.cumsum(3.5 + np.random.default_rng(0).uniform(0, 1.0, COUNT + 1))
    log = []
    for t in np.arange(0, starts[-1], 0.05):
        k = np.searchsorted(starts, t)
        log.append([f"{t:.2f}", f"{20 * (k - 1 + min((t - starts[k - 1]) / 2, 1)) if k else 0:.4f}", *["0"] * 5])
    files[0].write_text(text([["time [s]", *HEAD[1:7]]], log))
    moments = starts[:-1] + 2.75 + late
    points = [[name[0], f"{t:.2f}", *point] for name, t, point in zip(NAMED, moments, POINTS, strict=True)]
    files[1].write_text(text([["Point", "time [s]", *HEAD[7:]]], points))
    new(monkeypatch, arm, tmp_path / "cell", files, "--time-tolerance", "0.03", "--dry-run")
    said = capsys.readouterr().out
    if abs(late) < 0.7:
        assert "the robot moved" not in said  # within the shortest stop
        return
    low, high = re.search(r"The robot is at rest if .* s \((.\d\.\d+) to (.\d\.\d+)\) are added", said).groups()
    assert float(low) < -late < float(high)


def test_rows_without_a_partner_in_time_are_counted(monkeypatch, capsys, tmp_path, arm) -> None:
    files = clocked(tmp_path, rate=100.0, apart=0.003)
    late = [["late", "99000", *POINTS[0]]]
    files[1].write_text(files[1].read_text() + text([], late))
    assert new(monkeypatch, arm, tmp_path / "cell", files, "--time-tolerance", "0.006") == 0
    assert "1 measured rows without a match within 0.006 s, ignored: late." in capsys.readouterr().out


@pytest.mark.parametrize(
    ("shift", "within", "said"),
    [(5000.0, "0.01", "none within 0.01 s"), (0.0, "-1", "zero or more"), (0.0, "nan", "zero or more")],
)
def test_clocks_that_do_not_agree_are_one_sentence(monkeypatch, capsys, tmp_path, arm, shift, within, said) -> None:
    files = clocked(tmp_path, rate=100.0, apart=0.0, shift=shift)
    assert new(monkeypatch, arm, tmp_path / "cell", files, "--time-tolerance", within) == 2
    error = capsys.readouterr().err.strip()
    assert "\n" not in error
    assert said in error
    files[1].write_text(files[1].read_text().replace("Timestamp [ms]", "Remark"))
    assert new(monkeypatch, arm, tmp_path / "cell", files, "--time-tolerance", "0.01") == 2
    assert "no column of times among" in capsys.readouterr().err


def test_few_equal_times_are_asked_for_a_tolerance(monkeypatch, capsys, tmp_path, arm) -> None:
    files = clocked(tmp_path, rate=100.0, apart=0.0)
    rows = [
        [name[0], f"{i + 0.05 + 0.003 * (i > 3):.4f}", *p]
        for i, (name, p) in enumerate(zip(NAMED, POINTS, strict=True))
    ]
    files[1].write_text(text([["Point", "time [s]", *HEAD[7:]]], rows))
    assert new(monkeypatch, arm, tmp_path / "cell", files, "--hold-out", "0.25") == 2
    error = capsys.readouterr().err.strip()
    assert "\n" not in error
    assert "the key column 'time [s]': found 4 common values in" in error
    assert "accepted: --key with a column that names the points, --time-tolerance SECONDS for the nearest" in error
    assert new(monkeypatch, arm, tmp_path / "cell", files, "--time-tolerance", "0.004") == 0
    assert f"{COUNT} rows match" in capsys.readouterr().out
    assert new(monkeypatch, arm, tmp_path / "two", files, "--key", "time [s]") == 0
    assert "4 rows match" in capsys.readouterr().out


def test_each_of_the_fewer_has_its_own_partner() -> None:
    """A row of the longer table serves the nearest alone; both ways round the pairs are the same."""
    few, many = np.array([0.0, 0.9, 1.15, 5.0]), np.arange(0.0, 10.0, 1.0)
    left, right, apart = partners(few, many, 0.2)
    turned = partners(many, few, 0.2)
    assert list(zip(left.tolist(), right.tolist(), strict=True)) == [(0, 0), (1, 1), (3, 5)]
    assert (turned[1].tolist(), turned[0].tolist()) == (left.tolist(), right.tolist())
    np.testing.assert_allclose(turned[2], -apart)


def test_columns_of_other_names_join_two_files(monkeypatch, capsys, tmp_path, arm) -> None:
    """Running numbers of both files do not: the tracker's rows have another order."""
    joints = tmp_path / "robot.csv"
    points = tmp_path / "tracker.csv"
    joints.write_text(text([["No", "Pose", *HEAD[1:7]]], [[str(i), *row[:7]] for i, row in enumerate(ROWS, start=1)]))
    other_order = [[str(i), row[0], *row[7:]] for i, row in enumerate(ROWS[::-1], start=1)]
    points.write_text(text([["No", "Point Name", *HEAD[7:]]], other_order))
    for more in ([], ["--key", "Point Name"]):
        assert new(monkeypatch, arm, tmp_path / "cell", [points, joints], "--dry-run", *more) == 0
        assert f"joined by Pose = Point Name: {COUNT} rows match, of {COUNT}" in capsys.readouterr().out
    assert new(monkeypatch, arm, tmp_path / "cell", [points, joints], "--key", "row") == 2
    said = capsys.readouterr().err
    assert f"{COUNT - COUNT % 2} of {COUNT} rows whose Pose matches Point Name in another row" in said
    points.write_text(text([["ID", "Point Name", *HEAD[7:]]], [[f"x{row[0]}", *row[1:]] for row in other_order]))
    assert new(monkeypatch, arm, tmp_path / "cell", [points, joints]) == 2
    assert "columns 'ID' and 'Point Name' for label" in capsys.readouterr().err
    assert new(monkeypatch, arm, tmp_path / "cell", [points, joints], "--key", "Point Name") == 0


@pytest.mark.parametrize(
    ("name", "cell"),
    [
        ("Date / Time", "31.05.2026 12:{:02d}"),
        ("Timestamp UTC", "2026-05-31T12:{:02d}:00Z"),
        ("Time (UTC)", "2026/05/31 12:{:02d}:00"),
        ("Timestamp", "10/05/2026 12:{:02d}:34 PM"),
        ("Timestamp", "5/31/2026 9:{:02d} AM"),
        ("Timestamp", "31/05/2026 21:{:02d}:34"),
    ],
)
def test_dates_are_the_order_of_the_rows(monkeypatch, capsys, tmp_path, arm, name, cell) -> None:
    """A column that is called a time, and is none that can be read, is not used."""
    rows = [[*row, cell.format(COUNT - i)] for i, row in enumerate(ROWS)]
    (tmp_path / "raw.csv").write_text(text([[*HEAD, name]], rows))
    assert new(monkeypatch, arm, tmp_path / "cell", tmp_path / "raw.csv") == 0
    assert f"rows are in the order of '{name}'." in capsys.readouterr().out
    assert list(ro.load(tmp_path / "cell").problem.data.label) == LABELS[::-1]
    (tmp_path / "raw.csv").write_text(text([[*HEAD, name]], [[*row, "noon"] for row in ROWS]))
    assert new(monkeypatch, arm, tmp_path / "other", tmp_path / "raw.csv") == 0
    assert re.search(rf"{re.escape(name)} +not used", capsys.readouterr().out)


def test_a_reference_that_was_measured_again_is_no_obstacle_to_a_key(monkeypatch, capsys, tmp_path, arm) -> None:
    files = [tmp_path / "robot.csv", tmp_path / "tracker.csv"]
    files[0].write_text(text([["Punkt", *HEAD[1:7]]], [[f"P{i}", *row] for i, row in enumerate(JOINTS)]))
    rows = [["Robot", f"P{i}", *row] for i, row in enumerate(POINTS)]
    rows = [["Reference", "REF1", *POINTS[0]], *rows[::-1], ["Reference", "REF1", *POINTS[0]]]
    files[1].write_text(text([["Group", "Target", *HEAD[7:]]], rows))
    assert new(monkeypatch, arm, tmp_path / "cell", files, "--key", "Target") == 0
    said = capsys.readouterr().out
    assert f"{COUNT} rows match, of {COUNT} with joints and {COUNT + 2} measured." in said
    assert "without a match, ignored: REF1, REF1." in said


def test_a_reference_in_both_files_leaves_the_names_of_the_others(monkeypatch, capsys, tmp_path, arm) -> None:
    """By a key its rows are ignored; by the time they keep their name, and all rows were numbered."""
    files = [tmp_path / "robot.csv", tmp_path / "tracker.csv"]
    names = ["REF", *(f"P{i}" for i in range(COUNT - 2)), "REF"]
    files[0].write_text(
        text(
            [["Name", "Time [s]", *HEAD[1:7]]],
            [[n, str(i), *q] for i, (n, q) in enumerate(zip(names, JOINTS, strict=True))],
        )
    )
    rows = [[n, str(i), *p] for i, (n, p) in enumerate(zip(names, POINTS, strict=True))]
    files[1].write_text(text([["Target", "Time [s]", *HEAD[7:]]], rows[::-1]))
    for more, count in ((["--key", "Target"], COUNT - 2), (["--time-tolerance", "0.1"], COUNT)):
        assert new(monkeypatch, arm, tmp_path / f"cell{count}", files, *more) == 0
        said = capsys.readouterr().out
        assert f"{count} rows match, of {COUNT} with joints and {COUNT} measured" in said
        assert ("same name, ignored: REF. To keep them: --key row" in said) == (count < COUNT)
        assert {"P0", f"P{COUNT - 3}"} <= {*ro.load(tmp_path / f"cell{count}").problem.data.label}


def test_what_publishers_count_their_messages_by_is_no_key(monkeypatch, capsys, tmp_path, arm) -> None:
    files = [tmp_path / "robot.csv", tmp_path / "tracker.csv"]
    head = ["%time", "field.header.seq"]
    times = [str(1_700_000_000_000_000_000 + 10**9 * i) for i in range(COUNT)]
    files[0].write_text(text([[*head, *HEAD[1:7]]], [[times[i], str(i), *row] for i, row in enumerate(JOINTS)]))
    rows = [[times[i], str(i + 2), *row] for i, row in enumerate(POINTS)]
    files[1].write_text(text([[*head, *HEAD[7:]]], rows))
    assert new(monkeypatch, arm, tmp_path / "cell", files) == 0
    assert re.search(rf"joined by [^\n]*time: {COUNT} rows match", capsys.readouterr().out)


@pytest.mark.parametrize("key", ["", "Target", "Punkt"])
def test_names_that_differ_by_zeros_are_joined_in_the_order_of_time(monkeypatch, capsys, tmp_path, arm, key) -> None:
    """A tracker sorts its points as text, P1, P10, P11, P2; the last of the robot's was measured first."""
    files = [tmp_path / "robot.csv", tmp_path / "tracker.csv"]
    files[0].write_text(text([["Punkt", *HEAD[1:7]]], [[f"P{i:03d}", *row] for i, row in enumerate(JOINTS)]))
    rows = [[f"p{i}", *row, f"2026-05-31 12:{59 - i}:00"] for i, row in enumerate(POINTS)]
    files[1].write_text(text([["Target", *HEAD[7:], "Timestamp"]], sorted(rows)))
    more = ["--key", key] if key else []
    assert new(monkeypatch, arm, tmp_path / "cell", files, *more) == 0
    said = capsys.readouterr().out
    how = "Punkt = Target" if key else "label"
    assert f"joined by {how} ('p0' as 'P000'): {COUNT} rows match, of {COUNT} with joints and {COUNT} measured." in said
    assert "rows are in the order of 'Timestamp'." in said
    data = ro.load(tmp_path / "cell").problem.data
    assert list(data.label) == [f"P{i:03d}" for i in reversed(range(COUNT))]
    np.testing.assert_allclose(1e3 * data.blocks[0].y, P[::-1], atol=1e-4)
    assert new(monkeypatch, arm, tmp_path / "other", files, "--key", "Stamp") == 2
    assert "--key: found 'Stamp', no column of the files, accepted: Punkt, " in capsys.readouterr().err


def test_a_file_that_is_stated_twice_is_read_once(monkeypatch, capsys, tmp_path, arm) -> None:
    """As for two sheets of one file; rows that occur twice would be taken for measurements."""
    file = tmp_path / "both.csv"
    file.write_text(text([HEAD], ROWS))
    assert new(monkeypatch, arm, tmp_path / "cell", [file, file], "--dry-run") == 0
    said = capsys.readouterr().out
    assert "stacked" not in said
    assert f"{COUNT} rows, measurement position" in said
