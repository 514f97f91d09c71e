"""A robot whose parameters are all known: poses, errors and Jacobians of many rows at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.data.models import Measurement
from rpim_opt.robot.kinematics import FRAME, call_rows, frame, motion, transforms
from rpim_opt.robot.mdh import Robot


@dataclass(frozen=True, eq=False)
class Arm:
    """A robot with all its parameters known: poses, errors and Jacobians of rows.

    ``function`` maps model joint values, torques and target, side by side, to the pose, its error and J'.
    """

    function: ca.Function
    joint_map: Array

    @classmethod
    def of(
        cls, robot: Robot, values: Mapping[str, float], prefix: str, before: Array, kind: Measurement, torques: bool
    ) -> Arm:
        """Build the function, once for all rows: parameters are numbers in it, so that zeros cost nothing."""
        n = robot.dof
        q = ca.SX.sym("q", n)
        tau = ca.SX.sym("tau", n if torques else 0)
        y = ca.SX.sym("y", len(kind.columns))

        def value(name: str) -> float:
            return values.get(name, 0.0)

        joints = ca.vertsplit(q)
        torque = ca.vertsplit(tau) if torques else (0.0,) * n
        after = [ca.DM(before) @ T for T in transforms(robot.joint_types, joints, torque, value)]
        T = after[-1] @ frame([value(prefix + c) for c in FRAME])
        columns = []
        for i, (moves, joint) in enumerate(zip(robot.joint_types, after, strict=True), start=1):
            twist = _twist(moves, joint, T, value(f"beta{i}"))
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


def _twist(moves: str, joint: ca.SX, T: ca.SX, beta: float) -> ca.SX:
    """Return how point and orientation of T move with a joint (6, 1), after whose link the frame ``joint`` is."""
    axis = joint[:3, :3] @ ca.vertcat(-np.sin(beta), 0, np.cos(beta))  # z before Rot(y, beta), through the origin
    if moves == "prismatic":
        return ca.vertcat(axis, 0, 0, 0)
    return ca.vertcat(ca.cross(axis, T[:3, 3] - joint[:3, 3]), axis)
