"""Targets of a robot: joint values, poses, or both, from tables and arrays."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, RowError
from rpim_opt.basics.tables import read_columns
from rpim_opt.basics.units import joint_columns, split_unit
from rpim_opt.data.measurements.pose import pose
from rpim_opt.data.measurements.position import position
from rpim_opt.data.tables.reading import read_data
from rpim_opt.robot.mdh import Robot

PLACE = ("x_mm", "y_mm", "z_mm")


class Targets(NamedTuple):
    """Rows of a table: labels; joint values (N, dof), poses (N, 7) or positions (N, 3), torques, payloads, or None.

    Torques are (N, dof), payloads (N,).
    """

    label: tuple[str, ...]
    q: Array | None
    poses: Array | None
    torque: Array | None
    payload: Array | None = None


def read_targets(source: Any, robot: Robot) -> Targets:
    """Return the targets of a table.

    Columns ``q1_deg``, ... are joint values; ``x_mm, y_mm, z_mm`` positions in the robot's base, with
    ``qw, qx, qy, qz``, ``rx_deg, ry_deg, rz_deg`` or ``r11`` to ``r33`` poses. A table has the former, the latter, or
    both: joint values are then where to look for those of the pose. Optional: ``label``, torques ``tau1_Nm``, ...,
    ``payload_kg``.

    Parameters
    ----------
    source
        A path (``.csv``, ``.parquet``, ``.xlsx``), a pandas or polars data frame, or a mapping from column names
        to cells.
    robot
        Its joints' number and types decide the joint columns.

    Raises
    ------
    InputError
        Naming the file, the row or column, what was found and what is accepted.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> robot = ro.load("paper_arm").problem.robot
    >>> targets = ro.use.read_targets({"label": ["P1"], "x_mm": [400], "y_mm": [0], "z_mm": [500]}, robot)
    >>> targets.label, targets.q, targets.poses
    (('P1',), None, array([[0.4, 0. , 0.5]]))
    """
    try:
        return _targets(dict(read_columns(source)), robot)
    except InputError as error:
        raise error.within(source if isinstance(source, str | Path) else None) from None


def _targets(columns: dict[str, Any], robot: Robot) -> Targets:
    """Return the targets of columns; read as measurements are, with zeros for the half that targets need not have."""
    stems = {split_unit(name)[0] for name in columns}
    joints = not stems.isdisjoint(f"q{i}" for i in range(1, robot.dof + 1))
    oriented = not stems.isdisjoint({"qw", "rx", "r11"})
    positions = oriented or not stems.isdisjoint("xyz")  # without x, y, z an orientation is refused as half a pose
    if not joints and not positions:
        raise InputError("the header", "no targets", "columns q1_deg, ..., or x_mm, y_mm, z_mm, or both")
    absent = [*([] if joints else joint_columns(robot.joint_dimensions)), *([] if positions else PLACE)]
    columns = columns | dict.fromkeys(absent, [0.0] * len(next(iter(columns.values()))))
    noise = {"position_mm": 1, "orientation_mrad": 1} if oriented else {"position_mm": 1}
    data = read_data(columns, robot, noise, pose if oriented else position)
    block, *others = data.blocks
    if others:
        raise InputError("column marker", "several reflectors", "targets of one")
    if block.approach is not None:
        accepted = "none: joints are in the middle of their backlash"
        raise InputError("column approach1", "directions of approach", accepted)
    return Targets(
        data.label,
        data.q if joints else None,
        block.y if positions else None,
        None if block.torque is None else block.torque[:, 0],
        block.payload,
    )


def checked(robot: Robot, stated: Targets, orientation: bool) -> Targets:
    """Return the targets as arrays, labelled, or say what does not fit."""
    rows = stated.q if stated.poses is None else stated.poses
    if rows is None:
        raise InputError("targets", "neither joint values nor poses", "q, poses, or both")
    N = len(np.atleast_1d(rows))
    q = _rows("q", stated.q, N, (robot.dof,))
    poses = _rows("poses", stated.poses, N, (7, 3))
    torque = _rows("torque", stated.torque, N, (robot.dof,))
    if poses is not None and poses.shape[1] == 7:
        try:
            poses = pose.prepare(poses)[:, : 7 if orientation else 3]
        except RowError as error:
            raise error.named(f"poses, {error.where}") from None
    if len(stated.label) not in (0, N):
        raise InputError("label", f"{len(stated.label)} labels", f"{N}, one a row")
    return Targets(stated.label or tuple(str(i) for i in range(1, N + 1)), q, poses, torque)


def _rows(name: str, stated: Array | None, N: int, columns: tuple[int, ...]) -> Array | None:
    """Return N rows of finite numbers, if there are any."""
    if stated is None:
        return None
    values = np.asarray(stated, dtype=float)
    if values.ndim != 2 or values.shape[1] not in columns or len(values) != N or not N:
        accepted = " or ".join(f"({N or 'N'}, {k})" for k in columns)
        raise InputError(name, f"shape {values.shape}", accepted)
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        raise InputError(f"{name}, row {row + 1}", f"{values[row].tolist()}", "finite numbers")
    return values
