"""Where robots stand to each other by the points that several of them have touched."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Block
from rpim_opt.problem.placing import register
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.kinematics import FRAME, forward_kinematics, frame_numbers, numeric_frame
from rpim_opt.robot.parameter_names import tool_prefix
from rpim_opt.robot.parameters import Parameters

APART = 0.1
"""How far nominal robots may be from each other at a point that both have touched [m], until it is another point."""
Places = Mapping[str, Array]


def met(problem: CalibrationProblem) -> dict[str, Array]:
    """Return where bases (6,) stand by robot, of nominal robots that touched points of others before them.

    The first robot that touched something stands where it is stated, as does one whose base is not identified, and one
    that an instrument has seen. Each other one is put where its touches are nearest to those of the robots so far.

    Raises
    ------
    InputError
        For a point that robots are said to have touched alike, and that is elsewhere for one of them.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> from rpim_opt.problem.meeting import met
    >>> arm = ro.load("contact").problem
    >>> p = arm.parameters
    >>> free = arm.with_parameters(p.identify([*p.free.names, "base_*"]))
    >>> both = ro.together(left=arm, right=free, shared=["tool_*"])  # the same touches twice
    >>> bool(np.abs(met(both)["right"]).max() < 1e-9)  # so that they stand in one place
    True
    """
    known: dict[str, Array] = {}
    found = {}
    for robot, places in _touched(problem):
        base, placed = _standing(problem, robot, places, known)
        if placed:
            found[robot] = frame_numbers(base)
        for name, place in places.items():
            known.setdefault(name, _seen_from(base, place))
    return found


def _standing(problem: CalibrationProblem, robot: str, places: Places, known: Places) -> tuple[Array, bool]:
    """Return where a base (4, 4) is, and whether known places say so; refuse touches that are elsewhere."""
    p = problem.parameters.of_robot(robot)
    stated = numeric_frame(_frame(p, "base_"))
    common = {name: place for name, place in places.items() if name in known}
    if not _placed_by_touches(problem, robot, p):
        _require_near(robot, stated, common, known)
        return stated, False
    try:
        base = register(np.array(list(common.values())), np.array([known[name] for name in common]))
    except InputError:  # too few, or on a line
        return stated, False
    _require_near(robot, base, common, known)
    return base, True


def _seen_from(base: Array, place: Array) -> Array:
    return base[:3, :3] @ place + base[:3, 3]


def _touched(problem: CalibrationProblem) -> Iterator[tuple[str, Places]]:
    """Yield the nominal positions (3,) [m] of touched points by name in a robot's own frame, robot by robot."""
    for robot, arm in problem.arms.items():
        p = problem.parameters.of_robot(robot)
        all_of: dict[str, list[Array]] = {}
        for block in problem.data.blocks:
            names = _points(block)
            if block.robot == robot and len(names):
                T = forward_kinematics(arm, block.q[:, 0]) @ numeric_frame(_frame(p, tool_prefix(block.markers[0])))
                for name, position in zip(names, T[:, :3, 3], strict=True):
                    all_of.setdefault(name, []).append(position)
        if all_of:
            yield robot, {name: np.mean(positions, axis=0) for name, positions in all_of.items()}


def _points(block: Block) -> list[str]:
    """Return the points that rows touched; none where they touched planes, or nothing."""
    if block.touched is None or not block.measurement.touching or block.measurement.planar:
        return []
    return [str(name) for name in block.touched[:, 0]]


def _frame(p: Parameters, prefix: str) -> Array:
    return p.nominal[[p.names.index(prefix + component) for component in FRAME]]


def _placed_by_touches(problem: CalibrationProblem, robot: str, p: Parameters) -> bool:
    """Whether a robot's base is sought, and nothing but touches tells where it is."""
    sought = p.identified[[p.names.index(f"base_{component}") for component in FRAME]].all()
    return bool(sought) and all(block.touched is not None for block in problem.data.blocks if block.robot == robot)


def _require_near(robot: str, base: Array, places: Places, known: Places) -> None:
    """Refuse touches of one point that nominal robots put into different places."""
    for name, place in places.items():
        distance = float(np.linalg.norm(_seen_from(base, place) - known[name]))
        if distance > APART:
            found = f"touches of '{name}' that are {distance:.2g} m from those of another robot"
            accepted = f"at most {APART:g} m: state or identify its base, or give another point another name"
            raise InputError(f"together, problem '{robot}'", found, accepted)
