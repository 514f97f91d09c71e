"""What an update found: whether the robot changed, which parameters did, and what is known of it now."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

from rpim_opt.basics.text import joined, table
from rpim_opt.basics.units import display
from rpim_opt.calibration.result import Calibration
from rpim_opt.use.changes import Cause, Fit

RIVAL = 0.05
"""Belief from which on another cause is named beside the most believed one."""
SHOWN = 5
"""Causes that are shown where nothing changed."""


class Moved(NamedTuple):
    """A parameter that was let go: by how much it moved, and the standard deviation of that [SI]."""

    name: str
    dimension: str
    change: float
    std: float

    def __str__(self) -> str:
        """Return it in mm or degrees."""
        unit, si = display(self.dimension)
        return f"{self.name} {self.change / si:+.4g} {unit} (standard deviation {self.std / si:.2g})"

    def content(self) -> dict[str, Any]:
        """Return it as a document."""
        unit, si = display(self.dimension)
        return {"name": self.name, "unit": unit, "change": self.change / si, "std": self.std / si}


@dataclass(frozen=True, eq=False)
class Update:
    """A calibration that carries on an earlier one.

    Parameters
    ----------
    result
        The calibration, whose record says what it carries on.
    before, after
        How the readings fit the last calibration, and what is left with the changes.
    changes
        What changed, in the order in which it was found: parameters, frames, or wrong readings, which were left out.
    causes
        All that may have changed, with its evidence before anything was let go, the most believed first.
    moved
        By how much what was let go moved.
    readings
        Rows that were given.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> first = ro.calibrate(problem.on(problem.data.take(np.arange(32))))
    >>> found = ro.use.update(first, problem.data.take(np.arange(32, 40)))
    >>> found.changed, found.explained, found.causes[0].chance > 1e-4
    (False, True, True)
    """

    result: Calibration
    before: Fit
    after: Fit
    changes: tuple[Cause, ...]
    causes: tuple[Cause, ...]
    moved: tuple[Moved, ...]
    readings: int

    @property
    def changed(self) -> bool:
        """Whether the robot, or where it stands, is not what it was."""
        return any(cause.kind != "reading" for cause in self.changes)

    @property
    def explained(self) -> bool:
        """Whether readings and the last calibration agree, but for what was found."""
        return self.after.likely

    def content(self) -> dict[str, Any]:
        """Return the figures [mm, deg], all causes, and what the result says.

        >>> import numpy as np
        >>> import rpim_opt as ro
        >>> problem = ro.load("position").problem
        >>> first = ro.calibrate(problem.on(problem.data.take(np.arange(32))))
        >>> found = ro.use.update(first, problem.data.take(np.arange(32, 40))).content()
        >>> found["changed"], found["readings"], found["earlier"][0]["rows"]
        (False, 8, 32)
        """
        return {
            "changed": self.changed,
            "explained": self.explained,
            "before": self.before._asdict(),
            "after": self.after._asdict(),
            "changes": [cause._asdict() for cause in self.changes],
            "moved": [each.content() for each in self.moved],
            "causes": [cause._asdict() for cause in self.causes],
            "readings": self.readings,
            "converged": self.result.converged,
            "earlier": [each._asdict() for each in self.result.record.earlier],
        }

    def __str__(self) -> str:
        """Return the verdict in words, what moved, and the causes that were weighed."""
        lines = [*self._verdict(), *self._left(), "", self._causes(), "", self.result.message]
        return "\n".join(lines)

    def _verdict(self) -> list[str]:
        count = f"{self.readings} readings"
        if not self.changes and self.before.likely:
            return [f"The robot has not changed, as far as {count} can tell: {_said(self.before)}.", *self._let_go()]
        if not self.changes:
            text = f"{count} miss the last calibration by more than it allows: {_said(self.before)}."
            return [text[0].upper() + text[1:], *self._let_go()]
        said = "The robot has changed"
        if not self.changed:
            said = "The robot has not changed, but readings are wrong"
        lines = [f"{said}: {_said(self.before)} as it was."]
        lines += [self._change(cause) for cause in self.changes]
        return [*lines, *self._let_go()]

    def _change(self, cause: Cause) -> str:
        text = f"{cause.kind} {cause.name}: chi-squared falls by {cause.gain:.1f}, belief {cause.believed:.2g}"
        if cause.kind == "reading":
            text += ", left out"
        return f"  {text}."

    def _let_go(self) -> list[str]:
        if not self.moved:
            return []
        return [f"Moved since: {joined([str(each) for each in self.moved])}."]

    def _left(self) -> list[str]:
        lines = []
        rivals = [c.name for c in self.causes[1:] if self.changes and c.believed > RIVAL]
        if rivals:
            lines.append(f"These readings do not tell it apart from a change of {joined(rivals)}: measure more.")
        if self.changes:
            lines.append(f"What is left: {_said(self.after)}.")
        if not self.explained:
            lines.append(
                "No few changes of parameters, frames or readings explain the rest: is it the same robot? "
                "If so, calibrate it anew."
            )
        return lines

    def _causes(self) -> str:
        rows = [[c.name, c.kind, f"{c.gain:.1f}", f"{c.chance:.2g}", f"{c.believed:.2g}"] for c in self.causes[:SHOWN]]
        return table(["may have changed", "kind", "chi-squared falls by", "by chance", "belief"], rows)


def _said(fit: Fit) -> str:
    return f"chi-squared {fit.squares:.1f} of {fit.equations}, probability {fit.probability:.2g}"
