"""Sessions of a calibration: the base in the frame of each, and the one that uncertainties of positions refer to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.calibration.result import Calibration
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.chain import placed
from rpim_opt.robot.kinematics import FRAME, frame_numbers, numeric_frame
from rpim_opt.robot.parameters import of_session, session_prefix

STEP = 1e-6  # of central differences [m, rad]: what they leave out is 1e-12 of a frame's size
FEW = 6  # sessions that are listed, those that come first


def in_session(result: Calibration, robot: str = "") -> Calibration:
    """Return the calibration with positions, and their U, in the frame of a session instead of the sessions' mean.

    The instrument never stood at the mean of its places: what is uncertain about it is their scatter, and none of the
    robot's. The session is the one in whose frame the measured configurations are known best; the result itself where
    it identifies no session.

    >>> import rpim_opt as ro
    >>> result = ro.load("position").calibrate()
    >>> ro.use.in_session(result) is result  # a single session
    True
    """
    problem = result.problem
    names = _sessions(result, robot) if robot in problem.arms else []
    if not names or problem.session or not isinstance(problem, CalibrationProblem):
        return result
    views = [replace(result, problem=replace(problem, session=name)) for name in names]
    if result.no_intervals:
        return views[0]
    q = np.concatenate([block.q[:, 0] for block in problem.data.blocks if block.robot == robot])
    marker = next(block.markers[0] for block in problem.data.blocks if block.robot == robot)
    return min(views, key=lambda view: float(np.sum(view.predict(q, marker, of="mean", robot=robot).standard ** 2)))


def _sessions(result: Calibration, robot: str) -> list[str]:
    """Return the names of the sessions that are identified, those of the data first."""
    free = result.problem.parameters.of_robot(robot).free.names
    prefixes = dict.fromkeys(name.rpartition("_")[0] + "_" for name in free if of_session(name))
    called = {session_prefix(name): name for name in result.problem.sample().data.sessions}
    return [called.get(prefix, prefix[len("session_") : -1]) for prefix in prefixes]


def base_frame(result: Calibration, robot: str, x: Array | None = None, session: str = "") -> Array:
    """Return the base (4, 4) in the frame of a session, by default the problem's, at deviations x (n,) [SI]."""
    p = result.problem.parameters
    values = p.by_name(result.x if x is None else x)
    prefixes = "base_", session_prefix(session or result.problem.session)
    base, offset = ([values.get(p.called(robot, prefix + axis), 0.0) for axis in FRAME] for prefix in prefixes)
    return np.asarray(numeric_frame(base) @ numeric_frame(offset))


def session_notes(result: Calibration, robot: str = "") -> list[str]:
    """Return sentences on the session of `in_session`, and on the base in every session; none without sessions."""
    reference = result.problem.session
    if not reference:
        return []
    names = [reference, *(name for name in _sessions(result, robot) if name != reference)]
    listed = [f"'{name}' {placed(frame_numbers(base_frame(result, robot, session=name)))}" for name in names[:FEW]]
    if result.known_covariance is not None and np.isfinite(result.covariance).all():
        for i, name in enumerate(names[1:FEW], start=1):
            shift, turn = _apart(result, robot, name)
            listed[i] += f" (U, k = 2, relative to '{reference}': {1e3 * shift:.3g} mm, {1e3 * turn:.3g} mrad)"
    more = f"; {len(names) - FEW} more in the result" if len(names) > FEW else ""
    return [
        f"Positions and their U are in the instrument's frame of session '{reference}'. Base in the frame of sessions: "
        f"{'; '.join(listed)}{more}."
    ]


def _apart(result: Calibration, robot: str, session: str) -> tuple[float, float]:
    """Return U (k = 2) of the motion from a session's frame to the problem's, at the base: shift [m], turn [rad]."""
    here = base_frame(result, robot, session=session)

    def moved(x: Array) -> Array:
        return base_frame(result, robot, x) @ np.linalg.inv(base_frame(result, robot, x, session)) @ here

    frames = np.flatnonzero(result.problem.parameters.free.of_frames)
    J = []
    for step in STEP * np.eye(len(result.x))[frames]:
        ahead, behind = (moved(result.x + sign * step) for sign in (1, -1))
        W = ahead[:3, :3] @ behind[:3, :3].T
        J.append([*(ahead - behind)[:3, 3], W[2, 1], W[0, 2], W[1, 0]])
    slopes = np.array(J) / (2 * STEP)
    variance = np.einsum("ik,ij,jk->k", slopes, result.covariance[np.ix_(frames, frames)], slopes)
    return 2 * float(np.sqrt(variance[:3].sum())), 2 * float(np.sqrt(variance[3:].sum()))
