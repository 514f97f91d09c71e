"""Problems of a comparison (folders, loaded ones, families that a seed draws from), and what is held out of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.formulation import tikhonov
from rpim_opt.convex.program import Program
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.store.instances import Instance, load
from rpim_opt.study.arms import SimulatedArm

ACCEPTED = "a folder, a name, ro.load(...), a problem, or a function of a seed that returns one"
RETURNS = "an instance, a simulated arm, a problem, or a pair of a problem and validation data"
FOLDER = "folder"
MOST_FOLDS = 10_000
"""Each is a calibration of its own, and is listed before the first begins."""
NOISE_STREAM = 11
"""Stream of the noise that is added, apart from those that draw configurations."""


@dataclass(frozen=True, eq=False)
class Source:
    """A problem by its name; a function of a seed is another problem for every seed."""

    label: str
    problem: Instance | Callable[[int], Any]

    @property
    def drawn(self) -> bool:
        """Whether a seed draws it."""
        return not isinstance(self.problem, Instance)

    def instance(self, seed: int) -> Instance:
        """Return the instance of a seed."""
        if isinstance(self.problem, Instance):
            return self.problem
        instance = _instance(self.problem(seed), self.label)
        if instance is None:
            raise InputError(f"problem {self.label}", f"a function of a seed that returns no problem ({seed})", RETURNS)
        return instance


def sources_of(problems: Any) -> tuple[Source, ...]:
    """Return what a comparison runs on, each with a name of its own.

    Raises
    ------
    InputError
        For what is no problem, a folder without any, and a name that occurs twice.
    """
    sources = tuple(_sources(problems))
    if not sources:
        raise InputError("problems", "none", ACCEPTED)
    labels = [source.label for source in sources]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError("problems", f"'{label}' twice", "a name of its own for each: {'a name': problem}")
    return sources


def _sources(problems: Any) -> Iterator[Source]:
    if isinstance(problems, Mapping):
        yield from (_source(str(label), problem) for label, problem in problems.items())
    elif isinstance(problems, str | Path):
        yield from _in_folder(problems)
    elif isinstance(problems, tuple) and _instance(problems, "") is not None:
        yield _source("problem", problems)
    elif isinstance(problems, Iterable):
        for problem in problems:
            yield from _sources(problem)
    else:
        yield _source(_name(problems), problems)


def _in_folder(path: str | Path) -> Iterator[Source]:
    """Yield the problem of a folder or a name, or those of the folders in a folder."""
    place = Path(path)
    if place.is_dir() and not (place / "problem.toml").is_file():
        inside = sorted(each.parent for each in place.glob("*/problem.toml"))
        if not inside:
            raise InputError("problems", f"no problem.toml in '{place}' or a folder in it", ACCEPTED)
        yield from (Source(folder.name, load(folder)) for folder in inside)
        return
    label = place.parent.name if place.name == "problem.toml" else place.name
    yield Source(label or str(path), load(path))


def _source(label: str, stated: Any) -> Source:
    if isinstance(stated, str | Path):
        return Source(label, load(stated))
    instance = _instance(stated, label)
    if instance is not None:
        return Source(label, instance)
    if callable(stated):
        return Source(label, stated)
    if isinstance(stated, Program):
        raise InputError("problems", "a program", f"{ACCEPTED}; ro.select.compare compares selectors on a program")
    raise InputError("problems", f"a {type(stated).__name__}", ACCEPTED)


def _name(stated: Any) -> str:
    if isinstance(stated, Instance):
        return stated.title
    if isinstance(stated, CalibrationProblem):
        return stated.robot.name
    return getattr(stated, "__name__", type(stated).__name__)


def _instance(given: Any, label: str) -> Instance | None:
    """Return a problem in one of its forms as an instance; None for anything else."""
    match given:
        case Instance():
            return given
        case SimulatedArm():
            return Instance(label, "", given.problem, given.true, tikhonov, None)
        case CalibrationProblem():
            return Instance(label, "", given, None, tikhonov, None)
        case (CalibrationProblem() as problem, Dataset() as validation):
            return Instance(label, "", problem, validation, tikhonov, None)
    return None


# --- what is held out ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Split:
    """A way to hold configurations out.

    Parameters
    ----------
    label
        What rows call it.
    part
        What part of the configurations is held out at random; zero otherwise.
    folds
        In how many folds each is held out once; one for no folds.
    """

    label: str
    part: float = 0.0
    folds: int = 1

    @property
    def by_seed(self) -> bool:
        """Whether another seed holds others out."""
        return self.label != FOLDER

    def held_out(self, data: Dataset, fold: int, seed: int) -> np.ndarray:
        """Return which rows (N,) are held out; all rows of a configuration are, or none."""
        known = np.unique(data.configuration)
        drawn = np.random.default_rng(seed).permutation(known)
        if self.part:
            count = min(max(round(self.part * len(known)), 1), len(known) - 1)
            return np.isin(data.configuration, drawn[:count])
        if len(known) < self.folds:
            found = f"{len(known)} configurations"
            raise InputError("splits", found, f"at least {self.folds} for {self.folds} folds")
        return np.isin(data.configuration, np.array_split(drawn, self.folds)[fold - 1])


def splits_of(stated: Any) -> tuple[Split, ...]:
    """Return what ``splits`` says: ``"folder"``, a part (0.25), a number of folds (5), or several of them.

    Raises
    ------
    InputError
        For anything else.
    """
    if isinstance(stated, Sequence) and not isinstance(stated, str) and stated:
        return tuple(dict.fromkeys(_split(each) for each in stated))
    return (_split(stated),)


def _split(stated: Any) -> Split:
    number = isinstance(stated, int | float) and not isinstance(stated, bool)
    if stated == FOLDER:
        return Split(FOLDER)
    if number and 0 < stated < 1:
        return Split(f"{stated:g} held out", part=float(stated))
    if number and 2 <= stated <= MOST_FOLDS and stated == int(stated):
        return Split(f"{int(stated)} folds", folds=int(stated))
    accepted = f"'folder', a part of the configurations between 0 and 1, or a number of folds, 2 to {MOST_FOLDS}"
    raise InputError("splits", f"{stated!r}", accepted)


def divide(instance: Instance, split: Split, fold: int, count: int | None, noise: float, seed: int) -> Instance:
    """Return an instance with the data to fit, and the data that are held out as its validation data.

    Parameters
    ----------
    instance
        The problem; its validation data are used by the split ``"folder"`` and by no other.
    split, fold
        What is held out; folds count from 1.
    count
        How many of the configurations that are left are fitted, drawn at random; None for all.
    noise
        By what the noise of the data to fit is larger than it was measured with.
    seed
        Of everything that is drawn.

    Raises
    ------
    InputError
        For fewer configurations than asked, or nothing that is held out.
    """
    data = instance.problem.data
    held_out = instance.validation
    if split.label != FOLDER:
        held = split.held_out(data, fold, seed)
        held_out = data.take(np.flatnonzero(held))
        data = data.take(np.flatnonzero(~held))
    if held_out is None:
        raise InputError("splits", "no validation data", "a folder with some, a part (0.25), or folds (5)")
    if count is not None:
        data = data.configurations(count, seed)
    if noise > 1:
        data = add_noise(data, noise, seed)
    return replace(instance, problem=instance.problem.on(data), validation=held_out)


def add_noise(data: Dataset, factor: float, seed: int) -> Dataset:
    """Return data with as much normal noise added that it is ``factor`` times what it was, and declared so.

    To a row of covariance S comes noise of covariance (factor^2 - 1) S; it then declares factor^2 S.
    """
    rng = np.random.default_rng([seed, NOISE_STREAM])
    return replace(data, blocks=tuple(_add_noise(block, factor, rng) for block in data.blocks))


def _add_noise(block: Block, factor: float, rng: np.random.Generator) -> Block:
    k = block.covariance.shape[1]
    root = np.sqrt(factor**2 - 1) * np.linalg.cholesky(block.covariance)
    error = (root @ rng.standard_normal((len(block.y), k, 1)))[:, :, 0]
    return replace(block, y=block.measurement.plus(block.y, error), covariance=factor**2 * block.covariance)
