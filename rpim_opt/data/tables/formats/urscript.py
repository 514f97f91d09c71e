"""Programs of Universal Robots: ``movej([0.1, -1.57, ...])``, ``P1_q = [...]`` in rad, ``p[...]`` in m and rad."""

from __future__ import annotations

import math
import re

import scipy

from rpim_opt.data.tables.formats.registry import Rows, TableFormat

NUMBERS = r"\[\s*((?:[+-]?[\d.]+(?:e[+-]?\d+)?\s*,\s*){5}[+-]?[\d.]+(?:e[+-]?\d+)?)\s*\]"
TARGET = re.compile(rf"(?:(\w+)\s*=|(move[jlp])\s*\()\s*(p?){NUMBERS}", re.IGNORECASE)


def _plain(text: str) -> str:
    """Return a program without comments, its angles in rad."""
    radians = re.sub(r"d2r\(\s*([+-]?[\d.]+)\s*\)", lambda degrees: repr(math.radians(float(degrees[1]))), text)
    return re.sub(r"#.*", "", radians)


def read(text: str) -> Rows:
    """Return the joint values that are commanded or named if there are some, else the poses."""
    found = [each for each in TARGET.findall(_plain(text)) if each[0].lower() != "set_tcp"]
    joints = [each for each in found if not each[2]]
    rows = []
    for i, (name, _, pose, text_of) in enumerate(joints or found, start=1):
        values = [float(value) for value in text_of.split(",")]
        row = {"label": name.removesuffix("_q" if not pose else "_p") or str(i)}
        if not pose:
            row |= {f"joint_{k} [rad]": repr(value) for k, value in enumerate(values, start=1)}
        else:
            row |= {f"commanded {axis} [m]": repr(value) for axis, value in zip("xyz", values, strict=False)}
            turn = scipy.spatial.transform.Rotation.from_rotvec(values[3:]).as_quat()
            row |= {f"commanded q{part}": repr(float(value)) for part, value in zip("xyzw", turn, strict=True)}
        rows.append(row)
    return rows


FORMATS = (
    TableFormat("URScript", (".script", ".urscript"), lambda text: TARGET.search(_plain(text)) is not None, read),
)
