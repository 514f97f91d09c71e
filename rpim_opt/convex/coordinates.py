"""Unknowns in which the squares of data and penalty are diagonal together, and the rows of the data by them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.products import product
from rpim_opt.convex.quadratic import ridge
from rpim_opt.convex.structure import Quadratic
from rpim_opt.problem.linear import LinearModel


@dataclass(frozen=True, eq=False)
class Coordinates:
    """z = offset + B a, with the penalty weight |a_k|^2 on some of the a (p,), and rows A B sorted by groups.

    Parameters
    ----------
    offset, B
        (n,) and (n, p).
    rows, b
        (m, p) = A B, and (m,) = b - A offset.
    penalized
        (p,) which a the penalty sees.
    gram
        (p, p) = rows'rows.
    """

    offset: Array
    B: Array
    rows: Array
    b: Array
    penalized: np.ndarray
    gram: Array

    def of(self, kept: np.ndarray) -> Coordinates:
        """Return the same coordinates where some rows are zero; ``kept`` (m,) says which are not.

        Data and penalty are then diagonal together no more, but nearly where few rows are left out.
        """
        left_out = self.rows[~kept]
        gram = self.gram - left_out.T @ left_out
        rows, b = self.rows.copy(), self.b.copy()
        rows[~kept] = 0.0
        b[~kept] = 0.0
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
        """(p,) squared lengths of the columns of rows."""
        return np.diag(self.gram).copy()


def coordinates(model: LinearModel, penalty: Quadratic | None, order: np.ndarray) -> Coordinates:
    """Return the coordinates in which data and penalty are both diagonal; ``order`` (m,) sorts equations by groups."""
    form = ridge(model, penalty)
    B = np.hstack([form.B, form.free])
    rows = product(model.A, B)
    left = model.b - model.A @ form.offset
    if (np.diff(order) != 1).any():  # most tables are sorted, and a copy costs as much as the product
        rows, left = rows[order], left[order]
    penalized = np.arange(B.shape[1]) < form.B.shape[1]
    few = model.triangle[:-1, :-1] @ B  # rows whose squares are those of all
    return Coordinates(form.offset, B, rows, left, penalized, few.T @ few)
