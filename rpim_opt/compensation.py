"""Joint commands that bring the calibrated robot where its controller believes it to be."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.spatial.distance import cdist

from rpim_opt.calibration import Calibration
from rpim_opt.dataset import Dataset, read_data
from rpim_opt.design import random_candidates
from rpim_opt.exceptions import InputError, choices
from rpim_opt.files import write_text
from rpim_opt.kinematics import FRAME, call_rows, frame, motion, numeric_frame, transforms
from rpim_opt.measurement import Measurement, pose, position
from rpim_opt.parameters import reflectors, tool_prefix
from rpim_opt.problem import CalibrationProblem
from rpim_opt.record import statistics
from rpim_opt.robot import Array, Robot
from rpim_opt.tables import csv_text, read_columns
from rpim_opt.text import listed, table
from rpim_opt.threads import one_blas_thread
from rpim_opt.uncertainty import known_covariance
from rpim_opt.units import display, joint_columns, split_unit

REACHED = 1e-7
"""A target counts as reached when no more than this is left [m, rad]."""
KEPT = 1e-10
"""Weight of a correction that moves nothing, relative to the largest squared singular value."""
SETTLED, SLIGHT, PASSES = 1e-10, 1e-6, 50
"""A row is done when its step is shorter [rad or m], or lowers the sum by a smaller part; and its most steps."""
BLOCK = 8192
"""Rows that are worked on together, so that what they need stays in the processor's cache."""
BANK, TRIALS = 2000, 12
"""Configurations among which a pose without a start looks for the nearest ones, and how many of them it tries."""


class Targets(NamedTuple):
    """Rows of a table: labels, joint values (N, dof), poses (N, 7) or positions (N, 3), torques (N, dof), or None."""

    label: tuple[str, ...]
    q: Array | None
    poses: Array | None
    torque: Array | None


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

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, weight=ro.l_curve)
    >>> found = ro.compensate(result, np.radians([[10, -80, 60, 20, 30, 0]]), label=["P1"])
    >>> np.degrees(found.q - found.nominal).round(2), found.status
    (array([[ 0.08,  0.86, -2.02,  1.21, -0.09, -0.04]]), ('ok',))
    >>> sorted(found.content())
    ['corrected', 'largest_corrections', 'nominal', 'rows']
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

    def __str__(self) -> str:
        """Return the errors as a table, the largest corrections, and the rows that keep an error by name."""
        rows = [
            ("position [mm], nominal command", self.position_before),
            ("position [mm], corrected command", self.position_error),
            ("position [mm], uncertainty of the model", self.std),
            ("orientation [mrad], nominal command", self.orientation_before),
            ("orientation [mrad], corrected command", self.orientation_error),
        ]
        figures = [
            [name, *(f"{1e3 * f(v):.4f}" for f in (np.mean, lambda v: np.sqrt(np.mean(v**2)), np.max))]
            for name, v in rows
            if np.isfinite(v).all()
        ]
        change = np.abs(self.q - self.nominal).max(axis=0)
        units = [display(dimension) for dimension in self.robot.joint_dimensions]
        largest = [f"q{i} {c / si:.3f} {unit}" for i, (c, (unit, si)) in enumerate(zip(change, units, strict=True), 1)]
        lines = [
            table([f"{len(self.q)} targets, error", "mean", "RMS", "max"], figures),
            f"Largest corrections: {', '.join(largest)}.",
        ]
        for status in ("limited", "near singular", "unreachable"):
            found = [i for i, s in enumerate(self.status) if s == status]
            named = listed([f"{self.label[i]} ({1e3 * self.position_error[i]:.3f} mm left)" for i in found])
            lines += [f"{status.capitalize()}: {named}."] if found else []
        return "\n".join(lines)

    def content(self) -> dict[str, Any]:
        """Return the errors [mm, mrad], and a row for every target as in `csv`."""
        before = statistics(self.position_before), statistics(self.orientation_before, "mrad")
        after = statistics(self.position_error), statistics(self.orientation_error, "mrad")
        units = [display(dimension) for dimension in self.robot.joint_dimensions]
        columns = {f"q{i}_{unit}": self.q[:, i - 1] / si for i, (unit, si) in enumerate(units, start=1)}
        largest = {f"q{i}_{unit}": np.abs(self.q - self.nominal)[:, i - 1].max() / si
                   for i, (unit, si) in enumerate(units, start=1)}  # fmt: skip
        columns |= {
            "position_error_mm": 1e3 * self.position_error,
            "orientation_error_mrad": 1e3 * self.orientation_error, "std_mm": 1e3 * self.std,
        }  # fmt: skip
        rows = zip(self.label, *(v.tolist() for v in columns.values()), self.status, strict=True)
        return {
            "nominal": {"position": before[0], "orientation": before[1]},
            "corrected": {"position": after[0], "orientation": after[1]},
            "largest_corrections": largest,
            "rows": [dict(zip(("label", *columns, "status"), row, strict=True)) for row in rows],
        }

    def csv(self) -> str:
        """Return labels, corrected commands, what is left of the errors, and status as CSV text."""
        joints = joint_columns(self.robot.joint_dimensions)
        q, rows = self.q / list(joints.values()), []
        left = 1e3 * np.column_stack([self.position_error, self.orientation_error, self.std])
        for label, command, errors, status in zip(self.label, q, left, self.status, strict=True):
            cells = [f"{v:.6f}" if np.isfinite(v) else "" for v in errors]
            rows.append([label, *(f"{v:.9f}" for v in command), *cells, status])
        header = ["label", *joints, "position_error_mm", "orientation_error_mrad", "std_mm", "status"]
        return csv_text(header, rows)


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
    largest: float = 0.2,
    label: Sequence[str] = (),
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
        (N, dof) joint torques [Nm]: required, and zero if need be, where compliances were identified.
    largest
        Largest correction of a joint [rad or m].
    label
        N row labels; numbers from 1 by default.

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
    >>> found = ro.compensate(result, instance.validation.q)
    >>> print(f"{1e3 * found.position_before.mean():.2f} mm, {1e3 * found.position_error.max():.4f} mm left")
    2.64 mm, 0.0000 mm left
    """
    robot = result.problem.robot
    targets = _checked(robot, Targets(tuple(label), q, poses, torque), orientation)
    if not largest > 0:
        raise InputError("largest", f"{largest}", "a correction greater than zero")
    turned = orientation and (targets.poses is None or targets.poses.shape[1] == 7)
    cell = _Cell.of(result, pose if turned else position, tool, marker, base, torque is not None)

    def part(start: int) -> dict[str, Array]:
        rows = [None if v is None else v[start : start + BLOCK] for v in (targets.q, targets.poses, targets.torque)]
        return cell.compensated(rows[0], rows[1], rows[2], largest)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        parts = list(pool.map(part, range(0, len(targets.label), BLOCK)))
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Compensation(robot, targets.label, **{**whole, "status": tuple(whole["status"].tolist())})


def read_targets(source: Any, robot: Robot) -> Targets:
    """Return the targets of a table.

    Columns ``q1_deg``, ... are joint values; ``x_mm, y_mm, z_mm`` positions in the robot's base, with
    ``qw, qx, qy, qz``, ``rx_deg, ry_deg, rz_deg`` or ``r11`` to ``r33`` poses. A table has the former, the latter, or
    both: joint values are then where to look for those of the pose. Optional: ``label``, torques ``tau1_Nm``, ...

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
        columns = dict(read_columns(source))
        stems = {split_unit(name)[0] for name in columns}
        joints = any(f"q{i}" in stems for i in range(1, robot.dof + 1))
        turned = stems & {"qw", "rx", "r11"}
        placed = bool(turned or stems & {"x", "y", "z"})
        if not joints and not placed:
            raise InputError("the header", "no targets", "columns q1_deg, ..., or x_mm, y_mm, z_mm, or both")
        zeros = [0.0] * len(next(iter(columns.values())))
        if not joints:
            columns |= dict.fromkeys(joint_columns(robot.joint_dimensions), zeros)
        if not placed:
            columns |= dict.fromkeys(("x_mm", "y_mm", "z_mm"), zeros)
        # read as measurements are; what they weigh does not matter
        kind, noise = (pose, {"position_mm": 1, "orientation_mrad": 1}) if turned else (position, {"position_mm": 1})
        data = read_data(columns, robot, noise, kind)
        block, *others = data.blocks
        if others:
            raise InputError("column marker", "several reflectors", "targets of one")
    except InputError as error:
        raise error.within(source if isinstance(source, str | Path) else None) from None
    torque = None if block.torque is None else block.torque[:, 0]
    return Targets(data.label, data.q if joints else None, block.y if placed else None, torque)


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
    >>> found = ro.compensate_file(result, "targets.csv", "commands.csv")
    >>> len(found.q), set(found.status)
    (18, {'ok'})
    """
    read = read_targets(targets, result.problem.robot)
    found = compensate(result, read.q, read.poses, torque=read.torque, label=read.label, **options)
    write_text(Path(out), found.csv())
    return found


def _checked(robot: Robot, given: Targets, orientation: bool) -> Targets:
    """Return the targets as arrays, labelled, or say what does not fit."""
    arrays = {k: np.asarray(v, dtype=float) for k, v in given._asdict().items() if k != "label" and v is not None}
    if "q" not in arrays and "poses" not in arrays:
        raise InputError("targets", "neither joint values nor poses", "q, poses, or both")
    N = len(np.atleast_1d(arrays["poses" if "poses" in arrays else "q"]))
    columns = {"q": (robot.dof,), "poses": (7, 3), "torque": (robot.dof,)}
    for name, values in arrays.items():
        if values.ndim != 2 or values.shape[1] not in columns[name] or len(values) != N or not N:
            accepted = " or ".join(f"({N or 'N'}, {k})" for k in columns[name])
            raise InputError(name, f"shape {values.shape}", accepted)
        finite = np.isfinite(values).all(axis=1)
        if not finite.all():
            row = int(np.argmin(finite))
            raise InputError(f"{name}, row {row + 1}", f"{values[row].tolist()}", "finite numbers")
    if "poses" in arrays and arrays["poses"].shape[1] == 7:
        try:
            arrays["poses"] = pose.prepare(arrays["poses"])[:, : 7 if orientation else 3]
        except InputError as error:
            raise InputError(f"poses, row {int(error.where) + 1}", error.found, error.accepted) from None
    if len(given.label) not in (0, N):
        raise InputError("label", f"{len(given.label)} labels", f"{N}, one a row")
    label = given.label or tuple(str(i + 1) for i in range(N))
    return Targets(label, arrays.get("q"), arrays.get("poses"), arrays.get("torque"))


@dataclass(frozen=True, eq=False)
class _Arm:
    """A robot with all its parameters known: poses, errors and Jacobians of rows.

    ``function`` maps model joint values, torques and target, side by side, to the pose, its error and J'.
    """

    function: ca.Function
    joint_map: Array

    @classmethod
    def of(
        cls, robot: Robot, values: Mapping[str, float], prefix: str, before: Array, kind: Measurement, torques: bool
    ) -> _Arm:
        """Build the function, once for all rows: parameters are numbers in it, so that zeros cost nothing."""
        n = robot.dof
        q, tau = ca.SX.sym("q", n), ca.SX.sym("tau", n if torques else 0)
        y = ca.SX.sym("y", len(kind.columns))

        def value(name: str) -> float:
            return values.get(name, 0.0)

        joints, torque = ca.vertsplit(q), ca.vertsplit(tau) if torques else (0.0,) * n
        after = [ca.DM(before) @ T for T in transforms(robot.joint_types, joints, torque, value)]
        T = after[-1] @ frame([value(prefix + c) for c in FRAME])
        columns = []
        for i, (moves, joint) in enumerate(zip(robot.joint_types, after, strict=True), start=1):
            beta = value(f"beta{i}")  # the joint's axis is z before Rot(y, beta), and goes through the origin
            axis = joint[:3, :3] @ ca.vertcat(-np.sin(beta), 0, np.cos(beta))
            arm = T[:3, 3] - joint[:3, 3]
            twist = ca.vertcat(ca.cross(axis, arm), axis) if moves == "revolute" else ca.vertcat(axis, 0, 0, 0)
            moved = motion(moves, i, joints[i - 1], torque[i - 1], value)
            columns.append(twist * ca.jacobian(moved, joints[i - 1]))
        J = ca.horzcat(*columns)[: len(kind.components), :]
        modelled = kind.model(T)
        outputs = [ca.densify(v) for v in (modelled, kind.minus(y, modelled), J.T)]
        return cls(ca.Function("arm", [ca.vertcat(q, tau, y)], outputs), robot.joint_map)

    def at(self, q: Array, tau: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return the pose (N, c), its error (N, k) from y, and the Jacobian (N, k, dof) of the pose."""
        modelled, error, J = call_rows(self.function, [], np.hstack([q @ self.joint_map.T, tau, y]))
        return modelled[:, 0], error[:, 0], J @ self.joint_map


class _Spread(NamedTuple):
    """What the calibration knows of positions: deviations of the parameters and their covariance, or None."""

    problem: CalibrationProblem
    x: Array
    covariance: Array | None
    marker: str

    def at(self, q: Array, torque: Array | None) -> Array:
        """Return sqrt(tr J C J') at commands, (N,) [m]."""
        if self.covariance is None:
            return np.full(len(q), np.inf)
        data = Dataset.of(q, np.zeros((len(q), 3)), 1.0, measurement=position)
        loads = None if torque is None else torque[:, None]
        data = replace(data, blocks=tuple(replace(b, markers=(self.marker,), torque=loads) for b in data.blocks))
        J = self.problem.on(data).jacobian(self.x)
        known = np.isfinite(np.diag(self.covariance))
        C = np.where(np.outer(known, known), self.covariance, 0.0)
        variance = np.sum((J @ C) * J, axis=1).reshape(len(q), 3).sum(axis=1)
        unseen = (np.abs(J[:, ~known]) > 0).any(axis=1).reshape(len(q), 3).any(axis=1)
        return np.where(unseen, np.inf, np.sqrt(np.maximum(variance, 0.0)))


class _Cell(NamedTuple):
    """The controller's robot, the identified one, and what the calibration knows of it."""

    robot: Robot
    kind: Measurement
    nominal: _Arm
    real: _Arm
    spread: _Spread

    @classmethod
    def of(cls, result: Calibration, kind: Measurement, tool: Any, marker: str, base: bool, torques: bool) -> _Cell:
        """Set up both robots with their tool; the second moved by the base's deviation if that counts."""
        robot, p = result.problem.robot, result.problem.parameters
        known = reflectors(p.names)
        if tool is None and marker not in known:
            raise InputError("marker", f"'{marker}'", choices(marker, [m or "no marker" for m in known]))
        marker = marker if tool is None else known[0]  # whose place the tool takes
        prefix = tool_prefix(marker)
        x, covariance = np.zeros(len(p)), known_covariance(result)
        x[p.identified] = result.x
        if tool is not None:
            own = np.asarray(tool, dtype=float)
            if own.shape != (6,) or not np.isfinite(own).all():
                raise InputError("tool", f"{tool}", "x, y, z [m], roll, pitch, yaw [rad]")
            at = [p.names.index(prefix + c) for c in FRAME]
            places, identified = p.nominal.copy(), p.identified.copy()
            places[at], identified[at], x[at] = own, False, 0.0
            kept = identified[p.identified]
            covariance = None if covariance is None else covariance[np.ix_(kept, kept)]
            p = replace(p, nominal=places, identified=identified)
        values = [dict(zip(p.names, v.tolist(), strict=True)) for v in (p.nominal, p.values(x))]
        moved = np.eye(4)
        if base:
            stated, found = (numeric_frame([v[f"base_{c}"] for c in FRAME]) for v in values)
            moved = np.linalg.inv(stated) @ found
        nominal = _Arm.of(robot, values[0], prefix, np.eye(4), kind, torques)
        real = _Arm.of(robot, values[1], prefix, moved, kind, torques)
        problem = CalibrationProblem(robot, p, result.problem.data)
        return cls(robot, kind, nominal, real, _Spread(problem, x[p.identified], covariance, marker))

    def compensated(
        self, q: Array | None, poses: Array | None, torque: Array | None, largest: float
    ) -> dict[str, Array]:
        """Return the fields of a `Compensation` for some rows."""
        limits, N = self.robot.limits, len(np.asarray(q if poses is None else poses))
        tau = np.empty((N, 0)) if torque is None else torque @ np.linalg.inv(self.robot.joint_map)  # of the model's
        nominal = np.asarray(q) if poses is None else self._commands(poses, q, tau)
        asked = np.zeros((N, len(self.kind.columns))) if poses is None else poses
        believed, missed, _ = self.nominal.at(nominal, tau, asked)
        target, missed = (believed, np.zeros_like(missed)) if poses is None else (poses, missed)
        _, before, J = self.real.at(nominal, tau, target)
        W = _attainable(J)
        unit = _units(self.robot, J.shape[1])
        reached = self._reached(missed, W)
        due = np.where(reached[:, None], before - missed, 0.0)
        P = _pinned(W @ J * unit, _times(W, due), largest)
        inside = np.clip(nominal, *limits.T)
        low, high = np.maximum(limits[:, 0], inside - largest), np.minimum(limits[:, 1], inside + largest)
        found, left, held = _descend(self.real, tau, target, nominal, low, high, unit, W, P)
        at_limit = (held & ((found <= limits[:, 0]) | (found >= limits[:, 1]))).any(axis=1)
        cases = {"ok": self._reached(left, W), "limited": at_limit, "unreachable": ~reached}
        (place_before, turn_before), (place, turn) = self._norms(before), self._norms(left)
        return {
            "nominal": nominal,
            "q": found,
            "position_before": place_before,
            "orientation_before": turn_before,
            "position_error": place,
            "orientation_error": turn,
            "std": self.spread.at(found, torque),
            "status": np.select(list(cases.values()), list(cases), "near singular"),
        }

    def _commands(self, poses: Array, q: Array | None, tau: Array) -> Array:
        """Return joint values (N, dof) of the controller's robot for poses: near q, or near a known configuration."""
        starts = self._starts(poses, tau.shape[1]) if q is None else q[:, None]
        found, left, _ = self._nearest(poses, tau, starts[:, 0])
        for k in range(1, starts.shape[1]):
            again = np.flatnonzero(np.linalg.norm(left, axis=1) > REACHED)
            if not len(again):
                break
            other, error, _ = self._nearest(poses[again], tau[again], starts[again, k])
            better = np.linalg.norm(error, axis=1) < np.linalg.norm(left[again], axis=1)
            found[again[better]], left[again[better]] = other[better], error[better]
        if poses.shape[1] == 3 or self.robot.dof >= 6:
            return found
        return self._nearest(poses, tau, found, _attainable(self.nominal.at(found, tau, poses)[2]))[0]

    def _nearest(self, poses: Array, tau: Array, start: Array, W: Array | None = None) -> tuple:
        low, high = self.robot.limits.T
        return _descend(self.nominal, tau, poses, start, low, high, np.ones(self.robot.dof), W)

    def _starts(self, poses: Array, torques: int) -> Array:
        """Return the nearest of many configurations within limits, or a turn, for every pose, (N, TRIALS, dof)."""
        low, high = self.robot.limits.T
        low = np.where(np.isfinite(low), low, np.minimum(high, np.pi) - 2 * np.pi)
        high = np.where(np.isfinite(high), high, low + 2 * np.pi)
        bank = random_candidates(replace(self.robot, limits=np.column_stack([low, high])), BANK)
        seen = self.nominal.at(bank, np.zeros((BANK, torques)), np.zeros((BANK, poses.shape[1])))[0]
        distance = cdist(poses[:, :3], seen[:, :3], "sqeuclidean")
        if poses.shape[1] == 7:
            distance += 8 * (1 - np.abs(poses[:, 3:] @ seen[:, 3:].T))  # the angle's square, nearly
        nearest = np.argpartition(distance, TRIALS, axis=1)[:, :TRIALS]
        order = np.argsort(np.take_along_axis(distance, nearest, axis=1), axis=1)
        return bank[np.take_along_axis(nearest, order, axis=1)]

    @property
    def _lengths(self) -> np.ndarray:
        return np.array([dimension == "length" for dimension in self.kind.components.values()])

    def _norms(self, error: Array) -> tuple[Array, Array]:
        """Return the norms of position and orientation errors; NaN where there is no orientation."""
        turn = error[:, ~self._lengths]
        angle = np.linalg.norm(turn, axis=1) if turn.shape[1] else np.full(len(error), np.nan)
        return np.linalg.norm(error[:, self._lengths], axis=1), angle

    def _reached(self, error: Array, W: Array) -> np.ndarray:
        place, turn = self._norms(_times(W, error))
        return (place <= REACHED) & ~(turn > REACHED)


def _units(robot: Robot, equations: int) -> Array:
    """Return what counts as one for every joint: the ranges where there are more joints than equations, else 1."""
    span, unit = np.ptp(robot.limits, axis=1), np.ones(robot.dof)
    if robot.dof > equations:
        span[~np.isfinite(span)] = 2 * np.pi
        for kind in set(robot.joint_types):
            alike = np.array([k == kind for k in robot.joint_types])
            unit[alike] = span[alike] / span[alike].min()
    return unit


def _attainable(J: Array) -> Array:
    """Return matrices W (N or 1, k, k) that project errors on those that count, from Jacobians (N, k, n).

    With six joints or more, or positions alone, all do. With fewer position comes first: of the orientation counts what
    can be turned without moving the point, which makes as many equations as joints.
    """
    k, n = J.shape[1:]
    if n >= k or k == 3:
        return np.eye(k)[None]
    still = np.linalg.svd(J[:, :3])[2][:, 3:]
    U, s, _ = np.linalg.svd(J[:, 3:] @ still.transpose(0, 2, 1), full_matrices=False)
    U = U * (s > 1e-6)[:, None]
    W = np.tile(np.eye(k), (len(J), 1, 1))
    W[:, 3:, 3:] = U @ U.transpose(0, 2, 1)
    return W


def _times(W: Array, vectors: Array) -> Array:
    return (W @ vectors[:, :, None])[:, :, 0]


def _pinned(A: Array, due: Array, largest: float) -> Array:
    """Return the weights P (N, n, n) of corrections.

    With A = U diag(s) V', the correction in direction v_i would be e_i / s_i, e = U' due; see `compensate`.
    """
    n = A.shape[2]
    U, s, Vt = np.linalg.svd(A, full_matrices=True)
    e, some = np.zeros((len(A), n)), s.shape[1]
    e[:, :some] = np.einsum("nij,ni->nj", U, due)[:, :some]
    s = np.pad(s, ((0, 0), (0, n - some)))
    p = np.maximum((e / largest) ** 2 - s**2, 0.0)
    p += KEPT * s[:, :1] ** 2 * (s <= 1e-9 * s[:, :1])
    return np.einsum("nki,nk,nkj->nij", Vt, p, Vt)


def _descend(
    arm: _Arm, tau: Array, y: Array, start: Array, low: Array, high: Array, unit: Array, W: Array | None = None,
    P: Array | None = None,
) -> tuple[Array, Array, np.ndarray]:  # fmt: skip
    """Minimize |W error|^2 + D' P D from ``start``, q = start + unit D, within low and high, row by row.

    Gauss-Newton steps in the box, damped (Levenberg-Marquardt) in rows whose step does not lower the sum.

    Returns
    -------
    Joint values (N, n), their errors (N, k), and which joints a bound holds back (N, n).
    """
    N, n = start.shape
    P = np.zeros((N, n, n)) if P is None else P
    low, high = (np.broadcast_to(bound, start.shape) for bound in (low, high))
    to_low, to_high = (low - start) / unit, (high - start) / unit
    D, damping, left = np.clip(0.0, to_low, to_high), np.zeros(N), np.arange(N)

    def at(rows: np.ndarray, D: Array) -> tuple[Array, Array, Array, Array]:
        q = np.clip(start[rows] + unit * D, low[rows], high[rows])
        _, error, J = arm.at(q, tau[rows], y[rows])
        r, A = error, J * unit
        if W is not None and len(W) == N:
            r, A = _times(W[rows], r), W[rows] @ A
        return error, r, A, np.sum(r**2, axis=1) + np.sum(D * _times(P[rows], D), axis=1)

    def slope(rows: np.ndarray) -> Array:
        return np.einsum("nki,nk->ni", A[rows], r[rows]) - _times(P[rows], D[rows])

    error, r, A, cost = at(left, D)
    for _ in range(PASSES):
        if not len(left):
            break
        H = A[left].transpose(0, 2, 1) @ A[left] + P[left]
        diagonal = np.einsum("nii->ni", H)
        diagonal += damping[left, None] * diagonal + 1e-14 * diagonal.mean(axis=1, keepdims=True) + 1e-300
        g = slope(left)
        step = _boxed(H, g, to_low[left] - D[left], to_high[left] - D[left])
        tried = at(left, D[left] + step)
        better = tried[3] <= cost[left] * (1 + 1e-14) + 1e-20  # below that it is rounding
        rows = left[better]
        D[rows] += step[better]
        for kept, new in zip((error, r, A, cost), tried, strict=True):
            kept[rows] = new[better]
        damping[rows] = np.where(damping[rows] > 1e-6, damping[rows] / 10, 0.0)
        damping[left[~better]] = np.maximum(10 * damping[left[~better]], 1e-3)
        far = (np.abs(step).max(axis=1) > SETTLED) & (np.sum(step * g, axis=1) > SLIGHT * cost[left])
        left = left[far & (cost[left] > 1e-24)]
    g = slope(np.arange(N))
    held = ((to_low >= D) & (g < 0)) | ((to_high <= D) & (g > 0))
    return np.clip(start + unit * D, low, high), error, held


def _boxed(H: Array, g: Array, low: Array, high: Array) -> Array:
    """Return steps d (N, n) that minimize d'Hd/2 - g'd within low <= 0 <= high, nearly.

    Entries at a bound that the slope pushes out stay; those that leave the box are set on its border and the
    others solved anew, until none leaves. Which bounds hold in the end the next step's slope decides.
    """
    n = g.shape[1]
    free = ~(((low >= 0) & (g < 0)) | ((high <= 0) & (g > 0)))
    step, rows = np.zeros_like(g), np.arange(len(g))
    for _ in range(n + 1):
        f = free[rows]
        pairs = f[:, :, None] & f[:, None, :]
        fixed = np.where(f, 0.0, step[rows])
        rest = np.where(f, g[rows] - np.einsum("nij,nj->ni", H[rows], fixed), 0.0)
        solved = np.linalg.solve(np.where(pairs, H[rows], np.eye(n)), rest[:, :, None])[:, :, 0]
        step[rows] = np.clip(np.where(f, solved, fixed), low[rows], high[rows])
        out = f & ((solved < low[rows]) | (solved > high[rows]))
        free[rows] &= ~out
        rows = rows[out.any(axis=1)]
        if not len(rows):
            break
    return step
