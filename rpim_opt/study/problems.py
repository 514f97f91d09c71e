"""Problems of a comparison (folders, loaded ones, families that a seed draws from), and what is held out of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.formulation import tikhonov
from rpim_opt.convex.program import Program
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.data.record import Record
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.store.instances import Instance, load

ACCEPTED = "a folder, a name, ro.load(...), a problem, or a function of a seed that returns one"
RETURNS = "an instance, a simulated arm, a problem, or a pair of a problem and validation data"
FOLDER = "folder"
MOST_FOLDS = 10_000
"""Each is a calibration of its own, and is listed before the first begins."""
NOISE_STREAM = 11
"""Stream of the noise that is added, apart from those that draw configurations."""
Labelled = TypeVar("Labelled", bound=Any)


def each_once(where: str, labelled: Sequence[Labelled], what: str) -> tuple[Labelled, ...]:
    """Return things with labels as a tuple; InputError for a label that occurs twice."""
    labels = [each.label for each in labelled]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError(where, f"'{label}' twice", f"a name of its own for each: {{'a name': {what}}}")
    return tuple(labelled)


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
    """Return what a comparison runs on; InputError for what is no problem, and a name that occurs twice."""
    sources = each_once("problems", list(_sources(problems)), "problem")
    if not sources:
        raise InputError("problems", "none", ACCEPTED)
    return sources


def _sources(problems: Any, label: str = "") -> Iterator[Source]:
    instance = _instance(problems, label)
    if isinstance(problems, Mapping):
        for name, problem in problems.items():
            yield from _sources(problem, str(name))
    elif isinstance(problems, str | Path):
        place = Path(problems)
        paths: list[str | Path] = [problems]
        if not label and place.is_dir() and not (place / "problem.toml").is_file():
            paths = [each.parent for each in sorted(place.glob("*/problem.toml"))]
        if not paths:
            raise InputError("problems", f"no problem.toml in '{place}' or a folder in it", ACCEPTED)
        for path in paths:
            place = Path(path)
            name = place.parent.name if place.name == "problem.toml" else place.name
            yield Source(label or name or str(path), load(path))
    elif instance is not None:
        yield Source(label or instance.record.title or instance.problem.robot.name, instance)
    elif isinstance(problems, Iterable) and not label:
        for problem in problems:
            yield from _sources(problem)
    elif isinstance(problems, Program):
        raise InputError("problems", "a program", f"{ACCEPTED}; ro.select.compare compares selectors on a program")
    elif callable(problems):
        yield Source(label or getattr(problems, "__name__", type(problems).__name__), problems)
    else:
        raise InputError("problems", f"a {type(problems).__name__}", ACCEPTED)


def _instance(given: Any, label: str) -> Instance | None:
    """Return a problem in one of its forms as an instance; None for anything else."""
    match given:
        case Instance():
            return given
        case CalibrationProblem():
            return Instance(given, tikhonov, None, record=Record(label))
        case (CalibrationProblem() as problem, Dataset() as validation, *_):  # a simulated arm, too
            return Instance(problem, tikhonov, None, record=Record(label, validation=validation))
    return None


# --- what is held out ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Split:
    """A way to hold configurations out: a random part of them, or each once in a number of folds."""

    label: str
    part: float = 0.0
    folds: int = 1

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
    """Return what ``splits`` says: ``"folder"``, a part (0.25), a number of folds (5), or several of them."""
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

    Of the configurations that a split's fold (from 1) leaves, ``count`` are fitted, drawn at random, or all; their
    noise is ``noise`` times what it was. InputError for fewer configurations, or nothing that is held out.
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
    return replace(instance, problem=instance.problem.on(data), record=replace(instance.record, validation=held_out))


def add_noise(data: Dataset, factor: float, seed: int) -> Dataset:
    """Return data with as much normal noise added that it is ``factor`` times what it was, and declared so.

    To a row of covariance S comes noise of covariance (factor^2 - 1) S; it then declares factor^2 S.
    """
    rng = np.random.default_rng([seed, NOISE_STREAM])

    def noisy(block: Block) -> Block:
        k = block.covariance.shape[1]
        root = np.sqrt(factor**2 - 1) * np.linalg.cholesky(block.covariance)
        error = (root @ rng.standard_normal((len(block.y), k, 1)))[:, :, 0]
        return replace(block, y=block.measurement.plus(block.y, error), covariance=factor**2 * block.covariance)

    return replace(data, blocks=tuple(map(noisy, data.blocks)))
