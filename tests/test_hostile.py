"""Numbers, names and texts that no cell has: one sentence each, in a moment, and nothing of them reaches a terminal."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics.tables import csv_text, read_columns
from rpim_opt.basics.text import visible
from rpim_opt.use import compensate
from tests.test_cli import edit, folder, run

assert folder is not None  # the fixture

HEAD = 'title = "T"\nidentification = "identification.csv"\nidentify = ["d?"]\n'
PLAIN = HEAD + "[noise]\nposition_mm = 0.03\n"
DIGITS = "1" + "0" * 400
"""An integer that is no double."""
TOML = {
    "base at 1e308": (PLAIN + "[base]\nx_mm = 1e308\n", "key base.x_mm: found 1e+308"),
    "base at 1e20 m": (PLAIN + "[base]\nx_m = 1e20\n", "key base.x_m: found 1e+20"),
    "1e300 degrees": (PLAIN + "[base]\nrx_deg = 1e300\n", "key base.rx_deg: found 1e+300"),
    "a tool at 1e308": (PLAIN + "[tool]\nx_m = 1e308\n", "key tool.x_m: found 1e+308"),
    "1e400": (PLAIN + "[base]\nx_mm = 1e400\n", "key base.x_mm: found inf"),
    "a scale of 1e308": (PLAIN + "[scale]\nlength_mm = 1e308\n", "key length_mm: found 1e+308"),
    "a scale of 1e-308": (PLAIN + "[scale]\nlength_mm = 1e-308\n", "key length: found 1e-311"),
    "a scale of 1e400": (PLAIN + "[scale]\nlength_mm = 1e400\n", "key length_mm: found inf"),
    "a scale of 400 digits": (PLAIN + f"[scale]\nlength_mm = {DIGITS}\n", "key length_mm: found 1000"),
    "a tolerance of 400 digits": (PLAIN + f"[tolerance]\nlength_mm = {DIGITS}\n", "key length_mm: found 1000"),
    "a noise of 400 digits": (PLAIN.replace("0.03", DIGITS), "key position_mm: found 1000"),
    "a noise of 1e308": (PLAIN.replace("0.03", "1e308"), "key position_mm: found 1e+308"),
    "a noise of 1e-200": (PLAIN.replace("0.03", "1e-200"), "key position: found 1e-203"),
    "an infinite figure": (PLAIN + '[published."identification.csv"]\nRPIM = 1e400\n', "RPIM: found inf"),
    "a reference that is none": (PLAIN + "[reference]\nx = [nan, 1]\n", "key reference.x 1: found nan"),
    "5000 digits": (PLAIN + f"[base]\nx_mm = {'1' * 5000}\n", "the TOML text: found"),
    "3000 levels": (PLAIN + f"[simulation]\nx = {'[' * 3000}{']' * 3000}\n", "the TOML text: found"),
    "3000 levels of tables": (HEAD + f"a{'.a' * 3000} = 1\n", "found"),
    "a pattern of 20,000 characters": (PLAIN.replace('"d?"', f'"{"[!" * 10000}]"'), "key identify"),
    "a key of 20,000 characters": (PLAIN + f'[scale]\n"{"[!" * 10000}]_mm" = 1\n', "key scale"),
    "a weight of 1e308": ('selector = "1e308"\n' + PLAIN, "selector: found '1e+308'"),
    "a weight of 1e-320": ('selector = "1e-320"\n' + PLAIN, "selector: found '1e-320'"),
    "a weight of 6000 digits": (f'selector = "{"9" * 6000}"\n' + PLAIN, "selector: found"),
    "a name without letters": (PLAIN.replace("identification.csv", ""), "key identification: found ''"),
    "a zero byte in a name": (PLAIN.replace("identification.csv", "\\u0000.csv"), "key identification: found"),
    "a name of 5000 letters": (PLAIN.replace("identification.csv", f"{'a' * 5000}.csv"), "the file: found"),
    "a zero byte in the robot's name": ('robot = "\\u0000.toml"\n' + PLAIN, "key robot: found"),
}


@pytest.mark.parametrize("case", TOML)
def test_problem_files(monkeypatch, capsys, folder, case: str) -> None:
    text, expected = TOML[case]
    (folder / "problem.toml").write_text(text)
    refused(monkeypatch, capsys, folder, expected)


def refused(monkeypatch, capsys, folder: Path, expected: str) -> None:
    began = time.perf_counter()
    assert run(monkeypatch, "calibrate", str(folder), "--out", str(folder / "out")) == 2
    assert time.perf_counter() - began < 5
    said = capsys.readouterr()
    assert said.out == ""
    assert expected in said.err
    assert said.err.count("\n") == 1
    assert len(said.err) < 3000
    assert not (folder / "out").exists()


NUMBERS = {"1e400": "inf", "1e308": "1e+308", "1e20": "1e+20", DIGITS: "1000", "1" * 5000: "Exceeds", "nan": "nan"}


@pytest.mark.parametrize("number", NUMBERS)
@pytest.mark.parametrize("key", ["d_mm", "alpha_deg", "limits_deg", "coupling"])
def test_robot_files(monkeypatch, capsys, folder, key: str, number: str) -> None:
    (folder / "problem.toml").write_text(PLAIN)
    joints = 'name = "r"\n' + "[[joint]]\nd_mm = 100\n" * 6
    value = {"limits_deg": f"[0, {number}]", "coupling": f"[[{number}{', 0' * 5}]{', [0, 1, 0, 0, 0, 0]' * 5}]"}
    line = f"{key} = {value.get(key, number)}\n"
    text = line + joints
    if key != "coupling":
        text = joints + line
    (folder / "robot.toml").write_text(text)
    refused(monkeypatch, capsys, folder, "found")


@pytest.mark.parametrize("number", ["1e308", "1e300", "1e20"])
@pytest.mark.parametrize("old", ["228.695", "T2-1,"])
def test_cells(monkeypatch, capsys, folder, old: str, number: str) -> None:
    row = next(line for line in (folder / "identification.csv").read_text().splitlines() if old in line)
    cells = row.split(",")
    place = cells.index(old) if old in cells else 1
    new = ",".join([*cells[:place], number, *cells[place + 1 :]])
    edit(folder / "identification.csv", row, new)
    refused(monkeypatch, capsys, folder, f"row {cells[0]}, column")


def test_arrays_beyond_all_sizes() -> None:
    with pytest.raises(ro.InputError, match="numbers of at most"):
        ro.Dataset.of(np.full((1, 6), 1e300), np.zeros((1, 3)), 1e-4)
    with pytest.raises(ro.InputError, match="magnitudes of at most"):
        ro.robot.Robot("far", np.array([[0.0, 1e300, 0, 0, 0]]))


def test_limits_that_mean_none_in_a_urdf(tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(
        '<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="revolute"><parent link="a"/>'
        '<child link="b"/><limit lower="-1e16" upper="1e300"/></joint></robot>'
    )
    assert not np.isfinite(ro.read_urdf(tmp_path / "arm.urdf").robot.limits).any()


@pytest.mark.parametrize(
    "wrong",
    [
        lambda problem: ro.calibrate(problem, ro.tikhonov, 1.0, max_iterations=-1),
        lambda problem: ro.calibrate(problem, ro.tikhonov, 1.0, max_iterations=True),
        lambda problem: ro.calibrate(problem, ro.tikhonov, True),
        lambda problem: ro.calibrate(problem, ro.tikhonov, np.True_),
        lambda problem: ro.calibrate(problem, ro.tikhonov, float("nan")),
        lambda problem: ro.calibrate(problem, ro.tikhonov, 1e308),
        lambda problem: ro.calibrate(problem, ro.tikhonov, 1e-320),
        lambda problem: ro.constraints.signed(+2),
        lambda problem: ro.constraints.signed(0, "a?"),
        lambda problem: ro.huber(float("nan")),
        lambda problem: problem.parameters.scaled({"length_mm": True}),
        lambda problem: problem.parameters.toleranced({"length_mm": 10**400}),
        lambda problem: compensate(ro.calibrate(problem, ro.tikhonov, 1.0), np.zeros((1, 6)), largest=float("nan")),
    ],
)
def test_what_was_taken_in_silence(wrong) -> None:
    problem = ro.load("paper_arm").problem
    with pytest.raises(ro.InputError):
        wrong(problem)


ESCAPES = "\x1b]0;owned\x07\x1b[2J\x9b31m\u202egnp\x08\r"


@pytest.mark.usefixtures("undrawn")
def test_titles_and_sources_cannot_command_a_terminal(monkeypatch, capsys, folder, tmp_path) -> None:
    text = json.dumps(f"before{ESCAPES}after")
    (folder / "problem.toml").write_text(PLAIN.replace('"T"', text) + f'[exclude]\n"T2-1" = {text}\n')
    edit(folder / "problem.toml", 'identify = ["d?"', f'source = {text}\nidentify = ["*a?", "d?"')
    commands = [
        ["inspect", str(folder)],
        ["calibrate", str(folder), "--out", str(tmp_path / "out")],
        ["calibrate", str(folder), "--variant", ESCAPES],
        ["calibrate", str(tmp_path / f"none{ESCAPES}")],
        ["inspect", str(folder), "--json"],
        ["report", str(tmp_path / "out"), "--out", str(tmp_path / f"{ESCAPES[:9]}.html")],
    ]
    for command in commands:
        run(monkeypatch, *command)
        said = capsys.readouterr()
        text = said.out + said.err
        assert text == visible(text), command
        assert "\r" not in text
        if command[0] == "inspect":
            assert "before" in text
            assert "after" in text
    assert ro.load_result(tmp_path / "out").record.title == f"before{ESCAPES}after"  # as it was


def test_what_is_visible_stays() -> None:
    text = "Größe 3 µm — θ₁, 日本, 1\u00a0000\n"
    assert visible(text) == text
    assert visible("a\x1b[0m\tb\u202e") == r"a\x1b[0m\tb\u202e"


FORMULAS = ["=cmd|' /C calc'!A0", "+SUM(A1)", "-2+3", "@x", "\uff1d1", "'=1", "''=1", "-", "+", "=", "\t=1"]
PLAIN_CELLS = ["a", "T8-7", "-1.5", "+2", "-1e-3", "'quoted'", "", "1=1", "-inf"]


def test_no_cell_is_a_formula_and_all_come_back(tmp_path: Path) -> None:
    cells = [*FORMULAS, *PLAIN_CELLS]
    text = csv_text(["label", "n"], [[cell, str(i)] for i, cell in enumerate(cells)])
    (tmp_path / "t.csv").write_text(text)
    for line in text.splitlines():
        assert line.strip('"')[:1] not in "=@" or not line.strip('"')
    written = [line.rpartition(",")[0] for line in text.splitlines()[1:]]
    assert [cell for cell, line in zip(cells, written, strict=True) if cell != line.strip('"')] == FORMULAS
    assert list(read_columns(tmp_path / "t.csv")["label"]) == [cell.strip() for cell in cells]


def test_labels_in_tables_that_people_open(monkeypatch, capsys, folder, tmp_path) -> None:
    edit(folder / "validation.csv", (folder / "validation.csv").read_text().splitlines()[1].split(",")[0], "=1+cmd|x!A")
    assert run(monkeypatch, "calibrate", str(folder), "--out", str(tmp_path)) == 0
    table = tmp_path / "errors.csv"
    # two rows are misprints, by 15 and 38 mm: what contradicts the calibration is no validation
    assert run(monkeypatch, "validate", str(tmp_path), str(folder / "validation.csv"), "--out", str(table)) == 4
    assert "'=1+cmd|x!A" in table.read_text()
    assert "=1+cmd|x!A" in list(read_columns(table)["label"])


def command(*arguments: str, **options) -> subprocess.CompletedProcess[str]:
    start = [sys.executable, "-c", "from rpim_opt.cli import main; main()", *arguments]
    return subprocess.run(start, stderr=subprocess.PIPE, text=True, check=False, **options)


@pytest.mark.parametrize("arguments", [["robots"], ["robots", "--json"], ["--help"]])
def test_a_full_disk_behind_the_output(arguments: list[str]) -> None:
    with open("/dev/full", "w") as full:
        done = command(*arguments, stdout=full)
    assert done.returncode == 2
    assert "No space left on device" in done.stderr
    assert "Traceback" not in done.stderr
    assert "Exception ignored" not in done.stderr


def test_nobody_reads_any_more() -> None:
    """As of ``rpim-opt ... | head``: the code was that of a robot that is not delivered."""
    read, write = os.pipe()
    os.close(read)
    done = command("robots", stdout=write)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_full_disk_behind_the_errors() -> None:
    start = [sys.executable, "-c", "from rpim_opt.cli import main; main()", "inspect", "nope"]
    with open("/dev/full", "w") as full:
        assert subprocess.run(start, stderr=full, check=False).returncode == 2


def test_an_output_that_knows_but_ascii() -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = command("inspect", "no\u00e9\udcff", stdout=subprocess.PIPE, env=environment)
    assert done.returncode == 2
    assert "no folder 'no" in done.stderr


WAITING = """
import sys, signal, os, time
from rpim_opt import cli
from rpim_opt.store import instances

def load(*_):
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(60)  # another thread may have taken the signal first

instances.load = load
sys.argv = ["rpim-opt", "inspect", "paper_arm"]
cli.main()
"""


def test_an_interrupt_is_one_word() -> None:
    done = subprocess.run([sys.executable, "-c", WAITING], capture_output=True, text=True, check=False)
    assert done.returncode == 128 + signal.SIGINT
    assert done.stderr.strip() == "Interrupted."


@pytest.mark.parametrize(
    "arguments",
    [
        ["design", "position", "--candidates", "-5"],
        ["design", "position", "--candidates", "1000000000000"],
        ["design", "position", "--candidates", "40", "--count", "5", "--out", "/dev/full"],
        ["design", "position", "--candidates", "40", "--count", "5", "--out", "/proc/nope/x.csv"],
        ["calibrate", "paper_arm", "--out", "/dev/null"],
        ["calibrate", "paper_arm", "--out", "/proc/nope"],
        ["study", "paper", "--out", "/proc/nope"],
        ["study", "paper", "--workers", "0", "--out", "OUT"],
        ["study", "paper", "--scheduler", "nonsense", "--out", "OUT"],
        ["report", "/dev/zero"],
        ["new", "OUT", "--robot", "ur5", "--data", "/dev/zero"],
        ["new", "OUT", "--robot", "/dev/zero", "--data", "x.csv"],
        ["new", "/proc/x/y", "--robot", "ur5", "--data", "x.csv"],
    ],
)
def test_arguments_that_cannot_be(monkeypatch, capsys, tmp_path, arguments: list[str]) -> None:
    arguments = [str(tmp_path / "out") if argument == "OUT" else argument for argument in arguments]
    assert run(monkeypatch, *arguments) == 2
    assert "Traceback" not in capsys.readouterr().err
