"""The study of peers asks a peer once about the same files, and keeps only answers that are whole."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from rpim_opt.basics import RpimError
from rpim_opt.study import studies

CASE = {"tool": "pybotics", "situation": "clean10", "seed": 0, "quick": True}


class Peer:
    """Stands where the study starts processes: answers like a peer's script, and remembers whom it was asked for."""

    def __init__(self) -> None:
        self.commands: list[list[str]] = []
        self.ends_with = 0
        self.stopped = False
        self.predicted = 1.0

    def __call__(self, command: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
        self.commands.append(command)
        if self.stopped:
            raise KeyboardInterrupt
        answers: dict[str, Any] = {"imports": 0.5, "versions": "pybotics 3.1.2"}
        for setting in command[3:]:
            answers[setting] = {"seconds": float(self.asked), "predicted_mm": [[self.predicted] * 3] * 200}
        return subprocess.CompletedProcess(command, self.ends_with, "a warning\n" + json.dumps(answers) + "\n", "")

    @property
    def asked(self) -> int:
        return len(self.commands)


@pytest.fixture
def peers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """Return the study, with scripts and environments of its own."""
    study = studies.load_study(studies.find_study("peers"))
    shutil.copytree(study.HERE / "peer_scripts", tmp_path / "peer_scripts")
    (tmp_path / ".environments" / "pybotics").mkdir(parents=True)
    monkeypatch.setattr(study, "HERE", tmp_path)
    return study


@pytest.fixture
def peer(peers: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Peer:
    answering = Peer()
    monkeypatch.setattr(peers.subprocess, "run", answering)
    return answering


def kept(peers: ModuleType) -> list[Path]:
    return sorted((peers.HERE / ".environments" / "pybotics").rglob("answers/*"))


def test_a_peer_is_asked_once_about_the_same_files(peers: ModuleType, peer: Peer) -> None:
    first = peers.run(**CASE)
    assert first["xyz: rms_mm"] > 0
    program, script, folder, *settings = peer.commands[0]
    assert Path(program) == peers.HERE / ".environments" / "pybotics" / "bin" / "python"
    assert Path(script) == peers.HERE / "peer_scripts" / "run_pybotics.py"
    assert settings == peers.asked("pybotics", "clean10", quick=True)
    assert not Path(folder).exists()  # another one every time, which therefore must not count
    assert peers.run(**CASE) == first
    assert peer.asked == 1
    assert len(kept(peers)) == 1


def test_what_depends_on_us_is_asked_every_time(peers: ModuleType, peer: Peer) -> None:
    for _ in range(2):
        peers.run(**CASE | {"tool": "rpim_opt"})
    assert peer.asked == 2
    assert peer.commands[0][0] == sys.executable
    assert not list(peers.HERE.rglob("answers"))


def test_benchmarks_ask_anew(peers: ModuleType, peer: Peer) -> None:
    """Only times of one run are compared there."""
    case = CASE | {"situation": "clean52"}
    peers.run(**case)
    benchmarks = studies.load_study(studies.find_study("benchmarks"))
    assert benchmarks.run("peer", count=1, tool="pybotics") == {"xyz: seconds": 2.0}
    assert peers.run(**case)["xyz: seconds"] == 2.0
    assert peer.asked == 2


@pytest.mark.parametrize("more", [{"seed": 1}, {"situation": "clean15"}, {"quick": False}])
def test_another_case_is_asked(peers: ModuleType, peer: Peer, more: dict[str, Any]) -> None:
    peers.run(**CASE)
    peers.run(**CASE | more)
    assert peer.asked == 2


@pytest.mark.parametrize("name", ["calib.csv", "valid.csv", "robot.json", "robot.urdf"])
def test_a_changed_file_is_asked_again(
    peers: ModuleType, peer: Peer, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    peers.run(**CASE)
    written = peers.write_problem

    def changed(folder: Path, situation: str, seed: int) -> np.ndarray:
        true = written(folder, situation, seed)
        (folder / name).write_bytes((folder / name).read_bytes() + b" ")
        return true

    with monkeypatch.context() as other:
        other.setattr(peers, "write_problem", changed)
        peers.run(**CASE)
        assert peer.asked == 2
    peers.run(**CASE)  # the answer to the first files is still there
    assert peer.asked == 2


@pytest.mark.parametrize(("script", "asked"), [("run_pybotics.py", 2), ("common.py", 2), ("run_figaroh.py", 1)])
def test_a_changed_script_is_asked_again(peers: ModuleType, peer: Peer, script: str, asked: int) -> None:
    peers.run(**CASE)
    with (peers.HERE / "peer_scripts" / script).open("a") as stream:
        stream.write("# of tomorrow\n")
    peers.run(**CASE)
    assert peer.asked == asked


def test_another_version_of_a_peer_is_asked_again(
    peers: ModuleType, peer: Peer, monkeypatch: pytest.MonkeyPatch
) -> None:
    peers.run(**CASE)
    monkeypatch.setitem(peers.PACKAGES, "pybotics", ("pybotics==3.1.3", (3, 14)))
    peers.run(**CASE)
    assert peer.asked == 2


DAMAGES = {
    "empty": lambda text: b"",
    "half": lambda text: text[: len(text) // 2],
    "a byte less": lambda text: text[:-1],
    "another digit": lambda text: text.replace(b"0.5", b"0.6"),
    "no text": lambda text: b"\xff" + text[1:],
    "of another layout": lambda text: text.partition(b"\n")[2],
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_answer_is_asked_again(peers: ModuleType, peer: Peer, damage: Any) -> None:
    peers.run(**CASE)
    (file,) = kept(peers)
    whole = file.read_bytes()
    assert damage(whole) != whole
    file.write_bytes(damage(whole))
    assert peers.run(**CASE)["xyz: seconds"] == 2.0
    assert peer.asked == 2
    assert peers.run(**CASE)["xyz: seconds"] == 2.0  # the second answer stands in the place of the damaged one
    assert peer.asked == 2


def test_an_interrupted_or_failed_answer_is_not_kept(peers: ModuleType, peer: Peer) -> None:
    peer.stopped = True
    with pytest.raises(KeyboardInterrupt):
        peers.run(**CASE)
    peer.stopped = False
    peer.ends_with = -9  # killed, without a word
    with pytest.raises(RpimError, match=r"run_pybotics\.py ended with -9"):
        peers.run(**CASE)
    assert kept(peers) == []
    peer.ends_with = 0
    peers.run(**CASE)
    assert peer.asked == 3
    assert len(kept(peers)) == 1


def test_an_answer_that_is_no_number_is_kept_too(peers: ModuleType, peer: Peer) -> None:
    peer.predicted = float("nan")
    for _ in range(2):
        assert np.isnan(peers.run(**CASE)["xyz: rms_mm"])
    assert peer.asked == 1
