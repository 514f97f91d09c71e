"""What every check says beyond the calibration and the checks before it, in standard deviations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc, ndtri

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.calibration.intervals import scattered
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import known_covariance
from rpim_opt.problem.problem import CalibrationProblem

SMALLEST = 1e-12
"""Probabilities are taken as no smaller: beyond 7 standard deviations nobody asks how far."""


@dataclass(frozen=True, eq=False)
class Innovations:
    """Of N checks in the order of time.

    Parameters
    ----------
    sigmas
        (N,) |S^-1/2 e| of what a check misses its prediction by, e, with S = J C J' + the covariance of a reading, and
        C what calibration and earlier checks leave open.
    chance
        (N,) probability of so much where nothing drifts, by Fisher's F.
    deviate
        (N,) the same as a standard normal deviate, positive where a check misses more than usual.
    """

    sigmas: Array
    chance: Array
    deviate: Array


def innovations(result: Calibration, problem: CalibrationProblem, rare: float = 0.0) -> Innovations:
    """Return what checks say one after the other, each after all before it.

    What is not known of the robot bends all predictions alike. A Kalman filter takes that away as checks show it, so
    that the innovations of a robot that stays as it is are independent::

        e = r - J m,    S = J C J' + V,    K = C J' S^-1,    m + K e,    C - K J C

    Parameters
    ----------
    result
        The calibration.
    problem
        Its problem with the checks in the order of time.
    rare
        A check less probable than this is beyond what a reading may be: nothing is learned from it.

    Raises
    ------
    InputError
        For a result that has no covariance.
    """
    C = known_covariance(result)
    if C is None:
        accepted = "one with a squared penalty or none, whose predictions have intervals"
        raise InputError("monitor", f"formulation '{result.formulation.name}'", accepted)
    known = np.isfinite(np.diag(C))
    C = np.where(np.outer(known, known), C, 0.0)
    own = problem.parameters.free.scale[len(C) :]  # of sessions that the calibration does not know
    C = np.block([[C, np.zeros((len(C), len(own)))], [np.zeros((len(own), len(C))), np.diag(own**2)]])
    m = np.zeros(len(C))
    rows = _rows(result, problem, np.append(result.x, np.zeros(len(own))))
    freedom = max(result.freedom, 1.0)
    sigmas = np.zeros(len(rows))
    chance = np.ones(len(rows))
    for t in range(len(rows)):
        r, J, V = rows[t]
        S = J @ C @ J.T + V
        e = r - J @ m
        gain = np.linalg.solve(S, J @ C).T
        squares = float(e @ np.linalg.solve(S, e))
        sigmas[t] = np.sqrt(squares)
        chance[t] = fdtrc(len(r), freedom, squares / len(r))
        if chance[t] < rare:
            continue
        m = m + gain @ e
        C = C - gain @ S @ gain.T
    deviate = -np.asarray(ndtri(np.clip(chance, SMALLEST, 1 - SMALLEST)))
    return Innovations(sigmas, chance, deviate)


def _rows(result: Calibration, problem: CalibrationProblem, x: Array) -> dict[int, tuple[Array, Array, Array]]:
    """Return every row's residual (k,), slopes (k, n) and covariance (k, k) of a reading [SI]."""
    residual, J = problem.slopes(x)
    found = {}
    start = 0
    for block, V in zip(problem.data.blocks, scattered(problem, result.noise_level).reading, strict=True):
        k = len(block.measurement.components)
        for i, row in enumerate(block.row):
            part = slice(start + i * k, start + (i + 1) * k)
            found[int(row)] = residual[part], J[part], np.broadcast_to(V, (len(block.row), k, k))[i]
        start += k * len(block.row)
    return found
