"""Optimality certificate of a solution, from new calls of its functions and, except in blocks, a new linearization."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import TINY, Array
from rpim_opt.basics.exceptions import NoSolutionFound
from rpim_opt.convex.formulation import Formulation
from rpim_opt.convex.program import feasibility_tolerance, pose
from rpim_opt.problem.linear import LinearModel

DECREASE = 1e-6  # relative decrease that the program at a solution may predict: an interior-point method's accuracy
DIRECTIONS = 2  # random directions in which the model's derivative is compared
APART = 1e-4  # half the step of a central difference, in scales
INEXACT = 1e-4  # relative difference above which the model's derivative is not the residual's
RESTING = 1e-12  # step, relative to 1 + |z|, that is rounding, whatever decrease it predicts of an objective near zero


class Certificate(NamedTuple):
    """Residuals of the optimality conditions at a solution.

    ``step`` is the remaining step of the convex program at the solution, relative to 1 + |z|; ``violation`` that of the
    constraints, in units of the scales; ``decrease`` the predicted decrease of that step, relative to the objective, or
    None if unknown.

    >>> import rpim_opt as ro
    >>> result = ro.calibrate(ro.load("paper_arm").problem, ro.bounded, weight=1e-3)
    >>> evidence = result.certificate
    >>> evidence.holds(result.z), evidence.decrease < 1e-9, evidence.violation
    (True, True, 0.0)
    """

    step: float
    violation: float
    decrease: float | None = None

    def holds(self, z: Array) -> bool:
        """Whether the conditions hold at z (n,), to the accuracy of an interior-point solver."""
        if self.decrease is None or self.violation > feasibility_tolerance(z):
            return False
        return self.decrease <= DECREASE or self.step <= RESTING


def certified(
    formulation: Formulation,
    model: LinearModel,
    z: Array,
    weight: float,
    floor: float = 0.0,
    residual: Callable[[Array], Array] | None = None,
) -> Certificate:
    """Return the certificate that z (n,) minimizes the nonlinear problem; the formulation's functions are called again.

    ``model`` is the problem linearized again at z; ``floor`` is the objective below which it counts as zero. If
    ``residual`` is given (the whitened residual b - A z as a function of z (n,)), the model's derivative is compared
    with finite differences, and replaced by them if it differs.
    """
    if residual is not None:
        model = _differentiated(model, residual, z)
    program = pose(formulation, model).beginning(z)  # the start of the search proves nothing
    objective = program.objective(z, weight)
    violation = program.violation(z)
    try:
        best = program.solve(weight).z
    except NoSolutionFound:
        return Certificate(float("inf"), violation)
    step = float(np.linalg.norm(best - z) / (1 + np.linalg.norm(z)))
    predicted = objective - program.objective(best, weight)
    if not np.isfinite(predicted):
        return Certificate(step, violation)
    return Certificate(step, violation, float(max(predicted, 0.0) / max(abs(objective), floor, TINY)))


def _differentiated(model: LinearModel, residual: Callable[[Array], Array], z: Array) -> LinearModel:
    """Return the model, or where its derivative is not that of the residual, the one by central differences."""

    def slope(direction: Array) -> Array:
        return (residual(z - APART * direction) - residual(z + APART * direction)) / (2 * APART)

    rng = np.random.default_rng(0)
    directions = rng.normal(size=(DIRECTIONS, len(z)))
    for direction in directions:
        exact = model.A @ direction
        difference = slope(direction)
        if difference.shape != exact.shape or not np.isfinite(difference).all():
            return model
        if np.linalg.norm(difference - exact) > INEXACT * np.linalg.norm(exact):
            A = np.column_stack([slope(unit) for unit in np.eye(len(z))])
            return replace(model, A=A, b=residual(z) + A @ z)
    return model
