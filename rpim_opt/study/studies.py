"""Studies: Python files with a question and cases, run in parallel, resumable, and compared with a baseline."""

from __future__ import annotations

import glob
import importlib.util
import io
import os
import sys
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache, partial
from hashlib import file_digest, sha256
from itertools import product
from pathlib import Path
from types import ModuleType
from typing import Any

from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.files import LARGEST_DATA, json_text, read_json, refused, require_file, write_files
from rpim_opt.basics.text import Progress
from rpim_opt.study import replicates
from rpim_opt.study.replicates import Row, commit, require_package, run_cases

NEEDED = ("QUESTION", "METRICS", "cases", "run", "report")
"""What a study has: a text, a `Metric` for each figure that is held, and three functions."""
FILE = "study.py"
"""The study of a folder."""
MOST_FILES = 10_000
"""Of the files beside a study, each of which is read before its replicates are resumed."""
REPLICATES = "replicates"


@dataclass(frozen=True)
class Metric:
    """A metric of a study that must not get worse: its direction, and its relative tolerance.

    ``better`` is ``"lower"`` or ``"higher"``, ``tolerance`` what part of the baseline it may be worse by.

    >>> from rpim_opt.study import Metric
    >>> METRICS = {"mean error [mm]": Metric("lower", 0.1)}  # of a file in the folder studies
    """

    better: str
    tolerance: float


@dataclass(frozen=True)
class Report:
    """The answer of a study: a Markdown text, ``metrics`` by the names of its METRICS, matplotlib figures by name.

    >>> from rpim_opt.study import Report
    >>> Report("The error falls with the root of the number of poses.", {"mean error [mm]": 0.03}).metrics
    {'mean error [mm]': 0.03}
    """

    text: str
    metrics: Mapping[str, float] = field(default_factory=dict)
    figures: Mapping[str, Any] = field(default_factory=dict)


# --- where a study is ------------------------------------------------------------------------------------------------


def studies_folder() -> Path | None:
    """Return the folder ``studies`` of the checkout; an installed package has none."""
    folder = Path(__file__).resolve().parents[2] / "studies"
    return folder if folder.is_dir() else None


def find_study(name: str | Path) -> Path:
    """Return the file of a study: of a path, of a folder with ``study.py``, or of a name.

    A name is looked for among the studies of the checkout, and then in the current folder.
    """
    text = str(name)
    if text.endswith(".py") or os.sep in text or "/" in text or text in (".", ".."):
        path = Path(text, FILE) if Path(text).is_dir() else Path(text)
        if not path.is_file():
            raise InputError("study", f"no file '{path}'", f"a Python file with a study, or a folder with {FILE}")
        return path.resolve()
    own = studies_folder()
    known = {path.stem: path for path in sorted(own.glob("*.py"))} if own else {}
    if text in known:
        return known[text]
    for place in (Path(f"{text}.py"), Path(text, FILE), Path("studies", f"{text}.py"), Path("studies", text, FILE)):
        if place.is_file():
            return place.resolve()
    accepted = f"a file {text}.py, or a folder with {FILE}"
    if known:
        accepted += f", or a study of the checkout: {choices(text, known)}"
    raise InputError("study", f"'{text}'", accepted)


def _label(path: Path, quick: bool = False) -> str:
    """Return the name of a study: its file, or its folder where that holds ``study.py``."""
    name = path.parent.name if path.name == FILE else path.stem
    return f"{name}-quick" if quick else name


@lru_cache(maxsize=8)
def load_study(path: Path, needed: tuple[str, ...] = NEEDED) -> ModuleType:
    """Return a study: a Python file with QUESTION, METRICS, cases(quick), run(**case), report(rows).

    If it has prepare(quick), that is called once before the first case. It may import files beside it.
    """
    spec = importlib.util.spec_from_file_location(f"study_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise InputError("the study", str(path), "a Python file")
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    try:
        spec.loader.exec_module(module)
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

    That is whatever lies in its folder but hidden files and results of studies. Where the study says ``DEPENDS =
    ["data/*.csv"]``, it is that and Python files.
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
    digests = {}
    for file in sorted(files):
        name = os.path.relpath(file, folder)
        digests[name] = "unreadable"  # nor can the study read it
        with suppress(OSError), file.open("rb") as stream:
            digests[name] = file_digest(stream, "sha256").hexdigest()
    return digests


def _matching(folder: Path, pattern: str) -> set[Path]:
    """Return the files that match a pattern, without hidden and compiled ones."""
    files: set[Path] = set()
    for match in glob.iglob(str(folder / pattern), recursive=True):
        files.add(Path(match))
        if len(files) > MOST_FILES:
            accepted = "DEPENDS = [...] in the study: names of the files that it reads"
            raise InputError("DEPENDS", f"more than {MOST_FILES} files in {folder}", accepted)
    return {file for file in files if file.is_file() and file.suffix != ".pyc"}


def made_by(path: Path, quick: bool, count: int, files: Mapping[str, str]) -> str:
    """Return a sentence on the command, commit, files and versions that produce the replicates."""
    own = path.parent == studies_folder()
    command = f"rpim-opt study {_label(path) if own else path.name}{' --quick' if quick else ''}"
    if own:
        root = path.parent.parent
        source = f" ({commit(root, *(root / name for name in ('rpim_opt', 'studies', 'problems')))})"
    else:
        source = f", {replicates.file_state(path)}, with {replicates.package_state()}"
    digest = sha256(repr(sorted(files.items())).encode()).hexdigest()[: replicates.SHORT]
    known = f"{len(files)} files in its folder or named by it have SHA-256 {digest}; others that it reads are not known"
    return f"Made by `{command}`{source}: {count} replicates, {replicates.versions()}. {known}."


# --- a run -----------------------------------------------------------------------------------------------------------


def run_study(
    name: str | Path, quick: bool = False, workers: int = 1, resume: bool | None = None,
    redraw: bool = False, out: Path | None = None, progress: Progress = lambda _done, _every: None,
) -> tuple[Report, Path]:  # fmt: skip
    """Run a study; return its report and the folder with ``README.md``, ``metrics.json``, replicates and figures.

    Every replicate is a case, a table of plain values with the seed among them, so that results do not depend on who
    computes them. A finished replicate is written down at once. The ``name`` is a file ``mine.py``, a folder with
    ``study.py``, or a study of the checkout without its ending; ``quick`` is the small version; ``workers``,
    ``resume`` and ``progress`` are as `run_cases` has them. ``redraw`` computes nothing: the report is
    written anew from the replicates of the last run. Results go to ``out``, by default ``results/NAME`` or
    ``results/NAME-quick`` beside the study.
    """
    path = find_study(name)
    require_package("pyarrow", "the study")
    import pyarrow
    from pyarrow import parquet

    study = load_study(path)
    folder = out or path.parent / "results" / _label(path, quick)
    with refused(folder):
        folder.mkdir(parents=True, exist_ok=True)
    if redraw:
        path = folder / f"{REPLICATES}.parquet"
        if not path.exists():
            raise InputError("redraw", "no replicates", "a study that was run before", path)
        require_file(path, LARGEST_DATA)
        try:
            table = parquet.read_table(path)
            made = (table.schema.metadata or {}).get(b"made", b"").decode()
        except (OSError, ValueError) as error:
            raise InputError("redraw", str(error), "the replicates of a study", path) from None
        # without what a replicate does not have
        report = study.report([{key: v for key, v in row.items() if v is not None} for row in table.to_pylist()])
        write(folder, study.QUESTION, report, made, {})
        return report, folder
    if hasattr(study, "prepare"):
        study.prepare(quick)
    cases = study.cases(quick)
    files = files_of(path, study)
    made = made_by(path, quick, len(cases), files)  # of what is here now, whatever becomes of it meanwhile
    code = {**{f"file {file}": digest for file, digest in files.items()}, **replicates.package_code()}
    journal = folder / f"{REPLICATES}.sqlite"
    rows = run_cases(cases, lambda case: partial(_run, path, case), workers, progress, journal, code, resume)
    report = study.report(rows)
    columns = list(dict.fromkeys(key for row in rows for key in row))
    table = pyarrow.table({key: [row.get(key) for row in rows] for key in columns})
    stream = io.BytesIO()
    parquet.write_table(table.replace_schema_metadata({"made": made}), stream)
    write(folder, study.QUESTION, report, made, {f"{REPLICATES}.parquet": stream.getvalue()})
    replicates.remove_journal(journal)
    return report, folder


def _run(path: Path, case: Mapping[str, Any]) -> Row:
    return load_study(path).run(**case)


def write(folder: Path, question: str, report: Report, made: str, replicates: Mapping[str, bytes]) -> None:
    """Write ``README.md`` with the figures, ``metrics.json`` and the file of the replicates: all, or none."""
    pictures = [f"![{title}]({title}.svg)\n" for title in report.figures]
    text = "\n".join([f"# {question}", "", report.text.strip(), "", *pictures, made])
    files = {
        **replicates,
        "README.md": (text + "\n").encode(),
        "metrics.json": json_text(dict(report.metrics)).encode(),
    }
    if report.figures:
        from rpim_opt.study.figures import picture

        for (title, figure), kind in product(report.figures.items(), ("svg", "png")):
            files[f"{title}.{kind}"] = picture(figure, title, kind)
    with refused(folder):
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
