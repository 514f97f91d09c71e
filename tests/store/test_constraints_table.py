"""``stated`` in a problem file: ten constraints of a drawing, places, what says their cost, what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
from typer.testing import CliRunner

import rpim_opt as ro
from rpim_opt.basics import InputError
from rpim_opt.cli import app
from rpim_opt.convex.constraints import Parsed
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
    """True statements about it: the ten of the variant, against nothing besides the data."""
    plain, drawn = ro.load("constrained"), ro.load("constrained", "drawing")
    before, after = plain.calibrate(), drawn.calibrate()
    assert len(after.shadow_prices) == 10
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


def test_constraints_of_a_folder_hold_beside_every_ready_formulation(folder: Path) -> None:
    """As ``calibrate --formulation`` names it; a formulation of a script is taken as it is."""
    stating(
        folder, '\n[variant.held.constraints]\nat_nominal = ["a3", "d5"]\n[variant.held.tolerance]\nlength_mm = 5\n'
    )
    instance = ro.load(folder, "held")
    free = instance.problem.parameters.free
    k = [free.names.index(name) for name in ("a3", "d5")]
    for name in ("tikhonov", "lasso", "bounded"):
        assert instance.calibrate(formulation=name, weight=1.0).x[k] == pytest.approx(0, abs=1e-12)
    assert np.abs(instance.calibrate(formulation=ro.lasso, weight=1.0).x[k]).max() > 1e-5
    (own,) = instance.constraints
    assert ro.load(folder).constraints == ()
    bounded = ro.load(folder, "held").calibrate(formulation="bounded", weight=1.0).formulation
    assert bounded.constraints == (*ro.bounded.constraints, own)


def test_places_are_joint_values_boxes_and_rows(folder: Path) -> None:
    stating(
        folder,
        """
[variant.places.constraints]
stated = ["move at most 9 mm: one, two, three, four, measured"]
[variant.places.constraints.places]
one = { q_deg = [[0, 0, 90, 0, 90, 0], [0, 0, 90, 0, 80, 0]] }
two = { q1_deg = 0, q2_rad = 0, q3_deg = 90, q4_deg = 0, q5_deg = 90, q6_deg = 0 }
three = { rows = ["c1", "c3"] }
four = { x_mm = [400, 500], y_m = [-0.3, 0.3], z_mm = [-200, 200] }
""",
    )
    instance = ro.load(folder, "places")
    (demand,) = instance.formulation.constraints
    assert isinstance(demand, Parsed)
    where = {place.name: np.array(place.numbers) for place in demand.where}
    assert np.allclose(where["one"], np.radians([[0, 0, 90, 0, 90, 0], [0, 0, 90, 0, 80, 0]]))
    assert np.allclose(where["two"], where["one"][:1])
    assert where["three"].shape == (2, 6)
    assert np.allclose(where["four"], [[0.4, 0.5], [-0.3, 0.3], [-0.2, 0.2]])
    assert len(where["measured"]) == 14


@pytest.mark.parametrize(
    ("table", "found"),
    [
        ('stated = ["a3 = 425 kg"]', "unit 'kg'"),
        ('stated = ["a3 = 425 deg"]', "unit deg"),
        ('stated = ["a3 = 425 m"]', "violate by 424.6 m"),
        ('stated = ["a33 = 425 mm"]', "'a33'"),
        ('stated = "a3 = 425 mm"', "'a3 = 425 mm'"),
        ("stated = [3]", "3"),
        ('stated = ["move at most 3 mm: nowhere"]', "place 'nowhere'"),
        ("places.measured = { q_deg = [0, 0, 0, 0, 0, 0] }", "a predefined place"),
        ("places.here = { q_deg = [0, 0, 0] }", "3 joint values"),
        ("places.here = { q_mm = [0, 0, 0] }", "no unit of the right dimension"),
        ("places.here = { q_deg = [[0, 0], [0]] }", "lists of different lengths"),
        ("places.here = { x_mm = [0, 1] }", "x_mm"),
        ("places.here = { }", "nothing"),
        ('places.here = { rows = ["c99"] }', "'c99'"),
        ("places.here = { rows = [], q_deg = 0 }", "rows and other keys"),
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
