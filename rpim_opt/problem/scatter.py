"""The robot's own scatter beside the instrument's noise, and the rows of a configuration that share it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.problem.row_functions import Evaluation
from rpim_opt.robot.parameter_names import own_name

SHIFTED = ("base_x", "base_y", "base_z")
"""Parameters that move all of a robot alike."""


@dataclass(frozen=True, eq=False)
class Scatter:
    """By how much a robot misses where its model sends it, from configuration to configuration.

    The covariance of all that was measured in one configuration is::

        instrument^2 Sigma + position^2 I_length + orientation^2 I_angle + joint^2 J_theta J_theta'

    with Sigma as the rows state it and J_theta (k, dof) the slopes by the angles of the revolute joints: a joint that
    stops elsewhere shows in every reflector of a configuration, and the more the longer the lever arm.

    Parameters
    ----------
    position
        Standard deviation of every measured length, apart from the joints' part [m].
    orientation
        Of every measured angle [rad].
    joint
        Of every revolute joint [rad].
    instrument
        By how much the stated noise is multiplied; 1 for as stated.
    at
        (P,) values of all parameters at which the joints' slopes are taken [SI]; nominal if there are none.

    Examples
    --------
    >>> import dataclasses
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem  # 0.03 mm of instrument
    >>> rough = dataclasses.replace(problem, scatter=ro.problem.Scatter(position=40e-6))
    >>> x = np.zeros(len(problem.parameters.free))
    >>> bool(np.allclose(problem.linearize(x).b / rough.linearize(x).b, 5 / 3))
    True
    """

    position: float = 0.0
    orientation: float = 0.0
    joint: float = 0.0
    instrument: float = 1.0
    at: Array | None = None


@dataclass(frozen=True, eq=False)
class Stack:
    """Configurations with the same number k of equations: what divides their noise, one array each.

    Parameters
    ----------
    index
        (N, k) numbers of the equations.
    instrument
        (N, k, k) covariance as the rows state it [SI].
    length, angle
        (N, k) which equations are lengths, and which angles.
    joint
        (N, k, dof) slopes by the revolute joints' angles [SI]; (N, k, 0) where nobody asks. Where equations mix several
        stops of the joints, dof columns a stop.
    unit
        (N, k, k) covariance of a unit scatter of every measured position where equations mix several, or a camera sees
        several points of one; None where each has its own, 1 on the diagonal for lengths.
    """

    index: np.ndarray
    instrument: Array
    length: np.ndarray
    angle: np.ndarray
    joint: Array
    unit: Array | None = None

    @property
    def positional(self) -> bool:
        """Whether any equation shows a scatter of positions."""
        return self.unit is not None or bool(self.length.any())

    def of(self, dimension: str) -> np.ndarray:
        """Return which equations (N, k) are of a dimension: ``length``, ``angle``, or any other."""
        if dimension == "length":
            return self.length
        if dimension == "angle":
            return self.angle
        return ~(self.length | self.angle)

    def covariance(self, scatter: Scatter, reading: bool = True) -> Array:
        """Return the covariances (N, k, k) [SI] of the residuals; without the instrument's part if not of a reading."""
        k = self.index.shape[1]
        own = scatter.orientation**2 * self.angle
        if self.unit is None:
            own = scatter.position**2 * self.length + own
        found = own[:, :, None] * np.eye(k)
        if self.unit is not None:
            found += scatter.position**2 * self.unit
        if scatter.joint > 0:
            found += scatter.joint**2 * self.joint @ self.joint.transpose(0, 2, 1)
        if reading:
            found += scatter.instrument**2 * self.instrument
        return found


def stacked(data: Dataset, slopes: Array | None = None, shifts: Array | None = None) -> list[Stack]:
    """Return the equations of a dataset by configuration, those with equally many together, in the order of its blocks.

    ``slopes`` (m, dof) are by the joints' angles, ``shifts`` (m, 3) those of what cameras see by where the robot is,
    zero for other equations; None for none.
    """
    rows = _Rows(data)
    order = np.argsort(data.configuration, kind="stable")
    which = np.unique(data.configuration[order], return_inverse=True)[1]
    each = rows.equations[order]
    total = np.bincount(which, each).astype(int)
    before = np.cumsum(each) - each
    first = np.cumsum(total) - total
    offset = np.empty(len(order), dtype=int)
    offset[order] = before - first[which]
    number = np.empty(len(order), dtype=int)
    number[order] = which
    found = []
    for k in np.unique(total):
        of_size = np.flatnonzero(total == k)
        place = np.full(len(total), -1)
        place[of_size] = np.arange(len(of_size))
        stack = rows.stack(place[number], offset, len(of_size), int(k), slopes)
        if shifts is not None:
            G = shifts[stack.index]
            stack = replace(stack, unit=G @ G.transpose(0, 2, 1) + stack.length[:, :, None] * np.eye(int(k)))
        found.append(stack)
    return found


class _Rows:
    """Where the equations of every row stand, and what they are."""

    def __init__(self, data: Dataset):
        self.blocks = data.blocks
        self.equations = np.zeros(len(data), dtype=int)
        self.start = np.zeros(len(data), dtype=int)
        begin = 0
        for block in data.blocks:
            k = len(block.measurement.components)
            self.equations[block.row] = k
            self.start[block.row] = begin + k * np.arange(len(block.row))
            begin += k * len(block.row)

    def stack(self, place: np.ndarray, offset: np.ndarray, N: int, k: int, slopes: Array | None) -> Stack:
        """Return the stack of rows that have a place in it, each at its offset in a configuration's equations."""
        index = np.zeros((N, k), dtype=int)
        V = np.zeros((N, k, k))
        length = np.zeros((N, k), dtype=bool)
        angle = np.zeros((N, k), dtype=bool)
        for block in self.blocks:
            mine = np.flatnonzero(place[block.row] >= 0)
            row = block.row[mine]
            dimensions = list(block.measurement.components.values())
            column = offset[row, None] + np.arange(len(dimensions))
            at = place[row, None]
            index[at, column] = self.start[row, None] + np.arange(len(dimensions))
            length[at, column] = [d == "length" for d in dimensions]
            angle[at, column] = [d == "angle" for d in dimensions]
            V[at[:, :, None], column[:, :, None], column[:, None, :]] = _covariances(block, mine)
        joint = np.zeros((N, k, 0))
        if slopes is not None:
            joint = slopes[index]
        return Stack(index, V, length, angle, joint)


def _covariances(block: Block, rows: np.ndarray) -> Array:
    if len(block.covariance) == 1:
        return np.broadcast_to(block.covariance, (len(rows), *block.covariance.shape[1:]))
    return block.covariance[rows]


def joint_slopes(rows: Evaluation, at: Array | None = None) -> Array:
    """Return the slopes (m, dof) of the modelled values by the joints' angles [SI]; zero for sliding joints.

    They are taken at values ``at`` (P,) of all parameters [SI]; None for nominal.
    """
    joints = {}
    for name, robot in rows.arms.items():
        for i, kind in enumerate(robot.joint_types):
            if kind == "revolute":
                joints[f"theta{i + 1}"] = i
                joints[f"{name}.theta{i + 1}"] = i
    names = rows.parameters.names
    chosen = np.array([name in joints for name in names])
    found = np.zeros((len(rows.owners), max(robot.dof for robot in rows.arms.values())))
    if chosen.any():
        J = np.concatenate(rows.slopes_by(chosen, at))
        # the same joint of several robots: a row has slopes by those of its own robot alone
        np.add.at(found.T, [joints[name] for name in names if name in joints], J.T)
    return found


def shifts(rows: Evaluation, at: Array | None = None) -> Array | None:
    """Return the slopes (m, 3) of what cameras see by where the robot is; None where no row is a camera's.

    Zero for other rows, whose own lengths are shifted. A camera or a board that the robot holds elsewhere shifts
    all points of a view together. Values ``at`` as for `joint_slopes`.
    """
    seen = [block.measurement.metres is not None for block in rows.data.blocks]
    if not any(seen):
        return None
    names = [own_name(name) for name in rows.parameters.names]
    columns = [SHIFTED.index(name) for name in names if name in SHIFTED]
    parts = rows.slopes_by(np.array([name in SHIFTED for name in names]), at)
    found = [np.zeros((len(part), 3)) for part in parts]
    for sums, part, camera in zip(found, parts, seen, strict=True):
        if camera:
            np.add.at(sums.T, columns, part.T)
    return np.concatenate(found)
