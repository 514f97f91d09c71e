"""Targets of a robot: joint values, poses, or both, from tables and arrays."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, RowError
from rpim_opt.basics.tables import read_columns
from rpim_opt.basics.units import joint_columns, split_unit
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.pose import pose
from rpim_opt.data.measurements.position import position
from rpim_opt.data.tables.reading import read_data
from rpim_opt.robot.mdh import Robot


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
    >>> targets = ro.read_targets({"label": ["P1"], "x_mm": [400], "y_mm": [0], "z_mm": [500]}, robot)
    >>> targets.label, targets.q, targets.poses
    (('P1',), None, array([[0.4, 0. , 0.5]]))
    """
    try:
        return _targets(dict(read_columns(source)), robot)
    except InputError as error:
        raise error.within(source if isinstance(source, str | Path) else None) from None


class _Header(NamedTuple):
    """What the columns of a table speak of."""

    joints: bool
    positions: bool
    orientations: bool

    @classmethod
    def of(cls, names: Iterable[str], dof: int) -> _Header:
        stems = {split_unit(name)[0] for name in names}
        turned = not stems.isdisjoint({"qw", "rx", "r11"})
        return cls(
            joints=not stems.isdisjoint(f"q{i}" for i in range(1, dof + 1)),
            # without x, y, z an orientation is refused as half a pose
            positions=turned or not stems.isdisjoint("xyz"),
            orientations=turned,
        )


def _targets(columns: dict[str, Any], robot: Robot) -> Targets:
    """Return what the columns state; read as measurements are, whose weight does not matter."""
    header = _Header.of(columns, robot.dof)
    data = _read(_filled(columns, header, robot), robot, header.orientations)
    block, *others = data.blocks
    if others:
        raise InputError("column marker", "several reflectors", "targets of one")
    if block.approach is not None:
        raise InputError(
            "column approach1", "directions of approach", "none: joints are in the middle of their backlash"
        )
    targets = Targets(data.label, data.q, block.y, None, block.payload)
    if block.torque is not None:
        targets = targets._replace(torque=block.torque[:, 0])
    if not header.joints:
        targets = targets._replace(q=None)
    if not header.positions:
        targets = targets._replace(poses=None)
    return targets


def _filled(columns: dict[str, Any], header: _Header, robot: Robot) -> dict[str, Any]:
    """Return the columns with zeros for the half of a measurement that targets need not have."""
    if not header.joints and not header.positions:
        raise InputError("the header", "no targets", "columns q1_deg, ..., or x_mm, y_mm, z_mm, or both")
    absent: list[str] = []
    if not header.joints:
        absent += joint_columns(robot.joint_dimensions)
    if not header.positions:
        absent += ["x_mm", "y_mm", "z_mm"]
    count = len(next(iter(columns.values())))
    return columns | dict.fromkeys(absent, [0.0] * count)


def _read(columns: dict[str, Any], robot: Robot, turned: bool) -> Dataset:
    if turned:
        return read_data(columns, robot, {"position_mm": 1, "orientation_mrad": 1}, pose)
    return read_data(columns, robot, {"position_mm": 1}, position)


def checked(robot: Robot, given: Targets, orientation: bool) -> Targets:
    """Return the targets as arrays, labelled, or say what does not fit."""
    asked = given.q if given.poses is None else given.poses
    if asked is None:
        raise InputError("targets", "neither joint values nor poses", "q, poses, or both")
    N = len(np.atleast_1d(asked))
    q = _rows("q", given.q, N, (robot.dof,))
    poses = _rows("poses", given.poses, N, (7, 3))
    torque = _rows("torque", given.torque, N, (robot.dof,))
    if poses is not None and poses.shape[1] == 7:
        poses = _normalized(poses)[:, : 7 if orientation else 3]
    if len(given.label) not in (0, N):
        raise InputError("label", f"{len(given.label)} labels", f"{N}, one a row")
    return Targets(given.label or tuple(str(i) for i in range(1, N + 1)), q, poses, torque)


def _rows(name: str, given: Array | None, N: int, columns: tuple[int, ...]) -> Array | None:
    """Return N rows of finite numbers, if there are any."""
    if given is None:
        return None
    values = np.asarray(given, dtype=float)
    if values.ndim != 2 or values.shape[1] not in columns or len(values) != N or not N:
        accepted = " or ".join(f"({N or 'N'}, {k})" for k in columns)
        raise InputError(name, f"shape {values.shape}", accepted)
    finite = np.isfinite(values).all(axis=1)
    if not finite.all():
        row = int(np.argmin(finite))
        raise InputError(f"{name}, row {row + 1}", f"{values[row].tolist()}", "finite numbers")
    return values


def _normalized(poses: Array) -> Array:
    try:
        return pose.prepare(poses)
    except RowError as error:
        raise error.named(f"poses, {error.where}") from None
