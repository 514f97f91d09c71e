"""Where a machine's reflector will be, and how that follows the identified parameters, to first order."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.models import position
from rpim_opt.problem.design import random_candidates
from rpim_opt.problem.identified import Machine, require_robot
from rpim_opt.problem.loads import bearing
from rpim_opt.problem.problem import CalibrationProblem

SOME = 128
"""Configurations of a box, or of all joint ranges, that are always looked at; and those of all that move farthest."""
ALL, DRAWN = 2048, 4096
"""Configurations that stand for a box, or all joint ranges; drawn at once to find those, up to 16 times."""


class Predicted(NamedTuple):
    """Positions (N, 3) [m] at nominal deviations, and slopes (N, 3, n): about x they are position + slope x [SI]."""

    position: Array
    slope: Array


def predicted(machine: Machine, q: Array, marker: str | None = None, torque: Array | None = None) -> Predicted:
    """Return where a reflector is in the instrument's frame, to first order about where the machine is looked at.

    Parameters
    ----------
    machine
        Robot and parameters.
    q
        (N, dof) joint values of the controller [rad or m].
    marker
        The reflector; the only one, or the first, by default.
    torque
        (N, dof) joint torques [Nm], where the compliance of joints is identified from measured ones.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> from rpim_opt.problem.predicting import predicted
    >>> problem = ro.load("paper_arm").problem
    >>> model = problem.linearize(np.zeros(len(problem.parameters.free)))
    >>> where = predicted(model.parameters.machine, np.zeros((2, 6)))
    >>> where.position.shape, where.slope.shape
    ((2, 3), (2, 3, 26))
    """
    here = _there(machine, q, marker, torque)
    return _about(here, _at(machine))


def moved(machine: Machine, q: Array, marker: str | None = None, torque: Array | None = None) -> Predicted:
    """Return by how much the robot's own parameters move a reflector; arguments as for `predicted`.

    Frames stay where they are: they say where things stand, not how the robot is.
    """
    here = _there(machine, q, marker, torque)
    own = ~machine.parameters.free.of_frames
    about = _about(here, _at(machine) * own)
    nominal = here.modelled(np.zeros(len(own)))[0]
    return Predicted(about.position - nominal, about.slope * own)


def _at(machine: Machine) -> Array:
    if machine.at is None:
        return np.zeros(len(machine.parameters.free))
    return machine.at


def _about(here: CalibrationProblem, x: Array) -> Predicted:
    position = here.modelled(x)[0]
    slope = here.jacobian(x).reshape(len(position), 3, -1)
    return Predicted(position - slope @ x, slope)


def _there(machine: Machine, q: Array, marker: str | None, torque: Array | None) -> CalibrationProblem:
    """Return the problem whose measurements are the positions of a reflector."""
    q = np.atleast_2d(np.asarray(q, dtype=float))
    if not np.isfinite(q).all() or q.shape[1] != require_robot(machine).dof:
        found = f"joint values of shape {q.shape}"
        raise InputError("positions", found, f"finite numbers (N, {require_robot(machine).dof}) [rad or m]")
    data = Dataset.of(q, np.zeros((len(q), 3)), 1.0, measurement=position)
    data = bearing(data, machine.data, torque)
    if marker is None:
        marker = markers(machine)[0]
    block = replace(data.blocks[0], markers=(marker,))
    problem = CalibrationProblem(require_robot(machine), machine.parameters, machine.data)
    return problem.on(replace(data, blocks=(block,)))


def markers(machine: Machine) -> list[str]:
    """Return the reflectors that were measured, in the order of the data."""
    return list(dict.fromkeys(marker for block in machine.data.blocks for marker in block.markers))


def within_ranges(machine: Machine) -> Array:
    """Return configurations (N, dof) of all joint ranges that stand for them."""
    return _standing(machine, random_candidates(require_robot(machine), ALL))


def within_box(machine: Machine, lower: Array, upper: Array) -> Array:
    """Return configurations (N, dof) whose nominal reflector is in a box of the robot's base frame, and stand for it.

    Parameters
    ----------
    machine
        Robot and parameters.
    lower, upper
        (3,) corners [m].
    """
    key = (require_robot(machine), machine.parameters.nominal.tobytes(), tuple(lower), tuple(upper))
    if key not in _FOUND:
        if len(_FOUND) >= SOME:
            _FOUND.clear()
        _FOUND[key] = _reaching(machine, lower, upper)
    return _standing(machine, _FOUND[key])


_FOUND: dict[Any, Array] = {}
"""Configurations of boxes, which are asked for at every pass; a robot is the same object all the while."""


def _standing(machine: Machine, q: Array) -> Array:
    """Return some configurations, and those of all that move farthest where the machine is looked at.

    Bounds at some alone would be kept there, and nowhere else.
    """
    if machine.farthest is None or len(q) <= 2 * SOME:
        return q[: 2 * SOME]
    own = ~machine.parameters.free.of_frames
    rest = q[SOME:]
    here = _there(machine, rest, None, None)
    movement = here.modelled(machine.farthest * own)[0] - here.modelled(np.zeros(len(own)))[0]
    farthest = np.argsort(-np.linalg.norm(movement, axis=1), kind="stable")[:SOME]
    return np.concatenate([q[:SOME], rest[farthest]])


def _reaching(machine: Machine, lower: Array, upper: Array) -> Array:
    """Draw configurations until enough reach into a box."""
    inside = [np.zeros((0, require_robot(machine).dof))]
    for seed in range(16):
        q = random_candidates(require_robot(machine), DRAWN, seed)
        at = in_base(machine, q)
        inside.append(q[((at >= lower) & (at <= upper)).all(axis=1)])
        if sum(map(len, inside)) >= ALL:
            break
    found = np.concatenate(inside)[:ALL]
    if len(found) == 0:
        raise InputError("box", "no configuration of the joint ranges that reaches into it", "a box within reach")
    return found


def in_base(machine: Machine, q: Array, marker: str | None = None) -> Array:
    """Return where the nominal reflector is in the robot's base frame, (N, 3) [m]; arguments as for `predicted`."""
    whole = machine.parameters
    nominal = whole.nominal.copy()
    nominal[[name.startswith("base_") for name in whole.names]] = 0.0
    at_base = replace(machine, parameters=replace(whole, nominal=nominal), at=None, farthest=None)
    return _there(at_base, q, marker, None).modelled(np.zeros(len(whole.free)))[0]
