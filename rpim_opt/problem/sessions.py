"""What a session adds to a reading that nobody knows: the spread of its shift and its turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.data.dataset import Block
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.parameter_names import frame_of, of_session, session_prefix
from rpim_opt.robot.parameters import Parameters


def unknown_sessions(problem: CalibrationProblem) -> list[Array]:
    """Return what sessions that were not identified add to the covariance of a reading, block by block (N, k, k) [SI].

    T diag(size^2) T' with T the slopes by the shift and the turn of a session, and the sizes that the identified ones
    have as their scales; zero for rows of an identified session, and where no session is identified.

    Parameters
    ----------
    problem
        With the measurements.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> from rpim_opt.problem.sessions import unknown_sessions
    >>> problem = ro.load("position").problem
    >>> float(max(V.max() for V in unknown_sessions(problem)))  # nobody named a session
    0.0
    """
    data = problem.data
    known = {name: _first(problem.parameters.of_robot(name)) for name in problem.arms}
    if problem.touches is not None or not any(known.values()):
        return [np.zeros((1, 1, 1)) for _ in data.blocks]
    p = problem.parameters
    looked_at = {p.called(robot, name) for robot, names in known.items() for name in names}
    identified = np.array([name in looked_at for name in p.names])
    # any session's slopes are those of one that is known
    blocks = tuple(replace(block, session=_session(known[block.robot], len(block.row))) for block in data.blocks)
    as_known = replace(data, blocks=blocks)
    alone = replace(problem, parameters=replace(p, identified=identified), data=as_known, scatter=None)
    T = alone.jacobian(np.zeros(int(identified.sum()))) * p.scale[identified]
    found = []
    start = 0
    for block in data.blocks:
        k = len(block.measurement.components)
        end = start + k * len(block.row)
        part = T[start:end].reshape(-1, k, T.shape[1])
        start = end
        found.append(part @ part.transpose(0, 2, 1) * _unknown(block, p)[:, None, None])
    return found


def _first(own: Parameters) -> list[str]:
    """Return the identified parameters of the first session of one robot, as itself calls them."""
    names = [name for name in own.free.names if of_session(name)]
    if not names:
        return []
    return [name for name in names if frame_of(name) == frame_of(names[0])]


def _session(names: list[str], N: int) -> np.ndarray | None:
    """Return what stands for the session of some parameters, N times."""
    if not names:
        return None
    return np.full(N, frame_of(names[0]).removeprefix("session_").removesuffix("_"), dtype=object)


def _unknown(block: Block, parameters: Parameters) -> np.ndarray:
    """Return which rows (N,) are of a session that is not identified."""
    known = {frame_of(name) for name in parameters.of_robot(block.robot).free.names}
    return np.array([session_prefix(name) not in known for name in block.session_names])
