"""Triangles of linear models: rows rotated into n + 1 equations that say all that a squared loss sees."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.threads import one_blas_thread
from rpim_opt.data.dataset import whole_configurations
from rpim_opt.problem.linear import LinearModel, Reweigh, by_twos, from_triangle, reduced_models
from rpim_opt.problem.problem import CalibrationProblem

ROWS = 4096
"""Rows that are weighed and reduced together, of losses that are no squares."""
FEW = 1024
"""Rows that are evaluated and reduced together: as many as a core's cache holds."""


@one_blas_thread
def reduced(problem: CalibrationProblem, x: Array, reweigh: Reweigh | None = None) -> LinearModel:
    """Return the model of ``problem.linearize(x)`` as its triangle: n + 1 equations, the same |A z - b| for every z.

    Rows are evaluated, whitened and rotated into the triangle `FEW` at a time, so that memory does not grow with
    their number.

    Parameters
    ----------
    problem
        Measurements in memory.
    x
        (n,) deviations [SI].
    reweigh
        What weighs the equations of `ROWS` rows, whole configurations, by their residuals at x; or None.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> from rpim_opt.problem.triangles import reduced
    >>> model = reduced(problem, np.zeros(len(problem.parameters.free)))
    >>> model.A.shape, model.equations
    ((35, 34), 120)
    """
    if reweigh is None:
        return problem.triangle(x, FEW)
    groups = whole_configurations(problem.data, ROWS)
    return reduced_models(problem.on(problem.data.take(rows)).linearize(x, reweigh) for rows in groups)


def joined(models: Sequence[LinearModel]) -> LinearModel:
    """Return the triangle of several triangles, joined by twos."""
    R = [np.column_stack([model.A, model.b]) for model in models]
    equations = sum(model.equations for model in models)
    return from_triangle(models[0], by_twos(R), equations, sum(model.offset for model in models))
