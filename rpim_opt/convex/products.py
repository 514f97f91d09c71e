"""Products of many rows, in blocks that a processor's cache holds and on all cores."""

from __future__ import annotations

from functools import reduce

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.threads import on_all_cores

TOGETHER = 4096
"""Rows that are worked on together."""


DEAR = 200_000
"""Entries of the rows from which products with themselves are dear."""
SOME = 61
"""Of every so many rows one tells the weight that most may have; a prime, which meets all of a reading."""


def weighed_squares(rows: Array, weight: Array, gram: Array | None = None) -> Array:
    """Return rows' diag(weight) rows, (p, p), of rows (m, p) and weights (m,) of any sign.

    Where rows'rows (p, p) is known, ``gram``, those of many that have the usual weight cost nothing.

    >>> import numpy as np
    >>> from rpim_opt.convex.products import weighed_squares
    >>> weighed_squares(np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([1.0, -1.0]))
    array([[ -8., -10.],
           [-10., -12.]])
    """
    if gram is not None:
        usual = float(np.median(weight[::SOME]))
        other = np.flatnonzero(weight != usual)
        if 2 * len(other) <= len(rows):
            return usual * gram + weighed_squares(rows[other], weight[other] - usual)
    least, most = weight.min(initial=0.0), weight.max(initial=0.0)

    def squares(start: int) -> Array:
        some, by = rows[start : start + TOGETHER], weight[start : start + TOGETHER, None]
        if least < 0 < most:
            return some.T @ (by * some)
        some = np.sqrt(np.abs(by)) * some  # a product with itself costs half
        return some.T @ some

    total = reduce(np.add, on_all_cores(squares, range(0, max(len(rows), 1), TOGETHER)))
    if most == 0:
        return -total
    return total


def product(rows: Array, B: Array) -> Array:
    """Return rows B (m, q) of rows (m, p) and B (p, q).

    >>> import numpy as np
    >>> from rpim_opt.convex.products import product
    >>> product(np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([[1.0], [-1.0]])).tolist()
    [[-1.0], [-1.0]]
    """
    found = np.empty((len(rows), B.shape[1]))

    def multiplied(start: int) -> None:
        part = slice(start, start + TOGETHER)
        np.matmul(rows[part], B, out=found[part])

    on_all_cores(multiplied, range(0, len(rows), TOGETHER))
    return found
