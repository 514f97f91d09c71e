"""Several weights: a calibration at weight 1 whose scales hold them, alternated with their choice until both settle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.bayes.group_weights import Grouped, Members, members, rule_of
from rpim_opt.bayes.prior import Prior
from rpim_opt.bayes.prior_terms import Stated
from rpim_opt.calibration.at_weight import calibrated
from rpim_opt.calibration.loop import Options
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.program import pose
from rpim_opt.convex.rules.selection import Selection
from rpim_opt.problem.blocks import Source
from rpim_opt.problem.linear import LinearModel
from rpim_opt.problem.registration.frames import relocated
from rpim_opt.robot.parameters import Parameters

SAME, NEARLY = 1e-3, 1e-2
"""Weights have settled when their logarithms change by no more than the first; a note is given above the second."""
MOST_ROUNDS = 12
"""How often they are chosen anew."""


@dataclass(frozen=True, eq=False)
class Weighing:
    """What stays the same while weights of groups are chosen; ``stated`` is what a prior says, in unweighted scales."""

    formulation: Formulation
    weights: Members
    stated: Stated
    options: Options

    def root(self, t: Array) -> Array:
        """Return the roots (n,) of the parameters' weights at logarithms t (G,) of those of the groups."""
        values = self.weights.given.copy()
        chosen = self.weights.member >= 0
        values[chosen] = np.exp(t)[self.weights.member[chosen]]
        return np.sqrt(values)

    def solved(self, problem: Source, t: Array, start: Array | None) -> Calibration:
        """Return the calibration of a problem (without weights in its scales) at weight 1 with those weights."""
        size = self.stated.scale / self.root(t)
        table = problem.parameters
        scale = table.scale.copy()
        scale[table.identified] *= size
        weighted = problem.with_parameters(replace(table, scale=scale))
        formulation = self.stated.inside(size).penalized(self.formulation)
        return calibrated(weighted, formulation, 1.0, start=start, options=self.options)

    def groups(self, linear: LinearModel, t: Array) -> Grouped:
        """Return the squares that a calibration ended at, in the scales without weights."""
        root = self.root(t)
        widths = self.stated.scale
        linear = replace(
            linear, A=linear.A * root, parameters=replace(linear.parameters, scale=linear.parameters.scale * root)
        )
        form = pose(self.formulation, linear).penalty_form
        if form is None or form.c.any() or not form.diagonal:
            found = f"formulation '{self.formulation.name}'"
            raise InputError("weight", found, "numbers for its groups, or a penalty that sums squared deviations")
        return Grouped(
            linear,
            np.where(self.stated.replaced, 0.0, form.L**2),
            self.stated.centre / widths,
            self.stated.rows * widths,
            self.stated.values,
            *self.weights,
        )


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
    rule = rule_of(weights)
    found = members(problem.parameters.free, weights)
    notes: list[str] = []
    if start is None:
        elsewhere = relocated(problem)
        if elsewhere is not None:
            problem = elsewhere
            notes.append("Frames were stated far from where the data put them; their deviations count from there.")
    stated = (prior or Prior()).stated(problem.parameters, widened=False)
    weighing = Weighing(formulation, found, stated, options)
    t = np.zeros(len(found.names))
    result = weighing.solved(problem, t, start)
    selection = Selection(1.0, "given by group", np.zeros(0), np.zeros(0), True, "as stated", found.told)
    if rule is not None:
        change = np.inf
        selection = rule(weighing.groups(result.linear, t))
        for _ in range(MOST_ROUNDS):
            answer = np.log([selection.groups[name] for name in found.names])
            change = float(np.max(np.abs(answer - t)))
            if change <= SAME:
                break
            t = answer
            result = weighing.solved(problem, t, result.x)
            selection = rule(weighing.groups(result.linear, t))
        used = dict(zip(found.names, np.exp(t).tolist(), strict=True))
        selection = replace(selection, groups={**selection.groups, **used})
        if change > NEARLY:
            notes.insert(0, f"The weights of groups did not settle in {MOST_ROUNDS} rounds: the last ones are used.")
    how = {"formulation": formulation, "weights": weights, "prior": prior, "options": replace(options, progress=None)}
    again = partial(_again, table=problem.parameters, **how)
    return replace(result, selection=selection, message=" ".join([result.message, *notes]), asked=again)


def _again(problem: Source, *, table: Parameters, **how: Any) -> Calibration:
    """Ask the same of other rows; the parameters of a result have the weights in their scales."""
    return grouped(problem.with_parameters(table), **how)
