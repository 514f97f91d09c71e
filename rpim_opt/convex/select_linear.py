"""Rules for estimators that are linear in the data: each is the least of a score of the weight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.program import Program
from rpim_opt.convex.quadratic import Ridge, ridge
from rpim_opt.convex.selection import Score, Selection, edge, grid_of, least_between
from rpim_opt.convex.structure import Quadratic, identity
from rpim_opt.problem.linear import LinearModel


@dataclass(frozen=True, eq=False)
class Squared:
    """What a linear rule sees: equations, penalty, and their closed form."""

    model: LinearModel
    penalty: Quadratic
    form: Ridge

    @property
    def spare(self) -> int:
        """Equations besides those that the directions without penalty take."""
        return self.model.equations - self.form.fixed


def _squared(program: Program, weight: float) -> Squared:
    """Return the squares that a program amounts to: its own, or those that a robust loss trusts at a weight."""
    penalty = penalty_of(program)
    if program.quadratic:
        return Squared(program.squared, penalty, program.ridge)
    model = program.trusted(program.path([weight], rough=True)[0].z)
    return Squared(model, penalty, ridge(model, penalty))


def penalty_of(program: Program) -> Quadratic:
    """Return the squared penalty of a program, |z|^2 where it has none."""
    return program.penalty_form or identity(program.model.A.shape[1])


@dataclass(frozen=True)
class Rule:
    """A score of the weight that is least at the choice; with ``local`` an interior minimum goes before an edge."""

    name: str
    score: Callable[[Squared], Score]
    note: str
    local: bool = False


def linear_rule(program: Program, rule: Rule) -> Selection:
    """Minimize a score of the linear estimator over a grid from the singular values, refined between its points.

    With a robust loss the estimator is that of what it trusts (`Program.trusted`), found by iteration.
    """
    if program.penalty_form is None:
        found = f"formulation '{program.formulation.name}'"
        accepted = "a quadratic penalty, whose solutions are linear in the data; l_curve, corner or k_fold serve any"
        raise InputError(f"selector {rule.name}", found, accepted)
    weight = 1.0
    chosen = _least(rule, _squared(program, weight))
    if program.quadratic:
        return chosen
    # what a robust loss trusts depends on the weight; six rounds end within 2 %, or go on in the next linearization
    for _ in range(5):
        if abs(np.log(chosen.weight / weight)) < 0.02:
            break
        weight = chosen.weight
        chosen = _least(rule, _squared(program, weight))
    return chosen


def _least(rule: Rule, squared: Squared) -> Selection:
    """Return the choice of a rule for given squares."""
    weights = grid_of(squared.form)
    score_at = rule.score(squared)
    score = score_at(weights)
    best = _lowest(score, rule.local)
    if not 0 < best < len(weights) - 1:
        return Selection(float(weights[best]), rule.name, weights, score, False, edge(best))
    weight, _ = least_between(score_at, weights, best)
    return Selection(weight, rule.name, weights, score, True, rule.note)


def _lowest(score: Array, local: bool) -> int:
    if local:
        valleys = np.flatnonzero((score[1:-1] <= score[:-2]) & (score[1:-1] < score[2:])) + 1
        if len(valleys):
            return int(valleys[np.argmin(score[valleys])])
    return int(np.argmin(score))


def influence(squared: Squared) -> tuple[Array, Array, Array]:
    """Return Q (m, p), s^2 (p,) and the values y (m,) with influence matrix Q diag(s^2 / (s^2 + weight)) Q'.

    Directions that the penalty leaves free stand beside the others with infinite s^2, and y is measured from the
    penalty's centre.
    """
    model, form = squared.model, squared.form
    Q, Q_free = form.hat_rows(model.A)
    s2 = np.concatenate([form.s[form.seen] ** 2, np.full(form.fixed, 1e300)])
    return np.hstack([Q, Q_free]), s2, model.b - model.A @ form.offset
