"""Comparisons of formulations, selectors and baselines on problems, and the ranking of methods in pairs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import stdtrit

from rpim_opt.basics.arrays import TINY
from rpim_opt.basics.exceptions import InputError, choices, pick
from rpim_opt.basics.tables import csv_text, frame_of
from rpim_opt.basics.text import counted, html_table, listed, markdown, progress_bar, table, three_digits
from rpim_opt.report.plot import logarithmic
from rpim_opt.store.instances import Instance
from rpim_opt.study import studies
from rpim_opt.study.methods import METRICS, UNDELIVERED, methods_of, metrics_of, problems_of, replicate, splits_of

USUAL = ("rms_mm", "mean_mm", "max_mm", "seconds")  # metrics of a comparison unless stated
COVERED = "covered_percent"  # a metric for which neither less nor more is better, but 95
MOST_DRAWS = 100_000  # each is a calibration, and is listed before the first begins
TIE = 0.01  # relative difference of errors that counts as a tie
ENOUGH = 5  # problems from which an interval refers to similar problems; with fewer, to these
CONFIDENCE = 0.95
GROSS = 10.0  # largest over mean held-out error that means a wrong reading
SAME_DATA = ("problem", "split", "fold", "count", "seed")
"""Columns that agree for two replicates of a pair: they used the same data."""
Pair = tuple[Any, ...]
Rows = Sequence[Mapping[str, Any]]


def compare(
    problems: Any,
    formulations: Any = "tikhonov",
    selectors: Any = "learned",
    *,
    methods: Any = (),
    splits: Any = "folder",
    counts: Any = None,
    seeds: int | Iterable[int] = 1,
    metrics: Any = USUAL,
    options: Mapping[str, Any] | None = None,
    workers: int = 1,
    journal: str | Path | None = None,
    resume: bool | None = True,
    progress: bool | Callable[[int, int], None] = True,
) -> Comparison:
    """Compare formulations, selectors and user-defined methods on problems, by errors on held-out data.

    Every problem with every formulation, selector, split and seed is one replicate; impossible ones (a lasso with REML)
    and failures have a reason. All methods use the same data, so that errors are compared in pairs.

    ``problems`` are a folder, a name that comes with the package, ``ro.load(...)``, a problem, a pair of a problem and
    validation data, a folder of problem folders, a function of a seed that returns one of these or a `SimulatedArm`; or
    several, in a list or a mapping with names, ``{"cell 7": "data/cell7"}``. ``formulations`` are names of ready ones,
    objects, or ``"folder"`` for the folder's own; ``selectors`` are names, selectors, numbers, ``"learned"``, or
    ``"folder"``. A formulation without penalty appears once, with the selector ``none``. ``methods`` are baselines by
    name (``"levenberg_marquardt"``; ``"nominal"`` only fits frames) and functions of the problem that return deviations
    (n,) [SI], a calibration, or a function from joint values (N, dof) to positions (N, 3) [m]. ``options`` are further
    arguments of every calibration: ``{"model": "auto"}``.

    ``splits`` state the held-out configurations: ``"folder"``, the problem's validation data; a share of its data
    (``0.25``); or a number of folds (``5``), one replicate each. ``counts`` are numbers of the other configurations
    used for identification, by default all. ``seeds`` is their number, or a list: of generated problems, splits and
    draws.

    ``metrics`` of the held-out rows are ``"rms_mm"``, ``"mean_mm"``, ``"p95_mm"``, ``"max_mm"``, ``"rms_mrad"``,
    ``"fit_rms_mm"`` (of the identification rows), ``"covered_percent"`` (of 95 % intervals), ``"seconds"``; or
    functions of a `Fitted`, by names with their unit. Summaries use the first one, for which less has to be better.

    ``workers`` is the number of processes on this machine, -1 for all processors; or of a cluster that
    ``joblib.parallel_config`` names. Finished replicates are written to the file ``journal``; a call with the same code
    (of the loaded Python files) and arguments continues it, and may add seeds, splits and counts. Other code and
    arguments, and those that cannot be pickled, are refused; other inputs of functions, such as ``sys.argv``, are not
    noticed. ``resume`` False starts again; None refuses to discard results. ``progress`` is whether a bar is shown, or
    a function of the finished and the total number.

    InputError before any computation, for unknown names and invalid numbers, and for a journal of something else.

    >>> import rpim_opt as ro
    >>> found = ro.compare(["position", "seven_axis"], ["tikhonov", "lasso"], ["learned", "reml"])
    >>> for row in found.rows[:4]:
    ...     print(row["problem"], row["method"], row["status"], row["rms_mm"] and round(row["rms_mm"], 3))
    position tikhonov, learned ok 0.026
    position tikhonov, reml ok 0.026
    position lasso, learned ok 0.026
    position lasso, reml impossible None
    >>> len(found.to_frame()), found.metric
    (8, 'rms_mm')
    """
    by_label = problems_of(problems)
    compared = methods_of(formulations, selectors, methods, options or {})
    ways = splits_of(splits)
    numbers_drawn = [None] if counts is None else _numbers("counts", counts, "whole numbers, 1 or more", 1)
    if isinstance(seeds, int | np.integer) and not isinstance(seeds, bool):
        if seeds > MOST_DRAWS:
            raise InputError("seeds", f"{seeds}", f"at most {MOST_DRAWS} draws")
        seeds = range(max(int(seeds), 0))
    numbered = _numbers("seeds", seeds, "whole numbers, 0 or more", 0)
    figured = metrics_of(metrics)
    if next(iter(figured)) == COVERED:
        raise InputError("metrics", f"'{COVERED}' first, of which 95 is best", "a first metric to minimize")

    def work(case: Mapping[str, Any]) -> studies.Work:  # a closure of only what it needs
        return partial(
            replicate, by_label[case["problem"]], ways[case["split"]], compared[case["method"]], figured, case
        )

    made = studies.provenance()
    drawn = {label for label, problem in by_label.items() if not isinstance(problem, Instance)}
    cases: list[studies.Row] = []
    for (label, problem), (split, size), count in product(by_label.items(), ways.items(), numbers_drawn):
        every = np.inf if callable(problem) else len(np.unique(problem.problem.data.configuration))
        # a seed changes generated problems, held-out rows and drawn configurations
        seeded = callable(problem) or size > 0 or (count is not None and count < every)
        folds = range(1, max(int(size), 1) + 1)
        for seed, fold, (name, method) in product(numbered if seeded else numbered[:1], folds, compared.items()):
            case = {"problem": label, "method": name, "formulation": method.formulation, "selector": method.selector}
            cases.append({**case, "split": split, "fold": fold, "count": count, "seed": seed})
    path = None if journal is None else Path(journal)
    code: dict[str, str] = {}
    if path is not None:
        own = {name: metric for name, metric in figured.items() if METRICS.get(name) is not metric}
        inputs = {"problems given": by_label, "methods": compared, "metrics": (tuple(figured), own)}
        hashes = {f"set of {name}": studies.content_hash(value, "journal") for name, value in inputs.items()}
        code = studies.package_code() | studies.script_code() | hashes
        path.parent.mkdir(parents=True, exist_ok=True)
    with progress_bar("comparing", progress) as say:
        rows = studies.run_cases(cases, work, workers, say, path, code, resume)
    axes = {
        "Problems": by_label,
        "Methods": compared,
        "Held out": ways,
        "Configurations": [str(count or "all") for count in numbers_drawn],
        "Seeds": map(str, numbered),
        "Metrics": figured,
        "Options": [f"{name} = {value}" for name, value in (options or {}).items()],
    }
    settings = {name: "; ".join(values) for name, values in axes.items() if values}
    return Comparison(tuple(rows), tuple(figured), frozenset(drawn), settings, made)


def _numbers(where: str, stated: Any, accepted: str, least: int) -> list[Any]:
    """Return whole numbers, each once."""
    values = list(stated) if isinstance(stated, Iterable) else [stated]
    right = [isinstance(v, int | np.integer) and not isinstance(v, bool) and v >= least for v in values]
    if not values or not all(right):
        raise InputError(where, f"{stated!r}", accepted)
    return list(dict.fromkeys(map(int, values)))


@dataclass(frozen=True, eq=False)
class Comparison:
    """Replicates of methods on problems, one row each.

    ``rows`` are plain tables: ``problem``, ``method``, ``formulation``, ``selector``, ``split``, ``fold``, ``count``
    (as stated), ``seed``; ``status`` (``ok``, ``not delivered``, ``impossible``, ``failed``) with
    its ``reason``; ``configurations`` and ``parameters`` that were fitted, the ``weight``, and the ``metrics``.
    ``drawn`` are problems that depend on the seed, ``grid`` the grid as text, ``made`` script, package, versions
    and time.

    >>> import rpim_opt as ro
    >>> def arms(seed):
    ...     return ro.study.simulated_arm(seed, count=15)
    >>> found = ro.compare(arms, selectors=["learned", "reml"], seeds=5)
    >>> found
    Comparison: 2 methods on 1 problem, 10 replicates (10 ok)
    >>> found.summary().standings[0].method, len(found.to_frame()), len(found.plot("max_mm").axes)
    ('tikhonov, learned', 10, 1)
    """

    rows: tuple[studies.Row, ...]
    metrics: tuple[str, ...]
    drawn: frozenset[str] = frozenset()
    grid: Mapping[str, str] = field(default_factory=dict)
    made: Mapping[str, str] = field(default_factory=dict)

    @property
    def metric(self) -> str:
        """The default metric of summaries."""
        return self.metrics[0]

    @property
    def methods(self) -> tuple[str, ...]:
        """The labels of the methods, in the order given."""
        return tuple(dict.fromkeys(row["method"] for row in self.rows))

    @property
    def problems(self) -> tuple[str, ...]:
        """The labels of the problems, in the order given."""
        return tuple(dict.fromkeys(row["problem"] for row in self.rows))

    def to_frame(self) -> Any:
        """Return the rows as a data frame (pandas, or polars where that is missing), one row per replicate."""
        return frame_of(self.rows)

    def summary(self, metric: str | None = None, against: str | None = None) -> Summary:
        """Return the methods in their order, each compared with a reference on the same replicates.

        ``metric`` is a column for which less is better, by default the first; ``against`` is the reference's label, by
        default the first method with figures. InputError for an unknown metric or method, or if no method has figures.
        """
        metric = metric or self.metric
        ranked = [name for name in self.metrics if name != COVERED]
        if metric not in ranked:
            raise InputError("metric", f"'{metric}'", f"one to minimize: {choices(metric, ranked)}")
        of = figures(self.rows, metric)
        with_figures = [method for method, values in of.items() if values]
        reference = against or next(iter(with_figures), self.methods[0])
        other = pick(of, reference, "against")
        if not other:
            first = next(row for row in self.rows if row["method"] == reference)
            found = f"'{reference}', which has no results; {first['status']}: {first['reason']}"
            raise InputError("comparison", found, "a method with results")
        standings = []
        for method in with_figures:
            own = of[method]
            count = sum(row["method"] == method for row in self.rows)
            logs = {pair: _logarithm(own, pair) - _logarithm(other, pair) for pair in own.keys() | other.keys()}
            wins = sum(log < -TIE for log in logs.values())
            losses = sum(log > TIE for log in logs.values())
            ratio = interval({pair: logs[pair] for pair in own if pair in other}, self.drawn)
            middle = float(np.median(list(own.values())))
            against_other = (*ratio, wins, len(logs) - wins - losses, losses)
            standings.append(Standing(method, count, count - len(own), middle, max(own.values()), *against_other))
        standings.sort(key=lambda each: (each.ratio is None, each.ratio, each.median))
        return Summary(metric, reference, tuple(standings), tuple(_notes(self.rows, standings, self.drawn, reference)))

    def plot(self, metric: str | None = None, against: str | None = None) -> Any:
        """Return a matplotlib figure: every method's errors over the reference's, in pairs.

        Arguments and errors as for `summary`.
        """
        summary = self.summary(metric, against)
        of = figures(self.rows, summary.metric)
        other = of[summary.reference]
        ratios = {
            each.method: [value / other[pair] for pair, value in of[each.method].items() if other.get(pair)]
            for each in summary.standings
        }
        known = [each for each in summary.standings if ratios[each.method]]
        label = f"{summary.metric} over that of {summary.reference}, same replicate"
        figure = distributions({each.method: ratios[each.method] for each in known}, label)
        (ax,) = figure.axes
        ax.axvline(1, color="0.4", lw=1, zorder=1)
        for y, each in enumerate(known):
            if each.low is not None and each.high is not None:
                colour = "0.3"
                if each.different:
                    colour = "C2" if each.high < 1 else "C3"
                ax.plot([each.low, each.high], [y, y], lw=2, color=colour)
        ax.set_title("dots: replicates, medians marked; bars: 95 % interval of the geometric mean", fontsize=9)
        return figure

    def report(self, folder: str | Path) -> Path:
        """Write ``README.md`` with the summary and the medians by problem, the figure, and ``replicates.csv``.

        The folder is made. Return the path of ``README.md``.
        """
        summary = self.summary()
        of = figures(self.rows, summary.metric)
        medians = []
        for each in summary.standings:
            by_problem = [[v for pair, v in of[each.method].items() if pair[0] == name] for name in self.problems]
            medians.append([each.method, *(three_digits(float(np.median(v))) if v else "-" for v in by_problem)])
        text = "\n\n".join([
            f"{summary.metric} of the held-out rows; * 95 % interval excludes 1",
            markdown(summary.header, summary.cells()),
            *summary.notes,
            f"Median {summary.metric} by problem:",
            markdown(["method", *self.problems], medians),
            *(f"{name}: {what}" for name, what in self.grid.items()),
        ])  # fmt: skip
        replicates = csv_text(self.rows[0], (row.values() for row in self.rows))
        ratios = {each.method: each.ratio for each in summary.standings if each.ratio is not None}
        report = studies.Report(text, ratios, {"comparison": self.plot()})
        made = "\n\n".join(f"{name}: {what}" for name, what in self.made.items())
        title = f"{counted(len(self.methods), 'method')} on {counted(len(self.problems), 'problem')}"
        studies.write(Path(folder), title, report, made, {"replicates.csv": replicates.encode()})
        return Path(folder) / "README.md"

    def __repr__(self) -> str:
        """Return one line."""
        counts = ", ".join(f"{count} {status}" for status, count in Counter(row["status"] for row in self.rows).items())
        what = f"{counted(len(self.methods), 'method')} on {counted(len(self.problems), 'problem')}"
        return f"Comparison: {what}, {len(self.rows)} replicates ({counts})"

    def __str__(self) -> str:
        """Return that line, and the summary where there is one."""
        has_figures = any(figures(self.rows, self.metric).values())
        return f"{self!r}\n\n{self.summary()}" if has_figures else repr(self)


# --- the ranking of methods ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Standing:
    """Metrics of a method, and its ratio to the reference on the same replicates.

    Of its ``replicates`` some are ``missing`` (without a figure); ``median`` and ``worst`` are those of its figures.
    ``ratio`` is the geometric mean of its figures over the reference's, with equal weight of every problem (None
    without pairs), ``low`` and ``high`` are the ends of its 95 % interval (None with too little data). On ``wins``,
    ``ties`` and ``losses`` replicates it is better than the reference, equal within 1 %, or worse; a replicate without
    a figure loses against one with.
    """

    method: str
    replicates: int
    missing: int
    median: float
    worst: float
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

    Less of the ``metric`` is better; methods are compared with the ``reference``. ``standings`` has one entry per
    method with figures; ``notes`` state what the intervals refer to, and methods not delivered or without results.
    """

    metric: str
    reference: str
    standings: tuple[Standing, ...]
    notes: tuple[str, ...]

    @property
    def header(self) -> tuple[str, ...]:
        """The column names."""
        over = f"over {self.reference}"
        columns = ("method", f"median {self.metric}", "worst", over, "95 % interval", "better/tie/worse", "no result")
        return columns[: len(columns) - (not any(each.missing for each in self.standings))]

    def cells(self) -> list[list[str]]:
        """Return the table's rows as text."""
        rows = []
        for each in self.standings:
            interval = ""
            if each.low is not None and each.high is not None:
                interval = f"{three_digits(each.low)} to {three_digits(each.high)}{' *' * each.different}"
            ratio = "" if each.ratio is None else three_digits(each.ratio)
            against = [ratio, interval, f"{each.wins}/{each.ties}/{each.losses}"]
            if each.method == self.reference:
                against = ["1", "reference", ""]
            missing = f"{each.missing} of {each.replicates}"
            known = map(three_digits, (each.median, each.worst))
            rows.append([each.method, *known, *against, missing][: len(self.header)])
        return rows

    def __str__(self) -> str:
        """Return the table and the notes."""
        return "\n".join([table(self.header, self.cells()), "", *self.notes])

    def _repr_html_(self) -> str:
        return html_table(self.header, self.cells(), self.notes)


def _logarithm(known: Mapping[Pair, float], pair: Pair) -> float:
    """Return the logarithm of a figure, infinite without one; one of zero is as good as a rounding error."""
    return math.log(max(known.get(pair, math.inf), TINY))


def figures(rows: Rows, metric: str) -> dict[str, dict[Pair, float]]:
    """Return the metrics of every method by replicate."""
    of: dict[str, dict[Pair, float]] = {}
    for row in rows:
        own = of.setdefault(row["method"], {})
        if row.get(metric) is not None:
            own[tuple(row[name] for name in SAME_DATA)] = row[metric]
    return of


def interval(ratios: Mapping[Pair, float], drawn: frozenset[str]) -> tuple[float | None, float | None, float | None]:
    """Return the geometric mean of paired ratios, given as logarithms, and the ends of its 95 % interval.

    Replicates of one problem are correlated. The mean is over the problems' means; with five or more problems,
    Student's interval uses their scatter and refers to similar problems. With fewer, it uses the scatter within each
    problem of what is independent: arms of a generator, seeds, or folds of a measured problem; it then refers to
    similar arms, seeds or folds.
    """
    if not ratios:
        return None, None, None
    groups = []  # means per problem of independent units: seeds, or folds if seeds are few
    for label in dict.fromkeys(pair[0] for pair in ratios):
        own = {pair: ratio for pair, ratio in ratios.items() if pair[0] == label}
        by_seed = label in drawn or len({pair[-1] for pair in own}) >= ENOUGH
        parts: dict[Pair, list[float]] = {}
        for pair, ratio in own.items():
            part = (pair[-1],) if by_seed else (pair[-1], *pair[1:3])
            parts.setdefault(part, []).append(ratio)
        groups.append(np.array([float(np.mean(each)) for each in parts.values()]))
    means = np.array([each.mean() for each in groups])
    middle = float(means.mean())
    if len(means) >= ENOUGH:
        count = len(means)
        variance = means.var(ddof=1) / count
    else:
        count = min(map(len, groups))
        if count < ENOUGH:
            return float(np.exp(middle)), None, None
        variance = sum(each.var(ddof=1) / len(each) for each in groups) / len(groups) ** 2
    half = float(stdtrit(count - 1, (1 + CONFIDENCE) / 2) * np.sqrt(variance))
    return float(np.exp(middle)), float(np.exp(middle - half)), float(np.exp(middle + half))


def _notes(rows: Rows, standings: Sequence[Standing], drawn: frozenset[str], reference: str) -> Iterator[str]:
    """Yield the notes below the table: of what the ratios and intervals speak, and what has no results."""
    yield f"Ratios compare the same replicates in pairs; geometric mean over problems; a tie is within {TIE:.0%}."
    compared = sum(each.low is not None and each.method != reference for each in standings)
    problems = {row["problem"] for row in rows}
    if len(problems) >= ENOUGH:
        scope = f"other problems like these {len(problems)}"
    elif problems <= drawn:
        scope = "other arms of the same generator"
    else:
        scope = "these problems alone, with other seeds or folds"
    if compared:
        several = " They are not corrected for multiple comparisons." * (compared > 1)
        yield f"Intervals refer to {scope} (Student's t, {CONFIDENCE:.0%}); * excludes 1.{several}"
    elif len(standings) > 1:
        yield f"There are no intervals: fewer than {ENOUGH} problems, and fewer than {ENOUGH} seeds or folds on one."
    every_mean = figures(rows, "mean_mm")
    gross = [
        {pair for pair, error in of.items() if error > GROSS * every_mean.get(method, {}).get(pair, math.inf)}
        for method, of in figures(rows, "max_mm").items()
    ]
    if gross and (common := set.intersection(*gross)):
        yield (
            f"In {counted(len(common), 'replicate')} one held-out error is more than {GROSS:g} times the mean one with "
            "every method: the figures are those of gross readings. Exclude these ([exclude])."
        )
    every = Counter(row["method"] for row in rows)
    without: dict[tuple[str, str, str], list[str]] = {}
    for row in rows:
        if row["status"] == UNDELIVERED:  # each for reasons with different figures
            row = {**row, "reason": "their figures are included; the column `reason` states why."}
        if row["reason"]:
            without.setdefault((row["method"], row["status"], row["reason"]), []).append(row["problem"])
    for (method, status, reason), missing in without.items():
        where = f" ({listed(list(dict.fromkeys(missing)), 4)})" * (len(missing) < every[method])
        count = f"{len(missing)} of {every[method]} replicates{where}"
        yield f"{method}: {status}, {count}. {reason[:1].upper()}{reason[1:]}"


# --- figures ---------------------------------------------------------------------------------------------------------


def distributions(values: Mapping[str, Sequence[float]], label: str) -> Any:
    """Return a logarithmic dot plot with one line per name, from top to bottom, and marked medians.

    ``values`` are positive figures by name; ``label`` names them, with their unit.

    >>> import rpim_opt as ro
    >>> figure = ro.study.distributions({"reml": [0.1, 0.2, 0.4], "l_curve": [0.2, 0.3, 0.9]}, "mean error [mm]")
    >>> len(figure.axes)
    1
    """
    from matplotlib.figure import Figure  # only needed for figures

    ax = Figure(figsize=(7, 0.32 * len(values) + 0.9), layout="constrained").add_subplot()
    ax.set_yticks(range(len(values)), list(values), fontsize=8)
    ax.set_ylim(len(values) - 0.3, -0.7)
    ax.set_xlabel(label)
    ax.grid(axis="x", alpha=0.25)
    for y, known in enumerate(values.values()):
        dots = ax.plot(known, [y] * len(known), "o", ms=3, alpha=min(1.0, 5 / len(known) ** 0.5), color="C0", mew=0)
        dots[0].set_rasterized(len(known) > 50)  # thousands of dots take megabytes of SVG
        middle = sorted(known)[len(known) // 2]
        ax.plot([middle], [y], "|", ms=11, mew=2, color="C3")
        ax.annotate(f"{middle:.3g}", (1.01, y), xycoords=("axes fraction", "data"), va="center", fontsize=8)
    logarithmic(ax, "x")
    return ax.figure
