"""Measured points of an arm, and batched Levenberg-Marquardt fits of base, reflectors and joint zeros to them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Block
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.camera import posed
from rpim_opt.problem.registration.closed_forms import NOMINAL_ERROR, TOOL_ERROR, proper, transforms
from rpim_opt.robot.kinematics import FRAME
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameter_names import tool_prefix

MOST_ROWS = 300
"""Rows that are tried, evenly spread where there are more."""
FEWEST_ROWS = 6
LONGEST = 3.0
"""A reflector farther from the flange [m] is none."""
LEVER = 0.3
"""Length of a pose's axes whose tips are fitted like points, as a part of the extent of its positions."""
TRUSTED = 3.0
"""Rows farther off than so many medians count less, in proportion: gross errors do not decide what a table means."""
REWEIGHTED = 2
"""Steps between two computations of these weights."""
QUIET = 5
"""Steps in a row without a decrease that end a fit."""
FIRST_DAMPING = 1e-2
LARGEST_BATCH = 4_000_000
"""Entries of the Jacobians that are held at once."""
SHORT = 1e-9
"""Relative decrease of the cost below which a fit has converged."""


@dataclass(frozen=True, eq=False)
class Points:
    """N measured points of a robot."""

    q: Array
    y: Array
    marker: np.ndarray
    tools: Array
    turns: Array | None
    row: np.ndarray
    seen: bool = False
    names: tuple[str, ...] = ("",)

    def take(self, index: Sequence[int] | np.ndarray) -> Points:
        """Return the points at ``index``."""
        turns = None if self.turns is None else self.turns[index]
        return replace(
            self, q=self.q[index], y=self.y[index], marker=self.marker[index], turns=turns, row=self.row[index]
        )

    def evenly(self, most: int) -> Points:
        """Return at most so many of the points, evenly spread."""
        return self.take(np.linspace(0, len(self.row) - 1, min(most, len(self.row))).round().astype(int))

    @property
    def extent(self) -> float:
        """How far the points spread [m]."""
        return max(float(np.linalg.norm(self.y.std(axis=0))), 1e-12)

    @property
    def targets(self) -> tuple[Array, Array, np.ndarray]:
        """Joint values (K, dof), positions (K, 3) and reflectors (K,): of poses also the tips of their axes."""
        if self.turns is None:
            return self.q, self.y, self.marker
        tips = self.y[:, None] + self.lever * np.swapaxes(self.turns, 1, 2)
        y = np.concatenate([self.y[:, None], tips], axis=1).reshape(-1, 3)
        return np.repeat(self.q, 4, axis=0), y, (4 * self.marker[:, None] + np.arange(4)).ravel()

    @property
    def lever(self) -> float:
        """Length of the axes [m] whose tips are fitted."""
        return LEVER * self.extent

    @property
    def stated(self) -> tuple[Array, Array]:
        """Stated places (M, 3) of the reflectors of `targets` [m], and their standard deviations (M,) [m]."""
        if self.turns is None:
            return self.tools, np.full(len(self.tools), TOOL_ERROR)
        return np.repeat(self.tools, 4, axis=0), np.tile([TOOL_ERROR, *3 * [10 * TOOL_ERROR]], len(self.tools))


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
    ordered = replace(whole, row=row, seen=data is not problem.data).take(np.argsort(row, kind="stable"))
    return ordered.evenly(most)


def _together(blocks: Sequence[Block], own: Mapping[str, float]) -> Points:
    """Return the points of all blocks, reflectors where the parameters' values by name put them."""
    markers = list(dict.fromkeys(block.markers[0] for block in blocks))
    tools = np.array([[own[tool_prefix(marker) + c] for c in FRAME[:3]] for marker in markers])
    tools[np.linalg.norm(tools, axis=1) > LONGEST] = 0.0  # where a fit to lengths in another unit put them
    turns = None
    if len(markers) == 1 and all(block.measurement.name == "pose" for block in blocks):
        turns = np.concatenate([transforms(block.y)[:, :3, :3] for block in blocks])
    return Points(
        q=np.concatenate([block.q[:, 0] for block in blocks]),
        y=np.concatenate([block.y[:, :3] for block in blocks]),
        marker=np.concatenate([np.full(len(block.row), markers.index(block.markers[0])) for block in blocks]),
        tools=tools,
        turns=turns,
        row=np.concatenate([block.row for block in blocks]),
        names=tuple(markers),
    )


def mirrored(points: Points) -> Points:
    """Return the points in a measured frame of the other handedness."""
    mirror = np.diag([1.0, 1.0, -1.0])
    turns = points.turns
    if turns is not None:
        turns = mirror @ turns @ mirror
    return replace(points, y=points.y @ mirror, turns=turns)


class Fit(NamedTuple):
    """Where base, reflectors and joint zeros fit positions best: of B sets of N points, M reflectors."""

    modelled: Array
    error: Array
    cost: Array
    base: Array
    tools: Array
    zero: Array

    def take(self, index: np.ndarray) -> Fit:
        """Return the fits at ``index``."""
        return Fit(*(each[index] for each in self))


class Candidates(NamedTuple):
    """B sets of N points to be fitted at once."""

    q: Array
    y: Array
    marker: np.ndarray
    zero: Array
    tools: Array
    stated: Array
    spread: Array

    @classmethod
    def of(cls, robot: Robot, tries: Sequence[Points]) -> Candidates:
        """Return candidates of as many points each, joint zeros and reflectors as they are stated."""
        targets = [points.targets for points in tries]
        q, y, marker = (np.stack(each) for each in zip(*targets, strict=True))
        stated, spread = tries[0].stated
        tools = np.stack([points.stated[0] for points in tries])
        return cls(q @ robot.joint_map.T, y, marker, np.zeros((len(y), robot.dof)), tools, stated, spread)

    def take(self, index: np.ndarray) -> Candidates:
        """Return the candidates at ``index``."""
        taken = {name: getattr(self, name)[index] for name in ("q", "y", "marker", "zero", "tools")}
        return self._replace(**taken)


def fit_arms(
    robot: Robot,
    asked: Candidates,
    steps: int,
    *,
    zeros: bool = False,
    robust: bool = False,
    noise: float = NOMINAL_ERROR,
) -> Fit:
    """Return the fits of many candidates at once, by Levenberg-Marquardt with the base eliminated.

    ::

        minimize  sum_i w_i |y_i - Q (p_i + R_i tau_m(i)) - t|^2 + (noise |tau_m - stated_m| / spread_m)^2

    over reflectors tau and, where asked, joint zeros o: (R_i, p_i) is the flange at q_i + o. At every step (Q, t) is
    the registration in closed form (`proper`), and the Jacobian loses its mean over the rows and carries three columns
    for a turn of the base, whose step is dropped.

    Parameters
    ----------
    robot
        The nominal robot; joint values are those of its model.
    asked
        The candidates.
    steps
        At most so many.
    zeros
        Whether joint zeros are fitted.
    robust
        Whether weights w fall as 1 / error beyond three medians of a candidate's errors; otherwise they are one.
    noise
        Error of a point [m] that the spread of the reflectors is weighed against.
    """
    B, N, _ = asked.y.shape
    columns = 3 + 3 * len(asked.stated) + zeros * robot.dof
    parts = np.array_split(np.arange(B), 1 + B * N * 3 * columns // LARGEST_BATCH)
    fits = [_fitted(robot, asked.take(some), steps, zeros, robust, noise) for some in parts]
    return Fit(*(np.concatenate(each) for each in zip(*fits, strict=True)))


class _State(NamedTuple):
    """Candidates at one point: flange columns R (3, 3, B, N) and points p, joint axes and origins, residuals, cost."""

    zero: Array
    tools: Array
    points: Array
    turn: Array
    axes: Array
    origins: Array
    base: Array
    mean: Array
    residual: Array
    cost: Array

    def where(self, better: np.ndarray, other: _State) -> _State:
        """Return the other's candidates where they are better."""
        each = []
        for name, mine, theirs in zip(self._fields, self, other, strict=True):
            axis = _BATCH[name]
            shape = [1] * mine.ndim
            shape[axis] = -1
            each.append(np.where(better.reshape(shape), theirs, mine))
        return _State(*each)


_BATCH = {"zero": 0, "tools": 0, "points": 1, "turn": 2, "axes": 2, "origins": 2, "base": 0, "mean": 1, "residual": 1,
          "cost": 0}  # fmt: skip
"""The axis of a state's arrays that counts the candidates."""


def _fitted(robot: Robot, asked: Candidates, steps: int, zeros: bool, robust: bool, noise: float) -> Fit:
    B, N, _ = asked.y.shape
    damping = np.full(B, FIRST_DAMPING)
    weights = np.ones((B, N))
    pull = (noise / asked.spread) ** 2
    y = np.moveaxis(asked.y, -1, 0)
    asking = (robot, asked, y, pull)
    state = _at(*asking, weights, asked.zero, asked.tools)
    size = asked.tools[0].size
    quiet = 0
    for k in range(steps):
        if robust and k % REWEIGHTED == 0:
            error = np.linalg.norm(state.residual, axis=0)
            limit = TRUSTED * np.median(error, axis=1, keepdims=True) + 1e-12
            weights = np.minimum(1.0, limit / np.maximum(error, 1e-300))
            state = _at(*asking, weights, state.zero, state.tools)
        step = _step(robot, asked, pull, weights, state, damping, zeros)
        tools = state.tools + step[:, :size].reshape(state.tools.shape)
        zero = state.zero
        if zeros:
            zero = zero + step[:, size:-3]
        candidate = _at(*asking, weights, zero, tools)
        better = candidate.cost < state.cost
        before = state.cost
        damping = np.where(better, np.maximum(damping / 4, 1e-9), np.minimum(damping * 4, 1e6))
        state = state.where(better, candidate)
        quiet = 0 if (before - state.cost > SHORT * before).any() else quiet + 1
        if quiet == QUIET:
            break
    base = np.tile(np.eye(4), (B, 1, 1))
    base[:, :3, :3] = np.swapaxes(state.base, 1, 2)
    seen = np.einsum("bij,jbn->bni", base[:, :3, :3], state.points)
    weight = weights / weights.sum(axis=1, keepdims=True)
    base[:, :3, 3] = np.einsum("bn,bni->bi", weight, asked.y - seen)
    modelled = seen + base[:, None, :3, 3]
    return Fit(modelled, np.linalg.norm(asked.y - modelled, axis=2), state.cost, base, state.tools, state.zero)


def _at(robot: Robot, asked: Candidates, y: Array, pull: Array, weights: Array, zero: Array, tools: Array) -> _State:
    """Return the state at joint zeros (B, dof) and reflectors (B, M, 3)."""
    turn, p, axes, origins = _flange(robot, asked.q + zero[:, None])
    tau = np.moveaxis(tools[np.arange(len(tools))[:, None], asked.marker], -1, 0)
    points = p + turn[0] * tau[0] + turn[1] * tau[1] + turn[2] * tau[2]
    share = weights / weights.sum(axis=1, keepdims=True)
    mean = (points * share).sum(axis=-1, keepdims=True)
    centred = points - mean
    target = y - (y * share).sum(axis=-1, keepdims=True)
    base = proper(np.einsum("ibn,jbn->bij", weights * centred, target))
    residual = centred - np.einsum("bij,jbn->ibn", base, target)
    off = tools - asked.stated
    cost = (weights * residual**2).sum(axis=(0, 2)) + (pull[:, None] * off**2).sum(axis=(1, 2))
    return _State(zero, tools, points, turn, axes, origins, base, mean, residual, cost)


def _flange(robot: Robot, q: Array) -> tuple[Array, Array, Array, Array]:
    """Return rotation columns (3, 3, B, N) and origins (3, B, N) of flanges, axes and origins (dof, 3, B, N)."""
    B, N, dof = q.shape
    x, y, z = (np.broadcast_to(e[:, None, None], (3, B, N)) for e in np.eye(3))
    p = np.zeros((3, B, N))
    axes = np.empty((dof, 3, B, N))
    origins = np.empty((dof, 3, B, N))
    for j, (alpha, a, theta, d, beta) in enumerate(robot.mdh):
        c, s = np.cos(alpha), np.sin(alpha)
        y, z = c * y + s * z, c * z - s * y
        p = p + a * x
        axes[j] = z
        origins[j] = p
        angle = np.full((B, N), theta)
        shift = np.full((B, N), d)
        if robot.joint_types[j] == "revolute":
            angle = angle + q[:, :, j]
        else:
            shift = shift + q[:, :, j]
        c, s = np.cos(angle), np.sin(angle)
        x, y = c * x + s * y, c * y - s * x
        p = p + shift * z
        if beta:
            c, s = np.cos(beta), np.sin(beta)
            x, z = c * x - s * z, c * z + s * x
    return np.stack([x, y, z]), p, axes, origins


def _step(
    robot: Robot, asked: Candidates, pull: Array, weights: Array, state: _State, damping: Array, zeros: bool
) -> Array:
    """Return the damped Gauss-Newton steps (B, columns): reflectors, joint zeros, a turn of the base."""
    B, N, _ = asked.y.shape
    M = len(asked.stated)
    dof = state.zero.shape[1] if zeros else 0
    J = np.zeros((B, 3 * M + dof + 3, 3, N))
    for m in range(M):
        seen = asked.marker == m
        for k in range(3):
            J[:, 3 * m + k] = np.moveaxis(state.turn[k] * seen, 0, 1)
    for j in range(dof):
        J[:, 3 * M + j] = np.moveaxis(_moved(robot, state, j), 0, 1)
    centred = np.moveaxis(state.points - state.mean, 0, 1)
    J[:, -3, 1], J[:, -3, 2] = -centred[:, 2], centred[:, 1]
    J[:, -2, 0], J[:, -2, 2] = centred[:, 2], -centred[:, 0]
    J[:, -1, 0], J[:, -1, 1] = -centred[:, 1], centred[:, 0]
    share = (weights / weights.sum(axis=1, keepdims=True))[:, None, None]
    root = np.sqrt(weights)[:, None, None]
    J -= (J * share).sum(axis=-1, keepdims=True)
    A = (J * root).reshape(B, -1, 3 * N)
    r = (np.moveaxis(state.residual, 0, 1) * root[:, 0]).reshape(B, 3 * N, 1)
    H = A @ np.swapaxes(A, 1, 2)
    g = (A @ r)[..., 0]
    at = np.arange(3 * M)
    H[:, at, at] += np.repeat(pull, 3)
    g[:, at] += (pull[:, None] * (state.tools - asked.stated)).reshape(B, -1)
    diagonal = np.einsum("bii->bi", H)
    largest = diagonal.max(axis=1, keepdims=True)
    extra = damping[:, None] * (diagonal + 1e-3 * largest) + 1e-12 * largest
    return -np.linalg.solve(H + extra[:, :, None] * np.eye(H.shape[1]), g[..., None])[..., 0]


def _moved(robot: Robot, state: _State, j: int) -> Array:
    """Return how points (3, B, N) move by the zero of joint j."""
    axis = state.axes[j]
    if robot.joint_types[j] == "prismatic":
        return axis
    away = state.points - state.origins[j]
    return np.stack(
        [
            axis[1] * away[2] - axis[2] * away[1],
            axis[2] * away[0] - axis[0] * away[2],
            axis[0] * away[1] - axis[1] * away[0],
        ]
    )
