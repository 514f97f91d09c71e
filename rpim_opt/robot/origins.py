"""Origins of a URDF's joints as parameters: the same six numbers in every chain that a joint is part of."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.robot.kinematics import FRAME, placed, product
from rpim_opt.robot.terms import Joint, Symbol, Term

ORIGIN, MOUNT = "origin_", "mount_"
"""Prefixes of the parameters of joints that move, and of fixed joints at the ends of a chain."""
SCALES = {ORIGIN: ("1", "1"), MOUNT: ("10", "10")}
"""Expected sizes of their deviations [mm], [mrad]."""


class Origin(NamedTuple):
    """A joint's origin O, which becomes D O by six numbers in the frame of the joint's parent link."""

    prefix: str  # of its parameters, origin_torso_1_joint_
    frame: Array  # (4, 4) of the parent link in the frame behind the row that carries it
    up: bool  # whether the chain goes up through the joint


class Carried(NamedTuple):
    """The origins that stand behind a row (from 1) of a robot's table, in their order."""

    row: int
    origins: tuple[Origin, ...]


@dataclass(frozen=True, eq=False)
class Displaced(Term):
    """The term of `displaced`, with what it is made of."""

    carried: Carried = field(default_factory=lambda: Carried(1, ()))
    ready = True

    def __post_init__(self) -> None:
        """Check nothing: the names are those of frames."""

    def names(self, i: int) -> tuple[str, ...]:
        """Return the names of the parameters, which are the joints' and not the row's."""
        return tuple(entry.stem for entry in self.entries)


def origin_prefix(joint: str, moves: bool) -> str:
    """Return the prefix of a joint's parameters: ``origin_torso_1_joint_``, of a fixed one ``mount_..``."""
    return f"{ORIGIN if moves else MOUNT}{re.sub(r'[^0-9A-Za-z]+', '_', joint)}_"


def displaced(carried: Carried) -> Displaced:
    """Return the term of the origins behind a row of the table: all of them displace what follows, one by one.

    With F the parent link's frame behind the row, a joint that is passed down displaces by F D F^-1, one that is passed
    up by F D^-1 F^-1; D = Trans(x, y, z) Rot(rz) Rot(ry) Rot(rx) is zero's identity.
    """
    scales = {}
    for origin in carried.origins:
        length, angle = SCALES[ORIGIN if origin.prefix.startswith(ORIGIN) else MOUNT]
        for axis in FRAME:
            turn = axis.startswith("r")
            scales[f"{origin.prefix}{axis}_{'mrad' if turn else 'mm'}"] = float(angle if turn else length)
    return Displaced(partial(_moves, carried), scales, at="link", joints=(carried.row,), carried=carried)


def _moves(carried: Carried, link: Joint, *sizes: Symbol) -> Symbol:
    """Return the product of the displacements as six numbers."""
    T = ca.SX.eye(4)
    for k, (_, F, up) in enumerate(carried.origins):
        six = sizes[6 * k : 6 * k + 6]
        if not all(ca.SX(size).is_zero() for size in six):
            D = product(placed((0,) * 6, six))
            T = T @ F @ (_inverse(D) if up else D) @ np.linalg.inv(F)
    pitch = ca.atan2(-T[2, 0], ca.sqrt(T[0, 0] ** 2 + T[1, 0] ** 2))
    return ca.vertcat(T[:3, 3], ca.atan2(T[2, 1], T[2, 2]), pitch, ca.atan2(T[1, 0], T[0, 0]))


def _inverse(T: ca.SX) -> ca.SX:
    turned = T[:3, :3].T
    return ca.vertcat(ca.horzcat(turned, -turned @ T[:3, 3]), ca.horzcat(0, 0, 0, 1))


def carried_by(terms: Sequence[Term]) -> tuple[Carried, ...]:
    """Return the origins among a robot's terms."""
    return tuple(term.carried for term in terms if isinstance(term, Displaced))
