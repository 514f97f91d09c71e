"""Families of parameters beyond the table: which of them a robot has, and how large they are expected to be."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.robot.deflection import AXES, gravity_torques, moment_slopes
from rpim_opt.robot.gravity import Gravity
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameter_names import term_of

EXPECTED = 1e-4
"""Expected size of a family's deflection [rad] at the configuration where it is largest."""
DRAWS = 300
SAME = 1e-2
"""Columns that differ by less, relatively, say the same: far from rounding, and from tilts of some milliradians."""


def _draws(robot: Robot) -> Array:
    """Return random joint values (DRAWS, dof): (-pi, pi), prismatic joints within limits or a metre."""
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (DRAWS, robot.dof))
    for j, kind in enumerate(robot.joint_types):
        if kind == "prismatic":
            low, high = np.where(np.isfinite(robot.limits[j]), robot.limits[j], (0.0, 1.0))
            q[:, j] = low + (high - low) * (q[:, j] + np.pi) / (2 * np.pi)
    return q


@lru_cache(maxsize=64)
def _bends(mdh: bytes, joint_types: tuple[str, ...], joint_map: bytes, gravity: Gravity) -> tuple[str, ...]:
    """Return `bend_names`, once for every robot that a program meets."""
    dof = len(joint_types)
    tables = [np.frombuffer(values).reshape(dof, -1) for values in (mdh, joint_map)]
    return _bend_names(Robot("", tables[0], joint_types, tables[1], gravity=gravity))


def bend_names(robot: Robot) -> tuple[str, ...]:
    """Return the parameters ``bend{i}_{k}{a}`` that say something about a robot, each something else.

    Over random joint values, those whose slope (`moment_slopes`) is neither constant nor, but for a factor and a
    constant, that of an earlier one of the same joint. With constants they say all that masses of links can do to
    an arm of revolute joints.

    Parameters
    ----------
    robot
        The nominal robot.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> mdh = np.array([[np.pi / 2, 0, 0, 0, 0], [0, 0.4, 0, 0, 0]])  # both axes are horizontal
    >>> ro.robot.bend_names(ro.robot.Robot("two links", mdh))
    ('bend1_1x', 'bend1_1y', 'bend1_2x', 'bend1_2y', 'bend2_2x', 'bend2_2y')
    """
    return _bends(robot.mdh.tobytes(), robot.joint_types, robot.joint_map.tobytes(), robot.gravity)


def _bend_names(robot: Robot) -> tuple[str, ...]:
    slopes = moment_slopes(robot, _draws(robot))
    names = []
    for i in range(robot.dof):
        known: list[Array] = []
        for k in range(i, robot.dof):
            for a, axis in enumerate(AXES):
                v = slopes[:, i, k, a] - slopes[:, i, k, a].mean()
                size = float(np.linalg.norm(v))
                # slopes are of size 1: this is a share of that
                if size < SAME * np.sqrt(DRAWS) or any(_parallel(v / size, u) for u in known):
                    continue
                known.append(v / size)
                names.append(f"bend{i + 1}_{k + 1}{axis}")
    return tuple(names)


def _parallel(v: Array, u: Array) -> bool:
    """Return whether two unit vectors differ by less than `SAME`, but for their sign."""
    return min(float(np.linalg.norm(v - u)), float(np.linalg.norm(v + u))) < SAME


def bending_joints(robot: Robot) -> list[int]:
    """Return the joints (from 1) whose torque of gravity changes with the configuration.

    >>> import rpim_opt as ro
    >>> ro.robot.bending_joints(ro.load("paper_arm").problem.robot)  # nothing turns about a vertical axis
    [2, 3, 4, 5]
    """
    spread = np.ptp(gravity_torques(robot, _draws(robot)), axis=0)
    return [i for i, each in enumerate(spread, start=1) if each > SAME * spread.max()]


def families(robot: Robot) -> dict[str, tuple[str, ...]]:
    """Return the parameters of every family that may be added to a robot's geometry, by what they describe.

    Parameters
    ----------
    robot
        The nominal robot; compliances are those of the joints that gravity bends, `bending_joints`.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> found = ro.robot.families(ro.load("paper_arm").problem.robot)
    >>> found["gravity"]
    ('compliance2', 'compliance3', 'compliance4', 'compliance5')
    >>> {name: len(names) for name, names in found.items()}
    {'gravity': 4, 'first harmonic': 12, 'second harmonic': 12, 'moments': 30}
    """
    revolute = [i for i, kind in enumerate(robot.joint_types, start=1) if kind == "revolute"]
    waves = {name: tuple(f"{ecc}_{wave}{i}" for i in revolute for wave in ("cos", "sin")) for name, ecc in _WAVES}
    return {
        "gravity": tuple(f"compliance{i}" for i in bending_joints(robot)),
        **waves,
        "moments": bend_names(robot),
    }


_WAVES = (("first harmonic", "ecc"), ("second harmonic", "ecc2"))


def family_scales(robot: Robot, names: Iterable[str]) -> Array:
    """Return the expected sizes (n,) [SI] of parameters beyond the table: a deflection of 0.1 mrad where it is largest.

    Largest over random joint values, not over measured ones: what a family may do does not depend on the data. One
    that moves nothing, the compliance of a vertical axis for instance, has the usual size of its kind.

    Parameters
    ----------
    robot
        The nominal robot.
    names
        Of terms of joints: compliances, eccentricities, second harmonics, backlash, bends, ratios.

    Raises
    ------
    InputError
        For another parameter.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> robot = ro.load("paper_arm").problem.robot
    >>> ro.robot.family_scales(robot, ["compliance2", "ecc_cos3"])  # [rad/Nm], [rad]
    array([8.18405444e-07, 1.00000000e-04])
    """
    q = _draws(robot)
    torques = np.abs(gravity_torques(robot, q)).max(axis=0)
    slopes = np.abs(moment_slopes(robot, q)).max(axis=0)
    scales = []
    for name in names:
        term, i = term_of(name, robot.dof)
        largest = 1.0
        if term.name == "compliance":
            largest = torques[i - 1]
        if term.name == "bend":
            k, axis = name.partition("_")[2][:-1], name[-1]
            largest = slopes[i - 1, int(k) - 1, AXES.index(axis)]
        if term.name == "ratio":
            largest = np.pi
        if largest > 1e-9:
            scales.append(EXPECTED / largest)
        else:
            scales.append(term.entries[0].scale)
    return np.array(scales)
