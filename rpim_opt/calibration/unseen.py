"""Rows that a calibration did not see, in units of what its uncertainty predicts of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import fdtri, stdtrit

from rpim_opt.basics.arrays import Array
from rpim_opt.calibration.intervals import scattered
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.uncertainty import known_covariance
from rpim_opt.convex.prior import SESSIONS
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.sessions import unknown_sessions

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
    readings = scattered(problem, result.noise_level).reading
    for block, reading, session in zip(data.blocks, readings, unknown_sessions(problem), strict=True):
        k = len(block.measurement.components)
        end = start + k * len(block.row)
        r = residual[start:end].reshape(-1, k)
        A = J[start:end].reshape(-1, k, len(C))
        start = end
        S = A @ C @ A.transpose(0, 2, 1) + reading
        freedom = _freedom(result, S, session)
        squares = np.sum(r * np.linalg.solve(S, r[:, :, None])[:, :, 0], axis=1)
        seen = (A[:, :, ~known] == 0).all(axis=(1, 2))
        sigmas[block.row] = np.where(seen, np.sqrt(squares), np.nan)
        allowed[block.row] = np.where(seen, _limit(k, freedom, N), np.nan)
        lengths = np.array([d in ("length", "pixel") for d in block.measurement.components.values()])
        factor = np.asarray(stdtrit(freedom, (1 + CONFIDENCE) / 2))[:, None]
        within = np.abs(r) <= factor * np.sqrt(np.einsum("nkk->nk", S))
        inside.append(within[seen][:, lengths].ravel())
    covered = np.concatenate(inside)
    if not len(covered):
        return Judged(sigmas, allowed, None)
    return Judged(sigmas, allowed, float(covered.mean()))


def _freedom(result: Calibration, whole: Array, session: Array) -> Array:
    """Return the degrees of freedom (N,) of rows' variances, at least one; less where a few sessions told a part.

    2 V^2 / var(V) of the sum V of both parts' variances (Satterthwaite), where a size's logarithm has a spread.
    """
    freedom = max(result.freedom, 1.0)
    V = np.einsum("nkk->n", whole)
    part = np.broadcast_to(np.einsum("nkk->n", session), V.shape)
    spread = 0.0
    if result.learned is not None:
        sizes = result.learned.sizes
        spread = max((sizes[name].spread for name in SESSIONS.values() if name in sizes), default=0.0)
    variance = 2 * (V - part) ** 2 / freedom + (2 * spread * part) ** 2
    return np.maximum(np.minimum(2 * V**2 / np.maximum(variance, 1e-300), freedom), 1.0)


def _limit(k: int, freedom: Array, rows: int) -> Array:
    """Return above which norm one of so many rows with k components lies with probability `RARE`."""
    return np.asarray(np.sqrt(k * fdtri(k, freedom, 1 - RARE / rows)))
