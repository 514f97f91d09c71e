"""Every snippet of the README runs, and prints what the README says it prints."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
from pathlib import Path

import pytest

from tests.test_cli import run
from tests.test_commands import write_cell

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```(\w+)\n(.*?)```(?:\n+```text\n(.*?)```)?", README, flags=re.DOTALL)
PYTHON = [(code, printed) for language, code, printed in BLOCKS if language == "python"]
SHELL = [code.splitlines() for language, code, _ in BLOCKS if language == "sh"]


def test_there_are_snippets() -> None:
    assert PYTHON
    lines = [line for block in SHELL for line in block]
    assert any(line.startswith("python3 dev.py run calibrate") for line in lines)
    assert "python3 dev.py test" in lines


@pytest.mark.parametrize(("code", "printed"), PYTHON)
def test_python(code: str, printed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile(code, "README.md", "exec"), {})
    for line in printed.splitlines():
        assert line.strip() in out.getvalue()


def runs(line: str) -> bool:
    return "rpim-opt" in line.split("#")[0] or "dev.py run" in line


@pytest.mark.parametrize("block", [b for b in SHELL if any(map(runs, b))], ids=lambda block: block[0][:40])
def test_commands(block: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    write_cell(tmp_path)  # what the reader has: arm.urdf and measured.csv
    monkeypatch.chdir(tmp_path)
    for line in filter(runs, block):
        words = shlex.split(line.split("#")[0])
        words = words[3:] if words[0] == "python3" else words[1:]
        named = [w.removeprefix("problems/") for w in words]
        with contextlib.redirect_stdout(io.StringIO()):
            assert run(monkeypatch, *named) == 0
