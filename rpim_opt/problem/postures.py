"""Postures in which a robot's tool is at a stated point: what touches it, from many sides."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.models import revisit
from rpim_opt.problem.design import random_candidates
from rpim_opt.problem.loads import bearing
from rpim_opt.problem.problem import CalibrationProblem

DRAWS = 200
"""Random postures that are tried for each."""
FIRST, FAR = 10, 1e-3
"""After so many a point is out of reach from which the nearest posture is further [m]."""
STEPS = 40
"""Steps from each of them."""
LONGEST = 0.1
"""Largest step, in ranges of the joints: close starts stay close on their way."""
DIFFERENCE = 1e-4
"""Step of the slopes' differences, in ranges."""
DAMPING = 1e-9
"""Square of the slopes [m^2] at which a step is half as long: a stretched arm does not leap."""
THERE = 1e-11
"""Largest distance [m] of a posture from its point."""


def postures_at(
    problem: CalibrationProblem,
    points: Array,
    seed: int | np.random.Generator = 0,
    x: Array | None = None,
    share: float = 1.0,
    marker: str | None = None,
) -> Array:
    """Return joint values (N, dof) [rad or m] at which the tool is at N points.

    From a random posture, steps of least norm in units of the joints' ranges::

        u <- u - G' (G G' + d)^-1 (p - point),    G = dp / du

    and no further than the joints' limits. One that does not get there is drawn again. It is arithmetic on single
    numbers, row by row, as for `touching_poses`: the same on every processor.

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
    rng = np.random.default_rng(seed)
    reached = _Reached(problem, x, marker)
    low = problem.robot.limits.mean(axis=1) - share * np.ptp(problem.robot.limits, axis=1) / 2
    high = problem.robot.limits.mean(axis=1) + share * np.ptp(problem.robot.limits, axis=1) / 2
    postures = np.empty((len(points), problem.robot.dof))
    missing = np.ones(len(points), dtype=bool)
    nearest = np.full(len(points), np.inf)
    for draw in range(DRAWS):
        # for all rows, also those that have their posture: a row's draws do not depend on another row's luck
        q = random_candidates(problem.robot, len(points), rng, share)
        some = np.flatnonzero(missing)
        q, taken = reached.led(q[some], points[some], low, high)
        nearest[some] = np.minimum(nearest[some], np.sum((reached.at(q) - points[some]) ** 2, axis=1))
        if draw >= FIRST and (nearest > FAR**2).any():
            break
        postures[some[taken]] = q[taken]
        missing[some[taken]] = False
        if not missing.any():
            return postures
    point = ", ".join(f"{1e3 * v:g}" for v in points[int(np.argmax(nearest * missing))])
    raise InputError("the point", f"({point}) mm, out of reach", "one that the tool can be at")


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


class _Reached:
    """Where a tool is in the robot's base frame."""

    def __init__(self, problem: CalibrationProblem, x: Array, marker: str):
        self.problem = problem
        self.x = x
        self.marker = marker
        self.span = np.ptp(problem.robot.limits, axis=1)

    def at(self, q: Array) -> Array:
        """Return the positions (N, 3) [m] at joint values (N, dof)."""
        data = Dataset.of(q, np.empty((len(q), 0)), 1.0, measurement=revisit)
        data = bearing(data, self.problem.data, None)
        block = replace(data.blocks[0], markers=(self.marker,))
        there = self.problem.on(Dataset((block,), data.label, data.configuration))
        return there.modelled(self.x)[0]

    def led(self, q: Array, points: Array, low: Array, high: Array) -> tuple[Array, np.ndarray]:
        """Return postures (N, dof) led to their points from q (N, dof), and which of them are there (N,)."""
        q = q.copy()
        there = np.zeros(len(q), dtype=bool)
        for _ in range(STEPS):
            left = np.flatnonzero(~there)
            q[left] = np.clip(q[left] + self.step(q[left], points[left]), low, high)
            away = self.at(q[left]) - points[left]
            there[left] = np.sum(away**2, axis=1) < THERE**2
            if there.all():
                break
        # a last step for all: rounding is then all that is left, the same on every processor
        last = q + self.step(q, points)
        inside = np.all((last >= low) & (last <= high), axis=1)
        return np.where(inside[:, None], last, q), there & inside

    def step(self, q: Array, points: Array) -> Array:
        """Return every row's step (N, dof) towards its point, no longer than `LONGEST` ranges."""
        N, dof = q.shape
        shifts = np.diag(DIFFERENCE * self.span)
        near = np.concatenate([q[None], q + shifts[:, None], q - shifts[:, None]])
        p = self.at(near.reshape(-1, dof)).reshape(-1, N, 3)
        G = np.moveaxis(p[1 : dof + 1] - p[dof + 1 :], 0, 2) / (2 * DIFFERENCE)
        away = p[0] - points
        weighed = _solved(G, away)
        step = -np.sum(G * weighed[:, :, None], axis=1)
        length = np.sqrt(np.sum(step**2, axis=1))
        return step * np.minimum(1.0, LONGEST / np.maximum(length, LONGEST))[:, None] * self.span


def _solved(G: Array, away: Array) -> Array:
    """Return (G G' + d)^-1 e of every row (N, 3), by cofactors."""
    M = np.sum(G[:, :, None, :] * G[:, None, :, :], axis=3)
    for i in range(3):
        M[:, i, i] += DAMPING
    rows = [M[:, i] for i in range(3)]
    cofactors = np.stack([_cross(rows[1], rows[2]), _cross(rows[2], rows[0]), _cross(rows[0], rows[1])], axis=1)
    determinant = np.sum(rows[0] * cofactors[:, 0], axis=1)
    return np.sum(cofactors * away[:, :, None], axis=1) / determinant[:, None]


def _cross(a: Array, b: Array) -> Array:
    parts = [a[:, (i + 1) % 3] * b[:, (i + 2) % 3] - a[:, (i + 2) % 3] * b[:, (i + 1) % 3] for i in range(3)]
    return np.stack(parts, axis=1)
