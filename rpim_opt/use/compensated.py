"""Corrected commands with what is left of their errors: as text, content and CSV."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.statistics import statistics
from rpim_opt.basics.tables import csv_text
from rpim_opt.basics.text import listed, table
from rpim_opt.basics.units import display, joint_columns
from rpim_opt.calibration.ranges import Outside
from rpim_opt.robot.mdh import Robot


@dataclass(frozen=True, eq=False)
class Compensation:
    """Corrected joint commands, and what the calibrated model says of them.

    Parameters
    ----------
    robot
        The nominal robot.
    label
        N row labels.
    nominal, q
        (N, dof) commands of the nominal controller, and the corrected ones [rad or m].
    position_before, orientation_before
        (N,) how far the nominal command misses the target [m], [rad]; NaN for an orientation that does not count.
    position_error, orientation_error
        (N,) the same for the corrected command.
    std
        (N,) root mean square distance by which the model may be wrong there [m], from the calibration's covariance
        C: sqrt(tr J C J'), with the Jacobian J of the position in the instrument's frame, base included. Infinite
        where the calibration has no covariance.
    status
        For every row ``"ok"`` (of what counts, at most 0.1 um and 0.1 urad are left), ``"limited"`` (a joint limit
        prevents that), ``"unreachable"`` (for the nominal robot, too; the command is the nearest found) or
        ``"near singular"`` (the correction would be too large, and was damped).
    outside
        Corrected commands beyond the joint ranges that the calibration measured.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, weight=ro.l_curve)
    >>> found = ro.use.compensate(result, np.radians([[10, -80, 60, 20, 30, 0]]), label=["P1"])
    >>> np.degrees(found.q - found.nominal).round(2), found.status
    (array([[ 0.08,  0.86, -2.02,  1.21, -0.09, -0.04]]), ('ok',))
    >>> sorted(found.content())
    ['corrected', 'largest_corrections', 'nominal', 'outside', 'rows']
    >>> print(found.csv().splitlines()[0])
    label,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg,position_error_mm,orientation_error_mrad,std_mm,status
    """

    robot: Robot
    label: tuple[str, ...]
    nominal: Array
    q: Array
    position_before: Array
    orientation_before: Array
    position_error: Array
    orientation_error: Array
    std: Array
    status: tuple[str, ...]
    outside: Outside = field(default_factory=Outside)

    def __str__(self) -> str:
        """Return the errors as a table, the largest corrections, and the rows that keep an error by name."""
        rows = [
            ("position [mm], nominal command", self.position_before),
            ("position [mm], corrected command", self.position_error),
            ("position [mm], uncertainty of what is reached", self.std),
            ("orientation [mrad], nominal command", self.orientation_before),
            ("orientation [mrad], corrected command", self.orientation_error),
        ]
        figures = [[name, *_three(values)] for name, values in rows if np.isfinite(values).all()]
        largest = [f"q{i} {value:.3f} {unit}" for i, (unit, value) in enumerate(self._changes(), start=1)]
        lines = [
            table([f"{len(self.q)} targets, error", "mean", "RMS", "max"], figures),
            f"Largest corrections: {', '.join(largest)}.",
        ]
        for status in ("limited", "near singular", "unreachable"):
            found = [i for i, each in enumerate(self.status) if each == status]
            if found:
                named = listed([f"{self.label[i]} ({1e3 * self.position_error[i]:.3f} mm left)" for i in found])
                lines.append(f"{status.capitalize()}: {named}.")
        return "\n".join([*lines, *self.outside.sentences()])

    def _changes(self) -> list[tuple[str, float]]:
        """Return the unit and the largest correction of every joint."""
        change = np.abs(self.q - self.nominal).max(axis=0)
        units = [display(dimension) for dimension in self.robot.joint_dimensions]
        return [(unit, float(each / si)) for each, (unit, si) in zip(change, units, strict=True)]

    def content(self) -> dict[str, Any]:
        """Return the errors [mm, mrad], and a row for every target as in `csv`."""
        joints = joint_columns(self.robot.joint_dimensions)
        columns = {name: self.q[:, i] / si for i, (name, si) in enumerate(joints.items())}
        columns["position_error_mm"] = 1e3 * self.position_error
        columns["orientation_error_mrad"] = 1e3 * self.orientation_error
        columns["std_mm"] = 1e3 * self.std
        rows = zip(self.label, *(values.tolist() for values in columns.values()), self.status, strict=True)
        return {
            "nominal": _errors(self.position_before, self.orientation_before),
            "corrected": _errors(self.position_error, self.orientation_error),
            "largest_corrections": dict(zip(joints, (value for _, value in self._changes()), strict=True)),
            "outside": [self.label[i] for i in self.outside.rows],
            "rows": [dict(zip(("label", *columns, "status"), row, strict=True)) for row in rows],
        }

    def csv(self) -> str:
        """Return labels, corrected commands, what is left of the errors, and status as CSV text."""
        joints = joint_columns(self.robot.joint_dimensions)
        q = self.q / list(joints.values())
        rows = []
        left = 1e3 * np.column_stack([self.position_error, self.orientation_error, self.std])
        for label, command, errors, status in zip(self.label, q, left, self.status, strict=True):
            cells = [f"{v:.6f}" if np.isfinite(v) else "" for v in errors]
            rows.append([label, *(f"{v:.9f}" for v in command), *cells, status])
        header = ["label", *joints, "position_error_mm", "orientation_error_mrad", "std_mm", "status"]
        return csv_text(header, rows)


def _three(values: Array) -> list[str]:
    """Return mean, RMS and largest in thousandths."""
    figures = (np.mean(values), np.sqrt(np.mean(values**2)), np.max(values))
    return [f"{1e3 * figure:.4f}" for figure in figures]


def _errors(position: Array, orientation: Array) -> dict[str, Any]:
    return {"position": statistics(position), "orientation": statistics(orientation, "mrad")}
