"""Configurations in which a robot touches a plane or a sphere, exact to rounding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.postures import Target
from rpim_opt.problem.problem import CalibrationProblem


def touching_poses(
    problem: CalibrationProblem,
    x: Array,
    wanted: Array,
    rng: np.random.Generator,
    share: float = 1.0,
) -> Array:
    """Return joint values (N, dof) [rad or m] at which a constraint's residuals are the wanted ones.

    From random configurations by Newton's steps (`Target`), whose ends are within the joints' limits.

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
        Where no random configuration leads to the surface.

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

    def away(q: Array, rows: np.ndarray) -> Array:
        data = problem.data.take(rows)
        blocks = tuple(replace(block, q=q[block.row][:, None]) for block in data.blocks)
        posed = problem.on(Dataset(blocks, data.label, data.configuration))
        residual = np.empty(len(q))
        residual[np.concatenate([block.row for block in blocks])] = posed.residual(x)
        return (residual - wanted[rows])[:, None]

    target = Target(problem.robot, away, damping=1e-20)  # more would change the last digits of tables
    poses, beyond = target.reached(len(wanted), rng.spawn(1)[0], share)
    if beyond is not None:
        raise InputError("table simulation", "a plane or sphere out of reach", "one that the robot can touch")
    return poses
