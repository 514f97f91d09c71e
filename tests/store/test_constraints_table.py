"""``stated`` in a problem file: eight constraints of a drawing, what says their cost, what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from shutil import copytree

import pytest
from typer.testing import CliRunner

import rpim_opt as ro
from rpim_opt.basics.exceptions import InputError
from rpim_opt.cli import app
from tests import ROOT


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    copytree(ROOT / "problems" / "constrained", tmp_path / "arm")
    return tmp_path / "arm"


def stating(folder: Path, text: str) -> Path:
    """Append tables to the problem file."""
    file = folder / "problem.toml"
    file.write_text(file.read_text(encoding="utf-8") + text, encoding="utf-8")
    return folder


@pytest.mark.slow
def test_a_drawing_makes_the_arm_better() -> None:
    """True statements about it: the eight of the variant, against nothing besides the data."""
    plain, drawn = ro.load("constrained"), ro.load("constrained", "drawing")
    before, after = plain.calibrate(), drawn.calibrate()
    assert len(after.shadow_prices) == 8
    assert before.converged
    assert after.converged
    assert after.errors(drawn.validation).mean() < 0.85 * before.errors(plain.validation).mean()


@pytest.mark.slow
def test_reports_say_what_statements_cost(tmp_path: Path) -> None:
    out = tmp_path / "out"
    said = CliRunner().invoke(app, ["calibrate", "constrained", "--variant", "drawing", "--out", str(out), "--json"])
    assert said.exit_code == 0, said.output
    printed = json.loads(said.stdout)
    result = ro.load_result(out)
    prices = json.loads((out / "result.json").read_text(encoding="utf-8"))["shadow_prices"]
    assert [price["text"] for price in prices] == [price.text for price in result.shadow_prices]
    assert [price["multiplier"] for price in printed["shadow_prices"]] == [price["multiplier"] for price in prices]
    sentence = next(price for price in result.shadow_prices if price.holds).sentence()
    assert "would lower the objective by" in sentence
    assert sentence in printed["remarks"]
    assert sentence in str(result)


@pytest.mark.parametrize(
    ("table", "found"),
    [
        ('stated = ["a3 = 425 kg"]', "unit 'kg'"),
        ('stated = ["a3 = 425 deg"]', "unit deg"),
        ('stated = ["a3 = 425 m"]', "violate by 424.6 m"),
        ('stated = ["a33 = 425 mm"]', "'a33'"),
        ('stated = "a3 = 425 mm"', "'a3 = 425 mm'"),
        ("stated = [3]", "3"),
    ],
)
def test_a_table_that_does_not_fit_is_refused(folder: Path, table: str, found: str) -> None:
    stating(folder, f"\n[variant.wrong.constraints]\n{table}\n")
    with pytest.raises(InputError) as error:
        ro.load(folder, "wrong")
    assert found in error.value.found
    assert str(folder) in str(error.value)


def test_a_contradiction_is_named(folder: Path) -> None:
    stating(folder, '\n[variant.no.constraints]\nstated = ["a3 = 425 mm", "a3 >= 426 mm", "a5 <= 0 mm"]\n')
    with pytest.raises(ro.NoSolutionFound) as error:
        ro.load(folder, "no").calibrate()
    assert "these constraints contradict each other: 'a3 = 425 mm', 'a3 >= 426 mm'" in str(error.value)
    assert "a5" not in str(error.value)
