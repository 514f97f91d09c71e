"""Run studies: replicates in parallel, resumed where they were, with results that say what made them."""

from __future__ import annotations

import importlib.util
import json
import platform
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from types import ModuleType
from typing import Any

from rpim_opt.exceptions import InputError, RpimError, choices
from rpim_opt.files import write_json, write_text
from rpim_opt.record import PACKAGES


@dataclass(frozen=True)
class Metric:
    """A figure of a study that must not get worse: its direction, and by how much of the baseline it may vary."""

    better: str
    tolerance: float


@dataclass(frozen=True)
class Report:
    """What a study found: Markdown, metrics by name, matplotlib figures by name."""

    text: str
    metrics: Mapping[str, float] = field(default_factory=dict)
    figures: Mapping[str, Any] = field(default_factory=dict)


def studies_folder() -> Path:
    """Return the folder ``studies`` of the checkout."""
    folder = Path(__file__).resolve().parent.parent / "studies"
    if not folder.is_dir():
        raise InputError("the studies", "no folder 'studies' beside the package", "a checkout of the repository")
    return folder


@lru_cache(maxsize=8)
def load_study(path: Path, needed: tuple[str, ...] = ("QUESTION", "METRICS", "cases", "run", "report")) -> ModuleType:
    """Return a study: a Python file with QUESTION, METRICS, cases(quick), run(**case), report(rows).

    If it has prepare(quick), that is called once before the first case.
    """
    spec = importlib.util.spec_from_file_location(f"study_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise InputError("the study", str(path), "a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    missing = [name for name in needed if not hasattr(module, name)]
    if missing:
        raise InputError("the study", f"no '{missing[0]}'", ", ".join(needed), path)
    return module


def find_study(name: str) -> Path:
    """Return the file of a study by its name."""
    known = {p.stem: p for p in sorted(studies_folder().glob("*.py"))}
    if name not in known:
        raise InputError("study", f"'{name}'", choices(name, known))
    return known[name]


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
    folder.mkdir(parents=True, exist_ok=True)
    replicates = folder / "replicates.parquet"
    if redraw:
        rows, made = _kept(replicates)
        report = study.report(rows)
        _write(folder, study, report, made)
        return report, folder
    journal = folder / "replicates.jsonl"
    if hasattr(study, "prepare"):
        study.prepare(quick)
    cases = study.cases(quick)
    keys = [json.dumps(case, sort_keys=True) for case in cases]
    done = _finished(journal, set(keys)) if resume else {}
    if not resume:
        journal.unlink(missing_ok=True)
    waiting = [(key, case) for key, case in zip(keys, cases, strict=True) if key not in done]
    progress(len(done), len(cases))
    with journal.open("a", encoding="utf-8") as stream:
        for key, found in _computed(path, waiting, workers, scheduler):
            done[key] = found
            stream.write(json.dumps({"case": json.loads(key), "found": found}) + "\n")
            stream.flush()
            progress(len(done), len(cases))
    rows = [{**case, **done[key]} for key, case in zip(keys, cases, strict=True)]
    report = study.report(rows)
    command = f"rpim-opt study {name}{' --quick' if quick else ''}"
    packages = ", ".join(f"{p} {version(p)}" for p in PACKAGES)
    python = f"{platform.python_implementation()} {platform.python_version()}"
    made = f"Made by `{command}` from commit {_commit()}: {len(rows)} replicates, {python}, {packages}."
    _keep(rows, made, replicates)
    _write(folder, study, report, made)
    journal.unlink()
    return report, folder


def _one(path: Path, key: str, case: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    return key, load_study(path).run(**case)


def _computed(
    path: Path, waiting: Sequence[tuple[str, Mapping[str, Any]]], workers: int, scheduler: str | None
) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield results as they are finished."""
    if scheduler is not None:
        try:
            from distributed import Client, as_completed
        except ImportError:
            raise InputError("scheduler", "no package distributed", "pip install 'rpim-opt[studies]'") from None
        try:
            client = Client(scheduler, timeout="10s")
        except OSError as error:
            raise RpimError(f"Dask scheduler {scheduler}: cannot be reached: {error}.") from None
        with client:
            futures = [client.submit(_one, path, key, case, pure=False) for key, case in waiting]
            for future in as_completed(futures):
                yield future.result()
        return
    if workers == 1:
        for key, case in waiting:
            yield _one(path, key, case)
        return
    try:
        from joblib import Parallel, delayed
    except ImportError:
        raise InputError("workers", "no package joblib", "pip install 'rpim-opt[studies]'") from None
    tasks = (delayed(_one)(path, key, case) for key, case in waiting)
    finished: Any = Parallel(n_jobs=workers, return_as="generator_unordered")(tasks)
    yield from finished


def _finished(journal: Path, keys: set[str]) -> dict[str, dict[str, Any]]:
    """Return the replicates of an interrupted run; a line cut off by its end is left out."""
    done: dict[str, dict[str, Any]] = {}
    for line in journal.read_text(encoding="utf-8").splitlines() if journal.is_file() else ():
        try:
            entry = json.loads(line)
        except json.JSONDecodeError:
            continue
        key = json.dumps(entry["case"], sort_keys=True)
        if key in keys:
            done[key] = entry["found"]
    return done


def _keep(rows: list[dict], made: str, path: Path) -> None:
    """Write the replicates, with what made them."""
    import pyarrow as pa
    from pyarrow import parquet

    columns = list(dict.fromkeys(key for row in rows for key in row))
    table = pa.table({key: [row.get(key) for row in rows] for key in columns})
    parquet.write_table(table.replace_schema_metadata({"made": made}), path)


def _kept(path: Path) -> tuple[list[dict], str]:
    """Return the replicates of an earlier run, without what a replicate does not have, and what made them."""
    from pyarrow import parquet

    if not path.is_file():
        raise InputError("redraw", "no replicates", "a study that was run before", path)
    table = parquet.read_table(path)
    made = (table.schema.metadata or {}).get(b"made", b"").decode()
    return [{key: value for key, value in row.items() if value is not None} for row in table.to_pylist()], made


def _write(folder: Path, study: ModuleType, report: Report, made: str) -> None:
    pictures = []
    for title, figure in report.figures.items():
        from matplotlib import rc_context

        with rc_context({"svg.hashsalt": title}):  # the same file for the same figure
            figure.savefig(folder / f"{title}.svg", metadata={"Date": None})
        figure.savefig(folder / f"{title}.png")
        pictures.append(f"![{title}]({title}.svg)\n")
    text = "\n".join([f"# {study.QUESTION}", "", report.text.strip(), "", *pictures, made])
    write_text(folder / "README.md", text + "\n")
    write_json(folder / "metrics.json", dict(report.metrics))


def distributions(values: Mapping[str, Sequence[float]], label: str) -> Any:
    """Return a figure with one line of dots a name, logarithmic, its median marked; names from top to bottom."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    figure = Figure(figsize=(7, 0.32 * len(values) + 0.9), layout="constrained")
    ax = figure.add_subplot()
    for y, (name, found) in enumerate(reversed(list(values.items()))):
        dots = ax.semilogx(found, [y] * len(found), "o", ms=3, alpha=min(1.0, 5 / len(found) ** 0.5), color="C0", mew=0)
        dots[0].set_rasterized(len(found) > 50)  # thousands of dots would make megabytes of SVG
        middle = sorted(found)[len(found) // 2]
        ax.semilogx([middle], [y], "|", ms=11, mew=2, color="C3")
        ax.annotate(f"{middle:.3g}", (1.01, y), xycoords=("axes fraction", "data"), va="center", fontsize=8)
        ax.annotate(name, (-0.01, y), xycoords=("axes fraction", "data"), ha="right", va="center", fontsize=8)
    ax.set_yticks([])
    ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    ax.xaxis.set_major_formatter(ScalarFormatter())
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.grid(axis="x", alpha=0.3)
    ax.set_xlabel(label)
    return figure


def _commit() -> str:
    git = ["git", "-C", str(studies_folder().parent)]
    changes = ["status", "--porcelain", "--untracked-files=no", "--", ".", ":!studies/results"]
    try:
        commit, changed = (
            subprocess.run([*git, *what], capture_output=True, text=True, check=True).stdout.strip()
            for what in (["describe", "--always"], changes)
        )
        return f"{commit}-dirty" if changed else commit  # results of other studies are no change of this one
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def regressions(name: str, quick: bool, metrics: Mapping[str, float]) -> list[str]:
    """Return a sentence for every metric that is worse than the committed baseline allows."""
    path = studies_folder() / "baselines.json"
    known = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    label = f"{name}-quick" if quick else name
    if label not in known:
        raise InputError("baseline", f"none for '{label}'", choices(label, known), path)
    study, worse = load_study(find_study(name)), []
    for metric, baseline in known[label].items():
        rule, value = study.METRICS[metric], metrics.get(metric)
        sign = 1 if rule.better == "lower" else -1
        if value is None or not sign * (value - baseline) <= rule.tolerance * abs(baseline):
            bound = f"{rule.better} is better, tolerance {rule.tolerance:.0%}"
            worse.append(f"{metric}: found {value}, baseline {baseline}, {bound}")
    return worse
