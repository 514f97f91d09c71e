"""Modules of ABB: ``CONST jointtarget P1:=[[10,-90,...],[9E9,...]];`` in degrees, robtarget in mm with w first."""

from __future__ import annotations

import re

from rpim_opt.data.tables.formats.registry import Rows, TableFormat

JOINTS = re.compile(r"(?:jointtarget\s+(\w+)\s*:=|MoveAbsJ)\s*\[\s*\[([^\]]*)\]", re.IGNORECASE)
POSES = re.compile(r"(?:robtarget\s+(\w+)\s*:=|Move[JL])\s*\[\s*\[([^\]]*)\]\s*,\s*\[([^\]]*)\]", re.IGNORECASE)
POSE = [*(f"commanded {axis} [mm]" for axis in "xyz"), *(f"commanded q{part}" for part in "wxyz")]


def read(text: str) -> Rows:
    """Return the joint targets if there are some, else the poses; external axes are left out."""
    text = re.sub(r"!.*", "", text)
    joints = [(name, values.split(",")) for name, values in JOINTS.findall(text)]
    poses = [(name, [*place.split(","), *turn.split(",")]) for name, place, turn in POSES.findall(text)]
    rows = []
    for i, (name, values) in enumerate(joints or poses, start=1):
        names = [f"rax_{k} [deg]" for k in range(1, len(values) + 1)] if joints else POSE
        rows.append({"label": name or str(i), **dict(zip(names, map(str.strip, values), strict=False))})
    return rows


def _has_targets(text: str) -> bool:
    return any(pattern.search(text) for pattern in (JOINTS, POSES))


FORMATS = (TableFormat("RAPID module", (".mod", ".modx", ".prg", ".sys"), _has_targets, read),)
