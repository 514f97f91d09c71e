"""A measurement type, a table format and a rule of a stranger's, each in one file that every command finds."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rpim_opt.robot import forward_kinematics, write_robot
from tests import ROOT
from tests.simulate import ARM
from tests.store.instrument_files import INSTRUMENTS
from tests.store.raw_files import off_its_drawing

HEIGHT = '''
"""A gauge that reads heights alone."""

from rpim_opt.data.measurements.measurement import Measurement, Words

height = Measurement(
    "height",
    model=lambda T: T[2, 3],
    columns={"height": "length"},
    noise={"height": "length"},
    words=Words(target="a stylus", noise_of="a dial gauge", columns={"height": "height that the gauge reads"}),
)
TYPES = (height,)
'''
MELFA = '''
"""Joint variables of Mitsubishi's MELFA, ``J1=(+10.00,-20.00,...)`` in degrees."""

import re

from rpim_opt.data.tables.formats.registry import TableFormat

JOINTS = re.compile(r"^(J\\d+)=\\(([^)]*)\\)", re.MULTILINE)


def read(text):
    return [
        {"label": name, **{f"J{i} [deg]": value for i, value in enumerate(values.split(",")[:6], start=1)}}
        for name, values in JOINTS.findall(text)
    ]


FORMATS = (TableFormat("MELFA variables", (".prg",), read),)
'''
UNIT = '''
"""The weight that stated noise and scales are for."""

import numpy as np

from rpim_opt.convex.rules.selection import choice, on_inliers, weight_grid


@on_inliers
def unit(program):
    weights = weight_grid(program)
    far = np.abs(np.log(weights))
    return choice("unit", weights, far, int(np.argmin(far)), "nearest to one")


RULES = (unit,)
'''
COUNT = 80
NOISE = 0.01
"""[mm]"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package with the file, a robot, and a raw table of readings."""
    place = tmp_path_factory.mktemp("own")
    shutil.copytree(ROOT / "rpim_opt", place / "rpim_opt", ignore=shutil.ignore_patterns("__pycache__"))
    (place / "rpim_opt" / "data" / "measurements" / "height.py").write_text(HEIGHT)
    (place / "rpim_opt" / "data" / "tables" / "formats" / "melfa.py").write_text(MELFA)
    (place / "rpim_opt" / "convex" / "rules" / "unit.py").write_text(UNIT)
    write_robot(ARM, place / "robot.toml")
    rng = np.random.default_rng(3)
    q = rng.uniform(-120, 120, (COUNT, 6)).round(4)
    z = 1e3 * forward_kinematics(off_its_drawing(rng), np.radians(q))[:, 2, 3] + NOISE * rng.normal(size=COUNT)
    lines = ["Point;" + ";".join(f"J{i} [deg]" for i in range(1, 7)) + ";Height [mm]"]
    lines += [
        ";".join([f"P{i}", *map(str, row), f"{reading:.4f}"]) for i, (row, reading) in enumerate(zip(q, z, strict=True))
    ]
    (place / "raw.csv").write_text("\n".join(lines))
    return place


SCRIPT = """
import json, sys
from rpim_opt.cli import main
for words in json.loads(sys.argv[1]):
    sys.argv = ["rpim-opt", *words]
    try:
        main()
    except SystemExit as end:
        assert not end.code, words
    print("\\f")
"""


def said(place: Path, *commands: list[str]) -> list[str]:
    """Return what commands of the copy print, one after the other in one process."""
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, json.dumps(commands)],
        cwd=place,
        env={**os.environ, "PYTHONPATH": str(place)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split("\f\n")[:-1]


def test_from_a_raw_table_to_a_validated_robot(place: Path) -> None:
    table = ["--robot", "robot.toml", "--data", "raw.csv", "--measurement", "height", "--hold-out", "0.25"]
    calibrate, validate = ["calibrate", "cell", "--out", "out"], ["validate", "out", "cell/validation.csv", "--json"]
    made, _, validated = said(place, ["new", "cell", *table], calibrate, validate)
    assert "height that the gauge reads" in made
    assert "a dial gauge" in (place / "cell" / "problem.toml").read_text()
    found = json.loads(validated)
    assert found["identified"]["rms_mm"] < 3 * NOISE
    assert found["identified"]["rms_mm"] < 0.1 * found["nominal"]["rms_mm"]


def test_a_controllers_variables_beside_a_table_of_points(place: Path) -> None:
    write, options, _ = INSTRUMENTS["MELFA joint variables"]
    files = [part for file in write(place) for part in ("--data", file.name)]
    stated = [part for name, value in options.items() for part in (f"--{name}", value)]
    (made,) = said(place, ["new", "melfa", "--robot", "robot.toml", *files, *stated, "--json"])
    assert json.loads(made)["rows"] == 36


def test_a_rule_chooses_the_weight_by_its_name(place: Path) -> None:
    arm = str(ROOT / "problems" / "paper_arm")
    (calibrated,) = said(place, ["calibrate", arm, "--selector", "unit", "--json"])
    assert json.loads(calibrated)["selector"] == "unit"
    assert "(unit: nearest to one)" in calibrated
