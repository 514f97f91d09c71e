"""Several weights: a calibration at weight 1 whose scales hold them, alternated with their choice until both settle."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import scipy
from scipy.linalg import solve_triangular

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.units import fits
from rpim_opt.bayes.prior import Prior
from rpim_opt.calibration.at_weight import calibrated
from rpim_opt.calibration.loop import Options
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.program import pose
from rpim_opt.convex.quadratic import ridge
from rpim_opt.convex.rules.scores import reml
from rpim_opt.convex.rules.selection import Selection, grid_of
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.linear import RANK_TOLERANCE, LinearModel
from rpim_opt.robot.parameter_names import own_name
from rpim_opt.robot.parameters import Parameters

OTHERS = "others"
"""What the parameters are called that no group names: their weight is 1."""
Objective = Callable[[Array], tuple[float, Array]]
"""From logarithms of weights (G,) to a score and its gradient (G,)."""
SAME, NEARLY = 1e-3, 1e-2
"""Weights have settled when their logarithms change by no more than the first; a note is given above the second."""
MOST_ROUNDS = 12
"""How often they are chosen anew."""
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
FACTORS = np.geomspace(1e-3, 1e3, 61)
"""By which all weights together are multiplied, to show how sharp a choice is."""


# --- which parameters a group has ------------------------------------------------------------------------------


class Members(NamedTuple):
    """Names of the G groups to choose, every parameter's group (n,), given weights (n,), and those by their keys.

    The group is -1 where the weight is given.
    """

    names: tuple[str, ...]
    member: np.ndarray
    given: Array
    told: dict[str, float]

    def weights(self, t: Array) -> Array:
        """Return the weights (n,) of the parameters at logarithms t (G,) of those of the groups."""
        return np.where(self.member >= 0, np.append(np.exp(t), 0.0)[self.member], self.given)


def members(free: Parameters, weights: Mapping[str, Any]) -> Members:
    """Return which group every identified parameter is in, and which weights are given.

    Keys are patterns, names, or kinds (``"alpha"``, ``"tool"``, ``"length"``) and links (``"link2"``), several with a
    space between; a number is a given weight, `reml` one that is to be chosen. InputError for a key that names nothing,
    a parameter in two groups, weights that are not above zero, and other selectors.
    """
    if not weights:
        raise InputError("weight", "an empty mapping", "patterns of parameters with their weights")
    member = np.full(len(free), -1)
    given = np.ones(len(free))
    taken: dict[int, str] = {}
    names: list[str] = []
    told: dict[str, float] = {}
    for key, weight in weights.items():
        places = _places(key, free)
        for i in places:
            if i in taken:
                found = f"'{free.names[i]}' in '{taken[i]}' and in '{key}'"
                raise InputError("weight", found, "every parameter in one group")
            taken[i] = key
        if weight in (reml, "reml"):
            member[places] = len(names)
            names.append(key)
        elif not isinstance(weight, int | float | np.number) or isinstance(weight, bool):
            found = getattr(weight, "__name__", repr(weight).strip("'"))
            raise InputError("weight", f"'{found}' for groups", "reml, or a number")
        elif np.isfinite(weight) and weight > 0:
            given[places] = told[key] = float(weight)
        else:
            raise InputError("weight", f"{weight} for '{key}'", "a finite number above zero, or reml")
    if len(taken) < len(free):
        told[OTHERS] = 1.0
    return Members(tuple(names), member, given, told)


def _kinds(name: str) -> tuple[str, str]:
    """Return kind and link of a parameter: ``alpha`` and ``link3`` of ``alpha3``, ``tool`` twice of ``tool_x``."""
    name = own_name(name)
    stem = name.rstrip("0123456789")
    if stem == name:
        frame = name.split("_")[0]
        return frame, frame
    return stem, f"link{name.removeprefix(stem)}"


def _places(key: Any, free: Parameters) -> list[int]:
    """Return which parameters a key names."""
    if not isinstance(key, str) or not key.split():
        raise InputError("weight", f"key {key!r}", "patterns of parameters, 'a? d?'")
    places: list[int] = []
    kinds = [(*_kinds(name), group) for name, group in zip(free.names, free.groups, strict=True)]
    for token in key.split():
        met = [i for i, name in enumerate(free.names) if fits(name, token) or token in kinds[i]]
        if not met:
            known = [*dict.fromkeys(kind for kind, _, _ in kinds), *free.names]
            raise InputError("weight", f"'{token}'", "kinds, names or patterns: " + choices(token, known))
        places += [i for i in met if i not in places]
    return places


# --- the most likely weights -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Grouped:
    """Minimize |A z - b|^2 + sum_j w_j own_j (z_j - centre_j)^2 + |rows z - values|^2, with a weight w_g a group.

    The equations of ``model`` are in units of the scales without weights; ``own`` (n,) is 0 for parameters that only
    statements ``rows`` (k, n), ``values`` (k,) hold.
    """

    model: LinearModel
    members: Members
    own: Array
    centre: Array
    rows: Array
    values: Array

    def robot(self) -> tuple[np.ndarray, Array, Array, int]:
        """Return which parameters (k,) have a weight, |R z - r|^2 of rows R (., k), and how many equations these are.

        Frames are fixed effects unless a group is theirs alone, as is what has no penalty: how far a tripod stands says
        nothing about a gear. The rows are projected off their columns.
        """
        frames = self.model.parameters.placed
        alone = [g for g in range(len(self.members.names)) if frames[self.members.member == g].all()]
        free = (self.own == 0) | (frames & ~np.isin(self.members.member, alone))
        T = self.model.triangle
        R = np.vstack([T[:, :-1], self.rows])
        r = np.append(T[:, -1], self.values)
        columns = R[:, free]
        norms = np.linalg.norm(columns, axis=0)
        U, s, _ = np.linalg.svd(columns / np.where(norms > 0, norms, 1.0), full_matrices=False)
        U = U[:, s > RANK_TOLERANCE * np.max(s, initial=0.0)]
        left = R[:, ~free] - U @ (U.T @ R[:, ~free])
        equations = self.model.equations + len(self.values) - U.shape[1]
        return np.flatnonzero(~free), left, r - U @ (U.T @ r), equations


def restricted_likelihood(grouped: Grouped) -> Objective:
    """Return -2 ln(restricted likelihood) of logarithms of weights (G,), up to a constant, with its gradient.

    H = A'A + diag(w), and Q the least objective::

        m ln Q + ln det H - sum_j ln w_j,      gradient    m w_g |z_g|^2 / Q + w_g tr_g(H^-1) - n_g
    """
    kept, R, r, equations = grouped.robot()
    own, centre, member = grouped.own[kept], grouped.centre[kept], grouped.members.member[kept]
    in_group = member[:, None] == np.arange(len(grouped.members.names))

    def objective(t: Array) -> tuple[float, Array]:
        weights = grouped.members.weights(t)[kept] * own
        z, inverse = minimum(R, r, weights, centre)
        away = weights * (z - centre) ** 2
        Q = max(float(np.sum((R @ z - r) ** 2) + np.sum(away)), np.finfo(float).tiny)
        root = np.sqrt(weights)
        value = equations * np.log(Q) - np.linalg.slogdet(inverse * np.outer(root, root))[1]
        return float(value), (equations * away / Q + weights * np.diag(inverse) - 1) @ in_group

    return objective


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


def reml_groups(grouped: Grouped) -> Selection:
    """Choose the most likely weights: restricted maximum likelihood with a variance a group (Patterson, Thompson 1971).

    With the noise level profiled out and frames as fixed effects, as `reml` has them. Minimized from several starts.
    The optimum where all is noise counts only if there is no other, and then the weights are 1.
    """
    names, told = grouped.members.names, grouped.members.told
    if grouped.model.constrained:
        note = "points on a plane or sphere do not determine it: stated noise and scales are used"
        weights = {**dict.fromkeys(names, 1.0), **told}
        return Selection(1.0, "reml by group", FACTORS, np.zeros(len(FACTORS)), False, note, weights)
    objective = restricted_likelihood(grouped)
    grid = grid_of(ridge(grouped.model, None), 2)
    low, high = float(np.log(grid[0] / BEYOND)), float(np.log(grid[-1] * BEYOND))
    t = _least(objective, (low, high), len(names))
    at_low, at_high = t <= low + EDGE, t >= high - EDGE
    interior = not (at_low | at_high).any()
    note = "largest restricted likelihood"
    if at_high.all():
        t = np.zeros_like(t)
        note = "the data do not determine the scale of the deviations: stated noise and scales are used"
    else:
        for what, at in (("penalty", at_low), ("deviation", at_high)):
            if at.any():
                note += f"; the data support no {what} of {', '.join(np.array(names)[at])}"
    score = np.array([objective(t + np.log(factor))[0] for factor in FACTORS])
    weights = dict(zip(names, np.exp(t).tolist(), strict=True))
    return Selection(1.0, "reml by group", FACTORS, score, interior, note, {**weights, **told})


def _least(objective: Objective, bounds: tuple[float, float], count: int) -> Array:
    """Return the best minimum (G,) from several starts.

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
    options = {"ftol": EXACT, "gtol": 1e-9, "maxiter": 500}
    found = [
        scipy.optimize.minimize(objective, start, jac=True, method="L-BFGS-B", bounds=[bounds] * count, options=options)
        for start in starts
    ]

    def rank(each: Any) -> tuple[bool, float]:
        at_bound = (each.x <= low + EDGE) | (each.x >= high - EDGE)
        return bool(at_bound.all()), float(each.fun)

    return np.asarray(min(found, key=rank).x, dtype=float)


# --- calibration -----------------------------------------------------------------------------------------------


def grouped(
    problem: Source,
    formulation: Formulation,
    weights: Mapping[str, Any],
    *,
    prior: Prior | None = None,
    start: Array | None = None,
    options: Options,
) -> Calibration:
    """Return the calibration with a weight w for each group of parameters, which stands in its scales, S / sqrt(w).

    Weights that are to be chosen are chosen from the last linearization, and the problem is calibrated anew with them,
    until they are their own answer. Constraints that count in scales count in S / sqrt(w).
    """
    if formulation.penalty is None:
        raise InputError("weight", f"weights for formulation '{formulation.name}'", "one with a penalty")
    found = members(problem.parameters.free, weights)
    stated = (prior or Prior()).stated(problem.parameters, widened=False)

    def solved(t: Array, start: Array | None) -> Calibration:
        """Return the calibration at weight 1 with weights of logarithms t (G,) in the scales."""
        size = stated.scale / np.sqrt(found.weights(t))
        scale = problem.parameters.scale.copy()
        scale[problem.parameters.identified] *= size
        weighted = problem.with_parameters(replace(problem.parameters, scale=scale))
        penalized = stated.inside(size).penalized(formulation)
        return calibrated(weighted, penalized, 1.0, start=start, options=options)

    def choice(linear: LinearModel, t: Array) -> Selection:
        """Return the most likely weights for the squares that a calibration with weights t ended at."""
        root = np.sqrt(found.weights(t))
        scale = linear.parameters.scale * root
        linear = replace(linear, A=linear.A * root, parameters=replace(linear.parameters, scale=scale))
        form = pose(formulation, linear).penalty_form
        if form is None or form.c.any() or not form.diagonal:
            accepted = "numbers for its groups, or a penalty that sums squared deviations"
            raise InputError("weight", f"formulation '{formulation.name}'", accepted)
        own = np.where(stated.replaced, 0.0, form.L**2)
        centre = stated.centre / stated.scale
        return reml_groups(Grouped(linear, found, own, centre, stated.rows * stated.scale, stated.values))

    t = np.zeros(len(found.names))
    result = solved(t, start)
    selection = Selection(1.0, "given by group", np.zeros(0), np.zeros(0), True, "as stated", found.told)
    if found.names:
        change = np.inf
        selection = choice(result.linear, t)
        for _ in range(MOST_ROUNDS):
            answer = np.log([selection.groups[name] for name in found.names])
            change = float(np.max(np.abs(answer - t)))
            if change <= SAME:
                break
            t = answer
            result = solved(t, result.x)
            selection = choice(result.linear, t)
        used = dict(zip(found.names, np.exp(t).tolist(), strict=True))
        selection = replace(selection, groups={**selection.groups, **used})
        if change > NEARLY:
            note = f" The weights of groups did not converge in {MOST_ROUNDS} rounds: the last ones are used."
            result = replace(result, message=result.message + note)
    how = {"formulation": formulation, "weights": weights, "prior": prior, "options": replace(options, progress=None)}
    again = partial(_again, table=problem.parameters, **how)
    return replace(result, selection=selection, asked=again)


def _again(problem: Source, *, table: Parameters, **how: Any) -> Calibration:
    """Ask the same of other rows; the parameters of a result have the weights in their scales."""
    return grouped(problem.with_parameters(table), **how)
