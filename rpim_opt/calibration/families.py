"""Families of parameters that geometry lacks, and which of them the measured configurations can tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.family import families, family_scales
from rpim_opt.robot.parameter_names import EXPANSION, frame_of, of_session, own_name, session_prefix

TURNED = 2.0
"""Harmonics are looked for in joints that turned further [rad]: over less they are curve fitting."""
MANY = 40
"""Configurations from which on the last of the candidates is tried."""
TURNING = ("first harmonic", "second harmonic")
"""Families of joints that turned far enough."""
CANDIDATES = (
    (),
    ("gravity",),
    ("first harmonic",),
    ("gravity", "first harmonic"),
    ("gravity", "first harmonic", "second harmonic", "moments"),
)
"""The models of the arm that are compared."""
SESSIONS = "sessions"
"""The family of what the readings of a session have in common, which is none of the arm."""
WARMTH = "temperature"
"""The family of what grows with temperature."""
CONDITIONS = (SESSIONS, WARMTH)
"""Families of how and when was measured; each is a question of its own."""


def members(problem: CalibrationProblem) -> dict[str, tuple[str, ...]]:
    """Return the parameters of every family that these data may tell and that are not identified yet."""
    found: dict[str, tuple[str, ...]] = {}
    for robot in problem.arms:
        for family, names in _of_robot(problem, robot).items():
            found[family] = tuple(dict.fromkeys((*found.get(family, ()), *names)))
    shifts = _of_sessions(problem)
    if shifts:
        found[SESSIONS] = shifts
    known = set(problem.parameters.free.names)
    grows = tuple(name for name in problem.parameters.names if own_name(name) == EXPANSION and name not in known)
    if grows and np.ptp(problem.data.temperatures) > 0:
        found[WARMTH] = grows
    return found


def _of_sessions(problem: CalibrationProblem) -> tuple[str, ...]:
    """Return the shifts of sessions that are not identified yet, if sessions differ from single configurations."""
    data = problem.data
    known = set(problem.parameters.free.names)
    prefixes = {session_prefix(name) for name in data.sessions}
    if not 2 <= len(prefixes) <= len(np.unique(data.configuration)) / 2:
        return ()
    of_data = [name for name in problem.parameters.names if frame_of(name) in prefixes]
    return tuple(name for name in of_data if name not in known)


def _of_robot(problem: CalibrationProblem, robot: str) -> dict[str, list[str]]:
    """Return the same of one of several robots."""
    p = problem.parameters
    q = problem.alone(robot).joint_values
    turned = {str(i) for i, travel in enumerate(np.ptp(q, axis=0), start=1) if travel > TURNED}
    known = set(p.free.names)
    found = {}
    for family, names in families(problem.arms[robot]).items():
        left = names
        if family in TURNING:
            left = [name for name in names if name.rpartition("_")[2].lstrip("cosin") in turned]
        called = [p.called(robot, name) for name in left]
        found[family] = [name for name in called if name not in known]
    return {family: names for family, names in found.items() if names}


def _of_arm(name: str) -> bool:
    """Return whether the arm says how large a parameter is expected; others have their scale."""
    return not of_session(name) and own_name(name) != EXPANSION


def identifying(problem: CalibrationProblem, names: tuple[str, ...]) -> CalibrationProblem:
    """Return the problem that identifies parameters of families, too, at the scales that their effects suggest."""
    p = problem.parameters
    index = [p.names.index(name) for name in names]
    identified = p.identified.copy()
    scale = p.scale.copy()
    identified[index] = True
    for name, robot in problem.arms.items():
        mine = [i for i in p.places_of(name) if i in index and _of_arm(p.names[i])]
        scale[mine] = family_scales(robot, [own_name(p.names[i]) for i in mine])
    return problem.with_parameters(replace(p, identified=identified, scale=scale))
