"""Base and tool from poses: the certified start and closed forms on a thousand random cases, hard ones among them."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import rpim_opt as ro
from rpim_opt.basics.text import markdown
from rpim_opt.study import Metric, Report, distributions

QUESTION = "Is the certified start of hand-eye calibration right where closed forms fail, and does it detect failure?"
METRICS = {
    "worse_than_a_closed_form": Metric("lower", 0.0),
    "certified_but_wrong": Metric("lower", 0.0),
    "right": Metric("higher", 0.02),
    "certified_of_right": Metric("higher", 0.02),
}
FIRST = 7000
"""Seed of the first case."""
SCENES = ("any turns", "few poses", "half turns", "small turns", "nearly one axis", "one axis")
"""How the flange turns; with half turns also base and tool are turned by 180 degrees within 0.01."""
RIGHT = float(chi2.ppf(1 - 1e-6, 12))
"""Squared distance from the truth in standard deviations up to which an answer is right within the noise."""
DETERMINED = 0.1
"""Standard deviation of the least certain rotation [rad], at the truth, up to which poses determine the answer."""
AS_WELL = float(chi2.ppf(1 - 1e-4, 12))
"""What another answer's cost may be above the best, for noise to leave open which of them is true."""
ELSEWHERE = 0.5
"""Angle [rad] from which another answer is not the same."""
STARTS = 40
"""Descents that look for another answer."""
CLOSED = ("Shah", "Li", "Park and Martin")


def cases(quick: bool) -> list[dict[str, Any]]:
    """Return the seeds."""
    return [{"seed": FIRST + i} for i in range(60 if quick else 1000)]


def run(seed: int) -> dict[str, float | str]:
    """Return costs, distances from the truth and verdicts of one case."""
    rng = np.random.default_rng(seed)
    scene = SCENES[rng.choice(6, p=[0.25, 0.25, 0.2, 0.15, 0.1, 0.05])]
    flange, base, tool = _scene(rng, scene)
    N = len(flange)
    sigma = 10 ** rng.uniform([-5, -4], [-2.3, -1.5])
    measured = base @ flange @ tool
    measured[:, :3, :3] = Rotation.from_rotvec(sigma[1] * rng.normal(size=(N, 3))).as_matrix() @ measured[:, :3, :3]
    measured[:, :3, 3] += sigma[0] * rng.normal(size=(N, 3))
    begin = time.process_time()
    start = ro.problem.certified_hand_eye(flange, measured, sigma=tuple(sigma))
    seconds = time.process_time() - begin
    information = _information(flange, measured, base, tool, sigma)
    own = start.base, start.tool
    found: dict[str, float | str] = {
        "scene": scene,
        "poses": N,
        "milliseconds": 1e3 * seconds,
        "cost": _cost(flange, measured, *own, sigma),
        "distance": _distance(information, base, tool, *own),
        "determined": _least_certain(information),
        "gap": start.gap,
        "rank_ratio": start.rank_ratio,
        "uncertainty": start.uncertainty,
        "radius": start.radius,
        "certified": float(start.certified),
        "reason": start.reason,
    }
    for name, (Z, X) in _closed_forms(flange, measured).items():
        found[f"{name}, cost"] = _cost(flange, measured, Z, X, sigma)
        found[f"{name}, distance"] = _distance(information, base, tool, Z, X)
    if _least_certain(information) <= DETERMINED and not start.certified:
        found["another"] = float(_another(rng, flange, measured, base, tool, sigma))
    return found


def _transform(rng: np.random.Generator, turn: float, size: float) -> np.ndarray:
    """Return a rotation by up to an angle about any axis, and a translation."""
    T = np.eye(4)
    axis = rng.normal(size=3)
    T[:3, :3] = Rotation.from_rotvec(rng.uniform(0.0, turn) * axis / np.linalg.norm(axis)).as_matrix()
    T[:3, 3] = size * rng.normal(size=3)
    return T


def _half_turn(rng: np.random.Generator, size: float) -> np.ndarray:
    T = _transform(rng, 0.01, size)
    axis = rng.normal(size=3)
    T[:3, :3] = Rotation.from_rotvec(np.pi * axis / np.linalg.norm(axis)).as_matrix() @ T[:3, :3]
    return T


def _scene(rng: np.random.Generator, scene: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return flange poses, base and tool."""
    few = scene == "few poses"
    N = int(rng.integers(3, 7)) if few else int(rng.integers(8, 61))
    base = _transform(rng, np.pi, 2.0)
    tool = _transform(rng, np.pi, 0.1)
    if scene == "half turns":
        base = _half_turn(rng, 2.0)
        tool = _half_turn(rng, 0.1)
        flange = [_half_turn(rng, 0.4) if rng.random() < 0.7 else _transform(rng, np.pi, 0.4) for _ in range(N)]
    elif scene == "small turns":
        middle = _transform(rng, np.pi, 0.4)
        flange = [middle @ _transform(rng, 0.2, 0.1) for _ in range(N)]
    elif scene in ("nearly one axis", "one axis"):
        middle = _transform(rng, np.pi, 0.4)
        off = 0.0 if scene == "one axis" else 0.05
        hand = _transform(rng, np.pi, 0.4)
        flange = []
        for _ in range(N):
            T = np.eye(4)
            T[:3, :3] = Rotation.from_rotvec([*(off * rng.normal(size=2)), rng.uniform(-2, 2)]).as_matrix()
            flange.append(middle @ T @ hand)
    else:
        flange = [_transform(rng, np.pi, 0.4) for _ in range(N)]
    return np.array(flange), base, tool


def _residual(flange: Any, measured: Any, Z: Any, X: Any, sigma: Any) -> np.ndarray:
    """Return positions (3) and turns (9) in standard deviations, a pose a row."""
    modelled = Z @ flange @ X
    turns = (measured[:, :3, :3] - modelled[:, :3, :3]) / (np.sqrt(2) * sigma[1])
    return np.hstack([(measured - modelled)[:, :3, 3] / sigma[0], turns.reshape(-1, 9)])


def _cost(flange: Any, measured: Any, Z: Any, X: Any, sigma: Any) -> float:
    return float(np.sum(_residual(flange, measured, Z, X, sigma) ** 2))


def _moved(T: np.ndarray, step: np.ndarray) -> np.ndarray:
    moved = T.copy()
    moved[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(step[3:]).as_matrix()
    moved[:3, 3] += step[:3]
    return moved


def _information(flange: Any, measured: Any, Z: Any, X: Any, sigma: Any) -> np.ndarray:
    """Return J'J (12, 12) of base and tool at the truth, by central differences."""
    J = []
    for step in 1e-6 * np.eye(12):
        ahead = _residual(flange, measured, _moved(Z, step[:6]), _moved(X, step[6:]), sigma)
        behind = _residual(flange, measured, _moved(Z, -step[:6]), _moved(X, -step[6:]), sigma)
        J.append((ahead - behind).ravel() / 2e-6)
    return np.array(J) @ np.array(J).T


def _distance(information: np.ndarray, Z: Any, X: Any, Z1: Any, X1: Any) -> float:
    """Return the squared distance of two answers in standard deviations."""
    parts = []
    for T, T1 in ((Z, Z1), (X, X1)):
        parts += [T1[:3, 3] - T[:3, 3], Rotation.from_matrix(T[:3, :3].T @ T1[:3, :3]).as_rotvec()]
    e = np.concatenate(parts)
    return float(e @ information @ e)


def _least_certain(information: np.ndarray) -> float:
    """Return the largest standard deviation of a rotation [rad], translations being whatever fits."""
    turn = np.tile(np.repeat([False, True], 3), 2)
    across = information[np.ix_(turn, ~turn)]
    least = information[np.ix_(~turn, ~turn)]
    of_turns = information[np.ix_(turn, turn)] - across @ np.linalg.pinv(least, rcond=1e-10, hermitian=True) @ across.T
    weakest = np.linalg.eigvalsh(of_turns)[0]
    return float(1 / np.sqrt(weakest)) if weakest > 0 else np.inf


def _another(rng: np.random.Generator, flange: Any, measured: Any, base: Any, tool: Any, sigma: Any) -> bool:
    """Return whether other frames, to which descents lead from anywhere, fit the poses as well as those near these."""

    def moved(step: np.ndarray, Z: np.ndarray, X: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _moved(Z, step[:6]), _moved(X, step[6:])

    def descended(Z: np.ndarray, X: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        cost = lambda step: _residual(flange, measured, *moved(step, Z, X), sigma).ravel()  # noqa: E731
        found = least_squares(cost, np.zeros(12), x_scale="jac")
        return 2 * found.cost, *moved(found.x, Z, X)

    best, Z, X = descended(base, tool)
    for _ in range(STARTS):
        first, last = Rotation.random(2, rng=rng).as_matrix()
        value, Z1, X1 = descended(*_with_translations(flange, measured, first, last))
        apart = Rotation.from_matrix([Z[:3, :3].T @ Z1[:3, :3], X[:3, :3].T @ X1[:3, :3]]).magnitude()
        if value <= best + AS_WELL and apart.max() > ELSEWHERE:
            return True
    return False


def _closed_forms(flange: Any, measured: Any) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return base and tool by every closed form that has an answer."""
    found = {}
    for name, method in zip(CLOSED, (_shah, _li, _park), strict=True):
        try:
            found[name] = method(flange, measured)
        except np.linalg.LinAlgError:
            continue
    return found


def _shah(flange: Any, measured: Any) -> tuple[np.ndarray, np.ndarray]:
    """Take rotations from one singular value decomposition (Shah 2013, J. Mechanisms and Robotics 5:031007)."""
    # R_B = R_Z R_A R_X, so that sum_i R_B kron R_A maps vec(R_X') to N vec(R_Z)
    K = np.einsum("nij,nkl->ikjl", measured[:, :3, :3], flange[:, :3, :3]).reshape(9, 9)
    U, s, Vt = np.linalg.svd(K)
    if s[1] > (1 - 1e-6) * s[0]:
        raise np.linalg.LinAlgError("rotations about one axis only")
    V, W = U[:, 0].reshape(3, 3), Vt[0].reshape(3, 3)  # R_Z and R_X', up to one common factor
    sign = np.sign(np.linalg.det(V))
    return _with_translations(flange, measured, _proper(sign * V), _proper(sign * W).T)


def _li(flange: Any, measured: Any) -> tuple[np.ndarray, np.ndarray]:
    """Solve for both at once by one linear system (Li, Wang, Wu 2010, Int. J. Physical Sciences 5:1530)."""
    N = len(flange)
    rows, right = np.zeros((12 * N, 24)), np.zeros(12 * N)
    for i, (A, B) in enumerate(zip(flange, measured, strict=True)):
        a = slice(12 * i, 12 * i + 9)
        b = slice(12 * i + 9, 12 * i + 12)
        # B_R X_R' - Z_R A_R = 0,  Z_R'y - A_R t - u = A_t
        rows[a, :9] = -np.kron(np.eye(3), A[:3, :3].T)
        rows[a, 9:18] = np.kron(B[:3, :3], np.eye(3))
        rows[b, :9] = np.kron(B[:3, 3], np.eye(3))
        rows[b, 18:21] = -A[:3, :3]
        rows[b, 21:] = -np.eye(3)
        right[b] = A[:3, 3]
    x = np.linalg.lstsq(rows, right, rcond=None)[0]
    R = _proper(x[:9].reshape(3, 3)), _proper(x[9:18].reshape(3, 3))
    return _with_translations(flange, measured, R[0], R[1].T)


def _park(flange: Any, measured: Any) -> tuple[np.ndarray, np.ndarray]:
    """Align rotation vectors of motions (Park and Martin 1994, IEEE T-RA 10:717), then the base by its mean."""
    i, j = np.triu_indices(len(flange), 1)
    a = _vectors(flange[i, :3, :3], flange[j, :3, :3])
    b = _vectors(measured[i, :3, :3], measured[j, :3, :3])
    X = _proper(a.T @ b)
    Z = _proper(np.einsum("nij,kj,nlk->il", measured[:, :3, :3], X, flange[:, :3, :3]))
    return _with_translations(flange, measured, Z, X)


def _vectors(first: Any, second: Any) -> np.ndarray:
    return Rotation.from_matrix(np.swapaxes(first, 1, 2) @ second).as_rotvec()


def _proper(M: np.ndarray) -> np.ndarray:
    U, _, Vt = np.linalg.svd(M)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt


def _with_translations(flange: Any, measured: Any, Z: Any, X: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return the frames with the translations that fit the rotations best."""
    A = np.concatenate([np.hstack([Z @ R, np.eye(3)]) for R in flange[:, :3, :3]])
    b = measured[:, :3, 3] - flange[:, :3, 3] @ Z.T
    t = np.linalg.lstsq(A, b.ravel(), rcond=1e-6)[0]
    base, tool = np.eye(4), np.eye(4)
    base[:3, :3], base[:3, 3], tool[:3, :3], tool[:3, 3] = Z, t[3:], X, t[:3]
    return base, tool


def report(rows: list[dict[str, Any]]) -> Report:
    """Return how often answers are right and certified, by scene, and what that takes."""
    told = [row for row in rows if _told(row)]
    metrics = {
        "worse_than_a_closed_form": float(sum(row["cost"] > _best(row) * (1 + 1e-9) + 1e-6 for row in rows)),
        "certified_but_wrong": float(sum(_wrong(row) for row in rows)),
        "right": _share(told, _right),
        "certified_of_right": _share([row for row in told if _right(row)], lambda row: bool(row["certified"])),
    }
    lines = []
    for scene in SCENES:
        part = [row for row in rows if row["scene"] == scene]
        if part:
            lines.append([scene, str(len(part)), *_counts(part)])
    times = [row["milliseconds"] for row in rows]
    two = sum(row.get("another") == 1 for row in rows)
    text = (
        f"{len(rows)} cases: 3 to 60 poses, noise of 0.01 to 5 mm and 0.1 to 32 mrad. An answer is right if its "
        "distance from the truth, in standard deviations, is one that noise has in all but one of a million cases. "
        f"Poses determine it if, at the truth, they leave no rotation uncertain by more than {DETERMINED} rad, and if "
        f"no other frames fit them as well ({two} cases, found by {STARTS} descents from anywhere): turns about one "
        f"axis do not. Costs above that of the best closed form: {metrics['worse_than_a_closed_form']:.0f}. Certified "
        f"but wrong or not determined: {metrics['certified_but_wrong']:.0f}. Of the {len(told)} that are determined "
        f"{100 * metrics['right']:.1f} % are right, and of these {100 * metrics['certified_of_right']:.1f} % certified."
        f" Time of the processor, one thread: {np.median(times):.0f} ms (95 %: {np.percentile(times, 95):.0f} ms).\n\n"
    )
    head = ["scene", "cases", "determined", "of them right", "of them certified", "certified, wrong",
            "best closed form right"]  # fmt: skip
    names = [f"{name}, distance" for name in CLOSED]
    determined = [row for row in rows if row["certified"]]
    far = {"certified start": [_root(row["distance"]) for row in determined]}
    far |= {name[:-10]: [_root(row[name]) for row in determined if row.get(name) is not None] for name in names}
    figure = distributions(far, "distance from the truth [standard deviations]")
    return Report(text + markdown(head, lines), metrics, {"distances": figure})


def _root(square: float) -> float:
    return max(float(np.sqrt(square)), 1e-3)


def _right(row: dict[str, Any]) -> bool:
    return row["distance"] <= RIGHT


def _told(row: dict[str, Any]) -> bool:
    """Return whether the poses determine base and tool, and leave one answer."""
    return row["determined"] <= DETERMINED and row.get("another") != 1


def _wrong(row: dict[str, Any]) -> bool:
    """Return whether what is not right, or not determined, is certified."""
    return bool(row["certified"]) and not (_right(row) and _told(row))


def _closed(row: dict[str, Any], what: str) -> list[float]:
    """Return what closed forms have that gave an answer."""
    found = [row.get(f"{name}, {what}") for name in CLOSED]
    return [float(each) for each in found if each is not None and np.isfinite(each)]


def _best(row: dict[str, Any]) -> float:
    return min(_closed(row, "cost"), default=np.inf)


def _share(rows: list[dict[str, Any]], what: Callable[[dict[str, Any]], bool]) -> float:
    return float(np.mean([what(row) for row in rows])) if rows else 1.0


def _counts(part: list[dict[str, Any]]) -> list[str]:
    told = [row for row in part if _told(row)]
    right = [row for row in told if _right(row)]
    certified = [row for row in right if row["certified"]]
    wrong = [row for row in part if _wrong(row)]
    closed = [row for row in told if min(_closed(row, "distance"), default=np.inf) <= RIGHT]
    return [str(len(each)) for each in (told, right, certified, wrong, closed)]
