"""Do similar configurations err alike? Neighbours in joint space against the same errors dealt out anew."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.late import spatial

SHUFFLES = 300
LEAST = 8
"""Configurations below which neighbours say nothing."""
FEW = 500
"""Up to so many points all distances are found sooner than SciPy's tree is loaded."""
SURELY = 1 - 1e-9
"""Of squared distances that differ by less rounding decides which is smaller: then the tree does, for all points."""


class Alike(NamedTuple):
    """Correlation of the errors of nearest configurations, and by how many standard deviations chance misses it."""

    correlation: float
    z: float


def alike(q: Array, errors: Array, kinds: np.ndarray) -> Alike | None:
    """Return whether the errors of configurations resemble those of their nearest neighbours in joint space.

    ::

        rho = sum_i e_i . e_nearest(i) / sum_i e_i . e_i

    and z = (rho - mean) / std over the same errors dealt out to the configurations at random. The neighbours stay
    when errors are dealt out: two that are each other's nearest count twice in both.

    Parameters
    ----------
    q
        (N, dof) joint values.
    errors
        (N, k) errors in units of their noise; zero beyond what was measured there.
    kinds
        (N,) which configurations have errors of the same kind: neighbours are among those.

    Returns
    -------
    None for fewer than `LEAST` configurations of the same kind.
    """
    unit = (q - q.mean(axis=0)) / (q.std(axis=0) + 1e-9)
    groups = [rows for kind in np.unique(kinds) if len(rows := np.flatnonzero(kinds == kind)) >= LEAST]
    squares = sum(float(np.sum(errors[rows] ** 2)) for rows in groups)
    if not squares > 0:
        return None
    rng = np.random.default_rng(0)
    found = 0.0
    dealt = np.zeros(SHUFFLES)
    for rows in groups:
        e = errors[rows]
        nearest = _nearest(unit[rows])
        found += float(np.sum(e * e[nearest]))
        # a table of all products: shuffles only look up
        products = e @ e.T
        for k in range(SHUFFLES):
            order = rng.permutation(len(rows))
            dealt[k] += float(np.sum(products[order, order[nearest]]))
    spread = float(dealt.std())
    if not spread > 0:
        return None
    return Alike(found / squares, (found - float(dealt.mean())) / spread)


def _nearest(points: Array) -> np.ndarray:
    """Return the number (N,) of every point's nearest other one."""
    number = np.arange(len(points))
    if len(points) <= FEW:
        squares = np.sum((points[:, None] - points) ** 2, axis=2)
        np.fill_diagonal(squares, np.inf)
        nearest, next_one = np.partition(squares, 1)[:, :2].T
        if np.all(nearest < SURELY * next_one):
            return np.argmin(squares, axis=1)
    near = np.asarray(spatial.KDTree(points).query(points, k=2)[1])
    # of points at the same place either may come first
    return np.where(near[:, 0] == number, near[:, 1], near[:, 0])
