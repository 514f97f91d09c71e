"""Exceptions, whose messages name the place, the value found, the accepted values and the remedy."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple, ParamSpec, TypeVar

Named = TypeVar("Named")
Answer = TypeVar("Answer")
Options = ParamSpec("Options")
LONGEST = 1000  # characters of a part of a sentence
MANY = 32  # names that are listed one by one
LONGEST_COMPARED = 200
"""Longest text that is compared with names: these are shorter, and comparison takes time in proportion."""

OPTION = re.compile(r"(rpim-opt [^,;()]*)|(?<![\w-])--([a-z][a-z-]*)")
"""A command with its options, which stays as it is, or an option."""


class RpimError(Exception):
    """Base class of all exceptions of this package."""


class InputError(RpimError):
    """Invalid input: an argument, a file, a key, a column or a row.

    Reads as one sentence, ``file, where: found ..., accepted: ...``; the parts are available as attributes. ``where``
    is the key, column, row or argument, ``found`` its content, ``accepted`` a valid one, ``file`` the file that has it,
    None without one. Options of the command line, ``--tip-measured``, are named like arguments of a script,
    ``tip_measured``, except in the attribute ``command``, which the command line prints.

    >>> import rpim_opt as ro
    >>> error = ro.InputError("key joint 2.d_mm", "'long'", "a finite number")
    >>> print(error.within("robot.toml"))
    robot.toml, key joint 2.d_mm: found 'long', accepted: a finite number.
    """

    def __init__(self, where: str, found: str, accepted: str, file: object = None):
        self.file = file
        self.where = _one_line(where)
        self.found = _one_line(found)
        self.accepted = _one_line(accepted)
        place = f"{_one_line(str(file))}, {self.where}" if file else self.where
        self.command = f"{place}: found {self.found}, accepted: {self.accepted}."
        super().__init__(OPTION.sub(lambda match: match[1] or match[2].replace("-", "_"), self.command))

    def within(self, file: object) -> InputError:
        """Return the error with the file added, unless it already names one."""
        return self if self.file else InputError(self.where, self.found, self.accepted, file)


@contextmanager
def in_file(source: object) -> Iterator[None]:
    """Add the name of the file that is being read to an InputError, unless the source is no path."""
    try:
        yield
    except InputError as error:
        raise error.within(source if isinstance(source, str | Path) else None) from None


def of_file(function: Callable[Options, Answer]) -> Callable[Options, Answer]:
    """Let the InputErrors of a function name the file that is its first argument."""

    @wraps(function)
    def named(*arguments: Options.args, **options: Options.kwargs) -> Answer:
        with in_file(next(iter((*arguments, *options.values())))):
            return function(*arguments, **options)

    return named


def _one_line(text: str) -> str:
    """Return a text on one line, shortened: text from a file may have line breaks and any length."""
    line = " ".join(text.splitlines())
    return line if len(line) <= LONGEST else f"{line[:LONGEST]}..."


class NotDelivered(InputError):
    """The robot of a failed calibration was requested; ``despite_verdict=True`` writes it with a note."""


class RowError(InputError):
    """Invalid value in a row of a table (counted from 0)."""

    def __init__(self, row: int, found: str, accepted: str):
        super().__init__(f"row {row + 1}", found, accepted)
        self.row = row


class Conflict(NamedTuple):
    """Contradictory constraints, and the loosening [SI] of bounds and ``stated`` constraints that removes the conflict.

    ``constraints`` cannot hold together, and none can be left out; ``loosen`` says by how much, of either kind.
    """

    parameters: dict[str, float]
    constraints: tuple[str, ...] = ()
    stated: Mapping[str, float] = MappingProxyType({})
    loosen: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return the contradiction as a sentence; empty if there is none."""
        parts = []
        if self.constraints:
            parts.append(f"these constraints contradict each other: {', '.join(self.constraints)}")
        return "; ".join([*parts, *(f"loosen {each}" for each in self.loosen if each)])


class NoSolutionFound(RpimError):
    """A convex program has no solution, or the solver found none.

    ``formulation`` is the name of the formulation, ``weight`` the regularization weight, ``status`` the solver's, such
    as ``"infeasible"``; ``conflict`` are the contradicting constraints, None if unknown, and ``advice`` is a remedy
    without them.

    >>> import rpim_opt as ro
    >>> problem = ro.load("paper_arm").problem
    >>> tight = problem.parameters.toleranced({"length_mm": 0.5, "angle_mrad": 0.5})
    >>> longer = ro.constraints.parse("a3 = nominal + 2 mm")
    >>> drawn = ro.Formulation("as drawn", constraints=(ro.within_tolerance, longer))
    >>> try:
    ...     ro.calibrate(ro.CalibrationProblem(problem.robot, tight, problem.data), drawn)
    ... except ro.NoSolutionFound as error:
    ...     print(error.status, *error.conflict.parameters)  # whose tolerances contradict the statement
    infeasible a3
    """

    def __init__(
        self, formulation: str, weight: float, status: str, conflict: Conflict | None = None, advice: str = ""
    ):
        self.formulation = formulation
        self.weight = weight
        self.status = status
        self.conflict = conflict
        self.advice = advice
        contradiction = str(conflict) if conflict else ""
        why = contradiction or advice or "use another weight, or add constraints that bound the solution"
        program = f"Formulation '{formulation}' at weight {weight:.3g}"
        super().__init__(f"{program}: the solver ended with '{status}'; {why}.")


def choices(found: str, known: Iterable[str]) -> str:
    """Return the valid names as text; of more than `MANY` those similar to ``found`` and the number of the others."""
    names = list(known)
    found = found[:LONGEST_COMPARED]
    listed = ", ".join(names) or "nothing"
    if len(names) > MANY:
        near = difflib.get_close_matches(found, names, n=8, cutoff=0.0)
        listed = ", ".join(name for name in names if name in near) + f" and {len(names) - len(near)} others"
    close = difflib.get_close_matches(found, names, n=2, cutoff=0.6)
    return listed + (f" (did you mean {' or '.join(close)}?)" if close else "")


def pick(known: Mapping[str, Named], name: str, where: str, file: object = None, also: str = "") -> Named:
    """Return ``known[name]``; InputError with the valid names if there is none."""
    if name not in known:
        raise InputError(where, f"'{name}'", also + choices(name, known), file)
    return known[name]
