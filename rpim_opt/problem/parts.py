"""Blocks of measurements that are read one after another and reduced to the QR factor R."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import methodcaller
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.threads import on_all_cores, one_blas_thread
from rpim_opt.data.dataset import Dataset, whole_configurations
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.measurements.position import position
from rpim_opt.data.tables.reading import read_data
from rpim_opt.problem.linear import LinearModel, Reweigh, by_twos, from_triangle, reduced_models
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.scatter import Scatter
from rpim_opt.problem.source import Source
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameter_names import frame_of, of_session, session_prefix
from rpim_opt.robot.parameters import Parameters
from rpim_opt.robot.terms import Curve, Model

ROWS = 4096
"""Rows that are weighed and reduced together, of losses that are no squares."""
FEW = 1024
"""Rows that are evaluated and reduced together: as many as a core's cache holds."""


@one_blas_thread
def reduced(problem: CalibrationProblem, x: Array, reweigh: Reweigh | None = None) -> LinearModel:
    """Return the model of ``problem.linearize(x)`` as its QR factor: n + 1 equations, the same |A z - b| for every z.

    Rows are evaluated, whitened and reduced `FEW` at a time, so that memory does not grow with their number; where a
    loss weighs them by their residuals at x (n,) [SI], `ROWS` at a time, whole configurations.
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


KEPT = 200_000
"""Equations up to which a problem keeps its rows; beyond, only their triangle."""
Part = Callable[[], Dataset]
"""Reads some of the measurements; whole configurations."""


class PartitionedProblem:
    """A calibration problem whose measurements come in parts, read anew at every pass.

    Every part is rotated into a triangle (n+1, n+1), and the triangles into one, by twos; so that memory depends on
    the largest part and not on their number, and the parts may be read by threads or by the workers of a cluster.
    What speaks of rows goes through `rows`, one part after the other; a row's label is preceded by the number of its
    part, ``2:T8-6``.

    Parameters
    ----------
    robot, parameters
        As `CalibrationProblem` has them.
    data
        The first part, or what resembles it: it finds the frames' start, and is checked as a problem's data are.
    parts
        Functions that read the parts, at least one; `partitions` makes them from files.
    compute
        Like the built-in ``map``, in any order of execution: ``ThreadPoolExecutor().map``, or `on_cluster` (client).
        By default files of `partitions` are read and reduced on all cores, while functions of a script are called one
        after the other. Each part is one triangle, so that no digit depends on who computed it.

    Raises
    ------
    InputError
        For no parts, as `CalibrationProblem`, and for `data` of all the parts, which do not stand anywhere; when a part
        is read whose sessions the parameters do not have, where they have others (`starting_parameters`).

    Examples
    --------
    >>> import rpim_opt as ro
    >>> whole = ro.load("position").problem
    >>> halves = [lambda: whole.data.take(range(20)), lambda: whole.data.take(range(20, 40))]
    >>> problem = ro.problem.PartitionedProblem(whole.robot, whole.parameters, halves[0](), tuple(halves))
    >>> problem.linearize(0 * whole.parameters.free.nominal).equations
    120
    >>> [part.labels[0] for part in problem.rows()], problem.keeps_rows
    (['1:c0', '2:c20'], False)
    >>> f"{ro.calibrate(problem, ro.tikhonov, weight=ro.reml).weight:.2f}"
    '1.55'
    >>> x = 0 * whole.parameters.free.nominal
    >>> problem.errors(x).shape, problem.whitened_errors(x)[0].shape, problem.configuration_errors(x)[0].shape
    ((40,), (40,), (40,))
    >>> frames = problem.identifying(whole.parameters.of_frames & whole.parameters.identified)
    >>> len(frames.frozen().parameters.free), len(frames.with_parameters(whole.parameters).parameters.free)
    (9, 34)
    >>> len(problem.sample().labels), problem.on(whole.data).labels[0]
    (20, 'c0')
    >>> problem.scatter, problem.scattered(ro.problem.Scatter(position=1e-4)).scatter.position
    (None, 0.0001)
    >>> len(problem.without({"1:c3", "2:c33", "2:c34"}).labels), list(problem.arms)
    (37, [''])
    >>> bow = ro.robot.Term(lambda joint, size: size * joint.q**2, {"bow_mrad": 0.1}, joints=(2,))
    >>> problem.with_model(ro.Model([bow])).parameters.free.names[-1]
    'bow2'
    """

    def __init__(
        self,
        robot: Robot | Mapping[str, Robot],
        parameters: Parameters,
        data: Dataset,
        parts: Sequence[Part] = (),
        compute: Callable[..., Iterable[Any]] | None = None,
    ):
        if not parts:
            raise InputError("parts", "none", "at least one function that reads measurements")
        self._first = CalibrationProblem(robot, parameters, data)
        self._dropped: frozenset[str] = frozenset()
        self.parts = tuple(parts)
        if compute is None:
            compute = map
            if all(_is_ours(part) for part in self.parts):
                compute = on_all_cores
        self.compute = compute

    @property
    def robot(self) -> Robot:
        """The nominal robot."""
        return self._first.robot

    @property
    def arms(self) -> Mapping[str, Robot]:
        """The nominal robots by name; ``""`` for the only one."""
        return self._first.arms

    @property
    def parameters(self) -> Parameters:
        """All parameters of the model, some of them identified."""
        return self._first.parameters

    @property
    def data(self) -> NoReturn:
        """Raises InputError: the measurements do not stand together anywhere."""
        raise InputError("problem.data", "measurements in parts", "problem.rows(), one problem a part")

    @property
    def keeps_rows(self) -> bool:
        """False: linear models are triangles."""
        return False

    def _with(self, first: CalibrationProblem) -> PartitionedProblem:
        copy = PartitionedProblem(first.robots, first.parameters, first.data, self.parts, self.compute)
        copy._first = first
        copy._dropped = self._dropped
        return copy

    def on(self, data: Dataset) -> CalibrationProblem:
        """Return the same problem with other measurements, in memory."""
        return self._first.on(data)

    def with_parameters(self, parameters: Parameters) -> PartitionedProblem:
        """Return the same problem with another table of parameters."""
        return self._with(self._first.with_parameters(parameters))

    def with_model(self, model: Model, identify: Iterable[str] = ("*",)) -> PartitionedProblem:
        """Return the same problem with terms of a model; arguments as for `CalibrationProblem.with_model`.

        What reads the parts has to read the columns that the terms see.
        """
        return self._with(self._first.with_model(model, identify))

    def with_transmission(self, curves: Sequence[Curve]) -> PartitionedProblem:
        """Return the same problem with transmission errors; arguments as for `CalibrationProblem.with_transmission`."""
        return self._with(self._first.with_transmission(curves))

    @property
    def scatter(self) -> Scatter | None:
        """The robot's own noise; None for the instrument's alone."""
        return self._first.scatter

    def scattered(self, scatter: Scatter | None) -> PartitionedProblem:
        """Return the same problem with other noise of the robot's own, or none."""
        return self._with(self._first.scattered(scatter))

    def identifying(self, identified: np.ndarray) -> PartitionedProblem:
        """Return the same problem with other parameters identified, (P,) true or false."""
        return self._with(self._first.identifying(identified))

    def frozen(self) -> PartitionedProblem:
        """Return a copy that asks every measurement once and keeps the answer; workers elsewhere ask once a part."""
        return self._with(self._first.frozen())

    def sample(self) -> CalibrationProblem:
        """Return the first part: rows enough to place frames by."""
        return self._first

    def rows(self) -> Iterator[CalibrationProblem]:
        """Yield one problem a part, read in this process; no two parts share the number of a configuration."""
        configurations = 0
        for number, part in enumerate(self.parts, start=1):
            data = _read(self.parameters, self._dropped, (number, part))
            if len(data):
                label = tuple(f"{number}:{name}" for name in data.label)
                yield self.on(replace(data, label=label, configuration=data.configuration + configurations))
                configurations += int(data.configuration.max()) + 1

    def linearize(self, x: Array, reweigh: Reweigh | None = None) -> LinearModel:
        """Return the linear model of all parts around the deviations x (n,) [SI], as a QR factor.

        Arguments as for `CalibrationProblem.linearize`; ``reweigh`` gets some thousand rows at a time, whole
        configurations, where a part is read.
        """
        return joined(self._everywhere(partial(reduced, x=x, reweigh=reweigh)))

    @property
    def labels(self) -> tuple[str, ...]:
        """N labels of the rows, ``part:label``, parts counted from 1."""
        return tuple(label for part in self.rows() for label in part.labels)

    def without(self, labels: Collection[str]) -> PartitionedProblem:
        """Return the same problem without the rows of these labels, wherever they stand."""
        copy = self._with(self._first)
        copy._dropped = self._dropped | frozenset(labels)
        return copy

    def errors(self, x: Array, dimension: str = "length") -> Array:
        """Return the norm of every row's residual, (N,) [m]; arguments as for `CalibrationProblem.errors`."""
        return np.concatenate(self._everywhere(methodcaller("errors", x, dimension)))

    def whitened_errors(self, x: Array) -> tuple[Array, np.ndarray]:
        """Return the whitened norm of every row's residual at x (n,), (N,), and how many equations each has (N,)."""
        norms, equations = zip(*self._everywhere(methodcaller("whitened_errors", x)), strict=True)
        return np.concatenate(norms), np.concatenate(equations)

    def configuration_errors(self, x: Array) -> tuple[Array, np.ndarray]:
        """Return the whitened norm of every configuration's residual at x (n,), (C,), and its number of equations (C,).

        A configuration's rows stand in one part.
        """
        norms, equations = zip(*self._everywhere(methodcaller("configuration_errors", x)), strict=True)
        return np.concatenate(norms), np.concatenate(equations)

    def _everywhere(self, what: Callable[[CalibrationProblem], Any]) -> list[Any]:
        """Return what a function makes of every part, read and evaluated where ``compute`` does so."""
        task = partial(_on_part, what, sketch(self._first), self._dropped)
        results = self.compute(task, list(enumerate(self.parts, start=1)))
        found = [result for result in results if result is not None]
        if not found:
            raise InputError("data", "no row", "at least one")
        return found


def in_parts(problem: Source) -> Source:
    """Return the problem in parts of whole configurations where it has more than `KEPT` equations, else as it is."""
    if not isinstance(problem, CalibrationProblem):
        return problem
    if sum(len(block.row) * len(block.measurement.components) for block in problem.data.blocks) <= KEPT:
        return problem
    parts = [partial(problem.data.take, rows) for rows in whole_configurations(problem.data, KEPT // 4)]
    return PartitionedProblem(problem.robots, problem.parameters, problem.data, parts)._with(problem)


def _is_ours(part: Part) -> bool:
    """Whether a part is read by this package, which several threads may do at once."""
    return isinstance(part, partial) and (
        part.func is read_data or getattr(part.func, "__func__", None) is Dataset.take
    )


def sketch(problem: CalibrationProblem) -> CalibrationProblem:
    """Return the problem with one row of its data: what a worker must know of it besides its own part."""
    return problem.on(problem.data.take([0]))


def _on_part(
    what: Callable[[CalibrationProblem], Any],
    known: CalibrationProblem,
    dropped: frozenset[str],
    part: tuple[int, Part],
) -> Any:
    """Return what a function makes of a part, where a worker reads it; None for one without rows."""
    data = _read(known.parameters, dropped, part)
    return what(known.on(data)) if len(data) else None


def _read(parameters: Parameters, dropped: frozenset[str], part: tuple[int, Part]) -> Dataset:
    """Return the measurements of a part, without what was dropped of it.

    Refuse a session that the parameters lack while they have others: its rows would be taken for unshifted.
    """
    number, read = part
    mine = f"{number}:"
    out = {label.removeprefix(mine) for label in dropped if label.startswith(mine)}
    data = read()
    if out:
        data = data.without(out)
    known = {frame_of(name) for name in parameters.names if of_session(name)}
    strange = [name for name in data.sessions if session_prefix(name) not in known]
    if known and strange:
        accepted = "sessions of the parameters; starting_parameters(..., sessions=...) takes the names of all parts"
        raise InputError("session", f"'{strange[0]}' in part {number}", accepted)
    return data


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
    >>> parts = ro.problem.partitions(["targets.csv"], robot, {"position_mm": 0.03})
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

        compute = ro.problem.on_cluster(Client("tcp://10.0.0.7:8786"))
        problem = ro.problem.PartitionedProblem(robot, parameters, parts[0](), parts, compute)
    """

    def compute(task: Callable[[Any], Any], parts: Sequence[Any]) -> list[Any]:
        return client.gather(client.map(task, list(parts), pure=False))

    return compute
