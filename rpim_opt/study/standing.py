"""A comparison in one table: methods in their order, how sure that order is, and what could not be computed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rpim_opt.basics.tables import frame_of
from rpim_opt.basics.text import html_table, listed, table
from rpim_opt.study.pairs import CONFIDENCE, ENOUGH, TIE, Standing
from rpim_opt.study.replicate import NUMBERS


@dataclass(frozen=True)
class Summary:
    """Methods by their figures, those that are best in the geometric mean first.

    Parameters
    ----------
    metric
        What is compared; less is better.
    reference
        The method that the others are compared with.
    standings
        One a method that has figures.
    notes
        What a reader must know: of what the intervals speak, and what has no figures, with the reason.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> found = ro.compare("position", ["tikhonov", "lasso"], ["reml", 1.0], splits=5)
    >>> summary = found.summary(against="tikhonov, 1")
    >>> [each.method for each in summary.standings]
    ['tikhonov, 1', 'tikhonov, reml', 'lasso, 1']
    >>> summary.header[:2], summary.cells()[0][3:]
    (('method', 'median rms_mm'), ['1', 'reference', ''])
    >>> summary.notes[-1]
    "lasso, reml: impossible, 5 of 5 replicates. Selector reml: found formulation 'lasso', accepted: ..."
    >>> len(summary.to_frame())
    3
    """

    metric: str
    reference: str
    standings: tuple[Standing, ...]
    notes: tuple[str, ...]

    def to_frame(self) -> Any:
        """Return the standings as a data frame (pandas, or polars where that is missing)."""
        return frame_of([asdict(each) for each in self.standings])

    @property
    def header(self) -> tuple[str, ...]:
        """What the columns are called."""
        over = f"over {self.reference}"
        columns = ("method", f"median {self.metric}", "worst", over, "95 % interval", "better/tie/worse")
        if self._some_missing:
            return (*columns, "no figure")
        return columns

    def cells(self) -> list[list[str]]:
        """Return the table's rows as text."""
        return [self._cells(each) for each in self.standings]

    def _cells(self, each: Standing) -> list[str]:
        against = [number(each.ratio), _between(each), f"{each.wins}/{each.ties}/{each.losses}"]
        if each.method == self.reference:
            against = ["1", "reference", ""]
        missing = []
        if self._some_missing:
            missing = [f"{each.missing} of {each.replicates}"]
        return [each.method, number(each.median), number(each.worst), *against, *missing]

    @property
    def _some_missing(self) -> bool:
        return any(each.missing for each in self.standings)

    def __str__(self) -> str:
        """Return the table and the notes."""
        return "\n".join([table(self.header, self.cells()), "", *self.notes])

    def _repr_html_(self) -> str:
        """Return the same for a notebook."""
        return html_table(self.header, self.cells(), self.notes)


def number(value: float | None, digits: int = 3) -> str:
    """Return a figure with the digits that matter; nothing for none."""
    if value is None:
        return ""
    if 1e-3 <= abs(value) < 1e4:
        decimals = max(digits - 1 - _power(value), 0)
        return f"{value:.{decimals}f}"
    return f"{value:.{digits}g}"


def _power(value: float) -> int:
    """Return the decimal power of a number's first digit, at most that of ones."""
    return min(int(f"{value:e}".partition("e")[2]), 3)


def _between(each: Standing) -> str:
    if each.low is None or each.high is None:
        return ""
    mark = " *" if each.different else ""
    return f"{number(each.low)} to {number(each.high)}{mark}"


def notes_of(
    rows: Sequence[Mapping[str, Any]], standings: Sequence[Standing], drawn: frozenset[str], reference: str
) -> tuple[str, ...]:
    """Return what a reader must know besides the table."""
    said = [f"Ratios are of the same replicates in pairs, geometric mean over problems; a tie is within {TIE:.0%}."]
    compared = sum(each.low is not None and each.method != reference for each in standings)
    if compared:
        said.append(_intervals({row["problem"] for row in rows}, drawn, compared))
    elif len(standings) > 1:
        few = f"fewer than {ENOUGH} problems, and fewer than {ENOUGH} seeds or folds on one"
        said.append(f"There are no intervals: {few}.")
    late = sum(each.unconverged for each in standings)
    if late:
        said.append(f"{late} replicates did not converge; their figures count (column status).")
    return (*said, *_without(rows))


def _intervals(problems: set[str], drawn: frozenset[str], compared: int) -> str:
    """Say what the intervals speak of, and how many are wrong by chance."""
    scope = f"other problems like these {len(problems)}"
    if len(problems) < ENOUGH and problems <= drawn:
        scope = "other arms of the same family"
    elif len(problems) < ENOUGH:
        scope = "these problems alone, with other seeds or folds"
    said = f"Intervals speak of {scope} (bootstrap, {CONFIDENCE:.0%}); * leaves 1 out."
    if compared > 1:
        chance = (1 - CONFIDENCE) * compared
        said += f" Each is for itself: where nothing differs, {chance:.2g} of {compared} would be marked by chance."
    return said


def _without(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Say which replicates have no figures, and why, by method."""
    every = Counter(row["method"] for row in rows)
    reasons: dict[tuple[str, str, str], list[str]] = {}
    for row in rows:
        if row["status"] not in NUMBERS:
            reasons.setdefault((row["method"], row["status"], row["reason"]), []).append(row["problem"])
    said = []
    for (method, status, reason), problems in reasons.items():
        where = ""
        if len(problems) < every[method]:
            where = f" ({listed(list(dict.fromkeys(problems)), 4)})"
        count = f"{len(problems)} of {every[method]} replicates{where}"
        said.append(f"{method}: {status}, {count}. {reason[:1].upper()}{reason[1:]}")
    return said
