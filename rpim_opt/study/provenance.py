"""What figures follow from: digests of code and files, versions, and the commits that hold them."""

from __future__ import annotations

import platform
import subprocess
import sys
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
    return {
        "package": _folder_digest(PACKAGE, "**/*.py"),
        "set of problems": _folder_digest(problems_folder(), "*/*.*"),
        "set of versions": versions(),
    }


def _folder_digest(folder: Path, pattern: str) -> str:
    content = sha256()
    for file in sorted(folder.glob(pattern)):
        content.update(sha256(str(file.relative_to(folder)).encode()).digest())
        content.update(sha256(file.read_bytes()).digest())
    return content.hexdigest()


def versions() -> str:
    """Return the versions of what computes."""
    packages = ", ".join(f"{package} {version_of(package)}" for package in PACKAGES)
    return f"{platform.python_implementation()} {platform.python_version()}, {packages}"


def file_state(path: Path) -> str:
    """Return a file's name with its digest and its commit."""
    return f"{path.name} with SHA-256 {sha256(path.read_bytes()).hexdigest()[:SHORT]} ({commit(path.parent, path)})"


def package_state() -> str:
    """Return the package's version, its digest, and its commit where there is one."""
    said = f"rpim-opt {version_of('rpim-opt')}, SHA-256 {package_code()['package'][:SHORT]}"
    if PACKAGE.parent.joinpath("pyproject.toml").is_file():
        return f"{said} ({commit(PACKAGE.parent, PACKAGE, problems_folder())})"
    return f"{said} (installed)"


def commit(folder: Path, *paths: Path) -> str:
    """Return the commit that paths are of, and whether it lacks them (``untracked``) or has others (``dirty``).

    Results of studies do not count.
    """

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    names = [*map(str, paths), ":(exclude,glob)**/results/**"]
    try:
        said = f"commit {git('describe', '--always')}"
        if git("ls-files", "--others", "--exclude-standard", "--", *names):
            return f"{said}, untracked"
        changed = git("status", "--porcelain", "--untracked-files=no", "--", *names)
        return f"{said}, dirty" if changed else said
    except (OSError, subprocess.CalledProcessError):
        return "in no repository"


def provenance() -> dict[str, str]:
    """Return script, package, versions and time of a comparison."""
    file = getattr(sys.modules.get("__main__"), "__file__", None)
    if file is None or not Path(file).is_file():
        script = "none: an interactive session"
    elif Path(file).name in ("rpim-opt", "__main__.py"):
        script = "rpim-opt " + " ".join(sys.argv[1:])
    else:
        script = file_state(Path(file).resolve())
    made = datetime.now(UTC).isoformat(timespec="seconds")
    return {"Script": script, "Package": package_state(), "Versions": versions(), "Made": made}
