"""Validation of a calibration on new measurements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array, statistics
from rpim_opt.basics.exceptions import InputError, choices, pick
from rpim_opt.basics.layout import RawTable, TableOptions
from rpim_opt.basics.tables import Columns, csv_text, read_columns
from rpim_opt.basics.text import listed, table
from rpim_opt.basics.units import UNITS, accepted_units, parse_units
from rpim_opt.calibration.causes import misread
from rpim_opt.calibration.held_out_rows import judged
from rpim_opt.calibration.ranges import Outside
from rpim_opt.calibration.remarks import HEADER, Scatter, contact_remarks, known_points, scatter, scatter_rows
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.verdict import worse_sentence, worse_than_nominal
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.camera import board_of, on_board
from rpim_opt.data.measurements.contact import KNOWN
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.measurements.pose import pose
from rpim_opt.data.tables.reading import read_data
from rpim_opt.data.tables.understanding import Understood, understand
from rpim_opt.robot.mdh import Robot
from rpim_opt.use.targets import Targets, read_targets


@dataclass(frozen=True, eq=False)
class Validation:
    """Errors of a calibration on new measurements.

    Parameters
    ----------
    label
        N row labels.
    nominal, error
        (N,) position errors before and after calibration [m].
    vectors
        (N, 3) measured minus predicted position [m]; NaN where no position was measured.
    angle
        (N,) orientation errors [rad]; NaN for rows that are no poses.
    sigmas, allowed
        (N,) |S^-1/2 r| of a row's residual r, with S = J C J' + the covariance of a reading (the instrument's as the
        row states it, and the robot's scatter) and C the calibration's, and what of it Fisher's F allows so that one
        of all N rows exceeds it with probability 0.01. NaN where the calibration has no covariance, or none in a
        direction that the row depends on.
    coverage
        Share of the lengths that lie in the interval of a new reading at a confidence of 0.95; None without covariance.
    outside
        Rows beyond the joint ranges that the calibration measured.
    touched
        How far touches are from their points and planes, the worst first.
    remarks
        What a reader of errors of touches has to know.
    mistake
        Another reading of the measurements that fits far better, in a sentence; empty where there is none.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("position")
    >>> found = ro.use.validate(ro.calibrate(instance.problem, ro.tikhonov, ro.reml), instance.validation)
    >>> f"{1e3 * found.largest:.2f} mm", found.beyond  # no row that the uncertainty does not explain
    ('0.04 mm', ())
    >>> found.csv().splitlines()[0].split(",")[0], sorted(found.content())[:3]
    ('label', ['axes', 'beyond', 'coverage95'])
    """

    label: tuple[str, ...]
    nominal: Array
    error: Array
    vectors: Array
    angle: Array
    sigmas: Array
    allowed: Array
    coverage: float | None = None
    outside: Outside = field(default_factory=Outside)
    touched: tuple[Scatter, ...] = ()
    remarks: tuple[str, ...] = ()
    mistake: str = ""

    @property
    def largest(self) -> float:
        """The largest error [m]."""
        return float(np.nanmax(self.error))

    @property
    def worse(self) -> bool:
        """Whether the errors are larger than the nominal robot's, beyond chance."""
        return worse_than_nominal(self.nominal, self.error)

    @property
    def beyond(self) -> tuple[int, ...]:
        """Rows beyond what the prediction's uncertainty allows, the worst first."""
        order = np.argsort(-np.nan_to_num(self.sigmas / self.allowed))
        return tuple(int(i) for i in order if self.sigmas[i] > self.allowed[i])

    def content(self) -> dict[str, Any]:
        """Return the figures [mm, mrad], and the rows."""
        axes = {a: v[np.isfinite(v)] for a, v in zip("xyz", self.vectors.T, strict=True)}
        rows = self._rows()
        return {
            "nominal": statistics(self.nominal),
            "identified": statistics(self.error),
            "axes": {a: {**statistics(np.abs(v)), "bias_mm": 1e3 * v.mean()} for a, v in axes.items() if len(v)},
            "orientation": statistics(self.angle, "mrad"),
            "beyond": [self.label[i] for i in self.beyond],
            "coverage95": self.coverage,
            "outside": [self.label[i] for i in self.outside.rows],
            "touched": [each.content() for each in self.touched],
            "remarks": self.remarks,
            "mistake": self.mistake,
            "worse": self.worse,
            "judged": bool(np.isfinite(self.sigmas).any()),
            "rows": [dict(zip(rows, row, strict=True)) for row in zip(*rows.values(), strict=True)],
        }

    def csv(self) -> str:
        """Return the rows as CSV."""
        rows = self._rows()
        cells = [[c if isinstance(c, str) else f"{c:.6f}" if np.isfinite(c) else "" for c in v] for v in rows.values()]
        return csv_text(rows, zip(*cells, strict=True))

    def __str__(self) -> str:
        """Return the errors as a table, and the rows beyond their uncertainty by name."""
        content = self.content()
        figures = {"nominal": content["nominal"], "identified": content["identified"]}
        for axis, of_axis in content["axes"].items():
            figures[f"  {axis}, mean signed"] = {**of_axis, "mean_mm": of_axis["bias_mm"]}
        rows = [_row(name, each, "mm") for name, each in figures.items()]
        if content["orientation"]["count"]:
            rows.append(_row("orientation, identified [mrad]", content["orientation"], "mrad"))
        tables = [table(["error [mm]", "rows", "mean", "RMS", "max"], rows)]
        if self.touched:
            tables.append(table(HEADER, scatter_rows(self.touched)))
        worse = [worse_sentence(self.nominal, self.error)] if self.worse else []
        sentences = [*worse, self._verdict(), *self.outside.sentences(), *self.remarks, self.mistake]
        return "\n".join([*tables, *filter(None, sentences)])

    def _verdict(self) -> str:
        if not np.isfinite(self.sigmas).any():
            return "The calibration has no covariance for these rows: how large errors may be is not known."
        covered = ""
        if self.coverage is not None:
            covered = f" {100 * self.coverage:.0f} % of the coordinates lie in their 95 % intervals of a reading."
        if not self.beyond:
            return f"No row is beyond what the prediction's uncertainty allows.{covered}"
        named = [f"{self.label[i]} ({self.sigmas[i]:.1f} sigmas, {1e3 * self.error[i]:.3f} mm)" for i in self.beyond]
        return f"Beyond what the prediction's uncertainty allows: {listed(named)}.{covered}"

    def _rows(self) -> dict[str, Sequence[Any]]:
        lengths = {"nominal_mm": self.nominal, "error_mm": self.error}
        lengths |= {f"{axis}_mm": values for axis, values in zip("xyz", self.vectors.T, strict=True)}
        columns = {name: 1e3 * values for name, values in (lengths | {"orientation_mrad": self.angle}).items()}
        columns |= {"sigmas": self.sigmas, "allowed_sigmas": self.allowed}
        return {"label": self.label, **{name: values.tolist() for name, values in columns.items()}}


def _row(name: str, figures: Mapping[str, Any], unit: str) -> list[str]:
    return [name, str(figures["count"]), *(f"{figures[f'{key}_{unit}']:.4f}" for key in ("mean", "rms", "max"))]


def validate(result: Calibration, data: Dataset) -> Validation:
    """Return the errors of a calibration on measurements, and whether its uncertainty explains them.

    Parameters
    ----------
    result
        The calibration, perhaps of `load_result`.
    data
        Measurements in the same instrument's frame, by reflectors of the calibration.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("paper_arm")
    >>> found = ro.use.validate(ro.calibrate(instance.problem, ro.tikhonov, ro.l_curve), instance.validation)
    >>> f"{1e3 * found.error.mean():.3f} mm"
    '0.032 mm'
    """
    problem = result.problem.sample()
    nominal = result.nominal_errors(data)
    error = result.errors(data)
    touched = scatter(data, nominal, error)
    remarks = (*contact_remarks(problem), *known_points(problem, data)) if touched else ()
    angle = result.errors(data, "angle")
    mistake = misread(result, data)
    outside = result.outside(data)
    vectors = result.error_vectors(data)
    judgement = judged(result, data)
    return Validation(data.label, nominal, error, vectors, angle, *judgement, outside, touched, remarks, mistake)


def read_measurements(
    result: Calibration, source: Any, measurement: str | None = None, units: str = ""
) -> tuple[Dataset, tuple[str, ...]]:
    """Return the measurements of a table, whose columns `understand` recognises, and columns that were left out.

    Rows that state no uncertainty have that of the calibration's data.

    Parameters
    ----------
    result
        The calibration.
    source
        A text, Excel or Parquet file as ``rpim-opt new`` takes it, or a data frame.
    measurement
        Which of the calibration's kinds, where it has several.
    units
        Units of columns whose name carries none, ``"deg,mm"``.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, ro.l_curve)
    >>> table = {f"joint_{i}": [0.0, 10.0] for i in range(1, 7)}
    >>> table |= {"x": [826.6, 810.0], "y": [98.0, 240.0], "z": [107.0, 254.0], "note": ["", "warm"]}
    >>> data, left_out = ro.use.read_measurements(result, table, units="deg,mm")
    >>> len(data), left_out
    (2, ('note',))
    """
    found = read_table(result, source, measurement, units)
    return found.data, found.left_out


class Read(NamedTuple):
    """A table's measurements, the columns that were left out, and all columns as they stand there, of the same rows."""

    data: Dataset
    left_out: tuple[str, ...]
    raw: Columns


def read_table(result: Calibration, source: Any, measurement: str | None, units: str) -> Read:
    """Return what a table says; arguments as for `read_measurements`."""
    file = source if isinstance(source, str | Path) else None
    robot = result.problem.robot
    stated = _kind(result, measurement)
    try:
        found = _understood(source, robot, stated, result.record.reading, units)
        kind = stated
        if not found.stems >= set(stated.columns):  # poses may be validated by positions
            parts = [part for part in stated.parts if not any(found.stems >= set(form) for form, _ in stated.forms)]
            kind = next((part for part in parts if found.stems >= set(part.columns)), stated)
        columns = found.columns
        if found.left_out and not columns:
            accepted = f"joints' values and {', '.join(kind.columns)}"
            raise InputError("the header", f"nothing that is known among {', '.join(found.left_out)}"[:200], accepted)
        board = board_of(result.problem.sample().data)
        if kind.by_camera and board and not any(column.startswith("target_") for column in columns):
            columns = on_board(columns, board)
        data = read_data(columns, robot, _noise(result, stated, kind), kind)
    except InputError as error:
        raise error.within(file) from None
    return Read(data, found.left_out, found.raw)


def _understood(
    source: Any, robot: Robot, kind: Measurement, reading: Mapping[str, str], units: str, targets: bool = False
) -> Understood:
    """Return what a table says, read as the calibration's own were; one that does not fit that, as it says itself."""
    where = Path(source) if isinstance(source, str | Path) else RawTable(read_columns(source))
    plain = TableOptions(units=parse_units(units))
    if reading:
        options = TableOptions.stated({**reading, "units": units or reading.get("units", "")})
        try:
            return understand(where, robot, kind, options, options.joints, targets)
        except InputError as error:
            with suppress(InputError):  # one that has our names already
                return understand(where, robot, kind, plain, targets=targets)
            raise error from None
    found = understand(where, robot, kind, plain, targets=targets)
    if found.doubt == "quaternion" and "qw" in kind.columns:
        raise InputError("the header", "a quaternion whose components are numbered", "names qw, qx, qy, qz")
    return found


def read_commands(result: Calibration, source: str | Path, units: str = "") -> tuple[Targets, tuple[str, ...]]:
    """Return the targets of a table that is read as the calibration's own were, and the columns that were left out."""
    robot = result.problem.robot
    try:
        found = _understood(source, robot, pose, result.record.reading, units, targets=True)
        return read_targets(found.columns, robot), found.left_out
    except InputError as error:
        raise error.within(source) from None


def _kind(result: Calibration, name: str | None) -> Measurement:
    """Return the calibration's kind of measurement of a name, or its only one."""
    blocks = result.problem.data.blocks
    kinds = {block.measurement.name: block.measurement for block in blocks if block.measurement not in KNOWN}
    if name:
        return pick(kinds, name, "measurement")
    if len(kinds) != 1:
        raise InputError("measurement", "several", choices("", kinds))
    return next(iter(kinds.values()))


def _noise(result: Calibration, stated: Measurement, kind: Measurement) -> dict[str, float]:
    """Return the typical standard deviation of every component of a type or a part of it, as ``[noise]`` has it."""
    blocks = [block for block in result.problem.data.blocks if block.measurement is stated]
    variance = np.mean([np.einsum("nii->ni", block.covariance).mean(axis=0) for block in blocks], axis=0)
    si = {d: next(u for u in accepted_units(d) if UNITS[u].si == 1.0) for d in stated.components.values()}
    sigma = zip(stated.components.items(), np.sqrt(variance), strict=True)
    return {f"{name}_{si[dimension]}": float(value) for (name, dimension), value in sigma if name in kind.components}
