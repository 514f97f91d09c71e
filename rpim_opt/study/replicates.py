"""Replicates: computed here, in processes or on a Dask cluster, and kept in a SQLite database when they are done."""

from __future__ import annotations

import json
import signal
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError
from contextlib import ExitStack, closing, contextmanager, suppress
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rpim_opt.basics.exceptions import InputError, RpimError
from rpim_opt.basics.files import LARGEST_DATA, parse_json, refused, require_file

Row = dict[str, Any]
"""A case with its figures."""
Work = Callable[[], Row]
"""Computation of a replicate; it travels to wherever it is computed."""
Progress = Callable[[int, int], None]
"""Called with how many replicates of how many are done."""
SCHEMA = """
BEGIN IMMEDIATE;
CREATE TABLE IF NOT EXISTS code (part TEXT PRIMARY KEY, digest TEXT);
CREATE TABLE IF NOT EXISTS replicates (key TEXT PRIMARY KEY, found TEXT, digest TEXT);
COMMIT;
"""


def run_cases(
    cases: Sequence[Mapping[str, Any]], work: Callable[[Mapping[str, Any]], Work], workers: int, scheduler: Any,
    progress: Progress, journal: Path | None = None, code: Mapping[str, str] | None = None, resume: bool | None = True,
) -> list[Row]:  # fmt: skip
    """Return every case with its figures, in the order of the cases.

    Parameters
    ----------
    cases, work
        Plain tables, and the function that returns what computes one.
    workers, scheduler, progress
        As `compute` has them; called whenever a replicate is done.
    journal
        A file that every finished replicate is written to before the next one counts.
    code
        Digests of what replicates follow from; those of other code are refused.
    resume
        Whether replicates of an interrupted run are resumed (true), dropped (false), or refused (None).
    """
    keyed = [(json.dumps(case, sort_keys=True), case) for case in cases]
    code = code or {}
    if journal is not None and (journal.exists() or journal.is_symlink()):
        if resume is False:
            remove_journal(journal)
        else:
            require_file(journal, LARGEST_DATA)
    with _sentence(journal):
        base = sqlite3.connect(journal or ":memory:", isolation_level=None)
    with closing(base):
        with _sentence(journal):
            base.execute("PRAGMA trusted_schema = OFF")
            base.executescript(SCHEMA)
            stored = _resumed(base, journal, code, resume)
        done = {key: stored[key] for key, _ in keyed if key in stored}
        progress(len(done), len(cases))
        tasks = [(key, work(case)) for key, case in keyed if key not in done]
        for key, found in compute(tasks, workers, scheduler):
            text = json.dumps(found)
            with _sentence(journal):
                base.execute("INSERT INTO replicates VALUES (?, ?, ?)", (key, text, _digest(code, key, text)))
            done[key] = found
            progress(len(done), len(cases))
    return [{**case, **done[key]} for key, case in keyed]


def _resumed(
    base: sqlite3.Connection, path: Path | None, code: Mapping[str, str], resume: bool | None
) -> dict[str, Row]:
    """Return the replicates of an interrupted run by their keys; refuse those of other code, and edited ones."""
    known = dict(base.execute("SELECT part, digest FROM code"))
    stored = base.execute("SELECT key, found, digest FROM replicates").fetchall()
    if not stored:
        base.execute("DELETE FROM code")
        base.executemany("INSERT INTO code VALUES (?, ?)", list(code.items()))
        return {}
    if resume is None:
        accepted = "resume, to continue with them, or no-resume, to start again"
        raise InputError("resume", f"{len(stored)} replicates of an interrupted run", accepted, path)
    for part in [*code, *known]:
        if code.get(part) != known.get(part):
            accepted = "what began, or no-resume, to start again"
            raise InputError("resume", f"replicates of another {part}", accepted, path)
    for key, text, digest in stored:
        if digest != _digest(code, key, text):
            found = f"a replicate that was changed afterwards: {key}"
            raise InputError("resume", found, "replicates as they were computed, or no-resume", path)
    return {key: parse_json(text) for key, text, _ in stored}


def _digest(code: Mapping[str, str], key: str, found: str) -> str:
    """Return the SHA-256 of a replicate and of the code that computed it."""
    text = json.dumps(dict(code), sort_keys=True)
    return sha256("\0".join([text, str(key), str(found)]).encode()).hexdigest()


@contextmanager
def _sentence(path: Path | None) -> Iterator[None]:
    """Turn an error of the database, or of a text in it, into a sentence."""
    try:
        yield
    except (sqlite3.Error, ValueError) as error:
        raise RpimError(f"{path}: the journal cannot be read or written: {error}.") from None


def remove_journal(path: Path) -> None:
    """Remove a journal, and the file beside it that a kill may leave."""
    with refused(path):
        path.unlink(missing_ok=True)
        path.with_name(f"{path.name}-journal").unlink(missing_ok=True)


def require_package(name: str, where: str) -> None:
    """Refuse what needs a package of the extra ``studies`` that is not there, before anything is computed."""
    if find_spec(name) is None:
        raise InputError(where, f"no package {name}", "pip install 'rpim-opt[studies]'")


def compute(tasks: Sequence[tuple[str, Work]], workers: int, scheduler: Any) -> Iterator[tuple[str, Row]]:
    """Return an iterator of keys with what was computed, as it is finished.

    ``workers`` are processes on this machine, -1 for all processors; ``scheduler`` the address of a Dask scheduler to
    compute on instead, or a client of one.
    """
    if workers == 0:
        raise InputError("workers", "0", "one or more, or -1 for all processors")
    if scheduler is not None:
        require_package("distributed", "scheduler")
        return _on_cluster(tasks, scheduler)
    if workers != 1:
        require_package("joblib", "workers")
        return _in_processes(tasks, workers)
    return (_computed(*task) for task in tasks)


def _computed(key: str, work: Work) -> tuple[str, Row]:
    return key, work()


def _in_processes(tasks: Sequence[tuple[str, Work]], workers: int) -> Iterator[tuple[str, Row]]:
    from joblib import Parallel, delayed

    answer = None
    with suppress(ValueError):  # of a thread that is not the main one
        answer = signal.signal(signal.SIGINT, signal.SIG_IGN)  # as processes inherit: Ctrl-C is this one's to answer
    try:
        finished: Any = Parallel(n_jobs=workers, return_as="generator_unordered")(delayed(_computed)(*t) for t in tasks)
    finally:
        if answer is not None:
            signal.signal(signal.SIGINT, answer)
    try:
        yield from finished
    except BrokenExecutor as error:
        raise RpimError(
            f"A process ended before its replicate was done: {error} Finished replicates are kept."
        ) from None


def _on_cluster(tasks: Sequence[tuple[str, Work]], scheduler: Any) -> Iterator[tuple[str, Row]]:
    from distributed import Client, KilledWorker, as_completed

    with ExitStack() as stack:
        client = scheduler
        if isinstance(scheduler, str):
            try:
                client = stack.enter_context(Client(scheduler, timeout="10s"))
            except (OSError, ValueError) as error:  # ValueError: no address
                raise RpimError(f"Dask scheduler {scheduler}: cannot be reached: {error}.") from None
        if not isinstance(client, Client):
            raise InputError("scheduler", f"a {type(client).__name__}", "the address of a Dask scheduler, or a client")
        futures = [client.submit(_computed, *task, pure=False) for task in tasks]
        try:
            for future in as_completed(futures):
                yield future.result()
        except (KilledWorker, CancelledError) as error:  # whoever computes it dies, or the scheduler has
            said = next(iter(str(error).splitlines()), type(error).__name__)
            raise RpimError(f"Dask gave a replicate up: {said} Finished replicates are kept.") from None
