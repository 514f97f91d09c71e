"""Choosing the weight from the identification data alone, with the evidence for the choice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from rpim_opt.exceptions import InputError
from rpim_opt.formulation import ConvexProgram
from rpim_opt.problem import RANK_TOLERANCE
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


def weight_grid(program: ConvexProgram, count: int = 200) -> Array:
    """Return weights from 1e-4 s_r^2 to 10 s_1^2, where s are the singular values of A (zero ones aside).

    Below, the penalty changes nothing that the data see; above, it leaves nothing to identify.
    """
    s = program.model.svd[1]
    if program.formulation.penalty is None:
        raise InputError("weight", "a selector for a formulation without penalty", "weight 0")
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
        For another loss than the sum of squares or another penalty than the squared norm.
    """
    if not program.quadratic:
        accepted = "squared loss and squared penalty; l_curve serves any other"
        raise InputError("selector reml", f"formulation '{program.formulation.name}'", accepted)
    weights = weight_grid(program)
    if program.model.constrained:
        note = "points on a plane or sphere do not tell it: declared noise and scales are taken at their word"
        return Selection(1.0, "reml", weights, np.zeros(len(weights)), interior=False, note=note)
    likelihood = _restricted_likelihood(program)
    score = likelihood(weights)
    valley = np.flatnonzero((score[:-1] <= np.append(np.inf, score[:-2])) & (score[:-1] < score[1:]))
    best = int(valley[np.argmin(score[valley])]) if len(valley) else len(weights) - 1
    if best == 0:
        note = "the likelihood is largest at the lower edge: the data want no penalty"
        return Selection(float(weights[0]), "reml", weights, score, interior=False, note=note)
    if best == len(weights) - 1:
        note = "the data do not tell how large deviations are: declared noise and scales are taken at their word"
        return Selection(1.0, "reml", weights, score, interior=False, note=note)
    fine = minimize_scalar(
        lambda t: likelihood(np.exp([t]))[0],
        bounds=(np.log(weights[best - 1]), np.log(weights[best + 1])),
        method="bounded",
        options={"xatol": 1e-6},
    )
    note = "largest restricted likelihood"
    return Selection(float(np.exp(fine.x)), "reml", weights, score, interior=True, note=note)


def _restricted_likelihood(program: ConvexProgram) -> Callable[[Array], Array]:
    """Return the function from weights (K,) to -2 ln(restricted likelihood), up to a constant."""
    model, tiny = program.model, np.finfo(float).tiny
    frames, R = model.parameters.of_frames, model.triangle
    if frames.all():
        frames = np.zeros_like(frames)
    U, s, _ = np.linalg.svd(R[:, :-1][:, frames], full_matrices=False)
    U = U[:, s > RANK_TOLERANCE * s.max(initial=0.0)]
    R = R - U @ (U.T @ R)
    m, b = len(model.b) - U.shape[1], R[:, -1]
    U, s, _ = np.linalg.svd(R[:, :-1][:, ~frames], full_matrices=False)
    seen = s > RANK_TOLERANCE * s.max(initial=tiny)
    beta2, s2 = (U[:, seen].T @ b) ** 2, s[seen] ** 2
    perp = max(float(b @ b - beta2.sum()), 0.0)

    def score(weights: Array) -> Array:
        g = weights[:, None] / (s2 + weights[:, None])
        return m * np.log(np.maximum(g @ beta2 + perp, tiny)) - np.sum(np.log(g), axis=1)

    return score


def two_step(program: ConvexProgram) -> Selection:
    """Choose by the paper's two steps after a coarse L-curve (section III B and Figs. 7 to 10).

    1. From the corner down, 30 weights over ten decades. The residual norm falls with the weight, so its
       minimum is always the smallest weight; what the paper reads off its Fig. 7 is where the fall ends:
       the first weight from which one more step lowers the residual norm by less than 1 %.
    2. Ten weights within the same order of magnitude, 0.184 to 1.653 times that (the paper's 0.563e-14 to
       5.063e-14 around 3.063e-14), compared by held-out error: every configuration is left out once.
    """
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


def held_out_error(program: ConvexProgram, weights: Array) -> Array:
    """Root mean square of the whitened residual of each configuration, predicted from all the others."""
    model, groups = program.model, np.unique(program.model.group)
    if len(groups) < 2:
        raise InputError("data", "one configuration", "two or more to hold one out")
    total = np.zeros(len(weights))
    for group in groups:
        out = model.group == group
        Z = np.array([e.z for e in program.on(model.without(group)).path(weights)])
        total += np.sum((Z @ model.A[out].T - model.b[out]) ** 2, axis=1)
    return np.sqrt(total / len(model.b))


SELECTORS: dict[str, Selector] = {"l_curve": l_curve, "reml": reml, "two_step": two_step}
