"""Cameras on the flange or beside the robot, and their calibration boards.

The pinhole has radial and tangential distortion; a board's points come from a table or are a pattern.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, in_file, pick
from rpim_opt.basics.tables import Columns, read_columns, texts
from rpim_opt.basics.units import LARGEST, split, split_unit
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.data.measurements.measurement import Measurement, Words
from rpim_opt.data.tables.reading import quantities_of, require_unique

INTRINSICS = {
    "fx": "pixel", "fy": "pixel", "cx": "pixel", "cy": "pixel",
    "k1": "", "k2": "", "p1": "", "p2": "", "k3": "",
}  # fmt: skip
"""Focal lengths and centre, and distortion in the order of OpenCV."""
STRETCH = {"stretch_x": "ratio", "stretch_y": "ratio"}
"""Relative stretch of a printed board against its file, along its axes."""
TARGET = {"target_x": "length", "target_y": "length", "target_z": "length"}
"""Columns with the coordinates of a row's point on its board."""
Board = Mapping[str, Sequence[float] | Array]
"""Positions (3,) [m] of points on their board, by name."""
LEAST = 2
MOST = 300
"""Points along either side of a pattern; a larger board is stated as a table of its points."""


def pixels(point: Iterable[Any], camera: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return u and v [px] of a point in the camera's frame, x right, y down, z forwards; symbols, numbers or arrays.

    With the camera's `INTRINSICS`, (X, Y, Z) the point, x = X / Z, y = Y / Z and r^2 = x^2 + y^2 (Brown and Conrady)::

        u = fx [x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)] + cx
        v = fy [y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y] + cy
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = (camera[name] for name in INTRINSICS)
    X, Y, Z = point
    x = X / Z
    y = Y / Z
    r2 = x**2 + y**2
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return fx * u + cx, fy * v + cy


def _in_camera(carried: bool, T: Any, values: Mapping[str, Any]) -> Any:
    """Return a point in the camera's frame; T (4, 4) is the board that the robot carries, or else the camera."""
    x = values["target_x"] * (1 + values["board_stretch_x"])
    y = values["target_y"] * (1 + values["board_stretch_y"])
    point = ca.vertcat(x, y, values["target_z"])
    return T[:3, :3] @ point + T[:3, 3] if carried else T[:3, :3].T @ (point - T[:3, 3])


def _pixels_of(carried: bool, T: Any, **values: Any) -> Any:
    intrinsics = {name: values[f"camera_{name}"] for name in INTRINSICS}
    return ca.vertcat(*pixels(ca.vertsplit(_in_camera(carried, T, values)), intrinsics))


def _metres_of(carried: bool, T: Any, **values: Any) -> Any:
    """Return how far apart lines of sight through neighbouring pixels are at the point [m]: Z / f."""
    return _in_camera(carried, T, values)[2] / ca.sqrt(values["camera_fx"] * values["camera_fy"])


_WORDS = Words(
    target="a camera",
    at_flange="The camera (z forwards, x right, y down in the image)",
    frame="in the frame of the board",
    noise_of="corners detected to a fifth of a pixel",
    wrong="a wrong corner",
    columns={"u": "measured pixel, to the right", "v": "measured pixel, downwards"},
)
eye_in_hand = Measurement(
    "eye_in_hand",
    model=partial(_pixels_of, False),
    columns={"u": "pixel", "v": "pixel"},
    noise={"pixel": "pixel"},
    parameters={f"camera_{name}": d for name, d in INTRINSICS.items()}
    | {f"board_{name}": d for name, d in STRETCH.items()},
    depends_on=tuple(TARGET),
    extra=TARGET,
    names=("point",),
    accepted=dict.fromkeys(
        TARGET, 'the target\'s points: target = "board.csv", or columns target_x_mm, target_y_mm, target_z_mm'
    ),
    words=_WORDS,
    shown_by=lambda tables: any({"u", "v"} <= {split(name)[0].strip().lower() for name in table} for table in tables),
    registers=True,
    turning=True,
    metres=partial(_metres_of, False),
)
"""A point of a fixed board, seen by a camera on the flange: r = (u, v) - pixels(T^-1 p), with T the camera in the
board's frame, which is the instrument's."""

eye_to_hand = replace(
    eye_in_hand,
    name="eye_to_hand",
    model=partial(_pixels_of, True),
    metres=partial(_metres_of, True),
    words=_WORDS._replace(target="a board", at_flange="The board", frame="in the frame of the camera"),
)
"""A point of a board on the flange, seen by a fixed camera: r = (u, v) - pixels(T p), with T the board in the camera's
frame, which is the instrument's."""

TYPES = (eye_in_hand, eye_to_hand)
CAMERAS = {m.name: m for m in TYPES}


def grid_board(columns: int, rows: int, spacing: float) -> dict[str, Array]:
    """Return the points (3,) of a chessboard or a grid of circles, numbered from 0 row by row as OpenCV finds them.

    ``columns`` and ``rows`` are the numbers of inner corners along x and y, ``spacing`` their distance [m].

    >>> import rpim_opt as ro
    >>> board = ro.data.grid_board(9, 6, 0.025)
    >>> len(board), board["10"]
    (54, array([0.025, 0.025, 0.   ]))
    """
    if not (LEAST <= columns <= MOST and LEAST <= rows <= MOST):
        raise InputError("board", f"{columns!r:.20} x {rows!r:.20} points", f"two to {MOST} along either side")
    if not 0 < spacing <= LARGEST:
        raise InputError("board", f"a spacing of {spacing:g} m", "a length greater than zero")
    y, x = np.divmod(np.arange(columns * rows), columns)
    places = spacing * np.column_stack([x, y, np.zeros(columns * rows)])
    return {str(i): place for i, place in enumerate(places)}


def read_board(source: Any) -> dict[str, Array]:
    """Return the points (3,) [m] of a board by name, from a table with columns point, x_mm, y_mm and perhaps z_mm.

    The source is a file, a data frame, or a mapping from column names to cells.

    >>> import rpim_opt as ro
    >>> ro.data.read_board({"point": ["a", "b"], "x_mm": [0, 25], "y_mm": [0, 0]})["b"]
    array([0.025, 0.   , 0.   ])
    """
    accepted = "point, x_mm, y_mm, perhaps z_mm"
    with in_file(source):
        table = read_columns(source)
        if {"point", "x", "y"} - {split_unit(name)[0] for name in table}:
            raise InputError("the header", f"columns {', '.join(table)}", accepted)
        names = texts(table["point"], "point")
        require_unique(names, "point")
        places = quantities_of(table, {axis: ["length"] for axis in "xyz"}, ["point"], names)
    flat = {("z", ""): np.zeros(len(names)), **places}
    return dict(zip(names, np.column_stack([flat[axis, ""] for axis in "xyz"]), strict=True))


def views(q: Array, board: Board, uv: Array, sigma: float | Array, measurement: str = "eye_in_hand") -> Dataset:
    """Return the dataset of a camera's views of a board's P points at joint values q (V, dof) [rad or m].

    ``uv`` (V, P, 2) are the points' image coordinates [px], NaN if a point was not found; ``sigma`` is one standard
    deviation [px], or the covariance of u and v, (2, 2) or (V, P, 2, 2) [px^2]; ``measurement`` is ``"eye_to_hand"`` if
    the robot carries the board. InputError for shapes that do not fit together, and other measurement types.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> board = ro.data.grid_board(4, 3, 0.03)
    >>> data = ro.data.views(np.zeros((2, 6)), board, np.full((2, 12, 2), 500.0), sigma=0.1)
    >>> len(data), data.label[12], len(set(data.configuration))
    (24, 'v1/0', 2)
    """
    kind = pick(CAMERAS, measurement, "measurement")
    q, uv = np.asarray(q, dtype=float), np.asarray(uv, dtype=float)
    P = len(board)
    if q.ndim != 2 or uv.shape != (len(q), P, 2):
        raise InputError("q and uv", f"shapes {q.shape} and {uv.shape}", f"(V, dof) and (V, {P}, 2)")
    view, point = np.nonzero(np.isfinite(uv).all(axis=2))
    names = np.array(list(board), dtype=object)
    places = np.array(list(board.values()), dtype=float)[point]
    columns = dict(zip(TARGET, places.T, strict=True))
    spread = np.asarray(sigma, dtype=float)
    if spread.ndim == 4:
        spread = spread[view, point]
    label = tuple(f"v{v}/{names[p]}" for v, p in zip(view, point, strict=True))
    data = Dataset.of(q[view], uv[view, point], spread, label, kind, columns=columns, point=names[point])
    return replace(data, configuration=view)


def on_board(table: Columns, board: Board) -> Columns:
    """Return the columns of a table of corners, including point, and the points of the board, if there is one."""
    if not board:
        return table
    own = [name for name in table if split_unit(name)[0] in TARGET]
    if own:
        raise InputError("the header", f"column '{own[0]}' beside a target", "one of them")
    if "point" not in table:
        accepted = "a column point with the name of the board's point"
        raise InputError("the header", f"no column point among {', '.join(table)}", accepted)
    names = texts(table["point"], "point")
    label = texts(table["label"], "label") if "label" in table else range(1, len(names) + 1)
    rows = zip(names, label, strict=True)
    points = [pick(board, name, f"row {row}, column point", also="a point of the target: ") for name, row in rows]
    places = np.array(points).T.tolist()
    return {**table, **{f"{stem}_m": values for stem, values in zip(TARGET, places, strict=True)}}


def targets(block: Block) -> Array:
    """Return where the points of a camera's block are on their board (N, 3) [m]."""
    return np.column_stack([block.columns[stem] for stem in TARGET])


def board_of(data: Dataset) -> dict[str, Array]:
    """Return the points that the rows of cameras name, by name."""
    board = {}
    for block in data.blocks:
        if block.measurement.by_camera and block.point is not None:
            board |= dict(zip(map(str, block.point[:, 0]), targets(block), strict=True))
    return board
