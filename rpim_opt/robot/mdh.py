"""The nominal robot: a modified Denavit-Hartenberg table with Hayati's parameter, joints, limits and gravity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from rpim_opt.basics.arrays import Array, finite_numbers
from rpim_opt.basics.exceptions import InputError, choices
from rpim_opt.basics.text import Brief, shortened
from rpim_opt.basics.units import LARGEST
from rpim_opt.robot.terms import Model

MDH = ("alpha", "a", "theta", "d", "beta")
"""Columns of the table, in this order: Rot(x, alpha) Trans(x, a) Rot(z, theta) Trans(z, d) Rot(y, beta)."""
MDH_DIMENSION = {"alpha": "angle", "a": "length", "theta": "angle", "d": "length", "beta": "angle"}
FARTHEST = 1e15  # largest number of a table [m or rad]: common normals of nearly parallel axes may be far away
STANDARD = 9.80665  # standard acceleration of free fall [m/s^2]
Vector = tuple[float, float, float]
MOUNTINGS: dict[str, Vector] = {"floor": (0.0, 0.0, -1.0), "ceiling": (0.0, 0.0, 1.0), "wall": (-1.0, 0.0, 0.0)}
"""Where gravity points in the robot's base; on a wall the base's x axis points up."""


@dataclass(frozen=True)
class Gravity:
    """Gravity on a robot.

    ``direction`` is that of gravity in the robot's base frame (frame 0 of the table), normalized to a unit vector.
    ``masses`` are those of links 1 to dof [kg], ``centres`` their centres of mass in the link frames (frame i follows
    joint i) [m]. Without masses, 5 kg at the origin of the last frame and 10 kg at that of frame 4 are assumed:
    compliance absorbs the size of a torque, and only its dependence on the configuration matters. ``payload`` [kg] is
    an additional mass at ``payload_centre`` [m] in the flange frame. InputError for a zero direction, negative masses,
    and numbers that are not finite or do not fit together.

    >>> import rpim_opt as ro
    >>> ro.robot.Gravity(direction=(0, 0, -9.81), payload=2.5).direction
    (0.0, 0.0, -1.0)
    >>> ro.robot.Gravity().mounted("ceiling").carrying(1.5, (0, 0, 0.1)).payload_centre
    (0.0, 0.0, 0.1)
    """

    direction: Vector = (0.0, 0.0, -1.0)
    masses: tuple[float, ...] = ()
    centres: tuple[Vector, ...] = ()
    payload: float = 0.0
    payload_centre: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        object.__setattr__(self, "direction", _unit(self.direction, "direction of gravity"))
        object.__setattr__(self, "masses", tuple(_mass(mass, "mass of a link") for mass in self.masses))
        object.__setattr__(self, "centres", tuple(_vector(each, "centre of a link's mass") for each in self.centres))
        object.__setattr__(self, "payload", _mass(self.payload, "payload"))
        object.__setattr__(self, "payload_centre", _vector(self.payload_centre, "centre of the payload"))
        if len(self.centres) != len(self.masses):
            found = f"{len(self.masses)} masses, {len(self.centres)} centres"
            raise InputError("gravity", found, "one centre per mass")

    def mounted(self, mounting: str | Sequence[float], base: ArrayLike | None = None) -> Gravity:
        """Return the same masses on a robot mounted on "floor", "ceiling" or "wall", or with a gravity direction (3,).

        On a wall the base's x axis points up. ``base`` (3, 3) rotates frame 0 of the table into the base to which the
        mounting refers, a URDF's root link for instance.
        """
        if isinstance(mounting, str):
            if mounting not in MOUNTINGS:
                raise InputError("mounting", f"'{mounting}'", choices(mounting, [*MOUNTINGS, "[x, y, z]"]))
            mounting = MOUNTINGS[mounting]
        direction = np.array(_unit(mounting, "mounting"))
        if base is not None:
            direction = np.asarray(base, dtype=float).T @ direction
            direction[np.abs(direction) < 1e-15] = 0.0
        return replace(self, direction=tuple(direction.tolist()))

    def carrying(self, payload: float, centre: Sequence[float] | None = None) -> Gravity:
        """Return the same with a payload [kg] at ``centre`` (3,) in the flange frame [m], as before by default."""
        return replace(self, payload=payload, payload_centre=self.payload_centre if centre is None else tuple(centre))


def _vector(values: ArrayLike, where: str) -> Vector:
    """Return three finite numbers, none of them a negative zero."""
    x, y, z = (finite_numbers(where, values, (3,)) + 0.0).tolist()
    return x, y, z


def _unit(values: ArrayLike, where: str) -> Vector:
    """Return three numbers as a unit vector; one that is stays as it is."""
    vector = _vector(values, where)
    length = math.hypot(*vector)
    if not length > 0:
        raise InputError(where, f"{list(vector)}", "a nonzero vector")
    return vector if abs(length - 1) < 1e-15 else _vector(np.array(vector) / length, where)


def _mass(value: float, where: str) -> float:
    if not (0 <= value < math.inf):
        raise InputError(where, f"{value}", "a mass [kg], not negative")
    return float(value)


@dataclass(frozen=True, eq=False, repr=False)
class Robot(Brief):
    """A serial arm.

    Link i moves frame i-1 to frame i by (Craig's convention; paper, Eq. 1)::

        Rot(x, alpha) Trans(x, a) Rot(z, theta + q) Trans(z, d) Rot(y, beta)      revolute
        Rot(x, alpha) Trans(x, a) Rot(z, theta) Trans(z, d + q) Rot(y, beta)      prismatic

    where q are the model's joint values, q = ``joint_map`` @ (joint values of the controller).

    ``mdh`` is (n, 5) with columns alpha [rad], a [m], theta [rad], d [m], beta [rad]; ``joint_types`` states
    ``"revolute"`` (default) or ``"prismatic"`` for every joint. ``joint_map`` (n, dof) has the signs and couplings
    between the controller's joint values and the model's, by default the identity (a FANUC counts joint 3 from the
    horizontal); a mimic joint has a row but no column, so that dof < n. ``limits`` (dof, 2) are lower and upper joint
    values of the controller [rad or m], infinite if unknown; ``source`` is the origin of the table. ``model`` adds
    user-defined terms, which `forward_kinematics` leaves out. ``joint_names`` are the names in a robot's file.
    InputError for shapes that do not fit, numbers that are not finite, a singular joint map, limits that are not in
    order, and masses or names that are not one per joint.

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
    joint_names: tuple[str, ...] = ()

    def _short(self) -> str:
        return f"'{shortened(self.name)}', {self.dof} joints"

    def __post_init__(self) -> None:
        def require(right: bool, where: str, found: str, accepted: str) -> None:
            if not right:
                raise InputError(where, found, accepted, self.name)

        mdh = _frozen(self.mdh)
        right = mdh.ndim == 2 and mdh.shape[1] == 5 and len(mdh) > 0 and bool(np.isfinite(mdh).all())
        require(right, "mdh", f"shape {mdh.shape}", "finite numbers of shape (dof, 5); beta may be 0")
        n = len(mdh)
        largest = np.abs(mdh).max()
        require(largest <= FARTHEST, "mdh", f"{largest:g}", f"magnitudes of at most {FARTHEST:g} m or rad")
        types = tuple(self.joint_types) or ("revolute",) * n
        right = len(types) == n and set(types) <= {"revolute", "prismatic"}
        require(right, "joint_types", repr(types), f"{n} entries, each revolute or prismatic")
        joint_map = _frozen(self.joint_map if np.size(self.joint_map) else np.eye(n))
        right = joint_map.ndim == 2 and len(joint_map) == n >= joint_map.shape[1]
        right = right and bool((np.abs(joint_map) <= LARGEST).all())
        right = right and bool(np.linalg.det(joint_map.T @ joint_map) > 1e-18)
        require(right, "joint_map", f"{joint_map.tolist()}", f"an invertible {n} x {n} matrix, or independent columns")
        k = joint_map.shape[1]
        limits = _frozen(self.limits if np.size(self.limits) else np.tile([-np.inf, np.inf], (k, 1)))
        right = limits.shape == (k, 2) and bool((limits[:, 0] < limits[:, 1]).all())
        require(right, "limits", f"{limits.tolist()}", f"{k} pairs lower < upper")
        for where, each in (("masses", self.gravity.masses), ("joint_names", self.joint_names)):
            require(len(each) in (0, n), where, f"{len(each)} {where}", f"{n}, one per joint")
        for name, value in (("mdh", mdh), ("joint_types", types), ("joint_map", joint_map), ("limits", limits)):
            object.__setattr__(self, name, value)

    @property
    def dof(self) -> int:
        """Number of the controller's joints."""
        return self.joint_map.shape[1]

    def joint(self, i: int | np.intp) -> str:
        """Return the number of the controller's joint i (from 0), with its name where that is known."""
        return numbered(i, [self.joint_names[k] for k in self.leading] if self.joint_names else ())

    @property
    def leading(self) -> tuple[int, ...]:
        """The model's joint (from 0) of every joint of the controller: the first that moves with this joint alone."""
        n, k = self.joint_map.shape
        if n == k:
            return tuple(range(n))
        unit = [np.flatnonzero((self.joint_map == column).all(axis=1)) for column in np.eye(k)]
        moved = [np.flatnonzero(column) for column in self.joint_map.T]
        return tuple(int((rows if len(rows) else other)[0]) for rows, other in zip(unit, moved, strict=True))

    @property
    def zeros(self) -> list[str]:
        """Names of the parameters that the zeros of the model's joints are."""
        return [f"{'theta' if kind == 'revolute' else 'd'}{i}" for i, kind in enumerate(self.joint_types, start=1)]

    @property
    def joint_dimensions(self) -> tuple[str, ...]:
        """``"angle"`` for a revolute joint of the controller, ``"length"`` for a prismatic one."""
        return tuple("angle" if self.joint_types[i] == "revolute" else "length" for i in self.leading)


def numbered(i: int | np.intp, names: Sequence[str]) -> str:
    """Return the number of joint i (from 0), with its name where that is known: ``5 (wrist_2_joint)``."""
    return f"{i + 1} ({names[int(i)]})" if names and names[int(i)] else f"{i + 1}"


def _frozen(values: ArrayLike) -> Array:
    array = np.array(values, dtype=float)
    array.setflags(write=False)
    return array
