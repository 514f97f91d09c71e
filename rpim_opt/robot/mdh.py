"""The robot as its drawing says: a modified Denavit-Hartenberg table with Hayati's parameter."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError
from rpim_opt.basics.files import Angle, Length, Misfit, Table, read_toml, validate
from rpim_opt.basics.shown import Brief, shortened
from rpim_opt.basics.units import LARGEST, UNITS, accepted_units
from rpim_opt.robot.gravity import Gravity
from rpim_opt.robot.mounting import Mounting, PayloadTable, of_links, stated_gravity
from rpim_opt.robot.open_model import Model

MDH = ("alpha", "a", "theta", "d", "beta")
"""Columns of the table, in this order: Rot(x, alpha) Trans(x, a) Rot(z, theta) Trans(z, d) Rot(y, beta)."""

FARTHEST = 1e15
"""Size [m or rad] of a table's numbers: common normals of axes that are nearly parallel may be far away."""


@dataclass(frozen=True, eq=False, repr=False)
class Robot(Brief):
    """A serial arm.

    Link i moves frame i-1 to frame i by (Craig's convention; paper, Eq. 1)::

        Rot(x, alpha) Trans(x, a) Rot(z, theta + q) Trans(z, d) Rot(y, beta)      revolute
        Rot(x, alpha) Trans(x, a) Rot(z, theta) Trans(z, d + q) Rot(y, beta)      prismatic

    where q are the joint values of the model, ``joint_map @ (joint values of the controller)``.

    Parameters
    ----------
    name
        What to call it.
    mdh
        (dof, 5), columns alpha [rad], a [m], theta [rad], d [m], beta [rad].
    joint_types
        ``"revolute"`` or ``"prismatic"`` for every joint; all revolute by default.
    joint_map
        (dof, dof), the identity by default: signs and couplings between the controller's
        joint values and the model's (a FANUC counts joint 3 from the horizontal).
    limits
        (dof, 2) lower and upper joint values of the controller [rad or m]; infinite where unknown.
    source
        Where the table comes from.
    gravity
        Where gravity points in the robot's base, and the masses that it pulls at.
    model
        Terms of a user's own, by which it moves besides; `forward_kinematics` is of the table alone.

    Raises
    ------
    InputError
        For shapes that do not fit, numbers that are not finite, a singular joint map, limits that are not in order,
        masses that are not one a joint.

    Examples
    --------
    >>> import numpy as np
    >>> import rpim_opt as ro
    >>> mdh = np.array([[0, 0, 0, 0.5, 0], [0, 0.4, 0, 0, 0]])
    >>> lift = ro.robot.Robot("arm on a lift", mdh, ("prismatic", "revolute"))
    >>> lift.dof, lift.joint_dimensions
    (2, ('length', 'angle'))
    """

    name: str
    mdh: Array
    joint_types: tuple[str, ...] = ()
    joint_map: Array = field(default_factory=lambda: np.empty((0, 0)))
    limits: Array = field(default_factory=lambda: np.empty((0, 0)))
    source: str = ""
    gravity: Gravity = field(default_factory=Gravity)
    model: Model = field(default_factory=Model)

    def _short(self) -> str:
        return f"'{shortened(self.name)}', {self.dof} joints"

    def __post_init__(self) -> None:
        mdh = _frozen(self.mdh)
        if mdh.ndim != 2 or mdh.shape[1] != 5 or not len(mdh) or not np.isfinite(mdh).all():
            raise InputError("mdh", f"shape {mdh.shape}", "finite numbers of shape (dof, 5)", self.name)
        if np.abs(mdh).max() > FARTHEST:
            raise InputError("mdh", f"{np.abs(mdh).max():g}", f"sizes of at most {FARTHEST:g} m or rad", self.name)
        object.__setattr__(self, "mdh", mdh)
        object.__setattr__(self, "joint_types", self._types())
        object.__setattr__(self, "joint_map", self._map())
        object.__setattr__(self, "limits", self._limits())
        if len(self.gravity.masses) not in (0, self.dof):
            raise InputError("gravity", f"{len(self.gravity.masses)} masses", f"{self.dof}, one a joint", self.name)

    def _types(self) -> tuple[str, ...]:
        types = tuple(self.joint_types) or ("revolute",) * self.dof
        if len(types) != self.dof or not set(types) <= {"revolute", "prismatic"}:
            raise InputError("joint_types", repr(types), f"{self.dof} times revolute or prismatic", self.name)
        return types

    def _map(self) -> Array:
        n = self.dof
        joint_map = _frozen(self.joint_map if np.size(self.joint_map) else np.eye(n))
        sane = joint_map.shape == (n, n) and (np.abs(joint_map) <= LARGEST).all()
        if not sane or not abs(np.linalg.det(joint_map)) > 1e-9:
            raise InputError("joint_map", f"{joint_map.tolist()}", f"an invertible {n} x {n} matrix", self.name)
        return joint_map

    def _limits(self) -> Array:
        unlimited = np.tile([-np.inf, np.inf], (self.dof, 1))
        limits = _frozen(self.limits if np.size(self.limits) else unlimited)
        if limits.shape != (self.dof, 2) or not (limits[:, 0] < limits[:, 1]).all():
            raise InputError("limits", f"{limits.tolist()}", f"{self.dof} pairs lower < upper", self.name)
        return limits

    @property
    def dof(self) -> int:
        """Number of joints."""
        return len(self.mdh)

    @property
    def joint_dimensions(self) -> tuple[str, ...]:
        """``"angle"`` for a revolute joint, ``"length"`` for a prismatic one."""
        return tuple("angle" if kind == "revolute" else "length" for kind in self.joint_types)


def _frozen(values: ArrayLike) -> Array:
    array = np.array(values, dtype=float)
    array.setflags(write=False)
    return array


class _JointTable(Table):
    alpha: Angle = 0.0
    a: Length = 0.0
    theta: Angle = 0.0
    d: Length = 0.0
    beta: Angle = 0.0
    type: Literal["revolute", "prismatic"] = "revolute"
    sign: Literal[1, -1] = 1
    limits: Annotated[list[float] | None, "angle", "length"] = None
    mass: Annotated[float | None, "mass"] = None
    centre_x: Length = 0.0
    centre_y: Length = 0.0
    centre_z: Length = 0.0

    @model_validator(mode="before")
    @classmethod
    def _limits_fit_the_type(cls, table: Any) -> Any:
        if isinstance(table, dict):
            moves = "length" if table.get("type") == "prismatic" else "angle"
            wrong = [u for u, unit in UNITS.items() if f"limits_{u}" in table and unit.dimension != moves]
            if wrong:
                accepted = ", ".join(f"limits_{u}" for u in accepted_units(moves))
                raise Misfit(f"limits_{wrong[0]}", "a unit that does not fit the joint's type", accepted)
        return table


class _RobotTable(Table):
    name: str
    source: str = ""
    joint: list[_JointTable] = Field(min_length=1)
    coupling: list[list[Annotated[float, Field(strict=False)]]] | None = None
    mounting: Mounting | None = None
    payload: PayloadTable | None = None


def read_robot(path: str | Path) -> Robot:
    """Return the robot of a ``robot.toml`` file (its format: the guide "Your own robot").

    Raises
    ------
    InputError
        Naming the file, the key, what was found and what is accepted.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> ro.robot.write_robot(ro.load("paper_arm").problem.robot, "robot.toml")
    >>> ro.read_robot("robot.toml").mdh[1].round(4).tolist()  # alpha, a, theta, d, beta
    [1.5708, 0.0, 0.0, 0.107, 0.0]
    """
    path = Path(path)
    return robot_of(read_toml(path), path)


def robot_of(content: dict[str, Any], path: Path) -> Robot:
    """Return the robot that the keys of a ``robot.toml`` state, whatever file they come from."""
    table = validate(_RobotTable, content, path)
    return Robot(
        name=table.name,
        mdh=np.array([[getattr(joint, column) for column in MDH] for joint in table.joint]),
        joint_types=tuple(joint.type for joint in table.joint),
        joint_map=np.diag([float(joint.sign) for joint in table.joint]) @ _coupling(table, path),
        limits=_stated_limits(table, path),
        source=table.source,
        gravity=_gravity(table, path),
    )


def _gravity(table: _RobotTable, path: Path) -> Gravity:
    gravity = stated_gravity(Gravity(), table.mounting, table.payload, path)
    centres = [(joint.centre_x, joint.centre_y, joint.centre_z) for joint in table.joint]
    return of_links(gravity, [joint.mass for joint in table.joint], centres, path)


def _coupling(table: _RobotTable, path: Path) -> Array:
    dof = len(table.joint)
    if table.coupling is None:
        return np.eye(dof)
    if len(table.coupling) != dof or any(len(row) != dof for row in table.coupling):
        raise InputError("key coupling", f"{table.coupling}", f"{dof} rows of {dof} numbers", path)
    return np.array(table.coupling)


def _stated_limits(table: _RobotTable, path: Path) -> Array:
    limits = [joint.limits or [-np.inf, np.inf] for joint in table.joint]
    for number, pair in enumerate(limits, start=1):
        if len(pair) != 2 or not pair[0] < pair[1]:
            raise InputError(f"key joint {number}.limits", f"{pair}", "[lower, upper]", path)
    return np.array(limits, dtype=float)
