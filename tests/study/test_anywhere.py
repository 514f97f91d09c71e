"""Anyone's study runs from anywhere: a file, a folder, a name; its results say which version of it made them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import rpim_opt as ro
from rpim_opt.study import grid
from rpim_opt.study.runner import run_study
from tests.test_cli import run

MINE = """
from beside import factor
from rpim_opt.study import Metric, Report

QUESTION = "How large is twice a number?"
METRICS = {"largest": Metric("lower", 0.1)}


def cases(quick):
    return [{"seed": seed} for seed in range(2 if quick else 4)]


def run(seed):
    from inside.deep import extra

    if STOP and seed == 2:
        raise KeyboardInterrupt
    return {"value": factor * seed + extra}


def report(rows):
    return Report(f"{len(rows)} numbers", {"largest": max(row["value"] for row in rows)})
"""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder of somebody's with a study in a file and one in a folder, as the current one."""
    grid.load_study.cache_clear()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", list(sys.path))
    for module in ("beside", "inside", "inside.deep"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    text = MINE.replace("QUESTION", "STOP = False\nQUESTION", 1)
    whole = tmp_path / "whole"
    for file, folder in (("mine.py", tmp_path), ("study.py", whole)):
        (folder / "inside").mkdir(parents=True)
        (folder / file).write_text(text)
        (folder / "beside.py").write_text("factor = 2")
        (folder / "inside" / "__init__.py").write_text("")
        (folder / "inside" / "deep.py").write_text("extra = 0")
    return tmp_path


@pytest.mark.parametrize("name", ["mine", "mine.py", "./mine.py"])
def test_a_file_is_a_study(place: Path, name: str) -> None:
    report, folder = run_study(name)
    assert report.metrics == {"largest": 6}
    assert folder == place / "results" / "mine"
    made = (folder / "README.md").read_text()
    for part in (
        "`rpim-opt study mine.py`",
        "mine.py with SHA-256",
        "(in no repository)",
        "rpim-opt 0.1.0",
        "4 replicates",
    ):
        assert part in made


@pytest.mark.parametrize("name", ["whole", "./whole", "whole/"])
def test_a_folder_is_a_study(place: Path, name: str) -> None:
    _, folder = run_study(name, quick=True)
    assert folder == place / "whole" / "results" / "whole-quick"


def test_a_study_without_one_is_a_sentence(place: Path, monkeypatch, capsys) -> None:
    for name, said in {
        "nothing": "accepted: a file nothing.py, or a folder with study.py",
        "./nothing.py": "no file 'nothing.py'",
        "inside/": "no file 'inside/study.py'",
        "beside.py": "no 'QUESTION'",
    }.items():
        assert run(monkeypatch, "study", name) == 2
        assert said in capsys.readouterr().err
    (place / "wrong.py").write_text("def (")
    assert run(monkeypatch, "study", "wrong.py") == 2
    assert "line 1" in capsys.readouterr().err


def test_an_installed_package_names_no_studies_of_its_own(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere() -> Path:
        raise ro.InputError("the studies", "no folder", "a checkout")

    monkeypatch.setattr(grid, "studies_folder", nowhere)
    with pytest.raises(ro.InputError, match=r"accepted: a file paper.py, or a folder with study.py\.$"):
        grid.find_study("paper")
    assert run_study("mine", quick=True)[0].metrics == {"largest": 2}


def test_a_journal_knows_the_files_that_a_study_imports_and_no_others(place: Path) -> None:
    text = (place / "mine.py").read_text()
    waiting = text.replace("STOP = False", "from pathlib import Path\nSTOP = not Path('go').exists()")
    (place / "mine.py").write_text(waiting)
    with pytest.raises(KeyboardInterrupt):
        run_study("mine.py")
    (place / "go").touch()
    grid.load_study.cache_clear()
    (place / "other.py").write_text("nobody = 'imports this'")
    for file in (place / "beside.py", place / "inside" / "deep.py"):
        kept = file.read_text()
        file.write_text(kept + "\nnew = 1")
        with pytest.raises(ro.InputError, match="resume: found replicates of another set of studies"):
            run_study("mine.py", resume=True)
        file.write_text(kept)
    assert run_study("mine.py", resume=True)[0].metrics == {"largest": 6}


def test_results_say_whether_the_study_is_the_commits(place: Path) -> None:
    def git(*arguments: str) -> None:
        command = ["git", "-C", str(place), "-c", "user.name=a", "-c", "user.email=a@b", *arguments]
        subprocess.run(command, check=True, capture_output=True)

    def made() -> str:
        return (run_study("mine.py", quick=True)[1] / "README.md").read_text()

    git("init")
    git("commit", "--allow-empty", "-m", "first")
    assert ", untracked)" in made()
    git("add", "mine.py")
    git("commit", "-m", "mine")
    assert "untracked" not in made().split("with rpim-opt")[0]
    (place / "mine.py").write_text((place / "mine.py").read_text() + "\n# changed\n")
    assert ", dirty)" in made().split("with rpim-opt")[0]
