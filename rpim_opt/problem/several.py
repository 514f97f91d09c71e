"""Several problems, robots or sessions as one problem with shared parameters."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from string import ascii_uppercase

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.units import fits
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.frames import met
from rpim_opt.robot.parameter_names import frame_of, known_patterns, of_session, session_prefix
from rpim_opt.robot.parameters import Parameters

NAME = re.compile(r"(?!tool$|base$)[A-Za-z]\w*")
FAR = 3.0
"""How many scales the nominal values of a shared parameter may differ by: as much as a frame's before it is moved."""


def together(*problems: CalibrationProblem, shared: Sequence[str], **named: CalibrationProblem) -> CalibrationProblem:
    """Return several problems as one: two arms and one tracker, one robot in two campaigns, one tool on two robots.

    A problem like any other: `calibrate` takes it with any formulation and selector, or learns its sizes, one for each
    kind of parameter of all robots, and one scatter. Parameters are called ``name.parameter``, ``left.a2``, but those
    that are shared keep their name; configurations of different problems are never the same.

    Parameters
    ----------
    problems
        In memory, of one robot each; called ``A``, ``B``, ...
    shared
        Patterns of the parameters that are one and the same in all: ``["tool_*"]``. Their nominal values are those of
        the first problem.
    named
        Problems by the names that they are to have, ``left=problem``.

    Raises
    ------
    InputError
        For fewer than two problems, a pattern that matches no parameter that all have, shared parameters that are
        stated differently, scatter (it is stated of the whole, or learned), measurements in parts, and touches of a
        point that is elsewhere for another robot.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> data = problem.data
    >>> half = [problem.on(data.take(range(20))), problem.on(data.take(range(20, 40)))]
    >>> both = ro.together(spring=half[0], autumn=half[1], shared=["[!b]*", "beta?"])  # all but the base
    >>> both.parameters.free.names[:2], both.parameters.free.names[-1], both.labels[-1]
    (('alpha1', 'a1'), 'autumn.base_rz', 'c39')
    >>> result = ro.calibrate(both, ro.tikhonov, weight=1.0)
    >>> result.converged, result.x.shape, result.covariance.shape
    (True, (40,), (40, 40))
    >>> list(result.robots)
    ['spring', 'autumn']
    """
    parts = {**dict(zip(ascii_uppercase, problems, strict=False)), **named}
    _require_parts(parts, len(problems) + len(named))
    common = _common(parts, shared)
    for name in common:
        _require_same(name, parts)
    robots = {name: part.robot for name, part in parts.items()}
    data = Dataset.of_robots({name: part.data for name, part in parts.items()}).grouped_by_points()
    whole = CalibrationProblem(robots, _joined(parts, common), data)
    met(whole)  # what is touched by several robots is in one place
    return whole


def _require_parts(parts: Mapping[str, CalibrationProblem], count: int) -> None:
    """Refuse what cannot be put together."""
    if len(parts) < max(count, 2):
        raise InputError("together", f"{count} problems with {len(parts)} names", "two or more, each with its name")
    for name, part in parts.items():
        if not NAME.fullmatch(name):
            raise InputError("together", f"the name '{name}'", "letters, digits and _, neither tool nor base")
        if not isinstance(part, CalibrationProblem):
            raise InputError(f"together, problem '{name}'", type(part).__name__, "a CalibrationProblem, in memory")
        if len(part.arms) > 1:
            raise InputError(f"together, problem '{name}'", "several robots", "one; give all problems in one call")
        if part.scatter is not None:
            accepted = "none: it is learned, or stated of the whole by .scattered()"
            raise InputError(f"together, problem '{name}'", "the robot's scatter", accepted)


def _common(parts: Mapping[str, CalibrationProblem], shared: Sequence[str]) -> tuple[str, ...]:
    """Return the parameters that match one of the patterns and that all problems have."""
    if isinstance(shared, str):
        raise InputError("together, shared", f"'{shared}'", f"patterns in a list: ['{shared}']")
    first, *others = (part.parameters.names for part in parts.values())
    everywhere = [name for name in first if all(name in names for names in others)]
    for pattern in shared:
        if not any(fits(name, pattern) for name in everywhere):
            raise InputError("together, shared", f"'{pattern}'", known_patterns(everywhere, pattern) + ", of all")
    return tuple(name for name in everywhere if any(fits(name, pattern) for pattern in shared))


def _require_same(name: str, parts: Mapping[str, CalibrationProblem]) -> None:
    """Refuse a shared parameter that problems state differently."""
    (first, one), *others = ((key, _entry(part.parameters, name)) for key, part in parts.items())
    for key, other in others:
        for what, mine, theirs in zip(ENTRY, one, other, strict=True):
            if mine != theirs:
                found = f"{what} {mine} in '{first}' and {theirs} in '{key}'"
                raise InputError(f"together, shared '{name}'", found, "the same in all")
        table, further = parts[first].parameters, parts[key].parameters
        apart = abs(table.nominal[table.names.index(name)] - further.nominal[further.names.index(name)])
        if apart > FAR * table.scale[table.names.index(name)]:
            found = f"nominal values {apart:g} apart in '{first}' and '{key}', more than {FAR:g} scales"
            raise InputError(f"together, shared '{name}'", found, "one thing, stated alike")


ENTRY = ("dimension", "scale", "tolerance", "identified")


def _entry(parameters: Parameters, name: str) -> tuple[str, float, float, bool]:
    i = parameters.names.index(name)
    return (
        parameters.dimensions[i],
        float(parameters.scale[i]),
        float(parameters.tolerance[i]),
        bool(parameters.identified[i]),
    )


def _joined(parts: Mapping[str, CalibrationProblem], common: Sequence[str]) -> Parameters:
    """Return the tables one after the other; what is shared stands where the first has it."""
    tables = []
    for number, (name, part) in enumerate(parts.items()):
        table = part.parameters
        if number > 0:
            table = table.take(np.flatnonzero([own not in common for own in table.names]))
        tables.append(_called(table, name, common))
    values = {what: np.concatenate([getattr(table, what) for table in tables]) for what in VALUES}
    return Parameters(
        names=_listed(tables, "names"),
        dimensions=_listed(tables, "dimensions"),
        own_frames=tuple(dict.fromkeys(_listed(tables, "own_frames"))),
        terms=tuple(dict.fromkeys(_listed(tables, "terms"))),
        **values,
    )


VALUES = ("nominal", "scale", "tolerance", "identified")


def _listed(tables: Sequence[Parameters], what: str) -> tuple[str, ...]:
    return tuple(chain.from_iterable(getattr(table, what) for table in tables))


def _called(table: Parameters, robot: str, common: Sequence[str]) -> Parameters:
    """Return a table with the names of a robot among several."""
    new = {name: name if name in common else f"{robot}.{name}" for name in {*table.names, *table.terms}}
    return replace(
        table,
        names=tuple(new[name] for name in table.names),
        terms=tuple(new[name] for name in table.terms if name in table.names),
    )


def knowing_sessions(problem: CalibrationProblem) -> CalibrationProblem:
    """Return the problem that identifies the sessions of its data, too, as those that are identified already.

    Their parameters stand behind all others, with the scales of a session that is known; the problem itself where no
    session is identified, or all are. Rows that name no session are of one more.

    ``problem``: with measurements, perhaps of other sessions.
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
    return replace(problem, parameters=_joined_tables(p.take(kept), more), scatter=scatter)


def unknown_sessions(problem: CalibrationProblem) -> list[Array]:
    """Return what sessions that are not identified add to the covariance of a reading, block by block (N, k, k) [SI].

    T diag(size^2) T' with T the slopes by the shift and the turn of a session, and as sizes the scales of those that
    are identified; zero for rows of an identified session, and where no session is identified.

    ``problem``: with the measurements.
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


def _joined_tables(first: Parameters, second: Parameters) -> Parameters:
    values = {
        what: np.concatenate([getattr(first, what), getattr(second, what)])
        for what in ("nominal", "scale", "tolerance", "identified")
    }
    names = first.names + second.names
    return replace(first, names=names, dimensions=first.dimensions + second.dimensions, **values)
