"""One call for a comparison: its grid, its pairs, and the same rows whoever computes them and however often killed."""

from __future__ import annotations

import json
import math
import warnings
from pathlib import Path

import cvxpy as cp
import joblib
import numpy as np
import pytest
import scipy.sparse

import rpim_opt as ro
from tests import ROOT

TWO = ["position", "seven_axis"]
POSITION = ro.load("position")


def timeless(found: ro.study.Comparison) -> list[dict]:
    """Return the rows without what the clock says."""
    return [{name: value for name, value in row.items() if name != "seconds"} for row in found.rows]


def test_a_grid_has_one_row_a_replicate() -> None:
    found = ro.compare(TWO, ["tikhonov", "lasso", "least_squares"], ["learned", "reml", 1.0], progress=False)
    assert len(found.rows) == 2 * (3 + 3 + 1)  # least squares has no weight
    assert found.methods[-1] == "least_squares"
    assert found.problems == tuple(TWO)
    for row in found.rows:
        if (row["formulation"], row["selector"]) == ("lasso", "reml"):
            assert row["status"] == "impossible"
            assert row["reason"].startswith("selector reml: found formulation 'lasso', accepted: a quadratic penalty")
            assert row["rms_mm"] is None
        else:
            assert row["status"] == "ok"
            assert 0 < row["mean_mm"] < row["rms_mm"] < row["max_mm"] < 0.1
    frame = found.to_frame()
    assert len(frame) == len(found.rows)
    assert {"problem", "method", "split", "seed", "status", "reason", "rms_mm", "seconds"} < set(frame.columns)


def test_a_row_is_what_a_script_computes() -> None:
    found = ro.compare("position", "robust", "reml", progress=False)
    result = POSITION.calibrate(formulation=ro.robust, weight=ro.reml)
    errors = 1e3 * result.errors(POSITION.validation)
    row = found.rows[0]
    assert row["rms_mm"] == pytest.approx(np.sqrt(np.mean(errors**2)), rel=1e-12)
    assert row["max_mm"] == pytest.approx(errors.max(), rel=1e-12)
    assert row["weight"] == result.weight
    assert (row["configurations"], row["parameters"]) == (40, 34)


def mine(problem: ro.CalibrationProblem) -> np.ndarray:
    return ro.calibrate(problem, ro.tikhonov, 1.0).x


def predicting(problem: ro.CalibrationProblem):
    result = ro.calibrate(problem, ro.tikhonov, 1.0)
    return lambda q: result.forward(q)[:, :3, 3]


def broken(_: ro.CalibrationProblem) -> np.ndarray:
    raise ZeroDivisionError("of course")


def test_foreign_methods_are_compared_as_ours_are() -> None:
    methods = {
        "x": mine,
        "positions": predicting,
        "broken": broken,
        "short": lambda problem: [1.0, 2.0],
        "nominal": "nominal",
    }
    found = ro.compare("position", selectors=1.0, methods=methods, progress=False)
    of = {row["method"]: row for row in found.rows}
    assert of["x"]["rms_mm"] == pytest.approx(of["tikhonov, 1"]["rms_mm"], rel=1e-12)
    assert of["positions"]["rms_mm"] == pytest.approx(of["tikhonov, 1"]["rms_mm"], rel=1e-9)
    nominal = 1e3 * POSITION.calibrate().nominal_errors(POSITION.validation)
    assert of["nominal"]["rms_mm"] == pytest.approx(np.sqrt(np.mean(nominal**2)), rel=1e-6)
    assert (of["broken"]["status"], of["broken"]["reason"]) == ("failed", "ZeroDivisionError: of course")
    assert of["short"]["status"] == "impossible"
    assert "34 finite deviations [SI]" in of["short"]["reason"]


def test_all_baselines_run_by_their_names() -> None:
    found = ro.compare("position", selectors=1.0, methods=list(ro.baselines.__all__), progress=False)
    assert {row["status"] for row in found.rows} == {"ok"}
    assert max(row["rms_mm"] for row in found.rows if row["method"] != "gradient_descent") < 0.1


def test_problems_come_in_every_form(tmp_path: Path) -> None:
    for name in ("a", "b"):
        folder = tmp_path / name
        folder.mkdir()
        for file in (ROOT / "problems" / "position").iterdir():
            (folder / file.name).write_bytes(file.read_bytes())
    pair = (POSITION.problem, POSITION.validation)
    every = {"folder": ROOT / "problems" / "position", "name": "position", "loaded": POSITION, "pair": pair}
    every["generated"] = lambda seed: POSITION
    found = ro.compare(every, selectors=1.0, progress=False)
    assert found.problems == tuple(every)
    assert len({row["rms_mm"] for row in found.rows}) == 1
    assert ro.compare(tmp_path, selectors=1.0, progress=False).problems == ("a", "b")
    assert ro.compare([POSITION], selectors=1.0, progress=False).problems == (POSITION.record.title,)


def test_without_validation_data_a_row_says_so() -> None:
    found = ro.compare(POSITION.problem, selectors=1.0, progress=False)
    assert found.rows[0]["status"] == "impossible"
    assert "no validation data" in found.rows[0]["reason"]
    with pytest.raises(ro.InputError, match="which has no results; impossible: splits: found no validation data"):
        found.summary()


def test_folds_hold_every_configuration_out_once() -> None:
    seen: list[tuple[int, ...]] = []

    def configurations(fitted: ro.study.Fitted) -> float:
        assert not set(fitted.held_out.label) & set(fitted.problem.data.label)
        seen.append(tuple(np.unique(fitted.held_out.configuration)))
        return 1.0

    ro.compare("markers", selectors=1.0, splits=4, metrics={"n": configurations}, progress=False)  # three rows each
    assert sorted(k for fold in seen for k in fold) == sorted(np.unique(ro.load("markers").problem.data.configuration))
    seen.clear()
    ro.compare("markers", selectors=1.0, splits=0.2, seeds=3, metrics={"n": configurations}, progress=False)
    assert [len(held) for held in seen] == [5, 5, 5]
    assert len(set(seen)) == 3


def test_seeds_repeat_only_what_they_change() -> None:
    def arms(seed: int) -> ro.study.SimulatedArm:
        return ro.study.simulated_arm(seed, count=12)

    found = ro.compare([arms, "position"], selectors=["reml", 1.0], seeds=[3, 5], progress=False)
    assert [(row["problem"], row["seed"]) for row in found.rows[::2]] == [("arms", 3), ("arms", 5), ("position", 3)]
    counted = ro.compare("position", selectors=1.0, counts=[15, 30, 40, 500], seeds=2, progress=False)
    assert [row["configurations"] for row in counted.rows] == [15, 15, 30, 30, 40, None]  # no seed changes all rows
    assert counted.rows[-1]["reason"] == "count: found 500, accepted: 1 to 40 configurations."


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"formulations": "robsut"}, r"formulation: found 'robsut'.*did you mean robust"),
        ({"selectors": "relm"}, "weight: found 'relm', accepted: a number, a selector, learned, reml"),
        ({"selectors": [True]}, "selectors: found True"),
        ({"selectors": -1.0}, "selectors: found '-1.0'"),
        ({"selectors": 10**400}, "selectors: found 10000.*, accepted: a finite number"),
        ({"seeds": 10**400}, "seeds: found 10000.*, accepted: at most 100000 draws"),
        ({"methods": "newton"}, "methods: found 'newton', accepted: a function of the problem, nominal"),
        ({"metrics": "rms"}, r"metrics: found 'rms', accepted: a function of a fit, rms_mm"),
        ({"splits": 1}, "splits: found 1, accepted: 'folder', a fraction"),
        ({"splits": "half"}, "splits: found 'half'"),
        ({"splits": math.inf}, "splits: found inf"),
        ({"splits": [5, 1e308]}, r"splits: found 1e\+308, .* 2 to 10000"),
        ({"counts": 0}, "counts: found 0, accepted: whole numbers, 1 or more"),
        ({"seeds": []}, r"seeds: found \[\], accepted: whole numbers"),
        ({"problems": "positon"}, "did you mean position"),
        ({"problems": ["position", POSITION, "position"]}, "'position' twice"),
        ({"problems": 3}, "problems: found a int"),
        ({"workers": 0}, "workers: found 0"),
        ({"problems": []}, "problems: found none"),
        ({"problems": ROOT / "tests" / "study"}, "problems: found none"),
        ({"splits": []}, r"splits: found \[\]"),
        ({"selectors": ["reml", ro.reml]}, "'tikhonov, reml' twice"),
        ({"selectors": [lambda _: 1.0, lambda _: 2.0]}, "'tikhonov, <lambda>' twice"),
        ({"selectors": [{"length": 1.0}]}, "a number, a selector"),
        ({"formulations": (), "selectors": "reml"}, "methods: found none"),
        ({"methods": 3}, "methods: found 3"),
        ({"metrics": []}, "metrics: found none"),
        ({"metrics": "covered_percent"}, "found 'covered_percent' first, of which 95 is best"),
        ({"metrics": {"a": 3}}, "metrics: found 3"),
    ],
)
def test_what_cannot_be_asked_is_said_before_anything_is_computed(asked: dict, said: str) -> None:
    asked = {"problems": "position", "progress": False, **asked}
    with pytest.raises(ro.InputError, match=said):
        ro.compare(**asked)


# --- killed, resumed, elsewhere ------------------------------------------------------------------------------------

GRID = {"problems": TWO, "formulations": ["tikhonov", "robust"], "selectors": ["learned", "reml"]}


def stop_after(count: int):
    def progress(done: int, _: int) -> None:
        if done == count:
            raise KeyboardInterrupt

    return progress


def entries(journal: Path) -> list[str]:
    """Return what a journal holds of replicates."""
    return journal.read_text().splitlines()[1:]


def test_a_killed_comparison_goes_on_with_equal_results(tmp_path: Path) -> None:
    journal = tmp_path / "deep" / "journal.jsonl"
    with pytest.raises(KeyboardInterrupt):
        ro.compare(**GRID, journal=journal, progress=stop_after(3))
    assert len(entries(journal)) == 3
    counts: list[int] = []
    resumed = ro.compare(**GRID, journal=journal, progress=lambda done, _: counts.append(done))
    assert counts == [3, 4, 5, 6, 7, 8]
    fresh = ro.compare(**GRID, progress=False)
    assert timeless(resumed) == timeless(fresh)
    assert str(resumed.summary()) == str(fresh.summary())
    again = ro.compare(**GRID, journal=journal, progress=False)  # nothing is left to compute
    assert again.rows == resumed.rows
    ro.compare(**GRID, journal=journal, splits=["folder", 0.3], progress=False)  # more is added to it
    assert len(entries(journal)) == 16


class Ridge:
    """A method with a matrix."""

    def __init__(self, size: float):
        self.matrix = scipy.sparse.diags_array(np.full(34, size))

    def __call__(self, problem: ro.CalibrationProblem) -> np.ndarray:
        return ro.calibrate(problem, ro.tikhonov, self.matrix.trace()).x


def test_a_journal_returns_no_figures_of_another_matrix(tmp_path: Path) -> None:
    journal = tmp_path / "journal.jsonl"

    def errors(size: float) -> float:
        asked = {"selectors": 1.0, "methods": {"ridge": Ridge(size)}, "journal": journal, "progress": False}
        return ro.compare("position", **asked).rows[1]["rms_mm"]

    before = errors(1e-3)
    assert errors(1e-3) == before
    with pytest.raises(ro.InputError, match="replicates of another set of methods"):
        errors(1e6)
    journal.unlink()
    assert errors(1e6) > 10 * before


def test_what_a_journal_cannot_know_is_refused_before_anything_is_computed(tmp_path: Path) -> None:
    numbers = (k for k in range(3))
    asked = {"problems": "position", "selectors": 1.0, "methods": {"mine": lambda problem: [next(numbers)] * 34}}
    with pytest.raises(ro.InputError, match="journal: found something that cannot be pickled"):
        ro.compare(**asked, journal=tmp_path / "journal.jsonl", progress=False)
    assert ro.compare(**asked, progress=False).rows[1]["status"] == "ok"


@pytest.mark.parametrize(
    ("change", "part"),
    [
        ({"formulations": ["tikhonov", "minimax"]}, "set of methods"),
        ({"problems": ["position", "pose"]}, "set of problems given"),
        ({"metrics": "max_mm"}, "set of metrics"),
    ],
)
def test_a_journal_of_other_arguments_is_not_resumed(tmp_path: Path, change: dict, part: str) -> None:
    journal = tmp_path / "journal.jsonl"
    with pytest.raises(KeyboardInterrupt):
        ro.compare(**GRID, journal=journal, progress=stop_after(2))
    before = entries(journal)
    with pytest.raises(ro.InputError, match=f"resume: found replicates of another {part}"):
        ro.compare(**{**GRID, **change}, journal=journal, progress=False)
    assert entries(journal) == before
    with pytest.raises(KeyboardInterrupt):
        ro.compare(**{**GRID, **change}, journal=journal, resume=False, progress=stop_after(1))
    assert len(entries(journal)) == 1


def test_a_journal_knows_the_package_that_computed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rpim_opt.study import studies

    journal = tmp_path / "journal.jsonl"
    ro.compare("position", selectors=1.0, journal=journal, progress=False)
    other = {**studies.package_code(), "package": "0" * 64}
    monkeypatch.setattr(studies, "package_code", lambda: other)
    with pytest.raises(ro.InputError, match="replicates of another package"):
        ro.compare("position", selectors=1.0, journal=journal, progress=False)


def test_names_with_commas_are_told_apart_and_a_method_that_answers_no_numbers_is_named() -> None:
    methods = {"short": lambda problem: [0.0], "blind": lambda problem: [np.nan] * len(problem.parameters.free)}
    found = ro.compare("position", ["tikhonov"], ["reml", 1.0], methods=methods, progress=False)
    assert found.grid["Methods"] == "tikhonov, reml; tikhonov, 1; short; blind"
    notes = "\n".join(found.summary().notes)
    assert "Method short: found shape (1,), accepted: 34 finite deviations" in notes
    assert "Method blind: found nan" in notes


@pytest.mark.slow
def test_two_processes_and_a_cluster_give_the_same(tmp_path: Path) -> None:
    own = ro.Formulation("own", loss=lambda r: cp.sum(cp.huber(r, 1.5)), penalty=cp.sum_squares)
    asked = {"problems": ["position"], "formulations": ["tikhonov", own], "selectors": ["reml", 1.0]}
    asked["methods"] = {"mine": lambda problem: ro.calibrate(problem, "tikhonov", 1.0).x, "broken": broken}
    here = ro.compare(**asked, progress=False)
    processes = ro.compare(**asked, workers=2, progress=False)
    assert timeless(processes) == timeless(here)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the cluster's own, of ports and event loops
        from distributed import Client, LocalCluster

        local = LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None)
        with local as cluster, Client(cluster), joblib.parallel_config("dask"):
            there = ro.compare(**asked, workers=-1, progress=False)
    assert timeless(there) == timeless(here)


# --- what is read out ----------------------------------------------------------------------------------------------


def rows_of(errors: dict[str, dict[str, float | None]]) -> tuple[dict, ...]:
    """Return rows of methods on problems with given errors."""
    common = {"split": "folder", "fold": 1, "count": None, "seed": 0}
    return tuple(
        {"problem": problem, "method": method, **common, "rms_mm": value, **said(value)}
        for method, by_problem in errors.items()
        for problem, value in by_problem.items()
    )


def said(value: float | None) -> dict[str, str]:
    if value is None:
        return {"status": "failed", "reason": "it broke"}
    return {"status": "ok", "reason": ""}


def test_ratios_are_of_pairs_and_failures_lose() -> None:
    problems = [f"p{k}" for k in range(6)]
    hard = [0.01, 0.1, 1.0, 10.0, 100.0, 1000.0]
    a = dict(zip(problems, hard, strict=True))
    half = {problem: 0.5 * value for problem, value in a.items()}
    some = {**half, "p5": None}
    found = ro.study.Comparison(rows_of({"a": a, "half": half, "some": some}), ("rms_mm",))
    of = {each.method: each for each in found.summary().standings}
    assert of["half"].ratio == pytest.approx(0.5)
    assert (of["half"].low, of["half"].high) == (pytest.approx(0.5), pytest.approx(0.5))  # in pairs nothing varies
    assert (of["half"].wins, of["half"].ties, of["half"].losses) == (6, 0, 0)
    assert (of["some"].wins, of["some"].losses, of["some"].missing) == (5, 1, 1)
    assert of["half"].different
    assert not of["a"].different
    assert "some: failed, 1 of 6 replicates (p5). It broke" in found.summary().notes
    against = {each.method: each.ratio for each in found.summary(against="half").standings}
    assert against["a"] == pytest.approx(2.0)


@pytest.mark.parametrize("count", [5, 8, 20])
def test_intervals_of_other_problems_cover_as_they_say(count: int) -> None:
    from rpim_opt.study.comparison import interval

    covered = []
    for seed in range(400):
        rng = np.random.default_rng([seed, count])
        problem = 0.1 + 0.3 * rng.standard_normal(count)  # what is true of each problem
        ratios = {
            (f"p{k}", "5 folds", fold, None, 1.0, 0): problem[k] + 0.1 * rng.standard_normal()
            for k in range(count)
            for fold in range(5)
        }
        _, low, high = interval(ratios, frozenset())
        assert low is not None
        assert high is not None
        covered.append(low <= np.exp(0.1) <= high)
    assert np.mean(covered) > 0.92  # folds taken for independent would give some 0.4
    assert np.mean(covered) < 0.99


def test_an_interval_of_one_problem_is_of_its_seeds_and_not_of_its_folds() -> None:
    """Folds of one seed have its draw in common: with seeds enough they add nothing to what is independent."""
    seeds = dict(zip(range(6), [-0.5, 0.4, 0.1, -0.2, 0.3, 0.6], strict=True))

    def rows(folds: int) -> tuple[dict, ...]:
        of = {"a": dict.fromkeys(seeds, 0.0), "b": seeds}
        return tuple(
            {
                **row,
                "split": f"{folds} folds",
                "fold": fold,
                "seed": seed,
                "rms_mm": float(np.exp(of[row["method"]][seed])),
            }
            for row in rows_of({"a": {"p": 1.0}, "b": {"p": 1.0}})
            for seed in seeds
            for fold in range(folds)
        )

    once, often = (ro.study.Comparison(rows(folds), ("rms_mm",)).summary(against="a") for folds in (1, 4))
    one, other = ({each.method: each for each in found.standings}["b"] for found in (once, often))
    assert (one.low, one.high) == (pytest.approx(other.low), pytest.approx(other.high))
    assert one.ratio == pytest.approx(np.exp(np.mean(list(seeds.values()))))
    assert one.low < one.ratio < one.high


def test_few_problems_say_that_intervals_are_of_these() -> None:
    folds = ro.compare("position", ["tikhonov", "least_squares"], "reml", splits=5, progress=False)
    assert any("these problems alone" in note for note in folds.summary().notes)
    once = ro.compare(TWO, ["tikhonov", "least_squares"], "reml", progress=False)
    assert any("There are no intervals" in note for note in once.summary().notes)
    assert all(each.low is None for each in once.summary().standings)


@pytest.mark.slow
def test_a_report_is_written_whole_and_again(tmp_path: Path) -> None:
    found = ro.compare("position", ["tikhonov", "lasso"], ["learned", "reml"], splits=5, progress=False)
    text = found.report(tmp_path / "out").read_text()
    for part in ("Package: rpim-opt", "SHA-256", "Selector reml: found formulation", "(comparison.svg)"):
        assert part in text
    lines = (tmp_path / "out" / "replicates.csv").read_text().splitlines()
    assert len(lines) == 1 + 20
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    found.report(tmp_path / "out")
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before
    assert len(found.plot("max_mm").axes) == 1


def test_the_command_takes_all_configurations_unless_told(monkeypatch, capsys) -> None:
    from tests.test_cli import run

    asked = ["compare", "position", "--formulations", "tikhonov", "--selector", "1", "--json"]
    assert run(monkeypatch, *asked) == 0
    (row,) = json.loads(capsys.readouterr().out)["replicates"]
    assert row["configurations"] == len(POSITION.problem.data)


@pytest.mark.slow
def test_the_command(tmp_path: Path, monkeypatch, capsys) -> None:
    from tests.test_cli import run

    out = tmp_path / "out"
    asked = ["compare", "position", "--formulations", "tikhonov,lasso", "--selector", "reml,1.0", "--out", str(out)]
    assert run(monkeypatch, *asked) == 0
    said = capsys.readouterr().out
    assert "Comparison: 4 methods on 1 problem, 4 replicates (3 ok, 1 impossible)" in said
    assert sorted(path.name for path in out.iterdir()) == [
        "README.md", "comparison.png", "comparison.svg", "metrics.json", "replicates.csv",
    ]  # fmt: skip
    assert run(monkeypatch, *asked[:-2], "--splits", "2", "--seeds", "2", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert len(document["replicates"]) == 4 * 2 * 2
    assert run(monkeypatch, "compare", "position", "--formulations", "robsut") == 2
    assert "did you mean robust?" in capsys.readouterr().err
