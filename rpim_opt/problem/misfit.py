"""How badly points fit a nominal robot, wherever its base and reflectors are, fast enough for hundreds of tries.

Nothing but joint values, measured values and the drawing goes in: what a table means is judged before anything is
calibrated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Block
from rpim_opt.problem.placing import NOMINAL_ERROR, TOOL_ERROR, hand_eye, transforms
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.views import posed
from rpim_opt.robot.kinematics import FRAME, forward_kinematics
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameter_names import tool_prefix

MOST_ROWS = 300
"""Rows that are tried, evenly spread where there are more."""
FEWEST_ROWS = 6
STEPS = 7
SHORT = 1e-5
"""Reflectors are found when they move by less [m], and where nothing fits earlier: what is off by metres stays so."""
TRUSTED = 3.0
"""Rows further than so many medians count less, in proportion: blunders do not decide what a table means."""
TINY = 1e-13
"""Keeps normal equations regular where a direction is not seen."""
AT_ONCE = 128
"""Readings that are fitted at once: more need memory, and are not faster."""
LONGEST = 3.0
"""A reflector farther from the flange [m] is none."""
BEST = 0.75
"""The part of the rows, the best ones, whose errors are counted."""


@dataclass(frozen=True, eq=False)
class Points:
    """Measured points of a robot.

    Parameters
    ----------
    q
        (N, dof) joint values of the controller [rad or m].
    y
        (N, 3) measured positions [m].
    marker
        (N,) number of the reflector.
    tools
        (M, 3) where the reflectors are stated in the flange frame [m].
    turns
        (N, 3, 3) measured orientations; None where there are none.
    row
        (N,) row of the dataset.
    seen
        Whether they are poses of a camera's views.
    """

    q: Array
    y: Array
    marker: np.ndarray
    tools: Array
    turns: Array | None
    row: np.ndarray
    seen: bool = False

    def take(self, index: Sequence[int] | np.ndarray) -> Points:
        """Return the points at ``index``."""
        turns = None if self.turns is None else self.turns[index]
        return replace(
            self, q=self.q[index], y=self.y[index], marker=self.marker[index], turns=turns, row=self.row[index]
        )

    @property
    def extent(self) -> float:
        """How far the points spread [m]."""
        return float(np.linalg.norm(self.y.std(axis=0)))


@dataclass(frozen=True, eq=False)
class Placed:
    """Where base and reflectors fit best.

    Parameters
    ----------
    modelled
        (N, 3) points [m].
    error
        (N,) their errors [m].
    tools
        (M, 3) the reflectors in the flange frame [m].
    base
        (4, 4) the robot's base in the instrument's frame.
    """

    modelled: Array
    error: Array
    tools: Array
    base: Array


def points_of(problem: CalibrationProblem, most: int = MOST_ROWS) -> Points | None:
    """Return the measured points of positions, poses and a camera's views; None where there are too few."""
    p = problem.parameters
    own = dict(zip(p.names, p.nominal.tolist(), strict=True))
    try:
        data = posed(problem.data, own)
    except InputError:
        return None
    blocks = [block for block in data.blocks if block.measurement.name in ("position", "pose")]
    if sum(len(block.row) for block in blocks) < FEWEST_ROWS:
        return None
    whole = _together(blocks, own)
    number = {label: i for i, label in enumerate(problem.data.label)}
    row = np.array([number[data.label[i]] for i in whole.row])
    count = len(row)
    evenly = np.linspace(0, count - 1, min(count, most)).round().astype(int)
    return replace(whole, row=row, seen=data is not problem.data).take(np.argsort(row, kind="stable")[evenly])


def _together(blocks: Sequence[Block], own: Mapping[str, float]) -> Points:
    """Return the points of all blocks, reflectors where the parameters' values by name put them."""
    markers = list(dict.fromkeys(block.markers[0] for block in blocks))
    return Points(
        q=np.concatenate([block.q[:, 0] for block in blocks]),
        y=np.concatenate([block.y[:, :3] for block in blocks]),
        marker=np.concatenate([np.full(len(block.row), markers.index(block.markers[0])) for block in blocks]),
        tools=_reflectors(markers, own),
        turns=_turns(blocks, markers),
        row=np.concatenate([block.row for block in blocks]),
    )


def _turns(blocks: Sequence[Block], markers: Sequence[str]) -> Array | None:
    """Return the measured orientations (N, 3, 3), where all rows are poses of one reflector."""
    if len(markers) > 1 or any(block.measurement.name != "pose" for block in blocks):
        return None
    return np.concatenate([transforms(block.y)[:, :3, :3] for block in blocks])


def _reflectors(markers: Sequence[str], own: Mapping[str, float]) -> Array:
    """Return where reflectors are stated in the flange frame (M, 3) [m]; at the flange where that is none."""
    tools = np.array([[own[tool_prefix(marker) + c] for c in FRAME[:3]] for marker in markers])
    tools[np.linalg.norm(tools, axis=1) > LONGEST] = 0.0  # where a fit to lengths in another unit put them
    return tools


def placed(robot: Robot, points: Points) -> Placed:
    """Return where base and reflectors fit best, robot nominal.

    Minimizes sum_i w_i |y_i - R (R_i o + p_i) - t|^2 + (0.005 |o - o_stated| / 0.1)^2 over R, t and the reflectors o
    by Gauss-Newton steps from a registration, with weights that fall as 1 / error beyond three medians.
    """
    model, error, tools, base = _placed(robot, [points])
    return Placed(model[0], error[0], tools[0], base[0])


def _placed(robot: Robot, tries: Sequence[Points]) -> tuple[Array, Array, Array, Array]:
    """Return modelled points (B, N, 3), errors (B, N), reflectors (B, M, 3) and bases (B, 4, 4) of B tries at once."""
    q = np.stack([points.q for points in tries])
    y = np.stack([points.y for points in tries])
    marker = np.stack([points.marker for points in tries])
    stated = np.stack([points.tools for points in tries])
    B, N, dof = q.shape
    flange = forward_kinematics(robot, q.reshape(-1, dof)).reshape(B, N, 4, 4)
    tools = stated.copy()
    weights = np.ones((B, N))
    model, error, base = _modelled(flange, tools, marker, y, weights)
    for _ in range(STEPS):
        weights = _weights(error)
        turned = base[:, None, :3, :3] @ flange[..., :3, :3]
        step = _steps(turned, marker, model, y, weights, stated - tools)
        limit = SHORT * (1 + np.median(error, axis=1) / NOMINAL_ERROR)
        if (np.abs(step).max(axis=(1, 2)) < limit).all():
            break
        tools = tools + step
        model, error, base = _modelled(flange, tools, marker, y, weights)
    return model, error, tools, base


def _modelled(flange: Array, tools: Array, marker: np.ndarray, y: Array, weights: Array) -> tuple[Array, Array, Array]:
    """Return modelled points (B, N, 3), errors (B, N) and bases (B, 4, 4) of reflectors (B, M, 3)."""
    which = np.arange(len(y))[:, None]
    body = np.einsum("bnij,bnj->bni", flange[..., :3, :3], tools[which, marker]) + flange[..., :3, 3]
    base = _registered(body, y, weights)
    model = np.einsum("bij,bnj->bni", base[:, :3, :3], body) + base[:, None, :3, 3]
    return model, np.linalg.norm(y - model, axis=2), base


def _registered(source: Array, target: Array, weights: Array) -> Array:
    """Return the rigid motions (B, 4, 4) of `register`, of many sets of points (B, N, 3) at once."""
    q = weights[:, :, None]
    p = (q * source).sum(axis=1) / q.sum(axis=1)
    r = (q * target).sum(axis=1) / q.sum(axis=1)
    H = np.swapaxes(source - p[:, None], 1, 2) @ (q * (target - r[:, None]))
    U, _, Vt = np.linalg.svd(H)
    D = np.tile(np.eye(3), (len(H), 1, 1))
    D[:, 2, 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    T = np.tile(np.eye(4), (len(H), 1, 1))
    T[:, :3, :3] = np.swapaxes(Vt, 1, 2) @ D @ np.swapaxes(U, 1, 2)
    T[:, :3, 3] = r - np.einsum("bij,bj->bi", T[:, :3, :3], p)
    return T


def _weights(error: Array) -> Array:
    limit = TRUSTED * np.median(error, axis=1, keepdims=True) + 1e-12
    return np.minimum(1.0, limit / np.maximum(error, 1e-300))


def _steps(turned: Array, marker: np.ndarray, model: Array, y: Array, weights: Array, away: Array) -> Array:
    """Return the steps (B, M, 3) of the reflectors; base and reflectors move together."""
    B, N, _ = y.shape
    M = away.shape[1]
    J = np.zeros((B, N, 3, 6 + 3 * M))
    J[..., :3] = np.eye(3)
    J[..., 3:6] = -_cross(model - model.mean(axis=1, keepdims=True))
    for m in range(M):
        J[..., 6 + 3 * m : 9 + 3 * m] = turned * (marker == m)[:, :, None, None]
    root = np.sqrt(weights)[:, :, None]
    A = (J * root[..., None]).reshape(B, 3 * N, -1)
    b = ((y - model) * root).reshape(B, 3 * N)
    normal = np.swapaxes(A, 1, 2) @ A
    right = np.einsum("bki,bk->bi", A, b)
    ridge = (NOMINAL_ERROR / TOOL_ERROR) ** 2
    normal[:, range(6, 6 + 3 * M), range(6, 6 + 3 * M)] += ridge
    right[:, 6:] += ridge * away.reshape(B, 3 * M)
    whole = np.trace(normal, axis1=1, axis2=2)
    normal += TINY * whole[:, None, None] * np.eye(6 + 3 * M)
    step = np.linalg.solve(normal, right[..., None])[..., 0]
    return step[:, 6:].reshape(B, M, 3)


def _cross(v: Array) -> Array:
    """Return the matrices (B, N, 3, 3) of the cross products with v (B, N, 3)."""
    x, y, z = np.moveaxis(v, 2, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=2).reshape(*x.shape, 3, 3)


def misfit(robot: Robot, points: Points) -> float:
    """Return the error over the extent of the points, of poses with their angles [rad].

    The error is the RMS of the best three quarters of the rows.
    """
    return float(misfits(robot, [points])[0])


def misfits(robot: Robot, tries: Sequence[Points]) -> Array:
    """Return the `misfit` of many readings of a table, (B,); those of as many rows at once."""
    found = np.full(len(tries), np.inf)
    sizes = np.array([len(points.row) for points in tries])
    for size in np.unique(sizes):
        for some in np.array_split(np.flatnonzero(sizes == size), 1 + np.count_nonzero(sizes == size) // AT_ONCE):
            chosen = [tries[i] for i in some]
            error = np.sort(_placed(robot, chosen)[1], axis=1)[:, : int(np.ceil(BEST * size))]
            extent = np.array([max(points.extent, 1e-12) for points in chosen])
            found[some] = np.sqrt(np.mean(error**2, axis=1)) / extent
    for i, points in enumerate(tries):
        if points.turns is not None:
            found[i] = np.hypot(found[i], _angle(robot, points))
    return found


def _angle(robot: Robot, points: Points) -> float:
    """Return the median angle [rad] between measured and nominal orientations, base and tool fitted."""
    flange = forward_kinematics(robot, points.q)
    measured = np.tile(np.eye(4), (len(points.q), 1, 1))
    measured[:, :3, :3] = points.turns
    measured[:, :3, 3] = points.y
    try:
        Z, X = hand_eye(flange, measured)
    except InputError:
        return 0.0
    error = np.swapaxes(measured[:, :3, :3], 1, 2) @ (Z @ flange @ X)[:, :3, :3]
    cosine = np.clip((np.trace(error, axis1=1, axis2=2) - 1) / 2, -1, 1)
    return float(np.median(np.arccos(cosine)))


def lever_arms(robot: Robot, q: Array, tool: Array) -> Array:
    """Return how far a point of the flange frame moves a radian (or metre) of every joint, (N, dof) [m]."""
    step = 1e-6

    def point(values: Array) -> Array:
        T = forward_kinematics(robot, values)
        return T[:, :3, :3] @ tool + T[:, :3, 3]

    moved = [point(q + step * unit) - point(q - step * unit) for unit in np.eye(robot.dof)]
    return np.stack([np.linalg.norm(each, axis=1) for each in moved], axis=1) / (2 * step)
