"""A calibration at one weight, or with one selector, over the scales that a problem states."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.calibration.certificate import Certificate
from rpim_opt.calibration.loop import ROUNDS, Ended, Options, State, minimize
from rpim_opt.calibration.result import Calibration
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.select import Selector
from rpim_opt.problem.blocks import Source

LEVEL = 1e-9
"""Relative fall of the objective over five iterations below which it hardly changes."""
FAR = 1000.0
"""Deviations in prior standard deviations beyond which a fit without a penalty is called divergent."""
DIVERGES = "poorly identifiable combinations diverge without a penalty"


def calibrated(
    problem: Source,
    formulation: Formulation,
    weight: float | str | Selector,
    *,
    start: Array | None = None,
    options: Options,
) -> Calibration:
    """Return the calibration; arguments as for `calibrate`, start (n,) [SI]."""
    ended = minimize(problem, formulation, weight, start, options)
    choice = ended.state.choice
    again = replace(options, progress=None)
    return Calibration(
        problem=problem,
        formulation=formulation,
        x=ended.x,
        weight=choice.weight,
        selection=choice.selection,
        converged=ended.converged,
        message=ending(ended, options.max_iterations),
        history=ended.state.history,
        program=ended.state.program,
        certificate=ended.certificate,
        asked=partial(calibrated, formulation=formulation, weight=weight, options=again),
    )


def ending(ended: Ended, most: int) -> str:
    """Say how the loop ended, and why."""
    state = ended.state
    count = len(state.history)
    iterations = f"{count} iterations" if count != 1 else "1 iteration"
    if not ended.settled:
        what = "the positions that constraints bound still change; give a larger weight"
        return f"Not converged: after {ROUNDS} rounds {what}."
    if ended.converged and ended.rounds > 1:
        return f"Converged after {iterations} in {ended.rounds} rounds, positions linear about the solution."
    if ended.converged:
        text = f"Converged after {iterations}."
        if state.choice.weight == 0 and np.abs(state.z).max(initial=0.0) > FAR:
            text += f" Deviations exceed {FAR:g} prior standard deviations: {DIVERGES}; add one."
    elif state.outcome == "rest":
        text = f"Not converged: {uncertified(ended.certificate)}"
    elif state.outcome == "stuck":
        text = (
            "Not converged: no step lowers the nonlinear objective, however short; "
            "the formulation may have no minimum here, or the start is far away."
        )
    else:
        text = f"Not converged: {unfinished(state, most)}"
    return " ".join(filter(None, [text, state.choice.note]))


def uncertified(certificate: Certificate) -> str:
    """Say why a loop at rest has not converged."""
    if certificate.decrease is None:
        return "the convex program at the end could not be solved again, so that the solution is not certified."
    if certificate.decrease > 1e-6:
        return (
            f"the convex program at the end still predicts a decrease by {certificate.decrease:.1g} of the objective."
        )
    return f"the constraints are violated by {certificate.violation:.1g} scales."


def unfinished(state: State, most: int) -> str:
    """Say what the loop was doing when its iterations ran out."""
    iterations = f"{most} iterations were" if most != 1 else "1 iteration was"
    last = [iteration.objective for iteration in state.history[-5:]]
    if len(last) == 5 and last[0] - last[-1] <= LEVEL * abs(last[-1]):
        hardly = "though the objective hardly changes: the data hardly determine the solution; use a larger weight."
        return f"{iterations} not enough, {hardly}"
    if state.choice.weight == 0 and most > 1:
        return f"{iterations} not enough: {DIVERGES}; add one."
    return f"{iterations} not enough; allow more (max_iterations)."
