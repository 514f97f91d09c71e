"""Rules that predict configurations held out, all equations of one together: leave-one-out, folds, the paper's two."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.program import Estimate, Program
from rpim_opt.convex.rules.curve import l_curve
from rpim_opt.convex.rules.scores import Rule, Squared, influence, linear_rule, penalty_of
from rpim_opt.convex.rules.selection import Score, Selection, edge, on_squares, searched, weight_grid, with_rows
from rpim_opt.problem.linear import from_triangle, reduced_rows

SOME = 6
"""Configurations that are left out by solving, to see how exact the approximation is."""
EXACTLY = 60
"""Configurations up to which a program with cones is solved without each of them."""
INEXACT = 0.05
"""Relative error of the approximation from which a choice says how to do without it."""
AHEAD = 5
"""Weights that are solved at once, where each takes solving."""
COARSE = 12
"""Weights with which a search for the least error begins, where each takes solving."""
DROPPED = 1e-13
"""Pivots below this belong to what nothing else decides."""
SILENT = 1e-6
"""Part of the largest slope below which a configuration has no influence on an estimate."""
MEMORY = 500_000_000
"""Bytes of equations that are kept for all folds together; of more, a fold is made when it is asked for."""
MANY = 1_000_000
"""Residuals that are in memory together, of many weights."""

Predicted = Callable[[Array], Array]
"""From weights (K,) to the norms (K, N) of the residuals of left-out configurations."""


@on_squares
def leave_one_out(program: Program, exact: bool = False) -> Selection:
    """Choose by leaving every configuration out once and predicting it, all its equations together.

    For a linear estimator in closed form, r_g^- = (1 - H_gg)^-1 r_g with H = A (A'A + w)^-1 A' (Allen 1974; by blocks).
    With constraints or another penalty the same with H = A dz/db, the derivative of the solution (approximate
    leave-one-out; Wang et al. 2018); some configurations are left out by solving, too, and the note says how exact it
    is. With cones and few configurations all are solved; of a loss that is no sum over rows (minimax), those that have
    an influence.

    Parameters
    ----------
    program
        The formulation on a linear model.
    exact
        Whether all are solved anyway.

    Raises
    ------
    InputError
        For a single configuration, or a formulation without penalty.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.leave_one_out)
    >>> f"{result.weight:.2g}", result.selection.interior
    ('0.96', True)
    """
    with_rows(program, "leave_one_out")
    form = program.loss_form
    mixed = form is not None and not form.diagonal  # a square then belongs to no configuration
    if program.closed_form and not mixed:
        note = "smallest error of configurations left out one by one"
        return linear_rule(program, Rule("leave_one_out", _of_squares, note))
    if exact or not _approximates(program):
        return _held_out(program, "leave_one_out", None, exact)
    predicted = _approximately(program)
    weights, score, best = searched(lambda some: _error(program, predicted(some)), weight_grid(program, COARSE))
    interior = 0 < best < len(weights) - 1
    note = f"smallest error of configurations left out one by one, {_how_exact(program, weights[best])}"
    if not interior:
        note = edge(best)
    return Selection(float(weights[best]), "leave_one_out", weights, score, interior, note)


@on_squares
def k_fold(program: Program, folds: int = 10, seed: int = 0, parts: Sequence[np.ndarray] | None = None) -> Selection:
    """Choose by cross-validation in folds that keep configurations whole (Stone 1974); any formulation.

    Parameters
    ----------
    program
        The formulation on a linear model.
    folds
        In how many parts the configurations are divided.
    seed
        Of the division.
    parts
        Instead of that, the numbers (k,) of the configurations that are left out together, each in one part:
        `Dataset.by_session` has those of every session.

    Raises
    ------
    InputError
        For fewer configurations than folds, parts that are no division of them, or a formulation without penalty.

    Examples
    --------
    >>> from functools import partial
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=partial(ro.k_fold, folds=5))
    >>> f"{result.weight:.2g}", result.selection.interior
    ('0.93', True)
    """
    groups = np.unique(with_rows(program, "k_fold").group)
    if parts is not None:
        return _held_out(program, "k_fold", _division(groups, parts))
    if len(groups) < folds:
        raise InputError("selector k_fold", f"{len(groups)} configurations", f"at least {folds}, or fewer folds")
    parts = np.array_split(np.random.default_rng(seed).permutation(groups), folds)
    return _held_out(program, "k_fold", parts)


@on_squares
def two_step(program: Program) -> Selection:
    """Choose by the paper's two steps after a coarse L-curve (section III B and Figs. 7 to 10).

    1. From the corner down, 30 weights over ten decades. The residual norm falls with the weight, so its
       minimum is always the smallest weight; what the paper reads off its Fig. 7 is where the fall ends:
       the first weight from which one more step lowers the residual norm by less than 1 %.
    2. Ten weights within the same order of magnitude, 0.184 to 1.653 times that (the paper's 0.563e-14 to
       5.063e-14 around 3.063e-14), compared by held-out error: every configuration is left out once.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.two_step)
    >>> f"{result.weight:.2g}", result.selection.interior
    ('1.2', True)
    """
    with_rows(program, "two_step")
    start = l_curve(program).weight
    last = 1e-10 * start
    if not program.linear_penalty:
        last = max(last, min(start, weight_grid(program, 2)[0]))
    coarse = np.geomspace(start, last, 30)
    level = _end_of_fall(program, coarse)
    fine = level * np.linspace(0.563 / 3.063, 5.063 / 3.063, 10)
    score = _left_out_error(program)(fine)
    best = int(np.argmin(score))
    interior = 0 < best < len(fine) - 1
    note = "the paper's two steps: residual norm, then held-out error"
    if not interior:
        note += "; the held-out error is smallest at an edge of the ten weights, so a wider search would go on"
    return Selection(float(fine[best]), "two_step", fine, score, interior, note)


def _end_of_fall(program: Program, weights: Array) -> float:
    """Return the first weight (K,), falling, from which the residual norm falls no more; the first if it always does.

    What has no formula is solved no farther than that.
    """
    some = len(weights) if program.closed_form else AHEAD
    residual = np.empty(0)
    while len(residual) < len(weights):
        more = program.path(weights[len(residual) : len(residual) + some])
        residual = np.append(residual, np.sqrt([estimate.loss for estimate in more]))
        flat = residual[1:] >= 0.99 * residual[:-1]
        if flat.any():
            return float(weights[np.argmax(flat)])
    return float(weights[0])


def _division(groups: np.ndarray, parts: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return parts that have each of some configurations once, without those that the program does not have."""
    present = [np.intersect1d(part, groups) for part in parts]
    present = [part for part in present if len(part)]
    if len(present) < 2 or not np.array_equal(np.sort(np.concatenate(present)), groups):
        found = f"{len(present)} that have {sum(map(len, present))} of {len(groups)} configurations"
        raise InputError("selector k_fold, parts", found, "two or more, with every configuration in one of them")
    return present


def _held_out(program: Program, name: str, parts: Sequence[np.ndarray] | None, exact: bool = False) -> Selection:
    if program.closed_form:
        weights = weight_grid(program)
        score = held_out_error(program, weights, parts)
        best = int(np.argmin(score))
    else:
        grid = weight_grid(program, COARSE)
        error = _left_out_error(program) if parts is None and not exact else _error_of_folds(program, parts)
        weights, score, best = searched(error, grid)
    interior = 0 < best < len(weights) - 1
    note = "smallest error of configurations held out"
    if not interior:
        note = edge(best)
    return Selection(float(weights[best]), name, weights, score, interior, note)


# --- errors of what is left out --------------------------------------------------------------------------------


def held_out_error(program: Program, weights: Array, parts: Sequence[np.ndarray] | None = None) -> Array:
    """Root mean square of the whitened residual of held-out configurations, predicted from all the others.

    ``parts`` are the configurations that are held out together; each one alone by default. A loss that is no square
    judges the median of the configurations' norms instead: an outlier held out is not an error of the prediction.
    """
    return _error_of_folds(program, parts)(weights)


def _left_out_error(program: Program) -> Score:
    """Return what gives `held_out_error` of configurations left out one by one, with little solving."""
    if program.closed_form and program.squared_rows:
        squares = _of_squares(Squared(program.squared, penalty_of(program), program.ridge))
        return lambda weights: np.sqrt(squares(weights) / len(program.model.b))
    if _approximates(program):
        predicted = _approximately(program)
        return lambda weights: _error(program, predicted(weights))
    if program.loss_form is None and not np.isfinite(program.formulation.largest):
        return lambda weights: _error(program, _of_influential(program, weights))
    return _error_of_folds(program, None)


def _error_of_folds(program: Program, parts: Sequence[np.ndarray] | None) -> Score:
    """Return what gives `held_out_error`."""
    groups = np.unique(program.model.group)
    if len(groups) < 2:
        raise InputError("data", "one configuration", "two or more to hold one out")
    folds = Folds(program, list(groups[:, None]) if parts is None else parts)
    return lambda weights: _error(program, folds.norms(weights))


def _error(program: Program, norms: Array) -> Array:
    """Return what left-out norms (K, N) amount to: (K,)."""
    if program.loss_form is None:
        return np.median(norms, axis=1)
    return np.sqrt(np.sum(norms**2, axis=1) / len(program.model.b))


class Rows(NamedTuple):
    """Rows of configurations with the same number of equations, (G, k): places in the residual."""

    places: np.ndarray
    configurations: np.ndarray


def by_size(group: np.ndarray) -> list[Rows]:
    """Return the rows of configurations, those of a size together; ``group`` (m,) numbers the configurations."""
    which, count = np.unique(group, return_inverse=True, return_counts=True)[1:]
    order = np.argsort(which, kind="stable")
    first = np.cumsum(count) - count
    found = []
    for size in np.unique(count):
        configurations = np.flatnonzero(count == size)
        found.append(Rows(order[first[configurations][:, None] + np.arange(size)], configurations))
    return found


def _solved(M: Array, v: Array) -> Array:
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


def _of_squares(squared: Squared) -> Score:
    """Return the sums of squares (K,) of all left-out residuals of an estimator with influence Q diag(f) Q', by weight.

    With f = s^2 / (s^2 + weight) and residuals r of all, r_g^- = (1 - Q_g diag(f) Q_g')^-1 r_g.
    """
    Q, s2, target = influence(squared)
    projected = Q.T @ target
    parts = []
    for rows in by_size(squared.model.group):
        each, k = Q[rows.places], rows.places.shape[1]
        parts.append((rows.places, {(i, j): each[:, i] * each[:, j] for i in range(k) for j in range(i, k)}))

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
            left = _solved(M, residual[places.T])
            total += np.einsum("igw,igw->w", left, left)
        return total

    few = max(1, MANY // len(target))
    return lambda weights: np.concatenate([some(weights[k : k + few]) for k in range(0, len(weights), few)])


def _approximates(program: Program) -> bool:
    """Whether the derivative of the solution tells what leaving a configuration out changes.

    Cones bend the solution's path: with few configurations, all of them are solved without.
    """
    if program.loss_form is None or not program.loss_form.diagonal or program.closed_form:
        return False
    return program.structure.canonical.polyhedral or len(np.unique(program.model.group)) > EXACTLY


def _approximately(program: Program) -> Predicted:
    """Return what predicts every configuration by the derivative of the solution."""
    model = program.squared
    rows = by_size(model.group)

    def norms(estimate: Estimate) -> Array:
        D, U = program.derivative(estimate)
        r = model.A @ estimate.z - model.b
        found = np.zeros(sum(len(each.configurations) for each in rows))
        for places, configurations in rows:
            A = model.A[places]
            hat = np.einsum("gin,nr,gjr->ijg", A, D, U[places], optimize=True)
            M = np.eye(places.shape[1])[:, :, None] - (hat + hat.transpose(1, 0, 2)) / 2
            found[configurations] = np.linalg.norm(_solved(M, r[places.T]), axis=0)
        return found

    return lambda weights: np.array([norms(estimate) for estimate in program.path(weights)])


def _how_exact(program: Program, weight: float) -> str:
    """Say how exact the approximation is, from some configurations that are solved without."""
    configurations = np.unique(program.model.group)
    norms = _approximately(program)(np.array([weight]))[0]
    order = np.argsort(norms)  # from the best predicted to the worst
    some = order[np.linspace(0, len(order) - 1, min(SOME, len(order))).astype(int)]
    there = Folds(program, [configurations[[k]] for k in some]).norms(np.array([weight]))[0]
    off = float(np.linalg.norm(norms[some] - there) / max(np.linalg.norm(there), np.finfo(float).tiny))
    text = f"approximately ({100 * off:.2g} % off in {len(some)} that were solved)"
    if off > INEXACT:
        text += "; exact=True solves all"
    return text


def _of_influential(program: Program, weights: Array) -> Array:
    """Return norms (K, N) of left-out residuals: those of configurations without influence are what they are."""
    groups = np.unique(program.model.group)
    found = []
    for weight in weights:
        estimate, slope = program.solve_with_slope(float(weight))
        norms = program.norms(estimate.z)
        if slope is None:
            heard = np.arange(len(groups))
        else:
            size = program.model.norms(slope)
            heard = np.flatnonzero(size > SILENT * size.max(initial=0.0))
        norms[heard] = Folds(program, list(groups[heard][:, None])).norms(np.array([weight]))[0]
        found.append(norms)
    return np.array(found)


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
        if program.on_triangles or len(parts) * program.model.A.nbytes <= MEMORY:
            self._kept = list(_folds(program, self._rows))

    def norms(self, weights: Array) -> Array:
        """Return the norms (K, N) of the residuals of what is left out, in the order of the parts."""
        return np.hstack([self._norms(k, weights) for k in range(len(self._rows))])

    def _norms(self, k: int, weights: Array) -> Array:
        model, out = self._whole.model, self._rows[k]
        program = self._kept[k] if self._kept else _without(self._whole, out)
        Z = np.array([estimate.z for estimate in program.path(weights)])
        squares = (Z @ model.A[out].T - model.b[out]) ** 2
        _, which = np.unique(model.group[out], return_inverse=True)
        sums = np.zeros((len(weights), which.max() + 1))
        np.add.at(sums.T, which, squares.T)
        return np.sqrt(sums)


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
        yield program.apart(from_triangle(model, left, model.equations - len(parts[k])))
        before = reduced_rows(triangle, before)
