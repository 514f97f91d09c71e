"""Compensation: corrected joint commands for the calibrated robot, and the remaining errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import casadi as ca
import numpy as np
import scipy

from rpim_opt.basics.arrays import Array, finite_numbers, rms, statistics
from rpim_opt.basics.exceptions import InputError, RowError, choices, pick
from rpim_opt.basics.tables import columns_csv, records
from rpim_opt.basics.text import listed, table
from rpim_opt.basics.threads import on_all_cores, one_blas_thread
from rpim_opt.basics.units import display, joint_columns
from rpim_opt.calibration.acceptance import accept
from rpim_opt.calibration.covariance import noise_covariances, position_noise
from rpim_opt.calibration.diagnosis import SLACK, Outside
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.measurements.pose import pose, position
from rpim_opt.problem.design import random_candidates
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.row_functions import loads_on, measured_torques, require_known_masses, require_same_torques
from rpim_opt.robot import kinematics
from rpim_opt.robot.chain import placed
from rpim_opt.robot.kinematics import FRAME, call_rows, chain, forward_kinematics, numeric_frame, product
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import reflectors, tool_prefix
from rpim_opt.use.reading import Targets
from rpim_opt.use.sessions import base_frame, in_session, session_notes

SMALLEST = 1e-12  # smaller corrections [rad or m] are zero
BLOCK = 8192  # rows processed together, so that their data fit into the processor's cache
REACHED = 1e-7  # remaining error [m, rad] of a reached target
EXPANDED = 2.0  # coverage factor of the expanded uncertainty that is compared with errors and the limit
BESIDE = 0.05  # distance [m] between a stated position and its joint values that is reported
UNREACHABLE, ABOVE = "unreachable", "above the limit"
FIRST = np.array([1, 1, 1, 1e-3, 1e-3, 1e-3])  # weights [m/rad] of an error if position has priority
STILL = 1e-9  # weight [m^2/rad^2] of joint motion then: a singular wrist does not swing for an orientation
KEPT = np.array([1, 1, 1, 1e-4, 1e-4, 1e-4])  # `REACHED` is 1e-7 m, and 1 mrad if orientations are kept
NO_NOISE = 1e-18  # variance [m^2, rad^2] of unmeasured orientations: a reading needs a covariance
BANK = 2000  # configurations among which start values are sought for a pose without one
INSIDE, ANYWHERE = 48, 12  # start values tried in the measured joint ranges, then within limits
NULL_SPACE_WEIGHT = 1e-10  # weight of a correction in the null space, relative to the largest squared singular value
STEP_TOLERANCE = 1e-10
DECREASE_TOLERANCE = 1e-6
"""A row has converged when its step is shorter [rad or m], or decreases the objective by a smaller relative amount."""
MAX_ITERATIONS = 50
MOVED = 6  # targets needed for a significant common motion
WEIGHED = "a calibration with compliances identified from torques of gravity, or a term that depends on the payload"


@dataclass(frozen=True, eq=False)
class Compensation:
    """Corrected joint commands of a ``robot`` for N targets, and their errors by the calibrated model.

    ``nominal`` and ``q`` (N, dof) are the commands of the nominal controller and the corrected ones [rad or m].
    ``position_before`` and ``position_error`` (N,) [m] are their distances from the target by the calibrated model, the
    latter zero if the target is attainable; ``orientation_before`` and ``orientation_error`` [rad] likewise, NaN if
    orientations are not compensated. ``std`` (N,) [m] is the standard uncertainty of the position in the instrument's
    frame, sqrt(tr J C J' + tr R), with the covariance C of all identified parameters including the base, their Jacobian
    J and the repeatability R; infinite without C. ``orientation_std`` (N,) [rad] is that of the orientation, with R if
    orientations were measured.

    ``status`` of a row is ``"ok"`` (at most 0.1 um and 0.1 urad remain, 1 mrad if orientations are kept), ``"limited"``
    (by a joint limit), ``"unreachable"`` (also for the nominal robot; the command is the nearest found), ``"near
    singular"`` (the correction would be too large, and was damped) or ``"above the limit"`` (the sum of position error
    and expanded uncertainty, k = 2, exceeds ``limit`` [m]). An ``"ok"`` row is ``"extrapolated"`` beyond the measured
    joint ranges; ``outside`` are all rows there. ``note`` states why a robot is not delivered, how joints with
    estimated signs or zeros count, and the session of the instrument's frame; ``point`` the point that is moved, and
    why orientations are not corrected; ``source`` names the calibration; ``texts`` are further columns of the targets'
    table. ``beside`` (N,) [m] is the distance of a stated position from the nominal robot's at the joint values stated
    with it, NaN without these. ``std_after_motion`` is the RMS [m] of the standard uncertainties left by one motion of
    all targets, NaN for fewer than `MOVED` of them.
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
    orientation_std: Array
    beside: Array
    status: tuple[str, ...]
    outside: Outside = field(default_factory=Outside)
    note: str = ""
    point: str = ""
    limit: float = np.inf
    source: str = ""
    std_after_motion: float = np.nan
    texts: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def __str__(self) -> str:
        figures = []
        for name, values in {
            "position [mm], uncorrected command": self.position_before,
            "position [mm], corrected, by the model": self.position_error,
            "position in the instrument's frame [mm], standard uncertainty": self.std,
            "orientation [mrad], uncorrected command": self.orientation_before,
            "orientation [mrad], corrected, by the model": self.orientation_error,
            "orientation in the instrument's frame [mrad], standard uncertainty": self.orientation_std,
        }.items():
            if np.isfinite(values).all():
                shown = (values.mean(), np.sqrt(np.mean(values**2)), values.max())
                figures.append([name, *(f"{1e3 * value:.4f}" for value in shown)])
        changes = (f"{name.replace('_', f' {value:.3f} ')}" for name, value in self._largest_corrections().items())
        flange = 1e3 * forward_kinematics(self.robot, np.zeros((1, self.robot.dof)))[0, :3, 3]
        lines = [
            table([f"{len(self.q)} targets, error", "mean", "RMS", "max"], figures),
            f"Largest corrections: {', '.join(changes)}.",
            "Targets are stated in the robot's base frame, in which the nominal flange at zero joint values is at x "
            f"{flange[0]:z.3f} y {flange[1]:z.3f} z {flange[2]:z.3f} mm. Uncorrected errors refer to the identified "
            "base; nominal errors in a report refer to a refitted base and tool.",
        ]
        if self.std_after_motion < rms(self.std) / 2:
            whole, left = (f"{1e3 * EXPANDED * each:.4f} mm" for each in (rms(self.std), self.std_after_motion))
            lines.append(
                f"Most of the expanded uncertainty (k = 2), {whole} RMS, is a common displacement of all targets: the "
                f"data hardly determine the base frame. Relative to each other it is {left} RMS."
            )
        at_fault = {UNREACHABLE: " in the robot's base frame", ABOVE: f" of {1e3 * self.limit:g} mm"}
        for status, where in {"limited": "", "near singular": "", **at_fault}.items():
            rows = [f"{self.label[i]} ({self._left(i)})" for i, each in enumerate(self.status) if each == status]
            if rows:
                lines.append(f"{status.capitalize()}{where}: {listed(rows)}.")
        uncertain = np.count_nonzero((np.array(self.status) == ABOVE) & (self.position_error <= self.limit))
        unsure = "reach their target by the model, with an uncertainty that is above the limit"
        counts = {"miss their target": len(self.missed) - uncertain, unsure: uncertain}
        said = "{} of {} commands {}; do not execute these rows."
        lines += [said.format(count, len(self.q), what) for what, count in counts.items() if count]
        if len(self.missed) > uncertain and np.isfinite(self.orientation_error).any():
            lines.append(
                "Without --orientation, position has priority; --position-only ignores the targets' orientations."
            )
        vague = EXPANDED * self.std > self.position_before
        if vague.mean() > 0.5 and np.isfinite(self.std).all():
            lines.append(
                f"In {vague.sum()} of {len(self.q)} rows the expanded uncertainty (k = 2) is larger than the error "
                "that is corrected: the commands may be no better than the nominal ones."
            )
        far = [i for i in np.argsort(-np.nan_to_num(self.beside)) if self.beside[i] > BESIDE]
        if far:
            lines.append(
                f"Positions of {len(far)} rows are far from the joint values in the same row, by up to "
                f"{1e3 * self.beside[far[0]]:.0f} mm (row {self.label[far[0]]}); the commands reach the positions. Are "
                "they of another tool (--tool), or not in the robot's base frame?"
            )
        return "\n".join([*lines, *filter(None, [self.note, self.point]), *self.outside.sentences()])

    @property
    def missed(self) -> list[str]:
        """The labels of rows that miss their target: unreachable, or with error and uncertainty above the limit.

        Without a limit, rows count whose error exceeds twice its standard uncertainty.
        """
        far = np.isin(self.status, (UNREACHABLE, ABOVE))
        if not np.isfinite(self.limit):
            far |= self.position_error > EXPANDED * self.std
        return [self.label[i] for i in np.flatnonzero(far)]

    def _left(self, row: int) -> str:
        """Return the error of a row, its U where that counts, and the joints at a limit."""
        figures = {
            f"error {1e3 * self.position_error[row]:.3f} mm": True,
            f"U {1e3 * EXPANDED * self.std[row]:.3f} mm": self.status[row] == ABOVE,
            f"{1e3 * self.orientation_error[row]:.3f} mrad": self.orientation_error[row] > REACHED,
        }
        left = [text for text, counts in figures.items() if counts]
        low, high = self.robot.limits.T
        for i in np.flatnonzero((self.q[row] <= low) | (self.q[row] >= high)):
            unit, si = display(self.robot.joint_dimensions[i])
            left.append(f"joint {self.robot.joint(i)} at its limit of {self.q[row, i] / si:.6g} {unit}")
        return ", ".join(left)

    def _largest_corrections(self) -> dict[str, float]:
        joints = joint_columns(self.robot.joint_dimensions)
        change = np.abs(self.q - self.nominal).max(axis=0) / list(joints.values())
        return dict(zip(joints, change.tolist(), strict=True))

    def _columns(self) -> dict[str, Sequence[Any]]:
        joints = joint_columns(self.robot.joint_dimensions)
        commands = {name: self.q[:, i] / si for i, (name, si) in enumerate(joints.items())}
        left = {"position_error_mm": self.position_error, "orientation_error_mrad": self.orientation_error}
        left |= {"std_mm": self.std, "orientation_std_mrad": self.orientation_std}
        figures = commands | {name: 1e3 * values for name, values in left.items()}
        own = {"label": self.label, **{k: v.tolist() for k, v in figures.items()}, "status": self.status}
        return {**own, **{name: cells for name, cells in self.texts.items() if name not in own}}

    def content(self) -> dict[str, Any]:
        """Return the errors [mm, mrad], and a row for every target as in `csv`."""

        def errors(position: Array, orientation: Array) -> dict[str, Any]:
            return {"position": statistics(position), "orientation": statistics(orientation, "mrad")}

        return {
            "nominal": errors(self.position_before, self.orientation_before),
            "corrected": errors(self.position_error, self.orientation_error),
            "largest_corrections": self._largest_corrections(),
            "std_after_motion_mm": 1e3 * self.std_after_motion,
            "missed": self.missed,
            "outside": [self.label[i] for i in self.outside.rows],
            "rows": records(self._columns()),
            "note": self.note,
            "point": self.point,
            "source": self.source,
            "limit_mm": 1e3 * self.limit,
        }

    def csv(self) -> str:
        """Return labels, corrected commands, remaining errors, status and a note on their origin as CSV text."""
        columns = self._columns()
        limit = f"Limit {1e3 * self.limit:g} mm." if np.isfinite(self.limit) else "No limit."
        units = "std_mm and orientation_std_mrad are standard uncertainties (k = 1)."
        note = " ".join(filter(None, [self.note, f"{self.source}.", self.point, units, limit]))
        columns["note"] = [note, *[""] * (len(self.q) - 1)]
        return columns_csv(columns, joint_columns(self.robot.joint_dimensions))


@one_blas_thread
def compensate(
    result: Calibration,
    q: Array | None = None,
    poses: Array | None = None,
    *,
    orientation: bool | None = None,
    tool: Sequence[float] | Array | None = None,
    marker: str = "",
    base: bool = False,
    torque: Array | None = None,
    payload: float | Array | None = None,
    payload_centre: Sequence[float] | Array | None = None,
    largest: float = 0.2,
    limit: float | None = None,
    label: Sequence[str] = (),
    robot: str = "",
    despite_verdict: bool = False,
) -> Compensation:
    """Correct joint commands so that the calibrated robot reaches the poses of the nominal one.

    A target is the pose of the tool in the robot's base: that of the nominal robot at a command q, or a stated one.
    The corrected command q + D minimizes, within the joint limits and with no joint moved by more than ``largest``,

        |p|^2 + |w|^2 + D' P D

    where p [m] and w [rad] are the identified robot's errors of position and orientation. With fewer than six joints,
    only rotations that do not move the point count. With the singular values s of the Jacobian at q, P is zero unless
    the exact correction e / s of an error e would be longer than ``largest`` (near singular): there it is (e /
    largest)^2 - s^2, which makes the part (s largest / e)^2 of the correction. In the null space of redundant joints P
    is small and positive, so that the correction is the shortest to first order.

    **Which frame.** The identified base is the place of the instrument and is not compensated: targets hold in the base
    as identified. Data do not distinguish a rotation of joint 1 from one of the base; the part that the scales assign
    to the base stays. With ``base=True`` targets hold in the base as stated, and the robot also corrects for its place
    (with ``base = "auto"`` that of registration).

    **Targets.** ``q`` (N, dof) are commands of the nominal controller [rad or m], ``poses`` targets in the base, (N, 7)
    x, y, z [m] and unit quaternion, w first, or (N, 3) positions. With both, ``q`` are start values for the poses;
    without ``q`` several configurations near a pose are tried as start values, in the measured joint ranges, then
    within the limits. ``label`` names the rows, ``robot`` is one of several.

    **Orientation.** Position has priority: if some of p remains, |w|^2 counts 1e-6 m^2 instead, and |D|^2 1e-9 m^2
    rad^-2. The same applies to all targets if the standard uncertainty of any orientation exceeds its w, since
    positions of one reflector hardly determine it; w is then the change of orientation by the correction, so that rows
    of a program do not rotate relative to each other. ``orientation=True`` corrects all orientations, at the cost of
    positions if not both are attainable; with ``False`` orientations of targets are ignored.

    **Tool.** Both robots have the same tool, so that differences of tools are not compensated: ``tool`` (6,) in the
    flange frame, x, y, z [m], roll, pitch, yaw [rad], the controller's TCP, or by default the identified reflector of
    the calibration (``marker`` of several). The flange frame is that of the DH table, after the last joint.

    **Loads.** Joints are in the middle of their backlash. ``torque`` (N, dof) [Nm], possibly zero, is required if
    compliances were identified from measured torques; otherwise ``payload`` [kg], a number or (N,), and
    ``payload_centre`` (3,) in the flange frame [m] may be stated, by default those of the problem.

    ``largest`` is the largest correction of a joint [rad or m], ``limit`` [m] bounds the sum of the remaining position
    error and its expanded uncertainty (k = 2), by default that of the record's requirement. NotDelivered for a
    calibration that is not delivered, or that its acceptance test rejects, unless ``despite_verdict``; InputError for
    shapes that do not fit, numbers that are not finite, and an unknown reflector.

    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> result = ro.calibrate(instance.problem, ro.tikhonov, weight=ro.l_curve)
    >>> found = ro.use.compensate(result, instance.validation.q)
    >>> print(f"{1e3 * found.position_before.mean():.2f} mm, {1e3 * found.position_error.max():.4f} mm left")
    2.64 mm, 0.0000 mm left
    >>> print(found.csv().splitlines()[0])
    label,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,position_error_mm,orientation_error_mrad,std_mm,orientation_std_mrad,status,note
    """
    arm = pick(result.problem.arms, robot, "robot")
    result = in_session(result, robot)
    verdict, permitted = result.verdict, np.inf
    if requirement := result.record.requirement:
        verdict, permitted = accept(result).on(verdict), requirement.limit
    notes = verdict.require(despite_verdict), result.no_intervals, *session_notes(result, robot)
    targets = _checked(arm, Targets(tuple(label), q, poses, torque), orientation is not False)
    if limit is None:
        limit = permitted
    if not largest >= SMALLEST:
        raise InputError("largest", f"{largest}", f"a correction of at least {SMALLEST:g}")
    oriented = orientation is not False and (targets.poses is None or targets.poses.shape[1] == 7)
    if payload_centre is not None:
        arm = replace(arm, gravity=arm.gravity.carrying(arm.gravity.payload, list(payload_centre)))
    kind = pose if oriented else position
    cell = _Cell(result, robot, arm, kind, tool, marker, base, targets.torque is not None)
    if "payload" in cell.loads.stated:
        mass = np.asarray(arm.gravity.payload if payload is None else payload, dtype=float)
        count = len(targets.label)
        if mass.shape not in ((), (count,)) or not (mass >= 0).all() or not np.isfinite(mass).all():
            raise InputError("payload", f"{payload}", f"a mass [kg] that is not negative, one or {count}")
        require_known_masses(arm, cell.problem.parameters, cell.problem.data, mass)
        targets = targets._replace(payload=np.broadcast_to(mass, count))
    elif payload is not None or payload_centre is not None:
        raise InputError("payload", "a payload without effect on the model", WEIGHED)
    whole, why = _corrected(cell, targets, largest, orientation)
    point = cell.point + why
    if oriented and not turns_measured(cell.problem):
        point += " Positions of one reflector determine only part of an orientation; the prior determines the rest."
    expanded = EXPANDED * np.nan_to_num(whole["std"], posinf=0.0)
    above = (whole["position_error"] + expanded > limit) & (whole["status"] != UNREACHABLE)
    reached = Dataset.of(whole["q"], np.zeros((len(expanded), 3)), 1.0)
    outside = result.outside(Dataset.of_robots({robot: reached}))
    status = np.where(above, ABOVE, whole["status"])
    status[np.isin(np.arange(len(status)), outside.rows) & (status == "ok")] = "extrapolated"
    whole["status"] = tuple(status.tolist())
    if targets.q is None:
        point += " Targets without joint values may be reached in another arm configuration: state q1, ... with them."
        if outside.rows:
            beyond = listed([targets.label[i] for i in outside.rows])
            point += f" No solution in the measured joint ranges was found for {beyond}."
    return Compensation(
        result.problem.arms[robot], targets.label, **whole, outside=outside, note=" ".join(filter(None, notes)),
        point=point, limit=limit, source=result.record.identity,
    )  # fmt: skip


def _corrected(cell: _Cell, targets: Targets, largest: float, orientation: bool | None) -> tuple[dict[str, Any], str]:
    """Return the fields of all rows, and whether orientations are corrected where that is not stated."""
    rows = np.arange(len(targets.label))
    blocks = [targets.take(rows[i : i + BLOCK]) for i in range(0, len(rows), BLOCK)]
    choice = orientation is None and cell.kind is pose
    aims = on_all_cores(cell.aim, blocks)
    every = range(len(blocks))
    vague, why = 0, ""
    if choice:  # all rows are treated alike: they must not rotate relative to each other
        vague = sum(on_all_cores(lambda i: cell.vague(blocks[i], aims[i]), every))
        why = " Orientations of all targets are corrected."
    parts = on_all_cores(lambda i: cell.corrected(blocks[i], aims[i], largest, not vague, choice), every)
    fields: dict[str, Any] = {name: np.concatenate([each[name] for each in parts]) for name in parts[0]}
    if vague:
        why = (
            f" Orientations are not corrected: those of {vague} of {len(targets.label)} targets are known no better "
            "than by the nominal robot; --orientation corrects them anyway."
        )
    there = fields.pop("there")
    if len(there) >= MOVED:
        few = rows[:: -(-len(rows) // BLOCK)]
        fields["std_after_motion"] = rms(cell.uncertainty(fields["q"][few], targets.take(few), there[few])[0])
    return fields, why


def turns_measured(problem: CalibrationProblem) -> bool:
    """Return whether orientations were measured, or several reflectors, which determine them."""
    several = len(reflectors(problem.parameters.names)) > 1
    return several or any(block.measurement.turning for block in problem.data.blocks)


def tool_uncertainty(result: Calibration, q: Array, tool: Array | None, marker: str, robot: str) -> tuple[Array, Array]:
    """Return ``std`` and ``orientation_std`` of a `Compensation` (N,) at commands q (N, dof)."""
    cell = _Cell(result, robot, result.problem.arms[robot], pose, tool, marker, False, False)
    return cell.uncertainty(q, Targets((), q, None, None))


def _checked(robot: Robot, stated: Targets, orientation: bool) -> Targets:
    """Return the targets as labelled arrays; InputError for what does not fit."""
    arrays = {name: rows for name, rows in stated._asdict().items() if rows is not None and name != "label"}
    if not arrays.keys() & {"q", "poses"}:
        raise InputError("targets", "neither joint values nor poses", "q, poses, or both")
    N = len(np.atleast_1d(arrays.get("poses", stated.q)))
    count = max(N, 1)
    shapes = {"q": [(count, robot.dof)], "torque": [(count, robot.dof)], "poses": [(count, 7), (count, 3)]}
    arrays = {name: finite_numbers(name, rows, *shapes[name]) for name, rows in arrays.items()}
    if "poses" in arrays and arrays["poses"].shape[1] == 7:
        try:
            arrays["poses"] = pose.prepare(arrays["poses"])[:, : 7 if orientation else 3]
        except RowError as error:
            raise InputError(f"poses, {error.where}", error.found, error.accepted) from None
    if len(stated.label) not in (0, N):
        raise InputError("label", f"{len(stated.label)} labels", f"{N}, one per row")
    return stated._replace(label=stated.label or tuple(str(i) for i in range(1, N + 1)), **arrays)


# --- the controller's robot beside the identified one ------------------------------------------------------

Aim = tuple[Array, Array, Array, Array, Array]
"""For N targets: nominal commands (N, dof), poses (N, c), loads (N, l), errors (N, k), and `beside`."""


class _Cell:
    """The controller's robot, the identified one, and the uncertainty of its position.

    Both are functions of joint values, loads and targets (`_poses`).
    """

    def __init__(
        self,
        result: Calibration,
        which: str,
        robot: Robot,
        kind: Measurement,
        tool: Sequence[float] | Array | None,
        marker: str,
        base: bool,
        torques: bool,
    ) -> None:
        """Set up both robots with their tool; the second moved by the base's deviation if that counts."""
        whole = result.problem.parameters
        p = whole.of_robot(which)
        every = np.zeros(len(whole))
        every[whole.identified] = result.x
        x = every[whole.places_of(which)]
        known = reflectors(p.names)
        if tool is None and marker not in known:
            found = {"": "none"}.get(marker, f"'{marker}'")
            named = choices(marker, [m or "no marker" for m in known])
            raise InputError("--marker", found, f"{named}, or a controller's TCP by --tool")
        if tool is not None:
            marker = known[0]
        at = p.frame(tool_prefix(marker))
        if tool is None:
            place = p.values(x)[at]
            how = "as identified, " * bool(p.identified[at].any())
            self.point = f"Target point: the reflector, {how}at {placed(place)} in the flange frame"
            self.point += "; for the controller's TCP state --tool."
        else:
            place = finite_numbers("tool", tool, (6,))
            self.point = (
                f"Target point: the stated tool, at {placed(place)} in the flange frame. Its U includes what the data "
                "do not determine of the flange: to reduce it, measure a reflector as far from the flange as this "
                "tool, or state what is known of the reflector (`known` in [prior])."
            )
        p = replace(p, nominal=p.nominal.copy(), identified=p.identified.copy())
        p.nominal[at], x[at] = place, 0.0
        p.identified[at] &= tool is None
        # indices (n,) of the robot's identified parameters among all
        self.own = whole.free.places_of(which)[p.identified[whole.identified[whole.places_of(which)]]]
        values = p.values(x)
        nominal, identified = (dict(zip(p.names, of.tolist(), strict=True)) for of in (p.nominal, values))
        stated = numeric_frame(p.nominal[p.frame("base_")])
        moved = np.linalg.inv(stated) @ base_frame(result, which) if base else np.eye(4)
        measured = result.problem.sample().alone(which)
        repeatability = measured.repeatability
        if repeatability is not None and tool is not None:
            repeatability = replace(repeatability, at=values)
        session = result.problem.session
        self.robot, self.kind, self.marker = robot, kind, marker
        self.problem = CalibrationProblem(robot, p, measured.data, repeatability=repeatability, session=session)
        self.x = x[p.identified]
        self.fit_covariance = None if result.no_intervals else result.fit_covariance
        self.noise = np.eye(len(kind.components)) * NO_NOISE  # of a reading
        self.noise[:3, :3] += position_noise(measured)
        self.level = result.variance_factor
        self.ranges = result.ranges[which]
        require_same_torques(robot, p, measured_torques(measured.data), torques)
        self.loads = loads_on(robot, p, measured.data, torques)
        self.nominal = self._poses(nominal, nominal, np.eye(4))
        self.identified = self._poses(identified, nominal, moved)

    def _poses(self, values: Mapping[str, float], nominal: Mapping[str, float], before: Array) -> PoseFunction:
        """Return the function of joint values q (N, dof), loads and targets y (N, c) of a robot with these values.

        It returns the pose (N, c), its error (N, k) from y, and the Jacobian (N, k, dof) of the pose. Gravity acts on
        the ``nominal`` values.
        """
        robot = self.robot
        tool = tool_prefix(self.marker)
        command = self.loads.symbols(len(robot.joint_types), 1)
        y = ca.SX.sym("y", len(self.kind.columns))

        def value(name: str) -> float:
            return values.get(name, 0.0)

        configuration = self.loads.configuration(robot.joint_types, nominal.__getitem__, command)
        flange = chain(robot.joint_types, configuration, value, robot.model.terms)
        T = product([ca.SX(ca.DM(before)), *flange, *kinematics.placed([value(tool + c) for c in FRAME])])
        # motion of T's point and orientation by the joints; gravity deflects a joint depending on all joint values
        turn = sum(ca.skew(T[:3, k]) @ ca.jacobian(T[:3, k], command["q"]) for k in range(3)) / 2
        J = ca.vertcat(ca.jacobian(T[:3, 3], command["q"]), turn)[: len(self.kind.components), :]
        modelled = self.kind.model(T)
        outputs = [ca.densify(v) for v in (modelled, self.kind.minus(y, modelled), J.T)]
        function = ca.Function("arm", [ca.vertcat(*command.values(), y)], outputs)

        def at(q: Array, load: Array, y: Array) -> tuple[Array, Array, Array]:
            modelled, error, J = call_rows(function, [], np.hstack([q @ robot.joint_map.T, load, y]))
            return modelled[:, 0], error[:, 0], J @ robot.joint_map

        return at

    def aim(self, targets: Targets) -> Aim:
        """Return the uncorrected commands of some targets, and what these miss."""
        _, q, poses, torque, payload = targets
        N = len(targets.label)
        if torque is not None:
            torque = torque @ np.linalg.inv(self.robot.joint_map)
        borne = [each.reshape(N, -1) for each in (torque, payload) if each is not None]
        load = np.hstack([np.empty((N, 0)), *borne])
        beside = np.full(N, np.nan)
        if poses is None:
            commands = np.asarray(q)
            target, error, _ = self.nominal(commands, load, np.zeros((N, len(self.kind.columns))))
            return commands, target, load, np.zeros_like(error), beside
        commands = self._commands(poses, q, load)
        if q is not None:
            beside = norms(self.nominal(q, load, poses)[1])[0]
        return commands, poses, load, self.nominal(commands, load, poses)[1], beside

    def vague(self, targets: Targets, aim: Aim) -> int:
        """Return how many targets' orientations are known no better than by the nominal robot."""
        commands, target, load, missed, _ = aim
        _, before, J = self.identified(commands, load, target)
        known = norms(before)[1] >= self.uncertainty(commands, targets)[1]
        return int(np.count_nonzero(is_reached(missed, attainable(J)) & ~known))

    def corrected(self, targets: Targets, aim: Aim, largest: float, turning: bool, choice: bool) -> dict[str, Array]:
        """Return the fields of a `Compensation` for some targets, with orientations if ``turning``.

        With ``choice`` positions have priority. ``there`` (N, 3) are the positions of uncorrected commands.
        """
        commands, target, load, missed, beside = aim
        pose_before, before, J = self.identified(commands, load, target)
        N, k, n = J.shape
        counts = np.broadcast_to(attainable(J), (N, k, k))
        reached = is_reached(missed, counts)
        wanted = np.where(turning | (np.arange(target.shape[1]) < 3), target, pose_before)
        due = np.where(reached[:, None] & (turning | (np.arange(k) < 3)), before - missed, 0.0)
        W = counts * np.where(turning, 1.0, FIRST[:k])
        # P = V diag(p) V' of W J = U diag(s) V', see `compensate`
        U, s, Vt = np.linalg.svd(W @ J, full_matrices=True)
        some = s.shape[1]
        e = np.zeros((len(J), n))
        e[:, :some] = np.einsum("nij,ni->nj", U, times(W, due))[:, :some]
        s = np.pad(s, ((0, 0), (0, n - some)))
        p = np.maximum((e / largest) ** 2 - s**2, 0.0)
        p += NULL_SPACE_WEIGHT * s[:, :1] ** 2 * (s <= 1e-9 * s[:, :1])
        still = STILL * np.eye(n)
        P = np.einsum("nki,nk,nkj->nij", Vt, p, Vt) + (not turning) * still
        lowest, highest = self.robot.limits.T
        inside = np.clip(commands, lowest, highest)
        limits = np.array([np.maximum(lowest, inside - largest), np.minimum(highest, inside + largest)])
        corrected, left, active = nearest(self.identified, load, wanted, commands, limits, W, P)
        first = np.flatnonzero((choice and turning) & reached & (norms(left)[0] > REACHED))
        if len(first):  # the whole pose is unattainable
            there = load[first], wanted[first], commands[first], limits[:, first], counts[first] * FIRST, still[None]
            corrected[first], left[first], active[first] = nearest(self.identified, *there)
        at_limit = (active & ((corrected <= lowest) | (corrected >= highest))).any(axis=1)
        reached_all = is_reached(left * np.where(turning, 1.0, KEPT[:k]), counts)
        cases = {"ok": reached_all, "limited": at_limit, UNREACHABLE: ~reached}
        status = np.select(list(cases.values()), list(cases), "near singular")
        fields = {"nominal": commands, "q": corrected, "beside": beside, "status": status, "there": pose_before[:, :3]}
        fields["position_before"], fields["orientation_before"] = norms(before)
        error = self.identified(corrected, load, target)[1]
        fields["position_error"], fields["orientation_error"] = norms(error)
        fields["std"], fields["orientation_std"] = self.uncertainty(corrected, targets)
        return fields

    def uncertainty(self, q: Array, targets: Targets, moved: Array | None = None) -> tuple[Array, Array]:
        """Return sqrt(tr (J C J' + R)) (N,) of position [m] and orientation [rad] reached at q, under their loads.

        With ``moved`` (N, 3), that of positions is what one motion of all of them leaves.
        """
        N, k = len(q), len(self.kind.components)
        if self.fit_covariance is None:
            return norms(np.full((N, k), np.inf))
        loads = targets.torque, targets.payload
        problem = self.problem.measuring(q, self.kind, self.marker, *loads, covariance=self.noise)
        J = np.zeros((N, k, len(self.fit_covariance.z)))
        J[:, :, self.own] = problem.jacobian(self.x).reshape(N, k, -1)
        if moved is not None:
            motions = np.concatenate([np.tile(np.eye(3), (N, 1, 1)), np.cross(moved[:, None], np.eye(3))], axis=2)
            Q = scipy.linalg.orth(motions.reshape(3 * N, 6))
            of_positions = J[:, :3].reshape(3 * N, -1)
            J[:, :3] = (of_positions - Q @ (Q.T @ of_positions)).reshape(N, 3, -1)
        position_and_turn = (self.fit_covariance.of_positions(J[:, i : i + 3]) for i in range(0, k, 3))
        variance = np.hstack([np.einsum("nkk->nk", C) for C in position_and_turn])
        variance += np.einsum("nkk->nk", noise_covariances(problem, self.level).robot[0])
        return norms(np.sqrt(variance))

    def _commands(self, poses: Array, q: Array | None, load: Array) -> Array:
        """Return joint values (N, dof) of the controller's robot for poses: near q, or near a known configuration."""
        n = self.robot.dof
        turn = np.where(np.array(self.robot.joint_dimensions) == "angle", 2 * np.pi, np.inf)

        def found(rows: np.ndarray, start: Array, W: Array, box: Array) -> tuple[Array, Array, np.ndarray]:
            limits = np.maximum(box[0], start - turn), np.minimum(box[1], start + turn)
            return nearest(self.nominal, load[rows], poses[rows], start, limits, W, np.zeros((1, n, n)))

        all_count = np.eye(len(self.kind.components))[None]
        limits = self.robot.limits.T
        trials = [(q, limits)] if q is not None else self._trials(poses, load.shape[1])
        best, left = trials[0][0].copy(), np.full(len(poses), np.inf)
        for start, box in trials:
            again = np.flatnonzero(left > REACHED)
            other, error, _ = found(again, start[again], all_count, box)
            error = np.linalg.norm(error, axis=1)
            better = error < left[again]
            best[again[better]] = other[better]
            left[again[better]] = error[better]
        if poses.shape[1] == 3 or n >= 6:
            return best
        return found(np.arange(len(poses)), best, attainable(self.nominal(best, load, poses)[2]), limits)[0]

    def _trials(self, poses: Array, loads: int) -> list[tuple[Array, Array]]:
        """Return configurations (N, dof) near every pose, and the box (2, dof) for the iterations.

        First come `INSIDE` in the measured joint ranges extended by half of the allowed excess, which leaves the other
        half to the correction; then `ANYWHERE` within limits, or one revolution.
        """
        low, high = self.robot.limits.T
        low = np.where(np.isfinite(low), low, np.minimum(high, np.pi) - 2 * np.pi)
        high = np.where(np.isfinite(high), high, low + 2 * np.pi)
        spare = SLACK / 2 * np.ptp(self.ranges, axis=0)
        limits = self.robot.limits.T
        measured = np.clip([self.ranges[0] - spare, self.ranges[1] + spare], *limits)
        trials = []
        for box, within, count in ((measured, measured, INSIDE), (np.array([low, high]), limits, ANYWHERE)):
            bank = random_candidates(replace(self.robot, limits=box.T), BANK)
            reached = self.nominal(bank, np.zeros((BANK, loads)), np.zeros((BANK, poses.shape[1])))[0]
            distance = scipy.spatial.distance.cdist(poses[:, :3], reached[:, :3], "sqeuclidean")
            if poses.shape[1] == 7:
                distance += 8 * (1 - np.abs(poses[:, 3:] @ reached[:, 3:].T))  # approximately the squared angle
            closest = np.argpartition(distance, count, axis=1)[:, :count]
            order = np.argsort(np.take_along_axis(distance, closest, axis=1), axis=1)
            starts = bank[np.take_along_axis(closest, order, axis=1)]
            trials += [(starts[:, i], within) for i in range(count)]
        return trials


def norms(error: Array) -> tuple[Array, Array]:
    """Return the norms of position and orientation errors (N, 3 or 6); NaN where there is no orientation."""
    whole = np.pad(error, ((0, 0), (0, 6 - error.shape[1])), constant_values=np.nan)
    return np.linalg.norm(whole[:, :3], axis=1), np.linalg.norm(whole[:, 3:], axis=1)


def is_reached(error: Array, W: Array) -> np.ndarray:
    """Return where no more than `REACHED` is left of errors that are attainable (`attainable`)."""
    distance, angle = norms(times(W, error))
    return (distance <= REACHED) & ~(angle > REACHED)


# --- inverse kinematics within joint limits, many rows at once ---------------------------------------------

PoseFunction = Callable[[Array, Array, Array], tuple[Array, Array, Array]]


def nearest(
    at: PoseFunction, load: Array, y: Array, start: Array, limits: tuple[Array, Array] | Array, W: Array, P: Array
) -> tuple[Array, Array, np.ndarray]:
    """Minimize |W error|^2 + D' P D over low <= q <= high, q = start + D, row by row.

    Gauss-Newton steps in the box, damped (Levenberg-Marquardt) in rows whose step does not lower the objective.
    Shapes: start (N, n), limits (N, n) or (n,), W (N or 1, k, k), P (N or 1, n, n). Return joint values (N, n), their
    errors (N, k), and whether joints are at an active limit (N, n).
    """
    N, n = start.shape
    W = np.broadcast_to(W, (N, *W.shape[1:]))
    P = np.broadcast_to(P, (N, n, n))
    low, high = (np.broadcast_to(limit, start.shape) for limit in limits)
    to_low = low - start
    to_high = high - start

    def state(rows: np.ndarray, D: Array) -> tuple[Array, Array, Array, Array]:
        """Return errors, weighted errors, their slopes, and the objectives."""
        q = np.clip(start[rows] + D, low[rows], high[rows])
        _, error, J = at(q, load[rows], y[rows])
        weighted = times(W[rows], error)
        value = np.sum(weighted**2, axis=1) + np.sum(D * times(P[rows], D), axis=1)
        return error, weighted, W[rows] @ J, value

    every = np.arange(N)
    D = np.clip(0.0, to_low, to_high)
    damping = np.zeros(N)
    error, weighted, A, value = here = state(every, D)

    def descent(rows: np.ndarray) -> Array:
        """Return half the negative gradients."""
        return np.einsum("nki,nk->ni", A[rows], weighted[rows]) - times(P[rows], D[rows])

    left = every
    for _ in range(MAX_ITERATIONS):
        if not len(left):
            break
        g = descent(left)
        H = A[left].transpose(0, 2, 1) @ A[left] + P[left]
        diagonal = np.einsum("nii->ni", H)  # damping by the trace makes every one regular
        diagonal += damping[left, None] * diagonal + 1e-14 * diagonal.mean(axis=1, keepdims=True) + 1e-300
        step = _boxed(H, g, to_low[left] - D[left], to_high[left] - D[left])
        new = state(left, D[left] + step)
        better = new[-1] <= value[left] * (1 + 1e-14) + 1e-20  # smaller differences are rounding
        rows = left[better]
        D[rows] += step[better]
        for old, values in zip(here, new, strict=True):
            old[rows] = values[better]
        damping[rows] = np.where(damping[rows] > 1e-6, damping[rows] / 10, 0.0)
        damping[left[~better]] = np.maximum(10 * damping[left[~better]], 1e-3)
        long = np.abs(step).max(axis=1) > STEP_TOLERANCE
        promising = np.sum(step * g, axis=1) > DECREASE_TOLERANCE * value[left]
        left = left[long & promising & (value[left] > 1e-24)]
    g = descent(every)
    active = ((to_low >= D) & (g < 0)) | ((to_high <= D) & (g > 0))
    return np.clip(start + D, low, high), error, active


def _boxed(H: Array, g: Array, low: Array, high: Array) -> Array:
    """Return approximate minimizers d (N, n) of d'Hd/2 - g'd within low <= 0 <= high.

    Entries outside the box are set to its boundary and the others solved for again, until all are inside.
    """
    n = g.shape[1]
    free = ~(((low >= 0) & (g < 0)) | ((high <= 0) & (g > 0)))
    step = np.zeros_like(g)
    rows = np.arange(len(g))
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


def attainable(J: Array) -> Array:
    """Return matrices W (N or 1, k, k) that project errors on the attainable ones, from Jacobians (N, k, n).

    With six joints or more, or positions only, all are. With fewer, position has priority, and of the orientation
    only rotations that do not move the point count: as many equations as joints.
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


def times(W: Array, vectors: Array) -> Array:
    """Return matrices (N, k, k) times vectors (N, k), row by row."""
    return (W @ vectors[:, :, None])[:, :, 0]
