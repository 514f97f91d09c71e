"""The README and the guides: the code in them, what it prints, and the pictures that it makes.

``python3 dev.py pages [PAGE...]`` runs every snippet and writes its output and its pictures into the page.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

GALLERY = Path(__file__).resolve().parent
PICTURES = GALLERY / "pictures"
README = GALLERY.parents[1] / "README.md"
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$(?:\n+^```text\n(.*?)^```$)?", flags=re.DOTALL | re.MULTILINE)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w])")
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


def programs(text: str) -> list[list[Snippet]]:
    """Return a page's Python: its blocks, in lists of those that share their names."""
    found: list[list[Snippet]] = []
    for each in snippets(text):
        if each.language == "python" and found and "import " not in each.code:
            found[-1].append(each)
        elif each.language == "python":
            found.append([each])
    return found


def shown(text: str) -> list[str]:
    """Return the names of a page's own pictures."""
    return PICTURE.findall(text)


def alike(printed: str, said: str) -> bool:
    """Return whether an output is what a page shows: all of it, numbers to 2 % or 1.5 units of their last digit."""
    words, numbers = zip(*(_parts(text) for text in (printed, said)), strict=True)
    if words[0] != words[1]:
        return False
    return all(_near(*pair) for pair in zip(*numbers, strict=True))


def _parts(text: str) -> tuple[str, list[str]]:
    """Return a text without its numbers and the widths of its columns, and its numbers."""
    words = re.sub(r"[─-]{3,}", "─", NUMBER.sub("0", text))
    return " ".join(words.split()), NUMBER.findall(text)


def _near(one: str, other: str) -> bool:
    unit = 10.0 ** -len(other.partition("e")[0].partition(".")[2])
    if "e" in other:
        unit = 0.0
    return abs(float(one) - float(other)) <= max(1.5 * unit, 0.02 * abs(float(other))) if one != other else True


@contextlib.contextmanager
def scratch() -> Iterator[None]:
    """Work in an empty folder with what a reader has: raw tables and a URDF."""
    from tests.test_commands import write_cell

    here = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            readers_files(Path(folder), write_cell)
            yield
        finally:
            os.chdir(here)


def readers_files(folder: Path, write_cell: Callable[[Path], object]) -> None:
    """Write what the pages' commands name: arm.urdf and measured.csv, later new.csv and checks.csv, export.csv."""
    write_cell(folder)
    header, *later = (folder / "later.csv").read_text().splitlines(keepends=True)
    (folder / "new.csv").write_text("".join([header, *later[:8]]))
    (folder / "checks.csv").write_text("".join([header, *later[8:32]]))
    shutil.copy(GALLERY / "data" / "export.csv", folder)


def commands(snippet: Snippet) -> list[list[str]]:
    """Return the arguments of every call of ``rpim-opt`` in a block of shell commands."""
    calls = []
    for line in snippet.code.splitlines():
        words = shlex.split(line.split("#")[0])
        if words[:3] == ["python3", "dev.py", "run"]:
            words = ["rpim-opt", *words[3:]]
        if words[:1] == ["rpim-opt"]:
            calls.append([word.removeprefix("problems/") for word in words[1:]])
    return calls


def main(*names: str) -> None:
    """Run every snippet of all pages, or of some, and write what it prints and draws into its page."""
    os.environ["MPLBACKEND"] = "Agg"
    for page in pages():
        if names and page.stem not in names:
            continue
        text = page.read_text(encoding="utf-8")
        new = text
        for program in programs(text):
            with scratch():
                for snippet, printed in zip(program, _printed(program), strict=True):
                    new = _with_output(new, snippet, printed)
                for name in {name for each in program for name in each.saved} & set(shown(text)):
                    (PICTURES / name).write_bytes(Path(name).read_bytes())
        with scratch():
            for snippet in snippets(text):
                if snippet.language == "sh":
                    printed = _answers(snippet)  # also where it is not shown: the next commands go on from there
                    new = _with_output(new, snippet, printed) if snippet.printed else new
        if new != text:
            page.write_text(new, encoding="utf-8")
            print(f"{page.name}: written anew")


def _printed(program: list[Snippet]) -> Iterator[str]:
    """Yield what each block of a program prints."""
    from matplotlib import pyplot

    space: dict[str, object] = {}
    for snippet in program:
        out = io.StringIO()
        with contextlib.redirect_stdout(out):
            exec(compile(snippet.code, "snippet", "exec"), space)
        yield out.getvalue()
    pyplot.close("all")  # a snippet that draws on the current figure gets one of its own


def _answers(snippet: Snippet) -> str:
    program = [sys.executable, "-c", "from rpim_opt.cli import main; main()"]
    calls = [
        subprocess.run([*program, *call], capture_output=True, text=True, check=True) for call in commands(snippet)
    ]
    return "".join(call.stdout for call in calls)


def _with_output(text: str, snippet: Snippet, printed: str) -> str:
    """Return a page in which a block is followed by what it prints; an output that is alike stays."""
    if alike(printed, snippet.printed):
        return text
    lines = "".join(f"{line.rstrip()}\n" for line in printed.splitlines())
    block = f"```{snippet.language}\n{snippet.code}```\n"
    old = f"{block}\n```text\n{snippet.printed}```\n" if snippet.printed else block
    return text.replace(old, f"{block}\n```text\n{lines}```\n" if lines else block, 1)


if __name__ == "__main__":
    sys.path.insert(0, str(README.parent))
    main(*sys.argv[1:])
