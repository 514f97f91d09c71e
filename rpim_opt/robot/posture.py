"""What a term sees of an arm in one configuration: joint values, torques, gravity, and columns of the data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import casadi as ca

from rpim_opt.basics.exceptions import InputError

Symbol = Any  # ca.SX or a number: CasADi ships no types


class Weight(Protocol):
    """What gravity does to an arm of nominal geometry, made when a term asks for it."""

    @property
    def payload(self) -> Symbol:
        """Mass at the flange [kg]."""
        ...

    def torque(self, i: int) -> Symbol:
        """Return the torque of gravity about joint i [Nm]."""
        ...

    def moment(self, i: int, k: int, axis: str) -> Symbol:
        """Return what a unit of first moment of link k along its x, y or z means to joint i, without unit."""
        ...

    def down(self, k: int) -> Symbol:
        """Return where gravity points in the frame after joint k, a unit vector (3, 1)."""
        ...


@dataclass(frozen=True, eq=False)
class Posture:
    """What happens to an arm in one configuration, as the joints of the model see it.

    Parameters
    ----------
    q
        Joint values of the model [rad or m].
    torque
        Measured joint torques [Nm]; None where those of gravity stand for them.
    approach
        Directions of the joints' last movement, -1, 0 or +1; None where they are not known.
    weight
        What gravity does; None where nothing asks.
    columns
        Further columns of the data by name [SI].

    Examples
    --------
    >>> import rpim_opt as ro
    >>> ro.robot.Posture(q=[0.1, 0.5], columns={"temperature": 3.0}).torque is None
    True
    """

    q: Sequence[Symbol]
    torque: Sequence[Symbol] | None = None
    approach: Sequence[Symbol] | None = None
    weight: Weight | None = None
    columns: Mapping[str, Symbol] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Joint:
    """What a term sees of joint ``number`` (from 1), and of the link that it moves.

    A term of the base sees the first joint, one of the tool the last.

    Parameters
    ----------
    number
        Of the joint, from 1.
    posture
        Of the arm.

    Examples
    --------
    >>> import rpim_opt as ro
    >>> elbow = ro.robot.Joint(2, ro.robot.Posture(q=[0.1, 0.5], approach=[-1, 1], columns={"temperature": 3.0}))
    >>> elbow.q, elbow.approach, elbow.column("temperature")
    (0.5, 1, 3.0)
    """

    number: int
    posture: Posture

    @property
    def q(self) -> Symbol:
        """Joint value of the model [rad or m]."""
        return self.posture.q[self.number - 1]

    @property
    def every_q(self) -> Sequence[Symbol]:
        """Joint values of all joints [rad or m].

        >>> import rpim_opt as ro
        >>> ro.robot.Joint(2, ro.robot.Posture(q=[0.1, 0.5])).every_q
        [0.1, 0.5]
        """
        return self.posture.q

    @property
    def torque(self) -> Symbol:
        """Measured torque [Nm] where the data have torques, that of gravity elsewhere.

        >>> import rpim_opt as ro
        >>> ro.robot.Joint(2, ro.robot.Posture(q=[0.1, 0.5], torque=[3.0, 7.0])).torque
        7.0
        """
        if self.posture.torque is None:
            return self.gravity
        return self.posture.torque[self.number - 1]

    @property
    def gravity(self) -> Symbol:
        """Torque of gravity about the joint [Nm] on the nominal arm, positive the way it turns the joint.

        >>> import rpim_opt as ro
        >>> ro.robot.Joint(2, ro.robot.Posture(q=[0.1, 0.5])).gravity  # of a posture without weight
        0.0
        """
        if self.posture.weight is None:
            return 0.0
        return self.posture.weight.torque(self.number)

    @property
    def down(self) -> Symbol:
        """Where gravity points in the frame after the joint, of the nominal arm: a unit vector (3, 1).

        >>> import casadi as ca
        >>> import rpim_opt as ro
        >>> def bends(link, soft):  # a beam along x, clamped at the joint before it
        ...     return ca.vertcat(0, 0, 0, soft * ca.cross(ca.DM([1, 0, 0]), link.down))
        >>> beam = ro.robot.Term(bends, {"beam_mrad": 0.1}, at="link", joints=(2,))
        >>> ro.load("position").problem.with_model(ro.Model([beam])).parameters.free.names[-1]
        'beam2'
        """
        if self.posture.weight is None:
            return ca.DM.zeros(3)
        return self.posture.weight.down(self.number)

    @property
    def payload(self) -> Symbol:
        """Mass at the flange [kg].

        >>> import rpim_opt as ro
        >>> ro.robot.Joint(2, ro.robot.Posture(q=[0.1, 0.5])).payload  # of a posture without weight
        0.0
        """
        if self.posture.weight is None:
            return 0.0
        return self.posture.weight.payload

    @property
    def approach(self) -> Symbol:
        """Direction of the joint's last movement, -1, 0 or +1; 0 where it is not known."""
        if self.posture.approach is None:
            return 0.0
        return self.posture.approach[self.number - 1]

    def moment(self, k: int, axis: str) -> Symbol:
        """Return z_i . (R_k e_a x g_hat): what link k's first moment along its ``axis`` a means to this joint i.

        Parameters
        ----------
        k
            The link, from 1.
        axis
            ``"x"``, ``"y"`` or ``"z"`` of its frame.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> own = ro.robot.Term(lambda joint, size: size * joint.moment(3, "x"), {"own_mrad": 0.1}, joints=(2,))
        >>> ro.load("position").problem.with_model(ro.Model([own])).parameters.free.names[-1]
        'own2'
        """
        if self.posture.weight is None:
            return 0.0
        return self.posture.weight.moment(self.number, k, axis)

    def column(self, name: str) -> Symbol:
        """Return what a column of the data says of the row [SI]; the term has to name it in its ``columns``.

        Parameters
        ----------
        name
            Of the column.

        Raises
        ------
        InputError
            For a column that the term does not name.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> ro.robot.Joint(1, ro.robot.Posture(q=[0.1], columns={"hours": 8.0})).column("hours")
        8.0
        """
        if name not in self.posture.columns:
            raise InputError("term", f"column '{name}'", f"columns={{'{name}': ...}} of the term, with its dimension")
        return self.posture.columns[name]
