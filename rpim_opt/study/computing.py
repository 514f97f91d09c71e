"""Replicates computed one after the other, in processes of this machine, or on a Dask cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError
from contextlib import ExitStack
from typing import Any

from rpim_opt.basics.exceptions import InputError, RpimError
from rpim_opt.study.journal import Journal

Task = tuple[str, Callable[[], dict[str, Any]]]
"""A replicate's key, and what computes it; it travels to wherever that happens."""
Progress = Callable[[int, int], None]
"""Told how many replicates of how many are done."""


def silent(_done: int, _every: int) -> None:
    """Tell nobody."""


def fill(journal: Journal, tasks: Sequence[Task], workers: int, scheduler: Any, progress: Progress) -> None:
    """Compute what a journal lacks, and write every replicate down when it is finished.

    Parameters
    ----------
    journal
        What is done, and which cases there are.
    tasks
        What computes those that are left.
    workers
        Processes on this machine.
    scheduler
        Address of a Dask scheduler to compute on instead, or a client of one.
    progress
        Told how far it is.
    """
    every = len(journal.cases)
    progress(len(journal.done), every)
    for key, found in computed(tasks, workers, scheduler):
        journal.add(key, found)
        progress(len(journal.done), every)


def computed(tasks: Sequence[Task], workers: int, scheduler: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield keys with what was found, as they are finished."""
    if workers == 0:
        raise InputError("workers", "0", "one or more, or -1 for all processors")
    if scheduler is not None:
        return _on_cluster(tasks, scheduler)
    if workers != 1:
        return _in_processes(tasks, workers)
    return (_done(*task) for task in tasks)


def _done(key: str, work: Callable[[], dict[str, Any]]) -> tuple[str, dict[str, Any]]:
    return key, work()


def _on_cluster(tasks: Sequence[Task], scheduler: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    try:
        from distributed import Client, KilledWorker, as_completed
    except ImportError:
        raise InputError("scheduler", "no package distributed", "pip install 'rpim-opt[studies]'") from None
    with ExitStack() as stack:
        client = scheduler
        if isinstance(scheduler, str):
            try:
                client = stack.enter_context(Client(scheduler, timeout="10s"))
            except (OSError, ValueError) as error:  # ValueError: no address
                raise RpimError(f"Dask scheduler {scheduler}: cannot be reached: {error}.") from None
        if not isinstance(client, Client):
            raise InputError("scheduler", f"a {type(client).__name__}", "the address of a Dask scheduler, or a client")
        futures = [client.submit(_done, *task, pure=False) for task in tasks]
        try:
            for future in as_completed(futures):
                yield future.result()
        except (KilledWorker, CancelledError) as error:  # whoever computes it dies, or the scheduler has
            raise RpimError(f"Dask gave a replicate up: {_first_line(error)} What was finished is kept.") from None


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


def _in_processes(tasks: Sequence[Task], workers: int) -> Iterator[tuple[str, dict[str, Any]]]:
    try:
        from joblib import Parallel, delayed
    except ImportError:
        raise InputError("workers", "no package joblib", "pip install 'rpim-opt[studies]'") from None
    finished: Any = Parallel(n_jobs=workers, return_as="generator_unordered")(delayed(_done)(*task) for task in tasks)
    try:
        yield from finished
    except BrokenExecutor as error:
        raise RpimError(f"A process ended before its replicate was done: {error} What was finished is kept.") from None
