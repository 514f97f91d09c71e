"""Run studies: replicates in parallel, resumed where they were, with results that say what made them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from rpim_opt.basics.exceptions import InputError, RpimError
from rpim_opt.basics.writing import refused
from rpim_opt.study.grid import find_study, load_study
from rpim_opt.study.journal import Journal, kept, table_of
from rpim_opt.study.provenance import code_of, made_by
from rpim_opt.study.report import Report, write

Found = tuple[str, dict[str, Any]]
Run = Callable[[str, Mapping[str, Any]], Found]
Waiting = Sequence[tuple[str, Mapping[str, Any]]]
"""A replicate: its key and what was found; what computes one; cases by their keys."""


def run_study(
    name: str,
    quick: bool = False,
    workers: int = 1,
    scheduler: str | None = None,
    resume: bool = False,
    redraw: bool = False,
    out: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, all_: None,
) -> tuple[Report, Path]:
    """Run a study and write its results.

    Every replicate is a case, a table of plain values with the seed among them, so that results do not depend on who
    computes them. A finished replicate is written down at once; ``resume`` takes those up.

    Parameters
    ----------
    name
        A file of ``studies`` without its ending.
    quick
        The small version.
    workers
        Processes on this machine (joblib).
    scheduler
        Address of a Dask scheduler to compute on instead.
    resume
        Go on where an interrupted run was; otherwise everything is computed anew.
    redraw
        Compute nothing: write the report anew from the replicates of the last run, which say what made them.
    out
        Where results go; ``studies/results/NAME`` or ``NAME-quick`` by default.
    progress
        Told how many replicates of how many are done.

    Returns
    -------
    The report and the folder that holds ``README.md``, ``metrics.json``, ``replicates.parquet`` and the figures.
    """
    path = find_study(name)
    study = load_study(path)
    folder = out or path.parent / "results" / (f"{name}-quick" if quick else name)
    with refused(folder):
        folder.mkdir(parents=True, exist_ok=True)
    replicates = folder / "replicates.parquet"
    if redraw:
        rows, made = kept(replicates)
        report = study.report(rows)
        write(folder, study.QUESTION, report, made, {})
        return report, folder
    if hasattr(study, "prepare"):
        study.prepare(quick)
    cases = study.cases(quick)
    made = made_by(name, quick, len(cases))  # of the code that is here now, whatever becomes of it meanwhile
    journal = Journal(folder / "replicates.jsonl", cases, code_of(name), resume)
    _fill(journal, partial(_one, path), workers, scheduler, progress)
    report = study.report(journal.rows)
    write(folder, study.QUESTION, report, made, {replicates.name: table_of(journal.rows, made)})
    journal.close()
    return report, folder


def _one(path: Path, key: str, case: Mapping[str, Any]) -> Found:
    return key, load_study(path).run(**case)


def _fill(
    journal: Journal, run: Run, workers: int, scheduler: str | None, progress: Callable[[int, int], None]
) -> None:
    """Compute what is left, and write every replicate down when it is finished."""
    every = len(journal.cases)
    progress(len(journal.done), every)
    for key, found in _computed(run, journal.waiting, workers, scheduler):
        journal.add(key, found)
        progress(len(journal.done), every)


def _computed(run: Run, waiting: Waiting, workers: int, scheduler: str | None) -> Iterator[Found]:
    """Yield results as they are finished."""
    if scheduler is not None:
        return _on_cluster(run, waiting, scheduler)
    if workers != 1:
        return _in_processes(run, waiting, workers)
    return (run(key, case) for key, case in waiting)


def _on_cluster(run: Run, waiting: Waiting, scheduler: str) -> Iterator[Found]:
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise InputError("scheduler", "no package distributed", "pip install 'rpim-opt[studies]'") from None
    try:
        client = Client(scheduler, timeout="10s")
    except (OSError, ValueError) as error:  # ValueError: no address
        raise RpimError(f"Dask scheduler {scheduler}: cannot be reached: {error}.") from None
    with client:
        futures = [client.submit(run, key, case, pure=False) for key, case in waiting]
        for future in as_completed(futures):
            yield future.result()


def _in_processes(run: Run, waiting: Waiting, workers: int) -> Iterator[Found]:
    try:
        from joblib import Parallel, delayed
    except ImportError:
        raise InputError("workers", "no package joblib", "pip install 'rpim-opt[studies]'") from None
    if workers == 0:
        raise InputError("workers", "0", "one or more, or -1 for all processors")
    tasks = (delayed(run)(key, case) for key, case in waiting)
    finished: Any = Parallel(n_jobs=workers, return_as="generator_unordered")(tasks)
    yield from finished
