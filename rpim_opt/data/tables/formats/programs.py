"""Programs and data lists of robot controllers: their joint targets, or their poses if there are none.

FANUC ``P[1:"name"]{ UF : 0, UT : 1, J1= 10.000 deg, ... };``; KUKA ``DECL E6AXIS XP1={A1 10.0,A2 -90.0,...}``; ABB
``CONST jointtarget P1:=[[10,-90,...],[9E9,...]];``; Universal Robots ``movej([0.1, -1.57, ...])`` and ``P1_q = [...]``
in rad, ``p[...]`` in m and rad; Yaskawa ``C00000=10.0,-90.0,...`` below ``///POSTYPE ANGLE``; Kawasaki
``#p1 10.0 -90.0 ...`` below ``.JOINTS``; Mitsubishi ``J1=(+10.00,-90.00,...)``; Staubli
``<Value key="0" j1="10" j2="-90" ... />``. External axes are left out.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence

import scipy

from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.tables.formats.registry import Rows, TableFormat

NUMBER = r"[+-]?[\d.]+(?:e[+-]?\d+)?"
FANUC = re.compile(r'P\[(\d+)(?::"([^"]*)")?\]\s*\{(.*?)\};', re.DOTALL)
KUKA = re.compile(r"(?:(?:E6AXIS|AXIS|E6POS|POS|FRAME)\s+(\w+)\s*=|PTP|LIN)\s*\{([^{}]{0,500})\}", re.IGNORECASE)
ABB_JOINTS = re.compile(r"(?:jointtarget\s+(\w+)\s*:=|MoveAbsJ)\s*\[\s*\[([^\]]*)\]", re.IGNORECASE)
ABB_POSES = re.compile(r"(?:robtarget\s+(\w+)\s*:=|Move[JL])\s*\[\s*\[([^\]]*)\]\s*,\s*\[([^\]]*)\]", re.IGNORECASE)
ABB_TARGET = re.compile(f"{ABB_JOINTS.pattern}|{ABB_POSES.pattern}", re.IGNORECASE)
UR = re.compile(rf"(?:(\w+)\s*=|move[jlp]\s*\()\s*(p?)\[\s*((?:{NUMBER}\s*,\s*){{5}}{NUMBER})\s*\]", re.IGNORECASE)
YASKAWA = re.compile(r"^[ \t]*([BCP]+\d+)[ \t]*=[ \t]*([-+\d.][-+\d., \t]*)$", re.MULTILINE)
KAWASAKI = re.compile(r"^\.JOINTS[^\n]*\n(.*?)^\.END", re.MULTILINE | re.DOTALL | re.IGNORECASE)
MITSUBISHI = re.compile(r"^[ \t]*(J\w*)[ \t]*=[ \t]*\(([-+\d.][-+\d., \t]*)\)", re.MULTILINE | re.IGNORECASE)
STAUBLI = re.compile(r"<(Data|Value)\s([^<>]{0,2000})>")
PLACE = [f"commanded {axis} [mm]" for axis in "xyz"]
TURN = [f"commanded q{part}" for part in "wxyz"]
PAIRS = {**{f"{letter}{i}": f"{letter}{i} [deg]" for i in range(1, 7) for letter in "AJ"},
         **dict(zip("XYZ", PLACE, strict=True)), **{turn: f"commanded {turn} [deg]" for turn in "ABC"}}  # fmt: skip
"""What is stated by name, in capitals, and the header that says so."""
Targets = Sequence[tuple[str, Mapping[str, str]]]


def _rows(joints: Targets, poses: Targets = ()) -> Rows:
    """Return one row per joint target, or per pose if there are none; unnamed targets are numbered."""
    return [{"label": name or str(i), **values} for i, (name, values) in enumerate(joints or poses, start=1)]


def _listed(cells: str, names: Sequence[str] = ()) -> dict[str, str]:
    """Return values that are separated by commas, by default of joints [deg]."""
    values = [cell.strip() for cell in cells.split(",")]
    return dict(zip(names or [f"J{i} [deg]" for i in range(1, len(values) + 1)], values, strict=False))


def _paired(pairs: Iterable[tuple[str, str]]) -> dict[str, str]:
    return {PAIRS[name.upper()]: value for name, value in pairs if name.upper() in PAIRS}


def read_fanuc(text: str) -> Rows:
    """Return the points; a position register without values (``********``) has none."""
    points = FANUC.findall(text)
    comments = [comment for _, comment, _ in points]
    named = all(comments) and len(set(comments)) == len(comments)
    rows = []
    for number, comment, fields in points:
        numbers = re.findall(r"\b(J\d|[XYZWPR])\s*=\s*([+-]?[\d.]+)\s*(deg|mm)", fields)
        values = {f"{'' if name[0] == 'J' else 'commanded '}{name} [{unit}]": value for name, value, unit in numbers}
        rows.append((comment if named else f"P{number}", values))
    return _rows(rows)


def read_kuka(text: str) -> Rows:
    """Return the targets; a prefix X of all names, as in inline forms, is removed."""
    targets = KUKA.findall(text)
    targets = [each for each in targets if re.search(r"\bA1\b", each[1], re.IGNORECASE)] or targets
    inline = all(name.upper().startswith("X") for name, _ in targets)
    pair = re.compile(rf"\b([A-Z]\d?)\s+({NUMBER})", re.IGNORECASE)
    return _rows([(name[1:] if inline else name, _paired(pair.findall(fields))) for name, fields in targets])


def read_abb(text: str) -> Rows:
    """Return the targets; a quaternion has w first."""
    text = re.sub(r"!.*", "", text)
    joints = [f"rax_{i} [deg]" for i in range(1, 10)]
    poses = [(name, _listed(f"{place},{turn}", [*PLACE, *TURN])) for name, place, turn in ABB_POSES.findall(text)]
    return _rows([(name, _listed(cells, joints)) for name, cells in ABB_JOINTS.findall(text)], poses)


def _plain_urscript(text: str) -> str:
    """Return a program without comments, its angles in rad."""
    radians = re.sub(r"d2r\(\s*([+-]?[\d.]+)\s*\)", lambda degrees: repr(math.radians(float(degrees[1]))), text)
    return re.sub(r"#.*", "", radians)


def read_urscript(text: str) -> Rows:
    """Return the targets that are commanded or named."""
    joints = []
    poses = []
    for name, pose, cells in UR.findall(_plain_urscript(text)):
        values = [float(cell) for cell in cells.split(",")]
        if name.lower() == "set_tcp":
            continue
        if not pose:
            row = {f"joint_{i} [rad]": repr(value) for i, value in enumerate(values, start=1)}
            joints.append((name.removesuffix("_q"), row))
        else:
            w_last = scipy.spatial.transform.Rotation.from_rotvec(values[3:]).as_quat().tolist()
            row = {f"commanded {axis} [m]": repr(value) for axis, value in zip("xyz", values, strict=False)}
            row |= {part: repr(value) for part, value in zip([*TURN[1:], TURN[0]], w_last, strict=True)}
            poses.append((name.removesuffix("_p"), row))
    return _rows(joints, poses)


def read_yaskawa(text: str) -> Rows:
    """Return the points; refuse encoder pulses, which need the robot's gear ratios."""
    kind = re.search(r"///POSTYPE\s+(\w+)", text)
    if kind is None or kind[1] == "PULSE":
        raise InputError("the positions", "encoder pulses", "a job that was exported with ///POSTYPE ANGLE or BASE")
    names = () if kind[1] == "ANGLE" else PLACE
    return _rows([(name, _listed(cells, names)) for name, cells in YASKAWA.findall(text)])


def read_kawasaki(text: str) -> Rows:
    """Return the points of joint values of an AS program or of what a controller saved."""
    lines = [line.split() for section in KAWASAKI.findall(text) for line in section.splitlines()]
    return _rows([(words[0].removeprefix("#"), _listed(",".join(words[1:]))) for words in lines if len(words) > 1])


def read_staubli(text: str) -> Rows:
    """Return the points by their keys, numbered from 0 without keys; of several arrays as ``array[key]``."""
    array, i = "", -1
    targets = []
    for element, fields in STAUBLI.findall(text):
        attributes = dict(re.findall(r'\b(\w+)\s*=\s*"([^"]*)"', fields))
        if element == "Data":
            array, i = attributes.get("name", ""), -1
            continue
        i += 1
        targets.append((array, attributes.get("key", str(i)), _paired(attributes.items())))
    targets = [each for each in targets if "J1 [deg]" in each[2]] or targets
    several = len({array for array, _, _ in targets}) > 1
    return _rows([(f"{array}[{key}]" if several else key, values) for array, key, values in targets])


def read_mitsubishi(text: str) -> Rows:
    """Return the points of joint values."""
    return _rows([(name, _listed(cells)) for name, cells in MITSUBISHI.findall(text)])


FORMATS = (
    TableFormat("FANUC program", (".ls",), FANUC.search, read_fanuc),
    TableFormat("KUKA data list", (".dat", ".src"), KUKA.search, read_kuka),
    TableFormat("RAPID module", (".mod", ".modx", ".prg", ".sys"), ABB_TARGET.search, read_abb),
    TableFormat("URScript", (".script", ".urscript"), lambda text: UR.search(_plain_urscript(text)), read_urscript),
    TableFormat("Yaskawa job", (".jbi",), YASKAWA.search, read_yaskawa),
    TableFormat("Kawasaki AS program", (".as", ".pg"), KAWASAKI.search, read_kawasaki),
    TableFormat("MELFA program", (".prg", ".mb4", ".mb5", ".mb6"), MITSUBISHI.search, read_mitsubishi),
    TableFormat("VAL3 data", (".dtx",), lambda text: "<Value" in text, read_staubli),
)
