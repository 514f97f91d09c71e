"""Gears whose error repeats every few degrees, and gears without: what of it is recovered, and what is invented.

Simulated arms (`ro.study.simulated_arm`) whose joints stand at q + a cos(k q + phase), q their values: k cycles a turn,
a of 0.5 to 1.5 times `SIZE` and a phase for every joint. 200 positions of 0.03 mm noise identify such an arm; arms
without it, a joint of every other one off by a degree, have 25, 50 or 100.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import gmean

import rpim_opt as ro
from rpim_opt.basics.arrays import Array, rms
from rpim_opt.basics.text import markdown
from rpim_opt.calibration.uncertainty import transmission_errors
from rpim_opt.data.dataset import Dataset
from rpim_opt.study import Metric, Report, distributions

QUESTION = "Are transmission errors of gears recovered, and is none found where there is none?"
FIRST = 23_000
"""Seed of the first arm: nothing was chosen by these."""
SIGMA = 3e-5
SIZE = 3e-4
"""Mean amplitude of a joint [rad]."""
CYCLES = (5, 10, 20, 40)
MEASURED, CLEAN = 200, (25, 50, 100)
OFFSET = 0.0175
LARGE = 3
"""Joints, from the base, that move the tool far."""
METRICS = {
    "admitted": Metric("higher", 0.05),
    "correlation": Metric("higher", 0.02),
    "ratio": Metric("higher", 0.05),
    "covered": Metric("higher", 0.02),
    "over_geometry": Metric("lower", 0.1),
    "false_admissions": Metric("lower", 0.0),
    "loss": Metric("lower", 0.01),
}
Rows = list[dict[str, Any]]


def cases(quick: bool) -> Rows:
    """Return 3 arms or 30 with every number of cycles, and 12 arms or 200 without."""
    gears = [(FIRST + i, cycles, MEASURED) for i in range(3 if quick else 30) for cycles in CYCLES]
    clean = [(FIRST + 1000 + i, 0, CLEAN[i // 3 % len(CLEAN)]) for i in range(12 if quick else 200)]
    return [{"seed": seed, "cycles": cycles, "count": count} for seed, cycles, count in (*gears, *clean)]


def run(seed: int, cycles: int, count: int) -> dict[str, Any]:
    """Return the errors of an arm with and without curves, and what the curves have of the truth."""
    arm = ro.study.simulated_arm(seed, count, SIGMA, offset=0.0 if cycles else OFFSET * (seed % 2))
    rng = np.random.default_rng([seed, 31])
    dof = arm.problem.robot.dof
    amplitude, phase = SIZE * rng.uniform(0.5, 1.5, dof), rng.uniform(0, 2 * np.pi, dof)

    def ripple(joint_values: Array, joint: int | slice = slice(None)) -> Array:
        return (cycles > 0) * amplitude[joint] * np.cos(cycles * joint_values + phase[joint])

    def rippled(data: Dataset) -> Dataset:
        """Return the same places of an arm with ripple: its encoders say what is left without it."""
        stands = data.q @ arm.problem.robot.joint_map.T
        q = stands
        for _ in range(10):
            q = stands - ripple(q)
        return Dataset.of(q @ np.linalg.inv(arm.problem.robot.joint_map).T, data.blocks[0].y, SIGMA)

    problem, true = arm.problem.on(rippled(arm.problem.data)), rippled(arm.true)
    found = ro.calibrate(problem, model="auto")
    geometry = ro.calibrate(problem)
    undisturbed = ro.calibrate(arm.problem) if cycles else geometry
    curves = []
    for curve in transmission_errors(found):
        error, half = curve.error[curve.inside], curve.standard[curve.inside]
        joint = curve.joint - 1  # ripple is of the model's joint, the curve as the controller counts
        factor = 1.0 if "coupled" in curve.called else arm.problem.robot.joint_map[joint, joint]
        truth = ripple(factor * curve.q[curve.inside], joint) / factor
        inside = np.abs(error - truth) <= ro.calibration.Uncertainty(found).coverage_factor * half
        sums = {"truth": np.mean(truth**2), "found": np.mean(error**2), "both": np.mean(error * truth)}
        curves.append({"joint": curve.joint, **{k: float(v) for k, v in sums.items()}, "covered": float(inside.mean())})
    return {
        "dof": dof,
        "curves": curves,
        "auto": 1e3 * rms(found.errors(true)),
        "geometry": 1e3 * rms(geometry.errors(true)),
        "undisturbed": 1e3 * rms(undisturbed.errors(arm.true)),
        "readings": ro.use.validate(found, rippled(arm.read)).coverage,
    }


def report(rows: Rows) -> Report:
    """Return what of ripple is recovered, by its number of cycles, and how often curves are admitted without any."""
    gears, clean = ([row for row in rows if (row["cycles"] > 0) == rippled] for rippled in (True, False))
    text = (
        f"{len(gears)} calibrations of arms with ripple, amplitude {1e3 * SIZE:g} mrad in the mean. Joints 1 to "
        f"{LARGE}, and the others in brackets: correlation of curve and truth, ratio of their RMS, and how much of the "
        "truth is within the 95 % interval, over the measured range. Errors: root mean square at 200 other places; "
        "geometry is the model without curves, undisturbed the same arm without ripple. Readings: those within their "
        "95 % intervals.\n\n"
    )
    head = ["cycles a turn", "admitted [%]", "correlation", "ratio", "covered [%]", "auto [mm]", "geometry [mm]"]
    lines = []
    for cycles in CYCLES:
        part = [row for row in gears if row["cycles"] == cycles]
        large, small = _recovered(part, wrist=False), _recovered(part, wrist=True)
        figures = [f"{a:.3f} ({b:.3f})" for a, b in zip(large[:2], small[:2], strict=True)]
        figures.append(f"{100 * large[2]:.1f} ({100 * small[2]:.1f})")
        errors = [f"{rms(np.array([row[kind] for row in part])):#.3g}" for kind in ("auto", "geometry", "undisturbed")]
        readings = f"{100 * np.mean([row['readings'] for row in part]):.1f}"
        lines.append([str(cycles), f"{100 * _admitted(part):.0f}", *figures, *errors, readings])
    text += markdown([*head, "undisturbed [mm]", "readings [%]"], lines)
    ratio = np.array([row["auto"] / row["geometry"] for row in clean])
    counts = ", ".join(map(str, CLEAN))
    text += (
        f"\n\n{len(clean)} arms without ripple, of {counts} configurations: curves are admitted on "
        f"{sum(bool(row['curves']) for row in clean)} of them. Error of `model auto`, whatever it admits, over that of "
        f"geometry: {gmean(ratio):.4f} in the geometric mean, {ratio.max():.3f} at most."
    )
    correlation, size, _ = _recovered(gears, wrist=False)
    metrics = {
        "admitted": _admitted(gears),
        "correlation": correlation,
        "ratio": min(size, 1 / size),
        "covered": float(np.mean([curve["covered"] for row in gears for curve in row["curves"]])),
        "over_geometry": gmean([row["auto"] / row["geometry"] for row in gears]),
        "false_admissions": _admitted(clean),
        "loss": gmean(ratio),
    }
    errors = {
        f"{kind}, {cycles} cycles": [row[kind] for row in gears if row["cycles"] == cycles]
        for cycles in CYCLES
        for kind in ("auto", "geometry")
    }
    return Report(text, metrics, {"ripple": distributions(errors, "error at other places [mm]")})


def _recovered(rows: Rows, wrist: bool) -> tuple[float, float, float]:
    """Return correlation and ratio of the RMS of all curves with the truth, and the share that intervals cover."""
    curves = [curve for row in rows for curve in row["curves"] if (curve["joint"] > LARGE) == wrist]
    if not curves:
        return float("nan"), float("nan"), float("nan")
    truth, found, both = (sum(curve[key] for curve in curves) for key in ("truth", "found", "both"))
    return both / np.sqrt(truth * found), float(np.sqrt(found / truth)), float(np.mean([c["covered"] for c in curves]))


def _admitted(rows: Rows) -> float:
    return float(np.mean([bool(row["curves"]) for row in rows]))
