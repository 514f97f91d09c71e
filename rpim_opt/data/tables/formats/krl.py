"""Data lists and programs of KUKA: ``DECL E6AXIS XP1={A1 10.0,A2 -90.0,...}``; poses are E6POS, POS and FRAME."""

from __future__ import annotations

import re

from rpim_opt.data.tables.formats.registry import Rows, TableFormat

TARGET = re.compile(r"(?:(?:E6AXIS|AXIS|E6POS|POS|FRAME)\s+(\w+)\s*=|PTP|LIN)\s*\{([^{}]{0,500})\}", re.IGNORECASE)
AXES = re.compile(r"\bA1\b", re.IGNORECASE)
FIELD = re.compile(r"\b([A-Z]\d?)\s+([+-]?[\d.]+(?:E[+-]?\d+)?)", re.IGNORECASE)
NAMES = {**{f"A{i}": f"A{i} [deg]" for i in range(1, 7)}, **{axis: f"commanded {axis} [mm]" for axis in "XYZ"},
         **{turn: f"commanded {turn} [deg]" for turn in "ABC"}}  # fmt: skip


def read(text: str) -> Rows:
    """Return the targets: axis values if there are some, else poses; external axes are left out."""
    found = TARGET.findall(text)
    axes = [each for each in found if AXES.search(each[1])]
    inline = all(name.upper().startswith("X") for name, _ in axes or found)  # as inline forms name P1's data
    rows = []
    for i, (name, fields) in enumerate(axes or found, start=1):
        values = {NAMES[key.upper()]: value for key, value in FIELD.findall(fields) if key.upper() in NAMES}
        rows.append({"label": name[1:] if inline else name or str(i), **values})
    return rows


FORMATS = (TableFormat("KUKA data list", (".dat", ".src"), lambda text: TARGET.search(text) is not None, read),)
