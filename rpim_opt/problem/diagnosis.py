"""Likely causes of a poor fit: what rows, points of the nominal robot and residuals show."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain, combinations, combinations_with_replacement, pairwise, product
from typing import Any, NamedTuple

import numpy as np
import scipy
from scipy.special import bdtrc, fdtrc

from rpim_opt.basics.arrays import TINY, Array, rms
from rpim_opt.basics.text import joined, listed, three_digits
from rpim_opt.basics.units import display
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.data.measurements.measurement import of_fixture
from rpim_opt.problem.linear import LinearModel
from rpim_opt.problem.misreadings import BETTER, RARE, WRONG, better_interpretation, coupling, signs
from rpim_opt.problem.noise import Equations
from rpim_opt.problem.problem import SHIFTED, CalibrationProblem
from rpim_opt.problem.registration.closed_forms import transformed
from rpim_opt.problem.registration.points import FAR, Fit, Points, agreeing, fit_points, lengths_of, misfit, points_of
from rpim_opt.robot.kinematics import FRAME, forward_kinematics, numeric_frame
from rpim_opt.robot.mdh import Robot, numbered
from rpim_opt.robot.parameters import of_session, tool_prefix

LEAST_TRAVEL = {"revolute": np.radians(10), "prismatic": 0.01}  # a joint that moves less [rad, m] is hardly seen
ALIKE = (0.4, 2.5)  # rounding explains errors that are between these multiples of what it makes
NOTICED = 2**0.5
"""Residuals over the noise from which on half of the squares may be explained, and no less than the noise be left."""
MANY_MINUTES, TAKEN_UP = 30, 0.05  # different decimals below .60 that are no chance, and what a model leaves of them
MOVED = 0.5  # an instrument has moved if that leaves less than this part of the sum of squares
SLIGHT = (5 / 6) ** 2  # what an effect that is worth a word leaves of it: errors without it are a sixth smaller
ONE_BY_ONE = 0.9  # share of rows in which one joint alone is moved, from which how joints act together is unknown
FAR_MOVED = 0.005
"""Points that fit better than this part of their extent show an instrument's motion in the residuals alone."""
NOISY = 3.0  # residual RMS over the stated noise above which the fit is not that of the stated instrument
REACH, ANGULAR = 0.003, 0.02
"""Residual RMS over the length of the arm, and of orientations [rad], that a robot's own errors stay below."""
UNLIKELY = 1e-3  # probability with which outliers may agree on one joint by chance
FEW = 3  # outliers from which on they may have one cause
FEWEST = 6  # rows on either side of a change, or of which copies are told
LINEAR, EXACT = 13, 1e-5
"""Coefficients of a coordinate by position and rotation of the flange, and what no measurement comes up to [m]."""
BEYOND_REACH = 3.0
"""Lengths of the arm by which a position may be away from the others."""
MOST_LOST = 0.25  # part of the rows that may be so by lost decimal points: more are of another frame or quantity
UNRELATED = 0.25  # part of the spread of positions that a fit leaves where joint values do not explain them
FOLDED = 0.1  # part of its largest value below which the smallest one of a column without signs is near zero
MOST_DECIMALS = 4  # that are counted
ON_GRID = 2e-4  # part of a step by which rounded values may miss it, for their last decimal
NARROWER, GRID = 0.25, 61
"""Factor by which the grid for a joint's values gets narrower from round to round, and its points."""
SEVERAL = 0.85  # several joint zeros moved, if that leaves less than this part of what one move leaves
LOOSE = 4e-4  # backlash of a joint [rad, m] that no gear in order has: a quarter of that is usual
FLAT_TURN = 0.05
"""Part of their distance by which two places of a reflector differ in height and radius, if a joint turned it."""
ANOTHER = 0.01  # joint movement [rad, m] after which no point is measured again to the last digit
FILLED = 1e-3  # a point that is at least so far from the one before [m] is another one
COPIES = 0.2  # part of the rows that may repeat others
MOST_ROUNDS = 20  # of fitting one joint's values
COUPLED = 0.004  # ratio below which a coupling of two joints is not made by gears: teeth of one over those of another
LOADS, SINGULAR = 0.6, 1e-9
"""What two loads leave of the residuals at most; part of the squares below which columns are the same."""
COMPUTED = "were they computed, not measured? Leave them out ([exclude])."
MOSTLY = 2 / 3  # share of the rows from one to another that is of one kind, for a change to have come there
TWO_KINDS, STARTS = 0.4, 30
"""Rows are of two kinds if two calibrations leave less than this part of the residuals of one; starts of the search."""
SCATTERED = 5.0  # residuals of rows over those of the others from which on they are of another kind
OUTLYING, OUTLYING_ROUNDS = 10, 3
"""One of so many rows may be an outlier of the one calibration; rounds in which these are found."""
TOGETHER, CHANCE_RUNS = 4, 0.05
"""Excluded rows that follow each other, from which on something moved, if chance makes fewer such runs than that."""
JUMPING = 0.5  # mean square step of every joint over that of rows in random order, above which rows have no order
COURSES = 6  # half waves that a slow motion has over all rows at most
PLACES, PRECISE, SPANS = 40, 120, 12
"""Rows and joint values from which on something may have moved, and those between which it did and moved back."""
MOST_EQUATIONS = 3000  # equations up to which a change is looked for


def in_table_order(problem: CalibrationProblem, *apart: Dataset | None) -> CalibrationProblem:
    """Return a problem with rows that were kept apart, all at their places in the table by the numbers in their labels.

    The problem alone where its own labels do not increase (but for held-out rows behind the others), or parts have
    other labels (P07_A, v7): a table of its own says nothing of neighbouring rows.
    """
    parts = [problem.data, *(data for data in apart if data is not None)]
    own, *others = [[_natural(label) for label in data.label] for data in parts]
    every = own + [key for keys in others for key in keys]
    kinds = {key[::2] for key in own}
    turns = sum(one > next_one for one, next_one in pairwise(own))
    if turns > 1 or len(set(every)) < len(every) or any(key[::2] not in kinds for key in every):
        return problem
    order = sorted(range(len(every)), key=every.__getitem__)
    return problem.on(Dataset.together(parts, [f"part {k}" for k in range(len(parts))]).take(order))


def _natural(label: str) -> tuple[str | int, ...]:
    """Return what a label sorts by: its text and numbers in turn."""
    return tuple(int(part) if k % 2 else part for k, part in enumerate(re.split(r"(\d+)", label)))


def first(*explanations: Iterable[str]) -> list[str]:
    """Return the sentences of the first explanation that has any; later ones are not looked for."""
    return next((sentences for sentences in map(list, explanations) if sentences), [])


# What is said of a table


def hardly_moved(robot: Robot, measured: Array) -> list[str]:
    """Return which joints moved less than `LEAST_TRAVEL` in measured ranges (2, dof), and how far, as text."""
    lines = []
    for i, (travel, dimension) in enumerate(zip(np.ptp(measured, axis=0), robot.joint_dimensions, strict=True)):
        if travel < LEAST_TRAVEL[robot.joint_types[robot.leading[i]]]:
            unit, si = display(dimension)
            lines.append(f"joint {robot.joint(i)} moves only {travel / si:.2f} {unit}")
    return lines


def moved_one_by_one(robot: Robot, q: Array) -> bool:
    """Return whether nearly all joint values (N, dof) differ from a common configuration in one joint alone."""
    near = np.array([LEAST_TRAVEL[robot.joint_types[i]] / 10 for i in robot.leading])
    away = np.abs(q - np.median(q, axis=0)) > near
    return robot.dof > 1 and bool(np.mean(away.sum(axis=1) <= 1) > ONE_BY_ONE)


def beyond_limits(robot: Robot, q: Array, by: float = 0.0) -> Iterator[str]:
    """Say which joint values (N, dof) leave the joint's limits, ``by`` that many times their range."""
    for i, dimension in enumerate(robot.joint_dimensions):
        low, high = robot.limits[i]
        least, largest = q[:, i].min(), q[:, i].max()
        if np.isfinite(high - low) and max(low - least, largest - high) > max(by * (high - low), 1e-9):
            unit, si = display(dimension)
            measured, limits = (f"{a / si:,.6g} to {b / si:,.6g} {unit}" for a, b in ((least, largest), (low, high)))
            yield f"joint {robot.joint(i)} is {measured}, but its limits are {limits}"


def all_q(data: Dataset) -> Array:
    """Return the joint values (N, dof) of all points of all rows."""
    return np.concatenate([block.q.reshape(-1, block.q.shape[2]) for block in data.blocks])


def _rows(data: Dataset, rows: np.ndarray, of_one: str, of_several: str, most: int = 8) -> str:
    """Name rows, the first so many, before their verb."""
    labels = [data.label[i] for i in rows]
    if len(labels) == 1:
        return f"row {labels[0]} {of_one}"
    return f"rows {listed(labels, most)} {of_several}"


def arm_length(robot: Robot, blocks: Iterable[Block]) -> float:
    """Return the length of the arm stretched out [m], prismatic joints as far as they moved in blocks."""
    sliding = np.array(robot.joint_dimensions) == "length"
    moved = blocks if sliding.any() else ()
    strokes = [np.abs(block.q[..., sliding]).max(axis=(0, 1)) for block in moved if block.q.shape[-1] == robot.dof]
    return float(np.abs(robot.mdh[:, [1, 3]]).sum() + np.max(strokes, axis=0, initial=0.0).sum())


def single_rows(problem: CalibrationProblem) -> Iterator[str]:
    """Report what is wrong with single rows by themselves, from data in the order of the table."""
    yield from rows_without_values(problem.data, problem.arms)
    yield from filled_rows(problem.data)
    yield from exchanged_rows(problem)


def rows_without_values(data: Dataset, arms: Mapping[str, Robot]) -> Iterator[str]:
    """Report equal columns, and rows with one number for all coordinates: instruments write it for missing values."""
    for block in data.blocks:
        if len(block.measurement.columns) < 3:
            continue
        y = block.y[:, :3]
        same = (y == y[:, :1]).all(axis=1)
        for i, j in combinations(range(3), 2):
            if not same.all() and (y[:, i] == y[:, j]).all():
                yield f"columns {'xyz'[i]} and {'xyz'[j]} are equal in every row: is one a copy? Export both again."
        for value in np.unique(y[same, 0]):
            unit, si = display("length")
            number = f"{value / si:g} {unit}" if value else "0"
            which = _rows(data, block.row[same & (y[:, 0] == value)], "has", "have")
            yield (
                f"{which} {number} for every measured coordinate: missing measurements? Exclude such rows ([exclude])."
            )
        reach = arm_length(arms[block.robot], [block])
        away = np.linalg.norm(y - np.median(y, axis=0), axis=1)
        lost = block.row[away > BEYOND_REACH * reach]
        if 0 < len(lost) < MOST_LOST * len(y):
            yield (
                f"{_rows(data, lost, 'is', 'are')} farther from the others than the arm is long: was a decimal point "
                "lost, or is it another unit?"
            )


def common_rows(data: Dataset, other: Dataset) -> list[tuple[str, str]]:
    """Return the labels of other rows that are copies of rows of data, to the last digit, and the labels of those."""

    def rows(of: Dataset) -> list[tuple[bytes, str]]:
        blocks = [block for block in of.blocks if block.measurement.columns]
        each = [(block, i, row) for block in blocks for i, row in enumerate(block.row)]
        return [(block.q[i].tobytes() + block.y[i].tobytes(), of.label[row]) for block, i, row in each]

    own = dict(reversed(rows(data)))  # of copies the first
    return [(label, own[key]) for key, label in rows(other) if key in own]


def shared_rows(data: Dataset, validation: Dataset | None) -> Iterator[str]:
    """Report rows of the validation set that are copies of identification rows."""
    if validation is None:
        return
    copies = [own if own == other else f"{own} ({other})" for own, other in common_rows(data, validation)]
    if copies:
        yield (
            f"{len(copies)} of {len(validation)} rows of the validation set are identification rows as well: "
            f"{listed(copies)}. The validation error is too optimistic: separate the sets (rpim-opt new --hold-out)."
        )


def copied_rows(data: Dataset) -> Iterator[str]:
    """Report rows that duplicate others in joint and measured values, and so are not measurements."""
    for block in data.blocks:
        if not block.measurement.columns or len(block.row) < FEWEST:
            continue
        rows = np.hstack([block.q.reshape(len(block.row), -1), block.y])
        first, count = np.unique(rows, axis=0, return_index=True, return_counts=True)[1:]
        copies = len(rows) - len(first)
        if copies >= COPIES * len(rows):
            named = listed([data.label[block.row[i]] for i in np.sort(first[count > 1])], 3)
            yield (
                f"{copies} of {len(rows)} rows repeat others to the last digit (first {named}): copies are not "
                "measurements and make uncertainties too small; remove them."
            )


def filled_rows(data: Dataset) -> Iterator[str]:
    """Report rows that were filled in: means of their neighbours, joint values or the measured point of the row before.

    The data are in the order of the table.
    """
    of: dict[tuple[str, tuple[str, ...]], list[Block]] = {}  # neighbours may be of several blocks
    for block in data.blocks:
        if block.y.shape[1] >= 3:
            of.setdefault((block.robot, block.markers), []).append(block)
    for blocks in of.values():
        row = np.concatenate([block.row for block in blocks])
        order = np.argsort(row)
        row = row[order]
        q = np.concatenate([block.q[:, 0] for block in blocks])[order]
        y = np.concatenate([block.y[:, :3] for block in blocks])[order]
        moves = np.linalg.norm(np.diff(y, axis=0), axis=1)
        off = np.linalg.norm(y[1:-1] - (y[:-2] + y[2:]) / 2, axis=1)
        decimals = decimals_of(1e3 * y)
        last_digit = 10.0 ** -(MOST_DECIMALS if decimals is None else decimals)  # [mm]
        # rounding alone: measured points of a grid are nearly half way, the nearer the smaller their unit
        middle = off < min(EXACT, np.sqrt(3) * 1e-3 * last_digit)
        between = row[1:-1][middle & (np.minimum(moves[:-1], moves[1:]) > FILLED)]
        if len(between):
            which = _rows(data, between, "is", "are")
            yield (
                f"{which} exactly half way between the points before and after: interpolated, not measured; leave out "
                "what was filled in ([exclude])."
            )
        again = (q[1:] == q[:-1]).all(axis=1) & (moves > FILLED)
        if again.any():
            repeated = np.count_nonzero(again & ~np.append(False, again[:-1]))
            cause = "the log was not updated; leave such rows out ([exclude])."
            if 2 * repeated > len(q) - np.count_nonzero(again):  # most configurations: no accident
                cause = "are they of several reflectors? Name each row's reflector in a column `marker`."
            which = _rows(data, row[1:][again], "has", "have")
            yield f"{which} the joint values of the row before at another point: {cause}"
        frozen = (moves == 0) & (np.abs(np.diff(q, axis=0)).max(axis=1) > ANOTHER) & (np.ptp(y[1:], axis=1) > 0)
        if np.count_nonzero(frozen) >= FEW:
            which = _rows(data, row[1:][frozen], "has", "have")
            yield (
                f"{which} the measured point of the row before at other joint values: the reading was not updated; "
                "leave such rows out ([exclude])."
            )


def left_out_together(labels: Sequence[str], left_out: Collection[str]) -> Iterator[str]:
    """Report excluded rows that are consecutive, if the labels are in numerical order."""
    ordered = sorted(dict.fromkeys([*labels, *left_out]), key=_natural)
    if [label for label in ordered if label not in left_out] != list(labels):
        return
    at = np.array([i for i, label in enumerate(ordered) if label in left_out], dtype=int)
    for run in np.split(at, np.flatnonzero(np.diff(at) > 2) + 1):
        # expected number of such runs of the other outliers, each within two rows of the last
        share = (len(at) - len(run)) / max(len(ordered) - len(run), 1)
        if len(run) >= TOGETHER and len(at) * (1 - (1 - share) ** 2) ** (len(run) - 1) < CHANCE_RUNS:
            yield (
                f"rows {ordered[run[0]]} to {ordered[run[-1]]} were excluded as outliers and are consecutive: "
                "did the instrument or the robot's base move there, or was a column filled in or shifted? Correct the "
                "rows, calibrate the two parts separately, or register the second one again."
            )


class Rounding(NamedTuple):
    """What is rounded, the RMS error which that makes [m], and what helps.

    Residuals are at least a part ``least`` of it; ``step`` is what every joint is rounded to, empty if not all are.
    """

    what: str
    made: float
    remedy: str
    least: float = ALIKE[0]
    step: str = ""


def rounded(problem: CalibrationProblem, error: float) -> Iterator[str]:
    """Report rounding of joint or measured values that explains the RMS error [m] of a fit, or what it excludes."""
    alike = list(roundings(problem, error, ALIKE[1]))
    yield from alike
    for each in every_rounding(problem):
        if each.step and each.made > ALIKE[1] * error and not alike:
            yield (
                f"joint values are multiples of {each.step}, but errors of {three_digits(1e3 * error)} mm are smaller "
                f"than rounding would cause ({three_digits(1e3 * each.made)} mm): these are commanded joint values. "
                "Log the measured ones."
            )


def roundings(problem: CalibrationProblem, error: float, most: float) -> Iterator[str]:
    """Report rounding of joint or measured values, if the RMS error [m] of a fit is less than so many times its own."""
    for each in every_rounding(problem):
        if each.least * each.made < error < most * each.made:
            yield (
                f"{each.what}: that alone contributes {three_digits(1e3 * each.made)} mm, the residual RMS is "
                f"{three_digits(1e3 * error)} mm: {each.remedy}."
            )


def every_rounding(problem: CalibrationProblem) -> Iterator[Rounding]:
    """Yield roundings of joint and measured values that are there, whatever they explain."""
    q, turning = all_q(problem.data), np.array(problem.robot.joint_dimensions) == "angle"
    slopes = problem.joint_slopes(sliding=True)[Equations.of(problem.data).length] @ problem.robot.joint_map
    levers = np.sqrt(np.sum(slopes**2, axis=0) / len(problem.data))  # how far a joint moves a point [m/rad, m/m]
    angles = q[:, turning]
    decimals = (np.abs(np.degrees(angles)) % 1).round(6)
    if (decimals < 0.6).all():
        minutes = "joint values look like degrees and minutes (no decimals from .60 on)"
        least = TAKEN_UP if len(np.unique(decimals)) > MANY_MINUTES else ALIKE[0]
        yield Rounding(minutes, np.radians(0.4) / np.sqrt(3) * np.linalg.norm(levers[turning]), "convert them", least)
    for block in problem.data.blocks:
        columns = {name: i for i, (name, of) in enumerate(block.measurement.columns.items()) if of == "length"}
        if len(block.y) < FEWEST or not columns:  # lengths of a drawing are round
            continue
        values = [1e3 * block.y[:, i] for i in columns.values()]
        gaps = [np.diff(np.unique(each)).min(initial=np.inf) for each in values]
        units = np.array([_unit(each, gap, min(gaps)) for each, gap in zip(values, gaps, strict=True)])
        each = np.sqrt(np.mean(units**2, axis=1) / 12)
        made = float(np.linalg.norm(each))
        coarse = [name for name, part in zip(columns, each, strict=True) if 10 * part > made]
        of = "" if len(coarse) == len(columns) else f" ({', '.join(coarse)})"
        what = f"measured values are rounded to {units.max(initial=0.0):.4g} mm{of}"
        yield Rounding(what, 1e-3 * made, "export more decimals, or state the rounding as their noise")
    every = []
    for name, size in (("deg", np.pi / 180), ("rad", 1.0)):
        si, units = np.where(turning, size, 1e-3), np.where(turning, name, "mm")
        steps = np.array([_unit(column, _step(column)) for column in (q / si).T])
        each = si * np.sqrt(np.mean(steps**2, axis=1) / 12) * levers
        made = float(np.linalg.norm(each))
        coarse = 10 * each > made
        step = " and ".join(f"{steps[coarse & (units == u)].max():g} {u}" for u in dict.fromkeys(units[coarse]))
        up_to = "up to " * bool(np.ptp(steps[coarse], axis=1).any())
        of = ", ".join(f"q{i + 1}" for i in np.flatnonzero(coarse))
        what = f"joint values are rounded to {up_to}{step} ({of})"
        every.append(Rounding(what, made, "export them with more decimals", step=step if steps.all() else ""))
    yield max(every, key=lambda each: each.made)


def _unit(values: Array, *steps: float) -> Array:
    """Return to what values (N,) are rounded: 16-bit floats, a grid of such a step, or 3 or 4 digits; zeros if to none.

    16-bit floats have 11 significant bits; of those that were written with few decimals half of the last one may miss.
    """
    size = np.abs(values)
    decimals = decimals_of(values)
    written = 0.5 * 10.0 ** -(MOST_DECIMALS if decimals is None else decimals)
    binary = 2.0 ** (np.floor(np.log2(np.maximum(size, ON_GRID))) - 10)
    digits = 10.0 ** (np.floor(np.log10(np.maximum(size, 1.0))) - 2)
    grids = [np.full(values.shape, step) for step in steps if 0 < step < np.inf]
    for unit, missing in ((binary, written), *((each, 0.0) for each in (*grids, digits, digits / 10))):
        off = np.abs(values - unit * (values / unit).round())
        if missing < np.median(unit) / 8 and (off <= ON_GRID * unit + missing).all():
            return unit
    return np.zeros(values.shape)


def _step(values: Array) -> float:
    """Return the step of the decimal grid that values are on, up to 4 decimals; 0 where they are on none."""
    decimals = decimals_of(values)
    if decimals is None:
        return 0.0
    return float(np.gcd.reduce((values * 10.0**decimals).round().astype(int))) / 10.0**decimals


def decimals_of(values: Array) -> int | None:
    """Return how many decimals all values have at most, up to `MOST_DECIMALS`; None where they have more."""
    for decimals in range(MOST_DECIMALS + 1):
        scaled = values * 10.0**decimals
        if np.abs(scaled - scaled.round()).max(initial=0.0) < 1e-6 * np.abs(scaled).max(initial=1.0) ** 0.5:
            return decimals
    return None


# What points of the nominal robot say


def computed_columns(problem: CalibrationProblem) -> Iterator[str]:
    """Report coordinates that are exact functions of the nominal robot: computed, not measured.

    A coordinate of a point in any frame, of any reflector, is linear in position and rotation of the nominal flange.
    """
    points = points_of(problem)
    if points is None or points.by_camera or len(points.row) < 2 * LINEAR or len(points.tools) > 1:
        return
    T = forward_kinematics(points.robot, points.q)
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
        which = _rows(problem.data, swapped, "fits", "fit")
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
        "the two tables match? Join them by a common column, or by time. Or were deviations exported, not positions?"
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
    """Report a joint or coordinate whose values are wrong: with its own value in every row, the others fit.

    Base, reflectors and these values are fitted in turn, those of a joint on a grid that gets narrower.
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
    what = f"{_rows(problem.data, points.row[apart], 'has', 'have')} wrong values of {column}"
    if apart.sum() > len(apart) / 2:
        what = f"the values of {column} explain nothing (sorted, copied, shuffled, without signs, another quantity?)"
    yield (
        f"{what}: with fitted ones the points agree to {three_digits(1e3 * left[least] * points.extent)} mm instead "
        f"of {three_digits(1e3 * whole * points.extent)} mm; check its column."
    )


def _unsigned(values: Array) -> np.ndarray:
    """Return which columns of values (N, k) have none below zero, and some near it."""
    low, high = values.min(axis=0), values.max(axis=0)
    return (low >= 0) & (low < FOLDED * high)


def _values_that_fit(points: Points, joint: int, known: Fit | None = None) -> Array:
    """Return joint values (N, dof) in which one joint's are those that fit best, with base and reflectors if known.

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
    """Return what explains a table better than it is stated: another place or interpretation of some rows, or of all.

    Where half of the rows agree with the nominal robot, another interpretation is sought of the others first. One of
    all rows leaves errors of at most ``most`` [m] by the nominal robot, or a robot's part of the points' extent.
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
    parts, rest, exact = _stations(points)
    if exact:
        which = _rows(problem.data, points.row[parts[-1][0]], "agrees", "agree")
        yield f"{which} with the nominal robot: {COMPUTED}"
        return
    if len(parts) < 2 or len(rest) > len(points.row) / OUTLYING:
        return
    in_turn = all(len(part) > MOSTLY * (np.ptp(part) + 1) for part, _ in parts)
    if len(points.tools) > 1 and not in_turn:  # their names may be exchanged
        return
    (_, first), *others = sorted(parts, key=lambda each: each[0][0])
    for part, fit in others:
        where = _rows(problem.data, points.row[part], "fits", "fit")
        if in_turn:
            where = f"from about row {problem.data.label[points.row[part[0]]]} on the points fit"
        other, joint = _other_place(points, first, fit, len(problem.data.sessions) > 1)
        if in_turn or joint != 1:  # no base moves to and fro about the first axis
            yield f"{where} another {other}."


def _stations(points: Points) -> tuple[list[tuple[np.ndarray, Fit]], np.ndarray, bool]:
    """Return groups of rows that agree among themselves, the rest, and whether the last group was computed."""
    whole = rms(agreeing(points)[1].error)
    parts: list[tuple[np.ndarray, Fit]] = []
    rest = np.arange(len(points.row))
    while whole >= FAR_MOVED * points.extent and len(rest) >= FEWEST:
        own, fit = agreeing(points.take(rest))
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
        remedy = (
            "name both parts in a column `session` of the raw table (rpim-opt new registers each), or calibrate one "
        )
        remedy += "and add the other to its result with `update --reset 'base_*'`"
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
            where = where or _rows(problem.data, some.row, "fits otherwise:", "fit otherwise:")
            yield f"{where} {better.sentence}"
            return
    if not together and not points.lengths and points.turns is None:
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
            named = _rows(problem.data, out.row[explained], "has", "have")
            off = np.abs(np.degrees(np.angle(np.exp(1j * (q - out.q)[explained, i]))))
            of = f"joint {out.robot.joint(i)}, by {off.min():.1f} to {off.max():.1f} deg"
            said = f"{named} wrong values of {of}, which explain the errors: correct its column"
    if said:
        yield f"{said}, or leave them out ([exclude])."


def _modelled(points: Points, fit: Fit) -> Array:
    """Return where points (N, 3) are by the nominal robot and a fit [m]."""
    return transformed(fit.base @ forward_kinematics(points.robot, points.q), fit.tools[points.marker])


def _places(count: int, most: int = PLACES) -> list[int]:
    """Return before which rows a table may be parted."""
    return np.unique(np.linspace(FEWEST, count - FEWEST, most).round().astype(int)).tolist()


# What residuals say


Shares = dict[str, Array]
"""When something changes, and what part equations (m,) or (m, s) have in it."""


class Addition(NamedTuple):
    """Columns (m, c) that a linear model lacks, and what coefficients (c,) mean: what happened, and what to do."""

    columns: Array
    said: Callable[[Array], tuple[str, str]] | None  # None where it is no mistake
    most: float = np.inf  # coefficient from which on a slope says nothing


def _explained(
    model: LinearModel, x: Array, angle: np.ndarray, additions: Iterable[Addition], left_at_most: float = MOVED
) -> tuple[float, Addition, Array] | None:
    """Return which part of a model's residual at x (n,) is left, by which addition, with which coefficients (c,).

    Beside the parameters with their prior it must leave at most that part of the sum of squares, less than chance does
    once in a million (F test, all additions counted): None where none does. Where lengths and angles scatter unlike
    their stated noise the sum of squares has as many equations as a chi-squared of its mean and variance (Satterthwaite
    1946).
    """
    taken = _freedom(model)
    without = _without_parameters(model)
    rest = without((model.b - model.A @ (x / model.parameters.scale))[:, None])[:, 0]
    whole = float(rest @ rest)
    kinds = [rest[: len(angle)][part] ** 2 for part in (angle, ~angle) if part.any()]
    uneven = len(angle) * sum(float((each.sum() / max(whole, TINY)) ** 2) / len(each) for each in kinds)
    every = list(additions)
    tried: list[tuple[float, float, Addition, Array]] = []  # by the variance that is left: of many columns against few
    for addition in every:
        G = without(addition.columns)
        step = np.asarray(np.linalg.lstsq(G, rest, rcond=1e-9)[0], dtype=float)
        gain = whole - float(np.sum((rest - G @ step) ** 2))
        spare = max(len(model.A) - taken - len(step), 1)
        # one of many mistakes is ahead of what is none by chance, unless it is that many times as likely
        odds = 1.0 if addition.said is None else len(every) ** (2 / spare)
        tried.append(((whole - gain) / spare * odds, gain, addition, step))
    if not tried or not whole:
        return None
    _, gain, addition, step = min(tried, key=lambda each: round(each[0] / whole, 9))  # of equal ones the first
    spare = max((len(model.A) - taken - len(step)) / max(uneven, 1.0), 1)
    left = max(whole - gain, 1e-300)
    chance = fdtrc(len(step), spare, gain / len(step) / (left / spare))
    if gain <= (1 - left_at_most) * whole or chance * len(tried) >= RARE or np.abs(step).max() > addition.most:
        return None
    return float(np.sqrt(left / whole)), addition, step


def _freedom(model: LinearModel) -> float:
    """Return how many degrees of freedom the parameters take up beside their prior."""
    squares = model.svd[1] ** 2
    return float(np.sum(squares / (1 + squares)))


def _without_parameters(model: LinearModel) -> Callable[[Array], Array]:
    """Return a function of columns (m, c) that returns what parameters with their prior leave of them (m + n, c)."""
    n = model.A.shape[1]
    own = np.linalg.qr(np.vstack([model.A, np.eye(n)]))[0]

    def without(columns: Array) -> Array:
        G = np.vstack([columns, np.zeros((n, columns.shape[1]))])
        return np.asarray(G - own @ (own.T @ G), dtype=float)

    return without


def shown_by_residuals(problem: CalibrationProblem, x: Array, *, most: float | None = None) -> Iterator[str]:
    """Report what one addition to the linearization at x (n,) explains best: what moved, lags or is scaled.

    Added are the columns of a base for every session; of a base, fixture, reflector or joint zero for the rows from one
    on, or between two of a few, of a joint zero from a value of the joint on as well, and of a reflector by the
    direction of gravity at the flange; the slope of a joint's zero times the value of a joint, all of these times the
    way from the row before, and the slopes of the scale or offset of lengths, of positions by the scales and skews of
    their axes, too. Else backlash, rows of two kinds, noise of one column and of some rows are looked for. Nothing is
    reported where gravity and eccentric gears explain more, which are not in the model: a lack of fit, and no mistake.
    With ``most`` what leaves at most that part of the squares is reported, and else only backlash is looked for: a side
    for every row raises -2 ln L by 2 ln 2. It is named in place of an addition that leaves twice as much.
    """
    if len(problem.owners) > MOST_EQUATIONS:
        return
    single = most is not None
    if not single:  # a noise that was learned takes up what is looked for
        problem = problem.with_repeatability(None)
    model = problem.linearize(x)
    # a cause that leaves more than instrument and robot do is beyond its linearization, or one of several mistakes
    norms, count = problem.with_repeatability(None).whitened_errors(x)
    of_noise = NOISY * np.sqrt(count.sum()) / np.sqrt(max(float(norms @ norms), TINY))
    largest = {"length": REACH * arm_length(problem.robot, problem.data.blocks), "angle": ANGULAR}
    own = [part / size for each, part in largest.items() if (size := rms(problem.errors(x, each))) > TINY]
    acceptable = min(max(of_noise, min(own, default=0.0)), 1.0)
    most = min(MOVED if most is None else most, acceptable**2)
    moves = _moves(problem, x, along_joints=most <= MOVED)
    angle = Equations.of(problem.data).angle
    if problem.touches:  # lengths, without those that place the touched points
        angle = np.zeros(len(model.A), dtype=bool)
    best = _explained(model, x, angle, chain(moves, _gears(problem, model), _scales(problem, x, model)), most)
    left, limit = np.inf if best is None else best[0], min(TWO_KINDS, acceptable)
    if single:
        sides = min(limit, most**0.5 * 0.5 ** (len(problem.data) / len(model.b)), MOVED * left)
        states = two_states(problem, x, min(LOADS, sides))
        yield from first(two_positions(problem, x, sides), _said_of_addition(best), states)
        return
    # zeros of all joints fit two gross errors, whatever these are, but no more
    what, cause = "set of joint zeros", "did several joints slip, or were they remastered"
    changes = _changes(problem, x, model.A, _zeros(problem.robot), what, cause, _shares(problem))
    several = _explained(model, x, angle, changes, most)
    if several is not None and several[0] < SEVERAL * left:
        best, left = several, several[0]
    rows, part = _two_kinds(problem, x)
    # what changed at a row is named by itself where that is enough
    kinds = part < limit and left > (MOVED if np.ptp(rows) == len(rows) - 1 else part / MOVED)
    if best is not None and not kinds:
        yield from first(two_positions(problem, x, min(limit, MOVED * left)), _said_of_addition(best))
    else:
        said = [_said_of_kinds(problem, rows, part)] if kinds else ()
        rounding = roundings(problem, rms(problem.errors(x)), (1 - MOVED) ** -0.5)
        noise = _uneven_noise(problem, x) if acceptable == 1 else ()  # else errors are too large for noise
        backlash = two_positions(problem, x, min(limit, part / MOVED) if kinds else limit)
        states = () if problem.touches else two_states(problem, x)
        yield from first(backlash, states, said, rounding, noise, scattered_rows(problem, x))


def _said_of_addition(best: tuple[float, Addition, Array] | None) -> Iterator[str]:
    """Say what an addition means and which part of the residuals it leaves, unless it is no mistake."""
    if best is not None and best[1].said is not None:
        what, remedy = best[1].said(best[2])
        yield f"{what} (that leaves {100 * best[0]:.0f} % of the residuals): {remedy}."


def _moves(problem: CalibrationProblem, x: Array, along_joints: bool) -> Iterator[Addition]:
    """Yield a base, fixture, reflector, joint zero or payload that changed, where something places the robot.

    Joint zeros change at a value of the joint, too, if ``along_joints``: gears have slight steps.
    """
    p, blocks = problem.parameters, problem.data.blocks
    placed = {"base": ([f"base_{c}" for c in FRAME], "did the instrument or the robot's base move")}
    for block in blocks:
        names = [of_fixture(name, block.fixture) for name in block.measurement.parameters]
        if names:
            what = names[0].split("_")[0]
            placed[what] = ([*placed.get(what, [()])[0], *names], "did it, or the robot's base, move")
    apart = any(map(of_session, p.free.names))
    if not apart and not set(p.free.names) & {name for names, _ in placed.values() for name in names}:
        return
    markers = dict.fromkeys(marker for block in blocks for marker in block.markers)
    parts = dict(placed)
    parts["reflector"] = ([tool_prefix(m) + c for m in markers for c in FRAME], "was the reflector exchanged")
    every = np.array(p.names)
    bends, eccentric = np.char.startswith(every, "compliance"), np.char.startswith(every, "ecc_")
    parts["payload"] = (every[bends].tolist(), "did the load at the flange change")
    based = apart & np.isin(every, placed["base"][0])  # a base may move within a session, too
    whole, there = _with_others(problem, x, bends | eccentric | based)  # a payload shows in them, identified or not
    A = whole.linearize(there).A
    shares = _shares(problem)
    free, named = whole.parameters.free, problem.data.sessions
    base = np.flatnonzero(np.isin(free.names, SHIFTED))
    if len(base) and 1 < len(named) <= len(problem.data) / FEWEST and not apart:
        apart = A[:, base, None] * (problem.data.session[problem.owners, None] == np.array(named[1:]))[:, None]
        between = f"the base differs from session to session ({listed(named)})"
        remedy = 'did it move between them? Add `session_*` to `identify`, or model = "auto"'
        yield Addition(apart.reshape(len(A), -1), lambda c: (between, remedy))
    for what, (changed, cause) in parts.items():
        yield from _changes(whole, there, A, changed, what, cause, shares)
    for i, name in enumerate(_zeros(problem.robot)):
        cause = "did the joint slip or fall back under its load, or was it remastered"
        by = shares | (_shares(problem, i) if along_joints else {})
        zero = f"zero of joint {numbered(i, problem.robot.joint_names)}"
        yield from _changes(whole, there, A, [name], zero, cause, by)
    model = replace(problem.robot, joint_map=np.eye(len(problem.robot.mdh)), limits=np.empty((0, 0)))
    flange = forward_kinematics(model, problem.joint_values)
    down = {
        "with the direction of gravity at the flange": problem.robot.gravity.direction @ flange[problem.owners, :3, :3]
    }
    cause = "is it loose in its nest, or its holder compliant"
    yield from _changes(whole, there, A, [tool_prefix(m) + c for m in markers for c in "xyz"], "reflector", cause, down)
    yield from _tilts(whole, A, flange[:, :3, 3])
    for family in (bends, eccentric, bends | eccentric):  # either alone explains more with fewer columns
        lacking = np.isin(free.names, every[family & ~p.identified])
        if lacking.any():
            yield Addition(A[:, lacking], None)
    nominal = whole.parameters.nominal[whole.parameters.identified]
    of_arm = (np.array(free.dimensions) == "length") & ~free.of_frames
    elapsed = problem.owners / max(len(problem.data) - 1, 1)
    grown = A @ np.where(of_arm, nominal / free.scale, 0.0) * elapsed
    warm = "did it warm up? Measure it warm, or in random order, or state temperature_C of every row (expansion)"
    what = "the arm grows from row to row, by {} from the first to the last"
    yield Addition(grown[:, None], lambda c: (what.format(f"{100 * c[0]:.2g} %"), warm))
    q = problem.joint_values[:, np.ptp(problem.joint_values, axis=0) > 0]
    if len(q) < 2 * FEWEST or not len(base):
        return
    steps = np.diff(q, axis=0).var(axis=0) / (2 * q.var(axis=0))  # of every joint; one in rows of random order
    if steps.min(initial=1.0) > JUMPING:  # else model errors follow the rows as well
        courses = np.cos(np.pi * np.outer(elapsed, range(1, COURSES + 1)))
        slow = "the instrument or the base drifted slowly, though the joint values are in no order"
        still = "temperature? Measure reference points between the rows, or all in a shorter time"
        yield Addition((A[:, base, None] * courses[:, None]).reshape(len(A), -1), lambda c: (slow, still))


def _tilts(problem: CalibrationProblem, A: Array, flange: Array) -> Iterator[Addition]:
    """Yield that the base tilts by the side of the flange (N, 3), by its weight, or by the first harmonic of joint 1.

    It tilts about two axes, as a turn about the first joint's own axis is that of an eccentric gear.
    """
    p, robot = problem.parameters, problem.robot
    turns = [p.free.names.index(name) for name in ("base_rx", "base_ry", "base_rz") if name in p.free.names]
    if len(turns) < 3 or robot.joint_types[0] != "revolute":
        return
    base = numeric_frame(p.nominal[[p.names.index(f"base_{c}") for c in FRAME]])[:3, :3]
    across = numeric_frame([0, 0, 0, robot.mdh[0, 0], 0, 0])[:3, :2]
    tilts = A[:, turns] / p.free.scale[turns] @ base @ across
    reach, q1 = flange @ across, problem.joint_values[:, 0]
    side = reach / np.maximum(np.linalg.norm(reach, axis=1, keepdims=True), TINY)
    what = "the base tilts with the direction of the arm"
    remedy = "are its bolts tight, its foot and the bearing of joint 1 stiff? Fix it, and measure again"
    for share in (side, reach, np.column_stack([np.cos(q1), np.sin(q1)])):
        columns = tilts[:, :, None] * share[problem.owners, None]
        yield Addition(columns.reshape(len(A), -1), lambda c: (what, remedy))


def _with_others(problem: CalibrationProblem, x: Array, others: np.ndarray) -> tuple[CalibrationProblem, Array]:
    """Return a problem that identifies other parameters too, and deviations x (n,) with zeros for these."""
    p = problem.parameters
    whole = problem.identifying(p.identified | others)
    there = np.zeros(len(whole.parameters.free))
    there[p.identified[whole.parameters.identified]] = x
    return whole, there


def _changes(
    problem: CalibrationProblem, x: Array, A: Array, names: Collection[str], what: str, cause: str, by: Shares
) -> Iterator[Addition]:
    """Yield that parameters changed in proportion to shares (m,) or (m, s), of three equations a parameter."""
    free = problem.parameters.free
    some = np.flatnonzero(np.isin(free.names, list(names)))
    if not len(some):
        return
    equations = Equations.of(problem.data)

    def say(when: str, share: Array, coefficients: Array) -> tuple[str, str]:
        rows = equations.length & share.any(axis=1)
        by_share = problem.jacobian(x)[np.ix_(rows, some)] * free.scale[some] @ coefficients.reshape(len(some), -1)
        change = np.sum(by_share * share[rows], axis=1)
        far = 1e3 * float(np.sqrt(change @ change / max(len(np.unique(equations.row[rows])), 1)))
        moved = f"the points are {three_digits(far)} mm off the fit to the others"
        if not rows.any():  # nothing but angles was measured
            moved = "the measurements contradict the others"
        remedy = "Calibrate the two parts separately" + ", or name them in a column `session`" * (what == "base")
        if share.shape[1] > 1:  # motions of all points alike would be in the figure
            moved, remedy = "the points move to and fro", "Fix it, and measure again"
        return f"{when} {moved}, consistent with a changed {what}", f"{cause}? {remedy}"

    for when, part in by.items():
        share = part.reshape(len(A), -1)
        if np.count_nonzero(share.any(axis=1)) >= 3 * len(some):
            columns = A[:, some, None] * share[:, None]
            yield Addition(columns.reshape(len(A), -1), partial(say, when, share))


def _shares(problem: CalibrationProblem, joint: int | None = None) -> Shares:
    """Return what part equations (m,) have in a change, and when: from a row on, between two rows or steadily.

    Of a ``joint`` its values take the place of the rows' order: from one on, as gears' ripple is a change between two.
    """
    data, owners = problem.data, problem.owners
    at, places = np.arange(len(data)), [f"row {label}" for label in data.label]
    shares = {"more and more from row to row": owners / max(len(data) - 1, 1)}
    if joint is not None:
        unit, si = display("angle" if problem.robot.joint_types[joint] == "revolute" else "length")
        side = signs(problem.robot.joint_map)[joint]
        values, at = np.unique(side * problem.joint_values[:, joint], return_inverse=True)
        shares, places = {}, [f"q{joint + 1} = {value / si:.4g} {unit}" for value in values]
    if len(places) < 2 * FEWEST:
        return {}
    ends = len(places)
    spans = [(k, ends) for k in _places(ends, PLACES if joint is None else PRECISE)]
    if joint is None:
        spans += combinations(_places(ends, SPANS), 2)
    for start, end in spans:
        inside = (at >= start) & (at < end)
        # rows of one configuration share what the model lacks of the arm, and are one piece of evidence
        if min(len(np.unique(data.configuration[part])) for part in (inside, ~inside)) >= FEWEST:
            until = "on" if end == ends else f"to {places[end - 1]}"
            shares[f"from {places[start]} {until}"] = inside[owners].astype(float)
    return shares


def _two_kinds(problem: CalibrationProblem, x: Array) -> tuple[np.ndarray, float]:
    """Return the rows (K,) that have other parameters than the rest, none if too few, and which part that leaves.

    Two linear fits with the prior and the rows of each are found in turn, from random halves. Each kind of rows has
    its own parameters, and each row a degree of freedom for its choice.
    """
    model = problem.with_repeatability(None).linearize(x)
    A, b, owners, N = model.A, model.b, problem.owners, len(problem.data)
    rank = _freedom(model)
    spare = len(b) - 2 * rank - N
    if spare < rank:
        return np.zeros(0, dtype=int), np.inf

    def errors(of: np.ndarray) -> Array:
        z = np.linalg.solve(A[of].T @ A[of] + np.eye(A.shape[1]), A[of].T @ b[of])
        return np.bincount(owners, (b - A @ z) ** 2, N).astype(float)

    rng = np.random.default_rng(0)
    best, second = np.inf, np.zeros(N, dtype=bool)
    for _ in range(STARTS):
        now = rng.random(N) < 0.5
        for _ in range(MOST_ROUNDS):
            both = np.array([errors(~now[owners]), errors(now[owners])])
            left = float(both.min(axis=0).sum())
            if left < best:
                best, second = left, both[1] < both[0]
            before, now = now, both[1] < both[0]
            if (now == before).all():
                break
    kept = np.ones(N, dtype=bool)  # a few gross errors are outliers, and no kind of rows
    for _ in range(OUTLYING_ROUNDS):
        one = errors(kept[owners])
        kept = one <= np.sort(one)[N - N // OUTLYING - 1]
    left = float(np.sqrt(best / spare / (errors(kept[owners])[kept].sum() / (kept[owners].sum() - rank))))
    rows = np.flatnonzero(second == (second.sum() <= N / 2))
    return rows, left if len(rows) >= FEWEST else np.inf


def _uneven_noise(problem: CalibrationProblem, x: Array) -> Iterator[str]:
    """Report a column of measured values whose residuals at x (n,) are far larger than those of the others.

    Standard deviations s of all columns, over the stated noise, are estimated in turn with the fit of weights 1 / s^2,
    as otherwise the noise of one is in the residuals of all: s^2 = sum r^2 / sum (1 - h), residuals r, leverages h.
    """
    model = problem.linearize(x)
    columns = {tuple(block.measurement.components) for block in problem.data.blocks}
    which = Equations.of(problem.data).component
    if len(columns) > 1 or not which.any():
        return
    size = freedom = np.ones(which.max() + 1)
    for _ in range(MOST_ROUNDS):
        A, b = model.A / size[which][:, None], model.b / size[which]
        own = np.linalg.qr(np.vstack([A, np.eye(A.shape[1])]))[0][: len(b)]
        freedom = np.maximum(np.bincount(which, 1 - np.sum(own**2, axis=1)), 1.0)
        size = np.maximum(size * np.sqrt(np.bincount(which, (b - own @ (own.T @ b)) ** 2) / freedom), EXACT)
    *_, second, worst = np.argsort(size)
    times = float(size[worst] / size[second])
    if times > NOISY and freedom.min() > 1 and len(size) * fdtrc(freedom[worst], freedom[second], times**2) < RARE:
        name = columns.pop()[worst]
        yield (
            f"residuals of column {name} are {three_digits(times)} times those of the other columns, with the same "
            f"stated noise: check what measured it, or state its noise (column sigma_{name}_mm, ...)."
        )


def scattered_rows(problem: CalibrationProblem, x: Array) -> Iterator[str]:
    """Report rows that scatter far more than the others, if these agree with the stated noise without them.

    The rows of a fit of Huber's loss, then of those within `NOISY` times the stated noise, found in turn.
    """
    model, owners, N = problem.linearize(x), problem.owners, len(problem.data)
    A, b, count = model.A, model.b, np.maximum(np.bincount(owners, minlength=N), 1)
    weight, error = np.ones(N), np.ones(N)
    for k in range(2 * MOST_ROUNDS):
        w = weight[owners]
        z = np.linalg.solve((A.T * w) @ A + np.eye(A.shape[1]), A.T @ (w * b))
        error = np.sqrt(np.bincount(owners, (b - A @ z) ** 2, N) / count)
        weight = 1 / np.maximum(error, 1) if k < MOST_ROUNDS else (error < NOISY).astype(float)
    kept = weight > 0
    spare = count[kept].sum() - _freedom(model)
    if np.count_nonzero(~kept) < FEW or spare < _freedom(model):
        return
    size = float(np.sqrt(np.sum(count[kept] * error[kept] ** 2) / spare))
    times = rms(error[~kept]) / max(size, 1.0)
    if size < NOTICED and times > SCATTERED:
        rows = joined([problem.data.label[i] for i in np.flatnonzero(~kept)])  # all, as they are to be left out
        yield (
            f"residuals of rows {rows} are {three_digits(times)} times those of the others, which agree with the "
            "stated noise: was the reflector loose in its nest, or the arm not at rest? Measure them again, or leave "
            "them out ([exclude])."
        )


def _said_of_kinds(problem: CalibrationProblem, rows: np.ndarray, left: float) -> str:
    """Return the sentence on rows of two kinds."""
    named, label = _rows(problem.data, rows, "fits", "fit", len(rows)), problem.data.label
    if np.ptp(rows) == len(rows) - 1:
        named = f"rows {label[rows[0]]} to {label[rows[-1]]} fit"
    return (
        f"{named} other parameters than the rest (two calibrations leave {100 * left:.0f} % of the residuals): "
        "are they of another arm, tool or load, or were their joint values computed for another configuration of wrist "
        "or elbow? Calibrate the two groups separately, or leave one out ([exclude])."
    )


def two_positions(problem: CalibrationProblem, x: Array, most: float) -> Iterator[str]:
    """Report one or two joints that explain residuals at x (n,) if each is at either of two positions in every row.

    They leave less than a part ``most`` of them, two joints half of what one does at most.
    The parameters are fitted beside, with their prior. Random errors leave 60 % of the residuals, as their signs are
    fitted then and not their sizes, and much less where there are fewer than three equations a parameter.
    """
    model, free = problem.with_repeatability(None).linearize(x), problem.parameters.free
    if len(model.b) < 3 * len(x):
        return
    r, without = model.b - model.A @ (x / free.scale), _without_parameters(model)
    joints = [(i, free.names.index(name)) for i, name in enumerate(_zeros(problem.robot), 1) if name in free.names]
    joints = [(i, k) for i, k in joints if model.A[:, k].any()]
    best, alone, said = most, np.inf, ""
    for some in [*combinations(joints, 1), *combinations(joints, 2)]:
        numbers = [k for _, k in some]
        left, step, side = _either_side(r, without, problem.owners, [model.A[:, [k]] for k in numbers])
        if len(some) == 1:
            alone = min(alone, left)
        apart = 2e3 * np.abs(step) * free.scale[numbers]
        slipped = np.count_nonzero(np.diff(side, axis=0)) <= len(some)  # each joint once
        limit = best if len(some) == 1 else min(best, MOVED * alone)
        if left < limit and apart.min() >= 1e3 * LOOSE and not slipped:
            best = left
            units = ["mrad" if free.dimensions[k] == "angle" else "mm" for k in numbers]
            names = [numbered(i - 1, problem.robot.joint_names) for i, _ in some]
            steps = [f"joint {names[k]} by {apart[k]:.2g} {unit}" for k, unit in enumerate(units)]
            said = f"backlash, {joined(steps)}"
    if said:
        yield (
            f"{said}: one of two positions in every row explains the residuals (that leaves {100 * best:.0f} %). "
            "Approach all configurations from one side, or state the directions of approach (columns approach1, ...)."
        )


def two_states(problem: CalibrationProblem, x: Array, most: float = LOADS) -> Iterator[str]:
    """Report rows whose residuals at x (n,) one of two loads, bases or reflectors explains, to the noise.

    They leave less than a part ``most`` of them.
    """
    model, p = problem.with_repeatability(None).linearize(x), problem.parameters
    whole, there = _with_others(problem, x, np.char.startswith(np.array(p.names), "compliance"))
    A = whole.with_repeatability(None).linearize(there).A
    if len(model.b) < 3 * len(x):
        return
    separately = "or calibrate the two groups separately"
    stated = f"State payload_kg of every row and add `compliance?` to `identify`, {separately}"
    states = {
        "load at the flange": ("compliance", f"was a tool or a workpiece attached? {stated}"),
        "base": (
            "base_",
            f"does the robot or the instrument tip, or stand loose? Fix it and measure again, {separately}",
        ),
        "reflector": ("tool_", f"is it loose, or are there two? Name them in a column `marker`, {separately}"),
    }
    r, without = model.b - model.A @ (x / p.free.scale), _without_parameters(model)
    best, said = most, ""
    for what, (prefix, cause) in states.items():
        columns = A[:, np.char.startswith(whole.parameters.free.names, prefix)]
        columns = columns[:, columns.any(axis=0)]
        if not columns.size:
            continue
        left, _, side = _either_side(r, without, problem.owners, [columns])
        rows = np.flatnonzero(side[:, 0] == (1 if side.sum() <= 0 else -1))
        if left < best and left * rms(r) < NOTICED and len(rows) >= FEWEST:
            best, fit = left, _rows(problem.data, rows, "fits", "fit", len(rows))
            said = (
                f"{fit} another {what} (one of two in every row explains the residuals; that leaves "
                f"{100 * left:.0f} %): {cause}."
            )
    if said:
        yield said


def _either_side(
    r: Array, without: Callable[[Array], Array], rows: np.ndarray, groups: Sequence[Array]
) -> tuple[float, Array, np.ndarray]:
    """Return what part of residuals r (m,) groups of columns (m, k) leave that count +1 or -1 in every row.

    Beside it their coefficients, and the sides (N, groups). They start with what changes residuals most.
    """
    steps: Any = []
    for G in groups:
        moments = np.column_stack([np.bincount(rows, column * r) for column in G.T])
        size = G.T @ G
        c = scipy.linalg.eigh(moments.T @ moments, size + SINGULAR * np.trace(size) * np.eye(len(size)))[1][:, -1]
        steps.append(c * np.linalg.norm(r) / max(np.linalg.norm(G @ c), TINY))
    sides = np.array(list(product((-1.0, 1.0), repeat=len(groups))))
    target, columns = r, np.hstack(groups)
    chosen, rest = sides[:1], without(r[:, None])[:, 0]
    for _ in range(MOST_ROUNDS):
        moved = np.column_stack([G @ step for G, step in zip(groups, steps, strict=True)])
        errors = [np.bincount(rows, (target - moved @ side) ** 2) for side in sides]
        before, chosen = columns, sides[np.argmin(errors, axis=0)]
        columns = np.hstack([G * chosen[rows, [i]][:, None] for i, G in enumerate(groups)])
        if np.array_equal(columns, before):
            break
        step = np.linalg.lstsq(without(columns), rest, rcond=None)[0]
        target = without((r - columns @ step)[:, None])[: len(r), 0] + columns @ step
        steps = np.split(step, np.cumsum([G.shape[1] for G in groups])[:-1])
    found = np.concatenate(steps, dtype=float)
    return float(np.linalg.norm(target - columns @ found) / max(np.linalg.norm(r), TINY)), found, chosen


def _zeros(robot: Robot) -> list[str]:
    """Return the names of the parameters that joint zeros are."""
    return [f"{'theta' if kind == 'revolute' else 'd'}{i}" for i, kind in enumerate(robot.joint_types, start=1)]


def _gears(problem: CalibrationProblem, model: LinearModel) -> Iterator[Addition]:
    """Yield every gear ratio and coupling, and a lag of all joints."""
    robot, free = problem.robot, problem.parameters.free
    slopes = model.A / free.scale
    q = problem.joint_values
    of_zero = {i: slopes[:, free.names.index(name)] for i, name in enumerate(_zeros(robot)) if name in free.names}

    def gear(i: int, j: int, coefficients: Array) -> tuple[str, str]:
        factor = coefficients[0]
        to_model = robot.joint_map.copy()
        to_model[i] += factor * robot.joint_map[j]
        one, other = (numbered(k, robot.joint_names) for k in (i, j))
        what = f"joint {one} turns {100 * factor:+.2g} % more than its encoder reads (gear ratio)"
        if i != j:
            sign = signs(robot.joint_map)
            part = sign[i] * factor * sign[j]
            what = f"joint {one} is coupled to joint {other} (q{i + 1} {part:+.4f} q{j + 1})"
            if abs(part) < COUPLED:
                return what, "no gears have so small a ratio: have bearings, hoses and mounting of both joints checked"
        return what, coupling(to_model)

    for i, j in product(of_zero, range(q.shape[1])):
        if q[:, j].any():
            yield Addition((of_zero[i] * q[problem.owners, j])[:, None], partial(gear, i, j))
    if len(of_zero) == len(robot.mdh):
        way = np.diff(q, axis=0, prepend=q[:1])[problem.owners]
        lag = np.sum([zero * way[:, i] for i, zero in of_zero.items()], axis=0)
        remedy = "read both when the arm stands still"

        def lags(c: Array) -> tuple[str, str]:
            way = "lag behind" if c[0] > 0 else "run ahead"
            return f"joint values {way} by {100 * abs(c[0]):.2g} % of each move", remedy

        yield Addition(lag[:, None], lags)


def _scales(problem: CalibrationProblem, x: Array, model: LinearModel) -> Iterator[Addition]:
    """Yield the scale and the offset of lengths, and of positions the scales and skews of their axes."""
    free = problem.parameters.free
    base = [free.names.index(f"base_{c}") for c in "xyz" if f"base_{c}" in free.names]
    y = np.zeros((len(problem.data), 3))
    lengths = np.zeros((len(problem.data), 2))
    for block in problem.data.blocks:
        if block.measurement.name in ("position", "pose") and len(base) == 3:
            y[block.row] = block.y[:, :3]
        elif block.measurement.name in ("cable", "distance"):
            lengths[block.row] = np.column_stack([block.y, np.ones(len(block.y))])
    along = lengths[problem.owners]
    if lengths.any():  # in units of the equations
        unit = np.linalg.norm(model.A, axis=1) / np.linalg.norm(problem.jacobian(x) * free.scale, axis=1)
        along *= unit[:, None]
    y = y[problem.owners]
    of_axis = model.A[:, base] / free.scale[base]
    if y.any():
        radial = y / np.maximum(np.linalg.norm(y, axis=1, keepdims=True), 1e-9)
        along += np.column_stack([np.sum(of_axis * y, axis=1), np.sum(of_axis * radial, axis=1)])

    def scaled(column: Array, what: str, remedy: str, of: str = "too long") -> Addition:
        # a scale that shrinks positions to half and less fits values that have nothing to do with the robot
        return Addition(column[:, None], lambda c: (f"{what} {100 * c[0]:+.2g} % {of}", remedy), most=0.5)

    def longer(share: Array | float, when: str, remedy: str) -> Addition:
        said = "{}measured distances are {} mm too long".format
        return Addition((along[:, 1] * share)[:, None], lambda c: (said(when, three_digits(1e3 * c[0])), remedy))

    yield scaled(along[:, 0], "measured lengths are", "check the scale of the instrument")
    yield longer(1.0, "", "check the instrument's zero and the reflector's radius")
    for when, share in _shares(problem).items():
        yield longer(share, f"{when} ", "check the reflector and its radius in these rows")
    if y.any():  # of an instrument at the origin: index of the vertical circle, eccentricity of both
        flat = np.linalg.norm(y[:, :2], axis=1, keepdims=True)
        radius = np.maximum(np.linalg.norm(y, axis=1, keepdims=True), 1e-9)
        turn = np.column_stack([-y[:, 1], y[:, 0], np.zeros(len(y))])
        rise = np.column_stack([-y[:, :2] * y[:, [2]] / np.maximum(flat, 1e-9), flat])
        sines = np.hstack([y[:, :2] / np.maximum(flat, 1e-9), flat / radius, y[:, [2]] / radius])
        parts = [rise, *(sines[:, [k]] * (turn if k < 2 else rise) for k in range(4))]
        circles = np.column_stack([np.sum(of_axis * each, axis=1) for each in parts])
        said = "angles of the instrument at the origin are wrong by up to {} mrad (index and eccentricity of circles)"
        of_circles = "measure in both faces, and have it checked"
        yield Addition(circles, lambda c: (said.format(three_digits(1e3 * np.abs(c).max())), of_circles))
        middle = y - np.mean(y, axis=0)
        cubic = np.sum(of_axis * middle * np.sum(middle**2, axis=1, keepdims=True), axis=1)
        lens = "calibrate the instrument's lens or refraction, or measure nearer to its axis"
        distorted = "measured positions are distorted with the cube of their distance from the mean"
        yield Addition(cubic[:, None], lambda c: (distorted, lens))
    for i, j in combinations_with_replacement(range(3 * bool(y.any())), 2):
        what = (f"column {'xyz'[i]} is", "check its scale")
        if i != j:
            axes = "check whether the instrument's axes are square"
            what = (f"column {'xyz'[i]} contains", axes, f"of column {'xyz'[j]}")
        yield scaled(of_axis[:, i] * y[:, j], *what)
