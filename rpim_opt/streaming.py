"""Measurements that are read part by part and never stand in memory together."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import cvxpy as cp
import numpy as np

from rpim_opt.conic import Term
from rpim_opt.dataset import Dataset, read_data
from rpim_opt.exceptions import InputError
from rpim_opt.formulation import Formulation, rotation_invariant
from rpim_opt.measurement import Measurement, position
from rpim_opt.problem import ROWS, CalibrationProblem, LinearModel, reduced_rows
from rpim_opt.robot import Array, Robot
from rpim_opt.threads import one_blas_thread

KEPT = 200_000
"""Equations up to which a problem keeps its rows; beyond, only their triangle."""
Part = Callable[[], Dataset]
"""Reads some of the measurements; whole configurations."""


@dataclass(frozen=True, eq=False)
class PartitionedProblem(CalibrationProblem):
    """A calibration problem whose measurements come in parts, read anew at every pass.

    Every part is rotated into a triangle (n+1, n+1), and the triangles into one, by twos; so that memory depends on
    the largest part and not on their number, and the parts may be read by threads or by the workers of a cluster.
    ``data`` is the first part alone: it finds the frames' start, and `errors` without data is of it.

    Parameters
    ----------
    robot, parameters
        As `CalibrationProblem` has them.
    data
        The first part.
    parts
        Functions that read the parts, at least one; `partitions` makes them from files.
    compute
        Like the built-in ``map``, in any order of execution: ``ThreadPoolExecutor().map``, or `on_cluster` (client).
    loss
        The formulation whose loss weighs the rows, where that is not a squared norm; set by `calibrate`.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> whole = ro.load("position").problem
    >>> halves = [lambda: whole.data.take(range(20)), lambda: whole.data.take(range(20, 40))]
    >>> problem = ro.PartitionedProblem(whole.robot, whole.parameters, halves[0](), tuple(halves))
    >>> problem.linearize(0 * whole.parameters.free.nominal).equations
    120
    >>> problem.complete
    False
    >>> formulation = problem.for_loss(ro.robust)[1]  # majorized by a squared loss
    >>> formulation.loss_over
    'equation'
    >>> f"{ro.calibrate(problem, ro.tikhonov, weight=ro.reml).weight:.2f}"
    '1.55'
    """

    parts: tuple[Part, ...] = ()
    compute: Callable[..., Iterable[Any]] = map
    loss: Formulation | None = field(default=None)

    @property
    def complete(self) -> bool:
        """False: ``data`` are the first part."""
        return False

    def linearize(self, x: Array) -> LinearModel:
        """Return the reduced linear model around the deviations x (n,) [SI], of all parts."""
        alone = CalibrationProblem(self.robot, self.parameters, self.data)
        task = partial(_triangle, sketch(alone), x, self.loss)
        found = list(self.compute(task, self.parts))
        R, count, offset = [f[0] for f in found], sum(f[1] for f in found), sum(f[2] for f in found)
        while len(R) > 1:
            R = [reduced_rows(R[i + 1], R[i]) if i + 1 < len(R) else R[i] for i in range(0, len(R), 2)]
        return replace(self.from_triangle(R[0], count), offset=offset)

    def for_loss(self, formulation: Formulation) -> tuple[PartitionedProblem, Formulation]:
        """Return the problem and the formulation that solve it on triangles.

        A loss that is no squared norm is majorized at the current deviations by one that is: with v the whitened
        norms, loss(v) <= sum_i w_i v_i^2 + const with w_i = loss'(v_i) / (2 v_i) and equality there, so that every
        pass lowers the loss (iteratively reweighted least squares; Holland and Welsch 1977). That needs a loss that is
        a sum over rows and grows no faster than a square: Huber's, the sum of norms.
        """
        if rotation_invariant(formulation):
            return self, formulation
        if np.isfinite(formulation.largest) or formulation.loss_over != "configuration":
            found = f"formulation '{formulation.name}'"
            raise InputError(found, "measurements in parts", "a squared loss, or a sum over configurations (robust)")
        return replace(self, loss=formulation), replace(formulation, loss=cp.sum_squares, loss_over="equation")


def in_parts(problem: CalibrationProblem) -> CalibrationProblem:
    """Return the problem as it is solved: in parts of whole configurations where it has more than `KEPT` equations."""
    equations = sum(len(block.row) * len(block.measurement.components) for block in problem.data.blocks)
    if not problem.complete or equations <= KEPT:
        return problem
    order = np.argsort(problem.data.configuration, kind="stable")
    starts = np.flatnonzero(np.diff(problem.data.configuration[order], prepend=-1))
    ends = np.unique(starts[np.searchsorted(starts, np.arange(0, len(order), KEPT // 4))])
    parts = tuple(partial(problem.data.take, rows) for rows in np.split(order, ends[1:]))
    return PartitionedProblem(problem.robot, problem.parameters, problem.data, parts)


def sketch(problem: CalibrationProblem) -> CalibrationProblem:
    """Return the problem with one row of its data: what a worker must know of it besides its own part."""
    return problem.on(problem.data.take([0]))


@one_blas_thread
def _triangle(problem: CalibrationProblem, x: Array, loss: Formulation | None, part: Part) -> tuple[Array, int, float]:
    """Return a part's triangle, how many equations it stands for, and the majorizing constant."""
    whole = problem.on(part())
    if loss is None:
        model = whole.reduced(x)
        return np.vstack([model.A.T, model.b]).T, model.equations, 0.0
    R, count, offset = np.zeros((0, len(x) + 1)), 0, 0.0
    for start in range(0, len(whole.data), ROWS):
        rows = whole.on(whole.data.take(np.arange(start, min(start + ROWS, len(whole.data)))))
        model = rows.linearize(x)
        z = x / model.parameters.scale
        _, which = np.unique(model.group, return_inverse=True)
        v = np.sqrt(np.bincount(which, (model.A @ z - model.b) ** 2))
        near = np.maximum(v, 1e-6)
        term = Term(loss.loss, len(v))
        slope = term.slope(near)
        if slope is None:
            raise InputError(f"formulation '{loss.name}'", "a loss without slope", "one with a slope, as robust has")
        w = slope / (2 * near)
        offset += term(v) - float(w @ v**2)
        scaled = model.scaled(np.sqrt(w)[which])
        R, count = reduced_rows(np.column_stack([scaled.A, scaled.b]), R), count + model.equations
    return R, count, offset


def partitions(
    paths: Sequence[str | Path], robot: Robot, noise: Mapping[str, Any], measurement: Measurement = position
) -> tuple[Part, ...]:
    """Return functions that read the files, each a table as `read_data` takes it, of a few hundred thousand rows.

    A configuration's rows stand in one file. Parquet is read fastest.

    Parameters
    ----------
    paths
        Tables; at least one.
    robot, noise, measurement
        As for `read_data`.

    Raises
    ------
    InputError
        For no paths; when a part is read, as `read_data`.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> robot = ro.load("paper_arm").problem.robot
    >>> parts = ro.partitions(["targets.csv"], robot, {"position_mm": 0.03})
    >>> len(parts), len(parts[0]())
    (1, 18)
    """
    if not paths:
        raise InputError("paths", "no file", "at least one")
    return tuple(partial(read_data, Path(path), robot, noise, measurement) for path in paths)


def on_cluster(client: Any) -> Callable[..., Iterable[Any]]:
    """Return a ``compute`` for `PartitionedProblem` that lets the workers of a Dask cluster read and reduce the parts.

    Parameters
    ----------
    client
        A ``distributed.Client``.

    Examples
    --------
    With ``from distributed import Client`` and the address of the cluster's scheduler::

        replace(problem, compute=ro.on_cluster(Client("tcp://10.0.0.7:8786")))
    """

    def compute(task: Callable[[Part], Any], parts: Sequence[Part]) -> list[Any]:
        return client.gather(client.map(task, list(parts), pure=False))

    return compute
