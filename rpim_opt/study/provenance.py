"""What made a study's replicates: the command, the commit, the code itself and the versions."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Iterable
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path

from rpim_opt.data.record import PACKAGES
from rpim_opt.store.named import problems_folder
from rpim_opt.study.grid import find_study, studies_folder

PACKAGE = Path(__file__).resolve().parents[1]
CODE = ("rpim_opt", "studies", "problems")
"""Folders whose files no commit may lack: an untracked study is not the commit's."""


def code_of(name: str) -> dict[str, str]:
    """Return what a study's replicates follow from: digests of its files and of the package, and the versions."""
    studies = find_study(name).parent  # a study may load another one
    problems = problems_folder()
    return {
        "set of studies": _digest(studies, [*studies.glob("*.py"), *studies.glob("*/*.py")]),
        "package": _digest(PACKAGE, PACKAGE.rglob("*.py")),
        "set of problems": _digest(problems, problems.glob("*/*.*")),
        "set of versions": versions(),
    }


def _digest(folder: Path, files: Iterable[Path]) -> str:
    content = sha256()
    for file in sorted(files):
        content.update(sha256(str(file.relative_to(folder)).encode()).digest())
        content.update(sha256(file.read_bytes()).digest())
    return content.hexdigest()


def versions() -> str:
    """Return the versions of what computes."""
    packages = ", ".join(f"{package} {version(package)}" for package in PACKAGES)
    return f"{platform.python_implementation()} {platform.python_version()}, {packages}"


def made_by(name: str, quick: bool, count: int) -> str:
    """Say which command, commit and versions make the replicates."""
    command = f"rpim-opt study {name}"
    if quick:
        command += " --quick"
    return f"Made by `{command}` from commit {_commit()}: {count} replicates, {versions()}."


def _commit() -> str:
    try:
        commit = _git("describe", "--always")
        # results of other studies are no change of this one
        changed = _git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!studies/results")
        new = _git("ls-files", "--others", "--exclude-standard", "--", *CODE, ":!studies/results")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{commit}-dirty" if changed or new else commit


def _git(*arguments: str) -> str:
    command = ["git", "-C", str(studies_folder().parent), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
