"""Robots that have only touched things that nobody measured, beside robots that a tracker calibrated.

Simulated: a seven-axis arm, deviations drawn with the scales, 0.03 mm of noise a touch. What it touches: ten sockets,
six times each, without and with two known distances; six ball bars; the faces of three datum cubes. Beside each 60
positions of a tracker of the same noise. Judged by touches of four sockets elsewhere that nothing has seen: what they
are off the mean of their socket, which is what contact can see of a robot.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.basics.text import markdown
from rpim_opt.data import KnownAngle, KnownDistance, touches, with_known
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.study import Metric, Report

QUESTION = "How accurate is calibration by contact with unmeasured points, compared with a laser tracker?"
SIGMA = 3e-5
SHARE = 0.9
SOCKETS = {
    "A": [0.40, -0.25, 0.10], "B": [0.40, 0.00, 0.10], "C": [0.40, 0.25, 0.10], "D": [0.50, -0.25, 0.35],
    "E": [0.55, 0.00, 0.35], "F": [0.50, 0.25, 0.35], "G": [0.70, -0.25, 0.25], "H": [0.80, -0.25, 0.10],
    "I": [0.70, 0.00, 0.60], "J": [0.80, 0.25, 0.10],
}  # fmt: skip
ELSEWHERE = {"V1": [0.45, -0.2, 0.2], "V2": [0.6, 0.1, 0.1], "V3": [0.85, 0.2, 0.2], "V4": [0.5, 0.1, 0.5]}
CUBES = ([0.45, -0.2, 0.2], [0.6, 0.15, 0.15], [0.7, -0.05, 0.45])
SIDE = 0.1
ARTEFACTS = ("sockets", "sockets, two distances", "ball bars", "datum cubes")
METRICS = {"worst_ratio": Metric("lower", 0.1), "worst_arm": Metric("lower", 0.1), "coverage": Metric("higher", 0.02)}


def cases(quick: bool) -> list[dict[str, Any]]:
    """Return every artefact with every seed."""
    seeds = 2 if quick else 12
    return [{"artefact": artefact, "seed": seed} for artefact in ARTEFACTS for seed in range(seeds)]


def run(artefact: str, seed: int) -> dict[str, Any]:
    """Return errors elsewhere by contact and by a tracker, and how often the intervals hold."""
    rng = np.random.default_rng([seed, 18])
    arm, truth = _world(rng)
    clean = _touched(arm, truth, ELSEWHERE, 6, rng, 0.0)
    noisy = _touched(arm, truth, ELSEWHERE, 6, rng, SIGMA)
    problem = arm.on(_data(artefact, arm, truth, rng))
    result = ro.calibrate(problem)
    seen = _tracked(arm, truth, rng)
    tracker = ro.calibrate(seen)
    sd = _deviations(result, clean)
    k = ro.calibration.Uncertainty(result).coverage_factor
    return {
        "nominal": 1e3 * float(np.nanmean(result.nominal_errors(clean))),
        "contact": 1e3 * float(np.nanmean(result.errors(clean))),
        "tracker": 1e3 * float(np.nanmean(tracker.errors(clean))),
        "contact expected": 1e3 * _expected(sd),
        "tracker expected": 1e3 * _expected(_deviations(tracker, clean)),
        "converged": bool(result.converged and tracker.converged),
        "mean covered": float(np.mean(np.abs(result.problem.on(clean).residual(result.x)) <= k * sd)),
        "readings covered": ro.use.validate(result, noisy).coverage,
    }


def _deviations(result: Any, clean: Dataset) -> Array:
    """Return the standard deviations (n,) of the model's differences elsewhere [m]."""
    J = result.problem.on(clean).jacobian(result.x)
    return np.sqrt(np.einsum("ij,jk,ik->i", J, result.covariance, J))


def _expected(sd: Array) -> float:
    """Return the root mean square distance [m] of which three differences have these standard deviations."""
    return float(np.sqrt(3 * np.mean(sd**2)))


def _world(rng: np.random.Generator) -> tuple[CalibrationProblem, Array]:
    """Return an arm that identifies all of its geometry and its tool's place, and its true deviations [SI]."""
    arm = ro.load("contact").problem
    arm = arm.with_parameters(arm.parameters.identify(["alpha?", "a?", "theta?", "d?", "tool_[xyz]"]))
    free = arm.parameters.free
    return arm, rng.normal(size=len(free)) * free.scale


def _touched(
    arm: CalibrationProblem, truth: Array, places: dict[str, Any], count: int, rng: np.random.Generator, sigma: float
) -> Dataset:
    names = np.repeat(list(places), count)
    targets = np.repeat(np.array(list(places.values())), count, axis=0)
    return touches(_reached(arm, truth, targets, rng, sigma), names.tolist(), SIGMA)


def _reached(arm: CalibrationProblem, truth: Array, targets: Array, rng: np.random.Generator, sigma: float) -> Array:
    near = targets + sigma * rng.normal(size=targets.shape)
    return ro.problem.configurations_at(arm, near, rng, truth, SHARE)


def _data(artefact: str, arm: CalibrationProblem, truth: Array, rng: np.random.Generator) -> Dataset:
    if artefact == "ball bars":
        return _ball_bars(arm, truth, rng)
    if artefact == "datum cubes":
        return _datum_cubes(arm, truth, rng)
    data = _touched(arm, truth, SOCKETS, 6, rng, SIGMA)
    if artefact == "sockets":
        return data
    pairs = (("A", "J"), ("C", "H"))
    return with_known(data, [KnownDistance(pair, float(np.linalg.norm(_apart(*pair))), 1e-5) for pair in pairs])


def _apart(one: str, other: str) -> Array:
    return np.array(SOCKETS[one]) - np.array(SOCKETS[other])


def _ball_bars(arm: CalibrationProblem, truth: Array, rng: np.random.Generator) -> Dataset:
    """Return five touches of either ball of six bars of 300 mm, anyhow in the middle of the cell."""
    places = {}
    known = []
    for i in range(6):
        middle = rng.uniform([0.45, -0.25, 0.1], [0.7, 0.25, 0.45])
        along = rng.normal(size=3)
        along *= 0.15 / np.linalg.norm(along)
        places[f"{i}a"] = middle - along
        places[f"{i}b"] = middle + along
        known.append(KnownDistance((f"{i}a", f"{i}b"), 0.3, 1e-6))
    return with_known(_touched(arm, truth, places, 5, rng, SIGMA), known)


def _datum_cubes(arm: CalibrationProblem, truth: Array, rng: np.random.Generator) -> Dataset:
    """Return ten touches of each of six faces of three cubes of 100 mm, turned anyhow."""
    names: list[str] = []
    targets = []
    known: list[Any] = []
    for i, centre in enumerate(CUBES):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        for k, axis in enumerate("xyz"):
            for side, sign in (("+", 1), ("-", -1)):
                places = rng.uniform(-0.45, 0.45, (10, 3)) * SIDE
                places[:, k] = sign * SIDE / 2
                targets.append(np.array(centre) + places @ turn.T)
                names += [f"{i}{axis}{side}"] * 10
            opposite = (f"{i}{axis}+", f"{i}{axis}-")
            known.append(KnownDistance(opposite, SIDE, 5e-6))
            known.append(KnownAngle(opposite, parallel=True, sigma=2e-5))
            known.append(KnownAngle((f"{i}{axis}+", f"{i}{'xyz'[(k + 1) % 3]}+"), parallel=False, sigma=2e-5))
    q = _reached(arm, truth, np.concatenate(targets), rng, SIGMA)
    return with_known(touches(q, names, SIGMA, planes=True), known)


def _tracked(arm: CalibrationProblem, truth: Array, rng: np.random.Generator) -> CalibrationProblem:
    """Return 60 positions of a tracker, in any configurations, with the base to be found, too."""
    q = ro.problem.random_candidates(arm.robot, 60, rng, SHARE)
    exact = arm.on(Dataset.of(q, np.zeros((60, 3)), SIGMA)).modelled(truth)[0]
    p = arm.parameters
    base = np.array([name.startswith("base_") for name in p.names])
    parameters = replace(p, identified=p.identified | base, scale=np.where(base, 0.1, p.scale))
    data = Dataset.of(q, exact + SIGMA * rng.normal(size=exact.shape), SIGMA)
    return arm.with_parameters(arm.parameters).on(data).with_parameters(parameters)


def report(rows: list[dict[str, Any]]) -> Report:
    """Return errors and coverage by artefact, and a figure of every arm."""
    lines = []
    ratios = {}
    arms = {}
    for artefact in ARTEFACTS:
        part = [row for row in rows if row["artefact"] == artefact]
        contact, tracker, nominal = (np.array([row[key] for row in part]) for key in ("contact", "tracker", "nominal"))
        ratios[artefact] = float(np.exp(np.mean(np.log(contact / tracker))))
        arms[artefact] = max(row["contact expected"] / row["tracker expected"] for row in part)
        covered = [100 * np.mean([row[f"{what} covered"] for row in part]) for what in ("mean", "readings")]
        lines.append(
            [
                artefact,
                f"{nominal.mean():.2f}",
                f"{contact.mean():.4f}",
                f"{tracker.mean():.4f}",
                f"{ratios[artefact]:.2f}",
                f"{arms[artefact]:.2f}",
                f"{(contact / tracker).max():.2f}",
                *(f"{share:.1f}" for share in covered),
            ]
        )
    head = ["touched", "nominal [mm]", "contact [mm]", "tracker [mm]", "ratio", "worst arm", "worst draw",
            "mean held [%]", "readings held [%]"]  # fmt: skip
    text = (
        "Error: distance of a touch of a socket that nothing has seen from the mean of its touches, mean over six "
        "touches of four. Ratio: geometric mean over the arms of contact's error over the tracker's. Of one arm it is "
        "as much luck, for either may do well with one draw of noise: the worst draw is the largest quotient, the "
        "worst arm that of expected errors, by the covariances of both. Held: how many of these differences lie in "
        "their 95 % intervals, of the model's and of readings with new noise.\n\n"
    )
    metrics = {
        "worst_ratio": max(ratios.values()),
        "worst_arm": max(arms.values()),
        "coverage": float(np.mean([row["mean covered"] for row in rows])),
    }
    return Report(text + markdown(head, lines), metrics, {"contact": _figure(rows)})


def _figure(rows: list[dict[str, Any]]) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3.6), layout="constrained")
    ax = figure.add_subplot()
    for k, (key, label) in enumerate(
        (("nominal", "nominal"), ("tracker", "tracker, 60 positions"), ("contact", "contact"))
    ):
        for i, artefact in enumerate(ARTEFACTS):
            values = np.array([row[key] for row in rows if row["artefact"] == artefact])
            place = i + 0.25 * (k - 1) + np.linspace(-0.08, 0.08, len(values))
            ax.plot(place, values, "o", ms=3, alpha=0.7, color=("0.6", "C0", "C1")[k], label=label if i == 0 else None)
    ax.set_yscale("log")
    ax.set_xticks(range(len(ARTEFACTS)), ARTEFACTS)
    ax.set_ylabel("error elsewhere [mm]")
    ax.legend(frameon=False, ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.13))
    return figure
