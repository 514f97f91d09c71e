"""Every snippet of the README runs, and prints what the README says it prints."""

from __future__ import annotations

import contextlib
import io
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from rpim_opt import cli

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```(\w+)\n(.*?)```(?:\n+```text\n(.*?)```)?", README, flags=re.DOTALL)
PYTHON = [(code, printed) for language, code, printed in BLOCKS if language == "python"]
SHELL = [line for language, code, _ in BLOCKS if language == "sh" for line in code.splitlines()]


def test_there_are_snippets() -> None:
    assert PYTHON
    assert any(line.startswith("python3 dev.py run calibrate") for line in SHELL)
    assert "python3 dev.py test" in SHELL


@pytest.mark.parametrize(("code", "printed"), PYTHON)
def test_python(code: str, printed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(compile(code, "README.md", "exec"), {})
    for line in printed.splitlines():
        assert line.strip() in out.getvalue()


@pytest.mark.parametrize("line", [s for s in SHELL if "rpim-opt" in s.split("#")[0] or "dev.py run" in s])
def test_commands(line: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    words = shlex.split(line.split("#")[0])
    words = words[3:] if words[0] == "python3" else words[1:]
    monkeypatch.chdir(tmp_path)
    named = [w.removeprefix("problems/") for w in words]
    monkeypatch.setattr("sys.argv", ["rpim-opt", *named])
    with contextlib.redirect_stdout(io.StringIO()), pytest.raises(SystemExit) as stop:
        cli.main()
    assert not stop.value.code


def test_the_main_table_is_the_studys() -> None:
    from pyarrow import parquet

    path = Path(__file__).parents[1] / "studies" / "results" / "peers" / "replicates.parquet"
    rows = parquet.read_table(path).to_pylist()
    lines = re.findall(r"^\| (\S+, \S.*?) \| (.*) \|$", README.split("##")[0].replace("**", ""), flags=re.MULTILINE)
    assert len(lines) == 5
    for name, cells in lines:
        tool, _, method = name.partition(", ")
        own = [row for row in rows if (row["tool"], row["method"]) == (tool, method)]
        stated = [cell.strip() for cell in cells.split("|")]
        for situation, figure in zip(("clean52", "few10", "blunders52"), stated, strict=False):
            errors = [row["rms_mm"] for row in own if row["situation"] == situation]
            assert f"{np.mean(errors):.3f}" == figure, (name, situation)
        if stated[3]:
            largest = max(row["largest_mm"] for row in own)
            assert stated[3] == (f"{largest:.0f} mm" if largest > 10 else f"{largest:.1f} mm"), name
        clean = [row["seconds"] for row in own if row["situation"] == "clean52"]
        assert float(stated[4]) == pytest.approx(np.median(clean), rel=0.05), name
