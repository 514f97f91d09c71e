"""Studies wherever they are: a file, a folder, or a name among those of the checkout; each a question with cases."""

from __future__ import annotations

import ast
import importlib.util
import os
import sys
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from types import ModuleType

from rpim_opt.basics.exceptions import InputError, choices

NEEDED = ("QUESTION", "METRICS", "cases", "run", "report")
"""What a study has: a text, a `Metric` for each figure that is held, and three functions."""
FILE = "study.py"
"""The study of a folder."""


def studies_folder() -> Path:
    """Return the folder ``studies`` of the checkout."""
    folder = Path(__file__).resolve().parents[2] / "studies"
    if not folder.is_dir():
        raise InputError("the studies", "no folder 'studies' beside the package", "a checkout of the repository")
    return folder


def find_study(name: str | Path) -> Path:
    """Return the file of a study: of a path, of a folder with ``study.py``, or of a name.

    A name is looked for among the studies of the checkout, and then in the current folder.
    """
    text = str(name)
    if text.endswith(".py") or os.sep in text or "/" in text or text in (".", ".."):
        return _of_path(Path(text))
    known = _known()
    if text in known:
        return known[text]
    for place in (Path(f"{text}.py"), Path(text, FILE), Path("studies", f"{text}.py"), Path("studies", text, FILE)):
        if place.is_file():
            return place.resolve()
    accepted = f"a file {text}.py, or a folder with {FILE}"
    if known:
        accepted += f", or a study of the checkout: {choices(text, known)}"
    raise InputError("study", f"'{text}'", accepted)


def _known() -> dict[str, Path]:
    """Return the studies of the checkout by their names; an installed package has none."""
    try:
        folder = studies_folder()
    except InputError:
        return {}
    return {path.stem: path for path in sorted(folder.glob("*.py"))}


def _of_path(path: Path) -> Path:
    if path.is_dir():
        path = path / FILE
    if not path.is_file():
        raise InputError("study", f"no file '{path}'", f"a Python file with a study, or a folder with {FILE}")
    return path.resolve()


def name_of(path: Path) -> str:
    """Return what a study is called: its file, or its folder where that holds ``study.py``."""
    if path.name == FILE:
        return path.parent.name
    return path.stem


def of_checkout(path: Path) -> bool:
    """Whether a study is one of the package's own."""
    try:
        return path.parent == studies_folder()
    except InputError:
        return False


def files_of(path: Path) -> list[Path]:
    """Return the Python files that a study's replicates follow from, beside the package.

    Those of the whole folder for the package's own studies, which load each other, and for ``FOLDER/study.py``; else
    the file and what it imports from its folder.
    """
    folder = path.parent
    if of_checkout(path):
        return [*folder.glob("*.py"), *folder.glob("*/*.py")]
    if path.name == FILE:
        return list(folder.rglob("*.py"))
    found: dict[Path, None] = {}
    waiting = [path]
    while waiting:
        file = waiting.pop()
        if file not in found:
            found[file] = None
            waiting += _imported(file, folder)
    return list(found)


def _imported(file: Path, folder: Path) -> Iterator[Path]:
    """Yield the files of a folder that a file imports, also inside functions."""
    try:
        tree = ast.parse(file.read_bytes(), str(file))
    except (SyntaxError, ValueError):  # whoever imports it hears of that
        return
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)]
        for name in names:
            place = folder.joinpath(*name.split("."))
            yield from (each for each in (place.with_suffix(".py"), place / "__init__.py") if each.is_file())


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
    missing = [name for name in needed if not hasattr(module, name)]
    if missing:
        raise InputError("the study", f"no '{missing[0]}'", ", ".join(needed), path)
    return module
