"""Poses in which a robot touches a plane or a sphere: exact to rounding, and the same on every processor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.design import random_candidates
from rpim_opt.problem.problem import CalibrationProblem

DRAWS = 100
"""Random poses that are tried for each row."""
STEPS = 40
"""Newton steps from each: some dozen long ones until the surface is near, then a few to rounding."""
LONGEST = 0.1
"""Largest step, in ranges of the joints: close starts stay close on their way, whatever the surface."""
DIFFERENCE = 1e-4
"""Step of the slopes' differences, in ranges: their rounding is 1e-12, and Newton's method forgives their bend."""
TOUCHING = 1e-12
"""Largest distance to the surface [m]: what converged is at 1e-15, what did not is seen from afar."""


def touching_poses(
    problem: CalibrationProblem,
    x: Array,
    wanted: Array,
    rng: np.random.Generator,
    share: float = 1.0,
) -> Array:
    """Return joint values (N, dof) [rad or m] at which a constraint's residuals are the wanted ones.

    From a random pose, Newton's steps of least norm, in units of the joints' ranges, lead to the surface::

        u <- u - (r - wanted) g / g'g,   g = dr / du

    A pose that does not get there within the joints' limits is drawn again. It is arithmetic on single numbers, row
    by row: linear algebra, whose last digits differ from processor to processor, has no part in it. What rounding
    differs elsewhere grows 2 times on the way in the median and 100 times at worst, to a thousandth of what a table
    prints.

    Parameters
    ----------
    problem
        Its data are N rows of a measurement with one component and no columns; their joint values do not matter.
    x
        (n,) deviations of the identified parameters [SI].
    wanted
        (N,) residuals [m], in the order of the rows.
    rng
        Where the random poses come from. It advances by the same amount however many are needed.
    share
        Which part of every joint's range they are drawn from, from 0 to 1.

    Raises
    ------
    InputError
        Where none of `DRAWS` random poses leads to the surface.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> from rpim_opt.data.models import plane
    >>> from rpim_opt.store.touching import touching_poses
    >>> whole = ro.load("plane").problem
    >>> problem = whole.on(whole.data.take(range(8)))
    >>> nominal = np.zeros(len(problem.parameters.free))
    >>> q = touching_poses(problem, nominal, np.full(8, 1e-3), np.random.default_rng(0))
    >>> touching = problem.on(ro.Dataset.of(q, np.empty((8, 0)), 1e-5, measurement=plane))
    >>> bool(np.abs(touching.residual(nominal) - 1e-3).max() < 1e-14)
    True
    """
    draws = rng.spawn(1)[0]
    limits = problem.robot.limits
    poses = np.empty((len(wanted), problem.robot.dof))
    missing = np.ones(len(wanted), dtype=bool)
    for _ in range(DRAWS):
        # for all rows, also those that have their pose: a row's draws do not depend on another row's luck
        q = random_candidates(problem.robot, len(wanted), draws, share)[missing]
        rows = np.flatnonzero(missing)
        rest = problem.on(problem.data.take(rows))
        for _ in range(STEPS):
            q = q + _step(rest, x, wanted[rows], q)
        inside = ((q >= limits[:, 0]) & (q <= limits[:, 1])).all(axis=1)
        take = inside & (np.abs(_residual(rest, x, q) - wanted[rows]) < TOUCHING)
        poses[rows[take]] = q[take]
        missing[rows[take]] = False
        if not missing.any():
            return poses
    raise InputError("table simulation", "a plane or sphere out of reach", "one that the robot can touch")


def _step(problem: CalibrationProblem, x: Array, wanted: Array, q: Array) -> Array:
    """Return every row's step (N, dof) towards the surface, no longer than `LONGEST` ranges."""
    span = np.ptp(problem.robot.limits, axis=1)
    slope = np.empty_like(q)
    for j, shift in enumerate(np.diag(DIFFERENCE * span)):
        forward = _residual(problem, x, q + shift)
        backward = _residual(problem, x, q - shift)
        slope[:, j] = (forward - backward) / (2 * DIFFERENCE)
    away = _residual(problem, x, q) - wanted
    steepness = np.sum(slope**2, axis=1)
    # a pose in which no joint moves the point across the surface stays where it is, and is drawn again
    step = -(away / np.maximum(steepness, 1e-12))[:, None] * slope
    length = np.sqrt(np.sum(step**2, axis=1))
    return step * np.minimum(1.0, LONGEST / np.maximum(length, LONGEST))[:, None] * span


def _residual(problem: CalibrationProblem, x: Array, q: Array) -> Array:
    """Return every row's residual (N,) [m] at the joint values q (N, dof)."""
    data = problem.data
    blocks = tuple(replace(block, q=q[block.row][:, None]) for block in data.blocks)
    posed = problem.on(Dataset(blocks, data.label, data.configuration))
    residual = np.empty(len(q))
    residual[np.concatenate([block.row for block in blocks])] = posed.residual(x)
    return residual
