"""Input check before calibration: ranges, coverage, verdict on a quick fit, identifiability."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array, statistics
from rpim_opt.basics.exceptions import InputError, NoSolutionFound
from rpim_opt.basics.text import Tabled, counted, listed, table
from rpim_opt.basics.units import display
from rpim_opt.bayes.hyperparameters import ExcludedRow
from rpim_opt.bayes.prior import Prior
from rpim_opt.calibration.identify import calibrate
from rpim_opt.calibration.lack_of_fit import LackOfFit, judged
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.words import contact_remarks
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.causes.positions import better_interpretations
from rpim_opt.problem.causes.rows import all_q, beyond_limits, hardly_moved
from rpim_opt.problem.design import Observability, observe
from rpim_opt.problem.noise import UNITS
from rpim_opt.problem.problem import CalibrationProblem, near_parallel
from rpim_opt.problem.registration.frames import fitted_frames
from rpim_opt.problem.row_functions import repeated


@dataclass(frozen=True, eq=False, repr=False)
class Inspection(Tabled):
    """Result of `inspect`.

    ``residual`` (N,) is the error of every row of the ``problem`` [m] with the nominal robot and identified frames
    fitted; ``repeated`` are groups of labels measured in the same configuration with the same reflector. ``warnings``
    (limits, coverage, copied values, nearly parallel axes) and ``contact`` (information in touches) are sentences;
    ``observability`` is what the configurations can identify. ``fit`` is a quick calibration of the geometry with
    estimated scales and noise, and ``lack_of_fit`` the components of its residuals, repeatability among them; both None
    if there is no solution.

    >>> import rpim_opt as ro
    >>> found = ro.calibration.inspect(ro.load("paper_arm", variant="misprints").problem)
    >>> [row.label for row in found.outliers], found.observability.rank, found.warnings
    (['T8-6', 'T8-7'], 20, ('the axes 2 and 3 are nearly parallel: add beta2 to `identify`.',))
    """

    problem: CalibrationProblem
    residual: Array
    repeated: tuple[tuple[str, ...], ...]
    warnings: tuple[str, ...]
    observability: Observability
    contact: tuple[str, ...] = ()
    fit: Calibration | None = None
    lack_of_fit: LackOfFit | None = None

    @property
    def judgement(self) -> tuple[str, ...]:
        """Reasons and likely causes of the quick fit against the data, as sentences in the order of `calibrate`."""
        if self.fit is None:
            return ()
        verdict = self.fit.verdict
        return tuple(filter(None, (verdict.caution, *verdict.reasons, *verdict.beside(self.fit.causes))))

    @property
    def outliers(self) -> tuple[ExcludedRow, ...]:
        """Rows that the quick fit excluded."""
        return () if self.fit is None else self.fit.left_out

    def _short(self) -> str:
        o = self.observability
        seen = f"{o.rank} of {len(o.names)} combinations identifiable"
        return f"{self.problem.data._short()}, {seen}, {counted(len(self.warnings) + len(self.judgement), 'warning')}"

    def _frame_rows(self) -> list[dict[str, Any]]:
        """Return the joints and how far they move."""
        robot = self.problem.robot
        rows = []
        for i, (q, dimension) in enumerate(zip(all_q(self.problem.data).T, robot.joint_dimensions, strict=True)):
            unit, si = display(dimension)
            row = {"joint": f"q{i + 1}", "unit": unit, "from": q.min() / si, "to": q.max() / si}
            row |= {"limits": None, "share": None}
            if np.isfinite(robot.limits[i]).all():
                row |= {"limits": (robot.limits[i] / si).tolist(), "share": float(np.ptp(q) / np.ptp(robot.limits[i]))}
            rows.append(row)
        return rows

    def _notes(self) -> list[str]:
        notes = [f"Warning: {text}" for text in self.warnings]
        if self.fit is None:
            return notes
        count = len(np.unique(self.problem.data.configuration))
        against = "gives no reason against using the data" if self.fit.verdict.delivered else "would not be delivered"
        notes += [f"A quick fit of {count} configurations {against}.", *self.judgement]
        notes += [str(self.lack_of_fit)] if self.lack_of_fit else []
        if self.outliers:
            notes.append(f"Excluded outliers: {listed([str(row) for row in self.outliers], 10)}.")
        return notes

    def __str__(self) -> str:
        joints = []
        for i, r in enumerate(self._frame_rows()):
            figures = [f"{value:.2f}" for value in (r["from"], r["to"], r["to"] - r["from"])]
            limits = ["-", "-"]
            if r["limits"]:
                limits = [f"{r['limits'][0]:.0f} to {r['limits'][1]:.0f}", f"{100 * r['share']:.0f} %"]
            joints.append([f"q{self.problem.robot.joint(i)}", r["unit"], *figures, *limits])
        measured = []
        for r in self._measured():
            figures = ["-" if r[k] is None else f"{r[k]:.3f}" for k in ("from", "to")]
            of = [f"{r[f'sigma_{u}']:.3g} {u}" for u in ("mm", "mrad", "px") if r.get(f"sigma_{u}") is not None]
            measured.append([r["measured"], r["unit"], *figures, *(of or ["-"])])
        data, errors = self.problem.data, 1e3 * self.residual
        lines = [f"{len(data)} rows in {len(np.unique(data.configuration))} configurations."]
        if np.isfinite(errors).any():
            largest = f"{np.nanmax(errors):.3f} mm max ({data.label[np.nanargmax(errors)]})"
            lines[0] += f" Nominal error {np.nanmean(errors):.3f} mm mean, {largest}."
        if self.repeated:
            groups = listed([", ".join(group) for group in self.repeated], 5, "; ")
            lines.append(f"Measured more than once in the same configuration: {groups}.")
        parts = [
            table(["joint", "unit", "from", "to", "span", "limits", "covered"], joints),
            table(["measured", "unit", "from", "to", "noise (1 sigma)"], measured),
            "\n".join(lines),
            str(self.observability),
            "\n".join(self.contact),
            "\n".join(self._notes()),
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
            "repeated": self.repeated,
            "observability": {
                "parameters": o.names, "rank": o.rank, "weak": o.weak, "condition": o.condition, **o.indices,
                "unidentifiable": o.unidentifiable, "redundant": o.redundant,
            },
            "contact": self.contact,
            "warnings": self.warnings,
            "delivered": None if self.fit is None else self.fit.verdict.delivered,
            "judgement": self.judgement,
            "outliers": [row.label for row in self.outliers],
            "lack_of_fit": self.lack_of_fit and self.lack_of_fit.content(),
        }  # fmt: skip

    def _measured(self) -> list[dict[str, Any]]:
        """Return the range and typical deviation of every measured column by kind, reflector and fixture."""
        rows: dict[str, dict[str, Any]] = {}
        for block in self.problem.data.blocks:
            kind = block.measurement
            sigma = np.sqrt(np.median(np.einsum("nii->ni", block.covariance), axis=0))
            of = dict(zip(kind.components, sigma.tolist(), strict=True))
            where = ", ".join(filter(None, [" to ".join(filter(None, block.markers)), block.fixture]))
            for i, (column, dimension) in enumerate((kind.columns or kind.components).items()):
                unit, si = display(dimension)
                what = f"{kind.name}{f' of {where}' if where else ''}: {column}"
                row = {"measured": what, "unit": unit, "from": None, "to": None}
                if kind.columns:
                    row |= {"from": block.y[:, i].min() / si, "to": block.y[:, i].max() / si}
                each, size = UNITS.get(dimension, ("mrad", 1e-3))
                rows[what] = row | {f"sigma_{each}": of[column] / size if column in of else None}
        return list(rows.values())


def inspect(problem: CalibrationProblem, validation: Dataset | None = None, prior: Prior | None = None) -> Inspection:
    """Check a problem's data: ranges, coverage, repeated rows, likely input mistakes, identifiability.

    Mistakes are units, signs, zeros, orders and couplings of joints, rows that are shifted, exchanged or have no value,
    left-handed frames, another robot, an instrument that moved. They are sought with a quick fit, with the ``prior``,
    as by `likely_causes` for any calibration; none of the rows for ``validation`` should also be an identification row.

    >>> from dataclasses import replace
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> wrong = replace(problem.data.blocks[0], y=problem.data.blocks[0].y * [1, -1, 1])
    >>> said = ro.calibration.inspect(problem.on(replace(problem.data, blocks=(wrong,)))).judgement[-1]
    >>> said.partition(" with ")[2].partition(",")[0]
    'the measured frame mirrored (left-handed)'
    """
    if not problem.keeps_rows:
        raise InputError("inspect", "data in blocks", "one of them: inspect(part) for part in problem.rows()")
    data = problem.data
    fitted, x = fitted_frames(problem)
    groups: list[tuple[str, ...]] = []
    for block in data.blocks:
        which = repeated(block)
        again = np.flatnonzero(np.bincount(which) > 1)
        groups += [tuple(data.label[i] for i in block.row[which == k]) for k in again]
    fit = None
    failed: list[str] = []
    try:
        fit = calibrate(problem, prior=prior)
        fit = replace(fit, record=replace(fit.record, validation=validation))
    except (InputError, NoSolutionFound, np.linalg.LinAlgError) as error:
        failed = [f"The quick fit has no result: {error}"]
        failed += [f"Likely: {text}" for text in better_interpretations(problem)]
    # all are identified again, with frames if those were fitted
    whole = problem.with_parameters(replace(fitted.parameters, identified=problem.parameters.identified))
    return Inspection(
        problem=problem,
        residual=fitted.errors(x),
        repeated=tuple(groups),
        warnings=(*_ranges(problem), *failed),
        observability=observe(whole),
        contact=tuple(contact_remarks(problem)),
        fit=fit,
        lack_of_fit=fit and judged(fit),
    )


def _ranges(problem: CalibrationProblem) -> Iterator[str]:
    """Say which joints leave their limits or hardly move, which axes need a beta, and which rows may be copied."""
    robot = problem.robot
    for name in near_parallel(robot):
        axis = int(name.removeprefix("beta"))
        if name not in problem.parameters.free.names:
            yield f"the axes {axis} and {axis + 1} are nearly parallel: add {name} to `identify`."
    q = all_q(problem.data)
    yield from (f"{text}." for text in beyond_limits(robot, q))
    for moves in hardly_moved(robot, np.array([q.min(axis=0), q.max(axis=0)])):
        yield f"{moves}: its parameters are poorly identifiable."
    for block in problem.data.blocks:
        if block.y.shape[1] < 3:
            continue
        label = [problem.data.label[row] for row in block.row]
        _, first, which = np.unique(block.y, axis=0, return_index=True, return_inverse=True)
        for i, k in enumerate(first[which.ravel()]):  # a column in NumPy 2.0
            if not np.allclose(block.q[i], block.q[k]):
                both = f"rows {label[k]} and {label[i]}"
                yield f"{both} have the same measured values in different configurations: were they copied?"
