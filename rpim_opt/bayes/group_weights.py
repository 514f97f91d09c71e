"""Regularization weights of groups of parameters: restricted likelihood, cross-validation, L-hypersurface."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
import scipy
from scipy.linalg import solve_triangular

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.units import fits
from rpim_opt.convex.formulation import tikhonov
from rpim_opt.convex.program import pose
from rpim_opt.convex.quadratic import ridge
from rpim_opt.convex.rules.curve import l_curve
from rpim_opt.convex.rules.folds import k_fold
from rpim_opt.convex.rules.scores import reml
from rpim_opt.convex.rules.selection import Selection, grid_of
from rpim_opt.problem.linear import RANK_TOLERANCE, LinearModel
from rpim_opt.robot.parameter_names import own_name
from rpim_opt.robot.parameters import Parameters

OTHERS = "others"
"""What the parameters are called that no group names: their weight is 1."""
Objective = Callable[[Array], tuple[float, Array]]
"""From logarithms of weights (G,) to a score and its gradient (G,)."""
EXACT = 1e-15
"""Relative accuracy of a likelihood: its logarithm is large beside what decides."""
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
SIDES = ("the data support no penalty", "the data support no deviation")
"""What it means that a group is at the lower or at the upper bound."""
FACTORS = np.geomspace(1e-3, 1e3, 61)
"""By which all weights together are multiplied, to show how sharp a choice is."""


class Minimum(NamedTuple):
    """z (n,) and the inverse of half the Hessian at some weights, the misfit |A z - b|^2, |z_g|^2 of groups (G,)."""

    z: Array
    inverse: Array
    misfit: float
    sizes: Array


@dataclass(frozen=True, eq=False)
class Grouped:
    """Minimize |A z - b|^2 + sum_j w_j own_j (z_j - centre_j)^2 + |rows z - values|^2, with a weight w_g a group.

    The equations of ``model`` are in units of the scales without weights; ``own`` (n,) is 0 for parameters that only
    statements ``rows`` (k, n), ``values`` (k,) hold. The weights of the G groups ``names`` are to be chosen: ``member``
    (n,) is the number of a parameter's group, -1 where its weight is ``given`` (n,), ``told`` by its key.
    """

    model: LinearModel
    own: Array
    centre: Array
    rows: Array
    values: Array
    names: tuple[str, ...]
    member: np.ndarray
    given: Array
    told: Mapping[str, float]

    @classmethod
    def of(cls, model: LinearModel, weights: Mapping[str, Any]) -> Grouped:
        """Return the penalty |z|^2 in groups: a number is a given weight, anything else is to be chosen."""
        n = len(model.parameters)
        found = members(model.parameters, weights)
        return cls(model, np.ones(n), np.zeros(n), np.zeros((0, n)), np.zeros(0), *found)

    def penalty(self, t: Array) -> Array:
        """Return the weights (n,) of the parameters at logarithms t (G,) of those of the groups."""
        chosen = self.member >= 0
        weights = self.given.copy()
        weights[chosen] = np.exp(t)[self.member[chosen]]
        return weights * self.own

    @cached_property
    def triangle(self) -> tuple[Array, Array]:
        """Rows R (k, n) and r (k,) with |R z - r|^2 the misfit of data and statements."""
        T = self.model.triangle
        return np.vstack([T[:, :-1], self.rows]), np.append(T[:, -1], self.values)

    def at(self, t: Array) -> Minimum:
        """Return the minimum at logarithms t (G,) of the weights."""
        R, r = self.triangle
        z, inverse = minimum(R, r, self.penalty(t), self.centre)
        return Minimum(z, inverse, float(np.sum((R @ z - r) ** 2)), self.sums(self.own * (z - self.centre) ** 2))

    def sums(self, each: Array) -> Array:
        """Return the sums (G,) over the groups of numbers (n,)."""
        chosen = self.member >= 0
        sums = np.bincount(self.member[chosen], each[chosen], minlength=len(self.names))
        return sums.astype(float)  # whole numbers where there is nothing to add

    def slopes(self, t: Array, minimum: Minimum) -> Array:
        """Return dz / dt (n, G) at a minimum."""
        pull = self.penalty(t) * (minimum.z - self.centre)
        columns = pull[:, None] * (self.member[:, None] == np.arange(len(self.names)))
        return -minimum.inverse @ columns

    def robot(self) -> tuple[Grouped, Array, Array, int]:
        """Return the penalty of the robot alone, |R z - r|^2 of its rows R (k, n'), and how many equations these are.

        Frames are fixed effects unless a group is theirs alone, as is what has no penalty: how far a tripod stands says
        nothing about a gear. The rows are projected off their columns.
        """
        frames = self.model.parameters.placed
        alone = [g for g in range(len(self.names)) if frames[self.member == g].all()]
        free = (self.own == 0) | (frames & ~np.isin(self.member, alone))
        R, r = self.triangle
        columns = R[:, free]
        norms = np.linalg.norm(columns, axis=0)
        U, s, _ = np.linalg.svd(columns / np.where(norms > 0, norms, 1.0), full_matrices=False)
        U = U[:, s > RANK_TOLERANCE * np.max(s, initial=0.0)]
        kept = np.flatnonzero(~free)
        parts = {key: getattr(self, key)[kept] for key in ("own", "centre", "member", "given")}
        left = R[:, kept] - U @ (U.T @ R[:, kept])
        equations = self.model.equations + len(self.values) - U.shape[1]
        return replace(self, **parts), left, r - U @ (U.T @ r), equations


def minimum(R: Array, r: Array, penalty: Array, centre: Array) -> tuple[Array, Array]:
    """Return the minimum z (n,) of |R z - r|^2 + sum penalty_j (z_j - centre_j)^2, and half its Hessian's inverse.

    By QR of the rows stacked, columns of one length first: misfit and weights may differ by many orders.
    """
    root = np.sqrt(penalty)
    stacked = np.vstack([R, np.diag(root)])
    size = np.linalg.norm(stacked, axis=0)
    size[size == 0] = 1.0
    Q, T = np.linalg.qr(stacked / size)
    if np.min(np.abs(np.diag(T)), initial=1.0) <= RANK_TOLERANCE:  # neither data nor penalty decide a direction
        inverse = np.linalg.pinv(T, rcond=RANK_TOLERANCE)
    else:
        inverse = solve_triangular(T, np.eye(len(size)))
    scaled = inverse / size[:, None]
    return scaled @ (Q.T @ np.append(r, root * centre)), scaled @ scaled.T


# --- which parameters a group has ------------------------------------------------------------------------------


class Members(NamedTuple):
    """Names of the groups to choose, every parameter's group (n,), given weights (n,), and those by their keys."""

    names: tuple[str, ...]
    member: np.ndarray
    given: Array
    told: dict[str, float]


def members(free: Parameters, weights: Mapping[str, Any]) -> Members:
    """Return which group every identified parameter is in, and which weights are given.

    Keys are patterns, names, or kinds (``"alpha"``, ``"tool"``, ``"length"``), several with a space between, and
    ``"by_kind"`` and ``"by_link"`` stand for a group each; a number is a given weight. InputError for a key that names
    nothing, a parameter in two groups, and weights that are not above zero.
    """
    if not weights:
        raise InputError("weight", "an empty mapping", "patterns of parameters with their weights")
    every = {"by_kind": _kind, "by_link": _link}
    written: dict[str, Any] = {}
    for key, weight in weights.items():
        keys = dict.fromkeys(map(every[key], free.names)) if key in every else [key]
        written |= dict.fromkeys(keys, weight)
    member = np.full(len(free), -1)
    given = np.ones(len(free))
    taken: dict[int, str] = {}
    names: list[str] = []
    told: dict[str, float] = {}
    for key, weight in written.items():
        places = _places(key, free)
        for i in places:
            if i in taken:
                found = f"'{free.names[i]}' in '{taken[i]}' and in '{key}'"
                raise InputError("weight", found, "every parameter in one group")
            taken[i] = key
        if not _is_number(weight):
            member[places] = len(names)
            names.append(key)
        elif np.isfinite(weight) and weight > 0:
            given[places] = told[key] = float(weight)
        else:
            raise InputError("weight", f"{weight} for '{key}'", "a finite number above zero, or a selector")
    if len(taken) < len(free):
        told[OTHERS] = 1.0
    return Members(tuple(names), member, given, told)


def _is_number(weight: Any) -> bool:
    return isinstance(weight, int | float | np.number) and not isinstance(weight, bool)


def _kind(name: str) -> str:
    name = own_name(name)
    if name[-1].isdigit():
        return name.rstrip("0123456789")
    return name.split("_")[0]


def _link(name: str) -> str:
    name = own_name(name)
    stem = name.rstrip("0123456789")
    if stem == name:
        return name.split("_")[0]
    return f"link{name.removeprefix(stem)}"


def _places(key: Any, free: Parameters) -> list[int]:
    """Return which parameters a key names."""
    if not isinstance(key, str) or not key.split():
        raise InputError("weight", f"key {key!r}", "patterns of parameters, 'a? d?'")
    places: list[int] = []
    kinds = [(_kind(name), _link(name), group) for name, group in zip(free.names, free.groups, strict=True)]
    for token in key.split():
        met = [i for i, name in enumerate(free.names) if fits(name, token) or token in kinds[i]]
        if not met:
            known = [*dict.fromkeys(map(_kind, free.names)), *free.names]
            raise InputError("weight", f"'{token}'", "kinds, names or patterns: " + choices(token, known))
        places += [i for i in met if i not in places]
    return places


# --- rules -----------------------------------------------------------------------------------------------------


def reml_groups(grouped: Grouped) -> Selection:
    """Choose the most likely weights: restricted maximum likelihood with a variance a group (Patterson, Thompson 1971).

    With the noise level profiled out and frames as fixed effects, as `reml` has them. Minimized from several starts.
    The optimum where all is noise counts only if there is no other, and then the weights are 1.
    """
    if grouped.model.constrained:
        note = "points on a plane or sphere do not determine it: stated noise and scales are used"
        weights = {**dict.fromkeys(grouped.names, 1.0), **grouped.told}
        return Selection(1.0, "reml by group", FACTORS, np.zeros(len(FACTORS)), False, note, weights)
    objective = restricted_likelihood(grouped)
    bounds = _bounds(grouped)
    t = _least(objective, bounds, len(grouped.names), EXACT)
    if (t < bounds[1] - EDGE).any():
        return _selection(grouped, "reml", objective, t, bounds, "largest restricted likelihood")
    note = "the data do not determine the scale of the deviations: stated noise and scales are used"
    return replace(_selection(grouped, "reml", objective, np.zeros_like(t), bounds, note), interior=False)


def restricted_likelihood(grouped: Grouped) -> Objective:
    """Return -2 ln(restricted likelihood) of logarithms of weights (G,), up to a constant, with its gradient.

    H = A'A + diag(w), and Q the least objective::

        m ln Q + ln det H - sum_j ln w_j,      gradient    m w_g |z_g|^2 / Q + w_g tr_g(H^-1) - n_g
    """
    rest, R, r, equations = grouped.robot()
    counts = rest.sums(rest.own)

    def objective(t: Array) -> tuple[float, Array]:
        weights = rest.penalty(t)
        z, inverse = minimum(R, r, weights, rest.centre)
        away = weights * (z - rest.centre) ** 2
        Q = max(float(np.sum((R @ z - r) ** 2) + np.sum(away)), np.finfo(float).tiny)
        root = np.sqrt(weights)
        value = equations * np.log(Q) - np.linalg.slogdet(inverse * np.outer(root, root))[1]
        return float(value), equations * rest.sums(away) / Q + rest.sums(weights * np.diag(inverse)) - counts

    return objective


def k_fold_groups(grouped: Grouped, folds: int = 10, seed: int = 0) -> Selection:
    """Choose by cross-validation in folds that keep configurations whole (Stone 1974).

    The squared residuals of configurations held out, predicted from all others; minimized from several starts.
    InputError for fewer configurations than folds, and where only the triangle of the equations is kept.
    """
    model = grouped.model
    if model.stands_for is not None:
        found = f"{model.equations} equations in blocks, of which only the QR factor is kept"
        raise InputError("selector k_fold", found, "reml, l_curve, or a number")
    groups = np.unique(model.group)
    if len(groups) < folds:
        raise InputError("selector k_fold", f"{len(groups)} configurations", f"at least {folds}, or fewer folds")
    parts = np.array_split(np.random.default_rng(seed).permutation(groups), folds)
    objective = held_out(grouped, [np.isin(model.group, part) for part in parts])
    bounds = _bounds(grouped)
    t = _least(objective, bounds, len(grouped.names))
    return _selection(grouped, "k_fold", objective, t, bounds, "smallest error of configurations held out")


def held_out(grouped: Grouped, out: list[np.ndarray]) -> Objective:
    """Return the sum of squared residuals of rows held out, of logarithms of weights (G,), with its gradient."""
    model = grouped.model
    parts = [
        (replace(grouped, model=model.scaled(np.where(rows, 0.0, 1.0))), model.A[rows], model.b[rows]) for rows in out
    ]

    def objective(t: Array) -> tuple[float, Array]:
        value, slope = 0.0, np.zeros(len(t))
        for others, A, b in parts:
            found = others.at(t)
            residual = A @ found.z - b
            value += float(residual @ residual)
            slope += 2 * (residual @ A) @ others.slopes(t, found)
        return value, slope

    return objective


def minimum_distance(grouped: Grouped) -> Selection:
    """Choose the point of the L-hypersurface that is nearest to its origin (Belge, Kilmer and Miller 2002).

    The L-curve of several weights is a surface over the logarithms of residual and deviations,
    (ln |A z - b|^2, ln |z_1|^2, ..., ln |z_G|^2). Its corner is taken for the point nearest to where all of them are
    least: the residual at small weights, the deviations at large ones (Inverse Problems 18:1161), a hundredth and a
    hundredfold of the weight at the corner of the L-curve of one. It penalizes more than `reml_groups` does.
    """
    centre = np.log(l_curve(pose(tikhonov, grouped.model)).weight)
    bounds = (centre - np.log(AROUND), centre + np.log(AROUND))
    least, most = (grouped.at(np.full(len(grouped.names), bound)) for bound in bounds)
    objective = distance(grouped, np.log(least.misfit), np.log(most.sizes))
    t = _least(objective, bounds, len(grouped.names))
    sides = ("at the least weight", "at the largest weight")
    return _selection(grouped, "l_curve", objective, t, bounds, "nearest to the origin of the L-hypersurface", sides)


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


GroupSelector = Callable[[Grouped], Selection]
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

    InputError for two different ones, and for what serves a single weight only.
    """
    asked = [each for each in weights.values() if not _is_number(each)]
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


# --- minimization -----------------------------------------------------------------------------------------------


def _bounds(grouped: Grouped) -> tuple[float, float]:
    """Return the logarithms of weights beyond which the data say nothing more of any group."""
    grid = grid_of(ridge(grouped.model, None), 2)
    return float(np.log(grid[0] / BEYOND)), float(np.log(grid[-1] * BEYOND))


def _least(objective: Objective, bounds: tuple[float, float], count: int, accuracy: float = 1e-10) -> Array:
    """Return the best minimum (G,) from several starts; the accuracy is relative, of the score.

    A minimum at a bound in every group (no penalty at all, or no deviation) counts only if there is no other.
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
    options = {"ftol": accuracy, "gtol": 1e-9, "maxiter": 500}
    found = [
        scipy.optimize.minimize(objective, start, jac=True, method="L-BFGS-B", bounds=[bounds] * count, options=options)
        for start in starts
    ]
    least = min(found, key=lambda each: (bool(_at_edges(each.x, bounds).all()), float(each.fun)))
    return np.asarray(least.x, dtype=float)


def _at_edges(t: Array, bounds: tuple[float, float]) -> np.ndarray:
    return (t <= bounds[0] + EDGE) | (t >= bounds[1] - EDGE)


def _selection(
    grouped: Grouped,
    name: str,
    objective: Objective,
    t: Array,
    bounds: tuple[float, float],
    note: str,
    sides: Sequence[str] = SIDES,
) -> Selection:
    """Return the choice: the program has weight 1, with the groups' weights in its scales."""
    low, high = bounds
    for which, at in zip(sides, (t <= low + EDGE, t >= high - EDGE), strict=True):
        names = [group for group, is_there in zip(grouped.names, at, strict=True) if is_there]
        if names:
            note += f"; {which} of {', '.join(names)}"
    score = np.array([objective(t + np.log(factor))[0] for factor in FACTORS])
    weights = dict(zip(grouped.names, np.exp(t).tolist(), strict=True))
    inside = not bool(_at_edges(t, bounds).any())
    return Selection(1.0, f"{name} by group", FACTORS, score, inside, note, {**weights, **grouped.told})
