"""Sessions of a calibration: the one that positions and their uncertainty refer to, and the base in all of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import joined, listed
from rpim_opt.calibration.held_out import registered
from rpim_opt.calibration.result import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.pose import position
from rpim_opt.robot.chain import placed
from rpim_opt.robot.kinematics import FRAME, frame_numbers, numeric_frame
from rpim_opt.robot.mdh import numbered
from rpim_opt.robot.parameters import frame_of, of_session, session_prefix

FEW, SOME = 6, 100  # sessions that are listed at most; configurations that represent all at most


def in_session(result: Calibration, robot: str = "") -> Calibration:
    """Return the calibration with positions, and their U, in the frame of a session instead of the sessions' mean.

    The instrument never stood at the mean of its places: the uncertainty of that frame is their scatter, and none of
    the robot's. The chosen session is the one in whose frame the measured configurations are known best; the result
    itself is returned if it identifies no session.

    >>> import rpim_opt as ro
    >>> result = ro.load("position").calibrate()
    >>> ro.use.in_session(result) is result  # a single session
    True
    """
    problem = result.problem
    names = [name for name, again in _sessions(result, robot).items() if again and robot in problem.arms]
    if not names or problem.session or not problem.keeps_rows:
        return result
    views = [replace(result, problem=replace(problem, session=name)) for name in names]
    if result.no_intervals:
        return views[0]
    fit = result.fit_covariance
    squares = [np.trace(fit.of_positions(_slopes(view, robot)), axis1=1, axis2=2).sum() for view in views]
    return views[int(np.argmin(squares))]


def set_ups(result: Calibration, data: Dataset) -> list[str]:
    """Return the sessions that ``register`` refers to: those new to the calibration, or all if there are none."""
    return sorted({*data.session} - {*result.problem.sample().data.session}) or sorted({*data.session})


def registered_again(result: Calibration, data: Dataset) -> tuple[Dataset, str]:
    """Return measurements, with `set_ups` moved into the frame of `in_session`, and the motions in words.

    Each session has the motion that fits its rows best. InputError as of `registered`, with the session's name.
    """
    session, places = in_session(result).problem.session, data.session
    names = set_ups(result, data)
    if session:  # as another session's, their intervals would include the scatter of the instrument's places
        new = np.where(np.isin(places, names), session, places)
        data = replace(data, blocks=tuple(replace(each, session=new[each.row]) for each in data.blocks))
    motions = []
    for name in names:
        try:
            data, motion = registered(result, data, places == name)
        except InputError as error:
            where = filter(None, ["--register", name and f"session {name!r}", error.where])
            raise InputError(", ".join(where), error.found, error.accepted) from None
        moved = {"": "the measurements were"}.get(name, f"session {name!r} was")
        motions.append(f"{moved} {motion}")
    arm, *_ = result.problem.arms.values()
    first = [*arm.joint_types, "revolute"].index("revolute") or 1  # joint 1, or all linear axes of a gantry
    zeros = joined([f"joint {numbered(i, arm.joint_names)}" for i in range(first)])
    hidden = f"Changed zeros of {zeros} look like such a motion, and would not be found."
    return data, f"Registered again: {listed(motions, between='; ')}. {hidden}"


def _sessions(result: Calibration, robot: str) -> dict[str, bool]:
    """Return the names of the sessions that are identified, and whether they were measured: in an update some were."""
    free = result.problem.parameters.of_robot(robot).free.names
    called = {session_prefix(name): name for name in result.problem.sample().data.sessions}
    prefixes = dict.fromkeys(frame_of(name) for name in free if of_session(name))
    return {called.get(each, each.removeprefix("session_")[:-1]): each in called for each in prefixes}


def _slopes(view: Calibration, robot: str) -> Array:
    """Return the derivatives (N, 3, n) of positions in the frame of a view's session at measured configurations."""
    problem = view.problem.sample()
    blocks = [block for block in problem.data.blocks if block.robot == robot]
    step = -(-sum(len(block.row) for block in blocks) // SOME)
    slopes = []
    for few in [block.take(np.arange(0, len(block.row), step), block.row[::step]) for block in blocks]:
        torque = few.torque
        if torque is not None:
            torque = torque[:, 0]
        there = problem.measuring(few.q[:, 0], position, few.markers[0], torque, few.payload, few.columns, robot)
        slopes.append(there.jacobian(view.x).reshape(len(there.data), 3, -1))
    return np.concatenate(slopes)


def base_frame(result: Calibration, robot: str, session: str = "") -> Array:
    """Return the identified base (4, 4) in the frame of a session, by default the problem's."""
    p = result.problem.parameters
    values = p.by_name(result.x)
    prefixes = "base_", session_prefix(session or result.problem.session)
    base, offset = ([values.get(p.called(robot, prefix + axis), 0.0) for axis in FRAME] for prefix in prefixes)
    return np.asarray(numeric_frame(base) @ numeric_frame(offset))


def session_notes(result: Calibration, robot: str = "") -> list[str]:
    """Return a sentence on the session of `in_session` and the base in every session; none without sessions."""
    here = result.problem.session
    if not here:
        return []
    measured = _sessions(result, robot)
    names = sorted(measured, key=lambda name: (name != here, not measured[name]))
    before = {name: " (by rows before the update)" * (not again) for name, again in measured.items()}
    bases = [f"'{name}'{before[name]} {placed(frame_numbers(base_frame(result, robot, name)))}" for name in names]
    return [
        f"Positions and their U are in the instrument's frame of session '{here}'. Base of the DH table in the frame "
        f"of sessions: {listed(bases, FEW, '; ')}."
    ]
