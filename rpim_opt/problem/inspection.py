"""What is in a problem's data, and what looks wrong with it, before anything is calibrated."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.shown import Tabled, counted
from rpim_opt.basics.statistics import statistics
from rpim_opt.basics.text import listed, table
from rpim_opt.basics.units import display
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.contact import contact_sentences
from rpim_opt.problem.frames import fitted_frames
from rpim_opt.problem.loads import repeatable
from rpim_opt.problem.observability import Observability, combination, near_parallel, observe
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.readings import better_reading
from rpim_opt.problem.source import Source
from rpim_opt.problem.suspects import exchanged_rows, moved, moved_far, rows_without_values, shared_rows
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
    ' write sign = -1 for joint 3 in robot.toml.'
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
        warnings=(*_ranges(problem), *_copies(data), *shared_rows(data, validation), *_mistakes(problem, fitted, x)),
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
