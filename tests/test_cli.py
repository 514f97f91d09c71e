"""The command line: what it prints and writes, and one clear sentence for each thing that is wrong."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from io import StringIO
from pathlib import Path

import pytest

from rpim_opt import cli
from rpim_opt.convex.solvers.conic import Unsolved
from rpim_opt.store import problems_folder

KEYS = {"nominal", "identification", "validation", "weight", "selector", "formulation", "converged", "iterations",
        "flagged", "parameters"}  # fmt: skip


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr("sys.argv", ["rpim-opt", *arguments])
    with pytest.raises(SystemExit) as stop:
        cli.main()
    return int(stop.value.code or 0)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return Path(shutil.copytree(problems_folder() / "paper_arm", tmp_path / "arm"))


def test_calibrate_prints_the_tables_and_writes_the_result(monkeypatch, capsys, tmp_path) -> None:
    assert run(monkeypatch, "calibrate", "paper_arm", "--out", str(tmp_path)) == 0
    out = capsys.readouterr().out
    for expected in (
        "\nDelivered: the fit gives no reason against using this robot; no acceptance limit is stated. On 16",
        "0.0319",
        "2.6489",
        "published: RPIM",
        "0.468",
        "corner of the L-curve",
        "beta4",
    ):
        assert expected in out
    result = json.loads((tmp_path / "result.json").read_text())
    assert set(result) >= KEYS
    assert result["converged"] is True
    assert result["validation"]["count"] == 16
    assert result["validation"]["mean_mm"] <= 0.033
    assert result["nominal"]["validation"]["mean_mm"] == pytest.approx(2.6489, abs=1e-3)
    d5 = next(p for p in result["parameters"] if p["name"] == "d5")
    assert set(d5) == {"name", "unit", "nominal", "identified", "deviation", "std"}
    assert (d5["unit"], d5["nominal"]) == ("mm", pytest.approx(93.16))
    assert d5["identified"] - d5["nominal"] == pytest.approx(d5["deviation"])
    assert [p.name for p in tmp_path.iterdir()] == ["result.json"]


class Terminal(StringIO):
    """What a terminal receives."""

    def isatty(self) -> bool:
        return True


def test_a_terminal_gets_whole_words(monkeypatch, capsys) -> None:
    """Sentences are broken between words at the terminal's width; tables and all words are those of the piped text."""
    assert run(monkeypatch, "inspect", "paper_arm") == 0
    piped = capsys.readouterr().out
    monkeypatch.setenv("COLUMNS", "60")
    monkeypatch.setattr("sys.stdout", terminal := Terminal())
    assert run(monkeypatch, "inspect", "paper_arm") == 0
    shown = terminal.getvalue()
    assert shown.split() == piped.split()
    tables = [line for line in piped.splitlines() if "  " in line]
    assert tables == [line for line in shown.splitlines() if "  " in line]
    assert all(len(line) <= 60 for line in shown.splitlines() if "  " not in line)
    assert any(len(line) > 60 for line in piped.splitlines() if "  " not in line)


def test_a_weight_can_be_given(monkeypatch, capsys) -> None:
    assert run(monkeypatch, "calibrate", "paper_arm", "--selector", "0.5") == 0
    assert "Weight 0.5 (given)" in capsys.readouterr().out


def edit(path: Path, old: str, new: str, count: int = 1) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, count))


CSV, TOML, ROBOT = "identification.csv", "problem.toml", "robot.toml"
BAD = {
    "missing table": (CSV, None, None, ["identification.csv", "the file: found nothing"]),
    "missing problem file": (TOML, None, None, ["problem.toml", "found nothing"]),
    "missing robot file": (ROBOT, None, None, ["robot.toml", "found nothing"]),
    "unknown key": (
        TOML,
        'measurement = "position"',
        'measurment = "position"',
        ["problem.toml", "measurment", "mean measurement"],
    ),
    "unknown key in a table": (
        TOML,
        "length_mm = 1.0",
        "lenght_mm = 1.0",
        ["problem.toml", "scale", "lenght_mm", "length_mm"],
    ),
    "key without unit": (
        TOML,
        "position_mm = 0.03",
        "position = 0.03",
        ["problem.toml", "noise", "position_mm"],
    ),
    "key in a wrong unit": (ROBOT, "d_mm = 99.927", "d_deg = 99.927", ["robot.toml", "joint 1.d_deg", "d_m"]),
    "unknown joint key": (ROBOT, "d_mm = 99.927", "dd_mm = 99.927", ["robot.toml", "joint 1", "dd_mm"]),
    "text for a number in the robot": (
        ROBOT,
        "d_mm = 99.927",
        'd_mm = "long"',
        ["robot.toml", "joint 1.d_mm", "'long'"],
    ),
    "infinite robot": (ROBOT, "d_mm = 99.927", "d_mm = inf", ["robot.toml", "joint 1.d_mm", "finite"]),
    "wrong type": (
        TOML,
        'identify = ["alpha?", "a?", "d?", "theta?", "beta[34]"]',
        'identify = "a?"',
        ["problem.toml", "identify", "list"],
    ),
    "missing key": (
        TOML,
        'identification = "identification.csv"',
        "",
        ["problem.toml", "key identification", "found nothing"],
    ),
    "no TOML": (TOML, "[noise]", "[noise", ["problem.toml", "TOML"]),
    "unknown pattern": (TOML, '"alpha?"', '"alfa?"', ["problem.toml", "'alfa?'", "did you mean alpha?"]),
    "unknown formulation": (
        TOML,
        'formulation = "tikhonov"',
        'formulation = "tichonov"',
        ["'tichonov'", "mean tikhonov"],
    ),
    "unknown selector": (
        TOML,
        'selector = "l_curve"',
        'selector = "lcurve"',
        ["'lcurve'", "a number", "l_curve"],
    ),
    "unknown measurement": (TOML, 'measurement = "position"', 'measurement = "posn"', ["'posn'", "position"]),
    "unknown excluded row": (TOML, "T8-6 =", "T8-66 =", ["problem.toml", "exclude", "T8-66"]),
    "negative noise": (TOML, "position_mm = 0.03", "position_mm = -0.03", ["problem.toml", "noise", "> 0"]),
    "zero scale": (TOML, "length_mm = 1.0", "length_mm = 0", ["scale", "greater than zero"]),
    "missing column": (CSV, "z_mm", "sigma_mm", ["identification.csv", "no column for 'z'", "z_mm"]),
    "column without unit": (CSV, "z_mm", "z", ["identification.csv", "column 'z' without a unit", "z_mm"]),
    "column in a wrong unit": (CSV, "q1_deg", "q1_mm", ["identification.csv", "'q1_mm'", "q1_deg"]),
    "unknown column": (CSV, "z_mm", "zz_mm", ["identification.csv", "'zz_mm'", "z_m"]),
    "column twice": (CSV, "z_mm", "y_mm", ["identification.csv", "'y_mm' twice"]),
    "not a number": (
        CSV,
        "228.695",
        "nan",
        ["identification.csv", "row T2-1, column x_mm", "'nan'", "finite"],
    ),
    "infinite": (CSV, "228.695", "inf", ["row T2-1, column x_mm", "'inf'", "finite"]),
    "text": (CSV, "228.695", "wide", ["row T2-1, column x_mm", "'wide'", "a finite number"]),
    "decimal comma": (CSV, "228.695", '"228,695"', ["row T2-1, column x_mm", "'228,695'"]),
    "empty cell": (CSV, "228.695", "", ["row T2-1, column x_mm", "''"]),
    "ragged row": (CSV, "228.695,", "", ["row 1 (T2-1)", "9 cells", "10 cells"]),
    "label twice": (CSV, "T2-2", "T2-1", ["row 2, column label", "'T2-1'"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_sentence_and_nothing_is_written(monkeypatch, capsys, folder, case) -> None:
    file, old, new, expected = BAD[case]
    if old is None:
        (folder / file).unlink()
    else:
        edit(folder / file, old, new)
    out = folder / "out"
    assert run(monkeypatch, "calibrate", str(folder), "--out", str(out)) == 2
    said = capsys.readouterr()
    assert not out.exists()
    assert said.out == ""
    assert "Traceback" not in said.err
    assert said.err.strip().endswith(".")
    assert "found" in said.err
    assert "accepted" in said.err
    for part in expected:
        assert part in said.err, said.err


@pytest.mark.parametrize(("text", "found"), [("", "an empty file"), ("label,q1_deg\n", "a header and no rows")])
def test_empty_tables(monkeypatch, capsys, folder, text, found) -> None:
    (folder / CSV).write_text(text)
    assert run(monkeypatch, "calibrate", str(folder)) == 2
    assert found in capsys.readouterr().err


def test_unknown_names_on_the_command_line(monkeypatch, capsys) -> None:
    assert run(monkeypatch, "calibrate", "papr_arm") == 2
    assert "paper_arm" in capsys.readouterr().err
    assert run(monkeypatch, "calibrate", "paper_arm", "--variant", "swapp") == 2
    assert "did you mean swap?" in capsys.readouterr().err
    assert run(monkeypatch, "calibrate", "paper_arm", "--selector", "-1") == 2
    assert "zero or more" in capsys.readouterr().err


def test_fewer_equations_than_needed(monkeypatch, capsys, folder) -> None:
    lines = (folder / CSV).read_text().splitlines()
    (folder / CSV).write_text("\n".join(lines[:5]))
    edit(folder / TOML, 'formulation = "tikhonov"', 'formulation = "least_squares"')
    assert run(monkeypatch, "calibrate", str(folder), "--selector", "0") == 2
    assert "12 equations for 26 parameters" in capsys.readouterr().err


def no_luck(*_: object, **__: object) -> None:
    raise Unsolved("out of luck")


def test_a_solver_failure_writes_nothing(monkeypatch, capsys, folder) -> None:
    monkeypatch.setattr("rpim_opt.convex.program.minimum", no_luck)
    monkeypatch.setattr("cvxpy.Problem.solve", no_luck)
    out = folder / "out"
    assert run(monkeypatch, "calibrate", str(folder), "--formulation", "minimax", "--out", str(out)) == 3
    assert "out of luck" in capsys.readouterr().err
    assert not out.exists()


def test_an_unwritable_result_leaves_the_old_one(monkeypatch, capsys, folder) -> None:
    (folder / "out").write_text("a file where the folder should be")
    assert run(monkeypatch, "calibrate", str(folder), "--out", str(folder / "out")) == 2
    assert "cannot be written" in capsys.readouterr().err
    assert (folder / "out").read_text() == "a file where the folder should be"


def test_the_list_of_commands_says_each_first_line_whole(monkeypatch, capsys) -> None:
    """On a terminal of 80 columns a line that is too long is wrapped, and never cut."""
    monkeypatch.setenv("COLUMNS", "80")
    run(monkeypatch, "--help")
    said = capsys.readouterr().out
    assert max(map(len, said.splitlines())) <= 80
    words = " ".join(said.partition("Commands:")[2].split())
    for command in cli.app.registered_commands:
        first = command.callback.__doc__.partition("\n\n")[0]
        assert f"{command.callback.__name__} {' '.join(first.split())}" in words


@pytest.mark.parametrize(
    ("words", "incomplete", "value"),
    [
        ("rpim-opt calibrate", "pos", "position"),
        ("rpim-opt calibrate --selector", "re", "reml"),
        ("rpim-opt calibrate --formulation", "rob", "robust"),
        ("rpim-opt new --robot", "ur5", "ur5e"),
    ],
)
def test_a_shell_completes_the_values_of_options(words: str, incomplete: str, value: str) -> None:
    """As bash asks after a tab."""
    count = len(words.split())
    asked = {"_RPIM_OPT_COMPLETE": "complete_bash", "COMP_WORDS": f"{words} {incomplete}", "COMP_CWORD": str(count)}
    command = [sys.executable, "-c", "from rpim_opt.cli import app; app(prog_name='rpim-opt')"]
    done = subprocess.run(command, env=os.environ | asked, capture_output=True, text=True, timeout=60, check=False)
    assert value in done.stdout.split()
