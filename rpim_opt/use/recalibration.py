"""Recalibration with the previous result as prior: detection of changed parameters, and the new result."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations
from typing import Any, NamedTuple, cast

import numpy as np

from rpim_opt.basics.arrays import TINY, Array, rms, statistics
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.text import counted, joined, listed, table, three_digits
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.basics.units import display, printed
from rpim_opt.bayes.model_selection import deviations, named
from rpim_opt.bayes.prior import Prior
from rpim_opt.bayes.prior_terms import Statement, default_widths, nested
from rpim_opt.calibration.held_out import displacement, registered, registration
from rpim_opt.calibration.identify import calibrate
from rpim_opt.calibration.lack_of_fit import TOGETHER, judged
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import held_out_errors
from rpim_opt.calibration.verdict import refuse_misread
from rpim_opt.convex.constraints import matching
from rpim_opt.convex.expressions import SQUARES
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.quadratic import Quadratic, identity
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.record import Earlier, Fit, HeldOut, Record
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.causes.positions import other_places, other_rows
from rpim_opt.problem.causes.residuals import NOTICED, shown_by_residuals
from rpim_opt.problem.causes.rows import FEWEST, first
from rpim_opt.problem.linear import RANK_TOLERANCE, LinearModel
from rpim_opt.problem.multi_robot import identifying_sessions
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.chain import placed, same_place
from rpim_opt.robot.kinematics import FRAME, frame_numbers
from rpim_opt.robot.mdh import numbered
from rpim_opt.robot.parameters import (
    Parameters,
    of_session,
    reflectors,
    session_prefix,
    tool_prefix,
)
from rpim_opt.store.result_file import content
from rpim_opt.use.compensation import tool_uncertainty
from rpim_opt.use.sessions import base_frame, registered_again

FALSE_ALARM = 0.01  # false-alarm probability over all causes for a robot that did not change or drift
MULTIPLES = (1.0, 3.0, 10.0, 30.0)  # of a deviation's prior width: possible changes, equally likely
UNCHANGED = 0.5  # prior probability of no change; the other half is divided among the kinds of causes in use
OUTLIER_WIDTH = 10.0  # standard deviations of an outlier, times `MULTIPLES`
UNOBSERVABLE = 1e-9  # relative eigenvalue below which readings do not observe a direction of a change
STAYING = 1e-2
"""Change by an update, in scales, of combinations of parameters that no configuration shows, and the least part of one,
beside released parameters, that is kept constant."""
MOST = 4  # most successive changes of robot and frames: with more it is another robot
FEW = 1  # more changes than this may be one of a link
LINK = -10.0  # added to ln of a link's prior probability: a frame moves more often, and is nearly explained by one
SPARED = 0.25  # largest share of wrong readings
STRANGE = 5.0  # error over that before any calibration, above which unexplained readings are of another robot
VAGUE = 0.5  # of the standard deviation of a changed parameter's prior, above which nothing determines its change
RIVAL, AS_GOOD = 0.05, 4.0  # of a further cause to be named: probability, or chi-squared above the best
SHOWN = 5  # number of causes shown
BASE, PLACE = "base_", 0.1
"""Scale of a session's offset [m, rad] above which its place is unknown: then a new session is registered."""
OF_ROBOT = ("robot_serial", "controller")  # details of a record that are kept when the robot is measured again
OF_EARLIER = " (of the earlier calibration)"  # after details of the earlier record that new ones do not replace
UPDATED, BEFORE = " (updated)", "; of the earlier calibration: "  # in title and source of an updated calibration


class Cause(NamedTuple):
    """A change that may explain the deviation of readings from their predictions."""

    name: str
    kind: str  # joint offset or offsets, parameter, link, frame, transmission error, reading
    members: tuple[str, ...]  # parameters, or rows
    gain: float = 0.0  # decrease of chi-squared
    p_value: float = 1.0  # of that decrease without a change
    probability: float = 0.0  # posterior

    def __str__(self) -> str:
        """Return its kind and name, a link by its name."""
        return f"{self.kind} {self.name}".removeprefix("link ")


Weighed = tuple[tuple[Cause, ...], Fit]
"""All causes with their evidence, the most probable first, and the fit of all equations."""


class Moved(NamedTuple):
    """Change of a parameter, and its standard deviation [SI]."""

    name: str
    dimension: str
    change: float
    std: float

    def __str__(self) -> str:
        of = self.content()
        return f"{self.name} {of['change']:+.4g} {printed(of['unit'])} (standard deviation {of['std']:.2g})"

    def content(self) -> dict[str, Any]:
        """Return it as a document [mm, deg]."""
        unit, si = display(self.dimension)
        return {"name": self.name, "unit": unit, "change": self.change / si, "std": self.std / si}


@dataclass(frozen=True, eq=False)
class Update:
    """A recalibration with the previous result as prior.

    ``result`` is the calibration, whose record has the previous one; ``before`` and ``after`` are the fits of the
    ``readings`` (their number) to the previous one, without and with changes. ``changes`` are changed parameters and
    frames and wrong readings, which were left out, in the order of discovery; ``causes`` are all possible changes with
    their evidence before any release, the most probable first; ``moved`` are the movements of released parameters.
    ``errors`` [mm] are those of both calibrations on the readings used, and on held-out rows of the previous one if
    nothing was released. ``registered`` states that instrument or base moved so far that the base was registered again;
    otherwise empty. ``undetermined`` are released parameters and frames, and new frames, that the new rows determine
    worse than their prior, and changes below twice their standard deviation.
    """

    result: Calibration
    before: Fit
    after: Fit
    changes: tuple[Cause, ...]
    causes: tuple[Cause, ...]
    moved: tuple[Moved, ...]
    readings: int
    errors: Mapping[str, Mapping[str, Any]]
    registered: str = ""
    undetermined: tuple[str, ...] = ()

    @property
    def changed(self) -> bool:
        """Whether the robot or one of its frames changed."""
        return any(cause.kind != "reading" for cause in self.changes)

    @property
    def explained(self) -> bool:
        """Whether readings and the previous calibration agree, apart from the changes."""
        return self.after.likely

    @cached_property
    def lacking(self) -> str:
        """A sentence on an effect that new rows show and the model lacks, with the remedy; empty if there is none."""
        if not (fit := judged(self.result)):
            return ""
        return " ".join(line for line in fit.sentences() if TOGETHER in line)

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
            "undetermined": self.undetermined,
            "errors": self.errors,
            "lacking": self.lacking,
            "converged": self.result.converged,
            "verdict": self.result.verdict.content(),
            "earlier": [each._asdict() for each in self.result.record.earlier],
        }

    def _alternatives(self) -> str:
        """Return a sentence on other changes that the readings do not distinguish from those found; empty if none."""
        if not self.changes:
            return ""
        best, of_changes = self.changes[0], {cause.name for cause in self.changes}
        named = as_good(best, self.causes[1:]) * self.changed
        rivals = [c for c in self.causes[1:] if c.name in named or (c.probability > RIVAL and not contains(c, best))]
        rivals = [c for c in rivals if c.name not in of_changes]
        if not rivals:
            return ""
        remedy = "measure more."
        for frame in [cause for cause in rivals if cause.kind == "frame"][:1]:
            pattern = frame.name.replace("all reflectors", "tool")
            moved = "reflector was exchanged" if "tool" in pattern else "instrument moved"
            remedy = f"if the {moved}, use --reset '{pattern}_*'."
        names = joined([cause.name for cause in rivals])
        return f"These readings do not distinguish this from a change of {names}: {remedy}"

    def __str__(self) -> str:
        count = f"{self.readings} readings"
        besides = " besides that of what was reset" * bool(self.result.record.earlier[-1].released)
        verdicts = {
            "The robot has changed. With the previous calibration": self.changed,
            "The robot has not changed, but readings are wrong. With the previous calibration": bool(self.changes),
            f"No change of the robot{besides} is detectable from {count}": self.before.likely,
            f"{count} contradict the previous calibration": True,
        }
        verdict = next(text for text, holds in verdicts.items() if holds)
        lines = [*filter(None, [self.registered]), f"{verdict}: {self.before}."]
        for cause in self.changes:
            figures = f"chi-squared falls by {three_digits(cause.gain)}, posterior probability {cause.probability:.2g}"
            lines.append(f"  {cause}: {figures}{', excluded' * (cause.kind == 'reading')}.")
        moved = [str(each) for each in self.moved if not (self.registered and each.name.startswith(BASE))]
        known = {each.name for each in self.moved}
        members = {name for cause in self.changes for name in cause.members} - known
        unknown = [f"; the readings do not determine {name}" for name in self.undetermined if name in members]
        if moved:
            lines.append(f"Changed since then: {joined(moved)}{''.join(unknown)}.")
        lines += filter(None, [self._alternatives()])
        if self.changes:
            lines.append(f"After these changes: {self.after}.")
        for name, of in self.errors.items():
            was, now = (f"{of[when]['rms_mm']:.4f} mm" for when in ("before", "after"))
            rows = counted(of["after"]["count"], f"{name} row")
            lines.append(f"RMS error on {rows}: {was} with the previous calibration, {now} with this one.")
        lines += filter(None, [self.lacking])
        rows = [[c.name, c.kind, three_digits(c.gain), f"{c.p_value:.2g}", f"{c.probability:.2g}"] for c in self.causes]
        head = ["may have changed", "kind", "chi-squared falls by", "p-value", "probability"]
        refused = [str(self.result.verdict)] * (not self.result.verdict.delivered)
        return "\n".join([*lines, *refused, "", table(head, rows[:SHOWN]), "", self.result.message])


@one_blas_thread
def update(
    result: Calibration,
    data: Dataset,
    *,
    prior_inflation: float = 1.0,
    reset: Sequence[str] = (),
    source: str = "New measurements",
    progress: Callable[[str], None] | None = None,
) -> Update:
    """Recalibrate a robot: the posterior of its previous calibration is the prior of this one.

    First the robot is tested for changes. While the change of one parameter or frame, or one wrong reading, decreases
    chi-squared by more than chance does in one robot of a hundred (over all possible changes), the most probable change
    is released: its parameters get a wide prior, beyond any crash, about their previous values; all others keep the
    posterior.

    The result has a squared penalty or none. ``data`` are new measurements of the same robot, in the same instrument's
    frame unless ``reset`` has patterns of parameters that the earlier result no longer describes, ``("base_*",)`` for a
    moved instrument (automatic if it moved far). ``prior_inflation`` is a factor on the earlier standard deviations, in
    case everything drifted a little; ``source`` names the origin of the data; ``progress`` is called with every step in
    words. InputError for a result without covariance (lasso), data in blocks, and readings that cannot be this robot's.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> first = ro.calibrate(problem.on(problem.data.take(np.arange(32))))
    >>> found = ro.use.update(first, problem.data.take(np.arange(32, 40)))
    >>> print(str(found).splitlines()[0])
    No change of the robot is detectable from 8 readings: chi-squared 25.9, 24 degrees of freedom, p-value 0.37.
    >>> [earlier.title for earlier in found.result.record.earlier], found.changes
    (['ABB IRB 120-3/0.58'], ())
    """
    say = progress or (lambda step: None)
    data = by_visit(data)
    problem = with_data(result, data)
    free = problem.parameters.free
    released = _reset(result, data, free, reset)
    say("comparing with the previous calibration")
    base = tuple(name for name in free.names if name.startswith(registration(free, data)))
    unplaced = _unplaced(result, problem)
    elsewhere = not (released or unplaced) and _base_elsewhere(result, problem, base, prior_inflation)
    released += base * elsewhere
    released += tuple(name for name in unplaced if name not in released)
    anywhere = bool(base) and {*base} <= {*released}  # a reset base is registered again
    start = None if anywhere else previous_deviations(result, problem)
    in_turn = partial(_in_turn, result, problem, released, prior_inflation, start, say)
    first, updated, released, changes, after = _fewest(in_turn)
    if not after.likely:
        _refuse_another_robot(result, updated, data, bool({*base} & {*released}))
    vague = _undetermined(updated, set(result.problem.parameters.free.names).difference(released))
    updated = _with_scales_of_motion(result, updated, released, prior_inflation)
    left_out = tuple(label for cause in changes if cause.kind == "reading" for label in cause.members)
    moved, unknown = _moved(result, updated, released, changes)
    unclear = {each.name for each in moved if abs(each.change) < 2 * each.std}
    vague += tuple(cause.name for cause in changes if unclear.issuperset(cause.members))
    last = Earlier(
        result.record.title or _robots(result), result.record.made, result.record.digest or content(result)["digest"],
        len(result.problem.labels), {robot: ranges.tolist() for robot, ranges in result.ranges.items()},
        prior_inflation, tuple(name for name in released if name not in unplaced), left_out,
        tuple(_unresolved(vague, bool(reset), after)),
    )  # fmt: skip
    held_out = None if {*released} - {*unplaced} else result.record.validation  # measured before a change
    figures, said = _errors(result, updated, held_out)
    registered = " ".join(filter(None, [_bases(result, updated, data) if anywhere else "", said]))
    updated = replace(updated, record=_carried_on(result.record, last, source, updated.record.opened))
    return Update(updated, first[1], after, changes, first[0], moved, len(data), figures, registered, vague + unknown)


def _unresolved(vague: Sequence[str], reset: bool, after: Fit) -> Iterator[str]:
    """Say what new rows do not determine, and that nothing explains them."""
    if vague:
        omit = ", or omit --reset if nothing was moved" * reset
        yield (
            f"The new rows do not determine {joined(vague)}: measure more configurations, at least three with the "
            f"reflector's positions not on a line{omit}."
        )
    if not after.likely:
        yield (
            "No small set of changed parameters, frames or readings explains the rest. Check that it is the same "
            "robot; if so, calibrate it without the previous result."
        )


Changed = tuple[Weighed, Calibration, tuple[str, ...], tuple[Cause, ...], Fit]
"""All causes and the fit before any release, the last calibration, its released parameters, the changes in the order of
discovery, and the fit after them."""


def _fewest(in_turn: Callable[[bool], Changed]) -> Changed:
    """Return the changes in turn; those with a link, of which several may be one, if they are fewer or alone likely."""
    found = in_turn(False)
    if len(found[3]) <= FEW and found[-1].likely:
        return found
    of_link = in_turn(True)
    fewer = len(of_link[3]) < len(found[3]) or not found[-1].likely
    return of_link if of_link[-1].likely and fewer else found


def _in_turn(
    result: Calibration,
    problem: CalibrationProblem,
    released: tuple[str, ...],
    inflation: float,
    start: Array | None,
    say: Callable[[str], None],
    bent: bool,
) -> Changed:
    """Release the most probable change, one after the other, until chance explains the rest."""
    reset, changes = released, list[Cause]()
    most = {"reading": max(SPARED * len(np.unique(problem.data.configuration)), 1), "link": 1}
    first: Weighed | None = None
    while True:
        updated = _recalibrated(result, problem, released, inflation, start)
        laid = cast(CalibrationProblem, updated.problem)
        causes, after = _weighed(result, laid, updated.x, updated.formulation, released, bent)
        first = first or (causes, after)
        # the most probable cause that chance does not explain, where a change is more probable than none
        changed = sum(cause.probability for cause in causes) > UNCHANGED
        cause = next((cause for cause in causes if changed and cause.p_value * len(causes) < FALSE_ALARM), None)
        alike = [each for each in changes if cause and (each.kind == "reading") == (cause.kind == "reading")]
        if cause is None or len(alike) >= most.get(cause.kind, MOST):
            return first, updated, released, tuple(changes), after
        say(f"releasing {cause.name}")
        changes.append(cause)
        problem = problem.with_parameters(updated.problem.parameters)  # with the base if it was registered
        if cause.kind == "reading":  # what changed is sought again without it, which two zeros may have explained
            problem, released = problem.without(set(cause.members)), reset
            changes = [each for each in changes if each.kind == "reading"]
        else:
            released += cause.members
        start = updated.x


def _reset(result: Calibration, data: Dataset, free: Parameters, reset: Sequence[str]) -> tuple[str, ...]:
    """Return the parameters that the earlier result does not describe; refuse the base beside sessions."""
    if not reset:
        return ()
    if any(map(of_session, free.names)) and (wrong := [each for each in reset if each.startswith(BASE)]):
        own = session_prefix(str(data.session[0]))
        known = any(name.startswith(own) for name in result.problem.parameters.free.names)
        accepted = f"'{own}*'" if known else "no --reset: a new session is registered by itself"
        raise InputError("update, reset", f"'{wrong[0]}', but every session has an offset of its own", accepted)
    return tuple(np.array(free.names)[matching(free, reset, "update, reset")].tolist())


def _refuse_another_robot(result: Calibration, updated: Calibration, data: Dataset, base_reset: bool) -> None:
    """Refuse readings that no change explains: of another robot, or read otherwise than those of the result."""
    refuse_misread(result, data)
    missed = rms(updated.errors(data))
    if missed > STRANGE * float(np.nanmax(result.nominal_errors())):
        same = f"those of the same robot ({_robots(result)}) in the same units"
        known = " and instrument's frame, or --reset with what moved (base_*)" * (not base_reset)
        several = len(data.sessions) > 1
        apart = f"; of several set-ups ({joined(data.sessions)}) one at a time" if several else ""
        found = f"errors of {1e3 * missed:.3g} mm, whichever parameters change"
        raise InputError("the new measurements", found, same + known + apart)


def _errors(
    result: Calibration, updated: Calibration, held_out: Dataset | None
) -> tuple[dict[str, dict[str, dict[str, float]]], str]:
    """Return statistics of the new and of held-out rows' errors before and after an update, and how to read them."""
    new = before = updated.problem.data
    said = ""
    if any(map(of_session, result.problem.parameters.free.names)) and {*new.session} - {*result.problem.data.session}:
        with suppress(InputError):  # few rows
            before, said = registered_again(result, new)
    rows = {"new": (before, new), "held-out": (held_out, held_out)}
    errors = {key: {"before": result.errors(a), "after": updated.errors(b)} for key, (a, b) in rows.items() if a and b}
    figures = {name: {when: statistics(of) for when, of in each.items()} for name, each in errors.items()}
    return {name: each for name, each in figures.items() if each["after"]["count"]}, said  # those with lengths


def _carried_on(record: Record, last: Earlier, source: str, opened: Array) -> Record:
    """Return the record of an updated calibration: of the earlier one what holds for the new measurements, too."""
    first_source = record.source.rpartition(BEFORE)[2]  # notes on a file belong to its own measurements
    return Record(
        title=f"{record.title.removesuffix(UPDATED)}{UPDATED}",
        source=BEFORE.join(filter(None, [source, first_source])),
        excluded=dict.fromkeys(
            last.excluded, "configuration far outside the prediction intervals of the earlier result"
        ),
        simulated=record.simulated,
        noise_assumed=record.noise_assumed,
        details={k: t.removesuffix(OF_EARLIER) + OF_EARLIER * (k not in OF_ROBOT) for k, t in record.details.items()},
        requirement=record.requirement,
        earlier=(*record.earlier, last),
        reading=record.reading,
        terms=record.terms,
        opened=opened,
    )


def _undetermined(updated: Calibration, known: Collection[str]) -> tuple[str, ...]:
    """Return the frames, but ``known`` ones, with a direction in which rows know less than the prior's scale."""
    free = updated.problem.parameters.free
    frames: dict[str, list[int]] = {}
    for i in np.flatnonzero(free.of_frames):
        if free.names[i] not in known:
            frames.setdefault(free.names[i].rpartition("_")[0], []).append(int(i))
    A = updated.program.model.A  # in standard deviations of the noise, by deviations in units of the scales
    return tuple(name for name, index in frames.items() if np.linalg.matrix_rank(A[:, index], tol=1.0) < len(index))


def _robots(result: Calibration) -> str:
    return " and ".join(robot.name for robot in result.problem.arms.values())


def _unplaced(result: Calibration, problem: CalibrationProblem) -> tuple[str, ...]:
    """Return the parameters of a new session whose scales say nothing of where it is."""
    free = problem.parameters.free
    wide = np.array(free.names)[prior_widths(result, problem) >= PLACE].tolist()
    return tuple(name for name in wide if of_session(name) and name not in result.problem.parameters.free.names)


def _base_elsewhere(result: Calibration, problem: CalibrationProblem, base: tuple[str, ...], inflation: float) -> bool:
    """Return whether readings are displaced together and put the ``base``, by its parameters, out of its place."""
    # evidence is linear in the deviations: invalid for a large rotation of the base
    data = problem.data
    if not base or not displacement(result, data, held_out_errors(result, data))[0]:
        return False
    return not same_place(*_base_before_and_now(result, _recalibrated(result, problem, base, inflation, None), data))


def _base_before_and_now(result: Calibration, updated: Calibration, data: Dataset) -> list[Array]:
    """Return the place of the base, (6,) each, by two results."""
    session = str(data.session[0]) * (registration(updated.problem.parameters.free, data) != BASE)
    return [np.array(frame_numbers(base_frame(each, "", session))) for each in (result, updated)]


def _bases(result: Calibration, updated: Calibration, data: Dataset) -> str:
    """Say where the base is and was."""
    was, now = map(placed, _base_before_and_now(result, updated, data))
    place = registration(updated.problem.parameters.free, data)
    return (
        f"The instrument or the base moved: in the instrument's frame the base is at {now}, previously at {was}. It "
        f"was registered again (--reset '{place}*')."
    )


def _with_scales_of_motion(
    result: Calibration, updated: Calibration, released: tuple[str, ...], inflation: float
) -> Calibration:
    """Return the update with the scales of released frames enlarged to their distances from nominal.

    A reset base is far beyond its scale, which later tests would take for a deviation of the robot.
    """
    p = updated.problem.parameters
    distance = p.scale.copy()
    distance[p.identified] = np.abs(updated.x)
    farther = np.isin(p.names, released) & p.of_frames & (distance > p.scale)
    if not farther.any():
        return updated
    problem = cast(CalibrationProblem, updated.problem)
    problem = problem.with_parameters(replace(p, scale=np.where(farther, distance, p.scale)))
    return _recalibrated(result, problem, released, inflation, updated.x)


def moved_or_changed(result: Calibration, data: Dataset, held: HeldOut) -> tuple[str, str]:
    """Return the sentences of `displacement`, or the change of the robot that leaves clearly less chi-squared.

    That is less by `AS_GOOD`, of new measurements and prior together, than after registration and with another base. A
    change between the measurements has priority, unless one before all of them leaves no more than the noise.
    """
    between = _between_rows(result, data)
    moved = displacement(result, data, held)
    place = registration(result.problem.parameters.free, data)
    placed_by = {place + axis for axis in FRAME} <= set(result.problem.parameters.free.names)
    likely = moved[0] and f"Likely: the instrument or the base moved. {moved[0]}", moved[1]
    if not any((between, *moved)) or not placed_by or result.known_covariance is None or not result.problem.keeps_rows:
        return (between, "") if between else likely
    causes, fit = _changes(result, data)
    again, registered_fit = _changes(result, registered(result, data)[0])
    best, *others = [cause for cause in causes if cause.kind != "reading"]
    base = next(cause for cause in again if cause.members[0].startswith(place))
    left, motion = fit.squares - best.gain, registered_fit.squares - base.gain
    if between and left > NOTICED**2 * (fit.equations - len(best.members)):
        return between, ""
    rivals = as_good(best, others)
    if motion - left <= AS_GOOD:
        alone = best.members[0].startswith(place) and not rivals
        return likely if alone or left - motion > AS_GOOD else moved
    return (
        f"Likely: {', or '.join([best.name, *rivals])} changed: that leaves chi-squared {three_digits(left)} with "
        f"{fit.equations - len(best.members)} degrees of freedom, a motion of the instrument or the base "
        f"{three_digits(motion)} with {fit.equations - len(base.members)}. Recalibrate by `update`; --register would "
        "hide the change."
    ), ""


def _between_rows(result: Calibration, data: Dataset) -> str:
    """Say what changed, or is otherwise, from some measurements to others, as of a calibration's; empty elsewhere."""
    if not result.problem.keeps_rows or len(result.problem.arms) > 1:
        return ""
    with suppress(InputError):  # a common motion is no change; few or collinear positions determine none
        data = registered(result, data)[0]
    held = held_out_errors(result, data)
    if np.count_nonzero(held.sigmas > held.allowed) < FEWEST:  # outliers
        return ""
    problem = with_data(result, data)
    residuals = shown_by_residuals(problem, previous_deviations(result, problem))
    problem = replace(problem, robots=result.robot)
    said = first(residuals, other_places(problem), other_rows(problem))
    return f"Likely: {said[0]}" if said else ""


def _changes(result: Calibration, data: Dataset) -> Weighed:
    """Return all that may have changed before new measurements, as of `_weighed`, at the previous deviations."""
    problem = with_data(result, data)
    x, prior = previous_deviations(result, problem), posterior_as_prior(result, problem)
    return _weighed(result, problem, x, prior, (), bent=True)


def _moved(
    result: Calibration, updated: Calibration, released: Sequence[str], changes: Sequence[Cause]
) -> tuple[tuple[Moved, ...], tuple[str, ...]]:
    """Return the movements of released parameters, and the names of those that are less known than by their prior.

    Curves' coefficients are left out; the movements of reset parameters are from both results.

    For changed parameters the uncertainty common to both results does not count, but in proportion to the motion of a
    frame: if position and orientation in which it is stated are off by s and w, a motion by t and f appears off by
    w x t + f x s, and its rotation by w x f. A reflector is measured itself, wherever it is: without s.
    """
    free = updated.problem.parameters.free
    wide = MULTIPLES[-1] * prior_widths(result, updated.problem)
    curves = np.array(free.names)[free.of_curves].tolist()
    # deviations of a registered frame refer to another orientation, values do not
    was, now = (each.problem.parameters.by_name(each.x) for each in (result, updated))

    changed = [n for cause in changes if cause.kind != "reading" for n in cause.members if n not in curves]
    reset = [name for name in released if name not in changed]
    moved: list[Moved] = []
    for name in [name for name in reset if name in result.problem.parameters.free.names and name not in curves]:
        i = free.names.index(name)
        std = np.sqrt(result.covariance[i, i] + updated.covariance[i, i])
        change = now[name] - was[name]
        if free.dimensions[i] == "angle":
            change = np.angle(np.exp(1j * change))
        moved.append(Moved(name, free.dimensions[i], float(change), float(std)))
    if not changed:
        return _known(moved, changed, free, wide)
    index = [free.names.index(name) for name in changed]
    penalty = penalty_of(posterior_as_prior(result, updated.problem, reset), len(free))
    misfit = Misfit(result, updated.problem.linearize(updated.x), penalty)
    g, G = misfit.projected(slice(misfit.m), misfit.A[:, index])
    # what nothing determines stays within its prior
    inverse = np.linalg.inv(G + np.diag((free.scale[index] / wide[index]) ** 2))
    covariance = free.scale[index, None] * inverse * free.scale[index]
    change, std = covariance @ (g / free.scale[index]), np.sqrt(np.diag(covariance))
    frames = np.array(
        [name.rpartition("_")[0] * bool(free.of_frames[i]) for name, i in zip(changed, index, strict=True)]
    )
    turns = np.array(free.dimensions)[index] == "angle"
    common = np.sqrt(np.diag(updated.covariance)[index])
    for frame in {*frames} - {""}:
        own = frames == frame
        at, turning = own & ~turns, own & turns
        t, f, s = (np.linalg.norm(each) for each in (change[at], change[turning], common[at]))
        s *= not frame.rpartition(".")[2].startswith("tool")
        w = np.linalg.norm(common[turning]) if turning.any() else _turned(updated, frame)
        std[at], std[turning] = np.hypot(std[at], np.hypot(w * t, f * s)), np.hypot(std[turning], w * f)
    rows = zip(changed, index, change.tolist(), std.tolist(), strict=True)
    moved += [Moved(name, free.dimensions[i], d, s) for name, i, d, s in rows]
    return _known(moved, changed, free, wide)


def _known(
    moved: Sequence[Moved], changed: Sequence[str], free: Parameters, wide: Array
) -> tuple[tuple[Moved, ...], tuple[str, ...]]:
    """Return the movements that are better known than by the wide prior (n,) [SI], and the names of the others."""
    widest = dict(zip(free.names, wide.tolist(), strict=True))
    known = tuple(each for each in moved if each.std < (VAGUE if each.name in changed else 1) * widest[each.name])
    return known, tuple(each.name for each in moved if each not in known)


def _turned(result: Calibration, frame: str) -> float:
    """Return the largest standard deviation [rad] of the flange, in whose frame a reflector is stated; else zero."""
    robot, _, own = frame.rpartition(".")
    q = next(block.q[:, 0] for block in result.problem.sample().data.blocks if block.robot == robot)
    marker = own.removeprefix("tool").removeprefix("_")
    return float(tool_uncertainty(result, q, None, marker, robot)[1].max()) if own.startswith("tool") else 0.0


def penalty_of(formulation: Formulation, n: int) -> Quadratic:
    """Return the quadratic form of n deviations that a formulation penalizes."""
    form: Quadratic | None = getattr(formulation.penalty, "quadratic", None)
    return form or identity(n)


# --- the previous result as a prior ------------------------------------------------------------------------


def by_visit(data: Dataset, visit: np.ndarray | None = None) -> Dataset:
    """Return checks with one configuration number per visit (N,): a return to a place is another configuration.

    Without ``visit``, runs of equal configurations are visits.
    """
    if visit is None:
        visit = np.cumsum(np.diff(data.configuration, prepend=data.configuration[0]) != 0)
    keys = [visit, data.configuration, np.unique(data.session, return_inverse=True)[1]]
    return replace(data, configuration=np.unique(np.stack(keys), axis=1, return_inverse=True)[1].ravel())


def with_data(result: Calibration, data: Dataset) -> CalibrationProblem:
    """Return a result's problem with other measurements; new sessions are appended."""
    problem = result.problem
    if not isinstance(problem, CalibrationProblem):
        raise InputError("the result", "a calibration of data in blocks", "one of measurements in memory")
    known = reflectors(problem.parameters.names)
    for marker in [marker for block in data.blocks for marker in block.markers if marker and marker not in known]:
        accepted = f"{choices(marker, known)}; of a new reflector the name of one before, and --reset 'tool_NAME_*'"
        raise InputError("column marker", f"'{marker}'", accepted)
    return identifying_sessions(problem.on(data))


def previous_deviations(result: Calibration, problem: Source) -> Array:
    """Return the result's deviations (n,) [SI] of a problem's parameters, zero where it does not know them."""
    return deviations(problem, named(result.problem, result.x))


def posterior_as_prior(
    result: Calibration, problem: Source, released: Sequence[str] = (), inflation: float = 1.0
) -> Formulation:
    """Return the result's loss and constraints with its posterior as penalty, wide for the released parameters."""
    free = problem.parameters.free
    x = previous_deviations(result, problem)
    widths = prior_widths(result, problem)
    known = set(result.problem.parameters.free.names)
    centre, scale = {}, {}
    for i, name in enumerate(free.names):
        if name in released or name not in known:
            unit, si = display(free.dimensions[i])
            centre[f"{name}_{unit}"] = float(x[i]) / si
            # so wide that readings decide; of a new session at least as stated: few showed their scatter
            width = MULTIPLES[-1] * widths[i] if name in released else max(widths[i], free.scale[i])
            scale[f"{name}_{unit}"] = float(width) / si
    prior = Prior(centre=centre, scale=scale)
    if len(released) < len(free):
        without = tuple(name for name in released if name in known)
        # in units of the declared noise, like the new readings: weight 1 then combines both
        prior = Prior.from_result(result, inflation, without, noise=1.0) & prior
    rows = _staying(result, problem, x, released)
    if len(rows):
        values = tuple((rows @ x).tolist())
        prior = prior & Prior(statements=(Statement(free.names, free.dimensions, nested(rows), values),))
    plain = replace(result.formulation, penalty=SQUARES, penalty_over=None)
    return prior.stated(problem.parameters, widened=False).penalized(plain)


def _staying(result: Calibration, problem: Source, x: Array, released: Sequence[str]) -> Array:
    """Return combinations (k, n) [1 / SI] of deviations at x (n,) [SI] that no configuration shows, to be kept.

    A rotation of the base and one of joint 1 form one: its posterior is as wide as the prior, and through curvature (a
    rotation by g moves points by g^2) new readings would fit their noise with it. Parameters except released ones and
    those of a new session are fixed, so that these take the change.
    """
    if not isinstance(problem, CalibrationProblem):
        return np.zeros((0, len(x)))
    free, data = problem.parameters.free, problem.data
    rng = np.random.default_rng(0)
    slopes = []
    for _ in range(-(-2 * len(free) // len(data))):
        blocks = tuple(replace(block, q=block.q + rng.uniform(-1, 1, block.q.shape)) for block in data.blocks)
        other = problem.on(replace(data, blocks=blocks))
        A = other.contrasts(other.jacobian(x)) * free.scale
        size = np.linalg.norm(A, axis=1, keepdims=True)  # in pixels, a point beside the camera dominates
        slopes.append((A / np.maximum(size, TINY))[np.isfinite(size[:, 0])])
    s, V = np.linalg.svd(np.vstack(slopes), full_matrices=False)[1:]
    kept = np.isin(free.names, result.problem.parameters.free.names) & ~np.isin(free.names, list(released))
    rows = V[s <= UNOBSERVABLE * s[0]] * kept
    s, V = np.linalg.svd(rows, full_matrices=False)[1:]
    return V[s > STAYING] / (STAYING * free.scale)


def _opened(C: Array, rows: Array) -> Array:
    """Return D (n, k), C + D D' = (C^-1 - R'R)^-1: the covariance (n, n) without the information of rows R (k, n)."""
    left, U = np.linalg.eigh(np.eye(len(rows)) - rows @ C @ rows.T)
    return C @ rows.T @ U / np.sqrt(np.maximum(left, RANK_TOLERANCE))


def prior_widths(result: Calibration, problem: Source) -> Array:
    """Return the prior standard deviations (n,) [SI] of a problem's parameters before any calibration."""
    free = problem.parameters.free
    if result.learned is None:
        return default_widths(free)
    stated = dict(zip(result.problem.parameters.free.names, result.learned.stated, strict=True))
    stated |= {name.rpartition("_")[2]: own for name, own in stated.items() if of_session(name)}  # also of new sessions
    keys = [name.rpartition("_")[2] if of_session(name) and name not in stated else name for name in free.names]
    scale = [stated.get(key, own) for key, own in zip(keys, free.scale, strict=True)]
    return default_widths(replace(free, scale=np.array(scale)))


def _recalibrated(
    result: Calibration, problem: CalibrationProblem, released: Sequence[str], inflation: float, start: Array | None
) -> Calibration:
    """Return the calibration of new readings; hyperparameters stay as they were estimated."""
    formulation = posterior_as_prior(result, problem, released, inflation)
    updated = calibrate(problem, formulation, 1.0, start=start)
    learned = result.learned
    if learned is not None:
        more = problem.parameters.free.scale[len(learned.stated) :]
        learned = replace(
            learned,
            left_out=(),
            notes=(),
            stated=np.append(learned.stated, more),
            local=np.append(learned.local, np.ones(len(more))),
            drift=np.zeros((len(updated.x), 0)),  # the prior contains the uncertainty of the scales
        )
    rows = _staying(result, problem, previous_deviations(result, problem), released)
    updated = replace(updated, learned=learned, calibrate_again=partial(calibrate, formulation=formulation, weight=1.0))
    fit = updated.fit_covariance  # in units of the noise that it finds
    opened = _opened(fit.covariance, rows / np.sqrt(fit.noise_variance * fit.linear.factor))
    return replace(updated, record=replace(updated.record, opened=opened))


# --- every parameter, frame and reading as a cause of a misfit ----------------------------------------------


class Misfit:
    """Deviations of new readings from their predictions, in standard deviations.

    With the readings' equations A z ~ b and the prior's L z ~ c, all in standard deviations, a change d of some
    deviations shifts only the prior, L (z - d) ~ c. With the residual e of both together, M = I - B (B'B)^-1 B', B =
    [A; L], and D = [0; L] restricted to the changed parameters::

        chi^2 = e' e        it falls by  g' G^-1 g,    g = D' e,    G = D' M D
    """

    def __init__(self, result: Calibration, model: LinearModel, prior: Quadratic, reset: Sequence[int] = ()) -> None:
        sigma = np.sqrt(result.variance_factor)
        self.noise_dof = result.noise_dof
        self.m = len(model.b)
        self.A = model.A / sigma
        self.L = prior.matrix / sigma
        B = np.vstack([self.A, self.L])
        y = np.concatenate([model.b / sigma, prior.c / sigma])
        U, s, _ = np.linalg.svd(B, full_matrices=False)
        self.Q = U[:, s > RANK_TOLERANCE * s[0]]
        self.e = y - self.Q @ (self.Q.T @ y)
        squares = float(self.e @ self.e)
        # degrees of freedom: readings minus parameters without a prior
        taken = int(np.linalg.matrix_rank(self.A[:, list(reset)])) if len(reset) else 0
        freedom = max(self.m - taken, 1)
        self.fit = Fit.of(squares, freedom, self.noise_dof)

    def projected(self, rows: slice | np.ndarray, values: Array) -> tuple[Array, Array]:
        """Return g (p,) and G (p, p) of a change, from the ``values`` of D in some rows and zeros in the others."""
        D = np.zeros((len(self.e), values.shape[1]))
        D[rows] = values
        along = self.Q.T @ D
        return D.T @ self.e, D.T @ D - along.T @ along

    def evidence(self, cause: Cause, g: Array, G: Array) -> Cause:
        """Return a cause with its gain and p-value."""
        s, U = np.linalg.eigh(G)
        observed = s > UNOBSERVABLE * max(float(s[-1]), 1.0)
        if not observed.any():
            return cause
        gain = float(np.sum((U[:, observed].T @ g) ** 2 / s[observed]))
        return cause._replace(gain=gain, p_value=Fit.of(gain, int(observed.sum()), self.noise_dof).probability)


def candidates(problem: Source, reset: Sequence[str] = (), bent: bool = False) -> list[Cause]:
    """Return the candidate changes: parameters, whole frames and whole transmission errors that were not reset.

    A motor that moves several joints shifts all their zeros, and a plate all measured reflectors; two motors may have
    been exchanged. With ``bent``, links are candidates, too: all six numbers between two joints, which explain most
    motions of a frame.
    """
    free, data = problem.parameters.free, problem.sample().data
    place, measured = registration(free, data), {tool_prefix(m) for block in data.blocks for m in block.markers}
    zeros = _zeros(problem)
    causes = []
    wholes: dict[tuple[str, str], list[str]] = {}
    for name, frame, curve in zip(free.names, free.of_frames, free.of_curves, strict=True):
        if name in reset or (of_session(name) and not name.startswith(place)):  # an earlier session has ended
            continue
        kinds = {"frame": frame, "transmission error": curve, "joint offset": name in zeros, "parameter": True}
        kind = next(kind for kind, holds in kinds.items() if holds)
        if frame or curve:
            wholes.setdefault((name.rpartition("_")[0], kind), []).append(name)
        else:
            causes.append(Cause(zeros.get(name, name), kind, (name,)))
    tools = [names for (name, kind), names in wholes.items() if kind == "frame" and f"{name}_" in measured]
    if len(tools) > 1:
        wholes["all reflectors", "frame"] = [name for names in tools for name in names]
    known = {*free.names} - {*reset}
    causes += [cause for cause in _of_arms(problem, zeros, bent) if {*cause.members} <= known]
    return causes + [Cause(*whole, tuple(names)) for whole, names in wholes.items()]


def _zeros(problem: Source) -> dict[str, str]:
    """Return the parameters that joint zeros are, and what they are called: with the joint's name, if it has one."""
    called = {}
    for which, arm in problem.arms.items():
        joints = dict(enumerate(arm.joint_names))
        for i, zero in enumerate(arm.zeros):
            name = problem.parameters.called(which, zero)
            called[name] = f"{name} ({joints[i]})" if joints.get(i) else name
    return called


def _of_arms(problem: Source, zeros: Mapping[str, str], bent: bool) -> Iterator[Cause]:
    """Yield motors that move several joints, two joint zeros, and if bent all numbers between two joints."""
    names = problem.parameters.free.names
    for pair in combinations([name for name in zeros if name in names], 2):  # two motors that were exchanged
        yield Cause(joined([zeros[name] for name in pair]), "joint offsets", pair)
    for which, arm in problem.arms.items():
        for motor, column in enumerate(arm.joint_map.T):
            moved = [problem.parameters.called(which, arm.zeros[k]) for k in np.flatnonzero(column)]
            if len(moved) > 1:
                yield Cause(f"motor {arm.joint(motor)} ({joined(moved)})", "joint offset", tuple(moved))
        for i in range(1, len(arm.mdh) * bent):
            own = [f"theta{i}", f"d{i}", f"beta{i}", *(f"{kind}{i + 1}" for kind in ("alpha", "a", "theta", "d"))]
            members = [name for name in (problem.parameters.called(which, each) for each in own) if name in names]
            if len(members) > 1:
                ends = [numbered(k, arm.joint_names) for k in (i - 1, i)]
                yield Cause(f"link between joints {joined(ends)}", "link", tuple(members))


def readings(problem: CalibrationProblem, model: LinearModel) -> Iterator[tuple[Cause, np.ndarray, Array]]:
    """Yield configurations, and rows of those with several, as causes: measured wrongly, all together or one alone.

    With a configuration's equations (k,), and directions (k, j) of the error in standard deviations.
    """
    data, owners = problem.data, problem.owners
    groups = {number: np.flatnonzero(model.group == number) for number in np.unique(data.configuration)}
    whitened = None
    if problem.touches is None:  # a unit error of every equation; configurations, which share no noise, together
        unit = np.zeros((len(owners), max(map(len, groups.values()))))
        for equations in groups.values():
            unit[equations, np.arange(len(equations))] = 1.0
        whitened = problem.whitened(unit)
    for number, equations in groups.items():
        rows = np.flatnonzero(data.configuration == number)
        labels = [data.label[row] for row in rows]
        yield Cause(listed(labels), "reading", tuple(labels)), equations, np.eye(len(equations))
        if len(rows) == 1 or whitened is None:
            continue
        for row, label in zip(rows, labels, strict=True):
            own = whitened[np.ix_(equations, np.flatnonzero(owners[equations] == row))]
            yield Cause(label, "reading", (label,)), equations, np.linalg.qr(own)[0]


def _weighed(
    result: Calibration,
    problem: CalibrationProblem,
    x: Array,
    prior: Formulation,
    released: Sequence[str],
    bent: bool = False,
) -> Weighed:
    """Return all causes with their evidence at x (n,) [SI], the most probable first, and how well all fits."""
    free = problem.parameters.free
    model = problem.linearize(x)
    misfit = Misfit(result, model, penalty_of(prior, len(x)), [free.names.index(name) for name in released])
    width = prior_widths(result, problem) / free.scale
    tried: list[tuple[Cause, tuple[Array, Array], Array]] = []  # with its change, and the change's widths
    for cause in candidates(problem, released, bent):
        index = [free.names.index(name) for name in cause.members]
        tried.append((cause, misfit.projected(slice(misfit.m, None), misfit.L[:, index]), width[index]))
    for cause, equations, errors in readings(problem, model):
        tried.append((cause, misfit.projected(equations, errors), np.full(errors.shape[1], OUTLIER_WIDTH)))
    causes = [misfit.evidence(cause, *change) for cause, change, _ in tried]
    posterior = log_priors(causes) + [log_bayes_factor(*change, widths) for _, change, widths in tried]
    whole = float(np.logaddexp.reduce(posterior, initial=np.log(UNCHANGED)))
    order = np.argsort(-posterior)
    weighed = [causes[i]._replace(probability=float(np.exp(posterior[i] - whole))) for i in order]
    return tuple(weighed), misfit.fit


def contains(one: Cause, other: Cause) -> bool:
    """Whether a cause has all members of another one."""
    return {*one.members} >= {*other.members}


def as_good(best: Cause, causes: Iterable[Cause]) -> list[str]:
    """Return the names of causes that leave as little chi-squared as the best one, a frame as a length along its axis.

    Those that contain it do not count, and links, which explain most motions of a frame.
    """
    rivals = [cause for cause in causes if cause.gain > best.gain - AS_GOOD and cause.kind != "link"]
    return list(dict.fromkeys(cause.name for cause in rivals if not contains(cause, best)))


def log_priors(causes: Sequence[Cause]) -> Array:
    """Return ln of the prior probabilities of causes (C,): equal for all kinds but links, and for causes of a kind."""
    kinds = [cause.kind for cause in causes]
    share = (1 - UNCHANGED) / len(set(kinds))
    return np.log([share / kinds.count(kind) for kind in kinds]) + [LINK * (kind == "link") for kind in kinds]


def log_bayes_factor(g: Array, G: Array, width: Array) -> float:
    """Return ln of the Bayes factor of a change, with standard deviations (p,) times each of `MULTIPLES`, against none.

    ::

        ln p(y | d ~ N(0, W^2)) / p(y | 0) = (g' (G + W^-2)^-1 g - ln det(I + W G W)) / 2
    """
    W = np.outer(MULTIPLES, width)
    inner = np.eye(len(g)) + W[:, :, None] * G * W[:, None, :]
    along = W * g
    squares = np.sum(along * np.linalg.solve(inner, along[:, :, None])[:, :, 0], axis=1)
    logs = (squares - np.linalg.slogdet(inner)[1]) / 2
    return float(np.logaddexp.reduce(logs) - np.log(len(MULTIPLES)))
