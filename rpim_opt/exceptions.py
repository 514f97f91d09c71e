"""Errors: each names the culprit, what was found, what is accepted, and the remedy."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple


class RpimError(Exception):
    """Base of every error that this package raises on purpose."""


class InputError(RpimError):
    """Something a user wrote cannot be used.

    Reads as one sentence: ``file, where: found ..., accepted ...``. The parts stay
    available as attributes ``file``, ``where``, ``found`` and ``accepted``.
    """

    def __init__(self, where: str, found: str, accepted: str, file: object = None):
        self.file, self.where, self.found, self.accepted = file, where, found, accepted
        place = f"{file}, {where}" if file else where
        super().__init__(f"{place}: found {found}, accepted: {accepted}.")

    def within(self, file: object) -> InputError:
        """Return the same error with the file it occurred in."""
        return self if self.file else InputError(self.where, self.found, self.accepted, file)


class Conflict(NamedTuple):
    """What contradicts what: by how much bounds of parameters [SI] or of configurations [sigma] would have to give way.

    Each of the two alone makes the program feasible, with the least sum; empty where it cannot.
    """

    parameters: dict[str, float]
    configurations: dict[Any, float]


class NoSolutionFound(RpimError):
    """A convex program was not solved; ``program``, ``weight``, ``status`` and ``conflict`` are the evidence."""

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
        """Return the same error with names for the configurations' numbers."""
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
