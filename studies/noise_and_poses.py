"""Compare the error of predicted positions with the bound that Fisher information sets, over noise and poses.

Simulated: the paper's arm, deviations as large as the scales (0.3 mm, 1 mrad, reflector 0.5 mm), joints within 120
degrees.
The bound is that of the mean square over truths drawn from the prior (van Trees 1968): J (A'A + 1)^-1 J' at the truth.
"""

from __future__ import annotations

from typing import Any

import numpy as np

import rpim_opt as ro
from rpim_opt.basics.text import markdown
from rpim_opt.study import Metric, Report

QUESTION = "How does the error fall with the noise and the number of configurations, and how near is it to the bound?"
NOISES, COUNTS = (0.01, 0.03, 0.1, 0.3), (8, 12, 20, 35, 60, 100)
METRICS = {"largest_ratio": Metric("lower", 0.1), "median_ratio": Metric("lower", 0.03)}


def cases(quick: bool) -> list[dict[str, Any]]:
    """Return every noise [mm] with every number of configurations, 60 seeds or 4."""
    seeds = range(4 if quick else 60)
    return [{"noise_mm": noise, "count": count, "seed": seed} for noise in NOISES for count in COUNTS for seed in seeds]


def run(noise_mm: float, count: int, seed: int) -> dict[str, float]:
    """Return the mean square error of predicted positions and its bound [mm^2], by Tikhonov and least squares."""
    rng, sigma = np.random.default_rng([seed, count, round(1e3 * noise_mm)]), 1e-3 * noise_mm
    robot, limit = ro.load("paper_arm").problem.robot, np.radians(120)
    parameters = ro.robot.model_parameters(robot, tools={"": [0.03, -0.02, 0.06, 0, 0, 0]})
    parameters = parameters.scaled({"length_mm": 0.3, "angle_mrad": 1.0, "tool_mm": 0.5})
    parameters = parameters.identify(["alpha?", "a?", "theta?", "d?", "tool_[xyz]"])
    truth = rng.normal(size=len(parameters.free)) * parameters.free.scale
    q, there = rng.uniform(-limit, limit, (count, 6)), rng.uniform(-limit, limit, (200, 6))
    empty = ro.CalibrationProblem(robot, parameters, ro.Dataset.of(q, np.zeros((count, 3)), sigma))
    y = empty.modelled(truth)[0] + sigma * rng.normal(size=(count, 3))
    problem = empty.on(ro.Dataset.of(q, y, sigma))
    predicted = problem.on(ro.Dataset.of(there, np.zeros((200, 3)), 1.0))
    want = predicted.modelled(truth)[0]

    def square(x: np.ndarray) -> float:
        return 1e6 * float(np.mean(np.sum((predicted.modelled(x)[0] - want) ** 2, axis=1)))

    model = problem.linearize(truth)
    J = predicted.jacobian(truth) * parameters.free.scale
    bound = 3e6 * float(np.mean(np.sum(J @ np.linalg.inv(model.A.T @ model.A + np.eye(model.A.shape[1])) * J, axis=1)))
    return {
        "reml": square(ro.calibrate(problem, ro.tikhonov, ro.reml).x),
        "l_curve": square(ro.calibrate(problem, ro.tikhonov, ro.l_curve).x),
        "prior": square(ro.calibrate(problem, ro.tikhonov, 1.0).x),
        "bound": bound,
    }


def report(rows: list[dict[str, Any]]) -> Report:
    """Return root mean square errors over the bound, as a table and a figure."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.5))
    ax = figure.add_subplot()
    lines, ratios = [], []
    for k, noise in enumerate(NOISES):
        found: dict[str, list[float]] = {name: [] for name in ("reml", "l_curve", "prior", "bound")}
        for count in COUNTS:
            part = [row for row in rows if (row["noise_mm"], row["count"]) == (noise, count)]
            for name, values in found.items():
                values.append(float(np.sqrt(np.mean([row[name] for row in part]))))
            ratios.append(found["reml"][-1] / found["bound"][-1])
            figures = [f"{found[name][-1]:.4f}" for name in ("bound", "prior", "reml", "l_curve")]
            lines.append([f"{noise:g} mm, {count}", *figures, f"{ratios[-1]:.2f}"])
        ax.loglog(COUNTS, found["bound"], color=f"C{k}", ls="--", lw=1)
        ax.loglog(COUNTS, found["reml"], "o-", color=f"C{k}", ms=4, label=f"noise {noise:g} mm")
    ax.set_xlabel("configurations")
    ax.set_ylabel("root mean square error [mm]")
    ax.set_xticks(COUNTS, [str(c) for c in COUNTS])
    ax.minorticks_off()
    ax.set_title("Tikhonov with REML, and the bound (dashed)", fontsize=10)
    ax.legend(frameon=False)
    figure.tight_layout()
    seeds = len(rows) // len(lines)
    text = (
        f"Root mean square error of 200 predicted positions [mm], over {seeds} simulated calibrations each. The bound "
        "is what any estimator that knows noise and prior can reach in the mean; `prior` knows them (weight 1), REML "
        "and the L-curve find the weight from the data.\n\n"
    )
    table = markdown(["noise, configurations", "bound", "prior", "REML", "L-curve", "REML over bound"], lines)
    metrics = {"largest_ratio": max(ratios), "median_ratio": float(np.median(ratios))}
    return Report(text + table, metrics, {"noise_and_poses": figure})
