"""Three intervals of a position: of the model's mean, of what the robot will reach, of what an instrument will read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import chdtrc, stdtrit

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.several import unknown_sessions
from rpim_opt.problem.source import Source

Interval = Literal["mean", "reached", "reading"]
INTERVALS: tuple[Interval, ...] = ("mean", "reached", "reading")
UNLIKELY = 0.01
"""Probability below which noise is said to be another than declared."""


class NoiseTest(NamedTuple):
    """Observed over declared standard deviation, its two-sided probability under declared noise, and a verdict."""

    ratio: float
    probability: float
    verdict: str


@dataclass(frozen=True, eq=False)
class Scattered:
    """What adds to the covariance of a row's model, block by block (N, k, k) [SI]: the robot's part, and a reading's.

    ``reading`` is the robot's and the instrument's together, and ``session`` what of it a session adds that the problem
    does not know.
    """

    robot: list[Array]
    reading: list[Array]
    session: list[Array]


def checked(of: str) -> Interval:
    """Return the name of an interval.

    Raises
    ------
    InputError
        For another name.
    """
    for known in INTERVALS:
        if of == known:
            return known
    raise InputError("of", f"'{of}'", choices(of, INTERVALS))


def scattered(problem: CalibrationProblem, level: float) -> Scattered:
    """Return what robot and instrument add to the model of some measurements.

    A problem whose robot's scatter was learned knows its parts. Of another one the robot's is what the residuals show
    beyond the declared noise, (level - 1) Sigma. A reading of a session that the problem does not know has that
    session's shift besides, where those of others were identified.

    Parameters
    ----------
    problem
        With the measurements.
    level
        The noise's variance over the declared one, at least 1.
    """
    robot = [(level - 1) * V for V in problem.covariances()]
    reading = [level * V for V in problem.covariances()]
    if problem.scatter is not None:
        robot = problem.covariances(reading=False)
        reading = problem.covariances()
    session = unknown_sessions(problem)
    return Scattered(robot, [V + more for V, more in zip(reading, session, strict=True)], session)


def position_noise(source: Source) -> Array:
    """Return the median covariance (3, 3) [m^2] of a reading of a position; zero where no position was measured."""
    for part in source.rows():
        seen = [b.covariance[:, :3, :3] for b in part.data.blocks if b.measurement.name in ("position", "pose")]
        if seen:
            return np.asarray(np.median(np.concatenate(seen), axis=0), dtype=float)
    return np.zeros((3, 3))


def coverage_factor(freedom: float, confidence: float) -> float:
    """Return the quantile k of Student's t at (1 + confidence) / 2, with at least one degree of freedom."""
    return float(coverage_factors(np.asarray(freedom), confidence))


def coverage_factors(freedom: Array, confidence: float) -> Array:
    """Return the same for degrees of freedom (N,)."""
    return np.asarray(stdtrit(np.maximum(freedom, 1.0), (1 + confidence) / 2), dtype=float)


def row_freedom(freedom: float, spread: float, whole: Array, session: Array) -> Array:
    """Return the degrees of freedom (N,) of rows' variances, at least one; less where a few sessions told a part.

    2 V^2 / var(V) of the sum V of both parts' variances (Satterthwaite).

    Parameters
    ----------
    freedom
        Of what no session adds.
    spread
        Standard deviation of the logarithm of the sessions' size.
    whole, session
        (N, k, k) covariances of a row, and what of them an unknown session adds, (N, k, k) or (1, 1, 1) zeros.
    """
    freedom = max(freedom, 1.0)
    V = np.einsum("nkk->n", whole)
    part = np.broadcast_to(np.einsum("nkk->n", session), V.shape)
    variance = 2 * (V - part) ** 2 / freedom + (2 * spread * part) ** 2
    return np.maximum(np.minimum(2 * V**2 / np.maximum(variance, 1e-300), freedom), 1.0)


def noise_test(squares: float, freedom: float, learned: bool = False) -> NoiseTest:
    """Compare the scatter of the residuals with the instrument's noise as declared, by chi^2.

    Parameters
    ----------
    squares
        Sum of the squared residuals in units of the declared noise.
    freedom
        Equations less what the fit takes.
    learned
        Whether the robot's own scatter is known beside it.

    Examples
    --------
    >>> from rpim_opt.calibration.intervals import noise_test
    >>> noise_test(104.0, 100.0).verdict
    'The data scatter as declared (1.02 times).'
    """
    if freedom < 1:
        return NoiseTest(1.0, 1.0, "No equation is left over to tell the noise: it is the declared one.")
    ratio = float(np.sqrt(squares / freedom))
    upper = float(chdtrc(freedom, squares))
    probability = 2 * min(upper, 1 - upper)
    said = f"The data scatter {ratio:.2f} times as much as declared"
    if probability >= UNLIKELY:
        return NoiseTest(ratio, probability, f"The data scatter as declared ({ratio:.2f} times).")
    if upper >= 0.5:
        remedy = ""
        if learned:
            remedy = ' (noise = "free" learns it)'
        return NoiseTest(ratio, probability, f"{said}: the noise is stated too large{remedy}.")
    cause = "noise is larger, rows are wrong, or the model lacks something (backlash, elasticity)"
    if learned:
        cause = "what the robot's own scatter stands for"
    return NoiseTest(ratio, probability, f"{said}: {cause}.")
