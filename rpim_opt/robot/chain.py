"""Conversion of serial chains to modified DH with Hayati's beta, and of identified parameters back to their frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import casadi as ca
import numpy as np
import scipy

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.text import joined
from rpim_opt.robot.kinematics import FRAME, forward_kinematics, frame, frame_numbers, numeric_frame, numeric_link
from rpim_opt.robot.mdh import MDH, Robot, numbered
from rpim_opt.robot.terms import Joint, Symbol, Term

NEAR_PARALLEL = 0.35
"""Axes closer to parallel than this [rad] get Hayati's beta, as `problem.near_parallel` proposes.

An axis error moves the common normal, and with it d and theta of both joints, 1 / sin(angle) times as much: above a
factor of 3 prior scales would be wrong (axes 10 degrees apart, five simulated sets: errors of 0.18 to 0.53 mm with beta
= 0, 0.14 to 0.20 mm with beta).
"""
ANOTHER_ARM = 0.1  # a robot whose parameters deviate by more than this [m or rad] from a file's is not the file's
ORIGIN, MOUNT = OF_JOINTS = "origin_", "mount_"
"""Prefixes of the parameters of joints that move, and of fixed joints at the ends of a chain."""
ORIGIN_SCALES = {ORIGIN: 1.0, MOUNT: 10.0}  # prior standard deviations of their deviations [mm and mrad]
SAME_PLACE = (0.01, 0.1)  # frames closer than this [m], [rad] count as the same frame


@dataclass(frozen=True, eq=False)
class RobotSetup:
    """A robot with its base and tool frames; the tip of a file is at base @ MDH chain(q) @ tool."""

    robot: Robot
    base: Array = field(default_factory=partial(np.zeros, 6))  # x, y, z [m], roll, pitch, yaw [rad], R = Rz Ry Rx
    tool: Array = field(default_factory=partial(np.zeros, 6))
    names: tuple[str, ...] = ()  # of the joints in the file
    notes: tuple[str, ...] = ()  # sentences on what was left out of the file


@dataclass(frozen=True, eq=False)
class Chain:
    """Joints about axes of their own frames: O_1 J_1(q_1) O_2 J_2(q_2) ... O_n J_n(q_n) tail."""

    origins: Array  # (n, 4, 4) from the frame of joint i-1 to that of joint i at rest
    axes: Array  # (n, 3) unit vectors that the joints turn about or move along
    tail: Array  # (4, 4) from the last joint's frame to the tip

    @classmethod
    def about_z(cls, origins: Sequence[Array], tail: Array) -> Chain:
        """Return a chain whose axes are all z."""
        return cls(np.array(origins), np.tile([0.0, 0.0, 1.0], (len(origins), 1)), tail)


def same_place(one: Array, other: Array) -> bool:
    """Return whether two frames (6,) are within `SAME_PLACE`."""
    T = np.linalg.inv(numeric_frame(one)) @ numeric_frame(other)
    angle = scipy.spatial.transform.Rotation.from_matrix(T[:3, :3]).magnitude()
    return bool(np.linalg.norm(T[:3, 3]) < SAME_PLACE[0] and angle < SAME_PLACE[1])


def placed(place: Array) -> str:
    """Return a frame (6,) as text, to a micrometre 6 m away."""
    values = [f"{value:z.3f}" for value in 1e3 * place[:3]] + [f"{value:z.5f}" for value in np.degrees(place[3:])]
    return f"{' '.join(map(' '.join, zip(FRAME, values, strict=True)))} mm, deg (roll, pitch, yaw)"


def describe(
    chain: Chain, near: Array | None = None, parallel: float = NEAR_PARALLEL
) -> tuple[Array, Array, Array, Array]:
    """Return the MDH table (n, 5), base (4, 4), tool (4, 4), and the transforms from the chain's frames to the table's.

    Joint i+1 is reached from joint i by Rot(z, theta_i) Trans(z, d_i) Rot(y, beta_i) Rot(x, alpha_i+1)
    Trans(x, a_i+1): six numbers for a line have one degree of freedom to spare. Where the axes cross at more than
    ``parallel`` [rad], beta_i = 0 and x is the common normal (Craig). Otherwise d_i = 0 and x is the perpendicular
    from frame i's origin to the next axis, which beta_i tilts out of the plane (Hayati 1983): every number stays
    finite and changes little with the axes. Of the two directions of x the one nearer to theta_i = 0 is taken.

    The z axis of the base is the first joint axis, its origin the point of that axis next to the chain's origin; if the
    first axis is the chain's own z axis, the base is the identity. The last MDH frame is that of the last joint, turned
    so that z is its axis. ``near`` (n, 5) is a table to stay close to: it decides the full turns of theta, the sign of
    alpha and, between parallel axes, d. The fourth result, G (n, 4, 4), is constant: frame of joint i = MDH frame i
    before its Rot(y, beta_i), times G_i.
    """
    n = len(chain.axes)
    near = np.zeros((n, 5)) if near is None else near
    table = np.zeros((n, 5))
    G = np.zeros((n, 4, 4))
    turns = np.array([_to_axis(axis) for axis in chain.axes])
    start = chain.origins[0] @ turns[0]
    coaxial = np.abs(start[:2, 2:]).max() < 1e-12 and start[2, 2] > 0
    # C_i commutes with joint i's motion: Rot(z) Trans(z)
    C = np.linalg.inv(start) if coaxial else numeric_link(d=-start[:3, 2] @ start[:3, 3])
    base = np.eye(4) if coaxial else start @ C
    for i in range(n - 1):
        step = turns[i].T @ chain.origins[i + 1] @ turns[i + 1]
        theta, d, beta, alpha, a = _step(np.linalg.inv(C) @ step, near[i : i + 2], parallel)
        table[i, 2:] = theta, d, beta
        table[i + 1, :2] = alpha, a
        G[i] = np.linalg.inv(C @ numeric_link(theta=theta, d=d)) @ turns[i].T
        C = np.linalg.inv(step) @ C @ numeric_link(theta=theta, d=d, beta=beta) @ numeric_link(alpha=alpha, a=a)
    table[-1, 2:4] = _turned(-np.arctan2(C[1, 0], C[0, 0]), near[-1, 2]), -C[2, 3]
    G[-1] = turns[-1].T
    return table + 0.0, base, turns[-1].T @ chain.tail, G


def corrected(
    chain: Chain, table: Array, base: Array | None = None, tool: Array | None = None
) -> tuple[list[Array], Array, float]:
    """Return the origins and tail of a chain for another MDH table (n, 5), base and tool (6,), and the arm's length.

    With the MDH frame i before Rot(y, beta_i) times G_i as the frame of joint i, as in `describe`::

        O_i  = G_i-1^-1 Rot(y, beta_i-1) Rot(x, alpha_i) Trans(x, a_i) Rot(z, theta_i) Trans(z, d_i) G_i
        tail = G_n^-1 Rot(y, beta_n) tool

    (O_1 with the base in place of G_0^-1.) An error in the zero or place of joint i moves the frame of link i. By
    default base and tool are the chain's. The length [m] is that of the stretched arm, at least 1 m.
    """
    _, T_base, T_tool, G = describe(chain)
    T_base = T_base if base is None else numeric_frame(base)
    T_tool = T_tool if tool is None else numeric_frame(tool)
    before = [T_base, *(np.linalg.inv(g) @ numeric_link(beta=row[4]) for g, row in zip(G, table, strict=True))]
    origins = [b @ numeric_link(*row[:4]) @ g for b, row, g in zip(before[:-1], table, G, strict=True)]
    ends = sum(float(np.linalg.norm(T[:3, 3])) for T in (T_base, T_tool))
    return origins, before[-1] @ T_tool, max(float(np.abs(table[:, 1::2]).sum()) + ends, 1.0)


def require_same_arm(robot: Robot, original: Robot, file: Path) -> list[str]:
    """Refuse a robot whose joints or nominal parameters differ from those of a file, apart from zeros of joints.

    Return sentences on joint values that the file cannot express (`joint_values`), and on zeros moved into origins.
    """
    if robot.joint_types != original.joint_types:
        found, accepted = ", ".join(robot.joint_types), f"those of the file, {', '.join(original.joint_types)}"
        raise InputError("joints of the robot", found, accepted, file)
    notes = joint_values(robot, original, file)
    deviation = robot.mdh - original.mdh
    deviation[:, ::2] = np.angle(np.exp(1j * deviation[:, ::2]))
    zeros = []
    for i, kind in enumerate(original.joint_types):
        column, unit, size = (2, "deg", np.pi / 180) if kind == "revolute" else (3, "mm", 1e-3)
        if abs(deviation[i, column]) > ANOTHER_ARM:
            zeros.append(f"joint {numbered(i, original.joint_names)} by {deviation[i, column] / size:+.3f} {unit}")
            deviation[i, column] = 0.0
    joint, column = np.unravel_index(np.argmax(np.abs(deviation)), deviation.shape)
    if abs(deviation[joint, column]) > ANOTHER_ARM:
        unit = "rad" if column % 2 == 0 else "m"
        found = f"{MDH[column]}{joint + 1} differs from the file by {abs(deviation[joint, column]):.3g} {unit}"
        accepted = "the file that the calibration began with, between the same links"
        raise InputError(f"robot ({robot.source or robot.name})", found, accepted, file)
    if zeros:
        notes.append(
            f"{file.name}: joint zeros differ from the original's, within the joints' origins: {joined(zeros)}. Joint "
            "values need no correction for them; limits and named poses refer to the new zeros."
        )
    return notes


def joint_values(robot: Robot, original: Robot, file: Path) -> list[str]:
    """Return a sentence on how the values of a file's joints follow from the controller's, if they differ.

    With F (n, k) the joint map of the file and M that of the robot they are S q, F S = M; refused if S does not exist.
    """
    S = np.round(np.linalg.pinv(original.joint_map) @ robot.joint_map, 12)
    wrong = np.flatnonzero(np.abs(original.joint_map @ S - robot.joint_map).max(axis=1) > 1e-9)
    if len(wrong):
        found = f"a sign or coupling of joint {joined([str(i + 1) for i in wrong])}, which follows another in the file"
        raise InputError("joints of the robot", found, "joints that follow others as in the file", file)
    places = []
    for i in np.flatnonzero((np.eye(*S.shape) != S).any(axis=1)):
        terms = [f"{S[i, j]:+.9g} q{j + 1}" for j in np.flatnonzero(S[i])]
        places.append(f"joint {original.joint(i)} is at {' '.join(terms)}")
    if not places:
        return []
    return [f"{file.name}: for joint values q of the calibration, its {joined(places)}; the file cannot express this."]


def without_beta(robot: Robot) -> Robot:
    """Return the same arm in four numbers per joint: every Hayati parameter zero, common normals throughout.

    Between nearly parallel axes the common normal, and with it d of both joints, may be hundreds of metres away.
    Refused are a beta after the last joint, and axes so parallel that the four numbers lose more than 1e-9 m or rad.
    """
    table = robot.mdh
    if table[-1, 4]:
        raise InputError("robot", f"beta{len(table)} = {table[-1, 4]:g} rad", "0, with that rotation in the tool")
    before = np.append(0.0, table[:-1, 4])
    origins = [numeric_link(beta=b) @ numeric_link(*row[:4]) for b, row in zip(before, table, strict=True)]
    origins[0] = numeric_link(theta=table[0, 2], d=table[0, 3])  # alpha1 and a1 stay as they are
    plain = describe(Chain.about_z(origins, np.eye(4)), table, 1e-10)[0]
    plain[0, :2] = table[0, :2]
    plain[:, 4] = 0.0
    result = replace(robot, mdh=plain)
    q = np.random.default_rng(0).uniform(-1, 1, (20, robot.dof))
    lost = float(np.abs(forward_kinematics(result, q) - forward_kinematics(robot, q)).max())
    if lost > 1e-9:
        raise InputError("robot", f"nearly parallel axes (error {lost:.1g} m or rad)", "a table with beta", robot.name)
    return result


def standard_table(robot: Robot) -> Array:
    """Return the numbers (n, 5) of the same arm in the standard convention, from axis 1 to the same last frame.

    They are those of Rot(z, theta) Trans(z, d) Trans(x, a) Rot(x, alpha) Rot(y, beta), in the columns of `MDH`: without
    betas, alpha and a one row earlier; with betas, the modified table of the inverse chain, last joint first.
    """
    table = robot.mdh.copy()
    table[:, :2] = np.vstack([robot.mdh[1:, :2], np.zeros(2)])
    if table[:-1, 4].any():
        links = [numeric_link(theta=row[2], d=row[3]) @ numeric_link(beta=row[4]) for row in robot.mdh]
        steps = [link @ numeric_link(*row[:2]) for link, row in zip(links, robot.mdh[1:], strict=False)]
        near = -table[::-1]
        near[0] = 0.0  # the last link is what follows the chain
        inverse = Chain.about_z([np.eye(4), *np.linalg.inv(steps[::-1])], np.eye(4))
        found = -describe(inverse, near)[0][::-1]
        table[:-1] = np.column_stack([found[:-1, :2], found[:-1, 2:4], found[1:, 4]])
        table[-1, 2:4] += found[-1, 2:4]
    return table + 0.0


def _to_axis(axis: Array) -> Array:
    """Return the smallest turn (4, 4) that takes z to a unit vector."""
    v = np.cross([0.0, 0.0, 1.0], axis)
    s = float(np.linalg.norm(v))
    turn = v / s if s > 0 else np.array([1.0, 0.0, 0.0])  # to -z: about x
    T = np.eye(4)
    T[:3, :3] = scipy.spatial.transform.Rotation.from_rotvec(np.arctan2(s, axis[2]) * turn).as_matrix()
    return T


def _step(M: Array, near: Array, parallel: float) -> tuple[float, float, float, float, float]:
    """Return theta, d, beta, alpha, a that reach the z axis of M, as in `describe`, near those of two rows (2, 5)."""
    theta0, d0, alpha0 = near[0, 2], near[0, 3], near[1, 0]
    v = M[:3, 2]
    p = M[:3, 3]
    sine = np.hypot(v[0], v[1])
    if sine > np.sin(parallel):
        x = np.array([-v[1], v[0], 0.0]) / sine
        d = p[2] + v[2] * (-p[:2] @ v[:2]) / sine**2
        a = p @ x
    else:
        d = d0
        foot = p - [0, 0, d]
        foot = foot - (foot @ v) * v
        a = float(np.linalg.norm(foot))
        a, x = (a, foot / a) if a > 1e-11 else (0.0, np.array([np.cos(theta0), np.sin(theta0), 0.0]))
        x = x - (x @ v) * v  # a short a leaves x inexact
        x = x / np.linalg.norm(x)
    # cos(theta - theta0) + sin(alpha) sin(alpha0): after parallel axes any theta is possible, only alpha is certain
    if x[:2] @ [np.cos(theta0) - v[1] * np.sin(alpha0), np.sin(theta0) + v[0] * np.sin(alpha0)] < -1e-9:
        x = -x
        a = -a
    theta = np.arctan2(x[1], x[0])
    beta = np.arctan2(-x[2], np.hypot(x[0], x[1]))
    w = np.linalg.inv(numeric_link(theta=theta, beta=beta))[:3, :3] @ v
    return _turned(theta, theta0), float(d), float(beta), float(np.arctan2(-w[1], w[2])), float(a)


def _turned(angle: float, near: float) -> float:
    """Return the angle plus the full turns that bring it nearest to another."""
    return float(angle + 2 * np.pi * np.round((near - angle) / (2 * np.pi)))


# Numbers in the files of robots

ROUNDING = 1e-14  # of numbers of an arm of a metre, and of an angle's cosine


def spliced(data: bytes, edits: dict[tuple[int, int], str]) -> bytes:
    """Return ``data`` with the bytes from start to end replaced by texts, everything else as it was."""
    for (start, end), text in sorted(edits.items(), reverse=True):
        data = data[:start] + text.encode() + data[end:]
    return data


def origin_numbers(T: np.ndarray, old: Array, size: float) -> tuple[str | None, str | None]:
    """Return an origin's new xyz and rpy as texts that read back exactly; None for unchanged ones."""
    six = frame_numbers(T) + 0.0  # no negative zeros
    texts = [" ".join(repr(float(v)) for v in part) for part in (six[:3], six[3:])]
    moved = np.abs(T[:3, 3] - old[:3, 3]).max() > ROUNDING * size
    turned = np.abs(T[:3, :3] - old[:3, :3]).max() > ROUNDING
    return texts[0] if moved else None, texts[1] if turned else None


# Origins as parameters: the same six numbers in every chain that a joint is part of


class Origin(NamedTuple):
    """A joint's origin O, which becomes D O by six numbers in the frame of the joint's parent link."""

    prefix: str  # of its parameters: origin_torso_1_joint_
    frame: Array  # (4, 4) of the parent link in the frame behind the row that carries it
    up: bool  # whether the chain passes the joint from child to parent


class RowOrigins(NamedTuple):
    """The origins after a row (from 1) of a robot's table, in order."""

    row: int
    origins: tuple[Origin, ...]


def origins_term(carried: RowOrigins) -> Term:
    """Return the term of the origins after a row of the table, which displace the following frames in order.

    With F the parent link's frame behind the row, a joint passed from parent to child displaces by F D F^-1, one passed
    from child to parent by F D^-1 F^-1; D = Trans(x, y, z) Rot(rz) Rot(ry) Rot(rx).
    """
    units = dict(zip(FRAME, ("mm",) * 3 + ("mrad",) * 3, strict=True))
    scales = {}
    for origin in carried.origins:
        scale = ORIGIN_SCALES[ORIGIN if origin.prefix.startswith(ORIGIN) else MOUNT]
        scales |= {f"{origin.prefix}{axis}_{unit}": scale for axis, unit in units.items()}
    return Term(partial(_moves, carried), scales, at="link", joints=(carried.row,), made_of=carried)


def _moves(carried: RowOrigins, _link: Joint, *sizes: Symbol) -> Symbol:
    """Return the product of the displacements as six numbers."""
    T = ca.SX.eye(4)
    for k, (_, F, up) in enumerate(carried.origins):
        six = sizes[6 * k : 6 * k + 6]
        if not all(ca.SX(size).is_zero() for size in six):
            D = frame((0,) * 6, six)
            T = T @ F @ (_inverse(D) if up else D) @ np.linalg.inv(F)
    pitch = ca.atan2(-T[2, 0], ca.sqrt(T[0, 0] ** 2 + T[1, 0] ** 2))
    return ca.vertcat(T[:3, 3], ca.atan2(T[2, 1], T[2, 2]), pitch, ca.atan2(T[1, 0], T[0, 0]))


def _inverse(T: ca.SX) -> ca.SX:
    turned = T[:3, :3].T
    return ca.vertcat(ca.horzcat(turned, -turned @ T[:3, 3]), ca.horzcat(0, 0, 0, 1))


def row_origins(terms: Sequence[Term]) -> tuple[RowOrigins, ...]:
    """Return the origins among a robot's terms."""
    return tuple(term.made_of for term in terms if isinstance(term.made_of, RowOrigins))
