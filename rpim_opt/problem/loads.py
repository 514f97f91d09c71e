"""What joints bear in a row: measured torques, a payload, directions of approach; and whether gravity is needed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import casadi as ca
import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Block, Dataset
from rpim_opt.robot.deflection import Statics
from rpim_opt.robot.gravity import Gravity
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.open_model import asked_by
from rpim_opt.robot.parameter_names import of_term
from rpim_opt.robot.parameters import Parameters
from rpim_opt.robot.posture import Posture, Symbol


class Loads(NamedTuple):
    """What the rows of a block state of their joints, which decides the functions that evaluate them.

    ``gravity`` is None where no parameter asks for it; ``weighs`` tells that its torques stand for measured ones;
    ``columns`` are those that a user's own terms and measurement see.
    """

    torques: bool = False
    payload: bool = False
    approach: bool = False
    gravity: Gravity | None = None
    weighs: bool = False
    columns: tuple[str, ...] = ()

    def symbols(self, dof: int, points: int) -> Stated:
        """Return the symbols of a row of some points: empty for what it does not state."""
        joints = dof * points
        return Stated(
            q=ca.SX.sym("q", joints),
            torque=ca.SX.sym("tau", joints * self.torques),
            payload=ca.SX.sym("payload", int(self.payload)),
            approach=ca.SX.sym("approach", joints * self.approach),
            columns=ca.SX.sym("columns", len(self.columns)),
        )

    def posture(
        self, joint_types: Sequence[str], nominal: Callable[[str], Symbol], stated: Stated, point: int = 0
    ) -> Posture:
        """Return what the joints of an arm of nominal parameters see at a point of a row, from the row's symbols."""
        dof = len(joint_types)
        at = slice(point * dof, (point + 1) * dof)
        q = ca.vertsplit(stated.q[at])
        torque = None
        if self.torques:
            torque = ca.vertsplit(stated.torque[at])
        elif not self.weighs:
            torque = [0.0] * dof
        weight = None
        if self.gravity is not None:
            weight = Statics(joint_types, q, nominal, self.gravity, stated.payload if self.payload else None)
        directions = None
        if self.approach:
            directions = ca.vertsplit(stated.approach[at])
        return Posture(q, torque, directions, weight, self.named(stated))

    def named(self, stated: Stated) -> dict[str, Symbol]:
        """Return the symbols of columns by name."""
        return {name: stated.columns[i] for i, name in enumerate(self.columns)}


class Stated(NamedTuple):
    """The symbols of what a row states of its joints, in the order in which `columns` lays it side by side.

    ``q``, ``torque`` and ``approach`` are (dof x points, 1), point by point; ``payload`` (1, 1), ``columns`` (c, 1).
    """

    q: ca.SX
    torque: ca.SX
    payload: ca.SX
    approach: ca.SX
    columns: ca.SX


class Needs(NamedTuple):
    """What the parameters that are identified, or not zero, need to know of a row."""

    torques: bool
    moments: bool
    payload: bool
    columns: frozenset[str]

    @classmethod
    def of(cls, robot: Robot, parameters: Parameters) -> Needs:
        """Return what a robot with a table of parameters needs."""
        used = parameters.identified | (parameters.nominal != 0)
        names = {parameters.names[i] for i in np.flatnonzero(used)}
        terms = [name for name in names if of_term(name)]
        asked = asked_by(robot.model, robot.joint_types, names.__contains__)
        return cls(
            torques=asked.torques or any(name.startswith("compliance") for name in terms),
            moments=asked.gravity or any(name.startswith("bend") for name in terms),
            payload=asked.gravity,
            columns=asked.columns,
        )


def measured_torques(data: Dataset, robot: str = "") -> bool:
    """Return whether data of a robot state torques: then those of gravity stand for none of them."""
    return any(block.torque is not None for block in data.blocks if block.robot == robot)


def loads_of(robot: Robot, needs: Needs, data: Dataset, block: Block) -> Loads:
    """Return what the rows of a block of some data state, and what they need of gravity."""
    weighs = needs.torques and not measured_torques(data, block.robot)
    return Loads(
        torques=block.torque is not None,
        payload=block.payload is not None,
        approach=block.approach is not None,
        gravity=robot.gravity if weighs or needs.moments else None,
        weighs=weighs,
        columns=tuple(block.columns),
    )


def loads_on(robot: Robot, parameters: Parameters, data: Dataset, torques: bool) -> Loads:
    """Return what commands state that are to be compensated: torques, or a payload where those of gravity count."""
    needs = Needs.of(robot, parameters)
    if needs.columns:
        accepted = "a calibration without it: nothing says what it will be where commands are to be corrected"
        raise InputError("compensation", f"a term that sees column '{min(needs.columns)}'", accepted)
    weighs = needs.torques and not measured_torques(data)
    gravity = robot.gravity if weighs or needs.moments else None
    return Loads(torques=torques, payload=weighs or needs.payload, gravity=gravity, weighs=weighs)


def columns(robot: Robot, block: Block, part: slice) -> list[Array]:
    """Return what some rows state of their joints, side by side, about the joints of the model."""
    N = len(block.y[part])
    found = []
    if block.torque is not None:  # virtual work: tau_model = M^-T tau
        found.append((block.torque[part] @ np.linalg.inv(robot.joint_map)).reshape(N, -1))
    if block.payload is not None:
        found.append(block.payload[part].reshape(N, 1))
    if block.approach is not None:
        found.append(np.sign(block.approach[part] @ robot.joint_map.T).reshape(N, -1))
    return [*found, *(values[part].reshape(N, 1) for values in block.columns.values())]


def require_loads(robot: Robot, parameters: Parameters, data: Dataset) -> None:
    """Refuse to identify from data of a robot what needs columns that they do not have."""
    free = parameters.free.names
    sided = [name for name in free if (name.startswith("backlash") and of_term(name)) or _sees_approach(robot, name)]
    if sided and all(block.approach is None for block in data.blocks):
        found = f"'{sided[0]}' without directions of approach"
        raise InputError("key identify", found, "columns approach1, ... (-1, 0 or +1) in the data")
    needed = Needs.of(robot, parameters).columns
    for block in data.blocks:
        for name in sorted({*needed, *block.measurement.extra} - {*block.columns}):
            accepted = f"a column '{name}' of the table, or Dataset.of(..., columns={{'{name}': ...}})"
            raise InputError("data", f"no column '{name}', which a term or a measurement sees", accepted)


def _sees_approach(robot: Robot, name: str) -> bool:
    if not robot.model.terms:
        return False
    return asked_by(robot.model, robot.joint_types, lambda other: other == name).approach


def require_same_torques(robot: Robot, parameters: Parameters, data: Dataset, measured: bool) -> None:
    """Refuse torques of another kind than those of a problem's data, ``measured`` or not, where compliances need them.

    Without measured torques a compliance multiplies those of gravity, on masses that may be a guess.
    """
    if not Needs.of(robot, parameters).torques or measured_torques(data) == measured:
        return
    where = "compliances"
    if measured:
        accepted = "none, as in the problem's data: its compliances multiply the torques of gravity"
        raise InputError(where, "joint torques", accepted)
    raise InputError(where, "data without joint torques", "columns tau1_Nm, ..., as in the problem's data")


def bearing(
    data: Dataset,
    like: Dataset,
    torque: Array | None = None,
    payload: float | Array | None = None,
    columns: Mapping[str, Array] = MappingProxyType({}),
) -> Dataset:
    """Return rows of one point in one block with what their joints bear.

    Directions of approach are not known, 0, where the data of a problem ``like`` these state them: the joints are in
    the middle of their backlash.

    Parameters
    ----------
    data
        The rows.
    like
        Data of the problem whose rows these are to be.
    torque
        (N, dof) joint torques [Nm].
    payload
        Mass at the flange [kg], one or (N,).
    columns
        Further columns by name [SI], one number or (N,).
    """
    (block,) = data.blocks
    if torque is not None:
        torque = np.reshape(np.asarray(torque, dtype=float), (len(data), 1, -1))
    if payload is not None:
        payload = np.broadcast_to(np.asarray(payload, dtype=float), (len(data),))
    approach = None
    if any(each.approach is not None for each in like.blocks):
        approach = np.zeros(block.q.shape)
    known = {name: np.broadcast_to(np.asarray(values, dtype=float), len(data)) for name, values in columns.items()}
    block = replace(block, torque=torque, payload=payload, approach=approach, columns=known)
    return replace(data, blocks=(block,))


def repeatable(block: Block) -> Array:
    """Return what is the same (N, c) in rows that read the same thing again: joint values, and what a model sees else.

    >>> import rpim_opt as ro
    >>> from rpim_opt.problem.loads import repeatable
    >>> repeatable(ro.load("paper_arm").problem.data.blocks[0]).shape
    (9, 6)
    """
    seen = [block.columns[name][:, None] for name in block.measurement.sees if name in block.columns]
    return np.hstack([block.q.reshape(len(block.row), -1), *seen])
