"""Selectors that predict configurations held out, all equations of one together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.program import Program
from rpim_opt.convex.select_curve import l_curve
from rpim_opt.convex.select_linear import Rule, Squared, influence, linear_rule
from rpim_opt.convex.selection import Score, Selection, edge, weight_grid, with_rows


def leave_one_out(program: Program) -> Selection:
    """Choose by leaving every configuration out once and predicting it, all its equations together.

    For a linear estimator in closed form, r_g^- = (1 - H_gg)^-1 r_g with H = A (A'A + w)^-1 A' (Allen 1974; by blocks);
    for others by solving, on fewer weights.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.leave_one_out)
    >>> f"{result.weight:.2g}", result.selection.interior
    ('0.96', True)
    """
    with_rows(program, "leave_one_out")
    form = program.loss_form
    mixed = form is not None and not form.diagonal  # a square then belongs to no configuration
    if mixed or not program.closed_form:
        return _held_out(program, "leave_one_out", None)

    def of(squared: Squared) -> Score:
        Q, s2, target = influence(squared)
        group = squared.model.group
        rows = [np.flatnonzero(group == g) for g in np.unique(group)]

        def score(weights: Array) -> Array:
            total = np.zeros(len(weights))
            filters = s2 / (s2 + weights[:, None])
            residual = target - (filters * (Q.T @ target)) @ Q.T
            for k in rows:
                H = np.einsum("ip,wp,jp->wij", Q[k], filters, Q[k], optimize=True)
                left = np.linalg.pinv(np.eye(len(k)) - H)
                total += np.sum(np.einsum("wij,wj->wi", left, residual[:, k]) ** 2, axis=1)
            return total

        return score

    return linear_rule(program, Rule("leave_one_out", of, "smallest error of configurations left out one by one"))


def k_fold(program: Program, folds: int = 10, seed: int = 0) -> Selection:
    """Choose by cross-validation in folds that keep configurations whole (Stone 1974); any formulation.

    Parameters
    ----------
    program
        The formulation on a linear model.
    folds
        In how many parts the configurations are divided.
    seed
        Of the division.

    Raises
    ------
    InputError
        For fewer configurations than folds, or a formulation without penalty.

    Examples
    --------
    >>> from functools import partial
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=partial(ro.k_fold, folds=5))
    >>> f"{result.weight:.2g}", result.selection.interior
    ('0.93', True)
    """
    groups = np.unique(with_rows(program, "k_fold").group)
    if len(groups) < folds:
        raise InputError("selector k_fold", f"{len(groups)} configurations", f"at least {folds}, or fewer folds")
    parts = np.array_split(np.random.default_rng(seed).permutation(groups), folds)
    return _held_out(program, "k_fold", parts)


def _held_out(program: Program, name: str, parts: Sequence[np.ndarray] | None) -> Selection:
    count = 24  # where each is a solver's run a part
    if program.closed_form:
        count = 200
    weights = weight_grid(program, count)
    score = held_out_error(program, weights, parts)
    best = int(np.argmin(score))
    interior = 0 < best < len(weights) - 1
    note = "smallest error of configurations held out"
    if not interior:
        note = edge(best)
    return Selection(float(weights[best]), name, weights, score, interior, note)


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
    coarse = np.geomspace(start, 1e-10 * start, 30)
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


def held_out_error(program: Program, weights: Array, parts: Sequence[np.ndarray] | None = None) -> Array:
    """Root mean square of the whitened residual of held-out configurations, predicted from all the others.

    ``parts`` are the configurations that are held out together; each one alone by default. A robust loss judges
    the median of the configurations' norms instead: a blunder held out is not an error of the prediction.
    """
    model = program.model
    if len(np.unique(model.group)) < 2:
        raise InputError("data", "one configuration", "two or more to hold one out")
    if parts is None:
        parts = list(np.unique(model.group)[:, None])
    norms = np.hstack([_held_out_norms(program, weights, np.isin(model.group, part)) for part in parts])
    if program.loss_form is None:
        return np.median(norms, axis=1)
    return np.sqrt(np.sum(norms**2, axis=1) / len(model.b))


def _held_out_norms(program: Program, weights: Array, out: np.ndarray) -> Array:
    """Return the norms (K, configurations) of the residuals of rows that had no say in the estimates."""
    model = program.model
    others = program.on(model.scaled(np.where(out, 0.0, 1.0)))
    Z = np.array([estimate.z for estimate in others.path(weights)])
    squares = (Z @ model.A[out].T - model.b[out]) ** 2
    group = model.group[out]
    return np.sqrt(np.stack([squares[:, group == k].sum(1) for k in np.unique(group)], axis=1))
