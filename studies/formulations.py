"""Compare formulations on the robot of the peers' benchmark, with few poses and with blunders.

Simulated: the paper's arm with deviations of 1 mrad, 0.3 mm and 0.5 mm of the reflector, joints within 120 degrees,
0.05 mm noise a coordinate, 52 configurations, or 10, or 52 with four blunders of 3 mm; 500 validation points without
noise. Scales are generic (1 mm, 1 mrad) or those of the simulation. Weights by REML; no figure is chosen on validation
points.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import rpim_opt as ro
from rpim_opt.basics.text import markdown
from rpim_opt.calibration.baselines import levenberg_marquardt
from rpim_opt.study import Metric, Report, distributions

QUESTION = "How accurate is each formulation: 52 configurations, ten, or four gross errors?"
SITUATIONS = {"clean52": (52, 0), "few10": (10, 0), "blunders52": (52, 4)}
SCALES = {
    "generic": {"length_mm": 1.0, "angle_mrad": 1.0, "tool_mm": 1.0},
    "spread": {"length_mm": 0.3, "angle_mrad": 1.0, "tool_mm": 0.5},
}
METHODS = ("nominal", "least squares", "Tikhonov", "Huber", "Huber, refitted", "sum of norms")
METRICS = {
    "clean52, generic, Tikhonov": Metric("lower", 0.03),
    "few10, generic, Tikhonov": Metric("lower", 0.05),
    "blunders52, generic, Huber": Metric("lower", 0.05),
    "blunders52, generic, Huber, refitted": Metric("lower", 0.05),
}


def cases(quick: bool) -> list[dict[str, Any]]:
    """Return every situation with both scales, 20 seeds or 3."""
    seeds = range(3 if quick else 20)
    return [{"situation": s, "scales": k, "seed": seed} for s in SITUATIONS for k in SCALES for seed in seeds]


def run(situation: str, scales: str, seed: int) -> dict[str, float]:
    """Return the root mean square position error on the validation points [mm], by method."""
    rng = np.random.default_rng([seed, 2026])
    count, blunders = SITUATIONS[situation]
    robot = ro.load("paper_arm").problem.robot
    identify = ["alpha?", "a?", "theta?", "d?", "tool_[xyz]"]
    parameters = ro.robot.model_parameters(robot, tools={"": [0.03, -0.02, 0.06, 0, 0, 0]}).identify(identify)
    truth = rng.normal(size=len(parameters.free)) * parameters.scaled(SCALES["spread"]).free.scale
    limit = np.radians(120)
    q, q_valid = rng.uniform(-limit, limit, (count, 6)), rng.uniform(-limit, limit, (500, 6))

    def measured(joints: np.ndarray) -> np.ndarray:
        data = ro.Dataset.of(joints, np.zeros((len(joints), 3)), 5e-5)
        return ro.CalibrationProblem(robot, parameters, data).modelled(truth)[0]

    y = measured(q) + 5e-5 * rng.normal(size=(count, 3))
    for k in rng.choice(count, blunders, replace=False):
        direction = rng.normal(size=3)
        y[k] += 3e-3 * direction / np.linalg.norm(direction)
    problem = ro.CalibrationProblem(robot, parameters.scaled(SCALES[scales]), ro.Dataset.of(q, y, 5e-5))
    validation = problem.on(ro.Dataset.of(q_valid, measured(q_valid), 5e-5))

    def rms(x: np.ndarray) -> float:
        return 1e3 * float(np.sqrt(np.mean(validation.errors(x) ** 2)))

    robust = ro.calibrate(problem, ro.robust, ro.reml)
    return {
        "nominal": rms(np.zeros_like(truth)),
        "least squares": rms(levenberg_marquardt(problem).x),
        "Tikhonov": rms(ro.calibrate(problem, ro.tikhonov, ro.reml).x),
        "Huber": rms(robust.x),
        "Huber, refitted": rms(ro.calibrate(robust.without_flagged().problem, ro.tikhonov, ro.reml).x),
        "sum of norms": rms(ro.calibrate(problem, ro.sum_of_norms, ro.reml).x),
    }


def report(rows: list[dict[str, Any]]) -> Report:
    """Return the mean over the seeds, and how often each method was the best."""
    lines, metrics = [], {}
    for situation in SITUATIONS:
        for scales in SCALES:
            part = [row for row in rows if (row["situation"], row["scales"]) == (situation, scales)]
            best = [min(METHODS, key=lambda m, row=row: row[m]) for row in part]
            figures = []
            for method in METHODS:
                mean = float(np.mean([row[method] for row in part]))
                metrics[f"{situation}, {scales}, {method}"] = mean
                figures.append(f"{mean:.4f} ({best.count(method)})")
            lines.append([f"{situation}, {scales} scales", *figures])
    text = (
        "Root mean square position error on 500 points without noise [mm], mean over the seeds; in brackets how often "
        f"the method was the best of {len(rows) // len(lines)} seeds. Simulated; weights by REML.\n\n"
    )
    figures = {
        situation: distributions(
            {method: [row[method] for row in rows if row["situation"] == situation] for method in METHODS},
            f"{situation}: RMS position error [mm], both scales",
        )
        for situation in SITUATIONS
    }
    return Report(text + markdown(["situation", *METHODS], lines), metrics, figures)
