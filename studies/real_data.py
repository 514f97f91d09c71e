"""Calibrate the sets of ../shared/data that are at hand, on its fixed split and with few configurations.

The sets stay where they are; without them there is nothing to report. Weights by REML on the identification rows.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

import rpim_opt as ro
from rpim_opt.basics.text import markdown
from rpim_opt.study.figures import distributions
from rpim_opt.study.report import Metric, Report

QUESTION = "How accurate is a calibration on real measurements, with all configurations and with ten?"
FOLDER = Path(__file__).resolve().parents[2] / "shared" / "data"
SETS = (
    "franka_fr3_nadeau",
    "irb120_cable_robotcali",
    "irb120_wu",
    "rokae_lmpytorch",
    "ur5_jacobi",
    "wam_jacobi",
)
"""What the committed results rest on; other sets of the folder are of measurements that the package does not know."""
METHODS = ("nominal", "least squares", "rpim-opt")
METRICS = {"rms_over_least_squares": Metric("lower", 0.02)}


def cases(quick: bool) -> list[dict[str, Any]]:
    """Return every set with all its configurations, and with ten or twenty drawn at random."""
    sets = [name for name in SETS if (FOLDER / name / "problem.toml").is_file()]
    whole = [{"name": name, "count": 0, "seed": 0} for name in sets]
    counts, seeds = ((10,), range(2)) if quick else ((10, 20), range(10))
    return whole + [{"name": n, "count": c, "seed": s} for n in sets for c in counts for s in seeds]


def run(name: str, count: int, seed: int) -> dict[str, float]:
    """Return the root mean square error on the validation rows [mm]."""
    instance = ro.load(FOLDER / name)
    problem, validation = instance.problem, instance.validation
    if count:
        problem = problem.on(problem.data.configurations(count, seed))
    found = {}
    for method, weight in (("rpim-opt", instance.weight), ("least squares", 1e-6)):
        result = ro.calibrate(problem, ro.tikhonov, weight)
        found[method] = 1e3 * float(np.sqrt(np.mean(result.errors(validation) ** 2)))
        found["nominal"] = 1e3 * float(np.sqrt(np.mean(result.nominal_errors(validation) ** 2)))
    return found


def report(rows: list[dict[str, Any]]) -> Report:
    """Return the errors by set and number of configurations."""
    if not rows:
        return Report("The measurements of ../shared/data are not here.", {})
    lines, ratios = [], []
    for name, count in dict.fromkeys((row["name"], row["count"]) for row in rows):
        part = [row for row in rows if (row["name"], row["count"]) == (name, count)]
        figures = [float(np.mean([row[m] for row in part])) for m in METHODS]
        ratios.append(figures[2] / figures[1])
        lines.append([name, str(count) if count else "all", str(len(part)), *(f"{f:.3f}" for f in figures)])
    text = "Root mean square error on the validation rows [mm], mean over random draws of configurations.\n\n"
    head = ["set", "configurations", "draws", "nominal, frames fitted", "least squares", "rpim-opt"]
    ten = [row for row in rows if row["count"] == 10]
    figure = distributions(
        {f"{row['name']}, {m}": [r[m] for r in ten if r["name"] == row["name"]] for row in ten for m in METHODS},
        "ten configurations: RMS error on the validation rows [mm]",
    )
    metrics = {"rms_over_least_squares": float(np.exp(np.mean(np.log(ratios))))}
    return Report(text + markdown(head, lines), metrics, {"ten_configurations": figure})
