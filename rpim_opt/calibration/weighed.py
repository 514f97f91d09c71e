"""A calibration at one weight, or with one selector, over the scales that a problem states."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.calibration.outcome import Iteration
from rpim_opt.calibration.result import Calibration
from rpim_opt.calibration.rounds import run_about
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.select import Selector
from rpim_opt.problem.source import Source


def require_passes(max_iterations: int) -> None:
    """Refuse a number of passes that is none."""
    if isinstance(max_iterations, bool) or not isinstance(max_iterations, int) or max_iterations < 1:
        raise InputError("max_iterations", f"{max_iterations!r}", "a whole number, 1 or more")


def calibrated(
    problem: Source,
    formulation: Formulation,
    weight: float | str | Selector,
    *,
    start: Array | None = None,
    max_iterations: int = 500,
    tolerance: float = 1e-8,
    progress: Callable[[Iteration], None] | None = None,
    solver: str | None = None,
    settings: Mapping[str, Any] | None = None,
    verbose: bool = False,
) -> Calibration:
    """Return the calibration; arguments as for `calibrate`, start (n,) [SI]."""
    require_passes(max_iterations)
    how = {"solver": solver, "settings": settings, "verbose": verbose}
    ended = run_about(problem, formulation, weight, start, max_iterations, tolerance, progress, how)
    again = {"max_iterations": max_iterations, "tolerance": tolerance, **how}
    choice = ended.state.choice
    return Calibration(
        problem=problem,
        formulation=formulation,
        x=ended.x,
        weight=choice.weight,
        selection=choice.selection,
        converged=ended.converged,
        message=ended.message,
        history=ended.state.history,
        program=ended.state.program,
        certificate=ended.certificate,
        asked=partial(calibrated, formulation=formulation, weight=weight, **again),
    )
