"""The terms that every arm has, written as a user writes them, and how joints and links move by all terms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial

import casadi as ca

from rpim_opt.robot.posture import Joint, Posture, Symbol
from rpim_opt.robot.terms import Place, Term, moved

JOINT_TERMS = (
    Term(lambda joint, ratio: ratio * joint.q, {"ratio_ppm": 1000}, joints=("revolute", "prismatic")),
    Term(lambda joint, size: size * ca.cos(joint.q), {"ecc_cos_rad": 1e-3}),
    Term(lambda joint, size: size * ca.sin(joint.q), {"ecc_sin_rad": 1e-3}),
    Term(lambda joint, size: size * ca.cos(2 * joint.q), {"ecc2_cos_rad": 1e-4}),
    Term(lambda joint, size: size * ca.sin(2 * joint.q), {"ecc2_sin_rad": 1e-4}),
    Term(lambda joint, compliance: compliance * joint.torque, {"compliance_rad_per_Nm": 1e-5}),
    Term(lambda joint, half: half * joint.approach, {"backlash_rad": 1e-4}),
)
"""What every joint has; all parameters are zero in a nominal robot."""
BEND_SCALE = 1e-4
"""Expected deflection of a joint by one component of one link's first moment [rad]."""


def _bend(k: int, axis: str, joint: Joint, size: Symbol) -> Symbol:
    return size * joint.moment(k, axis)


@lru_cache
def terms_of(dof: int) -> tuple[Term, ...]:
    """Return all terms of an arm: `JOINT_TERMS`, and what the first moment of every link does, ``bend{i}_{k}{axis}``.

    Joint i has those of the links k that it carries, k >= i; a robot's table leaves out what says nothing.
    """
    bends = [
        Term(partial(_bend, k, axis), {f"bend{{}}_{k}{axis}_rad": BEND_SCALE})
        for k in range(1, dof + 1)
        for axis in "xyz"
    ]
    return (*JOINT_TERMS, *bends)


def motion(
    joint_types: Sequence[str], i: int, posture: Posture, value: Callable[[str], Symbol], terms: Sequence[Term] = ()
) -> Symbol:
    """Return by how much joint i has moved [rad or m].

    ``value("ratio2")`` gives the parameters; all terms of the joint are added, and ``terms`` besides::

        q + ratio q + ecc_cos cos q + ecc_sin sin q + compliance torque + ...        revolute
        q + ratio q                                                                  prismatic
    """
    total = posture.q[i - 1]
    joint = Joint(i, posture)
    for term in (*terms_of(len(posture.q)), *terms):
        if term.at == "joint" and i in term.places(joint_types):
            more = moved(term, joint, value)
            if more is not None:
                total = total + more
    return total


def displacement(
    at: Place,
    joint_types: Sequence[str],
    i: int,
    posture: Posture,
    value: Callable[[str], Symbol],
    terms: Sequence[Term],
) -> ca.SX | None:
    """Return the displacement (6, 1) [m, rad] of link i's frame, the robot's or the flange's; None for none at all."""
    total = None
    for term in terms:
        if term.at == at and i in term.places(joint_types):
            more = moved(term, Joint(i, posture), value)
            if more is not None:
                total = more if total is None else total + more
    return total
