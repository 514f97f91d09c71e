"""Tables as text: JSON and YAML (an object a line or document, an array of objects, an object of columns), MATLAB.

MATLAB's matrices, ``Q = [0 -90; 10 -80];``, have one row per configuration and units in comments.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import parse_json
from rpim_opt.basics.tables import library, records
from rpim_opt.basics.units import split
from rpim_opt.data.tables.formats.registry import Rows, TableFormat

MESSAGE = re.compile(r"^name: *\[[^\]]*\]\nposition: *\[", re.MULTILINE)
"""Joint states as printed by `rostopic echo` and `ros2 topic echo --flow-style`."""
MATRIX = re.compile(
    r"(?:%([^\n]*)\n\s*)?^[ \t]*(\w+)[ \t]*=[ \t]*\[([^\]]*)\][ \t]*;?[ \t]*(?:%([^\n]*))?", re.MULTILINE
)


def read(text: str) -> Rows:
    """Return the rows; names of objects within objects are joined by points, ``measured.x_mm``."""
    lines = [line for line in text.splitlines() if line.strip()]
    try:
        if not text.lstrip().startswith("[") and len(lines) > 1 and lines[0].rstrip().endswith("}"):
            content = [parse_json(line) for line in lines]
        else:
            content = parse_json(text)
    except ValueError as error:
        raise InputError("the JSON text", str(error), "a complete JSON file, or one object per line") from None
    return _rows(content)


def read_yaml(text: str) -> Rows:
    """Return the rows of a YAML text; refuse aliases, which may expand beyond memory."""
    yaml = library("yaml", "YAML files")
    try:
        if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text)):
            raise InputError("the YAML text", "an alias (*)", "values written out")
        documents = [document for document in yaml.safe_load_all(text) if document is not None]
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise InputError("the YAML text", " ".join(str(error).split())[:200], "a complete YAML file") from None
    return _rows(documents[0] if len(documents) == 1 else documents)


def _rows(found: Any) -> Rows:
    units = _units(found)
    if isinstance(found, dict):
        lists = {name: cells for name, cells in found.items() if isinstance(cells, list)}
        inner = [cells for cells in lists.values() if cells and all(isinstance(row, dict) for row in cells)]
        columns = len(lists) == len(found) or any(isinstance(cell, list) for cells in lists.values() for cell in cells)
        if columns and len(set(map(len, lists.values()))) != 1:
            raise InputError("the text", "lists of several lengths", "an array of rows, or columns of one length")
        if columns:
            found = records(lists)
        else:
            found = inner[0] if len(inner) == 1 else [found]
    if not isinstance(found, list) or not all(isinstance(row, dict) for row in found):
        raise InputError("the text", "an array of other values", "an array of objects, one per row")
    named = [
        {f"{name} [{units[name]}]" if name in units else name: cell for name, cell in row.items()} for row in found
    ]
    return [dict(_flat("", row)) for row in named]


def _units(found: Any) -> dict[str, str]:
    """Return the units that an object states by the names of the columns, in ``units`` of its own or of its header."""
    inner = found if isinstance(found, dict) else {}
    for part in (inner, *(each for each in inner.values() if isinstance(each, dict))):
        stated = next((each for name, each in part.items() if str(name).lower() == "units"), None)
        if isinstance(stated, dict):
            return {name: unit for name, unit in stated.items() if split(f"{name} [{unit}]")[1]}
    return {}


def _flat(prefix: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the values of an object with their names; lists of numbers stay together."""
    if not isinstance(value, Mapping):
        if value is not None:
            yield prefix, value
        return
    stem, unit = split(prefix)
    joints = value.get("name")
    for name, part in value.items():
        if isinstance(joints, list) and isinstance(part, list):
            # ROS: lists of values parallel to a list of names, in any order
            topic = f"/{prefix}" if prefix else ""
            if part is not joints:
                yield from ((f"{topic}/{joint}/{name}", cell) for joint, cell in zip(joints, part, strict=False))
            continue
        whole = f"{stem}.{name} [{unit}]" if unit else f"{prefix}.{name}"
        yield from _flat(whole if prefix else name, part)


def read_matlab(text: str) -> Rows:
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


FORMATS = (
    TableFormat("JSON", (".json", ".jsonl", ".ndjson"), read),
    TableFormat("YAML", (".yaml", ".yml"), read_yaml),
    TableFormat("ROS messages", (".txt", ".log"), lambda text: read_yaml(text) if MESSAGE.search(text) else ()),
    TableFormat("MATLAB text", (".m",), read_matlab),
)
