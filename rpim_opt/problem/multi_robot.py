"""Several problems, robots or sessions as one problem with shared parameters."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from string import ascii_uppercase

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, pick
from rpim_opt.basics.units import fits
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.noise import equation_numbers
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.frames import shared_bases
from rpim_opt.robot.parameters import concatenated, frame_of, known_patterns, of_session, session_prefix

NAME = re.compile(r"(?!tool$|base$)[A-Za-z]\w*")
MOST_PARAMETERS = 2000  # largest number of parameters with which sessions are identified
MINUTES = 0.26  # of a default calibration with a thousand parameters; 0.5 s with 274, 3 s with 514
FAR = 3.0
"""Largest difference of a shared parameter's nominal values, in scales; a frame further off is registered again."""


def together(
    *problems: CalibrationProblem, shared: Sequence[str] | Mapping[str, Sequence[str]], **named: CalibrationProblem
) -> CalibrationProblem:
    """Combine problems: two arms and one tracker, one robot in two campaigns, one tool on two robots.

    The result is a problem like any other: `calibrate` takes it with any formulation and selector, or estimates prior
    scales, one per kind of parameter of all robots, and one repeatability. Parameters are named ``name.parameter``,
    ``left.a2``, unless they are shared; configurations of different problems are never the same.

    The problems are in memory, of one robot each; their names are ``A``, ``B``, ..., or stated: ``left=problem``.
    ``shared`` are patterns of parameters that are the same in all problems that have them, ``["tool_*"]``; their
    nominal values are those of the first such problem. A mapping states patterns per problem: for two arms of one cell
    and a camera outside, the arms' ``base_*``. With ``read_urdf(..., origins=True)`` joints of one URDF can be shared
    where chains branch, too.

    InputError for fewer than two problems, a pattern that matches no parameter of several problems, shared parameters
    that are stated differently, stated repeatability (state it for the result), data in blocks, and touches of a point
    that two robots locate at different places.

    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> data = problem.data
    >>> half = [problem.on(data.take(range(20))), problem.on(data.take(range(20, 40)))]
    >>> both = ro.together(spring=half[0], autumn=half[1], shared=["[!b]*", "be*"])  # all but the base
    >>> both.parameters.free.names[:2], both.parameters.free.names[-1], both.labels[-1]
    (('alpha1', 'a1'), 'autumn.base_rz', 'c39')
    """
    parts = {**dict(zip(ascii_uppercase, problems, strict=False)), **named}
    count = len(problems) + len(named)
    if len(parts) < max(count, 2):
        raise InputError("together", f"{count} problems with {len(parts)} names", "two or more, each with its name")
    for name, part in parts.items():
        where = f"together, problem '{name}'"
        if not NAME.fullmatch(name):
            raise InputError("together", f"the name '{name}'", "letters, digits and _, neither tool nor base")
        if not isinstance(part, CalibrationProblem):
            raise InputError(where, type(part).__name__, "a CalibrationProblem, in memory")
        if len(part.arms) > 1:
            raise InputError(where, "several robots", "one; give all problems in one call")
        if part.repeatability is not None:
            accepted = "none: it is estimated, or stated for the whole problem by .with_repeatability()"
            raise InputError(where, "the robot's repeatability", accepted)
    common = _common(parts, shared)
    tables = []
    for name, part in parts.items():
        p = part.parameters
        known = {own for table in tables for own in table.names}
        p = p.take(np.flatnonzero([own not in common[name] or own not in known for own in p.names]))
        new = {own: own if own in common[name] else f"{name}.{own}" for own in p.names}
        tables.append(replace(p, names=tuple(new.values()), terms=tuple(new[own] for own in p.terms)))
    robots = {name: part.robot for name, part in parts.items()}
    data = Dataset.of_robots({name: part.data for name, part in parts.items()}).grouped_by_points()
    whole = CalibrationProblem(robots, concatenated(tables), data)
    shared_bases(whole)  # points touched by several robots have one position
    return whole


def _common(
    parts: Mapping[str, CalibrationProblem], shared: Sequence[str] | Mapping[str, Sequence[str]]
) -> dict[str, set[str]]:
    """Return what every problem shares: parameters that match a pattern and that several have, stated equally."""
    patterns = shared if isinstance(shared, Mapping) else dict.fromkeys(parts, shared)
    for key, each in patterns.items():
        pick(parts, key, "together, shared")
        if isinstance(each, str):
            raise InputError("together, shared", f"'{each}'", f"patterns in a list: ['{each}']")
    count = Counter(name for part in parts.values() for name in part.parameters.names)
    several = [name for name in count if count[name] > 1]
    for pattern in chain.from_iterable(patterns.values()):
        if not any(fits(name, pattern) for name in several):
            raise InputError("together, shared", f"'{pattern}'", known_patterns(several, pattern) + ", of several")
    common: dict[str, set[str]] = {key: set() for key in parts}
    for name in several:
        wanting = [key for key in parts if any(fits(name, pattern) for pattern in patterns.get(key, ()))]
        having = [key for key in wanting if name in parts[key].parameters.names]
        for key in having[1:]:
            first, where = having[0], f"together, shared '{name}'"
            p, other = parts[first].parameters, parts[key].parameters
            i, k = p.names.index(name), other.names.index(name)
            for what in ("dimensions", "scale", "tolerance", "identified"):
                mine, theirs = getattr(p, what)[i], getattr(other, what)[k]
                if mine != theirs:
                    found = f"{what.removesuffix('s')} {mine} in '{first}' and {theirs} in '{key}'"
                    raise InputError(where, found, "the same in all")
            apart = abs(p.nominal[i] - other.nominal[k])
            if apart > FAR * p.scale[i]:
                found = f"nominal values {apart:g} apart in '{first}' and '{key}', more than {FAR:g} prior scales"
                raise InputError(where, found, "one nominal value in all")
            common[first].add(name)
            common[key].add(name)
    return common


def identifying_sessions(problem: CalibrationProblem) -> CalibrationProblem:
    """Return the problem with all sessions of its data identified, like those that are already.

    Their parameters follow all others, with the scales of an identified session; the problem itself is returned if no
    session is identified, or if all are. Rows without a session form one more.
    """
    p = problem.parameters
    like: dict[str, str] = {}
    for robot in problem.arms:
        names = [name for name in p.of_robot(robot).free.names if of_session(name)]
        known = {frame_of(name) for name in names}
        blocks = [block for block in problem.data.blocks if block.robot == robot]
        for session in dict.fromkeys(name for block in blocks for name in block.session_names):
            prefix = session_prefix(session)
            for name in names:
                if prefix not in known and frame_of(name) == frame_of(names[0]):
                    called = p.called(robot, name)
                    like[called.removesuffix(name) + prefix + name.rpartition("_")[2]] = called
    if not like:
        return problem
    known_names = np.flatnonzero(~np.isin(p.names, list(like)))
    entries = np.array([p.names.index(name) for name in like.values()])
    more = replace(p.take(entries), names=tuple(like), nominal=np.zeros(len(like)))
    repeatability = problem.repeatability
    if repeatability is not None and repeatability.at is not None:
        repeatability = replace(repeatability, at=np.append(repeatability.at[known_names], more.nominal))
    return replace(problem, parameters=concatenated([p.take(known_names), more]), repeatability=repeatability)


def unknown_sessions(problem: CalibrationProblem) -> list[Array]:
    """Return T S^2 T' (N, k, k) [SI] of every block: sessions that are not identified, zero for those that are."""
    whole = identifying_sessions(problem)
    if whole is problem or problem.touches is not None:
        return [np.zeros((1, 1, 1)) for _ in problem.data.blocks]
    p = whole.parameters
    added = p.identified & ~np.isin(p.names, problem.parameters.free.names)
    alone = replace(whole, parameters=replace(p, identified=added), repeatability=None)
    T = alone.jacobian(np.zeros(int(added.sum()))) * p.scale[added]
    return [T[index] @ T[index].transpose(0, 2, 1) for index in equation_numbers(problem.data)]


def require_affordable(problem: Source) -> None:
    """Refuse hundreds of sessions: six parameters each, at a cost that grows with the cube of their number."""
    names = problem.parameters.free.names
    sessions = {frame_of(name) for name in names if of_session(name)}
    if len(names) > MOST_PARAMETERS and sessions:
        minutes = (len(names) / 1000) ** 3 * MINUTES
        raise InputError(
            "session",
            f"{len(sessions)} of them and {len(names):,} parameters, which would take about {minutes:.0f} minutes",
            f"at most {MOST_PARAMETERS:,}: one name for sessions of the same set-up, or `identify` without session_*",
        )
