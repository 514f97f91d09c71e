"""Validation of a calibration on new measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array, statistics
from rpim_opt.basics.tables import columns_csv, records
from rpim_opt.basics.text import listed, table
from rpim_opt.calibration.diagnosis import Outside
from rpim_opt.calibration.held_out import CHANGED, coverage_text
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import held_out_errors, unregistered
from rpim_opt.calibration.verdict import implausible, misread, worse_than_nominal
from rpim_opt.calibration.words import HEADER, contact_remarks, known_points, touch_errors, touch_rows
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.record import HeldOut
from rpim_opt.problem.causes.rows import shared_rows
from rpim_opt.use.recalibration import moved_or_changed
from rpim_opt.use.sessions import registered_again


@dataclass(frozen=True, eq=False, kw_only=True)
class Validation(HeldOut):
    """Errors of a calibration on N new measurements, with the fields of `HeldOut` and further findings.

    ``data`` are the measurements, ``vectors`` (N, 3) measured minus predicted position [m], NaN without a measured
    position. ``outside`` are rows beyond the measured joint ranges of the calibration, ``touched`` are distances of
    touches from their points and planes [mm], the worst first, ``remarks`` are notes on the errors, ``mistake`` states
    another interpretation of the measurements that fits far better, if any, and ``no_intervals`` why there are no
    intervals.
    """

    data: Dataset
    vectors: Array
    outside: Outside = field(default_factory=Outside)
    touched: tuple[Mapping[str, Any], ...] = ()
    remarks: tuple[str, ...] = ()
    mistake: str = ""
    no_intervals: str = ""

    @property
    def largest(self) -> float:
        """The largest error [m]."""
        return float(np.nanmax(self.error))

    @property
    def worse(self) -> str:
        """A sentence if the errors are significantly larger than those of the nominal robot; otherwise empty."""
        return worse_than_nominal(self.nominal, self.error)

    @property
    def failure(self) -> str:
        """Why the calibration fails on these measurements; empty where it does not."""
        return self.mistake or self.worse

    @property
    def beyond(self) -> tuple[int, ...]:
        """Rows outside their prediction intervals, the worst first."""
        order = np.argsort(-np.nan_to_num(self.sigmas / self.allowed))
        return tuple(int(i) for i in order if self.sigmas[i] > self.allowed[i])

    def content(self) -> dict[str, Any]:
        """Return the figures [mm, mrad], and the rows."""
        axes = {a: v[np.isfinite(v)] for a, v in zip("xyz", self.vectors.T, strict=True)}
        return {
            "nominal": statistics(self.nominal),
            "identified": statistics(self.error),
            "axes": {a: {**statistics(np.abs(v)), "bias_mm": 1e3 * v.mean()} for a, v in axes.items() if len(v)},
            "orientation": statistics(self.angle, "mrad"),
            "beyond": [self.label[i] for i in self.beyond],
            "coverage95": self.coverage,
            "fit": self.fit and self.fit._asdict(),
            "outside": [self.label[i] for i in self.outside.rows],
            "touched": [dict(each) for each in self.touched],
            "remarks": self.remarks,
            "mistake": self.mistake,
            "worse": bool(self.worse),
            "rows": records(self._rows()),
        }

    def csv(self) -> str:
        """Return the rows as CSV."""
        return columns_csv(self._rows())

    def tables(self) -> list[tuple[list[str], list[list[str]]]]:
        """Return header and rows of the table of errors as text, and of that of touches if there are any."""
        content = self.content()
        figures = {"nominal": content["nominal"], "identified": content["identified"]}
        for axis, of_axis in content["axes"].items():
            figures[f"  {axis}, mean signed"] = {**of_axis, "mean_mm": of_axis["bias_mm"]}
        if content["orientation"]["count"]:
            figures["orientation, identified [mrad]"] = content["orientation"]
        rows = []
        for name, of in figures.items():
            unit = next(iter(of)).rpartition("_")[2]
            rows.append([name, str(of["count"]), *(f"{of[f'{key}_{unit}']:.4f}" for key in ("mean", "rms", "max"))])
        errors = ["error [mm]", "rows", "mean", "RMS", "max"], rows
        return [errors, (HEADER, touch_rows(self.touched))] if self.touched else [errors]

    def sentences(self) -> list[str]:
        """Return the largest error, the rows outside their intervals, and remarks."""
        largest = ""
        if np.isfinite(self.error).any():
            largest = f"Largest error: row {self.label[np.nanargmax(self.error)]}, {1e3 * self.largest:.3f} mm."
        covered = f" {coverage_text(self)}." if self.coverage is not None else ""
        contradicted = self.contradiction
        if contradicted and not self.failure:
            contradicted = f"{contradicted} {CHANGED}"
        named = [
            f"{self.label[i]} ({self.sigmas[i]:.1f} standard deviations, {1e3 * self.error[i]:.3f} mm)"
            for i in self.beyond
        ]
        judgement = f"Outside their prediction intervals: {listed(named)}.{covered}"
        if not np.isfinite(self.sigmas).any():
            judgement = self.no_intervals or "No row has a prediction interval: data and penalty do not determine it."
        elif not named:
            judgement = f"No row is outside its prediction interval.{covered}"
        every = [self.worse, largest, judgement, contradicted, *self.outside.sentences(), *self.remarks, self.mistake]
        return [sentence for sentence in every if sentence]

    def __str__(self) -> str:
        return "\n".join([*(table(head, rows) for head, rows in self.tables()), *self.sentences()])

    def _rows(self) -> dict[str, Sequence[Any]]:
        columns = {"nominal_mm": 1e3 * self.nominal, "error_mm": 1e3 * self.error}
        columns |= {f"{axis}_mm": 1e3 * values for axis, values in zip("xyz", self.vectors.T, strict=True)}
        columns |= {"orientation_mrad": 1e3 * self.angle, "sigmas": self.sigmas, "allowed_sigmas": self.allowed}
        return {"label": self.label, **{name: values.tolist() for name, values in columns.items()}}


def validate(result: Calibration, data: Dataset, register: bool = False) -> Validation:
    """Return the errors of a calibration on new measurements, compared with its predicted uncertainty.

    ``data`` are measured with reflectors of the calibration (which may come from `load_result`), in the same
    instrument's frame, or with ``register`` in any frame: then the motion that fits them best is applied first.

    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> found = ro.use.validate(ro.calibrate(instance.problem, ro.tikhonov, ro.l_curve), instance.validation)
    >>> f"{1e3 * found.error.mean():.3f} mm", found.beyond  # no row that the uncertainty does not explain
    ('0.032 mm', ())
    """
    remarks: list[str] = []
    if register:
        data, motion = registered_again(result, data)
        remarks.append(motion)
    problem = result.problem.sample()
    held = held_out_errors(result, data)
    touched = touch_errors(data, held.nominal, held.error)
    remarks += shared_rows(problem.data, data)
    moved, hint = moved_or_changed(result, data, held)
    remarks += filter(None, [hint])
    if not result.verdict.delivered:
        remarks.append(f"The calibration is not delivered: {' '.join(result.verdict.reasons)}")
    if touched:
        remarks += [*contact_remarks(problem), *known_points(problem, data)]
    return Validation(
        **vars(held),
        data=data,
        vectors=result.error_vectors(data),
        outside=result.outside(data),
        touched=touched,
        remarks=tuple(remarks),
        mistake=misread(result, data) or moved or implausible(result, held),
        no_intervals=result.no_intervals or unregistered(result, data, held),
    )
