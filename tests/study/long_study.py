"""A study of an hour, killed again and again: ``python -m tests.study.long_study FOLDER [REPLICATES WAIT KILLS]``.

A replicate is a small calibration and, so that an hour costs a shared machine some minutes of its processor, a wait.
Its process group is killed with SIGKILL at random moments and the study resumed each time; in the end every file of
its results is compared byte for byte with those of a run without waits and kills.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from random import Random
from time import monotonic

WAIT = "LONG_STUDY_WAIT"
COMMAND = "from rpim_opt.cli import main; main()"
WORKERS = 2
STARTING = 6.0
"""Seconds that a command takes before its first replicate; a kill before that would find nothing to lose."""
STUDY = f'''"""Do results depend on how often a study was killed?"""
import os, time
import numpy as np
import rpim_opt as ro
from rpim_opt.study import Metric, Report

QUESTION = "Do results depend on how often a study was killed?"
METRICS = {{"error": Metric("lower", 0.1)}}

def cases(quick):
    return [{{"seed": seed}} for seed in range(REPLICATES)]

def run(seed):
    time.sleep(float(os.environ.get("{WAIT}", "0")))
    instance = ro.load("position")
    problem = instance.problem.on(instance.problem.data.configurations(30, seed))
    found = ro.calibrate(problem, ro.tikhonov, 1.0)
    names = [name for name, free in zip(problem.parameters.names, problem.parameters.identified) if free]
    error = float(found.errors(instance.validation).mean())
    return {{"error": error, **dict(zip(names, map(float, found.x)))}}

def report(rows):
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots()
    axes.hist([row["error"] for row in rows])
    lines = [f"{{key}}: {{np.mean([row[key] for row in rows])!r}}" for key in rows[0]]
    return Report("\\n".join(lines), {{"error": float(np.mean([row["error"] for row in rows]))}}, {{"errors": figure}})
'''


def start(study: Path, out: Path, wait: float) -> subprocess.Popen[bytes]:
    """Start the study or go on with it, in a process group of its own."""
    command = [sys.executable, "-c", COMMAND, "study", str(study), "--resume"]
    command += ["--workers", str(WORKERS), "--out", str(out)]
    return subprocess.Popen(
        command, env={**os.environ, WAIT: str(wait)}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        start_new_session=True,
    )  # fmt: skip


def killed(study: Path, out: Path, wait: float, moments: list[float]) -> list[int]:
    """Run a study, killed after so many seconds each time; return how many replicates its journal had then."""
    lines = []
    journal = out / "replicates.jsonl"
    for seconds in moments:
        process = start(study, out, wait)
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            lines.append(replicates_in(journal))
            sys.stderr.write(f"killed after {seconds:.1f} s, {lines[-1]} replicates in the journal\n")
    process = start(study, out, wait)
    if process.wait() != 0:
        raise RuntimeError(f"the study ended with exit code {process.returncode}")
    return lines


def replicates_in(journal: Path) -> int:
    """Return how many replicates a journal holds; the one that a kill cut off is none."""
    if not journal.exists():
        return 0
    return max(journal.read_bytes().count(b"\n") - 1, 0)  # the first line is of the code


def long_study(folder: Path, replicates: int, wait: float, kills: int, seed: int = 0) -> dict[str, object]:
    """Run the study killed so often and once more in peace, and return what came of it."""
    folder.mkdir(parents=True, exist_ok=True)
    study = folder / "hour.py"
    study.write_text(STUDY.replace("REPLICATES", str(replicates)), encoding="utf-8")
    rng = Random(seed)
    share = replicates * wait / WORKERS / (kills + 1)
    began = monotonic()
    lines = killed(study, folder / "killed", wait, [STARTING + rng.uniform(0.4, 1.4) * share for _ in range(kills)])
    seconds = monotonic() - began
    killed(study, folder / "whole", 0.0, [])
    return {
        "replicates": replicates,
        "seconds": round(seconds),
        "replicates in the journal when killed": lines,
        "files": sorted(path.name for path in (folder / "whole").iterdir()),
        "different": different(folder / "killed", folder / "whole"),
    }


def different(one: Path, other: Path) -> list[str]:
    """Return the names of files that are not the same in two folders, byte for byte."""
    contents = [{path.name: path.read_bytes() for path in folder.iterdir()} for folder in (one, other)]
    names = {*contents[0], *contents[1]}
    return sorted(name for name in names if contents[0].get(name) != contents[1].get(name))


def main(arguments: list[str]) -> int:
    """Run it, write down what came of it, and fail where a file differs."""
    folder = Path(arguments[0])
    replicates, wait, kills = (*arguments[1:], *("3000", "2.3", "10")[len(arguments) - 1 :])
    found = long_study(folder, int(replicates), float(wait), int(kills))
    (folder / "found.json").write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    sys.stdout.write(json.dumps(found, indent=2) + "\n")
    return int(bool(found["different"]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
