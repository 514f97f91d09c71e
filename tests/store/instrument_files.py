# ruff: noqa: E501
"""The clean table of `raw_files` as instruments, controllers and drivers export it, beyond tables with a plain header."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import openpyxl
from scipy.spatial.transform import Rotation

from tests.store.raw_files import (
    BARE,
    COUNT,
    HEAD,
    JOINTS,
    LABELS,
    METRES,
    NAMED,
    ORDER,
    POINTS,
    RADIANS,
    ROWS,
    UR,
    WANTED,
    WXYZ,
    Options,
    P,
    T,
    beside,
    book,
    cells,
    excel,
    joint_names,
    one,
    text,
    two,
    write,
)

Files = Path | list[Path]
Shape = tuple[Callable[[Path], Files], Options, str]
LENGTH = np.linalg.norm(P, axis=1)
AZIMUTH = np.degrees(np.arctan2(P[:, 1], P[:, 0]))
ELEVATION = np.degrees(np.arcsin(P[:, 2] / LENGTH))
POLAR = cells(np.column_stack([AZIMUTH, ELEVATION, LENGTH]))
ZENITH = cells(np.column_stack([AZIMUTH, 90 - ELEVATION, LENGTH]))
UR_JOINTS = [f"{name}_joint" for name in UR]
LONG_HEAD = [*HEAD[:7], "Axis", "Value [mm]"]
LONG = [[*row[:7], axis, row[7 + i]] for row in ROWS for i, axis in enumerate("XYZ")]
TRIPLES = [[f"[{', '.join(row)}]"] for row in POINTS]
POINT_TABLE = text([["Point", *HEAD[7:]]], beside(NAMED, POINTS))


def lists(values: np.ndarray) -> list[list[str]]:
    return [[f"[{', '.join(row)}]"] for row in cells(values.reshape(len(values), -1))]


def many(*files: tuple[str, str], kind: str = "position", **options: str) -> Shape:
    """Return a shape of several files, name and content each."""
    return lambda folder: [write(folder, name, content) for name, content in files], options, kind


def program(name: str, content: str, **options: str) -> Shape:
    """Return a controller's program with the joints, and a table of the points."""
    return many((name, content), ("points.csv", POINT_TABLE), **options)


def krl() -> str:
    lines = ["&ACCESS RVP", "&REL 1", "DEFDAT CALIB PUBLIC", "EXT BAS (BAS_COMMAND :IN,REAL :IN )"]
    for label, q in zip(LABELS, JOINTS, strict=True):
        axes = ",".join(f"A{i} {v}" for i, v in enumerate(q, start=1))
        lines.append(f"DECL E6AXIS X{label}={{{axes},E1 0.0,E2 0.0,E3 0.0,E4 0.0,E5 0.0,E6 0.0}}")
        lines.append(f'DECL FDAT F{label}={{TOOL_NO 1,BASE_NO 0,IPO_FRAME #BASE,POINT2[] " "}}')
    return "\n".join([*lines, "ENDDAT"])


def rapid() -> str:
    lines = ["MODULE Calibration", "  ! joint targets"]
    for label, q in zip(LABELS, JOINTS, strict=True):
        axes = ",".join(q)
        lines.append(f"  CONST jointtarget {label}:=[[{axes}],[9E+09,9E+09,9E+09,9E+09,9E+09,9E+09]];")
    moves = [f"    MoveAbsJ {label},v100,fine,tool0;" for label in LABELS]
    return "\n".join([*lines, "  PROC main()", *moves, "  ENDPROC", "ENDMODULE"])


def fanuc() -> str:
    lines = ["/PROG  CALIB", "/ATTR", 'COMMENT\t\t= "";', "/MN", "   1:J P[1] 100% FINE    ;", "/POS"]
    for i, (label, q) in enumerate(zip(LABELS, JOINTS, strict=True), start=1):
        axes = [f"\tJ{j}= {float(v):10.3f} deg" for j, v in enumerate(q, start=1)]
        lines += [f'P[{i}:"{label}"]{{', "   GP1:", "\tUF : 0, UT : 1,\t"]
        lines += [",".join(axes[:3]) + ",", ",".join(axes[3:]), "};"]
    return "\n".join([*lines, "/END"])


def urscript() -> str:
    lines = ["def calibration():", "  set_tcp(p[0.0,0.0,0.1,0.0,0.0,0.0])"]
    for label, q in zip(LABELS, RADIANS, strict=True):
        lines += [f"  # {label}", f"  movej([{', '.join(q)}], a=1.4, v=1.05)", "  sleep(1.0)"]
    return "\n".join([*lines, "end"])


def json_lines() -> str:
    rows = [
        {"name": label, "joints_deg": [float(v) for v in q], "measured": {"x_mm": float(p[0]), "y_mm": float(p[1]), "z_mm": float(p[2])}}
        for label, q, p in zip(LABELS, JOINTS, POINTS, strict=True)
    ]  # fmt: skip
    return "".join(json.dumps(row) + "\n" for row in rows)


def grouped_excel(head: list[str], above: dict[int, str], merged: list[str]) -> Shape:
    group = [above.get(i, "") for i in range(10)]
    return lambda folder: book(folder, {"Data": [group, head, *ROWS]}, merged=merged), {}, "position"


JOINT_HEAD = ["Point", *joint_names("Joint {} [deg]"), "X [mm]", "Y [mm]", "Z [mm]"]
ACHSE_HEAD = ["Punkt", *joint_names("Achse {} (°)"), "X (mm)", "Y (mm)", "Z (mm)"]
MIXED_HEAD = ["Point", *joint_names("q{}"), "x", "y", "z", "roll", "pitch", "yaw"]
RPY = cells(Rotation.from_matrix(T[:, :3, :3]).as_euler("xyz", degrees=True))

REFUSED_THOUGH_RIGHT: dict[str, Shape] = {
    "tabs, Joint 1": one(text([JOINT_HEAD], ROWS, "\t"), "raw.txt"),
    "tabs, Achse 1, decimal commas": one(text([ACHSE_HEAD], ROWS, "\t", comma=True), "raw.txt"),
    "tabs, a label of two words": one(text([JOINT_HEAD], [[f"Point {r[0][1:]}", *r[1:]] for r in ROWS], "\t"), "raw.txt"),
    "FARO-like": one(
        "FARO CAM2 Measure 10\nPart: cell 7\nDate: 02.05.2024 12:30\n\n" + text([JOINT_HEAD], ROWS, "\t"), "raw.txt"
    ),
    "UTF-16, Joint 1": one(text([JOINT_HEAD], ROWS, "\t"), "raw.txt", encoding="utf-16"),
    "blanks, Joint 1": one(text([JOINT_HEAD], ROWS, " "), "raw.txt"),
    "prefix robot1_": one(text([["Point", *joint_names("robot1_joint_{} [deg]"), *HEAD[7:]]], ROWS)),
    "prefix with a slash": one(text([["Point", *joint_names("cell/r1/q{} [deg]"), *HEAD[7:]]], ROWS)),
    "a ROS driver's names": one(
        text([["Point", *UR_JOINTS, "x [m]", "y [m]", "z [m]"]], beside(NAMED, RADIANS, METRES)), units="rad"
    ),
    "a ROS driver's names with a prefix": one(
        text([["Point", *(f"left_{n}" for n in UR_JOINTS), "x [m]", "y [m]", "z [m]"]], beside(NAMED, RADIANS, METRES)),
        units="rad",
    ),
    "Excel, group above X Y Z alone": grouped_excel(
        ["Name", *joint_names("J{} [deg]"), "X", "Y", "Z"], {7: "Measured [mm]"}, ["H1:J1"]
    ),
    "Excel, names merged downwards beside a group": (
        lambda folder: book(
            folder,
            {"Data": [["Name", *joint_names("J{} [deg]"), "Position [mm]", "", ""], [*[""] * 7, "X", "Y", "Z"], *ROWS]},
            merged=["H1:J1", *(f"{c}1:{c}2" for c in "ABCDEFG")],
        ),
        {},
        "position",
    ),
    "dashes for a missing reading": one(
        text([HEAD], [*ROWS[:4], ["lost", *JOINTS[0], "---", "---", "---"], *ROWS[4:]])
    ),
    "azimuth, elevation, distance": one(
        text([[*HEAD[:7], "Azimuth [deg]", "Elevation [deg]", "Distance [mm]"]], beside(NAMED, JOINTS, POLAR))
    ),
    "azimuth, zenith, slope distance": one(
        text([[*HEAD[:7], "Az [deg]", "Zenith angle [deg]", "D [mm]"]], beside(NAMED, JOINTS, ZENITH))
    ),
    "one row a coordinate": one(text([LONG_HEAD], LONG)),
    "one row a coordinate, joints in a file of their own": many(
        ("joints.csv", text([HEAD[:7]], beside(NAMED, JOINTS))),
        ("points.csv", text([["Point", "Axis", "Nominal [mm]", "Measured [mm]"]],
                            [[row[0], axis, "0", row[7 + i]] for row in ROWS for i, axis in enumerate("XYZ")], ";")),
    ),
    "x, y, z in one cell": one(text([[*HEAD[:7], "position [mm]"]], beside(NAMED, JOINTS, TRIPLES), ";")),
    "x, y, z in one cell without quotes": one(text([[*HEAD[:7], "position [mm]"]], beside(NAMED, JOINTS, TRIPLES))),
    "joints and position in one cell each": one(
        text([["id", "joints [deg]", "position [mm]"]],
             beside(NAMED, [[f"({' '.join(row)})"] for row in JOINTS], [[f"({' '.join(row)})"] for row in POINTS]))
    ),
    "a rotation matrix in one cell": one(
        text([[*HEAD, "rotation"]], beside(ROWS, lists(T[:, :3, :3])), ";"), kind="pose"
    ),
    "a transform in one cell": one(
        text([[*HEAD[:7], "pose"]], beside(NAMED, JOINTS, lists(T)), ";"), kind="pose", units="mm"
    ),
    "JSON lines": one(json_lines(), "raw.jsonl"),
    "KRL .dat": program("calib.dat", krl()),
    "RAPID .mod": program("calib.mod", rapid()),
    "FANUC .LS": program("calib.ls", fanuc()),
    "URScript": program("calib.script", urscript(), key="row"),
    "joints in rad, angles in deg": one(
        text([MIXED_HEAD], beside(NAMED, RADIANS, POINTS, RPY)), kind="pose", units="q=rad,deg,mm"
    ),
    "rotation vectors without units": one(
        text([["Point", *joint_names("q{}"), "x", "y", "z", "rx", "ry", "rz"]],
             beside(NAMED, RADIANS, METRES, cells(Rotation.from_matrix(T[:, :3, :3]).as_rotvec()))),
        kind="pose", units="rad,m", rotation="vector",
    ),
    "joints and rotation vectors in two files": two(
        text([HEAD[:7]], beside(NAMED, JOINTS)),
        text([["Point", *HEAD[7:], "rx [rad]", "ry [rad]", "rz [rad]"]],
             beside(NAMED, POINTS, cells(Rotation.from_matrix(T[:, :3, :3]).as_rotvec()))),
        kind="pose", rotation="vector",
    ),
    "intrinsic Euler angles": one(
        text([[*HEAD, "rx [deg]", "ry [deg]", "rz [deg]"]],
             beside(ROWS, cells(Rotation.from_matrix(T[:, :3, :3]).as_euler("XYZ", degrees=True)))),
        kind="pose", rotation="intrinsic xyz",
    ),
}  # fmt: skip
"""What issue trackers call "refused though right": the files of users whom the first table turned away."""


# --- twenty further ones, each as the program that is named writes it ----------------------------------------------


def rostopic_yaml() -> str:
    documents = []
    for q, p in zip(RADIANS, METRES, strict=True):
        documents.append(
            "header:\n  seq: 7\n  stamp:\n    secs: 1700000000\n    nsecs: 25\n  frame_id: ''\n"
            f"name: [{', '.join(UR_JOINTS)}]\nposition: [{', '.join(q)}]\nvelocity: []\n"
            f"point:\n  x: {p[0]}\n  y: {p[1]}\n  z: {p[2]}\n---\n"
        )
    return "".join(documents)


def pcdmis() -> list[list[str]]:
    return [
        [label, axis, "0.0000", f"{p[i]}", "0.1", "-0.1", p[i], "0"]
        for label, p in zip(LABELS, POINTS, strict=True)
        for i, axis in enumerate(("X", "Y", "Z"))
    ]


def vicon() -> str:
    head = "Trajectories\n100\n,,Calib:marker1,,\nFrame,Sub Frame,X,Y,Z\n,,mm,mm,mm\n"
    return head + text([], [[str(i + 1), "0", *p] for i, p in enumerate(POINTS)])


def optitrack() -> str:
    head = [
        "Format Version,1.23,Take Name,calib,Capture Frame Rate,120.0,Rotation Type,Quaternion,Length Units,Millimeters",
        "",
        ",,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body",
        ",,tool,tool,tool,tool,tool,tool,tool",
        ",,1,1,1,1,1,1,1",
        ",,Rotation,Rotation,Rotation,Rotation,Position,Position,Position",
        "Frame,Time (Seconds),X,Y,Z,W,X,Y,Z",
    ]
    xyzw = cells(WXYZ[:, [1, 2, 3, 0]])
    rows = [[str(i), f"{i / 120:.6f}", *xyzw[i], *POINTS[i]] for i in range(COUNT)]
    return "\n".join(head) + "\n" + text([], rows)


def polaris() -> list[list[str]]:
    return [
        ["1", "Port 1", str(i), "OK", *q, *p, "0.12"] for i, (q, p) in enumerate(zip(cells(WXYZ), POINTS, strict=True))
    ]


def titled(folder: Path) -> Path:
    """A workbook as people make it: a title, a date, an empty column and line, units in a line of their own."""
    file = openpyxl.Workbook()
    sheet = file.active
    assert sheet is not None
    sheet["B2"] = "Calibration of cell 7"
    sheet["B3"] = "Date"
    sheet["C3"] = "2024-05-02"
    for j, (name, unit) in enumerate(
        zip(["No.", *joint_names("θ{}"), "X", "Y", "Z"], ["", *["[°]"] * 6, *["[mm]"] * 3], strict=True)
    ):
        sheet.cell(5, j + 2, name)
        sheet.cell(6, j + 2, unit or None)
    for i, row in enumerate(ROWS):
        for j, cell in enumerate(row):
            sheet.cell(7 + i, j + 2, cell if j == 0 else float(cell))
    path = folder / "raw.xlsx"
    file.save(path)
    return path


SWISS = [[cell if len(cell) < 8 else f"{float(cell):,.4f}".replace(",", "'") for cell in row] for row in POINTS]
KUKA_ABC = cells(Rotation.from_matrix(T[:, :3, :3]).as_euler("ZYX", degrees=True))
OAT = cells(Rotation.from_matrix(T[:, :3, :3]).as_euler("ZYZ", degrees=True))

INSTRUMENTS: dict[str, Shape] = {
    "Yaskawa S L U R B T": one(
        text([["No.", *(f"{a}(deg)" for a in "SLURBT"), "X(mm)", "Y(mm)", "Z(mm)"]], beside(NAMED, JOINTS, POINTS))
    ),
    "KUKA trace of system variables": one(
        text([["Name", *joint_names("$AXIS_ACT_MEAS.A{} [°]"), "X [mm]", "Y [mm]", "Z [mm]"]], ROWS, ";", comma=True)
    ),
    "Kawasaki JT and O A T": one(
        text([["Name", *joint_names("JT{} [deg]"), "X [mm]", "Y [mm]", "Z [mm]", "O [deg]", "A [deg]", "T [deg]"]],
             beside(ROWS, OAT)), kind="pose",
    ),
    "OpenCV's tvec and rvec": one(
        text([["image", *joint_names("q{}"), "tvec_x", "tvec_y", "tvec_z", "rvec_x", "rvec_y", "rvec_z"]],
             beside(NAMED, RADIANS, METRES, cells(Rotation.from_matrix(T[:, :3, :3]).as_rotvec()))),
        kind="pose", units="rad,m",
    ),
    "Vicon CSV beside a table of joints": many(
        ("joints.csv", text([["Frame", *HEAD[1:7]]], [[str(i + 1), *q] for i, q in enumerate(JOINTS)])),
        ("vicon.csv", vicon()),
    ),
    "OptiTrack Motive CSV beside a table of joints": many(
        ("joints.csv", text([HEAD[1:7]], JOINTS)), ("take.csv", optitrack()), kind="pose", key="row", units="mm",
    ),
    "NDI Polaris CSV beside a table of joints": many(
        ("joints.csv", text([HEAD[1:7]], JOINTS)),
        ("polaris.csv", text([["Tools", "Handle", "Frame", "State", "Q0", "Qx", "Qy", "Qz", "Tx", "Ty", "Tz", "Error"]], polaris())),
        kind="pose", key="row", units="mm",
    ),
    "PC-DMIS, a row an axis": many(
        ("joints.csv", text([["FEATURE", *HEAD[1:7]]], beside(NAMED, JOINTS))),
        ("report.csv", text([["FEATURE", "AX", "NOMINAL", "MEAS", "+TOL", "-TOL", "DEV", "OUTTOL"]], pcdmis())),
        units="mm",
    ),
    "ROS, rostopic echo as YAML": one(rostopic_yaml(), "raw.yaml", units="rad,m"),
    "JSON array of objects": one(
        json.dumps([{"id": name, "q": [float(v) for v in q], "xyz": [float(v) for v in p]}
                    for name, q, p in zip(LABELS, JOINTS, POINTS, strict=True)], indent=1), "raw.json", units="deg,mm",
    ),
    "JSON object of columns": one(
        json.dumps({"label": LABELS, **{f"q{i + 1}_deg": [float(r[i]) for r in JOINTS] for i in range(6)},
                    **{f"{a}_mm": [float(r[i]) for r in POINTS] for i, a in enumerate("xyz")}}), "raw.json",
    ),
    "NumPy savetxt": one(
        "# q1 q2 q3 q4 q5 q6 x y z\n" + "".join(" ".join(f"{float(c):.18e}" for c in r[1:]) + "\n" for r in ROWS), "raw.txt",
        units="deg,mm",
    ),
    "pandas with its index": one(
        text([["", *joint_names("q{}"), "x", "y", "z"]], [[str(i), *r[1:]] for i, r in enumerate(ROWS)]), units="deg,mm"
    ),
    "Markdown": one(
        "\n".join("| " + " | ".join(r) + " |" for r in [HEAD, ["---"] * 10, *ROWS]), "raw.txt"
    ),
    "French": one(
        text([["Nom du point", *joint_names("Axe {} (°)"), "X mesuré (mm)", "Y mesuré (mm)", "Z mesuré (mm)"]], ROWS, ";", comma=True),
        encoding="cp1252",
    ),
    "Italian": one(
        text([["Punto", *joint_names("Giunto {} [gradi]"), "X misurato [mm]", "Y misurato [mm]", "Z misurato [mm]"]], ROWS, ";", comma=True)
    ),
    "Chinese": one(
        text([["点名", *joint_names("关节{}(°)"), "X坐标(mm)", "Y坐标(mm)", "Z坐标(mm)"]], ROWS), encoding="utf-8-sig"
    ),
    "Swiss thousands": one(text([HEAD], beside(NAMED, JOINTS, SWISS), ";")),
    "a workbook with title and empty column": (titled, {}, "position"),
    "Leica, polar in gon": one(
        text([["Point ID", *HEAD[1:7], "Hz [gon]", "V [gon]", "SD [m]"]],
             beside(NAMED, JOINTS, cells(np.column_stack([-AZIMUTH / 0.9, (90 - ELEVATION) / 0.9, LENGTH / 1e3]))), ";")
    ),
    "DMIS output": program(
        "calib.dmo",
        "UNITS/MM,ANGDEC\n" + "".join(f"FA({label})=FEAT/POINT,CART,{','.join(p)},0,0,1\n" for label, p in zip(LABELS, POINTS, strict=True)),
        key="row",
    ),
    "MELFA joint variables": program(
        "calib.prg", "".join(f"{label}=({','.join(f'{float(v):+.3f}' for v in q)},+0.00,+0.00)\n" for label, q in zip([f'J{i}' for i in range(1, COUNT + 1)], JOINTS, strict=True)),
        key="row",
    ),
}  # fmt: skip
"""Written down before the readers that read them; `test_instruments` says which are read at once."""


def lines(pattern: str) -> str:
    """Return a line a configuration, its number and joints put into a pattern."""
    return "".join(pattern.format(i, *q) for i, q in enumerate(JOINTS))


BOTH = [[c for v in q for c in (f"{float(v) + 1:.3f}", v)] for q in JOINTS]
IST_SOLL = [f"Achse{i} {what} [°]" for i in range(1, 7) for what in ("Sollwert", "Istwert")]
PENDANT = [f"{name} [°]" for name in ("Base", "Shoulder", "Elbow", "Wrist 1", "Wrist 2", "Wrist 3")]
WITH_UNITS = [[r[0], *(f"{v}°" for v in r[1:7]), *(f"{v} mm" for v in r[7:])] for r in ROWS]
OBJECTS = [
    {"id": n, "joints_deg": [float(v) for v in q], "seen_mm": {a: float(v) for a, v in zip("xyz", p, strict=True)}}
    for n, q, p in zip(LABELS, JOINTS, POINTS, strict=True)
]
STRANGERS: dict[str, Shape] = {
    "Spanish": one(
        text([["Punto", *joint_names("Eje {} [grados]"), *(f"{a} medida [mm]" for a in "XYZ")]], ROWS, ";", comma=True)
    ),
    "Japanese, the number first": one(text([["測定点", *joint_names("{}軸[度]"), "X[mm]", "Y[mm]", "Z[mm]"]], ROWS)),
    "German, Ist and Soll": one(
        text([["Messpunkt", *IST_SOLL, *(f"{a} Istwert [mm]" for a in "XYZ")]], beside(NAMED, BOTH, POINTS), ";", True)
    ),
    "a pendant's Base to Wrist 3": one(text([["Pose", *PENDANT, *HEAD[7:]]], ROWS)),
    "subscripts": one(text([["label", *(f"θ{i} (°)" for i in "₁₂₃₄₅₆"), *HEAD[7:]]], ROWS)),
    "capitals": one(text([["POINT_ID", *joint_names("JOINT_{}_DEG"), *(f"MEAS_{a}_MM" for a in "XYZ")]], ROWS)),
    "units of many letters in a row": one(text([BARE, ["", *["degrees"] * 6, *["millimeters"] * 3]], ROWS)),
    "a language that no list has": one(
        text([["Nokta", *joint_names("Eksen {} [derece]"), *HEAD[7:]]], ROWS, ";", comma=True)
    ),
    "units without a gap": one(text([["point", *joint_names("axis{}deg"), "Xmm", "Ymm", "Zmm"]], ROWS)),
    "a column of temperatures under our name": one(
        text([[*HEAD, "temperature_C"]], beside(ROWS, [["21.5"]] * COUNT))
    ),
    "JSON lines of ROS, joints by the alphabet": one(
        "".join(
            json.dumps({
                "joints": {"name": [UR_JOINTS[i] for i in ORDER], "position": [float(q[i]) for i in ORDER]},
                "point": {"x": float(p[0]), "y": float(p[1]), "z": float(p[2])},
            }) + "\n"
            for q, p in zip(RADIANS, METRES, strict=True)
        ), "raw.jsonl", units="m",
    ),
    "units above the header": one("Cell 7\nUnits: mm, deg\n\n" + text([BARE], ROWS, "\t"), "raw.txt"),
    "units in the cells, decimal commas": one(text([BARE], WITH_UNITS, ";", comma=True)),
    "the robot's own position beside the measured one": one(
        text([["name", *joint_names("joint_{}_position_deg"), *(f"{c}_{a}_mm" for c in ("tcp", "tracker") for a in "xyz")]],
             beside(NAMED, JOINTS, WANTED, POINTS))
    ),
    "ROS 2, indices": one(
        text([[*joint_names("position[{}]", 0), *(f"pose.position.{a}" for a in "xyz")]], beside(RADIANS, METRES))
    ),
    "JSON below a key": one(json.dumps({"robot": "r", "rows": OBJECTS}), "raw.json"),
    "Excel, two sheets": excel(
        {"Joints": [HEAD[:7], *beside(NAMED, JOINTS)], "Points": [[HEAD[0], *HEAD[7:]], *beside(NAMED, POINTS)]},
        sheet="Joints,Points",
    ),
    "SpatialAnalyzer, units in a comment": many(
        ("joints.csv", text([HEAD[:7]], beside(NAMED, JOINTS))),
        (
            "sa.txt",
            "// SpatialAnalyzer ASCII Export\n// Coordinate Frame: A::WORLD   Units: Millimeters, Degrees\n"
            "// Format: Collection, Group, Target, X, Y, Z\n" + text([], [["A", "Robot", *row] for row in beside(NAMED, POINTS)]),
        ),
    ),
    "SpatialAnalyzer, three names above A::Robot::P1": many(
        ("joints.csv", text([HEAD[:7]], beside(NAMED, JOINTS))),
        (
            "sa.txt",
            "// SA export  Units: Millimeters  Frame: A::WORLD\n// Collection Group Point X Y Z\n"
            + text([], [[f"A::Robot::{row[0]:6}", *row[1:]] for row in beside(NAMED, POINTS)], " "),
        ),
    ),
    "names of the points of two files": many(
        ("joints.csv", text([HEAD[:7]], beside(NAMED, JOINTS))),
        ("points.csv", text([], beside(NAMED, POINTS))), columns="label,x_mm,y_mm,z_mm",
    ),
    "Excel, a line of signs of degrees below joints alone": excel(
        {
            "Achsen": [["Pose", "Achswinkel"], ["", *joint_names("A{}")], ["", *["°"] * 6], *beside(NAMED, JOINTS)],
            "Punkte": [["Punkt", *"XYZ"], ["", *["mm"] * 3], *beside(NAMED, POINTS)],
        },
        sheet="Achsen,Punkte",
    ),
    "a unit of lengths and one of angles in a comment": one(
        "# 6DoF, length unit mm, angle unit deg\n" + text([BARE], ROWS, "\t"), "raw.txt"
    ),
    "JSON, units beside the rows": one(
        json.dumps({
            "meta": {"units": {"q": "deg", "point": "mm"}},
            "samples": [{"id": n, "q": [*map(float, q)], "point": dict(zip("xyz", map(float, p), strict=True))} for n, q, p in zip(LABELS, JOINTS, POINTS, strict=True)],
        }), "raw.json",
    ),
    "points with another word before their number": many(
        ("calib.dat", krl()), ("points.csv", text([["Name", *HEAD[7:]]], [[f"Meas{i + 1:02d}", *row] for i, row in enumerate(POINTS)]))
    ),
    "MATLAB text": one(
        "% joint angles in deg\nq = [\n" + text([], JOINTS, " ") + "];\np = [\n" + "".join(f"  {', '.join(row)};\n" for row in POINTS) + "]; % tracker [mm]\n",
        "raw.m",
    ),
    "a row a value": one(
        text([["point", "quantity", "value", "unit"]],
             [[row[0], name, value, "deg" if name[0] == "J" else "mm"] for row in ROWS for name, value in zip([*joint_names("J{}"), *"XYZ"], row[1:], strict=True)])
    ),
    "VAL3": program(
        "p.dtx", lines('<Value key="{}" j1="{}" j2="{}" j3="{}" j4="{}" j5="{}" j6="{}"/>\n'), key="row"
    ),
    "VAL3, points without a key, which VAL3 counts from 0": many(
        ("p.dtx", lines('<Value j1="{1}" j2="{2}" j3="{3}" j4="{4}" j5="{5}" j6="{6}"/>\n')),
        ("points.csv", text([["Point", *HEAD[7:]]], [[str(i), *row] for i, row in enumerate(POINTS)])),
    ),
    "VAL3, an array a point": many(
        ("p.dtx", lines('<Data name="P{0}"><Value key="0" j1="{1}" j2="{2}" j3="{3}" j4="{4}" j5="{5}" j6="{6}"/></Data>\n')),
        ("points.csv", text([["Point", *HEAD[7:]]], [[f"P{i}", *row] for i, row in enumerate(POINTS)])),
    ),
    "a page of HTML, a group header above": one(
        "<html><body><h1>Report</h1><p>by: me<table border=1>\n<tr><th>Point<th colspan='6'>Joints [deg]<th colspan=\"3\">Measured [mm]\n<TR>"
        + "".join(f"<th>{name}" for name in ["", *joint_names("J{}"), *"XYZ"])
        + "".join("<tr>" + "".join(f"<td class='c'><b>{cell}</b>&nbsp;</td>" for cell in row) + "</tr>\n" for row in ROWS)
        + "</table><p>end</body></html>", "raw.html",
    ),
    "Yaskawa job": program("P.JBI", "///POSTYPE ANGLE\n" + lines("C{:05d}={},{},{},{},{},{}\n"), key="row"),
    "KUKA, inline axes": program("m.src", lines("PTP {{A1 {1},A2 {2},A3 {3},A4 {4},A5 {5},A6 {6}}}\n"), key="row"),
    "RAPID, MoveAbsJ alone": program("m.mod", lines("MoveAbsJ [[{1},{2},{3},{4},{5},{6}],[9E9,9E9]],v9;\n"), key="row"),
    "URScript, degrees": program(
        "m.script", lines("movej([d2r({1}),d2r({2}),d2r({3}),d2r({4}),d2r({5}),d2r({6})])\n"), key="row"
    ),
}  # fmt: skip
"""As strangers write, written down before the readers that read them."""
