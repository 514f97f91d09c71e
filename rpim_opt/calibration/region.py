"""Bounds on how far the reached positions of a region lie from the predicted ones, and where they are largest."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import fdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.calibration.outcome import Outcome
from rpim_opt.calibration.uncertainty import Uncertainty
from rpim_opt.data.record import Requirement
from rpim_opt.problem.design import random_candidates
from rpim_opt.problem.linear import Machine, identified_of, require_robot
from rpim_opt.problem.workspace import in_base, markers

DRAWN, ROUNDS = 4096, 16
"""Configurations that are drawn at once, and how often at most."""
ENOUGH = 2048
"""How many represent a region."""
WORST, BESIDE = 16, 16
"""The search for the largest bound goes on from so many, at so many beside each."""
STEPS = (0.1, 0.05, 0.025, 0.0125)
"""How far beside, in parts of the joint ranges."""
LEAST = 1e-9
"""Width of the range of a joint that never moved [rad or m]."""


@dataclass(frozen=True, eq=False)
class Region:
    """A machine whose joint limits are those of the region, a box (3, 2) [m] in its base frame, and the reflector."""

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
        spare = slack * (high - low)
        found = ((q >= low - spare) & (q <= high + spare)).all(axis=1)
        if self.box is not None and found.any():
            at = in_base(self.machine, q[found], self.marker)
            found[found] = ((at >= self.box[:, 0]) & (at <= self.box[:, 1])).all(axis=1)
        return found

    def drawn(self) -> Array:
        """Return configurations (N, dof) that represent the region; InputError where none reaches into the box."""
        kept: list[Array] = []
        for seed in range(ROUNDS):
            q = random_candidates(require_robot(self.machine), DRAWN, seed)
            kept.append(q[self.inside(q)])
            if sum(map(len, kept)) >= ENOUGH:
                break
        found = np.concatenate(kept)[:ENOUGH]
        if not len(found):
            raise InputError("the box", "no configuration of the joint ranges that reaches into it", "one within reach")
        return found

    def largest(self, q: Array, value: Array, figure: Callable[[Array], Array]) -> Array:
        """Return where a figure, (N,) of configurations q (N, dof), is largest (dof,): a search from the worst."""
        rng = np.random.default_rng(0)
        span = np.ptp(self.limits, axis=1)
        for step in STEPS:
            beside = q[np.argsort(-value)[:WORST]].repeat(BESIDE, axis=0)
            beside = beside + step * span * rng.normal(size=beside.shape)
            beside = np.clip(beside, *self.limits.T)
            beside = beside[self.inside(beside)]
            if len(beside):
                q = np.concatenate([q, beside])
                value = np.concatenate([value, figure(beside)])
        return q[np.argmax(value)]


def region_of(result: Outcome, requirement: Requirement) -> Region:
    """Return the region of a requirement; refuse several robots, and joints and reflectors that the robot has not."""
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
    known = markers(machine)
    marker = requirement.marker or known[0]
    if marker not in known:
        raise InputError("acceptance", f"reflector '{marker}'", ", ".join(known))
    return Region(machine, None if requirement.box is None else np.array(requirement.box), marker)


class Reaching(NamedTuple):
    """Predicted positions (N, 3) [m], and bounds (N,) [m] on how far off the robot reaches them."""

    position: Array
    bound: Array


def reaching(result: Outcome, region: Region, q: Array, confidence: float) -> Reaching:
    """Return where the robot will be at configurations (N, dof), and how far off with some confidence."""
    found = Uncertainty(result, confidence).predict(q, region.marker, of="reached")
    return Reaching(found.position, distance_quantile(found.covariance, result.freedom, confidence))


def distance_quantile(covariance: Array, freedom: float, probability: float) -> Array:
    """Return quantiles (N,) of the length of Student's vectors with covariances (N, k, k) at scale 1.

    Of a normal vector with covariance S the squared length is nearly g chi^2 with h degrees of freedom (Satterthwaite),
    ``g = tr S^2 / tr S``, ``h = (tr S)^2 / tr S^2``; a scale known to nu degrees of freedom makes it Fisher's F::

        quantile^2 = tr S F(h, nu; probability)

    That is exact where S has equal eigenvalues, or one alone, and within some per cent elsewhere; infinite where a
    variance is.
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
