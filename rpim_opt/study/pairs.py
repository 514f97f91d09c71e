"""Methods compared in pairs: what each says of the same replicate, with intervals that know what is independent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import ndtr, stdtrit

from rpim_opt.basics.arrays import Array
from rpim_opt.study.replicate import UNCONVERGED

TIE = 0.01
"""Errors that differ by no more than this part are a tie."""
ENOUGH = 5
"""Problems from which on an interval speaks of problems like them; with fewer, of these."""
DRAWS = 4000
CONFIDENCE = 0.95
SAME = ("problem", "split", "fold", "count", "noise_factor", "seed")
"""Columns in which two replicates of a pair agree: then they saw the same data."""
Pair = tuple[Any, ...]


@dataclass(frozen=True)
class Standing:
    """How a method does, and how it does against the reference on the same replicates.

    Parameters
    ----------
    method
        Its label.
    replicates, missing, unconverged
        How many there are, how many of them have no figure, and how many did not converge (their figures count).
    median, worst
        Of its figures.
    ratio
        Geometric mean of its figures over those of the reference; every problem counts the same. None without pairs.
    low, high
        Ends of the 95 % interval of that ratio; None where there is too little to say.
    wins, ties, losses
        Replicates on which it is better than the reference, as good within 1 %, or worse; one without a figure loses
        against one with.

    Examples
    --------
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
        """Whether the interval of the ratio leaves one out."""
        return self.low is not None and self.high is not None and not self.low <= 1 <= self.high


def pair_of(row: Mapping[str, Any]) -> Pair:
    """Return what two replicates agree in that saw the same data."""
    return tuple(row[name] for name in SAME)


def figures(rows: Sequence[Mapping[str, Any]], metric: str) -> dict[str, dict[Pair, float]]:
    """Return the figures of every method, by what they were measured on."""
    found: dict[str, dict[Pair, float]] = {}
    for row in rows:
        own = found.setdefault(row["method"], {})
        if row.get(metric) is not None:
            own[pair_of(row)] = row[metric]
    return found


def standings(
    rows: Sequence[Mapping[str, Any]], metric: str, reference: str, drawn: AbstractSet[str]
) -> tuple[Standing, ...]:
    """Return how every method does against a reference, in the order of the methods."""
    of = figures(rows, metric)
    return tuple(_standing(rows, method, of[method], of[reference], drawn) for method in of)


def _standing(
    rows: Sequence[Mapping[str, Any]],
    method: str,
    own: Mapping[Pair, float],
    other: Mapping[Pair, float],
    drawn: AbstractSet[str],
) -> Standing:
    mine = [row for row in rows if row["method"] == method]
    values = list(own.values())
    ratios = {pair: _over(own[pair], other[pair]) for pair in own if pair in other}
    ratio, low, high = interval(ratios, drawn)
    compared = {pair_of(row) for row in mine} & (set(own) | set(other))
    wins = [pair for pair in compared if pair in own and (pair not in other or ratios[pair] < -TIE)]
    losses = [pair for pair in compared if pair in other and (pair not in own or ratios[pair] > TIE)]
    return Standing(
        method=method,
        replicates=len(mine),
        missing=len(mine) - len(own),
        unconverged=sum(row["status"] == UNCONVERGED for row in mine),
        median=float(np.median(values)) if values else None,
        worst=max(values, default=None),
        ratio=ratio,
        low=low,
        high=high,
        wins=len(wins),
        ties=len(compared) - len(wins) - len(losses),
        losses=len(losses),
    )


def _over(one: float, other: float) -> float:
    """Return the logarithm of a ratio; figures that are zero are as good as a rounding error."""
    least = np.finfo(float).tiny
    return float(np.log(max(one, least) / max(other, least)))


def interval(ratios: Mapping[Pair, float], drawn: AbstractSet[str]) -> tuple[float | None, float | None, float | None]:
    """Return the geometric mean of paired ratios, given as logarithms, and the ends of its 95 % interval.

    Replicates of one problem have the problem in common. The mean is over problems, of each one's mean; and with five
    problems or more it is they that are drawn anew (cluster bootstrap), so that the interval speaks of other problems
    like these. With fewer, what is independent within each is: the arms of a family, the seeds or else the folds of a
    measured one; then it speaks of other such arms, seeds or folds. Percentiles are those of Hesterberg (2015, The
    American Statistician 69), wider for few.
    """
    if not ratios:
        return None, None, None
    groups = [_parts(label, ratios, drawn) for label in dict.fromkeys(pair[0] for pair in ratios)]
    means = np.array([each.mean() for each in groups])
    middle = float(np.exp(means.mean()))
    rng = np.random.default_rng(0)
    if len(means) >= ENOUGH:
        anew = rng.choice(means, (DRAWS, len(means))).mean(axis=1)
        return middle, *_ends(anew, len(means))
    fewest = min(len(each) for each in groups)
    if fewest < ENOUGH:
        return middle, None, None
    within = [rng.choice(each, (DRAWS, len(each))).mean(axis=1) for each in groups]
    return middle, *_ends(np.mean(within, axis=0), fewest)


def _parts(label: str, ratios: Mapping[Pair, float], drawn: AbstractSet[str]) -> Array:
    """Return the means (parts,) of what is independent in a problem: seeds, or folds where seeds are few."""
    own = {pair: ratio for pair, ratio in ratios.items() if pair[0] == label}
    by_seed = label in drawn or len({pair[-1] for pair in own}) >= ENOUGH
    parts: dict[Pair, list[float]] = {}
    for pair, ratio in own.items():
        part = (pair[-1],) if by_seed else (pair[-1], *pair[1:3])
        parts.setdefault(part, []).append(ratio)
    return np.array([float(np.mean(each)) for each in parts.values()])


def _ends(means: Array, count: int) -> tuple[float, float]:
    """Return the ends of the interval of a mean of ``count`` things, from means (draws,) of things drawn anew."""
    beyond = ndtr(np.sqrt(count / (count - 1)) * stdtrit(count - 1, (1 - CONFIDENCE) / 2))
    low, high = np.quantile(means, [beyond, 1 - beyond])
    return float(np.exp(low)), float(np.exp(high))


def profiles(rows: Sequence[Mapping[str, Any]], metric: str) -> dict[str, Array]:
    """Return every method's figures over the best one of the same replicate, sorted, (N,); infinite without figure.

    At ratio tau, the share of these below tau is the performance profile (Dolan and Moré, Mathematical Programming 91,
    2002).
    """
    of = figures(rows, metric)
    best: dict[Pair, float] = {}
    for own in of.values():
        for pair, value in own.items():
            best[pair] = min(value, best.get(pair, np.inf))
    pairs = sorted(best, key=str)
    found = {}
    for method, own in of.items():
        over = [np.exp(_over(own[pair], best[pair])) if pair in own else np.inf for pair in pairs]
        found[method] = np.sort(np.array(over))
    return found
