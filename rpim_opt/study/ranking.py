"""Ranking of methods by paired replicates, with confidence intervals over independent units."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.special import ndtr, stdtrit

from rpim_opt.basics.exceptions import InputError, pick
from rpim_opt.basics.tables import frame_of
from rpim_opt.basics.text import html_table, listed, table

OK = "ok"
UNCONVERGED = "not converged"
IMPOSSIBLE = "impossible"
FAILED = "failed"
WITH_FIGURES = (OK, UNCONVERGED)
"""Statuses of replicates that have figures."""
TIE = 0.01
"""Errors that differ by no more than this part are a tie."""
ENOUGH = 5
"""Problems from which on an interval speaks of problems like them; with fewer, of these."""
BOOTSTRAP_DRAWS = 4000
CONFIDENCE = 0.95
SAME_DATA = ("problem", "split", "fold", "count", "noise_factor", "seed")
"""Columns in which two replicates of a pair agree: then they saw the same data."""
Pair = tuple[Any, ...]
Rows = Sequence[Mapping[str, Any]]


@dataclass(frozen=True)
class Standing:
    """Metrics of a method, and its ratio to the reference on the same replicates.

    Of its ``replicates`` some are ``missing`` (without a figure) or ``unconverged`` (their figures count); ``median``
    and ``worst`` are of its figures. ``ratio`` is the geometric mean of its figures over those of the reference, every
    problem counting the same (None without pairs), ``low`` and ``high`` the ends of its 95 % interval (None where there
    is too little to say). On ``wins``, ``ties`` and ``losses`` replicates it is better than the reference, as good
    within 1 %, or worse; one without a figure loses against one with.

    >>> import rpim_opt as ro
    >>> found = ro.compare("position", ["tikhonov", "least_squares"], "reml", splits=5)
    >>> second = found.summary().standings[1]
    >>> second.method, second.replicates, second.wins + second.ties + second.losses, second.different
    ('least_squares', 5, 5, False)
    """

    method: str
    replicates: int
    missing: int
    unconverged: int
    median: float | None
    worst: float | None
    ratio: float | None
    low: float | None
    high: float | None
    wins: int
    ties: int
    losses: int

    @property
    def different(self) -> bool:
        """Whether the interval of the ratio excludes 1."""
        return self.low is not None and self.high is not None and not self.low <= 1 <= self.high


@dataclass(frozen=True)
class Summary:
    """Methods ranked by the geometric mean of their metric.

    Less of the ``metric`` is better; others are compared with the ``reference``. ``standings`` are one a method that
    has figures; ``notes`` say of what the intervals speak, and what has no results, with the reason.

    >>> import rpim_opt as ro
    >>> found = ro.compare("position", ["tikhonov", "lasso"], ["reml", 1.0], splits=5)
    >>> summary = found.summary(against="tikhonov, 1")
    >>> [each.method for each in summary.standings]
    ['tikhonov, 1', 'tikhonov, reml', 'lasso, 1']
    >>> summary.notes[-1]
    "lasso, reml: impossible, 5 of 5 replicates. Selector reml: found formulation 'lasso', accepted: ..."
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
        """The column names."""
        over = f"over {self.reference}"
        columns = ("method", f"median {self.metric}", "worst", over, "95 % interval", "better/tie/worse")
        return (*columns, "no result") if any(each.missing for each in self.standings) else columns

    def cells(self) -> list[list[str]]:
        """Return the table's rows as text."""
        rows = []
        for each in self.standings:
            interval = ""
            if each.low is not None and each.high is not None:
                interval = f"{number(each.low)} to {number(each.high)}{' *' if each.different else ''}"
            against = [number(each.ratio), interval, f"{each.wins}/{each.ties}/{each.losses}"]
            if each.method == self.reference:
                against = ["1", "reference", ""]
            missing = f"{each.missing} of {each.replicates}"
            rows.append([each.method, number(each.median), number(each.worst), *against, missing][: len(self.header)])
        return rows

    def __str__(self) -> str:
        """Return the table and the notes."""
        return "\n".join([table(self.header, self.cells()), "", *self.notes])

    def _repr_html_(self) -> str:
        """Return the same for a notebook."""
        return html_table(self.header, self.cells(), self.notes)


def number(value: float | None) -> str:
    """Return a number with three digits; an empty text for None."""
    if value is None:
        return ""
    if 1e-3 <= abs(value) < 1e4:
        power = int(f"{value:e}".partition("e")[2])
        return f"{value:.{max(2 - power, 0)}f}"
    return f"{value:.3g}"


def summarize(rows: Rows, metric: str, against: str | None, drawn: AbstractSet[str]) -> Summary:
    """Return the methods in order, each against a reference, by default the first method that has figures.

    ``drawn`` are problems that depend on a seed. InputError for a reference that is unknown or has no figures.
    """
    of = figures(rows, metric)
    with_figures = [method for method, values in of.items() if values]
    if against is None and not with_figures:
        found = f"no replicate with results; {rows[0]['status']}: {rows[0]['reason']}"
        raise InputError("comparison", found, "one")
    reference = with_figures[0] if against is None else against
    other = pick(of, reference, "against")
    if not other:
        raise InputError("against", f"'{against}', which has no results", "a method with results")
    least = np.finfo(float).tiny  # figures that are zero are as good as a rounding error
    known = []
    for method in with_figures:
        own = of[method]
        mine = [row for row in rows if row["method"] == method]
        logs = {pair: math.log(max(own[pair], least) / max(other[pair], least)) for pair in own if pair in other}
        compared = {_pair(row) for row in mine} & (set(own) | set(other))
        wins = sum(pair in own and (pair not in other or logs[pair] < -TIE) for pair in compared)
        losses = sum(pair in other and (pair not in own or logs[pair] > TIE) for pair in compared)
        unconverged = sum(row["status"] == UNCONVERGED for row in mine)
        standing = Standing(
            method, len(mine), len(mine) - len(own), unconverged, float(np.median(list(own.values()))),
            max(own.values()), *interval(logs, drawn), wins, len(compared) - wins - losses, losses,
        )  # fmt: skip
        known.append(standing)
    known.sort(key=lambda each: (each.ratio is None, each.ratio, each.median))
    return Summary(metric, reference, tuple(known), _notes(rows, known, drawn, reference))


def figures(rows: Rows, metric: str) -> dict[str, dict[Pair, float]]:
    """Return the metrics of every method by replicate."""
    of: dict[str, dict[Pair, float]] = {}
    for row in rows:
        own = of.setdefault(row["method"], {})
        if row.get(metric) is not None:
            own[_pair(row)] = row[metric]
    return of


def _pair(row: Mapping[str, Any]) -> Pair:
    return tuple(row[name] for name in SAME_DATA)


def interval(ratios: Mapping[Pair, float], drawn: AbstractSet[str]) -> tuple[float | None, float | None, float | None]:
    """Return the geometric mean of paired ratios, given as logarithms, and the ends of its 95 % interval.

    Replicates of one problem have the problem in common. The mean is over problems, of each one's mean; and with five
    problems or more it is they that are drawn anew (cluster bootstrap), so that the interval speaks of other problems
    like these. With fewer, what is independent within each is: the arms of a generator, the seeds or else the folds of
    a measured one; then it speaks of other such arms, seeds or folds. Percentiles are those of Hesterberg (2015, The
    American Statistician 69), wider for few.
    """
    if not ratios:
        return None, None, None
    groups = []  # of every problem the means of what is independent: seeds, or folds where seeds are few
    for label in dict.fromkeys(pair[0] for pair in ratios):
        own = {pair: ratio for pair, ratio in ratios.items() if pair[0] == label}
        by_seed = label in drawn or len({pair[-1] for pair in own}) >= ENOUGH
        parts: dict[Pair, list[float]] = {}
        for pair, ratio in own.items():
            part = (pair[-1],) if by_seed else (pair[-1], *pair[1:3])
            parts.setdefault(part, []).append(ratio)
        groups.append(np.array([float(np.mean(each)) for each in parts.values()]))
    means = np.array([each.mean() for each in groups])
    middle = float(np.exp(means.mean()))
    rng = np.random.default_rng(0)
    count = len(means)
    if count >= ENOUGH:
        drawn_means = rng.choice(means, (BOOTSTRAP_DRAWS, count)).mean(axis=1)
    else:
        count = min(len(each) for each in groups)
        if count < ENOUGH:
            return middle, None, None
        within = [rng.choice(each, (BOOTSTRAP_DRAWS, len(each))).mean(axis=1) for each in groups]
        drawn_means = np.mean(within, axis=0)
    beyond = ndtr(np.sqrt(count / (count - 1)) * stdtrit(count - 1, (1 - CONFIDENCE) / 2))
    low, high = np.quantile(drawn_means, [beyond, 1 - beyond])
    return middle, float(np.exp(low)), float(np.exp(high))


def _notes(rows: Rows, standings: Sequence[Standing], drawn: AbstractSet[str], reference: str) -> tuple[str, ...]:
    """Return the notes below the table: of what the ratios and intervals speak, and what has no results."""
    notes = [f"Ratios are of the same replicates in pairs, geometric mean over problems; a tie is within {TIE:.0%}."]
    compared = sum(each.low is not None and each.method != reference for each in standings)
    problems = {row["problem"] for row in rows}
    if len(problems) >= ENOUGH:
        scope = f"other problems like these {len(problems)}"
    elif problems <= drawn:
        scope = "other arms of the same generator"
    else:
        scope = "these problems alone, with other seeds or folds"
    if compared:
        text = f"Intervals refer to {scope} (bootstrap, {CONFIDENCE:.0%}); * excludes 1."
        if compared > 1:
            text += " No correction for multiple comparisons: without any difference, "
            text += f"{(1 - CONFIDENCE) * compared:.2g} of {compared} would be marked by chance."
        notes.append(text)
    elif len(standings) > 1:
        few = f"fewer than {ENOUGH} problems, and fewer than {ENOUGH} seeds or folds on one"
        notes.append(f"There are no intervals: {few}.")
    late = sum(each.unconverged for each in standings)
    if late:
        notes.append(f"{late} replicates did not converge; their figures count (column status).")
    every = Counter(row["method"] for row in rows)
    without: dict[tuple[str, str, str], list[str]] = {}
    for row in rows:
        if row["status"] not in WITH_FIGURES:
            without.setdefault((row["method"], row["status"], row["reason"]), []).append(row["problem"])
    for (method, status, reason), missing in without.items():
        where = f" ({listed(list(dict.fromkeys(missing)), 4)})" if len(missing) < every[method] else ""
        count = f"{len(missing)} of {every[method]} replicates{where}"
        notes.append(f"{method}: {status}, {count}. {reason[:1].upper()}{reason[1:]}")
    return tuple(notes)
