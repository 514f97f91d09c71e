"""Selection rules by a score of the linear estimator: REML, GCV, discrepancy, quasi-optimality."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.program import Program
from rpim_opt.convex.quadratic import identity, ridge, robot_alone
from rpim_opt.convex.rules.selection import Score, Selection, choice, grid_of, least_between, on_inliers, weight_grid


def require_linear(program: Program, name: str) -> None:
    """Refuse a program whose solutions are not linear in the data."""
    if program.penalty_form is None:
        found = f"formulation '{program.formulation.name}'"
        accepted = "a quadratic penalty, so that solutions are linear in the data; l_curve, corner and k_fold take any"
        raise InputError(f"selector {name}", found, accepted)
    if program.loss_form is None:
        program.inlier_model(np.zeros(program.model.A.shape[1]))  # raises the reason


def linear_rule(program: Program, name: str, score: Score, note: str, local: bool = False) -> Selection:
    """Minimize a score of the linear estimator over a grid, refined between its points.

    With ``local`` an interior minimum has precedence over an edge.
    """
    require_linear(program, name)
    weights = grid_of(program.ridge)
    scores = score(weights)
    best = int(np.argmin(scores))
    valleys = np.flatnonzero((scores[1:-1] <= scores[:-2]) & (scores[1:-1] < scores[2:])) + 1
    if local and len(valleys):
        best = int(valleys[np.argmin(scores[valleys])])
    chosen = choice(name, weights, scores, best, note)
    return replace(chosen, weight=least_between(score, weights, best)[0]) if chosen.interior else chosen


@on_inliers
def reml(program: Program) -> Selection:
    """Choose by restricted maximum likelihood (REML), with the noise level profiled out.

    The penalty is read as a normal prior of variance sigma^2 / weight on the robot's parameters, with sigma^2 unknown,
    so that stated noise need not include backlash or gravity. Frames (base, reflectors, anchors) are fixed effects: the
    m equations are projected off their columns, since the place of a tripod says nothing about a robot. Minimizes, with
    g_i = w / (s_i^2 + w) (Patterson and Thompson 1971, Biometrika 58:545; Wahba 1985, Annals of Statistics 13:1378)::

        m ln(sum beta_i^2 g_i + |r_perp|^2) - sum ln g_i

    A robot shrunk to a point fits points on a plane or sphere exactly, so that they determine no noise level: the
    weight is then 1: stated noise and scales hold. With few data a second maximum may lie at infinite weight, where
    everything is noise: it counts only if there is no other, and then the weight is 1, too. A choice at the lower edge
    means that the data support no penalty. Constraints are left out of the likelihood.

    InputError for a penalty that is not quadratic.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.reml)
    >>> print(result.weight_sentence())
    Weight 1.549 (reml: largest restricted likelihood), formulation 'Tikhonov'.
    """
    if program.model.constrained and program.penalty_form is not None:
        weights = weight_grid(program)
        note = "points on a plane or sphere do not determine the weight: stated noise and scales are used"
        return Selection(1.0, "reml", weights, np.zeros(len(weights)), interior=False, note=note)

    require_linear(program, "reml")
    model, form = program.squared, program.ridge
    frames = model.parameters.placed
    if frames.any() and not frames.all():
        form = ridge(model, robot_alone(program.penalty_form or identity(len(frames)), frames))
    beta2, s2, perp = form.filters
    m = model.equations - form.unpenalized

    def score(weights: Array) -> Array:  # -2 ln(restricted likelihood), up to a constant
        g = weights[:, None] / (s2 + weights[:, None])
        return m * np.log(np.maximum(g @ beta2 + perp, np.finfo(float).tiny)) - np.sum(np.log(g), axis=1)

    chosen = linear_rule(program, "reml", score, "largest restricted likelihood", local=True)
    if chosen.interior or chosen.weight < 1.0:
        return chosen
    note = "the data do not determine the scale of the deviations: stated noise and scales are used"
    return replace(chosen, weight=1.0, note=note)


@on_inliers
def gcv(program: Program) -> Selection:
    """Choose by generalized cross-validation: minimize rho(w) / (m - dof(w))^2 (Golub, Heath and Wahba 1979).

    rho = |A z - b|^2, dof = sum s_i^2 / (s_i^2 + w). InputError for a penalty that is not quadratic.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.gcv)
    >>> f"{result.weight:.2g}", result.selection.interior
    ('1', True)
    """

    def score(weights: Array) -> Array:
        rho, freedom = program.ridge.misfits(weights)
        left = program.squared.equations - freedom
        return np.where(left > 0, rho / np.maximum(left, 1e-300) ** 2, np.inf)  # useless without degrees of freedom

    return linear_rule(program, "gcv", score, "smallest generalized cross-validation error")


DISCREPANCY = 1.1
"""Factor by which the residual norm may exceed the one that the stated noise implies."""


@on_inliers
def discrepancy(program: Program) -> Selection:
    """Choose the largest weight whose misfit agrees with the stated noise (Morozov 1966).

    rho(w) <= tau^2 (m - dof(w)), with tau = 1.1: with tau = 1 one data set in two would fit at no weight. InputError
    for a penalty that is not quadratic.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.discrepancy)
    >>> f"{result.weight:.2g}", result.selection.note
    ('28', 'residual norm 1.1 times that of the stated noise')
    """

    def score(weights: Array) -> Array:  # ln(rho / (tau^2 (m - dof)))
        rho, freedom = program.ridge.misfits(weights)
        left = program.squared.factor * DISCREPANCY**2 * np.maximum(program.squared.equations - freedom, 1e-9)
        return np.log(np.maximum(rho, np.finfo(float).tiny) / left)

    note = f"residual norm {DISCREPANCY:g} times that of the stated noise"
    chosen = linear_rule(program, "discrepancy", score, note)
    fits = np.flatnonzero(chosen.score <= 0)
    weights = chosen.weights
    if not len(fits):
        why = (
            "no weight fits as well as the stated noise implies: the noise is stated too small, or the model "
            "lacks an effect"
        )
        return replace(chosen, weight=float(weights[0]), interior=False, note=why)
    k = int(fits[-1])
    if k == len(weights) - 1:
        why = "every weight fits better than the stated noise implies: the noise is stated too large"
        return replace(chosen, weight=float(weights[k]), interior=False, note=why)
    # between the largest weight that fits and the next one, where the score crosses zero
    share = chosen.score[k] / (chosen.score[k] - chosen.score[k + 1])
    weight = float(np.exp(np.log(weights[k]) + share * np.log(weights[k + 1] / weights[k])))
    return replace(chosen, weight=weight, interior=True, note=note)


@on_inliers
def quasi_optimality(program: Program) -> Selection:
    """Choose where the solution changes least with the weight: minimize |w dz/dw| (Tikhonov and Glasko 1965).

    The lowest minimum inside the grid, if there is one. InputError for a penalty that is not quadratic.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, weight=ro.quasi_optimality)
    >>> f"{result.weight:.1g}", result.selection.interior
    ('5e-06', True)
    """

    def score(weights: Array) -> Array:
        beta2, s2, _ = program.ridge.filters
        return np.sum((weights[:, None] ** 2 * s2 * beta2) / (s2 + weights[:, None]) ** 4, axis=1)

    return linear_rule(program, "quasi_optimality", score, "least change of the solution", local=True)


RULES = (reml, gcv, discrepancy, quasi_optimality)
