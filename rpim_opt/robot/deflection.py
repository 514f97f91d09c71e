"""What gravity does to the joints of a robot: torques, and what first moments of links mean."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.robot.evaluation import call_rows
from rpim_opt.robot.gravity import STANDARD, Gravity
from rpim_opt.robot.kinematics import transforms
from rpim_opt.robot.mdh import MDH, Robot
from rpim_opt.robot.posture import Posture, Symbol

GUESS = ((5.0, None), (10.0, 4))
"""Masses [kg] at the origin of a frame, None for the last: what an arm is taken for that states none."""
AXES = "xyz"


class Statics:
    """What gravity does to an arm of nominal geometry in one configuration; nothing is made before it is asked for.

    Parameters
    ----------
    joint_types
        Of the arm.
    q
        Joint values of the model [rad or m].
    nominal
        Gives the numbers of the table, ``nominal("alpha2")``.
    gravity
        Where it points and what it pulls at.
    payload
        Mass of the payload [kg] instead of that of ``gravity``.
    """

    def __init__(
        self,
        joint_types: Sequence[str],
        q: Sequence[Symbol],
        nominal: Callable[[str], Symbol],
        gravity: Gravity,
        payload: Symbol | None = None,
    ) -> None:
        self.joint_types = joint_types
        self.q = q
        self.nominal = nominal
        self.gravity = gravity
        self.payload = gravity.payload if payload is None else payload
        self.direction = ca.DM(gravity.direction)

    def torque(self, i: int) -> Symbol:
        """Return z_i . sum over masses beyond joint i of m g (p - o_i) x g_hat [Nm]; zero about a prismatic joint."""
        if self.joint_types[i - 1] == "prismatic":
            return 0.0
        origin = self._frames[i - 1][:3, 3]
        pull = sum((mass * (place - origin) for k, place, mass in self._masses if k >= i), ca.SX(3, 1))
        return STANDARD * ca.dot(self._axis(i), ca.cross(pull, self.direction))

    def moment(self, i: int, k: int, axis: str) -> Symbol:
        """Return z_i . (R_k e_a x g_hat) for k >= i, of a revolute joint; zero elsewhere."""
        if k < i or self.joint_types[i - 1] == "prismatic":
            return 0.0
        along = self._frames[k - 1][:3, AXES.index(axis)]
        return ca.dot(self._axis(i), ca.cross(along, self.direction))

    def down(self, k: int) -> Symbol:
        """Return R_k' g_hat (3, 1)."""
        return self._frames[k - 1][:3, :3].T @ self.direction

    @cached_property
    def _frames(self) -> list[ca.SX]:
        """The transforms after every joint, as the table alone has them."""
        return transforms(self.joint_types, Posture(self.q), self._of_table)

    def _of_table(self, name: str) -> Symbol:
        if name.rstrip("0123456789") in MDH:
            return self.nominal(name)
        return 0.0

    def _axis(self, i: int) -> ca.SX:
        """Return the unit vector about which joint i turns: z before the link's Rot(y, beta)."""
        beta = self.nominal(f"beta{i}")
        return self._frames[i - 1][:3, :3] @ ca.vertcat(-ca.sin(beta), 0, ca.cos(beta))

    @cached_property
    def _masses(self) -> list[tuple[int, ca.SX, Symbol]]:
        """The number of the frame that carries each mass, its place in the base [m], and the mass [kg]."""
        dof = len(self.joint_types)
        gravity = self.gravity
        if gravity.masses:
            links = list(zip(range(1, dof + 1), gravity.centres, gravity.masses, strict=True))
        else:
            links = [(min(k or dof, dof), (0.0, 0.0, 0.0), mass) for mass, k in GUESS]
        carried = [*links, (dof, gravity.payload_centre, self.payload)]
        return [(k, self._place(k, centre), mass) for k, centre, mass in carried]

    def _place(self, k: int, centre: Sequence[float]) -> ca.SX:
        T = self._frames[k - 1]
        return T[:3, 3] + T[:3, :3] @ ca.DM(centre)


@lru_cache(maxsize=64)
def _function(joint_types: tuple[str, ...], gravity: Gravity) -> ca.Function:
    """Build torques and slopes from the table, row by row, and from a row of joint values and payload."""
    dof = len(joint_types)
    table = ca.SX.sym("mdh", dof * len(MDH))
    q = ca.SX.sym("q", dof)
    payload = ca.SX.sym("payload")
    names = [f"{column}{i}" for i in range(1, dof + 1) for column in MDH]
    value = dict(zip(names, ca.vertsplit(table), strict=True))
    statics = Statics(joint_types, ca.vertsplit(q), value.__getitem__, gravity, payload)
    joints = range(1, dof + 1)
    torques = ca.vertcat(*(statics.torque(i) for i in joints))
    slopes = ca.vertcat(*(statics.moment(i, k, axis) for i in joints for k in joints for axis in AXES))
    return ca.Function("statics", [table, ca.vertcat(q, payload)], [ca.densify(torques), ca.densify(slopes)])


def _evaluated(robot: Robot, q: Array, payload: float | Array | None) -> list[Array]:
    q = np.atleast_2d(np.asarray(q, dtype=float)) @ robot.joint_map.T
    if payload is None:
        payload = robot.gravity.payload
    rows = np.column_stack([q, np.broadcast_to(payload, len(q))])
    return call_rows(_function(robot.joint_types, robot.gravity), [robot.mdh.ravel()], rows)


def gravity_torques(robot: Robot, q: Array, payload: float | Array | None = None) -> Array:
    """Return the torques of gravity about the joints of the nominal arm.

    ::

        tau_i = z_i . sum over masses that joint i carries of m (p - o_i) x g

    Minus the slope of the potential energy: positive where gravity turns the joint the positive way.

    Parameters
    ----------
    robot
        Its `Gravity` says where gravity points and what it pulls at.
    q
        (N, dof) joint values of the controller [rad or m].
    payload
        Mass at the flange [kg], one or (N,), instead of that of the robot's `Gravity`.

    Returns
    -------
    (N, dof) [Nm], about the axes of the table; zero for prismatic joints.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> mdh = np.array([[np.pi / 2, 0, 0, 0, 0], [0, 0.4, 0, 0, 0]])  # both axes are horizontal
    >>> gravity = ro.robot.Gravity(masses=(0, 1), centres=((0, 0, 0), (0.2, 0, 0)))
    >>> arm = ro.robot.Robot("two links", mdh, gravity=gravity)
    >>> ro.robot.gravity_torques(arm, np.array([[0.0, 0.0]])).round(3)  # 1 kg at 0.6 m, and at 0.2 m
    array([[-5.884, -1.961]])
    """
    return _evaluated(robot, q, payload)[0].reshape(-1, robot.dof)


def moment_slopes(robot: Robot, q: Array) -> Array:
    """Return what first moments of links mean to the joints: z_i . (R_k e_a x g_hat) of the nominal arm.

    A joint's deflection is the sum of these times the parameters ``bend{i}_{k}{a}`` [rad].

    Parameters
    ----------
    robot
        Its `Gravity` says where gravity points.
    q
        (N, dof) joint values of the controller [rad or m].

    Returns
    -------
    (N, dof, dof, 3) without unit, by joint i, link k and axis a; zero for k < i and for prismatic joints.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> arm = ro.robot.Robot("pendulum", np.array([[np.pi / 2, 0, 0, 0, 0]]))
    >>> ro.robot.moment_slopes(arm, np.array([[0.0]])).round(3)[0, 0, 0] + 0.0  # x is horizontal
    array([-1.,  0.,  0.])
    """
    return _evaluated(robot, q, None)[1].reshape(-1, robot.dof, robot.dof, 3)
