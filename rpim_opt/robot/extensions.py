"""Model extensions: torques of gravity, and a robot's non-geometric parameters with their scales."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.robot.kinematics import call_rows, table_symbols, transforms
from rpim_opt.robot.mdh import MDH, STANDARD, Gravity, Robot
from rpim_opt.robot.terms import JOINT_TERMS, MOMENT_SCALE, Configuration, Symbol, Weight

GUESS = ((5.0, None), (10.0, 4))
"""Assumed point masses [kg] and the numbers of the frames at whose origins they are (None: the last frame)."""
AXES = "xyz"
EXPECTED = 1e-4  # prior scale of an extension's deflection [rad] at the configuration where it is largest
DRAWS = 300
SAME = 1e-2
"""Relative difference below which two columns are redundant: far above rounding and tilts of some milliradians."""


@dataclass(eq=False, kw_only=True)
class Statics(Weight):
    """Gravity on an arm of nominal geometry in one configuration; quantities are computed at first use."""

    joint_types: Sequence[str]
    q: Sequence[Symbol]  # joint values of the model
    nominal: Callable[[str], Symbol]  # number of the table by name, nominal("alpha2")
    gravity: Gravity

    @property
    def direction(self) -> ca.DM:
        """Where gravity points in the robot's base, a unit vector (3, 1)."""
        return ca.DM(self.gravity.direction)

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
        def value(name: str) -> Symbol:
            return self.nominal(name) if name.rstrip("0123456789") in MDH else 0.0

        return transforms(self.joint_types, Configuration(self.q), value)

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
        masses = []
        for k, centre, mass in [*links, (dof, gravity.payload_centre, self.payload)]:
            T = self._frames[k - 1]
            masses.append((k, T[:3, 3] + T[:3, :3] @ ca.DM(centre), mass))
        return masses


@lru_cache(maxsize=64)
def _function(joint_types: tuple[str, ...], gravity: Gravity) -> ca.Function:
    """Build torques and slopes from the table, row by row, and from joint values."""
    dof = len(joint_types)
    table, value = table_symbols(dof)
    q = ca.SX.sym("q", dof)
    nominal = value.__getitem__
    statics = Statics(gravity.payload, joint_types=joint_types, q=ca.vertsplit(q), nominal=nominal, gravity=gravity)
    joints = range(1, dof + 1)
    torques = ca.vertcat(*(statics.torque(i) for i in joints))
    slopes = ca.vertcat(*(statics.moment(i, k, axis) for i in joints for k in joints for axis in AXES))
    return ca.Function("statics", [table, q], [ca.densify(torques), ca.densify(slopes)])


def _evaluated(robot: Robot, q: Array) -> list[Array]:
    rows = np.atleast_2d(np.asarray(q, dtype=float)) @ robot.joint_map.T
    return call_rows(_function(robot.joint_types, robot.gravity), [robot.mdh.ravel()], rows)


def gravity_torques(robot: Robot, q: Array) -> Array:
    """Return the torques of gravity about the joints of the nominal arm.

    ::

        tau_i = z_i . sum over masses that joint i carries of m (p - o_i) x g

    This is minus the derivative of the potential energy: positive where gravity turns the joint in its positive sense.

    ``q`` (N, dof) are the controller's joint values [rad or m]; the payload is that of the robot's `Gravity`. The
    result is (N, dof) [Nm], about the axes of the table; zero for prismatic joints.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> mdh = np.array([[np.pi / 2, 0, 0, 0, 0], [0, 0.4, 0, 0, 0]])  # both axes are horizontal
    >>> gravity = ro.robot.Gravity(masses=(0, 1), centres=((0, 0, 0), (0.2, 0, 0)))
    >>> arm = ro.robot.Robot("two links", mdh, gravity=gravity)
    >>> ro.robot.gravity_torques(arm, np.array([[0.0, 0.0]])).round(3)  # 1 kg at 0.6 m, and at 0.2 m
    array([[-5.884, -1.961]])
    """
    return _evaluated(robot, q)[0].reshape(-1, len(robot.mdh))


def moment_slopes(robot: Robot, q: Array) -> Array:
    """Return derivatives of joint torques by first moments of links (N, dof, dof, 3), by joint i, link k and axis a.

    z_i . (R_k e_a x g_hat) of the nominal arm at q (N, dof) of the controller; zero for k < i and for prismatic joints.
    A joint's deflection is the sum of these times the parameters ``moment{i}_{k}{a}`` [rad].
    """
    return _evaluated(robot, q)[1].reshape(-1, len(robot.mdh), len(robot.mdh), 3)


# Parameters beyond the table


def _draws(robot: Robot) -> Array:
    """Return random joint values (DRAWS, dof): (-pi, pi), prismatic joints within limits or a metre."""
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (DRAWS, robot.dof))
    for j, dimension in enumerate(robot.joint_dimensions):
        if dimension == "length":
            low, high = np.where(np.isfinite(robot.limits[j]), robot.limits[j], (0.0, 1.0))
            q[:, j] = low + (high - low) * (q[:, j] + np.pi) / (2 * np.pi)
    return q


@lru_cache(maxsize=64)
def moment_names(robot: Robot) -> tuple[str, ...]:
    """Return the non-redundant parameters ``moment{i}_{k}{a}`` of a robot.

    Two parameters of a joint are redundant if their slopes (`moment_slopes`) over random joint values differ only by a
    factor and a constant; one of them is returned, none for a constant slope. With joint offsets they represent all
    deflections that the masses of links can cause in an arm of revolute joints.
    """
    n = len(robot.mdh)
    slopes = moment_slopes(robot, _draws(robot))
    names = []
    for i in range(n):
        known: list[Array] = []
        for k, a in np.ndindex(n, len(AXES)):
            v = slopes[:, i, k, a] - slopes[:, i, k, a].mean()
            size = float(np.linalg.norm(v))
            # slopes are of size 1: SAME is a share of that
            if size < SAME * np.sqrt(DRAWS):
                continue
            v = v / size
            if all(min(np.linalg.norm(v - u), np.linalg.norm(v + u)) >= SAME for u in known):
                known.append(v)
                names.append(f"moment{i + 1}_{k + 1}{AXES[a]}")
    return tuple(names)


def model_extensions(robot: Robot) -> dict[str, tuple[str, ...]]:
    """Return the parameters of all model extensions of a robot, by effect.

    A compliance is listed for every joint whose gravity torque changes with the configuration.

    >>> import rpim_opt as ro
    >>> found = ro.robot.model_extensions(ro.load("paper_arm").problem.robot)
    >>> found["gravity"]
    ('compliance2', 'compliance3', 'compliance4', 'compliance5')
    >>> {name: len(names) for name, names in found.items()}
    {'gravity': 4, 'first harmonic': 12, 'second harmonic': 12, 'moments': 30}
    """
    spread = np.ptp(gravity_torques(robot, _draws(robot)), axis=0)
    bending = [i for i, each in enumerate(spread, start=1) if each > SAME * spread.max()]
    revolute = [i for i, kind in enumerate(robot.joint_types, start=1) if kind == "revolute"]
    return {
        "gravity": tuple(f"compliance{i}" for i in bending),
        "first harmonic": tuple(f"ecc_{wave}{i}" for i in revolute for wave in ("cos", "sin")),
        "second harmonic": tuple(f"ecc2_{wave}{i}" for i in revolute for wave in ("cos", "sin")),
        "moments": moment_names(robot),
    }


def extension_scales(robot: Robot, names: Iterable[str]) -> Array:
    """Return the prior scales (n,) [SI] of model extensions: a deflection of 0.1 mrad where it is largest.

    The largest over random joint values, not measured ones: the prior does not depend on the data. An extension without
    any deflection, such as the compliance of a vertical axis, has the default scale of its kind.
    """
    q = _draws(robot)
    torques = np.abs(gravity_torques(robot, q)).max(axis=0)
    slopes = np.abs(moment_slopes(robot, q)).max(axis=0)
    n = len(robot.mdh)
    largest = {f"ratio{i}": np.pi for i in range(1, n + 1)}
    largest |= {f"compliance{i}": torque for i, torque in enumerate(torques, start=1)}
    largest |= {f"moment{i + 1}_{k + 1}{AXES[a]}": slopes[i, k, a] for i, k, a in np.ndindex(n, n, 3)}
    usual = {term.name: term.entries[0].scale for term in JOINT_TERMS} | {"moment": MOMENT_SCALE}
    scales = []
    for name in names:
        kind = re.fullmatch(r"(\w+?)\d+(_\d+[xyz])?", name)
        if kind is None or kind[1] not in usual:
            raise InputError("term of a joint", f"'{name}'", ", ".join(usual))
        size = largest.get(name, 1.0)
        scales.append(EXPECTED / size if size > 1e-9 else usual[kind[1]])
    return np.array(scales)
