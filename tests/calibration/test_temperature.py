"""Temperature: all lengths of a robot grow with it, by one coefficient that the data tell (simulated)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rpim_opt as ro
from rpim_opt.calibration.lack_of_fit import lack_of_fit
from rpim_opt.robot import model_parameters
from rpim_opt.robot.parameters import EXPANSION, REFERENCE
from rpim_opt.study.arms import BASE, KINDS, SCALES, TOOL

ALUMINIUM = 23e-6
"""[1/K]"""
ZERO = 273.15
SEED = 3
COUNT = 25


def warmed(expansion: float, seed: int = SEED) -> ro.CalibrationProblem:
    """Return a simulated arm that warms up from 20 to 40 degrees Celsius while it is measured."""
    problem = ro.study.simulated_arm(seed, COUNT).problem
    celsius = 40 - 20 * np.exp(-np.arange(COUNT) / 12)
    p = table(problem, seed, celsius.mean() + ZERO)
    data = problem.data
    plain = ro.Dataset.of(data.q, data.blocks[0].y, 3e-5, columns={"temperature": celsius + ZERO})
    probe = ro.CalibrationProblem(problem.robot, p.identify([EXPANSION]), plain)
    moved = probe.modelled(np.array([expansion]))[0] - probe.modelled(np.zeros(1))[0]
    y = data.blocks[0].y + moved
    return probe.with_parameters(p).on(ro.Dataset.of(data.q, y, 3e-5, columns={"temperature": celsius + ZERO}))


def table(problem: ro.CalibrationProblem, seed: int, reference: float) -> ro.robot.Parameters:
    """Return the parameters of a simulated arm whose lengths are as on the drawing at some temperature [K]."""
    found = model_parameters(problem.robot, list(BASE), {"": list(TOOL)}, temperature=reference).scaled(SCALES)
    return found.identify(["alpha?", "a?", "d?", "theta?", *KINDS[list(KINDS)[seed % 3]], "base_*", "tool_[xyz]"])


def off(result: ro.Calibration) -> float:
    """Return the RMS [m] of unseen positions at the mean temperature."""
    return float(np.sqrt(np.mean(result.errors(ro.study.simulated_arm(SEED, COUNT).true) ** 2)))


@pytest.fixture(scope="module")
def problem() -> ro.CalibrationProblem:
    return warmed(ALUMINIUM)


@pytest.fixture(scope="module")
def automatic(problem: ro.CalibrationProblem) -> ro.Calibration:
    return ro.calibrate(problem, model="auto")


def test_all_lengths_grow_alike(problem: ro.CalibrationProblem) -> None:
    own = problem.with_parameters(problem.parameters.identify([EXPANSION, "a?", "d?"]))
    free = own.parameters.free
    names = free.names
    growth = np.zeros(len(names))
    growth[names.index(EXPANSION)] = 1e-4
    kelvin = problem.data.temperatures - problem.parameters.nominal[problem.parameters.names.index(REFERENCE)]
    grown = own.modelled(growth)[0]
    for row in (0, 12, 24):  # the same arm with longer links, one temperature at a time
        longer = np.array([1e-4 * kelvin[row] * v for v in free.nominal])
        longer[names.index(EXPANSION)] = 0.0
        assert np.allclose(grown[row], own.modelled(longer)[0][row], atol=1e-12)


def test_the_evidence_takes_it_and_finds_the_coefficient(automatic: ro.Calibration) -> None:
    learned = automatic.learned
    assert learned is not None
    assert learned.extensions == ("temperature",)
    i = automatic.problem.parameters.free.names.index(EXPANSION)
    sd = np.sqrt(automatic.covariance[i, i])
    assert sd < 2e-6
    assert abs(automatic.x[i] - ALUMINIUM) < 4 * sd
    assert f"Thermal expansion: {1e6 * automatic.x[i]:.3g} um/(m K)." in str(automatic)


def test_the_robot_is_found_as_if_it_had_not_warmed_up(
    problem: ro.CalibrationProblem, automatic: ro.Calibration
) -> None:
    still = ro.calibrate(ro.study.simulated_arm(SEED, COUNT).problem)
    cold = ro.calibrate(problem)
    assert off(automatic) < 1.05 * off(still)
    assert off(cold) > 1.5 * off(still)
    assert lack_of_fit(cold).missing == ("temperature",)
    assert "add expansion to `identify`" in str(lack_of_fit(cold))


def test_it_is_not_taken_where_nothing_grows() -> None:
    steady = warmed(0.0)
    learned = ro.calibrate(steady, model="auto").learned
    assert learned is not None
    assert "temperature" not in learned.extensions
    explicit = steady.with_parameters(steady.parameters.identify([*steady.parameters.free.names, EXPANSION]))
    assert off(ro.calibrate(explicit)) < 1.02 * off(ro.calibrate(steady))


def test_predictions_are_at_the_mean_temperature_or_at_a_stated_one(
    automatic: ro.Calibration, problem: ro.CalibrationProblem
) -> None:
    q = problem.data.q[:4]
    p = automatic.problem.parameters
    mean = p.nominal[p.names.index(REFERENCE)]
    there = automatic.forward(q)
    assert np.allclose(automatic.forward(q, columns={"temperature": np.full(4, mean)}), there, atol=1e-15)
    warm = automatic.forward(q, columns={"temperature": np.full(4, mean + 10.0)})
    growth = np.linalg.norm(warm[:, :3, 3] - there[:, :3, 3], axis=1)
    assert (growth > 0.5 * 10 * ALUMINIUM * 0.2).all()  # of some decimetres and more
    assert (growth < 2.0 * 10 * ALUMINIUM * 1.5).all()
    ro.use.identified(automatic)  # what a file holds is the robot at that temperature


def test_temperatures_come_back_from_a_file(automatic: ro.Calibration, tmp_path: Path) -> None:
    ro.store.save_result(automatic, tmp_path)
    again = ro.load_result(tmp_path)
    assert np.array_equal(again.problem.data.temperatures, automatic.problem.data.temperatures)
    assert np.allclose(again.errors(), automatic.errors(), atol=1e-12)


def test_tables_state_it_in_degrees_celsius_or_kelvin(problem: ro.CalibrationProblem) -> None:
    data = problem.data
    columns = {f"q{i + 1}_rad": data.q[:, i] for i in range(6)}
    columns |= {f"{axis}_m": data.blocks[0].y[:, k] for k, axis in enumerate("xyz")}
    noise = {"position_mm": 0.03}
    read = [
        ro.read_data({**columns, name: data.temperatures - zero}, problem.robot, noise).temperatures
        for name, zero in (("temperature_C", ZERO), ("temperature_degC", ZERO), ("temperature_K", 0.0))
    ]
    for temperatures in read:
        assert np.allclose(temperatures, data.temperatures, atol=1e-9)
    parameters = ro.problem.starting_parameters(problem.robot, data)
    reference = parameters.names.index(REFERENCE)
    assert parameters.nominal[reference] == pytest.approx(data.temperatures.mean())
    stated = ro.problem.starting_parameters(problem.robot, data, temperature=ZERO + 20)
    assert stated.nominal[reference] == ZERO + 20
