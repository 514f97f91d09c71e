"""Robots that were calibrated once, crash or stay as they are, and are measured again; and checks that watch them.

Simulated arms (`ro.study.simulated_arm`), 40 positions of 0.05 mm noise at first. A crash lets one joint be off,
neither the first nor the last: eight new positions update the result, at 200 others nothing has been measured. Checks:
24 at six places, one place after the other, while a joint stays, moves steadily, or jumps before the thirteenth.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import rpim_opt as ro
from rpim_opt.basics.arrays import Array, rms
from rpim_opt.basics.text import markdown
from rpim_opt.calibration import Calibration
from rpim_opt.data.dataset import Dataset
from rpim_opt.study import Metric, Report, distributions

QUESTION = "Is a change of a calibrated robot detected, and how accurate is an update from eight points?"
FIRST = 17_000
"""Seed of the first arm: nothing was chosen by these."""
SIGMA = 5e-5
CALIBRATED, NEW = 40, 8
PLACES, CHECKS = 6, 24
CRASHES = (0.0, 0.2, 0.5, 1.0, 4.0)
"""Changes of a joint [mrad]."""
MOVES: dict[str, Callable[[Array], Array]] = {
    "not at all": np.zeros_like,
    "steadily": lambda t: t / (CHECKS - 1),
    "at once": lambda t: np.where(t >= CHECKS // 2, 1.0, 0.0),
}
"""How far a joint has moved, of all that it moves, at the checks of the numbers t."""
COURSES = (("not at all", 0.0), ("steadily", 0.2), ("steadily", 0.5), ("at once", 0.2), ("at once", 0.5))
"""How a joint moves, and how far in all [mrad]."""
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
    """Return 16 arms or 150, to each of which everything happens."""
    return [{"seed": FIRST + i} for i in range(16 if quick else 150)]


def run(seed: int) -> dict[str, Any]:
    """Return what new readings and checks make of an arm's calibration, whatever happened to it."""
    arm = ro.study.simulated_arm(seed, CALIBRATED + NEW, SIGMA)
    first = ro.calibrate(arm.problem.on(arm.problem.data.take(np.arange(CALIBRATED))))
    joint = 1 + seed // 3 % (arm.problem.robot.dof - 2)
    noise = SIGMA * np.random.default_rng([seed, 17]).standard_normal((CHECKS, 3))
    undisturbed = 1e3 * rms(ro.calibrate(arm.problem).errors(arm.true))
    return {
        "crashes": [{**_updated(arm, first, joint, mrad), "undisturbed": undisturbed} for mrad in CRASHES],
        "checks": [_monitored(arm, first, joint, what, mrad, noise) for what, mrad in COURSES],
    }


def _updated(arm: ro.study.SimulatedArm, first: Calibration, joint: int, mrad: float) -> dict[str, Any]:
    size = 1e-3 * mrad
    after = _moved(first, arm.problem.data.take(np.arange(CALIBRATED, CALIBRATED + NEW)), joint, size)
    unseen = _moved(first, arm.true, joint, size)
    found = ro.use.update(first, after)
    changed = [cause.name for cause in found.changes if cause.kind != "reading"]
    return {
        "mrad": mrad,
        "updated": 1e3 * rms(found.result.errors(unseen)),
        "old": 1e3 * rms(first.errors(unseen)),
        "alone": 1e3 * rms(ro.calibrate(arm.problem.on(after)).errors(unseen)),
        "held": ro.use.validate(found.result, _moved(first, arm.read, joint, size)).coverage,
        "found": bool(changed),
        "right": changed == [f"theta{joint + 1}"],
        "left out": len(changed) < len(found.changes),
    }


def _monitored(
    arm: ro.study.SimulatedArm, first: Calibration, joint: int, moves: str, mrad: float, noise: Array
) -> dict[str, Any]:
    places = arm.true.take(np.arange(CHECKS) % PLACES)
    course = 1e-3 * mrad * MOVES[moves](np.arange(CHECKS, dtype=float))
    found = ro.use.monitor(first, _moved(first, places, joint, course, noise))
    return {
        "moves": moves,
        "mrad": mrad,
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
    crashes = {mrad: [each for row in rows for each in row["crashes"] if each["mrad"] == mrad] for mrad in CRASHES}
    checks = [[row["checks"][i] for row in rows] for i in range(len(COURSES))]
    still, *moving = checks
    hard = crashes[CRASHES[-1]]
    text = (
        f"{len(rows)} simulated arms. Errors: root mean square at 200 unseen places of all arms; in brackets what "
        "95 % of the arms are below. Undisturbed: by all 48 positions of the same arm if nothing had happened. Found: "
        "robot, tool or base are said to have changed. Right: the joint that has, and nothing else. Held: readings at "
        "the unseen places that are inside the 95 % intervals of the updated result.\n\n"
    )
    text += markdown(*_crash_table(crashes)) + "\n\nChecks over time. Found: an alarm of any kind. Right: the joint is "
    text += "named as the cause.\n\n" + markdown(*_checks_table(checks))
    metrics = {
        "over_undisturbed": _rms(hard, "updated") / _rms(hard, "undisturbed"),
        "held": _mean([each for part in crashes.values() for each in part], "held"),
        "named": _mean(hard, "right"),
        "accused": _mean(crashes[0.0], "found"),
        "false_alarms": _mean(still, "found"),
        "drifts_found": _mean([each for part in moving for each in part], "found"),
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


def _checks_table(checks: list[Rows]) -> tuple[list[str], list[list[str]]]:
    """Return the head and a line for every course."""
    lines = []
    for (moves, mrad), part in zip(COURSES, checks, strict=True):
        lines.append([moves, f"{mrad:g}", _percent(part, "found"), _percent(part, "right")])
    return ["joint moves", "by [mrad]", "found [%]", "right [%]"], lines


def _mean(rows: Rows, what: str) -> float:
    return float(np.mean([row[what] for row in rows]))


def _percent(rows: Rows, what: str) -> str:
    return f"{100 * _mean(rows, what):.1f}"


def _spread(rows: Rows, kind: str) -> str:
    return f"{_rms(rows, kind):#.3g} ({np.percentile([row[kind] for row in rows], 95):#.3g})"


def _rms(rows: Rows, kind: str) -> float:
    return rms(np.array([row[kind] for row in rows]))
