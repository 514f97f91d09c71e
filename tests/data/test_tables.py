"""Tables of every kind say the same; a bad one is refused with its row, and nothing is written."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import polars as pl
import pytest

import rpim_opt as ro
from rpim_opt.basics.layout import read_table
from rpim_opt.data.measurements.registry import MEASUREMENTS
from tests.simulate import ARM
from tests.test_cli import run

ARM2 = ro.robot.Robot("two joints", ARM.mdh[:2])
HEAD = "label,q1_deg,q2_deg,x_mm,y_mm,z_mm"
GOOD = f"{HEAD}\na,1,2,3,4,5\nb,2,3,4,5,6\n"
NOISE = {"position_mm": 0.1}


def frame() -> pd.DataFrame:
    return pd.DataFrame({"label": ["a", "b"], "q1_deg": [1, 2], "q2_deg": [2.0, 3.0], "x_mm": [3.0, 4.0],
                         "y_mm": [4.0, 5.0], "z_mm": [5.0, 6.0]})  # fmt: skip


def write(tmp_path: Path, text: str | bytes) -> Path:
    path = tmp_path / "data.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize("kind", ["pandas", "polars", "dict", "arrow", "parquet", "xlsx", "csv with a mark"])
def test_every_kind_of_table_says_the_same(tmp_path: Path, kind: str) -> None:
    pandas, source = frame(), None
    if kind == "pandas":
        source = pandas.set_index(pd.Index([7, 9]))
    elif kind == "polars":
        source = pl.DataFrame(pandas.to_dict("list"))
    elif kind == "dict":
        source = pandas.to_dict("list")
    elif kind == "arrow":
        source = pl.DataFrame(pandas.to_dict("list")).to_arrow()
    elif kind == "parquet":
        source = tmp_path / "data.parquet"
        pandas.to_parquet(source)
    elif kind == "xlsx":
        source = tmp_path / "data.xlsx"
        pandas.to_excel(source, index=False)
    else:
        source = write(tmp_path, "\ufeff" + GOOD + "\n\n")
    want, got = ro.read_data(write(tmp_path, GOOD), ARM2, NOISE), ro.read_data(source, ARM2, NOISE)
    assert got.label == want.label == ("a", "b")
    for a, b in zip(got.blocks, want.blocks, strict=True):
        assert np.array_equal(a.q, b.q)
        assert np.array_equal(a.y, b.y)


ROW = "a,1,2,3,4,5\n"
HOSTILE = {
    "empty file": (b"", "the table: found an empty"),
    "blank lines": (b"\n\n  \n", "the table: found an empty"),
    "header only": (f"{HEAD}\n", "a header and no rows"),
    "UTF-16": (GOOD.encode("utf-16"), "the file: found"),
    "Latin-1": (GOOD.replace("a,1", "\xe4,1").encode("latin-1"), "the file: found"),
    "binary": (bytes(range(256)) * 4, "data.csv"),
    "null byte in a number": (GOOD.replace("a,1", "a,\x001"), "data.csv, row a, column q1_deg: found"),
    "unclosed quote": (GOOD + '"c,1,2,3,4,5', "line 4: found"),
    "semicolons": (GOOD.replace(",", ";"), "the header: found one column with semicolons"),
    "tabs": (GOOD.replace(",", "\t"), "the header: found one column with semicolons or tabs"),
    "decimal commas": (GOOD.replace("a,1,", 'a,"1,5",'), "row a, column q1_deg: found '1,5'"),
    "short row": (GOOD + "c,1,2,3\n", "row 3 (c): found 4 cells, accepted: 6"),
    "long row": (GOOD + "c,1,2,3,4,5,6\n", "row 3 (c): found 7 cells, accepted: 6"),
    "no header": (ROW + "b,2,3,4,5,6\n", "the header: found"),
    "unnamed column": (GOOD.replace("x_mm", ""), "the header: found column '', accepted: a unique name"),
    "column twice": (GOOD.replace("y_mm", "x_mm"), "the header: found column 'x_mm' twice"),
    "column in two units": (f"{HEAD},x_m\na,1,2,3,4,5,6\n", "column 'x' in two units"),
    "a driver's header": (GOOD.replace("x_mm", "/tracker/point/x"), "rpim-opt new (ro.store.new_problem)"),
    "unknown column": (GOOD.replace("x_mm", "px_mm"), "column 'px_mm'"),
    "no unit": (GOOD.replace("x_mm", "x"), "column 'x' without a unit"),
    "unknown unit": (GOOD.replace("x_mm", "x_ft"), "column 'x_ft'"),
    "length for an angle": (GOOD.replace("q1_deg", "q1_mm"), "column 'q1_mm' without a unit of the right dimension"),
    "angle for a length": (GOOD.replace("x_mm", "x_deg"), "column 'x_deg' without a unit of the right dimension"),
    "missing joint": (GOOD.replace("q2_deg", "sigma_mm"), "no column for 'q2'"),
    "missing coordinate": (GOOD.replace("z_mm", "sigma_mm"), "no column for 'z'"),
    "joint too many": (f"{HEAD},q3_deg\na,1,2,3,4,5,6\n", "column 'q3_deg'"),
    "empty cell": (GOOD.replace("b,2", "b,"), "row b, column q1_deg: found ''"),
    "nan": (GOOD.replace("b,2", "b,nan"), "row b, column q1_deg: found 'nan'"),
    "infinity": (GOOD.replace("b,2", "b,-inf"), "row b, column q1_deg: found '-inf'"),
    "overflow": (GOOD.replace("b,2", "b,1e999"), "row b, column q1_deg: found '1e999'"),
    "words": (GOOD.replace("b,2", "b,two"), "row b, column q1_deg: found 'two'"),
    "underscores": (GOOD.replace("b,2", "b,1_0"), "row b, column q1_deg: found '1_0'"),
    "hexadecimal": (GOOD.replace("b,2", "b,0x10"), "row b, column q1_deg: found '0x10'"),
    "a unit in the cell": (GOOD.replace("b,2", "b,2 deg"), "row b, column q1_deg: found '2 deg'"),
    "a formula": (GOOD.replace("b,2", "b,=A1"), "row b, column q1_deg: found '=A1'"),
    "true": (GOOD.replace("b,2", "b,True"), "row b, column q1_deg: found 'True'"),
    "label twice": (GOOD.replace("b,2", "a,2"), "row 2, column label: found 'a'"),
    "empty label": (GOOD.replace("b,2", ",2"), "row 2, column label: found ''"),
    "unprintable label": (GOOD.replace("b,2", "b\x07,2"), "row 2, column label: found"),
    "zero sigma": (f"{HEAD},sigma_mm\n{ROW[:-1]},0\n", "row a, column sigma_mm: found 0"),
    "negative sigma": (f"{HEAD},sigma_x_mm\n{ROW[:-1]},-1\n", "row a, column sigma_x_mm: found -1"),
    "zero U95": (f"{HEAD},u95_mm\n{ROW[:-1]},0\n", "row a, column u95_mm: found 0"),
    "sigma of an angle": (
        f"{HEAD},sigma_mrad\n{ROW[:-1]},1\n",
        "column 'sigma_mrad' without a unit of the right dimension",
    ),
    "covariance without unit": (
        f"{HEAD},cov_x_y\n{ROW[:-1]},1\n",
        "column 'cov_x_y' without a unit of the right dimension",
    ),
    "impossible covariance": (f"{HEAD},cov_x_y_mm2\n{ROW[:-1]},1\n", "row a, columns cov_...: found a covariance"),
    "a torque missing": (f"{HEAD},tau1_Nm\n{ROW[:-1]},1\n", "no column for 'tau2'"),
    "empty marker": (f"{HEAD},marker\n{ROW[:-1]},\n", "row a, column marker: found ''"),
    "unknown marker": (f"{HEAD},marker\n{ROW[:-1]},Q\n", "row a, column marker: found 'Q'"),
    "a second point that is none": (f"{HEAD},to_q1_deg\n{ROW[:-1]},1\n", "column 'to_q1_deg'"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_tables_are_refused_with_the_row_and_nothing_is_written(monkeypatch, capsys, tmp_path, case) -> None:
    text, expected = HOSTILE[case]
    write(tmp_path, text)
    (tmp_path / "robot.toml").write_text('name = "r"\n[[joint]]\nd_mm = 100\n[[joint]]\nalpha_deg = 90\na_mm = 300\n')
    (tmp_path / "problem.toml").write_text(
        'title = "t"\nidentification = "data.csv"\nidentify = ["a?"]\n[noise]\nposition_mm = 0.1\n'
    )
    out = tmp_path / "out"
    assert run(monkeypatch, "calibrate", str(tmp_path), "--out", str(out)) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert not out.exists()
    assert expected in said.err, said.err
    assert said.err.count("\n") == 1
    assert len(said.err) < 900
    assert "Traceback" not in said.err


@pytest.mark.parametrize("suffix", [".parquet", ".xlsx"])
def test_broken_binary_tables_are_refused(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"data{suffix}"
    path.write_bytes(b"PK\x03\x04 not what it says")
    with pytest.raises(ro.InputError, match="the file: found"):
        ro.read_data(path, ARM2, NOISE)


def test_a_table_of_an_unknown_kind_names_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ro.InputError, match=r"'data.mat', accepted: a name ending in .csv, .parquet, .xlsx"):
        ro.read_data(tmp_path / "data.mat", ARM2, NOISE)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"x_mm": [True, False]}, "row a, column x_mm: found 'True'"),
        ({"x_mm": [1.0, None]}, "row b, column x_mm"),
        ({"x_mm": [1.0, np.nan]}, "row b, column x_mm: found 'nan'"),
        ({"x_mm": [1j, 2j]}, "row a, column x_mm: found '1j'"),
        ({"x_mm": pd.to_datetime(["2026-01-01", "2026-01-02"])}, "row a, column x_mm: found '2026"),
        ({"label": ["a", np.nan]}, "row 2, column label: found ''"),
    ],
)
def test_hostile_data_frames(change: dict, expected: str) -> None:
    with pytest.raises(ro.InputError) as refused:
        ro.read_data(frame().assign(**change), ARM2, NOISE)
    assert expected in str(refused.value)


def read(header: str, row: str, noise: dict | None = None, kind: str = "position") -> ro.Dataset:
    table = dict(zip(header.split(","), ([cell] for cell in row.split(",")), strict=True))
    return ro.read_data(table, ARM2, NOISE if noise is None else noise, MEASUREMENTS[kind])


def test_expanded_uncertainties_are_two_standard_deviations() -> None:
    one = read(HEAD + ",u95_mm", "a,1,2,3,4,5,0.06", {})
    assert np.sqrt(np.diag(one.blocks[0].covariance[0])) == pytest.approx([3e-5] * 3)
    axes = read(HEAD + ",u95_x_mm,u95_y_mm,u95_z_um", "a,1,2,3,4,5,0.02,0.04,80", {})
    assert np.sqrt(np.diag(axes.blocks[0].covariance[0])) == pytest.approx([1e-5, 2e-5, 4e-5])


def test_a_full_covariance_of_a_row() -> None:
    names = ["x", "y", "z"]
    pairs = [(a, b) for i, a in enumerate(names) for b in names[i:]]
    header = HEAD + "," + ",".join(f"cov_{a}_{b}_mm2" for a, b in pairs)
    got = read(header, "a,1,2,3,4,5,4,1,0.5,9,2,16", {}).blocks[0].covariance[0]
    assert got == pytest.approx(1e-6 * np.array([[4, 1, 0.5], [1, 9, 2], [0.5, 2, 16]]))
    head = "q1_deg,q2_deg,x_mm,y_mm,z_mm,qw,qx,qy,qz,cov_x_rx_mm_mrad"
    six = (
        read(head, "1,2,3,4,5,1,0,0,0,0.01", {"position_mm": 0.1, "orientation_mrad": 0.2}, "pose").blocks[0].covariance
    )
    assert six.shape == (1, 6, 6)
    assert six[0, 0, 3] == six[0, 3, 0] == pytest.approx(1e-8)
    assert np.sqrt(np.diag(six[0])) == pytest.approx([1e-4] * 3 + [2e-4] * 3)


def test_a_tracker_adds_to_the_declared_noise_and_a_rows_own_replaces_both() -> None:
    tracker = {"range_um": 10, "range_ppm": 5, "transverse_um": 20, "angle_urad": 10, "x_m": -2}
    C = read(HEAD, "a,1,2,0,0,0", {"position_mm": 0.03, "tracker": tracker}).blocks[0].covariance[0]
    assert np.diag(C) == pytest.approx([9e-10 + 4e-10, 9e-10 + 16e-10, 9e-10 + 16e-10])
    tracker |= {"range_um": 3, "range_ppm": 1, "x_m": 1}
    C = read(HEAD, "a,1,2,3000,2000,2000", {"tracker": tracker}).blocks[0].covariance[0]  # 2 m along x, y and z
    assert np.sqrt(np.ones(3) @ C @ np.ones(3) / 3) == pytest.approx(3e-6 + 1e-6 * np.sqrt(12))
    assert np.linalg.eigvalsh(C)[1:] == pytest.approx(np.full(2, (2e-5 + 1e-5 * np.sqrt(12)) ** 2))
    own = read(HEAD + ",sigma_mm", "a,1,2,0,0,0,0.5", {"tracker": tracker}).blocks[0].covariance[0]
    assert own == pytest.approx(2.5e-7 * np.eye(3))
    with pytest.raises(ro.InputError, match=r"noise.tracker: found unknown key 'rang_um'.*did you mean range_um"):
        read(HEAD, "a,1,2,0,0,0", {"tracker": {"rang_um": 1}})
    with pytest.raises(ro.InputError, match="no range_um and no transverse_um"):
        read(HEAD, "a,1,2,0,0,0", {"tracker": {"x_mm": 1}})


def test_quaternions_are_normalized_or_refused() -> None:
    noise = {"position_mm": 0.1, "orientation_mrad": 0.2}
    head = "label,q1_deg,q2_deg,x_mm,y_mm,z_mm,qw,qx,qy,qz"
    y = read(head, "a,1,2,3,4,5,1.0005,0,0,0", noise, "pose").blocks[0].y
    assert np.linalg.norm(y[0, 3:]) == pytest.approx(1, abs=1e-15)
    with pytest.raises(ro.InputError, match="row a: found a quaternion of norm 2, accepted: norm 1"):
        read(head, "a,1,2,3,4,5,2,0,0,0", noise, "pose")
    angles = read("q1_deg,q2_deg,x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg", "1,2,3,4,5,0,0,90", noise, "pose").blocks[0].y
    assert angles[0, 3:] == pytest.approx([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    with pytest.raises(ro.InputError, match="no standard deviation for 'rx', accepted: orientation_mrad"):
        read(head, "a,1,2,3,4,5,1,0,0,0", {"position_mm": 0.1}, "pose")


def test_two_points_of_a_distance() -> None:
    noise = {"distance_mm": 0.1}
    base = "label,marker,to_marker,q1_deg,q2_deg,distance_mm"
    same = read(base, "a,A,B,1,2,30", noise, "distance").blocks[0]
    assert same.markers == ("A", "B")
    assert np.array_equal(same.q[0, 0], same.q[0, 1])
    moved = read(base + ",to_q1_deg,to_q2_deg", "a,A,A,1,2,30,3,4", noise, "distance").blocks[0]
    assert np.degrees(moved.q[0]) == pytest.approx(np.array([[1, 2], [3, 4]]))
    with pytest.raises(ro.InputError, match="row a: found the same reflector twice in one configuration"):
        read(base, "a,A,A,1,2,30", noise, "distance")
    with pytest.raises(ro.InputError, match="no column for 'to_q2'"):
        read(base + ",to_q1_deg", "a,A,A,1,2,30,3", noise, "distance")


def test_rows_at_the_same_joint_values_are_one_configuration() -> None:
    table = {"q1_deg": [1, 2, 1], "q2_deg": [5, 5, 5], "x_mm": [1, 2, 3], "y_mm": [1, 2, 3], "z_mm": [1, 2, 3]}
    data = ro.read_data(table, ARM2, NOISE)
    assert data.configuration[0] == data.configuration[2] != data.configuration[1]
    both = ro.Dataset.together([data, data.take([1])], ["one", "two"])
    assert both.label == ("one:1", "one:2", "one:3", "two:2")
    assert both.configuration[3] == both.configuration[1]
    again = both.take([3, 0, 0])
    assert again.label == ("two:2", "one:1", "one:1")
    assert again.q[:, 0] == pytest.approx(np.radians([2, 1, 1]))


def test_rows_of_an_arm_at_rest_are_one_configuration() -> None:
    """Encoders scatter by some microradians: every sample of a stream, and every later visit, was one before."""
    rng = np.random.default_rng(0)
    poses = np.repeat([[0.3, 0.1], [0.9, 0.2], [0.3, 0.1]], 20, axis=0)
    q = poses + 8e-6 * rng.normal(size=(60, 2))
    table = {"q1_rad": q[:, 0], "q2_rad": q[:, 1], **{f"{c}_mm": np.arange(60.0) for c in "xyz"}}
    for data in (ro.read_data(table, ARM2, NOISE), ro.Dataset.of(q, np.zeros((60, 3)), 1e-5)):
        assert data.configuration.tolist() == [0] * 20 + [1] * 20 + [0] * 20
        assert ro.Dataset.together([data], ["one"]).configuration.tolist() == data.configuration.tolist()
    slow = np.linspace(0, 9e-4, 21)[:, None] * [1, 0]  # of which no two samples are farther apart than encoders scatter
    assert len(set(ro.Dataset.of(slow, np.zeros((21, 3)), 1e-5).configuration)) == 7
    table["configuration"] = [f"{i}" for i in range(60)]
    assert len(set(ro.read_data(table, ARM2, NOISE).configuration)) == 60


def test_excel_says_what_is_missing(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    path = tmp_path / "data.xlsx"
    path.write_bytes(b"PK\x05\x06" + bytes(18))  # an archive without entries
    with pytest.raises(
        ro.InputError, match=r"Excel files: found no package openpyxl.*pip install 'rpim-opt\[tables\]'"
    ):
        ro.read_data(path, ARM2, NOISE)


@pytest.mark.parametrize("word", ["Mean", "Mittelwert", "Média", "Среднее"])
def test_a_row_that_is_called_a_mean_is_no_measurement(tmp_path: Path, word: str) -> None:
    path = np.linspace(0, 1, 9)[:, None] * [10.0, 20.0, 30.0]
    lines = ["label;q1_deg;q2_deg;q3_deg", *(f"P{i};{a};{b};{c}" for i, (a, b, c) in enumerate(path.tolist()))]
    file = tmp_path / "path.csv"
    file.write_text("\n".join([*lines, f"{word};5.0;10.0;15.0"]), encoding="utf-8")
    assert len(read_table(file).columns["q1_deg"]) == 9
