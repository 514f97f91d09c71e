"""Calibrate the sets of ../shared/data that are at hand, on its fixed split and with few configurations.

The sets stay where they are; without them there is nothing to report. Nothing is chosen by the validation rows.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import gmean

import rpim_opt as ro
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import markdown
from rpim_opt.study import Metric, Report, distributions

QUESTION = "How accurate is a calibration on real measurements, with all configurations and with ten?"
FOLDER = Path(__file__).resolve().parents[2] / "shared" / "data"
DEPENDS = [f"{FOLDER}/**"]
"""What replicates follow from, besides the Python files of this folder."""
SETS = (
    "franka_fr3_nadeau",
    "irb120_cable_robotcali",
    "irb120_wu",
    "rokae_lmpytorch",
    "ur5_jacobi",
    "wam_jacobi",
)
"""What the committed results rest on; other sets of the folder are of measurements that the package does not know."""
METHODS = {
    "least squares": {"weight": 1e-6},
    "reml": {"weight": ro.reml},
    "learned": {},
    "learned, model auto": {"model": "auto"},
}
"""What is asked of `ro.calibrate`; ``learned`` is its default, and with ``model="auto"`` that of the commands."""
OURS = "learned, model auto"
METRICS = {
    "auto_over_least_squares": Metric("lower", 0.02),
    "auto_over_reml": Metric("lower", 0.02),
    "learned_over_reml": Metric("lower", 0.02),
    "covers": Metric("higher", 0.02),
}
FIRST = 3000
"""Seed of the first draw."""


def cases(quick: bool) -> list[dict[str, Any]]:
    """Return every set with all its configurations, and with some drawn at random."""
    sets = [name for name in SETS if (FOLDER / name / "problem.toml").is_file()]
    whole = [{"name": name, "count": 0, "seed": 0} for name in sets]
    counts, draws = ((10,), 2) if quick else ((10, 20), 10)
    seeds = range(FIRST, FIRST + draws)
    return whole + [{"name": n, "count": c, "seed": s} for n in sets for c in counts for s in seeds]


def run(name: str, count: int, seed: int) -> dict[str, float]:
    """Return the RMS error on the validation rows [mm], and which share of them the 95 % intervals cover."""
    instance = ro.load(FOLDER / name)
    problem, validation = instance.problem, instance.validation
    if validation is None:
        raise InputError("validation", f"nothing for {name}", "a table of held-out readings")
    if count:
        problem = problem.on(problem.data.configurations(count, seed))
    found = {}
    for method, asked in METHODS.items():
        result = ro.calibrate(problem, **asked)
        found[method] = 1e3 * float(np.sqrt(np.mean(result.errors(validation) ** 2)))
        found[f"{method}, covers"] = ro.use.validate(result, validation).coverage
        found["nominal"] = 1e3 * float(np.sqrt(np.mean(result.nominal_errors(validation) ** 2)))
    return found


def report(rows: list[dict[str, Any]]) -> Report:
    """Return errors and coverage by set and number of configurations."""
    if not rows:
        return Report("The measurements of ../shared/data are not here.", {})
    lines = []
    for name, count in dict.fromkeys((row["name"], row["count"]) for row in rows):
        part = [row for row in rows if (row["name"], row["count"]) == (name, count)]
        figures = [float(np.mean([row[m] for row in part])) for m in ("nominal", *METHODS)]
        over = [row[OURS] / row["reml"] for row in part]
        covers = [float(np.mean([row[f"{m}, covers"] for row in part])) for m in ("reml", OURS)]
        middle = [f"{f:.3f}" for f in figures] + [f"{gmean(over):.2f}", f"{max(over):.2f}"]
        lines.append([name, str(count or "all"), str(len(part)), *middle, *(f"{100 * c:.0f} %" for c in covers)])
    metrics = {
        "auto_over_least_squares": _over(rows, OURS, "least squares"),
        "auto_over_reml": _over(rows, OURS, "reml"),
        "learned_over_reml": _over(rows, "learned", "reml"),
        "covers": float(np.mean([row[f"{OURS}, covers"] for row in rows])),
    }
    text = (
        "Root mean square error on the validation rows [mm], mean over random draws of configurations. `learned` is "
        "the default of `ro.calibrate`; with `model auto` that of the commands, it adds the model extensions that the "
        "data support. On the right its error over that of one weight by REML (geometric mean, worst draw), and the "
        "share of coordinates of held-out readings inside their 95 % intervals. Over all rows it has "
        f"{metrics['auto_over_least_squares']:.2f} times the error of least squares (weight 1e-6), "
        f"{metrics['auto_over_reml']:.2f} times that of REML; without model extensions "
        f"{metrics['learned_over_reml']:.2f}. In the mean {100 * metrics['covers']:.0f} % of the readings are "
        "inside.\n\n"
    )
    head = ["set", "configurations", "draws", "nominal, frames fitted", *METHODS]
    head += ["over REML", "worst", "REML covers", "ours covers"]
    ten = [row for row in rows if row["count"] == 10]
    figure = distributions(
        {f"{row['name']}, {m}": [r[m] for r in ten if r["name"] == row["name"]] for row in ten for m in METHODS},
        "ten configurations: RMS error on the validation rows [mm]",
    )
    return Report(text + markdown(head, lines), metrics, {"ten_configurations": figure})


def _over(rows: list[dict[str, Any]], method: str, other: str) -> float:
    return gmean([row[method] / row[other] for row in rows])
