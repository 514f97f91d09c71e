"""Run studies: replicates in parallel, resumed where they were, with results that say what made them."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from rpim_opt.basics.writing import refused
from rpim_opt.study.computing import Progress, fill, silent
from rpim_opt.study.grid import find_study, load_study, name_of
from rpim_opt.study.journal import Journal, kept, table_of
from rpim_opt.study.provenance import code_of, made_by
from rpim_opt.study.report import Report, write


def run_study(
    name: str | Path,
    quick: bool = False,
    workers: int = 1,
    scheduler: Any = None,
    resume: bool | None = None,
    redraw: bool = False,
    out: Path | None = None,
    progress: Progress = silent,
) -> tuple[Report, Path]:
    """Run a study and write its results.

    Every replicate is a case, a table of plain values with the seed among them, so that results do not depend on who
    computes them. A finished replicate is written down at once; ``resume`` takes those up.

    Parameters
    ----------
    name
        A file ``mine.py``, a folder with ``study.py``, or a study of the checkout without its ending.
    quick
        The small version.
    workers
        Processes on this machine (joblib).
    scheduler
        Address of a Dask scheduler to compute on instead, or a client of one.
    resume
        Go on where an interrupted run was; if false everything is computed anew. With None that is refused as long as
        replicates of an interrupted run are there.
    redraw
        Compute nothing: write the report anew from the replicates of the last run, which say what made them.
    out
        Where results go; ``results/NAME`` or ``results/NAME-quick`` beside the study by default.
    progress
        Told how many replicates of how many are done.

    Returns
    -------
    The report and the folder that holds ``README.md``, ``metrics.json``, ``replicates.parquet`` and the figures.
    """
    path = find_study(name)
    study = load_study(path)
    folder = out or _results(path, quick)
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
    made = made_by(path, quick, len(cases))  # of the code that is here now, whatever becomes of it meanwhile
    journal = Journal(folder / "replicates.jsonl", cases, code_of(path), resume)
    tasks = [(key, partial(_one, path, case)) for key, case in journal.waiting]
    fill(journal, tasks, workers, scheduler, progress)
    report = study.report(journal.rows)
    write(folder, study.QUESTION, report, made, {replicates.name: table_of(journal.rows, made)})
    journal.close()
    return report, folder


def _results(path: Path, quick: bool) -> Path:
    """Return where a study's results go by default."""
    name = f"{name_of(path)}-quick" if quick else name_of(path)
    return path.parent / "results" / name


def _one(path: Path, case: Mapping[str, Any]) -> dict[str, Any]:
    return load_study(path).run(**case)
