"""Likely misreadings of a table (units, signs, orders, another robot), by how well nominal kinematics fit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import three_digits
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.camera import posed
from rpim_opt.problem.registration.closed_forms import Fit, hand_eye, register_arm, transforms
from rpim_opt.robot.formats.tables import read_mdh
from rpim_opt.robot.kinematics import FRAME, forward_kinematics
from rpim_opt.robot.library import READY, robots
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameter_names import tool_prefix

MOST_ROWS = 300
"""Rows that are tried, evenly spread where there are more."""
FEWEST_ROWS = 6
AT_ONCE = 128
"""Readings that are fitted at once: more need memory, and are not faster."""
LONGEST = 3.0
"""A reflector farther from the flange [m] is none."""
BEST = 0.75
"""The part of the rows, the best ones, whose errors are counted."""


@dataclass(frozen=True, eq=False)
class Points:
    """N measured points of a robot.

    Joint values of the controller q (N, dof) [rad or m], positions y (N, 3) [m], numbers of the M reflectors
    ``marker`` (N,), ``tools`` (M, 3) where these are stated in the flange frame [m], orientations ``turns`` (N, 3, 3)
    or None, rows of the dataset (N,), and whether they are poses of a camera's views.
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


def placed(robot: Robot, points: Points) -> Fit:
    """Return where base and reflectors fit best, robot nominal: modelled (N, 3), errors (N,), base, reflectors."""
    return Fit(*(each[0] for each in _fitted(robot, [points])))


def _fitted(robot: Robot, tries: Sequence[Points]) -> Fit:
    """Return where base and reflectors fit each of B tries of as many points best."""
    q = np.stack([points.q for points in tries])
    flange = forward_kinematics(robot, q.reshape(-1, q.shape[2])).reshape(*q.shape[:2], 4, 4)
    y, marker, tools = (np.stack([getattr(points, name) for points in tries]) for name in ("y", "marker", "tools"))
    return register_arm(flange, y, marker, tools)


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
            error = np.sort(_fitted(robot, chosen).error, axis=1)[:, : int(np.ceil(BEST * size))]
            extent = np.array([max(points.extent, 1e-12) for points in chosen])
            found[some] = np.sqrt(np.mean(error**2, axis=1)) / extent
    for i, points in enumerate(tries):
        if points.turns is not None:
            found[i] = np.hypot(found[i], _angle(robot, points))
    return found


def _angle(robot: Robot, points: Points) -> float:
    """Return the median angle [rad] between measured and nominal orientations, base and tool fitted."""
    measured = np.tile(np.eye(4), (len(points.q), 1, 1))
    measured[:, :3, :3] = points.turns
    measured[:, :3, 3] = points.y
    angles = _angles(robot, points.q, measured)
    return 0.0 if angles is None else float(np.median(angles))


def _angles(robot: Robot, q: Array, measured: Array) -> Array | None:
    """Return the angles (N,) [rad] between measured poses and nominal ones; None where base and tool do not follow."""
    flange = forward_kinematics(robot, q)
    try:
        Z, X = hand_eye(flange, measured)
    except InputError:
        return None
    error = np.swapaxes(measured[:, :3, :3], 1, 2) @ (Z @ flange @ X)[:, :3, :3]
    return scipy.spatial.transform.Rotation.from_matrix(error).magnitude()


def pose_misfit(robot: Robot, data: Dataset) -> float:
    """Return the RMS angle [rad] between measured and nominal orientations of the data's first block of poses.

    Base and tool are fitted; pi where the poses do not determine them.
    """
    block = next(each for each in data.blocks if each.measurement.name == "pose")
    angles = _angles(robot, block.q[:, 0], transforms(block.y))
    return float(np.pi) if angles is None else float(np.sqrt(np.mean(angles**2)))


def lever_arms(robot: Robot, q: Array, tool: Array) -> Array:
    """Return how far a point of the flange frame moves a radian (or metre) of every joint, (N, dof) [m]."""
    step = 1e-6

    def point(values: Array) -> Array:
        T = forward_kinematics(robot, values)
        return T[:, :3, :3] @ tool + T[:, :3, 3]

    moved = [point(q + step * unit) - point(q - step * unit) for unit in np.eye(robot.dof)]
    return np.stack([np.linalg.norm(each, axis=1) for each in moved], axis=1) / (2 * step)


BETTER = 0.2
"""Another reading of the data is reported when it leaves less than this part of the position error."""
FURTHER = 0.7
"""A second mistake is looked for behind a reading that leaves less than this part."""
WRONG = 0.02
"""Points that are off by more than this part of their extent fit no drawing of their robot."""
FEW = 60
"""Rows of a first try; what comes near the best is tried on more."""
NEAR = 2.0
SAME = 1.05
"""Readings that leave within this factor the same cannot be told apart."""
MISTAKES = {False: 3, True: 1}
"""Mistakes that are looked for at once; one alone of a camera's views, whose lens is not known yet and blurs others."""
EXACT = 1e-9
"""A smaller error [m] is none."""
BEAM = 8
"""First mistakes behind which a second one is looked for."""


class Reading(NamedTuple):
    """Another reading: what was mistaken, what to write, the points as they are then, and readings that fit as well."""

    what: str
    remedy: str
    change: Callable[[Points], Points]
    others: tuple[Reading, ...] = ()


class Better(NamedTuple):
    """The best other reading: what and the remedies in words, and the errors [m] of both."""

    what: str
    remedy: str
    stated: float
    left: float

    @property
    def sentence(self) -> str:
        """Say it with the figures."""
        figures = f"{three_digits(1e3 * self.left)} mm instead of {three_digits(1e3 * self.stated)} mm"
        times = three_digits(self.stated / max(self.left, EXACT))
        return f"the data fit {times} times better, {figures}, with {self.what}: {self.remedy}."


def joint_readings(robot: Robot) -> Iterator[Reading]:
    """Yield readings with other joint values: units, signs, zeros, orders, couplings."""
    turning = np.array([kind == "revolute" for kind in robot.joint_types])
    n = robot.dof
    eye = np.eye(n)

    def of(what: str, remedy: str, M: Array, shift: Array | float = 0.0) -> Reading:
        return Reading(what, remedy, lambda points: replace(points, q=points.q @ M.T + shift))

    degrees = np.diag(np.where(turning, np.pi / 180, 1))
    yield of("joint values read as degrees, not radians", "name the columns q1_deg, ... (--units deg)", degrees)
    radians = np.diag(np.where(turning, 180 / np.pi, 1))
    yield of("joint values read as radians, not degrees", "name the columns q1_rad, ... (--units rad)", radians)
    for i in np.flatnonzero(turning):
        flipped = eye - 2 * np.outer(eye[i], eye[i])
        yield of(f"joint {i + 1} counted the other way", f"write sign = -1 for joint {i + 1} in robot.toml", flipped)
        for angle in (90, -90, 180):
            remedy = f"add {angle} deg to theta_deg of joint {i + 1} in robot.toml"
            yield of(f"joint {i + 1} shifted by {angle} deg", remedy, eye, np.radians(angle) * eye[i])
    for i, j in combinations(range(n), 2):
        if turning[i] == turning[j]:
            order = list(range(n))
            order[i], order[j] = order[j], order[i]
            remedy = f"exchange the names of the columns q{i + 1} and q{j + 1}"
            yield of(f"joints {i + 1} and {j + 1} exchanged", remedy, eye[order])
    yield from _couplings(robot, of)


def _couplings(robot: Robot, of: Callable[..., Reading]) -> Iterator[Reading]:
    """Yield readings in which a joint's value counts from another joint."""
    n = robot.dof
    turning = [i for i, kind in enumerate(robot.joint_types) if kind == "revolute"]
    for i, j in permutations(turning, 2):
        for sign in (1, -1):
            M = np.eye(n)
            M[i, j] = sign
            rows = ", ".join("[" + ", ".join(f"{v:g}" for v in row) + "]" for row in M)
            word = "plus" if sign > 0 else "minus"
            what = f"joint {i + 1} coupled to joint {j + 1} (q{i + 1} {word} q{j + 1})"
            yield of(what, f"write coupling = [{rows}] in robot.toml", M)


def measured_readings() -> Iterator[Reading]:
    """Yield readings with other measured values: units, handedness, transforms the other way."""

    def scaled(what: str, remedy: str, factors: list[float]) -> Reading:
        return Reading(what, remedy, lambda points: replace(points, y=points.y * factors))

    yield scaled("measured lengths a thousand times larger", "name the columns x_m, y_m, z_m", [1e3] * 3)
    yield scaled("measured lengths a thousand times smaller", "name the columns x_mm, y_mm, z_mm", [1e-3] * 3)
    yield scaled("measured lengths in inches, not mm", "name the columns X [in], ... and use rpim-opt new", [25.4] * 3)
    remedy = "change the sign of one coordinate, or exchange two"
    yield Reading("the measured frame mirrored (left-handed)", remedy, _mirrored)


def _mirrored(points: Points) -> Points:
    mirror = np.diag([1.0, 1.0, -1.0])
    turns = points.turns
    if turns is not None:
        turns = mirror @ turns @ mirror
    return replace(points, y=points.y * np.diag(mirror), turns=turns)


def pose_readings() -> Iterator[Reading]:
    """Yield readings with other orientations."""
    yield Reading(
        "orientations the other way round (of the instrument in the tool)",
        "invert the rotations, or the order of the quaternion is the other one (wxyz, xyzw)",
        lambda points: replace(points, turns=None if points.turns is None else np.swapaxes(points.turns, 1, 2)),
    )

    yield Reading("transforms the other way round (the instrument seen from the tool)", "invert the poses", _inverted)


def _inverted(points: Points) -> Points:
    if points.turns is None:
        return points
    back = np.swapaxes(points.turns, 1, 2)
    return replace(points, y=-np.einsum("nij,nj->ni", back, points.y), turns=back)


def view_readings() -> Iterator[Reading]:
    """Yield readings of a camera's views: it is not where it is said to be."""
    remedy = 'write measurement = "eye_to_hand" for "eye_in_hand", or the other way round'
    yield Reading("the camera and the board exchanged", remedy, _inverted)


def row_readings(count: int) -> Iterator[Reading]:
    """Yield readings with joint values of other rows: shifted, reversed, in the order of texts."""

    def of(what: str, remedy: str, joints: np.ndarray, values: np.ndarray) -> Reading:
        return Reading(what, remedy, lambda points: replace(points.take(values), q=points.q[joints]))

    rows = np.arange(count)
    for k in (1, 2, 3):
        if count - k >= 6:
            said = f"{k} row{'s' * (k > 1)}"
            down = f"move the measured values {said} up, against the joint values"
            yield of(f"measured values {said} too low in the table", down, rows[:-k], rows[k:])
            up = f"move the measured values {said} down, against the joint values"
            yield of(f"measured values {said} too high in the table", up, rows[k:], rows[:-k])
    yield of("the rows of joint values in the reverse order", "turn one of the two parts over", rows[::-1], rows)
    by_text = np.array(sorted(rows, key=lambda i: str(i + 1)))
    remedy = "join by a column that both have (rpim-opt new --data --data --key)"
    yield of("measured values sorted as texts (1, 10, 11, 2)", remedy, by_text, rows)
    back = np.argsort(by_text)
    yield of("joint values sorted as texts (1, 10, 11, 2)", remedy, back, rows)


def better_reading(problem: CalibrationProblem) -> Better | None:
    """Return the reading that fits far better than what is written, or None.

    Single mistakes are tried first, then a second and a third one behind the best of them; where the drawing cannot be
    right, all orders of up to six joints, and the ready robots.

    ``problem``: its robot as the drawing says; base and reflectors are fitted anew for every reading.
    """
    points = points_of(problem)
    if points is None:
        return None
    stated = misfit(problem.robot, points)
    if not np.isfinite(stated):
        return None
    found = _searched(problem.robot, points, stated)
    if found is None and stated > WRONG and not points.seen:
        found = _reordered(problem.robot, points, stated) or _other_robot(problem.robot, points, stated)
    return found


def _all(robot: Robot, points: Points) -> list[Reading]:
    readings = [*joint_readings(robot), *row_readings(len(points.row))]
    if points.seen:
        return [*readings, *view_readings()]
    readings += measured_readings()
    if points.turns is not None:
        readings += pose_readings()
    return readings


def _searched(robot: Robot, points: Points, stated: float) -> Better | None:
    """Return the best of up to three mistakes together: each time the best one, else two of which none is the best."""
    chain, best = _chained(robot, points, stated)
    if stated > WRONG and not points.seen and best >= min(BETTER * stated, WRONG):
        pair = _pair(robot, points)
        if pair is not None and pair[1] < min(best, BETTER * stated):
            chain, best = pair
    if not best < BETTER * stated:
        return None
    return _compared(robot, chain, points, stated, best)


def _chained(robot: Robot, points: Points, stated: float) -> tuple[list[Reading], float]:
    """Return mistakes, each the best behind those before it, and what is left; no more once little is."""
    chain: list[Reading] = []
    best = stated
    while len(chain) < MISTAKES[points.seen] and best >= min(BETTER * stated, WRONG):
        each, size = _best(robot, points, _all(robot, points))
        if each is None or not size < FURTHER * best:
            break
        chain.append(each)
        points = each.change(points)
        best = size
    return chain, best


def _pair(robot: Robot, points: Points) -> tuple[list[Reading], float] | None:
    """Return the best two mistakes together, the first of them one of those that help most, or of all signs."""
    readings = _all(robot, points)
    size = _tried(robot, points, readings)
    firsts = [readings[i] for i in np.argsort(size)[:BEAM]]
    found: list[tuple[list[Reading], float]] = []
    for first in firsts:
        changed = first.change(points)
        second, left = _best(robot, changed, [each for each in _all(robot, changed) if each.what != first.what])
        if second is not None:
            found.append(([first, second], left))
    return min(found, key=lambda each: each[1], default=None)


def _compared(robot: Robot, chain: list[Reading], points: Points, stated: float, left: float) -> Better:
    """Return mistakes in words, each with what fits as well in its place: some are the same but for base and tool."""
    same = [[each, *_in_place(robot, chain, i, points, left)] for i, each in enumerate(chain)]
    what = " and ".join(", or ".join(each.what for each in place) for place in same)
    remedy = "; ".join(", or ".join(each.remedy for each in place) for place in same)
    return Better(what, remedy, stated * points.extent, left * _changed(chain, points).extent)


def _in_place(robot: Robot, chain: list[Reading], i: int, points: Points, left: float) -> list[Reading]:
    """Return what fits as well as a mistake; of one with others behind it, what still does with them."""
    if i == len(chain) - 1:
        return list(chain[i].others)
    start = _changed(chain[:i], points)
    count = len(chain[i].change(start).row)
    found = []
    for other in chain[i].others:
        changed = other.change(start)
        if len(changed.row) == count:  # the mistakes behind it are of so many rows
            size = float(misfits(robot, [_changed(chain[i + 1 :], changed)])[0])
            if size <= SAME * left:
                found.append(other)
    return found


def _changed(chain: Sequence[Reading], points: Points) -> Points:
    """Return the points as they are without some mistakes."""
    for each in chain:
        points = each.change(points)
    return points


def _best(robot: Robot, points: Points, readings: list[Reading]) -> tuple[Reading | None, float]:
    """Return the reading that fits best, and how badly it does; few rows choose whom more rows compare."""
    size = _tried(robot, points, readings)
    least = float(size.min(initial=np.inf))
    if not np.isfinite(least):
        return None, float("inf")
    near = [i for i in np.argsort(size) if size[i] <= NEAR * least][:8]
    whole = misfits(robot, [readings[i].change(points) for i in near])
    k = int(np.argmin(whole))
    same = [readings[i] for i, left in zip(near, whole, strict=True) if left <= SAME * whole[k]]
    best = readings[near[k]]
    return best._replace(others=tuple(each for each in same if each is not best)[:2]), float(whole[k])


def _tried(robot: Robot, points: Points, readings: Sequence[Reading]) -> Array:
    """Return how badly readings fit, from few rows."""
    changed = [each.change(points) for each in readings]
    few = [
        each.take(np.linspace(0, len(each.row) - 1, min(FEW, len(each.row))).round().astype(int)) for each in changed
    ]
    return misfits(robot, few)


def _reordered(robot: Robot, points: Points, stated: float) -> Better | None:
    """Return the best order of up to six turning joints."""
    if robot.dof > 6 or len(set(robot.joint_types)) > 1:
        return None
    readings = [
        Reading(
            f"joints in the order {', '.join(f'q{i + 1}' for i in order)}",
            "name the columns in that order",
            lambda points, order=order: replace(points, q=points.q[:, list(order)]),
        )
        for order in permutations(range(robot.dof))
    ]
    each, size = _best(robot, points, readings)
    if each is None or not size < BETTER * stated:
        return None
    return _compared(robot, [each], points, stated, size)


def _other_robot(robot: Robot, points: Points, stated: float) -> Better | None:
    """Return the ready robot with as many joints that fits far better."""
    best = stated
    name = ""
    for each in robots():
        other = read_mdh(READY / f"{each}.toml")
        if other.joint_types == robot.joint_types:
            size = misfit(other, points)
            if size < best:
                best, name = size, each
    if not best < BETTER * stated:
        return None
    other = Reading(f"the ready robot {name}", f'write robot = "{name}" in problem.toml', lambda points: points)
    return _compared(robot, [other], points, stated, best)
