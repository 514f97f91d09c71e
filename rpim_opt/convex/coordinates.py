"""Unknowns in which the squares of data and penalty are diagonal together, and the rows of the data by them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.products import DEAR, product
from rpim_opt.convex.quadratic import ridge
from rpim_opt.convex.structure import Quadratic
from rpim_opt.problem.linear import LinearModel

ROUNDED = 1e4
"""By how much more than A B products of A with B may be rounded: half the digits of second derivatives are left."""


@dataclass(frozen=True, eq=False)
class Coordinates:
    """z = offset + B a, with the penalty weight |a_k|^2 on some of the a (p,), and rows A B sorted by groups.

    Of many equations the product is dear: rows are then those of A, and `turn` says what they are by a.

    Parameters
    ----------
    offset, B
        (n,) and (n, p).
    rows, b
        (m, p) = A B, or (m, n) = A, and (m,) = b - A offset.
    penalized
        (p,) which a the penalty sees.
    gram
        rows'rows.
    turn
        (n, p), B without what the data do not see: rows turn = A B. None where rows are that themselves.
    """

    offset: Array
    B: Array
    rows: Array
    b: Array
    penalized: np.ndarray
    gram: Array
    turn: Array | None = None

    def by_row(self, a: Array) -> Array:
        """Return A B a (m,)."""
        if self.turn is not None:
            a = self.turn.dot(a)
        return self.rows.dot(a)  # of short vectors, calls are dear: `dot` is a shorter one than `@`

    def along(self, y: Array) -> Array:
        """Return B'A'y (p,) of y (m,)."""
        found = self.rows.T.dot(y)
        if self.turn is None:
            return found
        return self.turn.T.dot(found)

    def turned(self, H: Array) -> Array:
        """Return what products of rows with themselves are by the coordinates (p, p)."""
        if self.turn is None:
            return H
        return self.turn.T @ H @ self.turn

    def of(self, kept: np.ndarray) -> Coordinates:
        """Return the same coordinates where some rows are zero; ``kept`` (m,) says which are not.

        Data and penalty are then diagonal together no more, but nearly where few rows are left out.
        """
        left_out = self.rows[~kept]
        gram = self.gram - left_out.T @ left_out
        rows, b = np.where(kept[:, None], self.rows, 0.0), np.where(kept, self.b, 0.0)
        return replace(self, rows=rows, b=b, gram=gram)

    @cached_property
    def inverse(self) -> Array:
        """(p, n) of the coordinates by z - offset."""
        return np.asarray(np.linalg.pinv(self.B), dtype=float)

    @cached_property
    def last(self) -> dict[str, Any]:
        """What the last search for a minimum in these coordinates leaves to the next."""
        return {}

    @cached_property
    def lengths(self) -> Array:
        """(p,) squared lengths of the columns of A B."""
        return np.diag(self.turned(self.gram)).copy()


def coordinates(
    model: LinearModel, penalty: Quadratic | None, order: np.ndarray, multiplied: bool = True
) -> Coordinates:
    """Return the coordinates in which data and penalty are both diagonal.

    Parameters
    ----------
    model, penalty
        The data, and what is penalized.
    order
        (m,) sorts equations by groups.
    multiplied
        Whether rows must be A B, however many there are.
    """
    form = ridge(model, penalty)
    B = np.hstack([form.B, form.free])
    few = model.triangle[:-1, :-1]  # rows whose squares are those of all
    turn = np.hstack([np.where(form.seen, form.B, 0.0), form.free])
    if not multiplied and model.A.size >= DEAR and _keeps_digits(few, turn):
        rows = model.A
    else:
        rows, few, turn = product(model.A, B), few @ B, None
    left = model.b - model.A @ form.offset
    if (np.diff(order) != 1).any():  # most tables are sorted, and a copy costs as much as the product
        rows, left = rows[order], left[order]
    penalized = np.arange(B.shape[1]) < form.B.shape[1]
    return Coordinates(form.offset, B, rows, left, penalized, few.T @ few, turn)


def _keeps_digits(A: Array, B: Array) -> bool:
    """Whether A (m, n) and B (n, p), one after the other, are about as exact as their product."""
    together = np.linalg.norm(A @ B, axis=0)
    apart = np.linalg.norm(A, axis=0) @ np.abs(B)
    return bool(np.all(apart <= ROUNDED * together))
