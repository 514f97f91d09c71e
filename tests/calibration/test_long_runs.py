"""Thousands of calibrations in one process, each with a shape and functions of its own: nothing grows."""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path

import cvxpy as cp
import numpy as np
import pytest

import rpim_opt as ro
from tests.simulate import simulated

WARM = 200
"""Calibrations until what is kept on purpose (a bounded number of compiled programs) is full."""
COUNT = WARM + int(os.environ.get("LONG_RUN", "800"))


def calibrated(i: int) -> None:
    """Calibrate a problem of another shape with functions that nobody has seen before."""
    rng = np.random.default_rng(i)
    some = [name for name in ("a?", "d?", "theta?", "alpha?", "base_*") if rng.random() < 0.6] or ["d?"]
    problem, _ = simulated(tuple(some), configurations=int(rng.integers(10, 25)), noise=5e-5, seed=i)
    size = rng.uniform(0.5, 2.0, len(problem.parameters.free))
    stated = ro.Formulation(
        f"mine {i}", loss=lambda r: cp.sum_squares(r), penalty=lambda z: cp.sum_squares(cp.multiply(size, z))
    )
    if i % 10 == 0:  # one that a solver solves
        stated = ro.Formulation(f"mine {i}", loss=lambda r: cp.sum_squares(r), penalty=lambda z: cp.norm1(size @ z))
    result = ro.calibrate(problem, stated, float(rng.uniform(0.1, 10)))
    assert np.isfinite(result.x).all()


def memory() -> float:
    """Return the megabytes that the process holds now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / 1e6


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="memory is read from /proc")
def test_calibrations_do_not_pile_up() -> None:
    for i in range(WARM):
        calibrated(i)
    gc.collect()
    objects = len(gc.get_objects())
    megabytes = memory()
    for i in range(WARM, COUNT):
        calibrated(i)
    gc.collect()
    grown = memory() - megabytes
    print(f"{COUNT} calibrations: {grown:.1f} MB on {megabytes:.0f}, {len(gc.get_objects()) - objects} objects")
    assert len(gc.get_objects()) - objects < 0.02 * objects
    assert grown < 30
