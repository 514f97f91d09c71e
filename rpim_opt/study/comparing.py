"""One call for a comparison: problems, formulations and selectors, replicates in parallel, and what became of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.progress import shown
from rpim_opt.basics.writing import refused
from rpim_opt.study.comparison import Comparison
from rpim_opt.study.computing import fill
from rpim_opt.study.fingerprint import fingerprint
from rpim_opt.study.journal import Journal
from rpim_opt.study.methods import Method, methods_of
from rpim_opt.study.metrics import USUAL, metrics_of
from rpim_opt.study.provenance import package_code, provenance
from rpim_opt.study.replicate import replicate
from rpim_opt.study.sources import Source, sources
from rpim_opt.study.splits import FOLDER, Split, splits_of


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
    scheduler: Any = None,
    journal: str | Path | None = None,
    resume: bool | None = True,
    progress: bool | Callable[[int, int], None] = True,
) -> Comparison:
    """Compare formulations, selectors and anybody's methods on problems, by what they say of data they did not see.

    Every problem with every formulation and every selector, every split and every seed: one replicate each. What cannot
    be (a lasso with REML) and what fails is a replicate with its reason. All methods see the same data: the same
    configurations held out, drawn and disturbed, so that their errors are compared in pairs.

    Parameters
    ----------
    problems
        A folder, a name that comes with the package, ``ro.load(...)``, a problem, a pair of a problem and validation
        data, a folder of problem folders, a family (a function of a seed that returns one of these, or a
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
        How many, or which: of families, of splits, of draws and of noise. What no seed changes is there once.
    metrics
        Of the rows held out: ``"rms_mm"``, ``"mean_mm"``, ``"p95_mm"``, ``"max_mm"``, ``"rms_mrad"``, ``"fit_rms_mm"``
        (of the rows that were fitted), ``"covered_percent"`` (of 95 % intervals), ``"seconds"``; or functions of a
        `Fitted`, by names that carry their unit. Summaries are of the first one, of which less is better.
    options
        Further options of every calibration: ``{"model": "auto"}``.
    workers
        Processes on this machine; -1 for all processors.
    scheduler
        Address of a Dask scheduler to compute on instead, or a client of one.
    journal
        A file that every finished replicate is written to at once. A call with the same code and arguments goes on
        with it (more seeds, splits, counts and factors may be asked); one of other code or arguments is refused.
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
    plan = Plan(
        sources(problems),
        methods_of(formulations, selectors, methods, options or {}),
        splits_of(splits),
        _counts(counts),
        _factors(noise),
        _seeds(seeds),
        metrics_of(metrics),
        options or {},
    )
    cases = plan.cases()
    made = provenance()
    place = None if journal is None else Path(journal)
    if place is not None:
        with refused(place):
            place.parent.mkdir(parents=True, exist_ok=True)
    kept = Journal(place, cases, plan.code(), resume)
    tasks = [(key, plan.task(case)) for key, case in kept.waiting]
    with shown("comparing", progress) as say:
        fill(kept, tasks, workers, scheduler, say)
    drawn = frozenset(source.label for source in plan.sources if source.drawn)
    return Comparison(tuple(kept.rows), tuple(plan.metrics), drawn, plan.said(), made)


MOST_DRAWS = 100_000
"""Each is a calibration of its own, and is listed before the first begins."""
LARGEST_FACTOR = float(np.finfo(float).max)
"""Whole numbers may be larger than any double."""


@dataclass(frozen=True, eq=False)
class Plan:
    """What is compared: the axes of the grid, checked.

    Parameters
    ----------
    sources, methods, splits, counts, factors, seeds, metrics
        One entry a value of each axis; a count of None is all configurations.
    options
        Of every calibration.
    """

    sources: tuple[Source, ...]
    methods: tuple[Method, ...]
    splits: tuple[Split, ...]
    counts: tuple[int | None, ...]
    factors: tuple[float, ...]
    seeds: tuple[int, ...]
    metrics: Mapping[str, Callable[..., Any]]
    options: Mapping[str, Any]

    def cases(self) -> list[dict[str, Any]]:
        """Return one plain table a replicate."""
        found = []
        for source, split, count, factor in product(self.sources, self.splits, self.counts, self.factors):
            changes = source.drawn or split.by_seed or count is not None or factor > 1
            seeds = self.seeds if changes else self.seeds[:1]
            folds = range(1, split.folds + 1)
            for seed, fold, method in product(seeds, folds, self.methods):
                found.append(
                    {
                        "problem": source.label,
                        "method": method.label,
                        "formulation": method.formulation,
                        "selector": method.selector,
                        "split": split.label,
                        "fold": fold,
                        "count": count,
                        "noise_factor": factor,
                        "seed": seed,
                    }
                )
        return found

    def task(self, case: Mapping[str, Any]) -> Callable[[], dict[str, Any]]:
        """Return what computes a case, with no more than it needs."""
        source = next(each for each in self.sources if each.label == case["problem"])
        split = next(each for each in self.splits if each.label == case["split"])
        method = next(each for each in self.methods if each.label == case["method"])
        return partial(replicate, source, split, method, self.metrics, case)

    def code(self) -> dict[str, str]:
        """Return what replicates follow from, in digests: the package, and what was given."""
        return {
            **package_code(),
            "set of problems given": fingerprint([(each.label, each.what) for each in self.sources]),
            "set of methods": fingerprint(self.methods),
            "set of metrics": fingerprint(self.metrics),
        }

    def said(self) -> dict[str, str]:
        """Return the axes in words."""
        counts = ["all" if count is None else str(count) for count in self.counts]
        axes = {
            "Problems": [source.label for source in self.sources],
            "Methods": [method.label for method in self.methods],
            "Held out": [split.label for split in self.splits],
            "Configurations": counts,
            "Noise factors": [f"{factor:g}" for factor in self.factors],
            "Seeds": [str(seed) for seed in self.seeds],
            "Metrics": list(self.metrics),
            "Options": [f"{name} = {value}" for name, value in self.options.items()],
        }
        return {name: ", ".join(values) for name, values in axes.items() if values}


def _counts(stated: Any) -> tuple[int | None, ...]:
    if stated is None:
        return (None,)
    return _whole("counts", stated, 1)


def _seeds(stated: int | Iterable[int]) -> tuple[int, ...]:
    if isinstance(stated, int | np.integer) and not isinstance(stated, bool):
        if stated > MOST_DRAWS:
            raise InputError("seeds", f"{stated}", f"at most {MOST_DRAWS} draws")
        return _whole("seeds", range(max(int(stated), 0)), 0)
    return _whole("seeds", stated, 0)


def _whole(where: str, stated: Any, least: int) -> tuple[int, ...]:
    """Return whole numbers, each once."""
    values = list(stated) if isinstance(stated, Iterable) else [stated]
    whole = [isinstance(v, int | np.integer) and not isinstance(v, bool) and v >= least for v in values]
    if not values or not all(whole):
        raise InputError(where, f"{stated!r}", f"whole numbers, {least} or more")
    return tuple(dict.fromkeys(int(v) for v in values))


def _factors(stated: Any) -> tuple[float, ...]:
    values = list(stated) if isinstance(stated, Iterable) else [stated]
    numbers = [isinstance(v, int | float | np.number) and not isinstance(v, bool) for v in values]
    if not values or not all(numbers) or not all(1 <= v <= LARGEST_FACTOR for v in values):
        raise InputError("noise", f"{stated!r}", "factors of 1 or more on the noise that was measured")
    return tuple(dict.fromkeys(float(v) for v in values))
