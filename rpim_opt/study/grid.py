"""Studies by their names: files of one folder, each a question with its cases."""

from __future__ import annotations

import importlib.util
import sys
from functools import lru_cache
from pathlib import Path
from types import ModuleType

from rpim_opt.basics.exceptions import InputError, choices

NEEDED = ("QUESTION", "METRICS", "cases", "run", "report")
"""What a study has: a text, a `Metric` for each figure that is held, and three functions."""


def studies_folder() -> Path:
    """Return the folder ``studies`` of the checkout."""
    folder = Path(__file__).resolve().parents[2] / "studies"
    if not folder.is_dir():
        raise InputError("the studies", "no folder 'studies' beside the package", "a checkout of the repository")
    return folder


def find_study(name: str) -> Path:
    """Return the file of a study by its name."""
    known = {p.stem: p for p in sorted(studies_folder().glob("*.py"))}
    if name not in known:
        raise InputError("study", f"'{name}'", choices(name, known))
    return known[name]


@lru_cache(maxsize=8)
def load_study(path: Path, needed: tuple[str, ...] = NEEDED) -> ModuleType:
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
