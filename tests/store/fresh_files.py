# ruff: noqa: E501
"""Formats that were written without sight of the reader and not read at first contact, of the clean table of `raw_files`."""

from __future__ import annotations

import json
from itertools import groupby
from pathlib import Path
from zipfile import ZipFile

import numpy as np
from scipy.io import savemat

from tests.store.instrument_files import Shape, many
from tests.store.raw_files import (
    COUNT,
    HEAD,
    JOINTS,
    LABELS,
    METRES,
    NAMED,
    POINTS,
    RADIANS,
    ROWS,
    WXYZ,
    P,
    Q,
    beside,
    cells,
    excel,
    joint_names,
    one,
    text,
)

AXES = text([["Point", *joint_names("A{}")]], beside(NAMED, JOINTS))
BOTH = {"units": "deg,mm"}
IN_SI = {"units": "rad,m"}
XYZW = cells(WXYZ[:, [1, 2, 3, 0]])
STAMPS = [f"{1403636579.763 + 5 * i:.3f}" for i in range(COUNT)]


def spatial_analyzer() -> str:
    points = "".join(f"A::KR6 Cal::{label}, {', '.join(row)}\n" for label, row in zip(LABELS, POINTS, strict=True))
    return f"// Spatial Analyzer ASCII Point Export\n// Units: Millimeters\n// Collection::Group::Target, X, Y, Z\n{points}"


def calypso() -> str:
    head = ["planid", "id", "type", "idsymbol", "actual", "nominal", "uppertol", "deviation", "unit"]
    rows = [["Kalib", f"{label}.{axis}", f"{axis.lower()}Value", axis, value, "1.0", "0.1", "2.5", "mm"]
            for label, row in zip(LABELS, POINTS, strict=True) for axis, value in zip("XYZ", row, strict=True)]  # fmt: skip
    return text([head], [*rows, ["END", *[""] * 8]], "\t")


def plotjuggler() -> str:
    head = [
        "__time",
        *joint_names("/joint_states/joint_a{}/position"),
        *joint_names("/joint_states/joint_a{}/velocity"),
    ]
    head += [f"/mocap/flange/pose/pose/position/{c}" for c in "xyz"] + [
        f"/mocap/flange/pose/pose/orientation/{c}" for c in "xyzw"
    ]
    return text([head], beside([[stamp] for stamp in STAMPS], RADIANS, [["1e-5"] * 6] * COUNT, METRES, XYZW))


def matlab(folder: Path) -> Path:
    savemat(folder / "data.mat", {"q": Q, "p": P, "note": "cell 7", "rate": 250.0})
    return folder / "data.mat"


def kawasaki() -> str:
    moves = "".join(f"  JMOVE #{label.lower()}\n" for label in LABELS)
    points = "".join(f"#{label.lower()} {' '.join(row)}\n" for label, row in zip(LABELS, JOINTS, strict=True))
    return f".PROGRAM calib()\n{moves}.END\n.JOINTS\n{points}.END\n"


def samples() -> str:
    lines = [f"- id: {i}\n  joint_positions: [{', '.join(q)}]\n  marker_position: {{x: {p[0]}, y: {p[1]}, z: {p[2]}}}\n"
             for i, (q, p) in enumerate(zip(RADIANS, METRES, strict=True))]  # fmt: skip
    return "# collected by a script\nsamples:\n" + "".join(lines)


def sheets(folder: Path, rows: dict[str, list[list[str]]]) -> Path:
    """Write a spreadsheet as LibreOffice does: equal cells once with their number, numbers shown with one digit."""
    content = ""
    for name, lines in rows.items():
        content += f'<table:table table:name="{name}" table:style-name="ta1"><table:table-column/>'
        for line in lines:
            content += "<table:table-row>"
            for cell, equal in groupby(line):
                repeated = f' table:number-columns-repeated="{len(list(equal))}"'
                if cell.lstrip("-")[:1].isdigit():
                    shown = f'office:value-type="float" office:value="{cell}"><text:p>{float(cell):.1f}'
                else:
                    shown = f'office:value-type="string"><text:p>{cell}'
                content += f"<table:table-cell{repeated} {shown}</text:p></table:table-cell>"
            content += '<table:table-cell table:number-columns-repeated="16374"/></table:table-row>'
        content += "</table:table>"
    path = folder / "raw.ods"
    with ZipFile(path, "w") as archive:
        archive.writestr("content.xml", f'<?xml version="1.0" encoding="UTF-8"?><office:body>{content}</office:body>')
    return path


def labview(times: bool = True) -> str:
    blocks = [["Channels", "9"], ["Samples", *["1"] * 9], ["Date", *["2024/03/14"] * 9], ["Y_Unit_Label", *["deg"] * 6, *["mm"] * 3],
              ["X0", *["0.0E+0"] * 9], ["Delta_X", *["1.000000"] * 9], ["***End_of_Header***"]]  # fmt: skip
    head = ["X_Value", *joint_names("J{}"), "X", "Y", "Z", "Comment"]
    rows = beside([[f"{i}.000000" if times else ""] for i in range(COUNT)], JOINTS, POINTS, [[""]] * COUNT)
    return "LabVIEW Measurement\t\nSeparator\tTab\n***End_of_Header***\t\n\t\n" + text([*blocks, head], rows, "\t")


def trajectory() -> str:
    rows = [" ".join([stamp, *p, *turn]) for stamp, p, turn in zip(STAMPS, METRES, XYZW, strict=True)]
    return "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n"


def clocked_joints() -> str:
    later = [[f"{float(stamp) + 0.002:.3f}"] for stamp in STAMPS]
    return text([["timestamp", *joint_names("joint_{}")]], beside(later, RADIANS))


def trace() -> str:
    head = ["Zeit", *joint_names("$AXIS_ACT.A{}"), *(f"$POS_ACT.{c}" for c in "XYZABC"), "LT_X", "LT_Y", "LT_Z"]
    return text(
        [head],
        beside(
            [[f"{10 * i}"] for i in range(COUNT)], JOINTS, cells(P - 9.0, 3), [["12.1", "-3.2", "90.0"]] * COUNT, POINTS
        ),
        ";",
    )


PROTOCOL = [["Messprotokoll"], ["Datum:", "14.03.2024", "", "Prüfer:", "H. Schmidt"], [], ["Pkt.-Nr.", *joint_names("A{}"), "X-Ist", "Y-Ist", "Z-Ist"],
            ["", *["°"] * 6, *["mm"] * 3], *beside(NAMED, JOINTS, POINTS), [], ["Mittelwert", *["1.5"] * 9], ["Std.-Abw.", *["60.5"] * 9]]  # fmt: skip
JAPANESE = text(
    [["測定点", *joint_names("第{}軸(度)"), "X座標(mm)", "Y座標(mm)", "Z座標(mm)"]], beside(NAMED, JOINTS, POINTS)
)
TURNED = [["Point", *LABELS], *([name, *column] for name, *column in zip([*joint_names("J{} [deg]"), "X [mm]", "Y [mm]", "Z [mm]"], *beside(JOINTS, POINTS), strict=True))]  # fmt: skip


def japanese(folder: Path) -> Path:
    (folder / "raw.csv").write_bytes(JAPANESE.encode("cp932"))
    return folder / "raw.csv"


def encoded(head: list[str], encoding: str, comma: bool = False) -> Shape:
    def write(folder: Path) -> Path:
        whole = text([head], ROWS, ";" if comma else ",", comma=comma)
        (folder / "raw.csv").write_bytes(whole.encode(encoding))
        return folder / "raw.csv"

    return write, {"encoding": encoding} | ({"decimal": "comma"} if comma else {}), "position"


def arrays(folder: Path) -> Path:
    np.savez(folder / "raw.npz", q=np.radians(Q), p=P / 1e3)
    return folder / "raw.npz"


def sexagesimal(angle: str) -> str:
    tenths = round(abs(float(angle)) * 36000)
    return f"{'-' * (float(angle) < 0)}{tenths // 36000}°{tenths // 600 % 60:02d}'{tenths % 600 / 10:04.1f}\""


def accounted(number: str, before: str, after: str) -> str:
    size = f"{abs(float(number)):,.4f}"
    return f"{before}{size}{after}" if float(number) < 0 else size


QUANTITIES = [
    [label, *quantity]
    for label, q, p in zip(LABELS, JOINTS, POINTS, strict=True)
    for quantity in [
        *((f"A{j}", value, "deg") for j, value in enumerate(q, 1)),
        *((axis, value, "mm") for axis, value in zip("XYZ", p, strict=True)),
        ("Room", "20.5", "degC"),
    ]
]
MEANS = ["Média", *(f"{v:.3f}" for v in [*Q.mean(axis=0), *P.mean(axis=0)])]
ARRAYS = {
    "cell": 4,
    "names": LABELS,
    "joint_angles_deg": np.asarray(JOINTS, float).tolist(),
    "measured_mm": np.asarray(POINTS, float).tolist(),
}
JOINT_ROWS = [
    [label, f"J{j}", value] for label, row in zip(LABELS, JOINTS, strict=True) for j, value in enumerate(row, 1)
]
COMMENTED = [line + " # reflector cleaned" * (i == 5) for i, line in enumerate(text([HEAD], ROWS).splitlines())]
FORTRAN = [[f"{float(v) / 1e3:.9f}D+03" for v in row[1:]] for row in ROWS]


FRESH: dict[str, Shape] = {
    "signs as in accounting": one(text([HEAD], beside(NAMED, *([[accounted(v, *signs) for v in row] for row in part] for part, signs in ((JOINTS, ("", "-")), (POINTS, ("(", ")"))))), "\t"), "raw.txt"),
    "a row a quantity, with others than joints and axes": one(text([["point", "quantity", "value", "unit"]], QUANTITIES, ";")),
    "means and deviations below their points": one(text([HEAD], [[f"{what}{row[0]}", *row[1:-1], f"{float(row[-1]) + off}"] for row in ROWS for what, off in (("", 0), ("Mean ", 1), ("Std ", 2))])),
    "Chinese in GB18030": encoded(["点号", *joint_names("关节{}(°)"), "实测X(mm)", "实测Y(mm)", "实测Z(mm)"], "gb18030"),
    "Russian in Windows-1251": encoded(["Точка", *joint_names("Ось {}, град"), "X, мм", "Y, мм", "Z, мм"], "cp1251", comma=True),
    "a mean in another language below": one(text([["Ponto", *HEAD[1:]]], [*ROWS, MEANS])),
    "Doosan, posj in a cell": one(text([["no", "command", "X [mm]", "Y [mm]", "Z [mm]"]], [[label, f"posj({', '.join(q)})", *p] for label, q, p in zip(LABELS, JOINTS, POINTS, strict=True)]), units="deg"),
    "Fortran, exponents of double precision": one(text([HEAD[1:]], FORTRAN, " "), "raw.dat"),
    "NumPy, .npz": (arrays, IN_SI, "position"),
    "JSON, an object of arrays": one(json.dumps(ARRAYS), "raw.json"),
    "comments behind rows": one("\n".join(COMMENTED)),
    "degrees, minutes and seconds": one(text([HEAD], beside(NAMED, [list(map(sexagesimal, q)) for q in JOINTS], POINTS), "\t"), "raw.tsv"),

    "SpatialAnalyzer, collection::group::point": many(("points.txt", spatial_analyzer()), ("joints.csv", AXES), **BOTH),
    "CALYPSO, a row a characteristic": many(("chr.txt", calypso()), ("joints.csv", AXES), **BOTH),
    "PlotJuggler, topics": one(plotjuggler(), kind="pose"),
    "MATLAB, table(q, p)": one(text([[*joint_names("q_{}"), *(f"p_{i}" for i in (1, 2, 3))]], beside(RADIANS, METRES)), **IN_SI),
    "MATLAB, .mat": (matlab, BOTH, "position"),
    "a protocol with statistics below": excel({"Messung": PROTOCOL}),
    "Japanese in Shift-JIS": (japanese, {"encoding": "cp932"}, "position"),
    "Kawasaki AS": many(("calib.as", kawasaki()), ("points.csv", text([["point", "x [mm]", "y [mm]", "z [mm]"]], beside([[label.lower()] for label in LABELS], POINTS)))),
    "YAML, a list of samples": one(samples(), "raw.yaml", **IN_SI),
    "Excel, a row a quantity": excel({"quer": TURNED}),
    "a row a joint": many(("axes.csv", text([["pose", "joint", "angle [deg]"]], JOINT_ROWS)), ("points.csv", text([["pose", *HEAD[7:]]], beside(NAMED, POINTS)))),
    "rows counted from 0 and from 1": many(("joints.csv", text([HEAD[:7]], beside([[str(i)] for i in range(COUNT)], JOINTS))), ("points.csv", text([[HEAD[0], *HEAD[7:]]], beside([[str(i + 1)] for i in range(COUNT)], POINTS)))),
    "LabVIEW": one(labview(), "raw.lvm", **BOTH),
    "LabVIEW without times": one(labview(times=False), "raw.lvm", **BOTH),
    "OpenDocument": (lambda folder: sheets(folder, {"Notes": [["cell 7"]], "Points": [HEAD, *ROWS]}), {}, "position"),
    "OpenDocument, the second sheet": (lambda folder: sheets(folder, {"Old": [HEAD, *ROWS[:3]], "New": [HEAD, *ROWS]}), {"sheet": "New"}, "position"),
    "RAPID, a jointtarget in a cell": one(text([["Point", "JointTarget", *HEAD[7:]]], [[label, f'"[[{",".join(q)}],[9E+09,9E9,9E+09,9E+09,9E+09,9E+09]]"', *p] for label, q, p in zip(LABELS, JOINTS, POINTS, strict=True)]), units="deg"),
    "TUM trajectory, joints by time": many(("trajectory.txt", trajectory()), ("joints.csv", clocked_joints()), kind="pose", **IN_SI),
    "KUKA trace beside a tracker": one(trace(), **BOTH),
}  # fmt: skip
