"""Rows that a calibration did not see, in units of what its uncertainty predicts of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import fdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.bayes.hyperparameters import sessions_spread
from rpim_opt.calibration.intervals import coverage_factors, row_freedom, scattered
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import known_covariance
from rpim_opt.data.dataset import Dataset

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
        factor = coverage_factors(freedom, CONFIDENCE)[:, None]
        within = np.abs(r) <= factor * np.sqrt(np.einsum("nkk->nk", S))
        inside.append(within[seen][:, lengths].ravel())
    covered = np.concatenate(inside)
    if not len(covered):
        return Judged(sigmas, allowed, None)
    return Judged(sigmas, allowed, float(covered.mean()))


def _limit(k: int, freedom: Array, rows: int) -> Array:
    """Return above which norm one of so many rows with k components lies with probability `RARE`."""
    return np.asarray(np.sqrt(k * fdtri(k, freedom, 1 - RARE / rows)))
