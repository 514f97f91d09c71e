"""Every text of the package that a user may see: file, line, text, with the expressions of an f-string in braces.

``python3 dev.py strings`` prints the list, with the glossary at hand to be read from first to last.
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
        if PROSE.search(text):
            yield node.lineno, " ".join(text.split())


def _piece(part: ast.expr) -> str:
    if isinstance(part, ast.FormattedValue):
        return f"{{{ast.unparse(part.value)}}}"
    return str(part.value) if isinstance(part, ast.Constant) else ""


if __name__ == "__main__":
    for path in sorted((ROOT / "rpim_opt").rglob("*.py")):
        for line, text in sorted(set(texts(path.read_text(encoding="utf-8")))):
            print(f"{path.relative_to(ROOT)}:{line}: {text}")
