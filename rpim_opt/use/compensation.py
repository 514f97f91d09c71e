"""Joint commands that bring the calibrated robot where its controller assumes it, and the errors that remain."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array, statistics
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.files import write_text
from rpim_opt.basics.tables import csv_text
from rpim_opt.basics.text import listed, table
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.basics.units import display, joint_columns
from rpim_opt.calibration.ranges import Outside
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.pose import pose
from rpim_opt.data.measurements.position import position
from rpim_opt.robot.mdh import Robot
from rpim_opt.use.cell import Cell
from rpim_opt.use.targets import Targets, checked, read_targets

SMALLEST = 1e-12
"""Correction [rad or m] below which nothing is corrected."""
BLOCK = 8192
"""Rows that are worked on together, so that what they need stays in the processor's cache."""


@dataclass(frozen=True, eq=False)
class Compensation:
    """Corrected joint commands, and what the calibrated model says of them.

    Parameters
    ----------
    robot
        The nominal robot.
    label
        N row labels.
    nominal, q
        (N, dof) commands of the nominal controller, and the corrected ones [rad or m].
    position_before, orientation_before
        (N,) how far the nominal command misses the target [m], [rad]; NaN for an orientation that does not count.
    position_error, orientation_error
        (N,) the same for the corrected command.
    std
        (N,) root mean square distance by which the model may be wrong there [m], from the calibration's covariance
        C: sqrt(tr J C J'), with the Jacobian J of the position in the instrument's frame, base included. Infinite
        where the calibration has no covariance.
    status
        For every row ``"ok"`` (of what counts, at most 0.1 um and 0.1 urad are left), ``"limited"`` (a joint limit
        prevents that), ``"unreachable"`` (for the nominal robot, too; the command is the nearest found) or
        ``"near singular"`` (the correction would be too large, and was damped).
    outside
        Corrected commands beyond the joint ranges that the calibration measured.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, weight=ro.l_curve)
    >>> found = ro.use.compensate(result, np.radians([[10, -80, 60, 20, 30, 0]]), label=["P1"])
    >>> np.degrees(found.q - found.nominal).round(2), found.status
    (array([[ 0.08,  0.86, -2.02,  1.21, -0.09, -0.04]]), ('ok',))
    >>> sorted(found.content())
    ['corrected', 'largest_corrections', 'nominal', 'outside', 'rows']
    >>> print(found.csv().splitlines()[0])
    label,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,position_error_mm,orientation_error_mrad,std_mm,status
    """

    robot: Robot
    label: tuple[str, ...]
    nominal: Array
    q: Array
    position_before: Array
    orientation_before: Array
    position_error: Array
    orientation_error: Array
    std: Array
    status: tuple[str, ...]
    outside: Outside = field(default_factory=Outside)

    def __str__(self) -> str:
        """Return the errors as a table, the largest corrections, and the rows that keep an error by name."""
        rows = [
            ("position [mm], nominal command", self.position_before),
            ("position [mm], corrected command", self.position_error),
            ("position [mm], standard uncertainty", self.std),
            ("orientation [mrad], nominal command", self.orientation_before),
            ("orientation [mrad], corrected command", self.orientation_error),
        ]
        figures = [
            [name, *(f"{1e3 * f:.4f}" for f in (v.mean(), np.sqrt(np.mean(v**2)), v.max()))]
            for name, v in rows
            if np.isfinite(v).all()
        ]
        units = [display(dimension)[0] for dimension in self.robot.joint_dimensions]
        changes = zip(self._largest_corrections().values(), units, strict=True)
        largest = [f"q{i} {value:.3f} {unit}" for i, (value, unit) in enumerate(changes, start=1)]
        lines = [
            table([f"{len(self.q)} targets, error", "mean", "RMS", "max"], figures),
            f"Largest corrections: {', '.join(largest)}.",
        ]
        for status in ("limited", "near singular", "unreachable"):
            at = [i for i, each in enumerate(self.status) if each == status]
            if at:
                named = listed([f"{self.label[i]} ({1e3 * self.position_error[i]:.3f} mm left)" for i in at])
                lines.append(f"{status.capitalize()}: {named}.")
        return "\n".join([*lines, *self.outside.sentences()])

    def _largest_corrections(self) -> dict[str, float]:
        """Return the largest correction of every joint, in the unit of its column."""
        joints = joint_columns(self.robot.joint_dimensions)
        change = np.abs(self.q - self.nominal).max(axis=0) / list(joints.values())
        return dict(zip(joints, change.tolist(), strict=True))

    def _columns(self) -> dict[str, Array]:
        """Return the corrected commands, and what is left of the errors, by column."""
        joints = joint_columns(self.robot.joint_dimensions)
        columns = {name: self.q[:, i] / si for i, (name, si) in enumerate(joints.items())}
        columns["position_error_mm"] = 1e3 * self.position_error
        columns["orientation_error_mrad"] = 1e3 * self.orientation_error
        columns["std_mm"] = 1e3 * self.std
        return columns

    def content(self) -> dict[str, Any]:
        """Return the errors [mm, mrad], and a row for every target as in `csv`."""
        columns = self._columns()
        rows = zip(self.label, *(values.tolist() for values in columns.values()), self.status, strict=True)
        return {
            "nominal": _errors(self.position_before, self.orientation_before),
            "corrected": _errors(self.position_error, self.orientation_error),
            "largest_corrections": self._largest_corrections(),
            "outside": [self.label[i] for i in self.outside.rows],
            "rows": [dict(zip(("label", *columns, "status"), row, strict=True)) for row in rows],
        }

    def csv(self) -> str:
        """Return labels, corrected commands, what is left of the errors, and status as CSV text."""
        cells = []
        for name, values in self._columns().items():
            digits = 6 if name.endswith(("_mm", "_mrad")) and not name.startswith("q") else 9
            cells.append([f"{v:.{digits}f}" if np.isfinite(v) else "" for v in values])
        return csv_text(["label", *self._columns(), "status"], zip(self.label, *cells, self.status, strict=True))


def _errors(position: Array, orientation: Array) -> dict[str, Any]:
    return {"position": statistics(position), "orientation": statistics(orientation, "mrad")}


@one_blas_thread
def compensate(
    result: Calibration,
    q: Array | None = None,
    poses: Array | None = None,
    *,
    orientation: bool = True,
    tool: Sequence[float] | Array | None = None,
    marker: str = "",
    base: bool = False,
    torque: Array | None = None,
    payload: float | Array | None = None,
    payload_centre: Sequence[float] | Array | None = None,
    largest: float = 0.2,
    label: Sequence[str] = (),
    robot: str = "",
) -> Compensation:
    """Correct joint commands so that the calibrated robot goes where the nominal one would.

    A target is the pose of the tool in the robot's base: that of the nominal robot at a command q, or one given.
    The corrected command q + D minimizes, within the joint limits and with no joint moved by more than ``largest``,

        |p|^2 + |w|^2 + D' P D

    where p [m] and w [rad] are the identified robot's errors of position and orientation. With fewer than six joints
    only those rotations count that need not move the point. P is zero but for two kinds of directions, from
    the singular values s of the Jacobian at q. Where the exact correction e / s of an error e would be longer than
    ``largest`` (near singular), P is (e / largest)^2 - s^2, so that the part (s largest / e)^2 of it is made: the less,
    the nearer the singularity. Where nothing moves (more joints than needed), a slight P keeps the command, so that
    the correction is the shortest to first order, in units of the joints' ranges.

    **Which frame.** The base is where the instrument stands and no fault of the robot: what a calibration identified
    of it is not compensated, and targets hold in the base as identified. A turn of joint 1 and one of the base are the
    same to the data; what the scales ascribe to the base stays. With ``base=True`` targets hold in the base as
    stated, and the robot corrects for its place, too (``base = "auto"`` states none: then it is where registration
    puts it).

    Parameters
    ----------
    result
        The calibration.
    q
        (N, dof) commands of the nominal controller [rad or m]; with ``poses`` where to look for those.
    poses
        (N, 7) targets: x, y, z [m] and unit quaternion, w first, in the base; or positions (N, 3). Without ``q``
        every one is looked for from several configurations within the limits that come near.
    orientation
        Whether orientations count.
    tool
        (6,) a tool in the flange frame, x, y, z [m], roll, pitch, yaw [rad], that the controller knows as it is. By
        default the reflector of the calibration, which the controller knows as stated and the robot has as identified.
    marker
        Which reflector, when there are several.
    base
        Whether to compensate the base.
    torque
        (N, dof) joint torques [Nm]: required, and zero if need be, where compliances were identified from measured
        ones.
    payload
        Mass at the flange [kg], one or (N,), where compliances were identified without measured torques; by default
        the one that the problem states. Joints are in the middle of their backlash.
    payload_centre
        (3,) where that mass is in the flange frame [m]; by default where the problem states it.
    largest
        Largest correction of a joint [rad or m].
    label
        N row labels; numbers from 1 by default.
    robot
        Which of several robots.

    Returns
    -------
    Every row depends on its own target alone.

    Raises
    ------
    InputError
        For shapes that do not fit, numbers that are not finite, a reflector that is not known.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> result = ro.calibrate(instance.problem, ro.tikhonov, weight=ro.l_curve)
    >>> found = ro.use.compensate(result, instance.validation.q)
    >>> print(f"{1e3 * found.position_before.mean():.2f} mm, {1e3 * found.position_error.max():.4f} mm left")
    2.64 mm, 0.0000 mm left
    """
    arms = result.problem.arms
    if robot not in arms:
        raise InputError("robot", f"'{robot}'", choices(robot, arms))
    arm = arms[robot]
    targets = checked(arm, Targets(tuple(label), q, poses, torque), orientation)
    if not largest >= SMALLEST:
        raise InputError("largest", f"{largest}", f"a correction of at least {SMALLEST:g}")
    oriented = orientation and (targets.poses is None or targets.poses.shape[1] == 7)
    kind = pose if oriented else position
    gravity = arm.gravity
    if payload_centre is not None:
        gravity = gravity.carrying(gravity.payload, list(payload_centre))
    cell = Cell.of(result, kind, tool, marker, base, torque is not None, gravity, robot)
    masses = _masses(cell, payload, payload_centre, len(targets.label))

    def part(start: int) -> dict[str, Array]:
        def rows(values: Array | None) -> Array | None:
            return None if values is None else values[start : start + BLOCK]

        loads = (rows(targets.torque), rows(masses))
        return cell.compensated(rows(targets.q), rows(targets.poses), *loads, largest)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        parts = list(pool.map(part, range(0, len(targets.label), BLOCK)))
    whole: dict[str, Any] = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    whole["status"] = tuple(whole["status"].tolist())
    commands = Dataset.of_robots({robot: Dataset.of(whole["q"], np.zeros((len(targets.label), 3)), 1.0)})
    return Compensation(arm, targets.label, **whole, outside=result.outside(commands))


def _masses(cell: Cell, payload: float | Array | None, centre: object, N: int) -> Array | None:
    """Return the payload of every row (N,) [kg], if there is one; refuse one that has no effect."""
    if payload is None and centre is None:
        return None
    if not cell.loads.payload:
        accepted = "a calibration that identified compliances from the torques of gravity, or a term that sees it"
        raise InputError("payload", "a payload that bends nothing", accepted)
    if payload is None:
        payload = cell.robot.gravity.payload
    values = np.asarray(payload, dtype=float)
    if values.shape not in ((), (N,)) or not (values >= 0).all() or not np.isfinite(values).all():
        raise InputError("payload", f"{payload}", f"a mass [kg] that is not negative, one or {N}")
    return np.broadcast_to(values, N)


def compensate_file(result: Calibration, targets: str | Path, out: str | Path, **options: Any) -> Compensation:
    """Compensate the targets of a table (`read_targets`) and write `Compensation.csv`, whole or not at all.

    Parameters
    ----------
    result
        The calibration.
    targets, out
        The table to read, and the CSV file to write.
    options
        Those of `compensate`.

    Raises
    ------
    InputError
        As `read_targets` and `compensate` do.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, weight=ro.l_curve)
    >>> found = ro.use.compensate_file(result, "targets.csv", "commands.csv")
    >>> len(found.q), set(found.status)
    (18, {'ok'})
    """
    read = read_targets(targets, result.problem.robot)
    columns = {"torque": read.torque, "payload": read.payload, "label": read.label}
    compensation = compensate(result, read.q, read.poses, **(columns | options))
    write_text(Path(out), compensation.csv())
    return compensation
