"""Studies: the same results whoever computes them, resumed where they were, gated against a baseline."""

from __future__ import annotations

import json
import os
import signal
import warnings
from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.study import grid, journal, report
from rpim_opt.study.runner import run_study
from tests import SHARED
from tests.test_cli import run

TOY = """
from rpim_opt.study import Metric, Report
import numpy as np

QUESTION = "Do random numbers have a mean?"
METRICS = {"mean": Metric("lower", 0.1)}


def cases(quick):
    return [{"seed": seed} for seed in range(4 if quick else 12)]


def run(seed):
    if LOG:
        with open(LOG, "a") as stream:
            stream.write(f"{seed}\\n")
    if STOP and seed == 3:
        raise KeyboardInterrupt
    return {"value": float(np.random.default_rng(seed).uniform())}


def report(rows):
    return Report(f"{len(rows)} numbers", {"mean": float(np.mean([row["value"] for row in rows]))})
"""


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "studies"
    folder.mkdir()
    for module in (grid, journal, report):
        monkeypatch.setattr(module, "studies_folder", lambda: folder)

    def write(stop: bool = False) -> Path:
        grid.load_study.cache_clear()
        log = str(folder / "log.txt")
        (folder / "toy.py").write_text(TOY.replace("QUESTION", f"LOG, STOP = {log!r}, {stop}\nQUESTION", 1))
        return folder

    return write


def values(folder: Path) -> list[float]:
    from pyarrow import parquet

    return parquet.read_table(folder / "replicates.parquet").column("value").to_pylist()


def test_results_do_not_depend_on_the_workers(toy, tmp_path: Path) -> None:
    toy()
    counts = []
    one, _ = run_study("toy", out=tmp_path / "one", progress=lambda done, every: counts.append((done, every)))
    two, _ = run_study("toy", workers=2, out=tmp_path / "two")
    assert values(tmp_path / "one") == values(tmp_path / "two")
    assert one.metrics == two.metrics
    assert counts == [(k, 12) for k in range(13)]
    assert json.loads((tmp_path / "one" / "metrics.json").read_text()) == one.metrics
    text = (tmp_path / "one" / "README.md").read_text()
    assert text.startswith("# Do random numbers have a mean?\n")
    for part in ("rpim-opt study toy`", "12 replicates", "numpy", "clarabel", "commit"):
        assert part in text


def test_a_dask_cluster_gives_the_same(toy, tmp_path: Path) -> None:

    toy()
    here, _ = run_study("toy", out=tmp_path / "here")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the cluster's own, of ports and event loops
        from distributed import LocalCluster

        with LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None) as cluster:
            there, _ = run_study("toy", scheduler=cluster.scheduler_address, out=tmp_path / "there")
    assert there.metrics == here.metrics
    assert values(tmp_path / "here") == values(tmp_path / "there")


def test_a_killed_study_resumes_and_loses_nothing(toy, tmp_path: Path) -> None:
    folder, out = toy(stop=True), tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        run_study("toy", out=out)
    journal = out / "replicates.jsonl"
    assert len(journal.read_text().splitlines()) == 3
    with journal.open("a") as stream:
        stream.write('{"case": {"seed": 5}, "fou')  # cut off while it was written
    toy(stop=False)
    (folder / "log.txt").unlink()
    resumed, _ = run_study("toy", out=out, resume=True)
    assert (folder / "log.txt").read_text().split() == [str(k) for k in range(3, 12)]
    assert not journal.exists()
    fresh, _ = run_study("toy", out=tmp_path / "fresh")
    assert resumed.metrics == fresh.metrics


def test_the_gate(toy, tmp_path: Path) -> None:
    folder = toy()
    mean = run_study("toy", quick=True, out=tmp_path / "out")[0].metrics["mean"]
    with pytest.raises(ro.InputError, match="baseline: found none for 'toy-quick'"):
        report.regressions("toy", True, {"mean": mean})
    (folder / "baselines.json").write_text(json.dumps({"toy-quick": {"mean": mean}}))
    assert report.regressions("toy", True, {"mean": 1.09 * mean}) == []
    assert "lower is better, tolerance 10%" in report.regressions("toy", True, {"mean": 1.11 * mean})[0]
    assert report.regressions("toy", True, {})
    assert report.regressions("toy", True, {"mean": float("nan")})


def test_the_command(toy, tmp_path, monkeypatch, capsys) -> None:
    folder = toy()
    assert run(monkeypatch, "study", "toy", "--quick", "--out", str(tmp_path / "out")) == 0
    assert "4 numbers" in capsys.readouterr().out
    (folder / "baselines.json").write_text(json.dumps({"toy-quick": {"mean": 1e-9}}))
    assert run(monkeypatch, "study", "toy", "--quick", "--gate", "--out", str(tmp_path / "out")) == 1
    assert "Worse: mean: found" in capsys.readouterr().err
    assert run(monkeypatch, "study", "tay") == 2
    assert "did you mean toy?" in capsys.readouterr().err
    (folder / "broken.py").write_text("QUESTION = 1\n")
    assert run(monkeypatch, "study", "broken") == 2
    assert "no 'METRICS'" in capsys.readouterr().err


BENCH = SHARED / "bench"


@pytest.mark.skipif(not BENCH.is_dir(), reason="the peers' benchmark ../shared/bench is not here")
@pytest.mark.parametrize("situation", ["clean52", "few10", "blunders52"])
def test_peers_study_draws_the_shared_benchmark(situation: str, tmp_path: Path):
    peers = grid.load_study(grid.find_study("peers"))
    peers.write_problem(tmp_path, situation, 0)
    for name in ("calib", "valid"):
        ours, theirs = (folder / f"{name}.csv" for folder in (tmp_path, BENCH / situation))
        assert ours.read_text().splitlines()[0] == theirs.read_text().splitlines()[0]
        rows = [np.loadtxt(path, delimiter=",", skiprows=1) for path in (ours, theirs)]
        np.testing.assert_allclose(*rows, rtol=0, atol=1.5e-9)  # nine decimals, the last one rounded


def test_a_study_prepares_once_before_its_cases(toy, tmp_path: Path):
    folder = toy()
    path = folder / "toy.py"
    path.write_text(
        path.read_text()
        + f"\n\ndef prepare(quick):\n    with open({str(tmp_path / 'p')!r}, 'a') as f:\n        f.write('x')\n"
    )
    run_study("toy", quick=True, out=tmp_path / "out")
    assert (tmp_path / "p").read_text() == "x"


MONTE_CARLO = """
import numpy as np
import rpim_opt as ro
from rpim_opt.study import Metric, Report

QUESTION = "How do 1000 calibrations of the paper's arm scatter?"
METRICS = {"mean": Metric("lower", 0.0)}


def cases(quick):
    return [{"seed": seed} for seed in range(1000)]


def run(seed):
    instance = ro.load("paper_arm")
    data = instance.problem.data
    y = data.blocks[0].y + 3e-5 * np.random.default_rng(seed).normal(size=data.blocks[0].y.shape)
    result = ro.calibrate(instance.problem.on(ro.Dataset.of(data.q, y, 3e-5)), ro.tikhonov, ro.reml)
    return {"value": float(1e3 * result.errors(instance.validation).mean())}


def report(rows):
    return Report(f"{len(rows)} calibrations", {"mean": float(np.mean([row["value"] for row in rows]))})
"""


@pytest.mark.slow
def test_a_killed_worker_of_a_cluster_loses_no_replicate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (grid, journal, report):
        monkeypatch.setattr(module, "studies_folder", lambda: tmp_path)
    (tmp_path / "monte_carlo.py").write_text(MONTE_CARLO)
    here, _ = run_study("monte_carlo", out=tmp_path / "here")
    killed: list[int] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the cluster's own, of ports, event loops and the worker that dies
        from distributed import Client, LocalCluster

        with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None) as cluster:
            with Client(cluster) as client:
                workers = list(client.run(os.getpid).values())

            def progress(done: int, of: int) -> None:
                if done == 300:
                    os.kill(workers[0], signal.SIGKILL)
                    killed.append(done)

            address = cluster.scheduler_address
            there, _ = run_study("monte_carlo", scheduler=address, out=tmp_path / "there", progress=progress)
    assert killed == [300]
    assert values(tmp_path / "there") == values(tmp_path / "here")
    assert len(values(tmp_path / "there")) == 1000
    assert there.metrics == here.metrics


def test_a_report_is_redrawn_from_the_replicates(toy, tmp_path: Path) -> None:
    folder, out = toy(), tmp_path / "out"
    found, _ = run_study("toy", out=out)
    before = (out / "README.md").read_text()
    (folder / "log.txt").unlink()
    again, _ = run_study("toy", out=out, redraw=True)
    assert again.metrics == found.metrics
    assert (out / "README.md").read_text() == before
    assert not (folder / "log.txt").exists()  # nothing was computed
    with pytest.raises(ro.InputError, match="no replicates"):
        run_study("toy", out=tmp_path / "empty", redraw=True)
