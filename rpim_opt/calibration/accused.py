"""Rows that a fit distrusts, held against what a fit without them predicts, with what that leaves open."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtrc, fdtrc

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.structure import Quadratic
from rpim_opt.convex.trust import RARE
from rpim_opt.problem.linear import LinearModel

WIDE = 30.0
"""Times what deviations are believed to be, so that no prior alone accuses. Chosen on 300 simulated arms with ten good
configurations, of which 7 have a row accused then, and 40 without this test; on 300 others 7 and 41. Meant are 3."""
LOOSE = 1e-9
"""Part of what equations say of all deviations, below which a direction is one that the others do not decide."""


def contradicted(
    model: LinearModel, penalty: Quadratic | None, weight: float, width: Array, groups: np.ndarray
) -> np.ndarray:
    """Return which of some configurations (g,) the others contradict.

    A robust loss may fit half of few equations at the expense of the other half, of which none is wrong. So all the
    suspects together are left out, and each is held against what the rest predicts of it, by the false rate of flags::

        e' (sigma^2 (I + A_i H^-1 A_i'))^-1 e,    H = A' A + weight L' L of the rest,    e = b_i - A_i z

    Parameters
    ----------
    model
        All equations, linearized at the solution, in units of their noise.
    penalty, weight
        |L z - c|^2 and its weight against them; None where there is none.
    width
        (n,) how large deviations are believed to be, in units of their scales.
    groups
        (g,) numbers of the configurations that are suspected.
    """
    rest = ~np.isin(model.group, groups)
    A, b = model.A[rest], model.b[rest]
    n = A.shape[1]
    L, c = np.zeros((0, n)), np.zeros(0)
    if penalty is not None and weight > 0:
        L = np.sqrt(weight) * penalty.matrix / (WIDE * width)
        c = np.sqrt(weight) * penalty.c
    U, s, V = np.linalg.svd(np.vstack([A, L]), full_matrices=False)
    seen = s > LOOSE * s[0]
    root = V[seen].T / s[seen]  # H^-1 = root root'
    z = root @ (U[:, seen].T @ np.concatenate([b, c]))
    spare = len(b) - float(np.sum((A @ root) ** 2))
    sigma2 = 1.0
    if spare > 1:
        sigma2 = max(1.0, float(np.sum((A @ z - b) ** 2)) / spare)
    undecided = np.eye(n) - V[seen].T @ V[seen]
    count = len(np.unique(model.group))
    found = []
    for number in groups:
        rows = model.group == number
        a = model.A[rows]
        S = np.eye(len(a)) + (a @ root) @ (a @ root).T
        e = a @ z - model.b[rows]
        told = np.linalg.norm(a @ undecided) <= np.sqrt(LOOSE) * np.linalg.norm(a)
        chance = _chance(float(e @ np.linalg.solve(S, e)) / sigma2, len(a), spare, sigma2)
        found.append(bool(told) and chance < RARE / count)
    return np.array(found, dtype=bool)


def _chance(squares: float, k: int, spare: float, sigma2: float) -> float:
    """Return the probability of so much: by the declared noise, or where it was estimated by Fisher's F."""
    if sigma2 > 1:
        return float(fdtrc(k, spare, squares / k))
    return float(chdtrc(k, squares))
