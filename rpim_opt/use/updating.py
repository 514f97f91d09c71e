"""The next calibration of a robot that was calibrated before: what is known stays known, and what changed is found."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.calibration.causes import refuse_misread
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.constraints import matching
from rpim_opt.convex.structure import identity
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.record import Earlier, Record
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.store.result_file import content
from rpim_opt.use.carried import Carried
from rpim_opt.use.changes import Cause, Fit, Reading, most_believed, possible, weighed
from rpim_opt.use.updated import Moved, Update

MOST = 4
"""Changes of robot and frames that are looked for one after the other: of more it is another robot."""
SPARED = 0.25
"""Part of the readings that may be wrong."""
STRANGE = 5.0
"""Readings that no change explains, and that miss by so many times the error before any calibration, are another's."""


def update(
    result: Calibration,
    data: Dataset,
    *,
    prior_inflation: float = 1.0,
    reset: Sequence[str] = (),
    progress: Callable[[str], None] | None = None,
) -> Update:
    """Calibrate a robot once more: the posterior of its last calibration is the prior of this one.

    First it is asked whether the robot is still the same. While a change of one parameter, of one frame, or one wrong
    reading lets chi-squared fall by more than chance would in one robot of a hundred (over all that may have changed),
    the most believed change is let go: its parameters are expected where they were, within widths that no crash leaves,
    and all others keep what is known of them.

    Parameters
    ----------
    result
        The last calibration, with a squared penalty or none; perhaps of `load_result`.
    data
        New measurements of the same robot, in the same instrument's frame unless ``reset`` says otherwise.
    prior_inflation
        Factor on the earlier standard deviations, where everything may have drifted a little.
    reset
        Patterns of parameters of which the earlier result says nothing, ``("base_*",)`` where the instrument moved.
    progress
        Called with what goes on.

    Raises
    ------
    InputError
        For a result without covariance (lasso), measurements in parts, and readings that cannot be this robot's.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> first = ro.calibrate(problem.on(problem.data.take(np.arange(32))))
    >>> found = ro.use.update(first, problem.data.take(np.arange(32, 40)))
    >>> print(str(found).splitlines()[0])
    The robot has not changed, as far as 8 readings can tell: chi-squared 25.9 of 24, probability 0.37.
    >>> [earlier.title for earlier in found.result.record.earlier], found.changes
    (['ABB IRB 120-3/0.58'], ())
    """
    say = progress or (lambda text: None)
    asking = Carried(result, prior_inflation)
    problem = asking.problem(data)
    let_go = _named(problem, reset)
    say("comparing with the last calibration")
    start = None  # a frame that was reset may be anywhere: then it is looked for
    if not let_go:
        start = asking.start(problem)
    found = asking.calibrated(problem, let_go, start)
    first, before = _asked(asking, found, let_go)
    causes = first
    after = before
    changes: list[Cause] = []
    while (cause := most_believed(causes)) is not None and _may(changes, cause, len(data)):
        say(f"letting {cause.name} go")
        changes.append(cause)
        if cause.kind == "reading":
            problem = problem.without(set(cause.members))
        else:
            let_go += cause.members
        found = asking.calibrated(problem, let_go, found.x)
        causes, after = _asked(asking, found, let_go)
    if not after.likely:
        _require_this_robot(result, found, data)
    moved = tuple(_moved(result, found, name) for name in asking.known(let_go))
    left_out = tuple(cause.name for cause in changes if cause.kind == "reading")
    record = _record(result, prior_inflation, let_go, left_out)
    return Update(replace(found, record=record), before, after, tuple(changes), first, moved, len(data))


def _may(changes: Sequence[Cause], cause: Cause, readings: int) -> bool:
    """Return whether one more change still leaves something of the robot, or of the readings."""
    alike = [each for each in changes if (each.kind == "reading") == (cause.kind == "reading")]
    if cause.kind == "reading":
        return len(alike) < max(SPARED * readings, 1)
    return len(alike) < MOST


def _named(problem: CalibrationProblem, reset: Sequence[str]) -> tuple[str, ...]:
    if not reset:
        return ()
    free = problem.parameters.free
    named = matching(free, reset, "update, reset")
    return tuple(name for name, new in zip(free.names, named, strict=True) if new)


def _asked(asking: Carried, found: Calibration, let_go: Sequence[str]) -> tuple[tuple[Cause, ...], Fit]:
    """Return all causes with their evidence, and how well readings and prior fit without them."""
    model = found.program.model
    missed = asking.missed(model, found.program.penalty_form or identity(len(found.x)))
    free = found.problem.parameters.free
    causes = possible(free, ~np.isin(free.names, let_go))
    return weighed(missed, causes, asking.widths(found.problem) / free.scale, _readings(found, model.group)), missed.fit


def _readings(found: Calibration, group: np.ndarray) -> list[Reading]:
    """Return every configuration's labels and equations: it may have been measured wrongly."""
    labels: dict[int, list[str]] = {}
    for part in found.problem.rows():
        for label, configuration in zip(part.data.label, part.data.configuration, strict=True):
            labels.setdefault(int(configuration), []).append(label)
    return [Reading(tuple(names), np.flatnonzero(group == number)) for number, names in labels.items()]


def _require_this_robot(result: Calibration, found: Calibration, data: Dataset) -> None:
    """Refuse readings that another unit or order explains, or further off than the robot ever was uncalibrated."""
    refuse_misread(result, data)
    before = float(np.nanmax(result.nominal_errors()))
    missed = float(np.sqrt(np.nanmean(found.errors(data) ** 2)))
    if missed > STRANGE * before:
        robots = " and ".join(robot.name for robot in result.problem.arms.values())
        raise InputError(
            "the new measurements",
            f"readings {1e3 * missed:.3g} mm off, whatever is let go",
            f"those of the same robot ({robots}) in the same units and instrument's frame, or --reset "
            "with what moved (base_*)",
        )


def _moved(result: Calibration, found: Calibration, name: str) -> Moved:
    """Return by how much a parameter moved."""
    free = found.problem.parameters.free
    i = free.names.index(name)
    spread = np.sqrt(result.covariance[i, i] + found.covariance[i, i])
    nominal = result.problem.parameters.free.nominal[i]
    change = free.nominal[i] + found.x[i] - nominal - result.x[i]
    return Moved(name, free.dimensions[i], float(change), float(spread))


def _record(result: Calibration, inflate: float, let_go: Sequence[str], left_out: Sequence[str]) -> Record:
    """Return where the new result comes from: the last one, by its digest, and what that came from."""
    old = result.record
    digest = old.digest or content(result)["digest"]
    title = old.title or " and ".join(robot.name for robot in result.problem.arms.values())
    last = Earlier(
        title,
        old.made,
        digest,
        len(result.problem.labels),
        {robot: ranges.tolist() for robot, ranges in result.ranges.items()},
        inflate,
        tuple(let_go),
        tuple(left_out),
    )
    return Record(
        old.title,
        old.source,
        excluded=dict.fromkeys(left_out, "far from what the last calibration allows"),
        simulated=old.simulated,
        earlier=(*old.earlier, last),
    )
