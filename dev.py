"""Set up and run, on a machine with only Python: ``python3 dev.py run ...``, ``test``, ``check``, ``docs`` and so on.

Every command first makes ``.venv``, if it is not there yet: ``run`` with the tested versions of ``requirements.txt``,
which are what a calibration needs, the others with those of ``constraints.txt``, with all tools besides. That
file has the hashes of all that may be downloaded, and is made by ``uv pip compile --universal --python-version 3.11
--generate-hashes --no-header --no-annotate --all-extras pyproject.toml -o constraints.txt``. ``requirements.txt``, for
an installation without tools, is the same without ``--all-extras`` and with ``-c constraints.txt``; so is
``studies/gallery/notebooks.txt``, with ``--group notebooks --extra studies --extra tables``: Jupyter has an environment
of its own.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
import tomllib
import venv
from collections.abc import Callable
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parent
ENVIRONMENT = Path(os.environ.get("RPIM_OPT_VENV", ROOT / ".venv"))
PROGRAMS = "Scripts" if os.name == "nt" else "bin"
BIN = ENVIRONMENT / PROGRAMS
GALLERY = ROOT / "studies" / "gallery"
JUPYTER = ROOT / "studies" / ".environments" / "notebooks"
MEASURED = ROOT / "measured"
KERNELS = ("Nehalem", "Sandybridge", "Haswell", "SkylakeX")
"""Of OpenBLAS, which every x86 processor of today has; Zen is Haswell in what NumPy and SciPy bring."""
CHECKS = {
    "format": ["ruff", "format", "--check", "."],
    "lint": ["ruff", "check", "."],
    "types": ["basedpyright", "--level", "error", "--pythonpath", str(BIN / "python")],
}


def environment(tools: bool = True, folder: Path = ENVIRONMENT, locked: Path = ROOT / "constraints.txt") -> None:
    """Make an environment, or bring it up to date: with what a calibration needs, or with all tools besides."""
    project = (ROOT / "pyproject.toml").read_bytes()
    plain = ROOT / "requirements.txt"
    states = {lock: hashlib.sha256(project + lock.read_bytes()).hexdigest() for lock in (plain, locked)}
    stamp = folder / "requirements.sha256"
    found = stamp.read_text() if stamp.is_file() else ""
    if found == states[locked] or (not tools and found == states[plain]):
        return
    print(f"Setting up {folder.name} (once, about a minute) ...", file=sys.stderr, flush=True)
    if found != states[plain]:
        venv.create(folder, with_pip=True, clear=folder.exists())
    wanted = locked if tools else plain
    pip = [folder / PROGRAMS / "python", "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    # what is downloaded must have the hashes that were tested; the build backend comes from there, too
    subprocess.run([*pip, "--require-hashes", "-r", wanted], check=True)
    if tools:
        subprocess.run([*pip, "--no-deps", "--no-build-isolation", "-e", ROOT], check=True)
    stamp.write_text(states[wanted])


def command_line(*arguments: str) -> int:
    """Run rpim-opt from this checkout, which needs no build, in the caller's folder."""
    program = "from rpim_opt.__main__ import main; main()"
    code = f"import sys; sys.path.insert(0, {str(ROOT)!r}); sys.argv[0] = 'rpim-opt'; {program}"
    return run("python", "-c", code, *arguments)


def run(*command: str | Path) -> int:
    """Run a program of the environment in the caller's folder."""
    return subprocess.run([BIN / command[0], *command[1:]], check=False).returncode


def docs(folder: str = "docs") -> int:
    """Build the documentation site: static pages that need no server and no network; a warning is a failure."""
    target = Path(folder).resolve()
    failed = run("sphinx-build", "-q", "-W", "--keep-going", "-c", GALLERY, "-d", target / ".trees", ROOT, target)
    start = f'<meta http-equiv="refresh" content="0; url={GALLERY.relative_to(ROOT).as_posix()}/index.html">'
    (target / "index.html").write_text(start, encoding="utf-8")
    return failed


def notebooks(folder: str = "notebooks", *pages: str) -> int:
    """Write README and gallery, or some pages, as notebooks that Jupyter has executed, and as HTML."""
    environment(folder=JUPYTER, locked=GALLERY / "notebooks.txt")
    command = [JUPYTER / PROGRAMS / "python", GALLERY / "notebooks.py", Path(folder).resolve(), *pages]
    return subprocess.run(command, check=False).returncode


def coverage(folder: str | Path = MEASURED) -> int:
    """Run the default suite once, and say which lines and branches it runs; ``mutants`` goes on from there."""
    folder = Path(folder).resolve()
    folder.mkdir(parents=True, exist_ok=True)
    os.environ["COVERAGE_FILE"] = str(folder / "coverage")
    os.environ["MUTANTS_TESTS"] = str(folder / "tests.json")
    failed = run("coverage", "run", "-m", "pytest", "-n", "auto", "-p", "tests.mutants")
    run("coverage", "combine", "--quiet")
    run("coverage", "report", "--skip-covered", "--show-missing", "--precision=1")
    return failed


def versions(*pythons: str) -> int:
    """Run the README's first two commands with other Pythons, in fresh environments and with every kernel.

    A digest of what is printed stands for each, so that machines can be compared; more than one is a failure.
    """
    said = {}
    for python in pythons:
        with tempfile.TemporaryDirectory() as scratch:
            programs = Path(scratch, "environment", PROGRAMS)
            subprocess.run([python, "-m", "venv", programs.parent], check=True)
            install = [programs / "python", "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
            subprocess.run([*install, f"{ROOT}[tables]"], check=True)
            version = subprocess.check_output([programs / "python", "--version"], text=True).strip()
            for kernel in KERNELS:
                said[version, kernel] = _readme(programs / "rpim-opt", Path(scratch, kernel))
                print(version, kernel, said[version, kernel], flush=True)
    return max(len(set(said.values())) - 1, 0)


def minima(python: str, *tests: str) -> int:
    """Run tests with the lowest version of every dependency that ``pyproject.toml`` allows, in a fresh environment."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = [
        *project["dependencies"],
        *(each for name in ("tables", "studies") for each in extras[name]),
    ]
    wanted += [each for each in extras["dev"] if each.startswith(("hypothesis", "polars", "pytest"))]
    lowest = sorted({each.replace(">=", "==") for each in wanted})
    with tempfile.TemporaryDirectory() as scratch:
        program = Path(scratch, PROGRAMS, "python")
        subprocess.run([python, "-m", "venv", scratch], check=True)
        subprocess.run([program, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", *lowest], check=True)
        # old packages use what newer ones of their own dependencies deprecate
        ignored = ["-W", "ignore::DeprecationWarning"]
        # tests start commands in other folders, which find the package by the path
        places = {**os.environ, "PYTHONPATH": str(ROOT)}
        return subprocess.run([program, "-m", "pytest", *ignored, *tests], cwd=ROOT, env=places, check=False).returncode


def _readme(program: Path, folder: Path) -> str:
    """Return a digest of what two commands print in an empty folder with an empty cache."""
    folder.mkdir()
    places = {"HOME": str(folder), "XDG_CACHE_HOME": str(folder / "cache"), "OPENBLAS_CORETYPE": folder.name}
    printed = hashlib.sha256()
    for command in (["calibrate", "position", "--out", "results"], ["report", "results"]):
        printed.update(subprocess.check_output([program, *command], cwd=folder, env={**os.environ, **places}))
    return printed.hexdigest()[:16]


def test(*arguments: str) -> int:
    """Run the tests on all cores."""
    return run("pytest", "-n", "auto", *arguments)


def check() -> int:
    """Run the checks, all of them."""
    failed = [name for name, command in CHECKS.items() if run(*command)]
    print(f"checks failed: {', '.join(failed)}" if failed else "all checks passed")
    return len(failed)


USAGE = """usage: python3 dev.py run RPIM-OPT-ARGUMENTS... | test [PYTEST-ARGUMENTS...] | check
       | docs [FOLDER] | notebooks [FOLDER [PAGE...]] | pages [PAGE...] | strings
       | coverage [FOLDER] | mutants [COUNT] [FOLDER] | versions PYTHON... | minima PYTHON [PYTEST-ARGUMENTS...]"""
OWN_ENVIRONMENT: dict[str, Callable[..., int]] = {"notebooks": notebooks, "versions": versions, "minima": minima}
IN_THE_CHECKOUT: dict[str, Callable[..., int]] = {
    "test": test,
    "check": check,
    "docs": docs,
    "pages": partial(run, "python", GALLERY / "pages.py"),
    "strings": partial(run, "python", GALLERY / "strings.py"),
    "coverage": coverage,
    "mutants": partial(run, "python", "-m", "tests.mutants"),
}


def main(arguments: list[str]) -> int:
    """Carry out one command line."""
    what, *rest = arguments or ["help"]
    if what in OWN_ENVIRONMENT:
        return OWN_ENVIRONMENT[what](*rest)
    if what == "run":
        environment(tools=False)
        return command_line(*rest)
    if what not in IN_THE_CHECKOUT:
        print(USAGE)
        return 2
    environment()
    os.chdir(ROOT)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # pytest has a process a core already
    return IN_THE_CHECKOUT[what](*rest)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
