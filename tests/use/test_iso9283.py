"""AP and RP against numbers computed by hand, and tables as they are exported."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro
from tests.test_cli import run

# Four approaches around (0, 0, 0.2) mm: distances 0.1, 0.1, 0.3, 0.3 from the barycentre, mean 0.2,
# S_l = sqrt(4 * 0.1^2 / 3) = 0.115470, RP_l = 0.2 + 3 * 0.115470 = 0.546410; AP_p from (0, 0, 0) is 0.2.
CROSS = 1e-3 * np.array([[0.1, 0.0, 0.2], [-0.1, 0.0, 0.2], [0.0, 0.3, 0.2], [0.0, -0.3, 0.2]])


def test_a_cross_by_hand() -> None:
    found = ro.use.iso9283(["P1"] * 4, CROSS, np.zeros((4, 3))).poses[0]
    expected = {"AP_p_mm": 0.2, "AP_x_mm": 0.0, "AP_y_mm": 0.0, "AP_z_mm": 0.2, "RP_l_mm": 0.5464101615}
    assert found == pytest.approx({"pose": "P1", "cycles": 4, **expected})


def test_angles_by_hand_across_half_a_turn() -> None:
    # about a: 1, 2, 3 mrad, mean 2, S = 1; about c: 3.140 and twice the same turned on by 4 mrad, across pi
    c = np.array([3.140, 3.144 - 2 * np.pi, 3.144 - 2 * np.pi])
    angles = np.column_stack([[0.001, 0.002, 0.003], np.zeros(3), c])
    commands = np.tile([0.0, 0.0, 3.141], (3, 1))
    found = ro.use.iso9283(["P"] * 3, np.zeros((3, 3)), None, angles, commands).poses[0]
    for kind, expected in {"RP": [3.0, 0.0, 3 * 4 / np.sqrt(3)], "AP": [2.0, 0.0, -1.0 + 8 / 3]}.items():
        assert [found[f"{kind}_{angle}_mrad"] for angle in "abc"] == pytest.approx(expected, abs=1e-9)
    assert found["AP_p_mm"] is None
    assert found["RP_l_mm"] == 0.0


def test_a_moved_or_turned_frame_changes_no_repeatability() -> None:
    rng = np.random.default_rng(0)
    reached = rng.normal(size=(30, 3))
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    plain, other = (ro.use.iso9283(["P"] * 30, each) for each in (reached, reached @ turn.T + 5.0))
    assert plain.repeatability == pytest.approx(other.repeatability, rel=1e-12)


def test_what_the_standard_asks_for_is_said_where_it_is_not_there() -> None:
    rng = np.random.default_rng(0)
    poses = [f"P{k}" for k in range(5) for _ in range(30)]
    whole = ro.use.iso9283(poses, rng.normal(size=(150, 3)), np.zeros((150, 3)))
    assert whole.content()["notes"] == []
    few = ro.use.iso9283(poses[:62], rng.normal(size=(62, 3)))
    assert few.content()["notes"] == [
        "The standard requires 5 poses, 30 approaches each: the table has 3 poses, with at least 2 approaches each.",
        "No commanded poses are known: repeatability is computed, accuracy is not.",
    ]
    assert few.accuracy is None
    assert 1e3 * whole.accuracy == pytest.approx(max(each["AP_p_mm"] for each in whole.poses))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((["P1", "P2", "P2"], np.zeros((3, 3))), "pose 'P1': found one approach"),
        ((["P1", "P1"], np.zeros((3, 3))), "shape"),
        ((["P1", "P1"], np.full((2, 3), np.nan)), "finite"),
        ((["P1", "P1"], np.zeros((2, 3)), np.arange(6.0).reshape(2, 3)), "more than one position"),
        ((["P1", "P1"], np.array([[0.0, 0, 0], [0, -1e308, 0]])), "positions, row 2: .* at most 1e"),
        (([], np.zeros((0, 3))), "no approach"),
    ],
)
def test_what_is_no_set_of_approaches_is_refused(arguments, said: str) -> None:
    with pytest.raises(ro.InputError, match=said):
        ro.use.iso9283(*arguments)


HEAD = "Pose;Cycle;Nominal X [mm];Nominal Y [mm];Nominal Z [mm];X [mm];Y [mm];Z [mm];Rx [deg];Ry [deg];Rz [deg]"


def written(folder: Path, head: str = HEAD) -> Path:
    rows = [f"P1;{k + 1};0;0;0;{x:.1f};{y:.1f};{z:.1f};0,1;0;{k}" for k, (x, y, z) in enumerate(1e3 * CROSS)]
    file = folder / "approaches.csv"
    file.write_text("\n".join([head, *(row.replace(".", ",") for row in rows)]))
    return file


def test_a_table_as_it_is_exported(monkeypatch, capsys, tmp_path) -> None:
    file = str(written(tmp_path))
    out = tmp_path / "out.csv"
    assert run(monkeypatch, "iso9283", file, "--json", "--out", str(out)) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["accuracy_mm"] == pytest.approx(0.2)
    assert document["repeatability_mm"] == pytest.approx(0.5464101615)
    row = document["poses"][0]
    assert row["RP_rz_mrad"] == pytest.approx(1e3 * np.radians(3 * np.std([0, 1, 2, 3], ddof=1)))
    assert row["AP_rz_mrad"] is None
    assert out.read_text().startswith("pose,cycles,AP_p_mm")
    assert run(monkeypatch, "iso9283", file, "--limit", "0.3", "--repeatability", "0.5") == 1
    text = capsys.readouterr().out
    assert "Largest AP_p: 0.2000 mm, within the limit of 0.3 mm." in text
    assert "Largest RP_l: 0.5464 mm, above the limit of 0.5 mm." in text
    assert "ISO 9283:1998, 7.2.1 (AP) and 7.2.2 (RP)." in text


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("Pose", "Note", "the header"),
        ("X [mm];Y [mm];Z [mm];Rx", "X [mm];Y [mm];Q;Rx", "the header"),
        (";X [mm]", ";X", "without a unit of length"),
        ("Nominal Z [mm]", "Note", "no column for z"),
    ],
)
def test_a_table_that_lacks_something_is_refused(monkeypatch, capsys, tmp_path, old: str, new: str, said: str) -> None:
    assert run(monkeypatch, "iso9283", str(written(tmp_path, HEAD.replace(old, new)))) == 2
    assert said in capsys.readouterr().err


def test_a_cell_that_is_no_position_is_refused(monkeypatch, capsys, tmp_path) -> None:
    file = written(tmp_path)
    file.write_text(file.read_text().replace(";0,1;0;0", ";0,1;0;-1e308"))
    assert run(monkeypatch, "iso9283", str(file)) == 2
    assert "at most 1e+07" in capsys.readouterr().err


def test_a_limit_needs_a_command(monkeypatch, capsys, tmp_path) -> None:
    head = HEAD.replace("Nominal X [mm];Nominal Y [mm];Nominal Z [mm]", "A1;A2;A3")
    assert run(monkeypatch, "iso9283", str(written(tmp_path, head)), "--limit", "1") == 2
    assert "without commands" in capsys.readouterr().err
