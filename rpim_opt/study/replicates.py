"""Replicates: computed here, in processes or on a cluster, and kept in a file when they are done."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError
from contextlib import ExitStack, closing, contextmanager
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rpim_opt.basics.exceptions import InputError, RpimError
from rpim_opt.basics.files import LARGEST_DATA, parse_json, refused, require_file

Row = dict[str, Any]
"""A case with its figures."""
Task = tuple[str, Callable[[], Row]]
"""A replicate's key, and what computes it; it travels to wherever that happens."""
Progress = Callable[[int, int], None]
"""Told how many replicates of how many are done."""
SCHEMA = """
BEGIN IMMEDIATE;
CREATE TABLE IF NOT EXISTS code (part TEXT PRIMARY KEY, digest TEXT);
CREATE TABLE IF NOT EXISTS replicates (key TEXT PRIMARY KEY, found TEXT, digest TEXT);
COMMIT;
"""


class Journal:
    """Cases, and their replicates that are done: each is on the disk before the next one counts.

    Use `open_journal`.
    """

    def __init__(self, base: sqlite3.Connection, path: Path | None, cases: Sequence[Mapping[str, Any]]) -> None:
        self.base = base
        self.path = path
        self.cases = [(json.dumps(case, sort_keys=True), case) for case in cases]
        self.done: dict[str, Row] = {}
        self.code = ""

    @property
    def waiting(self) -> list[tuple[str, Mapping[str, Any]]]:
        """The cases that are left to compute, with their keys."""
        return [(key, case) for key, case in self.cases if key not in self.done]

    @property
    def rows(self) -> list[Row]:
        """Every case with its figures, in the order of the cases."""
        return [{**case, **self.done[key]} for key, case in self.cases]

    def fill(self, tasks: Sequence[Task], workers: int, scheduler: Any, progress: Progress) -> None:
        """Compute what is left, and write every replicate down when it is done."""
        progress(len(self.done), len(self.cases))
        for key, found in compute(tasks, workers, scheduler):
            text = json.dumps(found)
            with _sentence(self.path):
                self.base.execute("INSERT INTO replicates VALUES (?, ?, ?)", (key, text, self._digest(key, text)))
            self.done[key] = found
            progress(len(self.done), len(self.cases))

    def take_up(self, code: Mapping[str, str], resume: bool | None) -> None:
        """Take up the replicates of an interrupted run; refuse those of other code, and any where nobody said so."""
        known = dict(self.base.execute("SELECT part, digest FROM code"))
        stored = self.base.execute("SELECT key, found, digest FROM replicates").fetchall()
        self.code = json.dumps(dict(code), sort_keys=True)
        if stored and resume is None:
            accepted = "resume, to go on with them, or no-resume, to begin anew"
            raise InputError("resume", f"{len(stored)} replicates of an interrupted run", accepted, self.path)
        if not stored:
            self.base.execute("DELETE FROM code")
            self.base.executemany("INSERT INTO code VALUES (?, ?)", list(code.items()))
            return
        for part in [*code, *known]:
            if code.get(part) != known.get(part):
                accepted = "what began, or no-resume, to begin anew"
                raise InputError("resume", f"replicates of another {part}", accepted, self.path)
        cases = {key for key, _ in self.cases}
        for key, text, digest in stored:
            if digest != self._digest(key, text):
                found = f"a replicate that was changed afterwards: {key}"
                raise InputError("resume", found, "replicates as they were computed, or no-resume", self.path)
            if key in cases:
                self.done[key] = parse_json(text)

    def _digest(self, key: str, found: str) -> str:
        """Return the SHA-256 of a replicate and of the code that computed it."""
        return sha256("\0".join([self.code, str(key), str(found)]).encode()).hexdigest()

    def remove(self) -> None:
        """Remove the file: everything is where it belongs."""
        self.base.close()
        _remove(self.path)


@contextmanager
def open_journal(
    path: Path | None, cases: Sequence[Mapping[str, Any]], code: Mapping[str, str], resume: bool | None
) -> Iterator[Journal]:
    """Open a file that keeps finished replicates, a SQLite database; without a path they are kept in memory.

    Parameters
    ----------
    path, cases
        Where, and of which cases.
    code
        What replicates follow from, in digests; only that goes on with them.
    resume
        Whether replicates of an interrupted run are taken up (true), dropped (false), or refused (None).
    """
    exists = path is not None and (path.exists() or path.is_symlink())
    if path is not None and exists and resume is False:
        _remove(path)
    elif path is not None and exists:
        require_file(path, LARGEST_DATA)
    with _sentence(path):
        base = sqlite3.connect(path or ":memory:", isolation_level=None)
    with closing(base):
        journal = Journal(base, path, cases)
        with _sentence(path):
            base.execute("PRAGMA trusted_schema = OFF")
            base.executescript(SCHEMA)
            journal.take_up(code, resume)
        yield journal


@contextmanager
def _sentence(path: Path | None) -> Iterator[None]:
    """Turn an error of the database, or of a text in it, into a sentence."""
    try:
        yield
    except (sqlite3.Error, ValueError) as error:
        raise RpimError(f"{path}: the journal cannot be read or written: {error}.") from None


def _remove(path: Path | None) -> None:
    if path is not None:
        with refused(path):
            path.unlink(missing_ok=True)
            path.with_name(f"{path.name}-journal").unlink(missing_ok=True)  # SQLite's, which a kill may leave


def require_package(name: str, where: str) -> None:
    """Refuse what needs a package of the extra ``studies`` that is not there, before anything is computed."""
    if find_spec(name) is None:
        raise InputError(where, f"no package {name}", "pip install 'rpim-opt[studies]'")


def compute(tasks: Sequence[Task], workers: int, scheduler: Any) -> Iterator[tuple[str, Row]]:
    """Yield keys with what was computed, as it is finished.

    Parameters
    ----------
    tasks
        What to compute.
    workers
        Processes on this machine, -1 for all processors.
    scheduler
        Address of a Dask scheduler to compute on instead, or a client of one.
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


def _computed(key: str, work: Callable[[], Row]) -> tuple[str, Row]:
    return key, work()


def _in_processes(tasks: Sequence[Task], workers: int) -> Iterator[tuple[str, Row]]:
    from joblib import Parallel, delayed

    finished: Any = Parallel(n_jobs=workers, return_as="generator_unordered")(delayed(_computed)(*t) for t in tasks)
    try:
        yield from finished
    except BrokenExecutor as error:
        raise RpimError(f"A process ended before its replicate was done: {error} What was finished is kept.") from None


def _on_cluster(tasks: Sequence[Task], scheduler: Any) -> Iterator[tuple[str, Row]]:
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
            raise RpimError(f"Dask gave a replicate up: {said} What was finished is kept.") from None
