"""Comparisons of formulations, selectors and baselines on problems, and their tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.files import refused
from rpim_opt.basics.tables import csv_text, frame_of
from rpim_opt.basics.text import counted, markdown, progress_bar
from rpim_opt.store.instances import Instance
from rpim_opt.study import replicates
from rpim_opt.study.methods import FOLDER, METRICS, USUAL, methods_of, metrics_of, problems_of, replicate, splits_of
from rpim_opt.study.ranking import WITH_FIGURES, Summary, figures, number, summarize
from rpim_opt.study.replicates import Row, run_cases
from rpim_opt.study.studies import Report, write

MOST_DRAWS = 100_000
"""Each is a calibration of its own, and is listed before the first begins."""
LARGEST = float(np.finfo(float).max)
"""Whole numbers may be larger than any double."""


def compare(
    problems: Any,
    formulations: Any = "tikhonov",
    selectors: Any = "learned",
    *,
    methods: Any = (),
    splits: Any = FOLDER,
    counts: Any = None,
    noise: Any = 1.0,
    seeds: int | Iterable[int] = 1,
    metrics: Any = USUAL,
    options: Mapping[str, Any] | None = None,
    workers: int = 1,
    journal: str | Path | None = None,
    resume: bool | None = True,
    progress: bool | Callable[[int, int], None] = True,
) -> Comparison:
    """Compare formulations, selectors and user-defined methods on problems, by errors on held-out data.

    Every problem with every formulation and every selector, every split and every seed: one replicate each. What cannot
    be (a lasso with REML) and what fails is a replicate with its reason. All methods see the same data: the same
    configurations held out, drawn and disturbed, so that their errors are compared in pairs.

    Parameters
    ----------
    problems
        A folder, a name that comes with the package, ``ro.load(...)``, a problem, a pair of a problem and validation
        data, a folder of problem folders, a generator (a function of a seed that returns one of these, or a
        `SimulatedArm`); or several, in a list or by names of your own, ``{"cell 7": "data/cell7"}``.
    formulations
        Ready ones by name, objects, ``"folder"`` for the folder's own; one or several, or by names of your own.
    selectors
        Names, selectors, numbers, ``"learned"``, ``"folder"``; likewise. A formulation without penalty has no weight
        and is there once, with the selector ``none``.
    methods
        Other methods: baselines by name (``"levenberg_marquardt"``; ``"nominal"`` fits frames alone) and functions of
        the problem that return deviations (n,) [SI], a calibration, or a function from joint values (N, dof) to
        positions (N, 3) [m]; in a list or by names of your own.
    splits
        What is held out, always whole configurations: ``"folder"``, the validation data of the problem; a part of its
        data (``0.25``); in how many folds (``5``), one replicate a fold; or several of them.
    counts
        Of how many configurations to identify from, drawn from those that are not held out; all of them by default.
    noise
        Factors, 1 or more, on the noise of the data to fit: the missing part is added, and declared.
    seeds
        How many, or which: of generated problems, of splits, of draws and of noise. What no seed changes is there once.
    metrics
        Of the rows held out: ``"rms_mm"``, ``"mean_mm"``, ``"p95_mm"``, ``"max_mm"``, ``"rms_mrad"``, ``"fit_rms_mm"``
        (of the rows that were fitted), ``"covered_percent"`` (of 95 % intervals), ``"seconds"``; or functions of a
        `Fitted`, by names that carry their unit. Summaries are of the first one, of which less is better.
    options
        Further options of every calibration: ``{"model": "auto"}``.
    workers
        Processes on this machine, -1 for all processors; or of a cluster, where ``joblib.parallel_config`` names one.
    journal
        A file that every finished replicate is written to at once. A call with the same code and arguments goes on
        with it (more seeds, splits, counts and factors may be asked); one of other code or arguments is refused, and
        so is an argument that cannot be pickled. Code is that of the Python files that are loaded; other files
        that a function reads are not known to it.
    resume
        False to begin the journal anew; None refuses to drop what an interrupted run has computed.
    progress
        Whether a bar with the time left is shown where a person is watching; or a function that is told how many
        replicates of how many are done.

    Raises
    ------
    InputError
        Before anything is computed: for unknown names, words and numbers, and a journal of something else.

    Examples
    --------
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
    asked = problems_of(problems)
    compared = methods_of(formulations, selectors, methods, options or {})
    ways = splits_of(splits)
    sizes = [None] if counts is None else _numbers("counts", counts, "whole numbers, 1 or more", 1, int)
    factors = _numbers("noise", noise, "factors of 1 or more on the noise that was measured", 1, float)
    if isinstance(seeds, int | np.integer) and not isinstance(seeds, bool):
        if seeds > MOST_DRAWS:
            raise InputError("seeds", f"{seeds}", f"at most {MOST_DRAWS} draws")
        seeds = range(max(int(seeds), 0))
    numbered = _numbers("seeds", seeds, "whole numbers, 0 or more", 0, int)
    figured = metrics_of(metrics)

    def work(case: Mapping[str, Any]) -> Callable[[], Row]:  # which takes no more along than it needs
        method = compared[case["method"]]
        return partial(replicate, asked[case["problem"]], ways[case["split"]], method, figured, case)

    made = replicates.provenance()
    drawn = {label for label, problem in asked.items() if not isinstance(problem, Instance)}
    cases: list[Row] = []
    for (label, problem), (split, size), count, factor in product(asked.items(), ways.items(), sizes, factors):
        # what no seed changes is there once
        seeded = label in drawn or split != FOLDER or factor > 1
        if count is not None and isinstance(problem, Instance):
            seeded = seeded or count < len(np.unique(problem.problem.data.configuration))
        folds = range(1, max(int(size), 1) + 1)
        for seed, fold, (name, method) in product(numbered if seeded else numbered[:1], folds, compared.items()):
            case = {"problem": label, "method": name, "formulation": method.formulation, "selector": method.selector}
            cases.append({**case, "split": split, "fold": fold, "count": count, "noise_factor": factor, "seed": seed})
    path = None if journal is None else Path(journal)
    code: dict[str, str] = {}
    if path is not None:
        own = {name: metric for name, metric in figured.items() if METRICS.get(name) is not metric}
        code = replicates.code_of({"problems given": asked, "methods": compared, "metrics": (tuple(figured), own)})
        with refused(path):
            path.parent.mkdir(parents=True, exist_ok=True)
    with progress_bar("comparing", progress) as say:
        rows = run_cases(cases, work, workers, say, path, code, resume)
    axes = {
        "Problems": asked,
        "Methods": compared,
        "Held out": ways,
        "Configurations": ["all" if count is None else str(count) for count in sizes],
        "Noise factors": [f"{factor:g}" for factor in factors],
        "Seeds": map(str, numbered),
        "Metrics": figured,
        "Options": [f"{name} = {value}" for name, value in (options or {}).items()],
    }
    settings = {name: ", ".join(values) for name, values in axes.items() if values}
    return Comparison(tuple(rows), tuple(figured), frozenset(drawn), settings, made)


def _numbers(where: str, stated: Any, accepted: str, least: float, kind: type) -> list[Any]:
    """Return numbers of a kind, ``int`` or ``float``, each once."""
    values = list(stated) if isinstance(stated, Iterable) else [stated]
    kinds = (int, np.integer) if kind is int else (int, float, np.number)
    right = [isinstance(v, kinds) and not isinstance(v, bool) and least <= v <= LARGEST for v in values]
    if not values or not all(right):
        raise InputError(where, f"{stated!r}", accepted)
    return list(dict.fromkeys(map(kind, values)))


@dataclass(frozen=True, eq=False)
class Comparison:
    """Replicates of methods on problems, one row each.

    ``rows`` are plain tables: ``problem``, ``method``, ``formulation``, ``selector``, ``split``, ``fold``, ``count``
    and ``noise_factor`` (as asked), ``seed``; ``status`` (``ok``, ``not converged``, ``impossible``, ``failed``) with
    its ``reason``; ``configurations`` and ``parameters`` that were fitted, the ``weight``, and the ``metrics``, of the
    first of which summaries are. ``drawn`` are problems that every seed draws anew, ``asked`` the axes of the grid in
    words, ``made`` what made the rows: script, package, versions and time.

    >>> import rpim_opt as ro
    >>> def arms(seed):
    ...     return ro.study.simulated_arm(seed, count=15)
    >>> found = ro.compare(arms, selectors=["learned", "reml"], seeds=5)
    >>> found
    Comparison: 2 methods on 1 problem, 10 replicates (10 ok)
    >>> found.summary().standings[0].method, len(found.to_frame()), len(found.plot("max_mm").axes)
    ('tikhonov, learned', 10, 1)
    >>> written = found.report("arms_compared")
    >>> written.name, sorted(path.name for path in written.parent.iterdir())
    ('README.md', ['README.md', 'comparison.png', 'comparison.svg', 'metrics.json', 'replicates.csv'])
    """

    rows: tuple[Row, ...]
    metrics: tuple[str, ...]
    drawn: frozenset[str] = frozenset()
    asked: Mapping[str, str] = field(default_factory=dict)
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
        """Return the rows as a data frame (pandas, or polars where that is missing), one row a replicate."""
        return frame_of(self.rows)

    def summary(self, metric: str | None = None, against: str | None = None) -> Summary:
        """Return the methods in their order, each against a reference on the same replicates.

        The metric is a column of which less is better, by default the first; the reference a method's label, by default
        the first one that has figures. InputError for an unknown metric or method, or where nothing has figures.
        """
        if metric is not None and metric not in self.metrics:
            raise InputError("metric", f"'{metric}'", choices(metric, self.metrics))
        return summarize(self.rows, metric or self.metric, against, self.drawn)

    def plot(self, metric: str | None = None, against: str | None = None) -> Any:
        """Return a matplotlib figure: every method's errors over the reference's, in pairs.

        Arguments and errors as for `summary`.
        """
        from rpim_opt.study.figures import comparison_figure

        return comparison_figure(self.rows, self.summary(metric, against))

    def report(self, folder: str | Path, metric: str | None = None, against: str | None = None) -> Path:
        """Write ``README.md`` with the summary and the medians by problem, the figure, and ``replicates.csv``.

        The folder is made; other arguments as for `summary`. Return the path of ``README.md``.
        """
        summary = self.summary(metric, against)
        of = figures(self.rows, summary.metric)
        medians = []
        for each in summary.standings:
            by_problem = [[v for pair, v in of[each.method].items() if pair[0] == name] for name in self.problems]
            medians.append([each.method, *(number(float(np.median(v))) if v else "-" for v in by_problem)])
        text = "\n\n".join([
            f"{summary.metric} of the held-out rows; * 95 % interval excludes 1",
            markdown(summary.header, summary.cells()),
            *summary.notes,
            f"Median {summary.metric} by problem:",
            markdown(["method", *self.problems], medians),
            *(f"{name}: {what}" for name, what in self.asked.items()),
        ])  # fmt: skip
        names = list(self.rows[0])
        cells = [["" if row[name] is None else str(row[name]) for name in names] for row in self.rows]
        where = ", ".join(self.problems) if len(self.problems) <= 3 else f"{len(self.problems)} problems"
        ratios = {each.method: each.ratio for each in summary.standings if each.ratio is not None}
        report = Report(text, ratios, {"comparison": self.plot(metric, against)})
        made = "\n\n".join(f"{name}: {what}" for name, what in self.made.items())
        title = f"{len(self.methods)} methods on {where}"
        write(Path(folder), title, report, made, {"replicates.csv": csv_text(names, cells).encode()})
        return Path(folder) / "README.md"

    def __repr__(self) -> str:
        """Return one line."""
        counts = ", ".join(f"{count} {status}" for status, count in Counter(row["status"] for row in self.rows).items())
        what = f"{counted(len(self.methods), 'method')} on {counted(len(self.problems), 'problem')}"
        return f"Comparison: {what}, {len(self.rows)} replicates ({counts})"

    def __str__(self) -> str:
        """Return that line, and the summary where there is one."""
        return f"{self!r}\n\n{self.summary()}" if self._has_figures else repr(self)

    def _repr_html_(self) -> str | None:
        """Return the summary for a notebook."""
        return f"<p><b>{self!r}</b></p>{self.summary()._repr_html_()}" if self._has_figures else None

    @property
    def _has_figures(self) -> bool:
        return any(row["status"] in WITH_FIGURES for row in self.rows)
