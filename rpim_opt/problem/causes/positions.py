"""What measured positions show with the nominal robot: rows, columns, frames and joint values that do not fit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import scipy
from scipy.special import bdtrc

from rpim_opt.basics.arrays import Array, rms
from rpim_opt.basics.text import joined, listed, three_digits
from rpim_opt.problem.causes.misreadings import BETTER, WRONG, better_interpretation
from rpim_opt.problem.causes.rows import (
    EXACT,
    FEW,
    FEWEST,
    LEAST_TRAVEL,
    OUTLYING,
    REACH,
    filled_rows,
    first,
    named_rows,
    rows_without_values,
)
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.closed_forms import transformed
from rpim_opt.problem.registration.points import FAR, Fit, Points, agreeing, fit_points, lengths_of, misfit, points_of
from rpim_opt.robot.kinematics import forward_kinematics

FAR_MOVED = 0.005
"""For points that fit better than this part of their extent, an instrument's motion is sought in residuals only."""
SINGLE = 1 / 3  # share of the rows up to which single ones have a joint value wrong
UNLIKELY = 1e-3  # probability with which outliers may agree on one joint by chance
UNRELATED = 0.25  # part of the spread of positions that a fit leaves where joint values do not explain them
FOLDED = 0.1  # part of its largest value below which the smallest one of a column without signs is near zero
NARROWER, GRID = 0.25, 61
"""Factor by which the grid for a joint's values gets narrower from round to round, and its points."""
FLAT_TURN = 0.05
"""Part of their distance by which two places of a reflector differ in height and radius, if a joint turned it."""
MOST_ROUNDS = 20  # of fitting one joint's values
COMPUTED = "were they computed, not measured? Leave them out ([exclude])."
MOSTLY = 2 / 3  # share of the rows from one to another that is of one kind, for a change to have come there
EXACT_TURN = 3e-5  # what no measured orientation comes up to [rad], nor a robot
LINEAR = 13  # coefficients of a coordinate by position and rotation of the flange


def single_rows(problem: CalibrationProblem) -> Iterator[str]:
    """Report what is wrong with single rows by themselves, from data in the order of the table."""
    yield from rows_without_values(problem.data, problem.arms)
    yield from filled_rows(problem.data)
    yield from exchanged_rows(problem)


def computed_columns(problem: CalibrationProblem) -> Iterator[str]:
    """Report coordinates or orientations that are exact functions of the nominal robot: computed, not measured.

    Coordinates of a point in any frame, for any reflector, are linear in position and rotation of the nominal flange.
    Orientations in any frame, for any tool, rotate by the same angle from row to row.
    """
    points = points_of(problem)
    if points is None or points.by_camera or len(points.row) < FEWEST:
        return
    T = forward_kinematics(points.robot, points.q)
    if points.turns is not None:
        angles = [
            scipy.spatial.transform.Rotation.from_matrix(R[1:] @ R[:-1].transpose(0, 2, 1)).magnitude()
            for R in (points.turns, T[:, :3, :3])
        ]
        apart = rms(angles[0] - angles[1])
        if apart < EXACT_TURN:
            agree = f"orientations agree with the nominal robot to {three_digits(1e3 * apart)} mrad"
            yield f"{agree}: were they computed, not measured? Use the positions alone (measurement = 'position')."
    if len(points.row) < 2 * LINEAR or len(points.tools) > 1:
        return
    X = np.column_stack([T[:, :3, 3], T[:, :3, :3].reshape(len(T), 9), np.ones(len(T))])
    left = points.y - X @ np.linalg.lstsq(X, points.y, rcond=None)[0]
    exact = np.sqrt(np.sum(left**2, axis=0) / (len(X) - LINEAR)) < np.minimum(EXACT, WRONG * points.y.std(axis=0))
    if exact.any() and not exact.all():
        named = joined([axis for axis, k in zip("xyz", exact, strict=True) if k])
        yield f"column {named} agrees with the nominal robot to {1e3 * EXACT:g} mm: was it computed, not measured?"


def exchanged_rows(problem: CalibrationProblem) -> Iterator[str]:
    """Report rows that fit the joint values, or the reflector, of another row."""
    points = points_of(problem)
    if points is None:
        return
    own, fit = agreeing(points)
    if 2 * own.sum() <= len(own):  # of many rows far off some are near any other by chance
        return
    label = [problem.data.label[i] for i in points.row]
    limit = FAR * float(np.median(fit.error[own]))
    far = np.flatnonzero(fit.error > limit)
    away = np.linalg.norm(points.y[far, None] - fit.modelled, axis=2)
    away[points.marker[far, None] != points.marker] = np.inf
    other = {
        int(i): int(j)
        for i, j, fits in zip(far, away.argmin(axis=1), away.min(axis=1), strict=True)
        if fits < min(BETTER * fit.error[i], limit)
    }
    pairs = [f"{label[i]} and {label[j]}" for i, j in other.items() if i < j and other.get(j) == i]
    if pairs:
        yield f"the measured values of rows {listed(pairs)} fit each other's joint values: exchange them."
    copied = [f"{label[i]} ({label[j]})" for i, j in other.items() if (points.y[i] == points.y[j]).all()]
    if copied:
        yield (
            f"rows {listed(copied)} have the measured values of the rows in brackets to the last digit, and do not "
            "fit their own joint values: were they pasted twice? Measure them again, or leave them out ([exclude])."
        )
    for by in (1, -1):
        shifted = [label[i] for i, j in other.items() if j - i == by]
        if len(shifted) >= FEWEST and len(shifted) > len(far) / 2:
            which = "next" if by > 0 else "previous"
            yield (
                f"the measured values of rows {listed(shifted)} fit the joint values of the {which} row: was a reading "
                "missed, or taken twice?"
            )
    if len(points.tools) < 2 or not len(far):
        return
    model = transformed((fit.base @ forward_kinematics(points.robot, points.q[far]))[:, None], fit.tools)
    error = np.linalg.norm(points.y[far, None] - model, axis=2)  # of every reflector, which the other rows place
    error[np.arange(len(far)), points.marker[far]] = np.inf
    swapped = points.row[far[error.min(axis=1) < np.minimum(BETTER * fit.error[far], limit)]]
    if len(swapped):
        which = named_rows(problem.data, swapped, "fits", "fit")
        yield f"{which} another reflector than the stated one (column marker): reflectors swapped?"


def unrelated_rows(problem: CalibrationProblem, error: float) -> Iterator[str]:
    """Report an RMS error [m] of a fit that is a large part of the spread of the positions."""
    points = points_of(problem)
    spread = 0.0 if points is None else float(np.sqrt(np.sum(np.var(points.y, axis=0))))
    if points is None or error <= UNRELATED * spread:
        return
    flange = float(np.sqrt(np.sum(np.var(forward_kinematics(points.robot, points.q)[:, :3, 3], axis=0))))
    yield (
        f"joint values hardly explain the measured positions (residual RMS {three_digits(1e3 * error)} mm, spread "
        f"{three_digits(1e3 * spread)} mm, that of the nominal flange {three_digits(1e3 * flange)} mm): do the rows of "
        "the two tables match, and are all joints' columns of one log? Join them by a common column, or by time. Or "
        "were deviations exported, not positions?"
    )


def odd_column(problem: CalibrationProblem) -> Iterator[str]:
    """Report a joint or coordinate whose values are wrong, else coordinates without a sign."""
    points = points_of(problem)
    if points is None or len(points.row) < 2 * FEWEST:
        return
    found = list(_odd_values(problem, points))
    unsigned = [axis for axis, k in zip("xyz", _unsigned(points.y), strict=True) if k]
    if not found and len(unsigned) > 1:  # the signs of one alone would be values that fit
        yield f"no value of columns {joined(unsigned)} is negative, and some are near zero: were signs lost?"
    yield from found


def _odd_values(problem: CalibrationProblem, points: Points) -> Iterator[str]:
    """Report a joint or coordinate with wrong values: if its values are free in every row, the rows fit.

    Base, reflectors and these values are fitted in turn, joint values on a successively finer grid.
    """
    points = replace(points, turns=None)
    whole = misfit(points)
    joints = range(points.robot.dof)
    fitted = {f"joint {points.robot.joint(i)}": replace(points, q=_values_that_fit(points, i)) for i in joints}
    for k, axis in enumerate("xyz"):
        other = points
        for _ in range(MOST_ROUNDS):
            other = replace(points, y=np.where(np.arange(3) == k, fit_points(other).modelled, points.y))
        fitted[f"coordinate {axis}"] = other
    left = {column: misfit(each) for column, each in fitted.items()}
    least = min(left, key=left.__getitem__)
    if left[least] >= min(BETTER * whole, WRONG):  # free values take up much of any other mistake
        return
    best = fitted[least]
    column = " or ".join(each for each in left if left[each] < 2 * left[least])
    apart = np.abs(np.angle(np.exp(1j * (best.q - points.q)))).max(axis=1) > LEAST_TRAVEL["revolute"] / 2
    apart |= np.abs(best.y - points.y).max(axis=1) > WRONG * points.extent
    if not apart.any():  # small errors of all rows
        return
    what = f"{named_rows(problem.data, points.row[apart], 'has', 'have')} wrong values of {column}"
    if apart.sum() > len(apart) / 2:
        what = f"the values of {column} explain nothing (sorted, copied, shuffled, without signs, another quantity?)"
    yield (
        f"{what}: with fitted values the points agree to {three_digits(1e3 * left[least] * points.extent)} mm instead "
        f"of {three_digits(1e3 * whole * points.extent)} mm; check the column."
    )


def _unsigned(values: Array) -> np.ndarray:
    """Return which columns of values (N, k) have none below zero, and some near it."""
    low, high = values.min(axis=0), values.max(axis=0)
    return (low >= 0) & (low < FOLDED * high)


def _values_that_fit(points: Points, joint: int, known: Fit | None = None) -> Array:
    """Return joint values (N, dof) with those of one joint fitted, together with base and reflectors unless ``known``.

    They are within pi [rad, m].
    """
    q, width = points.q, np.pi
    around: Any = 0.0
    for _ in range(MOST_ROUNDS):
        fit = known or fit_points(replace(points, q=q))
        tries = np.repeat(q[:, None], GRID, axis=1)
        tries[..., joint] = around + width * np.linspace(-1, 1, GRID)
        frames = fit.base @ forward_kinematics(points.robot, tries.reshape(-1, q.shape[1]))
        modelled = transformed(frames, np.repeat(fit.tools[points.marker], GRID, axis=0))
        error = np.linalg.norm(points.y[:, None] - modelled.reshape(len(q), GRID, 3), axis=2)
        chosen = tries[np.arange(len(q)), error.argmin(axis=1)]
        if width < np.pi or np.array_equal(chosen, q):
            around, width = chosen[:, [joint]], width * NARROWER
        q = chosen
    return q


def better_interpretations(problem: CalibrationProblem, most: float = np.inf) -> list[str]:
    """Return better explanations of a table: other frames or another interpretation of some rows, or of all.

    If half of the rows agree with the nominal robot, another interpretation of the others is sought first. One of all
    rows has nominal errors of at most ``most`` [m], or of a robot's part of the points' extent.
    """
    points = points_of(problem) or lengths_of(problem)
    if points is None:
        return []

    def of_all() -> Iterator[str]:
        better = better_interpretation(problem)
        if better is not None and better.left <= max(most, REACH * points.extent):  # the arm's unit may be wrong
            yield better.sentence

    both = [of_all(), other_rows(problem)]
    return first(other_places(problem), *(both[::-1] if 2 * agreeing(points)[0].sum() > len(points.row) else both))


def other_places(problem: CalibrationProblem) -> Iterator[str]:
    """Report rows that fit another base, anchor or reflector: one that was moved, exchanged or not named."""
    points = points_of(problem) or lengths_of(problem)
    if points is None or len(points.row) < 2 * FEWEST:
        return
    if (
        points.turns is not None and not points.by_camera
    ):  # in two frames orientations contradict each other more than positions
        points = replace(points, turns=None)
    parts, rest, exact = _stations(points)
    if exact:
        yield from computed_rows(problem.on(problem.data.take(points.row[parts[-1][0]])))
        return
    if len(parts) < 2 or len(rest) > len(points.row) / OUTLYING:
        return
    in_turn = all(len(part) > MOSTLY * (np.ptp(part) + 1) for part, _ in parts)
    if len(points.tools) > 1 and not in_turn:  # their names may be exchanged
        return
    (_, first), *others = sorted(parts, key=lambda each: each[0][0])
    for part, fit in others:
        where = named_rows(problem.data, points.row[part], "fits", "fit")
        if in_turn:
            where = f"from about row {problem.data.label[points.row[part[0]]]} on the points fit"
        other, joint = _other_place(points, first, fit, len(problem.data.sessions) > 1)
        if in_turn or joint != 1:  # no base moves to and fro about the first axis
            yield f"{where} another {other}."


def computed_rows(problem: CalibrationProblem) -> Iterator[str]:
    """Report rows that fit no others and agree with the nominal robot more closely than any measurement."""
    points = points_of(problem) or lengths_of(problem)
    if points is None or points.by_camera or len(points.row) < FEWEST:
        return
    own, fit = agreeing(points)
    exact = rms(fit.error[own])
    if own.sum() >= FEWEST * (1 + points.lengths) and exact < EXACT:
        which = named_rows(problem.data, points.row[own], "agrees", "agree")
        yield f"{which} with the nominal robot to {three_digits(1e3 * max(exact, 1e-6))} mm: {COMPUTED}"


def _stations(points: Points) -> tuple[list[tuple[np.ndarray, Fit]], np.ndarray, bool]:
    """Return groups of rows that agree among themselves, the rest, and whether the last group was computed."""
    whole = rms(agreeing(points)[1].error)
    parts: list[tuple[np.ndarray, Fit]] = []
    rest = np.arange(len(points.row))
    while whole >= FAR_MOVED * points.extent and len(rest) >= FEWEST:
        own, fit = agreeing(points.take(rest) if parts else points)
        part = rest[own]
        if len(part) < FEWEST or rms(fit.error[own]) >= min(BETTER * whole, WRONG * points.take(part).extent):
            break
        parts.append((part, fit))
        rest = rest[~own]
        if rms(fit.error[own]) < EXACT:
            return parts, rest, True
    return parts, rest, False


def _other_place(points: Points, first: Fit, second: Fit, sessions: bool) -> tuple[str, int | None]:
    """Return which place of the second fit is another one than in the first, and the joint that may be off instead."""
    reflectors = float(np.linalg.norm(second.tools - first.tools, axis=1).max())
    if points.lengths:
        far = float(np.linalg.norm(second.base[:3, 3] - first.base[:3, 3]))
        remedy = "name the anchor of every row in a column `fixture` of the raw table (rpim-opt new)"
        other, what = "anchor", f"the anchor or the robot's base moved; {remedy}"
        joint, places = 1, np.zeros((0, 2, 3))
    else:  # the second part's points in the robot's frame, by either base
        backs: Any = np.linalg.inv(np.stack([first.base, second.base]))
        joint, places = 1, transformed(backs, second.modelled[:, None])
        far = float(np.linalg.norm(places[:, 1] - places[:, 0], axis=1).mean())
        remedy = "name both parts in a column `session` of the raw table (rpim-opt new registers each), or calibrate "
        remedy += "one and add the other to its result with `update --reset 'base_*'`"
        if sessions:  # of one place, unless they are said to be apart
            remedy = "if it did between sessions, identify `session_*` in place of `base_*`, "
            remedy += "with session_mm = 1000 and session_mrad = 1000 in [scale]"
        other, what = "base", f"the instrument or the robot's base moved; {remedy}"
    if reflectors > far:
        far, joint, places = reflectors, len(points.robot.mdh), np.stack([first.tools, second.tools], axis=1)
        remedy = "name the reflector of every row in a column `marker` of the raw table (rpim-opt new)"
        other, what = "reflector", f"the reflector was exchanged; {remedy}"
    said = f"{other}, {three_digits(1e3 * far)} mm away: {what}"
    round_axis = np.stack([np.linalg.norm(places[..., :2], axis=2), places[..., 2]])
    if np.abs(np.diff(round_axis, axis=2)).max(initial=0.0) < FLAT_TURN * far and len(places):
        turn = np.angle(np.exp(1j * np.diff(np.arctan2(places[..., 1], places[..., 0]), axis=1)).mean())
        return f"{said}, or correct joint {joint}, which may be {abs(np.degrees(turn)):.0f} deg off in them", joint
    return said, None


def other_rows(problem: CalibrationProblem) -> Iterator[str]:
    """Report the row from which on, or rows in which, another interpretation or other values of one joint fit."""
    points = points_of(problem) or lengths_of(problem)
    if points is None or len(points.row) < 2 * FEWEST:
        return
    own, fit = agreeing(points)
    near, extent = rms(fit.error[own]), points.take(np.flatnonzero(own)).extent
    if near >= min(BETTER * rms(fit.error), WRONG * extent):
        return
    wrong = np.cumsum(~own) - ~own  # before each row
    start = int(np.argmin(2 * wrong - np.arange(len(wrong))))  # fewest rows that are on the wrong side of it
    out = np.flatnonzero(~own)
    together = len(out) > MOSTLY * (np.ptp(out) + 1)  # a joint that slipped is seen in residuals
    some, least, where = points.take(out), 2 * FEWEST, ""  # scattered rows were chosen by their errors
    if wrong[start] < 2 * FEWEST and own[start:].mean() < 1 - MOSTLY:
        some, least = points.take(np.arange(start, len(own))), FEWEST
        where = f"from about row {problem.data.label[some.row[0]]} on"
    several = 2 * len(np.unique(some.y, axis=0)) > len(some.row)  # any model fits one point many times
    if len(some.row) >= least and several and misfit(some) >= FAR * near / extent:
        if not (where or together or points.lengths) and (_unsigned(points.q).any() or _unsigned(points.y).any()):
            odd = list(_odd_values(problem, points))  # of which the rows of one sign fit otherwise, too
            if odd:
                yield from odd
                return
        better = better_interpretation(problem.on(problem.data.take(some.row)), whole=False)
        if better is not None:
            where = where or named_rows(problem.data, some.row, "fits if read otherwise:", "fit if read otherwise:")
            yield f"{where} {better.sentence}"
            return
    if not together and len(out) <= SINGLE * len(own) and not points.lengths and points.turns is None:
        yield from _turned_joint(problem, points.take(out), fit, FAR * float(np.median(fit.error[own])))


def _turned_joint(problem: CalibrationProblem, out: Points, fit: Fit, limit: float) -> Iterator[str]:
    """Report rows beyond a limit [m] of a fit to the others that another value of one joint explains."""
    if len(out.row) < FEW:
        return
    away = np.linalg.norm(out.y - _modelled(out, fit), axis=1)
    # a joint reaches a random error of size E to within the limit with probability 1 - sqrt(1 - (limit / E)^2)
    reached = float(np.mean(1 - np.sqrt(1 - np.minimum(limit / away, 1) ** 2)))
    best = max(FEW, len(out.row) / 2) - 1
    said = ""
    for i in np.flatnonzero(np.array(out.robot.joint_dimensions) == "angle"):
        q = _values_that_fit(out, int(i), fit)
        explained = np.linalg.norm(out.y - _modelled(replace(out, q=q), fit), axis=1) < limit
        chance = bdtrc(explained.sum() - 1, len(explained), reached) * out.robot.dof
        if explained.sum() > best and chance < UNLIKELY:
            best = explained.sum()
            named = named_rows(problem.data, out.row[explained], "has", "have")
            off = np.abs(np.degrees(np.angle(np.exp(1j * (q - out.q)[explained, i]))))
            of = f"joint {out.robot.joint(i)}, by {off.min():.1f} to {off.max():.1f} deg"
            said = f"{named} wrong values of {of}, which explain the errors: correct its column"
    if said:
        yield f"{said}, or leave them out ([exclude])."


def _modelled(points: Points, fit: Fit) -> Array:
    """Return where points (N, 3) are by the nominal robot and a fit [m]."""
    return transformed(fit.base @ forward_kinematics(points.robot, points.q), fit.tools[points.marker])
