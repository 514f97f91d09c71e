"""What people name in a file or on the command line: a problem, a formulation, a rule for the weight."""

from __future__ import annotations

from pathlib import Path

from rpim_opt.basics.exceptions import InputError, choices, pick
from rpim_opt.convex.formulation import FORMULATIONS, Formulation
from rpim_opt.convex.named import LEARNED
from rpim_opt.convex.select import SELECTORS, Selector
from rpim_opt.convex.selection import require_weight

PACKAGE = Path(__file__).resolve().parents[1]


def problems_folder() -> Path:
    """Return the folder of the problems that come with the package: inside it, or beside it in a checkout."""
    inside = PACKAGE / "problems"
    return inside if inside.is_dir() else PACKAGE.parent / "problems"


def find(name: str | Path) -> Path:
    """Return the folder of a problem, given its path or the name of one that comes with the package."""
    path = Path(name)
    if path.is_file() and path.name == "problem.toml":
        return path.parent
    if path.is_dir():
        return path
    known = sorted(p.name for p in problems_folder().iterdir() if (p / "problem.toml").is_file())
    if str(name) in known:
        return problems_folder() / str(name)
    accepted = "a folder with problem.toml, or " + choices(str(name), known)
    raise InputError("the problem", f"no folder '{name}'", accepted)


def named_formulation(text: str, file: Path | None = None) -> Formulation:
    """Return the ready formulation of that name."""
    return pick(FORMULATIONS, text, "key formulation", file)


def named_weight(text: str, file: Path | None = None) -> float | Selector | None:
    """Return the selector of that name, or the number that the text is; None for sizes that are learned."""
    if text == LEARNED:
        return None
    try:
        value = float(text)
    except ValueError:
        return pick(SELECTORS, text, "key selector", file, f"a number, {LEARNED}, ")
    return require_weight(value, "selector", file)
