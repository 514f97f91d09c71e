"""Studies: the same results whoever computes them, resumed where they were, gated against a baseline."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.study import studies
from rpim_opt.study.studies import compute, run_study
from tests.test_cli import run

TOY = """
from pathlib import Path
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
    if STOP.exists() and seed == 3:
        raise KeyboardInterrupt
    return {"value": float(np.random.default_rng(seed).uniform())}


def report(rows):
    return Report(f"{len(rows)} numbers", {"mean": float(np.mean([row["value"] for row in rows]))})
"""


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "studies"
    folder.mkdir()
    monkeypatch.setattr(studies, "STUDIES", folder)

    def write(stop: bool = False) -> Path:
        studies.load_study.cache_clear()
        log = str(tmp_path / "log.txt")
        flag = tmp_path / "stop"
        flag.unlink(missing_ok=True)
        if stop:
            flag.touch()
        (folder / "toy.py").write_text(
            TOY.replace("QUESTION", f"LOG, STOP = {log!r}, Path({str(flag)!r})\nQUESTION", 1)
        )
        return folder

    return write


def values(folder: Path) -> list[float]:
    from pyarrow import parquet

    return parquet.read_table(folder / "replicates.parquet").column("value").to_pylist()


def _answers() -> dict[str, bool]:
    return {"ignored": signal.getsignal(signal.SIGINT) == signal.SIG_IGN}


def test_an_interrupt_is_for_the_process_that_waits_for_the_others() -> None:
    before = signal.getsignal(signal.SIGINT)
    assert list(compute([("a", _answers)], 2)) == [("a", {"ignored": True})]
    assert signal.getsignal(signal.SIGINT) == before


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
    for part in ("rpim-opt study toy`, toy.py with", "(in no repository)", "12 replicates", "numpy", "clarabel"):
        assert part in text


def entries(journal: Path) -> list[tuple[str, dict]]:
    """Return what a journal holds of replicates."""
    return [json.loads(line) for line in journal.read_text().splitlines()[1:]]


def test_a_killed_study_resumes_and_loses_nothing(toy, tmp_path: Path) -> None:
    toy(stop=True)
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        run_study("toy", out=out)
    journal = out / "replicates.jsonl"
    assert len(entries(journal)) == 3
    with pytest.raises(ro.InputError, match="resume: found 3 replicates of an interrupted run"):
        run_study("toy", out=out)  # nobody has said that they may be dropped
    with pytest.raises(KeyboardInterrupt):
        run_study("toy", out=out, resume=True)
    toy(stop=False)
    (tmp_path / "log.txt").unlink()
    resumed, _ = run_study("toy", out=out, resume=True)
    assert (tmp_path / "log.txt").read_text().split() == [str(k) for k in range(3, 12)]
    assert not journal.exists()
    fresh, _ = run_study("toy", out=tmp_path / "fresh")
    assert resumed.metrics == fresh.metrics


def test_a_killed_study_begins_anew_where_that_is_said(toy, tmp_path: Path) -> None:
    toy(stop=True)
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        run_study("toy", out=out)
    toy(stop=False)
    (tmp_path / "log.txt").unlink()
    run_study("toy", out=out, resume=False)
    assert (tmp_path / "log.txt").read_text().split() == [str(k) for k in range(12)]


def test_the_gate(toy, tmp_path: Path) -> None:
    folder = toy()
    mean = run_study("toy", quick=True, out=tmp_path / "out")[0].metrics["mean"]
    with pytest.raises(ro.InputError, match="baseline: found none for 'toy-quick'"):
        studies.regressions("toy", True, {"mean": mean})
    (folder / "baselines.json").write_text(json.dumps({"toy-quick": {"mean": mean}}))
    assert studies.regressions("toy", True, {"mean": 1.09 * mean}) == []
    assert "lower is better, tolerance 10%" in studies.regressions("toy", True, {"mean": 1.11 * mean})[0]
    assert studies.regressions("toy", True, {})
    assert studies.regressions("toy", True, {"mean": float("nan")})


def test_the_command(toy, tmp_path, monkeypatch, capsys) -> None:
    folder = toy()
    assert run(monkeypatch, "study", "toy", "--quick", "--out", str(tmp_path / "out")) == 0
    assert "4 numbers" in capsys.readouterr().out
    (folder / "baselines.json").write_text(json.dumps({"toy-quick": {"mean": 1e-9}}))
    assert run(monkeypatch, "study", "toy", "--quick", "--gate", "--out", str(tmp_path / "out")) == 1
    assert "Worse: mean: found" in capsys.readouterr().out
    assert run(monkeypatch, "study", "tay") == 2
    assert "did you mean toy?" in capsys.readouterr().err
    (folder / "broken.py").write_text("QUESTION = 1\n")
    assert run(monkeypatch, "study", "broken") == 2
    assert "no 'METRICS'" in capsys.readouterr().err


@pytest.mark.parametrize("seed", [0, 1, 2, 5])
def test_peers_study_gives_every_tool_the_same_arm(seed: int, tmp_path: Path):
    peers = studies.load_study(studies.find_study("peers"))
    peers.write_problem(tmp_path, "clean10", seed)
    known = json.loads((tmp_path / "robot.json").read_text())
    rows = np.array(known["alpha_a_theta_d"])
    robot = ro.robot.Robot("rows", np.column_stack([rows, np.zeros(len(rows))]))
    calib = np.loadtxt(tmp_path / "calib.csv", delimiter=",", skiprows=1)
    data = ro.Dataset.of(calib[:, 3:], calib[:, :3], known["noise"])

    def seen(arm: ro.robot.Robot, base: list[float], tool: list[float]) -> Array:
        parameters = ro.robot.model_parameters(arm, base=base, tools={"": tool}).identify(["base_x"])
        return ro.CalibrationProblem(arm, parameters, data).modelled(np.zeros(1))[0]

    of_rows = seen(robot, known["base"], [*known["tool"], 0.0, 0.0, 0.0])
    described = ro.read_urdf(tmp_path / "robot.urdf", "instrument", "smr")
    of_urdf = seen(described.robot, list(described.base), list(described.tool))
    np.testing.assert_allclose(of_urdf, of_rows, rtol=0, atol=1e-11)
    assert np.linalg.norm(calib[:, :3] - of_rows, axis=1).max() < 0.1  # a degree of one joint, and millimetres


def test_peers_study_adds_errors_to_so_many_rows_as_it_says(tmp_path: Path):
    peers = studies.load_study(studies.find_study("peers"))
    points = {}
    for situation in ("clean52", "blunders52"):
        folder = tmp_path / situation
        folder.mkdir()
        peers.write_problem(folder, situation, 3)
        points[situation] = np.loadtxt(folder / "calib.csv", delimiter=",", skiprows=1)
    off = np.linalg.norm((points["blunders52"] - points["clean52"])[:, :3], axis=1)
    assert np.sum(off > 0) == 3
    np.testing.assert_allclose(off[off > 0], 3e-3, atol=2e-9)  # nine decimals
    np.testing.assert_array_equal(points["blunders52"][:, 3:], points["clean52"][:, 3:])


def test_a_run_that_returns_no_figures_by_name_is_refused_at_its_first_case(toy, tmp_path: Path) -> None:
    """It ended in a traceback after the last one."""
    file = toy() / "toy.py"
    file.write_text(
        file.read_text().replace('return {"value": float(', "return [float(").replace("uniform())}", "uniform())]")
    )
    studies.load_study.cache_clear()
    with pytest.raises(ro.InputError, match=r"toy.py, run of the study: found list, accepted: a dict of figures"):
        run_study("toy", quick=True, out=tmp_path / "out")
    assert (tmp_path / "log.txt").read_text().splitlines() == ["0"]


def test_a_study_prepares_once_before_its_cases(toy, tmp_path: Path):
    folder = toy()
    path = folder / "toy.py"
    path.write_text(
        path.read_text()
        + f"\n\ndef prepare(quick):\n    with open({str(tmp_path / 'p')!r}, 'a') as f:\n        f.write('x')\n"
    )
    run_study("toy", quick=True, out=tmp_path / "out")
    assert (tmp_path / "p").read_text() == "x"


def test_a_report_is_redrawn_from_the_replicates(toy, tmp_path: Path) -> None:
    toy()
    out = tmp_path / "out"
    found, _ = run_study("toy", out=out)
    before = (out / "README.md").read_text()
    (tmp_path / "log.txt").unlink()
    again, _ = run_study("toy", out=out, redraw=True)
    assert again.metrics == found.metrics
    assert (out / "README.md").read_text() == before
    assert not (tmp_path / "log.txt").exists()  # nothing was computed
    with pytest.raises(ro.InputError, match="no replicates"):
        run_study("toy", out=tmp_path / "empty", redraw=True)


def test_a_report_that_fails_leaves_its_replicates(toy, tmp_path: Path) -> None:
    """They were lost: neither --resume nor --redraw took them, as the file had to be corrected."""
    file = toy() / "toy.py"
    right = file.read_text()
    file.write_text(right.replace("def report(rows):", "def report(rows):\n    rows.groupby('seed')"))
    studies.load_study.cache_clear()
    with pytest.raises(AttributeError):
        run_study("toy", out=tmp_path / "out")
    computed = (tmp_path / "log.txt").read_text()
    file.write_text(right)
    studies.load_study.cache_clear()
    report, folder = run_study("toy", out=tmp_path / "out", redraw=True)
    assert report.metrics
    assert (folder / "README.md").exists()
    assert (tmp_path / "log.txt").read_text() == computed


def interrupted(toy, out: Path) -> Path:
    """Return the journal of a study that was stopped."""
    toy(stop=True)
    with pytest.raises(KeyboardInterrupt):
        run_study("toy", out=out)
    toy(stop=False)
    return out / "replicates.jsonl"


def test_a_full_disk_below_a_journal_is_a_sentence(toy, tmp_path: Path) -> None:
    journal = interrupted(toy, tmp_path / "out")
    journal.unlink()
    journal.symlink_to("/dev/full")
    with pytest.raises(OSError, match=r"cannot be written: No space left.*replicates.jsonl"):
        run_study("toy", out=tmp_path / "out", resume=False)


def test_a_line_that_was_not_finished_is_computed_again(toy, tmp_path: Path) -> None:
    journal = interrupted(toy, tmp_path / "out")
    journal.write_bytes(journal.read_bytes()[:-5])
    (tmp_path / "log.txt").unlink()
    run_study("toy", out=tmp_path / "out", resume=True)
    assert (tmp_path / "log.txt").read_text().split() == [str(k) for k in range(2, 12)]


def test_a_journal_of_other_code_is_refused(toy, tmp_path: Path) -> None:
    journal = interrupted(toy, tmp_path / "out")
    before = journal.read_bytes()
    path = studies.STUDIES / "toy.py"
    path.write_text(path.read_text().replace(".uniform()", ".normal()"))
    studies.load_study.cache_clear()
    with pytest.raises(ro.InputError, match=r"replicates of another file toy\.py"):
        run_study("toy", out=tmp_path / "out", resume=True)
    assert journal.read_bytes() == before
    run_study("toy", out=tmp_path / "out", resume=False)  # anew


ODD = {
    "a table": b"label,q1_deg\nA,1\n",
    "zero bytes": b"\0" * 4096,
    "no text": b"\xff\xfe",
    "half a journal": b'["code", {}]\n["a", {"b": 1}\n',
    "a link to a device": b"",
}


@pytest.mark.parametrize("odd", ODD)
def test_odd_journals_are_one_sentence(toy, tmp_path: Path, monkeypatch, capsys, odd: str) -> None:
    journal = interrupted(toy, tmp_path / "out")
    journal.write_bytes(ODD[odd])
    if "link" in odd:
        journal.unlink()
        journal.symlink_to("/dev/null")
    assert run(monkeypatch, "study", "toy", "--resume", "--out", str(tmp_path / "out")) == 2
    said = capsys.readouterr().err
    assert "replicates.jsonl" in said
    assert said.count("\n") == 1
    assert journal.read_bytes() == ODD[odd]


def test_a_journal_that_was_only_begun_begins_anew(toy, tmp_path: Path) -> None:
    journal = interrupted(toy, tmp_path / "out")
    fresh = run_study("toy", out=tmp_path / "fresh")[0].metrics
    for content in (b"", b'["code", {}]\n'):
        journal.write_bytes(content)
        assert run_study("toy", out=tmp_path / "out", resume=True)[0].metrics == fresh


@pytest.mark.parametrize("kind", ["fifo", "folder"])
def test_a_journal_that_is_no_file_is_refused(toy, tmp_path: Path, kind: str) -> None:
    journal = interrupted(toy, tmp_path / "out")
    journal.unlink()
    if kind == "fifo":
        os.mkfifo(journal)
    else:
        journal.mkdir()
    with pytest.raises(ro.InputError, match="accepted: a regular file"):
        run_study("toy", out=tmp_path / "out", resume=True)


def test_a_study_writes_all_its_results_or_none(toy, tmp_path: Path, monkeypatch) -> None:
    toy()
    out = tmp_path / "out"
    run_study("toy", quick=True, out=out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert set(before) == {"README.md", "metrics.json", "replicates.parquet"}
    real = os.fsync

    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        run_study("toy", out=out)
    after = {path.name: path.read_bytes() for path in out.iterdir() if path.name != "replicates.jsonl"}
    assert after == before
    monkeypatch.setattr(os, "fsync", real)
    resumed, _ = run_study("toy", out=out, resume=True)  # nothing is computed again
    assert "12 numbers" in resumed.text
    assert sorted(path.name for path in out.iterdir()) == sorted(before)


def test_a_broken_table_of_replicates_is_one_sentence(toy, tmp_path: Path) -> None:
    toy()
    run_study("toy", quick=True, out=tmp_path / "out")
    table = tmp_path / "out" / "replicates.parquet"
    table.write_bytes(table.read_bytes()[:-7])
    with pytest.raises(ro.InputError, match="accepted: the replicates of a study"):
        run_study("toy", quick=True, out=tmp_path / "out", redraw=True)
