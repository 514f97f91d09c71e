"""Improvement: whether a calibration makes a robot's positions better, from its identification data alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.calibration.covariance import coverage_factor
from rpim_opt.calibration.leverage import influence
from rpim_opt.calibration.outcome import Outcome
from rpim_opt.problem.linear import Machine, require_robot
from rpim_opt.problem.workspace import moved, predicted, within_ranges
from rpim_opt.robot.kinematics import FRAME, forward_kinematics, numeric_frame
from rpim_opt.robot.parameter_names import of_joint, own_name

WORTH = 0.9
"""A calibration whose predicted error is above this share of the nominal robot's improves nothing."""
CONFIDENCE = 0.95
"""Of the intervals."""


@dataclass(frozen=True)
class Improvement:
    """Position errors of the flange [m] that are expected over the joint ranges, base and tool fitted.

    Parameters
    ----------
    before, after
        RMS with the nominal parameters, and with the identified ones.
    within
        What 95 % of the errors along any axis do not exceed where least is known.
    """

    before: float
    after: float
    within: float

    @property
    def improves(self) -> bool:
        """Whether identified parameters are expected to be clearly better than the nominal ones."""
        return self.after < WORTH * self.before


def improvement(result: Outcome) -> Improvement | None:
    """Return the expected position errors of the flange, nominal and identified; None where nothing tells them.

    With the deviations x, D their slopes of W positions over the joint ranges less what fitting base and tool anew
    takes back, N the covariance of x by noise and B the mean square of what the penalty holds back::

        after^2  = tr(D (N + B) D') / W
        before^2 = (|D x|^2 - tr(D N D') + tr(D B D')) / W

    N is that of leaving out every configuration in turn (the jackknife) where that is more than the noise says: then
    the rows of a configuration err together, by the robot or by the camera, and more of them do not help.

    Parameters
    ----------
    result
        With a squared penalty or none, of one robot with joint limits, in one place or several (`together`).

    Examples
    --------
    >>> import rpim_opt as ro
    >>> found = ro.calibration.improvement(ro.load("position").calibrate())
    >>> found.improves, found.before > 10 * found.after
    (True, True)
    """
    if not result.linear_penalty:
        return None
    try:
        D, directions = _slopes(result)
        noise, prior = result.spread.noise, result.spread.prior
        change = influence(result).change
    except InputError:
        return None
    if np.isfinite(change).all():
        scale = result.problem.parameters.free.scale
        jackknife = change.T @ change * (len(change) - 1) / len(change)
        if np.trace(jackknife / np.outer(scale, scale)) > np.trace(noise / np.outer(scale, scale)):
            noise = jackknife
    count = len(directions)
    by_noise = float(np.sum((D @ noise) * D))
    by_prior = float(np.sum((D @ prior) * D))
    before = float(np.sum((D @ result.x) ** 2)) - by_noise + by_prior
    each = np.einsum("nij,jk,nik->ni", directions, noise + prior, directions)
    factor = coverage_factor(result.freedom, CONFIDENCE)
    return Improvement(
        before=float(np.sqrt(max(before, 0.0) / count)),
        after=float(np.sqrt((by_noise + by_prior) / count)),
        within=float(factor * np.sqrt(each.max())),
    )


def _slopes(result: Outcome) -> tuple[Array, Array]:
    """Return the slopes of flange positions less what fitting base and tool takes back, (3 W, n) and (W, 3, n)."""
    machine, columns = _at_flange(result)
    q = within_ranges(machine)
    p = predicted(machine, q).position
    J = np.zeros((len(p), 3, len(result.x)))
    J[:, :, columns] = moved(machine, q).slope
    D = J.reshape(-1, J.shape[2])
    p = p - p.mean(axis=0)
    turning = np.zeros((len(p), 3, 3))
    turning[:, [0, 1, 2], [1, 2, 0]] = p[:, [2, 0, 1]]
    turning[:, [0, 1, 2], [2, 0, 1]] = -p[:, [1, 2, 0]]
    nominal = dict(zip(machine.parameters.names, machine.parameters.nominal, strict=True))
    base = numeric_frame([nominal[f"base_{c}"] for c in FRAME])
    along = base[:3, :3] @ forward_kinematics(require_robot(machine), q)[:, :3, :3]
    fitting = np.concatenate([np.tile(np.eye(3), (len(p), 1, 1)), turning, along], axis=2).reshape(-1, 9)
    U = np.linalg.qr(fitting)[0]
    D = D - U @ (U.T @ D)
    return D, D.reshape(J.shape)


def _at_flange(result: Outcome) -> tuple[Machine, np.ndarray]:
    """Return the machine with its reflectors at the flange, where it was linearized, and which columns of x it has.

    Several problems of `together` are one machine where they share all that is identified of the joints.
    """
    problem = result.problem.sample()
    parameters = result.problem.parameters
    robot = next(iter(problem.arms))
    joints = [name for name in parameters.free.names if of_joint(name) or name in parameters.terms]
    own = [name for name in joints if own_name(name) != name]
    if own:
        raise InputError("improvement", f"several robots: '{own[0]}' is of one alone", "one robot")
    places = parameters.places_of(robot)
    columns = (np.cumsum(parameters.identified) - 1)[places[parameters.identified[places]]]
    of_robot = parameters.of_robot(robot)
    tools = np.array([name.startswith("tool_") for name in of_robot.names])
    nominal = np.where(tools, 0.0, of_robot.nominal)
    at = np.where(tools[of_robot.identified], 0.0, result.x[columns])
    data = problem.alone(robot).data
    return Machine(problem.arms[robot], replace(of_robot, nominal=nominal), data, at=at), columns
