"""Measured points of an arm, and batched Levenberg-Marquardt fits of base, reflectors and joint zeros to them.

Lengths from an anchor, or between two points of the arm, are fitted in the same way, with the anchor eliminated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.camera import with_poses
from rpim_opt.problem.registration.closed_forms import NOMINAL_ERROR, TOOL_ERROR, proper, rigid, transforms
from rpim_opt.robot.kinematics import FRAME
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import of_session, tool_prefix

MOST_ROWS = 300  # rows that are tried, evenly spread where there are more
STEPS = 20  # of a fit of base and reflectors, joint zeros too if they are free
FEWEST_ROWS = 6
LONGEST = 3.0  # a reflector farther from the flange [m] is none: fitted in another unit
LEVER = 0.3  # length of a pose's axes whose tips are fitted like points, as a part of the extent of its positions
FULL_WEIGHT = 3.0
"""Rows farther off than so many medians count less, in proportion: gross errors do not decide what a table means."""
UNEXPLAINED = 0.01
"""Nominal errors beyond this part of the points' extent (0.3 % of a robot's reach) are not those of a robot."""
AT_ONCE, STALLED = 10, 5  # steps of all candidates together (an even number), and those without progress that end one
LARGEST_BATCH = 4_000_000  # entries of the Jacobians in memory at once
DRAWS, BEST_DRAWS, LEAST_SHARE = 400, 20, 1 / 3
"""Few rows that are fitted to find those that agree, how many of these are refined, and the share that has to agree."""
FAR = 5.0  # medians of the errors from which on a row is in question
ONE_COORDINATE = 2.3  # medians of normal errors with three coordinates over those with one, in standard deviations


@dataclass(frozen=True, eq=False)
class Points:
    """N measured points of a robot, or N lengths from an anchor to them (K = 1) or between two of them (K = 2)."""

    robot: Robot  # nominal
    q: Array  # (N, dof), of lengths (N, K, dof): joint values of the controller [rad or m]
    y: Array  # (N, 3) positions or (N, 1) lengths [m]
    marker: np.ndarray  # (N,), of lengths (N, K): numbers of the reflectors
    tools: Array  # (M, 3) where these are stated in the flange frame [m]
    turns: Array | None  # (N, 3, 3) orientations
    row: np.ndarray  # (N,) of the dataset
    by_camera: bool = False  # whether they are poses of a camera's views
    names: tuple[str, ...] = ("",)  # of the reflectors

    def take(self, index: Sequence[int] | np.ndarray) -> Points:
        """Return the points at ``index``."""
        turns = None if self.turns is None else self.turns[index]
        return replace(
            self, q=self.q[index], y=self.y[index], marker=self.marker[index], turns=turns, row=self.row[index]
        )

    def evenly(self, most: int) -> Points:
        """Return at most ``most`` of the points, evenly spread."""
        return self.take(np.linspace(0, len(self.row) - 1, min(most, len(self.row))).round().astype(int))

    @property
    def extent(self) -> float:
        """Extent of the points [m], of one coordinate scaled to three."""
        return max(float(np.sqrt(3 * np.mean(self.y.var(axis=0)))), 1e-12)

    @property
    def lengths(self) -> bool:
        """Whether lengths were measured."""
        return self.y.shape[1] == 1


def of_sessions(problem: CalibrationProblem) -> list[CalibrationProblem]:
    """Return the parts of a problem whose sessions are registered one by one, the largest first; else the problem."""
    session, free = problem.data.session, problem.parameters.free.names
    if "base_x" in free or not any(map(of_session, free)):
        return [problem]
    names, count = np.unique(session, return_counts=True)
    return [problem.on(problem.data.take(np.flatnonzero(session == names[k]))) for k in np.argsort(-count)]


@lru_cache(maxsize=2)  # poses of a camera's views take seconds
def points_of(problem: CalibrationProblem) -> Points | None:
    """Return the measured points of positions, poses and a camera's views; None for few, and of several robots."""
    p = problem.parameters
    own = dict(zip(p.names, p.nominal.tolist(), strict=True))
    if len(problem.arms) > 1:
        return None
    try:
        data = with_poses(problem.data, own)
    except InputError:
        return None
    blocks = [block for block in data.blocks if block.measurement.name in ("position", "pose")]
    if sum(len(block.row) for block in blocks) < FEWEST_ROWS:
        return None
    markers = list(dict.fromkeys(block.markers[0] for block in blocks))
    tools = np.array([p.nominal[p.frame(tool_prefix(marker))[:3]] for marker in markers])
    tools[np.linalg.norm(tools, axis=1) > LONGEST] = 0.0
    turns = None
    if len(markers) == 1 and all(block.measurement.name == "pose" for block in blocks):
        turns = np.concatenate([transforms(block.y)[:, :3, :3] for block in blocks])
    number = {label: i for i, label in enumerate(problem.data.label)}
    whole = Points(
        problem.robot, np.concatenate([block.q[:, 0] for block in blocks]),
        np.concatenate([block.y[:, :3] for block in blocks]),
        marker=np.concatenate([np.full(len(block.row), markers.index(block.markers[0])) for block in blocks]),
        tools=tools, turns=turns, row=np.array([number[data.label[i]] for block in blocks for i in block.row]),
        by_camera=data is not problem.data, names=tuple(markers),
    )  # fmt: skip
    return whole.take(np.argsort(whole.row, kind="stable")).evenly(MOST_ROWS)


def lengths_of(problem: CalibrationProblem) -> Points | None:
    """Return lengths of a cable or of distances, all by the same reflectors and anchor; None for other or few data."""
    blocks = problem.data.blocks
    kinds = {(block.measurement.name, block.markers, block.fixture) for block in blocks}
    if len(kinds) > 1 or blocks[0].measurement.name not in ("cable", "distance") or len(problem.arms) > 1:
        return None
    p = problem.parameters
    names = list(dict.fromkeys(blocks[0].markers))
    if len(problem.data) < problem.robot.dof + 3 * len(names) + len(FRAME):
        return None
    q, y, row = (np.concatenate([getattr(block, name) for block in blocks]) for name in ("q", "y", "row"))
    marker = np.tile([names.index(marker) for marker in blocks[0].markers], (len(row), 1))
    tools = np.array([p.nominal[p.frame(tool_prefix(marker))[:3]] for marker in names])
    whole = Points(problem.robot, q, y, marker, tools, None, row, names=tuple(names))
    return whole.take(np.argsort(row, kind="stable")).evenly(MOST_ROWS)


def mirrored(points: Points) -> Points:
    """Return the points in a measured frame of the other handedness."""
    mirror = np.diag([1.0, 1.0, -1.0])
    turns = points.turns
    if turns is not None:
        turns = mirror @ turns @ mirror
    return replace(points, y=points.y @ mirror, turns=turns)


class Fit(NamedTuple):
    """Where base, reflectors and joint zeros fit positions best: of B sets of N points, M reflectors."""

    modelled: Array  # (B, N, 3), of lengths (B, N, 1) [m]
    error: Array  # (B, N) [m]
    cost: Array  # (B,) weighted [m^2]
    base: Array  # (B, 4, 4) in the instrument's frame; of lengths in a frame about the anchor
    tools: Array  # (B, M, 3) in the flange frame [m]
    zero: Array  # (B, dof) joint zeros [rad or m]
    offset: Array  # (B,) of lengths [m]


class Candidates(NamedTuple):
    """B sets of N points to be fitted at once, of robots with equal types of joints."""

    joint_types: tuple[str, ...]
    mdh: Array  # (B, dof, 5)
    q: Array  # (B, NK, dof) joint values of the model; of poses one for their four points
    y: Array  # (B, N, 3) positions or (B, N, 1) lengths [m]
    marker: np.ndarray  # (B, NK) reflectors
    zero: Array  # (B, dof) start values of joint zeros
    tools: Array  # (B, M, 3) start values of reflectors
    stated: Array  # (M, 3) their stated places
    spread: Array  # (M,) standard deviations of these [m]
    damping: Array  # (B,) of the first step

    @classmethod
    def of(cls, tries: Sequence[Points]) -> Candidates:
        """Return candidates with equal numbers of points, and stated joint zeros and reflectors.

        Tips of a pose's axes are points of additional reflectors.
        """
        y, marker, tools = (np.stack([getattr(points, name) for points in tries]) for name in ("y", "marker", "tools"))
        mdh = np.stack([points.robot.mdh for points in tries])
        q = np.stack([points.q @ points.robot.joint_map.T for points in tries])
        B, M, _ = tools.shape
        q, marker = q.reshape(B, -1, q.shape[-1]), marker.reshape(B, -1)
        spread = np.full(M, TOOL_ERROR)
        turns = [LEVER * points.extent * points.turns for points in tries if points.turns is not None]
        if turns:
            axes = np.swapaxes(np.stack(turns), 2, 3)
            tools = tools.repeat(4, axis=1)
            y = np.concatenate([y[:, :, None], y[:, :, None] + axes], axis=2).reshape(B, -1, 3)
            marker = (4 * marker[:, :, None] + np.arange(4)).reshape(B, -1)
            spread = np.tile([TOOL_ERROR, *3 * [10 * TOOL_ERROR]], M)
        zero = np.zeros(mdh.shape[:2])
        damping = np.full(B, 1e-2)
        return cls(tries[0].robot.joint_types, mdh, q, y, marker, zero, tools, tools[0], spread, damping)

    def take(self, index: np.ndarray) -> Candidates:
        """Return the candidates at ``index``."""
        taken = {name: getattr(self, name)[index] for name in ("mdh", "q", "y", "marker", "zero", "tools", "damping")}
        return self._replace(**taken)


def fit_arms(
    candidates: Candidates, steps: int, *, zeros: bool = False, robust: bool = False, noise: float = NOMINAL_ERROR
) -> Fit:
    """Return the fits of many candidates at once, by Levenberg-Marquardt with the base eliminated.

    ::

        minimize  sum_i w_i |y_i - Q (p_i + R_i tau_m(i)) - t|^2 + (noise |tau_m - stated_m| / spread_m)^2

    over reflectors tau and, if ``zeros``, joint zeros o, with (R_i, p_i) the flange at q_i + o. At every step (Q, t) is
    the registration in closed form (`proper`); the Jacobian is centred over the rows and has three more columns for a
    rotation of the base, whose step is dropped.

    If ``robust``, weights w fall as 1 / error beyond three medians of a candidate's errors, otherwise they are one;
    ``noise`` is the error of a point [m].
    """
    B = len(candidates.y)
    columns = 3 + 3 * len(candidates.stated) + zeros * candidates.zero.shape[1]
    parts = np.array_split(np.arange(B), 1 + B * candidates.marker.shape[1] * 3 * columns // LARGEST_BATCH)
    return stacked([_fitted(candidates.take(some), steps, zeros, robust, noise) for some in parts])


def stacked(fits: Sequence[Fit]) -> Fit:
    """Return the concatenation of fits with equal numbers of points."""
    return Fit(*(np.concatenate(each) for each in zip(*fits, strict=True)))


def rms(fit: Fit) -> Array:
    """Return the RMS errors (B,) [m] of the best three quarters of the points, of poses with their tips."""
    error = np.sort(fit.error, axis=1)[:, : int(np.ceil(0.75 * fit.error.shape[1]))]
    return np.sqrt(np.mean(error**2, axis=1))


def fit_points(points: Points) -> Fit:
    """Return where base and reflectors of the nominal robot fit best; of poses their positions."""
    fit = fit_arms(Candidates.of([points]), STEPS, robust=True)
    every = 1 if points.turns is None else 4
    of_points = {name: getattr(fit, name)[0, ::every] for name in ("modelled", "error", "tools")}
    return Fit(*(each[0] for each in fit))._replace(**of_points)


@lru_cache(maxsize=4)
def agreeing(points: Points) -> tuple[np.ndarray, Fit]:
    """Return which rows (N,) agree with one base and one place of each reflector, and the fit to them, of all rows.

    This is least trimmed squares for the nominal robot: a few random or consecutive rows are fitted, then twice the
    third of the rows closest to the best of these fits, and last all rows that are as close. It finds a consistent
    third of the rows wherever it is, and whatever is wrong with the others.
    """
    N = len(points.row)
    size = min(4 + len(points.tools) + 4 * points.lengths, N)
    most = max(int(np.ceil(LEAST_SHARE * N)), min(2 * size, N))  # so many that base and reflectors cannot fit any
    rng = np.random.default_rng(0)
    drawn = rng.permuted(np.tile(np.arange(N), (DRAWS // 2, 1)), axis=1)[:, :size]
    sets = np.vstack([drawn, rng.integers(0, N - size + 1, (DRAWS // 2, 1)) + np.arange(size)])
    for _ in range(3):
        error = _fits_of_all(points, sets).error
        nearest = np.argsort(error, axis=1)[:, :most]
        squares = np.sum(np.take_along_axis(error, nearest, axis=1) ** 2, axis=1)
        sets = nearest[np.argsort(squares)[:BEST_DRAWS]]
    own = np.isin(np.arange(N), sets[0])
    fits = _fits_of_all(points, sets[:1])
    far = FAR * ONE_COORDINATE**points.lengths
    for _ in range(STEPS):
        before, own = own, fits.error[0] < far * np.median(fits.error[0, own])
        if np.array_equal(own, before):
            break
        fits = _fits_of_all(points, np.flatnonzero(own)[None])
    return own, Fit(*(each[0] for each in fits))


def _fits_of_all(points: Points, sets: np.ndarray) -> Fit:
    """Return the fits to each set (B, K) of rows, with their residuals of all rows; errors of poses with their tips."""
    fits = fit_arms(Candidates.of([points.take(each) for each in sets]), STEPS)
    every = Candidates.of([points])
    turn, p, _, _ = _flange(every, every.zero)
    tau = np.moveaxis(fits.tools[:, every.marker[0]], -1, 0)
    there = p + turn[0] * tau[0] + turn[1] * tau[1] + turn[2] * tau[2]
    modelled = np.einsum("bij,jbn->bni", fits.base[:, :3, :3], there) + fits.base[:, None, :3, 3]
    if points.lengths:
        away = modelled if points.q.shape[1] == 1 else modelled[:, 1::2] - modelled[:, ::2]
        modelled = np.linalg.norm(away, axis=2, keepdims=True) + fits.offset[:, None, None]
    error = np.linalg.norm(every.y - modelled, axis=2).reshape(len(sets), len(points.row), -1)
    tips = error.shape[2]
    size = np.sqrt(np.mean(error**2, axis=2))
    return fits._replace(modelled=modelled[:, ::tips], error=size, tools=fits.tools[:, ::tips])


def misfit(points: Points) -> float:
    """Return the RMS error of the best three quarters of the points over their extent, for the nominal robot."""
    return float(misfits([points], zeros=False)[0])


def misfits(tries: Sequence[Points], zeros: bool = True) -> Array:
    """Return the same (B,) of many interpretations of a table, joint zeros fitted by default."""
    errors = np.full(len(tries), np.inf)
    kinds = [(points.robot.joint_types, len(points.row)) for points in tries]
    for kind in dict.fromkeys(kinds):
        some = [i for i, each in enumerate(kinds) if each == kind]
        alike = [tries[i] for i in some]
        fits = fit_arms(Candidates.of(alike), STEPS, zeros=zeros, robust=True)
        errors[some] = rms(fits) / [points.extent for points in alike]
    return errors


class _State(NamedTuple):
    """Candidates at one point: numbers of a candidate (B, ...), and of its points (..., B, NK) or rows (..., B, N)."""

    base: Array  # (B, 3, 3) from the instrument's frame to the robot's
    cost: Array
    offset: Array  # (B,) of lengths
    points: Array  # (3, B, NK)
    turn: Array  # (3, 3, B, NK) columns of the flange's rotation
    axes: Array  # (dof, 3, B, NK) of joints
    origins: Array  # (dof, 3, B, NK) of joints
    away: Array  # (3, B, N) from the points' mean, from the anchor, or from one point to the other
    residual: Array  # (3, B, N) or (1, B, N)


def _registered(points: Array, y: Array, weights: Array) -> tuple[Array, Array, Array, Array]:
    """Return base, offset, away and residual (`_State`) of positions y (3, B, N) at the best base."""
    share = weights / weights.sum(axis=1, keepdims=True)
    away = points - (points * share).sum(axis=-1, keepdims=True)
    target = y - (y * share).sum(axis=-1, keepdims=True)
    base = proper((weights * away).transpose(1, 0, 2) @ target.transpose(1, 2, 0))
    return base, np.zeros(len(base)), away, away - np.einsum("bij,jbn->ibn", base, target)


def _anchored(points: Array, y: Array, weights: Array) -> tuple[Array, Array, Array, Array]:
    """Return the same of lengths y (1, B, N): of pairs of points, or from the best anchor with the best offset.

    ::

        |p - a|^2 = (y - l)^2   is linear in  a, l, |a|^2 - l^2,

    which starts a Gauss-Newton step on |p - a| + l - y: of squares alone long lengths would weigh most.
    """
    B, N = weights.shape
    base = np.tile(np.eye(3), (B, 1, 1))
    if points.shape[2] == 2 * N:
        away = points[..., 1::2] - points[..., ::2]
        return base, np.zeros(B), away, np.linalg.norm(away, axis=0) - y
    root = np.sqrt(weights)

    def beside(anchor: Array, offset: Array) -> tuple[Array, Array, Array]:
        away = points - anchor[..., None]
        length = np.maximum(np.linalg.norm(away, axis=0), 1e-9)
        return away, length, length + offset[:, None] - y[0]

    def least_squares(columns: Array, right: Array) -> Array:
        A = (columns * root).transpose(1, 0, 2)
        H = A @ A.transpose(0, 2, 1)
        H += 1e-12 * np.trace(H, axis1=1, axis2=2)[:, None, None] * np.eye(len(columns))
        return np.linalg.solve(H, A @ (right * root)[..., None])[..., 0].T

    start = least_squares(np.concatenate([2 * points, -2 * y, np.ones_like(y)]), (points**2).sum(axis=0) - y[0] ** 2)
    away, length, residual = beside(start[:3], start[3])
    step = least_squares(np.concatenate([away / length, -np.ones_like(y)]), residual)
    anchor, offset = start[:3] + step[:3], start[3] + step[3]
    away, _, residual = beside(anchor, offset)
    return base, offset, away, residual[None]


def _fitted(candidates: Candidates, steps: int, zeros: bool, robust: bool, noise: float) -> Fit:
    """Return the fits after the first steps, and of candidates that these did not end, after further ones."""
    fit, damping, ended = _some_steps(candidates, min(steps, AT_ONCE), zeros, robust, noise)
    going = np.flatnonzero(~ended)
    if len(going) and steps > AT_ONCE:
        rest = candidates.take(going)._replace(zero=fit.zero[going], tools=fit.tools[going], damping=damping[going])
        for whole, some in zip(fit, _fitted(rest, steps - AT_ONCE, zeros, robust, noise), strict=True):
            whole[going] = some
    return fit


def _some_steps(
    candidates: Candidates, steps: int, zeros: bool, robust: bool, noise: float
) -> tuple[Fit, Array, np.ndarray]:
    """Return the fits, the damping (B,) of the next step, and which have not improved for `STALLED` steps."""
    B, N, coordinates = candidates.y.shape
    damping = candidates.damping
    weights = np.ones((B, N))
    pull = (noise / candidates.spread) ** 2
    y = np.moveaxis(candidates.y, -1, 0)
    eliminated = _anchored if coordinates == 1 else _registered

    def at(zero: Array, tools: Array) -> _State:
        """Return the state at joint zeros (B, dof) and reflectors (B, M, 3)."""
        turn, p, axes, origins = _flange(candidates, zero)
        tau = np.moveaxis(tools[np.arange(B)[:, None], candidates.marker], -1, 0)
        points = p + turn[0] * tau[0] + turn[1] * tau[1] + turn[2] * tau[2]
        base, offset, away, residual = eliminated(points, y, weights)
        off = tools - candidates.stated
        cost = (weights * residual**2).sum(axis=(0, 2)) + (pull[:, None] * off**2).sum(axis=(1, 2))
        return _State(base, cost, offset, points, turn, axes, origins, away, residual)

    zero, tools = candidates.zero, candidates.tools
    size = tools[0].size
    state = at(zero, tools)
    stalled = np.zeros(B, dtype=int)
    for k in range(steps):
        if robust and k % 2 == 0:
            error = np.linalg.norm(state.residual, axis=0)
            limit = FULL_WEIGHT * np.median(error, axis=1, keepdims=True) + 1e-12
            weights = np.minimum(1.0, limit / np.maximum(error, 1e-300))
            state = at(zero, tools)
        step = _step(candidates, pull, weights, state, tools, damping, zeros)
        other_tools = tools + step[:, :size].reshape(tools.shape)
        other_zero = zero + step[:, size : size + zero.shape[1]] if zeros else zero
        candidate = at(other_zero, other_tools)
        better = candidate.cost < state.cost
        fell = state.cost - candidate.cost > 1e-9 * state.cost
        damping = np.where(better, np.maximum(damping / 4, 1e-9), np.minimum(damping * 4, 1e6))
        zero = np.where(better[:, None], other_zero, zero)
        tools = np.where(better[:, None, None], other_tools, tools)
        masks = (better[:, None, None], better, better, *6 * [better[:, None]])
        state = candidate if better.all() else _State(*map(np.where, masks, candidate, state))
        stalled = np.where(fell, 0, stalled + 1)
        if (stalled >= STALLED).all():
            break
    ended = stalled >= STALLED
    if coordinates == 1:
        modelled = candidates.y + np.moveaxis(state.residual, 0, -1)
        base = rigid(state.base, (state.away[..., 0] - state.points[..., 0]).T)
        return Fit(modelled, np.abs(state.residual[0]), state.cost, base, tools, zero, state.offset), damping, ended
    turn = np.swapaxes(state.base, 1, 2)
    seen = np.einsum("bij,jbn->bni", turn, state.points)
    weight = weights / weights.sum(axis=1, keepdims=True)
    base = rigid(turn, np.einsum("bn,bni->bi", weight, candidates.y - seen))
    modelled = seen + base[:, None, :3, 3]
    error = np.linalg.norm(candidates.y - modelled, axis=2)
    return Fit(modelled, error, state.cost, base, tools, zero, state.offset), damping, ended


def _flange(candidates: Candidates, zero: Array) -> list[Array]:
    """Return rotation columns (3, 3, B, N) and origins (3, B, N) of flanges, axes and origins (dof, 3, B, N)."""
    q = candidates.q + zero[:, None]
    B, N, dof = q.shape
    x, y, z = (np.broadcast_to(e[:, None, None], (3, B, N)) for e in np.eye(3))
    p = np.zeros((3, B, N))
    axes = np.empty((dof, 3, B, N))
    origins = np.empty((dof, 3, B, N))
    for j, (alpha, a, theta, d, beta) in enumerate(candidates.mdh.transpose(1, 2, 0)[..., None]):
        if alpha.any():  # most sheets have zeros
            c, s = np.cos(alpha), np.sin(alpha)
            y, z = c * y + s * z, c * z - s * y
        if a.any():
            p = p + a * x
        axes[j] = z
        origins[j] = p
        turning = candidates.joint_types[j] == "revolute"
        angle = theta + turning * q[:, :, j]
        c, s = np.cos(angle), np.sin(angle)
        x, y = c * x + s * y, c * y - s * x
        p = p + (d + (not turning) * q[:, :, j]) * z
        if beta.any():
            c, s = np.cos(beta), np.sin(beta)
            x, z = c * x - s * z, c * z + s * x
    every = candidates.marker.shape[1] // N
    found = [np.stack([x, y, z]), p, axes, origins]
    return found if every == 1 else [each.repeat(every, axis=-1) for each in found]


def _step(
    candidates: Candidates, pull: Array, weights: Array, state: _State, tools: Array, damping: Array, zeros: bool
) -> Array:
    """Return the damped Gauss-Newton steps (B, columns): reflectors, joint zeros, then what was eliminated."""
    B, N, coordinates = candidates.y.shape
    M = len(candidates.stated)
    dof = candidates.zero.shape[1] if zeros else 0
    turning = 3 * (coordinates == 3)
    J = np.zeros((B, 3 * M + dof + turning, 3, candidates.marker.shape[1]))
    for m in range(M):
        seen = candidates.marker == m
        for k in range(3):
            J[:, 3 * m + k] = np.moveaxis(state.turn[k] * seen, 0, 1)
    for j in range(dof):
        slope = state.axes[j]
        if candidates.joint_types[j] == "revolute":
            arm = state.points - state.origins[j]  # `numpy.cross` takes three times as long
            slope = np.stack([slope[i - 2] * arm[i - 1] - slope[i - 1] * arm[i - 2] for i in range(3)])
        J[:, 3 * M + j] = np.moveaxis(slope, 0, 1)
    for k in range(turning):  # about the base's axes
        J[:, 3 * M + dof + k, k - 2], J[:, 3 * M + dof + k, k - 1] = -state.away[k - 1], state.away[k - 2]
    if coordinates == 1:
        if J.shape[-1] == 2 * N:
            J = J[..., 1::2] - J[..., ::2]
        unit = state.away / np.maximum(np.linalg.norm(state.away, axis=0), 1e-9)
        J = np.einsum("bcin,ibn->bcn", J, unit)[:, :, None]
        if candidates.marker.shape[1] == N:  # the anchor, and the offset as the mean
            J = np.concatenate([J, np.moveaxis(unit, 0, 1)[:, :, None]], axis=1)
    if candidates.marker.shape[1] == N:
        share = (weights / weights.sum(axis=1, keepdims=True))[:, None, None]
        J -= np.einsum("bcin,bin->bci", J, np.broadcast_to(share[:, 0], (B, *J.shape[2:])))[..., None]
    root = np.sqrt(weights)[:, None, None]
    J *= root
    A = J.reshape(B, J.shape[1], -1)
    r = (np.moveaxis(state.residual, 0, 1) * root[:, 0]).reshape(B, -1, 1)
    H = A @ np.swapaxes(A, 1, 2)
    g = (A @ r)[..., 0]
    at = np.arange(3 * M)
    H[:, at, at] += np.repeat(pull, 3)
    g[:, at] += (pull[:, None] * (tools - candidates.stated)).reshape(B, -1)
    diagonal = np.einsum("bii->bi", H)
    largest = diagonal.max(axis=1, keepdims=True)
    extra = damping[:, None] * (diagonal + 1e-3 * largest) + 1e-12 * largest
    return -np.linalg.solve(H + extra[:, :, None] * np.eye(H.shape[1]), g[..., None])[..., 0]
