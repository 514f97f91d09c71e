"""The loop, repeated about what it found where constraints bound predicted positions, linear about a point."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.calibration.loop import Ended, run
from rpim_opt.calibration.outcome import Iteration
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.select import Selector
from rpim_opt.problem.source import Source

NEAR = 1e-4
"""What a round may still change, relative to 1 + |z|: the error of the positions is its square."""
MOST, LEAST = 20, 1 / 8
"""Rounds at most; and the least part of the way to its solution that the next round looks from."""

CHOOSING = 6
"""Rounds that choose anew where in a region the robot moves farthest: after that these stay, or they might circle."""


def run_about(
    problem: Source,
    formulation: Formulation,
    weight: float | str | Selector,
    start: Array | None,
    max_iterations: int,
    tolerance: float,
    progress: Callable[[Iteration], None] | None,
    how: Mapping[str, Any],
) -> Ended:
    """Run the loop, and again about its solution until positions that constraints ask for are those of the solution.

    Constraints bend, and a round does not know that: where solutions jump to and fro, the next looks from between.
    """
    ended = run(problem, formulation, weight, start, max_iterations, tolerance, progress, how, start)
    if not ended.state.program.predicts:
        return ended
    history = ended.state.history
    scale = problem.parameters.free.scale
    about = farthest = ended.x
    share, last = 1.0, np.inf
    for rounds in range(2, MOST + 1):
        ended = run(problem, formulation, weight, ended.x, max_iterations, tolerance, progress, how, about, farthest)
        history = (*history, *ended.state.history)
        if not ended.converged:
            return _whole(ended, history, ended.message)
        length = float(np.linalg.norm((ended.x - about) / scale))
        if length <= NEAR * (1 + float(np.linalg.norm(ended.state.z))):
            passes = f"{len(history)} passes in {rounds} rounds"
            return _whole(ended, history, f"Converged after {passes}, positions linear about the solution.")
        if length > last / 2:
            share = max(share / 2, LEAST)
        about = about + share * (ended.x - about)
        last = length
        if rounds <= CHOOSING:
            farthest = about
    message = "the positions that constraints bound still change; give a larger weight"
    return replace(_whole(ended, history, f"Not converged: after {MOST} rounds {message}."), converged=False)


def _whole(ended: Ended, history: tuple[Iteration, ...], message: str) -> Ended:
    """Return where the last round ended, with the passes of all."""
    return replace(ended, state=replace(ended.state, history=history), message=message)
