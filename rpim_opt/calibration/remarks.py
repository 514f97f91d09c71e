"""Remarks on errors of cameras and of contacts: what they mean, and how they divide by point."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.text import listed
from rpim_opt.calibration.outcome import Outcome
from rpim_opt.calibration.verdict import rms
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.camera import camera_blocks

MOST = 20
"""Points of a table; of others one row says how many there are."""
HEADER = ["touches by point [mm]", "touches", "RMS, nominal", "RMS, identified", "max, identified"]


# --- cameras ----------------------------------------------------------------------------------------------------------


def camera_remarks(result: Outcome) -> list[str]:
    """Return remarks on a camera's views; nothing where there are none."""
    if not camera_blocks(result.problem.sample().data):
        return []
    from rpim_opt.calibration.expected import improvement  # which no other measurement asks for

    before, after = (rms(errors(dimension="pixel")) for errors in (result.nominal_errors, result.errors))
    remarks = [
        f"Reprojection error (RMS): {before:.3g} px before, {after:.3g} px after; in millimetres, the distance of the "
        "line of sight from the point. It measures how well views agree, not how well the robot is identified."
    ]
    found = improvement(result)
    if found is None:
        remarks.append("This result does not determine the expected position error of the flange.")
    else:
        remarks.append(
            "Expected position error of the flange over its joint ranges, base and tool fitted: "
            f"{1e3 * found.before:.3g} mm RMS nominal, {1e3 * found.after:.3g} mm identified (95 % of it within "
            f"{1e3 * found.within:.3g} mm along any axis)."
        )
        if not found.improves:
            remarks.append(
                "These views do not improve this robot: use its nominal parameters. Views from farther apart, with the "
                "board nearer or larger, or an instrument that measures positions would."
            )
    if not any("stretch" in name for name in result.problem.parameters.free.names):
        remarks.append(
            "Views do not identify the size of the board: an error of it scales the robot by the same factor "
            "(identify board_stretch_x and board_stretch_y where it was printed)."
        )
    return remarks


# --- contacts ---------------------------------------------------------------------------------------------------------


class Scatter(NamedTuple):
    """How far the touches of a point or plane are from it: RMS before and after calibration, and the largest [m]."""

    name: str
    touches: int
    nominal: float
    identified: float
    largest: float

    def content(self) -> dict[str, Any]:
        """Return the figures [mm]."""
        lengths = {"nominal_rms_mm": self.nominal, "rms_mm": self.identified, "max_mm": self.largest}
        return {"name": self.name, "count": self.touches, **{key: 1e3 * value for key, value in lengths.items()}}


def scatter(data: Dataset, nominal: Array, error: Array) -> tuple[Scatter, ...]:
    """Return the scatter of every point or plane that rows touched, the worst first, from errors (N,) [m]."""
    found = []
    for name, rows in _touched(data):
        before = float(np.sqrt(np.mean(nominal[rows] ** 2)))
        after = float(np.sqrt(np.mean(error[rows] ** 2)))
        found.append(Scatter(name, len(rows), before, after, float(error[rows].max())))
    return tuple(sorted(found, key=lambda each: -each.identified))


def _touched(data: Dataset) -> Iterator[tuple[str, np.ndarray]]:
    """Yield every point or plane by name, with the rows that touched it: with any tool, of any robot."""
    rows: dict[str, list[int]] = {}
    for block in data.blocks:
        if block.measurement.touching and block.touched is not None:
            for name, row in zip(block.touched[:, 0], block.row, strict=True):
                rows.setdefault(name, []).append(int(row))
    for name, of in rows.items():
        yield name, np.array(of)


def scatter_rows(found: Sequence[Scatter]) -> list[list[str]]:
    """Return the rows of a table [mm] under `HEADER`: the worst points, and how many others there are."""
    rows = []
    for each in found[:MOST]:
        lengths = (each.nominal, each.identified, each.largest)
        rows.append([each.name, str(each.touches), *(f"{1e3 * value:.3f}" for value in lengths)])
    others = found[MOST:]
    if others:
        largest = max(each.largest for each in others)
        rows.append(
            [f"{len(others)} others", str(sum(each.touches for each in others)), "", "", f"{1e3 * largest:.3f}"]
        )
    return rows


def known_points(problem: CalibrationProblem, data: Dataset) -> list[str]:
    """Say of which points that rows touched the calibration has touches of its own: those are not held out."""
    known = {name for name, _ in _touched(problem.data)}
    both = [name for name, _ in _touched(data) if name in known]
    if not both:
        return []
    return [f"Not held out: the calibration has touches of {listed(both)}, too."]


def contact_remarks(problem: CalibrationProblem) -> list[str]:
    """Return remarks on errors of touches; nothing where there are none."""
    if problem.touches is None:
        return []
    nearest = []
    if not all(problem.touches.planar):
        nearest.append("the mean of all touches of its point")
    if any(problem.touches.planar):
        nearest.append("the plane that fits all touches of it best")
    said = f"Error of a touch: the distance of the tool from {', or '.join(nearest)}, as the model has them"
    tells = "how well the robot returns there"
    if len(problem.arms) > 1:
        tells = "how well the robots meet and return there"
    remarks = [f"{said}. Their positions were not measured: the error is {tells} from all sides."]
    if not any(tie.kind == "known_distance" for tie in problem.touches.ties):
        remarks.append("No distance is known: the size of the robot rests on its nominal lengths alone.")
    return remarks
