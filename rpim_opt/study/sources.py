"""What a comparison runs on: folders, loaded problems, and families of simulated ones that a seed draws from."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.formulation import tikhonov
from rpim_opt.convex.program import Program
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.store.instances import Instance, load
from rpim_opt.study.arms import SimulatedArm

ACCEPTED = "a folder, a name, ro.load(...), a problem, or a function of a seed that returns one"


@dataclass(frozen=True, eq=False)
class Source:
    """A problem with its name; one that is drawn is another one for every seed.

    Parameters
    ----------
    label
        What rows call it.
    what
        An instance, or a function of a seed.
    """

    label: str
    what: Instance | Callable[[int], Any]

    @property
    def drawn(self) -> bool:
        """Whether a seed draws it."""
        return not isinstance(self.what, Instance)

    def made(self, seed: int) -> Instance:
        """Return the instance of a seed."""
        if isinstance(self.what, Instance):
            return self.what
        made = _instance(self.what(seed), self.label)
        if made is None:
            raise InputError(f"problem {self.label}", f"a function of a seed that returns no problem ({seed})", RETURNS)
        return made


RETURNS = "an instance, a simulated arm, a problem, or a pair of a problem and validation data"


def sources(problems: Any) -> tuple[Source, ...]:
    """Return what a comparison runs on, each with a name of its own.

    Raises
    ------
    InputError
        For what is no problem, a folder without any, and a name that occurs twice.
    """
    found = tuple(_each(problems))
    if not found:
        raise InputError("problems", "none", ACCEPTED)
    labels = [source.label for source in found]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError("problems", f"'{label}' twice", "a name of its own for each: {'a name': problem}")
    return found


def _each(problems: Any) -> Iterator[Source]:
    if isinstance(problems, Mapping):
        for label, problem in problems.items():
            yield _labelled(str(label), problem)
    elif isinstance(problems, str | Path):
        yield from _of_path(problems)
    elif isinstance(problems, tuple) and _instance(problems, "") is not None:
        yield _labelled("problem", problems)
    elif isinstance(problems, Iterable):
        for problem in problems:
            yield from _each(problem)
    else:
        yield _labelled(_name(problems), problems)


def _of_path(path: str | Path) -> Iterator[Source]:
    """Yield the problem of a folder or a name, or those of the folders in a folder."""
    place = Path(path)
    if place.is_dir() and not (place / "problem.toml").is_file():
        inside = sorted(each.parent for each in place.glob("*/problem.toml"))
        if not inside:
            raise InputError("problems", f"no problem.toml in '{place}' or a folder in it", ACCEPTED)
        yield from (Source(folder.name, load(folder)) for folder in inside)
        return
    label = place.name
    if label == "problem.toml":
        label = place.parent.name
    yield Source(label or str(path), load(path))


def _labelled(label: str, given: Any) -> Source:
    if isinstance(given, str | Path):
        return Source(label, load(given))
    made = _instance(given, label)
    if made is not None:
        return Source(label, made)
    if callable(given):
        return Source(label, given)
    if isinstance(given, Program):
        raise InputError("problems", "a program", f"{ACCEPTED}; ro.select.compare compares selectors on a program")
    raise InputError("problems", f"a {type(given).__name__}", ACCEPTED)


def _name(given: Any) -> str:
    if isinstance(given, Instance):
        return given.title
    if isinstance(given, CalibrationProblem):
        return given.robot.name
    return getattr(given, "__name__", type(given).__name__)


def _instance(made: Any, label: str) -> Instance | None:
    """Return what was given as an instance, if it is a problem in one of its forms."""
    if isinstance(made, Instance):
        return made
    if isinstance(made, SimulatedArm):
        return _plain(label, made.problem, made.true)
    if isinstance(made, CalibrationProblem):
        return _plain(label, made, None)
    match made:
        case (CalibrationProblem() as problem, Dataset() as validation):
            return _plain(label, problem, validation)
    return None


def _plain(label: str, problem: CalibrationProblem, validation: Dataset | None) -> Instance:
    return Instance(label, "", problem, validation, tikhonov, None)
