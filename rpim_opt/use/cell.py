"""The controller's robot beside the identified one, and corrections of its commands with their uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.calibration.intervals import position_noise, scattered
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import known_covariance
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.measurements.position import position
from rpim_opt.problem.design import random_candidates
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.row_functions import Loads, bearing, loads_on, require_same_torques
from rpim_opt.robot.kinematics import FRAME, numeric_frame
from rpim_opt.robot.mdh import Gravity, Robot
from rpim_opt.robot.parameter_names import reflectors, tool_prefix
from rpim_opt.robot.parameters import Parameters
from rpim_opt.use.inverse_kinematics import Arm, attainable, correction_weights, joint_units, nearest, times

REACHED = 1e-7
"""A target counts as reached when no more than this is left [m, rad]."""
BANK = 2000
TRIALS = 12
"""Configurations among which a pose without a start looks for the nearest ones, and how many of them it tries."""


class Posterior(NamedTuple):
    """All parameters of a robot, their deviations (p,) [SI], and the covariance (n, n) of the identified, or None."""

    parameters: Parameters
    x: Array
    covariance: Array | None

    @classmethod
    def of(cls, result: Calibration, robot: str = "") -> Posterior:
        """Return what a calibration identified of a robot; the other parameters do not deviate."""
        parameters = result.problem.parameters
        x = np.zeros(len(parameters))
        x[parameters.identified] = result.x
        covariance = known_covariance(result)
        if not robot:
            return cls(parameters, x, covariance)
        places = parameters.places_of(robot)
        if covariance is not None:
            index = np.cumsum(parameters.identified) - 1
            own = index[places[parameters.identified[places]]]
            covariance = covariance[np.ix_(own, own)]
        return cls(parameters.of_robot(robot), x[places], covariance)

    def with_tool(self, prefix: str, tool: Sequence[float] | Array) -> Posterior:
        """Return the same with a tool that is known exactly, (6,) x, y, z [m], roll, pitch, yaw [rad]."""
        frame = np.asarray(tool, dtype=float)
        if frame.shape != (6,) or not np.isfinite(frame).all():
            raise InputError("tool", f"{tool}", "x, y, z [m], roll, pitch, yaw [rad]")
        at = [self.parameters.names.index(prefix + c) for c in FRAME]
        nominal = self.parameters.nominal.copy()
        nominal[at] = frame
        identified = self.parameters.identified.copy()
        identified[at] = False
        x = self.x.copy()
        x[at] = 0.0
        covariance = self.covariance
        if covariance is not None:
            still = identified[self.parameters.identified]
            covariance = covariance[np.ix_(still, still)]
        return Posterior(replace(self.parameters, nominal=nominal, identified=identified), x, covariance)

    def named(self, values: Array) -> dict[str, float]:
        """Return values (p,) by the parameters' names."""
        return dict(zip(self.parameters.names, values.tolist(), strict=True))


class Uncertainty(NamedTuple):
    """Standard uncertainty of positions, from the posterior covariance C (or None) and the robot's repeatability.

    ``noise`` is the covariance (3, 3) [m^2] of a reading, and ``level`` the noise's variance over it.
    """

    problem: CalibrationProblem
    x: Array
    covariance: Array | None
    marker: str
    noise: Array
    level: float

    def at(self, q: Array, torque: Array | None, payload: Array | None) -> Array:
        """Return sqrt(tr (J C J' + R)) (N,) [m] of the positions reached at commands; R is the repeatability's."""
        if self.covariance is None:
            return np.full(len(q), np.inf)
        data = Dataset.of(q, np.zeros((len(q), 3)), self.noise, measurement=position)
        data = bearing(data, self.problem.data, torque, payload)
        data = replace(data, blocks=(replace(data.blocks[0], markers=(self.marker,)),))
        problem = self.problem.on(data)
        J = problem.jacobian(self.x)
        known = np.isfinite(np.diag(self.covariance))
        C = np.where(np.outer(known, known), self.covariance, 0.0)
        variance = np.sum((J @ C) * J, axis=1).reshape(len(q), 3).sum(axis=1)
        variance += np.trace(scattered(problem, self.level).robot[0], axis1=1, axis2=2)
        unknown = (np.abs(J[:, ~known]) > 0).any(axis=1).reshape(len(q), 3).any(axis=1)
        return np.where(unknown, np.inf, np.sqrt(np.maximum(variance, 0.0)))


class Cell(NamedTuple):
    """The controller's robot, the identified one, and the uncertainty of where that is."""

    robot: Robot
    kind: Measurement
    nominal: Arm
    identified: Arm
    uncertainty: Uncertainty
    loads: Loads

    @classmethod
    def of(
        cls,
        result: Calibration,
        kind: Measurement,
        tool: Sequence[float] | Array | None,
        marker: str,
        base: bool,
        torques: bool,
        gravity: Gravity,
        which: str = "",
    ) -> Cell:
        """Set up both robots with their tool; the second moved by the base's deviation if that counts."""
        robot = replace(result.problem.arms[which], gravity=gravity)
        posterior = Posterior.of(result, which)
        measured = result.problem
        if which:
            measured = measured.sample().alone(which)
        reflector = marker
        known = reflectors(posterior.parameters.names)
        if tool is not None:  # which takes the place of the first reflector
            reflector = known[0]
            posterior = posterior.with_tool(tool_prefix(reflector), tool)
        elif marker not in known:
            raise InputError("marker", f"'{marker}'", choices(marker, [m or "no marker" for m in known]))
        nominal = posterior.named(posterior.parameters.nominal)
        identified = posterior.named(posterior.parameters.values(posterior.x))
        moved = np.eye(4)
        if base:
            moved = np.linalg.inv(_base(nominal)) @ _base(identified)
        scatter = measured.scatter
        if tool is not None and scatter is not None:
            scatter = replace(scatter, at=posterior.parameters.values(posterior.x))
        problem = CalibrationProblem(robot, posterior.parameters, measured.data, scatter=scatter)
        require_same_torques(robot, problem.parameters, problem.data, torques)
        loads = loads_on(robot, problem.parameters, problem.data, torques)
        free = posterior.x[posterior.parameters.identified]
        noise = position_noise(measured)
        prefix = tool_prefix(reflector)
        return cls(
            robot,
            kind,
            Arm.of(robot, nominal, nominal, prefix, np.eye(4), kind, loads),
            Arm.of(robot, identified, nominal, prefix, moved, kind, loads),
            Uncertainty(problem, free, posterior.covariance, reflector, noise, result.noise_level),
            loads,
        )

    def compensated(
        self, q: Array | None, poses: Array | None, torque: Array | None, payload: Array | None, largest: float
    ) -> dict[str, Array]:
        """Return the fields of a `Compensation` for some rows, of which q or poses are there."""
        N = len(np.asarray(q if poses is None else poses))
        load = self._load(N, torque, payload)
        if poses is not None:
            commands, target = self._commands(poses, q, load), poses
            missed = self.nominal.at(commands, load, poses)[1]
        else:
            commands = np.asarray(q)
            target, error, _ = self.nominal.at(commands, load, np.zeros((N, len(self.kind.columns))))
            missed = np.zeros_like(error)
        _, before, J = self.identified.at(commands, load, target)
        W = attainable(J)
        unit = joint_units(self.robot, J.shape[1])
        reached = self._reached(missed, W)
        due = np.where(reached[:, None], before - missed, 0.0)
        P = correction_weights(W @ J * unit, times(W, due), largest)
        lowest, highest = self.robot.limits.T
        inside = np.clip(commands, lowest, highest)
        low, high = np.maximum(lowest, inside - largest), np.minimum(highest, inside + largest)
        corrected, left, active = nearest(self.identified, load, target, commands, low, high, unit, W, P)
        at_limit = (active & ((corrected <= lowest) | (corrected >= highest))).any(axis=1)
        cases = {"ok": self._reached(left, W), "limited": at_limit, "unreachable": ~reached}
        position_before, orientation_before = self._norms(before)
        position_error, orientation_error = self._norms(left)
        return {
            "nominal": commands,
            "q": corrected,
            "position_before": position_before,
            "orientation_before": orientation_before,
            "position_error": position_error,
            "orientation_error": orientation_error,
            "std": self.uncertainty.at(corrected, torque, payload),
            "status": np.select(list(cases.values()), list(cases), "near singular"),
        }

    def _load(self, N: int, torque: Array | None, payload: Array | None) -> Array:
        """Return what the joints of the model bear, as `Arm.at` takes it, (N, l)."""
        parts = [np.empty((N, 0))]
        if torque is not None:
            parts.append(torque @ np.linalg.inv(self.robot.joint_map))
        if self.loads.payload:
            mass = self.robot.gravity.payload if payload is None else payload
            parts.append(np.broadcast_to(mass, N)[:, None])
        return np.hstack(parts)

    def _commands(self, poses: Array, q: Array | None, load: Array) -> Array:
        """Return joint values (N, dof) of the controller's robot for poses: near q, or near a known configuration."""
        starts = self._starts(poses, load.shape[1]) if q is None else q[:, None]
        best, left, _ = self._nearest(poses, load, starts[:, 0])
        for k in range(1, starts.shape[1]):
            again = np.flatnonzero(np.linalg.norm(left, axis=1) > REACHED)
            if not len(again):
                break
            other, error, _ = self._nearest(poses[again], load[again], starts[again, k])
            better = np.linalg.norm(error, axis=1) < np.linalg.norm(left[again], axis=1)
            best[again[better]] = other[better]
            left[again[better]] = error[better]
        if poses.shape[1] == 3 or self.robot.dof >= 6:
            return best
        return self._nearest(poses, load, best, attainable(self.nominal.at(best, load, poses)[2]))[0]

    def _nearest(
        self, poses: Array, load: Array, start: Array, W: Array | None = None
    ) -> tuple[Array, Array, np.ndarray]:
        low, high = self.robot.limits.T
        return nearest(self.nominal, load, poses, start, low, high, np.ones(self.robot.dof), W)

    def _starts(self, poses: Array, loads: int) -> Array:
        """Return the nearest of many configurations within limits, or a turn, for every pose, (N, TRIALS, dof)."""
        low, high = self.robot.limits.T
        low = np.where(np.isfinite(low), low, np.minimum(high, np.pi) - 2 * np.pi)
        high = np.where(np.isfinite(high), high, low + 2 * np.pi)
        bank = random_candidates(replace(self.robot, limits=np.column_stack([low, high])), BANK)
        reached = self.nominal.at(bank, np.zeros((BANK, loads)), np.zeros((BANK, poses.shape[1])))[0]
        distance = scipy.spatial.distance.cdist(poses[:, :3], reached[:, :3], "sqeuclidean")
        if poses.shape[1] == 7:
            distance += 8 * (1 - np.abs(poses[:, 3:] @ reached[:, 3:].T))  # the angle's square, nearly
        closest = np.argpartition(distance, TRIALS, axis=1)[:, :TRIALS]
        order = np.argsort(np.take_along_axis(distance, closest, axis=1), axis=1)
        return bank[np.take_along_axis(closest, order, axis=1)]

    def _norms(self, error: Array) -> tuple[Array, Array]:
        """Return the norms of position and orientation errors; NaN where there is no orientation."""
        lengths = np.array([dimension == "length" for dimension in self.kind.components.values()])
        angle = np.full(len(error), np.nan) if lengths.all() else np.linalg.norm(error[:, ~lengths], axis=1)
        return np.linalg.norm(error[:, lengths], axis=1), angle

    def _reached(self, error: Array, W: Array) -> np.ndarray:
        distance, angle = self._norms(times(W, error))
        return (distance <= REACHED) & ~(angle > REACHED)


def _base(values: Mapping[str, float]) -> Array:
    return numeric_frame([values[f"base_{c}"] for c in FRAME])
