"""Compare the error of predicted positions with the bound that Fisher information sets, over noise and poses.

Simulated: the paper's arm, deviations as large as the scales (0.3 mm, 1 mrad, reflector 0.5 mm), joints within 120
degrees.
The bound is that of the mean square over truths drawn from the prior (van Trees 1968): J (A'A + 1)^-1 J' at the truth.

A second table asks the same where nobody knows the prior: three other robots with errors in all six directions behind
every link, of sizes that differ from robot to robot, one joint of every other one off by a degree
(`ro.study.simulated_arm`), 0.03 mm noise.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import gmean

import rpim_opt as ro
from rpim_opt.basics.text import markdown
from rpim_opt.study import Metric, Report

QUESTION = "How does the error fall with the noise and the number of configurations, and how near is it to the bound?"
NOISES, COUNTS = (0.01, 0.03, 0.1, 0.3), (8, 12, 20, 35, 60, 100)
METHODS = ("prior", "reml", "l_curve", "learned")
FEW = (8, 10, 15, 25, 52)
UNKNOWN = {
    "least_squares": {"weight": 1e-6},
    "reml": {"weight": ro.reml},
    "learned": {},
    "auto": {"model": "auto"},
}
"""What is asked of `ro.calibrate` where the prior is not known."""
METRICS = {
    "largest_ratio": Metric("lower", 0.1),
    "median_ratio": Metric("lower", 0.03),
    "learned_median_ratio": Metric("lower", 0.03),
    "unknown_learned_over_reml": Metric("lower", 0.05),
    "unknown_auto_over_learned": Metric("lower", 0.05),
}


def cases(quick: bool) -> list[dict[str, Any]]:
    """Return every noise [mm] with every number of configurations, 60 seeds or 4; and the robots of unknown sizes."""
    seeds = range(4 if quick else 60)
    few = (10, 25) if quick else FEW
    arms = range(1000, 1006 if quick else 1030)
    known = [
        {"noise_mm": noise, "count": count, "seed": seed} for noise in NOISES for count in COUNTS for seed in seeds
    ]
    return known + [{"noise_mm": 0.03, "count": n, "seed": seed, "truth": "unknown"} for n in few for seed in arms]


def run(noise_mm: float, count: int, seed: int, truth: str = "drawn") -> dict[str, float]:
    """Return what one calibration of every kind finds."""
    if truth == "unknown":
        return unknown(count, seed)
    return known(noise_mm, count, seed)


def unknown(count: int, seed: int) -> dict[str, float]:
    """Return root mean square errors [mm], and which share of new readings the 95 % intervals cover."""
    arm = ro.study.simulated_arm(seed, count, offset=np.radians((seed // 3) % 2))
    found = {}
    for name, asked in UNKNOWN.items():
        result = ro.calibrate(arm.problem, **asked)
        found[name] = 1e3 * float(np.sqrt(np.mean(result.errors(arm.true) ** 2)))
        found[f"{name}_covers"] = ro.use.validate(result, arm.read).coverage
    return found


def known(noise_mm: float, count: int, seed: int) -> dict[str, float]:
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
        "learned": square(ro.calibrate(problem).x),
        "bound": bound,
    }


def report(rows: list[dict[str, Any]]) -> Report:
    """Return root mean square errors over the bound, as a table and a figure; and those of the unknown sizes."""
    from matplotlib.figure import Figure

    drawn = [row for row in rows if row.get("truth") != "unknown"]
    figure = Figure(figsize=(7, 4.5))
    ax = figure.add_subplot()
    lines, ratios, learned = [], [], []
    for k, noise in enumerate(NOISES):
        found: dict[str, list[float]] = {name: [] for name in (*METHODS, "bound")}
        for count in COUNTS:
            part = [row for row in drawn if (row["noise_mm"], row["count"]) == (noise, count)]
            for name, values in found.items():
                values.append(float(np.sqrt(np.mean([row[name] for row in part]))))
            ratios.append(found["reml"][-1] / found["bound"][-1])
            learned.append(found["learned"][-1] / found["bound"][-1])
            figures = [f"{found[name][-1]:.4f}" for name in ("bound", *METHODS)]
            lines.append([f"{noise:g} mm, {count}", *figures, f"{ratios[-1]:.2f}", f"{learned[-1]:.2f}"])
        ax.loglog(COUNTS, found["bound"], color=f"C{k}", ls="--", lw=1)
        ax.loglog(COUNTS, found["reml"], "o-", color=f"C{k}", ms=4, label=f"noise {noise:g} mm")
        ax.loglog(COUNTS, found["learned"], "x:", color=f"C{k}", ms=5, lw=1)
    ax.set_xlabel("configurations")
    ax.set_ylabel("root mean square error [mm]")
    ax.set_xticks(COUNTS, [str(c) for c in COUNTS])
    ax.minorticks_off()
    ax.set_title("Tikhonov with REML, the learned prior (crosses), and the bound (dashed)", fontsize=10)
    ax.legend(frameon=False)
    figure.tight_layout()
    seeds = len(drawn) // len(lines)
    text = (
        f"Root mean square error of 200 predicted positions [mm], over {seeds} simulated calibrations each. The bound "
        "is what any estimator that knows noise and prior can reach in the mean; `prior` knows them (weight 1), REML "
        "and the L-curve find the weight from the data. `learned`, the default, does not take it for known that all "
        "deviations are of one size, which here they are: a prior with heavy tails pays for that.\n\n"
    )
    head = ["noise, configurations", "bound", "prior", "REML", "L-curve", "learned"]
    table = markdown([*head, "REML over bound", "learned over bound"], lines)
    second, metrics = _of_unknown([row for row in rows if row.get("truth") == "unknown"])
    metrics |= {
        "largest_ratio": max(ratios),
        "median_ratio": float(np.median(ratios)),
        "learned_median_ratio": float(np.median(learned)),
    }
    return Report(text + table + second, metrics, {"noise_and_poses": figure})


def _of_unknown(rows: list[dict[str, Any]]) -> tuple[str, dict[str, float]]:
    """Return the table of the robots with unknown sizes, and its figures."""
    names = {"least_squares": "least squares", "reml": "REML", "learned": "learned", "auto": "learned, model auto"}
    lines = []
    for count in sorted({row["count"] for row in rows}):
        part = [row for row in rows if row["count"] == count]
        for name, title in names.items():
            v = np.array([row[name] for row in part])
            over = v / [row["least_squares"] for row in part]
            share = np.mean([row[f"{name}_covers"] for row in part])
            figures = [f"{np.median(v):.4f}", f"{v.max():.2f}", f"{gmean(over):.2f}", f"{over.max():.2f}"]
            lines.append([str(count), title, *figures, f"{100 * share:.0f} %"])
    seeds = len({row["seed"] for row in rows})
    text = (
        f"\n\n## Where the sizes of deviations are not known\n\n{seeds} simulated robots with errors in all six "
        "directions behind every link, one joint of every other one off by a degree; 0.03 mm noise, scales of 1 mm and "
        "1 mrad stated. RMS error of 200 unseen positions [mm], in the median and at worst; over that of least squares "
        "on the same robot, in the geometric mean and at worst; share of new readings inside their 95 % intervals.\n\n"
    )
    head = ["configurations", "method", "RMS, median", "worst", "over least squares", "worst", "covers"]
    metrics = {
        "unknown_learned_over_reml": gmean([row["learned"] / row["reml"] for row in rows]),
        "unknown_auto_over_learned": gmean([row["auto"] / row["learned"] for row in rows]),
    }
    return text + markdown(head, lines), metrics
