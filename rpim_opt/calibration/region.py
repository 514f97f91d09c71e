"""Bounds on how far the reached positions of a region lie from the predicted ones, and where they are largest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import fdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.bayes.hyperparameters import Size
from rpim_opt.calibration.outcome import Outcome
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import Uncertainty
from rpim_opt.calibration.words import VAGUE
from rpim_opt.data.record import Requirement
from rpim_opt.problem.design import random_candidates
from rpim_opt.problem.identified import Machine, identified_of, require_robot
from rpim_opt.problem.workspace import in_base, markers

DRAWN, ROUNDS = 4096, 16
"""Configurations that are drawn at once, and how often at most."""
ALL = 2048
"""How many stand for a region."""
WORST, NEAR = 16, 16
"""The search for the largest goes on from so many, at so many beside each."""
LEAST = 1e-9
"""Width of the range of a joint that never moved [rad or m]."""
STEPS = (0.1, 0.05, 0.025, 0.0125)
"""How far beside, in parts of the joint ranges."""


@dataclass(frozen=True, eq=False)
class Region:
    """Where a requirement has to be kept.

    Parameters
    ----------
    machine
        The robot, whose limits are those of the region.
    box
        Sides (3, 2) [m] in the base frame, or None.
    marker
        The reflector.
    """

    machine: Machine
    box: Array | None
    marker: str

    @property
    def limits(self) -> Array:
        """Least and largest value (dof, 2) of every joint [rad or m]."""
        return require_robot(self.machine).limits

    def inside(self, q: Array, slack: float = 0.0) -> np.ndarray:
        """Return which configurations (N, dof) are in the region, (N,), or beyond it by so many parts of its ranges."""
        low, high = self.limits.T
        room = slack * (high - low)
        low = low - room
        high = high + room
        found = ((q >= low) & (q <= high)).all(axis=1)
        if self.box is None or not found.any():
            return found
        at = in_base(self.machine, q[found], self.marker)
        found[found] = ((at >= self.box[:, 0]) & (at <= self.box[:, 1])).all(axis=1)
        return found

    def drawn(self) -> Array:
        """Return configurations (N, dof) that stand for the region.

        Raises
        ------
        InputError
            Where none of them reaches into the box.
        """
        kept: list[Array] = []
        for seed in range(ROUNDS):
            q = random_candidates(require_robot(self.machine), DRAWN, seed)
            kept.append(q[self.inside(q)])
            if sum(map(len, kept)) >= ALL:
                break
        found = np.concatenate(kept)[:ALL]
        if not len(found):
            raise InputError("the box", "no configuration of the joint ranges that reaches into it", "one within reach")
        return found

    def largest(self, q: Array, value: Array, figure: Callable[[Array], Array]) -> Array:
        """Return where a figure of configurations is largest, (dof,): a search from the worst of those drawn.

        Parameters
        ----------
        q, value
            (N, dof) configurations of the region, and the figure (N,) there.
        figure
            Returns (N,) of (N, dof).
        """
        rng = np.random.default_rng(0)
        span = np.ptp(self.limits, axis=1)
        for step in STEPS:
            worst = q[np.argsort(-value)[:WORST]]
            beside = worst.repeat(NEAR, axis=0)
            beside = beside + step * span * rng.normal(size=beside.shape)
            beside = np.clip(beside, *self.limits.T)
            beside = beside[self.inside(beside)]
            if len(beside):
                q = np.concatenate([q, beside])
                value = np.concatenate([value, figure(beside)])
        return q[np.argmax(value)]


def region_of(result: Outcome, requirement: Requirement) -> Region:
    """Return the region of a requirement, for a calibration of one robot.

    Raises
    ------
    InputError
        For several robots, joints that the robot has not, reflectors that were not measured.
    """
    problem = result.problem
    if len(problem.arms) > 1 or "" not in problem.arms:
        raise InputError("acceptance", "several robots in one calibration", "a calibration of one robot")
    low, high = result.ranges[""]
    limits = np.column_stack([low, np.maximum(high, low + LEAST)])
    for joint, side in requirement.joints:
        if not 1 <= joint <= len(limits):
            raise InputError("acceptance", f"joint {joint}", f"1 to {len(limits)}")
        limits[joint - 1] = side
    sample = problem.sample()
    machine = identified_of(replace(problem.robot, limits=limits), sample.parameters, sample.data).machine
    if machine is None:
        raise InputError("acceptance", "no robot", "a calibration of one robot")
    box = None
    if requirement.box is not None:
        box = np.array(requirement.box)
    return Region(machine, box, _marker(machine, requirement.marker))


def _marker(machine: Machine, asked: str) -> str:
    known = markers(machine)
    if not asked:
        return known[0]
    if asked not in known:
        raise InputError("acceptance", f"reflector '{asked}'", ", ".join(known))
    return asked


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
    >>> from rpim_opt.calibration.region import distance_quantile
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
