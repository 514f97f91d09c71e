"""The unknowns of a formulation as a CVXPY variable with named entries; importing it imports CVXPY."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cvxpy as cp

from rpim_opt.convex.arguments import index_of


class Unknown(cp.Variable):
    """z (n,), deviations in units of their scales, with named entries: ``z["a2"]``, ``z["a?"]``, ``z[["a2", "d1"]]``.

    >>> import rpim_opt as ro
    >>> z = ro.convex.Unknown(("a1", "a2", "d1"))
    >>> z["a2"].shape, z["a?"].shape, z[["a2", "d1"]].shape, z[1].shape
    ((), (2,), (2,), ())
    >>> z["a4"]
    Traceback (most recent call last):
    rpim_opt.basics.exceptions.InputError: z: found 'a4', accepted: parameters: a1, a2, d1.
    """

    def __init__(self, names: Sequence[str]):
        super().__init__(len(names), name="z")
        self.names = tuple(names)

    def __getitem__(self, key: Any) -> Any:
        return super().__getitem__(index_of(self.names, key, "z"))
