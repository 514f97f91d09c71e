"""Blocks of measurements that are read one after another and reduced to the QR factor R."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from operator import methodcaller
from pathlib import Path
from typing import Any, ClassVar, NoReturn

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import counted
from rpim_opt.basics.threads import on_all_cores, one_blas_thread
from rpim_opt.data.dataset import Dataset, whole_configurations
from rpim_opt.data.measurements.measurement import Measurement
from rpim_opt.data.measurements.pose import position
from rpim_opt.data.tables.reading import read_data
from rpim_opt.problem.linear import LinearModel, Reweigh, reduced_models
from rpim_opt.problem.noise import equation_numbers
from rpim_opt.problem.problem import CalibrationProblem, RobotModel
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import Parameters, frame_of, of_session, session_prefix

ROWS = 4096  # rows that are evaluated, whitened and reduced together
KEPT = 200_000  # largest number of equations that a calibration keeps; of more, only their QR factor
Part = Callable[[], Dataset]  # reads a block of the measurements: whole configurations
Numbered = tuple[int, Part]


@one_blas_thread
def reduced(problem: CalibrationProblem, x: Array, reweigh: Reweigh | None = None) -> LinearModel:
    """Return the model of ``problem.linearize(x)`` as its QR factor: n + 1 equations, the same |A z - b| for every z.

    Rows are evaluated, whitened and reduced in groups of whole configurations, about `ROWS` at a time, so that memory
    does not grow with their number.
    """
    groups = whole_configurations(problem.data, ROWS) if len(problem.data) else ()
    return reduced_models(problem.on(problem.data.take(rows)).linearize(x, reweigh) for rows in groups)


@dataclass(frozen=True, eq=False, repr=False)
class PartitionedProblem(RobotModel):
    """A calibration problem whose measurements come in blocks, read again at every iteration.

    Every block is reduced to a QR factor (n+1, n+1), and these to one, so that memory depends on the largest block and
    not on their number, and blocks may be read by threads or by the workers of a cluster. Rows, where needed, are read
    through `rows`, block by block; a row's label has the number of its block as prefix, ``2:T8-6``.

    ``robots`` and ``parameters`` are those of `CalibrationProblem`; ``first`` is the first block, or similar data: the
    frames' start values come from it, and it is checked like a problem's data. ``parts`` are functions that read the
    blocks, at least one (`partitions` makes them from files), ``dropped`` the labels of rows that are left out.

    ``compute`` is like the built-in ``map``, in any order of execution: ``ThreadPoolExecutor().map``, or with a client
    of a Dask cluster ``lambda task, parts: client.gather(client.map(task, list(parts), pure=False))``. By default files
    of `partitions` are read and reduced on all cores, and a script's functions are called one after the other. Each
    block has its own QR factor, so that the result is the same to the last digit on any number of cores.

    InputError for no blocks, as for `CalibrationProblem`, for access to `data` of all blocks (they are not in memory),
    and while reading, for a block whose sessions the parameters lack (`starting_parameters`).

    >>> import rpim_opt as ro
    >>> whole = ro.load("position").problem
    >>> halves = [lambda: whole.data.take(range(20)), lambda: whole.data.take(range(20, 40))]
    >>> problem = ro.problem.PartitionedProblem(whole.robot, whole.parameters, halves[0](), tuple(halves))
    >>> [part.labels[0] for part in problem.rows()], f"{ro.calibrate(problem, ro.tikhonov, weight=ro.reml).weight:.2f}"
    (['1:c0', '2:c20'], '1.55')
    """

    keeps_rows: ClassVar[bool] = False
    first: Dataset
    parts: Sequence[Part] = ()
    compute: Callable[..., Iterable[Any]] | None = None
    dropped: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if not self.parts:
            raise InputError("parts", "none", "at least one function that reads measurements")
        self.sample()  # is checked
        if self.compute is None:
            ours = all(isinstance(part, partial) and part.func in (read_data, Dataset.take) for part in self.parts)
            object.__setattr__(self, "compute", on_all_cores if ours else map)

    def _short(self) -> str:
        return f"{counted(len(self.parts), 'block')}, the first {super()._short()}"

    @property
    def data(self) -> NoReturn:
        """Raises InputError: the measurements are never in memory together."""
        raise InputError("problem.data", "data in blocks", "problem.rows(), one problem per block")

    def sample(self) -> CalibrationProblem:
        """Return the first block, which suffices to locate frames."""
        return self._first

    @cached_property
    def _first(self) -> CalibrationProblem:
        return CalibrationProblem(self.robots, self.parameters, self.first, **_beside(self))

    def on(self, data: Dataset) -> CalibrationProblem:
        """Return the same problem with other measurements, in memory."""
        return self.sample().on(data)

    def without(self, labels: Collection[str]) -> PartitionedProblem:
        """Return the same problem without the rows of these labels, in any block."""
        return replace(self, dropped=self.dropped | frozenset(labels))

    def rows(self) -> Iterator[CalibrationProblem]:
        """Yield one problem per block, read in this process; no two blocks share the number of a configuration."""
        configurations = 0
        for number, part in enumerate(self.parts, start=1):
            data = _read(self.parameters, self.dropped, (number, part))
            if len(data):
                label = tuple(f"{number}:{name}" for name in data.label)
                yield self.on(replace(data, label=label, configuration=data.configuration + configurations))
                configurations += int(data.configuration.max()) + 1

    def gathered(self) -> CalibrationProblem | None:
        """Return the problem with all rows in memory; None where they have more than `KEPT` equations."""
        parts: list[Dataset] = []
        equations = 0
        for part in self.rows():
            equations += len(part.owners)
            if equations > KEPT:
                return None
            parts.append(part.data)
        if not parts:
            raise InputError("data", "no row", "at least one")
        return self.on(Dataset.concatenated(parts, [str(i) for i in range(len(parts))]))

    @property
    def labels(self) -> tuple[str, ...]:
        """N labels of the rows, ``block:label``, blocks counted from 1."""
        return tuple(label for part in self.rows() for label in part.labels)

    def linearize(self, x: Array, reweigh: Reweigh | None = None) -> LinearModel:
        """Return the linear model of all blocks around the deviations x (n,) [SI], as a QR factor.

        Arguments as for `CalibrationProblem.linearize`; ``reweigh`` gets some thousand rows at a time, whole
        configurations, where the block is read.
        """
        return reduced_models(self._everywhere(partial(reduced, x=x, reweigh=reweigh)))

    def errors(self, x: Array, dimension: str = "length") -> Array:
        """Return the norm of every row's residual, (N,) [m]; arguments as for `CalibrationProblem.errors`."""
        return np.concatenate(self._everywhere(methodcaller("errors", x, dimension)))

    def whitened_errors(self, x: Array) -> tuple[Array, np.ndarray]:
        """Return the whitened norm of every row's residual at x (n,), (N,), and how many equations each has (N,)."""
        norms, equations = zip(*self._everywhere(methodcaller("whitened_errors", x)), strict=True)
        return np.concatenate(norms), np.concatenate(equations)

    def configuration_errors(self, x: Array) -> tuple[Array, np.ndarray]:
        """Return the same for every configuration, (C,) and (C,); its rows are in one block."""
        norms, equations = zip(*self._everywhere(methodcaller("configuration_errors", x)), strict=True)
        return np.concatenate(norms), np.concatenate(equations)

    def _everywhere(self, what: Callable[[CalibrationProblem], Any]) -> list[Any]:
        """Return what a function makes of every block, read and evaluated where ``compute`` does so."""
        known = self.on(self.first.take([0]))  # one row: what a worker needs to know besides its own block
        task = partial(_on_part, what, known, self.dropped)
        results = (self.compute or map)(task, list(enumerate(self.parts, start=1)))
        answers = [result for result in results if result is not None]
        if not answers:
            raise InputError("data", "no row", "at least one")
        return answers


Source = CalibrationProblem | PartitionedProblem
"""Measurements of a calibration, in memory or in blocks: linear models, and rows block by block."""


def in_parts(problem: Source) -> Source:
    """Return the problem in memory, or where it has more than `KEPT` equations in blocks of whole configurations."""
    if isinstance(problem, PartitionedProblem):
        return problem.gathered() or problem
    if sum(index.size for index in equation_numbers(problem.data)) <= KEPT:
        return problem
    parts = [partial(Dataset.take, problem.data, rows) for rows in whole_configurations(problem.data, KEPT // 4)]
    return PartitionedProblem(problem.robots, problem.parameters, problem.data, parts, **_beside(problem))


def _beside(problem: RobotModel) -> dict[str, Any]:
    """Return what a problem knows besides robots, parameters and data."""
    return {"frozen_functions": problem.frozen_functions, "repeatability": problem.repeatability}


def _on_part(
    what: Callable[[CalibrationProblem], Any], known: CalibrationProblem, dropped: frozenset[str], part: Numbered
) -> Any:
    """Return what a function makes of a part, where a worker reads it; None for one without rows."""
    data = _read(known.parameters, dropped, part)
    return what(known.on(data)) if len(data) else None


def _read(parameters: Parameters, dropped: frozenset[str], part: Numbered) -> Dataset:
    """Return the measurements of a part; refuse a session that the parameters lack while they have others."""
    number, read = part
    mine = f"{number}:"
    out = {label.removeprefix(mine) for label in dropped if label.startswith(mine)}
    data = read().without(out) if out else read()
    known = {frame_of(name) for name in parameters.names if of_session(name)}
    strange = [name for name in data.sessions if session_prefix(name) not in known]
    if known and strange:
        accepted = "sessions with parameters: starting_parameters(..., sessions=...) takes the names of all blocks"
        raise InputError("session", f"'{strange[0]}' in block {number}", accepted)
    return data


def partitions(
    paths: Sequence[str | Path], robot: Robot, noise: Mapping[str, Any], measurement: Measurement = position
) -> tuple[Part, ...]:
    """Return functions that read the files, each a table for `read_data` with at most some hundred thousand rows.

    All rows of a configuration must be in one file. Parquet is read fastest. Other arguments as for `read_data`;
    InputError for no paths, and when a part is read.

    >>> import rpim_opt as ro
    >>> robot = ro.load("paper_arm").problem.robot
    >>> parts = ro.problem.partitions(["targets.csv"], robot, {"position_mm": 0.03})
    >>> len(parts), len(parts[0]())
    (1, 18)
    """
    if not paths:
        raise InputError("paths", "no file", "at least one")
    return tuple(partial(read_data, Path(path), robot, noise, measurement) for path in paths)
