"""Recalibration with the previous result as prior: whether the robot changed, which parameters, and the new result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import joined, table
from rpim_opt.basics.units import UNITS, accepted_units, display
from rpim_opt.bayes.prior import Prior
from rpim_opt.calibration.asking import calibrate
from rpim_opt.calibration.causes import refuse_misread
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.atoms import SQUARES
from rpim_opt.convex.constraints import matching
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.structure import Quadratic, identity
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.record import Earlier, Record
from rpim_opt.problem.linear import LinearModel
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.several import knowing_sessions
from rpim_opt.problem.source import Source
from rpim_opt.store.result_file import content
from rpim_opt.use.changes import SIZES, Cause, Fit, Misfit, Reading, candidates, prior_widths, significant, weigh

MOST = 4
"""Changes of robot and frames that are looked for one after the other: of more it is another robot."""
SPARED = 0.25
"""Part of the readings that may be wrong."""
STRANGE = 5.0
"""Readings that no change explains, and that miss by so many times the error before any calibration, are another's."""
OPEN = SIZES[-1]
"""Prior widths within which a parameter that changed may be: far enough that readings alone decide it."""
RIVAL = 0.05
"""Probability from which on another cause is named beside the most probable one."""
SHOWN = 5
"""Causes that are shown."""


class Moved(NamedTuple):
    """By how much a parameter that was released moved, and the standard deviation of that [SI]."""

    name: str
    dimension: str
    change: float
    std: float

    def __str__(self) -> str:
        """Return it in mm or degrees."""
        unit, si = display(self.dimension)
        return f"{self.name} {self.change / si:+.4g} {unit} (standard deviation {self.std / si:.2g})"

    def content(self) -> dict[str, Any]:
        """Return it as a document."""
        unit, si = display(self.dimension)
        return {"name": self.name, "unit": unit, "change": self.change / si, "std": self.std / si}


@dataclass(frozen=True, eq=False)
class Update:
    """A recalibration with the previous result as prior.

    Parameters
    ----------
    result
        The calibration, whose record has the previous one.
    before, after
        How the readings fit the previous calibration, and with the changes.
    changes
        Parameters and frames that changed, and wrong readings, which were left out, in the order of their discovery.
    causes
        All that may have changed, with its evidence before anything was released, the most probable first.
    moved
        By how much the released parameters moved.
    readings
        Rows that were given.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> first = ro.calibrate(problem.on(problem.data.take(np.arange(32))))
    >>> found = ro.use.update(first, problem.data.take(np.arange(32, 40)))
    >>> found.changed, found.explained, found.causes[0].p_value > 1e-4, found.content()["readings"]
    (False, True, True, 8)
    """

    result: Calibration
    before: Fit
    after: Fit
    changes: tuple[Cause, ...]
    causes: tuple[Cause, ...]
    moved: tuple[Moved, ...]
    readings: int

    @property
    def changed(self) -> bool:
        """Whether the robot, or where it stands, is not what it was."""
        return any(cause.kind != "reading" for cause in self.changes)

    @property
    def explained(self) -> bool:
        """Whether readings and the previous calibration agree, but for the changes."""
        return self.after.likely

    def content(self) -> dict[str, Any]:
        """Return the figures [mm, deg], all causes, and the earlier calibrations."""
        return {
            "changed": self.changed,
            "explained": self.explained,
            "before": self.before._asdict(),
            "after": self.after._asdict(),
            "changes": [cause._asdict() for cause in self.changes],
            "moved": [each.content() for each in self.moved],
            "causes": [cause._asdict() for cause in self.causes],
            "readings": self.readings,
            "converged": self.result.converged,
            "earlier": [each._asdict() for each in self.result.record.earlier],
        }

    def __str__(self) -> str:
        """Return the verdict, what moved, and the causes that were weighed."""
        count = f"{self.readings} readings"
        if self.changes:
            verdict = "The robot has changed" if self.changed else "The robot has not changed, but readings are wrong"
            lines = [f"{verdict}: {_chi_squared(self.before)} as it was."]
        elif self.before.likely:
            lines = [f"The robot has not changed, as far as {count} can tell: {_chi_squared(self.before)}."]
        else:
            lines = [f"{count} miss the last calibration by more than it allows: {_chi_squared(self.before)}."]
        for cause in self.changes:
            end = ", left out" if cause.kind == "reading" else ""
            figures = f"chi-squared falls by {cause.gain:.1f}, probability {cause.probability:.2g}"
            lines.append(f"  {cause.kind} {cause.name}: {figures}{end}.")
        if self.moved:
            lines.append(f"Moved since: {joined([str(each) for each in self.moved])}.")
        rivals = [c.name for c in self.causes[1:] if self.changes and c.probability > RIVAL]
        if rivals:
            lines.append(f"These readings do not tell it apart from a change of {joined(rivals)}: measure more.")
        if self.changes:
            lines.append(f"With these changes: {_chi_squared(self.after)}.")
        if not self.explained:
            lines.append(
                "No few changes of parameters, frames or readings explain the rest: is it the same robot? "
                "If so, calibrate it without the previous result."
            )
        rows = [[c.name, c.kind, f"{c.gain:.1f}", f"{c.p_value:.2g}", f"{c.probability:.2g}"] for c in self.causes]
        head = ["may have changed", "kind", "chi-squared falls by", "p-value", "probability"]
        return "\n".join([*lines, "", table(head, rows[:SHOWN]), "", self.result.message])


def _chi_squared(fit: Fit) -> str:
    return f"chi-squared {fit.squares:.1f} of {fit.equations}, probability {fit.probability:.2g}"


@dataclass(frozen=True, eq=False)
class Recalibration:
    """A result as the prior of new readings: its posterior, and its noise as it was learned.

    Parameters
    ----------
    result
        With a squared penalty or none.
    inflation
        Factor on its standard deviations.
    """

    result: Calibration
    inflation: float = 1.0

    def problem(self, data: Dataset) -> CalibrationProblem:
        """Return the result's problem with other measurements; sessions that it does not know stand behind."""
        problem = self.result.problem
        if not isinstance(problem, CalibrationProblem):
            raise InputError("the result", "a calibration of measurements in parts", "one of measurements in memory")
        return knowing_sessions(problem.on(data))

    def start(self, problem: CalibrationProblem) -> Array:
        """Return the result's deviations (n,) [SI], zero for sessions that it does not know."""
        return np.append(self.result.x, np.zeros(len(problem.parameters.free) - len(self.result.x)))

    def widths(self, problem: Source) -> Array:
        """Return the prior standard deviations (n,) before any calibration [SI]."""
        return np.append(self._widths, problem.parameters.free.scale[len(self._widths) :])

    @cached_property
    def _widths(self) -> Array:
        return prior_widths(self.result)

    def prior(self, problem: CalibrationProblem, released: Sequence[str]) -> Prior:
        """Return the posterior as a prior, wide for the released parameters."""
        free = problem.parameters.free
        x = self.start(problem)
        widths = self.widths(problem)
        centre, scale = {}, {}
        for i in [free.names.index(name) for name in released]:
            unit = next(u for u in accepted_units(free.dimensions[i]) if UNITS[u].si == 1.0)
            centre[f"{free.names[i]}_{unit}"] = float(x[i])
            scale[f"{free.names[i]}_{unit}"] = float(OPEN * widths[i])
        wide = Prior(centre=centre, scale=scale)
        if len(released) == len(free):
            return wide
        known = set(self.result.problem.parameters.free.names)
        without = tuple(name for name in released if name in known)
        # in units of the declared noise, as the new readings are: weight 1 then joins both
        return Prior.from_result(self.result, self.inflation, without, noise=1.0) & wide

    def formulation(self, problem: CalibrationProblem, released: Sequence[str]) -> Formulation:
        """Return the result's loss and constraints with the prior as the penalty."""
        prior = self.prior(problem, released)
        plain = replace(self.result.formulation, penalty=SQUARES, penalty_over=None)
        return prior.penalized(plain, prior.stated(problem.parameters, widened=False))

    def calibrate(self, problem: CalibrationProblem, released: Sequence[str], start: Array | None) -> Calibration:
        """Return the calibration; hyperparameters stay as they were learned."""
        formulation = self.formulation(problem, released)
        updated = calibrate(problem, formulation, 1.0, start=start)
        learned = self.result.learned
        if learned is not None:
            more = problem.parameters.free.scale[len(learned.stated) :]
            learned = replace(
                learned,
                left_out=(),
                notes=(),
                drift=np.zeros((len(updated.x), 0)),  # the prior holds what was not known of the scales
                stated=np.append(learned.stated, more),
                local=np.append(learned.local, np.ones(len(more))),
            )
        return replace(updated, learned=learned, asked=partial(calibrate, formulation=formulation, weight=1.0))

    def misfit(self, model: LinearModel, penalty: Quadratic) -> Misfit:
        """Return the misfit of equations and a prior, by the noise of the result."""
        return Misfit(model, penalty, self.result.noise_level, self.result.freedom)


def update(
    result: Calibration,
    data: Dataset,
    *,
    prior_inflation: float = 1.0,
    reset: Sequence[str] = (),
    progress: Callable[[str], None] | None = None,
) -> Update:
    """Recalibrate a robot: the posterior of its previous calibration is the prior of this one.

    First it is asked whether the robot is still the same. While a change of one parameter, of one frame, or one wrong
    reading lets chi-squared fall by more than chance would in one robot of a hundred (over all that may have changed),
    the most probable change is released: its parameters get a prior about where they were, wider than any crash, and
    all others keep the posterior.

    Parameters
    ----------
    result
        The previous calibration, with a squared penalty or none; perhaps of `load_result`.
    data
        New measurements of the same robot, in the same instrument's frame unless ``reset`` says otherwise.
    prior_inflation
        Factor on the earlier standard deviations, where everything may have drifted a little.
    reset
        Patterns of parameters of which the earlier result says nothing, ``("base_*",)`` where the instrument moved.
    progress
        Called with each step in words.

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
    previous = Recalibration(result, prior_inflation)
    problem = previous.problem(data)
    released: tuple[str, ...] = ()
    if reset:
        free = problem.parameters.free
        matches = matching(free, reset, "update, reset")
        released = tuple(name for name, new in zip(free.names, matches, strict=True) if new)
    say("comparing with the last calibration")
    # a frame that was reset may be anywhere: then it is registered anew
    updated = previous.calibrate(problem, released, None if released else previous.start(problem))
    first, before = _weighed(previous, updated, released)
    causes, after = first, before
    changes: list[Cause] = []
    while (cause := significant(causes)) is not None and _allowed(changes, cause, len(data)):
        say(f"releasing {cause.name}")
        changes.append(cause)
        if cause.kind == "reading":
            problem = problem.without(set(cause.members))
        else:
            released += cause.members
        updated = previous.calibrate(problem, released, updated.x)
        causes, after = _weighed(previous, updated, released)
    if not after.likely:
        _require_this_robot(result, updated, data)
    known = set(result.problem.parameters.free.names)
    moved = tuple(_moved(result, updated, name) for name in released if name in known)
    left_out = tuple(cause.name for cause in changes if cause.kind == "reading")
    record = _record(result, prior_inflation, released, left_out)
    return Update(replace(updated, record=record), before, after, tuple(changes), first, moved, len(data))


def _allowed(changes: Sequence[Cause], cause: Cause, readings: int) -> bool:
    """Return whether one more change still leaves something of the robot, or of the readings."""
    alike = [each for each in changes if (each.kind == "reading") == (cause.kind == "reading")]
    return len(alike) < (max(SPARED * readings, 1) if cause.kind == "reading" else MOST)


def _weighed(previous: Recalibration, updated: Calibration, released: Sequence[str]) -> tuple[tuple[Cause, ...], Fit]:
    """Return all causes with their evidence, and how well readings and prior fit without them."""
    model = updated.program.model
    misfit = previous.misfit(model, updated.program.penalty_form or identity(len(updated.x)))
    labels: dict[int, list[str]] = {}  # a configuration may have been measured wrongly
    for part in updated.problem.rows():
        for label, configuration in zip(part.data.label, part.data.configuration, strict=True):
            labels.setdefault(int(configuration), []).append(label)
    readings = [Reading(tuple(names), np.flatnonzero(model.group == number)) for number, names in labels.items()]
    free = updated.problem.parameters.free
    widths = previous.widths(updated.problem) / free.scale
    return weigh(misfit, candidates(free, released), widths, readings), misfit.fit


def _require_this_robot(result: Calibration, updated: Calibration, data: Dataset) -> None:
    """Refuse readings that another unit or order explains, or further off than the robot ever was uncalibrated."""
    refuse_misread(result, data)
    before = float(np.nanmax(result.nominal_errors()))
    missed = float(np.sqrt(np.nanmean(updated.errors(data) ** 2)))
    if missed > STRANGE * before:
        robots = " and ".join(robot.name for robot in result.problem.arms.values())
        raise InputError(
            "the new measurements",
            f"readings {1e3 * missed:.3g} mm off, whatever is released",
            f"those of the same robot ({robots}) in the same units and instrument's frame, or --reset "
            "with what moved (base_*)",
        )


def _moved(result: Calibration, updated: Calibration, name: str) -> Moved:
    """Return by how much a parameter moved."""
    free = updated.problem.parameters.free
    i = free.names.index(name)
    spread = np.sqrt(result.covariance[i, i] + updated.covariance[i, i])
    nominal = result.problem.parameters.free.nominal[i]
    change = free.nominal[i] + updated.x[i] - nominal - result.x[i]
    return Moved(name, free.dimensions[i], float(change), float(spread))


def _record(result: Calibration, inflation: float, released: Sequence[str], left_out: Sequence[str]) -> Record:
    """Return the provenance of the new result: the previous one, by its digest, and those before it."""
    old = result.record
    digest = old.digest or content(result)["digest"]
    title = old.title or " and ".join(robot.name for robot in result.problem.arms.values())
    last = Earlier(
        title,
        old.made,
        digest,
        len(result.problem.labels),
        {robot: ranges.tolist() for robot, ranges in result.ranges.items()},
        inflation,
        tuple(released),
        tuple(left_out),
    )
    return Record(
        old.title,
        old.source,
        excluded=dict.fromkeys(left_out, "far from what the last calibration allows"),
        simulated=old.simulated,
        earlier=(*old.earlier, last),
    )
