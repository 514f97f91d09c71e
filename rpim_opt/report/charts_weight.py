"""What is drawn of the weight: the L-curve, scores, choices of selectors, and what the data say at all."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.program import Program
from rpim_opt.convex.selection import Selection
from rpim_opt.report.chart import Axis, Chart, Dots, Line, Mark

VANISHED = 1e-4
"""Penalties below this part of the middle one are not drawn: a lasso has nothing left there."""
LEAST = 1e-4
"""Of what directions show [sigmas]; less is nothing."""


def l_curve_chart(residual: Array, solution: Array, chosen: Mapping[str, tuple[float, float]], own: str) -> Chart:
    """Return the L-curve: roots of loss and penalty (k,) over the weight, and the points of choices by what they say.

    The choice called ``own`` is the one that was taken.
    """
    shown = solution > VANISHED * float(np.median(solution))
    marks: list[Mark] = [Line(residual[shown], solution[shown], "ink")]
    others = {name: at for name, at in chosen.items() if name != own}
    if others:
        x, y = np.transpose(list(others.values()))
        marks.append(Dots(x, y, "other", "other selectors", list(others), each=True))
    if own in chosen:
        (x,), (y,) = np.transpose([chosen[own]])
        marks.append(Dots([x], [y], "mark", f"chosen: {own}", [f"chosen: {own}"], size="large"))
    across = Axis("root of the loss (residual norm) [sigmas]", (max(residual.min(), 1e-9), residual.max()), log=True)
    up = Axis("root of the penalty [scales]", (solution[shown].min(), solution.max()), log=True)
    return Chart("L-curve: misfit against size of the deviations", across, up, marks, height=330)


def score_chart(selection: Selection) -> Chart:
    """Return what a selector compared over the weights, and its choice, dashed where it is at an edge."""
    finite = np.isfinite(selection.score)
    weights = selection.weights[finite]
    score = selection.score[finite]
    every = [*weights, selection.weight]
    y = Axis(f"score of {selection.name}", (float(score.min()), float(score.max())))
    low, high = y.limits
    marks = [
        Line(weights, score, "ink"),
        Line([selection.weight] * 2, [low, high], "mark", f"weight {selection.weight:.3g}", not selection.interior),
    ]
    return Chart(
        f"Score of {selection.name} over the weight", Axis("weight", (min(every), max(every)), log=True), y, marks
    )


def choices_chart(chosen: Mapping[str, Selection]) -> Chart:
    """Return the weights that selectors choose, the largest on top; hollow: at an edge."""
    ordered = sorted(chosen.items(), key=lambda item: -item[1].weight)
    weight = np.array([each.weight for _, each in ordered])
    inside = np.array([each.interior for _, each in ordered])
    marks: list[Mark] = []
    for which, hollow, said in ((inside, False, ""), (~inside, True, "at an edge")):
        at = np.flatnonzero(which)
        hints = [f"{ordered[k][0]}: weight {weight[k]:.3g}" for k in at]
        if len(at):
            marks.append(Dots(weight[at], at + 1.0, "after", said, hints, hollow=hollow))
    names = [name for name, _ in ordered]
    x = Axis("weight", (weight.min(), weight.max()), log=True)
    return Chart("Weights that selectors choose", x, Axis("", names=names), marks, height=60 + 17 * len(names))


def picard_chart(program: Program, weight: float) -> Chart:
    """Return Picard's condition: singular values, what the data say along them, coefficients, the weight's root."""
    beta, s, _ = program.model.svd
    k = np.flatnonzero(s > 0)
    said = np.abs(beta[k])
    level = float(np.sqrt(weight))
    place = k + 1.0
    last = max(len(k), 2)
    hints = [f"direction {i + 1}: data {abs(beta[i]):.3g}, s {s[i]:.3g}" for i in k]
    ratio = [f"direction {i + 1}: coefficient {abs(beta[i]) / s[i]:.3g}" for i in k]
    marks: list[Mark] = [
        Line(place, s[k], "ink", "singular value s"),
        Dots(place, said / s[k], "other", "coefficient |u'b| / s", ratio, size="small"),
        Dots(place, said, "after", "data |u'b|", hints),
    ]
    every = np.concatenate([s[k], said])
    if level > 0:
        marks.append(Line([1, last], [level, level], "mark", "root of the weight", dashed=True))
        every = np.append(every, level)
    high = max(float(every.max(initial=1.0)), float((said / s[k]).max(initial=0.0)))
    y = Axis("size [sigmas, scales]", (max(float(every.min(initial=1.0)), LEAST), high), log=True)
    return Chart("Singular values and what the data say along them", Axis("direction", (1, last)), y, marks)
