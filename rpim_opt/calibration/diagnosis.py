"""What a fit says of its data: rows that it distrusts, bounds that hold it back, equations that it rests on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from rpim_opt.basics.arrays import Array
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.program import Program
from rpim_opt.convex.trust import RARE, Trusted, outlying, trusted_rows
from rpim_opt.problem.linear import LinearModel
from rpim_opt.problem.parts import in_parts
from rpim_opt.problem.source import Source


class Flag(NamedTuple):
    """A row that a calibration distrusts: its residual in sigmas, and its error [mm]."""

    label: str
    sigmas: float
    error_mm: float


class Held(NamedTuple):
    """A parameter at its bound [SI], the bound's multiplier, and the gain of loosening it by a tenth."""

    name: str
    bound: float
    multiplier: float
    gain: float


def trust(problem: Source, formulation: Formulation, program: Program, x: Array) -> Trusted | None:
    """Return what a robust loss trusts of the measurements at x (n,) [SI]; None for a squared loss.

    The program's formulation is another one where triangles stand for its loss.
    """
    source = in_parts(problem)
    if source.keeps_rows or program.formulation is formulation:
        return program.trust(x / problem.parameters.free.scale)
    return trusted_rows(source, x, formulation)


def trusted(problem: Source, program: Program, trust: Trusted | None, x: Array) -> LinearModel:
    """Return the last linearization, of the equations that a loss trusts at x (n,) [SI]."""
    if trust is None:
        return program.squared
    source = in_parts(problem)
    if source.keeps_rows:
        return trust(program.model, x / problem.parameters.free.scale)[0]
    return source.linearize(x, trust)


def factor(program: Program, trust: Trusted | None) -> float:
    """Return by how much the loss weighs the equations that it trusts, against squared residuals in sigmas."""
    if trust is not None:
        return trust.factor
    form = program.loss_form
    if form is None:
        return 1.0
    return form.size


def flagged(problem: Source, x: Array) -> tuple[Flag, ...]:
    """Return the rows beyond `outlying` at x (n,) [SI], the worst first."""
    norms, count = problem.whitened_errors(x)
    limit = outlying(norms, count)
    error = problem.errors(x)
    error = 1e3 * np.where(np.isfinite(error), error, problem.errors(x, "stated length"))
    noise = limit / np.sqrt(chdtri(count, RARE / len(norms)))
    labels = problem.labels
    worst = [i for i in np.argsort(-norms) if norms[i] > limit[i]]
    return tuple(Flag(labels[i], float(norms[i] / noise[i]), float(error[i])) for i in worst)


def held(program: Program, z: Array, weight: float) -> tuple[Held, ...]:
    """Return the parameters that a bound holds back at z (n,), the costliest first."""
    box = program.box
    if box is None or not program.formulation.constraints:
        return ()
    parameters = program.model.parameters
    multiplier = np.sum(program.beginning(z).solve(weight).duals, axis=0)
    loss = program.value(z)[0]
    rows = program.model.equations
    near = np.minimum(z - box[0], box[1] - z) < 1e-6 * (1 + np.abs(z))
    found: list[Held] = []
    for i in np.flatnonzero((multiplier > 1e-6 * loss / rows) & near & (box[0] < box[1])):
        bound = float(min((box[0][i], box[1][i]), key=lambda side: abs(z[i] - side)))
        less = max(loss - 0.1 * abs(bound) * multiplier[i], 0.0)
        gain = float(np.sqrt(loss / rows) - np.sqrt(less / rows))
        found.append(Held(parameters.names[i], bound * float(parameters.scale[i]), float(multiplier[i]), gain))
    return tuple(sorted(found, key=lambda h: -h.gain))
