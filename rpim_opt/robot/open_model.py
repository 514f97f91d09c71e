"""A kinematic model that a user opens: terms beside those that every arm has."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import casadi as ca

from rpim_opt.basics.exceptions import InputError
from rpim_opt.robot.evaluation import SYMBOLS
from rpim_opt.robot.posture import Joint, Posture, Symbol
from rpim_opt.robot.terms import Entry, Term, moved


class Asks(NamedTuple):
    """What terms ask of a row: torques, gravity, directions of approach, columns."""

    torques: bool = False
    gravity: bool = False
    approach: bool = False
    columns: frozenset[str] = frozenset()

    def beside(self, other: Asks) -> Asks:
        """Return what either asks."""
        return Asks(
            self.torques or other.torques,
            self.gravity or other.gravity,
            self.approach or other.approach,
            self.columns | other.columns,
        )


@dataclass(frozen=True, eq=False)
class Model:
    """The kinematics of an arm, opened: the product of its links, with terms of a user's own.

    Parameters
    ----------
    terms
        What moves joints, links, the base or the tool besides the terms that every arm has (``ratio``, ``ecc_cos``,
        ..., ``compliance``, ``backlash``, ``bend``).

    Raises
    ------
    InputError
        For two parameters of one name, and one column in two dimensions.

    Examples
    --------
    A third harmonic, identified beside the parameters that the problem identifies already:

    >>> import casadi as ca
    >>> import rpim_opt as ro
    >>> third = ro.robot.Term(lambda joint, size: size * ca.cos(3 * joint.q), {"third_mrad": 0.1}, joints=(2, 3))
    >>> problem = ro.load("position").problem.with_model(ro.Model(terms=[third]))
    >>> problem.parameters.free.names[-2:], problem.robot.model.terms == (third,)
    (('third2', 'third3'), True)
    >>> result = ro.calibrate(problem, ro.tikhonov, weight=1.0)
    >>> bool(abs(result.x[-2:]).max() < 1e-4)  # [rad]; this arm has none
    True
    """

    terms: Sequence[Term] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "terms", tuple(self.terms))
        stems = [entry.stem for term in self.terms for entry in term.entries]
        for stem in stems:
            if stems.count(stem) > 1:
                raise InputError("model, terms", f"parameter '{stem}' twice", "a name of its own for every parameter")
        for term in self.terms:
            for name, dimension in term.columns.items():
                if self.columns[name] != dimension:
                    raise InputError("model, terms", f"column '{name}' in two dimensions", "one of them")

    @cached_property
    def columns(self) -> Mapping[str, str]:
        """Further columns of the data that its terms see, name to dimension.

        >>> import rpim_opt as ro
        >>> slow = ro.robot.Term(
        ...     lambda joint, rate: rate * joint.column("hours"), {"drift_mrad": 0.1}, columns={"hours": ""}
        ... )
        >>> ro.Model([slow]).columns
        {'hours': ''}
        """
        return {name: dimension for term in self.terms for name, dimension in term.columns.items()}

    def names(self, joint_types: Sequence[str]) -> tuple[str, ...]:
        """Return the names of all its parameters.

        Parameters
        ----------
        joint_types
            Of the arm.

        Examples
        --------
        >>> import rpim_opt as ro
        >>> sag = ro.robot.Term(lambda tool, x: [0, 0, x, 0, 0, 0], {"sag_mm": 0.1}, at="tool")
        >>> ro.Model([sag]).names(("revolute", "revolute"))
        ('sag',)
        """
        return tuple(name for name, _ in entries_of(self, joint_types))


def entries_of(model: Model, joint_types: Sequence[str]) -> Iterator[tuple[str, Entry]]:
    """Yield the parameters of a model's terms by name."""
    for term in model.terms:
        for i in term.places(joint_types):
            yield from zip(term.names(i), term.entries, strict=True)


def asked_by(model: Model, joint_types: Sequence[str], used: Callable[[str], bool]) -> Asks:
    """Return what the terms ask of a row that have no parameters, or one of which ``used(name)`` says so."""
    found = Asks()
    for term in model.terms:
        for i in term.places(joint_types):
            names = term.names(i)
            if not names or any(map(used, names)):
                with SYMBOLS:
                    found = found.beside(_asked(term, i, len(joint_types)))
    return found


class _Stub:
    """Gravity of which nothing is known but whether somebody asks."""

    def __init__(self) -> None:
        self.payload: Symbol = ca.SX.sym("gravity")

    def torque(self, i: int) -> Symbol:
        return self.payload

    def moment(self, i: int, k: int, axis: str) -> Symbol:
        return self.payload

    def down(self, k: int) -> Symbol:
        return ca.vertcat(self.payload, self.payload, self.payload)


def _asked(term: Term, i: int, dof: int) -> Asks:
    """Return what a term asks of a row: what its answer depends on."""
    q = ca.SX.sym("q", dof)
    torque = ca.SX.sym("torque", dof)
    approach = ca.SX.sym("approach", dof)
    weight = _Stub()
    columns = {name: ca.SX.sym(name) for name in term.columns}
    posture = Posture(ca.vertsplit(q), ca.vertsplit(torque), ca.vertsplit(approach), weight, columns)
    found = moved(term, Joint(i, posture), lambda name: ca.SX.sym(name))
    if found is None:
        return Asks()
    return Asks(
        torques=ca.depends_on(found, torque),
        gravity=ca.depends_on(found, weight.payload),
        approach=ca.depends_on(found, approach),
        columns=frozenset(name for name, symbol in columns.items() if ca.depends_on(found, symbol)),
    )
