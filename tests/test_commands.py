"""From a table and a URDF to a corrected robot: the commands in order, what they write, and what they refuse."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import cvxpy as cp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rpim_opt as ro
from rpim_opt.basics.files import read_toml
from rpim_opt.basics.layout import RawTable, TableOptions
from rpim_opt.basics.units import parse_units
from rpim_opt.data.measurements.pose import pose, position
from rpim_opt.data.tables.understanding import interpret
from rpim_opt.robot.kinematics import frame_numbers, numeric_frame, numeric_link
from rpim_opt.robot.library import read_arm
from rpim_opt.robot.mdh import MDH
from rpim_opt.use import validate
from tests import SHARED
from tests.robot.test_exchange import CONF, YAML
from tests.simulate import ARM, simulated
from tests.test_cli import run

BENCH, REAL = SHARED / "bench", SHARED / "data"
HEADER = ["x1", "y1", "z1", *(f"joint_{i}" for i in range(1, 7))]


def urdf_text(mdh: np.ndarray, tool: np.ndarray, fixed: bool = True) -> str:
    """Return a URDF whose joints turn about z, named J1, ..., and whose tip is fixed to the last link."""
    parts = ['<robot name="arm"><link name="base_link"/>']

    def joint(kind: str, name: str, parent: str, child: str, T: np.ndarray) -> None:
        six = [repr(float(v)) for v in frame_numbers(T)]
        origin = f'<origin xyz="{" ".join(six[:3])}" rpy="{" ".join(six[3:])}"/>'
        ends = f'<parent link="{parent}"/><child link="{child}"/>'
        limit = '<axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/>'
        parts.append(f'<link name="{child}"/><joint name="{name}" type="{kind}">{ends}{origin}{limit}</joint>')

    for i, row in enumerate(mdh, start=1):
        joint("revolute", f"J{i}", f"link_{i - 1}" if i > 1 else "base_link", f"link_{i}", numeric_link(*row[:4]))
    if fixed:
        joint("fixed", "mount", f"link_{len(mdh)}", "smr", tool)
    return "\n".join([*parts, "</robot>"])


def urdf_points(path: Path, q: np.ndarray) -> np.ndarray:
    """Return the positions of the tip (N, 3), from the file alone: no code of the package."""
    T = np.tile(np.eye(4), (len(q), 1, 1))
    moving = 0
    for joint in ElementTree.parse(path).getroot().iter("joint"):
        origin = joint.find("origin")
        assert origin is not None
        step = np.eye(4)
        step[:3, 3] = [float(v) for v in origin.attrib["xyz"].split()]
        step[:3, :3] = Rotation.from_euler("xyz", [float(v) for v in origin.attrib["rpy"].split()]).as_matrix()
        T = T @ step
        if joint.attrib["type"] == "revolute":
            turn = np.tile(np.eye(4), (len(q), 1, 1))
            turn[:, :3, :3] = Rotation.from_rotvec(np.outer(q[:, moving], [0, 0, 1])).as_matrix()
            T, moving = T @ turn, moving + 1
    return T[:, :3, 3]


def urdf_turns(path: Path, q: np.ndarray) -> Rotation:
    """Return the orientations of the tip."""
    arm = ro.read_urdf(path)
    ends = numeric_frame(arm.base), numeric_frame(arm.tool)
    return Rotation.from_matrix((ends[0] @ ro.robot.forward_kinematics(arm.robot, q) @ ends[1])[:, :3, :3])


def write_csv(path: Path, header: list[str], rows: np.ndarray) -> None:
    lines = [",".join(header), *(",".join(repr(float(v)) for v in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")


TOOL = numeric_link(a=0.03, theta=0.4, d=0.06)


def write_cell(folder: Path) -> Path:
    """Write what a person has: a URDF and tables without units, 40 configurations and 100 without noise [m, rad]."""
    rng = np.random.default_rng(5)
    (folder / "arm.urdf").write_text(urdf_text(ARM.mdh, TOOL))
    mdh = ARM.mdh + np.array([1e-3, 3e-4, 1e-3, 3e-4, 0.0]) * rng.normal(size=ARM.mdh.shape)
    (folder / "true.urdf").write_text(urdf_text(mdh, TOOL @ numeric_link(a=3e-4, d=-4e-4)))
    for name, count, noise in (("measured.csv", 40, 3e-5), ("later.csv", 100, 0.0)):
        q = rng.uniform(-2, 2, (count, 6))
        p = urdf_points(folder / "true.urdf", q)
        write_csv(folder / name, HEADER, np.hstack([p + noise * rng.normal(size=p.shape), q]))
    return folder


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_cell(tmp_path_factory.mktemp("cell"))


@pytest.fixture(scope="module")
def made(cell: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with its result, by the commands themselves."""
    folder = tmp_path_factory.mktemp("made") / "arm"
    with pytest.MonkeyPatch.context() as patch:
        assert run(patch, "new", str(folder), "--robot", str(cell / "arm.urdf"), "--data", str(cell / "measured.csv"),
                   "--units", "rad,m", "--hold-out", "0.2") == 0  # fmt: skip
        assert run(patch, "calibrate", str(folder), "--out", str(folder / "results")) == 0
    return folder


def table(path: Path) -> tuple[list[str], np.ndarray]:
    with path.open(newline="") as stream:
        header, *rows = csv.reader(stream)
    return header, np.array(rows, dtype=float)


def rms_mm(difference: np.ndarray) -> float:
    return 1e3 * float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))


# --- in order ----------------------------------------------------------------------------------------------


def test_a_reflector_that_is_not_the_tip_is_placed_in_the_tip_links_frame(made: Path, cell: Path, tmp_path) -> None:
    result = ro.load_result(made / "results")
    farther = TOOL @ numeric_link(d=0.1)
    (tmp_path / "arm.urdf").write_text(urdf_text(ARM.mdh, farther))
    root, tip, uncertain = ro.use.export_files(result, tmp_path / "out.urdf", urdf=tmp_path / "arm.urdf").notes
    there = np.linalg.inv(farther) @ numeric_frame(ro.use.identified(result).tool)
    said = [float(number) for number in re.findall(r"[xyz] (-?[\d.]+)", tip)[:3]]
    np.testing.assert_allclose(said, 1e3 * there[:3, 3], atol=6e-4)
    assert root.startswith("URDF: base_link is the instrument's frame: the identified base, x ")
    assert re.search(r": smr ([\d.]+) mm and", uncertain)
    assert "state --tool" in str(ro.use.compensate(result, np.zeros((1, 6))))


def test_a_reflector_at_an_unknown_place_is_said_to_start_at_the_flange(monkeypatch, capsys, cell, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    Path("arm.urdf").write_text(urdf_text(ARM.mdh, np.eye(4)))
    assert (
        run(monkeypatch, "new", "arm", "--robot", "arm.urdf", "--data", str(cell / "measured.csv"), "--units", "m,rad")
        == 0
    )
    assert "The reflector starts at the flange's origin" in capsys.readouterr().out
    assert "unknown: starts at the flange's origin" in Path("arm/problem.toml").read_text()


def test_four_commands_from_nothing_to_a_corrected_urdf(monkeypatch, capsys, cell, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, "new", "arm", "--robot", str(cell / "arm.urdf"), "--data", str(cell / "measured.csv"),
               "--validation", str(cell / "later.csv"), "--units", "m,rad") == 0  # fmt: skip
    said = capsys.readouterr().out
    assert re.search(r"joint_1 .* q1_rad ", said)
    assert "Guessed: the data are in the robot's base frame" in said
    assert "The reflector starts at the tip link, x " in said
    assert run(monkeypatch, "inspect", "arm") == 0
    assert "Warning" not in capsys.readouterr().out
    assert run(monkeypatch, "calibrate", "arm", "--out", "arm/results") == 0
    export = ("export", "arm/results", "--urdf", str(cell / "arm.urdf"), "--out")
    capsys.readouterr()
    assert run(monkeypatch, *export, "corrected.urdf", "--tip-measured") == 0
    assert " mm to the reflector, " in Path("corrected.urdf").read_text()
    stated = re.search(r"\(k = 2.*: smr ([\d.]+) mm and ([\d.]+) mrad", capsys.readouterr().out)
    assert stated
    stated_place, stated_turn = map(float, stated.groups())
    assert run(monkeypatch, *export, "behind.urdf") == 0
    assert "option tip-measured (tip_measured=True) moves it there" in Path("behind.urdf").read_text()
    assert "Positions of one reflector determine only part of its pose" in capsys.readouterr().out
    assert run(monkeypatch, "report", "arm/results", "--data", str(cell / "later.csv")) == 0
    page = Path("arm/results/report.html").read_text(encoding="utf-8")
    assert "Validation on new measurements" in page
    assert "later.csv (SHA-256" in page
    assert {p.name for p in (tmp_path / "arm" / "results").iterdir()} == {"result.json", "report.html"}
    result = ro.load_result("arm/results")
    later = table(cell / "later.csv")[1]
    residual = rms_mm(later[:, :3] - result.forward(later[:, 3:])[:, :3, 3])
    left = rms_mm(later[:, :3] - urdf_points(tmp_path / "corrected.urdf", later[:, 3:]))
    assert left == pytest.approx(residual, abs=1e-9)
    assert left < 0.03  # as the noise of the data; the drawing is off by more than a millimetre
    turns = [urdf_turns(path, later[:, 3:]) for path in ("corrected.urdf", cell / "true.urdf")]
    turned = 1e3 * (turns[0].inv() * turns[1]).magnitude().max()
    assert turned < stated_turn < 10, turned
    places = [urdf_points(path, later[:, 3:]) for path in ("corrected.urdf", cell / "true.urdf")]
    missed = 1e3 * np.linalg.norm(places[0] - places[1], axis=1).max()
    assert missed < stated_place < 0.3, missed
    # a reflector near the tip link does not move it unless it is said to be the tip
    behind, nominal = (ro.read_urdf(path) for path in ("behind.urdf", cell / "arm.urdf"))
    assert np.abs(behind.tool - nominal.tool).max() < 1e-12
    assert np.abs(behind.tool - ro.use.identified(result).tool).max() > 1e-5
    assert rms_mm(later[:, :3] - urdf_points(cell / "arm.urdf", later[:, 3:])) > 1.0


@pytest.mark.slow  # the same commands as above, on data that other tools were compared on
@pytest.mark.skipif(not BENCH.is_dir(), reason="the peers' benchmark ../shared/bench is not here")
def test_four_commands_on_the_peers_benchmark(monkeypatch, tmp_path) -> None:
    data, robot = BENCH / "clean52", str(BENCH / "robot.urdf")
    assert run(monkeypatch, "new", str(tmp_path / "arm"), "--robot", robot, "--data", str(data / "calib.csv"),
               "--validation", str(data / "valid.csv"), "--units", "rad,m") == 0  # fmt: skip
    results = tmp_path / "arm" / "results"
    assert run(monkeypatch, "calibrate", str(tmp_path / "arm"), "--out", str(results)) == 0
    options = ["--urdf", robot, "--out", str(tmp_path / "new.urdf"), "--tip-measured"]
    assert run(monkeypatch, "export", str(results), *options) == 0
    assert run(monkeypatch, "report", str(results)) == 0
    own = json.loads((results / "result.json").read_text())["validation"]["rms_mm"]
    rows = table(data / "valid.csv")[1]
    left = rms_mm(rows[:, :3] - urdf_points(tmp_path / "new.urdf", rows[:, 3:]))
    assert left == pytest.approx(own, abs=1e-9)
    assert left == pytest.approx(0.0309, abs=1e-4)
    # simulated with one size for all deviations: one weight over scales that say so is better here
    assert run(monkeypatch, "calibrate", str(tmp_path / "arm"), "--selector", "reml", "--out", str(results)) == 0
    assert json.loads((results / "result.json").read_text())["validation"]["rms_mm"] == pytest.approx(0.0261, abs=1e-4)


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="the real measurements of ../shared/data are not here")
@pytest.mark.parametrize(
    ("name", "robot", "limit"),
    [("ur5_jacobi", "ur5", 0.113), ("irb120_wu", "", 0.223), ("rokae_lmpytorch", "", 0.099), ("wam_jacobi", "", 2.34)],
)
def test_real_measurements(monkeypatch, tmp_path, name: str, robot: str, limit: float) -> None:
    """The guesses do as well as the problem files that were written by hand (RMS in ../shared/data/README.md)."""
    source, folder = REAL / name, tmp_path / "arm"
    assert run(monkeypatch, "new", str(folder), "--robot", robot or str(source / "robot.toml"), "--data",
               str(source / "identification.csv"), "--validation", str(source / "validation.csv")) == 0  # fmt: skip
    code = 4 * (name == "wam_jacobi")  # of the wam alone U is above the nominal error
    assert run(monkeypatch, "calibrate", str(folder), "--out", str(folder / "results")) == code
    assert json.loads((folder / "results" / "result.json").read_text())["validation"]["rms_mm"] < limit
    assert run(monkeypatch, "export", str(folder / "results"), "--mdh", str(tmp_path / "arm.csv")) == code
    assert ro.read_robot(tmp_path / "arm.csv").dof == ro.load_result(folder / "results").robot.dof
    assert run(monkeypatch, "report", str(folder / "results")) == 0


# --- new ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("visits", [False, True])
def test_held_out_rows_are_whole_configurations_drawn_by_the_seed(monkeypatch, cell, tmp_path, visits: bool) -> None:
    """Also where visits of one pose are configurations of their own: the others would validate nothing."""
    header, rows = table(cell / "measured.csv")
    twice = np.repeat(rows, 2, axis=0)
    twice[1::2, :3] += 1e-6
    if visits:
        header = ["label", *header, "configuration"]
        twice = np.column_stack([np.arange(1, 81), twice, np.arange(80) // 2 + 100 * (np.arange(80) % 2)])
    write_csv(tmp_path / "twice.csv", header, twice)
    split = []
    for name, seed in (("a", "1"), ("b", "1"), ("c", "2")):
        robot, data = str(cell / "arm.urdf"), str(tmp_path / "twice.csv")
        assert run(monkeypatch, "new", str(tmp_path / name), "--robot", robot, "--data", data, "--units", "rad,m",
                   "--hold-out", "0.25", "--seed", seed) == 0  # fmt: skip
        sets = [table(tmp_path / name / f"{role}.csv")[1] for role in ("identification", "validation")]
        labels = [set(part[:, 0].astype(int)) for part in sets]
        assert labels[0] | labels[1] == set(range(1, 81))
        assert len(labels[1]) == 20
        assert not labels[0] & labels[1]
        assert {(k + 1) // 2 for k in labels[0]}.isdisjoint({(k + 1) // 2 for k in labels[1]})
        split.append(labels[1])
    assert split[0] == split[1] != split[2]


def test_held_out_rows_are_used_once_they_have_validated(monkeypatch, capsys, made, tmp_path) -> None:
    """The result has both figures: of the fit that did not see them, and of the one that did."""
    whole = json.loads((made / "results" / "result.json").read_text())
    assert run(monkeypatch, "calibrate", str(made), "--no-use-validation", "--out", str(tmp_path)) == 0
    apart = json.loads((tmp_path / "result.json").read_text())
    assert [each["identification"]["count"] for each in (whole, apart)] == [40, 32]
    assert whole["validation"] == apart["validation"] == whole["held_out"]["identified"]
    assert apart["held_out"] is None
    for folder, used in ((made / "results", True), (tmp_path, False)):
        capsys.readouterr()
        assert run(monkeypatch, "validate", str(folder), str(made / "validation.csv")) == 0
        assert ("8 of 8 rows of the validation set are identification rows" in capsys.readouterr().out) == used


def test_joints_and_points_in_two_files_with_a_point_missing(monkeypatch, capsys, cell, tmp_path) -> None:
    """As instruments export them, for identification and for validation."""
    files = []
    for name in ("measured.csv", "later.csv"):
        header, rows = table(cell / name)
        for part, of in (("points", slice(0, 3)), ("joints", slice(3, 9))):
            path = tmp_path / f"{part}_{name}"
            lines = [",".join(["Point", *header[of]])]
            lines += [",".join([f"P{i}", *(repr(float(v)) for v in row[of])]) for i, row in enumerate(rows)]
            if path.name == "points_measured.csv":
                lines[8] = lines[8].rpartition(",")[0] + ","  # a beam that broke
            path.write_text("\n".join(lines) + "\n")
            files += ["--data" if name == "measured.csv" else "--validation", str(path)]
    folder = tmp_path / "arm"
    assert run(monkeypatch, "new", str(folder), "--robot", str(cell / "arm.urdf"), *files, "--units", "rad,m") == 0
    said = capsys.readouterr().out
    assert "rows that lack one of their measured values are ignored: P7." in said
    made = ro.load(folder)
    assert len(made.problem.data) == 39
    assert made.record.validation is not None
    assert len(made.record.validation) == 100
    assert len([name for name in made.record.files if name.endswith("(raw data)")]) == 4


def test_a_noise_that_nobody_stated_is_called_assumed(monkeypatch, capsys, made, tmp_path) -> None:
    folder = tmp_path / "arm"
    shutil.copytree(made, folder)
    assert run(monkeypatch, "calibrate", str(folder), "--out", str(folder / "results")) == 0
    assert "noise is assumed, not stated" in capsys.readouterr().out
    assert run(monkeypatch, "report", str(folder / "results"), "--out", str(tmp_path / "report.html")) == 0
    assert "noise is assumed, not stated" in (tmp_path / "report.html").read_text()
    text = (folder / "problem.toml").read_text()
    assert "\n# [tolerance]\n" in text  # one that nobody stated is no tolerance
    assert "+- one standard deviation: known = " in text
    (folder / "problem.toml").write_text(re.sub(r"noise_assumed = true.*\n", "", text))
    capsys.readouterr()
    assert run(monkeypatch, "calibrate", str(folder)) == 0
    assert "noise is assumed" not in capsys.readouterr().out


def test_the_file_that_was_handed_over_is_named_with_its_digest(cell, made) -> None:
    digest = hashlib.sha256((cell / "measured.csv").read_bytes()).hexdigest()
    files = ro.load_result(made / "results").record.files
    assert files["measured.csv (raw data)"] == digest
    assert files["identification.csv"] == hashlib.sha256((made / "identification.csv").read_bytes()).hexdigest()


def test_every_guess_is_what_auto_means(cell, made) -> None:
    stated, text = ro.load(made), (made / "problem.toml").read_text()
    auto = made.parent / "auto"
    auto.mkdir()
    for path in made.glob("*.*"):
        (auto / path.name).write_text(path.read_text())
    line = next(line for line in text.splitlines() if line.startswith("identify"))
    (auto / "problem.toml").write_text(text.replace(line, 'identify = "auto"'))
    assert set(stated.problem.parameters.free.names) == set(ro.load(auto).problem.parameters.free.names)
    content = read_toml(made / "problem.toml")
    assert content["base"]["x_mm"] == 0.0
    assert content["tool"]["x_mm"] == pytest.approx(1e3 * TOOL[0, 3])
    drawn = ro.read_urdf(cell / "arm.urdf")
    assert np.array_equal(stated.problem.robot.mdh, drawn.robot.mdh)


def test_an_instrument_elsewhere_is_found(monkeypatch, cell, tmp_path) -> None:
    """The base comes from the data, is not the robot's, and does not go into its URDF."""
    header, rows = table(cell / "measured.csv")
    turn = Rotation.from_euler("xyz", [0.1, -0.2, 2.0])
    rows[:, :3] = turn.apply(rows[:, :3]) + np.array([2.0, -1.0, 0.5])
    write_csv(tmp_path / "far.csv", header, rows)
    assert run(monkeypatch, "new", str(tmp_path / "arm"), "--robot", str(cell / "arm.urdf"), "--data",
               str(tmp_path / "far.csv"), "--units", "rad,m") == 0  # fmt: skip
    assert read_toml(tmp_path / "arm" / "problem.toml")["base"] == "auto"
    assert run(monkeypatch, "calibrate", str(tmp_path / "arm"), "--out", str(tmp_path)) == 0
    source, target = ["--urdf", str(cell / "arm.urdf")], tmp_path / "by_rule.urdf"
    assert run(monkeypatch, "export", str(tmp_path), *source, "--out", str(target)) == 0
    assert rms_mm(rows[:, :3] - urdf_points(target, rows[:, 3:])) > 1000


def test_more_names_that_people_use() -> None:
    joints = {f"J{i} [deg]": f"q{i}_deg" for i in range(1, 7)}
    more = {"Wire length [mm]": "distance_mm", "SMR ID": "marker", "Anchor": "fixture", "U (k=2) [mm]": "u95_mm"}
    table = RawTable({name: ["1"] for name in joints | more})
    found = interpret(table, ARM, ro.data.measurements.registry.MEASUREMENTS["cable"], TableOptions())
    assert {each.column: each.name for each in found.meant} == joints | more


def test_names_that_people_use() -> None:
    names = {
        "J1 [deg]": "q1_deg", "axis_2(rad)": "q2_rad", "joint03": "q3_rad", "Theta_4": "q4_rad", "q5": "q5_rad",
        "A6 degrees": "q6_deg", "X": "x_mm", "measured_y": "y_mm", "pos_z (m)": "z_m", "quat_w": "qw", "Name": "label",
        "reflector": "marker", "sigma_mm": "sigma_mm", "torque_1": "tau1_Nm",
    }  # fmt: skip
    source = {name: ["1"] for name in (*names, "temperature", "timestamp")}
    found = interpret(RawTable(source), ARM, pose, TableOptions(units=parse_units("rad,mm,Nm")), targets=True)
    assert list(found.columns) == list(names.values())
    assert [each.column for each in found.meant if each.meaning == "not used"] == ["temperature", "timestamp"]
    assert [each.name for each in found.meant if each.name] == list(names.values())
    assert [each.column for each in found.meant if each.name] == list(names)


def test_joints_may_count_from_zero_or_have_the_files_names() -> None:
    zero = interpret(
        RawTable({f"q{i}": ["1"] for i in range(6)}), ARM, position, TableOptions(units=parse_units("deg"))
    )
    assert list(zero.columns) == [f"q{i}_deg" for i in range(1, 7)]
    assert (zero.meant[0].column, zero.meant[0].name) == ("q0", "q1_deg")
    joints = ["pan", "lift", "elbow", "w1", "w2", "w3"]
    named = interpret(
        RawTable({name: ["1"] for name in reversed(joints)}),
        ARM,
        position,
        TableOptions(units=parse_units("rad")),
        joints,
    )
    assert list(named.columns) == [f"q{i}_rad" for i in range(6, 0, -1)]


# --- validate, export, compensate --------------------------------------------------------------------------


def test_a_saved_result_on_new_measurements(monkeypatch, capsys, cell, made, tmp_path) -> None:
    arguments = ["validate", str(made / "results"), str(cell / "later.csv"), "--units", "rad,m"]
    assert run(monkeypatch, *arguments, "--limit", "0.1", "--out", str(tmp_path / "rows.csv")) == 0
    said = capsys.readouterr().out
    assert "No row is outside" in said
    assert "touches by point" not in said
    result, rows = ro.load_result(made / "results"), table(cell / "later.csv")[1]
    error = np.linalg.norm(rows[:, :3] - result.forward(rows[:, 3:])[:, :3, 3], axis=1)
    for figure in (error.mean(), np.sqrt(np.mean(error**2)), error.max()):
        assert f"{1e3 * figure:.4f}" in said
    with (tmp_path / "rows.csv").open() as stream:
        written = list(csv.DictReader(stream))
    assert [float(row["error_mm"]) for row in written] == pytest.approx(1e3 * error, abs=1e-6)
    assert run(monkeypatch, *arguments, "--limit", "0.01") == 1
    capsys.readouterr()
    record = replace(result.record, requirement=ro.data.Requirement(limit=1e-5))
    ro.store.save_result(replace(result, record=record), tmp_path / "limited.json")
    assert run(monkeypatch, "validate", str(tmp_path / "limited.json"), *arguments[2:]) == 1
    assert "above the limit of 0.01 mm" in capsys.readouterr().out  # that of the result
    assert run(monkeypatch, "validate", str(tmp_path / "limited.json"), *arguments[2:], "--limit", "0.1") == 0
    header, rows = table(cell / "later.csv")
    rows[:, :3] += np.random.default_rng(0).normal(0.0, 1e-4, (len(rows), 3))
    np.savetxt(tmp_path / "scattered.csv", rows, delimiter=",", header=",".join(header), comments="")
    capsys.readouterr()
    arguments[2] = str(tmp_path / "scattered.csv")
    assert run(monkeypatch, *arguments, "--limit", "1") == 4  # within a limit by intervals that do not hold
    assert "within the limit of 1 mm" in capsys.readouterr().out


def test_a_row_that_the_prediction_does_not_allow_is_named(monkeypatch, capsys, cell, made, tmp_path) -> None:
    header, rows = table(cell / "later.csv")
    rows[7, 1] += 5e-4
    write_csv(tmp_path / "later.csv", [*header, "temperature"], np.hstack([rows, rows[:, :1]]))
    arguments = ["validate", str(made / "results"), str(tmp_path / "later.csv"), "--units", "rad,m"]
    assert run(monkeypatch, *arguments, "--json") == 0
    assert json.loads(capsys.readouterr().out)["beyond"] == ["8"]
    assert run(monkeypatch, *arguments) == 0
    said = capsys.readouterr().out
    assert "intervals: 8 (" in said
    assert "Largest error: row 8, 0." in said
    assert "Ignored columns: temperature." in said


@pytest.mark.slow
def test_new_measurements_in_another_unit_are_named(monkeypatch, capsys, cell, made, tmp_path) -> None:
    """Each in the words of what to write; no new result is made from them."""
    for units, said in (("deg,m", "name the columns q1_rad"), ("rad,mm", "name the columns x_m, y_m, z_m")):
        arguments = [str(made / "results"), str(cell / "later.csv"), "--units", units]
        assert run(monkeypatch, "validate", *arguments) == 1
        likely = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("Likely: "))
        assert said in likely
        assert run(monkeypatch, "validate", *arguments, "--json") == 1
        assert json.loads(capsys.readouterr().out)["mistake"] == likely
        result, rows, *unit = arguments
        for refusing in (
            ["update", *arguments, "--out", str(tmp_path / "next")],
            ["accept", result, "--data", rows, *unit, "--limit", "0.2"],
        ):
            assert run(monkeypatch, *refusing) == 2
            assert f"accepted: {said}" in capsys.readouterr().err
        assert not (tmp_path / "next").exists()
        assert run(monkeypatch, "monitor", *arguments) == 1
        assert said in capsys.readouterr().out


def test_two_units_that_are_wrong_are_both_named(monkeypatch, capsys, cell, tmp_path) -> None:
    """And nothing that fits as well as the first of them, but not with the second."""
    arguments = ["--robot", str(cell / "arm.urdf"), "--data", str(cell / "measured.csv"), "--units", "deg,mm"]
    assert run(monkeypatch, "new", str(tmp_path / "arm"), *arguments) == 0
    capsys.readouterr()
    assert run(monkeypatch, "inspect", str(tmp_path / "arm")) == 1
    (said,) = [line for line in capsys.readouterr().out.splitlines() if "times better" in line]
    lengths, turns = "measured lengths a thousand times larger", "joint values read as radians, not degrees"
    assert f"{lengths} and {turns}: " in said or f"{turns} and {lengths}: " in said


def test_a_title_without_a_source_has_no_empty_line_below(monkeypatch, capsys, made) -> None:
    for command in ("inspect", "calibrate"):
        assert run(monkeypatch, command, str(made)) == 0
        title, empty, first, *_ = capsys.readouterr().out.splitlines()
        assert (title, empty) == ("arm", "")
        assert first.split()[:2] in (["joint", "unit"], ["Delivered:", "the"])


def test_what_the_uncertainty_allows_is_rarely_exceeded() -> None:
    """Of 40 sets of 50 new rows each with the declared noise, hardly one has a row beyond its bound."""
    problem, truth = simulated(("theta?", "d?", "a?", "tool_[xyz]", "base_*"), noise=5e-5, seed=1)
    result = ro.calibrate(problem, ro.tikhonov, 1.0)
    rng, named = np.random.default_rng(2), 0
    for _ in range(40):
        q = rng.uniform(-2, 2, (50, 6))
        there = problem.on(ro.Dataset.of(q, np.zeros((50, 3)), 5e-5))
        y = -there.residual(truth).reshape(-1, 3) + 5e-5 * rng.normal(size=(50, 3))
        named += bool(validate(result, ro.Dataset.of(q, y, 5e-5)).beyond)
    assert named <= 3  # 40 sets at 1 %: more than three has a probability of 1e-3


def test_a_robot_no_more_certain_than_the_nominal_one_errs_is_inconclusive_to_all(monkeypatch, tmp_path, cell) -> None:
    """Without a limit as with one: the word and the exit code of calibrate are those of export."""
    rng = np.random.default_rng(1)
    q = rng.uniform(-2, 2, (14, 6))
    p = urdf_points(cell / "arm.urdf", q)
    write_csv(tmp_path / "few.csv", HEADER, np.hstack([p + 3e-4 * rng.normal(size=p.shape), q]))
    folder = str(tmp_path / "few")
    arguments = ["--robot", str(cell / "arm.urdf"), "--data", str(tmp_path / "few.csv"), "--units", "rad,m"]
    assert run(monkeypatch, "new", folder, *arguments) == 0
    assert run(monkeypatch, "calibrate", folder, "--out", str(tmp_path)) == 4
    assert run(monkeypatch, "export", str(tmp_path), "--mdh", str(tmp_path / "arm.toml")) == 4
    assert "Readings scatter by 0.4" in (tmp_path / "arm.toml").read_text()


def test_several_files_at_once_or_none(monkeypatch, capsys, cell, made, tmp_path) -> None:
    outs = ["--mdh", str(tmp_path / "arm.json"), "--robodk", str(tmp_path / "dk.csv"), "--out", str(tmp_path / "o")]
    assert run(monkeypatch, "export", str(made / "results"), "--urdf", str(cell / "arm.urdf"), *outs, "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["written"] == [str(tmp_path / "o"), str(tmp_path / "arm.json"), str(tmp_path / "dk.csv")]
    written, result = (file.read_text() for file in (tmp_path / "arm.json", made / "results" / "result.json"))
    assert np.abs(ro.read_robot(tmp_path / "arm.json").mdh - ro.load_result(made / "results").robot.mdh).max() < 1e-11
    assert f"digest {json.loads(result)['digest'][:12]}." in json.loads(written)["source"]
    assert "lacks base and tool: base x" in json.loads(written)["source"]
    (tmp_path / "ros.yaml").write_text(YAML)
    outs = ["--mdh", str(tmp_path / "again.json"), "--out", str(tmp_path / "both")]
    sources = ["--urdf", str(cell / "arm.urdf"), "--ur-kinematics", str(tmp_path / "ros.yaml")]
    assert run(monkeypatch, "export", str(made / "results"), *sources, *outs) == 2  # of another robot
    assert "the file that the calibration began with" in capsys.readouterr().err
    assert not (tmp_path / "again.json").exists()
    assert not (tmp_path / "both").exists()


@pytest.mark.parametrize(("turn", "said"), [(0.0, ""), (np.pi, '"ceiling"'), (np.pi / 3, "[0.0, -0.866, -0.5]")])
def test_a_robot_that_does_not_stand_upright_is_told_its_mounting(tmp_path, turn: float, said: str) -> None:
    q = np.random.default_rng(2).uniform(-2, 2, (20, 6))
    base, tool = numeric_frame(np.array([1.0, 0.5, 2.0, turn, 0.0, 0.0])), np.array([0.03, 0.0, 0.06, 1.0])
    write_csv(tmp_path / "a.csv", HEADER, np.hstack([(base @ ro.robot.forward_kinematics(ARM, q) @ tool)[:, :3], q]))
    ro.robot.write_robot(ARM, tmp_path / "arm.toml")
    options = TableOptions(units=parse_units("rad,m"))
    made = ro.store.new_problem(tmp_path / "cell", tmp_path / "arm.toml", tmp_path / "a.csv", options=options)
    assert '# mounting = "floor" ' in (tmp_path / "cell" / "problem.toml").read_text()
    noted = re.search(r"z points up, .*: mounting = (.*)\.$", "\n".join(made.notes), re.MULTILINE)
    assert (noted[1] if noted else "") == said


def test_new_says_that_the_nominal_robot_does_not_explain_the_data_before_what_is_certified(tmp_path, cell) -> None:
    q = np.random.default_rng(2).uniform(-2, 2, (20, 6))
    write_csv(tmp_path / "a.csv", HEADER, np.hstack([urdf_points(cell / "arm.urdf", q) / 25.4, q]))
    options = TableOptions(units=parse_units("rad,m"))
    made = ro.store.new_problem(tmp_path / "few", cell / "arm.urdf", tmp_path / "a.csv", options=options)
    (guessed,) = [note for note in made.notes if note.startswith("Guessed: the base")]
    assert re.search(r"\(the nominal robot does not explain the data, RMS error \d+ mm; optimum of the regist", guessed)


def test_new_names_what_a_linear_axis_may_need(tmp_path: Path) -> None:
    """A gantry's pitch error of 80 ppm was taken for scatter: no extension has it, and no text said so."""
    scara = ro.store.problems_folder() / "scara"
    made = ro.store.new_problem(tmp_path / "cell", scara / "robot.toml", scara / "identification.csv")
    assert "# ratio3, if added: relative errors of linear axes" in (made.folder / "problem.toml").read_text()


def test_new_says_that_a_robot_file_was_exported_from_a_calibration(made: Path, cell: Path, tmp_path: Path) -> None:
    """Its undetermined parameters would be taken for as well known as the others."""
    ro.use.export_files(ro.load_result(made / "results"), tmp_path / "arm.urdf", urdf=cell / "arm.urdf")
    q = np.random.default_rng(2).uniform(-2, 2, (20, 6))
    write_csv(tmp_path / "a.csv", HEADER, np.hstack([urdf_points(tmp_path / "arm.urdf", q), q]))
    options = TableOptions(units=parse_units("rad,m"))
    notes = ro.store.new_problem(tmp_path / "again", tmp_path / "arm.urdf", tmp_path / "a.csv", options=options).notes
    (note,) = [note for note in notes if note.startswith("arm.urdf was exported from a calibration (")]
    assert "rpim-opt update RESULTS TABLE" in note


@pytest.mark.parametrize(("rail", "ignored"), [(50.0, {"ignored_joints": "E1 [mm]"}), (0.0, {})])
def test_a_rail_that_moves_is_ignored_aloud(cell: Path, tmp_path: Path, rail: float, ignored: dict[str, str]) -> None:
    """Its column had "an unknown name", and calibrate blamed the rows' order; where it stands still it is no word."""
    q = np.random.default_rng(2).uniform(-2, 2, (20, 6))
    rows = np.hstack([urdf_points(cell / "arm.urdf", q), q, rail * np.arange(20)[:, None]])
    write_csv(tmp_path / "a.csv", [*HEADER, "E1 [mm]"], rows)
    options = TableOptions(units=parse_units("rad,m"))
    ro.store.new_problem(tmp_path / "arm", cell / "arm.urdf", tmp_path / "a.csv", options=options)
    assert ro.load(tmp_path / "arm").record.details == ignored


@pytest.mark.slow
def test_joint_values_that_are_ignored_are_a_likely_cause(monkeypatch, capsys, cell, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = ("--data", str(cell / "measured.csv"), "--units", "rad,m", "--urdf-tip", "link_5")
    assert run(monkeypatch, "new", "short", "--robot", str(cell / "arm.urdf"), *arguments) == 0
    assert run(monkeypatch, "calibrate", "short", "--out", "short") == 1
    assert "Likely: joint values joint_6 are ignored (the robot has 5 joints):" in capsys.readouterr().out


def test_the_links_that_new_was_given_are_those_of_export(monkeypatch, capsys, cell, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    beside = (
        '<link name="cam"/><joint name="c" type="fixed"><parent link="base_link"/><child link="cam"/></joint></robot>'
    )
    Path("two.urdf").write_text((cell / "arm.urdf").read_text().replace("</robot>", beside))
    arguments = ("new", "arm", "--robot", "two.urdf", "--data", str(cell / "measured.csv"), "--units", "rad,m")
    assert run(monkeypatch, *arguments) == 2
    assert "--urdf-tip" in capsys.readouterr().err
    assert run(monkeypatch, "new", "short", *arguments[2:], "--urdf-tip", "link_5") == 0
    ignored = "Ignored joint values: joint_6. The robot (two.urdf, base_link to link_5) has 5 joints"
    assert ignored in capsys.readouterr().out
    assert ro.load("short").record.details == {"ignored_joints": "joint_6"}  # which calibrate and report show
    assert run(monkeypatch, *arguments, "--urdf-tip", "smr") == 0
    assert "Ignored joint values" not in capsys.readouterr().out
    assert run(monkeypatch, "calibrate", "arm", "--out", "arm") == 0
    assert run(monkeypatch, "export", "arm", "--urdf", "two.urdf", "--out", "out.urdf") == 0
    q = np.random.default_rng(2).uniform(-2, 2, (20, 6))
    known, written = ro.use.identified(ro.load_result("arm")), ro.read_urdf("out.urdf", tip="smr")
    reached = [numeric_frame(arm.base) @ ro.robot.forward_kinematics(arm.robot, q) for arm in (known, written)]
    assert np.abs(reached[0] - reached[1]).max() < 1e-9


def test_a_dh_table_is_exported_in_either_convention_and_says_which(monkeypatch, capsys, made, tmp_path) -> None:
    q = np.random.default_rng(2).uniform(-2, 2, (20, 6))
    result = ro.load_result(made / "results")
    robot = result.robot
    assert robot.mdh[:-1, 4].any()  # near parallel axes, which standard and modified tables tilt differently
    for convention in ("standard", "modified"):
        path = tmp_path / f"{convention}.csv"
        assert run(monkeypatch, "export", str(made / "results"), "--mdh", str(path), "--dh", convention) == 0
        said = capsys.readouterr().out
        assert f"{path.name}: {convention} DH" in said
        assert ("Its base contains alpha1 = " in said) == (convention == "standard")
        assert path.read_text().startswith("joint,theta_deg,d_mm,a_mm,alpha_deg,beta_deg,") == (
            convention == "standard"
        )
        printed = re.findall(r" (?:x|y|z|rx|ry|rz) (-?[\d.]+)", said.split("lacks base and tool: ")[1])
        numbers = np.array(printed, dtype=float).reshape(2, 6) * ([1e-3] * 3 + [np.pi / 180] * 3)
        base, tool = (numeric_frame(place) for place in numbers)
        read = read_arm(path)
        first = numeric_link(*robot.mdh[0, :2]) if convention == "standard" else np.eye(4)
        flange = numeric_frame(read.base) @ ro.robot.forward_kinematics(read.robot, q) @ numeric_frame(read.tool)
        assert np.abs(first @ flange - ro.robot.forward_kinematics(robot, q)).max() < 1e-10
        with path.open() as stream:
            rows = list(csv.DictReader(stream))
        assert all(len(row["alpha_deg"].partition(".")[2]) <= 9 or "e-" in row["alpha_deg"] for row in rows)
        assert "lacks base and tool: base x" in rows[0]["note"]
        assert ", digest " in rows[0]["note"]
        missed = np.linalg.norm((base @ flange @ tool - result.forward(q))[:, :3, 3], axis=1)
        turn, reach = np.radians(0.0005), np.linalg.norm(flange[:, :3, 3], axis=1)
        assert (missed < 2e-6 + 2 * turn * reach).all()  # 0.001 mm and 0.001 deg are printed
    assert run(monkeypatch, "export", str(made / "results"), "--mdh", str(tmp_path / "a.toml"), "--dh", "paul") == 2
    assert "modified" in capsys.readouterr().err


def test_a_universal_robots_files(monkeypatch, capsys, tmp_path) -> None:
    (tmp_path / "calibration.conf").write_text(CONF)
    nominal = ro.read_robot(Path(ro.__file__).parent / "robot" / "ready" / "ur10.toml")
    problem, _ = simulated(robot=nominal, identify=("alpha?", "a?", "theta?", "d?", "beta[23]"), size=0.3)
    result = ro.calibrate(problem, ro.tikhonov, 1.0)
    ro.store.save_result(result, tmp_path / "result.json")
    assert run(monkeypatch, "export", str(tmp_path), "--ur-calibration", str(tmp_path / "calibration.conf"),
               "--out", str(tmp_path / "new.conf")) == 0  # fmt: skip
    assert "tilt and offset of axis 1" in capsys.readouterr().out
    assert run(monkeypatch, "export", str(tmp_path), "--ur-calibration", "none.conf", "--out", "new.conf") == 2
    assert "copied from its controller" in capsys.readouterr().err
    read, q = (
        ro.robot.read_ur_calibration(tmp_path / "new.conf", nominal),
        np.random.default_rng(0).uniform(-2, 2, (9, 6)),
    )
    mdh = result.robot.mdh.copy()
    mdh[0, :2] = nominal.mdh[0, :2]  # where the base is, not how the robot is
    there = ro.robot.forward_kinematics(replace(nominal, mdh=mdh), q)
    found = ro.robot.forward_kinematics(read.robot, q)
    bridge = np.linalg.inv(there) @ found  # one constant tool, read as such
    assert np.abs(bridge - bridge[0]).max() < 1e-9


def test_a_robot_from_ros_base_link_is_written_in_the_controllers_base(tmp_path: Path) -> None:
    """A URDF's root base_link stands half a turn from base_link_inertia, where the controller's Base is."""
    ur10 = ro.read_robot(Path(ro.__file__).parent / "robot" / "ready" / "ur10.toml")
    conf, yaml = tmp_path / "calibration.conf", tmp_path / "kinematics.yaml"
    conf.write_text(CONF)
    yaml.write_text(YAML)
    drawn = ro.robot.read_ur_kinematics(yaml).robot
    change = 1e-3 * np.random.default_rng(0).normal(size=(6, 5))
    change[0, :2], change[:, 4] = 0, 0
    fixed = '<joint name="f" type="fixed"><parent link="base_link"/><child link="base_link_inertia"/>'
    fixed = f'<link name="base_link"/>{fixed}<origin rpy="0 0 {np.pi!r}"/></joint>'
    q = np.random.default_rng(1).uniform(-3, 3, (8, 6))
    for nominal, reading in ((ur10, "calibration"), (drawn, "kinematics")):
        true = replace(nominal, mdh=nominal.mdh + change)
        want = ro.robot.forward_kinematics(replace(true, mdh=true.mdh * [1, 1, 1, 1, 0]), q)
        for root in ("base_link", "base_link_inertia"):
            arms = []
            for each in (nominal, true):
                inner = urdf_text(each.mdh, np.eye(4)).replace("base_link", "base_link_inertia")
                (tmp_path / "ur.urdf").write_text(inner.replace("</robot>", f"{fixed}</robot>"))
                arms.append(ro.read_urdf(tmp_path / "ur.urdf", root).robot)
            assert (arms[0].mdh[2:4, 1] > 0).all() == (root == "base_link")
            if reading == "calibration":
                ro.robot.write_ur_calibration(conf, arms[1], arms[0], tmp_path / "new.conf")
                again = ro.robot.read_ur_calibration(tmp_path / "new.conf", ur10)
            else:
                ro.robot.write_ur_kinematics(yaml, arms[1], tmp_path / "new.yaml")
                again = ro.robot.read_ur_kinematics(tmp_path / "new.yaml")
            assert np.abs(ro.robot.forward_kinematics(again.robot, q) - want).max() < 1e-9


def test_another_payload_is_compensated_for(monkeypatch, capsys, tmp_path) -> None:
    gravity = ro.robot.Gravity(masses=(0, 4, 6, 3, 1, 1), centres=((0, 0, 0),) * 6)
    arm = replace(ARM, gravity=gravity)
    problem, _ = simulated(("a[2-6]", "compliance[23]"), configurations=25, noise=5e-5, robot=arm)
    result = ro.calibrate(problem, ro.tikhonov, 1.0)
    ro.store.save_result(result, tmp_path / "result.json")
    result = ro.load_result(tmp_path)
    q = problem.data.q[:6] / 2
    write_csv(tmp_path / "go.csv", [f"q{i}_rad" for i in range(1, 7)], q)
    arguments = ["compensate", str(tmp_path), str(tmp_path / "go.csv"), "--position-only", "--out"]
    for text, stated in (("2.5", (2.5, None)), ("2.5,30,0,100", (2.5, [0.03, 0, 0.1]))):
        assert run(monkeypatch, *arguments, str(tmp_path / "out.csv"), "--payload", text) == 0
        live = ro.use.compensate(result, q, orientation=False, payload=stated[0], payload_centre=stated[1])
        assert (tmp_path / "out.csv").read_text() == live.csv()
    for wrong in ("heavy", "-1", "1,2"):
        assert run(monkeypatch, *arguments, str(tmp_path / "out.csv"), "--payload", wrong) != 0
        assert "--payload: found" in capsys.readouterr().err


def test_another_payload_needs_masses_of_the_links(monkeypatch, capsys, tmp_path) -> None:
    """Compliances take up the size of guessed masses, but not that of a payload beside them."""
    problem, _ = simulated(("a[2-6]", "compliance[23]"), configurations=25, noise=5e-5)
    result = ro.calibrate(problem, ro.tikhonov, 1.0)
    ro.store.save_result(result, tmp_path / "result.json")
    write_csv(tmp_path / "go.csv", [f"q{i}_rad" for i in range(1, 7)], problem.data.q[:6] / 2)
    arguments = ["compensate", str(tmp_path), str(tmp_path / "go.csv"), "--position-only"]
    assert run(monkeypatch, *arguments, "--out", str(tmp_path / "out.csv")) == 0
    assert run(monkeypatch, *arguments, "--out", str(tmp_path / "no.csv"), "--payload", "2.5") == 2
    assert "2.5 kg; measured with 0 kg, and the masses of the links are assumed" in capsys.readouterr().err
    assert not (tmp_path / "no.csv").exists()
    with pytest.raises(ro.InputError, match="masses of the links are assumed"):
        result.predict(problem.data.q, payload=2.5)


def test_a_saved_result_compensates_as_the_live_one(monkeypatch, capsys, cell, made, tmp_path) -> None:
    write_csv(tmp_path / "go.csv", [f"q{i}_deg" for i in range(1, 7)], np.degrees(table(cell / "later.csv")[1][:9, 3:]))
    out, arguments = tmp_path / "commands.csv", ["compensate", str(made / "results"), str(tmp_path / "go.csv")]
    assert run(monkeypatch, *arguments, "--out", str(out), "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert document["corrected"]["position"]["max_mm"] < 1e-4
    assert document["nominal"]["position"]["mean_mm"] > 0.5
    with out.open() as stream:
        assert [row["status"] for row in csv.DictReader(stream)] == ["ok"] * 9
    assert run(monkeypatch, *arguments, "--largest", "1e-6", "--limit", "0.01", "--out", str(out)) == 1
    assert "9 of 9 commands miss their target; do not execute these rows." in capsys.readouterr().out
    with out.open() as stream:
        assert {row["status"] for row in csv.DictReader(stream)} == {"above the limit"}
    assert run(monkeypatch, *arguments, "--largest", "1e-6", "--limit", "100") == 0
    (tmp_path / "go.csv").write_text("x_um;y_um;z_um\n600,125;100,250;400,500\n")  # thousands or decimals
    assert run(monkeypatch, *arguments) == 2
    assert "--decimal comma" in capsys.readouterr().err
    assert run(monkeypatch, *arguments, "--decimal", "point") == 0
    (tmp_path / "go.csv").write_text("x_mm;y_mm;z_mm\n600,125;100,250;400,500\n")  # no point is 600 m away
    assert run(monkeypatch, *arguments) == 0
    (tmp_path / "go.csv").write_text("x_mm,y_mm,z_mm,rx_deg,ry_deg,rz_deg\n600,100,400,0,90,0\n")
    run(monkeypatch, *arguments)
    assert "Orientation of targets: rx_deg: roll (extrinsic xyz), ry_deg: pitch" in capsys.readouterr().out
    (tmp_path / "go.csv").write_text("label,x_mm,y_mm,z_mm,Ziel,speed,status\nP1,600,100,400,=SUM(door),5,new\n")
    assert run(monkeypatch, *arguments, "--out", str(out)) == 0
    with out.open() as stream:  # texts are carried through, but for columns that are the result's
        (row,) = csv.DictReader(stream)
    assert row["Ziel"] == "'=SUM(door)"
    assert row["status"] in ("ok", "extrapolated")
    assert "speed" not in row
    (tmp_path / "go.csv").write_text("label,x_mm,y_mm,z_mm\nP1,9000,0,100\n")
    assert run(monkeypatch, *arguments) == 1  # unreachable, with or without a limit
    assert "1 of 1 commands miss their target" in capsys.readouterr().out


FORMULATIONS = {
    "squared": ro.tikhonov,
    "robust": ro.robust,
    "lasso": ro.lasso,
    "a script's": ro.Formulation("own", loss=lambda r: cp.sum(cp.huber(r, 1.5)), penalty=cp.sum_squares),
}


@pytest.mark.parametrize("name", FORMULATIONS)
def test_uncertainty_of_compensation_survives_the_file(tmp_path, name: str) -> None:
    problem, _ = simulated(("theta?", "d?", "tool_[xyz]"), configurations=25, noise=5e-5)
    live = ro.calibrate(problem, FORMULATIONS[name], 0.5)
    ro.store.save_result(live, tmp_path / "result.json")
    q = np.random.default_rng(1).uniform(-2, 2, (5, 6))
    std = [ro.use.compensate(result, q).std for result in (live, ro.load_result(tmp_path))]
    assert np.array_equal(np.isfinite(std[0]), np.isfinite(std[1]))
    assert np.isfinite(std[0]).all() == (name != "lasso")
    finite = np.isfinite(std[0])
    assert std[1][finite] == pytest.approx(std[0][finite], rel=1e-9)


# --- what is refused ---------------------------------------------------------------------------------------

NEW = ["new", "made", "--robot", "arm.urdf", "--data", "measured.csv", "--units", "rad,m"]
RESULT = ["results"]
BAD = {
    "no units": (NEW[:6], ["measured.csv", "columns without a unit (x1, y1", "--units", "mm,deg"]),
    "half the units": (
        [*NEW[:6], "--units", "m"], ["columns without a unit (joint_1", "--units deg or --units rad, whichever"]
    ),
    "unknown unit": ([*NEW[:7], "grad,m"], ["--units", "'grad'", "mrad"]),
    "two units": ([*NEW[:7], "m,mm"], ["--units", "m and mm"]),
    "no such robot": ([*NEW[:3], "ur55", *NEW[4:]], ["'ur55'", "ur5"]),
    "no such robot file": ([*NEW[:3], "arm.toml", *NEW[4:]], ["arm.toml", "found nothing"]),
    "no such data": ([*NEW[:5], "measurd.csv", *NEW[6:]], ["measurd.csv", "mean measured.csv"]),
    "no such measurement": ([*NEW, "--measurement", "posn"], ["'posn'", "position"]),
    "missing measurement": ([*NEW, "--measurement", "cable"], ["measured.csv", "no column for 'distance'"]),
    "folder is there": (["new", "results", *NEW[2:]], ["results", "nothing is overwritten"]),
    "two validations": ([*NEW, "--hold-out", "0.2", "--validation", "later.csv"], ["one of them"]),
    "all held out": ([*NEW, "--hold-out", "1"], ["--hold-out", "between 0 and 1"]),
    "bad validation": ([*NEW, "--validation", "broken.csv"], ["broken.csv", "row 2", "'inf'"]),
    "another robot's data": ([*NEW[:3], "panda", *NEW[4:]], ["measured.csv", "no column for 'q7'"]),
    "several points": ([*NEW[:5], "points.csv", *NEW[6:]], ["another point or reading", "below each other", "marker"]),
    "a turning joint in mm": (
        [*NEW[:5], "sliding.csv", *NEW[6:]], ["'joint_6 [mm]' (joint 6) in mm", 'another type of the joint']
    ),
    "the same twice": ([*NEW[:5], "twice.csv", *NEW[6:]], ["columns 'x1' and 'X' for x_m"]),
    "rotation vector?": ([*NEW[:5], "turns.csv", *NEW[6:]], ["column 'rx', either angles or a rotation vector"]),
    "no rows": ([*NEW[:5], "empty.csv", *NEW[6:]], ["empty.csv", "a header and no rows"]),
    "no positions": ([*NEW[:5], "joints.csv", *NEW[6:]], ["joints.csv", "no positions", "--measurement"]),
    "option unknown": ([*NEW, "--unit", "m"], ["No such option", "--units"]),
    "no result": (["validate", "nothing", "later.csv"], ["nothing", "the file: found nothing"]),
    "not a result": (["validate", "other.json", "later.csv"], ["other.json", "no result of rpim-opt"]),
    "bad row": (["validate", *RESULT, "broken.csv", "--units", "rad,m"], ["broken.csv", "row 2", "'inf'"]),
    "limit": (["validate", *RESULT, "later.csv", "--units", "rad,m", "--limit", "0"], ["--limit", "greater than zero"]),
    "another kind": (["validate", *RESULT, "later.csv", "--measurement", "pose"], ["'pose'", "position"]),
    "nothing to export": (["export", *RESULT], ["nothing to write", "--urdf", "--robodk"]),
    "nowhere to export": (["export", *RESULT, "--urdf", "arm.urdf"], ["--out", "arm.urdf"]),
    "nothing for that file": (["export", *RESULT, "--mdh", "made.csv", "--out", "w.csv"], ["--out", "w.csv", "--urdf"]),
    "over the original": (["export", *RESULT, "--urdf", "arm.urdf", "--out", "arm.urdf"], ["is not overwritten"]),
    "another arm": (["export", *RESULT, "--urdf", "other.urdf", "--out", "made"], ["other.urdf", "differs from"]),
    "ending of a table": (["export", *RESULT, "--mdh", "made.txt"], ["made.txt", "ending in .toml"]),
    "two files in one": (["export", *RESULT, "--mdh", "made.csv", "--robodk", "made.csv"], ["made.csv", "two files"]),
    "unwritable": (
        ["export", *RESULT, "--mdh", "made.csv", "--robodk", "arm.urdf/dk.csv"],
        ["arm.urdf/dk.csv", "cannot be written"],
    ),
    "no reflector": (["export", *RESULT, "--mdh", "made.csv", "--marker", "B"], ["marker", "'B'"]),
    "no targets": (["compensate", *RESULT, "nothing.csv"], ["nothing.csv", "the file: found nothing"]),
    "a program": (
        ["compensate", *RESULT, "joints.csv", "--units", "rad", "--out", "targets.ls"],
        ["--out", "found 'targets.ls'", "no program of a controller is written"],
    ),
    "bad tool": (["compensate", *RESULT, "joints.csv", "--units", "rad", "--tool", "1,2"], ["--tool", "six numbers"]),
}  # fmt: skip


@pytest.fixture
def desk(cell: Path, made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with good and bad files."""
    for path in (*cell.iterdir(), made / "results" / "result.json"):
        (tmp_path / path.name).write_text(path.read_text())
    (tmp_path / "results").mkdir()
    (tmp_path / "result.json").rename(tmp_path / "results" / "result.json")
    header, rows = table(cell / "measured.csv")
    write_csv(tmp_path / "points.csv", ["x1", "y1", "z1", "x2", *header[4:]], rows)
    write_csv(tmp_path / "sliding.csv", [*header[:-1], "joint_6 [mm]"], rows)
    write_csv(tmp_path / "turns.csv", [*header, "rx", "ry", "rz"], np.hstack([rows, rows[:, :3]]))
    write_csv(tmp_path / "twice.csv", [*header, "X"], np.hstack([rows, rows[:, :1]]))
    write_csv(tmp_path / "joints.csv", header[3:], rows[:, 3:])
    write_csv(tmp_path / "empty.csv", header, rows[:0])
    broken = rows[:9].copy()
    broken[1, 2] = np.inf
    write_csv(tmp_path / "broken.csv", header, broken)
    (tmp_path / "other.json").write_text("{}")
    (tmp_path / "bare.urdf").write_text(urdf_text(ARM.mdh, TOOL, fixed=False))
    longer = ARM.mdh.copy()
    longer[2, MDH.index("a")] += 0.2
    (tmp_path / "other.urdf").write_text(urdf_text(longer, TOOL))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_sentence_and_nothing_is_left(monkeypatch, capsys, desk, case) -> None:
    arguments, expected = BAD[case]
    before = {path: path.read_bytes() for path in desk.rglob("*") if path.is_file()}
    for as_json in ([], ["--json"]):
        assert run(monkeypatch, *arguments, *as_json) == 2
        said = capsys.readouterr()
        assert said.out == "" or (arguments[0] == "new" and not as_json)  # what was understood of the tables stays
        text = json.loads(said.err)["error"] if as_json else said.err
        if as_json:
            assert list(json.loads(said.err)) == ["error"]
        for part in expected:
            assert part in text, text
        if "No such option" not in text:
            assert text.strip().endswith(".")
            assert "\n" not in text.strip()
    assert {path: path.read_bytes() for path in desk.rglob("*") if path.is_file()} == before
    assert not list(desk.glob("made*"))


def test_what_no_file_can_hold_is_named(monkeypatch, capsys, tmp_path) -> None:
    problem, _ = simulated(("theta?", "ratio2"), configurations=20)
    ro.store.save_result(ro.calibrate(problem, ro.tikhonov, 1.0), tmp_path / "result.json")
    assert run(monkeypatch, "export", str(tmp_path), "--mdh", str(tmp_path / "arm.csv")) == 0
    assert "Files cannot hold ratio2: their geometry is from a separate fit" in capsys.readouterr().out
    assert "It includes the error of leaving out the model extensions" in (tmp_path / "arm.csv").read_text()


def test_one_robot_of_several_is_exported_by_its_name(monkeypatch, capsys, tmp_path) -> None:
    problem, _ = simulated(("theta?",), configurations=20)
    result = ro.calibrate(ro.together(left=problem, right=problem, shared=["tool_*"]), ro.tikhonov, 1.0)
    ro.store.save_result(result, tmp_path / "result.json")
    files = ("export", str(tmp_path), "--mdh", str(tmp_path / "arm.toml"))
    assert run(monkeypatch, *files) == 2
    assert "robot: found '', accepted: left, right" in capsys.readouterr().err
    assert run(monkeypatch, *files, "--robot", "right") == 0
    assert np.abs(ro.read_robot(tmp_path / "arm.toml").mdh - result.robots["right"].mdh).max() < 1e-11


# --- JSON, completion, help --------------------------------------------------------------------------------

DOCUMENTS = {
    "new": (NEW, {"written", "rows", "notes", "columns", "measurement"}),
    "inspect": (["inspect", "paper_arm"], {"joints", "measured", "observability", "warnings", "lack_of_fit"}),
    "calibrate": (
        ["calibrate", "paper_arm"],
        {"parameters", "errors", "weight", "converged", "lack_of_fit", "remarks"},
    ),
    "report": (["report", *RESULT], {"written"}),
    "validate": (["validate", *RESULT, "later.csv", "--units", "rad,m"], {"nominal", "identified", "axes", "rows"}),
    "export": (["export", *RESULT, "--mdh", "made.csv"], {"written", "notes"}),
    "compensate": (["compensate", *RESULT, "joints.csv", "--units", "rad"], {"corrected", "rows"}),
    "simulate": (["simulate", "position", "--out", "made"], {"written"}),
    "design": (["design", "paper_arm", "--count", "8", "--table", "go.csv"], {"criterion", "gap", "configurations"}),
    "robots": (["robots"], {"robots"}),
}


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("name", DOCUMENTS)
def test_every_command_has_a_document(monkeypatch, capsys, desk, name) -> None:
    arguments, keys = DOCUMENTS[name]
    rows = np.random.default_rng(0).uniform(-90, 90, (30, 6))
    write_csv(desk / "go.csv", [f"q{i}_deg" for i in range(1, 7)], rows)
    assert run(monkeypatch, *arguments, "--json") == 0
    said = capsys.readouterr()
    document = json.loads(said.out, parse_constant=lambda constant: pytest.fail(f"{constant} is no JSON"))
    assert keys <= set(document)
    assert said.err == ""


def test_the_document_of_a_calibration_has_the_tables_figures(monkeypatch, capsys) -> None:
    assert run(monkeypatch, "calibrate", "paper_arm") == 0
    text = capsys.readouterr().out
    assert run(monkeypatch, "calibrate", "paper_arm", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert len(document["errors"]) == 11
    for row in document["errors"]:
        digits = 3 if row.get("printed") else 4
        assert f"{row['what']}" in text
        assert f"{row['mean_mm']:.{digits}f}" in text
    for p in document["parameters"]:
        assert f"{p['deviation']:+z.4f}" in text
    for remark in [*document["remarks"], *document["lack_of_fit"]["text"]]:
        assert remark in text


def test_commands_complete_in_a_shell() -> None:
    environment = {
        **os.environ, "_RPIM_OPT_COMPLETE": "complete_bash", "COMP_WORDS": "rpim-opt va", "COMP_CWORD": "1",
    }  # fmt: skip
    script = "import sys; sys.argv = ['rpim-opt']; from rpim_opt.cli import main; main()"
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False)
    assert done.stdout.split() == ["validate"]


def test_help_states_the_exit_codes(monkeypatch, capsys) -> None:
    assert run(monkeypatch, "--help") == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "0 done; 1 a limit or gate failed" in text
    assert "2 invalid input; 3 no solution found" in text
    assert "--install-completion" in text


@pytest.mark.parametrize("name", ["validate", "calibrate", "new", "study"])
def test_help_names_values_and_not_pythons_types(monkeypatch, capsys, name) -> None:
    assert run(monkeypatch, name, "--help") == 0
    text = capsys.readouterr().out
    assert re.search(r"--\w+ (?:TEXT|PATH|NUMBER|INTEGER)\b", text)
    assert not re.search(r"<\w+|list\[", text)


def test_where_the_base_of_a_urdf_with_a_mount_is_gets_printed(monkeypatch, capsys, cell, tmp_path) -> None:
    text = (cell / "arm.urdf").read_text()
    root = re.search(r'<parent link="([^"]+)"', text)[1]
    mount = (
        f'<link name="floor"/><joint name="pedestal" type="fixed"><parent link="floor"/><child link="{root}"/>'
        '<origin xyz="0.5 0.2 0.75" rpy="0 0 0"/></joint></robot>'
    )
    (tmp_path / "mounted.urdf").write_text(text.replace("</robot>", mount))
    arguments = ["new", str(tmp_path / "arm"), "--data", str(cell / "measured.csv"), "--units", "rad,m", "--dry-run"]
    said = {}
    for name in (cell / "arm.urdf", tmp_path / "mounted.urdf"):
        assert run(monkeypatch, *arguments, "--robot", str(name)) == 0
        said[name.name] = " ".join(capsys.readouterr().out.split())
    assert "In the base of mounted.urdf it is at x 500.000 y 200.000" in said["mounted.urdf"]
    assert "x 500.000" not in said["arm.urdf"]
