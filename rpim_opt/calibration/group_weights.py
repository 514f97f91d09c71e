"""Several weights: a calibration at weight 1 whose scales hold them, alternated with their choice until both rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.bayes.group_weights import Grouped, GroupSelector, Members, members, rule_of
from rpim_opt.bayes.prior import Prior
from rpim_opt.bayes.prior_terms import Stated
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.weighed import calibrated
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.program import pose
from rpim_opt.convex.rules.selection import Selection
from rpim_opt.problem.linear import LinearModel
from rpim_opt.problem.registration.frames import relocated
from rpim_opt.problem.source import Source
from rpim_opt.robot.parameters import Parameters

SAME, NEARLY = 1e-3, 1e-2
"""Weights have settled when their logarithms change by no more than the first; than the second nobody hears of it."""
PATIENCE = 12
"""How often they are chosen anew."""


@dataclass(frozen=True, eq=False)
class Weighing:
    """What stays the same while weights are sought: what was asked, and in which scales.

    Parameters
    ----------
    formulation
        As it was asked.
    weights
        The groups of the identified parameters.
    stated
        What a prior says of them, in units of their scales without weights.
    how
        Options of `calibrate`.
    """

    formulation: Formulation
    weights: Members
    stated: Stated
    how: Mapping[str, Any]

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
        formulation = Prior().penalized(self.formulation, self.stated.inside(size))
        return calibrated(weighted, formulation, 1.0, start=start, **self.how)

    def groups(self, linear: LinearModel, t: Array) -> Grouped:
        """Return the squares that a calibration ended at, in the scales without weights."""
        root = self.root(t)
        widths = self.stated.scale
        free = replace(linear.parameters, scale=linear.parameters.scale * root)
        return Grouped(
            replace(linear, A=linear.A * root, parameters=free),
            np.where(self.stated.replaced, 0.0, self._own(linear)),
            self.stated.centre / widths,
            self.stated.rows * widths,
            self.stated.values,
            *self.weights,
        )

    def _own(self, linear: LinearModel) -> Array:
        """Return how the formulation's own penalty weighs squared deviations (n,)."""
        form = pose(self.formulation, linear).penalty_form
        if form is None or form.c.any() or not form.diagonal:
            found = f"formulation '{self.formulation.name}'"
            raise InputError("weight", found, "numbers for its groups, or a penalty that sums squared deviations")
        return form.L**2


def grouped(
    problem: Source,
    formulation: Formulation,
    weights: Mapping[str, Any],
    *,
    prior: Prior | None = None,
    start: Array | None = None,
    **how: Any,
) -> Calibration:
    """Identify the parameters of a problem with a weight for each group of them.

    The weight w of a group stands in its scales, S / sqrt(w), and the program is solved at weight 1: constraints that
    count in scales count in these. Weights that are to be chosen are chosen from the last linearization, and the
    problem is calibrated anew with them, until they are their own answer.

    Parameters
    ----------
    problem
        What was measured, and what is to be identified.
    formulation
        The convex program of a pass; with a selector its penalty has to sum squared deviations.
    weights
        From patterns, names or kinds of parameters to a number, or to ``ro.reml``, ``ro.k_fold``, ``ro.l_curve`` (here
        the distance to the origin of the L-hypersurface) or its name. What no key names has weight 1.
    prior
        The prior besides: its centre, widths and statements.
    start, how
        As for `calibrate`.

    Raises
    ------
    InputError
        For keys that name nothing or a parameter twice, and for different selectors.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> from rpim_opt.calibration.group_weights import grouped
    >>> result = grouped(ro.load("position").problem, ro.tikhonov, {"alpha? theta?": ro.reml, "a? d?": 3.0})
    >>> print(result.weight_sentence())
    Weights ...
    """
    if formulation.penalty is None:
        raise InputError("weight", f"weights for formulation '{formulation.name}'", "one with a penalty")
    rule = rule_of(weights)
    notes: list[str] = []
    if start is None:
        elsewhere = relocated(problem)
        if elsewhere is not None:
            problem = elsewhere
            notes.append("Frames were stated far from where the data put them; their deviations count from there.")
    belief = (prior or Prior()).stated(problem.parameters, widened=False)
    weighing = Weighing(formulation, members(problem.parameters.free, weights), belief, how)
    t = np.zeros(len(weighing.weights.names))
    result = weighing.solved(problem, t, start)
    selection = _given(weighing.weights)
    if rule is not None:
        result, selection, note = _alternated(weighing, problem, rule, result)
        notes.insert(0, note)
    again = partial(
        _again, parameters=problem.parameters, formulation=formulation, weights=weights, prior=prior, how=how
    )
    message = " ".join(filter(None, [result.message, *notes]))
    return replace(result, selection=selection, message=message, asked=again)


def _alternated(
    weighing: Weighing, problem: Source, rule: GroupSelector, result: Calibration
) -> tuple[Calibration, Selection, str]:
    """Choose the weights and calibrate in turn; return the calibration, the choice, and what there is to say of it."""
    t = np.zeros(len(weighing.weights.names))
    change = np.inf
    selection = rule(weighing.groups(result.linear, t))
    for _ in range(PATIENCE):
        answer = np.log([selection.groups[name] for name in weighing.weights.names])
        change = float(np.max(np.abs(answer - t)))
        if change <= SAME:
            break
        t = answer
        result = weighing.solved(problem, t, result.x)
        selection = rule(weighing.groups(result.linear, t))
    used = dict(zip(weighing.weights.names, np.exp(t).tolist(), strict=True))
    note = ""
    if change > NEARLY:
        note = f"The weights of groups did not settle in {PATIENCE} rounds: the last ones are used."
    return result, replace(selection, groups={**selection.groups, **used}), note


def _given(weights: Members) -> Selection:
    return Selection(1.0, "given by group", np.zeros(0), np.zeros(0), True, "as stated", weights.told)


def _again(problem: Source, *, parameters: Parameters, how: Mapping[str, Any], **asked: Any) -> Calibration:
    """Ask the same of other rows, whose parameters have the weights in their scales."""
    return grouped(problem.with_parameters(parameters), **asked, **how)
