"""The CSV file that RoboDK exports after calibration measurements: its columns count, not their names."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain, count
from pathlib import Path
from string import ascii_uppercase

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import Columns, numbers, read_columns
from rpim_opt.basics.units import joint_columns


def robodk_columns(path: str | Path, joints: Sequence[str], tools: dict[str, list[float]]) -> Columns:
    """Return the columns of RoboDK's file under our names.

    They are the joints [deg or mm], the measured point x, y, z [mm], and the reflector in the flange frame x, y, z [mm]
    (RoboDK's macro library reads it so). Every reflector gets a marker A, B, ...

    Parameters
    ----------
    path
        The file.
    joints
        ``"angle"`` or ``"length"`` for every joint.
    tools
        Reflectors that are known, marker to x, y, z [mm]; new ones are added.
    """
    try:
        table = list(read_columns(Path(path)).values())
        names = [*joint_columns(joints), "x_mm", "y_mm", "z_mm"]
        if len(table) < len(names) + 3:
            accepted = f"{len(joints)} joints, 3 measured and 3 of the tool"
            raise InputError("the header", f"{len(table)} columns", accepted)
        rows = [str(i) for i in range(1, len(table[0]) + 1)]
        places = [numbers(table[i], rows, f"{i + 1}") for i in range(len(names), len(names) + 3)]
    except InputError as error:
        raise error.within(path) from None
    markers = [_marker(place, tools) for place in np.column_stack(places)]
    return {**dict(zip(names, table, strict=False)), "marker": markers}


def _marker(place: np.ndarray, tools: dict[str, list[float]]) -> str:
    """Return the name of the reflector there [mm]; a new one is added to those that are known."""
    for name, known in tools.items():
        if np.allclose(known, place, atol=1e-6):
            return name
    names = chain(ascii_uppercase, (f"M{i}" for i in count(1)))
    name = next(name for name in names if name not in tools)
    tools[name] = place.tolist()
    return name
