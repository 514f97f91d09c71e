"""Compliances that cannot be: joints that seem to bend upwards."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.problem.loads import measured_torques
from rpim_opt.problem.problem import CalibrationProblem

SURE = 3.0
"""Standard deviations by which a compliance is below zero before anything is said of it."""


def bends_upwards(problem: CalibrationProblem, x: Array, standard: Array) -> list[int]:
    """Return the joints (from 1) whose compliance is significantly negative under the torques of gravity.

    Measured torques have the sign of their controller: of those nothing is said.

    Parameters
    ----------
    problem
        With data whose torques are those of gravity.
    x, standard
        (n,) deviations and their standard deviations [SI].

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> bent = problem.with_parameters(problem.parameters.identify(["compliance[23]"]))
    >>> ro.calibration.bends_upwards(bent, np.array([-4e-6, 2e-6]), np.array([1e-6, 1e-6]))  # [rad/Nm]
    [2]
    """
    if measured_torques(problem.data):
        return []
    free = problem.parameters.free
    values = free.nominal + x
    return [
        int(name.removeprefix("compliance"))
        for name, value, u in zip(free.names, values, standard, strict=True)
        if name.startswith("compliance") and np.isfinite(u) and value < -SURE * u
    ]


def said_of_bending(joints: Sequence[int]) -> str:
    """Return the sentence on joints that seem to bend upwards; nothing where there are none.

    Parameters
    ----------
    joints
        From 1, as `bends_upwards` returns them.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> ro.calibration.said_of_bending([2, 3]).partition(": ")[0]
    'joints [2, 3] seem to bend upwards, which gravity cannot do'
    """
    if not joints:
        return ""
    remedy = "check mounting, payload, and whether the controller compensates sag"
    return f"joints {list(joints)} seem to bend upwards, which gravity cannot do: {remedy}"
