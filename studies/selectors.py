"""Compare selectors, and the default, on simulated robots: right and wrong priors, few data, wrong noise.

Simulated: the paper's arm, deviations of 0.3 mm and 1 mrad (reflector 0.5 mm), joints within 120 degrees, 0.03 mm
noise; and three other robots with errors in all directions, of sizes that nobody knows, one joint of every other robot
off by a degree (`ro.study.simulated_arm`).

The error on unseen configurations is compared with that at the best weight, which only a simulation knows. On the
paper's arm weights are chosen on one linearization at nominal, and the best is one of 60. A joint that is off by a
degree is too far for that: there every weight is that of a whole calibration, the best one of 15 or of those that were
chosen. The default learns sizes and noise instead; it is no single weight, and may be better than the best of them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import rpim_opt as ro
from rpim_opt.basics.text import markdown
from rpim_opt.study import Metric, Report, distributions

QUESTION = "Which selector comes nearest to the best weight on a robot?"
RULES = (ro.reml, ro.l_curve, ro.corner, ro.gcv, ro.leave_one_out, ro.two_step, ro.discrepancy, ro.quasi_optimality)
SITUATIONS = {  # configurations, scales over the true spread, true noise over the declared
    "as declared": (30, 1.0, 1.0),
    "9 configurations": (9, 1.0, 1.0),
    "15 configurations": (15, 1.0, 1.0),
    "scales ten times too small": (30, 0.1, 1.0),
    "scales ten times too large": (30, 10.0, 1.0),
    "noise five times the declared": (30, 1.0, 5.0),
}
COMPLETE = {"unknown sizes, 10": 10, "unknown sizes, 25": 25}
"""Configurations of the robots with errors in all directions."""
Error = Callable[[np.ndarray], float]
METHODS = ("learned", *(rule.__name__ for rule in RULES))
WHERE = (*SITUATIONS, *COMPLETE)
FIRST = 1000
"""Seed of the first case."""
METRICS = {f"{name}_p95": Metric("lower", 0.15) for name in ("learned", "reml", "l_curve", "gcv")}


def cases(quick: bool) -> list[dict[str, Any]]:
    """Return every situation, 100 seeds or 6."""
    count = 6 if quick else 100
    return [{"situation": name, "seed": seed} for name in WHERE for seed in range(FIRST, FIRST + count)]


def run(situation: str, seed: int) -> dict[str, float]:
    """Return the error over the error at the best weight, by selector and of the default."""
    problem, true = posed(situation, seed)

    def error(x: np.ndarray) -> float:
        return float(np.sqrt(np.mean(problem.on(true).errors(x) ** 2)))

    errors = linearized
    if situation in COMPLETE:
        errors = calibrated
    best, found = errors(problem, error)
    found["learned"] = error(ro.calibrate(problem).x)
    return {name: value / best for name, value in found.items()}


def linearized(problem: ro.CalibrationProblem, error: Error) -> tuple[float, dict[str, float]]:
    """Return the least error of 60 weights on the linearization at nominal, and the rules' errors there."""
    free = problem.parameters.free
    program = ro.convex.pose(ro.tikhonov, problem.linearize(np.zeros(len(free))))

    def at(weight: float) -> float:
        return error(program.path([weight])[0].z * free.scale)

    s = program.model.svd[1]
    best = min(at(w) for w in np.geomspace(1e-5 * s[s > 0][-1] ** 2, 10 * s[0] ** 2, 60))
    return best, {rule.__name__: at(rule(program).weight) for rule in RULES}


def calibrated(problem: ro.CalibrationProblem, error: Error) -> tuple[float, dict[str, float]]:
    """Return the least error of calibrations at 15 weights and by the rules, and the rules' errors."""

    def at(weight: float | Callable[..., Any]) -> float:
        return error(ro.calibrate(problem, ro.tikhonov, weight).x)

    found = {rule.__name__: at(rule) for rule in RULES}
    tried = [at(weight) for weight in np.geomspace(1e-4, 1e3, 15)]
    return min(*tried, *found.values()), found


def posed(situation: str, seed: int) -> tuple[ro.CalibrationProblem, ro.Dataset]:
    """Return a problem, and the true positions of 200 unseen configurations."""
    if situation in COMPLETE:
        offset = np.radians((seed // 3) % 2)
        arm = ro.study.simulated_arm(seed, COMPLETE[situation], offset=offset)
        return arm.problem, arm.true
    count, scales, excess = SITUATIONS[situation]
    rng = np.random.default_rng([seed, list(SITUATIONS).index(situation)])
    robot, limit, sigma = ro.load("paper_arm").problem.robot, np.radians(120), 3e-5
    parameters = ro.robot.model_parameters(robot, tools={"": [0.03, -0.02, 0.06, 0, 0, 0]})
    spread = {"length_mm": 0.3, "angle_mrad": 1.0, "tool_mm": 0.5}
    parameters = parameters.identify(["alpha?", "a?", "theta?", "d?", "tool_[xyz]"]).scaled(spread)
    truth = rng.normal(size=len(parameters.free)) * parameters.free.scale
    q, there = rng.uniform(-limit, limit, (count, 6)), rng.uniform(-limit, limit, (200, 6))
    parameters = parameters.scaled({key: scales * value for key, value in spread.items()})
    empty = ro.CalibrationProblem(robot, parameters, ro.Dataset.of(q, np.zeros((count, 3)), sigma))
    y = empty.modelled(truth)[0] + excess * sigma * rng.normal(size=(count, 3))
    problem = empty.on(ro.Dataset.of(q, y, sigma))
    want = problem.on(ro.Dataset.of(there, np.zeros((200, 3)), sigma)).modelled(truth)[0]
    return problem, ro.Dataset.of(there, want, sigma)


def report(rows: list[dict[str, Any]]) -> Report:
    """Return median, 95th percentile and share worse than 2, and the 95th percentiles by situation."""
    lines, metrics = [], {}
    for name in METHODS:
        v = np.array([row[name] for row in rows])
        metrics[f"{name}_median"], metrics[f"{name}_p95"] = float(np.median(v)), float(np.percentile(v, 95))
        each = [np.array([row[name] for row in rows if row["situation"] == s]) for s in WHERE]
        share = f"{100 * np.mean(v > 2):.1f} %"
        middle = [f"{np.median(v):.2f}", f"{np.percentile(v, 95):.2f}", share]
        lines.append([name, *middle, *(f"{np.median(e):.2f}, {np.percentile(e, 95):.2f}" for e in each)])
    text = (
        f"Error of predicted positions over that at the best weight, {len(rows)} simulated cases; on the right median "
        "and 95th percentile by situation. `learned` is the default, which no single weight limits.\n\n"
    )
    head = ["selector", "median", "95th percentile", "worse than 2", *WHERE]
    figure = distributions(
        {name: [row[name] for row in rows] for name in METHODS}, "error over that at the best weight"
    )
    return Report(text + markdown(head, lines), metrics, {"selectors": figure})
