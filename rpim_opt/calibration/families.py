"""Families of parameters that geometry lacks, and which of them the measured configurations can tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.family import families, family_scales

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
"""The models that are compared."""


def members(problem: CalibrationProblem) -> dict[str, tuple[str, ...]]:
    """Return the parameters of every family that these data may tell and that are not identified yet."""
    p = problem.parameters
    q = problem.data.q @ problem.robot.joint_map.T
    turned = {str(i) for i, travel in enumerate(np.ptp(q, axis=0), start=1) if travel > TURNED}
    known = set(p.free.names)
    found = {}
    for family, names in families(problem.robot).items():
        left = [name for name in names if name not in known]
        if family in TURNING:
            left = [name for name in left if name.rpartition("_")[2].lstrip("cosin") in turned]
        if left:
            found[family] = tuple(left)
    return found


def identifying(problem: CalibrationProblem, names: tuple[str, ...]) -> CalibrationProblem:
    """Return the problem that identifies parameters of families, too, at the scales that their effects suggest."""
    p = problem.parameters
    index = [p.names.index(name) for name in names]
    identified = p.identified.copy()
    scale = p.scale.copy()
    identified[index] = True
    scale[index] = family_scales(problem.robot, list(names))
    return problem.with_parameters(replace(p, identified=identified, scale=scale))
