"""Joint values beyond those that were measured: there nothing checked the model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.source import Source

SLACK = 0.1
"""Part of a measured range by which values may exceed it: the extremes of a range are themselves drawn by chance."""
LEAST = np.radians(1.0)
"""What they may exceed it by in any case [rad; for prismatic joints 17 mm]."""


@dataclass(frozen=True)
class Outside:
    """Which of some joint values lie outside the measured ranges by more than a tenth of them.

    Parameters
    ----------
    count
        How many rows there are.
    rows
        The numbers of those outside.
    joints
        How many rows are outside by a joint (from 1); a row may be outside by several.
    """

    count: int = 0
    rows: tuple[int, ...] = ()
    joints: Mapping[int, int] = field(default_factory=dict)

    def sentences(self) -> list[str]:
        """Say how many rows are outside, or nothing.

        >>> from rpim_opt.calibration.ranges import Outside
        >>> Outside(40, (2, 7), {1: 2, 4: 1}).sentences()[0].partition(":")[0]
        '2 of 40 rows lie well outside the measured joint ranges (joint 1'
        """
        if not self.rows:
            return []
        by = ", ".join(f"joint {joint}: {count}" for joint, count in self.joints.items())
        lie = "lie"
        if len(self.rows) == 1:
            lie = "lies"
        return [
            f"{len(self.rows)} of {self.count} rows {lie} well outside the measured joint ranges ({by}): no "
            "measurement checked the model there, and errors may exceed its intervals."
        ]


def measured_ranges(problem: Source) -> dict[str, Array]:
    """Return the least and largest measured value of every joint (2, dof) [rad or m], of all points of all rows.

    By robot, ``""`` for the only one.
    """
    blocks = (block for part in problem.rows() for block in part.data.blocks)
    return widest((block.robot, np.stack([block.q.min(axis=(0, 1)), block.q.max(axis=(0, 1))])) for block in blocks)


def widest(ranges: Iterable[tuple[str, Array]]) -> dict[str, Array]:
    """Return the ranges (2, dof) that hold all of some, by robot.

    >>> import numpy as np
    >>> from rpim_opt.calibration.ranges import widest
    >>> widest([("", np.array([[-1.0], [0.5]])), ("", np.array([[0.0], [2.0]]))])[""].tolist()
    [[-1.0], [2.0]]
    """
    found: dict[str, Array] = {}
    for robot, (low, high) in ranges:
        least, most = found.get(robot, (low, high))
        found[robot] = np.stack([np.minimum(least, low), np.maximum(most, high)])
    return found


def outside(ranges: Mapping[str, Array], data: Dataset) -> Outside:
    """Return which rows of a dataset have a point outside.

    Parameters
    ----------
    ranges
        (2, dof) by robot, as of `measured_ranges`.
    data
        Of the same robots.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> from rpim_opt.calibration.ranges import outside
    >>> data = ro.Dataset.of(np.array([[0.0, 1.0], [1.1, 1.0], [1.3, 2.5]]), np.zeros((3, 3)), sigma=1e-4)
    >>> outside({"": np.array([[-1.0, 0.0], [1.0, 2.0]])}, data)
    Outside(count=3, rows=(2,), joints={1: 1, 2: 1})
    """
    beyond = np.zeros((len(data), max(block.q.shape[2] for block in data.blocks)), dtype=bool)
    for block in data.blocks:
        low, high = ranges[block.robot]
        slack = np.maximum(SLACK * (high - low), LEAST)
        far = (block.q < low - slack) | (block.q > high + slack)
        beyond[block.row, : len(low)] = far.any(axis=1)
    by = {int(j) + 1: int(beyond[:, j].sum()) for j in np.flatnonzero(beyond.any(axis=0))}
    return Outside(len(data), tuple(np.flatnonzero(beyond.any(axis=1)).tolist()), by)
