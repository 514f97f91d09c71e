"""Choosing the weight from the identification data alone, with the evidence for the choice."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import cvxpy as cp
import numpy as np
from scipy.optimize import minimize_scalar

from rpim_opt.exceptions import InputError, NoSolutionFound
from rpim_opt.formulation import ConvexProgram
from rpim_opt.problem import RANK_TOLERANCE, LinearModel
from rpim_opt.robot import Array


@dataclass(frozen=True, eq=False)
class Selection:
    """A chosen weight with its evidence.

    Parameters
    ----------
    weight
        The choice.
    name
        The rule's name.
    weights, score
        (K,) the weights that were tried and what the rule compared.
    interior
        Whether the choice lies inside the weights that were tried. If not, ``note`` says what that means.
    note
        One sentence for the report.
    """

    weight: float
    name: str
    weights: Array
    score: Array
    interior: bool
    note: str = ""


Selector = Callable[[ConvexProgram], Selection]


def _with_rows(program: ConvexProgram, name: str) -> LinearModel:
    """Return the model for a rule that leaves rows out, if it has its rows."""
    if program.model.stands_for is not None:
        found = f"{program.model.equations} equations of which only the triangle is kept"
        raise InputError(f"selector {name}", found, "reml, l_curve, gcv, discrepancy, or a number")
    return program.model


def weight_grid(program: ConvexProgram, count: int = 200) -> Array:
    """Return weights from 1e-4 s_r^2 to 10 s_1^2, where s are the singular values of A (zero ones aside).

    Below, the penalty changes nothing that the data see; above, it leaves nothing to identify.
    """
    if program.formulation.penalty is None:
        raise InputError("weight", "a selector for a formulation without penalty", "weight 0")
    return _grid(program.model, count)


def _grid(model: LinearModel, count: int = 200) -> Array:
    s = model.svd[1]
    if not s.any():
        raise InputError("data", "no sensitivity to any identified parameter", "data that see at least one")
    return np.geomspace(1e-4 * s[s > 0][-1] ** 2, 10 * s[0] ** 2, count)


def l_curve(program: ConvexProgram) -> Selection:
    """Choose the corner of the L-curve: the largest curvature of (ln |A z - b|, ln |z|).

    With a closed form the derivatives are analytic (Hansen 1998, Rank-Deficient and Discrete Ill-Posed
    Problems, sec. 4.6; sign such that the corner of an L is positive) and the maximum is refined between
    the neighbours on the grid. Otherwise the curvature is that of the circle through three neighbouring
    points (Cultrera and Callegaro 2020). A maximum at the edge is no corner, and
    neither is a curve bent the other way everywhere; the weight is then that edge, or the lower one.
    """
    if program.closed_form:
        weights = weight_grid(program)
        score = _curvature(program, weights)
    else:
        weights = weight_grid(program, 60)
        estimates = program.path(weights)
        tiny = np.finfo(float).tiny
        points = 0.5 * np.log([[max(e.loss, tiny), max(e.penalty, tiny)] for e in estimates])
        score = _menger(points)
    best = int(np.argmax(score)) if np.max(score) > 0 else 0
    if not (0 < best < len(weights) - 1 and score[best] > 0):
        note = (
            f"the L-curve has no corner: the weight is the {'lower' if best == 0 else 'upper'} edge "
            f"of {weights[0]:.1e} to {weights[-1]:.1e}; another selector, or a weight of your own, may serve better"
        )
        return Selection(float(weights[best]), "l_curve", weights, score, interior=False, note=note)
    weight = float(weights[best])
    if program.closed_form:
        low, high = np.log(weights[best - 1]), np.log(weights[best + 1])
        fine = minimize_scalar(
            lambda t: -_curvature(program, np.exp([t]))[0],
            bounds=(low, high),
            method="bounded",
            options={"xatol": 1e-6},
        )
        weight = float(np.exp(fine.x)) if -fine.fun > score[best] else weight
    return Selection(weight, "l_curve", weights, score, interior=True, note="corner of the L-curve")


def _curvature(program: ConvexProgram, weights: Array) -> Array:
    """Curvature of t = ln weight -> (u, v) = (ln rho, ln eta) / 2 with rho = |Az - b|^2, eta = |z|^2.

    With z_i = s_i beta_i / (s_i^2 + w): eta' = d eta / dt = -2 w sum z_i^2 / (s_i^2 + w), and rho' = -w eta'.
    """
    beta, s, _ = program.model.svd
    seen, w = s > 0, weights[:, None]
    beta_seen, s2 = beta[seen], s[seen] ** 2
    unseen = program.model.triangle[-1, -1] ** 2 + np.sum(beta[~seen] ** 2)
    z2 = (s[seen] * beta_seen / (s2 + w)) ** 2
    eta, rho = z2.sum(1), ((w * beta_seen / (s2 + w)) ** 2).sum(1) + unseen
    first, second = (z2 / (s2 + w)).sum(1), (z2 / (s2 + w) ** 2).sum(1)
    eta1 = -2 * weights * first
    eta2 = eta1 + 6 * weights**2 * second
    rho1 = -weights * eta1
    rho2 = -weights * (eta1 + eta2)
    tiny = np.finfo(float).tiny
    eta, rho = np.maximum(eta, tiny), np.maximum(rho, tiny)
    u1, v1 = rho1 / rho / 2, eta1 / eta / 2
    u2, v2 = rho2 / rho / 2 - 2 * u1**2, eta2 / eta / 2 - 2 * v1**2
    speed = np.maximum(u1**2 + v1**2, tiny)
    return (u1 * v2 - v1 * u2) / speed**1.5


def _menger(points: Array) -> Array:
    """Signed curvature of the circle through each point (K, 2) and its neighbours; zero at the ends."""
    a, b, c = points[:-2], points[1:-1], points[2:]
    cross = (b - a)[:, 0] * (c - b)[:, 1] - (b - a)[:, 1] * (c - b)[:, 0]
    sides = np.linalg.norm(b - a, axis=1) * np.linalg.norm(c - b, axis=1) * np.linalg.norm(c - a, axis=1)
    inner = np.divide(2 * cross, sides, out=np.zeros(len(a)), where=sides > 1e-18)
    return np.concatenate([[0.0], inner, [0.0]])


def _linear_rule(
    program: ConvexProgram,
    name: str,
    score_of: Callable[[LinearModel], Callable[[Array], Array]],
    note: str,
    edges: Mapping[str, str],
    local: bool = False,
) -> Selection:
    """Minimize a score of the linear estimator over a grid from the singular values, refined between its points.

    With a robust loss the estimator is that of what it trusts (`ConvexProgram.trusted`), found by iteration.
    With ``local`` the lowest interior minimum goes before an edge.
    """
    if program.formulation.penalty is not cp.sum_squares or program.formulation.penalty_over is not None:
        found = f"formulation '{program.formulation.name}'"
        accepted = (
            "a squared norm as penalty, whose solutions are linear in the data; l_curve, corner or k_fold serve any"
        )
        raise InputError(f"selector {name}", found, accepted)
    weight, selection = 1.0, None
    for _ in range(1 if program.quadratic else 6):
        model = program.model if program.quadratic else program.trusted(program.solve(weight).z)
        weights = _grid(model)
        score_at = score_of(model)
        score = score_at(weights)
        valley = np.flatnonzero((score[1:-1] <= score[:-2]) & (score[1:-1] < score[2:])) + 1
        best = int(valley[np.argmin(score[valley])]) if local and len(valley) else int(np.argmin(score))
        if not 0 < best < len(weights) - 1:
            side = "lower" if best == 0 else "upper"
            selection = Selection(float(weights[best]), name, weights, score, False, edges[side])
        else:
            fine = minimize_scalar(
                lambda t, f=score_at: float(f(np.exp([t]))[0]),
                bounds=(np.log(weights[best - 1]), np.log(weights[best + 1])),
                method="bounded",
                options={"xatol": 1e-6},
            )
            selection = Selection(float(np.exp(fine.x)), name, weights, score, True, note)
        if abs(np.log(selection.weight / weight)) < 0.02:
            break
        weight = selection.weight
    if selection is None:
        raise InputError(f"selector {name}", "no weight", "data")
    return selection


ROOM = 1.1
"""Discrepancy principle: by how much the residual norm may exceed what the declared noise promises."""
EDGES = {
    "lower": "the smallest weight of the grid is best: the data want no penalty",
    "upper": "the largest weight of the grid is best: the data want no deviation",
}


def reml(program: ConvexProgram) -> Selection:
    """Choose the most likely weight: restricted maximum likelihood, with the noise level profiled out.

    The penalty is read as a normal prior of variance sigma^2 / weight on the robot's parameters and sigma^2 as
    unknown, so that declared noise that leaves out backlash or gravity does no harm. Frames (base, reflectors,
    anchors) are fixed effects: the m equations are projected off their columns, because how far a tripod stands
    says nothing about a gear. Minimizes, with g_i = w / (s_i^2 + w) (Patterson and Thompson 1971, Biometrika
    58:545; Wahba 1985, Annals of Statistics 13:1378)::

        m ln(sum beta_i^2 g_i + |r_perp|^2) - sum ln g_i

    Points on a plane or sphere are met by a robot shrunk to nothing, so that their fit tells no noise level: the
    weight is 1, declared noise and scales at their word. With few data a second maximum may lie at infinite
    weight, where everything is noise: it counts only if there is no other, and then the weight is 1 too. A choice
    at the lower edge means that the data want no penalty. Constraints are left out of the likelihood.

    Raises
    ------
    InputError
        For another penalty than the squared norm.
    """
    if program.model.constrained and program.formulation.penalty is cp.sum_squares:
        weights = weight_grid(program)
        note = "points on a plane or sphere do not tell it: declared noise and scales are taken at their word"
        return Selection(1.0, "reml", weights, np.zeros(len(weights)), interior=False, note=note)
    chosen = _linear_rule(program, "reml", _restricted_likelihood, "largest restricted likelihood", EDGES, local=True)
    if chosen.interior or chosen.weight < 1.0:
        return chosen
    note = "the data do not tell how large deviations are: declared noise and scales are taken at their word"
    return replace(chosen, weight=1.0, note=note)


def _restricted_likelihood(model: LinearModel) -> Callable[[Array], Array]:
    """Return the function from weights (K,) to -2 ln(restricted likelihood), up to a constant."""
    tiny, frames, R = np.finfo(float).tiny, model.parameters.of_frames, model.triangle
    if frames.all():
        frames = np.zeros_like(frames)
    U, s, _ = np.linalg.svd(R[:, :-1][:, frames], full_matrices=False)
    U = U[:, s > RANK_TOLERANCE * s.max(initial=0.0)]
    R = R - U @ (U.T @ R)
    m, b = model.equations - U.shape[1], R[:, -1]
    U, s, _ = np.linalg.svd(R[:, :-1][:, ~frames], full_matrices=False)
    seen = s > RANK_TOLERANCE * s.max(initial=tiny)
    beta2, s2 = (U[:, seen].T @ b) ** 2, s[seen] ** 2
    perp = max(float(b @ b - beta2.sum()), 0.0)

    def score(weights: Array) -> Array:
        g = weights[:, None] / (s2 + weights[:, None])
        return m * np.log(np.maximum(g @ beta2 + perp, tiny)) - np.sum(np.log(g), axis=1)

    return score


def _filters(model: LinearModel) -> tuple[Array, Array, float]:
    """Return beta^2, s^2 of the seen directions and |r_perp|^2."""
    beta, s, _ = model.svd
    seen = s > 0
    return beta[seen] ** 2, s[seen] ** 2, float(model.triangle[-1, -1] ** 2 + np.sum(beta[~seen] ** 2))


def _gcv_score(gamma: float) -> Callable[[LinearModel], Callable[[Array], Array]]:
    def of(model: LinearModel) -> Callable[[Array], Array]:
        beta2, s2, perp = _filters(model)

        def score(weights: Array) -> Array:
            g = weights[:, None] / (s2 + weights[:, None])
            left = model.equations - gamma * np.sum(1 - g, axis=1)
            return np.where(left > 0, (g**2 @ beta2 + perp) / np.maximum(left, 1e-300) ** 2, np.inf)

        return score

    return of


def gcv(program: ConvexProgram) -> Selection:
    """Choose by generalized cross-validation: minimize rho(w) / (m - dof(w))^2 (Golub, Heath and Wahba 1979).

    rho = |A z - b|^2, dof = sum s_i^2 / (s_i^2 + w).
    """
    return _linear_rule(program, "gcv", _gcv_score(1.0), "smallest generalized cross-validation error", EDGES)


def robust_gcv(program: ConvexProgram, gamma: float = 1.4) -> Selection:
    """Choose by cross-validation that charges more for degrees of freedom: rho(w) / (m - gamma dof(w))^2.

    Guards against GCV's occasional far too small weights (Cummins, Filloon and Nychka 2001, JASA 96:233). With
    less than three equations for each direction it guards too much and is refused.
    """
    m, rank = program.model.equations, program.model.rank
    if m < 3 * rank:
        found = f"{m} equations for {rank} directions"
        raise InputError("selector robust_gcv", found, "three equations a direction; gcv or reml with fewer")
    note = f"smallest cross-validation error with gamma {gamma:g}"
    return _linear_rule(program, "robust_gcv", _gcv_score(gamma), note, EDGES)


def discrepancy(program: ConvexProgram) -> Selection:
    """Choose the largest weight that fits as well as the declared noise allows (Morozov 1966).

    rho(w) <= tau^2 (m - dof(w)), with tau = 1.1: without that room one data set in two would fit at no weight.
    """
    chosen = _linear_rule(program, "discrepancy", _misfit, "misfit equal to the declared noise", EDGES)
    fits = np.flatnonzero(chosen.score <= 0)
    weights = chosen.weights
    if not len(fits):
        note = "no weight fits as well as the declared noise promises: it is too small, or the model lacks something"
        return replace(chosen, weight=float(weights[0]), interior=False, note=note)
    k = int(fits[-1])
    if k == len(weights) - 1:
        note = "every weight fits better than the declared noise: it is stated too large"
        return replace(chosen, weight=float(weights[k]), interior=False, note=note)
    share = chosen.score[k] / (chosen.score[k] - chosen.score[k + 1])
    weight = float(np.exp(np.log(weights[k]) + share * np.log(weights[k + 1] / weights[k])))
    return replace(chosen, weight=weight, interior=True, note="misfit equal to the declared noise")


def _misfit(model: LinearModel) -> Callable[[Array], Array]:
    """Return the function from weights (K,) to ln(rho / (tau^2 (m - dof)))."""
    beta2, s2, perp = _filters(model)

    def score(weights: Array) -> Array:
        g = weights[:, None] / (s2 + weights[:, None])
        left = ROOM**2 * np.maximum(model.equations - np.sum(1 - g, axis=1), 1e-9)
        return np.log(np.maximum(g**2 @ beta2 + perp, np.finfo(float).tiny) / left)

    return score


def quasi_optimality(program: ConvexProgram) -> Selection:
    """Choose where the solution changes least with the weight: minimize |w dz/dw| (Tikhonov and Glasko 1965)."""

    def of(model: LinearModel) -> Callable[[Array], Array]:
        beta2, s2, _ = _filters(model)
        return lambda weights: np.sum((weights[:, None] ** 2 * s2 * beta2) / (s2 + weights[:, None]) ** 4, axis=1)

    return _linear_rule(program, "quasi_optimality", of, "least change of the solution", EDGES, local=True)


def ncp(program: ConvexProgram) -> Selection:
    """Choose where the residual looks most like white noise: normalized cumulative periodogram (Hansen et al. 2006).

    Minimizes the largest distance of the cumulative periodogram of the residual, in the order of the rows, from
    a straight line. Needs rows in an order that means something, such as time or place.
    """
    _with_rows(program, "ncp")

    def of(model: LinearModel) -> Callable[[Array], Array]:
        _, s, Vt = model.svd
        seen = s > 0
        Q, s2 = model.A @ Vt[seen].T / s[seen], s[seen] ** 2

        def score(weights: Array) -> Array:
            fit = (s2 / (s2 + weights[:, None])) * (Q.T @ model.b)
            residual = model.b - fit @ Q.T
            power = np.abs(np.fft.rfft(residual, axis=1)[:, 1:]) ** 2
            cumulative = np.cumsum(power, axis=1) / np.sum(power, axis=1, keepdims=True)
            line = np.arange(1, power.shape[1] + 1) / power.shape[1]
            return np.max(np.abs(cumulative - line), axis=1)

        return score

    return _linear_rule(program, "ncp", of, "whitest residual", EDGES)


def leave_one_out(program: ConvexProgram) -> Selection:
    """Choose by leaving every configuration out once and predicting it, all its equations together.

    For a linear estimator in closed form, r_g^- = (1 - H_gg)^-1 r_g with H = A (A'A + w)^-1 A' (Allen 1974; by blocks);
    for others by solving, on fewer weights.
    """
    _with_rows(program, "leave_one_out")
    if not program.closed_form:
        return _held_out(program, "leave_one_out", None)

    def of(model: LinearModel) -> Callable[[Array], Array]:
        _, s, Vt = model.svd
        seen = s > 0
        Q, s2 = model.A @ Vt[seen].T / s[seen], s[seen] ** 2
        rows = [np.flatnonzero(model.group == g) for g in np.unique(model.group)]

        def score(weights: Array) -> Array:
            total = np.zeros(len(weights))
            filters = s2 / (s2 + weights[:, None])
            residual = model.b - (filters * (Q.T @ model.b)) @ Q.T
            for k in rows:
                H = np.einsum("ip,wp,jp->wij", Q[k], filters, Q[k], optimize=True)
                left = np.linalg.pinv(np.eye(len(k)) - H)
                total += np.sum(np.einsum("wij,wj->wi", left, residual[:, k]) ** 2, axis=1)
            return total

        return score

    return _linear_rule(program, "leave_one_out", of, "smallest error of configurations left out one by one", EDGES)


def k_fold(program: ConvexProgram, folds: int = 10, seed: int = 0) -> Selection:
    """Choose by cross-validation in folds that keep configurations whole; any formulation."""
    groups = np.unique(_with_rows(program, "k_fold").group)
    if len(groups) < folds:
        raise InputError("selector k_fold", f"{len(groups)} configurations", f"at least {folds}, or fewer folds")
    parts = np.array_split(np.random.default_rng(seed).permutation(groups), folds)
    return _held_out(program, "k_fold", parts)


def _held_out(program: ConvexProgram, name: str, parts: Sequence[np.ndarray] | None) -> Selection:
    weights = weight_grid(program, 200 if program.closed_form else 24)
    score = held_out_error(program, weights, parts)
    best = int(np.argmin(score))
    interior = 0 < best < len(weights) - 1
    note = "smallest error of configurations held out"
    side = "lower" if best == 0 else "upper"
    return Selection(float(weights[best]), name, weights, score, interior, note if interior else EDGES[side])


def corner(program: ConvexProgram, tolerance: float = 0.01) -> Selection:
    """Search the corner of the L-curve without a grid: golden sections by Menger curvature, any formulation.

    Cultrera and Callegaro 2020 (IOP SciNotes 1:025004): of four points on the curve the inner one with the larger
    curvature stays, and the interval shrinks to its neighbours; one new solution a step.
    """
    grid = weight_grid(program, 2)
    seen: dict[float, Array] = {}

    def point(t: float) -> Array:
        if t not in seen:
            e = program.path([np.exp(t)])[0]
            seen[t] = 0.5 * np.log(np.maximum([e.loss, e.penalty], np.finfo(float).tiny))
        return seen[t]

    def curvature(a: float, b: float, c: float) -> float:
        return float(_menger(np.array([point(a), point(b), point(c)]))[1])

    golden = (1 + 5**0.5) / 2
    x1, x4 = np.log(grid)
    x2 = (x4 + golden * x1) / (1 + golden)
    x3 = x1 + x4 - x2
    best = x2
    while x4 - x1 > tolerance:
        right = curvature(x2, x3, x4)
        while right < 0 and x4 - x1 > tolerance:  # the flat end on the right: cut it off
            x4, x3 = x3, x2
            x2 = (x4 + golden * x1) / (1 + golden)
            right = curvature(x2, x3, x4)
        if curvature(x1, x2, x3) > right:
            best, x4, x3 = x2, x3, x2
            x2 = (x4 + golden * x1) / (1 + golden)
        else:
            best, x1, x2 = x3, x2, x3
            x3 = x1 + x4 - x2
    order = sorted(seen)
    interior = np.log(grid[0]) + 0.1 < best < np.log(grid[1]) - 0.1
    note = (
        "corner of the L-curve by golden sections"
        if interior
        else "the search ended at an edge: the L-curve has no corner"
    )
    points = np.array([seen[t] for t in order])
    return Selection(float(np.exp(best)), "corner", np.exp(order), _menger(points), interior, note)


def two_step(program: ConvexProgram) -> Selection:
    """Choose by the paper's two steps after a coarse L-curve (section III B and Figs. 7 to 10).

    1. From the corner down, 30 weights over ten decades. The residual norm falls with the weight, so its
       minimum is always the smallest weight; what the paper reads off its Fig. 7 is where the fall ends:
       the first weight from which one more step lowers the residual norm by less than 1 %.
    2. Ten weights within the same order of magnitude, 0.184 to 1.653 times that (the paper's 0.563e-14 to
       5.063e-14 around 3.063e-14), compared by held-out error: every configuration is left out once.
    """
    _with_rows(program, "two_step")
    corner = l_curve(program)
    coarse = np.geomspace(corner.weight, 1e-10 * corner.weight, 30)
    residual = np.sqrt([e.loss for e in program.path(coarse)])
    level = coarse[np.argmax(residual[1:] >= 0.99 * residual[:-1])]
    fine = level * np.linspace(0.563 / 3.063, 5.063 / 3.063, 10)
    score = held_out_error(program, fine)
    best = int(np.argmin(score))
    interior = 0 < best < len(fine) - 1
    note = "the paper's two steps: residual norm, then held-out error"
    if not interior:
        note += "; the held-out error is smallest at an edge of the ten weights, so a wider search would go on"
    return Selection(float(fine[best]), "two_step", fine, score, interior, note)


def held_out_error(program: ConvexProgram, weights: Array, parts: Sequence[np.ndarray] | None = None) -> Array:
    """Root mean square of the whitened residual of held-out configurations, predicted from all the others.

    ``parts`` are the configurations that are held out together; each one alone by default. A robust loss judges
    the median of the configurations' norms instead: a blunder held out is not an error of the prediction.
    """
    model = program.model
    if len(np.unique(model.group)) < 2:
        raise InputError("data", "one configuration", "two or more to hold one out")
    squared = program.formulation.loss is cp.sum_squares
    norms = np.zeros((len(weights), 0))
    for part in parts if parts is not None else np.unique(model.group)[:, None]:
        out = np.isin(model.group, part)
        Z = np.array([e.z for e in program.on(model.scaled(np.where(out, 0.0, 1.0))).path(weights)])
        squares = (Z @ model.A[out].T - model.b[out]) ** 2
        of = np.unique(model.group[out], return_inverse=True)[1]
        norms = np.hstack([norms, np.sqrt(np.stack([squares[:, of == k].sum(1) for k in range(of.max() + 1)], axis=1))])
    return np.sqrt(np.sum(norms**2, axis=1) / len(model.b)) if squared else np.median(norms, axis=1)


def disagreement(program: ConvexProgram) -> str:
    """Return a warning where L-curve, GCV and REML lie more than a decade apart, else nothing."""
    if not program.closed_form or program.model.constrained:
        return ""
    found = {rule.__name__: rule(program).weight for rule in (l_curve, gcv, reml)}
    low, high = min(found, key=lambda k: found[k]), max(found, key=lambda k: found[k])
    if found[high] <= 10 * found[low]:
        return ""
    decades = np.log10(found[high] / found[low])
    return (
        f"The selectors disagree by {decades:.1f} decades: " + ", ".join(f"{k} {v:.2g}" for k, v in found.items()) + "."
    )


def compare(program: ConvexProgram) -> dict[str, Selection]:
    """Return what every selector chooses that serves a program, by name.

    Those that hold configurations out are left out where that would take long: without a closed form, or more than 200.
    """
    quick = program.closed_form and len(np.unique(program.model.group)) <= 200
    slow = () if quick else (leave_one_out, k_fold, two_step)
    chosen = {}
    for name, rule in SELECTORS.items():
        if rule not in slow:
            with contextlib.suppress(InputError, NoSolutionFound):  # it does not serve this formulation or these data
                chosen[name] = rule(program)
    return chosen


SELECTORS: dict[str, Selector] = {
    "reml": reml,
    "l_curve": l_curve,
    "corner": corner,
    "two_step": two_step,
    "gcv": gcv,
    "robust_gcv": robust_gcv,
    "leave_one_out": leave_one_out,
    "k_fold": k_fold,
    "discrepancy": discrepancy,
    "quasi_optimality": quasi_optimality,
    "ncp": ncp,
}
