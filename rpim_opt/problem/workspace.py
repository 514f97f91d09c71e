"""Positions of the reflector at configurations, and configurations at which it is somewhere or in sight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.measurements.camera import INTRINSICS, eye_in_hand, pixels
from rpim_opt.data.measurements.contact import revisit
from rpim_opt.data.measurements.measurement import of_fixture
from rpim_opt.problem.design import random_candidates
from rpim_opt.problem.linear import Machine, require_robot
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.camera import camera_blocks
from rpim_opt.problem.registration.closed_forms import transformed
from rpim_opt.robot.kinematics import FRAME, forward_kinematics, numeric_frame
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameter_names import tool_prefix

SOME = 128
"""Configurations of a box, or of all joint ranges, that are always looked at; and those of all that move farthest."""
ALL, DRAWN = 2048, 4096
"""Configurations that stand for a box, or all joint ranges; drawn at once to find those, up to 16 times."""


class Predicted(NamedTuple):
    """Positions (N, 3) [m] at nominal deviations, and slopes (N, 3, n): about x they are position + slope x [SI]."""

    position: Array
    slope: Array


def predicted(machine: Machine, q: Array, marker: str | None = None, torque: Array | None = None) -> Predicted:
    """Return where a reflector is at q (N, dof) [rad or m] to first order; ``torque`` (N, dof) [Nm]."""
    here = _there(machine, q, marker, torque)
    x = np.zeros(len(machine.parameters.free)) if machine.at is None else machine.at
    position = here.modelled(x)[0]
    slope = here.jacobian(x).reshape(len(position), 3, -1)
    return Predicted(position - slope @ x, slope)


def moved(machine: Machine, q: Array, marker: str | None = None, torque: Array | None = None) -> Predicted:
    """Return by how much the robot's own parameters move a reflector, frames where they are; arguments as before."""
    own = ~machine.parameters.free.of_frames
    at = None if machine.at is None else machine.at * own
    found = predicted(replace(machine, at=at), q, marker, torque)
    nominal = _there(machine, q, marker, torque).modelled(np.zeros(len(own)))[0]
    return Predicted(found.position - nominal, found.slope * own)


def _there(machine: Machine, q: Array, marker: str | None, torque: Array | None) -> CalibrationProblem:
    """Return the problem whose measurements are the positions of a reflector."""
    q = np.atleast_2d(np.asarray(q, dtype=float))
    robot = require_robot(machine)
    if not np.isfinite(q).all() or q.shape[1] != robot.dof:
        found = f"joint values of shape {q.shape}"
        raise InputError("positions", found, f"finite numbers (N, {robot.dof}) [rad or m]")
    return CalibrationProblem(robot, machine.parameters, machine.data).measuring(q, marker=marker, torque=torque)


def markers(machine: Machine) -> list[str]:
    """Return the reflectors that were measured, in the order of the data."""
    return list(dict.fromkeys(marker for block in machine.data.blocks for marker in block.markers))


def within_ranges(machine: Machine) -> Array:
    """Return configurations (N, dof) of all joint ranges that stand for them."""
    return _standing(machine, random_candidates(require_robot(machine), ALL))


def within_box(machine: Machine, lower: Array, upper: Array) -> Array:
    """Return configurations (N, dof) with the nominal reflector between corners (3,) [m] of the base frame."""
    robot = require_robot(machine)
    key = (robot, machine.parameters.nominal.tobytes(), tuple(lower), tuple(upper))
    if key not in _FOUND:
        inside = [np.zeros((0, robot.dof))]
        for seed in range(16):
            q = random_candidates(robot, DRAWN, seed)
            at = in_base(machine, q)
            inside.append(q[((at >= lower) & (at <= upper)).all(axis=1)])
            if sum(map(len, inside)) >= ALL:
                break
        found = np.concatenate(inside)[:ALL]
        if len(found) == 0:
            raise InputError(
                "box",
                "no configuration of the joint ranges that reaches into it",
                "a box within reach, in the base frame",
            )
        if len(_FOUND) >= SOME:
            _FOUND.clear()
        _FOUND[key] = found
    return _standing(machine, _FOUND[key])


_FOUND: dict[Any, Array] = {}
"""Configurations of boxes, which are asked for at every iteration; a robot is the same object all the while."""


def _standing(machine: Machine, q: Array) -> Array:
    """Return some configurations, and those of all that move farthest: bounds at some would be kept there alone."""
    if machine.farthest is None or len(q) <= 2 * SOME:
        return q[: 2 * SOME]
    own = ~machine.parameters.free.of_frames
    here = _there(machine, q[SOME:], None, None)
    movement = here.modelled(machine.farthest * own)[0] - here.modelled(np.zeros(len(own)))[0]
    farthest = np.argsort(-np.linalg.norm(movement, axis=1), kind="stable")[:SOME]
    return np.concatenate([q[:SOME], q[SOME:][farthest]])


def in_base(machine: Machine, q: Array, marker: str | None = None) -> Array:
    """Return where the nominal reflector is in the robot's base frame, (N, 3) [m]; arguments as for `predicted`."""
    whole = machine.parameters
    nominal = np.where([name.startswith("base_") for name in whole.names], 0.0, whole.nominal)
    at_base = replace(machine, parameters=replace(whole, nominal=nominal), at=None, farthest=None)
    return _there(at_base, q, marker, None).modelled(np.zeros(len(whole.free)))[0]


DRAWS = 200
"""Random configurations that are tried for each row."""
FIRST, FAR = 10, 1e-3
"""After so many draws a row is out of reach from which the nearest configuration is further [m]."""
LONGEST, DIFFERENCE = 0.1, 1e-4
"""Largest step, and step of the central differences, in ranges of the joints."""
DAMPING = 1e-9
"""Square of the slopes [m^2] at which a step is half as long: a stretched arm does not leap."""
THERE = 1e-11
"""Largest distance [m] of a configuration from its target; one more step then leaves rounding alone."""


def postures_at(
    problem: CalibrationProblem,
    points: Array,
    seed: int | np.random.Generator = 0,
    x: Array | None = None,
    share: float = 1.0,
    marker: str | None = None,
) -> Array:
    """Return joint values (N, dof) [rad or m] at which the tool is at N points.

    From random configurations by Newton's steps (`Target`), all the way within the joints' limits.

    Parameters
    ----------
    problem
        Gives robot, tools and what its joints bear; its measurements do not matter.
    points
        (N, 3) in the robot's base frame [m].
    seed
        Of the random postures, or a generator to draw from.
    x
        (n,) deviations of the identified parameters [SI]; nominal by default.
    share
        Which part of every joint's range is used, from 0 to 1.
    marker
        The tool, where there are several; that of the data's first row by default.

    Raises
    ------
    InputError
        For a joint without limits, and a point that none of `DRAWS` random postures leads to.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> problem = ro.load("position").problem
    >>> q = ro.problem.postures_at(problem, np.tile([0.4, 0.1, 0.2], (3, 1)))
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
        raise InputError("the point", f"({point}) mm, out of reach", "one that the tool can be at")
    return q


class Target(NamedTuple):
    """What is to vanish at joint values: e (M, k) [m] of ``away`` at (M, dof) joint values of rows (M,).

    Newton's steps of least norm, in units u of the joints' ranges and ``within`` (dof, 2), lead there::

        u <- u - G' (G G' + d)^-1 e,    G = de / du,    d the damping [m^2]
    """

    robot: Robot
    away: Callable[[Array, np.ndarray], Array]
    within: Array | None = None
    damping: float = DAMPING

    def reached(self, count: int, rng: np.random.Generator, share: float) -> tuple[Array, int | None]:
        """Return joint values (N, dof) [rad or m] of so many rows, and the row that is out of reach, if there is one.

        A configuration that does not get there is drawn again, from a share of the ranges; rows do not depend on each
        other. What processors differ by in rounding grows 100 times at worst, to a thousandth of what a table prints.
        """
        low, high = np.array([[-np.inf], [np.inf]]) if self.within is None else self.within.T
        least, most = (self.robot.limits if self.within is None else self.within).T
        found = np.empty((count, self.robot.dof))
        missing = np.ones(count, dtype=bool)
        nearest = np.full(count, np.inf)
        for draw in range(DRAWS):
            rows = np.flatnonzero(missing)
            # drawn for all rows, also those that are there: a row's draws do not depend on another row's luck
            q = random_candidates(self.robot, count, rng, share)[rows]
            there = np.zeros(len(q), dtype=bool)
            for _ in range(40):  # some dozen long steps until the target is near, then a few to rounding
                way = np.flatnonzero(~there)
                q[way] = np.clip(q[way] + self._step(q[way], rows[way]), low, high)
                there[way] = np.linalg.norm(self.away(q[way], rows[way]), axis=1) < THERE
                if there.all():
                    break
            # a last step for all: rounding is then all that is left, the same on every processor
            q = q + self._step(q, rows)
            found[rows] = q
            missing[rows] = ~there | np.any((q < least) | (q > most), axis=1)
            nearest[rows] = np.minimum(nearest[rows], np.linalg.norm(self.away(q, rows), axis=1))
            if not missing.any():
                return found, None
            if draw >= FIRST and (nearest > FAR).any():
                break
        return found, int(np.argmax(nearest * missing))

    def _step(self, q: Array, rows: np.ndarray) -> Array:
        """Return every row's step (M, dof), no longer than `LONGEST` ranges."""
        M, dof = q.shape
        span = np.ptp(self.robot.limits, axis=1)
        shifts = np.diag(DIFFERENCE * span)
        near = np.concatenate([q[None], q + shifts[:, None], q - shifts[:, None]])
        e = self.away(near.reshape(-1, dof), np.tile(rows, 2 * dof + 1)).reshape(2 * dof + 1, M, -1)
        G = np.moveaxis(e[1 : dof + 1] - e[dof + 1 :], 0, 2) / (2 * DIFFERENCE)
        damped = np.tile(np.sqrt(self.damping) * np.eye(e.shape[2]), (M, 1, 1))
        # [G'; sqrt(d) I] = Q R leaves more digits than G G' + d where an arm is nearly stretched
        Q, R = np.linalg.qr(np.concatenate([G.transpose(0, 2, 1), damped], axis=1))
        step = -(Q[:, :dof] @ np.linalg.solve(R.transpose(0, 2, 1), e[0][:, :, None]))[:, :, 0]
        length = np.linalg.norm(step, axis=1)
        return step * np.minimum(1.0, LONGEST / np.maximum(length, LONGEST))[:, None] * span


def touched_place(problem: CalibrationProblem, stated: str | None = None) -> Array:
    """Return a point (3,) [m] in the base frame: as stated, ``"400,0,200"`` [mm], or the middle of the data's."""
    if stated is not None:
        try:
            numbers = [float(part) for part in stated.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) != 3 or not np.isfinite(numbers).all():
            raise InputError("--point", f"'{stated}'", "x,y,z [mm] in the robot's base frame")
        return np.array(numbers) / 1e3
    centres = [thing.centre for thing in problem.touched]
    if not centres:
        raise InputError("the data", "no touch of a point", 'rows of measurement = "revisit"')
    middle = np.mean(centres, axis=0)
    # one of them: their middle may be where no tool reaches
    return min(centres, key=lambda centre: float(np.sum((centre - middle) ** 2)))


DRAWN, TIMES = 4096, 100
"""Configurations that are drawn at once to find some in which the board is in sight, and how often."""
MARGIN = 0.04
"""Part of the image along its edges in which no point appears."""
LARGE = 0.15
"""Least width of a board in the image, as part of the image's."""
UPRIGHT = 0.5
"""Least cosine between line of sight and the board's normal: corners of a board that leans more are not found."""


def postures_in_sight(
    problem: CalibrationProblem,
    points: Array,
    count: int,
    seed: int | np.random.Generator = 0,
    x: Array | None = None,
    share: float = 1.0,
    image: tuple[float, float] = (1280, 960),
) -> Array:
    """Return joint values (count, dof) [rad or m] at which a camera sees all of its board, large and upright enough.

    Parameters
    ----------
    problem
        With rows of a camera, whose frames and intrinsics count.
    points
        (P, 3) of the board [m].
    count
        How many.
    seed
        Of the draws, or a generator to draw from.
    x
        (n,) deviations at which frames and intrinsics are taken [SI]; nominal by default.
    share
        Which part of every joint's range is used, from 0 to 1.
    image
        Width and height [px].

    Raises
    ------
    InputError
        For a problem without a camera, joints without limits, and a board that is hardly ever in sight.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> points = np.array(list(ro.data.grid_board(7, 5, 0.03).values()))
    >>> ro.problem.postures_in_sight(ro.load("camera").problem, points, 12).shape
    (12, 6)
    """
    blocks = camera_blocks(problem.data)
    if not blocks:
        raise InputError("postures_in_sight", "no row of a camera", "a problem with eye_in_hand or eye_to_hand")
    block = blocks[0]
    p = problem.parameters
    values = p.nominal.copy()
    if x is not None:
        values[p.identified] = p.free.values(x)
    at = dict(zip(p.names, values.tolist(), strict=True))
    base = numeric_frame([at[f"base_{c}"] for c in FRAME])
    tool = numeric_frame([at[tool_prefix(block.markers[0]) + c] for c in FRAME])
    camera = {name: at[of_fixture(f"camera_{name}", block.fixture)] for name in INTRINSICS}
    points = np.asarray(points, dtype=float)
    normal = np.linalg.svd(points - points.mean(axis=0))[2][2]
    normal = normal * np.copysign(1.0, normal[np.argmax(np.abs(normal))])
    size = np.array(image)
    rng = np.random.default_rng(seed)
    found = np.zeros((0, problem.robot.dof))
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
        uv = np.stack(pixels(*np.moveaxis(there, 2, 0), **camera), axis=2)
        inside = ((uv > MARGIN * size) & (uv < (1 - MARGIN) * size)).all(axis=(1, 2))
        large = np.ptp(uv, axis=1).max(axis=1) > LARGE * size[0]
        upright = leaning > UPRIGHT * np.linalg.norm(sight, axis=1)
        found = np.concatenate([found, q[before & inside & large & upright]])
        if len(found) >= count:
            return found[:count]
    found_text = f"{len(found)} of {count} views in which the board is in sight"
    raise InputError("postures_in_sight", found_text, "frames, a share and an image with which it is more often")
