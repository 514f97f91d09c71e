"""Which parameters can which instrument identify on which arm, with how many configurations, and what redundancy costs.

Simulated: ready robots, 100 configurations, everything identified that ``identify = "auto"`` means (geometry, Hayati's
beta between near-parallel axes, base and reflector or what else the instrument places). Then ten configurations and
more of one arm, and least squares with and without redundant parameters by three methods that know no penalty.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.basics.files import write_text
from rpim_opt.basics.text import markdown
from rpim_opt.calibration.baselines import gauss_newton, levenberg_marquardt
from rpim_opt.problem.design import combination
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.store.simulation import write_simulation
from rpim_opt.study import Metric, Report

QUESTION = "What can each instrument identify, with how many configurations, and what do redundant parameters cost?"
ROBOTS = ("ur10e", "kr6_r900", "irb4600_60_205", "panda")
INSTRUMENTS = {
    "position": "[noise]\nposition_mm = 0.03\n[tool]\nx_mm = 30\ny_mm = -20\nz_mm = 60\n[base]\nx_mm = 0\n",
    "position, 3 reflectors": (
        "[noise]\nposition_mm = 0.03\n[tool.A]\nx_mm = 40\nz_mm = 60\n[tool.B]\ny_mm = 40\nz_mm = 60\n"
        "[tool.C]\nx_mm = -40\nz_mm = 90\n"
    ),
    "pose": "[noise]\nposition_mm = 0.05\norientation_mrad = 0.2\n[tool]\nz_mm = 120\n",
    "distance": "[noise]\ndistance_mm = 0.03\n[tool]\nx_mm = 30\ny_mm = -20\nz_mm = 60\n",
    "cable": "[noise]\ndistance_mm = 0.1\n[tool]\nx_mm = 30\nz_mm = 60\n[anchor]\nx_mm = 1500\ny_mm = -900\n",
    "plane": "[noise]\ndistance_mm = 0.02\n[tool]\nx_mm = 30\nz_mm = 60\n[plane]\nx_mm = 350\nz_mm = -100\n",
    "sphere": (
        "[noise]\ndistance_mm = 0.02\n[tool]\nx_mm = 30\nz_mm = 60\n[sphere]\nx_mm = 600\nz_mm = 300\nr_mm = 250\n"
    ),
}
PROBLEM = """\
title = "{robot}, {instrument}"
robot = "{robot}"
measurement = "{measurement}"
identification = "identification.csv"
identify = "auto"
{frames}
[simulation]
seed = {seed}
configurations = {count}
joint_share = 0.5
"""
COUNTS = (8, 9, 10, 12, 15, 20, 30, 50, 100)
METRICS = {"ranks": Metric("higher", 0.0), "independent_disagreement": Metric("lower", 9.0)}


def cases(quick: bool) -> list[dict[str, Any]]:
    """Return every arm with every instrument, one arm with few configurations, and the fits without penalty."""
    robots, seeds = (ROBOTS[:1], 2) if quick else (ROBOTS, 20)
    structure = [
        {"part": "structure", "robot": robot, "instrument": instrument, "count": 100, "seed": 1}
        for robot in robots
        for instrument in INSTRUMENTS
    ]
    few = [
        {"part": "few", "robot": "ur10e", "instrument": instrument, "count": count, "seed": seed}
        for instrument in ("position", "pose")
        for count in COUNTS
        for seed in range(seeds)
    ]
    freedom = [
        {"part": "freedom", "robot": robot, "instrument": "position", "count": 60, "seed": seed}
        for robot in robots
        for seed in range(seeds)
    ]
    return structure + few + freedom


def run(part: str, robot: str, instrument: str, count: int, seed: int) -> dict[str, Any]:
    """Return rank, condition and redundancies, or how far methods without a penalty disagree."""
    with tempfile.TemporaryDirectory() as folder:
        text = PROBLEM.format(
            robot=robot,
            instrument=instrument,
            measurement=instrument.partition(",")[0],
            frames=INSTRUMENTS[instrument],
            seed=seed,
            count=count,
        )
        write_text(Path(folder) / "problem.toml", text)
        write_simulation(folder)
        problem = ro.load(folder).problem
    return _freedom(problem) if part == "freedom" else _structure(problem)


def _structure(problem: CalibrationProblem) -> dict[str, Any]:
    seen = ro.problem.observe(problem)
    return {
        "parameters": len(seen.names),
        "rank": seen.rank,
        "condition": seen.condition,
        "unseen": ", ".join(seen.unidentifiable),
        "redundant": "; ".join(combination(terms) for terms in seen.redundant),
        "smallest": float(seen.singular_values[seen.rank - 1]),
    }


def _freedom(problem: CalibrationProblem) -> dict[str, Any]:
    """Fit everything, and then a set of independent parameters, by three methods that know no penalty."""
    chosen = {next(iter(terms)) for terms in ro.problem.observe(problem).base}
    own = np.array([name in chosen for name in problem.parameters.names])
    found: dict[str, Any] = {}
    for name, each in (("all", problem), ("independent", problem.identifying(own & problem.parameters.identified))):
        xs = [gauss_newton(each).x, levenberg_marquardt(each).x, ro.calibrate(each, ro.least_squares).x]
        residuals = [each.residual(x) for x in xs]
        scale = each.parameters.free.scale
        found[f"{name}: parameters differ"] = float(max(np.abs((x - xs[0]) / scale).max() for x in xs[1:]))
        found[f"{name}: residuals differ, mm"] = 1e3 * float(max(np.abs(r - residuals[0]).max() for r in residuals[1:]))
        found[f"{name}: largest, scales"] = float(max(np.abs(x / scale).max() for x in xs))
    return found


def report(rows: list[dict[str, Any]]) -> Report:
    """Return the three tables, and a figure of the condition over the number of configurations."""
    structure, few, freedom = ([row for row in rows if row["part"] == p] for p in ("structure", "few", "freedom"))
    lines = [
        [
            row["robot"],
            row["instrument"],
            f"{row['rank']} of {row['parameters']}",
            f"{row['condition']:.2g}",
            row["unseen"] or "-",
            row["redundant"] or "-",
        ]
        for row in structure
    ]
    parts = [
        "## Arms and instruments\n\nRank and condition of the whitened Jacobian in units of the scales at nominal. "
        "Coefficients in mm and mrad; along a redundant combination no measurement changes.\n",
        markdown(["robot", "instrument", "rank", "condition", "never seen", "redundant"], lines),
        "\n## Few configurations (ur10e)\n\nMedian over the seeds.\n",
    ]
    lines = []
    for instrument in dict.fromkeys(row["instrument"] for row in few):
        for count in COUNTS:
            part = [row for row in few if (row["instrument"], row["count"]) == (instrument, count)]
            rank, condition, weakest = (np.median([r[k] for r in part]) for k in ("rank", "condition", "smallest"))
            lines.append([f"{instrument}, {count}", f"{rank:.0f}", f"{condition:.2g}", f"{weakest:.2g}"])
    parts.append(markdown(["instrument, configurations", "rank", "condition", "weakest singular value"], lines))
    lines = []
    for name in ("all", "independent"):
        keys = [f"{name}: {k}" for k in ("parameters differ", "residuals differ, mm", "largest, scales")]
        worst = [max(row[key] for row in freedom) for key in keys]
        lines.append([f"{name} parameters", *(f"{v:.1e}" for v in worst[:2]), f"{worst[2]:.3g}"])
    parts += [
        "\n## Least squares without a penalty\n\nGauss-Newton with steps of least norm, Levenberg-Marquardt (MINPACK) "
        "and the convex program, position data; worst over arms and seeds.\n",
        markdown(["fit", "parameters differ [scales]", "residuals differ [mm]", "largest correction [scales]"], lines),
    ]
    metrics = {
        "ranks": float(sum(row["rank"] for row in structure)),
        "independent_disagreement": max(row["independent: parameters differ"] for row in freedom),
    }
    return Report("\n".join(parts), metrics, {"identifiability": _figure(few)})


def _figure(few: list[dict[str, Any]]) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4), layout="constrained")
    ax = figure.add_subplot()
    for k, instrument in enumerate(dict.fromkeys(row["instrument"] for row in few)):
        values: list[Array] = [
            np.array([r["smallest"] for r in few if (r["instrument"], r["count"]) == (instrument, count)])
            for count in COUNTS
        ]
        ax.loglog(COUNTS, [np.median(v) for v in values], "o-", ms=4, color=f"C{k}", label=instrument)
        ax.fill_between(COUNTS, [v.min() for v in values], [v.max() for v in values], color=f"C{k}", alpha=0.15, lw=0)
    ax.axhline(1, color="0.5", lw=0.8, ls="--")
    ax.annotate("a deviation of one scale shows as much as the noise", (8, 1.1), fontsize=8, color="0.3")
    ax.set_xticks(COUNTS, [str(c) for c in COUNTS])
    ax.minorticks_off()
    ax.set_xlabel("configurations (ur10e)")
    ax.set_ylabel("weakest singular value that is not zero")
    ax.legend(frameon=False)
    return figure
