"""Positions of the reflector at configurations, and configurations that reach a position or see a target."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.measurements.camera import INTRINSICS, eye_in_hand, pixels
from rpim_opt.data.measurements.contact import revisit
from rpim_opt.data.measurements.measurement import of_fixture
from rpim_opt.data.measurements.pose import position
from rpim_opt.problem.design import random_candidates
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.camera import camera_blocks
from rpim_opt.problem.registration.closed_forms import transformed
from rpim_opt.robot.kinematics import FRAME, forward_kinematics, numeric_frame
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import tool_prefix

SOME = 128
"""Configurations of a box, or of all joint ranges, that are always used; and most of those that move farthest."""
ALL, DRAWN, ROUNDS = 2048, 4096, 16
"""Configurations that represent a box or all joint ranges; number drawn at once to find them, most repetitions."""


class Predicted(NamedTuple):
    """Positions (N, 3) [m] at nominal deviations, and slopes (N, 3, n): about x they are position + slope x [SI]."""

    position: Array
    slope: Array


def predicted(
    problem: CalibrationProblem,
    q: Array,
    marker: str | None,
    torque: Array | None = None,
    at: Array | None = None,
    robot: str = "",
) -> Predicted:
    """Return where a reflector is at q (N, dof) [rad or m] to first order about ``at`` (n,) [SI]; torques [Nm]."""
    here = problem.measuring(q, position, marker, torque, robot=robot)
    x = np.zeros(len(problem.parameters.free)) if at is None else at
    places = here.modelled(x)[0]
    slope = here.jacobian(x).reshape(len(places), 3, -1)
    return Predicted(places - slope @ x, slope)


def moved(problem: CalibrationProblem, q: Array, marker: str | None, at: Array | None = None) -> Predicted:
    """Return the displacement of a reflector by the robot's parameters with frames fixed; arguments as before."""
    own = ~problem.parameters.free.of_frames
    prediction = predicted(problem, q, marker, at=None if at is None else at * own)
    nominal = problem.measuring(q, position, marker).modelled(np.zeros(len(own)))[0]
    return Predicted(prediction.position - nominal, prediction.slope * own)


def markers(problem: CalibrationProblem) -> list[str]:
    """Return the reflectors that were measured, in the order of the data."""
    return list(dict.fromkeys(marker for block in problem.data.blocks for marker in block.markers))


@lru_cache(maxsize=SOME)
def _in_box(problem: CalibrationProblem, box: tuple[tuple[float, float], ...], marker: str | None) -> Array:
    """Return configurations (N, dof) with the nominal reflector in a box, which every iteration uses."""
    low, high = np.array(box).T
    inside = np.zeros((0, problem.robot.dof))
    for seed in range(ROUNDS):
        q = random_candidates(problem.robot, DRAWN, seed)
        at = in_base(problem, q, marker)
        inside = np.concatenate([inside, q[((at >= low) & (at <= high)).all(axis=1)]])
        if len(inside) >= ALL:
            break
    if len(inside) == 0:
        accepted = "a box within reach, in the robot's base frame (not the instrument's)"
        raise InputError("the box", "no configuration of the joint ranges that reaches into it", accepted)
    return inside[:ALL]


def within(problem: CalibrationProblem, box: Array | None = None, marker: str | None = None) -> Array:
    """Return configurations (N, dof) that represent all joint ranges, or those with the nominal reflector in a box.

    ``box`` has sides (3, 2) [m] in the base frame.
    """
    if box is None:
        return random_candidates(problem.robot, ALL)
    return _in_box(problem, tuple(map(tuple, box.tolist())), marker)


def bounding(problem: CalibrationProblem, box: Array | None, x: Array | None) -> Array:
    """Return some of `within` and those that move farthest at x (n,) [SI], so that bounds hold in the whole region."""
    q = within(problem, box)
    if x is None or len(q) <= 2 * SOME:
        return q[: 2 * SOME]
    own = ~problem.parameters.free.of_frames
    here = problem.measuring(q[SOME:])
    movement = here.modelled(x * own)[0] - here.modelled(np.zeros(len(own)))[0]
    order = np.argsort(-np.linalg.norm(movement, axis=1), kind="stable")[:SOME]
    return np.concatenate([q[:SOME], q[SOME:][order]])


def in_base(problem: CalibrationProblem, q: Array, marker: str | None = None) -> Array:
    """Return where the nominal reflector is in the robot's base frame, (N, 3) [m]; arguments as for `predicted`."""
    return problem.measuring(q, revisit, marker).modelled(np.zeros(len(problem.parameters.free)))[0]


DRAWS = 200  # random configurations tried per row
FIRST, FAR = 10, 1e-3  # a row is unreachable if after so many draws the nearest configuration is further away [m]
LONGEST, DIFFERENCE = 0.1, 1e-4  # largest step, and step of central differences, in ranges of the joints
DAMPING = 1e-9  # squared derivative [m^2] that halves a step: a stretched arm does not jump
THERE = 1e-11  # largest distance [m] of a configuration from its target; one more step then leaves rounding only


def configurations_at(
    problem: CalibrationProblem,
    points: Array,
    seed: int | np.random.Generator = 0,
    x: Array | None = None,
    share: float = 1.0,
    marker: str | None = None,
) -> Array:
    """Return joint values (N, dof) [rad or m] at which the tool is at N points.

    Newton's steps (`Target`) start at random configurations, drawn as by `random_candidates`, and stay within the joint
    limits. Robot, tools and loads are the problem's. ``points`` are (N, 3) in the robot's base frame [m]; ``x`` (n,)
    are deviations of the identified parameters [SI], nominal by default; ``marker`` is the tool, by default that of the
    data's first row. InputError for a point that none of `DRAWS` random configurations leads to.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> q = ro.problem.configurations_at(problem, np.tile([0.4, 0.1, 0.2], (3, 1)))
    >>> touching = problem.on(ro.data.touches(q, ["A"] * 3, sigma=1e-4))
    >>> bool(touching.errors(np.zeros(len(problem.parameters.free))).max() < 1e-10)  # the same point
    True
    """
    points = np.atleast_2d(np.asarray(points, dtype=float))
    if x is None:
        x = np.zeros(len(problem.parameters.free))

    def away(q: Array, rows: np.ndarray) -> Array:
        return problem.measuring(q, revisit, marker).modelled(x)[0] - points[rows]

    middle = problem.robot.limits.mean(axis=1)
    half = share * np.ptp(problem.robot.limits, axis=1) / 2
    target = Target(problem.robot, away, np.column_stack([middle - half, middle + half]))
    q, beyond = target.reached(len(points), np.random.default_rng(seed), share)
    if beyond is not None:
        point = ", ".join(f"{1e3 * v:g}" for v in points[beyond])
        raise InputError("the point", f"({point}) mm, out of reach", "a point within reach of the tool")
    return q


class Target(NamedTuple):
    """Equations of inverse kinematics: e (M, k) [m] of ``away`` at joint values (M, dof) of rows (M,).

    Newton's steps of least norm, in units u of the joints' ranges and ``within`` (dof, 2), are::

        u <- u - G' (G G' + d)^-1 e,    G = de / du,    d the damping [m^2]
    """

    robot: Robot
    away: Callable[[Array, np.ndarray], Array]
    within: Array | None = None
    damping: float = DAMPING

    def reached(self, count: int, rng: np.random.Generator, share: float) -> tuple[Array, int | None]:
        """Return joint values (``count``, dof) [rad or m], and the row that is unreachable, if any.

        A configuration that does not converge is drawn again, from a share of the ranges; rows are independent of each
        other. Rounding differences between processors grow 100 times at worst, to a thousandth of a table's last digit.
        """
        low, high = np.array([[-np.inf], [np.inf]]) if self.within is None else self.within.T
        least, most = (self.robot.limits if self.within is None else self.within).T
        reached = np.empty((count, self.robot.dof))
        missing = np.ones(count, dtype=bool)
        nearest = np.full(count, np.inf)
        for draw in range(DRAWS):
            rows = np.flatnonzero(missing)
            # drawn for all rows, also converged ones: a row's draws do not depend on other rows
            q = random_candidates(self.robot, count, rng, share)[rows]
            there = np.zeros(len(q), dtype=bool)
            for _ in range(40):  # some dozen long steps to the target, then a few to rounding
                way = np.flatnonzero(~there)
                q[way] = np.clip(q[way] + self._step(q[way], rows[way]), low, high)
                there[way] = np.linalg.norm(self.away(q[way], rows[way]), axis=1) < THERE
                if there.all():
                    break
            # a last step for all leaves rounding only, the same on every processor
            q = q + self._step(q, rows)
            reached[rows] = q
            missing[rows] = ~there | np.any((q < least) | (q > most), axis=1)
            nearest[rows] = np.minimum(nearest[rows], np.linalg.norm(self.away(q, rows), axis=1))
            if not missing.any():
                return reached, None
            if draw >= FIRST and (nearest > FAR).any():
                break
        return reached, int(np.argmax(nearest * missing))

    def _step(self, q: Array, rows: np.ndarray) -> Array:
        """Return every row's step (M, dof), no longer than `LONGEST` ranges."""
        M, dof = q.shape
        span = np.ptp(self.robot.limits, axis=1)
        shifts = np.diag(DIFFERENCE * span)
        near = np.concatenate([q[None], q + shifts[:, None], q - shifts[:, None]])
        e = self.away(near.reshape(-1, dof), np.tile(rows, 2 * dof + 1)).reshape(2 * dof + 1, M, -1)
        G = np.moveaxis(e[1 : dof + 1] - e[dof + 1 :], 0, 2) / (2 * DIFFERENCE)
        damped = np.tile(np.sqrt(self.damping) * np.eye(e.shape[2]), (M, 1, 1))
        # [G'; sqrt(d) I] = Q R keeps more digits than G G' + d if an arm is nearly stretched
        Q, R = np.linalg.qr(np.concatenate([G.transpose(0, 2, 1), damped], axis=1))
        step = -(Q[:, :dof] @ np.linalg.solve(R.transpose(0, 2, 1), e[0][:, :, None]))[:, :, 0]
        length = np.linalg.norm(step, axis=1)
        return step * np.minimum(1.0, LONGEST / np.maximum(length, LONGEST))[:, None] * span


def touched_place(problem: CalibrationProblem) -> Array:
    """Return a point (3,) [m] in the base frame that the data's rows touched, the nearest to the mean of all."""
    centres = [thing.centre for thing in problem.touched]
    if not centres:
        raise InputError("the data", "no touch of a point", 'rows of measurement = "revisit"')
    middle = np.mean(centres, axis=0)
    # one of them: their mean may be unreachable
    return min(centres, key=lambda centre: float(np.sum((centre - middle) ** 2)))


TIMES = 100  # repetitions of draws to find some configurations with a visible board
MARGIN = 0.04  # margin of the image without points, as a part of its size
LARGE = 0.15  # least width of a board in the image, as a part of the image's
UPRIGHT = 0.5
"""Least cosine between line of sight and the board's normal: corners of a more inclined board are not found."""


def visible_configurations(
    problem: CalibrationProblem,
    points: Array,
    count: int,
    seed: int | np.random.Generator = 0,
    x: Array | None = None,
    share: float = 1.0,
    image: tuple[float, float] = (1280, 960),
) -> Array:
    """Return joint values (count, dof) [rad or m] at which a camera sees its whole board, large and upright enough.

    They are drawn as by `random_candidates`. Frames and intrinsics are the problem's, at deviations ``x`` (n,) [SI],
    nominal by default; ``points`` are (P, 3) of the board [m], ``image`` is width and height [px]. InputError for a
    problem without a camera, and a board that is hardly ever visible.

    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> points = np.array(list(ro.data.grid_board(7, 5, 0.03).values()))
    >>> ro.problem.visible_configurations(ro.load("camera").problem, points, 12).shape
    (12, 6)
    """
    blocks = camera_blocks(problem.data)
    if not blocks:
        raise InputError("visible_configurations", "no row of a camera", "a problem with eye_in_hand or eye_to_hand")
    block = blocks[0]
    p = problem.parameters
    at = p.by_name(np.zeros(len(p.free)) if x is None else x)
    base = numeric_frame([at[f"base_{c}"] for c in FRAME])
    tool = numeric_frame([at[tool_prefix(block.markers[0]) + c] for c in FRAME])
    camera = {name: at[of_fixture(f"camera_{name}", block.fixture)] for name in INTRINSICS}
    points = np.asarray(points, dtype=float)
    normal = np.linalg.svd(points - points.mean(axis=0))[2][2]
    normal = normal * np.copysign(1.0, normal[np.argmax(np.abs(normal))])
    size = np.array(image)
    rng = np.random.default_rng(seed)
    visible = np.zeros((0, problem.robot.dof))
    for _ in range(TIMES):
        q = random_candidates(problem.robot, DRAWN, rng, share)
        T: Array = base @ forward_kinematics(problem.robot, q) @ tool
        if block.measurement is eye_in_hand:
            T = np.asarray(np.linalg.inv(T), dtype=float)
        there = transformed(T[:, None], points)
        before = (there[:, :, 2] > 0).all(axis=1)
        sight = there.mean(axis=1)
        leaning = np.einsum("nij,j,ni->n", T[:, :3, :3], normal, sight)
        there[~before] = [0.0, 0.0, 1.0]
        uv = np.stack(pixels(np.moveaxis(there, 2, 0), camera), axis=2)
        inside = ((uv > MARGIN * size) & (uv < (1 - MARGIN) * size)).all(axis=(1, 2))
        large = np.ptp(uv, axis=1).max(axis=1) > LARGE * size[0]
        upright = leaning > UPRIGHT * np.linalg.norm(sight, axis=1)
        visible = np.concatenate([visible, q[before & inside & large & upright]])
        if len(visible) >= count:
            return visible[:count]
    accepted = (
        "other frames of camera and board, a smaller share of the image or a larger image: it is visible too rarely"
    )
    raise InputError("visible_configurations", f"{len(visible)} of {count} views with a visible board", accepted)
