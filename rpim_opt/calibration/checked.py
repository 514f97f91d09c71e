"""Rows that a calibration did not see, held against a limit and against the intervals that predicted them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import bdtr

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.text import listed
from rpim_opt.calibration.intervals import UNLIKELY
from rpim_opt.calibration.ranges import SLACK
from rpim_opt.calibration.reaching import distance_quantile
from rpim_opt.calibration.region import Region
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.unseen import CONFIDENCE
from rpim_opt.calibration.unseen import judged as unseen
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.record import Requirement

SURE = 1e9
"""Degrees of freedom of an uncertainty that is stated."""


@dataclass(frozen=True, eq=False)
class Checked:
    """What rows that were kept apart say.

    Parameters
    ----------
    count
        How many rows measure a length in the region.
    largest
        The largest error of these [m].
    missing
        Labels of those that miss by more than the limit and what the instrument may add to it.
    rows
        How many rows were kept apart in all.
    beyond
        Labels of those, in the region or not, that the prediction's uncertainty does not explain.
    coverage
        Share of their lengths that lie in the 95 % interval of a reading; None where there is none.
    """

    count: int
    largest: float
    missing: tuple[str, ...]
    rows: int
    beyond: tuple[str, ...]
    coverage: float | None

    def sentence(self) -> str:
        """Return the figures in a sentence."""
        if not self.count:
            return f"None of the {self.rows} rows that were kept apart is in the region."
        text = f"Kept apart: {self.rows} rows, {self.count} of them in the region, the largest error there "
        text += f"{1e3 * self.largest:.3f} mm as the instrument reads it"
        if self.coverage is not None:
            text += f"; {100 * self.coverage:.0f} % of the coordinates lie in their 95 % intervals"
        return f"{text}."

    def doubts(self, fewest: int) -> list[str]:
        """Return why the rows do not bear the intervals out, a sentence each."""
        lines: list[str] = []
        if self.rows < fewest:
            lines.append(f"Lacking: at least {fewest} rows that the calibration did not see; there are {self.rows}.")
        if self.beyond:
            lines.append(
                f"Lacking: intervals that hold. Beyond what the prediction's uncertainty allows: "
                f"{listed(list(self.beyond), 3)}. Measure again, or find what the model lacks."
            )
        if self.coverage is not None:
            # coordinates of a row are not independent of each other: a row counts once
            within = np.floor(self.coverage * self.rows)
            if bdtr(within, self.rows, CONFIDENCE) < UNLIKELY:
                lines.append(
                    f"Lacking: intervals that hold. Only {100 * self.coverage:.0f} % of the coordinates lie in their "
                    "95 % intervals."
                )
        return lines

    def content(self) -> dict[str, Any]:
        """Return the figures as a document [mm]."""
        return {
            "rows": self.rows,
            "in_region": self.count,
            "largest_mm": 1e3 * self.largest,
            "missing": list(self.missing),
            "beyond": list(self.beyond),
            "coverage95": self.coverage,
        }


def checked(result: Calibration, region: Region, requirement: Requirement, data: Dataset | None) -> Checked | None:
    """Return what rows that were kept apart say; None where there are none.

    Parameters
    ----------
    result
        The calibration, whose record knows them.
    region, requirement
        Where which limit is to be kept.
    data
        Other rows instead.
    """
    apart = data
    if apart is None:
        apart = result.record.validation
    if apart is not None:
        found = unseen(result, apart)
        return _checked(apart, result.errors(apart), *found, region, requirement)
    held = result.record.held_out
    if held is None:
        return None
    known = {label: row for row, label in enumerate(result.problem.data.label)}
    rows = [known[label] for label in held.label if label in known]
    kept = np.array([label in known for label in held.label])
    data = result.problem.data.take(rows)
    return _checked(data, held.error[kept], held.sigmas[kept], held.allowed[kept], held.coverage, region, requirement)


def _checked(
    data: Dataset,
    error: Array,
    sigmas: Array,
    allowed: Array,
    coverage: float | None,
    region: Region,
    requirement: Requirement,
) -> Checked:
    inside = _inside(data, region) & np.isfinite(error)
    more = error > requirement.limit + _instrument(data, requirement.confidence)
    missing = np.flatnonzero(inside & more)
    beyond = np.flatnonzero(np.nan_to_num(sigmas) > np.nan_to_num(allowed, nan=np.inf))
    return Checked(
        count=int(inside.sum()),
        largest=float(error[inside].max(initial=0.0)),
        missing=tuple(data.label[i] for i in missing),
        rows=len(data),
        beyond=tuple(data.label[i] for i in beyond),
        coverage=coverage,
    )


def _inside(data: Dataset, region: Region) -> np.ndarray:
    """Return which rows have all their points in the region, (N,)."""
    found = np.zeros(len(data), dtype=bool)
    for block in data.blocks:
        points = [region.inside(block.q[:, point], SLACK) for point in range(block.q.shape[1])]
        found[block.row] = np.all(points, axis=0)
    return found


def _instrument(data: Dataset, confidence: float) -> Array:
    """Return what the instrument may add to the errors of rows, (N,) [m]."""
    found = np.zeros(len(data))
    for block in data.blocks:
        lengths = [i for i, d in enumerate(block.measurement.components.values()) if d == "length"]
        stated = np.broadcast_to(block.covariance, (len(block.row), *block.covariance.shape[1:]))
        if lengths:
            found[block.row] = distance_quantile(stated[:, lengths][:, :, lengths], SURE, confidence)
    return found
