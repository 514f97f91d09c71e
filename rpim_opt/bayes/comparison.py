"""Evidence of model extensions at a result, whatever its weight: without them, and with more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from typing import Protocol

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.bayes.evidence import CENTRES, Evidence, Point
from rpim_opt.bayes.hyperparameters import Learned, Learning, sides
from rpim_opt.bayes.learning import sampled
from rpim_opt.bayes.model_selection import SESSIONS, WARMTH, compared, extended, members, restricted, size_names
from rpim_opt.bayes.outliers import clustered
from rpim_opt.bayes.prior import Prior, family_of
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.source import Source

SPEAK = 10.0
"""By how much -2 ln L must fall for a family to be spoken of: 4 is what a false pick gains, 10 none in many."""
EXACT = 1e-7
"""Relative accuracy of -2 ln L: far below what decides."""
OWNED = {
    "gravity": ("compliance", "bend"),
    "first harmonic": ("ecc",),
    "second harmonic": ("ecc2",),
    SESSIONS: ("session",),
    WARMTH: ("expansion",),
}
"""Families whose worth is asked, and what stands for them."""
KNOWN = Prior(joint_offset=1.0, frames=1.0)
"""What is believed once scales were learned: they are as the problem says."""


class Flagged(Protocol):
    """A row that a fit distrusts."""

    @property
    def label(self) -> str:
        """Of the row."""
        ...


class Outcome(Protocol):
    """What is asked of a result: a `Calibration` has it."""

    @property
    def problem(self) -> Source:
        """What was asked."""
        ...

    @property
    def x(self) -> Array:
        """(n,) deviations [SI]."""
        ...

    @property
    def learned(self) -> Learned | None:
        """The hyperparameters, where they were estimated."""
        ...

    @cached_property
    def flagged(self) -> Sequence[Flagged]:
        """Rows that the fit distrusts."""
        ...


@dataclass(frozen=True, eq=False)
class Judged:
    """A model that was compared: families beside what the result identifies, its parameters, and their sizes."""

    families: tuple[str, ...]
    names: tuple[str, ...]
    evidence: Evidence
    point: Point

    @cached_property
    def residual(self) -> Array:
        """What it leaves (m,) [SI]."""
        data = self.evidence.data
        return data.y - data.X @ self.point.z


class Comparison:
    """Models with and without families, all at the linearization of one result.

    Parameters
    ----------
    result
        Any calibration; of large data `learning.MOST` configurations are looked at.
    """

    def __init__(self, result: Outcome) -> None:
        self.result = result
        self.problem = _trusted(result)
        self.own = self.problem.parameters.free.names
        self.families = members(self.problem)
        every = tuple(name for names in self.families.values() for name in names)
        whole, x = extended(self.problem, result.x, every)
        self.names = whole.parameters.free.names
        self.columns = _learning(result).evidence(whole, x)

    @cached_property
    def configurations(self) -> int:
        """How many configurations are looked at."""
        return len(np.unique(self.problem.data.configuration))

    @cached_property
    def dimension(self) -> str:
        """``length``; ``angle`` where none was measured, ``pixel`` where a camera alone has seen."""
        stacks = self.columns.data.stacks
        return next(d for d in ("length", "angle", "pixel") if any(stack.of(d).any() for stack in stacks))

    @cached_property
    def equations(self) -> np.ndarray:
        """The numbers of the equations of that dimension."""
        stacks = self.columns.data.stacks
        return np.sort(np.concatenate([stack.index[stack.of(self.dimension)] for stack in stacks]))

    @cached_property
    def row(self) -> np.ndarray:
        """The row (m,) of every equation."""
        return self.problem.owners

    @cached_property
    def rows(self) -> int:
        """How many rows have such equations."""
        return len(np.unique(self.row[self.equations]))

    @cached_property
    def spare(self) -> float:
        """How many equations the deviations leave over, in the result's model."""
        point = self.plain.point
        return len(self.row) - float(np.sum(1 - np.diag(point.C) / point.v))

    @cached_property
    def plain(self) -> Judged:
        """The model that the result has."""
        used = np.isin(self.names, self.own)
        evidence = restricted(self.columns, used)
        if self.result.learned is not None:
            first = [_learned_by(self.result.learned, evidence)]
        else:
            first = sides(self.problem, evidence)
        return Judged((), self.own, evidence, evidence.mode(first, EXACT)[0])

    @cached_property
    def best(self) -> Judged:
        """The model that the data want, at a price of `SPEAK` a family."""
        learned = self.result.learned
        if learned is not None and learned.trials:  # the evidence has spoken
            return self.plain
        found = compared(self.problem, self.families, self._priced)
        return min([self._priced(()), *found], key=itemgetter(0))[2]

    def _priced(self, families: tuple[str, ...]) -> tuple[float, tuple[str, ...], Judged]:
        model = self.plain
        if families:
            model = self._with(families)
        return model.point.value + SPEAK * len(families), families, model

    @cached_property
    def gain(self) -> float:
        """By how much -2 ln L falls from the result's model to the best."""
        return self.plain.point.value - self.best.point.value

    def owned(self) -> dict[str, np.ndarray]:
        """Return the families that the result identifies, with which parameters (n,) are theirs.

        First moments of links are gravity's, too: either would stand for the other.
        """
        group = [family_of(name) for name in self.own]
        found = {}
        for family, patterns in OWNED.items():
            members = np.isin(group, patterns)
            if members.any():
                found[family] = members
        return found

    def worth(self, members: np.ndarray) -> float:
        """Return by how much -2 ln L would rise without some of the result's own parameters (n,)."""
        keep = np.isin(self.names, [name for name, out in zip(self.own, members, strict=True) if not out])
        return self._fitted((), keep).point.value - self.plain.point.value

    def _with(self, families: tuple[str, ...]) -> Judged:
        used = set(self.own).union(*(self.families[family] for family in families))
        return self._fitted(families, np.isin(self.names, list(used)))

    def _fitted(self, families: tuple[str, ...], keep: np.ndarray) -> Judged:
        """Return a model at its sizes, looked for from those of the result's."""
        evidence = restricted(self.columns, keep)
        names = tuple(np.array(self.names)[keep].tolist())
        return Judged(families, names, evidence, evidence.mode([self._from_plain(evidence)], EXACT)[0])

    def _from_plain(self, evidence: Evidence) -> Array:
        plain = self.plain
        known = dict(zip(size_names(plain.evidence), plain.point.logs, strict=True))
        return np.array([known.get(name, c) for name, c in zip(size_names(evidence), evidence.centre, strict=True)])


def _learned_by(learned: Learned, evidence: Evidence) -> Array:
    """Return the sizes that a result learned, as far as it did."""
    logs = evidence.centre.copy()
    for i, name in enumerate(size_names(evidence)):
        if name in learned.noise and name in CENTRES:
            logs[i] = np.log(learned.noise[name].value)
    return logs


def _trusted(result: Outcome) -> CalibrationProblem:
    """Return the problem in memory without scatter, and without flagged rows unless they err as their neighbours do."""
    problem = sampled(result.problem.scattered(None))
    labels = {label: i for i, label in enumerate(problem.labels)}
    rows = np.array([labels[flag.label] for flag in result.flagged if flag.label in labels], dtype=int)
    if not len(rows) or len(rows) > len(labels) / 4:
        return problem
    alone = rows[~clustered(problem, result.x, rows)]
    if not len(alone):
        return problem
    return problem.without({problem.labels[i] for i in alone})


def _learning(result: Outcome) -> Learning:
    """Return how the evidence is asked: scales that were learned are taken at their word."""
    learned = result.learned
    if learned is None:
        return Learning(Prior(), ("position", "orientation", "joint"))
    kinds = ["position", "orientation", "joint"]
    if "instrument" in learned.noise:
        kinds.append("instrument")
    return Learning(KNOWN, tuple(kinds))
