"""What a study keeps: replicates as they are finished, all of them in the end, and what made them."""

from __future__ import annotations

import json
import platform
import subprocess
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.record import PACKAGES
from rpim_opt.study.grid import studies_folder

Row = dict[str, Any]
"""A case with what was found."""


class Journal:
    """A file with one line a finished replicate, written at once: what was computed is not lost."""

    def __init__(self, path: Path, cases: Sequence[Mapping[str, Any]], resume: bool):
        self.path = path
        self.cases = [(json.dumps(case, sort_keys=True), case) for case in cases]
        self.done: dict[str, Row] = {}
        if resume and path.is_file():
            self.done = self._finished()
        elif not resume:
            path.unlink(missing_ok=True)

    def _finished(self) -> dict[str, Row]:
        """Return the replicates of an interrupted run; a line cut off by its end is left out."""
        known = {key for key, _ in self.cases}
        done: dict[str, Row] = {}
        for line in self.path.read_text(encoding="utf-8").splitlines():
            try:
                entry = json.loads(line)
            except json.JSONDecodeError:
                continue
            key = json.dumps(entry["case"], sort_keys=True)
            if key in known:
                done[key] = entry["found"]
        return done

    @property
    def waiting(self) -> list[tuple[str, Mapping[str, Any]]]:
        """The cases that are left to compute, with their keys."""
        return [(key, case) for key, case in self.cases if key not in self.done]

    @property
    def rows(self) -> list[Row]:
        """Every case with what was found, in the order of the cases."""
        return [{**case, **self.done[key]} for key, case in self.cases]

    def add(self, key: str, found: Row) -> None:
        """Write a replicate down."""
        self.done[key] = found
        with self.path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps({"case": json.loads(key), "found": found}) + "\n")

    def close(self) -> None:
        """Remove the file: everything is where it belongs."""
        self.path.unlink(missing_ok=True)


def keep(rows: Sequence[Row], made: str, path: Path) -> None:
    """Write the replicates, with what made them."""
    import pyarrow as pa
    from pyarrow import parquet

    columns = list(dict.fromkeys(key for row in rows for key in row))
    table = pa.table({key: [row.get(key) for row in rows] for key in columns})
    parquet.write_table(table.replace_schema_metadata({"made": made}), path)


def kept(path: Path) -> tuple[list[Row], str]:
    """Return the replicates of an earlier run, without what a replicate does not have, and what made them."""
    from pyarrow import parquet

    if not path.is_file():
        raise InputError("redraw", "no replicates", "a study that was run before", path)
    table = parquet.read_table(path)
    made = (table.schema.metadata or {}).get(b"made", b"").decode()
    return [{key: value for key, value in row.items() if value is not None} for row in table.to_pylist()], made


def made_by(name: str, quick: bool, count: int) -> str:
    """Say which command, commit and versions made the replicates."""
    command = f"rpim-opt study {name}"
    if quick:
        command += " --quick"
    packages = ", ".join(f"{package} {version(package)}" for package in PACKAGES)
    python = f"{platform.python_implementation()} {platform.python_version()}"
    return f"Made by `{command}` from commit {_commit()}: {count} replicates, {python}, {packages}."


def _commit() -> str:
    try:
        commit = _git("describe", "--always")
        # results of other studies are no change of this one
        changed = _git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!studies/results")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{commit}-dirty" if changed else commit


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(studies_folder().parent), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
