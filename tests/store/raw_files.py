"""One clean table in the many shapes in which instruments, controllers and people write it."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import openpyxl
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from rpim_opt.robot import Robot, forward_kinematics
from rpim_opt.robot.kinematics import numeric_frame
from tests.simulate import ARM

COUNT = 36
APART = 60
"""Configurations of the table that judges, which no calibration sees."""
NOISE = 0.02
TURNED = 5e-5
"""Of an instrument, along and about each axis [mm, rad]."""
UR = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")


def off_its_drawing(rng: np.random.Generator) -> Robot:
    """Return `ARM` as somebody built it: off its drawing by 0.5 mm and 0.5 mrad."""
    mdh = ARM.mdh.copy()
    mdh[:, :4] += 5e-4 * rng.normal(size=(6, 4))
    return replace(ARM, mdh=mdh)


def clean() -> tuple[np.ndarray, np.ndarray]:
    """Return joints (N, 6) [deg] and poses (N, 4, 4) [mm] as an instrument sees them, with few decimals."""
    rng = np.random.default_rng(7)
    built = off_its_drawing(rng)
    q = rng.uniform(-120, 120, (COUNT + APART, 6)).round(3)
    base = numeric_frame([1.8, -0.7, 0.35, 0.1, -0.2, 1.1])
    tool = numeric_frame([0.03, -0.02, 0.06, 0.3, 0.2, -0.5])
    T = base @ forward_kinematics(built, np.radians(q)) @ tool
    T[:, :3, 3] = (1e3 * T[:, :3, 3] + NOISE * rng.normal(size=(len(q), 3))).round(4)
    T[:, :3, :3] @= Rotation.from_rotvec(TURNED * rng.normal(size=(len(q), 3))).as_matrix()
    return q, T


EVERY_Q, EVERY_T = clean()
LABELS = [f"P{i + 1}" for i in range(COUNT)]
Q, T = EVERY_Q[:COUNT], EVERY_T[:COUNT]
P = T[:, :3, 3]
WXYZ = Rotation.from_matrix(T[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
Rows = list[list[str]]


def cells(values: np.ndarray, decimals: int | None = None) -> Rows:
    if decimals is None:
        return [[repr(float(v)) for v in row] for row in values]
    return [[f"{v:.{decimals}f}" for v in row] for row in values]


def beside(*parts: Rows) -> Rows:
    return [[cell for part in parts for cell in part[i]] for i in range(len(parts[0]))]


GERMAN = str.maketrans(",.", ".,")
NAMED = [[label] for label in LABELS]
JOINTS, POINTS = cells(Q, 3), cells(P, 4)
HEAD = ["Point", *(f"J{i} [deg]" for i in range(1, 7)), "X [mm]", "Y [mm]", "Z [mm]"]
ROWS = beside(NAMED, JOINTS, POINTS)


def text(header: Sequence[Sequence[str]], rows: Rows, mark: str = ",", comma: bool = False) -> str:
    lines = [mark.join(line) for line in header]
    for row in rows:
        lines.append(mark.join(cell.replace(".", ",") if comma else cell for cell in row))
    return "\n".join(lines) + "\n"


def joint_names(pattern: str, first: int = 1) -> list[str]:
    return [pattern.format(i) for i in range(first, first + 6)]


def matrix_cells(transposed: bool = False) -> Rows:
    M = np.swapaxes(T, 1, 2) if transposed else T
    return cells(M.reshape(COUNT, 16))


def write(folder: Path, name: str, content: str, encoding: str = "utf-8") -> Path:
    path = folder / name
    path.write_bytes(content.encode(encoding))
    return path


def book(folder: Path, sheets: dict[str, Rows], numbers: bool = True, merged: Sequence[str] = ()) -> Path:
    """Write an Excel workbook; cells that are numbers are written as numbers."""
    file = openpyxl.Workbook()
    file.remove(file.worksheets[0])
    for name, rows in sheets.items():
        sheet = file.create_sheet(name)
        for i, row in enumerate(rows, start=1):
            for j, cell in enumerate(row, start=1):
                value: object = cell or None
                if numbers and i > 1:
                    with contextlib.suppress(ValueError):
                        value = float(cell)
                sheet.cell(i, j, value)
        for area in merged:
            sheet.merge_cells(area)
    path = folder / "raw.xlsx"
    file.save(path)
    return path


def clocked(folder: Path, rate: float, apart: float, shift: float = 0.0) -> list[Path]:
    """Write joints at a rate [1/s] while the arm rests at each place, and points with times of another clock."""
    lines = []
    for i, row in enumerate(ROWS):
        lines += [[f"{i + k / rate:.4f}", *row[1:7]] for k in range(int(0.1 * rate))]
    joints = write(folder, "joints.csv", text([["time [s]", *HEAD[1:7]]], lines))
    moments = [f"{1e3 * (i + 0.05 + apart + shift):.2f}" for i in range(COUNT)]
    rows = [[name[0], moment, *point] for name, moment, point in zip(NAMED, moments, POINTS, strict=True)]
    return [joints, write(folder, "points.csv", text([["Point", "Timestamp [ms]", *HEAD[7:]]], rows))]


def parquet(folder: Path) -> Path:
    columns = [LABELS, *np.hstack([Q, P]).T]
    path = folder / "raw.parquet"
    pq.write_table(pa.table(dict(zip(HEAD, columns, strict=True))), path)
    return path


def of_two_kinds(folder: Path) -> list[Path]:
    """Write joints as the controller's text and points as a workbook."""
    joints = write(
        folder, "program.txt", text([["Punkt", *joint_names("A{} [deg]")]], beside(NAMED, JOINTS), "\t", True)
    )
    return [joints, book(folder, {"Messung": [["Punkt", *HEAD[7:]], *beside(NAMED, POINTS)]})]


Options = dict[str, str]
Shape = tuple[Callable[[Path], Path | list[Path]], Options, str]
"""What writes the files, the options of ``rpim-opt new``, and what is measured."""


def one(content: str, name: str = "raw.csv", encoding: str = "utf-8", kind: str = "position", **options: str) -> Shape:
    return lambda folder: write(folder, name, content, encoding), options, kind


def two(first: str, second: str, kind: str = "position", **options: str) -> Shape:
    return lambda folder: [write(folder, "first.csv", first), write(folder, "second.csv", second)], options, kind


def excel(sheets: dict[str, Rows], numbers: bool = True, merged: Sequence[str] = (), **options: str) -> Shape:
    return lambda folder: book(folder, sheets, numbers, merged), options, "position"


GROUPS = ["", "Joint angles", *[""] * 5, "Position", "", ""]
BARE = ["Name", *joint_names("A{}"), "X", "Y", "Z"]
UNITS_LINE = ["", *["deg"] * 6, *["mm"] * 3]
PREAMBLE = "Export of cell 7\nOperator;Smith\nDate;2024-05-02;12:30\n\n"
STD = [["0.018", "0.020", "0.022"]] * COUNT
U95 = [["0.036", "0.040", "0.044"]] * COUNT
WANTED = cells(P + 0.7, 4)
DEVIATIONS = cells(np.full((COUNT, 3), -0.7), 4)
METRES = cells(P / 1e3, 7)
RADIANS = cells(np.radians(Q))
ORDER = sorted(range(6), key=lambda i: UR[i])
TIMES = [[f"{1700000000000000000 + i}"] for i in range(COUNT)]
SHUFFLED = [(5 * i) % COUNT for i in range(COUNT)]
POSE_HEAD = HEAD[:10]

RAW: dict[str, Shape] = {
    "comma": one(text([HEAD], ROWS)),
    "semicolon and decimal comma": one(text([HEAD], ROWS, ";", comma=True)),
    "tab": one(text([HEAD], ROWS, "\t"), "raw.txt"),
    "tab and decimal comma": one(text([HEAD], ROWS, "\t", comma=True), "raw.tsv"),
    "bars": one(text([HEAD], ROWS, "|")),
    "columns of fixed width": one(
        "".join(f"{'  '.join(f'{c:>14}' for c in row)}\n" for row in [[h.replace(" ", "_") for h in HEAD], *ROWS]),
        "raw.dat",
    ),
    "byte order mark": one(text([HEAD], ROWS), encoding="utf-8-sig"),
    "UTF-16": one(text([HEAD], ROWS, "\t"), encoding="utf-16"),
    "UTF-16 without a mark": one(text([HEAD], ROWS, ";"), encoding="utf-16-le"),
    "Latin-1 with degrees": one(
        text([[h.replace("[deg]", "[°]").replace("Point", "Meßpunkt Nr") for h in HEAD]], ROWS, ";"), encoding="latin-1"
    ),
    "line ends of Windows": one(text([HEAD], ROWS).replace("\n", "\r\n")),
    "line ends of old Macs": one(text([HEAD], ROWS).replace("\n", "\r")),
    "quoted cells": one(text([HEAD], ROWS).replace(",", '","').replace("\n", '"\n"')[:-1].join(['"', ""])),
    "quoted decimal commas": one(text([HEAD], [[f'"{c.replace(".", ",")}"' for c in row] for row in ROWS])),
    "blanks behind commas": one(text([HEAD], ROWS).replace(",", ", ")),
    "merged header": one(text([GROUPS, BARE], ROWS, ";"), units="deg,mm"),
    "header with a line of units": one(text([BARE, UNITS_LINE], ROWS, ";", comma=True)),
    "three lines of header": one(text([GROUPS, BARE, [f"[{u}]" if u else "" for u in UNITS_LINE]], ROWS, ";")),
    "numbered joints below a group": one(
        text([["", "Joint [deg]", *[""] * 5, "Position [mm]", "", ""], ["No", *"123456", "X", "Y", "Z"]], ROWS, ";")
    ),
    "preamble": one(PREAMBLE + text([HEAD], ROWS, ";")),
    "comments": one("# made by a script\n" + text([["# " + HEAD[0], *HEAD[1:]]], ROWS)),
    "footer and means": one(
        text([HEAD], ROWS) + ",".join(["Mean", *["1.5"] * 9]) + "\nEnd of export\n"
    ),
    "header again on every page": one(text([HEAD], ROWS[:5]) + text([HEAD], ROWS[5:])),
    "units in the cells": one(
        text([["Point", *joint_names("J{}"), "X", "Y", "Z"]],
             beside(NAMED, [[f"{c} deg" for c in r] for r in JOINTS], [[f"{c} mm" for c in r] for r in POINTS])),
    ),
    "thousands": one(text([HEAD], beside(NAMED, JOINTS, [[f"{v:,.4f}" for v in row] for row in P]), ";")),
    "thousands of Germans": one(
        text([HEAD], beside(NAMED, [[f"{v:,.4f}".translate(GERMAN) for v in row] for row in np.hstack([Q, P])]), ";")
    ),
    "no header": one(text([], ROWS), columns="label,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,x_mm,y_mm,z_mm"),
    "beam lost": one(text([HEAD], [*ROWS[:4], ["lost", *JOINTS[0], "-", "-", "-"], *ROWS[4:]])),
    "inches": one(
        text([[*HEAD[:7], "X [in]", "Y [in]", "Z [in]"]], beside(NAMED, JOINTS, cells(P / 25.4))),
    ),
    "radians and metres": one(
        text([["Point", *joint_names("joint_{}"), "x", "y", "z"]], beside(NAMED, RADIANS, METRES)), units="rad,m"
    ),
    "nominal, measured, deviation": one(
        text([[*HEAD[:7], *(f"{w} {a} [mm]" for w in ("Nominal", "Measured", "Dev") for a in "XYZ")]],
             beside(NAMED, JOINTS, WANTED, POINTS, DEVIATIONS)),
    ),
    "Parquet": (parquet, {}, "position"),
    "Excel": excel({"Sheet1": [HEAD, *ROWS]}),
    "Excel, second sheet by name": excel({"Notes": [["warm", "up"]], "Points": [HEAD, *ROWS]}, sheet="Points"),
    "Excel, second sheet by number": excel({"Notes": [["warm", "up"]], "Points": [HEAD, *ROWS]}, sheet="2"),
    "Excel, merged header": excel(
        {"Points": [GROUPS, BARE, UNITS_LINE, *ROWS]}, merged=["B1:G1", "H1:J1"]
    ),
    "Excel, texts with decimal commas": excel(
        {"Points": [HEAD, *([cell.replace(".", ",") for cell in row] for row in ROWS)]}, numbers=False
    ),
    "SpatialAnalyzer": one(
        text([["Point Name", *HEAD[1:], *(f"U(95) {a} [mm]" for a in "XYZ"), "RMS"]],
             beside(ROWS, U95, [["0.004"]] * COUNT)),
    ),
    "SpatialAnalyzer, ASCII": one(
        "// Version 2023\n// Frame: World\n// Target J1 J2 J3 J4 J5 J6 X Y Z\n" + text([], ROWS, " "), "raw.txt",
        units="deg,mm",
    ),
    "Leica": one(
        text([["Point ID", *HEAD[1:], *(f"Std {a} [mm]" for a in "XYZ"), "Timestamp"]],
             beside(ROWS, STD, [["2024-05-02 12:30:01"]] * COUNT), ";")
    ),
    "RoboDK": one(text([[*joint_names("J{}"), "X", "Y", "Z"]], beside(JOINTS, POINTS)), units="deg,mm"),
    "KUKA": one(
        text([["Name", *joint_names("A{} [deg]"), "X [mm]", "Y [mm]", "Z [mm]", "A [deg]", "B [deg]", "C [deg]"]],
             beside(NAMED, JOINTS, POINTS, cells(Rotation.from_matrix(T[:, :3, :3]).as_euler("ZYX", degrees=True)))),
        kind="pose",
    ),
    "FANUC": one(
        text([["Name", *joint_names("J{} [deg]"), *(f"{a} [mm]" for a in "XYZ"), *(f"{a} [deg]" for a in "WPR")]],
             beside(NAMED, JOINTS, POINTS, cells(Rotation.from_matrix(T[:, :3, :3]).as_euler("xyz", degrees=True)))),
        kind="pose",
    ),
    "ABB": one(
        text([["Name", *joint_names("rax_{}"), "x", "y", "z", "q1", "q2", "q3", "q4"]],
             beside(NAMED, JOINTS, POINTS, cells(WXYZ))), kind="pose", units="deg,mm",
    ),
    "Universal Robots, RTDE": one(
        text([["timestamp", *joint_names("target_q_{}", 0), *joint_names("actual_q_{}", 0), *HEAD[7:]]],
             beside(TIMES, cells(np.radians(Q) + 1e-3), RADIANS, POINTS)),
    ),
    "ROS, rostopic": one(
        text([["%time", "field.header.seq", *joint_names("field.name{}", 0), *joint_names("field.position{}", 0),
               *joint_names("field.effort{}", 0),
               "field.pose.position.x", "field.pose.position.y", "field.pose.position.z"]],
             beside(TIMES, [["7"]] * COUNT, [[f"{UR[i]}_joint" for i in ORDER]] * COUNT,
                    [[row[i] for i in ORDER] for row in RADIANS], [["1.5"] * 6] * COUNT, METRES)),
    ),
    "ROS, by path": one(
        text([["__time", *(f"/joint_states/{UR[i]}_joint/position" for i in ORDER),
               *(f"/joint_states/{UR[i]}_joint/velocity" for i in ORDER),
               *(f"/tracker/pose/position/{a}" for a in "xyz")]],
             beside(TIMES, [[row[i] for i in ORDER] for row in RADIANS], cells(0 * Q), METRES)),
    ),
    "matrix m00 to m33": one(
        text([[*HEAD[:7], *(f"m{i}{j}" for i in range(4) for j in range(4))]], beside(NAMED, JOINTS, matrix_cells())),
        kind="pose", units="mm",
    ),
    "matrix T11 to T44, by columns": one(
        text([[*HEAD[:7], *(f"T{i}{j}" for i in range(1, 5) for j in range(1, 5))]],
             beside(NAMED, JOINTS, matrix_cells(transposed=True))), kind="pose", units="mm",
    ),
    "matrix of 16 columns": one(
        text([[*HEAD[:7], *(f"pose_{i}" for i in range(16))]], beside(NAMED, JOINTS, matrix_cells())),
        kind="pose", units="mm",
    ),
    "quaternion Q0 to Q3, w first": one(
        text([[*POSE_HEAD, "Q0", "Q1", "Q2", "Q3"]], beside(ROWS, cells(WXYZ))), kind="pose"
    ),
    "quaternion Q0 to Q3, w last": one(
        text([[*POSE_HEAD, "Q0", "Q1", "Q2", "Q3"]], beside(ROWS, cells(WXYZ[:, [1, 2, 3, 0]]))), kind="pose"
    ),
    "quaternion of named components": one(
        text([[*POSE_HEAD, *(f"orientation.{c}" for c in "xyzw")]], beside(ROWS, cells(WXYZ[:, [1, 2, 3, 0]]))),
        kind="pose",
    ),
    "rotation vector": one(
        text([[*POSE_HEAD, "rx [rad]", "ry [rad]", "rz [rad]"]],
             beside(ROWS, cells(Rotation.from_matrix(T[:, :3, :3]).as_rotvec()))), kind="pose", rotation="vector",
    ),
    "joints and points by label": two(
        text([HEAD[:7]], beside(NAMED, JOINTS)),
        text([["Point Name", *HEAD[7:]]], [ROWS[i][:1] + POINTS[i] for i in SHUFFLED], ";", comma=True),
    ),
    "joints and points by a stated key": two(
        text([["stamp", "op", *HEAD[1:7]]], beside(TIMES, [["a"]] * COUNT, JOINTS)),
        text([["Stamp", "op", "X [mm]", "Y [mm]", "Z [mm]"]], beside(TIMES, [["b"]] * COUNT, POINTS)), key="stamp",
    ),
    "joints and points by row": two(
        text([HEAD[1:7]], JOINTS), text([["X [mm]", "Y [mm]", "Z [mm]"]], POINTS), key="row"
    ),
    "a controller's text and a workbook": (of_two_kinds, {}, "position"),
    "joints and points of two clocks": (
        lambda folder: clocked(folder, rate=100.0, apart=0.003), {"time-tolerance": "0.006"}, "position"
    ),
    "several files below each other": two(
        text([HEAD], ROWS[:7]), text([[*HEAD[:7], "X [m]", "Y [m]", "Z [m]"]], beside(NAMED, JOINTS, METRES)[7:], ";")
    ),
}  # fmt: skip
