"""Robots that a camera alone has calibrated, and how sure the results are, rightly or not.

Simulated: a six-axis arm, deviations drawn with the scales, 25 views of a board of 20 points with 0.1 px of noise; the
camera on the flange or beside the robot, its intrinsics known or found along. Judged by positions of the tool elsewhere
in sight, and by every parameter. The last case is a robot twenty times better than its drawing's tolerances, seen by a
camera that shakes by 1 mm and 2 mrad from view to view: what a fit of such views makes of it, by least squares and with
sizes learned, and what the result says of that.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

import rpim_opt as ro
from rpim_opt.basics.arrays import Array
from rpim_opt.basics.text import markdown
from rpim_opt.calibration import Improvement, improvement
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.study import Metric, Report

QUESTION = "Do the intervals hold for a robot that was calibrated by a camera alone?"
SIGMA = 0.1
VIEWS, ELSEWHERE = 25, 20
BOARD = ro.data.grid_board(5, 4, 0.04)
CAMERA = {"camera_fx": 900.0, "camera_fy": 900.0, "camera_cx": 640.0, "camera_cy": 480.0}
LENS = {"camera_k1": 0.05, "camera_k2": 0.03, "camera_p1": 3e-4, "camera_p2": 3e-4, "camera_k3": 0.01}
PLACES = {
    "on the flange": ("eye_in_hand", (-0.45, 0.06, 0.0, np.pi, 0, 0), (0.06, 0, 0.04, 0, 0, 0)),
    "beside the robot": ("eye_to_hand", (0.1, 0.2, 1.1, -2.0, 0.1, 0.2), (-0.08, -0.06, 0.05, 0, 0, 0)),
}
KNOWN = ("known", "unknown")
SCALES = {
    "length_mm": 0.5, "angle_mrad": 1.0, "base_mm": 5.0, "base_mrad": 10.0, "tool_mm": 3.0, "tool_mrad": 10.0,
    "camera_fx_px": 10.0, "camera_fy_px": 10.0, "camera_cx_px": 10.0, "camera_cy_px": 10.0,
    **LENS,
}  # fmt: skip
GOOD, SHAKE = 0.05, (1e-3, 2e-3)
HELD = ("positions", "directions", "parameters")
METHODS = ("least squares", "learned")
METRICS = {"worst_coverage_off": Metric("lower", 0.4), "verdicts_right": Metric("higher", 0.02)}


def cases(quick: bool) -> list[dict[str, Any]]:
    """Return every setting with every seed, and the robots that views do not improve."""
    seeds = 4 if quick else 125
    shaken = 2 if quick else 25
    found = [{"place": p, "intrinsics": k, "seed": s} for p in PLACES for k in KNOWN for s in range(seeds)]
    return found + [{"place": "shaking", "intrinsics": "known", "seed": s} for s in range(shaken)]


def run(place: str, intrinsics: str, seed: int) -> dict[str, Any]:
    """Return errors elsewhere, how often the intervals hold, and what the result says of itself."""
    rng = np.random.default_rng([seed, 19])
    if place == "shaking":
        return _shaken(rng)
    problem, truth = _world(place, intrinsics == "known", rng)
    data, clean = _views(problem, truth, rng)
    # a start that knows nothing of the frames
    start = ro.problem.starting_parameters(problem.robot, data, None, {"": (0.0,) * 6}, _camera(problem))
    located = problem.on(data).with_parameters(replace(problem.parameters, nominal=_stated(problem, start.nominal)))
    result = ro.calibrate(located)
    half = ro.calibration.Uncertainty(result).coverage_factor
    sd = np.sqrt(np.diag(result.covariance))
    values = result.problem.parameters.free.values(result.x)
    off = _apart(problem, values, problem.parameters.free.values(truth))
    where, known = _positions(result, clean.q)
    there = _there(problem, clean.q).modelled(truth)[0]
    return {
        "converged": bool(result.converged),
        "nominal": 1e3 * _rms(_there(problem, clean.q).modelled(_frames(problem, truth))[0] - there),
        "camera": 1e3 * _rms(where - there),
        "reprojection": _rms(result.errors(clean, "pixel")),
        "parameters held": float(np.mean(np.abs(off) <= half * sd)),
        "directions held": _directions(result, off, half),
        "positions held": float(np.mean(np.abs(where - there) <= half * known)),
        **_verdict("learned", improvement(result), problem, result.x, truth),
    }


def _world(place: str, known: bool, rng: np.random.Generator, size: float = 1.0) -> tuple[CalibrationProblem, Array]:
    """Return an arm with its camera, identifying what ``auto`` does, and its true deviations [SI]."""
    kind, base, tool = PLACES[place]
    robot = _robot()
    data = ro.data.views(np.zeros((1, 6)), BOARD, np.zeros((1, len(BOARD), 2)), SIGMA, kind)
    parameters = ro.problem.starting_parameters(robot, data, base, {"": tool}, CAMERA)
    intrinsics = [] if known else ["camera_*"]
    parameters = parameters.identify(["alpha?", "a?", "theta?", "d?", "beta[23]", "base_*", "tool_*", *intrinsics])
    stated = {key: value for key, value in SCALES.items() if not known or not key.startswith("camera")}
    parameters = parameters.scaled(stated)
    if known:  # a lens that is known has distortion, too
        nominal = parameters.nominal.copy()
        for name, value in LENS.items():
            nominal[parameters.names.index(name)] = value * rng.normal()
        parameters = replace(parameters, nominal=nominal)
    free = parameters.free
    truth = rng.normal(size=len(free)) * free.scale
    truth[~_of_frames(parameters)] *= size
    return ro.CalibrationProblem(robot, parameters, data), truth


@cache
def _robot() -> ro.robot.Robot:
    return ro.load("camera").problem.robot


def _of_frames(parameters: Any) -> np.ndarray:
    return np.asarray(parameters.of_frames[parameters.identified])


def _camera(problem: CalibrationProblem) -> dict[str, float]:
    """Return what is stated of the camera: its data sheet, or all of it where it is known."""
    p = problem.parameters
    return {name: float(v) for name, v in zip(p.names, p.nominal, strict=True) if name.startswith("camera_")}


def _stated(problem: CalibrationProblem, found: Array) -> Array:
    """Return nominal values with the frames that were found; all else as stated."""
    frames = [name.startswith(("base_", "tool_")) for name in problem.parameters.names]
    return np.where(frames, found, problem.parameters.nominal)


def _apart(problem: CalibrationProblem, values: Array, truth: Array) -> Array:
    """Return by how much values (n,) are off; turns of frames about the parent's axes."""
    off = values - truth
    names = problem.parameters.free.names
    for prefix in ("base_", "tool_"):
        turn = [names.index(f"{prefix}r{axis}") for axis in "xyz"]
        one, other = (_rotation(v[turn]) for v in (values, truth))
        R = one @ other.T
        off[turn] = [(R[2, 1] - R[1, 2]) / 2, (R[0, 2] - R[2, 0]) / 2, (R[1, 0] - R[0, 1]) / 2]
    return off


def _rotation(angles: Array) -> Array:
    from rpim_opt.robot.kinematics import numeric_frame

    return np.asarray(numeric_frame([0, 0, 0, *angles])[:3, :3])


def _views(
    problem: CalibrationProblem, truth: Array, rng: np.random.Generator, shake: tuple[float, float] = (0.0, 0.0)
) -> tuple[Dataset, Dataset]:
    """Return what the camera sees with noise, and views elsewhere without."""
    points = np.array(list(BOARD.values()))
    q = ro.problem.visible_configurations(problem, points, VIEWS + ELSEWHERE, rng, truth, share=0.6)
    kind = problem.data.blocks[0].measurement.name
    empty = np.zeros((len(q), len(BOARD), 2))
    uv = problem.on(ro.data.views(q, BOARD, empty, SIGMA, kind)).modelled(truth)[0].reshape(empty.shape)
    seen = uv[:VIEWS].copy()
    if any(shake):
        seen = np.array([_moved(problem, truth, each, kind, shake, rng) for each in q[:VIEWS]])
    seen += SIGMA * rng.normal(size=seen.shape)
    return ro.data.views(q[:VIEWS], BOARD, seen, SIGMA, kind), ro.data.views(q[VIEWS:], BOARD, uv[VIEWS:], SIGMA, kind)


def _moved(
    problem: CalibrationProblem, truth: Array, q: Array, kind: str, shake: tuple[float, float], rng: np.random.Generator
) -> Array:
    """Return what a camera sees (P, 2) that is not where it should be."""
    names = list(problem.parameters.free.names)
    x = truth.copy()
    for size, axes in zip(shake, (("x", "y", "z"), ("rx", "ry", "rz")), strict=True):
        x[[names.index(f"tool_{axis}") for axis in axes]] += size * rng.normal(size=3)
    view = ro.data.views(q[None], BOARD, np.zeros((1, len(BOARD), 2)), SIGMA, kind)
    return np.asarray(problem.on(view).modelled(x)[0])


def _there(problem: CalibrationProblem, q: Array) -> CalibrationProblem:
    """Return the problem that measures the positions of camera or board."""
    return problem.on(Dataset.of(q, np.zeros((len(q), 3)), 1.0))


def _positions(result: Any, q: Array) -> tuple[Array, Array]:
    there = _there(result.problem, q)
    J = there.jacobian(result.x).reshape(len(q), 3, -1)
    sd = np.sqrt(np.einsum("nij,jk,nik->ni", J, result.covariance, J))
    return there.modelled(result.x)[0], sd


def _frames(problem: CalibrationProblem, truth: Array) -> Array:
    """Return the drawing's robot with the true frames."""
    return np.asarray(truth * _of_frames(problem.parameters))


def _directions(result: Any, off: Array, half: float) -> float:
    """Return how many of the directions that views see better than the scales lie within their intervals."""
    scale = result.problem.parameters.free.scale
    s, Vt = result.program.model.svd[1:]
    seen = Vt[s > 1]
    sd = np.sqrt(np.einsum("ij,jk,ik->i", seen, result.covariance / np.outer(scale, scale), seen))
    return float(np.mean(np.abs(seen @ (off / scale)) <= half * sd))


def _rms(e: Array) -> float:
    """Return the root of the mean square of errors (N,), or of the lengths of vectors (N, 3)."""
    return float(np.sqrt(np.sum(e**2) / len(e)))


def _verdict(
    method: str, found: Improvement | None, problem: CalibrationProblem, x: Array, truth: Array
) -> dict[str, Any]:
    """Return what a result expects of positions over the joint ranges, and what they are."""
    if found is None:
        raise ValueError("no covariance")
    before, after = _shape(problem, truth), _shape(problem, truth, x)
    return {
        f"{method}: as drawn": 1e3 * before,
        f"{method}: as identified": 1e3 * after,
        f"{method}: expected": 1e3 * found.after,
        f"{method}: improves": found.improves,
        f"{method}: did improve": after < 0.9 * before,
    }


def _shape(problem: CalibrationProblem, truth: Array, x: Array | None = None) -> float:
    """Return the RMS position error of the flange over the joint ranges, base and tool placed as fits best [m]."""
    q = ro.problem.random_candidates(problem.robot, 200, 0)
    own = ~_of_frames(problem.parameters)
    flange = problem.parameters.nominal.copy()
    flange[[name.startswith(("base_", "tool_")) for name in problem.parameters.names]] = 0.0
    bare = problem.with_parameters(replace(problem.parameters, nominal=flange))
    there = _there(bare, q)
    true = there.modelled(truth * own)[0]
    ours = there.modelled((np.zeros(len(truth)) if x is None else x) * own)[0]
    R = ro.robot.forward_kinematics(problem.robot, q)[:, :3, :3]
    p = true - true.mean(axis=0)
    turning = np.stack([np.cross(axis, p) for axis in np.eye(3)], axis=2)
    A = np.concatenate([np.tile(np.eye(3), (len(q), 1, 1)), turning, R], axis=2).reshape(-1, 9)
    e = (ours - true).ravel()
    left = e - A @ np.linalg.lstsq(A, e, rcond=None)[0]
    return float(np.sqrt(left @ left / len(q)))


def _shaken(rng: np.random.Generator) -> dict[str, Any]:
    """Return what a shaking camera makes of a good robot."""
    problem, truth = _world("on the flange", True, rng, GOOD)
    data, clean = _views(problem, truth, rng, SHAKE)
    stated = problem.on(data)
    found: dict[str, Any] = {"converged": True}
    for method in METHODS:
        weight = 1e-3 if method == "least squares" else None
        result = ro.calibrate(stated, ro.tikhonov, weight)
        found["converged"] = bool(found["converged"] and result.converged)
        found[f"{method}: reprojection"] = _rms(result.errors(clean, "pixel"))
        found |= _verdict(method, improvement(result), problem, result.x, truth)
    return found


def report(rows: list[dict[str, Any]]) -> Report:
    """Return errors and coverage by setting, what is said where views do not help, and a figure of both."""
    seen = [row for row in rows if row["place"] != "shaking"]
    lines = []
    off = []
    for place in PLACES:
        for known in KNOWN:
            part = [row for row in seen if row["place"] == place and row["intrinsics"] == known]
            held = [100 * float(np.mean([row[f"{what} held"] for row in part])) for what in HELD]
            off += [abs(share - 95) / 100 for share in held[:2]]
            means = [float(np.mean([row[key] for row in part])) for key in ("nominal", "camera", "reprojection")]
            lines.append([place, known, str(len(part)), *(f"{v:.3f}" for v in means), *(f"{v:.1f}" for v in held)])
    head = ["camera", "intrinsics", "runs", "nominal [mm]", "calibrated [mm]", "reprojection [px]",
            *(f"{what} held [%]" for what in HELD)]  # fmt: skip
    text = (
        "Errors are those of the tool's position at 20 views elsewhere (RMS, mean over the runs; nominal: the "
        "drawing's robot at the true frames). Held, in 95 % intervals: the coordinates of these positions; directions "
        "of the parameters that the views see better than the scales; every parameter by itself, where those that no "
        "view tells apart (d6 from the tool) rest on the learned size of deviations alone.\n\n"
    )
    text += markdown(head, lines) + "\n\n" + _shaking_text(rows)
    metrics = {"worst_coverage_off": max(off), "verdicts_right": _right(rows)}
    return Report(text, metrics, {"camera": _figure(rows)})


def _verdicts(rows: list[dict[str, Any]]) -> list[tuple[bool, bool]]:
    """Return for every result whether it says that views improve the robot, and whether they did."""
    keys = [(row, method) for row in rows for method in METHODS if f"{method}: improves" in row]
    pairs = [(row[f"{m}: improves"], row[f"{m}: did improve"]) for row, m in keys]
    return [(bool(said), bool(did)) for said, did in pairs if said is not None and said == said]


def _right(rows: list[dict[str, Any]]) -> float:
    return float(np.mean([said == did for said, did in _verdicts(rows)]))


def _shaking_text(rows: list[dict[str, Any]]) -> str:
    shaken = [row for row in rows if row["place"] == "shaking"]
    lines = []
    for method in METHODS:
        keys = ("reprojection", "as drawn", "as identified", "expected")
        means = [float(np.mean([row[f"{method}: {key}"] for row in shaken])) for key in keys]
        said = sum(not row[f"{method}: improves"] for row in shaken)
        lines.append([method, *(f"{v:.2f}" for v in means), f"{said} of {len(shaken)}"])
    head = ["fit", "reprojection elsewhere [px]", "flange as drawn [mm]", "as identified [mm]", "expected [mm]",
            '"do not improve" said']  # fmt: skip
    said = _verdicts([row for row in rows if row["place"] != "shaking"])
    wrong = sum(not improves for improves, did in said if did)
    return (
        "A good robot seen by a camera that shakes (position error of the flange over the joint ranges, base and tool "
        "placed as fits best; RMS, mean over the runs; least squares: weight 0.001):\n\n"
        f"{markdown(head, lines)}\n\nIn the {len(said)} runs of the first table views did improve the robot "
        f"{sum(did for _, did in said)} times; {wrong} of these results said that they do not."
    )


def _figure(rows: list[dict[str, Any]]) -> Any:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 3.6), layout="constrained")
    ax = figure.add_subplot()
    for marker, color, label, part, method in (
        ("o", "C0", "camera still", [row for row in rows if row["place"] != "shaking"], "learned"),
        ("s", "C1", "shaking, learned", [row for row in rows if row["place"] == "shaking"], "learned"),
        ("^", "C3", "shaking, least squares", [row for row in rows if row["place"] == "shaking"], "least squares"),
    ):
        x, y = (np.array([row[f"{method}: {key}"] for row in part]) for key in ("expected", "as identified"))
        ax.plot(x, y, marker, ms=3, alpha=0.6, color=color, label=label)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ends = ax.get_xlim()
    ax.plot(ends, ends, color="0.6", lw=0.8)
    ax.set_xlabel("position error that the result expects [mm]")
    ax.set_ylabel("position error [mm]")
    ax.legend(frameon=False)
    return figure
