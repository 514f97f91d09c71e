"""The program from outside: a stranger's command, an interrupt while commands are loaded, folders left alone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests import ROOT

MINE = '''
from pathlib import Path
from typing import Annotated
import typer
import rpim_opt as ro

def worst(problem: str, more: Annotated[int, typer.Option(help="How many.")] = 1) -> None:
    """Name the rows of a problem that the nominal robot misses most.

    By their labels.
    """
    data = ro.load(problem).problem
    errors = data.errors([0.0] * len(data.parameters.free))
    for row in errors.argsort()[::-1][:more]:
        print(data.data.label[row])
'''


def run(folder: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)]), **variables}
    command = [sys.executable, "-m", "rpim_opt", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "strangers_rows.py").write_text(MINE)
    about = tmp_path / "strangers_rows-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: strangers_rows\nVersion: 1.0\n")
    points = [f"{name} = strangers_rows:worst" for name in ("worst", "robots")]
    (about / "entry_points.txt").write_text("\n".join(["[rpim_opt.commands]", *points]))
    return tmp_path


def test_a_command_of_another_package_is_one_function(folder: Path) -> None:
    done = run(folder, "worst", "paper_arm", "--more", "2")
    assert done.stdout.split() == ["T2-9", "T2-8"], (done.returncode, done.stderr)
    said = run(folder, "--help").stdout
    assert "Name the rows of a problem that the nominal robot misses most." in said
    assert "ur5e" in run(folder, "robots").stdout  # ours go before others
    assert run(folder, "worst", "no such problem").returncode == 2


def test_a_command_that_cannot_be_loaded_does_not_hide_the_others(folder: Path) -> None:
    (folder / "strangers_rows.py").write_text("import no_such_module\n")
    done = run(folder, "--help")
    assert done.returncode == 0, done.stderr
    assert "cannot be loaded: No module named 'no_such_module'" in done.stdout
    assert sum(line.startswith("  robots ") for line in done.stdout.splitlines()) == 1


def test_an_interrupt_while_commands_are_loaded_is_one_word(tmp_path: Path) -> None:
    (tmp_path / "typer.py").write_text("import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(60)\n")
    done = run(tmp_path, "robots")
    assert done.returncode == 128 + signal.SIGINT
    assert done.stderr == "Interrupted.\n"


def test_no_folder_for_temporary_files_or_caches_is_used(tmp_path: Path) -> None:
    """A link that somebody planted in a shared one is not followed, since there is nothing to plant it for."""
    places = {"TMPDIR": str(tmp_path), "HOME": str(tmp_path), "XDG_CACHE_HOME": str(tmp_path)}
    assert run(tmp_path, "calibrate", "paper_arm", **places).returncode == 0
    assert not list(tmp_path.iterdir())


def test_a_reader_that_leaves_is_no_error_of_the_folder_that_is_made(tmp_path: Path) -> None:
    arm = ROOT / "problems" / "paper_arm"
    made = ["new", "made", "--robot", str(arm / "robot.toml"), "--data", str(arm / "identification.csv")]
    read, write = os.pipe()
    os.close(read)
    command = [sys.executable, "-m", "rpim_opt", *made]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, stdout=write, stderr=subprocess.PIPE, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, b"")
    assert (tmp_path / "made" / "problem.toml").is_file()


NO_NETWORK = """
import sys

def refuse(event, arguments):
    if event in ("socket.connect", "socket.bind", "socket.getaddrinfo", "subprocess.Popen", "os.system", "os.exec"):
        raise SystemExit(f"{event} {arguments}")

sys.addaudithook(refuse)
from rpim_opt.__main__ import main
main()
"""


@pytest.mark.parametrize(
    "arguments",
    [["inspect", "paper_arm"], ["report", "out"]],  # a report's result is calibrated first
)
def test_a_command_opens_no_connection_and_starts_no_program(tmp_path: Path, arguments: list[str]) -> None:
    if arguments[0] == "report":
        assert run(tmp_path, "calibrate", "paper_arm", "--out", "out").returncode == 0
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", NO_NETWORK, *arguments]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
