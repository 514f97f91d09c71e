"""Errors: each names the culprit, what was found, what is accepted, and the remedy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple


class RpimError(Exception):
    """Base of every error that this package raises on purpose.

    >>> import rpim_opt as ro
    >>> try:
    ...     ro.load("paper_arm", variant="bound")
    ... except ro.RpimError as error:
    ...     print(type(error).__name__)
    InputError
    """


class InputError(RpimError):
    """Something a user wrote cannot be used.

    Reads as one sentence, ``file, where: found ..., accepted: ...``; the parts stay available as attributes.

    Parameters
    ----------
    where
        The key, column, row or argument.
    found, accepted
        What stands there, and what could.
    file
        The file it stands in; None where there is none.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> error = ro.InputError("key joint 2.d_mm", "'long'", "a finite number")
    >>> print(error.within("robot.toml"))
    robot.toml, key joint 2.d_mm: found 'long', accepted: a finite number.
    """

    def __init__(self, where: str, found: str, accepted: str, file: object = None):
        self.file, self.where, self.found, self.accepted = file, where, found, accepted
        place = f"{file}, {where}" if file else where
        super().__init__(f"{place}: found {found}, accepted: {accepted}.")

    def within(self, file: object) -> InputError:
        """Return the same error with the file it occurred in, unless it names one already."""
        return self if self.file else InputError(self.where, self.found, self.accepted, file)


class Conflict(NamedTuple):
    """What contradicts what: by how much bounds of parameters [SI] or of configurations [sigma] would have to give way.

    Each of the two alone makes the program feasible, with the least sum; empty where it cannot.
    """

    parameters: dict[str, float]
    configurations: dict[Any, float]


class NoSolutionFound(RpimError):
    """A convex program was not solved; its parameters, kept as attributes, are the evidence.

    Parameters
    ----------
    program
        The `ConvexProgram`.
    weight
        At which it was to be solved.
    status
        How the solver ended, ``"infeasible"`` for instance.
    conflict
        What contradicts what; None where that is not known.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> problem = ro.load("paper_arm").problem
    >>> tight = problem.parameters.toleranced({"length_mm": 0.5, "angle_mrad": 0.5})
    >>> exact = ro.Formulation("all within a sigma", largest=1.0, constraints=(ro.within_tolerance,))
    >>> try:
    ...     ro.calibrate(ro.CalibrationProblem(problem.robot, tight, problem.data), exact)
    ... except ro.NoSolutionFound as error:
    ...     print(error.status, *error.conflict.parameters)  # whose tolerances contradict the measurements
    infeasible a3 a4 d5 d6
    """

    def __init__(self, program: Any, weight: float, status: str, conflict: Conflict | None = None):
        self.program, self.weight, self.status, self.conflict = program, weight, status, conflict
        text = f"Formulation '{program.formulation.name}' at weight {weight:.3g}: the solver ended with '{status}'; "
        given = conflict or Conflict({}, {})
        bounds = ", ".join(f"{name} by {1e3 * v:.3g} mm or mrad" for name, v in given.parameters.items())
        rows = ", ".join(f"{name} by {v:.3g} sigmas" for name, v in given.configurations.items())
        if bounds and rows:
            text += f"bounds contradict measurements: loosening {bounds} would do, and so would loosening {rows}."
        elif bounds or rows:
            text += f"loosening {bounds or rows} would do."
        else:
            text += "check that constraints and data can hold together, or change the weight."
        super().__init__(text)

    def naming(self, names: Mapping[int, str]) -> NoSolutionFound:
        """Return the same error with names for the configurations' numbers.

        >>> import rpim_opt as ro
        >>> from rpim_opt.exceptions import Conflict
        >>> program = ro.calibrate(ro.load("paper_arm").problem, weight=1e-3).program
        >>> error = ro.NoSolutionFound(program, 1e-3, "infeasible", Conflict({}, {3: 1.5}))
        >>> error.naming({3: "P4"}).conflict.configurations
        {'P4': 1.5}
        """
        if not self.conflict:
            return self
        rows = {names.get(k, k): v for k, v in self.conflict.configurations.items()}
        return NoSolutionFound(self.program, self.weight, self.status, self.conflict._replace(configurations=rows))


def choices(found: str, known: Iterable[str], many: int = 24) -> str:
    """List what is known; of more than ``many`` what resembles ``found``, and how many others there are."""
    names = list(known)
    close = difflib.get_close_matches(found, names, n=2, cutoff=0.6)
    shown = names
    if len(names) > many:
        shown = difflib.get_close_matches(found, names, n=8, cutoff=0.0)
        shown = [name for name in names if name in shown]
    listed = ", ".join(shown) if names else "nothing"
    more = f" and {len(names) - len(shown)} others" if len(shown) < len(names) else ""
    return f"{listed}{more} (did you mean {' or '.join(close)}?)" if close else listed + more
