"""Where base and reflectors are, in closed form: registration, tool offsets from distances, AX = ZB."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rpim_opt.dataset import Dataset
from rpim_opt.exceptions import InputError
from rpim_opt.kinematics import FRAME, forward_kinematics, frame_numbers, numeric_frame, roll_pitch_yaw
from rpim_opt.measurement import of_fixture
from rpim_opt.parameters import Parameters, model_parameters, tool_prefix
from rpim_opt.problem import CalibrationProblem
from rpim_opt.robot import Array, Robot

Place = Sequence[float] | Array
"""A frame's six numbers, or a point's three."""
MISPLACED = 3.0
"""How many scales a frame may be from where it is stated before the statement counts as a mistake."""
ENOUGH = 2000
"""Rows of a measurement from which frames are placed, where there are more."""
NOMINAL_ERROR, TOOL_ERROR = 5e-3, 0.1
"""What a nominal robot (also in angle, at a metre) and a roughly measured reflector may be wrong by [m, rad]."""


def register(source: Array, target: Array, weights: Array | None = None) -> Array:
    """Return the rigid motion T (4, 4) that minimizes sum q_i |R source_i + t - target_i|^2 (paper, Eq. 17).

    The rotation is proper (det R = 1), by singular value decomposition (Umeyama 1991, IEEE PAMI 13:376).

    Parameters
    ----------
    source, target
        (N, 3) points [m].
    weights
        (N,) q_i; 1 by default.

    Raises
    ------
    InputError
        For fewer than three points, points that coincide, or points on a line: their rotation is arbitrary.
    """
    source, target = np.asarray(source, dtype=float), np.asarray(target, dtype=float)
    q = np.ones(len(source)) if weights is None else np.asarray(weights, dtype=float)
    if source.shape != target.shape or source.shape[1:] != (3,) or q.shape != (len(source),) or not (q >= 0).all():
        raise InputError(
            "points", f"shapes {source.shape}, {target.shape}, {q.shape}", "N points, N points, N weights >= 0"
        )
    if np.count_nonzero(q) < 3:
        raise InputError("points", f"{np.count_nonzero(q)} with a weight", "three or more, not on a line")
    p, r = q @ source / q.sum(), q @ target / q.sum()
    for points, what in ((source - p, "source"), (target - r, "target")):
        s = np.linalg.svd(np.sqrt(q)[:, None] * points, compute_uv=False)
        if s[1] <= 1e-6 * s[0]:
            raise InputError(f"{what} points", "points on a line, or all in one place", "points that span a plane")
    U, _, Vt = np.linalg.svd((source - p).T @ (q[:, None] * (target - r)))
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    T = np.eye(4)
    T[:3, :3] = Vt.T @ D @ U.T
    T[:3, 3] = r - T[:3, :3] @ p
    return T


def tool_from_distances(flange: Array, points: Array, start: Place = (0, 0, 0), spread: float = np.inf) -> Array:
    """Return the reflector's offset in the flange frame, (3,) [m], without knowing the base (paper, Eqs. 18 to 23).

    Minimizes the differences of measured and modelled distances, | |y_j - y_i| - |p_j - p_i + (R_j - R_i) o| |^2,
    over pairs of configurations, by Levenberg-Marquardt from ``start``.

    Parameters
    ----------
    flange
        (N, 4, 4) transforms of the flange [m].
    points
        (N, 3) measured positions [m], in any frame.
    start, spread
        Where the offset is expected, and its standard deviation [m] against errors of the distances of 5 mm:
        a direction that the configurations do not show stays there.
    """
    N = len(points)
    if N < 2:
        raise InputError("configurations", f"{N}", "two or more for a distance")
    steps = np.unique(np.geomspace(1, N - 1, 10).astype(int))
    i = np.concatenate([np.arange(N - step) for step in steps])
    j = i + np.concatenate([np.full(N - step, step) for step in steps])
    measured = np.linalg.norm(points[j] - points[i], axis=1)
    first = np.asarray(start, dtype=float)
    ridge = NOMINAL_ERROR / spread * np.sqrt(len(i) / N)  # a configuration counts once, in however many pairs

    def residual(o: Array) -> Array:
        p = flange[:, :3, :3] @ o + flange[:, :3, 3]
        return np.append(np.linalg.norm(p[j] - p[i], axis=1) - measured, ridge * (o - first))

    return least_squares(residual, first, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15).x


def hand_eye(flange: Array, measured: Array, start: Place = (0, 0, 0)) -> tuple[Array, Array]:
    """Return base Z and tool X, (4, 4) each, with measured_i = Z flange_i X: the problem A X = Z B, A = flange^-1.

    Rotations by the Kronecker product and one singular value decomposition (Shah 2013, J. Mechanisms and
    Robotics 5:031007), translations by linear least squares, the tool's as near to ``start`` as the data allow.

    Parameters
    ----------
    flange, measured
        (N, 4, 4) transforms of the flange in the base, and of the tool in the instrument's frame.
    start
        (3,) expected offset of the tool [m].

    Raises
    ------
    InputError
        For fewer than three poses, or rotations about one axis only.
    """
    N = len(flange)
    if N < 3:
        raise InputError("poses", f"{N}", "three or more")
    RA, RB = flange[:, :3, :3], measured[:, :3, :3]
    # R_B = R_Z R_A R_X, so that sum_i R_B kron R_A maps vec(R_X') to N vec(R_Z)
    K = np.einsum("nij,nkl->ikjl", RB, RA).reshape(9, 9)
    U, s, Vt = np.linalg.svd(K)
    if s[1] > (1 - 1e-6) * s[0]:
        raise InputError("poses", "rotations about one axis only", "poses turned about two axes")
    V, W = U[:, 0].reshape(3, 3), Vt[0].reshape(3, 3)  # R_Z and R_X', up to one common factor
    sign = 1.0 if np.linalg.det(V) > 0 else -1.0
    Z, X = np.eye(4), np.eye(4)
    Z[:3, :3], X[:3, :3] = _proper(sign * V), _proper(sign * W).T
    A = np.concatenate([np.hstack([Z[:3, :3] @ R, np.eye(3)]) for R in RA])
    o = np.asarray(start, dtype=float)
    b = measured[:, :3, 3] - (flange[:, :3, 3] + RA @ o) @ Z[:3, :3].T
    t = np.linalg.lstsq(A, b.ravel(), rcond=1e-6)[0]
    X[:3, 3], Z[:3, 3] = o + t[:3], t[3:]
    return Z, X


def _proper(M: Array) -> Array:
    """Return the rotation nearest to M."""
    U, _, Vt = np.linalg.svd(M)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt


def locate(robot: Robot, data: Dataset, tools: Mapping[str, Place]) -> tuple[Array, dict[str, Array]]:
    """Return the base (6,) and the reflectors (6,) by marker, from positions and poses on the nominal robot.

    Poses give both by `hand_eye`. Otherwise distances correct the reflectors and registration places the base.

    Raises
    ------
    InputError
        When there are no positions and no poses, or they do not determine the base.
    """
    seen = [b for b in data.blocks if b.measurement.name in ("position", "pose")]
    seen = [b.take(k, k) for b in seen for k in [_spread(len(b.row))]]
    if not seen:
        raise InputError("key base", '"auto" without positions or poses', "a table [base]")
    places = {marker: np.asarray(place, dtype=float).copy() for marker, place in tools.items()}
    source, target, weight = [], [], []
    for block in seen:
        flange, marker = forward_kinematics(robot, block.q[:, 0]), block.markers[0]
        if block.measurement.name == "pose":
            try:
                base, tool = hand_eye(flange, _transforms(block.y), places[marker][:3])
            except InputError:
                pass  # too few turns: positions and the stated tool have to do
            else:
                places[marker] = frame_numbers(tool)
                return frame_numbers(base), places
        if len(flange) > 3:
            places[marker][:3] = tool_from_distances(flange, block.y[:, :3], places[marker][:3], TOOL_ERROR)
        source.append(flange[:, :3, :3] @ places[marker][:3] + flange[:, :3, 3])
        target.append(block.y[:, :3])
        variance = np.trace(block.covariance[:, :3, :3], axis1=1, axis2=2)
        weight.append(1 / np.broadcast_to(variance, len(flange)))
    q = np.concatenate(weight)
    return frame_numbers(register(np.concatenate(source), np.concatenate(target), q / q.max())), places


def _spread(count: int) -> np.ndarray:
    """Return which of so many rows place a frame: no more than `ENOUGH`, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, ENOUGH)).round().astype(int))


def _transforms(y: Array) -> Array:
    """Return the transforms (N, 4, 4) of measured poses (N, 7): x, y, z [m] and unit quaternion, w first."""
    T = np.tile(np.eye(4), (len(y), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(y[:, [4, 5, 6, 3]]).as_matrix()
    T[:, :3, 3] = y[:, :3]
    return T


def starting_parameters(
    robot: Robot,
    data: Dataset,
    base: Place | None = (0.0,) * 6,
    tools: Mapping[str, Place] | None = None,
    own: Mapping[str, float] | None = None,
) -> Parameters:
    """Return the model's parameters with closed-form values for what is not stated; none identified yet.

    Parameters
    ----------
    robot, data
        The nominal robot and what was measured.
    base
        The robot's base in the instrument's frame: x, y, z [m], roll, pitch, yaw [rad]; None for registration.
    tools
        Reflectors in the flange frame by marker; ``{"": frame}`` for the only one.
    own
        Values [SI] of the measurements' own parameters by name; a fixture (anchor, plane, sphere) none of whose
        parameters is stated is located from the nominal robot.
    """
    tools = tools or {"": (0.0,) * 6}
    place: Place = (0.0,) * 6 if base is None else base
    for block in data.blocks:
        for marker in set(block.markers) - set(tools):
            where = f"row {data.label[block.row[0]]}, column marker"
            known = ", ".join(f"[tool.{name}]" if name else "[tool]" for name in tools)
            raise InputError(where, f"'{marker}'", f"a reflector with a table of its own; there is {known}")
    places: dict[str, Place] = dict(tools)
    if base is None:
        place, located = locate(robot, data, tools)
        places |= {marker: [*located[marker][:3], *tools[marker][3:]] for marker in tools}
    entries: dict[str, tuple[str, float]] = {}
    for block in data.blocks:
        kind = block.measurement
        names = {name: of_fixture(name, block.fixture) for name in kind.parameters}
        given = {name: (own or {})[names[name]] for name in names if names[name] in (own or {})}
        if names and not given and kind.start is not None:
            T = (
                numeric_frame(place)
                @ forward_kinematics(robot, block.q[:, 0])
                @ numeric_frame(places[block.markers[0]])
            )
            given = kind.start(T[:, :3, 3], block.y)
        entries |= {names[name]: (d, float(given.get(name, 0.0))) for name, d in kind.parameters.items()}
    return model_parameters(robot, place, tools, entries)


def relocated(problem: CalibrationProblem) -> CalibrationProblem | None:
    """Return the problem with base and reflectors where the data put them, if what is stated contradicts that.

    Compared is what `locate` finds on the nominal robot with identified frames. A frame that is more than three
    scales away, and more than the robot's own errors explain, was not known: its deviations then count from where
    it was found. None when every frame is near enough, or the data do not tell.
    """
    p = problem.parameters
    index = {name: i for i, name in enumerate(p.names)}
    at = {"base_": [index[f"base_{c}"] for c in FRAME]}
    if not p.identified[at["base_"]].all():
        return None
    for block in problem.data.blocks:
        at[tool_prefix(block.markers[0])] = [index[tool_prefix(block.markers[0]) + c] for c in FRAME]
    tools = {b.markers[0]: p.nominal[at[tool_prefix(b.markers[0])]] for b in problem.data.blocks}
    try:
        base, places = locate(problem.robot, problem.data, tools)
    except InputError:
        return None
    found = {"base_": base} | {tool_prefix(b.markers[0]): places[b.markers[0]] for b in problem.data.blocks}
    nominal, moved = p.nominal.copy(), False
    for prefix, place in found.items():
        k = np.array(at[prefix])
        free = p.identified[k]
        if not (free[:3].all() and (free[3:].all() or not free[3:].any())):
            continue
        far = np.abs(_deviation(place, p.nominal[k])) > MISPLACED * (p.scale[k] + NOMINAL_ERROR)
        if (far & free).any():
            nominal[k[free]], moved = place[free], True
    return replace(problem, parameters=replace(p, nominal=nominal)) if moved else None


def _deviation(place: Place, nominal: Array) -> Array:
    """Return the deviation (6,) that takes a nominal frame to a place (`kinematics.frame`)."""
    T, T0 = numeric_frame(place), numeric_frame(nominal)
    return np.concatenate([T[:3, 3] - T0[:3, 3], roll_pitch_yaw(T[:3, :3] @ T0[:3, :3].T)])
