"""The program from outside: an interrupt while commands are loaded, folders left alone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests import ROOT


def run(folder: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)]), **variables}
    command = [sys.executable, "-m", "rpim_opt", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


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
    assert (done.returncode, done.stderr) == (1, b"")
    assert run(tmp_path, *made).returncode == 0


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
