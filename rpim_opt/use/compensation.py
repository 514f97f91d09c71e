"""Joint commands that bring the calibrated robot where its controller believes it to be."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.basics.writing import write_text
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.models import pose, position
from rpim_opt.use.cell import Cell
from rpim_opt.use.compensated import Compensation
from rpim_opt.use.targets import Targets, checked, read_targets

SMALLEST = 1e-12
"""Correction [rad or m] below which nothing is corrected."""
BLOCK = 8192
"""Rows that are worked on together, so that what they need stays in the processor's cache."""


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
    turned = orientation and (targets.poses is None or targets.poses.shape[1] == 7)
    kind = pose if turned else position
    gravity = arm.gravity
    if payload_centre is not None:
        gravity = gravity.carrying(gravity.payload, list(payload_centre))
    cell = Cell.of(result, kind, tool, marker, base, torque is not None, gravity, robot)
    carried = _carried(cell, payload, payload_centre, len(targets.label))

    def part(start: int) -> dict[str, Array]:
        def rows(values: Array | None) -> Array | None:
            return None if values is None else values[start : start + BLOCK]

        bears = (rows(targets.torque), rows(carried))
        return cell.compensated(rows(targets.q), rows(targets.poses), *bears, largest)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        parts = list(pool.map(part, range(0, len(targets.label), BLOCK)))
    whole: dict[str, Any] = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    whole["status"] = tuple(whole["status"].tolist())
    commands = Dataset.of_robots({robot: Dataset.of(whole["q"], np.zeros((len(targets.label), 3)), 1.0)})
    return Compensation(arm, targets.label, **whole, outside=result.outside(commands))


def _carried(cell: Cell, payload: float | Array | None, centre: object, N: int) -> Array | None:
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
    stated = {"torque": read.torque, "payload": read.payload, "label": read.label}
    found = compensate(result, read.q, read.poses, **(stated | options))
    write_text(Path(out), found.csv())
    return found
