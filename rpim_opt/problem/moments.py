"""Quadratic forms of rotations, relaxed to moment matrices: the definition in CVXPY."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.late import Late

if TYPE_CHECKING:
    import cvxpy as cp
else:
    cp = Late("cvxpy")


@lru_cache
def rotation_constraints(count: int) -> Array:
    """Return C (c, n, n) with x'C x = 0 for x = (1, vec R_1, ..., vec R_count), rows first, and no other quadratic.

    Of every rotation the twenty independent ones: R R' = 1 and R'R = 1, of which one diagonal entry follows from the
    others, and each row the cross product of the next two, which says that R is right-handed.
    """
    rows = [_quadratic(count, terms) for k in range(count) for terms in _of_rotation(1 + 9 * k)]
    return np.array(rows)


def _of_rotation(first: int) -> list[list[tuple[int, int, float]]]:
    """Return the terms (place, place, coefficient) of the quadratics that vanish on one rotation."""
    at = first + np.arange(9).reshape(3, 3)
    forms = []
    for entries in (at, at.T):
        for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)):
            terms = [(int(a), int(b), 1.0) for a, b in zip(entries[i], entries[j], strict=True)]
            forms.append([*terms, (0, 0, -float(i == j))])
    del forms[-1]  # both sums of squares are three
    for i in range(3):
        p, q, r = at[i], at[(i + 1) % 3], at[(i + 2) % 3]
        for a in range(3):
            b = (a + 1) % 3
            c = (a + 2) % 3
            forms.append([(int(p[b]), int(q[c]), 1.0), (int(p[c]), int(q[b]), -1.0), (0, int(r[a]), -1.0)])
    return forms


def _quadratic(count: int, terms: list[tuple[int, int, float]]) -> Array:
    """Return the symmetric matrix (n, n) of a sum of products."""
    M = np.zeros((1 + 9 * count, 1 + 9 * count))
    for i, j, value in terms:
        M[i, j] += value / 2
        M[j, i] += value / 2
    return M


@dataclass(frozen=True, eq=False)
class Relaxation:
    """The relaxation of min x'Q x over x = (1, vec R_1, ..., vec R_k), in the form that has k 20 + 1 unknowns.

    ::

        maximize    bound
        subject to  Q - bound e e' - sum_j multipliers_j C_j  positive semidefinite,    e = (1, 0, ..., 0)

    For rotations the left side of the constraint times x x' is x'Q x - bound >= 0: no rotation has a smaller value. The
    constraint's own multiplier is the moment matrix, which minimizes <Q, M> over all positive semidefinite M with
    M_00 = 1 and <C_j, M> = 0.

    Where Q has no products of some rotations (tools seen by the same cameras), the left side is the sum of positive
    semidefinite parts, one for each of those rotations with 1 and all that they share: its pattern is chordal (Agler et
    al. 1988, Linear Algebra and its Applications 107:101). Time then grows with their number, not with its power.

    Parameters
    ----------
    problem
        As above.
    places
        Of each part among the n.
    forms
        Each part's share of Q; products of what is shared stand in the last.
    bound, multipliers
        The unknowns.
    constraints
        One for each part.
    """

    problem: cp.Problem
    places: tuple[np.ndarray, ...]
    forms: tuple[cp.Parameter, ...]
    bound: cp.Variable
    multipliers: cp.Variable
    constraints: tuple[Any, ...]

    def state(self, Q: Array) -> None:
        """Give the parameters the values of a form."""
        for form, share in zip(self.forms, shares(Q, self.places), strict=True):
            form.value = share


def _places(count: int, shared: int) -> tuple[np.ndarray, ...]:
    """Return the places of every part: of 1, the shared rotations and one of the others."""
    common = np.arange(1 + 9 * shared)
    own = [np.arange(1 + 9 * k, 10 + 9 * k) for k in range(shared, count)]
    return tuple(np.concatenate([common, each]) for each in own) or (common,)


def shares(Q: Array, places: Sequence[np.ndarray]) -> list[Array]:
    """Return each part's share of a form."""
    common = np.intersect1d(places[0], places[-1])
    parts = [Q[np.ix_(place, place)] for place in places]
    for part in parts[:-1]:
        part[: len(common), : len(common)] = 0.0
    return parts


def relaxation(count: int, shared: int) -> Relaxation:
    """Return the definition for so many rotations, of which the first are shared by all others."""
    places = _places(count, shared)
    bound = cp.Variable()
    multipliers = cp.Variable(20 * count)
    common = 1 + 9 * shared
    moved = [cp.Variable((common, common), symmetric=True) for _ in places[1:]]
    first = np.zeros((common, common))
    first[0, 0] = 1.0
    last = -bound * first  # of what is shared, the last part has what the others leave
    for each in moved:
        last = last - each
    forms = tuple(cp.Parameter((len(place), len(place)), symmetric=True) for place in places)
    constraints = []
    for place, form, corner in zip(places, forms, [*moved, last], strict=True):
        border = np.eye(len(place))[:, :common]
        own = _own_constraints(place, count, shared, corner is last)
        C = rotation_constraints(count)[np.ix_(own, place, place)].reshape(len(own), -1)
        combined = cp.reshape(C.T @ multipliers[own], form.shape, order="C")
        constraints.append(form + border @ corner @ border.T - combined >> 0)
    problem = cp.Problem(cp.Maximize(bound), constraints)
    return Relaxation(problem, places, forms, bound, multipliers, tuple(constraints))


def _own_constraints(place: np.ndarray, count: int, shared: int, last: bool) -> np.ndarray:
    """Return which constraints are a part's: of its own rotation, and in the last of those that are shared."""
    rotations = [*range(shared)] if last else []
    if len(place) > 1 + 9 * shared:
        rotations.append(int(place[-1]) // 9 - 1)
    return (20 * np.array(rotations)[:, None] + np.arange(20)).ravel()
