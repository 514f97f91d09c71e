"""The identified parameters of a problem: which they are by default, and the machine that they belong to."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import numpy as np

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.data.dataset import Dataset
from rpim_opt.problem.linear import LinearModel
from rpim_opt.robot.mdh import Robot
from rpim_opt.robot.parameters import Parameters

GEOMETRY = re.compile(r"(alpha|a|d|theta)\d+")
BASE = re.compile(r"base_.*")
PLACES = re.compile(r"(tool|anchor|length|plane|sphere|camera)_.*")
POINTS = re.compile(r"(anchor|length|plane|sphere)_.*|tool_(.*_)?[xyz]")
"""Parameters that ``identify = "auto"`` names: places, or of those what a measurement without orientations sees."""


@dataclass(frozen=True, eq=False, repr=False)
class Machine:
    """What positions are predicted from: the nominal robot, all its parameters, and a row of each kind of data.

    They are linear about the deviations ``at`` (n,) [SI], or about nominal; where a region is asked for, also those
    that move farthest at the deviations ``farthest`` (n,) [SI] are looked at. ``robot`` is None for several robots.
    """

    robot: Robot | None
    parameters: Parameters
    data: Dataset
    at: Array | None = None
    farthest: Array | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Identified(Parameters):
    """The n identified parameters of a problem.

    Parameters
    ----------
    machine
        That they belong to; None for a table alone.
    """

    machine: Machine | None = None


def require_robot(machine: Machine) -> Robot:
    """Return the machine's robot; InputError where there are several."""
    if machine.robot is None:
        raise InputError("positions", "several robots in one problem", "one robot: constraints of `problem.alone(...)`")
    return machine.robot


def identified_of(robot: Robot | None, parameters: Parameters, data: Dataset) -> Identified:
    """Return the identified parameters of a table, with the machine; of the data one row of each kind."""
    blocks = tuple(block.take(np.array([0]), np.array([i])) for i, block in enumerate(data.blocks))
    first = [int(block.row[0]) for block in data.blocks]
    labels = tuple(f"{data.label[row]}" for row in first)
    few = Dataset(blocks, labels, np.arange(len(blocks)))
    table = {each.name: getattr(parameters.free, each.name) for each in fields(Parameters)}
    return Identified(**table, machine=Machine(robot, parameters, few))


def around(model: LinearModel, x: Array | None, farthest: Array | None = None) -> LinearModel:
    """Return a linear model whose parameters predict positions linearly about deviations x (n,) [SI], or nominal.

    Positions of a region are also those that move farthest at ``farthest`` (n,) [SI], by default at x.
    """
    known = model.parameters
    if x is None or not isinstance(known, Identified) or known.machine is None:
        return model
    if farthest is None:
        farthest = x
    machine = replace(known.machine, at=x, farthest=farthest)
    return replace(model, parameters=replace(known, machine=machine))


def near_parallel(robot: Robot, within: float = 0.1) -> tuple[str, ...]:
    """Return Hayati's parameters that a robot needs: ``beta{i}`` where the axes of joints i and i+1 are near parallel.

    Two parallel revolute axes have no single common normal: d and theta then change without bound under a small
    tilt, and a rotation about y after joint i takes the tilt instead (Hayati 1983). ``within`` [rad] is how far
    from parallel an axis pair still counts.
    """
    return tuple(
        f"beta{i}"
        for i in range(1, robot.dof)
        if abs(np.sin(robot.mdh[i, 0])) < np.sin(within) and robot.joint_types[i - 1 : i + 1] == ("revolute",) * 2
    )


def identifiable(patterns: Iterable[str], robot: Robot, parameters: Parameters, data: Dataset) -> Iterable[str]:
    """Return patterns of parameters; ``"auto"`` stands for geometry, Hayati's beta where it is needed, and frames."""
    if patterns != "auto":
        return patterns
    kinds = [block.measurement for block in data.blocks]
    kept = [GEOMETRY]
    if any(kind.registers for kind in kinds):  # distances do not tell where the robot stands
        kept.append(BASE)
    kept.append(PLACES if any(kind.turning for kind in kinds) else POINTS)
    geometry, *places = ([name for name in parameters.names if kind.fullmatch(name)] for kind in kept)
    return [*geometry, *near_parallel(robot), *(name for names in places for name in names)]
