"""The board that a new folder's camera sees, and whether the camera is on the flange or beside the robot."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.tables import Columns
from rpim_opt.basics.units import UNITS
from rpim_opt.data.board import Board, grid_board, on_board, read_board
from rpim_opt.data.models import CAMERAS, Measurement
from rpim_opt.data.tables.reading import read_data
from rpim_opt.problem.frames import starting_cameras
from rpim_opt.problem.located import locate
from rpim_opt.problem.views import posed
from rpim_opt.robot.chain import Described
from rpim_opt.robot.kinematics import forward_kinematics, numeric_frame

TARGET_FILE = "target.csv"
"""What a board's table is called in a folder."""
GRID = re.compile(r"(\d{1,6})\s*x\s*(\d{1,6})\s*,\s*(\d+\.?\d*|\.\d+)\s*(mm|m)", re.ASCII)
CLEARLY = 3.0
"""The camera is where the poses fit so many times better."""


@dataclass(frozen=True, eq=False)
class SeenTarget:
    """A board: its points, what ``target`` of a problem file says of it, and the table to write, if it has one."""

    board: Board
    stated: str
    table: Columns

    def under(self, columns: Columns) -> Columns:
        """Return the columns of a table of corners with where their points are; as they are without a board."""
        if not self.board:
            return columns
        return on_board(columns, self.board)


def seen_target(text: str) -> SeenTarget:
    """Return the board that ``--target`` states: a table, or columns, rows and spacing of a grid; empty for nothing.

    Examples
    --------
    >>> from rpim_opt.store.seen_target import seen_target
    >>> seen_target("7x5,30mm").stated
    'target = { columns = 7, rows = 5, spacing_mm = 30 }'
    """
    if not text:
        return SeenTarget({}, "", {})
    match = GRID.fullmatch(text.strip())
    if match:
        columns, rows, spacing, unit = match.groups()
        board = grid_board(int(columns), int(rows), float(spacing) * UNITS[unit].si)
        return SeenTarget(board, f"target = {{ columns = {columns}, rows = {rows}, spacing_{unit} = {spacing} }}", {})
    if "." not in text:
        raise InputError("--target", f"'{text}'", "a table with point, x_mm, y_mm, or a grid such as 7x5,30mm")
    board = read_board(text)
    places = np.array(list(board.values())) * 1e3
    table = {"point": list(board)}
    table |= {f"{axis}_mm": [repr(float(v)) for v in column] for axis, column in zip("xyz", places.T, strict=True)}
    return SeenTarget(board, f'target = "{TARGET_FILE}"', table)


def which_camera(arm: Described, columns: Columns) -> tuple[Measurement, str]:
    """Return whether the camera is on the flange or beside the robot, by what its poses fit, and how that was found.

    Raises
    ------
    InputError
        Where neither fits clearly better.
    """
    misfit = {name: _misfit(arm, columns, kind) for name, kind in CAMERAS.items()}
    best, other = sorted(misfit, key=lambda name: misfit[name])
    said = f"{1e3 * misfit[best]:.3g} mm RMS, {other} {1e3 * misfit[other]:.3g} mm"
    if not misfit[other] > CLEARLY * misfit[best]:
        raise InputError("the camera", f"no clear place ({best} leaves {said})", f"--measurement {best} or {other}")
    return CAMERAS[best], f"guessed: single views of the board, robot nominal and lens not fitted, leave {said}"


def _misfit(arm: Described, columns: Columns, kind: Measurement) -> float:
    """Return by how much poses of the views are off (RMS) where base and tool fit best [m]."""
    data = read_data(columns, arm.robot, {"pixel_px": 1.0}, kind)
    poses = posed(data, starting_cameras(data, {}))
    tools = {block.markers[0]: np.zeros(6) for block in poses.blocks}
    base, places, _ = locate(arm.robot, poses, tools)
    squares = []
    for block in poses.blocks:
        T = numeric_frame(base) @ forward_kinematics(arm.robot, block.q[:, 0]) @ numeric_frame(places[block.markers[0]])
        squares += np.sum((T[:, :3, 3] - block.y[:, :3]) ** 2, axis=1).tolist()
    return float(np.sqrt(np.mean(squares)))
