"""Data of Staubli: ``<Value key="0" j1="10" j2="-90" ... />`` joint points in degrees, poses by x, y, z."""

from __future__ import annotations

import re

from rpim_opt.data.tables.formats.registry import Rows, TableFormat

VALUE = re.compile(r"<Value\s([^<>]{0,2000})>")
FIELD = re.compile(r'\b(\w+)\s*=\s*"([^"]*)"')


def read(text: str) -> Rows:
    """Return the joint points if there are some, else the poses."""
    found = [dict(FIELD.findall(fields)) for fields in VALUE.findall(text)]
    joints = [each for each in found if "j1" in each]
    units = {f"j{i}": f"J{i} [deg]" for i in range(1, 7)}
    units |= {axis: f"commanded {axis} [mm]" for axis in "xyz"}
    rows = []
    for i, each in enumerate(joints or found):
        values = {units[name]: value for name, value in each.items() if name in units}
        rows.append({"label": each.get("key", str(i)), **values})
    return rows


FORMATS = (TableFormat("VAL3 data", (".dtx",), lambda text: VALUE.search(text) is not None, read),)
