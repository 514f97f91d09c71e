"""Orientations whose columns are numbered: quaternions, matrices row by row, and rotation vectors."""

from __future__ import annotations

import re
from itertools import product

import numpy as np
import scipy

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import Columns, numbers
from rpim_opt.data.tables.names import Readings

ORDERS = ("wxyz", "xyzw")
QUATERNION = re.compile(r"(q|quat|quaternion|orientation|orient|rot|rotation)[_ ]?\[?([0-4])\]?")
MATRIX = re.compile(r"(?:m|t|h|r|mat|matrix|tf|pose)[_ \[(]*([0-4])[_ ,\]\[]*([0-4])[\])]?")
ENTRIES = re.compile(r"(?:m|t|h|mat|matrix|tf|pose)[_ \[]*(\d{1,2})\]?")
SHAPES = {9: (3, 3), 12: (3, 4), 16: (4, 4)}
"""Rows and columns of a matrix by its number of entries."""
EULER = re.compile(r"(?:extrinsic|intrinsic) ([xyz])(?!\1)([xyz])(?!\2)[xyz]")
"""Three turns about axes that stand still, or that turn with it."""
ROUNDED = 1e-6
"""The last row of a matrix is 0 0 0 1 within this."""
Place = tuple[int, int]


def numbered(read: Readings, table: Columns, dof: int, order: str) -> None:
    """Give the columns of quaternions (in that order) and matrices their names."""
    if order not in ORDERS:
        raise InputError("--quaternion", f"'{order}'", " or ".join(ORDERS))
    for i, (name, letter) in enumerate(zip(quaternion_columns(read, dof), order, strict=False), start=1):
        read[name] = read[name]._replace(stem=f"q{letter}", why=f"component {i} of a quaternion, order {order}")
    stems = {found.stem for found in read.values()}
    if {"qx", "qy", "qz"} <= stems and "qw" not in stems:
        zeroth = [name for name in read if re.fullmatch(r"q_?0", name.strip().lower())]
        read.update({name: read[name]._replace(stem="qw", why="beside qx, qy, qz") for name in zeroth})
    # the columns of a matrix with their row and column from 0
    pairs: dict[str, Place] = {}
    single: dict[str, int] = {}
    for name in read:
        plain = re.sub(r"[_ ](mm|m)$", "", name.partition("[mm]")[0].strip().lower())
        pair, alone = MATRIX.fullmatch(plain), ENTRIES.fullmatch(plain)
        if pair:
            pairs[name] = (int(pair[1]), int(pair[2]))
        elif alone:
            single[name] = int(alone[1])
    first = min((i for i, _ in pairs.values()), default=0)
    places = {name: (i - first, j - first) for name, (i, j) in pairs.items()}
    if len(pairs) not in SHAPES or set(places.values()) != set(product(*map(range, SHAPES[len(pairs)]))):
        single |= {name: 10 * i + j for name, (i, j) in pairs.items()}
        ordered = sorted(single, key=lambda name: single[name])
        whole = len(ordered) in (12, 16) and single[ordered[-1]] - single[ordered[0]] == len(ordered) - 1
        places = {name: divmod(k, 4) for k, name in enumerate(ordered)} if whole else {}
    why = "a matrix, row by row"
    if len(places) == 16:
        matrices = np.empty((len(next(iter(table.values()))), 4, 4))
        for name, (i, j) in places.items():
            matrices[:, i, j] = numbers(table[name], name)
        row, column = (np.abs(part - [0, 0, 0, 1]).max() < ROUNDED for part in (matrices[:, 3], matrices[:, :, 3]))
        if not row and not column:
            raise InputError("the matrices", "neither a last row nor a last column 0 0 0 1", "4 x 4 transforms")
        why = "a matrix, row by row: its last row is 0 0 0 1"
        if not row:
            places = {name: (j, i) for name, (i, j) in places.items()}
            why = "a matrix, column by column: its last column is 0 0 0 1"
    for name, (row, column) in places.items():
        stem = "the last row of a matrix"
        if row < 3:
            stem = "xyz"[row] if column == 3 else f"r{row + 1}{column + 1}"
        read[name] = read[name]._replace(stem=stem, why=why)


def quaternion_columns(read: Readings, dof: int) -> list[str]:
    """Return the four columns of a quaternion whose components are numbered, in order; none where there is none.

    ``q0 ... q3`` are one where other columns are the joints.
    """
    found: dict[str, dict[int, str]] = {}
    for name in read:
        match = QUATERNION.fullmatch(name.strip().lower())
        if match:
            found.setdefault(match[1], {})[int(match[2])] = name
    for prefix, columns in found.items():
        if sorted(columns) in ([0, 1, 2, 3], [1, 2, 3, 4]):
            others = {each.stem for name, each in read.items() if name not in columns.values()}
            counted = any(all(f"q{i + first}" in others for i in range(dof)) for first in (0, 1))
            if prefix != "q" or counted:
                return [columns[i] for i in sorted(columns)]
    return []


def quaternions(angles: np.ndarray, rotation: str) -> dict[str, list[str]]:
    """Return ``qw, qx, qy, qz`` of columns rx, ry, rz (N, 3) [rad], none for rows that are not finite.

    Of ``intrinsic zyx`` the turn about z is first, and the column rz has it; of ``intrinsic zyz`` the columns have the
    first, second and third turn.
    """
    kept = np.isfinite(angles).all(axis=1)
    rotations = scipy.spatial.transform.Rotation
    if rotation == "vector":
        found = rotations.from_rotvec(angles[kept])
    else:
        how, order = rotation.split()
        places = ["xyz".index(axis) for axis in order] if len(set(order)) == 3 else [0, 1, 2]
        found = rotations.from_euler(order.upper() if how == "intrinsic" else order, angles[kept][:, places])
    cells = np.full((len(angles), 4), "", dtype=object)
    cells[kept] = [list(map(repr, row)) for row in found.as_quat().tolist()]
    return {f"q{part}": list(cells[:, "xyzw".index(part)]) for part in "wxyz"}
