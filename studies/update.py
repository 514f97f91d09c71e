"""Robots that were calibrated once, crash or stay as they are, and are measured again; and checks that watch them.

Simulated arms (`ro.study.simulated_arm`), 40 positions of 0.05 mm noise at first. A crash lets one joint be off,
neither the first nor the last: eight new positions update the result, at 200 others nothing has been measured. Checks:
24 at six places, one place after the other, while a joint stays, moves steadily, or jumps before the thirteenth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.basics.text import markdown
from rpim_opt.calibration import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.study import Metric, Report
from rpim_opt.study.figures import distributions

QUESTION = "Is a change of a calibrated robot found, and what do eight points make of what was known before?"
FIRST = 17_000
"""Seed of the first arm: nothing was chosen by these."""
SIGMA = 5e-5
CALIBRATED, NEW = 40, 8
PLACES, CHECKS = 6, 24
CRASHES = (0.0, 0.2, 0.5, 1.0, 4.0)
"""Changes of a joint [mrad]."""
COURSES: dict[str, Callable[[Array], Array]] = {
    "steadily": lambda t: t / (CHECKS - 1),
    "at once": lambda t: np.where(t >= CHECKS // 2, 1.0, 0.0),
}
"""How far a joint has moved, of all that it moves, at the checks of the numbers t."""
DRIFTS = (0.2, 0.5)
"""How far in all [mrad]."""
STILL = "steadily"
"""The course of a joint that moves by nothing."""
KINDS = ("updated", "old", "alone", "undisturbed")
Rows = list[dict[str, Any]]
METRICS = {
    "over_undisturbed": Metric("lower", 0.1),
    "held": Metric("higher", 0.02),
    "named": Metric("higher", 0.1),
    "accused": Metric("lower", 0.0),
    "false_alarms": Metric("lower", 0.0),
    "drifts_found": Metric("higher", 0.1),
}


def cases(quick: bool) -> Rows:
    """Return everything that may happen to an arm, with ten arms or 300."""
    happens = [("crash", mrad) for mrad in CRASHES]
    happens += [(STILL, 0.0), *((course, mrad) for course in COURSES for mrad in DRIFTS)]
    arms = range(FIRST, FIRST + (10 if quick else 300))
    return [{"happens": what, "mrad": mrad, "seed": seed} for what, mrad in happens for seed in arms]


def run(happens: str, mrad: float, seed: int) -> dict[str, Any]:
    """Return what the new readings make of an arm's calibration."""
    arm = ro.study.simulated_arm(seed, CALIBRATED + NEW, SIGMA)
    first = ro.calibrate(arm.problem.on(arm.problem.data.take(np.arange(CALIBRATED))))
    joint = 1 + seed // 3 % (arm.problem.robot.dof - 2)
    if happens == "crash":
        return _updated(arm, first, joint, 1e-3 * mrad)
    return _monitored(arm, first, joint, 1e-3 * mrad * COURSES[happens](np.arange(CHECKS, dtype=float)), seed)


def _updated(arm: ro.study.SimulatedArm, first: Calibration, joint: int, size: float) -> dict[str, Any]:
    after = _moved(first, arm.problem.data.take(np.arange(CALIBRATED, CALIBRATED + NEW)), joint, size)
    unseen = _moved(first, arm.true, joint, size)
    found = ro.use.update(first, after)
    changed = [cause.name for cause in found.changes if cause.kind != "reading"]
    return {
        "updated": 1e3 * _rms(found.result.errors(unseen)),
        "old": 1e3 * _rms(first.errors(unseen)),
        "alone": 1e3 * _rms(ro.calibrate(arm.problem.on(after)).errors(unseen)),
        "undisturbed": 1e3 * _rms(ro.calibrate(arm.problem).errors(arm.true)),
        "held": ro.use.validate(found.result, _moved(first, arm.read, joint, size)).coverage,
        "found": bool(changed),
        "right": changed == [f"theta{joint + 1}"],
        "left out": len(changed) < len(found.changes),
    }


def _monitored(arm: ro.study.SimulatedArm, first: Calibration, joint: int, course: Array, seed: int) -> dict[str, Any]:
    places = arm.true.take(np.arange(CHECKS) % PLACES)
    noise = SIGMA * np.random.default_rng([seed, 17]).standard_normal((CHECKS, 3))
    found = ro.use.monitor(first, _moved(first, places, joint, course, noise))
    return {
        "found": found.drifts,
        "right": found.drift is not None and found.drift.cause.name == f"theta{joint + 1}",
    }


def _moved(first: Calibration, data: Dataset, joint: int, size: Array | float, noise: Array | float = 0.0) -> Dataset:
    """Return the same places of an arm of which a joint is off [rad]: its encoders say less by that."""
    block = data.blocks[0]
    encoder = np.linalg.inv(first.problem.robot.joint_map)[:, joint]
    return Dataset.of(block.q[:, 0] - np.multiply.outer(size, encoder), block.y + noise, SIGMA)


def report(rows: Rows) -> Report:
    """Return errors and what was found after crashes of every size, and how often checks tell a drift."""
    count = len({row["seed"] for row in rows})
    crashes = {mrad: _part(rows, "crash", mrad) for mrad in CRASHES}
    courses = {(what, mrad): _part(rows, what, mrad) for what in COURSES for mrad in DRIFTS}
    still = _part(rows, STILL, 0.0)
    hard = crashes[CRASHES[-1]]
    text = (
        f"{count} simulated arms each. Errors: root mean square at 200 unseen places of all arms; in brackets what "
        "95 % of the arms are below. Undisturbed: by all 48 positions of the same arm if nothing had happened. Found: "
        "robot, tool or base are said to have changed. Right: the joint that has, and nothing else. Held: readings at "
        "the unseen places that are inside the 95 % intervals of the updated result.\n\n"
    )
    text += markdown(*_crash_table(crashes)) + "\n\nChecks over time. Found: an alarm of any kind. Right: the joint is "
    text += "named as the cause.\n\n" + markdown(*_checks_table(still, courses))
    metrics = {
        "over_undisturbed": _rms([row["updated"] for row in hard]) / _rms([row["undisturbed"] for row in hard]),
        "held": _mean(rows, "held"),
        "named": _mean(hard, "right"),
        "accused": _mean(crashes[0.0], "found"),
        "false_alarms": _mean(still, "found"),
        "drifts_found": _mean([row for part in courses.values() for row in part], "found"),
    }
    errors = {kind: [row[kind] for row in hard] for kind in KINDS}
    figure = distributions(errors, f"error after a joint was off by {CRASHES[-1]:g} mrad [mm]")
    return Report(text, metrics, {"crash": figure})


def _crash_table(crashes: dict[float, Rows]) -> tuple[list[str], list[list[str]]]:
    """Return the head and a line for every size."""
    shares = {"found": "found", "right": "right", "left out": "a reading left out", "held": "held"}
    head = ["joint off by [mrad]", *(f"{kind} [mm]" for kind in KINDS), *(f"{name} [%]" for name in shares.values())]
    lines = []
    for mrad, part in crashes.items():
        errors = [_spread(part, kind) for kind in KINDS]
        lines.append([f"{mrad:g}", *errors, *(_percent(part, share) for share in shares)])
    return head, lines


def _checks_table(still: Rows, courses: dict[tuple[str, float], Rows]) -> tuple[list[str], list[list[str]]]:
    """Return the head and a line for every course and size."""
    lines = [["stays", "0", _percent(still, "found"), ""]]
    for (what, mrad), part in courses.items():
        lines.append([what, f"{mrad:g}", _percent(part, "found"), _percent(part, "right")])
    return ["joint moves", "by [mrad]", "found [%]", "right [%]"], lines


def _part(rows: Rows, happens: str, mrad: float) -> Rows:
    return [row for row in rows if row["happens"] == happens and row["mrad"] == mrad]


def _mean(rows: Rows, what: str) -> float:
    return float(np.mean([row[what] for row in rows if what in row]))


def _percent(rows: Rows, what: str) -> str:
    return f"{100 * _mean(rows, what):.1f}"


def _spread(rows: Rows, kind: str) -> str:
    found = [row[kind] for row in rows]
    return f"{_rms(found):#.3g} ({np.percentile(found, 95):#.3g})"


def _rms(errors: Sequence[float] | Array) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))
