"""Measure the time of calibrations: against SciPy and the peers, with every rule, over the number of measurements.

And what else a user waits for: a command's start, a bootstrap, influence, reports, models with many parameters.

Simulated: the first arm of the study `peers` (52 configurations, 35 parameters), and random configurations of the
paper's arm with base and reflector (33 parameters) as Parquet tables of 50,000 rows. Times are medians in a warm
process, of its own where memory is measured; the machines are shared, so that only ratios within a run count.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import clarabel
import numpy as np

import rpim_opt as ro
from rpim_opt.basics.text import markdown
from rpim_opt.basics.threads import cores, on_all_cores, one_blas_thread
from rpim_opt.convex.formulation import FORMULATIONS
from rpim_opt.problem.blocks import ROWS, PartitionedProblem, partitions, reduced
from rpim_opt.problem.linear import reduced_rows
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.study import Metric, Report
from rpim_opt.study.studies import find_study, load_study

QUESTION = "How fast is a calibration with any formulation and rule, and what do a million configurations cost?"
PART = 50_000
HERE = Path(__file__).resolve().parent
GRID = load_study(HERE / "benchmark_parts" / "grid.py", ("cells", "cell", "figure"))
SOLVERS = load_study(HERE / "benchmark_parts" / "solvers.py", ("compared",))
OTHERS = load_study(HERE / "benchmark_parts" / "others.py", ("processes", "bootstrap"))
PEERS = ("pybotics", "robotkinecal", "figaroh")
METRICS = {  # limits are wide: gates run on shared machines, and tests say what of it needs no clock
    "over SciPy": Metric("lower", 1.0),
    "robotkinecal, documented over ours": Metric("higher", 0.5),
    "figaroh, structural over ours": Metric("higher", 0.5),
    "bounded path [ms]": Metric("lower", 4.0),
    "bootstrap of 1000 [s]": Metric("lower", 4.0),
    "pass over copy and QR": Metric("lower", 1.0),
    "peak memory, largest over smallest": Metric("lower", 0.3),
    "calibrate paper_arm over importing SciPy's optimizers": Metric("lower", 1.0),
    "slowest cell at 40 [s]": Metric("lower", 3.0),
    "influence over calibration": Metric("lower", 2.0),
    "report of a robust result over importing SciPy's optimizers": Metric("lower", 1.0),
    "pass of many parameters over its QR": Metric("lower", 2.0),
}


def prepare(quick: bool) -> None:
    """Install the peers, as the study `peers` does, and in the long version solvers of lasso."""
    peers = load_study(find_study("peers"))
    peers.prepare(quick)
    if not quick:  # a minute of it is compiling
        peers.install("solvers", SOLVERS.REQUIREMENTS, (3, 14))


def cases(quick: bool) -> list[dict[str, Any]]:
    """Return the small problem, its bootstrap, the peers, and growing numbers of rows; run by one worker."""
    counts = (1_000, 10_000, 100_000) if quick else (1_000, 10_000, 100_000, 1_000_000)
    one: list[dict[str, Any]] = [{"part": "small"}, {"part": "bootstrap", "count": 50 if quick else 1000}]
    one += [{"part": "peer", "tool": tool, "count": int(quick)} for tool in PEERS]
    one += [{"part": "rows", "count": count} for count in counts]
    one += [{"part": "process", "count": 5 if quick else 9}, {"part": "influence", "count": 2_000 if quick else 20_000}]
    one += [{"part": "report", "count": 400, "tool": "robust"}]
    one += [{"part": "model", "count": count} for count in ((60, 210) if quick else (60, 210, 510, 990))]
    one += GRID.cells(quick)
    if quick:
        return one
    one += [{"part": "report", "count": n, "tool": "robust"} for n in (2_208, 20_000)]
    one += [{"part": "solvers", "count": n} for n in (40, 1_000)]
    return [*one, {"part": "report", "count": 20_000, "tool": "tikhonov"}, {"part": "cluster", "count": 10_000_000}]


def run(part: str, count: int = 0, tool: str = "", method: str = "") -> dict[str, Any]:
    """Return the times of one part [s], or its memory [MB]."""
    if part == "peer":
        found = load_study(find_study("peers")).run(tool, "clean52", 0, bool(count), anew=True)
        return {key: value for key, value in found.items() if key.endswith(": seconds")}
    if part in ("rows", "cluster"):
        command = [sys.executable, "-P", __file__, part, str(count)]  # -P: selectors.py here is not Python's
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(done.stderr)
        return json.loads(done.stdout.splitlines()[-1])
    works: dict[str, Callable[[], dict[str, Any]]] = {
        "small": _small,
        "bootstrap": lambda: OTHERS.bootstrap(_arm(bounds=True), count),
        "process": lambda: {"processes": OTHERS.processes(count)},
        "influence": lambda: OTHERS.influence(GRID.arm(count, 0.0)),
        "report": lambda: OTHERS.report(GRID.arm(count), FORMULATIONS[tool]),
        "model": lambda: OTHERS.large_model(count),
        "cell": lambda: GRID.cell(tool, method, count),
        "solvers": lambda: {"solvers": _solvers(count)},
    }
    return works[part]()


def _solvers(count: int) -> dict[str, Any]:
    """Return how long paths take by us and by others, and how exact they are."""
    problem = GRID.arm(count)
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    program = find_study("peers").parent / ".environments" / "solvers" / "bin" / "python"
    return SOLVERS.compared(str(program), model)


def _arm(bounds: bool) -> CalibrationProblem:
    """Return the problem that the peers get."""
    problem = ro.study.simulated_arm(0, 52, load_study(find_study("peers")).NOISE).problem
    if not bounds:
        return problem
    tolerances = {"length_mm": 0.4, "angle_mrad": 1.0, "tool_mm": 0.5, "base_mm": 0.5, "base_mrad": 1.0}
    return problem.with_parameters(problem.parameters.toleranced(tolerances))


def _scipy(problem: CalibrationProblem) -> Callable[[], Any]:
    """Return the same calibration by SciPy alone, on a vectorised forward model in mm and rad."""
    from scipy.optimize import least_squares

    scripts = find_study("peers").parent / "peer_scripts"
    sys.path.insert(0, str(scripts))  # the script imports its neighbour
    try:
        positions = load_study(scripts / "run_scipy.py", ("positions",)).positions
    finally:
        sys.path.remove(str(scripts))
    nominal = dict(zip(problem.parameters.names, problem.parameters.nominal, strict=True))
    base = np.array([nominal[f"base_{key}"] for key in ("x", "y", "z", "rx", "ry", "rz")])
    reflector = 1e3 * np.array([nominal[f"tool_{key}"] for key in "xyz"])
    parallel = [int(name[4:]) - 1 for name in problem.parameters.free.names if name.startswith("beta")]
    table = (problem.robot.mdh[:, :4] * [1, 1e3, 1, 1e3]).ravel()
    x0 = np.concatenate([table, base * [1e3, 1e3, 1e3, 1, 1, 1], reflector, np.zeros(len(parallel))])
    q = problem.data.q @ problem.robot.joint_map.T
    p = 1e3 * problem.data.blocks[0].y
    return lambda: least_squares(lambda x: (positions(x, q, parallel) - p).ravel(), x0, method="lm")


def _median(work: Callable[[], Any], runs: int = 31, now: Callable[[], float] = time.perf_counter) -> float:
    work()
    seconds = []
    for _ in range(runs):
        start = now()
        work()
        seconds.append(now() - start)
    return float(np.median(seconds))


def _small() -> dict[str, Any]:
    """Return medians for 52 configurations."""
    problem = _arm(bounds=False)
    times: dict[str, float | None] = {
        "L-curve": _median(lambda: ro.calibrate(problem, ro.tikhonov, ro.l_curve)),
        "REML": _median(lambda: ro.calibrate(problem, ro.tikhonov, ro.reml)),
        "SciPy": _median(_scipy(problem), 5),
    }
    bounded = _arm(bounds=True)
    n = len(bounded.parameters.free)
    program = ro.convex.pose(ro.bounded, bounded.linearize(np.zeros(n)))
    s = program.model.svd[1]
    weights = np.geomspace(1e-4 * s[s > 0][-1] ** 2, 10 * s[0] ** 2, 200)
    inside = [float(np.abs(e.z).max()) for e in program.path(weights)]
    times["bounded path"] = _median(lambda: program.path(weights), 11)
    times["bounded"] = _median(lambda: ro.calibrate(bounded, ro.bounded, 1.0))
    times["robust"] = _median(lambda: ro.calibrate(problem, ro.robust, ro.reml), 5)
    lasso = ro.convex.pose(ro.lasso, bounded.linearize(np.zeros(n)))  # a box has an active set, and needs no Clarabel
    times["program once"] = _median(lambda: lasso.solve(10.0))
    times["Clarabel once"] = _clarabel(lasso)
    return {**times, "held": float(np.mean(np.array(inside) > 0.99))}


def _clarabel(program: Any) -> float | None:
    """Return the median of the time that Clarabel says it took itself [s]; None where it is not asked."""
    library: Any = clarabel
    own, spent = library.DefaultSolver, []

    class Solver:
        def __init__(self, *data: Any):
            self.solver = own(*data)

        def update(self, **data: Any) -> None:
            self.solver.update(**data)

        def solve(self) -> Any:
            solution = self.solver.solve()
            spent.append(solution.solve_time)
            return solution

    library.DefaultSolver = Solver
    try:
        for _ in range(31):
            program.solve(10.0)
    finally:
        library.DefaultSolver = own
    if not spent:  # another method solves it
        return None
    return float(np.median(spent))


def _tables(folder: Path, count: int) -> tuple[PartitionedProblem, np.ndarray]:
    """Write simulated tables and return their problem with the truth, deviations [SI]."""
    import pyarrow as pa
    from pyarrow import parquet

    robot = ro.load("paper_arm").problem.robot
    parameters = ro.robot.model_parameters(robot, tools={"": [0.03, -0.02, 0.06, 0, 0, 0]})
    parameters = parameters.identify(["alpha?", "a?", "theta?", "d?", "tool_[xyz]", "base_*"])
    truth = 0.3 * np.random.default_rng(0).normal(size=len(parameters.free)) * parameters.free.scale
    files = []
    for start in range(0, count, PART):
        rng, size = np.random.default_rng([start, count]), min(PART, count - start)
        q = rng.uniform(-2, 2, (size, 6))
        empty = CalibrationProblem(robot, parameters, ro.Dataset.of(q, np.zeros((size, 3)), 5e-5))
        y = empty.modelled(truth)[0] + 5e-5 * rng.normal(size=(size, 3))
        columns = {f"q{i + 1}_rad": q[:, i] for i in range(6)} | {f"{a}_m": y[:, i] for i, a in enumerate("xyz")}
        files.append(folder / f"{start}.parquet")
        parquet.write_table(pa.table(columns), files[-1])
    readers = partitions(files, robot, {"position_mm": 0.05})
    return PartitionedProblem(robot, parameters, readers[0](), readers), truth


def _rows(count: int) -> dict[str, Any]:
    """Return seconds, passes and memory of a calibration that reads its rows from Parquet."""
    with tempfile.TemporaryDirectory() as folder:
        problem, truth = _tables(Path(folder), count)
        first = problem.parts[0]()
        warm = CalibrationProblem(problem.robot, problem.parameters, first)
        reduced(warm, 0 * truth)  # compiles, where that pays
        ro.calibrate(warm.on(first.take(range(500))), ro.tikhonov, ro.reml)
        start = time.perf_counter()
        worked = time.process_time()
        result = ro.calibrate(problem, ro.tikhonov, ro.reml)
        worked = time.process_time() - worked
        seconds = time.perf_counter() - start
    block = np.random.default_rng(0).normal(size=(3 * ROWS, len(truth) + 1))
    target = np.empty_like(block)
    columns = np.asfortranarray(block)  # as LAPACK asks for them
    own = [np.empty_like(columns) for _ in range(2 * cores())]

    def copied(k: int) -> None:
        np.copyto(own[k], columns)
        OTHERS.usual_qr(own[k])

    alone = one_blas_thread(lambda: copied(0))
    together = one_blas_thread(lambda: on_all_cores(copied, range(len(own))))

    return {
        "seconds": seconds,
        "passes": len(result.history) + 1,  # one linearization more than steps
        "converged": result.converged,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "worked": worked,
        "floor_us": 1e6 * _median(alone, 11) / ROWS,
        "floor_worked_us": 1e6 * _median(alone, 11, time.process_time) / ROWS,
        "floor_together_us": 1e6 * _median(together, 11) / ROWS / len(own),
        "qr_us": 1e6 * _median(one_blas_thread(lambda: reduced_rows(block)), 11) / ROWS,
        "copy_us": 1e6 * _median(lambda: np.copyto(target, block), 11) / ROWS,
        "worst": float(np.abs((result.x - truth) / problem.parameters.free.scale).max()),
    }


def _cluster(count: int) -> dict[str, Any]:
    """Return seconds and the workers' memory of a calibration on a Dask cluster of two processes on this machine."""
    warnings.simplefilter("ignore")
    off: Any = None  # the annotation says str

    from distributed import Client, LocalCluster

    with tempfile.TemporaryDirectory() as folder:
        problem, truth = _tables(Path(folder), count)
        with (
            LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=off) as cluster,
            Client(cluster) as client,
        ):
            start = time.perf_counter()

            def compute(task: Any, each: Any) -> Any:
                return client.gather(client.map(task, list(each), pure=False))

            spread = PartitionedProblem(
                problem.robot, problem.parameters, problem.sample().data, problem.parts, compute
            )
            result = ro.calibrate(spread, ro.tikhonov, ro.reml)
            seconds = time.perf_counter() - start
            peak: Any = client.run(lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    return {
        "seconds": seconds,
        "passes": len(result.history) + 1,
        "converged": result.converged,
        "peak_mb": max(peak.values()),
        "worst": float(np.abs((result.x - truth) / problem.parameters.free.scale).max()),
    }


def report(rows: list[dict[str, Any]]) -> Report:
    """Return times and ratios, time and memory over the number of rows, and floors."""
    small = next(row for row in rows if row["part"] == "small")
    boot = next(row for row in rows if row["part"] == "bootstrap")
    counted = [row for row in rows if row["part"] == "rows"]
    ours = small["L-curve"]
    lines = [
        ["rpim_opt, L-curve over 200 weights, to convergence", f"{1e3 * ours:.2f}", "1"],
        ["rpim_opt, REML", f"{1e3 * small['REML']:.2f}", f"{small['REML'] / ours:.2g}"],
        [
            "SciPy least_squares(lm), vectorised, no weight",
            f"{1e3 * small['SciPy']:.2f}",
            f"{small['SciPy'] / ours:.2g}",
        ],
    ]
    metrics = {"over SciPy": ours / small["SciPy"]}
    for row in rows:
        if row["part"] == "peer":
            for key, seconds in row.items():
                if key.endswith(": seconds"):
                    name = f"{row['tool']}, {key.removesuffix(': seconds')}"
                    metrics[f"{name} over ours"] = seconds / ours
                    lines.append([name, f"{1e3 * seconds:.0f}", f"{seconds / ours:.3g}"])
    other = [
        ["bounded path over 200 weights", f"{1e3 * small['bounded path']:.1f} ms"],
        ["bounded calibration", f"{1e3 * small['bounded']:.2f} ms"],
        ["robust calibration with REML", f"{1e3 * small['robust']:.0f} ms"],
        [f"{boot['count']:,} bootstrap replicates of the bounded calibration, one process", f"{boot['seconds']:.2f} s"],
        [f"{boot['count']:,} bootstrap replicates, two processes", f"{boot['two']:.2f} s"],
    ]
    metrics["bounded path [ms]"] = 1e3 * small["bounded path"]
    metrics["bootstrap of 1000 [s]"] = boot["seconds"] / boot["count"] * 1000
    table = []
    for row in [*counted, *(r for r in rows if r["part"] == "cluster")]:
        each = 1e6 * row["seconds"] / row["count"] / row["passes"]
        where = " (Dask, two workers)" if row["part"] == "cluster" else ""
        table.append([f"{row['count']:,}{where}", f"{row['seconds']:.2f}", str(row["passes"]), f"{each:.2f}"])
        table[-1].append(f"{row['peak_mb']:.0f}")
    last = counted[-1]
    each = 1e6 * last["seconds"] / last["count"] / last["passes"]
    metrics["pass over copy and QR"] = each / last["floor_together_us"]
    parted = [row["peak_mb"] for row in counted if row["count"] >= 2 * PART]
    metrics["peak memory, largest over smallest"] = parted[-1] / parted[0]
    work = last["count"] * last["passes"] / 1e6
    text = TEXT.format(
        times=markdown(["52 configurations, 35 parameters", "ms", "over ours"], lines),
        other=markdown(["also", "time"], other),
        rows=markdown(["configurations", "seconds", "passes", "us each and pass", "peak memory [MB]"], table),
        held=100 * small["held"],
        program=1e3 * small["program once"],
        clarabel=_ms_or_none(small.get("Clarabel once")),  # none where it is not asked
        lapack=last["floor_us"],
        worked=last["worked"] / work,
        worked_over=last["worked"] / work / last["floor_worked_us"],
        qr=last["qr_us"],
        copy=last["copy_us"],
        cores=cores(),
        floor=last["floor_together_us"],
        over=metrics["pass over copy and QR"],
        waiting=_waiting(rows, metrics),
        models=_models(rows, metrics),
        **_cells(rows, metrics),
    )
    grid = [row for row in rows if row["part"] == "cell"]
    return Report(text, metrics, {"rows": _figure(counted), "grid": GRID.figure(grid)})


def _ms_or_none(seconds: float | None) -> str:
    if seconds is None:
        return "nothing: it is not asked"
    return f"{1e3 * seconds:.2f}"


def _waiting(rows: list[dict[str, Any]], metrics: dict[str, float]) -> str:
    """Return what a user waits for besides: processes, influence, reports; each with what it is compared with."""
    process = next(row for row in rows if row["part"] == "process")["processes"]
    floor = np.array(process["import scipy.optimize"])
    over = {name: float(np.median(seconds / floor)) for name, seconds in process.items()}
    metrics["calibrate paper_arm over importing SciPy's optimizers"] = over["rpim-opt calibrate paper_arm"]
    lines = [[name, f"{min(seconds):.3f}", f"{over[name]:.2g} times importing scipy.optimize"]
             for name, seconds in process.items()]  # fmt: skip
    for row in rows:
        if row["part"] == "influence":
            ratio = row["seconds"] / row["calibration"]
            metrics["influence over calibration"] = ratio
            lines.append([f"influence of {row['count']:,} rows", f"{row['seconds']:.3f}", f"{ratio:.2g} calibrations"])
        if row["part"] == "report":
            said = f"{row['mb']:.1f} MB; the calibration {row['calibration']:.2f} s"
            lines.append([f"report, {row['tool']}, {row['count']:,} rows", f"{row['seconds']:.2f}", said])
            if (row["tool"], row["count"]) == ("robust", 400):
                over_imports = row["seconds"] / float(np.median(floor))
                metrics["report of a robust result over importing SciPy's optimizers"] = over_imports
    return markdown(["waiting for", "seconds", "beside it"], lines) + _against(rows)


def _against(rows: list[dict[str, Any]]) -> str:
    """Return a table of paths by us and by others on the same A and b; nothing in the quick version."""
    lines = []
    for row in rows:
        if row["part"] == "solvers":
            for key, each in sorted(row["solvers"].items()):
                ours = row["solvers"][f"{key.partition(', ')[0]}, rpim_opt"]["seconds"]
                cells = [f"{1e3 * each['seconds']:.1f}", f"{each['seconds'] / ours:.2g}", f"{each['excess']:.0e}"]
                lines.append([f"{key}, {row['count']:,} configurations", *cells])
    if not lines:
        return ""
    head = ["path", "ms", "over ours", "largest excess of an objective over the least found"]
    return "\n\n" + markdown(head, lines) + "\n\n" + ALIKE


def _models(rows: list[dict[str, Any]], metrics: dict[str, float]) -> str:
    """Return how the cost of a pass grows with the parameters, beside LAPACK's QR of the same rows."""
    lines = []
    for row in rows:
        if row["part"] == "model":
            each = row["seconds"] / row["passes"]
            metrics["pass of many parameters over its QR"] = each / row["qr"]
            lines.append([str(row["parameters"]), f"{row['rows']:,}", f"{row['seconds']:.2f}", f"{1e3 * each:.0f}",
                          f"{1e3 * row['qr']:.0f}", f"{each / row['qr']:.2g}"])  # fmt: skip
    head = ["parameters", "rows", "seconds", "ms a pass", "LAPACK's QR [ms]", "over QR"]
    return markdown(head, lines) + "\n\nAn arm with many reflectors, 20 rows each, Tikhonov at one weight."


def _cells(rows: list[dict[str, Any]], metrics: dict[str, float]) -> dict[str, str]:
    """Return the grid of formulations and rules by numbers of configurations, and a sentence on what is slow."""
    grid = [row for row in rows if row["part"] == "cell" and "seconds" in row]
    metrics["slowest cell at 40 [s]"] = max(row["seconds"] for row in grid if row["count"] == 40)
    tables = []
    for count in sorted({row["count"] for row in grid}):
        here = [row for row in grid if row["count"] == count]
        rules = list(dict.fromkeys(row["method"] for row in here))
        lines = []
        for name in dict.fromkeys(row["tool"] for row in here):
            of = {row["method"]: row for row in here if row["tool"] == name}
            lines.append([name, *(_of_cell(of.get(rule)) for rule in rules)])
        tables.append(markdown([f"{count:,} configurations [s] (times Tikhonov)", *rules], lines))
    ended = [row for row in grid if row["ended"] != "converged"]
    slow = [f"{row['tool']} with {row['method']} at {row['count']:,}: {row['ended']}" for row in ended]
    far = "Every cell converged."
    if slow:
        far = "Not converged: " + "; ".join(slow) + "."
    return {"cells": "\n\n".join(tables), "far": far}


def _of_cell(row: dict[str, Any] | None) -> str:
    if row is None:
        return ""
    return f"{row['seconds']:.3f} ({row['seconds'] / row['tikhonov']:.2g})"


ALIKE = """\
The same A and b, their columns scaled to one length, as coordinate descent asks for: without that it does not end."""
TEXT = """\
{times}

Medians in one warm process; of the peers one run, without imports, in a process of its own.

{other}

On {held:.0f} % of the path some bound holds.

{rows}

Positions, 33 parameters, read from Parquet in tables of 50,000 rows at every pass, Tikhonov with REML to convergence.

Floors, in one thread each: to copy the same rows and to reduce them by LAPACK's usual QR (geqrf) takes {lapack:.2f} us
a configuration; by its recursive one (geqrt), which is used, {qr:.2f}; a copy of the whitened rows takes {copy:.2f}
us. Copy and usual QR on {cores} cores at once take {floor:.2f} us a configuration by the
clock, the pass {over:.2g} times that. In processor time, which other work on the machine disturbs less, a pass takes
{worked:.2f} us of all cores together, {worked_over:.2g} times the floor.
One lasso takes {program:.2f} ms, of which Clarabel itself {clarabel}.

{waiting}

{models}

{cells}

{far}
"""


def _figure(counted: list[dict[str, Any]]) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    N = np.array([row["count"] for row in counted])
    seconds = np.array([row["seconds"] / row["passes"] for row in counted])
    left.loglog(N, seconds, "o-", color="C3", ms=4, label="one pass")
    left.loglog(N, seconds[-1] * N / N[-1], color="0.5", ls="--", lw=1, label="linear")
    left.set_ylabel("seconds a pass")
    left.legend(frameon=False)
    right.semilogx(N, [row["peak_mb"] for row in counted], "o-", color="C0", ms=4)
    right.set_ylim(bottom=0)
    right.set_ylabel("peak resident memory [MB]")
    for ax in (left, right):
        ax.set_xlabel("configurations")
        ax.grid(alpha=0.3)
    return figure


if __name__ == "__main__":
    print(json.dumps({"rows": _rows, "cluster": _cluster}[sys.argv[1]](int(sys.argv[2]))))
