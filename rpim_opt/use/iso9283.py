"""Pose accuracy and pose repeatability as ISO 9283:1998 defines them (7.2.1 and 7.2.2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.shown import Tabled, counted
from rpim_opt.basics.tables import csv_text
from rpim_opt.basics.text import table

CYCLES, POSES = 30, 5
"""How often the standard has how many poses approached."""
ANGLES = ("a", "b", "c")
"""The standard's names of the rotations."""


@dataclass(frozen=True)
class PosePerformance:
    """Accuracy and repeatability at one pose.

    Parameters
    ----------
    pose
        Its name.
    cycles
        How often it was approached.
    AP, AP_axes
        Distance of the barycentre of the attained positions from the command [m], and along x, y, z; None where no
        command is known.
    RP
        Positioning repeatability [m].
    AP_angles, RP_angles
        Of the orientation, for each of three angles [rad]: mean less command, and 3 standard deviations; None where no
        orientation was measured.
    """

    pose: str
    cycles: int
    AP: float | None
    AP_axes: tuple[float, float, float] | None
    RP: float
    AP_angles: tuple[float, float, float] | None = None
    RP_angles: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Performance(Tabled):
    """Accuracy and repeatability at the poses of a table.

    Parameters
    ----------
    poses
        One of each pose.
    names
        What the table calls the three angles.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> reached = 1e-3 * np.array([[0.1, 0, 0], [-0.1, 0, 0], [0, 0.1, 0], [0, -0.1, 0]])
    >>> found = ro.use.iso9283(["P1"] * 4, reached, command=np.full((4, 3), 1e-3))
    >>> print(f"{1e3 * found.accuracy:.3f} mm, {1e3 * found.repeatability:.3f} mm")
    1.732 mm, 0.100 mm
    >>> round(found.content()["poses"][0]["RP_l_mm"], 3), found.csv().splitlines()[0]
    (0.1, 'pose,cycles,AP_p_mm,AP_x_mm,AP_y_mm,AP_z_mm,RP_l_mm')
    >>> print(found.notes()[0])
    The standard has 5 poses approached 30 times each: there is 1 pose, approached 4 times.
    """

    poses: tuple[PosePerformance, ...]
    names: tuple[str, ...] = ANGLES

    @property
    def accuracy(self) -> float | None:
        """The largest positioning accuracy AP of all poses [m]; None where no command is known."""
        found = [each.AP for each in self.poses if each.AP is not None]
        return max(found, default=None)

    @property
    def repeatability(self) -> float:
        """The largest positioning repeatability RP of all poses [m]."""
        return max(each.RP for each in self.poses)

    def notes(self) -> list[str]:
        """Say in what the table is not what the standard asks for, and what is not known."""
        lines: list[str] = []
        cycles = sorted({each.cycles for each in self.poses})
        if cycles[0] < CYCLES or len(self.poses) < POSES:
            times = f"{cycles[0]}"
            if len(cycles) > 1:
                times = f"{cycles[0]} to {cycles[-1]}"
            verb = "are" if len(self.poses) > 1 else "is"
            there = f"there {verb} {counted(len(self.poses), 'pose')}, approached {times} times"
            lines.append(f"The standard has {POSES} poses approached {CYCLES} times each: {there}.")
        if self.accuracy is None:
            lines.append("No command is known: there is repeatability, and no accuracy.")
        return lines

    def content(self) -> dict[str, Any]:
        """Return the figures [mm, mrad]."""
        accuracy = None
        if self.accuracy is not None:
            accuracy = 1e3 * self.accuracy
        return {
            "standard": "ISO 9283:1998, 7.2.1 and 7.2.2",
            "accuracy_mm": accuracy,
            "repeatability_mm": 1e3 * self.repeatability,
            "poses": self._frame_rows(),
            "notes": self.notes(),
        }

    def csv(self) -> str:
        """Return the rows as CSV."""
        rows = self._frame_rows()
        return csv_text(rows[0], [["" if value is None else value for value in row.values()] for row in rows])

    def __str__(self) -> str:
        """Return the figures as a table."""
        rows = self._frame_rows()
        lines = [_text(rows, "_mm"), "ISO 9283:1998, 7.2.1 (AP) and 7.2.2 (RP)."]
        if any(each.RP_angles is not None for each in self.poses):
            lines.insert(1, _text(rows, "_mrad"))
        return "\n".join([*lines, *self.notes()])

    def _short(self) -> str:
        return f"at {counted(len(self.poses), 'pose')}, RP {1e3 * self.repeatability:.4g} mm"

    def _notes(self) -> list[str]:
        return self.notes()

    def _frame_rows(self) -> list[dict[str, Any]]:
        return [self._row(each) for each in self.poses]

    def _row(self, each: PosePerformance) -> dict[str, Any]:
        row: dict[str, Any] = {"pose": each.pose, "cycles": each.cycles, "AP_p_mm": _milli(each.AP)}
        row |= {f"AP_{axis}_mm": value for axis, value in zip("xyz", _three(each.AP_axes), strict=True)}
        row["RP_l_mm"] = _milli(each.RP)
        if any(one.RP_angles is not None for one in self.poses):
            row |= {f"AP_{name}_mrad": v for name, v in zip(self.names, _three(each.AP_angles), strict=True)}
            row |= {f"RP_{name}_mrad": v for name, v in zip(self.names, _three(each.RP_angles), strict=True)}
        return row


def _milli(value: float | None) -> float | None:
    if value is None:
        return None
    return 1e3 * value


def _three(values: Sequence[float] | None) -> list[float | None]:
    if values is None:
        return [None, None, None]
    return [1e3 * value for value in values]


def _text(rows: list[dict[str, Any]], unit: str) -> str:
    """Return the figures of a unit as a table, without what no pose has."""
    kept = [key for key in rows[0] if key.endswith(unit) and any(row[key] is not None for row in rows)]
    head = [key.replace(unit, f" [{unit[1:]}]") for key in kept]
    return table(["pose", "cycles", *head], [[_cell(row[key]) for key in ("pose", "cycles", *kept)] for row in rows])


def _cell(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4f}"
    return str(value)


def iso9283(
    pose: Sequence[str],
    position: Array,
    command: Array | None = None,
    angles: Array | None = None,
    command_angles: Array | None = None,
    names: tuple[str, ...] = ANGLES,
) -> Performance:
    """Return pose accuracy and repeatability of repeated approaches.

    With n approaches of a pose, attained positions p_j, their barycentre m and the command c::

        AP_p = |m - c|                        AP_a = mean(a_j) - a_c
        l_j  = |p_j - m|                      S_a  = sqrt(sum (a_j - mean(a))^2 / (n - 1))
        S_l  = sqrt(sum (l_j - mean(l))^2 / (n - 1))
        RP_l = mean(l) + 3 S_l                RP_a = 3 S_a,  and the same for b and c

    (ISO 9283:1998, 7.2.1 and 7.2.2.) Attained positions are those that the instrument reads: its own scatter is in
    them. Angles count within half a turn of the command, or of the first approach.

    Parameters
    ----------
    pose
        N names of the pose that a row approaches.
    position, command
        (N, 3) attained and commanded positions [m] in one frame; without commands there is no accuracy.
    angles, command_angles
        (N, 3) the same for the orientation [rad].
    names
        What the three angles are called.

    Raises
    ------
    InputError
        For shapes that do not fit, a pose that is approached once, or whose command changes.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> turned = np.array([[0.0, 0.0, 3.141], [0.0, 0.0, -3.141]])  # a turn of 1.2 mrad
    >>> found = ro.use.iso9283(["P1", "P1"], np.zeros((2, 3)), angles=turned)
    >>> round(1e3 * found.poses[0].RP_angles[2], 2)  # 3 standard deviations [mrad]
    2.51
    """
    N = len(pose)
    reached = _numbers(position, N, "positions")
    commanded = _optional(command, N, "commanded positions")
    turned = _optional(angles, N, "angles")
    commanded_angles = _optional(command_angles, N, "commanded angles")
    if not N:
        raise InputError("iso9283", "no approach", "at least two of a pose")
    found: list[PosePerformance] = []
    for name in dict.fromkeys(pose):
        at = np.array([each == name for each in pose])
        if at.sum() < 2:
            raise InputError(f"pose '{name}'", "one approach", f"two or more, {CYCLES} by the standard")
        goal = _one(commanded, at, name, "position")
        goal_angles = _one(commanded_angles, at, name, "orientation")
        found.append(_of_pose(name, reached[at], goal, None if turned is None else turned[at], goal_angles))
    return Performance(tuple(found), names)


def _of_pose(
    name: str, reached: Array, goal: Array | None, turned: Array | None, goal_angles: Array | None
) -> PosePerformance:
    centre = reached.mean(axis=0)
    length = np.linalg.norm(reached - centre, axis=1)
    RP = float(length.mean() + 3 * length.std(ddof=1))
    off = None
    if goal is not None:
        off = centre - goal
    RP_angles = None
    AP_angles = None
    if turned is not None:
        start = turned[0] if goal_angles is None else goal_angles
        beside = (turned - start + np.pi) % (2 * np.pi) - np.pi
        RP_angles = _triple(3 * beside.std(axis=0, ddof=1))
        if goal_angles is not None:
            AP_angles = _triple(beside.mean(axis=0))
    if off is None:
        return PosePerformance(name, len(reached), None, None, RP, AP_angles, RP_angles)
    return PosePerformance(name, len(reached), float(np.linalg.norm(off)), _triple(off), RP, AP_angles, RP_angles)


def _triple(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def _one(values: Array | None, at: np.ndarray, name: str, what: str) -> Array | None:
    """Return the command of a pose, which all its rows repeat."""
    if values is None:
        return None
    of = values[at]
    if np.ptp(of, axis=0).max() > 1e-9:
        raise InputError(f"pose '{name}'", f"commands of more than one {what}", "one command a pose")
    return of[0]


def _optional(values: Array | None, N: int, what: str) -> Array | None:
    if values is None:
        return None
    return _numbers(values, N, what)


def _numbers(values: Array, N: int, what: str) -> Array:
    found = np.asarray(values, dtype=float)
    if found.shape != (N, 3) or not np.isfinite(found).all():
        raise InputError(what, f"shape {found.shape}", f"finite numbers of shape {(N, 3)}")
    return found
