"""The same answer from every process: bit for bit where nothing differs that counts, to rounding where it does."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro

PROGRAM = """
import json, sys
import rpim_opt as ro

answers = {}
for name, formulation, weight in (("paper_arm", ro.tikhonov, ro.reml), ("paper_arm", ro.bounded, 1e-3),
                                  ("position", ro.robust, 1.0), ("position", ro.tikhonov, ro.k_fold)):
    problem = ro.load(name).problem
    result = ro.calibrate(problem, formulation, weight)
    answers[f"{name} {formulation.name}"] = [result.weight, *result.z]
design = ro.problem.design.choose(problem, ro.problem.design.random_candidates(problem.robot, 60, 0), 8)
answers["design"] = sorted(int(i) for i in design.chosen)
json.dump(answers, sys.stdout)
"""
WEIGHT = 1e-3
"""To what a weight that a rule chose by a search comes back on another machine: the rule's own accuracy."""


@cache
def answers(**variables: str) -> dict[str, list[float]]:
    """Return what a process of its own finds, exactly as it prints its numbers."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", **variables}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=False, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("seed", ["1", pytest.param("4294967295", marks=pytest.mark.slow)])
def test_seeds_of_hashes_change_no_bit(seed: str) -> None:
    assert answers(PYTHONHASHSEED=seed) == answers(PYTHONHASHSEED="0")


@pytest.mark.slow
@pytest.mark.parametrize("threads", ["2", "4", "7"])
def test_threads_of_linear_algebra_change_no_bit(threads: str) -> None:
    """The package asks for one thread where it computes (1e-12 would do)."""
    assert answers(OPENBLAS_NUM_THREADS=threads) == answers(PYTHONHASHSEED="0")


def require_near(found: dict[str, list[float]], wanted: dict[str, list[float]], tolerance: float) -> None:
    assert found["design"] == wanted["design"]
    for name in set(wanted) - {"design"}:
        assert found[name][0] == pytest.approx(wanted[name][0], rel=WEIGHT)
        if found[name][0] == pytest.approx(wanted[name][0], rel=1e-9):
            z = np.array(wanted[name][1:])
            assert np.abs(found[name][1:] - z).max() < tolerance * np.abs(z).max()


@pytest.mark.slow
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="kernels of other machines")
@pytest.mark.parametrize("kernel", ["Nehalem", "Sandybridge", "Haswell", "SkylakeX"])
def test_kernels_of_linear_algebra_change_what_rounding_does(kernel: str) -> None:
    if kernel == "SkylakeX" and "avx512f" not in Path("/proc/cpuinfo").read_text():
        pytest.skip("a processor without these instructions")
    require_near(answers(OPENBLAS_CORETYPE=kernel), answers(PYTHONHASHSEED="0"), 1e-8)  # to which passes are repeated


@pytest.mark.slow
@pytest.mark.parametrize("workers", [2, 3])
def test_workers_change_no_bit(workers: int) -> None:
    def rows(count: int) -> list[str]:
        asked = {"splits": [3], "seeds": 2, "workers": count, "progress": False}
        found = ro.compare(["paper_arm"], ["tikhonov", "robust"], ["reml", 1.0], **asked)
        return [json.dumps({k: v for k, v in row.items() if "seconds" not in k}) for row in found.rows]

    assert rows(workers) == rows(1)
