"""A formulation whose penalty is that of a prior: about its centre, without what is replaced, with its statements."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.atoms import SQUARES, cp, named
from rpim_opt.convex.constraints import Ready
from rpim_opt.convex.formulation import NAMED, Formulation
from rpim_opt.convex.stated import Stated
from rpim_opt.convex.statement import listed
from rpim_opt.convex.structure import Quadratic

Vector = tuple[float, ...]
Matrix = tuple[Vector, ...]


@dataclass(frozen=True)
class _Believed:
    """penalty(keep (z - centre)) + |rows z - values|^2; of norms |D_k keep (z - centre)| where groups D_k are given.

    ``keep`` is 1 / scale, and zero for what the statements replace.
    """

    penalty: Callable[[Any], Any] | None
    keep: Vector
    centre: Vector
    rows: Matrix
    values: Vector
    groups: tuple[Matrix, ...] | None = None

    def __call__(self, z: Any) -> Any:
        """Return the CVXPY expression."""
        terms = []
        if self.penalty is not None:
            terms.append(self._own(cp.multiply(np.array(self.keep), z - np.array(self.centre))))
        if self.rows:
            terms.append(cp.sum_squares(np.array(self.rows) @ z - np.array(self.values)))
        return sum(terms[1:], terms[0])

    def __reduce__(self) -> Any:
        arguments = [getattr(self, each.name) for each in fields(self)]
        return believed, tuple(arguments)

    def _own(self, y: Any) -> Any:
        penalty: Any = self.penalty
        if self.groups is None:
            return penalty(y)
        differences = [np.array(D) for D in self.groups]
        if penalty == SQUARES:  # of norms: the sum of all squares, and no cone
            return cp.sum_squares(np.vstack(differences) @ y)
        return penalty(cp.hstack([cp.norm(D @ y) for D in differences]))


@dataclass(frozen=True)
class _ReadyBelieved(_Believed, Ready):
    """The same of a ready penalty: equal in content is equal in meaning, and a file holds it."""

    maker = "believed"

    @property
    def stated(self) -> list[Any]:
        """The maker's name and its arguments, the penalty by its own name."""
        return [self.maker, self.penalty, self.keep, self.centre, self.rows, self.values, self.groups]

    @property
    def quadratic(self) -> Quadratic | None:
        """The quadratic that it declares to be, without squared numbers in between; None where it is something else."""
        return self._quadratic

    @cached_property
    def _quadratic(self) -> Quadratic | None:
        if self.penalty not in (None, SQUARES) or (self.penalty is None and not self.rows):
            return None
        n = len(self.centre)
        L = [np.zeros((0, n))]
        c = [np.zeros(0)]
        if self.penalty is not None:
            own = np.diag(self.keep)
            if self.groups is not None:
                own = np.vstack([np.array(D) for D in self.groups]) @ own
            L.append(own)
            c.append(own @ np.array(self.centre))
        if self.rows:
            L.append(np.array(self.rows))
            c.append(np.array(self.values))
        return _reduced(np.vstack(L), np.concatenate(c))


def _reduced(L: Array, c: Array) -> Quadratic:
    """Return |L z - c|^2 with no more rows than unknowns, diagonal where L is."""
    n = L.shape[1]
    if len(L) == n and not np.any(L - np.diag(np.diag(L))):
        return Quadratic(np.diag(L).copy(), c)
    if len(L) <= n:
        return Quadratic(L, c)
    R: Any = np.linalg.qr(np.column_stack([L, c]), mode="r")
    return Quadratic(R[:n, :n], R[:n, n], float(R[n, n] ** 2))


def believed(
    penalty: Callable[[Any], Any] | None, keep: Any, centre: Any, rows: Any, values: Any, groups: Any
) -> Callable[[Any], Any]:
    """Return the penalty of a prior."""
    penalty = named(penalty)
    parts: list[Any] = [penalty, tuple(keep), tuple(centre), tuple(map(tuple, rows)), tuple(values), None]
    if groups is not None:
        parts[-1] = tuple(tuple(map(tuple, D)) for D in groups)
    if penalty is None or penalty in NAMED or isinstance(penalty, Ready):
        return _ReadyBelieved(*parts)
    return _Believed(*parts)


def penalized(formulation: Formulation, stated: Stated) -> Formulation:
    """Return the formulation whose penalty is that of a prior; arguments as for `Prior.penalized`."""
    if stated.plain or (formulation.penalty is None and not len(stated.rows)):
        return formulation
    keep = np.where(stated.replaced, 0.0, 1 / stated.scale)
    groups = None
    if formulation.penalty is not None and formulation.penalty_over is not None:
        groups = [listed(np.asarray(D, dtype=float)) for D in formulation.penalty_over(stated.parameters)]
    penalty = believed(
        formulation.penalty,
        keep.tolist(),
        stated.centre.tolist(),
        listed(stated.rows),
        stated.values.tolist(),
        groups,
    )
    return replace(formulation, penalty=penalty, penalty_over=None)
