"""Selectors for a vector of weights: likelihood, folds, and the distance to the L-hypersurface's origin."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.late import optimize
from rpim_opt.convex.formulation import tikhonov
from rpim_opt.convex.groups import Grouped, minimum
from rpim_opt.convex.program import pose
from rpim_opt.convex.quadratic import ridge
from rpim_opt.convex.select_curve import l_curve
from rpim_opt.convex.select_held_out import k_fold
from rpim_opt.convex.select_scores import reml
from rpim_opt.convex.selection import Selection, grid_of

Objective = Callable[[Array], tuple[float, Array]]
"""From logarithms of weights (G,) to a score and its gradient (G,)."""
GroupSelector = Callable[[Grouped], Selection]
EXACT = 1e-15
"""Accuracy of a likelihood: its logarithm is large beside what decides."""
EDGE = 1e-3
"""Logarithms this close to a bound are at it."""
APART = np.log(100.0)
"""By how much a start leaves the best common weight in one group."""
BEYOND = 1e6
"""Factor by which the weight of a group may leave the range in which a single one changes the estimate."""
COMMON = 41
"""Common weights that are tried first, for the valleys to start from."""
AROUND = 1e2
"""Factors from the corner of the L-curve within which that of several weights is sought: rules of one weight differ
by no more, and further out a deviation's logarithm falls without end."""
SIDES = ("the data want no penalty", "the data want no deviation")
"""What it means that a group is at the lower or at the upper bound."""
FACTORS = np.geomspace(1e-3, 1e3, 61)
"""By which all weights together are multiplied, to show how sharp a choice is."""


def reml_groups(grouped: Grouped) -> Selection:
    """Choose the most likely weights: restricted maximum likelihood with a variance a group (Patterson, Thompson 1971).

    With the noise level profiled out and frames as fixed effects, as `reml` has them; H = A'A + diag(w), and Q the
    least objective::

        m ln Q + ln det H - sum_j ln w_j,      gradient    m w_g |z_g|^2 / Q + w_g tr_g(H^-1) - n_g

    Minimized from several starts. The optimum where all is noise counts only if there is no other, and then the
    weights are 1.

    Parameters
    ----------
    grouped
        The equations, and which parameters share a weight.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> from rpim_opt.convex.groups import Grouped
    >>> from rpim_opt.convex.select_groups import reml_groups
    >>> model = ro.load("position").problem.linearize(np.zeros(34))
    >>> alone = reml_groups(Grouped.of(model, {"*": None})).groups["*"]
    >>> single = ro.reml(ro.convex.pose(ro.tikhonov, model)).weight
    >>> bool(abs(np.log(alone / single)) < 1e-5)
    True
    """
    if grouped.model.constrained:
        note = "points on a plane or sphere do not tell it: declared noise and scales are taken at their word"
        return _answer(grouped, "reml", np.zeros(len(grouped.names)), np.zeros(len(FACTORS)), False, note)
    objective = restricted_likelihood(grouped)
    bounds = _bounds(grouped)
    t, inside = _least(objective, bounds, len(grouped.names), EXACT)
    if (t >= bounds[1] - EDGE).all():
        note = "the data do not tell how large deviations are: declared noise and scales are taken at their word"
        t = np.zeros_like(t)
    else:
        note = _noted("largest restricted likelihood", grouped, t, bounds)
    return _answer(grouped, "reml", t, _profile(objective, t), inside, note)


def restricted_likelihood(grouped: Grouped) -> Objective:
    """Return -2 ln(restricted likelihood) of logarithms of weights (G,), up to a constant, with its gradient."""
    reduced = grouped.robot()
    rest = reduced.grouped
    counts = rest.sums(rest.own)
    tiny = np.finfo(float).tiny

    def objective(t: Array) -> tuple[float, Array]:
        weights = rest.penalty(t)
        z, inverse = minimum(reduced.R, reduced.r, weights, rest.centre)
        away = weights * (z - rest.centre) ** 2
        Q = max(float(np.sum((reduced.R @ z - reduced.r) ** 2) + np.sum(away)), tiny)
        value = reduced.equations * np.log(Q) - np.linalg.slogdet(_unit(inverse, weights))[1]
        slope = reduced.equations * rest.sums(away) / Q + rest.sums(weights * np.diag(inverse)) - counts
        return float(value), slope

    return objective


def _unit(inverse: Array, weights: Array) -> Array:
    """Return W^1/2 H^-1 W^1/2, whose determinant is that of the prior's part in the likelihood."""
    root = np.sqrt(weights)
    return inverse * np.outer(root, root)


def k_fold_groups(grouped: Grouped, folds: int = 10, seed: int = 0) -> Selection:
    """Choose by cross-validation in folds that keep configurations whole (Stone 1974).

    The squared residuals of configurations held out, predicted from all others; minimized from several starts.

    Parameters
    ----------
    grouped
        The equations, and which parameters share a weight.
    folds, seed
        Into how many parts the configurations are divided, and of the division.

    Raises
    ------
    InputError
        For fewer configurations than folds, and where only the triangle of the equations is kept.
    """
    model = grouped.model
    if model.stands_for is not None:
        found = f"{model.equations} equations of which only the triangle is kept"
        raise InputError("selector k_fold", found, "reml, l_curve, or a number")
    groups = np.unique(model.group)
    if len(groups) < folds:
        raise InputError("selector k_fold", f"{len(groups)} configurations", f"at least {folds}, or fewer folds")
    parts = np.array_split(np.random.default_rng(seed).permutation(groups), folds)
    objective = held_out(grouped, [np.isin(model.group, part) for part in parts])
    bounds = _bounds(grouped)
    t, inside = _least(objective, bounds, len(grouped.names))
    note = _noted("smallest error of configurations held out", grouped, t, bounds)
    return _answer(grouped, "k_fold", t, _profile(objective, t), inside, note)


def held_out(grouped: Grouped, out: list[np.ndarray]) -> Objective:
    """Return the sum of squared residuals of rows held out, of logarithms of weights (G,), with its gradient."""
    model = grouped.model
    parts = [(_without(grouped, rows), model.A[rows], model.b[rows]) for rows in out]

    def objective(t: Array) -> tuple[float, Array]:
        value, slope = 0.0, np.zeros(len(t))
        for others, A, b in parts:
            found = others.at(t)
            residual = A @ found.z - b
            value += float(residual @ residual)
            slope += 2 * (residual @ A) @ others.slopes(t, found)
        return value, slope

    return objective


def _without(grouped: Grouped, rows: np.ndarray) -> Grouped:
    return replace(grouped, model=grouped.model.scaled(np.where(rows, 0.0, 1.0)))


def minimum_distance(grouped: Grouped) -> Selection:
    """Choose the point of the L-hypersurface that is nearest to its origin (Belge, Kilmer and Miller 2002).

    The L-curve of several weights is a surface over the logarithms of residual and deviations,
    (ln |A z - b|^2, ln |z_1|^2, ..., ln |z_G|^2). Its corner is taken for the point nearest to where all of them are
    least: the residual at small weights, the deviations at large ones (Inverse Problems 18:1161), a hundredth and a
    hundredfold of the weight at the corner of the L-curve of one. It holds back more than `reml_groups` does.

    Parameters
    ----------
    grouped
        The equations, and which parameters share a weight.
    """
    centre = np.log(l_curve(pose(tikhonov, grouped.model)).weight)
    low, high = centre - np.log(AROUND), centre + np.log(AROUND)
    count = len(grouped.names)
    least = grouped.at(np.full(count, low))
    most = grouped.at(np.full(count, high))
    objective = distance(grouped, np.log(least.misfit), np.log(most.sizes))
    t, inside = _least(objective, (low, high), count)
    note = _noted(
        "nearest to the origin of the L-hypersurface",
        grouped,
        t,
        (low, high),
        ("at the least weight", "at the largest weight"),
    )
    return _answer(grouped, "l_curve", t, _profile(objective, t), inside, note)


def distance(grouped: Grouped, misfit: float, sizes: Array) -> Objective:
    """Return the squared distance to (misfit, sizes (G,)), of logarithms of weights (G,), with its gradient."""
    R, r = grouped.triangle
    tiny = np.finfo(float).tiny

    def objective(t: Array) -> tuple[float, Array]:
        found = grouped.at(t)
        slopes = grouped.slopes(t, found)
        away = np.log(np.maximum(found.sizes, tiny)) - sizes
        up = np.log(max(found.misfit, tiny)) - misfit
        d_misfit = 2 * (R @ found.z - r) @ R @ slopes / max(found.misfit, tiny)
        pull = 2 * (grouped.own * (found.z - grouped.centre))[:, None] * slopes
        d_sizes = np.array([grouped.sums(column) for column in pull.T]).T / np.maximum(found.sizes, tiny)[:, None]
        return float(up**2 + away @ away), 2 * up * d_misfit + 2 * away @ d_sizes

    return objective


RULES: dict[str, Callable[..., Selection]] = {
    "reml": reml_groups,
    "k_fold": k_fold_groups,
    "l_curve": minimum_distance,
    "minimum_distance": minimum_distance,
}
"""Selectors for a vector of weights, by name; those of a single weight stand for them."""
_INSTEAD: dict[Any, str] = {reml: "reml", k_fold: "k_fold", l_curve: "l_curve"}


def rule_of(weights: Mapping[str, Any]) -> GroupSelector | None:
    """Return the selector that a mapping of weights asks for; None where all are numbers.

    Raises
    ------
    InputError
        For two different ones, and for what serves a single weight only.
    """
    asked = [
        each for each in weights.values() if isinstance(each, bool) or not isinstance(each, int | float | np.number)
    ]
    if not asked:
        return None
    first = asked[0]
    if any(each is not first and each != first for each in asked):
        raise InputError("weight", "different selectors", "one for all groups that are to be chosen, and numbers")
    function, options = first, {}
    if isinstance(first, partial):
        function, options = first.func, first.keywords
    name = str(function)
    if callable(function):
        name = _INSTEAD.get(function, "")
    if name not in RULES:
        found = getattr(function, "__name__", repr(function))
        raise InputError("weight", f"'{found}' for groups", ", ".join(RULES) + ", or a number")
    return partial(RULES[name], **options)


# --- minimization ----------------------------------------------------------------------------------------------


def _bounds(grouped: Grouped) -> tuple[float, float]:
    """Return the logarithms of weights beyond which the data say nothing more of any group."""
    grid = grid_of(ridge(grouped.model, None), 2)
    return float(np.log(grid[0] / BEYOND)), float(np.log(grid[-1] * BEYOND))


def _least(
    objective: Objective, bounds: tuple[float, float], count: int, accuracy: float = 1e-10
) -> tuple[Array, bool]:
    """Return the best minimum (G,) from several starts, and whether it lies inside the bounds.

    ``accuracy`` is relative, of the score. A minimum at a bound in every group (no penalty at all, or no deviation)
    counts only if there is no other.
    """
    low, high = bounds
    common = np.linspace(low, high, COMMON)
    score = np.array([objective(np.full(count, t))[0] for t in common])
    valleys = [k for k in range(1, COMMON - 1) if score[k] <= min(score[k - 1], score[k + 1])]
    lowest = int(np.argmin(score))
    best = min(valleys or [lowest], key=lambda k: score[k])
    starts = [np.full(count, common[k]) for k in {lowest, *valleys}]
    if count > 1:
        sides = [common[best] + sign * APART * one for one in np.eye(count) for sign in (-1, 1)]
        starts += [np.clip(side, low, high) for side in sides]
    found = [_polished(objective, start, bounds, accuracy) for start in starts]
    t = min(found, key=lambda each: (_at_edges(each[1], bounds).all(), each[0]))[1]
    return t, not bool(_at_edges(t, bounds).any())


def _polished(objective: Objective, start: Array, bounds: tuple[float, float], accuracy: float) -> tuple[float, Array]:
    """Return the minimum next to a start, its value before it."""
    options = {"ftol": accuracy, "gtol": 1e-9, "maxiter": 500}
    found: Any = optimize.minimize(
        objective, start, jac=True, method="L-BFGS-B", bounds=[bounds] * len(start), options=options
    )
    return float(found.fun), np.asarray(found.x)


def _at_edges(t: Array, bounds: tuple[float, float]) -> np.ndarray:
    low, high = bounds
    return (t <= low + EDGE) | (t >= high - EDGE)


def _profile(objective: Objective, t: Array) -> Array:
    """Return the score with all weights multiplied by the same factors."""
    return np.array([objective(t + np.log(factor))[0] for factor in FACTORS])


def _noted(note: str, grouped: Grouped, t: Array, bounds: tuple[float, float], sides: Sequence[str] = SIDES) -> str:
    """Return what a choice rests on, with the groups that are at a bound."""
    low, high = bounds
    for which, at in zip(sides, (t <= low + EDGE, t >= high - EDGE), strict=True):
        names = [name for name, is_there in zip(grouped.names, at, strict=True) if is_there]
        if names:
            note += f"; {which} of {', '.join(names)}"
    return note


def _answer(grouped: Grouped, name: str, t: Array, score: Array, inside: bool, note: str) -> Selection:
    """Return the choice: the program has weight 1, with the groups' weights in its scales."""
    chosen = dict(zip(grouped.names, np.exp(t).tolist(), strict=True))
    groups = {**chosen, **grouped.told}
    return Selection(1.0, f"{name} by group", FACTORS, score, inside, note, groups)
