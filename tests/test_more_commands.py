"""Options of commands that others do not try."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from tests.test_cli import run


def test_what_is_measured_already_counts_in_a_design(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    asked = ["design", "position", "--count", "4", "--candidates", "20", "--criterion", "D", "--json"]
    values = []
    for more in ([], ["--augment"]):
        assert run(monkeypatch, *asked, *more) == 0
        values.append(json.loads(capsys.readouterr().out))
    assert values[0] != values[1]
    q = np.degrees(ro.load("position").problem.data.q)
    new = np.column_stack([np.array(values[1]["configurations"][f"q{i}_deg"], dtype=float) for i in range(1, 7)])
    assert (new >= q.min(axis=0) - 1e-3).all()
    assert (new <= q.max(axis=0) + 1e-3).all()
    assert run(monkeypatch, *asked[:-1], "--augment") == 0
    assert "calibrate all tables together (`new FOLDER --data OLD --data NEW`)" in capsys.readouterr().out


def test_a_table_of_candidates_keeps_its_labels(monkeypatch: pytest.MonkeyPatch, capsys: Any, tmp_path: Any) -> None:
    lines = ["label,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg"]
    lines += [f"M{k},{10 * k},-{5 * k},{7 * k},{k * k},{30 - k},{3 * k}" for k in range(12)]
    (tmp_path / "rows.csv").write_text("\n".join(lines))
    assert run(monkeypatch, "design", "position", "--count", "3", "--table", str(tmp_path / "rows.csv"), "--json") == 0
    chosen = json.loads(capsys.readouterr().out)["configurations"]
    assert all(float(q) == 10 * int(label[1:]) for label, q in zip(chosen["label"], chosen["q1_deg"], strict=True))


def test_numbers_units_and_the_base_are_checked_before_a_folder_is_made(
    monkeypatch: pytest.MonkeyPatch, capsys: Any, tmp_path: Any
) -> None:
    problem = ro.load("position").problem
    rows = np.column_stack([np.degrees(problem.data.q), 1e3 * problem.data.blocks[0].y])
    table = [",".join([f"P{k}", *(f"{v:.4f}" for v in row)]) for k, row in enumerate(rows)]
    file = tmp_path / "raw.csv"
    arguments = ["new", str(tmp_path / "cell"), "--robot", "irb120", "--data", str(file)]
    names = ",".join(["Point", *(f"A{i} [deg]" for i in range(1, 7)), "X{0},Y{0},Z{0}"])
    file.write_text("\n".join([names.format(" [mm]"), *table]))
    assert run(monkeypatch, *arguments, "--units", "rad,m", "--dry-run") == 0
    assert "--units m does not apply: the header has 'Z [mm]' in mm." in capsys.readouterr().out
    file.write_text("\n".join([names.format(""), *table]))
    assert run(monkeypatch, *arguments, "--units", "deg,m") == 0
    assert "mm: are the units right?" in capsys.readouterr().out
    file.write_text("\n".join([names.format(" [um]"), *table]))
    assert run(monkeypatch, *arguments[:1], str(tmp_path / "small"), *arguments[2:], "--dry-run") == 0
    assert "mm RMS, those of the nominal flange by" in capsys.readouterr().out
    file.write_text("\n".join([names.format(" [mm]"), *table[:-1], table[-1].rpartition(",")[0] + ",abc"]))
    arguments[1] = str(tmp_path / "other")
    assert run(monkeypatch, *arguments, "--dry-run") == 2
    assert f"row P{len(rows) - 1}, column 'Z [mm]': found 'abc'" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["UR-10", "Universal Robots UR10"])
def test_a_robots_trade_name_leads_to_its_own(
    monkeypatch: pytest.MonkeyPatch, capsys: Any, tmp_path: Any, name: str
) -> None:
    assert run(monkeypatch, "new", str(tmp_path / "cell"), "--robot", name, "--data", "rows.csv") == 2
    said = capsys.readouterr().err
    assert "(rpim-opt robots)" in said
    assert "did you mean ur10 " in said


def test_touches_are_designed_at_a_point(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    asked = ["design", "contact", "--count", "3", "--candidates", "8", "--criterion", "D", "--point", "500,0,300"]
    assert run(monkeypatch, *asked) == 0
    assert "3 of 8 configurations, D-optimal" in capsys.readouterr().out
    assert run(monkeypatch, *asked[:-1], "here") == 2
    assert "x,y,z [mm]" in capsys.readouterr().err


def test_touches_without_a_point_are_designed_at_a_place_that_was_touched(
    monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    """The one nearest to the middle of all, socket E; nominal errors of the robot are 6 mm, sockets 150 mm apart."""
    asked = ["design", "contact", "--count", "3", "--candidates", "8", "--criterion", "D", "--json"]
    assert run(monkeypatch, *asked) == 0
    columns = json.loads(capsys.readouterr().out)["configurations"]
    q = np.radians([[float(v) for v in columns[f"q{i}_deg"]] for i in range(1, 8)]).T
    flange = ro.robot.forward_kinematics(ro.load("contact").problem.robot, q)
    tip = flange[:, :3, 3] + 0.12 * flange[:, :3, 2]
    assert np.linalg.norm(tip - [0.55, 0.0, 0.35], axis=1).max() < 0.01


def test_two_logs_are_read_alike_by_every_command_that_takes_measurements(
    monkeypatch: pytest.MonkeyPatch, capsys: Any, tmp_path: Any
) -> None:
    """The key that ``new`` took stays; a later one of another name is stated."""
    problem = ro.load("position").problem
    robot = tmp_path / "robot.csv"
    ro.use.export_files(ro.calibrate(problem, weight=1e9), mdh=robot, despite_verdict=True)

    def logs(name: str, rows: Any, key: str) -> list[str]:
        table = np.column_stack([np.degrees(problem.data.q[rows]), 1e3 * problem.data.blocks[0].y[rows]])
        texts = [[f"P{i}", *(f"{v:.5f}".replace(".", ",") for v in row)] for i, row in enumerate(table)]
        paths = [tmp_path / f"{name}_joints.csv", tmp_path / f"{name}_tracker.csv"]
        joints = [[key, *(f"Achse {i} [Grad]" for i in range(1, 7))], *(row[:7] for row in texts)]
        values = [[key, "Zeit", "X [mm]", "Y [mm]", "Z [mm]"]]
        values += [[row[0], f"2026-03-{i + 1:02d}", *row[7:]] for i, row in enumerate(texts)]
        paths[0].write_text("\n".join(map(";".join, joints)), encoding="utf-8")
        paths[1].write_text("\n".join(map(";".join, [values[0], *reversed(values[1:])])), encoding="utf-8")
        return [str(path) for path in paths]

    joints, tracker = logs("first", slice(0, 25), "Messpunkt")
    cell = str(tmp_path / "cell")
    asked = ["new", cell, "--robot", str(robot), "--dh", "modified", "--data", joints, "--data", tracker]
    assert run(monkeypatch, *asked, "--key", "Messpunkt") == 0
    assert ro.load(cell).record.reading["key"] == "Messpunkt"
    assert run(monkeypatch, "calibrate", cell, "--out", cell, "--json") == 0
    later = logs("later", slice(25, 33), "Messpunkt")
    capsys.readouterr()
    found = {}
    for command, *options in (
        ["validate", cell, *later],
        ["update", cell, *later],
        ["monitor", cell, *later],
        ["accept", cell, "--limit", "9", "--data", later[0], "--data", later[1]],
    ):
        assert run(monkeypatch, command, *options, "--json") == 0, command
        found[command] = json.loads(capsys.readouterr().out)
        assert found[command]["tables"][-1].endswith("8 rows match, of 8 with joints and 8 measured.")
    assert found["validate"]["identified"]["count"] == 8
    assert found["validate"]["left_out"] == []
    other = logs("other", slice(25, 33), "Nummer")
    assert run(monkeypatch, "validate", cell, *other, "--key", "Nummer") == 0
    assert "joined by column 'nummer': 8 rows match, of 8" in capsys.readouterr().out


@pytest.fixture
def moved(tmp_path: Any) -> tuple[str, str, str]:
    """A result, new rows of an instrument that was set up anew, and the identification rows, as files."""
    instance = ro.load("position")
    result = replace(instance.calibrate(), record=replace(instance.record, validation=None))
    ro.store.save_result(result, tmp_path / "result.json")
    turn = Rotation.from_rotvec([0.1, 0.2, -0.3]).as_matrix()
    tables = {
        "new": (instance.validation, turn, [0.5, -0.2, 0.1]),
        "old": (instance.problem.data, np.eye(3), [0, 0, 0]),
    }
    for name, (data, about, shift) in tables.items():
        rows = np.column_stack([np.degrees(data.q), 1e3 * (data.blocks[0].y @ about.T + shift)])
        head = ",".join([*(f"q{i}_deg" for i in range(1, 7)), "x_mm", "y_mm", "z_mm"])
        lines = [",".join(map(repr, row)) for row in rows.tolist()]
        (tmp_path / f"{name}.csv").write_text("\n".join([head, *lines]) + "\n")
    return str(tmp_path), str(tmp_path / "new.csv"), str(tmp_path / "old.csv")


def test_an_instrument_that_was_set_up_anew_is_registered_by_every_command_that_judges(
    monkeypatch: pytest.MonkeyPatch, capsys: Any, moved: tuple[str, str, str]
) -> None:
    result, new, old = moved
    assert run(monkeypatch, "monitor", result, new) == 1
    assert "use --register in `validate`, `monitor` and `accept`" in capsys.readouterr().out
    for command in (["monitor", new], ["validate", new], ["accept", "--limit", "0.5", "--data", new]):
        assert run(monkeypatch, command[0], result, *command[1:], "--register") == 0, command
        assert "Registered again: the measurements were displaced as a whole by" in capsys.readouterr().out
    # after a motion they would no longer be recognized as rows that the calibration knows
    for command in (["monitor", old], ["validate", old], ["accept", "--limit", "0.5", "--data", old]):
        assert run(monkeypatch, command[0], result, *command[1:], "--register") == 2, command
        assert "of 40 rows are identification rows, accepted: new rows only" in capsys.readouterr().err


def test_an_update_says_in_millimetres_what_it_changed(
    monkeypatch: pytest.MonkeyPatch, capsys: Any, tmp_path: Any
) -> None:
    instance = ro.load("position")
    ro.store.save_result(replace(instance.calibrate(), record=instance.record), tmp_path / "result.json")
    data = instance.problem.data.take(np.arange(8))
    rows = np.column_stack([np.degrees(data.q), 1e3 * data.blocks[0].y + 0.01])
    head = ",".join([*(f"q{i}_deg" for i in range(1, 7)), "x_mm", "y_mm", "z_mm"])
    np.savetxt(tmp_path / "later.csv", rows, delimiter=",", header=head, comments="", fmt="%.6f")
    assert run(monkeypatch, "update", str(tmp_path), str(tmp_path / "later.csv")) == 0
    out = capsys.readouterr().out
    assert run(monkeypatch, "update", str(tmp_path), str(tmp_path / "later.csv"), "--json") == 0
    errors = json.loads(capsys.readouterr().out)["errors"]
    assert {name: of["after"]["count"] for name, of in errors.items()} == {"new": 8, "held-out": 40}
    assert errors["new"]["after"]["rms_mm"] < errors["new"]["before"]["rms_mm"]
    for name, of in errors.items():
        was, now = (f"{of[when]['rms_mm']:.4f} mm" for when in ("before", "after"))
        assert f"{name} rows: {was} with the previous calibration, {now} with this one." in out


def test_only_endings_that_a_table_is_written_with_are_accepted(
    monkeypatch: pytest.MonkeyPatch, capsys: Any, tmp_path: Any
) -> None:
    ro.store.save_result(ro.load("position").calibrate(), tmp_path / "result.json")
    for name in ("arm.xyz", "arm.xlsx"):
        assert run(monkeypatch, "export", str(tmp_path), "--mdh", str(tmp_path / name)) == 2
        assert "accepted: a name ending in .toml, .json, .csv.\n" in capsys.readouterr().err
        assert not (tmp_path / name).exists()
