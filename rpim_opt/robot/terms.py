"""What a joint does besides its drawing: terms, each a parameter times something that the joint sees."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, Protocol

import casadi as ca

Symbol = Any  # ca.SX or a number: CasADi ships no types


class Weight(Protocol):
    """What gravity does to an arm of nominal geometry, made when a term asks for it."""

    def torque(self, i: int) -> Symbol:
        """Return the torque of gravity about joint i [Nm]."""
        ...

    def moment(self, i: int, k: int, axis: str) -> Symbol:
        """Return what a unit of first moment of link k along its x, y or z means to joint i, without unit."""
        ...


@dataclass(frozen=True, eq=False)
class Posture:
    """What happens to an arm in one configuration, as the joints of the model see it.

    Parameters
    ----------
    q
        Joint values [rad or m].
    torque
        Measured joint torques [Nm]; None where those of gravity stand for them.
    approach
        Directions of the joints' last movement, -1, 0 or +1; None where they are not known.
    weight
        What gravity does; None where nothing asks.
    """

    q: Sequence[Symbol]
    torque: Sequence[Symbol] | None = None
    approach: Sequence[Symbol] | None = None
    weight: Weight | None = None


@dataclass(frozen=True, eq=False)
class Joint:
    """What a term sees of joint ``number`` (from 1)."""

    number: int
    posture: Posture

    @property
    def q(self) -> Symbol:
        """Joint value of the model [rad or m]."""
        return self.posture.q[self.number - 1]

    @property
    def every_q(self) -> Sequence[Symbol]:
        """Joint values of all joints [rad or m]."""
        return self.posture.q

    @property
    def torque(self) -> Symbol:
        """Measured torque [Nm] where the data have torques, that of gravity elsewhere."""
        if self.posture.torque is None:
            return self.gravity
        return self.posture.torque[self.number - 1]

    @property
    def gravity(self) -> Symbol:
        """Torque of gravity about the joint [Nm] on the nominal arm, positive the way it turns the joint."""
        if self.posture.weight is None:
            return 0.0
        return self.posture.weight.torque(self.number)

    @property
    def approach(self) -> Symbol:
        """Direction of the joint's last movement, -1, 0 or +1; 0 where it is not known."""
        if self.posture.approach is None:
            return 0.0
        return self.posture.approach[self.number - 1]

    def moment(self, k: int, axis: str) -> Symbol:
        """Return z_i . (R_k e_a x g_hat): what link k's first moment along its ``axis`` a means to this joint i."""
        if self.posture.weight is None:
            return 0.0
        return self.posture.weight.moment(self.number, k, axis)


@dataclass(frozen=True)
class JointTerm:
    """A way in which joints move besides their value: by parameter times effect [rad or m].

    Parameters
    ----------
    name
        The parameter of joint 3 is called ``{name}3{suffix}``.
    dimension
        Of the parameter: ``angle``, ``ratio``, ``compliance``.
    scale
        Its expected size [SI].
    effect
        What multiplies it, from what the joint sees, in CasADi.
    suffix
        What follows the joint's number in the parameter's name.
    joints
        Types of the joints that have it.

    Examples
    --------
    >>> import casadi as ca
    >>> from rpim_opt.robot.terms import Joint, JointTerm, Posture
    >>> third = JointTerm("ecc3_cos", "angle", 1e-4, lambda joint: ca.cos(3 * joint.q))
    >>> third.parameter(2), float(third.effect(Joint(2, Posture([0.0, ca.pi / 3]))))
    ('ecc3_cos2', -1.0)
    """

    name: str
    dimension: str
    scale: float
    effect: Callable[[Joint], Symbol]
    suffix: str = ""
    joints: tuple[str, ...] = ("revolute",)

    def parameter(self, i: int) -> str:
        """Return the name of joint i's parameter."""
        return f"{self.name}{i}{self.suffix}"


JOINT_TERMS = (
    JointTerm("ratio", "ratio", 1e-3, lambda joint: joint.q, joints=("revolute", "prismatic")),
    JointTerm("ecc_cos", "angle", 1e-3, lambda joint: ca.cos(joint.q)),
    JointTerm("ecc_sin", "angle", 1e-3, lambda joint: ca.sin(joint.q)),
    JointTerm("ecc2_cos", "angle", 1e-4, lambda joint: ca.cos(2 * joint.q)),
    JointTerm("ecc2_sin", "angle", 1e-4, lambda joint: ca.sin(2 * joint.q)),
    JointTerm("compliance", "compliance", 1e-5, lambda joint: joint.torque),
    JointTerm("backlash", "angle", 1e-4, lambda joint: joint.approach),
)
"""What every joint has; all parameters are zero in a nominal robot."""
BEND_SCALE = 1e-4
"""Expected deflection of a joint by one component of one link's first moment [rad]."""


def _moment(k: int, axis: str, joint: Joint) -> Symbol:
    return joint.moment(k, axis)


@lru_cache
def terms_of(dof: int) -> tuple[JointTerm, ...]:
    """Return all terms of an arm: `JOINT_TERMS`, and what the first moment of every link does, ``bend{i}_{k}{axis}``.

    Joint i has those of the links k that it carries, k >= i; a robot's table leaves out what says nothing.
    """
    bends = [
        JointTerm("bend", "angle", BEND_SCALE, partial(_moment, k, axis), suffix=f"_{k}{axis}")
        for k in range(1, dof + 1)
        for axis in "xyz"
    ]
    return (*JOINT_TERMS, *bends)


def motion(kind: str, i: int, posture: Posture, value: Callable[[str], Symbol]) -> Symbol:
    """Return by how much joint i has moved [rad or m].

    ``value("ratio2")`` gives the parameters; all terms of the joint are added::

        q + ratio q + ecc_cos cos q + ecc_sin sin q + compliance torque + ...        revolute
        q + ratio q                                                                  prismatic
    """
    joint = Joint(i, posture)
    moved = joint.q
    for term in terms_of(len(posture.q)):
        if kind in term.joints:
            size = value(term.parameter(i))
            # an effect may take a whole chain to write down: not for a parameter that is not there
            if not is_zero(size):
                moved = moved + size * term.effect(joint)
    return moved


def is_zero(value: Symbol) -> bool:
    """Return whether a value is zero whatever the symbols in it."""
    if isinstance(value, ca.SX):
        return bool(value.is_zero())
    return value == 0
