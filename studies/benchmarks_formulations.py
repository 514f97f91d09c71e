"""Measure formulations that a user may write: losses x penalties x constraints x storage, beside plain CVXPY.

The arm of `benchmarks` with 33 parameters, a twentieth of the rows off by millimetres. Each cell: a whole calibration
at one weight over Tikhonov's on the same rows in the same run; in memory also one convex program (up to 1,000), and at
40 configurations a path of 30 weights, beside plain CVXPY with Clarabel (its path canonicalizes once, DPP). These are
linearized at nominal, where the data identify 25 directions and 8 not at all: after some steps axes are parallel
but for microradians, singular values of 1e-9 of the largest appear, and no two solvers agree on what they hold. All
times are processor time, the least of two runs.
"""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cvxpy as cp
import numpy as np
from cvxpy.error import SolverError

import rpim_opt as ro
from rpim_opt.basics.text import markdown, three_digits
from rpim_opt.study import Metric, Report
from rpim_opt.study.studies import load_study

QUESTION = "What does a formulation of one's own cost, beside Tikhonov's and beside plain CVXPY?"
GRID = load_study(Path(__file__).resolve().parent / "benchmark_parts" / "grid.py", ("arm", "limited"))
SMOOTH, SHARP = ("squares", "huber", "huber of norms", "logistic"), ("sum of norms", "L1", "quantile", "minimax")
LIMITS = {40: (5.0, 5.0), 1_000: (3.0, 5.0), 20_000: (2.0, 4.0)}
"""Goals for a calibration over Tikhonov's, by configurations: smooth losses, and losses with kinks."""
PATHS = {"squares": 60, "huber": 250, "huber of norms": 250, "logistic": 250}
"""Goals for a path [ms] with any penalty and constraint, cones included; 200 for other losses."""
WEIGHTS = np.geomspace(1e-2, 1e4, 30)
EQUAL = 1e-7  # relative excess of an objective up to which two solvers agree
ACCURATE = 1e-10  # tolerance of plain CVXPY where its objective is below ours
PATIENCE = 120  # seconds that a calibration, a program or a path gets
METRICS = {
    "smooth losses at 40 over Tikhonov, median": Metric("lower", 1.0),
    "kinks at 40 over Tikhonov, median": Metric("lower", 1.0),
    "programs over plain CVXPY, median": Metric("lower", 0.5),
    "paths at 40 over plain CVXPY, median": Metric("lower", 0.5),
    "calibrations that did not converge": Metric("lower", 0.0),
    "objectives above plain CVXPY's": Metric("lower", 0.0),
}


def _cvar(r: Any) -> Any:  # the mean of the largest tenth of |r| (Rockafellar and Uryasev 2000)
    threshold = cp.Variable()
    return threshold + cp.sum(cp.pos(cp.abs(r) - threshold)) / (0.1 * r.size)


def _symmetric(z: Any, _: Any) -> Any:  # bounds the largest eigenvalue
    rows = [cp.hstack([z[0], z[1], z[2]]), cp.hstack([z[1], z[3], z[4]]), cp.hstack([z[2], z[4], z[5]])]
    return cp.vstack(rows) << 0.3 * np.eye(3)


def _slacks(z: Any, _: Any) -> list[Any]:  # bounds that may be exceeded, by so much in all
    s = cp.Variable(z.size, nonneg=True)
    return [z <= 0.2 + s, cp.sum(s) <= 1]


LOSSES: dict[str, dict[str, Any]] = {
    "squares": {},
    "huber": {"loss": ro.huber(1.5)},
    "huber of norms": {"loss": ro.huber(2.0), "loss_over": "configuration"},
    "sum of norms": {"loss": cp.sum, "loss_over": "configuration"},
    "L1": {"loss": cp.norm1},
    "quantile": {"loss": lambda r: cp.sum(cp.maximum(0.9 * r, -0.1 * r))},
    "logistic": {"loss": lambda r: cp.sum(cp.logistic(r) + cp.logistic(-r))},
    "minimax": {"loss": cp.max, "loss_over": "configuration"},
    "CVaR": {"loss": _cvar},
}
PENALTIES: dict[str, Any] = {
    "squares": cp.sum_squares,
    "norm1": cp.norm1,
    "groups": lambda z: cp.sum(cp.hstack([cp.norm(z[k : k + 3]) for k in range(0, z.size - 2, 3)])),
    "elastic net": lambda z: cp.sum_squares(z) + cp.norm1(z),
    "none": None,
}
CONSTRAINTS: dict[str, tuple[Any, ...]] = {
    "none": (),
    "tolerance": (ro.within_tolerance,),
    "inequality": (lambda z, _: cp.sum(z[:4]) <= -0.2,),
    "ball": (ro.in_ball(1.5, "*"),),
    "matrix": (_symmetric,),
    "slacks": (_slacks,),
}
STORAGE = ("memory", "two blocks")


def cases(quick: bool) -> list[dict[str, Any]]:
    """Return all cells at 40 configurations, every pair of kinds at 1,000, and half of these cells at 20,000."""
    penalties = list(PENALTIES)
    cells = []
    for i, loss in enumerate(LOSSES):
        for j, constraint in enumerate(CONSTRAINTS):
            pair = {"loss": loss, "penalty": penalties[(i + j) % 5], "constraint": constraint}
            pair["storage"] = STORAGE[(i // 2 + j) % 2]
            if quick:
                if (i + 2 * j) % 6 == 0:
                    cells.append({**pair, "storage": "memory", "count": 40})
                continue
            cells.append({**pair, "count": 1_000})
            if (i + j) % 2 == 0:
                cells.append({**pair, "count": 20_000})
            cells += [{**pair, "penalty": p, "storage": s, "count": 40} for p in penalties for s in STORAGE]
    return sorted(cells, key=lambda cell: cell["count"])


def run(loss: str, penalty: str, constraint: str, storage: str, count: int) -> dict[str, Any]:
    """Return seconds of a calibration, of Tikhonov's, and in memory of one program and of a path, ours and plain."""
    warnings.simplefilter("ignore")  # CVXPY's, of inaccurate solutions: they are counted
    mine = ro.Formulation("mine", penalty=PENALTIES[penalty], constraints=CONSTRAINTS[constraint], **LOSSES[loss])
    weight = 0.0 if mine.penalty is None else 1.0
    problem = GRID.arm(count)
    calibrated = problem
    if storage != "memory":
        blocks = [partial(problem.data.take, rows) for rows in np.array_split(np.arange(count), 2)]
        calibrated = ro.problem.PartitionedProblem(problem.robot, problem.parameters, problem.data, blocks)
    runs = 2 if count <= 1_000 else 1
    found: dict[str, Any] = {}
    found["tikhonov"], _ = least(lambda: ro.calibrate(calibrated, ro.tikhonov, 1.0), runs)
    found["seconds"], result = least(lambda: ro.calibrate(calibrated, mine, weight), runs)
    if isinstance(result, Exception):
        return {**found, "ended": f"{type(result).__name__}: {result}"}
    found["ended"] = "converged" if result.converged else "not converged"
    if storage != "memory" or count > 1_000:  # plain CVXPY takes minutes of 20,000
        return found
    model = problem.linearize(np.zeros(len(problem.parameters.free)))
    found["program"], own = least(lambda: ro.convex.pose(mine, model).solve(weight), runs)
    found["plain program"], other = least(lambda: plain(mine, model, [weight]), runs)
    if not isinstance(own, Exception) and not isinstance(other, Exception):
        found["excess"] = (own.objective - other[0]) / max(abs(other[0]), 1.0)
        if found["excess"] > EQUAL:  # at its usual tolerances a point may gain by what it violates constraints by
            value = plain(mine, model, [weight], ACCURATE)[0]
            found["excess"] = (own.objective - value) / max(abs(value), 1.0)
    if count == 40 and mine.penalty is not None:
        path, _ = least(lambda: ro.convex.pose(mine, model).path(WEIGHTS), 1)
        plain_path, ended = least(lambda: plain(mine, model, WEIGHTS), 1)
        if not isinstance(ended, Exception):  # a solver that gives up at some weight has taken no time for the others
            found |= {"path": path, "plain path": plain_path}
    return found


def least(work: Callable[[], Any], runs: int) -> tuple[float, Any]:
    """Return the least processor time of some runs [s], and what the work returned or how it failed."""
    seconds: list[float] = []
    done: Any = None
    for _ in range(runs):
        begun = time.process_time()
        try:
            with GRID.limited(PATIENCE):
                done = work()
        except (ro.basics.RpimError, SolverError, TimeoutError) as error:
            return time.process_time() - begun, error
        seconds.append(time.process_time() - begun)
    return min(seconds), done


def plain(mine: ro.Formulation, model: Any, weights: Any, tolerance: float | None = None) -> list[float]:
    """Return the least objectives at some weights by CVXPY and Clarabel, canonicalized once.

    A tolerance is that of the gap and of the constraints; Clarabel's is 1e-8, relative to the largest number.
    """
    z = cp.Variable(model.A.shape[1])
    r = model.A @ z - model.b
    if mine.loss_over == "configuration":
        r = cp.norm(cp.reshape(r, (-1, 3), order="C"), axis=1)
    weight = cp.Parameter(nonneg=True)
    objective = mine.loss(r)
    if mine.penalty is not None:
        objective += weight * mine.penalty(z)
    constraints: list[Any] = []
    for constraint in mine.constraints:
        given: Any = constraint(z, model.parameters)
        constraints += given if isinstance(given, list) else [given]
    program = cp.Problem(cp.Minimize(objective), constraints)
    settings: dict[str, float] = {}
    if tolerance is not None:
        settings = dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), tolerance)
    values = []
    for each in weights:
        weight.value = each
        value: Any = program.solve(solver=cp.CLARABEL, **settings)
        values.append(float(value))
    return values


# --- what is reported ------------------------------------------------------------------------------------------------


def report(rows: list[dict[str, Any]]) -> Report:
    """Return tables by loss and constraint (the largest of the penalties), goals that are missed, and metrics."""
    for row in rows:
        row["over"] = row["seconds"] / row["tikhonov"]
        row["name"] = row["loss"] + ", no penalty" * (row["penalty"] == "none")
    refused = [row for row in rows if row["ended"].startswith("InputError")]
    solved = [row for row in rows if not row["ended"].startswith("InputError")]
    small = [row for row in solved if row["count"] == 40 and row["penalty"] != "none"]
    known = [row for row in solved if row.get("excess") is not None]
    ended = [row for row in solved if row["ended"] != "converged"]
    programs = [row["program"] / row["plain program"] for row in known]
    wrong = [row for row in known if row["excess"] > EQUAL]
    paths = [row for row in small if row.get("path") is not None]
    smooth, sharp = ([row["over"] for row in small if row["loss"] in kind] for kind in (SMOOTH, SHARP))
    along = np.array([row["path"] / row["plain path"] for row in paths])
    figures = (np.median(smooth), np.median(sharp), np.median(programs), np.median(along), len(ended), len(wrong))
    metrics = {name: float(figure) for name, figure in zip(METRICS, figures, strict=True)}
    slower = sum(ratio > 1 for ratio in programs)
    excess = max((row["excess"] for row in known if row not in wrong), default=0.0)
    parts = [TEXT.format(programs=len(programs), slower=slower, paths=len(paths), behind=int(np.sum(along > 1)),
                         median=np.median(programs), along=np.median(along), excess=excess)]  # fmt: skip
    for count in sorted({row["count"] for row in rows}):
        here = [row for row in solved if row["count"] == count]
        parts.append(_table(here, f"{count:,} configurations: over Tikhonov, memory / two blocks", _ratios))
    parts.append(_table(paths, "40 configurations: path of 30 weights [ms] (over plain CVXPY)", _path_cell))
    parts.append(f"Refused: {_counted(refused)}. Not converged: {_counted(ended)}.")
    parts.append(f"Objectives that exceed plain CVXPY's by more than {EQUAL:g}: {_listed(wrong, 'excess')}.")
    goals = [(row, LIMITS[row["count"]][row["loss"] in SHARP]) for row in solved if row["penalty"] != "none"]
    late = [row for row, limit in goals if row["over"] > limit and row["loss"] != "CVaR"]
    parts.append(f"Above the goal for calibrations, ratio ({len(late)} of {len(goals)}): {_listed(late, 'over')}.")
    slow = [row for row in paths if 1e3 * row["path"] > PATHS.get(row["loss"], 200)]
    parts.append(f"Above the goal for paths, seconds ({len(slow)} of {len(paths)}): {_listed(slow, 'path')}.")
    return Report("\n\n".join(parts), metrics)


def _table(rows: list[dict[str, Any]], head: str, cell: Callable[[list[dict[str, Any]]], str]) -> str:
    lines = []
    for loss in sorted({row["name"] for row in rows}, key=lambda name: ("no penalty" in name, name)):
        of = [[row for row in rows if (row["name"], row["constraint"]) == (loss, name)] for name in CONSTRAINTS]
        lines.append([loss, *(cell(each) for each in of)])
    return markdown([head, *CONSTRAINTS], lines)


def _ratios(rows: list[dict[str, Any]]) -> str:
    of = [max((row["over"] for row in rows if row["storage"] == storage), default=None) for storage in STORAGE]
    return " / ".join("-" if ratio is None else f"{ratio:.1f}" for ratio in of)


def _path_cell(rows: list[dict[str, Any]]) -> str:
    if not rows:
        return ""
    slowest = max(rows, key=lambda row: row["path"])
    over = max(row["path"] / row["plain path"] for row in rows)
    return f"{three_digits(1e3 * slowest['path'])} ({over:.2f})"


def _listed(rows: list[dict[str, Any]], key: str) -> str:
    said = []
    for row in sorted(rows, key=lambda row: -row[key])[:15]:
        name = f"{row['loss']} + {row['penalty']} in {row['constraint']}, {row['storage']}, {row['count']:,}"
        said.append(f"{name}: {three_digits(row[key])}")
    return "; ".join(said) + (" and others" if len(rows) > 15 else "") or "none"


def _counted(rows: list[dict[str, Any]]) -> str:
    of = Counter(f"{row['name']}, {row['storage']}, {row['count']:,}" for row in rows)
    return ", ".join(f"{name} ({count} cells)" for name, count in of.items()) or "none"


TEXT = """\
Of {programs} single programs {slower} take longer than plain CVXPY, {median:.2g} times its time in the median; of
{paths} paths {behind}, {along:.2g} times. Objectives agree with plain CVXPY's to {excess:.1e} but where it is said
below. Each cell of the tables is the largest of its penalties. At nominal 25 of the 33 directions are identifiable;
once axes are not quite parallel the others are, too, with singular values of 1e-9 of the largest: without a penalty
calibrations walk along them, 1e5 scales far, to a minimum that least squares do have there."""
