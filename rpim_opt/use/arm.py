"""A robot whose parameters are all known: poses, errors and Jacobians of many rows at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.data.models import Measurement
from rpim_opt.problem.row_functions import Loads
from rpim_opt.robot.evaluation import call_rows
from rpim_opt.robot.joint_terms import motion
from rpim_opt.robot.kinematics import FRAME, chain, placed, product, transforms
from rpim_opt.robot.mdh import Robot


@dataclass(frozen=True, eq=False)
class Arm:
    """A robot with all its parameters known: poses, errors and Jacobians of rows.

    ``function`` maps model joint values, loads (`Loads`) and target, side by side, to the pose, its error and J'.
    """

    function: ca.Function
    joint_map: Array

    @classmethod
    def of(
        cls,
        robot: Robot,
        values: Mapping[str, float],
        stated: Mapping[str, float],
        prefix: str,
        before: Array,
        kind: Measurement,
        loads: Loads,
    ) -> Arm:
        """Build the function, once for all rows: parameters are numbers in it, so that zeros cost nothing.

        ``values`` are the parameters' by name, ``stated`` their nominal ones, by which gravity acts.
        """
        command = loads.symbols(robot.dof, 1)
        y = ca.SX.sym("y", len(kind.columns))

        def value(name: str) -> float:
            return values.get(name, 0.0)

        posture = loads.posture(robot.joint_types, stated.__getitem__, command)
        terms = robot.model.terms
        after = [ca.DM(before) @ T for T in transforms(robot.joint_types, posture, value, terms)]
        flange = chain(robot.joint_types, posture, value, terms)
        T = product([ca.SX(ca.DM(before)), *flange, *placed([value(prefix + c) for c in FRAME])])
        joints = list(enumerate(robot.joint_types, start=1))
        twists = [_twist(moves, after[i - 1], T, value(f"beta{i}")) for i, moves in joints]
        moved = ca.vertcat(*(motion(robot.joint_types, i, posture, value, terms) for i, moves in joints))
        # gravity bends a joint by the values of all of them
        J = (ca.horzcat(*twists) @ ca.jacobian(moved, command.q))[: len(kind.components), :]
        modelled = kind.model(T)
        outputs = [ca.densify(v) for v in (modelled, kind.minus(y, modelled), J.T)]
        return cls(ca.Function("arm", [ca.vertcat(*command, y)], outputs), robot.joint_map)

    def at(self, q: Array, load: Array, y: Array) -> tuple[Array, Array, Array]:
        """Return the pose (N, c), its error (N, k) from y, and the Jacobian (N, k, dof) of the pose."""
        modelled, error, J = call_rows(self.function, [], np.hstack([q @ self.joint_map.T, load, y]))
        return modelled[:, 0], error[:, 0], J @ self.joint_map


def _twist(moves: str, joint: ca.SX, T: ca.SX, beta: float) -> ca.SX:
    """Return how point and orientation of T move with a joint (6, 1), after whose link the frame ``joint`` is."""
    axis = joint[:3, :3] @ ca.vertcat(-np.sin(beta), 0, np.cos(beta))  # z before Rot(y, beta), through the origin
    if moves == "prismatic":
        return ca.vertcat(axis, 0, 0, 0)
    return ca.vertcat(ca.cross(axis, T[:3, 3] - joint[:3, 3]), axis)
