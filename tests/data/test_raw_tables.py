"""Raw tables whose names, sheets, units or rows are odd: understood as meant, or one sentence says what not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import openpyxl
import pandas as pd
import pytest

import rpim_opt as ro
from rpim_opt.basics.tables import read_grid
from rpim_opt.basics.units import parse_units, split
from rpim_opt.data.measurements.pose import pose, position
from rpim_opt.data.tables.formats.registry import read_raw
from rpim_opt.data.tables.joining import together
from rpim_opt.data.tables.understanding import CanonicalTable, interpret
from rpim_opt.robot.library import read_arm
from rpim_opt.store.raw import interpret_tables

ARM = ro.robot.Robot("two links", np.array([[0, 0, 0, 0, 0], [0, 0.4, 0, 0, 0]]))
ROWS = "P1,1,2,401,5,6\nP2,3,4,402,6,7\n"
HEAD = "Point,J1 [deg],J2 [deg],X [mm],Y [mm],Z [mm]\n"


def write(folder: Path, text: str | bytes, name: str = "raw.csv") -> Path:
    path = folder / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def read(path: Path, joints: Any = (), robot: Any = ARM, kind: Any = position, **asked: Any) -> CanonicalTable:
    options = ro.data.TableOptions(**asked)
    try:
        return replace(interpret(read_raw(path, options), robot, kind, options, joints), file=path.name)
    except ro.InputError as error:
        raise error.within(path) from None


def book(folder: Path) -> Path:
    made = openpyxl.Workbook()
    empty = made.active
    assert empty is not None
    empty.title = "notes"
    sheet = made.create_sheet("points")
    for row in (HEAD + ROWS).splitlines():
        sheet.append([*row.split(","), "", None])
    path = folder / "raw.xlsx"
    made.save(path)
    return path


REFUSED: dict[str, tuple[str, dict[str, Any], str]] = {
    "a sign that is two": (HEAD + ROWS, {"separator": "::"}, "--separator: found '::'"),
    "a decimal mark": (HEAD + ROWS, {"decimal": "'"}, "comma or point"),
    "nothing": ("\n\n", {}, "an empty file"),
    "an encoding that no text has": (HEAD + ROWS, {"encoding": "\ud800"}, "--encoding with the one that fits"),
    "an encoding of no name": (HEAD + ROWS, {"encoding": "\x00"}, "--encoding with the one that fits"),
    "a sheet of a text": (HEAD + ROWS, {"sheet": "1"}, "an Excel workbook"),
    "angles that no file has": (HEAD + ROWS, {"rotation": "euler"}, "--rotation: found 'euler'"),
    "no row with values": (HEAD + "P1,1,2,-,-,-\nP2,-,-,3,4,5\n", {}, "no row with values"),
    "one axis of an instrument": (
        HEAD.replace("Point", "tracker_x_mm") + ROWS.replace("P", "40"), {},
        "columns 'tracker_x_mm' and 'X [mm]' for x_mm",
    ),
    "a quote that does not end": (HEAD + 'P1,1,2,3,4,"5\nP2,1,2,3,4,5\n', {}, "line "),
}  # fmt: skip


def test_ignored_rows_without_labels_are_named_by_their_numbers(tmp_path: Path) -> None:
    rows = "1,2,401,5,6\n3,4,-,-,-\n5,6,402,6,7\n"
    found = read(write(tmp_path, HEAD.removeprefix("Point,") + rows))
    assert "rows without measured values are ignored: 2." in found.notes


def test_dates_with_points_are_no_decimal_points(tmp_path: Path) -> None:
    head, *rows = (HEAD + ROWS).replace(",", ";").splitlines()
    dated = [f"{head};Datum", *(f"{row},5;01.05.2024" for row in rows)]
    found = read(write(tmp_path, "\n".join(dated)))
    assert "decimal commas" in found.notes[-1]


def test_points_of_several_arrays_are_named_by_array_and_by_key_where_it_has_several(tmp_path: Path) -> None:
    homes = '<Data name="home"><Value key="0" j1="1"/></Data><Data name="cell"><Value key="0" x="7"/></Data>'
    path = write(tmp_path, homes + '<Data name="calib"><Value j1="2"/><Value j1="3"/></Data>', "raw.dtx")
    columns = read_raw(path).columns
    assert list(columns["label"]) == ["home", "calib[0]", "calib[1]"]
    assert list(columns["J1 [deg]"]) == ["1", "2", "3"]


@pytest.mark.parametrize("what", REFUSED)
def test_one_sentence_names_what_is_wrong(tmp_path: Path, what: str) -> None:
    text, asked, said = REFUSED[what]
    with pytest.raises(ro.InputError) as error:
        read(write(tmp_path, text), **asked)
    assert said in error.value.command


def test_a_file_of_another_kind_is_named(tmp_path: Path) -> None:
    with pytest.raises(ro.InputError, match=r"found 'raw\.pdf', accepted: a name ending in .*\.parquet"):
        read(write(tmp_path, HEAD + ROWS, "raw.pdf"))


@pytest.mark.parametrize("kind", ["page", "text", "workbook", "old workbook"])
def test_what_is_in_a_file_called_xls_is_read(tmp_path: Path, kind: str) -> None:
    rows = [row.split(",") for row in (HEAD + ROWS).splitlines()]
    cells = ("".join(f"<td>{cell}</td>" for cell in row) for row in rows)
    content = {
        "page": ("<html><table>" + "".join(f"<tr>{row}</tr>" for row in cells) + "</table></html>").encode(),
        "text": (HEAD + ROWS).replace(",", "\t").encode(),
        "workbook": book(tmp_path).read_bytes(),
        "old workbook": b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(504),
    }
    path = write(tmp_path, content[kind], "report.xls")
    if kind == "old workbook":
        with pytest.raises(ro.InputError, match=r"a workbook of Excel 97.*accepted: one that was saved as \.xlsx"):
            read(path)
    else:
        assert read(path).columns["z_mm"] == ["6", "7"]


def test_the_first_sheet_with_numbers_is_read_and_another_one_by_name_or_number(tmp_path: Path) -> None:
    path = book(tmp_path)
    found = read(path)
    assert "sheet 'points' of notes, points: the first with numbers" in found.notes[0]
    for sheet in ("points", "2"):
        assert dict(read(path, sheet=sheet).columns) == dict(found.columns)
    with pytest.raises(ro.InputError, match=r"found 'poinst', accepted: .*points"):
        read(path, sheet="poinst")
    with pytest.raises(ro.InputError, match="an empty file"):
        read(path, sheet="notes")


def test_three_axes_of_an_instrument_are_measured_where_others_are_there_too(tmp_path: Path) -> None:
    head = HEAD.replace("X [mm],Y [mm],Z [mm]", "tracker_x_mm,tracker_y_mm,tracker_z_mm,x_mm,y_mm,z_mm")
    found = read(write(tmp_path, head + "P1,1,2,401,5,6,7,8,9\nP2,3,4,402,6,7,8,9,9\n"))
    assert [float(found.columns[f"{axis}_mm"][0]) for axis in "xyz"] == [401, 5, 6]


def test_an_object_with_an_empty_list_is_a_row(tmp_path: Path) -> None:
    row = '{"label": "P1", "q1_deg": 1, "q2_deg": 2, "x_mm": 401, "y_mm": 5, "z_mm": 6, "tags": []}'
    assert list(read(write(tmp_path, row, "raw.json")).columns["x_mm"]) == ["401"]


def test_a_workbook_that_is_none_is_one_sentence(tmp_path: Path) -> None:
    path = write(tmp_path, b"PK\x05\x06" + bytes(18), "raw.xlsx")
    with pytest.raises(ro.InputError, match="a readable workbook"):
        read(path)


def test_parquet_says_what_the_text_says(tmp_path: Path) -> None:
    text = read(write(tmp_path, HEAD + ROWS))
    names, *rows = [line.split(",") for line in (HEAD + ROWS).splitlines()]
    pd.DataFrame(rows, columns=names).to_parquet(tmp_path / "raw.parquet")
    found = read(tmp_path / "raw.parquet")
    assert {name: [str(cell) for cell in cells] for name, cells in found.columns.items()} == dict(text.columns)


def test_blank_cells_at_the_end_of_a_row_are_none(tmp_path: Path) -> None:
    found = read(write(tmp_path, HEAD + ROWS.replace("6\n", "6,,\n")), separator=",")
    assert dict(found.columns) == dict(read(write(tmp_path, HEAD + ROWS)).columns)


def test_many_lines_between_rows_are_counted_beyond_those_that_are_shown(tmp_path: Path) -> None:
    between = "".join(f"P{i},{i},2,40{i},5,6\npause {i},,,,,\n" for i in range(1, 10))
    found = read(write(tmp_path, HEAD + between + "P10,1,2,3,4,5\n"))
    assert len(found.columns["label"]) == 10
    assert any(note.endswith("more lines are not rows of the table: ignored.") for note in found.notes)


@pytest.mark.parametrize("name", ["u(x)", "u x", "u_x"])
def test_a_small_u_is_a_standard_uncertainty(tmp_path: Path, name: str) -> None:
    head = HEAD.strip() + f",{name} [mm]\n"
    found = read(write(tmp_path, head + ROWS.replace("6\n", "6,0.1\n").replace("7\n", "7,0.1\n")))
    assert found.columns["sigma_x_mm"] == ["0.1", "0.1"]


def test_a_path_that_names_the_robots_own_joint_is_that_joint(tmp_path: Path) -> None:
    text = "t,/j/elbow/position,/j/foot/position,x_mm,y_mm,z_mm\n" + ROWS.replace("P1", "1").replace("P2", "2")
    found = read(write(tmp_path, text), joints=("foot", "elbow"), units={"angle": "deg"})
    assert found.columns["q2_deg"] == ["1", "3"]
    assert found.columns["q1_deg"] == ["2", "4"]


NAMED = "name0,name1,position0,position1,x_mm,y_mm,z_mm\n"


def test_columns_of_joints_names_say_the_order(tmp_path: Path) -> None:
    path = write(tmp_path, NAMED + "elbow,foot,1,2,401,5,6\nelbow,foot,3,4,402,6,7\n")
    found = read(path, joints=("foot", "elbow"), units={"angle": "deg"})
    assert found.columns["q2_deg"] == ["1", "3"]
    assert found.columns["q1_deg"] == ["2", "4"]


def test_a_joint_of_another_robot_is_no_joint_of_this_one(tmp_path: Path) -> None:
    text = NAMED.replace("name1,", "name1,name2,").replace("position1,", "position1,position2,")
    path = write(tmp_path, text + "foot,gripper,elbow,1,9,2,401,5,6\nfoot,gripper,elbow,3,9,4,402,6,7\n")
    found = read(path, joints=("foot", "elbow"), units={"angle": "deg"})
    assert found.columns["q1_deg"] == ["1", "3"]
    assert found.columns["q2_deg"] == ["2", "4"]


def test_efforts_follow_the_names_of_joints_and_are_torques_where_that_is_said(tmp_path: Path) -> None:
    """Without a unit they may be currents, and of some joints they are no torques of the robot."""
    head = "name0,name1,name2,position0,position1,position2,effort0,effort1,effort2,x_mm,y_mm,z_mm\n"
    path = write(
        tmp_path, head + "foot,gripper,elbow,1,9,2,10,90,20,401,5,6\nfoot,gripper,elbow,3,9,4,30,90,40,402,6,7\n"
    )
    asked: dict[str, Any] = {"joints": ("elbow", "foot"), "units": {"angle": "deg"}}
    why = {each.column: each.why for each in read(path, **asked).meant if each.meaning == "not used"}
    assert why["effort0"] == why["effort2"] == "an effort without a unit: --units Nm if it is a torque"
    asked["units"] = {"angle": "deg", "torque": "Nm"}
    found = read(path, **asked)
    assert [found.columns[f"tau{i}_Nm"] for i in (1, 2)] == [["20", "40"], ["10", "30"]]
    assert "tau3_Nm" not in found.columns
    assert len(ro.read_data(found.columns, ARM, {"position_mm": 0.1})) == 2
    path = write(tmp_path, path.read_text().replace("effort2", "other"))
    found = read(path, **asked)
    assert {each.column: each.why for each in found.meant}["effort0"] == "not all joints have an effort"
    assert len(ro.read_data(found.columns, ARM, {"position_mm": 0.1})) == 2


@pytest.mark.parametrize(
    ("cells", "joints", "said"),
    [
        (
            "elbow,foot,1,2,401,5,6\nfoot,elbow,3,4,402,6,7\n",
            ("foot", "elbow"),
            "2 names, accepted: one joint per column",
        ),
        ("elbow,foot,1,2,401,5,6\nelbow,foot,3,4,402,6,7\n", (), "a robot from a URDF, which names its joints"),
    ],
)
def test_names_of_joints_that_change_or_that_nobody_knows(tmp_path: Path, cells: str, joints: Any, said: str) -> None:
    with pytest.raises(ro.InputError) as error:
        read(write(tmp_path, NAMED + cells), joints=joints, units={"angle": "deg"})
    assert said in error.value.command


def test_q0_to_q3_are_a_quaternion_where_they_cannot_be_the_joints(tmp_path: Path) -> None:
    """Other columns are, or another file has them; joints where no others are there."""
    text = "Point,J1 [deg],J2 [deg],X [mm],Y [mm],Z [mm],Q0,Q1,Q2,Q3\nP1,1,2,401,5,6,1,0,0,0\nP2,3,4,402,6,7,1,0,0,0\n"
    found = read(write(tmp_path, text), kind=pose)
    assert [found.columns[name] for name in ("qw", "qx", "q1_deg")] == [["1", "1"], ["0", "0"], ["1", "3"]]
    found = read(write(tmp_path, "Point,X [mm],Y [mm],Z [mm],Q0,Q1,Q2,Q3\nP1,401,5,6,1,0,0,0\n"), kind=pose)
    assert [found.columns[name] for name in ("x_mm", "qw", "qz")] == [["401"], ["1"], ["0"]]
    four = ro.robot.Robot("four", np.array([[0, 0.1, 0, 0, 0]] * 4))
    text = "Point,Q0 [deg],Q1 [deg],Q2 [deg],Q3 [deg],X [mm],Y [mm],Z [mm]\nP1,1,2,3,4,401,5,6\n"
    found = read(write(tmp_path, text), robot=four)
    assert [found.columns[f"q{i}_deg"] for i in range(1, 5)] == [["1"], ["2"], ["3"], ["4"]]


@pytest.mark.parametrize(("unit", "millimetres"), [("cm", 10), ("in", 25.4)])
def test_centimetres_and_inches_are_lengths(tmp_path: Path, unit: str, millimetres: float) -> None:
    assert parse_units(unit) == {"length": unit}
    text = HEAD.replace("[mm]", f"[{unit}]")
    found = read(write(tmp_path, text + "P1,1,2,1,5,6\n"))
    assert found.columns[f"x_{unit}"] == ["1"]
    data = ro.read_data(found.columns, ARM, {"position_mm": 0.1})
    assert 1e3 * data.blocks[0].y[0, 0] == pytest.approx(millimetres)


def test_two_bytes_and_fewer_than_four_are_read_as_text(tmp_path: Path) -> None:
    assert read_grid(write(tmp_path, b"a,b")).rows == [["a", "b"]]
    assert read_grid(write(tmp_path, "x,y\n1,2\n".encode("utf-16"))).rows == [["x", "y"], ["1", "2"]]


JOINTS = "name,J1 [deg],J2 [deg]\na,1,2\nb,3,4\n"
VALUES = "name,X [mm],Y [mm],Z [mm]\nb,402,6,7\na,401,5,6\n"


def two(folder: Path, joints: str = JOINTS, values: str = VALUES) -> list[CanonicalTable]:
    return [read(write(folder, joints, "joints.csv")), read(write(folder, values, "values.csv"))]


def test_two_tables_are_joined_by_what_both_have(tmp_path: Path) -> None:
    found = together(two(tmp_path), ARM, position)
    assert [float(x) for x in found.columns["x_mm"]] == pytest.approx([401, 402])
    assert list(found.columns["q1_deg"]) == ["1", "3"]
    other_names = VALUES.replace("b,", "c,").replace("a,4", "d,4")
    by_row = together(two(tmp_path, values=other_names), ARM, position, "row")
    assert list(by_row.columns["q1_deg"]) == ["1", "3"]
    assert by_row.labels == ["a", "b"]  # names are kept


def test_a_common_column_counts_beside_a_pair_of_other_names(tmp_path: Path) -> None:
    joints = "stamp,Alpha,J1 [deg],J2 [deg]\n7,a,1,2\n9,b,3,4\n"
    values = "stamp,Beta,X [mm],Y [mm],Z [mm]\n9,b,402,6,7\n7,a,401,5,6\n"
    found = together(two(tmp_path, joints, values), ARM, position)
    assert [float(x) for x in found.columns["x_mm"]] == pytest.approx([401, 402])
    assert list(found.columns["q1_deg"]) == ["1", "3"]


@pytest.mark.parametrize(
    ("joints", "values", "key", "said"),
    [
        (JOINTS, VALUES + "c,1,2,3\n", "row", "2 rows of joints and 3 measured, accepted: equal numbers of both"),
        (JOINTS.replace("b,3", "a,3"), VALUES, "", "'a' twice in"),
        (JOINTS, VALUES, "time", "found 'time'"),
        (JOINTS, VALUES, "row", "2 of 2 rows whose name matches name in another row"),
        (JOINTS.replace("name", "one"), "other,X [mm],Y [mm],Z [mm]\nc,402,6,7\nd,401,5,6\n", "", "no column in both"),
    ],
)
def test_tables_that_cannot_be_joined(tmp_path: Path, joints: str, values: str, key: str, said: str) -> None:
    with pytest.raises(ro.InputError) as error:
        together(two(tmp_path, joints, values), ARM, position, key)
    assert said in error.value.command


def test_the_column_of_the_times_may_have_any_name(tmp_path: Path) -> None:
    joints = "stamp,J1 [deg],J2 [deg]\n0.0,1,2\n1.0,3,4\n"
    values = "stamp,X [mm],Y [mm],Z [mm]\n1.001,402,6,7\n"
    found = together(two(tmp_path, joints, values), ARM, position, "stamp", within=0.01)
    assert list(found.columns["q1_deg"]) == ["3"]
    for key, said in (("clock", "'clock', no column of the files"), ("", "no column of times")):
        with pytest.raises(ro.InputError, match=said):
            together(two(tmp_path, JOINTS, VALUES), ARM, position, key, within=0.01)


def test_files_of_one_name_are_told_apart_by_their_numbers(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    tables = [read(write(tmp_path, HEAD + ROWS)), read(write(tmp_path / "other", HEAD + ROWS))]
    assert list(together(tables, ARM, position).columns["label"]) == ["1:P1", "1:P2", "2:P1", "2:P2"]


def test_files_below_each_other_are_in_the_units_of_the_first(tmp_path: Path) -> None:
    other = HEAD.replace("[mm]", "[m]") + "P3,5,6,0.4,0.005,0.006\n"
    tables = [read(write(tmp_path, HEAD + ROWS)), read(write(tmp_path, other, "later.csv"))]
    assert float(together(tables, ARM, position).columns["x_mm"][2]) == pytest.approx(400)
    lacking = read(write(tmp_path, "Point,J1 [deg],X [mm],Y [mm],Z [mm]\nP4,1,2,3,4\n", "lacking.csv"))
    with pytest.raises(ro.InputError, match=r"q2 in only one of raw\.csv and lacking\.csv"):
        together([tables[0], lacking], ARM, position)


def test_a_table_without_columns_and_one_whose_names_are_no_texts() -> None:
    for table, said in (({}, "an empty table"), ({1: [2]}, "column 1, accepted: a unique name for every column")):
        with pytest.raises(ro.InputError, match=said):
            ro.read_data(table, ARM, {"position_mm": 0.1})


def test_a_german_controllers_and_a_trackers_export_need_no_renaming(tmp_path: Path) -> None:
    robot = ro.load("position").problem.robot
    head = ";".join(["Nr.", *(f"Achse {letter} [°]" for letter in "SLURBT"), "X-Wert", "Y-Wert", "Z-Wert"])
    text = f"Messprotokoll\nEinheit: mm\n\n{head};Unsicherheit U95\n"
    text += "".join(f"{i};1,5;2,5;3,5;4,5;5,5;6,5;100,125;200,25;{i}00,5;0,01\n" for i in (1, 2, 3))
    (tmp_path / "raw.csv").write_text(text, encoding="utf-8")
    arm = ro.robot.RobotSetup(robot, np.zeros(6), np.zeros(6))
    found = interpret_tables(arm, [tmp_path / "raw.csv"], options=ro.data.TableOptions(units="deg,mm"))
    assert found.kind is position
    assert set(found.columns) == {"label", *(f"q{i}_deg" for i in range(1, 7)), "x_mm", "y_mm", "z_mm", "u95_mm"}


def test_the_label_is_the_column_that_tells_rows_apart(tmp_path: Path) -> None:
    """Not the one collection that all points are of, nor what kind of feature they are; else --key says which."""
    rows = "A,Main,P1,1,2,401,5,6\nA,Main,P2,3,4,402,6,7\n"
    found = read(write(tmp_path, HEAD.replace("Point,", "Collection,Group,Point,") + rows))
    assert found.columns["label"] == ["P1", "P2"]
    rows = "a,P1,1,2,401,5,6\nb,P2,3,4,402,6,7\n"
    with pytest.raises(ro.InputError, match="such as key 'Point'"):
        read(write(tmp_path, HEAD.replace("Point,", "Name,Point,") + rows))


def test_a_unit_in_a_column_is_that_of_a_table_with_a_row_a_coordinate(tmp_path: Path) -> None:
    rows = [f"P{i},Point,{axis},{i},{i}.{k},0.{k},mm" for i in (1, 2) for k, axis in enumerate("XYZ", 1)]
    found = read(write(tmp_path, "Name,Feature,Axis,Nominal,Measured,Deviation,Unit\n" + "\n".join(rows)))
    assert found.columns["y_mm"] == ["1.2", "2.2"]
    assert found.columns["label"] == ["P1", "P2"]


def test_a_merged_cell_with_the_unit_of_all_joints_stands_above_them(tmp_path: Path) -> None:
    book = openpyxl.Workbook()
    for row in (["Cell 4"], [], ["Pose", "Joint values [deg]"], ["", "A1", "A2"], [1, 10.5, 20.5], [2, 11.5, 21.5]):
        book.active.append(row)
    book.active.merge_cells("B3:C3")
    book.save(tmp_path / "joints.xlsx")
    assert read(tmp_path / "joints.xlsx").columns["q2_deg"] == ["20.5", "21.5"]


@pytest.mark.parametrize("remarks", [{}, {1: "again"}, {0: "new", 1: "again"}])
@pytest.mark.parametrize(("empty", "head", "label"), [(1, "Nr", ""), (0, "#", ""), (0, "Point", "Cell::P")])
def test_no_value_of_a_sheet_is_under_another_header_where_columns_are_empty(
    tmp_path: Path, empty: int, head: str, label: str, remarks: dict[int, str]
) -> None:
    book = openpyxl.Workbook()
    names = [*HEAD.strip().replace("Point", head).split(","), "Remark", "Operator"]
    book.active.append([*[None] * empty, *names[: -1 if label else None]])
    for i in range(2):
        cells = [f"{label}{i + 1}", 10.5 + i, 20.5, 401.5, 5.5, 6.5, remarks.get(i)]
        book.active.append([*[None] * empty, *cells])
    book.save(tmp_path / "raw.xlsx")
    columns = read(tmp_path / "raw.xlsx").columns
    assert {name: cells[1] for name, cells in columns.items() if name != "label"} == {
        "q1_deg": "11.5", "q2_deg": "20.5", "x_mm": "401.5", "y_mm": "5.5", "z_mm": "6.5",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("places", "poses", "meant"), [("AAABBBCCC", 9, 1), ("AAAAAAAAA", 9, 1), ("AAABBBCCC", 3, 1), ("ABCDEFGHA", 9, 0)]
)
def test_a_station_of_several_poses_is_a_session(tmp_path: Path, places: str, poses: int, meant: int) -> None:
    """Also where the same poses were measured from each."""
    rows = "".join(f"{place},{i % poses},2,401,5,{i}\n" for i, place in enumerate(places))
    for head in ("Station", "Aufstellung"):
        columns = read(write(tmp_path, HEAD.replace("Point", head) + rows)).columns
        assert list(columns.get("session", ())) == list(places) * meant


def test_joints_are_called_as_a_robot_table_names_them(tmp_path: Path) -> None:
    """A1 turns the arm on a track, E1, whatever A1 is elsewhere."""
    robot = replace(ARM, joint_types=("prismatic", "revolute"), joint_names=("E1", "A1"))
    ro.robot.write_robot(robot, tmp_path / "robot.toml")
    arm = read_arm(tmp_path / "robot.toml")
    path = write(tmp_path, "E1 [mm];A1 [deg];X [mm];Y [mm];Z [mm]\n1;2;401;5;6\n3;4;402;6;7\n")
    columns = interpret_tables(arm, [path]).columns
    assert set(columns) == {"q1_mm", "q2_deg", "x_mm", "y_mm", "z_mm"}


def test_quaternions_beside_an_external_axis_are_no_joints(tmp_path: Path) -> None:
    """Q0 to Q3 were, as A1 to A6 alone did not name all joints."""
    robot = ro.robot.Robot("on a rail", np.vstack([np.zeros((1, 5)), ARM.mdh]), ("prismatic", *ARM.joint_types))
    ro.robot.write_robot(robot, tmp_path / "robot.toml")
    axes = [f"A{i}" for i in range(1, robot.dof)]
    head = ",".join(["E1 [mm]", *(f"{axis} [deg]" for axis in axes), "X [mm],Y [mm],Z [mm],Q0,Q1,Q2,Q3"])
    path = write(
        tmp_path, "".join(f"{head}\n") + f"1{',2' * len(axes)},401,5,6,1,0,0,0\n3{',4' * len(axes)},402,6,7,0,1,0,0\n"
    )
    options = ro.data.TableOptions(quaternion="wxyz")
    columns = interpret_tables(read_arm(tmp_path / "robot.toml"), [path], options=options).columns
    assert set(columns) >= {"q1_mm", *(f"q{i}_deg" for i in range(2, robot.dof + 1)), "x_mm", "qw", "qx", "qy", "qz"}


@pytest.mark.parametrize("targets", [True, False])
def test_the_pose_that_a_controller_computes_is_a_target_and_no_measurement(tmp_path: Path, targets: bool) -> None:
    head = ",".join(f"{which}_TCP_pose_{i}" for which in ("target", "actual") for i in range(6))
    path = write(tmp_path, f"Name,{head}\nP1,0.4,0.5,0.6,0,0,1.5,9,9,9,9,9,9\nP2,0.5,0.5,0.6,0,0,1,9,9,9,9,9,9\n")
    raw = read_raw(path)
    if targets:
        columns = interpret(raw, ARM, pose, ro.data.TableOptions(), targets=True).columns
        assert columns["x_m"] == ["0.4", "0.5"]
        assert [float(columns["qz"][i]) for i in (0, 1)] == pytest.approx(np.sin([0.75, 0.5]))
    else:
        names = "Name,x_mm,y_mm,z_mm," + head
        found = read(write(tmp_path, f"{names}\nP1,1,2,3{',1' * 12}\nP2,2,2,3{',1' * 12}\n"))
        assert set(found.columns) == {"label", "x_mm", "y_mm", "z_mm"}


def test_messages_that_ros_prints_into_a_text_are_read_and_xml_is_named(tmp_path: Path) -> None:
    message = "header:\n  seq: {0}\nname: [two, one]\nposition: [{0}.5, 0.25]\nvelocity: []\neffort: []\n---\n"
    found = read(write(tmp_path, message.format(0) + message.format(1), "states.txt"), joints=("one", "two"))
    assert found.columns["q2_rad"] == ["0.5", "1.5"]
    with pytest.raises(ro.InputError, match=r"the file's name: found 'm.xml'"):
        read(write(tmp_path, "<?xml version='1.0'?><a/>", "m.xml"))


@pytest.mark.parametrize("name", ["raw.xls", "raw.xml"])
def test_a_workbook_that_excel_2003_saved_as_xml_is_read_by_its_content(tmp_path: Path, name: str) -> None:
    """Cells that are left out, and those behind merged ones, are at their places; a sheet is chosen by its numbers."""

    def row(*cells: str) -> str:
        return "<Row>" + "".join(cells) + "</Row>"

    def cell(text: str, stated: str = "", kind: str = "String") -> str:
        return f'<Cell{stated}><Data ss:Type="{kind}">{text}</Data></Cell>'

    numbers = [cell(text, kind="Number") for text in ("10", "20.5", "1", "2", "3e0")]
    rows = row(cell("Joints [deg]", ' ss:Index="2" ss:MergeAcross="1"'), cell("Tracker [mm]", ' ss:MergeAcross="2"'))
    rows += row(*map(cell, ["Point", "J1 [deg]", "J2 [deg]", "X [mm]", "Y [mm]", "Z [mm]"]))
    rows += row(cell("P1"), *numbers) + row('<Cell ss:StyleID="s1"/>', *numbers)
    rows += row(cell("11", ' ss:Index="2"', "Number"), *numbers[1:])
    sheets = [f'<Worksheet ss:Name="{title}"><Table>{own}</Table></Worksheet>'
              for title, own in (("Notes", row(cell("cell 4"))), ("A &amp; B", rows))]  # fmt: skip
    head = '<?xml version="1.0"?>\n<?mso-application progid="Excel.Sheet"?>\n'
    head += '<Workbook xmlns="urn:schemas-microsoft-com:office:spreadsheet" xmlns:ss="urn:schemas-microsoft-com:office:'
    path = write(tmp_path, f'{head}spreadsheet">{"".join(sheets)}</Workbook>', name)
    assert [row[:3] for row in read_grid(path).rows[2:]] == [
        ["P1", "10", "20.5"],
        ["", "10", "20.5"],
        ["", "11", "20.5"],
    ]
    found = read(path)
    assert found.columns["q2_deg"] == ["20.5"] * 3
    assert found.columns["z_mm"] == ["3e0"] * 3
    assert any("'A & B' of Notes, A & B" in note for note in found.notes)


def test_three_readings_side_by_side_are_rows_of_one_configuration(tmp_path: Path) -> None:
    """Those of several reflectors, which differ by more, are still refused."""
    head = "Point,J1 [deg],J2 [deg],X1 [mm],Y1 [mm],Z1 [mm],X2 [mm],Y2 [mm],Z2 [mm]\n"
    rows = "A,1,2,401,5,6,401.1,5,6\nB,3,4,402,96,7,402,96.2,7\nC,5,4,302,96,7,302,96.2,7\n"
    found = read(write(tmp_path, head + rows))
    assert found.columns["label"] == ["A/1", "A/2", "B/1", "B/2", "C/1", "C/2"]
    assert found.columns["x_mm"] == ["401", "401.1", "402", "402", "302", "302"]
    assert found.columns["q1_deg"] == ["1", "1", "3", "3", "5", "5"]
    data = ro.read_data(found.columns, ARM, {"position_mm": 0.05})
    assert data.configuration.tolist() == [0, 0, 1, 1, 2, 2]
    failed = read(write(tmp_path, head + rows.replace("402,96.2,7", ",,")))
    assert failed.columns["label"] == ["A/1", "A/2", "B/1", "C/1", "C/2"]
    with pytest.raises(ro.InputError, match="another point or reading"):
        read(write(tmp_path, head + rows.replace("401.1", "421.1")))


def test_rows_are_named_by_pose_and_reflector_unless_a_name_is_empty(tmp_path: Path) -> None:
    head = "Pose,Reflector,J1 [deg],J2 [deg],X [mm],Y [mm],Z [mm]\n"
    rows = "V1,A,1,2,401,5,6\nV1,B,1,2,402,6,7\nV1,A,1,2,401,5,7\n"
    assert read(write(tmp_path, head + rows)).labels == ["V1/A (row 1)", "V1/B", "V1/A (row 3)"]
    assert read(write(tmp_path, head + rows.replace("V1,B", ",B"))).labels == ["1", "2", "3"]


def test_units_in_cells_separated_by_tabs(tmp_path: Path) -> None:
    """Blanks before the units parted more numbers than tabs."""
    rows = "".join(f"{i}\t{i + 0.5}°\t-{i}.25°\t{400 + i}.125 mm\t{i}.5 mm\t7.125 mm\n" for i in range(1, 5))
    found = read(write(tmp_path, "Nr.\tAxis 1\tAxis 2\tX\tY\tZ\n" + rows, "raw.txt"))
    assert found.columns["q1_deg"] == ["1.5", "2.5", "3.5", "4.5"]
    assert found.columns["z_mm"] == ["7.125"] * 4


def test_an_external_axis_is_the_joint_that_slides(tmp_path: Path) -> None:
    """A1 was read as the rail, and no option helped."""
    types = ("prismatic", "revolute", "revolute")
    arm = ro.robot.Robot("on a rail", np.vstack([np.zeros((1, 5)), ARM.mdh]), joint_types=types)
    head = "Point,A1 [deg],A2 [deg],E1 [mm],X [mm],Y [mm],Z [mm]\n"
    found = read(write(tmp_path, head + "P1,1,2,2366.5,401,5,6\nP2,3,4,1200,402,6,7\n"), robot=arm)
    assert [found.columns[name] for name in ("q1_mm", "q2_deg", "q3_deg")] == [
        ["2366.5", "1200"],
        ["1", "3"],
        ["2", "4"],
    ]
    programs = {
        "raw.dat": "DECL E6AXIS XP1={A1 1.5,A2 -2,E1 2366.4,E2 0.0}\nDECL E6AXIS XP2={A1 3.5,A2 -4,E1 120,E2 0.0}\n",
        "raw.mod": "CONST jointtarget P1:=[[1.5,-2],[2366.4,9E+09]];\nCONST jointtarget P2:=[[3.5,-4],[120,9E9]];\n",
    }
    for name, program in programs.items():
        joints = read(write(tmp_path, program, name), robot=arm)
        assert [joints.columns[each] for each in ("label", "q1_mm", "q3_deg")] == [
            ["P1", "P2"],
            ["2366.4", "120"],
            ["-2", "-4"],
        ]


def test_equal_rows_of_a_spreadsheet_are_as_many_as_they_were(tmp_path: Path) -> None:
    """OpenDocument states equal rows once, with their number; empty ones to the end of the sheet too."""

    def row(repeated: int, *cells: str) -> str:
        inside = "".join(f"<table:table-cell><text:p>{cell}</text:p></table:table-cell>" for cell in cells)
        return f'<table:table-row table:number-rows-repeated="{repeated}">{inside}</table:table-row>'

    head = ["q1_deg", "q2_deg", "x_mm", "y_mm", "z_mm"]
    rows = row(1, *head) + row(3, "10", "20", "1", "2", "3") + row(1, "11", "20", "1", "2", "4") + row(1048571, "")
    with ZipFile(tmp_path / "raw.ods", "w") as archive:
        archive.writestr("content.xml", f'<office:body><table:table table:name="A">{rows}</table:table></office:body>')
    assert [row[0] for row in read_grid(tmp_path / "raw.ods").rows] == ["q1_deg", "10", "10", "10", "11"]


def test_a_log_may_be_a_table_with_temperatures_in_degrees_celsius(tmp_path: Path) -> None:
    """A file .log is tried as ROS messages first; ``[C]`` is degC, as no other unit is called so."""
    path = tmp_path / "controller.log"
    path.write_text("# cell 4\nLabel,A1 (deg),A2 (deg),X [mm],Temperature [C]\nP1,10,-20,5,21.5\nP2,11,-21,6,22.5\n")
    table = read_raw(path, None)
    assert list(table.columns["A1 (deg)"]) == ["10", "11"]
    assert split("Temperature [C]") == ("Temperature", "degC")
