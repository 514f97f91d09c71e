"""Minima of quadratic programs: by formula without constraints, by an active set in a box."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.linalg import get_lapack_funcs

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.objective import Damping, Objective
from rpim_opt.problem.linear import RANK_TOLERANCE

FAR_APART = 1e-8
"""Ratio of pivots below which a matrix may not have full rank."""
SQUARED = 1e-6
"""The same where the matrix is squared first, which costs half of the digits: some of the solution's are left."""
_gels: Any
_potrf: Any
_potrs: Any
_gels, _potrf, _potrs = get_lapack_funcs(("gels", "potrf", "potrs"), dtype=float)
Bounds = tuple[Array, Array]
"""Lower and upper (n,)."""


def minimum(objective: Objective, weight: float, damping: Damping | None) -> Array:
    """Return the unconstrained minimum (n,)."""
    if damping is not None:
        return _least_squares(*objective.stacked(weight, damping))
    z = objective.ridge.minima(np.array([weight]))[0]
    if _plain(objective):
        return z
    A, b = objective.stacked(weight, None)  # a penalty that hardly holds some directions costs the formula digits
    return z + np.linalg.lstsq(A, b - A @ z, rcond=RANK_TOLERANCE)[0]


def moved(objective: Objective, weight: float, damping: Damping | None, pull: Array) -> Array | None:
    """Return by how far the minimum moves (n,) where A'b moves by ``pull`` (n,); None where that is not certain.

    By normal equations, which say so where they are far from singular.
    """
    A, _ = objective.stacked(weight, damping)
    factor, failed = _potrf(A.T @ A)
    pivots = factor.diagonal()
    if failed or pivots.min(initial=1.0) <= SQUARED * pivots.max(initial=0.0):
        return None
    return np.asarray(_potrs(factor, pull)[0], dtype=float)


def _least_squares(A: Array, b: Array) -> Array:
    """Return z (n,) where |A z - b| is least: by QR, and by singular values where its pivots are far apart."""
    n = A.shape[1]
    if len(A) >= n > 0:
        factors, z, _ = _gels(A, b)
        pivots = np.abs(factors.diagonal())
        if pivots.min() > FAR_APART * pivots.max():
            return np.asarray(z[:n], dtype=float)
    return np.asarray(np.linalg.lstsq(A, b, rcond=None)[0], dtype=float)


def _plain(objective: Objective) -> bool:
    """Whether the penalty is |z|^2, or there is none: its singular values are those of A."""
    form = objective.penalty_form
    return form is None or (form.diagonal and bool((form.L == 1).all()))


def values(objective: Objective, Z: Array) -> tuple[Array, Array]:
    """Return the loss and the penalty of many points Z (K, n), (K,) each, all at once."""
    R, n = objective.squared.triangle, Z.shape[1]
    loss = np.sum((Z @ R[:, :n].T - R[:, n]) ** 2, axis=1) + objective.squared.offset
    form = objective.penalty_form
    if form is None:
        return loss, np.zeros(len(Z))
    return loss, np.sum((form.times(Z.T).T - form.c) ** 2, axis=1) + form.constant


def minimum_between(
    objective: Objective,
    bounds: Bounds,
    weight: float,
    damping: Damping | None,
    free: Array | None = None,
    near: Array | None = None,
) -> tuple[Array, Array]:
    """Return the minimum (n,) in a box, and the multipliers (n,) of its bounds.

    Parameters
    ----------
    objective, weight, damping
        What is minimized.
    bounds
        The box.
    free
        The minimum (n,) without box and damping, if it is known.
    near
        A point (n,) near the minimum: that of a neighbouring weight or linearization. Of weight zero none is taken:
        what the data do not see would stay where it is.
    """
    from rpim_opt.convex.active_set import minimum_in_box  # a program without a box has no use of it

    lower, upper = bounds
    start = near if weight > 0 else None
    if start is None or free is not None:
        outside = minimum(objective, weight, None) if free is None else free
        if damping is None and weight > 0 and bool(np.all((lower <= outside) & (outside <= upper))):
            return outside, np.zeros_like(outside)
        start = outside if start is None else start
    A, b = objective.stacked(weight, damping)
    return minimum_in_box(A, b, lower, upper, np.clip(start, lower, upper))


def path_between(objective: Objective, bounds: Bounds, weights: Array) -> tuple[Array, Array]:
    """Return the minima (K, n) in a box at weights (K,), each from its neighbour, and their multipliers (K, n)."""
    if _plain(objective):
        free = objective.ridge.minima(weights)
    else:
        free = np.array([minimum(objective, float(weight), None) for weight in weights])
    Z, multipliers = np.zeros_like(free), np.zeros_like(free)
    start = None
    for k, weight in enumerate(weights):
        Z[k], multipliers[k] = minimum_between(objective, bounds, float(weight), None, free[k], start)
        start = Z[k]
    return Z, multipliers


def shares(objective: Objective, bounds: Bounds, z: Array, multipliers: Array) -> tuple[Array, ...]:
    """Return the multipliers (n,) of a box by constraint: where z lies on a bound, to a box stating it."""
    lower, upper = bounds
    left = multipliers.copy()
    found: list[Array] = []
    for low, high in objective._posed.limits:
        stated = (z <= lower) & (low == lower) | (z >= upper) & (high == upper)
        found.append(np.where(stated, left, 0.0))
        left = np.where(stated, 0.0, left)
    return tuple(found)
