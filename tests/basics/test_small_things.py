"""Tables of notebooks, files that grow, optima at ends, and quantities that are stated twice."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

import rpim_opt as ro
from rpim_opt.basics.files import read_bytes
from rpim_opt.basics.text import LONGEST, Tabled, shortened, table
from rpim_opt.basics.units import UNITS, split_unit
from rpim_opt.robot import write_robot
from tests.simulate import ARM


def test_a_table_has_no_column_without_a_value_and_blanks_where_one_lacks() -> None:
    parameters = ro.load("position").problem.parameters
    html = parameters._repr_html_()
    assert "tolerance" not in html
    assert "more rows." in html
    some = parameters.toleranced({"length_mm": 0.5})._repr_html_()
    assert "tolerance" in some
    assert "None" not in some + html


def test_a_unit_is_what_its_name_says() -> None:
    sizes = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "cm": 1e-2, "in": 0.0254, "rad": 1.0, "mrad": 1e-3, "urad": 1e-6,
             "deg": math.pi / 180, "gon": math.pi / 200, "Nm": 1.0, "N": 1.0, "kg": 1.0, "K": 1.0, "degC": 1.0,
             "ppm": 1e-6, "px": 1.0}  # fmt: skip
    for name, unit in UNITS.items():
        above, _, below = name.partition("_per_")
        size = math.prod(sizes[part.removesuffix("2")] ** (1 + part.endswith("2")) for part in above.split("_"))
        assert unit.si == pytest.approx(size / sizes[below or "m"], rel=1e-14)
        assert (split_unit(f"x_{name}"), split_unit(f"x__{name}")) == (("x", unit), ("x_", unit))


def test_a_long_title_is_cut() -> None:
    assert shortened("x" * LONGEST) == "x" * LONGEST
    cut = shortened("x" * LONGEST + "y")
    assert len(cut) == LONGEST
    assert cut.endswith("x...")


def test_a_file_that_states_no_size_is_read_no_further_than_it_may_be() -> None:
    endless = Path("/proc/self/status")  # of zero bytes, says the system
    if not endless.is_file():
        pytest.skip("no such files on this system")
    with pytest.raises(ro.InputError, match="more than 10 bytes"):
        read_bytes(endless, 10)
    assert read_bytes(endless)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("theta_deg", "theta_rad = 0.1\ntheta_deg", "theta twice, in two units, accepted: one of them"),
        ('type = "revolute"', 'type = "revolute"\nlimits_deg = [10, -10]', "[lower, upper]"),
        ('type = "revolute"', 'type = "revolute"\nlimits_deg = [10]', "[lower, upper]"),
    ],
)
def test_a_robot_whose_joints_say_two_things(tmp_path: Path, old: str, new: str, said: str) -> None:
    path = tmp_path / "robot.toml"
    write_robot(ARM, path)
    text = path.read_text()
    if old not in text:
        text = text.replace("[[joint]]\n", f"[[joint]]\n{old}{' = 0.0' if '=' not in old else ''}\n", 1)
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ro.InputError) as error:
        ro.read_robot(path)
    assert said in str(error.value)


def test_texts_in_notebook_tables_stay_as_they_are() -> None:
    class Rows(Tabled):
        def _frame_rows(self) -> list[dict[str, object]]:
            return [{"label": "True", "value": True}, {"label": "None", "value": None}]

        def _short(self) -> str:
            return "rows"

    shown = Rows()._repr_html_()
    assert '<th scope="row">True</th><td>yes</td>' in shown
    assert '<th scope="row">None</th><td></td>' in shown


def test_a_table_is_a_text_in_a_notebook_too(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = table(["name", "mm"], [["a2", "1.5"]])
    assert "a2" in plain
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)  # there rich shows what it is to print
    assert table(["name", "mm"], [["a2", "1.5"]]) == plain
