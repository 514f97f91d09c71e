"""Problem folders and results whose parts do not fit together: one sentence that names the key, or what is meant."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.store import find_problem
from rpim_opt.store.new_folder import stated_target
from rpim_opt.store.result_file import digest
from tests import ROOT
from tests.simulate import simulated

PROBLEMS = {
    "a fixture of no measurement": (
        "position", "[noise]", "[anchor]\nx_mm = 1\n[noise]", "a fixture that no measurement here has"
    ),
    "an anchor that no row names": (
        "cable", "[anchor.B]", "[anchor.C]\nx_mm = 1\n[anchor.B]", "table anchor: found 'C'"
    ),
    "an anchor that is a number": ("cable", "[anchor.A]", "[anchor]\nA = 3\n[anchor.D]", "table anchor.A: found 3"),
    "a published table that is missing": (
        "position", "[noise]", '[published."other.csv"]\nmean_mm = 1.0\n[noise]', "the name of a table in this folder"
    ),
    "a reference without tolerance": ("position", "[0.", "[1.0, 2.0, 0.", "a list of at most 2 items"),
    "all rows excluded": ("position", "[noise]", "[exclude]\nALL\n[noise]", "no remaining row (all are excluded)"),
    "repeatability below zero": (
        "position", "[noise]", "[repeatability]\njoint_mrad = -1.0\n[noise]", "greater than or equal"
    ),
    "a tool that is a number": ("markers", "[tool.A]", "[tool]\nA = 3\n[tool.D]", "key tool.A: found 3"),
    "a record without a word": (
        "position", "[noise]", "[record]\nnotes = ' '\n[noise]", "0 characters, accepted: 1 to"
    ),
    "an acceptance of one side": (
        "position", "[noise]", "[acceptance]\nlimit_mm = 0.1\nx_mm = [1.0]\n[noise]", "a list of at least 2 items"
    ),
}  # fmt: skip


def changed(folder: Path, name: str, old: str, new: str) -> Path:
    shutil.copytree(ROOT / "problems" / name, folder)
    file = folder / "problem.toml"
    text = file.read_text(encoding="utf-8")
    if "ALL" in new:
        rows = (folder / "identification.csv").read_text().splitlines()[1:]
        new = new.replace("ALL", "\n".join(f'{row.partition(",")[0]} = "bumped"' for row in rows))
    assert old in text
    file.write_text(text.replace(old, new, 1), encoding="utf-8")
    return folder


@pytest.mark.parametrize("what", PROBLEMS)
def test_a_folder_that_does_not_fit_is_named(tmp_path: Path, what: str) -> None:
    name, old, new, said = PROBLEMS[what]
    with pytest.raises(ro.InputError) as error:
        ro.load(changed(tmp_path / "arm", name, old, new))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_a_folder_may_be_named_by_its_file() -> None:
    assert find_problem(ROOT / "problems" / "position" / "problem.toml") == ROOT / "problems" / "position"


def test_targets_are_grids_or_tables(tmp_path: Path) -> None:
    assert stated_target("") == ({}, "", {})
    assert len(stated_target("7x5,30mm")[0]) == 35
    with pytest.raises(ro.InputError, match="a grid such as 7x5,30mm"):
        stated_target("7 by 5")
    path = tmp_path / "board.csv"
    path.write_text("point,x_mm,y_mm\na,0,0\nb,30,0\nc,0,30\n")
    board, _, points = stated_target(str(path))
    assert board["b"] == pytest.approx([0.03, 0.0, 0.0])
    assert points["point"] == ["a", "b", "c"]


# --- results -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def text(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("result") / "result.json"
    instance = ro.load("paper_arm")
    ro.store.save_result(replace(ro.calibrate(instance.problem, ro.tikhonov, 1.0), record=instance.record), path)
    return path.read_text(encoding="utf-8")


def put(content: Any, at: tuple[Any, ...], value: Any) -> None:
    for key in at[:-1]:
        content = content[key]
    if value is None:
        del content[at[-1]]
    else:
        content[at[-1]] = value


BLOCK = ("data", "identification", "blocks", 0)


@pytest.mark.parametrize(
    ("at", "value", "said"),
    [
        (("robots",), None, "inconsistent content (KeyError: 'robots')"),
        (("x",), [0.0] * 3, "inconsistent content"),
        ((*BLOCK, "q"), [[[0.0] * 6]], "accepted"),
        ((*BLOCK, "q"), [[[0.0] * 6], [[0.0]]], "inconsistent content"),
        ((*BLOCK, "y"), [[0.0] * 3], "accepted"),
        ((*BLOCK, "measurement"), "smell", "found 'smell', accepted: measurements=[...] with it"),
        (("rows", "identification"), [], "inconsistent content"),
        (("rows", "identification", 0, "nominal_mm"), 10**400, "inconsistent content"),
    ],
)
def test_a_result_whose_parts_do_not_fit_is_named(
    tmp_path: Path, text: str, at: tuple[Any, ...], value: Any, said: str
) -> None:
    """Also where the digest fits: somebody wrote it who knows how."""
    content = json.loads(text)
    put(content, at, value)
    content["digest"] = digest(content)
    path = tmp_path / "result.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ro.InputError) as error:
        ro.load_result(path)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_models_by_name_are_of_files_with_several_robots(tmp_path: Path, text: str) -> None:
    path = tmp_path / "result.json"
    path.write_text(text)
    with pytest.raises(ro.InputError, match="models by name, accepted: a Model, for the one robot of the file"):
        ro.load_result(path, model={"left": ro.robot.Model()})


# --- several robots ------------------------------------------------------------------------------------------------


def test_a_result_of_two_robots_comes_back(tmp_path: Path) -> None:
    """With their models by name, one for all that have terms, or none where no robot has any."""
    arms = [simulated(("theta[23]", "tool_x"), 12, 1e-5, seed)[0] for seed in (1, 2)]
    both = ro.together(left=arms[0], right=arms[1], shared=("tool_x",))
    result = ro.calibrate(both, ro.tikhonov, 1.0)
    path = tmp_path / "result.json"
    ro.store.save_result(result, path)
    for model in (None, ro.robot.Model(), {"left": ro.robot.Model()}):
        again = ro.load_result(path, **({} if model is None else {"model": model}))
        assert list(again.problem.arms) == ["left", "right"]
        assert np.array_equal(again.x, result.x)


def test_a_path_that_is_not_there_is_no_shipped_problem(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert ro.store.find_problem("position").is_dir()
    for name in (Path("position"), "./position", "x/position"):
        with pytest.raises(ro.InputError, match="no folder"):
            ro.load(name)
