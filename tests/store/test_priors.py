"""What a folder states before the data: words, numbers, earlier results."""

from __future__ import annotations

import shutil
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.bayes import Prior
from tests import ROOT

FOLDER = ROOT / "problems" / "position"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of a problem's folder, to write to."""
    shutil.copytree(FOLDER, tmp_path / "arm")
    return tmp_path / "arm"


def with_prior(folder: Path, text: str, scale: str = "") -> ro.store.Instance:
    stated = (FOLDER / "problem.toml").read_text(encoding="utf-8")
    stated = stated.replace("[scale]\n", f"[scale]\n{scale}\n")
    (folder / "problem.toml").write_text(f"{stated}\n{text}\n", encoding="utf-8")
    return ro.load(folder)


def solved(
    problem: ro.CalibrationProblem, prior: Prior, formulation: ro.Formulation = ro.tikhonov
) -> ro.calibration.Calibration:
    mine = prior.stated(problem.parameters).penalized(formulation)
    return ro.calibrate(problem, mine, weight=1.0)


def a_prior() -> Prior:
    prior = Prior(
        centre={"d5_mm": 0.1 + 0.2}, scale={"theta?_mrad": 1 / 3}, tails=np.inf, groups=("a? d?",), frames=7.0
    )
    return prior & Prior.known("a2 - 0.3 a3 = nominal + 0.1 +- 0.07 mm")


# --- results ---------------------------------------------------------------------------------------------------------

PENALTIES = [
    ro.tikhonov,
    ro.bounded,
    ro.lasso,
    ro.group_lasso,
    ro.robust,
    ro.Formulation("by kind", penalty=cp.sum_squares, penalty_over=ro.constraints.by_kind),
]


@pytest.mark.parametrize("formulation", PENALTIES, ids=lambda f: f.name)
def test_a_result_with_a_prior_is_loaded_and_solved_again(tmp_path: Path, formulation: ro.Formulation) -> None:
    problem = ro.load("position").problem
    problem = problem.with_parameters(problem.parameters.toleranced({"length_mm": 0.5, "angle_mrad": 1.0}))
    result = solved(problem, a_prior(), formulation)
    assert result.converged, result.message
    ro.store.save_result(result, tmp_path)
    again = ro.load_result(tmp_path)
    assert again.formulation == result.formulation
    assert np.array_equal(again.x, result.x)
    assert str(again) == str(result)
    anew = again.calibrate_again(again.problem)
    assert anew.x == pytest.approx(result.x, abs=1e-6 * np.abs(result.x).max())


def test_a_script_s_penalty_with_a_prior_keeps_its_covariance(tmp_path: Path) -> None:
    formulation = ro.Formulation("mine", penalty=lambda z: cp.sum_squares(2 * z))
    result = solved(ro.load("position").problem, a_prior(), formulation)
    ro.store.save_result(result, tmp_path)
    again = ro.load_result(tmp_path)
    assert not again.formulation.solvable
    assert again.covariance == pytest.approx(result.covariance, rel=1e-9)


# --- problem files --------------------------------------------------------------------------------------------------


def test_a_folder_that_says_nothing_believes_the_usual() -> None:
    assert ro.load("position").prior == Prior()


def test_a_folder_states_a_prior_in_words(folder: Path) -> None:
    text = """[prior]
known = ["a2 + a3 = nominal +- 0.05 mm", "d5 +- 0.1 mm"]
tails = inf
groups = ["a? d?", "alpha?"]
frames = 5
[prior.centre]
theta5_mrad = 4.0
[prior.scale]
"tool_?_mm" = 2
"""
    wanted = Prior(
        centre={"theta5_mrad": 4.0}, scale={"tool_?_mm": 2}, tails=np.inf, groups=("a? d?", "alpha?"), frames=5.0
    )
    for statement in ("a2 + a3 = nominal +- 0.05 mm", "d5 +- 0.1 mm"):
        wanted &= Prior.known(statement)
    assert with_prior(folder, text).prior == wanted


def test_a_report_lists_known_values_with_their_normalized_deviations(folder: Path) -> None:
    texts = ("a2 + a3 = nominal + 0.1 +- 0.05 mm", "tool_z = 61 +- 2 mm")
    result = with_prior(folder, f"[prior]\nknown = {list(texts)}".replace("'", '"')).calibrate()
    ro.store.save_result(result, folder / "result.json")
    ro.report.write_report(ro.load_result(folder / "result.json"), folder / "report.html")
    page = (folder / "report.html").read_text(encoding="utf-8")
    values, nominal = result.problem.parameters.by_name(result.x), result.problem.parameters
    assert nominal.nominal[nominal.names.index("tool_z")] == pytest.approx(0.061)
    deviation = dict(zip(nominal.free.names, result.x, strict=True))
    off = ((deviation["a2"] + deviation["a3"] - 1e-4) / 5e-5, (values["tool_z"] - 0.061) / 2e-3)
    for text, size in zip(texts, off, strict=True):
        assert f">{text}</th><td>{size:+.2f}</td>" in page


@pytest.mark.parametrize(
    ("scale", "first"), [("", 3.0), ("joint_offset_mrad = 10.0", 1.0), ('"theta?_mrad" = 5.0', 1.0)]
)
def test_joint_offsets_are_three_times_the_angle_scale_unless_said(folder: Path, scale: str, first: float) -> None:
    instance = with_prior(folder, "", scale)
    parameters = instance.problem.parameters
    stated = instance.prior.stated(parameters)
    theta1 = parameters.free.names.index("theta1")
    assert stated.scale[theta1] == pytest.approx(first, rel=1e-12)
    assert instance.prior.stated(parameters, widened=False).plain
    if scale:
        assert parameters.free.scale[theta1] == pytest.approx(1e-3 * float(scale.split("=")[1]), rel=1e-12)


def test_a_folder_takes_an_earlier_result_as_its_prior(folder: Path, tmp_path: Path) -> None:
    result = ro.calibrate(ro.load("position").problem, ro.tikhonov, 1.0)
    ro.store.save_result(result, folder / "earlier.json")
    found = with_prior(folder, '[prior]\nfrom = "earlier.json"\ninflate = 2\nwithout = ["base_*"]')
    assert found.prior == Prior.from_result(result, 2.0, ("base_*",))
    assert "earlier.json" in found.record.files


def test_what_an_earlier_result_knows_of_the_robot_is_not_dropped_in_silence(folder: Path) -> None:
    """Sag of an earlier `auto` calibration was, and the robot stood straight."""
    problem = ro.load("position").problem
    p = problem.parameters
    sagging = problem.identifying(p.identified | np.char.startswith(np.array(p.names), "compliance"))
    ro.store.save_result(ro.calibrate(sagging, ro.tikhonov, 1.0), folder / "earlier.json")
    with pytest.raises(ro.InputError, match=r"prior.from: found parameters .* \(compliance1, .*them in `identify`, or"):
        with_prior(folder, '[prior]\nfrom = "earlier.json"')
    stated = with_prior(folder, '[prior]\nfrom = "earlier.json"\nwithout = ["compliance?"]').prior
    assert len(stated.statements[0].names) == p.identified.sum()


def test_a_folder_learns_from_a_population(folder: Path) -> None:
    problem = ro.load("position").problem
    results = {}
    for k in range(2):
        part = problem.on(problem.data.take(np.arange(k, len(problem.data), 2)))
        results[f"arm{k}"] = ro.calibrate(part, ro.tikhonov, 1.0)
        (folder / f"arm{k}").mkdir()
        ro.store.save_result(results[f"arm{k}"], folder / f"arm{k}")
    found = with_prior(folder, '[prior]\npopulation = ["arm0", "arm1"]').prior
    wanted = Prior.from_population(results)
    assert found.centre == pytest.approx(wanted.centre, rel=1e-6, abs=1e-12)
    assert found.scale == pytest.approx(wanted.scale, rel=1e-6)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('known = ["a2 + a3"]', "key prior.known 1"),
        ('known = ["d5 +- 1 mm", "a2 + q3 +- 1 mm"]', "'q3'"),
        ('known = "a2 +- 1 mm"', "key prior.known"),
        ("tails = 0", "key prior.tails"),
        ('tails = "normal"', "key prior.tails: found 'normal', accepted: a number"),
        ("[prior.scale]\ntheta5_mrad = true", "key prior.scale.theta5_mrad: found True"),
        ("frames = -1", "key prior.frames"),
        ("[prior.scale]\ntheta5 = 1.0", "table scale, key theta5"),
        (
            '[prior.scale]\n"thta?_mrad" = 1.0',
            "key thta?_mrad: found a pattern that fits no parameter, accepted: theta1,",
        ),
        ("[prior.centre]\ntheta55_mrad = 1.0", "unknown key 'theta55_mrad'"),
        ('groups = ["b?"]', "key groups"),
        ('from = "nowhere.json"', "nowhere.json"),
        ('from = "robot.toml"', "robot.toml"),
        ('population = ["robot.toml"]', "robot.toml"),
        ("inflate = 2", "no key from in addition"),
        ('form = "x.json"', "from"),
        ('known = ["base_x +- 1 mm"]', "found 'base_x' without a value, where base = \"auto\""),
    ],
)
def test_a_wrong_prior_is_refused_by_file_and_key(folder: Path, text: str, says: str) -> None:
    with pytest.raises(ro.InputError) as error:
        with_prior(folder, f"[prior]\n{text}")
    assert "problem.toml" in str(error.value) or "robot.toml" in str(error.value) or "nowhere.json" in str(error.value)
    assert says in str(error.value)
