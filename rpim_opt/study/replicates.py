"""Replicates: computed here or in joblib's processes, kept in a SQLite database; what made them."""

from __future__ import annotations

import json
import pickle
import platform
import signal
import sqlite3
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rpim_opt.basics.exceptions import InputError, RpimError
from rpim_opt.basics.files import LARGEST_DATA, parse_json, refused, require_file
from rpim_opt.basics.text import Progress, version_of
from rpim_opt.data.record import PACKAGES
from rpim_opt.store.problem_file import problems_folder

Row = dict[str, Any]
"""A case with its figures."""
Work = Callable[[], Row]
"""Computation of a replicate; it travels to wherever it is computed."""
PACKAGE = Path(__file__).resolve().parents[1]
LIBRARIES = [Path(sysconfig.get_path(key)).resolve() for key in ("stdlib", "platstdlib", "purelib", "platlib")]
"""Where Python files lie that the versions of packages stand for."""
SHORT = 12
"""Digits of a digest that a reader compares by eye."""
SCHEMA = """
BEGIN IMMEDIATE;
CREATE TABLE IF NOT EXISTS code (part TEXT PRIMARY KEY, digest TEXT);
CREATE TABLE IF NOT EXISTS replicates (key TEXT PRIMARY KEY, found TEXT, digest TEXT);
COMMIT;
"""


# --- a run -----------------------------------------------------------------------------------------------------------


def run_cases(
    cases: Sequence[Mapping[str, Any]], work: Callable[[Mapping[str, Any]], Work], workers: int,
    progress: Progress, journal: Path | None = None, code: Mapping[str, str] | None = None, resume: bool | None = True,
) -> list[Row]:  # fmt: skip
    """Return every case with its figures, in the order of the cases.

    ``cases`` are plain tables, and ``work`` returns what computes one; ``workers`` is as `compute` has it,
    ``progress`` is called whenever a replicate is done. Every finished replicate is written to the
    ``journal`` before the next one counts; ``code`` are digests of what replicates follow from, and those of other code
    are refused. Replicates of an interrupted run are resumed (true), dropped (false), or refused (None).
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
        for key, row in compute(tasks, workers):
            text = json.dumps(row)
            with _sentence(journal):
                base.execute("INSERT INTO replicates VALUES (?, ?, ?)", (key, text, _digest(code, key, text)))
            done[key] = row
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
        accepted = "--resume to continue with them, or --no-resume to start again"
        raise InputError("resume", f"{len(stored)} replicates of an interrupted run", accepted, path)
    for part in [*code, *known]:
        if code.get(part) != known.get(part):
            accepted = "the same code, data and versions, or --no-resume to start again"
            raise InputError("resume", f"replicates of another {part}", accepted, path)
    for key, text, digest in stored:
        if digest != _digest(code, key, text):
            found = f"a replicate that was changed afterwards: {key}"
            raise InputError("resume", found, "unmodified replicates, or --no-resume", path)
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
    """Remove a journal, and the auxiliary file that an interrupted process may leave."""
    with refused(path):
        path.unlink(missing_ok=True)
        path.with_name(f"{path.name}-journal").unlink(missing_ok=True)


def require_package(name: str, where: str) -> None:
    """Refuse to start without a required package of the extra ``studies``."""
    if find_spec(name) is None:
        raise InputError(where, f"no package {name}", "pip install 'rpim-opt[studies]'")


# --- who computes ----------------------------------------------------------------------------------------------------


def compute(tasks: Sequence[tuple[str, Work]], workers: int) -> Iterator[tuple[str, Row]]:
    """Yield keys and results as they are finished.

    ``workers`` are processes on this machine, -1 for all processors; or those of the backend that
    ``joblib.parallel_config`` names, ``"dask"`` for a cluster.
    """
    if workers == 0:
        raise InputError("workers", "0", "one or more, or -1 for all processors")
    if workers == 1:
        yield from (_computed(*task) for task in tasks)
        return
    require_package("joblib", "workers")
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
            f"A process ended before its replicate was finished: {error} Finished replicates are kept."
        ) from None


def _computed(key: str, work: Work) -> tuple[str, Row]:
    return key, work()


# --- what made them --------------------------------------------------------------------------------------------------


def package_code() -> dict[str, str]:
    """Return digests of the package and its problems, and the versions of numerical libraries."""
    digests = {}
    for name, folder, pattern in (("package", PACKAGE, "**/*.py"), ("set of problems", problems_folder(), "*/*.*")):
        content = sha256()
        for file in sorted(folder.glob(pattern)):
            content.update(sha256(str(file.relative_to(folder)).encode()).digest())
            content.update(sha256(file.read_bytes()).digest())
        digests[name] = content.hexdigest()
    return {**digests, "set of versions": versions()}


def versions() -> str:
    """Return the versions of numerical libraries."""
    packages = ", ".join(f"{package} {version_of(package)}" for package in PACKAGES)
    return f"{platform.python_implementation()} {platform.python_version()}, {packages}"


def file_state(path: Path) -> str:
    """Return a file's name with its digest and its commit."""
    return f"{path.name} with SHA-256 {sha256(path.read_bytes()).hexdigest()[:SHORT]} ({commit(path.parent, path)})"


def package_state() -> str:
    """Return the package's version, its digest, and its commit where there is one."""
    checkout = (PACKAGE.parent / "pyproject.toml").is_file()
    state = commit(PACKAGE.parent, PACKAGE, problems_folder()) if checkout else "installed"
    return f"rpim-opt {version_of('rpim-opt')}, SHA-256 {package_code()['package'][:SHORT]} ({state})"


def commit(folder: Path, *paths: Path) -> str:
    """Return the commit of some paths, with ``untracked`` or ``dirty`` if they differ from it.

    Results of studies do not count.
    """

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    try:
        described = f"commit {git('describe', '--always').strip()}"
        changes = git(
            "status", "--porcelain", "--untracked-files=all", "--", *map(str, paths), ":(exclude,glob)**/results/**"
        )
    except (OSError, subprocess.CalledProcessError):
        return "in no repository"
    if "??" in {line[:2] for line in changes.splitlines()}:
        return f"{described}, untracked"
    return f"{described}, dirty" if changes else described


def provenance() -> dict[str, str]:
    """Return script, package, versions and time of a comparison."""
    file = getattr(sys.modules.get("__main__"), "__file__", None)
    script = "none: an interactive session"
    if file is not None and Path(file).name in ("rpim-opt", "__main__.py"):
        script = "rpim-opt " + " ".join(sys.argv[1:])
    elif file is not None and Path(file).is_file():
        script = file_state(Path(file).resolve())
    made = datetime.now(UTC).isoformat(timespec="seconds")
    return {"Script": script, "Package": package_state(), "Versions": versions(), "Made": made}


# --- what a comparison's replicates follow from ---------------------------------------------------------------------


def code_of(inputs: Mapping[str, Any]) -> dict[str, str]:
    """Return digests of the package, of a script, and of what it compares, by what that is called."""
    require_package("joblib", "journal")
    hashes = {f"set of {name}": content_hash(value, "journal") for name, value in inputs.items()}
    return package_code() | script_code() | hashes


def script_code() -> dict[str, str]:
    """Return digests of the Python files that are loaded besides installed ones, and of what a script was called with.

    Together they stand for the code of a script's functions, and for the globals that these read.
    """
    codes = {}
    for module in list(sys.modules.values()):
        file = Path(getattr(module, "__file__", None) or "")
        own = PACKAGE not in file.parents and not any(folder in file.resolve().parents for folder in LIBRARIES)
        if file.suffix == ".py" and own and file.is_file():
            codes[f"file {file.name} ({module.__name__})"] = sha256(file.read_bytes()).hexdigest()
            if module.__name__ == "__main__":
                codes["set of arguments of the script"] = repr(sys.argv[1:])
    return codes


def content_hash(thing: Any, where: str) -> str:
    """Return the hash of a value or an object by joblib, of what can be pickled.

    Functions count by their names: their code is that of `script_code`. InputError for what cannot be pickled, such as
    a lambda or a generator, and for functions of an interactive session, which has no file.
    """
    from joblib.hashing import NumpyHasher

    class Hasher(NumpyHasher):
        def reducer_override(self, obj: Any) -> Any:
            own = type(obj).__module__.startswith("rpim_opt.") and type(obj).__reduce__ is object.__reduce__
            if own and is_dataclass(obj) and not isinstance(obj, type):  # without what it cached
                return type(obj), tuple(getattr(obj, each.name) for each in fields(obj))
            return NotImplemented

    try:
        session = not hasattr(sys.modules["__main__"], "__file__")
        if not (session and b"__main__" in pickle.dumps(thing)):
            return str(Hasher("sha256").hash(thing))
        found = "a function of an interactive session"
    except Exception as error:  # of any library's own making
        found = f"something that cannot be pickled ({error})"
    raise InputError(where, found, "what can be pickled, with functions of a file by their names; or no journal")
