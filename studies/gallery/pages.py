"""The README and the pages of the gallery: the code in them, and the pictures that it makes.

``python3 dev.py pictures`` runs every snippet that saves a picture of its page, and replaces the committed one.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import tempfile
from dataclasses import dataclass
from pathlib import Path

GALLERY = Path(__file__).resolve().parent
PICTURES = GALLERY / "pictures"
README = GALLERY.parents[1] / "README.md"
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$(?:\n+^```text\n(.*?)^```$)?", flags=re.DOTALL | re.MULTILINE)
PICTURE = re.compile(r"!\[[^\]]*\]\((?:studies/gallery/)?pictures/([\w.]+)\)")


@dataclass(frozen=True)
class Snippet:
    """A block of a page: its language, its code, and what the page says that it prints."""

    language: str
    code: str
    printed: str

    @property
    def saved(self) -> list[str]:
        """Return the names of the pictures that it saves."""
        return re.findall(r'savefig\("([\w.]+)"', self.code)


def pages() -> list[Path]:
    """Return the files of all pages, the README first."""
    return [README, *sorted(GALLERY.glob("*.md"))]


def snippets(text: str) -> list[Snippet]:
    """Return the blocks of a page in their order."""
    return [Snippet(*found) for found in FENCE.findall(text)]


def programs(text: str) -> list[Snippet]:
    """Return a page's Python, each as it runs alone: a block that imports nothing goes on with the one before it."""
    found: list[Snippet] = []
    for each in snippets(text):
        if each.language != "python":
            continue
        if found and "import " not in each.code:
            before = found.pop()
            each = Snippet(each.language, f"{before.code}\n{each.code}", before.printed + each.printed)
        found.append(each)
    return found


def shown(text: str) -> list[str]:
    """Return the names of a page's own pictures."""
    return PICTURE.findall(text)


def main() -> None:
    """Make every picture by the code of its page."""
    os.environ["MPLBACKEND"] = "Agg"
    for page in pages():
        text = page.read_text(encoding="utf-8")
        for snippet in programs(text):
            wanted = set(snippet.saved) & set(shown(text))
            if wanted:
                _draw(snippet, wanted)
                print(f"{page.name}: {', '.join(sorted(wanted))}")


def _draw(snippet: Snippet, wanted: set[str]) -> None:
    """Run a snippet in a folder of its own, and take its pictures."""
    from matplotlib import pyplot

    here = Path.cwd()
    with tempfile.TemporaryDirectory() as scratch:
        os.chdir(scratch)
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                exec(compile(snippet.code, "snippet", "exec"), {})
            pyplot.close("all")  # a snippet that draws on the current figure gets one of its own
            for name in wanted:
                (PICTURES / name).write_bytes(Path(name).read_bytes())
        finally:
            os.chdir(here)


if __name__ == "__main__":
    main()
