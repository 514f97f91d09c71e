"""Where gravity points in a robot's base, and what it pulls at: masses of links and a payload."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from rpim_opt.basics.arrays import Array
from rpim_opt.basics.exceptions import InputError, choices

STANDARD = 9.80665
"""Acceleration of free fall [m/s^2]."""
Vector = tuple[float, float, float]
MOUNTINGS: dict[str, Vector] = {"floor": (0.0, 0.0, -1.0), "ceiling": (0.0, 0.0, 1.0), "wall": (-1.0, 0.0, 0.0)}
"""Where gravity points in the robot's base; on a wall the base's x axis points up."""


@dataclass(frozen=True)
class Gravity:
    """Gravity on a robot.

    Parameters
    ----------
    direction
        Where it points in the robot's base frame (frame 0 of the table), made a unit vector.
    masses
        Of the links that joints 1 to dof move [kg]. Without: a guess, 5 kg at the last frame's origin and 10 kg at
        frame 4's, which is good enough to tell how torques go with the configuration: compliance takes up their size.
    centres
        Where those masses are in the links' own frames [m], the frames after joints 1 to dof.
    payload
        What the flange carries besides [kg].
    payload_centre
        Where, in the flange frame [m].

    Raises
    ------
    InputError
        For no direction, masses that are negative, numbers that are not finite or do not fit together.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> ro.robot.Gravity(direction=(0, 0, -9.81), payload=2.5).direction
    (0.0, 0.0, -1.0)
    >>> hash(ro.robot.Gravity()) == hash(ro.robot.Gravity((0, 0, -1)))
    True
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
            raise InputError("gravity", f"{len(self.masses)} masses, {len(self.centres)} centres", "one centre a mass")

    def mounted(self, mounting: str | Sequence[float], base: ArrayLike | None = None) -> Gravity:
        """Return the same masses on a robot that is mounted so.

        Parameters
        ----------
        mounting
            ``"floor"``, ``"ceiling"``, ``"wall"`` (the base's x axis points up), or where gravity points, three numbers
            in the robot's base.
        base
            (3, 3) rotation of frame 0 of the table in the base that is meant, a URDF's root link for instance.

        Raises
        ------
        InputError
            For another word, or three zeros.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> ro.robot.Gravity().mounted("ceiling").direction, ro.robot.Gravity().mounted([0, -2, 0]).direction
        ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
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
        """Return the same with a payload.

        Parameters
        ----------
        payload
            Its mass [kg].
        centre
            (3,) where it is in the flange frame [m]; as before unless it is given.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> ro.robot.Gravity().carrying(1.5, (0, 0, 0.1)).payload_centre
        (0.0, 0.0, 0.1)
        """
        if centre is None:
            centre = self.payload_centre
        return replace(self, payload=payload, payload_centre=tuple(centre))


def _vector(values: ArrayLike, where: str) -> Vector:
    """Return three finite numbers, none of them a negative zero."""
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise InputError(where, f"{values}", "three finite numbers")
    x, y, z = (array + 0.0).tolist()
    return x, y, z


def _unit(values: ArrayLike, where: str) -> Vector:
    """Return three numbers as a unit vector."""
    vector = _vector(values, where)
    length = math.hypot(*vector)
    if abs(length - 1) < 1e-15:
        return vector
    if not length > 0:
        raise InputError(where, f"{list(vector)}", "a vector that points somewhere")
    array: Array = np.array(vector) / length
    x, y, z = array.tolist()
    return x, y, z


def _mass(value: float, where: str) -> float:
    if not (0 <= value < math.inf):
        raise InputError(where, f"{value}", "a mass [kg], not negative")
    return float(value)
