"""What Student's tails add to the covariance of deviations, beside the normal that stands for them at an optimum."""

from __future__ import annotations

import numpy as np

from rpim_opt.basics.arrays import Array

PRECISIONS = np.linspace(-14.0, 8.0, 200)
"""Logarithms of a deviation's own precision times its squared size, between which nearly all of a t_3 lies."""
WIDEST = 100.0
"""By how much tails may multiply a local variance: where data contradict them, nothing else bounds it."""


def added(z: Array, C: Array, v: Array, heavy: np.ndarray, size: Array, tails: float) -> Array:
    """Return by what deviations move (p, h): D, with D D' what tails add to their covariance C.

    The normal of variance v_j that stands for the t_nu of a deviation j has its curvature at the mean, not its width:
    where nothing decides z_j, v_j is size^2, and a t_3's variance is three times as much. What the data say of z_j,
    apart from that normal, has the precision p = 1 / C_jj - 1 / v_j and the mean z_j / (C_jj p). V_j is the variance
    of that times t_nu, and w_j = 1 / V_j - p the precision that a normal in the place of the tails needs to agree::

        C + D D' = (C^-1 - diag(1 / v - w))^-1        D = C B L^-T,    B B' = diag(1 / v - w),    L L' = I - B'C B

    Means stay. (One step of expectation propagation, from the mean field on.)

    Parameters
    ----------
    z, C
        (p,) and (p, p), with the local variances.
    v
        (p,) the local variances.
    heavy
        (h,) the deviations with tails, by number.
    size
        (h,) their sizes.
    tails
        Degrees of freedom.
    """
    c = C.diagonal()[heavy]
    local = v[heavy]
    known = np.maximum(1 / c - 1 / local, 0.0)
    precision = 1 / _variance(known * size**2, z[heavy] / c * size, tails) / size**2 - known
    B = np.sqrt(1 / local - np.clip(precision, 1 / (WIDEST * local), 1 / local))
    own = C[np.ix_(heavy, heavy)]
    L = np.linalg.cholesky(np.eye(len(B)) - own * np.outer(B, B))
    return np.asarray(np.linalg.solve(L, (C[:, heavy] * B).T).T, dtype=float)


def _variance(precision: Array, moved: Array, tails: float) -> Array:
    """Return the variances (h,) of t_nu times normals exp(moved t - precision t^2 / 2), as mixtures of normals."""
    logs = PRECISIONS * np.sqrt(3 / max(tails, 3.0))  # the nearer to a normal, the closer they are to zero
    own = np.exp(logs)
    both = precision[:, None] + own
    mean = moved[:, None] / both
    log = (tails * (logs - own) + logs - np.log(both) + moved[:, None] * mean) / 2
    share = np.exp(log - log.max(axis=1, keepdims=True))
    share /= share.sum(axis=1, keepdims=True)
    middle = np.sum(share * mean, axis=1, keepdims=True)
    return np.asarray(np.sum(share * (1 / both + (mean - middle) ** 2), axis=1), dtype=float)
