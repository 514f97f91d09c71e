"""The same lasso, group lasso and Huber paths by skglm, scikit-learn and by us: seconds, and how exact each is."""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import rpim_opt as ro
from rpim_opt.convex.program import Program
from rpim_opt.convex.rules.selection import weight_grid
from rpim_opt.problem.linear import LinearModel

REQUIREMENTS = ("skglm==0.5", "scikit-learn==1.9.1")
WEIGHTS = 15
THRESHOLD = 2.0
RUNS, ENOUGH = 50, 0.5
"""As `run_solvers` has them: everyone is timed warm, the least of as many runs as fit into half a second."""
PROBLEMS = {
    "lasso": ro.lasso,
    "group lasso": ro.group_lasso,
    "Huber": ro.Formulation("Huber of equations", loss=ro.huber(THRESHOLD), penalty=ro.tikhonov.penalty),
}
"""Huber's loss of every equation with a known threshold (scikit-learn's estimates a scale, and is another)."""


def compared(program: str, model: LinearModel) -> dict[str, Any]:
    """Return seconds, and the largest excess of an objective over the least one found, by problem and tool.

    Parameters
    ----------
    program
        The Python that has the other tools.
    model
        Whose A and b are exported, the columns scaled to one length: coordinate descent asks for that.
    """
    lengths = np.linalg.norm(model.A, axis=0)
    model = replace(model, A=model.A * (np.sqrt(np.mean(lengths**2)) / lengths))
    posed = {name: ro.convex.pose(formulation, model) for name, formulation in PROBLEMS.items()}
    grids = {name: weight_grid(each, WEIGHTS)[::-1][: 2 * WEIGHTS // 3] for name, each in posed.items()}
    ends = np.cumsum([len(D) for D in ro.constraints.by_link(model.parameters)])
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "given.npz"
        weights = {f"{name} weights": grid for name, grid in grids.items()}
        np.savez(file, A=model.A, b=model.b, ends=ends, threshold=THRESHOLD, allow_pickle=False, **weights)
        script = Path(__file__).with_name("run_solvers.py")
        done = subprocess.run([program, str(script), str(file)], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout.splitlines()[-1])
    for name, each in posed.items():
        found[f"{name}, rpim_opt"] = _ours(each, grids[name])
    return {key: _judged(posed, grids, found, key) for key in found}


def _ours(program: Program, weights: np.ndarray) -> dict[str, Any]:
    """Return seconds and solutions of the path, without what other paths left behind."""
    seconds: list[float] = []
    Z: list[np.ndarray] = []
    while len(seconds) < 2 or (len(seconds) < RUNS and sum(seconds) < ENOUGH):
        fresh = ro.convex.pose(program.formulation, program.model)
        fresh.solve(float(weights[0]))  # the formulation is read, as the others are compiled
        start = time.perf_counter()
        Z = [estimate.z for estimate in fresh.path(weights)]
        seconds.append(time.perf_counter() - start)
    return {"seconds": min(seconds), "z": Z}


def _judged(posed: dict[str, Program], grids: dict[str, np.ndarray], found: dict[str, Any], key: str) -> dict[str, Any]:
    problem = key.partition(", ")[0]
    program, weights = posed[problem], grids[problem]
    values = {other: _objectives(program, weights, each["z"]) for other, each in found.items()
              if other.startswith(f"{problem}, ")}  # fmt: skip
    least = np.min(list(values.values()), axis=0)
    return {"seconds": found[key]["seconds"], "excess": float(np.max(values[key] / least - 1))}


def _objectives(program: Program, weights: np.ndarray, Z: Any) -> np.ndarray:
    return np.array([program.objective(np.asarray(z), float(w)) for z, w in zip(Z, weights, strict=True)])
