"""What rows of a table show by themselves: missing, copied, filled-in and rounded values, ranges and limits."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.text import listed, three_digits
from rpim_opt.basics.units import display
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.problem.noise import Equations
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.mdh import Robot

LEAST_TRAVEL = {"revolute": np.radians(10), "prismatic": 0.01}  # a joint that moves less [rad, m] is hardly seen
ALIKE = (0.4, 2.5)  # rounding explains errors that are between these multiples of what it makes
MANY_MINUTES, TAKEN_UP = 30, 0.05  # different decimals below .60 that are no chance, and what a model leaves of them
ONE_BY_ONE = 0.9  # share of rows in which one joint alone is moved, from which how joints act together is unknown
REACH, ANGULAR = 0.003, 0.02
"""Residual RMS over the length of the arm, and of orientations [rad], that a robot's own errors stay below."""
FEW = 3  # outliers from which on they may have one cause
FEWEST = 6  # rows on either side of a change, or of which copies are told
BEYOND_REACH = 3.0
"""Lengths of the arm by which a position may be away from the others."""
MOST_LOST = 0.25  # part of the rows that may be so by lost decimal points: more are of another frame or quantity
MOST_DECIMALS = 4  # that are counted
ON_GRID = 2e-4  # part of a step by which rounded values may miss it, for their last decimal
ANOTHER = 0.01  # joint movement [rad, m] after which no point is measured again to the last digit
FILLED = 1e-3  # a point that is at least so far from the one before [m] is another one
STALE = 5e-3  # movement [m] at equal joint values that is no scatter: the arm was elsewhere
COPIES = 0.2  # part of the rows that may repeat others
TOGETHER, CHANCE_RUNS = 4, 0.05
"""Excluded rows that follow each other, from which on something moved, if chance makes fewer such runs than that."""
EXACT = 1e-5  # what no measurement comes up to [m]
OUTLYING = 10  # one of so many rows may be an outlier of a calibration


def in_table_order(problem: CalibrationProblem, *apart: Dataset | None) -> CalibrationProblem:
    """Return a problem with its held-out rows put back, in the order of the table by the numbers in their labels.

    The problem is returned as it is if its labels do not increase (except held-out rows behind the others), or if parts
    have other labels (P07_A, v7): a table of its own has no neighbouring rows.
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


def hardly_moved(robot: Robot, measured: Array) -> Iterator[str]:
    """Yield which joints moved less than `LEAST_TRAVEL` in measured ranges (2, dof), and how far, as text."""
    for i, (travel, dimension) in enumerate(zip(np.ptp(measured, axis=0), robot.joint_dimensions, strict=True)):
        if travel < LEAST_TRAVEL[robot.joint_types[robot.leading[i]]]:
            unit, si = display(dimension)
            yield f"joint {robot.joint(i)} moves only {travel / si:.2f} {unit}"


def moved_one_by_one(robot: Robot, q: Array) -> bool:
    """Return whether nearly all joint values (N, dof) differ from a common configuration in at most one joint."""
    near = np.array([LEAST_TRAVEL[robot.joint_types[i]] / 10 for i in robot.leading])
    away = np.abs(q - np.median(q, axis=0)) > near
    return robot.dof > 1 and bool(np.mean(away.sum(axis=1) <= 1) > ONE_BY_ONE)


def beyond_limits(robot: Robot, q: Array, by: float = 0.0) -> Iterator[str]:
    """Report joints whose values (N, dof) exceed their limits by more than ``by`` times their range."""
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


def named_rows(data: Dataset, rows: np.ndarray, of_one: str, of_several: str, most: int = 8) -> str:
    """Return the names of the first rows, and the verb that follows."""
    labels = [data.label[i] for i in rows]
    if len(labels) == 1:
        return f"row {labels[0]} {of_one}"
    return f"rows {listed(labels, most)} {of_several}"


def stretched_length(robot: Robot, blocks: Iterable[Block]) -> float:
    """Return the length of the arm stretched out [m], prismatic joints as far as they moved in blocks."""
    sliding = np.array(robot.joint_dimensions) == "length"
    moved = blocks if sliding.any() else ()
    strokes = [np.abs(block.q[..., sliding]).max(axis=(0, 1)) for block in moved if block.q.shape[-1] == robot.dof]
    return float(np.abs(robot.mdh[:, [1, 3]]).sum() + np.max(strokes, axis=0, initial=0.0).sum())


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
            which = named_rows(data, block.row[same & (y[:, 0] == value)], "has", "have")
            yield (
                f"{which} {number} for every measured coordinate: missing measurements? Exclude such rows ([exclude])."
            )
        reach = stretched_length(arms[block.robot], [block])
        away = np.linalg.norm(y - np.median(y, axis=0), axis=1)
        lost = block.row[away > BEYOND_REACH * reach]
        if 0 < len(lost) < MOST_LOST * len(y):
            yield (
                f"{named_rows(data, lost, 'is', 'are')} farther from the others than the arm is long: was a decimal "
                "point lost, or is it another unit?"
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
    """Report rows that duplicate others in joint and measured values, or points in measured values alone."""
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
        points, count = np.unique(block.y, axis=0, return_inverse=True, return_counts=True)[1:]
        copies = len(first) - len(count)  # of rows that differ in joint values
        if block.y.shape[1] >= 3 and copies >= COPIES * len(rows):
            named = listed([data.label[row] for row in block.row[count[points.ravel()] > 1]], 3)
            yield (
                f"{copies} of {len(rows)} rows have measured values of others to the last digit ({named}): were points "
                "pasted twice? Measure them again, or leave them out ([exclude])."
            )


def filled_rows(data: Dataset) -> Iterator[str]:
    """Report rows that were filled in: means of neighbours, joint values or the measured point of the previous row.

    The data have the order of the table.
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
            which = named_rows(data, between, "is", "are")
            yield (
                f"{which} exactly half way between the points before and after: interpolated, not measured; leave out "
                "what was filled in ([exclude])."
            )
        again = (q[1:] == q[:-1]).all(axis=1) & (moves > STALE)
        if again.any():
            repeated = np.count_nonzero(again & ~np.append(False, again[:-1]))
            cause = "the log was not updated; leave such rows out ([exclude])."
            if 2 * repeated > len(q) - np.count_nonzero(again):  # most configurations: no accident
                cause = "are they of several reflectors? Name each row's reflector in a column `marker`."
            which = named_rows(data, row[1:][again], "has", "have")
            yield f"{which} the joint values of the row before at another point: {cause}"
        frozen = (moves == 0) & (np.abs(np.diff(q, axis=0)).max(axis=1) > ANOTHER) & (np.ptp(y[1:], axis=1) > 0)
        if np.count_nonzero(frozen) >= FEW:
            which = named_rows(data, row[1:][frozen], "has", "have")
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
    """What is rounded, the RMS error that this causes [m], and the remedy.

    Residuals are at least a part ``least`` of it; ``step`` is the common resolution of all joints, empty without.
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
    """Report rounding of joint or measured values if the RMS error [m] of a fit is below ``most`` times its own."""
    for each in every_rounding(problem):
        if each.least * each.made < error < most * each.made:
            yield (
                f"{each.what}: that alone contributes {three_digits(1e3 * each.made)} mm, the residual RMS is "
                f"{three_digits(1e3 * error)} mm: {each.remedy}."
            )


def every_rounding(problem: CalibrationProblem) -> Iterator[Rounding]:
    """Yield all roundings of joint and measured values, whether or not they explain a fit."""
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
    """Return the rounding of values (N,): of 16-bit floats, a grid of such a step, or 3 or 4 digits; zeros for none.

    16-bit floats have 11 significant bits; if written with few decimals, half of the last one may be missing.
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
    """Return the step of the decimal grid that values are on, up to 4 decimals; 0 if on none, or all are equal."""
    decimals = decimals_of(values)
    if decimals is None or not np.ptp(values):
        return 0.0
    return float(np.gcd.reduce((values * 10.0**decimals).round().astype(int))) / 10.0**decimals


def decimals_of(values: Array) -> int | None:
    """Return how many decimals all values have at most, up to `MOST_DECIMALS`; None where they have more."""
    for decimals in range(MOST_DECIMALS + 1):
        scaled = values * 10.0**decimals
        if np.abs(scaled - scaled.round()).max(initial=0.0) < 1e-6 * np.abs(scaled).max(initial=1.0) ** 0.5:
            return decimals
    return None
