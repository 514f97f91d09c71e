"""The pages as notebooks: executed by Jupyter, and shown as HTML.

``python3 dev.py notebooks [FOLDER]`` makes the environment that `notebooks.txt` locks, and runs this file in it. The
Markdown pages are the only source: Python blocks become cells, and what a page says of their output has to stand in
what Jupyter answers.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbconvert import HTMLExporter
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook
from pages import FENCE, PICTURE, Snippet, alike, pages

LINK = re.compile(r"(\]\()([^)\s:#]*)(#[\w-]+)?(\))")
STYLE = """\
<style>
.jp-RenderedMarkdown .highlight { background: var(--jp-cell-editor-background); padding: 0.5em; margin: 0.5em 0 1em }
.jp-RenderedMarkdown .highlight pre { background: none }
.jp-OutputArea-output pre { word-break: normal; overflow-wrap: anywhere; font-size: 85% }
</style>
</head>"""
"""Room about shell commands, and printed tables that fit."""
BROKEN = "the notebook answers otherwise than its page"


def notebook(page: Path, folder: Path) -> nbformat.NotebookNode:
    """Return a page as a notebook that will lie in a folder."""
    text = page.read_text(encoding="utf-8")
    made = {name for found in FENCE.findall(text) for name in Snippet(*found).saved}
    cells = []
    for part, snippet in _parts(text):
        if snippet:
            cells.append(new_code_cell(snippet.code.rstrip(), metadata={"printed": snippet.printed}))
            continue
        prose = PICTURE.sub(lambda picture: "" if picture[1] in made else picture[0], part).strip()
        if prose:
            cells.append(new_markdown_cell(_moved(prose, page, folder)))
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    return new_notebook(cells=cells, metadata={"kernelspec": kernel, "title": _title(text)})


def _parts(text: str) -> Iterator[tuple[str, Snippet | None]]:
    """Yield running text and Python blocks in turn; blocks of other languages are text."""
    start = 0
    for found in FENCE.finditer(text):
        if found[1] == "python":
            yield text[start : found.start()], None
            yield "", Snippet(found[1], found[2], found[3] or "")
            start = found.end()
    yield text[start:], None


def _title(text: str) -> str:
    return text.partition("\n")[0].lstrip("# ")


def _moved(text: str, page: Path, folder: Path) -> str:
    """Return text whose links hold from the folder: to other notebooks, or back to where the page lies."""
    places = {each.resolve(): each.stem for each in pages()}

    def moved(link: re.Match[str]) -> str:
        before, name, anchor, after = link.groups()
        target = (page.parent / name).resolve() if name else page
        heading = _heading(target, anchor)
        if not name:
            return f"{before}{heading}{after}"
        if target in places:
            return f"{before}{places[target]}.ipynb{heading}{after}"
        return f"{before}{os.path.relpath(target, folder)}{heading}{after}"

    return LINK.sub(moved, text)


def _heading(page: Path, anchor: str | None) -> str:
    """Return how Jupyter calls a heading that GitHub calls by an anchor."""
    if not anchor or page.suffix != ".md":
        return anchor or ""
    for heading in re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE):
        if "#" + re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") == anchor:
            return "#" + heading.replace(" ", "-")
    return anchor


def execute(book: nbformat.NotebookNode) -> list[str]:
    """Run a notebook in a folder of its own, and return the outputs that differ from its page."""
    with tempfile.TemporaryDirectory() as scratch:
        NotebookClient(book, timeout=300, resources={"metadata": {"path": scratch}}).execute()
    missing = []
    for cell in book.cells:
        if cell.cell_type == "code":
            said = "".join(output.get("text", "") for output in cell.outputs)
            wanted = cell.metadata.pop("printed")
            missing += [] if alike(said, wanted) else [said]
    return missing


def export(book: nbformat.NotebookNode, target: Path) -> None:
    """Write a notebook as HTML with its figures inside; links to notebooks lead to their pages."""
    exporter = HTMLExporter(embed_images=True)
    body, _ = exporter.from_notebook_node(book, {"metadata": {"path": str(target.parent), "name": book.metadata.title}})
    linked = re.sub(r'href="(\w+)\.ipynb(#[^"]*)?"', r'href="\1.html\2"', body)
    target.write_text(linked.replace("</head>", STYLE, 1), encoding="utf-8")


def main(folder: Path, names: Sequence[str]) -> int:
    """Write pages, by default all, as notebooks and as HTML; return how many answer otherwise than they say."""
    folder.mkdir(parents=True, exist_ok=True)
    folder = folder.resolve()
    wrong = 0
    for page in pages():
        if names and page.stem not in names:
            continue
        book = notebook(page, folder)
        missing = execute(book)
        nbformat.write(book, folder / f"{page.stem}.ipynb")
        export(book, folder / f"{page.stem}.html")
        print(f"{folder / page.stem}.html", flush=True)
        for line in missing:
            print(f"{page.name}: {BROKEN}: {line}", file=sys.stderr)
        wrong += bool(missing)
    return wrong


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
