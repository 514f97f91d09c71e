"""Input check before calibration: ranges, suspicious rows, observability."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, combinations_with_replacement, product
from typing import Any

import numpy as np
from scipy.special import fdtrc

from rpim_opt.basics.arrays import Array, statistics
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import Tabled, counted, joined, listed, table, three_digits
from rpim_opt.basics.units import display
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.measurement import of_fixture
from rpim_opt.problem.design import Observability, observe
from rpim_opt.problem.linear import LinearModel
from rpim_opt.problem.misreadings import WRONG, better_reading, coupling, fit_points, misfit, signs
from rpim_opt.problem.noise import Equations
from rpim_opt.problem.problem import CalibrationProblem, near_parallel
from rpim_opt.problem.registration.closed_forms import transformed
from rpim_opt.problem.registration.frames import fitted_frames
from rpim_opt.problem.registration.points import Points, lengths_of, points_of
from rpim_opt.problem.row_functions import repeatable
from rpim_opt.robot.kinematics import FRAME, forward_kinematics
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import tool_prefix

LEAST_TRAVEL = {"revolute": np.radians(10), "prismatic": 0.01}
"""A joint that moves less [rad, m] is hardly seen."""
SPREAD = {"length": ("mm", 1e-3), "pixel": ("px", 1.0)}
"""Units of typical deviations, where they are not milliradians."""
STANDS_OUT = 5.0
"""Rows further than this many robust standard deviations above the median residual are listed."""
FAR = 5.0
"""A row is in question from so many medians of the errors on."""
FITS = 0.2
"""What a row is mistaken for leaves less than this part of its error."""
ALIKE = (0.4, 2.5)
"""Rounding explains errors that are between these multiples of what it makes."""
MOVED = 0.5
"""An instrument has moved if that leaves less than this part of the sum of squares."""
FAR_MOVED = 0.005
"""Points that fit better than this part of their extent show an instrument's motion in the residuals alone."""
SMALL = 0.2
"""Ratios and couplings [1, m] from which on a linearization says nothing of them."""
RARE = 1e-6
"""Probability with which chance may explain what is reported."""
FLAT = 1e-3
"""A coordinate that spreads less than this part of another one is hardly measured."""
FEWEST = 6
"""Rows on either side of a change, or of which copies are told."""
LINEAR, EXACT = 13, 1e-5
"""Coefficients of a coordinate by position and rotation of the flange, and what no measurement comes up to [m]."""
BEYOND_REACH = 3.0
"""Lengths of the arm by which a position may be away from the others, if they are not so far themselves."""
UNRELATED = 0.5
"""Part of the spread of positions that a fit leaves where joint values do not explain them."""
ON_GRID = 2e-4
"""Part of a step by which rounded values may miss it, for their last decimal."""
NARROWER, GRID = 0.25, 61
"""Factor by which the grid for a joint's values gets narrower from round to round, and its points."""
SEVERAL = 0.85
"""Several joint zeros moved, if that leaves less than this part of what one move leaves."""
LOOSE = 1e-3
"""A joint's random error [rad, m] that no gear in order has: a tenth of that is usual."""
COPIES = 0.2
"""Part of the rows that may repeat others."""
MOST_ROUNDS = 20
"""Of telling rows of one reflector from those of another, and of fitting one joint's values."""
TOGETHER, CHANCE_RUNS = 4, 0.05
"""Excluded rows that follow each other, from which on something moved, if chance makes fewer such runs than that."""
SPANS = 12
"""Places between which something may have moved, and moved back."""
MOST_EQUATIONS = 3000
"""Equations up to which a change is looked for."""


@dataclass(frozen=True, eq=False, repr=False)
class Inspection(Tabled):
    """Result of `inspect`.

    Parameters
    ----------
    problem
        What was inspected.
    residual
        (N,) error of every row [m], robot nominal, identified frames fitted.
    standing_out
        Labels of rows whose residual is far above the others', the largest first.
    repeated
        Groups of labels measured in the same configuration by the same reflector.
    repeatability
        Standard deviation of repeated measurements about their means [m], of one coordinate; None without any.
    warnings
        One sentence each: units, signs, frames, limits, coverage.
    proposals
        One sentence each: what the problem file could say.
    observability
        What the configurations can show.
    contact
        One sentence each: what touches show.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> found = ro.problem.inspect(ro.load("paper_arm", variant="misprints").problem)
    >>> found.standing_out, found.observability.rank, len(found.warnings)
    (('T8-6', 'T8-7'), 20, 0)
    """

    problem: CalibrationProblem
    residual: Array
    standing_out: tuple[str, ...]
    repeated: tuple[tuple[str, ...], ...]
    repeatability: float | None
    warnings: tuple[str, ...]
    proposals: tuple[str, ...]
    observability: Observability
    contact: tuple[str, ...] = ()

    @property
    def _mm(self) -> dict[str, float]:
        """Errors of the rows by label [mm]."""
        return dict(zip(self.problem.data.label, (1e3 * self.residual).tolist(), strict=True))

    def _short(self) -> str:
        o = self.observability
        seen = f"{o.rank} of {len(o.names)} combinations identifiable"
        return f"{self.problem.data._short()}, {seen}, {counted(len(self.warnings), 'warning')}"

    def _frame_rows(self) -> list[dict[str, Any]]:
        """Return the joints and how far they move."""
        robot = self.problem.robot
        rows = []
        for i, (q, dimension) in enumerate(zip(_all_q(self.problem.data).T, robot.joint_dimensions, strict=True)):
            unit, si = display(dimension)
            limited = np.isfinite(robot.limits[i]).all()
            limits = (robot.limits[i] / si).tolist() if limited else None
            share = float(np.ptp(q) / np.ptp(robot.limits[i])) if limited else None
            rows.append({"joint": f"q{i + 1}", "unit": unit, "from": q.min() / si, "to": q.max() / si,
                         "limits": limits, "share": share})  # fmt: skip
        return rows

    def _notes(self) -> list[str]:
        return [*(f"Warning: {text}" for text in self.warnings), *(f"Proposal: {text}" for text in self.proposals)]

    def __str__(self) -> str:
        """Return everything as a person reads it."""
        joints = []
        for r in self._frame_rows():
            figures = [f"{value:.2f}" for value in (r["from"], r["to"], r["to"] - r["from"])]
            limits, share = "-", "-"
            if r["limits"]:
                limits = f"{r['limits'][0]:.0f} to {r['limits'][1]:.0f}"
                share = f"{100 * r['share']:.0f} %"
            joints.append([r["joint"], r["unit"], *figures, limits, share])
        measured = []
        for r in self._measured():
            figures = ["-" if r[k] is None else f"{r[k]:.3f}" for k in ("from", "to")]
            of = [f"{r[f'sigma_{u}']:.3g} {u}" for u in ("mm", "mrad", "px") if r.get(f"sigma_{u}") is not None]
            measured.append([r["measured"], r["unit"], *figures, *(of or ["-"])])
        data = self.problem.data
        lines = [
            f"{len(data)} rows in {len(np.unique(data.configuration))} configurations. Nominal error "
            f"{1e3 * np.nanmean(self.residual):.3f} mm mean, {1e3 * np.nanmax(self.residual):.3f} mm max "
            f"({data.label[int(np.nanargmax(self.residual))]})."
        ]
        if self.repeated:
            groups = listed([", ".join(group) for group in self.repeated], 5, "; ")
            spread = f", repeatable to {1e3 * self.repeatability:.3g} mm" if self.repeatability else ""
            lines.append(f"Measured more than once in the same configuration{spread}: {groups}.")
        if self.standing_out:
            named = listed([f"{label} ({self._mm[label]:.2f} mm)" for label in self.standing_out], 10)
            lines.append(f"Exceptionally large nominal error: {named}.")
        notes = self._notes()
        parts = [
            table(["joint", "unit", "from", "to", "span", "limits", "of them"], joints),
            table(["measured", "unit", "from", "to", "typical sigma"], measured),
            "\n".join(lines),
            str(self.observability),
            "\n".join(self.contact),
            "\n".join(notes[: len(self.warnings)]),
            "\n".join(notes[len(self.warnings) :]),
        ]
        return "\n\n".join(filter(None, parts))

    def content(self) -> dict[str, Any]:
        """Return the same as a document; joints and measured values in the unit that they name."""
        o = self.observability
        return {
            "joints": self._frame_rows(),
            "measured": self._measured(),
            "rows": len(self.residual),
            "configurations": len(np.unique(self.problem.data.configuration)),
            "nominal": statistics(self.residual),
            "standing_out": [{"label": label, "error_mm": self._mm[label]} for label in self.standing_out],
            "repeated": self.repeated,
            "repeatability_mm": None if self.repeatability is None else 1e3 * self.repeatability,
            "observability": {
                "parameters": o.names, "rank": o.rank, "weak": o.weak,
                "condition": o.condition, "raw_condition": o.raw_condition, **o.indices,
                "unidentifiable": o.unidentifiable, "redundant": o.redundant,
            },
            "contact": self.contact,
            "warnings": self.warnings,
            "proposals": self.proposals,
        }  # fmt: skip

    def _measured(self) -> list[dict[str, Any]]:
        """Return the range and typical deviation of every measured column by kind, reflector and fixture."""
        rows: dict[str, dict[str, Any]] = {}
        for block in self.problem.data.blocks:
            kind = block.measurement
            sigma = np.sqrt(np.median(np.einsum("nii->ni", block.covariance), axis=0))
            of = dict(zip(kind.components, sigma, strict=True))
            where = ", ".join(part for part in (" to ".join(m for m in block.markers if m), block.fixture) if part)
            for i, (column, dimension) in enumerate((kind.columns or kind.components).items()):
                unit, si = display(dimension) if dimension else ("", 1.0)
                low, high = None, None
                if kind.columns:
                    low, high = block.y[:, i].min() / si, block.y[:, i].max() / si
                each, size = SPREAD.get(dimension, ("mrad", 1e-3))
                what = f"{kind.name}{f' of {where}' if where else ''}: {column}"
                typical = float(of[column]) / size if column in of else None
                rows[what] = {"measured": what, "unit": unit, "from": low, "to": high, f"sigma_{each}": typical}
        return list(rows.values())


def inspect(problem: CalibrationProblem, validation: Dataset | None = None) -> Inspection:
    """Check a problem's data: ranges, coverage, repeated rows, likely input mistakes, identifiability.

    Mistakes are units, signs, zeros, orders and couplings of joints, rows that are shifted, exchanged or have no value,
    left-handed frames, another robot, an instrument that moved: another reading of the data that leaves less than a
    fifth of the position error is named, with what to write. Of the rows that were kept apart for ``validation`` none
    should be an identification row.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> wrong = replace(problem.data.blocks[0], q=problem.data.blocks[0].q * [1, 1, -1, 1, 1, 1])
    >>> said = ro.problem.inspect(problem.on(replace(problem.data, blocks=(wrong,)))).warnings[-1]
    >>> said.split(":")[-1]
    ' write sign and theta_deg of these joints in robot.toml.'
    """
    if not problem.keeps_rows:
        raise InputError("inspect", "data in blocks", "one of them: inspect(part) for part in problem.rows()")
    data = problem.data
    fitted, x = fitted_frames(problem)
    residual = fitted.errors(x)
    middle = np.nanmedian(residual)
    spread = 1.4826 * np.nanmedian(np.abs(residual - middle))
    order = np.argsort(-np.nan_to_num(residual))
    far = [data.label[i] for i in order if residual[i] > middle + STANDS_OUT * spread] if len(data) > 4 else []
    repeated, repeatability = _repeated(data)
    needed = [name for name in near_parallel(problem.robot) if name not in problem.parameters.free.names]
    proposals = []
    if needed:
        pairs = ", ".join(f"{name[4:]} and {int(name[4:]) + 1}" for name in needed)
        proposals.append(f"the axes {pairs} are near parallel: add {', '.join(needed)} to `identify`.")
    # all are identified again, with frames where they were fitted
    names = problem.parameters.free.names
    own = dict(zip(fitted.parameters.free.names, x, strict=True))
    whole = problem.with_parameters(replace(fitted.parameters, identified=problem.parameters.identified))
    warnings = [*_ranges(problem), *copied_rows(data), *shared_rows(data, validation), *rows_without_values(problem)]
    better = better_reading(problem)
    if better is not None:
        warnings.append(better.sentence)
    else:
        warnings += exchanged_rows(problem)
        there = np.array([own.get(name, 0.0) for name in names])
        warnings += list(moved_far(problem)) or shown_by_residuals(whole, there, transmission=False)
    return Inspection(
        problem=problem,
        residual=residual,
        standing_out=tuple(far),
        repeated=repeated,
        repeatability=repeatability,
        warnings=tuple(warnings),
        proposals=tuple(proposals),
        observability=observe(whole),
        contact=tuple(contact_sentences(problem)),
    )


# What is said of a table


def _all_q(data: Dataset) -> Array:
    return np.concatenate([block.q.reshape(-1, block.q.shape[2]) for block in data.blocks])


def _repeated(data: Dataset) -> tuple[tuple[tuple[str, ...], ...], float | None]:
    """Return the labels of rows of one configuration, and the standard deviation of their lengths about their means."""
    groups: list[tuple[str, ...]] = []
    squares, freedom = 0.0, 0
    for block in data.blocks:
        lengths = [i for i, d in enumerate(block.measurement.columns.values()) if d == "length"]
        _, which, count = np.unique(repeatable(block).round(7), axis=0, return_inverse=True, return_counts=True)
        for k in np.flatnonzero(count > 1):
            rows = np.flatnonzero(which == k)
            groups.append(tuple(data.label[i] for i in block.row[rows]))
            y = block.y[rows][:, lengths]
            squares += float(np.sum((y - y.mean(axis=0)) ** 2))
            freedom += (len(rows) - 1) * len(lengths)
    return tuple(groups), float(np.sqrt(squares / freedom)) if freedom else None


def _ranges(problem: CalibrationProblem) -> Iterator[str]:
    """Say which joints leave their limits or hardly move, and which units or rows may be mistaken."""
    robot = problem.robot
    q = _all_q(problem.data)
    for i, dimension in enumerate(robot.joint_dimensions):
        unit, si = display(dimension)
        low, high = robot.limits[i]
        if q[:, i].min() < low - 1e-9 or q[:, i].max() > high + 1e-9:
            yield f"joint {i + 1} leaves its limits {low / si:.1f} to {high / si:.1f} {unit}."
        if np.ptp(q[:, i]) < LEAST_TRAVEL[robot.joint_types[robot.leading[i]]]:
            yield f"joint {i + 1} moves only {np.ptp(q[:, i]) / si:.2f} {unit}: its parameters are poorly identifiable."
    turning = [i for i, dimension in enumerate(robot.joint_dimensions) if dimension == "angle"]
    if turning:
        largest = np.abs(q[:, turning]).max()
        if largest > 4 * np.pi:
            yield f"joints reach {np.degrees(largest):.0f} deg: degrees given as radians?"
        if largest < np.radians(2 * np.pi):
            yield "no joint leaves 6.3 deg: radians given as degrees?"
    for block in problem.data.blocks:
        if block.y.shape[1] < 3:
            continue
        label = [problem.data.label[row] for row in block.row]
        _, first, which = np.unique(block.y, axis=0, return_index=True, return_inverse=True)
        for i, k in enumerate(first[which.ravel()]):  # a column in NumPy 2.0
            if not np.allclose(block.q[i], block.q[k]):
                both = f"rows {label[k]} and {label[i]}"
                yield f"{both} have the same measured values in different configurations: copied?"


def rows_without_values(problem: CalibrationProblem) -> Iterator[str]:
    """Report rows with zeros or one number for all measured coordinates, which instruments write for missing values."""
    data = problem.data
    for block in data.blocks:
        if len(block.measurement.columns) < 3:
            continue
        y = block.y[:, :3]
        same = (y == y[:, :1]).all(axis=1)
        for value in np.unique(y[same, 0]):
            labels = [data.label[i] for i in block.row[same & (y[:, 0] == value)]]
            what = f"{_rows(labels, 'has', 'have')} {value:g} for every measured coordinate"
            yield f"{what}: missing measurements? Exclude such rows ([exclude])."
        arm = problem.arms[block.robot]
        sliding = [i for i, dimension in enumerate(arm.joint_dimensions) if dimension == "length"]
        reach = float(np.abs(arm.mdh[:, [1, 3]]).sum() + np.ptp(block.q[..., sliding], axis=(0, 1)).sum())
        away = np.linalg.norm(y - np.median(y, axis=0), axis=1)
        labels = [data.label[i] for i in block.row[away > BEYOND_REACH * max(reach, float(np.median(away)))]]
        if labels:
            yield (
                f"{_rows(labels, 'is', 'are')} farther from the others than the arm is long: was a decimal point lost, "
                "or is it another unit?"
            )


def _rows(labels: list[str], of_one: str, of_several: str) -> str:
    """Name rows before their verb."""
    if len(labels) == 1:
        return f"row {labels[0]} {of_one}"
    return f"rows {listed(labels)} {of_several}"


def shared_rows(data: Dataset, validation: Dataset | None) -> Iterator[str]:
    """Report rows of the validation set that are copies of identification rows."""

    def rows(of: Dataset) -> list[tuple[bytes, str]]:
        return [
            (block.q[i].tobytes() + block.y[i].tobytes(), of.label[row])
            for block in of.blocks
            if block.measurement.columns
            for i, row in enumerate(block.row)
        ]

    if validation is None:
        return
    own = dict(reversed(rows(data)))  # of copies the first
    both = [(label, own[key]) for key, label in rows(validation) if key in own]
    copies = [label if label == other else f"{label} ({other})" for label, other in both]
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


def computed_columns(problem: CalibrationProblem) -> Iterator[str]:
    """Report coordinates that are exact functions of the nominal robot: computed, not measured.

    A coordinate of a point in any frame, of any reflector, is linear in position and rotation of the nominal flange.
    """
    points = points_of(problem)
    if points is None or points.seen or len(points.row) < 2 * LINEAR or len(points.tools) > 1:
        return
    T = forward_kinematics(problem.robot, points.q)
    X = np.column_stack([T[:, :3, 3], T[:, :3, :3].reshape(len(T), 9), np.ones(len(T))])
    left = points.y - X @ np.linalg.lstsq(X, points.y, rcond=None)[0]
    exact = np.sqrt(np.sum(left**2, axis=0) / (len(X) - LINEAR)) < EXACT
    if exact.any() and not exact.all():
        named = joined([axis for axis, k in zip("xyz", exact, strict=True) if k])
        yield f"column {named} follows from the nominal robot to {1e3 * EXACT:g} mm: was it computed, not measured?"


def left_out_together(labels: Sequence[str], left_out: Collection[str]) -> Iterator[str]:
    """Report excluded rows that are consecutive, if the labels are in numerical order."""
    numbers = {label: [int(part) for part in re.findall(r"\d+", label)] for label in (*labels, *left_out)}
    ordered = sorted(numbers, key=lambda label: numbers[label])
    if [label for label in ordered if label not in left_out] != list(labels):
        return
    at = np.array([i for i, label in enumerate(ordered) if label in left_out], dtype=int)
    for run in np.split(at, np.flatnonzero(np.diff(at) > 2) + 1):
        if len(run) < TOGETHER:
            continue
        # expected number of such runs of the other outliers, each within two rows of the last
        share = (len(at) - len(run)) / max(len(ordered) - len(run), 1)
        if len(at) * (1 - (1 - share) ** 2) ** (len(run) - 1) < CHANCE_RUNS:
            yield (
                f"rows {ordered[run[0]]} to {ordered[run[-1]]} were excluded as outliers, and follow each other: "
                "did the instrument or the robot's base move there? Calibrate the two parts separately, or "
                "register the second one again."
            )


# What points of the nominal robot say


def exchanged_rows(problem: CalibrationProblem) -> Iterator[str]:
    """Report rows that fit the joint values, or the reflector, of another row."""
    points = points_of(problem)
    if points is None:
        return
    fit = fit_points(problem.robot, points)
    label = [problem.data.label[i] for i in points.row]
    far = np.flatnonzero(fit.error > FAR * np.median(fit.error))
    pairs = []
    for i, j in combinations(far, 2):
        crossed = np.linalg.norm([points.y[i] - fit.modelled[j], points.y[j] - fit.modelled[i]], axis=1)
        if points.marker[i] == points.marker[j] and (crossed < FITS * fit.error[[i, j]]).all():
            pairs.append(f"{label[i]} and {label[j]}")
    if pairs:
        yield f"the measured values of rows {listed(pairs)} fit each other's joint values: exchange them."
    if len(points.tools) < 2 or not len(far):
        return
    flange = forward_kinematics(problem.robot, points.q[far])
    model = transformed((fit.base @ flange)[:, None], fit.tools)
    error = np.linalg.norm(points.y[far, None] - model, axis=2)  # of every reflector, which the other rows place
    error[np.arange(len(far)), points.marker[far]] = np.inf
    markers = [label[i] for i in far[error.min(axis=1) < FITS * fit.error[far]]]
    if markers:
        yield (
            f"{_rows(markers, 'fits', 'fit')} another reflector than the stated one (column marker): reflectors "
            "swapped?"
        )


def rounded(problem: CalibrationProblem, error: float) -> Iterator[str]:
    """Report rounding of joint or measured values that explains the RMS error [m] of a fit."""
    causes: list[tuple[str, float, str]] = []  # what is rounded to what, what that makes [m], and what helps
    for block in problem.data.blocks:
        if len(block.y) < FEWEST:  # lengths of a drawing are round
            continue
        lengths = [i for i, dimension in enumerate(block.measurement.columns.values()) if dimension == "length"]
        values = 1e3 * block.y[:, lengths]
        exponents = np.floor(np.log10(np.maximum(np.abs(values), 1.0)))
        gaps = np.diff(np.unique(values))  # a grid of any step, or the last of 3 or 4 digits
        units = (np.full(values.shape, gaps.min(initial=np.inf)), 10.0 ** (exponents - 2), 10.0 ** (exponents - 3))
        exact = (unit for unit in units if np.abs(values / unit - (values / unit).round()).max(initial=0.0) < ON_GRID)
        unit = next(exact, np.zeros(values.shape))
        made = 1e-3 * float(np.sqrt(np.sum(np.mean(unit**2, axis=0)) / 12))
        remedy = "export more decimals, or state the rounding as their noise"
        causes.append((f"measured values are rounded to {unit.max(initial=0.0):.4g} mm", made, remedy))
    turning = np.array(problem.robot.joint_dimensions) == "angle"
    slopes = problem.joint_slopes()[Equations.of(problem.data).length]
    arm = float(np.sqrt(np.sum(slopes**2) / len(problem.data)))  # how far all joints move a point, a radian each
    for unit, size in (("deg", np.pi / 180), ("rad", 1.0)):
        angles = _all_q(problem.data)[:, turning] / size
        decimals = decimals_of(angles)
        if decimals is not None:
            digits = (angles * 10.0**decimals).round().astype(int)
            step = float(np.gcd.reduce(digits, axis=None)) / 10.0**decimals  # half degrees are rounded as well
            remedy = "export them with more decimals"
            causes.append((f"joint values are rounded to {step:g} {unit}", size * step / np.sqrt(12) * arm, remedy))
    degrees = np.abs(np.degrees(_all_q(problem.data)[:, turning]))
    if ((degrees % 1).round(6) < 0.6).all():
        made = np.radians(0.4) / np.sqrt(3) * arm
        causes.insert(0, ("joint values look like degrees and minutes (no decimals from .60 on)", made, "convert them"))
    for what, made, remedy in causes:
        if ALIKE[0] * made < error < ALIKE[1] * made:
            yield (
                f"{what}: that alone contributes {three_digits(1e3 * made)} mm, the residual RMS is "
                f"{three_digits(1e3 * error)} mm: {remedy}."
            )
            return


def unrelated_rows(problem: CalibrationProblem, error: float) -> Iterator[str]:
    """Report an RMS error [m] of a fit that is nearly the spread of the positions."""
    points = points_of(problem)
    if points is None:
        return
    spread = float(np.sqrt(np.sum(np.var(points.y, axis=0))))
    if error > UNRELATED * spread:
        yield (
            f"joint values hardly explain the measured positions (residual RMS {three_digits(1e3 * error)} mm, their "
            f"spread is {three_digits(1e3 * spread)} mm): do the rows of the two tables match? Join them by a "
            "common column, or by time."
        )


def odd_columns(problem: CalibrationProblem) -> Iterator[str]:
    """Report columns of joint and measured values that are identical or sorted, coordinates that are flat or unsigned.

    Asked of data that nothing else explains: a robot may be measured so.
    """
    for block in problem.data.blocks:
        q, y = block.q[:, 0], block.y[:, :3]
        named = dict(zip([*(f"q{i + 1}" for i in range(q.shape[1])), *"xyz"], np.hstack([q, y]).T, strict=False))
        ordered = [name for name, column in named.items() if np.ptp(column) > 0 and (np.diff(column) >= 0).all()]
        if len(ordered) == 1 and len(q) >= 2 * FEWEST:
            yield f"column {ordered[0]} is in ascending order, and no other one: was it sorted alone?"
        for (one, first), (other, second) in combinations(named.items(), 2):
            if np.ptp(first) > 0 and (first == second).all():
                yield f"columns {one} and {other} have the same values: is one a copy?"
        if y.shape[1] == 3:
            spread = y.std(axis=0)
            for k in np.flatnonzero(spread < FLAT * spread.max()):
                yield f"column {'xyz'[k]} spreads over {three_digits(1e3 * spread[k])} mm only: is it another column?"
            if y.min() >= 0 and len(q) >= 2 * FEWEST:
                yield "no value of column x, y and z is negative: were signs lost?"


def odd_joint(problem: CalibrationProblem) -> Iterator[str]:
    """Report a joint whose values explain nothing: if every row may have its own, the other joints explain the points.

    Base, reflectors and the joint's values are fitted in turn, the values on a grid that gets narrower.
    """
    points = points_of(problem)
    if points is None or len(points.row) < 2 * FEWEST or points.turns is not None:
        return
    robot = problem.robot
    whole = misfit(robot, points)
    fitted = [(_values_that_fit(robot, points, i), i) for i in range(robot.dof) if robot.joint_types[i] == "revolute"]
    left = [misfit(robot, replace(points, q=q)) for q, _ in fitted]
    best = int(np.argmin(left))
    if left[best] >= min(FITS * whole, WRONG):  # free values take up much of any other mistake
        return
    q, i = fitted[best]
    measured, estimated = points.q[:, i], q[:, i]
    apart = np.abs(np.angle(np.exp(1j * (estimated - measured))))
    label = [problem.data.label[row] for row in points.row]
    odd = [label[k] for k in np.flatnonzero(apart > LEAST_TRAVEL["revolute"] / 2)]
    what = f"{_rows(odd, 'has', 'have')} wrong values of joint {i + 1}"
    if len(odd) > len(label) / 2:
        what = f"the values of joint {i + 1} explain nothing (sorted, shuffled or scaled alone, or another quantity?)"
    yield (
        f"{what}: with other ones the points fit to {three_digits(1e3 * left[best] * points.extent)} mm instead of "
        f"{three_digits(1e3 * whole * points.extent)} mm; check column q{i + 1}."
    )


def _values_that_fit(robot: Robot, points: Points, joint: int) -> Array:
    """Return joint values (N, dof) in which one joint's are those that fit best."""
    q, width = points.q, np.pi
    rows = np.arange(len(q))
    steps = np.linspace(-1, 1, GRID)
    around: Any = 0.0
    for _ in range(MOST_ROUNDS):
        fit = fit_points(robot, replace(points, q=q))
        tries = np.repeat(q[:, None], GRID, axis=1)
        tries[..., joint] = around + width * steps
        frames = fit.base @ forward_kinematics(robot, tries.reshape(-1, robot.dof))
        tips = np.repeat(fit.tools[points.marker], GRID, axis=0)
        modelled = np.einsum("kij,kj->ki", frames[:, :3, :3], tips) + frames[:, :3, 3]
        error = np.linalg.norm(points.y[:, None] - modelled.reshape(len(q), GRID, 3), axis=2)
        chosen = tries[rows, error.argmin(axis=1)]
        if width < np.pi or np.array_equal(chosen, q):
            around, width = chosen[:, [joint]], width * NARROWER
        q = chosen
    return q


def decimals_of(values: Array) -> int | None:
    """Return how many decimals all values have at most, up to 4; None where they have more."""
    for decimals in range(5):
        scaled = values * 10.0**decimals
        if np.abs(scaled - scaled.round()).max(initial=0.0) < 1e-6 * np.abs(scaled).max(initial=1.0) ** 0.5:
            return decimals
    return None


def moved_far(problem: CalibrationProblem) -> Iterator[str]:
    """Report the row from which on points fit another base, anchor or reflector: one that was moved."""
    points = points_of(problem) or lengths_of(problem)
    if points is None or len(points.row) < 2 * FEWEST:
        return
    whole = misfit(problem.robot, points)
    if whole < FAR_MOVED:
        return
    rows = np.arange(len(points.row))
    left = {k: max(misfit(problem.robot, points.take(part)) for part in (rows[:k], rows[k:]))
            for k in _places(len(rows))}  # fmt: skip
    place = min(left, key=left.__getitem__)
    if left[place] < FITS * whole:
        first, second = (fit_points(problem.robot, points.take(part)) for part in (rows[:place], rows[place:]))
        if points.lengths:
            far = float(np.linalg.norm(second.base[:3, 3] - first.base[:3, 3]))
            other, what = "anchor", "the anchor or the robot's base moved"
        else:  # the second part's points by the other base
            there = transformed(first.base @ np.linalg.inv(second.base), second.modelled)
            far = float(np.linalg.norm(second.modelled - there, axis=1).mean())
            other, what = "base", "the instrument or the robot's base moved"
        reflectors = float(np.linalg.norm(second.tools - first.tools, axis=1).max())
        if reflectors > far:
            other, what, far = "reflector", "the reflector was exchanged", reflectors
        yield (
            f"from row {problem.data.label[points.row[place]]} on the points fit another {other}, "
            f"{three_digits(1e3 * far)} mm away: {what}; calibrate the two parts separately, or register the "
            "second one again."
        )


def mixed_reflectors(problem: CalibrationProblem) -> Iterator[str]:
    """Report rows of another, unnamed reflector, from groups of points in the flange frame."""
    points = points_of(problem)
    if points is None or len(points.row) < 4 * FEWEST or len(points.tools) > 1 or points.turns is not None:
        return
    robot = problem.robot
    whole = misfit(robot, points)
    if whole < FAR_MOVED:
        return
    flange = forward_kinematics(robot, points.q)
    for count in (2, 3):
        named, marker, fit = points, points.marker, fit_points(robot, points)
        for _ in range(MOST_ROUNDS):
            frames = fit.base @ flange
            seen = np.einsum("nij,ni->nj", frames[:, :3, :3], points.y - frames[:, :3, 3])
            tools, before = fit.tools, marker
            if named is points:  # to begin with, in parts along the direction in which they spread most
                along = np.linalg.svd(seen - seen.mean(axis=0), full_matrices=False)[2][0]
                tools = np.array([seen[part].mean(axis=0) for part in np.array_split(np.argsort(seen @ along), count)])
            marker = np.linalg.norm(seen[:, None] - tools, axis=2).argmin(axis=1)
            if named is not points and (marker == before).all():
                break
            named = replace(points, marker=marker, tools=tools)
            fit = fit_points(robot, named)
        sizes = np.bincount(marker, minlength=count)
        if sizes.min() >= FEWEST // 2 and misfit(robot, named) < FITS * whole:
            far = 1e3 * np.linalg.norm(fit.tools - fit.tools[sizes.argmax()], axis=1).max()
            others = [problem.data.label[i] for i in points.row[marker != sizes.argmax()]]
            yield (
                f"the rows are of {count} reflectors, up to {three_digits(far)} mm apart: {_rows(others, 'is', 'are')} "
                "not of the first; name each row's reflector in a column `marker`."
            )
            return


def part_way(problem: CalibrationProblem) -> Iterator[str]:
    """Report the approximate row from which on another interpretation of the table fits."""
    points = points_of(problem) or lengths_of(problem)
    if points is None or len(points.row) < 2 * FEWEST:
        return
    rows = np.arange(len(points.row))
    whole = misfit(problem.robot, points)
    fitting = [k for k in _places(len(rows)) if misfit(problem.robot, points.take(rows[:k])) < FITS * whole]
    if not fitting:
        return
    error = fit_points(problem.robot, points.take(rows[: max(fitting)])).error
    start = int(np.flatnonzero(error <= FAR * np.median(error)).max()) + 1
    better = better_reading(problem.on(problem.data.take(points.row[start:])))
    if better is not None:
        yield f"from about row {problem.data.label[points.row[start]]} on {better.sentence}"


def _places(count: int, most: int = 40) -> list[int]:
    """Return before which rows a table may be parted."""
    return np.unique(np.linspace(FEWEST, count - FEWEST, most).round().astype(int)).tolist()


# What residuals say


def _added(model: LinearModel, x: Array, columns: Sequence[Array]) -> tuple[int, Array, float] | None:
    """Return which columns (m, c) explain a residual at x (n,) best, by which coefficients (c,), and the rest of it.

    Beside the parameters with their prior they must explain half of the sum of squares, more than chance does once in a
    million (F test, all columns counted): None where none does. The rest is a part of the residual's norm.
    """
    r = model.b - model.A @ (x / model.parameters.scale)
    whole = float(r @ r)
    own = np.linalg.qr(np.vstack([model.A, np.eye(len(x))]))[0]

    def without(columns: Array) -> Array:
        G = np.vstack([columns, np.zeros((len(x), columns.shape[1]))])
        return G - own @ (own.T @ G)

    rest = without(r[:, None])[:, 0]
    gains, steps = [], []
    for each in columns:
        G = without(each)
        steps.append(np.linalg.lstsq(G, rest, rcond=1e-9)[0])
        gains.append(float(rest @ rest - np.sum((rest - G @ steps[-1]) ** 2)))
    spare = [max(len(model.A) - len(x) - len(step), 1) for step in steps]
    # of many columns against few: by the variance that is left
    best = int(np.argmin((rest @ rest - np.array(gains)) / spare)) if gains else 0
    if not gains or gains[best] <= (1 - MOVED) * whole:
        return None
    c = len(steps[best])
    left = max(whole - gains[best], 1e-300)
    if float(fdtrc(c, spare[best], gains[best] / c / (left / spare[best]))) * len(gains) >= RARE:
        return None
    return best, steps[best], float(np.sqrt(left / whole))


Say = Callable[[Array], tuple[str, str]]
"""What coefficients mean: what happened, and what to do; empty where they are too large for a linearization."""


def shown_by_residuals(problem: CalibrationProblem, x: Array, *, transmission: bool = True) -> Iterator[str]:
    """Report what one addition to the linearization at x (n,) explains best (`_added`): what moved, lags or is scaled.

    Added are the columns of a base, fixture, reflector or joint zero for the rows from one on, or between two of a few;
    if ``transmission``, the slope of a joint's zero times the value of a joint, all of these times the way from the row
    before, and the slopes of the scale or offset of lengths, of positions by the scales and skews of their axes, too.
    """
    if len(problem.owners) > MOST_EQUATIONS:
        return
    model = problem.linearize(x)
    tried = list(_moves(problem, x, model))
    if transmission:
        tried += [*_gears(problem, model), *_scales(problem, x, model)]
    explained = _added(model, x, [columns for columns, _ in tried])
    several = list(_moves(problem, x, model, several=True))
    other = _added(model, x, [columns for columns, _ in several])
    if other is not None and (explained is None or other[2] < SEVERAL * explained[2]):
        tried, explained = several, other
    if explained is not None:
        number, coefficients, rest = explained
        what, remedy = tried[number][1](coefficients)
        if what:
            yield f"{what} (that leaves {100 * rest:.0f} % of the residuals): {remedy}."


def _moves(
    problem: CalibrationProblem, x: Array, model: LinearModel, *, several: bool = False
) -> Iterator[tuple[Array, Say]]:
    """Yield the columns (m, c) of a base, fixture, reflector, joint zero or payload that changed, or ``several`` zeros.

    It did so at a row, between two rows, or, base and fixture, steadily.
    """
    p = problem.parameters
    bends = np.char.startswith(p.names, "compliance") & ~p.identified
    if bends.any() and not several:
        problem, own = problem.identifying(p.identified | bends), x
        x = np.zeros(len(problem.parameters.free))
        x[p.identified[p.identified | bends]] = own
        model = problem.linearize(x)
    free, data = problem.parameters.free, problem.data
    markers = {marker for block in data.blocks for marker in block.markers}
    parts = {"base": {f"base_{c}" for c in FRAME}, "reflector": {tool_prefix(m) + c for m in markers for c in FRAME}}
    causes = {"base": "did the instrument or the robot's base move", "reflector": "was the reflector exchanged"}
    for block in data.blocks:
        names = list(block.measurement.parameters)
        if names:
            what = names[0].split("_")[0]
            causes[what] = "did it, or the robot's base, move"
            parts.setdefault(what, set()).update(of_fixture(name, block.fixture) for name in names)
    placed_by = [what for what in causes if what != "reflector"]
    zeros = _zeros(problem.robot)
    parts |= {f"zero of joint {i}": {name} for i, name in enumerate(zeros, start=1)}
    parts["payload"] = {name for name in free.names if name.startswith("compliance")}
    causes["payload"] = "did the load at the flange change"
    if several:
        parts = {"set of joint zeros": set(zeros)}
    causes["set of joint zeros"] = "did several joints slip, or were they remastered"
    of = {what: [k for k, name in enumerate(free.names) if name in names] for what, names in parts.items()}
    if len(data) < 2 * FEWEST or not (several or any(of[what] for what in placed_by)):
        return
    equations = Equations.of(data)

    def say(what: str, when: str, share: Array, coefficients: Array) -> tuple[str, str]:
        some = of[what]
        rows = equations.length & (share > 0)
        change = problem.jacobian(x)[np.ix_(rows, np.asarray(some))] @ (free.scale[some] * coefficients) * share[rows]
        far = 1e3 * float(np.sqrt(change @ change / len(np.unique(equations.row[rows]))))
        cause = causes.get(what, "did the joint slip, or was it remastered")
        return (
            f"{when} the points are {three_digits(far)} mm from where the others put them, and fit a {what} that moved"
        ), f"{cause}? Calibrate the two parts separately"

    spans = [(k, len(data)) for k in _places(len(data))] + list(combinations(_places(len(data), SPANS), 2))
    for (start, end), (what, some) in product(spans, of.items()):
        inside = ((problem.owners >= start) & (problem.owners < end)).astype(float)
        until = "on" if end == len(data) else f"to row {data.label[end - 1]}"
        # zeros of all joints fit two gross errors, whatever these are
        if some and (not several or inside.sum() >= 3 * len(some)):
            yield (
                model.A[:, some] * inside[:, None],
                partial(say, what, f"from row {data.label[start]} {until}", inside),
            )
    steadily = problem.owners / max(len(data) - 1, 1)
    for what in placed_by:
        if of.get(what):
            yield (
                model.A[:, of[what]] * steadily[:, None],
                partial(say, what, "more and more from row to row", steadily),
            )


def scattering_joint(problem: CalibrationProblem, x: Array) -> Iterator[str]:
    """Report a joint that explains residuals at x (n,) if it is elsewhere in every row, by more than a gear lets it."""
    alone = problem.with_repeatability(None)
    model, free, rows = alone.linearize(x), problem.parameters.free, alone.owners
    r = model.b - model.A @ (x / free.scale)
    N, whole = len(problem.data), float(r @ r)
    best = (0.0, 0.0, "")
    for i, name in enumerate(_zeros(problem.robot), start=1):
        if name in free.names:
            k = free.names.index(name)
            along, size = (np.bincount(rows, model.A[:, k] * each, N) for each in (r, model.A[:, k]))
            step = along / np.maximum(size, 1e-12)
            off = float(np.sqrt(np.mean(step**2)) * free.scale[k])
            unit = "mrad" if free.dimensions[k] == "angle" else "mm"
            what = f"joint {i} is {three_digits(1e3 * off)} {unit} (RMS) from its reading, otherwise in every row"
            best = max(best, (float(step @ along), off, what))
    gain, off, what = best
    spare = len(r) - N
    if off < LOOSE or whole - gain >= FITS * whole or spare < N:
        return
    if float(fdtrc(N, spare, gain / N / (max(whole - gain, 1e-300) / spare))) < RARE:
        left = f"that leaves {100 * np.sqrt(1 - gain / whole):.0f} % of the residuals"
        yield f"{what} ({left}): backlash, a loose encoder, or values read while it moved; check it."


def _zeros(robot: Robot) -> list[str]:
    """Return the names of the parameters that joint zeros are."""
    return [f"{'theta' if kind == 'revolute' else 'd'}{i}" for i, kind in enumerate(robot.joint_types, start=1)]


def _gears(problem: CalibrationProblem, model: LinearModel) -> Iterator[tuple[Array, Say]]:
    """Yield the column (m, 1) of every gear ratio and coupling, and of a lag of all joints."""
    robot, free = problem.robot, problem.parameters.free
    slopes = model.A / free.scale
    q = problem.joint_values
    of_zero = {i: slopes[:, free.names.index(name)] for i, name in enumerate(_zeros(robot)) if name in free.names}

    def gear(i: int, j: int, coefficients: Array) -> tuple[str, str]:
        factor = coefficients[0]
        to_model = robot.joint_map.copy()
        to_model[i] += factor * robot.joint_map[j]
        what = f"joint {i + 1} turns {100 * factor:+.2g} % more than its encoder reads (gear ratio)"
        if i != j:
            sign = signs(robot.joint_map)
            part = sign[i] * factor * sign[j]
            what = f"joint {i + 1} is coupled to joint {j + 1} (q{i + 1} {part:+.4f} q{j + 1})"
        return what * bool(abs(factor) <= SMALL), coupling(to_model)

    for i, j in product(of_zero, range(q.shape[1])):
        if q[:, j].any():
            yield (of_zero[i] * q[problem.owners, j])[:, None], partial(gear, i, j)
    if len(of_zero) == robot.dof:
        way = np.diff(q, axis=0, prepend=q[:1])[problem.owners] @ robot.joint_map.T
        lag = np.sum([of_zero[i] * way[:, i] for i in range(robot.dof)], axis=0)
        remedy = "read both when the arm stands still"
        yield lag[:, None], lambda c: (f"joint values lag behind by {100 * c[0]:.2g} % of the way", remedy)


def _scales(problem: CalibrationProblem, x: Array, model: LinearModel) -> Iterator[tuple[Array, Say]]:
    """Yield the column (m, 1) of the scale and offset of lengths, and of the scales and skews of positions."""
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

    def percent(what: str, remedy: str, c: Array) -> tuple[str, str]:
        return what.format(f"{100 * c[0]:+.2g} %") * bool(abs(c[0]) <= SMALL), remedy

    def offset(c: Array) -> tuple[str, str]:
        return (
            f"measured distances are {three_digits(1e3 * c[0])} mm too long" * bool(abs(c[0]) <= SMALL),
            "check the instrument's zero and the reflector's radius",
        )

    yield along[:, [0]], partial(percent, "measured lengths are {} too long", "check the scale of the instrument")
    yield along[:, [1]], offset
    for i, j in combinations_with_replacement(range(3 * bool(y.any())), 2):
        what, remedy = f"column {'xyz'[i]} is {{}} too long", "check its scale"
        if i != j:
            what = f"column {'xyz'[i]} has {{}} of column {'xyz'[j]} in it"
            remedy = "check whether the instrument's axes are square"
        yield (of_axis[:, i] * y[:, j])[:, None], partial(percent, what, remedy)


# What touches say


def contact_sentences(problem: CalibrationProblem) -> Iterator[str]:
    """Yield sentences on what touches identify and what they do not; none without touches."""
    touches = problem.touches
    if touches is None:
        return
    s = problem.linearize(np.zeros(len(problem.parameters.free))).svd[1]
    kinds = {"points": touches.planar.count(False), "planes": touches.planar.count(True)}
    things = " and ".join(f"{number} {name}" for name, number in kinds.items() if number)
    yield (
        f"{sum(map(len, touches.rows))} touches of {things}: {int(np.count_nonzero(s > 1))} of {len(s)} parameter "
        "combinations are identified better than by their prior scales. Touches do not identify the base frame and the "
        "offset of the first joint."
    )
    if all(tie.kind != "known_distance" for tie in touches.ties):
        yield (
            "The size of the robot rests on its nominal lengths: a known distance between two touched points "
            "([[known_distance]]) would determine it."
        )
