"""Selection rules by cross-validation over whole configurations: leave-one-out, k-fold, the paper's two steps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.program import Program
from rpim_opt.convex.rules.curve import l_curve
from rpim_opt.convex.rules.scores import linear_rule
from rpim_opt.convex.rules.selection import (
    Score,
    Selection,
    choice,
    on_inliers,
    searched,
    solved,
    weight_grid,
    with_rows,
)

PARTS = 100
"""Number of parts that are held out in turn if each has to be solved: configurations, or parts of more of them."""
COARSE, FOLDS = 12, 10
"""Initial weights of a search for the least error if each has to be solved, and the folds that locate it."""
ASIDE = 1e-3
"""Constant residual of held-out rows, in units of the noise, for a loss that is no sum over rows. At zero, where norms
and the loss's own variables are all non-smooth at once, an interior-point method stalls."""
DROPPED = 1e-13
"""Added to 1 - H_gg: a configuration for which that is smaller is determined by no other one."""


@on_inliers
def leave_one_out(program: Program) -> Selection:
    """Choose by leave-one-out cross-validation of whole configurations.

    For a linear estimator in closed form, r_g^- = (1 - H_gg)^-1 r_g with H = A (A'A + w)^-1 A' (Allen 1974; by blocks).
    With constraints, another penalty or another loss the program is solved without each configuration, or without each
    of 100 parts if there are more. InputError for a single configuration, or without penalty.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=ro.leave_one_out)
    >>> f"{result.weight:.2g}", result.selection.interior
    ('0.96', True)
    """
    with_rows(program, "leave_one_out")
    form = program.loss_form
    mixed = form is not None and not form.diagonal  # squares are then not those of single configurations
    if program.closed_form and not mixed:
        return linear_rule(program, "leave_one_out", _of_squares(program), "smallest leave-one-out error")
    begin = held_out_error(program, _drawn(program, FOLDS))
    return _least(program, "leave_one_out", "smallest leave-one-out error", held_out_error(program), begin)


@on_inliers
def k_fold(program: Program, folds: int = FOLDS, seed: int = 0, parts: Sequence[np.ndarray] | None = None) -> Selection:
    """Choose by cross-validation in folds that keep configurations whole (Stone 1974); any formulation.

    ``folds`` parts are drawn with ``seed``; or ``parts`` has the numbers (k,) of the configurations held out together,
    each in exactly one part: `Dataset.by_session` returns those of every session. InputError for fewer configurations
    than folds, parts that do not partition them, or a formulation without penalty.

    >>> from functools import partial
    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("position").problem, ro.tikhonov, weight=partial(ro.k_fold, folds=5))
    >>> f"{result.weight:.2g}", result.selection.interior
    ('0.93', True)
    """
    note = "smallest k-fold cross-validation error"
    groups = np.unique(with_rows(program, "k_fold").group)
    if parts is not None:
        present = [each for each in (np.intersect1d(part, groups) for part in parts) if len(each)]
        if len(present) < 2 or not np.array_equal(np.sort(np.concatenate(present)), groups):
            found = f"{len(present)} parts with {sum(map(len, present))} of {len(groups)} configurations"
            raise InputError("selector k_fold, parts", found, "two or more, with every configuration in exactly one")
        return _least(program, "k_fold", note, held_out_error(program, present))
    if len(groups) < folds:
        raise InputError("selector k_fold", f"{len(groups)} configurations", f"at least {folds}, or fewer folds")
    return _least(program, "k_fold", note, held_out_error(program, _drawn(program, folds, seed)))


@on_inliers
def two_step(program: Program) -> Selection:
    """Choose by the paper's two steps: a coarse L-curve, then held-out error (section III B and Figs. 7 to 10).

    1. From the corner down, 30 weights over ten decades. The residual norm falls with the weight, so its
       minimum is always the smallest weight; what the paper reads off its Fig. 7 is where the decrease ends:
       the first weight from which one more step lowers the residual norm by less than 1 %.
    2. Ten weights within the same order of magnitude, 0.184 to 1.653 times that (the paper's 0.563e-14 to
       5.063e-14 around 3.063e-14), compared by held-out error, with every configuration held out once.

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
    residual = np.sqrt([each.loss if each else np.nan for each in solved(program, coarse)])
    flat = np.flatnonzero(residual[1:] >= 0.99 * residual[:-1])
    level = float(coarse[flat[0] if len(flat) else 0])
    fine = level * np.linspace(0.563 / 3.063, 5.063 / 3.063, 10)
    if program.closed_form and program.squared is program.model:
        score = np.sqrt(_of_squares(program)(fine) / len(program.model.b))
    else:
        score = held_out_error(program, _drawn(program, FOLDS))(fine)
    note = "two steps: coarse L-curve, then held-out error"
    edge = "; the held-out error is smallest at an edge of the ten weights, so a wider range of weights may be better"
    return choice("two_step", fine, score, int(np.nanargmin(score)), note, at_edge=note + edge)


def _least(program: Program, name: str, note: str, error: Score, begin: Score | None = None) -> Selection:
    """Return the choice of the least error of configurations held out; a cheaper one tells where to ``begin``."""
    if program.closed_form:
        weights = weight_grid(program)
        score = error(weights)
        best = int(np.argmin(score))
    else:
        weights, score, best = searched(error, weight_grid(program, COARSE), begin)
    return choice(name, weights, score, best, note)


# --- errors of what is left out --------------------------------------------------------------------------------


def _drawn(program: Program, count: int, seed: int = 0) -> list[np.ndarray]:
    """Return the configurations in so many parts at most, at random."""
    groups, place = np.unique(program.model.group, return_index=True)
    groups = groups[np.argsort(place)]  # in order of their rows: sums depend on the order
    return np.array_split(np.random.default_rng(seed).permutation(groups), min(count, len(groups)))


def held_out_error(program: Program, parts: Sequence[np.ndarray] | None = None) -> Score:
    """Return a function for the RMS (K,) of whitened residuals of held-out parts, predicted by solving without them.

    For a loss other than squares the median of their norms is judged: a held-out outlier is no error of the prediction.
    """
    model = program.model
    groups = np.unique(model.group)
    if len(groups) < 2:
        raise InputError("data", "one configuration", "two or more to hold one out")
    if parts is None:  # one per configuration, or fewer
        parts = list(groups[:, None]) if len(groups) <= PARTS else _drawn(program, PARTS)
    part_of = np.full(int(groups.max()) + 1, -1)
    for k, part in enumerate(parts):
        part_of[part] = k
    rows = [np.flatnonzero(part_of[model.group] == k) for k in range(len(parts))]

    loss = program.structure.loss
    aside = 0.0 if loss is None or loss.separable else ASIDE

    def without(out: np.ndarray) -> Program:
        factors, b = np.ones(len(model.group)), model.b.copy()
        factors[out], b[out] = 0.0, aside
        return program.on(model.scaled(factors).with_values(b))

    def error(weights: Array) -> Array:
        left = []
        for out in rows:
            estimates = solved(without(out), weights)
            Z = np.array([each.z if each else np.full(model.A.shape[1], np.nan) for each in estimates])
            squares = (Z @ model.A[out].T - model.b[out]) ** 2
            which = np.unique(model.group[out], return_inverse=True)[1]
            sums = np.zeros((which.max() + 1, len(weights)))
            np.add.at(sums, which, squares.T)
            left.append(sums)
        norms2 = np.vstack(left)  # of the held-out configurations, at every weight
        if program.loss_form is None:
            return np.median(np.sqrt(norms2), axis=0)
        return np.sqrt(np.sum(norms2, axis=0) / len(model.b))

    return error


def _of_squares(program: Program) -> Score:
    """Return the sums of squares (K,) of all held-out residuals of an estimator with influence Q diag(f) Q', by weight.

    With f = s^2 / (s^2 + weight) and the residuals r of the full fit, r_g^- = (1 - Q_g diag(f) Q_g')^-1 r_g.
    """
    form, model = program.ridge, program.squared
    s = form.s[form.identifiable]
    # directions without penalty are appended with infinite s^2
    s2 = np.concatenate([s**2, np.full(form.unpenalized, 1e300)])
    Q = model.A @ np.hstack([form.B[:, form.identifiable] / s, form.free])
    target = model.b - model.A @ form.offset
    projected = Q.T @ target
    _, which, count = np.unique(model.group, return_inverse=True, return_counts=True)
    order, first = np.argsort(which, kind="stable"), np.cumsum(count) - count
    # configurations of k equations together
    places = [order[first[count == k][:, None] + np.arange(k)] for k in np.unique(count).tolist()]

    def squares(weight: float) -> float:
        filters = s2 / (s2 + weight)
        residual = target - Q @ (filters * projected)
        total = 0.0
        for rows in places:
            M = (1 + DROPPED) * np.eye(rows.shape[1]) - (Q[rows] * filters) @ Q[rows].transpose(0, 2, 1)
            total += float(np.sum(np.linalg.solve(M, residual[rows][:, :, None]) ** 2))
        return total

    return lambda weights: np.array([squares(weight) for weight in weights])


RULES = (two_step, leave_one_out, k_fold)
"""These rules solve without parts of the configurations, which is slow without a closed form."""
