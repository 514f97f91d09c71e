"""Anyone's study runs from anywhere: a file, a folder, a name; its results say which version of it made them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import rpim_opt as ro
from rpim_opt.study import studies
from rpim_opt.study.studies import run_study
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
    studies.load_study.cache_clear()
    here = tmp_path / "place"
    here.mkdir()
    monkeypatch.chdir(here)
    monkeypatch.setattr("sys.path", list(sys.path))
    for module in ("beside", "inside", "inside.deep"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    text = MINE.replace("QUESTION", "STOP = False\nQUESTION", 1)
    whole = here / "whole"
    for file, folder in (("mine.py", here), ("study.py", whole)):
        (folder / "inside").mkdir(parents=True)
        (folder / file).write_text(text)
        (folder / "beside.py").write_text("factor = 2")
        (folder / "inside" / "__init__.py").write_text("")
        (folder / "inside" / "deep.py").write_text("extra = 0")
    return here


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
        "nothing": "found 'nothing', accepted: a Python file, or a folder with study.py",
        "./nothing.py": "found './nothing.py'",
        "inside/": "found 'inside/'",
        "beside.py": "no 'QUESTION'",
    }.items():
        assert run(monkeypatch, "study", name) == 2
        assert said in capsys.readouterr().err
    (place / "wrong.py").write_text("def (")
    assert run(monkeypatch, "study", "wrong.py") == 2
    assert "line 1" in capsys.readouterr().err


def test_an_installed_package_names_no_studies_of_its_own(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(studies, "STUDIES", place / "nowhere")
    with pytest.raises(ro.InputError, match=r"accepted: a Python file, or a folder with study.py\.$"):
        studies.find_study("paper")
    assert run_study("mine", quick=True)[0].metrics == {"largest": 2}


def stopped(place: Path, more: str = "") -> None:
    """Run a study that is stopped after two of four replicates, and go on would."""
    text = (place / "mine.py").read_text()
    waiting = f"STOP = not Path({str(place.parent / 'go')!r}).exists()"
    (place / "mine.py").write_text(f"from pathlib import Path\n{more}\n{text.replace('STOP = False', waiting)}")
    with pytest.raises(KeyboardInterrupt):
        run_study("mine.py")
    (place.parent / "go").touch()
    studies.load_study.cache_clear()


@pytest.mark.parametrize("name", ["beside.py", "inside/deep.py", "data.csv", "deep/er/data.csv", "not imported.py"])
def test_a_journal_knows_the_files_beside_a_study(place: Path, name: str) -> None:
    """Once data.csv was changed between the kill and the second half: values 100 101 102 503 ... 507."""
    file = place / name
    file.parent.mkdir(parents=True, exist_ok=True)
    if not file.exists():
        file.write_text("100")
    (place / ".hidden").write_text("of an editor")
    stopped(place)
    kept = file.read_text()
    for change in (lambda: file.write_text(kept + "\n"), file.unlink):
        change()
        with pytest.raises(ro.InputError, match=f"resume: found replicates of another file {name}"):
            run_study("mine.py", resume=True)
    file.write_text(kept)
    (place / "new.csv").write_text("another file that it may read")
    with pytest.raises(ro.InputError, match=r"another file new\.csv"):
        run_study("mine.py", resume=True)
    (place / "new.csv").unlink()
    (place / ".hidden").unlink()
    (place / "results" / "of others").mkdir()
    (place / "results" / "of others" / "replicates.json").write_text("{}")
    assert run_study("mine.py", resume=True)[0].metrics == {"largest": 6}


def test_a_study_says_which_files_it_depends_on(place: Path) -> None:
    elsewhere = place.parent / "elsewhere"
    (elsewhere / "deep").mkdir(parents=True)
    (elsewhere / "deep" / "data.csv").write_text("100")
    for name in ("notes.txt", "table.csv"):
        (place / name).write_text("1")
    results = place / "results" / "another"
    results.mkdir(parents=True)
    (results / "replicates.json").write_text("1")
    stopped(place, f"DEPENDS = ['table.csv', '{elsewhere}', 'results/another', '*.none']")
    (place / "notes.txt").write_text("2")
    for file in (
        place / "table.csv",
        elsewhere / "deep" / "data.csv",
        place / "beside.py",
        results / "replicates.json",
    ):
        kept = file.read_text()
        file.write_text(kept + "\n")
        with pytest.raises(ro.InputError, match=f"another file .*{file.name}"):
            run_study("mine.py", resume=True)
        file.write_text(kept)
    _, folder = run_study("mine.py", resume=True)
    made = (folder / "README.md").read_text()
    assert "11 files in its folder or named by it have SHA-256" in made
    assert "others that it reads are not known" in made


def test_what_a_study_depends_on_is_there_and_not_endless(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = (place / "mine.py").read_text()
    (place / "mine.py").write_text(f"DEPENDS = ['table.csv']\n{text}")
    with pytest.raises(ro.InputError, match=r"DEPENDS: found no file 'table\.csv'"):
        run_study("mine.py")
    monkeypatch.setattr(studies, "MOST_FILES", 3)
    with pytest.raises(ro.InputError, match=r"more than 3 files .* DEPENDS = \[\.\.\.\] in the study"):
        run_study("whole")


def test_a_plain_installation_says_at_once_what_a_study_needs(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "joblib", None)
    ran = place.parent / "ran"
    text = (
        (place / "mine.py")
        .read_text()
        .replace("    from inside", f"    open({str(ran)!r}, 'w').close()\n    from inside")
    )
    (place / "mine.py").write_text(text)
    with pytest.raises(ro.InputError, match="no package joblib"):
        run_study("mine.py", quick=True, workers=2)
    assert not ran.exists()
    assert run_study("mine.py", quick=True)[0].metrics == {"largest": 2}


def test_a_study_asks_for_pyarrow_before_it_computes(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ro.InputError, match=r"the study: found no package pyarrow, accepted: pip install"):
        run_study("mine.py")
    assert not (place / "results").exists()


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
