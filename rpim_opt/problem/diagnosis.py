"""Diagnosis of a problem's data before anything is calibrated: ranges, suspicious rows, observability."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.special import fdtrc

from rpim_opt.basics.arrays import Array, statistics
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import Tabled, counted, listed, table, three_digits
from rpim_opt.basics.units import display
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.contact import KNOWN
from rpim_opt.data.measurements.position import position
from rpim_opt.problem.identified import near_parallel
from rpim_opt.problem.misreadings import better_reading, lever_arms, misfit, placed
from rpim_opt.problem.observability import Observability, combination, observe
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.frames import fitted_frames
from rpim_opt.problem.registration.points import Fit, Points, points_of
from rpim_opt.problem.row_functions import repeatable
from rpim_opt.problem.source import Source
from rpim_opt.robot.kinematics import FRAME, forward_kinematics
from rpim_opt.robot.mdh import Robot

LEAST_TRAVEL = {"revolute": np.radians(10), "prismatic": 0.01}
"""A joint that moves less [rad, m] is hardly seen."""
SPREAD = {"length": ("mm", 1e-3), "pixel": ("px", 1.0)}
"""Units of typical deviations, where they are not milliradians."""
STANDS_OUT = 5.0
"""Rows further than this many robust standard deviations above the median residual are listed."""


@dataclass(frozen=True, eq=False, repr=False)
class Inspection(Tabled):
    """What `inspect` found.

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
        One sentence each: what touches show, and known distances.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> found = ro.problem.inspect(ro.load("paper_arm", variant="misprints").problem)
    >>> found.standing_out, found.observability.rank, len(found.warnings)
    (('T8-6', 'T8-7'), 20, 0)
    >>> [row["label"] for row in found.content()["standing_out"]]
    ['T8-6', 'T8-7']
    >>> lines = str(found).splitlines()
    >>> print(lines[0])
     joint   unit      from        to     span   limits   of them
    >>> print(lines[2])
     q1       deg    -39.95     40.00    79.95        -         -
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

    def _short(self) -> str:
        o = self.observability
        seen = f"{o.rank} of {len(o.names)} directions seen"
        return f"{self.problem.data._short()}, {seen}, {counted(len(self.warnings), 'warning')}"

    def _frame_rows(self) -> list[dict[str, Any]]:
        """Return the joints and how far they move."""
        return self._joint_rows()

    def _notes(self) -> list[str]:
        return [*(f"Warning: {text}" for text in self.warnings), *(f"Proposal: {text}" for text in self.proposals)]

    def __str__(self) -> str:
        """Return everything as a person reads it."""
        parts = [self._joints(), self._measured(), self._rows(), self._identifiable()]
        parts += ["\n".join(self.contact)]
        parts += ["\n".join(f"Warning: {text}" for text in self.warnings)]
        parts += ["\n".join(f"Proposal: {text}" for text in self.proposals)]
        return "\n\n".join(part for part in parts if part)

    def content(self) -> dict[str, Any]:
        """Return the same as a document; joints and measured values in the unit that they name."""
        o, mm = self.observability, (1e3 * self.residual).tolist()
        error = dict(zip(self.problem.data.label, mm, strict=True))
        return {
            "joints": self._joint_rows(),
            "measured": self._measured_rows(),
            "rows": len(mm),
            "configurations": len(np.unique(self.problem.data.configuration)),
            "nominal": statistics(self.residual),
            "standing_out": [{"label": label, "error_mm": error[label]} for label in self.standing_out],
            "repeated": self.repeated,
            "repeatability_mm": None if self.repeatability is None else 1e3 * self.repeatability,
            "observability": {
                "parameters": o.names, "rank": o.rank, "weak": int(np.count_nonzero(o.singular_values[: o.rank] < 1)),
                "condition": o.condition, "raw_condition": o.raw_condition, **o.indices, "unseen": o.unseen,
                "redundant": o.redundant,
            },
            "contact": self.contact,
            "warnings": self.warnings,
            "proposals": self.proposals,
        }  # fmt: skip

    def _joint_rows(self) -> list[dict[str, Any]]:
        robot, rows = self.problem.robot, []
        for i, (q, dimension) in enumerate(zip(_all_q(self.problem.data).T, robot.joint_dimensions, strict=True)):
            unit, si = display(dimension)
            limited = np.isfinite(robot.limits[i]).all()
            limits = (robot.limits[i] / si).tolist() if limited else None
            share = float(np.ptp(q) / np.ptp(robot.limits[i])) if limited else None
            rows.append({"joint": f"q{i + 1}", "unit": unit, "from": q.min() / si, "to": q.max() / si,
                         "limits": limits, "share": share})  # fmt: skip
        return rows

    def _joints(self) -> str:
        rows = []
        for r in self._joint_rows():
            limits = f"{r['limits'][0]:.0f} to {r['limits'][1]:.0f}" if r["limits"] else "-"
            share = f"{100 * r['share']:.0f} %" if r["limits"] else "-"
            figures = [f"{r['from']:.2f}", f"{r['to']:.2f}", f"{r['to'] - r['from']:.2f}", limits, share]
            rows.append([r["joint"], r["unit"], *figures])
        return table(["joint", "unit", "from", "to", "span", "limits", "of them"], rows)

    def _measured_rows(self) -> list[dict[str, Any]]:
        rows = []
        for (name, reflector), values in _by_kind(self.problem.data).items():
            for column, (dimension, cells, sigma) in values.items():
                unit, si = display(dimension) if dimension else ("", 1.0)
                low, high = (cells.min() / si, cells.max() / si) if len(cells) else (None, None)
                of, size = SPREAD.get(dimension, ("mrad", 1e-3))
                spread = {f"sigma_{of}": None if sigma is None else sigma / size}
                what = f"{name}{f' of {reflector}' if reflector else ''}: {column}"
                rows.append({"measured": what, "unit": unit, "from": low, "to": high, **spread})
        return rows

    def _measured(self) -> str:
        rows = []
        for r in self._measured_rows():
            figures = ["-" if r[k] is None else f"{r[k]:.3f}" for k in ("from", "to")]
            of = [f"{r[f'sigma_{u}']:.3g} {u}" for u in ("mm", "mrad", "px") if r.get(f"sigma_{u}") is not None]
            rows.append([r["measured"], r["unit"], *figures, *(of or ["-"])])
        return table(["measured", "unit", "from", "to", "typical sigma"], rows)

    def _rows(self) -> str:
        data, mm = self.problem.data, 1e3 * self.residual
        lines = [
            f"{len(data)} rows in {len(np.unique(data.configuration))} configurations. Nominal error "
            f"{np.nanmean(mm):.3f} mm mean, {np.nanmax(mm):.3f} mm max ({data.label[int(np.nanargmax(mm))]})."
        ]
        if self.repeated:
            groups = listed([", ".join(group) for group in self.repeated], 5, "; ")
            spread = f", repeatable to {1e3 * (self.repeatability or 0.0):.3g} mm" if self.repeatability else ""
            lines.append(f"Measured more than once in the same configuration{spread}: {groups}.")
        if self.standing_out:
            error = dict(zip(data.label, mm, strict=True))
            named = listed([f"{label} ({error[label]:.2f} mm)" for label in self.standing_out], 10)
            lines.append(f"Nominal error stands out: {named}.")
        return "\n".join(lines)

    def _identifiable(self) -> str:
        o = self.observability
        s = o.singular_values[: o.rank]
        weak = int(np.count_nonzero(s < 1))
        lines = [
            f"{len(o.names)} parameters to identify, {o.rank} directions that the data see; {weak} of them weaker "
            "than the prior.",
            f"Condition {o.condition:.3g} scaled and whitened, {o.raw_condition:.3g} in mm and rad; "
            + ", ".join(f"{name} {value:.3g}" for name, value in o.indices.items())
            + ".",
        ]
        if o.unseen:
            lines.append(f"Not seen at all: {', '.join(o.unseen)}.")
        if o.redundant:
            named = "; ".join(combination(terms) for terms in o.redundant)
            lines.append(f"Free to move without any effect (mm, mrad): {named}.")
        return "\n".join(lines)


def inspect(problem: CalibrationProblem, validation: Dataset | None = None) -> Inspection:
    """Look at a problem's data: ranges, coverage, repeated rows, likely mistakes, what can be identified.

    Mistakes are units, signs, zeros, orders and couplings of joints, rows that are shifted, exchanged or have no value,
    left-handed frames, another robot, an instrument that moved: another reading of the data that leaves less than a
    fifth of the position error is named, with what to write (`readings`, `suspects`).

    Parameters
    ----------
    problem
        In memory.
    validation
        The rows that were kept apart, of which none should be an identification row.

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
        raise InputError("inspect", "measurements in parts", "one of them: inspect(part) for part in problem.rows()")
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
    return Inspection(
        problem=problem,
        residual=residual,
        standing_out=tuple(far),
        repeated=repeated,
        repeatability=repeatability,
        warnings=(
            *_ranges(problem),
            *_copies(data),
            *copied_rows(data),
            *shared_rows(data, validation),
            *_mistakes(problem, fitted, x),
        ),
        proposals=tuple(proposals),
        observability=observe(problem),
        contact=tuple(contact_sentences(problem)),
    )


def _all_q(data: Dataset) -> Array:
    return np.concatenate([block.q.reshape(-1, block.q.shape[2]) for block in data.blocks])


def _by_kind(data: Dataset) -> dict[tuple[str, str], dict[str, tuple[str, Array, float | None]]]:
    kinds: dict[tuple[str, str], dict[str, tuple[str, Array, float | None]]] = {}
    for block in data.blocks:
        sigma = np.sqrt(np.median(np.einsum("nii->ni", block.covariance), axis=0))
        of = dict(zip(block.measurement.components, sigma, strict=True))
        marker = " to ".join(m for m in block.markers if m)
        where = ", ".join(part for part in (marker, block.fixture) if part)
        columns = block.measurement.columns or block.measurement.components
        kinds[block.measurement.name, where] = {
            name: (
                dimension,
                block.y[:, i] if block.measurement.columns else np.empty(0),
                float(of[name]) if name in of else None,
            )
            for i, (name, dimension) in enumerate(columns.items())
        }
    return kinds


def _repeated(data: Dataset) -> tuple[tuple[tuple[str, ...], ...], float | None]:
    groups: list[tuple[str, ...]] = []
    squares, freedom = 0.0, 0
    for block in data.blocks:
        same = repeatable(block).round(7)
        _, which, count = np.unique(same, axis=0, return_inverse=True, return_counts=True)
        for k in np.flatnonzero(count > 1):
            rows = np.flatnonzero(which == k)
            groups.append(tuple(data.label[i] for i in block.row[rows]))
            lengths = [i for i, d in enumerate(block.measurement.columns.values()) if d == "length"]
            y = block.y[rows][:, lengths]
            squares += float(np.sum((y - y.mean(axis=0)) ** 2))
            freedom += (len(rows) - 1) * len(lengths)
    return tuple(groups), float(np.sqrt(squares / freedom)) if freedom else None


def _copies(data: Dataset) -> Iterable[str]:
    for block in data.blocks:
        if block.y.shape[1] < 3:
            continue
        _, first, which = np.unique(block.y, axis=0, return_index=True, return_inverse=True)
        for i, k in enumerate(which):
            if not np.allclose(block.q[i], block.q[first[k]]):
                pair = f"{data.label[block.row[first[k]]]} and {data.label[block.row[i]]}"
                yield f"rows {pair} have the same measured values in different configurations: copied?"


def _ranges(problem: CalibrationProblem) -> Iterable[str]:
    q = _all_q(problem.data)
    for i in range(problem.robot.dof):
        yield from _range(problem.robot, i, q[:, i])
    yield from _angle_units(problem.robot, q)
    yield from _length_units(problem)


def _range(robot: Robot, i: int, q: Array) -> Iterable[str]:
    """Say whether a joint leaves its limits, or hardly moves."""
    unit, si = display(robot.joint_dimensions[i])
    low, high = robot.limits[i]
    if q.min() < low - 1e-9 or q.max() > high + 1e-9:
        yield f"joint {i + 1} leaves its limits {low / si:.1f} to {high / si:.1f} {unit}."
    if np.ptp(q) < LEAST_TRAVEL[robot.joint_types[i]]:
        yield f"joint {i + 1} moves only {np.ptp(q) / si:.2f} {unit}: its parameters are hardly seen."


def _angle_units(robot: Robot, q: Array) -> Iterable[str]:
    """Say whether degrees and radians may have been exchanged."""
    turning = [i for i, kind in enumerate(robot.joint_types) if kind == "revolute"]
    if not turning:
        return
    largest = np.abs(q[:, turning]).max()
    if largest > 4 * np.pi:
        yield f"joints reach {np.degrees(largest):.0f} deg: degrees given as radians?"
    if largest < np.radians(2 * np.pi):
        yield "no joint leaves 6.3 deg: radians given as degrees?"


def _length_units(problem: CalibrationProblem) -> Iterable[str]:
    """Say whether millimetres and metres may have been exchanged."""
    reach = float(np.sum(np.abs(problem.robot.mdh[:, [1, 3]])))
    for block in problem.data.blocks:
        lengths = [i for i, d in enumerate(block.measurement.columns.values()) if d == "length"]
        if not lengths or len(block.row) < 2:
            continue
        size = float(np.ptp(block.y[:, lengths], axis=0).max())
        sizes = f"measured values spread over {size:.3g} m, the robot reaches {reach:.3g} m"
        if size > 20 * reach:
            yield f"{sizes}: millimetres given as metres?"
        elif size < reach / 200:
            yield f"{sizes}: metres given as millimetres?"


def _mistakes(problem: CalibrationProblem, fitted: Source, x: Array) -> Iterable[str]:
    """Say what the data were mistaken for: another reading of all of them, or of some rows."""
    yield from rows_without_values(problem)
    better = better_reading(problem)
    if better is not None:
        yield better.sentence
        return
    yield from exchanged_rows(problem)
    far = list(moved_far(problem))
    yield from far
    if not far:
        whole, deviations = _whole(problem, fitted, x)
        yield from moved(whole, deviations)


def _whole(problem: CalibrationProblem, fitted: Source, x: Array) -> tuple[CalibrationProblem, Array]:
    """Return the problem that identifies all again, with its frames where they were fitted."""
    whole = problem.with_parameters(replace(fitted.parameters, identified=problem.parameters.identified))
    names = whole.parameters.free.names
    deviations = np.zeros(len(names))
    for name, value in zip(fitted.parameters.free.names, x, strict=True):
        if name in names:
            deviations[names.index(name)] = value
    return whole, deviations


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
RARE = 1e-6
FEWEST = 6
MOST_PLACES = 40
COPIES = 0.2
"""Part of the rows that may repeat others."""
TOGETHER = 4
"""Excluded rows that follow each other, from which on something moved."""
MOST_EQUATIONS = 3000


def rows_without_values(problem: CalibrationProblem) -> Iterator[str]:
    """Say which rows have zero or the same number for every measured coordinate: what an instrument writes for none."""
    data = problem.data
    for block in data.blocks:
        if len(block.measurement.columns) < 3:
            continue
        y = block.y[:, :3]
        same = (y == y[:, :1]).all(axis=1)
        for value in np.unique(y[same, 0]):
            labels = [data.label[i] for i in block.row[same & (y[:, 0] == value)]]
            what = f"{_rows(labels, 'has', 'have')} {value:g} for every measured coordinate"
            yield f"{what}: no measurement? Leave out what is none ([exclude])."


def _rows(labels: list[str], of_one: str, of_several: str) -> str:
    """Name rows before their verb."""
    if len(labels) == 1:
        return f"row {labels[0]} {of_one}"
    return f"rows {listed(labels)} {of_several}"


def shared_rows(data: Dataset, validation: Dataset | None) -> Iterator[str]:
    """Say which rows of the validation set are copies of identification rows."""
    if validation is None:
        return
    own: dict[bytes, str] = {}
    for block in data.blocks:
        for i, row in enumerate(block.row):
            own.setdefault(block.q[i].tobytes() + block.y[i].tobytes(), data.label[row])
    copies = []
    for block in validation.blocks:
        for i, row in enumerate(block.row):
            key = block.q[i].tobytes() + block.y[i].tobytes()
            if key in own and block.measurement.columns:
                copies.append(_alias(validation.label[row], own[key]))
    if copies:
        yield (
            f"{len(copies)} of {len(validation)} rows of the validation set are identification rows as well: "
            f"{listed(copies)}. Its error says less than it seems: draw them apart (rpim-opt new --hold-out)."
        )


def _alias(label: str, other: str) -> str:
    if label == other:
        return label
    return f"{label} ({other})"


def exchanged_rows(problem: CalibrationProblem) -> Iterator[str]:
    """Say which rows fit the joint values, or the reflector, of another row."""
    points = points_of(problem)
    if points is None:
        return
    found = placed(problem.robot, points)
    label = [problem.data.label[i] for i in points.row]
    far = np.flatnonzero(found.error > FAR * np.median(found.error))
    pairs = _pairs(points, found, far)
    if pairs:
        named = listed([f"{label[i]} and {label[j]}" for i, j in pairs])
        yield f"the measured values of rows {named} fit each other's joint values: exchange them."
    markers = _other_markers(problem.robot, points, found, far)
    if markers:
        yield (
            f"{_rows([label[i] for i in markers], 'fits', 'fit')} another reflector than the stated one "
            "(column marker): reflectors swapped?"
        )


def _pairs(points: Points, found: Fit, far: np.ndarray) -> list[tuple[int, int]]:
    pairs = []
    for a, i in enumerate(far):
        for j in far[a + 1 :]:
            if points.marker[i] != points.marker[j]:
                continue
            crossed = np.linalg.norm([points.y[i] - found.modelled[j], points.y[j] - found.modelled[i]], axis=1)
            if (crossed < FITS * found.error[[i, j]]).all():
                pairs.append((int(i), int(j)))
    return pairs


def _other_markers(robot: Robot, points: Points, found: Fit, far: np.ndarray) -> list[int]:
    """Return the rows that fit another reflector, which the other rows place."""
    if len(points.tools) < 2 or not len(far):
        return []
    flange = forward_kinematics(robot, points.q[far])
    rows = []
    for k, i in enumerate(far):
        body = found.tools @ flange[k, :3, :3].T + flange[k, :3, 3]
        model = body @ found.base[:3, :3].T + found.base[:3, 3]
        error = np.linalg.norm(points.y[i] - model, axis=1)
        error[points.marker[i]] = np.inf
        if error.min() < FITS * found.error[i]:
            rows.append(int(i))
    return rows


def rounded_joints(problem: CalibrationProblem, error: float) -> Iterator[str]:
    """Say whether joint values are rounded so that this explains the RMS error [m] of a fit."""
    points = points_of(problem)
    if points is None:
        return
    turning = np.array([kind == "revolute" for kind in problem.robot.joint_types])
    if not turning.any():
        return
    arms = lever_arms(problem.robot, points.q, points.tools[0])[:, turning]
    for unit, size in (("deg", np.pi / 180), ("rad", 1.0)):
        decimals = _decimals(points.q[:, turning] / size)
        if decimals is None:
            continue
        step = size * 10.0**-decimals
        made = step / np.sqrt(12) * float(np.sqrt(np.mean(np.sum(arms**2, axis=1))))
        if ALIKE[0] * made < error < ALIKE[1] * made:
            yield (
                f"joint values are rounded to {10.0**-decimals:g} {unit}: that alone makes "
                f"{three_digits(1e3 * made)} mm, the fit is off by {three_digits(1e3 * error)} mm: "
                "export them with more decimals."
            )
            return


def _decimals(values: Array) -> int | None:
    """Return how many decimals all values have at most, up to 4; None where they have more."""
    for decimals in range(5):
        scaled = values * 10.0**decimals
        if np.abs(scaled - scaled.round()).max() < 1e-6 * max(np.abs(scaled).max(), 1.0) ** 0.5:
            return decimals
    return None


def copied_rows(data: Dataset) -> Iterator[str]:
    """Say that rows are copies of others, joint and measured values alike: they do not count as measurements."""
    for block in data.blocks:
        if not block.measurement.columns or len(block.row) < FEWEST:
            continue
        rows = np.hstack([block.q.reshape(len(block.row), -1), block.y])
        first, count = np.unique(rows, axis=0, return_index=True, return_counts=True)[1:]
        copies = len(rows) - len(first)
        if copies >= COPIES * len(rows):
            named = listed([data.label[block.row[i]] for i in np.sort(first[count > 1])], 3)
            yield (
                f"{copies} of {len(rows)} rows repeat others to the last digit (first {named}): copies are no "
                "measurements, and make uncertainties too small; leave them out."
            )


def left_out_together(labels: Sequence[str], left_out: Collection[str]) -> Iterator[str]:
    """Say that rows that were excluded follow each other in time: what moved is the instrument, not one reading.

    ``labels``: of the rows that were kept, which have to be in the order of their numbers for that to be known.
    """
    numbers = {label: [int(part) for part in re.findall(r"\d+", label)] for label in (*labels, *left_out)}
    ordered = sorted(numbers, key=lambda label: numbers[label])
    if [label for label in ordered if label not in left_out] != list(labels):
        return
    at = np.array([i for i, label in enumerate(ordered) if label in left_out], dtype=int)
    for run in np.split(at, np.flatnonzero(np.diff(at) > 2) + 1):
        if len(run) >= TOGETHER:
            yield (
                f"rows {ordered[run[0]]} to {ordered[run[-1]]} were excluded as outliers, and follow each other: did "
                "the instrument or the robot's foot move there? Calibrate the parts apart, or register the second anew."
            )


def transmission(problem: CalibrationProblem, x: Array) -> Iterator[str]:
    """Say whether the residuals at x (n,) are those of a joint's gear ratio, or of a coupling to another joint.

    One column, the slope of a joint's zero times the value of a joint, is added to the last linearization. It must
    explain half of the sum of squares, more than chance does once in a million (F test, all columns counted).
    """
    free = problem.parameters.free
    model = problem.linearize(x)
    if len(model.b) > MOST_EQUATIONS:
        return
    z = x / free.scale
    n = len(z)
    Q = np.linalg.qr(np.vstack([model.A, np.eye(n)]))[0]
    rest = np.concatenate([model.b - model.A @ z, np.zeros(n)])
    rest = rest - Q @ (Q.T @ rest)
    row = np.concatenate([np.repeat(block.row, len(block.measurement.components)) for block in problem.data.blocks])
    q = problem.joint_values[row]
    found: list[tuple[float, int, int, float]] = []
    for i, kind in enumerate(problem.robot.joint_types):
        name = f"{'theta' if kind == 'revolute' else 'd'}{i + 1}"
        if name not in free.names:
            continue
        k = free.names.index(name)
        for j in range(q.shape[1]):
            g = np.concatenate([model.A[:, k] * q[:, j] / free.scale[k], np.zeros(n)])
            g = g - Q @ (Q.T @ g)
            size = float(g @ g)
            if size > 0:
                found.append((float(g @ rest) ** 2 / size, i, j, float(g @ rest) / size))
    if not found:
        return
    gain, i, j, factor = max(found)
    whole = float(rest @ rest)
    freedom = max(len(model.b) - n - 1, 1)
    chance = fdtrc(1, freedom, gain / max((whole - gain) / freedom, 1e-300)) * len(found)
    if gain > (1 - MOVED) * whole and chance < RARE:
        what = f"joint {i + 1} turns {100 * factor:+.2g} % more than its encoder says (gear ratio)"
        if i != j:
            what = f"joint {i + 1} is coupled to joint {j + 1} (q{i + 1} {factor:+.4f} q{j + 1})"
        left = 100 * np.sqrt(max(whole - gain, 0.0) / whole)
        yield f"{what}: that leaves {left:.0f} % of the residuals; write it into coupling in robot.toml."


def moved_far(problem: CalibrationProblem) -> Iterator[str]:
    """Say from which row on points fit another base: an instrument that was moved by more than a robot's errors."""
    points = points_of(problem)
    if points is None or len(points.row) < 2 * FEWEST:
        return
    whole = misfit(problem.robot, points)
    if whole < FAR_MOVED:
        return
    best = whole
    place = 0
    rows = np.arange(len(points.row))
    for k in _places(len(rows)):
        parts = [misfit(problem.robot, points.take(rows[part])) for part in (slice(0, k), slice(k, None))]
        if max(parts) < best:
            best, place = max(parts), k
    if best < FITS * whole:
        label = problem.data.label[points.row[place]]
        first = placed(problem.robot, points.take(rows[:place]))
        second = placed(problem.robot, points.take(rows[place:]))
        far = 1e3 * _apart(first, second)
        yield (
            f"from row {label} on the points fit another base, {three_digits(far)} mm away: the instrument or the "
            "robot's foot moved; calibrate the two parts apart, or register the second one anew."
        )


def _apart(first: Fit, second: Fit) -> float:
    """Return how far apart two bases put the points of the second one's rows [m], in the mean."""
    body = (second.modelled - second.base[:3, 3]) @ second.base[:3, :3]
    seen = body @ first.base[:3, :3].T + first.base[:3, 3]
    return float(np.linalg.norm(second.modelled - seen, axis=1).mean())


def _places(count: int) -> np.ndarray:
    """Return before which rows a table may be parted."""
    if count < 2 * FEWEST:
        return np.array([], dtype=int)
    return np.unique(np.linspace(FEWEST, count - FEWEST, MOST_PLACES).round().astype(int))


def moved(problem: CalibrationProblem, x: Array) -> Iterator[str]:
    """Say from which row on the residuals at x (n,) show a base that has moved: a change point.

    Six columns, the base's motion for the rows from there on, are added to the last linearization. They must explain
    half of the sum of squares, more than chance does once in a million (F test, all places counted).
    """
    names = problem.parameters.free.names
    base = [names.index(f"base_{c}") for c in FRAME if f"base_{c}" in names]
    data = problem.data
    if len(base) < len(FRAME) or len(data) < 2 * FEWEST:
        return
    model = problem.linearize(x)
    if len(model.b) > MOST_EQUATIONS:
        return
    z = x / problem.parameters.free.scale
    r = model.b - model.A @ z
    n = len(z)
    Q = np.linalg.qr(np.vstack([model.A, np.eye(n)]))[0]
    row = np.concatenate([np.repeat(block.row, len(block.measurement.components)) for block in data.blocks])
    rest = np.concatenate([r, np.zeros(n)])
    rest = rest - Q @ (Q.T @ rest)
    whole = float(r @ r)
    places = _places(len(data))
    best, place, step = 0.0, 0, np.zeros(6)
    for k in places:
        G = np.vstack([model.A[:, base] * (row >= k)[:, None], np.zeros((n, 6))])
        G = G - Q @ (Q.T @ G)
        found = np.asarray(np.linalg.lstsq(G, rest, rcond=1e-9)[0], dtype=float)
        gain = float(rest @ rest - np.sum((rest - G @ found) ** 2))
        if gain > best:
            best, place, step = gain, int(k), found
    freedom = max(len(r) - n - 6, 1)
    left = max(whole - best, 1e-300)
    chance = fdtrc(6, freedom, best / 6 / (left / freedom)) * len(places)
    if best > (1 - MOVED) * whole and chance < RARE:
        yield _moved_text(problem, x, base, place, step, np.sqrt(left / whole))


def _moved_text(problem: CalibrationProblem, x: Array, base: list[int], place: int, step: Array, left: float) -> str:
    free = problem.parameters.free
    components = list(problem.data.blocks[0].measurement.components)
    lengths = [i for i, name in enumerate(components) if name in ("x", "y", "z", "distance")]
    alone = problem.on(replace(problem.data, blocks=problem.data.blocks[:1]))
    change = alone.jacobian(x)[:, base] @ (free.scale[base] * step)
    vectors = change.reshape(-1, len(components))[problem.data.blocks[0].row >= place][:, lengths]
    far = 1e3 * float(np.linalg.norm(vectors, axis=1).mean())
    return (
        f"from row {problem.data.label[place]} on the points are {three_digits(far)} mm from where the others put "
        f"them, and fit a base that moved (that leaves {100 * left:.0f} % of the residuals): did the instrument or the "
        "robot's foot move? Calibrate the two parts apart."
    )


STATED = frozenset(kind.name for kind in KNOWN)
"""Measurements that are statements of a drawing."""
CLOSE = 0.05
"""Places that are nearer [m] say little of the scale."""
LEAST = 1.0
"""A direction is seen that the data show better than the scales do."""


def contact_sentences(problem: CalibrationProblem) -> Iterator[str]:
    """Yield what the touches of a problem show, and what they do not; nothing where there are none.

    Of the scale it is said how well distances between touched places are known: the root of the mean square over all
    pairs of

    ::

        sd(|c_2 - c_1|) / |c_2 - c_1|,    var = g'(A'A + 1)^-1 g,    g the slope of the distance by z

    in units of the file's scales, before anything is learned.
    """
    touches = problem.touches
    if touches is None:
        return
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    s = model.svd[1]
    things = []
    points = touches.planar.count(False)
    planes = touches.planar.count(True)
    if points:
        things.append(f"{points} points")
    if planes:
        things.append(f"{planes} planes")
    count = sum(len(index) for index in touches.rows)
    yield (
        f"{count} touches of {' and '.join(things)}: {int(np.count_nonzero(s > LEAST))} of {len(s)} directions are "
        "seen better than the scales say. Where the robot stands and how its first joint is counted no touch shows."
    )
    yield _scale_sentence(problem, model.A)


def _scale_sentence(problem: CalibrationProblem, A: Array) -> str:
    without = problem.without({problem.labels[i] for b in problem.data.blocks if b.measurement.name in STATED
                               for i in b.row})  # fmt: skip
    bare = without.linearize(np.zeros(A.shape[1])).A
    alone = _scale(problem, bare)
    if alone is None:
        return "All that was touched is in one place: the robot's scale is that of the drawing."
    if len(without.data) == len(problem.data):
        return (
            f"Distances between touched places: known to {_per_metre(alone)} by touches and the scales of the file; a "
            "known distance between two of them ([[known_distance]]) would show how large the robot is."
        )
    known = _scale(problem, A)
    return (
        f"Distances between touched places: known to {_per_metre(known or alone)}, and to {_per_metre(alone)} without "
        "what the drawing knows of them."
    )


def _per_metre(sd: float) -> str:
    return f"{1e3 * sd:.2g} mm in a metre"


def _scale(problem: CalibrationProblem, A: Array) -> float | None:
    """Return the relative standard deviation of distances between touched places; None for a single one."""
    places, slopes = _touched_places(problem)
    C = np.linalg.inv(A.T @ A + np.eye(A.shape[1]))
    squares = []
    for i, j in combinations(range(len(places)), 2):
        apart = places[j] - places[i]
        length = float(np.linalg.norm(apart))
        if length > CLOSE:
            g = apart @ (slopes[j] - slopes[i]) / length**2
            squares.append(float(g @ C @ g))
    if not squares:
        return None
    return float(np.sqrt(np.mean(squares)))


def _touched_places(problem: CalibrationProblem) -> tuple[Array, Array]:
    """Return where the tool is at the touches of every thing in the mean (T, 3) [m], and its slopes by z (T, 3, n)."""
    free = problem.parameters.free
    x = np.zeros(len(free))
    names = []
    positions = []
    slopes = []
    for block in problem.data.blocks:
        if not block.measurement.touching or block.point is None:
            continue
        rows = np.arange(len(block.row))
        seen = replace(block, measurement=position, y=np.zeros((len(rows), 3)), row=rows, point=None)
        labels = tuple(str(i) for i in range(len(block.row)))
        there = problem.on(Dataset((seen,), labels, np.arange(len(labels))))
        names += block.point[:, 0].tolist()
        positions.append(there.modelled(x)[0])
        slopes.append((there.jacobian(x) * free.scale).reshape(len(labels), 3, -1))
    which = np.unique(names, return_inverse=True)[1]
    p = np.concatenate(positions)
    J = np.concatenate(slopes)
    each = [which == k for k in range(which.max() + 1)]
    return np.array([p[of].mean(axis=0) for of in each]), np.array([J[of].mean(axis=0) for of in each])
