"""What figures follow from: digests of code and files, versions, and the commits that hold them."""

from __future__ import annotations

import platform
import subprocess
import sys
from collections.abc import Iterable
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path

from rpim_opt.basics.text import version_of
from rpim_opt.data.record import PACKAGES
from rpim_opt.store.problem_file import problems_folder

PACKAGE = Path(__file__).resolve().parents[1]
SHORT = 12
"""Digits of a digest that a reader compares by eye."""


def package_code() -> dict[str, str]:
    """Return digests of the package and of its problems, and the versions of what computes."""
    problems = problems_folder()
    return {
        "package": files_digest(PACKAGE, PACKAGE.rglob("*.py")),
        "set of problems": files_digest(problems, problems.glob("*/*.*")),
        "set of versions": versions(),
    }


def files_digest(folder: Path, files: Iterable[Path]) -> str:
    """Return the SHA-256 of files with their names in a folder."""
    content = sha256()
    for file in sorted(files):
        content.update(sha256(str(file.relative_to(folder)).encode()).digest())
        content.update(sha256(file.read_bytes()).digest())
    return content.hexdigest()


def versions() -> str:
    """Return the versions of what computes."""
    packages = ", ".join(f"{package} {version_of(package)}" for package in PACKAGES)
    return f"{platform.python_implementation()} {platform.python_version()}, {packages}"


def file_state(path: Path) -> str:
    """Say which version of a file this is: its digest, its commit, and whether that holds it as it is."""
    return f"{path.name} with SHA-256 {sha256(path.read_bytes()).hexdigest()[:SHORT]} ({commit(path.parent, path)})"


def package_state() -> str:
    """Say which version of the package computes: its number, its digest, and its commit where there is one."""
    said = f"rpim-opt {version_of('rpim-opt')}, SHA-256 {package_code()['package'][:SHORT]}"
    if PACKAGE.parent.joinpath("pyproject.toml").is_file():
        return f"{said} ({commit(PACKAGE.parent, PACKAGE, problems_folder())})"
    return f"{said} (installed)"


def commit(folder: Path, *paths: Path) -> str:
    """Say which commit some paths are of, and whether it lacks them (``untracked``) or has other ones (``dirty``).

    Results of studies count for nothing.
    """
    names = [*map(str, paths), ":(exclude,glob)**/results/**"]
    try:
        said = f"commit {_git(folder, 'describe', '--always')}"
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no", "--", *names)
        new = _git(folder, "ls-files", "--others", "--exclude-standard", "--", *names)
    except (OSError, subprocess.CalledProcessError):
        return "in no repository"
    if new:
        return f"{said}, untracked"
    return f"{said}, dirty" if changed else said


def _git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def provenance() -> dict[str, str]:
    """Return what makes a comparison, in words: script, package, versions and time."""
    return {
        "Script": _script(),
        "Package": package_state(),
        "Versions": versions(),
        "Made": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _script() -> str:
    """Say which file is run, if it is one."""
    file = getattr(sys.modules.get("__main__"), "__file__", None)
    if file is None or not Path(file).is_file():
        return "none: an interactive session"
    if Path(file).name in ("rpim-opt", "__main__.py"):
        return "rpim-opt " + " ".join(sys.argv[1:])
    return file_state(Path(file).resolve())
