"""What else a user waits for: a command's start, a bootstrap, influence, reports, many parameters."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import get_lapack_funcs

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.problem.problem import CalibrationProblem

COMMANDS = {
    "python alone": "pass",
    "rpim-opt --version": "--version",
    "rpim-opt --help": "--help",
    "import cvxpy": "import cvxpy",
    "import scipy.optimize": "import scipy.optimize",
    "rpim-opt calibrate paper_arm": "calibrate paper_arm",
}
"""Processes; those that are compared follow each other."""


def processes(runs: int) -> dict[str, list[float]]:
    """Return the seconds of whole processes, each as often, in turn: a machine's speed changes within seconds.

    As from an installation by pip, which compiles what it installs: modules are compiled before, to a folder of their
    own, since a checkout where Python writes no bytecode would compile all of them at every start.
    """
    script = "import sys; from rpim_opt.cli import main; sys.argv[0] = 'rpim-opt'; main()"
    found: dict[str, list[float]] = {name: [] for name in COMMANDS}
    with tempfile.TemporaryDirectory() as folder:
        kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
        kept["PYTHONPYCACHEPREFIX"] = folder
        for _ in range(runs + 1):
            for name, what in COMMANDS.items():
                command = [sys.executable, "-P", "-c", what]
                if name.startswith("rpim-opt"):
                    command = [sys.executable, "-P", "-c", script, *what.split()]
                found[name].append(_seconds(lambda c=command: _run(c, kept)))
    return {name: seconds[1:] for name, seconds in found.items()}


def _run(command: list[str], variables: dict[str, str]) -> None:
    subprocess.run(command, capture_output=True, check=True, env=variables)


def bootstrap(problem: CalibrationProblem, count: int) -> dict[str, float]:
    """Return the seconds of a bounded calibration's bootstrap, rows drawn with replacement: in one process and two.

    Every replicate begins at the estimate, as bootstraps do, and goes on until it has converged by itself.
    """
    from joblib import Parallel, delayed

    rows = len(problem.data)
    estimate = ro.calibrate(problem, ro.bounded, 1.0).x

    def replicates(seeds: Any) -> list[Any]:  # inside, so that it travels to a process that cannot import this file
        found = []
        for seed in seeds:
            drawn = np.random.default_rng(int(seed)).integers(rows, size=rows)
            found.append(ro.calibrate(problem.on(problem.data.take(drawn)), ro.bounded, 1.0, start=estimate).x)
        return found

    replicates([0])
    serial = _seconds(lambda: replicates(range(count)))
    halves = np.array_split(np.arange(count), 2)
    with Parallel(2) as two:
        two(delayed(replicates)([0]) for _ in range(2))  # their start is no part of it
        parallel = _seconds(lambda: two(delayed(replicates)(half) for half in halves))
    return {"seconds": serial, "two": parallel}


def influence(problem: CalibrationProblem) -> dict[str, float]:
    """Return the seconds of one calibration, and of the influence of every row."""
    result = ro.calibrate(problem, ro.tikhonov, ro.reml)
    return {
        "calibration": _least_seconds(lambda: ro.calibrate(problem, ro.tikhonov, ro.reml)),
        "seconds": _least_seconds(lambda: ro.calibration.influence(result)),
    }


def report(problem: CalibrationProblem, formulation: ro.Formulation) -> dict[str, float]:
    """Return the seconds of a calibration and of its report, and the report's size [MB]."""
    start = time.perf_counter()
    result = ro.calibrate(problem, formulation, 1.0)
    calibration = time.perf_counter() - start
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "report.html"
        seconds = _seconds(lambda: ro.report.write_report(result, file))
        size = file.stat().st_size / 1e6
    return {"calibration": calibration, "seconds": seconds, "mb": size}


def large_model(parameters: int) -> dict[str, float]:
    """Return the seconds of a calibration with so many parameters, 20 rows a reflector, and of LAPACK's QR of them."""
    problem = reflectors((parameters - 30) // 3, 20)
    ro.calibrate(problem, ro.tikhonov, 1.0)
    start = time.perf_counter()
    result = ro.calibrate(problem, ro.tikhonov, 1.0)
    seconds = time.perf_counter() - start
    model = problem.linearize(result.x)
    rows = np.asfortranarray(np.column_stack([model.A, model.b]))
    return {
        "parameters": len(problem.parameters.free),
        "rows": len(problem.data),
        "seconds": seconds,
        "passes": len(result.history) + 1,
        "qr": _least_seconds(lambda: usual_qr(rows.copy(order="F"))),
    }


_geqrf: Any = get_lapack_funcs("geqrf", dtype=float)


def usual_qr(columns: Array) -> Any:
    """Return LAPACK's usual QR (geqrf) of rows (m, n) whose columns stand together; they are overwritten."""
    return _geqrf(columns, lwork=64 * columns.shape[1], overwrite_a=1)


def reflectors(count: int, each: int) -> CalibrationProblem:
    """Return an arm that carries many reflectors, each seen in some configurations: three parameters a reflector."""
    rng = np.random.default_rng(0)
    robot = ro.load("paper_arm").problem.robot
    names = [f"M{k}" for k in range(count)]
    tools = {name: [*rng.uniform(-0.1, 0.1, 3), 0.0, 0.0, 0.0] for name in names}
    parameters = ro.robot.model_parameters(robot, tools=tools)
    parameters = parameters.identify(["alpha?", "a?", "theta?", "d?", "base_*", "tool_*_[xyz]"])
    q = rng.uniform(-2, 2, (each * count, robot.dof))
    table: dict[str, Any] = {"marker": each * names}
    table |= {f"q{j + 1}_rad": q[:, j] for j in range(robot.dof)}
    table |= {f"{axis}_m": np.zeros(len(q)) for axis in "xyz"}
    empty = CalibrationProblem(robot, parameters, ro.read_data(table, robot, {"position_mm": 0.05}))
    truth = 0.3 * rng.normal(size=len(parameters.free)) * parameters.free.scale
    blocks = [
        replace(block, y=y + 5e-5 * rng.normal(size=y.shape))
        for block, y in zip(empty.data.blocks, empty.modelled(truth), strict=True)
    ]
    return empty.on(replace(empty.data, blocks=tuple(blocks)))


def _seconds(work: Callable[[], Any]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _least_seconds(work: Callable[[], Any]) -> float:
    """Return the least of many: where cores are shared, threads of a few ms wait for each other more often than not."""
    return min(_seconds(work) for _ in range(20))
