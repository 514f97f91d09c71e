"""Unknowns in which a penalty with kinks is a sum over components and groups, and the minima of a program in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.faces import Faces
from rpim_opt.convex.kinks import Kinks

INDEPENDENT = 1e-8
"""Smallest singular value, relative to the largest, of differences that count as independent."""


@dataclass(frozen=True, eq=False)
class Split:
    """z = T y + shift, in which the penalty's norms are those of components and groups of y.

    Parameters
    ----------
    T, shift
        (n, n) and (n,); T is None for the identity.
    price, member, groups
        As `Faces` has them.
    H, g, constant
        The penalty's smooth part in y; H is None where it is zero.
    """

    T: Array | None
    shift: Array
    price: Array
    member: np.ndarray
    groups: Array
    H: Array | None
    g: Array
    constant: float
    back: Array | None

    def z(self, y: Array) -> Array:
        """Return z of y, (n,) or (K, n)."""
        if self.T is None:
            return y + self.shift
        return y @ self.T.T + self.shift

    def y(self, z: Array) -> Array:
        """Return y of z (n,)."""
        if self.back is None:
            return z - self.shift
        return self.back @ (z - self.shift)

    def faces(self, A: Array, b: Array, box: tuple[Array, Array]) -> Faces | None:
        """Return the program |A z - b|^2 + weight penalty in a box, in y; None where the box is none there.

        Parameters
        ----------
        A, b
            (k, n) and (k,).
        box
            Lower and upper bounds (n,) of z.
        """
        bounded = np.isfinite(box[0]) | np.isfinite(box[1])
        if bounded.any() and (self.T is not None or (bounded & (self.member >= 0)).any()):
            return None
        lower, upper = box[0] - self.shift, box[1] - self.shift
        M = A if self.T is None else A @ self.T
        d = b - A @ self.shift
        return Faces(M, d, self.H, self.g, self.price, self.member, self.groups, lower, upper)


def split(kinks: Kinks) -> Split | None:
    """Return the unknowns in which a penalty's kinks do not share components; None where there are none such.

    The rows of all D_k together have to be independent; then y = D z - c, and what they do not see stands beside it.

    >>> import cvxpy as cp
    >>> from rpim_opt.convex.kinks import kinks
    >>> from rpim_opt.convex.split import split
    >>> z = cp.Variable(3)
    >>> split(kinks(cp.norm1(z) + cp.norm(z[:2]), z)) is None  # both have kinks in the same components
    True
    >>> found = split(kinks(cp.tv(z), z))
    >>> [float(p) for p in found.price]  # two differences, and the level
    [1.0, 1.0, 0.0]
    """
    n = len(kinks.g)
    if not kinks.norms:
        return None
    D = np.vstack([D for D, _, _ in kinks.norms])
    c = np.concatenate([c for _, c, _ in kinks.norms])
    if len(D) > n:
        return None
    price, member, groups = np.zeros(n), np.full(n, -1), []
    start = 0
    for rows, _, cost in kinks.norms:
        inside = slice(start, start + len(rows))
        start += len(rows)
        if len(rows) == 1:
            price[inside] = cost
        else:
            member[inside] = len(groups)
            groups.append(cost)
    alone = _selection(D, kinks.norms, price)
    if alone is not None:
        order, factor = alone
        ordered = price[: len(D)] * factor
        back = np.full(n, -1)
        priced = np.zeros(n)
        priced[order] = ordered
        back[order] = member[: len(D)]
        prices = np.array(groups)
        for k in range(len(groups)):
            prices[k] *= factor[member[: len(D)] == k][0]
        shift = np.zeros(n)
        shift[order] = c / D[np.arange(len(D)), order]
        return _made(kinks, None, shift, priced, back, prices, None)
    U, s, Vt = np.linalg.svd(D)
    if s[-1] <= INDEPENDENT * s[0]:
        return None
    T = np.hstack([(Vt[: len(D)].T / s) @ U.T, Vt[len(D) :].T])
    shift = T[:, : len(D)] @ c
    back = np.vstack([D, Vt[len(D) :]])
    return _made(kinks, T, shift, price, member, np.array(groups), back)


def _selection(D: Array, norms: Sequence[tuple[Array, Array, float]], price: Array) -> tuple[np.ndarray, Array] | None:
    """Return which component every row of D picks, and by what factor; None where rows do more than that.

    The rows of a group have one factor.
    """
    picks = D != 0
    if (np.count_nonzero(picks, axis=1) != 1).any() or (np.count_nonzero(picks, axis=0) > 1).any():
        return None
    order = np.argmax(picks, axis=1)
    factor = np.abs(D[np.arange(len(D)), order])
    start = 0
    for rows, _, _ in norms:
        inside = factor[start : start + len(rows)]
        start += len(rows)
        if np.ptp(inside) > 0:
            return None
    return order, factor


def _made(
    kinks: Kinks, T: Array | None, shift: Array, price: Array, member: np.ndarray, groups: Array, back: Array | None
) -> Split:
    H, g = kinks.H, kinks.g + kinks.H @ shift
    constant = kinks.constant + float(0.5 * shift @ kinks.H @ shift + kinks.g @ shift)
    if T is not None:
        H, g = T.T @ H @ T, T.T @ g
    return Split(T, shift, price, member, groups, H if H.any() else None, g, constant, back)
