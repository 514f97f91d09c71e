"""Inverse kinematics from random configurations: a tool at stated points, or whatever else is to vanish there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.models import revisit
from rpim_opt.problem.design import random_candidates
from rpim_opt.problem.loads import bearing
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.mdh import Robot

DRAWS = 200
"""Random configurations that are tried for each row."""
FIRST, FAR = 10, 1e-3
"""After so many draws a row is out of reach from which the nearest configuration is further [m]."""
STEPS = 40
"""Newton steps from each: some dozen long ones until the target is near, then a few to rounding."""
LONGEST = 0.1
"""Largest step, in ranges of the joints: close starts stay close on their way."""
DIFFERENCE = 1e-4
"""Step of the central differences, in ranges: their rounding is 1e-12, and Newton's method forgives their bend."""
DAMPING = 1e-9
"""Square of the slopes [m^2] at which a step is half as long: a stretched arm does not leap."""
THERE = 1e-11
"""Largest distance [m] of a configuration from its target; one more step then leaves rounding alone."""


def postures_at(
    problem: CalibrationProblem,
    points: Array,
    seed: int | np.random.Generator = 0,
    x: Array | None = None,
    share: float = 1.0,
    marker: str | None = None,
) -> Array:
    """Return joint values (N, dof) [rad or m] at which the tool is at N points.

    From random configurations by Newton's steps (`Target`), all the way within the joints' limits.

    Parameters
    ----------
    problem
        Gives robot, tools and what its joints bear; its measurements do not matter.
    points
        (N, 3) in the robot's base frame [m].
    seed
        Of the random postures, or a generator to draw from.
    x
        (n,) deviations of the identified parameters [SI]; nominal by default.
    share
        Which part of every joint's range is used, from 0 to 1.
    marker
        The tool, where there are several; that of the data's first row by default.

    Raises
    ------
    InputError
        For a joint without limits, and a point that none of `DRAWS` random postures leads to.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> q = ro.problem.postures_at(problem, np.tile([0.4, 0.1, 0.2], (3, 1)))
    >>> touching = problem.on(ro.data.touches(q, ["A"] * 3, sigma=1e-4))
    >>> bool(touching.errors(np.zeros(len(problem.parameters.free))).max() < 1e-10)  # the same point
    True
    """
    points = np.atleast_2d(np.asarray(points, dtype=float))
    if x is None:
        x = np.zeros(len(problem.parameters.free))
    if marker is None:
        marker = problem.data.blocks[0].markers[0]

    def away(q: Array, rows: np.ndarray) -> Array:
        data = Dataset.of(q, np.empty((len(q), 0)), 1.0, measurement=revisit)
        data = bearing(data, problem.data, None)
        block = replace(data.blocks[0], markers=(marker,))
        return problem.on(Dataset((block,), data.label, data.configuration)).modelled(x)[0] - points[rows]

    middle = problem.robot.limits.mean(axis=1)
    half = share * np.ptp(problem.robot.limits, axis=1) / 2
    target = Target(problem.robot, away, np.column_stack([middle - half, middle + half]))
    q, beyond = target.reached(len(points), np.random.default_rng(seed), share)
    if beyond is not None:
        point = ", ".join(f"{1e3 * v:g}" for v in points[beyond])
        raise InputError("the point", f"({point}) mm, out of reach", "one that the tool can be at")
    return q


class Target(NamedTuple):
    """What is to vanish at joint values: Newton's steps of least norm, in units u of the joints' ranges, lead there.

    ::

        u <- u - G' (G G' + d)^-1 e,    G = de / du

    ``away`` maps joint values (M, dof) and the numbers (M,) of their rows to e (M, k) [m]; no step leaves ``within``
    (dof, 2), by default the ends alone keep the joints' limits; d is ``damping`` [m^2].
    """

    robot: Robot
    away: Callable[[Array, np.ndarray], Array]
    within: Array | None = None
    damping: float = DAMPING

    def reached(self, count: int, rng: np.random.Generator, share: float) -> tuple[Array, int | None]:
        """Return joint values (N, dof) [rad or m] of so many rows, and the row that is out of reach, if there is one.

        A configuration that does not get there is drawn again, from a share of the ranges. Rows do not depend on each
        other. What processors differ by in rounding grows 2 times on the way in the median and 100 times at worst, to
        a thousandth of what a table prints.
        """
        q = np.empty((count, self.robot.dof))
        missing = np.ones(count, dtype=bool)
        nearest = np.full(count, np.inf)
        for draw in range(DRAWS):
            rows = np.flatnonzero(missing)
            # drawn for all rows, also those that are there: a row's draws do not depend on another row's luck
            q[rows] = random_candidates(self.robot, count, rng, share)[rows]
            q[rows], missing[rows] = self._led(q[rows], rows)
            nearest[rows] = np.minimum(nearest[rows], np.linalg.norm(self.away(q[rows], rows), axis=1))
            if not missing.any():
                return q, None
            if draw >= FIRST and (nearest > FAR).any():
                break
        return q, int(np.argmax(nearest * missing))

    def _led(self, q: Array, rows: np.ndarray) -> tuple[Array, np.ndarray]:
        """Return joint values led from q (M, dof), and which of them (M,) are not there or beyond the limits."""
        low, high = np.array([[-np.inf], [np.inf]]) if self.within is None else self.within.T
        there = np.zeros(len(q), dtype=bool)
        for _ in range(STEPS):
            way = np.flatnonzero(~there)
            q[way] = np.clip(q[way] + self._step(q[way], rows[way]), low, high)
            there[way] = np.linalg.norm(self.away(q[way], rows[way]), axis=1) < THERE
            if there.all():
                break
        # a last step for all: rounding is then all that is left, the same on every processor
        q = q + self._step(q, rows)
        low, high = (self.robot.limits if self.within is None else self.within).T
        return q, ~there | np.any((q < low) | (q > high), axis=1)

    def _step(self, q: Array, rows: np.ndarray) -> Array:
        """Return every row's step (M, dof), no longer than `LONGEST` ranges."""
        M, dof = q.shape
        span = np.ptp(self.robot.limits, axis=1)
        shifts = np.diag(DIFFERENCE * span)
        near = np.concatenate([q[None], q + shifts[:, None], q - shifts[:, None]])
        e = self.away(near.reshape(-1, dof), np.tile(rows, 2 * dof + 1)).reshape(2 * dof + 1, M, -1)
        G = np.moveaxis(e[1 : dof + 1] - e[dof + 1 :], 0, 2) / (2 * DIFFERENCE)
        damped = np.tile(np.sqrt(self.damping) * np.eye(e.shape[2]), (M, 1, 1))
        # [G'; sqrt(d) I] = Q R leaves more digits than G G' + d where an arm is nearly stretched
        Q, R = np.linalg.qr(np.concatenate([G.transpose(0, 2, 1), damped], axis=1))
        step = -(Q[:, :dof] @ np.linalg.solve(R.transpose(0, 2, 1), e[0][:, :, None]))[:, :, 0]
        length = np.linalg.norm(step, axis=1)
        return step * np.minimum(1.0, LONGEST / np.maximum(length, LONGEST))[:, None] * span


def touched_place(problem: CalibrationProblem, stated: str | None = None) -> Array:
    """Return a point (3,) [m] in the robot's base frame: as stated, ``"400,0,200"`` [mm], or the middle of the data's.

    Raises
    ------
    InputError
        For a text that is not three numbers, and data that touch nothing.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> from rpim_opt.problem.postures import touched_place
    >>> touched_place(ro.load("contact").problem, "400,0,200")
    array([0.4, 0. , 0.2])
    """
    if stated is not None:
        try:
            numbers = [float(part) for part in stated.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) != 3 or not np.isfinite(numbers).all():
            raise InputError("--point", f"'{stated}'", "x,y,z [mm] in the robot's base frame")
        return np.array(numbers) / 1e3
    centres = [thing.centre for thing in problem.touched]
    if not centres:
        raise InputError("the data", "no touch of a point", 'rows of measurement = "revisit"')
    middle = np.mean(centres, axis=0)
    # one of them: their middle may be where no tool reaches
    return min(centres, key=lambda centre: float(np.sum((centre - middle) ** 2)))
