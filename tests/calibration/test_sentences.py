"""What is said of a requirement, of what is left, of what was learned: every case has its words, and only its own."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.bayes.hyperparameters import ExcludedRow, Hyperparameter, Learned, Trial
from rpim_opt.calibration import Acceptance, Certificate, words
from rpim_opt.calibration.acceptance import Workspace, repeatability_bounds
from rpim_opt.calibration.certificate import certified
from rpim_opt.calibration.lack_of_fit import Autocorrelation, LackOfFit, autocorrelation
from rpim_opt.data import Requirement

LIMIT = Requirement(1e-4)


# --- acceptance ----------------------------------------------------------------------------------------------------


def expanded(count: int, largest: float, typical: float) -> Workspace:
    """The uncertainty at so many configurations and at the worst."""
    region: Any = None
    values = np.append(np.full(count, typical), largest)
    return Workspace(LIMIT, region, np.zeros((count + 1, 6)), np.zeros((count + 1, 3)), values)


def test_an_acceptance_says_what_it_rests_on() -> None:
    bare = Acceptance(LIMIT, "inconclusive", ("Missing: rows.",))
    assert bare.sentences() == [
        "Inconclusive: limit 0.1 mm with 95 % confidence at every configuration of the region.",
        "Missing: rows.",
        "Region: joints within the measured ranges.",
    ]
    assert [bare.content()[f"{name}_mm"] for name in ("bound", "median", "repeatability", "box")] == [None] * 4
    free = Acceptance(LIMIT, "inconclusive", (), expanded(500, np.inf, 5e-5), 2e-5)
    assert "The position reached" not in str(free)
    assert free.content()["bound_mm"] is None
    assert free.content()["median_mm"] == pytest.approx(0.05)
    whole = Acceptance(
        LIMIT, "accepted", (), expanded(500, 9e-5, 5e-5), 2e-5, {"rows": 4, "sentence": "Held out: 4 rows."}
    )
    assert whole.sentences()[2:] == [
        "Expanded uncertainty of the position that the reflector reaches (U, 95 %): at most 0.090 mm (largest of 500 "
        "configurations, refined by a search), median 0.050 mm; `compensate --tool` states that of another point.",
        "Held out: 4 rows.",
    ]
    assert whole.content()["checked"] == {"rows": 4}


def test_a_share_of_repeatability_that_is_not_known_is_zero() -> None:
    """Of a calibration whose noise's level stands for it."""
    problem = ro.load("paper_arm").problem
    region: Any = SimpleNamespace(marker="")
    found = repeatability_bounds(ro.calibrate(problem, ro.tikhonov, 1.0), region, problem.data.q[0], 0.95)
    assert found == (0.0, 0.0)


# --- what is left --------------------------------------------------------------------------------------------------

PLAIN = {"configurations": 60, "equations": 180, "residual_dof": 150.0, "dimension": "length"}

LACKING = {"missing": ("gravity",), "parameters": ("compliance?",)}


def left(rms: float, **more: Any) -> LackOfFit:
    return LackOfFit(**PLAIN, residual=rms, **more)


LEFT: dict[str, tuple[LackOfFit, str, str]] = {
    "none spare": (LackOfFit(3, 9, 1.0, "length", 1e-4), "degrees of freedom: 1, too few", "measurement noise"),
    "few spare": (LackOfFit(3, 9, 3.2, "length", 1e-4), "degrees of freedom: 3, too few", "measurement noise"),
    "effects": (
        left(1e-4, instrument=1e-4, present={"gravity": 30.0, "first harmonic": 9.0}),
        "gravity (likelihood-ratio statistic 30). Encoders or gears of joints have once-per-revolution errors "
        "(likelihood-ratio statistic 9).",
        "would explain",
    ),
    "alike": (
        left(2e-4, instrument=1e-4, autocorrelation=Autocorrelation(0.5, 9.0)),
        "Residuals of neighbouring configurations are correlated", "Even then",
    ),
    "alike even then": (
        left(2e-4, instrument=1e-4, autocorrelation=Autocorrelation(0.5, 9.0), **LACKING),
        "Even then, residuals of neighbouring configurations are correlated (0.50, z = 9): the model lacks an effect, "
        "which averaging more readings does not remove.",
        "Residuals of",
    ),
    "gross": (left(1e-1, instrument=1e-4, position=1e-1), "No robot has such poor repeatability", "limits"),
    "does not repeat": (
        left(1e-3, instrument=1e-4, position=1e-3, repeated=1e-3),
        "limits the result, by its repeatability, backlash or drift", "Repeat five",
    ),
    "repeats better": (
        left(1e-3, instrument=1e-4, position=1e-3, repeated=1e-4, excess=9e-4),
        "The robot, not the instrument, limits the result.", "backlash",
    ),
    "never repeated": (left(1e-3, instrument=1e-4, position=1e-3), "Repeat five configurations", "backlash"),
    "below the noise": (left(1e-6, instrument=1e-4, overstated=True), "Repeat one reading ten times", "only a more"),
    "up": (left(1e-4, instrument=1e-4, upward=("2",)), "Compliance of joint 2 is negative", "joints 2"),
    "both up": (
        left(1e-4, instrument=1e-4, upward=("2", "3 (elbow)")),
        "Compliances of joints 2 and 3 (elbow) are negative", "joint 2 is",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", LEFT)
def test_what_is_left_is_said(what: str) -> None:
    found, said, unsaid = LEFT[what]
    assert said in str(found)
    assert unsaid not in str(found)
    content = found.content()
    assert content["text"] == found.sentences()
    assert content["residual_mm"] == pytest.approx(1e3 * found.residual)
    if found.repeated is None:
        assert content["repeated_mm"] is None
    else:
        assert content["repeated_mm"] == pytest.approx(1e3 * found.repeated)
    assert content["present"] == found.present


def test_errors_without_any_size_are_not_alike() -> None:
    rng = np.random.default_rng(0)
    q = rng.normal(size=(60, 3))
    kinds = np.zeros(60, dtype=int)
    assert autocorrelation(q, np.zeros((60, 2)), kinds) is None
    assert autocorrelation(q, np.ones((60, 1)), kinds) is None  # dealt out, they are the same
    smooth = autocorrelation(q, np.sin(q), kinds)
    assert smooth is not None
    assert smooth.z > 5
    noise = autocorrelation(q, rng.normal(size=(60, 2)), kinds)
    assert noise is not None
    assert abs(noise.z) < 4


# --- what was learned ----------------------------------------------------------------------------------------------


def learned(
    sizes: Mapping[str, Hyperparameter] | None = None, noise: Mapping[str, Hyperparameter] | None = None, **more: Any
) -> Learned:
    stated: dict[str, Any] = {
        "local": np.ones(2), "trials": (), "value": 0.0, "noise_dof": 10.0, "left_out": (),
        "covariance": np.eye(1), "stated": np.ones(2), "drift": np.zeros((2, 1)), **more,
    }  # fmt: skip
    return Learned(sizes or {}, noise or {}, **stated)


def said(found: Learned) -> list[str]:
    return words.learned_lines(found, ("theta2", "d3"), np.zeros(2), np.zeros(2))


def test_what_was_learned_is_said_and_nothing_else() -> None:
    assert said(learned()) == []
    assert learned().extensions == ()
    assert learned().gain("gravity") is None
    sized = learned(
        {"lengths": Hyperparameter(2.0, 0.1), "angles": Hyperparameter(1.0, 0.1)},
        {"position": Hyperparameter(5e-5, 0.1)},
    )
    assert said(sized) == [
        "Estimated prior scale: lengths 2 x the stated one (95 % CI 1.6 to 2.4) and angles 1 x (95 % CI 0.82 to 1.2).",
        "Robot repeatability (1 sigma): 0.05 mm (95 % CI 0.041 to 0.061) in position along each axis.",
    ]


def test_parts_of_the_repeatability_that_are_not_worth_a_word() -> None:
    """Beside the largest; a size that is hardly known has an upper end."""
    only = said(learned(noise={"position": Hyperparameter(1e-3, 0.1), "joint": Hyperparameter(1e-6, 0.1)}))
    assert len(only) == 1
    assert "joint" not in only[0]
    assert "mm" in only[0]
    vague = said(learned(noise={"position": Hyperparameter(1e-3, 0.6)}))[0]
    assert "at most 2.7 mm (95 % confidence)" in vague


def test_extensions_are_compared_with_the_best_model_without_them() -> None:
    trials = (Trial(("gravity",), 10.0), Trial((), 40.0), Trial(("gravity", "moments"), 12.0))
    found = learned(trials=trials)
    assert found.extensions == ("gravity",)
    assert found.gain("gravity") == 30.0
    assert found.gain("moments") == -2.0
    assert found.gain("compliance") is None
    (text,) = said(found)
    assert text.startswith(
        "Model: geometry with gravity (likelihood-ratio statistic: gravity 30). `compensate` uses the whole"
    )
    assert "files for controllers hold geometry only" in text
    alone = learned(trials=(Trial((), 40.0), Trial(("gravity",), 40.2)))
    assert said(alone) == ["Model: the data support no extension."]


@pytest.mark.parametrize(("count", "more"), [(1, ""), (5, ""), (7, " and 2 more")])
def test_blunders_are_named_and_the_others_counted(count: int, more: str) -> None:
    (text,) = said(learned(left_out=tuple(ExcludedRow(f"r{k}", 9.0) for k in range(count))))
    assert text.startswith("Excluded outliers: r0 (9 times the median error)")
    assert text.endswith(f"median error){more}.")
    assert text.count("times") == min(count, 5)


# --- certificates --------------------------------------------------------------------------------------------------


def test_a_program_that_cannot_be_solved_again_certifies_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = ro.load("paper_arm").problem
    result = ro.calibrate(problem, ro.tikhonov, 1.0)
    model = problem.linearize(result.x)

    def fails(self: Any, weight: float) -> Any:
        raise ro.NoSolutionFound("own", weight, "solver_error")

    assert certified(ro.tikhonov, model, result.z, 1.0).holds(result.z)
    monkeypatch.setattr("rpim_opt.convex.program.Program.solve", fails)
    found = certified(ro.tikhonov, model, result.z, 1.0)
    assert found.decrease is None
    assert not found.holds(result.z)
    assert found == Certificate(float("inf"), 0.0)


def test_an_interval_is_one_of_those_that_are_known() -> None:
    result = ro.calibrate(ro.load("paper_arm").problem, ro.tikhonov, 1.0)
    with pytest.raises(ro.InputError, match="of: found 'sigma', accepted: "):
        result.predict(np.zeros((1, 6)), of="sigma")  # type: ignore[arg-type]
