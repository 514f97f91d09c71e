"""Selectors that predict configurations held out, all equations of one together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.left_out import Folds, by_their_say, of_squares, solved_again
from rpim_opt.convex.newton_step import NewtonStep
from rpim_opt.convex.program import Program
from rpim_opt.convex.select_curve import l_curve
from rpim_opt.convex.select_linear import Rule, Squared, influence, linear_rule, penalty_of
from rpim_opt.convex.selection import Score, Selection, edge, searched, weight_grid, with_rows

Predicted = Callable[[Array], Array]
"""From weights (K,) to the norms (K, N) of the residuals of left-out configurations."""
SOME = 6
"""Configurations that are left out by solving, to see how far off Newton's steps are."""
OFF = 0.05
"""Error of Newton's steps, relative, from which a choice says so."""


def leave_one_out(program: Program, exact: bool = False) -> Selection:
    """Choose by leaving every configuration out once and predicting it, all its equations together.

    For a linear estimator in closed form, r_g^- = (1 - H_gg)^-1 r_g with H = A (A'A + w)^-1 A' (Allen 1974; by blocks).
    For others by one Newton step each from the estimate of all (approximate leave-one-out; Wang et al. 2018); some
    configurations are left out by solving, too, and the note says how far off the steps are. Where there is no such
    step (minimax, a penalty without curvature) all are solved.

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
        return linear_rule(
            program, Rule("leave_one_out", _of_squares, "smallest error of configurations left out one by one")
        )
    if exact or not NewtonStep(program).serves:
        return _held_out(program, "leave_one_out", None, exact)
    predicted = _by_steps(program)
    weights, score, best = searched(lambda weights: _error(program, predicted(weights)), weight_grid(program, COARSE))
    interior = 0 < best < len(weights) - 1
    note = f"smallest error of configurations left out one by one, {_how_exact(program, weights[best])}"
    if not interior:
        note = edge(best)
    return Selection(float(weights[best]), "leave_one_out", weights, score, interior, note)


def _of_squares(squared: Squared) -> Score:
    return of_squares(*influence(squared), squared.model.group)


def _by_steps(program: Program) -> Predicted:
    """Return what predicts every configuration by one Newton step."""
    step = NewtonStep(program)
    return lambda weights: np.array([step.norms(estimate) for estimate in program.path(weights, rough=True)])


def _how_exact(program: Program, weight: float) -> str:
    """Say how far off Newton's steps are, from some configurations that are solved without."""
    configurations = np.unique(program.model.group)
    norms = _by_steps(program)(np.array([weight]))[0]
    order = np.argsort(norms)  # from the best predicted to the worst
    some = order[np.linspace(0, len(order) - 1, min(SOME, len(order))).astype(int)]
    there = solved_again(program, np.array([weight]), [configurations[[k]] for k in some])[0]
    off = float(np.linalg.norm(norms[some] - there) / max(np.linalg.norm(there), np.finfo(float).tiny))
    text = f"by one Newton step each ({100 * off:.2g} % off in {len(some)} that were solved)"
    if off > OFF:
        text += "; exact=True solves all"
    return text


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


def _division(groups: np.ndarray, parts: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return parts that have each of some configurations once, without those that the program does not have."""
    kept = [np.intersect1d(part, groups) for part in parts]
    kept = [part for part in kept if len(part)]
    if len(kept) < 2 or not np.array_equal(np.sort(np.concatenate(kept)), groups):
        found = f"{len(kept)} that have {sum(map(len, kept))} of {len(groups)} configurations"
        raise InputError("selector k_fold, parts", found, "two or more, with every configuration in one of them")
    return kept


AHEAD = 5
"""Weights at which the residual is asked for at once, where each takes solving."""
COARSE = 12
"""Weights with which a search for the least error begins, where each takes solving."""


def _held_out(program: Program, name: str, parts: Sequence[np.ndarray] | None, exact: bool = False) -> Selection:
    if program.closed_form:
        weights = weight_grid(program)
        score = held_out_error(program, weights, parts)
        best = int(np.argmin(score))
    else:
        grid = weight_grid(program, COARSE)
        quickly = parts is None and not exact
        error = _quickly(program) if quickly else _error_of_folds(program, parts)
        weights, score, best = searched(error, grid)
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
    last = 1e-10 * start
    if program.faces is not None:
        last = max(last, min(start, weight_grid(program, 2)[0]))
    coarse = np.geomspace(start, last, 30)
    level = _end_of_fall(program, coarse)
    fine = level * np.linspace(0.563 / 3.063, 5.063 / 3.063, 10)
    score = _left_out_error(program, fine)
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
    some = len(weights)
    if not program.closed_form:
        some = AHEAD
    residual = np.empty(0)
    near = None
    while len(residual) < len(weights):
        more = program.path(weights[len(residual) : len(residual) + some], near, rough=True)
        near = more[-1].z
        residual = np.append(residual, np.sqrt([estimate.loss for estimate in more]))
        flat = residual[1:] >= 0.99 * residual[:-1]
        if flat.any():
            return float(weights[np.argmax(flat)])
    return float(weights[0])


def _left_out_error(program: Program, weights: Array) -> Array:
    """Return `held_out_error` of configurations left out one by one, without solving for each where that can be."""
    return _quickly(program)(weights)


def _quickly(program: Program) -> Score:
    """Return what gives `held_out_error` of configurations left out one by one.

    By formula, or by Newton's steps. Where there are none, those that have no say in a loss of norms (minimax) are not
    asked.
    """
    if program.closed_form and program.squared_rows:
        squares = _of_squares(Squared(program.squared, penalty_of(program), program.ridge))
        return lambda weights: np.sqrt(squares(weights) / len(program.model.b))
    if not program.closed_form and NewtonStep(program).serves:
        predicted = _by_steps(program)
        return lambda weights: _error(program, predicted(weights))
    over_norms = program.formulation.loss_over == "configuration" and program.loss_form is None
    if over_norms and not program.inner and not np.isfinite(program.formulation.largest):
        return lambda weights: _error(program, by_their_say(program, weights))
    return _error_of_folds(program, None)


def held_out_error(program: Program, weights: Array, parts: Sequence[np.ndarray] | None = None) -> Array:
    """Root mean square of the whitened residual of held-out configurations, predicted from all the others.

    ``parts`` are the configurations that are held out together; each one alone by default. A robust loss judges
    the median of the configurations' norms instead: a blunder held out is not an error of the prediction.
    """
    return _error_of_folds(program, parts)(weights)


def _error_of_folds(program: Program, parts: Sequence[np.ndarray] | None) -> Score:
    """Return what gives `held_out_error`."""
    groups = np.unique(program.model.group)
    if len(groups) < 2:
        raise InputError("data", "one configuration", "two or more to hold one out")
    if parts is None:
        parts = list(groups[:, None])
    folds = Folds(program, parts)
    return lambda weights: _error(program, folds.norms(weights))


def _error(program: Program, norms: Array) -> Array:
    """Return what left-out norms (K, N) amount to: (K,)."""
    if program.loss_form is None:
        return np.median(norms, axis=1)
    return np.sqrt(np.sum(norms**2, axis=1) / len(program.model.b))
