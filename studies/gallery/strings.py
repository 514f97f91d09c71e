"""Every text of the package that a user may see: file, line, text, with the expressions of an f-string in braces.

These are strings, and the first lines of docstrings of modules and of what is public, with its name: the help of
commands and the reference show them. ``python3 dev.py strings`` prints the list, with the glossary at hand to be read
from first to last.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PROSE = re.compile(r"[A-Za-z]{2,}[ ,:;][ ]*[\w'{]")
"""Two words: keys, names of columns and formats have one."""


def texts(source: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of every string of a module that is neither a docstring nor a single word."""
    tree = ast.parse(source)
    skipped = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            skipped |= {id(part) for part in node.values}
    for node in ast.walk(tree):
        if not isinstance(node, ast.expr):
            continue
        text = ""
        if isinstance(node, ast.JoinedStr):
            parts = [_piece(part) for part in node.values]
            text = "".join(parts)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in skipped:
            text = node.value
        if PROSE.search(text) and "->" not in text:  # an einsum
            yield node.lineno, " ".join(text.split())


def first_lines(source: str) -> Iterator[tuple[int, str]]:
    """Yield line, name and first line of the docstring of a module and of its public functions and classes."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            name = getattr(node, "name", "")
            first = (ast.get_docstring(node) or "").partition("\n")[0]
            if first and not name.startswith("_"):
                yield getattr(node, "lineno", 1), f"{name}: {first}".removeprefix(": ")


def _piece(part: ast.expr) -> str:
    if isinstance(part, ast.FormattedValue):
        return f"{{{ast.unparse(part.value)}}}"
    return str(part.value) if isinstance(part, ast.Constant) else ""


if __name__ == "__main__":
    for path in sorted((ROOT / "rpim_opt").rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        for line, text in sorted({*texts(source), *first_lines(source)}):
            print(f"{path.relative_to(ROOT)}:{line}: {text}")
