"""What is stated of scales and noise may be wrong by ten: what is learned from the data makes up for it.

Simulated arms with complete errors and 0.05 mm of noise; errors are those of the model without noise elsewhere.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from tests.simulate import simulated

pytestmark = pytest.mark.slow

NOISE = 5e-5
TEN = 10.0
COUNTS = {10: 24, 25: 12}
"""Arms by the number of configurations."""


def scaled(problem: ro.CalibrationProblem, factor: float) -> ro.CalibrationProblem:
    """Return the problem with other scales of the robot's parameters."""
    p = problem.parameters
    return replace(problem, parameters=replace(p, scale=np.where(p.of_frames, 1.0, factor) * p.scale))


def declared(problem: ro.CalibrationProblem, factor: float) -> ro.CalibrationProblem:
    """Return the problem with another declared noise."""
    y = problem.data.blocks[0].y
    return problem.on(ro.Dataset.of(problem.data.q, y, factor * NOISE))


WRONG = {
    "scales ten times too large": lambda problem: ro.calibrate(scaled(problem, TEN)).x,
    "scales ten times too small": lambda problem: ro.calibrate(scaled(problem, 1 / TEN)).x,
    "noise ten times too small": lambda problem: ro.calibrate(declared(problem, 1 / TEN)).x,
    "noise ten times too large, free": lambda problem: ro.calibrate(declared(problem, TEN), noise="free").x,
}


def ratios(count: int, seed: int) -> list[float]:
    """Return the error after each wrong statement over that after right ones."""
    problem, truth = simulated(configurations=count, noise=NOISE, seed=seed, sigma=NOISE)
    other, _ = simulated(configurations=200, seed=900 + seed)
    elsewhere = problem.on(other.data)
    there = elsewhere.modelled(truth)[0]

    def error(x: Array) -> float:
        return float(np.linalg.norm(elsewhere.modelled(x)[0] - there))

    right = error(ro.calibrate(problem).x)
    return [error(wrong(problem)) / right for wrong in WRONG.values()]


@pytest.mark.parametrize("count", COUNTS)
def test_what_is_learned_makes_up_for_it(count: int) -> None:
    """Five percent in the geometric mean, 1.6 times in the worst case: what was asked for."""
    found = np.array([ratios(count, 100 * count + seed) for seed in range(COUNTS[count])])
    mean = np.exp(np.log(found).mean(axis=0))
    said = {name: f"{m:.3f}, {worst:.2f}" for name, m, worst in zip(WRONG, mean, found.max(axis=0), strict=True)}
    assert (mean <= 1.05).all(), said
    assert (found <= 1.6).all(), said
