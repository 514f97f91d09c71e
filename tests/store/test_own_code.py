"""A measurement type and a term in a Python file of the problem's folder, which run only where that is allowed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.robot import forward_kinematics, write_robot
from tests.simulate import ARM
from tests.test_cli import run

MINE = '''
"""A gauge that reads heights, and the droop of a link."""

from pathlib import Path

import rpim_opt as ro

height = ro.data.Measurement(
    "height", model=lambda T: T[2, 3], columns={"height": "length"}, noise={"height": "length"}
)
creep = ro.robot.Term(
    lambda base, rate: [0, 0, rate * base.column("hours"), 0, 0, 0],
    {"creep_um": 50},
    at="base",
    columns={"hours": ""},
)
Path(__file__).with_name("ran").touch()
'''
PROBLEM = """
title = "Heights"
measurement = "mine:height"
terms = ["mine:creep"]
identification = "heights.csv"
identify = ["theta[2-5]", "creep"]
selector = "1"
[noise]
height_mm = 0.01
"""
RATE = 0.03
"""mm an hour."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = np.random.default_rng(5)
    q = rng.uniform(-2, 2, (60, 6))
    hours = np.linspace(0, 8, 60)
    z = 1e3 * forward_kinematics(ARM, q)[:, 2, 3] + RATE * hours + 0.01 * rng.normal(size=60)
    rows = [
        ",".join([f"P{i}", *map(str, np.degrees(row)), str(hour), str(height)])
        for i, (row, hour, height) in enumerate(zip(q, hours, z, strict=True))
    ]
    header = ",".join(["label", *(f"q{i}_deg" for i in range(1, 7)), "hours", "height_mm"])
    (tmp_path / "heights.csv").write_text("\n".join([header, *rows]))
    (tmp_path / "problem.toml").write_text(PROBLEM)
    (tmp_path / "mine.py").write_text(MINE)
    write_robot(ARM, tmp_path / "robot.toml")
    return tmp_path


@pytest.mark.usefixtures("undrawn")
def test_code_of_a_folder_runs_only_where_it_is_allowed(folder: Path, monkeypatch, capsys) -> None:
    here = str(folder)
    assert run(monkeypatch, "calibrate", here) == 2
    refused = capsys.readouterr().err
    assert "'mine:height', code of mine.py, accepted" in refused
    assert "--allow-code" in refused
    assert not (folder / "ran").exists()
    assert run(monkeypatch, "calibrate", here, "--allow-code", "--out", here, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    creep = next(each for each in found["parameters"] if each["name"] == "creep")
    assert creep["identified"] == pytest.approx(RATE, rel=0.03)  # 0.01 mm of noise, 60 rows over eight hours

    assert run(monkeypatch, "inspect", here, "--allow-code") == 0
    assert run(monkeypatch, "report", here) == 2
    assert "--allow-code" in capsys.readouterr().err
    assert run(monkeypatch, "report", here, "--allow-code") == 0
    with pytest.raises(ro.InputError, match="allow_code"):
        ro.load(folder)
    with ro.store.allow_code():
        again = ro.load_result(folder)
        assert np.abs(again.x - ro.load(folder).calibrate().x).max() < 1e-12
    with pytest.raises(ro.InputError, match="allow_code"):
        ro.load_result(folder)


@pytest.mark.parametrize(
    ("text", "stated", "said"),
    [
        ("height = 3\n", "mine:height", "height = 3, accepted: a Measurement of that name"),
        ("1 / 0\n", "mine:height", "ZeroDivisionError: division by zero"),
        (MINE, "other:height", "no file other.py"),
        (MINE, "../mine:height", "the name of a file in the folder"),
        (MINE, "mine:width", "width = None, accepted: a Measurement"),
        ("raise SystemExit('bye')", "mine:height", "SystemExit: bye"),
    ],
)
def test_what_is_wrong_with_own_code_is_one_sentence(folder: Path, text: str, stated: str, said: str) -> None:
    (folder / "mine.py").write_text(text)
    (folder / "problem.toml").write_text(PROBLEM.replace("mine:height", stated))
    with ro.store.allow_code(), pytest.raises(ro.InputError) as refused:
        ro.load(folder)
    assert said in str(refused.value)


def test_other_keys_of_that_name_are_no_code(folder: Path) -> None:
    text = PROBLEM.replace("mine:height", "position").replace('terms = ["mine:creep"]\n', "")
    (folder / "problem.toml").write_text(text + '[record]\nmeasurement = "Leica: room 2"\n')
    with pytest.raises(ro.InputError) as refused:
        ro.load(folder)
    assert "code of" not in str(refused.value)


def test_a_file_may_have_data_classes(folder: Path) -> None:
    head = "from __future__ import annotations\nfrom dataclasses import dataclass\n"
    (folder / "mine.py").write_text(head + MINE + "\n@dataclass\nclass Gauge:\n    length: float\n")
    with ro.store.allow_code():
        assert ro.load(folder).problem.data.blocks[0].measurement.name == "mine:height"
