"""Likely misinterpretations of a table (units, orders, couplings, conventions, another robot), ranked by fit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations, pairwise, permutations, product
from typing import Any, NamedTuple

import numpy as np
import scipy
from scipy.special import fdtr

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import joined, three_digits
from rpim_opt.data.dataset import Dataset
from rpim_opt.data.measurements.pose import from_elevation, from_zenith
from rpim_opt.problem.causes.rows import FEWEST
from rpim_opt.problem.problem import CalibrationProblem
from rpim_opt.problem.registration.certified import UNKNOWN, certified_hand_eye
from rpim_opt.problem.registration.closed_forms import proper, transforms
from rpim_opt.problem.registration.global_start import QUARTER, UNEXPLAINED, WRITE, JointMapping, explained, search
from rpim_opt.problem.registration.points import (
    Points,
    fit_points,
    lengths_of,
    mirrored,
    misfit,
    misfits,
    of_sessions,
    points_of,
)
from rpim_opt.robot.formats.tables import read_robot
from rpim_opt.robot.kinematics import FRAME, forward_kinematics, numeric_frame
from rpim_opt.robot.library import READY, robots
from rpim_opt.robot.mdh import MDH, Robot, numbered

BETTER = 0.2  # another interpretation is reported if its position error is below this part of the present one
RARE = 1e-6  # p-value of reported interpretations
SIBLING, SIBLING_BETTER, SAME_LENGTH = 0.1, 0.5, 1e-3
"""Difference of nominal parameters [m, rad] to a similar ready robot; part of the error that it may leave; difference
of lengths [m] up to which it is the same robot."""
FURTHER = 0.7  # a further mistake is sought behind an interpretation that leaves less than this part
WRONG = 0.02  # errors above this part of the points' extent fit no nominal model of their robot
LEFT = 0.05  # an interpretation with larger errors over the extent explains nothing, even with gross errors
FEW = 30  # rows of a first trial; promising ones are tried on more
SAME = 1.05  # ratio of errors up to which interpretations cannot be distinguished
MISTAKES = {False: 3, True: 1}
"""Most combined mistakes; one for a camera's views, whose unknown lens blurs others."""
COUPLINGS = {True: (1.0, -1.0, 0.5, -0.5), False: (1.0, -1.0)}
"""Trial coupling factors of a joint to a neighbour, and to others."""
LENGTHS = {
    1e3: ("a thousand times larger", "name the columns x_m, y_m, z_m, or multiply an array by 1000"),
    1e-3: ("a thousand times smaller", "name the columns x_mm, y_mm, z_mm, or divide an array by 1000"),
    25.4: ("in inches, not mm", "name the columns X [in], ... and use rpim-opt new"),
    10.0: ("in cm, not mm", "name the columns X [cm], ... and use rpim-opt new"),
    1e-2: ("in cm, not m", "name the columns X [cm], ... and use rpim-opt new"),
    1 / 25.4: ("in mm, not inches", "name the columns X [mm], ... (--units deg,mm)"),
    0.1: ("in mm, not cm", "name the columns X [mm], ... (--units deg,mm)"),
    100.0: ("in m, not cm", "name the columns X [m], ... (--units deg,m)"),
}
"""Factors between units of lengths, what was read wrongly, and what to write."""
ANGLES = {
    np.pi / 180: ("as degrees, not radians", "name the columns q1_deg, ... (--units deg), or use np.radians(q)"),
    180 / np.pi: ("as radians, not degrees", "name the columns q1_rad, ... (--units rad), or leave out np.radians"),
    0.9: ("as gon, not degrees", "multiply the joint values by 0.9"),
    360.0: ("as turns, not degrees", "multiply the joint values by 360"),
    1e-3: ("as thousandths of a degree", "divide the joint values by 1000"),
}
"""The same of joint angles."""
LENGTHS_OF_ALL = "all measured lengths"
MOST_TIMES, FACTORS, FINER = 3e3, 49, 3
"""Largest factor of a column that is sought, how many are tried, and how many of them are refined."""
NEAR_ONE = np.array([0.8, 0.9, 1.1, 1.25])  # factors of all joints that are tried beside them, as of a servo's range
ROWS_OF_THOUSANDS, THOUSANDTH, WIDER = 3, 0.3, 2.0
"""Rows that lost their thousands at least, what others reach [m], and the most that points extend over the flange's."""
SLIPPED = ((1, "low", "up"), (-1, "high", "down"))
"""By how many rows a column may have slipped, where it is then, and which way back."""
DEGREES_PER_MM = np.radians(1) / 1e-3  # radians that a metre stands for where millimetres were degrees


class Misreading(NamedTuple):
    """Another interpretation: the mistake, the remedy, the resulting points, and equally good interpretations."""

    what: str
    remedy: str
    change: Callable[[Points], Points]
    others: tuple[Misreading, ...] = ()


MIRRORED = Misreading(
    "the measured frame mirrored (left-handed)", "change the sign of one coordinate, or exchange two", mirrored
)


class Better(NamedTuple):
    """The best other interpretation: mistake and remedies as text, and the errors [m] with and without it."""

    what: str
    remedy: str
    stated: float
    left: float

    @property
    def sentence(self) -> str:
        """Return it as a sentence with both errors."""
        alike = ""
        if ", or " in self.what:
            alike = " These explain the data equally well: apply the one that matches the set-up."
        figures = f"{three_digits(1e3 * self.left)} mm instead of {three_digits(1e3 * self.stated)} mm"
        times = three_digits(self.stated / max(self.left, 1e-9))
        return f"the data fit {times} times better, {figures}, with {self.what}: {self.remedy}.{alike}"


def pose_misfit(robot: Robot, data: Dataset, tool: Array | None = None) -> float:
    """Return the RMS angle [rad] between measured and nominal orientations of the data's first block of poses.

    Base and tool are fitted; pi if the poses do not determine them. With a ``tool`` (6,) the poses are in the robot's
    base.
    """
    block = next(each for each in data.blocks if each.measurement.name == "pose")
    measured = transforms(block.y)
    flange = forward_kinematics(robot, block.q[:, 0])
    if tool is None:
        try:
            start = certified_hand_eye(flange, measured)
        except InputError:  # two poses
            return float(np.pi)
        if start.uncertainty > UNKNOWN:
            return float(np.pi)
        nominal = start.base @ flange @ start.tool
    else:
        nominal = flange @ numeric_frame(tool)
    error = np.swapaxes(measured[:, :3, :3], 1, 2) @ nominal[:, :3, :3]
    return float(np.sqrt(np.mean(scipy.spatial.transform.Rotation.from_matrix(error).magnitude() ** 2)))


# What a table may be mistaken for


def _readings(points: Points) -> list[Misreading]:
    """Return all single mistakes that are looked for."""
    readings = [*_of_joints(points.robot), *_of_rows(points)]
    if points.by_camera:
        remedy = 'write measurement = "eye_to_hand" for "eye_in_hand", or vice versa'
        return [*readings, Misreading("the camera and the board exchanged", remedy, _inverted)]
    if points.lengths:
        for factor, (unit, _) in LENGTHS.items():
            remedy = f"multiply column distance by {factor:g} or name its unit"
            readings.append(_scaled(f"measured lengths {unit}", remedy, factor))
        return [*readings, _scaled("measured lengths that count down", "change the sign of column distance", -1.0)]
    return [*readings, *_of_positions(points), *(_of_poses() if points.turns is not None else ())]


def _of_joints(robot: Robot) -> Iterator[Misreading]:
    """Yield readings with other joint values: units, signs, orders, couplings; zeros are fitted."""
    turning = np.array(robot.joint_dimensions) == "angle"
    eye = np.eye(robot.dof)
    what = "joint values read as absolute, not as increments"
    yield Misreading(what, "accumulate them row by row", lambda of: replace(of, q=np.cumsum(of.q, axis=0)))
    for factor, (unit, remedy) in ANGLES.items():
        yield _joints(f"joint values read {unit}", remedy, np.diag(np.where(turning, factor, 1)))
    for (factor, (unit, _)), (i, j) in product(list(ANGLES.items())[:2], combinations(range(robot.dof + 1), 2)):
        if turning[i:j].all() and j - i < robot.dof:  # one joint, or several next to each other
            turned = f"joint{'s' * (j - i > 1)} {joined([robot.joint(k) for k in range(i, j)])}"
            remedy = f"multiply the values of {turned} by {factor:.6g} or name the unit"
            yield _joints(f"{turned} read {unit}", remedy, eye + (factor - 1) * np.diag(eye[i:j].sum(axis=0)))
    if not turning.all():
        for factor, (unit, _) in LENGTHS.items():
            remedy = f"multiply the columns of the linear joints by {factor:g} or name their unit"
            yield _joints(f"values of linear joints {unit}", remedy, np.diag(np.where(turning, 1, factor)))
    for i in range(robot.dof):
        flipped = eye - 2 * np.outer(eye[i], eye[i])
        sign = -int(signs(robot.joint_map)[i])
        joint = f"joint {robot.joint(i)}"
        yield _joints(f"{joint} reversed", f"write sign = {sign} for {joint} in robot.toml", flipped)
        what = f"{joint} standing still in all rows"
        yield _joints(what, "check its brake and its column", eye - np.outer(eye[i], eye[i]))
        if turning[i]:
            kinds = ["prismatic" if k == robot.leading[i] else kind for k, kind in enumerate(robot.joint_types)]
            remedy = f'write type = "prismatic" for it in robot.toml, and name its column q{i + 1}_mm'
            sliding = replace(robot, joint_types=tuple(kinds))
            yield _with_robot(f"{joint} prismatic and its values mm", remedy, sliding, DEGREES_PER_MM ** -eye[i])
    for i, last in enumerate(map(robot.joint, range(robot.dof - 1)), start=1):
        remedy = f"put it on the last link, or describe the robot up to joint {last}"
        before = np.diag(np.arange(robot.dof) < i).astype(float)
        yield _joints(f"the reflector on the link of joint {last} (later joints do not move it)", remedy, before)
    for i, j in combinations(range(robot.dof), 2):
        exchanged = eye.copy()
        exchanged[[i, j]] = eye[[j, i]]
        if turning[i] != turning[j]:  # degrees were read as millimetres, and these as degrees
            exchanged *= np.where(turning, DEGREES_PER_MM, 1 / DEGREES_PER_MM)[:, None] ** (eye[i] + eye[j])[:, None]
        both = f"joints {robot.joint(i)} and {robot.joint(j)}"
        yield _joints(f"{both} exchanged", f"exchange the columns of {both}", exchanged)
    for i, j in permutations(np.flatnonzero(turning), 2):
        for factor in COUPLINGS[bool(abs(i - j) == 1)]:
            M = eye.copy()
            M[i, j] = factor
            size = "" if abs(factor) == 1 else f"{abs(factor):g} "
            sum_of = f"q{i + 1} {'plus' if factor > 0 else 'minus'} {size}q{j + 1}"
            what = f"joint {robot.joint(i)} coupled to joint {robot.joint(j)} ({sum_of})"
            yield _joints(what, coupling(robot.joint_map @ M), M)
    for (i, j), size, side in product(pairwise(np.flatnonzero(turning)), (0.5, 1.0), (1.0, -1.0)):
        M = eye.copy()
        M[np.ix_([i, j], [i, j])] = size * np.array([[1, 1], [side, -side]])
        both = f"joints {robot.joint(i)} and {robot.joint(j)} (a differential)"
        what = f"columns q{i + 1} and q{j + 1} that are sum and difference of {both}"
        yield _joints(what, coupling(robot.joint_map @ M), M)
    own = set(zip(robot.leading, range(robot.dof), strict=True))
    coupled = product(range(len(robot.mdh)), range(robot.dof)) if len(robot.mdh) > robot.dof else ()
    for (i, j), factor in product(sorted({*coupled} - own), (-1, 0, 1)):
        to_model = robot.joint_map.copy()
        to_model[i, j] = factor
        if np.linalg.matrix_rank(to_model) < robot.dof:  # another coupling already moves the same joints
            continue
        what = f"joint {numbered(i, robot.joint_names)} following joint {robot.joint(j)} {factor} times"
        yield _with_robot(what, coupling(to_model), replace(robot, joint_map=to_model))


def signs(joint_map: Array) -> Array:
    """Return the signs (m,) of joints that a joint map (m, dof) has on its diagonal."""
    sign = np.ones(len(joint_map))
    sign[np.flatnonzero(np.diag(joint_map) < 0)] = -1
    return sign


def coupling(joint_map: Array) -> str:
    """Return the description and remedy of a joint map (m, dof)."""
    matrix = signs(joint_map)[:, None] * joint_map + 0.0
    rows = ", ".join("[" + ", ".join(f"{v:.6g}" for v in row) + "]" for row in matrix)
    return f"write coupling = [{rows}] in robot.toml"


def _joints(what: str, remedy: str, M: Array) -> Misreading:
    return Misreading(what, remedy, lambda points: replace(points, q=points.q @ M.T))


def _with_robot(what: str, remedy: str, robot: Robot, times: Array | float = 1.0) -> Misreading:
    return Misreading(what, remedy, lambda points: replace(points, robot=robot, q=points.q * times))


def _of_positions(points: Points) -> Iterator[Misreading]:
    """Yield readings with other measured positions, or of another size: units of all columns or one, handedness."""
    width = replace(points, y=forward_kinematics(points.robot, points.q)[:, :3, 3]).extent
    wrong_robot = abs(np.log(width)) > abs(np.log(points.extent))  # is farther from the size of robots, a metre
    for factor, (unit, remedy) in LENGTHS.items():
        if wrong_robot and "thousand" in unit:
            robot = replace(points.robot, mdh=points.robot.mdh / [1, factor, 1, factor, 1])
            remedy = f"correct the unit of the robot file; or {remedy}, if their unit is wrong"
            yield _with_robot(f"robot lengths {LENGTHS[1 / factor][0]}", remedy, robot)
        else:
            remedy += "; or correct the robot file, if its unit is wrong"
            yield _scaled(f"measured lengths {unit}", remedy, factor)
        for axis, of_axis in zip("xyz", np.eye(3), strict=True):
            remedy = f"multiply column {axis} by {factor:g} or name its unit"
            yield _scaled(f"column {axis} {unit}", remedy, 1 + (factor - 1) * of_axis)

    def from_angles(degrees: float, zenith: bool, first: int, points: Points) -> Points:
        y = np.roll(points.y, -first, axis=1)
        angles = np.radians(degrees * y[:, :2] / 1e-3)  # angles were read as millimetres
        polar = np.column_stack([angles, y[:, 2]])
        return replace(points, y=from_zenith(polar) if zenith else from_elevation(polar))

    def from_cylinder(points: Points) -> Points:
        radius, angle, height = points.y.T
        angle = np.radians(angle / 1e-3)
        return replace(points, y=np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height]))

    what = "columns x, y, z that are radius, angle and height (cylindrical coordinates)"
    yield Misreading(what, "convert them to x, y, z", from_cylinder)
    for (degrees, unit), zenith, first in product(((1.0, ""), (0.9, " in gon")), (False, True), (0, 1)):
        angles = f"azimuth, {'zenith angle' if zenith else 'elevation'}"
        what = f"columns x, y, z that are {f'distance, {angles}' if first else f'{angles} and distance'}{unit}"
        names = ["azimuth_deg", "elevation_deg", "distance_mm"]
        remedy = f"name the columns {', '.join([*names[3 - first :], *names[: 3 - first]])}"
        if zenith or unit:
            remedy = f"convert the angles to azimuth and elevation in degrees, and {remedy}"
        yield Misreading(what, remedy, partial(from_angles, degrees, zenith, first))

    def from_other_vertical(side: float, points: Points) -> Points:
        level = np.linalg.norm(points.y[:, :2], axis=1, keepdims=True)
        ahead = points.y[:, :2] / np.maximum(level, 1e-12)
        turned = side * np.sign(ahead @ np.linalg.svd(ahead)[2][:1].T)  # beyond 90 degrees the azimuth turns round
        return replace(points, y=turned * np.hstack([ahead * points.y[:, 2:], level]))

    def from_other_angle(points: Points) -> Points:
        distance = np.linalg.norm(points.y, axis=1)
        x, y, z = points.y.T
        polar = np.column_stack([np.arcsin(z / np.maximum(distance, 1e-12)), np.arctan2(y, x), distance])
        return replace(points, y=from_elevation(polar))

    def with_thousands(k: int, points: Points) -> Points:
        small = (np.arange(3) == k) & (np.abs(points.y) >= 1e-3) & (np.abs(points.y) < 1e-2)
        return replace(points, y=np.where(small, 1e3 * points.y, points.y))

    for k, axis in enumerate("xyz"):
        other = with_thousands(k, points)
        lost = (other.y != points.y).any(axis=1)
        below = np.abs(points.y[~lost, k]).max(initial=0.0)  # which reach up to a thousand
        if np.count_nonzero(lost) >= ROWS_OF_THOUSANDS and below > THOUSANDTH and other.extent < WIDER * width:
            what = f"values of column {axis} above 1000 mm read as a thousandth (1.234,5 as 1.2345)"
            yield Misreading(what, "export them without separators of thousands", partial(with_thousands, k))
    yield Misreading("azimuths and elevations exchanged", "exchange the names of these columns", from_other_angle)
    for side in (1.0, -1.0):
        remedy = "name the column zenith_deg in place of elevation_deg, or vice versa"
        what = "elevations and zenith angles exchanged"
        yield Misreading(what, remedy, partial(from_other_vertical, side))
    yield MIRRORED


def _scaled(what: str, remedy: str, factors: Array | float) -> Misreading:
    return Misreading(what, remedy, lambda points: replace(points, y=points.y * factors))


def _of_poses() -> Iterator[Misreading]:
    """Yield readings with other orientations."""
    Rotation = scipy.spatial.transform.Rotation

    def turned(what: str, remedy: str, change: Callable[[Any], Any]) -> Misreading:
        def turns(points: Points) -> Points:
            return replace(points, turns=change(Rotation.from_matrix(points.turns)).as_matrix())

        return Misreading(what, remedy, turns)

    def euler(axes: str, columns: Sequence[int] = (0, 1, 2), factor: Any = 1.0) -> Callable[[Any], Any]:
        # angles rx, ry, rz, taken for roll, pitch, yaw, are about other axes or in another unit
        return lambda R: Rotation.from_euler(axes, (factor * R.as_euler("xyz"))[:, list(columns)])

    def reordered(order: list[int]) -> Callable[[Any], Any]:
        return lambda R: Rotation.from_quat(R.as_quat()[:, order])

    yield turned("inverted orientations (of the instrument in the tool's frame)", "invert the rotations", Rotation.inv)
    for where, order in (("last", [3, 0, 1, 2]), ("first", [1, 2, 3, 0])):
        remedy = "state the order of the quaternion's components (--quaternion); arrays have w first"
        yield turned(f"quaternions with w {where}", remedy, reordered(order))
    yield Misreading("inverted transforms (the instrument in the tool's frame)", "invert the poses", _inverted)
    remedy = "express both in one frame: multiply the rotations by that between the two"
    yield Misreading("orientations in another frame than the positions", remedy, _in_one_frame)
    for order in map("".join, permutations("xyz")):
        for kind, axes in (("fixed", order), ("moving", order.upper())):
            what = f"Euler angles about {kind} axes in the order {', '.join(order)}"
            remedy = "convert them to roll, pitch, yaw, or to quaternions"
            if kind == "moving" and order != "zyx":  # the same as about fixed axes in reverse; zyx: roll, pitch, yaw
                stated = f"state --rotation 'intrinsic {order}', or {remedy}"
                yield turned(what, stated, euler(axes, ["xyz".index(axis) for axis in order]))
            if order != "xyz":  # KUKA's A, B, C for instance
                turns = "intrinsic" if kind == "moving" else "extrinsic"
                renamed = f"rename them r{', r'.join(order)} and state --rotation '{turns} {order}', or {remedy}"
                yield turned(f"{what}, columns in this order", renamed, euler(axes))
    for sign in list(product((1.0, -1.0), repeat=3))[1:]:
        named = joined([name for name, each in zip(("rx", "ry", "rz"), sign, strict=True) if each < 0])
        yield turned(f"Euler angles with the other sign of {named}", "change it", euler("xyz", factor=sign))
    for factor, unit in ((180 / np.pi, "radians"), (0.9, "gon")):
        yield turned(f"Euler angles in {unit}", "convert them to degrees", euler("xyz", factor=factor))
    vectors = "rotation vectors in radians"
    yield turned(vectors, "convert them to degrees", lambda R: Rotation.from_rotvec(R.as_rotvec(degrees=True)))
    for by, low, back in SLIPPED:
        what = f"orientations one row too {low} in the table"
        yield Misreading(what, f"move their columns one row {back}", partial(_slipped, None, by))


def _slipped(joints: Any, by: int, points: Points) -> Points:
    """Return points with joint values of an index, or the orientations, of the row that is so many rows later."""
    q, turns = points.q.copy(), points.turns
    if joints is not None:
        q[joints] = np.roll(q[joints], -by, axis=0)
    elif turns is not None:
        turns = np.roll(turns, -by, axis=0)
    rows = np.arange(len(q))
    return replace(points, q=q, turns=turns).take(rows[:-by] if by > 0 else rows[-by:])


def _in_one_frame(points: Points) -> Points:
    """Return poses whose orientations are turned into the frame of the positions, by their turns from row to row."""
    if points.turns is None:
        return points
    flange = fit_points(replace(points, turns=None)).base @ forward_kinematics(points.robot, points.q)

    def turns(R: Array) -> Array:
        return scipy.spatial.transform.Rotation.from_matrix(R[1:] @ np.swapaxes(R[:-1], 1, 2)).as_rotvec()

    Q = proper(np.einsum("ni,nj->ij", turns(flange[:, :3, :3]), turns(points.turns)))
    return replace(points, turns=Q @ points.turns)


def _inverted(points: Points) -> Points:
    if points.turns is None:
        return points
    back = np.swapaxes(points.turns, 1, 2)
    return replace(points, y=-np.einsum("nij,nj->ni", back, points.y), turns=back)


def _of_rows(points: Points) -> Iterator[Misreading]:
    """Yield readings with joint values of other rows: shifted, one column or all, reversed, in the order of texts."""
    count, robot = len(points.row), points.robot
    for k, (by, low, back) in product(range(1, min(3, count - 6) + 1), SLIPPED):
        rows = f"{k} row{'s' * (k > 1)}"
        what = f"measured values {rows} too {low} in the table"
        remedy = f"move the measured values {rows} {back}, against the joint values"
        yield Misreading(what, remedy, partial(_slipped, ..., -k * by))
    for i, (by, low, back) in product(range(robot.dof), SLIPPED):
        what = f"the values of joint {robot.joint(i)} one row too {low} in the table"
        remedy = f"move the column of joint {robot.joint(i)} one row {back}"
        yield Misreading(what, remedy, partial(_slipped, (..., i), by))
    for by, low, back in SLIPPED if points.q.ndim > 2 and points.q.shape[1] > 1 else ():
        what = f"the joint values of the second point one row too {low} in the table"
        yield Misreading(what, f"move their columns one row {back}", partial(_slipped, np.s_[:, 1], by))

    def reordered(order: np.ndarray, points: Points) -> Points:
        return replace(points, q=points.q[order])

    what = "the rows of joint values in the reverse order"
    yield Misreading(what, "reverse the order of one of the two", partial(reordered, np.arange(count)[::-1]))
    by_text = np.array(sorted(range(count), key=lambda i: str(i + 1)))
    remedy = "join by a column that both have (rpim-opt new --data --data --key)"
    for which, order in (("measured", by_text), ("joint", np.argsort(by_text))):
        yield Misreading(f"{which} values sorted as text (1, 10, 11, 2)", remedy, partial(reordered, order))


def _apart(points: Points) -> Iterator[Misreading]:
    """Yield the reading with joint values of another time, on a cubic spline through the rows: clocks are apart."""
    place = np.arange(len(points.row))
    if len(place) < 2 * FEWEST:
        return
    path = scipy.interpolate.CubicSpline(place, points.q)

    def at(shift: float, points: Points) -> Points:
        return replace(points, q=path(place + shift))

    shift = 0.0
    for step in (0.1, 0.02, 0.004):
        near = (shift + step * np.arange(-9, 10)).tolist()
        shift = near[int(np.argmin(misfits([at(each, points) for each in near])))]
    what = f"joint values of {abs(shift):.2g} rows {'earlier' if shift < 0 else 'later'} (clocks apart)"
    yield Misreading(
        what, "correct the offset of the two clocks before joining, or measure at rest", partial(at, shift)
    )


def _factors(points: Points) -> Iterator[Misreading]:
    """Yield readings with a column, all angles or all lengths times a factor that fits: other units, counts, gears."""
    robot = points.robot
    eye = np.eye(robot.dof)
    scaled = {f"values of joint {robot.joint(i)}": ("q", eye[i]) for i in range(robot.dof)}
    turning = np.array(robot.joint_dimensions) == "angle"
    scaled |= {"all joint values": ("q", turning), LENGTHS_OF_ALL: ("y", np.ones(points.y.shape[1]))}
    if not points.lengths:
        scaled |= {f"column {axis}": ("y", of) for axis, of in zip("xyz", np.eye(3), strict=True)}

    def times(what: str, factor: float, points: Points) -> Points:
        name, of = scaled[what]
        return replace(points, **{name: getattr(points, name) * (1 + (factor - 1) * of)})

    few = points.evenly(FEW)
    factors = np.append(np.geomspace(1 / MOST_TIMES, MOST_TIMES, FACTORS), NEAR_ONE)
    size = misfits([times(what, factor, few) for what in scaled for factor in factors.tolist()])
    size = size.reshape(len(scaled), -1)
    for k in np.argsort(size.min(axis=1))[:FINER]:
        what, factor = list(scaled)[k], float(factors[np.argmin(size[k])])
        ratio = factors[1] / factors[0]
        while ratio > 1 + 1e-5:
            near = (factor * ratio ** np.linspace(-1, 1, 9)).tolist()
            factor = near[int(np.argmin(misfits([times(what, each, few) for each in near])))]
            ratio **= 0.25
        unit = min((*LENGTHS, *ANGLES), key=lambda each: abs(np.log(each / factor)))
        factor = unit if abs(factor / unit - 1) < 1e-3 else factor  # the nominal robot is not more exact
        remedy = f"multiply {what} by {factor:.5g}, or name the unit"
        if what == LENGTHS_OF_ALL:
            remedy += ", or check that the right robot is named: one of another size would explain the data as well"
        yield Misreading(f"{what} in another unit or scale", remedy, partial(times, what, factor))


def _orders(points: Points) -> Iterator[Misreading]:
    """Yield inverse poses, and all orders of up to six turning joints; of more, the reverse or one moved."""
    robot = points.robot
    mdh = robot.mdh
    if points.turns is None and not points.lengths:  # else all of a pose is inverted
        back = np.hstack([np.vstack([np.zeros(2), mdh[:0:-1, :2]]), mdh[::-1, 2:]])
        types, joint_map = robot.joint_types[::-1], robot.joint_map[::-1, ::-1]
        inverse = replace(robot, mdh=-back, joint_types=types, joint_map=joint_map)
        what = "inverse poses (the instrument in the reflector's frame)"
        yield Misreading(
            what, "invert them, with their orientations", lambda of: replace(of, robot=inverse, q=-of.q[..., ::-1])
        )
    joints = list(range(robot.dof))
    if len(set(robot.joint_dimensions)) > 1:
        return
    orders = permutations(joints)
    if robot.dof > 6:
        moved = (tuple(np.insert(np.delete(joints, i), place, i).tolist()) for i, place in permutations(joints, 2))
        orders = (tuple(joints[::-1]), *moved)
    for columns in orders:  # the columns that hold joints 1, 2, ...
        names = ", ".join(f"q{columns.index(i) + 1}" for i in joints)
        yield _joints(f"joints in the order {names}", f"name the columns {names}", np.eye(robot.dof)[list(columns)])


def _other_robots(points: Points) -> Iterator[Misreading]:
    """Yield other readings of the Denavit-Hartenberg table, and the ready robots with such joints."""
    robot = points.robot
    mdh = robot.mdh
    links = mdh[:, :2]
    standard = np.hstack([np.vstack([[0.0, 0.0], links[:-1]]), mdh[:, 2:]])
    convention = "a table in the {} Denavit-Hartenberg convention"
    distal, proximal = map(convention.format, ("standard (distal)", "modified (proximal)"))
    exchanged = mdh.copy()  # whose a stand one row lower
    exchanged[:, 1], exchanged[:, 3] = np.append(0.0, mdh[:-1, 3]), np.append(mdh[1:, 1], 0.0)
    tables = [
        (distal, "read it with --dh standard: alpha and a of every row belong to the next row", standard),
        ("columns a and d of the DH table exchanged", "exchange them", mdh[:, [0, 3, 2, 1, 4]]),
        ("columns a and d of the standard DH table exchanged", "exchange them", exchanged),
        ("alpha of the other sign in the DH table", "change the signs of alpha", mdh * [-1, 1, 1, 1, 1]),
    ]
    for last in (0.0, QUARTER, -QUARTER):  # which the other convention gives to the tool
        modified = np.hstack([np.vstack([links[1:], [last, 0.0]]), mdh[:, 2:]])
        tables.append(
            (proximal, "read it with --dh modified: alpha and a of every row belong to the row before", modified)
        )
    for (k, column), (by, low, back) in product(((0, "alpha"), (1, "a"), (3, "d")), SLIPPED):
        slipped = mdh.copy()
        slipped[:, k] = np.roll(mdh[:, k], -by)
        what = f"column {column} one row too {low} in the DH table"
        tables.append((what, f"move column {column} one row {back} in the DH table", slipped))
    for i in range(len(mdh) - 1):
        rows = np.insert(np.delete(np.arange(len(mdh)), i), i + 1, i)
        tables.append((f"rows {i + 1} and {i + 2} of the DH table exchanged", "exchange them", mdh[rows]))
    others = [(what, remedy, replace(robot, mdh=table)) for what, remedy, table in tables]
    ready = {name: read_robot(READY / f"{name}.toml") for name in robots()}
    others += [(f"the ready robot {name}", f'write robot = "{name}" in problem.toml', of) for name, of in ready.items()]
    for what, remedy, other in others:
        if (other.joint_types, other.dof) == (robot.joint_types, robot.dof):
            yield _with_robot(what, remedy, other)


# Which of these fits


def better_interpretation(problem: CalibrationProblem, whole: bool = True) -> Better | None:
    """Return the interpretation that fits far better than the table as written, or None.

    Single mistakes are tried first, then second and third ones behind the best of them; if the nominal model cannot be
    right, also all orders of up to six joints, and, unless the table is only a part (not ``whole``), the ready robots.
    Base or anchor and reflectors are fitted for every interpretation.
    """
    problem = of_sessions(problem)[0]
    points = points_of(problem) or lengths_of(problem)
    if points is None:
        return None
    mapping = None if explained(points) else search(points, problem)
    if mapping is not None and mapping.left <= UNEXPLAINED * points.extent:
        return _of_mapping(mapping)
    # with zeros fitted, as of every other reading, unless they only fit what is wrong with some rows
    present = min(float(misfits([points])[0]), misfit(points))
    if not np.isfinite(present):
        return None
    chain, left = _mistakes(points, present)
    for further in ((_factors, _apart, _other_robots), (_orders,)):
        if left >= BETTER * present and present > WRONG and not points.by_camera and whole:
            first = [each for readings in further for each in readings(points)]
            chain, left = _chain(points, present, first, BETTER * present, 2)
    fits = left < BETTER * present and (left <= LEFT or points.by_camera)
    if fits:  # F test of two fits with the same spare equations, times the choices: few rows fit some of them well
        equations = points.y.size if points.turns is None else 2 * points.y.size
        spare = max(equations - len(FRAME) - points.tools.size - max(points.robot.dof - 2, 0), 1)
        fits = bool(fdtr(spare, spare, (left / present) ** 2) * len(_readings(points)) ** len(chain) < RARE)
    if mapping is not None and not (fits and left * points.extent < mapping.left):
        return _of_mapping(mapping)
    if fits:
        return _told(points, chain, present, left)
    if points.by_camera or not whole:
        return None
    behind = _mapping_behind(points) if present > WRONG and not points.lengths else None
    return behind or sibling(problem)


def _chain(
    points: Points, stated: float, readings: list[Misreading], enough: float, most: int
) -> tuple[list[Misreading], float]:
    """Return the best reading, and behind it so many others at most, the best each time, until ``enough`` is left."""
    chain: list[Misreading] = []
    left = stated
    while len(chain) < most and left >= enough:
        each, size = _best(points, readings)
        if not size < FURTHER * left:
            break
        chain += each
        left = size
        points = each[0].change(points)
        readings = _readings(points)
    return chain, left


def _of_mapping(mapping: JointMapping) -> Better:
    """Return signs and zeros of joints in words, and a mirrored frame that explains the data as well."""
    words = mapping.explanations
    remedy = WRITE
    if mapping.mirrored:
        words = f"{MIRRORED.what}, or {words}"
        remedy = (
            f"change the sign of one coordinate (or exchange two), or {remedy}; a known direction in the "
            "instrument's frame (such as up) shows which"
        )
    return Better(words, remedy, mapping.nominal, mapping.left)


def _mapping_behind(points: Points) -> Better | None:
    """Return signs and zeros of joints behind a mirrored frame, a unit that makes points as wide, or a coupling."""
    robot = points.robot
    width = replace(points, y=forward_kinematics(robot, points.q)[:, :3, 3]).extent
    factor = min(LENGTHS, key=lambda each: abs(np.log(each * points.extent / width)))
    behind = [MIRRORED]
    if abs(np.log(factor * points.extent / width)) < abs(np.log(points.extent / width)):
        behind.append(_scaled(f"measured lengths {LENGTHS[factor][0]}", LENGTHS[factor][1], factor))
    stated = robot.joint_map
    apart = stated - np.eye(*stated.shape) * stated
    what, maps = "the coupling of the robot file with the opposite sign", [stated - 2 * apart] * bool(apart.any())
    if not maps and robot.leading[1:3] == (1, 2):  # FANUC's third joint counts from the horizontal
        from_horizontal = np.outer(np.eye(robot.dof)[2], np.eye(robot.dof)[1])
        what = f"joint {robot.joint(2)} coupled to joint {robot.joint(1)}"
        maps = [stated + from_horizontal, stated - from_horizontal]
    behind += [_with_robot(what, "", replace(robot, joint_map=each)) for each in maps]
    for each in behind:
        there = each.change(points)
        mapping = search(there)
        if mapping is not None:
            found = _of_mapping(mapping)
            remedy = each.remedy or coupling(there.robot.joint_map * mapping.sign)
            return found._replace(what=f"{each.what} and {found.what}", remedy=f"{remedy}; {found.remedy}")
    return None


def sibling(problem: CalibrationProblem) -> Better | None:
    """Return the ready robot of nearly the same parameters that fits far better, a UR10e for a UR10; or None."""
    problem = of_sessions(problem)[0]
    points = points_of(problem) or lengths_of(problem)
    if points is None or points.by_camera:
        return None
    own = misfit(points)
    for each in _other_robots(points):
        other = each.change(points)
        apart = np.abs(other.robot.mdh - points.robot.mdh)
        lengths = apart[:, [MDH.index("a"), MDH.index("d")]]  # of equal ones it is the same robot, with wrong zeros
        if lengths.max() > SAME_LENGTH and apart.max() < SIBLING and misfit(other) < SIBLING_BETTER * own:
            return Better(each.what, each.remedy, own * points.extent, misfit(other) * points.extent)
    return None


def _told(points: Points, chain: Sequence[Misreading], stated: float, left: float) -> Better:
    """Return a chain of mistakes in words, with what fits as well as the last: some differ by base and tool alone."""
    same = [*([each] for each in chain[:-1]), [chain[-1], *chain[-1].others]]
    what = " and ".join(", or ".join(each.what for each in alike) for alike in same)
    remedy = "; ".join(", or ".join(each.remedy for each in alike) for alike in same)
    return Better(what, remedy, stated * points.extent, left * points.extent)


def _mistakes(points: Points, stated: float) -> tuple[list[Misreading], float]:
    """Return the best of up to three mistakes together: each time the best one, else two of which none is the best."""
    readings = _readings(points)
    enough = min(BETTER * stated, WRONG)
    chain, best = _chain(points, stated, readings, enough, MISTAKES[points.by_camera])
    if stated > WRONG and not points.by_camera and best >= enough:
        # another unit of lengths alone may be no better, as that of angles beside it is wrong, too
        units = [i for i, each in enumerate(readings) if " lengths a thousand" in each.what]
        for i in dict.fromkeys([*units, *np.argsort(_tried(points, readings))[:12].tolist()]):
            changed = readings[i].change(points)
            others = [each for each in _readings(changed) if each.what != readings[i].what]
            second, left = _best(changed, others)
            if left < min(best, BETTER * stated):
                chain, best = [readings[i], *second], left
    if len(chain) > 1 and best > WRONG:  # of many pairs one always fits somewhat better
        chain = chain[:1]
        best = float(_tried(points, chain)[0])
    return chain, best


def _best(points: Points, readings: list[Misreading]) -> tuple[list[Misreading], float]:
    """Return the reading that fits best, if any does, and how badly; few rows choose whom more rows compare."""
    size = _tried(points, readings)
    least = float(size.min(initial=np.inf))
    if not np.isfinite(least):
        return [], float("inf")
    order = [i for i in np.argsort(size) if size[i] <= 2 * least][:8]
    near = [readings[i] for i in order]
    whole = size[order] if len(points.row) <= FEW else _tried(points, near, len(points.row))
    k = int(np.argmin(whole))
    same = [each for each, left in zip(near, whole, strict=True) if left <= SAME * whole[k]]
    return [near[k]._replace(others=tuple(each for each in same if each is not near[k])[:3])], float(whole[k])


def _tried(points: Points, readings: Sequence[Misreading], most: int = FEW) -> Array:
    """Return how badly readings fit, from so many rows."""
    tries = [each.change(points).evenly(most) for each in readings]
    own = np.array([each.robot is points.robot for each in tries], dtype=bool)  # of another one zeros are not fitted
    errors = np.full(len(readings), np.inf)
    for zeros in (True, False):
        errors[own == zeros] = misfits([tries[i] for i in np.flatnonzero(own == zeros)], zeros)
    return errors
