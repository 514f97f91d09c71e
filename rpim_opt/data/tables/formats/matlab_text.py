"""MATLAB's matrices as text, ``Q = [0 -90; 10 -80];``, with one row per configuration and units in comments."""

from __future__ import annotations

import re

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import records
from rpim_opt.basics.units import split
from rpim_opt.data.tables.formats.registry import Rows, TableFormat

MATRIX = re.compile(
    r"(?:%([^\n]*)\n\s*)?^[ \t]*(\w+)[ \t]*=[ \t]*\[([^\]]*)\][ \t]*;?[ \t]*(?:%([^\n]*))?", re.MULTILINE
)


def read(text: str) -> Rows:
    """Return the rows of all matrices, with the only unit that a comment above or behind them names."""
    columns: dict[str, list[str]] = {}
    for above, name, inside, behind in MATRIX.findall(text):
        plain = re.sub(r"%.*|\.\.\.[^\n]*\n", "", inside)
        rows = [row.strip(" \t,") for row in re.split(r"[;\n]", plain) if row.strip(" \t,")]
        units = {
            split(f"{name} [{word}]")[1] for word in re.findall(r"[^\W\d]+|°", behind or above) if word != "in"
        } - {""}
        cells = [f"[{row}]" if re.search(r"[\s,]", row) else row for row in rows]
        columns[f"{name} [{units.pop()}]" if len(units) == 1 else name] = cells
    if len({*map(len, columns.values())}) > 1:
        found = ", ".join(f"{name} {len(cells)}" for name, cells in columns.items())
        raise InputError("the matrices", f"rows of {found}", "matrices with one row per configuration")
    return records(columns)


FORMATS = (TableFormat("MATLAB text", (".m",), read),)
