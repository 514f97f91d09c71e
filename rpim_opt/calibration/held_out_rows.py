"""Held-out rows: against the intervals that predicted them and a limit, and used for a last fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy.special import bdtr, fdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import listed
from rpim_opt.bayes.hyperparameters import sessions_spread
from rpim_opt.calibration.covariance import UNLIKELY, coverage_factor, row_freedom, scattered
from rpim_opt.calibration.diagnosis import SLACK
from rpim_opt.calibration.region import Region, distance_quantile
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import known_covariance
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.record import HeldOut, Requirement

RARE = 0.01
"""Probability that data like those of the calibration have any row that is named."""
CONFIDENCE = 0.95
"""Of the intervals whose coverage is counted."""


class Judged(NamedTuple):
    """Residuals (N,) in standard deviations of a reading, what of it is allowed, and the coverage of the intervals."""

    sigmas: Array
    allowed: Array
    coverage: float | None


def judged(result: Calibration, data: Dataset) -> Judged:
    """Return how the rows lie beside what the calibration's uncertainty predicts; NaN where it predicts nothing.

    Parameters
    ----------
    result
        The calibration.
    data
        N measurements in the same instrument's frame, by reflectors of the calibration.
    """
    N = len(data)
    sigmas = np.full(N, np.nan)
    allowed = np.full(N, np.nan)
    inside: list[np.ndarray] = []
    C = known_covariance(result)
    if C is None:
        return Judged(sigmas, allowed, None)
    problem = result.problem.on(data)
    residual = problem.residual(result.x)
    J = problem.jacobian(result.x)
    known = np.isfinite(np.diag(C))
    C = np.where(np.outer(known, known), C, 0.0)
    start = 0
    added = scattered(problem, result.noise_level)
    for block, reading, session in zip(data.blocks, added.reading, added.session, strict=True):
        k = len(block.measurement.components)
        end = start + k * len(block.row)
        r = residual[start:end].reshape(-1, k)
        A = J[start:end].reshape(-1, k, len(C))
        start = end
        S = A @ C @ A.transpose(0, 2, 1) + reading
        freedom = row_freedom(result.freedom, sessions_spread(result.learned), S, session)
        squares = np.sum(r * np.linalg.solve(S, r[:, :, None])[:, :, 0], axis=1)
        seen = (A[:, :, ~known] == 0).all(axis=(1, 2))
        sigmas[block.row] = np.where(seen, np.sqrt(squares), np.nan)
        allowed[block.row] = np.where(seen, _limit(k, freedom, N), np.nan)
        lengths = np.array([d in ("length", "pixel") for d in block.measurement.components.values()])
        factor = coverage_factor(freedom, CONFIDENCE)[:, None]
        within = np.abs(r) <= factor * np.sqrt(np.einsum("nkk->nk", S))
        inside.append(within[seen][:, lengths].ravel())
    covered = np.concatenate(inside)
    if not len(covered):
        return Judged(sigmas, allowed, None)
    return Judged(sigmas, allowed, float(covered.mean()))


def _limit(k: int, freedom: Array, rows: int) -> Array:
    """Return above which norm one of so many rows with k components lies with probability `RARE`."""
    return np.asarray(np.sqrt(k * fdtri(k, freedom, 1 - RARE / rows)))


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
        found = judged(result, apart)
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


def refit_all(result: Calibration, validation: Dataset | None = None) -> Calibration:
    """Return the calibration from identification and validation rows together, asked as this one was.

    Errors on the rows that were kept apart, which validate the procedure, stay in its record (``held_out``); the
    parameters that are delivered come from all rows. No row is left that checks these alone.

    Parameters
    ----------
    result
        The calibration that was validated.
    validation
        The rows that were kept apart; those of its record by default.

    Raises
    ------
    InputError
        Where no rows were kept apart, or measurements are not in memory.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> instance = ro.load("position")
    >>> result = instance.calibrate()
    >>> everything = ro.calibration.refit_all(result)
    >>> f"{1e3 * everything.record.held_out.error.mean():.3f} mm, then {len(everything.problem.data)} rows"
    '0.024 mm, then 80 rows'
    """
    apart = validation
    if apart is None:
        apart = result.record.validation
    if apart is None:
        raise InputError("validation", "no rows that were kept apart", "a calibration with validation data")
    if not result.stated.keeps_rows:
        raise InputError("refit_all", "measurements in parts", "measurements in memory")
    stated = result.stated
    whole = Dataset.together([stated.data, apart], ["identification", "validation"])
    held_out = HeldOut(
        whole.label[len(stated.data) :],
        len(stated.data),
        result.nominal_errors(apart),
        result.errors(apart),
        *judged(result, apart),
    )
    record = replace(result.record, validation=None, held_out=held_out)
    return replace(result.asked(stated.on(whole)), record=record)
