"""What is in a problem's data, and what looks wrong with it, before anything is calibrated."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.statistics import statistics
from rpim_opt.basics.text import listed, table
from rpim_opt.basics.units import display
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.frames import fitted_frames
from rpim_opt.problem.observability import Observability, combination, near_parallel, observe
from rpim_opt.problem.placing import locate
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.robot.kinematics import FRAME
from rpim_opt.robot.parameter_names import tool_prefix

BETTER = 0.2
"""Another reading of the data is reported when it leaves less than this part of the position error."""
STANDS_OUT = 5.0
"""Rows further than this many robust standard deviations above the median residual are listed."""


@dataclass(frozen=True, eq=False)
class Inspection:
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

    def __str__(self) -> str:
        """Return everything as a person reads it."""
        parts = [self._joints(), self._measured(), self._rows(), self._identifiable()]
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
                spread = {"sigma_mm" if dimension == "length" else "sigma_mrad": None if sigma is None else 1e3 * sigma}
                what = f"{name}{f' of {reflector}' if reflector else ''}: {column}"
                rows.append({"measured": what, "unit": unit, "from": low, "to": high, **spread})
        return rows

    def _measured(self) -> str:
        rows = []
        for r in self._measured_rows():
            figures = ["-" if r[k] is None else f"{r[k]:.3f}" for k in ("from", "to")]
            of = [f"{r[f'sigma_{u}']:.3g} {u}" for u in ("mm", "mrad") if r.get(f"sigma_{u}") is not None]
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


def inspect(problem: CalibrationProblem) -> Inspection:
    """Look at a problem's data: ranges, coverage, repeated rows, likely mistakes, what can be identified.

    Mistakes are units, signs and zeros of joints, and left-handed frames: another reading of the data that leaves less
    than a fifth of the position error is named.

    >>> from dataclasses import replace
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> wrong = replace(problem.data.blocks[0], q=problem.data.blocks[0].q * [1, 1, -1, 1, 1, 1])
    >>> print(ro.problem.inspect(problem.on(replace(problem.data, blocks=(wrong,)))).warnings[-1])
    the data fit 515 times better (error over extent) with joint 3 counted the other way.
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
        warnings=(*_ranges(problem), *_copies(data), *_other_readings(problem)),
        proposals=tuple(proposals),
        observability=observe(problem),
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
        N = len(block.row)
        _, which, count = np.unique(block.q.reshape(N, -1).round(7), axis=0, return_inverse=True, return_counts=True)
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
    robot, data = problem.robot, problem.data
    q = _all_q(data)
    turning = [i for i, kind in enumerate(robot.joint_types) if kind == "revolute"]
    for i, kind in enumerate(robot.joint_types):
        unit, si = display(robot.joint_dimensions[i])
        low, high = robot.limits[i]
        if (q[:, i] < low - 1e-9).any() or (q[:, i] > high + 1e-9).any():
            yield f"joint {i + 1} leaves its limits {low / si:.1f} to {high / si:.1f} {unit}."
        if np.ptp(q[:, i]) < (np.radians(10) if kind == "revolute" else 0.01):
            yield f"joint {i + 1} moves only {np.ptp(q[:, i]) / si:.2f} {unit}: its parameters are hardly seen."
    if turning and np.abs(q[:, turning]).max() > 4 * np.pi:
        yield f"joints reach {np.degrees(np.abs(q[:, turning]).max()):.0f} deg: degrees given as radians?"
    if turning and np.abs(q[:, turning]).max() < np.radians(2 * np.pi):
        yield "no joint leaves 6.3 deg: radians given as degrees?"
    reach = float(np.sum(np.abs(robot.mdh[:, [1, 3]])))
    for block in data.blocks:
        lengths = [i for i, d in enumerate(block.measurement.columns.values()) if d == "length"]
        if not lengths or len(block.row) < 2:
            continue
        size = float(np.ptp(block.y[:, lengths], axis=0).max())
        sizes = f"measured values spread over {size:.3g} m, the robot reaches {reach:.3g} m"
        if size > 20 * reach:
            yield f"{sizes}: millimetres given as metres?"
        elif size < reach / 200:
            yield f"{sizes}: metres given as millimetres?"


def _other_readings(problem: CalibrationProblem) -> Iterable[str]:
    """Try likely mistakes on positions: the reading that fits far better than what is written is named."""
    seen = {b.measurement.name for b in problem.data.blocks}
    if not seen & {"position", "pose"}:
        return
    stated = _fitted(problem, problem.data)
    if not np.isfinite(stated):
        return
    best, text = BETTER * stated, ""
    for what, data in _readings(problem).items():
        error = _fitted(problem, data)
        if error < best:
            best, text = error, what
    if text:
        yield f"the data fit {stated / best:.0f} times better (error over extent) with {text}."


def _readings(problem: CalibrationProblem) -> Mapping[str, Dataset]:
    robot, data = problem.robot, problem.data
    turning = np.array([kind == "revolute" for kind in robot.joint_types])

    def joints(change: Array, offset: Array | float = 0.0) -> Dataset:
        return replace(data, blocks=tuple(replace(b, q=b.q * change + offset) for b in data.blocks))

    def measured(*factors: float) -> Dataset:
        blocks = [replace(b, y=np.hstack([b.y[:, :3] * factors, b.y[:, 3:]])) for b in data.blocks if b.y.shape[1] >= 3]
        return replace(data, blocks=tuple(blocks))

    one, unit = np.ones(robot.dof), np.eye(robot.dof)
    readings = {
        "joint values read as degrees, not radians": joints(np.where(turning, np.pi / 180, 1)),
        "joint values read as radians, not degrees": joints(np.where(turning, 180 / np.pi, 1)),
        "measured lengths a thousand times larger": measured(1e3, 1e3, 1e3),
        "measured lengths a thousand times smaller": measured(1e-3, 1e-3, 1e-3),
        "the measured frame mirrored (left-handed)": measured(1, 1, -1),
    }
    for i in np.flatnonzero(turning):
        readings[f"joint {i + 1} counted the other way"] = joints(one - 2 * unit[i])
        for degrees in (90, -90, 180):
            readings[f"joint {i + 1} shifted by {degrees} deg"] = joints(one, np.radians(degrees) * unit[i])
    return readings


def _fitted(problem: CalibrationProblem, data: Dataset) -> float:
    """Root mean square error over the extent of the points, base and reflectors in closed form, robot nominal."""
    blocks = [b for b in data.blocks if b.measurement.name in ("position", "pose")]
    if sum(len(b.row) for b in blocks) < 6:
        return float("inf")
    p = problem.parameters
    index = {name: i for i, name in enumerate(p.names)}
    prefix = {b.markers[0]: tool_prefix(b.markers[0]) for b in blocks}
    tools = {m: [p.nominal[index[pre + c]] for c in FRAME] for m, pre in prefix.items()}
    part = Dataset(tuple(blocks), data.label, data.configuration)
    try:
        base, places = locate(problem.robot, part, tools)
    except InputError:
        return float("inf")
    nominal = p.nominal.copy()
    nominal[[index[f"base_{c}"] for c in FRAME]] = base
    for m, pre in prefix.items():
        nominal[[index[pre + c] for c in FRAME]] = places[m]
    moved = replace(p, nominal=nominal)
    errors = CalibrationProblem(problem.robot, moved, part).errors(np.zeros(len(p.free)))
    points = np.concatenate([b.y[:, :3] for b in blocks])
    extent = np.linalg.norm(points.std(axis=0))
    return float(np.sqrt(np.nanmean(errors**2)) / extent)
