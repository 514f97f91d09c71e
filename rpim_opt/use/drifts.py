"""Which parameter moved during checks, since when, and whether at once or steadily."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.units import display
from rpim_opt.convex.structure import Quadratic, identity
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.use.carried import Carried
from rpim_opt.use.changes import Cause, Missed, possible

MOMENTS = 40
"""Checks before which a change is looked for; of more so many, evenly."""


class Drift(NamedTuple):
    """A change during checks.

    What moved, the number of the first check that sees it, whether it moves steadily from the first to the last check,
    and by how much a single parameter moved in all, with its standard deviation [SI] (None for a frame).
    """

    cause: Cause
    first: int
    steady: bool
    change: float | None
    std: float | None
    dimension: str

    def content(self) -> dict[str, Any]:
        """Return it as a document [mm, deg]."""
        unit, si = display(self.dimension)
        change = None
        if self.change is not None and self.std is not None:
            change = {"unit": unit, "change": self.change / si, "std": self.std / si}
        return {**self.cause._asdict(), "first": self.first, "steady": self.steady, "moved": change}


def likeliest(carried: Carried, problem: CalibrationProblem, rare: float) -> Drift | None:
    """Return the change that explains checks best; None where chance does, over all changes that were tried.

    Parameters
    ----------
    carried
        The result.
    problem
        Its problem with the checks in the order of time.
    rare
        Probability of a change where nothing moved.
    """
    model = problem.linearize(carried.start(problem))
    penalty = carried.formulation(problem, ()).penalty
    form: Quadratic = getattr(penalty, "quadratic", None) or identity(model.A.shape[1])
    missed = carried.missed(model, form)
    # rows of one configuration were read together: the first of them says when
    numbers, first = np.unique(problem.data.configuration, return_index=True)
    when = first[np.searchsorted(numbers, model.group)]
    free = problem.parameters.free
    tried = list(_tried(missed, possible(free, np.ones(len(free), dtype=bool)), when, len(problem.data)))
    best = min(tried, key=lambda drift: (drift.cause.chance, -drift.cause.gain))
    if best.cause.chance * len(tried) >= rare:
        return None
    return best


def _tried(missed: Missed, causes: list[Cause], when: np.ndarray, count: int) -> Iterator[Drift]:
    """Yield all changes with their evidence: of every cause at every moment, and steadily."""
    free = missed.model.parameters
    courses = [(int(first), False, (when >= first).astype(float)) for first in _moments(count)]
    if count > 2:
        courses.append((0, True, when / (count - 1)))
    for cause in causes:
        index = [free.names.index(name) for name in cause.members]
        for first, steady, course in courses:
            g, G = missed.of_drift(index, course)
            gain, chance = missed.gain(g, G)
            change, std = _size(g, G, float(free.scale[index[0]]))
            yield Drift(cause._replace(gain=gain, chance=chance), first, steady, change, std, free.dimensions[index[0]])


def _moments(count: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, MOMENTS)).round().astype(int))


def _size(g: Array, G: Array, scale: float) -> tuple[float | None, float | None]:
    """Return change and standard deviation [SI] of a single parameter."""
    if len(g) > 1 or not G[0, 0] > 0:
        return None, None
    return float(scale * g[0] / G[0, 0]), float(scale / np.sqrt(G[0, 0]))
