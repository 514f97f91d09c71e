"""Whole commands with a fault at each of their calls that write: old files whole, nothing left over, one sentence."""

from __future__ import annotations

import csv
import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

import rpim_opt as ro
from rpim_opt import cli
from rpim_opt.robot.library import find_robot
from rpim_opt.store import problems_folder
from tests.faults import FAULTS, Audit, Layer
from tests.fuzz.seeds import CONF, KINEMATICS, TRACKED, URDF, make_cell

STUDY = """QUESTION = "Does it run?"
METRICS = {}
def cases(quick): return [{"seed": 1}, {"seed": 2}]
def run(seed): return {"twice": 2.0 * seed}
def report(rows):
    from rpim_opt.study import Report
    return Report("Yes.", {"sum": sum(row["twice"] for row in rows)})
"""
AUDIT = Audit()
COMMANDS = {
    "new": ["new", "deep/made", "--robot", "robot.toml", "--data", "table.csv", "--hold-out", "0.25"],
    "simulate": ["simulate", "sim"],
    "simulate elsewhere": ["simulate", "sim", "--out", "deep/er"],
    "calibrate": ["calibrate", "cell", "--selector", "1", "--model", "geometry", "--out", "deep/er"],
    "calibrate again": ["calibrate", "cell", "--selector", "2", "--model", "geometry", "--out", "."],
    "export": ["export", "result.json", "--mdh", "out.toml", "--robodk", "deep/out.csv"],
    "export again": ["export", "result.json", "--mdh", "old.toml", "--robodk", "old.csv"],
    "compensate": ["compensate", "result.json", "targets.csv", "--out", "old.csv"],
    "report": ["report", "result.json", "--out", "old.csv"],
    "validate": ["validate", "result.json", "table.csv", "--out", "deep/rows.csv"],
    "design": ["design", "cell", "--count", "3", "--candidates", "20", "--out", "old.csv"],
    "study": ["study", "mine.py", "--out", "deep/study"],
    "compare": ["compare", "cell", "--formulations", "tikhonov", "--selector", "1", "--splits", "0.25", "--out", "c"],
}
QUICK = ("new", "export again")
RESUMED = {"study": "deep/study", "compare": "c"}
"""Where what was computed stays, to go on with."""


def make_desk(folder: Path) -> None:
    """Make a folder with a file of every kind."""
    cell = folder / "cell"
    make_cell(cell)
    shutil.copy(cell / "robot.toml", folder / "robot.toml")
    shutil.copy(cell / "identification.csv", folder / "table.csv")
    instance = ro.load(cell)
    result = ro.calibrate(instance.problem, ro.tikhonov, 1.0)
    ro.store.save_result(replace(result, record=instance.record), folder / "result.json")
    shutil.copytree(problems_folder() / "scara", folder / "sim")
    (folder / "arm.urdf").write_text(URDF)
    ro.robot.write_robot(ro.read_robot(find_robot("irb120")), folder / "arm.csv")
    (folder / "kinematics.yaml").write_text(KINEMATICS)
    (folder / "calibration.conf").write_text(CONF)
    (folder / "targets.csv").write_text("label,q1_deg,q2_deg\nA,0,10\nB,1,2\n")
    (folder / "poses.csv").write_text("x_mm,y_mm,z_mm\n100,200,300\n300,0,400\n")
    (folder / "rows.csv").write_text(TRACKED)
    (folder / "mine.py").write_text(STUDY)
    (folder / "empty.csv").write_text("")
    for name in ("binary.xlsx", "binary.parquet"):
        (folder / name).write_bytes(bytes(range(256)) * 4)


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("faults") / "desk"
    make_desk(folder)
    for name in ("old.toml", "old.csv"):
        (folder / name).write_text("what was there")
    return folder


def content(folder: Path) -> dict[str, bytes | None]:
    """Return every file's bytes; None for folders."""
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


def run(monkeypatch: pytest.MonkeyPatch, arguments: list[str]) -> int:
    monkeypatch.setattr("sys.argv", ["rpim-opt", *arguments])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    return int(stop.value.code or 0)


def untimed(path: str, data: bytes | None) -> bytes | None:
    """Return a comparison's replicates without how long they took."""
    if not path.endswith("replicates.csv") or data is None:
        return data
    rows = list(csv.DictReader(data.decode().splitlines()))
    return json.dumps([{k: v for k, v in row.items() if k != "seconds"} for row in rows]).encode()


class Trial:
    """A command in a folder of its own, with faults."""

    def __init__(self, name: str, pristine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
        self.name = name
        self.line = COMMANDS[name]
        self.pristine = pristine
        self.folder = tmp_path / "desk"
        self.patch = monkeypatch
        self.capsys = capsys
        self.old = content(pristine)
        monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
        self.layer = Layer(monkeypatch)
        self.fresh()
        assert run(monkeypatch, self.line) == 0  # what is imported late is there now
        self.fresh()
        with self.layer.failing(None, "no space"):
            AUDIT.names = []
            AUDIT.listening = True
            assert run(monkeypatch, self.line) == 0
            AUDIT.listening = False
        self.calls = list(self.layer.names)
        self.new = content(self.folder)

    def fresh(self) -> None:
        os.chdir(self.pristine)
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.copytree(self.pristine, self.folder)
        self.patch.chdir(self.folder)

    def fail(self, at: int, fault: str, again: bool = True) -> None:
        """Let a call fail, look at what is left, and then, if wanted, run the command to its end."""
        where = f"{self.name}: {fault} at {at}, {self.calls[at]}"
        self.fresh()
        self.capsys.readouterr()
        with self.layer.failing(at, fault):
            code = run(self.patch, self.line)
        said = self.capsys.readouterr().err
        self._look(code, said, fault, where)
        if not again:
            return
        line = self.line
        if code and self.name in RESUMED:
            line = [*line, "--resume"]
        if code or self.name != "new":
            assert run(self.patch, line) == 0, where
        self.require_same(content(self.folder), self.new, where)

    def _look(self, code: int, said: str, fault: str, where: str) -> None:
        found = {path: data for path, data in content(self.folder).items() if path in self.old or not self._empty(path)}
        if code == 0:  # a step that may fail: a folder that cannot be synced, a mode
            self.require_same(found, self.new, where)
            return
        assert code == (130 if fault == "Ctrl-C" else 2), where
        assert said.count("\n") == 1, f"{where}: {said}"
        assert "Traceback" not in said, where
        assert not [path for path in found if ".part" in path], where
        kept = RESUMED.get(self.name)
        if kept is None:
            whole = found in (self.old, self.new) or self.alike(found, self.new)
            assert whole, f"{where}: {sorted(set(found) ^ set(self.old))}"
            return
        over = {path for path in set(found) - set(self.old) if not Path(path).is_relative_to(kept)}
        assert all(Path(kept).is_relative_to(path) for path in over), where

    def _empty(self, path: str) -> bool:
        """Whether a folder was made for files that could not be written."""
        place = self.folder / path
        return place.is_dir() and all(each.is_dir() for each in place.rglob("*"))

    def require_same(self, found: dict[str, bytes | None], wanted: dict[str, bytes | None], where: str) -> None:
        assert sorted(found) == sorted(wanted), where
        assert self.alike(found, wanted), where

    def alike(self, found: dict[str, bytes | None], wanted: dict[str, bytes | None]) -> bool:
        """Whether the files are the same, but for the day and the time they say."""
        if set(found) != set(wanted):
            return False
        timed = (".json", ".html", "README.md", ".parquet")
        found = {path: untimed(path, data) for path, data in found.items()}
        wanted = {path: untimed(path, data) for path, data in wanted.items()}
        return all(found[p] == wanted[p] or (p.endswith(timed) and len(found[p] or b"") > 100) for p in found)


@pytest.fixture
def trial(pristine, tmp_path, monkeypatch, capsys):
    return lambda name: Trial(name, pristine, tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize("name", QUICK)
def test_a_fault_at_each_call_that_writes(trial, name: str) -> None:
    made = trial(name)
    kinds = list(FAULTS)
    for at in range(len(made.calls)):
        made.fail(at, kinds[at % len(kinds)], again=at % 5 == 0)


EVERY = [
    (name, fault) for name in COMMANDS for fault in FAULTS if name not in RESUMED or fault in ("no space", "Ctrl-C")
]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "fault"), EVERY)
def test_every_fault_at_every_call_that_writes(trial, name: str, fault: str) -> None:
    made = trial(name)
    for at in range(len(made.calls)):
        made.fail(at, fault)


@pytest.mark.parametrize("name", ["new", "export again"])
def test_nothing_is_written_past_the_layer(trial, name: str) -> None:
    """Otherwise faults were not tried everywhere."""
    made = trial(name)
    opened = [call for call in made.calls if call in ("open", "os.open")]
    renamed = [call for call in made.calls if call in ("rename", "replace")]
    assert len(opened) == AUDIT.names.count("open")
    assert len(renamed) == AUDIT.names.count("os.rename")
    assert made.calls.count("mkdir") == AUDIT.names.count("os.mkdir")
    assert made.calls.count("link") == AUDIT.names.count("os.link")
