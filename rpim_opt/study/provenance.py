"""What made replicates: the command, the code of the study and of the package, its commits, and the versions."""

from __future__ import annotations

import platform
import subprocess
import sys
from collections.abc import Iterable
from datetime import UTC, datetime
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path

from rpim_opt.data.record import PACKAGES
from rpim_opt.store.problem_file import problems_folder
from rpim_opt.study.grid import files_of, name_of, of_checkout, studies_folder

PACKAGE = Path(__file__).resolve().parents[1]
CODE = ("rpim_opt", "studies", "problems")
"""Folders whose files no commit may lack: an untracked study is not the commit's."""
SHORT = 12
"""Digits of a digest that a reader compares by eye."""


def code_of(path: Path) -> dict[str, str]:
    """Return what a study's replicates follow from: digests of its files and of the package, and the versions."""
    return {"set of studies": _digest(path.parent, files_of(path)), **package_code()}


def package_code() -> dict[str, str]:
    """Return digests of the package and of its problems, and the versions of what computes."""
    problems = problems_folder()
    return {
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


def made_by(path: Path, quick: bool, count: int) -> str:
    """Say which command, commit and versions make the replicates."""
    name = name_of(path)
    if not of_checkout(path):
        name = path.name
    command = f"rpim-opt study {name}"
    if quick:
        command += " --quick"
    if of_checkout(path):
        return f"Made by `{command}` from commit {_commit()}: {count} replicates, {versions()}."
    return f"Made by `{command}`, {state_of(path)}, with {package_state()}: {count} replicates, {versions()}."


def state_of(path: Path) -> str:
    """Say which version of a file this is: its digest, its commit, and whether that holds it as it is."""
    return f"{path.name} with SHA-256 {sha256(path.read_bytes()).hexdigest()[:SHORT]} ({_tracked(path.parent, path)})"


def package_state() -> str:
    """Say which version of the package computes: its number, its digest, and its commit where there is one."""
    said = f"rpim-opt {version('rpim-opt')}, SHA-256 {package_code()['package'][:SHORT]}"
    if PACKAGE.parent.joinpath("pyproject.toml").is_file():
        return f"{said} ({_tracked(PACKAGE.parent, PACKAGE, problems_folder())})"
    return f"{said} (installed)"


def _tracked(folder: Path, *paths: Path) -> str:
    """Say which commit some paths are of, and whether it lacks them or has other ones."""
    names = [str(path) for path in paths]
    try:
        commit = _git(folder, "describe", "--always")
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no", "--", *names)
        new = _git(folder, "ls-files", "--others", "--", *names)
    except (OSError, subprocess.CalledProcessError):
        return "in no repository"
    new = "\n".join(line for line in new.splitlines() if not line.endswith((".pyc", ".nbi", ".nbc")))
    if new:
        return f"commit {commit}, untracked"
    if changed:
        return f"commit {commit}, dirty"
    return f"commit {commit}"


def _commit() -> str:
    folder = studies_folder().parent
    try:
        commit = _git(folder, "describe", "--always")
        # results of other studies are no change of this one
        changed = _git(folder, "status", "--porcelain", "--untracked-files=no", "--", ".", ":!studies/results")
        new = _git(folder, "ls-files", "--others", "--exclude-standard", "--", *CODE, ":!studies/results")
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{commit}-dirty" if changed or new else commit


def _git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def provenance() -> dict[str, str]:
    """Return what makes a comparison: script, package, versions and time, each said in words."""
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
    return state_of(Path(file).resolve())
