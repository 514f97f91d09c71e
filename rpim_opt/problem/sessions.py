"""Sessions that a problem does not know: what they add to a reading, and the parameters that would tell them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import chain

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.parameter_names import frame_of, of_session, session_prefix
from rpim_opt.robot.parameters import Parameters


def knowing_sessions(problem: CalibrationProblem) -> CalibrationProblem:
    """Return the problem that identifies the sessions of its data, too, as those that are identified already.

    Their parameters stand behind all others, with the scales of a session that is known; the problem itself where no
    session is identified, or all are. Rows that name no session are of one more.

    Parameters
    ----------
    problem
        With measurements, perhaps of other sessions.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> from rpim_opt.problem.sessions import knowing_sessions
    >>> problem = ro.load("position").problem
    >>> knowing_sessions(problem) is problem  # nobody named a session
    True
    """
    p = problem.parameters
    like = dict(chain.from_iterable(_new(problem, robot) for robot in problem.arms))
    if not like:
        return problem
    kept = np.flatnonzero(~np.isin(p.names, list(like)))
    entries = np.array([p.names.index(name) for name in like.values()])
    more = replace(p.take(entries), names=tuple(like), nominal=np.zeros(len(like)))
    scatter = problem.scatter
    if scatter is not None and scatter.at is not None:
        scatter = replace(scatter, at=np.append(scatter.at[kept], more.nominal))
    return replace(problem, parameters=_joined(p.take(kept), more), scatter=scatter)


def unknown_sessions(problem: CalibrationProblem) -> list[Array]:
    """Return what sessions that are not identified add to the covariance of a reading, block by block (N, k, k) [SI].

    T diag(size^2) T' with T the slopes by the shift and the turn of a session, and as sizes the scales of those that
    are identified; zero for rows of an identified session, and where no session is identified.

    Parameters
    ----------
    problem
        With the measurements.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> from rpim_opt.problem.sessions import unknown_sessions
    >>> problem = ro.load("position").problem
    >>> float(max(V.max() for V in unknown_sessions(problem)))  # nobody named a session
    0.0
    """
    whole = knowing_sessions(problem)
    if whole is problem or problem.touches is not None:
        return [np.zeros((1, 1, 1)) for _ in problem.data.blocks]
    p = whole.parameters
    added = p.identified & ~np.isin(p.names, problem.parameters.free.names)
    alone = replace(whole, parameters=replace(p, identified=added), scatter=None)
    T = alone.jacobian(np.zeros(int(added.sum()))) * p.scale[added]
    found = []
    start = 0
    for block in problem.data.blocks:
        k = len(block.measurement.components)
        end = start + k * len(block.row)
        part = T[start:end].reshape(-1, k, T.shape[1])
        start = end
        found.append(part @ part.transpose(0, 2, 1))
    return found


def _new(problem: CalibrationProblem, robot: str) -> Iterator[tuple[str, str]]:
    """Yield the parameters of the sessions of a robot's rows that are not identified, each with a known one like it."""
    p = problem.parameters
    own = p.of_robot(robot)
    known = {frame_of(name) for name in own.free.names}
    for prefix in _prefixes(problem, robot):
        for name in _first(own):
            if prefix not in known:
                called = p.called(robot, name)
                yield called.removesuffix(name) + prefix + name.rpartition("_")[2], called


def _first(own: Parameters) -> list[str]:
    """Return the identified parameters of the first session of one robot, as itself calls them."""
    names = [name for name in own.free.names if of_session(name)]
    return [name for name in names if frame_of(name) == frame_of(names[0])]


def _prefixes(problem: CalibrationProblem, robot: str) -> list[str]:
    """Return the prefixes of the sessions of a robot's rows, in their order."""
    names = [name for block in problem.data.blocks if block.robot == robot for name in block.session_names]
    return [session_prefix(name) for name in dict.fromkeys(names)]


def _joined(first: Parameters, second: Parameters) -> Parameters:
    values = {
        what: np.concatenate([getattr(first, what), getattr(second, what)])
        for what in ("nominal", "scale", "tolerance", "identified")
    }
    names = first.names + second.names
    return replace(first, names=names, dimensions=first.dimensions + second.dimensions, **values)
