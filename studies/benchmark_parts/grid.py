"""The grid of all ready formulations and all rules for the weight: seconds of every cell, and of Tikhonov beside it."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import numpy as np

import rpim_opt as ro
from rpim_opt.convex.formulation import FORMULATIONS
from rpim_opt.convex.select import SELECTORS
from rpim_opt.problem.problem import CalibrationProblem

RULES: dict[str, Any] = {"number": 1.0, **SELECTORS}
"""One weight, and every selector."""
PATIENCE = {40: 30, 1_000: 60, 20_000: 240}
"""Seconds that a cell gets, by configurations."""
TIMES, ENOUGH = 6, 6.0
"""How often a cell is timed at most, and the seconds after which it was often enough."""
BLUNDERS = 0.05
"""Part of the configurations that are off by some millimetres."""


def cells(quick: bool) -> list[dict[str, Any]]:
    """Return the cells; in the quick version those rules at 40 that one linearization answers."""
    if quick:
        rules = ("number", "reml", "l_curve", "gcv")
        return [_cell(name, rule, 40) for name in FORMULATIONS for rule in rules if _applies(name, rule)]
    return [_cell(name, rule, n) for n in PATIENCE for name in FORMULATIONS for rule in RULES if _applies(name, rule)]


def _cell(formulation: str, rule: str, count: int) -> dict[str, Any]:
    return {"part": "cell", "tool": formulation, "method": rule, "count": count}


def _applies(name: str, rule: str) -> bool:
    """Whether a formulation has a weight to choose."""
    return FORMULATIONS[name].penalty is not None or rule == "number"


@lru_cache(maxsize=2)
def arm(count: int, blunders: float = BLUNDERS) -> CalibrationProblem:
    """Return an arm with base and reflector (33 parameters) at random configurations, some of them blunders."""
    robot = ro.load("paper_arm").problem.robot
    parameters = ro.robot.model_parameters(robot, tools={"": [0.03, -0.02, 0.06, 0, 0, 0]})
    parameters = parameters.identify(["alpha?", "a?", "theta?", "d?", "tool_[xyz]", "base_*"])
    parameters = parameters.toleranced(
        {"length_mm": 0.4, "angle_mrad": 0.4, "tool_mm": 0.4, "base_mm": 0.4, "base_mrad": 0.4}
    )
    rng = np.random.default_rng(count)
    truth = 0.3 * rng.normal(size=len(parameters.free)) * parameters.free.scale
    q = rng.uniform(-2, 2, (count, robot.dof))
    empty = CalibrationProblem(robot, parameters, ro.Dataset.of(q, np.zeros((count, 3)), 5e-5))
    y = empty.modelled(truth)[0] + 5e-5 * rng.normal(size=(count, 3))
    off = rng.random(count) < blunders
    y[off] += 2e-3 * rng.normal(size=(np.count_nonzero(off), 3))
    return empty.on(ro.Dataset.of(q, y, 5e-5))


def cell(formulation: str, rule: str, count: int) -> dict[str, Any]:
    """Return the seconds of a calibration, those of Tikhonov with the same rule, and how it ended.

    The least of some runs of either, in turn: a machine's speed changes within seconds.
    """
    problem = arm(count)
    weight = RULES[rule]
    beside, seconds, ended = [], [], ""
    begin = time.perf_counter()
    while not seconds or (len(seconds) < TIMES and time.perf_counter() - begin < ENOUGH):
        beside.append(timed(lambda: ro.calibrate(problem, ro.tikhonov, weight))[0])
        try:
            with limited(PATIENCE[count]):
                each, result = timed(lambda: ro.calibrate(problem, FORMULATIONS[formulation], weight))
        except ro.InputError as error:
            return {"seconds": None, "tikhonov": min(beside), "ended": f"does not apply: {error}"}
        except (ro.NoSolutionFound, TimeoutError) as error:
            return {"seconds": float(PATIENCE[count]), "tikhonov": min(beside), "ended": f"{type(error).__name__}"}
        seconds.append(each)
        ended = "converged" if result.converged else "not converged"
    return {"seconds": min(seconds), "tikhonov": min(beside), "ended": ended}


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """Return the seconds of work, and what it returned."""
    start = time.perf_counter()
    found = work()
    return time.perf_counter() - start, found


@contextmanager
def limited(seconds: int) -> Iterator[None]:
    """Raise TimeoutError in what runs longer; only a process's main thread can be interrupted."""
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "SIGALRM"):
        yield
        return

    def late(*_: Any) -> None:
        raise TimeoutError

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def figure(rows: list[dict[str, Any]]) -> Any:
    """Return seconds of every cell as a coloured table, one panel a number of configurations."""
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    counts = sorted({row["count"] for row in rows})
    names = [name for name in FORMULATIONS if name in {row["tool"] for row in rows}]
    rules = [rule for rule in RULES if rule in {row["method"] for row in rows}]
    found = Figure(figsize=(1.5 + 4.4 * len(counts), 1.6 + 0.28 * len(rules)), layout="constrained")
    image = None
    for ax, count in zip(np.atleast_1d(found.subplots(1, len(counts), sharey=True)), counts, strict=True):
        table = np.full((len(rules), len(names)), np.nan)
        for row in rows:
            if row["count"] == count and "seconds" in row:
                table[rules.index(row["method"]), names.index(row["tool"])] = row["seconds"]
        image = ax.imshow(table, norm=LogNorm(1e-3, 1e2), cmap="viridis_r", aspect="auto")
        for i, j in zip(*np.nonzero(np.isfinite(table)), strict=True):
            ax.text(j, i, f"{table[i, j]:.2g}", ha="center", va="center", fontsize=6)
        ax.set_xticks(range(len(names)), names, rotation=60, ha="right", fontsize=7)
        ax.set_yticks(range(len(rules)), rules, fontsize=7)
        ax.set_title(f"{count:,} configurations", fontsize=9)
    if image is not None:
        found.colorbar(image, label="seconds")
    return found
