"""How far off the position that a robot reaches may be: a bound on its distance from the predicted one."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import fdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.bayes.hyperparameters import Size
from rpim_opt.calibration.learned_words import VAGUE
from rpim_opt.calibration.region import Region
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import Uncertainty


class Reaching(NamedTuple):
    """Predicted positions (N, 3) [m], and bounds (N,) [m] on how far off the robot reaches them."""

    position: Array
    bound: Array


class Share(NamedTuple):
    """What a bound at a configuration is made of [m].

    What the bound would be if all parameters were known: the robot's own scatter, as it is estimated and at the least.
    """

    scatter: float
    least_scatter: float


def distance_quantile(covariance: Array, freedom: float, probability: float) -> Array:
    """Return quantiles (N,) of the length of Student's vectors with given covariances at scale 1.

    Of a normal vector with covariance S the squared length is nearly g chi^2 with h degrees of freedom (Satterthwaite),
    ``g = tr S^2 / tr S``, ``h = (tr S)^2 / tr S^2``; a scale known to nu degrees of freedom makes it Fisher's F::

        quantile^2 = tr S F(h, nu; probability)

    That is exact where S has equal eigenvalues, or one alone, and within some per cent elsewhere.

    Parameters
    ----------
    covariance
        (N, k, k) [m^2]; infinite where a variance is.
    freedom
        Of the scale, nu.
    probability
        From 0 to 1.

    Examples
    --------
    >>> import numpy as np
    >>> from rpim_opt.calibration.reaching import distance_quantile
    >>> distance_quantile(np.eye(3)[None], 1e9, 0.95).round(3)  # chi with 3 degrees of freedom
    array([2.795])
    """
    trace = np.trace(covariance, axis1=1, axis2=2)
    known = np.isfinite(trace)
    S = covariance[known]
    found = np.full(len(covariance), np.inf)
    squares = np.einsum("nij,nji->n", S, S)
    h = trace[known] ** 2 / np.maximum(squares, np.finfo(float).tiny)
    h = np.clip(h, 1.0, covariance.shape[1])
    found[known] = np.sqrt(trace[known] * fdtri(h, max(freedom, 1.0), probability))
    return found


def reaching(result: Calibration, region: Region, q: Array, confidence: float) -> Reaching:
    """Return where the robot will be at configurations, and how far off with some confidence.

    Parameters
    ----------
    result
        The calibration, with a covariance.
    region
        Gives the reflector.
    q
        (N, dof) joint values of the controller [rad or m].
    confidence
        Of the bounds.

    Raises
    ------
    InputError
        For a formulation without covariance, and what a prediction needs besides (torques, columns).
    """
    found = Uncertainty(result, confidence).predict(q, region.marker, of="reached")
    return Reaching(found.position, distance_quantile(found.covariance, result.freedom, confidence))


def share(result: Calibration, region: Region, q: Array, confidence: float) -> Share:
    """Return what the bound at one configuration (dof,) is made of; arguments and errors as for `reaching`."""
    return Share(*(_own(each, region, q, confidence) for each in (result, _still(result))))


def _own(result: Calibration | None, region: Region, q: Array, confidence: float) -> float:
    """Return the bound at known parameters; zero where the scatter is not known apart from the noise."""
    if result is None:
        return 0.0
    mean, reached = (result.predict(q[None], region.marker, of=of).covariance for of in ("mean", "reached"))
    if not np.isfinite(mean).all():
        return 0.0
    return float(distance_quantile(reached - mean, result.freedom, confidence)[0])


def _still(result: Calibration) -> Calibration | None:
    """Return the calibration with the least scatter that the data allow; None where the noise's level stands for it."""
    scatter = result.problem.scatter
    if scatter is None:
        return None
    learned = {} if result.learned is None else result.learned.noise
    least = {kind: _least(size) for kind, size in learned.items()}
    return replace(result, problem=result.problem.scattered(replace(scatter, **least)))


def _least(size: Size) -> float:
    """Return the lower end of a scatter; zero where the data know no more than an upper one."""
    if size.spread > VAGUE:
        return 0.0
    return size.value * float(np.exp(-2 * size.spread))
