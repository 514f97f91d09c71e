"""Configurations that stand for a region where the robot has to keep a limit, and the largest of a figure there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.calibration.outcome import Outcome
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
