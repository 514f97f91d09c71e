"""Studies: Python files with a question and cases, run in parallel, resumable, and compared with a baseline."""

from __future__ import annotations

import glob
import io
import json
import os
import pickle
import platform
import signal
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from dataclasses import dataclass, field, fields, is_dataclass
from datetime import UTC, datetime
from functools import lru_cache, partial
from hashlib import file_digest, sha256
from itertools import islice, product
from pathlib import Path
from types import ModuleType
from typing import Any

from rpim_opt.basics.exceptions import InputError, RpimError, choices
from rpim_opt.basics.files import LARGEST_DATA, json_text, read_bytes, read_json, require_file, write_files, writing
from rpim_opt.basics.tables import library
from rpim_opt.basics.text import Progress, version_of
from rpim_opt.data.record import PACKAGES
from rpim_opt.store.own_code import run_file
from rpim_opt.store.problem_file import PACKAGE, problems_folder

NEEDED = ("QUESTION", "METRICS", "cases", "run", "report")
"""Required names of a study; an optional prepare(quick) is called once before the first case."""
FILE = "study.py"  # the study of a folder
MOST_FILES = 10_000  # largest number of files beside a study, all of which are read before replicates are resumed
REPLICATES = "replicates"
PICTURES: dict[str, dict[str, Any]] = {"svg": {"Date": None}, "png": {}}
"""Formats of figures and their metadata: without the time, equal figures give equal files."""


@dataclass(frozen=True)
class Metric:
    """A metric of a study that must not get worse: its direction, and its relative tolerance.

    ``better`` is ``"lower"`` or ``"higher"``, ``tolerance`` the part of the baseline by which it may be worse.
    """

    better: str
    tolerance: float


@dataclass(frozen=True)
class Report:
    """The answer of a study: a Markdown text, ``metrics`` by the names of its METRICS, matplotlib figures by name."""

    text: str
    metrics: Mapping[str, float] = field(default_factory=dict)
    figures: Mapping[str, Any] = field(default_factory=dict)


Row = dict[str, Any]  # a case with its figures
Work = Callable[[], Row]  # computation of a replicate; it travels to wherever it is computed
STUDIES = PACKAGE.parent / "studies"  # of the checkout; an installed package has none
LIBRARIES = [Path(sysconfig.get_path(key)).resolve() for key in ("stdlib", "platstdlib", "purelib", "platlib")]
"""Folders of Python files that are identified by the versions of packages."""
SHORT = 12  # digits of a digest that a reader compares by eye


# --- where a study is ------------------------------------------------------------------------------------------------


def find_study(name: str | Path) -> Path:
    """Return the file of a path, of a folder with ``study.py``, or of a name in the checkout or the current folder."""
    known = {path.stem: path for path in sorted(STUDIES.glob("*.py"))}
    text = str(name)
    names = f"{text}/{FILE}", f"{text}.py", f"studies/{text}.py", f"studies/{text}/{FILE}"
    for place in [known.get(text, Path(text)), *map(Path, names)]:
        if place.is_file():
            return place.resolve()
    accepted = f"a Python file, or a folder with {FILE}"
    if known:
        accepted += f", or a study of the checkout: {choices(text, known)}"
    raise InputError("study", f"'{text}'", accepted)


def _label(path: Path, quick: bool = False) -> str:
    """Return the name of a study: its file, or its folder where that holds ``study.py``."""
    return {FILE: path.parent.name}.get(path.name, path.stem) + "-quick" * quick


@lru_cache(maxsize=8)
def load_study(path: Path, needed: tuple[str, ...] = NEEDED) -> ModuleType:
    """Return a study: a Python file with the names that are ``needed``, which may import files beside it."""
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    try:
        module = run_file(path, f"study_{path.stem}")
    except SyntaxError as error:
        raise InputError(f"line {error.lineno}", str(error.msg), "Python", path) from None
    except ModuleNotFoundError as error:
        raise InputError("the study", f"no package {error.name}", "pip install it", path) from None
    missing = [name for name in needed if not hasattr(module, name)]
    if missing:
        raise InputError("the study", f"no '{missing[0]}'", ", ".join(needed), path)
    return module


# --- what its replicates follow from ---------------------------------------------------------------------------------


def files_of(path: Path, study: ModuleType) -> dict[str, str]:
    """Return digests of the files that a study depends on, by their names in its folder.

    These are all files in its folder except hidden files and results of studies; if the study defines ``DEPENDS =
    ["data/*.csv"]``, those and Python files.
    """
    folder = path.parent
    patterns = getattr(study, "DEPENDS", None)
    files = _matching(folder, "**" if patterns is None else "**/*.py")
    results = {file.parent for file in files if file.name.startswith(f"{REPLICATES}.")}
    files = {file for file in files if not results.intersection(file.parents)}
    for pattern in map(str, patterns or ()):
        named = _matching(folder, pattern) | _matching(folder, f"{pattern}/**")
        if not named and not glob.has_magic(pattern):
            raise InputError("DEPENDS", f"no file '{pattern}'", "names or patterns of files, from its folder", path)
        files |= named
    digests = {os.path.relpath(file, folder): "unreadable" for file in sorted(files)}  # nor can the study read it
    for name in digests:
        with suppress(OSError), Path(folder, name).open("rb") as stream:
            digests[name] = file_digest(stream, "sha256").hexdigest()
    return digests


def _matching(folder: Path, pattern: str) -> set[Path]:
    """Return the files that match a pattern, without hidden and compiled ones."""
    files = [Path(match) for match in islice(glob.iglob(str(folder / pattern), recursive=True), MOST_FILES + 1)]
    if len(files) > MOST_FILES:
        accepted = "DEPENDS = [...] in the study: names of the files that it reads"
        raise InputError("DEPENDS", f"more than {MOST_FILES} files in {folder}", accepted)
    return {file for file in files if file.is_file() and file.suffix != ".pyc"}


def run_study(
    name: str | Path,
    quick: bool = False,
    workers: int = 1,
    resume: bool | None = None,
    redraw: bool = False,
    out: Path | None = None,
    progress: Progress = lambda _done, _every: None,
) -> tuple[Report, Path]:
    """Run a study; return its report and the folder with ``README.md``, ``metrics.json``, replicates and figures.

    Every replicate is a case, a table of plain values that includes the seed, so that results do not depend on who
    computes them. Finished replicates are stored at once. ``name`` is a file ``mine.py``, a folder with ``study.py``,
    or a study of the checkout without its ending; ``quick`` runs the small version; ``workers``, ``resume`` and
    ``progress`` are as for `run_cases`. ``redraw`` only rewrites the report from the replicates of the last run.
    Results go to ``out``, by default ``results/NAME`` or ``results/NAME-quick`` beside the study.
    """
    path = find_study(name)
    study = load_study(path)
    folder = out or path.parent / "results" / _label(path, quick)
    table = folder / f"{REPLICATES}.parquet"
    if not redraw:
        _replicate(path, study, quick, workers, resume, table, progress)
    parquet = library("pyarrow.parquet", "the study", "studies")
    if not table.exists():
        raise InputError("redraw", "no replicates", "a study that was run before", table)
    require_file(table, LARGEST_DATA)
    try:
        rows = parquet.read_table(table)
        made = (rows.schema.metadata or {}).get(b"made", b"").decode()
    except (OSError, ValueError) as error:
        raise InputError("redraw", str(error), "the replicates of a study", table) from None
    # without what a replicate does not have
    report = study.report([{key: v for key, v in row.items() if v is not None} for row in rows.to_pylist()])
    write(folder, study.QUESTION, report, made, {})  # which were there before
    return report, folder


def _replicate(
    path: Path, study: ModuleType, quick: bool, workers: int, resume: bool | None, file: Path, progress: Progress
) -> None:
    """Write the replicates of a study to a Parquet file, from which the report is made, now or again."""
    pyarrow = library("pyarrow", "the study", "studies")
    parquet = library("pyarrow.parquet", "the study", "studies")
    file.parent.mkdir(parents=True, exist_ok=True)
    if hasattr(study, "prepare"):
        study.prepare(quick)
    cases = study.cases(quick)
    files = files_of(path, study)
    # results belong to the present files, whatever happens to them meanwhile
    name = _label(path) if path.parent == STUDIES else path.name
    source = f"`rpim-opt study {name}{' --quick' * quick}`, {file_state(path)}, with {package_state()}"
    digest = sha256(repr(sorted(files.items())).encode()).hexdigest()[:SHORT]
    known = f"{len(files)} files in its folder or named by it have SHA-256 {digest}; others that it reads are not known"
    made = f"Made by {source}: {len(cases)} replicates, {versions()}. {known}."
    code = {**{f"file {each}": digest for each, digest in files.items()}, **package_code()}
    journal = file.with_suffix(".jsonl")
    rows = run_cases(cases, lambda case: partial(_run, path, case), workers, progress, journal, code, resume)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    table = pyarrow.table({key: [row.get(key) for row in rows] for key in columns})
    stream = io.BytesIO()
    parquet.write_table(table.replace_schema_metadata({"made": made}), stream)
    write_files({file: stream.getvalue()})
    journal.unlink()


def _run(path: Path, case: Mapping[str, Any]) -> Row:
    row = load_study(path).run(**case)
    if not isinstance(row, dict):
        accepted = 'a dict of figures by name, as in return {"error_mm": 0.03}; further rows are further cases'
        raise InputError("run of the study", type(row).__name__, accepted, path)
    return row


def write(folder: Path, question: str, report: Report, made: str, replicates: Mapping[str, bytes]) -> None:
    """Write ``README.md`` with the figures, ``metrics.json`` and the file of the replicates: all, or none."""
    pictures = [f"![{title}]({title}.svg)\n" for title in report.figures]
    text = "\n".join([f"# {question}", "", report.text.strip(), "", *pictures, made])
    files = {"README.md": f"{text}\n".encode(), "metrics.json": json_text(dict(report.metrics)).encode(), **replicates}
    for (title, figure), (kind, metadata) in product(report.figures.items(), PICTURES.items()):
        from matplotlib import rc_context  # which nothing but a figure needs

        stream = io.BytesIO()
        with rc_context({"svg.hashsalt": title}):  # the same file for the same figure
            figure.savefig(stream, format=kind, metadata=metadata)
        files[f"{title}.{kind}"] = stream.getvalue()
    write_files({folder / name: content for name, content in files.items()})


def regressions(name: str | Path, quick: bool, metrics: Mapping[str, float]) -> list[str]:
    """Return a sentence for every metric that is worse than ``baselines.json`` of the study allows."""
    file = find_study(name)
    path = file.parent / "baselines.json"
    known = read_json(path) if path.is_file() else {}
    label = _label(file, quick)
    if label not in known:
        raise InputError("baseline", f"none for '{label}'", choices(label, known), path)
    rules = load_study(file).METRICS
    worse = []
    for metric, baseline in known[label].items():
        rule = rules[metric]
        value = metrics.get(metric)
        sign = 1 if rule.better == "lower" else -1
        if value is None or not sign * (value - baseline) <= rule.tolerance * abs(baseline):
            bound = f"{rule.better} is better, tolerance {rule.tolerance:.0%}"
            worse.append(f"{metric}: found {value}, baseline {baseline}, {bound}")
    return worse


# --- replicates ------------------------------------------------------------------------------------------------------


def run_cases(
    cases: Sequence[Mapping[str, Any]],
    work: Callable[[Mapping[str, Any]], Work],
    workers: int,
    progress: Progress,
    journal: Path | None,
    code: Mapping[str, str],
    resume: bool | None,
) -> list[Row]:
    """Return every case with its figures, in the order of the cases.

    ``cases`` are plain tables, and ``work`` returns the computation of one; ``code`` has digests of what replicates
    depend on. Those of an interrupted run are resumed (True), dropped (False), or refused (None), like other code's.
    """
    keyed = [(json.dumps(case, sort_keys=True), case) for case in cases]
    stored = {} if journal is None or resume is False else _resumed(journal, code, resume)
    done = {key: stored[key] for key, _ in keyed if key in stored}
    if journal is not None:  # rewritten, without an unfinished line
        lines = "".join(f"{json.dumps(line)}\n" for line in {"code": code, **stored}.items())
        write_files({journal: lines.encode()})
    with Path(journal or os.devnull).open("ab", buffering=0) as stream:
        progress(len(done), len(cases))
        tasks = [(key, work(case)) for key, case in keyed if key not in done]
        for key, row in compute(tasks, workers):
            with writing(Path(stream.name)):
                stream.write(f"{json.dumps([key, row])}\n".encode())
            done[key] = row
            progress(len(done), len(cases))
    return [{**case, **done[key]} for key, case in keyed]


def _resumed(path: Path, code: Mapping[str, str], resume: bool | None) -> dict[str, Row]:
    """Return the replicates of an interrupted run by their keys; refuse those of other code."""
    if not (path.exists() or path.is_symlink()):
        return {}
    content = read_bytes(path, LARGEST_DATA)
    try:  # of the finished lines
        stored = dict(json.loads(line) for line in content[: content.rfind(b"\n") + 1 or None].splitlines())
        known = dict(stored.pop("code", {}))
    except (TypeError, ValueError):
        accepted = "--no-resume (resume=False) to start again"
        raise InputError("the file", "no journal of replicates", accepted, path) from None
    if not stored:
        return {}
    if resume is None:
        accepted = "--resume (resume=True) to continue with them, or --no-resume (resume=False) to start again"
        raise InputError("resume", f"{len(stored)} replicates of an interrupted run", accepted, path)
    for part in [*code, *known]:
        if code.get(part) != known.get(part):
            accepted = "the same code, data and versions, or --no-resume to start again"
            raise InputError("resume", f"replicates of another {part}", accepted, path)
    return stored


def compute(tasks: Sequence[tuple[str, Work]], workers: int) -> Iterator[tuple[str, Row]]:
    """Yield keys and results as they are finished; ``workers`` as in `compare`."""
    if workers == 0:
        raise InputError("workers", "0", "one or more, or -1 for all processors")
    if workers == 1:
        yield from (_computed(*task) for task in tasks)
        return
    joblib = library("joblib", "workers", "studies")
    answer = None
    with suppress(ValueError):  # raised outside the main thread
        answer = signal.signal(signal.SIGINT, signal.SIG_IGN)  # inherited by processes: only this one handles Ctrl-C
    try:
        parallel = joblib.Parallel(n_jobs=workers, return_as="generator_unordered")
        finished = parallel(joblib.delayed(_computed)(*task) for task in tasks)
    finally:
        if answer is not None:
            signal.signal(signal.SIGINT, answer)
    try:
        yield from finished
    except BrokenExecutor as error:
        ended = f"A process ended before its replicate was finished: {error}"
        raise RpimError(f"{ended} Finished replicates are kept.") from None


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
    return f"{path.name} with SHA-256 {sha256(path.read_bytes()).hexdigest()[:SHORT]} ({commit(path)})"


def package_state() -> str:
    """Return the package's version, its digest, and its commit where there is one."""
    checkout = (PACKAGE.parent / "pyproject.toml").is_file()
    state = commit(PACKAGE, problems_folder()) if checkout else "installed"
    return f"rpim-opt {version_of('rpim-opt')}, SHA-256 {package_code()['package'][:SHORT]} ({state})"


def commit(*paths: Path) -> str:
    """Return the commit of some paths, with ``untracked`` or ``dirty`` if they differ from it."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(paths[0].parent), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout

    try:
        described = f"commit {git('describe', '--always').strip()}"
        changes = git("status", "--porcelain", "--untracked-files=all", "--", *map(str, paths))
    except (OSError, subprocess.CalledProcessError):
        return "in no repository"
    if "??" in {line[:2] for line in changes.splitlines()}:
        return f"{described}, untracked"
    return described + ", dirty" * bool(changes)


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


def script_code() -> dict[str, str]:
    """Return digests of the Python files that are loaded besides installed ones."""
    codes = {}
    for module in list(sys.modules.values()):
        file = Path(getattr(module, "__file__", None) or "")
        own = PACKAGE not in file.parents and not any(folder in file.resolve().parents for folder in LIBRARIES)
        if file.suffix == ".py" and own and file.is_file():
            codes[f"file {file.name} ({module.__name__})"] = sha256(file.read_bytes()).hexdigest()
    return codes


def content_hash(thing: Any, where: str) -> str:
    """Return the hash of a value or an object by joblib, of what can be pickled.

    Functions count by name: their code is that of `script_code`. InputError for objects that cannot be pickled, such as
    a lambda or a generator, and for functions of an interactive session, which has no file.
    """

    def reduced(pickler: Any, obj: Any) -> Any:
        own = type(obj).__module__.startswith("rpim_opt.") and type(obj).__reduce__ is object.__reduce__
        if own and is_dataclass(obj) and not isinstance(obj, type):  # without what it cached
            return type(obj), tuple(getattr(obj, each.name) for each in fields(obj))
        return NotImplemented

    hasher = library("joblib.hashing", where, "studies").NumpyHasher
    whole = io.BytesIO()
    try:
        # first, because joblib passes over what it cannot pickle inside a mapping
        type("Whole", (pickle.Pickler,), {"reducer_override": reduced})(whole).dump(thing)
        if hasattr(sys.modules["__main__"], "__file__") or b"__main__" not in whole.getvalue():
            return str(type("Hasher", (hasher,), {"reducer_override": reduced})("sha256").hash(thing))
        found = "a function of an interactive session"
    except Exception as error:  # any library's own
        found = f"something that cannot be pickled ({error})"
    raise InputError(where, found, "what can be pickled, with functions of a file by their names; or no journal")
