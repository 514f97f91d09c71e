"""Programs and data lists of robot controllers: their joint targets, or their poses if there are none.

FANUC ``P[1:"name"]{ UF : 0, UT : 1, J1= 10.000 deg, ... };``; KUKA ``DECL E6AXIS XP1={A1 10.0,A2 -90.0,...}``; ABB
``CONST jointtarget P1:=[[10,-90,...],[9E9,...]];``; Universal Robots ``movej([0.1, -1.57, ...])`` and ``P1_q = [...]``
in rad, ``p[...]`` in m and rad; Yaskawa ``C00000=10.0,-90.0,...`` below ``///POSTYPE ANGLE``; Kawasaki
``#p1 10.0 -90.0 ...`` below ``.JOINTS``; Mitsubishi ``J1=(+10.00,-90.00,...)``; Staubli ``<Value key="0" j1="10"
j2="-90" ... />``. Of external axes only E1 of KUKA and ABB is read.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np
import scipy

from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.tables.formats.registry import Rows, TableFormat

NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?"
FANUC = re.compile(r'P\[(\d+)(?::"([^"]*)")?\]\s*\{(.*?)\};', re.DOTALL)
KUKA = re.compile(r"(?:(?:E6AXIS|AXIS|E6POS|POS|FRAME)\s+(\w+)\s*=|PTP|LIN)\s*\{([^{}]{0,500})\}", re.IGNORECASE)
ABB_JOINTS = re.compile(
    r"(?:jointtarget\s+(\w+)\s*:=|MoveAbsJ)\s*\[\s*\[([^\]]*)\](?:\s*,\s*\[([^\],]*))?", re.IGNORECASE
)
NO_AXIS = 9e9  # ABB's value of an absent external axis
ABB_POSES = re.compile(r"(?:robtarget\s+(\w+)\s*:=|Move[JL])\s*\[\s*\[([^\]]*)\]\s*,\s*\[([^\]]*)\]", re.IGNORECASE)
UR = re.compile(rf"(?:(\w+)\s*=|move[jlp]\s*\()\s*(p?)\[\s*((?:{NUMBER}\s*,\s*){{5}}{NUMBER})\s*\]", re.IGNORECASE)
YASKAWA = re.compile(r"^[ \t]*([BCP]+\d+)[ \t]*=[ \t]*([-+\d.][-+\d., \t]*)$", re.MULTILINE)
KAWASAKI = re.compile(r"^[ \t]*#(\S+)[ \t]+([-+\d.][-+\d.eE \t]*)$", re.MULTILINE)
MITSUBISHI = re.compile(r"^[ \t]*(J\w*)[ \t]*=[ \t]*\(([-+\d.][-+\d., \t]*)\)", re.MULTILINE | re.IGNORECASE)
STAUBLI = re.compile(r"<(Data|Value)\s([^<>]{0,2000})>")
PLACE = [f"commanded {axis} [mm]" for axis in "xyz"]
TURN = [f"commanded q{part}" for part in "wxyz"]
PAIR = re.compile(rf'\b([AJ]\d|E1|[XYZABCWPR])\s*[= ]\s*"?({NUMBER})(?:\s*(deg|mm))?', re.IGNORECASE)
"""A joint, coordinate or rotation stated by name."""
LENGTHS = ("X", "Y", "Z", "E1")  # lengths if without a unit: an external axis that is a joint is taken for a rail
Target = tuple[str, Mapping[str, str]]


def _rows(targets: Sequence[Target]) -> Rows:
    """Return one row per joint target, or per pose if there are none; unnamed targets are numbered."""
    joints = [each for each in targets if not all(name.startswith("commanded") for name in each[1])]
    return [{"label": name or str(i), **values} for i, (name, values) in enumerate(joints or targets, start=1)]


def _listed(name: str, cells: str, headers: Sequence[str] = ()) -> Target:
    """Return a target whose values are separated by commas or blanks, by default those of joints [deg]."""
    values = re.split(r"\s*,\s*|\s+", cells.strip())
    return name, dict(zip(headers or [f"J{i} [deg]" for i in range(1, len(values) + 1)], values, strict=False))


def _paired(name: str, fields: str) -> Target:
    """Return a target whose values are stated by name, in degrees and millimetres unless it states other units."""
    values = {}
    for part, value, unit in PAIR.findall(fields):
        header = part.upper() if part[1:] else f"commanded {part.upper()}"
        values[f"{header} [{unit or ('mm' if part.upper() in LENGTHS else 'deg')}]"] = value
    return name, values


def read_joints(pattern: re.Pattern[str], text: str) -> Rows:
    """Return points with joint values, from a pattern whose groups are the name and the values."""
    return _rows([_listed(name, cells) for name, cells in pattern.findall(text)])


def read_fanuc(text: str) -> Rows:
    """Return the points; a position register without values (``********``) has none."""
    points = FANUC.findall(text)
    comments = {comment for _, comment, _ in points} - {""}
    named = len(comments) == len(points)
    return _rows([_paired(comment if named else f"P{number}", fields) for number, comment, fields in points])


def read_kuka(text: str) -> Rows:
    """Return the targets; a prefix X of all names, as in inline forms, is removed."""
    rows = _rows([_paired(name, fields) for name, fields in KUKA.findall(text)])
    inline = all(row["label"].upper().startswith("X") for row in rows)
    return [{**row, "label": row["label"][inline:]} for row in rows]


def read_abb(text: str) -> Rows:
    """Return the targets, with the first external axis as KUKA's E1; a quaternion has w first."""
    text = re.sub(r"!.*", "", text)
    poses = [_listed(name, f"{place},{turn}", [*PLACE, *TURN]) for name, place, turn in ABB_POSES.findall(text)]
    targets = []
    for name, cells, external in ABB_JOINTS.findall(text):
        rail = {"E1 [mm]": external} if float(external or NO_AXIS) < NO_AXIS else {}
        targets.append((name, rail | dict(_listed(name, cells)[1])))
    return _rows(targets or poses)


def read_urscript(text: str) -> Rows:
    """Return the targets that are commanded or named."""
    radians = re.sub(r"d2r\(\s*([+-]?[\d.]+)\s*\)", lambda degrees: repr(math.radians(float(degrees[1]))), text)
    targets = []
    for name, pose, cells in UR.findall(re.sub(r"#.*", "", radians)):
        if not pose:
            targets.append(_listed(name.removesuffix("_q"), cells, [f"J{i} [rad]" for i in range(1, 7)]))
        elif name.lower() != "set_tcp":
            place, turn = np.array(cells.split(","), dtype=float).reshape(2, 3)
            x, y, z, w = scipy.spatial.transform.Rotation.from_rotvec(turn).as_quat()
            numbers = map(repr, [*(1e3 * place).tolist(), *map(float, (w, x, y, z))])
            targets.append((name.removesuffix("_p"), dict(zip([*PLACE, *TURN], numbers, strict=True))))
    return _rows(targets)


def read_yaskawa(text: str) -> Rows:
    """Return the points; refuse encoder pulses, which need the robot's gear ratios."""
    points = YASKAWA.findall(text)
    kind = re.search(r"///POSTYPE\s+(\w+)", text)
    if points and (kind is None or kind[1] == "PULSE"):
        raise InputError("the positions", "encoder pulses", "a job that was exported with ///POSTYPE ANGLE or BASE")
    headers = PLACE if kind and kind[1] != "ANGLE" else ()
    return _rows([_listed(name, cells, headers) for name, cells in points])


def read_staubli(text: str) -> Rows:
    """Return the points, named by their key, or numbered from 0 without keys.

    If a file has several arrays, names are ``array[key]``, and ``array`` for one with a single point.
    """
    array, i = "", 0
    targets = []
    for element, fields in STAUBLI.findall(text):
        attributes = dict(re.findall(r'\b(\w+)\s*=\s*"([^"]*)"', fields))
        if element == "Data":
            array, i = attributes.get("name", ""), 0
        else:
            targets.append(_paired(f"{array}[{attributes.get('key', i)}]", fields))
            i += 1
    rows = _rows(targets)
    parts = [row["label"].rstrip("]").partition("[") for row in rows]
    counts = Counter(array for array, _, _ in parts)
    names = [key if len(counts) == 1 else array if counts[array] == 1 else f"{array}[{key}]" for array, _, key in parts]
    return [{**row, "label": name} for row, name in zip(rows, names, strict=True)]


FORMATS = (
    TableFormat("FANUC program", (".ls",), read_fanuc),
    TableFormat("KUKA data list", (".dat", ".src"), read_kuka),
    TableFormat("RAPID module", (".mod", ".modx", ".prg", ".sys"), read_abb),
    TableFormat("URScript", (".script", ".urscript"), read_urscript),
    TableFormat("Yaskawa job", (".jbi",), read_yaskawa),
    TableFormat("Kawasaki AS program", (".as", ".pg"), partial(read_joints, KAWASAKI)),
    TableFormat("MELFA program", (".prg", ".mb4", ".mb5", ".mb6"), partial(read_joints, MITSUBISHI)),
    TableFormat("VAL3 data", (".dtx",), read_staubli),
)
