"""Choice of the weight during the loop: a number, or a selection rule applied until its result repeats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.convex.program import Program
from rpim_opt.convex.rules.selection import SAME_WEIGHT, Selection, Selector, require_weight
from rpim_opt.convex.select import weight_of

SETTLED = 1e-3  # the weight is chosen anew while a step is longer than this share of the solution, then stays
SAME = 0.01  # two weights are the same when their logarithms differ by no more
SAME_SEARCH = float(np.log(SAME_WEIGHT))  # the same of weights from a search
SAME_ROBUST = 1e-6  # the same of a robust loss, whose weight does not depend on how the measurements are stored
MOST_ANSWERS = 10  # how many different answers a rule may give in turn


@dataclass(frozen=True, eq=False)
class WeightChoice:
    """The weight of an iteration, and how it was chosen.

    ``rule`` is None for a number; ``answers`` are all of its answers in turn, ``selection`` the last one.
    ``settled``: the weight stays while the loop comes to rest; ``final``: for good. ``robust``: the loss is a sum over
    rows, but no square.
    """

    rule: Selector | None
    weight: float = 0.0
    selection: Selection | None = None
    answers: tuple[float, ...] = ()
    settled: bool = False
    final: bool = False
    note: str = ""
    robust: bool = False

    def asked(self, program: Program) -> WeightChoice:
        """Return the choice of the rule for a program, unless the weight is final."""
        if self.settled or self.rule is None:
            return self
        selection = self.rule(program)
        name = getattr(self.rule, "__name__", "selector")
        if isinstance(selection, int | float | np.integer | np.floating) and not isinstance(selection, bool):
            selection = Selection(float(selection), name, np.empty(0), np.empty(0), True)
        if not isinstance(selection, Selection):
            raise InputError(f"selector {name}", f"a {type(selection).__name__}", "a weight, or a Selection with one")
        weight = float(selection.weight)
        if not (np.isfinite(weight) and weight >= 0):
            raise InputError(f"selector {selection.name}", f"weight {weight}", "a number, zero or more")
        chosen = replace(self, weight=weight, selection=selection, answers=(*self.answers, weight))
        if not program.closed_form:  # whose paths are dear: the next answer is asked for where this one leads
            chosen = replace(chosen, settled=True)
        return chosen._checked()

    def after(self, step: float) -> WeightChoice:
        """Return the choice after a step of that relative length."""
        return self if step > SETTLED else replace(self, settled=True)

    def confirmed(self, program: Program) -> WeightChoice:
        """Return the choice after applying the rule to the final program: final, or another weight."""
        if self.final:
            return self
        again = replace(self, settled=False).asked(program)
        apart = SAME  # by how much logarithms of weights differ that a rule tells apart
        selection = again.selection
        if self.robust and program.closed_form:
            apart = SAME_ROBUST
        elif selection is not None and selection.interior:  # an answer from a grid is no closer than its neighbours
            order = np.sort(selection.weights)
            place = int(np.searchsorted(order, selection.weight))
            if 0 < place < len(order) - 1 and order[place] == selection.weight and order[place - 1] > 0:
                apart = float(np.clip(0.5 * np.log(order[place + 1] / order[place - 1]), SAME, SAME_SEARCH))
        if self.answers and _same(again.weight, self.weight, apart):
            return replace(self, settled=True, final=True, note=again.note)
        return again

    def _checked(self) -> WeightChoice:
        """Settle a rule that alternates, or never comes to rest, on the safer of its answers."""
        turns = [self.answers[0]]
        turns += [b for a, b in zip(self.answers, self.answers[1:], strict=False) if not _same(a, b)]
        ended = _alternate(turns, SAME) or len(turns) >= MOST_ANSWERS
        if self.settled and len(turns) >= 3:  # leads where it led before
            ended = ended or _same(turns[-1], turns[-3], SAME_SEARCH)
        last: Sequence[float] = turns
        if not ended and self.robust:  # closer to each other than `SAME`
            ended, last = _alternate(self.answers, SAME_ROBUST), self.answers
        if not ended:
            return self
        one, other = last[-2:]
        low, high = sorted((one, other))
        name = self.selection.name if self.selection else "selector"
        weight, which = high, "the larger one is used"
        if low > 0 and high <= 10 * low:
            weight = float(np.sqrt(low * high))
            which = f"their geometric mean, {weight:.2g}, is used"
        note = ""
        if not _same(one, other):
            note = f"The rule {name} alternates between {one:.2g} and {other:.2g}: {which}."
        return replace(self, weight=weight, settled=True, final=True, note=note)


def _alternate(answers: Sequence[float], apart: float) -> bool:
    if len(answers) < 4:
        return False
    a, b, c, d = answers[-4:]
    return _same(a, c, apart) and _same(b, d, apart) and not _same(c, d, apart)


def _same(one: float, other: float, apart: float = SAME) -> bool:
    if one <= 0 or other <= 0:
        return one == other
    return abs(np.log(one / other)) <= apart


def weight_choice(weight: float | str | Selector, penalized: bool) -> WeightChoice:
    """Return the choice for a number, a selector, or the name of a ready selector; refuse anything else."""
    weight = weight_of(weight)
    if callable(weight):
        return WeightChoice(weight, settled=not penalized, final=not penalized)
    if isinstance(weight, bool) or not isinstance(weight, int | float | np.integer | np.floating):
        raise InputError("weight", f"{weight!r}", "a number, zero or more, or a selector")
    return WeightChoice(None, require_weight(weight, "weight"), settled=True, final=True)
