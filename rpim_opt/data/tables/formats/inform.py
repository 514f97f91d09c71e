"""Jobs of Yaskawa: ``C00000=10.0,-90.0,...`` in degrees below ``///POSTYPE ANGLE``, in mm and degrees below others."""

from __future__ import annotations

import re

from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.tables.formats.registry import Rows, TableFormat

POINT = re.compile(r"^[ \t]*([BCP]+\d+)[ \t]*=[ \t]*([-+\d.][-+\d., \t]*)$", re.MULTILINE)
POSE = ("commanded x [mm]", "commanded y [mm]", "commanded z [mm]")


def read(text: str) -> Rows:
    """Return the points; pulses of encoders say no angles without the robot's gear ratios."""
    kind = re.search(r"///POSTYPE\s+(\w+)", text)
    if kind is None or kind[1] == "PULSE":
        raise InputError("the positions", "pulses of encoders", "///POSTYPE ANGLE or BASE: export the job so")
    rows = []
    for name, cells in POINT.findall(text):
        values = [cell.strip() for cell in cells.split(",")]
        names = [f"J{i} [deg]" for i in range(1, len(values) + 1)] if kind[1] == "ANGLE" else POSE
        rows.append({"label": name, **dict(zip(names, values, strict=False))})
    return rows


FORMATS = (TableFormat("Yaskawa job", (".jbi",), lambda text: POINT.search(text) is not None, read),)
