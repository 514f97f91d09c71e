"""Programs of FANUC as listings: ``P[1:"name"]{ GP1: UF : 0, UT : 1, J1= 10.000 deg, ... };``."""

from __future__ import annotations

import re

from rpim_opt.data.tables.formats.registry import Rows, TableFormat

POINT = re.compile(r'P\[(\d+)(?::"([^"]*)")?\]\s*\{(.*?)\};', re.DOTALL)
FIELD = re.compile(r"\b(J\d|[XYZWPR])\s*=\s*([+-]?[\d.]+)\s*(deg|mm)")


def read(text: str) -> Rows:
    """Return the points; a position register without values (``********``) has none."""
    points = POINT.findall(text)
    comments = [comment for _, comment, _ in points]
    named = all(comments) and len(set(comments)) == len(comments)
    rows = []
    for number, comment, fields in points:
        row = {"label": comment if named else f"P{number}"}
        for name, value, unit in FIELD.findall(fields):
            row[f"{name} [{unit}]" if name[0] == "J" else f"commanded {name} [{unit}]"] = value
        rows.append(row)
    return rows


FORMATS = (TableFormat("FANUC program", (".ls",), lambda text: POINT.search(text) is not None, read),)
