"""Residuals of configurations that had no say in an estimate: by formula for squares, or solved again."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.program import Program
from rpim_opt.convex.selection import Score
from rpim_opt.problem.linear import from_triangle, reduced_rows

DROPPED = 1e-13
"""Pivots below this belong to what nothing else decides."""
RAISED, SAME = 1e-4, 1e-12
"""By how much norms are raised to see whether they matter to a loss; relative change of it that is rounding."""
CLOSE = 3.0
"""Ratio of weights up to which a path is about a line between them."""
KEPT = 500_000_000
"""Bytes of equations that are kept for all parts together; of more, what is left without a part is made when asked."""
MANY = 1_000_000
"""Residuals that are in memory together, of many weights."""


class Rows(NamedTuple):
    """Rows of configurations with the same number of equations, (G, k): places in the residual."""

    places: np.ndarray
    configurations: np.ndarray


def by_size(group: np.ndarray) -> list[Rows]:
    """Return the rows of configurations, those of a size together.

    Parameters
    ----------
    group
        (m,) number of the configuration that an equation belongs to.
    """
    which, count = np.unique(group, return_inverse=True, return_counts=True)[1:]
    order = np.argsort(which, kind="stable")
    first = np.cumsum(count) - count
    found = []
    for size in np.unique(count):
        configurations = np.flatnonzero(count == size)
        places = order[first[configurations][:, None] + np.arange(size)]
        found.append(Rows(places, configurations))
    return found


def taken(M: Array, places: np.ndarray) -> Array:
    """Return rows (G, k, p) of (m, p), or numbers (G, k) of (m,): no copy where their places follow each other."""
    first = int(places[0, 0]) if places.size else 0
    if np.array_equal(places.ravel(), np.arange(first, first + places.size)):
        return M[first : first + places.size].reshape(*places.shape, *M.shape[1:])
    return M[places]


def solved(M: Array, v: Array) -> Array:
    """Return M^-1 v for many small symmetric matrices, (k, k, ...) and (k, ...), without pivoting.

    What a vanishing pivot would decide is zero, as in a pseudo-inverse.
    """
    k = len(M)
    M, v = M.copy(), v.copy()
    for i in range(k):
        pivot = M[i, i]
        with np.errstate(divide="ignore"):
            inverse = np.where(np.abs(pivot) > DROPPED, 1 / pivot, 0.0)
        M[i, i] = inverse
        for j in range(i + 1, k):
            share = M[j, i] * inverse
            M[j, i:] = M[j, i:] - share * M[i, i:]
            v[j] = v[j] - share * v[i]
    for i in reversed(range(k)):
        for j in range(i + 1, k):
            v[i] = v[i] - M[i, j] * v[j]
        v[i] = v[i] * M[i, i]
    return v


def of_squares(Q: Array, s2: Array, target: Array, group: np.ndarray) -> Score:
    """Return the sums of squares (K,) of all left-out residuals of an estimator with influence Q diag(f) Q', by weight.

    With f = s^2 / (s^2 + weight) and residuals r of all, r_g^- = (1 - Q_g diag(f) Q_g')^-1 r_g.

    Parameters
    ----------
    Q, s2, target
        (m, p), (p,) and the values (m,).
    group
        (m,) number of the configuration.
    """
    projected = Q.T @ target
    parts = [(rows.places, _products(Q, rows.places)) for rows in by_size(group)]

    def some(weights: Array) -> Array:
        filters = (s2 / (s2 + weights[:, None])).T
        residual = target[:, None] - Q @ (filters * projected[:, None])
        total = np.zeros(len(weights))
        for places, products in parts:
            k = places.shape[1]
            M = np.empty((k, k, len(places), len(weights)))
            for (i, j), product in products.items():
                M[i, j] = (i == j) - product @ filters
                M[j, i] = M[i, j]
            left = solved(M, residual[places.T])
            total += np.einsum("igw,igw->w", left, left)
        return total

    few = max(1, MANY // len(target))

    def score(weights: Array) -> Array:
        return np.concatenate([some(weights[start : start + few]) for start in range(0, len(weights), few)])

    return score


def _products(Q: Array, places: np.ndarray) -> dict[tuple[int, int], Array]:
    """Return the products (G, p) of the rows i <= j of every configuration, whose sums are its influence."""
    k = places.shape[1]
    rows = taken(Q, places)
    return {(i, j): rows[:, i] * rows[:, j] for i in range(k) for j in range(i, k)}


class Folds:
    """A program without each of some parts of its configurations, solved again at weights that are asked for.

    Parameters
    ----------
    program
        The whole.
    parts
        Numbers of the configurations that are left out together.
    """

    def __init__(self, program: Program, parts: Sequence[np.ndarray]):
        self._whole, self._rows = program, _rows(program.model.group, parts)
        self._kept: list[Program] = []
        if program.on_triangles or len(parts) * program.model.A.nbytes <= KEPT:
            self._kept = list(_folds(program, self._rows))
        self._met: list[dict[float, Array]] = [{} for _ in parts]

    def norms(self, weights: Array) -> Array:
        """Return the norms (K, N) of the residuals of what is left out, in the order of the parts."""
        if self._whole.worst is not None:  # most parts have no say in a largest norm: the minimum stays without them
            self._whole.path(weights, rough=True)
        return np.hstack([self._norms(k, weights) for k in range(len(self._rows))])

    def _norms(self, k: int, weights: Array) -> Array:
        model, out = self._whole.model, self._rows[k]
        program = self._kept[k] if self._kept else _without(self._whole, out)
        Z = self._minima(k, program, weights)
        squares = (Z @ model.A[out].T - model.b[out]) ** 2
        _, which = np.unique(model.group[out], return_inverse=True)
        sums = np.zeros((len(weights), which.max() + 1))
        np.add.at(sums.T, which, squares.T)
        return np.sqrt(sums)

    def _minima(self, k: int, program: Program, weights: Array) -> Array:
        """Return the solutions (K, n) without a part; of a penalty with kinks each from the nearest that is known."""
        met = self._met[k]
        if program.faces is None or not (weights > 0).all():
            return np.array([estimate.z for estimate in program.path(weights, rough=True)])
        for weight in sorted({*weights.tolist()}, reverse=True):
            met[weight] = program.path([weight], self._near(k, program, weight), rough=True)[0].z
        return np.array([met[weight] for weight in weights.tolist()])

    def _near(self, k: int, program: Program, weight: float) -> Array | None:
        """Return a point near the solution without a part: between its neighbours, or that without the part before."""
        near = between(self._met[k], weight)
        if k == 0:
            return near
        other = self._met[k - 1][weight]
        faces, split = program.faces, program.split
        if near is None or faces is None or split is None:
            return other
        return min(other, near, key=lambda z: faces.value(split.y(z), weight))


def between(met: Mapping[float, Array], weight: float) -> Array | None:
    """Return where a path (n,) is about at a weight: on a line between near neighbours, or at the nearest one.

    The path of squares with kinks in the penalty is a line in the weight where it meets none.

    >>> import numpy as np
    >>> from rpim_opt.convex.left_out import between
    >>> met = {1.0: np.array([0.0]), 2.0: np.array([4.0]), 90.0: np.array([9.0])}
    >>> [between(met, weight).tolist() for weight in (1.5, 60.0)], between({}, 1.0)
    ([[2.0], [9.0]], None)
    """
    if not met:
        return None
    lower = max((other for other in met if other <= weight), default=0.0)
    upper = min((other for other in met if other >= weight), default=np.inf)
    if lower < upper <= CLOSE * lower:
        share = (weight - lower) / (upper - lower)
        return (1 - share) * met[lower] + share * met[upper]
    return met[min(met, key=lambda other: abs(np.log(other / weight)))]


def solved_again(program: Program, weights: Array, parts: Sequence[np.ndarray]) -> Array:
    """Return the norms (K, N) of the residuals of configurations left out in parts, in the order of the parts.

    Parameters
    ----------
    program
        Whose estimates they are.
    weights
        (K,).
    parts
        Numbers of the configurations that are left out together.
    """
    return Folds(program, parts).norms(weights)


def without_say(program: Program, z: Array) -> np.ndarray:
    """Return which configurations (N,) have no say in an estimate z (n,): of a nondecreasing loss of their norms.

    Those whose norms could all be a little larger at once, and the loss were the same (of a largest norm, all but the
    few that are about as large). Left out, they leave the estimate as it is.
    """
    v = program.norms(z)
    order = np.argsort(v)
    loss = program.loss_of_norms(v)
    none, all_of_them = 0, len(v)
    while all_of_them - none > 1:
        middle = (none + all_of_them) // 2
        raised = v.copy()
        raised[order[:middle]] *= 1 + RAISED
        if abs(program.loss_of_norms(raised) - loss) <= SAME * abs(loss):
            none = middle
        else:
            all_of_them = middle
    silent = np.zeros(len(v), dtype=bool)
    silent[order[:none]] = True
    return silent


def by_their_say(program: Program, weights: Array) -> Array:
    """Return norms (K, N) of left-out residuals, of which at least the medians over the configurations are exact.

    A configuration without say keeps its residual. One that has a say, left out, has a larger residual than all those
    of its kind: where they are fewer than half, their own norms, which are less, are on the right side of the median.
    Where they are more, they are solved for.
    """
    groups = np.unique(program.model.group)
    found = []
    for estimate in program.path(weights):
        norms = program.norms(estimate.z)
        heard = np.flatnonzero(~without_say(program, estimate.z))
        if 2 * len(heard) >= len(norms) - 1:
            norms[heard] = solved_again(program, np.array([estimate.weight]), list(groups[heard][:, None]))[0]
        found.append(norms)
    return np.array(found)


def _rows(group: np.ndarray, parts: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the rows of each of some parts, which have different configurations; ``group`` (m,) is every row's."""
    place = np.full(int(group.max()) + 1, -1)
    for k, part in enumerate(parts):
        place[part] = k
    of_part = place[group]
    order = np.argsort(of_part, kind="stable")
    return np.split(order, np.searchsorted(of_part[order], np.arange(len(parts) + 1)))[1:-1]


def _without(program: Program, rows: np.ndarray) -> Program:
    out = np.zeros(len(program.model.group), dtype=bool)
    out[rows] = True
    return program.without(out)


def _folds(program: Program, parts: Sequence[np.ndarray]) -> Iterator[Program]:
    """Return the program without the rows of each of the parts, one after the other.

    The rows of a squared loss are reduced part by part, once: what is left without a part is the triangles of the parts
    before it over those after it. Rows are added to triangles only, never taken from them, so that nothing is lost to
    cancellation where what is left sees less than the whole.
    """
    model = program.model
    n = model.A.shape[1]
    if not program.on_triangles or len(parts) < 2:
        for part in parts:
            yield _without(program, part)
        return
    rows = np.column_stack([model.A, model.b])
    each = [reduced_rows(rows[part]) for part in parts]
    rest = reduced_rows(np.delete(rows, np.concatenate(parts), axis=0))
    after = [np.zeros((n + 1, n + 1))]
    for triangle in reversed(each[1:]):
        after.append(reduced_rows(triangle, after[-1]))
    before = rest
    for k, triangle in enumerate(each):
        left = reduced_rows(before, after[-1 - k])
        yield program.on(from_triangle(model, left, model.equations - len(parts[k])))
        before = reduced_rows(triangle, before)
