"""Compare selectors on simulated robots: right and wrong priors, few configurations, noise larger than declared.

Simulated: the paper's arm, deviations of 0.3 mm and 1 mrad (reflector 0.5 mm), joints within 120 degrees, 0.03 mm
noise. The weight is chosen on one linearization at nominal; its error on unseen configurations is compared with that at
the best of 60 weights, which only a simulation knows.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import rpim_opt as ro
from rpim_opt.basics.text import markdown
from rpim_opt.study.figures import distributions
from rpim_opt.study.report import Metric, Report

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
METRICS = {f"{name}_p95": Metric("lower", 0.15) for name in ("reml", "l_curve", "gcv")}


def cases(quick: bool) -> list[dict[str, Any]]:
    """Return every situation, 100 seeds or 5."""
    return [{"situation": name, "seed": seed} for name in SITUATIONS for seed in range(5 if quick else 100)]


def run(situation: str, seed: int) -> dict[str, float]:
    """Return the error at the chosen weight over the error at the best weight, by selector."""
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
    predicted = problem.on(ro.Dataset.of(there, np.zeros((200, 3)), 1.0))
    want, program = predicted.modelled(truth)[0], ro.convex.pose(ro.tikhonov, problem.linearize(np.zeros_like(truth)))

    def error(weight: float) -> float:
        z = program.path([weight])[0].z
        return float(np.linalg.norm(predicted.modelled(z * parameters.free.scale)[0] - want))

    s = program.model.svd[1]
    best = min(error(w) for w in np.geomspace(1e-5 * s[s > 0][-1] ** 2, 10 * s[0] ** 2, 60))
    return {rule.__name__: error(rule(program).weight) / best for rule in RULES}


def report(rows: list[dict[str, Any]]) -> Report:
    """Return median, 95th percentile and share worse than 2, and the 95th percentiles by situation."""
    lines, metrics = [], {}
    for rule in RULES:
        name = rule.__name__
        v = np.array([row[name] for row in rows])
        metrics[f"{name}_median"], metrics[f"{name}_p95"] = float(np.median(v)), float(np.percentile(v, 95))
        each = [np.percentile([row[name] for row in rows if row["situation"] == s], 95) for s in SITUATIONS]
        share = f"{100 * np.mean(v > 2):.1f} %"
        middle = [f"{np.median(v):.2f}", f"{np.percentile(v, 95):.2f}", share]
        lines.append([name, *middle, *(f"{e:.2f}" for e in each)])
    text = (
        f"Error of predicted positions at the chosen weight over that at the best weight, {len(rows)} simulated cases; "
        "on the right the 95th percentile by situation.\n\n"
    )
    head = ["selector", "median", "95th percentile", "worse than 2", *SITUATIONS]
    figure = distributions(
        {rule.__name__: [row[rule.__name__] for row in rows] for rule in RULES}, "error over that at the best weight"
    )
    return Report(text + markdown(head, lines), metrics, {"selectors": figure})
